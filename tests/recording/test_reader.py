"""Files read back in their order: torn tails are borne, damage is told, nothing crashes."""

from __future__ import annotations

import itertools
import struct
import zlib
from pathlib import Path

import pytest
import zstandard
from all_topics import BLOCK, records
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_agent.messages import Record
from edge_agent.recording import reader, topics
from edge_agent.recording.reader import DamagedError
from edge_agent.recording.writer import SegmentWriter

WANTED = list(records(blocks=4, sensors=1))


def write(part: Path, wanted: list[Record], every: int = 10) -> Path:
    writer = SegmentWriter(part, metadata={"run": "r"}, attachments={"config.yaml": b"site: x", "a.dbc": b"VERSION"})
    for i, record in enumerate(wanted):
        writer.add(record)
        if i % every == 0:
            writer.flush()
    return writer.close()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("reader") / "a.mcap.part", WANTED)


def messages(path: Path) -> list[tuple[str, bytes]]:
    return [(s.topic, s.data) for s in reader.read_messages(path)]


EVERYTHING = [(r.topic, r.data) for r in WANTED]


def test_messages_come_in_the_order_of_the_file(path: Path) -> None:
    assert messages(path) == EVERYTHING
    only = [s.topic for s in reader.read_messages(path, {"/raw/can0", "/raw/gnss"})]
    assert only == ["/raw/can0", "/raw/gnss"] * 4


def test_what_the_index_of_a_file_says_is_what_a_walk_says(path: Path, tmp_path: Path) -> None:
    """Whole, torn, and with an index that lies or is cut."""
    newest = max(r.log_ns for r in WANTED)
    data = path.read_bytes()
    with reader.view(path) as buffer:
        chunks = [p for p in reader.parts(buffer) if p.opcode == reader.CHUNK]
        (footer,) = (p for p in reader.parts(buffer) if p.opcode == reader.FOOTER)
        (statistics,) = (p for p in reader.parts(buffer) if p.opcode == reader.STATISTICS)
    lying = bytearray(data)
    lying[statistics.pos + 34] ^= 0xFF  # the newest time; the index has a CRC
    for spoilt in (data, bytes(lying), data[: footer.pos], data[: chunks[-1].pos + chunks[-1].length], data + b"x"):
        one = tmp_path / "one.mcap"
        one.write_bytes(spoilt)
        assert reader.newest_ns(one) == newest
        assert reader.has_metadata(one, "edge_agent:run")
        assert not reader.has_metadata(one, "edge_agent:repaired")
    changed = bytearray(data)  # with its CRC made right: it is the index that is read
    changed[statistics.pos + 34 : statistics.pos + 42] = struct.pack("<Q", 77)
    (start,) = struct.unpack_from("<Q", data, footer.pos)
    struct.pack_into("<I", changed, footer.pos + 16, zlib.crc32(changed[start : footer.pos + 16]))
    one.write_bytes(changed)
    assert reader.newest_ns(one) == 77


def test_a_tally_counts_what_is_not_wanted_too(path: Path, tmp_path: Path) -> None:
    tally = reader.Tally()
    assert [s.topic for s in reader.read_messages(path, {"/raw/gnss"}, tally)] == ["/raw/gnss"] * 4
    times = [r.log_ns for r in WANTED]
    assert tally == reader.Tally(len(WANTED), min(times), max(times))
    spoilt = tmp_path / "spoilt.mcap"
    data = bytearray(path.read_bytes())
    with reader.view(path) as buffer:
        third = [reader.chunk_head(buffer, p) for p in reader.parts(buffer) if p.opcode == reader.CHUNK][2]
    data[third.pos + third.length // 2] ^= 1
    spoilt.write_bytes(data)
    tally = reader.Tally()
    with pytest.raises(DamagedError):
        list(reader.read_messages(spoilt, (), tally))
    assert tally.messages == 11  # of the two chunks before: one, then ten
    assert tally.end_ns == max(times[:11])


def test_a_walk_gives_back_what_it_has_passed(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader, "LET_GO", 100)
    assert messages(path) == EVERYTHING


def test_info_counts_what_is_there(path: Path) -> None:
    info = reader.info(path)
    assert (info.complete, info.damage, info.profile, info.library) == (True, "", "ros2", "edge-agent")
    assert info.messages == len(WANTED)
    assert info.start_ns == min(r.log_ns for r in WANTED)
    assert info.end_ns == max(r.log_ns for r in WANTED)
    assert info.size == path.stat().st_size
    can = info.topics["/raw/can0"]
    assert (can.schema, can.count, can.longest_ns) == (topics.CAN_FRAMES, 4, 100_000_000)
    assert can.last_ns - can.first_ns == 300_000_000
    assert can.size == sum(len(r.data) for r in WANTED if r.topic == "/raw/can0")
    assert info.schemas[topics.TICK] == topics.SCHEMAS[topics.TICK]
    assert info.metadata == {"edge_agent:run": {"run": "r"}}
    assert info.attachments == [("config.yaml", "application/yaml", 7), ("a.dbc", "text/plain", 7)]
    assert info.gaps == []
    assert (
        sum(len(topics.decode(s.schema, s.data)["can_id"]) for s in reader.read_messages(path, {"/raw/can0"}))
        == BLOCK * 4
    )


def test_info_tells_missing_raw_blocks(tmp_path: Path) -> None:
    less = [r for r in WANTED if r.topic != "/raw/gnss"]
    info = reader.info(write(tmp_path / "a.mcap.part", less))
    orders = [topics.raw_order(r.schema, r.data) for r in less if r.schema]
    jumps = [(a, b) for a, b in itertools.pairwise(orders) if b != a + 1]
    assert [(g.after, g.before) for g in info.gaps] == jumps
    assert len(jumps) == 3


def test_every_cut_gives_the_messages_of_the_whole_chunks(tmp_path: Path) -> None:
    wanted = [r for r in WANTED if r.topic in ("/raw/checkpoint", "/rosout", "/raw/gnss")]
    data = write(tmp_path / "a.mcap.part", wanted, every=2).read_bytes()
    ends, seen = [], 0
    for part in reader.parts(data):
        if part.opcode == reader.CHUNK:
            inner = reader.chunk_data(data, reader.chunk_head(data, part))
            seen += sum(p.opcode == reader.MESSAGE for p in reader.parts(inner, 0))
            ends.append((part.pos + part.length, seen))
    assert len(ends) == 4
    cut = tmp_path / "cut.mcap"
    for n in range(8, len(data)):
        cut.write_bytes(data[:n])
        whole = max((count for end, count in ends if end <= n), default=0)
        assert messages(cut) == [(r.topic, r.data) for r in wanted[:whole]], n


@pytest.mark.parametrize("zeros", [1, 100, 5000])
def test_unwritten_space_behind_a_cut_is_a_tail(path: Path, tmp_path: Path, zeros: int) -> None:
    """A power cut leaves zeros where pages were not written: behind the last record, and inside the last chunk."""
    with reader.view(path) as buffer:
        chunks = [p for p in reader.parts(buffer) if p.opcode == reader.CHUNK]
    data = path.read_bytes()
    last = chunks[-1]
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: last.pos - 9] + bytes(zeros))
    before = messages(cut)
    assert 0 < len(before) < len(EVERYTHING)
    assert before == EVERYTHING[: len(before)]
    for behind in (0, zeros):
        cut.write_bytes(data[: last.pos + 100] + bytes(last.length - 100 + behind))
        assert messages(cut) == before


def test_damage_before_the_tail_is_told(path: Path, tmp_path: Path) -> None:
    with reader.view(path) as buffer:
        chunk = next(p for p in reader.parts(buffer) if p.opcode == reader.CHUNK)
    data = bytearray(path.read_bytes())
    data[chunk.pos + chunk.length - 20] ^= 1
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data)
    with pytest.raises(DamagedError, match="chunk at byte"):
        messages(bad)
    info = reader.info(bad)
    assert "chunk at byte" in info.damage
    assert info.complete


def test_an_attachment_is_checked(path: Path, tmp_path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[data.index(b"site: x")] ^= 1
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(data)
    with pytest.raises(DamagedError, match=r"config\.yaml"):
        reader.read_attachments(bad)
    assert "config.yaml" in reader.info(bad).damage


def test_a_lying_chunk_does_not_fill_the_memory(tmp_path: Path) -> None:
    """A chunk that claims gigabytes, in its head or in its packed data, is refused before anything is unpacked."""

    behind = struct.pack("<BQ", reader.MESSAGE_INDEX, 2) + b"xx"  # so the chunk is no torn tail

    def file(size: int, packed: bytes) -> Path:
        body = struct.pack("<QQQII", 0, 1, size, 0, 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
        out = tmp_path / f"{size}.mcap"
        out.write_bytes(reader.MAGIC + struct.pack("<BQ", reader.CHUNK, len(body)) + body + behind)
        return out

    packed = zstandard.ZstdCompressor().compress(bytes(300))
    claims_all = b"\x28\xb5\x2f\xfd\xe0" + b"\xff" * 8
    for path in (file(1 << 40, packed), file(299, packed), file(1 << 29, claims_all)):
        with pytest.raises(DamagedError):
            messages(path)


def test_other_writers_files_are_read_too(tmp_path: Path) -> None:
    """Uncompressed chunks, messages outside of chunks, channels without schema."""
    from mcap.writer import CompressionType, Writer

    for chunking in (True, False):
        out = tmp_path / f"{chunking}.mcap"
        with open(out, "wb") as stream:
            writer = Writer(stream, compression=CompressionType.NONE, use_chunking=chunking)
            writer.start()
            channel = writer.register_channel("/x", "json", 0)
            writer.add_message(channel, 5, b"{}", 4, 3)
            writer.finish()
        assert list(reader.read_messages(out)) == [reader.Stored("/x", "", 5, 4, 3, b"{}")]


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_flipped_bits_are_borne_or_told(
    path: Path, tmp_path_factory: pytest.TempPathFactory, draw: st.DataObject
) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(draw.draw(st.integers(1, 3))):
        data[draw.draw(st.integers(0, len(data) - 1))] ^= 1 << draw.draw(st.integers(0, 7))
    bad = tmp_path_factory.mktemp("flip") / "bad.mcap"
    bad.write_bytes(data)
    for read in (messages, reader.read_attachments, reader.read_metadata, reader.info):
        try:
            read(bad)
        except DamagedError:
            continue


def test_crc_is_the_one_of_the_format(path: Path) -> None:
    with reader.view(path) as buffer:
        part = next(p for p in reader.parts(buffer) if p.opcode == reader.CHUNK)
        head = reader.chunk_head(buffer, part)
        assert zlib.crc32(reader.chunk_data(buffer, head)) == head.crc != 0


def test_no_recording_at_all(tmp_path: Path) -> None:
    for name, data in (("empty", b""), ("text", b"hello, this is no recording")):
        (tmp_path / name).write_bytes(data)
        for read in (messages, reader.read_attachments, reader.read_metadata, reader.info):
            with pytest.raises(DamagedError, match="not an MCAP"):
                read(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        messages(tmp_path / "absent")
