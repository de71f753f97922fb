"""One thread per port: reads blocks, stamps nothing, offers them to the inbox; and what watches over it.

A reader never blocks on a full inbox: the newest block is dropped and counted. A device that is lost is opened again
with capped back-off; one that is silent is opened again now and then, since a half-open connection or a line that
another program has changed looks like silence; a reader that does not come back from a call is left alone and another
one takes over. Any other exception is kept in `failure`, for main to raise.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import drivers
from edge_agent import messages as m
from edge_agent.queues import ByteQueue

BACKOFF_S = (1.0, 60.0)  # first and longest wait before a port is opened again
REOPEN_S = (10.0, 300.0)  # the same for a silent one: rarely, for what comes while it is closed is lost
HUNG_S = 30.0  # no open or read of a driver takes so long
HUNG_MOST = 3  # readers of one port that may hang at a time: each holds a thread
RECORD_OVERHEAD = 120  # bytes that a record costs in a queue beside its data

Payload = bytes | m.CanFrames | m.Tick


class Port(Protocol):
    counters: dict[str, int]

    def open(self) -> None: ...
    def read(self) -> list[tuple[int, Payload]]: ...
    def close(self, silently: bool = False) -> None: ...


@dataclass(frozen=True, slots=True)
class Arrival:
    """What a reader puts into the inbox: a block that was read, or a fault of its port."""

    t_ns: int
    source: str
    payload: Payload | m.Fault


class Account:
    """Ledger of one port, in blocks: received = written + queued + dropped + refused + lost, where queued is what sits
    in inbox, outbox and ring. One thread writes each counter; `lock` makes received, dropped and the inbox agree."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.received = 0  # reader
        self.dropped = 0  # reader: inbox full
        self.refused = 0  # main: outbox full
        self.written = 0  # writer
        self.lost = 0  # writer: the disk refused
        self.bytes = 0  # reader
        self.reopened = 0  # reader: while silent


class Reader(threading.Thread):
    """Reads one port for ever; opens it again when the device is lost, or when `reopen` is set."""

    def __init__(
        self,
        name: str,
        port: Port,
        inbox: ByteQueue[Arrival],
        account: Account,
        stop: threading.Event,
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        super().__init__(name=f"read-{name}", daemon=True)
        self.source, self.port, self.inbox, self.account, self.stopping = name, port, inbox, account, stop
        self.failure: BaseException | None = None
        self.reopen = threading.Event()
        self.abandoned = False  # another reader has taken over: from then on nothing more is said to the device
        self.state = "START"  # OPEN, LOST
        self.busy_ns = 0  # a call into the driver began then; 0 = none is under way
        self._now = now
        self._turn = threading.Lock()  # between the begin of a call into the driver and `abandon`

    def abandon(self) -> bool:
        """Give the port to another reader, if this one still hangs; whether it does."""
        with self._turn:
            if self.busy_ns and self._now() - self.busy_ns > HUNG_S * m.S:
                self.abandoned = True
                if let_go := getattr(self.port, "let_go", None):  # of drivers that hold a device against others
                    let_go()
            return self.abandoned

    def run(self) -> None:
        try:
            self._run()
        except BaseException as e:  # noqa: BLE001 - main raises it and ends the process
            self._fault("CRASH", f"{type(e).__name__}: {e}")
            self.failure = e

    def _run(self) -> None:
        wait = BACKOFF_S[0]
        while not self.stopping.is_set():
            try:
                self.reopen.clear()
                if not self._begin():
                    break
                self.port.open()
                if self.abandoned:
                    break
                if self.state == "LOST":
                    self._fault("PORT_OPEN", "open again")
                self.state = "OPEN"
                while not (self.stopping.is_set() or self.reopen.is_set()) and self._begin():
                    for t_ns, payload in self.port.read():
                        self._offer(t_ns, payload)
                        wait = BACKOFF_S[0]
                if self.stopping.is_set() or not self._begin():
                    break
                self.account.reopened += 1
                self.port.close()
            except drivers.PortError as e:
                self._close()
                if self.abandoned:
                    return  # the port is another reader's, and so is its state
                self.state = "LOST"
                self._fault("PORT_LOST", f"{e}; next try in {wait:.0f} s", (("retry_s", wait),))
                self.stopping.wait(wait)
                wait = min(2 * wait, BACKOFF_S[1])
        self._close()

    def _begin(self) -> bool:
        """A call into the driver begins, unless the port is another reader's by now."""
        with self._turn:
            self.busy_ns = self._now()
            return not self.abandoned

    def _close(self) -> None:
        mine = self._begin()
        self.port.close(silently=not mine)  # what another reader holds is let go without a word
        self.busy_ns = 0

    def _offer(self, t_ns: int, payload: Payload) -> None:
        size = payload_size(payload)
        with self.account.lock:
            self.account.received += 1
            self.account.bytes += size
            if not self.inbox.put(Arrival(t_ns, self.source, payload), size + RECORD_OVERHEAD, 1.0, self.source):
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


class PortWatch:
    """Says when a port falls silent, sends garbage, or never says a position; once per change of state."""

    SILENT_S = 5.0
    POSITION_S = 10.0

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self.state = "START"
        self._seen: dict[str, int] = {}
        self._since: dict[str, int] = {}
        self.reopens = 0  # in this silence
        self._reopen_ns = 0  # when a silent port is due
        self._reopen_s = 0.0  # the wait after that; 0 = not silent

    def look(self, t_ns: int, counts: Mapping[str, int]) -> tuple[str, str] | None:
        """counts: bytes (or frames), good (sentences or samples), positions, bus_off, all cumulative. Return (state,
        text)."""
        bus_off = counts.get("bus_off", 0) > self._seen.get("bus_off", 0)  # a fresh port counts from 0
        for key, value in counts.items():
            if self._seen.get(key) != value or key not in self._since:
                self._since[key] = t_ns
            self._seen[key] = value
        age = {k: (t_ns - t) / m.S for k, t in self._since.items()}
        unit, good = ("bytes", "sentence") if self.kind == "serial" else ("frames", "sample")
        if bus_off:
            state, text = "BUS_OFF", "the controller has left the bus: check for a short circuit, termination, bit rate"
        elif age["bytes"] > self.SILENT_S:
            state, text = "SILENT", f"nothing has come for {age['bytes']:.0f} s: check power, cable and device"
            self._since["good"] = self._since["positions"] = t_ns  # what comes next gets its time to be understood
        elif age["good"] > self.SILENT_S:
            hint = "baud rate and protocol" if self.kind == "serial" else "bit rate, ids and DBC file"
            state = "GARBAGE" if self.kind == "serial" else "NO_MATCH"
            text = f"{unit} come, but no good {good} for {age['good']:.0f} s: check {hint}"
        elif self.kind == "serial" and age["positions"] > self.POSITION_S:
            state = "NO_POSITION"
            text = f"good sentences come, but no position for {age['positions']:.0f} s: switch on GGA (and GST)"
        elif not self._seen["good"] or (self.state in ("SILENT", "BUS_OFF") and age["good"] > 0):
            return None  # not yet known
        else:
            state, text = "OK", f"good {good}s come"
        if state == self.state:
            return None
        first, self.state = self.state == "START", state
        return None if first and state == "OK" else (state, text)

    def reopen_due(self, t_ns: int) -> float:
        """For a silent port: seconds to the try after this one when it is time for one, else 0."""
        if self.state != "SILENT":
            self._reopen_s = 0.0
            return 0.0
        if self._reopen_s == 0.0:
            self.reopens = 0
            self._reopen_s = REOPEN_S[0]
            self._reopen_ns = t_ns + int(self._reopen_s * m.S)
            return 0.0
        if t_ns < self._reopen_ns:
            return 0.0
        self.reopens += 1
        self._reopen_s = min(2 * self._reopen_s, REOPEN_S[1])
        self._reopen_ns = t_ns + int(self._reopen_s * m.S)
        return self._reopen_s
