"""Threads, bounded queues, supervision, shutdown: what turns the pipeline into a service.

    one reader per port --inbox--> main: Pipeline.step, encode --outbox--> writer: Recorder

Readers never block on a full inbox: the newest block is dropped and counted. Main refuses derived records above 75 % of
the outbox and raw ones only when it is full, before they are stepped, so what is recorded is what was stepped. Every
loss is written down as a LOSS on `/faults` as soon as there is room. The writer holds records in a bounded ring while
the disk refuses, and asks main for a fresh segment. A device that is lost is reopened with capped back-off; any other
exception ends the process (its supervisor restarts it). All buffers and their bounds stand in `RecordSettings`.
"""

from __future__ import annotations

import os
import platform
import shutil
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Protocol

import numpy as np

import drivers
from edge_agent import assemble, lock
from edge_agent import messages as m
from edge_agent.notify import Notifier
from edge_agent.pipeline import Pipeline
from edge_agent.queues import ByteQueue
from edge_agent.recording import topics
from edge_agent.recording.segments import Recorder, RecordingError, recover

MB = 1_000_000
DERIVED_SHARE = 0.75  # of the outbox: derived records can be recomputed from raw ones, so they go first
BACKOFF_S = (1.0, 60.0)  # first and longest wait before a port is opened again
RETRY_NS = 5 * m.S  # a refusing disk is tried again after so long
STATE_FILE = "state/kept.bin"
RECORD_OVERHEAD = 120  # bytes that a record costs in a queue beside its data
HEAD_RECORDS = 64  # Ticks, faults and diagnostics that wait for the first data; then the first file begins without

INFO, WARNING, ERROR = 20, 30, 40
Payload = bytes | m.CanFrames | m.Tick


class Port(Protocol):
    counters: dict[str, int]

    def open(self) -> None: ...
    def read(self) -> list[tuple[int, Payload]]: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Arrival:
    """What a reader puts into the inbox: a block that was read, or a fault of its port."""

    t_ns: int
    source: str
    payload: Payload | m.Fault


@dataclass(frozen=True, slots=True)
class Keep:
    """Order to the writer: put the slow state into the state directory."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Beat:
    """A Tick has come through the inbox and main: once the writer has it too, the supervisor is told."""

    lines: tuple[str, ...]


class Account:
    """Ledger of one port: received = written + queued + dropped + refused + lost; one thread writes each counter."""

    def __init__(self) -> None:
        self.received = 0  # reader
        self.dropped = 0  # reader: inbox full
        self.refused = 0  # main: outbox full
        self.written = 0  # writer
        self.lost = 0  # writer: the disk refused
        self.bytes = 0  # reader


class Reader(threading.Thread):
    """Reads one port for ever; opens it again when the device is lost."""

    def __init__(self, name: str, port: Port, inbox: ByteQueue[Arrival], account: Account, stop: threading.Event):
        super().__init__(name=f"read-{name}", daemon=True)
        self.source, self.port, self.inbox, self.account, self.stopping = name, port, inbox, account, stop
        self.failure: BaseException | None = None

    def run(self) -> None:
        try:
            self._run()
        except BaseException as e:  # noqa: BLE001 - main raises it and ends the process
            self._fault("CRASH", f"{type(e).__name__}: {e}")
            self.failure = e

    def _run(self) -> None:
        wait = BACKOFF_S[0]
        lost = False
        while not self.stopping.is_set():
            try:
                self.port.open()
                if lost:
                    self._fault("PORT_OPEN", "open again")
                while not self.stopping.is_set():
                    for t_ns, payload in self.port.read():
                        self._offer(t_ns, payload)
                        wait = BACKOFF_S[0]
            except drivers.PortError as e:
                self.port.close()
                self._fault("PORT_LOST", f"{e}; next try in {wait:.0f} s", (("retry_s", wait),))
                lost = True
                self.stopping.wait(wait)
                wait = min(2 * wait, BACKOFF_S[1])
        self.port.close()

    def _offer(self, t_ns: int, payload: Payload) -> None:
        size = payload_size(payload)
        self.account.received += 1
        self.account.bytes += size
        if not self.inbox.put(Arrival(t_ns, self.source, payload), size + RECORD_OVERHEAD):
            self.account.dropped += 1

    def _fault(self, kind: str, text: str, values: tuple[tuple[str, float], ...] = ()) -> None:
        t_ns = time.monotonic_ns()
        self.inbox.put(Arrival(t_ns, self.source, m.Fault(t_ns, self.source, kind, text, values)), 0, float("inf"))


def payload_size(payload: Payload) -> int:
    """Bytes that a payload holds in memory, near enough for a bound."""
    if isinstance(payload, bytes):
        return len(payload)
    if isinstance(payload, m.CanFrames):
        return int(payload.t_ns.size) * (14 + int(payload.data.shape[1]))
    return 32


class Writer(threading.Thread):
    """Drives the Recorder; holds records in a ring while the disk refuses."""

    def __init__(
        self,
        outbox: ByteQueue[m.Record | m.Rotate | Keep | Beat],
        recorder: Recorder,
        settings: m.RecordSettings,
        state_path: Path,
        accounts: Mapping[str, Account],
        notifier: Notifier,
    ) -> None:
        super().__init__(name="writer", daemon=True)
        self.notifier = notifier
        self.outbox, self.recorder, self.settings, self.state_path = outbox, recorder, settings, state_path
        self.accounts = accounts
        self.failure: BaseException | None = None
        self.want_rotate = False  # read and cleared by main
        self.holding = False  # no file is open, records wait in the ring; what main says of losses waits too
        self.open_file = (0, 0)  # Rotates taken so far, bytes of the open file; one value, so that both are of one time
        self.faults: deque[m.Fault] = deque()
        self.lost: dict[str, list[int]] = {}  # topic -> [count, first log_time, last log_time]
        self.lock = threading.Lock()
        self._rotates = 0
        self._ring: deque[m.Record | m.Rotate] = deque()  # empty, or begins with a Rotate
        self._ring_bytes = 0
        self._told = False  # of the disk's refusal
        self._retry_ns = 0

    def run(self) -> None:
        try:
            while not self.outbox.drained:
                items = self.outbox.take(min(self.settings.flush_s, 1.0), self.outbox.limit_bytes // 4)
                now = time.monotonic_ns()
                for item in items:
                    self._one(item, now)
                self._due(now)
            self._end(time.monotonic_ns())
        except BaseException as e:  # noqa: BLE001 - main raises it and ends the process
            self.failure = e

    def _end(self, now: int) -> None:
        if self.holding and self._ring:
            self._resume(now)
        for item in self._ring:
            self._lose(item)
        try:
            self.recorder.close()
        except RecordingError as e:
            self._failed(e, now)

    def _one(self, item: m.Record | m.Rotate | Keep | Beat, now: int) -> None:
        if isinstance(item, Keep):
            self._keep(item.data, now)
            return
        if isinstance(item, Beat):
            self.notifier.send("WATCHDOG=1", *item.lines)
            return
        self._rotates += isinstance(item, m.Rotate)
        if not self.holding:
            self._write(item, now)
            return
        self._hold(item, now)
        if isinstance(item, m.Rotate) and now >= self._retry_ns:
            self._resume(now)

    def _write(self, item: m.Record | m.Rotate, now: int) -> bool:
        """Whether a file is open behind it."""
        try:
            self.recorder.handle(item, now)
        except RecordingError as e:
            self._failed(e, now, item)
            return not self.holding
        if isinstance(item, m.Record) and (account := self._account(item)):
            account.written += 1
        return True

    def _account(self, record: m.Record) -> Account | None:
        return self.accounts.get(record.topic[5:]) if record.topic.startswith("/raw/") else None

    def _failed(self, e: RecordingError, now: int, item: m.Record | m.Rotate | None = None) -> None:
        """The disk refused, at `item` or at a flush. Main must see `holding` and `want_rotate` before what they hold
        back, or a LOSS or a fault would go where nothing is written."""
        self.holding = self.recorder.path is None
        waits = self.holding and isinstance(item, m.Rotate)  # no file could be begun: the order stands
        if self.holding and not waits:
            self.want_rotate = True
        for record in e.unwritten:
            if waits and isinstance(item, m.Rotate) and record is item.checkpoint:
                continue
            if record is not item and (account := self._account(record)):
                account.written -= 1
            self._lose(record)
        if waits and item is not None:
            self._hold(item, now)
        if not (self.holding and self._told):
            text = f"{e}; records wait in memory until the disk takes them" if self.holding else str(e)
            self.faults.append(m.Fault(now, "recorder", "DISK_" + e.reason.upper(), text))
        self._told = self.holding
        self._retry_ns = now + RETRY_NS

    def _hold(self, item: m.Record | m.Rotate, now: int) -> None:
        """Keep for later what follows a Rotate; over the bound the oldest segment is lost, and counted."""
        bound = self.settings.ring_mb * MB
        size = held_size(item)
        if isinstance(item, m.Record) and item.derived and self._ring_bytes + size > DERIVED_SHARE * bound:
            self._lose(item)
            return
        if self._ring and self._ring_bytes + size > bound:
            self._drop_oldest()
            if not self._ring and isinstance(item, m.Record):
                self.want_rotate = True  # a file can only begin at a checkpoint
            self.faults.append(m.Fault(now, "recorder", "RING_FULL", "the disk still refuses; held records are lost"))
        if self._ring or isinstance(item, m.Rotate):
            self._ring.append(item)
            self._ring_bytes += size
        else:
            self._lose(item)

    def _drop_oldest(self) -> None:
        """Lose the ring's first Rotate and what follows it up to the next."""
        while self._ring:
            item = self._ring.popleft()
            self._ring_bytes -= held_size(item)
            self._lose(item)
            if self._ring and isinstance(self._ring[0], m.Rotate):
                return

    def _resume(self, now: int) -> None:
        held, self._ring, self._ring_bytes = list(self._ring), deque(), 0
        good = True
        for item in held:
            if good:
                good = self._write(item, now)
            else:  # refused again: behind a Rotate the rest waits on, else it is lost
                self._hold(item, now)
        if good:
            self.holding = self._told = False
            self.faults.append(m.Fault(now, "recorder", "DISK_OK", "recording goes on"))

    def _due(self, now: int) -> None:
        if self.holding:
            if self._ring and now >= self._retry_ns:
                self._resume(now)
        else:
            try:
                self.recorder.idle(now)
            except RecordingError as e:
                self._failed(e, now)
        self.open_file = self._rotates, self.recorder.open_bytes
        self.faults.extend(self.recorder.drain_faults())

    def _lose(self, item: m.Record | m.Rotate) -> None:
        if isinstance(item, m.Rotate):
            return
        if account := self._account(item):
            account.lost += 1
        with self.lock:
            note_loss(self.lost, item)

    def _keep(self, data: bytes, now: int) -> None:
        try:
            self.state_path.parent.mkdir(parents=True, exist_ok=True)
            temporary = self.state_path.with_suffix(".new")
            with open(temporary, "wb") as f:
                f.write(data)
                f.flush()
                os.fsync(f.fileno())
            os.replace(temporary, self.state_path)
        except OSError as e:
            self.faults.append(m.Fault(now, "state", "STATE_NOT_KEPT", f"{self.state_path}: {e.strerror or e}"))


def held_size(item: m.Record | m.Rotate) -> int:
    """Bytes that an item costs while it is held."""
    return len(item.checkpoint.data if isinstance(item, m.Rotate) else item.data) + RECORD_OVERHEAD


def note_loss(lost: dict[str, list[int]], record: m.Record) -> None:
    """Add a lost record to the account by topic: count, first and last log_time."""
    entry = lost.setdefault(record.topic, [0, record.log_ns, record.log_ns])
    entry[0] += 1
    entry[1], entry[2] = min(entry[1], record.log_ns), max(entry[2], record.log_ns)


class PortWatch:
    """Says when a port falls silent, sends garbage, or never says a position; once per change of state."""

    SILENT_S = 5.0
    POSITION_S = 10.0

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.state = "START"
        self._seen: dict[str, int] = {}
        self._since: dict[str, int] = {}

    def look(self, t_ns: int, counts: Mapping[str, int]) -> tuple[str, str] | None:
        """counts: bytes (or frames), good (sentences or samples), positions, all cumulative. Return (state, text)."""
        for key, value in counts.items():
            if self._seen.get(key) != value or key not in self._since:
                self._since[key] = t_ns
            self._seen[key] = value
        age = {k: (t_ns - t) / m.S for k, t in self._since.items()}
        unit, good = ("bytes", "sentence") if self.kind == "serial" else ("frames", "sample")
        if age["bytes"] > self.SILENT_S:
            state, text = "SILENT", f"nothing has come for {age['bytes']:.0f} s: check power, cable and device"
            self._since["good"] = self._since["positions"] = t_ns  # what comes next gets its time to be understood
        elif age["good"] > self.SILENT_S:
            hint = "baud rate and protocol" if self.kind == "serial" else "bit rate, ids and DBC file"
            state = "GARBAGE" if self.kind == "serial" else "NO_MATCH"
            text = f"{unit} come, but no good {good} for {age['good']:.0f} s: check {hint}"
        elif self.kind == "serial" and age["positions"] > self.POSITION_S:
            state = "NO_POSITION"
            text = f"good sentences come, but no position for {age['positions']:.0f} s: switch on GGA (and GST)"
        elif not self._seen["good"] or (self.state == "SILENT" and age["good"] > 0):
            return None  # not yet known
        else:
            state, text = "OK", f"good {good}s come"
        if state == self.state:
            return None
        first, self.state = self.state == "START", state
        return None if first and state == "OK" else (state, text)


class Agent:
    """One run: wires ports, pipeline and recorder together with threads, until `stop` is set."""

    def __init__(
        self,
        config: m.Config,
        pipeline: Pipeline,
        ports: Mapping[str, Port],
        recorder: Recorder,
        say: Callable[[str], None],
        notifier: Notifier | None = None,
    ) -> None:
        self.config, self.pipeline, self.recorder, self._print = config, pipeline, recorder, say
        self.stop = threading.Event()
        record = config.record
        self.inbox: ByteQueue[Arrival] = ByteQueue(int(record.inbox_mb * MB))
        self.outbox: ByteQueue[m.Record | m.Rotate | Keep | Beat] = ByteQueue(int(record.outbox_mb * MB))
        self.accounts = {name: Account() for name in ports}
        state_path = Path(config.data_dir) / STATE_FILE
        self.notifier = notifier or Notifier(None)
        self.writer = Writer(self.outbox, recorder, record, state_path, self.accounts, self.notifier)
        self._beats = 0
        self._synced = True  # only what differs is said
        self.readers = {n: Reader(n, p, self.inbox, self.accounts[n], self.stop) for n, p in ports.items()}
        self._head: list[m.Record] = []  # what came before the first file
        self._open = False
        self._rotates = 0
        self._period = 0  # of the rotation grid that the open segment belongs to
        self._lost: dict[str, list[int]] = {}  # topic -> [count, first, last log_time], refused by the outbox
        self._dropped: dict[str, int] = dict.fromkeys(ports, 0)  # told so far
        self._kernel: dict[str, int] = {}
        self._watch = {n: PortWatch(config.ports[n].kind) for n in ports if n in config.ports and self._listeners(n)}
        self._stamp = 0  # log_time of what the runtime itself records

    def _listeners(self, port: str) -> list[str]:
        c = self.config
        receivers = [r.name for r in c.receivers.values() if r.port == port]
        return receivers + [a.name for a in c.accelerometers.values() if a.port == port]

    def run(self, found: Sequence[m.Fault] = ()) -> int:
        """Returns 0 after an orderly stop; raises what a thread raised, after what is in hand has been written.

        `found` = faults from before the start, recorded as soon as the time is known.
        """
        self.writer.start()
        try:
            self._run(found)
        finally:
            self.outbox.close()
            self.writer.join()
            for f in self.writer.faults:
                self._print(f"{f.source}: {f.kind}: {f.text}")
            for topic, (count, _, _) in self.writer.lost.items():
                self._print(f"lost at the disk, and told in no file: {count} of {topic}")
        if self.writer.failure is not None:
            raise self.writer.failure
        return 0

    def _run(self, found: Sequence[m.Fault]) -> None:
        clock = self.readers.pop("clock")
        clock.start()
        started = False
        everyone = [clock, *self.readers.values()]
        while True:
            for arrival in self.inbox.take(0.5):
                self._arrived(arrival)
                if not started and isinstance(arrival.payload, m.Tick):
                    started = True  # the map to UTC is known: now the sensors
                    ports = ", ".join(self.config.ports) or "no ports"
                    self.say(INFO, f"edge-agent {version('edge-agent')} at {self.config.site}: {ports}")
                    for fault in found:
                        self.fault(fault)
                    for reader in self.readers.values():
                        reader.start()
            self._failures(everyone)
            if self.stop.is_set():
                break
        self.notifier.send("STOPPING=1")
        for reader in everyone:
            if reader.ident is not None:
                reader.join(timeout=5.0)
        for arrival in self.inbox.take(0.0):
            self._arrived(arrival)
        for record in self.pipeline.finish():
            self._put(record)
        self._tell_losses()
        self._put(Keep(self.pipeline.slow()))
        self.say(INFO, "stopped")
        self._failures(everyone)

    def _failures(self, readers: list[Reader]) -> None:
        for failure in (*(r.failure for r in readers), self.writer.failure):
            if failure is not None:
                for arrival in self.inbox.take(0.0):  # the fault that tells of it among them
                    self._arrived(arrival)
                raise failure

    # ----------------------------------------------------------------------------------------------------- each block

    def _arrived(self, arrival: Arrival) -> None:
        if isinstance(arrival.payload, m.Fault):
            self.fault(arrival.payload)
            return
        tick = isinstance(arrival.payload, m.Tick)
        if not tick and self.outbox.bytes + payload_size(arrival.payload) > self.outbox.limit_bytes:
            self.accounts[arrival.source].refused += 1
            now = self.pipeline.to_utc(arrival.t_ns)
            note_loss(self._lost, m.Record(f"/raw/{arrival.source}", now, now, b"", False))
            return
        self._rotate_if_due(arrival.t_ns, tick)
        raw = m.Raw(arrival.t_ns, self.pipeline.order, arrival.source, arrival.payload)
        try:
            records = self.pipeline.step(raw)
        except BaseException:  # this program is wrong: the block that shows it must be in the recording
            self._put(topics.raw_record(raw, self.pipeline.segment_utc_ns))
            raise
        for record in records:
            self._put(record)
        if isinstance(arrival.payload, m.CanFrames) and arrival.payload.dropped:
            self._kernel[arrival.source] = self._kernel.get(arrival.source, 0) + arrival.payload.dropped
            self._loss("kernel", arrival.source, arrival.payload.dropped, arrival.t_ns, arrival.t_ns)
        if tick:
            self._every_second(arrival.t_ns)

    def _rotate_if_due(self, t_ns: int, tick: bool) -> None:
        record = self.config.record
        utc = self.pipeline.to_utc(t_ns)
        rotates, size = self.writer.open_file
        if not self._open:
            if tick and len(self._head) < HEAD_RECORDS:
                return  # no file before there is data
            self._rotate("start", t_ns)
            head, self._head = self._head, []
            for held in head:
                self._put(held)
        elif self.pipeline.rotate_due:
            self._rotate(self.pipeline.rotate_due, t_ns)
        elif self.writer.want_rotate:
            self._rotate("disk", t_ns)
        elif utc // (record.rotate_s * m.S) > self._period:
            self._rotate("time", t_ns)
        elif rotates == self._rotates and size >= record.rotate_mb * MB:
            self._rotate("size", t_ns)

    def _rotate(self, reason: str, t_ns: int) -> None:
        if self._open:
            self._tell_losses()  # in the file that they are about
        utc = self.pipeline.to_utc(t_ns)
        rotate = self.pipeline.rotate(reason, t_ns)
        if reason in ("start", "clock"):
            utc = rotate.utc_ns
        self._open = True
        self._rotates += 1
        self.writer.want_rotate = False
        # by the map before too: one that moves back a little must not cross the same border again
        self._period = max(utc, rotate.utc_ns) // (self.config.record.rotate_s * m.S)
        self._stamp = rotate.utc_ns
        self.outbox.put(rotate, len(rotate.checkpoint.data), float("inf"))
        self._transforms()
        self._put(Keep(self.pipeline.slow()))

    def _transforms(self) -> None:
        for receiver in self.pipeline.receivers.values():
            frame = receiver.frame
            if frame is not None:
                sensors = [*self.config.receivers, *self.config.accelerometers]
                tf = topics.station_transforms(frame.reference_llh, frame.origin_ecef_m, frame.azimuth_deg, sensors)
                self._own("/tf_static", topics.tf_static(tf, self._stamp))
                return

    def _put(self, item: m.Record | Keep | Beat) -> None:
        if isinstance(item, (Keep, Beat)):
            self.outbox.put(item, len(item.data) if isinstance(item, Keep) else 0, float("inf"))
            return
        if not self._open:
            if not item.derived:
                self._head.append(item)
            return
        share = DERIVED_SHARE if item.derived else float("inf")  # raw was weighed before it was stepped
        if not self.outbox.put(item, len(item.data) + RECORD_OVERHEAD, share):
            note_loss(self._lost, item)

    # ------------------------------------------------------------------------------------------- the runtime's records

    def _own(self, topic: str, data: bytes) -> None:
        self._put(m.Record(topic, self._stamp, self._stamp, data, False))

    def _stamped(self, t_ns: int) -> int:
        self._stamp = max(self._stamp, self.pipeline.segment_utc_ns, self.pipeline.to_utc(t_ns))
        return self._stamp

    def fault(self, f: m.Fault) -> None:
        """Say a fault on stderr and record it."""
        stamp = self._stamped(min(f.t_ns, time.monotonic_ns()))
        self._own("/faults", topics.event(f.kind, f.source, f.text, f.values, f.t_ns, stamp))
        self.say(WARNING if f.kind not in ("PORT_OPEN", "OK", "DISK_OK") else INFO, f"{f.source}: {f.kind}: {f.text}")

    def say(self, level: int, text: str) -> None:
        """One line on stderr and on /rosout."""
        self._print(text)
        self._own("/rosout", topics.log(level, "edge_agent", text, self._stamp))

    def _loss(self, where: str, source: str, count: int, begin_ns: int, end_ns: int) -> None:
        """A LOSS on /faults; times UTC by the segment's map when they come from records, else monotonic."""
        stamp = self._stamped(end_ns)
        to_utc = self.pipeline.to_utc
        text = f"{count} lost at {where}"
        self._print(f"{source}: LOSS: {text}")
        values = (("count", float(count)),)
        self._own(
            "/faults", topics.event("LOSS", source, text, values, end_ns, stamp, to_utc(begin_ns), to_utc(end_ns))
        )

    def _tell_losses(self) -> None:
        if self.writer.holding:
            return  # later, into a file
        offset = self.pipeline.to_utc(0)
        with self.writer.lock:
            disk, self.writer.lost = self.writer.lost, {}
        refused, self._lost = self._lost, {}
        for where, lost in (("outbox", refused), ("disk", disk)):
            for topic, (count, begin, end) in lost.items():
                self._loss(where, topic, count, begin - offset, end - offset)
        for name, account in self.accounts.items():
            new = account.dropped - self._dropped[name]
            if new:
                self._dropped[name] += new
                now = time.monotonic_ns()
                self._loss("inbox", name, new, now - m.S, now)

    def _every_second(self, t_ns: int) -> None:
        self._stamped(t_ns)
        while self.writer.faults and not self.writer.want_rotate:
            self.fault(self.writer.faults.popleft())
        if self.outbox.bytes < DERIVED_SHARE * self.outbox.limit_bytes:
            self._tell_losses()
        if self.pipeline.wall.sync != self._synced:
            self._synced = self.pipeline.wall.sync
            words = "is disciplined" if self._synced else "is NOT disciplined: fixes rest on a latency set or assumed"
            self.say(INFO if self._synced else WARNING, f"clock: the host's clock {words}")
        counters = self.pipeline.counters()
        for port, watch in self._watch.items():
            names = self._listeners(port)
            good = "accepted" if watch.kind == "serial" else "samples"
            counts = {
                "bytes": self.accounts[port].bytes,
                "good": sum(counters[n].get(good, 0) for n in names),
                "positions": sum(counters[n].get("positions", 0) for n in names),
            }
            told = watch.look(t_ns, counts)
            if told:
                self.fault(m.Fault(t_ns, port, told[0], told[1]))
        self._own("/diagnostics", topics.diagnostics(self._statuses(counters), self._stamp))
        states = ", ".join(f"{port} {watch.state}" for port, watch in self._watch.items())
        self._beats += 1  # at the second one, every port has been tried
        self._put(Beat((*(("READY=1",) if self._beats == 2 else ()), f"STATUS={states or 'no sensors'}")))

    def _statuses(self, counters: Mapping[str, Mapping[str, int]]) -> list[topics.Status]:
        status = topics.Status
        found = []
        for name, a in self.accounts.items():
            queued = a.received - a.written - a.dropped - a.refused - a.lost
            ledger = {
                "received": a.received,
                "written": a.written,
                "queued": queued,
                "dropped_inbox": a.dropped,
                "refused_outbox": a.refused,
                "lost_disk": a.lost,
                "dropped_kernel": self._kernel.get(name, 0),
                "bytes": a.bytes,
            }
            state = self._watch[name].state if name in self._watch else "OK"
            level = 0 if state in ("OK", "START") and not (a.dropped or a.refused or a.lost) else 1
            found.append(status(level, f"port/{name}", state, {k: str(v) for k, v in ledger.items()}))
        for name, count in counters.items():
            found.append(status(0, f"codec/{name}", "", {k: str(v) for k, v in count.items()}))
        free = free_bytes(Path(self.config.data_dir))
        wall = self.pipeline.wall
        values = {
            "inbox_bytes": str(self.inbox.bytes),
            "outbox_bytes": str(self.outbox.bytes),
            "file_bytes": str(self.writer.open_file[1]),
            "disk_free_bytes": str(free),
            "rss_bytes": str(resident_bytes()),
            "clock_sync": str(int(wall.sync)),
            "clock_error_ns": str(wall.error_ns),
        }
        found.append(status(0 if wall.sync else 1, "agent", "" if wall.sync else "clock not disciplined", values))
        return found


def free_bytes(path: Path) -> int:
    """Free space of the file system that holds `path`, or its nearest parent that exists; -1 where it does not say."""
    try:
        while not path.exists():
            path = path.parent
        return shutil.disk_usage(path).free
    except OSError:
        return -1


def resident_bytes() -> int:
    """Resident memory of this process; 0 where /proc does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0


def run_metadata(config: m.Config, run_id: str) -> dict[str, str]:
    """What every segment says of the run that wrote it."""
    return {
        "run": run_id,
        "version": version("edge-agent"),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "platform": assemble.platform_name(),
        "started_utc_ns": str(time.time_ns()),
    }


def run(config: m.Config) -> int:
    """The service: recover, open, read, fuse and record until SIGTERM or SIGINT."""

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    data_dir = Path(config.data_dir)
    pipeline = assemble.pipeline(config)
    now = time.monotonic_ns()
    found: list[m.Fault] = []
    try:
        lock.hold(data_dir)  # before anything there is touched
        for r in recover(data_dir):
            text = f"{r.path.name}: {r.what}, {r.messages} messages kept {r.detail}".strip()
            found.append(m.Fault(now, "recorder", "RECOVERED", text))
    except OSError as e:  # the card may come back; until then records wait in memory
        found.append(m.Fault(now, "recorder", "DISK_IO", f"data_dir {data_dir}: {e.strerror or e}"))
    kept = data_dir / STATE_FILE
    if kept.exists():
        try:
            pipeline.adopt(kept.read_bytes())
        except (OSError, ValueError) as e:
            pipeline = assemble.pipeline(config)
            aside = kept.with_suffix(".refused")
            with suppress(OSError):
                os.replace(kept, aside)
            found.append(m.Fault(now, "state", "STATE_REFUSED", f"{kept.name}: {e}; moved to {aside.name}"))
    make = drivers.load
    ports: dict[str, Port] = {n: make(drivers.PORTS, s.kind)(s) for n, s in config.ports.items()}
    ports["clock"] = make(drivers.PORTS, "clock")(m.PortSettings("clock", "clock"))
    attachments = {"config.yaml": config.text.encode(), **dict(config.files)}
    metadata = run_metadata(config, os.urandom(8).hex())
    recorder = Recorder(data_dir, config.record, config.site, metadata, attachments, lambda: free_bytes(data_dir))
    agent = Agent(config, pipeline, ports, recorder, say, Notifier(os.environ.get("NOTIFY_SOCKET")))

    def on_signal(number: int, frame: FrameType | None) -> None:
        agent.stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    return agent.run(found)
