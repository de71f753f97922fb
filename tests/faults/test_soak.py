"""The soak itself runs: half a minute of simulated time, so that it has not rotted when it is wanted."""

from __future__ import annotations

from pathlib import Path

import soak


def test_it_runs_balances_and_says_that_it_was_too_short(tmp_path: Path) -> None:
    assert soak.soak(soak.PATIENCE_S, 30, tmp_path) == ["it ended before the first simulated hour"]
    names = [p.name for p in (tmp_path / "data").iterdir()]
    assert any(name.endswith(".mcap") for name in names)
