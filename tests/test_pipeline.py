"""The data path as a whole: cuts, checkpoints, clocks, and what the records say."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_agent import assemble, config
from edge_agent.geodesy import Frame
from edge_agent.messages import CanFrames, Config, FusionFlag, Raw, Record, S, Tick
from edge_agent.pipeline import Pipeline
from edge_agent.recording import topics
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import config_yaml, dbc_text, raw_blocks

DBC = "sensor.dbc"


def made(scenario: str, seed: int, seconds: float) -> tuple[Config, list[Raw]]:
    record = simulate(scenario, seed, seconds)
    text = config_yaml(SCENARIOS[scenario], dbc=DBC, site="test")
    settings = config.parse(text, Path(), lambda name: dbc_text(SCENARIOS[scenario]).encode())
    return settings, list(raw_blocks(record))


@pytest.fixture(scope="module")
def hostile() -> tuple[Config, list[Raw]]:
    return made("hostile", 3, 100.0)


def steps(pipeline: Pipeline, raws: list[Raw]) -> list[Record]:
    return [r for raw in raws for r in pipeline.step(raw)]


def derived(records: list[Record]) -> list[tuple[str, int, int, bytes]]:
    return [(r.topic, r.log_ns, r.publish_ns, r.data) for r in records if r.derived]


def renumbered(raws: list[Raw]) -> list[Raw]:
    return [replace(raw, order=i) for i, raw in enumerate(raws)]


def test_each_raw_comes_first_and_nothing_steps_back(hostile: tuple[Config, list[Raw]]) -> None:
    settings, raws = hostile
    pipeline = assemble.pipeline(settings)
    log, published = 0, {}
    for raw in raws:
        records = pipeline.step(raw)
        assert not records[0].derived
        assert topics.decode_raw(records[0].topic, records[0].schema, records[0].data).order == raw.order
        for r in records:
            assert r.log_ns >= log
            assert r.publish_ns <= r.log_ns
            assert r.publish_ns >= published.get(r.topic, 0)
            log, published[r.topic] = r.log_ns, r.publish_ns
    kinds = {t.rsplit("/", 1)[1] for t in published}
    assert {"fix", "solution", "block", "state", "update", "events", "can", "gnss", "clock"} <= kinds


def test_any_cut_of_the_serial_bytes_gives_the_same_derived_bytes(hostile: tuple[Config, list[Raw]]) -> None:
    settings, raws = hostile
    want = derived(steps(assemble.pipeline(settings), raws))
    rng = random.Random(5)
    for _ in range(3):
        cut: list[Raw] = []
        for raw in raws:
            data = raw.payload
            if isinstance(data, bytes):
                while len(data) > 1 and rng.random() < 0.7:
                    n = rng.randrange(1, len(data))
                    cut.append(replace(raw, payload=data[:n]))
                    data = data[n:]
                raw = replace(raw, payload=data)
            cut.append(raw)
        assert len(cut) > len(raws) + 500
        assert derived(steps(assemble.pipeline(settings), renumbered(cut))) == want


@pytest.mark.parametrize("seed", range(4))
def test_load_at_a_checkpoint_goes_on_byte_for_byte(hostile: tuple[Config, list[Raw]], seed: int) -> None:
    settings, raws = hostile
    at = random.Random(seed).randrange(50, len(raws) - 50)
    one = assemble.pipeline(settings)
    steps(one, raws[:at])
    point = one.rotate("test", raws[at].t_ns)
    state = topics.decode_checkpoint(point.checkpoint.data).state
    two = assemble.pipeline(settings)
    two.load(state)
    assert two.save() == state
    assert derived(steps(one, raws[at:])) == derived(steps(two, raws[at:]))
    assert one.save() == two.save()


def test_a_checkpoint_of_other_settings_or_with_damage_is_refused(hostile: tuple[Config, list[Raw]]) -> None:
    settings, raws = hostile
    pipeline = assemble.pipeline(settings)
    steps(pipeline, raws[:100])
    state = pipeline.save()
    other = replace(settings, fusion=replace(settings.fusion, gate_alpha=0.01))
    with pytest.raises(ValueError, match="other settings"):
        assemble.pipeline(other).load(state)
    with pytest.raises(ValueError):
        assemble.pipeline(settings).load(state[: len(state) // 2])


def test_a_stepped_wall_clock_asks_for_a_segment_and_leaves_the_estimate_alone(
    hostile: tuple[Config, list[Raw]],
) -> None:
    settings, raws = hostile
    calm = assemble.pipeline(settings)
    want = [b for t, _, _, b in derived(steps(calm, raws)) if t.endswith("/block")]
    pipeline = assemble.pipeline(settings)
    got, events, reasons = [], [], []
    for raw in raws:
        if isinstance(raw.payload, Tick) and raw.t_ns > raws[0].t_ns + 50 * S:
            raw = replace(raw, payload=Tick(raw.payload.utc_ns + 3600 * S, False, 0))
        if pipeline.rotate_due:
            reasons.append(pipeline.rotate_due)
            pipeline.rotate(pipeline.rotate_due, raw.t_ns)
        for r in pipeline.step(raw):
            if r.topic.endswith("/block"):
                got.append(topics.decode_fused_block("p", r.data))
            elif r.topic == "/events":
                events.append(topics.decode(topics.schema_of(r.topic), r.data))
    assert reasons == ["clock"]
    (step,) = [e for e in events if e["kind"] == "CLOCK_STEP"]
    assert "+3600.000 s" in step["text"]
    plain = [topics.decode_fused_block("p", b) for b in want]
    assert len(got) == len(plain)
    a = np.concatenate([e.displacement_m for e in got])
    b = np.concatenate([e.displacement_m for e in plain])
    assert np.abs(a - b).max() < 0.001  # the fixes' times come from the learned latency instead of the host's clock
    assert (np.diff(np.concatenate([e.t_ns for e in got])) > 0).all()


def test_an_unset_reference_is_the_median_of_the_start_and_outlives_a_reboot() -> None:
    scenario = SCENARIOS["clean"]
    record = simulate("clean", 2, 40.0)
    text = config_yaml(scenario, dbc=DBC, site="test")
    lines = [line for line in text.splitlines() if "reference_llh" not in line]
    settings = config.parse("\n".join(lines), Path(), lambda name: dbc_text(scenario).encode())
    assert settings.structure.reference_llh is None
    raws = list(raw_blocks(record))
    first = assemble.pipeline(settings)
    records = steps(first, raws)
    (receiver,) = first.receivers.values()
    assert receiver.reference is not None
    assert not receiver.provisional
    told = [topics.decode(topics.schema_of(r.topic), r.data) for r in records if r.topic == "/events"]
    (window,) = [e for e in told if e["kind"] == "REFERENCE"]
    begin, end = (window[k]["sec"] * S + window[k]["nanosec"] - record.utc_offset_ns for k in ("begin", "end"))
    assert 14.9 * S < end - begin < 15.1 * S
    z = record.fixes.z_m[(record.fixes.t_ns >= begin - 1_000_000) & (record.fixes.t_ns <= end + 1_000_000)]
    configured = config.parse(text, Path(), lambda name: dbc_text(scenario).encode()).structure.reference_llh
    assert configured is not None
    assert np.abs(np.array(Frame(configured).enu(*receiver.reference)) - np.median(z, axis=0)).max() < 2e-5
    blocks = [topics.decode_fused_block("p", r.data) for r in records if r.topic.endswith("/block")]
    assert np.abs(blocks[0].displacement_m[0]).max() < 0.05

    second = assemble.pipeline(settings)
    second.adopt(first.slow())
    again = steps(second, raws)
    told = [topics.decode(topics.schema_of(r.topic), r.data) for r in again if r.topic == "/events"]
    assert {"ADOPTED"} <= {e["kind"] for e in told}
    (adopted,) = second.receivers.values()
    assert adopted.reference == receiver.reference
    later = [topics.decode_fused_block("p", r.data) for r in again if r.topic.endswith("/block")]
    assert np.abs(later[-1].displacement_m[-1] - blocks[-1].displacement_m[-1]).max() < 0.004


def test_repeated_rejects_are_one_record_with_a_count(hostile: tuple[Config, list[Raw]]) -> None:
    settings, _ = hostile
    pipeline = assemble.pipeline(settings)
    bad = b"$GNGGA,1,2,3*00\r\n"
    (port,) = [p.name for p in settings.ports.values() if p.kind == "serial"]
    raws = [Raw(S + i * 100_000_000, i, port, bad) for i in range(25)]
    records = [r for r in steps(pipeline, raws) + pipeline.finish() if r.topic == "/events"]
    events = [topics.decode(topics.schema_of(r.topic), r.data) for r in records]
    assert {e["kind"] for e in events} == {"REJECT"}
    assert sum(v["value"] for e in events for v in e["values"] if v["name"] == "count") == 25
    assert len(events) <= 4
    assert "CHECKSUM" in events[0]["text"]


def test_frames_of_nobody_are_recorded_and_cause_nothing(hostile: tuple[Config, list[Raw]]) -> None:
    settings, _ = hostile
    (port,) = [p.name for p in settings.ports.values() if p.kind == "can"]
    frames = CanFrames(
        np.array([S]),
        np.array([0x7FF], np.uint32),
        np.zeros(1, np.uint8),
        np.array([8], np.uint8),
        np.zeros((1, 8), np.uint8),
    )
    records = assemble.pipeline(settings).step(Raw(S, 0, port, frames))
    assert [r.topic for r in records] == [f"/raw/{port}"]


@pytest.mark.parametrize("latency_ms", [None, 200.0])
def test_fix_times_that_rest_on_an_assumption_are_flagged(
    hostile: tuple[Config, list[Raw]], latency_ms: float | None
) -> None:
    """GIVEN a host clock that nothing disciplines WHEN the latency is not configured THEN the stream says so."""
    settings, raws = hostile
    receivers = {k: replace(r, latency_ms=latency_ms) for k, r in settings.receivers.items()}
    pipeline = assemble.pipeline(replace(settings, receivers=receivers))
    flags = set()
    for raw in raws[: len(raws) // 2]:
        if isinstance(raw.payload, Tick):
            raw = replace(raw, payload=replace(raw.payload, sync=False))
        for r in pipeline.step(raw):
            if r.topic.endswith("/block"):
                flags |= {int(f) & FusionFlag.TIME_UNCERTAIN for f in topics.decode_fused_block("p", r.data).flags}
    assert flags == ({FusionFlag.TIME_UNCERTAIN} if latency_ms is None else {0})
