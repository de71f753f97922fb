"""A heading on its way: from the receiver's bytes to the topics of its points, into no position, and through replay."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from test_replay import record

from edge_agent import assemble, config
from edge_agent.messages import Config, Quality, Raw, Record, S, Verdict
from edge_agent.pipeline import Pipeline
from edge_agent.recording import topics
from edge_agent.replay import replay
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import config_yaml, dbc_text, raw_blocks
from edge_agent.state import unpack

SECONDS = 24.0
TURN_AT = 16.0
"""The antennas are knocked aside by 7 deg, and the shortened `reacquire_s` sees it."""


def with_check(body: str) -> bytes:
    check = 0
    for c in body.encode():
        check ^= c
    return f"${body}*{check:02X}\r\n".encode()


def settings_of(*changes: tuple[str, str]) -> Config:
    scenario = SCENARIOS["rough"]
    text = config_yaml(scenario, dbc="sensor.dbc", site="test")
    text += "  quay: {receiver: rover}\n  tower: {accelerometer: acc}\nfusion: {start_s: 8, reacquire_s: 5}\n"
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    return config.parse(text, Path(), lambda name: dbc_text(scenario).encode())


def true_heading(t_s: float) -> float:
    return (359.95 + 0.0025 * t_s + (7.0 if t_s > TURN_AT else 0.0)) % 360.0


def with_headings(raws: list[Raw], seed: int, form: str) -> list[Raw]:
    """The same reads with a heading behind each GGA and GST, as a receiver with two antennas sends them."""
    rng = random.Random(seed)
    out = []
    for raw in raws:
        if isinstance(raw.payload, bytes):
            t_s = (raw.t_ns - raws[0].t_ns) / S
            deg = (true_heading(t_s) + rng.gauss(0.0, 0.1)) % 360.0
            time = raw.payload.partition(b"GGA,")[2][:9].decode()
            body = {"HDT": f"GNHDT,{deg:.4f},T", "AVR": f"PTNL,AVR,{time},{deg:+.4f},Yaw,+0.5,Tilt,,,2.000,3,1.4,16"}
            raw = replace(raw, payload=raw.payload + with_check(body[form]))
        out.append(raw)
    return out


@pytest.fixture(scope="module")
def plain() -> list[Raw]:
    return list(raw_blocks(simulate("rough", 4, SECONDS)))


@pytest.fixture(scope="module")
def two_antennas() -> Config:
    return settings_of(("{port: gnss}", "{port: gnss, heading: true}"))


def steps(pipeline: Pipeline, raws: list[Raw]) -> list[Record]:
    return [r for raw in raws for r in pipeline.step(replace(raw, order=pipeline.order))]


def derived(records: list[Record]) -> list[tuple[str, int, int, bytes]]:
    return [(r.topic, r.log_ns, r.publish_ns, r.data) for r in records if r.derived]


def told(records: list[Record], topic: str) -> list[dict[str, Any]]:
    return [topics.decode(topics.schema_of(topic), r.data) for r in records if r.topic == topic]


@pytest.mark.parametrize("form", ["HDT", "AVR"])
def test_the_headings_of_a_receiver_go_to_each_of_its_points(two_antennas: Config, plain: list[Raw], form: str) -> None:
    raws = with_headings(plain, 1, form)
    records = steps(assemble.pipeline(two_antennas), raws)
    found = {r.topic for r in records if r.topic.endswith("/heading")}
    assert found == {"/fusion/deck/heading", "/fusion/quay/heading"}
    deck, quay = (told(records, f"/fusion/{name}/heading") for name in ("deck", "quay"))
    assert [h["heading_deg"] for h in deck if not math.isnan(h["heading_deg"])]
    assert repr(deck) == repr(quay)
    assert len(deck) == sum(isinstance(r.payload, bytes) for r in raws)
    verdicts = [h["verdict"] for h in deck[2:]]  # the first one stands before there is a clock for its time
    assert {Verdict.START, Verdict.ACCEPTED, Verdict.REJECTED} == set(verdicts)
    for h in deck:
        t_s = (h["monotonic_ns"] - plain[0].t_ns) / S
        if h["verdict"] == Verdict.ACCEPTED:
            off = (h["heading_deg"] - true_heading(t_s + 0.2) + 180.0) % 360.0 - 180.0  # 0.2 s latency
            assert abs(off) < 0.15
            assert 0.0 <= h["heading_deg"] < 360.0
    kinds = [e["kind"] for e in told(records, "/events") if e["kind"].startswith("HEADING")]
    assert kinds == ["HEADING_START", "HEADING_JUMP"]
    assert deck[-1]["baseline_m"] == (2.0 if form == "AVR" else pytest.approx(math.nan, nan_ok=True))


def test_a_heading_has_the_time_of_its_epochs_fix(two_antennas: Config, plain: list[Raw]) -> None:
    records = steps(assemble.pipeline(two_antennas), with_headings(plain, 1, "HDT"))
    fixes = [f["monotonic_ns"] for f in told(records, "/gnss/rover/solution")]
    headings = [h["monotonic_ns"] for h in told(records, "/fusion/deck/heading")]
    # the first ones come before their fix is given out, the clock is still finding itself: 1 ms; then exact
    assert all(min(abs(t - f) for f in fixes) <= 1_000_000 for t in headings[3:])
    assert sum(t in set(fixes) for t in headings) >= 0.9 * len(headings)


@pytest.mark.parametrize("on", [True, False])
def test_a_heading_changes_no_byte_of_a_position(two_antennas: Config, plain: list[Raw], on: bool) -> None:
    """GIVEN the same fixes WHEN headings stand between them, wild ones too THEN everything else is as without."""
    settings = two_antennas if on else settings_of()
    raws = with_headings(plain, 1, "HDT")
    raws = [
        replace(r, payload=r.payload + with_check(f"GNHDT,{37 * i % 360}.5,T")) if isinstance(r.payload, bytes) else r
        for i, r in enumerate(raws)
    ]
    got = derived(steps(assemble.pipeline(settings), raws))
    want = derived(steps(assemble.pipeline(settings), plain))
    assert any(t.endswith("/heading") for t, _, _, _ in got) is on
    heads = [e for e in got if e[0] == "/events" and b"HEADING_" in e[3]]
    assert bool(heads) is on
    others = [e for e in got if not e[0].endswith("/heading") and e not in heads]
    assert [e for e in others if e[0] != "/events"] == [e for e in want if e[0] != "/events"]
    # an event's publish time never steps back on its topic, so only that may differ behind another event
    assert [e[3] for e in others if e[0] == "/events" and not on] == [
        e[3] for e in want if e[0] == "/events" and not on
    ]


@pytest.mark.parametrize(("min_quality", "verdict"), [("float", Verdict.ACCEPTED), ("fixed", Verdict.PRECHECK)])
def test_the_least_quality_holds_for_headings_too(plain: list[Raw], min_quality: str, verdict: Verdict) -> None:
    """GIVEN headings that are float from 12 s on."""
    settings = settings_of(("{port: gnss}", f"{{port: gnss, heading: true, min_quality: {min_quality}}}"))
    raws = with_headings(plain[: len(plain) * 5 // 8], 2, "AVR")
    late = raws[0].t_ns + 12 * S
    floats = []
    for r in raws:
        if isinstance(r.payload, bytes) and r.t_ns > late:
            head, _, tail = r.payload.partition(b"$PTNL")
            body = ("PTNL" + tail.partition(b"*")[0].decode()).replace("2.000,3", "2.000,2")
            r = replace(r, payload=head + with_check(body))
        floats.append(r)
    records = steps(assemble.pipeline(settings), floats)
    heads = told(records, "/fusion/deck/heading")
    assert {h["verdict"] for h in heads if h["monotonic_ns"] > late} == {verdict}
    assert Verdict.ACCEPTED in {h["verdict"] for h in heads if h["monotonic_ns"] <= late - S // 2}


def test_any_cut_and_any_stop_give_the_same_bytes(two_antennas: Config, plain: list[Raw]) -> None:
    raws = with_headings(plain, 3, "HDT")
    want = derived(steps(assemble.pipeline(two_antennas), raws))
    rng = random.Random(7)
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
    pipeline = assemble.pipeline(two_antennas)
    got: list[Record] = []
    stops = set(rng.sample(range(len(cut)), 12))
    for i, raw in enumerate(cut):
        if i in stops:
            state = pipeline.save()
            pipeline = assemble.pipeline(two_antennas)
            pipeline.load(state)
            assert pipeline.save() == state
        got += steps(pipeline, [raw])
    assert derived(got) == want


def test_a_recording_with_headings_replays_to_the_same_bytes(
    two_antennas: Config, plain: list[Raw], tmp_path: Path
) -> None:
    files = record(tmp_path, (two_antennas, with_headings(plain, 4, "HDT")))
    whole = replay(files, None, None, True)
    assert whole.ok, str(whole)
    assert whole.compared == whole.derived
    assert whole.topics["/fusion/deck/heading"] > 150
    assert all(replay([f], None, None, True).ok for f in files)


def test_course_and_speed_are_recorded(plain: list[Raw]) -> None:
    raws = [
        replace(r, payload=with_check(f"GNVTG,{i % 360}.5,T,,M,0.02,N,3.6,K,D") + r.payload)
        if isinstance(r.payload, bytes)
        else r
        for i, r in enumerate(plain[:300])
    ]
    got = told(steps(assemble.pipeline(settings_of()), raws), "/gnss/rover/solution")
    assert len(got) > 5
    # once, as the order of the sentences is learnt, a VTG before its position goes with the fix before
    assert [round(f["speed_mps"], 6) for f in got].count(1.0) == len(got) - 1
    assert all(f["course_deg"] % 1.0 == 0.5 for f in got if f["speed_mps"] == f["speed_mps"])
    plain_told = told(steps(assemble.pipeline(settings_of()), plain[:300]), "/gnss/rover/solution")
    assert all(math.isnan(f["speed_mps"]) and math.isnan(f["course_deg"]) for f in plain_told)


def test_what_outlives_a_run_keeps_its_version(two_antennas: Config) -> None:
    """An update of the program must find the reference of the one before, or the zero would move."""
    pipeline = assemble.pipeline(two_antennas)
    assert unpack(pipeline.slow())["version"] == 1
    assert pipeline.receivers["rover"].settings.min_quality == Quality.FLOAT
