"""Logs of others -> a raw recording that `replay` takes like one of the agent's own.

NMEA text or mixed binary captures, each line led by its host arrival time as candump writes it or by none, and
`candump -l` logs. The monotonic clock is made from the log's UTC: t = utc - first stamp + 1000 s, so that nothing is
negative; a Tick stands at every whole second of it. Sources are merged in the order of time, then of the command line.

Rules: every byte of an NMEA file goes into the recording, understood or not; a line without a time of its own travels
with the epoch that it follows, binary bytes with the line that they precede. Lines of a CAN log that are no frames are
counted and named. Time that steps back by more than a second (logs put end to end, a clock set) is carried on from
there and named.

Left out: any decoding beyond the time of a sentence. What the bytes mean is decided by the pipeline at replay.
"""

from __future__ import annotations

import datetime
import heapq
import importlib.metadata
import itertools
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edge_agent.messages import MS, CanFlag, CanFrames, Config, PortSettings, Raw, S, Tick

MONOTONIC_START_NS = 1000 * S
"""Monotonic time of the first stamp: as if the gateway had been up for a while."""
DEFAULT_LATENCY_NS = 100 * MS
"""From epoch to arrival where neither the log nor the configuration says: what RTK receivers take at 1 to 10 Hz."""
STEP_BACK_NS = 1 * S
"""Stamps that go back by less are jitter of the logger and are clamped."""
MAX_TICK_GAP_NS = 3600 * S
"""A longer pause in all logs holds no ticks but at its ends: nothing ran then."""
MAX_LINE_BYTES = 1 << 20
"""Binary without a line end is cut here."""
MAX_NAMED = 20
"""Complaints printed for each file; the others are counted."""

DAY_NS = 86_400 * S


class ImportRefusedError(ValueError):
    """The import cannot be made as asked; the text says what would be right."""


@dataclass
class Log:
    """One input file and what was noticed in it."""

    path: Path
    port: str
    interface: str | None = None  # CAN: only this interface of the log
    lines: int = 0
    items: int = 0  # bytes of NMEA, frames of CAN
    lost: int = 0  # CAN lines that are no frames
    other: int = 0  # frames of interfaces that were not asked for
    notes: list[str] = field(default_factory=list)
    noted: int = 0

    def note(self, line: int, text: str) -> None:
        self.noted += 1
        if len(self.notes) < MAX_NAMED:
            self.notes.append(f"{self.path.name}:{line}: {text}")


@dataclass(frozen=True, slots=True)
class Imported:
    """What an import did: `lost` = CAN lines that are not in the recording."""

    path: str
    raws: int
    ticks: int
    first_utc_ns: int
    last_utc_ns: int
    logs: tuple[Log, ...]

    @property
    def lost(self) -> int:
        return sum(log.lost for log in self.logs)


Piece = tuple[int, int, str, bytes | CanFrames]  # UTC ns, rank of its log, port, payload with UTC stamps


class _Forward:
    """Stamps of one log as a clock that never goes back: small steps are clamped, large ones carried on."""

    def __init__(self, log: Log) -> None:
        self._log = log
        self._shift = 0
        self._last: int | None = None

    def __call__(self, utc_ns: int, line: int) -> int:
        t = utc_ns + self._shift
        if self._last is not None and t < self._last:
            if self._last - t > STEP_BACK_NS:
                self._log.note(line, f"time steps back by {(self._last - t) / S:.3f} s; carried on without a step")
                self._shift += self._last - t
            t = self._last
        self._last = t
        return t


# ---------------------------------------------------------------------------------------------------------------- NMEA

_STAMP = re.compile(rb"\((\d{1,10})\.(\d{1,9})\) ")
_TIMED = re.compile(rb"\$[A-Z]{2}(?:GGA|GNS|RMC|GST|ZDA|GBS|GRS),(\d\d)(\d\d)(\d\d)(?:\.(\d{1,9}))?,")
_RMC_DATE = re.compile(rb"\$[A-Z]{2}RMC,[\d.]+,A,(?:[^,*]*,){6}(\d\d)(\d\d)(\d\d),")
_ZDA_DATE = re.compile(rb"\$[A-Z]{2}ZDA,[\d.]+,(\d\d),(\d\d),(\d{4}),")
_CHECKED = re.compile(rb"\$([^$*\r\n]{1,256})\*([0-9A-Fa-f]{2})")


def nmea_pieces(log: Log, rank: int, latency_ns: int, date: datetime.date | None) -> Iterator[Piece]:
    """Reads of a serial port as the log tells them; lines of one arrival are one read.

    Raises ImportRefusedError where no sentence carries a date and none was given, or nothing carries a time.
    """
    day = _first_day(log.path, date)
    forward = _Forward(log)
    buffer: list[bytes] = []  # bytes of the read being gathered, all of arrival `at`
    waiting: list[bytes] = []  # binary before the next line
    at: int | None = None
    tod_before: int | None = None
    stamped: int | None = None  # the last stamp
    for line, data in _lines(log.path):
        log.lines += 1
        stamp = _STAMP.match(data)
        arrival: int | None = None
        if stamp:
            data = data[stamp.end() :]
            arrival = stamped = _decimal_ns(stamp[1], stamp[2])
        else:
            tod, said = _time_of(data)
            if tod is not None and day is not None:
                if stamped is not None:
                    day = _day_near(stamped, tod)
                elif said is not None:
                    day = said
                elif tod_before is not None and tod < tod_before - DAY_NS // 2:
                    day += datetime.timedelta(days=1)
                tod_before = tod
                arrival = _midnight_ns(day) + tod + latency_ns
        log.items += len(data)
        text = b"$" in data or stamp is not None
        if arrival is None:
            if not text or at is None:
                waiting.append(data)  # binary, or a line before the first time
            else:
                buffer += [*waiting, data]
                waiting.clear()
            continue
        arrival = forward(arrival, line)
        if at is not None and arrival != at and buffer:
            yield at, rank, log.port, b"".join(buffer)
            buffer.clear()
        at = arrival
        buffer += [*waiting, data]
        waiting.clear()
    buffer += waiting
    if at is None:
        if buffer:
            raise ImportRefusedError(
                f"{log.path}: no sentence carries a time (GGA, GNS, RMC, GST, ZDA), no line a stamp"
            )
        return
    if buffer:
        yield at, rank, log.port, b"".join(buffer)


def _first_day(path: Path, date: datetime.date | None) -> datetime.date | None:
    """The day of the first time in a log: of its first RMC, ZDA or stamp, less the midnights before it; else `date`.

    None where the log holds no time at all.
    """
    midnights = 0
    tod_before: int | None = None
    for _, data in _lines(path):
        if stamp := _STAMP.match(data):
            near = _day_near(_decimal_ns(stamp[1], stamp[2]), tod_before or 0)
            return near - datetime.timedelta(days=midnights)
        tod, said = _time_of(data)
        if tod is None:
            continue
        if tod_before is not None and tod < tod_before - DAY_NS // 2:
            midnights += 1
        tod_before = tod
        if said is not None:
            return said - datetime.timedelta(days=midnights)
    if tod_before is None:
        return None
    if date is None:
        raise ImportRefusedError(f"{path}: no RMC or ZDA carries a date; give it with --date YYYY-MM-DD")
    return date


def _time_of(data: bytes) -> tuple[int | None, datetime.date | None]:
    """Time of day in ns and date of the first sentence in a line that carries them with a good checksum."""
    for m in _CHECKED.finditer(data):
        timed = _TIMED.match(m[0])
        if not timed or _xor(m[1]) != int(m[2], 16):
            continue
        h, minute, s = int(timed[1]), int(timed[2]), int(timed[3])
        if h > 23 or minute > 59 or s > 60:
            continue
        tod = (h * 3600 + minute * 60 + s) * S + int((timed[4] or b"0").ljust(9, b"0"))
        return tod, _date_of(m[0])
    return None, None


def _date_of(sentence: bytes) -> datetime.date | None:
    try:
        if m := _RMC_DATE.match(sentence):
            return datetime.date(2000 + int(m[3]), int(m[2]), int(m[1]))
        if m := _ZDA_DATE.match(sentence):
            return datetime.date(int(m[3]), int(m[2]), int(m[1]))
    except ValueError:
        return None  # month 13 and the like: no date said
    return None


def _day_near(utc_ns: int, tod_ns: int) -> datetime.date:
    """The day on which a time of day comes nearest to an instant."""
    return datetime.date.fromordinal(719_163 + (utc_ns - tod_ns + DAY_NS // 2) // DAY_NS)


def _xor(data: bytes) -> int:
    x = 0
    for b in data:
        x ^= b
    return x


def _midnight_ns(day: datetime.date) -> int:
    return (day.toordinal() - 719_163) * DAY_NS  # 719163 = ordinal of 1970-01-01


def _lines(path: Path) -> Iterator[tuple[int, bytes]]:
    """(number from 1, bytes with their line end), each at most MAX_LINE_BYTES long."""
    with path.open("rb") as f:
        number = 0
        while data := f.readline(MAX_LINE_BYTES):
            number += 1
            yield number, data


def _decimal_ns(whole: bytes | str, part: bytes | str) -> int:
    return int(whole) * S + int(int(part) * 10 ** (9 - len(part)))


# ----------------------------------------------------------------------------------------------------------------- CAN

_FRAME = re.compile(
    r"\((\d{1,10})\.(\d{1,9})\)\s+(\S+)\s+([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})"
    r"(?:#R([0-9A-Fa-f]?)|##([0-9A-Fa-f])((?:[0-9A-Fa-f]{2}){0,64})|#((?:[0-9A-Fa-f]{2}){0,8}))"
    r"(?:_[0-9A-Fa-f])?(?:\s+[RT])?\s*\Z"
)


def can_pieces(log: Log, rank: int, block_ns: int) -> Iterator[Piece]:
    """Blocks of frames as the CAN port makes them: a block is closed by the first frame `block_ns` after its first."""
    forward = _Forward(log)
    block: list[tuple[int, int, int, int, bytes]] = []
    interfaces: dict[str, int] = {}
    for number, raw in _lines(log.path):
        log.lines += 1
        if not raw.strip():
            continue
        m = _FRAME.match(raw.decode("ascii", "replace"))
        if not m:
            log.lost += 1
            log.note(number, f"is no candump frame: {raw[:60].decode('ascii', 'replace').strip()!r}")
            continue
        sec, sub, interface, ident, rtr, fd, fd_data, data = m.groups()
        if log.interface is not None and interface != log.interface:
            interfaces[interface] = interfaces.get(interface, 0) + 1
            continue
        t = forward(_decimal_ns(sec, sub), number)
        can_id = int(ident, 16)
        flags = 0
        if len(ident) == 8:
            flags = CanFlag.ERR if can_id & 0x20000000 else CanFlag.EXT
            can_id &= 0x1FFFFFFF
        length = -1
        if rtr is not None:
            flags |= CanFlag.RTR
            length = int(rtr or "0", 16)
        elif fd is not None:
            bits = int(fd, 16)
            flags |= CanFlag.FD | (CanFlag.BRS if bits & 1 else 0) | (CanFlag.ESI if bits & 2 else 0)
        payload = bytes.fromhex(fd_data or data or "")
        if block and t - block[0][0] >= block_ns:
            yield block[-1][0], rank, log.port, _packed(block)
            block.clear()
        block.append((t, can_id, int(flags), len(payload) if length < 0 else length, payload))
        log.items += 1
    if block:
        yield block[-1][0], rank, log.port, _packed(block)
    log.other = sum(interfaces.values())


def _packed(block: Sequence[tuple[int, int, int, int, bytes]]) -> CanFrames:
    width = 64 if any(b[2] & CanFlag.FD for b in block) else 8
    data = np.frombuffer(b"".join(b[4].ljust(width, b"\0") for b in block), np.uint8).reshape(len(block), width)
    return CanFrames(
        t_ns=np.array([b[0] for b in block], np.int64),
        can_id=np.array([b[1] for b in block], np.uint32),
        flags=np.array([b[2] for b in block], np.uint8),
        length=np.array([b[3] for b in block], np.uint8),
        data=data,
    )


# --------------------------------------------------------------------------------------------------------------- merge


def merged(sources: Sequence[Iterable[Piece]]) -> Iterator[tuple[Raw, int]]:
    """All sources and the ticks between them as (Raw, UTC of its t_ns), in the order of time."""
    order = 0
    heads = [(head, rest) for s in sources for rest in [iter(s)] for head in [next(rest, None)] if head is not None]
    # a block's frames are older than its end: the clock starts at the oldest of all
    first = min((int(p.t_ns[0]) if isinstance(p, CanFrames) else utc for (utc, _, _, p), _ in heads), default=0)
    offset = MONOTONIC_START_NS - first
    tick = last = first
    pieces = heapq.merge(*(itertools.chain([head], rest) for head, rest in heads), key=lambda p: (p[0], p[1]))
    for utc, _, port, payload in pieces:
        if utc - last > MAX_TICK_GAP_NS:
            tick += -(-(utc - tick) // S) * S - S
        while tick <= utc:
            yield Raw(tick + offset, order, "clock", Tick(tick, True, 0)), tick
            order += 1
            tick += S
        if isinstance(payload, CanFrames):
            payload = CanFrames(payload.t_ns + offset, payload.can_id, payload.flags, payload.length, payload.data)
        yield Raw(utc + offset, order, port, payload), utc
        order += 1
        last = utc


# --------------------------------------------------------------------------------------------------------------- import


def import_logs(
    output: Path,
    *,
    nmea: Sequence[tuple[str, Path]] = (),
    can: Sequence[tuple[str, Path, str | None]] = (),
    config: Config | None = None,
    dbc: Sequence[Path] = (),
    date: datetime.date | None = None,
) -> Imported:
    """Write one raw recording of all logs; `nmea` holds (port, file), `can` (port, file, interface or None for all).

    Raises ImportRefusedError for what cannot be made, OSError for files; on either nothing is left at `output`.
    """
    from edge_agent.recording import topics
    from edge_agent.recording.writer import SegmentWriter

    logs: list[Log] = []
    sources: list[Iterator[Piece]] = []
    for port, path in nmea:
        _check_port(config, port, "serial", path)
        log = Log(path, port)
        sources.append(nmea_pieces(log, len(logs), _latency_ns(config, port), date))
        logs.append(log)
    for port, path, interface in can:
        _check_port(config, port, "can", path)
        log = Log(path, port, interface)
        sources.append(can_pieces(log, len(logs), _block_ns(config, port)))
        logs.append(log)
    kinds: dict[str, str] = {}
    for kind, port in [("NMEA", p) for p, _ in nmea] + [("CAN", p) for p, _, _ in can]:
        if kinds.setdefault(port, kind) != kind:
            raise ImportRefusedError(f"port {port!r} cannot hold both NMEA and CAN; name another as PORT=FILE")
    attachments = {} if config is None else {"config.yaml": config.text.encode(), **dict(config.files)}
    attachments.update((path.name, path.read_bytes()) for path in dbc)
    metadata = {
        "version": importlib.metadata.version("edge-agent"),
        "site": "" if config is None else config.site,
        "imported": ", ".join(log.path.name for log in logs),
    }
    if output.exists():
        raise ImportRefusedError(f"{output} is there already; remove it or name another")
    part = output.with_name(output.name + ".part")
    part.unlink(missing_ok=True)  # of an import that was cut off: nothing is in it that the logs do not hold
    raws = ticks = first = last = 0
    writer: SegmentWriter | None = None
    done = False
    try:
        for raw, utc_ns in merged(sources):
            if writer is None:
                first = utc_ns
                writer = SegmentWriter(part, metadata=metadata, attachments=attachments, utc_ns=utc_ns)
            writer.add(topics.raw_record(raw, utc_ns))
            raws += 1
            ticks += isinstance(raw.payload, Tick)
            last = utc_ns
        if writer is None:
            raise ImportRefusedError("the logs hold nothing to import")
        final = writer.close()
        done = True
    finally:
        if writer is not None and not done:
            writer.abandon()
            part.unlink(missing_ok=True)
    return Imported(str(final), raws, ticks, first, last, tuple(logs))


def _check_port(config: Config | None, port: str, kind: str, path: Path) -> None:
    if not path.is_file():
        raise ImportRefusedError(f"{path}: no such file")
    if config is not None and (port not in config.ports or config.ports[port].kind != kind):
        there = ", ".join(name for name, p in config.ports.items() if p.kind == kind) or "none"
        raise ImportRefusedError(f"{path}: the configuration has no {kind} port {port!r}; there are: {there}")


def _latency_ns(config: Config | None, port: str) -> int:
    for receiver in config.receivers.values() if config else ():
        if receiver.port == port and receiver.latency_ms is not None:
            return round(receiver.latency_ms * MS)
    return DEFAULT_LATENCY_NS


def _block_ns(config: Config | None, port: str) -> int:
    return (config.ports[port].block_ms if config else PortSettings("", "can").block_ms) * MS
