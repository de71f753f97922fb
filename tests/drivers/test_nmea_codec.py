"""NmeaCodec: any cut, any garbage, every reject, the calendar, and other people's recordings against a regex oracle."""

from __future__ import annotations

import binascii
import calendar
import gzip
import math
import random
import re
import zlib
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.binary_frames import FRAME_LIMIT
from drivers.nmea_codec import NmeaCodec
from edge_agent.messages import Event, GnssFix, GnssHeading, Quality, Reject, S
from edge_agent.state import pack, unpack

DAY = 86400 * S
Out = list[GnssFix | GnssHeading | Reject | Event]


def sentence(body: str, end: str = "\r\n") -> bytes:
    check = 0
    for c in body.encode():
        check ^= c
    return f"${body}*{check:02X}{end}".encode()


def gga(
    time: str = "084706.30",
    quality: str = "4",
    *,
    talker: str = "GN",
    lat: str = "5102.0327346,N",
    lon: str = "01344.3752461,E",
    msl: str = "116.5089",
    separation: str = "43.9322",
) -> bytes:
    return sentence(f"{talker}GGA,{time},{lat},{lon},{quality},12,0.93,{msl},M,{separation},M,1.3,0486")


def gns(time: str = "084706.30", mode: str = "RR", talker: str = "GN") -> bytes:
    return sentence(f"{talker}GNS,{time},5102.0327346,N,01344.3752461,E,{mode},25,0.68,193.953,39.429,1.0,0486,V")


def gst(
    time: str = "084706.30", lat: str = "0.009", lon: str = "0.008", alt: str = "0.016", talker: str = "GN"
) -> bytes:
    return sentence(f"{talker}GST,{time},0.020,0.009,0.008,12.630,{lat},{lon},{alt}")


def rmc(time: str = "084706.30", date: str = "241126", status: str = "A", talker: str = "GN") -> bytes:
    return sentence(f"{talker}RMC,{time},{status},5102.0327346,N,01344.3752461,E,0.1,0.0,{date},,,A")


def zda(time: str = "084706.30", date: str = "24,11,2026") -> bytes:
    return sentence(f"GPZDA,{time},{date},00,00")


def ggk(
    time: str = "084706.30",
    quality: str = "3",
    *,
    date: str = "112426",
    lat: str = "5102.0327346,N",
    lon: str = "01344.3752461,E",
    height: str = "EHT160.4522",
) -> bytes:
    return sentence(f"PTNL,GGK,{time},{date},{lat},{lon},{quality},14,1.9,{height},M")


def vtg(course: str = "211.50", knots: str = "0.034", kmh: str = "0.063", mode: str = "D") -> bytes:
    return sentence(f"GNVTG,{course},T,,M,{knots},N,{kmh},K,{mode}")


def hdt(deg: str = "274.12", label: str = "T") -> bytes:
    return sentence(f"GPHDT,{deg},{label}")


def ths(deg: str = "244.28", mode: str = "A") -> bytes:
    return sentence(f"GNTHS,{deg},{mode}")


def avr(
    time: str = "084706.30",
    yaw: str = "+52.1531",
    quality: str = "3",
    *,
    tilt: str = "-0.0806,Tilt,,",
    baseline: str = "12.575",
) -> bytes:
    return sentence(f"PTNL,AVR,{time},{yaw},Yaw,{tilt},{baseline},{quality},1.4,16")


def utc(text: str) -> int:
    """ns of "2026-11-24 08:47:06.3"."""
    day, clock = text.split(" ")
    year, month, date = (int(x) for x in day.split("-"))
    hour, minute, second = clock.split(":")
    return calendar.timegm((year, month, date, int(hour), int(minute), 0)) * S + round(float(second) * 1e9)


def feed(
    *pieces: bytes, codec: NmeaCodec | None = None, hint: int = 0, step: int = S // 10, finish: bool = True
) -> Out:
    """One piece each `step` ns of host time, the hint running with it; then the end of the stream."""
    codec = codec or NmeaCodec()
    out: Out = []
    for i, piece in enumerate(pieces):
        out += codec.feed(i * step, piece, hint + i * step if hint else 0)
    return out + (codec.finish() if finish else [])


def fixes(out: Out) -> list[GnssFix]:
    return [x for x in out if isinstance(x, GnssFix)]


def headings(out: Out) -> list[GnssHeading]:
    return [x for x in out if isinstance(x, GnssHeading)]


def rejects(out: Out) -> list[Reject]:
    return [x for x in out if isinstance(x, Reject)]


def events(out: Out, kind: str | None = None) -> list[Event]:
    return [x for x in out if isinstance(x, Event) and kind in (None, x.kind)]


def ubx(payload: bytes, cls: int = 1, ident: int = 7) -> bytes:
    body = bytes((cls, ident)) + len(payload).to_bytes(2, "little") + payload
    a = b = 0
    for c in body:  # u-blox interface description, 8-bit Fletcher
        a = (a + c) & 255
        b = (b + a) & 255
    return b"\xb5b" + body + bytes((a, b))


def rtcm(payload: bytes) -> bytes:
    frame = b"\xd3" + len(payload).to_bytes(2, "big") + payload
    crc = 0
    for c in frame:  # bit by bit, not the codec's table
        crc ^= c << 16
        for _ in range(8):
            crc <<= 1
            if crc & 0x1000000:
                crc ^= 0x1864CFB
    return frame + crc.to_bytes(3, "big")


def sbf(payload: bytes) -> bytes:
    payload += bytes(-len(payload) % 4)
    rest = (4007).to_bytes(2, "little") + (8 + len(payload)).to_bytes(2, "little") + payload
    return b"$@" + binascii.crc_hqx(rest, 0).to_bytes(2, "little") + rest


def crc32_plain(data: bytes) -> bytes:
    crc = 0
    for c in data:  # NovAtel's manual, CalculateCRC32
        crc ^= c
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return crc.to_bytes(4, "little")


def novatel(payload: bytes) -> bytes:
    frame = b"\xaaD\x12\x1c" + bytes(4) + len(payload).to_bytes(2, "little") + bytes(18) + payload
    return frame + crc32_plain(frame)


def novatel_short(payload: bytes) -> bytes:
    frame = b"\xaaD\x13" + bytes((len(payload),)) + bytes(8) + payload
    return frame + crc32_plain(frame)


def unicore(payload: bytes) -> bytes:
    frame = b"\xaaD\xb5" + bytes(3) + len(payload).to_bytes(2, "little") + bytes(16) + payload
    return frame + crc32_plain(frame)


FRAMES = {
    "UBX": ubx,
    "RTCM3": rtcm,
    "SBF": sbf,
    "NovAtel": novatel,
    "NovAtel short": novatel_short,
    "Unicore": unicore,
}

# ------------------------------------------------------------------------------------------------------------- a fix


def test_every_field_of_a_fix() -> None:
    codec = NmeaCodec()
    out = codec.feed(5, rmc() + gga(), 0) + codec.feed(9, gst() + sentence("GNGSA,A,3" + "," * 12 + ",1.5,0.9,1.2"), 0)
    (fix,) = fixes(out + codec.finish())
    assert (fix.t_ns, fix.arrival_ns) == (0, 5)
    assert fix.utc_ns == utc("2026-11-24 08:47:06.3")
    assert fix.date_known
    assert fix.lat_deg == pytest.approx(51 + 2.0327346 / 60, abs=1e-13)
    assert fix.lon_deg == pytest.approx(13 + 44.3752461 / 60, abs=1e-13)
    assert fix.h_m == pytest.approx(116.5089 + 43.9322, abs=1e-12)
    assert fix.separation_m == 43.9322
    assert fix.quality is Quality.FIXED
    assert (fix.satellites, fix.hdop, fix.pdop, fix.vdop) == (12, 0.93, 1.5, 1.2)
    assert (fix.age_s, fix.station) == (1.3, "0486")
    assert fix.std_enu_m == (0.008, 0.009, 0.016)  # GST says latitude first
    minute = 1855.3  # metres on the equator
    east, north, up = fix.resolution_enu_m
    assert north == pytest.approx(minute * 1e-7, rel=1e-3)
    assert east == pytest.approx(north * math.cos(math.radians(51.034)), rel=1e-3)
    assert up == pytest.approx(1e-4)
    assert fix.sentences == ("RMC", "GGA", "GST")
    assert codec.counters["accepted"] == codec.counters["sentences"] == 4
    assert codec.counters["fixes"] == codec.counters["positions"] == 1
    assert (codec.last_sentence_ns, codec.last_position_ns) == (9, 5)


@pytest.mark.parametrize("talker", ["GP", "GN", "GL", "GA", "GB", "BD", "QZ", "XX"])
def test_any_talker(talker: str) -> None:
    assert len(fixes(feed(gga(talker=talker)))) == 1


def test_southwest_is_negative() -> None:
    (fix,) = fixes(feed(gga(lat="3351.5,S", lon="15112.25,W")))
    assert fix.lat_deg == pytest.approx(-(33 + 51.5 / 60))
    assert fix.lon_deg == pytest.approx(-(151 + 12.25 / 60))


def test_what_is_not_said_is_nan() -> None:
    out = feed(sentence("GPGGA,120000,5102.03,N,01344.37,E,1,,,100.1,M,,M,,"))
    (fix,) = fixes(out)
    assert math.isnan(fix.separation_m)
    assert math.isnan(fix.hdop)
    assert math.isnan(fix.age_s)
    assert all(math.isnan(x) for x in fix.std_enu_m)
    assert math.isnan(fix.pdop)
    assert (fix.station, fix.satellites, fix.h_m) == ("", 0, 100.1)
    assert [e.kind for e in events(out)] == ["NO_SEPARATION", "COARSE_GGA"]


@pytest.mark.parametrize("body", ["GPGGA,,,,,,0,,,,M,,M,,", "GNGGA,,,,,,0,00,99.99,,,,,,"])
def test_quality_0_without_anything_counts_but_is_no_position(body: str) -> None:
    codec = NmeaCodec()
    out = feed(sentence(body), codec=codec)
    (fix,) = fixes(out)
    assert len(out) == 1
    assert fix.quality is Quality.NONE
    assert (fix.utc_ns, fix.date_known) == (0, False)
    assert all(math.isnan(x) for x in (fix.lat_deg, fix.lon_deg, fix.h_m, *fix.resolution_enu_m))
    assert codec.counters["positions"] == 0
    assert codec.last_position_ns == -1
    assert codec.last_sentence_ns == 0


def test_quality_0_with_a_position() -> None:
    (fix,) = fixes(feed(gga(quality="0")))
    assert fix.quality is Quality.NONE
    assert fix.lat_deg > 51


@pytest.mark.parametrize(
    ("mode", "quality"),
    [
        ("RRNN", Quality.FIXED),
        ("FAN", Quality.FLOAT),
        ("AADN", Quality.DGNSS),
        ("A", Quality.SINGLE),
        ("NN", Quality.NONE),
        ("E", Quality.ESTIMATED),
        ("P", Quality.PPS),
        ("M", Quality.MANUAL),
        ("S", Quality.SIMULATED),
    ],
)
def test_gns_alone_is_a_fix(mode: str, quality: Quality) -> None:
    (fix,) = fixes(feed(gns(mode=mode)))
    assert fix.quality is quality
    assert fix.h_m == pytest.approx(193.953 + 39.429)
    assert fix.sentences == ("GNS",)


# ------------------------------------------------------------------------------------------------------------ epochs


def clock(i: int, hz: int = 10) -> str:
    total = i * (100 // hz)
    return f"0847{total // 100:02d}.{total % 100:02d}"


def test_the_first_epochs_end_at_the_next_then_the_learned_type_ends_them() -> None:
    codec = NmeaCodec()
    given_at = []
    for i in range(8):
        for piece in (gga(clock(i)), gst(clock(i))):
            for fix in fixes(codec.feed(i, piece, 0)):
                given_at.append((i, fix.sentences))
    # epochs 0 to 2 wait for the sentence that follows them; from then on GST, the last of three, ends its own
    assert given_at == [(i, ("GGA", "GST")) for i in (1, 2, 3, 3, 4, 5, 6, 7)]


@pytest.mark.parametrize(
    "order",
    [
        (gga, gst),
        (gst, gga),
        (rmc, gga, gst),
        (gga, gst, rmc),
        (zda, rmc, gst, gga),
        (gns, gga),
        (gga, gns),
        (rmc, gns, gga, gst, zda),
        (gst, gns, rmc, gga),
        (gns, gst),
    ],
)
def test_any_order_gives_one_fix_an_epoch(order: tuple[object, ...]) -> None:
    codec = NmeaCodec()
    out = feed(*(make(clock(i)) for i in range(12) for make in order), codec=codec)  # type: ignore[operator]
    got = fixes(out)
    assert len(got) == 12
    assert not rejects(out)
    step = [b.utc_ns - a.utc_ns for a, b in pairwise(got)]
    assert step == [S // 10] * 11
    if gst in order:
        assert all(f.std_enu_m == (0.008, 0.009, 0.016) for f in got)
    height = 160.4411 if gga in order else 233.382
    assert all(f.h_m == pytest.approx(height) for f in got)
    assert codec.counters["repeated_times"] == 0


def test_missing_sentences_leave_the_others_whole() -> None:
    pieces = []
    for i in range(30):
        if i % 7 != 3:
            pieces.append(gga(clock(i)))
        if i % 5 != 4:
            pieces.append(gst(clock(i)))
    got = fixes(feed(*pieces))
    want = [i for i in range(30) if i % 7 != 3]
    assert [f.utc_ns % S for f in got] == [i % 10 * S // 10 for i in want]
    assert len(got) == len(want)


def test_rmc_at_1_hz_between_gga_at_10_hz_delays_no_fix() -> None:
    codec = NmeaCodec()
    given_at = []
    for i in range(45):
        pieces = gga(clock(i)) + gst(clock(i)) + (rmc(clock(i)) if i % 10 == 0 else b"")
        given_at += [(i, f) for f in fixes(codec.feed(i, pieces, 0))]
    assert [i for i, _ in given_at] == [1, 2, 3, *range(3, 45)]
    assert all(f.date_known for _, f in given_at)
    assert all(f.std_enu_m[0] == 0.008 for _, f in given_at)


def test_gst_at_1_hz_serves_the_fixes_until_the_next_of_the_same_quality() -> None:
    pieces = []
    for i in range(60):
        pieces.append(gga(clock(i), "5" if i == 47 else "4"))
        if i % 10 == 0 and i < 50:
            pieces.append(gst(clock(i)))
    got = fixes(feed(*pieces))
    assert len(got) == 60
    known = [f.std_enu_m[0] == 0.008 for f in got]
    assert known[1:47] == [True] * 46
    assert known[47] is False  # another quality has another sigma
    assert known[48:56] == [True] * 8  # 1.5 s after 08:47:04.0
    assert known[56:] == [False] * 4


def test_a_changed_order_is_learned_again() -> None:
    first = [gga(clock(i)) for i in range(6)]
    then = [make(clock(i)) for i in range(6, 16) for make in (gga, gst)]
    got = fixes(feed(*first, *then))
    assert len(got) == 16
    assert all(f.sentences == ("GGA", "GST") for f in got[-8:])


def test_a_repeated_time_gives_each_gga_its_fix() -> None:
    codec = NmeaCodec()
    out = feed(*(p for _ in range(6) for p in (rmc("084706", status="V"), gga("084706", "0"))), codec=codec)
    assert len(fixes(out)) == 6
    assert codec.counters["repeated_times"] == 5


def test_gns_of_each_constellation_is_one_epoch() -> None:
    pieces = [gns(clock(i), talker=t) for i in range(6) for t in ("GN", "GP", "GL")]
    assert len(fixes(feed(*pieces))) == 6


def test_rmc_twice_in_an_epoch_parts_nothing() -> None:
    pieces = [p for i in range(6) for p in (gga(clock(i)), rmc(clock(i)), rmc(clock(i)), gst(clock(i)))]
    got = fixes(feed(*pieces))
    assert len(got) == 6
    assert all("GST" in f.sentences for f in got)


def test_a_zda_for_another_second_parts_nothing_but_its_epoch() -> None:
    pieces = [p for i in range(20) for p in (gga(clock(i)), zda(clock(max(0, i - 3))), gst(clock(i)))]
    got = fixes(feed(*pieces))
    assert len(got) == 20
    assert all(f.std_enu_m[0] == 0.008 for f in got)


def test_positions_without_time_and_zda_at_1_hz() -> None:
    pieces = []
    for i in range(12):
        pieces.append(sentence("GPGGA,,,,,,0,,,,M,,M,,"))
        if i % 3 == 0:
            pieces.append(zda(f"0847{i:02d}.00"))
    got = fixes(feed(*pieces))
    assert len(got) == 12
    assert {f.utc_ns for f in got} == {0}


def test_gga_with_a_later_unreadable_gst_keeps_its_fix() -> None:
    bad = gst(clock(3)).replace(b"0.009", b"0.0x9", 1)
    pieces = [p for i in range(6) for p in (gga(clock(i)), bad if i == 3 else gst(clock(i)))]
    out = feed(*pieces)
    assert len(fixes(out)) == 6
    assert [r.reason for r in rejects(out)] == ["CHECKSUM"]


# ---------------------------------------------------------------------------------------------------------- calendar


def test_midnight_without_a_jump_when_rmc_comes_first_or_last() -> None:
    for order in ((rmc, gga), (gga, rmc)):
        pieces = []
        for i in range(-20, 20):
            total = i % 864000
            time = f"{total // 36000:02d}{total // 600 % 60:02d}{total // 10 % 60:02d}.{total % 10}0"
            date = "231126" if i < 0 else "241126"
            pieces += [order[0](time), order[1](time)]
            pieces = [rmc(time, date) if b"RMC," + time.encode() in p else p for p in pieces]
        out = feed(*pieces, step=S // 20)
        got = fixes(out)
        assert not events(out)
        assert [f.utc_ns for f in got] == [utc("2026-11-24 00:00:00") + i * S // 10 for i in range(-20, 20)]


def test_date_known_once_runs_on_through_midnight_alone() -> None:
    out = feed(rmc("235958.00", "311299"), *(gga(t) for t in ("235958.00", "235959.00", "000000.00", "000001.00")))
    assert [f.utc_ns - utc("1999-12-31 23:59:58") for f in fixes(out)] == [0, S, 2 * S, 3 * S]
    assert all(f.date_known for f in fixes(out))


@pytest.mark.parametrize("late_s", [-0.4, 0.4])
def test_the_hosts_day_is_the_nearest_one_on_both_sides_of_midnight(late_s: float) -> None:
    """GIVEN a host 0.4 s late or early WHEN midnight comes without RMC THEN no fix is a day off."""
    times = ["235959.70", "235959.80", "235959.90", "000000.00", "000000.10", "000000.20"]
    first = utc("2026-11-23 23:59:59.7")
    got = fixes(feed(*(gga(t) for t in times), hint=first + round(late_s * 1e9)))
    assert [f.utc_ns - first for f in got] == [i * S // 10 for i in range(6)]
    assert not any(f.date_known for f in got)
    for t, day in (("235959.90", "2026-11-23"), ("000000.10", "2026-11-24")):
        (fix,) = fixes(feed(gga(t), hint=utc("2026-11-24 00:00:00") + round(late_s * 1e9)))
        assert fix.utc_ns == utc(f"{day} {t[:2]}:{t[2:4]}:{t[4:]}")


def test_no_date_and_no_clock_is_an_arbitrary_day_that_runs_on() -> None:
    got = fixes(feed(*(gga(t) for t in ("235959.80", "235959.90", "000000.00", "000000.10"))))
    assert got[0].utc_ns == DAY + 86399 * S + 8 * S // 10
    assert [b.utc_ns - a.utc_ns for a, b in pairwise(got)] == [S // 10] * 3
    assert not any(f.date_known for f in got)
    (midnight,) = fixes(feed(gga("000000.00")))
    assert midnight.utc_ns > 0  # 0 would say that it had no time


def test_days_of_silence_are_counted_by_the_hosts_monotonic_clock() -> None:
    codec = NmeaCodec()
    out = codec.feed(0, rmc("120000.00", "241126") + gga("120000.00"), 0)
    out += codec.feed(3 * DAY + 20 * 3600 * S, gga("080000.00") + gga("080000.10"), 0) + codec.finish()
    assert [f.utc_ns for f in fixes(out)][1] == utc("2026-11-28 08:00:00")


def test_a_clock_found_later_moves_the_arbitrary_day() -> None:
    codec = NmeaCodec()
    out = codec.feed(0, gga("120000.00"), 0)
    hint = utc("2026-11-24 12:00:01.2")
    out += codec.feed(S, gga("120001.00"), hint)
    out += codec.feed(2 * S, gga("120002.00") + rmc("120002.00") + gga("120003.00"), hint + S) + codec.finish()
    assert [f.utc_ns for f in fixes(out)][1:] == [utc(f"2026-11-24 12:00:0{i}") for i in (1, 2, 3)]
    assert [f.date_known for f in fixes(out)] == [False, False, True, True]
    assert not events(out, "DATE_CHANGED")


def test_a_time_of_day_that_jumps_at_the_first_fix_keeps_the_hosts_day() -> None:
    """A cold receiver counts from 00:00:00 until it knows; the day must not end up beside the host's."""
    hint = utc("2026-11-24 15:00:00")
    got = fixes(
        feed(gga("000010.00", "0"), gga("000011.00", "0"), gga("150002.00"), gga("150003.00"), hint=hint, step=S)
    )
    assert [f.utc_ns for f in got[2:]] == [utc("2026-11-24 15:00:02"), utc("2026-11-24 15:00:03")]


def test_a_host_clock_twelve_hours_off_does_not_make_the_day_flicker() -> None:
    codec = NmeaCodec()
    out: Out = []
    for i in range(40):
        wobble = (-1) ** i * S // 2
        out += codec.feed(i * S, gga(f"1200{i:02d}.00"), utc("2026-11-25 00:00:00") + i * S + wobble)
    got = fixes(out + codec.finish())
    assert [b.utc_ns - a.utc_ns for a, b in pairwise(got)] == [S] * 39


def test_leap_second() -> None:
    times = ["235958.00", "235959.00", "235960.00", "000000.00", "000001.00"]
    out = feed(rmc("235958.00", "311216"), *(gga(t) for t in times), step=S)
    assert [f.utc_ns - utc("2016-12-31 23:59:58") for f in fixes(out)] == [0, S, 2 * S, 2 * S, 3 * S]
    assert not rejects(out)


def test_gps_week_roll_over_is_mended_and_said_once() -> None:
    now = utc("2026-11-24 08:47:06.3")
    old = utc("2026-11-24 00:00:00") // DAY - 1024 * 7
    assert old == utc("2007-04-10 00:00:00") // DAY
    pieces = [p for i in range(5) for p in (rmc(f"08470{i}.00", "100407"), gga(f"08470{i}.00"))]
    out = feed(*pieces, hint=now, step=S // 2)
    (event,) = events(out)
    assert event.kind == "WEEK_ROLLOVER"
    assert event.values == (("weeks", 1024.0),)
    assert [f.utc_ns for f in fixes(out)] == [utc(f"2026-11-24 08:47:0{i}") for i in range(5)]
    assert all(f.date_known for f in fixes(out))


def test_an_old_log_is_not_a_roll_over() -> None:
    out = feed(rmc("093451", "310305"), gga("093451"), hint=utc("2026-11-24 08:00:00"))
    assert fixes(out)[0].utc_ns == utc("2005-03-31 09:34:51")
    assert not events(out, "WEEK_ROLLOVER")


def test_a_date_that_jumps_must_be_said_twice() -> None:
    good = [p for i in range(3) for p in (rmc(f"08470{i}.00"), gga(f"08470{i}.00"))]
    out = feed(*good, rmc("084703.00", "251126"), gga("084703.00"), rmc("084704.00"), gga("084704.00"), step=S // 2)
    assert {f.utc_ns // DAY for f in fixes(out)} == {utc("2026-11-24 00:00:00") // DAY}
    assert not events(out)
    out = feed(
        *good, *(p for i in (3, 4, 5) for p in (rmc(f"08470{i}.00", "251126"), gga(f"08470{i}.00"))), step=S // 2
    )
    assert fixes(out)[-1].utc_ns == utc("2026-11-25 08:47:05")
    (event,) = events(out)
    assert (event.kind, event.values) == ("DATE_CHANGED", (("days", 1.0),))


def test_the_date_of_a_void_rmc_is_not_believed() -> None:
    (fix,) = fixes(feed(rmc(date="060180", status="V"), gga(), hint=utc("2026-11-24 08:47:07")))
    assert fix.utc_ns == utc("2026-11-24 08:47:06.3")
    assert not fix.date_known


@pytest.mark.parametrize("date", ["290224", "280223", "010100", "311299", "060180", "311279"])
def test_dates_against_the_standard_library(date: str) -> None:
    year = int(date[4:]) + (1900 if int(date[4:]) >= 80 else 2000)
    want = calendar.timegm((year, int(date[2:4]), int(date[:2]), 8, 47, 6)) * S
    (fix,) = fixes(feed(rmc("084706", date), gga("084706")))
    assert fix.utc_ns == want
    (fix,) = fixes(feed(zda("084706", f"{date[:2]},{date[2:4]},{year}"), gga("084706")))
    assert fix.utc_ns == want


# ----------------------------------------------------------------------------------------------------------- rejects

REJECTS = [
    ("CHECKSUM", gga().replace(b"5102", b"5103"), "would be right"),
    ("CHECKSUM", b"$GNVTG,,T,,M,0.145,N,0.269,K,A*3)\r\n", "*30 would be right"),
    ("CHECKSUM", gga().split(b"*")[0] + b"*\r\n", "would be right"),
    ("NO_CHECKSUM", gga().split(b"*")[0] + b"\r\n", "ends without *"),
    ("NO_CHECKSUM", b"$GPTXT,hello\n", "ends without *"),
    ("TRUNCATED", gga()[:30], "next sentence begins after 30 bytes"),
    ("LENGTH", sentence("GNGGA,084706.30," + "0" * 120), "120 bytes"),
    ("LENGTH", sentence("PUBX,99," + "x" * 1020), "1024 bytes"),
    ("CHARACTER", gga().replace(b"N,0", b"N\x000", 1), "byte 0x00"),
    ("CHARACTER", gga().replace(b"N,0", b"N\xe90", 1), "byte 0xE9"),
    ("FIELD", sentence("GPGGA,084706"), "quality ''"),
    ("FIELD", sentence("GPGGA,084706.30,5102.03,N,01344.37,E,4,12,0.9"), "fields"),
    ("FIELD", gga(time="8:47"), "hhmmss"),
    ("FIELD", gga(time="084706.3x"), "hhmmss"),
    ("FIELD", gga(quality=""), "quality ''"),
    ("FIELD", gga(quality="x"), "quality 'x'"),
    ("FIELD", gga(lat="51x2.03,N"), "angle"),
    ("FIELD", gga(lat="-5102.03,N"), "angle"),
    ("FIELD", gga(lat="5102.03,E"), "hemisphere 'E'; N or S"),
    ("FIELD", gga(lat="5102.03,"), "hemisphere ''"),
    ("FIELD", gga(lat=",", lon=","), "FIXED but no position"),
    ("FIELD", gga(lat=","), "angle ''"),
    ("FIELD", gga(msl="1e2"), "height '1e2'"),
    ("FIELD", gga(msl="nan"), "height 'nan'"),
    ("FIELD", gga(msl="1.2.3"), "height '1.2.3'"),
    ("FIELD", gga().replace(b",M,", b",F,", 1)[:-5] + b"*00\r\n", ""),
    ("FIELD", sentence("GPGNS,084706,5102.03,N,01344.37,E,X,12,0.9,100.0,40.0,,"), "mode 'X'"),
    ("FIELD", rmc(status="X"), "status 'X'"),
    ("FIELD", rmc(date="24111"), "ddmmyy"),
    ("FIELD", zda(date="24,11,26"), "yyyy"),
    ("FIELD", gst(lat="abc"), "sigma 'abc'"),
    ("FIELD", sentence("GNGSA,A,3,1,2"), "GSA"),
    ("RANGE", gga(time="250000"), "000000 to 235960"),
    ("RANGE", gga(time="084761"), "000000 to 235960"),
    ("RANGE", gga(quality="9"), "0 to 8"),
    ("RANGE", gga(lat="9100.0,N"), "at most 90"),
    ("RANGE", gga(lat="9000.0001,N"), "at most 90"),
    ("RANGE", gga(lat="5161.0,N"), "minutes below 60"),
    ("RANGE", gga(lon="18100.0,E"), "at most 180"),
    ("RANGE", gga(msl="9999999.0"), "height"),
    ("RANGE", gga(separation="-99999"), "separation"),
    ("RANGE", rmc(date="310226"), "date 2026-2-31"),
    ("RANGE", rmc(date="001126"), "date"),
    ("RANGE", zda(date="24,13,2026"), "date 2026-13-24"),
    ("RANGE", gst(alt="-0.1"), "sigma '-0.1'"),
    ("FIELD", ggk(quality=""), "quality ''"),
    ("FIELD", ggk(quality="R"), "quality 'R'"),
    ("FIELD", ggk(date="11242"), "mmddyy"),
    ("FIELD", ggk(date="1124x6"), "mmddyy"),
    ("FIELD", ggk(height="160.4522"), "EHT"),
    ("FIELD", ggk(height="GHT160.4522"), "EHT"),
    ("FIELD", ggk(height="EHTx"), "height 'x'"),
    ("FIELD", ggk(lat=",", lon=","), "FIXED but no position"),
    ("FIELD", ggk(time="084706.3x"), "hhmmss"),
    ("FIELD", ggk().replace(b",M*", b",F*")[:-4] + b"00\r\n", "M would be right"),
    ("FIELD", sentence("PTNL,GGK,102939.00,051910"), "GGK has 12"),
    ("RANGE", ggk(quality="13"), "0 to 12"),
    ("RANGE", ggk(date="241126"), "date 2026-24-11"),  # ddmmyy, as one manual has it
    ("RANGE", ggk(height="EHT999999"), "height"),
    ("LENGTH", sentence("PTNL,GGK,102939.00," + "0" * 120), "120 bytes"),
    ("FIELD", vtg(course="x"), "course 'x'"),
    ("FIELD", vtg(mode="d"), "mode 'd'"),
    ("FIELD", vtg(mode="AA"), "mode 'AA'"),
    ("FIELD", vtg(kmh="1e3"), "speed '1e3'"),
    ("FIELD", sentence("GPVTG,054.7,034.4,005.5,010.2"), "VTG has 9"),
    ("FIELD", sentence("GPVTG,054.7,M,034.4,T,005.5,N,010.2,K"), "T would be right"),
    ("RANGE", vtg(course="360.01"), "course"),
    ("RANGE", vtg(knots="-0.1"), "speed"),
    ("FIELD", hdt("27x"), "heading '27x'"),
    ("FIELD", hdt(label="M"), "T would be right"),
    ("RANGE", hdt("-0.1"), "heading '-0.1'"),
    ("RANGE", hdt("360.1"), "heading '360.1'"),
    ("FIELD", ths(mode=""), "mode ''"),
    ("FIELD", ths(mode="D"), "mode 'D'"),
    ("FIELD", sentence("GNTHS,244.28"), "THS has 2"),
    ("RANGE", ths("400"), "heading '400'"),
    ("FIELD", avr(quality=""), "quality ''"),
    ("FIELD", avr(yaw="52.1531W"), "yaw '52.1531W'"),
    ("FIELD", avr(tilt="0.1,Yaw,,"), "Tilt would be right"),
    ("FIELD", sentence("PTNL,AVR,084706.30,+52.1531,Yaw,-0.0806,Tilt,,,12.575"), "AVR has 12"),
    ("RANGE", avr(yaw="-360.1"), "yaw"),
    ("RANGE", avr(tilt="-91,Tilt,,"), "tilt"),
    ("RANGE", avr(quality="99"), "0 to 12"),
    ("RANGE", avr(baseline="-1"), "range"),
    ("RANGE", avr(time="250000"), "000000 to 235960"),
    *(
        ("BINARY_CRC", make(b"payload.")[:-2] + b"\x00\x00", "would be right")
        for make in FRAMES.values()
        if make is not sbf
    ),
    ("BINARY_CRC", sbf(b"payload.")[:-3] + b"abc", "would be right"),
]


def mended(reason: str, data: bytes) -> bytes:
    """Give a FIELD case whose text was edited its right checksum."""
    if reason == "FIELD" and data.endswith(b"*00\r\n"):
        return sentence(data[1:-5].decode())
    return data


@pytest.mark.parametrize(("reason", "data", "detail"), REJECTS, ids=[f"{r}{i}" for i, (r, _, _) in enumerate(REJECTS)])
def test_a_bad_sentence_is_a_reject_and_changes_nothing(reason: str, data: bytes, detail: str) -> None:
    """GIVEN a learned stream WHEN something bad comes between THEN only the Reject and its counters tell of it."""
    data = mended(reason, data)
    before = b"".join(rmc(clock(i)) + gga(clock(i)) + gst(clock(i)) for i in range(5)) + rmc(clock(5)) + gst(clock(5))
    after = gga(clock(5)) + b"".join(rmc(clock(i)) + gga(clock(i)) + gst(clock(i)) for i in range(6, 9))
    codec, plain = NmeaCodec(), NmeaCodec()
    out = codec.feed(7, before + data + after, 0) + codec.finish()
    want = plain.feed(7, before + after, 0) + plain.finish()
    (reject,) = rejects(out)
    assert (reject.reason, reject.count, reject.t_ns) == (reason, 1, 7)
    assert detail in reject.detail
    assert reject.detail.isascii()
    assert reject.detail.isprintable()
    assert repr([x for x in out if not isinstance(x, Reject)]) == repr(want)
    assert codec.counters["rejected"] == codec.counters["rejected_" + reason] == 1
    assert codec.counters["accepted"] == plain.counters["accepted"]
    assert balanced(codec)


def balanced(codec: NmeaCodec) -> bool:
    c = codec.counters
    return c["bytes"] == c["sentence_bytes"] + c["binary_bytes"] + c["skipped_bytes"] + len(codec.save()["buffer"])


def test_every_single_damaged_byte_is_noticed() -> None:
    """Each byte of a sentence, made wrong in each bit. (Without a `$`, or with a control character as its second or
    third, nothing says that a sentence was meant: those are garbage, which is counted too.)"""
    whole = gga()[:-2]
    for at in range(4, len(whole)):
        for bit in range(8):
            damaged = bytearray(whole)
            damaged[at] ^= 1 << bit
            if bytes(damaged).upper() == whole:  # a hexadecimal digit in lower case
                continue
            codec = NmeaCodec()
            out = codec.feed(0, bytes(damaged) + b"\r\n" + gga(clock(1)), 0) + codec.finish()
            assert [f.utc_ns for f in fixes(out)] == [DAY + (8 * 3600 + 47 * 60) * S + S // 10]
            assert rejects(out), (at, bit)


# ------------------------------------------------------------------------------------------------- binary and garbage


@pytest.mark.parametrize("name", FRAMES)
def test_a_sentence_inside_a_good_frame_is_not_one(name: str) -> None:
    codec = NmeaCodec()
    inside = FRAMES[name](b"\r\n" + gga(clock(0)) + b"\xb5b\xd3\x00$@")
    out = codec.feed(0, gga(clock(1))[:-2] + inside + gga(clock(2)), 0) + codec.finish()
    assert len(out) == 2
    assert len(fixes(out)) == 2
    assert codec.counters["binary_frames"] == 1
    assert codec.counters["binary_bytes"] == len(inside)
    assert balanced(codec)


@pytest.mark.parametrize("name", FRAMES)
def test_nothing_good_inside_or_behind_a_damaged_frame_is_lost(name: str) -> None:
    frame = bytearray(FRAMES[name](b"\r\n" + gga(clock(0)) + b"  "))
    frame[frame.index(b"\r\n$GN")] ^= 0x40
    out = feed(bytes(frame) + gga(clock(1)))
    assert len(fixes(out)) == 2
    assert rejects(out)[0].reason == "BINARY_CRC"
    assert name.split()[0] in rejects(out)[0].detail


@pytest.mark.parametrize(
    "head", [b"\xb5b\x01\x07\xff\xff", b"\xd3\x04\x00", b"$@\0\0\0\0\x09\x00", b"\xaaD\x12\x1c" + b"\xff" * 6]
)
def test_a_head_that_cannot_be_a_frame_holds_nothing_up(head: bytes) -> None:
    codec = NmeaCodec()
    pieces = head + gga(clock(0)) + gga(clock(1))
    assert len(fixes(codec.feed(0, pieces, 0))) == 1
    assert codec.counters["skipped_bytes"] == len(head)


def test_an_empty_rtcm_frame() -> None:
    codec = NmeaCodec()
    codec.feed(0, b"\xd3\x00\x00\x47\xea\x4b", 0)
    assert codec.counters["binary_frames"] == 1


def test_frames_of_the_largest_size() -> None:
    for frame in (ubx(bytes(8184)), rtcm(b"$" * 1023), novatel(b"\xb5" * (FRAME_LIMIT - 32))):
        codec = NmeaCodec()
        assert not rejects(codec.feed(0, frame, 0))
        assert codec.counters["binary_bytes"] == len(frame)


def test_garbage_is_counted_and_never_a_reject() -> None:
    codec = NmeaCodec()
    pieces = [
        b",1.7,-30.40,M,-13.9,M,,*7D\r\n",  # the end of a sentence whose begin was missed
        b"# a comment with $GPGGA, a price of 5$ and \xc3\xa9 \r\n",
        b"#BESTPOSA,COM1,0,83.5,FINESTEERING;SOL_COMPUTED*b5b5a4f7\r\n",
        bytes(40) + b"\x80\xff",
        b"$\r\n$$$ $5 *",
        b"\n\n",
    ]
    out = feed(*pieces, b"$" + gga(), codec=codec)
    assert len(out) == 1
    assert len(fixes(out)) == 1
    assert balanced(codec)
    assert codec.counters["skipped_bytes"] > 170
    assert codec.counters["rejected"] == 0


def test_a_good_sentence_counts_wherever_it_stands() -> None:
    out = feed(b"# commented out: " + gga(clock(0)) + b"xyz" + gga(clock(1))[:-2] + gga(clock(2)))
    assert len(fixes(out)) == 3


def test_other_sentences_are_accepted_and_left_alone() -> None:
    codec = NmeaCodec()
    bodies = [
        "GNGGAH,130058.00,1",
        "PSSN,SNC,[0,379359000,1840]",
        "PTNL,LLK,102939.00,051910",
        "GNFOO,",
        "PUBX,03," + "1," * 300,
    ]
    assert feed(*(sentence(b) for b in bodies), codec=codec) == []
    assert codec.counters["accepted"] == codec.counters["not_decoded"] == len(bodies)
    assert codec.last_position_ns == -1


def test_the_buffer_is_bounded() -> None:
    rng = random.Random(5)
    codec = NmeaCodec()
    heads = [b"\xb5b\x01\x02\x00\x10", b"\xd3\x03\xff", b"$GPTXT,", b"$@aaaa\x00\x20", b"\xaaD\x12\x1c1234\x00\x20"]
    most = 0
    for _ in range(3000):
        codec.feed(0, rng.choice(heads) if rng.random() < 0.1 else rng.randbytes(40), 0)
        most = max(most, len(codec.save()["buffer"]))
    assert most <= FRAME_LIMIT + 40


# ------------------------------------------------------------------------------------------------------------ events


def test_a_change_of_the_geoid_is_an_event_and_no_jump() -> None:
    pieces = [gga(clock(i), msl="116.5", separation="43.9322") for i in range(4)]
    pieces += [gga(clock(i), msl="117.4322", separation="43.0") for i in range(4, 8)]
    out = feed(*pieces)
    assert {round(f.h_m, 9) for f in fixes(out)} == {160.4322}
    (event,) = events(out, "SEPARATION")
    assert event.values == (("before_m", 43.9322), ("after_m", 43.0))


def test_a_slow_change_of_separation_is_no_event() -> None:
    out = feed(*(gga(clock(i), separation=f"{43.9 + i * 0.004:.4f}") for i in range(30)))
    assert not events(out)


def test_a_separation_that_vanishes_is_held() -> None:
    out = feed(*(gga(clock(i), separation="43.9322" if i < 3 else "") for i in range(6)))
    assert {round(f.h_m, 9) for f in fixes(out)} == {160.4411}
    assert [e.kind for e in events(out)] == ["NO_SEPARATION"]


def test_coarse_decimals_are_said_once_per_change() -> None:
    coarse = {"lat": "5102.03273,N", "lon": "01344.37524,E", "msl": "116.5"}
    pieces = [gga(clock(i), **coarse) for i in range(20)]  # type: ignore[arg-type]
    pieces += [gga(clock(i)) for i in range(20, 40)]
    pieces += [gga(clock(i), **(coarse if i % 2 else {})) for i in range(40, 60)]  # type: ignore[arg-type]
    out = feed(*pieces)
    assert [e.kind for e in events(out)] == ["COARSE_GGA", "FINE_GGA"]
    assert "CFG-NMEA-HIGHPREC" in events(out)[0].text
    assert dict(events(out)[0].values)["step_n_m"] == pytest.approx(0.01855, rel=1e-2)
    assert fixes(out)[0].resolution_enu_m[2] == pytest.approx(0.1)
    assert not events(feed(*(gga(clock(i)) for i in range(20))))


# ------------------------------------------------------------------------------------------------- any cut, any stop

POOL = [
    gga(clock(0)),
    gga(clock(0), "5"),
    gst(clock(0)),
    rmc(clock(0)),
    gga(clock(1)),
    gst(clock(1)),
    gns(clock(1)),
    zda(clock(1)),
    gga(clock(2)),
    gst(clock(2)),
    gga(clock(3), lat="5102.03,N"),
    gga(clock(4), separation=""),
    gga("235960.00"),
    rmc("000000.00", "251126"),
    gga("000000.00"),
    sentence("GPGGA,,,,,,0,,,,M,,M,,"),
    sentence("GNGSA,A,3" + "," * 12 + ",1.5,0.9,1.2"),
    ggk(clock(1)),
    ggk(clock(2), "0", lat=",", lon=",", height="", date=""),
    vtg(),
    vtg(mode="N"),
    hdt(),
    hdt(""),
    ths(),
    ths(mode="V"),
    avr(clock(2)),
    avr(clock(3), quality="0"),
    *(data for _, data, _ in REJECTS),
    *(make(b"ab" + gga(clock(2)) + b"\xb5b\xd3\x00\xaaD") for make in FRAMES.values()),
    b"\r\n",
    b"\n#",
    b"#",
    b"$",
    b"*",
    b"$@",
    b"\xb5",
    b"\xb5b",
    b"\xb5b\x01\x07\x20\x00",
    b"\xd3",
    b"\xd3\x00",
    b"\xd3\x00\x20",
    b"\xaa",
    b"\xaaD",
    b"\xaaD\x12\x1c",
    bytes(3),
]
PIECES = st.one_of(
    st.sampled_from(POOL),
    st.binary(max_size=30),
    st.tuples(st.sampled_from(POOL), st.integers(0, 90)).map(lambda x: x[0][: x[1]]),
)


@settings(max_examples=400, deadline=None, derandomize=True, database=None)
@given(
    st.lists(st.tuples(PIECES, st.integers(0, 3)), max_size=30),
    st.randoms(use_true_random=False),
    st.sampled_from([1, 3, 40]),
    st.booleans(),
)
def test_any_cut_and_any_stop_give_the_same(
    pieces: list[tuple[bytes, int]], rng: random.Random, most: int, known: bool
) -> None:
    """GIVEN bytes with their arrival stamps WHEN they are cut anywhere, and the state is saved and loaded anywhere THEN
    outputs, counters and state are those of whole blocks."""
    whole, parts = NmeaCodec(), NmeaCodec()
    out: Out = []
    cut: Out = []
    t_ns = 0
    for data, pause in pieces:
        t_ns += pause * S
        hint = utc("2026-11-24 08:47:05") + t_ns if known else 0
        out += whole.feed(t_ns, data, hint)
        at = 0
        while at < len(data):
            n = rng.randint(1, most)
            cut += parts.feed(t_ns, data[at : at + n], hint)
            at += n
            if rng.random() < 0.1:
                state = unpack(pack(parts.save()))
                parts = NmeaCodec()
                parts.load(state)
    # marks may be finer where the cut was; everything that outputs depend on is the same
    a, b = whole.save(), parts.save()
    del a["marks"], b["marks"]
    assert pack(a) == pack(b)
    assert repr(cut) == repr(out)
    assert repr(parts.finish()) == repr(whole.finish())
    assert balanced(whole)
    assert whole.counters == parts.counters
    c = whole.counters
    assert c["accepted"] == c["sentences"]
    assert c["rejected"] == sum(v for k, v in c.items() if k.startswith("rejected_"))


def test_a_loaded_state_saves_as_itself() -> None:
    """Every part of the state that a stream can set, after each of its sentences."""
    stream = [p for i in range(12) for p in (rmc(clock(i)), gga(clock(i)), *([gst(clock(i))] if i % 4 == 0 else []))]
    stream.insert(3 * 2 + 6 * 2 + 2, vtg())  # behind the end of its epoch
    stream += [
        POOL[16],
        hdt(),
        ths(),
        hdt(),
        ggk(clock(11)),
        ggk(clock(12)),
        vtg(),
        gns(clock(12)),
        gga(clock(13), separation=""),
        b"#",
        rmc(clock(14), "251126"),
        gga(clock(14))[:20],
    ]
    codec = NmeaCodec()
    untouched = codec.save()
    for i, piece in enumerate(stream):
        codec.feed(i * S, piece, utc("2046-07-10 08:47:00") + i * S)  # 1024 weeks later
        state = pack(codec.save())
        again = NmeaCodec()
        again.load(unpack(state))
        assert pack(again.save()) == state
        for key, value in codec.save().items():
            if repr(value) != repr(untouched.get(key)):
                untouched.pop(key, None)
    assert not untouched  # the stream has reached every part


@settings(max_examples=200, deadline=None, derandomize=True, database=None)
@given(st.lists(st.binary(max_size=200), max_size=8))
def test_random_bytes_never_hide_the_good_sentences_behind_them(garbage: list[bytes]) -> None:
    """Nothing but a frame whose own check holds may swallow a sentence; random bytes hold none."""
    codec = NmeaCodec()
    out: Out = []
    for i, data in enumerate(garbage):
        out += codec.feed(i, data.replace(b"\xaa", b"") + gga(clock(i)), 0)
    out += codec.finish()
    assert len(fixes(out)) == len(garbage)


# --------------------------------------------------------------------------------------------- other people's receivers

A = (
    "A1-dresden-10hz-gga-gst",
    "A2-ublox-m8p-ubx-nmea-static",
    "A3-rtklib-static-13h-nmea",
    "A4-gpsd-regression-logs",
    "A5-budapest-nmea",
    "A8-mixed-and-damaged-streams",
)


def oracle(data: bytes) -> dict[str, int]:
    """GGA by quality: `$xxGGA,` with a good checksum anywhere in the bytes."""
    count: Counter[str] = Counter()
    for m in re.finditer(rb"\$(..GGA,[^$*]*)\*([0-9A-Fa-f]{2})", data):
        check = 0
        for c in m[1]:
            check ^= c
        if check == int(m[2], 16):
            count[m[1].split(b",")[6].decode()] += 1
    return dict(count)


def recording(path: Path) -> bytes:
    data = path.read_bytes()
    if path.suffix == ".gz":
        data = gzip.decompress(data)
    if "27_05" in path.name:  # its publisher cut the begin of every line
        data = b"".join(b"$GPGGA," + line + b"\n" for line in data.splitlines())
    return data


def by_quality(codec: NmeaCodec) -> dict[str, int]:
    return {k[-1]: v for k, v in codec.counters.items() if k.startswith("gga_quality_")}


@pytest.mark.parametrize("folder", A)
def test_gga_by_quality_equals_an_independent_count(shared_data: Path, folder: str) -> None:
    rng = random.Random(folder)
    paths = sorted(p for p in (shared_data / folder).iterdir() if p.is_file())
    assert paths
    for path in paths:
        data = recording(path)
        codec, cut = NmeaCodec(), NmeaCodec()
        out = codec.feed(0, data, 0) + codec.finish()
        parts: Out = []
        at = 0
        most = 300 if len(data) < 100_000 else 5000
        while at < len(data):
            n = rng.randint(1, most)
            parts += cut.feed(0, data[at : at + n], 0)
            at += n
        assert repr(parts + cut.finish()) == repr(out), path.name
        want = oracle(data)
        assert by_quality(codec) == want, path.name
        given_out = Counter(str(int(f.quality)) for f in fixes(out) if "GGA" in f.sentences)
        if path.name == "tcp-torture.log":  # `|19322|1.00` is no time, and four bars cancel out in the checksum
            assert [r.reason for r in rejects(out)] == ["FIELD"]
            assert not given_out
        else:
            assert given_out == want, path.name
        assert balanced(codec), path.name
        assert codec.save()["buffer"] == b""


@pytest.mark.parametrize(
    ("name", "want"),
    [
        ("A1-dresden-10hz-gga-gst/Messung.log", {"0": 1, "1": 592, "4": 4216, "5": 5343}),
        ("A1-dresden-10hz-gga-gst/Messg_4.log", {"1": 79, "4": 7547, "5": 1071}),
        ("A2-ublox-m8p-ubx-nmea-static/rover-20181004-1237.ubx.gz", {"1": 76, "2": 2, "5": 5, "4": 1121}),
        ("A3-rtklib-static-13h-nmea/test_nmea_27_05_clean.txt.gz", {"1": 2, "4": 5908, "5": 40247}),
    ],
)
def test_counts_that_the_data_sheet_gives(shared_data: Path, name: str, want: dict[str, int]) -> None:
    codec = NmeaCodec()
    codec.feed(0, recording(shared_data / name), 0)
    assert by_quality(codec) == want


def test_dresden_has_a_sigma_for_every_fix(shared_data: Path) -> None:
    codec = NmeaCodec()
    got = fixes(codec.feed(0, recording(shared_data / A[0] / "Messg_4.log"), 0) + codec.finish())
    assert sum(f.sentences == ("GGA", "GST") for f in got) == 8697
    assert not any(math.isnan(f.std_enu_m[0]) for f in got if f.quality is Quality.FIXED)


def test_static_13_hours_cross_midnight_without_a_jump(shared_data: Path) -> None:
    data = recording(shared_data / A[2] / "test_nmea_27_05_clean.txt.gz")
    for hint in (0, utc("2014-05-27 15:32:47.3")):
        codec = NmeaCodec()
        out: Out = []
        t_ns = 0
        for line in data.splitlines(keepends=True):
            tod = int(line[7:9]) * 3600 + int(line[9:11]) * 60 + int(line[11:13])
            t_ns = (tod - (15 * 3600 + 32 * 60 + 47)) % 86400 * S
            out += codec.feed(t_ns, line, hint + t_ns if hint else 0)
        got = fixes(out + codec.finish())
        steps = [b.utc_ns - a.utc_ns for a, b in pairwise(got)]
        assert min(steps) >= S
        assert max(steps) < 120 * S
        assert 13.2 < sum(steps) / (3600 * S) < 13.4
        assert not events(out, "DATE_CHANGED")
        if hint:
            assert got[0].utc_ns == utc("2014-05-27 15:32:47")
        assert [f.utc_ns for f in fixes(NmeaCodec().feed(0, data, 0))][-1] - got[0].utc_ns < 2 * DAY or hint


@pytest.mark.parametrize(
    ("name", "reasons"),
    [
        ("pygpsdata-BADCK2.log", {"BINARY_CRC"}),
        ("pygpsdata-MIXED-RTCM3BADCRC.log", {"BINARY_CRC"}),
        ("pygpsdata-MIXED3BADCK.log", {"BINARY_CRC"}),
        ("pygpsdata-nmeabadck.log", {"CHECKSUM"}),
        ("pygpsdata-nmeabadck2.log", {"CHECKSUM"}),
        ("pygpsdata-BADNMEAEOF.log", {"TRUNCATED"}),
        ("pygpsdata-NMEABADEND.log", {"TRUNCATED"}),
        ("pygpsdata-BADEOF1.log", set()),  # cut inside of a binary head: nothing to say but the skipped bytes
        ("pygpsdata-MIXED2.log", set()),
        ("trimble_nmea.log", set()),
    ],
)
def test_damaged_files_give_the_right_reasons(shared_data: Path, name: str, reasons: set[str]) -> None:
    codec = NmeaCodec()
    out = codec.feed(0, recording(shared_data / A[5] / name), 0) + codec.finish()
    assert {r.reason for r in rejects(out)} == reasons


def test_one_sentence_of_budapest_lacks_its_checksum(shared_data: Path) -> None:
    codec = NmeaCodec()
    out = codec.feed(0, recording(shared_data / A[4] / "nmea2.txt"), 0)
    assert [r.reason for r in rejects(out)] == ["NO_CHECKSUM"]
    assert codec.counters["rejected_NO_CHECKSUM"] == 1


def test_ublox_binary_is_framed_to_the_last_byte(shared_data: Path) -> None:
    codec = NmeaCodec()
    codec.feed(0, recording(shared_data / A[5] / "2023-4-17_82912_serial-COM3.ubx"), 0)
    assert codec.counters["binary_frames"] == 160
    assert codec.counters["skipped_bytes"] == codec.counters["rejected"] == 0


def test_crc32_oracle_is_itself_right() -> None:
    """NovAtel's CRC against zlib's where the two must agree: prefixing ones turns one into the other."""
    data = b"123456789"
    assert int.from_bytes(crc32_plain(data), "little") == zlib.crc32(data, 0xFFFFFFFF) ^ 0xFFFFFFFF == 0x2DFD2D88
