"""Recordings as text: any topic as CSV or JSON lines, and what a file holds.

Rules: the columns of a topic follow from its message text, so nothing here knows one message from another but CAN
frames; blocks are unrolled to one row per sample. Each column wears its unit. Enumerations and flags are words. A
number is written in the fewest digits that give it back; NaN is an empty cell (CSV) or null (JSON). `time` is when a
value was true, `log_time` when its cause was received, both UTC.

Left out: plots, other file formats.
"""

from __future__ import annotations

import csv
import datetime
import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from edge_agent.messages import CanFlag, CanFrames, S
from edge_agent.recording import reader, topics
from edge_agent.recording.schemas import Field, full_name, parse_schema
from edge_agent.recording.writer import PART, RUN_METADATA

UNITS = {
    "ns": "ns",
    "s": "s",
    "m": "m",
    "m2": "m2",
    "mps": "m/s",
    "mps2": "m/s2",
    "deg": "deg",
    "hz": "Hz",
}
"""Last part of a field's name -> unit."""
PLAIN_UNITS = {  # fields that ROS 2 named without a unit
    topics.NAV_SAT_FIX: {"latitude": "deg", "longitude": "deg", "altitude": "m", "position_covariance": "m2"},
    topics.ACCEL: {"x": "m/s2", "y": "m/s2", "z": "m/s2"},
    topics.TF: {"translation": "m"},
}
MAPS = ("edge_agent_msgs/msg/NamedValue", "diagnostic_msgs/msg/KeyValue")
"""Lists of these are one cell of name=value."""
STAMP = "builtin_interfaces/msg/Time"
OFFSETS = "t_offset_ns"
"""A message with this field is a block: its sequences are columns of samples."""

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Table:
    """How the messages of one schema become rows."""

    schema: str
    types: dict[str, tuple[Field, ...]]
    text: str

    @classmethod
    def of(cls, schema: str, text: str) -> Table:
        return cls(full_name(schema), parse_schema(schema, text), text)

    def rows(self, stored: reader.Stored) -> Iterator[Row]:
        """Rows of one message: `time_ns` and `log_time_ns` (int UTC), then the columns. ValueError if damaged."""
        if self.schema == topics.CAN_FRAMES:
            yield from _can_rows(stored)
            return
        message = topics.decode(self.schema, stored.data, self.text)
        head: Row = {"time_ns": stored.publish_ns, "log_time_ns": stored.log_ns}
        fields = self.types[self.schema]
        if OFFSETS in message:
            yield from self._block_rows(head, fields, message)
            return
        lists = [f for f in fields if f.length == -1 and f.type in self.types and f.type not in MAPS]
        scalar = dict(self._cells([f for f in fields if f not in lists], message, (), ""))
        if not lists:
            yield head | scalar
        for f in lists:
            for item in message[f.name]:
                yield head | scalar | dict(self._cells(self.types[f.type], item, (), ""))

    def _block_rows(self, head: Row, fields: Sequence[Field], message: dict[str, Any]) -> Iterator[Row]:
        offsets = message[OFFSETS].tolist()
        columns = [f for f in fields if f.length == -1 and f.name != OFFSETS]
        samples: dict[str, list[Any]] = {}
        for f in columns:
            values = message[f.name]
            if len(values) != len(offsets):
                raise ValueError(f"{f.name} has {len(values)} values for {len(offsets)} samples")
            samples[self._title((f.name,))] = [
                _plain(f, v) for v in (values if f.type == "float32" else values.tolist())
            ]
        scalar = dict(self._cells([f for f in fields if f not in columns and f.name != OFFSETS], message, (), ""))
        first = scalar.pop("monotonic [ns]", None)
        for i, offset in enumerate(offsets):
            row: Row = {"time_ns": head["time_ns"] + offset, "log_time_ns": head["log_time_ns"]}
            if first is not None:
                row["monotonic [ns]"] = first + offset
            for name, values in samples.items():
                row[name] = values[i]
            row.update(scalar)
            yield row

    def _cells(
        self, fields: Iterable[Field], message: dict[str, Any], path: tuple[str, ...], unit: str
    ) -> Iterator[tuple[str, Any]]:
        for f in fields:
            value = message[f.name]
            at = (*path, f.name)
            unit_here = PLAIN_UNITS.get(self.schema, {}).get(f.name, unit)
            if f.type == "std_msgs/msg/Header":
                if value["frame_id"]:
                    yield "frame_id", value["frame_id"]
            elif f.type == STAMP:
                if f.name != "stamp":  # that one is publish_time
                    yield "_".join(at), iso(value["sec"] * S + value["nanosec"])
            elif f.type in MAPS:
                names = [g.name for g in self.types[f.type]]
                yield "_".join(at), {v[names[0]]: v[names[1]] for v in value}
            elif f.length is None and f.type in self.types:
                yield from self._cells(self.types[f.type], value, at, unit_here)
            elif f.type == "uint8" and f.length == -1:
                yield "_".join(at), printable(value.tobytes()) if f.name == "data" else f"{len(value)} bytes"
            elif f.length is not None:
                for i, v in enumerate(value):
                    yield self._title((*at, str(i)), unit_here), _plain(f, v)
            else:
                yield self._title(at, unit_here), _plain(f, value)

    def _title(self, path: tuple[str, ...], unit: str = "") -> str:
        """("std_displacement_m", "x") -> "std_displacement_x [m]"."""
        words: list[str] = []
        for part in path:
            stem, _, last = part.rpartition("_")
            if stem and last in UNITS:
                unit = UNITS[last]
                part = stem
            words.append(part)
        return "_".join(words) + (f" [{unit}]" if unit else "")


def _plain(f: Field, value: Any) -> Any:
    """A number in the fewest digits, an enumeration or flags in words."""
    if f.names:
        return _word(tuple(f.names.items()), int(value))
    if f.type == "float32":
        return float(str(np.float32(value)))  # 0.1, not 0.10000000149011612
    return value.item() if isinstance(value, np.generic) else value


@lru_cache(maxsize=1024)
def _word(names: tuple[tuple[int, str], ...], number: int) -> str:
    """Name of an enumeration's value; names of the bits that are set, where the names are flags."""
    if all(name.startswith("FLAG_") for _, name in names):
        return "|".join(name.removeprefix("FLAG_") for bit, name in names if number & bit)
    return dict(names).get(number, str(number))


_CAN_FLAGS = tuple((f.value, f"FLAG_{f.name}") for f in CanFlag)


_EXT, _RTR = int(CanFlag.EXT), int(CanFlag.RTR)


def _can_rows(stored: reader.Stored) -> Iterator[Row]:
    raw = topics.decode_raw(stored.topic, stored.schema, stored.data)
    frames = raw.payload
    if not isinstance(frames, CanFrames):
        raise ValueError(f"{stored.topic}: no frames")
    columns = (frames.t_ns.tolist(), frames.can_id.tolist(), frames.flags.tolist(), frames.length.tolist())
    for i, (t_ns, can_id, flags, length) in enumerate(zip(*columns, strict=True)):
        yield {
            "time_ns": stored.log_ns + t_ns - raw.t_ns,
            "log_time_ns": stored.log_ns,
            "order": raw.order,
            "monotonic [ns]": t_ns,
            "id": f"{can_id:08X}" if flags & _EXT else f"{can_id:03X}",
            "flags": _word(_CAN_FLAGS, flags),
            "length [bytes]": length,
            "data": "" if flags & _RTR else frames.data[i, :length].tobytes().hex().upper(),
            "dropped": frames.dropped if i == 0 else 0,
        }


def printable(data: bytes) -> str:
    """Bytes as ASCII text; what does not print as \\xNN, \\r, \\n; a backslash doubled."""
    return data.decode("latin-1").encode("unicode_escape").decode("ascii")


def iso(utc_ns: int) -> str:
    """UTC as 2021-07-26T05:19:59.721150000Z."""
    sec, ns = divmod(utc_ns, S)
    return f"{_second(sec)}.{ns:09d}Z"


@lru_cache(maxsize=16)
def _second(sec: int) -> str:
    return f"{datetime.datetime.fromtimestamp(sec, datetime.UTC):%Y-%m-%dT%H:%M:%S}"


def parse_time(text: str) -> int:
    """UTC ns of an ISO time (without zone: UTC) or of seconds since 1970. Raises ValueError."""
    try:
        whole, _, part = text.partition(".")
        if whole.isdecimal() and (part.isdecimal() or not part) and len(whole) > 4:
            return int(whole) * S + int(part[:9].ljust(9, "0"))
        t = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise ValueError(f"{text!r} is no time; write 2026-05-01T12:00:00 or seconds since 1970") from None
    t = t.replace(tzinfo=datetime.UTC) if t.tzinfo is None else t
    return ((t - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)) // datetime.timedelta(microseconds=1)) * 1000


# ----------------------------------------------------------------------------------------------------------------- cat


def rows(
    paths: Iterable[Path], wanted: Sequence[str] = (), begin_ns: int | None = None, end_ns: int | None = None
) -> Iterator[tuple[str, Row]]:
    """(topic, row) of the wanted topics (all if none is named) of several files, in their order, with
    begin_ns <= time < end_ns. Raises OSError, and ValueError for a file that is no recording."""
    for path in paths:
        tables: dict[str, Table] = {}
        for stored in reader.read_messages(path, wanted or None):
            if stored.schema not in tables:
                tables[stored.schema] = Table.of(stored.schema, _schema_text(path, stored.schema))
            for row in tables[stored.schema].rows(stored):
                t = row["time_ns"]
                if (begin_ns is None or t >= begin_ns) and (end_ns is None or t < end_ns):
                    yield stored.topic, row


def _schema_text(path: Path, schema: str) -> str:
    """The message text of a schema; for one that this program does not write, the file's own."""
    text = topics.SCHEMAS.get(schema) or reader.info(path).schemas.get(schema)
    if text is None:
        raise ValueError(f"{path}: has no message text for {schema!r}")
    return text


def topics_of(paths: Iterable[Path]) -> list[str]:
    """Every topic of some files, sorted."""
    return sorted({topic for path in paths for topic in reader.info(path).topics})


def write_csv(out: TextIO, table: Iterable[tuple[str, Row]]) -> int:
    """One topic as CSV with a header; returns the rows written."""
    writer = csv.writer(out, lineterminator="\n")
    names: list[str] | None = None
    n = 0
    for _, row in table:
        if names is None:
            names = list(row)
            writer.writerow([_title_of(name) for name in names])
        writer.writerow([_cell(name, row.get(name)) for name in names])
        n += 1
    return n


def write_jsonl(out: TextIO, table: Iterable[tuple[str, Row]]) -> int:
    """Any topics as one JSON object a line; returns the lines written."""
    n = 0
    for topic, row in table:
        values = {_title_of(k): iso(v) if k in _TIMES else _finite(v) for k, v in row.items()}
        out.write(json.dumps({"topic": topic, **values}, ensure_ascii=False) + "\n")
        n += 1
    return n


_TIMES = ("time_ns", "log_time_ns")


def _title_of(name: str) -> str:
    return f"{name.removesuffix('_ns')} [UTC]" if name in _TIMES else name


def _cell(name: str, value: Any) -> Any:
    if name in _TIMES:
        return iso(value)
    if isinstance(value, dict):
        return ";".join(f"{k}={v}" for k, v in value.items())
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    return value


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


# ---------------------------------------------------------------------------------------------------------------- info


def describe(paths: Iterable[Path]) -> tuple[list[dict[str, Any]], bool]:
    """What each file holds, as plain values for JSON, and whether something in one is not as it should be.

    A file that cannot be read has `damage` and nothing else; the others are described all the same.
    """
    files: list[dict[str, Any]] = []
    unreadable: list[dict[str, Any]] = []
    for path in paths:
        try:
            info = reader.info(path)
        except OSError as e:
            unreadable.append({"file": str(path), "damage": f"cannot be read: {e.strerror or e}"})
            continue
        except ValueError as e:
            unreadable.append({"file": str(path), "damage": str(e).removeprefix(f"{path}: ")})
            continue
        empty = info.messages == 0
        seconds = (info.end_ns - info.start_ns) / S
        files.append(
            {
                "file": str(path),
                "bytes": info.size,
                "complete": info.complete,
                "damage": info.damage,
                "begin_utc": None if empty else iso(info.start_ns),
                "end_utc": None if empty else iso(info.end_ns),
                "seconds": seconds,
                "messages": info.messages,
                "topics": {
                    name: {
                        "schema": topic.schema,
                        "messages": topic.count,
                        "bytes": topic.size,
                        "rate_hz": _rate(topic),
                        "longest_gap_s": topic.longest_ns / S,
                    }
                    for name, topic in sorted(info.topics.items())
                },
                "metadata": info.metadata,
                "continuity": _continuity(path, info.metadata.get(RUN_METADATA, {})),
                "attachments": {name: size for name, _, size in info.attachments},
                "missing_before": _missing_before(files, info.metadata.get(RUN_METADATA, {})),
                "missing_blocks": [
                    {"after_order": gap.after, "before_order": gap.before, "utc": iso(gap.log_ns)} for gap in info.gaps
                ],
            }
        )
    wanting = bool(unreadable) or any(
        f["damage"]
        or not (f["complete"] or f["file"].endswith(PART))  # which is being written: read as far as it goes
        or f["missing_blocks"]
        or f["missing_before"]
        or f["continuity"].startswith(CHANGED)
        for f in files
    )
    return files + unreadable, wanting


def _missing_before(files: Sequence[Mapping[str, Any]], run: Mapping[str, str]) -> int:
    """How many files of the same run lie between this one and the one of a lower number that was named before it."""
    number = reader.count(run.get("segment", ""))
    same = [
        f["metadata"][RUN_METADATA] for f in files if f["metadata"].get(RUN_METADATA, {}).get("run") == run.get("run")
    ]
    if not number or not run.get("run"):
        return 0
    lower = [n for n in (reader.count(r["segment"]) for r in same if r.get("segment")) if n < number]
    return number - max(lower) - 1 if lower else 0


CHANGED = "changed"


def _continuity(path: Path, run: Mapping[str, str]) -> str:
    """How a file ties in with the one that it names as its predecessor, which is looked for beside it."""
    name, sha256 = run.get("previous_name", ""), run.get("previous_sha256", "")
    if not name:
        return "names no file before it"
    before = path.parent / name
    if Path(name).name != name or not before.is_file():
        return f"follows {name}, which is not here"
    with before.open("rb") as f:
        same = hashlib.file_digest(f, "sha256").hexdigest() == sha256
    return f"follows {name}" if same else f"{CHANGED}: {name} is not as it was when this file began"


def _rate(topic: reader.TopicInfo) -> float | None:
    """Messages a second between the first and the last; None for fewer than two instants."""
    span = topic.last_ns - topic.first_ns
    return round((topic.count - 1) / (span / S), 3) if span > 0 else None


def describe_text(files: Sequence[dict[str, Any]]) -> str:
    """`describe` for people."""
    lines: list[str] = []
    for f in files:
        if "bytes" not in f:
            lines.append(f"{f['file']}: {f['damage']}")
            continue
        state = f["damage"] or ("complete" if f["complete"] else "no index: being written or torn, see `recover`")
        lines.append(f"{f['file']}: {f['bytes'] / 1e6:.3f} MB, {f['messages']} messages, {state}")
        if f["begin_utc"]:
            lines.append(f"  {f['begin_utc']} to {f['end_utc']}, {f['seconds']:.3f} s")
        for name, values in f["metadata"].items():
            lines.append(f"  {name}: " + ", ".join(f"{k}={_short(v)}" for k, v in values.items() if v))
        lines.append(f"  {f['continuity']}")
        if f["missing_before"]:
            lines.append(f"  {f['missing_before']} file(s) of this run before it are missing")
        if f["attachments"]:
            lines.append("  attached: " + ", ".join(f"{k} ({v} bytes)" for k, v in f["attachments"].items()))
        for gap in f["missing_blocks"]:
            n = gap["before_order"] - gap["after_order"] - 1
            lines.append(f"  {gap['utc']}: {n} raw block(s) missing after number {gap['after_order']}")
        if f["topics"]:
            width = max(len(name) for name in f["topics"])
            lines.append(f"  {'topic':<{width}}  messages  rate [Hz]  longest gap [s]      bytes  type")
        for name, t in f["topics"].items():
            rate = "-" if t["rate_hz"] is None else f"{t['rate_hz']:.3f}"
            lines.append(
                f"  {name:<{width}}  {t['messages']:8d}  {rate:>9}  {t['longest_gap_s']:15.3f}  {t['bytes']:9d}  "
                f"{t['schema'].rpartition('/')[2]}"
            )
    return "\n".join(lines)


def _short(text: str) -> str:
    """One line of at most 80 characters."""
    line = " ".join(text.split())
    return line if len(line) <= 80 else f"{line[:77]}..."
