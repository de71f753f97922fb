"""The words that systemd hears, on a socket of our own."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from edge_agent.notify import Notifier


@pytest.mark.parametrize("abstract", [False, True])
def test_lines_arrive_as_one_datagram(tmp_path: Path, abstract: bool) -> None:
    path = f"edge-agent-{tmp_path.name}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.settimeout(10)
        server.bind("\0" + path if abstract else path)
        Notifier("@" + path if abstract else path).send("READY=1", "STATUS=ok")
        assert server.recv(100) == b"READY=1\nSTATUS=ok"


def test_nobody_listens_and_nothing_happens(tmp_path: Path) -> None:
    Notifier(None).send("READY=1")
    Notifier(str(tmp_path / "gone")).send("READY=1")


def test_a_supervisor_that_does_not_read_holds_nobody_up(tmp_path: Path) -> None:
    path = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as server:
        server.bind(path)
        notifier = Notifier(path)
        for i in range(1000):  # many times what the kernel queues; blocking would never end
            notifier.send(f"STATUS={i}")
        assert server.recv(100) == b"STATUS=0"
