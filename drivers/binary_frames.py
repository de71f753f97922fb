"""Binary frames that GNSS receivers put between NMEA sentences: how long one is, and whether its check holds.

UBX (u-blox interface description), RTCM 3 (RTCM 10403, CRC-24Q), SBF (Septentrio: CRC-CCITT), NovAtel with long and
short header and Unicore (CRC-32). Only lengths and checks: what the frames say is not read here.
"""

from __future__ import annotations

import binascii
import zlib

import numpy as np

FRAME_LIMIT = 16384
"""Longest frame believed [bytes]: NovAtel's range logs reach 10 kB. Bounds the buffer of whoever waits for one."""
UBX_LIMIT = 8192
HEAD = 10
"""Bytes that tell the length of any frame."""


def frame_length(head: bytes) -> tuple[str, int]:
    """(name, length in bytes) of the frame that begins with `head`, its first up to `HEAD` bytes.

    Length 0 = no frame; negative = so many bytes of head are needed to tell.
    """
    known = len(head)
    if head[:2] == b"\xb5b":
        if known < 6:
            return "UBX", -6
        return "UBX", _within(8 + int.from_bytes(head[4:6], "little"), UBX_LIMIT)
    if head[:2] == b"$@":
        if known < 8:
            return "SBF", -8
        total = int.from_bytes(head[6:8], "little")
        return "SBF", 0 if total < 8 or total % 4 else _within(total, FRAME_LIMIT)
    if head[0] == 0xD3:
        if known < 2 or (known < 3 and not head[1] & 0xFC):
            return "RTCM3", -known - 1
        return "RTCM3", 0 if head[1] & 0xFC else 6 + (head[1] << 8 | head[2])
    if head[:2] == b"\xaaD" and known >= 3:
        name = {0x12: "NovAtel", 0x13: "NovAtel short", 0xB5: "Unicore"}.get(head[2], "")
        if name and known < HEAD:
            return name, -HEAD
        if head[2] == 0x12 and head[3] >= HEAD:
            return name, _within(head[3] + int.from_bytes(head[8:10], "little") + 4, FRAME_LIMIT)
        if head[2] == 0x13:
            return name, 12 + head[3] + 4
        if head[2] == 0xB5:
            return name, _within(24 + int.from_bytes(head[6:8], "little") + 4, FRAME_LIMIT)
        return name, 0
    if known < 3 and head in (b"\xb5", b"$", b"\xaa", b"\xaaD"):
        return "", -known - 1
    return "", 0


def _within(total: int, limit: int) -> int:
    return total if total <= limit else 0


def frame_error(name: str, frame: bytes) -> str:
    """What is wrong with a whole binary frame by its own check, "" when nothing is."""
    if name == "UBX":
        data = np.frombuffer(frame, np.uint8)[2:-2]
        sums = np.cumsum(data, dtype=np.uint8)  # Fletcher's sums run modulo 256 (u-blox interface description)
        right = bytes((int(sums[-1]), int(np.sum(sums, dtype=np.uint8))))
        said = frame[-2:]
    elif name == "RTCM3":
        right = _crc24q(frame[:-3]).to_bytes(3, "big")
        said = frame[-3:]
    elif name == "SBF":
        right = binascii.crc_hqx(frame[4:], 0).to_bytes(2, "little")
        said = frame[2:4]
    else:  # NovAtel and Unicore: CRC-32 without the inversions that zlib makes
        right = (zlib.crc32(frame[:-4], 0xFFFFFFFF) ^ 0xFFFFFFFF).to_bytes(4, "little")
        said = frame[-4:]
    if said == right:
        return ""
    check = f"{said.hex()} stands there, {right.hex()} would be right"
    return f"{name} frame of {len(frame)} bytes ({frame[:8].hex()}...): {check}"


def _crc24q_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 16
        for _ in range(8):
            crc = crc << 1 ^ (0x1864CFB if crc & 0x800000 else 0)
        table.append(crc)
    return table


_CRC24Q = _crc24q_table()


def _crc24q(data: bytes) -> int:
    """RTCM 3's CRC-24Q: polynomial 0x1864CFB, start 0."""
    crc = 0
    for byte in data:
        crc = crc << 8 & 0xFFFFFF ^ _CRC24Q[crc >> 16 ^ byte]
    return crc
