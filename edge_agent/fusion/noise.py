"""What the filter believes about its sensors: the R rule, the scale of R, and the bank that finds q and qb.

**R rule** (`fix_std`): the receiver's own sd (GST) where it speaks, else a sd by quality and dilution; aged corrections
add; never below the floor; one step of the last decimal adds its uniform variance step^2 / 12.

**R scale**: receivers misstate their sd. Per axis the factor on R follows the median of nu^2 / S (0.4549 for a
chi-square of one degree): a step of fixed size up or down per fix, so an outlier counts no more than any other. It
starts from the median absolute third difference of z - J(t) over the start window (J the integrated accelerations),
which white noise fills and slow motion does not.

**Bank**: one three-state filter (d, v, b) per pair (q/r, qb/r) on a fixed grid, everything relative to r, so that all
axes share one covariance and r itself is concentrated: r = mean of nu^2 / s per axis. Each member's likelihood is
kept with a forgetting time; q and qb are the posterior's means in the logarithm. The grid spans what structures and
sensors can do, so the start is wide and the data narrow it. Source of the construction: the project's numerical
study; maximum likelihood for q and r after Shan & Qi.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from edge_agent.fusion.integrals import block
from edge_agent.messages import F64, Quality, State

CHI1_MEDIAN = 0.45493642311957283
"""Median of a chi-square of one degree of freedom."""

# sd of a fix whose receiver sends no GST [m]: horizontal per unit of HDOP, vertical per unit of VDOP. Fixed: the usual
# data sheet's 8 mm + 1 ppm and 15 mm + 1 ppm; the others are the classes' usual accuracy.
_BY_QUALITY = {
    Quality.SINGLE: (2.5, 5.0),
    Quality.DGNSS: (0.5, 1.0),
    Quality.PPS: (0.5, 1.0),
    Quality.FIXED: (0.008, 0.015),
    Quality.FLOAT: (0.15, 0.30),
    Quality.ESTIMATED: (5.0, 10.0),
    Quality.MANUAL: (0.008, 0.015),
    Quality.SIMULATED: (0.008, 0.015),
}
_FLOOR = {Quality.FLOAT: 0.03, Quality.SINGLE: 0.5, Quality.DGNSS: 0.1, Quality.PPS: 0.1, Quality.ESTIMATED: 1.0}
"""Least sd [m] by quality, whatever GST says; fixed: the receiver's own floor."""


def fix_std(
    quality: Quality,
    std_enu_m: tuple[float, float, float],
    hdop: float,
    vdop: float,
    age_s: float,
    resolution_enu_m: tuple[float, float, float],
    sigma_floor_m: tuple[float, float, float],
) -> tuple[float, float, float]:
    """sd of one fix in E, N, U [m]. NaN = the receiver did not say; quality NONE gives infinity."""
    if quality not in _BY_QUALITY:
        return (math.inf, math.inf, math.inf)
    by_dop = _BY_QUALITY[quality]
    h = by_dop[0] * (hdop if math.isfinite(hdop) and hdop > 0 else 1.0)
    v = by_dop[1] * (vdop if math.isfinite(vdop) and vdop > 0 else 1.0)
    floor = _FLOOR.get(quality, 0.0)
    # Corrections older than 5 s let the fixed solution drift by about a millimetre a second.
    aged = 0.001 * max(0.0, age_s - 5.0) if math.isfinite(age_s) else 0.0
    out = []
    for said, rule, step, least in zip(std_enu_m, (h, h, v), resolution_enu_m, sigma_floor_m, strict=True):
        s = said if math.isfinite(said) and said > 0 else rule
        s = max(s, floor, least)
        u = step if math.isfinite(step) and step > 0 else 0.0
        out.append(math.sqrt(s * s + aged * aged + u * u / 12.0))
    return (out[0], out[1], out[2])


Q_RATIOS = tuple(10.0 ** (-5.0 + 0.75 * i) for i in range(14))
"""q/r on the grid [1/s3]: from a quiet reference accelerometer with a poor receiver to one that is hardly useful."""
QB_RATIOS = tuple(10.0 ** (-10.0 + 1.25 * i) for i in range(14))
"""qb/r on the grid [1/s5]: the loop's bandwidth goes with its sixth root, so coarse steps do."""
R_TINY = 1e-14
"""Least concentrated r [m2]: an axis that repeats one number exactly must not divide by zero."""


class Bank:
    """Filters over (q/r, qb/r) for P points: states (3, M, P, 3), covariances relative to r as six planes (M, P)."""

    def __init__(
        self, points: int, q_ratios: Sequence[float] = Q_RATIOS, qb_ratios: Sequence[float] = QB_RATIOS
    ) -> None:
        rho = [a for a in q_ratios for _ in qb_ratios]
        beta = [b for _ in q_ratios for b in qb_ratios]
        self.rho: F64 = np.array(rho)[:, None]
        self.beta: F64 = np.array(beta)[:, None]
        self.log_rho: F64 = np.array([math.log(v) for v in rho])
        self.log_beta: F64 = np.array([math.log(v) for v in beta])
        m = len(rho)
        self.x: F64 = np.zeros((3, m, points, 3))
        self.C: F64 = np.zeros((6, m, points))  # dd dv db vv vb bb
        self.sum_e: F64 = np.zeros((m, points, 3))  # forgetting sum of nu^2 / s
        self.sum_l: F64 = np.zeros((m, points))  # of log s
        self.product: F64 = np.ones((m, points))  # of s since the last logarithm
        self.count: F64 = np.zeros(points)  # forgetting count of fixes
        self.fresh = [True] * points  # states must be set before the next fix

    def forget(self, p: int) -> None:
        """Drop all evidence of a point (another model holds from now on)."""
        self.sum_e[:, p] = 0.0
        self.sum_l[:, p] = 0.0
        self.product[:, p] = 1.0
        self.count[p] = 0.0
        self.fresh[p] = True

    def reset(self, p: int, d: F64, v: F64, b: F64) -> None:
        """Set the states (3,) of a point and a variance far above anything it may hold."""
        self.x[0, :, p] = d
        self.x[1, :, p] = v
        self.x[2, :, p] = b
        self.C[:, :, p] = np.array([1e6, 0.0, 0.0, 1e8, 0.0, 1e9])[:, None]
        self.fresh[p] = False

    def predict(self, k: slice | list[int], dt: F64, s1: F64, s2: F64) -> None:
        """Advance points k by dt (P',) with the integrals s1, s2 (P', 3)."""
        x = self.x[:, :, k]
        t = dt[:, None]
        x[0] += x[1] * t - x[2] * (0.5 * t * t) + s2
        x[1] += s1 - x[2] * t
        half = 0.5 * dt * dt
        dd, dv, db, vv, vb, bb = self.C[:, :, k]
        q, qb = self.rho, self.beta
        bt = bb * dt
        vt = vb - bt  # F applied once to the bias column
        dt2 = db + vb * dt - bb * half
        vv1 = vv - vb * dt  # rows applied, columns not yet
        dv1 = dv + vv * dt - vb * half
        t3 = half * dt
        C = self.C[:, :, k] if isinstance(k, slice) else np.empty_like(x[..., 0], shape=(6, *dd.shape))
        n_dd = dd + dv * dt - db * half + dv1 * dt - dt2 * half + t3 * (q * (2 / 3) + qb * (half * 0.2))
        n_dv = dv1 - dt2 * dt + half * (q + qb * (half * 0.5))
        n_db = dt2 - qb * (t3 * (1 / 3))
        n_vv = vv1 - vt * dt + dt * q + qb * (t3 * (2 / 3))
        n_vb = vt - qb * half
        n_bb = bb + qb * dt
        C[0], C[1], C[2], C[3], C[4], C[5] = n_dd, n_dv, n_db, n_vv, n_vb, n_bb
        if not isinstance(k, slice):
            self.x[:, :, k] = x
            self.C[:, :, k] = C

    def update(self, k: slice | list[int], z: F64, decay: F64) -> None:
        """Take fixes z (P', 3); decay (P',) is the factor of forgetting since the fix before."""
        x = self.x[:, :, k]
        C = self.C[:, :, k]
        dd, dv, db = C[0], C[1], C[2]
        s = dd + 1.0
        nu = z - x[0]
        g = 1.0 / s
        kd, kv, kb = dd * g, dv * g, db * g
        x[0] += kd[..., None] * nu
        x[1] += kv[..., None] * nu
        x[2] += kb[..., None] * nu
        C[3] -= kv * dv
        C[4] -= kv * db
        C[5] -= kb * db
        C[1] = dv * g
        C[2] = db * g
        C[0] = kd
        self.sum_e[:, k] = self.sum_e[:, k] * decay[:, None] + nu * nu * g[..., None]
        self.sum_l[:, k] = self.sum_l[:, k] * decay
        self.product[:, k] = self.product[:, k] * s
        self.count[k] = self.count[k] * decay + 1.0
        if not isinstance(k, slice):
            self.x[:, :, k] = x
            self.C[:, :, k] = C

    def fold(self, p: int) -> None:
        """Put the logarithm of the product into its sum: at least every 30 fixes, long before it overflows."""
        self.sum_l[:, p] += [math.log(v) for v in self.product[:, p].tolist()]
        self.product[:, p] = 1.0

    def posterior(
        self, p: int, prior: list[tuple[float, float, float, float]]
    ) -> list[tuple[float, float, float, int]]:
        """Per axis: mean log(q/r), mean log(qb/r), log r, index of the best member.

        `prior` per axis: centre and inverse variance of log(q/r), the same of log(qb/r).
        """
        self.fold(p)
        n = float(self.count[p])
        if n < 4.0:
            return []
        out = []
        sum_l = self.sum_l[:, p]
        r = self.sum_e[:, p].T / n + R_TINY
        logs = _logs(r)
        for axis in range(3):
            c, w, cb, wb = prior[axis]
            u = self.log_rho - c
            ub = self.log_beta - cb
            score = -0.5 * (sum_l + n * logs[axis] + w * u * u + wb * ub * ub)
            best = int(score.argmax())
            top = float(score[best])
            total = mean = mean_b = mean_r = 0.0
            near = (score > top - 25.0).nonzero()[0]
            rows = zip(*(v.take(near).tolist() for v in (score, self.log_rho, self.log_beta, logs[axis])), strict=True)
            for v, rho, beta, log_r in rows:
                f = math.exp(v - top)
                total += f
                mean += f * rho
                mean_b += f * beta
                mean_r += f * log_r
            out.append((mean / total, mean_b / total, mean_r / total, best))
        return out

    def save(self) -> State:
        return {
            "x": self.x, "C": self.C, "sum_e": self.sum_e, "sum_l": self.sum_l, "product": self.product,
            "count": self.count, "fresh": list(self.fresh),
        }  # fmt: skip

    def load(self, s: State) -> None:
        self.x, self.C = s["x"].copy(), s["C"].copy()
        self.sum_e, self.sum_l = s["sum_e"].copy(), s["sum_l"].copy()
        self.product, self.count = s["product"].copy(), s["count"].copy()
        self.fresh = list(s["fresh"])


class Monitor:
    """Does the accelerometer help, or does it contradict the fixes?

    Beside the fused filter runs one without accelerations (a small bank: motion by itself, from standing to swinging).
    Per fix and axis both say how surprised they were, log S + nu^2 / S (clipped, so that an outlier costs both alike).
    Where the one without has been less surprised by `ON` on average over `MEMORY_S`, it predicts the fixes better by a
    factor of e in sd: the two sensors do not see the same motion. A poor but honest accelerometer costs far less.
    """

    ON, OFF = 2.0, 0.5
    MEMORY_S = 20.0
    LEAST = 15
    STEP_S = 0.9
    CLIP = 25.0

    def __init__(self, points: int) -> None:
        self.bank = Bank(points, (1e-3, 1.0), (1e-4, 1e-2, 1.0, 1e2, 1e4))
        m = len(self.bank.log_rho)
        self.score: F64 = np.zeros((m, points, 3))  # mean surprise of each member
        self.fused: F64 = np.zeros((points, 3))  # and of the fused filter
        self.count = [0] * points
        self.since = [0.0] * points
        self.alarm = [False] * points

    def forget(self, p: int) -> None:
        self.bank.forget(p)
        self.score[:, p] = 0.0
        self.fused[p] = 0.0
        self.count[p] = 0
        self.since[p] = 0.0
        self.alarm[p] = False

    def fix(
        self, points: Sequence[int], dt: Sequence[float], z: F64, R: F64, nu: F64, S: F64, limit: float
    ) -> list[int]:
        """Take a fix z (3,) of some points, with its noise R and the fused filter's residual and variance (P', 3);
        returns the points whose alarm changed."""
        due: list[int] = []
        rows: list[int] = []
        elapsed: list[float] = []
        for i, p in enumerate(points):
            since = self.since[p] + dt[i]
            if self.bank.fresh[p]:
                self.bank.reset(p, z, _ZERO, _ZERO)
                since = 0.0
            elif since >= self.STEP_S:
                due.append(p)
                rows.append(i)
                elapsed.append(since)
                since = 0.0
            self.since[p] = since
        return self._take(due, elapsed, z, R[rows], nu[rows], S[rows], limit) if due else []

    def _take(self, due: list[int], elapsed: list[float], z: F64, R: F64, nu: F64, S: F64, limit: float) -> list[int]:
        bank = self.bank
        k = block(due)
        none = np.zeros((len(due), 3))
        bank.predict(k, np.array(elapsed), none, none)
        s = (bank.C[0][:, k] + 1.0)[..., None] * R
        e = z - bank.x[0][:, k]
        e = e * e / s
        weights = []
        for p, seconds in zip(due, elapsed, strict=True):
            self.count[p] += 1
            weights.append(max(min(seconds / self.MEMORY_S, 0.5), 1.0 / self.count[p]))
        w = np.array(weights)[:, None]
        score, fused = self.score[:, k], self.fused[k]
        score = score + w * (_logs(s) + np.minimum(e, self.CLIP) - score)
        fused = fused + w * (_logs(S) + np.minimum(nu * nu / S, self.CLIP) - fused)
        self.score[:, k], self.fused[k] = score, fused
        least = e.sum(axis=2).min(axis=0).tolist()
        good = [p for p, v in zip(due, least, strict=True) if v <= limit]  # else an outlier for every member
        if good:
            j = block(good)
            bank.update(j, np.broadcast_to(z, (len(good), 3)), np.ones(len(good)))
            bank.product[:, j] = 1.0  # its own likelihood is not asked for
        changed = []
        for p, ahead in zip(due, (fused - score.min(axis=0)).max(axis=1).tolist(), strict=True):
            before = self.alarm[p]
            if self.count[p] >= self.LEAST:
                self.alarm[p] = ahead > (self.OFF if before else self.ON)
            if self.alarm[p] != before:
                changed.append(p)
        return changed

    def save(self) -> State:
        return {
            "bank": self.bank.save(), "score": self.score, "fused": self.fused, "count": list(self.count),
            "since": list(self.since), "alarm": list(self.alarm),
        }  # fmt: skip

    def load(self, s: State) -> None:
        self.bank.load(s["bank"])
        self.score, self.fused = s["score"].copy(), s["fused"].copy()
        self.count, self.since, self.alarm = list(s["count"]), list(s["since"]), list(s["alarm"])


_ZERO = np.zeros(3)


def _logs(a: F64) -> F64:
    return np.array([math.log(v) for v in a.reshape(-1).tolist()]).reshape(a.shape)


def third_difference_std(w: F64) -> list[float]:
    """sd of the white part of w (n, 3) per axis from the median absolute third difference; n >= 4."""
    e = np.abs(w[3:] - 3.0 * w[2:-1] + 3.0 * w[1:-2] - w[:-3])
    m = np.sort(e, axis=0)[len(e) // 2].tolist()
    # 1/0.6745 makes a sd of a median; the third difference of white noise has 20 times its variance.
    return [v / 0.6744897501960817 / math.sqrt(20.0) for v in m]


def robust_mask(t: F64, w: F64) -> list[bool]:
    """Which of the start window's epochs t (n,) s, w = z - J(t) (n, 3) belong together.

    A line with curvature by iterated reweighting (weights 1/|residual|, near the L1 fit), then everything beyond 5
    robust sd of the residual is left out. Where the accelerometer's bias wanders, the residual of the curve is no
    noise; then each epoch is judged against the Theil-Sen line through its nine neighbours.
    """
    n = len(t)
    u = (t - t[0]) * (2.0 / (t[-1] - t[0])) - 1.0
    basis = np.stack([np.ones(n), u, u * u - 1 / 3])
    noise = [max(s, 1e-6) for s in third_difference_std(w)]
    scaled = w / np.array(noise)
    weight = np.ones(n)
    e = scaled
    for _ in range(25):
        e = scaled - _fit(basis, scaled, weight)
        size = np.sqrt((e * e).sum(axis=1))
        weight = 1.0 / np.maximum(size, 0.5)
    spread = float(np.sort(size)[n // 2])
    if spread > 6.0:  # 1.54 = median of a chi of three degrees; far beyond it the curve does not fit
        for i in range(n):
            lo = min(max(0, i - 4), max(0, n - 9))
            e[i] = _off_line(u[lo : lo + 9] - u[i], scaled[lo : lo + 9], i - lo)
        size = np.sqrt((e * e).sum(axis=1))
        spread = float(np.sort(size)[n // 2])
    limit = 5.0 * max(spread / 1.538, 1.0)
    return [bool(v) for v in size <= limit]


def _off_line(u: F64, y: F64, i: int) -> F64:
    """Residual (3,) of row i of y (n, 3) from the Theil-Sen line over u (n,), where u[i] = 0: medians of the slopes of
    all pairs, then of what they leave."""
    n = len(u)
    slopes = np.sort(np.stack([(y[k] - y[j]) / (u[k] - u[j]) for j in range(n) for k in range(j + 1, n)]), axis=0)
    m = len(slopes)
    slope = 0.5 * (slopes[(m - 1) // 2] + slopes[m // 2])
    level = np.sort(y - u[:, None] * slope, axis=0)[n // 2]
    out: F64 = y[i] - level
    return out


def _fit(basis: F64, y: F64, weight: F64) -> F64:
    """Weighted least squares of y (n, 3) on three basis rows (3, n); the 3x3 inverse is written out."""
    wb = basis * weight
    (a, b, c), (_, d, e), (_, _, f) = [[float((wb[i] * basis[j]).sum()) for j in range(3)] for i in range(3)]
    g = [(wb[i][:, None] * y).sum(axis=0) for i in range(3)]
    A, Bc, Cc = d * f - e * e, c * e - b * f, b * e - c * d
    Dd, E, Ff = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * A + b * Bc + c * Cc
    k0 = (A * g[0] + Bc * g[1] + Cc * g[2]) * (1.0 / det)
    k1 = (Bc * g[0] + Dd * g[1] + E * g[2]) * (1.0 / det)
    k2 = (Cc * g[0] + E * g[1] + Ff * g[2]) * (1.0 / det)
    out: F64 = basis[0][:, None] * k0 + basis[1][:, None] * k1 + basis[2][:, None] * k2
    return out
