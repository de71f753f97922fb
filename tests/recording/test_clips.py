"""Event clips: which interval is kept, what is in the file, the quota, the hook; an agent that writes one."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from edge_agent.messages import EventSettings, Record, RecordSettings, Rotate, S, TriggerSettings
from edge_agent.recording import clips, reader, topics
from edge_agent.recording.clips import Clips, Job, Watch
from edge_agent.recording.segments import Recorder
from edge_agent.recording.writer import RUN_METADATA
from edge_agent.triggers import BEGIN, END

OFFSET = 1_700_000_000 * S  # UTC - monotonic


def jobs(watch: Watch, seconds: range) -> list[tuple[float, float, tuple[str, ...]]]:
    found = [watch.due(s * S) for s in seconds]
    return [(j.begin_ns / S, j.end_ns / S, j.names) for j in found if j]


def watch(**settings: Any) -> Watch:
    return Watch(EventSettings(**{"before_s": 10.0, "after_s": 20.0, **settings}))


def test_an_event_is_kept_with_what_was_before_and_after() -> None:
    w = watch()
    w.begin("a", 100 * S)
    assert jobs(w, range(100, 150)) == []
    w.end("a", 150 * S)
    assert jobs(w, range(150, 180)) == []  # one that begins before 180 would overlap
    assert jobs(w, range(180, 300)) == [(90.0, 170.0, ("a",))]


def test_overlapping_events_are_one_clip_and_a_fault_joins_them() -> None:
    w = watch()
    w.begin("a", 100 * S)
    w.begin("b", 105 * S)
    w.end("a", 110 * S)
    w.end("b", 120 * S)
    w.moment("f", 149 * S)  # its 10 s before begin at 139, the clip so far ends at 140
    w.begin("a", 165 * S)
    w.end("a", 166 * S)
    assert jobs(w, range(160, 400)) == [(90.0, 186.0, ("a", "b", "f"))]
    w.moment("f", 400 * S)
    assert jobs(w, range(400, 500)) == [(390.0, 420.0, ("f",))]


def test_one_that_does_not_end_gives_one_clip_of_the_longest_length_and_the_next_holds_nothing_twice() -> None:
    w = watch(max_s=60.0)
    w.begin("a", 100 * S)
    assert jobs(w, range(100, 1000)) == [(90.0, 150.0, ("a",))]
    w.end("a", 1000 * S)  # of what has been kept already
    assert jobs(w, range(1000, 1100)) == []
    w = watch(max_s=60.0)
    w.begin("a", 100 * S)
    assert len(jobs(w, range(100, 152))) == 1
    w.begin("b", 155 * S)
    w.end("b", 156 * S)
    assert jobs(w, range(156, 300)) == [(150.0, 176.0, ("b",))]


def test_what_is_told_late_and_lies_in_the_last_clip_makes_no_other() -> None:
    w = watch()
    w.moment("f", 100 * S)
    assert jobs(w, range(100, 200)) == [(90.0, 120.0, ("f",))]
    w.moment("loss", 95 * S)
    assert jobs(w, range(200, 300)) == []
    w.moment("loss", 101 * S)
    assert jobs(w, range(300, 400)) == [(120.0, 121.0, ("loss",))]


def test_what_is_open_at_the_end_is_kept_as_far_as_it_came() -> None:
    w = watch()
    assert w.rest(5 * S) is None
    w.begin("a", 100 * S)
    assert w.rest(104 * S) == Job(90 * S, 104 * S, ("a",))
    assert w.rest(105 * S) is None


# ---------------------------------------------------------------------------------------------------------------- files


def line(t_ns: int, text: str) -> Record:
    return Record("/rosout", t_ns + OFFSET, OFFSET, topics.log(20, "n", text, OFFSET), False)


def event(kind: str, name: str, t_ns: int, end_ns: int = 0) -> Record:
    data = topics.event(kind, name, "", (), t_ns, t_ns + OFFSET, t_ns + OFFSET, end_ns + OFFSET)
    return Record("/events", t_ns + OFFSET, t_ns + OFFSET, data, True)


def point(t_ns: int, offset: int = OFFSET) -> Rotate:
    data = topics.checkpoint(0, t_ns, t_ns + offset, b"", "time")
    return Rotate(Record("/raw/checkpoint", t_ns + offset, t_ns + offset, data, False), t_ns + offset, "time")


OPEN: list[Recorder] = []


@pytest.fixture(autouse=True)
def closed_at_the_end() -> Iterator[None]:
    yield
    while OPEN:
        OPEN.pop().close()


def recorded(folder: Path, seconds: int = 300, rotate: int = 60, step: int | None = None) -> Recorder:
    """One line a second from 0 on; a file a minute, the last one still open; a clock step of an hour at `step`."""
    kept = RecordSettings(free_gb=0.0, keep_days=1e5)
    recorder = Recorder(folder, kept, "site", {"run": "r"}, {"c.yaml": b"x"}, lambda: 1 << 40)
    OPEN.append(recorder)
    for s in range(seconds):
        ahead = 3600 * S if step is not None and s >= step else 0
        if s % rotate == 0 or s == step:
            recorder.handle(point(s * S, OFFSET + ahead), s * S)
        recorder.handle(line(s * S + ahead, f"{s}"), s * S)
        recorder.idle(s * S)
    recorder.idle((seconds + 2) * S)
    return recorder


def made(recorder: Recorder, *triggers: TriggerSettings, **settings: Any) -> Clips:
    return Clips(recorder, EventSettings(**{"before_s": 10.0, "after_s": 20.0, **settings}), triggers)


def texts(path: Path) -> list[int]:
    return [int(topics.decode(s.schema, s.data)["msg"]) for s in reader.read_messages(path, {"/rosout"})]


def files(c: Clips) -> list[Path]:
    return sorted(c.folder.iterdir()) if c.folder.exists() else []


@pytest.mark.parametrize("step", [None, 115])
def test_a_clip_holds_every_record_of_its_interval_over_files_and_clock_steps(tmp_path: Path, step: int | None) -> None:
    c = made(recorded(tmp_path, step=step))
    c.saw(event(BEGIN, "sag", 110 * S), OFFSET)
    c.saw(event("REJECT", "gnss", 111 * S), OFFSET)
    c.saw(event(END, "sag", 126 * S, 121 * S), OFFSET)
    for s in range(126, 200):
        c.every_second(s * S)
    c.stopping.set()
    c._one(c._jobs.get_nowait())  # type: ignore[arg-type]
    (path,) = files(c)
    assert texts(path) == list(range(100, 141))
    assert path.name == "site_20231114T221500Z_000.mcap"
    run = reader.read_metadata(path)[RUN_METADATA]
    assert run["clip"] == "sag"
    assert len(run["clip_of"].split(", ")) == (2 if step is None else 3)
    assert "previous_name" not in run
    assert [a.name for a in reader.read_attachments(path)] == ["c.yaml"]
    (told,) = c.faults
    assert (told.kind, told.text, told.values[0]) == ("CLIP", f"{path.name}: 40.0 s, sag", ("seconds", 40.0))
    assert reader.info(path).complete


def test_a_clip_is_cut_from_the_open_file_and_channels_that_came_before_it_are_known(tmp_path: Path) -> None:
    recorder = recorded(tmp_path, seconds=100, rotate=1000)
    c = made(recorder)
    c._one(Job(50 * S, 60 * S, ("x",)))
    assert texts(files(c)[0]) == list(range(50, 60))
    c._one(Job(50 * S, 60 * S, ("x",)))
    assert [p.name[-8:] for p in files(c)] == ["000.mcap", "001.mcap"]
    assert list(reader.read_between(recorder.recent[-1].with_name(recorder.recent[-1].name + ".part"), 0, 5)) == []


def test_a_fault_of_the_named_kind_is_kept(tmp_path: Path) -> None:
    c = made(recorded(tmp_path, 100), TriggerSettings("pulled", fault="PORT_LOST"))
    c.fault("SILENT", 30 * S)
    c.fault("PORT_LOST", 50 * S)
    c.close(60 * S)
    c.run()
    assert [p.name[-8:] for p in files(c)] == ["000.mcap"]
    assert texts(files(c)[0]) == list(range(40, 60))


def test_a_full_folder_refuses_new_clips_and_keeps_the_old(tmp_path: Path) -> None:
    c = made(recorded(tmp_path, 100), clips_gb=0.001)
    c.folder.mkdir()
    (c.folder / "old").write_bytes(bytes(1_000_000))
    c._one(Job(50 * S, 60 * S, ("x",)))
    assert [p.name for p in files(c)] == ["old"]
    (told,) = c.faults
    assert told.kind == "CLIPS_FULL"
    assert "holds 0.001 GB of 0.001" in told.text


def test_retention_does_not_touch_clips(tmp_path: Path) -> None:
    recorder = recorded(tmp_path, 300)
    c = made(recorder)
    c._one(Job(50 * S, 60 * S, ("x",)))
    recorder.settings = RecordSettings(keep_gb=1e-9, keep_days=1e-3, free_gb=1e6)
    recorder.handle(point(86400 * S), 86400 * S)
    assert [p.name for p in tmp_path.iterdir() if p.suffix == ".mcap"] == []
    assert len(files(c)) == 1
    assert texts(files(c)[0]) == list(range(50, 60))


def test_a_file_that_is_renamed_while_a_clip_waits_for_it_is_looked_for_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[Path] = []

    def newest(path: Path) -> int:
        looks.append(path)
        if len(looks) == 1:
            raise FileNotFoundError(2, "No such file or directory", str(path))
        return reader.newest_ns(path)

    monkeypatch.setattr(clips, "newest_ns", newest)
    c = made(recorded(tmp_path, 100))
    monkeypatch.setattr(c.stopping, "wait", lambda seconds: False)
    c._one(Job(50 * S, 60 * S, ("x",)))
    assert len(looks) == 2
    assert [f.kind for f in c.faults] == ["CLIP"]


def test_a_file_that_gets_its_final_name_while_others_are_copied_is_in_the_clip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder = recorded(tmp_path, 100)  # begun at 0 and 60 s, the second is open
    read = clips.read_between

    def slow(path: Path, begin_ns: int, end_ns: int) -> Iterator[reader.Stored]:
        yield from read(path, begin_ns, end_ns)
        if len(list(tmp_path.glob("*.mcap"))) == 1:
            recorder.close()

    monkeypatch.setattr(clips, "read_between", slow)
    c = made(recorder)
    c._one(Job(50 * S, 70 * S, ("x",)))
    assert [f.kind for f in c.faults] == ["CLIP"]
    assert texts(files(c)[0]) == list(range(50, 70))


def test_a_clip_says_how_much_is_in_it(tmp_path: Path) -> None:
    """The agent began after the interval, or ended before it."""
    c = made(recorded(tmp_path, 100))
    c.stopping.set()
    for begin, end in ((50, 60), (-20, 10), (90, 140), (200, 210)):
        c._one(Job(begin * S, end * S, ("x",)))
    assert [dict(f.values)["seconds"] for f in c.faults] == [9, 9, 9, 0]
    assert ".mcap: 9.0 s, x" in c.faults[1].text


def test_a_disk_that_refuses_leaves_no_half_clip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    c = made(recorded(tmp_path, 100))

    def refuse(self: Any, record: Record) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(clips.SegmentWriter, "add", refuse)
    c._one(Job(50 * S, 60 * S, ("x",)))
    assert files(c) == []
    assert [f.kind for f in c.faults] == ["CLIP_FAILED"]
    recorder = Recorder(tmp_path / "none", RecordSettings(), "s", {}, {}, lambda: 1)
    c = made(recorder)
    c.stopping.set()
    c._one(Job(50 * S, 60 * S, ("x",)))
    assert "no segment holds it" in c.faults[0].text


def test_more_clips_than_may_wait_are_refused_and_told(tmp_path: Path) -> None:
    c = made(recorded(tmp_path, 10))
    for i in range(clips.JOBS + 2):
        c._offer(Job(i, i + 1, ("x",)))
    assert c._jobs.qsize() == clips.JOBS
    assert [f.kind for f in c.faults] == ["CLIP_REFUSED"] * 2
    c.close(0)  # still has room for the end


# ----------------------------------------------------------------------------------------------------------------- hook


def hooked(folder: Path, *argv: str, **settings: Any) -> tuple[Clips, Path]:
    c = made(recorded(folder / "rec", 100), hook=argv, **settings)
    c._one(Job(50 * S, 60 * S, ("sag", "shock")))
    return c, files(c)[0]


def test_the_hook_gets_the_clip_and_the_names_and_no_shell_reads_it(tmp_path: Path) -> None:
    code = "import os, sys; open(sys.argv[1], 'w').write(repr((sys.argv[2:], os.environ['EDGE_AGENT_TRIGGERS'])))"
    c, path = hooked(tmp_path, sys.executable, "-c", code, str(tmp_path / "out"), "$(reboot); `x`")
    assert (tmp_path / "out").read_text() == repr((["$(reboot); `x`", str(path)], "sag shock"))
    assert [f.kind for f in c.faults] == ["CLIP"]


@pytest.mark.parametrize(
    ("argv", "hook_s", "said"),
    [
        (("/bin/sh", "-c", "exit 3"), 60.0, "/bin/sh: exit code 3"),
        (("/no/such/program",), 60.0, "/no/such/program: No such file or directory"),
        (("/bin/true", "a\0b"), 60.0, "/bin/true: embedded null byte"),
        (("/bin/sh", "-c", "sleep 1000 & sleep 1000"), 0.2, "/bin/sh: killed: it took longer than 0.2 s"),
    ],
)
def test_a_hook_that_fails_or_hangs_is_a_fault(tmp_path: Path, argv: tuple[str, ...], hook_s: float, said: str) -> None:
    c, _ = hooked(tmp_path, *argv, hook_s=hook_s)
    assert [(f.kind, f.text) for f in c.faults][1:] == [("HOOK_FAILED", said)]


def test_what_a_hook_started_ends_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = f"sleep 1000 & echo $! > {tmp_path}/new; mv {tmp_path}/new {tmp_path}/pid; sleep 1000"

    def monotonic() -> float:  # the hook's time is over once it has done what the test looks at
        return 1000.0 if (tmp_path / "pid").exists() else 0.0

    monkeypatch.setattr(clips, "time", SimpleNamespace(monotonic=monotonic, monotonic_ns=time.monotonic_ns))
    c, _ = hooked(tmp_path, "/bin/sh", "-c", code, hook_s=0.5)
    assert [f.kind for f in c.faults] == ["CLIP", "HOOK_FAILED"]
    child = int((tmp_path / "pid").read_text())
    end = time.monotonic() + 20.0
    while (state := _state(child)) not in ("Z", "X", "gone") and time.monotonic() < end:
        time.sleep(0.01)
    if state not in ("Z", "X", "gone"):
        os.kill(child, signal.SIGKILL)
    assert state in ("Z", "X", "gone")


def _state(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return "gone"


def test_no_hook_runs_once_the_agent_ends(tmp_path: Path) -> None:
    c = made(recorded(tmp_path / "rec", 100), hook=("/bin/sh", "-c", f"echo > {tmp_path}/out"))
    c._offer(Job(50 * S, 60 * S, ("x",)))
    c.close(70 * S)
    c.run()
    assert len(files(c)) == 1
    assert not (tmp_path / "out").exists()
