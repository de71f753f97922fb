"""The whole agent live beside python-can's Notifier: both get the same frames at the same time, each on its own
loopback UDP socket that carries struct can_frame (the kernel stamps it as it stamps SocketCAN); sentences come through
a pseudo-terminal. CPU of each process is read at the borders of windows; nothing else of it is touched."""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
import tty
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import scene
from tasks import S, _rss_mib, _udp

HERE = Path(__file__).resolve().parent
WARM_S = 22.0
"""Start, 15 s of start window, and the first seconds of fusion are not measured."""


@dataclass
class Live:
    """Figures of one run, one number per window where there are several."""

    agent_percent: list[float] = field(default_factory=list)
    notifier_percent: list[float] = field(default_factory=list)
    ready_ms: float = 0.0
    rss_mib: float = 0.0
    raw_bytes: float = 0.0
    all_bytes: float = 0.0
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    share: float = 0.0  # of the samples whose age counts
    notes: list[str] = field(default_factory=list)


def _cpu(pid: int) -> int:
    """CPU time in ns of another process: clock_getcpuclockid(3) of Linux."""
    return time.clock_gettime_ns((~pid << 3) | 2)


def _plan(points: int, seconds: float, begin_ns: int, path: Path) -> None:
    """When which bytes leave, on this machine's monotonic clock; the record's UTC becomes the present."""
    from edge_agent.simulate.encode import can_frames, nmea_bursts
    from edge_agent.simulate.specs import START_NS

    record = scene.simulate(points)
    shift = begin_ns - START_NS
    wall = time.time_ns() - time.monotonic_ns()
    whole = -(-(begin_ns + wall) // S) * S  # receivers fix at whole fractions of UTC
    shift = whole - wall - START_NS
    record = replace(record, utc_offset_ns=whole - START_NS)
    frames = can_frames(record)
    n = int(np.searchsorted(frames.t_ns, START_NS + int(seconds * S)))
    rows = np.zeros(n, np.dtype([("id", "=u4"), ("length", "u1"), ("pad", "u1", 3), ("data", "u1", 8)]))
    rows["id"], rows["length"], rows["data"] = frames.can_id[:n], frames.length[:n], frames.data[:n]
    bursts = [(t, b) for t, b in nmea_bursts(record) if t < START_NS + int(seconds * S)]
    times = np.concatenate([frames.t_ns[:n], [t for t, _ in bursts]]) + shift
    order = np.argsort(times, kind="stable")
    parts = [rows[i].tobytes() for i in range(n)] + [b for _, b in bursts]
    np.savez(
        path,
        t_ns=times[order],
        kind=np.repeat([0, 1], [n, len(bursts)])[order],
        length=np.array([len(p) for p in parts])[order],
        blob=np.frombuffer(b"".join(parts[i] for i in order.tolist()), np.uint8),
    )


def _start(arguments: Sequence[str], env: dict[str, str], fds: Sequence[int] = ()) -> subprocess.Popen[str]:
    command = [sys.executable, str(HERE / "tasks.py"), *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env, pass_fds=fds)


def measure(
    points: int, data: Path, folder: Path, env: dict[str, str], windows: int = 3, window_s: float = 20.0
) -> Live:
    """One run of the agent; `env` decides whose agent it is. RuntimeError when it did not come up or lost frames."""
    found = Live()
    folder.mkdir(parents=True)
    recordings = folder / "recordings"
    bus, peer = _udp(), _udp()
    master, slave = os.openpty()
    tty.setraw(slave)
    text = (data / "config.yaml").read_text()
    text = text.replace("data_dir: recordings", f"data_dir: {recordings}")
    text = text.replace("device: /dev/ttyUSB0", f"device: {os.ttyname(slave)}")
    config = folder / "config.yaml"
    config.write_text(text.replace("site: simulated-bench", "site: bench"))
    (folder / "accelerometers.dbc").write_bytes((data / "accelerometers.dbc").read_bytes())
    notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    notify.bind(str(folder / "notify"))
    notify.settimeout(30.0)
    seconds = WARM_S + windows * window_s + 3.0
    plan = folder / "plan.npz"
    begin = time.monotonic_ns() + 4 * S
    _plan(points, seconds, begin, plan)
    puts = folder / "puts.json"
    agent = _start(
        ["agent", str(config), str(bus.fileno()), str(puts)],
        env | {"NOTIFY_SOCKET": str(folder / "notify")},
        [bus.fileno()],
    )
    notifier = _start(["notifier", str(config), str(peer.fileno())], env, [peer.fileno()])
    ports = [str(s.getsockname()[1]) for s in (bus, peer)]
    sender = _start(["sender", str(plan), str(master), *ports], env, [master])
    bus.close()
    peer.close()
    try:
        while "READY=1" not in notify.recv(4096).decode():
            pass
        found.ready_ms = _cpu(agent.pid) / 1e6
        notify.close()  # nobody reads it from now on, and a full one would hold the agent
        start = begin + int(WARM_S * S)
        before = (0, 0)
        for i in range(windows + 1):
            time.sleep(max(0.0, (start + int(i * window_s * S) - time.monotonic_ns()) / S))
            now = (_cpu(agent.pid), _cpu(notifier.pid))
            if i:
                found.agent_percent.append((now[0] - before[0]) / window_s / 1e7)
                found.notifier_percent.append((now[1] - before[1]) / window_s / 1e7)
            before = now
        found.rss_mib = _rss_mib(agent.pid)
        said = json.loads(sender.communicate(timeout=60)[0])
        late = said["late"]
        if late or said["refused"]:
            found.notes.append(f"busy machine: the sender was late {len(late)} times, {said['refused']} sends refused")
    except (TimeoutError, ProcessLookupError, OSError) as e:
        agent.kill()
        raise RuntimeError(f"the agent did not come up: {agent.communicate()[1][-2000:]}") from e
    finally:
        for p in (agent, notifier, sender):
            if p.poll() is None:
                p.send_signal(signal.SIGTERM)
        ended = [p.communicate(timeout=60) for p in (agent, notifier)]
        sender.wait(timeout=60)
        while select.select([master], [], [], 0)[0]:
            if not os.read(master, 4096):
                break
        os.close(master)
        os.close(slave)
    if agent.returncode:
        raise RuntimeError(f"the agent failed: {ended[0][1][-2000:]}")
    heard = json.loads(ended[1][0])["frames"]
    sizes = figures_of(["sizes", str(data), str(recordings)], env)
    if abs(sizes["frames"] - heard) > 0.001 * heard:
        raise RuntimeError(f"the Notifier heard {heard:.0f} frames, the agent recorded {sizes['frames']:.0f}")
    found.raw_bytes, found.all_bytes = sizes["raw"], sizes["all"]
    ages = figures_of(["ages", str(data), str(recordings), str(puts), json.dumps(late)], env)
    found.p50_ms, found.p99_ms, found.share = ages["p50"], ages["p99"], ages["share"]
    return found


def figures_of(arguments: Sequence[str], env: dict[str, str], most_s: float = 300.0) -> dict[str, float]:
    p = _start(arguments, env)
    out, err = p.communicate(timeout=most_s)
    if p.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: {err[-2000:]}")
    return dict(json.loads(out.splitlines()[-1]))
