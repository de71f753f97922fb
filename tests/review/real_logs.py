"""Real recordings as the logs of others, written with none of the project's encoders: what `import` is for.

GGA with nine decimals of a minute and height to 0.01 mm, GST with the declared sd, RMC for the date, VTG where the
receiver told its speed; accelerations as `candump -l` writes a CAN FD bus: one frame 0x101 a sample, three float32 in
m/s2. Times are second of day, as the record labels them; nothing here knows which of two labels is right.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import struct
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import numpy.typing as npt
from real_encode import SEPARATION_M, place

F64 = npt.NDArray[np.float64]

YAML = """
site: {site}
data_dir: recordings
ports:
{ports}
{sensors}
points:
  deck: {{{point}}}
"""
RECEIVER = "receivers:\n  rover: {port: gnss, sigma_floor_m: [1.0e-4, 1.0e-4, 1.0e-4]}"
ACCELEROMETER = """accelerometers:
  deck:
    port: can
    unit: m/s2
    fields:
      x: {id: 0x101, start: 0, length: 32, float: true}
      y: {id: 0x101, start: 32, length: 32, float: true}
      z: {id: 0x101, start: 64, length: 32, float: true}"""


@dataclass(frozen=True)
class Logs:
    """A folder with `site.yaml`, `rover.nmea` and `can.log`, or one of both logs."""

    folder: Path
    options: tuple[str, ...] = ()
    """Of `import`."""

    def commands(self, *more: str) -> tuple[list[str], list[str], list[str]]:
        """`import`, `replay` (with `more`) and `review` as a user types them, without the program's name."""
        at = self.folder
        logs: list[str] = []
        for option, name in (("--nmea", "rover.nmea"), ("--can", "can.log")):
            if (at / name).is_file():
                logs += [option, str(at / name)]
        raw, fused = str(at / "raw.mcap"), str(at / "fused.mcap")
        return (
            ["import", "-c", str(at / "site.yaml"), *logs, *self.options, "-o", raw],
            ["replay", raw, "-o", fused, *more],
            ["review", fused, "-o", str(at / "report.html"), "--json"],
        )


def _site(folder: Path, name: str, receiver: bool, accelerometer: bool, more: str = "") -> None:
    ports, sensors, point = [], [], []
    if receiver:
        ports.append("  gnss: {kind: serial, device: /dev/ttyUSB0}")
        sensors.append(RECEIVER)
        point.append("receiver: rover")
    if accelerometer:
        ports.append("  can: {kind: can, fd: true}")
        sensors.append(ACCELEROMETER)
        point.append("accelerometer: deck")
    text = YAML.format(site=name, ports="\n".join(ports), sensors="\n".join(sensors), point=", ".join(point))
    (folder / "site.yaml").write_text(text + more)


def _sentence(body: str) -> str:
    check = 0
    for c in body.encode():
        check ^= c
    return f"${body}*{check:02X}\r\n"


def _epoch(utc: float, day: str, llh: tuple[float, float, float], sd: F64, moved: F64 | None) -> str:
    """RMC, VTG (`moved` = speed east and north), GGA and GST of one fixed epoch, in the order of a u-blox F9P."""
    ms = round(utc * 1000)
    clock = f"{ms // 3_600_000:02d}{ms // 60_000 % 60:02d}{ms // 1000 % 60:02d}.{ms % 1000:03d}"
    lat, lon, h = llh
    ns, ew = "NS"[lat < 0], "EW"[lon < 0]
    lat, lon = abs(lat), abs(lon)
    where = f"{int(lat):02d}{(lat - int(lat)) * 60:012.9f},{ns},{int(lon):03d}{(lon - int(lon)) * 60:012.9f},{ew}"
    out = _sentence(f"GNRMC,{clock},A,{where},,,{day},,,A")
    if moved is not None:
        speed, course = math.hypot(*moved), math.degrees(math.atan2(moved[0], moved[1])) % 360
        out += _sentence(f"GNVTG,{course:.4f},T,,M,{speed / 0.514444:.4f},N,{3.6 * speed:.4f},K,A")
    out += _sentence(f"GNGGA,{clock},{where},4,20,0.6,{h - SEPARATION_M:.5f},M,{SEPARATION_M:.1f},M,1.0,0001")
    out += _sentence(f"GNGST,{clock},{sd[0]:.4f},{sd[0]:.4f},{sd[1]:.4f},0.0,{sd[1]:.4f},{sd[0]:.4f},{sd[2]:.4f}")
    return out


def _nmea(
    folder: Path, day: datetime, t: F64, llh: list[tuple[float, float, float]], sd: F64, moved: F64 | None = None
) -> None:
    with (folder / "rover.nmea").open("w", newline="") as f:
        for i, (at, where) in enumerate(zip(t.tolist(), llh, strict=True)):
            f.write(_epoch(at, f"{day:%d%m%y}", where, sd[i], None if moved is None else moved[i]))


def _candump(folder: Path, day: datetime, t: F64, xyz: F64) -> None:
    midnight = int(day.timestamp())
    us = np.rint(t * 1e6).astype(np.int64)
    with (folder / "can.log").open("w") as f:
        for at, a in zip(us.tolist(), xyz.tolist(), strict=True):
            data = struct.pack("<3f", *a).hex().upper()
            f.write(f"({midnight + at // 1_000_000}.{at % 1_000_000:06d}) can0 101##0{data}\n")


def _east(z: F64) -> list[tuple[float, float, float]]:
    return [place(np.array([v, 0.0, 0.0])) for v in z.tolist()]


def tohoku(shared: Path, folder: Path) -> Logs:
    """The 2011 Tohoku earthquake with the labels of its files (Niu & Xu 2014)."""
    at = shared / "B1-tohoku2011-gps0041-fks011"
    gps, acc = np.loadtxt(at / "gps.dat"), np.loadtxt(at / "acc.dat")
    day = datetime(2011, 3, 11, tzinfo=UTC)
    _site(folder, "tohoku", True, True)
    _nmea(folder, day, gps[:, 0], _east(gps[:, 1]), np.repeat(gps[:, 2:3], 3, axis=1))
    xyz = np.zeros((len(acc), 3))
    xyz[:, 0], xyz[:, 2] = acc[:, 1], 9.80665
    _candump(folder, day, acc[:, 0], xyz)
    return Logs(folder)


def shaker(shared: Path, folder: Path, sigma_m: float = 1e-4, every: int = 100) -> tuple[Logs, F64, F64]:
    """First floor of the UNISON tower on its shaker with one displacement of `every` as a fix; second of day and
    displacement (k,) m at 100 Hz."""
    volts = np.loadtxt(shared / "B3-unison-tower-shaker" / "wn_02.dat")
    d, a = volts[:, 7] * (0.0225 / 9), volts[:, 4] * -2.0
    t = 36_000.0 + np.arange(len(d)) / 100
    day = datetime(2008, 2, 29, tzinfo=UTC)
    _site(folder, "tower", True, True, "fusion: {r_least: 1.0, r_most: 1.0}\n")  # the sd is known: nothing to learn
    _nmea(folder, day, t[::every], _east(d[::every]), np.full((len(d[::every]), 3), sigma_m))
    xyz = np.zeros((len(a), 3))
    xyz[:, 0], xyz[:, 2] = a, 9.80665
    _candump(folder, day, t, xyz)
    return Logs(folder), t, d


def bridge(shared: Path, folder: Path, samples: int | None = None) -> Logs:
    """A steel test bridge at 100 Hz: vertical accelerations, no receiver."""
    packed = next((shared / "C1-munich-test-bridge").glob("*.zip"))
    with zipfile.ZipFile(packed) as z, z.open(z.namelist()[0]) as f:
        rows = csv.reader(io.TextIOWrapper(f, "utf-8"))
        next(rows)
        g = np.array([float(row[1]) for row in rows])[:samples]
    day = datetime(2022, 4, 11, tzinfo=UTC)
    _site(folder, "testbridge", False, True)
    xyz = np.zeros((len(g), 3))
    xyz[:, 2] = 9.80665 * (1.0 + g)
    _candump(folder, day, 30_984.9 + np.arange(len(g)) / 100, xyz)
    return Logs(folder)


def car(shared: Path, folder: Path, until_s: float = math.inf) -> Logs:
    """A car with both sensors, its first `until_s`; the accelerometer's labels are ms/1000 + 70196.593, which puts both
    beginnings together. GPS time stands for UTC."""
    at = shared / "B4-f9p-rtk-and-imu-walk-drive"
    rows = [line.split() for line in (at / "gnss_1934_sf.pos").read_text().splitlines() if line[0] != "%"]
    table = np.array([[float(v) for v in row[2:]] for row in rows])
    tod = np.array([sum(float(v) * w for v, w in zip(row[1].split(":"), (3600, 60, 1), strict=True)) for row in rows])
    day = datetime(2025, 7, 8, tzinfo=UTC)
    kept = tod < tod[0] + until_s
    table, tod = table[kept], tod[kept]
    _site(folder, "car", True, True)
    llh = [(lat, lon, h) for lat, lon, h in table[:, :3].tolist()]
    _nmea(folder, day, tod, llh, np.tile([0.01, 0.01, 0.02], (len(tod), 1)), table[:, [14, 13]])
    imu = np.loadtxt(at / "imu_1934.csv", delimiter=",")
    t = imu[:, 6] / 1000 + 70196.593
    _candump(folder, day, t[t < tod[-1]], imu[t < tod[-1], :3] * 9.80665)
    return Logs(folder)


def night(shared: Path, folder: Path, first: int = 0, last: int | None = None) -> Logs:
    """13 hours of a standing antenna across midnight; the `$GPGGA,` that the file has lost is put back."""
    packed = shared / "A3-rtklib-static-13h-nmea" / "test_nmea_27_05_clean.txt.gz"
    lines = gzip.decompress(packed.read_bytes()).splitlines(keepends=True)[first:last]
    _site(folder, "night", True, False)
    (folder / "rover.nmea").write_bytes(b"".join(b"$GPGGA," + line for line in lines))
    return Logs(folder, ("--date", "2015-05-27"))
