"""How likely the fixes are under many hypotheses at once: noise, clock offset, mounting.

A plain three-state filter [d v b] per lane. Everything is measured in the fixes' own variance: R = r std^2, q = r q~,
qb = r qb~, so that the gains depend on the ratios q~, qb~ alone and the best r follows from the residuals
("concentrated"). For given gains the filter is linear in what goes in, fixes and accelerations alike: `whiten` returns
the normalised innovations of each input, and any mixture of inputs is then a linear regression (see agree).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64
from edge_agent.review.smooth import NS, Accelerations, Fixes, Noise, increments

SKIP = 6
"""First innovations that carry the wide start and are not counted."""
THIN_S = 0.5
"""Fixes of a long record are thinned to so far apart: noise is slow, and a long record shows more of it."""
CELLS = 300_000
"""Lanes times fixes that are tried at a time, at most or one problem: 2.4 MB for each of a dozen arrays."""
START_VB = 1e8
"""Start variance of v [m2/s2] and b [m2/s4] in units of the first fix's variance: 30 m/s at 3 mm."""


class Gains(NamedTuple):
    """What the filter of each lane does at each fix, whatever goes in: gains (n, 3, G) for d, v, b, zero where no fix
    is; 1/sqrt(S) (n, G), zero likewise; S in units of r, 1 likewise; dt (n,)."""

    gain: F64
    weight: F64
    variance: F64
    dt: F64


def gains(dt: F64, std: F64, q: F64, qb: F64) -> Gains:
    """dt (n,) or (n, G) s before each fix, 0 for the first; std (n, G) declared sd, inf = no fix; q, qb (n, G) ratios
    over the interval before. The first fix is the start.

    Every lane is computed alike whatever stands beside it; arrays are used again and parts of the covariance go
    together, for most of the time here is numpy's cost for each call."""
    n, G = std.shape
    used = np.isfinite(std)
    R = np.where(used, std, 1.0) ** 2
    gain = np.zeros((n, 3, G))
    variance = np.ones((n, G))
    C = np.zeros((6, G))  # dd, dv, db, vv, vb, bb
    C[0], C[3], C[5] = R[0], START_VB * R[0], START_VB * R[0]
    x, inverse, buffer = np.empty(G), np.empty(G), np.empty((6, G))
    steps = _steps_of(dt)
    same = np.zeros(n, np.bool_)  # as much noise as on the step before
    same[1:] = (q[1:] == q[:-1]).all(axis=1) & (qb[1:] == qb[:-1]).all(axis=1)
    noise: dict[float, F64] = {}
    ahead: dict[float, list[F64]] = {}
    multiply, subtract, least = np.multiply, np.subtract, np.minimum.reduce
    targets = [(C[:i], C[j], buffer[:i]) for j, i in ((1, 1), (2, 2), (3, 2), (4, 4), (5, 5))]
    known, doubled, bd, odd, even, last = C[:3], C[3:5], C[1:3], C[3::2], C[2], C[5]
    tops, pairs = buffer[:3], buffer[:2]
    for k in range(1, n):
        t = steps[k]
        one = isinstance(t, float)
        columns = ahead.get(t) if one else None
        if columns is None:
            columns = _ahead_of(t)
            if one:
                ahead[t] = columns
        for column, (target, source, part) in zip(columns, targets, strict=True):  # F P F'
            multiply(column, source, out=part)
            target += part
        if not same[k]:
            noise.clear()
        added = noise.get(t) if one else None
        if added is None:
            added = np.stack(_noise_of(t, q[k], qb[k]))
            if one:
                noise[t] = added
        C += added
        if least(C[0]) < 0.0:
            _mend(C[0] < 0.0, *C)
        S = variance[k]
        np.add(C[0], R[k], out=S)
        np.divide(used[k], S, out=inverse)
        u = gain[k]
        multiply(known, inverse, out=u)
        multiply(bd, u[1], out=pairs)
        subtract(doubled, pairs, out=doubled)
        multiply(even, u[2], out=x)
        subtract(last, x, out=last)
        multiply(known, u[0], out=tops)
        subtract(known, tops, out=known)
        if odd.min() < 0.0:
            _mend((C[3] < 0.0) | (C[5] < 0.0), *C)
    variance[~used] = 1.0
    weight = np.sqrt(variance)
    np.divide(1.0, weight, out=weight)
    weight[~used] = 0.0
    return Gains(gain, weight, variance, dt)


def _ahead_of(t: Any) -> list[F64]:
    """How the covariance after t seconds, dd dv db vv vb bb, follows from that before: of each of them but the first
    what it adds to those in front of it, (j, 1) or (j, G) for t (G,)."""
    h, t2 = 0.5 * t * t, t * t
    columns = [[2 * t], [-2 * h, -t], [t2, t], [-2 * t * h, -(h + t2), t, -2 * t], [h * h, h * t, -h, t2, -t]]
    return [np.reshape(np.array(column), (len(column), -1)) for column in columns]


def _mend(bad: npt.NDArray[np.bool_], dd: F64, dv: F64, db: F64, vv: F64, vb: F64, bb: F64) -> None:
    """Lanes whose covariance is rounding: what the wide start leaves of digits, times a gap of minutes to the fourth.
    Without noise there is nothing to know any more: no variance below zero, nothing correlated."""
    for part in (dd, vv, bb):
        part[bad] = np.maximum(part[bad], 0.0)
    for part in (dv, db, vb):
        part[bad] = 0.0


def _steps_of(dt: F64) -> list[Any]:
    """Intervals (n,) as numbers; of (n, G) those as numbers that are the same in every lane, the others as rows."""
    if dt.ndim == 1:
        return list(dt.tolist())
    alike = (dt == dt[:, :1]).all(axis=1)
    return [row.item(0) if one else row for row, one in zip(dt, alike.tolist(), strict=True)]


def _noise_of(t: Any, a: F64, w: F64) -> tuple[F64, ...]:
    """What the densities a, w (G,) add to dd, dv, db, vv, vb, bb in t seconds."""
    h, t2 = 0.5 * t * t, t * t
    return (
        a * (t2 * t / 3) + w * (t2 * t2 * t / 20),
        a * h + w * (t2 * t2 / 8),
        -(w * (t2 * t / 6)),
        a * t + w * (t2 * t / 3),
        -(w * h),
        w * t,
    )


def whiten(g: Gains, s1: F64, s2: F64, z: F64) -> F64:
    """Normalised innovations (n, C, G) of C inputs: increments s1, s2 over the interval before, fixes z (n, C, G)."""
    n, C, G = z.shape
    out = np.zeros((n, C, G))
    x = np.zeros((3, C, G))  # d, v, b
    x[0] = z[0]
    e, buffer = np.empty((C, G)), np.empty((3, C, G))
    d, v, b, moved = x[0], x[1], x[2], x[:2]
    one, two = buffer[0], buffer[:2]
    gain, weight, multiply = g.gain[:, :, None], g.weight, np.multiply
    behind: dict[float, F64] = {}
    for k, t in enumerate(_steps_of(g.dt)):
        if k == 0:
            continue
        multiply(v, t, out=one)
        d += one
        column = behind.get(t) if isinstance(t, float) else None
        if column is None:
            column = np.reshape(np.array([-0.5 * t * t, -t]), (2, 1, -1))
            if isinstance(t, float):
                behind[t] = column
        multiply(column, b, out=two)
        moved += two
        d += s2[k]
        v += s1[k]
        np.subtract(z[k], d, out=e)
        multiply(e, weight[k], out=out[k])
        multiply(gain[k], e, out=buffer)
        x += buffer
    return out


def log_likelihood(e: F64, variance: F64, std: F64) -> tuple[F64, F64]:
    """Of normalised innovations (n, G): log likelihood with the best r (G,), and that r."""
    counted = np.isfinite(std)
    counted[:SKIP] = False
    n = np.maximum(counted.sum(axis=0), 1)
    r = np.maximum((np.where(counted, e, 0.0) ** 2).sum(axis=0) / n, 1e-12)
    return -0.5 * (n * (np.log(2 * math.pi * r) + 1.0) + np.where(counted, np.log(variance), 0.0).sum(axis=0)), r


@dataclass(frozen=True, slots=True)
class Fit:
    """Maximum likelihood per axis (3,): densities, factor r on the declared variance, the log likelihood reached, and
    how many fixes it rests on."""

    noise: Noise
    r: F64
    log_likelihood: F64
    fixes: int


def prepare(fixes: Fixes) -> tuple[F64, F64, F64]:
    """dt (n,), z and std (n, 3) for `whiten`, without fixes from another level; z about its first value."""
    good = np.isfinite(fixes.z_m) & np.isfinite(fixes.std_m) & (fixes.level == 0)[:, None]
    std = np.where(good, fixes.std_m, np.inf)
    first = np.array([_first(fixes.z_m[:, i], good[:, i]) for i in range(3)])
    z = np.where(good, fixes.z_m - first, 0.0)
    std[0] = np.where(good[0], std[0], 1.0)
    dt = np.diff(fixes.t_ns, prepend=fixes.t_ns[:1]) * NS
    return dt, z, std


def _first(z: F64, good: F64) -> float:
    at = np.flatnonzero(good)
    return float(z[at[0]]) if len(at) else 0.0


def fit(fixes: Fixes, accel: Accelerations, *, r: float | None = None, most: int = 3000) -> Fit:
    """Maximum likelihood of q, qb and r of a record (Shan & Qi; here with a bias walk), each axis for itself.

    A grid over both ratios, narrowed three times. `r` given = the declared variances times r are right. Without
    accelerations q, qb are those of a displacement by itself. Uses at most `most` fixes. ValueError below 20.
    """
    return fits([(fixes, accel)], r=r, most=most)[0]


class _Problem:
    """One record of `fits`: what goes in, and the best that was found so far."""

    def __init__(self, fixes: Fixes, accel: Accelerations, most: int) -> None:
        if len(fixes) < 20:
            raise ValueError("fit: 20 fixes at least")
        part = _some(fixes, most)
        reference = np.nanmean(accel.xyz, axis=0) if len(accel.t_ns) else np.zeros(3)
        inc = increments(part.t_ns, accel, reference)
        zero = np.zeros((1, 3))
        self.n = len(part)
        self.s1, self.s2 = np.concatenate([zero, inc.s1.T]), np.concatenate([zero, inc.s2.T])
        self.gap = np.concatenate([zero, inc.extra.T]) if len(accel.t_ns) else np.zeros((self.n, 3))
        self.dt, self.z, self.std = prepare(part)
        usual = float(np.median(self.dt[1:]))
        declared = np.median(np.where(np.isfinite(self.std), self.std, 0.01), axis=0) ** 2
        # in units that make 1 mean: as much noise within an interval as in a fix
        self.unit_q, self.unit_qb = declared / usual**3, declared / usual**5
        self.centre = np.zeros((2, 3))
        self.best = np.full(3, -np.inf)
        self.best_r = np.ones(3)

    def choose(self, value: F64, r: F64, q: F64, qb: F64) -> None:
        """Take the best of log likelihoods (k, 3) with the r, q, qb that belong to them."""
        for axis in range(3):
            k = int(np.argmax(value[:, axis]))
            if value[k, axis] >= self.best[axis]:
                self.best[axis], self.best_r[axis] = value[k, axis], r[k, axis]
                self.centre[0, axis] = math.log10(q[k, axis] / self.unit_q[axis])
                self.centre[1, axis] = math.log10(qb[k, axis] / self.unit_qb[axis])

    def found(self) -> Fit:
        q = self.unit_q * 10.0 ** self.centre[0] * self.best_r
        qb = self.unit_qb * 10.0 ** self.centre[1] * self.best_r
        return Fit(Noise(q, qb), self.best_r, self.best, self.n)


def fits(records: Sequence[tuple[Fixes, Accelerations]], *, r: float | None = None, most: int = 3000) -> list[Fit]:
    """`fit` of several records side by side, each with the figures that it would have alone, in a fraction of the
    time."""
    if not records:
        return []
    problems = [_Problem(fixes, accel, most) for fixes, accel in records]
    longest = max(p.n for p in problems)
    for span, count in ((6.0, 9), (1.5, 7), (0.4, 7), (0.12, 7)):
        some = max(1, CELLS // (3 * count * count * longest))
        for lo in range(0, len(problems), some):
            _narrow(problems[lo : lo + some], span, count, r)
    return [p.found() for p in problems]


def _narrow(problems: list[_Problem], span: float, count: int, r: float | None) -> None:
    """Try `count` values of both ratios, `span` decades to both sides of each problem's best so far."""
    longest = max(p.n for p in problems)
    same = all(p.n == longest and np.array_equal(p.dt, problems[0].dt) for p in problems)
    steps = np.linspace(-span, span, count)
    a, b = (m.ravel() for m in np.meshgrid(steps, steps))
    wide = 3 * a.size
    G = wide * len(problems)
    # behind a shorter record nothing happens: no time passes and no fix is there
    s1, s2, z, ratio = (np.zeros((longest, G)) for _ in range(4))
    std, walk = np.full((longest, G), np.inf), np.empty(G)
    dt = problems[0].dt if same else np.zeros((longest, G))
    trials = []
    for i, p in enumerate(problems):
        q = p.unit_q * 10.0 ** (p.centre[0] - (2.0 if span == 6.0 else 0.0) + a[:, None])
        qb = p.unit_qb * 10.0 ** (p.centre[1] - (5.0 if span == 6.0 else 0.0) + b[:, None])
        trials.append((q, qb))
        k = slice(wide * i, wide * (i + 1))
        for lanes, values in ((s1, p.s1), (s2, p.s2), (z, p.z), (std, p.std), (ratio, p.gap)):
            lanes[: p.n, k].reshape(p.n, -1, 3)[:] = values[:, None]
        ratio[:, k] += q.reshape(-1)  # a gap's noise is absolute: as if r were 1
        walk[k] = qb.reshape(-1)
        if not same:
            dt[: p.n, k] = p.dt[:, None]
    g = gains(dt, std, ratio, np.broadcast_to(walk, (longest, G)))
    e = whiten(g, s1[:, None], s2[:, None], z[:, None])[:, 0]
    for i, (p, (q, qb)) in enumerate(zip(problems, trials, strict=True)):
        k = slice(wide * i, wide * (i + 1))
        mine = e[: p.n, k], g.variance[: p.n, k], std[: p.n, k]
        value, r_each = log_likelihood(*mine)
        if r is not None:
            value, r_each = fixed_likelihood(*mine, r), np.full(len(value), r)
        p.choose(value.reshape(-1, 3), r_each.reshape(-1, 3), q, qb)


def _some(fixes: Fixes, most: int) -> Fixes:
    """At most so many fixes: thinned to THIN_S, then those in the middle."""
    n = len(fixes)
    usual = max(float(np.median(np.diff(fixes.t_ns))) * NS, 1e-3)
    every = min(-(-n // most), max(1, round(THIN_S / usual)))
    k = np.arange(0, n, every)
    lo = max(0, (len(k) - most) // 2)
    k = k[lo : lo + most]
    return Fixes(fixes.t_ns[k], fixes.z_m[k], fixes.std_m[k], fixes.level[k], fixes.step[k])


def fixed_likelihood(e: F64, variance: F64, std: F64, r: F64 | float) -> F64:
    """Log likelihood (G,) of normalised innovations (n, G) with a given r."""
    counted = np.isfinite(std)
    counted[:SKIP] = False
    each = np.log(2 * math.pi * r * variance) + e * e / r
    return np.asarray(-0.5 * np.where(counted, each, 0.0).sum(axis=0))
