"""The fused stream between fixes: states at an anchor and integrals become displacement, velocity and their sd.

    d(t) = d + v D + S2 - b D^2 / 2        v(t) = v + S1 - b D        D = t - anchor

with S1, S2 from the running integrals (see `integrals`), and the variances as polynomials in D (`model.growth`).
"""

from __future__ import annotations

import numpy as np

from edge_agent.fusion.integrals import NS
from edge_agent.fusion.model import B, D, V, gap_noise, growth
from edge_agent.fusion.point import Gap
from edge_agent.messages import F64, I64


def stream(t: I64, g: F64, anchor_ns: I64, x: F64, C: F64, g0: F64, q: F64, qb: F64) -> F64:
    """Rows t (P, n), integrals g (P, n, 6) as (g2, g1); x (N, P, 3), C, and g0 (P, 6) at the anchors (P,).

    Returns (12, P, n): displacement and velocity, then their variances; samples last, so that one operation is a few
    long loops and not many short ones.
    """
    out = np.empty((12, *t.shape))
    y, var = out[:6], out[6:]
    dt = (t - anchor_ns[:, None]) * NS
    c = np.zeros((3, 6, len(t)))
    start, slope, b = x[D] - g0[:, :3], x[V] - g0[:, 3:], x[B]
    c[0, :3] = start.T
    c[0, 3:] = slope.T
    c[1, :3] = slope.T
    c[1, 3:] = -b.T
    c[2, :3] = b.T * -0.5
    k = c[..., None]
    np.multiply(k[2], dt, out=y)
    y += k[1]
    y *= dt
    y += k[0]
    y += g.T.swapaxes(1, 2)
    k = growth(C, q, qb)[..., None]
    np.multiply(k[5], dt, out=var)
    for i in (4, 3, 2, 1):
        var += k[i]
        var *= dt
    var += k[0]
    return out


def add_gaps(gaps: list[Gap], anchor_ns: int, t: I64, var: F64) -> None:
    """Add the noise of gaps after the anchor to the variances (n, 6) of rows t (n,), in place."""
    for g in gaps:
        begin = max(g.begin_ns, anchor_ns)
        end = np.minimum(t, g.end_ns)
        length = np.asarray(np.maximum(end - begin, 0) * NS, dtype=np.float64)[:, None]
        since = np.asarray((t - end) * NS, dtype=np.float64)[:, None]
        dd, _, vv = gap_noise(length, since, g.q)
        var[:, :3] += dd
        var[:, 3:] += vv
