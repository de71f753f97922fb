"""Files that a kill, a power cut or a bad sector left behind, made readable again for readers that want an index.

A segment that was not closed ends in `.part` and has no index and no footer, and most readers refuse it. Repair walks
its records, checks every chunk's CRC and then

- complete: everything is there but the rename: renames it;
- cut: cuts after the last whole chunk, appends index and footer in place, renames it;
- copied: there are whole chunks behind damaged bytes: writes a copy without the damage and keeps the original beside
  it as `.damaged`.

No file is ever deleted, and a repair that is itself interrupted is done again at the next start. A repaired file
carries metadata `edge_agent:repaired`. Message indexes are taken over where they stand whole; a chunk is only taken
apart where its index is missing, where it brings new channels, or where it is young: what a power cut can have damaged
was written after the last fsync, so the CRCs of the last `YOUNG_NS` are checked and older chunks walked over, unless
asked for. (Readers check every CRC.)
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    DataEnd,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)
from mcap.records import MessageIndex as MessageIndexRecord

from edge_agent.messages import S
from edge_agent.recording import reader
from edge_agent.recording.reader import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    SCHEMA,
    Buffer,
    Channels,
    ChunkHead,
    DamagedError,
    Part,
)
from edge_agent.recording.writer import LIBRARY, PART, PROFILE, fsync_folder, publish

YOUNG_NS = 60 * S
"""A dozen times the default `fsync_s`."""
REPAIRED_METADATA = "edge_agent:repaired"
DAMAGED = ".damaged"
COPY = ".repairing"

_ZSTD = struct.pack("<I", 4) + b"zstd"
_BEFORE_ZSTD = 9 + 28  # record head, times, size and CRC stand before a chunk's compression
_INDEX = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries
_MESSAGE_HEAD = 9 + 22  # record head, channel, sequence, log time, publish time


class Repaired(NamedTuple):
    """What was done to one file. `lost_bytes`: of the file as found, not in the file as left."""

    path: Path
    what: str  # "complete", "cut", "copied", "failed"
    messages: int
    lost_bytes: int
    detail: str


@dataclass
class _Piece:
    """A whole record of the data section that goes into the repaired file.

    `end`: behind the record and its message indexes. A chunk has `head` and `index`: channel -> (position of its
    message index record, count), position -1 = must be rebuilt. An attachment or metadata has `name`, an attachment
    `attached`: log time, create time, media type, bytes.
    """

    part: Part
    end: int
    head: ChunkHead | None = None
    index: dict[int, tuple[int, int]] = field(default_factory=dict)
    name: str = ""
    attached: tuple[int, int, str, int] = (0, 0, "", 0)

    @property
    def record_end(self) -> int:
        return self.part.pos + self.part.length


@dataclass
class _Scan:
    pieces: list[_Piece] = field(default_factory=list)
    known: Channels = field(default_factory=Channels)
    damage: list[tuple[int, int]] = field(default_factory=list)  # begin, end
    reason: str = ""
    complete: bool = False


def recover(data_dir: Path, thorough: bool = False) -> list[Repaired]:
    """Repair every `*.mcap.part` of a folder, oldest first; call before anything is written there. `thorough` checks
    every CRC of a file, which takes several times as long.

    A file that cannot be repaired now (no space, read-only) stays as it is and is told as "failed".
    """
    done = []
    for path in sorted(Path(data_dir).glob("*.mcap" + PART)):
        try:
            done.append(repair(path, thorough))
        except OSError as e:
            done.append(Repaired(path, "failed", 0, 0, f"left as it is: {e}"))
    return done


def repair(path: Path, thorough: bool = False) -> Repaired:
    """Make one `.part` file readable and give it its final name. OSError from the disk; the file is then unchanged or
    can be repaired again."""
    final = path.with_name(path.name.removesuffix(PART))
    if final.exists():  # a copy was finished just before the end of the program
        kept = _free_name(final)
        path.rename(kept)
        fsync_folder(path.parent)
        return Repaired(final, "copied", 0, 0, f"had been copied before; the damaged original is {kept.name}")
    with reader.view(path) as buffer:
        size = len(buffer)
        scan = _scan(buffer, thorough)
        if not thorough and (not _ends_torn(scan, size) or not _young_are_whole(buffer, scan)):
            scan = _scan(buffer, True)
        if scan.complete:
            publish(path, final)
            return Repaired(final, "complete", _count(scan), 0, "only the rename was missing")
        in_place = _ends_torn(scan, size)
        if not scan.pieces and not _is_torn_head(buffer):
            in_place = False  # whatever it is, it is not ours to cut
        lost = sum(end - begin for begin, end in scan.damage)
        if not in_place:
            _write_copy(buffer, scan, final.with_name(final.name + COPY), lost)
    if in_place:
        _finish_in_place(path, scan, lost)
        publish(path, final)
        return Repaired(final, "cut", _count(scan), lost, f"{lost} bytes after the last whole chunk; {scan.reason}")
    publish(final.with_name(final.name + COPY), final)
    kept = _free_name(final)
    path.rename(kept)
    fsync_folder(path.parent)
    return Repaired(final, "copied", _count(scan), lost, f"{scan.reason}; the damaged original is {kept.name}")


def _free_name(final: Path) -> Path:
    kept = final.with_name(final.name + DAMAGED)
    number = 1
    while kept.exists():
        number += 1
        kept = final.with_name(f"{final.name}{DAMAGED}{number}")
    return kept


def _count(scan: _Scan) -> int:
    return sum(count for piece in scan.pieces for _, count in piece.index.values())


def _head_bytes() -> bytes:
    return MAGIC + _bytes(Header(PROFILE, LIBRARY))


def _is_torn_head(buffer: Buffer) -> bool:
    """Whether the file is only the begin of what a segment starts with, or unwritten space."""
    head = _head_bytes()
    found = bytes(buffer[: len(head)])
    return head.startswith(found.rstrip(b"\0")) and not any(buffer[len(head) :])


# ---------------------------------------------------------------------------------------------------------------- scan


def _ends_torn(scan: _Scan, size: int) -> bool:
    """Whether nothing is damaged but the tail."""
    return not scan.damage or (len(scan.damage) == 1 and scan.damage[0][1] == size)


def _young_are_whole(buffer: Buffer, scan: _Scan) -> bool:
    """Check what was written last: chunks and their indexes within YOUNG_NS of the last message."""
    chunks = [(piece, piece.head) for piece in scan.pieces if piece.head is not None]
    last = max((head.end_ns for _, head in chunks), default=0)
    try:
        for piece, head in chunks:
            if head.end_ns >= last - YOUNG_NS:
                _check_entries(buffer, piece, reader.chunk_data(buffer, head))
    except DamagedError:
        return False
    return True


def _scan(buffer: Buffer, thorough: bool) -> _Scan:
    """What is whole and what is not; only a thorough scan unpacks chunks that it need not."""
    scan = _Scan()
    pos = 0
    chunk: _Piece | None = None  # the chunk whose message indexes may follow, taken once the record behind is whole
    while pos < len(buffer):
        try:
            if chunk is not None and buffer[pos] == MESSAGE_INDEX:
                pos = _take_indexes(buffer, chunk, pos)
                if thorough and chunk.head is not None:
                    _check_entries(buffer, chunk, reader.chunk_data(buffer, chunk.head))
                continue
            part = _part(buffer, pos or len(MAGIC))
            end = part.pos + part.length
            if part.opcode == DATA_END and pos:
                whole = _is_complete(buffer, pos)
                if not whole and _next_chunk(buffer, pos + 1) < len(buffer):
                    raise DamagedError(f"an end of data at byte {pos} with more data behind it")
                if chunk is not None:
                    _settle(scan, chunk, buffer)
                scan.complete = not scan.damage and whole
                if not scan.complete:
                    scan.damage.append((pos, len(buffer)))
                    scan.reason = scan.reason or "index or footer not whole"
                return scan
            piece = _piece(buffer, part, pos, thorough)
        except DamagedError as e:
            scan.reason = scan.reason or str(e)
            if chunk is not None:  # how far its indexes are whole is not known
                pos = _rebuild(scan, chunk, buffer)
                chunk = None
            behind = _next_chunk(buffer, pos + 1)
            scan.damage.append((pos, behind))
            pos = behind
            continue
        if chunk is not None:
            _settle(scan, chunk, buffer)
        scan.pieces.append(piece)
        chunk = piece if piece.head is not None else None
        pos = end
    scan.reason = scan.reason or "index and footer missing"
    if chunk is not None:
        end = _rebuild(scan, chunk, buffer)
        if end < len(buffer):
            scan.damage.append((end, len(buffer)))
    return scan


def _piece(buffer: Buffer, part: Part, pos: int, thorough: bool) -> _Piece:
    """The record at `pos`. DamagedError for anything that does not belong there."""
    piece = _Piece(part, part.pos + part.length)
    if pos == 0:
        if buffer[: len(MAGIC)] != MAGIC or part.opcode != HEADER:
            raise DamagedError("the file does not begin as a recording")
        profile, library = reader.parse_header(buffer, part)
        if profile != PROFILE or part.length != 8 + len(profile.encode()) + len(library.encode()):
            raise DamagedError("the file does not begin as a recording of this program")
    elif part.opcode == CHUNK:
        piece.head = reader.chunk_head(buffer, part)
        if thorough:
            reader.chunk_data(buffer, piece.head)
    elif part.opcode == ATTACHMENT:
        piece.name, media_type, data = reader.parse_attachment(buffer, part)
        log_ns, create_ns = struct.unpack_from("<QQ", buffer, part.pos)
        piece.attached = log_ns, create_ns, media_type, len(data)
    elif part.opcode == METADATA:
        piece.name, _ = reader.parse_metadata(buffer, part)
    else:
        raise DamagedError(f"a record of kind {part.opcode} at byte {pos} is not what this program writes")
    return piece


def _part(buffer: Buffer, pos: int) -> Part:
    for part in reader.parts(buffer, pos):
        return part
    raise DamagedError(f"the record at byte {pos} is cut")


def _take_indexes(buffer: Buffer, chunk: _Piece, pos: int) -> int:
    """Take the message index records at `pos` for a chunk; return the position behind them."""
    size = len(buffer)
    while pos < size and buffer[pos] == MESSAGE_INDEX:
        if pos + _INDEX.size > size:
            raise DamagedError(f"message index at byte {pos}: cut")
        _, length, channel, entries = _INDEX.unpack_from(buffer, pos)
        if entries != length - 6 or entries % 16 or entries == 0 or length > size - pos - 9 or channel in chunk.index:
            raise DamagedError(f"message index at byte {pos}: damaged or cut")
        chunk.index[channel] = pos, entries // 16
        pos += 9 + length
        chunk.end = pos
    return pos


def _check_entries(buffer: Buffer, chunk: _Piece, data: bytes) -> None:
    """DamagedError where an index entry is not that of a message in the chunk's `data`."""
    inside = np.frombuffer(data, np.uint8)
    for channel, (pos, count) in chunk.index.items():
        if pos < 0:
            continue
        entries = np.frombuffer(buffer, "<u8", 2 * count, pos + _INDEX.size)
        times, at = entries[0::2], entries[1::2]
        good = bool(at.max() < inside.size - _MESSAGE_HEAD)
        if good:
            head = inside[at[:, None].astype(np.int64) + np.arange(_MESSAGE_HEAD)]
            good = (
                bool((head[:, 0] == MESSAGE).all())
                and bool((head[:, 9:11].copy().view("<u2")[:, 0] == channel).all())
                and bool((head[:, 15:23].copy().view("<u8")[:, 0] == times).all())
            )
        if not good:
            raise DamagedError(f"message index at byte {pos}: does not fit its chunk")


def _settle(scan: _Scan, chunk: _Piece, buffer: Buffer) -> None:
    """Take the channels of a chunk whose indexes are known; a chunk whose channels are lost becomes damage."""
    try:
        if not chunk.index or any(channel not in scan.known.channels for channel in chunk.index):
            there = {
                channel: (-1, len(times)) for channel, times in _read_chunk(scan.known, _data(buffer, chunk)).items()
            }
            if there.keys() != chunk.index.keys():  # the index is damaged, not the chunk
                scan.damage += [(chunk.record_end, chunk.end)] if chunk.end > chunk.record_end else []
                scan.reason = scan.reason or f"message indexes at byte {chunk.record_end} do not fit their chunk"
                chunk.index, chunk.end = there, chunk.record_end
        for channel in chunk.index:
            topic, schema = scan.known.channels[channel]
            if schema and schema not in scan.known.schemas:
                raise DamagedError(f"the message text of {topic} is lost")
    except KeyError as e:
        _drop(scan, chunk, f"channel {e} is lost with the chunk that defined it")
    except DamagedError as e:
        _drop(scan, chunk, str(e))


def _rebuild(scan: _Scan, chunk: _Piece, buffer: Buffer) -> int:
    """Take a chunk without its message indexes; return where it ends."""
    chunk.end = chunk.record_end
    try:
        chunk.index = {
            channel: (-1, len(times)) for channel, times in _read_chunk(scan.known, _data(buffer, chunk)).items()
        }
    except DamagedError as e:
        _drop(scan, chunk, str(e))
    else:
        _settle(scan, chunk, buffer)
    return chunk.end


def _data(buffer: Buffer, chunk: _Piece) -> bytes:
    if chunk.head is None:
        raise DamagedError("not a chunk")
    return reader.chunk_data(buffer, chunk.head)


def _drop(scan: _Scan, chunk: _Piece, reason: str) -> None:
    scan.pieces.remove(chunk)
    scan.damage.append((chunk.part.pos - 9, chunk.end))
    scan.reason = scan.reason or reason


def _read_chunk(known: Channels, data: bytes) -> dict[int, list[tuple[int, int]]]:
    """Meet a chunk's schemas and channels; return its message index: channel -> (log time, offset)."""
    index: dict[int, list[tuple[int, int]]] = {}
    end = 0
    for part in reader.parts(data, 0):
        end = part.pos + part.length
        if part.opcode == MESSAGE:
            if part.length < 22:
                raise DamagedError("a message is too short")
            (channel,) = struct.unpack_from("<H", data, part.pos)
            (log_ns,) = struct.unpack_from("<Q", data, part.pos + 6)
            index.setdefault(channel, []).append((log_ns, part.pos - 9))
        elif part.opcode in (SCHEMA, CHANNEL):
            known.meet(data, part)
    if end != len(data):
        raise DamagedError("a chunk's records do not fill it")
    return index


def _next_chunk(buffer: Buffer, pos: int) -> int:
    """Begin of the next whole chunk at or behind `pos`, or the end of the file."""
    found = buffer.find(_ZSTD, pos + _BEFORE_ZSTD)
    while found >= 0:
        start = found - _BEFORE_ZSTD
        if buffer[start] == CHUNK:
            try:
                reader.chunk_data(buffer, reader.chunk_head(buffer, _part(buffer, start)))
            except DamagedError:
                pass
            else:
                return start
        found = buffer.find(_ZSTD, found + 1)
    return len(buffer)


def _is_complete(buffer: Buffer, data_end: int) -> bool:
    """Whether summary and footer stand behind DataEnd as they were written."""
    summary = data_end + 9 + 4
    for part in reader.parts(buffer, summary):
        if part.opcode == FOOTER and part.length == 20:
            start, _, crc = struct.unpack_from("<QQI", buffer, part.pos)
            return (
                start == summary
                and buffer[part.pos + part.length :] == MAGIC
                and zlib.crc32(buffer[summary : part.pos + 16]) == crc
            )
    return False


# --------------------------------------------------------------------------------------------------------------- write


def _bytes(*records: McapRecord) -> bytes:
    builder: Any = RecordBuilder()  # its methods carry no types
    for record in records:
        record.write(builder)
    return bytes(builder.end())


def _finish_in_place(path: Path, scan: _Scan, lost: int) -> None:
    last = scan.pieces[-1] if scan.pieces else None
    with open(path, "r+b") as file:
        data = b""
        if last is not None and last.head is not None and last.end == last.record_end:
            file.seek(last.head.pos)
            data = reader.chunk_data(file.read(last.head.length), last.head._replace(pos=0))
        end = last.end if last is not None else 0
        file.truncate(end)
        file.seek(end)
        if last is None:
            file.write(_head_bytes())
        elif last.head is not None and last.end == last.record_end:
            _write_index(file, last, data)
        _write_end(file, scan, lost)
        file.flush()
        os.fsync(file.fileno())


def _write_index(file: BinaryIO, piece: _Piece, data: bytes) -> None:
    """Message index records of a chunk that ends where the file stands."""
    piece.index = {}
    for channel, times in _read_chunk(Channels(), data).items():
        piece.index[channel] = file.tell(), len(times)
        file.write(_bytes(MessageIndexRecord(channel, times)))
    piece.end = file.tell()


def _write_copy(buffer: Buffer, scan: _Scan, copy: Path, lost: int) -> None:
    """Everything whole of `buffer` as a file of its own, with fresh message indexes; `scan` then describes the copy."""
    with open(copy, "wb") as file:
        file.write(_head_bytes())
        pieces = []
        for piece in scan.pieces:
            if piece.part.opcode == HEADER:
                continue
            begin = piece.part.pos - 9
            moved = file.tell() - begin
            file.write(buffer[begin : piece.record_end])
            new = replace(piece, part=piece.part._replace(pos=piece.part.pos + moved), end=file.tell())
            if piece.head is not None:
                new.head = piece.head._replace(pos=piece.head.pos + moved)
                _write_index(file, new, reader.chunk_data(buffer, piece.head))
            pieces.append(new)
        scan.pieces = pieces
        _write_end(file, scan, lost)
        file.flush()
        os.fsync(file.fileno())


def _write_end(file: BinaryIO, scan: _Scan, lost: int) -> None:
    """The mark of repair, DataEnd, summary and footer, from where the file stands."""
    mark = _bytes(Metadata(REPAIRED_METADATA, {"lost_bytes": str(lost), "reason": scan.reason}))
    mark_pos = file.tell()
    file.write(mark + _bytes(DataEnd(0)))

    chunks = [(piece, piece.head) for piece in scan.pieces if piece.head is not None]
    attachments = [piece for piece in scan.pieces if piece.part.opcode == ATTACHMENT]
    metadata = [piece for piece in scan.pieces if piece.part.opcode == METADATA]
    counts: dict[int, int] = {}
    for piece, _ in chunks:
        for channel, (_, count) in piece.index.items():
            counts[channel] = counts.get(channel, 0) + count
    statistics = Statistics(
        attachment_count=len(attachments),
        channel_count=len(scan.known.channels),
        channel_message_counts=counts,
        chunk_count=len(chunks),
        message_count=sum(counts.values()),
        message_end_time=max((head.end_ns for _, head in chunks), default=0),
        message_start_time=min((head.start_ns for _, head in chunks), default=0),
        metadata_count=len(metadata) + 1,
        schema_count=len(scan.known.schemas),
    )
    metadata_indexes = [MetadataIndex(p.part.pos - 9, p.part.length + 9, p.name) for p in metadata]
    metadata_indexes.append(MetadataIndex(mark_pos, len(mark), REPAIRED_METADATA))
    known = scan.known.records.items()
    groups = {
        Opcode.SCHEMA: b"".join(record for (opcode, _), record in known if opcode == SCHEMA),
        Opcode.CHANNEL: b"".join(record for (opcode, _), record in known if opcode == CHANNEL),
        Opcode.STATISTICS: _bytes(statistics),
        Opcode.CHUNK_INDEX: b"".join(_chunk_index(piece, head) for piece, head in chunks),
        Opcode.ATTACHMENT_INDEX: _bytes(*(_attachment_index(piece) for piece in attachments)),
        Opcode.METADATA_INDEX: _bytes(*metadata_indexes),
    }
    start = file.tell()
    summary = b""
    offsets = []
    for opcode, group in groups.items():
        if group:
            offsets.append(SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
    offset_start = start + len(summary)
    summary += _bytes(*offsets)
    head = struct.pack("<BQQQ", FOOTER, 20, start, offset_start)
    file.write(summary + head + struct.pack("<I", zlib.crc32(head, zlib.crc32(summary))) + MAGIC)


def _chunk_index(piece: _Piece, head: ChunkHead) -> bytes:
    """A chunk index record; packed here because mcap's own takes longer than the walk over the chunk."""
    offsets = [number for channel, (pos, _) in piece.index.items() for number in (channel, pos)]
    begin, end = piece.part.pos - 9, piece.record_end
    body = b"".join(
        (
            struct.pack("<QQQQI", head.start_ns, head.end_ns, begin, end - begin, 5 * len(offsets)),
            struct.pack("<" + "HQ" * len(piece.index), *offsets),
            struct.pack("<QI", piece.end - end, len(head.compression)),
            head.compression.encode(),
            struct.pack("<QQ", head.length, head.size),
        )
    )
    return struct.pack("<BQ", Opcode.CHUNK_INDEX, len(body)) + body


def _attachment_index(piece: _Piece) -> AttachmentIndex:
    log_ns, create_ns, media_type, size = piece.attached
    return AttachmentIndex(
        offset=piece.part.pos - 9,
        length=piece.part.length + 9,
        log_time=log_ns,
        create_time=create_ns,
        data_size=size,
        name=piece.name,
        media_type=media_type,
    )
