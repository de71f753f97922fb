"""Flips bits in a recording and repairs it: `python tests/faults/flips.py [N] [SEED]`, 10 000 by default.

Each round takes a small file as a kill or a close left it, flips one to three bits anywhere, cuts it at times, and lets
repair loose on it. It must not raise, must delete nothing, and must keep every message of every chunk that still is as
it was written and whose channels are known from one that is. What that is, this file knows by a walk of its own over
the undamaged file; the result is read back by the library mcap with all CRCs checked. `make test` runs some rounds.
"""

from __future__ import annotations

import random
import struct
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.reader import make_reader

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "recording"))

from all_topics import checkpoint

from edge_agent.messages import Record
from edge_agent.recording import repair, topics
from edge_agent.recording.writer import SegmentWriter

T = 1_700_000_001 * 10**9
MAGIC_BYTES = 8


class Chunk(NamedTuple):
    """A chunk of the undamaged file: where its record lies, what it says, which channels it needs and defines."""

    begin: int
    end: int
    messages: tuple[bytes, ...]
    needs: frozenset[int]
    defines: frozenset[int]


def sample(folder: Path) -> bytes:
    """A closed recording of a few kB: two schemas, five chunks, an attachment."""
    writer = SegmentWriter(folder / "sample.mcap", metadata={"run": "r"}, attachments={"c.yaml": b"site: x\n" * 9})
    writer.add(checkpoint(T, state=b"s" * 40))
    writer.flush()
    for i in range(40):
        writer.add(Record("/rosout", T + i, T, topics.log(20, "n", f"line {i}", T), False))
        if i % 10 == 9:
            writer.flush()
    return writer.close().read_bytes()


def records(data: bytes, pos: int) -> Iterator[tuple[int, int, int]]:
    """(opcode, begin of the record, end), by the specification: one byte, a length of eight, the content."""
    while pos + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, pos)
        yield opcode, pos, pos + 9 + length
        pos += 9 + length
        if opcode == 2:
            return


def chunks(data: bytes) -> list[Chunk]:
    found = []
    for opcode, begin, end in records(data, MAGIC_BYTES):
        if opcode != 6:
            continue
        (name,) = struct.unpack_from("<I", data, begin + 9 + 28)
        packed = data[begin + 9 + 32 + name + 8 : end]
        (crc,) = struct.unpack_from("<I", data, begin + 9 + 24)
        inside = zstandard.decompress(packed)
        assert zlib.crc32(inside) == crc
        messages, needs, defines = [], set(), set()
        for op, a, b in records(inside, 0):
            (number,) = struct.unpack_from("<H", inside, a + 9)
            if op == 5:
                messages.append(inside[a + 9 + 22 : b])
                needs.add(number)
            elif op == 4:
                defines.add(number)
        found.append(Chunk(begin, end, tuple(messages), frozenset(needs), frozenset(defines)))
    return found


def expected(whole: list[Chunk], touched: list[int], size: int) -> list[bytes]:
    """Messages of the chunks that no flip touched and no cut reached, as far as their channels are known."""
    out: list[bytes] = []
    known: set[int] = set()
    for chunk in whole:
        if chunk.end > size or any(chunk.begin <= at < chunk.end for at in touched):
            continue
        known |= chunk.defines
        if chunk.needs <= known:
            out += chunk.messages
    return out


def flip_once(whole: bytes, parsed: list[Chunk], rng: random.Random, folder: Path) -> str:
    """One round in an empty folder, left empty. What repair did; AssertionError where it did wrong."""
    touched = [rng.randrange(len(whole)) for _ in range(rng.randint(1, 3))]
    data = bytearray(whole)
    for at in touched:
        data[at] ^= 1 << rng.randrange(8)
    size = len(whole) if rng.random() < 0.5 else rng.randrange(len(whole) + 1)
    data = data[:size]
    return judge(whole, parsed, bytes(data), folder, rng.random() < 0.5)


def judge(whole: bytes, parsed: list[Chunk], data: bytes, folder: Path, thorough: bool) -> str:
    """Repair `data`, a spoilt beginning of `whole`, and hold the result against what was whole in it."""
    size = len(data)
    touched = [at for at in range(size) if data[at] != whole[at]]
    part = folder / "a.mcap.part"
    part.write_bytes(data)
    (done,) = repair.recover(folder, thorough)
    case = f"flips at {touched}, {size} of {len(whole)} bytes: {done.what}"
    left = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert done.path.name == "a.mcap", case
    with done.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        found = [m.data for _, _, m in reader.iter_messages(log_time_order=False)]
    assert summary is not None, case
    assert summary.statistics is not None, case
    assert summary.statistics.message_count == len(found) == done.messages, case
    wanted = expected(parsed, touched, size)
    assert not Counter(wanted) - Counter(found), f"{case}; intact messages are gone"
    assert not Counter(found) - Counter(m for chunk in parsed for m in chunk.messages), f"{case}; damage got through"
    match done.what:
        case "complete":
            assert left == {"a.mcap": data}, case
        case "cut":  # nothing whole is taken away: what stood up to the last whole chunk still stands
            keep = max((c.end for c in parsed if c.end <= size and c.messages[0] in found), default=0)
            assert left.keys() == {"a.mcap"}, case
            assert left["a.mcap"][:keep] == data[:keep], case
        case "copied":
            assert left.keys() == {"a.mcap", "a.mcap.damaged"}, case
            assert left["a.mcap.damaged"] == data, case
        case what:
            raise AssertionError(f"{case}; repair says {what}")
    for path in folder.iterdir():
        path.unlink()
    return done.what


def main(argv: list[str]) -> int:
    count, seed = (int(x) for x in (*argv, *("10000", "1")[len(argv) :]))
    rng = random.Random(seed)
    shm = Path("/dev/shm")  # thousands of fsyncs are not what is tried here
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as name:
        folder = Path(name)
        whole = sample(folder)
        (folder / "sample.mcap").unlink()
        parsed = chunks(whole)
        done: Counter[str] = Counter()
        slowest, begin = 0.0, time.monotonic()
        for _ in range(count):
            t = time.monotonic()
            done[flip_once(whole, parsed, rng, folder)] += 1
            slowest = max(slowest, time.monotonic() - t)
        every = 0
        for at in range(len(whole) if count >= 10_000 else 0):  # and each bit of the file once, by itself
            for bit in range(8):
                every += 1
                data = whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :]
                judge(whole, parsed, data, folder, bool(at & 1))
    said = ", ".join(f"{n} {what}" for what, n in sorted(done.items()))
    print(f"{count} rounds on {len(whole)} bytes with {len(parsed)} chunks: {said}")
    print(f"each of {every} bits flipped by itself" if every else "each bit by itself: only from 10000 rounds on")
    print(f"no crash, nothing deleted, every intact chunk kept; slowest {slowest * 1e3:.0f} ms", end="")
    print(f", {time.monotonic() - begin:.0f} s in all")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
