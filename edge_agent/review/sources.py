"""Which of the files are copies of others, and which configurations they were made with."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from edge_agent import config as configs
from edge_agent.messages import Config
from edge_agent.recording.reader import DamagedError, read_attachments
from edge_agent.replay import CONFIG_NAME
from edge_agent.verify import File

MOST = 100
"""Different configurations at most; what is beyond is read with the first."""


ORIGIN = ("site", "source", "scenario", "seed")
"""What of a file's metadata says where its data come from; a replay keeps it."""


def copies(files: Sequence[File]) -> dict[Path, Path]:
    """Files whose blocks are all in others: copy -> one that has them. The same bytes under another name, an event clip
    beside its segments, a torn copy beside the whole, a replay beside what it was made from (the one that holds more
    messages stays)."""
    found: dict[Path, Path] = {}
    kept: dict[str, list[File]] = {}
    for f in sorted(files, key=lambda f: (-f.messages, f.state != "complete", f.path.name)):
        if not f.messages:
            continue
        origin = [f.run.get(key, "") for key in ORIGIN]  # runs of no agent have no id, and begin alike
        run = " ".join([*origin, f.run_id or str(f.begin_ns)])
        same = kept.setdefault(run, [])
        # A file without a checkpoint (simulated, imported) begins with the run; what was replayed from it may open
        # a few ticks later.
        begins = min((o.order for o in same if o.order >= 0), default=0)
        first, last = f.order if f.order >= 0 else begins, f.last_order
        home = None
        at = first
        for other in sorted(same, key=lambda o: o.order):
            if max(other.order, 0) <= at <= other.last_order:
                home = home or other
                at = other.last_order + 1
        if home is not None and at > last >= 0:
            found[f.path] = home.path
        else:
            same.append(f)
    return found


@dataclass(frozen=True)
class Setup:
    """A configuration as it is attached, the files that carry it (in order of time), and every setting of it and hash
    of every file that it names, by path."""

    text: str
    config: Config
    files: list[Path]
    settings: dict[str, str]


def setups(files: Sequence[Path]) -> list[Setup]:
    """The different configurations in the order in which they come; files without one that reads are left out."""
    found: dict[str, Setup] = {}
    for path in files:
        try:
            attached = {a.name: a.data for a in read_attachments(path)}
        except (OSError, DamagedError):
            continue
        if CONFIG_NAME not in attached:
            continue
        parts = [name.encode() + hashlib.sha256(data).digest() for name, data in sorted(attached.items())]
        key = hashlib.sha256(b"".join(parts)).hexdigest()
        if key in found:
            found[key].files.append(path)
            continue
        setup = _setup(path, attached) if len(found) < MOST else None
        if setup is not None:
            found[key] = setup
    return list(found.values())


def _setup(path: Path, attached: dict[str, bytes]) -> Setup | None:
    def read(name: str) -> bytes:
        if name not in attached:
            raise FileNotFoundError(2, "not attached to the recording", name)
        return attached[name]

    try:
        text = attached[CONFIG_NAME].decode()
        config = configs.parse(text, Path(), read)
        settings = _flat(yaml.safe_load(text), "")
    except (ValueError, OSError, yaml.YAMLError):
        return None
    for name, data in attached.items():
        if name != CONFIG_NAME:
            settings[name] = "sha256 " + hashlib.sha256(data).hexdigest()[:12]
    return Setup(text, config, [path], settings)


def _flat(value: Any, at: str) -> dict[str, str]:
    if isinstance(value, dict):
        inside = (_flat(part, f"{at}.{name}" if at else str(name)) for name, part in value.items())
        return {k: v for part in inside for k, v in part.items()}
    return {at: str(value)}


def differences(found: Sequence[Setup]) -> list[tuple[str, list[str]]]:
    """Settings that are not the same everywhere: path, value in each configuration, "" = not set."""
    names = sorted({name for s in found for name in s.settings})
    rows = [(name, [s.settings.get(name, "") for s in found]) for name in names]
    return [row for row in rows if len(set(row[1])) > 1]


def together(first: Config, found: Sequence[Setup]) -> Config:
    """The first configuration, and whatever sensors and points only others have."""
    receivers, accelerometers, points = dict(first.receivers), dict(first.accelerometers), dict(first.points)
    for s in found:
        receivers = {**s.config.receivers, **receivers}
        accelerometers = {**s.config.accelerometers, **accelerometers}
        points = {**s.config.points, **points}
    return replace(first, receivers=receivers, accelerometers=accelerometers, points=points)
