"""A real CAN recording through an slcan pseudo-terminal, and through import and replay: every acceleration arrives."""

from __future__ import annotations

import csv
import select
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from live import CAN, CLOCK, Live, ScriptedPort, faults, ledgers, parse, recordings, stored, tick, until

from drivers.can_port import CanPort
from edge_agent.importer import import_logs
from edge_agent.messages import F64, CanFlag, Config
from edge_agent.recording import topics
from edge_agent.replay import replay
from edge_agent.simulate.play import Slcan, Terminal, slcan_frame

NAME = "00000005-60FEB5A8"
FRAMES, SAMPLES = 5477, 4518


@pytest.fixture
def folder(shared_data: Path) -> Path:
    return shared_data / "D1-canedge-imu-mf4"


def site(folder: Path, data_dir: Path, device: str = "none") -> Config:
    text = (
        "site: imu\ndata_dir: rec\n"
        f"ports: {{can: {{kind: can, interface: slcan, channel: {device}, drain_ms: 5, block_ms: 20}}}}\n"
        "accelerometers: {imu: {port: can, dbc: canmod-gps.dbc, signals: "
        "[gnss_imu.AccelerationX, gnss_imu.AccelerationY, gnss_imu.AccelerationZ]}}\n"
        "points: {car: {accelerometer: imu}}\nrecord: {accel_block: true, free_gb: 0}\n"
    )
    return parse(text, data_dir, {"canmod-gps.dbc": (folder / "canmod-gps.dbc").read_bytes()})


def published(folder: Path) -> F64:
    """(4518, 3) m/s2, as another decoder found them."""
    with (folder / "derived" / f"{NAME}.gnss_imu.csv").open() as f:
        rows = [[float(row[f"Acceleration{axis}"]) for axis in "XYZ"] for row in csv.DictReader(f)]
    assert len(rows) == SAMPLES
    return np.array(rows)


def accelerations(files: list[Path]) -> tuple[F64, F64]:
    blocks = [topics.decode_accel_block("imu", s.data) for s in stored(files, "/accel/imu/block")]
    return np.concatenate([b.xyz for b in blocks]), np.concatenate([b.t_ns for b in blocks])


def adapter_lines(folder: Path) -> bytes:
    out = []
    for line in (folder / "derived" / f"{NAME}.candump.log").read_text().splitlines():
        can_id, _, data = line.split()[2].partition("#")
        out.append(slcan_frame(int(can_id, 16), CanFlag.EXT if len(can_id) == 8 else 0, bytes.fromhex(data)))
    assert len(out) == FRAMES
    return b"".join(out)


def serve(terminal: Terminal, data: bytes, ended: threading.Event) -> None:
    """Answer the host's commands; once it has opened the channel, send everything as fast as it is taken."""
    at = 0
    while not ended.is_set():
        wait_write = [terminal] if terminal.ready and at < len(data) else []
        readable, writable, _ = select.select([terminal] if terminal.listened else [], wait_write, [], 0.01)
        if readable:
            terminal.serve()
        if writable:
            piece = data[at : at + 1024]
            terminal.send(piece)
            at += len(piece)
            while terminal._pending and not ended.is_set():
                select.select([], [terminal], [], 0.01)
                terminal.serve()


def test_through_an_slcan_adapter(folder: Path, tmp_path: Path) -> None:
    terminal, ended = Terminal(Slcan()), threading.Event()
    settings = site(folder, tmp_path, terminal.path)
    player = threading.Thread(target=serve, args=(terminal, adapter_lines(folder), ended))
    player.start()
    try:
        can = CanPort(settings.ports["can"])
        with Live(settings, {CAN: can, CLOCK: ScriptedPort()}) as live:
            live.play([tick(time.monotonic_ns())])
            until(lambda: can.counters["frames"] >= FRAMES, "every frame is read")
            until(lambda: live.offered(CAN)[0] == can.counters["blocks"], "every block is handed on")
            live.play([tick(time.monotonic_ns())])  # no second between: the bus cannot fall silent on a slow machine
    finally:
        ended.set()
        player.join()
        terminal.close()
    files = recordings(tmp_path / "rec")
    xyz, t_ns = accelerations(files)
    assert np.array_equal(xyz.astype(np.float32), published(folder).astype(np.float32))
    assert (np.diff(t_ns) > 0).all()
    assert can.counters["frames"] == FRAMES
    assert terminal.lost == terminal.unheard == 0
    assert can.counters["malformed"] == 0
    assert not faults(files, "LOSS")
    ledger = ledgers(files)[CAN]
    assert ledger["received"] == can.counters["blocks"]
    assert ledger["dropped_inbox"] == ledger["refused_outbox"] == ledger["dropped_kernel"] == 0
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    # Into how many blocks they fell is the machine's affair: a block is whatever one read found waiting, even all.
    assert report.compared == report.derived >= len(stored(files, "/accel/imu/block")) > 0


def test_through_import_and_replay(folder: Path, tmp_path: Path) -> None:
    settings = site(folder, tmp_path)
    log = folder / "derived" / f"{NAME}.candump.log"
    done = import_logs(tmp_path / "raw.mcap", can=[("can", log, None)], config=settings)
    assert done.lost == 0
    replay([tmp_path / "raw.mcap"], tmp_path / "out.mcap", None, False)
    xyz, t_ns = accelerations([tmp_path / "out.mcap"])
    assert np.array_equal(xyz.astype(np.float32), published(folder).astype(np.float32))
    assert (np.diff(t_ns) > 0).all()
    assert replay([tmp_path / "out.mcap"], None, None, True).ok
