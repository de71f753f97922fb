"""What the pipeline really records, before readers that nobody here wrote; and bad numbers that must not stop it."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from test_replay import record as write_run

from edge_agent import assemble, config
from edge_agent.messages import CanFrames, Config, Raw, S, Tick
from edge_agent.recording import topics
from edge_agent.recording.reader import read_messages
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import config_yaml, dbc_text, raw_blocks
from edge_agent.state import pack, unpack


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    scenario = SCENARIOS["hostile"]
    text = config_yaml(scenario, dbc="x.dbc", site="test")
    settings = config.parse(text, Path(), lambda name: dbc_text(scenario).encode())
    return write_run(tmp_path_factory.mktemp("run"), (settings, list(raw_blocks(simulate("hostile", 5, 45.0)))))


def test_doctor_has_nothing_to_say_of_a_run(run: list[Path]) -> None:
    tool = Path(sys.executable).parent / "pymcap-cli"
    for path in run:
        done = subprocess.run(
            [tool, "doctor", "--strict-message-order", "--format", "jsonl", path], capture_output=True, text=True
        )
        lines = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        assert done.returncode == 0, done.stdout
        assert not [x for x in lines if x.get("severity") in ("error", "warning")], done.stdout


def test_rosbags_reads_the_same_displacement(run: list[Path]) -> None:
    mine = [
        topics.decode_fused_block("p", s.data)
        for f in run
        for s in read_messages(f)
        if s.topic.startswith("/fusion/") and s.topic.endswith("/block")
    ]
    theirs = []
    for f in run:
        with AnyReader([f], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            chosen = [c for c in reader.connections if c.topic.startswith("/fusion/") and c.topic.endswith("/block")]
            found = reader.messages(chosen) if chosen else ()  # of no connections, rosbags gives all messages
            theirs += [reader.deserialize(raw, c.msgtype) for c, _, raw in found]
    assert len(mine) == len(theirs) > 200
    for a, b in zip(mine, theirs, strict=True):
        assert (a.displacement_m[:, 2].astype(np.float32) == b.displacement_z_m).all()
        assert (a.mode == b.mode).all()
        assert int(a.t_ns[0]) == b.monotonic_ns


YAML = """
site: bad
data_dir: x
structure: {reference_llh: [46.5, 7.5, 610.0]}
ports: {gnss: {kind: serial, device: /dev/null}, can: {kind: can}}
receivers: {rover: {port: gnss}}
accelerometers:
  acc:
    port: can
    fields: {x: {id: 1, start: 0, length: 32, float: true}, y: {id: 2, start: 0, length: 32, float: true},
             z: {id: 3, start: 0, length: 64, float: true}}
points: {p: {receiver: rover, accelerometer: acc}, only: {accelerometer: acc}}
"""


@pytest.fixture
def bad() -> Config:
    return config.parse(YAML, Path())


def frames(t_ns: int, x: float, y: float, z: float) -> CanFrames:
    data = np.zeros((3, 8), np.uint8)
    for i, packed in enumerate((struct.pack("<f", x), struct.pack("<f", y), struct.pack("<d", z))):
        data[i, : len(packed)] = np.frombuffer(packed, np.uint8)
    t = np.array([t_ns, t_ns + 1000, t_ns + 2000])
    return CanFrames(t, np.array([1, 2, 3], np.uint32), np.zeros(3, np.uint8), np.array([4, 4, 8], np.uint8), data, 0)


@pytest.mark.parametrize("value", [3e38, 1e300, -1e200, float("nan"), float("inf"), 1e5, -2e4])
def test_numbers_that_no_accelerometer_gives_are_refused_not_fatal(bad: Config, value: float) -> None:
    """GIVEN garbage at the first sample, in mid-stream and for seconds WHEN it passes THEN it is a REJECT, no crash."""
    pipeline = assemble.pipeline(bad)
    records = []
    order = 0
    for i in range(1500):
        t = S + i * 10_000_000
        spoilt = i == 0 or i % 97 == 0 or 700 < i < 800
        z = value if spoilt else 9.81
        x = min(max(value, -3e38), 3e38) if spoilt and np.isfinite(value) else 0.1
        records += pipeline.step(Raw(t, order, "can", frames(t, x, 0.2, z)))
        order += 1
        if i % 100 == 0:
            records += pipeline.step(Raw(t, order, "clock", Tick(t + 10**18, True, 0)))
            order += 1
    events = [topics.decode(topics.schema_of(r.topic), r.data) for r in records if r.topic == "/events"]
    assert {"RANGE", "NOT_FINITE"} & {e["text"].split(":")[0] for e in events if e["kind"] == "REJECT"}
    blocks = [topics.decode_fused_block("p", r.data) for r in records if r.topic == "/fusion/only/block"]
    assert blocks
    assert all(np.isfinite(b.displacement_m).all() and np.abs(b.displacement_m).max() < 1.0 for b in blocks)


def test_an_accelerometer_that_stops_before_it_began_is_no_crash(bad: Config) -> None:
    pipeline = assemble.pipeline(bad)
    for i, t in enumerate([*range(S, S + S // 2, S // 100), *range(12 * S, 20 * S, S // 100)]):
        pipeline.step(Raw(t, i, "can", frames(t, 0.1, 0.2, 9.81)))


@pytest.mark.parametrize("spoil", [{"station": [1]}, {"receivers": None}, {"receivers": {"rover": {}}}, {"axes": {}}])
def test_a_damaged_kept_state_is_a_value_error(bad: Config, spoil: dict) -> None:
    damaged = {**unpack(assemble.pipeline(bad).slow()), **spoil}
    pipeline = assemble.pipeline(bad)
    if "axes" in spoil:
        pipeline.adopt(pack(damaged))  # other axes: the slow state of the filter is left alone
        return
    with pytest.raises(ValueError, match="kept state"):
        pipeline.adopt(pack(damaged))


def test_order_of_points_is_part_of_a_checkpoint(bad: Config) -> None:
    state = assemble.pipeline(bad).save()
    other = replace(bad, points=dict(reversed(list(bad.points.items()))))
    with pytest.raises(ValueError, match="other settings"):
        assemble.pipeline(other).load(state)
