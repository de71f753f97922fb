"""Real recordings, default settings, against answers that the tests compute without any code of the filter."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from fusion_play import F64, T0, Played, S, accel_items, blocks_of, fix_items, play
from oracles import dense_smoother, first_order_hold, process_noise, transition
from scipy.optimize import minimize

from edge_agent.messages import VALID_MODES, Verdict

ZEROS = (0.0, 0.0)


def east(t_a: F64, a: F64, t_z: F64, z: F64, sigma_m: float) -> Played:
    """One axis of motion; the other two stand still. The fixes arrive 50 ms late."""
    xyz = np.zeros((len(a), 3))
    xyz[:, 0] = a
    fixes = np.zeros((len(z), 3))
    fixes[:, 0] = z
    ta = T0 + np.rint(t_a * S).astype(np.int64)
    tz = T0 + np.rint(t_z * S).astype(np.int64)
    return play(accel_items(ta, xyz, blocks_of(ta)) + fix_items(tz, fixes, S // 20, (sigma_m, sigma_m, sigma_m)))


def likelihood(theta: F64, steps: list[tuple[float, float, float]], z: F64) -> float:
    """-2 log likelihood of (log q, log r, log qb) by the innovations of a plain three-state filter."""
    q, r, qb = np.exp(np.clip(theta, -45, 2))
    x = np.array([z[0], 0.0, 0.0])
    P = np.diag([10 * r, 1e-2, 1e-2])
    total = 0.0
    for k, (dt, v, d) in enumerate(steps):
        F = transition(dt)
        x = F @ x + np.array([d, v, 0.0])
        P = F @ P @ F.T + process_noise(dt, q, qb)
        s = P[0, 0] + r
        e = z[k + 1] - x[0]
        if k > 5:
            total += np.log(s) + e * e / s
        gain = P[:, 0] / s
        x = x + gain * e
        P = P - np.outer(gain, gain) * s
    return float(total)


def test_tohoku_2011_live_follows_the_smoother(shared_data: Path) -> None:
    """GEONET 0041 at 1 Hz and K-NET FKS011 at 100 Hz, the accelerometer's labels moved by the 43.0 s that they are
    early.

    Record: Niu & Xu (2014). Truth: RTS as one dense least-squares problem, with q, r, qb by maximum likelihood.
    """
    folder = shared_data / "B1-tohoku2011-gps0041-fks011"
    gps, acc = np.loadtxt(folder / "gps.dat"), np.loadtxt(folder / "acc.dat")
    begin = acc[0, 0] + 43.0
    t_a, a = acc[:, 0] + 43.0 - begin, acc[:, 1]
    inside = (gps[:, 0] >= begin) & (gps[:, 0] - begin <= t_a[-1])
    t_z, z = gps[inside, 0] - begin, gps[inside, 1]
    mean = a[:1000].mean()
    steps = [(u - s, *first_order_hold(t_a, a - mean, s, u)) for s, u in pairwise(t_z)]
    best = min(
        (
            minimize(likelihood, np.log([q0, 1e-5, 1e-9]), (steps, z), method="Nelder-Mead", options={"maxiter": 90})
            for q0 in (1e-8, 1e-6)
        ),
        key=lambda m: float(m.fun),
    )
    q, r, qb = np.exp(best.x)
    p = east(t_a, a, t_z, z, 0.0174)
    t = (p.t - T0) / S
    last = t <= t_z[-1]
    late = last & (t > t[0] + 60)
    # The smoother at every tenth sample: enough for rms and maximum at 100 Hz.
    at = np.flatnonzero(late)[::10]
    smooth = dense_smoother(t_a, a - mean, t_z, z, np.sqrt(r), q, qb, extra_t=np.round(t[at], 9))
    rts = np.interp(t[at], smooth.t, smooth.x[:, 0])
    error = p.d[at, 0] - rts
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    final = float(p.d[last, 0][-1])
    print(
        f"Tohoku: q {q:.2g} sqrt(r) {1e3 * np.sqrt(r):.1f} mm qb {qb:.2g}; live - RTS rms {1e3 * rms:.2f} mm, "
        f"largest {1e3 * largest:.1f} mm, peak {p.d[last, 0].max():.4f} m, final {final:.4f} m; events {p.kinds()}"
    )
    assert rms < 0.006
    assert largest < 0.030
    assert abs(p.d[last, 0].max() - 2.587) < 0.025
    assert abs(final - 1.785) < 0.010
    assert p.kinds() == ["START"]


def test_tohoku_goes_on_from_gnss_alone_to_both(shared_data: Path) -> None:
    """The whole record as it stands on the wires: 43 s of fixes before the first acceleration, 43 s of accelerations
    after the last fix."""
    folder = shared_data / "B1-tohoku2011-gps0041-fks011"
    gps, acc = np.loadtxt(folder / "gps.dat"), np.loadtxt(folder / "acc.dat")
    begin = gps[0, 0]
    p = east(acc[:, 0] + 43.0 - begin, acc[:, 1], gps[:, 0] - begin, gps[:, 1], 0.0174)
    assert p.kinds() == ["START", "ACCEL_ON"]
    t = (p.t - T0) / S
    live = (t > 110) & (t <= gps[-1, 0] - begin)
    assert abs(p.d[live, 0].max() - 2.587) < 0.025


def shaker(shared: Path, noise_m: float) -> float:
    """Std of the live stream [m] against the displacement at 100 Hz after the first minute."""
    volts = np.loadtxt(shared / "B3-unison-tower-shaker" / "wn_02.dat")
    d, a = volts[:, 7] * (0.0225 / 9), volts[:, 4] * -2.0
    t = np.arange(len(d)) / 100
    z = d[::10] + noise_m * np.random.default_rng(0).standard_normal(len(d[::10]))
    p = east(t, a, t[::10], z, 0.003)
    assert p.kinds() == ["START"]
    at = (p.t - T0) / S
    error = p.d[:, 0] - d[np.rint(at * 100).astype(int)]
    late = at > 60
    std = float(np.std(error[late]))
    print(f"shaker with {1e3 * noise_m:.0f} mm: {1e3 * std:.3f} mm")
    return std


def test_shaker_between_clean_fixes(shared_data: Path) -> None:
    """Receiver sd declared 3 mm, in truth none, and a bias that wanders by 20 to 90 mm/s2: both must be found out."""
    assert shaker(shared_data, 0.0) < 0.00025


def test_shaker_with_a_millimetre_of_noise(shared_data: Path) -> None:
    assert shaker(shared_data, 0.001) < 0.0009


def test_tohoku_as_labelled_is_two_sensors_that_contradict_each_other(shared_data: Path) -> None:
    """The accelerometer's labels are 43 s early: the shaking comes before the fixes move, and again without cause."""
    folder = shared_data / "B1-tohoku2011-gps0041-fks011"
    gps, acc = np.loadtxt(folder / "gps.dat"), np.loadtxt(folder / "acc.dat")
    begin = gps[0, 0]
    t_z, z = gps[:, 0] - begin, gps[:, 1]
    p = east(acc[:, 0] - begin, acc[:, 1], t_z, z, 0.0174)
    t = (p.t - T0) / S
    alarm = [(e.t_ns - T0) / S for e in p.events if e.kind == "CONTRADICTION"]
    assert alarm
    assert 30 < alarm[0] < 75  # the accelerations grow from 17 s on, the fixes move from 60 s on
    used = [i.t_ns for i in p.innovations if i.verdict in (Verdict.ACCEPTED, Verdict.OFFSET)]
    assert np.diff(used).max() < 60 * S
    error = np.abs(p.d[:, 0] - np.interp(t, t_z, z))
    valid = np.isin(p.column("mode"), VALID_MODES)
    print(f"as labelled: alarm at {alarm[0]:.0f} s; largest error while valid {error[valid].max():.3f} m")
    assert error[valid].max() < 1.0
