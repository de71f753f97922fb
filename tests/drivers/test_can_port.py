"""The CAN port without a CAN bus: loopback UDP sockets, scripted sockets, a virtual bus, an slcan adapter on a pty."""

from __future__ import annotations

import csv
import errno
import os
import select
import socket
import struct
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import numpy as np
import pytest
from live import PATIENCE_S, until

from drivers import PortError, can_port
from drivers.can_port import CanPort, FrameBus, FrameSerial, FrameSocket, monotonic_stamps, unpack_frames
from drivers.clock_port import clock_pair
from drivers.dbc_codec import AccelCodec
from edge_agent.messages import MS, AccelerometerSettings, CanFlag, CanFrames, PortSettings, S

WALL = 1_700_000_000 * S
EFF, RTR, ERR = 0x80000000, 0x40000000, 0x20000000


def classic(can_id: int, data: bytes, length: int | None = None) -> bytes:
    """struct can_frame."""
    return struct.pack("=IB3x8s", can_id, len(data) if length is None else length, data)


def flexible(can_id: int, data: bytes, flags: int = 0) -> bytes:
    """struct canfd_frame."""
    return struct.pack("=IBB2x64s", can_id, len(data), flags, data)


def counters() -> dict[str, int]:
    return CanPort(PortSettings("can", "can")).counters


def stamp_of(wall_ns: int) -> tuple[int, int, bytes]:
    return socket.SOL_SOCKET, can_port.SO_TIMESTAMPNS, struct.pack("@ll", *divmod(wall_ns, S))


def drops(count: int) -> tuple[int, int, bytes]:
    return socket.SOL_SOCKET, can_port.SO_RXQ_OVFL, struct.pack("=I", count)


class Script:
    """A socket that plays frames, control messages and errors in order, then has nothing more."""

    def __init__(self, *steps: bytes | tuple[Any, ...] | OSError) -> None:
        self.steps: list[Any] = list(steps)
        self.options: dict[int, int] = {}
        self.blocking = True

    def setsockopt(self, level: int, option: int, value: int) -> None:
        if option == can_port.SO_RCVBUFFORCE:
            raise PermissionError(errno.EPERM, "needs CAP_NET_ADMIN")
        self.options[option] = value

    def getsockopt(self, level: int, option: int) -> int:
        return self.options[option]

    def setblocking(self, flag: bool) -> None:
        self.blocking = flag

    def recvmsg(self, size: int, ancillary: int) -> tuple[bytes, list[tuple[int, int, bytes]], int, Any]:
        step = self.steps.pop(0) if self.steps else BlockingIOError()
        if isinstance(step, OSError):
            raise step
        if isinstance(step, bytes):
            return step, [], 0, None
        return step[0], list(step[1:]), 0, None


@pytest.fixture
def loopback() -> Iterator[tuple[socket.socket, socket.socket]]:
    """(receiver, sender): SO_TIMESTAMPNS works on them as on a CAN socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.connect(receiver.getsockname())
            yield receiver, sender


# ------------------------------------------------------------------------------------------------------ stamps (pure)


def stamps(
    wall: list[int], drains: list[tuple[int, int, int, int]], last_ns: int = 0
) -> tuple[list[int], list[bool], list[bool]]:
    counts, since, mono, wall_at = np.array(drains, np.int64).T
    t, spread, unstamped = monotonic_stamps(np.array(wall, np.int64), counts, since, mono, wall_at, last_ns)
    return t.tolist(), spread.tolist(), unstamped.tolist()


def test_a_stamp_becomes_monotonic_by_its_age() -> None:
    # two drains, between which the wall clock was slewed by 7 ns
    drains = [(2, 0, 20 * MS, WALL + 20 * MS), (1, 20 * MS, 40 * MS, WALL + 40 * MS + 7)]
    t, spread, unstamped = stamps([WALL + 5 * MS, WALL + 12 * MS, WALL + 33 * MS + 7], drains)
    assert t == [5 * MS, 12 * MS, 33 * MS]
    assert not any(spread)
    assert not any(unstamped)


def test_frames_that_waited_for_a_stalled_reader_keep_their_times() -> None:
    t, spread, _ = stamps([WALL + 1 * MS, WALL + 1999 * MS], [(2, 0, 2000 * MS, WALL + 2000 * MS)])
    assert t == [1 * MS, 1999 * MS]
    assert not any(spread)


@pytest.mark.parametrize("step_ns", [3600 * S, -3600 * S, 200 * MS, -30 * MS])
def test_a_clock_step_spreads_the_frames_over_the_drain(step_ns: int) -> None:
    # GIVEN four frames stamped before the wall clock stepped
    before = [WALL + 102 * MS, WALL + 107 * MS, WALL + 112 * MS, WALL + 117 * MS]
    # WHEN the drain reads the clocks after it
    t, spread, _ = stamps(before, [(4, 100 * MS, 120 * MS, WALL + 120 * MS + step_ns)])
    # THEN
    assert t == [105 * MS, 110 * MS, 115 * MS, 120 * MS]
    assert spread == [True] * 4


def test_frames_after_the_step_keep_their_times_and_those_before_stay_before() -> None:
    step = 3600 * S
    wall = [WALL + 101 * MS, WALL + 102 * MS, WALL + 103 * MS + step, WALL + 119 * MS + step]
    t, spread, _ = stamps(wall, [(4, 100 * MS, 120 * MS, WALL + 120 * MS + step)])
    assert spread == [True, True, False, False]
    assert t == [103 * MS, 103 * MS, 103 * MS, 119 * MS]


@pytest.mark.parametrize(("age_ns", "is_step"), [(-1, True), (0, False), (70 * MS, False), (70 * MS + 1, True)])
def test_the_limits_of_an_age(age_ns: int, is_step: bool) -> None:
    now = 120 * MS
    _, spread, _ = stamps([WALL + now - age_ns], [(1, 100 * MS, now, WALL + now)])
    assert spread == [is_step]


def test_time_never_runs_backwards() -> None:
    drains = [(2, 100 * MS, 120 * MS, WALL + 120 * MS)]
    t, _, _ = stamps([WALL + 110 * MS, WALL + 109 * MS], drains, last_ns=112 * MS)
    assert t == [112 * MS, 112 * MS]


def test_a_frame_without_a_stamp_is_put_at_the_drain() -> None:
    t, spread, unstamped = stamps([0, WALL + 119 * MS], [(2, 100 * MS, 120 * MS, WALL + 120 * MS)])
    assert t == [120 * MS, 120 * MS]
    assert spread == [False, False]
    assert unstamped == [True, False]


# ------------------------------------------------------------------------------------------------------ frames (pure)


def test_unpack_classic_frames() -> None:
    frames = [
        classic(0x123, b"\1\2\3"),
        classic(EFF | 0x18FF3408, bytes(range(8))),
        classic(RTR | 0x7FF, b"", 5),
        classic(ERR | 0x40, bytes(8)),
    ]
    can_id, flags, length, data = unpack_frames(frames)
    assert can_id.tolist() == [0x123, 0x18FF3408, 0x7FF, 0x40]
    assert flags.tolist() == [0, CanFlag.EXT, CanFlag.RTR, CanFlag.ERR]
    assert length.tolist() == [3, 8, 5, 8]
    assert data.tolist() == [[1, 2, 3, 0, 0, 0, 0, 0], list(range(8)), [0] * 8, [0] * 8]
    assert [a.dtype for a in (can_id, flags, length, data)] == [np.uint32, np.uint8, np.uint8, np.uint8]


def test_unpack_mixes_classic_and_fd() -> None:
    payload = bytes(range(100, 148))
    frames = [classic(1, b"\xaa" * 8), flexible(EFF | 2, payload, flags=1), flexible(3, b"", flags=2 | 4)]
    can_id, flags, length, data = unpack_frames(frames)
    assert can_id.tolist() == [1, 2, 3]
    assert flags.tolist() == [0, CanFlag.EXT | CanFlag.FD | CanFlag.BRS, CanFlag.FD | CanFlag.ESI]
    assert length.tolist() == [8, 48, 0]
    assert data.shape == (3, 64)
    assert data[0].tolist() == [0xAA] * 8 + [0] * 56
    assert data[1].tolist() == list(payload) + [0] * 16


def test_unpack_clears_what_lies_beyond_the_length_and_cuts_lengths_that_cannot_be() -> None:
    _, _, length, data = unpack_frames([classic(1, b"\xff" * 8, 2), classic(1, b"\xff" * 8, 200)])
    assert length.tolist() == [2, 8]
    assert data.tolist() == [[255, 255, 0, 0, 0, 0, 0, 0], [255] * 8]


# ----------------------------------------------------------------------------------------------------------- sockets


def test_a_socket_gives_frames_with_the_kernels_stamps(
    loopback: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    receiver, sender = loopback

    def pair() -> tuple[int, int]:
        """Both clocks, and the machine has not stood still in between."""
        while True:
            before, wall_ns = time.monotonic_ns(), time.time_ns()
            if time.monotonic_ns() - before < 10 * MS:
                return before, wall_ns

    def stamped() -> bool:
        """The kernel takes its time to begin with it: until then what arrives has the time at which it is read."""
        sender.send(b"probe")
        sent = time.time_ns()
        select.select([receiver], [], [], PATIENCE_S)
        ((_, _, stamp),) = (a for a in receiver.recvmsg(100, 100)[1] if a[1] == can_port.SO_TIMESTAMPNS)
        seconds, ns = can_port.TIMESPEC.unpack(stamp)
        return bool(seconds * S + ns <= sent)

    monkeypatch.setattr(can_port, "clock_pair", pair)
    source = FrameSocket(receiver, counters(), time.monotonic_ns())
    until(stamped, "stamps of the kernel")
    wall = [time.time_ns()]
    for k, frame in enumerate([*(classic(0x100 + k, bytes([k])) for k in range(5)), flexible(0x200, b"\7" * 12)]):
        sender.send(frame)
        wall.append(time.time_ns())
        if k == 4:
            source.drain()
    while len(source._frames) < 6:
        source.drain()
    offset = np.concatenate([np.full(taken, wall_ns - mono_ns) for taken, _, mono_ns, wall_ns in source._drains])
    block = source.block()
    assert block is not None
    assert block.can_id.tolist() == [0x100, 0x101, 0x102, 0x103, 0x104, 0x200]
    assert block.length.tolist() == [1, 1, 1, 1, 1, 12]
    assert block.dropped == 0
    assert block.t_ns.dtype == np.int64
    # each stamp, put back on the wall clock by its drain's pair, lies between the readings around its sending
    for t, low, high in zip((block.t_ns + offset).tolist(), wall[:-1], wall[1:], strict=True):
        assert low <= t <= high
    assert not (block.flags & (CanFlag.SPREAD | CanFlag.DRAIN)).any()
    assert source.block() is None


def test_the_receive_buffer_is_raised(loopback: tuple[socket.socket, socket.socket]) -> None:
    receiver, _ = loopback
    default = receiver.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    count = counters()
    FrameSocket(receiver, count, 0)
    assert count["receive_buffer"] >= default
    # without privileges the plain option is tried
    script = Script()
    FrameSocket(script, count, 0)
    assert script.options[socket.SO_RCVBUF] == can_port.RECEIVE_BUFFER
    assert script.options[can_port.SO_RXQ_OVFL] == 1
    assert not script.blocking


def test_kernel_drops_are_cumulative_and_ride_on_a_later_frame() -> None:
    mono, wall = clock_pair()
    at = stamp_of(wall)
    frame = classic(1, b"x")
    script = Script(
        (frame, at), (frame, at, drops(3)), (frame, drops(3), at), BlockingIOError(), (frame, at, drops(10))
    )
    count = counters()
    source = FrameSocket(script, count, mono)
    source.drain()
    first = source.block()
    source.drain()
    second = source.block()
    assert first is not None
    assert second is not None
    assert (first.dropped, second.dropped) == (3, 7)
    assert count["dropped"] == 10


def test_the_drop_count_wraps_at_32_bits() -> None:
    frame = classic(1, b"x")
    count = counters()
    source = FrameSocket(Script((frame, drops(0xFFFFFFFE)), (frame, drops(1))), count, 0)
    source.drain()
    assert count["dropped"] == 0xFFFFFFFE + 3


def test_error_frames_are_kept_and_counted_by_class() -> None:
    overflow = classic(ERR | 0x004, b"\0\1\0\0\0\0\0\0")
    passive = classic(ERR | 0x004, b"\0\x10\0\0\0\0\0\0")
    script = Script(overflow, passive, classic(ERR | 0x0C0, bytes(8)), classic(ERR | 0x100, bytes(8)), classic(4, b"x"))
    count = counters()
    source = FrameSocket(script, count, 0)
    source.drain()
    block = source.block()
    assert block is not None
    assert block.can_id.tolist() == [4, 4, 0xC0, 0x100, 4]
    assert (block.flags & CanFlag.ERR != 0).tolist() == [True, True, True, True, False]
    assert {k: v for k, v in count.items() if v and k != "receive_buffer"} == {
        "error_frames": 4,
        "error_controller": 2,
        "error_bus_off": 1,
        "error_bus": 1,
        "error_restarted": 1,
        "overruns": 1,
    }


def test_a_wall_clock_step_under_the_stamps_is_flagged() -> None:
    mono, wall = clock_pair()
    source = FrameSocket(Script((classic(1, b"x"), stamp_of(wall - 3600 * S))), count := counters(), mono)
    source.drain()
    block = source.block()
    assert block is not None
    assert block.flags.tolist() == [CanFlag.SPREAD]
    assert mono <= block.t_ns[0] <= clock_pair()[0]
    assert count["spread"] == 1


def test_what_is_no_can_frame_is_counted() -> None:
    source = FrameSocket(Script(b"short", classic(1, b"x")), count := counters(), 0)
    source.drain()
    block = source.block()
    assert block is not None
    assert block.t_ns.size == 1
    assert count["malformed"] == 1


def test_a_lost_link_is_reported_behind_the_frames_that_are_still_queued() -> None:
    down = OSError(errno.ENETDOWN, "Network is down")
    source = FrameSocket(Script(classic(1, b"a"), down, classic(2, b"b")), counters(), 0)
    source.drain()
    block = source.block()
    assert block is not None
    assert block.can_id.tolist() == [1, 2]
    assert source.failure is down


def test_a_flood_is_taken_in_bounded_drains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(can_port, "DRAIN_LIMIT", 10)
    mono, wall = clock_pair()
    old = stamp_of(wall - 1000 * MS)
    source = FrameSocket(Script(*[(classic(k, b"x"), old) for k in range(25)]), counters(), mono - 2000 * MS)
    for _ in range(3):
        source.drain()
    block = source.block()
    assert block is not None
    assert block.can_id.tolist() == list(range(25))
    # the frames that had to wait for the second and third drain are old, which is no clock step
    assert not (block.flags & CanFlag.SPREAD).any()


# -------------------------------------------------------------------------------------------------------------- port


class SocketBus:
    """What python-can's SocketCAN bus is to the port."""

    def __init__(self, sock: Any) -> None:
        self.socket = sock
        self.closed = 0

    def shutdown(self) -> None:
        self.closed += 1


def socketcan_port(monkeypatch: pytest.MonkeyPatch, sock: Any) -> tuple[CanPort, SocketBus, dict[str, Any]]:
    bus = SocketBus(sock)
    asked: dict[str, Any] = {}

    def make(**options: Any) -> SocketBus:
        asked.update(options)
        return bus

    monkeypatch.setattr(can, "Bus", make)
    port = CanPort(PortSettings("can", "can", channel="can0", bitrate=500_000, fd=True, drain_ms=1, block_ms=5))
    port.open()
    return port, bus, asked


def gather(port: CanPort, frames: int) -> CanFrames:
    """Read until so many frames came."""
    blocks: list[CanFrames] = []
    end = time.monotonic() + PATIENCE_S
    while sum(b.t_ns.size for b in blocks) < frames:
        assert time.monotonic() < end, f"fewer than {frames} frames came"
        blocks += [block for _, block in port.read()]
    return CanFrames(
        np.concatenate([b.t_ns for b in blocks]),
        np.concatenate([b.can_id for b in blocks]),
        np.concatenate([b.flags for b in blocks]),
        np.concatenate([b.length for b in blocks]),
        np.concatenate([b.data for b in blocks]),
        sum(b.dropped for b in blocks),
    )


def test_socketcan_is_read_from_its_socket(
    monkeypatch: pytest.MonkeyPatch, loopback: tuple[socket.socket, socket.socket]
) -> None:
    receiver, sender = loopback
    port, bus, asked = socketcan_port(monkeypatch, receiver)
    assert asked == {
        "channel": "can0",
        "interface": "socketcan",
        "ignore_config": True,
        "fd": True,
        "bitrate": 500_000,
        "receive_own_messages": False,
    }
    for k in range(50):
        sender.send(classic(k, b"abc"))
    got = gather(port, 50)
    assert got.can_id.tolist() == list(range(50))
    assert (np.diff(got.t_ns) >= 0).all()
    assert port.counters["frames"] == 50
    assert port.counters["blocks"] >= 1
    assert port.read() == []  # an empty block is nothing
    port.close()
    port.close()
    assert bus.closed == 1


@pytest.mark.parametrize(
    ("number", "text"), [(errno.ENETDOWN, "the link is down"), (errno.ENODEV, "it has been removed")]
)
def test_a_lost_bus_gives_its_last_frames_and_then_an_error(
    monkeypatch: pytest.MonkeyPatch, number: int, text: str
) -> None:
    script = Script(classic(1, b"a"), OSError(number, os.strerror(number)), classic(2, b"b"))
    port, _, _ = socketcan_port(monkeypatch, script)
    ((_, block),) = port.read()
    assert block.can_id.tolist() == [1, 2]
    with pytest.raises(PortError, match=f"CAN socketcan can0: lost: .*{text}"):
        port.read()
    port.close()


def test_time_goes_on_across_a_reopening(monkeypatch: pytest.MonkeyPatch) -> None:
    port, _, _ = socketcan_port(monkeypatch, Script(classic(1, b"a")))
    before = gather(port, 1)
    port.open()
    source = port._source
    assert isinstance(source, FrameSocket)
    assert source._last_ns == before.t_ns[-1]


def test_a_long_block_does_not_hold_the_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(10**6))  # ms: each reading takes one, a sleep none

    def monotonic_ns() -> int:
        return next(clock) * MS

    monkeypatch.setattr(can_port, "time", SimpleNamespace(monotonic_ns=monotonic_ns, sleep=lambda seconds: None))
    monkeypatch.setattr(can_port, "MAX_WAIT_NS", 10 * MS)
    monkeypatch.setattr(can, "Bus", lambda **options: SocketBus(Script(classic(1, b"a"))))
    port = CanPort(PortSettings("can", "can", drain_ms=1, block_ms=40))
    port.open()
    reads = [port.read()]
    while not reads[-1]:
        begin = next(clock)
        reads.append(port.read())
        assert next(clock) - begin < 20
    assert len(reads) > 1
    assert reads[-1][0][1].can_id.tolist() == [1]


def test_reading_before_opening_is_an_error() -> None:
    with pytest.raises(PortError, match="is not open"):
        CanPort(PortSettings("can", "can")).read()


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (PortSettings("can", "can", interface="nonsense"), "'nonsense' not supported"),
        (PortSettings("can", "can", interface="slcan", channel="/dev/nowhere"), "no such device"),
        (PortSettings("can", "can", interface="slcan", channel=""), "Must specify a serial port"),
    ],
)
def test_what_cannot_be_opened_says_why(settings: PortSettings, text: str) -> None:
    with pytest.raises(PortError, match=text):
        CanPort(settings).open()


def test_a_kernel_without_can_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**options: Any) -> None:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    monkeypatch.setattr(can, "Bus", refuse)
    with pytest.raises(PortError, match="CAN socketcan can0: cannot be opened: this kernel has no SocketCAN"):
        CanPort(PortSettings("can", "can")).open()


# --------------------------------------------------------------------------------------------- python-can's other buses


def test_a_virtual_bus_is_drained_and_stamped_there() -> None:
    port = CanPort(PortSettings("can", "can", interface="virtual", channel="t1", drain_ms=1, block_ms=5))
    port.open()
    with can.Bus(interface="virtual", channel="t1", ignore_config=True) as peer:
        begin, _ = clock_pair()
        peer.send(can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\1\2"))
        peer.send(can.Message(arbitration_id=0x18FF3408, data=bytes(8)))
        peer.send(can.Message(arbitration_id=5, is_extended_id=False, is_remote_frame=True, dlc=4))
        peer.send(can.Message(arbitration_id=0x80, is_extended_id=False, is_error_frame=True, dlc=8, data=bytes(8)))
        got = gather(port, 4)
        assert got.data.shape == (4, 8)
        peer.send(can.Message(arbitration_id=6, is_fd=True, bitrate_switch=True, data=bytes(range(12))))
        fd = gather(port, 1)
    end, _ = clock_pair()
    assert got.can_id.tolist() == [0x123, 0x18FF3408, 5, 0x80]
    expected = [CanFlag(0), CanFlag.EXT, CanFlag.RTR, CanFlag.ERR]
    assert got.flags.tolist() == [int(f | CanFlag.DRAIN) for f in expected]
    assert got.length.tolist() == [2, 8, 4, 8]
    assert got.data[0].tolist() == [1, 2, 0, 0, 0, 0, 0, 0]
    assert (np.diff(got.t_ns) >= 0).all()
    assert begin <= got.t_ns[0]
    assert got.t_ns[-1] <= end
    assert fd.data.shape == (1, 64)
    assert fd.length.tolist() == [12]
    assert fd.flags.tolist() == [CanFlag.EXT | CanFlag.FD | CanFlag.BRS | CanFlag.DRAIN]
    assert port.counters["frames"] == 5
    assert port.counters["error_frames"] == 1
    port.close()


class Damaged:
    """A bus whose second frame python-can cannot read, and which is then lost."""

    def __init__(self) -> None:
        self.steps: list[Any] = [
            can.Message(arbitration_id=1, data=b"a"),
            ValueError("invalid literal for int() with base 16: '0x!'"),
            can.Message(arbitration_id=2, data=b"b"),
            can.CanOperationError("Could not read from serial device"),
        ]

    def recv(self, timeout: float) -> Any:
        step = self.steps.pop(0)
        if isinstance(step, Exception):
            raise step
        return step


def test_a_damaged_frame_is_counted_and_a_lost_device_ends_the_stream() -> None:
    source = FrameBus(Damaged(), count := counters())
    while source.failure is None:  # a machine that stands still ends a drain early
        source.drain()
    block = source.block()
    assert block is not None
    assert block.can_id.tolist() == [1, 2]
    assert count["malformed"] == 1
    assert isinstance(source.failure, can.CanOperationError)


# ------------------------------------------------------------------------------------------------------------- slcan


class Adapter:
    """An slcan adapter on a pseudo-terminal: sends the lines that it is given once its channel has been opened."""

    def __init__(self, lines: list[bytes]) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self.commands = b""
        self.lines = lines
        self.thread = threading.Thread(target=self._play, daemon=True)

    def _play(self) -> None:
        while b"O\r" not in self.commands:
            self.commands += os.read(self.master, 64)
        data = b"".join(self.lines)
        while data:  # blocks while the terminal's buffer is full, as the adapter's flow control would
            data = data[os.write(self.master, data) :]

    def __enter__(self) -> Adapter:
        self.thread.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        self.thread.join(PATIENCE_S if kind is None else 1.0)  # one whose channel nobody opened is left behind
        os.close(self.slave)
        os.close(self.master)


def slcan_port(adapter: Adapter) -> CanPort:
    settings = PortSettings(
        "can", "can", interface="slcan", channel=adapter.path, bitrate=500_000, drain_ms=1, block_ms=5
    )
    return CanPort(settings)


def test_slcan_frames_of_every_kind() -> None:
    lines = [b"t1232AABB\r", b"T18FF340880001020304050607\r", b"r7FF4\r", b"t1!32AABB\r", b"t1248AABB\r", b"t0070\r"]
    with Adapter(lines) as adapter:
        port = slcan_port(adapter)
        port.open()
        got = gather(port, 4)
        port.close()
    assert b"S6\r" in adapter.commands
    assert got.can_id.tolist() == [0x123, 0x18FF3408, 0x7FF, 0x007]
    expected = [CanFlag(0), CanFlag.EXT, CanFlag.RTR, CanFlag(0)]
    assert got.flags.tolist() == [int(f | CanFlag.DRAIN) for f in expected]
    assert got.length.tolist() == [2, 8, 4, 0]
    assert port.counters["malformed"] == 2  # a wrong digit, and a frame that was cut


class Reads:
    """A serial port that gives these pieces, and then nothing."""

    timeout: float | None = 1.0

    def __init__(self, *pieces: bytes) -> None:
        self.pieces = list(pieces)

    def read(self, size: int) -> bytes:
        return self.pieces.pop(0) if self.pieces else b""


def test_a_frame_has_the_time_of_the_read_that_completed_it(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(1000, 9000, 1000))
    monkeypatch.setattr(can_port.time, "monotonic_ns", lambda: next(clock))
    port = Reads(b"t1230\rt12", b"40\rt1250\r", b"t1", b"", b"260\r")
    source = FrameSerial(port, counters())
    assert port.timeout == 0.0
    source.drain()
    first = source.block()
    source.drain()
    second = source.block()
    assert first is not None
    assert second is not None
    assert (first.can_id.tolist(), first.t_ns.tolist()) == ([0x123, 0x124, 0x125], [1000, 2000, 2000])
    assert (second.can_id.tolist(), second.t_ns.tolist()) == ([0x126], [4000])
    assert source.block() is None


def test_garbage_on_the_adapters_line_is_counted_and_the_port_goes_on() -> None:
    """Bytes that are no text at all, a flood without an end of line, frames run into one another."""
    lines = [b"t1231AA\r", b"\xff\xfe\x00\r", b"\x80" * 5000, b"t1241BB\r", b"t12", b"t1251CC\r", b"z\rZ\rV1013\r\a\r"]
    with Adapter([*lines, b"t1261DD\r"]) as adapter:
        port = slcan_port(adapter)
        port.open()
        got = gather(port, 4)
        port.close()
    assert got.can_id.tolist() == [0x123, 0x124, 0x125, 0x126]
    assert got.data[:, 0].tolist() == [0xAA, 0xBB, 0xCC, 0xDD]
    assert port.counters["malformed"] >= 3


def test_an_adapter_that_is_pulled_out_is_a_lost_port() -> None:
    with Adapter([b"t1231AA\r"]) as adapter:
        port = slcan_port(adapter)
        port.open()
        line = port._bus.serialPortOrig
        assert gather(port, 1).can_id.tolist() == [0x123]
        adapter.thread.join()
        os.close(adapter.master)
        with pytest.raises(PortError, match="lost"):
            gather(port, 1)
        port.close()  # the adapter can no longer be told to close its channel
        adapter.master = os.dup(adapter.slave)
    assert not line.is_open


def test_a_real_recording_through_an_slcan_adapter(shared_data: Path) -> None:
    """D1: a GNSS + inertial module; all 4518 accelerations as other people's decoder found them, no frame lost."""
    folder = shared_data / "D1-canedge-imu-mf4"
    lines = []
    for line in (folder / "derived" / "00000005-60FEB5A8.candump.log").read_text().splitlines():
        can_id, _, data = line.split()[2].partition("#")
        kind = "T" if len(can_id) == 8 else "t"
        lines.append(f"{kind}{can_id}{len(data) // 2}{data}\r".encode())
    codec = AccelCodec(
        AccelerometerSettings(
            "imu",
            "can",
            dbc_text=(folder / "canmod-gps.dbc").read_text(),
            signals=("gnss_imu.AccelerationX", "gnss_imu.AccelerationY", "gnss_imu.AccelerationZ"),
        )
    )
    xyz = []
    with Adapter(lines) as adapter:
        port = slcan_port(adapter)
        port.open()
        end = time.monotonic() + PATIENCE_S
        while port.counters["frames"] < len(lines) and time.monotonic() < end:
            for _, block in port.read():
                samples, notes = codec.feed(block)
                assert notes == []
                if samples is not None:
                    assert samples.drain_stamped
                    xyz.append(samples.xyz)
        port.close()
    assert port.counters["frames"] == len(lines) == 5477
    with (folder / "derived" / "00000005-60FEB5A8.gnss_imu.csv").open() as f:
        truth = [[float(row[f"Acceleration{axis}"]) for axis in "XYZ"] for row in csv.DictReader(f)]
    assert len(truth) == 4518
    assert np.array_equal(np.concatenate(xyz), truth)


@pytest.mark.parametrize("silently", [True, False])
def test_a_port_that_was_given_up_does_not_close_the_channel_of_the_one_that_took_over(silently: bool) -> None:
    with Adapter([b"t1231AA\r"]) as adapter:
        port = slcan_port(adapter)
        port.open()
        line = port._bus.serialPortOrig
        assert gather(port, 1).can_id.tolist() == [0x123]
        adapter.thread.join()
        port.close(silently)
        assert not line.is_open
        os.write(adapter.slave, b"end")
        said = b""
        while not said.endswith(b"end"):
            said += os.read(adapter.master, 64)
    assert said.removeprefix(b"O\r") == (b"end" if silently else b"C\rend")  # python-can may have said O twice
