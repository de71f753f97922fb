"""The bound is in bytes, and what does not fit is refused."""

from __future__ import annotations

import threading

from live import PATIENCE_S

from edge_agent.queues import ByteQueue


def test_bound_share_and_order() -> None:
    q: ByteQueue[int] = ByteQueue(100)
    assert q.put(1, 60)
    assert not q.put(2, 20, share=0.75)  # derived: only below 75
    assert q.put(3, 40)
    assert not q.put(4, 1)
    assert q.put(5, 50, share=float("inf"))
    assert list(q.take(0.0)) == [1, 3, 5]
    assert q.bytes == 0
    assert q.put(6, 100)


def test_take_wakes_for_enough_and_for_close() -> None:
    q: ByteQueue[int] = ByteQueue(100)
    got: list[list[int]] = []
    never = 1e6  # s: who is not woken is found waiting
    reader = threading.Thread(target=lambda: got.append(list(q.take(never, wake_bytes=50))), daemon=True)
    reader.start()
    q.put(1, 10)
    q.put(2, 60)
    reader.join(PATIENCE_S)
    assert not reader.is_alive()
    assert [x for items in got for x in items] + list(q.take(0.0)) == [1, 2]
    other = threading.Thread(target=lambda: got.append(list(q.take(never))), daemon=True)
    other.start()
    q.close()
    other.join(PATIENCE_S)
    assert not other.is_alive()
    assert q.drained


def test_what_is_in_hand_counts_until_it_is_done() -> None:
    q: ByteQueue[int] = ByteQueue(100)
    for i in range(5):
        assert q.put(i, 20, 1.0, "even" if i % 2 == 0 else "odd")
    assert q.account() == ({"even": 3, "odd": 2}, {})
    took, filled = [], []
    for item in q.take(0.0):
        took.append(item)
        filled.append(q.bytes)
        assert q.put(10 + item, 20) == (item > 0)  # room for one more only when the one before is done
        if item == 2:
            break
    assert took == [0, 1, 2]
    assert filled == [100, 80, 80]
    assert q.bytes == 80  # 3, 4 and the two new ones
    assert q.account() == ({"even": 1, "odd": 1}, {"even": 2, "odd": 1})
    assert list(q.take(0.0)) == [3, 4, 11, 12]
    assert (q.bytes, len(q)) == (0, 0)
