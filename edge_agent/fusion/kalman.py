"""Predict and update of stacked filters: pure functions of arrays, no matrix product, no linear algebra library.

Shapes as in `model`: x (N, P, 3), C (N, N, P, 3); F and Q's unit matrices (N, N, P or 1, 1); s1, s2, q, qb and
variances (P, 3). Joseph form, symmetrised. Sums run over a short leading axis, term by term, so every processor and
every number of points rounds them alike.
"""

from __future__ import annotations

from edge_agent.fusion.model import D, O, V
from edge_agent.messages import F64


def predict(x: F64, C: F64, F: F64, Qa: F64, Qb: F64, s1: F64, s2: F64, q: F64, qb: F64) -> tuple[F64, F64]:
    """x <- F x + (s2, s1, 0, 0), C <- F C F' + q Qa + qb Qb; Qa, Qb are Q's parts for unit densities."""
    x = (F * x).sum(axis=1)
    x[D] += s2
    x[V] += s1
    C = (F[:, :, None] * C).sum(axis=1)
    C = (C[:, None] * F[None]).sum(axis=2)
    C += Qa * q
    C += Qb * qb
    return x, C


def innovation(x: F64, C: F64, z: F64, R: F64) -> tuple[F64, F64, F64]:
    """Residual z - d - o (P, 3), C H' (N, P, 3) and its variance H C H' + R (P, 3)."""
    CH = C[:, D] + C[:, O]
    return z - x[D] - x[O], CH, CH[D] + CH[O] + R


def update(x: F64, C: F64, nu: F64, CH: F64, S: F64, R: F64, use: F64 | float) -> tuple[F64, F64]:
    """Joseph update, C <- (I - KH) C (I - KH)' + K R K'. `use` (P, 1) is 1.0 or 0.0; a zero leaves the point as it
    was."""
    K = CH * (use / S)
    C = C - K[:, None] * CH
    CH = C[:, D] + C[:, O]
    C += (K * R - CH)[:, None] * K
    C += C.swapaxes(0, 1).copy()
    C *= 0.5
    return x + K * nu, C
