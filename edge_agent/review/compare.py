"""`replay --compare`: two settings over the same raw blocks, side by side, with figures and one page.

Both sides are replayed from nothing, so that neither begins with what the recording had learned, and then read piece
by piece, so memory does not grow with the record. Judges: how well each predicted the fixes before it saw them (one
step ahead, on fixes that both took), how honest its sd is, what its gate refused, and how far its live stream lies from
the smoothed one, which knows the whole record. The smoother takes the fixes that either side took, its noise is its own
maximum likelihood, so it leans to neither.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from importlib.resources import files as package_files
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent import replay as replaying
from edge_agent.messages import F64, I64, VALID_MODES, Config, Estimate, S, Verdict
from edge_agent.review.charts import BLUE, GREY, ORANGE, RED, Plot, Scale, length, limits, table, time_scale, utc
from edge_agent.review.estimates import at_the_gate
from edge_agent.review.series import Envelope, Fixed, Fused, Judged, Piece, Stream, pieces
from edge_agent.review.smoothed import Smoothed

COUNTED = ("JUMP_OPEN", "JUMP_LEVEL", "DATUM", "REACQUIRE", "OUTAGE_END", "CONTRADICTION", "ACCEL_LOST", "ACCEL_GAP")
WINDOW_NS = 10 * S
"""Gains of neighbouring fixes are not independent; those of so long nearly are."""
SURE = 3.0
"""A gain beyond so many of its sd is one,"""
LEAST = 3.0
"""if it is more than this at all: a likelihood 20 times as high."""
CELL_NS = 200_000_000
"""Samples held against the smoothed stream, which comes late: one in so long,"""
HELD_NS = 8 * 3600 * S
"""and so many hours at most: two of its chapters at one fix a second are five."""
APART_NS = 60 * S
"""Both streams come to the same time within so long."""
SPANS = 1500
FINEST_NS = 20_000_000
SAME_US = 50
"""Arrivals that belong to one fix lie this close."""
AXES = "xyz"


@dataclass
class Side:
    """What one of the settings did at one point; per axis (3,) where it is an array."""

    samples: int = 0
    valid: Stream = field(default_factory=Stream)
    verdicts: dict[int, int] = field(default_factory=dict)
    events: dict[str, int] = field(default_factory=dict)
    taken: int = 0
    nis: F64 = field(default_factory=lambda: np.zeros(3))  # sums over `taken`
    residual2: F64 = field(default_factory=lambda: np.zeros(3))
    sd: F64 = field(default_factory=lambda: np.zeros(3))  # sum over common samples
    off2: F64 = field(default_factory=lambda: np.zeros(3))  # against the smoothed stream
    displacement: Envelope = field(default_factory=lambda: Envelope(3, FINEST_NS, SPANS))
    std: Envelope = field(default_factory=lambda: Envelope(3, FINEST_NS, SPANS))

    def gate(self, verdict: Verdict) -> float:
        """Share of the fixes at the gate that got this verdict."""
        n = at_the_gate(self.verdicts)
        return self.verdicts.get(int(verdict), 0) / n if n else math.nan


@dataclass
class Both:
    """Old against new at one point: sums over `common` samples where both are valid, over `smooth` samples that have a
    smoothed one, over `fixes` that both took; `windows`: gain in log likelihood of each WINDOW_NS."""

    receiver: str
    accelerometer: str
    old: Side = field(default_factory=Side)
    new: Side = field(default_factory=Side)
    common: int = 0
    apart: F64 = field(default_factory=lambda: np.zeros(3))
    apart2: F64 = field(default_factory=lambda: np.zeros(3))
    furthest: F64 = field(default_factory=lambda: np.zeros(3))
    smooth: int = 0
    fixes: int = 0
    likelihood_old: float = 0.0
    likelihood_new: float = 0.0
    windows: dict[int, float] = field(default_factory=dict)
    difference: Envelope = field(default_factory=lambda: Envelope(3, FINEST_NS, SPANS))

    @property
    def gain(self) -> tuple[float, float]:
        """Log likelihood of the fixes by the new settings less that by the old, and its sd."""
        each = np.array(list(self.windows.values()))
        spread = math.sqrt(len(each)) * float(each.std(ddof=1)) if len(each) > 2 else math.inf
        return self.likelihood_new - self.likelihood_old, spread

    @property
    def verdict(self) -> str:
        gain, sd = self.gain
        if not self.fixes:
            return "no fix that both took: nothing to judge by"
        if abs(gain) < max(SURE * sd, LEAST):
            return "no difference that the fixes could tell"
        return "the new settings predict the fixes better" if gain > 0 else "the new settings predict the fixes worse"


@dataclass
class Comparison:
    """`sets`: what was changed, as given; `begin_ns`, `end_ns` UTC."""

    sets: Sequence[str]
    files: Sequence[str]
    begin_ns: int
    end_ns: int
    points: dict[str, Both]
    report: replaying.Report


def compare(
    inputs: Sequence[Path],
    output: Path | None,
    old: Config,
    new: Config,
    sets: Sequence[str] = (),
    folder: Path | None = None,
    progress: Callable[[str], None] | None = None,
) -> Comparison:
    """Replay `inputs` by both configurations and compare; `output` gets the new recording (None: none is kept).
    `folder`: where the two recordings lie meanwhile, each as large as the inputs. Raises as `replay`."""

    def say(text: str) -> None:
        if progress is not None:
            progress(text)

    with tempfile.TemporaryDirectory(prefix="edge-agent-", dir=folder) as name:
        mine = Path(name)
        say("replaying with the old settings")
        replaying.replay(inputs, mine / "old.mcap", old, False, fresh=True)
        say("replaying with the new settings")
        made = output or mine / "new.mcap"
        report = replaying.replay(inputs, made, new, False, fresh=True)
        if output is None:
            report.output = ""
        names = [n for n in old.points if n in new.points]
        points = {n: Both(new.points[n].receiver or "", new.points[n].accelerometer or "") for n in names}
        walks = {n: _Point(n, new, points[n]) for n in names}
        aided = any(new.points[n].accelerometer and new.points[n].receiver for n in names)
        begin, end = 1 << 62, -(1 << 62)
        for a, b in zip_longest(pieces([mine / "old.mcap"], old, accelerations=False), _new(made, new, aided)):
            for walk in walks.values():
                walk.add(a, b)
            for f in (*a.fused.values(), *a.fixes.values()) if a is not None else ():
                if len(f.utc_ns):
                    begin, end = min(begin, int(f.utc_ns[0])), max(end, int(f.utc_ns[-1]))
            say(f"comparing, {length(max(end - begin, 0) / S)}")
        for walk in walks.values():
            walk.finish()
    if begin > end:
        raise replaying.ReplayError("neither settings give a fix or an estimate from these files")
    return Comparison(sets, [p.name for p in replaying.in_order(inputs)], begin, end, points, report)


def _new(path: Path, config: Config, aided: bool) -> Iterator[Piece]:
    return pieces([path], config, accelerations=aided)


class _Track(NamedTuple):
    utc_ns: I64
    d: F64
    sd: F64
    valid: npt.NDArray[np.bool_]


NOTHING = _Track(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.bool_))


def _track(f: Fused) -> _Track:
    return _Track(f.utc_ns, f.displacement_m, f.std_displacement_m, np.isin(f.mode, VALID_MODES))


def _joined(a: _Track, b: _Track) -> _Track:
    return _Track(
        np.concatenate([a.utc_ns, b.utc_ns]),
        np.concatenate([a.d, b.d]),
        np.concatenate([a.sd, b.sd]),
        np.concatenate([a.valid, b.valid]),
    )


def _late(a: _Track) -> _Track:
    return _behind(a, int(np.searchsorted(a.utc_ns, a.utc_ns[-1] - APART_NS))) if len(a.utc_ns) else a


def _behind(a: _Track, n: int) -> _Track:
    return _Track(a.utc_ns[n:], a.d[n:], a.sd[n:], a.valid[n:])


class _Point:
    """One point's walk over both streams."""

    def __init__(self, name: str, config: Config, both: Both) -> None:
        self.name, self.both = name, both
        self.old = self.new = NOTHING
        self.judged: list[tuple[I64, Judged]] = [(np.zeros(0, np.int64), _no_judged())] * 2
        self.smoother = Smoothed(config, name) if both.receiver else None
        self.held: list[tuple[I64, F64, F64]] = []  # UTC, old d, new d of samples that wait for the smoothed stream

    def add(self, a: Piece | None, b: Piece | None) -> None:
        for piece, side, which in ((a, self.both.old, 0), (b, self.both.new, 1)):
            if piece is None:
                continue
            for h in piece.happened:
                if h.source == self.name and h.kind in COUNTED:
                    side.events[h.kind] = side.events.get(h.kind, 0) + 1
            f = piece.fused.get(self.name)
            if f is not None and len(f.utc_ns):
                track = _track(f)
                side.samples += len(f.utc_ns)
                side.valid.add(f.utc_ns[track.valid])
                shown = track.valid[:, None]
                side.displacement.add(f.utc_ns, np.where(shown, track.d, np.nan))
                side.std.add(f.utc_ns, np.where(shown, track.sd, np.nan))
                if which:
                    self.new = _joined(self.new, track)
                else:
                    self.old = _joined(self.old, track)
            self._verdicts(side, which, piece)
        self._streams()
        taken = self._gate()
        if b is not None and self.smoother is not None:
            self._smooth(self.smoother.add(_for_truth(b, self.name, taken)))

    def finish(self) -> None:
        if self.smoother is not None:
            self._smooth(self.smoother.finish())

    # -------------------------------------------------------------------------------------------------------- streams

    def _streams(self) -> None:
        """Compare as far as both have come: the new stream at the old one's times."""
        old, new = self.old, self.new
        if not len(old.utc_ns) or len(new.utc_ns) < 2:  # one has not begun: the other has nothing to wait for
            self.old, self.new = _late(old), _late(new)
            return
        n = int(np.searchsorted(old.utc_ns, new.utc_ns[-1], side="right"))
        t = old.utc_ns[:n]
        k = np.searchsorted(new.utc_ns, t, side="right") - 1
        inside = k >= 0
        k = np.maximum(k, 0)
        after = np.minimum(k + 1, len(new.utc_ns) - 1)
        step = np.maximum(new.utc_ns[after] - new.utc_ns[k], 1)
        usual = max(float(np.median(np.diff(new.utc_ns))), 1.0)
        share = ((t - new.utc_ns[k]) / step)[:, None]
        near = (t == new.utc_ns[k]) | (step <= 3.5 * usual)
        good = inside & near & old.valid[:n] & new.valid[k]
        share, k, after = share[good], k[good], after[good]
        d_new = new.d[k] + np.where(share > 0, share * (new.d[after] - new.d[k]), 0.0)
        self._common(t[good], old.d[:n][good], d_new, old.sd[:n][good], new.sd[k])
        self.old = _behind(old, n)
        keep = max(0, int(np.searchsorted(new.utc_ns, t[-1], side="right")) - 1) if n else 0
        self.new = _behind(new, keep)

    def _common(self, t: I64, d_old: F64, d_new: F64, sd_old: F64, sd_new: F64) -> None:
        if not len(t):
            return
        both = self.both
        e = d_new - d_old
        both.common += len(t)
        both.apart += e.sum(axis=0)
        both.apart2 += (e * e).sum(axis=0)
        both.furthest = np.maximum(both.furthest, np.abs(e).max(axis=0))
        both.old.sd += sd_old.sum(axis=0)
        both.new.sd += sd_new.sum(axis=0)
        both.difference.add(t, e)
        if self.smoother is not None:
            some = np.diff(t // CELL_NS, prepend=-1) > 0
            if some.any():
                self.held.append((t[some], d_old[some], d_new[some]))

    # ----------------------------------------------------------------------------------------------------------- gate

    def _verdicts(self, side: Side, which: int, piece: Piece) -> None:
        j, fixes = piece.judged.get(self.name), piece.fixes.get(self.both.receiver)
        if j is None:
            return
        for value, n in zip(*np.unique(j.verdict, return_counts=True), strict=True):
            side.verdicts[int(value)] = side.verdicts.get(int(value), 0) + int(n)
        good = (
            (j.verdict == Verdict.ACCEPTED) & (j.std_residual_m > 0).all(axis=1) & np.isfinite(j.residual_m).all(axis=1)
        )
        e2 = j.residual_m[good] ** 2
        side.taken += int(good.sum())
        side.nis += (e2 / j.std_residual_m[good] ** 2).sum(axis=0)
        side.residual2 += e2.sum(axis=0)
        at = self.judged[which]
        self.judged[which] = np.concatenate([at[0], _arrival_us(j, fixes)]), _more(at[1], j)

    def _gate(self) -> I64:
        """Compare the verdicts that both have given; return monotonic times (by the new side) of fixes that either
        took."""
        (u, a), (v, b) = self.judged
        taken: I64 = b.t_ns[b.verdict == Verdict.ACCEPTED]
        if not len(u) or not len(v):
            for which, (arrived, j) in enumerate(((u, a), (v, b))):
                self.judged[which] = _later(arrived, j, int(arrived[-1]) - APART_NS // 1000 if len(arrived) else 0)
            return taken
        i = np.clip(np.searchsorted(v, u), 1, max(len(v) - 1, 1))
        i = np.where(np.abs(v[np.minimum(i, len(v) - 1)] - u) < np.abs(v[i - 1] - u), np.minimum(i, len(v) - 1), i - 1)
        same = np.abs(v[i] - u) <= SAME_US
        taken = np.asarray(np.union1d(taken, b.t_ns[i[same & (a.verdict == Verdict.ACCEPTED)]]), np.int64)
        good = same & (a.verdict == Verdict.ACCEPTED) & (b.verdict[i] == Verdict.ACCEPTED)
        one, two = _score(a)[good], _score(b)[i[good]]
        fine = np.isfinite(one) & np.isfinite(two)
        one, two = one[fine], two[fine]
        both = self.both
        both.fixes += len(one)
        both.likelihood_old += float(one.sum())
        both.likelihood_new += float(two.sum())
        for w, gain in zip((a.utc_ns[good][fine] // WINDOW_NS).tolist(), (two - one).tolist(), strict=True):
            both.windows[w] = both.windows.get(w, 0.0) + gain
        done = max(int(u[same].max()) if same.any() else 0, min(int(u[-1]), int(v[-1])))
        for which, (arrived, j) in enumerate(((u, a), (v, b))):
            self.judged[which] = _later(arrived, j, done)
        return taken

    # --------------------------------------------------------------------------------------------------------- smooth

    def _smooth(self, blocks: Iterator[tuple[Estimate, int]]) -> None:
        """Hold what waits against the smoothed stream as it comes."""
        parts = [(e.t_ns + offset, e.displacement_m, np.isin(e.mode, VALID_MODES)) for e, offset in blocks]
        if len(self.held) > 1 and self.held[0][0][0] < self.held[-1][0][-1] - HELD_NS:
            del self.held[0]
        if sum(len(t) for t, _, _ in parts) < 2 or not self.held:
            return
        t, d, valid = (np.concatenate(c) for c in zip(*parts, strict=True))
        u, old, new = (np.concatenate(c) for c in zip(*self.held, strict=True))
        k = np.clip(np.searchsorted(t, u), 1, len(t) - 1)
        usual = max(float(np.median(np.diff(t))), 1.0)
        hit = (u >= t[0]) & (u <= t[-1]) & (t[k] - t[k - 1] <= 3.5 * usual) & valid[k] & valid[k - 1]
        k, at = k[hit], u[hit]
        share = ((at - t[k - 1]) / (t[k] - t[k - 1]))[:, None]  # accelerations decoded anew: a clock's sd apart
        truth = d[k - 1] + share * (d[k] - d[k - 1])
        both = self.both
        both.smooth += len(at)
        both.old.off2 += ((old[hit] - truth) ** 2).sum(axis=0)
        both.new.off2 += ((new[hit] - truth) ** 2).sum(axis=0)
        left = u > t[-1]
        self.held = [(u[left], old[left], new[left])]


def _no_judged() -> Judged:
    z, n = np.zeros((0, 3)), np.zeros(0, np.int64)
    return Judged(n, n, z, z, z, z, np.zeros(0), np.zeros(0, np.uint8))


def _later(arrived: I64, j: Judged, than_us: int) -> tuple[I64, Judged]:
    left = arrived > than_us
    return arrived[left], Judged(*(getattr(j, n)[left] for n in Judged.__slots__))


def _more(a: Judged, b: Judged) -> Judged:
    return Judged(*(np.concatenate([getattr(a, n), getattr(b, n)]) for n in Judged.__slots__))


def _arrival_us(j: Judged, fixes: Fixed | None) -> I64:
    """Arrival of each judged fix, monotonic us: the same whatever latency the settings assume."""
    if fixes is None or not len(fixes.t_ns):
        return np.floor_divide(j.t_ns, 1000)
    i = np.clip(np.searchsorted(fixes.t_ns, j.t_ns), 0, len(fixes.t_ns) - 1)
    late = np.where(fixes.t_ns[i] == j.t_ns, np.nan_to_num(fixes.latency_s[i]), 0.0)
    return np.asarray(j.t_ns // 1000 + np.rint(1e6 * late).astype(np.int64), np.int64)


def _score(j: Judged) -> F64:
    """Log likelihood of each fix as predicted (n,)."""
    v = np.where(j.std_residual_m > 0, j.std_residual_m, np.nan) ** 2
    return np.asarray(-0.5 * (np.log(2 * math.pi * v) + j.residual_m**2 / v).sum(axis=1))


def _for_truth(piece: Piece, point: str, taken: I64) -> Piece:
    """The piece with every fix accepted that either side took, and no other; nothing is on another level."""
    j = piece.judged.get(point)
    if j is None:
        return piece
    good = np.isin(j.t_ns, taken)
    verdict = np.where(good, int(Verdict.ACCEPTED), int(Verdict.REJECTED)).astype(np.uint8)
    return replace(piece, judged={**piece.judged, point: replace(j, verdict=verdict)})


# ---------------------------------------------------------------------------------------------------------------- words


def _number(v: float) -> float | None:
    return float(f"{v:.6g}") if math.isfinite(v) else None


def _figures(both: Both, side: Side, seconds: float) -> dict[str, Any]:
    n, k = max(both.common, 1), max(side.taken, 1)

    def each(values: F64, some: int) -> list[float | None] | None:
        return [_number(float(v)) for v in values] if some else None

    return {
        "samples": side.samples,
        "availability": _number(min(side.valid.covered_ns / S / seconds, 1.0)),
        "mean_std_m": each(side.sd / n, both.common),
        "rms_against_smoothed_m": each(np.sqrt(side.off2 / max(both.smooth, 1)), both.smooth),
        "rms_innovation_m": each(np.sqrt(side.residual2 / k), side.taken),
        "innovation2_over_variance": each(side.nis / k, side.taken),
        "mean_nis": _number(float(side.nis.sum()) / k) if side.taken else None,
        "share_refused": _number(side.gate(Verdict.REJECTED)),
        "share_on_another_level": _number(side.gate(Verdict.OFFSET)),
        "verdicts": {Verdict(v).name: c for v, c in sorted(side.verdicts.items())},
        "events": dict(sorted(side.events.items())),
    }


def as_json(c: Comparison) -> dict[str, Any]:
    """Everything, as plain values; lengths in m, three axes each; `expected_nis` is what honest sd would give."""
    points = {}
    seconds = max((c.end_ns - c.begin_ns) / S, 1e-9)
    for name, b in c.points.items():
        gain, sd = b.gain
        n = max(b.common, 1)
        points[name] = {
            "verdict": b.verdict,
            "common_samples": b.common,
            "rms_difference_m": [_number(float(v)) for v in np.sqrt(b.apart2 / n)] if b.common else None,
            "mean_difference_m": [_number(float(v)) for v in b.apart / n] if b.common else None,
            "largest_difference_m": [_number(float(v)) for v in b.furthest] if b.common else None,
            "fixes_both_took": b.fixes,
            "log_likelihood_gain": _number(gain),
            "std_log_likelihood_gain": _number(sd),
            "expected_nis": 3.0,
            "old": _figures(b, b.old, seconds),
            "new": _figures(b, b.new, seconds),
        }
    return {"settings": list(c.sets), "files": list(c.files), "points": points}


def _mm(v: float | None) -> str:
    return "-" if v is None else f"{1e3 * v:.3f}"


def _rows(b: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """What is told of a point: label, then values old and new of each axis or of all."""

    def pair(key: str, show: Callable[[float | None], str]) -> list[str]:
        old, new = b["old"][key], b["new"][key]
        if isinstance(old, list) or isinstance(new, list):
            return [f"{show(p)} -> {show(q)}" for p, q in zip(old or [None] * 3, new or [None] * 3, strict=True)]
        return [f"{show(old)} -> {show(new)}"]

    def plain(v: float | None) -> str:
        return "-" if v is None else f"{v:.3f}"

    def share(v: float | None) -> str:
        return "-" if v is None else f"{100 * v:.2f} %"

    apart = b["rms_difference_m"] or [None] * 3
    most = b["largest_difference_m"] or [None] * 3
    return [
        ("rms of new less old [mm]", [_mm(v) for v in apart]),
        ("largest difference [mm]", [_mm(v) for v in most]),
        ("mean sd of the displacement [mm]", pair("mean_std_m", _mm)),
        ("rms against the smoothed stream [mm]", pair("rms_against_smoothed_m", _mm)),
        ("rms of the innovations [mm]", pair("rms_innovation_m", _mm)),
        ("innovation^2 / variance (1 = honest)", pair("innovation2_over_variance", plain)),
        ("v'S^-1v in the mean (3 = honest)", pair("mean_nis", plain)),
        ("fixes refused, of those at the gate", pair("share_refused", share)),
        ("fixes on another level, of those at the gate", pair("share_on_another_level", share)),
        ("valid displacement, of the period", pair("availability", share)),
    ]


def _gain(b: dict[str, Any]) -> str:
    gain, sd = b["log_likelihood_gain"], b["std_log_likelihood_gain"]
    told = f"{gain:+.1f}" + ("" if sd is None else f" +- {sd:.1f}")
    return f"{b['verdict']}: log likelihood {told} over {b['fixes_both_took']} fixes that both took"


def _changes(b: dict[str, Any]) -> str:
    old, new = b["old"]["events"], b["new"]["events"]
    kinds = [k for k in COUNTED if k in old or k in new]
    return ", ".join(f"{k} {old.get(k, 0)} -> {new.get(k, 0)}" for k in kinds) or "no jump, datum or outage in either"


def as_text(c: Comparison) -> str:
    """For people on a terminal."""
    lines = []
    for name, b in as_json(c)["points"].items():
        lines.append(f"{name}: {_gain(b)}")
        lines.append(f"  events: {_changes(b)}")
        for label, cells in _rows(b):
            values = (
                "   ".join(f"{axis} {v}" for axis, v in zip(AXES, cells, strict=True)) if len(cells) == 3 else cells[0]
            )
            lines.append(f"  {label + ':':40}{values}")
    return "\n".join(lines)


# ----------------------------------------------------------------------------------------------------------------- page


def _neat(text: str) -> str:
    """Words of the terminal as a page has them."""
    for plain, neat in (("+-", "\u00b1"), ("^2", "\u00b2"), ("v'S^-1v", "v\u2032S\u207b\u00b9v")):
        text = text.replace(plain, neat)
    return escape(text)


def page(c: Comparison) -> str:
    """One file with both streams, their difference and their sd, that needs nothing but itself."""
    here = package_files("edge_agent.review")
    css, js = (here.joinpath(n).read_text(encoding="utf-8") for n in ("page.css", "page.js"))
    figures = as_json(c)["points"]
    changed = "".join(f"<li><code>{escape(s)}</code></li>" for s in c.sets) or "<li>another configuration</li>"
    body = []
    for name, b in c.points.items():
        told = figures[name]
        rows = [[_neat(label), *(cells if len(cells) == 3 else [cells[0], "", ""])] for label, cells in _rows(told)]
        rows = [[r[0], *(escape(v).replace("-&gt;", "\u2192") for v in r[1:])] for r in rows]
        body.append(f'<section id="{escape(name)}"><h2>{escape(name)}</h2><p><b>{_neat(_gain(told))}.</b></p>')
        body.append(f"<p>Events: {escape(_changes(told)).replace('-&gt;', '→')}.</p>")
        body.append(table(["old \u2192 new", "x, or all axes", "y", "z"], rows, 3))
        body += [_drawn(c, name, b, axis) for axis in range(3)]
        body.append("</section>")
    title = f"Settings compared, {utc(c.begin_ns)[:10]}"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{escape(title)}</title><style>{css}</style></head><body><main>'
        f"<header><h1>{escape(title)}</h1><p>{utc(c.begin_ns)} to {utc(c.end_ns)} UTC, "
        f"{escape(', '.join(c.files[:5]))}</p></header>"
        f'<section id="summary"><h2>What was changed</h2><ul>{changed}</ul></section>{"".join(body)}'
        "<footer>Made by edge-agent replay --compare. Both replayed from nothing. All times UTC; sd = standard "
        f"deviation.</footer></main><script>{js}</script></body></html>\n"
    )


def _drawn(c: Comparison, name: str, b: Both, axis: int) -> str:
    frame = time_scale(c.begin_ns, c.end_ns)
    shown, curves = [], []
    for side, colour, text in ((b.old, ORANGE, "old"), (b.new, BLUE, "new")):
        t, low, high, _ = side.displacement.spans()
        if not len(t):
            continue
        _, _, sd, _ = side.std.spans()
        d0, d1, band = 1e3 * low[:, axis], 1e3 * high[:, axis], 2e3 * sd[:, axis]
        curves.append((t, d0, d1, band, max(1.5 * side.displacement.span_ns, 2.0 * S), colour, text))
        shown += [d0 - np.minimum(band, np.nanmedian(band) * 4), d1 + np.minimum(band, np.nanmedian(band) * 4)]
    if not curves:
        return ""
    plot = Plot(frame, Scale(*limits(*shown), "mm"), 210)
    for t, d0, d1, band, far, colour, text in curves:
        plot.area(t, d0 - band, d1 + band, far, colour, f"{text} \u00b1 2 sd", 0.18)
    for t, d0, d1, _, far, colour, text in curves:
        plot.area(t, d0, d1, far, colour, text, 0.85)
    out = plot.html(f"{name} {AXES[axis]}: displacement")
    t, low, high, _ = b.difference.spans()
    if len(t):
        plot = Plot(frame, Scale(*limits(1e3 * low[:, axis], 1e3 * high[:, axis], np.zeros(1)), "mm"), 120)
        far = max(1.5 * b.difference.span_ns, 2.0 * S)
        plot.area(t, 1e3 * low[:, axis], 1e3 * high[:, axis], far, RED, "new less old")
        plot.level(0.0, GREY, "")
        out += plot.html(f"{name} {AXES[axis]}: difference")
    curves_sd = []
    for side, colour, text in ((b.old, ORANGE, "old"), (b.new, BLUE, "new")):
        t, low, high, _ = side.std.spans()
        if len(t):
            curves_sd.append((t, 1e3 * low[:, axis], 1e3 * high[:, axis], side.std.span_ns, colour, text))
    top = max(float(np.nanquantile(h, 0.98)) for _, _, h, _, _, _ in curves_sd)
    plot = Plot(frame, Scale(0.0, 1.3 * top or 1.0, "mm"), 90)
    for t, low_sd, high_sd, span, colour, text in curves_sd:
        plot.area(t, low_sd, high_sd, max(1.5 * span, 2.0 * S), colour, text, 0.6)
    return out + plot.html(f"{name} {AXES[axis]}: sd of the displacement")
