"""What was due and what came, against a count on the grid that shares no code with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.messages import AccelFlag, Config, FusionFlag, S, Verdict
from edge_agent.review import received
from edge_agent.review.received import LOST, NOT_SENT, Received, Stretches
from edge_agent.review.series import Accelerated, Fixed, Fused, Happened, Judged, Piece
from edge_agent.simulate import SCENARIOS
from edge_agent.simulate.encode import config_yaml
from edge_agent.verify import Gap

I64 = npt.NDArray[np.int64]
T0 = 1_780_300_800 * S


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Config:
    from edge_agent import config
    from edge_agent.simulate.encode import dbc_text

    folder = tmp_path_factory.mktemp("due")
    scenario = SCENARIOS["clean"]
    (folder / "a.dbc").write_text(dbc_text(scenario))
    (folder / "c.yaml").write_text(config_yaml(scenario, dbc="a.dbc", site="s"))
    return config.load(folder / "c.yaml")


def fixes(t: I64) -> Fixed:
    n, three = len(t), np.zeros((len(t), 3))
    one = np.zeros(n)
    return Fixed(t, t, three, three, np.full(n, 4, np.uint8), np.full(n, 9), one, one, np.zeros((n, 2)))


def piece(run: str = "r", happened: list[Happened] | None = None) -> Piece:
    return Piece(Path("x"), run, False, {}, {}, {}, {}, happened or [])


def refused(at: int, count: int, source: str) -> Happened:
    return Happened(at, at, at, "REJECT", source, "CHECKSUM: bad", {"count": float(count)}, False)


def test_epochs_are_counted_on_their_grid_with_the_reason_that_is_known(settings: Config) -> None:
    (name, receiver), rng = next(iter(settings.receivers.items())), np.random.default_rng(1)
    every = np.arange(0, 6000)  # ten minutes at 10 Hz
    gone = np.zeros(6000, np.bool_)
    gone[rng.choice(np.arange(10, 3000), 300, replace=False)] = True  # here and there
    gone[4000:4100] = True  # the agent was stopped
    gone[5000:5002] = True  # came damaged
    gone[0] = gone[-1] = False
    gap = Gap(T0 + 399 * S, T0 + 411 * S, "all", "stop", "stopped in order")
    r = Received(settings, [gap])
    t = T0 + every * (S // 10)
    for k in range(0, 6000, 300):
        inside = slice(k, k + 300)
        happened = [refused(T0 + 500 * S, 2, receiver.port)] if k == 4800 else []
        r.add(replace(piece(happened=happened), fixes={name: fixes(t[inside][~gone[inside]])}))
    due = r.receivers[name]
    assert due.received == int((~gone).sum())
    assert due.expected == 6000
    assert due.missing == {NOT_SENT: 300, "stop": 100, "came damaged (checksum)": 2}
    assert due.gaps == int((np.diff(np.flatnonzero(~gone)) > 1).sum())  # places, not seconds
    assert due.longest is not None
    assert (due.longest.begin_ns, due.longest.end_ns, due.longest.why) == (t[3999], t[4100], "stop")
    middles, share = due.share.columns()
    assert share[3, 0] == pytest.approx((~gone[900:1200]).mean(), abs=0.01)
    assert len(middles) == 20


def test_half_of_the_epochs_missing_does_not_halve_the_rate(settings: Config) -> None:
    """One in three is left out at random, and later one in two in a row."""
    name = next(iter(settings.receivers))
    rng = np.random.default_rng(2)
    t = T0 + np.arange(9000) * (S // 20)
    keep = rng.random(9000) > 1 / 3
    keep[:20] = keep[-1] = True
    keep[6000:6600] = np.arange(600) % 2 == 0
    r = Received(settings, [])
    for k in range(0, 9000, 600):
        r.add(replace(piece(), fixes={name: fixes(t[k : k + 600][keep[k : k + 600]])}))
    due = r.receivers[name]
    alternate = int((~keep[6000:6600]).sum())
    assert due.received == keep.sum()
    # for half a minute nothing but every second one came: that is a receiver at half its rate
    assert abs(due.lost - (int((~keep).sum()) - alternate)) <= 2


def test_another_rate_is_no_loss_and_what_is_there_twice_counts_for_nothing_missing(settings: Config) -> None:
    name = next(iter(settings.receivers))
    r = Received(settings, [])
    for k in range(4):
        step = S // 10 if k < 2 else S
        begin = T0 + (k * 30 if k < 3 else 90) * S
        r.add(replace(piece(), fixes={name: fixes(begin + np.arange(30 * S // step) * step)}))
    again = T0 + np.arange(300) * (S // 10)
    before = r.receivers[name].lost
    r.add(replace(piece(), fixes={name: fixes(again)}))
    assert before == r.receivers[name].lost <= 9  # the seconds in which the rate changes


def samples(t: I64, flags: npt.NDArray[np.uint8]) -> Accelerated:
    x = np.zeros((len(t), 3))
    x[::2, 0], x[1::2, 0] = 0.3, -0.3
    x[:, 2] = 9.8
    return Accelerated(t, t, x, flags)


def test_a_gap_of_an_accelerometer_is_where_samples_are_missing_by_flag_or_silence(settings: Config) -> None:
    name = next(iter(settings.accelerometers))
    r = Received(settings, [])
    number = np.arange(20_000)
    gone = np.zeros(20_000, np.bool_)
    for a, b in ((500, 501), (800, 803), (12_000, 12_300)):
        gone[a:b] = True
    t = T0 + number[~gone] * (S // 100)
    flags = np.full(len(t), AccelFlag.FITTED, np.uint8)
    flags[np.flatnonzero(np.diff(number[~gone]) > 1)[:2] + 1] |= (
        AccelFlag.GAP_BEFORE.value
    )  # the last is told by its silence
    flags[50:60] |= AccelFlag.SATURATED.value
    for k in range(0, len(t), 3000):
        r.add(replace(piece(), accelerations={name: samples(t[k : k + 3000], flags[k : k + 3000])}))
    due = r.accelerometers[name]
    assert (due.received, due.lost, due.gaps) == (int((~gone).sum()), 1 + 3 + 300, 3)
    assert due.missing == {LOST: 304}
    marked = r.flags[name]
    assert {k: n for k, n in marked.counts.items() if n} == {AccelFlag.GAP_BEFORE: 2, AccelFlag.SATURATED: 10}
    ((a, b),) = marked.boxes(AccelFlag.SATURATED)
    assert a <= t[50] < t[59] <= b <= t[59] + S // 10
    assert r.rms(name) == pytest.approx([0.3, 0.0, 0.0], abs=1e-6)
    assert np.isnan(r.rms("none")).all()


def test_flags_and_verdicts_of_a_point_are_marked_in_time(settings: Config) -> None:
    r = Received(settings, [])
    t = T0 + np.arange(1000) * (S // 100)
    three = np.zeros((1000, 3))
    flags = np.zeros(1000, np.uint8)
    flags[200:300] = FusionFlag.JUMP_OPEN
    flags[250:260] |= FusionFlag.FLOAT.value
    f = Fused(t, three, three, np.ones(1000, np.uint8), flags)
    verdict = np.zeros(1000, np.uint8)
    verdict[[10, 900]] = Verdict.REJECTED
    j = Judged(t, t, three, three, three, three, np.zeros(1000), verdict)
    r.add(replace(piece(), fused={"p": f}, judged={"p": j}))
    state = r.states["p"]
    assert {k: n for k, n in state.counts.items() if n} == {FusionFlag.FLOAT: 10, FusionFlag.JUMP_OPEN: 100}
    assert len(state.boxes(FusionFlag.JUMP_OPEN)) == 1
    assert r.verdicts["p"].counts[Verdict.REJECTED] == 2
    assert len(r.verdicts["p"].boxes(Verdict.REJECTED)) == 2
    assert len(r.verdicts["p"].boxes(Verdict.REJECTED, 10.0 * S)) == 1


def test_events_stay_bounded_and_reach_over_the_whole_record() -> None:
    s = Stretches()
    for k in range(50_000):
        s.add(T0 + k * 7 * S, T0 + k * 7 * S + S)
    assert s.count == 50_000
    assert len(s.boxes) <= received.SPANS
    assert min(a for a, _ in s.boxes) == T0
    assert max(b for _, b in s.boxes) == T0 + 49_999 * 7 * S + S
