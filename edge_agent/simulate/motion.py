"""True motion, exact at every instant.

A quintic spline runs through nodes whose displacement, velocity and acceleration come from closed forms: a thermal
sine, smooth ramps, the modes' stationary response to coloured force (by its Fourier series), impacts (sums of complex
exponentials). The spline is the truth, and it is C2: d'' = a holds to rounding between the nodes too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64, S
from edge_agent.simulate.specs import START_NS, ZERO, Ramp, Scenario, Structure, Vec3


@dataclass(frozen=True, slots=True)
class Truth:
    """t_ns (n,) int64; displacement, velocity, acceleration (n, 3) in E N U, m, m/s, m/s2, without gravity."""

    t_ns: I64
    d_m: F64
    v_mps: F64
    a_mps2: F64


def stream(seed: int, part: str) -> np.random.Generator:
    """The seed's stream of one part: parts do not depend on each other."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *part.encode()])))


def pick(truth: Truth, keep: npt.NDArray[np.bool_]) -> Truth:
    """The rows of `truth` where `keep`."""
    return Truth(truth.t_ns[keep], truth.d_m[keep], truth.v_mps[keep], truth.a_mps2[keep])


class Motion:
    """The true motion as a C2 quintic spline: nodes at `START_NS - lead + k/rate` with d, v, a (n, 3)."""

    def __init__(self, start_ns: int, rate_hz: int, d: F64, v: F64, a: F64) -> None:
        self.start_ns, self.step_ns = start_ns, S // rate_hz
        self._nodes = d, v, a

    def at(self, t_ns: I64) -> Truth:
        """The truth at any instants inside of the record. Raises ValueError outside."""
        k = (t_ns - self.start_ns) // self.step_ns
        d, v, a = self._nodes
        if k.size and (k.min() < 0 or k.max() > len(d) - 2):
            raise ValueError("motion: an instant lies outside of the simulated record")
        rate = S / self.step_ns
        h = 1.0 / rate
        s = ((t_ns - self.start_ns - k * self.step_ns) / self.step_ns)[:, None]
        c0, diff = d[k], d[k + 1] - d[k]
        c1, c2, e1, e2 = h * v[k], 0.5 * h * h * a[k], h * v[k + 1], 0.5 * h * h * a[k + 1]
        c3 = 10 * diff - 6 * c1 - 4 * e1 - 3 * c2 + e2
        c4 = -15 * diff + 8 * c1 + 7 * e1 + 3 * c2 - 2 * e2
        c5 = 6 * diff - 3 * c1 - 3 * e1 - c2 + e2
        d = c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
        v = (c1 + s * (2 * c2 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) * rate
        a = (2 * c2 + s * (6 * c3 + s * (12 * c4 + s * 20 * c5))) * rate * rate
        return Truth(t_ns, d, v, a)


# ------------------------------------------------------------------------------------------------------------- motion

LEAD_S = 2.0  # nodes before second 0 and after the end


def _ramp(t: F64, ramp: Ramp) -> tuple[F64, F64, F64]:
    """Unit move: speed rises and falls by the quintic smoothstep's integral, so acceleration is continuous."""
    smooth = ramp.rise_s / 2 if ramp.smooth_s is None else min(ramp.smooth_s, ramp.rise_s / 2)
    top = 1.0 / (ramp.rise_s - smooth)  # constant speed between the ends

    def rise(u: F64) -> tuple[F64, F64, F64]:
        """Integral of speed, speed, its derivative, for speed = smoothstep(u/smooth) and then 1."""
        s = np.clip(u / smooth, 0.0, 1.0)
        after = np.maximum(u - smooth, 0.0)
        return (
            smooth * s**4 * (2.5 - 3 * s + s * s) + after,
            s**3 * (10 - 15 * s + 6 * s * s),
            30 * s**2 * (1 - s) ** 2 / smooth,
        )

    up, down = rise(t - ramp.start_s), rise(t - ramp.start_s - ramp.rise_s + smooth)
    d, v, a = (top * (x - y) for x, y in zip(up, down, strict=True))
    return d, v, a


def _ring(t: F64, start_s: float, freq_hz: float, damping: float) -> tuple[F64, F64, F64]:
    """Unit impact: exp decay of a sine behind the rise (1 - exp(-s/rise))^3, a sum of complex exponentials."""
    s = np.maximum(t - start_s, 0.0)
    w = 2 * math.pi * freq_hz
    rise = 4.0 * w  # 1/s
    out = np.zeros((3, len(t)))
    for k, c in enumerate((1.0, -3.0, 3.0, -1.0)):
        p = complex(-damping * w - k * rise, w * math.sqrt(1 - damping * damping))
        e = c * np.exp(p * s)
        for i in range(3):
            out[i] += np.where(t >= start_s, (e * p**i).imag, 0.0)
    return out[0], out[1], out[2]


def _modes(rng: np.random.Generator, structure: Structure, n: int, rate: int, f_max: float) -> F64:
    """Stationary response of the modes to coloured force, (3 derivatives, n, 3 axes), exact by its Fourier series."""
    size = 1 << (n - 1).bit_length()
    f = np.fft.rfftfreq(size, 1.0 / rate)
    w = 2j * math.pi * f
    spectrum = np.zeros((len(f), 3), dtype=np.complex128)
    for mode in structure.modes:
        w0 = 2 * math.pi * mode.freq_hz
        gain = 1 / (w0 * w0 + w * w + 2 * mode.damping * w0 * w) / np.sqrt(1 + (f / structure.force_corner_hz) ** 2)
        gain[0] = 0.0
        gain[f > f_max] = 0.0
        gain *= size / math.sqrt(4 * float(np.sum(np.abs(gain) ** 2)))
        draw = rng.standard_normal((2, len(f), 3))
        spectrum += gain[:, None] * (draw[0] + 1j * draw[1]) * np.array(mode.rms_m)
    return np.stack([np.fft.irfft(spectrum * (w**i)[:, None], size, axis=0)[:n] for i in range(3)])


def bridge_motion(scenario: Scenario, seed: int, duration_s: float) -> Motion:
    st, rng = scenario.structure, stream(seed, "motion")
    top = max((m.freq_hz for m in st.modes), default=0.1)
    rate = 400 if top > 3.0 else 200
    n = int(math.ceil((duration_s + 2 * LEAD_S) * rate)) + 1
    t = np.arange(n) / rate - LEAD_S
    out = np.zeros((3, n, 3))

    def add(parts: tuple[F64, F64, F64], size: Vec3, where: slice = slice(None)) -> None:
        for i, part in enumerate(parts):
            out[i, where] += part[:, None] * np.array(size)

    def span(begin_s: float, end_s: float) -> slice:
        return slice(max(0, int((begin_s + LEAD_S) * rate)), min(n, int((end_s + LEAD_S) * rate) + 2))

    w = 2 * math.pi / st.thermal_s
    phase = rng.uniform(0, 2 * math.pi)
    if any(st.thermal_m):
        arg = w * t + phase
        add((np.sin(arg), w * np.cos(arg), -w * w * np.sin(arg)), st.thermal_m)
    for ramp in st.ramps:
        add(_ramp(t, ramp), ramp.size_m)
    for start in _times(rng, st.traffic_per_h, duration_s):
        size = tuple(float(rng.uniform(0.3, 1.0)) * x for x in st.traffic_m)
        half, where = st.traffic_s / 2, span(start, start + st.traffic_s)
        add(_ramp(t[where], Ramp(start, half, ZERO)), (size[0], size[1], size[2]), where)
        add(_ramp(t[where], Ramp(start + half, half, ZERO)), (-size[0], -size[1], -size[2]), where)
    for start in _times(rng, st.taps_per_h, duration_s):
        mode = st.modes[int(rng.integers(len(st.modes)))]
        where = span(start, duration_s + LEAD_S)
        add(_ring(t[where], start, mode.freq_hz, mode.damping), st.tap_m, where)
    if st.modes:
        lowest = min((a.rate_hz for a in scenario.accels), default=100.0)
        out += _modes(rng, st, n, rate, min(3 * top, 0.4 * lowest))
    out[0] -= out[0][int(LEAD_S * rate)]  # displacement counts from second 0
    return Motion(START_NS - int(LEAD_S * S), rate, out[0], out[1], out[2])


def _times(rng: np.random.Generator, per_h: float, duration_s: float) -> list[float]:
    count = int(rng.poisson(per_h * duration_s / 3600.0)) if per_h > 0 else 0
    return sorted(float(x) for x in rng.uniform(0.0, duration_s, count))
