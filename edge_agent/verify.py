"""`edge-agent verify`: is everything there, is it as it was written, and what is missing for which reason.

Each file names the one before it and that file's SHA-256; so a chain of files shows a file that was altered, taken out
or put in. The past may be gone (retention deletes the oldest) and is then said, not held against the folder. Data is
missing where raw blocks are: between two runs, where the order of raw blocks jumps, where a LOSS on `/faults` tells
it, and where a port said nothing for `SILENT_S`. Each such gap gets the reason that the recording gives:

stop        the agent was stopped in order
kill        its process was killed: the file was torn, the machine ran on
power       the file was torn and the machine was started anew: power cut or reset
crash       the program ended by an error of its own
disk        the disk refused and the memory for that time was full
overload    a queue was full, or the kernel's
port lost   the device was away
stall       the agent itself stood still (SIGSTOP, a machine at its end): what devices sent meanwhile may be gone
silent      the port was open and nothing came
missing     a file of the run is not here
damaged     it stood in a file that is damaged or cut off
unknown     nothing in the recording explains it

Event clips (`clips/` in a folder) are read too: each must be whole and as it was written; they have no chain.

Left out: whether the derived records follow from the raw ones (`replay --verify`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

from edge_agent.cat import iso
from edge_agent.messages import S
from edge_agent.recording import reader, topics
from edge_agent.recording.repair import DAMAGED, REPAIRED_METADATA
from edge_agent.recording.writer import PART, RUN_METADATA

CLIPS = "clips"  # the folder of event clips, in the data folder
SILENT_S = 5.0  # as the agent itself calls a port silent
JOIN_NS = 2 * S  # losses of one reason that lie closer are one gap: a LOSS is told once a second
EXPLAINED = ("stop", "kill", "power", "crash", "disk", "overload", "port lost", "stall", "silent")
COSTS = ("kill", "power", "crash", "disk", "overload", "stall")  # reasons for which raw data was lost that had come


@dataclass(frozen=True, slots=True)
class Gap:
    """Raw data is missing from `begin_ns` to `end_ns` (UTC) at `source`, a port or "all"."""

    begin_ns: int
    end_ns: int
    source: str
    reason: str
    text: str


@dataclass
class File:
    """What one file says. Times are UTC ns; 0 = none."""

    path: Path
    size: int = 0
    sha256: str = ""
    run: dict[str, str] = field(default_factory=dict)
    state: str = "complete"  # complete, repaired, open (no index: being written or torn), damaged, unreadable
    damage: str = ""
    lost_bytes: int = 0  # of a repaired file
    messages: int = 0
    begin_ns: int = 0
    end_ns: int = 0
    order: int = -1  # of its checkpoint
    last_order: int = -1
    raws: dict[str, int] = field(default_factory=dict)  # blocks by port
    first_ns: dict[str, int] = field(default_factory=dict)  # of the first block by port
    last_ns: dict[str, int] = field(default_factory=dict)
    jumps: list[tuple[int, int, int]] = field(default_factory=list)  # begin, end, blocks missing
    quiet: list[tuple[str, int, int]] = field(default_factory=list)  # port, begin, end
    losses: list[tuple[str, str, int, int, int]] = field(default_factory=list)  # source, where, count, begin, end
    faults: list[tuple[int, str, str, str]] = field(default_factory=list)  # time, source, kind, text
    steps: list[tuple[int, str]] = field(default_factory=list)  # clock steps: time, text
    stopped: bool = False  # in order
    failed: str = ""  # the error by which the program ended

    @property
    def name(self) -> str:
        return self.path.name.removesuffix(PART)

    @property
    def run_id(self) -> str:
        return self.run.get("run", "")

    @property
    def segment(self) -> int:
        return reader.count(self.run.get("segment", ""))

    @property
    def last_raw_ns(self) -> int:
        return max(self.last_ns.values(), default=self.end_ns)


@dataclass
class Verdict:
    """What was found; `wanting`: what is not as it should be, one line each; `notes`: what is, but should be known."""

    files: list[File]
    gaps: list[Gap] = field(default_factory=list)
    wanting: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    clips: list[File] = field(default_factory=list)

    @property
    def lost(self) -> bool:
        """Raw data that had come is gone, for a reason that the recording gives."""
        return any(g.reason in COSTS for g in self.gaps) or any(f.lost_bytes for f in self.files)


def verify(
    paths: Sequence[Path],
    progress: Callable[[Path], None] | None = None,
    take: Callable[[Path], File] | None = None,
) -> Verdict:
    """Look at recordings (files, or folders with all their recordings). Raises OSError for a path that is not there.
    `take`: instead of `look`, called for one file after the other."""
    found: list[Path] = []
    notes: list[str] = []
    clips: list[File] = []
    for path in paths:
        if not path.is_dir():
            path.stat()
            found.append(path)
            continue
        inside = sorted(path.iterdir())
        found += [p for p in inside if p.name.endswith((".mcap", ".mcap" + PART))]
        notes += [f"{p.name} is the damaged original of a repaired file" for p in inside if _is_damaged(p.name)]
        if (path / CLIPS).is_dir():
            kept = sorted((path / CLIPS).iterdir())
            clips += [look(p) for p in kept if p.name.endswith((".mcap", ".mcap" + PART))]
    files = []
    for path in found:
        if progress is not None:
            progress(path)
        if not path.exists():  # a live agent has finished it, or retention has deleted it
            path = path.with_name(path.name.removesuffix(PART))
            if not path.exists() or path in found:
                notes.append(f"{path.name} went away meanwhile")
                continue
        files.append((take or look)(path))
    return judged(files, notes, clips)


def judged(files: list[File], notes: list[str], clips: Sequence[File] = ()) -> Verdict:
    """The verdict on files that have been looked at."""
    once, copies = _once(files)
    verdict = Verdict(_in_order(once), notes=notes + [text for _, text in copies], clips=list(clips))
    for f in (*verdict.clips, *verdict.files, *(f for f, _ in copies)):
        if f.damage:
            verdict.wanting.append(f"{f.path}: {f.damage}")
        if f.state == "repaired":
            verdict.notes.append(f"{f.path.name} was torn and has been repaired, {f.lost_bytes} bytes were cut off")
        if f.messages and not f.raws and not f.run and not f.damage:
            verdict.notes.append(f"{f.path.name} holds no raw data: of another program, or a part of a recording")
        if f.state == "open" and not f.size:
            verdict.notes.append(f"{f.path.name} is empty: it is being made, or its agent was killed then (`recover`)")
        elif f.state == "open":
            verdict.notes.append(f"{f.path.name} has no index: it is being written, or was torn (`recover`)")
    _chain(verdict)
    _gaps(verdict)
    return verdict


def _once(files: Sequence[File]) -> tuple[list[File], list[tuple[File, str]]]:
    """Files whose records count; and those whose do not, with why: named twice, or replayed from others here."""
    names = {f.name for f in files}
    seen: dict[str, File] = {}
    copies = []
    for f in files:
        first = seen.setdefault(f.sha256 or str(f.path), f)
        source = f.run.get("replayed_from", "")
        if first is not f and f.messages:
            copies.append((f, f"{f.path} is the same as {first.path}: counted once"))
        elif source and f.name not in source.split(", ") and names.issuperset(source.split(", ")):
            copies.append((f, f"{f.path.name} is a replay of {source}: its records are not counted again"))
    return [f for f in files if all(f is not copy for copy, _ in copies)], copies


def _is_damaged(name: str) -> bool:
    return f".mcap{DAMAGED}" in name


# ------------------------------------------------------------------------------------------------------------ one file


def look(path: Path) -> File:
    """Walk through a file; what is wrong with it is in the result."""
    f = File(path)
    try:
        with path.open("rb") as file:
            f.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            f.size = file.tell()
        if f.size == 0:
            f.state = "open"  # killed as it was made
            if not path.name.endswith(PART):
                f.state, f.damage = "damaged", "is empty (0 bytes): not a recording; a copy that failed, or a sick disk"
            return f
        metadata = reader.read_metadata(path)
        f.run = metadata.get(RUN_METADATA, {})
        with reader.view(path) as buffer:
            if buffer[-len(reader.MAGIC) :] != reader.MAGIC or path.name.endswith(PART):
                f.state = "open"
        if REPAIRED_METADATA in metadata:
            f.state = "repaired"
            f.lost_bytes = reader.count(metadata[REPAIRED_METADATA].get("lost_bytes", ""))
        tally = reader.Tally()
        try:
            for stored in reader.read_messages(path, _Telling(), tally):
                _message(f, stored)
        finally:
            f.messages, f.begin_ns, f.end_ns = tally.messages, tally.begin_ns, tally.end_ns
    except OSError as e:
        f.state, f.damage = "unreadable", f"cannot be read: {e.strerror or e}"
    except ValueError as e:  # damaged
        f.state, f.damage = "damaged", str(e).removeprefix(f"{path}: ")
    return f


class _Telling:
    """The topics that tell what is there and why; the rest is only counted."""

    def __contains__(self, topic: object) -> bool:
        return str(topic).startswith(topics.RAW_PREFIX) or topic in ("/faults", "/events", "/rosout")


def looks(paths: Sequence[Path]) -> Iterator[File]:
    """`look` at one after the other."""
    return map(look, paths)


def _message(f: File, stored: reader.Stored) -> None:
    f.begin_ns = f.begin_ns or stored.log_ns  # until the walk has ended
    topic = stored.topic
    if topic == topics.CHECKPOINT_TOPIC:
        if f.order < 0:
            f.order = f.last_order = topics.decode_checkpoint(stored.data).order
            f.last_order -= 1
    elif topic.startswith(topics.RAW_PREFIX):
        _raw(f, topic.removeprefix(topics.RAW_PREFIX), topics.raw_order(stored.schema, stored.data), stored.log_ns)
    elif topic == "/faults":
        _fault(f, topics.decode(stored.schema, stored.data), stored.log_ns)
    elif topic == "/events":
        event = topics.decode(stored.schema, stored.data)
        if event["kind"] == "CLOCK_STEP":
            f.steps.append((stored.log_ns, event["text"]))
    elif topic == "/rosout":
        text = topics.decode(stored.schema, stored.data)["msg"]
        f.stopped = text == "stopped"
        f.failed = text.partition("failed: ")[2] if text.startswith("failed: ") else ""


def _raw(f: File, port: str, order: int, log_ns: int) -> None:
    before = f.last_ns.get(port)
    if before is not None and log_ns - before > SILENT_S * S:
        f.quiet.append((port, before, log_ns))
    if f.last_order >= 0 and order > f.last_order + 1:  # Ticks that waited for the file lie before its checkpoint
        f.jumps.append((max(f.last_ns.values(), default=f.begin_ns), log_ns, order - f.last_order - 1))
    f.last_order = max(f.last_order, order)
    f.first_ns.setdefault(port, log_ns)
    f.last_ns[port] = log_ns
    f.raws[port] = f.raws.get(port, 0) + 1


def _fault(f: File, event: dict[str, Any], log_ns: int) -> None:
    kind, source, text = event["kind"], event["source"], event["text"]
    if kind == "LOSS":
        begin, end = (event[k]["sec"] * S + event[k]["nanosec"] for k in ("begin", "end"))
        count = next((int(v["value"]) for v in event["values"] if v["name"] == "count"), 0)
        f.losses.append((source, text.rpartition(" ")[2], count, begin, end))
    else:
        f.faults.append((log_ns, source, kind, text))


# --------------------------------------------------------------------------------------------------------------- chain


def _in_order(files: list[File]) -> list[File]:
    """Files of a run by their number, runs by their links, else by time: a clock may have been set back between."""
    runs: dict[str, list[File]] = {}
    for f in files:
        runs.setdefault(f.run_id or f"file {f.path}", []).append(f)
    home = {f.name: run for run, members in runs.items() for f in members}
    begin = {run: min(f.begin_ns for f in members) for run, members in runs.items()}
    for members in runs.values():
        members.sort(key=lambda f: (f.segment, f.name))
    out: list[File] = []
    placed: set[str] = set()
    for run in sorted(runs, key=lambda r: (begin[r], r)):
        line = []
        at: str | None = run
        while at is not None and at not in placed:  # what it follows goes first
            placed.add(at)
            line.append(at)
            at = home.get(runs[at][0].run.get("previous_name", ""))
        for r in reversed(line):
            out += runs[r]
    return out


def _chain(verdict: Verdict) -> None:
    files = verdict.files
    by_name = {f.name: f for f in files}
    by_hash = {f.sha256: f for f in files}
    deleted = " ".join(text for f in files for _, _, kind, text in f.faults if kind == "RETENTION")
    linked = [f for f in files if f.run]
    named = {f.run.get("previous_name", "") for f in linked}
    for i, f in enumerate(linked):
        name, sha256 = f.run.get("previous_name", ""), f.run.get("previous_sha256", "")
        before = by_name.get(name)
        if not name:
            if i:
                verdict.notes.append(f"{f.path.name} names no file before it: here a new chain begins")
            continue
        if before is None:
            beside = f.path.parent / name
            if Path(name).name == name and beside.is_file():  # not among what was asked for, but there
                with beside.open("rb") as file:
                    if hashlib.file_digest(file, "sha256").hexdigest() != sha256:
                        verdict.wanting.append(f"{name} was altered after {f.path.name} began behind it")
            elif sha256 in by_hash:
                verdict.notes.append(f"{name} is now called {by_hash[sha256].path.name}")
            elif name in deleted or i == 0:
                verdict.notes.append(f"what was before {f.path.name} is gone: {name}")
            else:
                verdict.wanting.append(f"{name} is missing: {f.path.name} follows it")
        elif before.sha256 != sha256:
            how = "repaired" if before.state == "repaired" else "altered"
            verdict.wanting.append(f"{name} was {how} after {f.path.name} began behind it")
        odd = linked[i - 1]
        if i and name != odd.name and odd.name not in named:
            if odd.state in ("repaired", "open"):
                verdict.notes.append(f"{odd.path.name} was torn when {f.path.name} began, which therefore names {name}")
            elif before is not None and before.run:
                verdict.wanting.append(f"{odd.path.name} is named by no file behind it: put in, or a file is missing")


# ---------------------------------------------------------------------------------------------------------------- gaps


def _gaps(verdict: Verdict) -> None:
    files = [f for f in verdict.files if f.messages]
    losses = [(*loss, f) for f in files for loss in f.losses]
    gaps = [g for f in files for g in _told(f)]
    at_disk = [(begin, end) for source, where, _, begin, end, _ in losses if where == "disk" and _is_raw(source)]
    for f in files:
        for begin, end, count in f.jumps:
            if not any(a <= end and b >= begin for a, b in at_disk):
                gaps.append(Gap(begin, end, "all", "unknown", f"{count} raw blocks are not in {f.path.name}"))
        for port, begin, end in f.quiet:
            gaps.append(_quiet(files, port, begin, end))
    for a, b in pairwise(files):
        if a.run_id == b.run_id and a.run_id:
            gaps += _within_run(a, b, at_disk)
        elif a.run_id or b.run_id:
            gaps.append(_between_runs(a, b))
    verdict.gaps = sorted(
        (g for g in gaps if not any(_covers(other, g) for other in gaps)),
        key=lambda g: (g.begin_ns, g.end_ns, g.source, g.reason),
    )
    for g in verdict.gaps:
        if g.reason not in EXPLAINED:
            verdict.wanting.append(f"{iso(g.begin_ns)}: {g.text}")


def _is_raw(source: str) -> bool:
    """A LOSS names a port (inbox, kernel) or a topic (outbox, disk)."""
    return source.startswith(topics.RAW_PREFIX) or not source.startswith("/")


def _told(f: File) -> list[Gap]:
    """Losses of raw data that a file tells; those of one source that lie close are one gap."""
    found: list[Gap] = []
    counts: dict[tuple[str, str], list[int]] = {}
    for source, where, count, begin, end in sorted(f.losses, key=lambda x: x[3]):
        if not _is_raw(source):
            continue
        port = source.removeprefix(topics.RAW_PREFIX)
        held = counts.get((port, where))
        if held is not None and begin - held[2] <= JOIN_NS:
            held[0] += count
            held[2] = max(held[2], end)
            continue
        if held is not None:
            found.append(_loss(port, where, held))
        counts[port, where] = [count, begin, end]
    return found + [_loss(port, where, held) for (port, where), held in counts.items()]


def _loss(port: str, where: str, held: list[int]) -> Gap:
    count, begin, end = held
    what = "frames" if where == "kernel" else "blocks"
    return Gap(begin, end, port, "disk" if where == "disk" else "overload", f"{count} {what} lost at {where}")


def _quiet(files: Sequence[File], port: str, begin: int, end: int) -> Gap:
    seconds = (end - begin) / S
    if port == "clock":
        return Gap(begin, end, "all", "stall", f"the agent stood still for {seconds:.1f} s")
    told = [
        (kind, text)
        for f in files
        for t, source, kind, text in f.faults
        if source == port and begin - S <= t <= end + S and kind in ("PORT_LOST", "SILENT")
    ]
    for kind, text in told:
        if kind == "PORT_LOST":
            return Gap(begin, end, port, "port lost", text.partition("; next try")[0])
    return Gap(begin, end, port, "silent", f"nothing came for {seconds:.1f} s")


def _within_run(a: File, b: File, at_disk: Sequence[tuple[int, int]]) -> list[Gap]:
    end, begin = a.last_raw_ns, b.begin_ns
    found = []
    if b.segment > a.segment + 1:
        text = f"{b.segment - a.segment - 1} file(s) between {a.path.name} and {b.path.name} are not here"
        found.append(Gap(end, begin, "all", "missing", text))
    elif a.last_order >= 0 and b.order > a.last_order + 1:
        count = b.order - a.last_order - 1
        text = f"{count} raw blocks between {a.path.name} and {b.path.name} are in no file"
        if not any(x <= begin and y >= end for x, y in at_disk):
            disk = b.run.get("opened_because") == "disk"
            reason = "damaged" if a.damage or a.state == "open" else "disk" if disk else "unknown"
            found.append(Gap(end, begin, "all", reason, text))
    if b.run.get("opened_because") == "clock":
        return found  # other times from here on
    for port, last in a.last_ns.items():  # quiet over the border
        first = b.first_ns.get(port, b.end_ns)
        if first - last > SILENT_S * S:
            found.append(_quiet([a, b], port, last, first))
    return found


def _between_runs(a: File, b: File) -> Gap:
    begin, end = a.last_raw_ns, b.begin_ns
    boots = a.run.get("boot", "").replace("-", ""), b.run.get("boot", "").replace("-", "")
    if a.stopped:
        reason, text = "stop", "stopped in order"
    elif a.failed:
        reason, text = "crash", f"the program ended by an error: {a.failed}"
    elif all(boots) and boots[0] != boots[1]:
        reason, text = "power", "no end was written and the machine was started anew: power cut or reset"
    elif all(boots):
        reason, text = "kill", "no end was written while the machine ran on: the process was killed"
    else:
        reason, text = "kill", "no end was written: the process was killed, or the power cut"
    text += f"; {(end - begin) / S:.1f} s to the next run" if end >= begin else "; then the clock was set back"
    return Gap(begin, max(begin, end), "all", reason, text)


def _covers(a: Gap, b: Gap) -> bool:
    """Whether `b`, found by silence alone, says nothing that `a` does not say."""
    rank = {"silent": 2, "stall": 1}
    here = a.source in ("all", b.source) or (b.reason == "stall" and a.source == "clock")
    near = 3 * S // 2  # ticks come once a second
    return (
        here
        and rank.get(a.reason, 0) < rank.get(b.reason, 0)
        and a.begin_ns - near <= b.begin_ns
        and b.end_ns <= a.end_ns + near
    )


# -------------------------------------------------------------------------------------------------------------- output


def as_json(verdict: Verdict) -> dict[str, Any]:
    """Plain values for JSON."""
    files = verdict.files
    raws: dict[str, int] = {}
    for f in files:
        for port, n in f.raws.items():
            raws[port] = raws.get(port, 0) + n
    derived: dict[str, int] = {}
    for f in files:
        for source, _, count, _, _ in f.losses:
            if not _is_raw(source):
                derived[source] = derived.get(source, 0) + count
    held = [f for f in files if f.messages]
    return {
        "ok": not verdict.wanting,
        "lost": verdict.lost,
        "begin_utc": iso(min(f.begin_ns for f in held)) if held else None,
        "end_utc": iso(max(f.end_ns for f in held)) if held else None,
        "recorded_s": round(sum(f.end_ns - f.begin_ns for f in held) / S, 3),
        "bytes": sum(f.size for f in files),
        "messages": sum(f.messages for f in files),
        "raw_blocks": dict(sorted(raws.items())),
        "derived_refused": dict(sorted(derived.items())),
        "wanting": verdict.wanting,
        "notes": verdict.notes,
        "gaps": [
            {
                "begin_utc": iso(g.begin_ns),
                "end_utc": iso(g.end_ns),
                "seconds": round((g.end_ns - g.begin_ns) / S, 3),
                "source": g.source,
                "reason": g.reason,
                "text": g.text,
            }
            for g in verdict.gaps
        ],
        "clips": [
            {"file": str(f.path), "bytes": f.size, "state": f.state, "messages": f.messages} for f in verdict.clips
        ],
        "clock_steps": [{"utc": iso(t), "text": text} for f in files for t, text in f.steps],
        "files": [
            {
                "file": str(f.path),
                "bytes": f.size,
                "sha256": f.sha256,
                "run": f.run_id,
                "segment": f.segment,
                "state": f.state,
                "begin_utc": iso(f.begin_ns) if f.messages else None,
                "end_utc": iso(f.end_ns) if f.messages else None,
                "messages": f.messages,
                "raw_blocks": f.raws,
            }
            for f in files
        ],
    }


def as_text(verdict: Verdict) -> str:
    """For people: totals, gaps, what is wanting, what should be known."""
    v = as_json(verdict)
    lines = [f"{len(verdict.files)} files, {v['bytes'] / 1e6:.1f} MB, {v['messages']} messages"]
    if v["begin_utc"]:
        hours, rest = divmod(v["recorded_s"], 3600)
        lines[0] += f", {v['begin_utc'][:19]}Z to {v['end_utc'][:19]}Z, recorded {hours:.0f} h {rest / 60:.1f} min"
        lines.append("raw blocks: " + ", ".join(f"{port} {n}" for port, n in v["raw_blocks"].items()))
    if v["clips"]:
        whole = sum(c["state"] == "complete" for c in v["clips"])
        lines.append(
            f"clips: {len(v['clips'])}, {whole} of them whole, {sum(c['bytes'] for c in v['clips']) / 1e6:.1f} MB"
        )
    for g in v["gaps"]:
        lines.append(f"gap {g['begin_utc'][:23]}Z {g['seconds']:.1f} s, {g['source']}: {g['reason']}: {g['text']}")
    lines += [f"clock {s['utc'][:23]}Z: {s['text']}" for s in v["clock_steps"]]
    if v["derived_refused"]:
        n = sum(v["derived_refused"].values())
        lines.append(f"{n} derived records were refused under load; replay computes them from the raw ones")
    lines += [f"note: {text}" for text in v["notes"]]
    lines += [f"WRONG: {text}" for text in v["wanting"]]
    lines.append("verify: " + ("NOT in order" if verdict.wanting else "good, with loss" if v["lost"] else "good"))
    return "\n".join(lines)
