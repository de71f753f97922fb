"""Work in a second process, with the same results as in this one.

`ahead` runs a generator beside: what it yields comes over a pipe, in its order, so nothing depends on whether there is
a second process. It waits when nobody takes what it has, so memory is bounded. Where there is no second processor, no
process to be had, or where it dies (killed, out of memory), the generator goes on here, behind what came already.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from edge_agent.memory import steady_memory

T = TypeVar("T")

WORTH_BYTES = 48 << 20
"""Recordings that are smaller are read sooner than a process has started."""


LARGE_BYTES = 1 << 20
"""Arrays of this size are given back at once, smaller ones are kept for the next: giving back has its price."""

allowed = False
"""Set by `alone`. Another program may not: its second process would run it again from the top, unless it has
its `if __name__ == "__main__"`."""


def alone() -> None:
    """This process does nothing but review, as one that the command line started."""
    global allowed
    allowed = True
    steady_memory(LARGE_BYTES)


def worth(files: Sequence[Path]) -> bool:
    """Whether a second process is to be had and files are large enough for it."""
    if not allowed or len(os.sched_getaffinity(0)) < 2 or multiprocessing.current_process().daemon:
        return False
    return sum(f.stat().st_size for f in files) >= WORTH_BYTES


def ahead(make: Callable[..., Iterator[T]], *args: Any) -> Iterator[T]:
    """What `make(*args)` yields, made by another process; `make` is a function of a module, arguments and values go
    through a pipe. It starts at once, not with the first value that is asked for."""
    context = multiprocessing.get_context("spawn")  # a fork would take threads' locks along
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(theirs, make, args), daemon=True)
    process.start()
    theirs.close()
    return _received(ours, process, make, args)


def _received(ours: Connection, process: Any, make: Callable[..., Iterator[T]], args: tuple[Any, ...]) -> Iterator[T]:
    count = 0
    try:
        while True:
            try:
                one = ours.recv()
            except (EOFError, OSError):
                break
            if one is None:
                return
            count += 1
            yield one.pop()  # nothing here holds it any longer
    finally:
        ours.close()
        process.terminate()
        process.join()
    yield from islice(make(*args), count, None)


def _serve(pipe: Connection, make: Callable[..., Iterator[T]], args: tuple[Any, ...]) -> None:
    steady_memory(LARGE_BYTES)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends the process that started this one, and that ends this
    try:
        for one in make(*args):
            pipe.send([one])
        pipe.send(None)
    except BrokenPipeError:
        pass
