"""The writer thread: appends, flushes, keeps the slow state, and outlives a disk that refuses.

After a write error the open file is sealed, records wait in a bounded ring, and main is asked for a fresh segment,
which begins with a checkpoint. What main needs to know of the disk is published here, so that nobody else waits for it.
"""

from __future__ import annotations

import errno
import os
import shutil
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from edge_agent import messages as m
from edge_agent.memory import give_back
from edge_agent.notify import Notifier
from edge_agent.queues import ByteQueue
from edge_agent.reading import RECORD_OVERHEAD, Account
from edge_agent.recording.segments import Recorder, RecordingError, list_segments

MB = 1_000_000
DERIVED_SHARE = 0.75  # of outbox and ring: derived records can be recomputed from raw ones, so they go first
RETRY_NS = 5 * m.S  # a refusing disk is tried again after so long
GONE_NS = 30 * m.S  # a folder that recordings were in is away so long: the process ends, to be started anew
SPACE_NS = 5 * m.S  # how often the free space is asked for,
FOLDER_NS = 60 * m.S  # and the folder read: thousands of names


@dataclass(frozen=True, slots=True)
class Keep:
    """Order to the writer: put the slow state into the state directory."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Beat:
    """A Tick has come through the inbox and main: once the writer has it too, the supervisor is told."""

    lines: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Books:
    """The writer's page of one port's ledger at a moment when nothing is in its hand, in blocks: taken from the outbox
    = written + lost + ring."""

    taken: int = 0
    written: int = 0
    lost: int = 0
    ring: int = 0


@dataclass(frozen=True, slots=True)
class Disk:
    """What the writer last saw of the disk; bytes, -1 = the file system does not say."""

    free_bytes: int = -1
    size_bytes: int = 0
    file: str = ""  # the open one
    begin_utc_ns: int = 0
    files: int = 0  # finished ones
    files_bytes: int = 0
    oldest_utc_ns: int = 0


def _gone(folder: Path) -> bool:
    """Whether it is not there; a disk that does not answer is sick, not gone."""
    try:
        folder.stat()
    except (FileNotFoundError, NotADirectoryError):
        return True
    except OSError:
        pass
    return False


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
        now: Callable[[], int] = time.monotonic_ns,
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
        self.busy_ns = 0  # an operation on the disk began then; 0 = none is under way
        self.books: Mapping[str, Books] = dict.fromkeys(accounts, Books())
        self.disk = Disk()
        self._now = now
        self._begin_utc_ns = 0  # of the open file
        self._path: Path | None = None  # when the folder was read last
        self._space_ns = self._folder_ns = 0  # when they were looked at last
        self._rotates = 0
        self._ring: deque[m.Record | m.Rotate] = deque()  # empty, or begins with a Rotate
        self.ring_bytes = 0
        self._told = False  # of the disk's refusal
        self._retry_ns = 0
        self._gone_ns = 0  # the folder was first seen missing

    def run(self) -> None:
        try:
            self._look(time.monotonic_ns())
            while not self.outbox.drained:
                flush_s = min(self.settings.flush_s, 1.0)
                wait_s = self.recorder.wait_s(time.monotonic_ns())
                begun = 0
                for item in self.outbox.take(wait_s, self.outbox.limit_bytes // 4):
                    self.busy_ns = self._now()
                    now = time.monotonic_ns()
                    self._one(item, now)
                    begun = begun or now
                    if now - begun > flush_s * m.S:
                        break  # a slow disk: flushing must not wait for all the rest
                self.busy_ns = self._now()
                self._due(time.monotonic_ns(), begun)
                self.busy_ns = 0
            self._end(time.monotonic_ns())
            self._close_books()
            self._look(time.monotonic_ns())
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
        self.busy_ns = self._now()
        try:
            self.recorder.handle(item, now)
        except RecordingError as e:
            self._failed(e, now, item)
            return not self.holding
        if isinstance(item, m.Rotate):
            self._begin_utc_ns = item.utc_ns
            give_back()
        elif account := self._account(item):
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
        if isinstance(item, m.Record) and item.derived and self.ring_bytes + size > DERIVED_SHARE * bound:
            self._lose(item)
            return
        if self._ring and self.ring_bytes + size > bound:
            self._drop_oldest()
            if not self._ring and isinstance(item, m.Record):
                self.want_rotate = True  # a file can only begin at a checkpoint
            self.faults.append(m.Fault(now, "recorder", "RING_FULL", "the disk still refuses; held records are lost"))
        if self._ring or isinstance(item, m.Rotate):
            self._ring.append(item)
            self.ring_bytes += size
        else:
            self._lose(item)

    def _drop_oldest(self) -> None:
        """Lose the ring's first Rotate and what follows it up to the next."""
        while self._ring:
            item = self._ring.popleft()
            self.ring_bytes -= held_size(item)
            self._lose(item)
            if self._ring and isinstance(self._ring[0], m.Rotate):
                return

    def _resume(self, now: int) -> None:
        held, self._ring, self.ring_bytes = list(self._ring), deque(), 0
        good = True
        for item in held:
            if good:
                good = self._write(item, now)
            else:  # refused again: behind a Rotate the rest waits on, else it is lost
                self._hold(item, now)
        if good:
            self.holding = self._told = False
            self.faults.append(m.Fault(now, "recorder", "DISK_OK", "recording goes on"))

    def _due(self, now: int, begun: int = 0) -> None:
        """`begun`: when the first record in hand was taken; 0 = none was."""
        if self.holding:
            if self._ring and now >= self._retry_ns:
                self._resume(now)
            self._see_to_folder(now)
        else:
            try:
                if self.recorder.idle(now, begun):
                    self.recorder.fsync_took(self._now() - (begun or now))
            except RecordingError as e:
                self._failed(e, now)
        self.open_file = self._rotates, self.recorder.open_bytes
        self.faults.extend(self.recorder.drain_faults())
        self._close_books()
        self._look(now)

    def _see_to_folder(self, now: int) -> None:
        """The folder of a service is a mount of its own: once it is deleted, only a new start of the service brings it
        back. OSError where that is so."""
        if self.recorder.segments == 0 or not _gone(self.recorder.data_dir):
            self._gone_ns = 0
        elif not self._gone_ns:
            self._gone_ns = now
        elif now - self._gone_ns >= GONE_NS:
            text = "the folder was taken away and cannot be made again from here"
            raise FileNotFoundError(errno.ENOENT, text, str(self.recorder.data_dir))

    @property
    def ring_items(self) -> int:
        """Records and Rotates that wait for the disk."""
        return len(self._ring)

    def _close_books(self) -> None:
        """Nothing is in hand: the ring is counted one by one, and everything taken must be somewhere."""
        ring = Counter(r.topic[5:] for r in self._ring if isinstance(r, m.Record) and self._account(r))
        _, taken = self.outbox.account()
        self.books = {n: Books(taken[n], a.written, a.lost, ring[n]) for n, a in self.accounts.items()}

    def _look(self, now: int) -> None:
        """See to the disk for the others, who must not wait for it."""
        path = self.recorder.path
        seen = replace(self.disk, file="" if path is None else path.name, begin_utc_ns=self._begin_utc_ns)
        if not self._space_ns or now - self._space_ns >= SPACE_NS:
            self._space_ns = now
            seen = replace(seen, free_bytes=self.recorder.free_bytes(), size_bytes=size_bytes(self.recorder.data_dir))
        if not self._folder_ns or now - self._folder_ns >= FOLDER_NS or path != self._path:
            self._folder_ns, self._path = now, path
            with suppress(OSError):  # whether it can be written shows at the next record
                found = list_segments(self.recorder.data_dir, self.recorder.site)
                oldest = int(found[0].begin.timestamp()) * m.S if found else 0
                total = sum(s.size for s in found)
                seen = replace(seen, files=len(found), files_bytes=total, oldest_utc_ns=oldest)
        self.disk = seen

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


def free_bytes(path: Path) -> int:
    """Free space of the file system that holds `path`, or its nearest parent that exists; -1 where it does not say."""
    return _usage(path)[1]


def size_bytes(path: Path) -> int:
    """Size of that file system; 0 where it does not say."""
    return max(0, _usage(path)[0])


def _usage(path: Path) -> tuple[int, int]:
    try:
        while not path.exists():
            path = path.parent
        usage = shutil.disk_usage(path)
        return usage.total, usage.free
    except OSError:
        return -1, -1
