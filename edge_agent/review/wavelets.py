"""When a structure moved at which frequency: wavelets of the fused displacement in the busiest minutes of a point, and
the motion of single modes taken out of it, beside the same band of the raw fixes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge_agent.messages import F64, I64, S
from edge_agent.review.modal import thinned
from edge_agent.review.spectra import Scalogram, band, scalogram, uniform

OCTAVE = 12
"""Frequencies to an octave."""
WIDE = 1.2
"""A band reaches from its frequency divided by this to that times this, and no further than half way to the next."""
BANDS = 3
SAMPLED = 4.0
"""Samples to a period of the highest frequency."""
LEAST = 256


class Banded(NamedTuple):
    """Motion between two frequencies: t_ns UTC (n,), fused value_m (n,), raw fixes t_ns, m; rms [m] of both without the
    stretches at the ends in which the record's ends are felt (NaN: too short, or fixes too rare)."""

    freq_hz: float
    low_hz: float
    high_hz: float
    t_ns: I64
    value_m: F64
    fixes_t_ns: I64
    fixes_m: F64
    rms_m: float
    fixes_rms_m: float
    largest_m: float


class Wavelets(NamedTuple):
    """Of one axis: begin UTC ns, power of the fused displacement [m2], bands."""

    axis: int
    begin_ns: int
    seconds: float
    scalogram: Scalogram
    bands: list[Banded]


def wavelets(
    fused: tuple[I64, F64], fixes: tuple[I64, F64], freq_hz: Sequence[float], utc_minus_ns: int
) -> Wavelets | None:
    """From fused displacement (n, 3) and fixes (m, 3) at monotonic times and frequencies of the structure; None where
    there are too few samples or no frequency. The axis is the one that moves most in their range."""
    t, d = fused
    if len(t) < LEAST or not freq_hz:
        return None
    u = uniform(t, d)
    seconds = len(u.x) / u.rate_hz
    high = min(1.8 * max(freq_hz), 0.45 * u.rate_hz)
    low = max(0.5 * min(freq_hz), 4.0 / seconds)
    shown = [f for f in freq_hz if low < f < high]
    if not shown or high <= low:
        return None
    x, rate = thinned(u.x, u.rate_hz, SAMPLED * high)
    spectrum = np.abs(np.fft.rfft(x, axis=0)) ** 2
    lines: F64 = np.arange(len(spectrum), dtype=np.float64) * (rate / len(x))
    inside = (lines >= 0.8 * min(shown)) & (lines <= 1.25 * max(shown))
    axis = int(np.argmax(spectrum[inside].sum(axis=0)))
    power = scalogram(x[:, axis], rate, low, high, per_octave=OCTAVE, most=500)
    begin = int(t[0]) + utc_minus_ns
    bands = []
    strongest = sorted(shown, key=lambda f: -_strength(spectrum[:, axis], lines, f))[:BANDS]
    for f in sorted(strongest):
        f0, f1 = edges(f, shown)
        y = band(x[:, axis], rate, f0, f1, per_octave=2 * OCTAVE)
        times = begin + np.rint(np.arange(len(y)) / rate * S).astype(np.int64)
        edge = round(float(np.interp(f0, power.freq_hz, power.edge_s)) * rate)
        sure = y[edge : len(y) - edge]
        t_z, z, rms_z = _fixes(fixes, axis, f0, f1, utc_minus_ns)
        rms = float(sure.std()) if len(sure) > 16 else math.nan
        largest = float(np.abs(sure).max()) if len(sure) > 16 else math.nan
        bands.append(Banded(f, f0, f1, times, y, t_z, z, rms, rms_z, largest))
    return Wavelets(axis, begin, seconds, power, bands)


def edges(f: float, freq_hz: Sequence[float]) -> tuple[float, float]:
    """Ends of the band of a frequency among others."""
    below = max((math.sqrt(f * g) for g in freq_hz if g < f), default=0.0)
    above = min((math.sqrt(f * g) for g in freq_hz if g > f), default=math.inf)
    return max(f / WIDE, below), min(f * WIDE, above)


def _strength(power: F64, lines: F64, f: float) -> float:
    return float(power[np.abs(lines - f) <= 0.1 * f].sum())


def _fixes(fixes: tuple[I64, F64], axis: int, low: float, high: float, utc_minus_ns: int) -> tuple[I64, F64, float]:
    """The same band of the raw fixes; empty where they come too rarely for it."""
    t, z = fixes
    none = np.zeros(0, np.int64), np.zeros(0), math.nan
    if len(t) < LEAST:
        return none
    u = uniform(t, z[:, axis])
    if high > 0.45 * u.rate_hz:
        return none
    x = u.x[:, 0]
    y = band(x - np.median(x), u.rate_hz, low, high, per_octave=2 * OCTAVE)
    edge = round(2.0 * u.rate_hz / low)
    sure = y[edge : len(y) - edge]
    times = int(t[0]) + utc_minus_ns + np.rint(np.arange(len(y)) / u.rate_hz * S).astype(np.int64)
    return times, y, float(sure.std()) if len(sure) > 16 else math.nan
