"""Noise of several records found side by side is that of each alone, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from edge_agent.review.likelihood import fit, fits
from edge_agent.review.smooth import NO_ACCELERATIONS, Accelerations, Fixes, plain


def record(seed: int, seconds: int, lost: float, gap: bool) -> tuple[Fixes, Accelerations]:
    """Noise at 5 Hz and 50 Hz, some fixes lost."""
    rng = np.random.default_rng(seed)
    t = np.arange(seconds * 50, dtype=np.int64) * 20_000_000
    t = t[(t < 8e9) | (t > 12e9)] if gap else t
    at = np.arange(seconds * 5, dtype=np.int64) * 200_000_000
    at = at[rng.uniform(size=len(at)) >= lost]
    z = rng.standard_normal((len(at), 3)) * 0.003
    z[7, 1] = np.nan
    return plain(at, z, 0.002 + 0.001 * seed), Accelerations(t, rng.standard_normal((len(t), 3)) * 0.01)


@pytest.mark.parametrize("r", [None, 1.0])
def test_side_by_side_is_each_alone(r: float | None) -> None:
    records = [record(1, 30, 0.0, False), record(2, 30, 0.0, True), record(3, 22, 0.2, False)]
    records.append((records[0][0], NO_ACCELERATIONS))
    for part in (records[:2], records):  # the same times, and different ones
        for together, alone in zip(fits(part, r=r, most=60), (fit(*one, r=r, most=60) for one in part), strict=True):
            assert together.fixes == alone.fixes
            for a, b in (
                (together.noise.q, alone.noise.q),
                (together.noise.qb, alone.noise.qb),
                (together.r, alone.r),
                (together.log_likelihood, alone.log_likelihood),
            ):
                assert a.tolist() == b.tolist()
    assert fits([]) == []
