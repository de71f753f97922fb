"""One file: every hazard of the library is refused before it is called, and the file stays good."""

from __future__ import annotations

import errno
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from all_topics import BLOCK, RATE_HZ, checkpoint, records
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from edge_agent.messages import Record
from edge_agent.recording import reader, topics
from edge_agent.recording.writer import CHUNK_BYTES, SegmentWriter

T = 1_700_000_000 * 10**9
GOOD = topics.log(20, "n", "m", T)


def rosout(log_ns: Any = T, publish_ns: Any = T, data: Any = GOOD, topic: str = "/rosout", schema: str = "") -> Record:
    return Record(topic, log_ns, publish_ns, data, False, schema)


def start(path: Path, **more: Any) -> SegmentWriter:
    return SegmentWriter(path, **{"metadata": {"run": "r"}, "attachments": {"config.yaml": b"site: x\n"}, **more})


def test_what_is_written_comes_back_in_order_and_indexed(tmp_path: Path) -> None:
    wanted = list(records())
    writer = start(tmp_path / "a.mcap.part", utc_ns=T)
    for record in wanted:
        writer.add(record)
    final = writer.close()
    assert final == tmp_path / "a.mcap"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
    assert writer.sha256 == hashlib.sha256(final.read_bytes()).hexdigest()
    assert writer.size == final.stat().st_size
    found = list(reader.read_messages(final))
    assert [(s.topic, s.log_ns, s.publish_ns, s.data) for s in found] == [
        (r.topic, r.log_ns, r.publish_ns, r.data) for r in wanted
    ]
    assert [s.schema for s in found] == [r.schema or topics.schema_of(r.topic) for r in wanted]
    for topic in {s.topic for s in found}:
        sequences = [s.sequence for s in found if s.topic == topic]
        assert sequences == list(range(1, len(sequences) + 1))
    with open(final, "rb") as file:  # mcap's own reader, through the index
        indexed = make_reader(file, validate_crcs=True)
        assert {m.data for _, _, m in indexed.iter_messages()} == {r.data for r in wanted}
        summary = indexed.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(wanted)
        assert [(a.name, a.media_type, a.data, a.log_time) for a in indexed.iter_attachments()] == [
            ("config.yaml", "application/yaml", b"site: x\n", T)
        ]
        assert [(m.name, m.metadata) for m in indexed.iter_metadata()] == [("edge_agent:run", {"run": "r"})]


@pytest.mark.parametrize(
    ("bad", "error"),
    [
        (rosout(log_ns=float(T)), TypeError),
        (rosout(publish_ns=1.5), TypeError),
        (rosout(log_ns=np.float64(T)), TypeError),
        (rosout(log_ns=-1), ValueError),
        (rosout(publish_ns=-1), ValueError),
        (rosout(log_ns=1 << 63), ValueError),
        (rosout(log_ns=None), TypeError),
        (rosout(data="text"), TypeError),
        (rosout(data=bytearray(b"x")), TypeError),
        (rosout(topic="/unknown"), ValueError),
        (rosout(topic="rosout", schema=topics.LOG), ValueError),
        (rosout(topic="/raw/gnss"), ValueError),
        (rosout(schema="edge_agent_msgs/msg/Nothing"), ValueError),
    ],
)
def test_hazards_are_refused_and_leave_the_open_chunk_whole(
    tmp_path: Path, bad: Record, error: type[Exception]
) -> None:
    writer = start(tmp_path / "a.mcap.part")
    writer.add(rosout())
    with pytest.raises(error):
        writer.add(bad)
    writer.add(rosout(log_ns=np.int64(T + 1), publish_ns=np.int64(T)))
    found = list(reader.read_messages(writer.close()))
    assert [(s.log_ns, s.sequence) for s in found] == [(T, 1), (T + 1, 2)]


def test_a_topic_keeps_its_schema(tmp_path: Path) -> None:
    writer = start(tmp_path / "a.mcap.part")
    writer.add(rosout(topic="/raw/x", schema=topics.RAW_BYTES))
    writer.add(rosout(topic="/rosout", schema=topics.LOG))
    writer.add(rosout(topic="/rosout"))  # named or implied, the same
    with pytest.raises(ValueError, match="another schema"):
        writer.add(rosout(topic="/raw/x", schema=topics.CAN_FRAMES))
    found = list(reader.read_messages(writer.close()))
    assert [(s.topic, s.sequence) for s in found] == [("/raw/x", 1), ("/rosout", 1), ("/rosout", 2)]


def test_sequences_wrap_at_32_bits(tmp_path: Path) -> None:
    writer = start(tmp_path / "a.mcap.part")
    writer.add(rosout())
    writer._sequences[1] = 0xFFFFFFFE  # 4 thousand million messages later
    for _ in range(3):
        writer.add(rosout())
    assert [s.sequence for s in reader.read_messages(writer.close())] == [1, 0xFFFFFFFF, 0, 1]


@pytest.mark.parametrize(
    "more",
    [{"metadata": {"a": 1}}, {"metadata": {2: "b"}}, {"attachments": {"a": "text"}}, {"attachments": {1: b""}}],
)
def test_a_head_of_wrong_types_makes_no_file(tmp_path: Path, more: dict[str, Any]) -> None:
    with pytest.raises(TypeError):
        start(tmp_path / "a.mcap.part", **more)
    assert list(tmp_path.iterdir()) == []


def test_no_file_is_ever_written_over(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"keep")
    with pytest.raises(FileExistsError):
        start(tmp_path / "a.mcap.part")
    (tmp_path / "b.mcap.part").write_bytes(b"keep")
    with pytest.raises(FileExistsError):
        start(tmp_path / "b.mcap.part")
    writer = start(tmp_path / "c.mcap.part")
    (tmp_path / "c.mcap").write_bytes(b"keep")
    with pytest.raises(FileExistsError):
        writer.close()
    assert {p.name for p in tmp_path.iterdir() if p.read_bytes() == b"keep"} == {"a.mcap", "b.mcap.part", "c.mcap"}


def test_head_is_in_the_file_at_once_and_flush_makes_messages_readable(tmp_path: Path) -> None:
    part = tmp_path / "a.mcap.part"
    writer = start(part)
    assert reader.read_metadata(part) == {"edge_agent:run": {"run": "r"}}
    assert reader.read_attachments(part) == [("config.yaml", "application/yaml", b"site: x\n")]
    writer.add(checkpoint(T + 10**9))
    assert list(reader.read_messages(part)) == []
    assert len(writer.pending) == 1
    writer.flush()
    assert [s.topic for s in reader.read_messages(part)] == ["/raw/checkpoint"]
    assert writer.pending == ()
    assert writer.size == part.stat().st_size
    writer.close()


def test_a_full_chunk_is_written_without_a_flush(tmp_path: Path) -> None:
    writer = start(tmp_path / "a.mcap.part")
    rng = np.random.default_rng(1)
    while len(writer.pending) == len(list(reader.read_messages(writer.path))) == 0 or writer.pending:
        writer.add(rosout(topic="/raw/x", schema=topics.RAW_BYTES, data=b"\0\1\0\0" + rng.bytes(CHUNK_BYTES // 4)))
    assert len(list(reader.read_messages(writer.path))) == 4
    writer.close()


def _disk_full(writer: SegmentWriter, after: int) -> Callable[[bytes], int]:
    real = writer._file.file.write

    def write(data: bytes) -> int:
        if writer._file.size + len(data) > after:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(data)

    return write


def test_an_error_of_the_disk_comes_out_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = start(tmp_path / "a.mcap.part")
    writer.add(rosout())
    writer.flush()
    monkeypatch.setattr(writer._file, "write", _disk_full(writer, writer.size + 10))
    writer.add(rosout())
    with pytest.raises(OSError, match="No space"):
        writer.flush()
    assert len(writer.pending) == 1  # what is in no file
    writer.abandon()
    assert len(list(reader.read_messages(writer.path))) == 1


@settings(max_examples=30, deadline=None)
@given(st.lists(st.sampled_from(list(records(blocks=2))), max_size=30), st.sets(st.integers(0, 30)))
def test_any_flushes_give_the_same_messages(tmp_path_factory: Any, chosen: list[Record], flushes: set[int]) -> None:
    folder = tmp_path_factory.mktemp("w")
    writer = start(folder / "a.mcap.part")
    for i, record in enumerate(chosen):
        writer.add(record)
        if i in flushes:
            writer.flush()
    found = reader.read_messages(writer.close())
    assert [(s.topic, s.data) for s in found] == [(r.topic, r.data) for r in chosen]


def test_size_stays_within_the_budget_of_a_station(tmp_path: Path) -> None:
    """Eight accelerometers on one bus with stamps that jitter by 10 us, eight points, one receiver at 10 Hz, flushed
    every second: raw CAN in the file costs no more than 5.8 bytes a frame, everything no more than 48."""

    def cost(name: str, keep: Callable[[Record], bool]) -> float:
        writer = SegmentWriter(tmp_path / name, metadata={}, attachments={})
        kept = [r for r in records(blocks=50, sensors=8) if keep(r)]
        writer.add(kept[0])
        writer.flush()
        head, frames = writer.size, 0
        for record in kept[1:]:
            writer.add(record)
            if record.schema == topics.CAN_FRAMES:
                frames += 8 * BLOCK
                if frames % (8 * RATE_HZ) == 0:
                    writer.flush()
        writer.flush()
        size = writer.size
        writer.close()
        return (size - head) / frames

    assert cost("can.mcap.part", lambda r: r.schema in (topics.CAN_FRAMES, topics.CHECKPOINT)) <= 5.8
    assert cost("all.mcap.part", lambda r: "/accel/" not in r.topic or not r.topic.endswith("/block")) <= 48.0
