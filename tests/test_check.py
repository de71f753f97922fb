"""`edge-agent check --live` on pseudo-terminals, a TCP server and fakes; what it says, and what it must not do."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from live import PATIENCE_S, parse

from drivers import PortError
from edge_agent import check, lock
from edge_agent.__main__ import main
from edge_agent.check import guess_baud, live, today
from edge_agent.judge import BAD, GOOD, NOTE, Finding
from edge_agent.messages import CanFlag, PortSettings, S
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import Wiring, config_yaml, dbc_text, nmea_epoch
from edge_agent.simulate.play import Slcan, Terminal, can_schedule, serial_schedule, slcan_frame

SECONDS = 1.0


BYTES, FRAMES = 2000, 100
"""What comes of one port in one second of `steady_time`."""


@pytest.fixture(autouse=True)
def steady_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """A port is listened to until so much came, not for a time: this machine may be busy."""
    end = time.monotonic() + PATIENCE_S

    def monotonic() -> float:
        assert time.monotonic() < end, "nothing comes any more"
        listener = threading.current_thread()
        assert isinstance(listener, check.Listener)
        if listener.settings.kind == "clock":
            reads[listener] = reads.get(listener, 0) + 1
            return 0.5 * reads[listener]
        payloads = [raw.payload for raw in listener.raws]
        return sum(len(p) / BYTES if isinstance(p, bytes) else p.t_ns.size / FRAMES for p in payloads)

    reads: dict[threading.Thread, int] = {}
    monkeypatch.setattr(check, "time", SimpleNamespace(monotonic=monotonic))


@contextmanager
def playing(*parts: tuple[Terminal, list[tuple[int, bytes]]]) -> Iterator[None]:
    """Play schedules again and again, from the moment on at which somebody listens."""
    stop = threading.Event()

    def run() -> None:
        begun = [0.0] * len(parts)
        at = [0] * len(parts)
        while not stop.is_set():
            for i, (terminal, schedule) in enumerate(parts):
                terminal.serve()
                if not terminal.ready:
                    begun[i] = 0.0
                    continue
                now = time.monotonic_ns()
                if not begun[i]:
                    begun[i], at[i] = now, 0
                while at[i] < len(schedule) and schedule[at[i]][0] - schedule[0][0] <= now - begun[i]:
                    terminal.send(schedule[at[i]][1])
                    at[i] += 1
            time.sleep(0.002)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        for terminal, _ in parts:
            terminal.close()


@pytest.fixture
def bridge(tmp_path: Path) -> Iterator[Path]:
    """A configuration whose receiver and CAN adapter play."""
    serial, adapter = Terminal(), Terminal(Slcan())
    scenario = SCENARIOS["clean"]
    (tmp_path / "accelerometers.dbc").write_text(dbc_text(scenario))
    text = config_yaml(scenario, wiring=Wiring(serial.path, "slcan", adapter.path))
    (tmp_path / "site.yaml").write_text(text.replace("rate_hz: 100.0\n", "\n") + "record: {free_gb: 0, keep_gb: 1}\n")
    record = simulate("clean", 1, 20.0)
    with playing((serial, serial_schedule(record)), (adapter, can_schedule(record, adapter))):
        yield tmp_path / "site.yaml"


def test_live_says_what_arrives(bridge: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """GIVEN a receiver and a sensor that play WHEN checked live THEN each is judged, nothing made, all released."""
    for _ in range(2):
        code = main(["check", "--live", "-c", str(bridge), "--seconds", str(SECONDS), "--json"])
        out, err = capsys.readouterr()
        result = json.loads(out)
        text = "\n".join(f"{f['level']} {f['path']}: {f['text']}" for f in result["live"])
        assert re.search(r"good ports.gnss: \d+ bytes/s: .*GNGGA", text)
        assert re.search(r"good receivers.rover: \S+ fixes.*: fixed 100 %; 18 satellites", text)
        assert re.search(r"good ports.can: \S+ frames/s, at most \d+ % of what the bus can carry", text)
        assert re.search(r"good accelerometers.acc: gravity 9.8\d m/s2 on \+z", text)
        bad = [f for f in result["live"] if f["level"] == BAD and f["path"] != "receivers.rover.latency_ms"]
        assert bad == []  # the record's time is not today's
        assert (code == 0) == result["ok"]
        assert "listening to gnss, can for 1 s" in err
    assert sorted(p.name for p in bridge.parent.iterdir()) == ["accelerometers.dbc", "site.yaml"]


def test_the_text_fits_a_terminal_of_80_columns(bridge: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["check", "--live", "-c", str(bridge), "--seconds", "0.5"]
    turned = ["--set", "accelerometers.acc.rotation=[[0, 0, 1], [1, 0, 0], [0, 1, 0]]"]
    assert main([*arguments, *turned]) == 1
    lines = capsys.readouterr().out.splitlines()[1:]
    assert all(len(line) <= 80 for line in lines), lines
    (turned_line,) = [line for line in lines if line.startswith("  BAD   rotation")]
    assert re.match(
        r"  BAD   rotation: gravity is not on z but at \(9\.\d, -?0\.\d, -?0\.\d\): the sensor's", turned_line
    )
    assert re.match(r"found wanting: \d BAD above", lines[-1])


def test_real_recordings_through_pseudo_terminals(shared_data: Path, tmp_path: Path) -> None:
    """GIVEN a receiver of 2013 in a tram and an inertial unit in a car THEN what is wrong for a bridge is told."""
    log = (shared_data / "A1-dresden-10hz-gga-gst" / "Messg_4.log").read_bytes()[:60_000]
    folder = shared_data / "D1-canedge-imu-mf4"
    frames = []
    for line in (folder / "derived" / "00000005-60FEB5A8.candump.log").read_text().splitlines()[:2000]:
        stamp, _, frame = line.split()[:3]
        can_id, _, data = frame.partition("#")
        flags = CanFlag.EXT if len(can_id) == 8 else 0
        t_ns = round(float(stamp.strip("()")) * S)
        frames.append((t_ns, slcan_frame(int(can_id, 16), flags, bytes.fromhex(data))))
    serial, adapter = Terminal(), Terminal(Slcan())
    made = parse(
        "site: s\ndata_dir: rec\nrecord: {free_gb: 0}\n"
        f"ports: {{gnss: {{kind: serial, device: {serial.path}}}, "
        f"can: {{kind: can, interface: slcan, channel: {adapter.path}}}}}\n"
        "receivers: {rover: {port: gnss}}\n"
        "accelerometers: {imu: {port: can, dbc: canmod-gps.dbc, signals: "
        "[gnss_imu.AccelerationX, gnss_imu.AccelerationY, gnss_imu.AccelerationZ]}}\n",
        tmp_path,
        {"canmod-gps.dbc": (folder / "canmod-gps.dbc").read_bytes()},
    )
    schedule = [(i * S // 2000, log[i * 10 : i * 10 + 10]) for i in range(len(log) // 10)]
    with playing((serial, schedule), (adapter, frames)):
        found = live(made, SECONDS)
    told = "\n".join(f"{f.level} {f.where}: {f.text}" for f in found)
    assert re.search(r"good ports.gnss: \d+ bytes/s: GPG(GA|ST) ", told)
    assert re.search(r"good receivers.rover: 10 fixes/s: ", told)
    assert "good receivers.rover: one step of the last decimal is " in told or "too coarse" in told
    assert re.search(r"good ports.can: 0x9 \S+/s of \S+ bytes \(gnss_imu\) -> imu", told)
    assert "bad accelerometers.imu.rotation: gravity is not on z" in told
    assert "note ports.can: recorded, decoded by nobody: 0x" in told


def test_nobody_reads_beside_the_service(bridge: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each of two readers would get a part of the bytes."""
    held = lock.hold(bridge.parent / "recordings")
    try:
        assert main(["check", "--live", "-c", str(bridge), "--seconds", "0.5"]) == 2
        out, err = capsys.readouterr()
        assert out == ""
        assert f"the agent runs (process {os.getpid()}, " in err
        assert "stop it first: systemctl stop edge-agent" in err
        assert main(["check", "-c", str(bridge)]) == 0  # the text alone may be checked
    finally:
        os.close(held)


def test_no_service_starts_meanwhile(tmp_path: Path) -> None:
    os.close(lock.hold(tmp_path))
    with check.hold_off(tmp_path), pytest.raises(lock.InUseError):
        lock.hold(tmp_path)
    os.close(lock.hold(tmp_path))
    with check.hold_off(tmp_path / "none"):
        assert not (tmp_path / "none").exists()


def test_seconds_that_are_none(bridge: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in ("0", "-1", "nan", "1e9"):
        assert main(["check", "--live", "-c", str(bridge), "--seconds", wrong]) == 2
    assert "0.1 to 3600" in capsys.readouterr().err


PORTS = """
site: s
data_dir: rec
ports: {gone: {kind: serial, device: DEVICE}, gnss: {kind: serial, device: "URL"}}
receivers: {rover: {port: gnss}}
record: {free_gb: 0}
"""


def test_a_port_that_cannot_be_opened_hides_no_other(tmp_path: Path) -> None:
    """GIVEN a device that is not there beside a receiver on the network THEN each is told."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        url = f"socket://127.0.0.1:{server.getsockname()[1]}"

        def serve() -> None:
            utc_ns = 1_780_300_800_000_000_000
            with server.accept()[0] as client, contextlib.suppress(OSError):  # until the check has heard enough
                while True:
                    client.sendall(nmea_epoch(utc_ns, (46.5, 7.5, 610.0), (0.01,) * 3))
                    utc_ns += 100_000_000
                    time.sleep(0.005)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        made = parse(PORTS.replace("DEVICE", str(tmp_path / "tty")).replace("URL", url), tmp_path)
        found = live(made, 0.3)
        thread.join()
    by_port = {f.where: f for f in found if f.where.startswith("ports.")}
    assert by_port["ports.gone"].level == BAD
    assert by_port["ports.gone"].text.startswith(f"no such device {tmp_path / 'tty'}; ")
    assert by_port["ports.gnss"].level == GOOD
    assert "GNGGA" in by_port["ports.gnss"].text


# --------------------------------------------------------------------------------------------------------- baud rate


class Wired:
    """A serial device whose other end speaks at one baud rate; every opening is noted."""

    def __init__(self, true_baud: int, opened: list[int]) -> None:
        self.true_baud, self.opened = true_baud, opened

    def __call__(self, settings: PortSettings) -> Any:
        def read() -> list[tuple[int, bytes]]:
            good = nmea_epoch(1_780_300_800_000_000_000, (46.5, 7.5, 610.0), (0.01, 0.01, 0.01))
            return [(time.monotonic_ns(), good if settings.baud == self.true_baud else b"\x80\xf8\x00\x1e" * 20)]

        def tick() -> list[tuple[int, Any]]:
            return []

        if settings.kind == "clock":
            return SimpleNamespace(open=lambda: None, read=tick, close=lambda: None)
        return SimpleNamespace(open=lambda: self.opened.append(settings.baud), read=read, close=lambda: None)


@pytest.mark.parametrize("true_baud", [4800, 9600, 460800])
def test_the_baud_rate_is_found_and_that_of_the_configuration_restored(true_baud: int) -> None:
    opened: list[int] = []
    port = PortSettings("gnss", "serial", device="/dev/x", baud=115200)
    assert guess_baud(port, Wired(true_baud, opened), 0.01) == true_baud
    assert opened[-2:] == [true_baud, 115200]


def test_no_baud_rate_is_made_up() -> None:
    opened: list[int] = []
    assert guess_baud(PortSettings("gnss", "serial", device="/dev/x"), Wired(1200, opened), 0.01) is None
    assert opened == [*check.BAUDS[1:], 115200]


def test_garbage_is_told_with_the_baud_rate_that_would_be_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(check, "BAUD_S", 0.01)
    made = parse(PORTS.replace("DEVICE", "/dev/a").replace("URL", "/dev/b"), tmp_path)
    found = live(made, 0.01, Wired(9600, []))
    told = {f.where: f.text for f in found if f.level == BAD}
    assert told["ports.gnss.baud"] == "at 9600 baud good ones come: write baud: 9600"
    made = parse(PORTS.replace("DEVICE", "/dev/a").replace("URL", "socket://h:1"), tmp_path)
    assert "ports.gnss.baud" not in {f.where for f in live(made, 0.01, Wired(9600, []))}  # it has none


def test_a_device_that_is_lost_while_listening_is_told_with_what_came(tmp_path: Path) -> None:
    class Torn:
        def __init__(self, settings: PortSettings) -> None:
            self.left = 3
            self.clock = settings.kind == "clock"

        def open(self) -> None: ...

        def close(self) -> None: ...

        def read(self) -> list[tuple[int, bytes]]:
            self.left -= 1
            if self.left < 0 and not self.clock:
                raise PortError(5, "port gnss: lost /dev/b: hung up")
            return [] if self.clock else [(1, nmea_epoch(0, (46.5, 7.5, 610.0), (0.01, 0.01, 0.01)))]

    made = parse(PORTS.replace("DEVICE", "/dev/a").replace("URL", "/dev/b"), tmp_path)
    found = [f for f in live(made, 1.0, Torn) if f.where == "ports.gnss"]
    assert [f.level for f in found] == [BAD, GOOD]
    assert found[0].text == "lost /dev/b: hung up"


def test_a_flood_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(check, "LISTEN_BYTES", 1000)
    port = PortSettings("gnss", "serial", device="/dev/x")
    (one,) = check.listen([port], 3600.0, Wired(115200, []))
    assert sum(len(r.payload) for r in one.raws if isinstance(r.payload, bytes)) < 2000


# -------------------------------------------------------------------------------------------------------------- today


@pytest.fixture
def large_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=20e9, total=32e9))


@pytest.mark.usefixtures("large_disk")
def test_what_is_not_there_today_is_a_note_and_no_mistake(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = PORTS.replace("DEVICE", "/dev/null").replace("URL", str(tmp_path / "ttyNONE"))
    text = text.replace("ports: {", "ports: {can: {kind: can, channel: nocan0}, ")
    (tmp_path / "site.yaml").write_text(text)
    assert main(["check", "-c", str(tmp_path / "site.yaml")]) == 0
    _, *notes = capsys.readouterr().out.splitlines()
    assert [n.partition(" is not there")[0] for n in notes] == [
        "note: ports.can: no receiver or accelerometer reads it: recorded, not decoded",
        "note: ports.gone: no receiver or accelerometer reads it: recorded, not decoded",
        "note: receivers.rover: no point uses it: recorded, not fused",
        "note: points: none: nothing is fused",
        "note: ports.can.channel: no network interface nocan0 now",
        f"note: ports.gnss.device: {tmp_path / 'ttyNONE'}",
    ]


@pytest.mark.usefixtures("large_disk")
def test_two_names_of_one_device_are_told(tmp_path: Path) -> None:
    (tmp_path / "by-id").symlink_to("/dev/null")
    made = parse(PORTS.replace("DEVICE", "/dev/null").replace("URL", str(tmp_path / "by-id")), tmp_path)
    assert [(f.where, f.text) for f in today(made)] == [
        ("ports.gnss.device", f"{tmp_path / 'by-id'} and the device of ports.gone are one: /dev/null")
    ]


@pytest.mark.parametrize(
    ("free", "total", "level", "where"),
    [
        (20e9, 32e9, None, ""),
        (0.5e9, 32e9, BAD, "record.free_gb"),
        (5e9, 8e9, NOTE, "record.keep_gb"),
    ],
)
def test_a_disk_that_is_too_small_is_told(
    free: float, total: float, level: str | None, where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = parse(PORTS.replace("DEVICE", "/dev/null").replace("URL", "/dev/zero").replace("free_gb: 0", ""), tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=free, total=total))
    assert [(f.level, f.where) for f in today(made)] == ([(level, where)] if level else [])


def test_a_data_dir_that_cannot_be_written_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "rec").write_text("a file")
    made = parse(PORTS.replace("DEVICE", "/dev/null").replace("URL", "/dev/zero"), tmp_path)
    assert [f.text for f in today(made)] == [f"{tmp_path / 'rec'} is no folder"]
    (tmp_path / "rec").unlink()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    (found,) = [f for f in today(made) if f.where == "data_dir"]
    assert f"may not make it below {tmp_path}" in found.text


# --------------------------------------------------------------------------------------------------------------- text


def test_findings_of_one_sensor_stand_together() -> None:
    found = [
        Finding(GOOD, "ports.a", "1"),
        Finding(BAD, "receivers.r.latency_ms", "2"),
        Finding(NOTE, "ports.a.baud", "3"),
        Finding(GOOD, "receivers.r", "word " * 30),
    ]
    assert check.as_text(found).splitlines() == [
        "ports.a",
        "  ok    1",
        "  note  baud: 3",
        "receivers.r",
        "  BAD   latency_ms: 2",
        "  ok    " + "word " * 13 + "word",
        "        " + "word " * 13 + "word",
        "        word word",
    ]


def test_the_state_of_a_can_controller_is_read_from_iproute2(monkeypatch: pytest.MonkeyPatch) -> None:
    can0 = {"info_kind": "can", "info_data": {"state": "BUS-OFF", "bittiming": {"bitrate": 250000}}}
    answers = [[{"linkinfo": can0}], [], [{}], [{"linkinfo": {"info_kind": "vcan"}}]]

    def run(command: list[str], **options: Any) -> Any:
        assert command[-2:] == ["dev", "can0"]
        return SimpleNamespace(stdout=json.dumps(answers.pop(0)).encode())

    monkeypatch.setattr(check.subprocess, "run", run)
    assert check.link_state("can0") == {"state": "BUS-OFF", "bitrate": 250000}
    for _ in range(3):
        assert check.link_state("can0") == {}
    monkeypatch.undo()
    assert check.link_state("no-such-interface") == {}
