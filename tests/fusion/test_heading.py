"""The heading filter: wrap, honesty, gate, jumps and decoys, outage, determinism; truth is analytic in every test."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from edge_agent.fusion import heading
from edge_agent.fusion.heading import HeadingFilter, compass, heading_std, wrap
from edge_agent.messages import Event, FusionSettings, GnssHeading, HeadingEstimate, Quality, S, Verdict
from edge_agent.state import pack, unpack

NAN = math.nan
SD = math.degrees(0.0035)
"""Of the default baseline of 1 m."""


def said(
    t_s: float, deg: float, quality: Quality = Quality.FIXED, baseline_m: float = NAN, step_deg: float = 1e-4
) -> GnssHeading:
    t_ns = round(t_s * S)
    return GnssHeading(t_ns, t_ns + S // 10, 0, float(deg), quality, NAN, baseline_m, step_deg, "AVR")


def made(fusion: FusionSettings | None = None) -> HeadingFilter:
    return HeadingFilter("rover", fusion or FusionSettings())


def play(one: HeadingFilter, items: list[GnssHeading]) -> tuple[list[HeadingEstimate], list[Event]]:
    out = [y for x in items for y in one.update(x, True)]
    return [y for y in out if isinstance(y, HeadingEstimate)], [y for y in out if isinstance(y, Event)]


def noisy(
    seed: int, seconds: float, truth: Callable[[float], float], hz: float = 10.0, sd: float = SD, first: float = 1.0
) -> list[GnssHeading]:
    rng = np.random.default_rng(seed)
    times = first + np.arange(round(seconds * hz)) / hz
    return [said(t, (truth(t) + sd * e) % 360.0) for t, e in zip(times, rng.standard_normal(times.size), strict=True)]


def errors(told: list[HeadingEstimate], truth: Callable[[float], float]) -> np.ndarray:
    return np.array([wrap(y.heading_deg - truth(y.t_ns / S)) for y in told])


# -------------------------------------------------------------------------------------------------------------- angles


@pytest.mark.parametrize(
    ("deg", "want"),
    [(0, 0), (180, 180), (-180, 180), (180.5, -179.5), (-180.5, 179.5), (359.9, -0.1), (540, 180), (-720.25, -0.25)],
)
def test_wrap_is_half_open(deg: float, want: float) -> None:
    assert wrap(deg) == pytest.approx(want, abs=1e-9)


def test_wrap_and_compass_are_the_angle_itself() -> None:
    for deg in np.random.default_rng(1).uniform(-2000, 2000, 500).tolist():
        for turned, low, high in ((wrap(deg), -180.0, 180.0), (compass(deg), 0.0, 360.0)):
            assert low <= turned <= high
            assert math.cos(math.radians(turned - deg)) == pytest.approx(1.0, abs=1e-12)
    assert compass(-1e-20) == compass(360.0) == 0.0


@pytest.mark.parametrize(
    ("quality", "baseline_m", "sd"),
    [
        (Quality.FIXED, NAN, 0.2005),
        (Quality.FIXED, 2.0, 0.1003),
        (Quality.FIXED, 10.0, 0.02005),
        (Quality.FIXED, 0.0, 0.2005),
        (Quality.FIXED, 1e-3, 2.005),
        (Quality.FLOAT, 2.0, 4.297),
        (Quality.FLOAT, 0.05, 85.94),
        (Quality.DGNSS, 2.0, math.inf),
        (Quality.NONE, 2.0, math.inf),
    ],
)
def test_the_sd_goes_with_the_baseline(quality: Quality, baseline_m: float, sd: float) -> None:
    assert heading_std(quality, baseline_m, FusionSettings()) == pytest.approx(sd, rel=1e-3)


# --------------------------------------------------------------------------------------------------------------- start


def test_nothing_is_told_before_the_start_and_the_start_is_an_event() -> None:
    told, events = play(made(), noisy(1, 20.0, lambda t: 42.0))
    before = [y for y in told if y.verdict == Verdict.START]
    assert len(before) == 151  # 15 s at 10 Hz; the last of them is the first with an estimate
    assert all(math.isnan(y.heading_deg) and math.isnan(y.std_deg) for y in before[:-1])
    assert {y.verdict for y in told[151:]} == {Verdict.ACCEPTED}
    (start,) = events
    assert (start.kind, start.source, start.t_ns, start.begin_ns) == ("HEADING_START", "rover", 16 * S, S)
    assert dict(start.values)["heading_deg"] == pytest.approx(42.0, abs=4 * SD / math.sqrt(151))


@pytest.mark.parametrize("level", [0.0, 359.98, 180.0, 90.0])
def test_a_start_window_of_outliers_and_wraps(level: float) -> None:
    items = noisy(3, 15.2, lambda t: level)
    items = [replace(x, heading_deg=(level + 70.0 * (i % 5)) % 360) if i % 5 == 1 else x for i, x in enumerate(items)]
    told, events = play(made(), items)
    assert [e.kind for e in events] == ["HEADING_START"]
    assert abs(wrap(told[-1].heading_deg - level)) < 0.1


def test_a_window_that_agrees_on_nothing_does_not_start_and_a_good_one_then_does() -> None:
    rng = np.random.default_rng(5)
    chaos = [said(1.0 + i / 10, float(v)) for i, v in enumerate(rng.uniform(0, 360, 600))]
    one = made()
    told, events = play(one, chaos)
    assert not events
    assert {y.verdict for y in told} == {Verdict.START}
    told, events = play(one, noisy(6, 40.0, lambda t: 12.0, first=61.1))
    assert [e.kind for e in events] == ["HEADING_START"]
    assert told[-1].heading_deg == pytest.approx(12.0, abs=0.1)


def test_a_slow_receiver_starts_after_eight() -> None:
    told, events = play(made(), noisy(7, 600.0, lambda t: 100.0, hz=0.1))
    assert [y.verdict for y in told[:9]] == [Verdict.START] * 8 + [Verdict.ACCEPTED]
    assert len(events) == 1


@pytest.mark.parametrize("sd", [0.02, 0.2, 1.0])
def test_the_scatter_of_the_window_sets_the_sd_of_a_heading(sd: float) -> None:
    told, _ = play(made(), noisy(8, 120.0, lambda t: 10.0, sd=sd))
    floor = SD * math.sqrt(FusionSettings().r_least)  # no receiver is that much better than its class
    assert told[151].std_measured_deg == pytest.approx(max(sd, floor), rel=0.25)
    assert told[-1].std_measured_deg == pytest.approx(max(sd, floor), rel=0.25)


# ---------------------------------------------------------------------------------------------------- wrap and honesty


def turning(t: float) -> float:
    """Through north and back: 359.9 -> 0.1 -> 359.9, the swing of a tower in the sun."""
    return 0.1 * math.sin(2 * math.pi * t / 14400.0)


def test_a_heading_through_north_is_followed_without_a_jump() -> None:
    told, events = play(made(), noisy(9, 7200.0, turning, hz=1.0))
    used = [y for y in told if not math.isnan(y.heading_deg)]
    assert all(0.0 <= y.heading_deg < 360.0 for y in used)
    assert {y.heading_deg > 180.0 for y in used} == {True, False}
    assert [e.kind for e in events] == ["HEADING_START"]
    assert np.abs(errors(used[300:], turning)).max() < 0.12
    assert sum(y.verdict == Verdict.REJECTED for y in used) <= 20


@pytest.mark.parametrize("jump", [-0.3, 0.3])
def test_the_innovation_is_the_short_way_round(jump: float) -> None:
    """GIVEN an estimate at north WHEN a heading stands on its other side THEN the ratio is that of 0.3, not 359.7."""
    one = made()
    play(one, noisy(10, 60.0, lambda t: 0.0))
    state = one.save()
    h, m = state["x"]
    (y,) = one.update(said(62.0, (h + m + jump) % 360.0), True)
    assert isinstance(y, HeadingEstimate)
    assert y.verdict == Verdict.ACCEPTED
    variance = jump**2 / (y.ratio * 10.827566170662733)
    assert variance == pytest.approx(y.std_measured_deg**2, rel=0.2)


def model_run(seed: int, n: int, sd: float, dt: float) -> tuple[list[GnssHeading], np.ndarray]:
    """Headings exactly as the filter's model has them, and the truth: random walk + Gauss-Markov + white noise."""
    rng = np.random.default_rng(seed)
    truth = 359.9 + np.cumsum(np.sqrt(1e-7 * dt) * rng.standard_normal(n))
    a = math.exp(-dt / 300.0)
    m = np.empty(n)
    m[0] = 0.5 * SD * rng.standard_normal()
    for i in range(1, n):
        m[i] = a * m[i - 1] + 0.5 * SD * math.sqrt(1 - a * a) * rng.standard_normal()
    z = (truth + m + sd * rng.standard_normal(n)) % 360.0
    return [said(1.0 + i * dt, float(v)) for i, v in enumerate(z)], truth


def test_nees_and_false_rejections_on_the_models_own_noise() -> None:
    """40 runs of 30 minutes: mean NEES within the 99.9 % bounds of a chi-square mean of independent runs, and the gate
    refuses about alpha of the good ones."""
    ends, mid, refused, judged = [], [], 0, 0
    for seed in range(40):
        items, truth = model_run(seed, 1800, SD, 1.0)
        told, events = play(made(), items)
        assert [e.kind for e in events] == ["HEADING_START"]
        for k, where in ((900, mid), (1799, ends)):
            where.append(wrap(told[k].heading_deg - float(truth[k])) ** 2 / told[k].std_deg ** 2)
        judged += sum(not math.isnan(y.ratio) for y in told)
        refused += sum(y.verdict == Verdict.REJECTED for y in told)
    # chi-square of 40 degrees / 40: 0.41 and 1.84 are its 0.05 % and 99.95 % points
    assert 0.41 < float(np.mean(ends)) < 1.84
    assert 0.41 < float(np.mean(mid)) < 1.84
    assert 0.0003 < refused / judged < 0.002


@pytest.mark.parametrize("multipath", [0.0, 0.05])
def test_the_sd_is_honest_beside_multipath_and_sway(multipath: float) -> None:
    """A tower that turns with the sun and sways at 0.3 Hz; the receiver at 2 m: 0.1 deg and reflections."""

    def truth(t: float) -> float:
        return 120.0 + 0.05 * math.sin(2 * math.pi * t / 14400.0) + 0.02 * math.sin(2 * math.pi * 0.3 * t)

    rng = np.random.default_rng(11)
    n = 7200
    reflected = np.zeros(n)
    for i in range(1, n):
        reflected[i] = reflected[i - 1] * math.exp(-1 / 120) + multipath * 0.129 * rng.standard_normal()
    z = [truth(1.0 + i) + reflected[i] + 0.1 * e for i, e in enumerate(rng.standard_normal(n))]
    told, _ = play(made(), [said(1.0 + i, v, baseline_m=2.0) for i, v in enumerate(z)])
    e = errors(told[600:], truth)
    nees = float((e**2 / np.array([y.std_deg for y in told[600:]]) ** 2).mean())
    assert nees < 3.0
    assert math.sqrt(float((e**2).mean())) < 0.05  # a single heading has 0.1


# ---------------------------------------------------------------------------------------------------- gate and refusal


def test_lone_wrong_headings_are_refused_and_move_nothing() -> None:
    """GIVEN 5 % of headings wrong by 3 to 170 deg WHEN they come alone THEN every one is refused, and no good one more
    often than alpha allows."""
    rng = np.random.default_rng(12)
    items = noisy(12, 600.0, lambda t: 0.05)
    wrong = {int(i) for i in rng.choice(np.arange(200, 6000), 290, replace=False)}
    items = [
        replace(x, heading_deg=(0.05 + rng.choice([-1, 1]) * rng.uniform(3, 170)) % 360) if i in wrong else x
        for i, x in enumerate(items)
    ]
    told, events = play(made(), items)
    assert all(told[i].verdict == Verdict.REJECTED for i in wrong)
    assert all(told[i].ratio > 1.0 for i in wrong)
    good = [y for i, y in enumerate(told) if i not in wrong and y.verdict != Verdict.START]
    assert sum(y.verdict == Verdict.REJECTED for y in good) <= 0.002 * len(good)
    assert [e.kind for e in events] == ["HEADING_START"]
    assert np.abs(errors(told[200:], lambda t: 0.05)).max() < 0.1


@pytest.mark.parametrize("drift", [0.0, 1 / 120])
def test_a_wrong_solution_shorter_than_the_longest_moves_nothing(drift: float) -> None:
    """GIVEN a wrong level for 60 s of each 100, the same or another one each time THEN refused, no event, no turn: the
    good headings between end the count, though they are fewer."""

    def turned(t: float) -> float:
        return 200.0 + (3.0 + t * drift if t > 100 and t % 100 < 60 else 0.0)

    told, events = play(made(), noisy(13, 900.0, turned))
    assert [e.kind for e in events] == ["HEADING_START"]
    for y in told:
        t = y.t_ns / S
        if t > 100 and 1 < t % 100 < 59:
            assert y.verdict == Verdict.REJECTED
    assert np.abs(errors(told[200:], lambda t: 200.0)).max() < 0.15


@pytest.mark.parametrize(("before", "after"), [(359.9, 5.0), (10.0, 190.0), (90.0, 89.0)])
@pytest.mark.parametrize("hz", [1.0, 10.0])
def test_a_turn_that_holds_is_taken_over_once(before: float, after: float, hz: float) -> None:
    def truth(t: float) -> float:
        return before if t < 100.0 else after

    told, events = play(made(), noisy(14, 400.0, truth, hz=hz))
    assert [e.kind for e in events] == ["HEADING_START", "HEADING_JUMP"]
    jump = events[1]
    assert 219.0 <= jump.t_ns / S <= 222.0  # reacquire_s after it
    assert 99.9 <= jump.begin_ns / S <= 102.1
    assert abs(wrap(dict(jump.values)["turn_deg"] - (after - before))) < 0.2
    then = [y for y in told if y.t_ns >= jump.t_ns]
    assert then[0].verdict == Verdict.ACCEPTED
    assert np.abs(errors(then, truth)).max() < 0.2
    assert sum(y.verdict == Verdict.REJECTED for y in then) <= max(1, 0.002 * len(then))
    between = [y for y in told if 110 < y.t_ns / S < 219]
    assert {y.verdict for y in between} == {Verdict.REJECTED}
    assert between[-1].std_measured_deg == pytest.approx(told[int(99 * hz)].std_measured_deg, rel=0.4)  # is not noise


@pytest.mark.parametrize("seed", range(6))
def test_a_turn_of_four_sd_is_not_smeared_over_an_hour(seed: int) -> None:
    """Every fifth of its headings passes the gate; they must neither pull the estimate nor end the count."""
    told, events = play(made(), noisy(seed, 300.0, lambda t: 10.0 if t < 100 else 10.8))
    assert [e.kind for e in events] == ["HEADING_START", "HEADING_JUMP"]
    assert told[-1].heading_deg == pytest.approx(10.8, abs=0.1)


def test_a_full_start_window_starts_whatever_its_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 20 Hz it holds 205 s; with a longer `start_s` the heading would never start."""
    monkeypatch.setattr(heading, "START_MOST", 50)
    told, events = play(made(replace(FusionSettings(), start_s=60.0)), noisy(3, 20.0, lambda t: 10.0))
    assert [e.kind for e in events] == ["HEADING_START"]
    assert [y.verdict for y in told].count(Verdict.START) == 50


def test_the_time_until_a_turn_is_believed_is_the_setting() -> None:
    fusion = replace(FusionSettings(), reacquire_s=5.0)
    _, events = play(made(fusion), noisy(15, 100.0, lambda t: 10.0 if t < 50 else 20.0))
    assert events[1].kind == "HEADING_JUMP"
    assert 54.9 <= events[1].t_ns / S <= 55.2


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_turn_with_wrong_headings_in_it_is_still_found(place: int) -> None:
    items = noisy(16, 300.0, lambda t: 10.0 if t < 50 else 30.0)
    wrong = {i for i in range(495, len(items)) if i % 3 == place}
    items = [replace(x, heading_deg=(40.0 + 7.0 * i) % 360) if i in wrong else x for i, x in enumerate(items)]
    told, events = play(made(), items)
    assert [e.kind for e in events] == ["HEADING_START", "HEADING_JUMP"]
    (taken,) = [y for y in told if y.t_ns == events[1].t_ns]
    assert taken.measured_deg == pytest.approx(30.0, abs=1.0)  # never at one that does not stand with the others
    assert told[-1].heading_deg == pytest.approx(30.0, abs=0.2)


def test_headings_that_agree_on_nothing_begin_anew_instead_of_locking_out() -> None:
    rng = np.random.default_rng(17)
    items = noisy(17, 60.0, lambda t: 10.0)
    items += [said(61.0 + i / 10, float(v)) for i, v in enumerate(rng.uniform(30, 350, 300))]
    items += noisy(18, 60.0, lambda t: 44.0, first=91.0)
    told, events = play(made(), items)
    assert [e.kind for e in events] == ["HEADING_START", "HEADING_LOST", "HEADING_START"]
    assert 70.9 < events[1].t_ns / S < 72.0  # lockout_s
    lost = [y for y in told if events[1].t_ns <= y.t_ns < events[2].t_ns]
    assert all(math.isnan(y.heading_deg) for y in lost)
    assert told[-1].heading_deg == pytest.approx(44.0, abs=0.1)


def test_two_outliers_far_apart_are_no_chaos() -> None:
    """A slow receiver: refused in a row, but too few to mean anything."""
    items = noisy(19, 600.0, lambda t: 50.0, hz=0.2)
    items[60] = replace(items[60], heading_deg=200.0)
    items[61] = replace(items[61], heading_deg=300.0)
    items[62] = replace(items[62], heading_deg=100.0)
    _, events = play(made(), items)
    assert [e.kind for e in events] == ["HEADING_START"]


def test_noise_that_grows_is_learnt_and_locks_nothing_out() -> None:
    items = noisy(20, 60.0, lambda t: 10.0) + noisy(21, 240.0, lambda t: 10.0, sd=5 * SD, first=61.0)
    told, events = play(made(), items)
    assert [e.kind for e in events] == ["HEADING_START"]
    assert told[-1].std_measured_deg == pytest.approx(5 * SD, rel=0.3)
    late = told[-1000:]
    assert sum(y.verdict == Verdict.REJECTED for y in late) <= 5


# ------------------------------------------------------------------------------------------- float, not valid, outage


def test_what_is_no_measurement_never_reaches_the_gate() -> None:
    one = made()
    play(one, noisy(22, 30.0, lambda t: 10.0))
    state = pack(one.save())
    for x in (
        said(40.0, NAN, Quality.NONE),
        said(40.1, 10.0, Quality.DGNSS),
        said(40.2, 10.0, Quality.SINGLE),
        said(40.3, NAN),
    ):
        (y,) = one.update(x, True)
        assert isinstance(y, HeadingEstimate)
        assert y.verdict == Verdict.PRECHECK
        assert y.heading_deg == pytest.approx(10.0, abs=0.1)
        assert math.isnan(y.ratio)
    (y,) = one.update(said(40.4, 10.0), False)
    assert isinstance(y, HeadingEstimate)
    assert y.verdict == Verdict.PRECHECK
    assert pack(one.save()) == state


def test_the_sd_grows_through_an_outage_and_the_same_heading_is_taken_again() -> None:
    one = made()
    told, _ = play(one, noisy(23, 300.0, lambda t: 10.0))
    before = told[-1].std_deg
    silent, _ = play(one, [said(301.0 + 60 * i, NAN, Quality.NONE) for i in range(600)])
    stds = [y.std_deg for y in silent]
    assert stds == sorted(stds)
    hours = (silent[-1].t_ns - told[-1].t_ns) / S
    assert stds[-1] == pytest.approx(math.sqrt(before**2 + 1e-7 * hours), rel=1e-12)
    after, events = play(one, noisy(24, 60.0, lambda t: 10.05, first=301.0 + 36001.0))
    assert not events
    assert {y.verdict for y in after} == {Verdict.ACCEPTED}
    assert before < after[0].std_deg < stds[-1]  # ten hours of walk do not go with one heading


def test_the_sd_in_the_long_run_goes_with_the_baseline() -> None:
    """The multipath is what is left; it shrinks as the antennas stand further apart."""
    left = {}
    for baseline in (1.0, 10.0):
        sd = SD / baseline
        items = [replace(x, baseline_m=baseline) for x in noisy(33, 1800.0, lambda t: 10.0, hz=1.0, sd=sd)]
        left[baseline] = play(made(), items)[0][-1].std_deg
    assert 3.0 < left[1.0] / left[10.0] < 10.0


def test_a_float_heading_counts_little_and_starts_nothing() -> None:
    one = made()
    told, events = play(one, [said(1.0 + i / 10, 15.0, Quality.FLOAT, 2.0) for i in range(300)])
    assert not events
    assert {y.verdict for y in told} == {Verdict.PRECHECK}
    play(one, noisy(25, 60.0, lambda t: 10.0, first=40.0))
    (y,) = one.update(said(101.0, 15.0, Quality.FLOAT, 2.0), True)
    assert isinstance(y, HeadingEstimate)
    assert y.verdict == Verdict.ACCEPTED
    assert y.std_measured_deg > 3.0
    assert y.heading_deg == pytest.approx(10.0, abs=0.1)


def test_an_older_heading_is_dropped() -> None:
    one = made()
    play(one, noisy(26, 30.0, lambda t: 10.0))
    state = pack(one.save())
    for t in (30.9, 12.0):
        (y,) = one.update(said(t, 10.0), True)
        assert isinstance(y, HeadingEstimate)
        assert y.verdict == Verdict.OLD
    assert pack(one.save()) == state


def test_coarse_decimals_are_part_of_the_sd() -> None:
    items = [replace(x, heading_deg=round(x.heading_deg), resolution_deg=1.0) for x in noisy(27, 60.0, lambda t: 77.0)]
    told, _ = play(made(), items)
    assert told[-1].std_measured_deg > 1.0 / math.sqrt(12)
    assert sum(y.verdict == Verdict.REJECTED for y in told) <= 0.02 * len(told)


def test_the_covariance_stays_one_for_a_year_of_headings() -> None:
    """A year at 1 Hz would take minutes: the smallest noise that the model has, at the longest and shortest steps."""
    one = made()
    play(one, noisy(28, 20.0, lambda t: 10.0))
    t = 30.0
    for i in range(20000):
        t += (1e-3, 3600.0, 0.05)[i % 3]
        one.update(said(t, 10.0 + 1e-4 * (i % 7), baseline_m=100.0), True)
        assert one.hh > 0.0
        assert one.mm >= 0.0
        assert one.hm * one.hm <= one.hh * one.mm * (1 + 1e-9)


# --------------------------------------------------------------------------------------------------------- determinism


def stormy() -> list[GnssHeading]:
    """Every path of the policy: start, decoys, float, outage, a turn, chaos, a new start."""
    rng = np.random.default_rng(29)
    items = noisy(29, 60.0, lambda t: 5.0 if 40 < t < 42 else 359.95, hz=5.0)
    items += [replace(x, quality=Quality.FLOAT, baseline_m=1.5) for x in noisy(30, 5.0, lambda t: 0.3, first=61.0)]
    items += [said(70.0, NAN, Quality.NONE), said(65.0, 1.0)]
    items += noisy(31, 40.0, lambda t: 12.0, hz=5.0, first=80.0)
    items += [said(121.0 + i / 5, float(v)) for i, v in enumerate(rng.uniform(0, 360, 120))]
    return items + noisy(32, 40.0, lambda t: 100.0, hz=5.0, first=150.0)


def test_a_stop_at_any_heading_goes_on_as_if_there_were_none() -> None:
    fusion = replace(FusionSettings(), reacquire_s=20.0)
    items = stormy()
    whole = made(fusion)
    want, states = [], []
    for x in items:
        states.append(pack(whole.save()))
        want.append(repr(whole.update(x, True)))
    kinds = " ".join(want)
    for kind in ("HEADING_START", "HEADING_JUMP", "HEADING_LOST", "REJECTED", "PRECHECK", "OLD"):
        assert kind in kinds
    one = made(fusion)
    got = []
    for x, state in zip(items, states, strict=True):
        assert pack(one.save()) == state
        one = made(fusion)
        one.load(unpack(state))
        got.append(repr(one.update(x, True)))
    assert got == want
    assert pack(one.save()) == pack(whole.save())


def test_the_start_window_is_bounded() -> None:
    """Also where the headings agree on nothing, so that none begins."""
    one = made(replace(FusionSettings(), start_s=1e6))
    most = 0
    for i in range(heading.START_MOST + 500):
        one.update(said(1.0 + i / 10, 37.0 * (i * i % 10)), True)
        most = max(most, len(one.window))
    assert not one.started
    assert heading.START_MOST // 2 <= most <= heading.START_MOST
