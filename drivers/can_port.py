"""The CAN port: drains a bus and hands on one packed block of frames per `block_ms`. Waking up costs, not reading.

The bus is opened through python-can. Three sources of frames:
- SocketCAN: `FrameSocket` reads the socket itself, without blocking, every `drain_ms`, with the kernel's arrival stamp
  of each frame and its count of dropped ones. The stamps are wall time; `monotonic_stamps` makes them monotonic time
  and recognises a clock step under them.
- slcan: `FrameSerial` reads the adapter's serial device itself, in blocks (python-can reads byte by byte), and stamps
  what one read gave with its time, with the flag DRAIN.
- every other interface of python-can (virtual, udp_multicast, pcan, ...): `bus.recv`, drained likewise and stamped as
  each call returns, with the flag DRAIN.

Frames are recorded as they came, error frames too: judging them is the codec's work. What is lost here is counted: by
the kernel (`dropped`, also in each block), by the controller (`error_controller`, `overruns`). A lost link or device is
a PortError, after the frames that were already here have been handed out.

SO_TIMESTAMPNS works on any socket, so a loopback UDP socket that carries struct can_frame can stand in for the bus.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import sys
import time
from typing import Any, Protocol

import can
import numpy as np
import numpy.typing as npt

from drivers import PortError
from drivers.clock_port import clock_pair
from drivers.slcan_lines import SlcanLines
from edge_agent.messages import I64, MS, CanFlag, CanFrames, PortSettings, S

RECEIVE_BUFFER = 4 << 20
"""SO_RCVBUF in bytes. The kernel charges 0.75 kB for a small frame: 1.4 s of a full 1 Mbit/s bus, where the default
holds 277 frames. Without CAP_NET_ADMIN the kernel cuts it to net.core.rmem_max."""
DRAIN_NS = 50_000_000  # longest drain of a python-can bus
SERIAL_BYTES = 1 << 16
SERIAL_READS = 16  # in one drain: at most 64 kB, for the kernel hands out 4 kB at a time; 0.3 s of a full 1 Mbit/s bus
DRAIN_LIMIT = 8192
"""Frames taken in one drain, so that a flood cannot hold the thread; the rest waits 20 ms in the kernel's buffer."""
MARGIN_NS = 50 * MS
"""A stamp may be older than the last drain by so much (a frame waited on a busy core); beyond, the clock stepped."""
MAX_WAIT_NS = S // 2
"""A read returns at least so often, so that a thread can be stopped."""

# linux/can.h, asm-generic/socket.h; Python's socket module does not have all of them
CAN_MTU, CANFD_MTU = 16, 72
SO_TIMESTAMPNS, SO_RXQ_OVFL, SO_RCVBUFFORCE = 35, 40, 33
ID_MASK = 0x1FFFFFFF
CANFD_BRS_ESI = 3

# linux/can/error.h: bits of the identifier of an error frame
ERROR_CLASSES = {
    0x001: "error_tx_timeout",
    0x002: "error_arbitration",
    0x004: "error_controller",
    0x008: "error_protocol",
    0x010: "error_transceiver",
    0x020: "error_no_ack",
    0x040: "error_bus_off",
    0x080: "error_bus",
    0x100: "error_restarted",
}
ERROR_CONTROLLER, CONTROLLER_RX_OVERFLOW = 0x004, 0x01

TIMESPEC = struct.Struct("@ll")
ANCILLARY = socket.CMSG_SPACE(TIMESPEC.size) + socket.CMSG_SPACE(4)
NO_STAMP = bytes(TIMESPEC.size)


def _frame_type(width: int) -> np.dtype[np.void]:
    return np.dtype([("id", "=u4"), ("length", "u1"), ("flags", "u1"), ("pad", "u2"), ("data", "u1", (width,))])


CLASSIC, FD = _frame_type(8), _frame_type(64)
# the three top bits of can_id (EFF, RTR, ERR) as CanFlag
TOP_FLAGS = np.array(
    [(b >> 2 & 1) * CanFlag.EXT | (b >> 1 & 1) * CanFlag.RTR | (b & 1) * CanFlag.ERR for b in range(8)], np.uint8
)


# --------------------------------------------------------------------------------------------------------- pure parts


def monotonic_stamps(
    stamps: I64, counts: I64, since_ns: I64, mono_ns: I64, wall_ns: I64, last_ns: int
) -> tuple[I64, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Monotonic time of frames from the kernel's wall stamps.

    stamps (n,) wall ns, 0 = none; counts (k,) frames of each of k drains; since_ns, mono_ns, wall_ns (k,): monotonic
    end of the drain before, and the pair of clocks at the drain's end; last_ns: time of the port's frame before.

    t = mono_now - (wall_now - stamp). An age outside of [0, time since the last drain + MARGIN_NS] means that the wall
    clock stepped in between: such a frame gets its even share of the drain's interval, but no later than the frames
    after it. Returns (t (n,) never decreasing, spread (n,), unstamped (n,): put at the drain).
    """
    drain = np.repeat(np.arange(counts.size), counts)
    now, since = mono_ns[drain], since_ns[drain]
    unstamped = stamps == 0
    age = np.where(unstamped, 0, wall_ns[drain] - stamps)
    t = now - age
    spread = (age < 0) | (age > now - since + MARGIN_NS)
    if spread.any():
        place = np.arange(stamps.size) - (np.cumsum(counts) - counts)[drain] + 1
        even = since + (now - since) * place // counts[drain]
        following = np.minimum.accumulate(np.where(spread, now.max(), t)[::-1])[::-1]
        t = np.where(spread, np.minimum(even, following), t)
    return np.maximum.accumulate(np.maximum(t, last_ns)), spread, unstamped


def unpack_frames(frames: list[bytes]) -> tuple[npt.NDArray[np.uint32], npt.NDArray[np.uint8], Any, Any]:
    """(can_id, flags, length, data) of struct can_frame (16 bytes) and struct canfd_frame (72 bytes), which may mix;
    data (n, 8), or (n, 64) if any is an FD frame; zero beyond each frame's length."""
    buffer = b"".join(frames)
    if len(buffer) == CAN_MTU * len(frames):
        rows = np.frombuffer(buffer, CLASSIC)
        width, fd = 8, None
    else:
        fd = np.fromiter(map(len, frames), np.int64, len(frames)) == CANFD_MTU
        rows = np.frombuffer(b"".join(f.ljust(CANFD_MTU, b"\0") for f in frames), FD)
        width = 64
    flags = TOP_FLAGS[rows["id"] >> 29]
    top: npt.NDArray[np.uint8] = np.array(width, np.uint8)
    if fd is not None:
        mode = int(CanFlag.FD) | (rows["flags"] & CANFD_BRS_ESI) << 4  # BRS and ESI, as CanFlag has them
        flags = np.where(fd, flags | mode, flags).astype(np.uint8)
        top = np.where(fd, 64, 8).astype(np.uint8)
    length = np.minimum(rows["length"], top)
    used = np.where(flags & CanFlag.RTR, 0, length)  # a remote frame asks for `length` bytes and carries none
    data = np.where(np.arange(width) < used[:, None], rows["data"], 0).astype(np.uint8, copy=False)
    return rows["id"] & np.uint32(ID_MASK), flags, length, data


# ------------------------------------------------------------------------------------------------------------- sources


class SocketLike(Protocol):
    """What `FrameSocket` needs of a socket."""

    def setsockopt(self, level: int, option: int, value: int, /) -> None: ...
    def getsockopt(self, level: int, option: int, /) -> int: ...
    def setblocking(self, flag: bool, /) -> None: ...
    def recvmsg(self, size: int, ancillary: int, /) -> tuple[bytes, list[tuple[int, int, bytes]], int, Any]: ...


class FrameSocket:
    """Frames of a socket that carries struct can_frame and struct canfd_frame, gathered over drains into a block.

    `failure` holds the OSError that ended the stream: the kernel reports a lost link once, ahead of the frames that are
    still queued, so a drain goes on behind it.
    """

    def __init__(self, sock: SocketLike, counters: dict[str, int], now_ns: int, last_ns: int = 0) -> None:
        self.failure: OSError | None = None
        self.counters = counters
        self._sock = sock
        self._drops = 0  # the kernel's cumulative count, 32 bits
        self._dropped = 0  # of the block under way
        self._since_ns = now_ns
        self._last_ns = last_ns  # of the frame before, so that time never runs backwards, across a reopening too
        self._frames: list[bytes] = []
        self._stamps: list[bytes] = []
        self._drains: list[tuple[int, int, int, int]] = []  # frames, end of the drain before, monotonic, wall
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        try:
            sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except OSError:  # not privileged: as much as the system allows everybody
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        counters["receive_buffer"] = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    def drain(self) -> None:
        """Take what is waiting. Never blocks; an error of the socket is kept in `failure`."""
        frames, stamps = self._frames, self._stamps
        before = len(frames)
        limit = before + DRAIN_LIMIT
        recvmsg = self._sock.recvmsg
        while len(frames) < limit:
            try:
                frame, ancillary, _, _ = recvmsg(CANFD_MTU, ANCILLARY)
            except BlockingIOError:
                break
            except OSError as e:
                if self.failure is not None:
                    break
                self.failure = e
                continue
            stamp = NO_STAMP
            for _, kind, value in ancillary:
                if kind == SO_TIMESTAMPNS:
                    stamp = value
                elif kind == SO_RXQ_OVFL:
                    self._count_drops(int.from_bytes(value, sys.byteorder))
            if len(frame) == CAN_MTU or len(frame) == CANFD_MTU:
                frames.append(frame)
                stamps.append(stamp)
            else:
                self.counters["malformed"] += 1
        taken = len(frames) - before
        if taken:
            mono_ns, wall_ns = clock_pair()
            self._drains.append((taken, self._since_ns, mono_ns, wall_ns))
        if taken < DRAIN_LIMIT:  # else what is left may be older than this drain
            self._since_ns = time.monotonic_ns()

    def _count_drops(self, cumulative: int) -> None:
        new = (cumulative - self._drops) & 0xFFFFFFFF
        self._drops = cumulative
        self._dropped += new
        self.counters["dropped"] += new

    def block(self) -> CanFrames | None:
        """The frames since the block before as one packed block, None if there were none."""
        if not self._frames:
            return None
        can_id, flags, length, data = unpack_frames(self._frames)
        stamp = np.frombuffer(b"".join(self._stamps), np.dtype([("s", "l"), ("ns", "l")]))
        counts, since, mono, wall = np.array(self._drains, np.int64).T
        t_ns, spread, unstamped = monotonic_stamps(
            stamp["s"].astype(np.int64) * S + stamp["ns"], counts, since, mono, wall, self._last_ns
        )
        if spread.any():
            flags = flags | np.where(spread, CanFlag.SPREAD, 0).astype(np.uint8)
            self.counters["spread"] += int(np.count_nonzero(spread))
        if unstamped.any():
            flags = flags | np.where(unstamped, CanFlag.DRAIN, 0).astype(np.uint8)
        self._last_ns = int(t_ns[-1])
        result = CanFrames(t_ns, can_id, flags, length, data, self._dropped)
        self._count_errors(result)
        self._frames, self._stamps, self._drains, self._dropped = [], [], [], 0
        return result

    def _count_errors(self, block: CanFrames) -> None:
        errors = np.flatnonzero(block.flags & CanFlag.ERR)
        if not errors.size:
            return
        self.counters["error_frames"] += errors.size
        classes = block.can_id[errors]
        for bit, name in ERROR_CLASSES.items():
            self.counters[name] += int(np.count_nonzero(classes & bit))
        overflow = (classes & ERROR_CONTROLLER != 0) & (block.data[errors, 1] & CONTROLLER_RX_OVERFLOW != 0)
        self.counters["overruns"] += int(np.count_nonzero(overflow))


class BusLike(Protocol):
    """What `FrameBus` needs of a python-can bus."""

    def recv(self, timeout: float, /) -> Any: ...


class FrameBus:
    """Frames of any python-can bus, gathered over drains into a block; stamped as `recv` returns them."""

    def __init__(self, bus: BusLike, counters: dict[str, int]) -> None:
        self.failure: OSError | can.CanError | None = None
        self.counters = counters
        self._bus = bus
        self._messages: list[tuple[int, Any]] = []

    def drain(self) -> None:
        """Take what is waiting; an error of the device is kept in `failure`."""
        end_ns = time.monotonic_ns() + DRAIN_NS
        for _ in range(DRAIN_LIMIT):
            if time.monotonic_ns() > end_ns:
                return  # a slow processor and a steady bus: the rest comes with the next drain, the block goes out
            try:
                message = self._bus.recv(0)
            except (can.CanError, OSError) as e:
                self.failure = e
                return
            except (ValueError, IndexError):  # a damaged line of an slcan adapter; python-can has taken it away
                self.counters["malformed"] += 1
                continue
            if message is None:
                return
            self._messages.append((time.monotonic_ns(), message))

    def block(self) -> CanFrames | None:
        """The frames since the block before as one packed block, None if there were none."""
        messages, self._messages = self._messages, []
        if not messages:
            return None
        n = len(messages)
        width = 64 if any(m.is_fd for _, m in messages) else 8
        payload = [b"" if m.is_remote_frame else bytes(m.data[:width]) for _, m in messages]
        data = np.frombuffer(b"".join(p.ljust(width, b"\0") for p in payload), np.uint8).reshape(n, width).copy()
        # a damaged frame may hold less than it promises: what is here counts, the codec refuses it as too short
        lengths = [m.dlc if m.is_remote_frame else len(p) for (_, m), p in zip(messages, payload, strict=True)]
        flags = [
            CanFlag.DRAIN
            | (CanFlag.EXT if m.is_extended_id else 0)
            | (CanFlag.RTR if m.is_remote_frame else 0)
            | (CanFlag.ERR if m.is_error_frame else 0)
            | (CanFlag.FD if m.is_fd else 0)
            | (CanFlag.BRS if m.bitrate_switch else 0)
            | (CanFlag.ESI if m.error_state_indicator else 0)
            for _, m in messages
        ]
        self.counters["error_frames"] += sum(bool(m.is_error_frame) for _, m in messages)
        return CanFrames(
            np.array([t for t, _ in messages], np.int64),
            np.array([m.arbitration_id & ID_MASK for _, m in messages], np.uint32),
            np.array(flags, np.uint8),
            np.array(lengths, np.uint8),
            data,
        )


class SerialLike(Protocol):
    """What `FrameSerial` needs of a pyserial port."""

    timeout: float | None

    def read(self, size: int, /) -> bytes: ...


class FrameSerial:
    """Frames of an slcan adapter, gathered over drains into a block; stamped when their bytes were read."""

    def __init__(self, port: SerialLike, counters: dict[str, int]) -> None:
        self.failure: OSError | None = None
        self.counters = counters
        self._port = port
        port.timeout = 0.0  # a read takes what is there; one of a lost device raises
        self._lines = SlcanLines()
        self._reads: list[tuple[int, bytes]] = []

    def drain(self) -> None:
        """Take what is waiting. Never blocks; an error of the device is kept in `failure`."""
        for _ in range(SERIAL_READS):
            try:
                data = self._port.read(SERIAL_BYTES)
            except OSError as e:  # SerialException is one
                self.failure = e
                break
            if not data:
                break
            self._reads.append((time.monotonic_ns(), data))

    def block(self) -> CanFrames | None:
        """The frames since the block before as one packed block, None if there were none."""
        reads, self._reads = self._reads, []
        before = self._lines.malformed
        columns = self._lines.feed(b"".join([data for _, data in reads]))
        self.counters["malformed"] += self._lines.malformed - before
        if columns is None:
            return None
        can_id, flags, length, data, places = columns
        ends = np.cumsum([len(d) for _, d in reads])
        t_ns = np.array([t for t, _ in reads], np.int64)[np.searchsorted(ends, places, side="right")]
        return CanFrames(t_ns, can_id, flags | np.uint8(CanFlag.DRAIN), length, data)


# ---------------------------------------------------------------------------------------------------------------- port


class CanPort:
    """One CAN bus, opened through python-can. `read` gives one block of frames per `block_ms` in which there were any.

    Counters: blocks, frames, dropped (by the kernel), malformed, spread (frames under a clock step), error_frames and
    error_<class>, overruns (the controller lost frames), receive_buffer (bytes).
    """

    def __init__(self, settings: PortSettings) -> None:
        self.settings = settings
        names = ["blocks", "frames", "dropped", "malformed", "spread", "error_frames", "overruns", "receive_buffer"]
        self.counters: dict[str, int] = dict.fromkeys([*names, *ERROR_CLASSES.values()], 0)
        self._bus: Any = None
        self._source: FrameSocket | FrameSerial | FrameBus | None = None
        self._next_drain_ns = 0
        self._block_end_ns = 0
        self._last_ns = 0

    def open(self) -> None:
        """Open the bus. Raises PortError with what is wrong with it."""
        s = self.settings
        options: dict[str, Any] = {"fd": s.fd, "receive_own_messages": False}
        if s.bitrate is not None:
            options["bitrate"] = s.bitrate
        if s.interface == "slcan" and s.channel.startswith("/dev/pts/"):
            options["sleep_after_open"] = 0.0  # 2 s by default, for boards that reset when their port is opened
        self.close()
        try:
            # ignore_config: python-can's own files and environment must not change what the configuration says
            self._bus = can.Bus(channel=s.channel, interface=s.interface, ignore_config=True, **options)
            now_ns = time.monotonic_ns()
            if s.interface == "socketcan":
                self._source = FrameSocket(self._bus.socket, self.counters, now_ns, self._last_ns)
            elif s.interface == "slcan":
                self._source = FrameSerial(self._bus.serialPortOrig, self.counters)
            else:
                self._source = FrameBus(self._bus, self.counters)
        except (can.CanError, OSError, ValueError, NotImplementedError) as e:
            self.close()
            raise PortError(f"{self._where()}: cannot be opened: {_reason(e)}") from e
        self._next_drain_ns = now_ns + s.drain_ms * MS
        self._block_end_ns = now_ns + s.block_ms * MS

    def read(self) -> list[tuple[int, CanFrames]]:
        """Drain until the block ends and return [(monotonic ns, frames)], or [] if no frame came.

        Raises PortError when the bus or its device is lost, after the frames that came before have been returned.
        """
        source = self._source
        if source is None:
            raise PortError(f"{self._where()}: is not open")
        give_up_ns = time.monotonic_ns() + MAX_WAIT_NS
        while source.failure is None:
            now_ns = time.monotonic_ns()
            if now_ns < self._next_drain_ns:
                time.sleep((self._next_drain_ns - now_ns) / S)
            source.drain()
            now_ns = time.monotonic_ns()
            # the next one on the grid: after a stall the drains that were missed are not made up for
            step_ns = self.settings.drain_ms * MS
            self._next_drain_ns += ((now_ns - self._next_drain_ns) // step_ns + 1) * step_ns
            if now_ns >= self._block_end_ns:
                break
            if now_ns >= give_up_ns:
                return []
        now_ns = time.monotonic_ns()
        step_ns = self.settings.block_ms * MS
        if now_ns >= self._block_end_ns:
            self._block_end_ns += ((now_ns - self._block_end_ns) // step_ns + 1) * step_ns
        frames = source.block()
        if frames is not None:
            self.counters["blocks"] += 1
            self.counters["frames"] += frames.t_ns.size
            self._last_ns = int(frames.t_ns[-1])
            return [(now_ns, frames)]
        if source.failure is not None:
            raise PortError(f"{self._where()}: lost: {_reason(source.failure)}") from source.failure
        return []

    def close(self, silently: bool = False) -> None:
        """Close the bus; twice is fine, and a device that is gone does not matter. `silently`: without a word to the
        device, which another port has meanwhile: an slcan adapter would close that one's channel."""
        bus, self._bus, self._source = self._bus, None, None
        if bus is None:
            return
        if silently and (adapter := getattr(bus, "serialPortOrig", None)) is not None:
            with contextlib.suppress(OSError):
                adapter.close()
        with contextlib.suppress(can.CanError, OSError, ValueError):
            bus.shutdown()
        # python-can's slcan writes a last command before it closes, and leaves the file open when that fails
        serial_port = getattr(bus, "serialPortOrig", None)
        if serial_port is not None:
            with contextlib.suppress(OSError):
                serial_port.close()

    def _where(self) -> str:
        return f"CAN {self.settings.interface} {self.settings.channel}"


HINTS = {
    errno.ENETDOWN: "the link is down (ip link set it up; after bus-off: restart-ms)",
    errno.ENODEV: "there is no such interface, or it has been removed",
    errno.EAFNOSUPPORT: "this kernel has no SocketCAN (modules can, can_raw)",
    errno.ENOENT: "there is no such device",
    errno.EACCES: "no permission for the device (group dialout?)",
    errno.EBUSY: "another program has it open",
    errno.EIO: "the device is gone",
}


def _reason(e: BaseException) -> str:
    """What an engineer can act on, found along the causes that python-can wraps."""
    text = f"{type(e).__name__}: {e}"
    cause: BaseException | None = e
    while cause is not None:
        number = getattr(cause, "errno", None) or getattr(cause, "error_code", None)
        if number in HINTS:
            return f"{HINTS[number]} [{text}]"
        if cause.__cause__ is not None:
            text = f"{text}: {cause.__cause__}"
        cause = cause.__cause__
    return text
