"""The agent's threads, queues and supervision on scripted ports: what it does is decided by the script alone."""

from __future__ import annotations

import re
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

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
    tick,
    until,
    values,
)

from drivers import PortError
from edge_agent import assemble, reading, writing
from edge_agent.messages import MS, Fault, Raw, Record, Rotate, S
from edge_agent.pipeline import Pipeline
from edge_agent.queues import ByteQueue
from edge_agent.reading import Account, Arrival, PortWatch, Reader
from edge_agent.recording.reader import read_messages
from edge_agent.recording.segments import Recorder
from edge_agent.replay import replay
from edge_agent.simulate import simulate
from edge_agent.simulate.encode import raw_blocks
from edge_agent.simulate.specs import EPOCH_UTC_NS, START_NS

DERIVED = ("/gnss/", "/accel/", "/fusion/", "/events")
SECONDS = 35.0


@pytest.fixture(scope="module")
def script() -> list[Raw]:
    return list(raw_blocks(simulate("clean", 1, SECONDS)))


def derived(files: Sequence[Path]) -> list[tuple[str, int, int, bytes]]:
    return [(s.topic, s.log_ns, s.publish_ns, s.data) for s in stored(files) if s.topic.startswith(DERIVED)]


def losses(files: Sequence[Path]) -> dict[tuple[str, str], int]:
    """(where, source) -> count of all LOSS records."""
    found: dict[tuple[str, str], int] = {}
    for f in faults(files, "LOSS"):
        key = f["text"].rpartition(" ")[2], f["source"]
        found[key] = found.get(key, 0) + int(values(f)["count"])
    return found


def balanced(ledger: dict[str, int]) -> bool:
    gone = ledger["dropped_inbox"] + ledger["refused_outbox"] + ledger["lost_disk"]
    return ledger["received"] == ledger["written"] + ledger["queued"] + gone and ledger["queued"] >= 0


# ----------------------------------------------------------------------------------------------------- order and files


def test_what_the_ports_said_is_recorded_in_order_and_fused_as_the_pipeline_alone_does(
    script: list[Raw], tmp_path: Path
) -> None:
    made = settings(tmp_path)
    with Live(made, ports()) as live:
        live.play(script)
    files = recordings(tmp_path / "rec")
    assert len(files) == 1
    got = raws(files)
    assert [r.order for r in got] == list(range(len(script)))
    assert [(r.t_ns, r.source) for r in got] == [(r.t_ns, r.source) for r in script]
    assert [r.payload for r in got if r.source != CAN] == [r.payload for r in script if r.source != CAN]

    pipeline, records, begun = assemble.pipeline(made), [], False
    for raw in script:
        if not begun and raw.source != CLOCK:
            pipeline.rotate("start", raw.t_ns)
            begun = True
        records += pipeline.step(raw)
    wanted = [(r.topic, r.log_ns, r.publish_ns, r.data) for r in records + pipeline.finish() if r.derived]
    assert derived(files) == wanted
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert report.compared == report.derived == len(wanted) > 1000

    everything = stored(files)
    assert everything[0].topic == "/raw/checkpoint"
    first = [s for s in everything if s.topic.startswith("/raw/")][1]
    assert (first.topic, first.log_ns) == ("/raw/clock", EPOCH_UTC_NS)  # the Tick that waited for the first data
    assert min(s.log_ns for s in everything) >= EPOCH_UTC_NS
    logs = [s.log_ns for s in everything if s.topic.startswith((*DERIVED, "/raw/"))]
    assert logs[1:] == sorted(logs[1:])
    for ledger in ledgers(files).values():
        assert balanced(ledger)
    assert ledgers(files)[CAN]["received"] > 300
    assert live.balance() == {}


def test_what_was_found_before_the_start_is_recorded_with_a_time(script: list[Raw], tmp_path: Path) -> None:
    found = [Fault(5, "recorder", "RECOVERED", "torn.mcap was repaired")]
    with Live(settings(tmp_path), ports(), found=found) as live:
        live.play(script[:10])
    files = recordings(tmp_path / "rec")
    (fault,) = stored(files, "/faults")
    assert fault.log_ns == EPOCH_UTC_NS
    assert faults(files)[0]["text"] == "torn.mcap was repaired"
    messages = [e["msg"] for e in decoded(files, "/rosout")]
    assert re.fullmatch(r"edge-agent \S+ at site: gnss, can", messages[0])
    assert messages[-1] == "stopped"
    assert all(s.log_ns >= EPOCH_UTC_NS for s in stored(files, "/rosout"))


def test_without_data_a_file_begins_all_the_same_and_keeps_every_fault(tmp_path: Path) -> None:
    made = ports()
    made[CAN].refuse.append(PortError("CAN slcan none: cannot be opened"))
    with Live(settings(tmp_path), made) as live:
        for i in range(60):
            live.play([tick(START_NS + i * S)], step=True)
        live.settle()
    files = recordings(tmp_path / "rec")
    assert [f["kind"] for f in faults(files, "PORT_LOST")] == ["PORT_LOST"]
    assert {f["source"] for f in faults(files, "SILENT")} == {GNSS, CAN}
    assert [r.order for r in raws(files)] == list(range(60))  # those that waited too
    ledger = ledgers(files)[CLOCK]
    assert ledger["received"] == 60
    assert balanced(ledger)
    assert replay(files, None, None, True).ok


def test_files_begin_at_whole_periods(script: list[Raw], tmp_path: Path) -> None:
    # two readers may stamp on one side of the border and be heard on the other
    heard = list(script)
    border = next(i for i, r in enumerate(heard) if r.t_ns >= START_NS + 20 * S)
    heard[border - 3 : border + 3] = heard[border - 3 : border + 3][::-1]
    with Live(settings(tmp_path, "record.rotate_s=10"), ports()) as live:
        live.play(heard)
    files = recordings(tmp_path / "rec")
    assert [f.name for f in files] == [f"site_20260601T0800{s}Z_000.mcap" for s in ("00", "10", "20", "30")]
    assert [next(read_messages(f)).topic for f in files] == ["/raw/checkpoint"] * 4
    assert [r.order for r in raws(files)] == list(range(len(script)))
    whole = replay(files, None, None, True)
    assert whole.ok, str(whole)
    assert whole.compared == whole.derived
    assert all(replay([f], None, None, True).ok for f in files)


def test_files_end_at_the_size(script: list[Raw], tmp_path: Path) -> None:
    with Live(settings(tmp_path, "record.rotate_mb=0.1"), ports()) as live:
        for i in range(0, len(script), 20):
            live.play(script[i : i + 20])
            live.settle()
    *files, last = recordings(tmp_path / "rec")
    assert len(files) >= 2
    for f in files:
        assert f.stat().st_size >= 100_000  # none was ended twice
    report = replay([*files, last], None, None, True)
    assert report.ok, str(report)
    assert report.compared == report.derived


def test_the_size_of_the_file_before_does_not_end_the_next_one(script: list[Raw], tmp_path: Path) -> None:
    """The writer may publish the old file's size after main has asked for a new one."""
    with Live(settings(tmp_path, "record.rotate_mb=100"), ports()) as live:
        live.play(script[:100])
        live.settle()
        until(lambda: live.agent.writer.open_file[1], "the open file's size")
        number, _ = live.agent.writer.open_file
        live.agent.writer.recorder.settings = replace(live.agent.config.record, flush_s=1e6, fsync_s=1e6)
        published: list[tuple[int, int]] = [(number, 1 << 40), (number, 1 << 40)]
        type(live.agent.writer).open_file = property(  # type: ignore[assignment]
            lambda self: published[0], lambda self, value: None
        )
        try:
            live.play(script[100:160], step=True)
        finally:
            del type(live.agent.writer).open_file
            live.agent.writer.open_file = number, 0
    assert len(recordings(tmp_path / "rec")) == 2


def test_what_waits_for_time_to_go_on_is_in_the_file_of_its_run(script: list[Raw], tmp_path: Path) -> None:
    bad = b"$GNGGA,1,2,3*00\r\n"
    for run_id, part in (("one", script[:100]), ("two", script[100:200])):
        with Live(settings(tmp_path), ports(), run_id=run_id) as live:
            live.play([tick(part[0].t_ns), *part, Raw(part[-1].t_ns, 0, GNSS, bad)])
        (last,) = [e for e in decoded(recordings(tmp_path / "rec")[-1:], "/events") if e["kind"] == "REJECT"]
        assert last["text"].startswith("CHECKSUM")  # told at the stop, less than a second after it came
    files = recordings(tmp_path / "rec")
    assert len(files) == 2
    for some in (files, files[:1], files[1:]):
        report = replay(some, None, None, True)
        assert report.ok, str(report)
        assert report.compared == report.derived


# -------------------------------------------------------------------------------------------------------------- faults


class Impatient:
    """A stop event that notes the waits and does not wait."""

    def __init__(self, waits: int) -> None:
        self.asked: list[float] = []
        self.limit = waits

    def is_set(self) -> bool:
        return len(self.asked) >= self.limit

    def wait(self, seconds: float) -> bool:
        self.asked.append(seconds)
        return self.is_set()


class Flaky:
    """A port whose opening and reading follow a script: True, data or an error."""

    def __init__(self, opens: list[bool], reads: list[bytes]) -> None:
        self.counters: dict[str, int] = {}
        self.opens, self.reads, self.closed = opens, reads, 0

    def open(self) -> None:
        if not (self.opens.pop(0) if self.opens else False):
            raise PortError("no such device")

    def read(self) -> list[tuple[int, bytes]]:
        if not self.reads:
            raise PortError("unplugged")
        return [(1, self.reads.pop(0))]

    def close(self, silently: bool = False) -> None:
        self.closed += 1


def reader(port: Any, stop: Any) -> list[Arrival]:
    inbox: ByteQueue[Arrival] = ByteQueue(1 << 20)
    thread = Reader("gnss", port, inbox, Account(), stop)
    thread.run()  # in this thread
    assert thread.failure is None
    return list(inbox.take(0.0))


def test_a_lost_port_is_tried_again_after_1_2_4_up_to_60_s() -> None:
    stop = Impatient(9)
    port = Flaky([], [])
    arrivals = reader(port, stop)
    assert stop.asked == [1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0, 60.0, 60.0]
    told = [a.payload for a in arrivals if isinstance(a.payload, Fault)]
    assert [f.kind for f in told] == ["PORT_LOST"] * 9
    assert [f.values for f in told] == [(("retry_s", s),) for s in stop.asked]
    assert told[2].text == "no such device; next try in 4 s"
    assert port.closed >= 9


def test_data_makes_the_reader_patient_no_longer_than_a_second() -> None:
    stop = Impatient(6)
    arrivals = reader(Flaky([False, False, False, True, True, False], [b"a", b"b"]), stop)
    # three failures, then two blocks, a loss; opened without data: goes on doubling
    assert stop.asked == [1.0, 2.0, 4.0, 1.0, 2.0, 4.0]
    kinds = [a.payload.kind if isinstance(a.payload, Fault) else a.payload for a in arrivals]
    assert kinds == [*["PORT_LOST"] * 3, "PORT_OPEN", b"a", b"b", "PORT_LOST", "PORT_OPEN", "PORT_LOST", "PORT_LOST"]


def test_a_port_that_comes_and_goes_is_on_faults_and_the_others_go_on(
    script: list[Raw], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "BACKOFF_S", (0.01, 0.02))
    made = ports()
    made[CAN].refuse.append(PortError("CAN slcan x: cannot be opened: there is no such device"))
    with Live(settings(tmp_path), made) as live:
        live.play(script[:60])
        made[GNSS].refuse.append(PortError("port gnss: no such device"))
        made[GNSS].fail(PortError("port gnss: lost: hung up"))
        live.play([r for r in script[60:90] if r.source != GNSS])
        live.play(script[90:200])
    files = recordings(tmp_path / "rec")
    # SILENT besides is right where this machine was so slow that main stepped seconds of the script without a block.
    told = [(f["source"], f["kind"]) for f in faults(files) if f["kind"].startswith("PORT_")]
    assert [k for s, k in told if s == CAN] == ["PORT_LOST", "PORT_OPEN"]
    assert [k for s, k in told if s == GNSS] == ["PORT_LOST", "PORT_LOST", "PORT_OPEN"]
    assert made[GNSS].counters["opens"] == 3
    want = [r for i, r in enumerate(script[:200]) if not (60 <= i < 90 and r.source == GNSS)]
    assert [(r.t_ns, r.source) for r in raws(files)] == [(r.t_ns, r.source) for r in want]
    assert replay(files, None, None, True).ok


def counts(number: int = 0, good: int = 0, positions: int = 0) -> dict[str, int]:
    return {"bytes": number, "good": good, "positions": positions}


def test_silent_garbage_and_no_position_are_three_states() -> None:
    watch = PortWatch("serial")
    seen: list[tuple[int, str]] = []

    def look(second: int, *numbers: int) -> None:
        told = watch.look(second * S, counts(*numbers))
        if told:
            seen.append((second, told[0]))
            texts[told[0]] = told[1]

    texts: dict[str, str] = {}
    for t in range(10):
        look(t)  # nothing at all
    for t in range(10, 20):
        look(t, 100 * t)  # bytes
    for t in range(20, 40):
        look(t, 100 * t, t)  # sentences
    for t in range(40, 50):
        look(t, 100 * t, t, t)  # positions
    for t in range(50, 60):
        look(t, 4900, 49, 49)  # silence again
    look(60, 5000, 49, 49)  # bytes again: nothing can be said yet, but silent it is not
    look(61, 5100, 50, 50)
    assert seen == [(6, "SILENT"), (15, "GARBAGE"), (20, "NO_POSITION"), (40, "OK"), (55, "SILENT"), (61, "OK")]
    assert texts["GARBAGE"] == "bytes come, but no good sentence for 6 s: check baud rate and protocol"
    assert "switch on GGA" in texts["NO_POSITION"]
    assert "check power, cable and device" in texts["SILENT"]


def test_a_good_start_is_no_news() -> None:
    watch = PortWatch("serial")
    assert [watch.look(t * S, counts(t, t, t)) for t in range(20)] == [None] * 20
    assert watch.state == "OK"


def test_frames_that_nobody_knows_are_said() -> None:
    watch = PortWatch("can")
    told = [watch.look(t * S, counts(t)) for t in range(10)]
    assert [t for t in told if t] == [
        ("NO_MATCH", "frames come, but no good sample for 6 s: check bit rate, ids and DBC file")
    ]
    assert watch.look(10 * S, counts(10, 5)) == ("OK", "good samples come")


def test_bus_off_is_said_at_once_and_is_over_with_the_next_sample() -> None:
    """GIVEN a bus that works WHEN the controller leaves it, and tries in vain THEN it is told once, until data come."""
    watch = PortWatch("can")
    told = []
    for t in range(16):  # bus-off at 3, 4 and 5 s, an error frame each; samples again from 7 s on
        good, off = min(t, 2) + max(t - 6, 0), min(max(t - 2, 0), 3)
        told.append(watch.look(t * S, {"bytes": good + off, "good": good, "positions": 0, "bus_off": off}))
    seen = [(t, x[0]) for t, x in enumerate(told) if x]
    assert seen == [(3, "BUS_OFF"), (7, "OK")]
    assert told[3] is not None
    assert "short circuit" in told[3][1]


def test_a_port_that_counts_from_0_again_has_not_left_the_bus() -> None:
    """Another reader has taken over, with a port of its own."""
    watch = PortWatch("can")
    told = [
        watch.look(t * S, {"bytes": t, "good": t, "positions": 0, "bus_off": off})
        for t, off in enumerate((0, 2, 2, 0, 0, 1))
    ]
    assert [(t, x[0]) for t, x in enumerate(told) if x] == [(1, "BUS_OFF"), (2, "OK"), (5, "BUS_OFF")]


def test_states_reach_the_recording(tmp_path: Path) -> None:
    with Live(settings(tmp_path), ports()) as live:
        for i in range(12):
            t = START_NS + i * S
            live.play([tick(t), Raw(t + MS, 0, GNSS, b"\x00\xff\x00 no sentence")], step=True)
        live.settle()
    files = recordings(tmp_path / "rec")
    assert {(f["source"], f["kind"]) for f in faults(files)} == {(CAN, "SILENT"), (GNSS, "GARBAGE")}
    assert "baud rate" in faults(files, "GARBAGE")[0]["text"]
    last = decoded(files, "/diagnostics")[-1]
    assert {s["name"]: s["message"] for s in last["status"]}["port/gnss"] == "GARBAGE"


# ------------------------------------------------------------------------------------------------------------ overload


def test_a_full_inbox_drops_the_newest_and_says_how_many(script: list[Raw], tmp_path: Path) -> None:
    made = settings(tmp_path)
    made = replace(made, record=replace(made.record, inbox_mb=0.02))
    gate, entered = threading.Event(), threading.Event()
    with Live(made, ports()) as live:
        live.play(script[:100], step=True)
        step = live.agent.pipeline.step

        def slow(raw: Raw) -> list[Record]:
            entered.set()
            assert gate.wait(PATIENCE_S)
            return step(raw)

        live.agent.pipeline.step = slow  # type: ignore[method-assign]
        live.play(script[100:101])
        assert entered.wait(PATIENCE_S)
        live.play(script[101:300])  # nobody takes them
        # what main has in its hand counts until it is done
        room = 20_000 - reading.payload_size(script[100].payload) - reading.RECORD_OVERHEAD
        kept, dropped = script[:101], []
        for raw in script[101:300]:
            size = reading.payload_size(raw.payload) + reading.RECORD_OVERHEAD
            if room >= size:
                room -= size
                kept.append(raw)
            else:
                dropped.append(raw)
        gate.set()
        live.stepped()
        live.play(script[300:400], step=True)
        live.settle()
    files = recordings(tmp_path / "rec")
    assert len(dropped) > 100
    assert [(r.t_ns, r.source) for r in raws(files)] == [(r.t_ns, r.source) for r in [*kept, *script[300:400]]]
    by_port = {name: sum(r.source == name for r in dropped) for name in (GNSS, CAN, CLOCK)}
    assert losses(files) == {("inbox", name): n for name, n in by_port.items() if n}
    for name, ledger in ledgers(files).items():
        assert ledger["dropped_inbox"] == by_port[name]
        assert balanced(ledger)
    assert live.balance() == {}
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert report.compared == report.derived
    assert report.raw_gaps == 0


class Gated(Recorder):
    """A disk that stops the writer while its gate is closed."""

    gate: threading.Event
    waiting: threading.Event

    def handle(self, item: Record | Rotate, now_ns: int | None = None) -> None:
        self.waiting.set()
        assert self.gate.wait(PATIENCE_S)
        super().handle(item, now_ns)


def test_a_full_outbox_refuses_derived_records_first_and_verify_knows(script: list[Raw], tmp_path: Path) -> None:
    made = settings(tmp_path, "record.rotate_s=10")
    made = replace(made, record=replace(made.record, outbox_mb=0.2))
    Gated.gate, Gated.waiting = threading.Event(), threading.Event()
    Gated.gate.set()
    with Live(made, ports(), make_recorder=Gated) as live:
        accounts = live.agent.accounts
        begin = next(i for i, r in enumerate(script) if r.t_ns > START_NS + 21 * S)
        for i in range(0, begin, 20):
            live.play(script[i : min(i + 20, begin)])
            live.settle()
        Gated.gate.clear()
        Gated.waiting.clear()
        live.play(script[begin : begin + 2])
        assert Gated.waiting.wait(PATIENCE_S)
        first = None
        for i in range(begin + 2, len(script)):
            live.play(script[i : i + 1], step=True)
            if live.agent._lost and first is None:
                assert all(not topic.startswith("/raw/") for topic in live.agent._lost)
                assert accounts[CAN].refused == accounts[GNSS].refused == 0
                first = i
            if accounts[CAN].refused >= 5 and accounts[GNSS].refused >= 5:
                break
        at = i + 1
        assert first is not None
        assert first < at - 10
        assert at < len(script) - 30, "the outbox should be full long before the script ends"
        Gated.gate.set()
        live.settle()
        for raw in script[at:]:
            live.play([raw], step=True)
            if 2 * live.agent.outbox.bytes > live.agent.outbox.limit_bytes:  # a checkpoint alone is larger
                live.settle()
        live.settle()
    files = recordings(tmp_path / "rec")
    told = losses(files)
    assert {where for where, _ in told} == {"outbox"}
    for name in (CAN, GNSS):
        assert told["outbox", f"/raw/{name}"] == accounts[name].refused
        ledger = ledgers(files)[name]
        assert ledger["refused_outbox"] == accounts[name].refused
        assert balanced(ledger)
        assert ledger["written"] == ledger["received"] - ledger["refused_outbox"] - ledger["queued"]
        assert sum(r.source == name for r in raws(files)) == accounts[name].received - accounts[name].refused
    assert live.balance() == {}
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert (report.missing, report.unexpected, report.raw_gaps) == (0, 0, 0)
    assert report.missing_allowed == sum(n for (_, topic), n in told.items() if not topic.startswith("/raw/")) > 100
    assert sum(replay([f], None, None, True).missing for f in files) == 0  # each file holds the LOSS of its own


# --------------------------------------------------------------------------------------------------------------- crash


def test_a_wrong_program_ends_with_the_block_that_showed_it_on_the_disk(
    script: list[Raw], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = Pipeline.step

    def wrong(self: Pipeline, raw: Raw) -> list[Record]:
        if raw.order == 50:
            raise ZeroDivisionError("a bug")
        return step(self, raw)

    monkeypatch.setattr(Pipeline, "step", wrong)
    with Live(settings(tmp_path), ports()) as live:
        live.play(script[:51])
        assert isinstance(live.crash(), ZeroDivisionError)
    files = recordings(tmp_path / "rec")
    assert [f.suffix for f in files] == [".mcap"]  # closed in order
    assert [r.order for r in raws(files)] == list(range(51))


def test_a_wrong_driver_ends_the_agent_and_is_recorded(script: list[Raw], tmp_path: Path) -> None:
    made = ports()
    with Live(settings(tmp_path), made) as live:
        live.play(script[:50])
        made[CAN].fail(ZeroDivisionError("a bug"))
        assert isinstance(live.crash(), ZeroDivisionError)
    files = recordings(tmp_path / "rec")
    assert [(f["source"], f["text"]) for f in faults(files, "CRASH")] == [(CAN, "ZeroDivisionError: a bug")]
    assert [r.order for r in raws(files)] == list(range(50))


def test_a_card_that_does_not_answer_is_no_crash(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def broken(path: object) -> None:
        raise OSError(5, "Input/output error")

    assert writing.free_bytes(tmp_path / "not" / "there") > 0
    monkeypatch.setattr(writing.shutil, "disk_usage", broken)
    assert writing.free_bytes(tmp_path) == -1
