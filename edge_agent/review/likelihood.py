"""How likely the fixes are under many hypotheses at once: noise, clock offset, mounting.

A plain three-state filter [d v b] per lane. Everything is measured in the fixes' own variance: R = r std^2, q = r q~,
qb = r qb~, so that the gains depend on the ratios q~, qb~ alone and the best r follows from the residuals
("concentrated"). For given gains the filter is linear in what goes in, fixes and accelerations alike: `whiten` returns
the normalised innovations of each input, and any mixture of inputs is then a linear regression (see agree).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from edge_agent.messages import F64
from edge_agent.review.smooth import NS, Accelerations, Fixes, Noise, increments

SKIP = 6
"""First innovations that carry the wide start and are not counted."""
THIN_S = 0.5
"""Fixes of a long record are thinned to so far apart: noise is slow, and a long record shows more of it."""
START_VB = 1e8
"""Start variance of v [m2/s2] and b [m2/s4] in units of the first fix's variance: 30 m/s at 3 mm."""


class Gains(NamedTuple):
    """What the filter of each lane does at each fix, whatever goes in: gains g0, g1, g2 (n, G) for d, v, b, zero where
    no fix is; 1/sqrt(S) (n, G), zero likewise; S in units of r, 1 likewise; dt (n,)."""

    g0: F64
    g1: F64
    g2: F64
    weight: F64
    variance: F64
    dt: F64


def gains(dt: F64, std: F64, q: F64, qb: F64) -> Gains:
    """dt (n,) s before each fix, 0 for the first; std (n, G) declared sd, inf = no fix; q, qb (n, G) ratios over the
    interval before. The first fix is the start."""
    n, G = std.shape
    used = np.isfinite(std)
    R = np.where(used, std, 1.0) ** 2
    g0, g1, g2 = np.zeros((n, G)), np.zeros((n, G)), np.zeros((n, G))
    variance = np.ones((n, G))
    first = R[0]
    dd, dv, db = first.copy(), np.zeros(G), np.zeros(G)
    vv, vb, bb = START_VB * first, np.zeros(G), START_VB * first
    for k in range(1, n):
        t = float(dt[k])
        h, t2 = 0.5 * t * t, t * t
        # F P F' + Q, written out
        dd = dd + 2 * t * dv - 2 * h * db + t2 * vv - 2 * t * h * vb + h * h * bb
        dv = dv + t * vv - t * db - (h + t2) * vb + h * t * bb
        db = db + t * vb - h * bb
        vv = vv - 2 * t * vb + t2 * bb
        vb = vb - t * bb
        a, w = q[k], qb[k]
        dd += a * (t2 * t / 3) + w * (t2 * t2 * t / 20)
        dv += a * h + w * (t2 * t2 / 8)
        db -= w * (t2 * t / 6)
        vv += a * t + w * (t2 * t / 3)
        vb -= w * h
        bb = bb + w * t
        S = dd + R[k]
        inverse = used[k] / S
        variance[k] = S
        u0, u1, u2 = dd * inverse, dv * inverse, db * inverse
        g0[k], g1[k], g2[k] = u0, u1, u2
        vv = vv - u1 * dv
        vb = vb - u1 * db
        bb = bb - u2 * db
        dv, db, dd = dv - u0 * dv, db - u0 * db, dd - u0 * dd
    variance = np.where(used, variance, 1.0)
    return Gains(g0, g1, g2, np.where(used, 1.0 / np.sqrt(variance), 0.0), variance, dt)


def whiten(g: Gains, s1: F64, s2: F64, z: F64) -> F64:
    """Normalised innovations (n, C, G) of C inputs: increments s1, s2 over the interval before, fixes z (n, C, G)."""
    n, C, G = z.shape
    out = np.zeros((n, C, G))
    x_d, x_v, x_b = z[0].copy(), np.zeros((C, G)), np.zeros((C, G))
    for k, t in enumerate(g.dt.tolist()):
        if k == 0:
            continue
        x_d += t * x_v
        x_d -= (0.5 * t * t) * x_b
        x_d += s2[k]
        x_v -= t * x_b
        x_v += s1[k]
        e = z[k] - x_d
        np.multiply(e, g.weight[k], out=out[k])
        x_d += g.g0[k] * e
        x_v += g.g1[k] * e
        x_b += g.g2[k] * e
    return out


def log_likelihood(e: F64, variance: F64, std: F64) -> tuple[F64, F64]:
    """Of normalised innovations (n, G): log likelihood with the best r (G,), and that r."""
    counted = np.isfinite(std)
    counted[:SKIP] = False
    n = np.maximum(counted.sum(axis=0), 1)
    r = np.maximum((np.where(counted, e, 0.0) ** 2).sum(axis=0) / n, 1e-12)
    return -0.5 * (n * (np.log(2 * math.pi * r) + 1.0) + np.where(counted, np.log(variance), 0.0).sum(axis=0)), r


@dataclass(frozen=True, slots=True)
class Fit:
    """Maximum likelihood per axis (3,): densities, factor r on the declared variance, the log likelihood reached, and
    how many fixes it rests on."""

    noise: Noise
    r: F64
    log_likelihood: F64
    fixes: int


def prepare(fixes: Fixes) -> tuple[F64, F64, F64]:
    """dt (n,), z and std (n, 3) for `whiten`, without fixes from another level; z about its first value."""
    good = np.isfinite(fixes.z_m) & np.isfinite(fixes.std_m) & (fixes.level == 0)[:, None]
    std = np.where(good, fixes.std_m, np.inf)
    first = np.array([_first(fixes.z_m[:, i], good[:, i]) for i in range(3)])
    z = np.where(good, fixes.z_m - first, 0.0)
    std[0] = np.where(good[0], std[0], 1.0)
    dt = np.diff(fixes.t_ns, prepend=fixes.t_ns[:1]) * NS
    return dt, z, std


def _first(z: F64, good: F64) -> float:
    at = np.flatnonzero(good)
    return float(z[at[0]]) if len(at) else 0.0


def fit(fixes: Fixes, accel: Accelerations, *, r: float | None = None, most: int = 3000) -> Fit:
    """Maximum likelihood of q, qb and r of a record (Shan & Qi; here with a bias walk), each axis for itself.

    A grid over both ratios, narrowed three times. `r` given = the declared variances times r are right. Without
    accelerations q, qb are those of a displacement by itself. Uses at most `most` fixes. ValueError below 20.
    """
    n = len(fixes)
    if n < 20:
        raise ValueError("fit: 20 fixes at least")
    part = _some(fixes, most)
    reference = np.nanmean(accel.xyz, axis=0) if len(accel.t_ns) else np.zeros(3)
    inc = increments(part.t_ns, accel, reference)
    zero = np.zeros((1, 3))
    s1, s2 = np.concatenate([zero, inc.s1.T]), np.concatenate([zero, inc.s2.T])
    gap = np.concatenate([zero, inc.extra.T]) if len(accel.t_ns) else np.zeros((len(part), 3))
    dt, z, std = prepare(part)
    usual = float(np.median(dt[1:]))
    declared = np.median(np.where(np.isfinite(std), std, 0.01), axis=0) ** 2
    # in units that make 1 mean: as much noise within an interval as in a fix
    unit_q, unit_qb = declared / usual**3, declared / usual**5
    centre = np.zeros((2, 3))
    best = np.full(3, -np.inf)
    best_r = np.ones(3)
    for span, count in ((6.0, 9), (1.5, 7), (0.4, 7), (0.12, 7)):
        steps = np.linspace(-span, span, count)
        a, b = (m.ravel() for m in np.meshgrid(steps, steps))
        q = unit_q * 10.0 ** (centre[0] - (2.0 if span == 6.0 else 0.0) + a[:, None])
        qb = unit_qb * 10.0 ** (centre[1] - (5.0 if span == 6.0 else 0.0) + b[:, None])
        G = a.size * 3
        lanes = [np.tile(m, (1, a.size))[:, None, :] for m in (s1, s2, z)]
        wide = np.tile(std, (1, a.size))
        ratio = np.tile(gap, (1, a.size)) + q.reshape(1, G)  # a gap's noise is absolute: as if r were 1
        g = gains(dt, wide, ratio, np.broadcast_to(qb.reshape(1, G), wide.shape))
        e = whiten(g, *lanes)[:, 0]
        value, r_each = log_likelihood(e, g.variance, wide)
        if r is not None:
            value = fixed_likelihood(e, g.variance, wide, r)
            r_each = np.full(G, r)
        value, r_each = value.reshape(-1, 3), r_each.reshape(-1, 3)
        for axis in range(3):
            k = int(np.argmax(value[:, axis]))
            if value[k, axis] >= best[axis]:
                best[axis], best_r[axis] = value[k, axis], r_each[k, axis]
                centre[0, axis] = math.log10(q[k, axis] / unit_q[axis])
                centre[1, axis] = math.log10(qb[k, axis] / unit_qb[axis])
    q_best = unit_q * 10.0 ** centre[0] * best_r
    qb_best = unit_qb * 10.0 ** centre[1] * best_r
    return Fit(Noise(q_best, qb_best), best_r, best, len(part))


def _some(fixes: Fixes, most: int) -> Fixes:
    """At most so many fixes: thinned to THIN_S, then those in the middle."""
    n = len(fixes)
    usual = max(float(np.median(np.diff(fixes.t_ns))) * NS, 1e-3)
    every = min(-(-n // most), max(1, round(THIN_S / usual)))
    k = np.arange(0, n, every)
    lo = max(0, (len(k) - most) // 2)
    k = k[lo : lo + most]
    return Fixes(fixes.t_ns[k], fixes.z_m[k], fixes.std_m[k], fixes.level[k], fixes.step[k])


def fixed_likelihood(e: F64, variance: F64, std: F64, r: F64 | float) -> F64:
    """Log likelihood (G,) of normalised innovations (n, G) with a given r."""
    counted = np.isfinite(std)
    counted[:SKIP] = False
    each = np.log(2 * math.pi * r * variance) + e * e / r
    return np.asarray(-0.5 * np.where(counted, each, 0.0).sum(axis=0))
