"""Recordings -> arrays, piece by piece in the order of the files, and a summary of any length in bounded memory.

`pieces` walks over files and hands out at most PIECE_S seconds at a time: fused blocks, fixes, verdicts, events, faults
as recorded; accelerations from `/accel/<id>/block` where that was recorded, else decoded from the raw frames by the
path's own codec and clock, set to the state of the segment's checkpoint. A file that is damaged or empty ends its walk
and is named in `Piece.damage`; the others go on.

`Overview` takes pieces and keeps envelopes (the least and largest value of every span: no extreme is ever lost, and
where nothing was there is no span), counts, gaps with their reasons and the events. Times here are UTC ns, for the
monotonic clock begins anew with each boot. Left out: mathematics (smooth, spectra, ...), drawing (report).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge_agent import assemble
from edge_agent.geodesy import Frame
from edge_agent.messages import F64, I64, U8, AccelFlag, CanFrames, Config, Quality, S, Verdict
from edge_agent.pipeline import Pipeline
from edge_agent.recording import topics
from edge_agent.recording.reader import DamagedError, Rows, Stored, read_messages, read_metadata, read_rows
from edge_agent.recording.writer import RUN_METADATA
from edge_agent.replay import CONFIG_NAME, ReplayError, in_order, recorded_config
from edge_agent.review.ahead import ahead, worth
from edge_agent.review.columns import groups
from edge_agent.review.learned import Learned, learned
from edge_agent.review.smooth import Accelerations, Fixes, plain
from edge_agent.timebase import with_times

PIECE_S = 30.0
"""Seconds of a piece, cut at whole multiples of UTC: 8 points at 250 Hz are 9 MB."""
FRAMES_NS = 5 * S, S // 2
"""Raw frames are decoded so much at a time where every sensor on the port counts its samples, and where one does not:
the same samples as live, their fitted times within some us, far below the clock's own sd. Without a counter a loss
shows only in the lateness of a dozen blocks, which must not take a minute."""
SPANS = 4000
"""Spans of an envelope at most: two for each pixel of a wide screen."""
KEPT = 5000
"""Events and gaps kept at most; what is beyond is counted."""


# --------------------------------------------------------------------------------------------------------------- pieces


@dataclass(frozen=True, slots=True)
class Fused:
    """The live stream of a point: utc_ns (n,), displacement and its sd (n, 3), mode, flags (n,)."""

    utc_ns: I64
    displacement_m: F64
    std_displacement_m: F64
    mode: U8
    flags: U8


@dataclass(frozen=True, slots=True)
class Fixed:
    """Fixes of a receiver: utc_ns (n,), t_ns (n,) monotonic, z_m (n, 3) in structure axes about the point's zero, NaN
    before there is a reference, std_m (n, 3) declared, quality, satellites (n,), latency_s, age_s (n,), velocity_mps
    (n, 2) along x and y by the receiver's own word (VTG), NaN = none."""

    utc_ns: I64
    t_ns: I64
    z_m: F64
    std_m: F64
    quality: U8
    satellites: I64
    latency_s: F64
    age_s: F64
    velocity_mps: F64


@dataclass(frozen=True, slots=True)
class Judged:
    """The gate's words on the fixes of a point: utc_ns, t_ns (n,), residual_m with its sd, std_m of the fix as used,
    offset_m (n, 3), ratio, verdict (n,)."""

    utc_ns: I64
    t_ns: I64
    residual_m: F64
    std_residual_m: F64
    std_m: F64
    offset_m: F64
    ratio: F64
    verdict: U8


@dataclass(frozen=True, slots=True)
class Accelerated:
    """Samples of an accelerometer: utc_ns, t_ns (n,), xyz (n, 3) m/s2, flags (n,) of AccelFlag."""

    utc_ns: I64
    t_ns: I64
    xyz: F64
    flags: U8


class Happened(NamedTuple):
    """An event or fault: UTC of its begin and end, monotonic time, kind, source, text, values."""

    begin_ns: int
    end_ns: int
    t_ns: int
    kind: str
    source: str
    text: str
    values: dict[str, float]
    fault: bool


@dataclass(frozen=True, slots=True)
class Piece:
    """What one file holds of some seconds. `first`: begins a file; `run`: the agent's run; `missing`: raw blocks that
    are not there before or in this piece; `damage`: why the file ends here, "" = it does not."""

    path: Path
    run: str
    first: bool
    fused: dict[str, Fused]
    fixes: dict[str, Fixed]
    judged: dict[str, Judged]
    accelerations: dict[str, Accelerated]
    happened: list[Happened]
    missing: int = 0
    damage: str = ""
    noted: list[Stored] = field(default_factory=list)  # headings and ticks as they are
    learned: list[Learned] = field(default_factory=list)  # at the head of a segment
    bias: dict[str, tuple[I64, F64, F64]] = field(default_factory=dict)  # of a point: utc_ns, m/s2 and its sd (n, 3)


class Share(NamedTuple):
    """Names of the points and accelerometers that one of several processes looks at."""

    points: frozenset[str]
    accelerometers: frozenset[str]


def configuration(paths: Sequence[Path]) -> Config:
    """The first configuration that is attached to a file. ReplayError where none is."""
    for path in paths:
        try:
            return recorded_config(path)
        except (OSError, DamagedError, ReplayError):
            continue
    told = ", ".join(str(p) for p in paths[:3]) + (f" and {len(paths) - 3} more" if len(paths) > 3 else "")
    raise ReplayError(f"no {CONFIG_NAME} is attached to {told}: one of the files must hold it, as the agent writes it")


def files_of(inputs: Sequence[Path]) -> tuple[list[Path], dict[Path, str]]:
    """Files among inputs (folders expanded) in order of time, each once, and those that hold nothing, with why."""
    good: list[Path] = []
    bad: dict[Path, str] = {}
    seen: set[Path] = set()
    for path in inputs:
        for file in sorted(p for p in path.iterdir() if ".mcap" in p.suffixes) if path.is_dir() else [path]:
            if file.resolve() in seen:
                continue
            seen.add(file.resolve())
            try:
                if file.stat().st_size == 0:
                    bad[file] = "empty"
                elif next(read_messages(file, WANTED), None) is None:
                    bad[file] = _strange(file)
                else:
                    read_metadata(file)
                    good.append(file)
            except OSError as e:
                bad[file] = e.strerror or str(e)
            except DamagedError as e:
                bad[file] = str(e).removeprefix(f"{file}: ")
    return (in_order(good) if good else []), bad


def _strange(file: Path) -> str:
    """Why a file without a topic of this program is of no use."""
    first = next(read_messages(file), None)
    if first is None:
        return "holds no message"
    return f"{STRANGE}: it holds {first.topic} and the like"


def pieces(
    files: Sequence[Path],
    config: Config,
    *,
    accelerations: bool = True,
    piece_s: float = PIECE_S,
    own: Mapping[Path, Config] | None = None,
) -> Iterator[Piece]:
    """Walk over files in the given order; `own`: configurations of files that have another. Large recordings are read
    by a second process where there is one to be had, with the same result."""
    args = list(files), config, accelerations, piece_s, dict(own or {})
    return map(_widened, ahead(_pieces, *args) if worth(files) else _pieces(*args))


def pieces_of(
    files: Sequence[Path], config: Config, own: Mapping[Path, Config], share: Share | None
) -> Iterator[Piece]:
    """The same by this process, with some points and accelerometers only (None: all): cut at the same places."""
    return map(_widened, _pieces(list(files), config, bool(config.accelerometers), PIECE_S, dict(own), share))


def _widened(piece: Piece) -> Piece:
    for name, f in piece.fused.items():
        piece.fused[name] = Fused(
            f.utc_ns,
            f.displacement_m.astype(np.float64),
            f.std_displacement_m.astype(np.float64),
            f.mode,
            f.flags,
        )
    return piece


def _pieces(
    files: list[Path],
    config: Config,
    accelerations: bool,
    piece_s: float,
    own: dict[Path, Config],
    share: Share | None = None,
) -> Iterator[Piece]:
    """The same with the fused stream in float32, as it is recorded: less to hand over."""
    for path in files:
        yield from _File(path, own.get(path, config), accelerations, round(piece_s * S), share).walk()


def window(
    files: Sequence[Path], point: str, *, begin_ns: int = -(1 << 62), end_ns: int = 1 << 62
) -> tuple[Fixes, Accelerations]:
    """What both sensors of a point said between two UTC times, all in memory: fixed solutions as declared, by their
    first run's monotonic clock, and accelerations. For `agree`, `split_fusion`, `second_difference`.

    ReplayError without a configuration, KeyError for a point that it does not name."""
    config = configuration(files)
    settings = config.points[point]
    rows: dict[str, list[tuple[Any, ...]]] = {"fixes": [], "accel": []}
    run: str | None = None
    for piece in pieces(files, config, accelerations=settings.accelerometer is not None):
        fixes = piece.fixes.get(settings.receiver or "")
        accel = piece.accelerations.get(settings.accelerometer or "")
        for kind, part in (("fixes", fixes), ("accel", accel)):
            if part is None:
                continue
            inside = (part.utc_ns >= begin_ns) & (part.utc_ns < end_ns)
            if inside.any() and run is None:
                run = piece.run
            if not inside.any() or piece.run != run:
                continue
            if isinstance(part, Fixed):
                inside &= (part.quality == Quality.FIXED) & np.isfinite(part.z_m).all(axis=1)
                rows[kind].append((part.t_ns[inside], part.z_m[inside], part.std_m[inside]))
            else:
                rows[kind].append((part.t_ns[inside], part.xyz[inside]))
    t, z, std = _together(rows["fixes"], 3)
    t_a, xyz = _together(rows["accel"], 2)
    rising = np.diff(t_a, prepend=t_a[:1] - 1) > 0
    return plain(t, z, np.where(np.isfinite(std) & (std > 0), std, 0.01)), Accelerations(t_a[rising], xyz[rising])


def _together(rows: list[tuple[Any, ...]], count: int) -> list[Any]:
    if not rows:
        return [np.zeros(0, np.int64), *(np.zeros((0, 3)) for _ in range(count - 1))]
    return [np.concatenate(c) for c in zip(*rows, strict=True)]


_FUSED, _JUDGED, _FIXES, _SINGLE, _ORDERED, _OTHERS = range(1, 7)
"""What is done with a topic's messages: decoded many at once; taken one by one; taken one by one in order with all
others, for they change what others mean; left to another process."""


def _kind(topic: str) -> tuple[int, str]:
    """That of a topic, 0 = not looked at, and the name of its point or receiver."""
    match topic.split("/"):
        case ["", "raw", "checkpoint"] | ["", "events"]:
            return _ORDERED, ""
        case ["", "raw", _] | ["", "faults"] | ["", "fusion", _, "heading"] | ["", "accel", _, "block"]:
            return _SINGLE, ""
        case ["", "fusion", name, "block"]:
            return _FUSED, name
        case ["", "fusion", name, "update"]:
            return _JUDGED, name
        case ["", "gnss", name, "solution"]:
            return _FIXES, name
    return 0, ""


STRANGE = "no recording of edge-agent"
"""Begins the reason for a file that is whole, but another program's."""


class _Wanted:
    """The topics that pieces are made of."""

    def __contains__(self, topic: object) -> bool:
        return _kind(str(topic))[0] != 0


WANTED = _Wanted()


def _fields(plain: str, threes: str) -> frozenset[str]:
    return frozenset([*plain.split(), *(f"{name}.{axis}" for name in threes.split() for axis in "xyz")])


_FIELDS = {
    _FUSED: _fields(
        "t_offset_ns mode flags "
        "displacement_x_m displacement_y_m displacement_z_m "
        "std_displacement_x_m std_displacement_y_m std_displacement_z_m",
        "bias_mps2 std_bias_mps2",
    ),
    _JUDGED: _fields("monotonic_ns ratio verdict", "residual_m std_residual_m std_fix_m offset_m"),
    _FIXES: _fields(
        "monotonic_ns east_m north_m up_m course_deg speed_mps fix satellites latency_ns age_s", "std_enu_m"
    ),
}
"""The fields of which rows are made."""


class _Many:
    """Messages of one kind that wait to be decoded together: content, whose it is, publish time [UTC ns]."""

    def __init__(self) -> None:
        self.schema = ""
        self.data: list[bytes] = []
        self.names: list[str] = []
        self.publish_ns: list[int] = []


class _File:
    """One file's walk: rows wait in lists until the piece is long enough."""

    def __init__(self, path: Path, config: Config, accelerations: bool, span_ns: int, share: Share | None) -> None:
        self.path, self.config, self.span_ns, self.share = path, config, span_ns, share
        try:
            self.run = read_metadata(path).get(RUN_METADATA, {}).get("run", "")
        except (OSError, DamagedError):
            self.run = ""
        self.decode_raw = accelerations
        self.pipeline: Pipeline = assemble.pipeline(config)
        self.axes = Frame((0.0, 0.0, 0.0), config.structure.azimuth_deg)
        unit = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        self.turn = np.array([self.axes.to_structure(e) for e in unit]).T
        self.zero = {name: np.zeros(3) for name in config.receivers}
        self.order: int | None = None
        self.waiting: dict[str, list[tuple[CanFrames, int]]] = {}  # port -> frames, UTC - monotonic
        counted = all(a.clock.counted for a in self.pipeline.accelerometers.values())
        self.frames_ns = FRAMES_NS[0 if counted else 1]
        self.cell = -1  # of the frames that wait
        self.first = True
        self.kinds: dict[str, tuple[int, str]] = {}
        self._new()

    def _new(self) -> None:
        self.rows: dict[tuple[str, str], list[tuple[Any, ...]]] = {}
        self.kept = {kind: _Many() for kind in (_FUSED, _JUDGED, _FIXES)}
        self.happened: list[Happened] = []
        self.missing = 0
        self.noted: list[Stored] = []
        self.learned: list[Learned] = []

    def walk(self) -> Iterator[Piece]:
        damage = ""
        try:
            span = -1
            for rows in read_rows(self.path):
                kinds = {c: self._kind_of(topic) for c, (topic, _) in rows.named.items()}
                table = np.zeros(max(kinds, default=0) + 1, np.uint8)
                table[list(kinds)] = [kind for kind, _ in kinds.values()]
                chosen = np.flatnonzero(table[rows.channel])
                cells, spans = rows.log_ns[chosen] // self.frames_ns, rows.log_ns[chosen] // self.span_ns
                cuts = np.flatnonzero((np.diff(cells) != 0) | (np.diff(spans) != 0)) + 1
                for lo, hi in pairwise([0, *cuts.tolist(), len(chosen)]):
                    if lo == hi:
                        continue
                    if cells[lo] != self.cell:  # not where a piece ends: that must not move the clocks
                        self._frames()
                        self.cell = int(cells[lo])
                    if spans[lo] != span:
                        if span >= 0:
                            yield self._piece("")
                        span = int(spans[lo])
                    self._take(rows, chosen[lo:hi], table, kinds)
        except (OSError, ValueError) as e:  # what no longer decodes is damage too
            damage = str(e)
        self._frames()
        yield self._piece(damage)

    def _kind_of(self, topic: str) -> tuple[int, str]:
        """`_kind`, 0 for another's points."""
        if topic not in self.kinds:
            kind, name = _kind(topic)
            if kind in (_FUSED, _JUDGED) and self.share is not None and name not in self.share.points:
                kind = _OTHERS
            self.kinds[topic] = kind, name
        return self.kinds[topic]

    def _decodes(self, accelerometer: str) -> bool:
        return self.share is None or accelerometer in self.share.accelerometers

    def _take(self, rows: Rows, k: I64, table: U8, kinds: dict[int, tuple[int, str]]) -> None:
        """Take rows k of a chunk, in the order of the file where it matters."""
        kind = table[rows.channel[k]]
        for lo, hi in pairwise([0, *(np.flatnonzero(kind == _ORDERED) + 1).tolist(), len(k)]):
            part, which = k[lo:hi], kind[lo:hi]
            last = hi > lo and which[-1] == _ORDERED
            for many in (_FUSED, _JUDGED, _FIXES):
                some = part[which == many]
                if len(some):
                    self._keep(self.kept[many], rows, some, kinds)
            for i in part[which == _SINGLE].tolist():
                self._single(_stored(rows, i))
            if last:
                s = _stored(rows, int(part[-1]))
                if s.topic == topics.CHECKPOINT_TOPIC:
                    self._checkpoint(s)
                else:
                    self._event(s)

    @staticmethod
    def _keep(many: _Many, rows: Rows, k: I64, kinds: dict[int, tuple[int, str]]) -> None:
        many.schema = many.schema or rows.named[int(rows.channel[k[0]])][1]
        begin, end = rows.begin[k].tolist(), rows.end[k].tolist()
        many.data += [rows.data[a:b] for a, b in zip(begin, end, strict=True)]
        many.names += [kinds[c][1] for c in rows.channel[k].tolist()]
        many.publish_ns += rows.publish_ns[k].tolist()

    def _single(self, s: Stored) -> None:
        if s.topic.startswith(topics.RAW_PREFIX):
            self._raw(s)
        elif s.topic == "/faults":
            self._event(s)
        elif s.topic.startswith("/fusion/"):  # a heading
            self.noted.append(s)
        else:
            name = s.topic.split("/")[2]
            self.decode_raw = False  # recorded at full rate: nothing to compute again
            self.waiting.clear()
            if self._decodes(name):
                b = topics.decode_accel_block(name, s.data)
                offset = s.publish_ns - int(b.t_ns[0])
                self._put("accel", name, b.t_ns + offset, b.t_ns, b.xyz, b.flags)

    def _checkpoint(self, s: Stored) -> None:
        point = topics.decode_checkpoint(s.data)
        try:
            self.pipeline.load(point.state)
            self.learned.append(learned(self.pipeline, s.publish_ns))
        except ValueError:  # another version's or other settings': codecs begin anew, which costs a moment
            self.pipeline = assemble.pipeline(self.config)
        for name in self.zero:
            self.zero[name] = np.array(self.pipeline.station.datum(name) or (0.0, 0.0, 0.0))

    def _raw(self, s: Stored) -> None:
        order = topics.raw_order(s.schema, s.data)
        if self.order is not None and order > self.order + 1:
            self.missing += order - self.order - 1
        self.order = order
        if s.schema == topics.TICK:
            self.noted.append(s)
        if not self.decode_raw or s.schema != topics.CAN_FRAMES:
            return
        raw = topics.decode_raw(s.topic, s.schema, s.data)
        if isinstance(raw.payload, CanFrames):
            offset = s.log_ns - raw.t_ns  # the segment's map
            wait = self.waiting.setdefault(raw.source, [])
            if wait and wait[0][1] != offset:
                self._frames()
                wait = self.waiting.setdefault(raw.source, [])
            wait.append((raw.payload, offset))

    def _frames(self) -> None:
        """Decode the frames that wait."""
        waiting, self.waiting = self.waiting, {}
        for source, wait in waiting.items():
            frames = _joined([w[0] for w in wait])
            for name, accelerometer in self.pipeline.accelerometers.items():
                if accelerometer.settings.port != source or not self._decodes(name):
                    continue
                block, _ = accelerometer.codec.feed(frames)
                if block is None or not block.t_ns.size:
                    continue
                t_ns, gap = accelerometer.clock.times(block)
                block = with_times(block, t_ns, t_ns is not block.t_ns, gap)
                self._put("accel", name, block.t_ns + wait[0][1], block.t_ns, block.xyz, block.flags)

    def _decode(self, kind: int) -> None:
        """Turn messages that wait into rows."""
        many = self.kept[kind]
        if not many.data:
            return
        self.kept[kind] = _Many()
        numbers = {name: i for i, name in enumerate(dict.fromkeys(many.names))}
        number = np.array([numbers[n] for n in many.names], np.int64)
        publish = np.array(many.publish_ns, np.int64)
        names = list(numbers)
        for group in groups(many.schema, many.data, _FIELDS[kind]):
            order = np.argsort(number[group.rows], kind="stable")
            whose = number[group.rows][order]
            edges = [0, *(np.flatnonzero(np.diff(whose)) + 1).tolist(), len(whose)]
            for lo, hi in pairwise(edges):
                k = order[lo:hi]
                one = {name: column[k] for name, column in group.columns.items()}
                self._rows_of(kind, names[int(whose[lo])], publish[group.rows[k]], one)

    def _rows_of(self, kind: int, name: str, utc: I64, c: dict[str, Any]) -> None:
        """Rows of one point or receiver from the columns of its messages, published at `utc`."""
        if kind == _FUSED:
            self._put("bias", name, utc, _three(c, "bias_mps2"), _three(c, "std_bias_mps2"))
            three = (
                np.stack([c[f"{what}_{axis}_m"].reshape(-1) for axis in "xyz"], axis=1)
                for what in ("displacement", "std_displacement")
            )
            times = (utc[:, None] + c["t_offset_ns"]).reshape(-1)
            self._put("fused", name, times, *three, c["mode"].reshape(-1), c["flags"].reshape(-1))
            return
        t = c["monotonic_ns"][:, 0]
        if kind == _JUDGED:
            three = (_three(c, k) for k in ("residual_m", "std_residual_m", "std_fix_m", "offset_m"))
            self._put("judged", name, utc, t, *three, c["ratio"][:, 0].astype(np.float64), c["verdict"][:, 0])
            return
        enu = np.stack([c[k][:, 0] for k in ("east_m", "north_m", "up_m")], axis=1)
        z = enu @ self.turn.T - self.zero.get(name, np.zeros(3))
        std = _three(c, "std_enu_m")
        std = np.array([self.axes.std_to_structure((e, n, u)) for e, n, u in std.tolist()])
        course, speed = np.radians(c["course_deg"][:, 0].astype(np.float64)), c["speed_mps"][:, 0]
        velocity = np.stack([speed * np.sin(course), speed * np.cos(course)], axis=1) @ self.turn[:2, :2].T
        self._put(
            "fixes", name, utc, t, z, std, c["fix"][:, 0], c["satellites"][:, 0].astype(np.int64),
            c["latency_ns"][:, 0] / S, c["age_s"][:, 0].astype(np.float64), velocity,
        )  # fmt: skip

    def _event(self, s: Stored) -> None:
        d = topics.decode(s.schema, s.data)
        values = {v["name"]: float(v["value"]) for v in d["values"]}
        begin, end = (d[k]["sec"] * S + d[k]["nanosec"] for k in ("begin", "end"))
        fault = s.topic == "/faults"
        self.happened.append(Happened(begin, end, d["monotonic_ns"], d["kind"], d["source"], d["text"], values, fault))
        if d["kind"] == "REFERENCE" and d["source"] in self.zero and {"x_m", "y_m", "z_m"} <= values.keys():
            self._decode(_FIXES)  # those before count from the old zero
            self.zero[d["source"]] = np.array([values["x_m"], values["y_m"], values["z_m"]])

    def _put(self, kind: str, name: str, *columns: Any) -> None:
        self.rows.setdefault((kind, name), []).append(columns)

    def _piece(self, damage: str) -> Piece:
        for kind in self.kept:
            self._decode(kind)

        def joined(kind: str) -> dict[str, list[Any]]:
            out = {}
            for (k, name), rows in self.rows.items():
                if k == kind:
                    columns = [np.concatenate(c) for c in zip(*rows, strict=True)]
                    if (columns[0][1:] < columns[0][:-1]).any():  # groups of messages came one after the other
                        order = np.argsort(columns[0], kind="stable")
                        columns = [c[order] for c in columns]
                    out[name] = columns
            return out

        piece = Piece(
            self.path,
            self.run,
            self.first,
            {k: Fused(*c) for k, c in joined("fused").items()},
            {k: Fixed(*c) for k, c in joined("fixes").items()},
            {k: Judged(*c) for k, c in joined("judged").items()},
            {k: Accelerated(*c) for k, c in joined("accel").items()},
            self.happened,
            self.missing,
            damage,
            self.noted,
            self.learned,
            {k: (c[0], c[1], c[2]) for k, c in joined("bias").items()},
        )
        self.first = False
        self._new()
        return piece


def _stored(rows: Rows, i: int) -> Stored:
    """A row as a message of its own; its number within its channel is not known."""
    topic, schema = rows.named[int(rows.channel[i])]
    data = rows.data[int(rows.begin[i]) : int(rows.end[i])]
    return Stored(topic, schema, int(rows.log_ns[i]), int(rows.publish_ns[i]), 0, data)


def _three(c: dict[str, Any], name: str) -> F64:
    return np.concatenate([c[f"{name}.{axis}"] for axis in "xyz"], axis=1).astype(np.float64)


def _joined(blocks: list[CanFrames]) -> CanFrames:
    """Blocks of one port as one; narrow ones are filled with zeros."""
    if len(blocks) == 1:
        return blocks[0]
    width = max(b.data.shape[1] for b in blocks)
    data = [
        b.data if b.data.shape[1] == width else np.pad(b.data, ((0, 0), (0, width - b.data.shape[1]))) for b in blocks
    ]
    return CanFrames(
        np.concatenate([b.t_ns for b in blocks]),
        np.concatenate([b.can_id for b in blocks]),
        np.concatenate([b.flags for b in blocks]),
        np.concatenate([b.length for b in blocks]),
        np.concatenate(data),
        sum(b.dropped for b in blocks),
    )


# ------------------------------------------------------------------------------------------------------------- overview


class Envelope:
    """Least and largest value of every span of time, for columns (c,). Spans double in length when there are too many,
    so memory is bounded and every extreme stays."""

    def __init__(self, columns: int, span_ns: int = S, most: int = SPANS) -> None:
        self.span_ns, self.most = span_ns, most
        self._key: I64 = np.zeros(0, np.int64)
        self._low: F64 = np.zeros((0, columns))
        self._high: F64 = np.zeros((0, columns))
        self._count: I64 = np.zeros(0, np.int64)

    def add(self, utc_ns: I64, values: F64) -> None:
        """Samples (n,), (n, c) or (n,) values; NaN values count as nothing."""
        if not len(utc_ns):
            return
        columns = values.reshape(len(utc_ns), -1)
        key = utc_ns // self.span_ns
        if (key[1:] < key[:-1]).any():
            order = np.argsort(key, kind="stable")
            key, columns = key[order], columns[order]
        starts = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
        # fmin and fmax pass NaN over
        low, high = np.fmin.reduceat(columns, starts, axis=0), np.fmax.reduceat(columns, starts, axis=0)
        self._merge(
            np.concatenate([self._key, key[starts]]),
            np.concatenate([self._low, np.where(np.isnan(low), np.inf, low)]),
            np.concatenate([self._high, np.where(np.isnan(high), -np.inf, high)]),
            np.concatenate([self._count, np.diff(starts, append=len(key))]),
        )
        while len(self._key) > self.most:
            self.span_ns *= 2
            self._merge(self._key // 2, self._low, self._high, self._count)

    def _merge(self, key: I64, low: F64, high: F64, count: I64) -> None:
        order = np.argsort(key, kind="stable")
        key = key[order]
        starts = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
        self._key = key[starts]
        self._low = np.minimum.reduceat(low[order], starts, axis=0)
        self._high = np.maximum.reduceat(high[order], starts, axis=0)
        self._count = np.add.reduceat(count[order], starts)

    def spans(self) -> tuple[I64, F64, F64, I64]:
        """Middles (k,) UTC ns of the spans that hold something; low, high (k, c), NaN where only NaN was; count."""
        low, high = (np.where(np.isfinite(v), v, np.nan) for v in (self._low, self._high))
        return self._key * self.span_ns + self.span_ns // 2, low, high, self._count


class Silence(NamedTuple):
    """A stretch of a stream without data, UTC ns, and why."""

    begin_ns: int
    end_ns: int
    reason: str


class Stream:
    """Coverage of one stream: how many samples, the usual interval, and where it was silent."""

    def __init__(self, least_s: float = 1.0) -> None:
        self.samples = 0
        self.begin_ns = self.end_ns = -1
        self.usual_ns = 0.0
        self.covered_ns = 0
        self.silences: list[tuple[int, int]] = []
        self.more = 0  # silences beyond the list, the shortest ones
        self._least_ns = round(least_s * S)

    def add(self, utc_ns: I64) -> None:
        if not len(utc_ns):
            return
        before = utc_ns[:1] if self.end_ns < 0 else np.array([self.end_ns])
        steps = np.diff(utc_ns, prepend=before)
        inner = steps[steps > 0]
        if len(inner) and not self.usual_ns:
            self.usual_ns = float(np.median(inner))
        limit = max(self._least_ns, 3.5 * self.usual_ns)
        for i in np.flatnonzero(steps > limit).tolist():
            self.silences.append((int(utc_ns[i] - steps[i]), int(utc_ns[i])))
        if len(self.silences) > 2 * KEPT:
            self.silences.sort(key=lambda s: s[0] - s[1])
            self.more += len(self.silences) - KEPT
            self.silences = self.silences[:KEPT]
        self.covered_ns += int(steps[(steps > 0) & (steps <= limit)].sum())
        if self.begin_ns < 0:
            self.begin_ns = int(utc_ns[0])
        self.end_ns = max(self.end_ns, int(utc_ns[-1]))
        self.samples += len(utc_ns)


@dataclass
class Point:
    """What a point did. Envelopes in m: displacement and its sd; of the gate: residual, ratio."""

    stream: Stream = field(default_factory=lambda: Stream())
    displacement: Envelope = field(default_factory=lambda: Envelope(3))
    std: Envelope = field(default_factory=lambda: Envelope(3))
    residual: Envelope = field(default_factory=lambda: Envelope(3))
    ratio: Envelope = field(default_factory=lambda: Envelope(1))
    modes: dict[int, int] = field(default_factory=dict)  # samples per Mode
    verdicts: dict[int, int] = field(default_factory=dict)  # fixes per Verdict
    over: int = 0  # fixes at the gate with a ratio above 1


@dataclass
class Receiver:
    """What a receiver said: fixes per quality, and the quality over time (columns: the quality's number)."""

    stream: Stream = field(default_factory=lambda: Stream())
    position: Envelope = field(default_factory=lambda: Envelope(3))
    latency: Envelope = field(default_factory=lambda: Envelope(1))
    satellites: Envelope = field(default_factory=lambda: Envelope(1))
    age: Envelope = field(default_factory=lambda: Envelope(1))
    qualities: dict[int, int] = field(default_factory=dict)
    spells: list[tuple[int, int, int]] = field(default_factory=list)  # begin, end UTC ns, quality; the first KEPT


@dataclass
class Accelerometer:
    """What an accelerometer said: envelope in m/s2, samples per flag."""

    stream: Stream = field(default_factory=lambda: Stream(0.5))
    xyz: Envelope = field(default_factory=lambda: Envelope(3))
    flags: dict[int, int] = field(default_factory=dict)  # samples per AccelFlag


class Overview:
    """Everything that a report tells of any length of recordings. `add` each piece; then read the fields and `why`."""

    def __init__(self) -> None:
        self.points: dict[str, Point] = {}
        self.receivers: dict[str, Receiver] = {}
        self.accelerometers: dict[str, Accelerometer] = {}
        self.happened: list[Happened] = []
        self.kinds: dict[str, int] = {}
        self.files: dict[Path, str] = {}  # damage, "" = none
        self.runs: list[str] = []
        self.missing = 0

    def add(self, piece: Piece) -> None:
        self.files[piece.path] = piece.damage or self.files.get(piece.path, "")
        if piece.run not in self.runs:
            self.runs.append(piece.run)
        self.missing += piece.missing
        for h in piece.happened:
            self.kinds[h.kind] = self.kinds.get(h.kind, 0) + 1
            if len(self.happened) < KEPT:
                self.happened.append(h)
        for name, f in piece.fused.items():
            p = self.points.setdefault(name, Point())
            p.stream.add(f.utc_ns)
            p.displacement.add(f.utc_ns, f.displacement_m)
            p.std.add(f.utc_ns, f.std_displacement_m)
            _count(p.modes, f.mode)
        for name, j in piece.judged.items():
            p = self.points.setdefault(name, Point())
            gated = np.isin(j.verdict, (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.OFFSET))
            p.residual.add(j.utc_ns[gated], j.residual_m[gated])
            p.ratio.add(j.utc_ns[gated], j.ratio[gated])
            p.over += int((j.ratio[gated] > 1.0).sum())
            _count(p.verdicts, j.verdict)
        for name, x in piece.fixes.items():
            r = self.receivers.setdefault(name, Receiver())
            r.stream.add(x.utc_ns)
            for envelope, values in ((r.position, x.z_m), (r.latency, x.latency_s), (r.age, x.age_s)):
                envelope.add(x.utc_ns, values)
            r.satellites.add(x.utc_ns, x.satellites.astype(np.float64))
            _count(r.qualities, x.quality)
            self._spells(r, x)
        for name, a in piece.accelerations.items():
            s = self.accelerometers.setdefault(name, Accelerometer())
            s.stream.add(a.utc_ns)
            s.xyz.add(a.utc_ns, a.xyz)
            for flag in AccelFlag:
                hit = int(((a.flags & flag.value) != 0).sum())
                if hit:
                    s.flags[flag.value] = s.flags.get(flag.value, 0) + hit

    @staticmethod
    def _spells(r: Receiver, x: Fixed) -> None:
        """Spells of one quality; a silence ends one."""
        if not len(x.utc_ns):
            return
        limit = max(S, round(3.5 * r.stream.usual_ns))
        parts = np.flatnonzero(
            (np.diff(x.quality, prepend=x.quality[:1]) != 0) | (np.diff(x.utc_ns, prepend=x.utc_ns[:1]) > limit)
        )
        for lo, hi in zip([0, *parts.tolist()], [*parts.tolist(), len(x.quality)], strict=True):
            if hi <= lo:
                continue
            begin, end, quality = int(x.utc_ns[lo]), int(x.utc_ns[hi - 1]), int(x.quality[lo])
            last = r.spells[-1] if r.spells else None
            if last is not None and last[2] == quality and 0 <= begin - last[1] <= limit:
                r.spells[-1] = last[0], end, quality
            elif len(r.spells) < KEPT:
                r.spells.append((begin, end, quality))

    def why(self, stream: Stream, known: Sequence[tuple[int, int, str]] = ()) -> list[Silence]:
        """The silences of a stream in order of time with their reasons: a known gap of the raw data (begin, end UTC ns,
        reason: `verify`'s), else what happened meanwhile, else "silent"."""
        out = []
        for begin, end in sorted(stream.silences):
            reason = next((r for b, e, r in known if b < end and e > begin), "")
            if not reason:
                inside = [h for h in self.happened if h.begin_ns <= end + S and h.end_ns >= begin - S]
                reason = next((h.kind for h in inside if h.kind in _REASONS), "silent")
            out.append(Silence(begin, end, reason))
        return out


_REASONS = ("LOSS", "ACCEL_LOST", "ACCEL_GAP", "CLOCK_STEP", "GNSS_TIME_STEP", "OUTAGE_END", "MODE", "START")
"""Kinds of events that explain a silence by themselves."""


def _count(into: dict[int, int], values: U8) -> None:
    for value, n in zip(*np.unique(values, return_counts=True), strict=True):
        into[int(value)] = into.get(int(value), 0) + int(n)


def overview(inputs: Sequence[Path], *, accelerations: bool = True) -> Overview:
    """Summary of files and folders. ReplayError where nothing among them holds a configuration."""
    files, bad = files_of(inputs)
    out = Overview()
    for piece in pieces(files, configuration(files), accelerations=accelerations):
        out.add(piece)
    out.files.update(bad)
    return out
