"""Accelerometers of every kind from the configuration's text to the records."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_agent import assemble
from edge_agent.config import ConfigError, parse
from edge_agent.messages import MS, AccelFlag, CanFlag, CanFrames, Config, Raw, Record, S, Tick
from edge_agent.recording import topics

T0 = 1000 * S
SITE = """site: s
data_dir: d
ports: {can: {kind: can}}
points: {p: {accelerometer: imu}}
record: {accel_block: true}
accelerometers:
  imu:
    port: can
"""
J1939 = """    source_address: 8
    fields: {x: {pgn: 0xFF34, start: 0, length: 16}, y: {pgn: 0xFF34, start: 16, length: 16},
             z: {pgn: 0xFF34, start: 32, length: 16}}
"""
CANOPEN = """    sync: 0x80
    fields: {x: {id: 0x188, start: 0, length: 16}, y: {id: 0x288, start: 0, length: 16},
             z: {id: 0x388, start: 0, length: 16}}
"""


def frames(rows: list[tuple[int, int, int, bytes]]) -> CanFrames:
    """(t_ns, identifier, flags, data) as a block."""
    return CanFrames(
        np.array([r[0] for r in rows], np.int64),
        np.array([r[1] for r in rows], np.uint32),
        np.array([r[2] for r in rows], np.uint8),
        np.array([len(r[3]) for r in rows], np.uint8),
        np.frombuffer(b"".join(r[3].ljust(8, b"\0") for r in rows), np.uint8).reshape(-1, 8),
    )


def raws(rows: list[tuple[int, int, int, bytes]], seconds: int) -> list[Raw]:
    """Blocks of 100 ms and a tick a second."""
    out: list[Raw] = []
    for k in range(10 * seconds):
        begin = T0 + k * 100 * MS
        if k % 10 == 0:
            out.append(Raw(begin, 0, "clock", Tick(begin + 10**18, True, 0)))
        part = [r for r in rows if begin <= r[0] < begin + 100 * MS]
        if part:
            out.append(Raw(begin + 100 * MS, 0, "can", frames(part)))
    return [Raw(r.t_ns, i, r.source, r.payload) for i, r in enumerate(out)]


def config(accelerometer: str) -> Config:
    return parse(SITE + accelerometer, Path(), lambda name: b"")


def derived(records: list[Record]) -> list[tuple[str, int, bytes]]:
    return [(r.topic, r.publish_ns, r.data) for r in records if r.derived]


def events(records: list[Record]) -> list[dict[str, Any]]:
    return [topics.decode(topics.schema_of(r.topic), r.data) for r in records if r.topic == "/events"]


def both(settings: Config, given: list[Raw], at: int) -> list[Record]:
    """Through one pipeline, and through two of which the second is loaded: the same."""
    one, two = assemble.pipeline(settings), assemble.pipeline(settings)
    records = [r for raw in given for r in one.step(raw)]
    first = [r for raw in given[:at] for r in two.step(raw)]
    three = assemble.pipeline(settings)
    three.load(two.save())
    second = [r for raw in given[at:] for r in three.step(raw)]
    assert derived(records) == derived(first + second)
    assert one.save() == three.save()
    return records


@pytest.mark.parametrize("at", [55, 75, 95])
def test_a_sensor_whose_cable_is_cut_is_told_from_the_ticks(at: int) -> None:
    """GIVEN a J1939 sensor at 100 Hz and another device that goes on. WHEN its cable is cut for 4 s. THEN its PGN, the
    time and the period are told at the first tick beyond 2 s, and its return; a checkpoint between changes nothing."""
    rng = np.random.default_rng(1)
    rows = []
    for k in range(1200):
        t = T0 + k * 10 * MS
        if not 500 <= k < 900:
            body = struct.pack("<3h", *rng.integers(-9, 9, 3).tolist())
            rows.append((t, 0x18FF3408, int(CanFlag.EXT), body + b"\0\0"))
        rows.append((t + MS, 0x18FF3409, int(CanFlag.EXT), bytes(8)))  # its neighbour
    found = events(both(config(J1939), raws(rows, 12), at))
    silent = [e for e in found if e["kind"].startswith("ACCEL_SILENT")]
    assert [e["kind"] for e in silent] == ["ACCEL_SILENT", "ACCEL_SILENT_END"]
    assert silent[0]["source"] == "imu"
    assert silent[0]["text"] == "no frame PGN 0xFF34 from 0x08 (x, y, z) for 2.0 s; it came every 10 ms"
    assert not [e for e in found if e["kind"] == "REJECT"]


def test_sync_gives_the_samples_their_times() -> None:
    rows = []
    for k in range(300):
        t = T0 + k * 10 * MS
        rows.append((t, 0x80, 0, b""))
        rows += [(t + (n + 1) * MS + k % 5, 0x188 + 0x100 * n, 0, struct.pack("<h", n + k)) for n in range(3)]
    records = both(config(CANOPEN), raws(rows, 3), 17)
    blocks = [topics.decode_accel_block("imu", r.data) for r in records if r.topic == "/accel/imu/block"]
    assert len(blocks) == 30
    times = np.concatenate([b.t_ns for b in blocks])
    assert np.array_equal(np.diff(times), np.full(299, 10 * MS))


def test_flags_reach_the_records() -> None:
    rng = np.random.default_rng(2)
    rows = []
    for k in range(3000):
        x, y, z = np.rint(rng.standard_normal(3) * 5).astype(int).tolist()
        if k == 2000:
            x = 2000
        if 2200 <= k < 2600:
            y = 3
        rows.append((T0 + k * 10 * MS, 0x18FF3408, int(CanFlag.EXT), struct.pack("<3h", x, y, z) + b"\0\0"))
    records = both(config(J1939), raws(rows, 30), 221)
    blocks = [topics.decode_accel_block("imu", r.data) for r in records if r.topic == "/accel/imu/block"]
    flags = np.concatenate([b.flags for b in blocks])
    assert np.flatnonzero(flags & AccelFlag.SPIKE).tolist() == [2000]
    stuck = np.flatnonzero(flags & AccelFlag.STUCK)
    assert 2200 + 30 < stuck[0] <= 2248
    assert 2600 < stuck[-1] < 2800
    kinds = [e["kind"] for e in events(records)]
    for kind in ("ACCEL_SPIKE", "ACCEL_STUCK", "ACCEL_STUCK_END", "ACCEL_GAP"):
        assert kinds.count(kind) == 1, kind


@pytest.mark.parametrize(
    ("text", "mistake"),
    [
        (J1939.replace("x: {pgn: 0xFF34,", "x: {pgn: 0xFF34, id: 5,"), "fields.x.id: give either id or pgn"),
        (J1939.replace("0xFF34", "0xEF34"), "fields.x: x: PGN 0xEF34 has a format below 240"),
        (J1939.replace("0xFF34", "0x50000"), "fields.x.pgn: must be from 0 to 262143"),
        (J1939.replace("address: 8", "address: 254"), "source_address: must be from 0 to 253, not 254"),
        (CANOPEN + "    source_address: 8\n", "source_address: source_address is for J1939, whose identifiers have 29"),
        (CANOPEN.replace("0x80", "0x188"), "sync: sync 0x188 is the identifier of a message that carries an axis"),
        (CANOPEN + "    counter: {id: 0x188, start: 16, length: 8}\n", "counter: give either counter or sync"),
        (J1939 + "  b:\n    port: can\n" + J1939, "accelerometers.b: reads the same signals of CAN id PGN 0xFF34 from"),
        (
            J1939 + "  b:\n    port: can\n" + J1939.replace("source_address: 8", "unit: g"),
            "accelerometers.b: reads the",
        ),
    ],
)
def test_mistakes(text: str, mistake: str) -> None:
    with pytest.raises(ConfigError) as e:
        config(text)
    assert len(e.value.mistakes) == (3 if "0xE" in text or "0x5" in text else 1)  # each axis says it
    assert mistake in e.value.mistakes[0]


def test_two_sensors_of_one_pgn_are_no_mistake() -> None:
    both = config(J1939 + "  b:\n    port: can\n" + J1939.replace("source_address: 8", "source_address: 9"))
    assert len(both.accelerometers) == 2
