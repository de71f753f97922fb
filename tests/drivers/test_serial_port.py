"""The serial port on real pseudo-terminals: exact bytes, and a clear word for each way it can fail."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import random
import re
import socket
import struct
import sys
import termios
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from live import PATIENCE_S, until
from serial import rfc2217

import drivers.serial_port
from drivers import PORTS, PortError, load
from drivers.serial_port import SerialPort
from edge_agent.messages import PortSettings


class Pty:
    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        self.device = os.ttyname(self._slave)

    def hang_up(self) -> None:
        for fd in (self.master, self._slave):
            if fd >= 0:
                os.close(fd)
        self.master = self._slave = -1


@pytest.fixture
def pty() -> Iterator[Pty]:
    p = Pty()
    yield p
    p.hang_up()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drivers.serial_port, "COALESCE_S", 0.001)


def make(device: str) -> SerialPort:
    return SerialPort(PortSettings(name="gnss", kind="serial", device=device))


def collect(port: SerialPort, size: int) -> bytes:
    parts: list[bytes] = []
    got = 0
    before = -1
    end = time.monotonic() + PATIENCE_S
    while got < size:
        assert time.monotonic() < end, f"{got} of {size} bytes came"
        for stamp, data in port.read():
            assert stamp >= before
            before = stamp
            parts.append(data)
            got += len(data)
    return b"".join(parts)


def waiting(fd: int) -> int:
    """Bytes that the kernel holds for a reader."""
    return int.from_bytes(fcntl.ioctl(fd, termios.FIONREAD, bytes(4)), sys.byteorder)


def lose(port: SerialPort) -> str:
    """Read until the loss of the device has come through; what is said of it."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        try:
            assert port.read() == []
        except PortError as e:
            return str(e)
    raise AssertionError("the device is not lost")


def test_bytes_arrive_exactly_as_written(pty: Pty) -> None:
    rng = random.Random(1)
    sent = bytes(range(256)) * 4 + rng.randbytes(200_000) + b"\x03\x04\x11\x13\x1a\x1c\r\r\n\n\x00\xff" * 100
    port = make(pty.device)
    port.open()

    def play() -> None:
        at = 0
        while at < len(sent):
            at += os.write(pty.master, sent[at : at + rng.randint(1, 3000)])

    player = threading.Thread(target=play)
    player.start()
    got = collect(port, len(sent))
    player.join()
    assert got == sent
    assert port.counters["bytes"] == len(sent)
    port.close()


def test_what_waits_is_one_block(pty: Pty) -> None:
    """Never byte by byte."""
    port = make(pty.device)
    port.open()
    os.write(pty.master, b"$GNGGA," * 100)
    until(lambda: waiting(pty._slave) == 700, "700 bytes")
    ((_, data),) = port.read()
    assert data == b"$GNGGA," * 100
    port.close()


def test_silence_is_an_empty_list(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drivers.serial_port, "WAIT_S", 0.01)
    port = make(pty.device)
    port.open()
    assert port.read() == []
    os.write(pty.master, b"$")
    assert collect(port, 1) == b"$"
    assert port.read() == []
    port.close()


def test_a_hang_up_is_a_lost_device(pty: Pty) -> None:
    port = make(pty.device)
    port.open()
    os.write(pty.master, b"last words")
    assert collect(port, 10) == b"last words"
    pty.hang_up()
    assert "lost /dev/" in lose(port)
    port.close()
    port.close()


def test_it_opens_again(pty: Pty) -> None:
    port = make(pty.device)
    for n in (1, 2):
        port.open()
        os.write(pty.master, b"hello")
        assert collect(port, 5) == b"hello"
        assert port.counters["opens"] == n
        port.close()
    with pytest.raises(PortError, match="not open"):
        port.read()


def test_no_such_device_is_said(tmp_path: Path) -> None:
    with pytest.raises(PortError, match="port gnss: no such device") as e:
        make(str(tmp_path / "ttyNONE")).open()
    assert e.value.errno == errno.ENOENT


def test_a_busy_device_is_said(pty: Pty) -> None:
    first = make(pty.device)
    first.open()
    with pytest.raises(PortError, match="busy"):
        make(pty.device).open()
    first.close()
    second = make(pty.device)
    second.open()
    second.close()


def test_a_port_whose_read_hangs_lets_its_device_go(pty: Pty) -> None:
    """GIVEN a driver that holds the device and hangs in a read WHEN it lets go THEN another one may open it."""
    hung, fresh = make(pty.device), make(pty.device)
    hung.open()
    with hung._lock:  # as in a read that does not come back
        with pytest.raises(PortError, match="busy"):
            fresh.open()
        hung.let_go()
        fresh.open()
    os.write(pty.master, b"x")
    assert collect(fresh, 1) == b"x"
    fresh.close()
    hung.close()
    hung.let_go()  # of what is closed: nothing


def test_a_file_is_no_port(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"x")
    with pytest.raises(PortError, match="cannot open"):
        make(str(path)).open()


def test_missing_permission_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: serial.Serial) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port: Permission denied")

    monkeypatch.setattr(serial.Serial, "open", refuse)
    with pytest.raises(PortError, match="add the user to group dialout"):
        make("/dev/ttyUSB0").open()


def test_a_device_that_cannot_be_locked_opens_all_the_same(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    real = serial.Serial.open

    def no_locks(self: serial.Serial) -> None:
        if self.exclusive:
            raise serial.SerialException(errno.ENOLCK, "Could not exclusively lock port")
        real(self)

    monkeypatch.setattr(serial.Serial, "open", no_locks)
    port = make(pty.device)
    port.open()
    os.write(pty.master, b"abc")
    assert collect(port, 3) == b"abc"
    port.close()


def test_an_impossible_baud_is_said(pty: Pty) -> None:
    with pytest.raises(PortError, match="-5 baud"):
        SerialPort(PortSettings(name="gnss", kind="serial", device=pty.device, baud=-5)).open()


class Server:
    """A TCP server on the loopback that takes one client after the other."""

    def __init__(self) -> None:
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.listening.getsockname()[1]}"
        self.clients: list[socket.socket] = []

    def accept(self) -> socket.socket:
        self.clients.append(self.listening.accept()[0])
        return self.clients[-1]

    def close(self) -> None:
        for s in (self.listening, *self.clients):
            s.close()


@pytest.fixture
def server() -> Iterator[Server]:
    s = Server()
    yield s
    s.close()


NOISE = bytes(range(256)) * 4 + random.Random(2).randbytes(200_000) + b"\xff\xff\xfa\x00\r\n" * 100


def test_a_tcp_server_is_read_in_blocks_to_its_last_byte_and_again(server: Server) -> None:
    port = make(f"socket://{server.address}")
    for _ in range(2):
        port.open()
        client = server.accept()

        def play(client: socket.socket = client) -> None:
            client.sendall(NOISE)
            client.close()

        player = threading.Thread(target=play)
        player.start()
        until(lambda: waiting(port._fd) > 1000, "the first thousand bytes")
        ((_, first),) = port.read()  # pyserial's `in_waiting` says 1: a read of each byte
        assert len(first) > 1000
        assert first + collect(port, len(NOISE) - len(first)) == NOISE
        assert re.search(rf"lost socket://{server.address}: .*the other end closed", lose(port))
        player.join()
        port.close()
    assert port.counters["opens"] == 2


def test_a_silent_tcp_server_is_silence_and_the_kernel_asks_whether_it_lives(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drivers.serial_port, "WAIT_S", 0.01)
    port = make(f"socket://{server.address}")
    port.open()
    assert port.read() == []
    with socket.socket(fileno=os.dup(port._fd)) as s:
        assert s.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        assert s.getsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE) == 15
    port.close()


def test_a_reset_connection_is_a_lost_device(server: Server) -> None:
    port = make(f"socket://{server.address}")
    port.open()
    client = server.accept()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
    assert "lost socket://" in lose(port)
    port.close()


class Rfc2217Server:
    """A serial server: pyserial's own server side with a port that has every line (a pseudo-terminal has none)."""

    def __init__(self, server: Server) -> None:
        self.client = server.accept()
        self.serial = serial.serial_for_url("loop://", 9600)
        self._lock = threading.Lock()
        self.manager = rfc2217.PortManager(self.serial, self)
        self._threads = [threading.Thread(target=self._commands, daemon=True)]
        self._threads[0].start()

    def write(self, data: bytes) -> None:
        with self._lock:
            self.client.sendall(data)

    def _commands(self) -> None:
        with contextlib.suppress(OSError):
            while data := self.client.recv(1024):
                list(self.manager.filter(data))  # a generator

    def send(self, data: bytes) -> None:
        self.write(b"".join(self.manager.escape(data)))

    def close(self) -> None:
        with contextlib.suppress(OSError):  # the client may have gone first
            self.client.shutdown(socket.SHUT_RDWR)
        self.client.close()
        self._threads[0].join()
        self.serial.close()


# pyserial's handler sets up its thread in a way that Python calls old
@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")
def test_an_rfc2217_server_takes_the_baud_rate_and_loses_nothing(server: Server) -> None:
    device = f"rfc2217://{server.address}?timeout={PATIENCE_S:.0f}"  # for the server's answers
    port = SerialPort(PortSettings("gnss", "serial", device=device, baud=38400))
    made: list[Rfc2217Server] = []
    host = threading.Thread(target=lambda: made.append(Rfc2217Server(server)))
    host.start()
    port.open()
    host.join()
    far = made[0]
    assert far.serial.baudrate == 38400
    player = threading.Thread(target=lambda: (far.send(NOISE), far.close()))
    player.start()
    player.join()
    held = port._queue
    assert held is not None
    until(lambda: held.qsize() > len(NOISE), "every byte and the end, one by one from pyserial's thread")
    assert collect(port, len(NOISE)) == NOISE  # also what had come before the end of the connection was noticed
    assert port.counters["reads"] == -(-len(NOISE) // drivers.serial_port.LIMIT)
    for _ in range(2):
        assert re.search(r"lost rfc2217://.*the other end closed", lose(port))
    port.close()


def test_what_is_wrong_with_a_network_source_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as deaf:  # holds its port, so that nobody else listens there
        deaf.bind(("127.0.0.1", 0))
        with pytest.raises(PortError, match="nothing listens on that port"):
            make(f"socket://127.0.0.1:{deaf.getsockname()[1]}").open()

    def fail(error: OSError) -> None:
        def connect(*args: object, **options: object) -> socket.socket:
            assert options["timeout"] == 5  # bounded
            raise error

        monkeypatch.setattr(socket, "create_connection", connect)

    for error, said in (
        (socket.gaierror(-2, "Name or service not known"), r"host name is not known \(Name or service not known\)"),
        (TimeoutError("timed out"), "no answer: check the address"),
        (OSError(errno.EHOSTUNREACH, "No route to host"), "no answer: check the address"),
        (OSError(errno.EAFNOSUPPORT, "Address family not supported"), "install the drop-in network.conf"),
        (OSError(errno.EPERM, "Operation not permitted"), "install the drop-in network.conf"),
    ):
        fail(error)
        for scheme in ("socket", "rfc2217"):
            with pytest.raises(PortError, match=said):
                make(f"{scheme}://receiver.example:5017").open()


@pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")
def test_a_server_without_rfc2217_is_said(server: Server) -> None:
    with pytest.raises(PortError, match="does not speak RFC 2217: if it sends bytes only, write socket:// instead"):
        make(f"rfc2217://{server.address}?timeout=0.1").open()


def test_close_may_come_from_another_thread(pty: Pty) -> None:
    port = make(pty.device)
    port.open()
    closer = threading.Thread(target=port.close)
    closer.start()
    closer.join()
    with pytest.raises(PortError):
        port.read()


def test_the_table_knows_it() -> None:
    assert load(PORTS, "serial") is SerialPort
