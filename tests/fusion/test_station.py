"""Policy of the station: GIVEN sensors and faults WHEN they are handed over THEN modes, verdicts, events, bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fusion_play import (
    STD,
    T0,
    Played,
    S,
    accel_items,
    blocks_of,
    bridge,
    fix_items,
    hand,
    play,
    same,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from oracles import dense_smoother

from edge_agent.fusion import station
from edge_agent.fusion.station import Station
from edge_agent.messages import FusionFlag, FusionSettings, Measurement, Mode, PointSettings, Quality, Verdict
from edge_agent.state import pack, unpack

FROZEN = FusionSettings(r_step=0.0, bank_full_s=0.0, bank_step_s=1e9, gate_alpha=2e-12)
"""Noise figures stay as the start window left them."""


def test_start_waits_for_its_window_and_says_so() -> None:
    t, a, _, tf, z, _ = bridge(20.0)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z))
    assert p.kinds() == ["START"]
    assert p.events[0].t_ns - T0 == pytest.approx(15 * S, abs=S // 5)
    assert p.estimates[0].t_ns[0] >= p.events[0].t_ns
    early = [i for i in p.innovations if i.t_ns <= p.events[0].t_ns]
    assert len(early) >= 150
    assert all(i.verdict == Verdict.START for i in early)
    assert set(p.column("mode")) == {Mode.FUSED}
    assert all(i.verdict == Verdict.ACCEPTED for i in p.innovations if i.t_ns > p.events[0].t_ns)


def test_a_full_start_window_is_enough_however_long_it_should_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(station, "START_FIXES", 100)
    t, a, _, tf, z, _ = bridge(20.0)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z), FusionSettings(start_s=3600))
    assert p.kinds() == ["START"]
    assert p.events[0].t_ns - T0 == pytest.approx(10 * S, abs=S // 2)


def test_displacement_and_bias_follow_the_truth() -> None:
    t, a, truth, tf, z, _ = bridge(60.0)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z))
    d = truth[np.searchsorted(t, p.t)]
    late = p.t > T0 + 30 * S
    rms = np.sqrt(np.mean((p.d - d)[late] ** 2, axis=0))
    assert (rms < np.array([0.0013, 0.0013, 0.0024])).all()
    last = p.estimates[-1]
    assert np.abs(last.bias_mps2 - np.array([0.03, -0.02, 9.82])).max() < 2e-3
    assert ((p.d - d)[late] ** 2 / p.sd[late] ** 2).mean() < 2.5


def test_start_window_leaves_outliers_out() -> None:
    t, a, truth, tf, z, _ = bridge(25.0)
    z = z.copy()
    z[5:150:17] += [0.4, -0.2, 0.3]
    z[60:68] += [0.0, 0.05, 0.0]
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z))
    d = truth[np.searchsorted(t, p.t)]
    assert np.abs(p.d - d).max() < 0.012


@settings(max_examples=12, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(data=st.data())
def test_any_cut_of_the_accelerations_gives_the_same_bytes(data: st.DataObject) -> None:
    t, a, _, tf, z, _ = bridge(19.0, rate=50, offset_ns=3_000_001)
    keep = np.ones(len(t), bool)
    keep[880:892] = False  # a gap of 0.24 s
    t, a = t[keep], a[keep]
    fixes = fix_items(tf, z, -20_000_000)  # always waiting for accelerations
    whole = play(accel_items(t, a, [300]) + fixes)
    cuts = data.draw(st.lists(st.integers(1, len(t) - 1), unique=True, max_size=60).map(sorted))
    assert len(t) > 300
    # Cut, but handed over where the large block was: the order against the fixes is the same.
    parts = accel_items(t, a, sorted({*cuts, 300}))
    border = int(t[299])
    moved = [((border if i[0] <= border else int(t[-1])), i[1], i[2]) for i in parts]
    assert same(whole, play(moved + fixes))


def test_cut_per_sample_gives_the_same_bytes_as_blocks() -> None:
    t, a, _, tf, z, _ = bridge(40.0, rate=50, offset_ns=7_000_003)
    # Fixes in time order before the samples that follow them, in both.
    a1 = play(fix_items(tf, z, 0) + accel_items(t, a, list(range(1, len(t)))))
    coarse = [int(i) for i in np.searchsorted(t, tf, side="right")]
    a2 = play(fix_items(tf, z, 0) + accel_items(t, a, sorted(set(coarse))))
    names = ("t_ns", "displacement_m", "std_displacement_m")
    assert all(a1.column(n).tobytes() == a2.column(n).tobytes() for n in names)


@pytest.mark.parametrize("latency_ms", [37, 200, 900])
def test_a_late_fix_is_the_same_fix_once_caught_up(latency_ms: int) -> None:
    t, a, _, tf, z, _ = bridge(50.0, offset_ns=4_000_001)
    tf, z = tf[5:], z[5:]  # accelerations are there before the first fix, however early it arrives
    accel = accel_items(t, a, blocks_of(t))
    on_time = play(accel + fix_items(tf, z, 20_000_000))
    late = np.full(len(tf), 20_000_000)
    late[:-30:3] = latency_ms * 1_000_000
    late = np.maximum.accumulate(tf + late) - tf  # one wire delivers in order
    caught = play(accel + fix_items(tf, z, late))
    for x, y in ((on_time.station.x, caught.station.x), (on_time.station.C, caught.station.C)):
        assert np.abs(x - y).max() <= 1e-12 * max(1.0, np.abs(x).max())
    assert np.abs(on_time.d[-5:] - caught.d[-5:]).max() < 1e-12
    assert len(on_time.innovations) == len(caught.innovations)


@settings(max_examples=15, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(seed=st.integers(0, 10_000))
def test_fixes_at_any_time_between_samples_against_dense_least_squares(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t, a, _, tf, z, _ = bridge(24.0, seed=seed)
    tf = tf + rng.integers(0, 99_000_000, len(tf))
    keep = rng.uniform(size=len(tf)) > 0.3
    keep[:160] = True
    tf, z = tf[keep], z[keep]
    order = np.argsort(tf, kind="stable")
    tf, z = tf[order], z[order]
    items = sorted(
        accel_items(t, a, blocks_of(t)) + fix_items(tf, z, 150_000_000),
        key=lambda i: i[0],
    )
    p = Played(Station([PointSettings("p", "r", "a")], FROZEN))
    begin = None
    for item in items:
        hand(p, item)
        if begin is None and p.events:
            p.station.bend_rate[:] = 1.0  # nothing is a blow
            begin = (p.station.points[0].anchor_ns, p.station.x[:3, 0].copy(), p.station.C[:3, :3, 0].copy())
    assert begin is not None
    s = p.station
    used = (tf > begin[0]) & (tf <= s.points[0].anchor_ns)
    assert used.sum() > 20
    zero = int(begin[0])
    for axis in range(3):
        smooth = dense_smoother(
            (t - zero) / S,
            a[:, axis] - s.ring.reference[0, axis],
            (tf[used] - zero) / S,
            z[used, axis],
            STD[axis] * float(np.sqrt(s.scale[0, axis])),
            float(s.q[0, axis]),
            float(s.qb[0, axis]),
            extra_t=np.zeros(1),
            prior=(begin[1][:, axis], begin[2][:, :, axis]),
            covariance=True,
        )
        scale = np.sqrt(np.diag(smooth.cov[-1]))
        assert np.abs((s.x[:3, 0, axis] - smooth.x[-1]) / scale).max() < 1e-5
        # The dense problem's normal equations lose digits where qb is tiny; 1e-4 is far below any error that matters.
        dense = smooth.cov[-1] / np.outer(scale, scale)
        assert np.abs(s.C[:3, :3, 0, axis] / np.outer(scale, scale) - dense).max() < 1e-4


def test_load_at_any_place_goes_on_byte_for_byte() -> None:
    t, a, _, tf, z, _ = bridge(45.0, rate=50, offset_ns=6_000_001)
    z = z.copy()
    z[300:340] += [0.08, 0.0, -0.05]  # a jump that opens and closes
    keep = (t < T0 + 22 * S) | (t > T0 + 22.4 * S)
    out = (tf < T0 + 37 * S) | (tf > T0 + 39 * S)
    items = sorted(
        accel_items(t[keep], a[keep], blocks_of(t[keep])) + fix_items(tf[out], z[out], 120_000_000),
        key=lambda i: i[0],
    )
    whole = play(items)
    assert "JUMP_OPEN" in whole.kinds()
    assert "ACCEL_GAP" in whole.kinds()
    for cut in (50, 170, 230, 331, 420, 601, 650, 800):
        first = Played(Station([PointSettings("p", "r", "a")], FusionSettings()))
        for item in items[:cut]:
            hand(first, item)
        saved = pack(first.station.save())
        second = Played(Station([PointSettings("p", "r", "a")], FusionSettings()), first.estimates, first.innovations)
        second.events = first.events
        second.station.load(unpack(saved))
        assert pack(second.station.save()) == saved
        for item in items[cut:]:
            hand(second, item)
        assert same(whole, second)
        assert pack(second.station.save()) == pack(whole.station.save())


def test_points_stacked_are_points_alone() -> None:
    """Two receivers, three points, accelerometers of different rates: as if each had a station of its own."""
    t1, a1, _, tf, z, _ = bridge(24.0, rate=100)
    t2, a2, _, _, _, _ = bridge(24.0, rate=80, seed=3)
    t2 = t2 + 1_234_567
    points = [PointSettings("p1", "r", "a"), PointSettings("p2", "r", "b"), PointSettings("p3", "r", None)]
    accel = accel_items(t1, a1, blocks_of(t1)) + accel_items(t2, a2, blocks_of(t2), name="b")
    both = play(accel + fix_items(tf, z, 30_000_000), points=points)
    for point in points:
        alone = play(accel + fix_items(tf, z, 30_000_000), points=[point])
        for name in ("t_ns", "displacement_m", "std_displacement_m", "velocity_mps", "mode"):
            assert both.column(name, point.name).tobytes() == alone.column(name, point.name).tobytes()


def test_blocks_of_two_accelerometers_in_one_call_equal_separate_calls() -> None:
    t1, a1, _, tf, z, _ = bridge(20.0, rate=100)
    t2, a2, _, _, _, _ = bridge(20.0, rate=50, seed=3)
    points = [PointSettings("p1", "r", "a"), PointSettings("p2", "r", "b")]
    runs = []
    for together in (True, False):
        p = Played(Station(points, FusionSettings()))
        for k in range(200):
            now = T0 + (k + 1) * (S // 10)
            blocks = {}
            for name, t, a in (("a", t1, a1), ("b", t2, a2)):
                w = (t > now - S // 10) & (t <= now)
                blocks |= {name: accel_items(t[w], a[w], [], name=name)[0][2]}
            if together:
                p.take(p.station.accelerations(blocks, now))
            else:
                for name, block in blocks.items():
                    p.take(p.station.accelerations({name: block}, now))
            hand(p, (now, "r", Measurement(int(tf[k]), now, tuple(z[k].tolist()), STD, Quality.FIXED)))
        runs.append(p)
    for name in ("p1", "p2"):
        for column in ("t_ns", "displacement_m", "std_displacement_m"):
            assert runs[0].column(column, name).tobytes() == runs[1].column(column, name).tobytes()


def test_outage_coasts_with_growing_sd_then_is_invalid_then_resumes() -> None:
    t, a, truth, tf, z, _ = bridge(110.0)
    gone = (tf > T0 + 40 * S) & (tf < T0 + 85 * S)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf[~gone], z[~gone]))
    mode = p.column("mode")
    flags = p.column("flags")
    at = (p.t - T0) / S
    assert set(mode[at < 42.5]) == {Mode.FUSED}
    assert set(mode[(at > 44) & (at < 45)]) == {Mode.COAST}
    assert set(mode[(at > 71) & (at < 85)]) == {Mode.INVALID}
    assert set(mode[at > 88]) == {Mode.FUSED}
    silent = (at > 40.2) & (at < 84.9)
    assert (np.diff(p.sd[silent], axis=0) > 0).all()
    degraded = (flags & FusionFlag.DEGRADED) != 0
    coast = mode == Mode.COAST
    assert (degraded[coast] == (p.sd[coast] > 0.005).any(axis=1)).all()
    assert degraded.any()
    assert "OUTAGE_END" in p.kinds()
    d = truth[np.searchsorted(t, p.t)]
    assert np.abs((p.d - d)[at > 90]).max() < 0.01
    # three epochs had to agree
    first = [i.verdict for i in p.innovations if i.t_ns >= T0 + 85 * S][:3]
    assert first == [Verdict.REJECTED, Verdict.REJECTED, Verdict.ACCEPTED]


def test_wrong_fixes_open_a_level_and_its_end_closes_it() -> None:
    t, a, truth, tf, z, _ = bridge(80.0)
    z = z.copy()
    z[400:600] += [0.05, -0.03, 0.08]
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z, 200_000_000))
    assert p.kinds() == ["START", "JUMP_OPEN", "JUMP_CLOSED"]
    d = truth[np.searchsorted(t, p.t)]
    assert np.abs(p.d - d).max() < 0.015
    inside = [i for i in p.innovations if T0 + 42 * S < i.t_ns < T0 + 59 * S]
    assert all(i.verdict == Verdict.OFFSET for i in inside)
    assert np.abs(inside[-1].offset_m - np.array([0.05, -0.03, 0.08])).max() < 0.01
    open_ = (p.column("flags") & FusionFlag.JUMP_OPEN) != 0
    at = (p.t - T0) / S
    assert open_[(at > 42) & (at < 59)].all()
    assert not open_[at > 62].any()


def test_a_level_that_holds_becomes_the_datum_after_its_time() -> None:
    t, a, truth, tf, z, _ = bridge(75.0)
    z = z.copy()
    z[300:] += [0.05, 0.0, 0.0]
    quick = replace(FusionSettings(), reacquire_s=20.0)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z), quick)
    assert p.kinds() == ["START", "JUMP_OPEN", "DATUM"]
    datum = p.events[[e.kind for e in p.events].index("DATUM")]
    assert datum.t_ns - T0 == pytest.approx(50.5 * S, abs=S)
    d = truth[np.searchsorted(t, p.t)] + [0.05, 0, 0]
    assert np.abs((p.d - d)[p.t > datum.t_ns]).max() < 0.01


def test_a_real_step_that_the_accelerometer_sees_is_no_jump() -> None:
    t, a, truth, tf, z, _ = bridge(60.0)
    # 5 cm in 1 s by a half sine of velocity
    s = np.clip((t - T0) / S - 40, 0, 1)
    step = 0.05 * (s - np.sin(2 * np.pi * s) / (2 * np.pi))
    acc = np.where((s > 0) & (s < 1), 0.05 * 2 * np.pi * np.sin(2 * np.pi * s), 0)
    sf = np.clip((tf - T0) / S - 40, 0, 1)
    p = play(
        accel_items(t, a + acc[:, None] * [1, 0, 0], blocks_of(t))
        + fix_items(tf, z + 0.05 * (sf - np.sin(2 * np.pi * sf) / (2 * np.pi))[:, None] * [1, 0, 0])
    )
    assert p.kinds() == ["START"]
    i = np.searchsorted(t, p.t)
    assert np.abs(p.d[:, 0] - truth[i, 0] - step[i]).max() < 0.005


def test_float_is_carried_beside_and_three_fixed_epochs_end_it() -> None:
    t, a, truth, tf, z, _ = bridge(70.0)
    z = z.copy()
    quality = np.full(len(tf), 4)
    quality[350:500] = 5
    drift = 0.2 * (1 - np.exp(-np.arange(150) / 100.0))
    z[350:500] += drift[:, None] * [1, -1, 0.5]
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z, quality=quality.tolist()))
    assert p.kinds() == ["START", "FLOAT_BEGIN", "FLOAT_END"]
    d = truth[np.searchsorted(t, p.t)]
    at = (p.t - T0) / S
    # never off by more than it says
    assert (np.abs(p.d - d) < 5 * p.sd).all()
    assert np.abs((p.d - d)[at > 51]).max() < 0.01
    floating = (p.column("flags") & FusionFlag.FLOAT) != 0
    assert floating[(at > 36) & (at < 49)].all()
    assert not floating[at > 51].any()


def test_accelerometer_gap_is_bridged_and_flagged() -> None:
    t, a, truth, tf, z, _ = bridge(60.0)
    keep = (t < T0 + 40 * S) | (t > T0 + int(40.6 * S))
    p = play(accel_items(t[keep], a[keep], blocks_of(t[keep])) + fix_items(tf, z))
    gaps = [e for e in p.events if e.kind == "ACCEL_GAP"]
    assert len(gaps) == 1
    assert gaps[0].end_ns - gaps[0].begin_ns == pytest.approx(0.62 * S, abs=0.03 * S)
    d = truth[np.searchsorted(t, p.t)]
    assert (np.abs(p.d - d) < 5 * p.sd).all()
    assert np.abs(p.d - d)[p.t > T0 + 43 * S].max() < 0.008


def test_lost_accelerometer_leaves_gnss_only_and_comes_back() -> None:
    t, a, truth, tf, z, tr = bridge(150.0, hz=5)
    keep = (t < T0 + 30 * S) | (t > T0 + 110 * S)
    p = play(accel_items(t[keep], a[keep], blocks_of(t[keep])) + fix_items(tf, z))
    assert p.kinds().count("ACCEL_LOST") == 1
    assert p.kinds().count("ACCEL_ON") == 1
    mode = p.column("mode")
    at = (p.t - T0) / S
    silent = (at > 32) & (at < 110)
    assert set(mode[silent]) <= {Mode.GNSS_ONLY, Mode.INVALID}
    assert (mode[silent] == Mode.GNSS_ONLY).mean() > 0.95
    assert silent.sum() > 5 * 75  # one estimate per fix
    d = np.stack([np.interp(p.t, t, truth[:, i]) for i in range(3)], axis=1)
    assert np.abs((p.d - d)[silent & (mode != Mode.INVALID)]).max() < 0.03
    assert set(mode[at > 118]) == {Mode.FUSED}
    assert np.abs((p.d - d)[at > 130]).max() < 0.01
    del tr


def test_a_fix_waits_half_a_second_of_raw_time_for_accelerations() -> None:
    t, a, _, tf, z, _ = bridge(20.0)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z, 50_000_000))
    s = p.station
    last = int(t[-1])
    ahead = Measurement(last + 30_000_000, last + 40_000_000, tuple(z[-1].tolist()), STD, Quality.FIXED)
    assert s.fix("r", ahead, last + 40_000_000) == []
    assert s.advance(last + 530_000_000) == []
    out = s.advance(last + 541_000_000)
    assert [type(o).__name__ for o in out][:1] == ["Innovation"]
    assert s.points[0].anchor_ns == ahead.t_ns


def test_point_without_accelerometer_gives_one_estimate_per_fix() -> None:
    rng = np.random.default_rng(5)
    tf = T0 + np.arange(400) * S
    truth = 0.03 * np.sin(2 * np.pi * np.arange(400) / 300)[:, None] * [1, 0.5, 0.2]
    std = (0.010, 0.010, 0.020)
    z = truth + rng.standard_normal((400, 3)) * std
    p = play(fix_items(tf, z, std=std), points=[PointSettings("p", "r", None)])
    assert [len(e.t_ns) for e in p.estimates] == [1] * len(p.estimates)
    assert len(p.estimates) == 400 - 16
    assert set(p.column("mode")) == {Mode.GNSS_ONLY}
    late = p.t > T0 + 100 * S
    error = p.d - truth[(p.t - T0) // S]
    assert (np.sqrt(np.mean(error[late] ** 2, axis=0)) < 0.6 * np.array(std)).all()


def test_point_without_receiver_gives_vibration_about_zero() -> None:
    t, a, truth, _, _, _ = bridge(120.0)
    p = play(accel_items(t, a, blocks_of(t)), points=[PointSettings("p", None, "a")])
    assert set(p.column("mode")) == {Mode.ACCEL_ONLY}
    assert p.innovations == []
    at = (p.t - T0) / S
    late = at > 60
    i = np.searchsorted(t, p.t)
    vibration = truth[i] - 0.01 * np.sin(2 * np.pi * at / 900)[:, None]
    assert np.sqrt(np.mean((p.d - vibration)[late] ** 2, axis=0)).max() < 0.0025


def test_old_and_unusable_fixes_are_reported_and_dropped() -> None:
    t, a, _, tf, z, _ = bridge(20.0)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z, 50_000_000))
    s = p.station
    before = pack(s.save()["arrays"])
    now = int(t[-1]) + S
    again = Measurement(int(tf[-1]), now, (0.0, 0.0, 0.0), STD, Quality.FIXED)
    bad = Measurement(int(tf[-1]) + 1, now, (float("nan"), 0.0, 0.0), STD, Quality.FIXED)
    none = Measurement(int(tf[-1]) + 1, now, (0.0, 0.0, 0.0), STD, Quality.NONE)
    assert [o.verdict for o in s.fix("r", again, now)] == [Verdict.OLD]  # type: ignore[union-attr]
    assert [o.verdict for o in s.fix("r", bad, now)] == [Verdict.PRECHECK]  # type: ignore[union-attr]
    assert [o.verdict for o in s.fix("r", none, now)] == [Verdict.PRECHECK]  # type: ignore[union-attr]
    assert (s.old, s.prechecked) == (1, 2)
    assert pack(s.save()["arrays"]) == before


def test_unset_reference_becomes_the_median_of_the_start_window() -> None:
    t, a, truth, tf, z, _ = bridge(25.0)
    away = np.array([3.0, -2.0, 1.0])
    p = Played(Station([PointSettings("p", "r", "a")], FusionSettings(), frozenset({"r"})))
    for item in sorted(accel_items(t, a, blocks_of(t)) + fix_items(tf, z + away), key=lambda i: i[0]):
        hand(p, item)
    assert p.kinds() == ["REFERENCE", "START"]
    datum = p.station.datum("r")
    assert datum is not None
    window = (z + away)[tf <= T0 + 15 * S]
    assert np.allclose(datum, np.median(window, axis=0), atol=1e-3)
    i = np.searchsorted(t, p.t)
    assert np.abs(p.d + datum - away - truth[i]).max() < 0.012


def test_a_new_run_adopts_noise_and_says_so() -> None:
    t, a, _, tf, z, _ = bridge(40.0)
    items = accel_items(t, a, blocks_of(t)) + fix_items(tf, z)
    slow = unpack(pack(play(items).station.slow()))
    fresh = Station([PointSettings("p", "r", "a")], FusionSettings())
    events = fresh.adopt(slow)
    assert [e.kind for e in events] == ["ADOPTED"]
    p = Played(fresh)
    for item in sorted(items, key=lambda i: i[0]):
        hand(p, item)
    assert p.kinds() == ["START"]
    assert fresh.adopt({}) == []


def test_incomplete_samples_count_as_missing() -> None:
    t, a, truth, tf, z, _ = bridge(40.0)
    a = a.copy()
    a[2500::200, 1] = np.nan
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z))
    assert np.isfinite(p.d).all()
    assert not set(t[2500::200]) & set(p.t.tolist())
    assert np.abs(p.d - truth[np.searchsorted(t, p.t)]).max() < 0.012


def test_saturated_samples_count_as_missing() -> None:
    """GIVEN samples at full scale WHEN they are flagged THEN they are left out."""
    t, a, truth, tf, z, _ = bridge(40.0)
    a = a.copy()
    a[2500::200, 0] = 160.0
    items = accel_items(t, a, blocks_of(t))
    flagged = [(n, k, replace(b, flags=np.where(b.xyz[:, 0] > 100, 1, 0).astype(np.uint8))) for n, k, b in items]
    p = play(flagged + fix_items(tf, z))
    assert not set(t[2500::200]) & set(p.t.tolist())
    assert np.abs(p.d - truth[np.searchsorted(t, p.t)]).max() < 0.012


def test_nothing_locks_out_when_fixes_agree_on_nothing() -> None:
    t, a, _, tf, z, _ = bridge(90.0)
    z = z.copy()
    n = len(z) - 300
    z[300:] += (np.arange(n) ** 2 * 3e-5)[:, None] * [1, 0, 0]  # the receiver runs away: 0.6 mm/s2 more each second
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z))
    used = [i.t_ns for i in p.innovations if i.verdict in (Verdict.ACCEPTED, Verdict.OFFSET)]
    assert max(np.diff(used)) < 15 * S
    assert used[-1] > T0 + 80 * S


def test_a_fix_older_than_the_accelerations_kept_is_old() -> None:
    t, a, _, tf, z, _ = bridge(60.0)
    seen = tf < T0 + 30 * S
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf[seen], z[seen]))
    late = Measurement(T0 + 40 * S, int(t[-1]), tuple(z[400].tolist()), STD, Quality.FIXED)
    assert [o.verdict for o in p.station.fix("r", late, int(t[-1]))] == [Verdict.OLD]  # type: ignore[union-attr]


def test_checkpoint_is_small_enough_to_head_every_segment() -> None:
    t, a, _, tf, z, _ = bridge(60.0, rate=250)
    p = play(accel_items(t, a, blocks_of(t)) + fix_items(tf, z))
    assert len(pack(p.station.save())) < 600_000
