"""Independent oracles for the filter: nothing here is shared with edge_agent.fusion.

`riccati_bound` and `smoothed_bound` are what the best live filter and the best smoother reach with the true noise;
`dense_smoother` solves the whole record as one sparse least-squares problem. Rauch, Tung and Striebel 1965 prove that
its answer is the RTS smoother's, and at the last instant the filter's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import sparse
from scipy.sparse.linalg import splu

F64 = npt.NDArray[np.float64]


def process_noise(dt: float, q: float, qb: float) -> F64:
    """Q (3, 3) of [d v b] over `dt` s: white acceleration of PSD q (m2/s3) and bias walk of PSD qb (m2/s5)."""
    t = dt
    white = q * np.array([[t**3 / 3, t**2 / 2, 0], [t**2 / 2, t, 0], [0, 0, 0]])
    walk = qb * np.array(
        [[t**5 / 20, t**4 / 8, -(t**3) / 6], [t**4 / 8, t**3 / 3, -(t**2) / 2], [-(t**3) / 6, -(t**2) / 2, t]]
    )
    return white + walk


def transition(dt: float) -> F64:
    """F (3, 3) of [d v b] over `dt` s: a_true = a_measured - b."""
    return np.array([[1, dt, -dt * dt / 2], [0, 1, -dt], [0, 0, 1.0]])


def accel_q(noise: float) -> float:
    """Two-sided acceleration PSD q (m2/s3) of a one-sided density `noise` (m/s2/sqrt(Hz))."""
    return noise * noise / 2


def _steady(fix_hz: float, sigma_m: float, q: float) -> tuple[F64, F64, F64]:
    """Steady covariances before and after a fix and F, two states, by iterating the Riccati recursion."""
    dt = 1.0 / fix_hz
    F, Q, R = transition(dt)[:2, :2], process_noise(dt, q, 0.0)[:2, :2], sigma_m**2
    P = np.diag([R, R])
    for _ in range(100_000):
        K = P[:, 0] / (P[0, 0] + R)
        after = P - np.outer(K, P[0])
        new = F @ after @ F.T + Q
        if np.allclose(new, P, rtol=1e-13, atol=0):
            break
        P = new
    return P, after, F


def riccati_bound(fix_hz: float, sigma_m: float, q: float, latency_s: float = 0.0) -> float:
    """The least live RMSE (m) of displacement: white fixes of `sigma_m` at `fix_hz`, acceleration noise of PSD `q`
    (m2/s3, see `accel_q`), all known exactly, no bias; variance averaged over the interval between fixes.

    With `latency_s` the newest fix in hand is between latency and latency + 1/fix_hz old.
    """
    _, P, _ = _steady(fix_hz, sigma_m, q)
    # mean over [a, b] of P11 + 2 P12 t + P22 t^2 + q t^3/3
    a, b = latency_s, latency_s + 1.0 / fix_hz

    def integral(t: float) -> float:
        return float(P[0, 0] * t + P[0, 1] * t**2 + P[1, 1] * t**3 / 3 + q * t**4 / 12)

    return math.sqrt((integral(b) - integral(a)) / (b - a))


def smoothed_bound(fix_hz: float, sigma_m: float, q: float) -> float:
    """The least RMSE (m) of a fixed-interval smoother at the fixes, far from both ends; same conditions."""
    before, after, F = _steady(fix_hz, sigma_m, q)
    C = after @ F.T @ np.linalg.inv(before)
    P = after
    for _ in range(100_000):
        new = after + C @ (P - before) @ C.T
        if np.allclose(new, P, rtol=1e-13, atol=0):
            break
        P = new
    return math.sqrt(P[0, 0])


@dataclass(frozen=True)
class Smoothed:
    """At `t` (n,) s: x (n, 3) = [d v b] in m, m/s, m/s2; cov (n, 3, 3), or (0, 3, 3) where it was not asked for."""

    t: F64
    x: F64
    cov: F64


def first_order_hold(t_a: F64, a: F64, begin: float, end: float) -> tuple[float, float]:
    """Exact single and double integral from `begin` to `end` of the straight lines through the samples (t_a, a);
    the first and last value hold outside. Returns (sum of v, sum of d) from rest."""
    inside = t_a[(t_a > begin) & (t_a < end)]
    t = np.concatenate([[begin], inside, [end]])
    y = np.interp(t, t_a, a)
    h = np.diff(t)
    v = float(np.sum(h * (y[:-1] + y[1:]) / 2))
    # d = integral of (end - t) a(t): exact by Simpson's rule, as the integrand is quadratic on each piece
    mid, y_mid = (t[:-1] + t[1:]) / 2, (y[:-1] + y[1:]) / 2
    d = float(np.sum(h / 6 * ((end - t[:-1]) * y[:-1] + 4 * (end - mid) * y_mid + (end - t[1:]) * y[1:])))
    return v, d


def dense_smoother(
    t_a: F64,
    a: F64,
    t_z: F64,
    z: F64,
    sigma: F64 | float,
    q: float,
    qb: float,
    *,
    extra_t: F64 | None = None,
    prior: tuple[F64, F64] | None = None,
    covariance: bool = False,
) -> Smoothed:
    """One axis, fixed-interval: all states [d v b] at the fixes (and at `extra_t`) as one least-squares problem.

    t_a, a: accelerometer samples (s, m/s2, gravity or any constant allowed: it is bias), held by first order. t_z, z,
    sigma: fixes (s, m, m), strictly increasing. q (m2/s3), qb (m2/s5): see `process_noise`; qb > 0. prior: mean (3,)
    and covariance (3, 3) of the first state; without it the data alone must fix all three. Minimises
    sum |x[k+1] - F x[k] - u[k]|^2 in Q^-1 + sum (z - d)^2/sigma^2 by sparse normal equations in units scaled per
    state. At the last instant the answer equals the Kalman filter's. Subtract a large constant from `a` for precision.
    """
    t = np.unique(np.concatenate([t_z, extra_t if extra_t is not None else np.zeros(0)]))
    n = len(t)
    steps = np.diff(t)
    scale = np.array([1e-3, 1e-2, 1e-2])  # m, m/s, m/s2 per unknown: keeps the normal equations well conditioned
    data: list[F64] = []
    rows: list[F64] = []
    cols: list[F64] = []
    rhs: list[float] = []
    row = 0

    def put(block: F64, col: int) -> None:
        r, c = np.indices(block.shape)
        data.append(block.ravel())
        rows.append((r + row).ravel())
        cols.append((c + col).ravel())

    for k, dt in enumerate(steps):
        v, d = first_order_hold(t_a, a, t[k], t[k + 1])
        L = np.linalg.cholesky(process_noise(dt, q, qb))
        W = np.linalg.inv(L)  # whitening: W Q W' = 1
        put(-W @ transition(dt) * scale, 3 * k)
        put(W * scale, 3 * k + 3)
        rhs.extend(W @ np.array([d, v, 0.0]))
        row += 3
    sd = np.broadcast_to(np.asarray(sigma, dtype=float), z.shape)
    for k, y, s in zip(np.searchsorted(t, t_z), z, sd, strict=True):
        put(np.array([[scale[0] / s]]), 3 * int(k))
        rhs.append(y / s)
        row += 1
    if prior is not None:
        W = np.linalg.inv(np.linalg.cholesky(prior[1]))
        put(W * scale, 0)
        rhs.extend(W @ prior[0])
        row += 3
    A = sparse.csc_matrix((np.concatenate(data), (np.concatenate(rows), np.concatenate(cols))), shape=(row, 3 * n))
    solve = splu((A.T @ A).tocsc())
    b = np.array(rhs)
    x = solve.solve(A.T @ b)
    x = x + solve.solve(A.T @ (b - A @ x))  # one step of refinement
    cov = np.zeros((0, 3, 3))
    if covariance:
        cov = np.empty((n, 3, 3))
        for k in range(n):
            unit = np.zeros((3 * n, 3))
            unit[3 * k : 3 * k + 3] = np.eye(3)
            cov[k] = solve.solve(unit)[3 * k : 3 * k + 3] * np.outer(scale, scale)
    return Smoothed(t, x.reshape(n, 3) * scale, cov)
