"""The clock port: host wall time at every monotonic second, and whether the kernel calls it synchronised.

Wall time enters the agent only through these Ticks (and through the kernel's stamps that the CAN port converts at
once). The two clocks are read as a bracketed pair, monotonic - wall - monotonic, so that a thread switch in between
cannot pass for a clock step.

Synchronisation and error come from adjtimex(2) without privileges. Where the C library has none, or a sandbox forbids
it, a Tick says "not synchronised, error not known", which is the safe side.
"""

from __future__ import annotations

import ctypes
import time

from edge_agent.messages import PortSettings, S, Tick

MAX_WAIT_NS = S // 2
"""A read returns at least so often, so that a thread can be stopped."""
PAIR_TRIES = 5
PAIR_GOOD_NS = 20_000
"""A bracket no wider than this needs no second try; a quiet gateway core reads the three clocks within 5 us."""

TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised
STA_UNSYNC = 0x0040


class _Timex(ctypes.Structure):
    """struct timex of adjtimex(2) up to `status`, with room for all that may follow on any ABI."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_char * 512),
    )


def clock_pair() -> tuple[int, int]:
    """(monotonic ns, wall ns) of one instant: the narrowest of a few brackets, its middle as the monotonic time."""
    best = (1 << 62, 0, 0)
    for _ in range(PAIR_TRIES):
        before = time.monotonic_ns()
        wall = time.time_ns()
        width = time.monotonic_ns() - before
        if width < best[0]:
            best = (width, before + width // 2, wall)
        if width <= PAIR_GOOD_NS:
            break
    return best[1], best[2]


def sync_from(state: int, status: int, maxerror_us: int, esterror_us: int) -> tuple[bool, int]:
    """(synchronised, error in ns) from the return value and the fields of adjtimex.

    The error is the daemon's estimate; one that sets none (systemd-timesyncd) leaves 0 there, and the kernel's bound
    `maxerror`, which grows by 500 ppm since the last update, stands in.
    """
    if state < 0:
        return False, 0
    sync = state != TIME_ERROR and not status & STA_UNSYNC
    error_us = esterror_us if esterror_us > 0 else maxerror_us
    return sync, max(error_us, 0) * 1000


def kernel_sync() -> tuple[bool, int]:
    """`sync_from` of this host's kernel; (False, 0) where it cannot be asked."""
    try:
        call = ctypes.CDLL(None).adjtimex
    except (AttributeError, OSError, TypeError):  # another C library, or none to load from
        return False, 0
    timex = _Timex()  # modes 0: read only
    state = int(call(ctypes.byref(timex)))
    return sync_from(state, timex.status, timex.maxerror, timex.esterror)


class ClockPort:
    """Emits one `Tick` at each full second of the monotonic clock. It cannot fail and needs no device."""

    def __init__(self, settings: PortSettings) -> None:
        self.settings = settings
        self.counters: dict[str, int] = {"ticks": 0, "late": 0}
        self._next_ns = 0

    def open(self) -> None:
        """Start at the next full second."""
        self._next_ns = (time.monotonic_ns() // S + 1) * S

    def read(self) -> list[tuple[int, Tick]]:
        """Wait for the next full second and return [(monotonic ns, Tick)], or [] if it is more than 0.5 s away.

        After a stall the seconds that passed are not made up for; `late` counts them.
        """
        if not self._next_ns:
            self.open()
        now = time.monotonic_ns()
        if now < self._next_ns:
            time.sleep(min(self._next_ns - now, MAX_WAIT_NS) / S)
        if time.monotonic_ns() < self._next_ns:
            return []
        mono_ns, utc_ns = clock_pair()
        sync, error_ns = kernel_sync()
        following = (mono_ns // S + 1) * S
        self.counters["ticks"] += 1
        self.counters["late"] += (following - self._next_ns) // S - 1
        self._next_ns = following
        return [(mono_ns, Tick(utc_ns, sync, error_ns))]

    def close(self, silently: bool = False) -> None:
        """Nothing is held."""
