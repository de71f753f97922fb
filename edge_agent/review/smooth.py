"""Fixed-interval smoothing of one point: what the record says with its future known.

Model per axis (as fusion/model.py): displacement d, velocity v, accelerometer bias b (a_true = a - b), and where the
receiver's solution stood on another level, its offset o. Accelerations enter as first-order-hold integrals between
fixes (Smyth & Wu 2007), so all linear algebra happens at fixes, and what lies between them follows in closed form.

The Rauch-Tung-Striebel smoother runs in its inverse-free form (Bryson & Frazier 1963, de Jong 1989): behind the filter
an adjoint (r, N) goes backwards, r <- H' nu/S + (I - K H)' r, then r <- F' r, and x_s = x + P r, P_s = P - P N P. Both
passes are cut into blocks that advance side by side: a filter from an unknown state is linear in that state, so blocks
join exactly (as in Sarkka & Garcia-Fernandez 2021), and an hour of three axes costs some hundred steps of numpy.

`two_filter` is a second way to the same answer that shares no recursion with the first: an information filter that
runs backwards meets a forward filter (Fraser & Potter 1969, as Duong et al. use it).

Memory is bounded by chapters (`Smoother`): a chapter is smoothed once the next one has been filtered, and how much the
fixes behind that could still have moved it is computed and said (`Smooth.open_end`). Left out: reading recordings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from edge_agent.fusion import kalman
from edge_agent.fusion.model import B, D, N, O, V
from edge_agent.messages import F64, I64

NS = 1e-9
OFFSET_STD_M = 1.0
"""Nothing is known of a level offset before its first fix, nor of where a datum step leads."""
START_STD_V = 1.0
"""sd of the velocity at the first fix [m/s]; structures are slower."""
START_STD_B = 1.0
"""sd of the bias at the first fix [m/s2] about the mean acceleration."""
SPACE = 3.5
"""Accelerations further apart than so many usual intervals are a gap, as in fusion/feed.py."""
BLOW = 8.0
"""Second differences so many times as strong as usual are a blow that the samples may have missed;"""
BLOW_S = 10.0
"""usual is what half of the intervals show in so long: shaking that lasts is no blow."""
GAP_MEAN_S = 10.0
"""Across a gap the mean of the last accelerations of so long is held."""
PART = 1 << 13
"""Samples between fixes that are computed at a time: what a processor's cache holds."""
CHAPTER = 3_000
"""Fixes of a chapter: five minutes at 10 Hz, some 10 MB with accelerations at 250 Hz."""


@dataclass(frozen=True, slots=True)
class Fixes:
    """Positions of one point in structure axes: t_ns (n,) strictly rising; z_m and std_m (n, 3), NaN = no value there;
    level (n,): 0, or the number of the episode in which the solution stood on another level; step (n,) bool: the
    displacement's own level changed before this fix (datum, reacquired)."""

    t_ns: I64
    z_m: F64
    std_m: F64
    level: I64
    step: npt.NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.t_ns)

    def part(self, begin: int, end: int) -> Fixes:
        """Fixes begin..end-1."""
        k = slice(begin, end)
        return Fixes(self.t_ns[k], self.z_m[k], self.std_m[k], self.level[k], self.step[k])


def plain(t_ns: I64, z_m: F64, std_m: F64 | float | tuple[float, float, float]) -> Fixes:
    """Fixes (n, 3) without any jump; std_m broadcasts."""
    std = np.array(np.broadcast_to(np.asarray(std_m, dtype=np.float64), z_m.shape))
    return Fixes(t_ns, z_m, std, np.zeros(len(t_ns), np.int64), np.zeros(len(t_ns), np.bool_))


@dataclass(frozen=True, slots=True)
class Accelerations:
    """t_ns (m,) strictly rising, xyz (m, 3) m/s2 in structure axes, gravity allowed: it is bias. m = 0: none."""

    t_ns: I64
    xyz: F64


NO_ACCELERATIONS = Accelerations(np.zeros(0, np.int64), np.zeros((0, 3)))


@dataclass(frozen=True, slots=True)
class Noise:
    """Densities per axis (3,): q of the acceleration's white noise [m2/s3, two-sided], qb of the bias walk [m2/s5]."""

    q: F64
    qb: F64


def noise(q: float, qb: float) -> Noise:
    """The same on three axes."""
    return Noise(np.full(3, q), np.full(3, qb))


# --------------------------------------------------------------------------------------------------------- integrals


class Increments(NamedTuple):
    """Accelerations integrated from rest over the intervals between n + 1 nodes (first-order hold).

    s1, s2 (3, n): over each interval; extra (3, n): density [m2/s3] that gaps add to q. At the samples between the
    first and last node: t_ns (m,), v, d (3, m) since the node before, `after` (m,) that node's number."""

    s1: F64
    s2: F64
    extra: F64
    t_ns: I64
    v: F64
    d: F64
    after: I64


def increments(node_ns: I64, accel: Accelerations, reference: F64, *, velocity: bool = True) -> Increments:
    """Integrate accelerations less `reference` (3,) between nodes (n + 1,). Without samples everything is zero.
    `velocity`: v is wanted, else it is empty.

    Nodes in a gap of the accelerations stand among the samples, so that the stream has no hole where fixes are."""
    n = len(node_ns) - 1
    extra = np.zeros((3, n))
    if len(accel.t_ns):
        t, a, gaps = bridged(accel, reference, int(node_ns[0]), int(node_ns[-1]))
    else:
        t, a, gaps = node_ns[[0, -1]], np.zeros((3, 2)), [(int(node_ns[0]), int(node_ns[-1]), np.zeros(3))]
    zero = int(node_ns[0])
    x, xf = (t - zero) * NS, (node_ns - zero) * NS
    at = np.searchsorted(t, node_ns)
    rows = at + np.arange(n + 1)  # of the nodes, in samples and nodes merged
    lo = int(rows[0])
    rows -= lo
    time = np.insert(x, at, xf)[lo : lo + rows[-1] + 1]
    count = np.diff(rows)
    h = np.diff(time)
    half, sixth = 0.5 * h, h * h * (1 / 6)
    v, d = np.zeros((3, len(time))), np.zeros((3, len(time)))
    s1, s2 = np.empty((3, n)), np.empty((3, n))
    for axis in range(3):
        y = np.insert(a[axis], at, np.interp(xf, x, a[axis]))[lo : lo + rows[-1] + 1]
        total = y[:-1] + y[1:]
        s1[axis], before = _since(total * half, rows, count, v[axis])
        total += y[:-1]
        total *= sixth
        total += before * h
        s2[axis], _ = _since(total, rows, count, d[axis])
    if len(accel.t_ns):
        extra += _blows(t, a, node_ns)
    inside = np.arange(*np.searchsorted(t, node_ns[[0, -1]]))
    if len(accel.t_ns):
        real = np.isin(t[inside], accel.t_ns, assume_unique=False) if gaps else np.ones(len(inside), np.bool_)
        inside = inside[real]
    else:
        inside = inside[:0]
    after = np.searchsorted(node_ns, t[inside], side="right") - 1
    where = inside + after + 1 - lo
    times = t[inside]
    bare = np.zeros(n + 1, np.bool_)
    for begin, end, q in gaps:
        part = np.minimum(node_ns[1:], end) - np.maximum(node_ns[:-1], begin)
        extra += q[:, None] * np.maximum(part, 0) / np.diff(node_ns)
        bare |= (node_ns >= begin) & (node_ns < end)
    bare[-1] = False
    if bare.any():
        k = np.flatnonzero(bare)
        times, after, where = (np.concatenate(pair) for pair in ((times, node_ns[k]), (after, k), (where, rows[k])))
        order = np.argsort(times, kind="stable")
        once = np.ones(len(order), np.bool_)
        once[1:] = np.diff(times[order]) > 0
        times, after, where = times[order][once], after[order][once], where[order][once]
    after = after.astype(np.int32)
    return Increments(s1, s2, extra, times, v[:, where] if velocity else v[:, :0], d[:, where], after)


def _blows(t: I64, a: F64, node_ns: I64) -> F64:
    """Density (3, n) that makes up for blows between samples: a first-order hold misses h/12 of the second difference
    of a in velocity, so where that is far above what is usual in this record, so much more is not known
    (fusion/integrals.py `bend`)."""
    at = np.searchsorted(t, node_ns, side="right")
    seconds = np.diff(node_ns) * NS
    rate = np.zeros((3, len(node_ns) - 1))
    end = int(at[-1])
    if end < 3:
        return rate
    h = np.diff(t[:end])[1:] * NS
    first = np.minimum(at[:-1], end - 1)
    some = at[1:] > at[:-1]
    for axis in range(3):
        e = np.zeros(end)
        x, y = a[axis, :end], e[2:]
        np.subtract(x[2:], x[1:-1], out=y)
        y -= x[1:-1]
        y += x[:-2]
        y *= h
        y *= y
        rate[axis] = np.where(some, np.add.reduceat(e, first), 0.0)
    rate /= seconds
    usual = _usual(rate, max(5, round(BLOW_S / float(np.median(seconds)))))
    return np.asarray(np.maximum(rate - BLOW * usual * (1.0 + 0.1 / seconds), 0.0) * (1 / 144))


def _usual(rate: F64, size: int) -> F64:
    """Median of stretches of `size` intervals, for each interval (3, n) the largest of its own and its neighbours'."""
    n = rate.shape[1]
    count = max(1, n // size)
    edges = (np.arange(count + 1) * n) // count
    middle = np.array([np.median(rate[:, a:b], axis=1) for a, b in pairwise(edges.tolist())])
    padded = np.concatenate([middle[:1], middle, middle[-1:]])
    largest = np.maximum(np.maximum(padded[:-2], padded[1:-1]), padded[2:])
    return np.asarray(np.repeat(largest, np.diff(edges), axis=0).T)


def _since(steps: F64, rows: I64, count: I64, out: F64) -> tuple[F64, F64]:
    """Running sum of steps (k,) since the node before into out (k + 1,); return the sums over whole intervals (n,) and
    the sums before each step (k,)."""
    np.cumsum(steps, out=out[1:])
    at_nodes = out[rows]
    out[:-1] -= np.repeat(at_nodes[:-1], count)
    out[-1] = 0.0
    whole: F64 = np.diff(at_nodes)
    return whole, out[:-1]


def bridged(
    accel: Accelerations, reference: F64, begin_ns: int, end_ns: int
) -> tuple[I64, F64, list[tuple[int, int, F64]]]:
    """Samples (3, m) less reference with every gap held at the mean of the last seconds before it (of the first after
    it, where it is the first thing), and the gaps: begin, end, density q (3,) = 2 var(a) tau of what was not seen."""
    t = accel.t_ns
    a = np.ascontiguousarray((accel.xyz - reference).T)
    if not np.isfinite(a).all():  # an axis was missing: the sample before goes on
        good = np.isfinite(a).all(axis=0)
        t, a = t[good], a[:, good]
    usual = float(np.median(np.diff(t))) if len(t) > 1 else 1e9
    limit = SPACE * usual
    holes = [(i, int(t[i]), int(t[i + 1])) for i in np.flatnonzero(np.diff(t) > limit).tolist()]
    if len(t) and t[0] > begin_ns + limit:
        holes.insert(0, (-1, begin_ns - 2, int(t[0])))
    if len(t) and t[-1] < end_ns - limit:
        holes.append((len(t) - 1, int(t[-1]), end_ns + 2))
    gaps, where, times, values = [], [], [], []
    for i, begin, end in holes:
        near = t >= begin - GAP_MEAN_S / NS if i >= 0 else t <= end + GAP_MEAN_S / NS
        near[i + 1 :] &= i < 0
        part = a[:, near]
        mean = part.mean(axis=1)
        var = part.var(axis=1)
        rate = np.mean(np.diff(part, axis=1) ** 2, axis=1) if part.shape[1] > 1 else var
        h = usual * NS
        tau = np.clip(np.sqrt(var / np.maximum(rate, 1e-30)) * h, h, 0.5)
        gaps.append((begin, end, 2.0 * var * tau + 1e-12))
        where += [i + 1, i + 1]
        times += [begin + 1, end - 1]
        values += [mean, mean]
    if gaps:
        t = np.insert(t, where, times)
        a = np.insert(a, where, np.array(values).T, axis=1)
    return t, a, gaps


# ----------------------------------------------------------------------------------------- filter and adjoint, in lanes
# A lane is one axis of one block of steps. Arrays put the step first, then the state, the lane last.


class Steps(NamedTuple):
    """What happens on each step, arrays (L, M): predict over dt [s] with increments s1, s2, densities q, qb; o keeps
    (1) or is begun anew (0) with variance `fresh`; `move` is added to the variance of d; then z [m] with variance R is
    used (1) or not (0)."""

    dt: F64
    s1: F64
    s2: F64
    q: F64
    qb: F64
    keep: F64
    fresh: F64
    move: F64
    z: F64
    R: F64
    use: F64


class Filtered(NamedTuple):
    """After each step: x (L, N, M), P (L, N, N, M), gain K (L, N, M), nu/S and 1/S (L, M), zero where not used."""

    x: F64
    P: F64
    K: F64
    e: F64
    w: F64


class Span(NamedTuple):
    """A block of steps as a function of the state before it: x_end = A x + b with covariance A P A' + C, and what its
    fixes say of that state in information form, J x = eta. A (N, N, M), b (N, M), C, J (N, N, M), eta (N, M)."""

    A: F64
    b: F64
    C: F64
    J: F64
    eta: F64


def _q_matrix(s: Steps) -> F64:
    """Q per step (L, N, N, M), in closed form (fusion/model.py `process_noise`)."""
    Q = np.zeros((s.dt.shape[0], N, N, s.dt.shape[1]))
    t = s.dt
    t2 = t * t
    t3 = t2 * t
    Q[:, D, D] = s.q * t3 / 3.0 + s.qb * t3 * t2 / 20.0 + s.move
    Q[:, D, V] = Q[:, V, D] = s.q * t2 / 2.0 + s.qb * t2 * t2 / 8.0
    Q[:, D, B] = Q[:, B, D] = s.qb * t3 / -6.0
    Q[:, V, V] = s.q * t + s.qb * t3 / 3.0
    Q[:, V, B] = Q[:, B, V] = s.qb * t2 / -2.0
    Q[:, B, B] = s.qb * t
    Q[:, O, O] = s.fresh
    return Q


def _ahead(m: F64, dt: F64, half: F64, keep: F64) -> None:
    """m <- F m in place, m (N, ..., M)."""
    m[D] += dt * m[V] - half * m[B]
    m[V] -= dt * m[B]
    m[O] *= keep


def _back(m: F64, dt: F64, half: F64, keep: F64) -> None:
    """m <- F' m in place."""
    m[B] -= half * m[D] + dt * m[V]
    m[V] += dt * m[D]
    m[O] *= keep


def _filter(x: F64, P: F64, s: Steps) -> Filtered:
    """Kalman filter of every lane from x (N, M), P (N, N, M)."""
    L, M = s.dt.shape
    out = Filtered(np.empty((L, N, M)), np.empty((L, N, N, M)), np.empty((L, N, M)), np.empty((L, M)), np.empty((L, M)))
    Q = _q_matrix(s)
    half = 0.5 * s.dt * s.dt
    x, P = x.copy(), P.copy()
    for k in range(L):
        dt, hh, keep = s.dt[k], half[k], s.keep[k]
        _ahead(x, dt, hh, keep)
        x[D] += s.s2[k]
        x[V] += s.s1[k]
        _ahead(P, dt, hh, keep)
        _ahead(P.swapaxes(0, 1), dt, hh, keep)
        P += Q[k]
        R = s.R[k]
        nu, CH, S = kalman.innovation(x, P, s.z[k], R)
        x, P = kalman.update(x, P, nu, CH, S, R, s.use[k])
        w = s.use[k] / S
        out.x[k], out.P[k], out.K[k], out.e[k], out.w[k] = x, P, CH * w, nu * w, w
    return out


def _span(s: Steps) -> Span:
    """Every lane's block as a function of the state before it."""
    L, M = s.dt.shape
    A = np.zeros((N, N, M))
    A[range(N), range(N)] = 1.0
    b, C, J, eta = np.zeros((N, M)), np.zeros((N, N, M)), np.zeros((N, N, M)), np.zeros((N, M))
    Q = _q_matrix(s)
    half = 0.5 * s.dt * s.dt
    for k in range(L):
        dt, hh, keep = s.dt[k], half[k], s.keep[k]
        _ahead(b, dt, hh, keep)
        b[D] += s.s2[k]
        b[V] += s.s1[k]
        _ahead(A, dt, hh, keep)
        _ahead(C, dt, hh, keep)
        _ahead(C.swapaxes(0, 1), dt, hh, keep)
        C += Q[k]
        R = s.R[k]
        nu, CH, S = kalman.innovation(b, C, s.z[k], R)
        b, C = kalman.update(b, C, nu, CH, S, R, s.use[k])
        w = s.use[k] / S
        AH = A[D] + A[O]
        eta += AH * (nu * w)
        J += AH[:, None] * (AH * w)
        A -= (CH * w)[:, None] * AH
    return Span(A, b, C, J, eta)


class Adjoint(NamedTuple):
    """Behind each step, in terms of the state after it: r (L, N, M), n (L, N, N, M)."""

    r: F64
    n: F64


class Alone(NamedTuple):
    """Blocks as if nothing came behind them: r0 (N, M), n0 (N, N, M) before the first step, and the map T (N, N, M) of
    the adjoint from the block's end to there."""

    r0: F64
    n0: F64
    T: F64


def _take_fix(f: Filtered, k: int, r: F64, n: F64) -> None:
    """Bring the adjoint from behind the fix of step k to before it, in place: r <- H' nu/S + (I - K H)' r."""
    K = f.K[k]
    c = f.e[k] - (K * r).sum(axis=0)
    r[D] += c
    r[O] += c
    nK = (n * K).sum(axis=1)
    n[:, D] -= nK
    n[:, O] -= nK
    n[D] -= nK
    n[O] -= nK
    c = (K * nK).sum(axis=0) + f.w[k]
    for i in (D, O):
        n[i, D] += c
        n[i, O] += c


def _adjoint(f: Filtered, s: Steps, r: F64, n: F64) -> Adjoint:
    """Backward pass of every lane from r (N, M), n (N, N, M) behind the last step."""
    L, M = s.dt.shape
    rs, ns = np.empty((L, N, M)), np.empty((L, N, N, M))
    half = 0.5 * s.dt * s.dt
    r, n = r.copy(), n.copy()
    for k in range(L - 1, -1, -1):
        rs[k], ns[k] = r, n
        _take_fix(f, k, r, n)
        dt, hh, keep = s.dt[k], half[k], s.keep[k]
        _back(r, dt, hh, keep)
        _back(n, dt, hh, keep)
        _back(n.swapaxes(0, 1), dt, hh, keep)
    return Adjoint(rs, ns)


def _alone(f: Filtered, s: Steps) -> Alone:
    """The same from nothing, and the map: what is linear in what lies behind."""
    L, M = s.dt.shape
    T = np.zeros((N, N, M))
    T[range(N), range(N)] = 1.0
    half = 0.5 * s.dt * s.dt
    r, n = np.zeros((N, M)), np.zeros((N, N, M))
    for k in range(L - 1, -1, -1):
        _take_fix(f, k, r, n)
        KT = (f.K[k][:, None] * T).sum(axis=0)
        T[D] -= KT
        T[O] -= KT
        dt, hh, keep = s.dt[k], half[k], s.keep[k]
        _back(r, dt, hh, keep)
        _back(n, dt, hh, keep)
        _back(n.swapaxes(0, 1), dt, hh, keep)
        _back(T, dt, hh, keep)
    return Alone(r, n, T)


# ------------------------------------------------------------------------------------------------------------ chapters


class State(NamedTuple):
    """A state at a node: x (N, 3), P (N, N, 3)."""

    t_ns: int
    x: F64
    P: F64
    level: int


def begin(fixes: Fixes) -> State:
    """The state at the first fix, which it uses up: d from it, v and b wide open."""
    z, std = fixes.z_m[0], fixes.std_m[0]
    known = np.isfinite(z) & np.isfinite(std)
    x, P = np.zeros((N, 3)), np.zeros((N, N, 3))
    x[D] = np.where(known, z, 0.0)
    P[D, D] = np.where(known, std * std, OFFSET_STD_M**2)
    P[V, V], P[B, B] = START_STD_V**2, START_STD_B**2
    return State(int(fixes.t_ns[0]), x, P, 0)


@dataclass(frozen=True, slots=True)
class _Chapter:
    """A filtered chapter: nodes 0..n in time, steps and filter in blocks of lanes."""

    start: State
    node_ns: I64
    inc: Increments
    steps: Steps
    lanes: tuple[int, int, int]  # fixes, steps per block, blocks
    filtered: Filtered
    noise: Noise
    level: int  # of the last fix

    def end(self) -> State:
        n, L, K = self.lanes
        k, lane = (n - 1) % L, slice(3 * (K - 1), 3 * K)
        return State(int(self.node_ns[-1]), self.filtered.x[k, :, lane], self.filtered.P[k, :, :, lane], self.level)

    def line(self, start: F64, blocks: F64) -> F64:
        """Node 0 (..., 3), then the steps' blocks (L, ..., M) -> (..., 3, n + 1) in time."""
        n, L, K = self.lanes
        shape = blocks.shape[1:-1]
        split = blocks.reshape(L, *shape, K, 3)
        ordered = np.moveaxis(split, (-2, 0), (-2, -1)) if not shape else np.moveaxis(split, 0, -1)
        out = np.empty((*shape, 3, n + 1))
        out[..., 0] = start
        out[..., 1:] = np.swapaxes(ordered, -3, -2).reshape(*shape, 3, K * L)[..., :n]
        return out


def _lay(a: F64, L: int, K: int, pad: float) -> F64:
    """(n, 3) in time -> (L, K * 3) in lanes; what is missing in the last block is `pad`."""
    full = np.full((L * K, 3), pad)
    full[: len(a)] = a
    return np.ascontiguousarray(full.reshape(K, L, 3).transpose(1, 0, 2)).reshape(L, K * 3)


def _steps(start: State, fixes: Fixes, inc: Increments, noise: Noise, L: int, K: int) -> Steps:
    n = len(fixes)
    dt = np.asarray(np.diff(fixes.t_ns, prepend=start.t_ns) * NS, dtype=np.float64)
    use = np.isfinite(fixes.z_m) & np.isfinite(fixes.std_m)
    level = np.concatenate([[start.level], fixes.level])
    same = (np.diff(level) == 0).astype(np.float64)
    fresh = np.where((same == 0) & (fixes.level > 0), OFFSET_STD_M**2, 0.0)
    move = np.where(fixes.step, OFFSET_STD_M**2, 0.0)

    def wide(v: F64) -> F64:
        return np.broadcast_to(v[:, None], (n, 3))

    rows = (
        (wide(dt), 0.0), (inc.s1.T, 0.0), (inc.s2.T, 0.0), (inc.extra.T + noise.q, 0.0),
        (np.broadcast_to(noise.qb, (n, 3)), 0.0), (wide(same), 1.0), (wide(fresh), 0.0), (wide(move), 0.0),
        (np.where(use, fixes.z_m, 0.0), 0.0), (np.where(use, fixes.std_m**2, 1.0), 1.0), (use.astype(np.float64), 0.0),
    )  # fmt: skip
    return Steps(*(_lay(a, L, K, pad) for a, pad in rows))


def _forward(
    start: State, fixes: Fixes, accel: Accelerations, reference: F64, noise: Noise, velocity: bool = True
) -> _Chapter:
    """Filter fixes that lie behind `start`."""
    n = len(fixes)
    node_ns = np.concatenate([[start.t_ns], fixes.t_ns])
    if not (np.diff(node_ns) > 0).all():
        raise ValueError("smooth: fixes must rise strictly in time")
    inc = increments(node_ns, accel, reference, velocity=velocity)
    K = max(1, round(math.sqrt(n)))
    L = -(-n // K)
    K = -(-n // L)
    steps = _steps(start, fixes, inc, noise, L, K)
    first = _filter(start.x, start.P, Steps(*(a[:, :3] for a in steps)))
    x, P = [start.x, first.x[-1]], [start.P, first.P[-1]]
    if K > 2:
        span = _span(Steps(*(a[:, 3:-3] for a in steps)))
        for k in range(K - 2):
            part = Span(*(a[..., 3 * k : 3 * k + 3] for a in span))
            joined = _join(x[-1], P[-1], part)
            x.append(joined[0])
            P.append(joined[1])
    filtered = _filter(np.concatenate(x[:K], axis=-1), np.concatenate(P[:K], axis=-1), steps)
    return _Chapter(start, node_ns, inc, steps, (n, L, K), filtered, noise, int(fixes.level[-1]))


def _join(x: F64, P: F64, s: Span) -> tuple[F64, F64]:
    """State behind a block from the state before it, three axes: x (N, 3), P (N, N, 3)."""
    P, A, C, J = (np.moveaxis(m, -1, 0) for m in (P, s.A, s.C, s.J))
    eta, b, m = s.eta.T, s.b.T, x.T
    both = np.concatenate([P, (m + np.einsum("aij,aj->ai", P, eta))[:, :, None]], axis=2)
    solved = np.linalg.solve(np.eye(N) + P @ J, both)
    P, m = solved[:, :, :N], solved[:, :, N]
    P = A @ P @ A.swapaxes(1, 2) + C
    P = 0.5 * (P + P.swapaxes(1, 2))
    return (np.einsum("aij,aj->ai", A, m) + b).T, np.moveaxis(P, 0, -1)


class _Behind(NamedTuple):
    """Adjoint behind a node, of all that follows: r (N, 3), n (N, N, 3)."""

    r: F64
    n: F64


def _nothing() -> _Behind:
    return _Behind(np.zeros((N, 3)), np.zeros((N, N, 3)))


def _joined(alone: Alone, K: int, behind: _Behind) -> tuple[list[F64], list[F64], F64]:
    """Adjoints behind each of K blocks, the last block's first, that before the first at the end; and the map T
    (N, N, 3) from the chapter's end to its start."""
    r, n = [behind.r], [behind.n]
    T = np.broadcast_to(np.eye(N)[:, :, None], (N, N, 3))
    for k in range(K - 1, -1, -1):
        part = slice(3 * k, 3 * k + 3)
        t = alone.T[..., part]
        r.append(alone.r0[:, part] + _mul(t, r[-1][:, None])[:, 0])
        n.append(alone.n0[..., part] + _mul(_mul(t, n[-1]), t.swapaxes(0, 1)))
        T = _mul(t, T)
    return r, n, T


def _backward(c: _Chapter, alone: Alone, behind: _Behind) -> tuple[Adjoint, _Behind]:
    """Adjoint of all steps in lanes; that at the chapter's start."""
    r, n, _ = _joined(alone, c.lanes[2], behind)
    before = _Behind(r.pop(), n.pop())
    return _adjoint(c.filtered, c.steps, np.concatenate(r[::-1], axis=-1), np.concatenate(n[::-1], axis=-1)), before


def _mul(a: F64, b: F64) -> F64:
    """Matrix product a b of stacks (..., i, j, lanes) and (..., j, k, lanes)."""
    out = a[..., :, 0, None, :] * b[..., None, 0, :, :]
    for k in range(1, a.shape[-2]):
        out += a[..., :, k, None, :] * b[..., None, k, :, :]
    return np.asarray(out)


# ----------------------------------------------------------------------------------------------------------- the result


@dataclass(frozen=True, slots=True)
class Smooth:
    """The smoothed stream at t_ns (m,), samples of the accelerometer (fixes where there are none): displacement and
    velocity (m, 3) in m and m/s with their sd (what is not asked for is empty). At the fixes fix_ns (n,): state x
    (n, N, 3) with covariance P (n, N, N, 3), bias about `reference` (3,); log likelihood of the fixes given the model,
    per axis (3,). open_end: the largest share of its sd by which what lies behind the interval could still move the end
    of this part (0 = nothing lies behind)."""

    t_ns: I64
    displacement_m: F64
    velocity_mps: F64
    std_displacement_m: F64
    std_velocity_mps: F64
    fix_ns: I64
    x: F64
    P: F64
    reference: F64
    log_likelihood: F64
    open_end: float


def _finish(
    c: _Chapter, adjoint: Adjoint, before: _Behind, reference: F64, std: bool, last: bool, end: float
) -> Smooth:
    f = c.filtered
    x_s = f.x + _mul(f.P, adjoint.r[:, :, None])[:, :, 0]
    P_s = np.empty_like(f.P)
    for i in range(len(P_s)):  # one by one: small arrays stay in the cache
        P_s[i] = f.P[i] - _mul(_mul(f.P[i], adjoint.n[i]), f.P[i])
    P0 = c.start.P
    x = c.line(c.start.x + _mul(P0, before.r[:, None])[:, 0], x_s)  # (N, 3, n + 1)
    P = c.line(P0 - _mul(_mul(P0, before.n), P0), P_s)
    r = c.line(before.r, adjoint.r)[..., :-1]
    inc = c.inc
    qb = np.broadcast_to(c.noise.qb[:, None], inc.extra.shape)
    q = inc.extra + c.noise.q[:, None]
    xs = x[..., :-1]
    rd, rv, rb = r[D], r[V], r[B]
    # d(tau), and v(tau) = its derivative, tau seconds behind the node: the state, then what the future says
    poly = [xs[D], xs[V], 0.5 * (q * rv - xs[B]), (q * rd + qb * rb) / -6.0, qb * rv / -24.0, qb * rd / 120.0]
    t = inc.t_ns
    tau = np.asarray((t - c.node_ns[inc.after]) * NS, dtype=np.float64)
    m = len(tau)
    speed = inc.v.shape[1] == m
    d, v = np.empty((3, m + last)), np.zeros((3, m + last if speed else 0))
    for axis in range(3):
        for k in _cached(m):
            at, after, slope = tau[k], inc.after[k], v[axis, k]
            y = poly[-1][axis].take(after)
            for p in poly[-2::-1]:
                if speed:
                    slope *= at
                    slope += y
                y *= at
                y += p[axis].take(after)
            np.add(y, inc.d[axis, k], out=d[axis, k])
            if speed:
                slope += inc.v[axis, k]
    sd_d = sd_v = np.zeros((3, 0))
    if std:
        P_f, n = c.line(P0, f.P)[..., :-1], c.line(before.n, adjoint.n)[..., :-1]
        jumps = bool(c.level or c.start.level or n[O].any())
        sd_d, sd_v = np.empty((3, m + last)), np.empty((3, m + last if speed else 0))
        out = (sd_d, sd_v) if speed else (sd_d,)
        _spread(P_f, n, q, qb, tau, inc.after, (D, V, B, O) if jumps else (D, V, B), out)
    if last:
        t = np.concatenate([t, c.node_ns[-1:]])
        for state, value, sd in ((D, d, sd_d), (V, v, sd_v)):
            if state == D or speed:
                value[:, m] = x[state, :, -1]
                if std:
                    sd[:, m] = np.sqrt(np.maximum(P[state, state, :, -1], 0.0))
    used = f.w > 0
    w = np.where(used, f.w, 1.0)
    each = np.where(used, np.log(w) - f.e * f.e / w - math.log(2 * math.pi), 0.0)
    likelihood = 0.5 * each.sum(axis=0).reshape(-1, 3).sum(axis=0)
    x_n, P_n = np.ascontiguousarray(x.transpose(2, 0, 1)), np.ascontiguousarray(P.transpose(3, 0, 1, 2))
    return Smooth(t, d.T, v.T, sd_d.T, sd_v.T, c.node_ns, x_n, P_n, reference, likelihood, end)


Poly: TypeAlias = list[F64 | None]
"""Coefficients (3, n) of a polynomial per axis and interval, from the constant up; None = zero."""


def _slope(p: Poly) -> Poly:
    return [None if c is None else c * float(i) for i, c in enumerate(p)][1:]


def _cached(m: int) -> Iterator[slice]:
    """Samples 0..m-1 in parts so short that all that is computed of one stays in the processor's cache."""
    return (slice(lo, min(lo + PART, m)) for lo in range(0, m, PART))


def _roots_along(p: Poly, tau: F64, after: I64, out: F64) -> None:
    """Square root of the polynomial at tau (m,) behind node `after` (m,), into out (3, m or more)."""
    for axis in range(3):
        for k in _cached(len(tau)):
            at, node, y = tau[k], after[k], out[axis, k]
            y[:] = 0.0
            for c in p[::-1]:
                y *= at
                if c is not None:
                    y += c[axis].take(node)
            np.sqrt(np.maximum(y, 0.0, out=y), out=y)


def _add_product(total: Poly, a: Poly, b: Poly, factor: F64) -> None:
    """total += factor a b."""
    total += [None] * (len(a) + len(b) - 1 - len(total))
    for i, u in enumerate(a):
        if u is None:
            continue
        scaled = factor * u
        for j, w in enumerate(b):
            if w is not None:
                term = scaled * w
                old = total[i + j]
                total[i + j] = term if old is None else old + term


def _spread(
    P: F64, n: F64, q: F64, qb: F64, tau: F64, after: I64, states: tuple[int, ...], out: tuple[F64, ...]
) -> None:
    """sd of d, or of d and v, (3, m), into `out`, between nodes: P_s(tau) = P(tau) - y N y', y = [F P + Q F(-tau)'] of
    its row.

    P, n (N, N, 3, n). Terms of the variance, a polynomial of degree 10, that nowhere reach 1e-5 of it are left out."""
    rows: dict[int, Poly] = {
        D: [P[D, D], P[V, D], -0.5 * P[B, D], q / -6.0, None, qb / 120.0],
        V: [P[D, V], P[V, V], 0.5 * (q - P[B, V]), None, qb / -24.0],
        B: [P[D, B], P[V, B], -0.5 * P[B, B], qb / -6.0],
        O: [P[D, O], P[V, O], -0.5 * P[B, O]],
    }
    own: Poly = [P[D, D], 2 * P[D, V], P[V, V] - P[D, B], q / 3.0 - P[V, B], 0.25 * P[B, B], qb / 20.0]
    speed: Poly = [P[V, V], q - 2 * P[V, B], P[B, B], qb / 3.0]
    slopes = {i: _slope(row) for i, row in rows.items()}
    longest = np.zeros(q.shape[1])
    np.maximum.at(longest, after, tau)
    for lines, total, sd in zip((rows, slopes), (own, speed), out, strict=False):
        for i in states:
            for j in states:
                if j >= i:
                    _add_product(total, lines[i], lines[j], n[i, j] * (-1.0 if i == j else -2.0))
        power = longest ** (len(total) - 1)
        while len(total) > 1:
            top, level = total[-1], total[0]
            if top is not None and level is not None and bool((np.abs(top) * power > 1e-6 * np.abs(level)).any()):
                break
            total.pop()
            power = longest ** (len(total) - 1)
        _roots_along(total, tau, after, sd)


def smooth(fixes: Fixes, accel: Accelerations, noise: Noise, *, std: bool = True, ahead: bool = True) -> Smooth:
    """Smooth a whole record at once; without `ahead` only what lies behind is used: the forward filter's stream.

    ValueError for less than two fixes or times that do not rise.
    """
    if len(fixes) < 2:
        raise ValueError("smooth: two fixes at least")
    reference = _reference(accel)
    chapter = _forward(begin(fixes), fixes.part(1, len(fixes)), accel, reference, noise)
    if ahead:
        adjoint, before = _backward(chapter, _alone(chapter.filtered, chapter.steps), _nothing())
    else:
        f, before = chapter.filtered, _nothing()
        adjoint = Adjoint(np.zeros_like(f.x), np.zeros_like(f.P))
    return _finish(chapter, adjoint, before, reference, std, True, 0.0)


def _reference(accel: Accelerations) -> F64:
    """What is taken off before integration: it only saves digits, for the bias is estimated about it."""
    if not len(accel.t_ns):
        return np.zeros(3)
    mean = accel.xyz.mean(axis=0)
    return np.asarray(mean if np.isfinite(mean).all() else np.nanmean(accel.xyz, axis=0))


class Smoother:
    """Smooths a record of any length, chapter by chapter in the order of time; memory is two chapters.

    Feed chapters of fixes, equally long but for the last, with the accelerations that cover them (from the last fix
    before to the last fix in them); `add` yields the chapter before, smoothed, once there is one; `finish` the last.
    Another run, or what lies behind an outage that nothing bridges, begins after `finish`.
    """

    def __init__(self, noise: Noise, *, std: bool = True, velocity: bool = True) -> None:
        self.noise, self.std, self.velocity = noise, std, velocity
        self._state: State | None = None
        self._reference: F64 = np.zeros(3)
        self._waiting: tuple[_Chapter, Alone] | None = None

    def add(self, fixes: Fixes, accel: Accelerations) -> Iterator[Smooth]:
        """Take the next chapter; yield the one before."""
        if self._state is None:
            self._reference = _reference(accel)
            self._state = begin(fixes)
            fixes = fixes.part(1, len(fixes))
        if not len(fixes):
            return
        new = _forward(self._state, fixes, accel, self._reference, self.noise, self.velocity)
        self._state = new.end()
        alone = _alone(new.filtered, new.steps)
        if self._waiting is not None:
            r, n, T = _joined(alone, new.lanes[2], _nothing())
            behind = _Behind(r[-1], n[-1])
            yield self._out(*self._waiting, behind, False, _open_end(new, T, behind))
        self._waiting = new, alone

    def finish(self) -> Iterator[Smooth]:
        """Yield what is left; the smoother is then as new."""
        if self._waiting is not None:
            yield self._out(*self._waiting, _nothing(), True, 0.0)
        self._state = self._waiting = None

    def _out(self, c: _Chapter, alone: Alone, behind: _Behind, last: bool, open_end: float) -> Smooth:
        adjoint, before = _backward(c, alone, behind)
        return _finish(c, adjoint, before, self._reference, self.std, last, open_end)


def _open_end(c: _Chapter, T: F64, behind: _Behind) -> float:
    """Share of the sd of d at the chapter's start by which fixes behind its end could move it: their adjoint r has at
    most the covariance P^-1 of the filtered state there, and reaches the start as P T r."""
    worst = 0.0
    for axis in range(3):
        P0, P1 = c.start.P[:3, :3, axis], c.end().P[:3, :3, axis]
        row = P0[D] @ T[:3, :3, axis]
        moved = float(row @ np.linalg.solve(P1, row))
        left = float(P0[D, D] - P0[D] @ behind.n[:3, :3, axis] @ P0[D])
        worst = max(worst, math.sqrt(max(moved, 0.0) / left) if left > 0 else math.inf)
    return worst


# ---------------------------------------------------------------------------------------------------------- second way


def two_filter(fixes: Fixes, accel: Accelerations, noise: Noise) -> tuple[F64, F64]:
    """x (n, 3, 3) = [d v b] and its covariance (n, 3, 3, 3), fix, state, axis, by two filters; for records without
    jumps, some thousand fixes a second. The prior at the first fix is that of `begin`.

    Forward: a Kalman filter. Backward: an information filter Y, y that knows nothing at the end. They meet at each
    fix: P = (Pf^-1 + Y)^-1.
    """
    reference = _reference(accel)
    start = begin(fixes)
    inc = increments(fixes.t_ns, accel, reference)
    n = len(fixes)
    dts = np.diff(fixes.t_ns) * NS
    use = np.isfinite(fixes.z_m) & np.isfinite(fixes.std_m)
    x_f, P_f = np.empty((n, 3, 3)), np.empty((n, 3, 3, 3))
    x, P = start.x[:3].T.copy(), np.moveaxis(start.P[:3, :3], -1, 0).copy()  # axis, state
    x_f[0], P_f[0] = x, P
    F, Q, u = np.empty((n - 1, 3, 3)), np.empty((n - 1, 3, 3, 3)), np.zeros((n - 1, 3, 3))
    for k, t in enumerate(dts):
        F[k] = [[1, t, -t * t / 2], [0, 1, -t], [0, 0, 1]]
        white = np.array([[t**3 / 3, t**2 / 2, 0], [t**2 / 2, t, 0], [0, 0, 0]])
        walk = np.array(
            [[t**5 / 20, t**4 / 8, -(t**3) / 6], [t**4 / 8, t**3 / 3, -(t**2) / 2], [-(t**3) / 6, -(t**2) / 2, t]]
        )
        Q[k] = (noise.q + inc.extra[:, k])[:, None, None] * white + noise.qb[:, None, None] * walk
        u[k, :, 0], u[k, :, 1] = inc.s2[:, k], inc.s1[:, k]
        x = x @ F[k].T + u[k]
        P = F[k] @ P @ F[k].T + Q[k]
        for a in np.flatnonzero(use[k + 1]).tolist():
            R = fixes.std_m[k + 1, a] ** 2
            gain = P[a, :, 0] / (P[a, 0, 0] + R)
            IKH = np.eye(3) - np.outer(gain, [1, 0, 0])
            x[a] += gain * (fixes.z_m[k + 1, a] - x[a, 0])
            P[a] = IKH @ P[a] @ IKH.T + R * np.outer(gain, gain)
        x_f[k + 1], P_f[k + 1] = x, P
    Y, y = np.zeros((3, 3, 3)), np.zeros((3, 3))
    out_x, out_P = np.empty((n, 3, 3)), np.empty((n, 3, 3, 3))
    for k in range(n - 1, -1, -1):
        for a in range(3):
            inverse = np.linalg.inv(np.eye(3) + P_f[k, a] @ Y[a])
            out_P[k, :, :, a] = inverse @ P_f[k, a]
            out_x[k, :, a] = inverse @ (x_f[k, a] + P_f[k, a] @ y[a])
        if k == 0:
            break
        for a in range(3):
            if use[k, a]:
                w = 1.0 / fixes.std_m[k, a] ** 2
                Y[a, 0, 0] += w
                y[a, 0] += w * fixes.z_m[k, a]
            # over the interval backwards: x[k] = F x[k-1] + u + noise
            G = np.linalg.inv(np.eye(3) + Y[a] @ Q[k - 1, a])
            Y_open = G @ Y[a]
            y_open = G @ y[a] - Y_open @ u[k - 1, a]
            Y[a] = F[k - 1].T @ Y_open @ F[k - 1]
            Y[a] = 0.5 * (Y[a] + Y[a].T)
            y[a] = F[k - 1].T @ y_open
    return out_x, out_P
