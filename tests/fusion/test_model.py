"""The model against numerical integration and dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm

from edge_agent.fusion import kalman
from edge_agent.fusion.model import B, D, N, O, V, gap_noise, growth, process_noise, transition

A = np.zeros((N, N))
A[D, V] = 1.0
A[V, B] = -1.0


@pytest.mark.parametrize("dt", [0.004, 0.1, 1.0, 30.0])
def test_transition_and_process_noise_solve_the_continuous_model(dt: float) -> None:
    assert np.allclose(transition([dt])[:, :, 0, 0], expm(A * dt), rtol=1e-12, atol=0)
    for white, walk, q, Q in zip((1.0, 0.0), (0.0, 1.0), (1.0, 1.0), process_noise([dt]), strict=True):
        G = np.diag([0.0, white, walk, 0.0])
        want, _ = quad_vec(lambda s, G=G: expm(A * s) @ G @ expm(A * s).T, 0.0, dt, epsrel=1e-12)
        assert np.allclose(Q[:, :, 0, 0] * q, want, rtol=1e-9, atol=1e-300)


def _random(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    L = rng.standard_normal((n, 3, N, N))
    C = np.moveaxis(L @ np.swapaxes(L, -1, -2), (2, 3), (0, 1))
    return rng.standard_normal((N, n, 3)), np.ascontiguousarray(C)


def test_predict_is_f_c_f_transposed_plus_q() -> None:
    x, C = _random(5, 1)
    dt = [0.1, 0.2, 1.0, 0.05, 3.0]
    rng = np.random.default_rng(2)
    s1, s2, q, qb = rng.uniform(0.1, 1.0, (4, 5, 3))
    Qa, Qb = process_noise(dt)
    y, P = kalman.predict(x, C, transition(dt), Qa, Qb, s1, s2, q, qb)
    for p in range(5):
        F = transition([dt[p]])[:, :, 0, 0]
        for a in range(3):
            assert np.allclose(y[:, p, a], F @ x[:, p, a] + [s2[p, a], s1[p, a], 0, 0])
            want = F @ C[:, :, p, a] @ F.T + q[p, a] * Qa[:, :, p, 0] + qb[p, a] * Qb[:, :, p, 0]
            assert np.allclose(P[:, :, p, a], want)


def test_update_is_the_textbooks_and_a_refused_fix_changes_no_bit() -> None:
    x, C = _random(4, 3)
    C = 0.5 * (C + C.swapaxes(0, 1))
    z = np.random.default_rng(4).standard_normal((4, 3))
    R = np.full((4, 3), 0.3)
    nu, CH, S = kalman.innovation(x, C, z, R)
    use = np.array([[1.0], [0.0], [1.0], [0.0]])
    y, P = kalman.update(x, C, nu, CH, S, R, use)
    H = np.zeros((1, N))
    H[0, [D, O]] = 1.0
    for p in range(4):
        for a in range(3):
            c = C[:, :, p, a]
            K = c @ H.T / (H @ c @ H.T + R[p, a])
            if use[p, 0]:
                assert np.allclose(y[:, p, a], x[:, p, a] + (K * (z[p, a] - H @ x[:, p, a]))[:, 0])
                assert np.allclose(P[:, :, p, a], (np.eye(N) - K @ H) @ c)
                assert (P[:, :, p, a] == P[:, :, p, a].T).all()
            else:
                assert y[:, p, a].tobytes() == x[:, p, a].tobytes()
                assert P[:, :, p, a].tobytes() == c.tobytes()


def test_growth_is_the_predicted_variance() -> None:
    _, C = _random(2, 5)
    C = 0.5 * (C + C.swapaxes(0, 1))
    q, qb = np.full((2, 3), 0.7), np.full((2, 3), 0.4)
    c = growth(C, q, qb)
    for dt in (0.01, 0.3, 2.0):
        power = dt ** np.arange(6)
        var = np.tensordot(power, c, 1)
        F = transition([dt])[:, :, 0, 0]
        Qa, Qb = process_noise([dt])
        for p in range(2):
            for a in range(3):
                want = F @ C[:, :, p, a] @ F.T + 0.7 * Qa[:, :, 0, 0] + 0.4 * Qb[:, :, 0, 0]
                assert var[a, p] == pytest.approx(want[D, D], rel=1e-12)
                assert var[3 + a, p] == pytest.approx(want[V, V], rel=1e-12)


def test_gap_noise_is_white_noise_that_has_ended() -> None:
    q = np.array([2.0])
    dd, dv, vv = gap_noise(0.7, 0.4, q)
    Qa, _ = process_noise([0.7])
    F = transition([0.4])[:, :, 0, 0]
    want = 2.0 * F @ Qa[:, :, 0, 0] @ F.T
    assert (dd[0], dv[0], vv[0]) == pytest.approx((want[D, D], want[D, V], want[V, V]))
