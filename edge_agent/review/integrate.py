"""Accelerations and displacements against each other: double integration, and second differences.

Overlay (Lima et al.): accelerations integrated twice from a known state show what the accelerometer says alone, and how
fast that drifts. Second difference (Wang et al.): the fused displacement, differenced twice, must be the acceleration
again, also on an axis that hardly moves, where the raw fixes are noise. Filters here have no phase: they weight the
Fourier transform with cosine flanks, low + high = 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge_agent.messages import F64, I64
from edge_agent.review.smooth import NS, Accelerations, bridged

FLANK = 0.25
"""Half width of a filter's flank, as a share of its cut."""


def low_pass(x: F64, rate_hz: float, cut_hz: float) -> F64:
    """Columns of x (n, c) below cut_hz. The ends are mirrored about their last value, so a slope goes on."""
    n = len(x)
    pad = min(n - 1, int(4 * rate_hz / cut_hz))
    ext = np.concatenate([2 * x[0] - x[pad:0:-1], x, 2 * x[-1] - x[-2 : -pad - 2 : -1]]) if pad > 0 else x
    f = np.fft.rfftfreq(len(ext), 1 / rate_hz)
    s = np.clip((f / cut_hz - (1 - FLANK)) / (2 * FLANK), 0.0, 1.0)
    weight = 0.5 + 0.5 * np.cos(np.pi * s)
    trend = np.linspace(0.0, 1.0, len(ext))[:, None] * (ext[-1] - ext[0]) + ext[0]  # the transform sees no step
    out = np.fft.irfft(np.fft.rfft(ext - trend, axis=0) * weight[:, None], len(ext), axis=0) + trend
    return np.asarray(out[pad : pad + n])


def high_pass(x: F64, rate_hz: float, cut_hz: float) -> F64:
    """Columns of x (n, c) above cut_hz: x less `low_pass`."""
    return x - low_pass(x, rate_hz, cut_hz)


def band_pass(x: F64, rate_hz: float, low_hz: float, high_hz: float) -> F64:
    """Columns of x (n, c) between two frequencies."""
    return high_pass(low_pass(x, rate_hz, high_hz), rate_hz, low_hz)


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
class Overlay:
    """Accelerations alone, from a state at the first time: t_ns (n,), velocity_mps and displacement_m (n, 3)."""

    t_ns: I64
    velocity_mps: F64
    displacement_m: F64


def double_integral(accel: Accelerations, t_ns: I64, d0_m: F64, v0_mps: F64, bias_mps2: F64) -> Overlay:
    """Integrate accelerations less bias_mps2 (3,) twice over t_ns (n,) from d0, v0 (3,), first-order hold, no
    correction after the first time: it drifts with half the bias error times the square of the time."""
    t = np.asarray((t_ns - t_ns[0]) * NS, dtype=np.float64)
    about = np.nanmean(accel.xyz, axis=0)
    s1, s2 = (s[:, :, 0] for s in Integral(accel, int(t_ns[0])).between(t[:, None]))
    dt = np.diff(t, prepend=0.0)[:, None]
    v = np.cumsum(s1, axis=0)
    d = np.cumsum(s2 + np.concatenate([np.zeros((1, 3)), v[:-1]]) * dt, axis=0)
    rest = about - bias_mps2  # the integral was taken about the mean
    when = t[:, None]
    return Overlay(t_ns, v0_mps + v + rest * when, d0_m + v0_mps * when + d + 0.5 * rest * when * when)


def windowed_double_integral(a: F64, rate_hz: float, window_s: float, degree: int = 3) -> F64:
    """Displacement (n, 3) of high-passed accelerations a (n, 3), by windows (arch-bridge patent): each is integrated
    twice, a polynomial is taken off, and half-overlapping windows are faded into each other.

    Four of the longest periods make a window: in one, the polynomial takes motion with it.
    """
    n = len(a)
    size = max(2 * degree + 2, min(n, 2 * (round(window_s * rate_hz) // 2)))
    hop = max(1, size // 2)
    starts = [*range(0, max(n - size, 0), hop), max(n - size, 0)]
    out, weight = np.zeros((n, 3)), np.zeros((n, 1))
    x = np.linspace(-1.0, 1.0, min(size, n))
    base = np.polynomial.legendre.legvander(x, degree)
    solve = np.linalg.pinv(base)
    fade = (np.sin(np.pi * (np.arange(len(x)) + 0.5) / len(x)) ** 2)[:, None] + 1e-9
    for s in starts:
        part = a[s : s + size]
        h = 1.0 / rate_hz
        v = np.zeros_like(part)
        np.cumsum(0.5 * h * (part[1:] + part[:-1]), axis=0, out=v[1:])
        d = np.zeros_like(part)
        np.cumsum(h * v[:-1] + h * h / 6 * (2 * part[:-1] + part[1:]), axis=0, out=d[1:])
        d -= base @ (solve @ d)
        out[s : s + size] += d * fade
        weight[s : s + size] += fade
    return out / weight


@dataclass(frozen=True, slots=True)
class Differences:
    """Second difference of a displacement against the accelerations in one band, per axis (3,): correlation, gain
    (1 = the same size), rms of the acceleration and of the difference [m/s2]; and both curves (n, 3) at t_ns (n,)."""

    t_ns: I64
    from_displacement: F64
    from_accelerometer: F64
    correlation: F64
    gain: F64
    rms_mps2: F64
    rms_difference_mps2: F64


def second_difference(
    t_ns: I64, displacement_m: F64, accel: Accelerations, low_hz: float, high_hz: float
) -> Differences:
    """Compare on an even grid at the displacement's own rate. Both sides pass through the same second difference: the
    accelerations are integrated twice exactly before it, so no frequency response stands between them."""
    t = np.asarray((t_ns - t_ns[0]) * NS, dtype=np.float64)
    h = float(np.median(np.diff(t)))
    grid: F64 = np.arange(int(t[-1] / h) + 1, dtype=np.float64) * h
    d = np.stack([np.interp(grid, t, displacement_m[:, i]) for i in range(3)], axis=1)
    s1, s2 = (s[:, :, 0] for s in Integral(accel, int(t_ns[0])).between(grid[:, None]))
    mine = (d[2:] - 2 * d[1:-1] + d[:-2]) / (h * h)
    theirs = (s2[2:] - s2[1:-1] + s1[1:-1] * h) / (h * h)
    mine, theirs = (band_pass(y, 1 / h, low_hz, high_hz) for y in (mine, theirs))
    edge = min(len(mine) // 8, round(1.0 / (low_hz * h)))
    inside = slice(edge, len(mine) - edge)
    x, y = theirs[inside], mine[inside]
    xx, yy, xy = (x * x).sum(axis=0), (y * y).sum(axis=0), (x * y).sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation, gain = xy / np.sqrt(xx * yy), xy / xx
    times = t_ns[0] + np.rint(grid[1:-1] / NS).astype(np.int64)
    rms, rest = np.sqrt(np.mean(x * x, axis=0)), np.sqrt(np.mean((y - x) ** 2, axis=0))
    return Differences(times, mine, theirs, correlation, gain, rms, rest)
