"""A day of the bench's bridge as the agent would have recorded it: `python tests/bench/day.py FOLDER [HOURS [FROM]]`.

8 triaxial accelerometers at 250 Hz on one bus, a receiver at 10 Hz with outliers, lost fixes and float spells, through
the agent's own pipeline and recorder with default settings: rotating files with a chain, checkpoints and diagnostics
once a second. One motion without a seam: modes whose strength follows the day, the sun's slow drift, noise that never
repeats. It is made minute by minute, so memory is that of a minute; an hour takes a minute and a half of a core.

`whole_day` makes both halves side by side: two runs of the agent of one boot, stopped and started again at noon.
"""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from edge_agent import assemble, config
from edge_agent.messages import F64, I64, MS, CanFrames, Raw, Record, S, Tick
from edge_agent.recording import topics
from edge_agent.recording.segments import Recorder
from edge_agent.simulate.bridge import SimRecord
from edge_agent.simulate.encode import CAN_PORT, CLOCK_PORT, GNSS_PORT, can_frames, config_yaml, dbc_text, nmea_bursts
from edge_agent.simulate.motion import Motion, Truth, _modes, stream
from edge_agent.simulate.sensors import AccelTrack, FixTrack, in_order
from edge_agent.simulate.specs import EPOCH_UTC_NS, GRAVITY_MPS2, START_NS, Accel, Gnss, Modal, Scenario, Structure

POINTS, RATE_HZ, FIX_HZ = 8, 250, 10
WINDOW_S = 60
NODES, NODES_HZ = 1 << 20, 200
"""Nodes of the modes' motion: it comes back after 87 minutes, at another strength."""
DAY_S = 86_400.0
OUTLIERS, DROPS, FLOAT_EVERY_S, FLOAT_S = 0.002, 0.005, 3600, 15

_BRIDGE = Structure(modes=(Modal(0.5, (0.006, 0.004, 0.003)), Modal(1.7, (0.002, 0.0015, 0.001))))
_SLOW = ((DAY_S, (0.012, 0.006, 0.009)), (900.0, (0.004, 0.002, 0.002)))  # period in s, amplitude in m


class DayMotion(Motion):
    """The modes' periodic spline, times a strength that follows the day, and slow sines."""

    def __init__(self, seed: int) -> None:
        d, v, a = _modes(stream(seed, "motion"), _BRIDGE, NODES, NODES_HZ, 5.1)
        super().__init__(START_NS, NODES_HZ, *(np.concatenate([x, x[:2]]) for x in (d, v, a)))

    def at(self, t_ns: I64) -> Truth:
        once = super().at(START_NS + (t_ns - START_NS) % (NODES * self.step_ns))
        t = ((t_ns - START_NS) / S)[:, None]
        w = 2 * math.pi / DAY_S
        g, dg, ddg = 0.65 - 0.35 * np.cos(w * t), 0.35 * w * np.sin(w * t), 0.35 * w * w * np.cos(w * t)
        d, v, a = g * once.d_m, dg * once.d_m + g * once.v_mps, ddg * once.d_m + 2 * dg * once.v_mps + g * once.a_mps2
        for period, size in _SLOW:
            w, m = 2 * math.pi / period, np.array(size)
            d, v, a = d + np.sin(w * t) * m, v + w * np.cos(w * t) * m, a - w * w * np.sin(w * t) * m
        return Truth(t_ns, d, v, a)


def scenario() -> Scenario:
    accels = tuple(Accel(name=f"a{i}", rate_hz=float(RATE_HZ)) for i in range(POINTS))
    return Scenario("day", _BRIDGE, Gnss(latency_s=0.05, jitter_s=0.005), accels)


def raws(seed: int, begin: int, seconds: int) -> Iterator[Raw]:
    """What the ports would have read from second `begin` on; both are multiples of WINDOW_S."""
    made, motion, rng = scenario(), DayMotion(seed), stream(seed, f"noise {begin}")
    offset = EPOCH_UTC_NS - START_NS
    bias = stream(seed, "bias").uniform(-0.03, 0.03, (POINTS, 3))
    left: CanFrames | None = None
    order = 0
    for begin_s in range(begin, begin + seconds, WINDOW_S):
        record = _window(made, motion, rng, bias, begin_s, offset)
        end_ns = START_NS + (begin_s + WINDOW_S) * S
        frames = can_frames(record)
        if left is not None:
            frames = _joined(left, frames)
        blocks, left = _blocks(frames, end_ns)
        waiting: list[tuple[int, str, bytes | CanFrames | Tick]] = [
            (t, CLOCK_PORT, Tick(t + offset, True, MS)) for t in range(START_NS + begin_s * S, end_ns, S)
        ]
        waiting += [(t, CAN_PORT, b) for t, b in blocks]
        waiting += [(t, GNSS_PORT, data) for t, data in nmea_bursts(record)]
        waiting.sort(key=lambda x: x[0])
        for t, source, payload in waiting:
            yield Raw(t, order, source, payload)
            order += 1


def _window(
    made: Scenario, motion: Motion, rng: np.random.Generator, bias: F64, begin_s: int, offset: int
) -> SimRecord:
    n, begin = WINDOW_S * FIX_HZ, START_NS + begin_s * S
    t = begin + np.arange(n, dtype=np.int64) * (S // FIX_HZ)
    truth = motion.at(t)
    sigma = np.array([0.003, 0.003, 0.006])
    z = truth.d_m + rng.standard_normal((n, 3)) * sigma
    floating = ((t - START_NS) // S) % FLOAT_EVERY_S >= FLOAT_EVERY_S - FLOAT_S
    z[floating] += 0.1 * rng.standard_normal((int(floating.sum()), 3))
    hit = rng.uniform(size=n) < OUTLIERS
    hit &= (t - START_NS) // S % FLOAT_EVERY_S > 30  # not within a start window
    z[hit] += rng.uniform(-0.3, 0.3, (int(hit.sum()), 3))
    arrival = in_order(t + np.rint((0.05 + rng.uniform(-0.005, 0.005, n)) * S).astype(np.int64))
    keep = rng.uniform(size=n) >= DROPS
    std, quality = np.tile(sigma, (n, 1)), np.where(floating, 5, 4).astype(np.uint8)
    none = np.zeros(int(keep.sum()), np.uint8)
    fixes = FixTrack(t[keep], arrival[keep], z[keep], std[keep], quality[keep], none, np.zeros((len(none), 3)))
    tracks = []
    k = np.arange(begin_s * RATE_HZ, (begin_s + WINDOW_S) * RATE_HZ, dtype=np.int64)
    true = START_NS + k * (S // RATE_HZ)
    force = motion.at(true).a_mps2 + np.array([0.0, 0.0, GRAVITY_MPS2])
    for i, accel in enumerate(made.accels):
        xyz = force + bias[i] + rng.standard_normal((len(k), 3)) * accel.noise * math.sqrt(RATE_HZ / 2)
        late = 0.002 + i / (RATE_HZ * POINTS) + rng.uniform(-1e-4, 1e-4, len(k))
        came = in_order(true + np.rint(late * S).astype(np.int64))
        tracks.append(AccelTrack(accel.name, true, true, came, k, xyz, np.zeros(len(k), np.uint8), xyz))
    return SimRecord(made, 1, offset, motion, fixes, truth, tuple(tracks), ())


def _joined(a: CanFrames, b: CanFrames) -> CanFrames:
    pairs = ((getattr(a, n), getattr(b, n)) for n in ("t_ns", "can_id", "flags", "length", "data"))
    joined = [np.concatenate(p) for p in pairs]
    order = np.argsort(joined[0], kind="stable")
    return CanFrames(*(c[order] for c in joined))


def _part(f: CanFrames, k: slice) -> CanFrames:
    return CanFrames(f.t_ns[k], f.can_id[k], f.flags[k], f.length[k], f.data[k])


def _blocks(f: CanFrames, end_ns: int, block_ms: int = 100) -> tuple[list[tuple[int, CanFrames]], CanFrames]:
    """Blocks that are read before `end_ns`, and the frames that are read later."""
    step = block_ms * MS
    slot = -(-(f.t_ns - START_NS) // step)
    whole = int(np.searchsorted(slot, (end_ns - START_NS) // step))
    cut = [0, *(np.flatnonzero(np.diff(slot[:whole])) + 1).tolist(), whole]
    found = [(START_NS + int(slot[lo]) * step, _part(f, slice(lo, hi))) for lo, hi in pairwise(cut) if hi > lo]
    return found, _part(f, slice(whole, None))


def whole_day(folder: Path, hours: float = 24.0) -> Path:
    """Record so many hours by two processes; return the folder of the recordings."""
    half = 0.5 * hours
    places = folder / "first", folder / "second"
    parts = ((places[0], half, 0.0), (places[1], half, half))
    command = [sys.executable, str(Path(__file__).resolve())]
    made = [subprocess.Popen([*command, str(place), str(long), str(begin)]) for place, long, begin in parts]
    codes = [p.wait() for p in made]
    if any(codes):
        raise RuntimeError("the day could not be recorded")
    recordings = places[0] / "recordings"
    for path in sorted((places[1] / "recordings").glob("*.mcap")):
        path.rename(recordings / path.name)
    return recordings


def record(folder: Path, seconds: int, begin: int = 0, seed: int = 1) -> Path:
    """Record multiples of WINDOW_S, from second `begin` on, into `folder` as the agent does; return the folder of the
    recordings."""
    folder.mkdir(parents=True, exist_ok=True)
    made = scenario()
    (folder / "accelerometers.dbc").write_text(dbc_text(made))
    (folder / "config.yaml").write_text(config_yaml(made, site="bench-day"))
    settings = config.load(folder / "config.yaml")
    path = assemble.pipeline(settings)
    attachments = {"config.yaml": settings.text.encode(), **dict(settings.files)}
    place = folder / "recordings"
    # fsync only waits for the disk: not one byte of the files depends on it
    recorder = Recorder(
        place,
        replace(settings.record, fsync_s=1e9),
        settings.site,
        {"run": f"bench-{begin}", "boot": "simulated"},
        attachments,
        lambda: 1 << 50,
    )
    period = -1
    status = [
        topics.Status(0, f"port/{name}", "OK", {f"counter_{i}": str(10**6 + i) for i in range(8)})
        for name in (CAN_PORT, GNSS_PORT, CLOCK_PORT)
    ]
    for raw in raws(seed, begin, seconds):
        now = path.to_utc(raw.t_ns) // (settings.record.rotate_s * S)
        reason = "" if period >= 0 else "start"
        if isinstance(raw.payload, Tick) and not reason:
            recorder.idle(raw.t_ns)
            utc_ns = path.segment_utc_ns
            data = topics.diagnostics(status, utc_ns)
            recorder.handle(Record("/diagnostics", utc_ns, utc_ns, data, False), raw.t_ns)
        if not reason and now > period:
            reason = "time"
        if not reason and recorder.open_bytes >= settings.record.rotate_mb * 1e6:
            reason = "size"
        if reason and not (reason == "start" and isinstance(raw.payload, Tick)):
            rotate = path.rotate(reason, raw.t_ns)
            recorder.handle(rotate, raw.t_ns)
            period = rotate.utc_ns // (settings.record.rotate_s * S)
        for r in path.step(raw):
            if recorder.path is not None:
                recorder.handle(r, raw.t_ns)
    utc_ns = path.segment_utc_ns
    recorder.handle(Record("/rosout", utc_ns, utc_ns, topics.log(20, "edge_agent", "stopped", utc_ns), False))
    recorder.close()
    return place


if __name__ == "__main__":
    hours, first = (float(sys.argv[i]) if len(sys.argv) > i else value for i, value in ((2, 24.0), (3, 0.0)))
    record(Path(sys.argv[1]), round(hours * 3600), round(first * 3600))
