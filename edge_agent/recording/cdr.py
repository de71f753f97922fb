"""CDR, little endian, as ROS 2 writes it: a writer, a reader, and a decoder driven by a message text.

4 bytes 00 01 00 00, then fields aligned to their size counted from byte 4; a string is a u32 length with its NUL; a
sequence is a u32 count and the elements. Damaged bytes raise ValueError, never anything else.
"""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from edge_agent.messages import S
from edge_agent.recording.schemas import PRIMITIVES, SCHEMAS, Field, full_name, parse_schema

BEGIN = b"\0\1\0\0"
PAD = tuple(bytes(n) for n in range(8))
U8 = struct.Struct("<B")
U32 = struct.Struct("<I")
F64 = struct.Struct("<d")
STAMP = struct.Struct("<iI")
SINGLE = {name: struct.Struct("<" + code) for name, (_, code) in PRIMITIVES.items()}


def pack(layout: struct.Struct, *values: Any) -> bytes:
    """struct's own errors as ValueError: a value that does not fit its field."""
    try:
        return layout.pack(*values)
    except (struct.error, OverflowError) as e:
        raise ValueError(f"a value does not fit its field: {e}") from None


class Out:
    """CDR bytes in the making; `data[:4]` is the encapsulation header that alignment does not count."""

    __slots__ = ("data",)

    def __init__(self, *parts: bytes) -> None:
        self.data = bytearray(b"".join(parts))

    def align(self, n: int) -> None:
        self.data += PAD[(4 - len(self.data)) % n]

    def put(self, n: int, layout: struct.Struct, *values: Any) -> None:
        self.align(n)
        self.data += pack(layout, *values)

    def text(self, value: str) -> None:
        raw = value.replace("\0", "").encode("utf-8", "replace") + b"\0"  # a NUL inside would end the string early
        self.put(4, U32, len(raw))
        self.data += raw

    def column(self, a: npt.NDArray[Any], dtype: str) -> None:
        a = np.ascontiguousarray(a, dtype=dtype)
        self.put(4, U32, a.size)
        if a.size:
            self.align(a.itemsize)
            self.data += a.tobytes()

    def columns(self, table: npt.NDArray[np.float32]) -> None:
        """The rows of a (k, n) table as k sequences of float32: count and numbers have one size, so in one go."""
        k, n = table.shape
        words = np.empty((k, n + 1), "<u4")
        words[:, 0] = n
        words[:, 1:] = table.view("<u4")
        self.align(4)
        self.data += words.tobytes()

    def done(self) -> bytes:
        return bytes(self.data)


class In:
    """Reads CDR bytes; every step beyond the end is a ValueError."""

    __slots__ = ("data", "pos")

    def __init__(self, data: bytes) -> None:
        if data[:2] not in (b"\0\1", b"\0\0") or len(data) < 4:
            raise ValueError("not a CDR message")
        if data[1] == 0:
            raise ValueError("big-endian CDR is not written by this program")
        self.data = data
        self.pos = 4

    def align(self, n: int) -> None:
        self.pos += (4 - self.pos) % n

    def take(self, n: int) -> int:
        """Position of the next n bytes, which are then behind."""
        pos = self.pos
        if pos + n > len(self.data):
            raise ValueError(f"message of {len(self.data)} bytes ends inside a field")
        self.pos = pos + n
        return pos

    def fixed(self, n: int, layout: struct.Struct) -> tuple[Any, ...]:
        self.align(n)
        return layout.unpack_from(self.data, self.take(layout.size))

    def text(self) -> str:
        (n,) = self.fixed(4, U32)
        pos = self.take(n)
        return self.data[pos : pos + n].rstrip(b"\0").decode("utf-8", "replace")

    def array(self, dtype: str, n: int) -> npt.NDArray[Any]:
        kind = np.dtype(dtype)
        if n == 0:
            return np.zeros(0, kind)
        self.align(kind.itemsize)
        return np.frombuffer(self.data, kind, n, self.take(n * kind.itemsize))

    def column(self, dtype: str) -> npt.NDArray[Any]:
        (n,) = self.fixed(4, U32)
        return self.array(dtype, n)

    def head(self) -> tuple[int, str]:
        sec, nanosec = self.fixed(4, STAMP)
        return sec * S + nanosec, self.text()


@lru_cache(maxsize=64)
def _types(name: str, text: str) -> dict[str, tuple[Field, ...]]:
    return parse_schema(name, text)


def decode(schema_name: str, data: bytes, text: str | None = None) -> dict[str, Any]:
    """Any message as a dict of its fields, by its message text (default: this program's own).

    A nested message is a dict, a sequence of numbers an array, a sequence of others a list. ValueError for an unknown
    schema or damaged bytes.
    """
    if text is None:
        text = SCHEMAS.get(full_name(schema_name))
        if text is None:
            raise ValueError(f"schema {schema_name!r} is not one of this program's")
    types = _types(schema_name, text)
    return _message(types, full_name(schema_name), In(data))


def _message(types: dict[str, tuple[Field, ...]], name: str, stream: In) -> dict[str, Any]:
    fields = types.get(name)
    if fields is None:
        raise ValueError(f"the message text does not define {name}")
    return {field.name: _value(types, field, stream) for field in fields}


def _value(types: dict[str, tuple[Field, ...]], field: Field, stream: In) -> Any:
    kind = field.type
    if field.length is None:
        if kind == "string":
            return stream.text()
        if kind in SINGLE:
            layout = SINGLE[kind]
            return stream.fixed(layout.size, layout)[0]
        return _message(types, kind, stream)
    n = stream.fixed(4, U32)[0] if field.length < 0 else field.length
    if kind in PRIMITIVES:
        return stream.array(PRIMITIVES[kind][0], n)
    if n > len(stream.data):  # an element has at least one byte: keeps a damaged count from filling the memory
        raise ValueError(f"{field.name}: {n} elements in a message of {len(stream.data)} bytes")
    if kind == "string":
        return [stream.text() for _ in range(n)]
    return [_message(types, kind, stream) for _ in range(n)]
