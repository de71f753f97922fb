"""Records of every topic with values that a station could have: what tests and judges read back."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from edge_agent.messages import (
    MS,
    AccelBlock,
    AccelFlag,
    CanFlag,
    CanFrames,
    Estimate,
    FusionFlag,
    GnssFix,
    HeadingEstimate,
    Innovation,
    Mode,
    Quality,
    Raw,
    Record,
    S,
    Tick,
    Verdict,
)
from edge_agent.recording import topics

OFFSET_NS = 1_700_000_000_123_456_789
"""UTC - monotonic."""
RATE_HZ = 250
BLOCK = 25
NAN = math.nan


def fix(t_ns: int, i: int, std: tuple[float, float, float] = (0.004, 0.005, 0.012)) -> GnssFix:
    utc_ns = t_ns + OFFSET_NS
    quality = (Quality.FIXED, Quality.FLOAT, Quality.DGNSS, Quality.NONE)[i % 4]
    resolution = (1.1e-4, 1.8e-4, 1e-3)
    return GnssFix(
        *(t_ns, t_ns + 80 * MS, utc_ns, True, 47.123456789 + i * 1e-9, -8.5, 412.3456, 48.1, quality, 17),
        *(0.7, NAN, 1.1, 0.8, "0042", std, resolution, ("GGA", "GST"), 211.5, 0.017),
    )


def frames(rng: np.random.Generator, t_ns: np.ndarray, sensors: int, width: int = 8, dlc: int = 6) -> CanFrames:
    """Ambient vibration as int16 triples, one frame per sensor and instant, stamped with 10 us of jitter."""
    n = len(t_ns) * sensors
    stamps = np.repeat(t_ns, sensors) + np.tile(np.arange(sensors) * 130_000, len(t_ns))
    stamps += np.abs(rng.normal(0.0, 10_000.0, n)).astype(np.int64)
    counts = np.round(rng.normal(0.0, 11.0, (n, 3)) + np.array([30.0, -200.0, 16384.0])).astype("<i2")
    data = np.zeros((n, width), np.uint8)
    data[:, :dlc] = counts.view(np.uint8).reshape(n, 6)[:, :dlc]
    can_id = np.tile(np.arange(sensors, dtype=np.uint32) + 0x120, len(t_ns))
    flags = np.full(n, CanFlag.FD if width > 8 else 0, np.uint8)
    return CanFrames(stamps, can_id, flags, np.full(n, dlc, np.uint8), data, dropped=3 if width > 8 else 0)


def accel_block(rng: np.random.Generator, t_ns: np.ndarray, first: int, name: str = "a1") -> AccelBlock:
    n = len(t_ns)
    xyz = (np.round(rng.normal(0.0, 11.0, (n, 3))) * 6e-4).astype(np.float32).astype(np.float64)
    flags = np.full(n, AccelFlag.FITTED, np.uint8)
    return AccelBlock(name, t_ns, xyz + np.array([0.0, 0.0, 9.81]), flags, first + np.arange(n, dtype=np.int64))


def estimate(rng: np.random.Generator, t_ns: np.ndarray, point: str = "p1") -> Estimate:
    """Three modes of a bridge of 10, 2 and 0.5 mm, with the filter's noise on top; sd breathing between fixes."""
    n = len(t_ns)
    t = (t_ns[:, None] / S) + np.array([0.0, 0.3, 0.7])
    turns = 2.0 * math.pi * np.array([0.31, 1.7, 4.9])
    size = np.array([0.010, 0.002, 0.0005])
    moved = (size * np.sin(turns * t[:, :, None])).sum(axis=2) + rng.normal(0.0, 2e-5, (n, 3))
    speed = (size * turns * np.cos(turns * t[:, :, None])).sum(axis=2) + rng.normal(0.0, 1e-4, (n, 3))
    since = np.arange(1, n + 1)[:, None] / RATE_HZ
    steady = 1.0 + rng.normal(0.0, 1e-4)
    std = steady * (0.0012 + 0.0004 * since * np.array([1.0, 1.1, 2.0]))
    return Estimate(
        *(point, t_ns, moved, speed, std, steady * (0.004 + 0.01 * since * np.ones(3))),
        *(np.full(n, Mode.FUSED, np.uint8), np.full(n, FusionFlag.FLOAT, np.uint8)),
        *(rng.normal(0.0, 1e-3, 3), np.full(3, 2e-4), np.zeros(3), np.full(3, NAN)),
    )


def innovation(rng: np.random.Generator, t_ns: int, verdict: Verdict, point: str) -> Innovation:
    residual = rng.normal(0.0, 0.005, 3)
    variance = np.diag([2.5e-5, 2.6e-5, 1e-4]) + 1e-6
    ratio = float((residual**2 / np.diag(variance)).sum() / 16.27)
    return Innovation(
        point, t_ns, residual, variance, ratio, verdict, 80 * MS, np.full(3, 0.005), np.array([0.0, 0.1, -0.2])
    )


def _derived(topic: str, log_ns: int, publish_ns: int, data: bytes) -> Record:
    return Record(topic, log_ns, publish_ns, data, True)


def _runtime(topic: str, utc_ns: int, data: bytes) -> Record:
    return Record(topic, utc_ns, utc_ns, data, False)


def checkpoint(utc_ns: int, order: int = 0, state: bytes = b"EASTATE1" + bytes(range(200))) -> Record:
    data = topics.checkpoint(order, utc_ns - OFFSET_NS, utc_ns, state, "start")
    return _runtime(topics.CHECKPOINT_TOPIC, utc_ns, data)


def records(blocks: int = 30, sensors: int = 2) -> Iterator[Record]:
    """The records of `blocks` tenths of a second, checkpoint first: one accelerometer and one point per sensor, one
    receiver, views at 25 Hz; topics that are rare come once a second."""
    rng = np.random.default_rng(7)
    begin = 5_000 * S
    yield checkpoint(begin + OFFSET_NS)
    transforms = topics.station_transforms((47.0, -8.5, 412.0), (4.3e6, -6.4e5, 4.6e6), 30.0, ("a1", "r1"))
    yield _runtime("/tf_static", begin + OFFSET_NS, topics.tf_static(transforms, begin + OFFSET_NS))
    order = 0
    for block in range(blocks):
        t_ns = begin + block * 100 * MS + np.arange(BLOCK, dtype=np.int64) * (S // RATE_HZ)
        now = int(t_ns[-1]) + 5 * MS
        log, first = now + OFFSET_NS, int(t_ns[0]) + OFFSET_NS
        yield topics.raw_record(Raw(now, order, "can0", frames(rng, t_ns, sensors)), log)
        sentence = b"$GNGGA,%06d.00,4707.407407,N,00830.000000,W,4,17,0.7,364.2456,M,48.1,M,0.8,0042*5B\r\n" % block
        yield topics.raw_record(Raw(now, order + 1, "gnss", sentence), log)
        order += 2
        for k in range(1, sensors + 1):
            yield from _point(rng, t_ns, block, k, log)
        one = fix(int(t_ns[0]), block, (NAN, NAN, NAN) if block % 3 == 2 else (0.004, 0.005, 0.012))
        yield _derived("/gnss/r1/fix", log, first, topics.navsatfix(one, first, "r1"))
        yield _derived(
            "/gnss/r1/solution", log, first, topics.gnss_solution(one, first, (0.1, -0.2, 0.3), 80 * MS, "r1")
        )
        if block % 10 == 0:
            yield topics.raw_record(Raw(now, order, "clock", Tick(now + OFFSET_NS + 250, True, 1200)), log)
            order += 1
            yield from _rare(rng, t_ns, now)


def _point(rng: np.random.Generator, t_ns: np.ndarray, block: int, k: int, log: int) -> Iterator[Record]:
    first = int(t_ns[0]) + OFFSET_NS
    samples = accel_block(rng, t_ns, block * BLOCK, f"a{k}")
    fused = estimate(rng, t_ns, f"p{k}")
    yield _derived(f"/accel/a{k}/block", log, first, topics.accel_block(samples, first))
    yield _derived(f"/fusion/p{k}/block", log, first, topics.fused_block(fused, first))
    for i in range(0, BLOCK, 10):
        at = int(t_ns[i]) + OFFSET_NS
        seen = topics.accel(int(samples.count[i]), samples.xyz[i], int(samples.flags[i]), at)
        yield _derived(f"/accel/a{k}", log, at, seen)
        yield _derived(f"/fusion/p{k}/state", log, at, topics.fused_state(fused, i, at))
    update = innovation(rng, int(t_ns[0]), Verdict(block % 6), f"p{k}")
    yield _derived(f"/fusion/p{k}/update", log, first, topics.fusion_update(update, first))


def _rare(rng: np.random.Generator, t_ns: np.ndarray, now: int) -> Iterator[Record]:
    epoch = int(t_ns[0])
    log, at = now + OFFSET_NS, epoch + OFFSET_NS
    turned = topics.heading(HeadingEstimate(epoch, 271.25, 0.05, 271.4, 0.2, NAN, 1.5, 0.3, Verdict.ACCEPTED), at)
    yield _derived("/fusion/p1/heading", log, at, turned)
    yield _derived("/fusion/p1/smoothed", log, at, topics.fused_block(replace(estimate(rng, t_ns), revision=1), at))
    values = (("rate_hz", 250.0), ("worst", math.inf))
    yield _derived("/events", log, at, topics.event("START", "p1", "began, \u00b5-Zeit", values, epoch, at, at - S, at))
    yield _runtime("/faults", log, topics.event("DEVICE_LOST", "gnss", "cannot open", (), now, log))
    line = topics.log(30, "edge_agent.runtime", "port is silent", log, "runtime.py", "run", 42)
    yield _runtime("/rosout", log, line)
    queues = topics.Status(1, "queues", "inbox a third full", {"inbox_bytes": "123", "dropped": "0"}, "gateway")
    yield _runtime("/diagnostics", log, topics.diagnostics([queues, topics.Status(0, "space", "", {})], log))
