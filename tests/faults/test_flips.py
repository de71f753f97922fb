"""Some rounds of what flips.py does ten thousand times, and the flips that once took intact chunks away."""

from __future__ import annotations

import os
import random
from pathlib import Path

import flips
import pytest

from edge_agent.recording import repair


@pytest.fixture(autouse=True)
def no_waiting_for_the_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands of repairs; that they reach the disk is tried elsewhere."""
    monkeypatch.setattr(os, "fsync", lambda fd: None)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return flips.sample(tmp_path_factory.mktemp("whole"))


def test_flipped_bits_cost_no_intact_chunk(whole: bytes, tmp_path: Path) -> None:
    parsed = flips.chunks(whole)
    rng = random.Random(4)
    done = {flips.flip_once(whole, parsed, rng, tmp_path) for _ in range(250)}
    assert done >= {"cut", "copied"}


@pytest.mark.parametrize("opcode", [7, 1])
@pytest.mark.parametrize("thorough", [False, True])
def test_each_bit_of_message_indexes_and_of_the_header(
    whole: bytes, tmp_path: Path, opcode: int, thorough: bool
) -> None:
    """A wrong channel in an index, a wrong length of the header: the chunks are as good as before."""
    wanted = [m for chunk in flips.chunks(whole) for m in chunk.messages]
    ranges = [(a, b) for op, a, b in flips.records(whole, flips.MAGIC_BYTES) if op == opcode]
    head = ranges[0][0], min(ranges[0][1], ranges[0][0] + 31)
    for at in range(*head):
        for bit in range(0, 8, 3):
            data = bytearray(whole)
            data[at] ^= 1 << bit
            (tmp_path / "a.mcap.part").write_bytes(data)
            (done,) = repair.recover(tmp_path, thorough)
            assert done.messages == len(wanted), (at, bit, done)
            for path in tmp_path.iterdir():
                path.unlink()
