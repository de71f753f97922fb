"""Fields of NMEA 0183 sentences: text to numbers, checked before anything is believed.

Every function raises `BadSentenceError` with the reason and detail of the Reject to come. An empty field is
"not said": NaN, or -1 for a time of day.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TypeAlias

from edge_agent.messages import Quality, S

DAY_NS = 86400 * S
HALF_DAY_NS = DAY_NS // 2
UNTIMED = -1

Position: TypeAlias = tuple[int, int, float, float, float, float, int, int, float, float, str, float, float]
"""What a position sentence says: arrival_ns, hint_ns, lat_deg, lon_deg, msl_m, separation_m, quality, satellites, hdop,
age_s, station, step_minutes, step_height_m."""


class BadSentenceError(ValueError):
    """A sentence cannot be used: reason and detail of the Reject to come. Raised before any state changes."""

    def __init__(self, reason: str, detail: str) -> None:
        super().__init__(reason, detail)
        self.reason = reason
        self.detail = detail


def show(data: bytes) -> str:
    """Bytes as text that any log can hold."""
    return data.decode("ascii", "backslashreplace").encode("unicode_escape").decode("ascii")


def xor8(data: bytes) -> int:
    """Exclusive-or of at most 1024 bytes, folded as one long integer: 0.5 us where a loop takes 4."""
    n = int.from_bytes(data, "little")
    if len(data) > 128:
        n ^= n >> 4096
        n ^= n >> 2048
        n ^= n >> 1024
    n ^= n >> 512
    n ^= n >> 256
    n ^= n >> 128
    n ^= n >> 64
    n ^= n >> 32
    n ^= n >> 16
    n ^= n >> 8
    return n & 0xFF


def need_fields(kind: str, f: list[str], least: int, full: int) -> None:
    """Refuse a sentence with fewer than `least` fields; fill the optional ones at its end up to `full`."""
    if len(f) < least:
        raise BadSentenceError("FIELD", f"{len(f) - 1} fields; {kind} has {full - 1}")
    if len(f) < full:
        f.extend([""] * (full - len(f)))


@lru_cache(maxsize=8)  # the sentences of an epoch repeat it
def time_of_day(text: str) -> int:
    """Time of day [ns] of hhmmss.sss, -1 where it is empty. Second 60 is a leap second."""
    if not text:
        return UNTIMED
    whole, _, fraction = text.partition(".")
    if len(whole) != 6 or not whole.isdigit() or (fraction and not fraction.isdigit()):
        raise BadSentenceError("FIELD", f"time {text!r}; hhmmss or hhmmss.sss would be right")
    n = int(whole)
    hour, minute, second = n // 10000, n // 100 % 100, n % 100
    if hour > 23 or minute > 59 or second > 60:
        raise BadSentenceError("RANGE", f"time {text!r}; 000000 to 235960 would be right")
    ns = int(fraction[:9].ljust(9, "0")) if fraction else 0
    return (hour * 3600 + minute * 60 + second) * S + ns


@lru_cache(maxsize=1024)  # sigmas, ages, separations repeat; a hit costs a seventh
def number(text: str, name: str, low: float, high: float) -> float:
    """A decimal number, NaN where it is empty."""
    if not text:
        return math.nan
    if text.strip("0123456789.+-"):
        raise BadSentenceError("FIELD", f"{name} {text!r}; a decimal number would be right")
    try:
        value = float(text)
    except ValueError:
        raise BadSentenceError("FIELD", f"{name} {text!r}; a decimal number would be right") from None
    if not low <= value <= high:
        raise BadSentenceError("RANGE", f"{name} {text!r}; {low:g} to {high:g} would be right")
    return value


def angle(text: str, side: str, sides: str, most: float) -> float:
    """Degrees of dddmm.mmmm and its hemisphere."""
    whole, _, fraction = text.partition(".")
    if not 3 <= len(whole) <= 5 or not whole.isdigit() or (fraction and not fraction.isdigit()):
        raise BadSentenceError("FIELD", f"angle {text!r}; degrees, two digits of minutes and decimals would be right")
    if len(side) != 1 or side not in sides:
        raise BadSentenceError("FIELD", f"hemisphere {side!r}; {sides[0]} or {sides[1]} would be right")
    minutes = float(text[len(whole) - 2 :])
    value = int(whole[:-2]) + minutes / 60.0
    if minutes > 60.0 or value > most:
        raise BadSentenceError("RANGE", f"angle {text!r}; minutes below 60 and at most {most:g} degrees would be right")
    return -value if side == sides[1] else value


def last_step(text: str) -> float:
    """One step of the last decimal."""
    return 10.0 ** (text.find(".") + 1 - len(text)) if "." in text else 1.0


def position(
    f: list[str],
    at: int,
    quality: int,
    satellites: str,
    hdop: str,
    msl: str,
    separation: str,
    age: str,
    station: str,
    t_ns: int,
    hint_ns: int,
) -> Position:
    """Common part of GGA and GNS; latitude, N/S, longitude, E/W stand at `at` and after."""
    lat = lon = step = math.nan
    if f[at] or f[at + 2]:
        lat = angle(f[at], f[at + 1], "NS", 90.0)
        lon = angle(f[at + 2], f[at + 3], "EW", 180.0)
        step = max(last_step(f[at]), last_step(f[at + 2]))
    elif quality > 0:
        raise BadSentenceError("FIELD", f"{Quality(quality).name} but no position")
    return (
        t_ns,
        hint_ns,
        lat,
        lon,
        number(msl, "height", -1e4, 1e5),
        number(separation, "separation", -1e3, 1e3),
        quality,
        int(number(satellites, "satellites", 0, 999)) if satellites else 0,
        number(hdop, "HDOP", 0.0, 1e4),
        number(age, "age", 0.0, 1e6),
        station,
        step,
        last_step(msl) if msl else math.nan,
    )


TRIMBLE_QUALITY = (
    Quality.NONE,  # 0 not available or invalid
    Quality.SINGLE,  # 1 autonomous
    Quality.FLOAT,  # 2 RTK float
    Quality.FIXED,  # 3 RTK fixed
    Quality.DGNSS,  # 4 code phase only
    Quality.DGNSS,  # 5 SBAS
    Quality.FLOAT,  # 6 RTK float or location, 3D network
    Quality.FIXED,  # 7 RTK fixed, 3D network
    Quality.FLOAT,  # 8 RTK float or location, 2D network
    Quality.FIXED,  # 9 RTK fixed, 2D network
    Quality.FLOAT,  # 10 OmniSTAR HP/XP, decimetres
    Quality.DGNSS,  # 11 OmniSTAR VBS
    Quality.FLOAT,  # 12 location RTK
)
"""GGK's and AVR's quality, not GGA's. Source: Trimble, SPSx51 Modular GPS Receivers User Guide, tables A.6 and A.8."""


def trimble_quality(text: str) -> Quality:
    """Quality of the PTNL sentences."""
    if not 1 <= len(text) <= 2 or not text.isdigit():
        raise BadSentenceError("FIELD", f"quality {text!r}; a number would be right")
    n = int(text)
    if n >= len(TRIMBLE_QUALITY):
        raise BadSentenceError("RANGE", f"quality {text}; 0 to {len(TRIMBLE_QUALITY) - 1} would be right")
    return TRIMBLE_QUALITY[n]


def unit(text: str, right: str) -> None:
    """Refuse another unit or label than `right`; some receivers leave it out where the value is missing."""
    if text not in ("", right):
        raise BadSentenceError("FIELD", f"{text!r}; {right} would be right")


KNOT_MPS = 1852.0 / 3600.0


def velocity(f: list[str]) -> tuple[float, float]:
    """Course over ground [deg] and speed [m/s] of VTG, NaN where it does not say; mode N is not valid.

    The speed is that in km/h, whose last decimal is the finer one, else that in knots.
    """
    for at, right in ((2, "T"), (4, "M"), (6, "N"), (8, "K")):
        unit(f[at], right)
    course = number(f[1], "course", 0.0, 360.0)
    number(f[3], "magnetic course", 0.0, 360.0)
    knots, kmh = number(f[5], "speed", 0.0, 1e4), number(f[7], "speed", 0.0, 2e4)
    if len(f[9]) > 1 or (f[9] and not f[9].isupper()):
        raise BadSentenceError("FIELD", f"mode {f[9]!r}; one letter would be right")
    if f[9] == "N":
        return math.nan, math.nan
    return course, kmh / 3.6 if kmh == kmh else knots * KNOT_MPS


Heading: TypeAlias = tuple[float, Quality, float, float, float]
"""What a heading sentence says: heading_deg (NaN = none), quality, tilt_deg, baseline_m, step_deg."""


def heading(text: str, valid: bool) -> Heading:
    """Of HDT and THS, which know neither quality nor baseline."""
    deg = number(text, "heading", 0.0, 360.0)
    if not valid or deg != deg:
        return math.nan, Quality.NONE, math.nan, math.nan, math.nan
    return deg, Quality.FIXED, math.nan, math.nan, last_step(text)


def vector_heading(f: list[str]) -> Heading:
    """Of PTNL,AVR; the yaw may be negative."""
    for at, right in ((4, "Yaw"), (6, "Tilt"), (8, "Roll")):
        unit(f[at], right)
    yaw = number(f[3], "yaw", -360.0, 360.0)
    tilt = number(f[5], "tilt", -90.0, 90.0)
    number(f[7], "roll", -180.0, 180.0)
    baseline = number(f[9], "range", 0.0, 1e6)
    quality = trimble_quality(f[10])
    if quality == Quality.NONE or yaw != yaw:
        return math.nan, Quality.NONE, tilt, baseline, math.nan
    return (yaw + 360.0 if yaw < 0.0 else yaw), quality, tilt, baseline, last_step(f[3])


_MONTH_DAYS = (31, 29, 31, 30, 31, 30, 31, 31, 30, 31, 30, 31)


def day_number(year: int, month: int, day: int) -> int:
    """Days from 1970-01-01 to a date of the Gregorian calendar (H. Hinnant's days_from_civil)."""
    leap = year % 4 == 0 and (year % 100 != 0 or year % 400 == 0)
    if (
        not 1980 <= year <= 2199
        or not 1 <= month <= 12
        or not 1 <= day <= _MONTH_DAYS[month - 1] - (month == 2 and not leap)
    ):
        raise BadSentenceError("RANGE", f"date {year}-{month}-{day}; a day from 1980 on would be right")
    y = year - (month <= 2)
    era_year = y % 400
    day_of_year = (153 * (month + (-3 if month > 2 else 9)) + 2) // 5 + day - 1
    return y // 400 * 146097 + era_year * 365 + era_year // 4 - era_year // 100 + day_of_year - 719468


def two_digit_day(year: str, month: str, day: str) -> int:
    """Days from 1970-01-01; years 80 to 99 are of the last century."""
    n = int(year)
    return day_number(1900 + n if n >= 80 else 2000 + n, int(month), int(day))


def nearest_day(tod: int, utc_ns: int) -> int:
    """The instant with time of day `tod` that lies nearest to `utc_ns`."""
    return tod + (utc_ns - tod + HALF_DAY_NS) // DAY_NS * DAY_NS
