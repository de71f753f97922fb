"""Accuracy on simulated records with exact truth: 15 minutes, first 60 s dropped, default settings, nothing tuned.

Bound: the Riccati variance with the true q and r, averaged over the interval between fixes. Oracle: the same filter on
the same record with labelled outliers removed and the wrong fixes' true offsets subtracted.
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from fusion_play import F64, I64, Played, S, play_record
from oracles import accel_q, riccati_bound

from edge_agent.messages import Verdict
from edge_agent.simulate import SCENARIOS, FixLabel, SimRecord, oracle, run

SEEDS = (1, 2, 3, 4, 5, 6)
ROUGH_SEEDS = (1, 2, 3)


@functools.cache
def played(name: str, seed: int) -> tuple[SimRecord, Played]:
    record = run(SCENARIOS[name], seed)
    return record, play_record(record)


def rmse(record: SimRecord, p: Played) -> tuple[F64, F64]:
    """RMSE per axis after the first minute, and all errors."""
    i = np.searchsorted(record.accel.t_ns, p.t)
    assert (record.accel.t_ns[i] == p.t).all()
    error = p.d - record.truth.d_m[i]
    late = p.t > record.fixes.t_ns[0] + 60 * S
    return np.sqrt(np.mean(error[late] ** 2, axis=0)), error


def verdicts(record: SimRecord, p: Played) -> tuple[I64, I64]:
    """Verdict per fix of the record, and its label."""
    of = {i.t_ns: int(i.verdict) for i in p.innovations}
    return np.array([of[int(t)] for t in record.fixes.t_ns]), record.fixes.label.astype(np.int64)


def not_locked_out(record: SimRecord, p: Played) -> None:
    """60 s or more without ACCEPTED or OFFSET while true fixes arrive, or an error above 0.5 m, is a lock-out."""
    verdict, label = verdicts(record, p)
    t = record.fixes.t_ns
    used = (verdict == Verdict.ACCEPTED) | (verdict == Verdict.OFFSET)
    true = t[(label == FixLabel.GOOD) & (verdict != Verdict.START)]
    marks = np.concatenate([[true[0]], t[used], [true[-1]]])
    assert np.diff(marks).max() < 60 * S
    assert np.abs(rmse(record, p)[1]).max() < 0.5


def test_clean_reaches_the_bound() -> None:
    g = SCENARIOS["clean"].gnss
    assert g is not None
    q = accel_q(SCENARIOS["clean"].accels[0].noise)
    bound = np.array([riccati_bound(g.rate_hz, s, q) for s in g.sigma_m])
    ratios = []
    wrong = total = 0
    for seed in SEEDS:
        record, p = played("clean", seed)
        ratios.append(rmse(record, p)[0] / bound)
        verdict, _ = verdicts(record, p)
        wrong += int((verdict == Verdict.REJECTED).sum())
        total += int((verdict != Verdict.START).sum())
        assert [e.kind for e in p.events if e.kind != "MODE"] == ["START"]
    print("clean: live RMSE / bound", np.round(np.mean(ratios), 4), "false rejection", wrong / total)
    assert np.mean(ratios) <= 1.05
    assert wrong / total < 0.003


@pytest.mark.parametrize("seed", ROUGH_SEEDS)
def test_rough_equals_the_oracle(seed: int) -> None:
    record, p = played("rough", seed)
    ideal = oracle(record)
    ratio = rmse(record, p)[0] / rmse(ideal, play_record(ideal))[0]
    verdict, label = verdicts(record, p)
    live = verdict != Verdict.START
    false = np.mean(verdict[live & (label == FixLabel.GOOD)] == Verdict.REJECTED)
    caught = np.mean(verdict[live & (label == FixLabel.OUTLIER)] == Verdict.REJECTED)
    print(
        f"rough {seed}: live / oracle {np.round(ratio, 3)}, false rejection {false:.5f}, outliers rejected {caught:.4f}"
    )
    not_locked_out(record, p)
    assert ratio.max() <= 1.05
    assert false < 0.003
    assert caught >= 0.999


@pytest.mark.parametrize("seed", SEEDS)
def test_hostile_never_locks_out(seed: int) -> None:
    record, p = played("hostile", seed)
    not_locked_out(record, p)
    rms, error = rmse(record, p)
    late = p.t > record.fixes.t_ns[0] + 60 * S
    nees = np.mean((error[late] / p.sd[late]) ** 2)
    worst = 1e3 * np.abs(error[late]).max()
    print(f"hostile {seed}: live RMSE mm {np.round(1e3 * rms, 2)}, largest {worst:.1f}, NEES {nees:.2f}")
    # The study's prototype had a median of 0.96/1.06/1.75 mm on its seeds; twice that is the goal's maximum.
    assert (rms < 2 * np.array([0.0010, 0.0010, 0.0016])).all()
    assert nees < 2.0


def test_hostile_stays_near_the_oracle() -> None:
    ratios = []
    for seed in ROUGH_SEEDS:
        record, p = played("hostile", seed)
        ideal = oracle(record)
        ratios.append(rmse(record, p)[0] / rmse(ideal, play_record(ideal))[0])
    print("hostile: live / oracle", np.round(ratios, 3).tolist())
    assert np.median(ratios) <= 1.25
    assert np.max(ratios) <= 2.0


def test_floaty_stays_near_the_oracle() -> None:
    record, p = played("floaty", 2)
    ideal = oracle(record)
    ratio = rmse(record, p)[0] / rmse(ideal, play_record(ideal))[0]
    print("floaty: live / oracle", np.round(ratio, 3))
    not_locked_out(record, p)
    assert ratio.max() <= 2.0


@pytest.mark.parametrize("seed", [1, 2])
def test_blows_that_the_sampling_misses_do_not_carry_the_filter_away(seed: int) -> None:
    """P0 at 50 Hz: a quiet accelerometer, and once a minute a tap that rises within one of its samples. The velocity
    that is missed must be found by the fixes; believed, it made errors of metres."""
    record = run(SCENARIOS["P0"], seed, 600.0)
    p = play_record(record)
    not_locked_out(record, p)
    rms, _ = rmse(record, p)
    print(f"P0 at 50 Hz, seed {seed}: live RMSE mm {np.round(1e3 * rms, 2)}", p.kinds())
    assert (rms < np.array([0.004, 0.004, 0.008])).all()
    assert len(p.kinds()) <= 12


@pytest.mark.parametrize("name", ["clean", "hostile"])
def test_an_honest_accelerometer_is_never_called_contradicting(name: str) -> None:
    for seed in ROUGH_SEEDS:
        assert "CONTRADICTION" not in played(name, seed)[1].kinds()
