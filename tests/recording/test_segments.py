"""Segments of a run: names, chain, durability, retention, a disk that refuses."""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from all_topics import checkpoint, records

from edge_agent.messages import Record, RecordSettings, Rotate, S
from edge_agent.recording import reader, segments, topics
from edge_agent.recording.segments import BELIEVED_NS, Recorder, RecordingError, list_segments, recover

T = 1_700_000_000 * S  # 2023-11-14 22:13:20 UTC
NAME = "bridge_20231114T221320Z"
FREE = 1 << 40


def rotate(utc_ns: int = T, order: int = 0) -> Rotate:
    return Rotate(checkpoint(max(utc_ns, T + S), order), utc_ns, "time")


def line(i: int, text: str = "x") -> Record:
    return Record("/rosout", T + 2 * S + i, T, topics.log(20, "n", f"{text} {i}", T), False)


def start(folder: Path, free: Any = None, site: str = "bridge", **settings: Any) -> Recorder:
    kept = RecordSettings(**{"free_gb": 0.0, "keep_days": 1e5, **settings})
    return Recorder(folder, kept, site, {"run": "r7"}, {"c.yaml": b"x"}, free or (lambda: FREE))


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def texts(path: Path) -> list[str]:
    return [topics.decode(s.schema, s.data)["msg"] for s in reader.read_messages(path, {"/rosout"})]


# ------------------------------------------------------------------------------------------------------ files and names


def test_a_segment_is_part_until_it_is_whole(tmp_path: Path) -> None:
    recorder = start(tmp_path / "made" / "by" / "us")
    folder = recorder.data_dir
    assert recorder.open_bytes == 0
    recorder.handle(rotate())
    assert names(folder) == [f"{NAME}_000.mcap.part"]
    assert recorder.path == folder / names(folder)[0]
    # the head is readable at once
    assert [s.topic for s in reader.read_messages(recorder.path)] == ["/raw/checkpoint"]
    assert recorder.open_bytes == recorder.path.stat().st_size > 0
    recorder.handle(line(1))
    recorder.handle(rotate(T + 60 * S, 5))
    assert names(folder) == [f"{NAME}_000.mcap", "bridge_20231114T221420Z_000.mcap.part"]
    assert recorder.close() == folder / "bridge_20231114T221420Z_000.mcap"
    assert recorder.close() is None
    assert names(folder) == [f"{NAME}_000.mcap", "bridge_20231114T221420Z_000.mcap"]
    assert texts(folder / f"{NAME}_000.mcap") == ["x 1"]
    assert recorder.drain_faults() == []


def test_two_files_never_share_a_name(tmp_path: Path) -> None:
    for taken in ("000.mcap", "001.mcap.damaged", "002.mcap.part", "003.mcap.repairing"):
        (tmp_path / f"{NAME}_{taken}").write_bytes(b"keep")
    recorder = start(tmp_path)
    for i in range(3):
        recorder.handle(rotate(T + i))
    recorder.close()
    assert [n for n in names(tmp_path) if (tmp_path / n).read_bytes() != b"keep"] == [
        f"{NAME}_{i:03d}.mcap" for i in (4, 5, 6)
    ]


def test_each_file_names_the_one_before_and_its_hash(tmp_path: Path) -> None:
    recorder = start(tmp_path)
    for i in range(3):
        recorder.handle(rotate(T + i * 60 * S))
        recorder.handle(line(i))
    last = recorder.close()
    assert last is not None
    again = start(tmp_path)  # the next run goes on with the chain
    again.handle(rotate(T + 3600 * S))
    again.close()
    found = sorted(tmp_path.iterdir())
    before, sha256 = "", ""
    for i, path in enumerate(found):
        run = reader.read_metadata(path)["edge_agent:run"]
        assert (run["previous_name"], run["previous_sha256"]) == (before, sha256)
        assert (run["run"], run["site"], run["opened_because"]) == ("r7", "bridge", "time")
        assert run["segment"] == str(i % 3)
        before, sha256 = path.name, hashlib.sha256(path.read_bytes()).hexdigest()
    assert reader.read_attachments(found[0]) == [("c.yaml", "application/yaml", b"x")]


def test_a_record_without_a_segment_comes_back(tmp_path: Path) -> None:
    recorder = start(tmp_path)
    with pytest.raises(RecordingError) as caught:
        recorder.handle(line(1))
    assert (caught.value.reason, caught.value.unwritten) == ("closed", (line(1),))
    recorder.idle(10 * S)
    assert names(tmp_path) == []


def test_a_wrong_record_is_the_callers_error_and_leaves_the_segment(tmp_path: Path) -> None:
    recorder = start(tmp_path)
    recorder.handle(rotate())
    with pytest.raises(ValueError, match="log time"):
        recorder.handle(Record("/rosout", -1, 0, b"", False))
    recorder.handle(line(1))
    path = recorder.close()
    assert path is not None
    assert texts(path) == ["x 1"]


# ----------------------------------------------------------------------------------------------------------- durability


def test_flush_and_fsync_come_when_due(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN flush every second and fsync every five WHEN time goes on THEN messages reach the file, and the disk."""
    synced: list[float] = []
    now = 100 * S
    monkeypatch.setattr(os, "fdatasync", lambda fd: synced.append(now / S))
    recorder = start(tmp_path)
    recorder.handle(rotate(), now)
    recorder.idle(now)
    synced.clear()
    seen = []
    for i in range(1, 101):
        recorder.handle(line(i), now)
        now += S // 10
        recorder.idle(now)
        assert recorder.path is not None
        seen.append(len(texts(recorder.path)))
    assert seen == [10 * (i // 10) for i in range(1, 101)]
    assert synced == [105.0, 110.0]
    recorder.close()


def test_on_a_slow_disk_an_fsync_is_over_when_it_is_due(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN an fsync that takes 0.8 s with the records before it WHEN power may go at any time THEN it costs 5 s."""
    synced: list[int] = []
    now = 100 * S
    recorder = start(tmp_path)
    recorder.handle(rotate(), now)
    recorder.idle(now)
    monkeypatch.setattr(os, "fdatasync", lambda fd: synced.append(now))
    ends = [now]
    for i in range(12):
        while len(synced) == i:
            now += max(int(recorder.wait_s(now) * S), 1)
            begun = now
            recorder.handle(line(i), now)
            now += S // 2  # to write the record
            if recorder.idle(now, begun):
                now += 3 * S // 10  # to sync
                recorder.fsync_took(now - begun)
                ends += [begun, now]
    costs = [end - begun for begun, end in zip(ends[0::2], ends[2::2], strict=False)]
    assert all(c <= 5.0 * S for c in costs[1:]), costs
    assert costs[-1] > 4 * S
    # A disk that takes for ever does not make it sync all the time.
    recorder.fsync_took(60 * S)
    assert recorder.wait_s(now) == 1.0 - 0.3
    recorder.close()


def test_a_disk_that_cannot_keep_fsync_s_gets_its_pause_and_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN an fsync that takes 4 s of the 5 WHEN it goes on so for three minutes THEN the writer has a quarter of the
    time for its other work, and what a power cut costs now is told once; and once when the disk keeps up again."""
    took = 4 * S
    monkeypatch.setattr(os, "fdatasync", lambda fd: None)
    recorder = start(tmp_path)
    now = begin = 100 * S
    recorder.handle(rotate(), now)
    recorder.idle(now)
    recorder.fsync_took(S // 100)
    busy = 0
    kinds_at: list[tuple[str, float]] = []

    def go_on(seconds: int) -> None:
        nonlocal now, busy
        end = now + seconds * S
        while now < end:
            now += max(int(recorder.wait_s(now) * S), S // 100)
            recorder.handle(line(0), now)
            begun = now
            if recorder.idle(now, begun):
                now += took
                busy += took
                recorder.fsync_took(now - begun)
            kinds_at.extend((f.kind, dict(f.values).get("lost_s", 0.0)) for f in recorder.drain_faults())

    go_on(180)
    assert 0.5 < busy / (now - begin) < 0.77
    ((kind, lost),) = kinds_at
    assert kind == "FSYNC_LATE"
    assert 6 < lost < 10
    late = recorder.fsyncs_late
    assert late > 20
    assert recorder.fsync_ns == took
    took = S // 10
    go_on(50)
    assert [k for k, _ in kinds_at] == ["FSYNC_LATE"]
    go_on(30)
    assert [k for k, _ in kinds_at] == ["FSYNC_LATE", "FSYNC_OK"]
    assert recorder.fsyncs_late <= late + 1
    recorder.close()


def test_time_without_a_file_is_no_late_fsync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "fdatasync", lambda fd: None)
    recorder = start(tmp_path)
    for at in (100, 200, 300):  # closed in between, as after a refusal
        recorder.handle(rotate(), at * S)
        for s in range(at, at + 20):
            recorder.handle(line(s), s * S)
            if recorder.idle(s * S, s * S):
                recorder.fsync_took(S // 10)
        recorder.close()
    assert recorder.fsyncs_late == 0


def test_what_waited_behind_a_rotate_is_flushed_when_it_would_have_been_without(tmp_path: Path) -> None:
    """GIVEN records that waited nearly a second for the writer WHEN a file is begun THEN they wait no more."""
    recorder = start(tmp_path)
    recorder.handle(rotate(), 100 * S)
    recorder.handle(line(0), 100 * S)
    recorder.idle(100 * S)  # the first records of a run have waited too
    assert recorder.path is not None
    assert texts(recorder.path) == ["x 0"]
    assert recorder.wait_s(100 * S + S // 4) == 0.75
    recorder.handle(rotate(T + 60 * S), 101 * S)
    recorder.handle(line(1), 101 * S)
    assert recorder.wait_s(101 * S) == 0.0
    recorder.idle(101 * S)
    assert recorder.path is not None
    assert texts(recorder.path) == ["x 1"]
    recorder.close()
    assert recorder.wait_s(0) == 1.0


def test_a_killed_run_is_recovered_at_the_next_start(tmp_path: Path) -> None:
    recorder = start(tmp_path)
    recorder.handle(rotate(), 0)
    recorder.handle(line(1), 0)
    recorder.idle(S)
    recorder.handle(line(2), S)  # never flushed
    assert recorder.path is not None
    (tmp_path / "copy").write_bytes(recorder.path.read_bytes())
    recorder.close()
    torn = (tmp_path / f"{NAME}_000.mcap").rename(tmp_path / f"{NAME}_000.mcap.part")
    (tmp_path / "copy").rename(torn)
    (done,) = recover(tmp_path)
    assert (done.path.name, done.what, done.messages) == (f"{NAME}_000.mcap", "cut", 2)
    again = start(tmp_path)
    again.handle(rotate())
    path = again.close()
    assert path is not None
    assert path.name == f"{NAME}_001.mcap"
    run = reader.read_metadata(path)["edge_agent:run"]
    assert run["previous_sha256"] == hashlib.sha256(done.path.read_bytes()).hexdigest()


# ------------------------------------------------------------------------------------------------------------ retention


def fill(folder: Path, ages_days: list[float], size: int, now: int = T) -> list[str]:
    made = []
    for age in ages_days:
        stamp = datetime.fromtimestamp(now // S, UTC) - timedelta(days=age)
        path = folder / f"bridge_{stamp:%Y%m%dT%H%M%SZ}_000.mcap"
        path.write_bytes(bytes(size))
        made.append(path.name)
    return made


STRANGERS = (
    "bridge.mcap",
    "bridge_20200101T000000Z_000.mcap.part",
    "bridge_20200101T000000Z_000.mcap.gz",
    "bridge_20200101T000000Z_00.mcap",
    "bridge_20201301T000000Z_000.mcap",
    "bridge_old_20200101T000000Z_000.mcap",
    "xbridge_20200101T000000Z_000.mcap",
    "bridge2_20200101T000000Z_000.mcap",
    "tower_20200101T000000Z_000.mcap",
    "notes.txt",
)


def test_only_our_own_names_are_segments(tmp_path: Path) -> None:
    for name in STRANGERS:
        (tmp_path / name).write_bytes(b"")
    ours = [f"bridge_20200101T00000{n}" for n in ("0Z_000.mcap", "0Z_1000.mcap", "1Z_000.mcap", "1Z_001.mcap.damaged2")]
    for name in ours:
        (tmp_path / name).write_bytes(b"")
    assert [s.path.name for s in list_segments(tmp_path, "bridge")] == ours
    assert list_segments(tmp_path, "b.*") == []


def test_what_is_too_old_goes_and_is_told(tmp_path: Path) -> None:
    for name in STRANGERS:
        (tmp_path / name).write_bytes(b"keep")
    old, young = fill(tmp_path, [10.01, 9.99], 100)
    recorder = start(tmp_path, keep_days=10.0)
    recorder.handle(rotate(), 7)
    recorder.idle(BELIEVED_NS + 6)
    assert (tmp_path / old).exists()  # a clock that has just been set is not believed so far
    recorder.idle(BELIEVED_NS + 60 * S + 7)
    assert not (tmp_path / old).exists()
    assert (tmp_path / young).exists()
    assert all((tmp_path / name).exists() for name in STRANGERS)
    (fault,) = recorder.drain_faults()
    said = fault.t_ns, fault.kind, fault.source, fault.values
    assert said == (BELIEVED_NS + 60 * S + 7, "RETENTION", "recorder", (("bytes", 100.0),))
    assert old in fault.text
    assert "10 days" in fault.text
    assert recorder.drain_faults() == []
    recorder.close()


def test_a_clock_that_was_not_set_ages_nothing(tmp_path: Path) -> None:
    """Files of 1970 have no known age once the clock is found; before it is found nothing has."""
    names_1970 = fill(tmp_path, [0.5, 1.0], 100, now=2 * 86400 * S)
    (young,) = fill(tmp_path, [100.0], 100)
    recorder = start(tmp_path, keep_days=10.0)
    recorder.handle(rotate(3 * 86400 * S), 0)
    assert recorder.drain_faults() == []
    recorder.handle(replace(rotate(), reason="clock"), BELIEVED_NS)
    assert recorder.drain_faults() == []
    recorder.handle(rotate(), 2 * BELIEVED_NS)
    assert [f.text.split()[0] for f in recorder.drain_faults()] == [young]
    assert set(names_1970) < set(names(tmp_path))
    recorder.close()


def test_oldest_go_first_when_there_is_too_much(tmp_path: Path) -> None:
    made = fill(tmp_path, [5, 4, 3, 2, 1], 1000)
    recorder = start(tmp_path, keep_gb=3500e-9)
    recorder.handle(rotate())
    assert [n for n in made if (tmp_path / n).exists()] == made[2:]
    assert len(recorder.drain_faults()) == 2
    recorder.close()


def test_the_open_file_counts_but_is_never_deleted(tmp_path: Path) -> None:
    recorder = start(tmp_path, keep_gb=1e-9)
    recorder.handle(rotate(), 0)
    (old,) = fill(tmp_path, [1], 0)
    recorder.handle(line(1), 0)
    recorder.idle(61 * S)
    assert names(tmp_path) == [f"{NAME}_000.mcap.part"]
    assert [f.text.split()[0] for f in recorder.drain_faults()] == [old]
    path = recorder.close()
    assert path is not None
    assert texts(path) == ["x 1"]


def test_an_undisciplined_clock_deletes_nothing_for_its_age(tmp_path: Path) -> None:
    """GIVEN a wall clock a year ahead that nothing disciplines WHEN segments begin THEN all recordings stay."""
    made = fill(tmp_path, [3, 2, 1], 100)
    recorder = start(tmp_path, keep_days=30.0)
    for year in (1, 2):
        recorder.handle(replace(rotate(T + year * 366 * 86400 * S), sync=False))
    assert set(made) < set(names(tmp_path))
    assert recorder.drain_faults() == []
    recorder.handle(rotate(T + 3 * 366 * 86400 * S), BELIEVED_NS)
    assert len([f for f in recorder.drain_faults() if f.kind == "RETENTION"]) >= 3
    recorder.close()


def test_a_disk_that_others_fill_costs_no_recordings_in_vain(tmp_path: Path) -> None:
    made = fill(tmp_path, [3, 2, 1], 1000)
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "one.mcap").write_bytes(bytes(2_000_000))
    free = [5_000_000]
    recorder = start(tmp_path, lambda: free[0], free_gb=0.006)
    recorder.handle(rotate(), 0)
    recorder.idle(100 * S)
    assert set(made) < set(names(tmp_path))
    (fault,) = recorder.drain_faults()
    assert (fault.kind, fault.values) == ("SPACE_SHORT", (("missing_bytes", 1e6),))
    assert "clips, which are never deleted, 0.002 GB" in fault.text
    free[0] = 7_000_000  # there is room again, and then it is short once more
    recorder.idle(200 * S)
    free[0] = 5_000_000
    recorder.idle(300 * S)
    assert [f.kind for f in recorder.drain_faults()] == ["SPACE_SHORT"]
    free[0] = 7_000_000
    recorder.idle(400 * S)
    free[0] = -1  # it does not say: nothing is told, and nothing deleted
    recorder.idle(500 * S)
    assert recorder.drain_faults() == []
    assert (tmp_path / "clips" / "one.mcap").exists()
    recorder.close()


@pytest.mark.parametrize(("size", "clips_"), [(100_000, 0), (20_000, 0), (100_000, 60_000)])
def test_a_disk_never_runs_full_of_recordings_whatever_clock_and_limits(
    tmp_path: Path, size: int, clips_: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN a clock that is never disciplined, and restarts, so that nothing goes for its age; keep_gb far beyond the
    disk; and a disk smaller than free_gb or half full of clips WHEN recording goes on for long THEN old files go before
    it is full, no record is refused, and the open file stays."""
    monkeypatch.setattr(segments, "HEAD_BYTES", 500)
    least, made = size, 0

    def free() -> int:
        nonlocal least
        left = size - clips_ - sum(p.stat().st_size for p in tmp_path.iterdir())
        least = min(least, left)
        return left

    for restart in range(6):
        recorder = start(tmp_path, free, free_gb=5e-5, keep_gb=16.0, keep_days=1e-3)
        for i in range(5):
            at = (1000 * restart + 100 * i) * S
            recorder.handle(replace(rotate(T + at), sync=False), at)
            for j in range(3):
                recorder.handle(line(j), at + j * S)
            recorder.idle(at + 70 * S)
            made += 1
            assert recorder.path is not None
        recorder.close()
    there = list(tmp_path.glob("*.mcap"))
    assert 1 < len(there) < made
    assert least > 0


def test_free_space_is_kept_while_a_file_is_open(tmp_path: Path) -> None:
    """GIVEN another program that fills the disk WHEN a minute has passed THEN the oldest make room."""
    made = fill(tmp_path, [3, 2, 1], 1000)
    taken = [0]

    def free() -> int:
        return 10_000_000 - taken[0] + 1000 * sum(not (tmp_path / n).exists() for n in made)

    recorder = start(tmp_path, free, free_gb=0.01)
    recorder.handle(rotate(), 0)
    assert set(made) < set(names(tmp_path))
    taken[0] = 1500
    recorder.idle(59 * S)
    assert set(made) < set(names(tmp_path))
    recorder.idle(60 * S)
    assert [n for n in made if (tmp_path / n).exists()] == made[2:]
    recorder.close()


def test_a_file_that_cannot_be_deleted_is_told_and_passed_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = fill(tmp_path, [3, 2, 1], 1000)
    real = Path.unlink

    def unlink(self: Path, missing_ok: bool = False) -> None:
        if self.name == made[0]:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        real(self, missing_ok)

    monkeypatch.setattr(Path, "unlink", unlink)
    recorder = start(tmp_path, keep_days=1.5)
    recorder.handle(rotate(), 0)
    recorder.idle(BELIEVED_NS)
    assert [n for n in made if (tmp_path / n).exists()] == [made[0], made[2]]
    assert [f.kind for f in recorder.drain_faults()] == ["RETENTION_FAILED", "RETENTION"]
    recorder.close()


# -------------------------------------------------------------------------------------- a disk that refuses


class Disk:
    """Refuses to write beyond a number of bytes, as a full or failing file system does."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left = 1 << 40
        self.error = errno.ENOSPC
        disk = self
        real = segments.SegmentWriter.__init__.__globals__["_HashedFile"]

        class File(real):  # type: ignore[misc, valid-type] # the class that the writer uses
            def write(self, data: bytes) -> int:
                if len(data) > disk.left:
                    super().write(data[: disk.left])  # the part that still went
                    disk.left = 0
                    raise OSError(disk.error, os.strerror(disk.error))
                disk.left -= len(data)
                return int(super().write(data))

        monkeypatch.setitem(segments.SegmentWriter.__init__.__globals__, "_HashedFile", File)


@pytest.mark.parametrize(
    ("error", "reason"), [(errno.ENOSPC, "full"), (errno.EDQUOT, "full"), (errno.EROFS, "read-only"), (errno.EIO, "io")]
)
@pytest.mark.parametrize("left", [0, 10, 100])
def test_a_failing_disk_seals_the_file_and_gives_back_what_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int, reason: str, left: int
) -> None:
    disk = Disk(monkeypatch)
    disk.error = error
    recorder = start(tmp_path)
    recorder.handle(rotate(), 0)
    for i in range(5):
        recorder.handle(line(i), 0)
    recorder.idle(S)
    for i in range(5, 8):
        recorder.handle(line(i), S)
    disk.left = left
    with pytest.raises(RecordingError) as caught:
        recorder.idle(2 * S)
    assert caught.value.reason == reason
    assert list(caught.value.unwritten) == [line(i) for i in range(5, 8)]
    assert recorder.path is None
    assert recorder.open_bytes == 0
    assert names(tmp_path) == [f"{NAME}_000.mcap"]
    assert texts(tmp_path / f"{NAME}_000.mcap") == [f"x {i}" for i in range(5)]
    with pytest.raises(RecordingError, match="no segment"):
        recorder.handle(line(8))
    # WHEN there is space again THEN the next Rotate goes on
    disk.left = 1 << 40
    recorder.handle(rotate(T + S), 3 * S)
    recorder.handle(line(9), 3 * S)
    path = recorder.close()
    assert path is not None
    assert texts(path) == ["x 9"]
    run = reader.read_metadata(path)["edge_agent:run"]
    before = tmp_path / run["previous_name"]
    assert run["previous_sha256"] == hashlib.sha256(before.read_bytes()).hexdigest()


def test_a_file_system_made_read_only_by_force_is_told_at_the_next_flush(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Writes go on without an error then, into memory (`echo u >/proc/sysrq-trigger`)."""
    recorder = start(tmp_path)
    recorder.handle(rotate(), 0)
    recorder.handle(line(0), 0)
    recorder.idle(S)
    real = os.fstatvfs

    def forced(fd: int) -> object:
        seen = real(fd)
        return type("", (), {"f_flag": seen.f_flag | os.ST_RDONLY})

    monkeypatch.setattr(os, "fstatvfs", forced)
    recorder.handle(line(1), S)
    recorder.idle(S + S // 2)  # not due
    with pytest.raises(RecordingError) as caught:
        recorder.idle(2 * S)
    assert (caught.value.reason, caught.value.unwritten) == ("read-only", (line(1),))
    assert recorder.path is None


@pytest.mark.parametrize("gone", ["file", "folder"])
def test_a_file_taken_away_is_told_at_the_next_flush_and_the_next_begins(tmp_path: Path, gone: str) -> None:
    """Linux writes on into a file that has no name any more."""
    data = tmp_path / "data"
    recorder = start(data)
    recorder.handle(rotate(), 0)
    recorder.handle(line(0), 0)
    recorder.idle(S)
    assert recorder.path is not None
    if gone == "file":
        recorder.path.unlink()
    else:
        shutil.rmtree(data)
    recorder.handle(line(1), S)
    with pytest.raises(RecordingError, match="No such file") as caught:
        recorder.idle(2 * S)
    assert (caught.value.reason, caught.value.unwritten) == ("io", (line(1),))
    recorder.handle(rotate(T + 2 * S), 2 * S)
    recorder.handle(line(2), 2 * S)
    path = recorder.close()
    assert path is not None
    assert texts(path) == ["x 2"]


def test_a_full_disk_makes_room_with_the_oldest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(monkeypatch)
    made = fill(tmp_path, [3, 2], 1000)
    recorder = start(tmp_path)
    recorder.handle(rotate(), 0)
    recorder.handle(line(1), 0)
    disk.left = 0
    with pytest.raises(RecordingError, match="was sealed"):
        recorder.idle(S)
    assert [n for n in made if (tmp_path / n).exists()] == made[1:]
    assert "full" in recorder.drain_faults()[0].text


def test_rotation_on_a_failing_disk_tells_the_loss_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """GIVEN the old file cannot be finished WHEN the new one can be opened THEN recording goes on, the loss is told."""
    disk = Disk(monkeypatch)
    recorder = start(tmp_path)
    recorder.handle(rotate(), 0)
    recorder.handle(line(1), 0)
    disk.left = 0
    real = Recorder._open

    def recovered(self: Recorder, order: Rotate) -> Any:
        disk.left = 1 << 40
        return real(self, order)

    monkeypatch.setattr(Recorder, "_open", recovered)
    with pytest.raises(RecordingError, match="a new segment is open") as caught:
        recorder.handle(rotate(T + S), 0)
    assert caught.value.unwritten == (line(1),)
    assert recorder.path is not None
    recorder.handle(line(2), 0)
    path = recorder.close()
    assert path is not None
    assert texts(path) == ["x 2"]


@pytest.mark.parametrize("left", [0, 100, 900])
def test_trying_again_on_a_full_disk_leaves_nothing_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: int
) -> None:
    disk = Disk(monkeypatch)
    recorder = start(tmp_path)
    for i in range(3):
        disk.left = left
        with pytest.raises(RecordingError) as caught:
            recorder.handle(rotate(T + i * S, i))
        assert caught.value.reason == "full"
        assert caught.value.unwritten == (rotate(T + i * S, i).checkpoint,)
        assert names(tmp_path) == []
    disk.left = 1 << 40
    recorder.handle(rotate())
    assert recorder.close() is not None


def test_no_file_is_begun_without_room_for_its_head(tmp_path: Path) -> None:
    recorder = start(tmp_path, lambda: 1000)
    with pytest.raises(RecordingError) as caught:
        recorder.handle(rotate())
    assert caught.value.reason == "full"
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_made_is_a_recording_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    recorder = start(tmp_path / "file" / "below")
    with pytest.raises(RecordingError) as caught:
        recorder.handle(rotate())
    assert caught.value.reason == "io"


def test_a_whole_run_comes_back_in_order(tmp_path: Path) -> None:
    """Every record of a run, in the order in which it was handed over, over all files."""
    recorder = start(tmp_path, flush_s=0.5)
    wanted, now = list(records(blocks=30)), 0
    for i, record in enumerate(wanted):
        if i % 200 == 0:
            recorder.handle(Rotate(checkpoint(record.log_ns, i), record.log_ns + i // 200 * 60 * S, "size"), now)
        recorder.handle(record, now)
        now += 5_000_000
        recorder.idle(now)
    recorder.close()
    found = [(s.topic, s.data) for path in sorted(tmp_path.iterdir()) for s in list(reader.read_messages(path))[1:]]
    assert found == [(r.topic, r.data) for r in wanted]
