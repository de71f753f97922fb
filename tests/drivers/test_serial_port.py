"""The serial port on real pseudo-terminals: exact bytes, and a clear word for each way it can fail."""

from __future__ import annotations

import errno
import os
import random
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

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
    while got < size:
        for stamp, data in port.read():
            assert stamp > before
            before = stamp
            parts.append(data)
            got += len(data)
    return b"".join(parts)


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
    assert port.counters["reads"] < len(sent) / 100  # never byte by byte
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
    with pytest.raises(PortError, match="lost /dev/"):
        port.read()
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


def test_a_url_handler_of_pyserial_works() -> None:
    port = make("loop://")
    port.open()
    port._serial.write(b"through the loop")
    assert collect(port, 16) == b"through the loop"
    port.close()


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
