"""Which frames are whose: J1939, multiplexed messages, SYNC, and who has fallen silent."""

from __future__ import annotations

import dataclasses
import random
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest
from can_play import T0, Frame, accel, balance, cut, frames, reasons, run, triple
from cantools import j1939
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.can_assembly import Message
from drivers.can_signals import Dbc, by_pgn, compile_signal
from drivers.dbc_codec import GRAVITY_MPS2, AccelCodec
from edge_agent.messages import MS, AccelBlock, AccelerometerSettings, AccelFlag, CanFlag, Event, Reject, S, SignalField
from edge_agent.state import pack, unpack

EXT = int(CanFlag.EXT)
GAP = int(AccelFlag.GAP_BEFORE)

# --------------------------------------------------------------------------------------------------------------- J1939

PGN = tuple(SignalField(0, 16 * k, 16, scale=0.5, pgn=0xFF34) for k in range(3))


def j1939_id(priority: int, pgn: int, source: int, destination: int = 0) -> int:
    """By cantools, from the fields of J1939-21."""
    p = j1939.pgn_unpack(pgn)
    specific = p.pdu_specific if j1939.is_pdu_format_1(p.pdu_format) is False else destination
    return int(j1939.frame_id_pack(priority, p.reserved, p.data_page, p.pdu_format, specific, source))


def pgn_frame(t_ns: int, can_id: int, xyz: tuple[int, int, int] = (2, 4, 6)) -> Frame:
    return Frame(t_ns, can_id, struct.pack("<3h", *xyz) + b"\xff\xff", EXT)


@settings(deadline=None, max_examples=300, derandomize=True)
@given(
    can_id=st.integers(0, (1 << 29) - 1),
    flips=st.integers(0, (1 << 29) - 1),
    keep=st.sampled_from([0, 0xFF, 0x1C0000FF, 0x1C00FFFF, 0x0300FF00, 0x1FFFFFFF]),
)
def test_a_pgn_is_matched_as_cantools_takes_identifiers_apart(can_id: int, flips: int, keep: int) -> None:
    """Any identifier and one that differs from it in some bits: they match exactly if their PGNs are equal."""
    other = can_id ^ (flips & keep)
    spec = by_pgn(compile_signal("s", SignalField(can_id, 0, 8, extended=True)), None)
    message = Message([(0, spec)], None, True)
    same = j1939.pgn_from_frame_id(can_id) == j1939.pgn_from_frame_id(other)
    assert message.places(np.array([other], np.uint32)).size == same
    source = j1939.frame_id_unpack(other).source_address
    told = Message([(0, by_pgn(spec, source))], None, True)
    assert told.places(np.array([other, other ^ 1], np.uint32)).tolist() == ([0] if same else [])


def test_frames_of_a_pgn_have_any_priority_and_are_told_apart_by_their_source() -> None:
    """GIVEN two sensors that send the same PGN. THEN each is read by its address, whatever the priority."""
    rows = [
        pgn_frame(T0 + k * MS, j1939_id(prio, 0xFF34, source), (source, k, 0))
        for k, (prio, source) in enumerate([(3, 8), (3, 9), (6, 8), (0, 9), (7, 8)])
    ]
    rows += [
        pgn_frame(T0 + 10 * MS, j1939_id(3, 0xFF35, 8)),  # another PGN
        pgn_frame(T0 + 11 * MS, j1939_id(3, 0x1FF34, 8)),  # another data page
        dataclasses.replace(pgn_frame(T0 + 12 * MS, j1939_id(3, 0xFF34, 8) & 0x7FF), flags=0),
    ]
    for source, places in ((8, [0, 2, 4]), (9, [1, 3])):
        codec = AccelCodec(accel(unit="m/s2", fields=PGN, source_address=source))
        samples, notes = run(codec, cut(frames(rows), [2, 3]))
        assert notes == []
        assert samples.xyz.tolist() == [[source * 0.5, k * 0.5, 0.0] for k in places]
        assert codec.counters["frames"] == len(places)


def test_two_sources_of_one_pgn_are_never_mixed() -> None:
    """GIVEN no source address. THEN the first that came is taken, and the other refused with both addresses."""
    rows = [pgn_frame(T0 + k * MS, j1939_id(3, 0xFF34, 8 + k % 2), (8 + k % 2, 0, 0)) for k in range(7)]
    foreign = [pgn_frame(T0 - 1, j1939_id(3, 0xFF30, 5)), dataclasses.replace(rows[1], t_ns=T0 - 1, flags=0)]
    for places in ([], [1, 2, 3], list(range(9))):
        codec = AccelCodec(accel(unit="m/s2", fields=PGN))
        samples, notes = run(codec, cut(frames([*foreign, *rows]), places))
        assert samples.xyz[:, 0].tolist() == [4.0] * 4
        assert sum(n.count for n in notes if isinstance(n, Reject)) == codec.counters["rejected"] == 3
        assert {r for r, _ in reasons(notes)} == {"SOURCE"}
        note = notes[0]
        assert isinstance(note, Reject)
        assert "PGN 0xFF34 comes from source address 0x09 too; 0x08 came first" in note.detail
        assert "source_address: 0x08 or 0x09" in note.detail


def test_axes_in_two_pgns_come_from_one_source() -> None:
    """x from one sensor and y, z from another would be such a mix; the earliest frame decides, in whatever message."""
    fields = (dataclasses.replace(PGN[0], pgn=0xFF30), *PGN[1:])
    rows = []
    for k in range(6):
        for source in (8, 9):  # 8 comes first, and with the PGN of y and z
            t = T0 + k * 10 * MS + source * MS // 10
            rows.append(pgn_frame(t, j1939_id(3, 0xFF34, source), (0, source, source)))
            rows.append(pgn_frame(t + MS, j1939_id(3, 0xFF30, source), (source, 0, 0)))
    rows.sort(key=lambda f: f.t_ns)
    for places in ([], list(range(len(rows)))):
        codec = AccelCodec(accel(unit="m/s2", fields=fields))
        samples, _ = run(codec, cut(frames(rows), places))
        assert samples.xyz.tolist() == [[4.0] * 3] * 5  # the first set begins in the middle
        assert codec.counters["rejected"] == 12 + 1


def test_pdu1_goes_to_any_destination() -> None:
    """Below PDU format 240 the third byte is whom it is for, and no part of the PGN."""
    fields = tuple(dataclasses.replace(f, pgn=0xEF00) for f in PGN)
    rows = [pgn_frame(T0 + d, j1939_id(6, 0xEF00, 8, d), (d, 0, 0)) for d in (0, 0x21, 0xFF)]
    rows.append(pgn_frame(T0 + 300, j1939_id(6, 0xEE00, 8, 0xFF)))
    samples, notes = run(AccelCodec(accel(unit="m/s2", fields=fields)), [frames(rows)])
    assert samples.xyz[:, 0].tolist() == [0.0, 0x21 / 2, 0xFF / 2]
    assert notes == []


def test_a_dbc_file_that_says_j1939_is_matched_by_pgn(shared_data: Path) -> None:
    """D3 does not say so: exact, until a source address is given; then by PGN. A file with VFrameFormat: by PGN."""
    text = (shared_data / "D3-hipnuc-imu-dbc" / "J1939.dbc").read_text()
    names = tuple(f"PGN65332_FF34_Accel.Acc_{axis}" for axis in "XYZ")
    rows = [
        pgn_frame(T0 + k, j1939_id(prio, 65332, sa), (k, 0, 0)) for k, (prio, sa) in enumerate([(3, 8), (6, 8), (3, 9)])
    ]

    def taken(text: str, **changes: Any) -> list[int]:
        codec = AccelCodec(accel(fields=None, signals=names, dbc="J1939.dbc", dbc_text=text, **changes))
        samples, _ = run(codec, [frames(rows)])
        return [round(v / 0.00048828 / GRAVITY_MPS2) for v in samples.xyz[:, 0]]

    assert taken(text) == [0]
    assert taken(text, source_address=8) == [0, 1]
    assert taken(text, source_address=9) == [2]
    marked = text + (
        '\nBA_DEF_ BO_  "VFrameFormat" ENUM  "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_  "VFrameFormat" "ExtendedCAN";\nBA_ "VFrameFormat" BO_ 2365535240 3;\n'
    )
    assert taken(marked) == [0, 1]
    assert taken(marked, source_address=9) == [2]


def test_the_counter_of_a_pgn() -> None:
    fields = tuple(dataclasses.replace(f, pgn=0xFF34) for f in PGN)
    counter = SignalField(0, 48, 8, signed=False, pgn=0xFF34)
    rows = [
        dataclasses.replace(pgn_frame(T0 + k * MS, j1939_id(3, 0xFF34, 8)), data=bytes(6) + bytes([k, 0]))
        for k in (0, 1, 4)
    ]
    codec = AccelCodec(accel(fields=fields, counter=counter, source_address=8))
    samples, _ = run(codec, [frames(rows)])
    assert samples.count.tolist() == [0, 1, 4]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        (
            {"fields": tuple(dataclasses.replace(f, pgn=0xEF12) for f in PGN)},
            r"PGN 0xEF12 has a format below 240.*0xEF00",
        ),
        ({"fields": tuple(dataclasses.replace(f, pgn=0x40000) for f in PGN)}, "0x3FFFF is the largest"),
        ({"fields": PGN, "source_address": 254}, "source_address 254 must be from 0 to 253"),
        ({"source_address": 8}, "source_address is for J1939, whose identifiers have 29 bits"),
        ({"sync": 0x188}, "sync 0x188 is the identifier of a message that carries an axis"),
        ({"sync": 0x80, "counter": SignalField(0x188, 48, 8)}, "give either counter or sync"),
    ],
)
def test_a_mistake_says_what_would_be_right(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        AccelCodec(accel(**changes))


def test_two_codecs_know_what_they_share() -> None:
    eight, nine = (AccelCodec(accel(fields=PGN, source_address=s)) for s in (8, 9))
    anyone = AccelCodec(accel(fields=PGN))
    by_id = AccelCodec(accel(fields=tuple(SignalField(0x0CFF3408, f.start, 16, extended=True) for f in PGN)))
    assert eight.shared(nine) == []
    assert eight.shared(anyone) == ["PGN 0xFF34 from 0x08"]
    assert anyone.shared(by_id) == ["PGN 0xFF34"]
    assert by_id.shared(eight) == ["0xCFF3408"]
    assert nine.shared(by_id) == []
    elsewhere = AccelCodec(accel(fields=tuple(dataclasses.replace(f, start=f.start + 8) for f in PGN)))
    assert anyone.shared(elsewhere) == []


# ---------------------------------------------------------------------------------------------------------- multiplexed


def test_every_multiplexed_signal_is_in_the_frames_in_which_cantools_finds_it(shared_data: Path) -> None:
    """All multiplexed messages of D1, D3 and D5, random payloads with mostly small selectors."""
    rng = random.Random(11)
    seen = 0
    for path in sorted(shared_data.glob("D[135]-*/*.dbc")):
        text = path.read_text(encoding="cp1252")
        database: Any = cantools.database.load_string(text, "dbc", strict=False)
        for message in database.messages:
            if message.is_multiplexed():
                seen += compare_with_cantools(text, message, rng)
    assert seen > 40


def compare_with_cantools(text: str, message: Any, rng: random.Random) -> int:
    """The signals of a message, ours against cantools' on 600 random payloads; returns how many were seen in some."""
    payloads = [
        bytes(rng.randrange(256) & rng.choice((0xFF, 0x3F, 7, 3)) for _ in range(message.length)) for _ in range(600)
    ]
    decoded: list[dict[str, Any]] = []
    for payload in payloads:
        try:
            decoded.append(message.decode(payload, decode_choices=False, scaling=False))
        except cantools.database.errors.DecodeError:
            decoded.append({})  # no signals belong to this selector
    data = np.frombuffer(b"".join(p.ljust(8, b"\0") for p in payloads), np.uint8).reshape(len(payloads), -1)
    length = np.full(len(payloads), message.length, np.uint8)
    dbc = Dbc(text, "dbc")
    seen = 0
    for signal in message.signals:
        if signal.multiplexer_ids is None:
            continue
        ours = Message([(0, dbc.one(f"0x{message.frame_id:X}.{signal.name}"))], None, True)
        chosen = ours.chosen(data, length)
        raw = ours.decoder.raw(data, length)[:, 0]
        for k, values in enumerate(decoded):
            if not values:
                continue
            assert chosen[k] == (signal.name in values), (message.name, signal.name, payloads[k].hex())
            if chosen[k]:
                assert raw[k] == values[signal.name]
        seen += bool(chosen.any())
    return seen


EXTENDED = """VERSION ""
BU_: A
BO_ 102 Chosen: 8 A
 SG_ Kind M : 0|4@1+ (1,0) [0|0] "" A
 SG_ Axis m3M : 4|4@1+ (1,0) [0|0] "" A
 SG_ X m1 : 8|16@1- (0.5,0) [0|0] "m/s2" A
 SG_ Y m2 : 8|16@1- (0.5,0) [0|0] "m/s2" A
 SG_ Z m4 : 31|16@0- (0.5,0) [0|0] "m/s2" A
 SG_ Other m0 : 8|16@1- (1,0) [0|0] "" A
 SG_ N : 48|8@1+ (1,0) [0|0] "" A
SG_MUL_VAL_ 102 Axis Kind 3-3, 5-5;
SG_MUL_VAL_ 102 X Axis 1-1, 9-11;
SG_MUL_VAL_ 102 Y Axis 2-2;
SG_MUL_VAL_ 102 Z Axis 4-4;
SG_MUL_VAL_ 102 Other Kind 0-0;
"""


def chosen_frame(t_ns: int, kind: int, axis: int, value: int, n: int = 0) -> Frame:
    where = struct.pack(">h", value).rjust(4, b"\0")[1:] if axis == 4 else struct.pack("<h", value) + b"\0"
    body = bytes([kind | axis << 4]) + (b"\0\0" + struct.pack(">h", value) if axis == 4 else where)
    return Frame(t_ns, 102, body.ljust(6, b"\0") + bytes([n]) + b"\0")


def multiplexed(**changes: Any) -> AccelerometerSettings:
    return accel(unit="m/s2", fields=None, signals=("X", "Y", "Z"), dbc="site.dbc", dbc_text=EXTENDED, **changes)


def test_extended_multiplexing_as_cantools_decodes_it() -> None:
    database: Any = cantools.database.load_string(EXTENDED, "dbc", strict=False)
    assert compare_with_cantools(EXTENDED, database.messages[0], random.Random(3)) == 5


def test_axes_multiplexed_in_one_identifier_make_samples() -> None:
    """GIVEN x, y, z one after another in one identifier, other signals between. THEN they make one sample each."""
    rows = []
    for k in range(50):
        for n, axis in enumerate((9 + k % 3 if k % 2 else 1, 2, 4)):
            rows.append(chosen_frame(T0 + k * 10 * MS + n * MS, 5 if k % 2 else 3, axis, 10 * k + n))
        rows.append(chosen_frame(T0 + k * 10 * MS + 4 * MS, 0, 0, 999))  # not an acceleration
        rows.append(chosen_frame(T0 + k * 10 * MS + 5 * MS, 3, 6, 999))  # nobody's
    expected = [[(10 * k + n) / 2 for n in range(3)] for k in range(50)]
    for places in ([], list(range(0, 250, 7))):
        codec = AccelCodec(multiplexed())
        samples, notes = run(codec, cut(frames(rows), places))
        assert samples.xyz.tolist() == expected
        assert samples.t_ns.tolist() == [T0 + k * 10 * MS + 2 * MS for k in range(50)]
        assert notes == []
        assert codec.counters["frames"] == 150
    del rows[20 * 5 + 1]  # y of sample 20
    codec = AccelCodec(multiplexed())
    samples, notes = run(codec, [frames(rows)])
    assert samples.xyz.tolist() == expected[:20] + expected[21:]
    assert reasons(notes) == [("INCOMPLETE", 2)]
    assert "0x66, Kind 3, 5, Axis 2 (y)" in str(notes[0])


def test_a_multiplexed_frame_too_short_for_its_selector_is_refused_once() -> None:
    rows = [chosen_frame(T0 + n, 3, axis, n) for n, axis in enumerate((1, 2, 4))]
    rows += [Frame(T0 + 5, 102, b""), Frame(T0 + 6, 102, b"\x13\1"), Frame(T0 + 7, 102, bytes(8), int(CanFlag.RTR))]
    codec = AccelCodec(multiplexed())
    samples, notes = run(codec, [frames(rows)])
    assert len(samples.t_ns) == 1
    assert sorted(reasons(notes)) == [("RTR", 1), ("SHORT", 1), ("SHORT", 1)]
    assert codec.counters["frames"] == 6


def test_a_counter_beside_the_multiplexed_axes_matches_them() -> None:
    rows = []
    for k in range(20):
        rows += [chosen_frame(T0 + k * MS + n, 3, axis, k, n=k) for n, axis in enumerate((1, 2, 4))]
    del rows[3 * 7]
    codec = AccelCodec(multiplexed(counter="N"))
    samples, _ = run(codec, [frames(rows)])
    good = [k for k in range(20) if k != 7]
    assert samples.count.tolist() == good
    assert samples.xyz.tolist() == [[k / 2] * 3 for k in good]


# ----------------------------------------------------------------------------------------------------------------- SYNC

TPDO = (SignalField(0x188, 0, 16), SignalField(0x288, 0, 16), SignalField(0x388, 0, 16))


def sync(t_ns: int, counter: int | None = None) -> Frame:
    return Frame(t_ns, 0x80, b"" if counter is None else bytes([counter]))


def answers(k: int, axes: str = "xyz", late_ns: int = MS) -> list[Frame]:
    ids = {"x": 0x188, "y": 0x288, "z": 0x388}
    t = T0 + 10 * MS * k + late_ns
    return [Frame(t + n, ids[a], struct.pack("<h", 3 * k + "xyz".index(a))) for n, a in enumerate(axes)]


def triggered(**changes: Any) -> AccelerometerSettings:
    return accel(**({"unit": "m/s2", "fields": TPDO, "sync": 0x80} | changes))


def test_a_sample_has_the_time_of_its_sync_in_whatever_order_it_is_answered() -> None:
    rng = random.Random(1)
    rows: list[Frame] = []
    for k in range(30):
        order = "".join(rng.sample("xyz", 3))
        rows += [sync(T0 + 10 * MS * k), *answers(k, order, rng.randrange(MS, 9 * MS))]
    for places in ([], list(range(0, 120, 5)), list(range(120))):
        codec = AccelCodec(triggered())
        samples, notes = run(codec, cut(frames(rows), places))
        assert samples.t_ns.tolist() == [T0 + 10 * MS * k for k in range(30)]
        assert samples.xyz.tolist() == [[3 * k, 3 * k + 1, 3 * k + 2] for k in range(30)]
        assert samples.count.tolist() == list(range(30))
        assert notes == []
        assert codec.counters["frames"] == codec.counters["accepted"] == 90  # a SYNC is nobody's


def test_a_missing_answer_is_an_incomplete_sample_and_none_a_lost_one() -> None:
    rows: list[Frame] = [answers(0)[0]]  # before any SYNC
    for k in range(1, 10):
        rows += [sync(T0 + 10 * MS * k), *answers(k, {3: "xz", 5: "", 6: ""}.get(k, "xyz"))]
    codec = AccelCodec(triggered())
    samples, notes = run(codec, [frames(rows)])
    assert samples.xyz[:, 0].tolist() == [3.0 * k for k in (1, 2, 4, 7, 8, 9)]
    assert samples.count.tolist() == [0, 1, 3, 6, 7, 8]
    assert samples.flags.tolist() == [0, 0, GAP, GAP, 0, 0]
    assert codec.counters["incomplete"] == 2
    assert codec.counters["lost"] == 3
    assert reasons(notes) == [("INCOMPLETE", 3)]
    assert "SYNC 0x80" in str(notes[0])


def test_a_lost_sync_makes_no_false_sample() -> None:
    """Answers to a SYNC that was not seen: refused, not given the time of the one before."""
    rows: list[Frame] = []
    for k in range(6):
        rows += ([] if k == 3 else [sync(T0 + 10 * MS * k)]) + answers(k)
    codec = AccelCodec(triggered())
    samples, notes = run(codec, [frames(rows)])
    assert samples.xyz[:, 0].tolist() == [0.0, 3.0, 6.0, 12.0, 15.0]
    assert samples.t_ns.tolist() == [T0 + 10 * MS * k for k in (0, 1, 2, 4, 5)]
    assert reasons(notes) == [("INCOMPLETE", 3)]
    assert "no frame SYNC 0x80" in str(notes[0])


def test_the_syncs_counter_numbers_the_samples() -> None:
    """1 to 7 and again, as CiA 301 counts; lost SYNCs show once a turn has been seen."""
    rows: list[Frame] = []
    for k in range(40):
        if k not in (12, 13, 25):
            rows += [sync(T0 + 10 * MS * k, k % 7 + 1), *answers(k)]
    for places in ([], list(range(0, 148, 3))):
        codec = AccelCodec(triggered())
        samples, _ = run(codec, cut(frames(rows), places))
        assert samples.count.tolist() == [k for k in range(40) if k not in (12, 13, 25)]
        assert codec.counters["lost"] == 3


def test_one_tpdo_with_all_axes_and_a_sync() -> None:
    rows = []
    for k in range(5):
        rows += [sync(T0 + k * MS), triple(T0 + k * MS + MS // 2, (k, k, k))]
    rows.insert(3, Frame(T0 + MS + 1, 0x80, b"", EXT))  # another protocol's
    rows.insert(3, Frame(T0 + MS + 1, 0x80, bytes(8), int(CanFlag.ERR)))
    samples, _ = run(AccelCodec(accel(unit="m/s2", sync=0x80)), [frames(rows)])
    assert samples.t_ns.tolist() == [T0 + k * MS for k in range(5)]
    assert np.allclose(samples.xyz[:, 0], [k * 0.001 for k in range(5)])


# ----------------------------------------------------------------------------------------------------------- time-out


def told(codec: AccelCodec, rows: Sequence[Frame], ticks: Sequence[int]) -> list[Event]:
    """Frames and ticks in the order of their times: the events about silence."""
    found: list[Event] = []
    for t, row in sorted([(r.t_ns, r) for r in rows] + [(t, None) for t in ticks], key=lambda p: (p[0], p[1] is None)):
        if row is None:
            found += codec.silent(t)
        else:
            found += [n for n in codec.feed(frames([row]))[1] if isinstance(n, Event)]
    return [e for e in found if e.kind.startswith("ACCEL_SILENT")]


def test_one_of_three_messages_that_stops_is_named_with_its_period() -> None:
    rows = [f for k in range(100) for f in answers(k)]
    rows += [f for k in range(100, 1000) for f in answers(k, "xz")]
    rows += [f for k in range(1000, 1010) for f in answers(k)]
    events = told(AccelCodec(triggered(sync=None)), rows, [T0 + k * S for k in range(11)])
    begin, end = events
    assert (begin.kind, begin.source, begin.t_ns) == ("ACCEL_SILENT", "imu", T0 + 3 * S)
    assert begin.begin_ns == T0 + 99 * 10 * MS + MS + 1
    assert begin.text == "no frame 0x288 (y) for 2.0 s; it came every 10 ms"
    assert dict(begin.values) == {"silent_s": pytest.approx(2.009, abs=1e-3), "period_s": pytest.approx(0.01)}
    assert (end.kind, end.t_ns) == ("ACCEL_SILENT_END", T0 + 10 * S + MS + 1)


def test_a_slow_message_has_a_long_patience() -> None:
    rows = [triple(T0 + k * S // 2, (1, 2, 3)) for k in range(80)]  # 2 Hz: ten periods are 5 s
    last = rows[-1].t_ns
    events = told(AccelCodec(accel()), rows, [last + k * S for k in range(1, 9)])
    assert [(e.kind, e.t_ns) for e in events] == [("ACCEL_SILENT", last + 6 * S)]


def test_a_silent_sync_is_told_too_and_nothing_before_the_period_is_known() -> None:
    rows: list[Frame] = []
    for k in range(100):
        rows += [sync(T0 + 10 * MS * k)] * (k < 70) + answers(k)
    ticks = [T0 + k * S for k in range(9)]
    assert told(AccelCodec(triggered()), rows[:30], ticks) == []
    events = told(AccelCodec(triggered()), rows, ticks)
    assert [e.text.split(" for ")[0] for e in events] == [
        f"no frame {n}" for n in ("0x188 (x)", "0x288 (y)", "0x388 (z)", "SYNC 0x80")
    ]


# --------------------------------------------------------------------------------------------------- cuts, save, load


def traffic(seed: int, shape: str) -> tuple[AccelerometerSettings, list[Frame]]:
    """A messy bus: lost, doubled, short and foreign frames."""
    rng = random.Random(seed)
    rows: list[Frame] = []
    for k in range(rng.randrange(30, 130)):
        t = T0 + 10 * MS * k
        if shape == "sync":
            config = triggered()
            part = [sync(t, k % 9 + 1 if seed % 2 else None), *answers(k, "".join(rng.sample("xyz", 3)))]
        elif shape == "mux":
            config = multiplexed()
            part = [chosen_frame(t + n * MS, rng.choice((3, 5)), axis, k) for n, axis in enumerate((1, 2, 4))]
        else:
            config = accel(fields=(dataclasses.replace(PGN[0], pgn=0xFF30), *PGN[1:]))
            source = rng.choice((8, 8, 8, 9))
            part = [pgn_frame(t + n * MS, j1939_id(n, p, source), (k, k, k)) for n, p in enumerate((0xFF30, 0xFF34))]
        for f in part:
            dice = rng.random()
            if dice < 0.04:
                continue
            rows.append(dataclasses.replace(f, data=f.data[:1]) if dice < 0.06 else f)
            if dice > 0.96:
                rows.append(f)
    return config, rows


@pytest.mark.parametrize("shape", ["sync", "mux", "j1939"])
@settings(deadline=None, max_examples=25, derandomize=True)
@given(seed=st.integers(0, 10_000), places=st.lists(st.integers(0, 400), max_size=30), at=st.integers(0, 31))
def test_any_cut_gives_the_same_samples_and_a_loaded_codec_goes_on(
    shape: str, seed: int, places: list[int], at: int
) -> None:
    config, rows = traffic(seed, shape)
    whole_codec = AccelCodec(config)
    whole, _ = run(whole_codec, [frames(rows)])
    pieces = cut(frames(rows), [min(p, len(rows)) for p in places])
    codec = AccelCodec(config)
    first, _ = run(codec, pieces[:at])
    fresh = AccelCodec(config)
    fresh.load(unpack(pack(codec.save())))
    second, _ = run(fresh, pieces[at:])
    for name in ("t_ns", "xyz", "flags", "count"):
        parts = [getattr(b, name) for b in (first, second)]
        assert np.concatenate(parts).tobytes() == getattr(whole, name).tobytes()
    assert pack(fresh.save()) == pack(whole_codec.save())
    assert balance(fresh)


def test_the_messy_bus_is_messy() -> None:
    """Else the test above would prove little."""
    for shape in ("sync", "mux", "j1939"):
        total = dict.fromkeys(("samples", "rejected", "incomplete", "lost"), 0)
        for seed in range(10):
            config, rows = traffic(seed, shape)
            codec = AccelCodec(config)
            block: AccelBlock = run(codec, [frames(rows)])[0]
            assert len(block.t_ns) == codec.counters["samples"]
            total = {k: v + codec.counters[k] for k, v in total.items()}
        assert min(total.values()) > 0, shape
