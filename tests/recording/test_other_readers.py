"""Our files before readers and judges that nobody here wrote: rosbags and pymcap-cli's doctor."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from all_topics import OFFSET_NS, checkpoint, records
from rosbags.highlevel import AnyReader
from test_topics import plain

from edge_agent.messages import RecordSettings, Rotate, S
from edge_agent.recording import reader, topics
from edge_agent.recording.repair import recover
from edge_agent.recording.segments import Recorder
from edge_agent.recording.writer import SegmentWriter


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every topic, five chunks."""
    part = tmp_path_factory.mktemp("readers") / "station_20231114T221320Z_000.mcap.part"
    writer = SegmentWriter(part, metadata={"run": "r"}, attachments={"config.yaml": b"site: x", "a.dbc": b"VERSION"})
    for i, record in enumerate(records()):
        writer.add(record)
        if i % 150 == 0:
            writer.flush()
    return writer.close()


@pytest.fixture(scope="module")
def repaired(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same file, once torn in its last chunk and once with a bad byte in its fourth, after repair."""
    folder = tmp_path_factory.mktemp("repaired")
    data = bytearray(recording.read_bytes())
    with reader.view(recording) as buffer:
        chunks = [part for part in reader.parts(buffer) if part.opcode == reader.CHUNK]
    (folder / "torn.mcap.part").write_bytes(data[: chunks[-1].pos + chunks[-1].length // 2])
    data[chunks[3].pos + chunks[3].length // 2] ^= 0x10
    (folder / "flipped.mcap.part").write_bytes(data)
    what = {r.path.name: r.what for r in recover(folder)}
    assert what == {"torn.mcap": "cut", "flipped.mcap": "copied"}
    return folder / "torn.mcap", folder / "flipped.mcap"


def read_by_rosbags(path: Path) -> list[tuple[str, int, Any]]:
    with AnyReader([path]) as bag:
        return [
            (connection.topic, log_ns, plain(bag.deserialize(data, connection.msgtype)))
            for connection, log_ns, data in bag.messages()
        ]


def read_by_us(path: Path) -> list[tuple[str, int, Any]]:
    return [(s.topic, s.log_ns, plain(topics.decode(s.schema, s.data))) for s in reader.read_messages(path)]


def test_rosbags_reads_every_topic_with_equal_values(recording: Path) -> None:
    theirs, ours = read_by_rosbags(recording), read_by_us(recording)
    assert len({topic for topic, _, _ in ours}) == 23
    assert {s.schema for s in reader.read_messages(recording)} == set(topics.SCHEMAS)
    key = lambda found: (found[1], found[0], json.dumps(found[2]))  # noqa: E731 - within one log time orders differ
    assert sorted(theirs, key=key) == sorted(ours, key=key)


def test_rosbags_reads_what_was_repaired(repaired: tuple[Path, Path]) -> None:
    for path in repaired:
        ours = read_by_us(path)
        assert Counter(topic for topic, _, _ in read_by_rosbags(path)) == Counter(topic for topic, _, _ in ours)
        assert len(ours) > 100


def doctor(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Summary and findings of `pymcap-cli doctor`; its exit code tells errors only, so warnings are counted here."""
    tool = Path(sys.executable).with_name("pymcap-cli")
    done = subprocess.run(
        [tool, "doctor", "--strict-message-order", "--format", "jsonl", path],
        capture_output=True,
        text=True,
    )
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == (1 if lines[-1]["errors"] else 0), done.stderr
    return lines[-1], lines[:-1]


def test_doctor_has_nothing_to_say(recording: Path, repaired: tuple[Path, Path]) -> None:
    for path in (recording, *repaired):
        summary, findings = doctor(path)
        assert (summary["errors"], summary["warnings"]) == (0, 0), findings
        assert summary["messages"] == len(list(reader.read_messages(path)))


def test_doctor_would_say_something(recording: Path, tmp_path: Path) -> None:
    """The judge is awake: a flipped byte is an error, a publish time after its log time a warning."""
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 0x10
    (tmp_path / "flipped.mcap").write_bytes(data)
    assert doctor(tmp_path / "flipped.mcap")[0]["errors"] > 0
    writer = SegmentWriter(tmp_path / "late.mcap.part", metadata={}, attachments={})
    first = next(records())
    writer.add(first.__class__(first.topic, first.log_ns, first.log_ns + 1, first.data, False))
    assert doctor(writer.close())[0]["warnings"] > 0


def test_doctor_and_rosbags_take_segments_of_a_recorder(tmp_path: Path) -> None:
    settings = RecordSettings(free_gb=0.0)
    recorder = Recorder(tmp_path, settings, "bridge", {"run": "r"}, {"config.yaml": b"x"}, lambda: 1 << 40)
    now = 0
    for i, record in enumerate(records(blocks=12)):
        if i % 100 == 0:
            at = record.log_ns
            recorder.handle(Rotate(checkpoint(at, i), at, "time"), now)
        if record.topic != topics.CHECKPOINT_TOPIC:
            recorder.handle(record, now)
        now += S // 10
        recorder.idle(now)
    recorder.close()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 2
    for path in files:
        summary, _ = doctor(path)
        assert (summary["errors"], summary["warnings"]) == (0, 0)
        assert len(read_by_rosbags(path)) == len(read_by_us(path))
    with AnyReader(files) as bag:  # rosbags joins the segments of a run
        assert bag.message_count == sum(len(read_by_us(path)) for path in files)
        assert bag.start_time >= 5_000 * S + OFFSET_NS


def test_plain_tells_values_apart() -> None:
    assert plain({"a": np.float32(0.1)}) != plain({"a": 0.1})
    assert plain([np.uint8(1), float("nan")]) == [1, "nan"]
