"""What each window of a record says for or against its accelerometer: do the fixes show the motion that it tells?

A filter that knows nothing of the accelerometer, quick enough to let pass what is faster than `MEMORY_S`, turns fixes
into innovations e and the accelerations' displacement into the innovations x that it would cause. Regressing e on x
gives the share of the told motion that the fixes show: 1 where the sensors agree, 0 where they tell of different
things, with a sd from what is left over. Both sides have the same filter, so neither is the surer that nothing moves,
and slow things (bias, temperature, multipath, a wrong fix that stays) pass through neither.

A window votes only where the accelerometer tells more than its own noise (the quietest part of its spectrum, sent
through the same filter) and more than the receiver's. Behind a gap or a blow, of which samples may have missed a part,
the filter forgets its velocity: no window is blamed for that. One window proves nothing, the majority does.

The other way round, fixes may move while the accelerometer tells of nothing: `stands_still`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64
from edge_agent.review import spectra
from edge_agent.review.integrate import Integral
from edge_agent.review.likelihood import SKIP, Fit, Gains, gains, log_likelihood, prepare, whiten
from edge_agent.review.smooth import NS, Accelerations, Fixes, increments

MEMORY_S, MEMORY_FIXES = 2.0, 3.0
"""Memory of the filter: the longer of both. Slower motion is left to bias and multipath."""
WINDOW_S, WINDOW_FIXES = 10.0, 40.0
"""A window is the longer of both, and longer still, down to WINDOWS of them, where little is told in one."""
WINDOWS, ENOUGH = 5, 40.0
"""sum(x^2 / r) that windows should have: the share is then known to 0.16."""
BLOW_S = 0.1
"""Velocity that samples may have missed in a blow: the highest acceleration for so long."""
LOUD = 4.0
"""A window votes where x has so many times the power of the sensor's own noise,"""
KNOWN = 0.2
"""and the share's sd is below this;"""
HALF = 0.5
"""for the accelerometer above this share, against it where the share is below by 2 sd."""
LEAST = 3
"""Windows that must speak against it, more than for it."""
FLOOR_S, FLOOR_HZ, FLOOR_SHARE = 8.0, 0.2, 0.1
"""A sensor's noise: of segments so long, above this frequency, the quantile of the density in the quietest segment."""
DEAD, DEAD_EACH = 10.0, 10.0
"""Fixes that need so many times the acceleration that the sensor tells of, beside a bias that walks, and gain so much
log likelihood in a window by it, moved without the accelerometer."""
QUIETEST = 1e-9
"""No sensor is quieter [m2/s3]; one that gives a single number all the time looks so."""
WALK = 1e-5
"""No bias is known to walk faster [m2/s5]: 20 to 90 mm/s2 in some minutes."""


class Windows(NamedTuple):
    """Per window: begin_ns, end_ns (k,) of fixes; share (k,) of the told motion that the fixes show, and its sd;
    support (k,): log likelihood of the fixes with against without the accelerometer; loud (k,): whether it told more
    than its own noise."""

    begin_ns: I64
    end_ns: I64
    share: F64
    std: F64
    support: F64
    loud: npt.NDArray[np.bool_]

    @property
    def favour(self) -> npt.NDArray[np.bool_]:
        return np.asarray(self._clear & (self.share > HALF))

    @property
    def against(self) -> npt.NDArray[np.bool_]:
        return np.asarray(self._clear & (self.share + 2 * self.std < HALF))

    @property
    def _clear(self) -> npt.NDArray[np.bool_]:
        return np.asarray(self.loud & (self.std < KNOWN))

    @property
    def together(self) -> tuple[float, float]:
        """Share over all windows in which the accelerometer told something, and its sd; NaN where there is none. No
        window weighs more than four average ones."""
        if not self.loud.any():
            return math.nan, math.nan
        w = 1.0 / self.std[self.loud] ** 2
        w = np.minimum(w, 4.0 * float(np.median(w)))
        mean = float((w * self.share[self.loud]).sum() / w.sum())
        spread = float(np.sqrt((w * w * (self.share[self.loud] - mean) ** 2).sum()) / w.sum())
        return mean, max(spread, float(np.sqrt((w * w * self.std[self.loud] ** 2).sum()) / w.sum()))

    @property
    def confirm(self) -> bool:
        """Whether the windows together speak for the accelerometer."""
        mean, std = self.together
        return std < KNOWN and mean - 2 * std > HALF and int(self.favour.sum()) >= int(self.against.sum())

    @property
    def refute(self) -> bool:
        """Whether most windows that say something speak against the accelerometer."""
        bad = int(self.against.sum())
        return bad >= LEAST and bad > int(self.favour.sum())


class Witness:
    """Fixes (n) of a point and its accelerometer, ready for questions. `alone`: the noise of the fixes by themselves,
    `both`: with the accelerometer, of which the walk of the bias is taken."""

    def __init__(self, fixes: Fixes, accel: Accelerations, alone: Fit, both: Fit) -> None:
        self.fixes, self.accel, self.alone = fixes, accel, alone
        self.dt, self.z, self.std = prepare(fixes)
        self.usual = float(np.median(self.dt[1:]))
        self.r = np.maximum(alone.r, 1e-12)
        self.weight = np.where(alone.r > 1e-9, 1.0 / np.sqrt(self.r), 0.0)  # an axis of which nothing is told
        self.t = np.asarray((fixes.t_ns - fixes.t_ns[0]) * NS, dtype=np.float64)
        declared = np.nanmedian(np.where(np.isfinite(self.std), self.std, np.nan), axis=0) ** 2
        memory = max(MEMORY_S, MEMORY_FIXES * self.usual)
        self.q = np.maximum(alone.noise.q / self.r, declared * self.usual / memory**4)
        walk = np.maximum(alone.noise.qb, both.noise.qb) / self.r
        self.qb = np.maximum(walk, declared * self.usual / memory**6)
        rate = 1.0 / (float(np.median(np.diff(accel.t_ns))) * NS)
        self.floor = noise_floor(accel)
        rng = np.random.default_rng(0)
        white = rng.standard_normal(accel.xyz.shape) * np.sqrt(self.floor * rate)
        step = rng.standard_normal(accel.xyz.shape) * np.sqrt(np.minimum(both.noise.qb, WALK) / rate)
        self.hiss = Integral(Accelerations(accel.t_ns, white + np.cumsum(step, axis=0)), int(fixes.t_ns[0]))
        covered = (fixes.t_ns >= accel.t_ns[0]) & (fixes.t_ns <= accel.t_ns[-1])
        covered[:SKIP] = False
        self.covered = covered
        self.long = 0.0  # of a window [s], by the motion as configured

    def windows(self, offset_s: float = 0.0, matrix: F64 | None = None) -> Windows:
        """With the accelerometer's clock moved and its axes turned: a = matrix (3, 3) a_measured."""
        M = np.eye(3) if matrix is None else matrix
        moved = Accelerations(self.accel.t_ns + round(offset_s / NS), self.accel.xyz @ M.T)
        g = gains(
            self.dt, self.std, self.q + missed(self.fixes, moved) / self.r, np.broadcast_to(self.qb, self.std.shape)
        )
        nothing = np.zeros((len(self.t), 1, 3))
        e = whiten(g, nothing, nothing, self.z[:, None])[:, 0]
        x = self._told(g, Integral(moved, int(self.fixes.t_ns[0])))
        hiss = self._told(g, self.hiss)
        for v in (e, x, hiss):
            v *= self.weight
            v[~self.covered] = 0.0
        if not self.long:
            self.long = max(WINDOW_S, WINDOW_FIXES * self.usual)
            power, count = float((x * x).sum()), max(1.0, float(self.t[-1]) / self.long)
            if power < ENOUGH * count:
                self.long = float(self.t[-1]) / max(min(count, float(WINDOWS)), power / ENOUGH) * (1 + 1e-9)
        starts = self._starts(self.long)
        ends = np.append(starts[1:], len(self.t)) - 1

        def total(v: F64) -> F64:
            return np.asarray(np.add.reduceat(v.sum(axis=1), starts))

        xx, ex, nn = total(x * x), total(e * x), total(hiss * hiss)
        some = np.maximum(xx, 1e-12)
        share = ex / some
        n = np.maximum(total((e != 0).astype(np.float64)), 1.0)
        left = np.maximum(total(e * e) - ex * share, 0.0) / n
        std = np.sqrt(np.maximum(left, 1.0) / some)
        # noise in what a regression stands on makes its coefficient small
        kept = np.clip(1.0 - nn / some, 1.0 - 1.0 / LOUD, 1.0)
        begin, end = self.fixes.t_ns[starts], self.fixes.t_ns[ends]
        return Windows(begin, end, share / kept, std / kept, ex - 0.5 * xx, (xx > LOUD * nn) & (n > 10))

    def _told(self, g: Gains, integral: Integral) -> F64:
        s1, s2 = (s[:, None, :, 0] for s in integral.between(self.t[:, None]))
        return -whiten(g, s1, s2, np.zeros_like(s1))[:, 0]  # an innovation is fix less prediction

    def stands_still(self) -> F64:
        """Acceleration that the fixes need, per axis (3,), over the largest density that the sensor tells of below
        their Nyquist frequency, where most windows need more than DEAD times that; 0 elsewhere."""
        s = _density(self.accel)
        low = (s.freq_hz >= 0.05) & (s.freq_hz <= 0.5 / self.usual)
        told = 0.5 * s.psd[low].max(axis=0) if low.any() else self.floor
        factors = DEAD * 10.0 ** np.arange(-3.0, 6.0)
        q = (factors[:, None] * np.maximum(told, QUIETEST)).ravel()
        axis = np.tile(np.arange(3), len(factors))
        std = self.std[:, axis]
        qb = np.full(len(q), WALK)
        g = gains(self.dt, std, *(np.broadcast_to(v / self.r[axis], std.shape) for v in (q, qb)))
        nothing = np.zeros((len(self.t), 1, len(q)))
        e = whiten(g, nothing, nothing, self.z[:, None, axis])[:, 0]
        value, r = log_likelihood(e, g.variance, std)
        value = value.reshape(-1, 3)
        each = np.where(np.isfinite(std), -0.5 * (np.log(g.variance * r) + e * e / r), 0.0)
        each[:SKIP] = 0.0
        each = each.reshape(len(self.t), -1, 3)
        starts = self._starts(max(WINDOW_S, WINDOW_FIXES * self.usual))
        bound = factors <= DEAD * 1.01
        out = np.zeros(3)
        for i in range(3):
            free, held = int(np.argmax(value[:, i])), int(np.argmax(np.where(bound, value[:, i], -np.inf)))
            clear = np.add.reduceat(each[:, free, i] - each[:, held, i], starts) > DEAD_EACH
            if not bound[free] and self.weight[i] and clear.sum() >= max(LEAST, 0.5 * len(starts)):
                out[i] = factors[free]
        return out

    def _starts(self, long: float) -> npt.NDArray[np.int64]:
        """First fixes of windows so long [s]; a last one of less than half belongs to the one before."""
        window = np.minimum(np.floor(self.t / long), max(math.floor(self.t[-1] / long - 0.5), 0))
        return np.flatnonzero(np.diff(window, prepend=-1.0))


def missed(fixes: Fixes, accel: Accelerations) -> F64:
    """Density (n, 3) [m2/s3] before each fix of the velocity that accelerations may have missed: in gaps, and in blows
    the highest acceleration for BLOW_S."""
    mean = np.nanmean(accel.xyz, axis=0)
    inc = increments(fixes.t_ns, accel, mean)
    out = np.zeros((len(fixes), 3))
    out[1:] = inc.extra.T
    blown = np.flatnonzero((out > 0).any(axis=1))
    if not len(blown):
        return out
    at = np.searchsorted(accel.t_ns, fixes.t_ns)
    for k in blown.tolist():
        a = accel.xyz[max(at[k - 1] - 1, 0) : at[k] + 1] - mean
        dt = float(fixes.t_ns[k] - fixes.t_ns[k - 1]) * NS
        if len(a):
            out[k] += (BLOW_S * np.nanmax(np.abs(a), axis=0)) ** 2 / dt
    return out


def _density(accel: Accelerations) -> spectra.Spectrum:
    u = spectra.uniform(accel.t_ns, accel.xyz)
    size = min(max(16, round(FLOOR_S * u.rate_hz)), len(u.x))
    try:
        return spectra.welch(u.x, u.rate_hz, size, valid=u.valid)
    except ValueError:  # gaps everywhere
        return spectra.welch(u.x, u.rate_hz, size)


def noise_floor(accel: Accelerations) -> F64:
    """Two-sided density (3,) of a sensor's own white noise [m2/s3]: motion only adds to it."""
    u = spectra.uniform(accel.t_ns, accel.xyz)
    size = min(max(16, round(FLOOR_S * u.rate_hz)), len(u.x))
    best = np.full(3, math.inf)
    for begin in range(0, len(u.x) - size + 1, size):
        s = spectra.welch(u.x[begin : begin + size], u.rate_hz, size)
        k = (s.freq_hz > FLOOR_HZ) & (s.freq_hz < 0.45 * u.rate_hz)
        # of exponentially distributed densities the quantile p stands at -ln(1 - p) of the mean
        quiet = np.quantile(s.psd[k], FLOOR_SHARE, axis=0) / -math.log1p(-FLOOR_SHARE)
        best = np.minimum(best, 0.5 * quiet)
    return np.where(np.isfinite(best), best, 0.0)


__all__ = ["Windows", "Witness", "missed", "noise_floor"]
