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
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64
from edge_agent.review.integrate import Integral
from edge_agent.review.likelihood import SKIP, Fit, fit, gains, prepare, whiten
from edge_agent.review.smooth import NO_ACCELERATIONS, NS, Accelerations, Fixes
from edge_agent.review.witness import KNOWN, Windows, Witness, missed

SEARCH_S = 60.0
LEAST = 15.0
"""Log likelihood that must be gained before anything is called found: e^15 outweighs thousands of trial offsets."""
APART = 10.0
"""Log likelihood by which the best offset must beat every other peak."""
OBSERVED = 0.1
"""Largest sd of a mounting coefficient that counts as observed: 6 degrees."""
SEEN = 0.3
"""Smallest coefficient that names an axis."""
WINDOW_S, WINDOW_FIXES = 8.0, 20.0
"""Yaw is held within so long where it is left free: a car turns a corner in it, a bridge never does."""
STEADY = 0.8
"""Yaw that is the same in all windows scores 1, and noise in it takes little; one turn of a car scores half."""
FEW = 3
"""Windows in which the accelerometer tells something, for a word on its scale."""
SCALE = 0.25
"""An axis whose scale is off by more than this, and four of its sd, is wrong."""
STEP = 20.0
"""Log likelihood that one window may bring for or against a clock or a mounting: they must mend most windows."""
NOISY = 0.75
"""Share of the accelerations' power, as a receiver sees it, that may be their noise."""
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
    """What the two sensors say of each other. verdict: "AGREE", "CONTRADICTION", "NOT OBSERVABLE"; text: one sentence
    for the head of the report; windows: what each window says of the accelerometer as it is configured. by_speed: the
    offset by the receiver's speeds in place of its positions, where it moves fast enough and told them."""

    verdict: str
    text: str
    offset: Offset
    mounting: Mounting
    scan: Scan
    windows: Windows
    by_speed: Offset | None = None

    @property
    def in_doubt(self) -> bool:
        """Whether what is fused of both sensors is in doubt."""
        return self.verdict == "CONTRADICTION"


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
    fixes: Fixes,
    accel: Accelerations,
    both: Fit,
    offset: float,
    M: F64,
    with_rate: bool,
    hiss: Integral | None = None,
    rounds: int = 6,
) -> _Fine:
    """`hiss`: noise like that of the accelerometer. Its share of what the regression stands on would make every
    coefficient too small, and is taken off."""
    zero = int(fixes.t_ns[0])
    integral = Integral(accel, zero)
    t = np.asarray((fixes.t_ns - zero) * NS, dtype=np.float64)
    mid, length = 0.5 * t[-1], float(t[-1])
    dt, z, std = prepare(fixes)
    r = np.maximum(both.r, 1e-12)
    q = both.noise.q / r + missed(fixes, turned(accel, offset, np.eye(3))) / r
    qb = np.broadcast_to(both.noise.qb / r, std.shape)
    window = max(WINDOW_S, WINDOW_FIXES * float(np.median(dt[1:])))
    starts = np.flatnonzero(np.diff(np.floor(t / window).astype(np.int64), prepend=-1))
    long = np.diff(np.append(starts, len(t)))
    trust = np.ones((3, len(t)))
    rate, eps = 0.0, 0.25 * float(np.median(dt[1:]))
    y_in = z[:, None, :]
    filters = gains(dt, std, q, qb)
    e_y = whiten(filters, np.zeros_like(y_in), np.zeros_like(y_in), y_in)
    e_y[:SKIP] = 0.0
    # an axis without motion has a variance of nothing; it must not outweigh the others
    weight = np.where(r > 1e-9, 1.0 / np.sqrt(r), 0.0)
    lean = (t - mid) / length
    noise = np.zeros((len(t), 3, 3))
    if hiss is not None:
        s1, s2 = (s.reshape(len(t), 3)[:, :, None] * np.ones(3) for s in hiss.between(t[:, None]))
        noise = whiten(filters, s1, s2, np.broadcast_to(0.0, s1.shape))
        noise[:SKIP] = 0.0
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
            X[axis] *= weight[axis] * trust[axis][:, None]
            Y[axis] = e_y[:, 0, axis] * weight[axis] * trust[axis]
        A, y = X.reshape(-1, 11), Y.ravel()
        size = np.sqrt((A * A).sum(axis=0))
        known = size > 1e-9 * size.max()
        theta, cov = np.zeros(11), np.full((11, 11), np.inf)
        B = A[:, known] / size[known]
        normal = B.T @ B + 1e-12 * np.eye(int(known.sum()))
        own = np.einsum("nji,in->ij", noise * noise, (trust * weight[:, None]) ** 2).ravel()
        own = np.append(own, (0.0, 0.0))[known] / size[known] ** 2
        normal -= np.diag(np.minimum(own, NOISY))
        theta[known] = np.linalg.solve(normal, B.T @ y) / size[known]
        cov[np.ix_(known, known)] = np.linalg.inv(normal) / np.outer(size[known], size[known])
        left = (Y - X @ theta) / trust  # of each axis
        each = np.add.reduceat(left * left, starts, axis=1) / long
        # a window of which the model explains less than of the others has more noise than they
        trust = np.repeat(
            1.0 / np.sqrt(np.maximum(each / np.maximum(np.median(each, axis=1), 1.0)[:, None], 1.0)), long, 1
        )
        score = np.add.reduceat((A * (y - A @ theta)[:, None]).reshape(3, len(t), 11), starts, axis=1).sum(axis=0)
        M = theta[:9].reshape(3, 3)
        step = float(np.clip(theta[9], -eps, eps))
        offset += step
        rate += float(np.clip(theta[10], -2e-3, 2e-3))
        if abs(step) < 1e-5 and abs(theta[10]) < 1e-7:
            break
    # where neighbours are not independent the scatter of the windows tells the sd, not the curvature
    ok = np.isfinite(np.diag(cov))
    bread = np.where(ok[:, None] & ok, cov, 0.0)
    more = len(starts) / max(len(starts) - int(ok.sum()) / 3, 1.0)
    spread = np.diag(bread @ (score.T @ score) @ bread) * more
    sd = np.sqrt(np.where(ok, np.maximum(np.diag(cov), spread), np.inf))
    return _Fine(offset, float(sd[9]), rate, float(sd[10]), M, sd[:9].reshape(3, 3))


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
    witness = Witness(part, accel, alone, configured)
    now = witness.windows()
    if turning and not now.confirm:
        close = scan(_Lanes(part, accel, alone), free_peak + 0.125 * step * np.arange(-16.0, 17.0))
        return _turning(found, close, flipped, now)
    why = "the motion is too small for the receiver, or the accelerations are too noisy"
    if found.fixed[k] < LEAST:
        return _judged(_no_offset(why), _no_mounting(why), found, now, witness, [])
    tried = []
    busy = busiest(part, accel, NOISE)
    hills = _hills(found.offset_s, found.fixed)[: RIVALS if found.fixed[k] - fixed_rival < 50 * APART else 1]
    if now.confirm:  # they agree as they are: what is asked is how well
        hills = [_climbed(found.offset_s, found.fixed)]
    for peak in hills:
        M = _coarse(busy, accel, alone, peak)
        fine = _refine(busy, accel, alone, peak, M, False, rounds=3)
        both = fit(busy, turned(accel, fine.offset, fine.M), most=NOISE)
        tried.append((float(both.log_likelihood.sum()), fine, both))
    tried.sort(key=lambda row: -row[0])
    _, fine, both = tried[0]
    lead = tried[0][0] - tried[1][0] if len(tried) > 1 else float(found.fixed[k] - fixed_rival)
    fine = _refine(part, accel, both, fine.offset, fine.M, False)
    both = fit(part, turned(accel, fine.offset, fine.M), most=NOISE)
    fine = _refine(part, accel, both, fine.offset, fine.M, False, witness.hiss)
    rated = _refine(part, accel, both, fine.offset, fine.M, True, witness.hiss)
    sure = (lead > APART or now.confirm) and fine.std_offset < 0.25
    offset = _offset(fine, rated, sure, lead)
    mounting = _mounting(fine)
    wrong, borne_out = _wrong(offset, mounting, now, witness)
    turned_by = mounting.observable and abs(mounting.yaw_deg) > 3 * mounting.std_yaw_deg
    if not borne_out and (turned_by or not now.confirm):
        mounting = _no_mounting("most of the record is none the better for what is likeliest")
    if offset.observable and not borne_out and abs(offset.value_s) > max(3 * offset.std_s, CLOCK_S):
        offset = _no_offset(
            f"{offset.value_s:+.3f} s is the likeliest, but most of the record is none the better for it"
        )
    return _judged(offset, mounting, found, now, witness, wrong)


def _wrong(offset: Offset, mounting: Mounting, now: Windows, witness: Witness) -> tuple[list[str], bool]:
    """What a clock or a mounting that was found explains, and whether most windows are the better for it; if not,
    nothing is told."""
    wrong = []
    value, M = 0.0, np.eye(3)
    if offset.observable and abs(offset.value_s) > max(3 * offset.std_s, CLOCK_S):
        value = offset.value_s
        wrong.append(f"the accelerometer's clock is {abs(value):.3f} s {'early' if value > 0 else 'late'}")
    off = [
        (name, float(m), float(sd))
        for name, axis, m, sd in zip("xyz", mounting.axes, np.diag(mounting.matrix), np.diag(mounting.std), strict=True)
        if axis == "+" + name and abs(m - 1.0) > max(SCALE, 4 * sd)
    ]
    if any(a not in ("?", b) for a, b in zip(mounting.axes, ("+x", "+y", "+z"), strict=True)):
        wrong.append(f"its axes stand as {' '.join(mounting.axes)}")
        M = mounting.matrix
    elif mounting.observable and abs(mounting.yaw_deg) > max(5.0, 3 * mounting.std_yaw_deg):
        wrong.append(f"it is turned by {mounting.yaw_deg:.1f} deg")
        M = mounting.matrix
    elif off:
        told = ", ".join(f"{m:.2f} \u00b1 {sd:.2f} along {name}" for name, m, sd in off)
        wrong.append(f"its scale is wrong: the fixes show {told} of what it tells")
        M = mounting.matrix
    if not wrong:
        return [], False
    known = np.isfinite(M) & np.isfinite(mounting.std) & (mounting.std < 0.5)
    better = witness.windows(value, np.where(known, M, np.eye(3))).support - now.support
    gain = float(np.clip(better, -STEP, STEP).sum())
    borne_out = gain > LEAST and bool((better > 0).sum() > (better < 0).sum())
    return (wrong, True) if borne_out else ([], False)


def _percent(share: float, sd: float) -> str:
    return f"{100 * share:.0f} \u00b1 {max(100 * sd, 1.0):.0f} %".replace("-", "\u2212")


def _judged(
    offset: Offset, mounting: Mounting, found: Scan, now: Windows, witness: Witness, wrong: list[str]
) -> Agreement:
    """The verdict, and the words for it."""
    still = witness.stands_still() if not now.confirm else np.zeros(3)
    reasons = list(wrong)
    if not reasons and now.refute:
        told = _percent(*now.together)
        reasons.append(f"the fixes do not show the motion that the accelerations tell, but {told} of it")
    share, sd = now.together
    if not reasons and sd < KNOWN and now.loud.sum() >= FEW and abs(share - 1.0) - 4 * sd > SCALE:
        reasons.append(f"the fixes show {_percent(share, sd)} of the motion that the accelerations tell")
    if not reasons and still.any():
        axes = ", ".join(name for name, v in zip("xyz", still, strict=True) if v)
        reasons.append(f"the fixes move along {axes} while the accelerations tell of nothing that could move them")
    if reasons:
        text = f"receiver and accelerometer contradict each other: {' and '.join(reasons)}"
        return Agreement("CONTRADICTION", text, offset, mounting, found, now)
    if now.confirm:
        told = _percent(share, sd)
        text = (
            f"receiver and accelerometer tell of the same motion: the fixes show {told} of what the accelerations tell"
        )
        return Agreement("AGREE", text, offset, mounting, found, now)
    why = "whether the sensors agree is not observable: no motion stands out of the noise of both that would decide it"
    return Agreement("NOT OBSERVABLE", why, offset, mounting, found, now)


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


def _climbed(offset_s: F64, value: F64) -> float:
    """Top of the hill on which no offset lies."""
    k = int(np.argmin(np.abs(offset_s)))
    while 0 < k < len(value) - 1 and value[k] < max(value[k - 1], value[k + 1]):
        k += 1 if value[k + 1] > value[k - 1] else -1
    return float(offset_s[k])


def _hills(offset_s: F64, value: F64) -> list[float]:
    """Offsets of the local maxima, highest first."""
    inner = np.flatnonzero((value[1:-1] >= value[:-2]) & (value[1:-1] > value[2:])) + 1
    order = inner[np.argsort(-value[inner])]
    return [float(offset_s[i]) for i in order] or [float(offset_s[int(np.argmax(value))])]


def _coarse(fixes: Fixes, accel: Accelerations, alone: Fit, offset: float) -> F64:
    """Mounting at a trial offset by the regression of the scan; axes that say nothing keep the configured row."""
    fine = _refine(fixes, accel, alone, offset, np.eye(3), False, rounds=1)
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
        if sd[i, j] >= 2 * OBSERVED or abs(M[i, j]) < max(SEEN, 4 * sd[i, j]):
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


def _turning(found: Scan, close: Scan, flipped: bool, now: Windows) -> Agreement:
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
    return Agreement("CONTRADICTION", text, offset, _no_mounting(why), found, now)
