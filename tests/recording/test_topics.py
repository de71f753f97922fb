"""Encoders against their own decoders, and against another project's encoder: rosbags must write the same bytes."""

from __future__ import annotations

import contextlib
import enum
import math
import struct
from typing import Any

import numpy as np
import pytest
from all_topics import BLOCK, accel_block, estimate, fix, records
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from edge_agent import messages as m
from edge_agent.recording import schemas, topics

I64_ = st.integers(-(1 << 63), (1 << 63) - 1)
U64_ = st.integers(0, (1 << 63) - 1)

SAMPLES = {(r.schema or topics.schema_of(r.topic)): r for r in records(blocks=11)}


def typestore(schema: str) -> Any:
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(topics.SCHEMAS[schema], schema))
    return store


def plain(value: Any) -> Any:
    """A message of rosbags or of `decode` as the same plain values."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if hasattr(value, "__msgtype__"):
        names = [f for f in value.__dataclass_fields__ if not f.isupper() and f != "__msgtype__"]  # upper: constants
        return {k: plain(getattr(value, k)) for k in names}
    if isinstance(value, np.ndarray):
        return [plain(v) for v in value.tolist()]
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return "nan" if isinstance(value, float) and math.isnan(value) else value


def test_samples_cover_every_schema() -> None:
    assert set(SAMPLES) == set(topics.SCHEMAS)


@pytest.mark.parametrize("schema", topics.SCHEMAS)
def test_rosbags_reads_the_same_values_and_writes_the_same_bytes(schema: str) -> None:
    store = typestore(schema)
    data = SAMPLES[schema].data
    message = store.deserialize_cdr(data, schema)
    assert plain(message) == plain(topics.decode(schema, data))
    assert bytes(store.serialize_cdr(message, schema)) == data


@pytest.mark.parametrize("frame", ["", "a", "ab", "abc", "abcdefg", "station-7"])
def test_alignment_holds_for_any_length_of_name(frame: str) -> None:
    made = {
        topics.NAV_SAT_FIX: topics.navsatfix(fix(5, 0), 7, frame),
        topics.GNSS_SOLUTION: topics.gnss_solution(fix(5, 0), 7, (1.0, 2.0, 3.0), 9, frame),
        topics.ACCEL: topics.accel(3, (1.0, 2.0, 3.0), 5, 7, frame),
        topics.EVENT: topics.event(frame, frame * 2, frame * 3, ((frame, 1.0), (frame + "x", 2.0)), 5, 7),
        topics.LOG: topics.log(10, frame, frame * 2, 7, frame * 3, frame, 3),
        topics.DIAGNOSTICS: topics.diagnostics([topics.Status(2, frame, frame, {frame: frame + "y"})] * 2, 7),
        topics.TF: topics.tf_static([topics.Transform(frame, frame + "z", (1.0,) * 3, (0.5,) * 4)] * 3, 7),
        topics.CHECKPOINT: topics.checkpoint(1, 2, 3, b"state", frame),
        topics.RAW_BYTES: topics.raw_bytes(m.Raw(1, 2, frame, b"abc"), 7),
    }
    for schema, data in made.items():
        store = typestore(schema)
        message = store.deserialize_cdr(data, schema)
        assert bytes(store.serialize_cdr(message, schema)) == data, schema
        assert plain(message) == plain(topics.decode(schema, data)), schema


@pytest.mark.parametrize("schema", [topics.NAV_SAT_FIX, topics.LOG, topics.DIAGNOSTICS, topics.TF])
def test_standard_types_are_those_of_ros(schema: str) -> None:
    """rosbags' own copy of the ROS 2 definitions gives the same type hash and the same constants."""
    ros = get_typestore(Stores.ROS2_HUMBLE)
    ours = typestore(schema)
    assert ours.hash_rihs01(schema) == ros.hash_rihs01(schema)
    for name in schemas.parse_schema(schema, topics.SCHEMAS[schema]):
        assert ours.fielddefs[name] == ros.fielddefs[name], name


@pytest.mark.parametrize(
    ("schema", "field", "meaning"),
    [
        (topics.GNSS_SOLUTION, "fix", m.Quality),
        (topics.FUSION_UPDATE, "verdict", m.Verdict),
        (topics.HEADING, "verdict", m.Verdict),
        (topics.FUSED_STATE, "mode", m.Mode),
        (topics.FUSED_BLOCK, "mode", m.Mode),
        (topics.FUSED_STATE, "flags", m.FusionFlag),
        (topics.FUSED_BLOCK, "flags", m.FusionFlag),
        (topics.ACCEL, "flags", m.AccelFlag),
        (topics.ACCEL_BLOCK, "flags", m.AccelFlag),
        (topics.CAN_FRAMES, "flags", m.CanFlag),
    ],
)
def test_constants_stand_before_their_field_and_mean_the_same(
    schema: str, field: str, meaning: type[enum.IntEnum] | type[enum.IntFlag]
) -> None:
    names = next(f.names for f in schemas.parse_schema(schema, topics.SCHEMAS[schema])[schema] if f.name == field)
    prefix = "FLAG_" if issubclass(meaning, enum.IntFlag) else ""
    assert names == {int(value): f"{prefix}{value.name}" for value in meaning}


def test_a_solution_from_before_course_and_speed_reads_by_its_files_own_text() -> None:
    data = SAMPLES[topics.GNSS_SOLUTION].data
    new = topics.decode(topics.GNSS_SOLUTION, data)
    assert (new["course_deg"], new["speed_mps"]) == (211.5, pytest.approx(0.017))
    lines = topics.SCHEMAS[topics.GNSS_SOLUTION].splitlines(keepends=True)
    text = "".join(x for x in lines if not x.startswith(("float32 course_deg", "float32 speed_mps")))
    at = data.index(struct.pack("<f", 211.5))
    old = topics.decode(topics.GNSS_SOLUTION, data[:at] + data[at + 8 :], text)
    assert plain(old) == plain({k: v for k, v in new.items() if k not in ("course_deg", "speed_mps")})


def test_topics_have_the_schemas_of_the_table() -> None:
    assert topics.schema_of("/raw/clock") == topics.TICK
    assert topics.schema_of("/accel/a1") == topics.ACCEL
    assert topics.schema_of("/accel/a1/block") == topics.ACCEL_BLOCK
    assert topics.schema_of("/fusion/p/smoothed") == topics.FUSED_BLOCK
    for topic in (
        "/raw/can0",
        "/raw/",
        "/gnss/r1",
        "/gnss//fix",
        "/fusion/p/other",
        "accel/a1",
        "/accel/a/b/block",
        "",
    ):
        with pytest.raises(ValueError, match="topic"):
            topics.schema_of(topic)


# ----------------------------------------------------------------------------------------------------- raw, bit for bit


def same_frames(a: m.CanFrames, b: m.CanFrames) -> bool:
    columns = ("t_ns", "can_id", "flags", "length", "data")
    return a.dropped == b.dropped and all(
        getattr(a, k).dtype == getattr(b, k).dtype
        and getattr(a, k).shape == getattr(b, k).shape
        and getattr(a, k).tobytes() == getattr(b, k).tobytes()
        for k in columns
    )


@st.composite
def can_frames(draw: st.DrawFn) -> m.CanFrames:
    n = draw(st.integers(0, 40))
    width = draw(st.sampled_from([8, 64]))
    rng = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    kind = draw(st.sampled_from(["any", "microseconds", "equal", "slow"]))
    if kind == "any":
        t_ns = rng.integers(-(1 << 63), (1 << 63) - 1, n, dtype=np.int64, endpoint=True)
    elif kind == "microseconds":
        t_ns = 123_456_789 + 1000 * np.cumsum(rng.integers(-5, 5000, n))
    elif kind == "equal":
        t_ns = np.full(n, draw(U64_), np.int64)
    else:
        t_ns = np.cumsum(rng.integers(0, 1 << draw(st.integers(1, 40)), n))
    data = rng.integers(0, 256, (n, width), dtype=np.uint8)
    length = rng.integers(0, width, n, dtype=np.uint8, endpoint=True)
    if draw(st.booleans()):
        data[np.arange(width) >= length[:, None]] = 0
    can_id = rng.integers(0, 1 << 29, n, dtype=np.uint32)
    flags = rng.integers(0, 256, n, dtype=np.uint8)
    return m.CanFrames(t_ns.astype(np.int64), can_id, flags, length, data, draw(st.integers(0, (1 << 32) - 1)))


@settings(max_examples=200, deadline=None)
@given(can_frames(), U64_, U64_)
def test_can_frames_come_back_bit_for_bit(frames: m.CanFrames, t_ns: int, order: int) -> None:
    record = topics.raw_record(m.Raw(t_ns, order, "can0", frames), 5)
    back = topics.decode_raw(record.topic, record.schema, record.data)
    assert (back.t_ns, back.order, back.source) == (t_ns, order, "can0")
    assert isinstance(back.payload, m.CanFrames)
    assert same_frames(back.payload, frames)
    assert topics.raw_order(record.schema, record.data) == order


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300), U64_, U64_, I64_, I64_, st.booleans(), st.text(max_size=9))
def test_bytes_ticks_and_checkpoints_come_back_bit_for_bit(
    data: bytes, t_ns: int, order: int, utc_ns: int, error_ns: int, sync: bool, text: str
) -> None:
    for raw in (m.Raw(t_ns, order, "gnss", data), m.Raw(t_ns, order, "clock", m.Tick(utc_ns, sync, error_ns))):
        record = topics.raw_record(raw, 1 << 60)
        assert topics.decode_raw(record.topic, record.schema, record.data) == raw
        assert topics.raw_order(record.schema, record.data) == order
    made = topics.checkpoint(order, t_ns, utc_ns, data, text)
    reason = text.replace("\0", "").encode("utf-8", "replace").decode()
    assert topics.decode_checkpoint(made) == topics.Checkpoint(order, t_ns, utc_ns, reason, data)


def test_planes_of_frames_are_what_the_message_text_says() -> None:
    """A reader that follows the text's comment alone gets the times and the data."""
    frames = next(r for r in records(blocks=1) if r.schema == topics.CAN_FRAMES)
    raw = topics.decode_raw(frames.topic, frames.schema, frames.data).payload
    assert isinstance(raw, m.CanFrames)
    values = topics.decode(frames.schema, frames.data)
    n = len(values["can_id"])
    times, data = values["t_delta_planes"].tolist(), values["data_planes"].tolist()
    size = len(times) // n
    t_ns = values["t_first_ns"]
    for i in range(n):
        delta = int.from_bytes(bytes(times[k * n + i] for k in range(size)), "little", signed=True)
        t_ns += values["t_unit_ns"] * delta
        assert t_ns == raw.t_ns[i]
        stored = bytes(data[k * n + i] for k in range(len(data) // n))
        assert stored.ljust(values["width"], b"\0") == raw.data[i].tobytes()


# -------------------------------------------------------------------------------------------------------------- blocks


def test_blocks_come_back_as_float32_kept_them() -> None:
    rng = np.random.default_rng(3)
    t_ns = 10**12 + np.cumsum(rng.integers(1, 1 << 34, BLOCK))
    block = accel_block(rng, t_ns, -5)
    back = topics.decode_accel_block("a1", topics.accel_block(block, 77))
    assert back.source == "a1"
    assert back.t_ns.tolist() == t_ns.tolist()
    assert back.count.tolist() == block.count.tolist()
    assert back.flags.tobytes() == block.flags.tobytes()
    assert (back.xyz == block.xyz.astype(np.float32)).all()

    made = estimate(rng, t_ns)
    fused = topics.decode_fused_block("p1", topics.fused_block(made, 77))
    assert fused.t_ns.tolist() == t_ns.tolist()
    assert np.abs(fused.displacement_m - made.displacement_m).max() <= 0.5 / topics.DISPLACEMENT_GRID
    assert np.abs(fused.velocity_mps - made.velocity_mps).max() <= 0.5 / topics.VELOCITY_GRID
    for name in ("std_displacement_m", "std_velocity_mps"):
        assert np.abs(getattr(fused, name) / getattr(made, name) - 1.0).max() < 0.0005, name
    for name in ("bias_mps2", "std_bias_mps2", "offset_m", "std_offset_m"):
        want = getattr(made, name).astype(np.float32)
        assert np.array_equal(getattr(fused, name), want, equal_nan=True), name
    assert fused.mode.tobytes() == made.mode.tobytes()
    assert fused.flags.tobytes() == made.flags.tobytes()
    assert (fused.point, fused.revision) == ("p1", 0)


def test_a_block_keeps_infinite_and_missing_numbers() -> None:
    rng = np.random.default_rng(3)
    made = estimate(rng, np.arange(3, dtype=np.int64))
    for table in (made.displacement_m, made.velocity_mps, made.std_displacement_m, made.std_velocity_mps):
        table[:] = np.array([[math.nan], [math.inf], [-math.inf]])
    fused = topics.decode_fused_block("p1", topics.fused_block(made, 0))
    for name in ("displacement_m", "velocity_mps", "std_displacement_m", "std_velocity_mps"):
        assert np.array_equal(getattr(fused, name), getattr(made, name), equal_nan=True), name


def test_a_value_that_does_not_fit_is_a_value_error() -> None:
    with pytest.raises(ValueError, match="fit"):
        topics.raw_bytes(m.Raw(-1, 0, "gnss", b""), 0)
    with pytest.raises(ValueError, match="fit"):
        topics.accel(0, (0.0, 0.0, 0.0), 256, 0)
    with pytest.raises(ValueError, match="without samples"):
        topics.accel_block(accel_block(np.random.default_rng(0), np.zeros(0, np.int64), 0), 0)


def test_absurd_numbers_of_a_receiver_do_not_stop_the_recording() -> None:
    absurd = m.GnssFix(
        *(1, 2, 3, False, 0.0, 0.0, 1e300, 0.0, m.Quality.NONE, 65535, 1e300, -1e300, math.inf, math.nan, "\0\ud800"),
        *((1e300,) * 3, (0.0,) * 3, ()),
    )
    data = topics.gnss_solution(absurd, 1 << 62, (math.nan,) * 3, 0, "r1")
    values = topics.decode(topics.GNSS_SOLUTION, data)
    assert values["hdop"] == math.inf
    assert values["pdop"] == -math.inf
    assert values["station"] == "?"
    assert values["header"]["stamp"] == {"sec": 0x7FFFFFFF, "nanosec": 999_999_999}


def test_map_frame_turns_into_earth_as_the_textbook_says() -> None:
    """East, North and Up of 47 N 8.5 W, from the rotation matrix of ENU to ECEF."""
    lat, lon = math.radians(47.0), math.radians(-8.5)
    earth_map, map_structure, sensor = topics.station_transforms((47.0, -8.5, 0.0), (1.0, 2.0, 3.0), 30.0, ("a1",))

    def turn(q: tuple[float, float, float, float], v: tuple[float, float, float]) -> list[float]:
        u, w = np.array(q[:3]), q[3]
        return list(np.array(v) + 2.0 * np.cross(u, np.cross(u, v) + w * np.array(v)))

    east = [-math.sin(lon), math.cos(lon), 0.0]
    up = [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)]
    assert turn(earth_map.rotation, (1.0, 0.0, 0.0)) == pytest.approx(east, abs=1e-12)
    assert turn(earth_map.rotation, (0.0, 0.0, 1.0)) == pytest.approx(up, abs=1e-12)
    x_axis = [math.sin(math.radians(30.0)), math.cos(math.radians(30.0)), 0.0]  # azimuth 30: East, North
    assert turn(map_structure.rotation, (1.0, 0.0, 0.0)) == pytest.approx(x_axis, abs=1e-12)
    assert (sensor.parent, sensor.child) == ("structure", "a1")


# ------------------------------------------------------------------------------------------------------------- garbage


@settings(max_examples=300, deadline=None)
@given(st.sampled_from(sorted(SAMPLES)), st.data())
def test_damaged_bytes_are_a_value_error_and_nothing_else(schema: str, draw: st.DataObject) -> None:
    data = bytearray(SAMPLES[schema].data)
    for _ in range(draw.draw(st.integers(0, 4))):
        data[draw.draw(st.integers(0, len(data) - 1))] ^= 1 << draw.draw(st.integers(0, 7))
    cut = bytes(data[: draw.draw(st.integers(0, len(data)))])
    readers = [lambda: topics.decode(schema, cut)]
    if schema in (topics.RAW_BYTES, topics.CAN_FRAMES, topics.TICK):
        readers.append(lambda: topics.decode_raw("/raw/x", schema, cut))
    if schema == topics.CHECKPOINT:
        readers.append(lambda: topics.decode_checkpoint(cut))
    if schema == topics.ACCEL_BLOCK:
        readers.append(lambda: topics.decode_accel_block("a1", cut))
    if schema == topics.FUSED_BLOCK:
        readers.append(lambda: topics.decode_fused_block("p", cut))
    for read in readers:
        with contextlib.suppress(ValueError):
            read()


def test_a_number_that_damage_has_made_a_signalling_nan_is_no_warning() -> None:
    """Found by fuzzing: numpy warns of them, and a warning is an error here."""
    rng = np.random.default_rng(3)
    made, block = estimate(rng, np.arange(3, dtype=np.int64)), accel_block(rng, np.arange(3, dtype=np.int64), 0)
    for table in (made.displacement_m, made.std_velocity_mps, block.xyz):
        table[:] = math.nan
    quiet, signalling = np.float32(math.nan).tobytes(), b"\x01\x00\xa0\x7f"
    for data in (topics.fused_block(made, 0), topics.accel_block(block, 0)):
        assert data.count(quiet) >= 6
    fused = topics.decode_fused_block("p", topics.fused_block(made, 0).replace(quiet, signalling))
    assert np.isnan(fused.displacement_m).all()
    assert np.isnan(topics.decode_accel_block("a", topics.accel_block(block, 0).replace(quiet, signalling)).xyz).all()
