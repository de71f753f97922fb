"""Two agents, or an agent and a repair, must never meet in one folder."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from edge_agent.__main__ import main
from edge_agent.lock import InUseError, hold


def test_the_second_is_told_who_holds_the_folder(tmp_path: Path) -> None:
    fd = hold(tmp_path)
    with pytest.raises(InUseError, match=f"in use by process {os.getpid()}"):
        hold(tmp_path)
    os.close(fd)
    os.close(hold(tmp_path))


def test_run_and_recover_refuse_a_folder_in_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "data"
    data.mkdir()
    torn = data / "a_20260101T000000Z_000.mcap.part"
    torn.write_bytes(b"")
    config = tmp_path / "site.yaml"
    config.write_text("site: a\ndata_dir: data\nports: {gnss: {kind: serial, device: /dev/null}}\n")
    fd = hold(data)
    assert main(["run", "-c", str(config)]) == 2
    assert main(["recover", str(data)]) == 2
    assert main(["recover", str(torn)]) == 2
    assert capsys.readouterr().err.count("is in use by process") == 3
    assert torn.exists()
    os.close(fd)
