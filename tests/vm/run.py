"""The real service on a real Linux: installed, fed through real drivers, disturbed, stopped and removed.

    python tests/vm/run.py [--keep FOLDER]

Starts a virtual machine (machine.py) of a stock Debian (image.py), installs the agent from wheels with the project's
installer as on a gateway without a network, and plays a simulated bridge: NMEA onto a 16550A port, one accelerometer
onto the CAN card, another as an slcan adapter on a second serial port. Then it looks at what was recorded. Prints a row
for each thing that must hold; exit code 1 when one does not. The last line is "N passed, N failed". Where QEMU cannot
be had it says so and ends with 0.

Emulation makes the guest's Python some 15 times slower: nothing here judges speed.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import select
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(PROJECT)]

import image  # noqa: E402
from machine import Machine  # noqa: E402

from edge_agent.messages import MS, VALID_MODES, CanFlag, CanFrames, S, Tick  # noqa: E402
from edge_agent.recording import cdr, reader, topics  # noqa: E402
from edge_agent.simulate.bridge import SimRecord, run  # noqa: E402
from edge_agent.simulate.encode import Wiring, can_frames, config_yaml, dbc_text  # noqa: E402
from edge_agent.simulate.play import Slcan, play, serial_schedule, slcan_schedule, socketcan_schedule  # noqa: E402
from edge_agent.simulate.specs import START_NS, Accel, Gnss, Modal, Scenario, Structure  # noqa: E402

TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "qemu-img": "qemu-utils",
    "mmdebstrap": "mmdebstrap",
    "mke2fs": "e2fsprogs",
}
SERVICE = "edge-agent"
DATA = "/var/lib/edge-agent"
PLAY_S, STEP_S, STOP_S = 112.0, 82.0, 104.0  # of the play: its length, the clock's step, the service's stop
FUSED_S = 60.0  # at least so long of fused data before the clock steps
STAMP_NS = MS  # kernel stamps of agent and candump agree within
LATENCY_S = 0.200
LINE_S = 0.010  # a GGA's bytes at 115200 baud
READY_S = 180.0  # patience with a start; it takes some 10 s
MAX_EXPOSURE = 2.0
DECK, PYLON = "deck", "pylon"  # accelerometers on the CAN card and on the slcan adapter
DECK_IDS, PYLON_IDS = range(0x098, 0x0A8), range(0x0A8, 0x0B8)
SCHEDULE_RECORD = struct.Struct("=q16s")  # as player.py reads it
# Tells the kernel that its clock is disciplined, as an NTP daemon does: struct timex with modes = status and errors.
DISCIPLINE = (
    "python3 -c 'import ctypes, struct; t = ctypes.create_string_buffer(512); "
    'struct.pack_into("@Illlli", t, 0, 0x1C, 0, 0, 1000, 1000, 0); print(ctypes.CDLL(None).adjtimex(t))\''
)


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Tally:
    """One row for each thing that must hold."""

    passed = failed = 0

    def row(self, good: bool, what: str, seen: str) -> None:
        self.passed += good
        self.failed += not good
        print(f"{'pass' if good else 'FAIL'}  {what:<58} {seen}", flush=True)


# ------------------------------------------------------------------------------------------------------ what it needs


def missing_tools() -> str:
    """Why it cannot run here; empty where it can. Installs what is missing where that is allowed."""
    if os.uname().machine != "x86_64":
        return "the machine's image is x86-64"
    for attempt in (1, 2):
        missing = sorted(package for tool, package in TOOLS.items() if not _which(tool))
        if not missing or attempt == 2:
            break
        if os.geteuid() != 0 or not _which("apt-get"):
            return f"needs {', '.join(missing)}: apt-get install --no-install-recommends {' '.join(missing)}"
        say(f"installing {', '.join(missing)}")
        for command in ("update", "install -y --no-install-recommends " + " ".join(missing)):
            subprocess.run(
                ["apt-get", "-q", *command.split()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=False
            )
    if missing:
        return f"{', '.join(missing)} could not be installed"
    return "" if _which("apt-cache") else "the image is made from Debian packages; there is no apt here"


def _which(tool: str) -> str | None:
    return shutil.which(tool, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")


def collect_wheels() -> Path:
    """A folder with the wheels of the agent, as it stands, and of its libraries for Debian 12's Python 3.11."""
    out = image.cache_dir() / "wheels"
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("edge_agent-*.whl"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:  # a build leaves files in its source
        for part in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(PROJECT / part, folder)
        for part in ("edge_agent", "drivers"):
            shutil.copytree(PROJECT / part, Path(folder, part), ignore=shutil.ignore_patterns("__pycache__"))
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
        _check([*pip, "wheel", "--no-deps", "-w", str(out), folder])
    (wheel,) = out.glob("edge_agent-*.whl")
    tags = [f"--platform=manylinux{v}_x86_64" for v in ("_2_28", "_2_27", "_2_17", "2014")]
    _check([*pip, "download", "--only-binary=:all:", "--python-version=3.11", *tags, "-d", str(out), str(wheel)])
    return out


def _check(command: list[str]) -> None:
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: code {done.returncode}\n{done.stdout}{done.stderr}")


# ---------------------------------------------------------------------------------------------------------- the bridge


def scenario() -> Scenario:
    """A bridge deck with one receiver and two accelerometers, slow enough for an emulated processor."""
    structure = Structure(
        thermal_m=(0.004, 0.003, 0.002),
        thermal_s=120.0,
        modes=(Modal(0.62, (0.0015, 0.0020, 0.0025)), Modal(1.35, (0.0004, 0.0005, 0.0008))),
    )
    accels = (Accel(name=DECK, rate_hz=50.0), Accel(name=PYLON, rate_hz=25.0))
    return Scenario("vm", structure, Gnss(rate_hz=5.0, latency_s=LATENCY_S), accels, duration_s=PLAY_S)


def site_yaml(made: Scenario) -> str:
    """The gateway's configuration: the simulated bridge on ttyS1, can0 and an slcan adapter on ttyS2."""
    text = config_yaml(
        made,
        site="vm",
        data_dir=DATA,
        dbc="vm.dbc",
        wiring=Wiring("/dev/ttyS1", "socketcan", "can0"),
        latency_ms=(LATENCY_S + LINE_S) * 1e3,
    )
    tree = yaml.safe_load(text)
    tree["ports"]["adapter"] = {"kind": "can", "interface": "slcan", "channel": "/dev/ttyS2", "bitrate": 500_000}
    tree["accelerometers"][PYLON]["port"] = "adapter"
    return yaml.safe_dump(tree, sort_keys=False)


def only(frames: CanFrames, ids: range) -> CanFrames:
    """The frames of some identifiers."""
    use = (frames.can_id >= ids.start) & (frames.can_id < ids.stop)
    return chosen(frames, use)


def chosen(f: CanFrames, use: Any) -> CanFrames:
    """The frames of a mask."""
    return CanFrames(f.t_ns[use], f.can_id[use], f.flags[use], f.length[use], f.data[use])


class Wire:
    """The host's end of a serial port; with `adapter` it is an slcan adapter."""

    ready = True

    def __init__(self, end: socket.socket, adapter: Slcan | None = None) -> None:
        self._end, self._adapter = end, adapter
        self.sent = bytearray()

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, data: bytes) -> None:
        if self._adapter is None or self._adapter.open:
            self._end.sendall(data)
            self.sent += data

    def serve(self) -> None:
        """Take what the guest wrote; the adapter answers."""
        while select.select([self._end], [], [], 0)[0]:
            data = self._end.recv(4096)
            if self._adapter is not None:
                self._end.sendall(self._adapter.feed(data))
            if not data:
                return

    def close(self) -> None:
        self._end.close()


class Serving(threading.Thread):
    """Lets the adapter answer while nothing is played, as a real one does."""

    def __init__(self, wires: tuple[Wire, ...]) -> None:
        super().__init__(daemon=True)
        self.wires, self.ended = wires, threading.Event()

    def run(self) -> None:
        while not self.ended.wait(0.02):
            for wire in self.wires:
                wire.serve()

    def __enter__(self) -> Serving:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.ended.set()
        self.join()


class Player(threading.Thread):
    """Plays onto the serial ports, beside the player in the guest."""

    def __init__(self, parts: list[tuple[Wire, list[tuple[int, bytes]]]], shift_ns: int) -> None:
        super().__init__(daemon=True)
        self.parts, self.shift_ns, self.late_ns = parts, shift_ns, 0
        self.failure: OSError | None = None

    def run(self) -> None:
        try:
            self.late_ns = play(self.parts, self.shift_ns)
        except OSError as e:
            self.failure = e


# -------------------------------------------------------------------------------------------------------- the service


@dataclass
class Session:
    """The machine, what was sent and what is known of it."""

    vm: Machine
    tally: Tally
    share: Path  # of the host, read-only in the guest
    out: Path  # written by the guest
    offset_ns: int = 0  # guest's wall clock minus the host's
    record: SimRecord | None = None
    sent: bytes = b""  # to the receiver's port
    stop_s: float = 0.0
    files: list[Path] = field(default_factory=list)

    def show(self, *names: str) -> dict[str, str]:
        """Properties of the service."""
        lines = self.vm.sh(f"systemctl show {SERVICE} -p {','.join(names)}", timeout=60).splitlines()
        return dict(line.split("=", 1) for line in lines)

    def ready(self, timeout: float = READY_S) -> float:
        """Wait until the service has said READY; seconds, inf where it did not."""
        began = time.monotonic()
        while time.monotonic() - began < timeout:
            if self.show("ActiveState")["ActiveState"] == "active":
                return time.monotonic() - began
            time.sleep(0.5)
        return float("inf")

    def fails(self, command: str) -> bool:
        return self.vm.run(command).rc != 0


def installs(s: Session) -> None:
    """From wheels, without a network; the second time nothing of the technician's is touched."""
    install = "/mnt/share/systemd/install.sh --wheels /mnt/share/wheels"
    began = time.monotonic()
    done = s.vm.run(install, timeout=900)
    seconds = time.monotonic() - began
    there = s.vm.run(f"test -f /etc/edge-agent/site.yaml && edge-agent --version && systemctl cat {SERVICE}").rc == 0
    s.tally.row(done.rc == 0 and there, "install.sh installs, without a network", f"{seconds:.0f} s")
    if done.rc:
        raise RuntimeError(f"the installer failed:\n{done.out}{done.err}")
    s.vm.sh("cp /mnt/share/site.yaml /mnt/share/vm.dbc /etc/edge-agent/")
    began = time.monotonic()
    done = s.vm.run(install, timeout=900)
    seconds = time.monotonic() - began
    same = s.vm.run("cmp /mnt/share/site.yaml /etc/edge-agent/site.yaml").rc == 0
    s.tally.row(done.rc == 0 and same, "install.sh a second time, site.yaml stays", f"{seconds:.0f} s")
    off = s.fails(f"systemctl is-enabled {SERVICE}") and s.fails(f"systemctl is-active {SERVICE}")
    s.tally.row(off, "the installer starts nothing by itself", "neither enabled nor active")


def brings_can_up(s: Session) -> None:
    """The shipped network file, through systemd-networkd and the real driver."""
    s.vm.sh("ip link set can1 type can bitrate 500000 && ip link set can1 up")
    s.vm.sh("systemctl enable --now --quiet systemd-networkd", timeout=120)
    info: dict[str, Any] = {}
    for _ in range(40):
        link = json.loads(s.vm.sh("ip -json -details link show can0"))[0]
        info = link["linkinfo"]["info_data"]
        if "UP" in link["flags"]:
            break
        time.sleep(0.5)
    seen = info.get("bittiming", {}).get("bitrate"), info.get("restart_ms"), info.get("state")
    text = f"{seen[0]} bit/s, restart after {seen[1]} ms, {seen[2]}"
    s.tally.row(seen == (500_000, 100, "ERROR-ACTIVE"), "80-can0.network brings the card up", text)


def starts(s: Session) -> None:
    s.vm.set_clock()
    s.vm.sh(DISCIPLINE)
    s.vm.sh(f"systemctl enable --quiet {SERVICE} && systemctl start --no-block {SERVICE}")
    seconds = s.ready()
    seen = s.show("ActiveState", "SubState", "Type", "StatusText", "User", "Result")
    good = seconds < READY_S and seen["Type"] == "notify" and seen["User"] == SERVICE
    s.tally.row(good, "the service says READY, as its own user", f"{seconds:.1f} s, {seen['ActiveState']}")
    s.tally.row(bool(seen["StatusText"]), "it says its state (STATUS=)", repr(seen["StatusText"]))
    if seconds > READY_S:
        raise RuntimeError(f"no READY:\n{s.vm.run(f'journalctl -u {SERVICE} --no-pager | tail -40').out}")


def clock_offset_ns(vm: Machine) -> int:
    """The guest's wall clock minus the host's, from the quickest of some exchanges."""
    best = (float("inf"), 0)
    for _ in range(8):
        before = time.time_ns()
        guest = int(vm.sh("date +%s%N"))
        after = time.time_ns()
        best = min(best, (after - before, guest - (before + after) // 2))
    return int(best[1])


def plays(s: Session, gnss: Wire, adapter: Wire) -> None:
    """The bridge through the three drivers; on the way the clock steps by an hour, at the end the service stops."""
    with Serving((gnss, adapter)):
        s.offset_ns = clock_offset_ns(s.vm)
        mono_ns, wall_ns = time.monotonic_ns(), time.time_ns()
        utc_ns = (wall_ns // S + 6) * S
        record = s.record = run(scenario(), 1, PLAY_S, utc_ns)
        frames = can_frames(record)
        schedule = socketcan_schedule(only(frames, DECK_IDS))
        (s.share / "can.schedule").write_bytes(b"".join(SCHEDULE_RECORD.pack(t - START_NS, d) for t, d in schedule))
        start = (utc_ns + s.offset_ns) / S
        s.vm.sh("candump -L can0 >/run/candump.log 2>/run/candump.err & echo $! >/run/candump.pid")
        s.vm.sh(f"python3 /mnt/share/player.py can1 /mnt/share/can.schedule {start:.6f} >/run/player.log 2>&1 &")
        player = Player(
            [(gnss, serial_schedule(record)), (adapter, slcan_schedule(only(frames, PYLON_IDS)))],
            mono_ns + utc_ns - wall_ns - START_NS,
        )

    def until(second: float) -> None:
        time.sleep(max(0.0, (utc_ns - time.time_ns()) / S + second))

    player.start()
    until(STEP_S - 8)
    seen = s.show("ActiveState", "NRestarts", "MemoryCurrent", "StatusText")
    memory = int(seen["MemoryCurrent"]) / 1e6
    good = seen["ActiveState"] == "active" and seen["NRestarts"] == "0" and memory < 256
    text = f"{memory:.0f} MB of 256, status {seen['StatusText']!r}"
    s.tally.row(good, "it runs on, without a restart", text)
    until(STEP_S)
    s.vm.sh("date -s \"@$(date -d '+1 hour' +%s.%N)\"")
    until(STOP_S)
    began = time.monotonic()
    done = s.vm.run(f"systemctl stop {SERVICE}", timeout=120)
    s.stop_s = time.monotonic() - began
    seen = s.show("ActiveState", "Result", "ExecMainStatus")
    good = done.rc == 0 and seen == {"ActiveState": "inactive", "Result": "success", "ExecMainStatus": "0"}
    s.tally.row(good, "systemctl stop ends it in good order", f"{s.stop_s:.1f} s, {seen['Result']}")
    player.join()
    if player.failure is not None:
        raise player.failure
    s.sent = bytes(gnss.sent)
    # an hour later on the guest's clock: all of the frames have been sent
    s.vm.sh("sleep 1; kill $(cat /run/candump.pid); sleep 0.5; cp /run/candump.log /run/player.log /mnt/out/")
    say(f"players: {(s.out / 'player.log').read_text().strip()}; serial at most {player.late_ns / MS:.0f} ms late")


def leaves_good_files(s: Session) -> None:
    parts = s.vm.sh(f"ls {DATA} | grep -c part || true").strip()
    done = s.vm.run(f"edge-agent info {DATA}/*.mcap", timeout=300)
    s.vm.sh(f"mkdir -p /mnt/out/rec && cp {DATA}/*.mcap /mnt/out/rec/")
    s.files = sorted((s.out / "rec").glob("*.mcap"))
    good = done.rc == 0 and parts == "0" and bool(s.files)
    s.tally.row(good, "every file is finished and whole (edge-agent info)", f"{len(s.files)} files, {parts} torn")
    if done.rc:
        say(done.out + done.err)


# ---------------------------------------------------------------------------------------------------- what it recorded


def stored(files: list[Path], *wanted: str) -> Iterator[reader.Stored]:
    for path in files:
        yield from reader.read_messages(path, set(wanted))


def records_all(s: Session) -> None:
    """Raw data are what was sent, bit for bit: of a port, and of the CAN card beside candump."""
    got = b"".join(topics.decode_raw(m.topic, m.schema, m.data).payload for m in stored(s.files, "/raw/gnss"))  # type: ignore[misc]
    at = s.sent.find(got[:64]) if got else -1
    good = at == 0 and s.sent[at : at + len(got)] == got and len(got) > 0.9 * len(s.sent) * STOP_S / PLAY_S
    s.tally.row(good, "ttyS1: every byte that was sent until the stop", f"{len(got)} of {len(s.sent)} bytes")
    agent = blocks(s.files, "/raw/can")
    dump = candump(s.out / "candump.log")
    n = len(agent.t_ns)
    same = n > 0 and [(i, d) for _, i, d in dump[:n]] == keys(agent)
    s.tally.row(same, "can0: every frame that candump saw until the stop", f"{n} of {len(dump)} frames")
    n = len(blocks(s.files, "/raw/adapter").t_ns)
    s.tally.row(n > 0.9 * 25 * STOP_S, "slcan adapter on ttyS2: its frames", f"{n} frames")


def blocks(files: list[Path], topic: str) -> CanFrames:
    """All frames of a CAN port, without error frames."""
    found = [topics.decode_raw(m.topic, m.schema, m.data).payload for m in stored(files, topic)]
    use = [b for b in found if isinstance(b, CanFrames)]
    if not use:
        none = np.zeros(0, np.uint8)
        return CanFrames(np.zeros(0, np.int64), np.zeros(0, np.uint32), none, none, np.zeros((0, 8), np.uint8))
    joined = CanFrames(
        np.concatenate([b.t_ns for b in use]),
        np.concatenate([b.can_id for b in use]),
        np.concatenate([b.flags for b in use]),
        np.concatenate([b.length for b in use]),
        np.concatenate([b.data for b in use]),
    )
    return chosen(joined, joined.flags & CanFlag.ERR == 0)


def keys(frames: CanFrames) -> list[tuple[int, bytes]]:
    rows = zip(frames.can_id.tolist(), frames.data, frames.length.tolist(), strict=True)
    return [(i, d[:n].tobytes()) for i, d, n in rows]


def candump(path: Path) -> list[tuple[int, int, bytes]]:
    """(wall ns, identifier, data) of a candump log."""
    out = []
    for line in path.read_text().splitlines():
        m = re.fullmatch(r"\((\d+)\.(\d{6})\) can0 ([0-9A-F]{3})#([0-9A-F]*)", line.strip())
        if m:
            out.append((int(m[1]) * S + int(m[2]) * 1000, int(m[3], 16), bytes.fromhex(m[4])))
    return out


def keeps_time(s: Session) -> None:
    """The kernel's stamps, on the monotonic clock, are those that candump has on the wall clock."""
    ticks = [topics.decode_raw(m.topic, m.schema, m.data) for m in stored(s.files, "/raw/clock")]
    pairs = [(r.t_ns, r.payload) for r in ticks if isinstance(r.payload, Tick)]
    offsets = np.array([p.utc_ns - t for t, p in pairs], np.int64)
    step_ns = int(offsets[-1] - offsets[0])
    s.tally.row(abs(step_ns - 3600 * S) < 2 * S, "the clock's step of one hour is in the Ticks", f"{step_ns / S:.3f} s")
    synced = sum(p.sync for _, p in pairs)
    s.tally.row(
        synced > 60, "the sandbox lets it ask whether the clock is disciplined", f"{synced} of {len(pairs)} Ticks"
    )
    agent, dump = blocks(s.files, "/raw/can"), candump(s.out / "candump.log")
    n = min(len(agent.t_ns), len(dump))
    wall = np.array([t for t, _, _ in dump[:n]], np.int64)
    apart = wall - agent.t_ns[:n]
    before = np.abs(offsets - offsets[0]) < 1800 * S
    sides = [int(np.median(offsets[part])) for part in (before, ~before) if part.any()]
    off = np.min([np.abs(apart - side) for side in sides], axis=0)
    after = int(np.sum(np.abs(apart - sides[0]) > 1800 * S))
    spread = agent.flags[:n] & CanFlag.SPREAD != 0
    worst = int(off[~spread].max()) if (~spread).any() else -1
    good = 0 <= worst <= STAMP_NS and 100 < after < n - 100 and int(spread.sum()) < 0.01 * n
    text = f"at most {worst / 1e3:.0f} us over {n} frames, {after} of them after the step"
    s.tally.row(good, "kernel stamps agree with candump's to 1 ms", text)
    at_step = int(off[spread].max()) / MS if spread.any() else 0.0
    print(
        f"      in the drain in which the clock stepped: {int(spread.sum())} frames, flagged, within {at_step:.1f} ms"
    )


def fuses(s: Session) -> None:
    """At least a minute of fused data before the step, better than the fixes; no gap at the step."""
    assert s.record is not None
    record = s.record
    zero = START_NS + record.utc_offset_ns + s.offset_ns
    fixes = record.fixes.z_m - record.motion.at(record.fixes.t_ns).d_m
    raw = np.sqrt(np.mean(fixes**2, axis=0)) * 1e3
    for name in (DECK, PYLON):
        t, mono, d, std, mode = [], [], [], [], []
        for m in stored(s.files, f"/fusion/deck-{name}/block"):
            block = topics.decode_fused_block("", m.data)
            t.append(m.publish_ns - zero + block.t_ns - block.t_ns[0])
            mono.append(block.t_ns)
            d.append(block.displacement_m)
            std.append(block.std_displacement_m)
            mode.append(block.mode)
        if not t:
            s.tally.row(False, f"{name}: fused data", "none")
            continue
        seconds, where = np.concatenate(t) / S, np.concatenate(d)
        valid = np.isin(np.concatenate(mode), [int(m) for m in VALID_MODES]) & (seconds < STEP_S - 0.5)
        error = where[valid] - record.motion.at(START_NS + np.rint(seconds[valid] * S).astype(np.int64)).d_m
        rms = np.sqrt(np.mean(error**2, axis=0)) * 1e3
        within = float(np.mean(np.abs(error) <= 2 * np.concatenate(std)[valid]))
        length = float(seconds[valid][-1] - seconds[valid][0]) if valid.any() else 0.0
        text = f"{length:.1f} s, {int(valid.sum())} samples"
        s.tally.row(length >= FUSED_S, f"{name}: a minute of fused data before the step", text)
        numbers = "/".join(f"{x:.2f}" for x in rms) + " mm, fixes " + "/".join(f"{x:.2f}" for x in raw)
        good = bool((rms < raw).all())
        s.tally.row(good, f"{name}: rms error x/y/z below that of the fixes", f"{numbers} mm, {within:.0%} within 2 sd")
        gap = float(np.diff(np.concatenate(mono)).max()) / S
        s.tally.row(gap < 0.5, f"{name}: no gap in the estimate, at the step neither", f"longest {gap * 1e3:.0f} ms")
    told: dict[str, int] = {}
    for m in stored(s.files, "/events", "/faults"):
        kind = str(cdr.decode(m.schema, m.data)["kind"])
        told[kind] = told.get(kind, 0) + 1
    print(f"      events and faults: {', '.join(f'{k} {n}' for k, n in sorted(told.items())) or 'none'}")
    s.tally.row(not {"LOSS", "CRASH"} & set(told), "nothing was lost", "no LOSS on /faults")


# -------------------------------------------------------------------------------------------------------- disturbances


def survives_a_hang(s: Session) -> None:
    """A process that is stopped (SIGSTOP) is ended by the watchdog and comes again; its torn file is made whole."""
    drop_in = f"/run/systemd/system/{SERVICE}.service.d"
    s.vm.sh(f"mkdir -p {drop_in} && printf '[Service]\\nWatchdogSec=5\\n' >{drop_in}/watchdog.conf")
    s.vm.sh("systemctl daemon-reload; cangen can1 -g 20 -I 098 -L 8 >/dev/null 2>&1 & echo $! >/run/cangen.pid", 60)
    s.vm.sh(f"systemctl start --no-block {SERVICE}")
    seconds = s.ready()
    time.sleep(8)  # longer than the watchdog: fed, it stays quiet
    seen = s.show("NRestarts", "ActiveState", "MainPID", "WatchdogUSec")
    good = seconds < READY_S and seen["NRestarts"] == "0" and seen["ActiveState"] == "active"
    s.tally.row(good, "fed, a watchdog of 5 s stays quiet", f"8 s, WatchdogUSec={seen['WatchdogUSec']}")
    s.vm.sh(f"kill -STOP {seen['MainPID']}")
    began = time.monotonic()
    while time.monotonic() - began < 60 and s.show("NRestarts")["NRestarts"] == "0":
        time.sleep(0.5)
    caught = time.monotonic() - began
    again = s.ready()
    log = s.vm.sh(f"journalctl -u {SERVICE} --no-pager -o cat")
    good = "Watchdog timeout" in log and s.show("NRestarts")["NRestarts"] == "1" and again < READY_S
    text = f"restarted {caught:.1f} s after SIGSTOP, READY {again:.1f} s later"
    s.tally.row(good, "SIGSTOP is caught by the watchdog", text)
    s.tally.row("RECOVERED" in log, "the torn file is made whole at the next start", "RECOVERED in the journal")
    s.vm.sh("kill $(cat /run/cangen.pid)")
    s.vm.sh(f"systemctl stop {SERVICE}; rm -r {drop_in}; systemctl daemon-reload", timeout=120)


def sees_a_late_adapter(s: Session) -> None:
    """A USB adapter that is plugged after the start: the device list of the sandbox lets it in, the rules name it."""
    s.vm.sh("sed -i s,/dev/ttyS1,/dev/serial/by-id/usb-receiver, /etc/edge-agent/site.yaml")
    s.vm.sh(f"systemctl start --no-block {SERVICE}")
    seconds = s.ready()
    s.tally.row(seconds < READY_S, "READY with a receiver that is not there", f"{seconds:.1f} s")
    # the adapter passes for a receiver, whose numbers it does not have
    rule = 'SUBSYSTEM=="tty", ENV{ID_VENDOR_ID}=="0403", ENV{EDGE_GNSS}="1"'
    s.vm.sh(f"mkdir -p /run/udev/rules.d; echo '{rule}' >/run/udev/rules.d/79-test.rules; udevadm control --reload")
    usb = s.vm.plug_usb("GPS0001")
    link = ""
    for _ in range(40):
        link = s.vm.run("ls /dev/serial/by-id/ | grep GPS0001").out.strip()
        if link:
            break
        time.sleep(0.25)
    timer = s.vm.run("cat /sys/bus/usb-serial/devices/ttyUSB0/latency_timer").out.strip()
    name = s.vm.run("readlink /dev/gnss-GPS0001-00").out.strip()
    wrong = s.vm.run("journalctl -b -u systemd-udevd --no-pager -o cat | grep edge-agent").out.strip()
    s.vm.sh(f"ln -s {link} /dev/serial/by-id/usb-receiver")
    log = ""
    for _ in range(80):
        log = s.vm.sh(f"journalctl -u {SERVICE} --no-pager -o cat")
        if "PORT_OPEN" in log:
            break
        usb.sendall(b"$GNZDA,000000.00,01,01,2026,00,00*7D\r\n")
        time.sleep(1)
    s.tally.row(bool(link) and "PORT_OPEN" in log, "a USB adapter plugged later is opened", f"{link}")
    s.tally.row(name == "ttyUSB0" and not wrong, "udev rule: a stable name", f"/dev/gnss-GPS0001-00 -> {name} {wrong}")
    s.tally.row(timer == "1", "udev rule: latency timer of FTDI adapters", f"{timer or 'absent'} ms")
    s.vm.unplug_usb()
    usb.close()
    for _ in range(20):
        log = s.vm.sh(f"journalctl -u {SERVICE} --no-pager -o cat")
        if log.rfind("PORT_LOST") > log.rfind("PORT_OPEN"):
            break
        time.sleep(0.5)
    good = log.rfind("PORT_LOST") > log.rfind("PORT_OPEN") and s.show("ActiveState")["ActiveState"] == "active"
    s.tally.row(good, "unplugged: a fault, and the service runs on", "PORT_LOST in the journal")
    s.vm.sh(f"systemctl stop {SERVICE}", timeout=120)


def refuses_a_wrong_file(s: Session) -> None:
    """`check` stands before the start: a mistake is in the journal with its line, and the service stays down."""
    s.vm.sh("cp /etc/edge-agent/site.yaml /run/good.yaml; echo 'frobnicate: 1' >>/etc/edge-agent/site.yaml")
    done = s.vm.run(f"timeout 60 systemctl start {SERVICE}", timeout=120)
    log = s.vm.sh(f"journalctl -u {SERVICE} --no-pager -o cat | tail -20")
    told = re.search(r"^frobnicate: .*", log, re.MULTILINE)
    s.vm.sh(f"systemctl stop {SERVICE}; cp /run/good.yaml /etc/edge-agent/site.yaml", timeout=120)
    s.tally.row(
        done.rc != 0 and told is not None, "a wrong site.yaml keeps it down", told[0][:50] if told else "not told"
    )


def survives_a_power_cut(s: Session, reboot: Callable[[], Machine]) -> None:
    """The plug is pulled while it records; the machine boots, and all comes up by itself."""
    s.vm.sh("cp /mnt/share/site.yaml /etc/edge-agent/")
    s.vm.sh("cangen can1 -g 20 -I 098 -L 8 >/dev/null 2>&1 & echo $! >/run/cangen.pid")
    s.vm.sh(f"systemctl start --no-block {SERVICE}")
    s.ready()
    torn = ""
    for _ in range(60):
        torn = s.vm.run(f"ls {DATA}/*.part").out.strip()
        if torn:
            break
        time.sleep(0.5)
    time.sleep(8)  # longer than record.fsync_s
    s.vm.power_cut()
    s.vm = reboot()
    seconds = s.ready()
    log = s.vm.sh(f"journalctl -b -u {SERVICE} --no-pager -o cat")
    good = seconds < READY_S and "RECOVERED" in log and bool(torn)
    recovered = re.search(r"RECOVERED: (.*)", log)
    text = recovered[1] if recovered else "nothing recovered"
    s.tally.row(good, "after a power cut it comes up by itself, the file is whole", text)
    room = s.vm.sh("sysctl -n net.core.rmem_max").strip()
    state = s.vm.sh("ip -br link show can0").split()[1]
    modules = s.vm.run("grep -qw usbserial /proc/modules && grep -qw cdc_acm /proc/modules").rc == 0
    text = f"can0 {state}, net.core.rmem_max {room}, modules {'loaded' if modules else 'absent'}"
    s.tally.row(state == "UP" and room == "4194304" and modules, "and so do interface, buffer limit and drivers", text)
    s.vm.sh(f"systemctl stop {SERVICE}", timeout=120)


def is_hardened(s: Session) -> None:
    out = s.vm.run(f"systemd-analyze security --no-pager {SERVICE}", timeout=120).out
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", out)
    level = float(found[1]) if found else float("nan")
    s.tally.row(level <= MAX_EXPOSURE, "systemd-analyze security", f"{level} (at most {MAX_EXPOSURE})")


def uninstalls(s: Session) -> None:
    done = s.vm.run("/opt/edge-agent/share/install.sh --uninstall", timeout=120)
    gone = s.fails(f"systemctl cat {SERVICE}") and s.fails("test -e /opt/edge-agent -o -e /usr/local/bin/edge-agent")
    kept = s.vm.run(f"test -f /etc/edge-agent/site.yaml && ls {DATA}/*.mcap && getent passwd {SERVICE}").rc == 0
    s.tally.row(done.rc == 0 and gone and kept, "--uninstall: gone, configuration and data kept", f"code {done.rc}")
    done = s.vm.run("/mnt/share/systemd/install.sh --uninstall --purge", timeout=120)
    left = s.vm.sh(
        f"find / -xdev -name '*edge-agent*' -not -path '/proc/*' -not -path '/mnt/*' -not -path '/var/log/*' "
        f"-not -path '/tmp/*'; getent passwd {SERVICE} || true"
    ).split()
    s.tally.row(done.rc == 0 and not left, "--uninstall --purge leaves nothing", " ".join(left) or "nothing left")


# ----------------------------------------------------------------------------------------------------------------- main


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the recordings and logs there")
    args = parser.parse_args()
    why = missing_tools()
    if why:
        print(f"skip  the virtual machine tier: {why}\n0 passed, 0 failed, 1 skipped")
        return 0
    began = time.monotonic()
    tally = Tally()
    try:
        made, wheels = image.build(say), collect_wheels()
    except RuntimeError as e:
        tally.row(False, "image and wheels are made", str(e))
        print(f"{tally.passed} passed, {tally.failed} failed")
        return 1
    with tempfile.TemporaryDirectory(prefix="edge-agent-share-") as folder, contextlib.ExitStack() as cleanup:
        share, out = Path(folder, "share"), (args.keep or Path(folder, "out")).resolve()
        share.mkdir()
        out.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(out / "rec", ignore_errors=True)  # of an earlier run
        shutil.copytree(PROJECT / "systemd", share / "systemd")
        shutil.copytree(wheels, share / "wheels")
        shutil.copy(HERE / "player.py", share)
        (share / "site.yaml").write_text(site_yaml(scenario()))
        (share / "vm.dbc").write_text(dbc_text(scenario()))
        vm = cleanup.enter_context(Machine.fresh(made, share, out))
        say(f"machine up after {time.monotonic() - began:.0f} s")
        s = Session(vm, tally, share, out)

        def reboot() -> Machine:
            again = cleanup.enter_context(Machine.boot(made, vm.disk, share, out))
            again.mount()
            return again

        try:
            work(s, reboot)
        except (RuntimeError, OSError, ValueError) as e:
            tally.row(False, "the run came to its end", f"{type(e).__name__}: {e}")
        with contextlib.suppress(RuntimeError, OSError, ValueError):
            log = s.vm.run(f"journalctl -u {SERVICE} --no-pager", timeout=60).out
            (out / "journal.txt").write_text(log)
            if tally.failed:
                say(f"the service's journal:\n{log[-6000:]}")
    say(f"took {time.monotonic() - began:.0f} s")
    print(f"{tally.passed} passed, {tally.failed} failed")
    return 1 if tally.failed else 0


def work(s: Session, reboot: Callable[[], Machine]) -> None:
    """Everything in turn."""
    installs(s)
    brings_can_up(s)
    gnss, adapter = Wire(s.vm.port("ttyS1")), Wire(s.vm.port("ttyS2"), Slcan())
    with Serving((gnss, adapter)):
        starts(s)
    plays(s, gnss, adapter)
    checks: tuple[Callable[[Session], None], ...] = (leaves_good_files, records_all, keeps_time, fuses)
    for check in checks:
        check(s)
    with Serving((gnss, adapter)):
        survives_a_hang(s)
        sees_a_late_adapter(s)
        refuses_a_wrong_file(s)
    gnss.close()
    adapter.close()
    survives_a_power_cut(s, reboot)
    is_hardened(s)
    uninstalls(s)


if __name__ == "__main__":
    sys.exit(main())
