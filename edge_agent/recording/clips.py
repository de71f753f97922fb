"""Event clips: the minutes around an event as a file of their own that retention does not touch.

`Watch` collects triggers and faults into intervals: from `before_s` before the first to `after_s` after the last of
those that overlap, at most `max_s`. `Clips` is a thread that copies all records of an interval, raw and fused at full
rate, from the segments (the open one too) to `clips/` in the data folder, and then runs the hook. Nothing is held in
memory for it: what a clip needs is on the disk already. A clip is cut out by monotonic time, which each segment's
checkpoint ties to its UTC, so a clock that steps meanwhile does no harm.

A clip's metadata names its triggers and the segments that it was taken from. Those replay byte for byte; a clip begins
amid a segment, without a checkpoint, so `replay` computes it anew from its raw data.

A run that ended without an orderly stop (a kill, a power cut) may have left events without their clip. The next start
finds them in the last files before it, as the dead run's own Watch would have, and makes up for them. A clip is known
by its run and its monotonic begin, for the UTC in its name depends on the file that it was computed with.

Retention never deletes clips; beyond `clips_gb` new ones are refused, and a fault says so (the segments still hold the
data). The hook is run without a shell, in a process group of its own that is killed after `hook_s`; it holds none of
the agent's files, gives way to the agent where the processor is short, and is the first to go where memory is.
"""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from edge_agent.messages import MS, EventSettings, Fault, Record, S, TriggerSettings
from edge_agent.recording import topics
from edge_agent.recording.reader import (
    Stored,
    count,
    has_metadata,
    head_metadata,
    newest_ns,
    read_attachments,
    read_between,
    read_messages,
)
from edge_agent.recording.repair import REPAIRED_METADATA
from edge_agent.recording.segments import Recorder, list_segments
from edge_agent.recording.writer import PART, RUN_METADATA, TIME_MAX, SegmentWriter
from edge_agent.triggers import BEGIN, END

FOLDER = "clips"
RUNS_BACK, FILES_BACK = 3, 64
"""Runs and files before this one that are looked at for events without a clip: a power that comes and goes makes short
runs."""
JOBS = 16
"""Clips that wait to be written; one more is refused and told."""
HOOK_NICE = 10
HOOK_OOM = 500
"""Score by which the kernel chooses whom to kill for memory; the service's own is -500."""
OF_A_SEGMENT = ("segment", "opened_because", "previous_name", "previous_sha256")
"""What a file's metadata say of its place among the others, which a clip has not."""
BEGIN_KEY = "clip_begin_monotonic_ns"
"""Of a clip's metadata."""
PATIENCE_S = 30.0
"""How long a clip waits for its last records to reach the disk."""


@dataclass(frozen=True, slots=True)
class Job:
    """An interval to be kept, monotonic, and what asked for it."""

    begin_ns: int
    end_ns: int
    names: tuple[str, ...]
    files: tuple[Path, ...] = ()  # of an earlier run that hold it; () = this run's


class Watch:
    """Which interval is to be kept. Times are monotonic and need not be in order."""

    def __init__(self, settings: EventSettings) -> None:
        self._before = int(settings.before_s * S)
        self._after = int(settings.after_s * S)
        self._most = int(settings.max_s * S)
        self._active: set[str] = set()
        self._names: list[str] = []
        self._begin = self._end = 0
        self._kept = 0  # end of the last clip: the next does not hold the same again

    def begin(self, name: str, t_ns: int) -> None:
        """An event begins."""
        self._active.add(name)
        self._extend(name, t_ns)

    def end(self, name: str, t_ns: int) -> None:
        """It is over; `t_ns`: when it last was."""
        if name in self._active:
            self._active.discard(name)
            self._extend(name, t_ns)

    def moment(self, name: str, t_ns: int) -> None:
        """Something that has no length."""
        self._extend(name, t_ns)

    def _extend(self, name: str, t_ns: int) -> None:
        begin, end = max(t_ns - self._before, self._kept), t_ns + self._after
        if end <= self._kept:
            return  # told late: the last clip holds all of it
        if not self._names:
            self._begin, self._end = begin, end
        self._begin, self._end = min(self._begin, begin), max(self._end, end)
        if name not in self._names:
            self._names.append(name)

    def due(self, now_ns: int) -> Job | None:
        """The interval, once nothing can be added to it."""
        if not self._names:
            return None
        if self._active:
            self._end = max(self._end, now_ns)
        full = self._end - self._begin >= self._most
        if not full and (self._active or now_ns < self._end + self._before):  # an overlapping one may still begin
            return None
        if full and now_ns < self._begin + self._most:
            return None
        return self._job(min(self._end, self._begin + self._most))

    def rest(self, now_ns: int) -> Job | None:
        """The interval as far as it has come: the agent ends."""
        return self._job(min(self._end, now_ns)) if self._names else None

    def _job(self, end_ns: int) -> Job:
        job = Job(self._begin, end_ns, tuple(self._names))
        self._names = []
        self._active.clear()  # of one that goes on beyond the longest clip, the segments hold the rest
        self._kept = end_ns
        return job


class Clips(threading.Thread):
    """Writes clips and runs the hook, one after the other. Main tells it what happens; nothing there waits."""

    def __init__(self, recorder: Recorder, settings: EventSettings, triggers: Iterable[TriggerSettings]) -> None:
        super().__init__(name="clips", daemon=True)
        self.recorder, self.settings = recorder, settings
        self.folder = recorder.data_dir / FOLDER
        self.faults: deque[Fault] = deque()
        self.failure: BaseException | None = None
        self.stopping = threading.Event()
        self._watch = Watch(settings)
        self._jobs: queue.Queue[Job | None] = queue.Queue(JOBS + 1)
        self._of_fault: dict[str, list[str]] = {}
        for t in triggers:
            if t.fault is not None:
                self._of_fault.setdefault(t.fault, []).append(t.name)

    def saw(self, record: Record, offset_ns: int) -> None:
        """A record on /events; `offset_ns` = UTC - monotonic of the open segment."""
        take(self._watch, topics.decode(topics.EVENT, record.data), offset_ns)

    def fault(self, kind: str, t_ns: int) -> None:
        """A fault of that kind, monotonic."""
        for name in self._of_fault.get(kind, ()):
            self._watch.moment(name, t_ns)

    def every_second(self, now_ns: int) -> None:
        """Begin with what is due."""
        if job := self._watch.due(now_ns):
            self._offer(job)

    def close(self, now_ns: int) -> None:
        """The agent ends and its files are closed: what is open or waiting is still written, without hooks."""
        if job := self._watch.rest(now_ns):
            self._offer(job)
        self.stopping.set()
        self._jobs.put(None)

    def _offer(self, job: Job) -> None:
        if self._jobs.qsize() >= JOBS:
            self._tell("CLIP_REFUSED", f"{', '.join(job.names)}: {JOBS} clips are waiting; the segments hold the data")
            return
        self._jobs.put_nowait(job)

    def run(self) -> None:
        try:
            for left in self._left():
                self._one(left)
            while (job := self._jobs.get()) is not None:
                self._one(job)
        except BaseException as e:  # noqa: BLE001 - main raises it and ends the process
            self.failure = e

    def _left(self) -> list[Job]:
        """Intervals of earlier runs that have no clip."""
        run = self.recorder.metadata.get("run", "")
        try:
            return [*left_over(self.recorder.data_dir, self.recorder.site, self.settings, self._of_fault, run)]
        except FileNotFoundError:  # no folder yet
            return []
        except (OSError, ValueError, OverflowError) as e:
            self._tell("CLIP_FAILED", f"what was before the start cannot be read: {e}")
            return []

    def _one(self, job: Job) -> None:
        if not job.files:
            self._wait_for(job)
        try:
            made = self._write(job)
            if made is None:
                return
            path, seconds = made
            size = path.stat().st_size
        except (OSError, ValueError, OverflowError) as e:
            self._tell("CLIP_FAILED", f"{', '.join(job.names)}: {e}; the segments hold the data")
            return
        values = (("seconds", seconds), ("bytes", float(size)), ("begin_monotonic_s", job.begin_ns / S))
        self._tell("CLIP", f"{path.name}: {seconds:.1f} s, {', '.join(job.names)}", values)
        if self.settings.hook and not self.stopping.is_set() and (said := self._hook(path, job)):
            self._tell("HOOK_FAILED", f"{self.settings.hook[0]}: {said}")

    def _tell(self, kind: str, text: str, values: tuple[tuple[str, float], ...] = ()) -> None:
        self.faults.append(Fault(time.monotonic_ns(), "clips", kind, text, values))

    # ----------------------------------------------------------------------------------------------------------- files

    def _wait_for(self, job: Job) -> None:
        """Until the segments hold the end of the interval; not for ever: the disk may refuse."""
        end = time.monotonic() + PATIENCE_S
        while time.monotonic() < end and not self.stopping.is_set():
            newest = next(_sources(self.recorder.recent, job.end_ns, TIME_MAX), None)
            with suppress(OSError, ValueError, OverflowError):  # it has just been renamed: the next look finds it
                if newest is not None and newest_ns(newest[0]) - newest[1] >= job.end_ns:
                    return
            self.stopping.wait(self.recorder.settings.flush_s)

    def _write(self, job: Job) -> tuple[Path, float] | None:
        """The clip and how many seconds are in it: fewer than asked for where the agent began later, or the disk has
        not got all of it."""
        sources = [*_sources(job.files or self.recorder.recent, job.begin_ns, job.end_ns)][::-1]
        if not sources:
            self._tell("CLIP_FAILED", f"{', '.join(job.names)}: no segment holds it")
            return None
        self.folder.mkdir(parents=True, exist_ok=True)
        held = sum(p.stat().st_size for p in self.folder.iterdir())
        if held >= self.settings.clips_gb * 1e9:
            text = f"{FOLDER}/ holds {held / 1e9:.3g} GB of {self.settings.clips_gb:g}: move clips away"
            self._tell("CLIPS_FULL", f"{', '.join(job.names)}: no clip was written, {text}")
            return None
        utc_ns = max(0, job.begin_ns + sources[0][1])
        run, attachments = self.recorder.metadata, self.recorder.attachments
        if job.files:
            told = head_metadata(sources[-1][0], RUN_METADATA)
            run = {k: v for k, v in told.items() if k not in OF_A_SEGMENT}
            attachments = {a.name: a.data for a in read_attachments(sources[-1][0])}
        metadata = {
            **run,
            "site": self.recorder.site,
            "clip": ", ".join(job.names),
            BEGIN_KEY: str(job.begin_ns),
            "clip_of": ", ".join(path.name.removesuffix(PART) for path, _ in sources),
        }
        part = self._free_name(utc_ns)
        writer = SegmentWriter(part, metadata=metadata, attachments=attachments, utc_ns=utc_ns)
        first, last = job.end_ns, job.begin_ns
        try:
            for path, offset in sources:
                for s in _between(path, job.begin_ns + offset, job.end_ns + offset):
                    writer.add(Record(s.topic, s.log_ns, s.publish_ns, s.data, False, s.schema))
                    first, last = min(first, s.log_ns - offset), max(last, s.log_ns - offset)
            return writer.close(), max(0, last - first) / S
        except (OSError, ValueError, OverflowError):
            writer.abandon()
            with suppress(OSError):
                part.unlink()  # a copy of what the segments hold
            raise

    def _free_name(self, utc_ns: int) -> Path:
        stem = _stem(self.recorder.site, utc_ns)
        taken = [path.name for path in self.folder.iterdir()]
        number = 0
        while any(name.startswith(f"{stem}_{number:03d}.mcap") for name in taken):
            number += 1
        return self.folder / f"{stem}_{number:03d}.mcap{PART}"

    # ------------------------------------------------------------------------------------------------------------ hook

    def _hook(self, path: Path, job: Job) -> str:
        """Run the hook with the clip's path behind its arguments; what went wrong, "" if nothing did."""
        argv = [*(self.settings.hook or ()), str(path)]
        environment = {**os.environ, "EDGE_AGENT_TRIGGERS": " ".join(job.names)}
        for name in ("NOTIFY_SOCKET", "WATCHDOG_USEC", "WATCHDOG_PID"):  # the hook does not speak for the service
            environment.pop(name, None)
        try:
            process = subprocess.Popen(
                argv, stdin=subprocess.DEVNULL, env=environment, start_new_session=True, close_fds=True
            )
        except (OSError, ValueError) as e:  # a NUL in an argument
            return str(getattr(e, "strerror", None) or e)
        with suppress(OSError):  # not what keeps the service alive when memory or time are short
            nice = max(HOOK_NICE, os.getpriority(os.PRIO_PROCESS, process.pid))
            os.setpriority(os.PRIO_PROCESS, process.pid, nice)
        with suppress(OSError):
            Path(f"/proc/{process.pid}/oom_score_adj").write_text(str(HOOK_OOM))
        end = time.monotonic() + self.settings.hook_s
        while process.poll() is None and time.monotonic() < end and not self.stopping.is_set():
            self.stopping.wait(0.05)
        if process.poll() is None:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            return f"killed: it took longer than {self.settings.hook_s:g} s" if not self.stopping.is_set() else ""
        return f"exit code {process.returncode}" if process.returncode else ""


def _stem(site: str, utc_ns: int) -> str:
    return f"{site}_{datetime.fromtimestamp(utc_ns // S, UTC):%Y%m%dT%H%M%SZ}"


def left_over(
    data_dir: Path, site: str, settings: EventSettings, of_fault: Mapping[str, Sequence[str]], run: str
) -> Iterator[Job]:
    """Intervals in the last files of runs before `run` for which there should be a clip and is none. Only a run whose
    last file was torn can have left any, and only of its last minutes: a clip is written as soon as nothing can be
    added to it. OSError, ValueError for a file that another version wrote or that is damaged."""
    lookback = int(2 * (settings.before_s + settings.max_s + settings.after_s + PATIENCE_S) * S)
    runs: dict[str, list[Path]] = {}
    oldest: dict[str, int] = {}  # run -> UTC before which nothing of it is looked at
    for segment in reversed(list_segments(data_dir, site)[-FILES_BACK:]):
        if segment.path.suffix != ".mcap":
            continue
        try:
            name = head_metadata(segment.path, RUN_METADATA).get("run", "")
            if name == run or (len(runs) == RUNS_BACK and name not in runs) or oldest.get(name) == TIME_MAX:
                continue
            if name not in runs and _is_whole(segment.path):
                runs[name], oldest[name] = [], TIME_MAX  # this run ended in order
                continue
            end_ns = newest_ns(segment.path)
        except (OSError, ValueError, OverflowError):  # retention was quicker; the others may hold something
            continue
        if end_ns >= oldest.setdefault(name, end_ns - lookback):
            runs.setdefault(name, []).insert(0, segment.path)
    for name, files in reversed(runs.items()):
        if files and (missing := _asked_for(tuple(files), site, settings, of_fault)):
            made = _made(data_dir / FOLDER, name)  # thousands of files on a slow card: only where it matters
            for job, stems in missing:
                if not _is_among(made, job, stems):
                    yield job


def _made(folder: Path, run: str) -> list[tuple[str, float | None]]:
    """Name and monotonic begin [ns] of a run's clips that are whole; None = written before clips said it."""
    found: list[tuple[str, float | None]] = []
    for path in folder.glob("*.mcap"):
        with suppress(OSError, ValueError, OverflowError):  # moved away meanwhile, or damaged
            told = head_metadata(path, RUN_METADATA)
            if told.get("run", "") == run and _is_whole(path):
                found.append((path.name, count(told[BEGIN_KEY]) if BEGIN_KEY in told else None))
    return found


def _is_among(clips: Iterable[tuple[str, float | None]], job: Job, stems: tuple[str, ...]) -> bool:
    """Whether one of a run's clips is that of the job."""
    return any(
        name.startswith(stems) if begin_ns is None else abs(begin_ns - job.begin_ns) < MS for name, begin_ns in clips
    )


def _is_whole(path: Path) -> bool:
    """Whether a recording was finished by the run that wrote it."""
    try:
        return not has_metadata(path, REPAIRED_METADATA)
    except (OSError, ValueError, OverflowError):
        return False


def _asked_for(
    files: tuple[Path, ...], site: str, settings: EventSettings, of_fault: Mapping[str, Sequence[str]]
) -> list[tuple[Job, tuple[str, ...]]]:
    """What a run's own Watch would have asked for, as far as the run does not say that it has written it; each with the
    begins of names that its clip can have."""
    watch = Watch(settings)
    found: list[Job] = []
    offset = now_ns = 0
    offsets: dict[int, None] = {}  # UTC - monotonic of each file
    told: list[tuple[str, float | None]] = []  # clips that the run says it has written
    stopped = False
    for path in files:
        for s in read_messages(path, {topics.CHECKPOINT_TOPIC, "/events", "/faults", "/rosout"}):
            if s.topic == topics.CHECKPOINT_TOPIC:
                point = topics.decode_checkpoint(s.data)
                offset, now_ns = point.utc_ns - point.monotonic_ns, max(now_ns, point.monotonic_ns)
                offsets[offset] = None
                continue
            message = topics.decode(s.schema, s.data)
            now_ns = max(now_ns, s.log_ns - offset)
            if s.topic == "/rosout":
                stopped = message["msg"] == "stopped"
                continue
            if job := watch.due(now_ns):
                found.append(job)
            if s.topic == "/events":
                take(watch, message, offset)
            elif message["kind"] == "CLIP":
                begin_s = next((v["value"] for v in message["values"] if v["name"] == "begin_monotonic_s"), None)
                told.append((message["text"], None if begin_s is None else begin_s * S))
            else:
                for name in of_fault.get(message["kind"], ()):
                    watch.moment(name, message["monotonic_ns"])
    if stopped:
        return []
    now_ns = max(now_ns, newest_ns(files[-1]) - offset) + 1  # an end is exclusive
    found += [job for job in (watch.due(now_ns), watch.rest(now_ns)) if job is not None]
    asked = []
    for job in found:
        stems = tuple(_stem(site, max(0, job.begin_ns + of)) for of in offsets)
        if not _is_among(told, job, stems):
            asked.append((Job(job.begin_ns, job.end_ns, job.names, files), stems))
    return asked


def take(watch: Watch, event: Mapping[str, Any], offset_ns: int) -> None:
    """An event of /events; `offset_ns` = UTC - monotonic of its segment."""
    if event["kind"] == BEGIN:
        watch.begin(event["source"], event["monotonic_ns"])
    elif event["kind"] == END:
        watch.end(event["source"], event["end"]["sec"] * S + event["end"]["nanosec"] - offset_ns)


def _between(path: Path, begin_ns: int, end_ns: int) -> Iterator[Stored]:
    """`read_between` of a file that may have got its final name meanwhile."""
    try:
        yield from read_between(path, begin_ns, end_ns)
    except FileNotFoundError:  # before the first message: what is open stays readable
        if not path.name.endswith(PART):
            raise
        yield from read_between(path.with_name(path.name.removesuffix(PART)), begin_ns, end_ns)


def _sources(recent: Sequence[Path], begin_ns: int, end_ns: int) -> Iterator[tuple[Path, int]]:
    """The run's files that begin before `end_ns`, from the newest back to the one that holds `begin_ns`, with UTC -
    monotonic of each."""
    for final in reversed(recent):
        for path in (final, final.with_name(final.name + PART)):
            try:
                first = next(read_messages(path, {topics.CHECKPOINT_TOPIC}), None)
            except (OSError, ValueError, OverflowError):  # retention was quicker, or it has just been renamed
                continue
            if first is None:
                continue
            point = topics.decode_checkpoint(first.data)
            if point.monotonic_ns < end_ns:
                yield path, point.utc_ns - point.monotonic_ns
            if point.monotonic_ns <= begin_ns:
                return
            break
