"""The bound is in bytes, and what does not fit is refused."""

from __future__ import annotations

import threading

from edge_agent.queues import ByteQueue


def test_bound_share_and_order() -> None:
    q: ByteQueue[int] = ByteQueue(100)
    assert q.put(1, 60)
    assert not q.put(2, 20, share=0.75)  # derived: only below 75
    assert q.put(3, 40)
    assert not q.put(4, 1)
    assert q.put(5, 50, share=float("inf"))
    assert q.take(0.0) == [1, 3, 5]
    assert q.bytes == 0
    assert q.put(6, 100)


def test_take_wakes_for_enough_and_for_close() -> None:
    q: ByteQueue[int] = ByteQueue(100)
    got: list[list[int]] = []
    reader = threading.Thread(target=lambda: got.append(q.take(30.0, wake_bytes=50)))
    reader.start()
    q.put(1, 10)
    q.put(2, 60)
    reader.join(timeout=30)
    assert [x for items in got for x in items] + q.take(0.0) == [1, 2]
    other = threading.Thread(target=lambda: got.append(q.take(30.0)))
    other.start()
    q.close()
    other.join(timeout=30)
    assert not other.is_alive()
    assert q.drained
