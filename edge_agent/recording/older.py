"""Messages that another version of this program wrote, as today's: decoded by the message text inside their own file.

Fields that today's text does not have are left out; fields that the file does not have are unknown: NaN, 0, false, an
empty text; a missing column of a block has as many values as the others. What is missing is told once as an
`OtherVersionWarning`. A text that differs in comments or constants only costs nothing.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np

from edge_agent.recording import cdr
from edge_agent.recording.schemas import PRIMITIVES, SCHEMAS, Field, full_name, parse_schema

Types = Mapping[str, tuple[Field, ...]]
FIELDS_MOST = 1000
"""A text with more is not one of this program's: one that nests without end must not fill the memory."""


class OtherVersionWarning(UserWarning):
    """A recording lacks what this version writes, or holds what it does not know."""


@lru_cache(maxsize=256)
def converter(name: str, text: bytes) -> Callable[[bytes], bytes] | None:
    """What makes today's message of schema `name` of one that was written by `text`; None where it is today's already,
    or no schema of this program's. The converter raises ValueError for damaged bytes."""
    full = full_name(name)
    if full not in SCHEMAS or text == SCHEMAS[full].encode():
        return None
    try:
        old = parse_schema(full, text.decode())
        before = list(islice(_layout(old, full), FIELDS_MOST + 1))
    except (ValueError, KeyError, RecursionError):  # no ros2msg text: another program's, with a name of ROS 2
        return None
    new = parse_schema(full, SCHEMAS[full])
    now = [*_layout(new, full)]
    if before == now or len(before) > FIELDS_MOST:
        return None
    written = text.decode()
    missing, unknown = ([field for field in a if field not in b] for a, b in ((now, before), (before, now)))
    if told := [
        f"{what} {', '.join(path for path, _ in fields)}"
        for what, fields in (("lacks", missing), ("has what is not known here:", unknown))
        if fields
    ]:
        warnings.warn(f"recorded by another version: {full} {'; it '.join(told)}", OtherVersionWarning, stacklevel=2)

    def convert(data: bytes) -> bytes:
        out = cdr.Out(cdr.BEGIN)
        _put(out, new, full, cdr.decode(full, data, written))
        return out.done()

    return convert


def _layout(types: Types, name: str, path: str = "") -> Iterator[tuple[str, str]]:
    """Path and kind of each number and text of a message, in its order."""
    for field in types[name]:
        many = "" if field.length is None else f"[{field.length}]"
        if field.type in types:
            yield from _layout(types, field.type, f"{path}{field.name}{many}.")
        elif field.type in PRIMITIVES or field.type == "string":
            yield path + field.name, field.type + many
        else:
            raise ValueError(f"{path}{field.name} is of an unknown type {field.type}")


def _put(out: cdr.Out, types: Types, name: str, message: Mapping[str, Any]) -> None:
    columns = {len(v) for v in message.values() if isinstance(v, np.ndarray)}
    rows = columns.pop() if len(columns) == 1 else 0
    for field in types[name]:
        value = message.get(field.name)
        if field.length is None:
            _put_one(out, types, field.type, value)
            continue
        if field.type in PRIMITIVES:
            _put_numbers(out, field, value, rows)
            continue
        items = list(value) if isinstance(value, list) else []
        if field.length < 0:
            out.put(4, cdr.U32, len(items))
        else:
            items = (items + [None] * field.length)[: field.length]
        for item in items:
            _put_one(out, types, field.type, item)


def _put_numbers(out: cdr.Out, field: Field, value: Any, rows: int) -> None:
    dtype = np.dtype(PRIMITIVES[field.type][0])
    n = rows if field.length is None or field.length < 0 else field.length
    if isinstance(value, np.ndarray) and (field.length is None or field.length < 0 or len(value) == n):
        with np.errstate(invalid="ignore", over="ignore"):
            numbers = value.astype(dtype)
    else:
        numbers = np.full(n, math.nan if dtype.kind == "f" else 0, dtype)
    if field.length is None or field.length < 0:
        out.column(numbers, PRIMITIVES[field.type][0])
    elif n:
        out.align(dtype.itemsize)
        out.data += numbers.tobytes()


def _put_one(out: cdr.Out, types: Types, kind: str, value: Any) -> None:
    if kind == "string":
        out.text(value if isinstance(value, str) else "")
    elif kind in PRIMITIVES:
        dtype = np.dtype(PRIMITIVES[kind][0])
        layout = cdr.SINGLE[kind]
        good = isinstance(value, (int, float)) and (dtype.kind == "f" or value == value // 1)
        if not good:
            value = math.nan if dtype.kind == "f" else 0
        out.put(layout.size, layout, float(value) if dtype.kind == "f" else int(value))
    else:
        _put(out, types, kind, value if isinstance(value, dict) else {})
