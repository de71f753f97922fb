"""Two tables, kind -> "module:Class", imported when used, so that a gateway without CAN never loads a CAN library.

A `*_port.py` does I/O and never parses; a `*_codec.py` parses and never does I/O. From edge_agent both import only
`edge_agent.messages`. Shape, not ancestry:

    port:   __init__(settings), open(), read() -> list of (monotonic ns, payload), close(silently=False), counters
    codec:  __init__(...), feed(...), save(), load(state), counters

`open` and `read` of a port raise `PortError`; `read` returns within about 0.5 s, with [] when nothing came.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

PORTS: Mapping[str, str] = {
    "serial": "drivers.serial_port:SerialPort",
    "can": "drivers.can_port:CanPort",
    "clock": "drivers.clock_port:ClockPort",
}
CODECS: Mapping[str, str] = {
    "nmea": "drivers.nmea_codec:NmeaCodec",
    "accel": "drivers.dbc_codec:AccelCodec",
}


class PortError(OSError):
    """A device could not be opened or was lost. The text says which, why, and where it helps what to do."""

    def __str__(self) -> str:
        return self.strerror or super().__str__()  # without the number, which tells a technician nothing


def load(table: Mapping[str, str], kind: str) -> Any:
    """The class that `table` names for `kind`. Raises ValueError for a kind that is not in the table."""
    if kind not in table:
        raise ValueError(f"kind {kind!r} is not known; there are: {', '.join(sorted(table))}")
    module, _, name = table[kind].partition(":")
    return getattr(importlib.import_module(module), name)
