"""The panels of what rings: spectra with the frequencies that stand out and their track, modes of all accelerometers
together, wavelets. Each is a pure function as in `panels`."""

from __future__ import annotations

import math
from html import escape

import numpy as np

from edge_agent.messages import F64, I64
from edge_agent.review import modal, spectra
from edge_agent.review.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RAW,
    RED,
    Plot,
    Scale,
    length,
    limits,
    shade_colour,
    table,
    time_scale,
    utc,
)
from edge_agent.review.gather import PEAK_DB, PointFigures, Review
from edge_agent.review.panels import AXES, MM, mm, number, percent, period, with_sd
from edge_agent.review.spectra import BOTTOM_DB

TRACKED = 3
"""Parts of the record at least, for a frequency to be drawn in time."""
RANGE_DB = 30.0
"""Power in a scalogram from its largest down to nothing."""


def frequencies(r: Review) -> str:
    """Spectra of accelerations, fused and raw displacement, with the frequencies that stand out."""
    out = []
    for name, p in r.points.items():
        rows = [
            [
                with_sd(f.freq_hz, f.std_hz, 3),
                f"{100 * f.damping:.2f} \u00b1 {100 * f.std_damping:.2f}" if math.isfinite(f.damping) else "\u2013",
                f.axes,
                number(f.above_db, 0),
                _peak(f.freq_hz, f.fused_hz, p.fused_spectrum),
                _peak(f.freq_hz, f.gnss_hz, p.gnss_spectrum),
            ]
            for f in p.frequencies
        ]
        if rows:
            head = [
                "accelerations [Hz]", "damping [%]", "axes", "above floor [dB]", "fused displacement [Hz]",
                "accepted fixes [Hz]",
            ]  # fmt: skip
            out.append(f"<h3>{escape(name)}</h3>" + table(head, rows))
        elif p.accel_spectrum is not None:
            out.append(f"<h3>{escape(name)}</h3><p>No frequency stands out of the accelerations' floor.</p>")
        if p.accel_spectrum is not None:
            s = p.accel_spectrum
            out.append(_density(f"{name}: accelerations", "(m/s\u00b2)\u00b2/Hz", [(s, "", "")], p))
        parts = [
            (s, c, t) for s, c, t in ((p.gnss_spectrum, GREY, "accepted fixes"), (p.fused_spectrum, BLUE, "fused")) if s
        ]
        for axis in range(3):
            if parts:
                out.append(_density(f"{name} {AXES[axis]}: displacement", "mm\u00b2/Hz", parts, p, axis))
        out.append(_tracks(r, name, p))
        used = [s for s in (p.accel_spectrum, p.fused_spectrum, p.gnss_spectrum) if s is not None]
        if used:
            each = [(p.accel_spectrum, "accelerations"), (p.fused_spectrum, "fused"), (p.gnss_spectrum, "fixes")]
            text = ", ".join(
                f"{what} {s.segments} segments of {length(1 / float(s.freq_hz[1]))}"
                for s, what in each
                if s is not None
            )
            out.append(
                f'<p class="small">Welch\u2019s densities, Hann window, over the whole record ({text}); shaded: 95 % '
                "confidence. Fixes: those that the gate took, without what it refused or used less a level, and not "
                f"those of a start. A frequency is told where the accelerations stand {PEAK_DB:.0f} dB "
                "above their floor and rise clearly from the valleys beside: the skirt of another peak is none; its sd "
                "and damping are of the liveliest minutes. Beside it stands the nearest peak of the displacements, on "
                f"any axis, {BOTTOM_DB:.0f} dB above their floor and within 3 % or 1.5 lines; \u201cno peak\u201d: "
                "there is none, \u201ctoo fast\u201d: beyond what their rate shows, \u2013: no spectrum, for no "
                "segment was whole.</p>"
            )
    return "".join(out)


def _peak(freq_hz: float, found_hz: float, s: spectra.Spectrum | None) -> str:
    """The peak of a displacement beside a frequency of the accelerations, or why there is none."""
    if s is None:
        return "\u2013"
    if math.isfinite(found_hz):
        return number(found_hz, 3)
    return "no peak" if freq_hz < 0.9 * float(s.freq_hz[-1]) else "too fast"


def _tracks(r: Review, name: str, p: PointFigures) -> str:
    """Each frequency in time with its sd."""
    times, tracked, std = p.track
    if not p.frequencies or not len(times):
        return ""
    if len(times) < TRACKED:
        return f'<p class="small">{escape(name)}: the record is too short to follow its frequencies in time.</p>'
    out = []
    half = 0.5 * float(np.median(np.diff(times)))
    for i, f in enumerate(p.frequencies):
        y, sd = tracked[:, i], std[:, i]
        good = np.isfinite(y)
        if good.sum() < TRACKED:
            continue
        plot = Plot(period(r), Scale(*limits(y - 2 * sd, y + 2 * sd, room=0.15), "Hz"), 100, 4)
        plot.bars(times, y - 2 * sd, y + 2 * sd, BLUE, "\u00b1 2 sd", opacity=0.35)
        plot.bars(times, y, y, BLUE, f"in each {length(2 * half / 1e9)}", big=len(times) < 60)
        mean = float(np.average(y[good], weights=1.0 / sd[good] ** 2))
        plot.level(mean, GREY, f"mean {number(mean, 4)} Hz")
        out.append(plot.html(f"{name}: {number(f.freq_hz, 3)} Hz in time"))
    return f'<div class="grid3">{"".join(out)}</div>'


def _density(
    title: str,
    unit: str,
    parts: list[tuple[spectra.Spectrum, str, str]],
    p: PointFigures,
    axis: int | None = None,
) -> str:
    top = max(float(s.freq_hz[-1]) for s, _, _ in parts)
    low = min(float(s.freq_hz[2]) for s, _, _ in parts)
    curves: list[tuple[F64, F64, F64, F64, str, str]] = []
    for s, colour, text in parts:
        keep = s.freq_hz >= low
        scale = 1.0 if axis is None else MM * MM
        for i in range(3) if axis is None else (axis,):
            f = np.log10(s.freq_hz[keep])
            each = [np.log10(np.maximum(v[keep, i] * scale, 1e-18)) for v in (s.psd, s.low, s.high)]
            paint = (BLUE, ORANGE, GREEN)[i] if axis is None else colour
            curves.append((*_thinned(f, *each), paint, AXES[i] if axis is None else text))
    y = np.concatenate([c[1] for c in curves])
    plot = Plot(
        Scale(math.log10(low), math.log10(top), "frequency [Hz]", log=True),
        Scale(float(y.min()) - 0.3, float(y.max()) + 0.4, unit, log=True),
        200,
    )
    for f, c, a, b, paint, text in curves:
        plot.area(f, a, b, math.inf, paint, "", 0.15)
        plot.line(f, c, paint, text)
    for mode in p.frequencies:
        if low < mode.freq_hz < top:
            plot.mark(math.log10(mode.freq_hz), PURPLE, f"{mode.freq_hz:.3f} Hz")
    if p.frequencies:
        plot.legend.append((PURPLE, "line", "frequencies of the table"))
    return plot.html(title)


def _thinned(f: F64, y: F64, low: F64, high: F64, most: int = 900) -> tuple[F64, F64, F64, F64]:
    """Fewer lines where they lie closer than a pixel, the highest of each bin: peaks stay."""
    if len(f) <= most:
        return f, y, low, high
    cell = np.floor((f - f[0]) / (f[-1] - f[0]) * most).astype(np.int64)
    starts = np.flatnonzero(np.diff(cell, prepend=-1))
    at = np.array([a + int(np.argmax(y[a:b])) for a, b in zip(starts, [*starts[1:], len(f)], strict=True)])
    return f[at], y[at], low[at], high[at]


# ----------------------------------------------------------------------------------------- modes of the whole structure


def modes(r: Review) -> str:
    """Modes of all accelerometers together: singular values, stabilisation, table."""
    m = r.modal
    if m is None:
        what = (
            "no accelerometer is among the sensors"
            if not r.config.accelerometers
            else "less than a minute in which all accelerometers were there"
        )
        return f"<p>Not identified: {what}.</p>"
    if m.why:
        return f"<p>Not identified: {escape(m.why)}. The fits of single channels above stand alone.</p>"
    rows = []
    for b in m.bands:
        for k in b.modes:
            shape = ", ".join(
                f"{escape(n)} {number(float(v.real), 2)}"
                for n, v in zip(b.names, k.shape, strict=True)
                if abs(v) >= 0.05
            )
            rows.append(
                [
                    with_sd(k.freq_hz, k.std_freq_hz, 3),
                    f"{number(100 * k.damping, 2)} \u00b1 {number(100 * k.std_damping, 2)}",
                    number(k.fdd_hz, 3),
                    f"{100 * k.share:.0f} %",
                    number(modal.in_phase(k.shape), 2),
                    shape,
                ]
            )
    out = []
    if rows:
        head = ["frequency [Hz]", "damping [%]", "singular values [Hz]", "orders that show it", "in phase", "shape"]
        out.append(table(head, rows))
    else:
        out.append("<p>No pole stands still over the orders: nothing is told of modes.</p>")
    for b in m.bands:
        top = 0.5 * b.rate_hz
        keep = (b.freq_hz > 0) & (b.freq_hz <= top)
        f = b.freq_hz[keep]
        y = np.log10(np.maximum(b.singular[keep], 1e-18))
        scale = Scale(0.0, top, "frequency [Hz]")
        plot = Plot(scale, Scale(float(y.min()) - 0.2, float(y.max()) + 0.3, "(m/s\u00b2)\u00b2/Hz", log=True), 170)
        for i, (colour, text) in reversed(list(enumerate(((BLUE, "first"), (ORANGE, "second"), (GREY, "third"))))):
            if i < y.shape[1]:
                plot.line(f, y[:, i], colour, text)
        for k in b.modes:
            plot.mark(k.freq_hz, PURPLE, f"{k.freq_hz:.3f} Hz")
        plot.legend.append((PURPLE, "line", "modes of the table"))
        out.append(plot.html(f"Singular values of {len(m.names)} channels, up to {number(top, 2)} Hz"))
        p = b.poles
        seen = p.freq_hz <= top
        still = p.still & seen
        plot = Plot(scale, Scale(0.0, float(p.order.max(initial=2)) + 2, "order"), 170)
        order = p.order.astype(np.float64)
        plot.bars(
            p.freq_hz[seen & ~p.still],
            order[seen & ~p.still],
            order[seen & ~p.still],
            "#b8b8b8",
            "other poles",
            big=True,
        )
        plot.bars(p.freq_hz[still], order[still], order[still], GREEN, "poles that stand still", big=True)
        for k in b.modes:
            plot.mark(k.freq_hz, PURPLE, f"{k.freq_hz:.3f} Hz")
        out.append(plot.html(f"Stabilisation, up to {number(top, 2)} Hz"))
    channels = ", ".join(m.names)
    out.append(
        f'<p class="small">Both by pyOMA-2 from {length(m.seconds)} of accelerations from {utc(m.begin_ns)} UTC '
        f"({escape(channels)}): frequency-domain decomposition, and covariance-driven subspace identification, whose "
        "sd (\u00b1) is of the record\u2019s blocks and of the spread over the orders. In phase: 1 = all channels move "
        "together or against each other, as in a mode of a structure; less = a doubtful shape.</p>"
    )
    return "".join(out)


# ------------------------------------------------------------------------------------------------------------ wavelets


def wavelets(r: Review) -> str:
    """Scalogram of the fused displacement, and single bands taken out of it."""
    out = []
    for name, p in r.points.items():
        w = p.wavelets
        if w is None:
            why = (
                "it has no receiver, so there is no displacement" if not p.receiver
                else "no valid displacement" if not p.moments.n
                else "it has no accelerometer" if not p.accelerometer
                else "no frequency stands out of the accelerations" if not p.frequencies
                else "no stretch of fixes and accelerations long enough"
            )  # fmt: skip
            out.append(f"<p>{escape(name)}: no wavelets, {why}.</p>")
            continue
        g = w.scalogram
        end = w.begin_ns + round(w.seconds * 1e9)
        frame = time_scale(w.begin_ns, end)
        f0, f1 = math.log10(float(g.freq_hz[0])), math.log10(float(g.freq_hz[-1]))
        db = 10.0 * np.log10(np.maximum(g.power / g.power.max(), 1e-12))
        step = 0.5 * (f1 - f0) / (len(g.freq_hz) - 1)
        plot = Plot(frame, Scale(f0 - step, f1 + step, "Hz", log=True), 260, alone=True)
        plot.image((frame.low, frame.high), (f0 - step, f1 + step), 1.0 + db / RANGE_DB)
        edge = np.minimum(g.edge_s, 0.5 * w.seconds) * 1e9
        logs = np.log10(g.freq_hz)
        for x in (w.begin_ns + edge, end - edge):
            plot.line(x, logs, RED, "outside: the record\u2019s ends are felt")
        for b in w.bands:
            for f in (b.low_hz, b.high_hz):
                plot.level(math.log10(f), GREY, "bands below")
        for k in (0, 10, 20, 30):
            shade = shade_colour(1.0 - k / RANGE_DB)
            plot.legend.append((shade, "box edge", "largest" if not k else f"\u2212{k} dB"))
        out.append(plot.html(f"{name} {AXES[w.axis]}: wavelet power of the fused displacement, {utc(w.begin_ns)[:10]}"))
        rows = []
        for b in w.bands:
            shown = [np.quantile(MM * x, (0.002, 0.998)) for x in (b.value_m, b.fixes_m) if len(x)]  # ends may be wild
            plot = Plot(frame, Scale(*limits(*shown), "mm"), 130, alone=True)
            if len(b.fixes_m):
                plot.area(*_spans(b.fixes_t_ns, MM * b.fixes_m), math.inf, RAW, "fixes, same band")
            plot.area(*_spans(b.t_ns, MM * b.value_m), math.inf, BLUE, "fused")
            title = f"{name} {AXES[w.axis]}: {number(b.freq_hz, 3)} Hz alone, {b.low_hz:.3g} to {b.high_hz:.3g} Hz"
            out.append(plot.html(title))
            share = (b.rms_m / b.fixes_rms_m) ** 2 if b.fixes_rms_m > 0 else math.nan
            rows.append(
                [
                    f"{b.low_hz:.3g} \u2026 {b.high_hz:.3g}",
                    mm(b.rms_m, 2),
                    mm(b.fixes_rms_m, 2),
                    percent(min(share, 1.0)) if math.isfinite(share) else "\u2013",
                    mm(b.largest_m, 2),
                ]
            )
        if rows:
            head = [
                "band [Hz]", "rms fused [mm]", "rms of the fixes [mm]", "fused / fixes, power", "largest fused [mm]",
            ]  # fmt: skip
            out.append(table(head, rows, 4))
    text = (
        "Morlet wavelets (Torrence &amp; Compo 1998) in the liveliest minutes of each point. What the fixes have "
        "beyond the fused displacement in a band is noise of the receiver. Figures leave out both ends, where the "
        "record\u2019s ends are felt. \u2013: fixes too rare for the band, or minutes too few for it."
    )
    return "".join(out) + f'<p class="small">{text}</p>'


def _spans(t: I64, y: F64, most: int = 2000) -> tuple[I64, F64, F64]:
    """Least and largest of so many spans."""
    size = -(-len(y) // most)
    starts = np.arange(0, len(y), size)
    return t[starts], np.minimum.reduceat(y, starts), np.maximum.reduceat(y, starts)
