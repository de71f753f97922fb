"""How this process asks the C library for memory. Another C library than glibc: nothing happens."""

from __future__ import annotations

import ctypes
import sys
from contextlib import suppress

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # of malloc.h
HELD, NAMES = 1 << 13, 5 << 14  # enough to make the table of interned strings grow, and to touch all of it


def steady_memory(large: int = 256 << 10) -> None:
    """Tell glibc's malloc to keep one arena and to give blocks of `large` bytes and more back at once. By default each
    thread has an arena, which grows to what the hungriest of all threads that ever used it needed (7 MiB in 18 hours of
    a soak in which readers were replaced), and blocks of the size of a chunk move into the heap for good. The
    interpreter's lock leaves threads nothing to gain from arenas."""
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(M_ARENA_MAX, 1)
        mallopt(M_MMAP_THRESHOLD, large)
        mallopt(M_TRIM_THRESHOLD, large // 2)


def grow_names() -> None:
    """Let the interpreter's table of interned strings grow now instead of some hours later, by 1 MiB. Pathlib interns
    each part of each path and forgets it, which uses the table's entries up; it is then made anew, with three times the
    entries that are in use. Costs 40 ms."""
    held = [sys.intern(f"held {n}") for n in range(HELD)]
    for n in range(NAMES):
        sys.intern(f"name {n}")
    held.clear()


def give_back() -> None:
    """Return the heap's free pages to the system. What one busy moment left between longer-lived blocks stays resident
    for good otherwise (0.8 of 2.6 MiB that 72 hours of a soak grew by)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
