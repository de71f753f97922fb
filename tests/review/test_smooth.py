"""The smoother against one dense least-squares problem, against itself in other cuts, and against what is possible."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from oracles import accel_q, dense_smoother, smoothed_bound

from edge_agent.review.likelihood import fit
from edge_agent.review.smooth import (
    NO_ACCELERATIONS,
    Accelerations,
    Fixes,
    Smooth,
    Smoother,
    increments,
    noise,
    plain,
    smooth,
    two_filter,
)
from edge_agent.simulate import SCENARIOS, run

F64 = npt.NDArray[np.float64]
S = 1_000_000_000
T0 = 7_000_000 * S
Q, QB, SIGMA = 1e-6, 1e-5, 0.003
PRIOR = np.diag([1e4, 1.0, 1.0])


def ns(t: F64) -> npt.NDArray[np.int64]:
    return T0 + np.rint(t * S).astype(np.int64)


def record(seconds: int = 30, rate: int = 100, seed: int = 0) -> tuple[F64, F64, F64, F64]:
    """Fixes at odd times near 1 Hz, noise for accelerations: t_a, a (m, 3), t_z, z (n, 3)."""
    rng = np.random.default_rng(seed)
    t_a = np.arange(seconds * rate) / rate
    a = 0.3 * rng.standard_normal((len(t_a), 3)) + np.array([0.1, -0.2, 9.8])
    t_z = np.round(np.arange(1, seconds - 1) + rng.uniform(-0.2, 0.2, seconds - 2), 6)
    return t_a, a, t_z, 0.01 * rng.standard_normal((len(t_z), 3))


def dense(t_a: F64, a: F64, t_z: F64, z: F64, extra: F64, q: float = Q, qb: float = QB) -> tuple[F64, F64]:
    """Oracle of one axis at `extra` (s): x (n, 3), sd (n, 3)."""
    o = dense_smoother(
        t_a, a - a.mean(), t_z, z, SIGMA, q, qb, extra_t=extra, prior=(np.zeros(3), PRIOR), covariance=True
    )
    rows = np.searchsorted(o.t, extra)
    return o.x[rows], np.sqrt(np.diagonal(o.cov, axis1=1, axis2=2)[rows])


def test_it_is_the_least_squares_answer_at_every_sample() -> None:
    t_a, a, t_z, z = record()
    s = smooth(plain(ns(t_z), z, SIGMA), Accelerations(ns(t_a), a), noise(Q, QB))
    assert len(s.t_ns) > 2700
    some = np.arange(0, len(s.t_ns), 37)
    at = np.round((s.t_ns[some] - T0) / S, 9)
    for axis in range(3):
        x, sd = dense(t_a, a[:, axis], t_z, z[:, axis], at)
        assert np.abs(s.displacement_m[some, axis] - x[:, 0]).max() < 2e-8
        assert np.abs(s.velocity_mps[some, axis] - x[:, 1]).max() < 1e-7
        assert np.abs(s.std_displacement_m[some, axis] / sd[:, 0] - 1).max() < 2e-5
        assert np.abs(s.std_velocity_mps[some, axis] / sd[:, 1] - 1).max() < 5e-5


def test_an_outage_and_a_missing_axis_are_the_least_squares_answer_too() -> None:
    t_a, a, t_z, z = record(60)
    keep = (t_z < 20) | (t_z > 40)
    t_z, z = t_z[keep], z[keep]
    z[5, 1] = np.nan
    s = smooth(plain(ns(t_z), z, SIGMA), Accelerations(ns(t_a), a), noise(Q, QB))
    some = np.arange(0, len(s.t_ns), 61)
    at = np.round((s.t_ns[some] - T0) / S, 9)
    for axis in (0, 1):
        known = np.isfinite(z[:, axis])
        x, sd = dense(t_a, a[:, axis], t_z[known], z[known, axis], at)
        assert np.abs(s.displacement_m[some, axis] - x[:, 0]).max() < 1e-6
        assert np.abs(s.std_displacement_m[some, axis] / sd[:, 0] - 1).max() < 2e-4
    sd = s.std_displacement_m[some, 0]
    assert sd[np.argmin(np.abs(at - 30))] > 5 * sd[np.argmin(np.abs(at - 10))]


def test_the_two_filter_smoother_is_the_same() -> None:
    t_a, a, t_z, z = record(200, 50)
    fixes, accel = plain(ns(t_z), z, SIGMA), Accelerations(ns(t_a), a)
    s = smooth(fixes, accel, noise(Q, QB))
    x, P = two_filter(fixes, accel, noise(Q, QB))
    assert np.abs(x[:, 0] - s.x[:, 0]).max() < 1e-9  # a millionth of a millimetre
    assert np.abs(x[:, 1:] - s.x[:, 1:3]).max() < 1e-8
    sd, sd2 = (np.sqrt(np.diagonal(m[:, :3, :3], axis1=1, axis2=2)) for m in (s.P, P))
    assert np.abs(sd / sd2 - 1).max() < 1e-6


@pytest.mark.parametrize("chapter", [40, 5])
def test_chapters_join_without_a_trace(chapter: int) -> None:
    t_a, a, t_z, z = record(402, 20)
    a = a.mean(axis=0) + (a - a.mean(axis=0)) * (np.sqrt(Q * 20) / 0.3)  # as noisy as the model says
    z *= SIGMA / 0.01
    fixes, accel = plain(ns(t_z), z, SIGMA), Accelerations(ns(t_a), a)
    whole = smooth(fixes, accel, noise(Q, QB))
    parts = in_chapters(fixes, accel, chapter)
    assert (np.concatenate([p.t_ns for p in parts]) == whole.t_ns).all()
    claimed = max(p.open_end for p in parts)
    for name in ("displacement_m", "velocity_mps", "std_displacement_m", "std_velocity_mps"):
        got, want = np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name)
        if chapter > 5:
            assert np.abs(got - want).max() < (1e-9 if name[0] != "s" else 1e-5 * want.max())
        elif name == "displacement_m":  # so short that the end is felt, and it says so
            share = float((np.abs(got - want) / whole.std_displacement_m).max())
            assert 1e-4 < share < 3 * claimed
    assert (claimed < 1e-6) == (chapter > 5)
    assert parts[-1].open_end == 0.0


def in_chapters(fixes: Fixes, accel: Accelerations, n: int) -> list[Smooth]:
    smoother = Smoother(noise(Q, QB))
    parts: list[Smooth] = []
    for k in range(0, len(fixes), n):
        parts += smoother.add(fixes.part(k, k + n), accel)
        if k == 0:  # the reference of the first chapter stays, whatever comes later
            smoother._reference = accel.xyz.mean(axis=0)
    return [*parts, *smoother.finish()]


def test_a_level_offset_is_estimated_away_and_a_datum_step_is_kept() -> None:
    t_a, a, t_z, z = record(60)
    level, step = np.zeros(len(t_z), np.int64), np.zeros(len(t_z), np.bool_)
    level[20:30] = 1
    step[40] = True
    moved = z.copy()
    moved[20:30] += np.array([0.05, -0.2, 0.1])
    moved[40:] += np.array([0.3, 0.0, -0.1])
    std = np.full_like(z, SIGMA)
    accel = Accelerations(ns(t_a), a)
    plain_z = smooth(Fixes(ns(t_z), z, std, level, step), accel, noise(Q, QB))
    s = smooth(Fixes(ns(t_z), moved, std, level, step), accel, noise(Q, QB))
    after = s.t_ns >= ns(t_z)[40]
    want = plain_z.displacement_m + after[:, None] * np.array([0.3, 0.0, -0.1])
    assert np.abs(s.displacement_m - want).max() < 1e-5  # the prior of 1 m pulls by R / 1 m2
    ignored = smooth(plain(ns(t_z), moved, SIGMA), accel, noise(Q, QB))
    assert np.abs(ignored.displacement_m - want).max() > 0.05
    assert (s.std_displacement_m >= plain_z.std_displacement_m * (1 - 1e-6)).all()
    skipped = z.copy()  # an offset that is unknown is worth more than no fix, and less than a good one
    skipped[20:30] = np.nan
    middle = np.searchsorted(s.t_ns, ns(t_z)[25])
    without = smooth(Fixes(ns(t_z), skipped, std, level * 0, step), accel, noise(Q, QB))
    assert (s.std_displacement_m[middle] < without.std_displacement_m[middle]).all()


def test_a_gap_of_the_accelerometer_is_held_at_the_mean_and_widens_the_sd() -> None:
    t_a, a, t_z, z = record(60)
    there = (t_a < 25.3) | (t_a > 33.1)
    fixes = plain(ns(t_z), z, SIGMA)
    full = smooth(fixes, Accelerations(ns(t_a), a), noise(Q, QB))
    s = smooth(fixes, Accelerations(ns(t_a[there]), a[there]), noise(Q, QB))
    inside = (s.t_ns > ns(np.array([25.4]))) & (s.t_ns < ns(np.array([33.0])))
    assert set(s.t_ns[inside].tolist()) == set(ns(t_z[(t_z > 25.4) & (t_z < 33.0)]).tolist())
    far = s.t_ns < ns(np.array([15.0]))
    assert np.abs(s.displacement_m[far] - full.displacement_m[: far.sum()]).max() < 1e-4
    assert s.std_displacement_m[inside].min() > 1.1 * s.std_displacement_m[far][1000:].min()
    assert np.abs(s.displacement_m[inside] - z[(t_z > 25.4) & (t_z < 33.0)]).max() < 0.05
    inc = increments(fixes.t_ns, Accelerations(ns(t_a[there]), a[there]), a.mean(axis=0))
    assert (inc.extra[:, np.flatnonzero((t_z[1:] < 25) | (t_z[:-1] > 34))] == 0).all()
    assert (inc.extra[:, np.flatnonzero((t_z[:-1] > 26) & (t_z[1:] < 33))] > 1e-5).all()


def test_a_blow_that_the_samples_miss_widens_the_sd_and_is_not_believed() -> None:
    """An impact between two samples: the accelerations show a third of it, the fixes show all."""
    t_a, a, t_z, z = record(60)
    a = a.mean(axis=0) + 1e-3 * (a - a.mean(axis=0))
    truth = np.where(t_z > 30.004, 0.05 * (t_z - 30.004), 0.0)[:, None] * np.ones(3)  # 50 mm/s that stay
    hit = a.copy()
    hit[3000:3002] += 50.0 / 60  # 1/60 of a second of it instead of all
    z = truth + 0.3 * z
    s = smooth(plain(ns(t_z), z, SIGMA), Accelerations(ns(t_a), hit), noise(1e-8, 1e-12))
    at = np.searchsorted(s.t_ns, ns(t_z)[:-1])
    near = np.abs(t_z[:-1] - 30) < 3
    assert np.abs(s.displacement_m[at] - truth[:-1])[~near].max() < 0.01
    calm = smooth(plain(ns(t_z), z, SIGMA), Accelerations(ns(t_a), a), noise(1e-8, 1e-12))
    assert s.std_displacement_m[at][near].max() > 1.2 * calm.std_displacement_m[at][near].max()
    assert np.abs(calm.displacement_m[at] - truth[:-1]).max() > 0.02  # without the blow's doubt it is smeared


def test_fixes_alone_are_smoothed_at_their_own_times() -> None:
    _, _, t_z, z = record(60)
    s = smooth(plain(ns(t_z), z, SIGMA), NO_ACCELERATIONS, noise(1e-6, 1e-4))
    assert (s.t_ns == ns(t_z)).all()
    o = dense_smoother(np.array([0.0, 60.0]), np.zeros(2), t_z, z[:, 0], SIGMA, 1e-6, 1e-4, prior=(np.zeros(3), PRIOR))
    assert np.abs(s.displacement_m[:, 0] - o.x[:, 0]).max() < 1e-7


@pytest.mark.parametrize("seed", [1, 2])
def test_clean_records_reach_the_smoothed_bound(seed: int) -> None:
    """RMSE over the smoothed bound with the true q, r. 15 minutes hold some 200 independent errors: 5 % of chance."""
    scenario = SCENARIOS["clean"]
    assert scenario.gnss is not None
    q = accel_q(scenario.accels[0].noise)
    r = run(scenario, seed)
    s = smooth(
        plain(r.fixes.t_ns, r.fixes.z_m, r.fixes.std_m), Accelerations(r.accel.t_ns, r.accel.xyz), noise(q, 1e-14)
    )
    row = np.searchsorted(r.accel.t_ns, s.t_ns)
    late = (s.t_ns > r.fixes.t_ns[0] + 60 * S) & (s.t_ns < s.t_ns[-1] - 10 * S)
    error = (s.displacement_m - r.truth.d_m[row])[late]
    bound = np.array([smoothed_bound(scenario.gnss.rate_hz, v, q) for v in scenario.gnss.sigma_m])
    ratio = np.sqrt((error**2).mean(axis=0)) / bound
    print("clean, RTS over smoothed bound:", ratio.round(3))
    assert ratio.mean() < 1.05
    assert ratio.max() < 1.2
    nees = (error / s.std_displacement_m[late]) ** 2
    assert 0.85 < nees.mean() < 1.15


def test_a_shaker_from_one_fix_a_second(shared_data: Path) -> None:
    """UNISON tower, wn_02: displacement at 1 Hz with sd 0.1 mm, accelerations at 100 Hz whose bias wanders by 20 to 90
    mm/s2, against the displacement at 100 Hz."""
    volts = np.loadtxt(shared_data / "B3-unison-tower-shaker" / "wn_02.dat")
    d, a = volts[:, 7] * (0.0225 / 9), volts[:, 4] * -2.0
    t = ns(np.arange(len(d)) / 100)
    z = np.zeros((len(d[::100]), 3))
    z[:, 0] = d[::100]
    xyz = np.zeros((len(a), 3))
    xyz[:, 0] = a
    s = smooth(plain(t[::100], z, 1e-4), Accelerations(t, xyz), noise(1e-9, 1e-5))
    error = s.displacement_m[:, 0] - d[np.searchsorted(t, s.t_ns)]
    print(f"shaker from 1 Hz: {1e3 * error.std():.4f} mm")
    assert error.std() <= 0.10e-3


def test_the_tohoku_earthquake_smoothed_with_its_own_noise(shared_data: Path) -> None:
    """GEONET 0041 and K-NET FKS011 (Niu & Xu 2014), labels put right by 43.0 s: peak 2.587 m, final 1.785 m."""
    folder = shared_data / "B1-tohoku2011-gps0041-fks011"
    gps, acc = np.loadtxt(folder / "gps.dat"), np.loadtxt(folder / "acc.dat")
    both = (gps[:, 0] >= acc[0, 0] + 43.0) & (gps[:, 0] <= acc[-1, 0] + 43.0)
    z, xyz = np.zeros((both.sum(), 3)), np.zeros((len(acc), 3))
    z[:, 0], xyz[:, 0] = gps[both, 1], acc[:, 1]
    fixes = plain(ns(gps[both, 0]), z, 0.0174)
    accel = Accelerations(ns(acc[:, 0] + 43.0), xyz)
    found = fit(fixes, accel)
    sigma = 0.0174 * np.sqrt(found.r[0])
    assert sigma == pytest.approx(0.00268, rel=0.05)  # not the 17 mm that the receiver claims
    s = smooth(plain(fixes.t_ns, z, sigma), accel, found.noise)
    d = s.displacement_m[:, 0]
    final = d[s.t_ns > s.t_ns[-1] - 20 * S].mean()
    print(f"Tohoku: peak {d.max():.4f} m, final {final:.4f} m, sigma {1e3 * sigma:.2f} mm")
    assert d.max() == pytest.approx(2.587, abs=0.001)
    assert final == pytest.approx(1.785, abs=0.005)


def test_what_cannot_be_smoothed_is_refused() -> None:
    t_a, a, t_z, z = record()
    accel = Accelerations(ns(t_a), a)
    with pytest.raises(ValueError, match="two fixes"):
        smooth(plain(ns(t_z[:1]), z[:1], SIGMA), accel, noise(Q, QB))
    fixes = plain(ns(t_z), z, SIGMA)
    with pytest.raises(ValueError, match="rise"):
        smooth(replace(fixes, t_ns=fixes.t_ns[::-1].copy()), accel, noise(Q, QB))
