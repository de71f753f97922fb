"""Spectra and modes of one stream or several: Welch's density with confidence, peaks, modes with damping and their
sd, their track over windows, wavelet scalogram and band.

Densities are one-sided, in unit^2/Hz. A mode is fitted to the periodogram itself by Whittle's likelihood (Whittle
1953; for modes: Yuen & Katafygiotis 2003, Au 2011): power of one damped resonance under a flat force plus a floor. It
needs no averaging, gives the sd from the curvature, and works on accelerations and displacements alike. Left out: modes
of several channels at once (modal).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64

NS = 1e-9
HANN_OVERLAP = 1 / 36
"""Squared correlation of two half-overlapping Hann segments' densities (Welch 1967)."""
MODE_GAIN = 10.0
"""Log likelihood that a resonance must add to a floor: three parameters and a search take 5 by chance."""
BOTTOM_DB = 6.0
"""A peak stands so far above the floor,"""
RISE_DB, RISE_SD = 3.0, 3.3
"""and rises so far, and so many sd of chance, from the valley between it and what is higher: on the skirt of another
peak nothing does."""


@dataclass(frozen=True, slots=True)
class Uniform:
    """A stream on an even grid: x (n, c), valid (n,) where the grid lies in no gap of the source."""

    begin_ns: int
    rate_hz: float
    x: F64
    valid: npt.NDArray[np.bool_]


def uniform(t_ns: I64, x: F64, rate_hz: float | None = None, gap: float = 3.5) -> Uniform:
    """Samples (n,) or (n, c) at t_ns, rising, onto an even grid at their own median rate (or `rate_hz`), linearly;
    gaps of more than `gap` intervals are marked invalid. ValueError for less than two samples."""
    if len(t_ns) < 2:
        raise ValueError("uniform: two samples at least")
    t = np.asarray((t_ns - t_ns[0]) * NS, dtype=np.float64)
    columns = x.reshape(len(x), -1)
    step = float(np.median(np.diff(t)))
    rate = 1.0 / step if rate_hz is None else rate_hz
    grid = np.arange(math.floor(t[-1] * rate + 1e-6) + 1) / rate
    out = np.stack([np.interp(grid, t, c) for c in columns.T], axis=1)
    i = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 2)
    good = (np.diff(t)[i] <= gap * step) | (np.abs(grid - t[i]) < 1e-6)
    return Uniform(int(t_ns[0]), rate, out, good & np.isfinite(out).all(axis=1))


# ------------------------------------------------------------------------------------------------------------ densities


@dataclass(frozen=True, slots=True)
class Spectrum:
    """freq_hz (k,), psd (k, c) with its confidence limits low, high (k, c); segments that went into it."""

    freq_hz: F64
    psd: F64
    low: F64
    high: F64
    segments: int
    level: float


def welch(
    x: F64, rate_hz: float, segment: int, *, valid: npt.NDArray[np.bool_] | None = None, level: float = 0.95
) -> Spectrum:
    """Welch (1967): Hann segments of `segment` samples, half overlapping, each less its straight line.

    x (n,) or (n, c). Segments that touch an invalid sample are left out. The limits hold for Gaussian noise: chi-square
    with the degrees of freedom that the overlap leaves. ValueError where no segment fits.
    """
    columns = x.reshape(len(x), -1)
    good = np.ones(len(x), np.bool_) if valid is None else valid
    bad = np.concatenate([[0], np.cumsum(~good)])
    starts = np.arange(0, len(x) - segment + 1, max(1, segment // 2))
    starts = starts[bad[starts + segment] == bad[starts]]
    if segment < 8 or not len(starts):
        raise ValueError(f"welch: no whole segment of {segment} valid samples in {len(x)}")
    window = np.sin(np.pi * np.arange(segment) / segment) ** 2
    scale = 2.0 / (rate_hz * float((window * window).sum()))
    ramp = np.arange(segment) - 0.5 * (segment - 1)
    ramp /= math.sqrt(float((ramp * ramp).sum()))
    total = np.zeros((segment // 2 + 1, columns.shape[1]))
    for s in starts.tolist():
        part = columns[s : s + segment]
        part = part - part.mean(axis=0)
        part = part - ramp[:, None] * (ramp @ part)
        total += np.abs(np.fft.rfft(part * window[:, None], axis=0)) ** 2
    psd = total * (scale / len(starts))
    psd[0] *= 0.5
    if segment % 2 == 0:
        psd[-1] *= 0.5
    n = len(starts)
    dof = freedom(n)
    z = _normal_quantile(0.5 + 0.5 * level)
    freq: F64 = np.arange(segment // 2 + 1, dtype=np.float64) * (rate_hz / segment)
    return Spectrum(freq, psd, psd * (dof / _chi2(dof, z)), psd * (dof / _chi2(dof, -z)), n, level)


def freedom(segments: int) -> float:
    """Degrees of freedom of the mean of half-overlapping Hann segments' densities (Welch 1967)."""
    return 2.0 * segments / (1.0 + 2.0 * HANN_OVERLAP * (segments - 1) / segments)


def _chi2(dof: float, z: float) -> float:
    """Chi-square quantile at the normal quantile z (Wilson & Hilferty 1931; 1 % from 2 degrees of freedom at 95 %)."""
    c = 2.0 / (9.0 * dof)
    return float(dof * max(1.0 - c + z * math.sqrt(c), 0.05) ** 3)


def _normal_quantile(p: float) -> float:
    """Standard normal quantile by bisection of erf."""
    lo, hi = -10.0, 10.0
    for _ in range(80):
        mid = 0.5 * (lo + hi)
        lo, hi = (mid, hi) if 0.5 * (1 + math.erf(mid / math.sqrt(2))) < p else (lo, mid)
    return 0.5 * (lo + hi)


class Peak(NamedTuple):
    """A peak of a density: frequency by a parabola through its top, height above the floor."""

    freq_hz: float
    above_db: float


FLOOR_ROWS = 512
"""Lines of a floor that are found at a time."""


def floor_of(freq_hz: F64, psd: F64, width_hz: float) -> F64:
    """Median density (k,) within +-width_hz around each frequency: what a narrow peak stands on."""
    step = float(freq_hz[1] - freq_hz[0])
    half = max(2, round(width_hz / step))
    padded = np.pad(psd, half, mode="reflect") if half < len(psd) else np.pad(psd, half, mode="edge")
    views = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    floor = np.empty(len(psd))
    for lo in range(0, len(psd), FLOOR_ROWS):  # a median copies all that it looks at
        floor[lo : lo + FLOOR_ROWS] = np.median(views[lo : lo + FLOOR_ROWS], axis=1)
    return floor


def rise_db(psd: F64, at: int) -> float:
    """How far [dB] a line stands above the valley that parts it from anything higher (its topographic prominence), inf
    for the highest. Valleys are means of three lines: a single low one is chance."""
    smooth = np.convolve(np.pad(psd, 1, mode="edge"), np.ones(3) / 3, mode="valid")
    saddle = 0.0
    for side in (np.arange(at - 1, -1, -1), np.arange(at + 1, len(psd))):
        higher = np.flatnonzero(psd[side] > psd[at])
        if len(higher):
            between = side[: int(higher[0]) + 1]
            saddle = max(saddle, float(np.minimum(smooth[between], psd[at]).min()))
    return 10.0 * math.log10(float(psd[at]) / saddle) if saddle > 0 else math.inf


def peaks(
    spectrum: Spectrum,
    channel: int = 0,
    *,
    low_hz: float = 0.0,
    high_hz: float = math.inf,
    above_db: float = BOTTOM_DB,
    width_hz: float = 1.0,
    alone: bool = True,
) -> list[Peak]:
    """Peaks of a channel in [low_hz, high_hz] that stand `above_db` above the floor within +-width_hz, by frequency;
    `alone`: and rise from the valleys beside them by RISE_DB and RISE_SD of chance. Not asked where the peak of another
    stream is looked for again.

    Of peaks nearer than a quarter of the width, the highest."""
    f, p = spectrum.freq_hz, np.maximum(spectrum.psd[:, channel], 1e-300)
    db = 10.0 * np.log10(p)
    above = db - 10.0 * np.log10(np.maximum(floor_of(f, p, width_hz), 1e-300))
    top = np.flatnonzero((db[1:-1] > db[:-2]) & (db[1:-1] >= db[2:])) + 1
    top = top[(above[top] >= above_db) & (f[top] >= low_hz) & (f[top] <= high_hz)]
    found: list[Peak] = []
    step = float(f[1] - f[0])
    dof = freedom(spectrum.segments)
    chance = 10.0 / math.log(10.0) * math.sqrt(2.0 / dof + 2.0 / (1.5 * dof))  # sd of a line over three, in dB
    least = max(RISE_DB, RISE_SD * chance)
    for i in top[np.argsort(-db[top])].tolist():
        if alone and rise_db(p, i) < least:
            continue
        a, b, c = db[i - 1 : i + 2].tolist()
        at = float(f[i]) + 0.5 * (a - c) / (a - 2 * b + c) * step
        if all(abs(at - peak.freq_hz) > 0.25 * width_hz for peak in found):
            found.append(Peak(at, float(above[i])))
    return sorted(found)


# ---------------------------------------------------------------------------------------------------------------- modes


class Mode(NamedTuple):
    """A mode with sd: frequency [Hz], damping ratio; `share`: how far its peak stands above the floor [dB]. NaN
    everywhere: no mode there."""

    freq_hz: float
    std_freq_hz: float
    damping: float
    std_damping: float
    above_db: float


NO_MODE = Mode(math.nan, math.nan, math.nan, math.nan, math.nan)


def fit_mode(x: F64, rate_hz: float, guess_hz: float, width_hz: float, *, accelerations: bool = False) -> Mode:
    """The mode near guess_hz in a stream x (n,), from its periodogram within +-width_hz.

    Displacements: S(f) = h / ((f0^2 - f^2)^2 + (2 z f0 f)^2) + floor (f0/f)^p; accelerations: the resonance times f^4.
    The likelihood is maximised by damped Newton steps from several starts; sd from its curvature. NO_MODE where no
    resonance is MODE_GAIN more likely than the floor alone, or it leaves the band.
    """
    n = len(x)
    window = np.sin(np.pi * (np.arange(n) + 0.5) / n)  # half as wide as Hann's, and slow motion does not leak far
    ramp = np.linspace(-1.0, 1.0, n)
    y = x - x.mean()
    y = y - ramp * float((ramp @ y) / (ramp @ ramp))
    power = np.abs(np.fft.rfft(y * window)) ** 2
    f: F64 = np.arange(len(power), dtype=np.float64) * (rate_hz / n)
    band = (f >= max(guess_hz - width_hz, 2 * rate_hz / n)) & (f <= min(guess_hz + width_hz, 0.48 * rate_hz))
    return _fitted(f[band], power[band], guess_hz, width_hz, 1.0, accelerations)


def fit_density(
    freq_hz: F64, psd: F64, segments: float, guess_hz: float, width_hz: float, *, accelerations: bool = False
) -> Mode:
    """The mode near guess_hz from a Welch density (k,) of `segments` Hann segments: the likelihood of so many averaged
    periodograms, whose neighbouring lines share 1.5 lines' worth, of a resonance as the window blurs it."""
    dof = segments / (1.0 + 2.0 * HANN_OVERLAP)
    band = (np.abs(freq_hz - guess_hz) <= width_hz) & (freq_hz > 2.0 * freq_hz[1])
    return _fitted(freq_hz[band], psd[band], guess_hz, width_hz, dof / 1.5, accelerations, float(freq_hz[1]))


BLUR = np.arange(-1.75, 1.76, 0.25)
"""Lines apart at which a Hann window's main lobe is taken,"""
LOBE = (np.sinc(BLUR) / np.where(np.abs(BLUR) == 1.0, np.inf, 1.0 - BLUR**2) + 0.5 * (np.abs(BLUR) == 1.0)) ** 2
"""and its power there."""


def _fitted(
    f: F64, power: F64, guess_hz: float, width_hz: float, weight: float, accelerations: bool, line_hz: float = 0.0
) -> Mode:
    """The resonance that makes densities (k,) at f most likely; `weight`: how many independent ones each line is;
    `line_hz`: of a Hann window that blurs it, 0 = none."""
    if len(f) < 12 or not power.any():
        return NO_MODE
    power = power / power.mean()
    lift = f**4 / guess_hz**4 if accelerations else np.ones_like(f)
    share = (LOBE / LOBE.sum())[:, None] if line_hz else np.ones((1, 1))
    near_f = f + line_hz * BLUR[:, None] if line_hz else f[None, :]
    lean = np.log(f / guess_hz)

    def model(theta: F64) -> tuple[F64, F64]:
        """S (k,) and its derivatives (5, k) in ln f0, ln zeta, ln height, ln floor, slope."""
        f0, z = math.exp(theta[0]), math.exp(theta[1])
        a, b = f0 * f0 - near_f * near_f, 2 * z * f0 * near_f
        D = a * a + b * b
        each = share * math.exp(theta[2]) * (2 * z * f0 * f0) ** 2 * lift / D
        peak = each.sum(axis=0)
        floor = math.exp(theta[3]) * np.exp(-theta[4] * lean)
        return peak + floor, np.stack(
            [
                (each * (4.0 - (4 * f0 * f0 * a + 2 * b * b) / D)).sum(axis=0),
                (each * (2.0 - 2 * b * b / D)).sum(axis=0),
                peak,
                floor,
                -lean * floor,
            ]
        )

    def cost(theta: F64) -> float:
        S = model(theta)[0]
        return weight * float(np.log(S).sum() + (power / S).sum()) + 0.02 * float(theta[4]) ** 2

    narrow = math.log(0.1 * line_hz / guess_hz) if line_hz else -12.0  # a tone is as wide as the window shows it
    smooth = np.convolve(power, np.ones(3) / 3, mode="same")
    near = np.abs(f - guess_hz) <= 0.5 * width_hz
    top = float(f[near][int(np.argmax(smooth[near]))]) if near.any() else guess_hz
    quiet = float(np.median(power))
    tried = []
    for start in (top,) if line_hz else (top, guess_hz):
        for z in (0.01,) if line_hz else (0.003, 0.02):
            theta = np.array([math.log(start), math.log(z), math.log(smooth.max()), math.log(quiet), 0.0])
            tried.append(_descend(theta, model, cost, power, weight, narrow))
    value, theta = min(((cost(theta), theta) for theta in tried), key=lambda pair: pair[0])
    S, dS = model(theta)
    bare = weight * min(_floor_only(lean, power, p) for p in np.linspace(-4.0, 4.0, 17).tolist())
    f0, z = math.exp(theta[0]), math.exp(theta[1])
    G = dS / S
    try:
        cov = np.linalg.inv(weight * (G @ G.T) + np.diag([0, 0, 0, 0, 0.04]))
    except np.linalg.LinAlgError:
        return NO_MODE
    if bare - value < MODE_GAIN or not f[0] < f0 < f[-1] or not 1e-5 < z < 0.5 or not (np.diag(cov) > 0).all():
        return NO_MODE
    sd = np.sqrt(np.diag(cov))
    peak = math.exp(theta[2]) * float(np.interp(f0, f, lift))
    above = 10 * math.log10(peak / (math.exp(theta[3]) * (f0 / guess_hz) ** -theta[4]))
    return Mode(f0, f0 * float(sd[0]), z, z * float(sd[1]), above)


def _floor_only(lean: F64, power: F64, slope: float) -> float:
    shape = np.exp(-slope * lean)
    level = float((power / shape).mean())
    return float(np.log(level * shape).sum()) + len(power)


def _descend(
    theta: F64,
    model: Callable[[F64], tuple[F64, F64]],
    cost: Callable[[F64], float],
    power: F64,
    weight: float,
    narrow: float,
) -> F64:
    """Fisher scoring with a damping that grows until a step pays."""
    value, damp = cost(theta), 1e-3
    for _ in range(60):
        S, dS = model(theta)
        G = dS / S
        fisher = weight * (G @ G.T)
        slope = weight * (G @ (power / S - 1.0))
        slope[4] -= 0.02 * theta[4]
        while damp < 1e8:
            step = np.linalg.solve(fisher + damp * np.diag(np.diag(fisher) + 1e-9), slope)
            step = np.clip(step, [-0.05, -1.0, -2.0, -2.0, -1.0], [0.05, 1.0, 2.0, 2.0, 1.0])
            new = np.clip(theta + step, [-20.0, narrow, -30.0, -30.0, -12.0], [20.0, 0.0, 30.0, 30.0, 12.0])
            moved = cost(new)
            if moved <= value:
                break
            damp *= 6.0
        else:
            break
        done = value - moved < 1e-9 * (1.0 + abs(value))
        theta, value, damp = new, moved, max(damp / 10.0, 1e-9)
        if done:
            break
    return theta


class Track(NamedTuple):
    """Modes over time: middles t_ns (w,) and the mode of each window and guess, [window][guess]."""

    t_ns: I64
    modes: list[list[Mode]]


def track(
    stream: Uniform, guesses_hz: Sequence[float], window_s: float, width_hz: float, *, accelerations: bool = False
) -> Track:
    """Fit each mode in half-overlapping windows of `window_s` of a stream's first channel; windows with invalid
    samples are left out."""
    n = round(window_s * stream.rate_hz)
    times, modes = [], []
    for s in range(0, len(stream.x) - n + 1, max(1, n // 2)):
        k = slice(s, s + n)
        if stream.valid[k].all():
            times.append(stream.begin_ns + round((s + 0.5 * n) / stream.rate_hz / NS))
            x = stream.x[k, 0]
            modes.append([fit_mode(x, stream.rate_hz, g, width_hz, accelerations=accelerations) for g in guesses_hz])
    return Track(np.array(times, dtype=np.int64), modes)


# ------------------------------------------------------------------------------------------------------------- wavelets

OMEGA0 = 6.0
"""Morlet's wave number: admissible, and six oscillations under the envelope."""
DELTA_C = 0.776
"""Its reconstruction factor (Torrence & Compo 1998, table 2), which with PI^-1/4 turns scales back into the signal."""


class Scalogram(NamedTuple):
    """freq_hz (k,) log-spaced, t_s (m,) from the begin, power (k, m) in unit^2, the cone of influence: edge_s (k,)
    seconds at both ends in which the record's ends are felt."""

    freq_hz: F64
    t_s: F64
    power: F64
    edge_s: F64


def _morlet(n: int, rate_hz: float, freq_hz: float, spectrum: npt.NDArray[np.complex128]) -> npt.NDArray[np.complex128]:
    """Wavelet transform (n,) at one frequency, normalised to unit energy at each scale (Torrence & Compo, eq. 4-6)."""
    scale = (OMEGA0 + math.sqrt(2.0 + OMEGA0**2)) / (4 * math.pi * freq_hz)
    omega = 2 * math.pi * np.fft.fftfreq(len(spectrum), 1 / rate_hz)
    daughter = np.zeros(len(spectrum))
    up = omega > 0
    daughter[up] = math.pi**-0.25 * np.exp(-0.5 * (scale * omega[up] - OMEGA0) ** 2)
    daughter *= math.sqrt(2 * math.pi * scale * rate_hz)
    return np.asarray(np.fft.ifft(spectrum * daughter)[:n])


def _padded(x: F64) -> npt.NDArray[np.complex128]:
    n = len(x)
    size = 1 << (2 * n - 1).bit_length()  # the other end must not be felt
    return np.asarray(np.fft.fft(x - x.mean(), size))


def scalogram(
    x: F64, rate_hz: float, low_hz: float, high_hz: float, *, per_octave: int = 12, most: int = 800
) -> Scalogram:
    """Morlet power of x (n,) between two frequencies, the largest of each of at most `most` spans of time."""
    freq = _ladder(low_hz, high_hz, per_octave)
    spectrum, n = _padded(x), len(x)
    span = -(-n // most)
    starts = np.arange(0, n, span)
    power = np.empty((len(freq), len(starts)))
    for k, f in enumerate(freq.tolist()):
        power[k] = np.maximum.reduceat(np.abs(_morlet(n, rate_hz, f, spectrum)) ** 2, starts)
    scale = (OMEGA0 + math.sqrt(2.0 + OMEGA0**2)) / (4 * math.pi * freq)
    return Scalogram(freq, starts / rate_hz, power, math.sqrt(2.0) * scale)


def band(x: F64, rate_hz: float, low_hz: float, high_hz: float, *, per_octave: int = 12) -> F64:
    """What x (n,) does between two frequencies, by the wavelets of that band put together again (eq. 11 there)."""
    freq = _ladder(low_hz, high_hz, per_octave)
    spectrum, n = _padded(x), len(x)
    out = np.zeros(n)
    for f in freq.tolist():
        scale = (OMEGA0 + math.sqrt(2.0 + OMEGA0**2)) / (4 * math.pi * f)
        out += _morlet(n, rate_hz, f, spectrum).real / math.sqrt(scale)
    return np.asarray(out * (math.sqrt(1 / rate_hz) / (per_octave * DELTA_C * math.pi**-0.25)))


def _ladder(low_hz: float, high_hz: float, per_octave: int) -> F64:
    if not 0 < low_hz < high_hz:
        raise ValueError("wavelets: 0 < low_hz < high_hz")
    count = max(2, round(math.log2(high_hz / low_hz) * per_octave) + 1)
    return np.asarray(low_hz * 2.0 ** (np.arange(count) / per_octave))
