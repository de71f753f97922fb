"""A point without receiver: vibration is right, and a bias that moves shows in the sd, not as metres of motion."""

from __future__ import annotations

import numpy as np

from edge_agent.fusion.station import Station
from edge_agent.messages import AccelBlock, Estimate, FusionSettings, Mode, PointSettings, S


def fused(xyz: np.ndarray, rate: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    station = Station([PointSettings("p", None, "a")], FusionSettings())
    t = 10 * S + np.arange(len(xyz)) * (S // rate)
    out: list[Estimate] = []
    for i in range(0, len(t), rate // 10):
        n = len(t[i : i + rate // 10])
        block = AccelBlock("a", t[i : i + n], xyz[i : i + n], np.zeros(n, np.uint8), np.arange(i, i + n))
        now = int(t[i + n - 1])
        out += [
            o for o in [*station.accelerations({"a": block}, now), *station.advance(now)] if isinstance(o, Estimate)
        ]
    assert {int(m) for e in out for m in e.mode} == {Mode.ACCEL_ONLY}
    join = np.concatenate
    return join([e.t_ns for e in out]), join([e.displacement_m for e in out]), join([e.std_displacement_m for e in out])


def test_a_step_of_the_bias_stays_below_a_decimetre_and_inside_its_sd() -> None:
    """GIVEN a structure at rest WHEN the bias steps by 5 mg THEN displacement stays within 4 sd and comes back."""
    rate = 100
    rng = np.random.default_rng(3)
    xyz = rng.normal(0, 2e-3, (90 * rate, 3))
    xyz[40 * rate :, 0] += 0.05
    t, d, sd = fused(xyz, rate)
    assert np.abs(d[:, 0]).max() < 0.15
    late = t > t[0] + 60 * S
    assert np.abs(d[late, 0]).max() < 0.03
    assert (np.abs(d[late]) < 4 * sd[late]).all()


def test_vibration_above_a_tenth_of_a_hertz_is_right() -> None:
    rate = 100
    s = np.arange(120 * rate) / rate
    w = 2 * np.pi * 0.5
    xyz = np.zeros((s.size, 3))
    xyz[:, 1] = -0.01 * w * w * np.sin(w * s)
    rng = np.random.default_rng(4)
    t, d, _ = fused(xyz + rng.normal(0, 1e-3, xyz.shape), rate)
    true = 0.01 * np.sin(w * (t - 10 * S) / S)
    late = t > t[0] + 60 * S
    assert np.sqrt(np.mean((d[late, 1] - true[late]) ** 2)) < 0.002
