"""The text of an slcan adapter to CAN frames, in numpy blocks: one byte at a time costs 200 times as much.

    t iii l dd...    11-bit identifier, length, data, all hexadecimal; T (or x) iiiiiiii l dd...: 29-bit identifier
    r iii l          remote request; R iiiiiiii l
    d, D, b, B       the same for CAN FD, length as its code; b and B with the faster bit rate

each ended by CR, with four digits of the adapter's own time stamp behind it where that is switched on (not used).
Answers to commands are passed over; a BEL is one too. What is neither is counted: a damaged line is never a frame. As a
frame (but FD) begins with a letter that is no digit, garbage before it or a lost CR costs only what it stands in.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from edge_agent.messages import I64, U8, U32, CanFlag

LONGEST = 1 + 8 + 1 + 2 * 64 + 4  # bytes of a line

HEX = np.full(256, 255, np.uint8)
for _k, _c in enumerate(b"0123456789abcdef"):
    HEX[_c] = _k
    HEX[ord(chr(_c).upper())] = _k
FD_LENGTH = np.array([0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64], np.uint8)
KINDS: dict[int, tuple[int, CanFlag]] = {
    ord("t"): (3, CanFlag(0)),
    ord("T"): (8, CanFlag.EXT),
    ord("x"): (8, CanFlag.EXT),
    ord("r"): (3, CanFlag.RTR),
    ord("R"): (8, CanFlag.EXT | CanFlag.RTR),
    ord("d"): (3, CanFlag.FD),
    ord("D"): (8, CanFlag.FD | CanFlag.EXT),
    ord("b"): (3, CanFlag.FD | CanFlag.BRS),
    ord("B"): (8, CanFlag.FD | CanFlag.BRS | CanFlag.EXT),
}
"""Letter -> digits of the identifier, flags."""
STARTS = np.isin(np.arange(256), list(b"tTxrR"))  # d, D, b and B are digits too
ANSWERS = np.isin(np.arange(256), list(b"zZVvNF"))

Columns = tuple[U32, U8, U8, U8, I64]
"""can_id (n,), flags (n,), length (n,), data (n, 8), or (n, 64) if one of the frames is FD; where each ends (n,)."""


class SlcanLines:
    """Bytes in, frames out; `malformed` counts pieces that are neither frames nor answers."""

    def __init__(self) -> None:
        self.malformed = 0
        self._rest = b""

    def feed(self, data: bytes) -> Columns | None:
        """The frames whose lines these bytes complete, in their order, and where in them; None if there are none."""
        before = len(self._rest)
        data = self._rest + data
        b = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero((b == 13) | (b == 7))
        # of a line that is too long its end will do: to be counted as such, or for the frame that begins in it
        self._rest = data[int(ends[-1]) + 1 if ends.size else 0 :][-LONGEST - 1 :]
        if not ends.size:
            return None
        begins = np.concatenate([[0], ends[:-1] + 1])
        letters = np.flatnonzero(STARTS[b[: ends[-1]]])
        if letters.size:
            last = letters[np.maximum(np.searchsorted(letters, ends) - 1, 0)]
            late = (last > begins) & (last < ends)
            self.malformed += int(np.count_nonzero(late))
            begins = np.where(late, last, begins)
        size = ends - begins
        first = b[begins]  # of an empty line its end, which no kind has
        groups, which = np.unique(first * np.int64(1 << 16) + np.minimum(size, LONGEST + 1), return_inverse=True)
        found: list[tuple[I64, U32, U8, U8, U8]] = []
        for g, code in enumerate(groups.tolist()):
            kind, n = code >> 16, code & 0xFFFF
            lines = np.flatnonzero(which == g)
            if kind in KINDS and n <= LONGEST:
                part = _frames(b, begins[lines], n, *KINDS[kind])
                good = part[0]
                self.malformed += int(good.size - np.count_nonzero(good))
                found.append((lines[good], part[1][good], part[2][good], part[3][good], part[4][good]))
            elif n > LONGEST or (n and not ANSWERS[kind]):
                self.malformed += lines.size
        if not sum(f[0].size for f in found):
            return None
        width = max(f[4].shape[1] for f in found if f[0].size)
        lines = np.concatenate([f[0] for f in found])
        order = np.argsort(lines)
        rows = np.concatenate([np.pad(f[4], ((0, 0), (0, max(0, width - f[4].shape[1]))))[:, :width] for f in found])
        return (
            np.concatenate([f[1] for f in found])[order],
            np.concatenate([f[2] for f in found])[order],
            np.concatenate([f[3] for f in found])[order],
            rows[order],
            ends[lines[order]] - before,
        )


def _frames(b: U8, begins: I64, n: int, digits: int, flags: CanFlag) -> tuple[npt.NDArray[np.bool_], U32, U8, U8, U8]:
    """(good (m,), can_id, flags, length, data) of m lines of n characters of one kind."""
    m = begins.size
    head = digits + 2
    fd = bool(flags & CanFlag.FD)
    if n < head:
        none = np.zeros(m, np.uint8)
        return np.zeros(m, np.bool_), none.astype(np.uint32), none, none, np.zeros((m, 8), np.uint8)
    x = HEX[b[begins[:, None] + np.arange(1, n)]]
    can_id = np.zeros(m, np.uint32)
    for k in range(digits):
        can_id = can_id << np.uint32(4) | x[:, k]
    code = x[:, digits]
    length = FD_LENGTH[code & 15] if fd else code
    carried = np.zeros(m, np.int64) if flags & CanFlag.RTR else length.astype(np.int64)
    good = (x < 16).all(axis=1) & (can_id <= (0x1FFFFFFF if digits == 8 else 0x7FF)) & (fd | (code <= 8))
    good &= (n == head + 2 * carried) | (n == head + 2 * carried + 4)
    width = 64 if fd else 8
    data = np.zeros((m, width), np.uint8)
    there = min(width, (n - head) // 2)
    data[:, :there] = x[:, head - 1 : head - 1 + 2 * there : 2] << 4 | x[:, head : head + 2 * there : 2]
    data[np.arange(width) >= carried[:, None]] = 0  # the time stamp
    return good, can_id, np.full(m, int(flags), np.uint8), length, data
