"""A queue bounded in bytes, between two threads. What does not fit is refused, never waited for."""

from __future__ import annotations

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class ByteQueue(Generic[T]):
    """Items with a size; `put` refuses above the limit that it is given, `take` hands over everything at once."""

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self._items: deque[tuple[T, int]] = deque()
        self._ready = threading.Condition()
        self._closed = False
        self._wake = 0

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: T, size: int, share: float = 1.0) -> bool:
        """Append unless the queue would then hold more than `share` of its limit; inf = always."""
        with self._ready:
            if self.bytes + size > share * self.limit_bytes:
                return False
            self._items.append((item, size))
            self.bytes += size
            if self.bytes >= self._wake:
                self._ready.notify()
            return True

    def close(self) -> None:
        """No more will come: `take` returns at once from now on."""
        with self._ready:
            self._closed = True
            self._ready.notify_all()

    @property
    def drained(self) -> bool:
        """Closed and empty."""
        return self._closed and not self._items

    def take(self, timeout_s: float, wake_bytes: int = 1) -> list[T]:
        """Everything that waits, as soon as `wake_bytes` wait, at the latest after `timeout_s`."""
        with self._ready:
            self._wake = wake_bytes
            if self.bytes < wake_bytes and not self._closed:
                self._ready.wait(timeout_s)
            items = [item for item, _ in self._items]
            self._items.clear()
            self.bytes = 0
            return items
