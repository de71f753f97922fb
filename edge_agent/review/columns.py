"""Many messages of one topic -> columns at once: the layout is read from the first, the rest is a view of numbers.

Messages of one topic differ in their numbers and in the lengths of their sequences; those of equal length whose length
words are equal have one layout. 1 us a message instead of 40.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.recording import cdr
from edge_agent.recording.schemas import PRIMITIVES, SCHEMAS, Field, full_name, parse_schema


class Place(NamedTuple):
    """Where a field of numbers stands: position, numpy type, how many."""

    pos: int
    dtype: str
    number: int


class Group(NamedTuple):
    """Messages of one layout: their places in the list (k,), and field name -> (k, count). Names of nested fields are
    joined by dots; strings are left out."""

    rows: npt.NDArray[np.int64]
    columns: dict[str, npt.NDArray[Any]]


@lru_cache(maxsize=16)
def _types(schema: str) -> dict[str, tuple[Field, ...]]:
    return parse_schema(full_name(schema), SCHEMAS[full_name(schema)])


def layout(schema: str, data: bytes) -> tuple[dict[str, Place], list[int]]:
    """Places of a message's numbers, and the positions of its length words. ValueError for damaged bytes."""
    types = _types(schema)
    stream = cdr.In(data)
    places: dict[str, Place] = {}
    lengths: list[int] = []

    def length() -> int:
        (n,) = stream.fixed(4, cdr.U32)
        lengths.append(stream.pos - 4)
        return int(n)

    def walk(name: str, prefix: str) -> None:
        for field in types[full_name(name)]:
            path = prefix + field.name
            if field.length is None:
                one(field, path)
                continue
            n = length() if field.length < 0 else field.length
            if field.type in PRIMITIVES:
                numbers(field, path, n)
            else:
                for i in range(n):
                    one(field, f"{path}.{i}")

    def one(field: Field, path: str) -> None:
        if field.type == "string":
            stream.take(length())
        elif field.type in PRIMITIVES:
            numbers(field, path, 1)
        else:
            walk(field.type, path + ".")

    def numbers(field: Field, path: str, n: int) -> None:
        kind = np.dtype(PRIMITIVES[field.type][0])
        if n:
            stream.align(kind.itemsize)
        places[path] = Place(stream.take(n * kind.itemsize), PRIMITIVES[field.type][0], n)

    walk(schema, "")
    return places, lengths


def groups(schema: str, messages: Sequence[bytes], fields: Container[str] | None = None) -> list[Group]:
    """Columns of messages of one schema; `fields`: those that are wanted. ValueError for damaged bytes."""
    by_size: dict[int, list[int]] = {}
    for i, data in enumerate(messages):
        by_size.setdefault(len(data), []).append(i)
    out = []
    for size, rows in by_size.items():
        left = np.array(rows, dtype=np.int64)
        table = np.frombuffer(b"".join(messages[i] for i in rows), np.uint8).reshape(len(rows), size)
        while len(left):
            places, lengths = layout(schema, messages[int(left[0])])
            words = table[:, [p + k for p in lengths for k in range(4)]]
            alike = (words == words[0]).all(axis=1)
            part = table[alike]
            columns = {
                name: np.ascontiguousarray(part[:, p.pos : p.pos + p.number * np.dtype(p.dtype).itemsize]).view(p.dtype)
                for name, p in places.items()
                if fields is None or name in fields
            }
            out.append(Group(left[alike], columns))
            left, table = left[~alike], table[~alike]
    return out
