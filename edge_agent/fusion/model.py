"""States, transition and process noise of the fused filter, one axis of one point at a time, all stacked.

State per axis: displacement d [m], velocity v [m/s], accelerometer bias b [m/s2] relative to the reference that was
taken off before integration, level offset o [m] of the receiver's solution (zero with zero variance while no jump and
no float spell is open, so the measurement row is always d + o). A Gauss-Markov multipath state m belongs beside o: give
it the next index, its decay in `transition`, its variance in `process_noise`, and add it to the sums of d + o in
`kalman`.

Arrays put the state first: x (N, P, 3), C (N, N, P, 3) for P points and three axes, so that one operation on one state
touches one contiguous plane. The input is the acceleration's first-order-hold integrals over the interval: s1 adds to
v, s2 to d. A point without accelerations uses the same model with s1 = s2 = 0; -b is then its acceleration.

Equations: Smyth & Wu (2007) for the multi-rate form; q is the two-sided spectral density of the acceleration's noise
[m2/s3], qb of the bias walk [m2/s5]; both enter as the exact integrals of a continuous model.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edge_agent.messages import F64

D, V, B, O = 0, 1, 2, 3  # noqa: E741  the level offset's usual letter
N = 4


def transition(dt: Sequence[float]) -> F64:
    """F per interval [s], shape (N, N, len(dt), 1)."""
    return _last_two(
        [[1.0, t, -0.5 * t * t, 0.0, 0.0, 1.0, -t, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0] for t in dt]
    )


def process_noise(dt: Sequence[float]) -> tuple[F64, F64]:
    """Q per interval [s] for unit densities: Qa of white acceleration noise, Qb of the bias walk, (N, N, len(dt), 1).

    Q = q Qa + qb Qb.
    """
    white = []
    walk = []
    for t in dt:
        t2 = t * t
        t3 = t2 * t
        a, b = t3 / 3.0, 0.5 * t2
        white.append([a, b, 0.0, 0.0, b, t, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        a, b, c, d, e = t3 * t2 / 20.0, t2 * t2 / 8.0, t3 / -6.0, t3 / 3.0, -0.5 * t2
        walk.append([a, b, c, 0.0, b, d, e, 0.0, c, e, t, 0.0, 0.0, 0.0, 0.0, 0.0])
    return _last_two(white), _last_two(walk)


def _last_two(rows: list[list[float]]) -> F64:
    a = np.array(rows)
    return a.T.reshape(N, N, len(rows), 1)


def gap_noise(length: F64 | float, since: F64 | float, q: F64) -> tuple[F64, F64, F64]:
    """Variances (d, dv, v) of white acceleration noise q [m2/s3] that lasted `length` s and ended `since` s ago."""
    dd: F64 = q * length * (length * length * (1 / 3) + length * since + since * since)
    dv: F64 = q * length * (0.5 * length + since)
    vv: F64 = q * length
    return dd, dv, vv


def growth(C: F64, q: F64, qb: F64) -> F64:
    """Polynomial coefficients in D of the variances of d and v after the anchor, from F C F' + Q(D): (6, 6, P), of
    (1, D, ..., D^5); channels d xyz, v xyz. C (N, N, P, 3), q and qb (P, 3)."""
    dd, dv, db = C[D, D].T, C[D, V].T, C[D, B].T
    vv, vb, bb = C[V, V].T, C[V, B].T, C[B, B].T
    q, qb = q.T, qb.T
    out = np.zeros((6, 6, q.shape[1]))
    d, v = out[:, :3], out[:, 3:]
    d[0] = dd
    d[1] = dv * 2.0
    d[2] = vv - db
    d[3] = q * (1 / 3) - vb
    d[4] = bb * 0.25
    d[5] = qb * (1 / 20)
    v[0] = vv
    v[1] = q - vb * 2.0
    v[2] = bb
    v[3] = qb * (1 / 3)
    return out
