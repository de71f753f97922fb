"""From arrays to the wires: NMEA sentences, CAN frames with their DBC, and the Raw blocks that ports would have read.

Rules. One burst of sentences per fix: ZDA on whole seconds (the date), then GGA and GST. Positions carry as many
decimals as the scenario asks for, by default nine of a minute (2 um) and five of a metre, so that the text adds nothing
to the noise. A CAN sample is one frame of three int16 and a u16 counter where the rounding stays below a third of the
sensor's noise, else three frames of int32 in um/s2, each with the counter. Left out: real time (play.py).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from edge_agent.geodesy import Frame
from edge_agent.messages import F64, I64, MS, U8, U32, CanFrames, Raw, S, Tick
from edge_agent.simulate.bridge import SimRecord
from edge_agent.simulate.sensors import AccelTrack
from edge_agent.simulate.specs import START_NS, Accel, Scenario

SEPARATION_M = 47.3
GNSS_PORT, CAN_PORT, CLOCK_PORT, RECEIVER = "gnss", "can", "clock", "rover"
INT16_STEP = 0.0006  # m/s2: +-2 g in 16 bits
INT32_STEP = 1e-6  # m/s2

# --------------------------------------------------------------------------------------------------------------- NMEA


def geodetic(enu_m: F64, reference_llh: tuple[float, float, float]) -> list[tuple[float, float, float]]:
    """ENU (n, 3) about a reference to latitude, longitude (deg) and ellipsoidal height (m)."""
    frame = Frame(reference_llh)
    return [frame.geodetic((e, n, u)) for e, n, u in enu_m.tolist()]


def sentence(body: str) -> bytes:
    """`$` body `*` checksum CR LF."""
    check = 0
    for c in body.encode():
        check ^= c
    return f"${body}*{check:02X}\r\n".encode()


def _angle(degrees: float, decimals: int, width: int, hemispheres: str) -> str:
    """Degrees and decimal minutes as NMEA writes them, rounded once and carried."""
    unit = 10**decimals
    steps = round(abs(degrees) * 60 * unit)
    whole, part = divmod(steps, 60 * unit)
    minute, fraction = divmod(part, unit)
    side = hemispheres[degrees < 0]
    return f"{whole:0{width}d}{minute:02d}.{fraction:0{decimals}d},{side}"


def nmea_epoch(
    utc_ns: int,
    llh: Sequence[float],
    std_enu_m: Sequence[float],
    quality: int = 4,
    *,
    minute_decimals: int = 9,
    height_decimals: int = 5,
    talker: str = "GN",
    date: bool = False,
    sentences: Sequence[str] = ("GGA", "GST"),
) -> bytes:
    """One epoch's burst. `date` puts ZDA in front; `sentences` may hold GGA, GST and RMC."""
    when = datetime.fromtimestamp(utc_ns // S, UTC) + timedelta(microseconds=(utc_ns % S) // 1000)
    clock = when.strftime("%H%M%S") + f".{when.microsecond // 10_000:02d}"
    lat = _angle(llh[0], minute_decimals, 2, "NS")
    lon = _angle(llh[1], minute_decimals, 3, "EW")
    e, n, u = std_enu_m
    out = b""
    if date:
        out += sentence(f"{talker}ZDA,{clock},{when:%d,%m,%Y},00,00")
    for kind in sentences:
        if kind == "GGA":
            age = "1.0,0001" if quality in (4, 5) else ","
            out += sentence(
                f"{talker}GGA,{clock},{lat},{lon},{quality},18,0.7,{llh[2] - SEPARATION_M:.{height_decimals}f},M,"
                f"{SEPARATION_M:.1f},M,{age}"
            )
        elif kind == "GST":
            big, small = max(e, n), min(e, n)
            out += sentence(
                f"{talker}GST,{clock},{math.hypot(e, n):.4f},{big:.4f},{small:.4f},{0.0 if n >= e else 90.0:.1f},"
                f"{n:.4f},{e:.4f},{u:.4f}"
            )
        elif kind == "RMC":
            mode = {4: "R", 5: "F", 1: "A", 2: "D"}.get(quality, "N")
            out += sentence(f"{talker}RMC,{clock},A,{lat},{lon},0.00,,{when:%d%m%y},,,{mode}")
        else:
            raise ValueError(f"simulate: no sentence {kind}")
    return out


def nmea_bursts(record: SimRecord, *, sentences: Sequence[str] = ("GGA", "GST")) -> list[tuple[int, bytes]]:
    """(arrival_ns, bytes) of each fix in order."""
    g, f = record.scenario.gnss, record.fixes
    if g is None:
        return []
    minute, height = g.minute_decimals, g.height_decimals
    llh = geodetic(f.z_m, record.scenario.reference_llh)
    out = []
    for i, t in enumerate(f.t_ns.tolist()):
        utc = t + record.utc_offset_ns
        burst = nmea_epoch(
            utc,
            llh[i],
            f.std_m[i].tolist(),
            int(f.quality[i]),
            minute_decimals=9 if minute is None else minute,
            height_decimals=5 if height is None else height,
            date=utc % S == 0,
            sentences=sentences,
        )
        out.append((int(f.arrival_ns[i]), burst))
    return out


# ---------------------------------------------------------------------------------------------------------------- CAN


def wide(accel: Accel) -> bool:
    """Whether int16 over +-2 g would be too coarse for this sensor's noise."""
    return accel.noise * math.sqrt(accel.rate_hz / 2) < 3 * INT16_STEP / math.sqrt(12)


def _first_id(scenario: Scenario, name: str) -> int:
    return 0x098 + 0x10 * [a.name for a in scenario.accels].index(name)


def dbc_text(scenario: Scenario) -> str:
    """The DBC of every accelerometer of the scenario: message ACC_<name>, or ACC_<name>_X/_Y/_Z where it is wide."""
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: Sensor Gateway", ""]
    for accel in scenario.accels:
        can_id = _first_id(scenario, accel.name)
        if wide(accel):
            for i, axis in enumerate("XYZ"):
                lines += [
                    f"BO_ {can_id + i} ACC_{accel.name}_{axis}: 6 Sensor",
                    f' SG_ {axis} : 0|32@1- ({INT32_STEP},0) [-2147|2147] "m/s2" Gateway',
                    ' SG_ Counter : 32|16@1+ (1,0) [0|65535] "" Gateway',
                    "",
                ]
        else:
            lines += [f"BO_ {can_id} ACC_{accel.name}: 8 Sensor"]
            lines += [
                f' SG_ {axis} : {16 * i}|16@1- ({INT16_STEP},0) [-19.66|19.66] "m/s2" Gateway'
                for i, axis in enumerate("XYZ")
            ]
            lines += [' SG_ Counter : 48|16@1+ (1,0) [0|65535] "" Gateway', ""]
    return "\n".join(lines)


def _frames(scenario: Scenario, accel: Accel, track: AccelTrack) -> CanFrames:
    """All frames of one accelerometer, duplicates included, by arrival."""
    repeat = 1 + track.duplicate.astype(np.int64)
    xyz = np.repeat(track.xyz, repeat, axis=0)
    count = np.repeat(track.count, repeat).astype("<u2")
    t_ns = np.repeat(track.arrival_ns, repeat)
    second = np.concatenate([[False], np.diff(t_ns) == 0]) if len(t_ns) else np.zeros(0, bool)
    t_ns = t_ns + second * 300_000  # 0.3 ms: one frame's time on the wire at 500 kbit/s
    n, per = len(t_ns), 3 if wide(accel) else 1
    data = np.zeros((n, per, 8), np.uint8)
    if per == 3:
        raw = np.rint(np.clip(xyz / INT32_STEP, -(2.0**31), 2.0**31 - 1)).astype("<i4")
        data[:, :, :4] = raw.view(np.uint8).reshape(n, 3, 4)
        data[:, :, 4:6] = count.view(np.uint8).reshape(n, 1, 2)
    else:
        raw16 = np.rint(np.clip(xyz / INT16_STEP, -32768, 32767)).astype("<i2")
        data[:, 0, :6] = raw16.view(np.uint8).reshape(n, 6)
        data[:, 0, 6:8] = count.view(np.uint8).reshape(n, 2)
    first = _first_id(scenario, accel.name)
    return CanFrames(
        (t_ns[:, None] + np.arange(per) * 100_000).ravel(),
        np.tile(np.arange(first, first + per, dtype=np.uint32), n),
        np.zeros(n * per, np.uint8),
        np.full(n * per, 6 if per == 3 else 8, np.uint8),
        data.reshape(n * per, 8),
    )


def can_frames(record: SimRecord) -> CanFrames:
    """Every frame on the bus in the order of arrival."""
    parts = [_frames(record.scenario, a, t) for a, t in zip(record.scenario.accels, record.accels, strict=True)]
    if not parts:
        none = np.zeros(0, np.uint8)
        return CanFrames(np.zeros(0, np.int64), np.zeros(0, np.uint32), none, none, np.zeros((0, 8), np.uint8))
    t_ns: I64 = np.concatenate([p.t_ns for p in parts])
    order = np.argsort(t_ns, kind="stable")
    can_id: U32 = np.concatenate([p.can_id for p in parts])[order]
    length: U8 = np.concatenate([p.length for p in parts])[order]
    data: U8 = np.concatenate([p.data for p in parts])[order]
    return CanFrames(t_ns[order], can_id, np.zeros(len(order), np.uint8), length, data)


# ----------------------------------------------------------------------------------------------------------------- Raw


def raw_blocks(
    record: SimRecord, *, block_ms: int = 100, sync: bool = True, sentences: Sequence[str] = ("GGA", "GST")
) -> Iterator[Raw]:
    """What the ports would have read, in step order from 0: one Raw per burst of sentences, one per `block_ms` of CAN
    frames (at the end of the interval), one Tick a second of a host clock that is right and says `sync`."""
    arrivals = [record.fixes.arrival_ns, *(a.arrival_ns for a in record.accels)]
    end_ns = max(int(x[-1]) if len(x) else START_NS for x in arrivals)
    ticks = (
        (t, CLOCK_PORT, Tick(t + record.utc_offset_ns, sync, MS if sync else 0)) for t in range(START_NS, end_ns + 1, S)
    )
    serial = ((t, GNSS_PORT, data) for t, data in nmea_bursts(record, sentences=sentences))
    parts: list[Iterator[tuple[int, str, bytes | CanFrames | Tick]]] = [ticks, _can_blocks(record, block_ms), serial]
    for order, (t_ns, source, payload) in enumerate(heapq.merge(*parts, key=lambda x: x[0])):
        yield Raw(t_ns, order, source, payload)


def _can_blocks(record: SimRecord, block_ms: int) -> Iterator[tuple[int, str, CanFrames]]:
    f = can_frames(record)
    if not len(f.t_ns):
        return
    step = block_ms * MS
    slot = -(-(f.t_ns - START_NS) // step)  # read at the end of the interval that holds the frame
    cut = np.flatnonzero(np.diff(slot)) + 1
    for lo, hi in zip([0, *cut.tolist()], [*cut.tolist(), len(slot)], strict=True):
        s = slice(lo, hi)
        block = CanFrames(f.t_ns[s], f.can_id[s], f.flags[s], f.length[s], f.data[s])
        yield int(START_NS + slot[lo] * step), CAN_PORT, block


# -------------------------------------------------------------------------------------------------------------- config


@dataclass(frozen=True, slots=True)
class Wiring:
    """Where the configuration finds the sensors."""

    serial_device: str = "/dev/ttyUSB0"
    can_interface: str = "socketcan"
    can_channel: str = "can0"


def config_yaml(
    scenario: Scenario,
    *,
    site: str = "simulated",
    data_dir: str = "recordings",
    dbc: str = "accelerometers.dbc",
    wiring: Wiring = Wiring(),
    azimuth_deg: float = 90.0,
    rotate_s: int | None = None,
    latency_ms: float | None = None,
) -> str:
    """A configuration of the agent for this scenario; `dbc` = path of `dbc_text` as written there. The reference is the
    simulated one, so displacements compare with the truth as they are."""
    lat, lon, h = scenario.reference_llh
    frame = Frame(scenario.reference_llh, azimuth_deg)
    lines = [
        f"site: {site}",
        f"data_dir: {data_dir}",
        "structure:",
        f"  reference_llh: [{lat}, {lon}, {h}]",
        f"  azimuth_deg: {azimuth_deg}",
        "ports:",
    ]
    if scenario.gnss is not None:
        lines.append(f"  {GNSS_PORT}: {{kind: serial, device: {wiring.serial_device}, baud: 115200}}")
    if scenario.accels:
        bitrate = "" if wiring.can_interface == "socketcan" else ", bitrate: 500000"  # there the system sets it
        bus = f"interface: {wiring.can_interface}, channel: {wiring.can_channel}{bitrate}"
        lines.append(f"  {CAN_PORT}: {{kind: can, {bus}}}")
    if scenario.gnss is not None:
        latency = "" if latency_ms is None else f", latency_ms: {latency_ms}"
        lines += ["receivers:", f"  {RECEIVER}: {{port: {GNSS_PORT}{latency}}}"]
    if scenario.accels:
        lines.append("accelerometers:")
        for a in scenario.accels:
            names = [f"ACC_{a.name}_{x}.{x}" if wide(a) else f"ACC_{a.name}.{x}" for x in "XYZ"]
            counter = "Counter" if wide(a) else f"ACC_{a.name}.Counter"
            lines += [
                f"  {a.name}:",
                f"    port: {CAN_PORT}",
                f"    dbc: {dbc}",
                f"    signals: [{', '.join(names)}]",
                f"    counter: {counter}",
                "    unit: m/s2",
                f"    rate_hz: {a.rate_hz}",
            ]
            if azimuth_deg != 90.0:  # the simulated sensor stands in E N U
                x, y = frame.to_structure((1.0, 0.0, 0.0)), frame.to_structure((0.0, 1.0, 0.0))
                rows = ", ".join(f"[{a:.9f}, {b:.9f}, {c:.1f}]" for a, b, c in zip(x, y, (0.0, 0.0, 1.0), strict=True))
                lines.append(f"    rotation: [{rows}]")
    lines.append("points:")
    receiver = f"receiver: {RECEIVER}" if scenario.gnss is not None else ""
    for a in scenario.accels:
        both = ", ".join(x for x in (receiver, f"accelerometer: {a.name}") if x)
        lines.append(f"  {point_name(scenario, a.name)}: {{{both}}}")
    if not scenario.accels:
        lines.append(f"  {point_name(scenario)}: {{{receiver}}}")
    if rotate_s is not None:
        lines += ["record:", f"  rotate_s: {rotate_s}"]
    return "\n".join(lines) + "\n"


def point_name(scenario: Scenario, accel: str = "") -> str:
    """The fused point of an accelerometer: `deck`, or `deck-<accelerometer>` where there are several."""
    return f"deck-{accel}" if len(scenario.accels) > 1 else "deck"
