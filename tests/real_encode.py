"""Real motion on the wires: NMEA sentences and CAN frames as ports read them, with none of the project's encoders.

A record of an earthquake or a shaker holds displacement and acceleration as numbers. Here they become what a receiver
and an accelerometer would have sent, so that a test takes them through the whole path. Rules: GGA with nine decimals of
a minute and height to 0.01 mm (rounding below 6 um), quality 4, GST with the declared sd; one CAN frame per axis and
sample (0x101, 0x102, 0x103: one float32 in m/s2, little-endian), stamped by the kernel when they were true; a host
clock that is right; fixes arrive `LATENCY_NS` late.
"""

from __future__ import annotations

import itertools
import math
import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt

from edge_agent import assemble, config
from edge_agent.messages import MS, CanFrames, Config, Estimate, Raw, S, Tick
from edge_agent.recording import topics

F64 = npt.NDArray[np.float64]

BOOT_NS = 5000 * S  # monotonic time of the record's second 0
LATENCY_NS = 60 * MS
BLOCK_S = 0.1
REFERENCE = (37.0873, 140.1885, 312.4)
SEPARATION_M = 41.5

YAML = """
site: real
data_dir: recordings
ports:
  gnss: {kind: serial, device: /dev/ttyUSB0}
  can: {kind: can}
receivers:
  rover: {port: gnss}
accelerometers:
  deck:
    port: can
    unit: m/s2
    fields:
      x: {id: 0x101, start: 0, length: 32, float: true}
      y: {id: 0x102, start: 0, length: 32, float: true}
      z: {id: 0x103, start: 0, length: 32, float: true}
points:
  deck: {receiver: rover, accelerometer: deck}
"""
"""Ports, axes and units; everything else is the default."""


@dataclass(frozen=True)
class Record:
    """East motion with zero north and up: t_z (n,) s, z (n,) m, sigma (n,) m; t_a (k,) s, a (k,) m/s2. Seconds count
    from `midnight_ns` (UTC of a day's begin)."""

    midnight_ns: int
    t_z: F64
    z: F64
    sigma: F64
    t_a: F64
    a: F64

    @property
    def begin(self) -> float:
        """The whole second at which the first sensor speaks."""
        return float(math.floor(min(self.t_z[0], self.t_a[0])))

    def cut(self, begin: float, end: float) -> Record:
        """What both sensors say in [begin, end]."""
        k, m = (self.t_z >= begin) & (self.t_z <= end), (self.t_a >= begin) & (self.t_a <= end)
        return Record(self.midnight_ns, self.t_z[k], self.z[k], self.sigma[k], self.t_a[m], self.a[m])


@dataclass(frozen=True)
class Live:
    """The decoded live stream of a run: t (n,) s of day, d and sd (n, 3) m about the record's own zero, the modes
    (n,), (kind, text) of all events, gate verdicts in order."""

    t: F64
    d: F64
    std: F64
    mode: npt.NDArray[np.uint8]
    events: list[tuple[str, str]]
    verdicts: list[int]


# --------------------------------------------------------------------------------------------------------- real records


def tohoku(shared: Path) -> Record:
    """The 2011 Tohoku earthquake at GEONET 0041 and K-NET FKS011 (Niu & Xu 2014), the accelerometer's labels put right.

    Maximum likelihood finds `acc.dat` early by 43.0 s, so its first 43 s have no accelerations and after its last fix
    43 s of accelerations remain.
    """
    folder = shared / "B1-tohoku2011-gps0041-fks011"
    gps, acc = np.loadtxt(folder / "gps.dat"), np.loadtxt(folder / "acc.dat")
    midnight = int(datetime(2011, 3, 11, tzinfo=UTC).timestamp()) * S
    return Record(midnight, gps[:, 0], gps[:, 1], gps[:, 2], acc[:, 0] + 43.0, acc[:, 1])


def shaker(shared: Path, noise_m: float, seed: int = 0) -> tuple[Record, F64]:
    """First floor of the UNISON tower on its shaker, fixes at 10 Hz; and its displacement (k,) m at 100 Hz.

    Column 8 is displacement at 2.25/9 cm/V, column 5 the acceleration of the same motion at -2 m/s2 per V. `noise_m` =
    sd of the white noise added to the fixes.
    """
    volts = np.loadtxt(shared / "B3-unison-tower-shaker" / "wn_02.dat")
    d, a = volts[:, 7] * (0.0225 / 9), volts[:, 4] * -2.0
    t = 36_000.0 + np.arange(len(d)) / 100
    z = d[::10] + noise_m * np.random.default_rng(seed).standard_normal(len(d[::10]))
    midnight = int(datetime(2008, 2, 29, tzinfo=UTC).timestamp()) * S
    return Record(midnight, t[::10], z, np.full(len(z), 0.003), t, a), d


# ------------------------------------------------------------------------------------------------------------ the wires


def _ecef(lat: float, lon: float, h: float) -> F64:
    """Geodetic (rad, rad, m) to ECEF on WGS 84."""
    a, f = 6378137.0, 1 / 298.257223563
    e2 = f * (2 - f)
    n = a / math.sqrt(1 - e2 * math.sin(lat) ** 2)
    return np.array(
        [
            (n + h) * math.cos(lat) * math.cos(lon),
            (n + h) * math.cos(lat) * math.sin(lon),
            (n * (1 - e2) + h) * math.sin(lat),
        ]
    )


def _axes(lat: float, lon: float) -> F64:
    """Rows E, N, U in ECEF."""
    sl, cl, so, co = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


def place(enu: F64) -> tuple[float, float, float]:
    """ENU (3,) m about REFERENCE to latitude, longitude (deg) and ellipsoidal height: Newton steps on the ECEF
    coordinates, each from the local axes, so it shares nothing with the closed form under test."""
    lat, lon, h = math.radians(REFERENCE[0]), math.radians(REFERENCE[1]), REFERENCE[2]
    wanted = _ecef(lat, lon, h) + _axes(lat, lon).T @ enu
    for _ in range(4):
        e, n, u = _axes(lat, lon) @ (wanted - _ecef(lat, lon, h))
        lat, lon, h = lat + n / 6.36e6, lon + e / (6.38e6 * math.cos(lat)), h + u
    return math.degrees(lat), math.degrees(lon), h


def _sentence(body: str) -> bytes:
    check = 0
    for c in body.encode():
        check ^= c
    return f"${body}*{check:02X}\r\n".encode()


def _minutes(deg: float, width: int) -> str:
    whole = int(deg)
    return f"{whole:0{width}d}{(deg - whole) * 60:012.9f}"


def nmea(utc_ns: int, enu: F64, sigma: float) -> bytes:
    """GGA and GST of one fixed epoch, in the northern and eastern hemisphere."""
    lat, lon, h = place(enu)
    clock = datetime.fromtimestamp(utc_ns // S, UTC).strftime("%H%M%S") + f".{utc_ns % S // 10_000_000:02d}"
    gga = (
        f"GNGGA,{clock},{_minutes(lat, 2)},N,{_minutes(lon, 3)},E,4,20,0.6,{h - SEPARATION_M:.5f},M,"
        f"{SEPARATION_M:.1f},M,1.0,0001"
    )
    gst = f"GNGST,{clock},{sigma:.4f},{sigma:.4f},{sigma:.4f},0.0,{sigma:.4f},{sigma:.4f},{sigma:.4f}"
    return _sentence(gga) + _sentence(gst)


def frames(t_ns: npt.NDArray[np.int64], xyz: F64) -> CanFrames:
    """Three frames a sample, one float32 in each."""
    n = 3 * len(t_ns)
    data = np.zeros((n, 8), np.uint8)
    data[:, :4] = np.frombuffer(struct.pack(f"<{n}f", *xyz.ravel().tolist()), np.uint8).reshape(n, 4)
    ids = np.tile(np.array([0x101, 0x102, 0x103], np.uint32), len(t_ns))
    return CanFrames(np.repeat(t_ns, 3), ids, np.zeros(n, np.uint8), np.full(n, 4, np.uint8), data)


def raws(record: Record) -> list[Raw]:
    """What the ports would have read, in step order from 0."""
    begin = record.begin
    offset = record.midnight_ns + int(begin) * S - BOOT_NS  # UTC - monotonic

    def mono(t: F64) -> npt.NDArray[np.int64]:
        return BOOT_NS + np.rint((t - begin) * S).astype(np.int64)

    parts: list[tuple[int, int, str, bytes | CanFrames | Tick]] = []
    t_z, t_a = mono(record.t_z), mono(record.t_a)
    for t, z, sigma in zip(t_z.tolist(), record.z.tolist(), record.sigma.tolist(), strict=True):
        parts.append((t + LATENCY_NS, 2, "gnss", nmea(t + offset, np.array([z, 0.0, 0.0]), sigma)))
    xyz = np.zeros((len(t_a), 3))
    xyz[:, 0], xyz[:, 2] = record.a, 9.80665  # at rest, a sensor shows gravity upwards
    block = np.floor((record.t_a - begin) / BLOCK_S + 1e-6).astype(np.int64)
    cuts = [0, *(np.flatnonzero(np.diff(block)) + 1).tolist(), len(t_a)]
    for lo, hi in itertools.pairwise(cuts):
        parts.append((int(t_a[hi - 1]) + 2 * MS, 1, "can", frames(t_a[lo:hi], xyz[lo:hi])))
    end = max(p[0] for p in parts)
    parts += [(t, 0, "clock", Tick(t + offset, True, MS)) for t in range(BOOT_NS, end + S, S)]
    parts.sort(key=lambda p: p[:2])
    return [Raw(t, i, source, payload) for i, (t, _, source, payload) in enumerate(parts)]


# ------------------------------------------------------------------------------------------------------------ the agent


def settings() -> Config:
    return config.parse(YAML, Path())


def run(record: Record) -> Live:
    """The whole path from the wires to the decoded live stream, with default settings."""
    pipeline = assemble.pipeline(settings())
    blocks: list[Estimate] = []
    events: list[tuple[str, str]] = []
    verdicts: list[int] = []
    zero = np.full(3, np.nan)
    for raw in raws(record):
        for r in pipeline.step(raw):
            if r.topic == "/fusion/deck/block":
                blocks.append(topics.decode_fused_block("deck", r.data))
            elif r.topic == "/fusion/deck/update":
                verdicts.append(int(topics.decode(topics.schema_of(r.topic), r.data)["verdict"]))
            elif r.topic == "/events":
                e = topics.decode(topics.schema_of(r.topic), r.data)
                events.append((e["kind"], e["text"]))
                if e["kind"] == "REFERENCE":
                    # displacement counts from the start window's median, given about the first fix
                    zero = np.array([float(v["value"]) for v in e["values"]])
                    zero[0] += record.z[0]
    t = (np.concatenate([b.t_ns for b in blocks]) - BOOT_NS) / S + record.begin
    return Live(
        t,
        np.concatenate([b.displacement_m for b in blocks]) + zero,
        np.concatenate([b.std_displacement_m for b in blocks]),
        np.concatenate([b.mode for b in blocks]),
        events,
        verdicts,
    )
