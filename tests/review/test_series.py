"""Recordings into arrays, envelopes, gaps with reasons, and the smoothed stream back into a recording."""

from __future__ import annotations

import ast
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.__main__ import main
from edge_agent.messages import Mode, Quality, S, Verdict
from edge_agent.recording.reader import read_messages
from edge_agent.recording.topics import decode_fused_block
from edge_agent.replay import ReplayError
from edge_agent.review import series
from edge_agent.review.series import Envelope, Overview, Stream, configuration, files_of, overview, pieces, window
from edge_agent.review.smoothed import smoothed
from edge_agent.simulate import SCENARIOS, SimRecord, run
from edge_agent.simulate.files import write_files

F64 = npt.NDArray[np.float64]
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimRecord, Path]:
    """Four minutes of outliers, drops, wrong fixes and a float spell, replayed and smoothed by the command line."""
    folder = tmp_path_factory.mktemp("hostile")
    record = run(SCENARIOS["floaty"], 2, 240.0)
    write_files(record, folder)
    command = ["replay", str(folder / "raw.mcap"), "-c", str(folder / "config.yaml"), "-o", str(folder / "fused.mcap")]
    assert main([*command, "--smooth"]) == 0
    return record, folder / "fused.mcap"


def stream(path: Path, leaf: str, record: SimRecord) -> tuple[npt.NDArray[np.int64], F64, F64, set[int]]:
    """Monotonic times of the record, displacement, sd, revisions of `/fusion/*/<leaf>`."""
    t, d, sd, revisions = [], [], [], set()
    for m in read_messages(path):
        if m.topic == f"/fusion/deck/{leaf}":
            e = decode_fused_block("deck", m.data)
            t.append(e.t_ns + (m.publish_ns - int(e.t_ns[0]) - record.utc_offset_ns))
            d.append(e.displacement_m)
            sd.append(e.std_displacement_m)
            revisions.add(e.revision)
    return np.concatenate(t), np.concatenate(d), np.concatenate(sd), revisions


def test_replay_smooth_writes_the_stream_and_halves_the_error(hostile: tuple[SimRecord, Path]) -> None:
    record, path = hostile
    rmse = {}
    for leaf in ("block", "smoothed"):
        t, d, sd, revisions = stream(path, leaf, record)
        assert revisions == {0 if leaf == "block" else 2}
        assert (np.diff(t) > 0).all()
        truth = np.stack([np.interp(t, record.accel.true_ns, record.truth.d_m[:, i]) for i in range(3)], axis=1)
        late = t > t[0] + 60 * S
        rmse[leaf] = (d - truth)[late].std(axis=0)  # the zero is the start window's, with its own error
        nees = float((((d - truth) / sd)[late] ** 2).mean())
        if leaf == "smoothed":
            assert 0.3 < nees < 2.0
    print("hostile, mm: live", 1e3 * rmse["block"], "smoothed", 1e3 * rmse["smoothed"])
    assert np.sqrt((rmse["smoothed"] ** 2).sum() / (rmse["block"] ** 2).sum()) < 0.8
    logs = [m.log_ns for m in read_messages(path) if m.topic.startswith("/fusion/")]
    assert max(a - b for a, b in pairwise(logs)) < 3 * S


def test_a_smoothed_recording_still_verifies_and_is_smoothed_anew(
    hostile: tuple[SimRecord, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    record, path = hostile
    again = tmp_path / "again.mcap"
    assert main(["replay", str(path), "--verify", "--smooth", "-o", str(again), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["ok"]
    assert told["unexpected"] == 0
    assert any("/fusion/deck/smoothed" in note for note in told["notes"])
    for a, b in zip(stream(path, "smoothed", record), stream(again, "smoothed", record), strict=True):
        assert np.array_equal(a, b) if isinstance(a, np.ndarray) else a == b
    assert main(["replay", str(path), "--smooth", "--verify"]) == 2


def test_chapters_of_a_recording_join(hostile: tuple[SimRecord, Path]) -> None:
    _, path = hostile
    whole = [e for e, _ in smoothed([path], ["deck"])]
    noise_like = [e for e, _ in smoothed([path], ["deck"], chapter=700)]
    a, b = (np.concatenate([e.displacement_m for e in es]) for es in (whole, noise_like))
    assert a.shape == b.shape
    # the noise is estimated per chapter, so the answer moves, by less than it is sure of
    sd = np.concatenate([e.std_displacement_m for e in whole])
    assert float(np.abs((a - b) / sd).mean()) < 0.5
    assert (np.concatenate([e.t_ns for e in whole]) == np.concatenate([e.t_ns for e in noise_like])).all()
    with pytest.raises(KeyError):
        next(smoothed([path], ["nowhere"]))


def test_pieces_hold_what_was_recorded(hostile: tuple[SimRecord, Path]) -> None:
    record, path = hostile
    found = list(pieces([path], configuration([path]), piece_s=30.0))
    assert len(found) >= 8
    assert [p.first for p in found] == [True] + [False] * (len(found) - 1)
    assert max(len(p.fused["deck"].utc_ns) for p in found if p.fused) < 33 * 100  # so memory is bounded
    t = np.concatenate([p.accelerations["acc"].t_ns for p in found if p.accelerations])
    xyz = np.concatenate([p.accelerations["acc"].xyz for p in found if p.accelerations])
    assert len(t) == len(record.accel.t_ns)  # the duplicates of the wire are gone, every sample is there
    assert np.abs(xyz - record.accel.xyz).max() < 0.01
    assert np.abs(t - record.accel.t_ns).max() < 0.005 * S
    fixes = [p.fixes["rover"] for p in found if "rover" in p.fixes]
    z, at = np.concatenate([f.z_m for f in fixes]), np.concatenate([f.t_ns for f in fixes])
    assert (
        np.abs(np.concatenate([f.utc_ns for f in fixes]) - record.fixes.t_ns[: len(at)] - record.utc_offset_ns).max()
        < 2_000_000
    )
    assert np.abs(z - record.fixes.z_m[: len(z)]).max() < 0.001
    judged = [p.judged["deck"] for p in found if "deck" in p.judged]
    assert set(np.concatenate([j.verdict for j in judged]).tolist()) >= {
        Verdict.ACCEPTED,
        Verdict.REJECTED,
        Verdict.START,
    }
    assert set(np.concatenate([j.t_ns for j in judged]).tolist()) <= set(at.tolist())
    kinds = [h.kind for p in found for h in p.happened]
    assert "START" in kinds


def test_a_window_feeds_the_comparison_of_the_sensors(hostile: tuple[SimRecord, Path]) -> None:
    record, path = hostile
    begin = int(record.accel.t_ns[0]) + record.utc_offset_ns + 60 * S
    fixes, accel = window([path], "deck", begin_ns=begin, end_ns=begin + 100 * S)
    assert 700 < len(fixes) < 800  # a tenth was dropped, and the float spell is left out
    assert len(accel.t_ns) == pytest.approx(10_000, rel=0.01)
    assert abs(int(fixes.t_ns[0]) - int(accel.t_ns[0])) < S
    everything, _ = window([path], "deck")
    assert len(everything) > 1900
    nothing, none = window([path], "deck", begin_ns=0, end_ns=1)
    assert len(nothing) == len(none.t_ns) == 0


def test_the_overview_counts_everything_and_loses_no_extreme(hostile: tuple[SimRecord, Path]) -> None:
    _, path = hostile
    all_pieces = list(pieces([path], configuration([path]), piece_s=20.0))
    o = overview([path])
    point, receiver, accel = o.points["deck"], o.receivers["rover"], o.accelerometers["acc"]
    d = np.concatenate([p.fused["deck"].displacement_m for p in all_pieces if p.fused])
    assert point.stream.samples == len(d)
    assert sum(point.modes.values()) == len(d)
    assert point.modes[Mode.FUSED] > 0.9 * len(d)
    _, low, high, count = point.displacement.spans()
    assert (low.min(axis=0) == d.min(axis=0)).all()
    assert (high.max(axis=0) == d.max(axis=0)).all()
    assert count.sum() == len(d)
    assert point.verdicts[Verdict.REJECTED] > 50
    assert point.over >= point.verdicts[Verdict.REJECTED] * 0.5
    assert receiver.qualities.keys() == {Quality.FIXED, Quality.FLOAT}
    assert sum(receiver.qualities.values()) == receiver.stream.samples
    assert [q for _, _, q in receiver.spells] == [Quality.FIXED, Quality.FLOAT, Quality.FIXED]
    begin, end, _ = receiver.spells[1]
    assert (end - begin) / S == pytest.approx(15.0, abs=0.5)
    assert accel.stream.usual_ns == pytest.approx(1e7, rel=1e-3)
    assert o.files == {path: ""}
    assert o.missing == 0
    assert o.kinds["START"] == 1


@pytest.mark.parametrize("harm", ["cut", "flipped", "empty"])
def test_bad_files_among_good_ones_are_named(hostile: tuple[SimRecord, Path], tmp_path: Path, harm: str) -> None:
    _, path = hostile
    data = bytearray(path.read_bytes())
    bad = tmp_path / "bad.mcap"
    if harm == "flipped":
        data[len(data) // 2] ^= 0x10
    bad.write_bytes(b"" if harm == "empty" else data[: len(data) // 2] if harm == "cut" else data)
    good = tmp_path / "good.mcap"
    good.write_bytes(path.read_bytes())
    o = overview([tmp_path])
    assert o.files[good] == ""
    if harm == "empty":
        assert o.files[bad] == "empty"
    elif harm == "flipped":
        assert "damaged" in o.files[bad]
    else:  # a torn tail is read up to its last whole chunk, and is no damage
        assert bad in o.files
    assert o.points["deck"].stream.samples > 20_000
    assert files_of([bad])[1] == ({bad: "empty"} if harm == "empty" else {})
    with pytest.raises(ReplayError, match=r"config\.yaml"):
        configuration([])


def test_envelopes_are_bounded_and_honest() -> None:
    rng = np.random.default_rng(1)
    e = Envelope(2, S, 100)
    t = np.cumsum(rng.integers(1, 3 * S, 5000)).astype(np.int64)
    x = rng.standard_normal((5000, 2))
    x[::7, 1] = np.nan
    for k in range(0, 5000, 311):
        e.add(t[k : k + 311], x[k : k + 311])
    middle, low, high, count = e.spans()
    assert 50 <= len(middle) <= 100
    assert count.sum() == 5000
    width = e.span_ns
    for i in (0, 17, len(middle) - 1):
        inside = t // width == middle[i] // width
        assert low[i] == pytest.approx(np.nanmin(x[inside], axis=0))
        assert high[i] == pytest.approx(np.nanmax(x[inside], axis=0))
    gap = Envelope(1, S, 100)
    gap.add(np.array([0, 10 * S]), np.array([1.0, np.nan]))
    middle, low, _, _ = gap.spans()
    assert len(middle) == 2  # nothing is drawn where nothing was
    assert np.isnan(low[1, 0])


def test_silences_have_reasons() -> None:
    s = Stream()
    t = np.arange(0, 100 * S, S // 10)
    s.add(t[:300])
    s.add(t[450:700])
    s.add(t[720:])
    o = Overview()
    o.happened.append(series.Happened(70 * S, 71 * S, 0, "LOSS", "can", "lost", {}, True))
    found = o.why(s, [(29 * S, 46 * S, "power")])
    assert [(round(x.begin_ns / S, 1), round(x.end_ns / S, 1), x.reason) for x in found] == [
        (29.9, 45.0, "power"),
        (69.9, 72.0, "LOSS"),
    ]
    assert s.covered_ns == 100 * S - S // 10 - sum(x.end_ns - x.begin_ns for x in found)


def test_review_imports_no_port_and_nothing_of_the_running_agent() -> None:
    for path in (ROOT / "edge_agent/review").glob("*.py"):
        names: set[str] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                names.add(node.module or "")
        assert not {n for n in names if n.startswith("drivers") or n.endswith(("runtime", "reading", "writing"))}, path
