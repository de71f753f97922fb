"""What can be simulated: structures, receivers, accelerometers and their faults, as frozen values.

Axes are E, N, U; a number's unit is in its name. Every fault is off by default.
"""

from __future__ import annotations

from dataclasses import dataclass

from edge_agent.messages import S

GRAVITY_MPS2 = 9.80665
START_NS = 1_000 * S
"""Monotonic time of second 0 of every record: a host that has been up for a while."""
EPOCH_UTC_NS = 1_780_300_800 * S
"""UTC of second 0 by default: 2026-06-01T08:00:00Z."""
Vec3 = tuple[float, float, float]
ZERO: Vec3 = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Modal:
    """One damped mode under coloured Gaussian force; `rms_m` of its displacement on each axis."""

    freq_hz: float
    rms_m: Vec3
    damping: float = 0.01


@dataclass(frozen=True, slots=True)
class Ramp:
    """A move by `size_m` in `rise_s` that stays: a slider, a settlement, a step that the accelerometer sees.

    `smooth_s` of the rise at either end is acceleration, the rest constant speed; None = half of it (no constant part).
    """

    start_s: float
    rise_s: float
    size_m: Vec3
    smooth_s: float | None = None


@dataclass(frozen=True, slots=True)
class Structure:
    thermal_m: Vec3 = ZERO  # amplitude of the slow sine
    thermal_s: float = 900.0
    modes: tuple[Modal, ...] = ()
    force_corner_hz: float = 2.0  # the force's power falls with 1/f^2 above
    ramps: tuple[Ramp, ...] = ()
    traffic_per_h: float = 0.0  # vehicles: a push to `traffic_m` and back
    traffic_m: Vec3 = ZERO
    traffic_s: float = 8.0  # length of a crossing
    taps_per_h: float = 0.0  # impacts that set the first mode ringing
    tap_m: Vec3 = ZERO  # its first amplitude


@dataclass(frozen=True, slots=True)
class Fault:
    """A GNSS fault at a given time, beside the random ones: `kind` is outage, outliers, wrong, float or datum.

    `size_m` is the offset of wrong and datum; for outliers its first number is the share of hit epochs.
    """

    kind: str
    start_s: float
    length_s: float = 0.0
    size_m: Vec3 = ZERO


@dataclass(frozen=True, slots=True)
class Gnss:
    rate_hz: float = 10.0
    sigma_m: Vec3 = (0.003, 0.003, 0.006)
    declared: float = 1.0  # declared sigma / true sigma
    multipath_m: Vec3 = ZERO  # Gauss-Markov
    multipath_s: float = 300.0
    outlier_share: float = 0.0
    outlier_m: tuple[float, float] = (0.03, 1.0)  # norm, uniform; direction isotropic
    drop_share: float = 0.0
    wrong_per_h: float = 0.0
    wrong_m: tuple[float, float] = (0.02, 0.30)
    wrong_s: tuple[float, float] = (5.0, 60.0)
    float_every_s: float = 0.0
    float_s: float = 15.0
    float_sigma_m: float = 0.15  # Gauss-Markov, on top of the white noise
    float_tau_s: float = 30.0
    latency_s: float = 0.0
    jitter_s: float = 0.0  # arrivals spread evenly over +- this, in order
    minute_decimals: int | None = None  # of GGA latitude and longitude; None = not quantised
    height_decimals: int | None = None
    faults: tuple[Fault, ...] = ()
    calm_s: float = 30.0  # no random wrong fix or float before: the start window has no truth to compare with


@dataclass(frozen=True, slots=True)
class Accel:
    name: str = "acc"
    rate_hz: float = 100.0
    noise: float = 2.2e-4  # one-sided density, m/s2/sqrt(Hz); q = noise^2/2
    bias_mps2: tuple[float, float] = (0.0, 0.0)  # size on each axis, uniform between, random sign
    bias_walk: float = 0.0  # PSD of the bias's derivative, m2/s5
    temperature_mps2: float = 0.0  # amplitude of a bias that follows the temperature
    temperature_s: float = 3600.0
    scale: float = 0.0  # relative error, the same on all axes
    misalignment_deg: Vec3 = ZERO  # small rotation about E, N, U of the whole sensor
    tilt_per_m: Vec3 = ZERO  # rotation in rad per m of displacement: -g kappa d leaks into E and N
    gravity: bool = True
    lsb_mps2: float = 0.0
    range_mps2: float = 0.0  # 0 = none
    clock_offset_s: float = 0.0  # stamps late by this
    clock_ppm: float = 0.0  # the device's clock is fast by this
    clock_walk_s: float = 0.0  # sd of the stamp's random walk after one hour
    latency_s: float = 0.002
    jitter_s: float = 0.0
    drop_share: float = 0.0
    duplicate_share: float = 0.0
    late_share: float = 0.0  # frames that come 30 ms later, with those behind them
    gaps: tuple[tuple[float, float], ...] = ()  # (start, length) in s


@dataclass(frozen=True, slots=True)
class Scenario:
    name: str
    structure: Structure
    gnss: Gnss | None
    accels: tuple[Accel, ...]
    duration_s: float = 900.0
    reference_llh: Vec3 = (46.5, 7.5, 610.0)
