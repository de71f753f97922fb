"""Replay and verify: the whole run, each segment alone, a torn end, and what must not pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from edge_agent import assemble, config
from edge_agent.messages import Config, Raw, Record, RecordSettings, Rotate, S, Tick
from edge_agent.recording import topics
from edge_agent.recording.reader import read_messages, read_metadata
from edge_agent.recording.repair import recover
from edge_agent.recording.segments import Recorder
from edge_agent.recording.writer import RUN_METADATA
from edge_agent.replay import ReplayError, in_order, replay
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import config_yaml, dbc_text, raw_blocks

DBC = "sensor.dbc"
ROTATE_S = 15


@pytest.fixture(scope="module")
def setup() -> tuple[Config, list[Raw]]:
    scenario = SCENARIOS["rough"]
    text = config_yaml(scenario, dbc=DBC, site="test")
    settings = config.parse(text, Path(), lambda name: dbc_text(scenario).encode())
    return settings, list(raw_blocks(simulate("rough", 4, 50.0)))


def record(
    folder: Path,
    setup: tuple[Config, list[Raw]],
    *,
    drop: Callable[[Record], bool] = lambda record: False,
    finish: bool = True,
    raws: list[Raw] | None = None,
    run: str = "",
) -> list[Path]:
    """What a run writes, without threads: rotation every 15 s, `drop` = records that never reach the file."""
    settings, all_raws = setup
    attachments = {"config.yaml": settings.text.encode(), **dict(settings.files)}
    metadata = {"platform": assemble.platform_name()} | ({"run": run} if run else {})
    recorder = Recorder(folder, RecordSettings(free_gb=0.0), "test", metadata, attachments, lambda: 1 << 40)
    pipeline = assemble.pipeline(settings)
    period = None
    for i, raw in enumerate(raws or all_raws):
        raw = replace(raw, order=pipeline.order)
        now = i * 10_000_000
        if i > 0 and (pipeline.rotate_due or pipeline.to_utc(raw.t_ns) // (ROTATE_S * S) != period):
            recorder.handle(pipeline.rotate("time", raw.t_ns), now)
            period = pipeline.to_utc(raw.t_ns) // (ROTATE_S * S)
        for r in pipeline.step(raw):
            if recorder.path is not None and not drop(r):
                recorder.handle(r, now)
        recorder.idle(now)
    if finish:
        for r in pipeline.finish():
            recorder.handle(r, 0)
        recorder.close()
    elif recorder._writer is not None:  # a kill: what was not flushed is gone
        recorder._writer.abandon()
    return sorted(folder.glob("*.mcap*"))


def test_the_run_and_each_segment_alone_are_equal(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    files = record(tmp_path, setup)
    assert len(files) >= 4
    whole = replay(files, None, None, True)
    assert whole.ok, str(whole)
    assert (whole.differing, whole.missing, whole.missing_allowed, whole.unexpected) == (0, 0, 0, 0)
    assert whole.compared == whole.derived > 3000
    alone = [replay([f], None, None, True) for f in files]
    assert all(r.ok for r in alone)
    assert sum(r.compared for r in alone) == whole.compared
    # the past may be gone, and the folder itself may be named
    files[0].unlink()
    assert replay([tmp_path], None, None, True).ok


def test_a_missing_segment_is_no_lie(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    files = record(tmp_path, setup)
    files[1].unlink()
    report = replay([tmp_path], None, None, True)
    assert report.ok
    assert report.segments == len(files) - 1


def test_a_torn_run_is_equal_up_to_the_cut(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    *whole, torn = record(tmp_path, setup, finish=False)
    assert torn.suffix == ".part"
    data = torn.read_bytes()
    for share in (0.5, 0.8, 0.97):
        torn.write_bytes(data[: int(len(data) * share)])
        report = replay([*whole, torn], None, None, True)
        assert report.ok, str(report)
        assert report.compared > 1000
    recover(tmp_path)
    assert replay([tmp_path], None, None, True).ok


def test_a_changed_byte_is_found(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    seen = 0

    def spoil(r: Record) -> bool:
        nonlocal seen
        seen += r.topic.endswith("/block")
        if r.topic.endswith("/block") and seen == 50:
            object.__setattr__(r, "data", r.data[:-1] + bytes([r.data[-1] ^ 1]))
        return False

    report = replay(record(tmp_path, setup, drop=spoil), None, None, True)
    assert not report.ok
    assert report.differing == 1


def test_a_record_that_is_missing_without_a_loss_is_found(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    seen = 0

    def lose(r: Record) -> bool:
        nonlocal seen
        seen += r.topic.endswith("/update")
        return r.topic.endswith("/update") and seen in (30, 31)

    report = replay(record(tmp_path, setup, drop=lose), None, None, True)
    assert not report.ok
    assert report.missing == 2


def test_a_loss_on_faults_allows_what_it_covers(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    lost: list[Record] = []
    settings, _ = setup

    def lose(r: Record) -> bool:
        if r.topic.endswith("/update") and len(lost) < 5:
            lost.append(r)
            return True
        return False

    files = record(tmp_path, setup, drop=lose)
    begin, end = lost[0].log_ns, lost[-1].log_ns
    data = topics.event("LOSS", lost[0].topic, "5 lost at outbox", (("count", 5.0),), 0, end, begin, end)
    recorder = Recorder(tmp_path / "b", RecordSettings(free_gb=0.0), "test", {}, {}, lambda: 1 << 40)
    for f in files:  # the same recording with the LOSS that the runtime would have written
        for s in read_messages(f):
            r = Record(s.topic, s.log_ns, s.publish_ns, s.data, False, s.schema)
            recorder.handle(Rotate(r, s.log_ns, "copy") if s.topic == "/raw/checkpoint" else r, 0)
    recorder.handle(Record("/faults", end, end, data, False), 0)
    recorder.close()
    assert not replay(files, None, settings, True).ok
    report = replay([tmp_path / "b"], None, settings, True)
    assert report.ok
    assert report.missing_allowed == 5


def test_a_lost_raw_block_is_not_verifiable_up_to_the_next_checkpoint(
    setup: tuple[Config, list[Raw]], tmp_path: Path
) -> None:
    seen = 0

    def lose(r: Record) -> bool:
        nonlocal seen
        seen += not r.derived
        return not r.derived and seen == 200

    report = replay(record(tmp_path, setup, drop=lose), None, None, True)
    assert report.ok, str(report)
    assert report.raw_gaps == 1
    assert 0 < report.unverifiable < report.derived
    assert "not verifiable" in str(report)


def test_two_runs_in_one_folder(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    _, raws = setup
    record(tmp_path, setup, raws=raws[: len(raws) // 2])
    record(tmp_path, setup, raws=raws[len(raws) // 2 :])
    report = replay([tmp_path], None, None, True)
    assert report.ok, str(report)


def test_the_output_replays_to_itself_and_retune_changes_it(setup: tuple[Config, list[Raw]], tmp_path: Path) -> None:
    settings, _ = setup
    files = record(tmp_path / "a", setup)
    report = replay(files, tmp_path / "same.mcap", None, False)
    assert report.output == str(tmp_path / "same.mcap")
    assert replay([tmp_path / "same.mcap"], None, None, True).ok
    other = config.parse(
        settings.text, Path(), lambda name: dict(settings.files)[name], ["fusion.gate_alpha=0.05", "fusion.start_s=20"]
    )
    replay(files, tmp_path / "other.mcap", other, False)
    assert replay([tmp_path / "other.mcap"], None, None, True).ok
    with pytest.raises(ReplayError, match="settings"):
        replay(files, None, other, True)
    same, changed = (
        [s.data for s in read_messages(tmp_path / f"{n}.mcap") if s.topic.endswith("/block")] for n in ("same", "other")
    )
    assert same
    assert changed
    assert same != changed


def test_files_of_a_run_go_by_their_number_not_by_a_clock_that_was_set_back(
    setup: tuple[Config, list[Raw]], tmp_path: Path
) -> None:
    settings, raws = setup
    back = [
        replace(r, payload=replace(r.payload, utc_ns=r.payload.utc_ns - 7200 * S))
        if isinstance(r.payload, Tick) and r.t_ns > raws[0].t_ns + 25 * S
        else r
        for r in raws
    ]
    files = record(tmp_path, setup, raws=back, run="one")
    numbers = [int(read_metadata(f)[RUN_METADATA]["segment"]) for f in files]
    assert numbers != sorted(numbers)  # the names do step back
    assert in_order(files) == [f for _, f in sorted(zip(numbers, files, strict=True))]
    assert replay(files, None, settings, True).ok


def test_nothing_to_replay_is_said(tmp_path: Path) -> None:
    with pytest.raises(ReplayError, match="no recording"):
        replay([tmp_path], None, None, False)
