"""Our recordings before readers that nobody here wrote: `rerun mcap check`, and @mcap/core with rosmsg2-serialization.

    python tests/judges/run.py [FILE.mcap ...]

Judges a recording of every topic, written here with the agent's own writer, the same recording after repair, and any
FILE. rerun-sdk comes from the extra `judges`; the npm packages are installed beside the virtual environment. A judge
that cannot run on this machine is skipped and says why. Exit code 1 when something failed. The last line is
"N passed, N failed".
"""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "recording"))

from all_topics import records  # noqa: E402 - shared with tests/recording

from edge_agent.messages import S  # noqa: E402
from edge_agent.recording import reader, repair, topics  # noqa: E402
from edge_agent.recording.writer import SegmentWriter  # noqa: E402

CACHE = Path(sys.prefix)
NODE = CACHE / "judges-node"
LIMIT_S = 3600.0  # of one program; none takes a minute where nothing else runs


class Tally:
    passed = failed = 0

    def say(self, good: bool, what: str, why: str = "") -> None:
        self.passed += good
        self.failed += not good
        print(f"{'pass' if good else 'FAIL'}  {what}{': ' + why if why else ''}", flush=True)


def sample(folder: Path) -> Path:
    """A recording of every topic in several chunks."""
    part = folder / "every_topic.mcap.part"
    writer = SegmentWriter(part, metadata={"run": "judges"}, attachments={"config.yaml": b"site: judges\n"})
    for i, record in enumerate(records(blocks=40)):
        writer.add(record)
        if i % 150 == 0:
            writer.flush()
    return writer.close()


def repaired(path: Path, folder: Path) -> Path:
    """The same, torn in its last chunk and repaired."""
    with reader.view(path) as buffer:
        last = [part for part in reader.parts(buffer) if part.opcode == reader.CHUNK][-1]
    part = folder / "repaired.mcap.part"
    part.write_bytes(path.read_bytes()[: last.pos + last.length // 2])
    return repair.repair(part).path


def disordered(path: Path, folder: Path) -> Path:
    """A file whose log times go back and whose publish times do not: a judge that is awake has something to say."""
    part = folder / "disordered.mcap.part"
    writer = SegmentWriter(part, metadata={}, attachments={})
    stored = [s for s in reader.read_messages(path) if s.topic == "/raw/can0"]
    first = next(iter(records(blocks=1)))
    for i, s in enumerate(stored):
        writer.add(
            replace(
                first, topic=s.topic, log_ns=s.log_ns - i % 7 * S, publish_ns=s.publish_ns, data=s.data, schema=s.schema
            )
        )
    return writer.close()


def flipped(path: Path, folder: Path) -> Path:
    """A file with one bad bit in a chunk."""
    with reader.view(path) as buffer:
        chunk = [part for part in reader.parts(buffer) if part.opcode == reader.CHUNK][-1]
    data = bytearray(path.read_bytes())
    data[chunk.pos + chunk.length // 2] ^= 0x10
    out = folder / "flipped.mcap"
    out.write_bytes(data)
    return out


# --------------------------------------------------------------------------------------------------------------- rerun


def rerun_tool() -> tuple[Path | None, str]:
    tool = Path(sys.executable).with_name("rerun")
    if not tool.exists():
        return None, "rerun-sdk is not installed (extra `judges`)"
    return tool, ""


def rerun_says(tool: Path, path: Path) -> str:
    """What `rerun mcap check --full` has against a file; "" = nothing. Its exit code stays 0 for problems."""
    home = CACHE / "judges-home"  # keeps its settings, and the refusal of analytics, out of the user's home
    home.mkdir(exist_ok=True)
    environment = {**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": str(home / ".config"), "NO_COLOR": "1"}
    subprocess.run([tool, "analytics", "disable"], env=environment, capture_output=True, timeout=LIMIT_S, check=False)
    command = [tool, "mcap", "check", "--full", path]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    lines = (done.stdout + done.stderr).splitlines()
    bad = [line.strip() for line in lines if any(word in line for word in ("PROBLEM", "ERROR", "WARN", "Error"))]
    if done.returncode:
        bad.append(f"exit code {done.returncode}")
    if not bad and not any(line.startswith("ok") for line in lines):
        bad.append("no topic was checked")
    return "; ".join(bad)


# ----------------------------------------------------------------------------------------------------------------- npm


def node_tool() -> tuple[str | None, str]:
    """Path of node, or why there is none. Installs what package.json names."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        return None, "node and npm are not installed"
    wanted = (HERE / "package.json").read_bytes()
    NODE.mkdir(exist_ok=True)
    mark = NODE / "installed.json"
    if not mark.exists() or mark.read_bytes() != wanted:
        (NODE / "package.json").write_bytes(wanted)
        command = [npm, "install", "--no-audit", "--no-fund", "--silent"]
        for _ in range(3):  # a network that is not there for a moment is nobody's fault
            done = subprocess.run(command, cwd=NODE, capture_output=True, text=True, timeout=LIMIT_S, check=False)
            if not done.returncode:
                break
        else:
            return None, f"npm cannot install it: {(done.stderr or done.stdout).strip()[-300:]}"
        mark.write_bytes(wanted)
    return node, ""


def read_by_node(node: str, path: Path) -> Iterator[dict[str, Any]]:
    environment = {**os.environ, "NODE_PATH": str(NODE / "node_modules")}
    command = [node, str(HERE / "read.cjs"), str(path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    if done.returncode:
        raise ValueError(done.stderr.strip()[-300:])
    for line in done.stdout.splitlines():
        yield json.loads(line)


def plain(value: Any) -> Any:
    """Our values and theirs as the same JSON: their times call the nanoseconds `nsec`; NaN equals NaN."""
    if isinstance(value, dict):
        return {"nanosec" if k == "nsec" else k: plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list):
        return [plain(v) for v in value]
    return "nan" if isinstance(value, float) and math.isnan(value) else value


def node_says(node: str, path: Path) -> str:
    """How the values that @mcap/core and rosmsg2-serialization read differ from ours; "" = not at all."""
    ours = [
        {"topic": s.topic, "logTime": s.log_ns, "publishTime": s.publish_ns, "sequence": s.sequence}
        | {"data": plain(topics.decode(s.schema, s.data))}
        for s in reader.read_messages(path)
    ]
    try:
        theirs = [plain(message) for message in read_by_node(node, path)]
    except ValueError as e:
        return str(e)

    def place(message: dict[str, Any]) -> tuple[Any, ...]:
        return message["logTime"], message["topic"], message["sequence"]  # theirs come by log time

    ours.sort(key=place)
    theirs.sort(key=place)
    if len(ours) != len(theirs):
        return f"{len(theirs)} messages instead of {len(ours)}"
    for mine, other in zip(ours, theirs, strict=True):
        if mine != other:
            return f"{mine['topic']} at {mine['logTime']}: {other} instead of {mine}"[:600]
    return ""


def main(arguments: list[str]) -> int:
    tally = Tally()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole = sample(folder)
        files = [whole, repaired(whole, folder), *(Path(argument) for argument in arguments)]
        tool, why = rerun_tool()
        if tool is None:
            print(f"skip  rerun mcap check: {why}")
        else:
            for path in files:
                words = rerun_says(tool, path)
                tally.say(not words, f"rerun mcap check {path.name}", words)
            for path in (disordered(whole, folder), flipped(whole, folder)):
                tally.say(bool(rerun_says(tool, path)), f"rerun mcap check objects to {path.name}")
        node, why = node_tool()
        if node is None:
            print(f"skip  @mcap/core and rosmsg2-serialization: {why}")
        else:
            for path in files:
                words = node_says(node, path)
                tally.say(not words, f"@mcap/core and rosmsg2-serialization read our values of {path.name}", words)
            tally.say(_refused(node, flipped(whole, folder)), "@mcap/core objects to flipped.mcap")
    print(f"{tally.passed} passed, {tally.failed} failed")
    return 1 if tally.failed else 0


def _refused(node: str, path: Path) -> bool:
    try:
        list(read_by_node(node, path))
    except ValueError:
        return True
    return False


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
