"""What a command is given: the recordings among it, of which sites they are, which are copies of others, and which
configurations they were made with."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from edge_agent import config as configs
from edge_agent.messages import Config
from edge_agent.recording.reader import DamagedError, read_attachments
from edge_agent.replay import CONFIG_NAME, ReplayError
from edge_agent.review.series import configuration, files_of
from edge_agent.verify import File

MOST = 100
"""Different configurations at most; what is beyond is read with the first."""


ORIGIN = ("site", "source", "scenario", "seed")
"""What of a file's metadata says where its data come from; a replay keeps it."""


class Opened(NamedTuple):
    """Recordings in order of time, those of no use with why, the first configuration, and the different ones."""

    files: list[Path]
    bad: dict[Path, str]
    config: Config
    setups: list[Setup]


def opened(inputs: Sequence[Path]) -> Opened:
    """Look what there is. OSError for a path that is not there; ReplayError where no file holds data, or none a
    configuration: the text names each and says what would be right."""
    for path in inputs:
        path.stat()
    files, bad = files_of(inputs)
    if not files:
        told = [f"{p}: {why}" for p, why in sorted(bad.items())[:5]]
        told += [f"{len(bad) - 5} more"] if len(bad) > 5 else []
        raise ReplayError("; ".join(told) or "; ".join(_empty(p) for p in inputs))
    return Opened(files, bad, configuration(files), setups(files))


def _empty(folder: Path) -> str:
    """That a folder holds no recording, and where there are some."""
    inside = sorted(p for p in folder.iterdir() if p.is_dir())
    below = [p for p in inside if any(".mcap" in q.suffixes for q in p.iterdir())]
    hint = f"; there are some in {', '.join(str(p) for p in below[:3])}" if below else ""
    return f"{folder} holds no recording (*.mcap){hint}"


def sites(found: Opened) -> dict[str, Opened]:
    """What was opened by site, in order of time; a file without a configuration goes with the one before it, a file of
    no use with every site."""
    names = {path: s.config.site for s in found.setups for path in s.files}
    out: dict[str, list[Path]] = {}
    site = found.config.site
    for path in found.files:
        site = names.get(path, site)
        out.setdefault(site, []).append(path)
    if len(out) < 2:
        return {site: found}
    parts = {}
    for site, files in out.items():
        own = [s for s in found.setups if s.config.site == site]
        parts[site] = Opened(files, found.bad, own[0].config if own else found.config, own)
    return parts


def one_site(found: Opened) -> None:
    """ReplayError for recordings of more than one site."""
    parts = sites(found)
    if len(parts) > 1:
        told = "; ".join(f"{site}: {len(part.files)} ({part.files[0].name}, ...)" for site, part in parts.items())
        raise ReplayError(f"the files are of {len(parts)} sites: {told}; name those of one")


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

    @property
    def digest(self) -> str:
        """What `sha256sum config.yaml` begins with."""
        return hashlib.sha256(self.text.encode()).hexdigest()[:12]


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
