"""The panels of the report: each is a pure function from what was gathered to a piece of HTML, "" = nothing to tell.

A new panel is a function and a row in `report.PANELS`. Numbers come from `figures.as_json` where both tell the same.
"""

from __future__ import annotations

import math
from html import escape

import numpy as np

from edge_agent.messages import F64, VALID_MODES, AccelFlag, Mode, Quality, S, Verdict
from edge_agent.review.agree import CLOCK_S, Agreement
from edge_agent.review.charts import (
    BLUE,
    GREEN,
    GREY,
    MODE_COLOURS,
    ORANGE,
    PURPLE,
    QUALITY_COLOURS,
    RED,
    Plot,
    Scale,
    length,
    limits,
    table,
    time_scale,
    utc,
)
from edge_agent.review.gather import Extreme, PointFigures, Review, gaps_of, modes_of
from edge_agent.review.series import Envelope, Stream
from edge_agent.review.sources import differences

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
    "SAMPLES_LOST", "COUNTER_RESET", "COARSE_GGA", "NO_SEPARATION", "PORT_LOST", "PORT_OPEN", "SILENT", "GARBAGE",
)  # fmt: skip


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


def break_of(e: Envelope, usual_ns: float) -> float:
    """Spans of an envelope further apart than this have a gap between them."""
    return max(1.5 * e.span_ns, 3.5 * usual_ns + e.span_ns)


def period(r: Review) -> Scale:
    return time_scale(r.begin_ns, r.end_ns)


# -------------------------------------------------------------------------------------------------------- availability


def availability(r: Review) -> str:
    """When each stream was there, in which mode or quality, and why not."""
    out = []
    for name, p in r.points.items():
        plot = Plot(period(r), Scale(0, 1, ""), 34)
        rows = [
            (float(a), float(b), MODE_COLOURS[Mode(m).name], f"{Mode(m).name} {utc(a)} {length((b - a) / S)}")
            for a, b, m in p.spells
        ]
        plot.spans(rows)
        for m in sorted({m for _, _, m in p.spells}):
            plot.legend.append((MODE_COLOURS[Mode(m).name], "box", Mode(m).name.lower().replace("_", " ")))
        out.append(plot.html(f"{name}: mode of the estimate", values=False))
    for name, receiver in r.overview.receivers.items():
        if not receiver.stream.samples:
            continue
        plot = Plot(period(r), Scale(0, 1, ""), 34)
        plot.spans(
            [
                (float(a), float(b), _quality_colour(q), f"{quality_name(q)} {utc(a)} {length((b - a) / S)}")
                for a, b, q in receiver.spells
            ]
        )
        for q in sorted({q for _, _, q in receiver.spells}):
            plot.legend.append((_quality_colour(q), "box", quality_name(q).lower()))
        out.append(plot.html(f"{name}: fix quality", values=False))
    for name, sensor in r.overview.accelerometers.items():
        if not sensor.stream.samples:
            continue
        plot = Plot(period(r), Scale(0, 1, ""), 34)
        plot.spans([(float(a), float(b), BLUE, "accelerations") for a, b in _covered(sensor.stream)])
        plot.legend.append((BLUE, "box", "samples"))
        out.append(plot.html(f"{name}: accelerations", values=False))
    gaps = [(g.begin_ns, g.end_ns, "raw data, " + g.source, g.reason, g.text) for g in r.verdict.gaps]
    for name, p in r.points.items():
        for a, b, why in absent(r, p):
            gaps.append((a, b, f"displacement, {name}", why, "no valid estimate"))
    for kind, streams in (("fixes", r.overview.receivers), ("accelerations", r.overview.accelerometers)):
        for name, s in streams.items():
            gaps += [(a, b, f"{kind}, {name}", why.lower().replace("_", " "), "") for a, b, why in gaps_of(r, s.stream)]
    gaps.sort()
    longest = sorted(gaps, key=lambda g: g[0] - g[1])[:LISTED]
    rows_html = [
        [utc(a, 1), length((b - a) / S), escape(what), escape(why), escape(text)]
        for a, b, what, why, text in sorted(longest)
    ]
    if rows_html:
        more = f", the {LISTED} longest of {len(gaps)}" if len(gaps) > LISTED else ""
        out.append(f"<h3>Gaps and their reasons{more}</h3>")
        out.append(table(["begin [UTC]", "length", "what is missing", "reason", ""], rows_html))
    else:
        out.append("<p>No gap: every stream was there all the time.</p>")
    return "".join(out)


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
        rows.append(
            [
                escape(name),
                f"{x.stream.samples}",
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
        t, lo, hi, _ = x.latency.spans()
        if len(t) and np.isfinite(lo).any():
            plot = Plot(frame, Scale(*limits(1e3 * lo, 1e3 * hi), "ms"), 110)
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
        "fixes",
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
    for name, p in r.points.items():
        point = r.overview.points[name]
        t, low, high, _ = point.displacement.spans()
        _, _, sd, _ = point.std.spans()
        if not len(t) or not p.moments.n:
            out.append(f"<p>{escape(name)}: no valid displacement in these files.</p>")
            continue
        far = break_of(point.displacement, p.valid.usual_ns)
        position = r.overview.receivers.get(p.receiver)
        for axis in range(3):
            d0, d1 = MM * low[:, axis], MM * high[:, axis]
            band = 2 * MM * (sd[:, axis] if len(sd) == len(t) else np.full(len(t), math.nan))
            shown = [d0 - band, d1 + band, d0, d1]
            beyond = 0
            if position is not None and position.stream.samples:
                tz, z0, z1, _ = position.position.spans()
                z0, z1 = MM * z0[:, axis], MM * z1[:, axis]
                fine = np.isfinite(z0) & np.isfinite(z1) & (tz >= t[0]) & (tz <= t[-1])
                if fine.sum() > 8:  # what most fixes span beside the estimate, not the wrong ones
                    shown += [np.quantile(z0[fine], (0.02, 0.98)), np.quantile(z1[fine], (0.02, 0.98))]
            y0, y1 = limits(*shown)
            plot = Plot(period(r), Scale(y0, y1, "mm"), 200)
            if position is not None and position.stream.samples:
                beyond = int(((z0 < y0) | (z1 > y1)).sum())
                plot.bars(tz, z0, z1, "#a9a9a9", "raw GNSS" + (f" ({beyond} spans reach beyond)" if beyond else ""))
            plot.area(t, d0 - band, d1 + band, far, BLUE, "\u00b1 2 sd", 0.22)
            plot.area(t, d0, d1, far, BLUE, "live, fused")
            ts, s0, s1, _ = p.smoothed.spans()
            if len(ts):
                plot.area(
                    ts, MM * s0[:, axis], MM * s1[:, axis], break_of(p.smoothed, p.valid.usual_ns), RED, "smoothed", 0.8
                )
            out.append(plot.html(f"{name} {AXES[axis]}: displacement"))
        span = point.displacement.span_ns / S
        note = (
            f"Each span of {length(span)} is drawn from its least to its largest value."
            if span > 2 * p.valid.usual_ns / S
            else "Every sample is drawn."
        )
        out.append(f'<p class="small">{note} Drag over a plot to zoom, double-click or \u201call\u201d to go back.</p>')
    return "".join(out)


def _extreme(e: Extreme | None) -> str:
    return "\u2013" if e is None else f"{mm(e.value_m)} \u00b1 {mm(e.std_m)}<br><small>{utc(e.utc_ns, 1)}</small>"


def extremes(r: Review) -> str:
    """Least and largest displacement with sd and time, and a close look at the furthest."""
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
            title = f"{name} {AXES[c.axis]}: around its furthest displacement, {utc(int(c.utc_ns[0]))[:10]}"
            out.append(plot.html(title))
    if not rows:
        return ""
    head = [
        "point", "axis", "least [mm]", "largest [mm]", "range [mm]", "mean [mm]", "rms about mean [mm]",
        "sd live [mm]", "sd smoothed [mm]",
    ]  # fmt: skip
    return table(head, rows, 7) + f'<div class="grid3">{"".join(out)}</div>'


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
        t, _, high, _ = point.ratio.spans()
        if len(t):
            y = np.log10(np.maximum(high[:, 0], 1e-3))
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
                plot.bars(t, a, b, GREY, "fix less prediction")
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


def events(r: Review) -> str:
    """Jumps, datum events, triggers, clips and whatever else was told, in the order of time."""
    told = [h for h in r.overview.happened if h.kind not in ("SAMPLES_LOST", "LOSS")]
    if not told and not r.overview.kinds:
        return "<p>Nothing happened that the agent would have told.</p>"
    counts = ", ".join(f"{escape(k)} {n}" for k, n in sorted(r.overview.kinds.items(), key=lambda i: -i[1]))
    first = sorted(told, key=lambda h: (h.kind not in BAD_EVENTS and "TRIGGER" not in h.kind, h.begin_ns))[:LISTED]
    rows = [
        [
            utc(h.begin_ns, 1),
            length((h.end_ns - h.begin_ns) / S) if h.end_ns > h.begin_ns else "",
            escape(h.kind),
            escape(h.source),
            escape(h.text),
            escape(", ".join(f"{k} {v:.4g}" for k, v in list(h.values.items())[:4])),
        ]
        for h in sorted(first, key=lambda h: h.begin_ns)
    ]
    more = f" ({len(told)} in all, the JSON twin lists them)" if len(told) > LISTED else ""
    plot = Plot(period(r), Scale(0, 1, ""), 34)
    for h in first:
        bad = h.fault or h.kind in BAD_EVENTS
        colour = PURPLE if "TRIGGER" in h.kind or h.kind == "CLIP" else RED if bad else GREY
        plot.spans([(float(h.begin_ns), float(max(h.end_ns, h.begin_ns)), colour, f"{h.kind} {h.source}: {h.text}")])
    plot.legend = [(RED, "box", "trouble"), (PURPLE, "box", "trigger, clip"), (GREY, "box", "other")]
    head = ["UTC", "length", "event", "source", "", "values"]
    return f"<p>{counts}{more}</p>" + plot.html("events", values=False) + table(head, rows)


def losses(r: Review) -> str:
    """What was lost where, what was refused, and how the chain of files holds."""
    lost: dict[tuple[str, str], int] = {}
    for f in r.verdict.files:
        for source, where, count, _, _ in f.losses:
            lost[source, where] = lost.get((source, where), 0) + count
    samples: dict[str, int] = {}
    for h in r.overview.happened:
        if h.kind == "SAMPLES_LOST":
            n = next(iter(h.values.values()), 1.0)
            samples[h.source] = samples.get(h.source, 0) + int(n)
    rows = [[escape(s), escape(w), str(n), "told by the agent"] for (s, w), n in sorted(lost.items())]
    rows += [[escape(s), "before the bus", str(n), "by the sample counter"] for s, n in sorted(samples.items())]
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
            rows.append([escape(name), "0", "\u2013", "\u2013", "no sample in these files", ""])
            continue
        flags = ", ".join(
            f"{AccelFlag(v).name.lower().replace('_', ' ')} {n}"  # type: ignore[union-attr]
            for v, n in sorted(a.flags.items())
            if v != AccelFlag.FITTED
        )
        seen = ", ".join(f"{k} {n}" for (source, k), n in sorted(watched.items()) if source == name)
        rows.append(
            [
                escape(name),
                str(s.samples),
                number(S * (s.samples - 1) / max(s.covered_ns, 1), 2),
                f"{len(s.silences) + s.more}",
                flags or "none",
                escape(seen) or "nothing",
            ]
        )
        t, low, high, _ = a.xyz.spans()
        mean = np.nanmean((low + high) / 2, axis=0)
        low, high = low - mean, high - mean
        plot = Plot(period(r), Scale(*limits(low, high), "m/s\u00b2"), 150)
        for axis, colour in enumerate((BLUE, ORANGE, GREEN)):
            shown = 0.75 if axis else 1.0
            plot.area(t, low[:, axis], high[:, axis], break_of(a.xyz, s.usual_ns), colour, AXES[axis], shown)
        about = " / ".join(number(float(v), 3) for v in mean)
        out.append(plot.html(f"{name}: accelerations about {about} m/s\u00b2"))
    if not rows:
        return ""
    head = ["accelerometer", "samples", "rate [Hz]", "gaps", "flagged samples", "noticed"]
    return table(head, rows) + "".join(out)


# ------------------------------------------------------------------------------------------------- what is asked closer


def offset_known(a: Agreement) -> bool:
    """Whether the offset may be told: where the sensors agree as they are, one far from zero is a chance hit."""
    o = a.offset
    return o.observable and (a.verdict == "CONTRADICTION" or abs(o.value_s) < max(CLOCK_S, 3 * o.std_s))


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
