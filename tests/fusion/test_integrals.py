"""First-order hold: exact, at any time, however it was cut."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import first_order_hold

from edge_agent.fusion.integrals import KEEP, ROWS, Ring

S = 1_000_000_000


def samples(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    t = 5 * S + np.cumsum(rng.integers(1_000_000, 9_000_000, n))
    return t, rng.standard_normal((n, 3)) + np.array([0, 0, 9.81])


def fill(ring: Ring, t: np.ndarray, a: np.ndarray, cuts: list[int], p: int = 0) -> None:
    edges = [0, *cuts, len(t)]
    for i, j in pairwise(edges):
        if j > i:
            ring.append([p], t[None, i:j], a[None, i:j], None, [j - i])


@settings(max_examples=50, deadline=None, derandomize=True)
@given(st.lists(st.integers(1, 199), unique=True).map(sorted))
def test_any_cut_gives_the_same_bytes(cuts: list[int]) -> None:
    t, a = samples(200)
    whole, parts = Ring(1), Ring(1)
    fill(whole, t, a, [])
    fill(parts, t, a, cuts)
    assert whole.g[0, :200].tobytes() == parts.g[0, :200].tobytes()


def test_integrals_between_any_two_times_are_exact() -> None:
    t, a = samples(300)
    ring = Ring(1)
    fill(ring, t, a, [100, 130])
    rng = np.random.default_rng(1)
    at = (t - t[0]) / S
    for _ in range(50):
        f, e = np.sort(rng.integers(t[0], t[-1], 2))
        g0, g1 = ring.at(0, int(f))[2], ring.at(0, int(e))[2]
        dt = (e - f) / S
        for axis in range(3):
            v, d = first_order_hold(at, a[:, axis] - a[0, axis], (f - t[0]) / S, (e - t[0]) / S)
            assert g1[3 + axis] - g0[3 + axis] == pytest.approx(v, abs=1e-12)
            assert g1[axis] - g0[axis] - g0[3 + axis] * dt == pytest.approx(d, abs=1e-12)


def test_rebase_changes_the_origin_and_nothing_else() -> None:
    t, a = samples(300)
    ring = Ring(1)
    fill(ring, t, a, [])
    f = int(t[120]) + 777
    times = (f, f + 100_000, t[150] + 5, t[299])
    assert f + 100_000 < t[121]
    before = [ring.at(0, int(v))[2] for v in times]
    ring.rebase(0, f)
    for old, when in zip(before, times, strict=True):
        new = ring.at(0, int(when))[2]
        dt = (int(when) - f) / S
        assert np.allclose(new[3:], old[3:] - before[0][3:], atol=1e-12)
        assert np.allclose(new[:3], old[:3] - before[0][:3] - before[0][3:] * dt, atol=1e-12)
    # rows that come later go on as if they had been there
    late = Ring(1)
    fill(late, t[:200], a[:200], [])
    late.rebase(0, f)
    fill(late, t[200:], a[200:], [40])
    assert late.g[0, 121:300].tobytes() == ring.g[0, 121:300].tobytes()


def test_the_ring_forgets_the_oldest_rows_only() -> None:
    t, a = samples(ROWS + 3000)
    ring = Ring(1)
    fill(ring, t, a, list(range(500, len(t), 500)))
    assert ring.head[0] <= ROWS
    assert ring.covers(0, int(t[-KEEP // 2]))
    assert not ring.covers(0, int(t[-KEEP]))
    with pytest.raises(ValueError, match="outside"):
        ring.at(0, int(t[0]))
    with pytest.raises(ValueError, match="outside"):
        ring.at(0, int(t[-1]) + 1)


def test_unequal_blocks_stacked_equal_each_alone() -> None:
    t1, a1 = samples(60, 1)
    t2, a2 = samples(45, 2)
    both = Ring(2)
    tt, aa = np.zeros((2, 60), np.int64), np.zeros((2, 60, 3))
    tt[0], aa[0] = t1, a1
    tt[1, :45], aa[1, :45] = t2, a2
    tt[1, 45:], aa[1, 45:] = t2[-1], a2[-1]
    both.append([0, 1], tt, aa, None, [60, 45])
    t3, a3 = t2 + (t2[-1] - t2[0]) + S, a2
    both.append([1], t3[None], a3[None], None, [45])
    alone = Ring(1)
    fill(alone, np.concatenate([t2, t3]), np.concatenate([a2, a3]), [45])
    assert both.g[1, :90].tobytes() == alone.g[0, :90].tobytes()
    assert both.head == [60, 90]
