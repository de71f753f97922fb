"""Displacements against each other in the busiest minutes of a point: second differences of the fused, smoothed and raw
displacement against the accelerations, accelerations integrated twice beside the smoothed displacement, and frequency-
split fusion beside the live filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64, S
from edge_agent.review.integrate import Differences, Overlay, double_integral, second_difference
from edge_agent.review.likelihood import fit
from edge_agent.review.smooth import Accelerations, Fixes, Noise, smooth, two_filter
from edge_agent.review.splits import Split

OVERLAY_S = 20.0
"""Seconds that accelerations are integrated alone."""
NOISE_FIXES = 1000
SECOND_WAY = 300
"""Fixes that are smoothed a second way."""
SETTLE_S, SETTLE_PERIODS = 20.0, 10.0
"""Begin of a stretch in which the D-type's filter is still starting: the longer of both."""
FIX_GAP_S = 3.0
"""Where fixes are further apart the split has nothing to go by."""


@dataclass
class Checks:
    """`differences` by what was differenced: "live", "smoothed", "raw GNSS"; smoothed t_ns (n,), m (n, 3) at the
    accelerations; `overlay` with the rows of the smoothed stream that it stands beside."""

    differences: dict[str, Differences] = field(default_factory=dict)
    smoothed: tuple[I64, F64] = field(default_factory=lambda: (np.zeros(0, np.int64), np.zeros((0, 3))))
    overlay: Overlay | None = None
    overlay_rows: slice = field(default_factory=lambda: slice(0))
    second_way: tuple[float, int] = (math.nan, 0)
    """Largest difference [m] of the smoothed displacement from that of the two-filter smoother, over how many fixes."""


def check(fixes: Fixes, accel: Accelerations, live: tuple[I64, F64], low_hz: float, high_hz: float) -> Checks:
    """Second differences between two frequencies, and the overlay where it moves most. ValueError where the record is
    too short to be smoothed."""
    found = Checks()
    noise = fit(fixes, accel, most=NOISE_FIXES).noise
    s = smooth(fixes, accel, noise, std=False)
    found.second_way = _second_way(fixes, accel, noise)
    found.smoothed = s.t_ns, s.displacement_m
    for name, t, d in (("live", *live), ("smoothed", s.t_ns, s.displacement_m), ("raw GNSS", fixes.t_ns, fixes.z_m)):
        if len(t) < 200:
            continue
        high = min(high_hz, 0.25 * S / float(np.median(np.diff(t))))
        if low_hz < 0.5 * high:
            found.differences[name] = second_difference(t, d, accel, low_hz, high)
    rate = S / float(np.median(np.diff(s.t_ns)))
    n = round(OVERLAY_S * rate)
    if len(s.t_ns) > 2 * n:
        speed = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(s.displacement_m, axis=0)).sum(axis=1))])
        at = int(np.argmax(speed[n:] - speed[:-n]))
        rows = slice(at, at + n)
        inside = (accel.t_ns >= s.t_ns[at]) & (accel.t_ns <= s.t_ns[at + n - 1])
        bias = np.nanmean(accel.xyz[inside], axis=0)
        found.overlay = double_integral(accel, s.t_ns[rows], s.displacement_m[at], s.velocity_mps[at], bias)
        found.overlay_rows = rows
    return found


def _second_way(fixes: Fixes, accel: Accelerations, noise: Noise) -> tuple[float, int]:
    """The smoother against one that shares no recursion with it."""
    part = fixes.part(0, SECOND_WAY)
    inside = (accel.t_ns >= part.t_ns[0] - S) & (accel.t_ns <= part.t_ns[-1] + S)
    near = Accelerations(accel.t_ns[inside], accel.xyz[inside])
    x, _ = two_filter(part, near, noise)
    return float(np.abs(smooth(part, near, noise, std=False).x[:, 0] - x[:, 0]).max()), len(part)


@dataclass(frozen=True)
class Apart:
    """A split beside the live filter: `fair` (n,) where both have what they need, the filter (n, 3) on its grid;
    there, per axis (3,): rms of G-type, D-type and merged less the filter [m], about the median, and of the filter;
    seconds that are fair, share of D-type."""

    fair: npt.NDArray[np.bool_]
    live_m: F64
    g_type_m: F64
    d_type_m: F64
    merged_m: F64
    filter_m: F64
    seconds: float
    d_share: float


def apart(split: Split, taken_ns: I64, live: tuple[I64, F64]) -> Apart | None:
    """`taken_ns`: times of the fixes that the gate took; None where there is less than ten seconds to compare."""
    t = split.t_ns
    t_f, d = live
    if len(t_f) < 2 or len(taken_ns) < 2:
        return None
    settle = max(SETTLE_S, SETTLE_PERIODS / split.critical_hz) * S
    fair = (t >= t[0] + settle) & (t <= t[-1] - settle)
    i = np.clip(np.searchsorted(taken_ns, t), 1, len(taken_ns) - 1)
    fair &= (taken_ns[i] - taken_ns[i - 1]) <= FIX_GAP_S * S
    k = np.clip(np.searchsorted(t_f, t), 1, len(t_f) - 1)
    fair &= ((t_f[k] - t_f[k - 1]) <= 0.2 * S) & (t >= t_f[0]) & (t <= t_f[-1])
    rate = S / float(np.median(np.diff(t)))
    if fair.sum() < 10.0 * rate:
        return None
    at = ((t - t[0]) / S, (t_f - t[0]) / S)
    filtered = np.stack([np.interp(*at, d[:, j]) for j in range(3)], axis=1)

    def rms(x: F64) -> F64:
        rest = (x - filtered)[fair]
        return np.asarray(np.sqrt(np.mean((rest - np.median(rest, axis=0)) ** 2, axis=0)))

    return Apart(
        fair, filtered, rms(split.g_type_m), rms(split.d_type_m), rms(split.displacement_m),
        np.asarray(filtered[fair].std(axis=0)), float(fair.sum()) / rate, float(split.kind[fair].mean()),
    )  # fmt: skip


def liveliest(x: F64, fair: npt.NDArray[np.bool_], n: int) -> int | None:
    """First row of the n rows, nearly all of them fair, in which x (m, c) moves most; None where there are none."""
    if len(x) <= n:
        return None
    speed = np.concatenate([[0.0], np.abs(np.diff(x, axis=0)).sum(axis=1)]) * fair
    total, good = (np.concatenate([[0.0], np.cumsum(v)]) for v in (speed, fair.astype(np.float64)))
    moved, share = total[n:] - total[:-n], (good[n:] - good[:-n]) / n
    moved = np.where(share >= 0.95, moved, -math.inf)
    at = int(np.argmax(moved))
    return at if math.isfinite(float(moved[at])) else None
