"""The panels of the report: each is a pure function from what was gathered to a piece of HTML, "" = nothing to tell.

A new panel is a function and a row in `report.PANELS`. Numbers come from `figures.as_json` where both tell the same.
"""

from __future__ import annotations

import math
from html import escape

import numpy as np

from edge_agent.messages import F64, I64, VALID_MODES, AccelFlag, FusionFlag, Mode, Quality, S, Verdict
from edge_agent.review.charts import (
    BLUE,
    DARK,
    GREEN,
    GREY,
    INK,
    MODE_COLOURS,
    ORANGE,
    PURPLE,
    QUALITY_COLOURS,
    RAW,
    RED,
    Lane,
    Plot,
    Scale,
    length,
    limits,
    spread,
    table,
    time_scale,
    utc,
)
from edge_agent.review.estimates import Track
from edge_agent.review.gather import Extreme, PointFigures, Review, gaps_of, modes_of
from edge_agent.review.received import Due, Marked
from edge_agent.review.series import PIECE_S, Envelope, Stream
from edge_agent.review.sources import differences
from edge_agent.verify import Gap

MM = 1e3
AXES = "xyz"
LISTED = 60
"""Rows of a list at most; the JSON twin has more."""
TRACKED = 3
"""Parts of the record at least, for a frequency to be drawn in time."""
BAD_EVENTS = (
    "JUMP_OPEN", "JUMP_LEVEL", "DATUM", "REACQUIRE", "OUTAGE_END", "ACCEL_LOST", "ACCEL_GAP", "CONTRADICTION",
    "CLOCK_STEP", "GNSS_TIME_STEP", "DATE_CHANGED", "WEEK_ROLLOVER", "SEPARATION",
)  # fmt: skip
SENSOR_EVENTS = (
    "ACCEL_SPIKE", "ACCEL_SPIKE_END", "ACCEL_STUCK", "ACCEL_STUCK_END", "ACCEL_SILENT", "ACCEL_SILENT_END",
    "COUNTER_RESET", "COARSE_GGA", "NO_SEPARATION", "PORT_LOST", "PORT_OPEN", "SILENT", "GARBAGE",
)  # fmt: skip
FAMILIES = (
    ("fixes against the filter", RED, ("JUMP_", "DATUM", "REACQUIRE", "OUTAGE_END", "CONTRADICTION", "HEADING_JUMP")),
    ("accelerometers", ORANGE, ("ACCEL_", "SAMPLES_LOST", "COUNTER_RESET")),
    ("receivers", BLUE, ("FLOAT_", "HEADING_", "COARSE_GGA", "FINE_GGA", "SEPARATION", "NO_SEPARATION")),
    ("triggers, clips", PURPLE, ("TRIGGER", "CLIP")),
    ("clocks", INK, ("CLOCK_STEP", "GNSS_TIME_STEP", "DATE_CHANGED", "WEEK_ROLLOVER")),
    ("state of the filter", GREEN, ("START", "MODE", "REFERENCE", "ADOPTED")),
    ("refused input, ports, disk, program", DARK, (
        "REJECT", "LOSS", "PORT_", "SILENT", "GARBAGE", "BUS_OFF", "DISK_", "SPACE_SHORT", "RING_FULL", "RETENTION",
        "WRITER_", "STATE_", "STATUS_", "HOOK_FAILED", "RECOVERED", "CRASH",
    )),
)  # fmt: skip
"""Events of one colour: what they tell of, and how their kinds begin; each kind has a strip of its own."""
LANES = 40
"""Strips of events at most."""


def mm(v: float, digits: int = 1) -> str:
    return f"{MM * v:.{digits}f}".replace("-", "\u2212") if math.isfinite(v) else "\u2013"


def number(v: float, digits: int) -> str:
    if not math.isfinite(v):
        return "\u2013"
    text = f"{v:.{digits}f}"
    return text.replace("-", "\u2212") if float(text) else text.lstrip("-")


def with_sd(v: float, sd: float, digits: int) -> str:
    """v \u00b1 sd with so many digits, or as many more as show two figures of the sd; without sd the value alone."""
    if not (math.isfinite(sd) and sd > 0):
        return number(v, digits)
    digits = max(digits, min(1 - math.floor(math.log10(sd)), digits + 2))
    return f"{number(v, digits)} \u00b1 {number(sd, digits)}"


def percent(share: float) -> str:
    """A share in per cent; never rounded to a full 100 or to 0 where it is not."""
    if share >= 1 or share <= 0:
        return f"{100 * min(max(share, 0), 1):.0f} %"
    return f"{min(max(100 * share, 0.01), 99.99):.2f} %"


def bin_s(track: Track) -> float:
    """Seconds of a bin of a track whose rows are of a piece each; where a file ends it is shorter."""
    return PIECE_S * float(1 << track.folds)


def whole(track: Track) -> tuple[I64, F64]:
    """A track without bins that hold far less than the others do: the record's last seconds say little."""
    counts = np.array([n for _, _, n in track.rows], np.float64)
    t, values = track.columns()
    good = counts > 0.3 * np.median(counts) if len(counts) else np.zeros(0, np.bool_)
    return t[good], values[good]


def break_of(e: Envelope, usual_ns: float) -> float:
    """Spans of an envelope further apart than this have a gap between them."""
    return max(1.5 * e.span_ns, 3.5 * usual_ns + e.span_ns)


def period(r: Review) -> Scale:
    return time_scale(r.begin_ns, r.end_ns)


# -------------------------------------------------------------------------------------------------------- availability


def availability(r: Review) -> str:
    """What was due and what came, when each stream was there in which mode, quality and state, and why not."""
    out = [_due(r)]
    for name, p in r.points.items():
        total = sum(b - a for a, b, _ in p.spells) or 1
        lanes = []
        for m in sorted({m for _, _, m in p.spells}):
            mine = [(a, b) for a, b, k in p.spells if k == m]
            note = percent(sum(b - a for a, b in mine) / total)
            lanes.append(Lane(Mode(m).name.lower().replace("_", " "), note, MODE_COLOURS[Mode(m).name], _boxes(mine)))
        lanes += _flags(r.received.states.get(name), FusionFlag, "flag: ")
        out.append(_strips(r, f"{name}: mode and flags of the estimate", lanes))
    for name, receiver in r.overview.receivers.items():
        lanes = []
        for q in sorted({q for _, _, q in receiver.spells}):
            note = f"{receiver.qualities.get(q, 0)} epochs"
            mine = [(a, b) for a, b, k in receiver.spells if k == q]
            lanes.append(Lane(quality_name(q).lower(), note, _quality_colour(q), _boxes(mine)))
        out.append(_strips(r, f"{name}: quality of the fixes", lanes))
    for name, sensor in r.overview.accelerometers.items():
        if sensor.stream.samples:
            lanes = [Lane("samples", f"{sensor.stream.samples}", BLUE, _boxes(_covered(sensor.stream)))]
            lanes += _flags(r.received.flags.get(name), AccelFlag, "flag: ")
            out.append(_strips(r, f"{name}: samples and their flags", lanes))
    gaps = [(g.begin_ns, g.end_ns, "raw data, " + g.source, g.reason, g.text) for g in r.verdict.gaps]
    for name, p in r.points.items():
        for a, b, why in absent(r, p) if p.receiver else ():
            gaps.append((a, b, f"displacement, {name}", why, "no valid estimate"))
    for kind, streams in (("epochs", r.overview.receivers), ("accelerations", r.overview.accelerometers)):
        for name, s in streams.items():
            gaps += [(a, b, f"{kind}, {name}", why.lower().replace("_", " "), "") for a, b, why in gaps_of(r, s.stream)]
    gaps = [g for g in gaps if g[2].startswith("raw") or not _told_already(g, r.verdict.gaps)]
    longest = sorted(gaps, key=lambda g: g[0] - g[1])[:LISTED]
    rows_html = [
        [utc(a, 1), length((b - a) / S), escape(what), escape(why), escape(text)]
        for a, b, what, why, text in sorted(longest)
    ]
    if rows_html:
        more = f", the {LISTED} longest of {len(gaps)}" if len(gaps) > LISTED else ""
        out.append(f"<h3>The long gaps and their reasons{more}</h3>")
        out.append(table(["begin [UTC]", "length", "what is missing", "reason", ""], rows_html))
        out.append(f'<p class="small">{GAP} Listed: those above 1 s, and above 0.5 s of accelerometers.</p>')
    elif any(due.lost for due in (*r.received.receivers.values(), *r.received.accelerometers.values())):
        out.append(f'<p class="small">{GAP} None is longer than 1 s (accelerometers: 0.5 s).</p>')
    else:
        out.append("<p>No gap: every stream was there all the time.</p>")
    return "".join(out)


def _told_already(gap: tuple[int, int, str, str, str], raw: list[Gap]) -> bool:
    """Whether nearly all of a gap is one of the raw data of all ports."""
    begin, end = gap[:2]
    held = (min(end, g.end_ns) - max(begin, g.begin_ns) for g in raw if g.source == "all")
    return max(held, default=0) > 0.9 * (end - begin)


GAP = "A gap is a place where at least one epoch or sample is missing; all are counted in the table above."


def _due(r: Review) -> str:
    """Table of what was due, what came, what is missing and why."""
    rows = []
    for name, p in r.points.items():
        if not p.receiver:
            continue
        why: dict[str, float] = {}
        gone = absent(r, p)
        for a, b, reason in gone:
            why[reason] = why.get(reason, 0.0) + (b - a) / S
        lost = max(r.seconds - min(p.valid.covered_ns / S, r.seconds), 0.0)
        rows.append(
            [
                f"{escape(name)}: valid displacement",
                length(r.seconds),
                length(r.seconds - lost),
                f"{length(lost)} ({percent(lost / r.seconds)})" if gone else "none",
                f"{len(gone)}",
                length(max(b - a for a, b, _ in gone) / S) if gone else "\u2013",
                escape(", ".join(f"{k} {length(v)}" for k, v in sorted(why.items(), key=lambda i: -i[1]))),
            ]
        )
    for what, found in (("epochs", r.received.receivers), ("samples", r.received.accelerometers)):
        for name, due in found.items():
            rows.append([f"{escape(name)}: {what}", str(due.expected), str(due.received), *missing_cells(due)])
    absent_ones = [n for n in (*r.config.receivers, *r.config.accelerometers) if n not in _came(r)]
    rows += [[escape(name), "\u2013", "0", "all", "", "", "nothing of it is in these files"] for name in absent_ones]
    if not rows:
        return ""
    head = ["what", "expected", "received", "missing", "gaps", "longest gap", "why"]
    return table(head, rows)


def came(due: Due, what: str) -> str:
    """How much of what was due came, in words; what is missing for want of a recording apart."""
    lost, due_then = due.lost - due.unrecorded, due.expected - due.unrecorded
    text = f"{due.received} of {due_then} {what}"
    text += " due while it was recorded" if due.unrecorded else ""
    return text + (f", {lost} missing ({percent(lost / due_then)})" if lost else ", none missing")


def _came(r: Review) -> set[str]:
    return {name for found in (r.received.receivers, r.received.accelerometers) for name, d in found.items()}


def missing_cells(due: Due) -> list[str]:
    """What is missing of a stream, in how many gaps, the longest, why."""
    if not due.lost or due.longest is None:
        return ["none", "0", "\u2013", ""]
    why = sorted(due.missing.items(), key=lambda i: -i[1])
    return [
        f"{due.lost} ({percent(due.lost / due.expected)})",
        f"{due.gaps}",
        length((due.longest.end_ns - due.longest.begin_ns) / S),
        escape(", ".join(f"{k} {n}" for k, n in why) if len(why) > 1 else why[0][0]),
    ]


def _boxes(stretches: list[tuple[int, int]]) -> list[tuple[float, float, str]]:
    return [(float(a), float(b), f"{utc(a)} {length((b - a) / S)}") for a, b in stretches]


def _flags(marked: Marked | None, names: type[AccelFlag] | type[FusionFlag], before: str = "") -> list[Lane]:
    """A strip for each flag that stood."""
    if marked is None:
        return []
    colours = (ORANGE, RED, PURPLE, DARK, INK)
    kinds = [k for k in marked.kinds if marked.counts[k]]
    out = []
    for k in kinds:
        name = str(names(k).name).lower().replace("_", " ")
        note = f"{marked.counts[k]} samples"
        out.append(Lane(before + name, note, colours[marked.kinds.index(k) % len(colours)], _boxes(marked.boxes(k))))
    return out


def _strips(r: Review, title: str, lanes: list[Lane]) -> str:
    if not lanes:
        return ""
    plot = Plot(period(r), Scale(0, 1, ""))
    plot.lanes(lanes)
    return plot.html(title, values=False)


def absent(r: Review, p: PointFigures) -> list[tuple[int, int, str]]:
    """When a point had no valid estimate, and why; what is not told here adds up to less than the steps of its
    stream."""
    out = []
    for a, b, why in gaps_of(r, p.valid):
        if why == "MODE":  # which one
            why = next((Mode(m).name for c, d, m in p.spells if c < b and d > a and m not in VALID_MODES), why)
        out.append((a, b, why.lower().replace("_", " ")))
    if not p.moments.n:
        return [(r.begin_ns, r.end_ns, "never started")]
    if p.valid.begin_ns - r.begin_ns > S:
        out.insert(0, (r.begin_ns, p.valid.begin_ns, "start"))
    if r.end_ns - p.valid.end_ns > S:
        out.append((p.valid.end_ns, r.end_ns, "end"))
    return out


def quality_name(q: int) -> str:
    return next((known.name for known in Quality if known == q), str(q))


def _quality_colour(q: int) -> str:
    return QUALITY_COLOURS.get(quality_name(q), PURPLE)


def _covered(stream: Stream) -> list[tuple[int, int]]:
    """Stretches in which a stream was there."""
    edges = [stream.begin_ns]
    for a, b in sorted(stream.silences):
        edges += [a, b]
    edges.append(stream.end_ns)
    return list(zip(edges[::2], edges[1::2], strict=True))


# ----------------------------------------------------------------------------------------------------------- receivers


def receivers(r: Review) -> str:
    """Fix quality, satellites and latency."""
    out = []
    rows = []
    for name, x in r.overview.receivers.items():
        if not x.stream.samples:
            continue
        latency = r.latency[name]
        low, high = x.latency.spans()[1:3]
        shares = ", ".join(
            f"{quality_name(q).lower()} {percent(n / x.stream.samples)}"
            for q, n in sorted(x.qualities.items(), key=lambda i: -i[1])
        )
        age = x.age.spans()[2]
        due = r.received.receivers.get(name, Due())
        rows.append(
            [
                escape(name),
                f"{x.stream.samples} of {due.expected - due.unrecorded}",
                number(S / x.stream.usual_ns if x.stream.usual_ns else math.nan, 2),
                shares,
                f"{1e3 * float(latency.mean[0]):.0f} \u00b1 {1e3 * float(latency.std[0]):.0f}"
                if latency.n
                else "\u2013",
                f"{1e3 * float(np.nanmin(low)):.0f} \u2026 {1e3 * float(np.nanmax(high)):.0f}"
                if latency.n
                else "\u2013",
                number(float(np.nanmax(age)), 1) if np.isfinite(age).any() else "\u2013",
            ]
        )
        frame = period(r)
        t, share = whole(due.share)
        if due.lost and len(t) >= 2:
            came = 100 * share[:, 0]
            plot = Plot(frame, Scale(min(90.0, math.floor(0.2 * float(came.min())) * 5 - 5.0), 101.0, "%"), 90)
            text = f"epochs that came of those due, each {length(bin_s(due.share))}"
            plot.bars(t, came, came, BLUE, text, big=len(t) < 60)
            plot.level(100.0, GREEN, "all")
            out.append(plot.html(f"{name}: epochs received"))
        t, lo, hi, _ = x.latency.spans()
        if len(t) and np.isfinite(lo).any():
            plot = Plot(frame, Scale(*spread(1e3 * lo, 1e3 * hi), "ms"), 110)
            plot.bars(t, 1e3 * lo[:, 0], 1e3 * hi[:, 0], BLUE, "arrival less time of the fix")
            out.append(plot.html(f"{name}: latency"))
        t, lo, hi, _ = x.satellites.spans()
        if len(t):
            plot = Plot(frame, Scale(0.0, float(np.nanmax(hi)) + 2, "satellites"), 90)
            plot.bars(t, lo[:, 0], hi[:, 0], GREEN, "satellites in the solution")
            out.append(plot.html(f"{name}: satellites"))
    if not rows:
        return ""
    head = [
        "receiver",
        "epochs received",
        "rate [Hz]",
        "quality",
        "latency [ms]",
        "least \u2026 most [ms]",
        "oldest corrections [s]",
    ]
    return table(head, rows, 1) + "".join(out)


# -------------------------------------------------------------------------------------------------------- displacement


def displacement(r: Review) -> str:
    """Raw fixes, live fused displacement with its sd band, smoothed; per point and axis."""
    out = []
    zooms = False
    for name, p in r.points.items():
        if not p.receiver:
            out.append(f"<p>{escape(name)}: {accelerometer_only(r, p)}.</p>")
            continue
        point = r.overview.points[name]
        t, low, high, _ = point.displacement.spans()
        _, _, sd, _ = point.std.spans()
        if not len(t) or not p.moments.n:
            out.append(f"<p>{escape(name)}: no valid displacement in these files.</p>")
            continue
        far = break_of(point.displacement, p.valid.usual_ns)
        receiver = r.overview.receivers.get(p.receiver)
        sd = sd if len(sd) == len(t) else np.full(low.shape, math.nan)
        for axis in range(3):
            raw = smoothed = None
            if receiver is not None and receiver.stream.samples:
                tz, z0, z1, _ = receiver.position.spans()
                raw = tz, MM * z0[:, axis], MM * z1[:, axis]
            ts, s0, s1, _ = p.smoothed.spans()
            if len(ts):
                smoothed = ts, MM * s0[:, axis], MM * s1[:, axis], break_of(p.smoothed, p.valid.usual_ns)
            live = t, MM * low[:, axis], MM * high[:, axis], 2 * MM * sd[:, axis], far
            out.append(estimated(r, f"{name} {AXES[axis]}: displacement", "mm", 200, live, raw, smoothed))
            zooms = True
        span = point.displacement.span_ns / S
        note = (
            f"Each span of {length(span)} is drawn from its least to its largest value."
            if span > 2 * p.valid.usual_ns / S
            else "Every sample is drawn."
        )
        out.append(f'<p class="small">{escape(name)}: {note}</p>')
    if zooms:
        out.append(f'<p class="small">{ZOOMING}</p>')
    return "".join(out)


ZOOMING = (
    "The scale is that of the estimate; fixes beyond it are marked and counted at the edge. "
    '<span class="screen">Zoom: drag over a plot, pinch, or turn the wheel with Ctrl held or after a click; \u2195 '
    "shows every value, double-click or \u201call\u201d goes back. Plots over the period move together.</span>"
)

Spans = tuple[I64, F64, F64]


def estimated(
    r: Review,
    title: str,
    unit: str,
    height: int,
    live: tuple[I64, F64, F64, F64, float],
    raw: Spans | None,
    smoothed: tuple[I64, F64, F64, float] | None = None,
    texts: tuple[str, str] = ("raw GNSS", "live, fused"),
) -> str:
    """What was measured under what was made of it: live is middles, least, largest, 2 sd and the step that is a gap.

    The scale is that of the estimate and of what most measurements span beside it: a wrong fix must not flatten the
    motion."""
    t, low, high, band, far = live
    shown = [*spread(low, high), *spread(low - band, high + band, share=0.05, reach=0.5)]
    if smoothed is not None:
        shown += spread(smoothed[1], smoothed[2])
    if raw is not None:
        fine = np.isfinite(raw[1]) & np.isfinite(raw[2]) & (raw[0] >= t[0]) & (raw[0] <= t[-1])
        middle = 0.5 * (raw[1] + raw[2])[fine]
        if len(middle) > 8:  # 4 sd of their noise, from neighbours: Gaussian noise has few beyond
            noise = 1.4826 * float(np.median(np.abs(np.diff(middle)))) / math.sqrt(2.0)
            inside = middle[(middle > min(shown) - 4 * noise) & (middle < max(shown) + 4 * noise)]
            shown += [float(inside.min()), float(inside.max())] if len(inside) else []
    plot = Plot(period(r), Scale(*limits(np.array(shown), room=0.03), unit), height)
    if raw is not None:
        plot.bars(*raw, RAW, texts[0], loose=True)
    plot.area(t, low - band, high + band, far, BLUE, "\u00b1 2 sd", 0.22)
    plot.area(t, low, high, far, BLUE, texts[1])
    if smoothed is not None:
        plot.area(*smoothed, RED, "smoothed", 0.8)
    return plot.html(title)


def accelerometer_only(r: Review, p: PointFigures) -> str:
    """What there is of a point without a receiver, in words."""
    rms = r.received.rms(p.accelerometer)
    text = "accelerometer only: vibration, no displacement"
    if np.isfinite(rms).all():
        told = " / ".join(f"{1e3 * v:.3g}" for v in rms.tolist())
        text += f"; accelerations x / y / z {told} mm/s\u00b2 rms about the mean of each half minute"
    return text


def _extreme(e: Extreme | None) -> str:
    return "\u2013" if e is None else f"{mm(e.value_m)} \u00b1 {mm(e.std_m)}<br><small>{utc(e.utc_ns, 1)}</small>"


def extremes(r: Review) -> str:
    """Least and largest displacement with sd and time, and a close look at the furthest from the reference."""
    rows, out = [], []
    for name, p in r.points.items():
        if not p.moments.n:
            continue
        for axis in range(3):
            lo, hi = p.low[axis], p.high[axis]
            rows.append(
                [
                    escape(name),
                    AXES[axis],
                    _extreme(lo),
                    _extreme(hi),
                    mm(hi.value_m - lo.value_m) if lo and hi else "\u2013",
                    mm(float(p.moments.mean[axis])),
                    mm(float(p.moments.std[axis]), 2),
                    mm(float(p.std_m.mean[axis]), 2),
                    mm(float(p.smoothed_std_m.mean[axis]), 2) if p.smoothed_std_m.n else "\u2013",
                ]
            )
        for c in p.close:
            if len(c.utc_ns) < 2:
                continue
            d, sd = MM * c.displacement_m, 2 * MM * c.std_m
            plot = Plot(
                time_scale(int(c.utc_ns[0]), int(c.utc_ns[-1])), Scale(*limits(d - sd, d + sd), "mm"), 150, 4, True
            )
            far = 5.0 * float(np.median(np.diff(c.utc_ns)))
            plot.area(c.utc_ns, d - sd, d + sd, far, BLUE, "\u00b1 2 sd", 0.22)
            plot.line(c.utc_ns, d, BLUE, "live, fused, every sample", far)
            title = f"{name} {AXES[c.axis]}: around its furthest from the reference, {utc(int(c.utc_ns[0]))[:10]}"
            out.append(plot.html(title))
    if not rows:
        return ""
    head = [
        "point", "axis", "least [mm]", "largest [mm]", "peak to peak [mm]", "mean [mm]", "rms about mean [mm]",
        "sd live [mm]", "sd smoothed [mm]",
    ]  # fmt: skip
    text = (
        "Displacement counts from the reference, which is zero: least, largest and furthest are of that. Peak to peak "
        "is the largest less the least."
    )
    doubt = [escape(name) for name, p in r.points.items() if p.moments.n and p.agreement and p.agreement.in_doubt]
    if doubt:
        text += f" In doubt for {', '.join(doubt)}: receiver and accelerometer contradict each other there."
    return table(head, rows, 7) + f'<div class="grid3">{"".join(out)}</div><p class="small">{text}</p>'


# ------------------------------------------------------------------------------------------------------------- verdicts


def gate(r: Review) -> str:
    """Innovations and verdicts, whether the gate fits, jumps and datum events."""
    out, rows = [], []
    for name, p in r.points.items():
        point = r.overview.points[name]
        n = sum(point.verdicts.values())
        if not n:
            continue
        verdicts = ", ".join(
            f"{Verdict(v).name.lower()} {k} ({percent(k / n)})" for v, k in sorted(point.verdicts.items())
        )
        step = math.sqrt(16.27) * p.std_residual_m
        rows.append(
            [
                escape(name),
                verdicts,
                " / ".join(number(float(v), 2) for v in p.nis) if p.gated else "\u2013",
                " / ".join(mm(float(v)) for v in step) if p.gated else "\u2013",
            ]
        )
        marked = r.received.verdicts.get(name)
        if marked is not None:
            colours = (RED, ORANGE, PURPLE, INK, GREEN)
            near = 1.5 * r.received.receivers.get(p.receiver, Due()).interval_ns  # one epoch after the other
            lanes = [
                Lane(Verdict(v).name.lower(), f"{marked.counts[v]} fixes", colour, _boxes(marked.boxes(v, near)))
                for v, colour in zip(marked.kinds, colours, strict=True)
                if marked.counts[v]
            ]
            out.append(_strips(r, f"{name}: fixes that were not simply taken", lanes))
        t, _, high, _ = point.ratio.spans()
        if len(t):
            y = np.log10(np.maximum(high[:, 0], 1e-2))
            plot = Plot(period(r), Scale(-2.0, max(1.0, float(np.nanmax(y)) + 0.2), "ratio", log=True), 130)
            plot.bars(t, y, y, GREY, "largest of each span")
            above = high[:, 0] > 1
            if above.any():
                plot.bars(t[above], y[above], y[above], RED, "does not fit")
            plot.level(0.0, RED, "limit of the gate")
            out.append(plot.html(f"{name}: how well each fix fits (v\u2032S\u207b\u00b9v / \u03c7\u00b2)"))
        t, low, high, _ = point.residual.spans()
        if len(t):
            for axis in range(3):
                a, b = MM * low[:, axis], MM * high[:, axis]
                sd = MM * float(p.std_residual_m[axis])
                plot = Plot(period(r), Scale(*_most(a, b, sd), "mm"), 110)
                plot.bars(t, a, b, GREY, "fix less prediction", loose=True)
                if sd:
                    plot.level(2 * sd, BLUE, "\u00b1 2 sd as predicted, mean")
                    plot.level(-2 * sd, BLUE, "")
                out.append(plot.html(f"{name} {AXES[axis]}: innovations"))
    if not rows:
        return ""
    head = [
        "point", "verdicts on the fixes", "innovation\u00b2 / variance x / y / z (1 = honest)",
        "smallest step it refuses x / y / z [mm]",
    ]  # fmt: skip
    return table(head, rows, 1) + "".join(out)


def _most(a: F64, b: F64, sd: float) -> tuple[float, float]:
    """A frame for most of what is there: wrong fixes are metres off."""
    both = np.concatenate([a[np.isfinite(a)], b[np.isfinite(b)]])
    if not len(both):
        return -1.0, 1.0
    far = max(float(np.quantile(np.abs(both), 0.98)) * 1.3, 3 * sd, 1e-3)
    return -far, far


def family(kind: str) -> int:
    """Which of FAMILIES a kind of event belongs to; their number for one of none."""
    found = ((len(start), i) for i, f in enumerate(FAMILIES) for start in f[2] if kind.startswith(start))
    return max(found, default=(0, len(FAMILIES)))[1]


def events(r: Review) -> str:
    """A strip for each kind of event and fault, and the list of them in the order of time."""
    seen = r.received.events
    if not seen:
        return "<p>Nothing happened that the agent would have told.</p>"
    lanes = []
    used = set()
    for kind, source in sorted(seen, key=lambda k: (family(k[0]), k)):
        stretches, which = seen[kind, source], family(kind)
        used.add(which)
        colour = FAMILIES[which][1] if which < len(FAMILIES) else GREY
        name = f"{kind.lower().replace('_', ' ')}, {source}" if source else kind.lower().replace("_", " ")
        times = "once" if stretches.count == 1 else f"{stretches.count} times"
        lanes.append(Lane(name, times, colour, _boxes(stretches.boxes)))
    plot = Plot(period(r), Scale(0, 1, ""))
    plot.lanes(lanes[:LANES])
    plot.legend = [(f[1], "box", f[0]) for i, f in enumerate(FAMILIES) if i in used]
    if len(FAMILIES) in used:
        plot.legend.append((GREY, "box", "other"))
    told = [h for h in r.overview.happened if h.kind not in ("SAMPLES_LOST", "LOSS")]
    first = sorted(told, key=lambda h: (h.kind not in BAD_EVENTS and "TRIGGER" not in h.kind, h.begin_ns))[:LISTED]
    rows = [
        [
            utc(h.begin_ns, 1),
            length((h.end_ns - h.begin_ns) / S) if h.end_ns > h.begin_ns else "",
            escape(h.kind.lower().replace("_", " ")),
            escape(h.source),
            escape(h.text),
            escape(", ".join(f"{k} {v:.4g}" for k, v in list(h.values.items())[:4])),
        ]
        for h in sorted(first, key=lambda h: h.begin_ns)
    ]
    head = ["UTC", "length", "event", "source", "", "values"]
    listed = "Listed: all but samples lost, refused input and losses, which have sections of their own"
    if len(told) > LISTED:
        listed = f"Listed: {LISTED} of {len(told)}, trouble and triggers first; the JSON twin has more"
    more = f" The first {LANES} of {len(lanes)} kinds are drawn." if len(lanes) > LANES else ""
    shown = table(head, rows) + f'<p class="small">{listed}.{more}</p>' if rows else ""
    return plot.html("Events and faults", values=False) + shown


def losses(r: Review) -> str:
    """What was lost where, what was refused, and how the chain of files holds."""
    lost: dict[tuple[str, str], int] = {}
    for f in r.verdict.files:
        for source, where, count, _, _ in f.losses:
            lost[source, where] = lost.get((source, where), 0) + count
    rows = [[escape(s), escape(w), str(n), "told by the agent"] for (s, w), n in sorted(lost.items())]
    for what, found in (("epochs", r.received.receivers), ("samples", r.received.accelerometers)):
        how = "by their times" if what == "epochs" else "by the sample counter, else by their times"
        rows += [
            [escape(s), f"{what}: {escape(w)}", str(n), how] for s, d in found.items() for w, n in d.missing.items()
        ]
    rows += [
        [escape(s), f"refused: {escape(w)}", str(n), "input as it came"] for (s, w), n in sorted(r.rejects.items())
    ]
    if r.overview.missing:
        rows.append(["raw", "in no file", str(r.overview.missing), "by the order of the blocks"])
    out = (
        table(["source", "where", "count", "how it is known"], rows) if rows else "<p>Nothing was lost or refused.</p>"
    )
    for title, lines in (("Wrong", r.verdict.wanting), ("Notes", r.verdict.notes)):
        if lines:
            out += f"<h3>{title}</h3><ul>" + "".join(f"<li>{escape(t)}</li>" for t in lines[:LISTED]) + "</ul>"
    return out


def sensors(r: Review) -> str:
    """Rates, gaps, and what the agent noticed of each sensor."""
    rows, out = [], []
    watched: dict[tuple[str, str], int] = {}
    for h in r.overview.happened:
        if h.kind in SENSOR_EVENTS:
            watched[h.source, h.kind] = watched.get((h.source, h.kind), 0) + 1
    for name, a in r.overview.accelerometers.items():
        s = a.stream
        if not s.samples:
            rows.append([escape(name), "0", "\u2013", "\u2013", "\u2013", "\u2013", "no sample in these files", ""])
            continue
        due = r.received.accelerometers.get(name, Due())
        flags = ", ".join(
            f"{AccelFlag(v).name.lower().replace('_', ' ')} {n}"  # type: ignore[union-attr]
            for v, n in sorted(a.flags.items())
            if v not in (AccelFlag.FITTED, AccelFlag.GAP_BEFORE)
        )
        seen = ", ".join(f"{k} {n}" for (source, k), n in sorted(watched.items()) if source == name)
        rows.append(
            [
                escape(name),
                str(s.samples),
                number(S * (s.samples - 1) / max(s.covered_ns, 1), 2),
                f"{due.lost - due.unrecorded} of {due.expected - due.unrecorded}",
                f"{due.gaps}",
                " / ".join(f"{1e3 * v:.3g}" for v in r.received.rms(name).tolist()),
                flags or "none",
                escape(seen) or "nothing",
            ]
        )
        t, low, high, _ = a.xyz.spans()
        mean = np.nanmean((low + high) / 2, axis=0)
        low, high = low - mean, high - mean
        plot = Plot(period(r), Scale(*spread(low, high), "m/s\u00b2"), 150)
        for axis, colour in enumerate((BLUE, ORANGE, GREEN)):
            shown = 0.75 if axis else 1.0
            plot.area(t, low[:, axis], high[:, axis], break_of(a.xyz, s.usual_ns), colour, AXES[axis], shown)
        about = " / ".join(number(float(v), 3) for v in mean)
        out.append(plot.html(f"{name}: accelerations about {about} m/s\u00b2"))
        shaking = r.received.shaking.get(name, Track())
        width = bin_s(shaking)
        t, square = whole(shaking)
        if len(t) >= 3:
            rms = 1e3 * np.sqrt(square)
            plot = Plot(period(r), Scale(*spread(rms, np.zeros(1)), "mm/s\u00b2"), 110)
            for axis, colour in enumerate((BLUE, ORANGE, GREEN)):
                plot.line(t, rms[:, axis], colour, AXES[axis], 3.5 * width * S)
                plot.bars(t, rms[:, axis], rms[:, axis], colour, "", big=len(t) < 60)
            out.append(plot.html(f"{name}: rms of the accelerations about their mean, each {length(width)}"))
    if not rows:
        return ""
    head = [
        "accelerometer", "samples", "rate [Hz]", "missing", "gaps", "rms x / y / z [mm/s\u00b2]", "flagged samples",
        "noticed",
    ]  # fmt: skip
    return table(head, rows) + "".join(out)


# ------------------------------------------------------------------------------------------------- what is asked closer


# ------------------------------------------------------------------------------------------------------ place, settings


def place(r: Review) -> str:
    """Where it stands: a dot on a graticule, coordinates to copy, and the structure's axes."""
    if not r.places:
        return ""
    lines = "".join(f'<path d="M{x} 0V180" class="{"m" if x == 180 else ""}"/>' for x in range(0, 361, 30))
    lines += "".join(f'<path d="M0 {y}H360" class="{"m" if y == 90 else ""}"/>' for y in range(0, 181, 30))
    dots, rows = "", []
    for name, (lat, lon, h) in r.places.items():
        dots += f'<circle cx="{lon + 180:.2f}" cy="{90 - lat:.2f}" r="4"/>'
        rows.append(
            [
                escape(name),
                f"{lat:.7f}",
                f"{lon:.7f}",
                f"{h:.2f}",
                f'<a href="geo:{lat:.7f},{lon:.7f}">geo:{lat:.5f},{lon:.5f}</a>',
            ]
        )
    azimuth = r.config.structure.azimuth_deg
    angle = math.radians(azimuth)
    x, y = 50 + 36 * math.sin(angle), 50 - 36 * math.cos(angle)
    u, v = 50 - 28 * math.cos(angle), 50 - 28 * math.sin(angle)
    compass = (
        '<svg viewBox="0 0 100 100" class="compass" role="img" aria-label="axes"><circle cx="50" cy="50" r="40"/>'
        f'<text x="50" y="9">N</text><path d="M50 50L{x:.1f} {y:.1f}"/><text x="{x:.1f}" y="{y + 3:.1f}">x</text>'
        f'<path d="M50 50L{u:.1f} {v:.1f}"/><text x="{u:.1f}" y="{v + 3:.1f}">y</text></svg>'
    )
    world = (
        f'<svg viewBox="0 0 360 180" class="world" role="img" aria-label="position">{lines}{dots}'
        '<text x="184" y="10">0\u00b0</text><text x="2" y="87">equator</text></svg>'
    )
    head = ["receiver", "latitude [deg]", "longitude [deg]", "height [m]", "open in a map"]
    text = f"x points {azimuth:g}\u00b0 clockwise from true north, y 90\u00b0 left of it, z up."
    return f'{table(head, rows)}<div class="places">{world}{compass}</div><p class="small">{text}</p>'


def settings(r: Review) -> str:
    """The configurations as they are attached to the files, and what differs between them."""
    out = []
    found = r.setups
    if len(found) > 1:
        head = ["setting", *(f"configuration {k + 1}" for k in range(min(len(found), 6)))]
        told = [[escape(name), *(escape(v) or "\u2013" for v in values[:6])] for name, values in differences(found)]
        whose = [
            [str(k + 1), str(len(s.files)), escape(", ".join(p.name for p in s.files[:LISTED]))]
            for k, s in enumerate(found)
        ]
        out.append(f"<p>These files were made with {len(found)} different configurations.</p>")
        out.append(table(["configuration", "files", "which"], whose))
        out.append("<h3>What differs</h3>" + table(head, told))
    for k, s in enumerate(found[:3]):
        title = "config.yaml" if len(found) == 1 else f"config.yaml, configuration {k + 1}"
        shown = " open" if k == 0 else ""
        out.append(f"<details{shown}><summary>{title}</summary><pre>{escape(s.text)}</pre></details>")
    return "".join(out)


def files(r: Review) -> str:
    """Every file with its state; damaged ones first."""
    rows = []
    for path, why in sorted(r.damaged.items()):
        rows.append([escape(path.name), '<b class="bad">damaged</b>', escape(why), "", ""])
    for f in r.verdict.files:
        if f.path not in r.damaged:
            state = "open: being written, or torn" if f.path in r.open_files else f.state
            rows.append(
                [escape(f.path.name), state, utc(f.begin_ns) if f.messages else "", length((f.end_ns - f.begin_ns) / S),
                 f"{f.size / 1e6:.2f}"]
            )  # fmt: skip
    for copy, home in sorted(r.copies.items()):
        if copy not in r.damaged:
            rows.append([escape(copy.name), "a copy: counted once", f"all of it is in {escape(home.name)}", "", ""])
    shown = rows[:200]
    more = f"<p>{len(rows) - len(shown)} more; the JSON twin lists them.</p>" if len(rows) > len(shown) else ""
    return table(["file", "state", "begin [UTC], or what is wrong", "length", "size [MB]"], shown, 1) + more


__all__ = ["mm", "modes_of", "number", "percent"]
