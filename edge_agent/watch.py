"""`edge-agent status --watch`: the view of `status.py`, drawn anew each second in whatever terminal there is."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from edge_agent import status as st

ENTER, LEAVE = "\x1b[?1049h\x1b[?25l", "\x1b[?25h\x1b[?1049l"  # a screen of its own, without the cursor
HOME, LINE_END, REST = "\x1b[H", "\x1b[K", "\x1b[J"


def places(environment: Mapping[str, str], dirs: Sequence[Path], data_dir: str | None) -> list[Path]:
    """Folders where a status may lie: those that are named; else where the service of `data_dir` writes; else where
    systemd's does."""
    if dirs:
        return [place for d in dirs for place in (d, d / "state")]
    service = Path(environment.get("RUNTIME_DIRECTORY", "").split(":")[0] or "/run/edge-agent")
    return [service] if data_dir is None else [service, Path(data_dir) / "state"]


def ansi(out: TextIO, environment: Mapping[str, str]) -> tuple[bool, bool]:
    """(the cursor can be moved, colours may be used) on this output."""
    moves = out.isatty() and environment.get("TERM", "") not in ("", "dumb")
    return moves, moves and not environment.get("NO_COLOR")


def size() -> tuple[int, int]:
    """Columns and lines of the terminal; 80 by 24 where there is none."""
    columns, lines = shutil.get_terminal_size((80, 24))
    return max(columns, 20), max(lines, 5)


def report(path: Path, status: st.Status, now_utc_ns: int) -> dict[str, object]:
    """What --json says: the tree, and what is made of it."""
    age, wrong = st.age_s(status, now_utc_ns), st.problems(status, now_utc_ns)
    head = {"ok": not wrong, "file": str(path), "age_s": age, "stale": st.stale(status, now_utc_ns), "problems": wrong}
    return {**head, **st.plain(status)}


@contextmanager
def screen(out: TextIO, moves: bool) -> Iterator[None]:
    """A screen of its own, given back whatever happens."""
    if moves:
        out.write(ENTER)
    try:
        yield
    finally:
        if moves:
            out.write(LEAVE)
        out.flush()


def watch(
    out: TextIO,
    environment: Mapping[str, str],
    look: Callable[[], tuple[Path, st.Status]],
    now: Callable[[], int],
    pause: Callable[[], None],
) -> None:
    """Draw until KeyboardInterrupt, which ends it quietly. Without a terminal the view is printed again and again."""
    moves, colour = ansi(out, environment)
    try:
        with screen(out, moves):
            while True:
                width, height = size()
                now_ns = now()  # before the file is read: a slow machine must not make it look old
                try:
                    text = st.render(look()[1], width, height if moves else None, now_ns, colour)
                except (FileNotFoundError, st.StatusError) as e:  # the agent may be on its way
                    text = f"{e}\nwaiting for it; Ctrl-C ends"
                if moves:
                    lines = [line[:width] if "\x1b" not in line else line for line in text.split("\n")][:height]
                    out.write(HOME + (LINE_END + "\r\n").join(lines) + LINE_END + REST)
                else:
                    out.write(text + "\n\n")
                out.flush()
                pause()
    except KeyboardInterrupt:
        return
