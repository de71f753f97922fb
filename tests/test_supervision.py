"""What watches over the threads: a writer that hangs, ledgers that do not balance, ports that are silent or hang."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from live import (
    CAN,
    CLOCK,
    GNSS,
    PATIENCE_S,
    Live,
    ScriptedPort,
    faults,
    ledgers,
    ports,
    raws,
    recordings,
    settings,
    tick,
    until,
    values,
)
from stepped import Stepped

from drivers import PortError
from edge_agent import reading, runtime, writing
from edge_agent.messages import MS, Raw, Record, Rotate, S
from edge_agent.queues import ByteQueue
from edge_agent.reading import PortWatch, payload_size
from edge_agent.recording.segments import Recorder
from edge_agent.replay import replay
from edge_agent.simulate import simulate
from edge_agent.simulate.encode import raw_blocks
from edge_agent.simulate.specs import EPOCH_UTC_NS, START_NS


@pytest.fixture(scope="module")
def script() -> list[Raw]:
    return list(raw_blocks(simulate("clean", 1, 12.0)))


def tick_of(second: int) -> Raw:
    return tick(START_NS + second * S)


class Time:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.ns = S

    def __call__(self) -> int:
        return self.ns


def pass_by(live: Live, time: Time, seconds: int, *working: str) -> None:
    """Let time go on, and the readers that work come back from their driver."""
    time.ns += seconds * S
    until(lambda: all(live.agent.readers[n].busy_ns == time.ns for n in working), "readers that come back")


class Gated(Recorder):
    """A disk that stops the writer while its gate is closed."""

    gate: threading.Event
    waiting: threading.Event

    def handle(self, item: Record | Rotate, now_ns: int | None = None) -> None:
        if not self.gate.is_set():
            self.waiting.set()
        assert self.gate.wait(PATIENCE_S)
        super().handle(item, now_ns)


@pytest.fixture
def gated() -> type[Gated]:
    Gated.gate, Gated.waiting = threading.Event(), threading.Event()
    Gated.gate.set()
    return Gated


def kinds(files: Sequence[Path], source: str) -> list[str]:
    """Without what a slow disk adds."""
    told = [f["kind"] for f in faults(files) if f["source"] == source]
    return [kind for kind in told if not kind.startswith("FSYNC_")]


# ----------------------------------------------------------------------------------------------------------- the writer


def test_a_writer_that_hangs_is_a_fault_after_5_s_with_its_end(
    script: list[Raw], tmp_path: Path, gated: type[Gated]
) -> None:
    time = Time()
    with Live(settings(tmp_path), ports(), make_recorder=gated, now=time) as live:
        live.play(script[:60])
        live.settle()
        gated.gate.clear()
        live.play([tick_of(3)], step=True)
        assert gated.waiting.wait(PATIENCE_S)
        time.ns += 5 * S
        live.play([tick_of(4)], step=True)
        assert not any("WRITER_STALLED" in line for line in live.said)
        for more in (1, 30, 60):
            time.ns += more * S
            live.play([tick_of(5 + more)], step=True)
        assert [line for line in live.said if "WRITER" in line] == [
            "recorder: WRITER_STALLED: the disk has not answered for 6 s; records wait in memory"
        ]
        gated.gate.set()
        live.settle()
        live.play([tick_of(70)], step=True)
        live.settle()
        live.play([tick_of(71)], step=True)
    files = recordings(tmp_path / "rec")
    assert kinds(files, "recorder") == ["WRITER_STALLED", "WRITER_OK"]
    assert values(faults(files, "WRITER_STALLED")[0])["stalled_s"] == 6
    assert values(faults(files, "WRITER_OK")[0])["stalled_s"] == 96
    assert live.balance() == {}


def test_memory_is_bounded_while_the_writer_hangs(
    script: list[Raw], tmp_path: Path, gated: type[Gated], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "RESERVE_BYTES", 10_000)
    made = settings(tmp_path, "record.rotate_s=10")
    made = replace(made, record=replace(made.record, outbox_mb=0.03))
    with Live(made, ports(), make_recorder=gated) as live:
        live.play(script[:60], step=True)
        live.settle()
        gated.gate.clear()
        most, block = 0, max(payload_size(r.payload) for r in script) + 200
        for second in range(3, 60):
            for raw in (r for r in script if START_NS + 3 * S < r.t_ns <= START_NS + 4 * S and r.source != CLOCK):
                live.play([replace(raw, t_ns=raw.t_ns + (second - 3) * S)], step=True)
            live.play([tick_of(second)], step=True)
            most = max(most, live.agent.outbox.bytes)
            if second == 30:
                after_half = most
        assert 36_000 < most <= 30_000 + 10_000 + block
        assert most == after_half
        assert live.agent.accounts[CLOCK].refused > 20
        gated.gate.set()
        live.settle()
        live.play([tick_of(60)], step=True)
        live.settle()
    files = recordings(tmp_path / "rec")
    assert live.balance() == {}
    told = sum(values(f)["count"] for f in faults(files, "LOSS") if f["source"] == f"/raw/{CLOCK}")
    assert told == live.agent.accounts[CLOCK].refused
    assert not faults(files, "LEDGER")
    assert replay(files, None, None, True).ok


# --------------------------------------------------------------------------------------------------------- the ledgers


def test_a_block_that_main_forgets_is_a_fault_with_the_figures(script: list[Raw], tmp_path: Path) -> None:
    with Live(settings(tmp_path), ports()) as live:
        live.play(script[:100], step=True)
        live.settle()
        step = live.agent._step
        live.agent._step = lambda arrival, payload, tick: None  # type: ignore[method-assign]
        live.play([r for r in script[100:130] if r.source == CAN][:1], step=True)
        live.agent._step = step  # type: ignore[method-assign]
        live.play(script[130:200], step=True)
        live.settle()
    files = recordings(tmp_path / "rec")
    (fault,) = faults(files, "LEDGER")
    assert fault["source"] == CAN
    assert fault["text"].startswith("1 blocks are unaccounted for: received ")
    figures = dict(part.rsplit(" ", 1) for part in fault["text"].split(": ")[1].split(", "))
    assert list(figures) == ["received", "written", "queued", "dropped_inbox", "refused_outbox", "lost_disk"]
    received, *others = map(int, figures.values())
    assert received == sum(others) + 1
    assert values(fault)["missing"] == 1
    assert ledgers(files)[CAN]["received"] - sum(int(ledgers(files)[CAN][k]) for k in list(figures)[1:]) == 1


def test_a_block_that_the_writer_forgets_is_a_fault(script: list[Raw], tmp_path: Path) -> None:
    with Live(settings(tmp_path), ports()) as live:
        live.play(script[:60], step=True)
        live.settle()
        write = live.agent.writer._write
        forgotten: list[Record | Rotate] = []

        def careless(item: Record | Rotate, now: int) -> bool:
            if isinstance(item, Record) and item.topic == f"/raw/{GNSS}" and not forgotten:
                forgotten.append(item)
                return True
            return write(item, now)

        live.agent.writer._write = careless  # type: ignore[method-assign]
        live.play(script[60:80], step=True)
        live.settle()
        until(lambda: live.agent.writer.books[GNSS].taken > live.agent.writer.books[GNSS].written, "closed books")
        live.play([tick_of(9)], step=True)
        live.play([tick_of(10)], step=True)
    (fault,) = faults(recordings(tmp_path / "rec"), "LEDGER")
    assert (fault["source"], values(fault)["missing"]) == (GNSS, 1)


def test_a_held_block_that_vanishes_from_the_ring_is_a_fault(
    tmp_path: Path, script: list[Raw], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writing, "RETRY_NS", 1 << 62)  # the ring stays what it is
    with Live(settings(tmp_path), ports(), free_bytes=lambda: 0) as live:  # no file can be begun
        live.play(script[:60], step=True)
        live.settle()
        until(lambda: live.agent.writer.books[CAN].ring > 5, "blocks in the ring")
        live.play([tick_of(9)], step=True)
        assert not any("LEDGER" in line for line in live.said)
        writer = live.agent.writer
        close, held = writer._close_books, writer.books[CAN].ring

        def careless() -> None:
            ring = writer._ring
            ring.remove(next(r for r in ring if isinstance(r, Record) and r.topic == f"/raw/{CAN}"))
            writer._close_books = close  # type: ignore[method-assign]
            close()

        writer._close_books = careless  # type: ignore[method-assign]
        until(lambda: writer.books[CAN].ring < held, "closed books")
        live.play([tick_of(11)], step=True)
        assert sum("LEDGER: 1 blocks" in line for line in live.said) == 1


def test_a_codec_that_miscounts_is_a_fault(script: list[Raw], tmp_path: Path) -> None:
    with Live(settings(tmp_path), ports()) as live:
        live.play(script[:100], step=True)
        live.agent.pipeline.receivers["rover"].codec.counters["rejected"] += 2
        live.agent.pipeline.receivers["rover"].codec.counters["skipped_bytes"] -= 1
        live.agent.pipeline.accelerometers["acc"].codec.counters["frames"] += 3
        live.play(script[100:200], step=True)
    told = {f["source"]: f["text"] for f in faults(recordings(tmp_path / "rec"), "LEDGER")}
    assert told["rover"] == "2 of 2 rejects came without a reason"
    assert told["acc frames"].startswith("3 frames of ")
    assert told["rover bytes"].startswith("1 bytes of ")
    assert set(told) == {"rover", "rover bytes", "acc frames"}


def test_garbage_and_losses_balance(script: list[Raw], tmp_path: Path) -> None:
    bad = b"$GNGGA,1,2,3*00\r\n$GNGGA,1,2,3\r\n$GN$GNGGA,\x01\xb5b\x01\x07\x02\x00xx\x00\x00$GNGST,1,2,3*55\r\n"
    with Live(settings(tmp_path), ports()) as live:
        for i, raw in enumerate(script):
            live.play([raw], step=True)
            if i % 7 == 0:
                live.play([Raw(raw.t_ns, 0, GNSS, bad[: i % len(bad)])], step=True)
    files = recordings(tmp_path / "rec")
    assert live.agent.pipeline.receivers["rover"].codec.counters["rejected"] > 20
    assert not faults(files, "LEDGER")


# ----------------------------------------------------------------------------------------------------------- the ports


def test_a_silent_port_is_due_after_10_20_40_up_to_300_s_until_something_comes() -> None:
    watch = PortWatch("can")
    due = []
    for second in range(1000):
        moving = second if second < 5 or second > 700 else 5
        watch.look(second * S, {"bytes": moving, "good": moving, "positions": 0})
        if watch.reopen_due(second * S):
            due.append((second, watch.state, watch.reopens))
    assert due == [(21, "SILENT", 1), (41, "SILENT", 2), (81, "SILENT", 3), (161, "SILENT", 4), (321, "SILENT", 5),
                   (621, "SILENT", 6)]  # fmt: skip


def test_a_silent_bus_is_opened_again_and_a_working_port_is_left_alone(script: list[Raw], tmp_path: Path) -> None:
    made = ports()
    fixes = [r for r in script if r.source == GNSS]
    with Live(settings(tmp_path), made) as live:
        live.play([tick_of(0)], step=True)
        until(lambda: live.agent.readers[CAN].state == "OPEN", "the bus is open")
        for second in range(1, 60):
            live.play([fixes[second], tick_of(second)], step=True)
            if second in (16, 36):
                opens = 2 if second == 16 else 3
                until(lambda n=opens: made[CAN].counters["opens"] == n, "the bus is open again")
        assert made[GNSS].counters["opens"] == 1
        assert live.agent.accounts[CAN].reopened == 2
        assert made[CAN].counters["closes"] == 2
        live.play([r for r in script if r.source == CAN][:5], step=True)
        live.play([tick_of(60)], step=True)
        assert live.agent.accounts[CAN].received == 5
    files = recordings(tmp_path / "rec")
    assert kinds(files, CAN) == ["SILENT", "PORT_REOPEN", "OK"]
    assert len([r for r in raws(files) if r.source == CAN]) == 5
    assert replay(files, None, None, True).ok


class Stuck(ScriptedPort):
    """A driver that does not come back from a read."""

    def __init__(self) -> None:
        super().__init__()
        self.entered, self.free = threading.Event(), threading.Event()

    def read(self) -> list[tuple[int, Any]]:
        self.entered.set()
        assert self.free.wait(PATIENCE_S)
        return []


def test_a_reader_that_hangs_is_replaced_alone(script: list[Raw], tmp_path: Path) -> None:
    time, made, fresh = Time(), ports(), ScriptedPort()
    stuck = Stuck()
    asked: list[str] = []

    def make_port(name: str) -> ScriptedPort:
        asked.append(name)
        return fresh

    with Live(settings(tmp_path), {**made, CAN: stuck}, now=time, make_port=make_port) as live:
        live.play([tick_of(0)], step=True)
        assert stuck.entered.wait(PATIENCE_S)
        old = live.agent.readers[CAN]
        pass_by(live, time, 30, GNSS)
        live.play([tick_of(1)], step=True)
        assert asked == []
        pass_by(live, time, 1, GNSS)
        live.play([tick_of(2)], step=True)
        assert asked == [CAN]
        made[CAN] = live.ports = {**live.ports, CAN: fresh}  # type: ignore[assignment]
        live.play([r for r in script if r.source == CAN][:5], step=True)
        live.play([tick_of(3)], step=True)
        assert asked == [CAN]
        stuck.free.set()
        old.join(PATIENCE_S)
        assert not old.is_alive()
        assert stuck.counters["closes"] == 1
        live.play([r for r in script if r.source == CAN][5:10], step=True)
    files = recordings(tmp_path / "rec")
    assert kinds(files, CAN)[:2] == ["PORT_HUNG", "PORT_OPEN"]
    assert len([r for r in raws(files) if r.source == CAN]) == 10


def test_a_reader_that_was_replaced_says_nothing_of_the_port_any_more() -> None:
    inbox: ByteQueue[Any] = ByteQueue(1000)
    port = ScriptedPort()
    reader = reading.Reader(CAN, port, inbox, reading.Account(), threading.Event())

    def lost() -> list[tuple[int, Any]]:
        reader.abandoned = True
        raise PortError("the device is gone")

    port.read = lost  # type: ignore[method-assign]
    reader.run()
    assert len(inbox) == 0
    assert port.counters["closes"] == 1
    assert reader.failure is None


def test_a_stop_waits_for_hung_readers_together_not_for_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file must be finished inside the time that systemd gives, however many drivers hang."""
    stuck = {GNSS: Stuck(), CAN: Stuck()}
    patience: list[float] = []
    clock = Time()

    def join(reader: reading.Reader, timeout: float | None = None) -> None:
        if reader.source in stuck:
            patience.append(timeout or 0.0)
            clock.ns += int((timeout or 0.0) * S)

    with Live(settings(tmp_path), {**ports(), **stuck}) as live:
        live.play([tick_of(0)], step=True)
        for port in stuck.values():
            assert port.entered.wait(PATIENCE_S)
        monkeypatch.setattr(reading.Reader, "join", join)
        real = runtime.time
        frozen = SimpleNamespace(monotonic=lambda: clock.ns / S, monotonic_ns=real.monotonic_ns, time_ns=real.time_ns)
        monkeypatch.setattr(runtime, "time", frozen)
    assert patience == [runtime.READERS_S, 0.0]
    for port in stuck.values():
        port.free.set()


def test_no_more_than_three_readers_of_a_port_hang(tmp_path: Path) -> None:
    time = Time()
    all_stuck = [Stuck()]

    def make_port(name: str) -> Stuck:
        all_stuck.append(Stuck())
        return all_stuck[-1]

    with Live(settings(tmp_path), {**ports(), CAN: all_stuck[0]}, now=time, make_port=make_port) as live:
        live.play([tick_of(0)], step=True)
        for second in range(1, 10):
            assert all_stuck[-1].entered.wait(PATIENCE_S)
            pass_by(live, time, 31, GNSS)
            live.play([tick_of(second)], step=True)
        assert len(all_stuck) == 1 + reading.HUNG_MOST
        for port in all_stuck:
            port.free.set()
    assert sum(line.startswith("can: PORT_HUNG") for line in live.said) == reading.HUNG_MOST


def test_the_status_of_a_stalled_disk_and_a_hung_port_says_so(
    script: list[Raw], tmp_path: Path, gated: type[Gated]
) -> None:
    from edge_agent import status as st

    time, stuck, run = Time(), Stuck(), tmp_path / "run"
    made: dict[str, Any] = {**ports(), CAN: stuck}
    with Live(settings(tmp_path), made, make_recorder=gated, now=time, status_dir=run) as live:
        live.play([r for r in script[:60] if r.source != CAN], step=True)
        assert stuck.entered.wait(PATIENCE_S)
        live.settle()
        gated.gate.clear()
        live.play([tick_of(3)], step=True)
        assert gated.waiting.wait(PATIENCE_S)
        pass_by(live, time, 31, GNSS)
        live.play([tick_of(4)], step=True)
        at = EPOCH_UTC_NS + 4 * S
        until(lambda: (run / st.NAME).exists() and st.load([run])[1].written_utc_ns == at, "that status")
        s = st.load([run])[1]
        assert (s.disk.state, s.disk.stalled_s, s.disk.stalls) == ("stalled", 31.0, 1)
        assert [p.state for p in s.ports] == ["OK", "HUNG"]
        text = st.render(s, 80, 24, at + 100 * MS)
        assert "! the disk has not answered for 31 s: records wait in memory" in text
        assert "! port can HUNG for" in text
        gated.gate.set()
        stuck.free.set()


def test_a_reader_that_was_replaced_lets_go_of_its_device_without_a_word(tmp_path: Path) -> None:
    said: list[bool] = []

    class Port(ScriptedPort):
        def close(self, silently: bool = False) -> None:
            said.append(silently)

    for abandoned in (False, True):
        port, stop = Port(), threading.Event()
        reader = reading.Reader(CAN, port, ByteQueue(1000), reading.Account(), stop)

        def last(reader: reading.Reader = reader, stop: threading.Event = stop, gone: bool = abandoned) -> list[Any]:
            reader.abandoned = gone
            stop.set()
            return []

        port.read = last  # type: ignore[method-assign]
        reader.run()
    assert said == [False, True]


@pytest.mark.parametrize("hangs_in", ["read", "close", "open"])
def test_a_reader_that_was_to_open_its_port_again_and_hung_says_nothing_to_the_device_of_its_successor(
    hangs_in: str,
) -> None:
    """GIVEN a silent port that is due to be opened again, and whose driver hangs WHEN another reader has taken over and
    the driver comes back THEN all that the old reader still does is to let go of the device without a word."""
    time, calls = Time(), list[str]()
    stop = threading.Event()

    class Port(ScriptedPort):
        def __init__(self) -> None:
            super().__init__()
            self.given_up = False

        def call(self, name: str) -> None:
            calls.append(f"{name} after" if self.given_up else name)
            if name == hangs_in and not self.given_up:
                time.ns += 31 * S
                self.given_up = reader.abandon()

        def open(self) -> None:
            self.call("open")

        def read(self) -> list[tuple[int, Any]]:
            reader.reopen.set()
            self.call("read")
            return []

        def close(self, silently: bool = False) -> None:
            self.call("silent close" if silently else "close")

        def let_go(self) -> None:
            calls.append("let go")

    reader = reading.Reader(CAN, Port(), ByteQueue(1000), reading.Account(), stop, time)
    reader.run()
    assert reader.abandoned
    assert (
        calls
        == {
            "open": ["open", "let go", "silent close after"],
            "read": ["open", "read", "let go", "silent close after"],
            "close": ["open", "read", "close", "let go", "silent close after"],
        }[hangs_in]
    )
    assert reader.failure is None


def test_a_reader_that_came_back_in_time_keeps_its_port() -> None:
    time = Time()
    reader = reading.Reader(CAN, ScriptedPort(), ByteQueue(1000), reading.Account(), threading.Event(), time)
    assert not reader.abandon()  # in no call
    assert reader._begin()
    time.ns += 30 * S
    assert not reader.abandon()
    assert reader._begin()  # back, and in the next call
    time.ns += S
    assert not reader.abandon()
    time.ns += 30 * S
    assert reader.abandon()
    assert not reader._begin()


def test_frames_that_the_kernel_drops_are_told_once_a_second_and_the_journal_once_a_minute(
    script: list[Raw], tmp_path: Path
) -> None:
    """GIVEN a kernel that drops three frames of each block for ten minutes THEN the recording counts each second,
    stderr has a first line, one a minute and the rest at the end, and both sums are right."""
    run = Stepped(settings(tmp_path))
    blocks = [r for r in script if r.source == CAN][:2]
    for second in range(600):
        run.play([tick_of(second)])
        for i, r in enumerate(blocks):
            t_ns = START_NS + second * S + (i + 1) * 300 * MS
            payload = replace(r.payload, dropped=3 if second < 590 else 0, t_ns=r.payload.t_ns - r.t_ns + t_ns)  # type: ignore[union-attr,call-arg]
            run.play([Raw(t_ns, 0, CAN, payload)])
    run.close()
    files = run.files()
    lost = faults(files, "LOSS")
    assert {(f["source"], values(f)["count"]) for f in lost} == {(CAN, 6.0)}
    assert len(lost) == 590
    assert all("lost at kernel" in f["text"] for f in lost)
    lines = [line for line in run.said if "LOSS" in line]
    assert lines[0] == "can: LOSS: 6 lost at kernel"
    assert lines[2] == "can: LOSS: 360 more lost at kernel within 60 s"
    assert len(lines) == 11
    counts = [int(line.split(": ")[2].split()[0]) for line in lines]
    assert sum(counts) == 590 * 6 == run.agent._kernel[CAN]
    assert {int(d["dropped_kernel"]) for d in [ledgers(files)[CAN]]} == {590 * 6}


def test_what_is_said_of_losses() -> None:
    said: list[str] = []
    losses = runtime.Losses(said.append)
    losses.tell("inbox", "gnss", 2, 0)
    losses.tell("inbox", "gnss", 3, S)
    losses.tell("outbox", "/raw/can", 1, S)
    losses.every_second(59 * S)
    assert said == ["gnss: LOSS: 2 lost at inbox", "/raw/can: LOSS: 1 lost at outbox"]
    losses.every_second(60 * S)
    assert said[2:] == ["gnss: LOSS: 3 more lost at inbox within 60 s"]
    losses.every_second(120 * S)  # nothing more in this minute: the next is a first one again
    losses.tell("inbox", "gnss", 4, 121 * S)
    losses.tell("inbox", "gnss", 5, 122 * S)
    losses.close()
    losses.close()
    assert said[3:] == ["gnss: LOSS: 4 lost at inbox", "gnss: LOSS: 5 more lost at inbox"]
