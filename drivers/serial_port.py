"""A serial port as it is: bytes when they wait, never line by line, never parsed.

Anything that pyserial opens: device paths (prefer /dev/serial/by-id/...), pseudo-terminals, its URL handlers. `read`
sleeps until the first byte and then a little longer, so that a burst of sentences is one block and not a wake-up per
byte; its stamp is the time of the read. Opening throws away what the driver held from before. Left out: reopening
and back-off, which are the runtime's.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
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


class SerialPort:
    """One serial device. `counters`: bytes, reads, opens. `close` may come from another thread, and then waits for a
    read under way (at most about 0.5 s)."""

    def __init__(self, settings: PortSettings) -> None:
        self.settings = settings
        self.counters: dict[str, int] = {"bytes": 0, "reads": 0, "opens": 0}
        self._serial: Any | None = None
        self._fd = -1
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
            # A real descriptor is read directly; a URL handler keeps its own protocol.
            self._fd = port.fileno() if os.name == "posix" and isinstance(port, serial.Serial) else -1
            self.counters["opens"] += 1

    def _open(self, exclusive: bool) -> Any:
        port = serial.serial_for_url(
            self.settings.device, do_not_open=True, baudrate=self.settings.baud, timeout=WAIT_S, write_timeout=WAIT_S
        )
        if os.name == "posix" and isinstance(port, serial.Serial) and exclusive:
            port.exclusive = True
        port.open()
        return port

    def _explain(self, e: OSError | ValueError) -> PortError:
        device = self.settings.device
        code = getattr(e, "errno", None)
        name = self.settings.name
        if code in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
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
        return PortError(code or errno.EIO, f"port {name}: {text}")

    def read(self) -> list[tuple[int, bytes]]:
        """[(monotonic ns, bytes)] of what waits, [] when nothing came for 0.5 s. Raises PortError when the device is
        lost or not open."""
        with self._lock:
            if self._serial is None:
                raise PortError(errno.EBADF, f"port {self.settings.name}: {self.settings.device} is not open")
            try:
                data = self._read_fd() if self._fd >= 0 else self._read_url(self._serial)
            except (OSError, ValueError, TypeError) as e:  # pyserial answers a vanished descriptor with any of them
                text = f"port {self.settings.name}: lost {self.settings.device}: {e}"
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

    def _read_url(self, port: Any) -> bytes:
        data = bytes(port.read(1))
        if data:
            time.sleep(COALESCE_S)
            waiting = port.in_waiting
            if waiting:
                data += bytes(port.read(min(waiting, LIMIT)))
        return data

    def close(self) -> None:
        """Idempotent, never raises."""
        with self._lock:
            self._close()

    def _close(self) -> None:
        port, self._serial, self._fd = self._serial, None, -1
        if port is not None:
            with contextlib.suppress(OSError, ValueError):  # the device may be gone already
                port.close()
