"""Checkpoint bytes: a tree of plain values and numpy arrays, packed the same way every time and without pickle.

Layout: 8 bytes magic, u32 length of a JSON skeleton, the skeleton, then the arrays and byte strings back to back. An
array stands in the skeleton as {"$a": [dtype, shape, offset]}, bytes as {"$b": [length, offset]}, a NaN or infinite
float as JSON's NaN/Infinity (Python reads its own back exactly; finite floats go through repr and are exact).
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

MAGIC = b"EASTATE1"
_DTYPES = {"|b1", "|u1", "|i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f4", "<f8"}


def pack(tree: Any) -> bytes:
    """Pack a tree (dict with str keys, list, tuple, str, int, float, bool, None, bytes, ndarray) to bytes.

    Tuples come back as lists. Raises TypeError for any other type: a state that cannot be saved is a bug.
    """
    blobs: list[bytes] = []
    size = 0

    def put(data: bytes) -> int:
        nonlocal size
        blobs.append(data)
        size += len(data)
        return size - len(data)

    def walk(x: Any) -> Any:
        if x is None or isinstance(x, (bool, int, float, str)):
            if isinstance(x, np.generic):
                return x.item()
            return x
        if isinstance(x, np.ndarray):
            a = np.ascontiguousarray(x)
            if a.dtype.str not in _DTYPES:
                raise TypeError(f"state: array of {a.dtype} cannot be saved")
            return {"$a": [a.dtype.str, list(x.shape), put(a.tobytes())]}
        if isinstance(x, (bytes, bytearray)):
            return {"$b": [len(x), put(bytes(x))]}
        if isinstance(x, dict):
            for k in x:
                if not isinstance(k, str) or k.startswith("$"):
                    raise TypeError(f"state: key {k!r} must be a string without a leading $")
            return {k: walk(v) for k, v in x.items()}
        if isinstance(x, (list, tuple)):
            return [walk(v) for v in x]
        if isinstance(x, (np.integer, np.floating, np.bool_)):
            return x.item()
        raise TypeError(f"state: {type(x).__name__} cannot be saved")

    skeleton = json.dumps(walk(tree), separators=(",", ":"), ensure_ascii=False).encode()
    return b"".join([MAGIC, struct.pack("<I", len(skeleton)), skeleton, *blobs])


def unpack(data: bytes) -> Any:
    """Inverse of `pack`; arrays are fresh and writable. Raises ValueError for anything that `pack` did not make."""
    if data[:8] != MAGIC or len(data) < 12:
        raise ValueError("checkpoint: not a state of this program (magic differs)")
    (n,) = struct.unpack_from("<I", data, 8)
    base = 12 + n
    if base > len(data):
        raise ValueError("checkpoint: cut short")
    try:
        skeleton = json.loads(data[12:base])
    except (ValueError, RecursionError) as e:
        raise ValueError(f"checkpoint: damaged skeleton: {e}") from None

    def take(offset: Any, length: int) -> bytes:
        if not isinstance(offset, int) or offset < 0 or length < 0 or base + offset + length > len(data):
            raise ValueError("checkpoint: a value lies outside of the data")
        return data[base + offset : base + offset + length]

    def walk(x: Any) -> Any:
        if isinstance(x, list):
            return [walk(v) for v in x]
        if isinstance(x, dict):
            if "$a" in x:
                dtype, shape, offset = _triple(x["$a"])
                if dtype not in _DTYPES or not all(isinstance(s, int) and 0 <= s < 1 << 31 for s in shape):
                    raise ValueError("checkpoint: damaged array")
                count = 1
                for s in shape:
                    count *= s
                raw = take(offset, count * np.dtype(dtype).itemsize)
                return np.frombuffer(raw, dtype=dtype).reshape(shape).copy()
            if "$b" in x:
                if not (isinstance(x["$b"], list) and len(x["$b"]) == 2 and isinstance(x["$b"][0], int)):
                    raise ValueError("checkpoint: damaged bytes")
                return take(x["$b"][1], x["$b"][0])
            return {k: walk(v) for k, v in x.items()}
        return x

    try:
        return walk(skeleton)
    except RecursionError:
        raise ValueError("checkpoint: damaged skeleton: nested too deeply") from None


def _triple(x: Any) -> tuple[str, list[int], Any]:
    if not (isinstance(x, list) and len(x) == 3 and isinstance(x[0], str) and isinstance(x[1], list)):
        raise ValueError("checkpoint: damaged array")
    return x[0], x[1], x[2]
