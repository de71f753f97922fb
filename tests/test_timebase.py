"""Clocks against exact truth: jittered arrivals, drains, steps, lost samples."""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.messages import MS, AccelBlock, GnssFix, Quality, S, Tick
from edge_agent.timebase import DeviceClock, FixClock, WallMap

UTC0 = 1_790_000_000 * S


def fix(utc_ns: int, arrival_ns: int) -> GnssFix:
    nan = float("nan")
    nan3 = (nan, nan, nan)
    return GnssFix(
        0, arrival_ns, utc_ns, True, 51.0, 13.0, 100.0, 40.0, Quality.FIXED, 12, 0.9, nan, nan, 1.0, "", nan3, nan3, ()
    )


def block(stamps: np.ndarray, count: np.ndarray, drain: bool = True) -> AccelBlock:
    n = stamps.size
    return AccelBlock("a", stamps, np.zeros((n, 3)), np.zeros(n, np.uint8), count, drain)


def drained(true: np.ndarray, drain_ns: int = 20 * MS + 130_000, transport_ns: int = 300_000) -> np.ndarray:
    """Arrival stamps of a port that sleeps 20 ms between looks (and so looks a little less often than that)."""
    return (true + transport_ns + drain_ns - 1) // drain_ns * drain_ns


def run_clock(clock: DeviceClock, true: np.ndarray, stamps: np.ndarray, count: np.ndarray, per: int = 10) -> np.ndarray:
    out = []
    for i in range(0, true.size, per):
        t, _ = clock.times(block(stamps[i : i + per], count[i : i + per]))
        out.append(t)
    return np.concatenate(out)


@pytest.mark.parametrize("rate_hz", [None, 100.0])
@pytest.mark.parametrize("counted", [True, False])
def test_drained_stamps_become_sample_times(rate_hz: float | None, counted: bool) -> None:
    """GIVEN 100 Hz, 200 ppm fast, stamped at 20 ms drains WHEN ten minutes pass THEN times are within 1.5 ms of true
    after half a minute, their spacing within 1 %, and always increasing."""
    n = 60_000
    true = 5 * S + np.rint(np.arange(n) * (10 * MS / 1.0002)).astype(np.int64)
    got = run_clock(DeviceClock(rate_hz, counted), true, drained(true), np.arange(n))
    assert (np.diff(got) > 0).all()
    err = (got - true)[3000:]
    assert np.abs(err).max() < 1.5 * MS
    assert np.abs(np.diff(got)[3000:] / (10 * MS) - 1).max() < 0.01


def test_kernel_stamps_without_rate_or_counter_stay() -> None:
    rng = np.random.default_rng(1)
    stamps = np.cumsum(rng.integers(1 * MS, 20 * MS, 100)).astype(np.int64)
    got, gap = DeviceClock(None, False).times(block(stamps, np.arange(100), drain=False))
    assert (got == stamps).all()
    assert not gap


def test_equal_stamps_are_made_increasing() -> None:
    got, _ = DeviceClock(None, False).times(block(np.full(5, 7 * S), np.arange(5), drain=False))
    assert (np.diff(got) > 0).all()
    assert got[0] == 7 * S


def test_counter_keeps_time_across_lost_samples() -> None:
    n = 20_000
    true = 5 * S + np.arange(n) * 4 * MS
    keep = np.ones(n, bool)
    keep[12_000:12_300] = False
    got = run_clock(DeviceClock(None, True), true[keep], drained(true[keep]), np.arange(n)[keep], 25)
    assert np.abs(got - true[keep])[5000:].max() < 1.5 * MS


def test_lost_samples_without_a_counter_are_found() -> None:
    """GIVEN no counter WHEN five samples are lost for good THEN the times are right again within some seconds."""
    n = 12_000
    true = 5 * S + np.arange(n) * 10 * MS
    keep = np.ones(n, bool)
    keep[6000:6005] = False
    t = true[keep]
    got = run_clock(DeviceClock(100.0, False), t, drained(t), np.arange(t.size))
    assert np.abs(got - t)[6000 + 300 :].max() < 2 * MS
    assert np.abs(got - t)[2000:5990].max() < 1.5 * MS


def test_a_device_that_restarts_begins_a_new_line() -> None:
    true = np.concatenate([5 * S + np.arange(3000) * 10 * MS, 50 * S + np.arange(3000) * 10 * MS])
    count = np.concatenate([np.arange(3000), np.arange(3000) + 9])
    got = run_clock(DeviceClock(None, True), true, drained(true), count)
    assert (np.diff(got) > 0).all()
    assert np.abs(got - true)[5000:].max() < 2 * MS


def test_device_clock_goes_on_after_load() -> None:
    n = 4000
    true = 5 * S + np.arange(n) * 10 * MS
    stamps = drained(true)
    one, two = DeviceClock(None, False), DeviceClock(None, False)
    a = run_clock(one, true[:2000], stamps[:2000], np.arange(2000))
    two.load(one.save())
    x = run_clock(one, true[2000:], stamps[2000:], np.arange(2000, n))
    y = run_clock(two, true[2000:], stamps[2000:], np.arange(2000, n))
    assert (x == y).all()
    assert a[-1] < x[0]


def drive(clock: FixClock, wall: WallMap, n: int, *, latency_ns: int, sync: bool, start: int = 0) -> np.ndarray:
    """10 Hz epochs with +-20 ms of jitter; returns t_ns - truth. Monotonic truth = utc - UTC0 + 1000 s."""
    rng = np.random.default_rng(7)
    err = []
    for i in range(start, start + n):
        true = 1000 * S + i * 100 * MS
        utc = UTC0 + i * 100 * MS
        if i % 10 == 0:
            wall.tick(true, Tick(utc, sync, 0))
        arrival = true + latency_ns + int(rng.uniform(-20, 20) * MS)
        err.append(clock.time(fix(utc, arrival), wall)[0] - true)
    return np.array(err)


def test_synchronised_host_gives_exact_fix_times_and_learns_the_latency() -> None:
    clock, wall = FixClock(None), WallMap()
    err = drive(clock, wall, 3000, latency_ns=200 * MS, sync=True)
    assert np.abs(err).max() == 0
    assert clock.latency_ns() == pytest.approx(200 * MS, abs=5 * MS)
    # the host loses its time source: what was learned goes on
    err = drive(clock, wall, 3000, latency_ns=200 * MS, sync=False, start=3000)
    assert np.abs(err).max() < 8 * MS


def test_unsynchronised_host_uses_the_configured_latency() -> None:
    err = drive(FixClock(200.0), WallMap(), 3000, latency_ns=200 * MS, sync=False)
    assert np.abs(err[200:]).max() < 6 * MS


def test_nothing_known_is_said() -> None:
    clock, wall = FixClock(None), WallMap()
    _, uncertain, _ = clock.time(fix(UTC0, 1000 * S + 200 * MS), wall)
    assert uncertain


def test_a_step_of_the_host_clock_does_not_move_the_fixes() -> None:
    """GIVEN a learned latency WHEN the wall clock jumps by an hour and calls itself synchronised THEN fixes stay."""
    clock, wall = FixClock(None), WallMap()
    drive(clock, wall, 1000, latency_ns=200 * MS, sync=True)
    last = 0
    for i in range(1000, 1500):
        true, utc = 1000 * S + i * 100 * MS, UTC0 + i * 100 * MS
        if i % 10 == 0:
            assert wall.tick(true, Tick(utc + 3600 * S, True, 0)) == (3600 * S if i == 1000 else 0)
        t, _, step = clock.time(fix(utc, true + 200 * MS), wall)
        assert step == 0
        assert abs(t - true) < 8 * MS
        assert t > last
        last = t


def test_a_step_of_the_receiver_time_is_found() -> None:
    clock, wall = FixClock(150.0), WallMap()
    steps = []
    for i in range(400):
        true, utc = 1000 * S + i * 100 * MS, UTC0 + i * 100 * MS
        shift = 18 * S if i >= 200 else 0
        t, _, step = clock.time(fix(utc + shift, true + 150 * MS), wall)
        steps += [step] if step else []
        assert abs(t - true) < 5 * MS
    assert steps == [18 * S]


def test_a_backlog_is_late_not_stepped() -> None:
    """GIVEN a host that stalls for 3 s WHEN the held-back sentences come at once THEN their times are still true."""
    clock, wall = FixClock(100.0), WallMap()
    for i in range(400):
        true, utc = 1000 * S + i * 100 * MS, UTC0 + i * 100 * MS
        arrival = true + 100 * MS
        if 200 <= i < 230:
            arrival = 1000 * S + 23 * S
        t, _, step = clock.time(fix(utc, arrival), wall)
        assert step == 0
        assert abs(t - true) < 20 * MS


def test_wall_map_reports_a_step_once() -> None:
    wall = WallMap()
    steps = [wall.tick(i * S, Tick(UTC0 + i * S + (86_400 * S if i > 5 else 0), False, 0)) for i in range(10)]
    assert steps == [0] * 6 + [86_400 * S] + [0] * 3


def test_a_sentence_that_is_no_fix_has_its_epochs_time_and_teaches_nothing() -> None:
    clock = FixClock(200.0)
    wall = WallMap()
    assert clock.time_of(UTC0, 5 * S) == 5 * S - 200 * MS  # no fix has been seen
    for i in range(20):
        t_ns, _, _ = clock.time(fix(UTC0 + i * S, 5 * S + i * S), wall)
    state = clock.save()
    for late in (0, 30 * MS, S):  # behind its fix in the same burst
        assert clock.time_of(UTC0 + 19 * S, 24 * S + late) == t_ns
    for utc_ns in (0, UTC0 + 3600 * S, UTC0 + 25 * S, UTC0):  # no time, or one that cannot be
        assert clock.time_of(utc_ns, 24 * S) == 24 * S - 200 * MS
    assert clock.save() == state
