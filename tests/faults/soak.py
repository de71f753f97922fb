"""A month in two hours: `python tests/faults/soak.py [WALL_MINUTES [SIMULATED_DAYS]]`, 120 and 30 by default.

Pipeline, recorder and clips as in the agent, in simulated time: an accelerometer at 100 Hz in blocks of a second, a
receiver at 1 Hz, the clock. It ends with the simulated days or with the wall time, whichever comes first. On the way:
hourly files, retention by size, clock steps there and back, a receiver and a bus that go away and come back, garbage on
the wire, events with clips. After the first simulated hour memory, descriptors and threads must stand still: resident
memory within 2 MiB at the end, descriptors and threads the same. Prints a row each six simulated hours.
"""

from __future__ import annotations

import gc
import os
import random
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from edge_agent import assemble, config
from edge_agent.messages import CanFrames, Raw, S, Tick
from edge_agent.recording.clips import Clips
from edge_agent.recording.segments import Recorder
from edge_agent.runtime import resident_bytes
from edge_agent.simulate.encode import nmea_epoch

HZ = 100
START_NS = 1000 * S
UTC_NS = 1_780_300_800 * S - START_NS
HOUR = 3600
BOUND = 2 << 20
YAML = """
site: soak
data_dir: .
structure: {reference_llh: [46.5, 7.5, 610.0]}
ports: {gnss: {kind: serial, device: /dev/null}, can: {kind: can}}
receivers: {rover: {port: gnss}}
accelerometers:
  deck:
    port: can
    unit: mg
    rate_hz: 100
    fields: {x: {id: 1, start: 0, length: 16}, y: {id: 1, start: 16, length: 16}, z: {id: 1, start: 32, length: 16}}
    counter: {id: 1, start: 48, length: 16, signed: false}
points: {mid: {receiver: rover, accelerometer: deck}}
record: {keep_gb: 0.02, rotate_mb: 4, free_gb: 0, view_hz: 1}
triggers: {shaken: {point: mid, above_mps2: 0.5}}
events: {clips_gb: 0.001, max_s: 60}
"""


class Sensors:
    """Second by second, what the ports would have read. The same seed gives the same."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        noise = np.random.default_rng(seed)
        self.blocks = np.rint(noise.normal(0.0, 2.0, (64, HZ, 3)) + np.array([5.0, -7.0, 1000.0])).astype("<i2")
        self.wander = noise.normal(0.0, 0.002, (997, 3))

    def second(self, s: int) -> list[tuple[int, str, bytes | CanFrames | Tick]]:
        t = START_NS + s * S
        hour, within = divmod(s, HOUR)
        step_s = {0: 0, 1: 3600, 2: 0, 3: -2}[hour // 6 % 4]  # the wall clock steps every six hours
        out: list[tuple[int, str, bytes | CanFrames | Tick]] = [
            (t, "clock", Tick(t + UTC_NS + step_s * S, True, 1_000_000))
        ]
        if not (hour % 2 == 1 and 600 <= within < 640):  # the receiver is away for 40 s every other hour
            e, n, u = self.wander[s % 997].tolist()
            llh = (46.5 + n / 111_000, 7.5 + e / 76_000, 610.0 + 2 * u)
            data = nmea_epoch(t + UTC_NS, llh, (0.004, 0.004, 0.008), 4, date=s % 10 == 0)
            if self.rng.random() < 0.01:
                at = self.rng.randrange(len(data))
                data = data[:at] + self.rng.randbytes(9) + data[at:]
            out.append((t + 80_000_000, "gnss", data))
        if not (hour % 3 == 2 and 1200 <= within < 1290):  # and the bus for 90 s every third
            data = np.zeros((HZ, 8), np.uint8)
            data[:, :6] = self.blocks[s % 64].view(np.uint8).reshape(HZ, 6)
            if within == 1800 and hour % 4 == 0:
                data[50, 0:2] = 0xFF, 0x00  # 255 mg: an event
            data[:, 6:8] = ((s * HZ + np.arange(HZ)) & 0xFFFF).astype("<u2").view(np.uint8).reshape(HZ, 2)
            t_ns = t + np.arange(HZ) * (S // HZ)
            can = CanFrames(t_ns, np.ones(HZ, np.uint32), np.zeros(HZ, np.uint8), np.full(HZ, 8, np.uint8), data)
            out.append((t + 990_000_000, "can", can))
        return out


class Soak:
    """The agent's main and writer in one thread, driven by simulated time."""

    def __init__(self, folder: Path) -> None:
        self.made = config.parse(YAML, folder)
        self.pipeline = assemble.pipeline(self.made)
        self.recorder = Recorder(folder, self.made.record, "soak", {"run": "soak"}, {}, lambda: 1 << 40)
        self.clips = Clips(self.recorder, self.made.events, self.made.triggers.values())
        self.clips.start()
        self.period = -1
        self.frames = self.records = self.rotations = self.steps = 0
        self.faults: dict[str, int] = {}

    def take(self, t_ns: int, source: str, payload: bytes | CanFrames | Tick) -> None:
        p = self.pipeline
        reason = p.rotate_due or ("start" if self.period < 0 else "")
        if not reason and p.to_utc(t_ns) // (HOUR * S) != self.period:
            reason = "time"
        if not reason and self.recorder.open_bytes >= self.made.record.rotate_mb * 1e6:
            reason = "size"
        if reason and not (reason == "start" and isinstance(payload, Tick)):
            self.steps += reason == "clock"
            self.rotations += 1
            self.recorder.handle(p.rotate(reason, t_ns), t_ns)
            self.period = p.to_utc(t_ns) // (HOUR * S)
        for record in p.step(Raw(t_ns, p.order, source, payload)):
            if self.recorder.path is not None:
                self.recorder.handle(record, t_ns)
            self.records += 1
            if record.topic == "/events":
                self.clips.saw(record, p.to_utc(0))
        if isinstance(payload, CanFrames):
            self.frames += len(payload.t_ns)
        if isinstance(payload, Tick):
            self.recorder.idle(t_ns)
            self.clips.every_second(t_ns)
            for f in [
                *self.recorder.drain_faults(),
                *(self.clips.faults.popleft() for _ in range(len(self.clips.faults))),
            ]:
                self.faults[f.kind] = self.faults.get(f.kind, 0) + 1

    def close(self, now_ns: int) -> None:
        self.recorder.close()
        self.clips.close(now_ns)
        self.clips.join(60)


def standing() -> tuple[int, int, int]:
    """Resident bytes, descriptors, threads."""
    gc.collect()
    return resident_bytes(), len(os.listdir("/proc/self/fd")), threading.active_count()


def soak(wall_s: float, simulated_s: int, folder: Path) -> list[str]:
    run, sensors = Soak(folder), Sensors(1)
    first: tuple[int, int, int] | None = None
    wrong: list[str] = []
    begin = time.monotonic()
    print("simulated h  wall s  files  RSS MiB  descriptors  threads     frames    records  clock steps")
    s = 0
    while s < simulated_s and time.monotonic() - begin < wall_s:
        for t_ns, source, payload in sensors.second(s):
            run.take(t_ns, source, payload)
        s += 1
        if s == HOUR or s % (6 * HOUR) == 0:
            now = standing()
            first = first or now
            files = sum(p.suffix in (".mcap", ".part") for p in folder.iterdir())
            wall = time.monotonic() - begin
            print(
                f"{s / HOUR:11.1f}  {wall:6.0f}  {files:5d}  {now[0] / (1 << 20):7.2f}  {now[1]:11d}  {now[2]:7d}",
                end="",
            )
            print(f"  {run.frames:9d}  {run.records:9d}  {run.steps:5d}", flush=True)
    last = standing()
    run.close(START_NS + s * S)
    print(f"{s / HOUR:.1f} simulated hours, {run.frames} frames, {run.rotations} files, {run.steps} clock steps")
    print(f"faults: {run.faults}")
    if first is None:
        wrong.append("it ended before the first simulated hour")
        return wrong
    grown = last[0] - first[0]
    print(f"RSS {last[0] / (1 << 20):.2f} MiB at the end, {grown / (1 << 20):+.2f} MiB since the first simulated hour")
    if grown > BOUND:
        wrong.append(f"memory grew by {grown / (1 << 20):.2f} MiB, {BOUND >> 20} allowed")
    if last[1:] != first[1:]:
        wrong.append(f"descriptors and threads were {first[1:]} and are {last[1:]}")
    return wrong


def main(argv: list[str]) -> int:
    minutes, days = (float(x) for x in (*argv, *("120", "30")[len(argv) :]))
    shm = Path("/dev/shm")  # fsync is not what is tried here
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as name:
        wrong = soak(60 * minutes, int(days * 24 * HOUR), Path(name))
    for w in wrong:
        print(f"WRONG: {w}")
    print("soak: " + ("NOT good" if wrong else "good"))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
