"""Recordings read back, in the order of the file: replay needs exactly that order, and a torn tail must not stop it.

The walk is over records, not over the summary, so a file without its footer reads like a whole one up to its last whole
chunk. Every chunk's CRC is checked (libraries do not by default). A tail that was cut ends the walk in silence; damage
with more of the file behind it raises DamagedError, for what follows would be out of its context. Messages that another
version wrote are given as today's (`older`).
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Callable, Container, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
import zstandard

from edge_agent.recording import older, topics

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 1, 2, 3, 4, 5, 6, 7
ATTACHMENT, STATISTICS, METADATA, METADATA_INDEX, DATA_END = 9, 11, 12, 13, 15
CHUNK_MAX = 1 << 30
"""No chunk that this program or a sane one writes is larger unpacked; a damaged length must not fill the memory."""

LET_GO = 4 << 20
"""A walk gives back so much of a file at a time."""

Buffer: TypeAlias = bytes | mmap.mmap

_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_WHOLE_MESSAGE = struct.Struct("<BQHIQQ")  # with its record's head
_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<u8"),
        ("publish_ns", "<u8"),
    ]
)
"""The same, of many at once."""
_U16 = struct.Struct("<H")
_U32 = struct.Struct("<I")
_U64 = struct.Struct("<Q")


class DamagedError(ValueError):
    """A file that is not as it was written, and not merely cut at its end."""


class Stored(NamedTuple):
    """One message of a file. Times are UTC ns."""

    topic: str
    schema: str
    log_ns: int
    publish_ns: int
    sequence: int
    data: bytes


class Part(NamedTuple):
    """One record of a file: its opcode, and the position and length of its content."""

    opcode: int
    pos: int
    length: int


class ChunkHead(NamedTuple):
    start_ns: int
    end_ns: int
    size: int  # unpacked
    crc: int
    compression: str
    pos: int  # of the packed data
    length: int


@contextmanager
def view(path: Path) -> Iterator[Buffer]:
    """The file's bytes without reading them all. OSError as open."""
    with open(path, "rb") as file:
        if file.seek(0, 2) == 0:  # nothing to map
            yield b""
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
            yield buffer


def parts(buffer: Buffer, pos: int = len(MAGIC)) -> Iterator[Part]:
    """Whole records from `pos` on, to the footer or the first that is cut or no record (opcode 0: unwritten space)."""
    end = len(buffer)
    behind = pos
    while pos + _RECORD.size <= end:
        opcode, length = _RECORD.unpack_from(buffer, pos)
        pos += _RECORD.size
        if pos - behind > LET_GO and isinstance(buffer, mmap.mmap):  # else the whole file counts as this process's
            behind -= behind % mmap.PAGESIZE
            buffer.madvise(mmap.MADV_DONTNEED, behind, pos - behind)
            behind = pos
        if opcode == 0 or length > end - pos:
            return
        yield Part(opcode, pos, length)
        if opcode == FOOTER:
            return
        pos += length


def chunk_head(buffer: Buffer, part: Part) -> ChunkHead:
    """Head of a chunk record. DamagedError where it does not hold together."""
    fixed = _CHUNK.size
    if part.length < fixed + 8:
        raise DamagedError(f"chunk at byte {part.pos}: too short")
    start, end, size, crc, name = _CHUNK.unpack_from(buffer, part.pos)
    if name > part.length - fixed - 8:
        raise DamagedError(f"chunk at byte {part.pos}: damaged head")
    pos = part.pos + fixed + name
    (length,) = _U64.unpack_from(buffer, pos)
    if length != part.length - fixed - name - 8 or size > CHUNK_MAX or start > end:
        raise DamagedError(f"chunk at byte {part.pos}: damaged head")
    compression = buffer[part.pos + fixed : pos].decode("ascii", "replace")
    return ChunkHead(start, end, size, crc, compression, pos + 8, length)


def chunk_data(buffer: Buffer, head: ChunkHead) -> bytes:
    """A chunk's records, unpacked and checked by its CRC. DamagedError where that fails."""
    packed = buffer[head.pos : head.pos + head.length]
    if head.compression == "":
        data = packed
    elif head.compression == "zstd":
        try:
            declared = zstandard.get_frame_parameters(packed).content_size
            if declared not in (head.size, zstandard.CONTENTSIZE_UNKNOWN):
                raise DamagedError(f"chunk at byte {head.pos}: damaged data (size)")
            data = zstandard.decompress(packed, max_output_size=head.size)
        except zstandard.ZstdError as e:
            raise DamagedError(f"chunk at byte {head.pos}: damaged data ({e})") from None
    else:
        raise DamagedError(f"chunk at byte {head.pos}: compression {head.compression!r} is not supported")
    if len(data) != head.size or (head.crc and zlib.crc32(data) != head.crc):
        raise DamagedError(f"chunk at byte {head.pos}: damaged data (CRC)")
    return data


def _text(buffer: Buffer, pos: int, end: int) -> tuple[str, int]:
    """A string at pos and the position behind it."""
    if pos + 4 > end:
        raise DamagedError(f"string at byte {pos}: cut")
    (n,) = _U32.unpack_from(buffer, pos)
    pos += 4
    if n > end - pos:
        raise DamagedError(f"string at byte {pos}: damaged length")
    try:
        return buffer[pos : pos + n].decode(), pos + n
    except UnicodeDecodeError:  # other readers stop at it, so it must not get into a repaired file
        raise DamagedError(f"string at byte {pos}: damaged text") from None


def _numbers(layout: struct.Struct, buffer: Buffer, pos: int, end: int) -> tuple[int, ...]:
    if pos + layout.size > end:
        raise DamagedError(f"record at byte {pos}: cut")
    return layout.unpack_from(buffer, pos)


@dataclass
class Channels:
    """The schemas and channels that a walk has met so far."""

    schemas: dict[int, tuple[str, bytes]] = field(default_factory=dict)  # id -> name, text
    channels: dict[int, tuple[str, int]] = field(default_factory=dict)  # id -> topic, schema id
    records: dict[tuple[int, int], bytes] = field(default_factory=dict)  # opcode, id -> the record as it stands

    def meet(self, buffer: Buffer, part: Part) -> None:
        """Take a schema or channel record. DamagedError where it does not hold together."""
        end = part.pos + part.length
        (number,) = _numbers(_U16, buffer, part.pos, end)
        if part.opcode == SCHEMA:
            name, pos = _text(buffer, part.pos + 2, end)
            _, pos = _text(buffer, pos, end)  # encoding
            (n,) = _numbers(_U32, buffer, pos, end)
            if pos + 4 + n != end:
                raise DamagedError(f"schema at byte {part.pos}: damaged length")
            self.schemas[number] = name, buffer[pos + 4 : end]
        else:
            (schema,) = _numbers(_U16, buffer, part.pos + 2, end)
            topic, pos = _text(buffer, part.pos + 4, end)
            _text(buffer, pos, end)  # encoding
            self.channels[number] = topic, schema
        self.records[part.opcode, number] = buffer[part.pos - _RECORD.size : end]

    def named(self, channel: int) -> tuple[str, str]:
        """Topic and schema of a channel. KeyError where its file does not define both."""
        topic, schema = self.channels[channel]
        return topic, self.schemas[schema][0] if schema else ""

    def converter(self, channel: int) -> Callable[[bytes], bytes] | None:
        """What makes today's message of one of a channel; None where it is. KeyError as `named`."""
        schema = self.channels[channel][1]
        return older.converter(*self.schemas[schema]) if schema else None

    def are_todays(self, channels: set[int]) -> bool:
        """Whether all of them are known, and none is of another version."""
        return channels <= self.channels.keys() and all(self.converter(c) is None for c in channels)

    def message(self, buffer: Buffer, part: Part) -> Stored:
        """A message record. DamagedError without its channel."""
        end = part.pos + part.length
        channel, sequence, log_ns, publish_ns = _numbers(_MESSAGE, buffer, part.pos, end)
        try:
            topic, name = self.named(channel)
        except KeyError:
            raise DamagedError(f"message at byte {part.pos}: its channel {channel} is not in the file") from None
        data = _today(self.converter(channel), buffer[part.pos + _MESSAGE.size : end], part.pos)
        return Stored(topic, name, log_ns, publish_ns, sequence, data)


def _today(convert: Callable[[bytes], bytes] | None, data: bytes, pos: int) -> bytes:
    """A message as this version would have written it. DamagedError."""
    try:
        return data if convert is None else convert(data)
    except ValueError as e:
        raise DamagedError(f"message at byte {pos}: {e}") from None


def _check_magic(buffer: Buffer, path: Path) -> None:
    if buffer[: len(MAGIC)] != MAGIC:
        raise DamagedError(f"{path}: not an MCAP file")


@dataclass
class Tally:
    """Messages that a walk has passed, wanted or not, and their smallest and largest log time [UTC ns]."""

    messages: int = 0
    begin_ns: int = 0
    end_ns: int = 0

    def add(self, messages: int, begin_ns: int, end_ns: int) -> None:
        if messages:
            self.begin_ns = min(self.begin_ns, begin_ns) if self.messages else begin_ns
            self.end_ns = max(self.end_ns, end_ns)
            self.messages += messages


def read_messages(path: Path, wanted: Container[str] | None = None, tally: Tally | None = None) -> Iterator[Stored]:
    """Messages of the topics `wanted` (None = all) in the order of the file; `tally` counts all that were passed, and
    is right when the walk has ended. Topics that are not wanted cost little: ask for what you need.

    Raises OSError, DamagedError for a file that is no MCAP or is damaged before its tail. A file that is being written
    gives what was flushed when it was opened.
    """
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        yield from _messages(buffer, Channels(), wanted, tally or Tally())


Named: TypeAlias = dict[int, tuple[str, str, bool, Callable[[bytes], bytes] | None]]


def _in_chunk(
    data: bytes, known: Channels, wanted: Container[str] | None, named: Named, tally: Tally
) -> Generator[Stored, None, int]:
    """Messages of an unpacked chunk; returns how far its records reach. `named`: channel -> topic, schema, whether it
    is wanted, what makes it today's, as far as met. This loop is where a walk spends its time."""
    unpack, size = _WHOLE_MESSAGE.unpack_from, _WHOLE_MESSAGE.size
    pos, end = 0, len(data)
    count, low, high = 0, 1 << 64, 0
    try:
        while pos + size <= end:
            opcode, length, channel, sequence, log_ns, publish_ns = unpack(data, pos)
            if opcode != MESSAGE:
                if opcode == 0 or length > end - pos - _RECORD.size:
                    break
                if opcode in (SCHEMA, CHANNEL):
                    known.meet(data, Part(opcode, pos + _RECORD.size, length))
                    named.clear()
                pos += _RECORD.size + length
                continue
            begin = pos + size
            pos += _RECORD.size + length
            if pos > end:
                pos = begin - size
                break
            if channel not in named or pos < begin:
                first = known.message(data, Part(MESSAGE, begin - _MESSAGE.size, length))
                yes = wanted is None or first.topic in wanted
                named[channel] = first.topic, first.schema, yes, known.converter(channel)
            count += 1
            if log_ns > high:
                high = log_ns
            if log_ns < low:
                low = log_ns
            topic, schema, yes, convert = named[channel]
            if yes:
                body = data[begin:pos] if convert is None else _today(convert, data[begin:pos], begin)
                yield Stored(topic, schema, log_ns, publish_ns, sequence, body)
        for part in parts(data, pos):  # the last records, where they are shorter than a message's head
            if part.opcode == MESSAGE:
                known.message(data, part)  # cut: raises
            elif part.opcode in (SCHEMA, CHANNEL):
                known.meet(data, part)
                named.clear()
            pos = part.pos + part.length
    finally:
        tally.add(count, low, high)
    return pos


class Rows(NamedTuple):
    """Messages of a run of records in the order of the file: of each its channel, where its content stands in `data`,
    its times UTC ns (n,); `named`: channel -> topic, schema."""

    data: bytes
    channel: npt.NDArray[np.int64]
    begin: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    log_ns: npt.NDArray[np.int64]
    publish_ns: npt.NDArray[np.int64]
    named: dict[int, tuple[str, str]]


def read_rows(path: Path) -> Iterator[Rows]:
    """All messages of a file chunk by chunk, for who wants many of them: a message is a row of numbers, no object.
    Raises as `read_messages`."""
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        known = Channels()
        for part, indexes in _grouped(buffer):
            if part.opcode in (SCHEMA, CHANNEL):
                known.meet(buffer, part)
            elif part.opcode == DATA_END:
                return
            elif part.opcode == MESSAGE:
                yield _as_rows([known.message(buffer, part)])
            elif part.opcode == CHUNK:
                data = _sound(buffer, part)
                if data is None:
                    return
                heads = _heads(buffer, data, indexes)
                if heads is None or not known.are_todays(set(heads["channel"].tolist())):
                    each = _in_chunk(data, known, None, {}, Tally())
                    rows = _as_rows(list(_filling(each, part, data)))
                    if len(rows.channel):
                        yield rows
                    continue
                places, length = heads["begin"], heads["length"].astype(np.int64)
                yield Rows(
                    data,
                    heads["channel"].astype(np.int64),
                    places,
                    places + length - _MESSAGE.size,
                    heads["log_ns"].astype(np.int64),
                    heads["publish_ns"].astype(np.int64),
                    {c: known.named(c) for c in set(heads["channel"].tolist())},
                )


def _as_rows(stored: list[Stored]) -> Rows:
    numbers = {name: i for i, name in enumerate(dict.fromkeys((s.topic, s.schema) for s in stored))}
    ends = np.cumsum([len(s.data) for s in stored], dtype=np.int64)
    return Rows(
        b"".join(s.data for s in stored),
        np.array([numbers[s.topic, s.schema] for s in stored], np.int64),
        ends - np.array([len(s.data) for s in stored], np.int64),
        ends,
        np.array([s.log_ns for s in stored], np.int64),
        np.array([s.publish_ns for s in stored], np.int64),
        {i: name for name, i in numbers.items()},
    )


def _grouped(buffer: Buffer) -> Iterator[tuple[Part, list[Part]]]:
    """Records of a file, each with the message indexes behind it."""
    held: tuple[Part, list[Part]] | None = None
    for part in parts(buffer):
        if part.opcode == MESSAGE_INDEX:
            if held is not None:
                held[1].append(part)
            continue
        if held is not None:
            yield held
        held = part, []
    if held is not None:
        yield held


def _sound(buffer: Buffer, part: Part) -> bytes | None:
    """A chunk's records; None where it is damaged and the last thing that was written: a torn tail."""
    try:
        return chunk_data(buffer, chunk_head(buffer, part))
    except DamagedError:
        if next(parts(buffer, part.pos + part.length), None) is None:
            return None
        raise


def _heads(buffer: Buffer, data: bytes, indexes: list[Part]) -> dict[str, npt.NDArray[Any]] | None:
    """Heads of all records of a chunk at once, found by its message indexes; None where these do not lead from its
    first byte to its last over nothing but messages. So they are never believed: what they say is what a walk from
    record to record would have met."""
    tables = []
    for part in indexes:
        if part.length < 6 or (part.length - 6) % 16 or part.pos + part.length > len(buffer):
            return None
        tables.append(buffer[part.pos + 6 : part.pos + part.length])
    at = np.frombuffer(b"".join(tables), "<u8")[1::2]
    size = _HEAD.itemsize
    if not at.size or int(at.max()) > len(data) - size:
        return None
    place = np.sort(at.astype(np.int64))
    head = np.frombuffer(data, np.uint8)[place[:, None] + np.arange(size)].view(_HEAD)[:, 0]
    length = head["length"]
    if (head["opcode"] != MESSAGE).any() or int(length.max()) > len(data) or int(length.min()) < _MESSAGE.size:
        return None
    behind = place + _RECORD.size + length.astype(np.int64)
    if place[0] or behind[-1] != len(data) or (behind[:-1] != place[1:]).any():
        return None
    return {"begin": place + size, **{name: head[name] for name in _HEAD.names or ()}}


def _filling(each: Generator[Stored, None, int], part: Part, data: bytes) -> Iterator[Stored]:
    """Messages of a chunk. DamagedError where its records do not fill it."""
    if (yield from each) != len(data):
        raise DamagedError(f"chunk at byte {part.pos}: its records do not fill it")


def _messages(buffer: Buffer, known: Channels, wanted: Container[str] | None, tally: Tally) -> Iterator[Stored]:
    named: Named = {}
    for part in parts(buffer):
        if part.opcode == CHUNK:
            data = _sound(buffer, part)
            if data is None:
                return
            yield from _filling(_in_chunk(data, known, wanted, named, tally), part, data)
        elif part.opcode == MESSAGE:
            stored = known.message(buffer, part)
            tally.add(1, stored.log_ns, stored.log_ns)
            if wanted is None or stored.topic in wanted:
                yield stored
        elif part.opcode in (SCHEMA, CHANNEL):
            known.meet(buffer, part)
            named.clear()
        elif part.opcode == DATA_END:
            return


def read_between(path: Path, begin_ns: int, end_ns: int) -> Iterator[Stored]:
    """Messages with `begin_ns` <= log time < `end_ns` of a file in which log time does not step back; only the chunks
    that hold them are unpacked, and those before them where they may define a channel. Errors as `read_messages`."""
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        known = Channels()
        skipped: list[ChunkHead] = []
        for part in parts(buffer):
            if part.opcode != CHUNK:
                continue
            head = chunk_head(buffer, part)
            if head.start_ns >= end_ns:
                return
            if head.end_ns < begin_ns:
                skipped.append(head)
                continue
            try:
                data = chunk_data(buffer, head)
            except DamagedError:
                if next(parts(buffer, part.pos + part.length), None) is None:
                    return
                raise
            for before in skipped:
                _define(chunk_data(buffer, before), known)
            skipped.clear()
            for inner in parts(data, 0):
                if inner.opcode in (SCHEMA, CHANNEL):
                    known.meet(data, inner)
                elif inner.opcode == MESSAGE:
                    stored = known.message(data, inner)
                    if begin_ns <= stored.log_ns < end_ns:
                        yield stored


def _define(data: bytes, known: Channels) -> None:
    for part in parts(data, 0):
        if part.opcode in (SCHEMA, CHANNEL):
            known.meet(data, part)


def _summary(buffer: Buffer) -> list[Part]:
    """Records of the index of a file, found from its end; [] where there is none, or it is damaged. On a slow card a
    walk through all chunks takes a second and more, this a few reads."""
    footer = len(buffer) - len(MAGIC) - 20
    if footer < 2 * len(MAGIC) or buffer[footer + 20 :] != MAGIC:
        return []
    (start,) = _U64.unpack_from(buffer, footer)
    (crc,) = _U32.unpack_from(buffer, footer + 16)
    if not len(MAGIC) <= start < footer or crc != zlib.crc32(buffer[start : footer + 16]):
        return []
    return list(parts(buffer, start))


def newest_ns(path: Path) -> int:
    """The largest log time of a file by its index, else by the heads of its chunks; 0 = none. Errors as
    `read_messages`."""
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        for part in _summary(buffer):
            if part.opcode == STATISTICS and part.length >= 42:
                return int(_U64.unpack_from(buffer, part.pos + 34)[0])
        return max((chunk_head(buffer, part).end_ns for part in parts(buffer) if part.opcode == CHUNK), default=0)


class Attachment(NamedTuple):
    name: str
    media_type: str
    data: bytes


def read_attachments(path: Path) -> list[Attachment]:
    """Attached files. Raises OSError, DamagedError (CRC)."""
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        return [parse_attachment(buffer, part) for part in parts(buffer) if part.opcode == ATTACHMENT]


def parse_attachment(buffer: Buffer, part: Part) -> Attachment:
    """An attachment record: two times, name, media type, data, CRC."""
    end = part.pos + part.length
    name, pos = _text(buffer, part.pos + 16, end)
    media_type, pos = _text(buffer, pos, end)
    (n,) = _numbers(_U64, buffer, pos, end)
    pos += 8
    if pos + n + 4 != end:
        raise DamagedError(f"attachment at byte {part.pos}: damaged length")
    (crc,) = _numbers(_U32, buffer, pos + n, end)
    if crc and zlib.crc32(buffer[part.pos : pos + n]) != crc:
        raise DamagedError(f"attachment {name!r} at byte {part.pos}: damaged data (CRC)")
    return Attachment(name, media_type, buffer[pos : pos + n])


def read_metadata(path: Path) -> dict[str, dict[str, str]]:
    """Metadata records by name; of one name, the last. Raises OSError, DamagedError."""
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        found = [parse_metadata(buffer, part) for part in parts(buffer) if part.opcode == METADATA]
    return dict(found)


def has_metadata(path: Path, name: str) -> bool:
    """Whether a file holds a metadata record of that name, by its index where it has one. Raises OSError,
    DamagedError."""
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        indexed = [part for part in _summary(buffer) if part.opcode == METADATA_INDEX]
        if indexed:
            return name in [_text(buffer, part.pos + 16, part.pos + part.length)[0] for part in indexed]
        return name in [parse_metadata(buffer, part)[0] for part in parts(buffer) if part.opcode == METADATA]


def head_metadata(path: Path, name: str) -> dict[str, str]:
    """The first metadata record of a name, without a walk through the whole file; {} where it does not stand in front
    of the first chunk. Raises OSError, DamagedError."""
    with view(Path(path)) as buffer:
        _check_magic(buffer, path)
        for part in parts(buffer):
            if part.opcode == CHUNK:
                break
            if part.opcode == METADATA:
                found, values = parse_metadata(buffer, part)
                if found == name:
                    return values
    return {}


def count(text: str) -> int:
    """A count that a metadata record holds as text; 0 where it is none, whatever else stands there."""
    return int(text) if text.isdecimal() and len(text) < 20 else 0


def parse_metadata(buffer: Buffer, part: Part) -> tuple[str, dict[str, str]]:
    """A metadata record: its name and its strings."""
    end = part.pos + part.length
    name, pos = _text(buffer, part.pos, end)
    (n,) = _numbers(_U32, buffer, pos, end)
    pos += 4
    if pos + n != end:
        raise DamagedError(f"metadata {name!r} at byte {part.pos}: damaged length")
    values: dict[str, str] = {}
    while pos < end:
        key, pos = _text(buffer, pos, end)
        values[key], pos = _text(buffer, pos, end)
    return name, values


def parse_header(buffer: Buffer, part: Part) -> tuple[str, str]:
    """Profile and library of a header record."""
    end = part.pos + part.length
    profile, pos = _text(buffer, part.pos, end)
    library, _ = _text(buffer, pos, end)
    return profile, library


@dataclass
class TopicInfo:
    """What a file holds of one topic. `longest_ns`: the longest time between two of its messages, by log time."""

    schema: str
    count: int = 0
    size: int = 0  # bytes of its messages, unpacked
    first_ns: int = 0
    last_ns: int = 0
    longest_ns: int = 0


class Gap(NamedTuple):
    """Raw blocks that are missing: the order jumps from `after` to `before` at `log_ns`."""

    after: int
    before: int
    log_ns: int


@dataclass
class Info:
    """Summary of a file, from a walk through all of it."""

    path: Path
    size: int
    complete: bool = False  # index and footer are there
    damage: str = ""  # "" = every chunk is as it was written
    profile: str = ""
    library: str = ""
    chunks: int = 0
    messages: int = 0
    start_ns: int = 0  # UTC, smallest and largest log time
    end_ns: int = 0
    topics: dict[str, TopicInfo] = field(default_factory=dict)
    schemas: dict[str, str] = field(default_factory=dict)  # name -> message text
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[tuple[str, str, int]] = field(default_factory=list)  # name, media type, bytes
    gaps: list[Gap] = field(default_factory=list)


def info(path: Path) -> Info:
    """Walk through the whole file. Raises OSError, DamagedError for what is no MCAP; other damage is in `damage`."""
    path = Path(path)
    with view(path) as buffer:
        _check_magic(buffer, path)
        result = Info(path, len(buffer))
        known = Channels()
        last_order: int | None = None
        try:
            for part in parts(buffer):
                if part.opcode == HEADER:
                    result.profile, result.library = parse_header(buffer, part)
                elif part.opcode == CHUNK:
                    result.chunks += 1
                elif part.opcode == ATTACHMENT:
                    name, media_type, data = parse_attachment(buffer, part)
                    result.attachments.append((name, media_type, len(data)))
                elif part.opcode == METADATA:
                    name, values = parse_metadata(buffer, part)
                    result.metadata[name] = values
                elif part.opcode == FOOTER:
                    result.complete = buffer[part.pos + part.length :] == MAGIC
            for stored in _messages(buffer, known, None, Tally()):
                _count(result, stored)
                if stored.topic.startswith(topics.RAW_PREFIX) and stored.topic != topics.CHECKPOINT_TOPIC:
                    order = topics.raw_order(stored.schema, stored.data)
                    if last_order is not None and order != last_order + 1:
                        result.gaps.append(Gap(last_order, order, stored.log_ns))
                    last_order = order
        except ValueError as e:
            result.damage = str(e)
        result.schemas = {name: text.decode("utf-8", "replace") for name, text in known.schemas.values()}
    return result


def _count(result: Info, stored: Stored) -> None:
    first = result.messages == 0
    result.messages += 1
    result.start_ns = stored.log_ns if first else min(result.start_ns, stored.log_ns)
    result.end_ns = max(result.end_ns, stored.log_ns)
    topic = result.topics.get(stored.topic)
    if topic is None:
        topic = result.topics[stored.topic] = TopicInfo(stored.schema, first_ns=stored.log_ns, last_ns=stored.log_ns)
    topic.count += 1
    topic.size += len(stored.data)
    topic.longest_ns = max(topic.longest_ns, stored.log_ns - topic.last_ns)
    topic.last_ns = stored.log_ns
