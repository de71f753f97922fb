"""Do receiver and accelerometer tell of the same motion? Time offset, clock rate, mounting; and when they do not.

Judge is the likelihood of the fixes. A filter that knows nothing of the accelerometer (its noise by maximum
likelihood) turns the fixes into white innovations; the same filter turns the accelerations, moved by a trial offset,
into the innovations that they would cause. If both sensors see one motion, the first are a linear mixture of the
second: a regression. Its coefficients are the mounting (a 3x3 matrix M with a = M a_measured, the identity where the
configuration is right), what it explains is the likelihood of the offset. No assumption on yaw, sign or order of the
axes enters. A second regression leaves the yaw free in every window of some seconds: where it explains far more, the
sensors turn against the axes (a vehicle) and a fixed mounting is refused as not observable.

Offset: accelerometer time stamps + offset = receiver time. The scan takes both signs; where the best is found it is
refined together with rate and mounting by Gauss-Newton with the noise of both sensors, which gives the sd. The bound
var(offset) = 1 / sum(v^2/S) is reached by no other estimator.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from itertools import permutations

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64
from edge_agent.review.likelihood import SKIP, Fit, fit, gains, prepare, whiten
from edge_agent.review.smooth import NO_ACCELERATIONS, NS, Accelerations, Fixes, Noise, bridged

SEARCH_S = 60.0
LEAST = 15.0
"""Log likelihood that must be gained before anything is called found: e^15 outweighs thousands of trial offsets."""
APART = 10.0
"""Log likelihood by which the best offset must beat every other peak."""
OBSERVED = 0.1
"""Largest sd of a mounting coefficient that counts as observed: 6 degrees."""
WINDOW_S = 8.0
"""Yaw is held within so long where it is left free: a car turns a corner in it, a bridge never does."""
STEADY = 0.8
"""Yaw that is the same in all windows scores 1, and noise in it takes little; one turn of a car scores half."""
ALARM = 10.0
"""Log likelihood against the accelerometer in one window that is called a contradiction,"""
ALARM_EACH = 0.05
"""and so much more for every value in it: integrated noise costs a little where nothing moves."""
FEW, OFTEN = 2, 0.25
"""So many windows, or so large a share of them, may speak against the accelerometer where nothing can be found."""
RIVALS = 4
"""Hills of the scan that are looked at closely, where the highest does not stand out."""
MOST = 2400
"""Fixes that are looked at, where the motion is strongest: four minutes at 10 Hz,"""
NOISE = 1000
"""and those that the noise is estimated from."""
COARSE, COARSE_S = 1000, 0.25
"""The scan of all offsets takes so many of them, at least so far apart."""
FAST_MPS = 0.5
"""rms speed from which a receiver's own speeds say something: no structure reaches it, a vehicle does."""
CLOCK_S = 0.02
"""An offset below is within what receivers' latencies are known to."""


class Integral:
    """Accelerations integrated once for any trial time: seconds since `zero_ns`, gaps and both outsides at rest."""

    def __init__(self, accel: Accelerations, zero_ns: int) -> None:
        mean = np.nanmean(accel.xyz, axis=0)
        t_ns, a, _ = bridged(accel, mean, int(accel.t_ns[0]), int(accel.t_ns[-1]))
        self.t: F64 = np.asarray((t_ns - zero_ns) * NS, dtype=np.float64)
        self.a = a
        h = np.diff(self.t)
        total = a[:, :-1] + a[:, 1:]
        self.g1, self.g2 = np.zeros_like(a), np.zeros_like(a)
        np.cumsum(total * (0.5 * h), axis=1, out=self.g1[:, 1:])
        np.cumsum(h * (self.g1[:, :-1] + (total + a[:, :-1]) * (h / 6)), axis=1, out=self.g2[:, 1:])

    def between(self, t: F64) -> tuple[F64, F64]:
        """Single and double integrals over the intervals that end at t[1:] (n, O) s, led by a zero: two (n, 3, O)."""
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        s = t - self.t[i]
        before, behind = s < 0, t > self.t[-1]
        h = self.t[i + 1] - self.t[i]
        inside = np.clip(s, 0.0, h)
        rest = s - inside  # at rest outside: velocity goes on
        g1, g2 = np.empty((3, *t.shape)), np.empty((3, *t.shape))
        for axis in range(3):
            a0, a1 = self.a[axis][i], self.a[axis][i + 1]
            slope = (a1 - a0) / h
            g1[axis] = self.g1[axis][i] + inside * (a0 + 0.5 * slope * inside)
            g2[axis] = self.g2[axis][i] + inside * (self.g1[axis][i] + inside * (0.5 * a0 + slope * inside / 6))
            g2[axis] += rest * g1[axis] * (behind | before)
        s1, s2 = np.zeros((t.shape[0], 3, t.shape[1])), np.zeros((t.shape[0], 3, t.shape[1]))
        s1[1:] = np.diff(g1, axis=1).transpose(1, 0, 2)
        s2[1:] = (np.diff(g2, axis=1) - g1[:, :-1] * np.diff(t, axis=0)).transpose(1, 0, 2)
        return s1, s2


@dataclass(frozen=True, slots=True)
class Scan:
    """Log likelihood gained at each trial offset (O,) s: by a fixed mounting; with the yaw left free in every window,
    for a sensor of the same handedness and for a mirrored one."""

    offset_s: F64
    fixed: F64
    turning: F64
    mirrored: F64
    windows: int


@dataclass(frozen=True, slots=True)
class Offset:
    """Add value_s to the accelerometer's times; its clock is fast by rate_ppm. NaN where nothing is
    observable; `why` says what and how sure."""

    value_s: float
    std_s: float
    rate_ppm: float
    std_rate_ppm: float
    observable: bool
    why: str


@dataclass(frozen=True, slots=True)
class Mounting:
    """a = matrix (3, 3) x a_measured, with sd (3, 3); yaw_deg: the sensor must be turned by so much, counter-clockwise
    seen from above; axes: the nearest order and signs, e.g. ("+x", "+y", "+z")."""

    matrix: F64
    std: F64
    yaw_deg: float
    std_yaw_deg: float
    axes: tuple[str, str, str]
    observable: bool
    why: str


@dataclass(frozen=True, slots=True)
class Agreement:
    """What the two sensors say of each other. t_ns (n,): ends of windows; support (n,): log likelihood with against
    without the accelerometer as configured, per window; contradictions: spans (begin_ns, end_ns) of windows against it.
    verdict: "AGREE", "CONTRADICTION", "NOT OBSERVABLE"; text: one sentence for the head of the report. by_speed: the
    offset by the receiver's speeds in place of its positions, where it moves fast enough and told them."""

    verdict: str
    text: str
    offset: Offset
    mounting: Mounting
    scan: Scan
    t_ns: I64
    support: F64
    contradictions: list[tuple[int, int]] = field(default_factory=list)
    by_speed: Offset | None = None


def busiest(fixes: Fixes, accel: Accelerations, most: int = MOST) -> Fixes:
    """At most `most` neighbouring fixes, where the accelerations move most."""
    n = len(fixes)
    if n <= most:
        return fixes
    a = np.nan_to_num(accel.xyz - np.nanmedian(accel.xyz, axis=0))
    power = np.concatenate([[0.0], np.cumsum((a * a).sum(axis=1))])
    at = np.searchsorted(accel.t_ns, fixes.t_ns)
    best = int(np.argmax(power[at[most - 1 :]] - power[at[: n - most + 1]]))
    return fixes.part(best, best + most)


def thinned(fixes: Fixes, accel: Accelerations) -> Fixes:
    """Fewer fixes for the scan."""
    usual = float(np.median(np.diff(fixes.t_ns))) * NS
    every = max(1, round(COARSE_S / usual)) if usual > 0 else 1
    k = slice(None, None, every)
    thin = Fixes(fixes.t_ns[k], fixes.z_m[k], fixes.std_m[k], fixes.level[k], fixes.step[k])
    return busiest(thin, accel, COARSE)


class _Lanes:
    """Fixes and accelerations through the filter that knows nothing of the accelerometer. Four lanes: three axes, and
    one horizontal in which both axes have the same gains, so that a turn of the axes goes through it unchanged."""

    def __init__(self, fixes: Fixes, accel: Accelerations, alone: Fit) -> None:
        zero = int(fixes.t_ns[0])
        self.integral = Integral(accel, zero)
        self.t = np.asarray((fixes.t_ns - zero) * NS, dtype=np.float64)
        dt, z, std = prepare(fixes)
        across = np.sqrt(np.mean(std[:, :2] ** 2, axis=1))
        std = np.concatenate([std, across[:, None]], axis=1)
        r = np.maximum(alone.r, 1e-12)
        moves = [i for i in (0, 1) if alone.r[i] > 1e-9] or [0]
        ratios = [np.maximum(v / r, 1e-30) for v in (alone.noise.q, alone.noise.qb)]
        both = [np.append(v, math.exp(float(np.mean(np.log(v[moves]))))) for v in ratios]
        q, qb = (np.broadcast_to(v, std.shape) for v in both)
        self.gains = gains(dt, std, q, qb)
        inputs = np.zeros((len(z), 2, 4))
        inputs[:, 0, :3] = z
        inputs[:, :, 3] = z[:, :2]
        e = whiten(self.gains, np.zeros_like(inputs), np.zeros_like(inputs), inputs)
        e[:SKIP] = 0.0
        self.axes = e[:, 0, :3]
        self.plane = e[:, 0, 3] + 1j * e[:, 1, 3]
        window = np.floor(self.t / WINDOW_S).astype(np.int64)
        starts = np.flatnonzero(np.diff(window, prepend=-1))
        size = np.diff(np.append(starts, len(self.t)))
        self.starts, self.full = starts, size > 4

    def accelerations(self, offsets_s: F64) -> F64:
        """Innovations that the accelerations at trial offsets (O,) would cause: (n, 3 sensor axes, O, 4 lanes)."""
        n, count = len(self.t), len(offsets_s)
        s1, s2 = self.integral.between(self.t[:, None] - offsets_s)
        shape = (n, 3 * count, 4)
        w1, w2 = (np.broadcast_to(s.reshape(n, 3 * count)[:, :, None], shape) for s in (s1, s2))
        e = whiten(self.gains, w1, w2, np.broadcast_to(0.0, shape))
        e[:SKIP] = 0.0
        return -e.reshape(n, 3, count, 4)  # an innovation is fix less prediction

    def match(self, w: npt.NDArray[np.complex128]) -> tuple[npt.NDArray[np.complex128], F64]:
        """Per window: the sum of fixes times accelerations w (n, O), and the power of w."""
        power = np.add.reduceat(np.abs(w) ** 2, self.starts, axis=0)
        return np.add.reduceat(self.plane[:, None] * w.conj(), self.starts, axis=0), np.maximum(power, 1e-300)


def scan(lanes: _Lanes, offsets_s: F64) -> Scan:
    """Try every offset."""
    fixed, turning, mirrored = (np.zeros(len(offsets_s)) for _ in range(3))
    counts = np.maximum((lanes.axes != 0).sum(axis=0), 1)
    total = (lanes.axes**2).sum(axis=0)
    power = float((np.abs(lanes.plane) ** 2).sum())
    step = max(1, 1_000_000 // (12 * len(lanes.t)))
    for lo in range(0, len(offsets_s), step):
        k = slice(lo, lo + step)
        e = lanes.accelerations(offsets_s[k])
        for axis in range(3):
            X = e[..., axis]
            normal = np.einsum("njo,nko->ojk", X, X)
            right = np.einsum("njo,n->oj", X, lanes.axes[:, axis])
            explained = np.einsum("oj,oj->o", right, _solve(normal, right))
            left = np.maximum(total[axis] - explained, 1e-9 * total[axis] + 1e-300)
            fixed[k] += 0.5 * counts[axis] * np.log(max(total[axis], 1e-300) / left)
        w = e[:, 0, :, 3] + 1j * e[:, 1, :, 3]
        for out, other in ((turning, w), (mirrored, w.conj())):
            found, strength = lanes.match(other)
            explained = (np.abs(found) ** 2 / strength)[lanes.full].sum(axis=0)
            left = np.maximum(power - explained, 1e-9 * power + 1e-300)
            out[k] = counts[0] * np.log(max(power, 1e-300) / left)
    return Scan(offsets_s, fixed, turning, mirrored, int(lanes.full.sum()))


def steadiness(lanes: _Lanes, offset_s: float, mirrored: bool) -> tuple[float, int]:
    """How far the yaw is the same in all windows that show one, 1 = the same, and how many do (12 times the chance)."""
    e = lanes.accelerations(np.array([offset_s]))
    w = e[:, 0, :, 3] + 1j * e[:, 1, :, 3]
    found, strength = lanes.match(w.conj() if mirrored else w)
    found, strength = found[:, 0], strength[:, 0]
    gain = np.abs(found) ** 2 / strength
    size = np.diff(np.append(lanes.starts, len(lanes.t)))
    left = np.add.reduceat(np.abs(lanes.plane) ** 2, lanes.starts) - gain
    clear = lanes.full & (gain > 12 * np.maximum(left, 1e-300) / np.maximum(size - 1, 1))
    if not clear.any():
        return 1.0, 0
    return float(np.abs(found[clear].sum()) / np.abs(found[clear]).sum()), int(clear.sum())


def _solve(normal: F64, right: F64) -> F64:
    """Least squares with regressors that may be nothing: (O, k, k), (O, k) -> (O, k)."""
    k = normal.shape[-1]
    trace = np.einsum("ojj->o", normal)
    ridge = (1e-9 * trace + 1e-300)[:, None, None] * np.eye(k)
    return np.asarray(np.linalg.solve(normal + ridge, right[:, :, None])[:, :, 0])


@dataclass(frozen=True, slots=True)
class _Fine:
    """Refined: offset [s], rate [-] about mid_s, M and sd; gain: explained log likelihood under the noise used."""

    offset: float
    std_offset: float
    rate: float
    std_rate: float
    M: F64
    std_m: F64


def _refine(
    fixes: Fixes, accel: Accelerations, both: Fit, offset: float, M: F64, with_rate: bool, rounds: int = 6
) -> _Fine:
    zero = int(fixes.t_ns[0])
    integral = Integral(accel, zero)
    t = np.asarray((fixes.t_ns - zero) * NS, dtype=np.float64)
    mid, length = 0.5 * t[-1], float(t[-1])
    dt, z, std = prepare(fixes)
    r = np.maximum(both.r, 1e-12)
    rows = std.shape
    q, qb = (np.broadcast_to(v / r, rows) for v in (both.noise.q, both.noise.qb))
    rate, eps = 0.0, 0.25 * float(np.median(dt[1:]))
    y_in = z[:, None, :]
    filters = gains(dt, std, q, qb)
    e_y = whiten(filters, np.zeros_like(y_in), np.zeros_like(y_in), y_in)
    e_y[:SKIP] = 0.0
    # an axis without motion has a variance of nothing; it must not outweigh the others
    weight = np.where(r > 1e-9, 1.0 / np.sqrt(r), 0.0)
    lean = (t - mid) / length
    cov = np.full((11, 11), np.inf)
    for _ in range(rounds):
        at = t - offset - rate * (t - mid)
        moved = np.stack([at, at - eps, at + eps, at - eps * lean, at + eps * lean], axis=1)
        s1, s2 = (s.reshape(len(t), 15)[:, :, None] * np.ones(3) for s in integral.between(moved))
        e = whiten(filters, s1, s2, np.broadcast_to(0.0, s1.shape))
        e[:SKIP] = 0.0
        e = -e.reshape(len(t), 3, 5, 3)
        X = np.zeros((3, len(t), 11))
        Y = np.zeros((3, len(t)))
        for axis in range(3):
            own = e[..., axis]
            X[axis, :, 3 * axis : 3 * axis + 3] = own[:, :, 0]
            X[axis, :, 9] = (own[:, :, 1] - own[:, :, 2]) @ M[axis] / (2 * eps)
            if with_rate:
                X[axis, :, 10] = (own[:, :, 3] - own[:, :, 4]) @ M[axis] / (2 * eps) * length
            X[axis] *= weight[axis]
            Y[axis] = e_y[:, 0, axis] * weight[axis]
        A, y = X.reshape(-1, 11), Y.ravel()
        size = np.sqrt((A * A).sum(axis=0))
        known = size > 1e-9 * size.max()
        theta, cov = np.zeros(11), np.full((11, 11), np.inf)
        B = A[:, known] / size[known]
        normal = B.T @ B + 1e-12 * np.eye(int(known.sum()))
        theta[known] = np.linalg.solve(normal, B.T @ y) / size[known]
        cov[np.ix_(known, known)] = np.linalg.inv(normal) / np.outer(size[known], size[known])
        M = theta[:9].reshape(3, 3)
        step = float(np.clip(theta[9], -eps, eps))
        offset += step
        rate += float(np.clip(theta[10], -2e-3, 2e-3))
        if abs(step) < 1e-5 and abs(theta[10]) < 1e-7:
            break
    sd = np.sqrt(np.diag(cov))
    return _Fine(offset, float(sd[9]), rate, float(sd[10]), M, sd[:9].reshape(3, 3))


def support(fixes: Fixes, accel: Accelerations, alone: Fit, both: Fit, window_s: float = 30.0) -> tuple[I64, F64, F64]:
    """Log likelihood of the fixes with against without the accelerometer in windows: their ends (k,), values (k,), and
    the loss (k,) that is an alarm.

    Both sides have the noise that suits them best over the record, but no side may be surer than the other that
    nothing moves: what is left is the motion itself."""
    zero = int(fixes.t_ns[0])
    t = np.asarray((fixes.t_ns - zero) * NS, dtype=np.float64)
    dt, z, std = prepare(fixes)
    integral = Integral(accel, zero)
    s1, s2 = (s for s in integral.between(t[:, None]))
    agile = Noise(np.maximum(alone.noise.q, both.noise.q), np.maximum(alone.noise.qb, both.noise.qb))
    total = np.zeros(len(t))
    for side, noise, sign in ((both, both.noise, 1.0), (alone, agile, -1.0)):
        w1, w2 = (s[:, None, :, 0] * (1.0 if side is both else 0.0) for s in (s1, s2))
        r = np.maximum(side.r, 1e-12)
        q, qb = (np.broadcast_to(v / r, std.shape) for v in (noise.q, noise.qb))
        filters = gains(dt, std, q, qb)
        e = whiten(filters, w1, w2, z[:, None, :])[:, 0]
        each = np.where(np.isfinite(std), np.log(filters.variance * r) + e * e / r, 0.0)
        total += sign * -0.5 * each.sum(axis=1)
    total[:SKIP] = 0.0
    covered = (fixes.t_ns >= accel.t_ns[0]) & (fixes.t_ns <= accel.t_ns[-1])
    total[~covered] = 0.0
    window = np.floor(t / window_s).astype(np.int64)
    starts = np.flatnonzero(np.diff(window, prepend=-1))
    ends = np.append(starts[1:], len(t)) - 1
    moving = np.isfinite(std) & (np.nanstd(fixes.z_m, axis=0) > 0)
    alarm = ALARM + ALARM_EACH * np.add.reduceat(moving.sum(axis=1), starts)
    return fixes.t_ns[ends], np.asarray(np.add.reduceat(total, starts)), np.asarray(alarm)


def turned(accel: Accelerations, offset_s: float, matrix: F64) -> Accelerations:
    """The accelerations at their right times and in the right axes."""
    return Accelerations(accel.t_ns + round(offset_s * 1e9), accel.xyz @ matrix.T)


def agree(fixes: Fixes, accel: Accelerations, *, search_s: float = SEARCH_S) -> Agreement:
    """Compare one receiver and one accelerometer. ValueError for less than 50 fixes or 50 samples."""
    if len(fixes) < 50 or len(accel.t_ns) < 50:
        raise ValueError("agree: 50 fixes and 50 accelerations at least")
    part = busiest(fixes, accel)
    alone = fit(part, NO_ACCELERATIONS, most=NOISE)
    few = thinned(part, accel)
    step = 0.25 * float(np.median(np.diff(few.t_ns))) * NS
    reach = math.ceil(search_s / step)
    lanes = _Lanes(few, accel, fit(few, NO_ACCELERATIONS, most=NOISE))
    found = scan(lanes, np.arange(-reach, reach + 1, dtype=np.float64) * step)
    _, fixed_rival = _peak(found.offset_s, found.fixed)
    flipped = bool(found.mirrored.max() > found.turning.max())
    free = found.mirrored if flipped else found.turning
    free_peak, free_rival = _peak(found.offset_s, free)
    k, f = int(np.argmax(found.fixed)), int(np.argmax(free))
    steady, clear = steadiness(lanes, free_peak, flipped)
    # each window brings coefficients of its own, which explain a unit each by chance
    turning = free[f] - found.windows > LEAST and free[f] - free_rival > APART and steady < STEADY and clear >= 5
    configured = fit(part, accel, most=NOISE)
    t_ns, gain, alarm = support(part, accel, alone, configured)
    begins = np.concatenate([part.t_ns[:1], t_ns[:-1]])
    bad = gain < -alarm
    against = list(zip(begins[bad].tolist(), t_ns[bad].tolist(), strict=True))
    if turning:
        close = scan(_Lanes(part, accel, alone), free_peak + 0.125 * step * np.arange(-16.0, 17.0))
        return _turning(found, close, flipped, t_ns, gain, against)
    if found.fixed[k] < LEAST:
        why = "no offset stands out: the motion is too small for the receiver, or the accelerations are too noisy"
        much = len(against) > max(FEW, OFTEN * len(t_ns))
        verdict = "CONTRADICTION" if much else "NOT OBSERVABLE"
        text = f"{why}; and they speak against the accelerometer" if much else why
        return Agreement(verdict, text, _no_offset(why), _no_mounting(why), found, t_ns, gain, against)
    tried = []
    busy = busiest(part, accel, NOISE)
    for peak in _hills(found.offset_s, found.fixed)[: RIVALS if found.fixed[k] - fixed_rival < 50 * APART else 1]:
        M = _coarse(busy, accel, alone, peak)
        fine = _refine(busy, accel, alone, peak, M, False, 3)
        both = fit(busy, turned(accel, fine.offset, fine.M), most=NOISE)
        tried.append((float(both.log_likelihood.sum()), fine, both))
    tried.sort(key=lambda row: -row[0])
    _, fine, both = tried[0]
    lead = tried[0][0] - tried[1][0] if len(tried) > 1 else float(found.fixed[k] - fixed_rival)
    fine = _refine(part, accel, both, fine.offset, fine.M, False)
    both = fit(part, turned(accel, fine.offset, fine.M), most=NOISE)
    fine = _refine(part, accel, both, fine.offset, fine.M, False)
    rated = _refine(part, accel, both, fine.offset, fine.M, True)
    sure = lead > APART and fine.std_offset < 0.25
    offset = _offset(fine, rated, sure, lead)
    mounting = _mounting(fine)
    better = float(both.log_likelihood.sum() - configured.log_likelihood.sum())
    wrong = []
    if sure and better > LEAST and abs(fine.offset) > max(3 * fine.std_offset, CLOCK_S):
        wrong.append(f"the accelerometer's clock is {abs(fine.offset):.3f} s {'early' if fine.offset > 0 else 'late'}")
    if better > LEAST and any(a not in ("?", b) for a, b in zip(mounting.axes, ("+x", "+y", "+z"), strict=True)):
        wrong.append(f"its axes stand as {' '.join(mounting.axes)}")
    elif better > LEAST and mounting.observable and abs(mounting.yaw_deg) > max(5.0, 3 * mounting.std_yaw_deg):
        wrong.append(f"it is turned by {mounting.yaw_deg:.1f} deg")
    if wrong or against:
        reasons = " and ".join(wrong) or "the fixes speak against the accelerations"
        text = f"receiver and accelerometer contradict each other: {reasons}"
        return Agreement("CONTRADICTION", text, offset, mounting, found, t_ns, gain, against)
    text = "receiver and accelerometer tell of the same motion"
    return Agreement("AGREE", text, offset, mounting, found, t_ns, gain, against)


def with_speeds(a: Agreement, fixes: Fixes, velocity_mps: F64, accel: Accelerations) -> Agreement:
    """The same with the offset by the receiver's speeds (n, 2) along x and y, NaN = not told.

    A receiver filters positions and speeds differently: the speed of one that measures it over the epoch before is half
    an epoch late. The two offsets differ by that, and which clock was meant is not for the data to say."""
    told = np.isfinite(velocity_mps).all(axis=1)
    if not a.offset.observable or told.mean() < 0.9 or np.sqrt(np.mean(velocity_mps[told] ** 2)) < FAST_MPS:
        return a
    t = (fixes.t_ns - fixes.t_ns[0]) * NS
    v = np.stack([np.interp(t, t[told], velocity_mps[told, i]) for i in range(2)], axis=1)
    z = fixes.z_m.copy()
    moved = 0.5 * (v[1:] + v[:-1]) * np.diff(t)[:, None]
    z[:, :2] = np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    other = agree(Fixes(fixes.t_ns, z, fixes.std_m, fixes.level, fixes.step), accel).offset
    if not other.observable:
        return a
    apart = other.value_s - a.offset.value_s
    text = f"{a.text}; by the receiver's speeds the offset is {other.value_s:.3f} s"
    if abs(apart) > CLOCK_S:
        late = "later" if apart > 0 else "earlier"
        text += f": it tells its speeds {abs(apart):.3f} s {late} than its positions"
    return replace(a, text=text, by_speed=other)


def _peak(offset_s: F64, value: F64) -> tuple[float, float]:
    """Offset of the highest value, refined by a parabola, and the highest value beyond its own hill."""
    k = int(np.argmax(value))
    lo = hi = k
    while lo > 0 and value[lo - 1] < value[lo]:
        lo -= 1
    while hi < len(value) - 1 and value[hi + 1] < value[hi]:
        hi += 1
    rest = np.concatenate([value[:lo], value[hi + 1 :]])
    rival = float(rest.max()) if len(rest) else 0.0
    best = float(offset_s[k])
    if 0 < k < len(value) - 1:
        a, b, c = value[k - 1 : k + 2].tolist()
        bend = a - 2 * b + c
        if bend < 0:
            best += 0.5 * (a - c) / bend * float(offset_s[1] - offset_s[0])
    return best, rival


def _hills(offset_s: F64, value: F64) -> list[float]:
    """Offsets of the local maxima, highest first."""
    inner = np.flatnonzero((value[1:-1] >= value[:-2]) & (value[1:-1] > value[2:])) + 1
    order = inner[np.argsort(-value[inner])]
    return [float(offset_s[i]) for i in order] or [float(offset_s[int(np.argmax(value))])]


def _coarse(fixes: Fixes, accel: Accelerations, alone: Fit, offset: float) -> F64:
    """Mounting at a trial offset by the regression of the scan; axes that say nothing keep the configured row."""
    fine = _refine(fixes, accel, alone, offset, np.eye(3), False, 1)
    seen = np.isfinite(fine.std_m).all(axis=1) & (fine.std_m.max(axis=1) < 0.5)
    return np.where(seen[:, None], fine.M, np.eye(3))


def _offset(fine: _Fine, rated: _Fine, sure: bool, lead: float) -> Offset:
    rate, sd = -1e6 * rated.rate, 1e6 * rated.std_rate
    if not sure:
        why = f"not observable: another offset is as likely (log likelihood ahead by {lead:.1f} only)"
        return Offset(math.nan, math.nan, math.nan, math.nan, False, why)
    known = math.isfinite(sd) and sd < 500.0
    why = f"found, ahead of every other offset by a log likelihood of {lead:.0f}"
    if not known:
        why += "; rate not observable"
    return Offset(fine.offset, fine.std_offset, rate if known else math.nan, sd if known else math.nan, True, why)


def _no_offset(why: str) -> Offset:
    return Offset(math.nan, math.nan, math.nan, math.nan, False, f"not observable: {why}")


def _no_mounting(why: str) -> Mounting:
    none = np.full((3, 3), np.nan)
    return Mounting(none, none, math.nan, math.nan, ("?", "?", "?"), False, f"not observable: {why}")


def _mounting(fine: _Fine) -> Mounting:
    M, sd = fine.M, fine.std_m
    names = []
    order = max(permutations(range(3)), key=lambda p: sum(_clear(M, sd, i, j) for i, j in enumerate(p)))
    for i, j in enumerate(order):
        if sd[i, j] >= OBSERVED or abs(M[i, j]) < 0.5:
            names.append("?")
        else:
            names.append(("+" if M[i, j] > 0 else "-") + "xyz"[j])
    plane = complex(M[0, 0] + M[1, 1], M[1, 0] - M[0, 1]) / 2
    mirror = complex(M[0, 0] - M[1, 1], M[1, 0] + M[0, 1]) / 2
    spread = 0.5 * math.sqrt(float((sd[:2, :2] ** 2).sum()) / 2) if np.isfinite(sd[:2, :2]).all() else math.inf
    known = spread < OBSERVED and abs(plane) > max(5 * spread, abs(mirror), 0.3)
    yaw = math.degrees(math.atan2(plane.imag, plane.real)) if known else math.nan
    sd_yaw = math.degrees(spread / abs(plane)) if known else math.nan
    blind = [axis for axis, name in zip("xyz", names, strict=True) if name == "?"]
    why = "found" if known else "yaw not observable: the motion does not tell the horizontal axes apart"
    if blind:
        why += f"; {', '.join(blind)} moved too little to be judged"
    return Mounting(M, sd, yaw, sd_yaw, (names[0], names[1], names[2]), known, why)


def _clear(M: F64, sd: F64, i: int, j: int) -> float:
    return abs(float(M[i, j])) / (1.0 + float(sd[i, j]) / OBSERVED)


def _turning(
    found: Scan, close: Scan, flipped: bool, t_ns: I64, gain: F64, against: list[tuple[int, int]]
) -> Agreement:
    free = close.mirrored if flipped else close.turning
    value, _ = _peak(close.offset_s, free)
    k = min(max(int(np.argmax(free)), 1), len(free) - 2)
    step = float(close.offset_s[1] - close.offset_s[0])
    bend = float(free[k - 1] - 2 * free[k] + free[k + 1]) / step**2
    std = 1.0 / math.sqrt(-bend) if bend < 0 else math.inf
    why = "found with the yaw left free; the arm between antenna and sensor is not modelled"
    offset = Offset(value, std, math.nan, math.nan, True, why)
    why = "the yaw between the sensors is not fixed, it turns during the record"
    if flipped:
        why += "; the sensor is mirrored (one axis has the wrong sign)"
    text = f"receiver and accelerometer contradict each other: {why}"
    if abs(value) > max(3 * std, CLOCK_S):
        text += f"; the accelerometer's clock is {abs(value):.3f} s {'early' if value > 0 else 'late'}"
    return Agreement("CONTRADICTION", text, offset, _no_mounting(why), found, t_ns, gain, against)
