"""A month in two hours: `python tests/faults/soak.py [WALL_MINUTES [SIMULATED_DAYS]]`, 120 and 30 by default.

The agent itself - main, writer, clips, status, supervision, ledger - driven second by second in simulated time: an
accelerometer at 100 Hz in blocks of a second, a receiver at 1 Hz, the clock. It ends with the simulated days or with
the wall time, whichever comes first. On the way: hourly files, retention by size, clock steps there and back, a
receiver and a bus whose ports are lost and opened again (real drivers on pseudo-terminals, in real reader threads), a
reader that hangs and is replaced, garbage on the wire, a full disk, events with clips. After the first simulated hour
memory, descriptors and threads must stand still: resident memory within 2 MiB at the end, descriptors and threads the
same, and the ledger of each port balances to the block. What happens at all happens in that first hour too, so that
what is only met for the first time is no growth. Prints a row each six simulated hours.
"""

from __future__ import annotations

import gc
import os
import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import drivers
from drivers import PortError
from edge_agent import assemble, config
from edge_agent.memory import grow_names, steady_memory
from edge_agent.messages import CanFrames, PortSettings, S, Tick
from edge_agent.reading import HUNG_S
from edge_agent.recording.segments import Recorder
from edge_agent.runtime import Agent, resident_bytes
from edge_agent.simulate.encode import nmea_epoch
from edge_agent.simulate.play import Slcan, Terminal

HZ = 100
START_NS = 1000 * S
UTC_NS = 1_780_300_800 * S - START_NS
HOUR = 3600
DAY = 24 * HOUR
BOUND = 2 << 20
PATIENCE_S = 60.0  # of real time
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
record: {keep_gb: 0.02, rotate_mb: 4, free_gb: 0, view_hz: 1, ring_mb: 0.5}
triggers: {shaken: {point: mid, above_mps2: 0.5}, plug: {fault: PORT_LOST}}
events: {clips_gb: 0.004, max_s: 60}
"""
Payload = bytes | CanFrames | Tick


class Sensors:
    """Second by second, what the ports would have read. The same seed gives the same."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        noise = np.random.default_rng(seed)
        self.blocks = np.rint(noise.normal(0.0, 2.0, (64, HZ, 3)) + np.array([5.0, -7.0, 1000.0])).astype("<i2")
        self.wander = noise.normal(0.0, 0.002, (997, 3))

    def away(self, s: int) -> set[str]:
        """Ports that are unplugged in that second."""
        hour, within = divmod(s, HOUR)
        gnss = hour % 2 == 0 and 600 <= within < 640  # for 40 s every other hour
        can = hour % 3 == 0 and 1200 <= within < 1290  # and the bus for 90 s every third
        return {name for name, gone in (("gnss", gnss), ("can", can)) if gone}

    def second(self, s: int) -> list[tuple[int, str, Payload]]:
        t = START_NS + s * S
        hour, within = divmod(s, HOUR)
        step_s = {0: 0, 1: 3600, 2: 0, 3: -2}[hour // 6 % 4]  # the wall clock steps every six hours
        away = self.away(s)
        out: list[tuple[int, str, Payload]] = [(t, "clock", Tick(t + UTC_NS + step_s * S, True, 1_000_000))]
        if "gnss" not in away:
            e, n, u = self.wander[s % 997].tolist()
            llh = (46.5 + n / 111_000, 7.5 + e / 76_000, 610.0 + 2 * u)
            data = nmea_epoch(t + UTC_NS, llh, (0.004, 0.004, 0.008), 4, date=s % 10 == 0)
            if self.rng.random() < 0.01:
                at = self.rng.randrange(len(data))
                data = data[:at] + self.rng.randbytes(9) + data[at:]
            out.append((t + 80_000_000, "gnss", data))
        if "can" not in away:
            data = np.zeros((HZ, 8), np.uint8)
            data[:, :6] = self.blocks[s % 64].view(np.uint8).reshape(HZ, 6)
            if within == 1800 and hour % 4 == 0:
                data[50, 0:2] = 0xFF, 0x00  # 255 mg: an event
            data[:, 6:8] = ((s * HZ + np.arange(HZ)) & 0xFFFF).astype("<u2").view(np.uint8).reshape(HZ, 2)
            t_ns = t + np.arange(HZ) * (S // HZ)
            can = CanFrames(t_ns, np.ones(HZ, np.uint32), np.zeros(HZ, np.uint8), np.full(HZ, 8, np.uint8), data)
            out.append((t + 990_000_000, "can", can))
        return out


class Plug:
    """A port around a real driver on a pseudo-terminal, which is opened and closed as its reader says; what it reads is
    not passed on, the sensors' data come from the soak."""

    def __init__(self, driver: Any, serve: Callable[[], None] = lambda: None) -> None:
        self.driver, self.serve = driver, serve
        self.counters: dict[str, int] = driver.counters
        self.unplugged = threading.Event()
        self.hangs = threading.Event()  # a read does not come back while this is set,
        self.hung = threading.Event()  # which it says here
        self.opens = 0

    def open(self) -> None:
        if self.unplugged.is_set():
            raise PortError("unplugged")
        self.driver.open()
        self.opens += 1

    def read(self) -> list[tuple[int, Any]]:
        self.serve()
        while self.hangs.is_set():
            self.hung.set()
            time.sleep(0.01)
        if self.unplugged.is_set():
            raise PortError("unplugged")
        self.driver.read()
        return []

    def close(self, silently: bool = False) -> None:
        self.driver.close(silently)


class Soak:
    """An Agent whose main and writer are called in turn, in simulated time; readers and clips are its own threads."""

    def __init__(self, folder: Path, status: Path) -> None:
        self.made = config.parse(YAML, folder)
        self.wires = {"gnss": Terminal(), "can": Terminal(Slcan())}
        self.unplugged: set[str] = set()
        self.hang_ns = S  # the clock by which a reader hangs: real time is not what is simulated here
        self.full = False
        ports: dict[str, Any] = {name: self.port(name) for name in self.wires}
        ports["clock"] = drivers.load(drivers.PORTS, "clock")(PortSettings("clock", "clock"))
        self.recorder = Recorder(folder, self.made.record, "soak", {"run": "soak", "version": "0"}, {}, self.free_bytes)
        pipeline = assemble.pipeline(self.made)
        self.agent = Agent(
            self.made, pipeline, ports, self.recorder, self.said, None, status, self.port, lambda: self.hang_ns
        )
        self.folder = folder
        self.agent.readers["gnss"].start()
        self.agent.readers["can"].start()
        assert self.agent.clips is not None
        assert self.agent.publisher is not None
        self.clips, self.publisher = self.agent.clips, self.agent.publisher
        self.clips.start()
        self.publisher.start()
        self.frames = self.records = 0
        self.kinds: Counter[str] = Counter()

    def said(self, text: str) -> None:
        self.kinds[text.split(": ")[1] if text.count(": ") > 1 else "other"] += 1

    def port(self, name: str) -> Plug:
        wire = self.wires[name]
        if name == "gnss":
            return Plug(drivers.load(drivers.PORTS, "serial")(PortSettings(name, "serial", device=wire.path)))
        made = PortSettings(name, "can", interface="slcan", channel=wire.path, bitrate=500_000)
        return Plug(drivers.load(drivers.PORTS, "can")(made), wire.serve)

    def free_bytes(self) -> int:
        return 0 if self.full else 1 << 40

    def plug(self, name: str) -> Plug:
        port = self.agent.readers[name].port
        assert isinstance(port, Plug)
        return port

    def second(self, s: int, sensors: Sensors) -> None:
        away = sensors.away(s)
        for name in away ^ self.unplugged:
            event = self.plug(name).unplugged
            if name in away:
                event.set()
            else:
                event.clear()
        self.unplugged = away
        hour, within = divmod(s, HOUR)
        self.full = hour % 5 == 0 and 2990 <= within < 3020
        if self.full and within == 3000:
            self.agent.writer.want_rotate = True  # no file can be begun then
        if hour % 8 == 0 and within in (2400, 2460):
            self.hang("gnss" if within == 2400 else "can")
        if s % (12 * HOUR) == 0:
            for path in (self.folder / "clips").glob("*.mcap"):
                path.unlink()  # somebody has fetched them
        for t_ns, source, payload in sensors.second(s):
            self.take(t_ns, source, payload)

    def take(self, t_ns: int, source: str, payload: Payload) -> None:
        self.agent.readers[source]._offer(t_ns, payload)
        self.work(t_ns)
        if isinstance(payload, CanFrames):
            self.frames += len(payload.t_ns)

    def work(self, t_ns: int) -> None:
        """Main's turn, then the writer's."""
        for arrival in self.agent.inbox.take(0.0, 0):
            self.agent._arrived(arrival)
        self.agent._failures()
        writer = self.agent.writer
        for item in self.agent.outbox.take(0.0, 0):
            writer._one(item, t_ns)
            self.records += 1
        writer._due(t_ns)

    def hang(self, name: str) -> None:
        """A driver does not come back: a new reader takes over; then it does come back, and ends."""
        old = self.agent.readers[name]
        port = self.plug(name)
        self.wait(lambda: old.state == "OPEN", f"{name} open")
        port.hangs.set()
        self.wait(port.hung.is_set, f"{name} hanging")
        self.hang_ns += int((HUNG_S + 1) * S)
        t_ns = self.agent._tick_ns
        self.agent._watch_ports(t_ns, self.agent.pipeline.counters())
        port.hangs.clear()
        old.join(PATIENCE_S)
        self.work(t_ns)
        assert self.agent.readers[name] is not old

    def wait(self, there: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE_S
        while not there():
            if time.monotonic() > end:
                raise AssertionError(f"waited in vain: {what}")
            time.sleep(0.01)

    def standing(self) -> tuple[int, int, int]:
        """Resident bytes, descriptors, threads; once every port is open again and every clip is written."""
        for name in self.wires:
            self.wait(lambda name=name: self.agent.readers[name].state == "OPEN", f"{name} open")  # type: ignore[misc]
        self.wait(lambda: self.clips._jobs.empty(), "clips written")
        gc.collect()
        return resident_bytes(), len(os.listdir("/proc/self/fd")), threading.active_count()

    def unbalanced(self) -> dict[str, int]:
        return {name: page.unaccounted for name, page in self.agent._pages().items() if page.unaccounted}

    def close(self, now_ns: int) -> None:
        self.agent.stop.set()
        for reader in (self.agent.readers["gnss"], self.agent.readers["can"]):
            reader.join(PATIENCE_S)
        self.work(now_ns)
        self.agent.writer._end(now_ns)
        self.clips.close(now_ns)
        self.clips.join(PATIENCE_S)
        self.publisher.close()
        for wire in self.wires.values():
            wire.close()


def soak(wall_s: float, simulated_s: int, folder: Path) -> list[str]:
    (folder / "data").mkdir()
    run, sensors = Soak(folder / "data", folder / "status"), Sensors(1)
    first: tuple[int, int, int] | None = None
    wrong: list[str] = []
    begin = time.monotonic()
    print("simulated h  wall s  files  RSS MiB  descriptors  threads     frames    records  segments")
    s = 0
    while s < simulated_s and time.monotonic() - begin < wall_s:
        run.second(s, sensors)
        s += 1
        if s == HOUR or s % (6 * HOUR) == 0:
            now = run.standing()
            first = first or now
            files = sum(p.suffix in (".mcap", ".part") for p in (folder / "data").iterdir())
            wall = time.monotonic() - begin
            print(
                f"{s / HOUR:11.1f}  {wall:6.0f}  {files:5d}  {now[0] / (1 << 20):7.2f}  {now[1]:11d}  {now[2]:7d}",
                end="",
            )
            print(f"  {run.frames:9d}  {run.records:9d}  {run.recorder.segments:8d}", flush=True)
            if unbalanced := run.unbalanced():
                wrong.append(f"after {s / HOUR:g} h the ledger does not balance: {unbalanced}")
    last = run.standing()
    run.close(START_NS + s * S)
    print(f"{s / HOUR:.1f} simulated hours, {run.frames} frames, {run.recorder.segments} files")
    print(f"told: {dict(run.kinds)}")
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
    steady_memory()
    grow_names()
    minutes, days = (float(x) for x in (*argv, *("120", "30")[len(argv) :]))
    shm = Path("/dev/shm")  # fsync is not what is tried here
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as name:
        wrong = soak(60 * minutes, int(days * DAY), Path(name))
    for w in wrong:
        print(f"WRONG: {w}")
    print("soak: " + ("NOT good" if wrong else "good"))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
