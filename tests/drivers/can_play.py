"""Frames for the accelerometer codec, by hand, and what comes of them."""

from __future__ import annotations

import dataclasses
import itertools
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from drivers.dbc_codec import AccelCodec
from edge_agent.messages import AccelBlock, AccelerometerSettings, CanFrames, Event, Reject, S, SignalField

T0 = 1000 * S

# x, y, z as int16 in milli-g, an 8-bit counter behind them
TRIPLE = tuple(SignalField(0x188, 16 * k, 16, scale=0.001) for k in range(3))
COUNTER = SignalField(0x188, 48, 8, signed=False)
# one axis per message, sent z (0x30), x (0x31), y (0x32); each with a 4-bit counter behind it
SPLIT = tuple(SignalField(i, 0, 16, scale=0.001) for i in (0x31, 0x32, 0x30))


@dataclasses.dataclass
class Frame:
    t_ns: int
    can_id: int
    data: bytes
    flags: int = 0


def frames(rows: Sequence[Frame], dropped: int = 0) -> CanFrames:
    width = 64 if any(len(r.data) > 8 for r in rows) else 8
    return CanFrames(
        np.array([r.t_ns for r in rows], np.int64),
        np.array([r.can_id for r in rows], np.uint32),
        np.array([r.flags for r in rows], np.uint8),
        np.array([len(r.data) for r in rows], np.uint8),
        np.frombuffer(b"".join(r.data.ljust(width, b"\0") for r in rows), np.uint8).reshape(-1, width),
        dropped,
    )


def triple(t_ns: int, xyz: tuple[int, int, int], counter: int = 0) -> Frame:
    return Frame(t_ns, 0x188, struct.pack("<3hB", *xyz, counter))


def accel(**changes: Any) -> AccelerometerSettings:
    return AccelerometerSettings(**({"name": "imu", "port": "can", "unit": "g", "fields": TRIPLE} | changes))


def balance(codec: AccelCodec) -> bool:
    """Every candidate has gone somewhere."""
    c = codec.counters
    return c["frames"] == c["accepted"] + c["duplicates"] + c["rejected"] + c["pending"]


def run(codec: AccelCodec, blocks: Sequence[CanFrames]) -> tuple[AccelBlock, list[Reject | Event]]:
    """All blocks through the codec, its samples as one block."""
    got: list[AccelBlock] = []
    notes: list[Reject | Event] = []
    for block in blocks:
        samples, more = codec.feed(block)
        notes += more
        if samples is not None:
            assert samples.t_ns.size
            got.append(samples)
        assert balance(codec)
    return AccelBlock(
        codec.settings.name,
        np.concatenate([b.t_ns for b in got] or [np.empty(0, np.int64)]),
        np.concatenate([b.xyz for b in got] or [np.empty((0, 3))]),
        np.concatenate([b.flags for b in got] or [np.empty(0, np.uint8)]),
        np.concatenate([b.count for b in got] or [np.empty(0, np.int64)]),
        any(b.drain_stamped for b in got),
    ), notes


def reasons(notes: Sequence[Reject | Event]) -> list[tuple[str, int]]:
    return [(n.reason, n.count) for n in notes if isinstance(n, Reject)]


def cut(block: CanFrames, places: Sequence[int]) -> list[CanFrames]:
    """The same frames in blocks that end at `places`."""
    edges = [0, *sorted(places), block.t_ns.size]
    return [
        CanFrames(block.t_ns[a:b], block.can_id[a:b], block.flags[a:b], block.length[a:b], block.data[a:b])
        for a, b in itertools.pairwise(edges)
    ]
