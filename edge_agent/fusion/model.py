"""States, transition and process noise of the fused filter, one axis of one point at a time, all stacked.

State per axis: displacement d [m], velocity v [m/s], accelerometer bias b [m/s2] relative to the reference that was
taken off before integration, level offset o [m] of the receiver's solution (zero with zero variance while no jump and
no float spell is open, so the measurement row is always d + o). A Gauss-Markov multipath state m belongs between b and
o: give it the next index, a row in `transition`, an entry in `process_noise` and a one in `MEASURED`.

Arrays put the state first: x (N, P, 3), C (N, N, P, 3) for P points and three axes, so that one operation on one state
touches one contiguous plane. The input is the acceleration's first-order-hold integrals over the interval: s1 adds to
v, s2 to d. A point without accelerations uses the same model with s1 = s2 = 0; -b is then its acceleration.

Equations: Smyth & Wu (2007) for the multi-rate form; q is the two-sided spectral density of the acceleration's noise
[m2/s3], qb of the bias walk [m2/s5]; both enter as the exact integrals of a continuous model.
"""

from __future__ import annotations

import numpy as np

from edge_agent.messages import F64

D, V, B, O = 0, 1, 2, 3  # noqa: E741  the level offset's usual letter
N = 4
MEASURED = (D, O)
"""States whose sum a fix measures."""


def transition(dt: F64 | float) -> F64:
    """F(dt), shape (N, N) + shape of dt [s]."""
    t = np.asarray(dt, dtype=np.float64)
    F = np.zeros((N, N, *t.shape))
    for i in range(N):
        F[i, i] = 1.0
    F[D, V] = t
    F[D, B] = -0.5 * t * t
    F[V, B] = -t
    return F


def process_noise(dt: F64 | float, q: F64 | float, qb: F64 | float) -> F64:
    """Q(dt), shape (N, N) + broadcast shape: white acceleration noise q [m2/s3] and bias walk qb [m2/s5] over dt [s]."""
    t, q, qb = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (dt, q, qb)))
    Q = np.zeros((N, N, *t.shape))
    t2 = t * t
    t3 = t2 * t
    Q[D, D] = t3 * (q * (1 / 3) + qb * (t2 * (1 / 20)))
    Q[D, V] = Q[V, D] = t2 * (q * 0.5 + qb * (t2 * (1 / 8)))
    Q[V, V] = t * q + qb * (t3 * (1 / 3))
    Q[D, B] = Q[B, D] = qb * (t3 * (-1 / 6))
    Q[V, B] = Q[B, V] = qb * (t2 * -0.5)
    Q[B, B] = qb * t
    return Q


def gap_noise(length: F64 | float, since: F64 | float, q: F64 | float) -> tuple[F64, F64, F64]:
    """Variances (d, dv, v) of white acceleration noise q [m2/s3] that lasted `length` s and ended `since` s ago."""
    L = np.asarray(length, dtype=np.float64)
    e = np.asarray(since, dtype=np.float64)
    return q * L * (L * L * (1 / 3) + L * e + e * e), q * L * (0.5 * L + e), q * L
