"""Frequency-split fusion, double integration and second differences, on motion that is known exactly."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.review.integrate import (
    band_pass,
    double_integral,
    high_pass,
    low_pass,
    second_difference,
    windowed_double_integral,
)
from edge_agent.review.likelihood import fit
from edge_agent.review.smooth import Accelerations, plain, smooth
from edge_agent.review.splits import D_TYPE, G_TYPE, critical_frequency, split_fusion
from edge_agent.simulate import SCENARIOS, FixLabel, run

F64 = npt.NDArray[np.float64]
S = 1_000_000_000


def ns(t: F64) -> npt.NDArray[np.int64]:
    return 10**15 + np.rint(t * S).astype(np.int64)


def three(x: F64) -> F64:
    return np.stack([x, 0.5 * x, -x], axis=1)


def test_filters_without_phase_share_a_signal_between_them() -> None:
    t = np.arange(6000) / 100
    slow, fast = 0.02 * np.sin(2 * math.pi * 0.05 * t) + 0.001 * t, 0.003 * np.sin(2 * math.pi * 1.5 * t)
    x = three(slow + fast)
    assert np.abs(low_pass(x, 100.0, 0.5) - three(slow)).max() < 4e-4
    assert np.abs(low_pass(x, 100.0, 0.5) - three(slow))[300:-300].max() < 2e-5
    assert np.abs(high_pass(x, 100.0, 0.5) - three(fast))[300:-300].max() < 2e-5
    assert np.abs(band_pass(x, 100.0, 1.0, 2.0) - three(fast))[300:-300].max() < 2e-4
    assert np.abs(low_pass(x, 100.0, 0.5) + high_pass(x, 100.0, 0.5) - x).max() < 1e-15


def test_the_overlay_is_the_motion_where_the_state_and_bias_are_right() -> None:
    t = np.arange(4000) / 200
    w = 2 * math.pi * 0.8
    d, v, a = 0.01 * np.sin(w * t), 0.01 * w * np.cos(w * t), -0.01 * w * w * np.sin(w * t)
    bias = np.array([0.03, -0.02, 9.81])
    o = double_integral(Accelerations(ns(t), three(a) + bias), ns(t[:3000]), np.zeros(3), three(v)[0], bias)
    # straight lines between samples miss (w h)^2 / 12 of the sine, and with it as much of the velocity
    missed = (w / 200) ** 2 / 12 * 0.01 * w
    assert np.abs(o.displacement_m - three(d)[:3000]).max() < 1.2 * missed * 15
    assert np.abs(o.velocity_mps - three(v)[:3000]).max() < 3 * missed
    wrong = double_integral(Accelerations(ns(t), three(a) + bias), ns(t[:3000]), np.zeros(3), three(v)[0], bias - 0.01)
    drift = wrong.displacement_m - three(d)[:3000]
    assert drift[-1] == pytest.approx(np.full(3, 0.5 * 0.01 * t[2999] ** 2), rel=2e-3)


def test_four_periods_make_a_window_and_one_takes_motion_with_it() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(8000) / 100
    w = 2 * math.pi * 0.9
    d = 0.004 * np.sin(w * t + 0.4)
    a = three(-w * w * d) + 1e-3 * rng.standard_normal((8000, 3))
    errors = {}
    for periods in (1.0, 4.0):
        got = windowed_double_integral(high_pass(a, 100.0, 0.45), 100.0, periods / 0.9)
        errors[periods] = float(np.std((got - three(d))[500:-500, 0]))
    print("windows of 1 and 4 periods:", errors)
    assert errors[4.0] < 0.15 * 0.004 / math.sqrt(2)
    assert errors[1.0] > 3 * errors[4.0]


def test_the_second_difference_is_the_acceleration_on_the_weak_axis_too() -> None:
    """P1 (Wang et al.): the fused displacement gives the accelerations back, the raw fixes do not, least on the weak
    axis."""
    r = run(SCENARIOS["P1"], 1, 600.0)
    fixes, accel = plain(r.fixes.t_ns, r.fixes.z_m, r.fixes.std_m), Accelerations(r.accel.t_ns, r.accel.xyz)
    s = smooth(fixes, accel, fit(fixes, accel, most=600).noise, std=False)
    fused = second_difference(s.t_ns, s.displacement_m, accel, 0.15, 2.0)
    raw = second_difference(fixes.t_ns, fixes.z_m, accel, 0.15, 2.0)
    print("P1 second differences: fused", fused.correlation.round(4), "raw", raw.correlation.round(4))
    assert (fused.correlation > 0.99).all()
    assert np.abs(fused.gain - 1).max() < 0.02
    assert (fused.rms_difference_mps2 < 0.1 * fused.rms_mps2).all()
    assert (raw.correlation < 0.5).all()
    assert raw.correlation[2] < 0.1


def test_split_fusion_beside_the_filter_on_the_arch_bridge() -> None:
    """P3: critical frequency from the data, both types at millimetre level, float spells and outliers left out."""
    r = run(SCENARIOS["P3"], 1, 400.0)
    good = r.fixes.label == FixLabel.GOOD
    fixes = plain(r.fixes.t_ns[good], r.fixes.z_m[good], r.fixes.std_m[good])
    accel = Accelerations(r.accel.t_ns, r.accel.xyz)
    assert critical_frequency(accel) == pytest.approx(0.91, abs=0.03)
    s = split_fusion(fixes, accel)
    truth = np.stack([np.interp(s.t_ns, r.accel.true_ns, r.truth.d_m[:, i]) for i in range(3)], axis=1)
    filtered = smooth(fixes, accel, fit(fixes, accel, most=1000).noise, std=False, ahead=False)
    f = np.stack([np.interp(s.t_ns, filtered.t_ns, filtered.displacement_m[:, i]) for i in range(3)], axis=1)

    def rmse(x: F64) -> F64:
        return np.sqrt(((x - truth)[3000:-500] ** 2).mean(axis=0))

    print("P3, mm: G", 1e3 * rmse(s.g_type_m), "D", 1e3 * rmse(s.d_type_m), "filter", 1e3 * rmse(f))
    assert (rmse(s.g_type_m) < (0.002, 0.002, 0.004)).all()
    assert (rmse(s.d_type_m) < (0.002, 0.002, 0.004)).all()
    raw = np.sqrt(((fixes.z_m - r.truth_at_fixes.d_m[good]) ** 2).mean(axis=0))
    assert (rmse(s.displacement_m) < 0.6 * raw).all()
    assert set(np.unique(s.kind)) <= {G_TYPE, D_TYPE}
    with pytest.raises(ValueError, match="shorter"):
        split_fusion(fixes.part(0, 30), accel, 0.91)


def test_stretches_of_either_type_are_put_together_in_the_order_of_time() -> None:
    """Vibration at 2 Hz in the first half, a slow move in the second."""
    rng = np.random.default_rng(3)
    t = np.arange(20_000) / 100
    w = 2 * math.pi * 2.0
    first = t < 100
    vibration = np.where(first, 0.004 * np.sin(w * t), 0.0)
    ramp = np.where(first, 0.0, 0.03 * (1 - np.cos(2 * math.pi * (t - 100) / 60)))
    a = np.where(first, -w * w * vibration, 0.03 * (2 * math.pi / 60) ** 2 * np.cos(2 * math.pi * (t - 100) / 60))
    accel = Accelerations(ns(t), three(a) + 1e-4 * rng.standard_normal((20_000, 3)))
    z = three(vibration + ramp)[::10] + 0.001 * rng.standard_normal((2000, 3))
    s = split_fusion(plain(ns(t[::10]), z, 0.001), accel, 2.0)
    at = (s.t_ns - 10**15) / S
    assert (s.kind[at < 90] == G_TYPE).all()
    assert (s.kind[at > 110] == D_TYPE).all()
    assert (s.displacement_m[at < 85] == s.g_type_m[at < 85]).all()
    assert (s.displacement_m[at > 115] == s.d_type_m[at > 115]).all()
    assert np.abs(np.diff(s.displacement_m, axis=0)).max() < 0.0025  # 0.5 mm a sample is the vibration itself
    assert np.std((s.displacement_m - three(vibration + ramp)[: len(at)])[500:-500, 0]) < 0.0015


def test_without_a_clear_peak_the_critical_frequency_must_be_given() -> None:
    accel = Accelerations(ns(np.arange(20_000) / 100), np.random.default_rng(4).standard_normal((20_000, 3)))
    with pytest.raises(ValueError, match="give the critical frequency"):
        critical_frequency(accel)
