"""Signals of CAN frames: where their bits lie, compiled once and decoded in numpy blocks; and their names in DBC files.

Every signal becomes the list of its bytes from least to most significant, a shift and a mask. Both byte orders come out
the same that way: Motorola only lists its bytes the other way round. Which frames hold a signal is part of it: the bits
of the identifier that must agree (all of them, or for J1939 those of the PGN), and for a multiplexed signal the values
that its selectors must have.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, U8, SignalField

U64 = npt.NDArray[np.uint64]

WHOLE_ID = 0x1FFFFFFF  # every bit of an identifier
ANY_SOURCE = 0xFE  # J1939-81: the null address; DBC files write it where the source does not matter


# ------------------------------------------------------------------------------------------------------------ signals


@dataclass(frozen=True, slots=True)
class SignalSpec:
    """One signal, compiled. value = raw * scale + offset; raw = bits of `columns` (from least to most significant
    byte) shifted right by `shift` and cut to `length` bits."""

    name: str
    can_id: int
    extended: bool
    columns: tuple[int, ...]
    shift: int
    length: int
    signed: bool
    is_float: bool
    scale: float
    offset: float
    unit: str = ""
    modulus: int = 0  # as a counter: values before it wraps
    mask: int = WHOLE_ID  # bits of an identifier that must be those of `can_id`
    j1939: bool = False  # `can_id` is a J1939 identifier, as the DBC file or the field says
    when: tuple[
        tuple[SignalSpec, tuple[int, ...]], ...
    ] = ()  # selectors, outermost first, and the values they must have

    @property
    def need(self) -> int:
        """Bytes that a frame must have for this signal."""
        return max(self.columns) + 1


def j1939_mask(can_id: int) -> int:
    """Bits of an identifier that make its PGN (SAE J1939-21): both data page bits and PDU format; from format 240 on
    (PDU2) the next byte too, below it (PDU1) that byte is the destination. Priority and source are no part of it."""
    return 0x03FFFF00 if can_id >> 16 & 0xFF >= 240 else 0x03FF0000


def by_pgn(spec: SignalSpec, source: int | None) -> SignalSpec:
    """The signal in every frame of its PGN, of any priority, to any destination, from `source` (None: from any)."""
    mask = j1939_mask(spec.can_id)
    can_id = spec.can_id & mask
    if source is not None:
        mask, can_id = mask | 0xFF, can_id | source
    return replace(spec, can_id=can_id, mask=mask)


def compile_signal(name: str, field: SignalField, unit: str = "", maximum: float | None = None) -> SignalSpec:
    """Compile a field. `start` counts as in a DBC file: the least significant bit for little endian, the most
    significant one for big endian, with bit 0 the lowest bit of byte 0 in both. Raises ValueError with the reason."""
    can_id, extended = field.can_id, field.extended
    if field.pgn is not None:
        can_id, extended = field.pgn << 8 | ANY_SOURCE, True
        if not 0 <= field.pgn <= 0x3FFFF:
            raise ValueError(f"{name}: PGN {field.pgn} does not fit, 0x3FFFF is the largest")
        if field.pgn << 8 & ~j1939_mask(can_id):
            raise ValueError(
                f"{name}: PGN 0x{field.pgn:X} has a format below 240, where the last byte is a destination: "
                f"write 0x{field.pgn & 0x3FF00:X}"
            )
    top = 0x1FFFFFFF if extended else 0x7FF
    if not 0 <= can_id <= top:
        raise ValueError(f"{name}: identifier 0x{can_id:X} does not fit, 0x{top:X} is the largest")
    if not 1 <= field.length <= 64:
        raise ValueError(f"{name}: a length of {field.length} bits is not between 1 and 64")
    if field.is_float and field.length not in (16, 32, 64):
        raise ValueError(f"{name}: a float has 16, 32 or 64 bits, not {field.length}")
    if not (math.isfinite(field.scale) and math.isfinite(field.offset)) or field.scale == 0.0:
        raise ValueError(f"{name}: scale {field.scale} and offset {field.offset} must be finite and scale not 0")
    if field.byteorder == "little":
        first = field.start // 8
        shift = field.start % 8
        last = (field.start + field.length - 1) // 8
        columns = tuple(range(first, last + 1))
    elif field.byteorder == "big":
        begin = 8 * (field.start // 8) + 7 - field.start % 8  # counted from the frame's first bit on the wire
        end = begin + field.length
        first, last = begin // 8, (end - 1) // 8
        shift = 8 * (last + 1) - end
        columns = tuple(range(last, first - 1, -1))
    else:
        raise ValueError(f"{name}: byteorder {field.byteorder!r} is neither little nor big")
    if field.start < 0 or max(columns) > 63:
        raise ValueError(f"{name}: bits {field.start} +{field.length} lie outside of the 64 bytes of a CAN FD frame")
    modulus = 1 << field.length
    if maximum is not None and maximum == modulus - 2:  # some profiles keep the last value for "invalid"
        modulus -= 1
    return SignalSpec(
        name,
        can_id,
        extended,
        columns,
        shift,
        field.length,
        field.signed,
        field.is_float,
        field.scale,
        field.offset,
        unit,
        modulus,
        j1939=field.pgn is not None,
    )


def decode_signal(spec: SignalSpec, data: U8, length: U8) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """Raw values (n,) of one signal from frames data (n, w), and where the frame was long enough to hold it (n,).

    int64 for signed, uint64 for unsigned, float64 for float signals; unscaled. A value where the frame was too short
    means nothing.
    """
    ok = length >= spec.need
    n, width = data.shape
    if width < spec.need:
        data = np.concatenate([data, np.zeros((n, spec.need - width), np.uint8)], axis=1)
    columns = spec.columns
    low = np.zeros((n, 8), np.uint8)
    low[:, : min(len(columns), 8)] = data[:, columns[:8]]
    bits: U64 = low.view("<u8")[:, 0] >> np.uint64(spec.shift)
    if len(columns) == 9:  # a long field across byte borders
        bits |= data[:, columns[8]].astype(np.uint64) << np.uint64(64 - spec.shift)
    bits &= np.uint64((1 << spec.length) - 1)
    if spec.is_float:
        code = {16: ("<u2", "<f2"), 32: ("<u4", "<f4"), 64: ("<u8", "<f8")}[spec.length]
        return bits.astype(code[0]).view(code[1]).astype(np.float64), ok
    if spec.signed:
        sign = np.uint64(1 << (spec.length - 1))
        return ((bits ^ sign) - sign).view(np.int64), ok
    return bits, ok


class Decoder:
    """Several signals of one message at once: (n, w) bytes to (n, k) values. Numpy calls are the cost at 25 frames, so
    what is the same for all signals is a scalar, and whole bytes are only gathered."""

    def __init__(self, specs: Sequence[SignalSpec]) -> None:
        self.specs = tuple(specs)
        self.need = max(s.need for s in specs)
        self.is_float = any(s.is_float for s in specs)
        self.scale = _common([s.scale for s in specs], np.float64)
        self.offset = _common([s.offset for s in specs], np.float64)
        # The usual case is decoded as one array: integers that lie in eight bytes and fit into int64.
        self.together = all(not s.is_float and len(s.columns) <= 8 and (s.signed or s.length < 64) for s in specs)
        whole = {(s.length, s.signed) for s in specs} if all(s.shift == 0 for s in specs) else set()
        length, signed = whole.pop() if len(whole) == 1 else (0, False)
        self.dtype = f"<{'i' if signed else 'u'}{length // 8}" if length in (8, 16, 32, 64) else ""
        size = length // 8 if self.dtype else 8
        # Columns beyond a signal's own repeat its first byte; the mask takes their bits out again.
        self.columns = np.array([(s.columns + (s.columns[0],) * 8)[:size] for s in specs])
        self.shift = np.array([s.shift for s in specs], np.uint64)
        self.mask = _common([(1 << s.length) - 1 for s in specs], np.uint64)
        self.sign = _common([(1 << (s.length - 1)) * s.signed for s in specs], np.uint64)
        self.any_signed = any(s.signed for s in specs)

    def raw(self, data: U8, length: U8) -> npt.NDArray[Any]:
        """Raw values (n, k) of frames that are all at least `need` bytes long; float64 where one signal is a float."""
        if not self.together:
            return np.stack([decode_signal(s, data, length)[0].astype(np.float64) for s in self.specs], axis=1)
        bits = data.take(self.columns, axis=1)
        if self.dtype:
            return bits.view(self.dtype)[:, :, 0]
        values: U64 = (bits.view("<u8")[:, :, 0] >> self.shift) & self.mask
        if self.any_signed:
            values = (values ^ self.sign) - self.sign
        return values.view(np.int64)

    def __call__(self, data: U8, length: U8) -> F64:
        """Scaled values (n, k) of frames that are all at least `need` bytes long."""
        with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one, which the codec refuses
            values: F64 = self.raw(data, length) * self.scale + self.offset
        return values


def _common(values: Sequence[float], dtype: type[np.generic]) -> Any:
    """A scalar if all values are equal, else the array (k,)."""
    array = np.array(values, dtype)
    return array[0] if len(set(values)) == 1 else array


# ------------------------------------------------------------------------------------------------- names to signals


class Dbc:
    """The messages of a DBC text, for looking up names."""

    def __init__(self, text: str, path: str) -> None:
        import cantools  # imported when used: 60 ms and 3 MiB that fields in the YAML do not need

        self.path = path
        try:
            # Not strict: files in the field hold overlapping signals and messages that are too short for them; a
            # frame too short for ours is a Reject.
            database: Any = cantools.database.load_string(text, "dbc", strict=False)
        except cantools.Error as e:
            raise ValueError(f"{path}: not a DBC file: {e}") from None
        self.messages: list[Any] = list(database.messages)

    def find(self, name: str, among: Sequence[SignalSpec] | None = None) -> list[SignalSpec]:
        """Every signal that `name` ("Signal", "Message.Signal" or "0x1A.Signal") may mean, in the messages that
        carry a signal of `among` if given. Raises ValueError if there is none."""
        message_name, _, signal_name = name.rpartition(".")
        messages = self.messages
        if message_name:
            messages = [m for m in messages if message_name == m.name or _hex(message_name) == m.frame_id]
            if not messages:
                raise ValueError(
                    f"{self.path}: no message {message_name!r}; there are: "
                    f"{_listed(f'{m.name} (0x{m.frame_id:X})' for m in self.messages)}"
                )
        if among is not None:
            messages = [m for m in messages if any(_carries(m, s) for s in among)]
        found = [(m, s) for m in messages for s in m.signals if s.name == signal_name]
        if not found:
            known = "; ".join(
                f"signals of message {m.name}: {_listed(s.name for s in m.signals)}" for m in messages[:8]
            )
            more = f"; and {len(messages) - 8} messages more" if len(messages) > 8 else ""
            raise ValueError(f"{self.path}: no signal {signal_name!r}; {known}{more}")
        return [self._compile(m, s) for m, s in found]

    def one(self, name: str) -> SignalSpec:
        """The one signal of that name. Raises ValueError if there are several."""
        specs = self.find(name)
        if len(specs) > 1:
            signal = name.rpartition(".")[2]
            choice = _listed(f"0x{s.can_id:X}.{signal} ({s.name})" for s in specs)
            raise ValueError(f"{self.path}: signal {name!r} is ambiguous; write one of: {choice}")
        return specs[0]

    def _compile(self, message: Any, signal: Any) -> SignalSpec:
        name = f"{message.name}.{signal.name}"
        field = SignalField(
            can_id=message.frame_id,
            start=signal.start,
            length=signal.length,
            byteorder="little" if signal.byte_order == "little_endian" else "big",
            signed=signal.is_signed,
            is_float=signal.is_float,
            scale=float(signal.scale),
            offset=float(signal.offset),
            extended=message.is_extended_frame,
        )
        maximum = None if signal.maximum is None else float(signal.maximum)
        spec = compile_signal(name, field, signal.unit or "", maximum)
        when: list[tuple[SignalSpec, tuple[int, ...]]] = []
        inner = signal
        while inner.multiplexer_ids is not None:  # extended multiplexing: a selector may itself be selected
            selector = next((s for s in message.signals if s.name == inner.multiplexer_signal), None)
            if selector is None or len(when) == len(message.signals):
                raise ValueError(
                    f"{self.path}: signal {name} is multiplexed by {inner.multiplexer_signal}, which is no signal"
                )
            when.insert(0, (self._selector(message, selector), tuple(sorted(inner.multiplexer_ids))))
            inner = selector
        j1939 = bool(message.protocol == "j1939" and message.is_extended_frame)
        return replace(spec, when=tuple(when), j1939=j1939)

    def _selector(self, message: Any, signal: Any) -> SignalSpec:
        """A selector by its bits: its scale, sign and own place in the multiplexing do not matter."""
        order = "little" if signal.byte_order == "little_endian" else "big"
        field = SignalField(
            message.frame_id, signal.start, signal.length, order, False, extended=message.is_extended_frame
        )
        return compile_signal(f"{message.name}.{signal.name}", field)


def _carries(message: Any, spec: SignalSpec) -> bool:
    mask = spec.mask if spec.mask == WHOLE_ID else spec.mask & ~0xFF  # a source address is the configuration's
    return bool(message.is_extended_frame == spec.extended and message.frame_id & mask == spec.can_id & mask)


def _hex(text: str) -> int:
    """The number of "0x1A", or -1."""
    try:
        return int(text, 16) if text.lower().startswith("0x") else -1
    except ValueError:
        return -1


def _listed(names: Any, most: int = 40) -> str:
    every = list(names)
    return ", ".join(every[:most]) + (f" and {len(every) - most} more" if len(every) > most else "")
