"""Disks that are full, read-only, broken or taken away, and clocks that are a year off: what can be kept is kept, what
is lost is counted, recording goes on by itself. In simulated time, without threads (`stepped.py`)."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import CAN, CLOCK, GNSS, Live, decoded, faults, ledgers, ports, raws, settings, stored, values
from stepped import Stepped, estimates

from edge_agent import runtime
from edge_agent.messages import Fault, Mode, Raw, Record, Rotate, S, Tick
from edge_agent.recording import segments, topics, writer
from edge_agent.recording.reader import read_metadata
from edge_agent.replay import replay
from edge_agent.simulate import simulate
from edge_agent.simulate.encode import raw_blocks
from edge_agent.simulate.specs import START_NS
from edge_agent.verify import verify

BLOCK = 20_000
FUSED = "/fusion/deck/block"
DAY = 86_400 * S


@pytest.fixture(scope="module")
def script() -> list[Raw]:
    return list(raw_blocks(simulate("clean", 1, 50.0)))


@pytest.fixture(scope="module")
def calm(script: list[Raw], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The recording of the same script on a good disk."""
    run = Stepped(settings(tmp_path_factory.mktemp("calm")))
    run.play(script)
    run.close()
    return run.files()


class Refusing:
    """A disk that refuses to write, and to begin files, with `error` while that is set."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.error = 0
        self.refused = 0
        write, begin, repair = writer._HashedFile.write, writer._HashedFile.__init__, segments.repair

        def check() -> None:
            if self.error:
                self.refused += 1
                raise OSError(self.error, os.strerror(self.error))

        def refusing(file: writer._HashedFile, data: bytes) -> int:
            check()
            return write(file, data)

        def beginning(file: writer._HashedFile, path: Path) -> None:
            check()
            begin(file, path)

        def sealing(path: Path) -> segments.Repaired:
            check()
            return repair(path)

        patch.setattr(writer._HashedFile, "write", refusing)
        patch.setattr(writer._HashedFile, "__init__", beginning)
        patch.setattr(segments, "repair", sealing)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Refusing:
    return Refusing(monkeypatch)


def second(raw: Raw) -> float:
    return (raw.t_ns - START_NS) / S


def sound(run: Stepped, script: Iterable[Raw], *, compared: int = 300) -> set[int]:
    """What holds after every fault; the places in the script of what is in no file."""
    assert run.within_bounds(BLOCK), run.most
    assert run.checked == []
    assert run.balance() == {}
    files = run.files()
    assert not faults(files, "LEDGER")
    verdict = verify(files)
    assert verdict.wanting == []
    assert {g.reason for g in verdict.gaps} <= {"disk"}
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert report.compared > compared
    assert report.unexpected == 0
    there = [(r.source, r.t_ns) for r in raws(files)]
    assert len(set(there)) == len(there)
    gone = {i for i, r in enumerate(script) if (r.source, r.t_ns) not in set(there)}
    by_port = {n: sum(r.source == n for i, r in enumerate(script) if i in gone) for n in (GNSS, CAN, CLOCK)}
    assert by_port == {n: a.lost for n, a in run.agent.accounts.items()}
    return gone


def told(run: Stepped) -> list[str]:
    return [f["kind"] for f in faults(run.files()) if f["source"] == "recorder"]


def lost_at_the_disk(run: Stepped) -> dict[str, int]:
    found: dict[str, int] = {}
    for f in faults(run.files(), "LOSS"):
        assert f["text"].endswith("at disk")
        found[f["source"]] = found.get(f["source"], 0) + int(values(f)["count"])
    return found


# ------------------------------------------------------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (errno.ENOSPC, "DISK_FULL"),
        (errno.EROFS, "DISK_READ-ONLY"),
        (errno.EIO, "DISK_IO"),
    ],
)
def test_a_disk_that_refuses_amid_a_file_for_20_s_costs_what_was_in_its_hand(
    script: list[Raw], tmp_path: Path, disk: Refusing, calm: list[Path], error: int, kind: str
) -> None:
    run = Stepped(settings(tmp_path))
    run.play(r for r in script if second(r) < 20)
    disk.error = error
    run.play(r for r in script if 20 <= second(r) < 40)
    assert disk.refused >= 5  # it is tried again every 5 s, and when main orders a file
    assert run.writer.holding
    assert 0 < run.writer.ring_bytes < run.settings.record.ring_mb * 1e6
    disk.error = 0
    run.play(r for r in script if second(r) >= 40)
    run.close()
    segments.recover(run.data_dir)  # as the next start does: nothing could be sealed while it refused
    gone = sound(run, script)
    assert told(run) == [kind, "DISK_OK"]
    assert 0 < len(gone) <= 4  # what waited for its flush, and what came up to main's Rotate
    assert all(19.8 <= second(script[i]) < 20.3 for i in gone), [second(script[i]) for i in gone]
    assert {k: v for k, v in lost_at_the_disk(run).items() if k.startswith("/raw/")} == {
        f"/raw/{n}": a.lost for n, a in run.agent.accounts.items() if a.lost
    }
    assert ledgers(run.files())[CAN]["lost_disk"] == run.agent.accounts[CAN].lost
    because = [read_metadata(f)["edge_agent:run"]["opened_because"] for f in run.files()]
    assert because == ["start", "disk"]
    # the estimate went on all the while: the same instants and values, but for what was lost with the raw blocks
    there = {data for _, _, data in estimates(run.files())}
    missing = [data for _, _, data in estimates(calm) if data not in there]
    assert len(missing) <= 8
    last = topics.decode_fused_block("p", stored(run.files(), FUSED)[-1].data)
    assert set(last.mode.tolist()) == {Mode.FUSED}


def test_a_disk_that_is_full_from_the_start_and_then_freed_costs_nothing(script: list[Raw], tmp_path: Path) -> None:
    free = [0]
    run = Stepped(settings(tmp_path), free_bytes=lambda: free[0])
    run.play(r for r in script if second(r) < 30)
    assert run.files() == []
    assert any("DISK_FULL" in line for line in run.said)
    assert run.writer.ring_bytes > 100_000
    free[0] = 1 << 40
    run.play(r for r in script if second(r) >= 30)
    run.close()
    assert sound(run, script) == set()
    assert told(run) == ["DISK_FULL", "DISK_OK"]
    assert len(run.files()) == 1
    assert run.said[-1] == "stopped"


@pytest.mark.parametrize("ring_mb", [0.8, 0.45])
def test_a_disk_that_stays_full_costs_derived_records_first_and_then_the_oldest(
    script: list[Raw], tmp_path: Path, disk: Refusing, ring_mb: float
) -> None:
    run = Stepped(settings(tmp_path, f"record.ring_mb={ring_mb}"))
    run.play(r for r in script if second(r) < 17)
    disk.error = errno.ENOSPC
    run.play(r for r in script if 17 <= second(r) < 42)
    disk.error = 0
    run.play(r for r in script if second(r) >= 42)
    run.close()
    segments.recover(run.data_dir)
    gone = sound(run, script)
    lost = lost_at_the_disk(run)
    assert run.most["ring"] <= ring_mb * 1e6
    assert lost[FUSED] > 30
    if ring_mb == 0.8:
        assert told(run) == ["DISK_FULL", "DISK_OK"]
        assert len(gone) <= 4
    else:
        assert told(run)[-1] == "DISK_OK"
        assert "RING_FULL" in told(run)
        assert any("DISK_FULL" in line for line in run.said)  # on /faults it went with the oldest
        assert len(gone) > 100
        kept = [r for i, r in enumerate(script) if 17 <= second(r) < 42 and i not in gone]
        assert kept  # the newest of what came while it was full
        assert min(map(second, kept)) > 20
    last = topics.decode_fused_block("p", stored(run.files(), FUSED)[-1].data)
    assert set(last.mode.tolist()) == {Mode.FUSED}


def test_a_disk_that_comes_and_goes_is_told_each_time_and_balances(
    script: list[Raw], tmp_path: Path, disk: Refusing
) -> None:
    run = Stepped(settings(tmp_path, "record.rotate_s=10"))
    for raw in script:
        disk.error = errno.EIO if second(raw) % 13 >= 8 and second(raw) < 40 else 0
        run.play([raw])
    run.close()
    disk.error = 0
    segments.recover(run.data_dir)
    gone = sound(run, script, compared=100)
    assert told(run) == ["DISK_IO", "DISK_OK"] * 3
    assert 0 < len(gone) < 40


@pytest.fixture
def codes(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """With what runs end."""
    found: list[int] = []
    run = runtime.Agent.run

    def watched(agent: runtime.Agent, before: Sequence[Fault] = ()) -> int:
        found.append(run(agent, before))
        return found[-1]

    monkeypatch.setattr(runtime.Agent, "run", watched)
    return found


def test_a_run_of_which_nothing_could_be_recorded_does_not_end_well(
    script: list[Raw], tmp_path: Path, codes: list[int]
) -> None:
    for name, free in (("full", 0), ("good", 1 << 40)):
        with Live(settings(tmp_path / name), ports(), free_bytes=lambda free=free: free) as live:  # type: ignore[misc]
            live.play(script[:60], step=True)
        assert ("nothing that came could be recorded" in live.said) == (name == "full")
    assert codes == [1, 0]


def test_a_run_that_ends_with_a_loss_that_no_file_tells_says_so_by_its_code(
    script: list[Raw], tmp_path: Path, disk: Refusing, codes: list[int]
) -> None:
    with Live(settings(tmp_path), ports()) as live:
        live.play(script[:60], step=True)
        live.settle()
        disk.error = errno.EROFS
        live.play(script[60:90], step=True)
    disk.error = 0
    assert codes == [3]
    assert any("told in no file" in line for line in live.said)


# ----------------------------------------------------------------------------------------------------------- taken away


def test_a_folder_deleted_under_the_agent_is_made_again(script: list[Raw], tmp_path: Path) -> None:
    """What was in it is gone; what comes after the next flush is not, and the ledger says what was lost on the way."""
    run = Stepped(settings(tmp_path, "record.flush_s=1"))
    run.play(r for r in script if second(r) < 20)
    shutil.rmtree(run.data_dir)
    run.play(r for r in script if second(r) >= 20)
    run.close()
    files = run.files()
    assert [read_metadata(f)["edge_agent:run"]["opened_because"] for f in files] == ["disk"]
    assert told(run)[0].startswith("DISK_")
    there = [(r.source, r.t_ns) for r in raws(files)]
    first = min(t for _, t in there)
    assert 20 <= (first - START_NS) / S < 22.5  # a flush, and main's Rotate
    assert there == [(r.source, r.t_ns) for r in script if r.t_ns >= first][-len(there) :]
    assert len(script) - len(there) - sum(r.t_ns < START_NS + 20 * S for r in script) < 40
    for name, a in run.agent.accounts.items():
        assert a.received == a.written + a.lost
        assert a.written > sum(s == name for s, _ in there)  # what was taken away had been written
    assert run.checked == []
    assert run.within_bounds(BLOCK)
    assert replay(files, None, None, True).ok
    kept = run.data_dir / "state" / "kept.bin"
    assert kept.exists()  # the slow state is written anew


# ---------------------------------------------------------------------------------------------------------- clock


def stepped_by(days: int, begin: float, end: float) -> Callable[[Raw], Raw]:
    def shift(raw: Raw) -> Raw:
        if isinstance(raw.payload, Tick) and begin <= second(raw) < end:
            return replace(raw, payload=replace(raw.payload, utc_ns=raw.payload.utc_ns + days * DAY))
        return raw

    return shift


@pytest.mark.parametrize("days", [365, -365])
def test_a_clock_a_year_off_and_back_loses_nothing_and_deletes_nothing(
    script: list[Raw], tmp_path: Path, calm: list[Path], days: int
) -> None:
    """GIVEN recordings of the last month and a disciplined clock WHEN it is a year off for 6 s THEN all recordings
    stay, no name is used twice, files of whole periods go on, and the estimate knows nothing of it."""
    run = Stepped(settings(tmp_path, "record.keep_days=60", "record.rotate_s=10"))
    old = [run.data_dir / f"site_202605{day:02d}T080000Z_000.mcap" for day in range(2, 30)]
    shutil.copy(calm[0], old[0])
    for path in old[1:]:
        os.link(old[0], path)
    run.play(map(stepped_by(days, 21, 27), script))
    run.close()
    assert all(path.exists() for path in old)
    for path in old:
        path.unlink()
    files = run.files()
    year = "2027" if days > 0 else "2025"
    names = [f.name[5:21] for f in sorted(files, key=lambda f: read_metadata(f)["edge_agent:run"]["segment"])]
    assert names == [
        "20260601T080000Z",
        "20260601T080010Z",
        "20260601T080020Z",
        f"{year}0601T080021Z",
        "20260601T080027Z",
        "20260601T080030Z",
        "20260601T080040Z",
        "20260601T080050Z",
    ]
    steps = [e for e in decoded(files, "/events") if e["kind"] == "CLOCK_STEP"]
    assert sorted(round(values(e)["step_s"]) for e in steps) == [-365 * 86400, 365 * 86400]
    assert sorted((r.t_ns, r.source) for r in raws(files)) == sorted((r.t_ns, r.source) for r in script)
    for f in files:
        log = [s.log_ns for s in stored([f])]
        assert log == sorted(log)
        for topic in {s.topic for s in stored([f])}:
            stamps = [s.publish_ns for s in stored([f], topic)]
            assert stamps == sorted(stamps), topic

    def instants(some: list[Path]) -> np.ndarray:
        blocks = [topics.decode_fused_block("p", s.data) for s in stored(some, FUSED)]
        return np.sort(np.concatenate([b.t_ns for b in blocks]))

    assert (instants(files) == instants(calm)).all()
    assert run.balance() == {}
    assert run.checked == []
    assert run.within_bounds(BLOCK)
    verdict = verify(files)
    assert verdict.wanting == []
    assert verdict.gaps == []
    assert [f.name for f in verdict.files] == [f"site_{n}_000.mcap" for n in names]
    report = replay(files, None, None, True)
    assert report.ok, str(report)
    assert all(replay([f], None, None, True).ok for f in files[2:4])


def test_an_age_counts_only_by_a_clock_that_has_gone_on_for_hours(tmp_path: Path) -> None:
    """The same over hours: a year ahead for five, and nothing is deleted; right again, and what is too old goes."""
    made = settings(tmp_path, "record.keep_days=60")
    deleted: dict[str, Any] = {}
    for hours in (5, 7):
        folder = tmp_path / f"{hours}"
        folder.mkdir()
        recorder = segments.Recorder(folder, made.record, "site", {"run": "r"}, {}, lambda: 1 << 40)
        (folder / "site_20260501T080000Z_000.mcap").touch()
        utc = 1_780_300_800 * S
        for hour in range(hours + 1):
            reason = "start" if hour == 0 else "clock" if hour == 1 else "time"
            at = utc + hour * 3600 * S + (365 * DAY if hour >= 1 else 0)
            data = topics.checkpoint(hour, hour * 3600 * S, at, b"", reason)
            recorder.handle(Rotate(Record("/raw/checkpoint", at, at, data, False), at, reason), hour * 3600 * S)
            recorder.idle(hour * 3600 * S + 61 * S)
        recorder.close()
        deleted[str(hours)] = [f.kind for f in recorder.drain_faults()]
    assert deleted["5"] == []
    assert "RETENTION" in deleted["7"]
