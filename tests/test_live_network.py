"""A receiver behind a TCP server whose connection is lost again and again: every byte is recorded, every loss told."""

from __future__ import annotations

import random
import socket
import threading
import time
from pathlib import Path

import pytest
from live import CLOCK, Live, ScriptedPort, faults, parse, raws, recordings, tick, until

from drivers.serial_port import SerialPort
from edge_agent import reading
from edge_agent.simulate import simulate
from edge_agent.simulate.encode import nmea_bursts

CONNECTIONS = 4


def test_every_byte_of_a_network_receiver_is_recorded_across_lost_connections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "BACKOFF_S", (0.01, 0.02))
    stream = b"".join(data for _, data in nmea_bursts(simulate("clean", 4, 20.0)))
    cuts = sorted(random.Random(4).sample(range(1, len(stream)), CONNECTIONS - 1))
    pieces = [stream[i:j] for i, j in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"
        settings = parse(
            f"site: s\ndata_dir: rec\nports: {{gnss: {{kind: serial, device: '{url}'}}}}\n"
            "receivers: {rover: {port: gnss}}\npoints: {p: {receiver: rover}}\nrecord: {free_gb: 0}\n",
            tmp_path,
        )
        port = SerialPort(settings.ports["gnss"])
        ended = threading.Event()

        def serve() -> None:
            for n, piece in enumerate(pieces, 1):
                client = server.accept()[0]
                until(lambda n=n: port.counters["opens"] == n, "an open port")  # what comes before is thrown away
                client.sendall(piece)
                if n == CONNECTIONS:
                    ended.wait()
                client.close()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        with Live(settings, {"gnss": port, CLOCK: ScriptedPort()}) as live:
            live.play([tick(time.monotonic_ns())])  # the only one: a slow server must not look like silence
            until(lambda: live.offered("gnss")[1] == len(stream), "every byte is read")
        ended.set()
        thread.join()
    files = recordings(tmp_path / "rec")
    assert b"".join(r.payload for r in raws(files) if isinstance(r.payload, bytes)) == stream
    told = [f["kind"] for f in faults(files) if f["kind"].startswith("PORT_")]
    assert told == ["PORT_LOST", "PORT_OPEN"] * (CONNECTIONS - 1)
    (text,) = {f["text"] for f in faults(files, "PORT_LOST")}
    assert text.startswith(f"port gnss: lost {url}: ")
    assert live.agent.pipeline.counters()["rover"]["accepted"] == stream.count(b"$")
    assert live.balance() == {}
