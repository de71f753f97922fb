"""The benchmark's own arithmetic; nothing is timed here."""

from __future__ import annotations

import pytest
from figures import MET, MISSED, SKIPPED, TOLD, Goal, Result, as_json, comparison, median, misses, number, spread, table


def test_median_and_spread() -> None:
    assert median([3.0, 1.0, 2.0]) == 2.0
    assert median([4.0, 1.0, 3.0, 2.0]) == 2.5
    assert spread([8.0, 10.0, 12.0]) == pytest.approx(0.2)
    with pytest.raises(ValueError, match="nothing"):
        median([])


@pytest.mark.parametrize(
    ("goal", "figure", "peers", "value", "holds"),
    [
        (Goal(5.0), 5.0, {}, 5.0, True),
        (Goal(5.0), 5.1, {}, 5.1, False),
        (Goal(700.0, None, "rate"), 700.0, {}, 700.0, True),
        (Goal(700.0, None, "rate"), 699.0, {}, 699.0, False),
        (Goal(0.35, "p"), 2.0, {"p": 8.0}, 0.25, True),
        (Goal(0.35, "p"), 4.0, {"p": 8.0}, 0.5, False),
        (Goal(40.0, "p", "peer"), 2.0, {"p": 80.0}, 40.0, True),
        (Goal(40.0, "p", "peer"), 2.0, {"p": 79.0}, 39.5, False),
        (Goal(2.0, "p", "rate"), 9.0, {"p": 3.0}, 3.0, True),
    ],
)
def test_a_goal_is_a_limit_on_the_figure_or_its_ratio(
    goal: Goal, figure: float, peers: dict[str, float], value: float, holds: bool
) -> None:
    assert goal.value(figure, peers) == value
    assert goal.holds(figure, peers) is holds


def test_ratios_are_of_one_round_each() -> None:
    """GIVEN a machine that is twice as slow in the second round WHEN judged THEN the ratio is what each round said,
    where the ratio of the medians would be another."""
    r = Result("r", "us", (Goal(0.5, "p"),), [1.0, 2.0, 1.0], {"p": [4.0, 8.0, 100.0]})
    ((_, value, holds),) = r.judged()
    assert (value, holds) == (0.25, True)
    assert r.verdict == MET


def test_one_missed_goal_makes_the_row_missed_and_is_named() -> None:
    r = Result("r", "us", (Goal(5.0), Goal(8.0, "p", "peer")), [2.0], {"p": [10.0]})
    assert r.verdict == MISSED
    assert misses([r]) == ["r: 5.00 x, goal >= 8 x cheaper"]
    lines = table([r]).splitlines()
    assert [line.split()[-1] for line in lines[2:]] == [MET, MISSED]
    assert "p 10.0" in lines[3]


def test_a_row_without_its_peer_a_goal_or_a_figure_says_so() -> None:
    lone = Result("lone", "us", (Goal(8.0, "p", "peer"),), [2.0], {}, without={"p": "not installed: p"})
    told = Result("told", "us", (), [2.0], {"floor": [1.0]})
    none = Result("none", "s", (), reason="there is no smoother")
    assert [r.verdict for r in (lone, told, none)] == [TOLD, TOLD, SKIPPED]
    text = table([lone, told, none])
    for words in ("skipped: not installed: p", "2.00 x", "skipped: there is no smoother"):
        assert words in text
    assert misses([lone, told, none]) == []
    assert [x["verdict"] for x in as_json([lone, told, none])] == [TOLD, TOLD, SKIPPED]


def test_two_checkouts_are_compared_pair_by_pair() -> None:
    line = comparison("r", "us", [2.0, 4.0, 2.0], [1.0, 2.0, 3.0])
    assert line == ("r", "us", "2.00", "2.00", "0.500 x", "0.500 ... 1.50")


def test_numbers_keep_three_digits() -> None:
    assert [number(v) for v in (0.01234, 1.234, 12.34, 123.4, 77074.6)] == ["0.012", "1.23", "12.3", "123", "77 075"]
