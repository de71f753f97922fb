"""`make bench`: measures this checkout against its goals, or two checkouts against each other.

    python tests/bench/run.py [--rows NAME,...] [--rounds N] [--json] [--strict]
    python tests/bench/run.py --compare COMMIT [--rows NAME,...] [--rounds N]

Each figure is the median of `rounds` runs, each a process of its own; what it is compared with runs in the same round,
in turn before and behind it, so every ratio is of one moment. A row is chosen by its name or the first part of it.
Exit code 0 when all chosen rows ran: a goal that is missed is listed, not an error (`--strict` makes it 1), 1 when a
row failed, 2 for wrong use. Progress goes to stderr.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import figures
import scene
import whole_agent
from figures import Goal, Result

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]


@dataclass(frozen=True)
class Task:
    """A run of tasks.py: its name, the record (points), the figure that counts, libraries that it needs."""

    name: str
    points: int
    key: str
    writes: bool = False
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Row:
    name: str
    about: str
    unit: str
    task: Task
    peers: dict[str, Task]
    goals: tuple[Goal, ...]


FILTERPY = Task("filterpy", 1, "us", needs=("filterpy",))
LIBRARY = Task("library", 8, "percent", True, ("filterpy", "pynmea2", "cantools"))

ROWS = (
    Row(
        "computation",
        "decode, time, filter, encode, compress; 8 x 250 Hz + 10 Hz",
        "% of a core",
        Task("pipeline", 8, "percent", True),
        {"libraries": LIBRARY, "block floor": Task("floor_pipeline", 8, "percent", True)},
        (Goal(40.0, "libraries", "peer"), Goal(3.0, "block floor")),
    ),
    Row(
        "filter-1",
        "per sample and axis, 1 point, block_ms 100",
        "us",
        Task("filter", 1, "us"),
        {
            "filterpy": FILTERPY,
            "plain floor": Task("floor_plain", 1, "us"),
            "adaptive floor": Task("floor_adaptive", 1, "us"),
        },
        (Goal(0.6), Goal(8.0, "filterpy", "peer")),
    ),
    Row(
        "filter-8",
        "per sample and axis, 8 points",
        "us",
        Task("filter", 8, "us"),
        {
            "filterpy": FILTERPY,
            "plain floor": Task("floor_plain", 8, "us"),
            "adaptive floor": Task("floor_adaptive", 8, "us"),
        },
        (Goal(0.12), Goal(40.0, "filterpy", "peer")),
    ),
    Row(
        "replay",
        "raw file to fused file, 8 x 250 Hz + 10 Hz, by CPU time",
        "x real time",
        Task("replay", 8, "times", True),
        {},
        (Goal(700.0, None, "rate"),),
    ),
    Row(
        "burst",
        "socket to file, fused, without a loss",
        "frames/s",
        Task("burst", 8, "per_s", True),
        {"python-can reads": Task("burst_peer", 8, "per_s")},
        (Goal(200_000.0, None, "rate"),),
    ),
    Row(
        "slcan",
        "CPU per frame of an slcan adapter",
        "us",
        Task("slcan", 8, "us"),
        {"python-can": Task("slcan_peer", 8, "us")},
        (Goal(0.05, "python-can"),),
    ),
    Row(
        "nmea",
        "bytes on a pseudo-terminal to fixes, per sentence",
        "us",
        Task("nmea", 1, "us"),
        {"readline + pynmeagps": Task("nmea_peer", 1, "us", needs=("pynmeagps",))},
        (Goal(5.0), Goal(50.0, "readline + pynmeagps", "peer")),
    ),
    Row(
        "repair",
        "torn file made readable, per chunk",
        "us",
        Task("repair", 2, "us", True),
        {"mcap re-reads": Task("reread", 2, "us", True)},
        (Goal(60.0),),
    ),
    Row(
        "rts",
        "smoother, an hour x 3 axes, 250 Hz + 10 Hz",
        "s",
        Task("rts", 1, "s", needs=("edge_agent.review.smooth",)),
        {"filterpy": Task("filterpy_rts", 1, "s", needs=("filterpy",)), "plain floor": Task("floor_rts", 1, "s")},
        (Goal(0.5), Goal(1.2, "plain floor")),
    ),
)
IMPORTS = Task("imports", 1, "ms")
LIVE = {
    "live-2000": (8, "whole agent, 2000 frames/s + 10 Hz, 8 points, default settings"),
    "live-500": (2, "whole agent, 500 frames/s + 10 Hz, 2 points"),
}
BUSY = "this machine stood still too often"
REVIEW = "review"
NAMES = (*LIVE, *(r.name for r in ROWS), REVIEW)
SHORT_S, LONG_S, DAY_S = 600, 1800, 86_400
"""A review has work that does not grow with the record; what an hour adds is the difference of these two."""


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Bench:
    """Runs tasks in a folder of its own; `env` names the checkout whose agent they use."""

    def __init__(self, folder: Path, env: dict[str, str]) -> None:
        self.folder, self.env = folder, env
        self.live: dict[str, whole_agent.Live] = {}
        self.imports: list[dict[str, float]] = []

    def data(self, points: int) -> Path:
        return scene.prepare(self.folder / "data", points)

    def figure(self, task: Task, env: dict[str, str] | None = None) -> float:
        return self.run(task, env)[task.key]

    def run(self, task: Task, env: dict[str, str] | None = None) -> dict[str, float]:
        arguments = [task.name, str(self.data(task.points)), *([str(self.folder)] if task.writes else [])]
        return whole_agent.figures_of(arguments, env or self.env)


def lacking(task: Task) -> str:
    """Why a task cannot run here; empty when it can."""
    missing = [n for n in task.needs if not there(n)]
    return f"there is no {', '.join(missing)} (make bench installs the peers)" if missing else ""


def there(module: str) -> bool:
    """Whether a module can be imported."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # nor what it is a part of
        return False


def measure(bench: Bench, row: Row, rounds: int) -> Result:
    """All rounds of a row; ours and the peers in turn."""
    result = Result(row.name, row.unit, row.goals, reason=lacking(row.task))
    if result.reason:
        return result
    peers = {}
    for name, task in row.peers.items():
        why = lacking(task)
        if why:
            result.without[name] = why
        else:
            peers[name] = task
            result.peers[name] = []
    for i in range(rounds):
        order: list[str | None] = [None, *peers]
        for name in order if i % 2 == 0 else reversed(order):
            if name is None:
                result.figures.append(bench.figure(row.task))
            else:
                result.peers[name].append(bench.figure(peers[name]))
    return result


def measure_live(bench: Bench, name: str, rounds: int) -> list[Result]:
    """One run of the agent gives several rows: windows side by side with the Notifier, memory, start, bytes, age."""
    points, _ = LIVE[name]
    run = whole_agent.measure(points, bench.data(points), bench.folder / name, bench.env, windows=rounds)
    for note in run.notes:
        say(f"{name}: {note}")
    alone = [bench.run(IMPORTS) for _ in range(rounds)]
    found = [
        Result(
            name,
            "% of a core",
            (Goal(0.35, "Notifier"),),
            run.agent_percent,
            {"Notifier": run.notifier_percent},
        ),
        Result(
            f"memory-{points}",
            "MiB",
            (Goal(75.0 if points == 8 else 60.0),),
            [run.rss_mib],
            {"imports": [figures.median([a["mib"] for a in alone])]},
        ),
    ]
    if points == 8:
        found += [
            Result("age p99", "ms", (Goal(150.0),), [run.p99_ms] if run.share >= 0.5 else [], reason=BUSY),
            Result(
                "ready",
                "ms CPU",
                (Goal(2.5, "imports"),),
                [run.ready_ms],
                {"imports": [figures.median([a["ms"] for a in alone])]},
            ),
            Result("bytes raw", "B/frame", (Goal(5.8),), [run.raw_bytes]),
            Result("bytes all", "B/frame", (Goal(48.0),), [run.all_bytes]),
        ]
    return found


def measure_review(bench: Bench, day: str | None) -> list[Result]:
    """A day of 8 sensors at 250 Hz and 10 Hz fixes, reviewed: minutes by the clock and of processors, memory. `day`:
    that day itself, in this folder ("": recorded first, in two halves side by side, half an hour on two cores); None:
    from two short records."""
    import day as days

    def review(folder: Path) -> dict[str, float]:
        say(f"review: reading {sum(1 for _ in folder.iterdir())} files")
        out = bench.folder / "report.html"
        return whole_agent.figures_of(["review", "-", str(folder), str(out)], bench.env, 7200)

    def run(seconds: int) -> dict[str, float]:
        say(f"review: recording {seconds / 3600:.2f} h")
        return review(days.record(bench.folder / f"review-{seconds}", seconds))

    if day is not None:
        if not day:
            say("review: recording 24 h")
        found = review(Path(day) if day else days.whole_day(bench.folder / "day"))
        wall, cpu = found["wall"], found["cpu"]
    else:
        short, found = run(SHORT_S), run(LONG_S)
        more = (DAY_S - LONG_S) / (LONG_S - SHORT_S)
        wall, cpu = (found[k] + more * (found[k] - short[k]) for k in ("wall", "cpu"))
    how = ", by two short ones" if day is None else ""
    return [
        Result(f"review of a day{how}", "min", (Goal(10.0),), [wall / 60]),
        Result(f"review of a day, CPU{how}", "min", (), [cpu / 60]),
        Result("review, memory", "MiB", (Goal(600.0),), [found["mib"]]),
    ]


def chosen(text: str) -> list[str]:
    """Names of rows by their name or its first part; ValueError for one that is none."""
    wanted = [w.strip() for w in text.split(",") if w.strip()]
    for w in wanted:
        if not any(n == w or n.split("-")[0] == w for n in NAMES):
            raise ValueError(f"no row {w!r}; there are: {', '.join(NAMES)}")
    return [n for n in NAMES if not wanted or n in wanted or n.split("-")[0] in wanted]


def this(bench: Bench, names: Sequence[str], rounds: int, day: str | None = None) -> tuple[list[Result], list[str]]:
    """Every chosen row: results, and the rows that failed with their reason."""
    results: list[Result] = []
    failed: list[str] = []
    for name in names:
        begin = time.monotonic()
        try:
            if name in LIVE:
                results += measure_live(bench, name, rounds)
            elif name == REVIEW:
                results += measure_review(bench, day)
            else:
                row = next(r for r in ROWS if r.name == name)
                results.append(measure(bench, row, rounds))
        except (RuntimeError, subprocess.TimeoutExpired) as e:
            failed.append(f"{name}: {e}")
        say(f"{name}: {time.monotonic() - begin:.0f} s")
    return results, failed


def compare(bench: Bench, other: dict[str, str], names: Sequence[str], rounds: int) -> tuple[str, list[str]]:
    """Both checkouts in turn, other first: a table of new / old, and the rows that failed."""
    lines: list[tuple[str, ...]] = [("row", "unit", "old", "new", "new / old", "of each pair")]
    failed: list[str] = []
    for name in names:
        try:
            if name == REVIEW:
                raise RuntimeError("is not compared; run it in both checkouts")
            if name in LIVE:
                points, _ = LIVE[name]
                pair: dict[str, list[float]] = {"old": [], "new": []}
                for i in range(rounds):
                    for which, env in (("old", other), ("new", bench.env)):
                        place = bench.folder / f"{name}-{which}-{i}"
                        run = whole_agent.measure(points, bench.data(points), place, env, windows=1)
                        pair[which] += run.agent_percent
                lines.append(figures.comparison(name, "% of a core", pair["old"], pair["new"]))
            else:
                row = next(r for r in ROWS if r.name == name)
                old, new = [], []
                for _ in range(rounds):
                    old.append(bench.figure(row.task, other))
                    new.append(bench.figure(row.task))
                lines.append(figures.comparison(name, row.unit, old, new))
        except (RuntimeError, subprocess.TimeoutExpired) as e:
            failed.append(f"{name}: {e}")
        say(f"{name}: done")
    return figures.columns(lines), failed


@contextlib.contextmanager
def checkout(commit: str, folder: Path) -> Iterator[Path]:
    """A commit's files beside the repository's, taken away again. ValueError for one that does not exist."""
    place = folder / "checkout"
    command = ["git", "-C", str(ROOT), "worktree", "add", "--detach", "--quiet", str(place), commit]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ValueError(f"git worktree {commit}: {done.stderr.strip()}")
    try:
        yield place
    finally:
        remove = ["git", "-C", str(ROOT), "worktree", "remove", "--force", str(place)]
        subprocess.run(remove, capture_output=True, check=False)


def environment(root: Path) -> dict[str, str]:
    """Whose `edge_agent` and `drivers` a task imports; one thread, so that CPU time is time."""
    return os.environ | {"PYTHONPATH": str(root), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--rows", default="", help=f"comma-separated: {', '.join(NAMES)}")
    parser.add_argument("--rounds", type=int, default=3, help="runs of each figure, at least 1 (default 3)")
    parser.add_argument("--compare", metavar="COMMIT", help="measure this commit's code in turn with the present one")
    parser.add_argument(
        "--day",
        nargs="?",
        const="",
        metavar="FOLDER",
        help="review: a whole day, that of this folder, or recorded first (half an hour on two cores)",
    )
    parser.add_argument("--json", action="store_true", help="results as JSON")
    parser.add_argument("--strict", action="store_true", help="exit code 1 when a goal is missed")
    args = parser.parse_args(arguments)
    if args.rounds < 1:
        parser.error("--rounds must be at least 1")
    try:
        names = chosen(args.rows)
    except ValueError as e:
        parser.error(str(e))
    with tempfile.TemporaryDirectory(prefix="bench-") as temporary:
        folder = Path(temporary)
        bench = Bench(folder, environment(ROOT))
        if args.compare:
            if not args.rows:
                names = [n for n in names if n not in (*LIVE, REVIEW)]
                say(f"without {', '.join(LIVE)}: name them in --rows, each pair takes two minutes")
            try:
                with checkout(args.compare, folder) as place:
                    text, failed = compare(bench, environment(place), names, args.rounds)
            except ValueError as e:
                parser.error(str(e))
            print(text)
        else:
            results, failed = this(bench, names, args.rounds, args.day)
            missed = figures.misses(results)
            if args.json:
                print(json.dumps({"rows": figures.as_json(results), "missed": missed, "failed": failed}, indent=2))
            else:
                print(figures.table(results))
                print("\nmissed:" if missed else "\nall goals met", *missed, sep="\n  ")
            if args.strict and missed:
                failed = failed or ["--strict: goals are missed"]
    for line in failed:
        say(f"FAILED {line}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
