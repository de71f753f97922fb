"""A serial port as it is: bytes when they wait, never line by line, never parsed.

Device paths (prefer /dev/serial/by-id/...), pseudo-terminals, `socket://HOST:PORT` (the bytes of a TCP server: a
receiver's own port, a serial server in raw mode) and `rfc2217://HOST:PORT` (a serial server that takes the baud rate).
`read` sleeps until the first byte and then a little longer, so that a burst of sentences is one block and not a
wake-up per byte; its stamp is the time of the read. Opening throws away what the driver held from before.

What has a descriptor is read directly: pyserial's socket handler says 1 for any number of bytes that wait, which would
make a read of each. Its RFC 2217 handler queues single bytes (about 2 us each); a lost connection is told after the
bytes that had come. A peer that vanishes without a word (power cut) is found by TCP keep-alive within 30 s.
Left out: reopening and back-off, which are the runtime's; name look-ups, bounded only by the system's resolver.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import queue
import select
import socket
import threading
import time
from pathlib import Path
from typing import Any

import serial

from drivers import PortError
from edge_agent.messages import PortSettings

WAIT_S = 0.5
"""Longest wait of a read for its first byte."""
COALESCE_S = 0.02
"""Pause after the first byte: 230 bytes at 115200 baud, well below the 4095 that the kernel holds."""
BLOCK = 4096
LIMIT = 65536
"""Most bytes of one read, so that a flood still comes in blocks that the queues can count."""
KEEP_ALIVE = ((socket.TCP_KEEPIDLE, 15), (socket.TCP_KEEPINTVL, 5), (socket.TCP_KEEPCNT, 3))
"""Seconds of silence before the kernel asks the peer, seconds between questions, questions without an answer."""


class SerialPort:
    """One serial device. `counters`: bytes, reads, opens. `close` may come from another thread, and then waits for a
    read under way (at most about 0.5 s)."""

    def __init__(self, settings: PortSettings) -> None:
        self.settings = settings
        self.counters: dict[str, int] = {"bytes": 0, "reads": 0, "opens": 0}
        self._serial: Any | None = None
        self._fd = -1
        self._queue: queue.Queue[bytes | None] | None = None  # of the RFC 2217 handler
        self._lock = threading.Lock()

    def open(self) -> None:
        """Open the device for this program alone, where the platform can. Raises PortError saying what to do."""
        with self._lock:
            self._close()
            try:
                port = self._open(exclusive=True)
            except (OSError, ValueError) as e:
                if getattr(e, "errno", None) not in (
                    errno.ENOTTY,
                    errno.EINVAL,
                    errno.ENOSYS,
                    errno.ENOLCK,
                    errno.EOPNOTSUPP,
                ):
                    raise self._explain(e) from e
                try:  # a device that cannot be locked
                    port = self._open(exclusive=False)
                except (OSError, ValueError) as again:
                    raise self._explain(again) from again
            self._serial = port
            self._queue = getattr(port, "_read_buffer", None)
            self._fd = port.fileno() if self._queue is None else -1
            sock = getattr(port, "_socket", None)
            if sock is not None:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
                for option, value in KEEP_ALIVE:
                    sock.setsockopt(socket.IPPROTO_TCP, option, value)
            self.counters["opens"] += 1

    def _open(self, exclusive: bool) -> Any:
        port = serial.serial_for_url(
            self.settings.device, do_not_open=True, baudrate=self.settings.baud, timeout=WAIT_S
        )
        if isinstance(port, serial.Serial) and exclusive:
            port.exclusive = True
        port.open()
        return port

    def _explain(self, e: OSError | ValueError) -> PortError:
        device = self.settings.device
        # pyserial's network handlers wrap what happened in an error without a number
        cause = e.__context__ if isinstance(e.__context__, OSError) and not getattr(e, "errno", None) else e
        code = getattr(cause, "errno", None)
        if "://" in device:
            text = self._explain_network(cause, code)
        elif code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
            there = sorted(str(p) for p in Path("/dev/serial/by-id").glob("*"))
            text = f"no such device {device}; " + (f"there are: {', '.join(there)}" if there else "is it plugged in?")
        elif code in (errno.EACCES, errno.EPERM):
            text = (
                f"no permission for {device}: add the user to group dialout (usermod -aG dialout USER) and log in again"
            )
        elif code in (errno.EBUSY, errno.EAGAIN):
            text = f"{device} is busy: another program holds it (gpsd, ModemManager, a second agent?)"
        else:
            text = f"cannot open {device} at {self.settings.baud} baud: {e}"
        number = code if isinstance(code, int) and code > 0 else errno.EIO
        return PortError(number, f"port {self.settings.name}: {text}")

    def _explain_network(self, e: BaseException, code: int | None) -> str:
        url = self.settings.device
        if isinstance(e, socket.gaierror):
            return f"{url}: the host name is not known ({e.strerror}): write its address, or check DNS"
        if code == errno.ECONNREFUSED:
            return f"{url}: the host is there, but nothing listens on that port: check the port and the server's mode"
        if code in (errno.EHOSTUNREACH, errno.ENETUNREACH) or isinstance(e, TimeoutError):
            return f"{url}: no answer: check the address, the cable and the host's power"
        if code in (errno.EAFNOSUPPORT, errno.EPERM, errno.EACCES):
            return (
                f"{url}: this service may not open network sockets: install the drop-in network.conf, its head says how"
            )
        if "RFC2217" in str(e):
            return f"{url}: the server does not speak RFC 2217: if it sends bytes only, write socket:// instead"
        return f"cannot open {url}: {e}"

    def read(self) -> list[tuple[int, bytes]]:
        """[(monotonic ns, bytes)] of what waits, [] when nothing came for 0.5 s. Raises PortError when the device is
        lost or not open."""
        with self._lock:
            if self._serial is None:
                raise PortError(errno.EBADF, f"port {self.settings.name}: {self.settings.device} is not open")
            try:
                data = self._read_fd() if self._queue is None else self._read_queue(self._queue)
            except (OSError, ValueError, TypeError) as e:  # pyserial answers a vanished descriptor with any of them
                text = f"port {self.settings.name}: lost {self.settings.device}: {getattr(e, 'strerror', None) or e}"
                raise PortError(getattr(e, "errno", None) or errno.EIO, text) from e
            stamp = time.monotonic_ns()
        if not data:
            return []
        self.counters["bytes"] += len(data)
        self.counters["reads"] += 1
        return [(stamp, data)]

    def _read_fd(self) -> bytes:
        fd = self._fd
        if not select.select([fd], [], [], WAIT_S)[0]:
            return b""
        time.sleep(COALESCE_S)
        parts: list[bytes] = []
        size = 0
        while size < LIMIT:
            try:
                part = os.read(fd, BLOCK)
            except BlockingIOError:
                break
            except OSError:
                if parts:
                    break  # hand over what came; the next read meets the error again
                raise
            if not part:
                if parts:
                    break
                raise OSError(errno.EIO, "hung up (unplugged, or the other end closed)")
            parts.append(part)
            size += len(part)
            if len(part) < BLOCK // 4 or not select.select([fd], [], [], 0)[0]:
                break  # no flood
        return b"".join(parts)

    def _read_queue(self, waiting: queue.Queue[bytes | None]) -> bytes:
        """Of the RFC 2217 handler, past its own `read`, which forgets what waits once the connection is lost."""
        parts: list[bytes] = []
        with contextlib.suppress(queue.Empty):
            byte = waiting.get(timeout=WAIT_S)
            if byte is not None:
                time.sleep(COALESCE_S)
            while byte is not None:
                parts.append(byte)
                if len(parts) == LIMIT:
                    return b"".join(parts)
                byte = waiting.get_nowait()
            waiting.put(None)  # the end is met again by the next read
            if not parts:
                raise OSError(errno.EIO, "the other end closed the connection")
        return b"".join(parts)

    def let_go(self) -> None:
        """While a read of another thread hangs: the device may be opened again, though `close` would wait in vain."""
        if self._fd >= 0:
            with contextlib.suppress(OSError):
                fcntl.flock(self._fd, fcntl.LOCK_UN)

    def close(self, silently: bool = False) -> None:
        """Idempotent, never raises; never says anything to the device."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        port, self._serial, self._fd, self._queue = self._serial, None, -1, None
        if port is not None:
            sock = getattr(port, "_socket", None)
            with contextlib.suppress(OSError, ValueError):  # the device may be gone already
                port.close()
            if sock is not None:
                sock.close()  # pyserial forgets to where the peer has reset the connection
