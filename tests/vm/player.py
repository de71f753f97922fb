"""Plays a schedule of CAN frames onto an interface, inside the virtual machine.

    python3 player.py IFACE SCHEDULE START_UTC_S

SCHEDULE: records of i64 ns after the start and 16 bytes of struct can_frame. The start is a wall time; from there the
monotonic clock paces, so that a step of the wall clock moves no frame. Frames that are late follow at the pace of a
bus: the emulated card loses what comes at once. Prints how many frames were sent and how late the latest left.
"""

from __future__ import annotations

import errno
import socket
import struct
import sys
import time
from pathlib import Path

RECORD = struct.Struct("=q16s")
FRAME_S = 0.001

interface, path, start = sys.argv[1:]
bus = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
bus.bind((interface,))
frames = list(RECORD.iter_unpack(Path(path).read_bytes()))
begin_ns = time.monotonic_ns() + int(float(start) * 1e9) - time.time_ns()
late_ns = 0
for after_ns, frame in frames:
    wait_ns = begin_ns + after_ns - time.monotonic_ns()
    time.sleep(max(wait_ns / 1e9, FRAME_S))
    late_ns = max(late_ns, -wait_ns)
    while True:
        try:
            bus.send(frame)
            break
        except OSError as e:
            if e.errno != errno.ENOBUFS:  # the card's queue is full: the bus needs its time
                raise
        time.sleep(FRAME_S)
print(f"{len(frames)} frames, at most {late_ns / 1e6:.1f} ms late")
