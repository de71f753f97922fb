"""The real service on a real Linux: installed, fed through real drivers, disturbed, stopped and removed.

    python tests/vm/run.py [--keep FOLDER] [--faults few]

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
import shutil
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import yaml

HERE = Path(__file__).resolve().parent
PROJECT = HERE.parents[1]
sys.path[:0] = [str(HERE), str(PROJECT)]

import faults  # noqa: E402
import image  # noqa: E402
from machine import Machine  # noqa: E402
from session import (  # noqa: E402
    DATA,
    SERVICE,
    Player,
    Serving,
    Session,
    Tally,
    Wire,
    blocks,
    candump,
    clock_offset_ns,
    keys,
    only,
    say,
    stored,
    waited,
)

from edge_agent.messages import MS, VALID_MODES, CanFlag, S, Tick  # noqa: E402
from edge_agent.recording import cdr, topics  # noqa: E402
from edge_agent.simulate.bridge import SimRecord, run  # noqa: E402
from edge_agent.simulate.encode import Wiring, can_frames, config_yaml, dbc_text  # noqa: E402
from edge_agent.simulate.play import Slcan, serial_schedule, slcan_schedule, socketcan_schedule  # noqa: E402
from edge_agent.simulate.specs import START_NS, Accel, Gnss, Modal, Scenario, Structure  # noqa: E402

TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "qemu-img": "qemu-utils",
    "mmdebstrap": "mmdebstrap",
    "mke2fs": "e2fsprogs",
}
PLAY_S, STEP_S, STOP_S = 122.0, 92.0, 114.0  # of the play: its length, the clock's step, the service's stop
FUSED_S = 60.0  # at least so long of fused data before the clock steps
STAMP_NS = MS  # kernel stamps of agent and candump agree within
LATENCY_S = 0.200
LINE_S = 0.010  # a GGA's bytes at 115200 baud
LATE_NS = 100 * MS  # beyond that players or guest were too late for the estimate to be judged
INSTALL_S = 3600.0
PIP = (sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check")
MAX_EXPOSURE = 2.0
DECK, PYLON = "deck", "pylon"  # accelerometers on the CAN card and on the slcan adapter
PYLON_HZ = 20.0
DECK_IDS, PYLON_IDS = range(0x098, 0x0A8), range(0x0A8, 0x0B8)
FAULTS_S = 4800.0  # of the play beside them; they take some 10 minutes
SCHEDULE_RECORD = struct.Struct("=q16s")  # as player.py reads it
# Tells the kernel that its clock is disciplined, as an NTP daemon does: struct timex with modes = status and errors.
DISCIPLINE = (
    "python3 -c 'import ctypes, struct; t = ctypes.create_string_buffer(512); "
    'struct.pack_into("@Illlli", t, 0, 0x1C, 0, 0, 1000, 1000, 0); print(ctypes.CDLL(None).adjtimex(t))\''
)


# A receiver that speaks on a socket.
PORT = 4001
SERVER = f"""import socket, time
server = socket.create_server(("127.0.0.1", {PORT}))
while True:
    end, _ = server.accept()
    try:
        for line in open("/mnt/share/nmea.bin", "rb"):
            end.sendall(line)
            time.sleep(0.05)
    except OSError:
        pass
"""


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
            apt = ["apt-get", "-q", "-o", "Acquire::http::Timeout=30", *command.split()]
            subprocess.run(apt, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, check=False)
    if missing:
        return f"{', '.join(missing)} could not be installed"
    return "" if _which("apt-cache") else "the image is made from Debian packages; there is no apt here"


def _which(tool: str) -> str | None:
    return shutil.which(tool, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin")


def build_wheel() -> Path:
    """The agent's wheel, as it stands, in the folder of wheels."""
    out = image.cache_dir() / "wheels"
    out.mkdir(parents=True, exist_ok=True)
    for old in out.glob("edge_agent-*.whl"):
        old.unlink()
    with tempfile.TemporaryDirectory() as folder:  # a build leaves files in its source
        for part in ("pyproject.toml", "README.md", "LICENSE"):
            shutil.copy(PROJECT / part, folder)
        for part in ("edge_agent", "drivers"):
            shutil.copytree(PROJECT / part, Path(folder, part), ignore=shutil.ignore_patterns("__pycache__"))
        _check([*PIP, "wheel", "--no-deps", "-w", str(out), folder])
    (wheel,) = out.glob("edge_agent-*.whl")
    return wheel


def add_libraries(wheel: Path) -> None:
    """What the agent needs, for Debian 12's Python 3.11, beside its wheel."""
    tags = [f"--platform=manylinux{v}_x86_64" for v in ("_2_28", "_2_27", "_2_17", "2014")]
    binary = ["--only-binary=:all:", "--python-version=3.11", *tags]
    _check([*PIP, "download", *binary, "-d", str(wheel.parent), str(wheel)])


def _check(command: list[str]) -> None:
    done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: code {done.returncode}\n{done.stdout}{done.stderr}")


# ---------------------------------------------------------------------------------------------------------- the bridge


def scenario(duration_s: float = PLAY_S, fix_hz: float = 5.0) -> Scenario:
    """A bridge deck with one receiver and two accelerometers, slow enough for an emulated processor."""
    structure = Structure(
        thermal_m=(0.004, 0.003, 0.002),
        thermal_s=120.0,
        modes=(Modal(0.62, (0.0015, 0.0020, 0.0025)), Modal(1.35, (0.0004, 0.0005, 0.0008))),
    )
    accels = (Accel(name=DECK, rate_hz=10 * fix_hz), Accel(name=PYLON, rate_hz=PYLON_HZ))
    return Scenario("vm", structure, Gnss(rate_hz=fix_hz, latency_s=LATENCY_S), accels, duration_s=duration_s)


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


# -------------------------------------------------------------------------------------------------------- the service


def installs(s: Session) -> None:
    """From wheels, without a network; the second time nothing of the technician's is touched."""
    install = "/mnt/share/systemd/install.sh --wheels /mnt/share/wheels"
    began = time.monotonic()
    done = s.vm.run(install, timeout=INSTALL_S)
    seconds = time.monotonic() - began
    there = s.vm.run(f"test -f /etc/edge-agent/site.yaml && edge-agent --version && systemctl cat {SERVICE}").rc == 0
    s.tally.row(done.rc == 0 and there, "install.sh installs, without a network", f"{seconds:.0f} s")
    if done.rc:
        raise RuntimeError(f"the installer failed:\n{done.out}{done.err}")
    s.vm.sh("cp /mnt/share/site.yaml /mnt/share/vm.dbc /etc/edge-agent/")
    began = time.monotonic()
    done = s.vm.run(install, timeout=INSTALL_S)
    seconds = time.monotonic() - began
    same = s.vm.run("cmp /mnt/share/site.yaml /etc/edge-agent/site.yaml").rc == 0
    s.tally.row(done.rc == 0 and same, "install.sh a second time, site.yaml stays", f"{seconds:.0f} s")
    off = s.fails(f"systemctl is-enabled {SERVICE}") and s.fails(f"systemctl is-active {SERVICE}")
    s.tally.row(off, "the installer starts nothing by itself", "neither enabled nor active")


def brings_can_up(s: Session) -> None:
    """The shipped network file, through systemd-networkd and the real driver."""
    s.vm.sh("ip link set can1 type can bitrate 500000 && ip link set can1 up")
    s.vm.sh("systemctl enable --now --quiet systemd-networkd")
    info: dict[str, Any] = {}

    def up() -> bool:
        link = json.loads(s.vm.sh("ip -json -details link show can0"))[0]
        info.update(link["linkinfo"]["info_data"])
        return "UP" in link["flags"]

    waited(up)
    seen = info.get("bittiming", {}).get("bitrate"), info.get("restart_ms"), info.get("state")
    text = f"{seen[0]} bit/s, restart after {seen[1]} ms, {seen[2]}"
    s.tally.row(seen == (500_000, 100, "ERROR-ACTIVE"), "80-can0.network brings the card up", text)


def starts(s: Session) -> None:
    s.vm.set_clock()
    s.vm.sh(DISCIPLINE)
    s.be_patient()
    s.vm.sh(f"systemctl enable --quiet {SERVICE}")
    seconds = s.starts()
    seen = s.show("ActiveState", "SubState", "Type", "StatusText", "User", "Result")
    good = seen["ActiveState"] == "active" and seen["Type"] == "notify" and seen["User"] == SERVICE
    s.tally.row(good, "the service says READY, as its own user", f"{seconds:.1f} s, {seen['ActiveState']}")
    s.tally.row(bool(seen["StatusText"]), "it says its state (STATUS=)", repr(seen["StatusText"]))
    if seen["ActiveState"] != "active":
        raise RuntimeError(f"no READY:\n{s.vm.run(f'journalctl -u {SERVICE} --no-pager | tail -40').out}")


def prepared(s: Session, made: Scenario, seed: int) -> tuple[SimRecord, int]:
    """A bridge whose play begins in some seconds, and the host's wall time of that; CAN frames in `share`."""
    for lead_s in (6, 20, 60):  # on a busy host it takes longer
        utc_ns = (time.time_ns() // S + lead_s) * S
        record = run(made, seed, made.duration_s, utc_ns)
        schedule = socketcan_schedule(only(can_frames(record), DECK_IDS))
        (s.share / "can.schedule").write_bytes(b"".join(SCHEDULE_RECORD.pack(t - START_NS, d) for t, d in schedule))
        if utc_ns - time.time_ns() > 4 * S:
            break
    return record, utc_ns


def started(s: Session, record: SimRecord, utc_ns: int, gnss: Wire, adapter: Wire) -> Player:
    """Both players, in the guest onto can1 and here onto the serial ports."""
    start = (utc_ns + s.offset_ns) / S
    s.vm.sh(
        f"python3 /mnt/share/player.py can1 /mnt/share/can.schedule {start:.6f} >/run/player.log 2>&1 & "
        "echo $! >/run/player.pid"
    )
    pylon = slcan_schedule(only(can_frames(record), PYLON_IDS))
    shift_ns = time.monotonic_ns() - time.time_ns() + utc_ns - START_NS
    player = Player([(gnss, serial_schedule(record)), (adapter, pylon)], shift_ns)
    player.start()
    return player


def plays(s: Session, gnss: Wire, adapter: Wire) -> None:
    """The bridge through the three drivers; on the way the clock steps by an hour, at the end the service stops."""
    with Serving((gnss, adapter)):
        s.offset_ns = clock_offset_ns(s.vm)
        s.vm.sh("candump -r 4000000 -L can0 >/run/candump.log 2>/run/candump.err & echo $! >/run/candump.pid")
        s.record, utc_ns = prepared(s, scenario(), 1)
    player = started(s, s.record, utc_ns, gnss, adapter)

    def until(second: float) -> None:
        time.sleep(max(0.0, (utc_ns - time.time_ns()) / S + second))

    until(STEP_S - 8)
    seen = s.show("ActiveState", "NRestarts", "MemoryCurrent", "StatusText")
    memory = seen["MemoryCurrent"]
    text = f"{int(memory) / 1e6 if memory.isdigit() else 0:.0f} MB of 256, status {seen['StatusText']!r}"
    good = seen["ActiveState"] == "active" and seen["NRestarts"] == "0"
    s.tally.row(good, "it runs on, without a restart", text)
    until(STEP_S)
    s.step_s = (time.time_ns() - utc_ns) / S
    s.vm.sh("date -s \"@$(date -d '+1 hour' +%s.%N)\"")
    until(STOP_S)
    s.by_stop = len(gnss.sent), adapter.sent.count(b"\r")
    began = time.monotonic()
    done = s.vm.run(f"systemctl stop {SERVICE}")
    seconds = time.monotonic() - began
    stop_s = (time.time_ns() - utc_ns) / S
    seen = s.show("ActiveState", "Result", "ExecMainStatus")
    good = done.rc == 0 and seen == {"ActiveState": "inactive", "Result": "success", "ExecMainStatus": "0"}
    s.tally.row(good, "systemctl stop ends it in good order", f"{seconds:.1f} s, {seen['Result']}")
    player.join()
    if player.failure is not None:
        raise player.failure
    s.sent = bytes(gnss.sent)
    # the player in the guest may be behind: the emulated card takes its time
    waited(lambda: s.vm.run("kill -0 $(cat /run/player.pid)").rc != 0)
    s.vm.sh("sleep 1; kill $(cat /run/candump.pid); sleep 0.5; cp /run/candump.log /run/player.log /mnt/out/")
    log = (s.out / "player.log").read_text().strip()
    said = re.search(r"at most ([\d.]+) ms late", log)
    s.late_ns = max(player.late_ns, int(float(said[1]) * MS) if said else 0)
    s.tally.told(
        None, "the players", f"{log}; serial at most {player.late_ns / MS:.0f} ms late; stop at {stop_s:.0f} s"
    )


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


def records_all(s: Session) -> None:
    """Raw data are what was sent, bit for bit: of a port, and of the CAN card beside candump."""
    got = b"".join(topics.decode_raw(m.topic, m.schema, m.data).payload for m in stored(s.files, "/raw/gnss"))  # type: ignore[misc]
    at = s.sent.find(got[:64]) if got else -1
    # how much of it is still on the way at the stop is the emulation's affair
    good = at == 0 and s.sent[at : at + len(got)] == got and 2 * len(got) > s.by_stop[0]
    text = f"{len(got)} of {s.by_stop[0]} bytes by then"
    s.tally.row(good, "ttyS1: every byte that was sent until the stop", text)
    agent = blocks(s.files, "/raw/can")
    dump = candump(s.out / "candump.log")
    n = len(agent.t_ns)
    same = n > 0 and [(i, d) for _, i, d in dump[:n]] == keys(agent)
    s.tally.row(same, "can0: every frame that candump saw until the stop", f"{n} of {len(dump)} frames")
    n = len(blocks(s.files, "/raw/adapter").t_ns)
    s.tally.row(2 * n > s.by_stop[1], "slcan adapter on ttyS2: its frames", f"{n} of {s.by_stop[1]} by the stop")


def keeps_time(s: Session) -> None:
    """The kernel's stamps, on the monotonic clock, are those that candump has on the wall clock."""
    ticks = [topics.decode_raw(m.topic, m.schema, m.data) for m in stored(s.files, "/raw/clock")]
    pairs = [(r.t_ns, r.payload) for r in ticks if isinstance(r.payload, Tick)]
    offsets = np.array([p.utc_ns - t for t, p in pairs], np.int64)
    step_ns = int(offsets[-1] - offsets[0])
    s.tally.row(
        abs(step_ns - 3600 * S) < 60 * S, "the clock's step of one hour is in the Ticks", f"{step_ns / S:.3f} s"
    )
    synced = sum(p.sync for _, p in pairs)
    s.tally.row(
        4 * synced > len(pairs),
        "the sandbox lets it ask whether the clock is disciplined",
        f"{synced} of {len(pairs)} Ticks",
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
    # the rest: the agent was put aside between its looks at the two clocks
    most = float(np.quantile(off[~spread], 0.99)) if (~spread).any() else -1.0
    good = 0 <= most <= STAMP_NS and 0 < after < n and int(spread.sum()) < n // 4
    text = f"99 % {most / 1e3:.0f} us, at most {worst / 1e3:.0f} us over {n} frames, {after} of them after the step"
    s.tally.row(good, "kernel stamps agree with candump's to 1 ms", text)
    at_step = int(off[spread].max()) / MS if spread.any() else 0.0
    text = f"{int(spread.sum())} frames, flagged, within {at_step:.1f} ms"
    s.tally.told(None, "in the drain in which the clock stepped", text)


def guest_late_ns(s: Session) -> int:
    """How late the guest let the agent look at its clock, once a second: so late it reads its serial ports too, whose
    bytes have no stamp but that."""
    t_ns = [topics.decode_raw(m.topic, m.schema, m.data).t_ns for m in stored(s.files, "/raw/clock")]
    return int(np.quantile(np.abs(np.diff(t_ns) - S), 0.98)) if len(t_ns) > 1 else 0


def fuses(s: Session) -> None:
    """At least a minute of fused data before the step, better than the fixes; no gap at the step."""
    assert s.record is not None
    record = s.record
    zero = START_NS + record.utc_offset_ns + s.offset_ns
    late_ns = max(s.late_ns, guest_late_ns(s))
    s.tally.told(late_ns <= LATE_NS, "the estimate is judged where nothing was late", f"{late_ns / MS:.0f} ms late")
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
        # the adapter's frames have no stamp of the kernel, and python-can takes a starved processor's time for each
        judge = s.tally.row if name == DECK and late_ns <= LATE_NS else s.tally.told
        if not t:
            judge(False, f"{name}: fused data", "none")
            continue
        seconds, where = np.concatenate(t) / S, np.concatenate(d)
        valid = np.isin(np.concatenate(mode), [int(m) for m in VALID_MODES]) & (seconds < s.step_s - 0.5)
        error = where[valid] - record.motion.at(START_NS + np.rint(seconds[valid] * S).astype(np.int64)).d_m
        rms = np.sqrt(np.mean(error**2, axis=0)) * 1e3
        within = float(np.mean(np.abs(error) <= 2 * np.concatenate(std)[valid]))
        length = float(seconds[valid][-1] - seconds[valid][0]) if valid.any() else 0.0
        text = f"{length:.1f} s, {int(valid.sum())} samples"
        judge(length >= FUSED_S, f"{name}: a minute of fused data before the step", text)
        numbers = "/".join(f"{x:.2f}" for x in rms) + " mm, fixes " + "/".join(f"{x:.2f}" for x in raw)
        numbers += f" mm, {within:.0%} within 2 sd"
        gap = float(np.diff(np.concatenate(mono)).max()) / S
        judge(bool((rms < raw).all()), f"{name}: rms error x/y/z below that of the fixes", numbers)
        text = f"longest {gap * 1e3:.0f} ms"
        judge(gap < 0.5, f"{name}: no gap in the estimate, at the step neither", text)
    told: dict[str, int] = {}
    for m in stored(s.files, "/events", "/faults"):
        kind = str(cdr.decode(m.schema, m.data)["kind"])
        told[kind] = told.get(kind, 0) + 1
    s.tally.told(None, "events and faults", ", ".join(f"{k} {n}" for k, n in sorted(told.items())) or "none")
    s.tally.row(not {"LOSS", "CRASH"} & set(told), "nothing was lost", "no LOSS on /faults")


# ----------------------------------------------------------------------------------------------------------- the rest


def refuses_a_wrong_file(s: Session) -> None:
    """`check` stands before the start: a mistake is in the journal with its line, and the service stays down."""
    s.vm.sh("cp /etc/edge-agent/site.yaml /run/good.yaml; echo 'frobnicate: 1' >>/etc/edge-agent/site.yaml")
    done = s.vm.run(f"timeout 500 systemctl start {SERVICE}")
    log = s.vm.sh(f"journalctl -u {SERVICE} --no-pager -o cat | tail -20")
    told = re.search(r"^frobnicate: .*", log, re.MULTILINE)
    s.stops()
    s.vm.sh("cp /run/good.yaml /etc/edge-agent/site.yaml")
    s.tally.row(
        done.rc != 0 and told is not None, "a wrong site.yaml keeps it down", told[0][:50] if told else "not told"
    )


def reaches_the_network(s: Session) -> None:
    """A receiver behind a socket is out of reach until the shipped drop-in is in force."""
    record = run(scenario(60.0), 3, 60.0, time.time_ns() + s.offset_ns)
    (s.share / "nmea.bin").write_bytes(b"".join(data for _, data in serial_schedule(record)))
    tree = yaml.safe_load(site_yaml(scenario()))
    tree["ports"] = {"gnss": {"kind": "serial", "device": f"socket://127.0.0.1:{PORT}"}}
    tree["points"] = {"deck": {"receiver": next(iter(tree["receivers"]))}}
    del tree["accelerometers"]
    (s.share / "network.yaml").write_text(yaml.safe_dump(tree, sort_keys=False))
    s.vm.sh("cp /etc/edge-agent/site.yaml /run/good.yaml; cp /mnt/share/network.yaml /etc/edge-agent/site.yaml")
    s.vm.sh(f"python3 -c '{SERVER}' >/dev/null 2>&1 & echo $! >/run/server.pid")
    s.journal()
    s.starts()
    refused = s.told(r"(?m)^gnss: PORT_LOST: .*")
    folder = f"/etc/systemd/system/{SERVICE}.service.d"
    s.vm.sh(f"mkdir -p {folder} && cp /opt/edge-agent/share/network.conf {folder}/ && systemctl daemon-reload")
    s.vm.sh(f"systemctl restart {SERVICE}")
    s.ready()
    good = waited(lambda: "gnss OK" in s.show("StatusText")["StatusText"])
    text = f"without it PORT_LOST, with it {s.show('StatusText')['StatusText']!r}"
    s.tally.row(refused and good, "network.conf, and only that, lets socket:// in", text)
    s.stops()
    s.vm.sh(f"kill $(cat /run/server.pid); rm -r {folder}; systemctl daemon-reload")
    s.vm.sh("cp /run/good.yaml /etc/edge-agent/site.yaml")


def survives_faults(s: Session, adapter: Wire, reboot: Callable[[], Machine], everything: bool) -> None:
    """faults.py, while the bridge is played."""
    gnss = Wire(s.vm.port("usb0"))
    gnss.on = False
    with Serving((adapter,)):
        s.vm.set_clock()
        s.vm.sh(DISCIPLINE)
        made = scenario(FAULTS_S, 2.0)  # each start costs an emulated processor enough
        faults.prepared(s, site_yaml(made), dbc_text(made))
        s.offset_ns = clock_offset_ns(s.vm)
        record, utc_ns = prepared(s, made, 2)
    player = started(s, record, utc_ns, gnss, adapter)

    def plug_pulled() -> Machine:
        player.ended.set()
        player.join()
        return reboot()

    faults.course(faults.Course(s, gnss, adapter), plug_pulled, everything)


def is_hardened(s: Session) -> None:
    out = s.vm.run(f"systemd-analyze security --no-pager {SERVICE}").out
    found = re.search(r"Overall exposure level for \S+: ([\d.]+)", out)
    level = float(found[1]) if found else float("nan")
    s.tally.row(level <= MAX_EXPOSURE, "systemd-analyze security", f"{level} (at most {MAX_EXPOSURE})")


def uninstalls(s: Session) -> None:
    done = s.vm.run("/opt/edge-agent/share/install.sh --uninstall")
    gone = s.fails(f"systemctl cat {SERVICE}") and s.fails("test -e /opt/edge-agent -o -e /usr/local/bin/edge-agent")
    kept = s.vm.run(f"test -f /etc/edge-agent/site.yaml && ls {DATA}/*.mcap && getent passwd {SERVICE}").rc == 0
    s.tally.row(done.rc == 0 and gone and kept, "--uninstall: gone, configuration and data kept", f"code {done.rc}")
    done = s.vm.run("/mnt/share/systemd/install.sh --uninstall --purge")
    left = s.vm.sh(
        f"find / -xdev -name '*edge-agent*' -not -path '/proc/*' -not -path '/mnt/*' -not -path '/var/log/*' "
        f"-not -path '/tmp/*'; getent passwd {SERVICE} || true"
    ).split()
    s.tally.row(done.rc == 0 and not left, "--uninstall --purge leaves nothing", " ".join(left) or "nothing left")


# ----------------------------------------------------------------------------------------------------------------- main


def materials() -> tuple[Path, Path, str]:
    """The machine's image, the agent's wheel beside its libraries, and why not, where they cannot be had."""
    why = missing_tools()
    if not why:
        try:
            made = image.build(say)
            wheel = build_wheel()
            add_libraries(wheel)
        except (RuntimeError, OSError) as e:
            why = str(e)
        else:
            return made, wheel, ""
    return Path(), Path(), why


def fill(share: Path, wheel: Path) -> None:
    """Put into the shared folder what the gateway needs."""
    shutil.copytree(PROJECT / "systemd", share / "systemd")
    shutil.copytree(wheel.parent, share / "wheels")
    shutil.copy(HERE / "player.py", share)
    (share / "site.yaml").write_text(site_yaml(scenario()))
    (share / "vm.dbc").write_text(dbc_text(scenario()))


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the recordings and logs there")
    parser.add_argument("--faults", choices=("all", "few"), default="all", help="few: three of them, half the time")
    args = parser.parse_args()
    began = time.monotonic()
    made, wheel, why = materials()
    if why:
        print(f"skip  the virtual machine tier: {why}\n0 passed, 0 failed, 1 skipped")
        return 0
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix="edge-agent-share-") as folder, contextlib.ExitStack() as cleanup:
        share, out = Path(folder, "share"), (args.keep or Path(folder, "out")).resolve()
        share.mkdir()
        out.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(out / "rec", ignore_errors=True)  # of an earlier run
        fill(share, wheel)
        vm = cleanup.enter_context(Machine.fresh(made, share, out))
        say(f"machine up after {time.monotonic() - began:.0f} s")
        s = Session(vm, tally, share, out)

        def reboot() -> Machine:
            again = cleanup.enter_context(Machine.boot(made, vm.disk, share, out))
            again.mount()
            return again

        try:
            work(s, reboot, args.faults == "all")
        except (RuntimeError, OSError, ValueError) as e:
            tally.row(False, "the run came to its end", f"{type(e).__name__}: {e}")
        with contextlib.suppress(RuntimeError, OSError, ValueError):
            log = s.vm.run(f"journalctl -u {SERVICE} --no-pager").out
            (out / "journal.txt").write_text(log)
            if tally.failed:
                say(f"the service's journal:\n{log[-6000:]}")
    say(f"took {time.monotonic() - began:.0f} s")
    print(f"{tally.passed} passed, {tally.failed} failed")
    return 1 if tally.failed else 0


def work(s: Session, reboot: Callable[[], Machine], everything: bool) -> None:
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
        refuses_a_wrong_file(s)
        reaches_the_network(s)
    is_hardened(s)
    gnss.close()
    survives_faults(s, adapter, reboot, everything)
    uninstalls(s)


if __name__ == "__main__":
    sys.exit(main())
