"""The R rule, the start's robust figures, and the bank against dense Gaussian likelihood."""

from __future__ import annotations

import math

import numpy as np
import pytest
from oracles import process_noise, transition

from edge_agent.fusion.noise import Bank, fix_std, robust_mask, third_difference_std
from edge_agent.messages import Quality

NAN = math.nan
NO = (NAN, NAN, NAN)
FLOOR = (0.001, 0.001, 0.002)


def test_gst_speaks_first_and_the_floor_last() -> None:
    assert fix_std(Quality.FIXED, (0.004, 0.005, 0.009), 0.8, 1.2, 1.0, NO, FLOOR) == pytest.approx(
        (0.004, 0.005, 0.009)
    )
    assert fix_std(Quality.FIXED, (0.0001, 0.0001, 0.0001), 0.8, 1.2, 1.0, NO, FLOOR) == pytest.approx(FLOOR)


def test_without_gst_quality_and_dilution_decide() -> None:
    assert fix_std(Quality.FIXED, NO, 1.5, 2.0, NAN, NO, FLOOR) == pytest.approx((0.012, 0.012, 0.030))
    assert fix_std(Quality.FIXED, NO, NAN, NAN, NAN, NO, FLOOR) == pytest.approx((0.008, 0.008, 0.015))
    order = [
        fix_std(q, NO, 1.0, 1.0, NAN, NO, FLOOR)[0]
        for q in (Quality.FIXED, Quality.FLOAT, Quality.DGNSS, Quality.SINGLE)
    ]
    assert order == sorted(order)
    assert fix_std(Quality.NONE, (0.01, 0.01, 0.01), 1.0, 1.0, NAN, NO, FLOOR) == (math.inf,) * 3


def test_a_float_solution_that_claims_millimetres_is_not_believed() -> None:
    assert min(fix_std(Quality.FLOAT, (0.002, 0.002, 0.002), 1.0, 1.0, NAN, NO, FLOOR)) >= 0.03


def test_coarse_decimals_and_old_corrections_enter() -> None:
    e, n, u = fix_std(Quality.FIXED, (0.003, 0.003, 0.003), 1.0, 1.0, NAN, (0.018, 0.012, 0.1), FLOOR)
    assert (e, n, u) == pytest.approx(tuple(math.sqrt(0.003**2 + s * s / 12) for s in (0.018, 0.012, 0.1)))
    assert fix_std(Quality.FIXED, (0.003,) * 3, 1.0, 1.0, 25.0, NO, FLOOR)[0] == pytest.approx(math.hypot(0.003, 0.020))


def test_third_differences_see_the_white_part_only() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(2000) * 0.1
    w = rng.standard_normal((2000, 3)) * [0.003, 0.001, 0.006] + (0.5 * 0.02 * t**2)[:, None]
    assert np.array(third_difference_std(w)) == pytest.approx([0.003, 0.001, 0.006], rel=0.08)
    w[::20] += 1.0  # each outlier is in four differences: a fifth of all
    assert np.array(third_difference_std(w)) == pytest.approx([0.003, 0.001, 0.006], rel=0.45)


@pytest.mark.parametrize("walk", [0.0, 3e-2])
def test_robust_mask_finds_outliers_and_blocks(walk: float) -> None:
    rng = np.random.default_rng(2)
    t = np.arange(150) * 0.1
    bias = np.cumsum(rng.standard_normal((150, 3)), axis=0) * walk
    slow = np.cumsum(np.cumsum(bias * 0.1, axis=0) * 0.1, axis=0)
    w = rng.standard_normal((150, 3)) * [0.003, 0.003, 0.006] + slow + (0.3 * t - 0.02 * t**2)[:, None]
    bad = np.zeros(150, bool)
    bad[[7, 30, 31, 90, 149]] = True
    w[bad] += [0.2, -0.4, 0.1]
    if walk == 0:
        bad[50:70] = True  # two seconds at a wrong level
        w[50:70] += [0.0, 0.06, 0.0]
    mask = np.array(robust_mask(t, w))
    assert not mask[bad].any()
    assert mask[~bad].mean() > 0.97


def test_bank_gives_each_members_exact_likelihood() -> None:
    """-2 log p(z) up to what is common, r concentrated, from the dense covariance of all fixes."""
    rng = np.random.default_rng(3)
    dt = rng.uniform(0.05, 0.4, 25)
    z = np.cumsum(rng.standard_normal((26, 3)) * 0.01, axis=0)
    bank = Bank(2)
    bank.reset(1, z[0], np.zeros(3), np.zeros(3))
    one = np.ones(1)
    for k in range(25):
        bank.predict([1], dt[k : k + 1], np.zeros((1, 3)), np.zeros((1, 3)))
        bank.update([1], z[k + 1][None], one)
    bank.fold(1)
    for member in (0, 40, 100, len(bank.log_rho) - 1):
        rho, beta = float(bank.rho[member, 0]), float(bank.beta[member, 0])
        C = np.diag([1e6, 1e8, 1e9])
        blocks = [C]
        maps = [np.eye(3)]
        for h in dt:
            F = transition(h)
            maps.append(F)
            blocks.append(F @ blocks[-1] @ F.T + process_noise(h, rho, beta))
        cov = np.zeros((25, 25))
        for i in range(25):
            forward = np.eye(3)
            for j in range(i, 25):
                if j > i:
                    forward = maps[j + 1] @ forward
                cov[i, j] = cov[j, i] = (forward @ blocks[i + 1])[0, 0]
        cov += np.eye(25)
        if np.linalg.cond(cov) > 1e13:
            continue
        _, logdet = np.linalg.slogdet(cov)
        assert bank.sum_l[member, 1] == pytest.approx(logdet, rel=1e-4, abs=1e-3)
        for axis in range(3):
            e = z[1:, axis] - z[0, axis]
            assert bank.sum_e[member, 1, axis] == pytest.approx(e @ np.linalg.solve(cov, e), rel=1e-3)


def test_bank_finds_the_noise_that_made_the_data() -> None:
    rng = np.random.default_rng(4)
    q, r, n = 2.4e-8, 9e-6, 1500
    chol = np.linalg.cholesky(process_noise(0.1, q, 1e-12))
    F = transition(0.1)
    z = np.zeros((n, 3))
    for axis in range(3):
        x = np.zeros(3)
        for k in range(n):
            x = F @ x + chol @ rng.standard_normal(3)
            z[k, axis] = x[0] + math.sqrt(r) * rng.standard_normal()
    bank = Bank(1)
    bank.reset(0, z[0], np.zeros(3), np.zeros(3))
    step, one, zero = np.array([0.1]), np.ones(1), np.zeros((1, 3))
    for k in range(1, n):
        bank.predict(slice(0, 1), step, zero, zero)
        bank.update(slice(0, 1), z[k][None], one)
        if k % 20 == 0:
            bank.fold(0)
    flat = [(0.0, 0.0, 0.0, 0.0)] * 3
    for rho, _, log_r, _ in bank.posterior(0, flat):
        assert math.exp(log_r) == pytest.approx(r, rel=0.15)
        assert abs(math.log10(math.exp(rho + log_r) / q)) < 0.7
