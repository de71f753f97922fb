"""What the parts of the virtual machine tier share: the machine with its service, the players, the recordings.

A wait ends with what it waits for; its patience (`PATIENCE_S`) only ends a run that is broken, whatever the host has to
do beside it.
"""

from __future__ import annotations

import re
import select
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from machine import Machine

from edge_agent.messages import CanFlag, CanFrames, S
from edge_agent.recording import reader, topics
from edge_agent.simulate.bridge import SimRecord
from edge_agent.simulate.play import Slcan, play

SERVICE = "edge-agent"
DATA = "/var/lib/edge-agent"
PATIENCE_S = 900.0  # with a start or a fault that take some 10 s on a quiet machine


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def waited(good: Callable[[], bool], patience_s: float = PATIENCE_S, every_s: float = 0.5) -> bool:
    """Wait until something holds; whether it did."""
    end_s = time.monotonic() + patience_s
    while not good():
        if time.monotonic() > end_s:
            return False
        time.sleep(every_s)
    return True


class Tally:
    """One row for each thing that must hold."""

    passed = failed = 0

    def row(self, good: bool, what: str, seen: str) -> None:
        self.passed += good
        self.failed += not good
        print(f"{'pass' if good else 'FAIL'}  {what:<58} {seen}", flush=True)

    def told(self, good: bool | None, what: str, seen: str) -> None:
        """A figure that is not judged; `good` only says how it would be."""
        print(f"{'' if good is None else 'good' if good else 'no':<4}  {what:<58} {seen}", flush=True)


def only(frames: CanFrames, ids: range) -> CanFrames:
    """The frames of some identifiers."""
    use = (frames.can_id >= ids.start) & (frames.can_id < ids.stop)
    return chosen(frames, use)


def chosen(f: CanFrames, use: Any) -> CanFrames:
    """The frames of a mask."""
    return CanFrames(f.t_ns[use], f.can_id[use], f.flags[use], f.length[use], f.data[use])


class Wire:
    """The host's end of a serial port; with `adapter` it is an slcan adapter."""

    ready = True

    def __init__(self, end: socket.socket, adapter: Slcan | None = None) -> None:
        self._end, self._adapter = end, adapter
        self.sent = bytearray()
        self.on = True  # off: what is played goes nowhere, as on a line without a listener

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, data: bytes) -> None:
        if self.on and (self._adapter is None or self._adapter.open):
            self._end.sendall(data)
            self.sent += data

    def say(self, data: bytes) -> None:
        """Send something that is not part of the play."""
        self._end.sendall(data)

    def serve(self) -> None:
        """Take what the guest wrote; the adapter answers."""
        while select.select([self._end], [], [], 0)[0]:
            data = self._end.recv(4096)
            if self._adapter is not None:
                self._end.sendall(self._adapter.feed(data))
            if not data:
                return

    def close(self) -> None:
        self._end.close()


class Serving(threading.Thread):
    """Lets the adapter answer while nothing is played, as a real one does."""

    def __init__(self, wires: tuple[Wire, ...]) -> None:
        super().__init__(daemon=True)
        self.wires, self.ended = wires, threading.Event()

    def run(self) -> None:
        while not self.ended.wait(0.02):
            for wire in self.wires:
                wire.serve()

    def __enter__(self) -> Serving:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.join()


class Player(threading.Thread):
    """Plays onto the serial ports, beside the player in the guest."""

    def __init__(self, parts: list[tuple[Wire, list[tuple[int, bytes]]]], shift_ns: int) -> None:
        super().__init__(daemon=True)
        self.parts, self.shift_ns, self.late_ns = parts, shift_ns, 0
        self.ended = threading.Event()
        self.failure: OSError | None = None

    def run(self) -> None:
        try:
            self.late_ns = play(self.parts, self.shift_ns, stop=self.ended)
        except OSError as e:
            self.failure = e


@dataclass
class Session:
    """The machine, what was sent and what is known of it."""

    vm: Machine
    tally: Tally
    share: Path  # of the host, read-only in the guest
    out: Path  # written by the guest
    offset_ns: int = 0  # guest's wall clock minus the host's
    record: SimRecord | None = None
    sent: bytes = b""  # to the receiver's port
    by_stop: tuple[int, int] = (0, 0)  # bytes to it and frames of the adapter that were sent until the service's stop
    step_s: float = 0.0  # of the play: when the clock stepped
    late_ns: int = 0  # of the latest thing that was played
    files: list[Path] = field(default_factory=list)

    def show(self, *names: str) -> dict[str, str]:
        """Properties of the service."""
        lines = self.vm.sh(f"systemctl show {SERVICE} -p {','.join(names)}").splitlines()
        return dict(line.split("=", 1) for line in lines)

    def ready(self) -> float:
        """Wait until the service has said READY; seconds, inf where it did not."""
        began = time.monotonic()
        good = waited(lambda: self.show("ActiveState")["ActiveState"] == "active")
        return time.monotonic() - began if good else float("inf")

    def starts(self) -> float:
        """Start the service; seconds to READY, inf where it did not come."""
        self.vm.sh(f"systemctl start --no-block {SERVICE}")
        return self.ready()

    def be_patient(self) -> None:
        """Until the next boot: a starved processor may need longer than the unit's 30 s to write what is in hand, and
        longer than its 600 s to start."""
        folder = f"/run/systemd/system/{SERVICE}.service.d"
        lines = "[Service]\\nTimeoutStopSec=400\\nTimeoutStartSec=1800\\n"
        self.vm.sh(f"mkdir -p {folder} && printf '{lines}' >{folder}/patience.conf && systemctl daemon-reload")

    def stops(self) -> None:
        self.vm.sh(f"systemctl stop {SERVICE}")

    def journal(self) -> str:
        """What the service has said since the last call."""
        return self.vm.run(
            f"journalctl --cursor-file=/run/cursor -u {SERVICE} --no-pager -o cat"
        ).out  # code 1: nothing

    def told(self, pattern: str) -> bool:
        """Wait until the service says something (regular expression), from the last call of `journal` on."""
        said: list[str] = []

        def seen() -> bool:
            said.append(self.journal())
            return re.search(pattern, "".join(said)) is not None

        return waited(seen)

    def fails(self, command: str) -> bool:
        return self.vm.run(command).rc != 0


def clock_offset_ns(vm: Machine, exchanges: int = 8) -> int:
    """The guest's wall clock minus the host's, from the quickest of some exchanges."""
    best = (float("inf"), 0)
    for _ in range(exchanges):
        before = time.time_ns()
        guest = int(vm.sh("date +%s%N"))
        after = time.time_ns()
        best = min(best, (after - before, guest - (before + after) // 2))
    return int(best[1])


def stored(files: list[Path], *wanted: str) -> Iterator[reader.Stored]:
    for path in files:
        yield from reader.read_messages(path, set(wanted))


def blocks(files: list[Path], topic: str) -> CanFrames:
    """All frames of a CAN port, without error frames."""
    found = [topics.decode_raw(m.topic, m.schema, m.data).payload for m in stored(files, topic)]
    use = [b for b in found if isinstance(b, CanFrames)]
    if not use:
        none = np.zeros(0, np.uint8)
        return CanFrames(np.zeros(0, np.int64), np.zeros(0, np.uint32), none, none, np.zeros((0, 8), np.uint8))
    joined = CanFrames(
        np.concatenate([b.t_ns for b in use]),
        np.concatenate([b.can_id for b in use]),
        np.concatenate([b.flags for b in use]),
        np.concatenate([b.length for b in use]),
        np.concatenate([b.data for b in use]),
    )
    return chosen(joined, joined.flags & CanFlag.ERR == 0)


def keys(frames: CanFrames) -> list[tuple[int, bytes]]:
    rows = zip(frames.can_id.tolist(), frames.data, frames.length.tolist(), strict=True)
    return [(i, d[:n].tobytes()) for i, d, n in rows]


def candump(path: Path) -> list[tuple[int, int, bytes]]:
    """(wall ns, identifier, data) of a candump log."""
    out = []
    for line in path.read_text().splitlines():
        m = re.fullmatch(r"\((\d+)\.(\d{6})\) can0 ([0-9A-F]{3})#([0-9A-F]*)", line.strip())
        if m:
            out.append((int(m[1]) * S + int(m[2]) * 1000, int(m[3], 16), bytes.fromhex(m[4])))
    return out
