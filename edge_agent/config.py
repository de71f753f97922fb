"""The one strict configuration: YAML text -> frozen `messages.Config`, or every mistake at once.

Rules: keys, types and defaults are those of the dataclasses in `messages`; nothing is written twice. An unknown key
stops. A mistake names its path, its line and what would be right, and does not hide the next one. Names become topics
and file names, so they are short and plain. Values are read as YAML 1.2 reads them (`on` and `no` are words, `010` is
ten, `1e-3` is a number), a key stands once, anchors and aliases are refused, and so is a file above its size limit.

Left out: whether a device exists or answers. That is a property of the day, not of the text (`check`).
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import enum
import json
import math
import re
import reprlib
import types
import typing
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from edge_agent.messages import (
    AccelerometerSettings,
    Config,
    EventSettings,
    FusionSettings,
    PointSettings,
    PortSettings,
    ReceiverSettings,
    RecordSettings,
    SignalField,
    Structure,
    TriggerSettings,
)

MAX_YAML_BYTES = 1 << 18
"""A configuration of 1000 points takes 100 kB; a hostile one of this size costs 100 MB and some seconds to refuse."""
MAX_FILE_BYTES = 16 << 20
"""The largest DBC files of vehicle makers stay below 10 MiB; each is attached to every segment."""
MAX_DEPTH = 12
"""The deepest path of a valid file has five steps."""
MAX_GUESSES = 100
"""Unknown keys of one file for which the nearest known one is looked up (0.3 ms each)."""

NAME = re.compile(r"[A-Za-z0-9_-]{1,32}\Z")
NAME_RULE = "a name is 1 to 32 of the characters A-Z a-z 0-9 _ -"
RESERVED_PORTS = ("clock", "checkpoint")  # topics /raw/clock and /raw/checkpoint are the agent's own

PORT_KEYS = {
    "serial": ("device", "baud"),
    "can": ("interface", "channel", "bitrate", "fd", "drain_ms", "block_ms"),
}
"""Which fields of PortSettings belong to which kind."""

_YAML_NAME = {"can_id": "id", "is_float": "float"}  # field of a dataclass -> key in the YAML, where they differ
_MADE_HERE = ("name", "dbc_text")  # fields that the YAML does not hold
_CHOICES: dict[str, tuple[str, ...]] = {
    "kind": tuple(PORT_KEYS),
    "unit": ("m/s2", "g", "mg", "gal"),
    "byteorder": ("little", "big"),
    "min_quality": ("fixed", "float", "single"),
    "axis": ("x", "y", "z", "horizontal", "any"),
    "fault": (
        *("PORT_LOST", "PORT_HUNG", "SILENT", "GARBAGE", "NO_MATCH", "NO_POSITION", "BUS_OFF"),
        *("LOSS", "WRITER_STALLED", "DISK_FULL", "DISK_READ-ONLY", "DISK_IO"),
    ),
}
_INTERFACES = ("socketcan", "slcan", "virtual", "udp_multicast", "pcan", "kvaser", "ixxat", "vector", "gs_usb")

NETWORK = re.compile(r"(?:socket|rfc2217)://(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):([0-9]{1,5})(?:\?[\w=&.]*)?\Z")

# Smallest and largest allowed value (inclusive) by the last key of the path. A test asks for a row of each numeric key.
_LIMITS: dict[str, tuple[float, float]] = {
    "azimuth_deg": (-360.0, 360.0),
    "baud": (300, 4_000_000),
    "bitrate": (5_000, 1_000_000),
    "drain_ms": (1, 500),
    "block_ms": (10, 500),
    "latency_ms": (0.0, 10_000.0),
    "sigma_floor_m": (0.0, 10.0),
    "rate_hz": (0.1, 20_000.0),
    "range_mps2": (0.001, 1e6),
    "sync": (1, (1 << 29) - 1),
    "source_address": (0, 253),  # 254 and 255 are nobody's and everybody's
    "pgn": (0, 0x3FFFF),
    "rotation": (-2.0, 2.0),  # `_check_rotation` says the rest
    "id": (0, (1 << 29) - 1),
    "start": (0, 511),
    "length": (1, 64),
    "scale": (-1e12, 1e12),
    "offset": (-1e12, 1e12),
    "gate_alpha": (1e-9, 0.5),
    "rotate_s": (1, 86_400),
    "rotate_mb": (0.1, 100_000.0),
    "keep_days": (0.001, 36_525.0),
    "keep_gb": (0.001, 1e6),
    "free_gb": (0.0, 1e6),
    "flush_s": (0.05, 60.0),
    "fsync_s": (0.05, 3600.0),
    "view_hz": (0.1, 1000.0),
    "above_m": (1e-6, 1e3),
    "above_mps": (1e-6, 1e3),
    "above_mps2": (1e-6, 1e3),
    "before_s": (0.0, 3600.0),
    "after_s": (0.0, 3600.0),
    "hold_s": (0.05, 3600.0),
    "release": (0.01, 1.0),
    "max_s": (1.0, 7200.0),
    "clips_gb": (0.001, 1e6),
    "hook_s": (0.05, 3600.0),
    # MB; a gateway has 256 MB to 4 GB for everything
    "inbox_mb": (0.1, 1000.0),
    "outbox_mb": (0.1, 1000.0),
    "ring_mb": (0.1, 1000.0),
    "start_s": (1.0, 3600.0),
    "reacquire_s": (1.0, 86_400.0),
    "wait_s": (0.001, 10.0),
    "invalid_std_horizontal_m": (0.001, 100.0),
    "invalid_std_vertical_m": (0.001, 100.0),
    "invalid_outage_s": (0.1, 86_400.0),
    "degraded_std_m": (1e-5, 100.0),
    "coast_s": (0.05, 3600.0),
    "outage_s": (0.05, 3600.0),
    "lockout_s": (0.1, 86_400.0),
    "accel_noise_m2ps3": (1e-16, 1.0),
    "accel_noise_decades": (0.01, 6.0),
    "bias_walk_m2ps5": (1e-18, 1.0),
    "bias_walk_decades": (0.01, 6.0),
    "gnss_only_q_m2ps3": (1e-16, 1.0),
    "gnss_only_qb_m2ps5": (1e-18, 1.0),
    "bank_memory_s": (1.0, 1e7),
    "bank_full_s": (0.1, 1e7),
    "bank_step_s": (0.01, 3600.0),
    "r_step": (1e-5, 0.5),
    "r_least": (1e-4, 1.0),
    "r_most": (1.0, 1e4),
    "float_std_m": (0.001, 100.0),
    "float_tau_s": (0.1, 86_400.0),
    "float_r_factor": (1.0, 1e4),
    "accel_mean_s": (0.1, 600.0),
    "accel_absent_s": (0.05, 3600.0),
    "accel_lost_s": (0.1, 86_400.0),
    "accel_settle_s": (0.05, 600.0),
    "accel_only_std_m": (1e-5, 10.0),
}

_SECTIONS: dict[str, type] = {
    "structure": Structure,
    "fusion": FusionSettings,
    "record": RecordSettings,
    "events": EventSettings,
}
_TABLES: dict[str, type] = {
    "ports": PortSettings,
    "receivers": ReceiverSettings,
    "accelerometers": AccelerometerSettings,
    "points": PointSettings,
    "triggers": TriggerSettings,
}
_TOP = ("site", "data_dir", *_SECTIONS, *_TABLES)

_show = reprlib.Repr()
_show.maxstring = _show.maxother = 60
_show.maxlevel = 3


class ConfigError(ValueError):
    """Every mistake of a configuration: `mistakes` holds one line of text each, in the order of the file."""

    def __init__(self, mistakes: Sequence[str]) -> None:
        super().__init__("\n".join(mistakes))
        self.mistakes = tuple(mistakes)


def load(path: Path, sets: Sequence[str] = ()) -> Config:
    """Read a configuration file and the files that it names. `sets` are `path=value` overrides.

    Raises ConfigError with all mistakes; a file that cannot be read is one of them.
    """
    try:
        text = _read(path, MAX_YAML_BYTES).decode("utf-8")
    except UnicodeDecodeError as e:
        raise ConfigError([f"{path}: is not UTF-8 text (byte {e.start})"]) from None
    except OSError as e:
        raise ConfigError([f"{path}: {e.strerror or e}"]) from None
    return parse(text, path.parent, sets=sets)


def parse(
    text: str, base_dir: Path, read_file: Callable[[str], bytes] | None = None, sets: Sequence[str] = ()
) -> Config:
    """Make a Config of YAML text.

    `base_dir` is where relative paths in it begin. `read_file(name as written) -> content` serves the files that the
    text names (a recording's attachments); None reads them from the disk. With `sets`, `Config.text` is the
    configuration as overridden, so that a recording made with it never claims another one. Raises ConfigError.
    """
    if len(text.encode("utf-8", "surrogatepass")) > MAX_YAML_BYTES:
        raise ConfigError([f"the configuration is larger than {MAX_YAML_BYTES >> 10} KiB"])
    report = _Report()
    tree = _tree(text, report)
    read = read_file or (lambda name: _read(base_dir / name, MAX_FILE_BYTES))
    before: set[tuple[str, str]] = set()
    if sets:  # what is wrong already without them is not their fault
        as_written = _Report()
        _config(_tree(text, _Report()), text, base_dir, read, as_written)
        before = {(path, said) for path, said, _ in as_written.mistakes}
    for s in sets:
        apply_set(tree, s)
    if sets:
        heading = "".join(f"# --set {json.dumps(s)}\n" for s in sets)
        text = f"{heading}{json.dumps(tree, indent=2, ensure_ascii=False)}\n"
    config = _config(tree, text, base_dir, read, report)
    if report.mistakes or config is None:
        raise ConfigError(report.lines(sets, before))
    return config


def notes(config: Config) -> list[str]:
    """What a good configuration may have forgotten: it runs, but some of what it names is only recorded."""
    found = []
    used = {r.port for r in config.receivers.values()} | {a.port for a in config.accelerometers.values()}
    found += [
        f"ports.{p}: no receiver or accelerometer reads it: recorded, not decoded"
        for p in config.ports
        if p not in used
    ]
    for table, key in (("receivers", "receiver"), ("accelerometers", "accelerometer")):
        fused = {getattr(p, key) for p in config.points.values()}
        found += [
            f"{table}.{name}: no point uses it: recorded, not fused"
            for name in getattr(config, table)
            if name not in fused
        ]
    if not config.points:
        found.append("points: none: nothing is fused")
    return found


def apply_set(tree: Any, assignment: str) -> None:
    """Put one override `path=value` into a tree, e.g. "fusion.gate_alpha=0.01"; a number steps into a list.

    The value is read as YAML. Raises ConfigError.
    """
    path, equals, value = assignment.partition("=")
    keys = path.strip().split(".")
    if not equals or not all(keys):
        raise ConfigError([f"--set {assignment}: write path=value, e.g. fusion.gate_alpha=0.01"])
    report = _Report()
    try:
        new = _tree(value, report, empty=None)
        if report.mistakes:
            raise ConfigError(report.lines())
    except ConfigError as e:
        raise ConfigError([f"--set {assignment}: {m}" for m in e.mistakes]) from None
    at = tree
    for i, key in enumerate(keys):
        last = i == len(keys) - 1
        if isinstance(at, dict):
            if last:
                at[key] = new
            elif at.get(key) is None:
                at[key] = {}
            at = at[key]
        elif isinstance(at, list):
            if not key.isdecimal() or int(key) >= len(at):
                raise ConfigError([f"--set {assignment}: {'.'.join(keys[:i])} has places 0 to {len(at) - 1}"])
            if last:
                at[int(key)] = new
            at = at[int(key)]
        else:
            raise ConfigError([f"--set {assignment}: {'.'.join(keys[:i])} holds {_show.repr(at)}, not further keys"])


def keys_of(cls: type) -> dict[str, dataclasses.Field[Any]]:
    """YAML key -> field of a settings class, without those that are made here."""
    return {_YAML_NAME.get(f.name, f.name): f for f in dataclasses.fields(cls) if f.name not in _MADE_HERE}


# --------------------------------------------------------------------------------------------------- text to plain tree


class _Report:
    """Mistakes as they are found, and the line of each path."""

    def __init__(self) -> None:
        self.mistakes: list[tuple[str, str, int]] = []
        self.line_of: dict[str, int] = {}

    def add(self, path: str, text: str, line: int | None = None) -> None:
        """A mistake at a path; its line is that of the nearest written parent."""
        at = path
        while line is None:
            line = self.line_of.get(at)
            if not at:
                break
            at = at.rpartition(".")[0]
        self.mistakes.append((path, text, line or 0))

    def wrong(self, path: str) -> bool:
        """Whether a mistake stands at a path or below it."""
        return any(p == path or p.startswith(f"{path}.") for p, _, _ in self.mistakes)

    def lines(self, sets: Sequence[str] = (), before: Collection[tuple[str, str]] = ()) -> list[str]:
        """One line of text for each. What is not among the mistakes `before` the overrides `sets` is theirs."""
        out = []
        for path, text, line in sorted(self.mistakes, key=lambda m: m[2]):
            where = f" (line {line})" if line else ""
            if sets and (path, text) not in before:
                keys = [s.partition("=")[0].strip() for s in sets]
                guilty = [s for s, k in zip(sets, keys, strict=True) if _related(path, k)]
                guilty = guilty or [s for s, k in zip(sets, keys, strict=True) if _related(path, k.rpartition(".")[0])]
                where = f" ({', '.join(f'--set {s}' for s in guilty or sets)})"
            out.append((f"{path}: " if path else "") + text + where)
        return out


class _Loader(yaml.SafeLoader):
    """SafeLoader with the scalars of YAML 1.2, no aliases and a bound on depth. Used to compose nodes only."""

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        event = self.peek_event()  # type: ignore[no-untyped-call]  # PyYAML's parser has no stubs
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise yaml.MarkedYAMLError(
                problem="anchors and aliases are refused: write it out", problem_mark=event.start_mark
            )
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise yaml.MarkedYAMLError(problem=f"nested deeper than {MAX_DEPTH} levels", problem_mark=event.start_mark)
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node


_Loader.yaml_implicit_resolvers = {}
# Order matters: the first match wins. Digits are bounded, so that no number takes long to read.
for _tag, _pattern, _first in (
    ("null", r"(?:~|null|Null|NULL|)\Z", ["~", "n", "N", ""]),
    ("bool", r"(?:true|True|TRUE|false|False|FALSE)\Z", list("tTfF")),
    ("int", r"(?:[-+]?[0-9]{1,18}|0x[0-9a-fA-F]{1,15})\Z", list("-+0123456789")),
    ("float", r"[-+]?(?:\.[0-9]{1,30}|[0-9]{1,30}(?:\.[0-9]{0,30})?)(?:[eE][-+]?[0-9]{1,3})?\Z", list("-+.0123456789")),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)


def _tree(text: str, report: _Report, empty: Any = dataclasses.MISSING) -> Any:
    """YAML text -> dict, list, str, int, float, bool, None. A text that is no YAML raises ConfigError at once."""
    try:
        loader = _Loader(text)
        try:
            node = loader.get_single_node()
        finally:
            loader.dispose()
    except yaml.MarkedYAMLError as e:
        where = f" (line {e.problem_mark.line + 1}, column {e.problem_mark.column + 1})" if e.problem_mark else ""
        about = f"{e.context}: " if e.context and e.problem != e.context else ""
        raise ConfigError([f"not readable as YAML: {about}{e.problem}{where}"]) from None
    except yaml.YAMLError as e:
        raise ConfigError([f"not readable as YAML: {str(e).splitlines()[0]}"]) from None
    if node is None:
        return {} if empty is dataclasses.MISSING else empty
    return _plain(node, "", report)


def _plain(node: yaml.Node, path: str, report: _Report) -> Any:
    report.line_of.setdefault(path, node.start_mark.line + 1)
    tag = str(node.tag).removeprefix("tag:yaml.org,2002:")
    if tag not in ("map", "seq", "null", "bool", "int", "float", "str"):
        report.add(path, f"the YAML tag {tag!r} is refused; write a plain value")
        return None
    if isinstance(node, yaml.MappingNode):
        out: dict[str, Any] = {}
        for key_node, value_node in node.value:
            line = key_node.start_mark.line + 1
            if not isinstance(key_node, yaml.ScalarNode):
                report.add(path, "a key must be plain text", line)
                continue
            key = str(key_node.value)
            at = _join(path, key)
            if key in out:
                report.add(at, f"stands twice, first on line {report.line_of[at]}", line)
                continue
            report.line_of[at] = line
            out[key] = _plain(value_node, at, report)
        return out
    if isinstance(node, yaml.SequenceNode):
        return [_plain(n, _join(path, str(i)), report) for i, n in enumerate(node.value)]
    word = str(node.value)
    try:
        match tag:
            case "null":
                return None
            case "bool":
                return word.lower() == "true"
            case "int":
                return int(word, 16) if word.startswith("0x") else int(word)
            case "float":
                return float(word)
            case _:
                return word
    except ValueError:  # only where the tag was written out, as in `!!int many`
        report.add(path, f"{_show.repr(word)} is no {tag}")
        return None


def _join(path: str, key: str) -> str:
    key = key if len(key) <= 60 else _show.repr(key)
    return f"{path}.{key}" if path else key


def _related(a: str, b: str) -> bool:
    """Whether one of two paths is the other or lies below it."""
    return a == b or a.startswith(f"{b}.") or b.startswith(f"{a}.")


# ---------------------------------------------------------------------------------------------------- tree to settings

_BAD = object()


def _config(tree: Any, text: str, base_dir: Path, read_file: Callable[[str], bytes], report: _Report) -> Config | None:
    if not isinstance(tree, dict):
        report.add("", f"the configuration must be keys with values, not {_show.repr(tree)}")
        return None
    _unknown_keys(tree, _TOP, "", report)
    site = _required_text(tree, "site", "the name of the site; it becomes a file name", report)
    if site is not None and not NAME.match(site):
        report.add("site", f"{_show.repr(site)} is no name: {NAME_RULE}")
    data_dir = _required_text(tree, "data_dir", "the folder for recordings", report)
    sections = {k: _build(cls, tree.get(k), k, report) for k, cls in _SECTIONS.items()}
    tables: dict[str, dict[str, Any]] = {}
    for table, cls in _TABLES.items():
        entries = tree.get(table)
        tables[table] = {}
        if entries is None:
            if table == "ports":
                report.add("ports", "is missing: name at least one serial or can port")
            continue
        if not isinstance(entries, dict):
            report.add(table, f"must be names with settings, not {_show.repr(entries)}")
            continue
        for name, entry in entries.items():
            path = _join(table, name)
            if not NAME.match(name):
                report.add(path, f"{_show.repr(name)} is no name: {NAME_RULE}")
            tables[table][name] = _build(cls, entry, path, report, name=name)
    _check_structure(sections["structure"], report)
    _check_record(sections["record"], report)
    _check_ports(tree, tables["ports"], report)
    _check_receivers(tables, report)
    files: dict[str, bytes] = {}
    _check_accelerometers(tables, read_file, files, report)
    _check_points(tables, report)
    _check_triggers(tables, report)
    if report.mistakes:
        return None
    return Config(
        site=str(site),
        data_dir=str(base_dir / str(data_dir)),
        structure=sections["structure"],
        ports=tables["ports"],
        receivers=tables["receivers"],
        accelerometers=tables["accelerometers"],
        points=tables["points"],
        fusion=sections["fusion"],
        record=sections["record"],
        events=sections["events"],
        triggers=tables["triggers"],
        text=text,
        files=tuple(files.items()),
    )


def _required_text(tree: Mapping[str, Any], key: str, meaning: str, report: _Report) -> str | None:
    value = tree.get(key)
    if value is None or value == "":
        report.add(key, f"is missing: {meaning}")
        return None
    if not isinstance(value, str):
        report.add(key, f"must be text, not {_show.repr(value)}; put it in quotes")
        return None
    return value


def _unknown_keys(value: Mapping[str, Any], known: Iterable[str], path: str, report: _Report) -> None:
    known = tuple(known)
    for key in value:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1) if len(report.mistakes) < MAX_GUESSES else []
            there = ", ".join(known) if known else "none"
            report.add(
                _join(path, key),
                f"unknown key; did you mean {near[0]}?" if near else f"unknown key; there are: {there}",
            )


def _build(cls: type, value: Any, path: str, report: _Report, name: str | None = None) -> Any:
    """A settings object of one mapping; None where it is no mapping.

    Where something in it is wrong (and reported), the default or an empty value stands in its place, so that the
    checks across keys go on; `report.wrong(path)` tells.
    """
    if value is None:
        value = {}
    if not isinstance(value, dict):
        report.add(path, f"must be keys with values, not {_show.repr(value)}")
        return None
    known = keys_of(cls)
    if cls is PortSettings:
        keys = PORT_KEYS.get(value.get("kind", ""), ()) if isinstance(value.get("kind"), str) else ()
        if keys:
            known = {k: f for k, f in known.items() if k == "kind" or k in keys}
    _unknown_keys(value, known, path, report)
    hints = typing.get_type_hints(cls)
    made: dict[str, Any] = {} if name is None else {"name": name}
    if cls is SignalField and value.get("pgn") is not None:
        if "id" in value:
            report.add(_join(path, "id"), "give either id or pgn; one of the two")
        del known["id"]
        made["can_id"] = 0
    for key, field in known.items():
        if key in value:
            made[field.name] = _convert(value[key], hints[field.name], _join(path, key), report)
            _check_number(key, made[field.name], _join(path, key), report)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            choices = _CHOICES.get(key)
            report.add(_join(path, key), "is missing" + (f"; one of: {', '.join(choices)}" if choices else ""))
            made[field.name] = _BAD
    for field in dataclasses.fields(cls):
        if made.get(field.name) is _BAD:
            if field.default is dataclasses.MISSING:
                made[field.name] = hints[field.name]()  # only str and int fields have no default
            else:
                made[field.name] = field.default
    settings = cls(**made)
    if isinstance(settings, SignalField) and not report.wrong(path):
        _check_field(settings, path, report)
    return settings


def _convert(value: Any, hint: Any, path: str, report: _Report) -> Any:
    """One value to the type of its field, or _BAD and a mistake that says what would be right."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        kinds = [a for a in args if a is not type(None)]
        if value is None and len(kinds) < len(args):
            return None
        # of several kinds the shape of the value picks one: a mapping is a dataclass, a list a tuple
        fitting = [k for k in kinds if dataclasses.is_dataclass(k) == isinstance(value, dict)] or kinds
        return _convert(value, fitting[0], path, report)
    if origin is tuple:
        return _convert_tuple(value, args, path, report)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        made = _build(hint, value, path, report)
        return _BAD if made is None or report.wrong(path) else made
    if isinstance(hint, type) and issubclass(hint, enum.Enum):
        allowed = _CHOICES.get(path.rpartition(".")[2])
        words = {m.name.lower(): m for m in hint if allowed is None or m.name.lower() in allowed}
        if isinstance(value, str) and value.lower() in words:
            return words[value.lower()]
        report.add(path, f"must be one of: {', '.join(words)}; not {_show.repr(value)}")
        return _BAD
    if hint is float and isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    if hint is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if hint is bool and isinstance(value, bool):
        return value
    if hint is str and isinstance(value, str) and value:
        choices = _CHOICES.get(path.rpartition(".")[2])
        if choices and value not in choices:
            near = difflib.get_close_matches(value, choices, n=1)
            meant = f"; did you mean {near[0]}?" if near else ""
            report.add(path, f"must be one of: {', '.join(choices)}; not {_show.repr(value)}{meant}")
            return _BAD
        return value
    right = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}[hint]
    quotes = "; put it in quotes" if hint is str and isinstance(value, int | float) else ""
    report.add(path, f"must be {right}, not {'empty' if value in (None, '') else _show.repr(value)}{quotes}")
    return _BAD


def _convert_tuple(value: Any, args: tuple[Any, ...], path: str, report: _Report) -> Any:
    endless = len(args) == 2 and args[1] is Ellipsis
    kind = args[0]
    by_axis = not endless and len(args) == 3 and kind in (str, SignalField)
    keys = ["0", "1", "2"]
    if by_axis and isinstance(value, dict):
        keys = ["x", "y", "z"]
        _unknown_keys(value, keys, path, report)
        missing = [k for k in keys if k not in value]
        for k in missing:
            report.add(_join(path, k), "is missing")
        if missing:
            return _BAD
        value = [value[k] for k in keys]
    if not isinstance(value, list) or (not endless and len(value) != len(args)):
        what = "values" if not isinstance(kind, type) else {float: "numbers", str: "signal names"}.get(kind, "values")
        right = "a list of lists" if endless else f"a list of {len(args)} {what}"
        if by_axis:
            right = "{x: ..., y: ..., z: ...}"
        report.add(path, f"must be {right}, not {_show.repr(value)}")
        return _BAD
    items = [_convert(v, kind, _join(path, keys[i] if i < 3 else str(i)), report) for i, v in enumerate(value)]
    return _BAD if any(i is _BAD for i in items) else tuple(items)


def _check_number(key: str, value: Any, path: str, report: _Report) -> None:
    """Range of a number or of each number in a (nested) tuple."""
    if isinstance(value, tuple):
        for v in value:
            _check_number(key, v, path, report)
        return
    if isinstance(value, bool | enum.Enum) or not isinstance(value, int | float) or key == "reference_llh":
        return
    low, high = _LIMITS.get(key, (-math.inf, math.inf))
    if not low <= value <= high:
        report.add(path, f"must be from {low:g} to {high:g}, not {value:g}")


# -------------------------------------------------------------------------------------------- what one key cannot know


def _check_structure(structure: Structure | None, report: _Report) -> None:
    if structure is None or structure.reference_llh is None:
        return
    lat, lon, h = structure.reference_llh
    if not (-90 <= lat <= 90 and -180 <= lon <= 180 and -1000 <= h <= 10_000):
        report.add(
            "structure.reference_llh",
            f"must be [latitude -90 to 90 deg, longitude -180 to 180 deg, ellipsoidal height -1000 to 10000 m], not "
            f"[{lat:g}, {lon:g}, {h:g}]",
        )


def _check_record(record: RecordSettings | None, report: _Report) -> None:
    if record is None:
        return
    if record.keep_gb * 1000 < 2 * record.rotate_mb:
        report.add("record.keep_gb", f"must hold two files of rotate_mb: at least {2 * record.rotate_mb / 1000:g}")
    if record.fsync_s < record.flush_s:
        report.add("record.fsync_s", f"must not be below flush_s ({record.flush_s:g})")


def _check_ports(tree: Mapping[str, Any], ports: Mapping[str, PortSettings | None], report: _Report) -> None:
    if not ports and isinstance(tree.get("ports"), dict):
        report.add("ports", "is empty: name at least one serial or can port")
    taken: dict[tuple[str, ...], str] = {}
    for name, port in ports.items():
        path = f"ports.{name}"
        if name in RESERVED_PORTS:
            report.add(path, f"the name {name!r} is the agent's own; choose another")
        if port is None:
            continue
        if port.kind == "serial" and not port.device and not report.wrong(f"{path}.device"):
            report.add(f"{path}.device", "is missing: the path of the serial device, best of /dev/serial/by-id/")
        if port.kind == "serial" and port.device:
            _check_device(port.device, f"{path}.device", report)
        if port.kind == "can":
            if port.interface not in _INTERFACES:
                _check_interface(port.interface, f"{path}.interface", report)
            if port.block_ms < port.drain_ms:
                report.add(f"{path}.block_ms", f"must not be below drain_ms ({port.drain_ms})")
        wire = ("serial", port.device) if port.kind == "serial" else ("can", port.interface, port.channel)
        if report.wrong(path):
            continue
        if wire in taken:
            report.add(path, f"opens the same {port.kind} device as ports.{taken[wire]}")
        taken.setdefault(wire, name)


def _check_device(device: str, path: str, report: _Report) -> None:
    if "://" in device:
        network = NETWORK.match(device)
        if network is None or not 0 < int(network[1]) < 65536:
            report.add(path, f"must be socket://HOST:PORT or rfc2217://HOST:PORT, not {_show.repr(device)}")
    elif not device.startswith("/"):
        report.add(
            path,
            f"must be a path such as /dev/{device.rpartition('/')[2]} or socket://HOST:PORT, not {_show.repr(device)}",
        )


def _check_interface(interface: str, path: str, report: _Report) -> None:
    from can.interfaces import VALID_INTERFACES

    if interface not in VALID_INTERFACES:
        near = difflib.get_close_matches(interface, sorted(VALID_INTERFACES), n=1)
        right = f"did you mean {near[0]}?" if near else f"there are: {', '.join(sorted(VALID_INTERFACES))}"
        report.add(path, f"python-can has no interface {interface!r}; {right}")


def _check_reference(
    settings: Any, key: str, table: str, path: str, tables: Mapping[str, Mapping[str, Any]], report: _Report
) -> bool:
    """Whether `settings.key` names an entry of a table; a name that is not there is a mistake."""
    wanted = getattr(settings, key)
    there = tables[table]
    if not wanted:
        return False  # reported already
    if wanted in there:
        return True
    near = difflib.get_close_matches(wanted, list(there), n=1)
    names = ", ".join(there) or "none"
    meant = f" (did you mean {near[0]}?)" if near and len(there) > 1 else ""
    report.add(f"{path}.{key}", f"no {table[:-1]} named {_show.repr(wanted)}; there are: {names}{meant}")
    return False


def _check_kind(port: PortSettings | None, wanted: str, path: str, report: _Report) -> None:
    if port is not None and port.kind and port.kind != wanted:
        report.add(path, f"{port.name!r} is a {port.kind} port; a {wanted} port is needed")


def _check_receivers(tables: Mapping[str, Mapping[str, Any]], report: _Report) -> None:
    of_port: dict[str, str] = {}
    for name, receiver in tables["receivers"].items():
        if receiver is None:
            continue
        path = f"receivers.{name}"
        if _check_reference(receiver, "port", "ports", path, tables, report):
            _check_kind(tables["ports"][receiver.port], "serial", f"{path}.port", report)
        if receiver.port and receiver.port in of_port:
            report.add(f"{path}.port", f"receivers.{of_port[receiver.port]} already reads port {receiver.port!r}")
        of_port.setdefault(receiver.port, name)


def _check_accelerometers(
    tables: dict[str, dict[str, Any]], read_file: Callable[[str], bytes], files: dict[str, bytes], report: _Report
) -> None:
    listening: list[tuple[AccelerometerSettings, Any]] = []
    for name, accel in tables["accelerometers"].items():
        if accel is None:
            continue
        path = f"accelerometers.{name}"
        if _check_reference(accel, "port", "ports", path, tables, report):
            _check_kind(tables["ports"][accel.port], "can", f"{path}.port", report)
        _check_rotation(accel.rotation, f"{path}.rotation", report)
        if accel.dbc is not None and accel.dbc not in files:
            try:
                files[accel.dbc] = read_file(accel.dbc)
            except KeyError:
                report.add(f"{path}.dbc", f"the file {_show.repr(accel.dbc)} is not there")
            except OSError as e:
                where = f": {e.filename}" if e.filename else ""
                report.add(f"{path}.dbc", f"cannot be read: {e.strerror or e}{where}")
        if any(report.wrong(f"{path}.{key}") for key in ("dbc", "signals", "fields", "counter")):
            continue
        before = len(report.mistakes)
        if (accel.signals is None) == (accel.fields is None):
            report.add(path, "give either dbc and signals, or fields; one of the two")
        elif (accel.signals is not None or isinstance(accel.counter, str)) and accel.dbc is None:
            what = "these signals" if accel.signals is not None else "the counter of that name"
            report.add(f"{path}.dbc", f"is missing: the DBC file that holds {what}")
        elif accel.fields is not None and accel.dbc is not None and not isinstance(accel.counter, str):
            report.add(f"{path}.dbc", "goes with signals, not with fields; remove one of them")
        axes: Sequence[Any] = accel.signals or accel.fields or ()
        if len(set(axes)) != len(axes):
            report.add(f"{path}.{'signals' if accel.signals else 'fields'}", "two axes name the same signal")
        if len(report.mistakes) > before:
            continue
        if any(report.wrong(f"{path}.{key}") for key in ("unit", "rate_hz", "range_mps2", "sync", "source_address")):
            continue  # the codec would say it again, or compare the unit with that of the DBC file
        if report.wrong(f"{path}.rotation"):
            accel = dataclasses.replace(accel, rotation=AccelerometerSettings(name, "").rotation)
        if accel.dbc is not None:
            accel = dataclasses.replace(accel, dbc_text=_dbc_text(files[accel.dbc]))
            tables["accelerometers"][name] = accel
        codec = _codec(accel, path, report)
        if codec is not None:
            listening.append((accel, codec))
    for i, (a, codec_a) in enumerate(listening):
        for b, codec_b in listening[:i]:
            ids = ", ".join(codec_a.shared(codec_b)) if a.port == b.port else ""
            if ids:
                report.add(
                    f"accelerometers.{a.name}", f"reads the same signals of CAN id {ids} as accelerometers.{b.name}"
                )


def _check_field(f: SignalField, path: str, report: _Report) -> None:
    from drivers.can_signals import compile_signal

    if not f.extended and f.can_id > 0x7FF:
        report.add(f"{path}.id", f"0x{f.can_id:X} does not fit 11 bits (at most 0x7FF); set extended: true")
        return
    try:
        compile_signal(path.rpartition(".")[2], f)
    except ValueError as e:
        report.add(path, " ".join(str(e).split()))


def _check_rotation(rotation: tuple[tuple[float, float, float], ...], path: str, report: _Report) -> None:
    """Rows orthonormal to 1e-3 and right-handed."""
    if len(rotation) != 3:
        report.add(path, f"must be 3 rows of 3 numbers, not {len(rotation)} rows")
        return
    for i in range(3):
        for j in range(i + 1):
            dot = sum(rotation[i][k] * rotation[j][k] for k in range(3))
            if abs(dot - (1.0 if i == j else 0.0)) > 1e-3:
                what = (
                    f"row {i + 1} has length {math.sqrt(dot):.4f}, not 1"
                    if i == j
                    else (f"rows {j + 1} and {i + 1} are not perpendicular (product {dot:.4f})")
                )
                report.add(path, f"is no rotation: {what}")
                return
    (a, b, c), (d, e, f), (g, h, i_) = rotation
    if a * (e * i_ - f * h) - b * (d * i_ - f * g) + c * (d * h - e * g) < 0:
        report.add(path, "is no rotation: it mirrors (determinant -1); change the sign of one row")


def _codec(accel: AccelerometerSettings, path: str, report: _Report) -> Any:
    """The codec of an accelerometer, made once here to hear what it refuses."""
    from drivers.dbc_codec import AccelCodec

    try:
        return AccelCodec(accel)
    except ValueError as e:
        text = " ".join(str(e).split())
    key = "signals" if accel.signals is not None else "fields"
    if "unit says" in text:
        key = "unit"
    elif text.startswith(("sync ", "source_address ")):
        key = text.partition(" ")[0]
    elif accel.counter is not None:
        with contextlib.suppress(ValueError):
            AccelCodec(dataclasses.replace(accel, counter=None))
            key = "counter"  # without it all is well
    report.add(f"{path}.{key}", text)
    return None


def _check_points(tables: Mapping[str, Mapping[str, Any]], report: _Report) -> None:
    pairs: dict[tuple[str | None, str | None], str] = {}
    for name, point in tables["points"].items():
        if point is None:
            continue
        path = f"points.{name}"
        if point.receiver is None and point.accelerometer is None and not report.wrong(path):
            report.add(path, "names neither a receiver nor an accelerometer")
            continue
        if point.receiver is not None:
            _check_reference(point, "receiver", "receivers", path, tables, report)
        if point.accelerometer is not None:
            _check_reference(point, "accelerometer", "accelerometers", path, tables, report)
        if report.wrong(path):
            continue
        pair = (point.receiver, point.accelerometer)
        if pair in pairs:
            report.add(path, f"is the same pair as points.{pairs[pair]}")
        pairs.setdefault(pair, name)


def _check_triggers(tables: Mapping[str, Mapping[str, Any]], report: _Report) -> None:
    for name, t in tables["triggers"].items():
        path = f"triggers.{name}"
        if t is None or report.wrong(path):
            continue
        given = [key for key in ("above_m", "above_mps", "above_mps2", "fault") if getattr(t, key) is not None]
        if len(given) != 1:
            report.add(path, "give one of above_m, above_mps, above_mps2 or fault")
        elif given == ["fault"]:
            if t.point is not None:
                report.add(f"{path}.point", "does not go with fault; remove one of them")
        elif t.point is None:
            report.add(f"{path}.point", "is missing: the point whose motion is watched")
        elif _check_reference(t, "point", "points", path, tables, report) and given == ["above_mps2"]:
            point = tables["points"][t.point]
            if point is not None and point.accelerometer is None:
                report.add(f"{path}.above_mps2", f"points.{t.point} has no accelerometer")


# --------------------------------------------------------------------------------------------------------------- files


def _read(path: Path, limit: int) -> bytes:
    """A regular file of at most `limit` bytes; raises OSError."""
    if path.exists() and not path.is_file():
        raise OSError("not a regular file")
    with path.open("rb") as f:
        data = f.read(limit + 1)
    if len(data) > limit:
        raise OSError(f"larger than {limit >> 10} KiB")
    return data


def _dbc_text(data: bytes) -> str:
    """DBC files are written in cp1252 by most tools and in UTF-8 by some."""
    for encoding in ("utf-8-sig", "cp1252"):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    return data.decode("latin-1")
