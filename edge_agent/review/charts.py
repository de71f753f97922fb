"""Plots as HTML and inline SVG that need no script: curves lie in an SVG that stretches, labels beside it in HTML.

A plot maps its data to a box of W x H units. Zooming (page.js) moves the SVG's viewBox and writes the labels anew;
without a script, and on paper, the first view stands there. Long curves come as the least and largest value of each
span, drawn as an area, so no extreme is lost. Values beyond the first view are drawn too, marked and counted at its
edge, and zooming out reaches them. What is drawn is also told in words, for those who do not see it.
"""

from __future__ import annotations

import base64
import math
import re
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from html import escape
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, S

W, H = 10000, 4000
"""Units of a plot's box."""
FAR = 1000
"""So many boxes beyond its own a plot's curves reach; wilder values stand there."""
BLUE, GREY, RED, ORANGE, GREEN, PURPLE = "#0072B2", "#767676", "#D55E00", "#C47F00", "#009E73", "#8e5a9e"
"""After Okabe & Ito, safe for the colour-blind; each stands out of white paper (3 to 1 and more)."""
DARK, INK, RAW = "#8b0a1e", "#1c2733", "#8c8c8c"
MODE_COLOURS = {
    "INIT": RAW,
    "FUSED": GREEN,
    "GNSS_ONLY": BLUE,
    "ACCEL_ONLY": PURPLE,
    "COAST": ORANGE,
    "CONTRADICTION": RED,
    "INVALID": DARK,
}
QUALITY_COLOURS = {"FIXED": GREEN, "FLOAT": ORANGE, "DGNSS": BLUE, "SINGLE": RED, "NONE": DARK}
LAST = 96
"""A label on x beyond this per cent must not stick out of the page."""
LANE = 32
"""Height of a lane [px]: its name and below it its boxes."""
TITLED = 200
"""Boxes of a lane that tell of themselves; more are drawn as one."""


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


class Lane(NamedTuple):
    """A strip of its own in a plot: what it shows, how often or how long, its boxes (begin, end, title)."""

    name: str
    note: str
    colour: str
    boxes: Sequence[tuple[float, float, str]]


@dataclass
class Plot:
    """A plot that grows by layers; `html` at the end. `y` is the first view."""

    x: Scale
    y: Scale
    height: int = 190
    places: int = 7  # labels on x at most
    alone: bool = False  # a time axis of its own: it does not zoom with the others
    layers: list[str] = field(default_factory=list)
    legend: list[tuple[str, str, str]] = field(default_factory=list)  # colour, shape, text
    told: dict[str, tuple[float, float]] = field(default_factory=dict)  # least and largest of what was drawn, by text
    words: list[str] = field(default_factory=list)  # for those who do not see it
    labels: list[tuple[float, str]] = field(default_factory=list)  # of lanes: share from the top, HTML
    beyond: dict[bool, dict[str, tuple[int, float]]] = field(
        default_factory=lambda: {False: {}, True: {}}
    )  # above?: text -> how many spans, and the most extreme value
    single: set[str] = field(default_factory=set)  # those of them that are single values, not points of a curve
    marks: list[str] = field(default_factory=list)  # of those at the edge

    def _told(self, x: npt.NDArray[Any], low: F64, high: F64, colour: str, text: str, single: bool = False) -> None:
        """Take what is drawn into the words, and what is out of view; single values are counted and marked."""
        good = np.isfinite(low) & np.isfinite(high)
        if not text or not good.any():
            return
        before = self.told.get(text, (math.inf, -math.inf))
        self.told[text] = min(before[0], float(low[good].min())), max(before[1], float(high[good].max()))
        for above, values in ((True, high), (False, low)):
            out = good & ((values > self.y.high) if above else (values < self.y.low))
            if not out.any():
                continue
            n, far = self.beyond[above].get(text, (0, 0.0))
            most = float(values[out].max() if above else values[out].min())
            self.beyond[above][text] = n + int(out.sum()), (max if above else min)(far, most) if n else most
            self.single |= {text} if single else set()
            if not single:
                continue
            at = np.unique(np.rint(self.x.map(x[out], W) / 10).astype(np.int64) * 10)
            edge = "0v150" if above else f"{H}v-150"
            d = "".join(f"M{v} {edge}" for v in at[(at >= 0) & (at <= W)].tolist())
            self.marks.append(f'<path d="{d}" fill="none" stroke="{colour}" class="v edge"/>')

    def _xy(self, x: npt.NDArray[Any], y: F64) -> tuple[list[int], list[int]]:
        px = np.clip(np.rint(self.x.map(x, W)), -W, 2 * W).astype(np.int64)
        py = np.clip(np.rint(H - self.y.map(y, H)), -FAR * H, FAR * H).astype(np.int64)
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
        if solid:
            self._told(x, low, high, colour, text)
        self._legend(colour, "line" if solid else "band", text)

    def bars(
        self,
        x: npt.NDArray[Any],
        low: F64,
        high: F64,
        colour: str,
        text: str,
        big: bool = False,
        opacity: float = 1.0,
        loose: bool = False,
    ) -> None:
        """A stroke from low to high at each x, a dot where they are equal. `loose`: where they lie far apart there is
        nothing between, and the ends are dots on a faint stroke."""
        if loose:
            far = high - low > 0.2 * (self.y.high - self.y.low)
            if far.any():
                self.bars(x[far], low[far], high[far], colour, "", big, 0.25)
                self.bars(x[far], low[far], low[far], colour, "", big)
                self.bars(x[far], high[far], high[far], colour, "", big)
                self._told(x[far], low[far], high[far], colour, text, True)
                x, low, high = x[~far], low[~far], high[~far]
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
        if opacity == 1.0:
            self._told(x, low, high, colour, text, True)
        self._legend(colour, "dot" if opacity == 1.0 else "band", text)

    def line(
        self, x: npt.NDArray[Any], y: F64, colour: str, text: str, far: float = math.inf, *, broad: bool = False
    ) -> None:
        """A curve; `broad`: a wide faint one, for others to lie on."""
        kind = 'class="v broad" opacity="0.3"' if broad else 'class="v"'
        for part in _unbroken(x, y, y, far):
            self.layers.append(f'<path d="{_path(*self._xy(x[part], y[part]))}" fill="none" stroke="{colour}" {kind}/>')
        self._told(x, y, y, colour, text)
        self._legend(colour, "band" if broad else "line", text)

    def lanes(self, rows: Sequence[Lane]) -> None:
        """One strip below the other, each with its name over it; the plot becomes as high as they need."""
        self.height = LANE * len(rows)
        size = H / len(rows)
        for k, lane in enumerate(rows):
            y, h = round((k + 0.55) * size), round(0.4 * size)
            boxes = sorted(lane.boxes)
            edges = self.x.map(np.array([box[:2] for box in boxes], np.float64).reshape(-1, 2), W)
            paint = f'fill="{lane.colour}" stroke="{lane.colour}" class="v"'
            if len(boxes) <= TITLED:
                for (a, b), (_, _, title) in zip(edges.tolist(), boxes, strict=True):
                    self.layers.append(
                        f'<rect x="{a:.0f}" y="{y}" width="{max(b - a, 1):.0f}" height="{h}" {paint}>'
                        f"<title>{escape(title)}</title></rect>"
                    )
            else:
                d = "".join(f"M{a} {y}h{b - a + 1}v{h}h{a - b - 1}z" for a, b in _merged(edges))
                self.layers.append(f'<path d="{d}" {paint}><title>{escape(lane.name)}</title></path>')
            note = f" <small>{escape(lane.note)}</small>" if lane.note else ""
            key = f'<i style="--c:{lane.colour}"></i>'
            self.labels.append((k / len(rows), f"{key}{escape(lane.name)}{note}"))
            self.words.append(f"{lane.name} {lane.note}".strip())

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
        at = H - float(np.clip(self.y.map(np.array([y]), H)[0], -FAR * H, FAR * H))
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
        x_text = "".join(f'<span{" class=e" if p > LAST else ""} style="left:{p:.2f}%">{t}</span>' for p, t in xs)
        y_text = "".join(f'<span style="top:{100 - p:.2f}%">{t}</span>' for p, t in ys)
        kinds = ("own" if self.alone else "time") if self.x.time else "log" if self.x.log else "lin"
        x0, x1 = (self.x.low / 1e6, self.x.high / 1e6) if self.x.time else (self.x.low, self.x.high)
        keys = "".join(
            f'<span class="key"><i class="{shape}" style="--c:{colour}"></i>{escape(text)}</span>'
            for colour, shape, text in self.legend
        )
        unit = f'<span class="unit">{escape(self.y.label)}</span>' if self.y.label else ""
        lanes = "".join(f'<span style="top:{100 * share:.2f}%">{text}</span>' for share, text in self.labels)
        lanes = f'<div class="lt">{lanes}</div>' if lanes else ""
        whole, edges = self._edges()
        marks = f'<g class="off">{"".join(self.marks)}</g>' if edges else ""
        every = '<button type="button" data-do="every" title="every value, also what is far off">&#8597;</button>'
        return (
            f'<figure class="chart" data-kind="{kinds}" data-x="{x0!r},{x1!r}" data-y="{self.y.low!r},{self.y.high!r}" '
            f'data-ylog="{int(self.y.log)}" data-values="{int(values)}" data-whole="{whole[0]!r},{whole[1]!r}">'
            f'<figcaption><b>{escape(title)}</b>{unit}<span class="keys">{keys}</span>'
            '<span class="tools"><button type="button" data-do="in" title="zoom in">+</button>'
            '<button type="button" data-do="out" title="zoom out">&minus;</button>'
            '<button type="button" data-do="left" title="earlier">&lsaquo;</button>'
            '<button type="button" data-do="right" title="later">&rsaquo;</button>'
            f"{every if edges else ''}"
            '<button type="button" data-do="all" title="as it was">all</button></span></figcaption>'
            f'<div class="plot" tabindex="0" style="height:{self.height}px">'
            f'<svg viewBox="0 0 {W} {H}" preserveAspectRatio="none" role="img" '
            f'aria-label="{escape(self._spoken(title), quote=True)}"><g class="grid">{grid}</g>{"".join(self.layers)}'
            f'{marks}</svg>{lanes}{edges}<div class="yt">{y_text}</div><div class="xt">{x_text}</div></div>'
            f'<div class="xl">{escape(self.x.label)}</div></figure>'
        )

    def _edges(self) -> tuple[tuple[float, float], str]:
        """The whole range of what is drawn, and what stands at the edges of the first view."""
        size = self.y.high - self.y.low
        low = min((v[0] for v in self.told.values()), default=self.y.low)
        high = max((v[1] for v in self.told.values()), default=self.y.high)
        whole = (
            self.y.low if low >= self.y.low else max(low - 0.03 * (high - low), self.y.low - (FAR - 1) * size),
            self.y.high if high <= self.y.high else min(high + 0.03 * (high - low), self.y.high + (FAR - 1) * size),
        )
        out = ""
        for above, place, sign in ((True, "up", "\u25b2"), (False, "down", "\u25bc")):
            found = self.beyond[above]
            if found:
                told = ", ".join(
                    f"{f'{n} of ' if t in self.single else ''}{escape(t)} to {self._number(v)}"
                    for t, (n, v) in found.items()
                )
                out += f'<div class="off {place}">{sign} {told} {escape(self.y.label)}</div>'
        return whole, out

    def _number(self, v: float) -> str:
        return f"{10**v if self.y.log else v:.3g}".replace("-", "\u2212")

    def _spoken(self, title: str) -> str:
        """The plot in words."""
        if self.x.time:
            over = f"{utc(round(self.x.low))} to {utc(round(self.x.high))} UTC"
        else:
            a, b = (10**v if self.x.log else v for v in (self.x.low, self.x.high))
            over = f"{self.x.label} {a:.3g} to {b:.3g}"
        ranges = [f"{t} {self._number(a)} to {self._number(b)} {self.y.label}" for t, (a, b) in self.told.items()]
        return "; ".join([f"{title}, {over}", *ranges, *self.words])


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


def _merged(edges: F64) -> list[tuple[int, int]]:
    """Begins and ends (k, 2) in order of their begins as whole units, those that touch as one."""
    out: list[tuple[int, int]] = []
    for a, b in np.rint(edges).astype(np.int64).tolist():
        if out and a <= out[-1][1] + 2:
            out[-1] = out[-1][0], max(b, out[-1][1])
        else:
            out.append((a, b))
    return out


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


STACKED = 4
"""Columns from which on a table's rows become cards on a phone."""
_TAG = re.compile(r"<[^>]*>")
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
        ((k * step - low) / size * 100, _short(k * step, digits) if k else "0")
        for k in range(first, math.floor(high / step + 1e-9) + 1)
    ]


def _short(v: float, digits: int) -> str:
    text = f"{v:.{digits}f}" if abs(v) < 1e6 else f"{v:.3g}".replace("e+0", "e").replace("e+", "e")
    return text.replace("-", "\u2212")


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


def spread(*values: F64, share: float = 0.005, reach: float = 3.0, room: float = 0.06) -> tuple[float, float]:
    """As `limits`, but for single values far off: what lies further from the inner part (all but `share` at either
    end) than `reach` times its width is left out."""
    flat = np.concatenate([np.zeros(0), *(v[np.isfinite(v)].ravel() for v in values)])
    if not flat.size:
        return limits()
    low, high = np.quantile(flat, (share, 1.0 - share)).tolist()
    wide = reach * max(high - low, 1e-9 + 0.01 * abs(high))
    return limits(flat[(flat >= low - wide) & (flat <= high + wide)], room=room)


def table(head: Sequence[str], rows: Sequence[Sequence[str]], numbers: int = 0) -> str:
    """A table; cells are HTML. The last `numbers` columns are set right."""
    n = len(head)

    names = [_TAG.sub(" ", t) for t in head]  # on a phone each cell carries its column's name

    def cell(tag: str, i: int, text: str) -> str:
        name = f' data-h="{names[i]}"' if tag == "td" and names[i] and n >= STACKED else ""
        inside = f"<div>{text}</div>" if name and text else text
        return f"<{tag}{' class=n' if i >= n - numbers else ''}{name}>{inside}</{tag}>"

    top = "".join(cell("th", i, t) for i, t in enumerate(head))
    body = "".join("<tr>" + "".join(cell("td", i, t) for i, t in enumerate(row)) + "</tr>" for row in rows)
    broad = ' class="broad"' if n >= STACKED else ""
    long = " long" if len(rows) > 12 else ""
    return f'<div class="wide{long}"><table{broad}><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
