"""Columns of many messages against the decoder of single ones."""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.messages import Estimate, GnssFix, Quality
from edge_agent.recording import topics
from edge_agent.review.columns import groups


def estimate(n: int, seed: int) -> Estimate:
    rng = np.random.default_rng(seed)
    x = [rng.standard_normal((n, 3)) for _ in range(4)]
    t = 10**15 + np.cumsum(rng.integers(1, 10**7, n))
    mode, flags = rng.integers(0, 7, n).astype(np.uint8), rng.integers(0, 31, n).astype(np.uint8)
    return Estimate("p", t, *x, mode, flags, *(rng.standard_normal(3) for _ in range(4)), 2)


def test_blocks_of_different_lengths_come_apart_and_back() -> None:
    estimates = [estimate(n, i) for i, n in enumerate((25, 24, 25, 1, 26, 25))]
    messages = [topics.fused_block(e, int(e.t_ns[0]), frame) for e, frame in zip(estimates, "aaabaa", strict=True)]
    seen: set[int] = set()
    for g in groups(topics.FUSED_BLOCK, messages):
        for k, row in enumerate(g.rows.tolist()):
            want = topics.decode_fused_block("p", messages[row])
            seen.add(row)
            assert (g.columns["monotonic_ns"][k] + g.columns["t_offset_ns"][k] == want.t_ns).all()
            assert (g.columns["velocity_y_mps"][k] == want.velocity_mps[:, 1]).all()
            assert (g.columns["mode"][k] == want.mode).all()
            assert g.columns["offset_m.z"][k, 0] == pytest.approx(want.offset_m[2])
            assert g.columns["revision"][k, 0] == 2
    assert seen == set(range(6))


def test_strings_of_equal_length_sums_do_not_mix() -> None:
    """Two solutions of one size whose strings end elsewhere: each is read by its own layout."""

    def solution(frame: str, station: str, satellites: int) -> bytes:
        fix = GnssFix(
            1, 2, 3, True, 46.5, 7.5, 610.0, 50.0, Quality.FIXED, satellites, 0.7, 1.2, 1.0, 1.5, station,
            (0.01, 0.02, 0.03), (0.001, 0.001, 0.001), ("GGA",),
        )  # fmt: skip
        return topics.gnss_solution(fix, 5 * 10**9, (1.0, 2.0, 3.0), 60_000_000, frame)

    messages = [solution("rover", "0001", 20 + i) for i in range(3)] + [solution("rover12345678", "0001", 30)]
    messages += [solution("rover", "000112345678", 40)]
    assert len(messages[3]) == len(messages[4])
    found = {}
    for g in groups(topics.GNSS_SOLUTION, messages):
        for k, row in enumerate(g.rows.tolist()):
            found[row] = int(g.columns["satellites"][k, 0]), float(g.columns["north_m"][k, 0])
            decoded = topics.decode(topics.GNSS_SOLUTION, messages[row])
            assert g.columns["std_enu_m.y"][k, 0] == pytest.approx(decoded["std_enu_m"]["y"])
            assert g.columns["fix"][k, 0] == decoded["fix"] == Quality.FIXED
    assert found == {0: (20, 2.0), 1: (21, 2.0), 2: (22, 2.0), 3: (30, 2.0), 4: (40, 2.0)}


def test_damaged_messages_are_refused() -> None:
    e = estimate(5, 1)
    data = topics.fused_block(e, int(e.t_ns[0]))
    with pytest.raises(ValueError, match="ends inside"):
        groups(topics.FUSED_BLOCK, [data[:60]])
    with pytest.raises(ValueError, match="not a CDR"):
        groups(topics.FUSED_BLOCK, [b"\7\7" + data[2:]])
