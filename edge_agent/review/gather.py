"""One pass over recordings -> everything that the report tells, in memory that does not grow with their length.

`verify` says what is missing and why, `series.pieces` hands out the data, `series.Overview` keeps envelopes and counts.
Added here: extremes of the valid displacement with their sd, spectra averaged on the way, the smoothed stream, the
busiest minutes of each point (for the questions that need all samples at once) and a close look at each extreme.
Displacement counts where its mode is valid; what is not valid is in the mode's strip, not in the figures.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent import verify
from edge_agent.geodesy import geodetic_to_ecef
from edge_agent.memory import give_back
from edge_agent.messages import F64, I64, U8, VALID_MODES, Config, Estimate, Mode, Quality, S, Verdict
from edge_agent.recording import topics
from edge_agent.recording.reader import DamagedError, read_messages
from edge_agent.recording.writer import PART
from edge_agent.replay import ReplayError
from edge_agent.review import spectra
from edge_agent.review.agree import Agreement, agree, with_speeds
from edge_agent.review.ahead import ahead, worth
from edge_agent.review.checks import Apart, Checks, apart, check
from edge_agent.review.estimates import Estimates
from edge_agent.review.modal import Modal, Together, identify
from edge_agent.review.received import Received, unrecorded
from edge_agent.review.series import (
    KEPT,
    STRANGE,
    Accelerometer,
    Envelope,
    Happened,
    Overview,
    Piece,
    Point,
    Receiver,
    Share,
    Stream,
    pieces,
    pieces_of,
)
from edge_agent.review.smooth import Accelerations, plain
from edge_agent.review.smoothed import Smoothed, add_all
from edge_agent.review.sources import Opened, Setup, copies, opened, setups, together
from edge_agent.review.splits import Split, split_fusion
from edge_agent.review.wavelets import Wavelets, wavelets

SPANS = 2000
"""Spans of an envelope that is drawn: one for each pixel of a wide plot."""
FINEST_NS = 20_000_000
"""Its shortest span; it doubles as the record grows."""
SEGMENT_S = (8.0, 100.0)
"""Shortest and longest segment of a spectrum: a fifth of the record between them."""
CHUNK = 3
"""Segments that are averaged at a time, a part of the record; two neighbouring parts are kept where they move most."""
BUSY_S = (120.0, 600.0)
"""The busiest stretch that is kept of each point is so long: the longer one where fixes are rare,"""
BUSY_FIXES = (100, 1200)
"""least fixes that it must hold, and those that are enough."""
TRUSTED = 0.6
"""Where the gate took so large a share of the fixes, what it refused is left out of the questions to the sensors; one
that refuses more may be wrong itself, for example where the accelerometer contradicts;"""
REFUSED, TAKEN = 0.12, 0.3
"""nor is it wrong where the fixes stood on another level for long, if it refused less and took more than this."""
SMOOTHED = 1 << 14
"""Samples of the smoothed stream that are taken at a time."""
CLOSE_NS = 6 * S
"""A close look reaches so far to both sides of an extreme."""
PEAK_DB = 9.0
"""A frequency is told as dominating where accelerations stand so far above their floor."""
MODES = 8
"""Frequencies told of one accelerometer at most, the highest above the floor."""
TRACK_HZ, TRACK_PARTS, TRACK_REACH = 20.0, 96, 0.06
"""Frequencies below this are tracked in time, in at most so many parts of the record, within so large a share of their
mean."""
SAME = 0.03
"""Peaks of two sensors are one frequency within this share,"""
SAME_LINES = 1.5
"""or within so many lines of the spectrum."""


FAR_M = 200.0
"""A receiver that stands so far from where it stood is on another structure."""


class Extreme(NamedTuple):
    """A displacement, its sd and when."""

    value_m: float
    std_m: float
    utc_ns: int


class Close(NamedTuple):
    """A close look: utc_ns (n,), displacement and sd (n,) of one axis at full rate."""

    axis: int
    utc_ns: I64
    displacement_m: F64
    std_m: F64


@dataclass
class Moments:
    """Count, mean and rms about the mean of what has passed, per axis (3,)."""

    n: int = 0
    mean: F64 = field(default_factory=lambda: np.zeros(3))
    m2: F64 = field(default_factory=lambda: np.zeros(3))

    def add(self, x: F64) -> None:
        """Values (n, c), all finite (Chan, Golub & LeVeque 1983)."""
        if not len(x):
            return
        if not self.n:
            self.mean, self.m2 = np.zeros(x.shape[1]), np.zeros(x.shape[1])
        mean, n = x.mean(axis=0), self.n + len(x)
        apart = mean - self.mean
        self.m2 = self.m2 + ((x - mean) ** 2).sum(axis=0) + apart * apart * (self.n * len(x) / n)
        self.mean, self.n = self.mean + apart * (len(x) / n), n

    @property
    def std(self) -> F64:
        return np.asarray(np.sqrt(self.m2 / max(self.n, 1)))


_VALID = np.isin(np.arange(256), VALID_MODES)
"""Of each mode."""


def _valid(mode: U8, t: I64, d: F64, sd: F64) -> tuple[I64, F64, F64]:
    """Times (n,), displacements and their sd (n, 3) where the mode is valid; no copy where it is everywhere."""
    valid = _VALID[mode]
    return (t, d, sd) if valid.all() else (t[valid], d[valid], sd[valid])


def _rising(t: I64) -> npt.NDArray[np.bool_]:
    """Times later than all before them: a file that is there twice must not turn time back."""
    good = np.ones(len(t), np.bool_)
    good[1:] = t[1:] > np.maximum.accumulate(t)[:-1]
    return good


class Averaged:
    """Welch's density of a stream of any length, and the stretch of it that moved most."""

    def __init__(self, segment_s: float, *, keep: bool = False) -> None:
        """`keep`: the stretch that moved most too, and what `track` needs."""
        self.segment_s, self.keep = segment_s, keep
        self.rate_hz = 0.0
        self.busiest: spectra.Uniform | None = None
        self._power = -1.0
        self._total: F64 = np.zeros(0)
        self._freq: F64 = np.zeros(0)
        self._segments = 0
        self._parts: list[tuple[int, F64, int]] = []  # middle, density below TRACK_HZ over all columns, segments
        self._rows: list[tuple[I64, F64]] = []
        self._run = ""
        self._before: tuple[I64, F64, float] | None = None  # the part before and its power

    def add(self, run: str, t_ns: I64, x: F64) -> None:
        if not len(t_ns):
            return
        if run != self._run:
            self.flush()
            self._run, self._before = run, None
        self._rows.append((t_ns, x.astype(np.float32) if self.keep else x))  # as fine as the converters of sensors
        if t_ns[-1] - self._rows[0][0][0] > CHUNK * self.segment_s * S:
            self.flush()

    def flush(self) -> None:
        rows, self._rows = self._rows, []
        if not rows:
            return
        t, x = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
        x = x.astype(np.float64)
        good = np.isfinite(x).all(axis=1)
        t, x = t[good], x[good]
        rising = _rising(t)
        t, x = t[rising], x[rising]
        if len(t) < 16:
            return
        if not self.rate_hz:
            self.rate_hz = S / float(np.median(np.diff(t)))
        u = spectra.uniform(t, x, self.rate_hz)
        try:
            found = spectra.welch(u.x, u.rate_hz, max(8, round(self.segment_s * self.rate_hz)), valid=u.valid)
        except ValueError:  # no whole segment in it
            return
        if self.keep:
            self._keep(t, x, u, float(found.psd[1:].sum()) * found.segments)
        self._freq = found.freq_hz
        self._total = found.psd * found.segments + (self._total if self._segments else 0.0)
        self._segments += found.segments
        if not self.keep:
            return
        low = found.psd[found.freq_hz <= TRACK_HZ].sum(axis=1)
        self._parts.append((int(t[0]) + int(t[-1] - t[0]) // 2, low, found.segments))
        if len(self._parts) > 2 * TRACK_PARTS:
            self._halve()

    def _keep(self, t: I64, x: F64, u: spectra.Uniform, own: float) -> None:
        power, stretch = own, u
        if self._before is not None and 0 < t[0] - self._before[0][-1] < S:
            power += self._before[2]
            if power > self._power:
                both = np.concatenate([self._before[0], t]), np.concatenate([self._before[1], x])
                stretch = spectra.uniform(*both, self.rate_hz)
        if power > self._power:
            self._power, self.busiest = power, stretch
        self._before = t, x.astype(np.float32), own

    def _halve(self) -> None:
        pairs = zip(self._parts[::2], self._parts[1::2], strict=False)
        self._parts = [((a + b) // 2, (x * m + y * n) / (m + n), m + n) for (a, x, m), (b, y, n) in pairs]

    def track(self, freq_hz: Sequence[float]) -> tuple[I64, F64, F64]:
        """The mode near each frequency in each part of the record: middles (k,), Hz and its sd (k, f), NaN = none."""
        while len(self._parts) > TRACK_PARTS:
            self._halve()
        out = np.full((2, len(self._parts), len(freq_hz)), np.nan)
        for i, (_, psd, segments) in enumerate(self._parts):
            lines = self._freq[: len(psd)]
            for j, f in enumerate(freq_hz):
                apart = min((abs(f - g) for g in freq_hz if g != f), default=math.inf)
                width = min(max(TRACK_REACH * f, 8.0 * float(lines[1])), 0.7 * apart)
                if f > lines[-1]:
                    continue
                mode = spectra.fit_density(lines, psd, segments, f, width, accelerations=True)
                if abs(mode.freq_hz - f) <= TRACK_REACH * f and mode.std_freq_hz < TRACK_REACH * f:
                    out[:, i, j] = mode.freq_hz, mode.std_freq_hz
        return np.array([m for m, _, _ in self._parts], dtype=np.int64), out[0], out[1]

    def spectrum(self) -> spectra.Spectrum | None:
        """The average with its 95 % limits; None where there was no whole segment."""
        self.flush()
        n = self._segments
        if not n:
            return None
        psd = self._total / n
        dof = 2.0 * n / (1.0 + 2.0 * spectra.HANN_OVERLAP * (n - 1) / n)
        c = 2.0 / (9.0 * dof)  # chi-square quantiles after Wilson & Hilferty (1931)
        low, high = (dof / (dof * max(1.0 - c + z * math.sqrt(c), 0.05) ** 3) for z in (1.96, -1.96))
        return spectra.Spectrum(self._freq, psd, psd * low, psd * high, n, 0.95)


class Frequency(NamedTuple):
    """A frequency at which a structure moves: of the accelerations with sd and damping (NaN: no fit), the axes that
    show it, height above the floor; the nearest peak of fused and raw displacement, NaN = none."""

    freq_hz: float
    std_hz: float
    damping: float
    std_damping: float
    axes: str
    above_db: float
    fused_hz: float
    gnss_hz: float


class Busy(NamedTuple):
    """Stretch in which a point moved most: fixes t_ns, z_m, std_m and which of them the gate let in (not those of a
    start, which it never saw), whether it let in enough of what it saw to be trusted, accelerations t_ns, xyz, fused
    t_ns, d, sd; velocity_mps (n, 2) of the fixes as the receiver told it."""

    utc_minus_ns: int
    fixes: tuple[I64, F64, F64]
    taken: npt.NDArray[np.bool_]
    trusted: bool
    accel: tuple[I64, F64]
    fused: tuple[I64, F64, F64]
    velocity_mps: F64


def _trusted(taken: float, refused: float) -> bool:
    """Whether a gate that took and refused such shares of the fixes (the rest stood on another level) may be right."""
    return taken > TRUSTED or (refused < REFUSED and taken > TAKEN)


class _Keeper:
    """Keeps the busiest stretch of a point."""

    def __init__(self) -> None:
        self.best: Busy | None = None
        self._score = -1.0
        self._run = ""
        self._begin = 0
        self._count = 0
        self._offset = 0
        self._rows: dict[str, list[tuple[npt.NDArray[np.int64] | F64, ...]]] = {"fixes": [], "accel": [], "fused": []}
        self._kept: tuple[list[I64], list[I64], list[I64]] = ([], [], [])  # times of REJECTED, OFFSET, START

    def add(self, piece: Piece, point: str, receiver: str, accelerometer: str) -> None:
        fixes, accel, fused = (
            piece.fixes.get(receiver),
            piece.accelerations.get(accelerometer),
            piece.fused.get(point),
        )
        times = [p.utc_ns for p in (fixes, accel, fused) if p is not None and len(p.utc_ns)]
        if not times:
            return
        first = int(min(t[0] for t in times))
        long = first - self._begin
        full = long >= BUSY_S[0] * S and self._count >= BUSY_FIXES[1]
        if piece.run != self._run or full or not 0 <= long < BUSY_S[1] * S:
            self.close()
            self._run, self._begin, self._count = piece.run, first, 0
        if fixes is not None:
            good = (fixes.quality == Quality.FIXED) & np.isfinite(fixes.z_m).all(axis=1)
            self._count += len(fixes.t_ns)
            self._rows["fixes"].append((fixes.t_ns[good], fixes.z_m[good], fixes.std_m[good], fixes.velocity_mps[good]))
        judged = piece.judged.get(point)
        if judged is not None:
            for kept, verdict in zip(self._kept, (Verdict.REJECTED, Verdict.OFFSET, Verdict.START), strict=True):
                kept.append(judged.t_ns[judged.verdict == verdict])
        if accel is not None and len(accel.t_ns):
            self._offset = int(accel.utc_ns[0] - accel.t_ns[0])
            self._rows["accel"].append((accel.t_ns, accel.xyz))
        if fused is not None:
            self._rows["fused"].append(_valid(fused.mode, fused.utc_ns, fused.displacement_m, fused.std_displacement_m))

    def close(self) -> None:
        rows = {k: [np.concatenate(c) for c in zip(*v, strict=True)] for k, v in self._rows.items() if v}
        refused, moved, unseen = (np.concatenate([np.zeros(0, np.int64), *v]) for v in self._kept)
        refused = np.concatenate([refused, moved])
        self._rows, self._kept = {"fixes": [], "accel": [], "fused": []}, ([], [], [])
        if not {"fixes", "accel", "fused"} <= rows.keys() or len(rows["fixes"][0]) < BUSY_FIXES[0]:
            return
        t, xyz = rows["accel"]
        good = _rising(t) & np.isfinite(xyz).all(axis=1)
        t, xyz = t[good], xyz[good]
        if len(t) < 100:
            return
        score = float(np.diff(xyz, axis=0).std(axis=0).sum()) * math.sqrt(float(t[-1] - t[0]))
        if score > self._score:
            fixes, fused = rows["fixes"], rows["fused"]
            good, seen = ~np.isin(fixes[0], refused), ~np.isin(fixes[0], unseen)
            offset = np.isin(fixes[0], moved)
            self._score = score
            self.best = Busy(
                self._offset,
                (fixes[0], fixes[1], fixes[2]),
                good & seen,
                _trusted(float(good[seen].mean()), float((~good & ~offset)[seen].mean())) if seen.any() else False,
                (t, xyz),
                (fused[0] - self._offset, fused[1], fused[2]),
                fixes[3],
            )


NO_FIXES: tuple[I64, I64, F64] = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
UNJUDGED_NS = 10 * S
"""A fix that has no verdict for so long gets none."""


@dataclass
class PointFigures:
    """What a point did: coverage of the valid estimate, extremes and moments of it, spells of one mode (begin, end UTC
    ns, mode), gate, smoothed stream, spectra, frequencies and what the sensors say of each other."""

    receiver: str
    accelerometer: str
    valid: Stream = field(default_factory=Stream)
    moments: Moments = field(default_factory=Moments)
    low: list[Extreme | None] = field(default_factory=lambda: [None] * 3)
    high: list[Extreme | None] = field(default_factory=lambda: [None] * 3)
    spells: list[tuple[int, int, int]] = field(default_factory=list)
    gated: int = 0
    nis: F64 = field(default_factory=lambda: np.zeros(3))  # mean of residual^2 / variance
    std_residual_m: F64 = field(default_factory=lambda: np.zeros(3))  # mean over the fixes at the gate
    run: str = ""
    unjudged: tuple[I64, I64, F64] = field(
        default_factory=lambda: NO_FIXES
    )  # of that run, t_ns, UTC ns, z_m without a verdict yet
    smoothed: Envelope = field(default_factory=lambda: Envelope(3, FINEST_NS, SPANS))
    smoothed_std_m: Moments = field(default_factory=Moments)
    std_m: Moments = field(default_factory=Moments)
    fused_spectrum: spectra.Spectrum | None = None
    gnss_spectrum: spectra.Spectrum | None = None
    accel_spectrum: spectra.Spectrum | None = None
    frequencies: list[Frequency] = field(default_factory=list)
    recent: tuple[I64, F64, F64] = field(
        default_factory=lambda: (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    )
    looks: dict[tuple[int, bool], Close] = field(default_factory=dict)  # axis, whether the largest
    track: tuple[I64, F64, F64] = field(
        default_factory=lambda: (np.zeros(0, np.int64), np.zeros((0, 0)), np.zeros((0, 0)))
    )
    close: list[Close] = field(default_factory=list)
    busy: Busy | None = None
    agreement: Agreement | None = None
    split: Split | None = None
    apart: Apart | None = None
    checks: Checks | None = None
    wavelets: Wavelets | None = None
    notes: list[str] = field(default_factory=list)


@dataclass
class Review:
    """Everything that the report tells. `damaged`: file -> what is wrong with it."""

    config: Config
    setups: list[Setup]  # the different configurations among the files
    verdict: verify.Verdict
    overview: Overview
    damaged: dict[Path, str]
    open_files: list[Path]
    begin_ns: int
    end_ns: int
    points: dict[str, PointFigures]
    latency: dict[str, Moments]
    places: dict[str, tuple[float, float, float]]  # receiver -> latitude, longitude, height
    rejects: dict[tuple[str, str], int]  # source, reason -> count
    estimates: Estimates
    received: Received
    modal: Modal | None = None
    copies: dict[Path, Path] = field(default_factory=dict)  # left out: it holds nothing that the other does not
    strange: dict[Path, str] = field(default_factory=dict)  # of other programs, left out
    apart: dict[str, float] = field(
        default_factory=dict
    )  # receiver -> how far it stands apart in files of other settings

    @property
    def seconds(self) -> float:
        return max((self.end_ns - self.begin_ns) / S, 1e-9)


def gather(
    inputs: Sequence[Path] | Opened, progress: Callable[[str], None] | None = None, smooth: bool = True
) -> Review:
    """Read files and folders. Damaged files are named in the result. Raises as `sources.opened`."""

    def say(text: str) -> None:
        if progress is not None:
            progress(text)

    files, bad, config, found = inputs if isinstance(inputs, Opened) else opened(inputs)
    strange = {path: why for path, why in bad.items() if why.startswith(STRANGE)}
    bad = {path: why for path, why in bad.items() if path not in strange}
    looked = _looked([*files, *bad], lambda p: say(f"checking {p.name}"))
    twice = copies(looked)
    files = [p for p in files if p not in twice]
    verdict = verify.judged([f for f in looked if f.path not in twice], [])
    verdict.gaps += unrecorded(verdict.files, verdict.gaps)
    damaged = {p: _short(p, why) for p, why in bad.items() if not p.name.endswith(PART)}
    unfinished = [p for p in bad if p.name.endswith(PART)]
    for f in looked:
        if f.damage:
            damaged.setdefault(f.path, f.damage)
        elif f.state == "open" and f.path.name.endswith(PART):
            if f.path not in unfinished:
                unfinished.append(f.path)
        elif f.state == "open":
            damaged.setdefault(f.path, "cut off: its end is missing; what stands before is in the report")
    held = [f for f in verdict.files if f.messages]
    begin, end = min(f.begin_ns for f in held), max(f.end_ns for f in held)
    if twice:
        found = setups(files)
    config = together(config, found)
    review = Review(
        config, found, verdict, Overview(), damaged, unfinished, begin, end, {}, {}, {}, {}, Estimates(config),
        Received(config, verdict.gaps), copies=twice, strange=strange,
    )  # fmt: skip
    recorded_s = sum(f.end_ns - f.begin_ns for f in held) / S
    _both(review, files, min(max(recorded_s / 5, SEGMENT_S[0]), SEGMENT_S[1]), smooth, say)
    review.overview.files.update(bad)
    for path, damage in review.overview.files.items():
        if damage and path not in damaged and path not in unfinished:
            damaged[path] = _short(path, damage)
    review.places = {name: place for name in config.receivers if (place := _place(files, name)) is not None}
    review.apart = _apart_places(review)
    return review


def _looked(files: list[Path], progress: Callable[[Path], None]) -> list[verify.File]:
    """`verify.look` at each, every second file by a second process."""
    theirs = files[1::2] if worth(files) else []
    beside = ahead(verify.looks, theirs) if theirs else iter(())
    out = []
    for k, path in enumerate(files):
        progress(path)
        out.append(next(beside) if theirs and k % 2 else verify.look(path))
    return out


def _answered(p: PointFigures) -> None:
    """What is asked of a point's busiest minutes."""
    p.close = _close_looks(p)
    _questions(p)


def _short(path: Path, why: str) -> str:
    return why.removeprefix(f"{path}: ")


def _envelopes() -> tuple[Point, Receiver, Accelerometer]:
    """Containers with spans as fine as a plot can show."""

    def fine(columns: int) -> Envelope:
        return Envelope(columns, FINEST_NS, SPANS)

    return (
        Point(displacement=fine(3), std=fine(3), residual=fine(3), ratio=fine(1)),
        Receiver(position=fine(3), latency=fine(1), satellites=fine(1), age=fine(1)),
        Accelerometer(xyz=fine(3)),
    )


def _walk(
    review: Review,
    files: Sequence[Path],
    segment_s: float,
    smooth: bool,
    say: Callable[[str], None],
    share: Share | None,
) -> Iterator[Piece]:
    """Take all pieces into the review; `share`: only these points and accelerometers. Yields each piece when it is
    done with it."""
    config, overview = review.config, review.overview
    keepers: dict[str, _Keeper] = {}
    fused: dict[str, Averaged] = {}
    gnss: dict[str, Averaged] = {}
    accel: dict[str, Averaged] = {}
    smoothers: dict[str, Smoothed] = {}
    names = sorted(config.points if share is None else share.points)
    total = sum(f.stat().st_size for f in files) or 1
    done, shown = 0, ""
    for name in names:
        settings = config.points[name]
        p = review.points[name] = PointFigures(settings.receiver or "", settings.accelerometer or "")
        overview.points[name] = _envelopes()[0]
        keepers[name], fused[name], gnss[name] = _Keeper(), Averaged(segment_s), Averaged(segment_s)
        if smooth and p.receiver:
            smoothers[name] = Smoothed(config, name, block=SMOOTHED, velocity=False)
    for name in config.receivers:
        overview.receivers[name] = _envelopes()[1]
        review.latency[name] = Moments()
    for name in sorted(config.accelerometers if share is None else share.accelerometers):
        overview.accelerometers[name] = _envelopes()[2]
        accel[name] = Averaged(segment_s, keep=True)
    current = None
    own = {path: s.config for s in review.setups for path in s.files}
    if share is None:
        found = pieces(files, config, accelerations=bool(config.accelerometers), own=own)
    else:
        found = pieces_of(files, config, own, share)
    for piece in found:
        if piece.path != current:
            done += current.stat().st_size if current is not None else 0
            current = piece.path
        text = f"reading {piece.path.name}, {100 * done // total} %"
        if text != shown:
            say(text)
            shown = text
        for name in names:
            p = review.points[name]
            _point(p, piece, name, fused[name], gnss[name])
            keepers[name].add(piece, name, p.receiver, p.accelerometer)
        for name, e, offset in add_all(smoothers, piece):
            _smooth(review.points[name], e, offset)
        for name, x in piece.fixes.items():
            review.latency.setdefault(name, Moments()).add(x.latency_s[np.isfinite(x.latency_s)][:, None])
        if piece.first:
            give_back()
        for name, a in piece.accelerations.items():
            accel.setdefault(name, Averaged(segment_s, keep=True)).add(piece.run, a.utc_ns, a.xyz)
        overview.add(_for_overview(review, piece))
        review.estimates.add(piece)
        review.received.add(piece)
        yield piece
        del piece  # before the next one is there
    for name in names:
        p = review.points[name]
        if name in smoothers:
            for e, offset in smoothers.pop(name).finish():  # done with: what it holds is not needed below
                _smooth(p, e, offset)
        keepers[name].close()
        p.busy = keepers.pop(name).best
        p.fused_spectrum, p.gnss_spectrum = fused.pop(name).spectrum(), gnss.pop(name).spectrum()
        if p.accelerometer in accel:
            p.accel_spectrum = accel[p.accelerometer].spectrum()
            p.frequencies = _frequencies(p, accel[p.accelerometer].busiest)
            p.track = accel[p.accelerometer].track([f.freq_hz for f in p.frequencies])


def _shares(config: Config) -> tuple[Share, Share]:
    """Points and accelerometers in two halves; what belongs to no point is in the first."""
    names = sorted(config.points)
    first = names[: -(-len(names) // 2)]
    mine = {config.points[name].accelerometer for name in first}
    theirs = {config.points[name].accelerometer for name in names[len(first) :]} - mine
    sensors = frozenset(config.accelerometers)
    return (
        Share(frozenset(first), frozenset(sensors - theirs)),
        Share(frozenset(names[len(first) :]), frozenset(sensors & {n for n in theirs if n})),
    )


def _both(review: Review, files: list[Path], segment_s: float, smooth: bool, say: Callable[[str], None]) -> None:
    """Walk over the files and look closer at each point; where there is a second process to be had, it does so with
    half of the points. Each reads all files: that costs less than to hand over what is in them."""
    config = review.config
    share: Share | None = None
    beside: Iterator[Any] = iter(())
    if len(config.points) > 1 and worth(files):
        share, theirs = _shares(config)
        beside = ahead(_half, files, review.setups, config, review.verdict.gaps, segment_s, smooth, theirs)
    moving = Together()
    for piece in _walk(review, files, segment_s, smooth, say, share):
        found = piece.accelerations
        if share is not None:
            found = found | next(beside)
        moving.add(dataclasses.replace(piece, accelerations={n: found[n] for n in config.accelerometers if n in found}))
        del piece, found  # before the next ones are there
    moving.close()
    give_back()
    for name, p in review.points.items():
        _answered(p)
        say(f"{name}: looked closer")
    if share is not None:
        _join(review, next(beside), theirs)
    for table, _ in _tables(review):
        items = sorted(table.items())
        table.clear()
        table.update(items)
    channels = moving.channels()
    if channels is not None:
        say("modes of all accelerometers together")
        review.modal = identify(channels, _apart(f.freq_hz for p in review.points.values() for f in p.frequencies))


def _half(
    files: list[Path],
    found: list[Setup],
    config: Config,
    gaps: list[verify.Gap],
    segment_s: float,
    smooth: bool,
    share: Share,
) -> Iterator[Any]:
    """A share of the work: the accelerations of each piece, then a Review in which nothing counts but that share."""
    review = Review(
        config, found, verify.Verdict([]), Overview(), {}, [], 0, 0, {}, {}, {}, {}, Estimates(config),
        Received(config, gaps),
    )  # fmt: skip
    for piece in _walk(review, files, segment_s, smooth, lambda _: None, share):
        yield {
            name: dataclasses.replace(a, t_ns=a.t_ns[:0], xyz=a.xyz.astype(np.float32), flags=a.flags[:0])
            for name, a in piece.accelerations.items()
        }
    give_back()
    for p in review.points.values():
        _answered(p)
    yield review


def _tables(r: Review) -> list[tuple[dict[str, Any], bool]]:
    """What is kept by the name of a point (True) or of an accelerometer."""
    points = r.points, r.overview.points, r.estimates.gated, r.estimates.bias, r.received.states, r.received.verdicts
    sensors = (
        r.overview.accelerometers, r.estimates.rates, r.received.accelerometers, r.received.flags, r.received.shaking,
    )  # fmt: skip
    return [*((t, True) for t in points), *((t, False) for t in sensors)]


def _join(review: Review, other: Review, share: Share) -> None:
    """Take a share from another's review."""
    for (mine, of_points), (theirs, _) in zip(_tables(review), _tables(other), strict=True):
        names = share.points if of_points else share.accelerometers
        mine.update({name: value for name, value in theirs.items() if name in names})


def _for_overview(review: Review, piece: Piece) -> Piece:
    """The piece with displacement that is not valid left out, and with refused input counted instead of listed."""
    kept: list[Happened] = []
    for h in piece.happened:
        if h.kind == "REJECT":
            reason = h.text.split(":", 1)[0].split(" ", 1)[0]
            key = h.source, reason
            if key in review.rejects or len(review.rejects) < 200:
                review.rejects[key] = review.rejects.get(key, 0) + int(h.values.get("count", 1.0))
        else:
            kept.append(h)
    fused = {}
    for name, f in piece.fused.items():
        valid = _VALID[f.mode]
        fused[name] = f
        if not valid.all():
            fused[name] = dataclasses.replace(
                f,
                displacement_m=np.where(valid[:, None], f.displacement_m, np.nan),
                std_displacement_m=np.where(valid[:, None], f.std_displacement_m, np.nan),
            )
    return dataclasses.replace(piece, happened=kept, fused=fused)


def _point(p: PointFigures, piece: Piece, name: str, fused: Averaged, gnss: Averaged) -> None:
    f = piece.fused.get(name)
    if f is not None and len(f.utc_ns):
        t, d, sd = _valid(f.mode, f.utc_ns, f.displacement_m, f.std_displacement_m)
        p.valid.add(t)
        p.moments.add(d)
        p.std_m.add(sd)
        if len(t):
            _extremes(p, t, d, sd)
        fused.add(piece.run, t, d)
        _mode_spells(p, f.utc_ns, f.mode)
    j, x = piece.judged.get(name), piece.fixes.get(p.receiver)
    if piece.run != p.run:
        p.run, p.unjudged = piece.run, NO_FIXES
    if x is not None and len(x.t_ns):
        t, utc, z = p.unjudged
        waiting = np.concatenate([t, x.t_ns]), np.concatenate([utc, x.utc_ns]), np.concatenate([z, x.z_m])
        p.unjudged = _later(waiting, int(x.t_ns[0]) - UNJUDGED_NS)
    if j is None or not len(j.t_ns):
        return
    used = np.isin(j.verdict, (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.OFFSET))
    used &= (j.std_residual_m > 0).all(axis=1) & np.isfinite(j.residual_m).all(axis=1)
    counted = used & (j.verdict == Verdict.ACCEPTED)
    n = int(counted.sum())
    if n:
        total = p.gated + n
        share = (j.residual_m[counted] / j.std_residual_m[counted]) ** 2
        p.nis = p.nis + (share.mean(axis=0) - p.nis) * (n / total)
        p.std_residual_m = p.std_residual_m + (j.std_residual_m[counted].mean(axis=0) - p.std_residual_m) * (n / total)
        p.gated = total
    t, utc, z = p.unjudged  # a verdict may stand in the piece behind that of its fix
    taken = np.isin(t, j.t_ns[j.verdict == Verdict.ACCEPTED]) & np.isfinite(z).all(axis=1)  # none sees those of a start
    gnss.add(piece.run, utc[taken], z[taken])
    p.unjudged = _later(p.unjudged, int(j.t_ns.max()))


def _later(fixes: tuple[I64, I64, F64], t_ns: int) -> tuple[I64, I64, F64]:
    """Those behind a time."""
    good = fixes[0] > t_ns
    return fixes[0][good], fixes[1][good], fixes[2][good]


def _extremes(p: PointFigures, t: I64, d: F64, sd: F64) -> None:
    """Take valid samples into the extremes, and keep what lies around each."""
    t_all = np.concatenate([p.recent[0], t])
    d_all, sd_all = np.concatenate([p.recent[1], d]), np.concatenate([p.recent[2], sd])
    for axis in range(3):
        lo, hi = int(np.argmin(d[:, axis])), int(np.argmax(d[:, axis]))
        low, high = p.low[axis], p.high[axis]
        new = {}
        if low is None or d[lo, axis] < low.value_m:
            p.low[axis] = new[False] = Extreme(float(d[lo, axis]), float(sd[lo, axis]), int(t[lo]))
        if high is None or d[hi, axis] > high.value_m:
            p.high[axis] = new[True] = Extreme(float(d[hi, axis]), float(sd[hi, axis]), int(t[hi]))
        for upper in (False, True):
            if upper in new:
                at = new[upper].utc_ns
                k = (t_all >= at - CLOSE_NS) & (t_all <= at + CLOSE_NS)
                p.looks[axis, upper] = Close(axis, t_all[k], d_all[k, axis], sd_all[k, axis])
                continue
            at, look = (p.high if upper else p.low)[axis].utc_ns, p.looks[axis, upper]  # type: ignore[union-attr]
            k = (t > look.utc_ns[-1]) & (t <= at + CLOSE_NS)
            if k.any():
                p.looks[axis, upper] = Close(
                    axis,
                    np.concatenate([look.utc_ns, t[k]]),
                    np.concatenate([look.displacement_m, d[k, axis]]),
                    np.concatenate([look.std_m, sd[k, axis]]),
                )
    kept = t_all >= t_all[-1] - CLOSE_NS
    p.recent = t_all[kept], d_all[kept], sd_all[kept]


def _mode_spells(p: PointFigures, t: I64, mode: U8) -> None:
    """Spells of one mode; a gap of a second ends one."""
    cuts = np.flatnonzero((np.diff(mode.astype(np.int64)) != 0) | (np.diff(t) > S)) + 1
    for lo, hi in zip([0, *cuts.tolist()], [*cuts.tolist(), len(t)], strict=True):
        begin, end, value = int(t[lo]), int(t[hi - 1]), int(mode[lo])
        last = p.spells[-1] if p.spells else None
        if last is not None and last[2] == value and 0 <= begin - last[1] <= S:
            p.spells[-1] = last[0], end, value
        elif len(p.spells) < KEPT:
            p.spells.append((begin, end, value))


def _smooth(p: PointFigures, e: Estimate, offset: int) -> None:
    t, d, sd = _valid(e.mode, e.t_ns, e.displacement_m, e.std_displacement_m)
    p.smoothed.add(t + offset, d)
    p.smoothed_std_m.add(sd)


# ---------------------------------------------------------------------------------------------------------- frequencies


def _apart(freq_hz: Iterable[float]) -> list[float]:
    """Frequencies of several points, each once."""
    out: list[float] = []
    for f in sorted(freq_hz):
        if not out or f > (1.0 + SAME) * out[-1]:
            out.append(f)
    return out


def _all_peaks(s: spectra.Spectrum, axis: int, above_db: float, alone: bool = True) -> list[spectra.Peak]:
    """Peaks of an axis. The floor is taken over a width that grows with the frequency, as modes do."""
    step, top = float(s.freq_hz[1]), 0.9 * float(s.freq_hz[-1])
    found: list[spectra.Peak] = []
    for low, high, width in ((3 * step, 2.0, 0.4), (2.0, top, 2.0)):
        if low < min(high, top):
            w = max(width, 12 * step)
            high = min(high, top)
            found += spectra.peaks(s, axis, low_hz=low, high_hz=high, above_db=above_db, width_hz=w, alone=alone)
    return found


def _same(a_hz: float, b_hz: float, step_hz: float) -> bool:
    return abs(a_hz - b_hz) <= max(SAME * a_hz, SAME_LINES * step_hz)


def _frequencies(p: PointFigures, stretch: spectra.Uniform | None) -> list[Frequency]:
    s = p.accel_spectrum
    if s is None or stretch is None:
        return []
    step = float(s.freq_hz[1])
    groups: list[list[tuple[spectra.Peak, int]]] = []
    every = sorted((peak, axis) for axis in range(3) for peak in _all_peaks(s, axis, PEAK_DB))
    for peak, axis in every:
        if groups and _same(groups[-1][-1][0].freq_hz, peak.freq_hz, step):
            groups[-1].append((peak, axis))
        else:
            groups.append([(peak, axis)])
    groups.sort(key=lambda g: -max(peak.above_db for peak, _ in g))
    groups = sorted(groups[:MODES], key=lambda g: g[0][0].freq_hz)
    other = [
        [peak.freq_hz for axis in range(3) for peak in _all_peaks(o, axis, spectra.BOTTOM_DB, False)]
        if o is not None
        else []
        for o in (p.fused_spectrum, p.gnss_spectrum)
    ]
    tops = [max(g, key=lambda row: row[0].above_db) for g in groups]
    out = []
    for i, (peak, axis) in enumerate(tops):
        apart = min((abs(peak.freq_hz - t[0].freq_hz) for k, t in enumerate(tops) if k != i), default=math.inf)
        width = min(max(0.15 * peak.freq_hz, 8 * step), 0.6 * apart, 0.9 * peak.freq_hz)
        mode = spectra.NO_MODE
        if stretch.valid.mean() > 0.98:
            mode = spectra.fit_mode(stretch.x[:, axis], stretch.rate_hz, peak.freq_hz, width, accelerations=True)
        if not _same(peak.freq_hz, mode.freq_hz, step):
            mode = spectra.NO_MODE
        near = [
            min(
                (f for f in found if _same(peak.freq_hz, f, step)),
                key=lambda f: abs(f - peak.freq_hz),
                default=math.nan,
            )
            for found in other
        ]
        fitted = math.isfinite(mode.freq_hz)
        out.append(
            Frequency(
                mode.freq_hz if fitted else peak.freq_hz,
                mode.std_freq_hz,
                mode.damping,
                mode.std_damping,
                "".join("xyz"[a] for a in sorted({a for _, a in groups[i]})),
                peak.above_db,
                near[0],
                near[1],
            )
        )
    return out


# --------------------------------------------------------------------------------------------------------- closer looks


def _close_looks(p: PointFigures) -> list[Close]:
    """Full-rate samples around the furthest displacement of each axis from the reference, which is zero."""
    out = []
    for axis in range(3):
        low, high = p.low[axis], p.high[axis]
        if low is not None and high is not None:
            out.append(p.looks[axis, high.value_m > -low.value_m])
    return out


def _place(files: Sequence[Path], receiver: str) -> tuple[float, float, float] | None:
    """The first position that a receiver gave."""
    topic = f"/gnss/{receiver}/solution"
    for path in files[:20]:
        try:
            s = next(read_messages(path, {topic}), None)
        except (OSError, DamagedError):
            continue
        if s is not None:
            v = topics.decode(s.schema, s.data)
            return float(v["latitude_deg"]), float(v["longitude_deg"]), float(v["height_m"])
    return None


def _apart_places(review: Review) -> dict[str, float]:
    """How far [m] each receiver stands apart in files of different configurations, where that is further than FAR_M."""
    out = {}
    for name in review.config.receivers if len(review.setups) > 1 else ():
        places = [at for s in review.setups if (at := _place(s.files[:1], name)) is not None]
        far = max((math.dist(geodetic_to_ecef(*places[0]), geodetic_to_ecef(*at)) for at in places[1:]), default=0.0)
        if far > FAR_M:
            out[name] = far
    return out


def _questions(p: PointFigures) -> None:
    """What needs all samples at once, asked of the busiest minutes."""
    if p.busy is None:
        return
    t, z, std = p.busy.fixes
    good = _rising(t)
    if p.busy.trusted:
        good &= p.busy.taken
    t, z, std = t[good], z[good], std[good]
    fixes = plain(t, z, np.where(np.isfinite(std) & (std > 0), std, 0.01))
    accel = Accelerations(*p.busy.accel)
    try:
        p.agreement = with_speeds(agree(fixes, accel), fixes, p.busy.velocity_mps[good], accel)
    except ValueError as e:
        p.notes.append(f"sensors not compared: {e}")
    try:
        p.split = split_fusion(fixes, accel)
    except ValueError as e:
        p.notes.append(f"not split by frequency: {e}")
    t_f, d, _ = p.busy.fused
    good = _rising(t_f)
    t_f, d = t_f[good], d[good]
    if p.split is not None:
        p.apart = apart(p.split, t, (t_f, d))
    if len(t_f) > 200 and p.frequencies:
        low, high = 0.5 * p.frequencies[0].freq_hz, 1.5 * p.frequencies[-1].freq_hz
        try:
            p.checks = check(fixes, accel, (t_f, d), low, high)
        except ValueError as e:
            p.notes.append(f"not integrated: {e}")
    p.wavelets = wavelets((t_f, d), (t, z), [f.freq_hz for f in p.frequencies], p.busy.utc_minus_ns)


def modes_of(p: Point) -> dict[str, float]:
    """Share of samples in each mode."""
    total = sum(p.modes.values()) or 1
    return {Mode(k).name: n / total for k, n in sorted(p.modes.items())}


def gaps_of(review: Review, stream: Stream) -> list[tuple[int, int, str]]:
    """Silences of a stream with reasons, from the begin of the record to its end."""
    known = [(g.begin_ns, g.end_ns, g.reason) for g in review.verdict.gaps]
    return [(s.begin_ns, s.end_ns, s.reason) for s in review.overview.why(stream, known)]


__all__ = ["ReplayError", "Review", "gather"]
