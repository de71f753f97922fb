"""Plays a simulated record in real time: NMEA onto one pseudo-terminal, an slcan adapter on another, or a vcan.

Rules. A record's monotonic time becomes the host's by one constant, so each byte leaves when the simulated wire would
have delivered it: nothing early, and what is late at once. As on a real wire, bytes that nobody listens to are gone: a
pseudo-terminal without a reader keeps nothing for later, and an adapter whose channel is closed sends no frame. The
schedules are pure (`serial_schedule`, `slcan_schedule`); clocks and descriptors are read in `play` alone. The slcan
side answers as Lawicel's protocol says: CR for done, BEL for a command refused.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import struct
import termios
import threading
import time
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from edge_agent.messages import MS, CanFlag, CanFrames, S
from edge_agent.simulate.bridge import SimRecord
from edge_agent.simulate.encode import can_frames, nmea_bursts

Schedule = list[tuple[int, bytes]]
"""(t_ns on the record's clock, bytes that arrive then), ascending."""

PIECE = 32  # bytes that a USB adapter hands over at once
PENDING_BYTES = 65_536  # what an adapter's own buffer holds for a reader that sleeps; the newest is dropped beyond
COMMAND_BYTES = 64  # no slcan command is longer
VCAN = "vcan0"


def serial_schedule(record: SimRecord, baud: int = 115_200) -> Schedule:
    """The sentences in pieces as a line of that speed delivers them: a burst begins at its fix's arrival, or as soon as
    the line is free."""
    out: Schedule = []
    free_ns = 0
    for t_ns, data in nmea_bursts(record):
        free_ns = max(free_ns, t_ns)
        for i in range(0, len(data), PIECE):
            piece = data[i : i + PIECE]
            free_ns += len(piece) * 10 * S // baud  # 8 bits, start, stop
            out.append((free_ns, piece))
    return out


def slcan_frame(can_id: int, flags: int, data: bytes) -> bytes:
    """One frame as an slcan adapter reports it."""
    head = f"T{can_id:08X}" if flags & CanFlag.EXT else f"t{can_id:03X}"
    return f"{head}{len(data)}{data.hex().upper()}\r".encode()


def slcan_schedule(frames: CanFrames) -> Schedule:
    """Frames as slcan text."""
    return [(t, slcan_frame(i, f, d)) for t, i, f, d in _rows(frames)]


def socketcan_schedule(frames: CanFrames) -> Schedule:
    """Frames as the kernel's struct can_frame, 16 bytes."""
    return [
        (t, struct.pack("=IB3x8s", i | (0x8000_0000 if f & CanFlag.EXT else 0), len(d), d))
        for t, i, f, d in _rows(frames)
    ]


def _rows(frames: CanFrames) -> list[tuple[int, int, int, bytes]]:
    return [
        (t, i, f, d[:n].tobytes())
        for t, i, f, n, d in zip(
            frames.t_ns.tolist(),
            frames.can_id.tolist(),
            frames.flags.tolist(),
            frames.length.tolist(),
            frames.data,
            strict=True,
        )
    ]


class Slcan:
    """The adapter's side of the slcan protocol: bytes of commands in, answers out. Pure."""

    def __init__(self) -> None:
        self.open = False
        self.bitrate = ""
        self._line = bytearray()

    def feed(self, data: bytes) -> bytes:
        """Take what the host wrote, in any cut; return what the adapter answers."""
        out = b""
        for byte in data:
            if byte != 0x0D:
                if len(self._line) < COMMAND_BYTES:
                    self._line.append(byte)
                continue
            out += self._answer(self._line.decode("ascii", "replace").strip("\n"))
            self._line.clear()
        return out

    def _answer(self, line: str) -> bytes:
        good, bad = b"\r", b"\a"
        match line[:1]:
            case "":
                return good
            case "O" | "L":
                was, self.open = self.open, True
                return bad if was else good
            case "C":
                was, self.open = self.open, False
                return good if was else bad
            case "S" if not self.open and line[1:] in tuple("012345678"):
                self.bitrate = line
                return good
            case "s" if not self.open and len(line) == 5:
                self.bitrate = line
                return good
            case "V":
                return b"V1013\r"
            case "N":
                return b"NSIM1\r"
            case "F":
                return b"F00\r"
            case "Z" | "X":
                return good
            case "t" | "r":
                return b"z\r" if self.open else bad
            case "T" | "R":
                return b"Z\r" if self.open else bad
        return bad


class Sink(Protocol):
    """Where a schedule goes. `ready` = the agent listens."""

    @property
    def ready(self) -> bool: ...
    def fileno(self) -> int: ...
    def send(self, data: bytes) -> None: ...
    def serve(self) -> None: ...
    def close(self) -> None: ...


class Terminal:
    """Master side of a pseudo-terminal that plays a serial device; `path` is what the agent opens.

    With `adapter` it is an slcan adapter, whose commands it answers.
    """

    def __init__(self, adapter: Slcan | None = None) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave, termios.TCSANOW)  # before anyone opens it, or its echo would come back as commands
        self.path = os.ttyname(slave)
        os.close(slave)
        os.set_blocking(self._master, False)
        self.adapter = adapter
        self.lost = 0  # bytes that a listener was too slow for
        self.unheard = 0  # bytes sent while nobody listened
        self._pending = bytearray()
        self._poll = select.poll()
        self._poll.register(self._master, select.POLLIN)

    def fileno(self) -> int:
        return self._master

    @property
    def listened(self) -> bool:
        """Whether someone has the other side open: Linux reports a hang-up while nobody has."""
        return not any(event & select.POLLHUP for _, event in self._poll.poll(0))

    @property
    def ready(self) -> bool:
        return self.listened and (self.adapter is None or self.adapter.open)

    def send(self, data: bytes) -> None:
        if not self.ready:
            self.unheard += len(data)
            return
        self._write(data)

    def serve(self) -> None:
        """Read and answer what the host wrote, and go on with what did not fit before."""
        with contextlib.suppress(BlockingIOError):
            try:
                data = os.read(self._master, 4096)
            except OSError as e:
                if e.errno != errno.EIO:  # nobody has the other side open
                    raise
                self._pending.clear()
                if self.adapter is not None:
                    self.adapter.open = False
                return
            if self.adapter is not None:
                self._write(self.adapter.feed(data))
        self._flush()

    def _write(self, data: bytes) -> None:
        if len(self._pending) + len(data) > PENDING_BYTES:
            self.lost += len(data)
            return
        self._pending += data
        self._flush()

    def _flush(self) -> None:
        if self._pending:
            with contextlib.suppress(BlockingIOError):
                n = os.write(self._master, self._pending)
                del self._pending[:n]

    def close(self) -> None:
        if self._master >= 0:
            os.close(self._master)
            self._master = -1


class Vcan:
    """A virtual CAN interface of the kernel that already exists and is up. Raises OSError where it cannot be used."""

    ready = True

    def __init__(self, channel: str = VCAN) -> None:
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            self._socket.bind((channel,))
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, data: bytes) -> None:
        with contextlib.suppress(BlockingIOError):
            self._socket.send(data)

    def serve(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._socket.recv(16)  # others on the bus are not our business

    def close(self) -> None:
        self._socket.close()


def open_can() -> tuple[Sink, str, str]:
    """(sink, python-can interface, channel): vcan0 where the kernel has it up, else an slcan adapter of our own."""
    if hasattr(socket, "AF_CAN") and Path("/sys/class/net", VCAN).exists():
        with contextlib.suppress(OSError):
            return Vcan(), "socketcan", VCAN
    terminal = Terminal(Slcan())
    return terminal, "slcan", terminal.path


def can_schedule(record: SimRecord, sink: Sink) -> Schedule:
    """The record's frames in the sink's own form."""
    frames = can_frames(record)
    return socketcan_schedule(frames) if isinstance(sink, Vcan) else slcan_schedule(frames)


def wait_ready(sinks: Sequence[Sink], timeout_s: float, alive: Callable[[], bool]) -> bool:
    """Serve the sinks until the agent listens on all of them; False after `timeout_s` or when `alive` says no."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end and alive():
        for sink in sinks:
            sink.serve()
        if all(sink.ready for sink in sinks):
            return True
        time.sleep(0.02)
    return False


def play(
    parts: Sequence[tuple[Sink, Schedule]],
    shift_ns: int,
    *,
    stop: threading.Event | None = None,
    progress: Callable[[int], None] | None = None,
) -> int:
    """Play the schedules; host monotonic time = record time + `shift_ns`. Returns the largest lateness in ns.

    `progress` gets the record's time about once a second; `stop` ends the play early.
    """
    due = sorted(((t, i, data) for i, (_, schedule) in enumerate(parts) for t, data in schedule), key=lambda x: x[0])
    sinks = [sink for sink, _ in parts]
    reading = select.poll()
    for sink in sinks:
        reading.register(sink.fileno(), select.POLLIN)
    late, told = 0, -(10**18)
    for t, i, data in due:
        while (wait_ns := t + shift_ns - time.monotonic_ns()) > 0:
            if stop is not None and stop.is_set():
                return late
            events = reading.poll(min(wait_ns / MS, 20))
            # A hang-up is reported at once and always: then only time can be waited for.
            if any(e & select.POLLHUP for _, e in events):
                time.sleep(min(wait_ns, 5 * MS) / S)
            for sink in sinks:
                sink.serve()
        late = max(late, -wait_ns)
        sinks[i].send(data)
        if progress is not None and t - told >= S:
            told = t
            progress(t)
    return late
