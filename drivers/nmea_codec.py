"""NMEA 0183 out of a byte stream that may hold anything else: bytes in, one `GnssFix` per epoch out, no I/O, no clock.
A receiver with two antennas adds `GnssHeading`s, which are values of their own.

**Sentences.** `$`, printable characters, `*` and two hexadecimal digits, anywhere in the stream: a line end is not
needed, so binary may run straight into a `$`. Any talker; GGA, GNS, RMC, GST, ZDA, VTG, HDT, THS, the DOP of GSA and
Trimble's PTNL,GGK and PTNL,AVR are decoded, every other sentence with a good checksum is accepted and left alone
(`not_decoded` counts them). A bad sentence changes nothing and becomes a `Reject`:

    CHECKSUM     the two digits differ from the exclusive-or, or are no digits
    NO_CHECKSUM  the line ends before a `*`
    TRUNCATED    the next `$` comes before a `*`
    LENGTH       longer than 120 bytes (decoded types; the standard says 82, high precision needs more) or 1024 (others)
    CHARACTER    a byte that is not printable ASCII stands inside
    FIELD        a field is missing, or is not what the sentence has there
    RANGE        a number no receiver on earth can mean
    BINARY_CRC   a binary frame failed its own check

A `$` that is not followed by something like an address is no sentence but garbage, as are NUL bytes and lines that
begin with `#` (comments, Unicore and NovAtel text logs): counted in `skipped_bytes`, never a Reject.

**Binary.** UBX, RTCM 3, SBF, NovAtel (long, short header) and Unicore frames are skipped by their own length and check,
so a `$` inside starts nothing. If the check fails, reading resumes one byte on, so nothing good behind it is lost.

**Epochs.** Sentences of one time form an epoch, in any order, whatever is missing. It ends at the type (GGK, GGA,
GNS or GST) that came last in each of the last three epochs with a position, else at the first sentence of another time.
RMC and ZDA only bring the date, and may come at any rate. Every GGA makes one fix: a second one of the same time
begins an epoch of its own (`repeated_times` counts them). Position from GGK, else from GGA, else from GNS; what GGK
does not say (HDOP, separation, age, station) comes from the GGA or GNS of its epoch. A GST that comes too late or less
often than the position serves the next fixes of the same quality for 1.5 s. VTG has no time: inside
an epoch its course and speed are the epoch's. Behind one that has ended it is that one's too, and too late, unless it
arrived nearer to the sentence that begins the next (a receiver that sends VTG first).

**Headings.** Never wait and never hold a fix up. AVR has a time. HDT and THS have none: the first one that stands
behind a sentence with a new time belongs to that time's epoch, further ones (a compass may be faster than the
positions) have only their arrival. Of several types in one stream only the best is given out, AVR before THS before
HDT (`headings_beside` counts the others): they are the same measurement. THS in another mode than A, an empty HDT and
an AVR of quality 0 are given out as not valid (`headings_invalid`).

**Date.** From RMC (status A) or ZDA; then it runs on by itself through midnight: the day is the one that puts the fix
nearest to where the last one plus the host's monotonic time says. Without them the day nearest to the host's
clock; with no clock either, an arbitrary day (`date_known` False, `utc_ns` counts from 1970-01-02 and stays monotone).
A day that jumps must be said twice to be believed. Dates that lie 1024 weeks, or a multiple, before the host's clock
are GPS week roll-overs of old firmware: corrected, with an Event. Second 60 is a leap second and falls, as in POSIX
time, on the following midnight. `utc_ns` 0 = the position came without a time.

Nothing depends on how the bytes were cut: each output carries the stamp of the byte that decided it.
Left out: AIS (`!`), other proprietary solutions (PUBX, PASHR, PSTI).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import TypeAlias

from drivers.binary_frames import HEAD, frame_error, frame_length
from drivers.nmea_fields import (
    DAY_NS,
    HALF_DAY_NS,
    BadSentenceError,
    Heading,
    Position,
    day_number,
    heading,
    nearest_day,
    need_fields,
    number,
    position,
    show,
    time_of_day,
    trimble_quality,
    two_digit_day,
    unit,
    vector_heading,
    velocity,
    xor8,
)
from edge_agent.messages import Event, GnssFix, GnssHeading, Quality, Reject, S, State

Output: TypeAlias = list[GnssFix | GnssHeading | Reject | Event]

DECODED_LIMIT = 120
OTHER_LIMIT = 1024
GST_CARRY_NS = 3 * S // 2
DOP_CARRY_NS = 10 * S
VELOCITY_CARRY_NS = 3 * S // 2
HEADING_RANK = {"AVR": 3, "THS": 2, "HDT": 1}
HEADING_PATIENCE = 20
"""Lesser heading sentences that pass before the better type counts as gone: 2 s of HDT at 10 Hz beside THS."""
ROLLOVER_NS = 1024 * 7 * 86400 * S
DATE_SLACK_NS = 18 * 3600 * S
"""Beyond this distance from the host's clock a day that was only chosen, not told, is chosen anew."""
COARSE_STEP_M = 0.002
"""Decimals this coarse hide what the monitor is for: 5 of a minute are 19 mm, 6 are 1.9 mm; height 2 are 10 mm."""
COARSE_RUN = 10
"""Epochs that must agree before a stream changes from coarse to fine or back: some receivers drop zeros at the end."""
MINUTE_M = 6378137.0 * math.pi / 10800.0
"""One minute of arc on the equator; along a meridian it is 0.7 % less or 0.3 % more, which a step does not need."""

_START = re.compile(rb"\$|\xb5(?:b|\Z)|\xd3(?:[\x00-\x03]|\Z)|\xaa(?:D(?:[\x12\x13\xb5]|\Z)|\Z)")
_BODY = re.compile(rb"[ -#%-)+-~]*")  # printable, neither $ nor *
_ADDRESS = re.compile(rb"[A-Z][A-Z0-9]{2}")
_HEX = {bytes((a, b)): int(bytes((a, b)), 16) for a in b"0123456789ABCDEFabcdef" for b in b"0123456789ABCDEFabcdef"}
_DIGITS = "0123456789"
_GNS_MODES = "RFPDAEMSN"
_GNS_QUALITY = (
    Quality.FIXED,
    Quality.FLOAT,
    Quality.PPS,
    Quality.DGNSS,
    Quality.SINGLE,
    Quality.ESTIMATED,
    Quality.MANUAL,
    Quality.SIMULATED,
    Quality.NONE,
)
_NAN3 = (math.nan, math.nan, math.nan)
_EMPTY = -2


class NmeaCodec:
    """See the module's text. `counters` and the two stamps are for reading only; -1 = never."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = dict.fromkeys(
            (
                "bytes",
                "sentence_bytes",  # with the line ends
                "binary_bytes",
                "skipped_bytes",  # garbage, comments, NUL, and what stood in rejected sentences
                "sentences",  # = accepted: good checksum, good fields
                "accepted",
                "rejected",
                "binary_frames",
                "fixes",  # GnssFix given out, any quality
                "positions",  # of those, with a position of quality > 0
                "repeated_times",
                "late_sentences",  # came after their epoch was closed
                "not_decoded",  # of the accepted ones
                "headings",  # GnssHeading given out, valid or not
                "headings_invalid",
                "headings_beside",
            ),
            0,
        )
        self.last_sentence_ns = -1
        self.last_position_ns = -1
        # bytes that wait for the rest of a sentence or frame, and which of them came when: (end, t_ns, hint_ns)
        self._buffer = b""
        self._marks: list[tuple[int, int, int]] = []
        self._need = 0  # no use in looking again before the buffer is so long; found again after load
        self._line_start = True
        self._comment = False
        # the epoch: open, or the last one closed
        self._open = False
        self._key = _EMPTY  # time of day [ns]
        self._kinds: dict[str, str] = {}  # sentence type -> talker, in the order of arrival
        self._ggk: Position | None = None  # with its DOP for HDOP and the ellipsoidal height for MSL
        self._gga: Position | None = None
        self._gns: Position | None = None
        self._gst: tuple[float, float, float] | None = None
        self._last_kind = ""
        self._history: list[str] = []
        self._ender = ""
        self._fix_key = _EMPTY
        # carried from epoch to epoch
        self._gst_last: tuple[int, int, float, float, float] | None = None  # key, quality, e, n, u
        self._dop: tuple[int, float, float] | None = None  # arrival_ns, pdop, vdop
        self._velocity: tuple[int, float, float] | None = None  # arrival_ns, course, speed; until a fix takes it
        self._between = -1  # arrival of what ended the epoch before the VTG that waits; -1 = none waits, or inside one
        self._now = -1  # arrival of the sentence in hand
        self._ended = -1  # arrival of what ended the last epoch
        self._heading_key = _EMPTY  # the epoch that has its heading
        self._heading_rank = 0
        self._heading_beside = 0
        self._separation = math.nan
        self._separation_missing = False
        self._coarse = -1  # -1 not known, 0 fine, 1 coarse
        self._coarse_run = 0
        # the calendar
        self._utc = -1
        self._utc_at = 0
        self._date_known = False
        self._date_doubt = 0  # days that the last sentence wanted to jump
        self._rollovers = 0
        self._handlers: dict[bytes, Callable[[str, list[str], int, int, Output], None]] = {
            b"GGA,": self._on_gga,
            b"GNS,": self._on_gns,
            b"RMC,": self._on_rmc,
            b"GST,": self._on_gst,
            b"ZDA,": self._on_zda,
            b"GSA,": self._on_gsa,
            b"VTG,": self._on_vtg,
            b"HDT,": self._on_hdt,
            b"THS,": self._on_ths,
        }
        self._proprietary = {b"PTNL,GGK,": self._on_ggk, b"PTNL,AVR,": self._on_avr}

    # ------------------------------------------------------------------------------------------------------ the stream

    def feed(self, t_ns: int, data: bytes, utc_hint_ns: int) -> Output:
        """Take the bytes that were read at monotonic `t_ns`; give what they complete.

        `utc_hint_ns` = the host's UTC at `t_ns`, 0 when it does not know. Outputs have source "" (the caller knows it).
        """
        out: Output = []
        if not data:
            return out
        self.counters["bytes"] += len(data)
        buffer = self._buffer + data if self._buffer else data
        self._marks.append((len(buffer), t_ns, utc_hint_ns))
        if len(buffer) < self._need:
            self._buffer = buffer
            return out
        self._keep(buffer, self._scan(buffer, out))
        return out

    @property
    def waiting(self) -> int:
        """Bytes that wait for the rest of a sentence or frame: bytes = sentence_bytes + binary_bytes + skipped_bytes +
        waiting."""
        return len(self._buffer)

    def finish(self) -> Output:
        """The stream is over: reject what is cut off, close the open epoch. For ends that are known, such as a file's;
        a live stream is never over, its rest waits in the state."""
        out: Output = []
        while self._buffer:
            buffer = self._buffer
            t_ns = self._stamp(len(buffer) - 1)[0]
            if buffer[0] == 0x24 and buffer[1:2] != b"@":
                used = self._refuse(buffer, 0, len(buffer), t_ns, "TRUNCATED", "the stream ends inside it", out)
            else:
                self._skip(buffer[:1])
                used = 1
            self._need = 0
            used += self._scan(buffer[used:], out, used) if used < len(buffer) else 0
            self._keep(buffer, used)
        if self._open:
            self._close(out)
        return out

    def _keep(self, buffer: bytes, used: int) -> None:
        self._buffer = buffer[used:]
        if used >= len(buffer):
            self._marks.clear()
            self._need = 0
        elif used:
            self._marks = [(end - used, t, hint) for end, t, hint in self._marks if end > used]
            self._need = max(0, self._need - used)

    def _stamp(self, index: int) -> tuple[int, int]:
        """(t_ns, utc_hint_ns) of the byte at `index` of the buffer."""
        for end, t_ns, hint_ns in self._marks:
            if index < end:
                return t_ns, hint_ns
        raise IndexError(index)

    def _scan(self, buffer: bytes, out: Output, base: int = 0) -> int:
        """Use up what is complete in `buffer` (which begins at `base` of the marks); return how much that was."""
        pos = 0
        size = len(buffer)
        self._need = 0
        while pos < size:
            if buffer[pos] != 0x24:
                match = _START.search(buffer, pos)
                start = match.start() if match else size
                if start > pos:
                    self._skip(buffer[pos:start])
                    pos = start
                if pos == size:
                    break
            if buffer[pos] == 0x24:
                if pos + 1 == size:
                    break
                frame = buffer[pos + 1] == 0x40
            else:
                frame = True
            used = self._frame(buffer, pos, base, out) if frame else self._sentence(buffer, pos, base, out)
            if not used:
                break
            pos += used
            if buffer.startswith(b"\r\n", pos):  # the common case of _skip
                self.counters["sentence_bytes"] += 2
                self._line_start = True
                self._comment = False
                pos += 2
        return pos

    def _skip(self, data: bytes) -> None:
        """Count what lies between sentences and remember whether the line at its end is a comment."""
        if data == b"\r\n" or data == b"\n":
            self.counters["sentence_bytes"] += len(data)
            self._line_start = True
            self._comment = False
            return
        ends = data.count(b"\r") + data.count(b"\n")
        self.counters["sentence_bytes"] += ends
        self.counters["skipped_bytes"] += len(data) - ends
        cut = data.rfind(b"\n") + 1
        if cut:
            self._line_start = True
            self._comment = False
        if cut < len(data):
            if self._line_start:
                self._comment = data[cut] == 0x23
            self._line_start = False

    def _sentence(self, buffer: bytes, pos: int, base: int, out: Output) -> int:
        """Length of what the `$` at `pos` begins and of what was made of it; 0 = wait for more."""
        match = _BODY.match(buffer, pos + 1)
        end = match.end() if match else pos + 1
        size = len(buffer)
        if buffer[pos + 1] != 0x50:
            handler = self._handlers.get(buffer[pos + 3 : pos + 7])
        else:  # P: proprietary
            handler = self._proprietary.get(buffer[pos + 1 : pos + 10])
        limit = OTHER_LIMIT if handler is None else DECODED_LIMIT
        if end - pos > limit - 3:
            at = pos + limit - 3  # the byte that would have to be the `*`
            detail = f"no checksum within {limit} bytes"
            return self._refuse(buffer, pos, at, self._stamp(base + at)[0], "LENGTH", detail, out)
        if end == size:
            return 0
        stop = buffer[end]
        if stop == 0x2A:
            last = end + 2
            if last >= size:
                return 0
            body = buffer[pos + 1 : end]
            t_ns, hint_ns = self._stamp(base + last)
            said = _HEX.get(buffer[end + 1 : end + 3])
            right = xor8(body)
            if said == right:
                if handler is not None:
                    fields = body.decode("ascii").split(",")
                    self._now = t_ns
                    try:
                        handler(fields[0][:2], fields, t_ns, hint_ns, out)
                    except BadSentenceError as e:
                        return self._refuse(buffer, pos, last + 1, t_ns, e.reason, e.detail, out)
                else:
                    self.counters["not_decoded"] += 1
                counters = self.counters
                counters["sentences"] += 1
                counters["accepted"] += 1
                counters["sentence_bytes"] += last + 1 - pos
                self.last_sentence_ns = t_ns
                self._line_start = False
                return last + 1 - pos
            until = end + 1 if said is None else last + 1
            detail = f"*{show(buffer[end + 1 : end + 3])} stands there, *{right:02X} would be right"
            return self._refuse(buffer, pos, until, t_ns, "CHECKSUM", detail, out, said is not None and end > pos + 1)
        t_ns = self._stamp(base + end)[0]
        if stop == 0x24:
            detail = f"the next sentence begins after {end - pos} bytes, before a checksum"
            return self._refuse(buffer, pos, end, t_ns, "TRUNCATED", detail, out)
        if stop in (0x0D, 0x0A):
            detail = f"the line ends without *{xor8(buffer[pos + 1 : end]):02X}"
            return self._refuse(buffer, pos, end, t_ns, "NO_CHECKSUM", detail, out)
        detail = f"byte 0x{stop:02X} at position {end - pos}; printable ASCII would be right"
        return self._refuse(buffer, pos, end, t_ns, "CHARACTER", detail, out)

    def _refuse(
        self,
        buffer: bytes,
        pos: int,
        until: int,
        t_ns: int,
        reason: str,
        detail: str,
        out: Output,
        sure: bool = False,
    ) -> int:
        """Give up `buffer[pos:until]`: a Reject if it looks like a sentence outside of a comment, garbage if not."""
        if self._comment or not (sure or _ADDRESS.match(buffer, pos + 1, until)):
            self._skip(buffer[pos : pos + 1])
            return 1
        self.counters["skipped_bytes"] += until - pos
        self._line_start = False
        self._reject(t_ns, reason, f"{show(buffer[pos : min(until, pos + DECODED_LIMIT)])}: {detail}", out)
        return until - pos

    def _reject(self, t_ns: int, reason: str, detail: str, out: Output) -> None:
        counters = self.counters
        counters["rejected"] += 1
        counters["rejected_" + reason] = counters.get("rejected_" + reason, 0) + 1
        out.append(Reject(t_ns, "", reason, detail))

    # ---------------------------------------------------------------------------------------------------------- binary

    def _frame(self, buffer: bytes, pos: int, base: int, out: Output) -> int:
        """Length of the binary frame whose first byte stands at `pos`, 1 where it is none, 0 = wait for more."""
        name, total = frame_length(buffer[pos : pos + HEAD])
        if total < 0:
            return self._wait(pos - total)
        if total and pos + total > len(buffer):
            return self._wait(pos + total)
        if total:
            detail = frame_error(name, buffer[pos : pos + total])
            if not detail:
                self.counters["binary_frames"] += 1
                self.counters["binary_bytes"] += total
                self._line_start = False
                self._comment = False
                return total
            if not self._comment:
                self._reject(self._stamp(base + pos + total - 1)[0], "BINARY_CRC", detail, out)
        self._skip(buffer[pos : pos + 1])  # no frame, or a damaged one: what stands behind it may be good
        return 1

    def _wait(self, size: int) -> int:
        self._need = size
        return 0

    # ------------------------------------------------------------------------------------------------------- sentences
    # Each handler reads all that it needs before it changes anything.

    def _on_gga(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        said = f[6] if len(f) > 6 else ""
        if len(said) == 1 and said in _DIGITS:
            name = "gga_quality_" + said  # by the stream's own word, also where another field spoils the sentence
            self.counters[name] = self.counters.get(name, 0) + 1
        else:
            raise BadSentenceError("FIELD", f"quality {said!r}; one digit would be right")
        need_fields("GGA", f, 11, 15)
        if said == "9":
            raise BadSentenceError("RANGE", "quality 9; 0 to 8 would be right")
        if f[10] not in ("M", "") or f[12] not in ("M", ""):
            raise BadSentenceError("FIELD", f"units {f[10]!r}, {f[12]!r}; M would be right")
        tod = time_of_day(f[1])
        pos = position(f, 2, int(said), f[7], f[8], f[9], f[11], f[13], f[14], t_ns, hint_ns)
        self._enter("GGA", talker, tod, out)
        self._gga = pos
        self._placed("GGA", t_ns, pos, out)

    def _on_gns(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("GNS", f, 10, 13)
        best = min((_GNS_MODES.find(c) for c in f[6]), default=-1)
        if best < 0:
            raise BadSentenceError("FIELD", f"mode {f[6]!r}; letters of {_GNS_MODES} would be right")
        tod = time_of_day(f[1])
        quality = int(_GNS_QUALITY[best])
        pos = position(f, 2, quality, f[7], f[8], f[9], f[10], f[11], f[12], t_ns, hint_ns)
        if self._enter("GNS", talker, tod, out):
            self._gns = pos
            self._placed("GNS", t_ns, pos, out)

    def _on_gst(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("GST", f, 9, 9)
        tod = time_of_day(f[1])
        north, east, up = (number(f[i], "sigma", 0.0, 1e7) for i in (6, 7, 8))
        std = (east, north, up)
        if self._enter("GST", talker, tod, out):
            self._gst = std
            self._placed("GST", t_ns, None, out)
        elif tod == self._key and not self._open:  # its fix has gone out; the next ones may use it
            pos = self._placement()
            if pos is not None and self._gst is None:
                self._gst_last = (tod, pos[6], *std)

    def _on_rmc(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("RMC", f, 10, 12)
        tod = time_of_day(f[1])
        if f[2] not in ("A", "V"):
            raise BadSentenceError("FIELD", f"status {f[2]!r}; A or V would be right")
        date = f[9]
        day = 0
        if date:
            if len(date) != 6 or date.strip(_DIGITS):
                raise BadSentenceError("FIELD", f"date {date!r}; ddmmyy would be right")
            day = two_digit_day(date[4:], date[2:4], date[:2])
        if date and f[2] == "A" and tod >= 0:  # without a fix many receivers show a date out of thin air
            self._date(day * DAY_NS + tod, t_ns, hint_ns, out)
        self._enter("RMC", talker, tod, out)

    def _on_zda(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("ZDA", f, 5, 7)
        tod = time_of_day(f[1])
        if f[2] or f[3] or f[4]:
            if "" in f[2:5] or (f[2] + f[3] + f[4]).strip(_DIGITS) or len(f[2]) > 2 or len(f[3]) > 2 or len(f[4]) != 4:
                raise BadSentenceError("FIELD", f"date {f[2]!r}, {f[3]!r}, {f[4]!r}; dd, mm, yyyy would be right")
            day = day_number(int(f[4]), int(f[3]), int(f[2]))
            if tod >= 0:
                self._date(day * DAY_NS + tod, t_ns, hint_ns, out)
        self._enter("ZDA", talker, tod, out)

    def _on_gsa(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("GSA", f, 18, 18)
        pdop = number(f[15], "PDOP", 0.0, 1e4)
        number(f[16], "HDOP", 0.0, 1e4)
        vdop = number(f[17], "VDOP", 0.0, 1e4)
        self._dop = (t_ns, pdop, vdop)

    def _on_ggk(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        """time, mmddyy, latitude, longitude, quality, satellites, DOP, EHT + ellipsoidal height, M."""
        need_fields("GGK", f, 12, 13)
        quality = trimble_quality(f[8])
        unit(f[12], "M")
        if f[11] and not f[11].startswith("EHT"):
            raise BadSentenceError("FIELD", f"height {f[11]!r}; EHT and the ellipsoidal height would be right")
        tod = time_of_day(f[2])
        date = f[3]
        day = 0
        if date:
            if len(date) != 6 or date.strip(_DIGITS):
                raise BadSentenceError("FIELD", f"date {date!r}; mmddyy would be right")
            if quality > 0:
                day = two_digit_day(date[4:], date[:2], date[2:4])
        pos = position(f, 4, int(quality), f[9], f[10], f[11][3:], "", "", "", t_ns, hint_ns)
        name = f"ggk_quality_{int(f[8])}"  # Trimble's number
        self.counters[name] = self.counters.get(name, 0) + 1
        if day and tod >= 0:
            self._date(day * DAY_NS + tod, t_ns, hint_ns, out)
        if self._enter("GGK", talker, tod, out):
            self._ggk = pos
            self._placed("GGK", t_ns, pos, out)

    def _on_vtg(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("VTG", f, 9, 10)
        self._velocity = (t_ns, *velocity(f))
        self._between = -1 if self._open or self._ended < 0 else self._ended

    def _on_hdt(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("HDT", f, 2, 3)
        unit(f[2], "T")
        self._heading("HDT", -1, heading(f[1], True), t_ns, hint_ns, out)

    def _on_ths(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        need_fields("THS", f, 3, 3)
        if len(f[2]) != 1 or f[2] not in "AEMSV":
            raise BadSentenceError("FIELD", f"mode {f[2]!r}; a letter of AEMSV would be right")
        self._heading("THS", -1, heading(f[1], f[2] == "A"), t_ns, hint_ns, out)

    def _on_avr(self, talker: str, f: list[str], t_ns: int, hint_ns: int, out: Output) -> None:
        """time, yaw, "Yaw", tilt, "Tilt", roll, "Roll", range, quality, PDOP, satellites."""
        need_fields("AVR", f, 11, 13)
        tod = time_of_day(f[2])
        self._heading("AVR", tod, vector_heading(f), t_ns, hint_ns, out)

    # -------------------------------------------------------------------------------------------------------- headings

    def _heading(self, kind: str, tod: int, said: Heading, t_ns: int, hint_ns: int, out: Output) -> None:
        """Give a heading out, unless the stream holds better ones; `tod` -1 = that of the epoch in which it stands."""
        counters = self.counters
        rank = HEADING_RANK[kind]
        if rank < self._heading_rank and self._heading_beside < HEADING_PATIENCE:
            self._heading_beside += 1
            counters["headings_beside"] += 1
            return
        self._heading_rank = rank
        self._heading_beside = 0
        if tod < 0 and self._key != self._heading_key:
            tod = self._heading_key = self._key
        utc = self._utc_near(tod, t_ns, hint_ns) if tod >= 0 else 0
        deg, quality, tilt, baseline, step = said
        counters["headings"] += 1
        if quality == Quality.NONE:
            counters["headings_invalid"] += 1
        out.append(GnssHeading(0, t_ns, utc, deg, quality, tilt, baseline, step, kind))

    # ---------------------------------------------------------------------------------------------------------- epochs

    def _placement(self) -> Position | None:
        """The position that holds for the epoch: GGK's, else GGA's, else GNS's. A GGK without one hides no other."""
        ggk = self._ggk
        other = self._gga or self._gns
        return ggk if ggk is not None and (ggk[6] > 0 or other is None) else other

    def _enter(self, kind: str, talker: str, tod: int, out: Output) -> bool:
        """Find the epoch of a sentence, closing and opening as the module's text says; False = it is in none."""
        key = self._key
        is_position = kind in ("GGA", "GNS", "GGK")
        if not is_position and tod >= 0 and key >= 0 and tod != key and (tod - key) % DAY_NS > HALF_DAY_NS:
            self.counters["late_sentences"] += 1  # of an earlier epoch
            return False
        if tod == key:
            before = self._kinds.get(kind)
            if before is None and self._open:
                self._kinds[kind] = talker
                return True
            if kind != "GGA":  # each GGA makes a fix, so one more begins an epoch
                if before is None:
                    if kind in ("GNS", "GST", "GGK"):
                        self._last_kind = kind
                    self.counters["late_sentences"] += 1
                    return False
                if before != talker or kind == "RMC" or kind == "ZDA":
                    return False  # the standard lets each constellation send its own GNS, GST
        if self._open:
            self._close(out)
        if self._last_kind and self._placement() is not None:
            self._history = [*self._history[-2:], self._last_kind]
            same = len(self._history) == 3 and len(set(self._history)) == 1
            self._ender = self._last_kind if same else ""
        if self._between >= 0 and self._velocity is not None:
            if self._velocity[0] - self._between <= self._now - self._velocity[0]:
                self._velocity = None  # of the epoch before
            self._between = -1
        self._open = True
        self._key = tod
        self._kinds = {kind: talker}
        self._ggk = self._gga = self._gns = None
        self._gst = None
        self._last_kind = ""
        return True

    def _placed(self, kind: str, t_ns: int, pos: Position | None, out: Output) -> None:
        """A sentence of GGK, GGA, GNS, GST has been stored in its epoch: note it, end the epoch if this is its end."""
        self._last_kind = kind
        if pos is not None and pos[6] > 0:
            self.last_position_ns = t_ns
        if kind == self._ender and self._placement() is not None:
            self._close(out)

    def _close(self, out: Output) -> None:
        """End the open epoch; give its fix, if it has a position sentence, and the Events that come with it."""
        self._open = False
        self._ended = self._now
        pos = self._placement()
        if pos is None:
            return
        arrival, hint, lat, lon, msl, separation, quality, satellites, hdop, age, station, minutes, step_h = pos
        tod = self._key
        std = self._gst
        last = self._gst_last
        if std is not None:
            self._gst_last = (tod, quality, *std)
        elif last is not None and last[1] == quality and tod >= 0 and (tod - last[0]) % DAY_NS <= GST_CARRY_NS:
            std = last[2:]
        if tod >= 0:
            if tod == self._fix_key:
                self.counters["repeated_times"] += 1
            utc = self._utc_of(tod, arrival, hint, out)
        else:
            utc = 0
        self._fix_key = tod
        dop = self._dop
        if dop is None or arrival - dop[0] > DOP_CARRY_NS:
            dop = (0, math.nan, math.nan)
        ellipsoidal = pos is self._ggk
        if ellipsoidal:
            dop = (0, hdop, dop[2])
            other = self._gga or self._gns
            hdop, separation, age, station = (other[8], other[5], other[9], other[10]) if other else (*_NAN3, "")
        velocity = self._velocity
        self._velocity = None
        if velocity is None or arrival - velocity[0] > VELOCITY_CARRY_NS:
            velocity = (0, math.nan, math.nan)
        placed = lat == lat and msl == msl
        height = math.nan
        step = _NAN3
        if lat == lat:
            step = (minutes * MINUTE_M * math.cos(math.radians(lat)), minutes * MINUTE_M, step_h)
        if placed:
            height = msl if ellipsoidal else msl + self._geoid(separation, quality, arrival, out)
            if quality > 0:
                self._decimals(step, arrival, out)
        self.counters["fixes"] += 1
        if quality > 0 and lat == lat:
            self.counters["positions"] += 1
        out.append(
            GnssFix(
                0,
                arrival,
                utc,
                self._date_known and tod >= 0,
                lat,
                lon,
                height,
                separation,
                Quality(quality),
                satellites,
                hdop,
                dop[1],
                dop[2],
                age,
                station,
                std or _NAN3,
                step,
                tuple(self._kinds),
                velocity[1],
                velocity[2],
            )
        )

    def _geoid(self, separation: float, quality: int, t_ns: int, out: Output) -> float:
        """Separation to add to the height above the geoid [m]. MSL + separation is ellipsoidal whatever geoid the
        receiver holds, so a change moves nothing; where it says none, the last one holds, else 0."""
        before = self._separation
        if quality == 0:
            return separation if separation == separation else (before if before == before else 0.0)
        missing = separation != separation
        if missing and not self._separation_missing:
            held = before if before == before else 0.0
            text = f"the receiver gives no geoid separation; {held} m is taken"
            out.append(Event(t_ns, "NO_SEPARATION", "", text, (("separation_m", held),)))
        self._separation_missing = missing
        if missing:
            return before if before == before else 0.0
        if abs(separation - before) > 0.01:
            text = f"geoid separation {before} -> {separation} m; the ellipsoidal height does not jump with it"
            out.append(Event(t_ns, "SEPARATION", "", text, (("before_m", before), ("after_m", separation))))
        self._separation = separation
        return separation

    def _decimals(self, step: tuple[float, float, float], t_ns: int, out: Output) -> None:
        """Say once that the decimals are too few, and once that they are enough again."""
        coarse = int(step[1] > COARSE_STEP_M or step[2] > COARSE_STEP_M)
        if coarse == self._coarse:
            self._coarse_run = 0
            return
        self._coarse_run += 1
        if self._coarse >= 0 and self._coarse_run < COARSE_RUN:
            return
        first = self._coarse < 0
        self._coarse = coarse
        self._coarse_run = 0
        values = (("step_e_m", step[0]), ("step_n_m", step[1]), ("step_u_m", step[2]))
        steps = f"{step[1] * 1000:.3g} mm north, {step[2] * 1000:.3g} mm up"
        if coarse:
            text = (
                f"the position sentence has too few decimals: one step is {steps}. Make the receiver send at least 7"
                " decimals of a minute and 3 of the height (u-blox: CFG-NMEA-HIGHPREC = 1; others: the setting for"
                " extended or high-precision NMEA, or more digits of GGA)"
            )
            out.append(Event(t_ns, "COARSE_GGA", "", text, values))
        elif not first:
            out.append(Event(t_ns, "FINE_GGA", "", f"the position's decimals suffice now: one step is {steps}", values))

    # -------------------------------------------------------------------------------------------------------- calendar

    def _date(self, utc_ns: int, t_ns: int, hint_ns: int, out: Output) -> None:
        """A sentence says date and time: believe it, mend a week roll-over, or doubt a jump until it is said again."""
        rollovers = 0
        if hint_ns:
            rollovers = round((hint_ns - utc_ns) / ROLLOVER_NS)
            if rollovers < 1 or abs(hint_ns - utc_ns - rollovers * ROLLOVER_NS) > DAY_NS:
                rollovers = 0
        utc_ns += rollovers * ROLLOVER_NS
        if self._utc >= 0:
            expected = self._utc + t_ns - self._utc_at
            jump = (utc_ns - expected + HALF_DAY_NS) // DAY_NS
            if jump:
                if self._date_known and jump != self._date_doubt:
                    self._date_doubt = jump
                    return
                if self._date_known or expected > 2 * DAY_NS:  # not from the arbitrary day of a clockless start
                    values = (("days", float(jump)),)
                    out.append(Event(t_ns, "DATE_CHANGED", "", f"the receiver's date moves by {jump} days", values))
        if rollovers != self._rollovers:
            self._rollovers = rollovers
            if rollovers:
                weeks = 1024 * rollovers
                text = f"the receiver's date is {weeks} weeks old (GPS week roll-over): corrected; update its firmware"
                out.append(Event(t_ns, "WEEK_ROLLOVER", "", text, (("weeks", float(weeks)),)))
        self._date_doubt = 0
        self._date_known = True
        self._utc = utc_ns
        self._utc_at = t_ns

    def _utc_near(self, tod: int, t_ns: int, hint_ns: int) -> int:
        """UTC of a time of day that arrived at `t_ns`, as far as the calendar is known."""
        if self._utc >= 0:
            return nearest_day(tod, self._utc + t_ns - self._utc_at)
        return nearest_day(tod, hint_ns) if hint_ns else DAY_NS + tod

    def _utc_of(self, tod: int, t_ns: int, hint_ns: int, out: Output) -> int:
        """UTC of a time of day that arrived at `t_ns`, from which the calendar goes on."""
        utc = self._utc_near(tod, t_ns, hint_ns)
        if not self._date_known and hint_ns and abs(utc - hint_ns) > DATE_SLACK_NS:
            moved = nearest_day(tod, hint_ns)
            if self._utc > 2 * DAY_NS + HALF_DAY_NS:
                days = (moved - utc) // DAY_NS
                text = f"no date from the receiver; the host's clock moves it by {days} days"
                out.append(Event(t_ns, "DATE_CHANGED", "", text, (("days", float(days)),)))
            utc = moved
        self._utc = utc
        self._utc_at = t_ns
        return utc

    # ----------------------------------------------------------------------------------------------------------- state

    def save(self) -> State:
        """Everything that the outputs to come depend on."""
        return {
            "counters": dict(self.counters),
            "last_sentence_ns": self.last_sentence_ns,
            "last_position_ns": self.last_position_ns,
            "buffer": self._buffer,
            "marks": [list(m) for m in self._marks],
            "line": [self._line_start, self._comment],
            "open": self._open,
            "key": self._key,
            "kinds": [[k, v] for k, v in self._kinds.items()],
            "ggk": _list(self._ggk),
            "gga": _list(self._gga),
            "gns": _list(self._gns),
            "gst": _list(self._gst),
            "last_kind": self._last_kind,
            "history": list(self._history),
            "ender": self._ender,
            "fix_key": self._fix_key,
            "gst_last": _list(self._gst_last),
            "dop": _list(self._dop),
            "velocity": _list(self._velocity),
            "between": self._between,
            "ended": self._ended,
            "heading": [self._heading_key, self._heading_rank, self._heading_beside],
            "separation": [self._separation, self._separation_missing],
            "coarse": [self._coarse, self._coarse_run],
            "utc": [self._utc, self._utc_at],
            "date": [self._date_known, self._date_doubt, self._rollovers],
        }

    def load(self, s: State) -> None:
        """Continue where `save` was called."""
        self.counters = dict(s["counters"])
        self.last_sentence_ns = s["last_sentence_ns"]
        self.last_position_ns = s["last_position_ns"]
        self._buffer = s["buffer"]
        self._marks = [(m[0], m[1], m[2]) for m in s["marks"]]
        self._need = 0
        self._line_start, self._comment = s["line"]
        self._open = s["open"]
        self._key = s["key"]
        self._kinds = dict(s["kinds"])
        self._ggk = None if s["ggk"] is None else tuple(s["ggk"])
        self._gga = None if s["gga"] is None else tuple(s["gga"])
        self._gns = None if s["gns"] is None else tuple(s["gns"])
        self._gst = None if s["gst"] is None else tuple(s["gst"])
        self._last_kind = s["last_kind"]
        self._history = list(s["history"])
        self._ender = s["ender"]
        self._fix_key = s["fix_key"]
        self._gst_last = None if s["gst_last"] is None else tuple(s["gst_last"])
        self._dop = None if s["dop"] is None else tuple(s["dop"])
        self._velocity = None if s["velocity"] is None else tuple(s["velocity"])
        self._between, self._ended = s.get("between", -1), s.get("ended", -1)  # not in states before 2026-12
        self._heading_key, self._heading_rank, self._heading_beside = s["heading"]
        self._separation, self._separation_missing = s["separation"]
        self._coarse, self._coarse_run = s["coarse"]
        self._utc, self._utc_at = s["utc"]
        self._date_known, self._date_doubt, self._rollovers = s["date"]


def _list(x: tuple[int | float | str, ...] | None) -> list[int | float | str] | None:
    return None if x is None else list(x)
