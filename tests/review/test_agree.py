"""Do the sensors agree? Against the truth of simulated records, and on real ones whose clocks are known to differ."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from oracles import accel_q, first_order_hold, process_noise, transition

from edge_agent.geodesy import Frame
from edge_agent.review.agree import Agreement, agree
from edge_agent.review.integrate import Integral
from edge_agent.review.likelihood import fit, gains
from edge_agent.review.smooth import NO_ACCELERATIONS, Accelerations, Fixes, noise, plain
from edge_agent.review.witness import Witness, missed, noise_floor
from edge_agent.simulate import SCENARIOS, SimRecord, run

F64 = npt.NDArray[np.float64]
S = 1_000_000_000


def ns(t: F64) -> npt.NDArray[np.int64]:
    return np.rint(t * S).astype(np.int64)


def simulated(seconds: float, seed: int = 3, **sensor: object) -> tuple[Fixes, Accelerations, SimRecord]:
    """The clean scenario with something wrong with its accelerometer."""
    scenario = SCENARIOS["clean"]
    accel = replace(scenario.accels[0], **sensor)  # type: ignore[arg-type]
    r = run(replace(scenario, accels=(accel,)), seed, seconds)
    return plain(r.fixes.t_ns, r.fixes.z_m, r.fixes.std_m), Accelerations(r.accel.t_ns, r.accel.xyz), r


def tohoku(shared: Path) -> tuple[Fixes, Accelerations]:
    folder = shared / "B1-tohoku2011-gps0041-fks011"
    gps, acc = np.loadtxt(folder / "gps.dat"), np.loadtxt(folder / "acc.dat")
    z, xyz = np.zeros((len(gps), 3)), np.zeros((len(acc), 3))
    z[:, 0], xyz[:, 0] = gps[:, 1], acc[:, 1]
    return plain(ns(gps[:, 0]), z, 0.0174), Accelerations(ns(acc[:, 0]), xyz)


def likelihood(theta: F64, steps: list[tuple[float, float, float]], z: F64, skip: int) -> float:
    """Log likelihood of log q, log r, log qb by a plain filter in matrices."""
    q, r, qb = np.exp(theta)
    x, P = np.array([z[0], 0.0, 0.0]), np.diag([r, 1e8 * r, 1e8 * r])
    total = 0.0
    for k, (dt, v, d) in enumerate(steps, 1):
        F = transition(dt)
        x = F @ x + np.array([d, v, 0.0])
        P = F @ P @ F.T + process_noise(dt, q, qb)
        s, e = P[0, 0] + r, z[k] - x[0]
        if k >= skip:
            total -= 0.5 * (math.log(2 * math.pi * s) + e * e / s)
        gain = P[:, 0] / s
        x, P = x + gain * e, P - np.outer(gain, gain) * s
    return total


def test_the_noise_found_is_the_most_likely() -> None:
    """Half a minute: no neighbour in q, r or qb is more likely, by a filter that shares nothing; and on two minutes the
    true noise of the receiver comes out."""
    fixes, accel, _ = simulated(120)
    part = fixes.part(0, 300)
    found = fit(part, accel)
    theta = np.log([found.noise.q[0], found.r[0] * 0.003**2, found.noise.qb[0]])
    t_a, a = (accel.t_ns - part.t_ns[0]) / S, accel.xyz[:, 0] - accel.xyz[:, 0].mean()
    t_z = (part.t_ns - part.t_ns[0]) / S
    steps = [(v - u, *first_order_hold(t_a, a, u, v)) for u, v in pairwise(t_z)]
    best = likelihood(theta, steps, part.z_m[:, 0], 6)
    assert best == pytest.approx(found.log_likelihood[0], abs=0.02)
    for i in range(3):
        for step in (-0.7, 0.7):
            moved = theta.copy()
            moved[i] += step
            assert likelihood(moved, steps, part.z_m[:, 0], 6) < best + 0.05
    assert fit(fixes, accel).r == pytest.approx(np.ones(3), abs=0.25)


def test_integrals_at_any_time_are_exact() -> None:
    rng = np.random.default_rng(1)
    t_a = np.arange(400) / 40 + rng.uniform(-0.01, 0.01, 400)
    a = rng.standard_normal((400, 3))
    t_z = np.linspace(1.03, 8.9, 14)
    whole = Integral(Accelerations(ns(t_a), a), 0)
    offsets = np.array([-0.7, 0.0, 0.31])
    s1, s2 = whole.between(t_z[:, None] - offsets)
    t_a = ns(t_a) / S
    for o, offset in enumerate(offsets):
        for k in range(1, 14):
            for axis in range(3):
                v, d = first_order_hold(t_a, a[:, axis] - a[:, axis].mean(), t_z[k - 1] - offset, t_z[k] - offset)
                assert s1[k, axis, o] == pytest.approx(v, abs=1e-9)
                assert s2[k, axis, o] == pytest.approx(d, abs=1e-9)


def told(a: Agreement) -> str:
    return f"{a.verdict}: {a.text}; {a.offset.value_s:.4f} +- {a.offset.std_s:.4f} s; yaw {a.mounting.yaw_deg:.2f}"


def test_sensors_that_agree_are_not_accused() -> None:
    fixes, accel, _ = simulated(120)
    a = agree(fixes, accel)
    print(told(a))
    assert a.verdict == "AGREE"
    assert abs(a.offset.value_s) < 3 * a.offset.std_s < 0.01
    assert a.mounting.axes == ("+x", "+y", "+z")
    assert abs(a.mounting.yaw_deg) < 3 * a.mounting.std_yaw_deg < 3
    w = a.windows
    assert not w.against.any()
    assert w.favour.all()
    assert (w.support > 0).all()
    assert np.abs((w.share - 1) / w.std).max() < 4


def test_a_late_clock_is_found_as_well_as_it_can_be() -> None:
    """The bound of any estimator: var = 1 / sum(v^2/S) over axes and fixes (v the velocity, S the innovation's
    variance)."""
    fixes, accel, r = simulated(120, clock_offset_s=3.37)
    a = agree(fixes, accel)
    print(told(a))
    q = accel_q(5e-4)
    bound = 0.0
    for axis, sigma in enumerate((0.003, 0.003, 0.006)):
        P = np.diag([sigma**2, 1.0])
        F, Q = transition(0.1)[:2, :2], process_noise(0.1, q, 0.0)[:2, :2]
        for _ in range(500):
            P = F @ P @ F.T + Q
            s = P[0, 0] + sigma**2
            P = P - np.outer(P[:, 0], P[:, 0]) / s
        v = r.truth_at_fixes.v_mps[:, axis]
        bound += float((v * v / s).sum())
    bound = 1 / math.sqrt(bound)
    print(f"bound {1e3 * bound:.2f} ms")
    assert abs(a.offset.value_s + 3.37) < 2 * a.offset.std_s
    assert 0.8 * bound < a.offset.std_s < 2 * bound
    assert a.verdict == "CONTRADICTION"
    assert "3.37" in a.text
    assert "late" in a.text
    assert a.windows.refute
    assert abs(a.offset.rate_ppm) < 3 * a.offset.std_rate_ppm


def test_a_fast_clock_is_found_with_its_rate() -> None:
    fixes, accel, _ = simulated(240, clock_ppm=800.0)
    a = agree(fixes, accel)
    print(told(a), a.offset)
    assert a.offset.rate_ppm == pytest.approx(800, abs=3 * a.offset.std_rate_ppm)
    assert a.offset.std_rate_ppm < 80


def test_a_turned_and_swapped_sensor_is_found() -> None:
    fixes, accel, _ = simulated(120)
    yaw = math.radians(25.0)
    turn = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    a = agree(fixes, Accelerations(accel.t_ns, accel.xyz @ turn.T))
    print(told(a))
    assert a.verdict == "CONTRADICTION"
    assert a.mounting.yaw_deg == pytest.approx(25.0, abs=3.0)
    assert abs(a.mounting.yaw_deg - 25.0) < 3 * a.mounting.std_yaw_deg + 0.5
    assert np.abs(a.mounting.matrix @ turn - np.eye(3)).max() < 0.25
    swapped = np.stack([accel.xyz[:, 1], accel.xyz[:, 0], -accel.xyz[:, 2]], axis=1)
    a = agree(fixes, Accelerations(accel.t_ns, swapped))
    print(told(a))
    assert a.mounting.axes == ("+y", "+x", "-z")
    assert "+y +x -z" in a.text


@pytest.mark.parametrize("noise_mps2", [1e-3, 1e-2])
def test_a_resting_pair_is_not_judged(noise_mps2: float) -> None:
    rng = np.random.default_rng(5)
    fixes = plain(ns(np.arange(600) / 10), 0.003 * rng.standard_normal((600, 3)), 0.003)
    accel = Accelerations(ns(np.arange(6000) / 100), noise_mps2 * rng.standard_normal((6000, 3)))
    a = agree(fixes, accel)
    assert a.verdict == "NOT OBSERVABLE"
    assert not a.offset.observable
    assert math.isnan(a.offset.value_s)
    assert not a.mounting.observable
    assert "not observable" in a.offset.why


def test_the_earthquake_as_labelled_is_a_contradiction_of_43_s(shared_data: Path) -> None:
    fixes, accel = tohoku(shared_data)
    a = agree(fixes, accel)
    print(told(a))
    assert a.verdict == "CONTRADICTION"
    assert a.offset.value_s == pytest.approx(43.0, abs=0.1)
    assert a.offset.std_s < 0.02
    assert a.windows.support.sum() < -50
    assert a.mounting.axes[0] == "+x"
    assert not a.mounting.observable  # one axis says nothing of the yaw
    right = agree(fixes, Accelerations(accel.t_ns + 43 * S, accel.xyz))
    assert right.verdict == "AGREE"
    assert not right.windows.against.any()
    assert right.windows.support.sum() > 100


@pytest.mark.parametrize(("source", "offset_s"), [("positions", 3.24), ("velocities", 3.37)])
def test_a_turning_car_has_no_fixed_yaw_and_a_clock(shared_data: Path, source: str, offset_s: float) -> None:
    """GNSS second of day = ms/1000 + 70196.593 + offset, where 70196.593 puts both files' beginnings together.

    The receiver's own two answers differ by half an epoch (0.125 s of 0.25 s): its Doppler velocity equals the
    position's difference over the epoch before. 3.37 +- 0.10 s is the velocities' offset, the positions' is 3.24.
    """
    folder = shared_data / "B4-f9p-rtk-and-imu-walk-drive"
    rows = [line.split() for line in (folder / "gnss_1934_sf.pos").read_text().splitlines() if line[0] != "%"]
    table = np.array([[float(v) for v in row[2:]] for row in rows])
    tod = np.array([sum(float(v) * w for v, w in zip(row[1].split(":"), (3600, 60, 1), strict=True)) for row in rows])
    frame = Frame((table[0, 0], table[0, 1], table[0, 2]), 90.0)
    z = np.array([frame.enu(*row) for row in table[:, :3].tolist()])
    velocity = table[:, [14, 13, 15]]  # east, north, up
    back = np.diff(z, axis=0) / np.diff(tod)[:, None]
    assert (back - velocity[1:]).std(axis=0)[:2].max() < 0.05 < (back - velocity[:-1]).std(axis=0)[:2].min()
    if source == "velocities":
        moved = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(tod)[:, None]
        z = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
    imu = np.loadtxt(folder / "imu_1934.csv", delimiter=",")
    accel = Accelerations(ns(imu[:, 6] / 1000 + 70196.593), imu[:, :3] * 9.80665)
    a = agree(plain(ns(tod), z, (0.01, 0.01, 0.02)), accel)
    print(told(a))
    assert a.offset.value_s == pytest.approx(offset_s, abs=0.05)
    assert a.verdict == "CONTRADICTION"
    assert not a.mounting.observable
    assert "not observable" in a.mounting.why
    assert math.isnan(a.mounting.yaw_deg)
    assert a.windows.refute


@pytest.mark.parametrize("sensor", [0, 1])
def test_blows_that_samples_miss_accuse_nobody(sensor: int) -> None:
    """The bridge model is hit once a minute; 50 Hz sees little of that, and what it misses is metres after a minute."""
    r = run(SCENARIOS["P0"], 2, 130.0)
    samples = r.accels[sensor]
    a = agree(plain(r.fixes.t_ns, r.fixes.z_m, r.fixes.std_m), Accelerations(samples.t_ns, samples.xyz))
    print(told(a), a.windows.share.round(2))
    assert a.verdict != "CONTRADICTION"
    assert a.windows.favour.sum() > 2 * a.windows.against.sum()


def test_what_each_window_says_is_as_sure_as_it_claims() -> None:
    """Over many sound windows the share is 1 with the spread that its sd tells, and hardly one speaks against."""
    z, against = [], 0
    for seed in range(6):
        name = ("clean", "P1", "P3", "P4")[seed % 4]
        r = run(SCENARIOS[name], seed, 400.0 if name == "P4" else 160.0)
        good = (r.fixes.quality == 4) & (r.fixes.label == 0)
        fixes = plain(r.fixes.t_ns[good], r.fixes.z_m[good], r.fixes.std_m[good])
        accel = Accelerations(r.accel.t_ns, r.accel.xyz)
        alone = fit(fixes, NO_ACCELERATIONS, most=1000)
        w = Witness(fixes, accel, alone, fit(fixes, accel, most=1000)).windows()
        z += ((w.share - 1) / w.std)[w.loud].tolist()
        against += int(w.against.sum())
    print(f"{len(z)} windows, mean {np.mean(z):.2f}, spread {np.std(z):.2f}, {against} against")
    assert len(z) > 50
    assert against == 0
    assert abs(np.mean(z)) < 0.4
    assert 0.6 < np.std(z) < 1.3


def test_wrong_scale_and_wrong_signs_are_found() -> None:
    fixes, accel, _ = simulated(70)
    for factor in (0.5, 2.0):
        a = agree(fixes, Accelerations(accel.t_ns, factor * accel.xyz))
        print(told(a))
        assert a.verdict == "CONTRADICTION"
        assert "scale is wrong" in a.text
        assert f"{1 / factor:.2f}"[:3] in a.text
    a = agree(fixes, Accelerations(accel.t_ns, accel.xyz * np.array([-1.0, 1.0, 1.0])))
    assert a.verdict == "CONTRADICTION"
    assert a.mounting.axes[:2] == ("-x", "+y")
    a = agree(fixes, Accelerations(accel.t_ns + S // 2, accel.xyz))
    assert a.verdict == "CONTRADICTION"
    assert a.offset.value_s == pytest.approx(-0.5, abs=0.02)


def test_motion_that_only_one_of_them_sees_is_a_contradiction() -> None:
    """Fixes of something that stands still, and an accelerometer that tells of its own noise alone."""
    fixes, accel, _ = simulated(70)
    rng = np.random.default_rng(8)
    still = plain(fixes.t_ns, 0.003 * rng.standard_normal(fixes.z_m.shape), 0.003)
    a = agree(still, accel)
    print(told(a))
    assert a.verdict == "CONTRADICTION"
    assert "do not show the motion" in a.text
    assert a.windows.refute
    assert not a.offset.observable
    quiet = Accelerations(accel.t_ns, 1e-3 * rng.standard_normal(accel.xyz.shape) + np.array([0.0, 0.0, 9.8]))
    a = agree(fixes, quiet)
    print(told(a))
    assert a.verdict == "CONTRADICTION"
    assert "tell of nothing that could move them" in a.text
    a = agree(fixes, Accelerations(accel.t_ns, np.full(accel.xyz.shape, 9.8)))
    assert "tell of nothing that could move them" in a.text


def test_behind_a_blow_or_a_gap_the_velocity_is_not_known() -> None:
    """A blow of 2 m/s2 may hide 0.2 m/s: that squared over the interval between fixes, on the axes that were hit."""
    t_a, t_z = np.arange(4000) / 100, np.arange(401) / 10
    xyz = 1e-3 * np.random.default_rng(3).standard_normal((4000, 3))
    xyz[2003:2006, 0] += 2.0
    fixes = plain(ns(t_z), np.zeros((401, 3)), 0.003)
    found = missed(fixes, Accelerations(ns(t_a), xyz))
    hit = np.flatnonzero(found[:, 0] > 0.01)
    assert hit.tolist() == [201]
    assert found[201, 0] == pytest.approx(0.2**2 / 0.1, rel=0.05)
    assert found[201, 1] < 1e-3
    kept = (t_a < 10.0) | (t_a > 12.0)
    found = missed(fixes, Accelerations(ns(t_a[kept]), xyz[kept]))
    assert (found[102:119] > 0).all()
    assert (found[30:90] == 0).all()


def test_the_noise_of_a_sensor_is_told_below_its_motion() -> None:
    _, accel, _ = simulated(120)
    floor = noise_floor(accel)
    assert floor == pytest.approx(np.full(3, accel_q(5e-4)), rel=0.35)


def test_too_little_is_refused() -> None:
    fixes, accel, _ = simulated(20)
    with pytest.raises(ValueError, match="50 fixes"):
        agree(fixes.part(0, 40), accel)
    with pytest.raises(ValueError, match="50 fixes"):
        agree(fixes, NO_ACCELERATIONS)
    with pytest.raises(ValueError, match="20 fixes"):
        fit(fixes.part(0, 10), accel)
    assert noise(1.0, 2.0).q.tolist() == [1.0] * 3


def test_gaps_of_minutes_leave_the_likelihood_finite() -> None:
    """Trials of hardly any noise have no digits left behind a gap of minutes; they must lose, not spoil the rest."""
    rng = np.random.default_rng(4)
    dt = np.concatenate([[0.0, 1.0, 200.0], np.ones(13), [200.0] * 3, np.ones(30)])
    t = np.cumsum(dt)
    q = np.tile(10.0 ** np.linspace(-22, 3, 60), (len(dt), 1))
    for qb in (1e-26, 1e-12, 1e-4):
        g = gains(dt, np.full_like(q, 0.003), q, np.full_like(q, qb))
        assert np.isfinite(g.weight).all()
        assert (g.variance >= 0.003**2).all()
        assert np.abs(g.gain[:, 0]).max() <= 1.0
    z = 0.003 * rng.standard_normal((len(t), 3))
    found = fit(plain(ns(t), z, 0.003), NO_ACCELERATIONS)
    assert np.isfinite(found.log_likelihood).all()
    assert found.r == pytest.approx(np.ones(3), abs=0.6)
