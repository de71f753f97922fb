"""One program at a time writes into a data folder: a lock that ends with its process, whatever ends that."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

NAME = "state/lock"


class InUseError(Exception):
    """Another program writes there; the text says which folder and which process."""


def hold(data_dir: Path) -> int:
    """Lock `data_dir` until the process ends (or the returned descriptor is closed). InUseError, OSError."""
    path = data_dir / NAME
    path.parent.mkdir(parents=True, exist_ok=True)
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as e:
        holder = os.pread(fd, 32, 0).decode("ascii", "replace").strip() or "another process"
        os.close(fd)
        raise InUseError(f"{data_dir} is in use by process {holder}: stop that agent first") from e
    os.ftruncate(fd, 0)
    os.pwrite(fd, f"{os.getpid()}\n".encode(), 0)
    return fd
