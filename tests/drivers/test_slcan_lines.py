"""The text of an slcan adapter against python-can's writer of it, in any cut, with garbage between."""

from __future__ import annotations

import itertools
import random
from typing import Any

import can
import numpy as np
import pytest
from can.interfaces.slcan import slcanBus
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.slcan_lines import LONGEST, SlcanLines
from edge_agent.messages import CanFlag

Row = tuple[int, int, int, bytes]
"""identifier, flags, length, data"""


def text_of(message: can.Message) -> bytes:
    """As python-can would write it."""
    written: list[str] = []
    bus: Any = slcanBus.__new__(slcanBus)
    bus.serialPortOrig = type("Port", (), {"write_timeout": None})()
    bus._write = written.append
    bus.send(message)
    bus._is_shutdown = True  # nothing to close
    return written[0].encode() + b"\r"


@st.composite
def messages(draw: st.DrawFn) -> can.Message:
    extended = draw(st.booleans())
    fd = draw(st.integers(0, 3)) == 0
    remote = not fd and draw(st.integers(0, 3)) == 0
    length = draw(st.sampled_from([0, 1, 5, 8, 12, 20, 48, 64])) if fd else draw(st.integers(0, 8))
    return can.Message(
        arbitration_id=draw(st.integers(0, 0x1FFFFFFF if extended else 0x7FF)),
        is_extended_id=extended,
        is_fd=fd,
        bitrate_switch=fd and draw(st.booleans()),
        is_remote_frame=remote,
        dlc=length,
        data=None if remote else draw(st.binary(min_size=length, max_size=length)),
    )


def row_of(m: can.Message) -> Row:
    flags = CanFlag(0)
    for bit, there in (
        (CanFlag.EXT, m.is_extended_id),
        (CanFlag.RTR, m.is_remote_frame),
        (CanFlag.FD, m.is_fd),
        (CanFlag.BRS, m.bitrate_switch),
    ):
        flags |= bit if there else CanFlag(0)
    return m.arbitration_id, int(flags), m.dlc, b"" if m.is_remote_frame else bytes(m.data)


def parse(data: bytes, places: list[int], lines: SlcanLines | None = None) -> tuple[list[Row], int]:
    """What comes of the bytes in pieces that end at `places`; and how much was malformed."""
    lines = lines or SlcanLines()
    rows: list[Row] = []
    edges = [0, *sorted(min(p, len(data)) for p in places), len(data)]
    for a, b in itertools.pairwise(edges):
        columns = lines.feed(data[a:b])
        if columns is None:
            continue
        can_id, flags, length, body, ends = columns
        assert [data[a:b][i] for i in ends.tolist()] == [b"\r"[0]] * ends.size or b"\a" in data
        assert (np.diff(ends) > 0).all()
        assert body.shape in ((can_id.size, 8), (can_id.size, 64))
        for i in range(can_id.size):
            used = 0 if flags[i] & CanFlag.RTR else int(length[i])
            assert not body[i, used:].any()
            rows.append((int(can_id[i]), int(flags[i]), int(length[i]), body[i, :used].tobytes()))
    return rows, lines.malformed


@settings(deadline=None, max_examples=150, derandomize=True)
@given(
    sent=st.lists(messages(), max_size=12),
    places=st.lists(st.integers(0, 800), max_size=20),
    lower=st.booleans(),
    stamp=st.booleans(),
)
def test_every_frame_of_python_can_in_any_cut(
    sent: list[can.Message], places: list[int], lower: bool, stamp: bool
) -> None:
    text = [text_of(m) for m in sent]
    if stamp:  # milliseconds of the adapter
        text = [t[:-1] + b"%04X\r" % (k * 4369 & 0xFFFF) for k, t in enumerate(text)]
    if lower:
        text = [t[:1] + t[1:].lower() for t in text]
    rows, malformed = parse(b"".join(text), places)
    assert rows == [row_of(m) for m in sent]
    assert malformed == 0


@settings(deadline=None, max_examples=150, derandomize=True)
@given(
    data=st.binary(max_size=600) | st.text("0123456789abtTVd\r", max_size=600).map(str.encode),
    places=st.lists(st.integers(0, 700), max_size=9),
)
def test_garbage_is_no_frame_and_what_follows_it_is(data: bytes, places: list[int]) -> None:
    """Whatever came before: the same in every cut, and the next good line is read."""
    good = b"\rT1ABCDEF03010203\r"
    whole, malformed = parse(data + good, [])
    assert parse(data + good, places) == (whole, malformed)
    assert whole[-1] == (0x1ABCDEF0, int(CanFlag.EXT), 3, b"\1\2\3")


@pytest.mark.parametrize(
    ("line", "frames", "malformed"),
    [
        (b"", 0, 0),
        (b"z", 0, 0),
        (b"V1013", 0, 0),
        (b"t", 0, 1),
        (b"t123", 0, 1),
        (b"t1230", 1, 0),
        (b"t8000", 0, 1),  # no 11-bit identifier
        (b"T200000000", 0, 1),  # no 29-bit identifier
        (b"t1239" + b"00" * 9, 0, 1),  # no length of a classic frame
        (b"t1232AAB", 0, 1),
        (b"t1232AABBC", 0, 1),
        (b"t1232AABB12345", 0, 1),
        (b"t123 2AABB", 0, 1),
        (b"t1232AG", 0, 1),
        (b"r1238", 1, 0),
        (b"r12380000", 1, 0),  # with a time stamp
        (b"\xff\xfft1231AA", 1, 1),
        (b"t1231At1231AA", 1, 1),  # a lost CR
        (b"D000000011AA", 1, 0),
        (b"hello", 0, 1),
        (b"t1230" + b"0" * 200, 0, 1),
    ],
)
def test_lines(line: bytes, frames: int, malformed: int) -> None:
    rows, bad = parse(line + b"\r", [])
    assert (len(rows), bad) == (frames, malformed)


def test_a_flood_without_an_end_takes_no_memory() -> None:
    lines = SlcanLines()
    for _ in range(50):
        assert lines.feed(b"0" * 1000) is None
    assert len(lines._rest) <= LONGEST + 1
    assert parse(b"\rt1230\r", [], lines)[0] == [(0x123, 0, 0, b"")]


def test_a_long_block_keeps_the_order_of_all_kinds() -> None:
    rng = random.Random(1)
    sent = [
        can.Message(arbitration_id=k, is_extended_id=rng.random() < 0.5, data=rng.randbytes(rng.randrange(9)))
        for k in range(2000)
    ]
    rows, _ = parse(b"".join(text_of(m) for m in sent), [rng.randrange(40_000) for _ in range(9)])
    assert rows == [row_of(m) for m in sent]
    assert np.array_equal([r[0] for r in rows], range(2000))
