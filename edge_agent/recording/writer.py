"""One MCAP file: profile ros2, CDR, zstd chunks of 1 MiB, everything checked before the library is called.

mcap's Writer raises on a float, a negative time, a sequence above 32 bits or `str` data, and by then has damaged the
open chunk without a word; an unknown channel does not even raise. So every value is looked at first, and what is wrong
is a ValueError or TypeError here with the file untouched. An OSError (disk full, card gone) kills the Writer: the file
is then only good for `abandon` and repair (segments). Not thread-safe; no clock is read here.
"""

from __future__ import annotations

import errno
import hashlib
import operator
import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from edge_agent.messages import Record
from edge_agent.recording.schemas import SCHEMAS, schema_of

PART = ".part"
CHUNK_BYTES = 1 << 20
PROFILE = "ros2"
LIBRARY = "edge-agent"
RUN_METADATA = "edge_agent:run"
TIME_MAX = 1 << 63  # rosbags and rosbag2 keep times as int64


class _HashedFile:
    """The file under the Writer: counts and hashes what goes through it."""

    def __init__(self, path: Path) -> None:
        self.file = open(path, "xb")  # noqa: SIM115 - lives as long as the segment; x: never over another file
        self.size = 0
        self.sha256 = hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.file.write(data)
        self.sha256.update(data)
        self.size += len(data)
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        self.file.flush()


class SegmentWriter:
    """Writes one file at `path`, normally NAME.mcap.part, which must not exist, nor what `close` will call it.

    The head is in the file on return: `metadata` as the record `edge_agent:run`, and the attachments (name -> content)
    stamped `utc_ns`. Raises OSError (FileExistsError among them), TypeError for values that are no strings or bytes.
    """

    def __init__(
        self, path: Path, *, metadata: Mapping[str, str], attachments: Mapping[str, bytes], utc_ns: int = 0
    ) -> None:
        for key, value in metadata.items():
            if not isinstance(key, str) or not isinstance(value, str):
                raise TypeError(f"metadata {key!r}: keys and values must be strings")
        for name, data in attachments.items():
            if not isinstance(name, str) or not isinstance(data, bytes):
                raise TypeError(f"attachment {name!r}: needs a name and bytes")
        stamp = _time("attachment time", utc_ns)
        self.final = path.with_name(path.name.removesuffix(PART))
        if self.final.exists():
            raise FileExistsError(errno.EEXIST, "there is a recording of that name", str(self.final))
        self.path = path
        self._file = _HashedFile(path)
        self._channels: dict[tuple[str, str], int] = {}  # topic and schema as the record has them
        self._topics: dict[str, tuple[str, int]] = {}  # schema and channel
        self._schemas: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        self._pending: list[Record] = []
        try:
            file_like: Any = self._file  # mcap's types ask for a whole IO; it calls write, tell and flush
            self._writer: Any = Writer(file_like, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            self._writer.start(profile=PROFILE, library=LIBRARY)
            self._writer.add_metadata(RUN_METADATA, dict(metadata))
            for name, data in attachments.items():
                self._writer.add_attachment(stamp, stamp, name, _media_type(name), data)
            self._file.flush()
        except OSError:
            self.abandon()
            with suppress(OSError):
                path.unlink()  # made a moment ago, holds no record
            raise

    @property
    def size(self) -> int:
        """Bytes written so far, without the open chunk."""
        return self._file.size

    @property
    def sha256(self) -> str:
        """Hash of what was written so far; of the whole file after `close`."""
        return self._file.sha256.hexdigest()

    @property
    def pending(self) -> tuple[Record, ...]:
        """Records of the open chunk: what an OSError would lose."""
        return tuple(self._pending)

    def add(self, record: Record) -> None:
        """Append one message. ValueError or TypeError for what the format cannot hold, OSError from the disk."""
        log_ns = _time("log time", record.log_ns)
        publish_ns = _time("publish time", record.publish_ns)
        if not isinstance(record.data, bytes):
            raise TypeError(f"{record.topic}: {type(record.data).__name__} is not bytes")
        channel = self._channel(record.topic, record.schema)
        sequence = self._sequences[channel] = (self._sequences[channel] + 1) & 0xFFFFFFFF
        before = self._file.size
        self._pending.append(record)
        self._writer.add_message(channel, log_ns, record.data, publish_ns, sequence)
        if self._file.size != before:  # the chunk was full
            self._file.flush()  # else a part of it waits here, to be lost uncounted at the next error
            self._pending.clear()

    def look(self) -> None:
        """See that what is written still goes somewhere. OSError where the file was taken away, or its file system was
        made read-only by force: no write fails for that, it goes into memory that is thrown away."""
        os.stat(self.path)
        if os.fstatvfs(self._file.file.fileno()).f_flag & os.ST_RDONLY:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(self.path))

    def flush(self) -> None:
        """Close the open chunk and hand everything to the operating system."""
        self._writer.flush()
        self._pending.clear()

    def fsync(self) -> None:
        """`flush`, then wait until it is on the disk."""
        self.flush()
        os.fdatasync(self._file.file.fileno())

    def close(self) -> Path:
        """Write index and footer, wait until they are on the disk, give the file its final name and return that."""
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.file.fileno())
        self._file.file.close()
        self._pending.clear()
        publish(self.path, self.final)
        return self.final

    def abandon(self) -> None:
        """Let go of the file as it is, after an OSError. Never raises for the disk."""
        with suppress(OSError):  # closing flushes the buffer, which fails again on a full disk
            self._file.file.close()

    def _channel(self, topic: str, schema: str) -> int:
        """The channel of a record, registered with its first one. ValueError for an unknown topic or schema."""
        channel = self._channels.get((topic, schema))
        if channel is not None:
            return channel
        name = schema or schema_of(topic)
        text = SCHEMAS.get(name)
        if text is None or not topic.startswith("/"):
            raise ValueError(f"topic {topic!r} with schema {name!r} is not one of this program's")
        known = self._topics.get(topic)
        if known is None:
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, "ros2msg", text.encode())
            known = name, self._writer.register_channel(topic, "cdr", self._schemas[name])
            self._topics[topic] = known
            self._sequences[known[1]] = 0
        if known[0] != name:
            raise ValueError(f"topic {topic!r} came with another schema before {name!r}: {known[0]!r}")
        self._channels[topic, schema] = known[1]
        return known[1]


def publish(part: Path, final: Path) -> None:
    """Rename a file that is complete on the disk, and wait until its folder knows; never over another file."""
    if part != final:
        if final.exists():
            raise FileExistsError(errno.EEXIST, "there is a recording of that name", str(final))
        part.rename(final)
    fsync_folder(final.parent)


def fsync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def _media_type(name: str) -> str:
    """Never empty, or a doctor warns."""
    match Path(name).suffix.lower():
        case ".yaml" | ".yml":
            return "application/yaml"
        case ".dbc" | ".txt":
            return "text/plain"
        case _:
            return "application/octet-stream"


def _time(what: str, value: int) -> int:
    """An integer of ns that every reader holds; TypeError for a float, ValueError out of range."""
    value = operator.index(value)
    if not 0 <= value < TIME_MAX:
        raise ValueError(f"{what} {value} ns is outside of 0 ... 2^63 - 1")
    return value
