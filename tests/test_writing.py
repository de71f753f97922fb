"""The writer and a folder that is taken away from under it."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import pytest
from live import recordings, stored

from edge_agent.messages import Record, RecordSettings, Rotate, S
from edge_agent.notify import Notifier
from edge_agent.queues import ByteQueue
from edge_agent.recording import topics
from edge_agent.recording.segments import Recorder
from edge_agent.writing import GONE_NS, Beat, Keep, Writer

T = 1_700_000_000 * S


def made(folder: Path) -> Writer:
    settings = RecordSettings(free_gb=0.0)
    recorder = Recorder(folder, settings, "site", {"run": "r"}, {}, lambda: 1 << 40)
    outbox: ByteQueue[Record | Rotate | Keep | Beat] = ByteQueue(1 << 20)
    return Writer(outbox, recorder, settings, folder / "state", {}, Notifier(None), now=lambda: 0)


def rotate(i: int, reason: str) -> Rotate:
    utc_ns = T + i * S
    data = topics.checkpoint(i, i * S, utc_ns, b"", reason)
    return Rotate(Record(topics.CHECKPOINT_TOPIC, utc_ns, utc_ns, data, False), utc_ns, reason)


def line(i: int) -> Record:
    return Record("/rosout", T + i * S, T, topics.log(20, "n", f"line {i}", T), False)


def second(writer: Writer, i: int) -> None:
    """A line; a new file where the writer asks for one."""
    now = i * S
    if writer.want_rotate:
        writer.want_rotate = False
        writer._one(rotate(i, "disk"), now)
    writer._one(line(i), now)
    writer._due(now)


def test_a_folder_that_is_deleted_is_made_again_and_what_could_not_be_written_is_told(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    writer = made(folder)
    writer._one(rotate(0, "start"), 0)
    for i in range(1, 4):
        second(writer, i)
    shutil.rmtree(folder)
    for i in range(4, 15):
        second(writer, i)
    writer._end(15 * S)
    said = {topics.decode(s.schema, s.data)["msg"] for s in stored(recordings(folder), "/rosout")}
    assert said == {f"line {i}" for i in range(5, 15)}
    assert [f.kind for f in writer.faults] == ["DISK_IO", "DISK_OK"]
    assert writer.lost["/rosout"] == [1, T + 4 * S, T + 4 * S]


def test_a_folder_that_cannot_be_made_again_ends_the_writer_after_a_while(tmp_path: Path) -> None:
    """As a service, whose folder is a mount of its own: once it is deleted, only a new start brings it back."""
    place = tmp_path / "lib"
    writer = made(place / "rec")
    writer._one(rotate(0, "start"), 0)
    for i in range(1, 4):
        second(writer, i)
    shutil.rmtree(place)
    place.write_text("no folder can be made here")
    told = 5  # at 4 the file is missed, from 5 on the folder
    for i in range(4, told + GONE_NS // S):
        second(writer, i)
    assert [f.kind for f in writer.faults] == ["DISK_IO"]
    with pytest.raises(FileNotFoundError, match="cannot be made again"):
        second(writer, told + GONE_NS // S)


def test_a_disk_that_does_not_answer_is_not_a_folder_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is held in memory waits for it, however long."""
    writer = made(tmp_path / "rec")
    writer._one(rotate(0, "start"), 0)
    writer.holding = True

    def sick(self: Path, **_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(Path, "stat", sick)
    for i in range(1, 3 * GONE_NS // S):
        writer._see_to_folder(i * S)
    monkeypatch.undo()
    shutil.rmtree(tmp_path / "rec")
    writer._see_to_folder(100 * S)
    with pytest.raises(FileNotFoundError):
        writer._see_to_folder(100 * S + GONE_NS)
    writer._end(0)


def test_a_folder_that_was_never_there_is_waited_for(tmp_path: Path) -> None:
    place = tmp_path / "lib"
    place.write_text("no folder can be made here")
    writer = made(place / "rec")
    writer.want_rotate = True
    for i in range(1, 3 * GONE_NS // S):
        second(writer, i)
    place.unlink()
    for i in range(3 * GONE_NS // S, 3 * GONE_NS // S + 10):
        second(writer, i)
    assert not writer.holding
    writer._end(0)
    assert len(recordings(place / "rec")) == 1
