"""The panels of what the filter believes: headings, whether its sd is honest, noise, bias, clocks. Each is a pure
function as in `panels`; the figures are those of `estimates`."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from edge_agent.messages import F64, I64, S, Verdict
from edge_agent.review.agree import CLOCK_S
from edge_agent.review.charts import BLUE, GREEN, GREY, ORANGE, RED, Plot, Scale, length, limits, table, utc
from edge_agent.review.estimates import BINS, Gated, Headed
from edge_agent.review.gather import Review
from edge_agent.review.panels import AXES, MM, bin_s, break_of, estimated, mm, number, percent, period
from edge_agent.review.series import Envelope

LEAST = 100
"""Fixes at the gate, for a word on whether the sd is honest."""
SURE, CAREFUL = 1.3, 0.7
"""Mean of the squares over the variance beyond which the filter is too sure or too careful: sd 14 % off."""
COLOURED = 0.3
"""Neighbouring innovations that are so much alike are not noise."""
COLOURS = (BLUE, ORANGE, GREEN)


def headings(r: Review) -> str:
    """Headings of receivers with two antennas."""
    if not any(x.heading for x in r.config.receivers.values()):
        return ""
    rows, out = [], []
    for name, h in r.estimates.headed.items():
        n = sum(h.verdicts.values())
        verdicts = ", ".join(f"{Verdict(v).name.lower()} {k} ({percent(k / n)})" for v, k in sorted(h.verdicts.items()))
        low, high = h.estimate.spans()[1:3]
        turned = float(np.nanmax(high) - np.nanmin(low)) if np.isfinite(high).any() else math.nan
        rows.append(
            [
                escape(name),
                verdicts,
                f"{number(h.last_deg, 3)} \u00b1 {number(h.last_std_deg, 3)}",
                number(turned, 3),
                number(h.baseline_m, 2),
                number(h.mean_nis, 2),
            ]
        )
        out.append(_heading(r, name, h))
    if not rows:
        return "<p>A receiver is configured to give headings; none is in these files.</p>"
    head = [
        "point", "verdicts on the headings", "last [deg]", "turned by [deg]", "antennas apart [m]",
        "innovation\u00b2 / variance (1 = honest)",
    ]  # fmt: skip
    text = (
        "Clockwise from true north; the estimate has the receiver\u2019s multipath in its sd. Headings never enter the "
        "displacement."
    )
    return table(head, rows, 4) + "".join(out) + f'<p class="small">{text}</p>'


def _heading(r: Review, name: str, h: Headed) -> str:
    t, low, high, _ = h.estimate.spans()
    tm, m0, m1, _ = h.measured.spans()
    sd = h.std.spans()[2][:, 0] if len(h.std.spans()[0]) == len(t) else np.full(len(t), math.nan)
    at, far = h.first_deg, 5.0 * float(np.median(np.diff(t))) if len(t) > 1 else math.inf
    live = t, at + low[:, 0], at + high[:, 0], 2 * sd, far
    raw = tm, at + m0[:, 0], at + m1[:, 0]
    return estimated(r, f"{name}: heading", "deg", 180, live, raw, None, ("as the receiver says", "estimate"))


def honest_words(g: Gated) -> str:
    """What the innovations say of the filter's sd."""
    if g.accepted < LEAST:
        return "too few fixes to tell"
    words = []
    if g.mean_nis > SURE:
        words.append(f"too sure of itself: errors are {math.sqrt(g.mean_nis):.1f} times what the sd says")
    elif g.mean_nis < CAREFUL:
        words.append(f"too careful: errors are {math.sqrt(g.mean_nis):.1f} times what the sd says")
    else:
        words.append("honest: errors are as large as the sd says")
    coloured = [AXES[i] for i in range(3) if abs(g.whiteness[i]) > COLOURED]
    if coloured:
        words.append(f"neighbouring innovations are alike in {', '.join(coloured)} (multipath, or a wrong time)")
    return "; ".join(words)


def honesty(r: Review) -> str:
    """Innovations against chi-square: is the sd honest, is the gate as wide as it should be."""
    rows, out = [], []
    for name in r.points:
        g = r.estimates.gated.get(name)
        if g is None or not g.count:
            continue
        rows.append(
            [
                escape(name),
                escape(honest_words(g)),
                f"{number(g.mean_nis, 3)} \u00b1 {number(g.std_nis, 3)}",
                " / ".join(number(float(v), 2) for v in g.whiteness),
                percent(1.0 - g.accepted / g.count),
                percent(r.config.fusion.gate_alpha),
            ]
        )
        often = g.chance * (BINS / g.count)
        spread = 2.0 * math.sqrt(BINS / g.count)
        plot = Plot(
            Scale(0.0, 1.0, "probability of a smaller innovation by chi-square"),
            Scale(0.0, max(2.0, 1.1 * float(often.max())), "times as often"),
            130,
        )
        for k, v in enumerate(often.tolist()):
            plot.box((k + 0.06) / BINS, (k + 0.94) / BINS, 0.0, v, BLUE, f"{v:.2f}")
        plot.legend.append((BLUE, "box", f"{g.count} fixes"))
        plot.level(1.0, RED, "an honest filter, \u00b1 2 sd of chance")
        plot.level(1.0 + spread, GREY, "")
        plot.level(max(1.0 - spread, 0.0), GREY, "")
        out.append(plot.html(f"{name}: innovations against chi-square"))
        t, nis = g.nis.columns()
        if len(t) >= 3:
            sd = np.sqrt(2.0 / (3.0 * np.array([n for _, _, n in g.nis.rows])))
            y, y0, y1 = (np.log10(np.maximum(v, 1e-3)) for v in (nis[:, 0], nis[:, 0] - 2 * sd, nis[:, 0] + 2 * sd))
            low, high = limits(y, np.array([-0.5, 0.5]))
            plot = Plot(period(r), Scale(low, high, "ratio", log=True), 130, 4)
            plot.bars(t, y0, y1, BLUE, "\u00b1 2 sd of chance", opacity=0.35)
            plot.bars(t, y, y, BLUE, f"mean of each {length(bin_s(g.nis))}", big=len(t) < 60)
            plot.level(0.0, RED, "honest")
            out.append(plot.html(f"{name}: innovation\u00b2 / variance in time"))
    if not rows:
        return "<p>Not told: no fix came to the gate in these files.</p>"
    head = [
        "point", "the sd is", "innovation\u00b2 / variance", "likeness of neighbours x / y / z", "beyond the gate",
        "expected of an honest filter",
    ]  # fmt: skip
    text = (
        "Innovation: fix less prediction; its square over its variance is 1 in the mean where the sd is honest (\u00b1 "
        "sd of chance), and the bars are then level. Bars that rise to the right: too sure; to the left: too careful. "
        "Wrong fixes stand in the last bar. Here count the fixes that were taken and those beyond the gate; fixes used "
        "less an open level are left out."
    )
    return table(head, rows) + f'<div class="grid3">{"".join(out)}</div><p class="small">{text}</p>'


def noise(r: Review) -> str:
    """Noise and bias: sd of the fixes as declared and as used, q and qb at the heads of the files, bias in time."""
    rows, out = [], []
    for name, p in r.points.items():
        g = r.estimates.gated.get(name)
        if g is not None and g.accepted:
            used = np.sqrt(g.used / g.accepted)
            declared = np.sqrt(g.declared / g.declared_count) if g.declared_count else np.full(3, math.nan)
            rows.append(
                [
                    escape(name),
                    " / ".join(mm(float(v)) for v in declared) if g.declared_count else "not declared",
                    " / ".join(mm(float(v)) for v in used),
                    " / ".join(number(float(v), 2) for v in used / declared) if g.declared_count else "\u2013",
                    " / ".join(mm(float(v)) for v in p.std_residual_m),
                ]
            )
            out.append(_three(r, f"{name}: sd of the fixes as used", g.used_std, None, MM, "mm"))
        if name in r.estimates.bias and len(r.estimates.bias[name][0].spans()[0]):
            envelope, sd = r.estimates.bias[name]
            out.append(_three(r, f"{name}: bias of the accelerometer about its mean", envelope, sd, MM, "mm/s\u00b2"))
    parts = []
    if rows:
        head = [
            "point", "sd of the fixes as declared x / y / z [mm]", "as used [mm]", "used / declared",
            "sd of the innovations [mm]",
        ]  # fmt: skip
        parts.append(table(head, rows))
    parts.append(_heads(r))
    if out:
        parts.append(f'<div class="grid3">{"".join(out)}</div>')
    if not rows and not out:
        parts.append("<p>No fix was used in these files: nothing was learned of noise.</p>")
    text = (
        "Declared: by the receiver (GST), fixed solutions, root mean square. Used: with the factor that the filter has "
        "learned and the step of the last decimal. The bias holds gravity\u2019s share on a tilted axis; the JSON twin "
        "has its mean."
    )
    return "".join(parts) + f'<p class="small">{text}</p>'


def _three(r: Review, title: str, e: Envelope, sd: Envelope | None, scale: float, unit: str) -> str:
    """Three axes in one plot; with an sd about their means, with its band."""
    t, low, high, _ = e.spans()
    about = np.zeros(3) if sd is None else np.nanmean(0.5 * (low + high), axis=0)
    low, high = scale * (low - about), scale * (high - about)
    shown = [low, high]
    band: F64 | None = None
    if sd is not None and len(sd.spans()[0]) == len(t):
        band = 2 * scale * sd.spans()[2]
        settled = slice(len(t) // 4, None)
        shown = [(low - band)[settled], (high + band)[settled]]
    plot = Plot(period(r), Scale(*limits(*shown), unit), 130, 4)
    far = break_of(e, float(np.median(np.diff(t))) if len(t) > 1 else 0.0)
    for axis, colour in enumerate(COLOURS):
        if band is not None:
            lower, upper = low[:, axis] - band[:, axis], high[:, axis] + band[:, axis]
            plot.area(t, lower, upper, far, colour, "", 0.13)
        plot.area(t, low[:, axis], high[:, axis], far, colour, AXES[axis])
    if band is not None:
        plot.legend.append((GREY, "band", "\u00b1 2 sd"))
    return plot.html(title)


def _heads(r: Review) -> str:
    """q, qb and the factor on the variance of the fixes, as the heads of the files hold them."""
    heads = r.estimates.heads
    if not heads:
        return "<p>No file begins with the filter\u2019s state: q, qb and the factor of the fixes are not recorded.</p>"
    out = []
    last = heads[-1]
    rows = []
    for name in r.points:
        if name in last.points:
            cells = [" / ".join(f"{v:.2g}" for v in values.tolist()) for values in last.points[name]]
            rows.append([escape(name), *cells])
    head = ["point", "q x / y / z [m\u00b2/s\u00b3]", "qb [m\u00b2/s\u2075]", "factor on the variance of the fixes"]
    n = len(heads)
    which = "the only file" if n == 1 else f"the last of {n} files"
    out.append(f"<h3>Noise at the head of {which}, {utc(last.utc_ns)} UTC</h3>" + table(head, rows))
    if n >= 3:
        t = np.array([h.utc_ns for h in heads])
        for name in r.points:
            for k, (what, unit) in enumerate(
                (("q", "m\u00b2/s\u00b3"), ("qb", "m\u00b2/s\u2075"), ("factor", "ratio"))
            ):
                values = np.array([h.points[name][k] if name in h.points else np.full(3, math.nan) for h in heads])
                y = np.log10(np.maximum(values, 1e-30))
                if not np.isfinite(y).any():
                    continue
                plot = Plot(period(r), Scale(*limits(y, room=0.2), unit, log=True), 110, 4)
                for axis, colour in enumerate(COLOURS):
                    plot.line(t, y[:, axis], colour, AXES[axis])
                    plot.bars(t, y[:, axis], y[:, axis], colour, "")
                out.append(plot.html(f"{name}: {what} at the heads of the files"))
        out = [out[0], f'<div class="grid3">{"".join(out[1:])}</div>']
    return "".join(out)


def clocks(r: Review) -> str:
    """The host against UTC, devices against their nominal rate, latency of receivers, offset between sensors."""
    rows, out = [], []
    for k, clock in enumerate(r.estimates.clocks.values()):
        rate = clock.rate_ppm()
        ticks = f"{percent(clock.synchronised / clock.ticks)} of {clock.ticks} ticks synchronised"
        error = f"{1e3 * clock.error_s:.3g} ms" if clock.error_s < 1 else f"{clock.error_s:.3g} s"
        admitted = f", error admitted up to {error}" if clock.error_s > 0 else ""
        value = f"{rate:+.3f} ppm".replace("-", "\u2212") if math.isfinite(rate) else "less than a minute of ticks"
        rows.append([f"host, run {k + 1}", value, "UTC against the monotonic clock", ticks + admitted])
    for name, track in r.estimates.rates.items():
        t, hz = track.columns()
        told = [h.rates[name] for h in r.estimates.heads if name in h.rates]
        nominal = r.config.accelerometers[name].rate_hz if name in r.config.accelerometers else None
        mean = float(hz.mean())
        value = f"{number(mean, 5)} Hz"
        if nominal:
            value += f", {1e6 * (mean / nominal - 1):+.1f} ppm".replace("-", "\u2212")
        note = f"{1e6 * told[-1]:+.1f} ppm in the state of the last file".replace("-", "\u2212") if told else ""
        rows.append([escape(name), value, "rate of its samples, fitted to their arrivals", note])
        if len(t) >= 3:
            ppm = 1e6 * (hz[:, 0] / (nominal or mean) - 1.0)
            plot = Plot(period(r), Scale(*limits(ppm, np.array([-0.1, 0.1]), room=0.2), "ppm"), 110, 4)
            plot.bars(t, ppm, ppm, BLUE, f"median of each {length(bin_s(track))}", big=len(t) < 60)
            out.append(plot.html(f"{name}: rate against {'the nominal' if nominal else 'its mean'}"))
    for name in r.overview.accelerometers:
        if name not in r.estimates.rates and r.overview.accelerometers[name].stream.samples:
            rows.append([escape(name), "not fitted", "its samples keep the times of their arrival", ""])
    for name, x in r.overview.receivers.items():
        if not x.stream.samples:
            continue
        rows += _latency(r, name)
    for name, p in r.points.items():
        a = p.agreement
        if a is not None and a.offset.observable:
            o = a.offset
            value = f"{1e3 * o.value_s:+.1f} \u00b1 {1e3 * o.std_s:.1f} ms".replace("-", "\u2212")
            set_it = "nothing to set: it is within its sd, or below what latencies are known to"
            if abs(o.value_s) > max(3 * o.std_s, CLOCK_S):
                set_it = "the clocks differ: <code>edge-agent tune</code> tells whether a latency mends it"
            what = "estimated by the motion itself: to be added to the accelerometer\u2019s time"
            rows.append([escape(name), value, what, set_it])
        elif a is not None:
            rows.append(
                [escape(name), "not observable", "offset between receiver and accelerometer", escape(a.offset.why)]
            )
    for k, clock in enumerate(r.estimates.clocks.values()):
        t, ms = clock.offset_ms.columns()
        if len(t) >= 3 and t[-1] - t[0] >= 60 * S:
            plot = Plot(period(r), Scale(*limits(ms, np.array([-0.01, 0.01])), "ms"), 110, 4)
            plot.line(t, ms[:, 0], BLUE, "UTC less the monotonic clock, from 0 at its first tick", 5.0 * _usual(t))
            out.append(plot.html(f"host clock, run {k + 1}"))
    if not rows:
        return "<p>No clock is recorded in these files.</p>"
    text = (
        "A host clock that is disciplined is steered to UTC: its slope is then that of the steering. Mounting angles "
        "stand under \u201cDo the sensors agree?\u201d."
    )
    return (
        table(["clock", "value", "what", "to set"], rows)
        + f'<div class="grid3">{"".join(out)}</div><p class="small">{text}</p>'
    )


def _latency(r: Review, name: str) -> list[list[str]]:
    """What was taken for the latency of a receiver's fixes before there was an estimate, what it was by the host's
    clock, and what to set."""
    rows = []
    heads = [h.latencies[name] for h in r.estimates.heads if name in h.latencies]
    ticks = sum(c.ticks for c in r.estimates.clocks.values())
    known = ticks > 0 and sum(c.synchronised for c in r.estimates.clocks.values()) > 0.5 * ticks
    how = heads[-1][1] if heads else ""
    latency = r.latency[name]
    if heads:
        first = "at the head of the only file" if len(r.estimates.heads) == 1 else "at the head of the last file"
        unused = known and latency.n and how == "assumed"
        note = "replaced as soon as the host\u2019s clock told it, see below" if unused else ""
        rows.append([escape(name), f"{how} {1e3 * heads[-1][0]:.0f} ms", f"latency of its fixes, {first}", note])
    if not latency.n:
        return rows
    mean, sd = 1e3 * float(latency.mean[0]), 1e3 * float(latency.std[0])
    if how == "configured":
        told, note = "as configured, with the jitter of the arrivals", ""
    elif known:
        told = "estimated by the host\u2019s synchronised clock, mean and sd of one fix"
        note = (
            f"for hours without a synchronised clock set <code>receivers.{escape(name)}.latency_ms: {mean:.0f}</code>"
        )
    else:
        told = f"{how or 'assumed'}, with the jitter of the arrivals: no synchronised clock measured it"
        note = f"set <code>receivers.{escape(name)}.latency_ms</code> to what the receiver\u2019s handbook says"
    rows.append([escape(name), f"{mean:.0f} \u00b1 {sd:.0f} ms", f"latency of its fixes in these files: {told}", note])
    return rows


def _usual(t: I64) -> float:
    return float(np.median(np.diff(t)))


__all__ = ["clocks", "headings", "honest_words", "honesty", "noise"]
