"""What systemd is told (sd_notify): one datagram to the socket that it names. Without one, nothing."""

from __future__ import annotations

import socket
from contextlib import suppress


class Notifier:
    """Sends `READY=1`, `WATCHDOG=1`, `STATUS=...` to NOTIFY_SOCKET's address; None = not run by systemd."""

    def __init__(self, address: str | None) -> None:
        self._address = address
        if address and address.startswith("@"):  # abstract socket
            self._address = "\0" + address[1:]

    def send(self, *lines: str) -> None:
        """One message; a supervisor that cannot be reached, or does not read, is no reason to stop recording."""
        if not self._address:
            return
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as s:
            s.setblocking(False)
            s.sendto("\n".join(lines).encode(), self._address)
