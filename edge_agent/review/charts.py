"""Plots as HTML and inline SVG that need no script: curves lie in an SVG that stretches, labels beside it in HTML.

A plot maps its data to a box of W x H units. Zooming (page.js) moves the SVG's viewBox and writes the labels anew;
without a script, and on paper, the whole range stands there. Long curves come as the least and largest value of each
span, drawn as an area, so no extreme is lost.
"""

from __future__ import annotations

import base64
import math
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from html import escape
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, S

W, H = 10000, 4000
"""Units of a plot's box."""
BLUE, GREY, RED, ORANGE, GREEN, PURPLE = "#0072B2", "#8a8a8a", "#D55E00", "#E69F00", "#009E73", "#8e5a9e"
"""Safe for the colour-blind (Okabe & Ito)."""
MODE_COLOURS = {
    "INIT": "#c9c9c9",
    "FUSED": GREEN,
    "GNSS_ONLY": "#56B4E9",
    "ACCEL_ONLY": "#b39ddb",
    "COAST": ORANGE,
    "CONTRADICTION": RED,
    "INVALID": "#b00020",
}
QUALITY_COLOURS = {"FIXED": GREEN, "FLOAT": ORANGE, "DGNSS": "#56B4E9", "SINGLE": RED, "NONE": "#b00020"}


def utc(ns: int, digits: int = 0) -> str:
    """2026-11-24 13:07:46.12; the zone is said where it is used."""
    t = datetime.fromtimestamp(ns // S, UTC)
    part = f"{ns % S / S:.{digits}f}"[1:] if digits else ""
    return f"{t:%Y-%m-%d %H:%M:%S}{part}" if part != ".0" else f"{t:%Y-%m-%d %H:%M:%S}"


def length(seconds: float) -> str:
    """A length of time in the unit that suits it."""
    if seconds < 120:
        return f"{seconds:.3g} s" if seconds < 10 else f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.1f} h" if seconds < 172800 else f"{seconds / 86400:.1f} days"


@dataclass
class Scale:
    """Values low to high on an axis; `log`: both and the data are logarithms to base 10; `time`: UTC ns."""

    low: float
    high: float
    label: str
    log: bool = False
    time: bool = False

    def map(self, values: npt.NDArray[Any], size: int) -> F64:
        """Values -> units of the box, from the low end."""
        v = np.asarray(values - self.low, dtype=np.float64) if self.time else np.asarray(values, np.float64) - self.low
        return np.asarray(v / max(self.high - self.low, 1e-300) * size)


@dataclass
class Plot:
    """A plot that grows by layers; `html` at the end."""

    x: Scale
    y: Scale
    height: int = 190
    places: int = 7  # labels on x at most
    alone: bool = False  # a time axis of its own: it does not zoom with the others
    layers: list[str] = field(default_factory=list)
    legend: list[tuple[str, str, str]] = field(default_factory=list)  # colour, shape, text

    def _xy(self, x: npt.NDArray[Any], y: F64) -> tuple[list[int], list[int]]:
        px = np.clip(np.rint(self.x.map(x, W)), -W, 2 * W).astype(np.int64)
        py = np.clip(np.rint(H - self.y.map(y, H)), -3 * H, 4 * H).astype(np.int64)
        return px.tolist(), py.tolist()

    def area(
        self, x: npt.NDArray[Any], low: F64, high: F64, far: float, colour: str, text: str, opacity: float = 1.0
    ) -> None:
        """Spans at x from low to high as one area; steps beyond `far` and NaN break it. Opaque ones have an outline,
        so that where least and largest are the same there is a line."""
        solid = opacity >= 0.5
        for part in _unbroken(x, low, high, far):
            px, lo = self._xy(x[part], low[part])
            _, hi = self._xy(x[part], high[part])
            d = _path(px, hi) + "L" + _path(px[::-1], lo[::-1])[1:] + "z"
            edge = f'stroke="{colour}" class="v"' if solid else 'stroke="none"'
            self.layers.append(f'<path d="{d}" fill="{colour}" opacity="{opacity:g}" {edge}/>')
        self._legend(colour, "line" if solid else "band", text)

    def bars(
        self, x: npt.NDArray[Any], low: F64, high: F64, colour: str, text: str, big: bool = False, opacity: float = 1.0
    ) -> None:
        """A stroke from low to high at each x, a dot where they are equal."""
        good = np.isfinite(low) & np.isfinite(high)
        if good.any():
            px, lo = self._xy(x[good], low[good])
            _, hi = self._xy(x[good], high[good])
            d: list[str] = []
            at = 0, 0
            kind = "dot big" if big else "dot" if len(px) < 1200 else "dot dense"
            faint = "" if opacity == 1.0 else f' opacity="{opacity:g}"'
            for a, b, c in zip(px, lo, hi, strict=True):
                d.append(f"m{a - at[0]} {b - at[1]}v{c - b}" if d else f"M{a} {b}v{c - b}")
                at = a, c
            self.layers.append(f'<path d="{"".join(d)}" fill="none" stroke="{colour}" class="v {kind}"{faint}/>')
        self._legend(colour, "dot" if opacity == 1.0 else "band", text)

    def line(self, x: npt.NDArray[Any], y: F64, colour: str, text: str, far: float = math.inf) -> None:
        for part in _unbroken(x, y, y, far):
            self.layers.append(
                f'<path d="{_path(*self._xy(x[part], y[part]))}" fill="none" stroke="{colour}" class="v"/>'
            )
        self._legend(colour, "line", text)

    def spans(self, rows: Sequence[tuple[float, float, str, str]], low: float = 0.0, high: float = 1.0) -> None:
        """Boxes (begin, end, colour, title) between two shares of the height, e.g. for what happened."""
        for begin, end, colour, title in rows:
            a, b = (float(v) for v in self.x.map(np.array([begin, end]), W))
            self.layers.append(
                f'<rect x="{a:.0f}" y="{H * (1 - high):.0f}" width="{max(b - a, 8):.0f}" '
                f'height="{H * (high - low):.0f}" fill="{colour}"><title>{escape(title)}</title></rect>'
            )

    def box(self, x0: float, x1: float, y0: float, y1: float, colour: str, title: str) -> None:
        """A box between values."""
        a, b = (float(v) for v in self.x.map(np.array([x0, x1]), W))
        c, d = (H - float(v) for v in self.y.map(np.array([y0, y1]), H))
        self.layers.append(
            f'<rect x="{a:.0f}" y="{min(c, d):.0f}" width="{max(b - a, 8):.0f}" height="{abs(c - d):.0f}" '
            f'fill="{colour}"><title>{escape(title)}</title></rect>'
        )

    def image(self, x: tuple[float, float], y: tuple[float, float], shade: F64) -> None:
        """A picture between two values of each axis: shade (rows, columns) 0 to 1, the first row at the low end of y,
        white to dark blue."""
        a, b = (float(v) for v in self.x.map(np.array(x), W))
        c, d = (H - float(v) for v in self.y.map(np.array(y), H))
        data = base64.b64encode(png(shade[::-1])).decode()
        self.layers.append(
            f'<image x="{a:.0f}" y="{d:.0f}" width="{b - a:.0f}" height="{c - d:.0f}" preserveAspectRatio="none" '
            f'href="data:image/png;base64,{data}"/>'
        )

    def mark(self, x: float, colour: str, title: str) -> None:
        at = float(self.x.map(np.array([x]), W)[0])
        self.layers.append(
            f'<path d="M{at:.0f} 0V{H}" stroke="{colour}" class="v dash"><title>{escape(title)}</title></path>'
        )

    def level(self, y: float, colour: str, text: str) -> None:
        at = H - float(self.y.map(np.array([y]), H)[0])
        self.layers.append(f'<path d="M0 {at:.0f}H{W}" stroke="{colour}" class="v dash"/>')
        self._legend(colour, "line", text)

    def _legend(self, colour: str, shape: str, text: str) -> None:
        if text and all(row[2] != text for row in self.legend):
            self.legend.append((colour, shape, text))

    def html(self, title: str, values: bool = True) -> str:
        """The whole figure. `values` False: no numbers on y (strips)."""
        xs = ticks(self.x, self.places)
        about = max(2, min(5, self.height // 30)) if self.y.log else 5  # powers may come two to a label's height
        ys = ticks(self.y, about) if values else []
        grid = "".join(f'<path d="M{W * p / 100:.0f} 0V{H}"/>' for p, _ in xs)
        grid += "".join(f'<path d="M0 {H - H * p / 100:.0f}H{W}"/>' for p, _ in ys)
        x_text = "".join(f'<span style="left:{p:.2f}%">{t}</span>' for p, t in xs)
        y_text = "".join(f'<span style="top:{100 - p:.2f}%">{t}</span>' for p, t in ys)
        kinds = ("own" if self.alone else "time") if self.x.time else "log" if self.x.log else "lin"
        x0, x1 = (self.x.low / 1e6, self.x.high / 1e6) if self.x.time else (self.x.low, self.x.high)
        keys = "".join(
            f'<span class="key"><i class="{shape}" style="--c:{colour}"></i>{escape(text)}</span>'
            for colour, shape, text in self.legend
        )
        unit = f'<span class="unit">{escape(self.y.label)}</span>' if self.y.label else ""
        return (
            f'<figure class="chart" data-kind="{kinds}" data-x="{x0!r},{x1!r}" data-y="{self.y.low!r},{self.y.high!r}" '
            f'data-ylog="{int(self.y.log)}" data-values="{int(values)}">'
            f'<figcaption><b>{escape(title)}</b>{unit}<span class="keys">{keys}</span>'
            '<span class="tools"><button type="button" data-do="in" title="zoom in">+</button>'
            '<button type="button" data-do="out" title="zoom out">&minus;</button>'
            '<button type="button" data-do="left" title="earlier">&lsaquo;</button>'
            '<button type="button" data-do="right" title="later">&rsaquo;</button>'
            '<button type="button" data-do="all" title="everything">all</button></span></figcaption>'
            f'<div class="plot" style="height:{self.height}px"><svg viewBox="0 0 {W} {H}" preserveAspectRatio="none" '
            f'role="img" aria-label="{escape(title)}"><g class="grid">{grid}</g>{"".join(self.layers)}</svg>'
            f'<div class="yt">{y_text}</div><div class="xt">{x_text}</div></div>'
            f'<div class="xl">{escape(self.x.label)}</div></figure>'
        )


SHADES = ((255, 255, 255), (222, 235, 247), (158, 202, 225), (66, 146, 198), (8, 81, 156), (8, 29, 70))
"""From nothing to much: one hue that darkens, so it reads in grey and by the colour-blind."""


def shade_colour(share: float) -> str:
    at = min(max(share, 0.0), 1.0) * (len(SHADES) - 1)
    k = min(int(at), len(SHADES) - 2)
    mixed = (round(a + (b - a) * (at - k)) for a, b in zip(SHADES[k], SHADES[k + 1], strict=True))
    return "#" + "".join(f"{v:02x}" for v in mixed)


def png(shade: F64) -> bytes:
    """A picture of shades (rows, columns) 0 to 1 with a palette of 256 (PNG, ISO/IEC 15948)."""
    rows, columns = shade.shape
    values = np.rint(np.clip(shade, 0.0, 1.0) * 255).astype(np.uint8)
    palette = bytes.fromhex("".join(shade_colour(k / 255)[1:] for k in range(256)))
    lines = np.concatenate([np.zeros((rows, 1), np.uint8), values], axis=1).tobytes()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", columns, rows, 8, 3, 0, 0, 0)
    parts = (
        chunk(b"IHDR", head),
        chunk(b"PLTE", palette),
        chunk(b"IDAT", zlib.compress(lines, 9)),
        chunk(b"IEND", b""),
    )
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def _unbroken(x: npt.NDArray[Any], low: F64, high: F64, far: float) -> list[slice]:
    """Stretches without NaN and without steps beyond `far`."""
    good = np.isfinite(low) & np.isfinite(high)
    if not len(x):
        return []
    cut = np.flatnonzero((np.diff(x) > far) | (good[1:] != good[:-1])) + 1
    edges = [0, *cut.tolist(), len(x)]
    return [slice(a, b) for a, b in pairwise(edges) if good[a]]


def _path(px: list[int], py: list[int]) -> str:
    """Points as a path of short relative steps."""
    out = [f"M{px[0]} {py[0]}"]
    for i in range(1, len(px)):
        dx, dy = px[i] - px[i - 1], py[i] - py[i - 1]
        if dx or dy:
            out.append(f"l{dx} {dy}" if dy >= 0 else f"l{dx}{dy}")
    if len(out) == 1:
        out.append("h0")
    return "".join(out)


STEPS_S = (0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200, 86400)


def ticks(scale: Scale, about: int) -> list[tuple[float, str]]:
    """Places in per cent of the axis, and their texts."""
    low, high = scale.low, scale.high
    size = max(high - low, 1e-300)
    if scale.time:
        return _time_ticks(round(low), round(high), about)
    if scale.log:
        whole = range(math.floor(low - 1e-9), math.floor(high + 1e-9) + 1)
        every = max(1, math.ceil(len(whole) / (about + 2)))
        for steps in ((1, 2, 5), (1,)):
            found = [(k, m, k + math.log10(m)) for k in whole for m in steps if k % every == 0]
            found = [row for row in found if low - 1e-9 <= row[2] <= high + 1e-9]
            if len(found) <= about + 3 or len(steps) == 1:
                break
        if len(found) >= 2:
            texts = [_power(k) if m == 1 else _plain(m * 10.0**k) for k, m, _ in found]
            return [((at - low) / size * 100, t) for (_, _, at), t in zip(found, texts, strict=True)]
        linear = ticks(Scale(10**low, 10**high, ""), 5)
        values = [10**low + p / 100 * (10**high - 10**low) for p, _ in linear]
        return [((math.log10(v) - low) / size * 100, t) for v, (_, t) in zip(values, linear, strict=True) if v > 0]
    step = 10.0 ** math.floor(math.log10(size / about))
    step = next(s for s in (step, 2 * step, 5 * step, 10 * step) if size / s <= about)
    digits = max(0, -math.floor(math.log10(step) + 1e-9))
    first = math.ceil(low / step - 1e-9)
    return [
        ((k * step - low) / size * 100, f"{k * step:.{digits}f}".replace("-", "\u2212") if k else "0")
        for k in range(first, math.floor(high / step + 1e-9) + 1)
    ]


def _power(k: int) -> str:
    return _plain(10.0**k) if -3 <= k <= 3 else f"10<sup>{k}</sup>".replace("-", "\u2212")


def _plain(v: float) -> str:
    return f"{v:g}"


def _time_ticks(low: int, high: int, about: int) -> list[tuple[float, str]]:
    seconds = (high - low) / S
    step = next((s for s in STEPS_S if seconds / s <= about), 0.0)
    if not step:
        step = 86400.0 * math.ceil(seconds / 86400 / about)
    step_ns = round(step * S)
    out = []
    for k in range(-(-low // step_ns), high // step_ns + 1):
        t = datetime.fromtimestamp(k * step_ns // S, UTC)
        if step < 1:
            text = f"{t:%H:%M:%S}.{k * step_ns % S // 100_000_000}"
        elif step < 60:
            text = f"{t:%H:%M:%S}"
        elif step < 86400:
            text = f"{t:%H:%M}" if seconds < 86400 else f"{t:%m-%d %H:%M}"
        else:
            text = f"{t:%m-%d}"
        out.append(((k * step_ns - low) / (high - low) * 100, text))
    return out


def time_scale(begin_ns: int, end_ns: int) -> Scale:
    return Scale(float(begin_ns), float(max(end_ns, begin_ns + S)), "UTC", time=True)


def limits(*values: F64, room: float = 0.06) -> tuple[float, float]:
    """Least and largest of the finite values with some room; a frame around 0 where there is none."""
    flat = [v[np.isfinite(v)] for v in values]
    flat = [v for v in flat if v.size]
    if not flat:
        return -1.0, 1.0
    low, high = float(min(v.min() for v in flat)), float(max(v.max() for v in flat))
    pad = room * (high - low) or max(0.1 * abs(high), 1e-3)
    return low - pad, high + pad


def table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: int = 0) -> str:
    """A table; cells are HTML. The last `numbers` columns are set right."""
    n = len(head)

    def cell(tag: str, i: int, text: str) -> str:
        return f"<{tag}{' class=n' if i >= n - numbers else ''}>{text}</{tag}>"

    top = "".join(cell("th", i, t) for i, t in enumerate(head))
    body = "".join("<tr>" + "".join(cell("td", i, t) for i, t in enumerate(row)) + "</tr>" for row in rows)
    broad = ' class="broad"' if n >= 5 else ""
    return f'<div class="wide"><table{broad}><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
