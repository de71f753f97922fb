"""The panels of displacements against each other: do the sensors agree, integration and differences, the split."""

from __future__ import annotations

from html import escape

import numpy as np

from edge_agent.messages import F64, S
from edge_agent.review.charts import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    RAW,
    RED,
    Plot,
    Scale,
    limits,
    table,
    time_scale,
    utc,
)
from edge_agent.review.checks import OVERLAY_S, Apart, Checks, liveliest
from edge_agent.review.gather import Busy, Review
from edge_agent.review.integrate import Overlay
from edge_agent.review.panels import AXES, MM, mm, number
from edge_agent.review.splits import Split
from edge_agent.review.witness import Windows

SHOWN_S = 30.0
"""Seconds of a close look at the split, and at second differences half of it."""


def agreement(r: Review) -> str:
    """Whether receiver and accelerometer tell of the same motion."""
    rows, out = [], []
    for name, p in r.points.items():
        a = p.agreement
        if a is None:
            why = next((t for t in p.notes if "compared" in t), "")
            if not why:
                pair = p.receiver and p.accelerometer
                why = "no stretch of both long enough" if pair else "it has not both sensors"
            out.append(f"<p>{escape(name)}: not compared, {escape(why.removeprefix('sensors not compared: '))}.</p>")
            continue
        o, m = a.offset, a.mounting
        offset = f"{number(1e3 * o.value_s, 1)} \u00b1 {1e3 * o.std_s:.1f} ms" if o.observable else escape(o.why)
        yaw = escape(m.why)
        if m.observable:
            yaw = f"{number(m.yaw_deg, 1)} \u00b1 {m.std_yaw_deg:.1f}\u00b0, {' '.join(m.axes)}"
        rows.append([escape(name), escape(a.verdict.lower()), escape(a.text), offset, yaw])
        if p.busy is not None and len(a.windows.share):
            out.append(_windows(name, a.windows, p.busy.utc_minus_ns))
    if rows:
        head = ["point", "verdict", "", "add to the accelerometer\u2019s time", "yaw and axes"]
        out.insert(0, table(head, rows))
        text = (
            "Of the liveliest minutes. Windows: how much of the motion that the accelerations tell, as they are "
            "configured, the fixes show: 100 % where both see one motion, 0 where they see two (\u00b1 2 sd). "
            "Windows in which the accelerometer tells no more than its own noise have no say. Log likelihood: of the "
            "fixes with the accelerometer less without, by a filter that is quick enough to follow without it. One "
            "window proves nothing: a blow that the samples missed or a wrong fix speaks against sound sensors too; "
            "the verdict is that of most windows, or of a clock or mounting by which most of them gain."
        )
        out.append(f'<p class="small">{text}</p>')
    return "".join(out)


def _windows(name: str, w: Windows, utc_minus_ns: int) -> str:
    """Share of the told motion that the fixes show, in time."""
    t0, t1 = w.begin_ns + utc_minus_ns, w.end_ns + utc_minus_ns
    y, sd = 100.0 * w.share, 200.0 * w.std
    said = w.loud & (sd < 200.0)
    frame = time_scale(int(t0[0]), int(t1[-1]))
    plot = Plot(
        frame, Scale(*limits(np.clip(y - sd, -250, 250)[said], np.array([-10.0, 110.0])), "%"), 130, 4, alone=True
    )
    for a, b, v, s in zip(t0[said].tolist(), t1[said].tolist(), y[said].tolist(), sd[said].tolist(), strict=True):
        edges = np.array([a, b], np.int64)
        plot.area(edges, np.full(2, v - s), np.full(2, v + s), float("inf"), BLUE, "\u00b1 2 sd", 0.3)
        plot.line(edges, np.full(2, v), BLUE, "told motion that the fixes show")
    plot.level(100.0, GREEN, "they see one motion")
    plot.level(0.0, RED, "they see different ones")
    some = f"{int(w.favour.sum())} speak for the accelerometer, {int(w.against.sum())} against"
    total = f"log likelihood with less without {number(float(w.support.sum()), 0)}"
    return plot.html(f"{name}: {len(w.share)} windows, {some}; {total}")


def integration(r: Review) -> str:
    """Second differences of displacements against accelerations; accelerations integrated twice."""
    out = []
    for name, p in r.points.items():
        c, busy = p.checks, p.busy
        if c is None or busy is None or not c.differences:
            continue
        rows = []
        for what, d in c.differences.items():
            rows += [
                [what, AXES[i], number(float(d.correlation[i]), 3), number(float(d.gain[i]), 3), f"{d.rms_mps2[i]:.3g}",
                 f"{d.rms_difference_mps2[i]:.3g}"] for i in range(3)
            ]  # fmt: skip
        head = [
            "displacement", "axis", "correlation", "gain", "rms of the accelerations [m/s\u00b2]",
            "rms of the difference [m/s\u00b2]",
        ]  # fmt: skip
        out.append(f"<h3>{escape(name)}: second differences against the accelerations</h3>" + table(head, rows, 4))
        out.append('<div class="grid3">')
        out += [_second(name, c, busy, axis) for axis in range(3)]
        out.append("</div>")
        apart, n = c.second_way
        if n:
            out.append(
                f'<p class="small">{escape(name)}: the smoothed displacement, computed a second way over {n} fixes '
                f"(two filters, one forward, one backward), differs by {MM * apart:.1g} mm at most.</p>"
            )
        if c.overlay is not None:
            out.append(f"<h3>{escape(name)}: accelerations integrated twice</h3>" + '<div class="grid3">')
            out += [_overlay(name, c, c.overlay, busy, axis) for axis in range(3)]
            out.append("</div>")
    if not out:
        return "<p>No point has a stretch of fixes and accelerations with a frequency that stands out.</p>"
    text = (
        "Of the liveliest minutes, in the band of the structure\u2019s frequencies. A displacement that is right gives "
        "the accelerations back when it is differenced twice: correlation and gain 1. The smoothed one is made with "
        "them, so it shows that the fixes do not pull it away from them; raw fixes know nothing of them. Integrated "
        f"twice, accelerations start from the smoothed state and are not corrected for {OVERLAY_S:.0f} s: how they "
        "drift is what the fixes hold."
    )
    return "".join(out) + f'<p class="small">{text}</p>'


def _every(n: int, most: int = 1500) -> int:
    """Every so manieth of n samples is drawn: more than a plot has pixels say nothing more."""
    return max(1, n // most)


def _second(name: str, c: Checks, busy: Busy, axis: int) -> str:
    best = c.differences.get("smoothed") or next(iter(c.differences.values()))
    rate = S / float(np.median(np.diff(best.t_ns)))
    edge = len(best.t_ns) // 8
    n = min(round(0.5 * SHOWN_S * rate), len(best.t_ns) - 2 * edge)
    power = np.cumsum(best.from_accelerometer[:, axis] ** 2)
    at = edge + int(np.argmax(power[edge + n - 1 : len(power) - edge] - power[edge : len(power) - edge - n + 1]))
    k = slice(at, at + n, _every(n))
    t0, t1 = int(best.t_ns[k][0]), int(best.t_ns[k][-1])
    a, b = best.from_accelerometer[k, axis], best.from_displacement[k, axis]
    frame = time_scale(t0 + busy.utc_minus_ns, t1 + busy.utc_minus_ns)
    plot = Plot(frame, Scale(*limits(a, b), "m/s\u00b2"), 140, 4, alone=True)
    raw = c.differences.get("raw GNSS")
    if raw is not None:
        i = (raw.t_ns >= t0) & (raw.t_ns <= t1)
        plot.line(raw.t_ns[i] + busy.utc_minus_ns, raw.from_displacement[i, axis], RAW, "from raw GNSS")
    plot.line(best.t_ns[k] + busy.utc_minus_ns, a, BLUE, "accelerations")
    plot.line(best.t_ns[k] + busy.utc_minus_ns, b, RED, "from the smoothed displacement")
    return plot.html(f"{name} {AXES[axis]}, {utc(t0 + busy.utc_minus_ns)[:10]}")


def _overlay(name: str, c: Checks, o: Overlay, busy: Busy, axis: int) -> str:
    every = slice(None, None, _every(len(o.t_ns)))
    t = o.t_ns[every] + busy.utc_minus_ns
    smoothed, alone = MM * c.smoothed[1][c.overlay_rows, axis][every], MM * o.displacement_m[every, axis]
    size = max(float(np.ptp(smoothed)), 1e-3)
    low, high = float(smoothed.min()) - size, float(smoothed.max()) + size
    plot = Plot(time_scale(int(t[0]), int(t[-1])), Scale(low, high, "mm"), 140, 4, alone=True)
    plot.line(t, smoothed, BLUE, "smoothed")
    plot.line(t, alone, ORANGE, "accelerations alone")
    return plot.html(f"{name} {AXES[axis]}, {utc(int(t[0]))[:10]}")


def split(r: Review) -> str:
    """Frequency-split fusion beside the filter, in the busiest minutes."""
    out, rows = [], []
    for name, p in r.points.items():
        s, busy, a = p.split, p.busy, p.apart
        if s is None or busy is None or a is None:
            continue
        rows.append(
            [
                escape(name),
                number(s.critical_hz, 3),
                f"{100 * (1 - a.d_share):.0f} / {100 * a.d_share:.0f} %",
                *(" / ".join(mm(float(v), 2) for v in x) for x in (a.filter_m, a.g_type_m, a.d_type_m, a.merged_m)),
            ]
        )
        n = round(SHOWN_S * S / float(np.median(np.diff(s.t_ns))))
        at = liveliest(s.displacement_m, a.fair, n)
        if at is not None:
            out += [_split(name, s, a, busy, slice(at, at + n, _every(n)), axis) for axis in range(3)]
    if not rows:
        why = [t.removeprefix("not split by frequency: ") for p in r.points.values() for t in p.notes if "split" in t]
        return f"<p>Not split: {escape('; '.join(why) or 'no stretch of both sensors long enough')}.</p>"
    head = [
        "point", "split at [Hz]", "time as G / D", "rms of the filter x / y / z [mm]", "G-type less filter [mm]",
        "D-type less filter [mm]", "merged less filter [mm]",
    ]  # fmt: skip
    text = (
        "Critical frequency: the lowest at which the accelerations clearly peak. G-type: fixes below half of it, "
        "accelerations above, integrated in windows; D-type: a forward filter on high-passed accelerations; merged in "
        "the order of time by which of them the structure moves more. Compared with the live filter in the liveliest "
        "minutes where fixes are there, about the median."
    )
    return table(head, rows) + "".join(out) + f'<p class="small">{text}</p>'


def _split(name: str, s: Split, a: Apart, busy: Busy, k: slice, axis: int) -> str:
    offset = busy.utc_minus_ns
    t = s.t_ns[k] + offset

    def moved(x: F64) -> F64:
        return np.asarray(MM * (x[k, axis] + np.median(a.live_m[k, axis] - x[k, axis])))

    curves = [
        (moved(s.displacement_m), INK, "merged"),
        (moved(s.g_type_m), ORANGE, "G-type"),
        (moved(s.d_type_m), GREEN, "D-type"),
        (MM * a.live_m[k, axis], BLUE, "live filter"),
    ]
    plot = Plot(time_scale(int(t[0]), int(t[-1])), Scale(*limits(*(c[0] for c in curves)), "mm"), 170, alone=True)
    t_z, z, _ = busy.fixes
    near = (t_z + offset >= t[0]) & (t_z + offset <= t[-1]) & busy.taken
    plot.bars(t_z[near] + offset, MM * z[near, axis], MM * z[near, axis], RAW, "raw GNSS")
    for y, colour, text in curves:
        plot.line(t, y, colour, text, broad=colour == INK)
    return plot.html(f"{name} {AXES[axis]}: split at {number(s.critical_hz, 3)} Hz, {utc(int(t[0]))[:10]}")
