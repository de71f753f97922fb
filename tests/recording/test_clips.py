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
from live import PATIENCE_S, until

from edge_agent.messages import EventSettings, Record, RecordSettings, Rotate, S, TriggerSettings
from edge_agent.recording import clips, reader, topics
from edge_agent.recording.clips import Clips, Job, Watch
from edge_agent.recording.segments import Recorder, recover
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


# ------------------------------------------------------------------------------------- what a kill has left undone


def killed(
    folder: Path, *some: tuple[int, Record], run: str = "r", begin: int = 0, end: int = 200, drift_ns: int = 0
) -> list[Path]:
    """A run of which the process was killed at `end` s: lines and these records as they came, a file a minute, each
    with a clock `drift_ns` further off."""
    recorder = Recorder(
        folder, RecordSettings(free_gb=0.0, keep_days=1e5), "site", {"run": run}, {"c": b"x"}, lambda: 1 << 40
    )
    for s in range(begin, end):
        if (s - begin) % 60 == 0:
            recorder.handle(point(s * S, OFFSET + (s - begin) // 60 * drift_ns), s * S)
        recorder.handle(line(s * S, f"{s}"), s * S)
        for at, record in some:
            if at == s:
                recorder.handle(record, s * S)
        recorder.idle(s * S)
    recorder.idle((end + 2) * S)
    path = recorder.path
    assert path is not None
    torn = path.read_bytes()
    final = recorder.close()
    assert final is not None
    final.unlink()
    path.write_bytes(torn)
    recover(folder)
    return sorted(folder.glob("*.mcap"))


def told(kind: str, text: str, t_ns: int) -> Record:
    data = topics.event(kind, "clips" if kind == "CLIP" else "gnss", text, (), t_ns, t_ns + OFFSET)
    return Record("/faults", t_ns + OFFSET, t_ns + OFFSET, data, False)


def next_start(folder: Path, *triggers: TriggerSettings, run: str = "r2", **settings: Any) -> Clips:
    """The next run's clips, from its start to its stop."""
    kept = RecordSettings(free_gb=0.0, keep_days=1e5)
    recorder = Recorder(folder, kept, "site", {"run": run}, {}, lambda: 1 << 40)
    recorder.handle(point(1000 * S), 1000 * S)
    OPEN.append(recorder)
    c = made(recorder, *triggers, **settings)
    c.close(1001 * S)
    c.run()
    assert c.failure is None
    return c


def test_an_event_that_a_kill_cut_short_gets_its_clip_at_the_next_start(tmp_path: Path) -> None:
    """GIVEN an event that had begun, and one whose clip was not yet written WHEN the process is killed THEN both clips
    are made from the recovered files, and only once."""
    files_ = killed(
        tmp_path,
        (115, event(BEGIN, "sag", 115 * S)),
        (121, event(END, "sag", 121 * S, 118 * S)),
        (190, event(BEGIN, "shock", 190 * S)),
    )
    c = next_start(tmp_path)
    first, second = files(c)
    assert texts(first) == list(range(105, 138))
    assert texts(second) == list(range(180, 200))
    run = reader.read_metadata(first)[RUN_METADATA]
    assert (run["run"], run["clip"]) == ("r", "sag")
    assert run["clip_of"] == f"{files_[1].name}, {files_[2].name}"
    assert "previous_name" not in run
    assert [(a.name, a.data) for a in reader.read_attachments(first)] == [("c", b"x")]
    assert [f.kind for f in c.faults] == ["CLIP", "CLIP"]
    again = next_start(tmp_path, run="r3")
    assert len(files(again)) == 2
    assert list(again.faults) == []
    second.unlink()  # the first one is there; that does not count for the second
    next_start(tmp_path, run="r4")
    assert [texts(path) for path in files(c)] == [list(range(105, 138)), list(range(180, 200))]


def test_a_clip_that_was_written_before_the_kill_is_not_made_again(tmp_path: Path) -> None:
    """Neither where it lies in the folder nor where the run says so and somebody has fetched it; a torn one is."""
    begin = (50, event(BEGIN, "sag", 50 * S))
    end = (55, event(END, "sag", 55 * S, 52 * S))
    name = "site_20231114T221400Z_000.mcap"
    killed(tmp_path / "told", begin, end, (90, told("CLIP", f"{name}: 32.0 s, sag", 90 * S)))
    assert files(next_start(tmp_path / "told")) == []
    killed(tmp_path / "there", begin, end)
    (made_,) = files(next_start(tmp_path / "there"))
    assert made_.name == name
    assert files(next_start(tmp_path / "there", run="r3")) == [made_]
    data = made_.read_bytes()
    made_.unlink()
    made_.with_name(made_.name + ".part").write_bytes(data[: len(data) // 2])
    recover(made_.parent)
    c = next_start(tmp_path / "there", run="r4")
    assert [p.name[-8:] for p in files(c)] == ["000.mcap", "001.mcap"]
    assert texts(files(c)[1]) == list(range(40, 72))


def test_a_clip_is_known_whatever_the_clock_of_the_file_that_it_was_computed_with(tmp_path: Path) -> None:
    """Each file has its own map to UTC: the clip's name comes from the first, the event is over in another."""
    killed(tmp_path, (50, event(BEGIN, "sag", 50 * S)), (55, event(END, "sag", 55 * S, 52 * S)), drift_ns=3 * S // 2)
    (clip,) = files(next_start(tmp_path))
    assert files(next_start(tmp_path, run="r3")) == [clip]
    began = topics.event("CLIP", "clips", "x.mcap: 1 s", (("begin_monotonic_s", 40.0),), 90 * S, 90 * S + OFFSET)
    itself = Record("/faults", 90 * S + OFFSET, 90 * S + OFFSET, began, False)
    begin, end = (50, event(BEGIN, "sag", 50 * S)), (55, event(END, "sag", 55 * S, 52 * S))
    killed(tmp_path / "told", begin, end, (90, itself), drift_ns=3 * S // 2)
    assert files(next_start(tmp_path / "told")) == []


def test_a_clip_of_another_run_with_the_same_second_in_its_name_is_not_mistaken_for_it(tmp_path: Path) -> None:
    """A clock that was set back names two clips alike."""
    begin, end = (50, event(BEGIN, "sag", 50 * S)), (55, event(END, "sag", 55 * S, 52 * S))
    killed(tmp_path / "a", begin, end, run="before")
    (other,) = files(next_start(tmp_path / "a"))
    killed(tmp_path / "b", begin, end)
    (tmp_path / "b" / "clips").mkdir()
    (tmp_path / "b" / "clips" / other.name).write_bytes(other.read_bytes())
    first, second = files(next_start(tmp_path / "b"))
    assert [reader.read_metadata(p)[RUN_METADATA]["run"] for p in (first, second)] == ["before", "r"]


def test_no_clip_is_looked_at_where_no_run_was_torn_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Thousands of clips and files on a slow card: the index of the last file says that its run ended in order."""
    recorded(tmp_path, 100)
    OPEN.pop().close()
    (tmp_path / "clips").mkdir()
    looked: list[Path] = []

    def walked(path: Path, *rest: object) -> Any:
        looked.append(path)
        raise ValueError("walked through")

    for name in ("newest_ns", "read_messages", "read_between"):
        monkeypatch.setattr(clips, name, walked)
    monkeypatch.setattr(clips, "_made", lambda folder, run: walked(folder))
    assert list(clips.left_over(tmp_path, "site", EventSettings(), {}, "r2")) == []
    assert looked == []


def test_a_run_that_was_stopped_and_one_long_ago_leave_nothing(tmp_path: Path) -> None:
    begin = (50, event(BEGIN, "sag", 50 * S))
    killed(tmp_path / "stopped", begin, (199, line(199 * S, "stopped")))
    assert files(next_start(tmp_path / "stopped")) == []
    end = (55, event(END, "sag", 55 * S, 52 * S))
    killed(tmp_path / "old", begin, end, end=600)
    c = next_start(tmp_path / "old", max_s=30.0, before_s=1.0, after_s=1.0)
    assert files(c) == []  # its clip was written long before the end, and has been fetched


def test_faults_of_the_named_kind_are_made_up_for_too(tmp_path: Path) -> None:
    killed(tmp_path, (150, told("PORT_LOST", "gone", 150 * S)), (151, told("SILENT", "", 151 * S)))
    c = next_start(tmp_path, TriggerSettings("pulled", fault="PORT_LOST"))
    (path,) = files(c)
    assert texts(path) == list(range(140, 170))
    assert [f.text.rpartition(", ")[2] for f in c.faults] == ["pulled"]


def test_a_folder_that_cannot_be_read_is_told_and_no_crash(tmp_path: Path) -> None:
    (path, *_) = killed(tmp_path, (50, event(BEGIN, "sag", 50 * S)))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    c = next_start(tmp_path)
    assert [f.kind for f in c.faults] == ["CLIP_FAILED"]


# ----------------------------------------------------------------------------------------------------------------- hook


def hooked(folder: Path, *argv: str, **settings: Any) -> tuple[Clips, Path]:
    c = made(recorded(folder / "rec", 100), hook=argv, **settings)
    c._one(Job(50 * S, 60 * S, ("sag", "shock")))
    return c, files(c)[0]


def test_the_hook_gets_the_clip_and_the_names_and_no_shell_reads_it(tmp_path: Path) -> None:
    code = "import os, sys; open(sys.argv[1], 'w').write(repr((sys.argv[2:], os.environ['EDGE_AGENT_TRIGGERS'])))"
    c, path = hooked(tmp_path, sys.executable, "-c", code, str(tmp_path / "out"), "$(reboot); `x`", hook_s=PATIENCE_S)
    assert (tmp_path / "out").read_text() == repr((["$(reboot); `x`", str(path)], "sag shock"))
    assert [f.kind for f in c.faults] == ["CLIP"]


@pytest.mark.parametrize(
    ("argv", "hook_s", "said"),
    [
        (("/bin/sh", "-c", "exit 3"), PATIENCE_S, "/bin/sh: exit code 3"),
        (("/no/such/program",), PATIENCE_S, "/no/such/program: No such file or directory"),
        (("/bin/true", "a\0b"), PATIENCE_S, "/bin/true: embedded null byte"),
        (("/bin/sh", "-c", "sleep 1000 & sleep 1000"), 0.2, "/bin/sh: killed: it took longer than 0.2 s"),
    ],
)
def test_a_hook_that_fails_or_hangs_is_a_fault(tmp_path: Path, argv: tuple[str, ...], hook_s: float, said: str) -> None:
    c, _ = hooked(tmp_path, *argv, hook_s=hook_s)
    assert [(f.kind, f.text) for f in c.faults][1:] == [("HOOK_FAILED", said)]


def test_a_hook_has_none_of_the_agents_files_and_gives_way_to_it(tmp_path: Path) -> None:
    """It waits until the agent has set its priority, or forever: the agent's patience decides."""
    code = """
import os, sys, time
def mine():
    return os.getpriority(os.PRIO_PROCESS, 0), int(open("/proc/self/oom_score_adj").read())
want = int(sys.argv[2]), int(sys.argv[3])
while mine() != want:
    time.sleep(0.01)
links = [os.readlink(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{n}")]
names = [n for n in os.environ if n in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID")]
open(sys.argv[1], "w").write(repr([x for x in links if "agents-own" in x] + names))
"""
    own = (tmp_path / "agents-own").open("w")
    os.set_inheritable(own.fileno(), True)
    wanted = str(max(os.getpriority(os.PRIO_PROCESS, 0), clips.HOOK_NICE)), str(clips.HOOK_OOM)
    c, _ = hooked(tmp_path, sys.executable, "-c", code, str(tmp_path / "out"), *wanted, hook_s=PATIENCE_S)
    own.close()
    assert [f.kind for f in c.faults] == ["CLIP"]
    assert (tmp_path / "out").read_text() == "[]"


def test_what_a_hook_started_ends_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = f"sleep 1000 & echo $! > {tmp_path}/new; mv {tmp_path}/new {tmp_path}/pid; sleep 1000"

    now = 0.0

    def monotonic() -> float:  # time passes, fast, once the hook has done what the test looks at
        nonlocal now
        now += 1000.0 if (tmp_path / "pid").exists() else 0.0
        return now

    monkeypatch.setattr(clips, "time", SimpleNamespace(monotonic=monotonic, monotonic_ns=time.monotonic_ns))
    c, _ = hooked(tmp_path, "/bin/sh", "-c", code, hook_s=0.5)
    assert [f.kind for f in c.faults] == ["CLIP", "HOOK_FAILED"]
    child = int((tmp_path / "pid").read_text())
    try:
        until(lambda: _state(child) in ("Z", "X", "gone"), "the end of what the hook started")
    except AssertionError:
        os.kill(child, signal.SIGKILL)
        raise


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


def test_an_old_file_that_cannot_be_decoded_is_told_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that another version wrote, met at each start."""
    c = made(recorded(tmp_path / "rec", 100))

    def foreign(*_: object) -> None:
        raise ValueError("a schema of another version")

    monkeypatch.setattr(clips, "left_over", foreign)
    assert c._left() == []
    (fault,) = c.faults
    assert (fault.kind, "another version" in fault.text) == ("CLIP_FAILED", True)
