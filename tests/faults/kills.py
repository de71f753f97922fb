"""Kills a live agent at random instants under load: `python tests/faults/kills.py [N] [SEED]`, 20 kills by default.

The agent is the real one in its own process, on a pseudo-terminal that plays the receiver and on an slcan adapter on
another; it rotates every few seconds, so that kills also fall on rotations. Each next start recovers what the kill
left. Then:

- each file that a kill left torn is read by rosbags and has nothing for pymcap-cli's doctor to say;
- lost = time of the kill - newest raw stamp in the files of that run <= flush_s + block_ms + 0.2 s. The machine itself
  may be late (other programs): how late the player was and how long the agent's threads waited for a processor in the
  last 2 s is measured, stands in the table, and is allowed for;
- `verify` finds the chain in order, and one gap with reason "kill" for each kill;
- `replay --verify` holds for each torn file alone and for all files together.

Prints a row per kill and the figures. Exit code 1 where something does not hold.
"""

from __future__ import annotations

import contextlib
import json
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from edge_agent.messages import MS, S
from edge_agent.recording import reader, topics
from edge_agent.recording.repair import REPAIRED_METADATA
from edge_agent.replay import ReplayError, replay
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import Wiring, config_yaml, dbc_text
from edge_agent.simulate.play import Sink, Slcan, Terminal, can_schedule, play, serial_schedule, wait_ready
from edge_agent.simulate.specs import START_NS
from edge_agent.verify import verify

SCENARIO = SCENARIOS["clean"]
FLUSH_S, BLOCK_S, SLACK_S = 1.0, 0.1, 0.2  # the defaults of the product, and the allowance of the promise
ROTATE_S = 3
PATIENCE_S = 60.0
LIFE_S = 5.0  # a kill comes at a random instant of so long after the first file


class Watched(Terminal):
    """An adapter that notes when it sent last and the longest wait between two sends of late."""

    def __init__(self) -> None:
        super().__init__(Slcan())
        self.last_ns = 0
        self.waits: list[tuple[int, int]] = []  # time, wait before it, of those above 30 ms

    def send(self, data: bytes) -> None:
        now = time.monotonic_ns()
        if self.last_ns and now - self.last_ns > 30 * MS:
            self.waits.append((now, now - self.last_ns))
        self.last_ns = now
        super().send(data)

    def late_ns(self, at_ns: int) -> int:
        """The longest wait of the 2 s before an instant, in which a frame was due every 10 ms."""
        return max((w for t, w in self.waits if t > at_ns - 2 * S), default=0) + max(0, at_ns - self.last_ns - 30 * MS)


class Site:
    """A folder with a configuration, and the two devices."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.rec = folder, folder / "rec"
        self.serial, self.can = Terminal(), Watched()
        self.begun_ns = 0  # when the player of the latest run began
        (folder / "a.dbc").write_text(dbc_text(SCENARIO))
        wiring = Wiring(self.serial.path, "slcan", self.can.path)
        text = config_yaml(SCENARIO, dbc="a.dbc", site="site", data_dir="rec", wiring=wiring)
        record = f"record: {{free_gb: 0, flush_s: {FLUSH_S}, rotate_s: {ROTATE_S}}}\n"
        (folder / "site.yaml").write_text(text + record)

    def start(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "edge_agent", "run", "-c", str(self.folder / "site.yaml")]
        with (self.folder / "agent.log").open("ab") as log:
            return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def play(self, agent: subprocess.Popen[bytes], seed: int, ended: threading.Event) -> None:
        sinks: list[Sink] = [self.serial, self.can]
        record = simulate("clean", seed, 30.0, (time.time_ns() // S + 2) * S)
        schedules = [(self.serial, serial_schedule(record)), (self.can, can_schedule(record, self.can))]
        if wait_ready(sinks, PATIENCE_S, lambda: agent.poll() is None and not ended.is_set()):
            self.can.last_ns, self.can.waits = 0, []
            self.begun_ns = time.monotonic_ns()
            play(schedules, time.monotonic_ns() - START_NS, stop=ended)


def names(folder: Path) -> set[str]:
    return {p.name.removesuffix(".part") for p in folder.iterdir() if ".mcap" in p.name} if folder.exists() else set()


def starved_ns(pid: int) -> int:
    """How long the threads of a process have been ready to run while the processors did something else."""
    total = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):  # a thread that has just ended
            total += int(path.read_text().split()[1])
    return total


def newest_ns(files: list[Path]) -> int:
    """The newest raw stamp (monotonic) of files; that of a checkpoint where there is none."""
    newest = 0
    for path in files:
        for s in reader.read_messages(path):
            if s.topic == topics.CHECKPOINT_TOPIC:
                newest = max(newest, topics.decode_checkpoint(s.data).monotonic_ns)
            elif s.topic.startswith(topics.RAW_PREFIX):
                newest = max(newest, topics.decode_raw(s.topic, s.schema, s.data).t_ns)
    return newest


def first_file(site: Site, agent: subprocess.Popen[bytes], before: set[str]) -> None:
    """Wait until a run has begun its first file."""
    end = time.monotonic() + PATIENCE_S
    while not names(site.rec) - before:
        if agent.poll() is not None or time.monotonic() > end:
            log = (site.folder / "agent.log").read_text()[-2000:]
            raise SystemExit(f"no file after {PATIENCE_S:g} s; log: {log}")
        time.sleep(0.02)


def one_kill(site: Site, seed: int, rng: random.Random) -> dict[str, float]:
    """Start, play, kill. What was lost, in seconds; which file was torn stands in the folder."""
    before = names(site.rec)
    agent, ended = site.start(), threading.Event()
    player = threading.Thread(target=site.play, args=(agent, seed, ended))
    player.start()
    try:
        first_file(site, agent, before)
        first_s = time.monotonic()
        end = time.monotonic() + rng.uniform(0.0, LIFE_S)
        waits: deque[tuple[float, int]] = deque([(time.monotonic(), starved_ns(agent.pid))], maxlen=40)
        while (left := end - time.monotonic()) > 0:
            time.sleep(min(left, 0.05))
            waits.append((time.monotonic(), starved_ns(agent.pid)))
        killed_ns = time.monotonic_ns()
        agent.send_signal(signal.SIGKILL)
        agent.wait()
        dead_ns = time.monotonic_ns()
    finally:
        ended.set()
        if agent.poll() is None:
            agent.kill()
            agent.wait()
        player.join()
    new = names(site.rec) - before
    files = [p for p in site.rec.iterdir() if p.name.removesuffix(".part") in new]
    starved = waits[-1][1] - next(w for t, w in waits if t > waits[-1][0] - 2.0)
    late = (site.can.late_ns(killed_ns) + starved) / S
    newest = newest_ns([p for p in files if p.stat().st_size])  # 0 where the kill came before the first file's head
    lost = (killed_ns - (newest or site.begun_ns)) / S
    return {
        "empty": not newest,
        "alive": killed_ns / S - first_s,
        "files": len(new),
        "lost": lost,
        "late": late,
        "dying": (dead_ns - killed_ns) / S,
    }


def doctor(path: Path) -> str:
    """What pymcap-cli's doctor finds; "" = nothing."""
    tool = Path(sys.executable).with_name("pymcap-cli")
    command = [tool, "doctor", "--strict-message-order", "--format", "jsonl", path]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    *findings, summary = (json.loads(line) for line in done.stdout.splitlines())
    return "" if (summary["errors"], summary["warnings"]) == (0, 0) else f"{findings[:3]}"


def judge(rec: Path, ends: int, reason: str = "kill") -> list[str]:
    """What does not hold of the files of runs that came to such an end, after the last recovery."""
    wrong = []
    files = sorted(rec.glob("*.mcap*"))
    torn = [p for p in files if REPAIRED_METADATA in reader.read_metadata(p)]
    said = 0
    for path in torn:
        if found := doctor(path):
            wrong.append(f"{path.name}: doctor: {found}")
        with AnyReader([path]) as bag:
            there = sum(1 for _ in bag.messages())
        mine = sum(1 for _ in reader.read_messages(path))
        if there != mine:
            wrong.append(f"{path.name}: rosbags reads {there} of {mine} messages")
        try:
            report = replay([path], None, None, True)
        except ReplayError:
            continue  # killed before its first message
        said += report.compared
        if not report.ok:
            wrong.append(f"{path.name}: {report}")
    everything = replay([rec], None, None, True)
    if not everything.ok:
        wrong.append(f"all files: {everything}")
    verdict = verify([rec])
    wrong += [f"verify: {w}" for w in verdict.wanting]
    reasons = [g.reason for g in verdict.gaps if g.source == "all"]
    if reasons.count(reason) != ends or set(reasons) - {reason}:
        wrong.append(f"verify: {ends} times {reason}, but the gaps are {dict(Counter(reasons))}")
    print(
        f"{len(files)} files, {len(torn)} of them torn and repaired, {len(names(rec)) - len(files)} left over; ",
        end="",
    )
    print(f"replay: {said} derived records equal in the torn files, {everything.compared} in all")
    return wrong


def main(argv: list[str]) -> int:
    kills, seed = (int(x) for x in (*argv, *("20", "1")[len(argv) :]))
    rng = random.Random(seed)
    bound = FLUSH_S + BLOCK_S + SLACK_S
    wrong: list[str] = []
    rows: list[dict[str, float]] = []
    with tempfile.TemporaryDirectory() as name:
        site = Site(Path(name))
        print(" kill  alive [s]  files  lost [s]  late [s]")
        for i in range(kills):
            row = one_kill(site, seed * 1000 + i, rng)
            rows.append(row)
            bad = row["lost"] > bound + row["late"]
            print(
                f"{i + 1:5d}  {row['alive']:9.3f}  {row['files']:5.0f}  {row['lost']:8.3f}  {row['late']:8.3f}", end=""
            )
            print("  TOO MUCH" if bad else "", flush=True)
            if bad:
                wrong.append(
                    f"kill {i + 1}: {row['lost']:.3f} s lost, {bound:g} s allowed, the machine {row['late']:.3f} s late"
                )
        agent, ended = site.start(), threading.Event()  # recovers what the last kill left, and ends in order
        player = threading.Thread(target=site.play, args=(agent, seed, ended))
        player.start()
        first_file(site, agent, names(site.rec))
        time.sleep(1.0)
        agent.send_signal(signal.SIGTERM)
        if agent.wait(PATIENCE_S) != 0:
            wrong.append("the last run did not end in order")
        ended.set()
        player.join()
        wrong += judge(site.rec, kills - sum(bool(r["empty"]) for r in rows))  # no gap of its own: nothing lies between
        site.serial.close()
        site.can.close()
    lost = np.array([r["lost"] for r in rows])
    within = int((lost <= bound).sum())
    middle, most = np.quantile(lost, (0.5, 0.95))
    print(f"lost in {kills} kills: median {middle:.3f} s, 95 % {most:.3f} s, largest {lost.max():.3f} s")
    allowed = kills - sum(w.startswith("kill ") for w in wrong)
    print(f"bound {bound:g} s: held in {within}; with the lateness of the machine allowed for, in {allowed} of {kills}")
    for w in wrong:
        print(f"WRONG: {w}")
    print("kill-test: " + ("NOT good" if wrong else "good"))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
