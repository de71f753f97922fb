"""Records to bytes and back: one CDR encoder for every value that goes into a file, and decoders.

`decode_raw` gives back a `Raw` bit for bit, or replay would not be one; `decode` reads any message by its text. A value
that does not fit its field and damaged bytes raise ValueError. Left out: which topic is written when (pipeline), the
texts (schemas), files (writer, segments).
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.messages import (
    F64,
    I64,
    U8,
    AccelBlock,
    CanFrames,
    Estimate,
    GnssFix,
    HeadingEstimate,
    Innovation,
    Quality,
    Raw,
    Record,
    S,
    Tick,
)
from edge_agent.recording import cdr
from edge_agent.recording.cdr import decode
from edge_agent.recording.schemas import (
    ACCEL,
    ACCEL_BLOCK,
    CAN_FRAMES,
    CHECKPOINT,
    CHECKPOINT_TOPIC,
    CLOCK_TOPIC,
    DIAGNOSTICS,
    EVENT,
    FUSED_BLOCK,
    FUSED_STATE,
    FUSION_UPDATE,
    GNSS_SOLUTION,
    HEADING,
    LOG,
    NAV_SAT_FIX,
    RAW_BYTES,
    RAW_PREFIX,
    SCHEMAS,
    TF,
    TICK,
    schema_of,
)

__all__ = [
    "ACCEL",
    "ACCEL_BLOCK",
    "CAN_FRAMES",
    "CHECKPOINT",
    "CHECKPOINT_TOPIC",
    "CLOCK_TOPIC",
    "DIAGNOSTICS",
    "EVENT",
    "FUSED_BLOCK",
    "FUSED_STATE",
    "FUSION_UPDATE",
    "GNSS_SOLUTION",
    "HEADING",
    "LOG",
    "NAV_SAT_FIX",
    "RAW_BYTES",
    "RAW_PREFIX",
    "SCHEMAS",
    "TF",
    "TICK",
    "decode",
    "schema_of",
]

# ------------------------------------------------------------------------------------------------------------ encoding

DISPLACEMENT_GRID = 2.0**24
"""Steps per metre of a FusedBlock, a power of two so that mantissas end in zeros: their last bits are noise that zstd
cannot shrink. 0.06 um is below a thousandth of any sd that the filter reaches (0.1 mm)."""
VELOCITY_GRID = 2.0**22
"""Steps per m/s: 0.24 um/s."""
_F32_MAX = 3.4028234663852886e38

_RAW_BYTES = struct.Struct("<QQ")
_CAN_FRAMES = struct.Struct("<QQqIIB3x")
_TICK = struct.Struct("<QQqq?")
_CHECKPOINT = struct.Struct("<QQq")
_SOLUTION = struct.Struct("<qqqqddddddd3f3ffffffffH?B")
_ACCEL = struct.Struct("<q3fB")
_ACCEL_BLOCK = struct.Struct("<q?3x")
_FUSED_STATE = struct.Struct("<q3f3f3f3f3f3fBB")
_FUSED_BLOCK = struct.Struct("<q3f3f3f3fB3x")
_UPDATE = struct.Struct("<qq3f3f3f3f9ffB")
_HEADING = struct.Struct("<qdd5fB")
_EVENT = struct.Struct("<q")
_I8 = struct.Struct("<b")
_U16 = struct.Struct("<H")
_NAV_BODY = struct.Struct("<ddd9dB")
_TRANSFORM = struct.Struct("<7d")


def _aligned(part: bytes, n: int) -> bytes:
    """`part` starts at a multiple of 8 after byte 4; pad it so that the next field of n bytes is aligned."""
    return part + cdr.PAD[-len(part) % n]


@lru_cache(maxsize=256)
def _frame(frame_id: str) -> bytes:
    """Frame's name, which stands at offset 8 after byte 4, padded so that an 8-byte field follows."""
    text = frame_id.replace("\0", "").encode("utf-8", "replace") + b"\0"
    return _aligned(cdr.U32.pack(len(text)) + text, 8)


def _stamp(utc_ns: int) -> bytes:
    """builtin_interfaces/Time. Its 32-bit seconds end in 2038; a clock beyond that keeps the last stamp (the message's
    log and publish times go on), for a wrong wall clock must not stop the recording."""
    sec, nanosec = divmod(utc_ns, S)
    if not -(1 << 31) <= sec < 1 << 31:
        sec, nanosec = (0x7FFFFFFF, S - 1) if sec > 0 else (-0x80000000, 0)
    return cdr.STAMP.pack(sec, nanosec)


def _f32(values: Iterable[float]) -> list[float]:
    """Values as a float32 field takes them: beyond its range they are infinite, as in numpy."""
    return [v if -_F32_MAX <= v <= _F32_MAX or v != v else math.copysign(math.inf, v) for v in values]


def _head(utc_ns: int, frame_id: str) -> bytes:
    return cdr.BEGIN + _stamp(utc_ns) + _frame(frame_id)


def raw_bytes(raw: Raw, utc_ns: int) -> bytes:
    """RawBytes of a Raw of bytes, read at `utc_ns`."""
    data = raw.payload
    if not isinstance(data, bytes):
        raise TypeError(f"raw_bytes: {type(data).__name__} is not bytes")
    return b"".join(
        (_head(utc_ns, raw.source), cdr.pack(_RAW_BYTES, raw.order, raw.t_ns), cdr.U32.pack(len(data)), data)
    )


def can_frames(raw: Raw) -> bytes:
    """CanFrames of a Raw of frames.

    Times become differences in the largest unit of 1 or 1000 ns that keeps them exact, in the fewest bytes, one plane
    per byte, and so do the data: zstd then sees the quiet bytes apart from the noisy ones.
    """
    frames = raw.payload
    if not isinstance(frames, CanFrames):
        raise TypeError(f"can_frames: {type(frames).__name__} is not CanFrames")
    n, width = frames.data.shape
    t = np.asarray(frames.t_ns, dtype="<i8")
    if not len(t) == len(frames.can_id) == len(frames.flags) == len(frames.length) == n:
        raise ValueError("can_frames: columns of different lengths")
    delta = np.diff(t, prepend=t[:1])
    unit = 1
    if n > 1 and not (delta % 1000).any():
        unit, delta = 1000, delta // 1000
    low, high = (int(delta.min()), int(delta.max())) if n else (0, 0)
    size = next(k for k in (1, 2, 4, 8) if -(1 << (8 * k - 1)) <= low and high < 1 << (8 * k - 1))
    used = np.flatnonzero(frames.data.any(axis=0))
    planes = int(used[-1]) + 1 if used.size else 0
    fixed = (raw.order, raw.t_ns, int(t[0]) if n else 0, unit, frames.dropped, width)
    out = cdr.Out(cdr.BEGIN, cdr.pack(_CAN_FRAMES, *fixed))
    out.column(frames.can_id, "<u4")
    out.column(frames.flags, "u1")
    out.column(frames.length, "u1")
    out.column(delta.astype(f"<i{size}").view(np.uint8).reshape(n, size).T, "u1")
    out.column(frames.data[:, :planes].T, "u1")
    return out.done()


def tick(raw: Raw, utc_ns: int) -> bytes:
    """Tick of a Raw of the clock port; `utc_ns` by the pipeline's map, which smooths the wall clock."""
    value = raw.payload
    if not isinstance(value, Tick):
        raise TypeError(f"tick: {type(value).__name__} is not a Tick")
    fixed = (raw.order, raw.t_ns, value.utc_ns, value.error_ns, value.sync)
    return _head(utc_ns, "") + cdr.pack(_TICK, *fixed)


def raw_record(raw: Raw, utc_ns: int) -> Record:
    """The Record of any Raw, on its topic and with its schema; both times are those of the read."""
    topic = RAW_PREFIX + raw.source
    match raw.payload:
        case CanFrames():
            return Record(topic, utc_ns, utc_ns, can_frames(raw), False, CAN_FRAMES)
        case Tick():
            return Record(topic, utc_ns, utc_ns, tick(raw, utc_ns), False, TICK)
        case _:
            return Record(topic, utc_ns, utc_ns, raw_bytes(raw, utc_ns), False, RAW_BYTES)


def checkpoint(order: int, mono_ns: int, utc_ns: int, state: bytes, reason: str) -> bytes:
    """Checkpoint: `order` of the next Raw, `utc_ns` = UTC at `mono_ns` by the map that holds for the segment."""
    out = cdr.Out(_head(utc_ns, ""), cdr.pack(_CHECKPOINT, order, mono_ns, utc_ns))
    out.text(reason)
    out.put(4, cdr.U32, len(state))
    out.data += state
    return out.done()


def navsatfix(fix: GnssFix, utc_ns: int, frame_id: str) -> bytes:
    """sensor_msgs/NavSatFix: ellipsoidal height, covariance from GST where the receiver sends it."""
    match fix.quality:
        case Quality.NONE:
            status = -1
        case Quality.DGNSS:
            status = 1
        case Quality.FIXED | Quality.FLOAT:
            status = 2
        case _:
            status = 0
    east, north, up = fix.std_enu_m
    known = math.isfinite(east) and math.isfinite(north) and math.isfinite(up)
    diagonal = (east * east, 0.0, 0.0, 0.0, north * north, 0.0, 0.0, 0.0, up * up) if known else (0.0,) * 9
    out = cdr.Out(cdr.BEGIN, _stamp(utc_ns))
    out.text(frame_id)
    out.put(1, _I8, status)
    out.put(2, _U16, 0)  # service: the sentences do not say which constellations were used
    out.put(8, _NAV_BODY, fix.lat_deg, fix.lon_deg, fix.h_m, *diagonal, 2 if known else 0)
    return out.done()


def gnss_solution(
    fix: GnssFix, utc_ns: int, enu_m: Sequence[float], latency_ns: int, frame_id: str, baseline_m: float = math.nan
) -> bytes:
    """GnssSolution; `enu_m` (3,) about the reference, NaN before there is one."""
    fixed = (
        *(fix.t_ns, fix.arrival_ns, latency_ns, fix.utc_ns),
        *(fix.lat_deg, fix.lon_deg, fix.h_m, fix.separation_m, *enu_m),
        *_f32((*fix.std_enu_m, *fix.resolution_enu_m, fix.hdop, fix.vdop, fix.pdop, fix.age_s)),
        *_f32((baseline_m, fix.course_deg, fix.speed_mps)),
        *(fix.satellites, fix.date_known, fix.quality),
    )
    out = cdr.Out(_head(utc_ns, frame_id), cdr.pack(_SOLUTION, *fixed))
    out.text(fix.station)
    out.text(" ".join(fix.sentences))
    return out.done()


def accel(seq: int, xyz_mps2: Sequence[float] | F64, flags: int, utc_ns: int, frame_id: str = "structure") -> bytes:
    """Accel: one sample for plots."""
    x, y, z = xyz_mps2
    return _head(utc_ns, frame_id) + cdr.pack(_ACCEL, seq, x, y, z, flags)


def accel_block(block: AccelBlock, utc_ns: int, frame_id: str = "structure") -> bytes:
    """AccelBlock; `utc_ns` is UTC of the first sample. ValueError for an empty block."""
    _filled(len(block.t_ns))
    first = int(block.t_ns[0])
    out = cdr.Out(_head(utc_ns, frame_id), cdr.pack(_ACCEL_BLOCK, first, block.drain_stamped))
    out.columns(np.ascontiguousarray(block.xyz.T, "<f4"))
    out.column(block.flags, "u1")
    out.column(block.t_ns - first, "<i8")
    out.column(block.count, "<i8")
    return out.done()


def fused_state(estimate: Estimate, i: int, utc_ns: int, frame_id: str = "structure") -> bytes:
    """FusedState: sample i of a block, for plots; `utc_ns` is that sample's."""
    fixed = (
        int(estimate.t_ns[i]),
        *estimate.displacement_m[i].tolist(),
        *estimate.velocity_mps[i].tolist(),
        *estimate.std_displacement_m[i].tolist(),
        *estimate.std_velocity_mps[i].tolist(),
        *estimate.bias_mps2.tolist(),
        *estimate.offset_m.tolist(),
        int(estimate.mode[i]),
        int(estimate.flags[i]),
    )
    return _head(utc_ns, frame_id) + cdr.pack(_FUSED_STATE, *fixed)


def fused_block(estimate: Estimate, utc_ns: int, frame_id: str = "structure") -> bytes:
    """FusedBlock; `utc_ns` is UTC of the first sample. ValueError for an empty block."""
    _filled(len(estimate.t_ns))
    first = int(estimate.t_ns[0])
    fixed = (
        first,
        *estimate.bias_mps2.tolist(),
        *estimate.std_bias_mps2.tolist(),
        *estimate.offset_m.tolist(),
        *estimate.std_offset_m.tolist(),
        estimate.revision,
    )
    out = cdr.Out(_head(utc_ns, frame_id), cdr.pack(_FUSED_BLOCK, *fixed))
    columns = np.empty((12, len(estimate.t_ns)), "<f4")
    columns[0:3] = (np.rint(estimate.displacement_m * DISPLACEMENT_GRID) * (1.0 / DISPLACEMENT_GRID)).T
    columns[3:6] = (np.rint(estimate.velocity_mps * VELOCITY_GRID) * (1.0 / VELOCITY_GRID)).T
    columns[6:9] = estimate.std_displacement_m.T
    columns[9:12] = estimate.std_velocity_mps.T
    bits = columns[6:12].view("<u4")  # 10 bits of mantissa, 0.05 %: nobody knows a standard deviation better
    bits += 0x1000
    bits &= 0xFFFFE000
    out.columns(columns)
    out.column(estimate.mode, "u1")
    out.column(estimate.flags, "u1")
    out.column(estimate.t_ns - first, "<i8")
    return out.done()


def _filled(n: int) -> None:
    if n == 0:
        raise ValueError("a block without samples has no time")


def fusion_update(innovation: Innovation, utc_ns: int, frame_id: str = "structure") -> bytes:
    """FusionUpdate; `utc_ns` is when the fix was true."""
    variance = innovation.variance_m2.reshape(9).tolist()
    std = [math.sqrt(v) if v > 0.0 else 0.0 for v in (variance[0], variance[4], variance[8])]
    fixed = (
        *(innovation.t_ns, innovation.latency_ns),
        *_f32((*innovation.residual_m.tolist(), *std, *innovation.std_m.tolist(), *innovation.offset_m.tolist())),
        *_f32((*variance, innovation.ratio)),
        innovation.verdict,
    )
    return _head(utc_ns, frame_id) + cdr.pack(_UPDATE, *fixed)


def heading(h: HeadingEstimate, utc_ns: int, frame_id: str = "map") -> bytes:
    """Heading; `utc_ns` is when it was true."""
    floats = _f32((h.std_deg, h.std_measured_deg, h.tilt_deg, h.baseline_m, h.ratio))
    fixed = (h.t_ns, h.heading_deg, h.measured_deg, *floats, h.verdict)
    return _head(utc_ns, frame_id) + cdr.pack(_HEADING, *fixed)


def event(
    kind: str,
    source: str,
    text: str,
    values: Sequence[tuple[str, float]],
    t_ns: int,
    utc_ns: int,
    begin_utc_ns: int | None = None,
    end_utc_ns: int | None = None,
) -> bytes:
    """Event; `t_ns` monotonic; without begin and end it is a moment."""
    begin = utc_ns if begin_utc_ns is None else begin_utc_ns
    end = utc_ns if end_utc_ns is None else end_utc_ns
    out = cdr.Out(_head(utc_ns, ""), cdr.pack(_EVENT, t_ns), _stamp(begin), _stamp(end))
    for part in (kind, source, text):
        out.text(part)
    out.put(4, cdr.U32, len(values))
    for name, value in values:
        out.text(name)
        out.put(8, cdr.F64, value)
    return out.done()


def log(level: int, name: str, msg: str, utc_ns: int, file: str = "", function: str = "", line: int = 0) -> bytes:
    """rcl_interfaces/Log; level as Python's logging: 10 debug, 20 info, 30 warning, 40 error, 50 critical."""
    out = cdr.Out(cdr.BEGIN, _stamp(utc_ns), cdr.pack(cdr.U8, level))
    for part in (name, msg, file, function):
        out.text(part)
    out.put(4, cdr.U32, line)
    return out.done()


class Status(NamedTuple):
    """One entry of `/diagnostics`. level 0 ok, 1 warning, 2 error, 3 stale."""

    level: int
    name: str
    message: str
    values: Mapping[str, str]
    hardware_id: str = ""


def diagnostics(statuses: Sequence[Status], utc_ns: int) -> bytes:
    """diagnostic_msgs/DiagnosticArray."""
    out = cdr.Out(cdr.BEGIN, _stamp(utc_ns))
    out.text("")
    out.put(4, cdr.U32, len(statuses))
    for status in statuses:
        out.put(1, cdr.U8, status.level)
        for part in (status.name, status.message, status.hardware_id):
            out.text(part)
        out.put(4, cdr.U32, len(status.values))
        for key, value in status.values.items():
            out.text(key)
            out.text(value)
    return out.done()


class Transform(NamedTuple):
    """Frame `child` in frame `parent`: translation in m, rotation as quaternion x y z w."""

    parent: str
    child: str
    translation_m: tuple[float, float, float]
    rotation: tuple[float, float, float, float]


def tf_static(transforms: Sequence[Transform], utc_ns: int) -> bytes:
    """tf2_msgs/TFMessage."""
    out = cdr.Out(cdr.BEGIN, cdr.U32.pack(len(transforms)))
    for t in transforms:
        out.align(4)
        out.data += _stamp(utc_ns)
        out.text(t.parent)
        out.text(t.child)
        out.put(8, _TRANSFORM, *t.translation_m, *t.rotation)
    return out.done()


def station_transforms(
    reference_llh: tuple[float, float, float],
    reference_ecef_m: tuple[float, float, float],
    azimuth_deg: float,
    sensors: Sequence[str] = (),
) -> tuple[Transform, ...]:
    """earth -> map (ENU at the reference) -> structure -> each sensor (REP-103, REP-105).

    ENU in ECEF is a turn about z by 90 deg + longitude, then about x by 90 deg - latitude. Sensors stand at the
    structure's origin: where they are mounted is not known, and their samples are already in structure axes.
    """
    lat, lon, _ = reference_llh
    half_z, half_x = math.radians(90.0 + lon) / 2.0, math.radians(90.0 - lat) / 2.0
    cz, sz, cx, sx = math.cos(half_z), math.sin(half_z), math.cos(half_x), math.sin(half_x)
    turn = math.radians(90.0 - azimuth_deg) / 2.0
    zero, same = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
    return (
        Transform("earth", "map", reference_ecef_m, (cz * sx, sz * sx, sz * cx, cz * cx)),
        Transform("map", "structure", zero, (0.0, 0.0, math.sin(turn), math.cos(turn))),
        *(Transform("structure", name, zero, same) for name in sensors),
    )


# ------------------------------------------------------------------------------------------------------------ decoding


def decode_raw(topic: str, schema: str, data: bytes) -> Raw:
    """The Raw of a message on `/raw/<port>` or `/raw/clock`, bit for bit as it was encoded."""
    source = topic.removeprefix(RAW_PREFIX)
    stream = cdr.In(data)
    if schema == RAW_BYTES:
        stream.head()
        order, t_ns = stream.fixed(8, _RAW_BYTES)
        (n,) = stream.fixed(4, cdr.U32)
        pos = stream.take(n)
        return Raw(t_ns, order, source, data[pos : pos + n])
    if schema == CAN_FRAMES:
        order, t_ns, first, unit, dropped, width = stream.fixed(8, _CAN_FRAMES)
        can_id = stream.column("<u4")
        flags, length = stream.column("u1"), stream.column("u1")
        times, planes = stream.column("u1"), stream.column("u1")
        return Raw(t_ns, order, source, _unplane(first, unit, dropped, width, can_id, flags, length, times, planes))
    if schema == TICK:
        stream.head()
        order, t_ns, utc_ns, error_ns, sync = stream.fixed(8, _TICK)
        return Raw(t_ns, order, source, Tick(utc_ns, sync, error_ns))
    raise ValueError(f"{topic}: {schema} is no raw schema")


def _unplane(
    first: int,
    unit: int,
    dropped: int,
    width: int,
    can_id: npt.NDArray[np.uint32],
    flags: U8,
    length: U8,
    times: U8,
    planes: U8,
) -> CanFrames:
    n = can_id.size
    used, rest = divmod(planes.size, n) if n else (0, planes.size)
    size, uneven = divmod(times.size, n) if n else (1, times.size)
    if rest or uneven or used > width or size not in (1, 2, 4, 8) or not flags.size == length.size == n:
        raise ValueError("CanFrames: columns of different lengths")
    data = np.zeros((n, width), np.uint8)
    data[:, :used] = planes.reshape(used, n).T if n else 0
    delta = np.ascontiguousarray(times.reshape(size, n).T).view(f"<i{size}").reshape(n).astype(np.int64)
    t_ns: I64 = first + unit * np.cumsum(delta)
    return CanFrames(t_ns, can_id, flags, length, data, dropped)


class Checkpoint(NamedTuple):
    """A decoded Checkpoint: `order` of the next Raw, UTC at `monotonic_ns` by the segment's map, reason, state."""

    order: int
    monotonic_ns: int
    utc_ns: int
    reason: str
    state: bytes


def decode_checkpoint(data: bytes) -> Checkpoint:
    """Inverse of `checkpoint`."""
    stream = cdr.In(data)
    stream.head()
    order, mono_ns, utc_ns = stream.fixed(8, _CHECKPOINT)
    reason = stream.text()
    (n,) = stream.fixed(4, cdr.U32)
    pos = stream.take(n)
    return Checkpoint(order, mono_ns, utc_ns, reason, data[pos : pos + n])


def raw_order(schema: str, data: bytes) -> int:
    """`Raw.order` of a raw message, without decoding the rest."""
    stream = cdr.In(data)
    if schema != CAN_FRAMES:
        stream.head()
    return int(stream.fixed(8, _RAW_BYTES)[0])


def decode_accel_block(source: str, data: bytes) -> AccelBlock:
    """The AccelBlock, its accelerations as float32 kept them."""
    stream = cdr.In(data)
    stream.head()
    first, drain = stream.fixed(8, _ACCEL_BLOCK)
    axes = [stream.column("<f4") for _ in range(3)]
    flags = stream.column("u1")
    offset, count = stream.column("<i8"), stream.column("<i8")
    _same_length(*axes, flags, offset, count)
    with np.errstate(invalid="ignore"):  # a damaged number may be a signalling NaN
        xyz = np.stack(axes, axis=1).astype(np.float64)
    return AccelBlock(source, first + offset, xyz, flags, count, drain)


def decode_fused_block(point: str, data: bytes) -> Estimate:
    """The Estimate, its columns as float32 kept them."""
    stream = cdr.In(data)
    stream.head()
    first, *threes, revision = stream.fixed(8, _FUSED_BLOCK)
    columns = [stream.column("<f4") for _ in range(12)]
    mode, flags = stream.column("u1"), stream.column("u1")
    offset = stream.column("<i8")
    _same_length(*columns, mode, flags, offset)
    with np.errstate(invalid="ignore"):  # a damaged number may be a signalling NaN
        moved, speed, std_moved, std_speed = (
            np.stack(columns[i : i + 3], axis=1).astype(np.float64) for i in (0, 3, 6, 9)
        )
    bias, std_bias, level, std_level = (np.array(threes[i : i + 3]) for i in (0, 3, 6, 9))
    t_ns = first + offset
    return Estimate(
        point, t_ns, moved, speed, std_moved, std_speed, mode, flags, bias, std_bias, level, std_level, revision
    )


def _same_length(*columns: npt.NDArray[Any]) -> None:
    if len({column.size for column in columns}) != 1:
        raise ValueError("columns of different lengths")
