"""Thresholds on fused motion: begin, hysteresis, hold, end; the same events however the stream is cut."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_agent.messages import AccelBlock, Estimate, Event, EventSettings, Mode, PointSettings, S, TriggerSettings
from edge_agent.state import pack, unpack
from edge_agent.triggers import BEGIN, END, Triggers

T = 1000 * S
HZ = 10
POINTS = {"mid": PointSettings("mid", "r", "acc"), "top": PointSettings("top", None, "acc")}


def times(n: int) -> np.ndarray:
    return T + np.arange(n) * (S // HZ)


def estimate(t_ns: np.ndarray, xyz: np.ndarray, mode: int = Mode.FUSED, point: str = "mid") -> Estimate:
    n = len(t_ns)
    ones = np.ones((n, 3))
    return Estimate(
        *(point, t_ns, xyz, 10 * xyz, ones, ones, np.full(n, mode, np.uint8), np.zeros(n, np.uint8)),
        *(np.array([0.1, 0.2, 9.8]), np.ones(3), np.zeros(3), np.ones(3)),
    )


def made(hold_s: float = 1.0, release: float = 0.5, **trigger: Any) -> Triggers:
    t = TriggerSettings("t", **{"point": "mid", "axis": "x", "above_m": 1.0, **trigger})
    return Triggers([t], EventSettings(hold_s=hold_s, release=release), POINTS)


def along_x(x: list[float]) -> np.ndarray:
    return np.array(x)[:, None] * np.array([1.0, 0.0, 0.0])


def play(triggers: Triggers, x: list[float], cuts: tuple[int, ...] = ()) -> list[Event]:
    """Feed a motion along x at 10 Hz, cut into blocks; after each block the state is saved into a fresh one."""
    t, xyz = times(len(x)), along_x(x)
    found: list[Event] = []
    for a, b in zip((0, *cuts), (*cuts, len(x)), strict=True):
        if b > a:
            found += triggers.estimate(estimate(t[a:b], xyz[a:b]))
            triggers.load(unpack(pack(triggers.save())))
    return found


def short(events: list[Event]) -> list[tuple[Any, ...]]:
    """Kind, begin and end in tenths of a second, peak."""
    return [
        (BEGIN, (e.t_ns - T) * HZ // S)
        if e.kind == BEGIN
        else (END, (e.begin_ns - T) * HZ // S, (e.end_ns - T) * HZ // S, dict(e.values)["peak"])
        for e in events
    ]


def test_an_event_begins_at_the_threshold_and_ends_after_the_hold() -> None:
    x = [0.9] * 5 + [1.0, -1.5, 0.6, 0.4] + [0.0] * 20
    found = play(made(), x)
    assert short(found) == [(BEGIN, 5), (END, 5, 7, 1.5)]  # 0.6 is still above the release of 0.5, 0.4 is not
    assert found[0].text == "mid x displacement 1 m, at least 1"
    assert found[1].text == "mid x displacement reached 1.5 m in 0.200 s"
    assert dict(found[1].values) == {"peak": 1.5, "threshold": 1.0, "seconds": 0.2, "peak_after_s": 0.1}
    assert found[1].t_ns == T + 18 * S // HZ  # the first sample more than a second behind the last high one


def test_an_oscillation_is_one_event_and_noise_about_the_threshold_too() -> None:
    x = [1.2 if i % 8 == 0 else 0.0 for i in range(80)] + [0.0] * 20
    assert short(play(made(), x)) == [(BEGIN, 0), (END, 0, 72, 1.2)]
    noisy = [1.0 + (-1) ** i * 0.05 for i in range(80)] + [0.0] * 20
    assert short(play(made(hold_s=0.2), noisy)) == [(BEGIN, 0), (END, 0, 79, 1.05)]


def test_two_that_lie_apart_are_two() -> None:
    x = [2.0] + [0.0] * 15 + [3.0] + [0.0] * 15
    assert short(play(made(), x)) == [(BEGIN, 0), (END, 0, 0, 2.0), (BEGIN, 16), (END, 16, 16, 3.0)]


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from([0.0, 0.4, 0.5, 0.9, 1.0, 1.7]), max_size=80), st.sets(st.integers(0, 80)))
def test_any_cut_finds_the_same_as_a_walk_by_sample(x: list[float], cuts: set[int]) -> None:
    begin = last = -1
    peak = 0.0
    wanted: list[tuple[Any, ...]] = []
    for i, v in enumerate(x):
        if begin >= 0 and i - last > HZ:
            wanted.append((END, begin, last, peak))
            begin = -1
        if begin < 0 and v >= 1.0:
            wanted.append((BEGIN, i))
            begin, last, peak = i, i, v
        elif begin >= 0 and v >= 0.5:
            last, peak = i, max(peak, v)
    inside = tuple(sorted(c for c in cuts if c < len(x)))
    assert short(play(made(), x, inside)) == wanted


@pytest.mark.parametrize(
    ("axis", "xyz", "begins"),
    [
        ("x", [1.0, 0, 0], True), ("x", [-1.0, 0, 0], True), ("x", [0, 5, 5], False), ("y", [0, 1.0, 0], True),
        ("z", [0, 0, -1.0], True), ("z", [5, 5, 0], False), ("any", [0, 0, 1.0], True), ("any", [0.9, 0.9, 0.9], False),
        ("horizontal", [0.6, 0.8, 0], True), ("horizontal", [0.6, 0.7, 9], False),
    ],
)  # fmt: skip
def test_axes(axis: str, xyz: list[float], begins: bool) -> None:
    assert bool(made(axis=axis).estimate(estimate(times(1), np.array([xyz])))) is begins


def test_what_is_not_valid_or_not_live_or_of_another_point_counts_nothing() -> None:
    t, xyz = times(3), along_x([2.0, 2.0, 2.0])
    triggers = made()
    for mode in (Mode.INIT, Mode.ACCEL_ONLY, Mode.CONTRADICTION, Mode.INVALID):
        assert triggers.estimate(estimate(t, xyz, mode)) == []
    assert triggers.estimate(estimate(t, xyz, point="top")) == []
    assert triggers.estimate(estimate(t, xyz * np.nan)) == []
    assert len(triggers.estimate(estimate(t, xyz, Mode.COAST))) == 1


def test_velocity_and_acceleration() -> None:
    t = times(3)
    assert len(made(above_m=None, above_mps=10.0).estimate(estimate(t, along_x([0.9, 1.0, 0.0])))) == 1
    triggers = made(above_m=None, above_mps2=1.0, axis="any")
    still = AccelBlock("acc", t, np.tile([0.1, 0.2, 9.8], (3, 1)), np.zeros(3, np.uint8), np.arange(3))
    shaken = AccelBlock("acc", t, still.xyz + along_x([0.0, -1.0, 0.0]), still.flags, still.count)
    assert triggers.accelerations("acc", shaken) == []  # nothing is known of gravity yet
    assert triggers.estimate(estimate(t, along_x([5.0, 5.0, 5.0]))) == []
    assert triggers.accelerations("acc", still) == []
    assert triggers.accelerations("other", shaken) == []
    (event,) = triggers.accelerations("acc", shaken)
    assert event.text == "mid any acceleration 1 m/s2, at least 1"
    again = made(above_m=None, above_mps2=1.0, axis="any")
    again.load(unpack(pack(triggers.save())))
    assert again.accelerations("acc", shaken) == []  # it is in the event already, as the first one is


def test_an_event_ends_where_the_data_ends() -> None:
    triggers = made()
    assert short(play(triggers, [1.5, 1.2])) == [(BEGIN, 0)]
    assert triggers.expire(T + 10 * S) == []
    assert short(triggers.expire(T + 12 * S)) == [(END, 0, 1, 1.5)]
    assert triggers.expire(T + 100 * S) == []
