"""VTG, HDT, THS, PTNL,GGK and PTNL,AVR: values, whose epoch they belong to, and other people's receivers."""

from __future__ import annotations

import itertools
import math
import re
from collections import Counter
from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import pytest
from test_nmea_codec import (
    A,
    Out,
    avr,
    clock,
    events,
    feed,
    fixes,
    gga,
    ggk,
    gns,
    gst,
    hdt,
    headings,
    recording,
    rejects,
    rmc,
    sentence,
    ths,
    utc,
    vtg,
)

from drivers.nmea_codec import HEADING_PATIENCE, NmeaCodec
from drivers.nmea_fields import BadSentenceError, last_step, number
from edge_agent.messages import Quality, S

BASE = utc("2026-11-24 08:47:00")

# ------------------------------------------------------------------------------------------------------------- numbers


@pytest.mark.parametrize(("text", "step"), [("274", 1.0), ("274.1", 0.1), ("+52.1531", 1e-4), ("5102.0327346", 1e-7)])
def test_the_step_of_the_last_decimal(text: str, step: float) -> None:
    assert last_step(text) == pytest.approx(step, rel=1e-12)


@pytest.mark.parametrize("text", ["inf", "nan", "1_0", "0x1", "--1", "1-", ".", "1e5", "\u0661"])
def test_only_decimals_are_numbers(text: str) -> None:
    with pytest.raises(BadSentenceError):
        number(text, "n", -10.0, 10.0)


# ----------------------------------------------------------------------------------------------------------------- GGK


def test_every_field_of_ggk() -> None:
    """The maker's example: date, ellipsoidal height and position type stand in the sentence itself."""
    body = "PTNL,GGK,172814.00,071296,3723.46587704,N,12202.26957864,W,3,06,1.7,EHT-6.777,M"
    out = feed(sentence(body))
    (fix,) = fixes(out)
    assert fix.utc_ns == utc("1996-07-12 17:28:14")
    assert fix.date_known
    assert fix.lat_deg == pytest.approx(37 + 23.46587704 / 60, abs=1e-13)
    assert fix.lon_deg == pytest.approx(-(122 + 2.26957864 / 60), abs=1e-13)
    assert fix.h_m == -6.777
    assert (fix.quality, fix.satellites, fix.pdop) == (Quality.FIXED, 6, 1.7)
    assert fix.resolution_enu_m[1] == pytest.approx(1855.3e-8, rel=1e-3)
    assert fix.resolution_enu_m[2] == pytest.approx(1e-3)
    assert all(math.isnan(x) for x in (fix.separation_m, fix.hdop, fix.age_s))
    assert fix.sentences == ("GGK",)
    assert not events(out)  # no separation is missing: the height is ellipsoidal


@pytest.mark.parametrize(
    ("code", "quality"),
    [
        ("1", Quality.SINGLE),
        ("2", Quality.FLOAT),
        ("3", Quality.FIXED),
        ("4", Quality.DGNSS),
        ("5", Quality.DGNSS),
        ("6", Quality.FLOAT),
        ("7", Quality.FIXED),
        ("8", Quality.FLOAT),
        ("9", Quality.FIXED),
        ("10", Quality.FLOAT),
        ("11", Quality.DGNSS),
        ("12", Quality.FLOAT),
    ],
)
def test_ggk_counts_its_qualities_its_own_way(code: str, quality: Quality) -> None:
    codec = NmeaCodec()
    (fix,) = fixes(feed(ggk(quality=code), codec=codec))
    assert fix.quality is quality
    assert codec.counters[f"ggk_quality_{code}"] == 1


def test_ggk_of_quality_0_has_no_position_and_no_date() -> None:
    codec = NmeaCodec()
    out = feed(ggk(quality="0", lat=",", lon=",", height="EHT", date="010180"), codec=codec)
    (fix,) = fixes(out)
    assert len(out) == 1
    assert fix.quality is Quality.NONE
    assert math.isnan(fix.lat_deg)
    assert not fix.date_known
    assert codec.counters["positions"] == 0
    assert codec.last_position_ns == -1


@pytest.mark.parametrize("order", list(itertools.permutations((ggk, gga, gns, gst))))
def test_the_position_comes_from_ggk_in_any_order(order: tuple[object, ...]) -> None:
    """GIVEN all three positions of an epoch WHEN they come in any order THEN GGK's holds, with what only GGA says."""
    got = fixes(feed(*(make(clock(i)) for i in range(12) for make in order)))  # type: ignore[operator]
    assert [f.utc_ns for f in got] == [BASE + i * S // 10 for i in range(12)]
    for fix in got[3:]:  # the first ones close before the order is known
        assert fix.h_m == 160.4522
        assert (fix.satellites, fix.pdop) == (14, 1.9)
        assert (fix.hdop, fix.separation_m, fix.age_s, fix.station) == (0.93, 43.9322, 1.3, "0486")
        assert fix.std_enu_m == (0.008, 0.009, 0.016)
        assert sorted(fix.sentences) == ["GGA", "GGK", "GNS", "GST"]


def test_ggk_ends_its_epoch_and_gives_the_date() -> None:
    codec = NmeaCodec()
    given_at = [(i, f) for i in range(8) for f in fixes(codec.feed(i, ggk(clock(i)), 0))]
    assert [i for i, _ in given_at] == [1, 2, 3, 3, 4, 5, 6, 7]
    assert all(f.date_known for _, f in given_at)


def test_ggk_that_is_switched_on_later_is_waited_for() -> None:
    first = [gga(clock(i)) for i in range(6)]
    got = fixes(feed(*first, *(make(clock(i)) for i in range(6, 16) for make in (gga, ggk))))
    assert len(got) == 16
    assert all((f.h_m, f.sentences) == (160.4522, ("GGA", "GGK")) for f in got[-6:])


def test_positions_go_on_when_the_receivers_time_steps_back() -> None:
    pieces = [ggk(f"{hour}0000.{i}0") for hour in ("12", "11") for i in range(6)]
    assert len(fixes(feed(*pieces))) == 12


def test_gga_holds_where_ggk_is_missing_or_has_no_fix() -> None:
    bad = ggk(clock(5), "0", lat=",", lon=",", height="", date="")
    pieces = [(gga(clock(i)), bad if i == 5 else b"" if i == 7 else ggk(clock(i))) for i in range(10)]
    out = feed(*(p for pair in pieces for p in pair if p))
    assert [round(f.h_m, 4) for f in fixes(out)] == [160.4411 if i in (5, 7) else 160.4522 for i in range(10)]
    assert all(f.quality is Quality.FIXED for f in fixes(out))
    assert not events(out)  # no height jumps with the kind of sentence


def test_ggk_carries_the_date_through_midnight() -> None:
    times = [("235959.80", "112326"), ("235959.90", "112326"), ("000000.00", "112426"), ("000000.10", "112426")]
    got = fixes(feed(*(ggk(t, date=d) for t, d in times)))
    assert [b.utc_ns - a.utc_ns for a, b in pairwise(got)] == [S // 10] * 3
    assert got[2].utc_ns == utc("2026-11-24 00:00:00")


# ----------------------------------------------------------------------------------------------------------------- VTG


@pytest.mark.parametrize(
    ("piece", "course", "speed"),
    [
        (vtg(), 211.5, 0.063 / 3.6),
        (vtg(course=""), math.nan, 0.063 / 3.6),
        (vtg(kmh=""), 211.5, 0.034 * 1852 / 3600),
        (vtg(mode="N"), math.nan, math.nan),
        (vtg("", "", "", "N"), math.nan, math.nan),
        (sentence("GNVTG,,,,,,,,,N"), math.nan, math.nan),
        (sentence("GPVTG,054.7,T,034.4,M,005.5,N,010.2,K"), 54.7, 10.2 / 3.6),  # before NMEA 2.3
    ],
)
def test_course_and_speed_go_with_their_fix(piece: bytes, course: float, speed: float) -> None:
    (fix,) = fixes(feed(gga(), piece))
    assert fix.course_deg == pytest.approx(course, nan_ok=True)
    assert fix.speed_mps == pytest.approx(speed, nan_ok=True)


def test_a_velocity_behind_the_end_of_its_epoch_is_no_other_ones() -> None:
    """GIVEN VTG behind the sentence that ends an epoch THEN no fix has it: its own is out already, and the next one is
    at another time."""
    codec = NmeaCodec()
    given_at = []
    for i in range(12):
        pieces = gga(clock(i)) + (vtg(kmh=f"{i}.0") if i % 3 == 0 else b"")
        given_at += [(i, f.speed_mps * 3.6) for f in fixes(codec.feed(i * S // 10, pieces, 0))]
    assert [i for i, _ in given_at] == [1, 2, 3, *range(3, 12)]
    # up to the third fix the epochs end at the next one's begin, so the VTG stands inside
    assert [v for _, v in given_at] == [0] + [pytest.approx(math.nan, nan_ok=True)] * 11


@pytest.mark.parametrize("cut", [False, True])
def test_a_velocity_that_leads_its_epoch_is_that_ones(cut: bool) -> None:
    """GIVEN VTG in front of the position, in the same burst THEN each fix has its own, and none is late for it."""
    codec = NmeaCodec()
    given = []
    for i in range(12):
        lead, pieces = vtg(kmh=f"{i}.0"), rmc(clock(i)) + gga(clock(i))
        t = i * S // 10
        for at, part in ((t, lead), (t + S // 100, pieces)) if cut else ((t, lead + pieces),):
            given += [(i, round(f.speed_mps * 3.6, 6)) for f in fixes(codec.feed(at, part, 0))]
    # while an epoch ends at the next one's begin, the VTG stands inside the one before
    assert given[-8:] == [(i, float(i)) for i in range(4, 12)]


def test_an_old_velocity_is_forgotten() -> None:
    codec = NmeaCodec()
    out = codec.feed(0, vtg(), 0) + codec.feed(2 * S, gga(), 0) + codec.finish()
    assert math.isnan(fixes(out)[0].speed_mps)


# ------------------------------------------------------------------------------------------------------------ headings


def test_a_heading_belongs_to_the_epoch_in_which_it_stands() -> None:
    """GIVEN HDT behind the position WHEN the epochs are given out at their ends THEN it waits for nothing and has the
    epoch's time."""
    codec = NmeaCodec()
    out = [x for i in range(6) for x in codec.feed(7 + i, rmc(clock(i)) + gga(clock(i)) + hdt(f"{i}.25"), 0)]
    assert [h.heading_deg for h in headings(out)] == [i + 0.25 for i in range(6)]
    assert [h.utc_ns for h in headings(out)] == [BASE + i * S // 10 for i in range(6)]
    assert [h.arrival_ns for h in headings(out)] == [7 + i for i in range(6)]
    one = headings(out)[0]
    assert (one.t_ns, one.quality, one.sentence) == (0, Quality.FIXED, "HDT")
    assert one.resolution_deg == pytest.approx(0.01)
    assert math.isnan(one.baseline_m)
    assert math.isnan(one.tilt_deg)


def test_headings_change_nothing_about_the_fixes() -> None:
    plain = [p for i in range(20) for p in (rmc(clock(i)), gga(clock(i)), gst(clock(i)))]
    more = [p + q for p, q in zip(plain, itertools.cycle((hdt(), avr(), ths(mode="V"))), strict=False)]
    more = [hdt(""), *more]
    a, b = fixes(feed(*plain)), fixes(feed(*more))
    assert [f.utc_ns for f in a] == [f.utc_ns for f in b]
    assert [repr(f.std_enu_m) for f in a] == [repr(f.std_enu_m) for f in b]
    assert [f.arrival_ns + S // 10 for f in a] == [f.arrival_ns for f in b]  # one piece stands before


def test_a_compass_faster_than_the_positions_has_its_arrival_for_a_time() -> None:
    codec = NmeaCodec()
    out = []
    for i in range(30):
        out += codec.feed(i * S // 10, (rmc(clock(i)) + gga(clock(i)) if i % 10 == 0 else b"") + hdt(), 0)
    got = headings(out)
    assert len(got) == 30
    assert [h.utc_ns for h in got if h.utc_ns] == [BASE + i * S for i in range(3)]


def test_a_stream_of_headings_alone() -> None:
    out = feed(*(hdt(f"{i}.5") for i in range(5)))
    assert [(h.heading_deg, h.utc_ns) for h in headings(out)] == [(i + 0.5, 0) for i in range(5)]
    assert len(out) == 5


@pytest.mark.parametrize("mode", "EMSV")
def test_ths_in_another_mode_is_not_valid(mode: str) -> None:
    codec = NmeaCodec()
    (h,) = headings(feed(gga(), ths(mode=mode), codec=codec))
    assert h.quality is Quality.NONE
    assert math.isnan(h.heading_deg)
    assert codec.counters["headings"] == codec.counters["headings_invalid"] == 1


@pytest.mark.parametrize("piece", [hdt(""), sentence("GPHDT,,"), sentence("GPHDT,"), ths(""), avr(yaw="")])
def test_an_empty_heading_is_not_valid(piece: bytes) -> None:
    codec = NmeaCodec()
    (h,) = headings(feed(gga(), piece, codec=codec))
    assert h.quality is Quality.NONE
    assert codec.counters["headings_invalid"] == 1
    assert codec.counters["rejected"] == 0


def test_every_field_of_avr() -> None:
    """The maker's example."""
    body = "PTNL,AVR,212405.20,+52.1531,Yaw,-0.0806,Tilt,,,12.575,3,1.4,16"
    assert sentence(body) == b"$" + body.encode() + b"*39\r\n"
    (h,) = headings(feed(rmc("212405.00", "190510"), sentence(body)))
    assert h.utc_ns == utc("2010-05-19 21:24:05.2")  # its own time, not that of RMC
    assert (h.heading_deg, h.tilt_deg, h.baseline_m) == (52.1531, -0.0806, 12.575)
    assert h.quality is Quality.FIXED
    assert h.resolution_deg == pytest.approx(1e-4)
    (h,) = headings(feed(avr(tilt=",,-0.0807,Roll")))
    assert math.isnan(h.tilt_deg)


@pytest.mark.parametrize(("yaw", "deg"), [("-0.0100", 359.99), ("-179.5", 180.5), ("+359.9999", 359.9999), ("0", 0.0)])
def test_a_yaw_is_a_compass_angle(yaw: str, deg: float) -> None:
    (h,) = headings(feed(avr(yaw=yaw)))
    assert h.heading_deg == pytest.approx(deg, abs=1e-9)


@pytest.mark.parametrize(("code", "quality"), [("1", Quality.SINGLE), ("2", Quality.FLOAT), ("4", Quality.DGNSS)])
def test_avr_says_how_good_it_is(code: str, quality: Quality) -> None:
    (h,) = headings(feed(avr(quality=code)))
    assert h.quality is quality
    (h,) = headings(feed(avr(quality="0")))
    assert h.quality is Quality.NONE
    assert math.isnan(h.heading_deg)


def test_one_measurement_in_two_sentences_is_given_out_once() -> None:
    codec = NmeaCodec()
    out = feed(*(p for i in range(30) for p in (gga(clock(i)), hdt(), ths(), avr(clock(i)))), codec=codec)
    kinds = Counter(h.sentence for h in headings(out))
    assert kinds == {"HDT": 1, "THS": 1, "AVR": 30}  # the first ones stand before better is known
    assert codec.counters["headings_beside"] == 58


def test_a_ths_that_is_not_valid_silences_the_hdt_beside_it() -> None:
    out = feed(*(p for i in range(9) for p in (gga(clock(i)), ths(mode="V"), hdt())))
    assert {h.quality for h in headings(out)} == {Quality.NONE}


def test_the_lesser_sentence_serves_when_the_better_one_is_gone() -> None:
    out = feed(gga(), avr(), *(p for i in range(HEADING_PATIENCE + 5) for p in (gga(clock(i)), hdt())))
    assert [h.sentence for h in headings(out)] == ["AVR"] + ["HDT"] * 5


# --------------------------------------------------------------------------------------------- other people's receivers


def said(data: bytes, address: str) -> list[list[str]]:
    """Fields of every sentence whose checksum holds and whose address matches, found by a regular expression."""
    found = []
    for m in re.finditer(rb"\$((?:" + address.encode() + rb"),[^$*\r\n]*)\*([0-9A-Fa-f]{2})", data):
        check = 0
        for c in m[1]:
            check ^= c
        if check == int(m[2], 16):
            found.append(m[1].decode("ascii").split(","))
    return found


@lru_cache(maxsize=64)
def parsed(path: Path) -> tuple[bytes, NmeaCodec, Out]:
    """A recording, fed whole."""
    data = recording(path)
    codec = NmeaCodec()
    return data, codec, codec.feed(0, data, 0) + codec.finish()


@pytest.mark.parametrize("folder", A)
def test_headings_equal_an_independent_parse(shared_data: Path, folder: str) -> None:
    """A stream with several types gives out the best of them; within a file, that is what the regex must find."""
    for path in sorted(p for p in (shared_data / folder).iterdir() if p.is_file()):
        data, codec, out = parsed(path)
        got = headings(out)
        ths_said = [float(f[1]) if f[2] == "A" else None for f in said(data, "[A-Z]{2}THS")]
        hdt_said = [float(f[1]) if f[1] else None for f in said(data, "[A-Z]{2}HDT")]
        avr_said = [float(f[3]) if f[10] != "0" else None for f in said(data, "PTNL,AVR")]
        want = avr_said or ths_said or hdt_said
        assert [None if math.isnan(h.heading_deg) else h.heading_deg for h in got] == want, path.name
        total = len(avr_said) + len(ths_said) + len(hdt_said)
        assert len(got) + codec.counters["headings_beside"] == total, path.name


@pytest.mark.parametrize(
    ("name", "kinds", "valid"),
    [
        ("A4-gpsd-regression-logs/skytraq-PX1172RH_DS.log", {"THS": 9}, 9),
        ("A4-gpsd-regression-logs/hemi.log", {"HDT": 215}, 4),
        ("A8-mixed-and-damaged-streams/trimble_nmea.log", {"AVR": 2}, 2),
    ],
)
def test_headings_that_the_files_hold(shared_data: Path, name: str, kinds: dict[str, int], valid: int) -> None:
    codec = NmeaCodec()
    got = headings(codec.feed(0, recording(shared_data / name), 0) + codec.finish())
    assert Counter(h.sentence for h in got) == kinds
    assert sum(h.quality is Quality.FIXED for h in got) == valid


def test_skytraqs_headings_have_the_times_of_their_epochs(shared_data: Path) -> None:
    data = recording(shared_data / A[3] / "skytraq-PX1172RH_DS.log")
    codec = NmeaCodec()
    got = {h.utc_ns: h.heading_deg for h in headings(codec.feed(0, data, 0) + codec.finish())}
    own = said(data, "PSTI,036")  # the receiver's own sentence: time, date, heading
    assert len(own) == 9
    for f in own:
        assert got[utc(f"2022-03-29 {f[2][:2]}:{f[2][2:4]}:{f[2][4:]}")] == float(f[4])


@pytest.mark.parametrize("folder", A)
def test_velocities_equal_an_independent_parse(shared_data: Path, folder: str) -> None:
    """Every speed of a fix was said by a VTG, and by no more fixes than said it; by as many where a VTG never stands
    behind the position's last sentence."""
    for path in sorted(p for p in (shared_data / folder).iterdir() if p.is_file()):
        data, _, out = parsed(path)
        got = fixes(out)
        want: Counter[tuple[float, float]] = Counter()
        for f in said(data, "[A-Z]{2}VTG"):
            if len(f) < 10 or f[9] != "N":
                speed = float(f[7]) / 3.6 if f[7] else math.nan
                want[float(f[1] or -1.0), round(speed, 9)] += 1
        have = Counter(
            (-1.0 if math.isnan(x.course_deg) else x.course_deg, round(x.speed_mps, 9))
            for x in got
            if not math.isnan(x.speed_mps)
        )
        assert not have - want, path.name
        positions = len(said(data, "[A-Z]{2}GGA"))
        behind = re.search(rb"(GGA|GNS|GST),[^$]*\$(?:..(?:GSA|GSV|GLL|GBS|GRS|RMC|ZDA),[^$]*\$)*..VTG,", data)
        # as many positions as velocities: none is lost but the last
        if positions and sum(want.values()) <= positions and not behind:
            assert sum((want - have).values()) <= 1, path.name


def test_trimbles_ggk_in_a_real_stream(shared_data: Path) -> None:
    data = recording(shared_data / A[5] / "trimble_nmea.log")
    codec = NmeaCodec()
    (fix,) = [f for f in fixes(codec.feed(0, data, 0) + codec.finish()) if "GGK" in f.sentences]
    (f,) = said(data, "PTNL,GGK")
    assert fix.lat_deg == pytest.approx(int(f[4][:2]) + float(f[4][2:]) / 60, abs=1e-12)
    assert fix.lon_deg == pytest.approx(int(f[6][:3]) + float(f[6][3:]) / 60, abs=1e-12)
    assert fix.h_m == float(f[11][3:]) == 150.79
    assert fix.utc_ns == utc("2010-05-19 10:29:39")
    assert fix.quality is Quality.DGNSS  # its 5 is SBAS
    assert not rejects(codec.feed(0, b"", 0))
