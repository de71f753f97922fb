"""A generator in a second process: the same values, and the rest of them here when that process is gone."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_agent.__main__ import main
from edge_agent.review import ahead, gather, series
from edge_agent.review.ahead import ahead as run
from edge_agent.review.figures import as_json
from edge_agent.simulate import SCENARIOS
from edge_agent.simulate import run as simulate
from edge_agent.simulate.files import write_files


def numbered(n: int, home: int, dies_at: int = -1) -> Iterator[tuple[int, bool]]:
    """Numbers, and whether they were made in another process than `home`; there it may kill itself."""
    for i in range(n):
        if i == dies_at and os.getpid() != home:
            os.kill(os.getpid(), signal.SIGKILL)
        yield i, os.getpid() != home


def failing(home: int) -> Iterator[int]:
    yield 1
    raise ValueError("made here" if os.getpid() == home else "made there")


def test_values_come_from_another_process_in_their_order() -> None:
    assert list(run(numbered, 200, os.getpid())) == [(i, True) for i in range(200)]


def test_what_a_killed_process_did_not_say_is_made_here() -> None:
    assert list(run(numbered, 5, os.getpid(), 3)) == [(0, True), (1, True), (2, True), (3, False), (4, False)]


def test_an_error_is_raised_here_with_its_own_story() -> None:
    found = run(failing, os.getpid())
    assert next(found) == 1
    with pytest.raises(ValueError, match="made here"):
        next(found)


def test_who_stops_taking_ends_the_process() -> None:
    import multiprocessing

    found = run(numbered, 1 << 40, os.getpid())
    assert next(found) == (0, True)
    assert isinstance(found, Iterator)
    found.close()  # type: ignore[attr-defined]
    assert multiprocessing.active_children() == []


def test_one_processor_or_little_to_read_is_done_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    files = [tmp_path / "a"]
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    monkeypatch.setattr(ahead, "allowed", True)
    assert not ahead.worth(files)
    monkeypatch.setattr(ahead, "WORTH_BYTES", 5)
    assert ahead.worth(files)
    monkeypatch.setattr(ahead, "allowed", False)  # not by the command line
    assert not ahead.worth(files)
    monkeypatch.setattr(ahead, "allowed", True)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0})
    assert not ahead.worth(files)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ahead")
    write_files(simulate(SCENARIOS["rough"], 4, 100.0), folder)
    command = ["replay", str(folder / "raw.mcap"), "-c", str(folder / "config.yaml"), "-o", str(folder / "fused.mcap")]
    assert main(command) == 0
    return folder / "fused.mcap"


def test_a_review_by_two_processes_is_that_by_one(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spoilt = recording.with_name("spoilt.mcap")
    data = bytearray(recording.read_bytes())
    data[len(data) // 2] ^= 4
    spoilt.write_bytes(data)
    told = []
    for both in (False, True):
        monkeypatch.setattr(gather, "worth", lambda files, both=both: both)
        monkeypatch.setattr(series, "worth", lambda files, both=both: both)
        r = gather.gather([recording, spoilt])
        p = r.points["deck"]
        told.append((sorted(r.damaged.items()), r.overview.kinds, p.moments.mean.tolist(), p.low, p.high, p.agreement))
        held = [*r.overview.points["deck"].displacement.spans(), *p.smoothed.spans(), p.busy.accel[1] if p.busy else 0]
        told[-1] += (b"".join(np.asarray(a).tobytes() for a in held),)
    assert [path for path, _ in told[0][0]] == [spoilt]
    assert str(told[0][:-1]) == str(told[1][:-1])
    assert told[0][-1] == told[1][-1]


def test_half_of_the_points_by_another_process_gives_the_same_review(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rough = SCENARIOS["rough"]
    write_files(
        simulate(replace(rough, accels=tuple(replace(rough.accels[0], name=f"a{i}") for i in range(3))), 4, 80.0),
        tmp_path,
    )
    fused = str(tmp_path / "fused.mcap")
    assert main(["replay", str(tmp_path / "raw.mcap"), "-c", str(tmp_path / "config.yaml"), "-o", fused]) == 0
    told = []
    for both in (False, True):
        monkeypatch.setattr(gather, "worth", lambda files, both=both: both)
        r = gather.gather([Path(fused)])
        names = [list(table) for table, _ in gather._tables(r)]
        told.append((json.dumps(as_json(r), sort_keys=True), names, r.overview.kinds, str(r.modal and r.modal.names)))
        held = [e.spans() for p in r.overview.points.values() for e in (p.displacement, p.std, p.residual, p.ratio)]
        held += [a.xyz.spans() for a in r.overview.accelerometers.values()]
        held += [p.smoothed.spans() for p in r.points.values()]
        told[-1] += (b"".join(np.asarray(a).tobytes() for e in held for a in e),)
        assert len(r.points) == 3
        assert all(p.busy is not None and p.agreement is not None for p in r.points.values())
    assert told[0] == told[1]
