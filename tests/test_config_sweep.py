"""No knob without effect: each key of the configuration, set to another value, changes what it is there to change.

`ROWS` is a table: key -> an override, the probe that runs a small deterministic part of the agent with and without it,
and the output of the probe that must differ. A key without a row fails `test_every_key_has_a_row`.
"""

from __future__ import annotations

import functools
import hashlib
import os
import random
import struct
import tempfile
import termios
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from fusion.fusion_play import Played, accel_items, blocks_of, fix_items, hand
from live import Live, ScriptedPort, recordings

import drivers
import drivers.can_port
from edge_agent import assemble, config
from edge_agent.fusion.station import Station
from edge_agent.messages import (
    AccelBlock,
    CanFlag,
    CanFrames,
    Config,
    Estimate,
    Event,
    Quality,
    Raw,
    Record,
    Rotate,
    S,
    SignalField,
    Tick,
)
from edge_agent.recording import topics
from edge_agent.recording.clips import Clips
from edge_agent.recording.segments import BELIEVED_NS, Recorder, RecordingError
from edge_agent.simulate.encode import nmea_epoch, sentence
from edge_agent.triggers import Triggers

Outputs = Mapping[str, object]


@dataclass(frozen=True)
class Row:
    """`assignment` as of --set; `changes`: the name of the probe's output that must differ; `base`: overrides of both
    runs, for a key that acts only where others are set."""

    probe: Callable[[Config], Outputs]
    assignment: str
    changes: str
    base: tuple[str, ...] = ()


# ----------------------------------------------------------------------------------------------------- the base config

FILES = {
    name: f"""VERSION ""
BO_ 16 Imu: 8 Vector__XXX
 SG_ X : 0|16@1- ({scale},0) [-32|32] "" Vector__XXX
 SG_ Y : 16|16@1- ({scale},0) [-32|32] "" Vector__XXX
 SG_ Z : 32|16@1- ({scale},0) [-32|32] "" Vector__XXX
""".encode()
    for name, scale in (("one.dbc", 0.001), ("two.dbc", 0.0011))
}
BASE = """
site: s
data_dir: rec
structure: {azimuth_deg: 60}
ports:
  gnss: {kind: serial, device: /dev/gnss}
  gnss2: {kind: serial, device: /dev/gnss2}
  can: {kind: can}
  can2: {kind: can, channel: can1}
receivers:
  rover: {port: gnss}
accelerometers:
  acc:
    port: can
    fields:
      x: {id: 0x20, start: 0, length: 16, scale: 1e-3}
      y: {id: 0x20, start: 16, length: 16, scale: 1e-3}
      z: {id: 0x20, start: 32, length: 16, scale: 1e-3}
  named: {port: can, dbc: one.dbc, signals: {x: X, y: Y, z: Z}}
points:
  p: {receiver: rover, accelerometer: named}
  q: {receiver: rover}
fusion:
  {start_s: 3, reacquire_s: 6, invalid_outage_s: 7, coast_s: 2, outage_s: 3, lockout_s: 4, accel_absent_s: 0.5,
   accel_lost_s: 4, accel_settle_s: 2, bank_full_s: 5, bank_step_s: 1, degraded_std_m: 0.004,
   invalid_std_horizontal_m: 0.06, invalid_std_vertical_m: 0.09}
record: {accel_block: true, free_gb: 0}
"""


def made(*sets: str) -> Config:
    return config.parse(BASE, Path(), FILES.__getitem__, sets)


# ------------------------------------------------------------------------------------------------------ the data path


def frames(t_ns: np.ndarray, port: int, rng: np.random.Generator) -> CanFrames:
    """A SYNC, then each sample as three int16 in mm/s2 and a counter, by seven identifiers with values of their own."""
    ids = (0x80, 0x10, 0x20, 0x21, 0x20, 0x18FF34A0, 0x18FF34A1, 0x18FF35A0)
    n = len(t_ns)
    data = np.zeros((n, len(ids), 8), np.uint8)  # that of the SYNC stays empty
    at = (t_ns - 1000 * S)[:, None] / S
    for j in range(1, len(ids)):
        xyz = 300 * (1 + 0.1 * j + 0.05 * port) * np.sin(2 * np.pi * 0.7 * at + np.array([0.0, 1.0, 2.0 + j]))
        xyz += np.array([50.0, -70.0, 9810.0]) + rng.normal(0, 100, (n, 3))
        count = np.rint(at * 50)
        count += count >= 200  # a sample that never came
        data[:, j] = np.concatenate([np.rint(xyz), count], axis=1).astype("<i2").view(np.uint8)
    extended = [CanFlag.EXT if j >= 4 else 0 for j in range(len(ids))]
    return CanFrames(
        np.repeat(t_ns, len(ids)) + np.tile(np.arange(len(ids)) * 200_000, n),
        np.tile(np.array(ids, np.uint32), n),
        np.tile(np.array(extended, np.uint8), n),
        np.tile(np.array([0, *[8] * (len(ids) - 1)], np.uint8), n),
        data.reshape(-1, 8),
    )


@functools.cache
def script() -> list[Raw]:
    """7 s: two receivers at 5 Hz with a spell of float, THS and VTG; two buses at 50 Hz, stamps with jitter."""
    rng = np.random.default_rng(1)
    utc = 1_780_300_800 * S - 1000 * S
    items: list[tuple[int, str, bytes | CanFrames | Tick]] = []
    for i in range(35):
        t = 1000 * S + i * S // 5
        quality = 5 if 25 <= i < 30 else 4
        for k, port in enumerate(("gnss", "gnss2")):
            llh = (46.5 + 1e-8 * rng.standard_normal(), 7.5 + 1e-8 * rng.standard_normal() + 1e-7 * k, 610.0)
            data = nmea_epoch(t + utc, llh, (0.0008, 0.0007, 0.0015), quality, date=i % 5 == 0)
            data += sentence(f"GNTHS,{123 + 0.05 * rng.standard_normal():.3f},A")
            items.append((t + 60_000_000, port, data))
    for i in range(70):
        t = 1000 * S + (np.arange(5) * S) // 50 + i * S // 10
        jitter = rng.integers(0, 2_000_000, 5)
        items += [(int(t[-1]) + 10_000_000, port, frames(t + jitter, k, rng)) for k, port in enumerate(("can", "can2"))]
    items += [(1000 * S + i * S, "clock", Tick(1000 * S + i * S + utc, True, 1_000_000)) for i in range(7)]
    return [Raw(t, n, source, data) for n, (t, source, data) in enumerate(sorted(items, key=lambda x: x[0]))]


def path(made: Config) -> Outputs:
    """Everything that the data path records, by topic."""
    pipeline = assemble.pipeline(made)
    out: dict[str, Any] = {}
    for raw in script():
        for r in pipeline.step(raw):
            out.setdefault(r.topic, hashlib.sha256()).update(struct.pack("<qq", r.log_ns, r.publish_ns) + r.data)
    return {topic: digest.digest() for topic, digest in out.items()}


# ------------------------------------------------------------------------------------------------------------- fusion


@functools.cache
def trouble() -> tuple[Any, ...]:
    """80 s of everything that the filter has a setting for; accelerations at 20 Hz, fixes at 5 Hz."""
    rng = np.random.default_rng(3)
    t = 1000 * S + (np.arange(1600) * S) // 20
    at = (t - 1000 * S) / S
    w = 2 * np.pi * 0.4
    size = np.array([0.006, 0.004, 0.003])
    xyz = -w * w * np.sin(w * at)[:, None] * size + np.array([0.03, -0.02, 9.82]) + rng.normal(0, 1e-3, (1600, 3))
    silent = ((at > 46) & (at < 47.5)) | ((at > 52) & (at < 60))
    late = np.where((at > 4.5) & (at < 7), 800_000_000, 0)
    keep = ~silent
    accelerations = accel_items(t[keep], xyz[keep], blocks_of(t[keep], S // 2), np.maximum.accumulate(t + late)[keep])

    tf = 1000 * S + (np.arange(400) * S) // 5 + 7_000_000
    af = (tf - 1000 * S) / S
    z = np.sin(w * af)[:, None] * size + rng.normal(0, 1, (400, 3)) * np.array([0.003, 0.003, 0.006])
    z[(af > 8) & (af < 8.6), 0] += 0.4  # outliers
    z[af > 12, 0] += 0.05  # a level that stays
    z[(af > 24) & (af < 30), 1] += 0.05 * np.sin(af[(af > 24) & (af < 30)])
    lost = (af > 64) & (af < 72)
    z[lost] += rng.uniform(-1, 1, (int(lost.sum()), 3))
    quality = np.where((af > 24) & (af < 30), Quality.FLOAT, Quality.FIXED)
    there = ~((af > 32) & (af < 42))  # an outage
    return (*accelerations, *fix_items(tf[there], z[there], 40_000_000, quality=quality[there].tolist()))


def fuse(made: Config) -> Outputs:
    """Point with both sensors, with a receiver only, with an accelerometer only."""
    points = [
        config.PointSettings("both", "r", "a"),
        config.PointSettings("receiver", "r"),
        config.PointSettings("vibration", None, "a"),
    ]
    played = Played(Station(points, made.fusion))
    when = []
    for item in sorted(trouble(), key=lambda i: int(i[0])):
        hand(played, item)
        when.append(len(played.innovations))
    out: dict[str, object] = {
        "when": when,  # fixes used by the time of each item
        "verdicts": [(i.point, i.t_ns, i.verdict) for i in played.innovations],
        "events": [(e.kind, e.source, e.t_ns) for e in played.events],
    }
    for point in points:
        for name in ("t_ns", "displacement_m", "std_displacement_m", "mode", "flags"):
            out[f"{point.name}.{name}"] = played.column(name, point.name).tobytes()
    return out


@functools.cache
def calm() -> tuple[Any, ...]:
    """A structure that sways, with good fixes for 30 s, then accelerations alone for 10 s."""
    rng = np.random.default_rng(4)
    t = 1000 * S + (np.arange(800) * S) // 20
    at = (t - 1000 * S) / S
    w = 2 * np.pi * 0.4
    size = np.array([0.006, 0.004, 0.003])
    xyz = -w * w * np.sin(w * at)[:, None] * size + rng.normal(0, 1e-3, (800, 3))
    tf = 1000 * S + (np.arange(150) * S) // 5 + 7_000_000
    z = np.sin(w * (tf - 1000 * S) / S)[:, None] * size + rng.normal(0, 1, (150, 3)) * np.array([0.003, 0.003, 0.006])
    return (*accel_items(t, xyz, blocks_of(t, S // 2), t), *fix_items(tf, z, 40_000_000))


def coast(made: Config) -> Outputs:
    """Mode and flags of a point that loses its fixes and nothing else."""
    played = Played(Station([config.PointSettings("both", "r", "a")], made.fusion))
    for item in sorted(calm(), key=lambda i: int(i[0])):
        hand(played, item)
    return {name: played.column(name, "both").tobytes() for name in ("mode", "flags")}


# ---------------------------------------------------------------------------------------------------------- recording

T = 1_700_000_000 * S


def record_line(i: int) -> Record:
    return Record("/rosout", T + i, T, topics.log(20, "n", random.Random(i).randbytes(500).hex(), T), False)


def order(utc_ns: int) -> Rotate:
    return Rotate(Record("/raw/checkpoint", T, T, topics.checkpoint(0, 0, T, b"", "time"), False), utc_ns, "time")


def retention(made: Config) -> Outputs:
    """Which of four older files are still there when a new one is begun."""
    with tempfile.TemporaryDirectory() as folder:
        for day in ("20231101", "20231108", "20231113", "20231114"):
            with open(f"{folder}/{made.site}_{day}T000000Z_000.mcap", "wb") as f:
                f.truncate(800_000)

        def free() -> int:
            return 5_000_000 - sum(os.stat(Path(folder, f)).st_size for f in os.listdir(folder))

        recorder = Recorder(Path(folder), made.record, made.site, {}, {}, free)
        recorder.handle(order(T), 0)
        recorder.handle(order(T), BELIEVED_NS)  # the clock has run without a step for so long
        recorder.close()
        return {"files": sorted(os.listdir(folder))}


MOVED = ("triggers.t.point=p", "triggers.t.above_m=0.01", "events.hold_s=1")
PULLED = ("triggers.t.fault=PORT_LOST",)


def events(made: Config) -> Outputs:
    """What the triggers find in a motion that swells and ebbs: points p and q, x half of y, z still."""
    triggers = Triggers(made.triggers.values(), made.events, {**made.points, "q": replace(made.points["p"], name="q")})
    found: list[Event] = []
    for i in range(40):
        t = 1000 * S + (np.arange(50) + 50 * i) * (S // 50)
        at = (t - 1000 * S) / S
        size = (
            0.03 * np.sin(np.pi * at / 40)[:, None] * np.sin(2 * np.pi * 0.25 * at)[:, None] * np.array([0.5, 1.0, 0])
        )
        for point, share in (("p", 1.0), ("q", 0.6)):
            e = Estimate(
                *(
                    point,
                    t,
                    share * size,
                    share * 10 * size,
                    size,
                    size,
                    np.full(50, 1, np.uint8),
                    np.zeros(50, np.uint8),
                ),
                *(np.array([0.0, 0.0, 9.81]), np.ones(3), np.zeros(3), np.ones(3)),
            )
            found += triggers.estimate(e)
        xyz = 100 * size + np.array([0.0, 0.0, 9.81])
        name = made.points["p"].accelerometer or ""
        found += triggers.accelerations(name, AccelBlock(name, t, xyz, np.zeros(50, np.uint8), np.arange(50)))
    assert found, "the motion of this probe is too small for the threshold"
    return {"events": [(e.kind, e.source, e.t_ns, e.values) for e in found]}


def clip(made: Config) -> Outputs:
    """A fault in the middle of a recording of 60 s: the interval that is kept of it, the file, the hook."""
    with tempfile.TemporaryDirectory() as folder:
        recorder = Recorder(Path(folder), made.record, made.site, {}, {}, lambda: 1 << 40)
        recorder.handle(order(T))
        for i in range(60):
            recorder.handle(replace(record_line(i), log_ns=T + i * S))
        recorder.close()
        (Path(folder) / "clips").mkdir()
        with open(f"{folder}/clips/old", "wb") as f:
            f.truncate(1_100_000)
        clips = Clips(recorder, made.events, made.triggers.values())
        clips.fault("PORT_LOST", 30 * S)
        for s in range(30, 200):
            clips.every_second(s * S)
        jobs = [clips._jobs.get_nowait() for _ in range(clips._jobs.qsize())]
        for job in jobs:
            assert job is not None
            clips._one(job)
        files = sorted(p.name for p in clips.folder.iterdir())
        told = [(f.kind, f.text) for f in clips.faults]
        return {"interval": [(j.begin_ns, j.end_ns) for j in jobs if j], "files": files, "told": told}


def durability(made: Config) -> Outputs:
    """When a record is in the file, and when it is on the disk."""
    synced, flushed = [], []
    now = 0
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        recorder = Recorder(Path(folder), made.record, made.site, {}, {}, lambda: 1 << 40)
        recorder.handle(order(T), now)
        patch.setattr(os, "fdatasync", lambda fd: synced.append(now))
        patch.setattr(os, "fsync", lambda fd: synced.append(now))
        for i in range(100):
            now = i * S // 10
            before = recorder.open_bytes
            recorder.handle(record_line(i), now)
            recorder.idle(now)
            if recorder.open_bytes > before:
                flushed.append(now)
        recorder.close()
    return {"flushed": flushed, "synced": synced}


def agent(made: Config) -> Outputs:
    """An agent that records the script: names and places of its files."""
    with tempfile.TemporaryDirectory() as folder:
        made = replace(made, data_dir=os.path.join(folder, made.data_dir))
        ports = {n: ScriptedPort() for n in ("gnss", "gnss2", "can", "can2", "clock")}
        with Live(made, ports) as live:
            for raw in script():
                live.play([raw])
                if raw.source == "clock":
                    live.settle()
        files = recordings(Path(made.data_dir))
        return {"folder": os.listdir(folder), "names": [f.name for f in files], "count": len(files)}


def queues(made: Config) -> Outputs:
    """How many records fit into each queue of an agent, the ring of its writer with a disk that refuses among them."""

    class Refusing(Recorder):
        path = None

        def handle(self, item: Record | Rotate, now_ns: int | None = None) -> None:
            raise RecordingError("full", "no space", (item.checkpoint if isinstance(item, Rotate) else item,))

    with tempfile.TemporaryDirectory() as folder:
        made = replace(made, data_dir=folder)
        ports = {n: ScriptedPort() for n in ("gnss", "gnss2", "can", "can2", "clock")}
        live = Live(made, ports, make_recorder=Refusing)
        line = record_line(0)
        fits = {
            name: sum(queue.put(line, 10_000) for _ in range(1000))
            for name, queue in (("inbox", live.agent.inbox), ("outbox", live.agent.outbox))
        }
        writer = live.agent.writer
        writer._one(order(T), 0)
        for i in range(600):
            writer._one(record_line(i), 0)
        return {**fits, "ring": sum(count for count, _, _ in writer.lost.values())}


# -------------------------------------------------------------------------------------------------------------- ports


def serial_line(made: Config) -> Outputs:
    """A port on one of two pseudo-terminals: which one it reads, and at which speed it runs."""
    ends = [os.openpty() for _ in range(2)]
    devices = {f"/dev/gnss{n or ''}": os.ttyname(slave) for n, (_, slave) in zip((0, 2), ends, strict=True)}
    settings = made.ports["gnss"]
    port = drivers.load(drivers.PORTS, settings.kind)(replace(settings, device=devices[settings.device]))
    try:
        port.open()
        for k, (master, _) in enumerate(ends):
            os.write(master, b"receiver %d" % k)
        data = b""
        while len(data) < 10:
            data += b"".join(piece for _, piece in port.read())
        speeds = [termios.tcgetattr(slave)[4:6] for _, slave in ends]
    finally:
        port.close()
        for pair in ends:
            for fd in pair:
                os.close(fd)
    return {"bytes": data, "speed": speeds}


class FakeClock:
    """Time that moves when it is waited for."""

    def __init__(self) -> None:
        self.now = 0
        self.sleeps: list[int] = []

    def monotonic_ns(self) -> int:
        self.now += 1000
        return self.now

    def sleep(self, seconds: float) -> None:
        self.sleeps.append(round(seconds * 1000))
        self.now += round(seconds * S)


def can_bus(made: Config) -> Outputs:
    """A CAN port on python-can as a stage: how it opens the bus, how often it drains it, and its blocks."""
    opened: list[dict[str, Any]] = []
    calls: list[float] = []
    clock = FakeClock()

    class Bus:
        def recv(self, timeout: float) -> can.Message | None:
            clock.now += 100_000
            calls.append(timeout)
            return can.Message(arbitration_id=1, data=b"x") if len(calls) % 3 else None

        def shutdown(self) -> None: ...

    def make(**options: Any) -> Bus:
        opened.append(options)
        return Bus()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drivers.can_port, "time", clock)
        patch.setattr(can, "Bus", make)
        port = drivers.load(drivers.PORTS, "can")(made.ports["can"])
        port.open()
        blocks = [t for _ in range(5) for t, _ in port.read()]
        port.close()
    return {"open": opened, "drains": clock.sleeps, "blocks": blocks}


def kind_of_port(made: Config) -> Outputs:
    return {"driver": type(drivers.load(drivers.PORTS, made.ports["can2"].kind)(made.ports["can2"]))}


# -------------------------------------------------------------------------------------------------------------- table

J1939 = (
    "accelerometers.acc.fields={x: {pgn: 0xFF34, start: 0, length: 16}, y: {pgn: 0xFF34, start: 16, length: 16}, "
    "z: {pgn: 0xFF34, start: 32, length: 16}}",
    "accelerometers.acc.source_address=0xA0",
    "accelerometers.acc.unit=mg",
)
VIRTUAL = ("ports.can.interface=virtual",)
QUICK = ("record.flush_s=0.05",)  # the writer wakes so often
SHORT = ("record.rotate_mb=0.1",)

ROWS: dict[str, Row] = {
    "site": Row(agent, "site=other", "names", QUICK),
    "data_dir": Row(agent, "data_dir=other", "folder", QUICK),
    "structure.azimuth_deg": Row(path, "structure.azimuth_deg=61", "/fusion/p/block"),
    "structure.reference_llh": Row(path, "structure.reference_llh=[46.5, 7.5, 609.9]", "/fusion/p/block"),
    "ports.NAME.kind": Row(kind_of_port, "ports.can2={kind: serial, device: /dev/x}", "driver"),
    "ports.NAME.device": Row(serial_line, "ports.gnss.device=/dev/gnss2", "bytes", ("ports.gnss2.device=/dev/gnss3",)),
    "ports.NAME.baud": Row(serial_line, "ports.gnss.baud=9600", "speed"),
    "ports.NAME.interface": Row(can_bus, "ports.can.interface=pcan", "open", VIRTUAL),
    "ports.NAME.channel": Row(can_bus, "ports.can.channel=can7", "open", VIRTUAL),
    "ports.NAME.bitrate": Row(can_bus, "ports.can.bitrate=250000", "open", VIRTUAL),
    "ports.NAME.fd": Row(can_bus, "ports.can.fd=true", "open", VIRTUAL),
    "ports.NAME.drain_ms": Row(can_bus, "ports.can.drain_ms=50", "drains", VIRTUAL),
    "ports.NAME.block_ms": Row(can_bus, "ports.can.block_ms=200", "blocks", VIRTUAL),
    "receivers.ID.port": Row(path, "receivers.rover.port=gnss2", "/gnss/rover/solution"),
    "receivers.ID.latency_ms": Row(path, "receivers.rover.latency_ms=30", "/fusion/p/update"),
    "receivers.ID.sigma_floor_m": Row(path, "receivers.rover.sigma_floor_m=[0.01, 0.01, 0.01]", "/fusion/p/update"),
    "receivers.ID.heading": Row(path, "receivers.rover.heading=true", "/fusion/p/heading"),
    "receivers.ID.min_quality": Row(path, "receivers.rover.min_quality=fixed", "/fusion/p/update"),
    "accelerometers.ID.port": Row(path, "accelerometers.named.port=can2", "/accel/named/block"),
    "accelerometers.ID.unit": Row(path, "accelerometers.acc.unit=gal", "/accel/acc/block"),
    "accelerometers.ID.dbc": Row(path, "accelerometers.named.dbc=two.dbc", "/accel/named/block"),
    "accelerometers.ID.signals": Row(path, "accelerometers.named.signals=[Y, X, Z]", "/accel/named/block"),
    "accelerometers.ID.fields": Row(
        path, "accelerometers.acc.fields.x={id: 0x20, start: 48, length: 16}", "/accel/acc/block"
    ),
    "accelerometers.ID.counter": Row(
        path, "accelerometers.acc.counter={id: 0x20, start: 48, length: 16, signed: false}", "/accel/acc/block"
    ),
    "accelerometers.ID.rate_hz": Row(path, "accelerometers.acc.rate_hz=50", "/accel/acc/block"),
    "accelerometers.ID.range_mps2": Row(path, "accelerometers.acc.range_mps2=9.9", "/accel/acc/block"),
    "accelerometers.ID.rotation": Row(
        path, "accelerometers.acc.rotation=[[0, 1, 0], [-1, 0, 0], [0, 0, 1]]", "/accel/acc/block"
    ),
    "accelerometers.ID.fields.x.id": Row(path, "accelerometers.acc.fields.z.id=0x21", "/accel/acc/block"),
    "accelerometers.ID.fields.x.start": Row(path, "accelerometers.acc.fields.x.start=1", "/accel/acc/block"),
    "accelerometers.ID.fields.x.length": Row(path, "accelerometers.acc.fields.x.length=6", "/accel/acc/block"),
    "accelerometers.ID.fields.x.byteorder": Row(
        path, "accelerometers.acc.fields.x.byteorder=big", "/accel/acc/block", ("accelerometers.acc.fields.x.start=7",)
    ),
    "accelerometers.ID.fields.x.signed": Row(path, "accelerometers.acc.fields.y.signed=false", "/accel/acc/block"),
    "accelerometers.ID.fields.x.float": Row(path, "accelerometers.acc.fields.x.float=true", "/accel/acc/block"),
    "accelerometers.ID.fields.x.scale": Row(path, "accelerometers.acc.fields.x.scale=0.002", "/accel/acc/block"),
    "accelerometers.ID.fields.x.offset": Row(path, "accelerometers.acc.fields.x.offset=0.1", "/accel/acc/block"),
    "accelerometers.ID.fields.x.extended": Row(
        path,
        "accelerometers.acc.fields={x: {id: 0x20, extended: true, start: 0, length: 16}, "
        "y: {id: 0x20, extended: true, start: 16, length: 16}, z: {id: 0x20, extended: true, start: 32, length: 16}}",
        "/accel/acc/block",
        (
            "accelerometers.acc.fields={x: {id: 0x20, start: 0, length: 16}, "
            "y: {id: 0x20, start: 16, length: 16}, z: {id: 0x20, start: 32, length: 16}}",
        ),
    ),
    "accelerometers.ID.fields.x.pgn": Row(path, "accelerometers.acc.fields.z.pgn=0xFF35", "/accel/acc/block", J1939),
    "accelerometers.ID.source_address": Row(path, "accelerometers.acc.source_address=0xA1", "/accel/acc/block", J1939),
    "accelerometers.ID.sync": Row(path, "accelerometers.acc.sync=0x80", "/accel/acc/block"),
    "points.ID.receiver": Row(path, "points.p.receiver=~", "/fusion/p/block"),
    "points.ID.accelerometer": Row(path, "points.q.accelerometer=acc", "/fusion/q/block"),
    "fusion.start_s": Row(fuse, "fusion.start_s=4", "both.t_ns"),
    "fusion.gate_alpha": Row(fuse, "fusion.gate_alpha=0.2", "verdicts"),
    "fusion.reacquire_s": Row(fuse, "fusion.reacquire_s=3", "verdicts"),
    "fusion.wait_s": Row(fuse, "fusion.wait_s=0.1", "both.displacement_m"),
    "fusion.invalid_std_horizontal_m": Row(fuse, "fusion.invalid_std_horizontal_m=0.003", "both.mode"),
    "fusion.invalid_std_vertical_m": Row(fuse, "fusion.invalid_std_vertical_m=0.004", "both.mode"),
    "fusion.invalid_outage_s": Row(coast, "fusion.invalid_outage_s=4", "mode"),
    "fusion.degraded_std_m": Row(coast, "fusion.degraded_std_m=0.2", "flags"),
    "fusion.coast_s": Row(coast, "fusion.coast_s=1", "mode"),
    "fusion.outage_s": Row(fuse, "fusion.outage_s=60", "verdicts"),
    "fusion.lockout_s": Row(fuse, "fusion.lockout_s=6", "events"),
    "fusion.accel_noise_m2ps3": Row(fuse, "fusion.accel_noise_m2ps3=1e-6", "both.displacement_m"),
    "fusion.accel_noise_decades": Row(fuse, "fusion.accel_noise_decades=0.2", "both.displacement_m"),
    "fusion.bias_walk_m2ps5": Row(fuse, "fusion.bias_walk_m2ps5=1e-7", "both.displacement_m"),
    "fusion.bias_walk_decades": Row(fuse, "fusion.bias_walk_decades=0.2", "both.displacement_m"),
    "fusion.gnss_only_q_m2ps3": Row(fuse, "fusion.gnss_only_q_m2ps3=1e-4", "receiver.displacement_m"),
    "fusion.gnss_only_qb_m2ps5": Row(fuse, "fusion.gnss_only_qb_m2ps5=1e-2", "receiver.displacement_m"),
    "fusion.bank_memory_s": Row(fuse, "fusion.bank_memory_s=10", "both.displacement_m"),
    "fusion.bank_full_s": Row(fuse, "fusion.bank_full_s=30", "both.displacement_m"),
    "fusion.bank_step_s": Row(fuse, "fusion.bank_step_s=2", "both.displacement_m"),
    "fusion.r_step": Row(fuse, "fusion.r_step=0.1", "both.displacement_m"),
    "fusion.r_least": Row(fuse, "fusion.r_least=1", "both.std_displacement_m"),
    "fusion.r_most": Row(fuse, "fusion.r_most=1", "both.std_displacement_m"),
    "fusion.float_std_m": Row(fuse, "fusion.float_std_m=0.05", "both.displacement_m"),
    "fusion.float_tau_s": Row(fuse, "fusion.float_tau_s=5", "both.displacement_m"),
    "fusion.float_r_factor": Row(fuse, "fusion.float_r_factor=4", "both.displacement_m"),
    "fusion.accel_mean_s": Row(fuse, "fusion.accel_mean_s=2", "both.displacement_m"),
    "fusion.accel_absent_s": Row(fuse, "fusion.accel_absent_s=2", "when"),
    "fusion.accel_lost_s": Row(fuse, "fusion.accel_lost_s=6", "both.displacement_m"),
    "fusion.accel_settle_s": Row(fuse, "fusion.accel_settle_s=4", "both.displacement_m"),
    "fusion.accel_only_std_m": Row(fuse, "fusion.accel_only_std_m=0.1", "vibration.displacement_m"),
    "record.rotate_s": Row(agent, "record.rotate_s=2", "count", QUICK),
    "record.rotate_mb": Row(agent, "record.rotate_mb=0.1", "count", (*QUICK, "record.view_hz=1000")),
    "record.keep_days": Row(retention, "record.keep_days=10", "files", SHORT),
    "record.keep_gb": Row(retention, "record.keep_gb=0.002", "files", SHORT),
    "record.free_gb": Row(retention, "record.free_gb=0.0025", "files", SHORT),
    "record.flush_s": Row(durability, "record.flush_s=0.5", "flushed"),
    "record.fsync_s": Row(durability, "record.fsync_s=2", "synced"),
    "record.view_hz": Row(path, "record.view_hz=5", "/accel/acc"),
    "record.inbox_mb": Row(queues, "record.inbox_mb=2", "inbox"),
    "record.outbox_mb": Row(queues, "record.outbox_mb=3", "outbox", ("record.outbox_mb=4",)),
    "record.ring_mb": Row(queues, "record.ring_mb=0.5", "ring", ("record.ring_mb=1",)),
    "triggers.ID.point": Row(events, "triggers.t.point=q", "events", MOVED),
    "triggers.ID.axis": Row(events, "triggers.t.axis=x", "events", MOVED),
    "triggers.ID.above_m": Row(events, "triggers.t.above_m=0.02", "events", MOVED),
    "triggers.ID.above_mps": Row(
        events, "triggers.t.above_mps=0.2", "events", ("triggers.t.point=p", "triggers.t.above_mps=0.1")
    ),
    "triggers.ID.above_mps2": Row(
        events, "triggers.t.above_mps2=2", "events", ("triggers.t.point=p", "triggers.t.above_mps2=1")
    ),
    "triggers.ID.fault": Row(clip, "triggers.t.fault=SILENT", "interval", ("triggers.t.fault=PORT_LOST",)),
    "events.before_s": Row(clip, "events.before_s=3", "interval", PULLED),
    "events.after_s": Row(clip, "events.after_s=3", "interval", PULLED),
    "events.max_s": Row(clip, "events.max_s=7", "interval", PULLED),
    "events.hold_s": Row(events, "events.hold_s=0.3", "events", MOVED),
    "events.release": Row(events, "events.release=0.1", "events", MOVED),
    "events.clips_gb": Row(clip, "events.clips_gb=0.001", "files", PULLED),
    "events.hook": Row(clip, "events.hook=[/bin/false]", "told", PULLED),
    "events.hook_s": Row(
        clip, "events.hook_s=0.05", "told", (*PULLED, "events.hook=[/bin/sh, -c, sleep 1000]", "events.hook_s=0.1")
    ),
    "record.accel_block": Row(path, "record.accel_block=false", "/accel/acc/block"),
}


def keys() -> set[str]:
    """Every key that a configuration may hold, by the dataclasses, with NAME, ID and x for what the site names."""
    tables = {"ports": "NAME", "receivers": "ID", "accelerometers": "ID", "points": "ID", "triggers": "ID"}
    found = {"site", "data_dir"}
    for section, cls in config._SECTIONS.items():
        found |= {f"{section}.{key}" for key in config.keys_of(cls)}
    for table, cls in config._TABLES.items():
        found |= {f"{table}.{tables[table]}.{key}" for key in config.keys_of(cls)}
    return found | {f"accelerometers.ID.fields.x.{key}" for key in config.keys_of(SignalField)}


def test_every_key_has_a_row() -> None:
    missing = keys() - set(ROWS)
    assert not missing, (
        f"no row in ROWS of {Path(__file__).name} for {sorted(missing)}. Add one: "
        '"section.key": Row(probe, "section.key=another value", "output that must then differ"). Probes: `path` (raw '
        "bytes and frames through the pipeline; outputs are topics), `fuse` (the filter alone), `agent`, `retention`, "
        "`durability`, `queues`, `serial_line`, `can_bus`. Let `script` or `trouble` hold what the key acts on. A key "
        "that changes nothing is a bug: delete it."
    )
    assert not set(ROWS) - keys(), f"rows of keys that are gone: {sorted(set(ROWS) - keys())}"


@functools.cache
def output(probe: Callable[[Config], Outputs], sets: Sequence[str]) -> Outputs:
    return probe(made(*sets))


@pytest.mark.parametrize("key", ROWS)
def test_a_key_changes_what_it_is_there_for(key: str) -> None:
    row = ROWS[key]
    assert key.rpartition(".")[2] in row.assignment
    before = output(row.probe, row.base)
    after = row.probe(made(*row.base, row.assignment))
    assert row.changes in {**before, **after}
    assert before.get(row.changes) != after.get(row.changes)


@pytest.mark.parametrize("probe", [path, fuse, retention, durability, queues, can_bus])
def test_without_a_change_a_probe_says_the_same_again(probe: Callable[[Config], Outputs]) -> None:
    """Else any row would pass."""
    sets = VIRTUAL if probe is can_bus else ()
    assert probe(made(*sets)) == output(probe, sets)
