"""What a site does to an agent: kills, pulled plugs, garbage, full disks, stepping clocks. The recording stays true."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live import (
    CAN,
    CLOCK,
    GNSS,
    PATIENCE_S,
    Live,
    decoded,
    faults,
    ledgers,
    ports,
    raws,
    recordings,
    settings,
    stored,
    until,
    values,
)

import drivers.serial_port
from drivers.serial_port import SerialPort
from edge_agent import reading, writing
from edge_agent.__main__ import main
from edge_agent.messages import PortSettings, Raw, Record, Rotate, S, Tick
from edge_agent.recording import segments, topics, writer
from edge_agent.recording.reader import CHUNK, DamagedError, info, parts, read_metadata
from edge_agent.replay import replay
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import Wiring, config_yaml, dbc_text, raw_blocks
from edge_agent.simulate.play import Sink, Slcan, Terminal, can_schedule, play, serial_schedule, wait_ready
from edge_agent.simulate.specs import START_NS
from edge_agent.verify import verify

SCENARIO = SCENARIOS["clean"]


@pytest.fixture(scope="module")
def script() -> list[Raw]:
    return list(raw_blocks(simulate("clean", 1, 35.0)))


def lost_at_the_disk(files: list[Path]) -> dict[str, int]:
    found: dict[str, int] = {}
    for f in faults(files, "LOSS"):
        assert f["text"].endswith("at disk")
        found[f["source"]] = found.get(f["source"], 0) + int(values(f)["count"])
    return found


# ---------------------------------------------------------------------------------------------------------------- kill


class Site:
    """A real agent process on pseudo-terminals, under the load of a simulated bridge."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.serial, self.can = Terminal(), Terminal(Slcan())
        (folder / "a.dbc").write_text(dbc_text(SCENARIO))
        wiring = Wiring(self.serial.path, "slcan", self.can.path)
        text = config_yaml(SCENARIO, dbc="a.dbc", site="site", data_dir="rec", wiring=wiring)
        (folder / "site.yaml").write_text(f"{text}record: {{free_gb: 0, flush_s: 0.2, rotate_s: 2}}\n")
        self.rec = folder / "rec"

    @contextlib.contextmanager
    def run(self, seed: int) -> Iterator[subprocess.Popen[bytes]]:
        command = [sys.executable, "-m", "edge_agent", "run", "-c", str(self.folder / "site.yaml")]
        with (self.folder / "agent.log").open("ab") as log:
            agent = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
            ended = threading.Event()
            player = threading.Thread(target=self._play, args=(agent, seed, ended))
            player.start()
            try:
                yield agent
            finally:
                ended.set()
                if agent.poll() is None:
                    agent.kill()
                agent.wait(PATIENCE_S)
                player.join(PATIENCE_S)

    def _play(self, agent: subprocess.Popen[bytes], seed: int, ended: threading.Event) -> None:
        sinks: list[Sink] = [self.serial, self.can]
        if not wait_ready(sinks, PATIENCE_S, lambda: agent.poll() is None and not ended.is_set()):
            return
        now, wall = time.monotonic_ns(), time.time_ns()
        record = simulate("clean", seed, 60.0, (wall // S + 1) * S)
        schedules = [(self.serial, serial_schedule(record)), (self.can, can_schedule(record, self.can))]
        play(schedules, now - START_NS, stop=ended)

    def seconds(self, files: list[Path]) -> float:
        """How much of the sensors the files hold."""
        try:
            t = [r.t_ns for r in raws(files) if r.source == CAN]
        except (FileNotFoundError, DamagedError):  # being made, or renamed under our hands
            return 0.0
        return (max(t) - min(t)) / S if t else 0.0

    def caught_amid_a_file(self, agent: subprocess.Popen[bytes]) -> bool:
        """Stop the agent where it stands: some of its files are finished and one is open that holds data. If not,
        it goes on. A look without the stop would be of a file that is finished before the kill comes."""
        if not self.rec.exists() or len(recordings(self.rec)) < 3:
            return False
        agent.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, agent.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
        files = recordings(self.rec)
        if [f.suffix for f in files].count(".part") == 1 and self.seconds(files[-1:]) > 0.2:
            return True
        agent.send_signal(signal.SIGCONT)
        return False

    def log(self) -> str:
        return (self.folder / "agent.log").read_text(errors="replace")

    def close(self) -> None:
        self.serial.close()
        self.can.close()


def test_sigkill_under_load_then_recover_and_the_next_run_in_the_same_folder(tmp_path: Path) -> None:
    site = Site(tmp_path)
    try:
        with site.run(1) as agent:
            until(lambda: site.caught_amid_a_file(agent) or agent.poll() is not None, "an open file with data", 0.1)
            assert agent.poll() is None, site.log()
            agent.send_signal(signal.SIGKILL)
            agent.wait(PATIENCE_S)
        torn = [f for f in recordings(site.rec) if f.name.endswith(".part")]
        assert len(torn) == 1
        before = len(recordings(site.rec))
        assert before >= 2  # rotation had happened

        # by hand, in a copy
        shutil.copytree(site.rec, tmp_path / "copy")
        assert replay([tmp_path / "copy"], None, None, True).ok  # torn as it is
        assert main(["recover", str(tmp_path / "copy")]) in (0, 3)
        copies = recordings(tmp_path / "copy")
        assert [f.name for f in copies] == [f.name.removesuffix(".part") for f in recordings(site.rec)]
        for f in copies:
            assert info(f).complete
            assert not info(f).damage
        report = replay([tmp_path / "copy"], None, None, True)
        assert report.ok, str(report)
        assert report.raw_gaps == 0
        assert report.compared > 50
        orders = [r.order for r in raws(copies)]
        assert orders == list(range(len(orders)))

        # by the next start, which then goes on beside it
        with site.run(2) as agent:
            until(
                lambda: site.seconds(recordings(site.rec)[before:]) >= 2.5 or agent.poll() is not None,
                "2.5 s of the second run",
                0.1,
            )
            assert agent.poll() is None, site.log()
            agent.send_signal(signal.SIGTERM)
            assert agent.wait(PATIENCE_S) == 0, site.log()
    finally:
        site.close()
    files = recordings(site.rec)
    assert all(f.suffix == ".mcap" for f in files)
    assert [f.read_bytes() for f in files[:before]] == [f.read_bytes() for f in copies]
    assert len({read_metadata(f)["edge_agent:run"]["run"] for f in files}) == 2
    (told,) = faults(files[before:], "RECOVERED")
    assert torn[0].name.removesuffix(".part") in told["text"]
    assert all(s.log_ns > 1_600_000_000 * S for s in stored(files))  # nothing is of 1970
    report = replay([site.rec], None, None, True)
    assert report.ok, str(report)
    assert report.segments == len(files) >= 3
    assert report.state_differs == report.unexpected == report.differing == 0
    waited = 0  # Ticks of each run that waited for data: they are in its first checkpoint
    for f in (files[0], files[before]):
        order = topics.decode_checkpoint(stored([f], "/raw/checkpoint")[0].data).order
        waited += sum(r.order < order for r in raws([f]))
    assert waited >= 2
    assert report.raws == len(raws(files)) - waited
    verdict = verify([site.rec])
    assert verdict.wanting == []
    # that the machine stood still for a while besides is its affair
    assert [g.reason for g in verdict.gaps if g.source == "all" and g.reason != "stall"] == ["kill"]


def test_a_run_killed_at_its_first_checkpoint_is_not_taken_for_the_beginning_of_the_next(
    script: list[Raw], tmp_path: Path
) -> None:
    for run_id, part in (("one", script[:60]), ("two", script[60:300])):
        begin = next(i for i, r in enumerate(part) if r.source == CLOCK)
        with Live(settings(tmp_path), ports(), run_id=run_id) as live:
            live.play(part[begin:])
        if run_id == "one":  # the disk has the checkpoint, nothing behind it
            (file,) = recordings(tmp_path / "rec")
            data = file.read_bytes()
            first = next(p for p in parts(data) if p.opcode == CHUNK)
            file.unlink()
            file.with_name(file.name + ".part").write_bytes(data[: first.pos + first.length])
    (tmp_path / "rec" / "site_20260601T070000Z_000.mcap.part").touch()  # a kill before the first byte
    report = replay([tmp_path / "rec"], None, None, True)
    assert report.ok, str(report)
    segments.recover(tmp_path / "rec")
    one, two = (f for f in recordings(tmp_path / "rec") if stored([f]))
    point_one, point_two = (topics.decode_checkpoint(stored([f], "/raw/checkpoint")[0].data) for f in (one, two))
    assert point_one.order == point_two.order == 1
    report = replay([tmp_path / "rec"], None, None, True)
    assert report.ok, str(report)
    assert report.compared > 100


# ---------------------------------------------------------------------------------------------------------------- wires


class Plug:
    """A serial device behind a link, as udev's by-id names are: it can be pulled and put back as another pty."""

    def __init__(self, link: Path) -> None:
        self.link, self.master, self.slave = link, -1, -1
        self.put_in()

    def put_in(self) -> None:
        self.master, self.slave = os.openpty()
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(self.slave))

    def pull(self) -> None:
        self.link.unlink()
        os.close(self.master)
        os.close(self.slave)

    def send(self, data: bytes) -> None:
        while data:
            data = data[os.write(self.master, data) :]


class Watch:
    """The clock of a serial port that stands where the test sets it: on the script's time, as the other ports are."""

    ns = START_NS

    def monotonic_ns(self) -> int:
        return self.ns

    def sleep(self, seconds: float) -> None:
        time.sleep(seconds)


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> Watch:
    """Quick ports, and their clock."""
    monkeypatch.setattr(drivers.serial_port, "COALESCE_S", 0.001)
    monkeypatch.setattr(drivers.serial_port, "WAIT_S", 0.02)
    monkeypatch.setattr(reading, "BACKOFF_S", (0.02, 0.04))
    made = Watch()
    monkeypatch.setattr(drivers.serial_port, "time", made)
    return made


def test_a_pulled_plug_is_a_fault_and_the_rest_goes_on(script: list[Raw], tmp_path: Path, watch: Watch) -> None:
    plug = Plug(tmp_path / "receiver")
    serial = SerialPort(PortSettings(GNSS, "serial", str(plug.link)))
    sent = [b"", b""]
    with Live(settings(tmp_path), {**ports(), GNSS: serial}) as live:
        account = live.agent.accounts[GNSS]

        def go_on(some: list[Raw], half: int) -> None:
            for raw in some:
                if raw.source == GNSS:
                    assert isinstance(raw.payload, bytes)
                    if half >= 0:
                        watch.ns = raw.t_ns
                        plug.send(raw.payload)
                        sent[half] += raw.payload
                        until(lambda: account.bytes == len(sent[0] + sent[1]), "every byte is read")
                else:
                    live.play([raw], step=True)

        live.play(script[:1])
        until(lambda: serial.counters["opens"] == 1, "the port is open")
        go_on(script[1:100], 0)
        plug.pull()
        until(lambda: any("PORT_LOST" in line for line in live.said), "the loss is noticed")
        go_on(script[100:160], -1)  # 3 s: not yet worth the word SILENT
        plug.put_in()
        until(lambda: serial.counters["opens"] == 2, "it is open again")
        go_on(script[160:300], 1)
    plug.pull()
    files = recordings(tmp_path / "rec")
    kinds = [f["kind"] for f in faults(files) if f["source"] == GNSS]
    assert kinds[0] == "PORT_LOST"
    assert kinds[-1] == "PORT_OPEN"
    assert set(kinds) == {"PORT_LOST", "PORT_OPEN"}
    assert {f["source"] for f in faults(files)} == {GNSS}
    assert f"lost {plug.link}" in faults(files)[0]["text"]
    got = raws(files)
    assert b"".join(r.payload for r in got if isinstance(r.payload, bytes)) == sent[0] + sent[1]
    assert [r.t_ns for r in got if r.source == CAN] == [r.t_ns for r in script[:300] if r.source == CAN]
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert report.compared == report.derived > 100


def test_garbage_on_the_wire_is_said_and_then_forgiven(script: list[Raw], tmp_path: Path, watch: Watch) -> None:
    plug = Plug(tmp_path / "receiver")
    serial = SerialPort(PortSettings(GNSS, "serial", str(plug.link)))
    noise = bytes(np.random.default_rng(3).integers(0, 256, 4000, np.uint8)).replace(b"$", b"")
    ticks = [r for r in script if r.source == CLOCK]
    good = [r.payload for r in script if r.source == GNSS and isinstance(r.payload, bytes)]
    with Live(settings(tmp_path), {**ports(), GNSS: serial}) as live:
        live.play(ticks[:1])
        until(lambda: serial.counters["opens"] == 1, "the port is open")
        size = 0
        for i, tick in enumerate(ticks[1:20]):
            data = noise[i * 200 : i * 200 + 200] if i < 10 else b"".join(good[10 * i : 10 * i + 10])
            size += len(data)
            watch.ns = tick.t_ns - S // 10
            plug.send(data)
            until(lambda size=size: live.agent.accounts[GNSS].bytes == size, "every byte is read")  # type: ignore[misc]
            live.play([tick], step=True)
    plug.pull()
    files = recordings(tmp_path / "rec")
    told = [(f["kind"], f["text"]) for f in faults(files) if f["source"] == GNSS]
    assert [k for k, _ in told] == ["GARBAGE", "OK"]
    assert "check baud rate and protocol" in told[0][1]
    assert b"".join(r.payload for r in raws(files) if isinstance(r.payload, bytes)).startswith(noise[:2000])
    assert replay(files, None, None, True).ok


# ----------------------------------------------------------------------------------------------------------------- disk


class Disk:
    """Refuses to write while it is full."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.full = False
        self.refused = 0
        self.sealing = True
        write, repair = writer._HashedFile.write, segments.repair

        def refusing(file: writer._HashedFile, data: bytes) -> int:
            if self.full:
                self.refused += 1
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return write(file, data)

        def sealing(path: Path) -> segments.Repaired:
            if not self.sealing:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            return repair(path)

        patch.setattr(writer._HashedFile, "write", refusing)
        patch.setattr(segments, "repair", sealing)


def flushed(live: Live) -> None:
    """Wait until everything that came is in the file."""
    live.settle()
    recorder = live.agent.writer.recorder
    until(lambda: recorder._writer is not None and not recorder._writer.pending, "a flush")


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    monkeypatch.setattr(writing, "RETRY_NS", 20_000_000)
    return Disk(monkeypatch)


@pytest.mark.parametrize(("sealing", "rotate_s"), [(True, 3600), (False, 3600), (True, 10)])
def test_a_full_disk_is_waited_for_in_memory(
    script: list[Raw], tmp_path: Path, disk: Disk, sealing: bool, rotate_s: int
) -> None:
    disk.sealing = sealing
    with Live(settings(tmp_path, f"record.rotate_s={rotate_s}"), ports()) as live:
        live.play(script[:300], step=True)
        flushed(live)
        disk.full = True
        live.play(script[300:310], step=True)
        until(lambda: live.agent.writer._told, "the writer has noticed")
        live.play(script[310:500], step=True)
        live.settle()
        until(lambda: disk.refused > 5, "it is tried again")
        disk.full = False
        until(lambda: not live.agent.writer.holding, "it goes on by itself")
        live.play(script[500:], step=True)
        live.settle()
    said = [line for line in live.said if "DISK_" in line]
    assert [line.split(": ")[1] for line in said] == ["DISK_FULL", "DISK_OK"]
    if not sealing:
        assert [f.name[-5:] for f in recordings(tmp_path / "rec")] == [".part", ".mcap"]
        disk.sealing = True
        segments.recover(tmp_path / "rec")
    files = recordings(tmp_path / "rec")
    because = [read_metadata(f)["edge_agent:run"]["opened_because"] for f in files]
    if rotate_s == 3600:
        assert because == ["start", "disk"]
        assert live.balance() == {}
    else:  # the oldest file made room; the border at 20 s was crossed while the disk was full
        assert because == ["time", "disk", "time", "time"]
        assert [f["kind"] for f in faults(files)].count("RETENTION") == 1
    assert [stored([f])[0].topic for f in files] == ["/raw/checkpoint"] * len(files)
    told = [f["kind"] for f in faults(files) if f["source"] == "recorder" and f["kind"].startswith("DISK")]
    assert told == ["DISK_FULL", "DISK_OK"]
    verdict = verify(files)
    assert verdict.wanting == []
    assert {g.reason for g in verdict.gaps} == {"disk"}
    orders = [r.order for r in raws(files)]
    gone = set(range(orders[0], len(script))) - set(orders)
    assert gone  # what waited in the chunk, and what came up to main's Rotate; nothing of the long wait
    assert gone <= set(range(300, 312))
    lost = lost_at_the_disk(files)
    for name, ledger in ledgers(files).items():
        number = sum(script[i].source == name for i in gone)
        assert ledger["lost_disk"] == lost.get(f"/raw/{name}", 0) == number
        assert ledger["received"] == ledger["written"] + ledger["queued"] + number
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert report.compared > 1000


def test_a_disk_that_stays_full_costs_what_the_ring_cannot_hold_and_says_so(
    script: list[Raw], tmp_path: Path, disk: Disk
) -> None:
    made = settings(tmp_path)
    made = replace(made, record=replace(made.record, ring_mb=0.35))
    with Live(made, ports()) as live:
        live.play(script[:100], step=True)
        flushed(live)
        disk.full = True
        for i in range(100, 500, 10):
            live.play(script[i : i + 10], step=True)
            live.settle()
        until(lambda: disk.refused > 5, "it is tried again")
        disk.full = False
        live.play(script[500:510], step=True)  # where the ring has just overflowed, a file can only begin here
        until(lambda: not live.agent.writer.holding, "it goes on by itself")
        live.play(script[510:], step=True)
        live.settle()
    files = recordings(tmp_path / "rec")
    assert len(files) == 2
    assert "RING_FULL" in {f["kind"] for f in faults(files)}
    verdict = verify(files)
    assert verdict.wanting == []
    assert {g.reason for g in verdict.gaps} == {"disk"}
    orders = [r.order for r in raws(files)]
    gone = set(range(len(script))) - set(orders)
    assert len(gone) > 100
    lost = lost_at_the_disk(files)
    assert live.balance() == {}
    for name, ledger in ledgers(files).items():
        number = sum(script[i].source == name for i in gone)
        assert ledger["lost_disk"] == lost.get(f"/raw/{name}", 0) == number, name
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    alone = replay(files[1:], None, None, True)
    assert alone.ok, str(alone)
    assert alone.compared > 500


def test_a_disk_that_is_full_to_the_end_is_told_on_stderr(script: list[Raw], tmp_path: Path, disk: Disk) -> None:
    with Live(settings(tmp_path), ports()) as live:
        live.play(script[:100], step=True)
        flushed(live)
        disk.full = True
        live.play(script[100:200], step=True)
        until(lambda: live.agent.writer._told, "the writer has noticed")
    assert any("DISK_FULL" in line for line in live.said)
    files = recordings(tmp_path / "rec")
    gone = [r for r in script[:200] if r.order not in {x.order for x in raws(files)}]
    told = {line.rpartition(" ")[2]: int(line.split(": ")[1].split()[0]) for line in live.said if "told in no" in line}
    for name in (GNSS, CAN, CLOCK):
        assert told.get(f"/raw/{name}", 0) == sum(r.source == name for r in gone)
    assert live.balance() == {}
    assert replay(files, None, None, True).ok


def test_a_chunk_that_only_reached_a_buffer_does_not_pass_for_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = settings(tmp_path)
    recorder = segments.Recorder(tmp_path, made.record, "site", {}, {}, lambda: 1 << 40)
    point = Record("/raw/checkpoint", 1, 1, topics.checkpoint(0, 0, 1, b"", "start"), False)
    recorder.handle(Rotate(point, 1, "start"), 0)

    def refuse(file: writer._HashedFile) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer._HashedFile, "flush", refuse)
    raw = Raw(2, 0, GNSS, bytes(writer.CHUNK_BYTES))  # packs to next to nothing
    with pytest.raises(segments.RecordingError) as e:
        recorder.handle(topics.raw_record(raw, 2), 0)
    assert e.value.reason == "full"
    assert [r.topic for r in e.value.unwritten] == ["/raw/gnss"]


# ---------------------------------------------------------------------------------------------------------------- clock


@pytest.mark.parametrize("step_s", [3600, -3600])
def test_a_clock_that_steps_there_and_back_begins_files_and_leaves_the_estimate_alone(
    script: list[Raw], tmp_path: Path, step_s: int
) -> None:
    def stepped(raw: Raw) -> Raw:
        if isinstance(raw.payload, Tick) and START_NS + 20 * S <= raw.t_ns < START_NS + 27 * S:
            return replace(raw, payload=replace(raw.payload, utc_ns=raw.payload.utc_ns + step_s * S))
        return raw

    (tmp_path / "calm").mkdir()
    with Live(settings(tmp_path / "calm"), ports()) as live:
        live.play(script)
    with Live(settings(tmp_path), ports()) as live:
        live.play(map(stepped, script))
    files = recordings(tmp_path / "rec")
    away = "09" if step_s > 0 else "07"
    assert {f.name for f in files} == {
        "site_20260601T080000Z_000.mcap",
        f"site_20260601T{away}0020Z_000.mcap",
        "site_20260601T080027Z_000.mcap",
    }
    because = {f.name[14:20]: read_metadata(f)["edge_agent:run"]["opened_because"] for f in files}
    assert because == {"080000": "start", f"{away}0020": "clock", "080027": "clock"}
    told = [e for e in decoded(files, "/events") if e["kind"] == "CLOCK_STEP"]
    assert sorted(round(values(e)["step_s"]) for e in told) == [-3600, 3600]

    def blocks(files: list[Path]) -> list[tuple[int, int]]:
        found = [topics.decode_fused_block("p", s.data) for s in stored(files, *fused)]
        return sorted((int(t), i) for e in found for i, t in enumerate(e.t_ns.tolist()))

    calm = recordings(tmp_path / "calm" / "rec")
    fused = {s.topic for s in stored(calm) if s.topic.startswith("/fusion/") and s.topic.endswith("/block")}
    assert blocks(files) == blocks(calm)  # the same instants: no gap, none twice
    assert len(blocks(files)) > 1900
    assert sorted(r.order for r in raws(files)) == list(range(len(script)))
    report = replay([tmp_path / "rec"], None, None, True)
    assert report.ok, str(report)
    assert report.compared > 1000
    assert (report.unverifiable, report.missing, report.unexpected) == (0, 0, 0)
    assert all(replay([f], None, None, True).ok for f in files)
