"""Quantiles and the state machine, fed by hand."""

from __future__ import annotations

import pytest
from scipy.stats import chi2

from edge_agent.fusion.gate import Action, Gate, quantile

S = 1_000_000_000
LIMIT = quantile(0.001, 3)
R = (1e-5, 1e-5, 4e-5)
SLOW = (1e-8, 1e-8, 1e-8)
ZERO = (0.0, 0.0, 0.0)


@pytest.mark.parametrize("alpha", [0.05, 0.01, 0.001, 0.02, 1e-4, 1e-6, 2e-12, 0.3])
@pytest.mark.parametrize("dof", [1, 2, 3])
def test_quantiles(alpha: float, dof: int) -> None:
    assert quantile(alpha, dof) == pytest.approx(chi2.isf(alpha, dof), rel=1e-9)


def test_quantile_says_what_it_needs() -> None:
    with pytest.raises(ValueError, match="alpha"):
        quantile(0.0, 3)
    with pytest.raises(ValueError, match="dof"):
        quantile(0.002, 4)


class Feed:
    def __init__(self) -> None:
        self.gate = Gate()
        self.t = 0
        self.used = 0

    def __call__(
        self,
        level: tuple[float, float, float],
        fits: bool,
        zero: bool = False,
        evidence: float = 0.0,
        confirm: bool = False,
        step_ns: int = S // 10,
    ) -> Action:
        self.t += step_ns
        action = self.gate.judge(
            self.t, fits, zero, evidence, level, R, SLOW, LIMIT, confirm, self.t - self.used, 120 * S, 10 * S
        )
        if action not in (Action.SKIP, Action.CONFIRM, Action.CONSUMED):
            self.used = self.t
        return action


def test_single_outliers_are_dropped_and_forgotten() -> None:
    feed = Feed()
    for k in range(40):
        bad = k % 7 == 3
        level = (0.1 * (k + 1), -0.05 * k, 0.0) if bad else ZERO
        assert feed(level, not bad) == (Action.SKIP if bad else Action.USE)
    assert not feed.gate.open


def test_four_that_agree_open_a_level_even_with_good_ones_between() -> None:
    feed = Feed()
    level = (0.08, 0.0, -0.05)
    got = [
        feed(*a) for a in [(level, False), (ZERO, True), (level, False), (level, False), (ZERO, True), (level, False)]
    ]
    assert got == [Action.SKIP, Action.USE, Action.SKIP, Action.SKIP, Action.USE, Action.OPEN]
    assert feed.gate.level == pytest.approx(level)


def test_the_level_closes_only_on_evidence() -> None:
    feed = Feed()
    for _ in range(4):
        feed((0.02, 0.0, 0.0), False)
    assert feed.gate.open
    # fits at zero now and then mean nothing while the estimated level fits better
    assert {feed((0.02, 0.0, 0.0), True, True, -1.0) for _ in range(20)} == {Action.OFFSET}
    got = [feed(ZERO, False, True, 2.5) for _ in range(3)]
    assert got == [Action.CONSUMED, Action.CONSUMED, Action.CLOSE]
    assert not feed.gate.open


def test_a_new_level_replaces_the_old() -> None:
    feed = Feed()
    for _ in range(4):
        feed((0.1, 0.0, 0.0), False)
    got = [feed((0.0, 0.2, 0.1), False) for _ in range(4)]
    assert got == [Action.SKIP] * 3 + [Action.REOPEN]
    assert feed.gate.level == pytest.approx((0.0, 0.2, 0.1))


def test_a_level_that_holds_becomes_the_datum() -> None:
    feed = Feed()
    for _ in range(4):
        feed((0.1, 0.0, 0.0), False)
    got = [feed((0.1, 0.0, 0.0), True) for _ in range(1202)]
    assert got.index(Action.DATUM) == pytest.approx(1201, abs=1)
    assert not feed.gate.open


def test_levels_that_follow_each_other_do_not_put_the_datum_off_for_ever() -> None:
    feed = Feed()
    actions = []
    for k in range(6000):
        n = k // 1000
        actions.append(feed((0.1 * (n + 1), 0.0, 0.0), k % 1000 > 3))
    assert Action.REOPEN in actions
    assert Action.DATUM in actions


def test_refusals_that_agree_on_nothing_re_open_everything() -> None:
    feed = Feed()
    got = [feed((0.1 * (k + 1) ** 2, 0.0, 0.0), False) for k in range(130)]
    assert Action.REACQUIRE in got
    assert got.index(Action.REACQUIRE) == pytest.approx(100, abs=2)


def test_three_must_agree_after_an_outage() -> None:
    feed = Feed()
    got = [feed((0.3, 0.0, 0.0), True, confirm=True), feed((0.9, 0.0, 0.0), True), feed(ZERO, True)]
    assert got == [Action.CONFIRM] * 3
    assert feed((0.001, 0.0, 0.0), True) == Action.CONFIRM
    assert feed(ZERO, True) == Action.RESUME


def test_three_that_agree_on_another_level_open_it() -> None:
    feed = Feed()
    got = [feed((0.3, 0.0, 0.0), False, confirm=True)] + [feed((0.3, 0.0, 0.0), False) for _ in range(2)]
    assert got == [Action.CONFIRM, Action.CONFIRM, Action.OPEN]


def test_save_and_load() -> None:
    feed = Feed()
    for level in ((0.1, 0.0, 0.0), (0.1, 0.001, 0.0), (0.5, 0.0, 0.0)):
        feed(level, False)
    other = Gate()
    other.load(feed.gate.save())
    assert other.save() == feed.gate.save()


def test_two_misfits_in_a_row_that_agree_are_motion_where_nothing_else_tells() -> None:
    def judged(levels: list[tuple[float, float, float]], follow: bool) -> list[Action]:
        gate = Gate()
        return [
            gate.judge(
                k * S // 10, v == ZERO, v == ZERO, 0.0, v, R, SLOW, LIMIT, False, S // 10, 120 * S, 10 * S, follow
            )
            for k, v in enumerate(levels)
        ]

    near, nearly, far = (0.03, 0.0, 0.0), (0.032, 0.001, 0.0), (0.0, 0.3, 0.0)
    assert judged([near, nearly, ZERO], True) == [Action.SKIP, Action.FOLLOW, Action.USE]
    assert judged([near, far, near], True) == [Action.SKIP] * 3
    assert judged([near, ZERO, nearly], True) == [Action.SKIP, Action.USE, Action.SKIP]
    assert judged([near, nearly, ZERO], False) == [Action.SKIP, Action.SKIP, Action.USE]
