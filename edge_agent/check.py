"""`edge-agent check` beyond the text of the configuration: what is there today, and with --live what arrives.

`today` looks without opening anything: devices, disk. `live` opens every port at once for some seconds, through the
ports of the service, and has `judge` say what came; a serial port that gives only garbage is then tried at other baud
rates. Nothing is written, nowhere. Two readers of one serial device would each get a part of its bytes, so the data
folder's lock is asked for first and held meanwhile (a service that starts then tries again).
"""

from __future__ import annotations

import fcntl
import getpass
import json
import os
import shutil
import subprocess
import textwrap
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import drivers
from drivers.can_signals import Dbc
from edge_agent import lock
from edge_agent.judge import BAD, GOOD, NOTE, Finding, judge_can, judge_serial, payloads, scan
from edge_agent.messages import Config, PortSettings, Raw

BAUDS = (115200, 9600, 38400, 460800, 57600, 921600, 230400, 19200, 4800)
"""Tried in this order: the usual defaults of receivers first."""
BAUD_S = 1.3  # seconds at each: a receiver that speaks once a second is heard
LISTEN_BYTES = 64 << 20  # kept of one port; the rest of the time is then not listened to
WIDTH = 80

MakePort = Callable[[PortSettings], Any]


def make_port(settings: PortSettings) -> Any:
    """The port of the service for these settings."""
    return drivers.load(drivers.PORTS, settings.kind)(settings)


# --------------------------------------------------------------------------------------------------------------- today


def today(config: Config) -> list[Finding]:
    """What would keep the agent waiting if it started now. Nothing is opened or made."""
    out: list[Finding] = []
    real: dict[str, str] = {}  # device behind all links -> port
    for port in config.ports.values():
        key = "device" if port.kind == "serial" else "channel"
        path = str(getattr(port, key))
        where = f"ports.{port.name}.{key}"
        if port.kind == "can" and port.interface == "socketcan":
            if not os.path.exists(f"/sys/class/net/{path}"):
                out.append(Finding(BAD, where, f"no network interface {path} now"))
        elif path.startswith("/") and not os.path.exists(path):
            out.append(Finding(BAD, where, f"{path} is not there now: {_beside()}"))
        elif path.startswith("/"):
            device = os.path.realpath(path)
            first = real.setdefault(device, port.name)
            if first != port.name:
                out.append(Finding(BAD, where, f"{path} and the device of ports.{first} are one: {device}"))
    return [*out, *disk(config)]


def _beside() -> str:
    there = sorted(str(p) for p in Path("/dev/serial/by-id").glob("*"))
    return f"there are: {', '.join(there)}" if there else "is it plugged in?"


def disk(config: Config) -> Iterator[Finding]:
    """Whether recordings can be made in data_dir, and kept as configured."""
    folder = Path(config.data_dir)
    at = folder
    while not os.path.exists(at) and at != at.parent:  # what may not be looked at counts as absent
        at = at.parent
    if not os.path.isdir(at):
        yield Finding(BAD, "data_dir", f"{at} is no folder")
        return
    if not os.access(at, os.W_OK | os.X_OK):
        user = getpass.getuser() if os.environ.get("USER") or os.environ.get("LOGNAME") else f"user {os.getuid()}"
        what = "may not write there" if at == folder else f"may not make it below {at}"
        yield Finding(BAD, "data_dir", f"{folder}: {user} {what} (the service runs as the user of its unit)")
    record = config.record
    space = shutil.disk_usage(at)
    if space.free < record.free_gb * 1e9:
        text = f"{space.free / 1e9:.3g} GB free, below free_gb: the oldest recordings go, then no new ones come"
        yield Finding(BAD, "record.free_gb", text)
    elif space.total < (record.keep_gb + record.free_gb) * 1e9:
        text = (
            f"the disk has {space.total / 1e9:.3g} GB: free_gb ({record.free_gb:g}) will end recordings before keep_gb"
        )
        yield Finding(NOTE, "record.keep_gb", text)


# ---------------------------------------------------------------------------------------------------------------- live


@contextmanager
def hold_off(data_dir: Path) -> Iterator[None]:
    """Keep an agent from starting in `data_dir` meanwhile. Raises lock.InUseError where one runs. Makes no file: one
    made by another user would keep the service out for good."""
    try:
        fd = os.open(data_dir / lock.NAME, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        yield  # no agent ever ran there, or it cannot be told
        return
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = os.pread(fd, 32, 0).decode("ascii", "replace").strip() or "another process"
            raise lock.InUseError(
                f"the agent runs (process {holder}, {data_dir}) and has the ports open, which two must not read; "
                "stop it first: systemctl stop edge-agent"
            ) from None
        yield
    finally:
        os.close(fd)


class Listener(threading.Thread):
    """Reads one port for some seconds from its opening on."""

    def __init__(self, settings: PortSettings, port: Any, seconds: float) -> None:
        super().__init__(name=f"check-{settings.name}", daemon=True)
        self.settings, self.port, self.seconds = settings, port, seconds
        self.raws: list[Raw] = []
        self.heard_s = 0.0
        self.error: drivers.PortError | None = None

    def run(self) -> None:
        kept = 0
        try:
            self.port.open()
            begin = time.monotonic()
            while self.heard_s < self.seconds and kept < LISTEN_BYTES:
                for t_ns, payload in self.port.read():
                    self.raws.append(Raw(t_ns, len(self.raws), self.settings.name, payload))
                    kept += len(payload) if isinstance(payload, bytes) else 1000
                self.heard_s = time.monotonic() - begin
        except drivers.PortError as e:
            self.error = e
        finally:
            self.port.close()


def listen(ports: Sequence[PortSettings], seconds: float, make: MakePort = make_port) -> list[Listener]:
    """Listen to all ports at once."""
    listeners = [Listener(s, make(s), seconds) for s in ports]
    for thread in listeners:
        thread.start()
    for thread in listeners:
        thread.join()
    return listeners


def live(config: Config, seconds: float, make: MakePort = make_port) -> list[Finding]:
    """Open every port for `seconds` and judge what arrives. Raises lock.InUseError where the agent runs."""
    with hold_off(Path(config.data_dir)):
        clock, *heard = listen([PortSettings("clock", "clock"), *config.ports.values()], seconds, make)
        out: list[Finding] = []
        for one in heard:
            if one.error is not None:
                text = str(one.error).removeprefix(f"port {one.settings.name}: ")
                out.append(Finding(BAD, f"ports.{one.settings.name}", text))
            if one.raws or one.error is None:
                out += _judge(config, one, clock.raws, make)
    return out


def _judge(config: Config, one: Listener, ticks: Sequence[Raw], make: MakePort) -> list[Finding]:
    port = one.settings
    seconds = max(one.heard_s, 0.001)
    if port.kind == "can":
        accelerometers = [a for a in config.accelerometers.values() if a.port == port.name]
        link = link_state(port.channel) if port.interface == "socketcan" else {}
        names: dict[tuple[bool, int], str] = {}
        for path, text in {a.dbc: a.dbc_text for a in accelerometers if a.dbc}.items():
            names.update({(m.is_extended_frame, m.frame_id): m.name for m in Dbc(text, str(path)).messages})
        bitrate = port.bitrate or link.get("bitrate")
        out = judge_can(port, accelerometers, one.raws, seconds, bitrate, names)
        state = link.get("state", "ERROR-ACTIVE")
        if state != "ERROR-ACTIVE":
            out.append(Finding(BAD, f"ports.{port.name}", f"the controller is {state}: too many errors on the bus"))
        return out
    receiver = next((r for r in config.receivers.values() if r.port == port.name), None)
    found = judge_serial(port, receiver, one.raws, ticks, seconds)
    data = payloads(one.raws)
    if data and not scan(data).valid and not port.device.startswith(("socket://", "/dev/pts/")):
        baud = guess_baud(port, make, BAUD_S)
        text = f"at {baud} baud good ones come: write baud: {baud}" if baud else "nor at any other usual baud rate"
        found.append(Finding(BAD, f"ports.{port.name}.baud", text))
    return found


def guess_baud(port: PortSettings, make: MakePort, seconds: float) -> int | None:
    """The first of BAUDS at which sentences or known frames come, or None. Leaves the device as configured."""
    found = None
    for baud in BAUDS:
        if baud == port.baud:
            continue
        (one,) = listen([replace(port, baud=baud)], seconds, make)
        if scan(payloads(one.raws)).valid:
            found = baud
            break
    listen([port], 0.0, make)
    return found


def link_state(channel: str) -> dict[str, Any]:
    """Bit rate and state of a CAN interface as iproute2 tells them; {} where it does not."""
    with suppress(OSError, subprocess.SubprocessError, ValueError, LookupError, TypeError, AttributeError):
        done = subprocess.run(
            ["ip", "-json", "-details", "link", "show", "dev", channel], capture_output=True, timeout=5, check=True
        )
        data = json.loads(done.stdout)[0]["linkinfo"]["info_data"]
        return {"state": data["state"], "bitrate": data.get("bittiming", {}).get("bitrate")}
    return {}


# ---------------------------------------------------------------------------------------------------------------- text


def as_text(findings: Sequence[Finding]) -> str:
    """For eyes: one heading per port or sensor, a line or two for each finding, 80 columns."""
    lines: list[str] = []
    heading = ""
    for f in sorted(findings, key=lambda f: _order(findings, f)):
        entry = ".".join(f.where.split(".")[:2])
        if entry != heading:
            heading = entry
            lines.append(entry)
        key = f.where.removeprefix(entry).lstrip(".")
        text = f"{key}: {f.text}" if key else f.text
        mark = {GOOD: "  ok    ", NOTE: "  note  ", BAD: "  BAD   "}[f.level]
        lines += textwrap.wrap(text, WIDTH, initial_indent=mark, subsequent_indent=" " * 8, break_on_hyphens=False)
    return "\n".join(lines)


def _order(findings: Sequence[Finding], f: Finding) -> int:
    """Findings of one entry stand together, where the first of them stands."""
    entry = f.where.split(".")[:2]
    return next(i for i, other in enumerate(findings) if other.where.split(".")[:2] == entry)


def as_json(findings: Sequence[Finding]) -> list[Mapping[str, str]]:
    """For programs."""
    return [{"level": f.level, "path": f.where, "text": f.text} for f in findings]
