"""Fusion split by frequency, as the arch-bridge patent describes it, beside the filter.

A critical frequency f_c, the structure's fundamental, divides. Where a stretch of time moves mainly above f_c it is
G-type: low-passed, interpolated fixes plus the windowed double integral of the high-passed accelerations. Where it
moves mainly below, it is D-type: high-passed accelerations and a forward multi-rate filter. The stretches are put
together in the order of time. Fixes and accelerations are split at half of f_c, where neither the structure's modes nor
its slow motion live.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge_agent.messages import F64, I64, U8
from edge_agent.review.integrate import high_pass, low_pass, windowed_double_integral
from edge_agent.review.likelihood import fit
from edge_agent.review.smooth import NS, Accelerations, Fixes, smooth
from edge_agent.review.spectra import peaks, uniform, welch

SPLIT = 0.5
"""Cut between fixes and accelerations, as a share of the critical frequency."""
PERIODS = 4.0
"""Longest periods in a window of integration."""
STRETCH_PERIODS = 20.0
"""Periods of f_c in a stretch that is of one type."""
G_TYPE, D_TYPE = 0, 1


@dataclass(frozen=True, slots=True)
class Split:
    """At t_ns (n,), an even grid at the accelerometer's rate: displacement_m (n, 3) merged, kind (n,) G_TYPE or D_TYPE,
    and both types over the whole record (n, 3)."""

    critical_hz: float
    t_ns: I64
    displacement_m: F64
    kind: U8
    g_type_m: F64
    d_type_m: F64


def critical_frequency(accel: Accelerations, low_hz: float = 0.05) -> float:
    """The lowest frequency at which accelerations clearly peak on some axis. ValueError where none does: give it."""
    stream = uniform(accel.t_ns, accel.xyz)
    seconds = len(stream.x) / stream.rate_hz
    segment = int(min(len(stream.x) / 4, stream.rate_hz * max(seconds / 16, 40.0)))
    spectrum = welch(stream.x, stream.rate_hz, segment, valid=stream.valid)
    found = []
    for axis in range(3):
        high = 0.4 * stream.rate_hz
        top = peaks(spectrum, axis, low_hz=low_hz, high_hz=high, above_db=10.0, width_hz=max(0.5, 20 * low_hz))
        found += [p.freq_hz for p in top[:1]]
    if not found:
        raise ValueError("splits: no clear peak in the accelerations; give the critical frequency")
    return min(found)


def split_fusion(fixes: Fixes, accel: Accelerations, critical_hz: float | None = None) -> Split:
    """Frequency-split fusion of one point, over the time that both sensors cover. ValueError for too short a record."""
    f_c = critical_frequency(accel) if critical_hz is None else critical_hz
    begin, end = max(fixes.t_ns[0], accel.t_ns[0]), min(fixes.t_ns[-1], accel.t_ns[-1])
    inside = (accel.t_ns >= begin) & (accel.t_ns <= end)
    t_ns, xyz = accel.t_ns[inside], accel.xyz[inside]
    if len(t_ns) < 16 or (end - begin) * NS < PERIODS / f_c:
        raise ValueError("splits: the record is shorter than four of the longest periods")
    stream = uniform(t_ns, xyz)
    rate = stream.rate_hz
    grid_ns = stream.begin_ns + np.rint(np.arange(len(stream.x)) / rate / NS).astype(np.int64)
    cut = SPLIT * f_c
    a = high_pass(stream.x - stream.x.mean(axis=0), rate, cut)
    known = np.isfinite(fixes.z_m).all(axis=1) & (fixes.level == 0)
    t_z, z = (fixes.t_ns[known] - stream.begin_ns) * NS, fixes.z_m[known]
    grid = np.arange(len(stream.x)) / rate
    slow = low_pass(np.stack([np.interp(grid, t_z, z[:, i]) for i in range(3)], axis=1), rate, cut)
    g_type = slow + high_pass(windowed_double_integral(a, rate, PERIODS / cut), rate, cut)
    accelerations = Accelerations(grid_ns, a)
    forward = smooth(fixes, accelerations, fit(fixes, accelerations, most=1000).noise, std=False, ahead=False)
    at = (forward.t_ns - stream.begin_ns) * NS
    d_type = np.stack([np.interp(grid, at, forward.displacement_m[:, i]) for i in range(3)], axis=1)
    kind = _kinds(slow, g_type, rate, f_c)
    share = _faded(kind, rate, f_c)[:, None]
    return Split(f_c, grid_ns, g_type * (1 - share) + d_type * share, kind, g_type, d_type)


def _kinds(slow: F64, g_type: F64, rate: float, f_c: float) -> U8:
    """Type of every sample: by which part of its stretch moves more, in velocity (where frequencies weigh alike)."""
    n = len(slow)
    size = max(4, min(n, round(STRETCH_PERIODS / f_c * rate)))
    count = max(1, n // size)
    which = np.minimum(np.arange(n) // size, count - 1)
    fast_v = np.diff(g_type - slow, axis=0, prepend=(g_type - slow)[:1])
    slow_v = np.diff(slow, axis=0, prepend=slow[:1])
    power = [np.bincount(which, (v * v).sum(axis=1), count) for v in (fast_v, slow_v)]
    kinds = np.where(power[0] >= power[1], G_TYPE, D_TYPE).astype(np.uint8)
    return np.asarray(kinds[which], dtype=np.uint8)


def _faded(kind: U8, rate: float, f_c: float) -> F64:
    """Share of D-type: its kind, faded over one period, so that stretches meet without a step."""
    n = max(1, round(rate / f_c))
    padded = np.pad(kind.astype(np.float64), (n // 2, n - 1 - n // 2), mode="edge")
    total = np.concatenate([[0.0], np.cumsum(padded)])
    return np.asarray((total[n:] - total[:-n]) / n)
