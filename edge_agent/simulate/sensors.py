"""What a receiver and an accelerometer make of the true motion, with every fault labelled.

Each part draws from its own stream of the seed, so a fault that is switched on leaves the noise of all others alone.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np

from edge_agent.messages import F64, I64, U8, S
from edge_agent.simulate.motion import LEAD_S, Motion, Truth, pick, stream
from edge_agent.simulate.specs import GRAVITY_MPS2, START_NS, Accel, Fault, Gnss, Scenario, Vec3


class FixLabel(enum.IntEnum):
    GOOD = 0
    OUTLIER = 1
    WRONG = 2
    FLOAT = 3
    DATUM = 4  # after a step of the antenna that no accelerometer felt


@dataclass(frozen=True, slots=True)
class FixTrack:
    """The receiver's fixes that arrive, in time order: `offset_m` is the error beyond noise and multipath."""

    t_ns: I64
    arrival_ns: I64
    z_m: F64
    std_m: F64  # declared
    quality: U8
    label: U8  # FixLabel
    offset_m: F64


@dataclass(frozen=True, slots=True)
class AccelTrack:
    """One accelerometer's samples that arrive: `true_ns` when sampled, `t_ns` as its clock says, `count` its number."""

    name: str
    t_ns: I64
    true_ns: I64
    arrival_ns: I64
    count: I64
    xyz: F64
    duplicate: U8  # 1 = the frame comes twice
    bias_mps2: F64  # (n, 3) all that a filter would call bias, gravity included


def in_order(arrival: I64) -> I64:
    """One wire delivers in order: nothing overtakes, and no two share a stamp."""
    step = np.arange(len(arrival), dtype=np.int64) * 1000  # 1 us
    return np.asarray(np.maximum.accumulate(arrival - step) + step) if len(arrival) else arrival


def _gauss_markov(rng: np.random.Generator, n: int, step_s: float, sigma: F64, tau_s: float) -> F64:
    """(n, 3) stationary first-order Gauss-Markov, exact discretisation."""
    phi = math.exp(-step_s / tau_s)
    drive = rng.standard_normal((n, 3)) * sigma * math.sqrt(1 - phi * phi)
    x = rng.standard_normal(3) * sigma
    out = np.empty((n, 3))
    for i in range(n):
        out[i] = x
        x = phi * x + drive[i]
    return out


def _direction(rng: np.random.Generator, n: int) -> F64:
    x = rng.standard_normal((n, 3))
    return np.asarray(x / np.sqrt(np.sum(x * x, axis=1, keepdims=True)))


def _spells(rng: np.random.Generator, gnss: Gnss, duration_s: float) -> list[Fault]:
    """Random wrong fixes without overlap: their number is the rate times the duration, rounded by chance."""
    free = duration_s - gnss.calm_s
    count = int(math.floor(gnss.wrong_per_h * free / 3600.0 + rng.uniform())) if free > 0 else 0
    length = rng.uniform(*gnss.wrong_s, count)
    pause = rng.exponential(1.0, count + 1)
    room = free - float(length.sum()) - 2.0 * count  # at least 2 s between two of them
    if count == 0 or room <= 0:
        return []
    start = gnss.calm_s + np.cumsum(pause[:-1] * room / float(pause.sum()) + 2.0)
    start[1:] += np.cumsum(length[:-1])
    size = _direction(rng, count) * rng.uniform(*gnss.wrong_m, count)[:, None]
    return [
        Fault("wrong", float(s), float(n), (float(o[0]), float(o[1]), float(o[2])))
        for s, n, o in zip(start, length, size, strict=True)
    ]


def gnss_fixes(scenario: Scenario, seed: int, duration_s: float, motion: Motion) -> tuple[FixTrack, Truth]:
    g = scenario.gnss
    if g is None:
        none, three = np.zeros(0, np.int64), np.zeros((0, 3))
        u8 = np.zeros(0, np.uint8)
        return FixTrack(none, none, three, three, u8, u8, three), motion.at(none)
    n = int(math.floor(duration_s * g.rate_hz + 1e-9)) + 1
    t = np.arange(n) / g.rate_hz
    t_ns = START_NS + np.rint(t * S).astype(np.int64)
    truth = motion.at(t_ns)
    sigma = np.array(g.sigma_m)
    z = truth.d_m + stream(seed, "gnss white").standard_normal((n, 3)) * sigma
    if any(g.multipath_m):
        z = z + _gauss_markov(stream(seed, "gnss multipath"), n, 1 / g.rate_hz, np.array(g.multipath_m), g.multipath_s)
    label, quality, offset = np.zeros(n, np.uint8), np.full(n, 4, np.uint8), np.zeros((n, 3))
    lost = stream(seed, "gnss drops").uniform(size=n) < g.drop_share

    faults = [*g.faults, *_spells(stream(seed, "gnss wrong"), g, duration_s)]
    if g.float_every_s > 0:
        begin = np.arange(max(g.float_every_s / 2, g.calm_s), duration_s, g.float_every_s)
        faults += [Fault("float", float(b), g.float_s) for b in begin]
    datum = np.zeros((n, 3))
    hit = stream(seed, "gnss outliers").uniform(size=n)
    share = np.full(n, g.outlier_share)
    float_rng = stream(seed, "gnss float")
    for kind in ("datum", "wrong", "float", "outliers", "outage"):  # a later kind overrides an earlier one
        for fault in (f for f in faults if f.kind == kind):
            inside = (t >= fault.start_s - 1e-9) & (t < fault.start_s + fault.length_s - 1e-9)
            if kind == "datum":
                after = t >= fault.start_s - 1e-9
                datum[after] += np.array(fault.size_m)
                label[after] = FixLabel.DATUM
            elif kind == "wrong":
                offset[inside] = np.array(fault.size_m)
                label[inside] = FixLabel.WRONG
            elif kind == "float":
                walk = _gauss_markov(
                    float_rng, int(inside.sum()), 1 / g.rate_hz, np.full(3, g.float_sigma_m), g.float_tau_s
                )
                offset[inside], label[inside], quality[inside] = walk, FixLabel.FLOAT, 5
            elif kind == "outliers":
                share[inside] = fault.size_m[0]
            else:
                lost |= inside
    rng = stream(seed, "gnss outlier sizes")
    outlier = hit < share
    size = _direction(rng, n) * rng.uniform(*g.outlier_m, n)[:, None]
    offset[outlier] = size[outlier]
    label[outlier] = FixLabel.OUTLIER
    offset += datum
    z = z + offset
    if g.minute_decimals is not None:
        lat, lon, _ = scenario.reference_llh
        north = 1852.0  # one minute of latitude
        for axis, degrees, minute_m in ((1, lat, north), (0, lon, north * math.cos(math.radians(lat)))):
            step = 10.0**-g.minute_decimals
            z[:, axis] = (np.rint((degrees * 60 + z[:, axis] / minute_m) / step) * step - degrees * 60) * minute_m
    if g.height_decimals is not None:
        step, h = 10.0**-g.height_decimals, scenario.reference_llh[2]
        z[:, 2] = np.rint((h + z[:, 2]) / step) * step - h
    jitter = stream(seed, "gnss jitter").uniform(-1.0, 1.0, n) * g.jitter_s
    arrival = in_order(t_ns + np.rint((g.latency_s + jitter) * S).astype(np.int64))
    keep = ~lost
    std = np.broadcast_to(sigma * g.declared, (n, 3))
    track = FixTrack(t_ns[keep], arrival[keep], z[keep], std[keep].copy(), quality[keep], label[keep], offset[keep])
    return track, pick(truth, keep)


def _rotation(small_deg: Vec3) -> F64:
    """Rotation by the vector's length about its direction (Rodrigues), (3, 3)."""
    r = np.radians(np.array(small_deg))
    angle = float(np.sqrt(np.sum(r * r)))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = r / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * (k @ k))


def accel_samples(a: Accel, seed: int, duration_s: float, motion: Motion) -> tuple[AccelTrack, Truth]:
    def rng(part: str) -> np.random.Generator:
        return stream(seed, f"{a.name} {part}")

    n = int(math.floor(duration_s * a.rate_hz + 1e-9)) + 1
    k = np.arange(n, dtype=np.int64)
    true_ns = START_NS + np.rint(k * (S / (a.rate_hz * (1 + a.clock_ppm * 1e-6)))).astype(np.int64)
    if a.clock_walk_s > 0:
        walk = np.cumsum(rng("clock").standard_normal(n)) * a.clock_walk_s / math.sqrt(3600.0 * a.rate_hz)
    else:
        walk = np.zeros(n)
    t_ns = START_NS + np.rint((k / a.rate_hz + a.clock_offset_s + walk) * S).astype(np.int64)
    inside = true_ns <= START_NS + int((duration_s + LEAD_S / 2) * S)
    truth = motion.at(true_ns[inside])
    k, true_ns, t_ns, n = k[inside], true_ns[inside], t_ns[inside], int(inside.sum())

    t = (true_ns - START_NS) / S
    up = np.array([0.0, 0.0, GRAVITY_MPS2 if a.gravity else 0.0])
    force = truth.a_mps2 + up  # specific force: a resting accelerometer reads +1 g upwards
    if any(a.tilt_per_m):
        force = force - GRAVITY_MPS2 * truth.d_m * np.array(a.tilt_per_m) * np.array([1.0, 1.0, 0.0])
    xyz = (1 + a.scale) * (force @ _rotation(a.misalignment_deg).T)
    draw = rng("bias")
    bias = draw.uniform(*a.bias_mps2, 3) * draw.choice([-1.0, 1.0], 3) + np.zeros((n, 3))
    if a.bias_walk > 0:
        bias = bias + np.cumsum(draw.standard_normal((n, 3)), axis=0) * math.sqrt(a.bias_walk / a.rate_hz)
    if a.temperature_mps2:
        phase = 2 * math.pi * t[:, None] / a.temperature_s + draw.uniform(0.0, 2 * math.pi, 3)
        bias = bias + a.temperature_mps2 * np.sin(phase)
    xyz = xyz + bias + rng("white").standard_normal((n, 3)) * a.noise * math.sqrt(a.rate_hz / 2)
    if a.lsb_mps2 > 0:
        xyz = np.rint(xyz / a.lsb_mps2) * a.lsb_mps2
    if a.range_mps2 > 0:
        xyz = np.clip(xyz, -a.range_mps2, a.range_mps2)

    chance = rng("frames").uniform(size=(3, n))
    late = np.where(chance[2] < a.late_share, 0.030, 0.0)
    jitter = rng("jitter").uniform(-1.0, 1.0, n) * a.jitter_s
    arrival = true_ns + np.rint((a.latency_s + a.clock_offset_s + jitter + late) * S).astype(np.int64)
    keep = chance[0] >= a.drop_share
    for start, length in a.gaps:
        keep &= (t < start) | (t >= start + length)
    track = AccelTrack(
        a.name,
        t_ns[keep],
        true_ns[keep],
        in_order(arrival)[keep],
        k[keep],
        xyz[keep],
        (chance[1] < a.duplicate_share).astype(np.uint8)[keep],
        (bias + up)[keep],
    )
    return track, pick(truth, keep)
