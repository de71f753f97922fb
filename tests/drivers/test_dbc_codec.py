"""The accelerometer codec against cantools, against a real recording, and against everything a bus can do to it."""

from __future__ import annotations

import csv
import dataclasses
import math
import random
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from can_play import COUNTER, SPLIT, T0, TRIPLE, Frame, accel, balance, cut, frames, reasons, run, triple
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can_signals import Dbc, Decoder, compile_signal, decode_signal
from drivers.dbc_codec import COUNTERS, GRAVITY_MPS2, AccelCodec
from edge_agent.messages import (
    MS,
    AccelBlock,
    AccelerometerSettings,
    AccelFlag,
    CanFlag,
    CanFrames,
    Event,
    Reject,
    S,
    SignalField,
)
from edge_agent.state import pack, unpack

# ---------------------------------------------------------------------------------------- every signal, as cantools


def dbc_files(shared_data: Path) -> list[Path]:
    folders = ("D1-canedge-imu-mf4", "D3-hipnuc-imu-dbc", "D5-dbc-with-acceleration-signals")
    return sorted(path for folder in folders for path in (shared_data / folder).glob("*.dbc"))


def compiled(signal: Any, message: Any) -> Any:
    return compile_signal(
        signal.name,
        SignalField(
            message.frame_id,
            signal.start,
            signal.length,
            "little" if signal.byte_order == "little_endian" else "big",
            signal.is_signed,
            signal.is_float,
            float(signal.scale),
            float(signal.offset),
            message.is_extended_frame,
        ),
    )


def same(a: Any, b: Any) -> bool:
    return bool(a == b) or (math.isnan(a) and math.isnan(b))


def test_every_signal_of_every_file_decodes_as_cantools_decodes_it(shared_data: Path) -> None:
    """Random payloads; multiplexed signals wherever the payload selects them. Raw values and scaled ones."""
    rng = random.Random(1)
    seen: set[tuple[str, str, str]] = set()
    total = 0
    for path in dbc_files(shared_data):
        database: Any = cantools.database.load_string(path.read_text(encoding="cp1252"), "dbc", strict=False)
        for message in database.messages:
            total += len(message.signals)
            specs = {s.name: compiled(s, message) for s in message.signals}
            multiplexed = message.is_multiplexed()
            for _ in range(400 if multiplexed else 20):
                payload = bytearray(rng.randbytes(message.length))
                if multiplexed:  # selectors are mostly small
                    payload = bytearray(b & rng.choice((0xFF, 0x3F, 0x07, 0x03)) for b in payload)
                data = np.frombuffer(bytes(payload).ljust(8, b"\0"), np.uint8).reshape(1, -1)
                length = np.array([message.length], np.uint8)
                try:
                    raw = message.decode(bytes(payload), decode_choices=False, scaling=False)
                    scaled = message.decode(bytes(payload), decode_choices=False)
                except cantools.database.errors.DecodeError:
                    assert multiplexed  # no signals belong to this selector
                    continue
                for name, expected in raw.items():
                    values, ok = decode_signal(specs[name], data, length)
                    assert ok.all()
                    assert same(values[0].item(), expected), (path.name, message.name, name)
                    together = Decoder([specs[name]])(data, length)[0, 0].item()
                    if math.isfinite(together):
                        assert together == pytest.approx(float(scaled[name]), rel=1e-14, abs=1e-300), name
                    seen.add((path.name, f"{message.frame_id:X}.{message.name}", name))
    assert total == 766
    assert len(seen) == total


def test_an_exhaustive_bit_by_bit_reading() -> None:
    """Every start and length, both byte orders, against plain big integers: fields across nine bytes too."""
    payload = random.Random(2).randbytes(64)
    data = np.frombuffer(payload, np.uint8).reshape(1, 64)
    full = np.array([64], np.uint8)
    little, big = int.from_bytes(payload, "little"), int.from_bytes(payload, "big")
    checked = 0
    for start in [*range(24), 441, 447, 448]:
        for length in range(1, 65):
            mask = (1 << length) - 1
            for signed in (False, True):
                expected = little >> start & mask
                expected -= (1 << length) * (signed and expected >> (length - 1))
                spec = compile_signal("s", SignalField(1, start, length, "little", signed))
                assert decode_signal(spec, data, full)[0].item() == expected

                begin = 8 * (start // 8) + 7 - start % 8
                if begin + length <= 512:
                    expected = big >> (512 - begin - length) & mask
                    expected -= (1 << length) * (signed and expected >> (length - 1))
                    spec = compile_signal("s", SignalField(1, start, length, "big", signed))
                    assert decode_signal(spec, data, full)[0].item() == expected
                    checked += 1
    assert checked > 3000


@pytest.mark.parametrize(("order", "mark", "start"), [("little", "<", 8), ("big", ">", 15)])
@pytest.mark.parametrize(("length", "code"), [(16, "e"), (32, "f"), (64, "d")])
def test_floats(order: str, mark: str, start: int, length: int, code: str) -> None:
    payload = (b"\xff" + struct.pack(mark + code, -1.5)).ljust(12, b"\xff")
    spec = compile_signal("s", SignalField(1, start, length, order, is_float=True))
    values, _ = decode_signal(spec, np.frombuffer(payload, np.uint8).reshape(1, -1), np.array([12], np.uint8))
    assert values.item() == -1.5


def test_a_frame_that_is_too_short_for_a_signal_says_so() -> None:
    spec = compile_signal("s", SignalField(1, 0, 24))
    data = np.zeros((3, 8), np.uint8)
    _, ok = decode_signal(spec, data, np.array([2, 3, 8], np.uint8))
    assert ok.tolist() == [False, True, True]
    far = compile_signal("s", SignalField(1, 100, 24))
    assert not decode_signal(far, data, np.array([8, 8, 8], np.uint8))[1].any()


# ------------------------------------------------------------------------------------------------- a real recording


def candump(path: Path) -> CanFrames:
    """`candump -l` lines of classic frames: (1627276799.721150) can1 009#9BE4CFC000FEAF7F"""
    rows = []
    for line in path.read_text().splitlines():
        stamp, _, frame = line.split()
        seconds, _, micros = stamp.strip("()").partition(".")
        can_id, _, data = frame.partition("#")
        flags = CanFlag.EXT if len(can_id) == 8 else 0
        rows.append(Frame(int(seconds) * S + int(micros) * 1000, int(can_id, 16), bytes.fromhex(data), flags))
    return frames(rows)


@pytest.fixture(scope="session")
def imu(shared_data: Path) -> tuple[CanFrames, AccelerometerSettings, np.ndarray[Any, Any], list[int]]:
    """D1: frames, settings, accelerations and times as other people's decoder found them."""
    folder = shared_data / "D1-canedge-imu-mf4"
    with (folder / "derived" / "00000005-60FEB5A8.gnss_imu.csv").open() as f:
        rows = list(csv.DictReader(f))
    truth = np.array([[float(row[f"Acceleration{axis}"]) for axis in "XYZ"] for row in rows])
    times = [int(row["t_unix"].replace(".", "")) * 1000 for row in rows]
    names = ("AccelerationX", "AccelerationY", "AccelerationZ")
    text = (folder / "canmod-gps.dbc").read_text()
    return (
        candump(folder / "derived" / "00000005-60FEB5A8.candump.log"),
        accel(unit="m/s2", fields=None, signals=names, dbc="canmod-gps.dbc", dbc_text=text),
        truth,
        times,
    )


def test_a_real_recording(imu: tuple[CanFrames, AccelerometerSettings, np.ndarray[Any, Any], list[int]]) -> None:
    block, config, truth, times = imu
    codec = AccelCodec(config)
    assert codec.ids == frozenset({(False, 9)})
    samples, notes = run(codec, cut(block, range(17, block.t_ns.size, 17)))
    assert notes == []
    assert samples.xyz.shape == (4518, 3)
    assert np.array_equal(samples.xyz, truth)
    assert samples.t_ns.tolist() == times
    assert samples.count.tolist() == list(range(4518))
    assert not samples.flags.any()  # 95 equal payloads in a row are no duplicates
    assert not samples.drain_stamped
    assert codec.counters == dict.fromkeys(COUNTERS, 0) | {"frames": 4518, "accepted": 4518, "samples": 4518}


def test_d3_accelerations(shared_data: Path) -> None:
    """CANopen and J1939 of the same maker: standard and extended identifiers, g."""
    folder = shared_data / "D3-hipnuc-imu-dbc"
    for file, can_id, flags, message, step in [
        ("CANopen.dbc", 0x188, 0, "TPDO1_Acceleration", 0.001),
        ("J1939.dbc", 0x0CFF3408, CanFlag.EXT, "PGN65332_FF34_Accel", 0.00048828),
    ]:
        names = tuple(f"{message}.Acc_{axis}" for axis in "XYZ")
        text = (folder / file).read_text()
        codec = AccelCodec(accel(fields=None, signals=names, dbc=file, dbc_text=text))
        data = struct.pack("<4h", -1, 2, 1000, 0)[: 6 if file == "CANopen.dbc" else 8]
        other = Frame(T0, can_id, data, flags ^ CanFlag.EXT)  # the same number in the other kind of identifier
        samples, notes = run(codec, [frames([other, Frame(T0 + 1, can_id, data, flags)])])
        assert notes == []
        assert samples.t_ns.tolist() == [T0 + 1]
        assert samples.xyz.tolist() == [[raw * step * GRAVITY_MPS2 for raw in (-1, 2, 1000)]]


# ---------------------------------------------------------------------------------------------- units, axes, flags


@pytest.mark.parametrize(("unit", "factor"), [("m/s2", 1.0), ("g", 9.80665), ("mg", 0.00980665), ("gal", 0.01)])
def test_units(unit: str, factor: float) -> None:
    samples, _ = run(AccelCodec(accel(unit=unit)), [frames([triple(T0, (1000, -2000, 500))])])
    assert samples.xyz[0] == pytest.approx([factor, -2 * factor, 0.5 * factor], rel=1e-15)


def test_the_mounting_rotates_to_structure_axes() -> None:
    # the sensor's x looks down, its y along the structure's x, its z along -y
    rotation = ((0.0, 1.0, 0.0), (0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))
    samples, _ = run(AccelCodec(accel(unit="m/s2", rotation=rotation)), [frames([triple(T0, (1000, 2000, 3000))])])
    assert samples.xyz.tolist() == [[2.0, -3.0, -1.0]]


def test_range_is_in_sensor_axes_before_the_rotation() -> None:
    half = math.sqrt(0.5)
    rotation = ((half, -half, 0.0), (half, half, 0.0), (0.0, 0.0, 1.0))
    codec = AccelCodec(accel(unit="m/s2", range_mps2=20.0, rotation=rotation))
    rows = [(19979, 0, 0), (19980, 0, 0), (0, -19980, 0), (0, 0, -25000), (15000, 15000, 0)]
    samples, _ = run(codec, [frames([triple(T0 + k * MS, xyz) for k, xyz in enumerate(rows)])])
    assert samples.flags.tolist() == [0, *[AccelFlag.SATURATED] * 3, 0]
    assert codec.counters["saturated"] == 3


def test_an_integer_at_its_end_is_saturated_without_a_range() -> None:
    rows = [(32767, 0, 0), (0, -32768, 0), (32766, -32767, 0)]
    samples, _ = run(AccelCodec(accel()), [frames([triple(T0 + k, xyz) for k, xyz in enumerate(rows)])])
    assert samples.flags.tolist() == [AccelFlag.SATURATED, AccelFlag.SATURATED, 0]


def test_drain_stamps_are_handed_on() -> None:
    for flag in (CanFlag.DRAIN, CanFlag.SPREAD):
        row = dataclasses.replace(triple(T0, (1, 2, 3)), flags=int(flag))
        samples, _ = AccelCodec(accel()).feed(frames([triple(T0, (1, 2, 3)), row]))
        assert samples is not None
        assert samples.drain_stamped


# --------------------------------------------------------------------------------------------------------- refusals


def test_short_and_remote_frames_are_refused_with_their_reason() -> None:
    rows = [
        triple(T0, (1, 1, 1)),
        Frame(T0 + 1, 0x188, b"\1\2\3\4\5"),
        Frame(T0 + 2, 0x188, bytes(6), int(CanFlag.RTR)),
        Frame(T0 + 3, 0x188, b""),
        Frame(T0 + 4, 0x188, bytes(8), int(CanFlag.ERR)),  # an error class that happens to be that number
        triple(T0 + 5, (2, 2, 2)),
    ]
    codec = AccelCodec(accel())
    samples, notes = run(codec, [frames(rows)])
    assert samples.t_ns.tolist() == [T0, T0 + 5]
    assert reasons(notes) == [("RTR", 1), ("SHORT", 2)]
    assert [n.t_ns for n in notes] == [T0 + 2, T0 + 1, T0 + 5]
    short = notes[1]
    assert isinstance(short, Reject)
    assert short.detail == "0x188 (x, y, z): 5 bytes, its signals need 6"
    # two samples are missing, and the number of the next says so
    assert samples.count.tolist() == [0, 3]
    assert samples.flags.tolist() == [0, AccelFlag.GAP_BEFORE]
    assert {k: v for k, v in codec.counters.items() if v} == {
        "frames": 5,
        "accepted": 2,
        "rejected": 3,
        "samples": 2,
        "gaps": 1,
        "lost": 2,
    }


def test_a_float_that_is_no_number_is_refused() -> None:
    fields = tuple(SignalField(7, 32 * k, 32, is_float=True) for k in range(3))
    rows = [Frame(T0 + k, 7, struct.pack("<3f", 1, v, 3)) for k, v in enumerate([2, math.nan, math.inf, -2])]
    samples, notes = run(AccelCodec(accel(unit="m/s2", fields=fields)), [frames(rows)])
    assert samples.xyz.tolist() == [[1, 2, 3], [1, -2, 3]]
    assert samples.flags.tolist() == [0, AccelFlag.GAP_BEFORE]
    assert reasons(notes) == [("NOT_FINITE", 2)]


def test_fd_signals_in_a_block_of_classic_frames() -> None:
    fields = tuple(SignalField(7, 8 * 40 + 16 * k, 16, "big" if k else "little", scale=0.5) for k in (0, 1, 2))
    payload = bytes(40) + struct.pack("<h", -4) + bytes(20)
    samples, notes = run(
        AccelCodec(accel(unit="m/s2", fields=fields)),
        [frames([Frame(T0, 7, bytes(8))]), frames([Frame(T0, 7, payload)])],
    )
    assert reasons(notes) == [("SHORT", 1)]
    assert samples.xyz[0, 0] == -2.0


def test_nothing_of_ours_in_the_block() -> None:
    codec = AccelCodec(accel())
    assert codec.feed(frames([Frame(T0, 0x189, bytes(8))])) == (None, [])
    assert codec.counters == dict.fromkeys(COUNTERS, 0)


# ---------------------------------------------------------------------------------------------------------- counter


def counted(values: Sequence[int], **changes: Any) -> tuple[AccelCodec, AccelBlock, list[Reject | Event]]:
    codec = AccelCodec(accel(counter=COUNTER, **changes))
    samples, notes = run(codec, [frames([triple(T0 + k * MS, (k, 0, 0), c) for k, c in enumerate(values)])])
    return codec, samples, notes


def test_a_counter_unwraps() -> None:
    _, samples, notes = counted([k % 256 for k in range(250, 530)])
    assert samples.count.tolist() == list(range(250, 530))
    assert not samples.flags.any()
    assert notes == []


def test_gaps_are_counted_and_flagged_and_told() -> None:
    codec, samples, notes = counted([3, 4, 7, 8, 254, 1])
    assert samples.count.tolist() == [3, 4, 7, 8, 254, 257]
    gap = AccelFlag.GAP_BEFORE
    assert samples.flags.tolist() == [0, 0, gap, 0, gap, gap]
    assert (codec.counters["gaps"], codec.counters["lost"]) == (3, 2 + 245 + 2)
    (event,) = notes
    assert isinstance(event, Event)
    assert (event.kind, event.source) == ("SAMPLES_LOST", "imu")
    assert event.values == (("lost", 249.0), ("gaps", 3.0))
    assert (event.begin_ns, event.end_ns) == (T0 + 1 * MS, T0 + 5 * MS)


def test_duplicates_by_counter_are_dropped_and_equal_payloads_are_not() -> None:
    codec, samples, notes = counted([1, 1, 2, 3, 3, 3])
    assert samples.count.tolist() == [1, 2, 3]
    assert samples.t_ns.tolist() == [T0, T0 + 2 * MS, T0 + 3 * MS]  # the first of each
    assert codec.counters["duplicates"] == 3
    assert notes == []
    still = AccelCodec(accel(counter=COUNTER))
    samples, _ = run(still, [frames([triple(T0 + k, (5, 5, 5), k) for k in range(9)])])
    assert samples.t_ns.size == 9


def test_a_block_of_nothing_but_duplicates() -> None:
    codec = AccelCodec(accel(counter=COUNTER))
    run(codec, [frames([triple(T0, (1, 1, 1), 9)])])
    assert codec.feed(frames([triple(T0 + 1, (1, 1, 1), 9)])) == (None, [])
    assert balance(codec)


@pytest.mark.parametrize("rate_hz", [1000.0, None])
def test_turns_that_went_by_unseen_are_told_by_the_period(rate_hz: float | None) -> None:
    """GIVEN an 8-bit counter at 1000 Hz, its rate given or learned. WHEN 10 s are missing. THEN its number says so."""
    before = 1100
    values = [k % 256 for k in range(before)] + [(before + 10_000 + k) % 256 for k in range(3)]
    times = [T0 + k * MS for k in range(before)] + [T0 + (before + 10_000 + k) * MS for k in range(3)]
    codec = AccelCodec(accel(counter=COUNTER, rate_hz=rate_hz))
    rows = [triple(t, (1, 2, 3), c) for t, c in zip(times, values, strict=True)]
    samples, notes = run(codec, cut(frames(rows), range(25, before, 25)))
    assert samples.count[-3:].tolist() == [before + 10_000 + k for k in range(3)]
    assert codec.counters["lost"] == 10_000
    assert samples.flags[-3:].tolist() == [AccelFlag.GAP_BEFORE, 0, 0]
    assert len(notes) == 1


def test_a_pause_while_the_period_is_learned_does_not_spoil_it() -> None:
    field = dataclasses.replace(COUNTER, length=4)
    codec = AccelCodec(accel(counter=field))
    times = [T0 + 4 * MS * k + (10 * S if k >= 500 else 0) for k in range(1600)]
    rows = [triple(t, (0, 0, 0), k % 16) for k, t in enumerate(times)]
    run(codec, [frames(rows)])
    # 25 samples are missing: a turn and a half, which only the period can tell
    last = times[-1] + 26 * 4 * MS
    samples, _ = run(codec, [frames([triple(last, (0, 0, 0), (1599 + 26) % 16)])])
    assert samples.count.tolist() == [1599 + 26]
    assert codec.counters["lost"] == 25


def test_bunched_drain_stamps_are_no_lost_turns() -> None:
    """A reader that stalled for 1 s stamps what waited as late; nothing is missing."""
    field = dataclasses.replace(COUNTER, length=4)
    codec = AccelCodec(accel(counter=field, rate_hz=250.0))
    times = [T0 + 4 * MS * k for k in range(10)] + [T0 + S + k * 1000 for k in range(250)]
    rows = [dataclasses.replace(triple(t, (0, 0, 0), k % 16), flags=int(CanFlag.DRAIN)) for k, t in enumerate(times)]
    samples, notes = run(codec, [frames(rows)])
    assert samples.count.tolist() == list(range(260))
    assert notes == []


def test_a_wide_counter_that_runs_backwards_was_reset() -> None:
    wide = SignalField(0x188, 48, 16)
    codec = AccelCodec(accel(counter=wide, rate_hz=100.0))
    values = [40_000, 40_001, 0, 1]
    times = [T0, T0 + 10 * MS, T0 + 2010 * MS, T0 + 2020 * MS]
    rows = [Frame(t, 0x188, struct.pack("<3hH", 1, 2, 3, c)) for t, c in zip(times, values, strict=True)]
    samples, notes = run(codec, [frames(rows)])
    assert samples.count.tolist() == [40_000, 40_001, 40_201, 40_202]  # 2 s at 100 Hz
    assert [n.kind for n in notes if isinstance(n, Event)] == ["SAMPLES_LOST", "COUNTER_RESET"]
    assert samples.flags.tolist() == [0, 0, AccelFlag.GAP_BEFORE, 0]
    assert codec.counters["resets"] == 1


DBC = """VERSION ""
BU_: A
BO_ 100 Both: 8 A
 SG_ X : 0|16@1- (0.001,0) [0|0] "g" A
 SG_ Y : 16|16@1- (0.001,0) [0|0] "g" A
 SG_ Z : 32|16@1- (0.001,0) [0|0] "g" A
 SG_ Alive : 48|4@1+ (1,0) [0|14] "" A
 SG_ Same : 56|8@1+ (1,0) [0|0] "" A
BO_ 101 Other: 8 A
 SG_ X : 0|16@1- (0.001,0) [0|0] "g" A
 SG_ Same : 56|8@1+ (1,0) [0|0] "" A
BO_ 102 Chosen: 8 A
 SG_ Which M : 0|8@1+ (1,0) [0|0] "" A
 SG_ Hidden m1 : 8|16@1- (1,0) [0|0] "g" A
"""


def test_a_counter_that_keeps_its_last_value_for_invalid() -> None:
    """Profiles that count 0 to 14 in four bits, which the DBC file's maximum tells."""
    codec = AccelCodec(accel(fields=None, signals=("Both.X", "Both.Y", "Both.Z"), dbc_text=DBC, counter="Alive"))
    rows = [Frame(T0 + k, 100, bytes(6) + bytes([c, 0])) for k, c in enumerate([12, 13, 14, 0, 15, 2])]
    samples, notes = run(codec, [frames(rows)])
    assert samples.count.tolist() == [12, 13, 14, 15, 17]
    assert reasons(notes) == [("COUNTER", 1)]


# ------------------------------------------------------------------------------------------------- several messages


def split(k: int, axes: str = "zxy", counter: int | None = None, spacing_ns: int = MS // 4) -> list[Frame]:
    """Sample k at 100 Hz of a device that sends one axis per message, as z, x, y."""
    ids = {"x": 0x31, "y": 0x32, "z": 0x30}
    raw = {"x": k, "y": 1000 + k, "z": -k}
    tail = b"" if counter is None else bytes([counter])
    return [
        Frame(T0 + k * 10 * MS + n * spacing_ns, ids[a], struct.pack("<h", raw[a]) + tail)
        for n, a in enumerate("zxy")
        if a in axes
    ]


def split_samples(ks: Sequence[int]) -> list[list[float]]:
    return [[v * 0.001 for v in (k, 1000 + k, -k)] for k in ks]


def test_three_messages_make_one_sample_at_the_last_of_them() -> None:
    codec = AccelCodec(accel(unit="m/s2", fields=SPLIT))
    assert codec.ids == frozenset({(False, 0x30), (False, 0x31), (False, 0x32)})
    samples, notes = run(codec, [frames([f for k in range(5) for f in split(k)])])
    assert samples.xyz.tolist() == split_samples(range(5))
    assert samples.t_ns.tolist() == [T0 + k * 10 * MS + MS // 2 for k in range(5)]
    assert samples.count.tolist() == list(range(5))
    assert notes == []


@pytest.mark.parametrize("lost", ["z", "x", "y", "zx", "xy", "zy"])
def test_a_sample_with_a_missing_axis_is_dropped_and_counted(lost: str) -> None:
    codec = AccelCodec(accel(unit="m/s2", fields=SPLIT))
    kept = "".join(a for a in "zxy" if a not in lost)
    rows = [f for k in range(8) for f in split(k, kept if k == 3 else "zxy")]
    samples, notes = run(codec, [frames(rows)])
    assert samples.xyz.tolist() == split_samples([0, 1, 2, 4, 5, 6, 7])
    assert samples.count.tolist() == [0, 1, 2, 4, 5, 6, 7]
    assert samples.flags.tolist() == [0, 0, 0, AccelFlag.GAP_BEFORE, 0, 0, 0]
    assert codec.counters["incomplete"] == 1
    assert reasons(notes) == [("INCOMPLETE", len(kept))]


def test_two_axes_in_one_message_and_one_in_another() -> None:
    fields = (SignalField(0x40, 0, 16), SignalField(0x41, 0, 16), SignalField(0x40, 16, 16))
    rows = []
    for k in range(3):
        rows.append(Frame(T0 + k * MS, 0x40, struct.pack("<2h", k, 20 + k)))
        rows.append(Frame(T0 + k * MS + 1, 0x41, struct.pack("<h", 10 + k)))
    samples, _ = run(AccelCodec(accel(unit="m/s2", fields=fields)), [frames(rows)])
    assert samples.xyz.tolist() == [[k, 10 + k, 20 + k] for k in range(3)]


def test_which_message_begins_a_set_is_learned_from_the_pauses() -> None:
    """GIVEN a device whose lowest identifier (z) is sent last. THEN after the first sets a sample has one time only."""
    ids = {"x": 0x31, "y": 0x32, "z": 0x30}
    rows = []
    for k in range(60):
        for n, axis in enumerate("xyz"):
            rows.append(Frame(T0 + k * 10 * MS + n * MS // 4, ids[axis], struct.pack("<h", k)))
    codec = AccelCodec(accel(unit="m/s2", fields=SPLIT))
    samples, _ = run(codec, [frames(rows)])
    one_time = np.ptp(samples.xyz, axis=1) == 0.0
    assert one_time[30:].all()
    assert not one_time[5]  # what the learning is worth
    assert codec.counters["incomplete"] <= 2  # one at the beginning, one where the view changes


def test_frames_of_two_samples_never_make_one() -> None:
    """GIVEN a learned period. WHEN a long loss ends just where the order would fit. THEN no sample is made of it."""
    rows = [f for k in range(40) for f in split(k)]
    rows += split(40, "z") + split(49, "xy") + [f for k in range(50, 55) for f in split(k)]
    codec = AccelCodec(accel(unit="m/s2", fields=SPLIT))
    samples, _ = run(codec, [frames(rows)])
    assert samples.xyz.tolist() == split_samples([*range(40), *range(50, 55)])
    assert codec.counters["incomplete"] == 2


def keyed() -> AccelerometerSettings:
    text = 'VERSION ""\nBU_: A\n'
    for can_id, axis in ((0x31, "X"), (0x32, "Y"), (0x30, "Z")):
        text += f"BO_ {can_id} M{axis}: 3 A\n"
        text += f' SG_ {axis} : 0|16@1- (0.001,0) [0|0] "m/s2" A\n SG_ N : 16|4@1+ (1,0) [0|0] "" A\n'
    return accel(unit="m/s2", fields=None, signals=("X", "Y", "Z"), dbc_text=text, counter="N")


def test_a_counter_in_each_message_matches_them() -> None:
    rows = [f for k in range(40) for f in split(k, counter=k % 16)]
    del rows[3 * 20 + 2], rows[3 * 10]  # y of sample 20, z of sample 10
    rows.insert(4, rows[4])  # a frame sent twice
    codec = AccelCodec(keyed())
    samples, notes = run(codec, [frames(rows)])
    good = [k for k in range(40) if k not in (10, 20)]
    assert samples.count.tolist() == good
    assert samples.xyz.tolist() == split_samples(good)
    assert reasons(notes) == [("INCOMPLETE", 4)]
    assert (codec.counters["duplicates"], codec.counters["lost"], codec.counters["incomplete"]) == (1, 2, 2)


def test_a_counter_in_one_of_three_messages_numbers_the_samples() -> None:
    codec = AccelCodec(accel(unit="m/s2", fields=SPLIT, counter=SignalField(0x32, 16, 4)))
    rows = [f for k in (0, 1, 2, 5, 6) for f in split(k, counter=k)]
    samples, _ = run(codec, [frames(rows)])
    assert samples.count.tolist() == [0, 1, 2, 5, 6]
    assert samples.flags.tolist() == [0, 0, 0, AccelFlag.GAP_BEFORE, 0]


def test_the_kernel_dropped_frames_and_no_counter_tells_whose() -> None:
    rows = [triple(T0 + k * 10 * MS, (k, 0, 0)) for k in (0, 1, 2, 5, 6, 7)]
    samples, _ = run(AccelCodec(accel()), [frames(rows, dropped=9)])
    assert samples.flags.tolist() == [0] * 6  # the first block: nothing to compare with
    codec = AccelCodec(accel())
    samples, _ = run(codec, [frames(rows[:1]), frames(rows[1:], dropped=9)])
    assert samples.flags.tolist() == [0, 0, 0, AccelFlag.GAP_BEFORE, 0, 0]
    even = [triple(T0 + k * 10 * MS, (k, 0, 0)) for k in range(6)]
    samples, _ = run(AccelCodec(accel()), [frames(even[:1]), frames(even[1:], dropped=9)])
    assert not samples.flags.any()  # somebody else's frames


# -------------------------------------------------------------------------------------------------- cuts, save, load


def traffic(seed: int, shape: str) -> tuple[AccelerometerSettings, list[Frame]]:
    """A messy bus: lost, doubled, short, remote and foreign frames, pauses, drain stamps, a wrapping counter."""
    rng = random.Random(seed)
    if shape == "one":
        config = accel(counter=dataclasses.replace(COUNTER, length=4), rate_hz=100.0, range_mps2=9.0)
    elif shape == "plain":
        config = accel()
    elif shape == "order":
        config = accel(fields=SPLIT)
    else:
        config = keyed()
    rows: list[Frame] = []
    t = T0
    for k in range(rng.randrange(20, 120)):
        if shape in ("one", "plain"):
            parts = [triple(t, (rng.randrange(-2000, 2000), k, -k), k % 16)]
        else:
            parts = [dataclasses.replace(f, t_ns=t + n * MS // 4) for n, f in enumerate(split(k, counter=k % 16))]
        for f in parts:
            dice = rng.random()
            if dice < 0.03:
                continue
            if dice < 0.05:
                f = dataclasses.replace(f, data=f.data[:1])
            elif dice < 0.06:
                f = dataclasses.replace(f, flags=int(CanFlag.RTR))
            elif dice < 0.08:
                f = dataclasses.replace(f, flags=int(CanFlag.DRAIN))
            rows.append(f)
            if dice > 0.97:
                rows.append(f)
            if dice > 0.95:
                rows.append(Frame(f.t_ns, 0x555, b"other"))
        t += 10 * MS if rng.random() > 0.03 else rng.randrange(20, 400) * MS
    return config, rows


SHAPES = ("one", "plain", "order", "keyed")


@pytest.mark.parametrize("shape", SHAPES)
@settings(deadline=None, max_examples=40, derandomize=True)
@given(seed=st.integers(0, 10_000), places=st.lists(st.integers(0, 300), max_size=30), at=st.integers(0, 31))
def test_any_cut_gives_the_same_samples_and_a_loaded_codec_goes_on(
    shape: str, seed: int, places: list[int], at: int
) -> None:
    config, rows = traffic(seed, shape)
    block = frames(rows)
    whole_codec = AccelCodec(config)
    whole, _ = run(whole_codec, [block])

    pieces = cut(block, [min(p, len(rows)) for p in places])
    codec = AccelCodec(config)
    first, _ = run(codec, pieces[:at])
    state = pack(codec.save())
    fresh = AccelCodec(config)
    fresh.load(unpack(state))
    assert pack(fresh.save()) == state
    second, _ = run(fresh, pieces[at:])
    assert np.concatenate([first.xyz, second.xyz]).tobytes() == whole.xyz.tobytes()
    assert np.concatenate([first.t_ns, second.t_ns]).tobytes() == whole.t_ns.tobytes()
    assert np.concatenate([first.count, second.count]).tobytes() == whole.count.tobytes()
    assert np.concatenate([first.flags, second.flags]).tobytes() == whole.flags.tobytes()
    assert pack(fresh.save()) == pack(whole_codec.save())


@pytest.mark.parametrize("shape", SHAPES)
def test_the_messy_bus_is_messy(shape: str) -> None:
    """Else the test above would prove little."""
    total = dict.fromkeys(COUNTERS, 0)
    for seed in range(30):
        config, rows = traffic(seed, shape)
        codec = AccelCodec(config)
        run(codec, [frames(rows)])
        total = {k: v + codec.counters[k] for k, v in total.items()}
    expected = {"frames", "accepted", "rejected", "samples", "gaps", "lost"}
    expected |= {
        "one": {"duplicates", "saturated"},
        "keyed": {"duplicates", "incomplete"},
        "order": {"incomplete"},
    }.get(shape, set())
    assert expected <= {k for k, v in total.items() if v}


def test_the_state_of_another_kind_of_accelerometer_is_refused() -> None:
    with pytest.raises(ValueError, match="accelerometer with other messages"):
        AccelCodec(accel()).load(AccelCodec(accel(fields=SPLIT)).save())


def test_the_rotation_gives_the_same_bits_for_one_sample_as_for_many() -> None:
    rng = random.Random(5)
    half = math.sqrt(0.5)
    rotation = ((half, -half, 0.0), (half, half, 0.0), (0.0, 0.0, 1.0))
    rows = [triple(T0 + k, tuple(rng.randrange(-9999, 9999) for _ in "xyz"), k % 256) for k in range(257)]  # type: ignore[arg-type]
    one, _ = run(AccelCodec(accel(rotation=rotation)), [frames([r]) for r in rows])
    many, _ = run(AccelCodec(accel(rotation=rotation)), [frames(rows)])
    assert one.xyz.tobytes() == many.xyz.tobytes()
    r = np.array(rotation)
    for row, xyz in zip(rows, many.xyz.tolist(), strict=True):
        raw = [v * 0.001 * GRAVITY_MPS2 for v in struct.unpack("<3h", row.data[:6])]
        assert xyz == [raw[0] * r[i, 0] + raw[1] * r[i, 1] + raw[2] * r[i, 2] for i in range(3)]


# -------------------------------------------------------------------------------------------- mistakes in the settings


def broken(field: int, **changes: Any) -> tuple[SignalField, ...]:
    return tuple(dataclasses.replace(f, **changes) if k == field else f for k, f in enumerate(TRIPLE))


def cases() -> Iterator[tuple[dict[str, Any], str]]:
    dbc: dict[str, Any] = {"fields": None, "dbc": "site.dbc", "dbc_text": DBC}
    good = ("Both.X", "Both.Y", "Both.Z")
    yield (
        dbc | {"signals": ("Both.X", "Both.Y", "Up")},
        r"no signal 'Up'; signals of message Both: X, Y, Z, Alive, Same",
    )
    yield dbc | {"signals": ("Both.X", "Both.Y", "Both.Up")}, "no signal 'Up'; signals of message Both: X, Y, Z"
    yield dbc | {"signals": ("B.X", "Both.Y", "Both.Z")}, r"no message 'B'; there are: Both \(0x64\), Other \(0x65\)"
    yield (
        dbc | {"signals": ("X", "Y", "Z")},
        r"'X' is ambiguous; write one of: 0x64\.X \(Both\.X\), 0x65\.X \(Other\.X\)",
    )
    yield dbc | {"signals": good[:2]}, "three signals are needed, x, y and z; there are 2"
    yield dbc | {"signals": ("Both.X", "Both.Y", "Both.Y")}, "y and z are the same signal"
    yield dbc | {"signals": good, "unit": "m/s2"}, "Both.X is in 'g' by the DBC file, unit says 'm/s2': write unit: g"
    yield dbc | {"signals": good, "counter": "Nope"}, "no signal 'Nope'; signals of message Both"
    yield dbc | {"signals": good, "counter": "Other.Same"}, "no signal 'Same'"
    yield (
        dbc | {"signals": good, "counter": SignalField(9, 0, 8)},
        r"must be in a message that carries an axis \(0x64\)",
    )
    yield dbc | {"signals": good, "counter": SignalField(100, 0, 40)}, "an integer of at most 32 bits"
    yield dbc | {"signals": good, "dbc_text": "BO_ nonsense"}, "site.dbc: not a DBC file"
    yield dbc | {"signals": good, "dbc_text": ""}, "no dbc file that says where they are"
    yield dbc | {"signals": good, "fields": TRIPLE}, "either dbc and signals, or fields"
    yield {"fields": None}, "either dbc and signals, or fields"
    yield {"counter": "Alive"}, "no dbc file"
    yield {"unit": "ft/s2"}, "unit 'ft/s2' is not known; there are: m/s2, g, mg, gal"
    yield {"rate_hz": 0.0}, "rate_hz 0.0 must be a positive number"
    yield {"range_mps2": -1.0}, "range -1.0 m/s2 must be a positive number"
    yield {"fields": broken(1, length=65)}, r"fields\[1\]: a length of 65 bits"
    yield {"fields": broken(2, start=510)}, r"fields\[2\]: bits 510 \+16 lie outside"
    yield {"fields": broken(2, start=-1)}, "lie outside"
    yield {"fields": broken(0, is_float=True, length=24)}, "a float has 16, 32 or 64 bits, not 24"
    yield {"fields": broken(0, byteorder="middle")}, "'middle' is neither little nor big"
    yield {"fields": broken(0, can_id=0x800)}, "identifier 0x800 does not fit, 0x7FF is the largest"
    yield {"fields": broken(0, scale=0.0)}, "scale 0.0 and offset 0.0 must be finite and scale not 0"
    yield {"rotation": ((1.0, 0.0), (0.0, 1.0))}, "three rows of three numbers"
    yield {"rotation": ((2.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, r"row 0 has length 2\.000"
    yield {"rotation": ((1.0, 0.0, 0.0), (0.6, 0.8, 0.0), (0.0, 0.0, 1.0))}, "rows 0 and 1 lean"
    yield {"rotation": ((math.nan, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "rotation is not one"


@pytest.mark.parametrize(("changes", "text"), list(cases()))
def test_a_mistake_says_what_exists(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        AccelCodec(accel(**changes))


def test_a_message_may_be_named_by_its_identifier() -> None:
    specs = Dbc(DBC, "site.dbc").find("0x65.X")
    assert [(s.can_id, s.name) for s in specs] == [(101, "Other.X")]
