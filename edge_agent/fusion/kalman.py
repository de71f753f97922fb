"""Predict and update of stacked filters: pure functions of arrays, no matrix product, no linear algebra library.

Shapes as in `model`: x (N, P, 3), C (N, N, P, 3); dt, s1, s2, q, qb, variances broadcast to (P, 3). Joseph form,
symmetrised. The sums are written out so that every processor rounds them alike.
"""

from __future__ import annotations

import numpy as np

from edge_agent.fusion.model import B, D, O, V
from edge_agent.messages import F64


def predict(x: F64, C: F64, dt: F64, s1: F64, s2: F64, q: F64, qb: F64) -> tuple[F64, F64]:
    """x <- F x + (s2, s1, 0, 0), C <- F C F' + Q(dt), with F and Q of `model` in their sparse form."""
    half = dt * dt * 0.5
    x = x.copy()
    x[D] += x[V] * dt - x[B] * half + s2
    x[V] += s1 - x[B] * dt
    C = C.copy()
    C[D] += C[V] * dt - C[B] * half
    C[V] -= C[B] * dt
    C[:, D] += C[:, V] * dt - C[:, B] * half
    C[:, V] -= C[:, B] * dt
    t3 = half * dt
    C[D, D] += t3 * (q * (2 / 3) + qb * (half * 0.2))
    c = half * (q + qb * (half * 0.5))
    C[D, V] += c
    C[V, D] += c
    C[V, V] += dt * q + qb * (t3 * (2 / 3))
    c = qb * (t3 * (1 / 3))
    C[D, B] -= c
    C[B, D] -= c
    c = qb * half
    C[V, B] -= c
    C[B, V] -= c
    C[B, B] += qb * dt
    return x, C


def relax_offset(x: F64, C: F64, phi: F64, variance: float) -> None:
    """Let o decay as a Gauss-Markov process, in place: o <- phi o, stationary variance in m2. phi (P, 1), 1 = a constant."""
    x[O] *= phi
    C[O] *= phi
    C[:, O] *= phi
    C[O, O] += (1.0 - phi * phi) * variance


def innovation(x: F64, C: F64, z: F64, R: F64) -> tuple[F64, F64, F64]:
    """Residual z - d - o (P, 3), C H' (N, P, 3) and its variance H C H' + R (P, 3)."""
    CH = C[:, D] + C[:, O]
    return z - x[D] - x[O], CH, CH[D] + CH[O] + R


def update(x: F64, C: F64, nu: F64, CH: F64, S: F64, R: F64, use: F64) -> tuple[F64, F64]:
    """Joseph update, C <- (I - KH) C (I - KH)' + K R K'. `use` (P, 1) is 1.0 or 0.0; a zero leaves the point as it was."""
    K = CH * (use / S)
    A = C - K[:, None] * CH[None]
    AH = A[:, D] + A[:, O]
    C = A + (K * R - AH)[:, None] * K[None]
    return x + K * nu, 0.5 * (C + np.swapaxes(C, 0, 1))
