"""`edge-agent tune`: settings by maximum likelihood of what was recorded, with sd, and the gain they would bring.

Of each point some stretches are kept: those that moved most and some spread evenly over the record, so time and memory
do not grow with the folder. Every second stretch in time is for fitting, the others judge. Per axis the likelihood of
the fixes one step ahead gives the densities q and qb and the factor r on the variance of the fixes (Shan & Qi; here
with a bias walk); their sd comes from its curvature. Clock and mounting are those of `agree`.

A key is proposed only if the other half of the stretches gains by it. The live filter finds much of its noise by
itself, so its figures are judged against what it would settle at with the configured ones, not against those. What is
left alone says why. The gain over the live stream as recorded is told beside: the whole effect on the same fixes.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import yaml

from edge_agent.messages import F64, I64, Config, FusionSettings, Quality, S, Verdict
from edge_agent.replay import ReplayError, recorded_config
from edge_agent.review.agree import Agreement, agree, turned
from edge_agent.review.likelihood import SKIP, gains, prepare, whiten
from edge_agent.review.series import Piece, pieces
from edge_agent.review.smooth import NO_ACCELERATIONS, NS, Accelerations, Fixes, increments, plain
from edge_agent.review.sources import one_site, opened

STRETCH_S = (60.0, 600.0)
"""A stretch is at least so long, longer where fixes are rare,"""
STRETCH_FIXES = (60, 600)
"""has at least so many fixes and ends with so many."""
BUSY, SPREAD = 4, 6
"""Stretches kept of each point: those that moved most, and at most so many evenly over the record."""
SETTLE_S = 15.0
"""A stretch's filter starts from nothing: its first seconds do not count."""
TRUSTED = 0.6
"""Where the gate took a smaller share of the fixes than this, it may be the gate that is wrong: all are used."""
CUT_S, CUT = 10.0, 10.5
"""Where no fix was used for so long and so many usual intervals, a stretch ends: behind it may be another level."""
KNOWN = 0.5
"""Largest sd of log10 q or qb that counts as found."""
GRID = ((6.0, 9), (1.5, 7), (0.4, 7), (0.1, 5))
"""Half width in decades and points of the search in q and qb, each about the best before."""
SURE, LEAST = 3.0, 5.0
"""A gain in log likelihood counts beyond so many of its sd, and above so much."""
BLOCK_S = 10.0
"""Gains of neighbouring fixes are not independent; those of so long nearly are."""
CLOCK_MS, YAW_DEG = 2.0, 1.0
"""Smaller errors of clock and yaw are left alone."""
REACH = 0.5
"""Share of the prior's decades that an estimate may be off its centre: the filter is made to find that by itself."""
FARTHEST = 3.0
"""sd of the scatter of estimates over axes and points, in units of the prior's, before the prior is told too narrow."""
AXES = "xyz"


@dataclass(frozen=True, slots=True)
class Stretch:
    """Some minutes of a point: fixes with the sd that the live filter used, accelerations, `said_m` (3,) the median of
    what the receiver said of its sd (NaN = nothing), mean latency [s]; per fix (n, 3) the live innovation and its sd,
    NaN where the live filter did not take it."""

    begin_ns: int
    fixes: Fixes
    accel: Accelerations
    said_m: F64
    latency_s: float
    live: F64
    live_std: F64
    power: float

    @property
    def counted(self) -> npt.NDArray[np.bool_]:
        """Fixes (n,) that judge."""
        k: npt.NDArray[np.bool_] = (self.fixes.t_ns - self.fixes.t_ns[0]) * NS > SETTLE_S
        k[:SKIP] = False
        return k & np.isfinite(self.live).all(axis=1)


class _Keeper:
    """Cuts a point's record into stretches and keeps the busiest and some spread ones."""

    def __init__(self, receiver: str, accelerometer: str, point: str) -> None:
        self.receiver, self.accelerometer, self.point = receiver, accelerometer, point
        self.busy: list[Stretch] = []
        self.spread: list[Stretch] = []
        self.moved: Stretch | None = None  # the busiest in which the filter moved its level: it says nothing of noise
        self._every, self._seen = 1, 0
        self._run = ""
        self._clear()

    def _clear(self) -> None:
        self._fixes: list[tuple[Any, ...]] = []
        self._judged: list[tuple[Any, ...]] = []
        self._accel: list[tuple[I64, F64]] = []
        self._count, self._begin, self._moved = 0, -1, False

    def add(self, p: Piece) -> None:
        if p.run != self._run:
            self.close()
            self._run = p.run
        self._moved |= any(h.source == self.point and h.kind in ("DATUM", "REACQUIRE") for h in p.happened)
        f, j, a = p.fixes.get(self.receiver), p.judged.get(self.point), p.accelerations.get(self.accelerometer)
        if a is not None and len(a.t_ns):
            self._accel.append((a.t_ns, a.xyz))
        if f is not None and len(f.t_ns):
            good = (f.quality == Quality.FIXED) & np.isfinite(f.z_m).all(axis=1)
            if good.any():
                self._fixes.append((f.t_ns[good], f.z_m[good], f.std_m[good], f.latency_s[good]))
        if j is not None and len(j.t_ns):
            self._judged.append((j.t_ns, j.std_m, j.residual_m, j.std_residual_m, j.verdict))
            self._count += len(j.t_ns)
            self._begin = int(j.t_ns[0]) if self._begin < 0 else self._begin
            long = (int(j.t_ns[-1]) - self._begin) / S
            full = long >= STRETCH_S[0] and self._count >= STRETCH_FIXES[1]
            if full or not 0 <= long < STRETCH_S[1]:
                self.close()
        elif self._begin < 0 and self._held_s() > STRETCH_S[1]:  # no verdicts: nothing to keep it for
            self._clear()

    def _held_s(self) -> float:
        """How long what waits goes back."""
        return max(
            (float(rows[-1][0][-1] - rows[0][0][0]) * NS for rows in (self._accel, self._fixes) if rows), default=0
        )

    def close(self) -> None:
        made = self._made() if self._fixes and self._judged else None
        moved = self._moved
        self._clear()
        if made is None:
            return
        if moved:
            if self.moved is None or made.power > self.moved.power:
                self.moved = made
            return
        self.busy = sorted([*self.busy, made], key=lambda s: -s.power)[:BUSY]
        if self._seen % self._every == 0:
            self.spread.append(made)
        self._seen += 1
        if len(self.spread) > SPREAD:
            self.spread = self.spread[::2]
            self._every *= 2

    def _made(self) -> Stretch | None:
        t, z, said, late = (np.concatenate(c) for c in zip(*self._fixes, strict=True))
        u, std, e, sd, verdict = (np.concatenate(c) for c in zip(*self._judged, strict=True))
        gated = np.isin(verdict, (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.OFFSET))
        u, std, e, sd, verdict = u[gated], std[gated], e[gated], sd[gated], verdict[gated]
        if len(u) < STRETCH_FIXES[0] or not len(t):
            return None
        k = np.minimum(np.searchsorted(t, u), len(t) - 1)
        taken = verdict == Verdict.ACCEPTED
        good = t[k] == u
        if taken[good].mean() >= TRUSTED:
            good &= taken
        good[1:] &= u[1:] > np.maximum.accumulate(u)[:-1]
        if not self._moved:
            good &= _longest(u, good)
        k, u = k[good], u[good]
        if len(u) < STRETCH_FIXES[0]:
            return None
        used = taken[good, None] & (sd[good] > 0)
        accel = NO_ACCELERATIONS
        if self._accel:
            ta, xyz = (np.concatenate(c) for c in zip(*self._accel, strict=True))
            rising = np.ones(len(ta), np.bool_)
            rising[1:] = ta[1:] > np.maximum.accumulate(ta)[:-1]
            rising &= np.isfinite(xyz).all(axis=1)
            accel = Accelerations(ta[rising], xyz[rising])
        if self.accelerometer and len(accel.t_ns) < 2 * len(u):
            return None  # mostly without: another model
        size = accel.xyz if len(accel.t_ns) else z[k]
        power = float(np.diff(size, axis=0).std(axis=0).sum())
        with np.errstate(all="ignore"):
            heard = np.isfinite(said[k]).any(axis=0)
            middle = np.array([np.nanmedian(said[k, i]) if heard[i] else math.nan for i in range(3)])
        finite = late[k][np.isfinite(late[k])]
        return Stretch(
            int(u[0]), plain(u, z[k], std[good]), accel, middle, float(finite.mean()) if len(finite) else math.nan,
            np.where(used, e[good], np.nan), np.where(used, sd[good], np.nan), power,
        )  # fmt: skip

    def halves(self) -> tuple[list[Stretch], list[Stretch]]:
        """Stretches to fit and stretches to judge, in turn; a single one is cut in two."""
        every = sorted({s.begin_ns: s for s in (*self.busy, *self.spread)}.values(), key=lambda s: s.begin_ns)
        if len(every) == 1:
            every = _cut(every[0])
        return every[::2], every[1::2]


def _longest(t: I64, good: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """The longest part of the good ones among t without a cut."""
    k = np.flatnonzero(good)
    out = np.zeros(len(t), np.bool_)
    if len(k) < 2:
        return out
    steps = np.diff(t[k])
    far = max(CUT_S * S, CUT * float(np.median(steps)))
    edges = [0, *(np.flatnonzero(steps > far) + 1).tolist(), len(k)]
    begin, end = max(pairwise(edges), key=lambda e: e[1] - e[0])
    out[k[begin:end]] = True
    return out


def _cut(s: Stretch) -> list[Stretch]:
    n = len(s.fixes)
    if n < 2 * STRETCH_FIXES[0]:
        return [s]
    out = []
    for k in (slice(0, n // 2), slice(n // 2, n)):
        part = s.fixes.part(k.start, k.stop)
        inside = (s.accel.t_ns >= part.t_ns[0] - S) & (s.accel.t_ns <= part.t_ns[-1] + S)
        accel = Accelerations(s.accel.t_ns[inside], s.accel.xyz[inside])
        out.append(Stretch(int(part.t_ns[0]), part, accel, s.said_m, s.latency_s, s.live[k], s.live_std[k], s.power))
    return out


# ---------------------------------------------------------------------------------------------------------- likelihood


class Noise(NamedTuple):
    """Per axis (3,): q [m2/s3], qb [m2/s5], factor r on the variance of the fixes."""

    q: F64
    qb: F64
    r: F64


class _Ready(NamedTuple):
    """A stretch as the filter takes it: arrays (n, 3), and what gaps add to q."""

    dt: F64
    z: F64
    std: F64
    s1: F64
    s2: F64
    gap: F64
    counted: npt.NDArray[np.bool_]


def ready(s: Stretch, accel: Accelerations | None = None) -> _Ready:
    """Integrate the accelerations of a stretch, or others in their place."""
    a = s.accel if accel is None else accel
    inc = increments(s.fixes.t_ns, a, np.nanmean(a.xyz, axis=0) if len(a.t_ns) else np.zeros(3))
    none = np.zeros((1, 3))
    gap = np.concatenate([none, inc.extra.T]) if len(a.t_ns) else np.zeros((len(s.fixes), 3))
    s1, s2 = np.concatenate([none, inc.s1.T]), np.concatenate([none, inc.s2.T])
    return _Ready(*prepare(s.fixes), s1, s2, gap, s.counted)


def _run(p: _Ready, axis: F64, q: F64, qb: F64, r: F64) -> tuple[F64, F64]:
    """Innovation^2 / r and log of its variance in units of r, (n, G), for lanes G: axis number, q, qb, r of each."""
    std = p.std[:, axis.astype(np.int64)]
    lane = axis.astype(np.int64)
    g = gains(p.dt, std, (q + p.gap[:, lane]) / r, np.broadcast_to(qb / r, std.shape))
    e = whiten(g, p.s1[:, None, lane], p.s2[:, None, lane], p.z[:, None, lane])[:, 0]
    seen = p.counted[:, None] & np.isfinite(std)
    return np.where(seen, e * e, np.nan), np.where(seen, np.log(g.variance), np.nan)


def likelihood(parts: Sequence[_Ready], axis: F64, q: F64, qb: F64, r: F64) -> F64:
    """Log likelihood (G,) of all parts."""
    total = np.zeros(len(q))
    for p in parts:
        e2, log_s = _run(p, axis, q, qb, r)
        total += np.nansum(-0.5 * (np.log(2 * math.pi * r) + log_s + e2 / r), axis=0)
    return total


def most_likely(parts: Sequence[_Ready]) -> tuple[Noise, F64]:
    """Noise per axis, and sd (3, 3) of log q, log qb, log r per axis in the last index; inf = not to be found."""
    usual = float(np.median(np.concatenate([p.dt[1:] for p in parts])))
    std = np.concatenate([np.where(np.isfinite(p.std), p.std, np.nan) for p in parts])
    declared = np.nanmedian(std, axis=0) ** 2
    centre = np.array([np.log(declared / usual**3) - 2 * math.log(10), np.log(declared / usual**5) - 5 * math.log(10)])
    best, r_best = np.full(3, -np.inf), np.ones(3)
    for span, count in GRID:
        steps = math.log(10) * np.linspace(-span, span, count)
        a, b = (m.ravel() for m in np.meshgrid(steps, steps))
        axis = np.tile(np.arange(3.0), a.size)
        q = np.exp(centre[0] + a[:, None]).ravel()
        qb = np.exp(centre[1] + b[:, None]).ravel()
        guess = np.tile(r_best, a.size)  # gaps and blows are absolute: they need an r before there is one
        n, e2, logs = np.zeros(q.size), np.zeros(q.size), np.zeros(q.size)
        for p in parts:
            one, log_s = _run(p, axis, q * guess, qb * guess, guess)
            n += np.isfinite(one).sum(axis=0)
            e2 += np.nansum(one, axis=0)
            logs += np.nansum(log_s, axis=0)
        r = np.maximum(e2 / np.maximum(n, 1), 1e-12)
        value = (-0.5 * (n * (np.log(2 * math.pi * r) + 1) + logs)).reshape(-1, 3)
        for i in range(3):
            k = int(np.argmax(value[:, i]))
            if value[k, i] >= best[i] or span == GRID[0][0]:
                best[i], r_best[i] = value[k, i], r.reshape(-1, 3)[k, i]
                centre[:, i] = math.log(q.reshape(-1, 3)[k, i]), math.log(qb.reshape(-1, 3)[k, i])
    found = Noise(np.exp(centre[0]) * r_best, np.exp(centre[1]) * r_best, r_best)
    return found, _spread(parts, found)


def _spread(parts: Sequence[_Ready], at: Noise) -> F64:
    """sd (3, 3) of log q, log qb, log r by the curvature of the likelihood at its top."""
    h = np.array([0.3, 0.3, 0.05])
    moves = [(i, j, a, b) for i in range(3) for j in range(i + 1) for a in (-1, 1) for b in (-1, 1)]
    shift = np.zeros((len(moves) + 1, 3))
    for k, (i, j, a, b) in enumerate(moves, 1):
        shift[k, i] += a * h[i]
        shift[k, j] += b * h[j]
    axis = np.tile(np.arange(3.0), len(shift))
    q, qb, r = (
        (v * np.exp(shift[:, i])[:, None]).ravel() for i, v in enumerate((at.q, at.qb, np.maximum(at.r, 1e-12)))
    )
    value = likelihood(parts, axis, q, qb, r).reshape(-1, 3)
    out = np.full((3, 3), np.inf)
    for c in range(3):
        H = np.zeros((3, 3))
        f = {m: float(value[k, c]) for k, m in enumerate(moves, 1)}
        for i in range(3):
            for j in range(i + 1):
                across = (f[i, j, 1, 1] - f[i, j, 1, -1] - f[i, j, -1, 1] + f[i, j, -1, -1]) / (4 * h[i] * h[j])
                H[i, j] = H[j, i] = across
        free = [i for i in range(3) if H[i, i] < -0.2]  # flatter than that, nothing holds it
        if not free:
            continue
        try:
            cov = np.linalg.inv(-H[np.ix_(free, free)])
        except np.linalg.LinAlgError:
            continue
        good = np.diag(cov) > 0
        out[np.array(free)[good], c] = np.sqrt(np.diag(cov)[good])
    for i in (0, 1):  # a density that could as well be nothing, the others making up for it, is not found
        shift = np.array([(a, b) for a in (0.0, 0.5, 1.0, 2.0, 4.0) for b in (0.0, 0.04)])
        moved = [np.tile(v, (len(shift), 1)) for v in (at.q, at.qb, np.maximum(at.r, 1e-12))]
        moved[i] *= 1e-3
        moved[1 - i] *= np.exp(shift[:, :1])
        moved[2] *= np.exp(shift[:, 1:])
        axis = np.tile(np.arange(3.0), len(shift))
        less = likelihood(parts, axis, *(m.ravel() for m in moved)).reshape(-1, 3).max(axis=0)
        out[i, value[0] - less < 0.5 * SURE**2] = np.inf
    return out


def scores(p: _Ready, noise: Noise) -> tuple[F64, F64]:
    """Per fix (n, 3): log likelihood and innovation [m]; NaN where it does not count."""
    r = np.maximum(noise.r, 1e-12)
    e2, log_s = _run(p, np.arange(3.0), noise.q, noise.qb, r)
    return -0.5 * (np.log(2 * math.pi * r) + log_s + e2 / r), np.sqrt(e2 * np.exp(log_s))


class Gain(NamedTuple):
    """Log likelihood won, its sd, and over how many fixes."""

    value: float
    std: float
    fixes: int

    @property
    def sure(self) -> bool:
        return self.value > max(SURE * self.std, LEAST)


def gain(parts: Sequence[Stretch], one: Sequence[F64], two: Sequence[F64]) -> Gain:
    """Of scores two over scores one, (n, 3) of each stretch; fixes that only one of them scored are left out."""
    blocks: list[float] = []
    n = 0
    for s, a, b in zip(parts, one, two, strict=True):
        d = np.nansum(b - a, axis=1)
        seen = np.isfinite(b - a).any(axis=1)
        n += int(seen.sum())
        at = ((s.fixes.t_ns - s.fixes.t_ns[0]) // round(BLOCK_S * S)).astype(np.int64)
        blocks += np.bincount(at[seen], d[seen]).tolist() if seen.any() else []
    each = np.array([b for b in blocks if b])
    sd = math.sqrt(len(each)) * float(each.std(ddof=1)) if len(each) > 2 else math.inf
    return Gain(float(each.sum()), sd, n)


# ------------------------------------------------------------------------------------------------------------ proposals


@dataclass(frozen=True, slots=True)
class Proposal:
    """One key: what stands there, what the data say with sd (in words), the gain on stretches it was not fitted to.
    `keep`: leave it as it is, `why` says so."""

    key: str
    old: Any
    new: Any
    std: str
    gain: Gain | None
    keep: bool
    why: str


@dataclass(frozen=True, slots=True)
class Fitted:
    """A point: stretches and fixes fitted and judged, noise with sd of its logarithms (3, 3) by q, qb, r, what `agree`
    said; on the judging half log likelihood won over the live stream as recorded, rms (3,) of innovations then and now
    [m]."""

    stretches: tuple[int, int]
    fixes: tuple[int, int]
    noise: Noise
    spread: F64
    std_m: F64
    agreement: Agreement | None
    over_live: Gain
    rms_live_m: F64
    rms_m: F64


@dataclass
class Tuning:
    """Everything that `tune` tells."""

    files: list[Path]
    config: Config
    points: dict[str, Fitted] = field(default_factory=dict)
    proposals: list[Proposal] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def changes(self) -> list[Proposal]:
        return [p for p in self.proposals if not p.keep]

    @property
    def sets(self) -> list[str]:
        """As `--set` takes them."""
        return [
            f"{p.key}={yaml.safe_dump(p.new, default_flow_style=True, width=10_000).split(chr(10))[0]}"
            for p in self.changes
        ]


class _Fit(NamedTuple):
    """What is known of a point while proposals are made."""

    name: str
    fit: list[Stretch]
    judge: list[Stretch]
    parts_judge: list[_Ready]
    noise: Noise
    spread: F64


def tune(inputs: Sequence[Path], progress: Callable[[str], None] | None = None) -> Tuning:
    """Read recordings with a fused stream. ReplayError where there is none, OSError for a path that is not there."""

    def say(text: str) -> None:
        if progress is not None:
            progress(text)

    found = opened(inputs)
    one_site(found)
    files, bad, config, _ = found
    out = Tuning(files, config)
    out.notes += [f"{p.name} is left out: {why}" for p, why in sorted(bad.items())]
    keepers = {
        name: _Keeper(p.receiver, p.accelerometer or "", name) for name, p in config.points.items() if p.receiver
    }
    if not keepers:
        raise ReplayError("no point has a receiver: there are no fixes to judge settings by")
    total = sum(f.stat().st_size for f in files) or 1
    done, current = 0, files[0]
    fused = False
    for piece in pieces(files, config, accelerations=any(k.accelerometer for k in keepers.values())):
        if piece.path != current:
            done, current = done + current.stat().st_size, piece.path
        say(f"reading {piece.path.name}, {100 * done // total} %")
        fused |= bool(piece.judged)
        for k in keepers.values():
            k.add(piece)
        if piece.damage:
            out.notes.append(f"{piece.path.name} ends early: {piece.damage}")
    if not fused:
        again = shlex.join(["edge-agent", "replay", *map(str, files), "-o", "fused.mcap"])
        raise ReplayError(f"no fused stream in these files, so nothing to tune; make one: {again}")
    fits = []
    for name, k in keepers.items():
        k.close()
        say(f"{name}: fitting")
        a, b = k.halves()
        if not a or not b:
            out.notes.append(f"{name}: {_why_not(k)}")
            continue
        fits.append(_point(out, name, k, a, b))
    _noise(out, [f for f in fits if keepers[f.name].accelerometer], True)
    _noise(out, [f for f in fits if not keepers[f.name].accelerometer], False)
    _receivers(out, fits)
    if out.changes:
        recorded_config(files[0], out.sets)  # what is proposed is what the configuration takes
    for name, fitted in out.points.items():
        if fitted.over_live.sure and not out.changes:
            text = (
                "the fitted noise predicts the fixes better than the live filter did, but no key is sure to bring that"
            )
            out.notes.append(f"{name}: {text}; `review` tells what held it up (start, jumps, contradiction)")
    return out


def _why_not(k: _Keeper) -> str:
    """Why nothing can be fitted to a point."""
    if k.moved is None:
        return "too few fixes that the gate took, nothing is said of it"
    why = "the filter moved its level (DATUM, REACQUIRE) whenever there were fixes enough: no noise explains that"
    if k.accelerometer:
        try:
            said = agree(k.moved.fixes, k.moved.accel)
        except ValueError:
            return why
        if said.verdict == "CONTRADICTION":
            return f"{said.text}; mend that first, no setting does"
    return why


def _point(out: Tuning, name: str, k: _Keeper, a: list[Stretch], b: list[Stretch]) -> _Fit:
    """Clock, mounting, then noise of one point."""
    said = None
    change: tuple[float, F64] | None = None
    if k.accelerometer:
        busiest = max(a, key=lambda s: s.power)
        try:
            said = agree(busiest.fixes, busiest.accel)
        except ValueError as e:
            out.notes.append(f"{name}: sensors not compared: {e}")
        else:
            change = _alignment(out, name, k, said, a, b)

    def aligned(s: Stretch) -> _Ready:
        return ready(s, turned(s.accel, *change)) if change is not None else ready(s)

    parts_a, parts_b = [aligned(s) for s in a], [aligned(s) for s in b]
    noise, spread = most_likely(parts_a)
    live = [
        np.where(
            s.counted[:, None],
            -0.5 * (np.log(2 * math.pi * s.live_std**2) + (s.live / s.live_std) ** 2),
            np.nan,
        )
        for s in b
    ]
    mine = [scores(p, noise) for p in parts_b]
    won = gain(b, live, [m[0] for m in mine])
    rms_live = np.sqrt(np.nanmean(np.concatenate([s.live[s.counted] for s in b]) ** 2, axis=0))
    rms = np.sqrt(np.nanmean(np.concatenate([m[1] for m in mine]) ** 2, axis=0))
    used = np.nanmedian(np.concatenate([s.fixes.std_m for s in a]), axis=0)
    counts = (sum(int(s.counted.sum()) for s in a), sum(int(s.counted.sum()) for s in b))
    out.points[name] = Fitted(
        (len(a), len(b)), counts, noise, spread, np.sqrt(noise.r) * used, said, won, rms_live, rms
    )
    return _Fit(name, a, b, parts_b, noise, spread)


def _alignment(
    out: Tuning, name: str, k: _Keeper, said: Agreement, a: list[Stretch], b: list[Stretch]
) -> tuple[float, F64] | None:
    """Propose latency and rotation where both sensors tell of them; return what is to be done to the accelerations."""
    offset, rotation = 0.0, np.eye(3)
    o, m = said.offset, said.mounting
    if o.observable and abs(o.value_s) > max(SURE * o.std_s, 1e-3 * CLOCK_MS):
        offset = o.value_s
    axes = any(found not in ("?", want) for found, want in zip(m.axes, ("+x", "+y", "+z"), strict=True))
    if "?" not in m.axes and axes:
        order = np.array([[(1.0 if a[0] == "+" else -1.0) * (a[1] == b) for b in AXES] for a in m.axes])
        if np.linalg.det(order) < 0:
            out.notes.append(f"{name}: {k.accelerometer} is mirrored: one of its axes has the wrong sign")
        else:
            rotation = _about_z(m.matrix @ order.T, float(m.std.max())) @ order
    elif m.observable:
        rotation = _about_z(m.matrix, math.radians(m.std_yaw_deg))
    before = [ready(s) for s in b]
    base, _ = most_likely([ready(s) for s in a])
    settings = out.config.receivers[k.receiver]
    key = f"receivers.{k.receiver}.latency_ms"
    latency = 1e3 * float(np.mean([s.latency_s for s in (*a, *b)]))
    shown = settings.latency_ms if settings.latency_ms is not None else round(latency, 1)
    sd = f"+- {1e3 * o.std_s:.1f} ms" if o.observable else ""
    told = [scores(p, base)[0] for p in before]

    def better(offset_s: float, turn: F64) -> Gain:
        moved = [ready(s, turned(s.accel, offset_s, turn)) for s in a]
        after, _ = most_likely(moved)
        return gain(b, told, [scores(ready(s, turned(s.accel, offset_s, turn)), after)[0] for s in b])

    if not offset and np.array_equal(rotation, np.eye(3)):
        why = f"{1e3 * o.value_s:+.1f} ms left" if o.observable else o.why.removeprefix("not observable: ")
        out.proposals.append(Proposal(key, shown, shown, sd, None, True, why))
        mount = "found as configured" if m.observable else m.why.removeprefix("not observable: ")
        old = [list(row) for row in out.config.accelerometers[k.accelerometer].rotation]
        out.proposals.append(Proposal(f"accelerometers.{k.accelerometer}.rotation", old, old, "", None, True, mount))
        return None
    won = better(offset, rotation)
    if not won.sure:
        why = "the other stretches do not bear a change out"
        out.proposals.append(Proposal(key, shown, shown, sd, won, True, why))
        return None
    if offset:
        new = round(latency + 1e3 * offset, 1)
        if any(p.key == key and not p.keep for p in out.proposals):
            out.notes.append(f"{name}: {k.accelerometer}'s clock is off by {offset:+.3f} s beside another point's")
        elif 0 <= new <= 10_000:
            why = f"fixes are {abs(1e3 * offset):.1f} ms {'late' if offset > 0 else 'early'} against the accelerations"
            out.proposals.append(Proposal(key, shown, new, sd, won, False, why))
        else:
            early = "early" if offset > 0 else "late"
            out.notes.append(f"{name}: {k.accelerometer}'s clock is {abs(offset):.3f} s {early}: no key mends that")
    if not np.array_equal(rotation, np.eye(3)):
        old = [list(row) for row in out.config.accelerometers[k.accelerometer].rotation]
        u, _, v = np.linalg.svd(rotation @ np.array(old))
        new_rows = [[round(float(x), 6) for x in row] for row in (u @ v).tolist()]
        told_sd = f"+- {m.std_yaw_deg:.1f} deg" if math.isfinite(m.std_yaw_deg) else ""
        why = f"axes stand as {' '.join(m.axes)}" if axes else f"turned by {m.yaw_deg:.1f} deg"
        out.proposals.append(
            Proposal(f"accelerometers.{k.accelerometer}.rotation", old, new_rows, told_sd, won, False, why)
        )
    return offset, rotation


def _about_z(matrix: F64, std: float) -> F64:
    """The turn about z in a matrix (3, 3) near one; none where it is small against its sd [rad]."""
    yaw = math.atan2(float(matrix[1, 0] - matrix[0, 1]), float(matrix[0, 0] + matrix[1, 1]))
    if abs(yaw) < max(math.radians(YAW_DEG), SURE * std):
        return np.eye(3)
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _settled(found: F64, sd: F64, centre: float, decades: float, scale: float) -> F64:
    """Where the live bank would settle: the logarithm's mean of the prior and of what it sees in its memory, which is
    `scale` of the fitted record."""
    p = math.log(10.0) * decades
    s2 = np.where(np.isfinite(sd), sd, 1e6) ** 2 / scale
    return np.asarray(np.exp((np.log(found) / s2 + math.log(centre) / p**2) / (1 / s2 + 1 / p**2)))


def _noise(out: Tuning, fits: list[_Fit], aided: bool) -> None:
    """q and qb, one pair of figures for all points of a kind."""
    if not fits:
        return
    s = out.config.fusion
    names = ("accel_noise_m2ps3", "bias_walk_m2ps5") if aided else ("gnss_only_q_m2ps3", "gnss_only_qb_m2ps5")
    units = ("m2/s3", "m2/s5")
    each = [np.stack([f.noise.q, f.noise.qb]) for f in fits]
    sds = [f.spread[:2] for f in fits]
    logs, sd = np.log(np.concatenate(each, axis=1)), np.concatenate(sds, axis=1)
    for i, (name, unit) in enumerate(zip(names, units, strict=True)):
        key, old = f"fusion.{name}", float(getattr(s, name))
        good = sd[i] < math.log(10) * KNOWN
        if not good.any():
            why = "the data do not tell it: other noise is larger"
            out.proposals.append(Proposal(key, old, old, "", None, True, why))
            continue
        w = 1 / sd[i, good] ** 2
        mean = float((w * logs[i, good]).sum() / w.sum())
        scatter = float(np.sqrt((w * (logs[i, good] - mean) ** 2).sum() / w.sum())) if good.sum() > 1 else 0.0
        spread = math.hypot(1 / math.sqrt(float(w.sum())), scatter / math.sqrt(float(good.sum())))
        new = float(f"{math.exp(mean):.3g}")
        gains_ = [_judged(s, f, i, math.exp(mean), aided) for f in fits]
        won = Gain(sum(g.value for g in gains_), math.sqrt(sum(g.std**2 for g in gains_)), sum(g.fixes for g in gains_))
        told = f"x/: {math.exp(spread):.2f}"
        decades = s.accel_noise_decades if i == 0 else s.bias_walk_decades
        off = abs(math.log10(new / old))
        if won.sure and off > max(spread / math.log(10), REACH * decades):
            why = f"{off:.1f} decades away, the prior gives {decades:g}"
            out.proposals.append(Proposal(key, old, new, f"{told} {unit}", won, False, why))
        else:
            why = f"the data say {new:g}; the filter finds it by itself"
            out.proposals.append(Proposal(key, old, old, told, won, True, why))
        wide = scatter / math.log(10)
        if aided and wide > FARTHEST * decades:
            key = f"fusion.{'accel_noise' if i == 0 else 'bias_walk'}_decades"
            why = f"axes and points differ by {wide:.2g} decades"
            out.proposals.append(Proposal(key, decades, round(min(wide, 6.0), 1), "", won, False, why))


def _judged(s: FusionSettings, f: _Fit, which: int, proposed: float, aided: bool) -> Gain:
    """Gain on the judging half of settling with the proposed centre over settling with the configured one."""
    seconds = sum(float(x.fixes.t_ns[-1] - x.fixes.t_ns[0]) for x in f.fit) * NS
    scale = s.bank_memory_s / max(seconds, 1.0)
    if aided:
        centres = [s.accel_noise_m2ps3, s.bias_walk_m2ps5]
    else:
        centres = [s.gnss_only_q_m2ps3, s.gnss_only_qb_m2ps5]
    decades = (s.accel_noise_decades, s.bias_walk_decades)

    def settled(at: list[float]) -> Noise:
        q, qb = (_settled(v, f.spread[i], at[i], decades[i], scale) for i, v in enumerate((f.noise.q, f.noise.qb)))
        return Noise(q, qb, f.noise.r)

    other = list(centres)
    other[which] = proposed
    return gain(
        f.judge,
        [scores(p, settled(centres))[0] for p in f.parts_judge],
        [scores(p, settled(other))[0] for p in f.parts_judge],
    )


def _receivers(out: Tuning, fits: list[_Fit]) -> None:
    """The scale of the fixes' noise: the live filter follows it between r_least and r_most about what the receiver
    says or the floor. What lies beyond its reach needs a key."""
    s, c = (f(math.radians(out.config.structure.azimuth_deg)) for f in (math.sin, math.cos))
    low, high = math.sqrt(out.config.fusion.r_least), math.sqrt(out.config.fusion.r_most)

    def across(v: Sequence[float]) -> F64:
        """sd along x, y, z of sd along E, N, U, and back."""
        return np.array([math.hypot(s * v[0], c * v[1]), math.hypot(c * v[0], s * v[1]), v[2]])

    for receiver, settings in out.config.receivers.items():
        mine = [f for f in fits if out.config.points[f.name].receiver == receiver]
        if not mine:
            continue
        f = mine[0]
        key = f"receivers.{receiver}.sigma_floor_m"
        old = list(settings.sigma_floor_m)
        used = np.nanmedian(np.concatenate([x.fixes.std_m for x in f.fit]), axis=0)
        found = np.sqrt(f.noise.r) * used
        said = np.stack([x.said_m for x in f.fit])
        heard = np.isfinite(said).all(axis=0)
        declared = np.where(heard, np.median(np.where(heard, said, 0.0), axis=0), np.nan)
        floor = across(old)
        share = found / np.maximum(declared, floor)
        sd = f.spread[2] / 2 * found
        told = "+- " + "/".join(f"{1e3 * v:.2f}" for v in sd) + " mm"
        why = "the fixes scatter by " + "/".join(f"{1e3 * v:.2f}" for v in found) + " mm"
        if heard.all():
            why += ", " + "/".join(f"{v:.2f}" for v in share) + " x what is declared"
        one = Noise(f.noise.q, f.noise.qb, np.ones(3))
        won = gain(f.judge, [scores(p, one)[0] for p in f.parts_judge], [scores(p, f.noise)[0] for p in f.parts_judge])
        known = bool((f.spread[2] < KNOWN).all()) and won.sure
        if known and (share > high).any():
            new = [float(f"{max(v, o):.3g}") for v, o in zip(across(found.tolist()), old, strict=True)]
            why += f"; the filter reaches {high:.3g} x"
            out.proposals.append(Proposal(key, old, new, told, won, False, why))
        elif known and (share < low).any() and (floor > declared).any():
            new = [float(f"{min(v, o):.3g}") for v, o in zip(across(found.tolist()), old, strict=True)]
            why += f"; the filter goes down to {low:.3g} x"
            out.proposals.append(Proposal(key, old, new, told, won, False, why))
        elif known and (share < low).any():
            least = float(f"{max(0.5 * float(np.nanmin(share)) ** 2, 1e-4):.2g}")
            why += f"; the filter goes down to {low:.3g} x"
            out.proposals.append(Proposal("fusion.r_least", out.config.fusion.r_least, least, told, won, False, why))
        else:
            out.proposals.append(Proposal(key, old, old, told, None, True, why + ": the filter follows by itself"))


# ---------------------------------------------------------------------------------------------------------------- words


def snippet(t: Tuning) -> str:
    """The proposals as YAML to paste into the configuration; "" = keep what you have."""
    tree: dict[str, Any] = {}
    for p in t.changes:
        at = tree
        *path, last = p.key.split(".")
        for k in path:
            at = at.setdefault(k, {})
        at[last] = p.new
    return yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=110) if tree else ""


def command(t: Tuning) -> str:
    """What proves it."""
    sets = [part for s in t.sets for part in ("--set", s)]
    return shlex.join(["edge-agent", "replay", *map(str, t.files), *sets, "--compare"])


def _list(v: F64, digits: int = 6) -> list[float | None]:
    return [float(f"{x:.{digits}g}") if math.isfinite(x) else None for x in v.tolist()]


def _gain(g: Gain | None) -> dict[str, Any] | None:
    if g is None:
        return None
    return {
        "log_likelihood": round(g.value, 2),
        "std": round(g.std, 2) if math.isfinite(g.std) else None,
        "fixes": g.fixes,
    }


def as_json(t: Tuning) -> dict[str, Any]:
    """Everything, as plain values; three axes each, SI units; sd of q, qb, r are of their natural logarithms. What the
    data do not tell is null."""
    return {
        "files": [str(p) for p in t.files],
        "points": {
            name: {
                "stretches_fitted_judged": list(f.stretches),
                "fixes_fitted_judged": list(f.fixes),
                "accel_noise_m2ps3": _list(np.where(np.isfinite(f.spread[0]), f.noise.q, np.nan)),
                "bias_walk_m2ps5": _list(np.where(np.isfinite(f.spread[1]), f.noise.qb, np.nan)),
                "r": _list(f.noise.r),
                "std_log": {k: _list(f.spread[i], 4) for i, k in enumerate(("accel_noise", "bias_walk", "r"))},
                "fix_std_m": _list(f.std_m),
                "agreement": None if f.agreement is None else f.agreement.text,
                "gain_over_live": _gain(f.over_live),
                "rms_innovation_live_m": _list(f.rms_live_m),
                "rms_innovation_m": _list(f.rms_m),
            }
            for name, f in t.points.items()
        },
        "proposals": [
            {
                "key": p.key, "old": p.old, "new": p.new, "std": p.std, "keep": p.keep, "why": p.why,
                "gain": _gain(p.gain),
            }
            for p in t.proposals
        ],
        "notes": t.notes,
        "yaml": snippet(t),
        "command": command(t) if t.changes else None,
    }  # fmt: skip


def _value(v: Any) -> str:
    return f"{v:g}" if isinstance(v, float) else str(v)


def as_text(t: Tuning) -> str:
    """For people on a terminal."""
    lines = []
    for name, f in t.points.items():
        lines.append(
            f"{name}: fitted to {f.fixes[0]} fixes in {f.stretches[0]} stretches, judged on {f.fixes[1]} in "
            f"{f.stretches[1]} others"
        )
        for i, axis in enumerate(AXES):
            told = [
                f"{label} {v[i]:.3g} {unit} x/: {math.exp(sd):.2f}" if sd < 3 else f"{label} not to be found"
                for label, v, unit, sd in (
                    ("q", f.noise.q, "m2/s3", f.spread[0, i]),
                    ("qb", f.noise.qb, "m2/s5", f.spread[1, i]),
                    ("fixes' sd", 1e3 * f.std_m, "mm", f.spread[2, i] / 2),
                )
            ]
            lines.append(f"  {axis}: {', '.join(told)}")
        pair = ", ".join(
            f"{a} {1e3 * p:.2f} -> {1e3 * q:.2f}" for a, p, q in zip(AXES, f.rms_live_m, f.rms_m, strict=True)
        )
        g = f.over_live
        lines.append(f"  on the others, live -> fitted: rms of the innovations [mm] {pair}")
        lines.append(f"  log likelihood {g.value:+.1f} +- {g.std:.1f} over {g.fixes} fixes")
    for p in t.changes:
        won = "" if p.gain is None else f"; log likelihood {p.gain.value:+.1f} +- {p.gain.std:.1f}"
        lines.append(f"change {p.key}: {_value(p.old)} -> {_value(p.new)} {p.std}; {p.why}{won}")
    for p in t.proposals:
        if p.keep:
            won = "" if p.gain is None else f" (log likelihood {p.gain.value:+.1f} +- {p.gain.std:.1f})"
            lines.append(f"keep {p.key}: {_value(p.old)}; {p.why}{won}")
    lines += [f"note: {n}" for n in t.notes]
    if t.changes:
        lines += ["", "# paste into the configuration:", snippet(t).rstrip(), "", "# what proves it:", command(t)]
    else:
        lines.append("keep what you have: no change would be sure to gain" if t.points else "nothing could be fitted")
    return "\n".join(lines)
