"""Torn and damaged files: every whole chunk survives, every reader opens the result, no file is ever deleted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from all_topics import checkpoint, records
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.rosbag2.storage_mcap import McapReader

from edge_agent.messages import Record
from edge_agent.recording import reader, repair, topics
from edge_agent.recording.writer import SegmentWriter

T = 1_700_000_001 * 10**9


def small() -> list[Record]:
    """Two schemas and three chunks in a few kB."""
    lines = [topics.log(20, "n", f"line {i}", T) for i in range(9)]
    return [checkpoint(T, state=b"s" * 20), *(Record("/rosout", T + i, T, line, False) for i, line in enumerate(lines))]


def write(part: Path, wanted: list[Record], flush_at: tuple[int, ...]) -> Path:
    writer = SegmentWriter(part, metadata={"run": "r"}, attachments={"c.yaml": b"site: x"})
    for i, record in enumerate(wanted):
        writer.add(record)
        if i in flush_at:
            writer.flush()
    return writer.close()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return write(tmp_path_factory.mktemp("w") / "a.mcap.part", small(), (0, 4)).read_bytes()


def chunks(data: bytes) -> list[tuple[int, int, int]]:
    """Begin, end and number of messages of each chunk."""
    found = []
    for part in reader.parts(data):
        if part.opcode == reader.CHUNK:
            inner = reader.chunk_data(data, reader.chunk_head(data, part))
            count = sum(p.opcode == reader.MESSAGE for p in reader.parts(inner, 0))
            found.append((part.pos - 9, part.pos + part.length, count))
    return found


def payloads_by_mcap(path: Path) -> list[bytes]:
    """Through mcap's indexed reader, CRCs checked, its statistics and message indexes believed."""
    with open(path, "rb") as file:
        indexed = make_reader(file, validate_crcs=True)
        summary = indexed.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = [message.data for _, _, message in indexed.iter_messages()]
        assert summary.statistics.message_count == len(found)
        assert summary.statistics.chunk_count == len(summary.chunk_indexes)
        for _, channel, _ in indexed.iter_messages(topics=[c.topic for c in summary.channels.values()]):
            assert channel.topic
        assert len(list(indexed.iter_attachments())) == summary.statistics.attachment_count
        assert len(list(indexed.iter_metadata())) == summary.statistics.metadata_count
        return found


def payloads_by_rosbags(path: Path) -> list[bytes]:
    bag = McapReader(path)
    bag.open()
    try:
        return [data for _, _, data in bag.messages(bag.connections)]
    finally:
        bag.close()


@pytest.mark.parametrize("odd", [0, 1])
def test_every_cut_is_made_readable_with_all_whole_chunks(
    whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, odd: int
) -> None:
    monkeypatch.setattr(os, "fsync", lambda fd: None)  # thousands of them
    wanted = [r.data for r in small()]
    ends = chunks(whole)
    part, final = tmp_path / "a.mcap.part", tmp_path / "a.mcap"
    for n in range(odd, len(whole) + 1, 2):
        part.write_bytes(whole[:n])
        (done,) = repair.recover(tmp_path)
        assert (done.path, done.what) == (final, "complete" if n == len(whole) else "cut")
        expected = wanted[: sum(count for _, end, count in ends if end <= n)]
        assert done.messages == len(expected)
        assert payloads_by_mcap(final) == expected, n
        assert sorted(payloads_by_rosbags(final)) == sorted(expected), n
        if done.what == "cut":
            assert int(reader.read_metadata(final)[repair.REPAIRED_METADATA]["lost_bytes"]) == done.lost_bytes
        assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]
        assert repair.recover(tmp_path) == []
        final.unlink()


@pytest.mark.parametrize("zeros", [1, 8, 9, 40, 5000])
def test_unwritten_space_is_cut_off(whole: bytes, tmp_path: Path, zeros: int) -> None:
    """After a power cut the file has its length but not all of its pages."""
    wanted = [r.data for r in small()]
    for i, (begin, end, _) in enumerate(chunks(whole)):
        for at, expected in ((end, i + 1), (begin + 60, i)):
            (tmp_path / "a.mcap.part").write_bytes(whole[:at] + bytes(zeros))
            (done,) = repair.recover(tmp_path)
            assert done.what == "cut"
            want = wanted[: sum(count for _, _, count in chunks(whole)[:expected])]
            assert payloads_by_mcap(done.path) == want
            done.path.unlink()


def test_repair_begun_anew_gives_the_same(whole: bytes, tmp_path: Path) -> None:
    """A repair that was itself cut off at any point of what it appends is done again."""
    (tmp_path / "a.mcap.part").write_bytes(whole[: chunks(whole)[1][1] + 10])
    (done,) = repair.recover(tmp_path)
    good = done.path.read_bytes()
    expected = payloads_by_mcap(done.path)
    assert len(expected) == 5
    done.path.unlink()
    for n in range(chunks(whole)[1][1], len(good), 7):
        (tmp_path / "a.mcap.part").write_bytes(good[:n])
        (again,) = repair.recover(tmp_path)
        assert payloads_by_mcap(again.path) == expected, n
        again.path.unlink()


def test_a_bad_chunk_in_the_middle_is_left_out_and_the_original_kept(whole: bytes, tmp_path: Path) -> None:
    wanted = [r.data for r in small()]
    found = chunks(whole)
    begin, end, _ = found[2]
    more = whole[:end] + whole[begin:end] + whole[end:]  # a fourth chunk, equal to the third
    data = bytearray(more)
    data[begin + 80] ^= 4
    (tmp_path / "a.mcap.part").write_bytes(data)
    (done,) = repair.recover(tmp_path)
    assert done.what == "copied"
    assert done.lost_bytes >= end - begin
    assert "a.mcap.damaged" in done.detail
    assert payloads_by_mcap(done.path) == wanted
    assert (tmp_path / "a.mcap.damaged").read_bytes() == data
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap", "a.mcap.damaged"}


def test_a_lost_head_is_replaced_and_the_rest_kept(whole: bytes, tmp_path: Path) -> None:
    data = bytes(60) + whole[60:]
    (tmp_path / "a.mcap.part").write_bytes(data)
    (done,) = repair.recover(tmp_path)
    assert done.what == "copied"
    assert payloads_by_mcap(done.path) == [r.data for r in small()]
    assert (tmp_path / "a.mcap.damaged").read_bytes() == data


def test_messages_whose_channel_is_lost_stay_in_the_original_only(whole: bytes, tmp_path: Path) -> None:
    begin, end, _ = chunks(whole)[1]  # defines /rosout
    (tmp_path / "a.mcap.part").write_bytes(whole[:begin] + bytes(end - begin) + whole[end:])
    (done,) = repair.recover(tmp_path)
    assert done.what == "copied"
    assert payloads_by_mcap(done.path) == [small()[0].data]
    assert (tmp_path / "a.mcap.damaged").exists()


def test_what_is_no_recording_is_kept(tmp_path: Path) -> None:
    (tmp_path / "a.mcap.part").write_bytes(b"somebody's notes" * 9)
    (done,) = repair.recover(tmp_path)
    assert (done.what, done.messages) == ("copied", 0)
    assert payloads_by_mcap(done.path) == []
    assert (tmp_path / "a.mcap.damaged").read_bytes() == b"somebody's notes" * 9


def test_a_crash_between_copy_and_rename_ends_well(whole: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(whole)
    (tmp_path / "a.mcap.part").write_bytes(b"the damaged original")
    (tmp_path / "b.mcap.part").write_bytes(bytes(50) + whole[50:])
    (tmp_path / "b.mcap.repairing").write_bytes(b"half a copy")
    first, second = repair.recover(tmp_path)
    assert (first.path.name, first.what) == ("a.mcap", "copied")
    assert (tmp_path / "a.mcap").read_bytes() == whole
    assert (tmp_path / "a.mcap.damaged").read_bytes() == b"the damaged original"
    assert payloads_by_mcap(second.path) == [r.data for r in small()]
    assert {p.name for p in tmp_path.iterdir()} == {"a.mcap", "a.mcap.damaged", "b.mcap", "b.mcap.damaged"}


def test_other_files_are_left_alone(whole: bytes, tmp_path: Path) -> None:
    for name in ("a.mcap", "notes.part", "b.mcap.damaged"):
        (tmp_path / name).write_bytes(b"x")
    assert repair.recover(tmp_path) == []
    assert all(p.read_bytes() == b"x" for p in tmp_path.iterdir())


def test_a_disk_that_refuses_leaves_the_file(whole: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.mcap.part").write_bytes(whole[:-50])

    def refuse(fd: int) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(os, "fsync", refuse)
    (done,) = repair.recover(tmp_path)
    assert (done.what, done.path.name) == ("failed", "a.mcap.part")
    assert "Read-only" in done.detail
    monkeypatch.undo()
    (done,) = repair.recover(tmp_path)
    assert payloads_by_mcap(done.path) == [r.data for r in small()]


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_flipped_bits_never_stop_a_repair(whole: bytes, tmp_path_factory: Any, draw: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("flip")
    data = bytearray(whole)
    for _ in range(draw.draw(st.integers(1, 3))):
        data[draw.draw(st.integers(0, len(data) - 1))] ^= 1 << draw.draw(st.integers(0, 7))
    data = data[: draw.draw(st.integers(0, len(data)) | st.just(len(data)))]
    (folder / "a.mcap.part").write_bytes(data)
    (done,) = repair.recover(folder)
    found = payloads_by_mcap(done.path)
    assert len(found) == done.messages
    good = {r.data for r in small()}
    assert set(found) <= good  # the CRC lets no damaged message through
    if done.what == "copied":
        assert (folder / "a.mcap.damaged").read_bytes() == data


WRITER = """
import sys, pathlib
sys.path.insert(0, sys.argv[2])
from all_topics import records
from edge_agent.recording.writer import SegmentWriter
writer = SegmentWriter(pathlib.Path(sys.argv[1]), metadata={"run": "r"}, attachments={"c.yaml": b"x"})
while True:
    for i, record in enumerate(records(blocks=20)):
        writer.add(record)
        if i % 40 == 0:
            writer.flush()
            print(i, flush=True)
"""


def test_what_was_flushed_survives_a_kill(tmp_path: Path) -> None:
    part = tmp_path / "a.mcap.part"
    command = [sys.executable, "-c", WRITER, str(part), str(Path(__file__).parent)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        flushes = [int(process.stdout.readline()) for _ in range(12)]
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        flushes += [int(line) for line in process.stdout.read().split()]
    (done,) = repair.recover(tmp_path)
    assert done.what == "cut"
    per_round = len(list(records(blocks=20)))
    rounds = sum(i == 0 for i in flushes) - 1
    assert done.messages >= rounds * per_round + flushes[-1] + 1
    with AnyReader([done.path]) as bag:
        assert bag.message_count == done.messages
    assert [s.data for s in reader.read_messages(done.path)][:100] == [r.data for r in records(blocks=20)][:100]


def test_a_file_is_repaired_while_nothing_else_is_lost(tmp_path: Path) -> None:
    """A station's file of many channels, cut in the middle of any record."""
    data = write(tmp_path / "a.mcap.part", list(records(blocks=12)), (0, 40, 80, 120, 160)).read_bytes()
    (tmp_path / "a.mcap").unlink()
    ends = chunks(data)
    for part in list(reader.parts(data)):
        for n in (part.pos, part.pos + part.length // 2):
            (tmp_path / "a.mcap.part").write_bytes(data[:n])
            (done,) = repair.recover(tmp_path)
            assert done.messages == sum(count for _, end, count in ends if end <= n)
            assert len(payloads_by_mcap(done.path)) == done.messages
            with suppress(FileNotFoundError):
                done.path.unlink()
