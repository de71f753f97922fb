"""Real receivers' streams through pseudo-terminals into the whole agent: no byte lost, every GGA counted."""

from __future__ import annotations

import gzip
import os
import re
import select
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from live import (
    CLOCK,
    PATIENCE_S,
    Live,
    ScriptedPort,
    decoded,
    faults,
    ledgers,
    parse,
    raws,
    recordings,
    tick,
    until,
    values,
)

import drivers.serial_port
from drivers.serial_port import SerialPort
from edge_agent.replay import replay

FOLDERS = ("A1-*", "A2-*", "A3-*", "A4-*", "A5-*", "A8-*")


def streams(shared_data: Path) -> dict[str, tuple[str, bytes]]:
    """name of a port -> (file, what its receiver sends)."""
    found: dict[str, tuple[str, bytes]] = {}
    for pattern in FOLDERS:
        (folder,) = shared_data.glob(pattern)
        for path in sorted(folder.iterdir()):
            data = path.read_bytes()
            if path.suffix == ".gz":
                data = gzip.decompress(data)
            if "27_05" in path.name:  # published without its first field
                data = b"".join(b"$GPGGA," + line for line in data.splitlines(keepends=True))
            found[f"p{len(found):02d}"] = (path.name, data)
    return found


def gga_by_quality(data: bytes) -> dict[str, int]:
    """`$xxGGA,` with a good checksum anywhere in the bytes, by the digit of its quality."""
    found: Counter[str] = Counter()
    for match in re.finditer(rb"\$(?=([A-Z0-9]{2}GGA,[^*$\r\n]*)\*([0-9A-Fa-f]{2}))", data):
        body, said = match.groups()
        total = 0
        for byte in body:
            total ^= byte
        if total == int(said, 16):
            found[body.split(b",")[6].decode()] += 1
    return dict(found)


class Wires:
    """One pseudo-terminal for each stream."""

    def __init__(self, data: dict[str, bytes]) -> None:
        self.data = data
        self.masters: dict[str, int] = {}
        self.slaves: list[int] = []
        self.devices: dict[str, str] = {}
        for name in data:
            self.masters[name], slave = os.openpty()
            self.slaves.append(slave)  # held, so that a port which opens late meets no hang-up
            self.devices[name] = os.ttyname(slave)
            os.set_blocking(self.masters[name], False)

    def play(self) -> None:
        """Everything, as fast as the readers take it."""
        left = {self.masters[name]: memoryview(data) for name, data in self.data.items() if data}
        while left:
            ready = select.select([], list(left), [], PATIENCE_S)[1]
            assert ready, "no reader takes anything any more"
            for fd in ready:
                left[fd] = left[fd][os.write(fd, left[fd][:4096]) :]
                if not left[fd]:
                    del left[fd]

    def close(self) -> None:
        for fd in (*self.masters.values(), *self.slaves):
            os.close(fd)


class Run:
    """What one run of the agent made of all files."""

    def __init__(self, shared_data: Path, folder: Path) -> None:
        self.files = streams(shared_data)
        self.wires = Wires({name: data for name, (_, data) in self.files.items()})
        ports = "".join(f"  {n}: {{kind: serial, device: {d}}}\n" for n, d in self.wires.devices.items())
        receivers = "".join(f"  r{n}: {{port: {n}}}\n" for n in self.files)
        points = "".join(f"  x{n}: {{receiver: r{n}}}\n" for n in self.files)
        text = (
            f"site: wires\ndata_dir: rec\nports:\n{ports}receivers:\n{receivers}points:\n{points}"
            "record: {inbox_mb: 64, outbox_mb: 256, free_gb: 0}\n"
        )
        settings = parse(text, folder)
        made = {n: SerialPort(s) for n, s in settings.ports.items()}
        with Live(settings, {**made, CLOCK: ScriptedPort()}) as live:
            live.play([tick(time.monotonic_ns())])
            until(lambda: all(p.counters["opens"] for p in made.values()), "every port is open")
            self.wires.play()
            sizes = {n: len(d) for n, (_, d) in self.files.items()}
            until(lambda: {n: live.offered(n)[1] for n in sizes} == sizes, "every byte is read")
            live.play([tick(time.monotonic_ns())])  # no second between: none of them falls silent on a slow machine
        self.wires.close()
        self.counters = live.agent.pipeline.counters()
        self.recordings = recordings(folder / "rec")
        self.said = live.said

    def of(self, part: str) -> str:
        """The port that played the file whose name holds `part`."""
        (port,) = [n for n, (name, _) in self.files.items() if part in name]
        return port


@pytest.fixture(scope="module")
def run(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drivers.serial_port, "COALESCE_S", 0.001)
        yield Run(shared_data, tmp_path_factory.mktemp("wires"))


def test_no_byte_is_lost(run: Run) -> None:
    assert len(run.files) >= 45
    got: dict[str, bytearray] = {name: bytearray() for name in run.files}
    for raw in raws(run.recordings):
        if isinstance(raw.payload, bytes):
            got[raw.source] += raw.payload
    for name, (file, data) in run.files.items():
        assert bytes(got[name]) == data, file
    kinds = {f["kind"] for f in faults(run.recordings)}
    assert not kinds & {"LOSS", "PORT_LOST", "CRASH"}
    for name, ledger in ledgers(run.recordings).items():
        assert ledger["dropped_inbox"] == ledger["refused_outbox"] == 0, name
        assert ledger["bytes"] == len(run.files[name][1]) if name in run.files else name == CLOCK


def test_every_gga_is_counted_by_quality(run: Run) -> None:
    total: Counter[str] = Counter()
    for name, (file, data) in run.files.items():
        mine = {k[-1]: n for k, n in run.counters[f"r{name}"].items() if k.startswith("gga_quality_")}
        theirs = gga_by_quality(data)
        assert mine == theirs, file
        total += Counter(theirs)
        counters = run.counters[f"r{name}"]
        assert counters["bytes"] == len(data)
        rejected = sum(n for k, n in counters.items() if k.startswith("rejected_"))
        assert counters["rejected"] == rejected, file
    # figures that were published with the files
    assert gga_by_quality(run.files[run.of("Messung.log")][1]) == {"1": 592, "4": 4216, "5": 5343, "0": 1}
    assert gga_by_quality(run.files[run.of("rover-2018")][1]) == {"1": 76, "2": 2, "4": 1121, "5": 5}
    assert gga_by_quality(run.files[run.of("27_05")][1]) == {"1": 2, "4": 5908, "5": 40247}
    assert sum(total.values()) > 60_000


def test_damage_is_rejected_with_its_reason(run: Run) -> None:
    told: dict[str, Counter[str]] = {}
    for event in decoded(run.recordings, "/events"):
        if event["kind"] == "REJECT":
            count = told.setdefault(event["source"].removeprefix("r"), Counter())
            count[event["text"].partition(":")[0]] += int(values(event)["count"])
    for name, (file, _) in run.files.items():  # every Reject that was counted has been told, with its reason
        counted = {k.removeprefix("rejected_"): n for k, n in run.counters[f"r{name}"].items() if "rejected_" in k}
        assert dict(told.get(name, {})) == counted, file
    bad = {run.files[n][0]: dict(c) for n, c in told.items()}
    # found by eye in the files; whatever else is in them is whole, or ends in mid-frame and waits for the rest
    assert bad == {
        "tcp-torture.log": {"FIELD": 1},
        "st-teseo-liv4f.log": {"CHECKSUM": 1},
        "nmea2.txt": {"NO_CHECKSUM": 1},
        "pygpsdata-nmeabadck.log": {"CHECKSUM": 2},
        "pygpsdata-nmeabadck2.log": {"CHECKSUM": 1},
        "pygpsdata-BADCK2.log": {"BINARY_CRC": 2},
        "pygpsdata-MIXED3BADCK.log": {"BINARY_CRC": 1},
        "pygpsdata-MIXED-RTCM3BADCRC.log": {"BINARY_CRC": 1},
    }


def test_replay_gives_the_same_bytes(run: Run) -> None:
    report = replay(run.recordings, None, None, True)
    assert report.ok, str(report)
    assert (report.differing, report.missing, report.unexpected, report.unverifiable) == (0, 0, 0, 0)
    assert report.compared > 150_000
