"""Recordings -> Raw in the order of the file -> the same Pipeline: recompute, verify, retune.

A recording of the agent begins each segment with a checkpoint; the first one is loaded, at the later ones the pipeline
rotates as it did live and its state must be the recorded one. Raw blocks whose order lies before the checkpoint (Ticks
that waited for the first data) are already in it. A recording without checkpoints (import, simulate), or one that is
replayed with other settings, starts from nothing.

`--verify` compares every derived record as (topic, log_time, publish_time, bytes). Missing is allowed where a LOSS on
`/faults` covers it and behind the last raw block of a file that was cut. On another platform than the recording's,
numbers may differ by 1e-3 of the published sd. After raw blocks that were lost behind `step` nothing can be said up to
the next checkpoint.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from edge_agent import assemble, config
from edge_agent import messages as m
from edge_agent.pipeline import Pipeline
from edge_agent.recording import topics
from edge_agent.recording.reader import MAGIC, Stored, count, read_attachments, read_messages, read_metadata
from edge_agent.recording.writer import PART, RUN_METADATA, SegmentWriter, fsync_folder

CHECKPOINT = "/raw/checkpoint"
CONFIG_NAME = "config.yaml"
DERIVED = ("/gnss/", "/accel/", "/fusion/", "/events")
TOLERANCE_SD = 1e-3
ROUNDING = 2.0**-22  # of recorded velocities; displacements are finer
NAMED = 20
FINAL = 2
"""Revision of a smoothed stream that knows the whole record."""


class ReplayError(ValueError):
    """These inputs cannot be replayed as asked; the text says why and what would be right."""


@dataclass
class Report:
    """What a replay did. Counts are records but for `raws` and `segments`."""

    segments: int = 0
    raws: int = 0
    derived: int = 0  # computed
    compared: int = 0  # found equal
    close: int = 0  # other platform: within the tolerance
    differing: int = 0
    missing: int = 0
    missing_allowed: int = 0  # covered by a LOSS, or behind the cut
    unexpected: int = 0  # recorded, not computed
    state_differs: int = 0  # checkpoints
    raw_gaps: int = 0
    unverifiable: int = 0
    verify: bool = False
    same_platform: bool = True
    output: str = ""
    notes: list[str] = field(default_factory=list)
    topics: dict[str, int] = field(default_factory=dict)  # derived records computed

    @property
    def ok(self) -> bool:
        return not (self.differing or self.missing or self.unexpected or self.state_differs)

    def note(self, text: str) -> None:
        if len(self.notes) < NAMED:
            self.notes.append(text)

    def __str__(self) -> str:
        lines = [f"{self.segments} segments, {self.raws} raw blocks -> {self.derived} derived records"]
        if self.output:
            lines.append(f"written to {self.output}")
        if self.verify:
            found = f"verify: {self.compared} equal, {self.differing} differing, {self.missing} missing"
            found += f" ({self.missing_allowed} more allowed), {self.unexpected} unexpected"
            if not self.same_platform:
                found += f", {self.close} within {TOLERANCE_SD:g} sd on another platform"
            lines.append(f"{found}; {self.state_differs} checkpoints differ")
            if self.unverifiable:
                lines.append(f"not verifiable: {self.unverifiable} records behind {self.raw_gaps} gaps in the raw data")
            lines.append("verify: " + ("good" if self.ok else "NOT equal"))
        return "\n".join([*lines, *self.notes])


def replay(
    inputs: Sequence[Path], output: Path | None, settings: m.Config | None, verify: bool, *, fresh: bool = False
) -> Report:
    """Replay `inputs` (files or folders) in order of time; write raw and derived records to `output` (one MCAP file).

    `settings` None = the configuration in the recording. `fresh`: recorded states are not taken over, also where the
    settings are those of the recording. Raises ReplayError, OSError, reader.DamagedError.
    """
    files = in_order(inputs)
    used = settings or recorded_config(files[0])
    return _Replay(files, used, verify, fresh).run(output)


def in_order(inputs: Sequence[Path]) -> list[Path]:
    """Recordings among `inputs`, folders expanded: runs by their first message, files of a run by their number.

    Not by log time alone: a clock that was set back would put later files of a run first.
    """
    found: list[tuple[int, str, int, Path]] = []
    for path in inputs:
        if path.is_dir():
            names = [p for p in sorted(path.iterdir()) if p.name.endswith((".mcap", ".mcap" + PART))]
        else:
            names = [path]
        for p in names:
            first = None if p.stat().st_size == 0 else next(read_messages(p), None)  # empty: killed as it was made
            if first is not None:
                run = read_metadata(p).get(RUN_METADATA, {})
                found.append((first.log_ns, run.get("run", ""), count(run.get("segment", "")), p))
    if not found:
        raise ReplayError(f"no recording with messages in {', '.join(map(str, inputs)) or 'nothing'}")
    begin: dict[str, int] = {}
    for log_ns, run_id, _, _ in found:
        begin[run_id] = min(log_ns, begin.get(run_id, log_ns))
    found.sort(key=lambda f: (begin[f[1]], f[1], f[2], f[3].name) if f[1] else (f[0], "", 0, f[3].name))
    return [p for _, _, _, p in found]


def recorded_config(path: Path, sets: Sequence[str] = ()) -> m.Config:
    """The configuration that is attached to a recording, with `path=value` overrides. ReplayError without one."""
    files = {a.name: a.data for a in read_attachments(path)}
    if CONFIG_NAME not in files:
        raise ReplayError(f"{path} holds no {CONFIG_NAME}: give one with -c")

    def read(name: str) -> bytes:
        if name not in files:
            raise FileNotFoundError(2, "not attached to the recording", name)
        return files[name]

    return config.parse(files[CONFIG_NAME].decode(), Path(), read, sets)


class _Replay:
    def __init__(self, files: list[Path], settings: m.Config, verify: bool, forget: bool = False) -> None:
        self.files, self.settings, self.forget = files, settings, forget
        self.report = Report(verify=verify)
        self.pipeline: Pipeline = assemble.pipeline(settings)
        self.fresh = True  # nothing has been stepped
        self.new_run = False  # the file begins another run than the one before: its state is its own
        self.opened = False  # the output has its first checkpoint
        self.blind = False  # raw blocks were lost: nothing can be compared up to the next checkpoint
        self.own_state = False  # started from nothing: recorded checkpoints say nothing about this pipeline
        self.head: list[m.Record] = []
        self.mine: dict[str, deque[m.Record]] = {}
        self.theirs: dict[str, deque[Stored]] = {}
        self.missed: list[tuple[str, int]] = []
        self.losses: list[tuple[str, int, int]] = []
        self.writer: SegmentWriter | None = None

    def run(self, output: Path | None) -> Report:
        if output is None:
            self._all()
        else:
            part = output.with_name(output.name + PART)
            metadata = dict(read_metadata(self.files[0]).get(RUN_METADATA, {}))
            for key in ("previous_name", "previous_sha256"):  # of the input; the output follows nobody
                metadata.pop(key, None)
            metadata["platform"] = assemble.platform_name()
            metadata["replayed_from"] = ", ".join(p.name for p in self.files)
            attachments = {CONFIG_NAME: self.settings.text.encode(), **dict(self.settings.files)}
            self.writer = SegmentWriter(part, metadata=metadata, attachments=attachments)
            try:
                self._all()
                self.writer.close()
            except BaseException:
                self.writer.abandon()
                part.unlink(missing_ok=True)
                raise
            if part.exists():  # a writer may have renamed it itself
                part.replace(output)
            fsync_folder(output.parent)
            self.report.output = str(output)
        for topic, log_ns in self.missed:
            if any(t == topic and a <= log_ns <= b for t, a, b in self.losses):
                self.report.missing_allowed += 1
            else:
                self.report.missing += 1
                self.report.note(f"missing: {topic} at log_time {log_ns}")
        return self.report

    def _all(self) -> None:
        runs = [read_metadata(path).get(RUN_METADATA, {}) for path in self.files]
        ids = [run.get("run") for run in runs]
        for i, path in enumerate(self.files):
            self.report.segments += 1
            here = runs[i].get("platform", "")
            self.report.same_platform &= not here or here == assemble.platform_name()
            self.new_run = i > 0 and ids[i] != ids[i - 1]
            last_raw_log = self._segment(path)
            if not ended(path):
                self.report.note(f"{path.name} was torn or is being written: what it holds up to there was replayed")
            if i + 1 == len(self.files) or ids[i + 1] != ids[i]:
                self._out(self.pipeline.finish())
            self._settle(last_raw_log)

    def _segment(self, path: Path) -> int:
        """Step through one file; return the log_time of its last raw block."""
        last = 0
        for stored in read_messages(path):
            if stored.topic == CHECKPOINT:
                self._checkpoint(stored, path)
            elif stored.topic.startswith(topics.RAW_PREFIX):
                self._raw(topics.decode_raw(stored.topic, stored.schema, stored.data))
                last = stored.log_ns
            elif stored.topic.startswith(DERIVED):
                self._compare(stored)
            elif stored.topic == "/faults":
                self._loss(stored)
        return last

    def _checkpoint(self, stored: Stored, path: Path) -> None:
        point = topics.decode_checkpoint(stored.data)
        self._settle(None)
        another = self.new_run or point.order < self.pipeline.order
        goes_on = not self.fresh and not another and point.order == self.pipeline.order
        self.new_run = False
        if goes_on and (self.own_state or not self.blind):
            rotate = self.pipeline.rotate(point.reason, point.monotonic_ns)
            if not self.own_state and topics.decode_checkpoint(rotate.checkpoint.data).state != point.state:
                self.report.state_differs += 1
                self.report.note(f"{path.name}: the state at its checkpoint is not the one that replay reached")
            self._write(rotate.checkpoint)
            return
        if not self.fresh and not another:
            self.report.note(f"{path.name}: segments of this run are missing before it")
        if not self.fresh:  # another run, or segments are missing between
            self.pipeline = assemble.pipeline(self.settings)
        self.blind = False
        try:
            if self.forget:
                raise ValueError("recorded states are not asked for")
            self.pipeline.load(point.state)
            self.own_state = False
        except ValueError as e:
            if self.report.verify:
                raise ReplayError(f"{path}: {e}; --verify needs the settings of the recording") from None
            self.pipeline = assemble.pipeline(self.settings)
            self.own_state, self.fresh, self.opened = True, True, False
            return
        self.fresh, self.opened = False, True
        self._write(m.Record(CHECKPOINT, stored.log_ns, stored.publish_ns, stored.data, False))

    def _raw(self, raw: m.Raw) -> None:
        if raw.order < self.pipeline.order and not self.own_state:
            return  # already in the checkpoint
        if raw.order > self.pipeline.order and not self.fresh:
            self.report.raw_gaps += 1
            self.blind = True
            # what the lost block caused, as far as recorded
            self.report.unverifiable += sum(len(q) for q in self.mine.values())
            self.report.unverifiable += sum(len(q) for q in self.theirs.values())
            self.mine.clear()
            self.theirs.clear()
            self.report.note(f"raw blocks {self.pipeline.order}..{raw.order - 1} are not in the recording")
        self.fresh = False
        self.report.raws += 1
        tick = isinstance(raw.payload, m.Tick)
        if not self.opened and not tick:
            self._begin("replay", raw.t_ns)
        elif self.own_state and self.opened and self.pipeline.rotate_due:
            self._begin(self.pipeline.rotate_due, raw.t_ns)
        self._out(self.pipeline.step(raw))

    def _begin(self, reason: str, t_ns: int) -> None:
        self._write(self.pipeline.rotate(reason, t_ns).checkpoint)
        self.opened = True
        for held in self.head:
            self._write(held)
        self.head = []

    def _out(self, records: list[m.Record]) -> None:
        for record in records:
            if not self.opened:
                self.head += [] if record.derived else [record]
                continue
            self._write(record)
            if not record.derived:
                continue
            self.report.derived += 1
            self.report.topics[record.topic] = self.report.topics.get(record.topic, 0) + 1
            if self.report.verify:
                if self.blind:
                    self.report.unverifiable += 1
                else:
                    self.mine.setdefault(record.topic, deque()).append(record)

    def _write(self, record: m.Record) -> None:
        if self.writer is not None:
            self.writer.add(record)

    # -------------------------------------------------------------------------------------------------------- verify

    def _compare(self, stored: Stored) -> None:
        if not self.report.verify or self.blind:
            return
        if stored.topic.endswith("/smoothed") and topics.decode_fused_block("", stored.data).revision == FINAL:
            return  # made from the whole record by `--smooth`, not by `step`
        self.theirs.setdefault(stored.topic, deque()).append(stored)
        self._match(stored.topic)

    def _match(self, topic: str) -> None:
        mine, theirs = self.mine.setdefault(topic, deque()), self.theirs[topic]
        while mine and theirs:
            a, b = mine[0], theirs[0]
            here, there = (a.log_ns, a.publish_ns), (b.log_ns, b.publish_ns)
            if here == there:
                mine.popleft()
                theirs.popleft()
                self._judge(a, b)
            elif here < there:
                mine.popleft()
                self.missed.append((topic, a.log_ns))
            else:
                theirs.popleft()
                self._unexpected(b)

    def _judge(self, a: m.Record, b: Stored) -> None:
        if a.data == b.data:
            self.report.compared += 1
        elif not self.report.same_platform and close(b.schema, a.data, b.data):
            self.report.close += 1
        else:
            self.report.differing += 1
            self.report.note(f"differs: {a.topic} at log_time {a.log_ns}")

    def _unexpected(self, stored: Stored) -> None:
        self.report.unexpected += 1
        self.report.note(f"unexpected: {stored.topic} at log_time {stored.log_ns} is recorded, not computed")

    def _settle(self, last_raw_log: int | None) -> None:
        """At the border of a segment or the end of a file: what has no partner by now never will have."""
        for topic in list(self.theirs):  # what `finish` gave found no record that came after it
            self._match(topic)
        for topic, mine in self.mine.items():
            for a in mine:
                if last_raw_log is not None and a.log_ns >= last_raw_log:
                    self.report.missing_allowed += 1
                else:
                    self.missed.append((topic, a.log_ns))
            mine.clear()
        for theirs in self.theirs.values():
            for b in theirs:
                self._unexpected(b)
            theirs.clear()

    def _loss(self, stored: Stored) -> None:
        if not self.report.verify:
            return
        event = topics.decode(stored.schema, stored.data)
        if event["kind"] == "LOSS":
            begin, end = (event[k]["sec"] * m.S + event[k]["nanosec"] for k in ("begin", "end"))
            self.losses.append((event["source"], begin, end))


def ended(path: Path) -> bool:
    """Whether a file has its footer."""
    with open(path, "rb") as f:
        f.seek(-len(MAGIC), 2)
        return f.read() == MAGIC


def close(schema: str, a: bytes, b: bytes) -> bool:
    """Another platform's record: numbers that have an sd of their own (`std_<name>`) within 1e-3 of it, the others
    within 0.2 % (sd are recorded with 10 bits); everything else the same."""
    x, y = dict(_leaves("", topics.decode(schema, a))), dict(_leaves("", topics.decode(schema, b)))
    return x.keys() == y.keys() and all(_near(x[k], y[k], y.get(f".std_{k[1:]}")) for k in x)


def _near(u: object, v: object, sd: object) -> bool:
    if not (isinstance(u, float) and isinstance(v, float)):
        return u == v
    if u == v or (math.isnan(u) and math.isnan(v)):
        return True
    allowed = TOLERANCE_SD * sd + ROUNDING if isinstance(sd, float) else 2e-3 * abs(v)
    return abs(u - v) <= allowed


def _leaves(path: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for k, v in value.items():
            yield from _leaves(f"{path}.{k}", v)
    elif hasattr(value, "tolist"):
        yield from _leaves(path, value.tolist())
    elif isinstance(value, (list, tuple)):
        for i, v in enumerate(value):
            yield from _leaves(f"{path}[{i}]", v)
    else:
        yield path, value
