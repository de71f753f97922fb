"""A stop while the service starts is an orderly one: systemd must not show it as failed."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from edge_agent import __main__ as cli


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_stop_before_anything_was_opened_ends_with_0(tmp_path: Path, number: signal.Signals) -> None:
    """GIVEN an agent that still reads its configuration WHEN it is stopped THEN its code is 0 and nothing was begun."""
    code = (
        "import signal, sys, time; from edge_agent import __main__ as cli; "
        "signal.signal(signal.SIGINT, signal.default_int_handler); "  # a shell's background job ignores SIGINT
        "cli._config = lambda args: (print('there', flush=True), time.sleep(3600)); "
        "sys.exit(cli.main(['run', '-c', 'site.yaml']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        process.send_signal(number)
        _, said = process.communicate()
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, said) == (0, "")
    assert list(tmp_path.iterdir()) == []


def test_the_handlers_of_others_are_given_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)]
    (tmp_path / "site.yaml").write_text("site: [\n")
    assert cli.main(["run", "-c", str(tmp_path / "site.yaml")]) == 2
    assert [signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGINT)] == before
    assert "mistake" in capsys.readouterr().err
