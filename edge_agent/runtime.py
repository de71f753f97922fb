"""Threads, supervision, shutdown: what turns the pipeline into a service.

    one reader per port --inbox--> main: Pipeline.step, encode --outbox--> writer: Recorder
                                     `--Status, once a second--> publisher: status.json, edge-agent.prom

Readers (`reading.py`) never block on a full inbox: the newest block is dropped and counted. Main refuses derived
records above 75 % of the outbox and raw ones when it is full, before they are stepped, so what is recorded is what was
stepped; Ticks and its own records have a reserve. Every loss is written down as a LOSS on `/faults` as soon as there is
room, and once a second the ledger of each port must balance:

    received = written + queued + dropped(inbox) + refused(outbox) + lost(disk)

where `queued` is counted one by one where blocks wait; what is missing is a fault LEDGER. The writer (`writing.py`)
holds records in a bounded ring while the disk refuses, and asks main for a fresh segment; when it does not come back
from the disk for 5 s, that is a fault WRITER_STALLED. What the agent says of itself is gathered in `observe.py`. Any
exception that is not a port's or the disk's ends the process (its supervisor restarts it). All buffers and their bounds
stand in `RecordSettings`.
"""

from __future__ import annotations

import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from types import FrameType

import numpy as np

import drivers
from edge_agent import assemble, lock
from edge_agent import messages as m
from edge_agent import status as st
from edge_agent.memory import grow_names, steady_memory
from edge_agent.notify import Notifier
from edge_agent.observe import Observer, Publisher, resident_bytes
from edge_agent.pipeline import Pipeline
from edge_agent.queues import ByteQueue
from edge_agent.reading import (
    HUNG_MOST,
    HUNG_S,
    RECORD_OVERHEAD,
    Account,
    Arrival,
    Payload,
    Port,
    PortWatch,
    Reader,
    payload_size,
)
from edge_agent.recording import topics
from edge_agent.recording.clips import FOLDER as CLIPS_FOLDER
from edge_agent.recording.clips import Clips
from edge_agent.recording.segments import Recorder, recover
from edge_agent.writing import DERIVED_SHARE, MB, Beat, Keep, Writer, free_bytes, note_loss

BOOT_VARIABLE = "EDGE_AGENT_BOOT"
STALLED_S = 5.0  # the writer is at one operation so long
STATE_FILE = "state/kept.bin"
READERS_S = 5.0  # at a stop, what all readers together may take to come back from their drivers
CLIPS_S = 10.0  # at a stop, what clips may still take
RESERVE_BYTES = MB  # of the outbox beyond its bound, for Ticks and for what tells of the loss
LOSSES_S = 60.0  # how often stderr is told of losses that go on
HEAD_RECORDS = 64  # Ticks, faults and diagnostics that wait for the first data; then the first file begins without

INFO, WARNING, ERROR = 20, 30, 40
GOOD_NEWS = ("PORT_OPEN", "OK", "DISK_OK", "WRITER_OK", "STATUS_OK", "FSYNC_OK", "CLIP")


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
        status_dir: Path | None = None,
        make_port: Callable[[str], Port] | None = None,
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """`status_dir` = where the status goes, None = nowhere; `make_port` makes the port of a reader that takes over
        from one that hangs; `now` = monotonic ns, for what is said to hang."""
        self.config, self.pipeline, self.recorder, self._print = config, pipeline, recorder, say
        self._make_port, self._now = make_port, now
        self.stop = threading.Event()
        record = config.record
        self.inbox: ByteQueue[Arrival] = ByteQueue(int(record.inbox_mb * MB))
        self.outbox: ByteQueue[m.Record | m.Rotate | Keep | Beat] = ByteQueue(int(record.outbox_mb * MB))
        self.accounts = {name: Account() for name in ports}
        state_path = Path(config.data_dir) / STATE_FILE
        self.notifier = notifier or Notifier(None)
        self.writer = Writer(self.outbox, recorder, record, state_path, self.accounts, self.notifier, now)
        self.observer = Observer(config, pipeline)
        self.clips = Clips(recorder, config.events, config.triggers.values()) if config.triggers else None
        self.publisher = None if status_dir is None else Publisher(status_dir)
        self._beats = 0
        self._last_tick: tuple[int, int] | None = None  # monotonic, UTC
        self._synced = True  # only what differs is said
        self.readers = {n: Reader(n, p, self.inbox, self.accounts[n], self.stop, now) for n, p in ports.items()}
        self._abandoned: list[Reader] = []
        self._stalled_s = 0.0  # the writer has been at one operation so long
        self._stalls = 0
        self._unaccounted: dict[str, int] = {}  # port or codec -> what its ledger cannot account for, as told
        self._status_failed = False  # as told
        self._head: list[m.Record] = []  # what came before the first file
        self._open = False
        self._rotates = 0
        self._period = 0  # of the rotation grid that the open segment belongs to
        self._lost: dict[str, list[int]] = {}  # topic -> [count, first, last log_time], refused by the outbox
        self._dropped: dict[str, int] = dict.fromkeys(ports, 0)  # told so far
        self._kernel: dict[str, int] = {}
        self._overrun: dict[str, list[int]] = {}  # of that, not yet told: [count, first, last t_ns]
        self._losses = Losses(say)
        self._watch = {n: PortWatch(config.ports[n].kind) for n in ports if n in config.ports and self._listeners(n)}
        self._stamp = 0  # log_time of what the runtime itself records
        self._tick_ns = 0  # the last second

    def _listeners(self, port: str) -> list[str]:
        c = self.config
        receivers = [r.name for r in c.receivers.values() if r.port == port]
        return receivers + [a.name for a in c.accelerometers.values() if a.port == port]

    def run(self, found: Sequence[m.Fault] = ()) -> int:
        """Returns 0 after an orderly stop, 1 where data came and nothing of it could be written in the whole run, 3
        where the disk refused at the end and what was lost there is told in no file; raises what a thread raised, after
        what is in hand has been written.

        `found` = faults from before the start, recorded as soon as the time is known.
        """
        self.writer.start()
        if self.clips is not None:
            self.clips.start()
        if self.publisher is not None:
            self.publisher.start()
        state = "failed"
        try:
            self._run(found)
            state = "stopped"
        except BaseException as e:
            self.say(ERROR, f"failed: {type(e).__name__}: {e}")
            raise
        finally:
            self.outbox.close()
            self.writer.join()
            if self.clips is not None:
                self.clips.close(time.monotonic_ns())
                self.clips.join(CLIPS_S)
                self.writer.faults.extend(self.clips.faults)
            if self.publisher is not None:
                if self._last_tick is not None:
                    self.publisher.offer(self._status(*self._last_tick, state))
                self.publisher.close()
            self._losses.close()
            for f in self.writer.faults:
                self._print(f"{f.source}: {f.kind}: {f.text}")
            for topic, (count, _, _) in self.writer.lost.items():
                self._print(f"lost at the disk, and told in no file: {count} of {topic}")
        if self.writer.failure is not None:
            raise self.writer.failure
        sensors = [a for name, a in self.accounts.items() if name != "clock"]
        if any(a.refused or a.dropped or a.lost for a in sensors) and not any(a.written for a in sensors):
            self._print("nothing that came could be recorded")
            return 1
        return 3 if any(topic.startswith("/raw/") for topic in self.writer.lost) else 0

    def _run(self, found: Sequence[m.Fault]) -> None:
        self.readers["clock"].start()
        started = False
        while True:
            for arrival in self.inbox.take(0.5):
                self._arrived(arrival)
                if not started and isinstance(arrival.payload, m.Tick):
                    started = True  # the map to UTC is known: now the sensors
                    ports = ", ".join(self.config.ports) or "no ports"
                    self.say(INFO, f"edge-agent {version('edge-agent')} at {self.config.site}: {ports}")
                    for fault in found:
                        self.fault(fault)
                    for name in self.config.ports:
                        self.readers[name].start()
            self._failures()
            if self.stop.is_set():
                break
        self.notifier.send("STOPPING=1")
        end = time.monotonic() + READERS_S
        for reader in self.readers.values():
            if reader.ident is not None:
                reader.join(timeout=max(0.0, end - time.monotonic()))
        for arrival in self.inbox.take(0.0):
            self._arrived(arrival)
        for record in self.pipeline.finish():
            self._put(record)
        self._tell_losses()
        self._put(Keep(self.pipeline.slow()))
        self.say(INFO, "stopped")
        self._failures()

    def _failures(self) -> None:
        threads = (*self.readers.values(), self.writer, self.publisher, self.clips)
        for failure in [t.failure for t in threads if t is not None]:
            if failure is not None:
                for arrival in self.inbox.take(0.0):  # the fault that tells of it among them
                    self._arrived(arrival)
                raise failure

    # ----------------------------------------------------------------------------------------------------- each block

    def _arrived(self, arrival: Arrival) -> None:
        payload = arrival.payload
        if isinstance(payload, m.Fault):
            self.fault(payload)
            return
        tick = isinstance(payload, m.Tick)
        room = self.outbox.limit_bytes + (RESERVE_BYTES if tick else 0)
        if self.outbox.bytes + payload_size(payload) > room:
            self.accounts[arrival.source].refused += 1
            now = self.pipeline.to_utc(arrival.t_ns)
            note_loss(self._lost, m.Record(f"/raw/{arrival.source}", now, now, b"", False))
        else:
            self._step(arrival, payload, tick)
        if isinstance(payload, m.Tick):
            self._every_second(arrival.t_ns, payload.utc_ns)

    def _step(self, arrival: Arrival, payload: Payload, tick: bool) -> None:
        self._rotate_if_due(arrival.t_ns, tick)
        self._stamped(arrival.t_ns)  # what the runtime says next comes after this block
        raw = m.Raw(arrival.t_ns, self.pipeline.order, arrival.source, payload)
        try:
            records = self.pipeline.step(raw)
        except BaseException:  # this program is wrong: the block that shows it must be in the recording
            self._put(topics.raw_record(raw, self.pipeline.segment_utc_ns))
            raise
        for record in records:
            self._put(record)
            if record.topic == "/events" and self.clips is not None:
                self.clips.saw(record, self.pipeline.to_utc(0))
        if isinstance(payload, m.CanFrames) and payload.dropped:
            self._kernel[arrival.source] = self._kernel.get(arrival.source, 0) + payload.dropped
            entry = self._overrun.setdefault(arrival.source, [0, arrival.t_ns, arrival.t_ns])
            entry[0] += payload.dropped
            entry[2] = arrival.t_ns

    def _rotate_if_due(self, t_ns: int, tick: bool) -> None:
        record = self.config.record
        utc = self.pipeline.to_utc(t_ns)
        rotates, size = self.writer.open_file
        if not self._open:
            if tick and len(self._head) < HEAD_RECORDS:
                return  # no file before there is data
            self._rotate("start", t_ns)
        elif self.outbox.bytes > DERIVED_SHARE * self.outbox.limit_bytes:
            return  # a checkpoint is large, and the writer is behind: all of these can wait
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
        head, self._head = sorted(self._head, key=lambda r: r.log_ns), []
        if head:  # the first file: log times must not step back behind the checkpoint
            first = min(head[0].log_ns, rotate.checkpoint.log_ns)
            rotate = replace(rotate, checkpoint=replace(rotate.checkpoint, log_ns=first, publish_ns=first))
        self.outbox.put(rotate, len(rotate.checkpoint.data), float("inf"))
        for held in head:
            self._put(held)
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
        source = item.topic[5:] if item.topic.startswith("/raw/") else ""  # was weighed before it was stepped
        own = 1.0 + RESERVE_BYTES / self.outbox.limit_bytes
        share = float("inf") if source else DERIVED_SHARE if item.derived else own
        if not self.outbox.put(item, len(item.data) + RECORD_OVERHEAD, share, source):
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
        self.say(INFO if f.kind in GOOD_NEWS else WARNING, f"{f.source}: {f.kind}: {f.text}")
        self.observer.fault(f)
        if self.clips is not None:
            self.clips.fault(f.kind, f.t_ns)

    def say(self, level: int, text: str) -> None:
        """One line on stderr and on /rosout."""
        self._print(text)
        self._own("/rosout", topics.log(level, "edge_agent", text, self._stamp))

    def _loss(self, where: str, source: str, count: int, begin_ns: int, end_ns: int) -> None:
        """A LOSS on /faults; times UTC by the segment's map when they come from records, else monotonic."""
        stamp = self._stamped(end_ns)
        to_utc = self.pipeline.to_utc
        text = f"{count} lost at {where}"
        self.observer.loss(where, source, count, self._tick_ns)
        if self.clips is not None:
            self.clips.fault("LOSS", end_ns)
        self._losses.tell(where, source, count, self._tick_ns)
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
        overrun, self._overrun = self._overrun, {}
        for name, (count, begin, end) in overrun.items():
            self._loss("kernel", name, count, begin, end)

    # ----------------------------------------------------------------------------------------------------- each second

    def _every_second(self, t_ns: int, utc_ns: int) -> None:
        self._tick_ns = t_ns
        self._losses.every_second(t_ns)
        self._stamped(t_ns)
        while self.writer.faults and not self.writer.want_rotate:
            self.fault(self.writer.faults.popleft())
        if self.clips is not None:
            self.clips.every_second(t_ns)
            while self.clips.faults:
                self.fault(self.clips.faults.popleft())
        if self.outbox.bytes < DERIVED_SHARE * self.outbox.limit_bytes:
            self._tell_losses()
        if self.pipeline.wall.sync != self._synced:
            self._synced = self.pipeline.wall.sync
            words = "is disciplined" if self._synced else "is NOT disciplined: fixes rest on a latency set or assumed"
            self.say(INFO if self._synced else WARNING, f"clock: the host's clock {words}")
        counters = self.pipeline.counters()
        self._watch_ports(t_ns, counters)
        self._watch_writer(t_ns)
        self._watch_status(t_ns)
        pages = self._pages()
        self._watch_ledgers(t_ns, pages, counters)
        self._own("/diagnostics", topics.diagnostics(self._statuses(pages, counters), self._stamp))
        states = ", ".join(f"{port} {watch.state}" for port, watch in self._watch.items())
        self._beats += 1  # at the second one, every port has been tried
        self._put(Beat((*(("READY=1",) if self._beats == 2 else ()), f"STATUS={states or 'no sensors'}")))
        self._last_tick = t_ns, utc_ns
        if self.publisher is not None:
            self.publisher.offer(self._status(t_ns, utc_ns, "running", pages))

    def _watch_ports(self, t_ns: int, counters: Mapping[str, Mapping[str, int]]) -> None:
        for port, watch in self._watch.items():
            names = self._listeners(port)
            good = "accepted" if watch.kind == "serial" else "samples"
            counts = {
                "bytes": self.accounts[port].bytes,
                "good": sum(counters[n].get(good, 0) for n in names),
                "positions": sum(counters[n].get("positions", 0) for n in names),
                "bus_off": self.readers[port].port.counters.get("error_bus_off", 0),
            }
            told = watch.look(t_ns, counts)
            if told:
                self.fault(m.Fault(t_ns, port, told[0], told[1]))
            reader = self.readers[port]
            if reader.busy_ns and self._now() - reader.busy_ns > HUNG_S * m.S:
                self._take_over(port, reader, t_ns)
            elif (next_s := watch.reopen_due(t_ns)) and reader.state == "OPEN":
                if watch.reopens == 1:  # told once per silence
                    text = f"still silent: opened again, and again after {next_s:.0f} s and more"
                    self.fault(m.Fault(t_ns, port, "PORT_REOPEN", text))
                reader.reopen.set()

    def _take_over(self, port: str, reader: Reader, t_ns: int) -> None:
        """A driver does not come back: a fresh reader tries with a port of its own."""
        self._abandoned = [r for r in self._abandoned if r.is_alive()]
        if self._make_port is None or sum(r.source == port for r in self._abandoned) >= HUNG_MOST:
            return
        if not reader.abandon():
            return  # it has come back just now
        text = f"its driver has been in one call for {HUNG_S:.0f} s; another reader takes over"
        self.fault(m.Fault(t_ns, port, "PORT_HUNG", text))
        self._abandoned.append(reader)
        fresh = Reader(port, self._make_port(port), self.inbox, self.accounts[port], self.stop, self._now)
        fresh.state = "LOST"  # until it is open
        self.readers[port] = fresh
        fresh.start()

    def _watch_writer(self, t_ns: int) -> None:
        busy = self.writer.busy_ns
        seconds = (self._now() - busy) / m.S if busy else 0.0
        if seconds > STALLED_S:
            if not self._stalled_s:
                self._stalls += 1
                text = f"the disk has not answered for {seconds:.0f} s; records wait in memory"
                self.fault(m.Fault(t_ns, "recorder", "WRITER_STALLED", text, (("stalled_s", seconds),)))
            self._stalled_s = seconds
        elif self._stalled_s:
            text = f"the disk answers again, after {self._stalled_s:.0f} s and more"
            self.fault(m.Fault(t_ns, "recorder", "WRITER_OK", text, (("stalled_s", self._stalled_s),)))
            self._stalled_s = 0.0

    def _watch_status(self, t_ns: int) -> None:
        """A status that cannot be written is told once, and once when it can again."""
        if self.publisher is None or bool(self.publisher.error) == self._status_failed:
            return
        self._status_failed = not self._status_failed
        if self._status_failed:
            text = f"{self.publisher.error}; the agent goes on"
            self.fault(m.Fault(t_ns, "status", "STATUS_NOT_WRITTEN", text))
        else:
            self.fault(m.Fault(t_ns, "status", "STATUS_OK", f"written again, {self.publisher.failed} could not be"))

    # ---------------------------------------------------------------------------------------------------------- ledger

    def _pages(self) -> dict[str, Page]:
        """The ledger of each port now. Readers and writer go on meanwhile: each part is taken at a moment when it
        agrees in itself, and what the writer took since it last closed its books is in its hand."""
        books = self.writer.books
        outbox, taken = self.outbox.account()
        found = {}
        for name, account in self.accounts.items():
            with account.lock:
                received, dropped, size = account.received, account.dropped, account.bytes
                inbox = self.inbox.account()[0][name]
            head = sum(r.topic == f"/raw/{name}" for r in self._head)
            page = books[name]
            queued = inbox + head + outbox[name] + (taken[name] - page.taken) + page.ring
            found[name] = Page(received, page.written, queued, dropped, account.refused, page.lost, size)
        return found

    def _watch_ledgers(self, t_ns: int, pages: Mapping[str, Page], counters: Mapping[str, Mapping[str, int]]) -> None:
        for name, page in pages.items():
            said = ", ".join(f"{k} {v}" for k, v in page.figures().items())
            self._balance(t_ns, name, page.unaccounted, f"blocks are unaccounted for: {said}")
        for name, c in counters.items():
            rejects = sum(self.observer.rejects[name].values())
            self._balance(t_ns, name, c["rejected"] - rejects, f"of {c['rejected']} rejects came without a reason")
            if name in self.config.accelerometers:
                whole, parts = "frames", {k: c[k] for k in ("accepted", "duplicates", "rejected", "pending")}
            else:
                whole, parts = "bytes", {k: c[k] for k in ("sentence_bytes", "binary_bytes", "skipped_bytes")}
                parts["waiting"] = self.pipeline.receivers[name].codec.waiting
            said = ", ".join(f"{k} {v}" for k, v in parts.items())
            text = f"{whole} of {c[whole]} are unaccounted for: {said}"
            self._balance(t_ns, f"{name} {whole}", c[whole] - sum(parts.values()), text)

    def _balance(self, t_ns: int, name: str, missing: int, text: str) -> None:
        """A ledger that does not balance is a bug: told whenever the difference changes."""
        if missing == self._unaccounted.get(name, 0):
            return
        self._unaccounted[name] = missing
        self.fault(m.Fault(t_ns, name, "LEDGER", f"{missing} {text}", (("missing", float(missing)),)))

    # ---------------------------------------------------------------------------------------------------------- status

    def _statuses(self, pages: Mapping[str, Page], counters: Mapping[str, Mapping[str, int]]) -> list[topics.Status]:
        status = topics.Status
        found = []
        for name, page in pages.items():
            ledger = {**page.figures(), "dropped_kernel": self._kernel.get(name, 0), "bytes": page.bytes}
            state = self._watch[name].state if name in self._watch else "OK"
            good = state in ("OK", "START") and not (page.dropped or page.refused or page.lost or page.unaccounted)
            found.append(status(0 if good else 1, f"port/{name}", state, {k: str(v) for k, v in ledger.items()}))
        for name, count in counters.items():
            found.append(status(0, f"codec/{name}", "", {k: str(v) for k, v in count.items()}))
        wall = self.pipeline.wall
        values = {
            "inbox_bytes": str(self.inbox.bytes),
            "outbox_bytes": str(self.outbox.bytes),
            "file_bytes": str(self.writer.open_file[1]),
            "disk_free_bytes": str(self.writer.disk.free_bytes),
            "writer_stalled_s": f"{self._stalled_s:.0f}",
            "writer_stalls": str(self._stalls),
            "fsync_s": f"{self.recorder.fsync_ns / m.S:.3f}",
            "fsyncs_late": str(self.recorder.fsyncs_late),
            "rss_bytes": str(resident_bytes()),
            "clock_sync": str(int(wall.sync)),
            "clock_error_ns": str(wall.error_ns),
        }
        found.append(status(0 if wall.sync else 1, "agent", "" if wall.sync else "clock not disciplined", values))
        return found

    def _status(self, t_ns: int, utc_ns: int, state: str, pages: Mapping[str, Page] | None = None) -> st.Status:
        seen, writer, limit = self.writer.disk, self.writer, self.config.record.ring_mb * MB
        recording = (
            "closed"
            if state != "running"
            else "stalled"
            if self._stalled_s
            else "refused"
            if writer.holding
            else "recording"
        )
        disk = st.Disk(
            os.path.abspath(self.config.data_dir),
            recording if seen.file or recording != "recording" else "waiting",
            seen.free_bytes,
            seen.size_bytes,
            seen.file,
            writer.open_file[1],
            (utc_ns - seen.begin_utc_ns) / m.S if seen.file else None,
            seen.files,
            seen.files_bytes,
            seen.oldest_utc_ns,
            self._stalled_s,
            self._stalls,
        )
        queues = [
            st.Queue("inbox", self.inbox.bytes, self.inbox.limit_bytes, len(self.inbox)),
            st.Queue("outbox", self.outbox.bytes, self.outbox.limit_bytes, len(self.outbox)),
            st.Queue("ring", writer.ring_bytes, int(limit), writer.ring_items),
        ]
        pages = pages or self._pages()
        ports = [self._port_status(n, s, pages[n], t_ns) for n, s in self.config.ports.items()]
        said = self.recorder.metadata
        run = said.get("run", ""), said.get("version", ""), state
        return self.observer.status(t_ns, utc_ns, run, ports, queues, disk)

    def _port_status(self, name: str, s: m.PortSettings, page: Page, t_ns: int) -> st.Port:
        reader = self.readers[name]
        state = reader.state
        if reader.busy_ns and self._now() - reader.busy_ns > HUNG_S * m.S:
            state = "HUNG"
        elif state == "OPEN" and name in self._watch and self._watch[name].state != "START":
            state = self._watch[name].state
        age, flow = self.observer.port_flow(name, page.bytes, t_ns)
        return st.Port(
            name,
            s.device or f"{s.interface} {s.channel}",
            state,
            self.observer.port_state(name, state, t_ns),
            age,
            page.bytes,
            flow,
            self.accounts[name].reopened,
            page.received,
            page.written,
            page.queued,
            page.dropped,
            page.refused,
            page.lost,
            self._kernel.get(name, 0),
            page.unaccounted,
        )


class Losses:
    """What is said of losses on stderr, which a journal keeps: the first of a place at once, then its sum once a
    minute, and what is left at the end. The recording holds each second's."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say = say
        self._waiting: dict[tuple[str, str], list[int]] = {}  # (where, source) -> [count not yet said, when said last]

    def tell(self, where: str, source: str, count: int, now_ns: int) -> None:
        """`count` more are lost there."""
        entry = self._waiting.get((where, source))
        if entry is None:
            self._say(f"{source}: LOSS: {count} lost at {where}")
            self._waiting[where, source] = [0, now_ns]
        else:
            entry[0] += count

    def every_second(self, now_ns: int) -> None:
        """Say what a minute has gathered; of a minute without a loss nothing, and the next loss is a first one."""
        for (where, source), (count, said_ns) in list(self._waiting.items()):
            if now_ns - said_ns < LOSSES_S * m.S:
                continue
            del self._waiting[where, source]
            if count:
                self._say(f"{source}: LOSS: {count} more lost at {where} within {LOSSES_S:.0f} s")
                self._waiting[where, source] = [0, now_ns]

    def close(self) -> None:
        """The end: what has not been said."""
        for (where, source), (count, _) in self._waiting.items():
            if count:
                self._say(f"{source}: LOSS: {count} more lost at {where}")
        self._waiting.clear()


@dataclass(frozen=True, slots=True)
class Page:
    """The ledger of one port, in blocks."""

    received: int
    written: int
    queued: int
    dropped: int
    refused: int
    lost: int
    bytes: int

    @property
    def unaccounted(self) -> int:
        return self.received - self.written - self.queued - self.dropped - self.refused - self.lost

    def figures(self) -> dict[str, int]:
        """By the names of `/diagnostics`."""
        return {
            "received": self.received,
            "written": self.written,
            "queued": self.queued,
            "dropped_inbox": self.dropped,
            "refused_outbox": self.refused,
            "lost_disk": self.lost,
        }


def boot_id() -> str:
    """The kernel's name for this boot, so that a kill and a power cut can be told apart later; "" where it has none.
    The unit gives it: a service that sees nothing of /proc but processes cannot ask."""
    if given := os.environ.get(BOOT_VARIABLE, ""):
        return given.replace("-", "")
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", "")
    except OSError:
        return ""


def run_metadata(config: m.Config, run_id: str) -> dict[str, str]:
    """What every segment says of the run that wrote it."""
    return {
        "run": run_id,
        "version": version("edge-agent"),
        "numpy": np.__version__,
        "python": platform.python_version(),
        "platform": assemble.platform_name(),
        "started_utc_ns": str(time.time_ns()),
        "boot": boot_id(),
    }


def run(config: m.Config) -> int:
    """The service: recover, open, read, fuse and record until SIGTERM or SIGINT."""

    def say(text: str) -> None:
        print(text, file=sys.stderr, flush=True)

    steady_memory()
    grow_names()
    data_dir = Path(config.data_dir)
    pipeline = assemble.pipeline(config)
    now = time.monotonic_ns()
    found: list[m.Fault] = []
    try:
        lock.hold(data_dir)  # before anything there is touched
        for r in (*recover(data_dir), *recover(data_dir / CLIPS_FOLDER)):
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
    agent = Agent(
        config,
        pipeline,
        ports,
        recorder,
        say,
        Notifier(os.environ.get("NOTIFY_SOCKET")),
        st.folder(os.environ, data_dir),
        lambda name: make(drivers.PORTS, config.ports[name].kind)(config.ports[name]),
    )

    def on_signal(number: int, frame: FrameType | None) -> None:
        agent.stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, on_signal)
    return agent.run(found)
