"""Several receivers, accelerometers and points: each recorded under its name, paired or not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from edge_agent import assemble, config
from edge_agent.messages import Mode, Raw, S
from edge_agent.recording import topics
from edge_agent.replay import close
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import config_yaml, dbc_text, raw_blocks

POINTS = """
points:
  fast: {receiver: rover, accelerometer: acc250}
  slow: {receiver: rover, accelerometer: acc50}
  mast: {receiver: second}
  pier: {accelerometer: acc250}
"""


def test_every_sensor_is_recorded_and_every_point_fused() -> None:
    """GIVEN two receivers, two accelerometers and four points WHEN they run THEN each point has its mode and those
    with both sensors agree with the truth."""
    scenario = SCENARIOS["P0"]
    record = simulate("P0", 1, 60.0)
    names = [a.name for a in scenario.accels]
    text = config_yaml(scenario, dbc="x.dbc", site="many").split("points:")[0]
    text = text.replace("  can:", "  gnss2: {kind: serial, device: /dev/ttyS2}\n  can:", 1)
    text = text.replace("accelerometers:", "  second: {port: gnss2}\naccelerometers:", 1)
    text += POINTS.replace("acc250", names[1]).replace("acc50", names[0])
    settings = config.parse(text, Path(), lambda name: dbc_text(scenario).encode())
    pipeline = assemble.pipeline(settings)
    blocks: dict[str, list] = {p: [] for p in settings.points}
    seen: set[str] = set()
    order = 0
    for raw in raw_blocks(record):
        twice = [raw, replace(raw, source="gnss2")] if raw.source == "gnss" else [raw]
        for one in twice:
            for r in pipeline.step(Raw(one.t_ns, order, one.source, one.payload)):
                seen.add(r.topic)
                if r.topic.endswith("/block"):
                    blocks[r.topic.split("/")[2]].append(topics.decode_fused_block("p", r.data))
            order += 1
    for sensor in ("rover", "second"):
        assert {f"/gnss/{sensor}/fix", f"/gnss/{sensor}/solution"} <= seen
    assert {f"/accel/{n}" for n in names} <= seen
    assert {"/raw/gnss", "/raw/gnss2", "/raw/can", "/raw/clock"} <= seen
    modes = {p: {int(m) for e in b for m in e.mode} for p, b in blocks.items()}
    assert modes["fast"] == modes["slow"] == {Mode.FUSED}
    assert modes["mast"] == {Mode.GNSS_ONLY}
    assert modes["pier"] == {Mode.ACCEL_ONLY}
    truth = record.truth
    for point in ("fast", "slow"):
        t = np.concatenate([e.t_ns for e in blocks[point]])
        d = np.concatenate([e.displacement_m for e in blocks[point]])
        late = t > record.fixes.t_ns[0] + 40 * S
        for axis in range(3):
            error = d[late, axis] - np.interp(t[late], truth.t_ns, truth.d_m[:, axis])
            assert np.sqrt(np.mean(error**2)) < (0.004, 0.004, 0.007)[axis]  # multipath 1.5/1.5/3 mm, 40 s, stays
    rates = {p: len(np.concatenate([e.t_ns for e in b])) for p, b in blocks.items()}
    assert rates["fast"] > 4 * rates["slow"] > 4 * rates["mast"]


def test_another_platform_may_differ_by_a_thousandth_of_the_sd() -> None:
    record = simulate("clean", 1, 20.0)
    scenario = SCENARIOS["clean"]
    settings = config.parse(
        config_yaml(scenario, dbc="x.dbc", site="t"), Path(), lambda name: dbc_text(scenario).encode()
    )
    pipeline = assemble.pipeline(settings)
    records = [r for raw in raw_blocks(record) for r in pipeline.step(raw)]
    block = next(r for r in records if r.topic.endswith("/block"))
    estimate = topics.decode_fused_block("p", block.data)
    sd = float(estimate.std_displacement_m.min())

    def moved(by: float) -> bytes:
        return topics.fused_block(replace(estimate, displacement_m=estimate.displacement_m + by), block.publish_ns)

    schema = topics.schema_of(block.topic)
    assert close(schema, moved(0.0), moved(0.5e-3 * sd))
    assert not close(schema, moved(0.0), moved(3e-3 * sd))
