"""What a running agent says of itself: one tree of values, as JSON, as Prometheus text, and as a view for a terminal.

    Status --to_json--> status.json --from_json--> Status --render--> lines for 80 or 40 columns
       `--to_prometheus--> edge-agent.prom (textfile collector of node_exporter)

Pure functions of the tree; nothing here opens a socket or reads a clock. `observe.py` fills the tree once a second and
writes both files; `edge-agent status` reads one. Units stand in the names; None = not known (yet). Structure axes x, y,
z. Ages are counted from `written_utc_ns`.
"""

from __future__ import annotations

import dataclasses
import json
import math
import numbers
import re
import textwrap
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias

from edge_agent.messages import FusionFlag, Mode, Quality, S

FORMAT = 1
STALE_S = 5.0
"""A status is written once a second; one that is older than this comes from an agent that hangs or is gone."""
NAME, METRICS = "status.json", "edge-agent.prom"
MAX_BYTES = 1 << 20
"""Of a file that is read: a status has some kilobytes."""
EVENTS = 8
"""Events and faults that are remembered: the last of each kind and source."""
GOOD_PORT = ("START", "OPEN", "OK")
START_S = 60.0
"""So long after its start an agent that has no estimate yet is not yet a problem."""

Triple: TypeAlias = tuple[float, ...]
"""x, y, z; empty = not known."""


class StatusError(Exception):
    """What lies there is no status; the text says what it is."""


# ------------------------------------------------------------------------------------------------------------ the tree


@dataclass(frozen=True, slots=True)
class Count:
    name: str
    count: int


@dataclass(frozen=True, slots=True)
class Gate:
    """The last verdict on a fix of one point, and how many fixes of this run got which."""

    verdict: str
    age_s: float
    ratio: float  # v'S^-1 v / limit; the fix fits iff <= 1
    step_m: Triple  # smallest step of one axis alone that would be refused now
    verdicts: tuple[Count, ...]


@dataclass(frozen=True, slots=True)
class Point:
    name: str
    receiver: str | None
    accelerometer: str | None
    mode: str  # of messages.Mode
    valid: bool
    flags: tuple[str, ...]  # of messages.FusionFlag
    age_s: float | None  # of the newest sample of the fused stream
    displacement_m: Triple
    std_displacement_m: Triple
    velocity_mps: Triple
    std_velocity_mps: Triple
    gate: Gate | None


@dataclass(frozen=True, slots=True)
class Receiver:
    name: str
    port: str
    quality: str  # of messages.Quality
    satellites: int
    hdop: float | None
    age_s: float | None  # since the arrival of the last fix
    latency_s: float | None  # of the last fix
    latency_from: str  # "configured", "learned" or "assumed"
    rate_hz: float | None  # over the last 10 s
    fixes: int
    positions: int
    sentences: int
    heading_deg: float | None  # of a receiver with two antennas
    std_heading_deg: float | None
    heading_age_s: float | None
    rejects: tuple[Count, ...]  # by reason


@dataclass(frozen=True, slots=True)
class Accelerometer:
    name: str
    port: str
    rate_hz: float | None  # over the last 10 s
    expected_hz: float | None  # configured, else learned
    age_s: float | None  # of the last sample
    samples: int
    missing: int  # samples that the counter or the time says are missing
    gaps: int
    flags: tuple[str, ...]  # of messages.AccelFlag, of the last second
    clock_ppm: float | None  # the device's clock against the nominal rate; positive = fast
    rejects: tuple[Count, ...]


@dataclass(frozen=True, slots=True)
class Port:
    """`received` = written + queued + dropped_inbox + refused_outbox + lost_disk + unaccounted, in blocks (reads)."""

    name: str
    device: str
    state: str  # START, OPEN, OK, SILENT, GARBAGE, NO_MATCH, NO_POSITION, BUS_OFF, LOST, HUNG
    since_s: float  # in this state
    age_s: float | None  # since the last block
    bytes: int
    bytes_per_s: float | None
    reopened: int
    received: int
    written: int
    queued: int
    dropped_inbox: int
    refused_outbox: int
    lost_disk: int
    dropped_kernel: int  # frames
    unaccounted: int


@dataclass(frozen=True, slots=True)
class Queue:
    name: str
    bytes: int
    limit_bytes: int
    items: int


@dataclass(frozen=True, slots=True)
class Loss:
    where: str  # kernel, inbox, outbox, disk
    source: str
    count: int
    age_s: float  # since the last one was noticed


@dataclass(frozen=True, slots=True)
class Clock:
    synchronised: bool
    error_s: float  # the kernel's estimate; 0 = not known
    shift_s: float  # the wall clock now against the map of the open file


@dataclass(frozen=True, slots=True)
class Disk:
    path: str
    state: str  # "recording", "waiting" (for the first data), "refused" (records wait in memory), "stalled", "closed"
    free_bytes: int  # -1 = the file system does not say
    size_bytes: int
    file: str
    file_bytes: int
    file_age_s: float | None
    files: int  # finished ones of this site
    files_bytes: int
    oldest_utc_ns: int  # 0 = none
    stalled_s: float  # the writer has been at one operation so long
    stalls: int


@dataclass(frozen=True, slots=True)
class Process:
    pid: int
    rss_bytes: int
    cpu_s: float
    cpu_share: float | None  # of one core, over the last 10 s
    threads: int


@dataclass(frozen=True, slots=True)
class Happening:
    """An event or fault; `times` = how often this kind of this source came in this run."""

    utc_ns: int
    kind: str
    source: str
    text: str
    fault: bool
    times: int


@dataclass(frozen=True, slots=True)
class Status:
    format: int
    site: str
    version: str
    run: str
    state: str  # "running", at the end "stopped" or "failed"
    written_utc_ns: int
    uptime_s: float
    points: tuple[Point, ...]
    receivers: tuple[Receiver, ...]
    accelerometers: tuple[Accelerometer, ...]
    ports: tuple[Port, ...]
    queues: tuple[Queue, ...]
    losses: tuple[Loss, ...]
    clock: Clock
    disk: Disk
    process: Process
    faults: tuple[Count, ...]  # by kind
    events: tuple[Happening, ...]  # oldest first


# ---------------------------------------------------------------------------------------------------------------- JSON


def plain(value: Any) -> Any:
    """Dicts, lists, text and Python's own numbers; a float that is not finite is None, as JSON has no other word."""
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, tuple):
        return [plain(v) for v in value]
    if isinstance(value, numbers.Integral):  # numpy's too
        return int(value)
    if isinstance(value, numbers.Real):
        return float(value) if math.isfinite(value) else None
    return {name: plain(getattr(value, name)) for name in _fields(type(value))}


_HINTS: dict[type, dict[str, Any]] = {}


def _fields(kind: type) -> dict[str, Any]:
    if kind not in _HINTS:
        _HINTS[kind] = typing.get_type_hints(kind)
    return _HINTS[kind]


def to_json(status: Status) -> str:
    """The text of status.json."""
    return json.dumps(plain(status), ensure_ascii=False, allow_nan=False)


def from_json(text: str | bytes) -> Status:
    """The tree again. StatusError if it is not the status of an agent of this version's format."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError) as e:
        raise StatusError(f"is no status of edge-agent: no JSON ({e})") from None
    if not isinstance(value, dict) or "format" not in value or "site" not in value:
        raise StatusError("is no status of edge-agent: JSON of something else")
    if value["format"] != FORMAT:
        raise StatusError(f"has format {value['format']!r}, this edge-agent reads {FORMAT}: another version runs there")
    status: Status = _built(Status, value, "")
    for p in status.points:  # the view shows them side by side
        sizes = {len(x) for x in (p.displacement_m, p.std_displacement_m, p.velocity_mps, p.std_velocity_mps)}
        if sizes not in ({0}, {3}):  # none, or the three axes of each
            raise StatusError(f"is a damaged status of edge-agent: the axes of point {p.name!r} are not complete")
    return status


def _built(kind: Any, value: Any, where: str) -> Any:
    """`value` as a `kind`: dataclass, tuple[X, ...], X | None, str, bool, int or float. StatusError says where not."""
    origin = typing.get_origin(kind)
    if origin is tuple:
        (item, _) = typing.get_args(kind)
        if isinstance(value, list):
            return tuple(_built(item, v, f"{where}[{i}]") for i, v in enumerate(value))
    elif origin is types.UnionType:
        return None if value is None else _built(typing.get_args(kind)[0], value, where)
    elif dataclasses.is_dataclass(kind):
        fields = _fields(typing.cast(type, kind))
        if isinstance(value, dict) and value.keys() == fields.keys():
            made: Any = kind
            return made(**{k: _built(f, value[k], f"{where}.{k}" if where else k) for k, f in fields.items()})
    elif kind is float:
        if value is None:
            return math.nan
        if isinstance(value, (int, float)) and not isinstance(value, bool):
            return float(value)
    elif type(value) is kind:
        return value
    raise StatusError(f"is a damaged status of edge-agent: {where or 'the whole'} is not what it should be")


# ---------------------------------------------------------------------------------------------------------------- file


def folder(environment: Mapping[str, str], data_dir: str | Path) -> Path:
    """Where the service writes: the runtime directory that systemd gives it (a tmpfs), else `data_dir`/state."""
    given = environment.get("RUNTIME_DIRECTORY", "").split(":")[0]
    return Path(given) if given else Path(data_dir) / "state"


def load(places: Sequence[Path], data_dir: str | None = None) -> tuple[Path, Status]:
    """The newest status in `places`, of the agent that records into `data_dir` where one is named.

    FileNotFoundError if there is none, StatusError if what is there cannot be used.
    """
    found: list[tuple[Path, Status]] = []
    wrong: list[str] = []
    for place in places:
        path = place / NAME
        try:
            with open(path, "rb") as file:
                text = file.read(MAX_BYTES + 1)
        except (FileNotFoundError, NotADirectoryError):
            continue
        try:
            if len(text) > MAX_BYTES:
                raise StatusError(f"is no status of edge-agent: larger than {MAX_BYTES} bytes")
            status = from_json(text)
            if data_dir is not None and status.disk.path != data_dir:
                raise StatusError(f"is of another agent: site {status.site}, which records into {status.disk.path}")
            found.append((path, status))
        except StatusError as e:
            wrong.append(f"{path} {e}")
    if found:
        return max(found, key=lambda f: f[1].written_utc_ns)
    if wrong:
        raise StatusError("\n".join(wrong))
    looked = ", ".join(str(place / NAME) for place in places)
    raise FileNotFoundError(f"no status: looked for {looked}")


# ----------------------------------------------------------------------------------------------------------- judgement


def age_s(status: Status, now_utc_ns: int) -> float:
    """Seconds since the status was written."""
    return (now_utc_ns - status.written_utc_ns) / S


def stale(status: Status, now_utc_ns: int) -> bool:
    """A running agent would have written since; a status of the future is one of before a clock step."""
    return status.state == "running" and abs(age_s(status, now_utc_ns)) > STALE_S


def problems(status: Status, now_utc_ns: int) -> list[str]:
    """What somebody should see to, worst first; empty = all is well."""
    age = age_s(status, now_utc_ns)
    found = []
    if status.state != "running":
        how = "was stopped" if status.state == "stopped" else "failed and ended"
        return [f"the agent {how} {_time(age)} ago; this is its last word"]
    if stale(status, now_utc_ns):
        found.append(f"written {_time(age)} {'ago' if age > 0 else 'ahead of this clock'}: agent not running?")
    d = status.disk
    if d.stalled_s > 0:
        found.append(f"the disk has not answered for {_time(d.stalled_s)}: records wait in memory")
    if d.state == "refused":
        found.append("the disk refuses: records wait in memory")
    poor = {port.name for port in status.ports if port.state not in GOOD_PORT}
    for port in status.ports:
        if port.name in poor:
            since = port.since_s if port.state != "SILENT" or port.age_s is None else port.age_s
            found.append(f"port {port.name} {port.state} for {_time(since)}")
        if port.unaccounted:
            found.append(f"ledger: {_blocks(port.unaccounted)} of {port.name} unaccounted for")
    for point in status.points:
        waits = point.mode == Mode.INIT.name and status.uptime_s < START_S
        alone = point.receiver is None and point.mode == Mode.ACCEL_ONLY.name
        if point.age_s is not None and point.age_s > STALE_S:
            found.append(f"point {point.name}: no estimate for {_time(point.age_s)}")
        elif not (point.valid or waits or alone):
            found.append(f"point {point.name} {point.mode}: not valid")
        elif point.accelerometer and point.mode == Mode.GNSS_ONLY.name:
            found.append(f"point {point.name} goes on without {point.accelerometer}")
        elif "JUMP_OPEN" in point.flags:
            found.append(f"point {point.name}: its fixes stand on another level; they or the estimate are wrong")
    for a in status.accelerometers:
        if a.port not in poor and _slow(a) and status.uptime_s > START_S:
            found.append(f"{a.name} gives {a.rate_hz:.1f} Hz of {a.expected_hz:.1f} Hz")
    found += [f"lost {text}" for text, age in _losses(status) if age < START_S]
    if not status.clock.synchronised:
        found.append("the host's clock is not synchronised")
    return found


def _losses(status: Status) -> list[tuple[str, float]]:
    """What was lost by place, and how long ago the last of it. Derived records can be recomputed, raw ones cannot."""
    found = []
    for where in dict.fromkeys(x.where for x in status.losses):
        here = [x for x in status.losses if x.where == where]
        raw = [x for x in here if not x.source.startswith("/") or x.source.startswith("/raw/")]
        one, more = ("frame", "frames") if where == "kernel" else ("block", "blocks")
        parts = [f"{_many(x.count, one, more)} of {x.source.removeprefix('/raw/')}" for x in raw]
        derived = sum(x.count for x in here) - sum(x.count for x in raw)
        parts += [_many(derived, "derived record", "derived records")] if derived else []
        found.append((f"at {where}: {', '.join(parts)}", min(x.age_s for x in here)))
    return found


# ---------------------------------------------------------------------------------------------------------- Prometheus

Labels: TypeAlias = Mapping[str, object]
AXES = "xyz"
PORT_STATES = ("START", "OPEN", "OK", "SILENT", "GARBAGE", "NO_MATCH", "NO_POSITION", "BUS_OFF", "LOST", "HUNG")


def to_prometheus(status: Status) -> str:
    """The text of edge-agent.prom: exposition format 0.0.4 without time stamps, which the textfile collector refuses.

    Base units; counters of this run end in _total. What is not known is not there.
    """
    out: list[str] = []

    def metric(name: str, kind: str, about: str, rows: Iterable[tuple[Labels, float | int | bool | None]]) -> None:
        lines = []
        for labels, value in rows:
            if value is None or not math.isfinite(value):
                continue
            inner = ",".join(f'{k}="{_escaped(str(v))}"' for k, v in labels.items())
            number = repr(float(value)) if isinstance(value, float) else str(int(value))
            lines.append(f"edge_agent_{name}{{{inner}}} {number}" if inner else f"edge_agent_{name} {number}")
        if lines:
            out.extend((f"# HELP edge_agent_{name} {about}", f"# TYPE edge_agent_{name} {kind}", *lines))

    def gauge(name: str, about: str, rows: Iterable[tuple[Labels, float | int | bool | None]]) -> None:
        metric(name, "gauge", about, rows)

    def counter(name: str, about: str, rows: Iterable[tuple[Labels, float | int | bool | None]]) -> None:
        metric(name + "_total", "counter", about, rows)

    def axes(what: str, points: Sequence[Point]) -> list[tuple[Labels, float]]:
        return [
            ({"point": p.name, "axis": a}, v)
            for p in points
            for a, v in zip(AXES, getattr(p, what), strict=False)  # empty before the start
        ]

    s, points, receivers, sensors = status, status.points, status.receivers, status.accelerometers
    refusing: tuple[Receiver | Accelerometer, ...] = (*receivers, *sensors)
    gauge("info", "What runs.", [({"site": s.site, "version": s.version, "run": s.run}, 1)])
    gauge("running", "1 while the agent runs, 0 when it has ended.", [({}, s.state == "running")])
    gauge("status_time_seconds", "When this was written, Unix time.", [({}, s.written_utc_ns / S)])
    gauge("uptime_seconds", "Since the agent's start.", [({}, s.uptime_s)])
    gauge("problems", "Things that somebody should see to.", [({}, len(problems(s, s.written_utc_ns)))])

    gauge("mode", "Mode of the fused stream, see README.", [({"point": p.name}, int(Mode[p.mode])) for p in points])
    gauge("valid", "1 if displacement is valid now.", [({"point": p.name}, p.valid) for p in points])
    flags = [({"point": p.name, "flag": f.name}, f.name in p.flags) for p in points for f in FusionFlag]
    gauge("flag", "Flags of the fused stream.", flags)
    gauge("estimate_age_seconds", "Age of the newest fused sample.", [({"point": p.name}, p.age_s) for p in points])
    gauge("displacement_meters", "Displacement, structure axes.", axes("displacement_m", points))
    gauge("displacement_stddev_meters", "Its standard deviation.", axes("std_displacement_m", points))
    gauge("velocity_meters_per_second", "Velocity, structure axes.", axes("velocity_mps", points))
    gauge("velocity_stddev_meters_per_second", "Its standard deviation.", axes("std_velocity_mps", points))
    gated = [(p, p.gate) for p in points if p.gate is not None]
    counter(
        "fixes_judged",
        "Fixes by verdict.",
        [({"point": p.name, "verdict": v.name}, v.count) for p, g in gated for v in g.verdicts],
    )
    gauge(
        "gate_ratio",
        "Last fix against the gate's limit; fits iff <= 1.",
        [({"point": p.name}, g.ratio) for p, g in gated],
    )
    gauge(
        "gate_step_meters",
        "Smallest step of one axis that the gate would refuse now.",
        [({"point": p.name, "axis": a}, v) for p, g in gated for a, v in zip(AXES, g.step_m, strict=False)],
    )

    def each(rows: Sequence[Any], label: str, what: str) -> list[tuple[Labels, Any]]:
        return [({label: r.name}, getattr(r, what)) for r in rows]

    quality = [({"receiver": r.name}, int(Quality[r.quality])) for r in receivers if r.age_s is not None]
    gauge("fix_quality", "GGA quality of the last fix: 4 fixed, 5 float.", quality)
    gauge("satellites", "Satellites used in the last fix.", each(receivers, "receiver", "satellites"))
    gauge("hdop", "Horizontal dilution of precision.", each(receivers, "receiver", "hdop"))
    gauge("fix_age_seconds", "Since the arrival of the last fix.", each(receivers, "receiver", "age_s"))
    gauge(
        "fix_latency_seconds",
        "From the epoch to the arrival of the last fix.",
        each(receivers, "receiver", "latency_s"),
    )
    gauge("fix_rate_hertz", "Fixes a second over 10 s.", each(receivers, "receiver", "rate_hz"))
    gauge("heading_degrees", "Azimuth between two antennas.", each(receivers, "receiver", "heading_deg"))
    gauge("heading_stddev_degrees", "Its standard deviation.", each(receivers, "receiver", "std_heading_deg"))
    gauge("heading_age_seconds", "Age of the last heading.", each(receivers, "receiver", "heading_age_s"))
    counter("fixes", "Fixes of any quality.", each(receivers, "receiver", "fixes"))
    counter("sentences", "Good sentences.", each(receivers, "receiver", "sentences"))
    counter(
        "rejects",
        "Sentences or frames refused by the codec.",
        [({"source": r.name, "reason": c.name}, c.count) for r in refusing for c in r.rejects],
    )

    gauge("sample_rate_hertz", "Samples a second over 10 s.", each(sensors, "accelerometer", "rate_hz"))
    gauge("sample_rate_expected_hertz", "Configured or learned.", each(sensors, "accelerometer", "expected_hz"))
    gauge("sample_age_seconds", "Age of the last sample.", each(sensors, "accelerometer", "age_s"))
    counter("samples", "Accelerations decoded.", each(sensors, "accelerometer", "samples"))
    counter("samples_missing", "Samples that never came.", each(sensors, "accelerometer", "missing"))
    counter("sample_gaps", "Gaps in the accelerations.", each(sensors, "accelerometer", "gaps"))
    gauge(
        "device_clock_deviation_ratio",
        "Device clock against its nominal rate.",
        [({"accelerometer": a.name}, None if a.clock_ppm is None else a.clock_ppm * 1e-6) for a in sensors],
    )

    gauge(
        "port_state",
        "1 for the state that the port is in.",
        [({"port": p.name, "state": state}, p.state == state) for p in s.ports for state in PORT_STATES],
    )
    gauge("port_age_seconds", "Since the last block of the port.", each(s.ports, "port", "age_s"))
    counter("port_bytes", "Bytes received.", each(s.ports, "port", "bytes"))
    counter("port_reopened", "Times that a silent port was opened again.", each(s.ports, "port", "reopened"))
    fates = ("received", "written", "dropped_inbox", "refused_outbox", "lost_disk")
    counter(
        "port_blocks",
        "Blocks by fate: received = written + queued + dropped + refused + lost.",
        [({"port": p.name, "fate": f}, getattr(p, f)) for p in s.ports for f in fates],
    )
    gauge("port_blocks_queued", "Blocks on their way to the file.", each(s.ports, "port", "queued"))
    gauge(
        "port_blocks_unaccounted",
        "What the ledger cannot account for; not 0 = a bug.",
        each(s.ports, "port", "unaccounted"),
    )
    counter("port_frames_dropped_kernel", "Frames dropped by the kernel.", each(s.ports, "port", "dropped_kernel"))
    gauge("queue_bytes", "Fill of a queue.", each(s.queues, "queue", "bytes"))
    gauge("queue_limit_bytes", "Its bound.", each(s.queues, "queue", "limit_bytes"))
    counter("lost", "Records lost.", [({"where": x.where, "source": x.source}, x.count) for x in s.losses])
    counter("faults", "Faults by kind.", [({"kind": f.name}, f.count) for f in s.faults])

    d = s.disk
    gauge("disk_free_bytes", "Free space where recordings go.", [({}, None if d.free_bytes < 0 else d.free_bytes)])
    gauge("disk_size_bytes", "Size of that file system.", [({}, None if d.free_bytes < 0 else d.size_bytes)])
    gauge("disk_refused", "1 while the disk refuses and records wait in memory.", [({}, d.state == "refused")])
    gauge("writer_stalled_seconds", "The writer has been at one operation so long.", [({}, d.stalled_s)])
    counter("writer_stalls", "Times that it was for more than 5 s.", [({}, d.stalls)])
    gauge("recording_file_bytes", "Size of the open file.", [({}, d.file_bytes)])
    gauge("recording_file_age_seconds", "Age of the open file.", [({}, d.file_age_s)])
    gauge("recording_files", "Finished recordings of this site.", [({}, d.files)])
    gauge("recording_files_bytes", "Their size together.", [({}, d.files_bytes)])
    gauge("clock_synchronised", "1 while the host's clock is disciplined.", [({}, s.clock.synchronised)])
    gauge("clock_error_seconds", "The kernel's estimate of its error.", [({}, s.clock.error_s or None)])
    gauge("resident_memory_bytes", "Resident memory of the agent.", [({}, s.process.rss_bytes)])
    counter("cpu_seconds", "CPU time of the agent.", [({}, s.process.cpu_s)])
    gauge("threads", "Threads of the agent.", [({}, s.process.threads)])
    return "\n".join(out) + "\n"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


# -------------------------------------------------------------------------------------------------------------- a view

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
STYLES = {"good": "32", "bad": "1;31", "warn": "33", "dim": "2", "bold": "1"}


@dataclass(frozen=True, slots=True)
class _Piece:
    """Text that is not broken over lines."""

    text: str
    style: str = ""


@dataclass(frozen=True, slots=True)
class _Group:
    """Lines that go together; where the height does not do, those of the highest `rank` go first."""

    rank: int
    label: str
    pieces: tuple[_Piece, ...]


def render(status: Status, width: int, height: int | None, now_utc_ns: int, colour: bool = False) -> str:
    """The view as lines of at most `width` columns, at most `height` of them (None = all), plain ASCII but for names.

    Every number is followed by its unit. `colour`: with ANSI colours, which never carry what the text does not.
    """
    wide = width >= 60
    groups = _groups(status, now_utc_ns, wide)
    indent = 10 if wide else 5
    blocks = [_flow(g, width, indent, colour) for g in groups]
    total = sum(map(len, blocks))
    if height is None or total <= height:
        return "\n".join(line for block in blocks for line in block)
    shown: set[int] = set()
    room = height - 1  # for the note
    for i in sorted(range(len(groups)), key=lambda i: (groups[i].rank, i)):
        if len(blocks[i]) <= room:
            shown.add(i)
            room -= len(blocks[i])
    lines = [line for i, block in enumerate(blocks) if i in shown for line in block]
    note = f"{total - len(lines)} lines hidden" + (": a taller window shows them" if wide else "")
    return "\n".join([*lines, _painted(note, "dim", colour)])


def _flow(group: _Group, width: int, indent: int, colour: bool) -> list[str]:
    """Label and pieces in lines; what follows the first line is indented."""
    if not group.label and len(group.pieces) == 1:  # a sentence
        (piece,) = group.pieces
        wrapped = _wrapped(piece.text, width, subsequent_indent=" " * 4, max_lines=3, placeholder=" ...")
        return [_painted(line, piece.style, colour) for line in wrapped]
    lines: list[str] = []
    line, used = "", 0
    if group.label:
        label = group.label[: width - 1]
        used = max(indent, len(label) + 1)
        line = _painted(label, "bold", colour) + " " * (used - len(label))
    fresh = True  # nothing but label or indent stands on the line
    for piece in group.pieces:
        # longer than a line: between words, so that no number loses its unit
        for text in _wrapped(piece.text, width - indent) if len(piece.text) > width - indent else [piece.text]:
            gap = 0 if fresh else 2
            if used + gap + len(text) > width and used > indent:
                lines.append(line.rstrip() if not colour else line)
                line, used, gap = " " * indent, indent, 0
            line += " " * gap + _painted(text, piece.style, colour)
            used += gap + len(text)
            fresh = False
    lines.append(line.rstrip() if not colour else line)
    return lines


def _wrapped(text: str, width: int, **options: Any) -> list[str]:
    """Lines cut between words, but never between a number and its unit, nor in a name."""
    glued = re.sub(r"(?<=\d) (?=\S)", "\xa0", text)
    lines = textwrap.wrap(glued, width, break_on_hyphens=False, **options)
    return [line.replace("\xa0", " ") for line in lines]


def _painted(text: str, style: str, colour: bool) -> str:
    return f"\x1b[{STYLES[style]}m{text}\x1b[0m" if colour and style else text


def _groups(s: Status, now: int, wide: bool) -> list[_Group]:
    found = [_head(s, now)]
    found += [_Group(0, "", (_Piece(f"! {p}", "bad"),)) for p in problems(s, now)]
    for p in s.points:
        found += _point(p, wide)
    found += [_receiver(r) for r in s.receivers]
    found += [_accelerometer(a) for a in s.accelerometers]
    found.append(_Group(3, "ports", tuple(_port(p) for p in s.ports)))
    found += _recording(s)
    found += _machine(s)
    if s.events:
        found += [_Group(3, "last", ())] if wide else []
        newest = len(s.events) - 3  # these three are wanted most
        for i, e in enumerate(s.events):
            rank = (6, 4, 3)[i - newest] if i >= newest else 9 + newest - i
            found += _event(e, rank, wide)
    return found


def _head(s: Status, now: int) -> _Group:
    pieces = [_Piece(f"edge-agent {s.version}")]
    if s.state != "running":
        pieces.append(_Piece(s.state.upper(), "bad"))
    elif stale(s, now):
        pieces.append(_Piece("NOT RUNNING?", "bad"))
    else:
        pieces.append(_Piece("running", "good"))
    pieces += [_Piece(f"up {_time(s.uptime_s)}"), _Piece(f"{_clock(s.written_utc_ns, '%Y-%m-%d %H:%M:%S')} UTC")]
    return _Group(0, s.site, tuple(pieces))


def _point(p: Point, wide: bool) -> list[_Group]:
    good = "good" if p.valid else "warn" if p.mode in (Mode.INIT.name, Mode.ACCEL_ONLY.name) else "bad"
    if p.age_s is not None and p.age_s > STALE_S:
        pieces = [_Piece(f"no estimate for {_time(p.age_s)}", "bad"), _Piece(f"was {p.mode}")]
    else:
        pieces = [_Piece(p.mode, good), _Piece("valid" if p.valid else "not valid", good)]
        pieces += [_Piece(f, "warn") for f in p.flags]
        pieces += [] if p.age_s is None else [_Piece(f"{_time(p.age_s)} old")]
    found = [_Group(1, p.name, tuple(pieces))]
    if len(p.displacement_m) == len(p.velocity_mps) == 3:
        place = [
            f"{a} {_mm(v)} sd {_sd(sd)} mm"
            for a, v, sd in zip(AXES, p.displacement_m, p.std_displacement_m, strict=True)
        ]
        speed = [f"{_mm(v)} sd {_sd(sd)} mm/s" for v, sd in zip(p.velocity_mps, p.std_velocity_mps, strict=True)]
        if wide:
            found.append(_Group(1, "  displ.", tuple(_Piece(f"{x:<22}") for x in place)))
            found.append(_Group(4, "  veloc.", tuple(_Piece(f"{a} {x:<20}") for a, x in zip(AXES, speed, strict=True))))
        else:
            found += [_Group(1, "", (_Piece("  " + x),)) for x in place]
            found += [_Group(4, "", (_Piece(f"  {a} {x}"),)) for a, x in zip(AXES, speed, strict=True)]
    if p.gate is not None:
        found += _gate(p.gate)
    return found


def _gate(g: Gate) -> list[_Group]:
    n = {v.name: v.count for v in g.verdicts}
    judged = sum(n.get(k, 0) for k in ("ACCEPTED", "OFFSET", "REJECTED"))

    def part(key: str) -> _Piece:
        share = f" {_percent(n[key] / judged)}" if key in ("ACCEPTED", "REJECTED", "OFFSET") else ""
        return _Piece(f"{key.lower()} {_many(n[key], 'fix', 'fixes')}{share}")

    style = {"ACCEPTED": "good", "REJECTED": "bad"}.get(g.verdict, "warn")
    last = _Piece(f"{g.verdict}, ratio {_percent(g.ratio)}", style)
    refused = [part(k) for k in ("REJECTED", "OFFSET", "PRECHECK", "OLD") if n.get(k)]
    rest = [part("ACCEPTED")] if n.get("ACCEPTED") else []
    if g.step_m:
        rest.append(_Piece("refuses steps of " + "/".join(f"{1e3 * v:.1f}" for v in g.step_m) + " mm"))
    return [_Group(5, "  gate", (last, *refused)), _Group(7, "  ", tuple(rest))]


def _receiver(r: Receiver) -> _Group:
    if r.age_s is None:
        return _Group(2, r.name, (_Piece("no fix yet", "warn"), _Piece(_many(r.sentences, "sentence", "sentences"))))
    style = "good" if r.quality == Quality.FIXED.name else "warn"
    if r.age_s > STALE_S:
        pieces = [_Piece(f"no fix for {_time(r.age_s)}", "bad"), _Piece(f"was {r.quality}")]
    else:
        pieces = [_Piece(r.quality, style), _Piece(f"{r.satellites} sat"), _Piece(f"{_time(r.age_s)} ago")]
    if r.rate_hz is not None:
        pieces.append(_Piece(f"{r.rate_hz:.1f} Hz"))
    if r.latency_s is not None:
        pieces.append(_Piece(f"latency {1e3 * r.latency_s:.0f} ms {r.latency_from}"))
    if r.heading_deg is not None and r.std_heading_deg is not None:
        pieces.append(_Piece(f"heading {r.heading_deg:.2f} sd {r.std_heading_deg:.2f} deg"))
    if r.heading_age_s is not None and r.heading_age_s > STALE_S:
        pieces.append(_Piece(f"no heading for {_time(r.heading_age_s)}", "bad"))
    count = sum(c.count for c in r.rejects)
    if count:
        pieces.append(_Piece(f"rejects {_many(count, 'sentence', 'sentences')}", "warn"))
    return _Group(2, r.name, tuple(pieces))


def _accelerometer(a: Accelerometer) -> _Group:
    if a.age_s is None:
        return _Group(2, a.name, (_Piece("no sample yet", "warn"),))
    pieces = []
    if a.rate_hz is not None:
        of = f" of {a.expected_hz:.1f} Hz" if a.expected_hz else ""
        pieces.append(_Piece(f"{a.rate_hz:.1f} Hz{of}", "bad" if _slow(a) else "good"))
    pieces.append(_Piece(f"{_time(a.age_s)} ago", "bad" if a.age_s > 3 else ""))
    pieces += [_Piece(f, "warn") for f in a.flags]
    pieces.append(_Piece(f"missing {_many(a.missing, 'sample', 'samples')} in {_many(a.gaps, 'gap', 'gaps')}"))
    count = sum(c.count for c in a.rejects)
    if count:
        pieces.append(_Piece(f"rejects {_many(count, 'frame', 'frames')}", "warn"))
    if a.clock_ppm is not None:
        pieces.append(_Piece(f"clock {a.clock_ppm:+.1f} ppm"))
    return _Group(2, a.name, tuple(pieces))


def _slow(a: Accelerometer) -> bool:
    return a.rate_hz is not None and a.expected_hz is not None and a.rate_hz < 0.95 * a.expected_hz


def _port(p: Port) -> _Piece:
    style = ("good" if p.state == "OK" else "") if p.state in GOOD_PORT else "bad"
    rate = "" if p.bytes_per_s is None or style == "bad" else f" {_size(p.bytes_per_s)}/s"
    return _Piece(f"{p.name} {p.state} {_time(p.since_s)}{rate}", style)


def _recording(s: Status) -> list[_Group]:
    d = s.disk
    style = "bad" if d.state in ("refused", "stalled") else "good" if d.state == "recording" else "warn"
    pieces = [_Piece(d.state, style)]
    if d.free_bytes >= 0:
        share = f" = {_percent(d.free_bytes / d.size_bytes)}" if d.size_bytes > 0 else ""
        pieces.append(_Piece(f"free {_size(d.free_bytes)}{share}"))
    if d.file:
        pieces.append(_Piece(d.file.split(".")[0]))
        pieces.append(_Piece(f"{_size(d.file_bytes)}" + ("" if d.file_age_s is None else f", {_time(d.file_age_s)}")))
    pieces.append(_Piece(f"{_many(d.files, 'finished file', 'finished files')}, {_size(d.files_bytes)}"))
    if d.oldest_utc_ns:
        pieces.append(_Piece(f"oldest {_clock(d.oldest_utc_ns, '%Y-%m-%d')} UTC"))
    found = [_Group(3, "disk", tuple(pieces))]
    lost = tuple(_Piece(f"{text}, {_time(age)} ago", "warn") for text, age in _losses(s))
    found.append(_Group(3, "lost", lost or (_Piece("nothing", "good"),)))
    return found


def _machine(s: Status) -> list[_Group]:
    queues = [
        _Piece(
            f"{q.name} {_percent(q.bytes / q.limit_bytes)} {_size(q.bytes)}",
            "warn" if 2 * q.bytes > q.limit_bytes else "",
        )
        for q in s.queues
        if q.limit_bytes > 0
    ]
    c, p = s.clock, s.process
    clock = [_Piece("synchronised", "good") if c.synchronised else _Piece("NOT synchronised", "bad")]
    if c.error_s:
        clock.append(_Piece(f"error {_time(c.error_s)}"))
    if abs(c.shift_s) >= 0.001:
        clock.append(_Piece(f"{c.shift_s:+.3f} s against the file"))
    agent = [_Piece(f"RSS {_size(p.rss_bytes)}")]
    if p.cpu_share is not None:
        agent.append(_Piece(f"CPU {_percent(p.cpu_share)} of a core"))
    agent += [_Piece(_many(p.threads, "thread", "threads")), _Piece(f"pid {p.pid}")]
    return [_Group(6, "queues", tuple(queues)), _Group(7, "clock", tuple(clock)), _Group(7, "agent", tuple(agent))]


def _event(e: Happening, rank: int, wide: bool) -> list[_Group]:
    times = f" ({e.times} times)" if e.times > 1 else ""
    head = f"{_clock(e.utc_ns, '%H:%M:%S')} UTC {e.source} {e.kind}{times}"
    text = _CONTROL.sub("?", e.text)  # a device must not steer the terminal
    style = "warn" if e.fault else ""
    if wide:
        return [_Group(rank, "", (_Piece(f"  {head}: {text}", style),))]
    return [_Group(rank, "", (_Piece(head, style),)), _Group(max(rank, 8), "", (_Piece(f"  {text}"),))]


def _clock(utc_ns: int, form: str) -> str:
    try:
        return datetime.fromtimestamp(utc_ns // S, UTC).strftime(form)
    except (OverflowError, ValueError, OSError):
        return "?"


def _time(seconds: float) -> str:
    if not math.isfinite(seconds):
        return "? s"
    x = abs(seconds)
    if x < 0.0995:
        return f"{1e3 * x:.1f} ms" if x < 0.00995 else f"{1e3 * x:.0f} ms"
    if x < 9.95:
        return f"{x:.1f} s"
    for limit, unit, name in ((120, 1, "s"), (7200, 60, "min"), (172800, 3600, "h")):
        if x < limit:
            return f"{x / unit:.0f} {name}"
    return f"{x / 86400:.0f} d"


def _size(count: float) -> str:
    x = float(count)
    for name in ("B", "kB", "MB", "GB"):
        if abs(x) < 999.5:
            return f"{x:.0f} {name}" if name == "B" or x >= 99.95 else f"{x:.1f} {name}"
        x /= 1000
    return f"{x:.1f} TB"


def _mm(metres: float) -> str:
    x = 1e3 * metres
    return f"{x:+.2f}" if abs(x) < 1e4 else f"{x:+.0f}"


def _sd(metres: float) -> str:
    x = 1e3 * metres
    return f"{x:.2f}" if x < 100 else f"{x:.0f}"


def _percent(share: float) -> str:
    x = 100 * share
    return f"{x:.0f} %" if x >= 9.95 or x == 0 else f"{x:.1f} %"


def _blocks(count: int) -> str:
    return _many(count, "block", "blocks")


def _many(count: int, one: str, more: str) -> str:
    return f"{count} {one if count == 1 else more}"
