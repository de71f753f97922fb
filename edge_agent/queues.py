"""A queue bounded in bytes, between two threads. What does not fit is refused, never waited for."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class ByteQueue(Generic[T]):
    """Items with a size; `put` refuses above the limit that it is given, `take` hands over what waits, one by one.

    An item counts until the one who took it comes back for the next, so the bound holds for what is in hand too.
    Items put with a `source` are counted by it, for the ledger. One thread takes.
    """

    def __init__(self, limit_bytes: int) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self._items: deque[tuple[T, int, str]] = deque()
        self._ready = threading.Condition()
        self._closed = False
        self._wake = 0
        self._taken: Counter[str] = Counter()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: T, size: int, share: float = 1.0, source: str = "") -> bool:
        """Append unless the queue would then hold more than `share` of its limit; inf = always."""
        with self._ready:
            if self.bytes + size > share * self.limit_bytes:
                return False
            self._items.append((item, size, source))
            self.bytes += size
            if self.bytes >= self._wake:
                self._ready.notify()
            return True

    def close(self) -> None:
        """No more will come: `take` waits no longer."""
        with self._ready:
            self._closed = True
            self._ready.notify_all()

    @property
    def drained(self) -> bool:
        """Closed and empty."""
        return self._closed and not self._items

    def take(self, timeout_s: float, wake_bytes: int = 1) -> Iterator[T]:
        """What waits, as soon as `wake_bytes` wait, at the latest after `timeout_s`. Ends when all of that has been
        handed out; who stops before finds the rest at the next call."""
        with self._ready:
            self._wake = wake_bytes
            if self.bytes < wake_bytes and not self._closed:
                self._ready.wait(timeout_s)
            waiting = len(self._items)
        for _ in range(waiting):
            with self._ready:
                item, size, source = self._items.popleft()
                if source:
                    self._taken[source] += 1
            try:
                yield item
            finally:
                with self._ready:
                    self.bytes -= size

    def account(self) -> tuple[Counter[str], Counter[str]]:
        """Items by source: those that wait, counted one by one, and how many were ever taken; both of one moment."""
        with self._ready:
            return Counter(source for _, _, source in self._items if source), Counter(self._taken)
