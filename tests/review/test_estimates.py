"""What a recording says of noise, clocks and headings, from pieces whose statistics are known."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.stats import chi2

from edge_agent import assemble
from edge_agent.messages import HeadingEstimate, Raw, S, Tick, Verdict
from edge_agent.recording import topics
from edge_agent.recording.reader import Stored
from edge_agent.replay import recorded_config
from edge_agent.review import panels_estimates
from edge_agent.review.estimates import BINS, KEPT, Estimates, Track, chi2_3, wrapped
from edge_agent.review.figures import as_json
from edge_agent.review.gather import gather
from edge_agent.review.learned import Learned, learned
from edge_agent.review.panels_estimates import honest_words
from edge_agent.review.series import Judged, Piece
from edge_agent.review.sources import copies, differences, setups, together
from edge_agent.simulate import SCENARIOS, run
from edge_agent.simulate.files import write_files
from edge_agent.verify import File

F64 = npt.NDArray[np.float64]
BEGIN = 1_780_300_800 * S


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("estimates")
    write_files(run(SCENARIOS["clean"], 1, 3.0), folder)
    return folder / "raw.mcap"


def judged(residual: F64, std: F64, limit: float) -> Judged:
    n = len(residual)
    t = BEGIN + np.arange(n) * (S // 10)
    ratio = ((residual / std) ** 2).sum(axis=1) / limit
    verdict = np.where(ratio > 1, Verdict.REJECTED, Verdict.ACCEPTED).astype(np.uint8)
    return Judged(t, t, residual, std, 0.9 * std, np.zeros((n, 3)), ratio, verdict)


def piece(**parts: object) -> Piece:
    return replace(Piece(Path("x.mcap"), "run", False, {}, {}, {}, {}, []), **parts)  # type: ignore[arg-type]


def test_chi2_is_scipys() -> None:
    x = np.array([0.0, 0.01, 0.5, 2.366, 7.8, 16.27, 60.0])
    assert np.allclose(chi2_3(x), chi2.cdf(x, 3), atol=1e-12)


@pytest.mark.parametrize(
    ("size", "memory", "word"), [(1.0, 0.0, "honest"), (1.5, 0.0, "too sure"), (0.7, 0.0, "careful")]
)
def test_innovations_are_held_against_chi_square(raw: Path, size: float, memory: float, word: str) -> None:
    e = Estimates(recorded_config(raw))
    assert e.limit == pytest.approx(chi2.isf(0.001, 3), rel=1e-6)
    rng = np.random.default_rng(3)
    std = np.full((600, 3), 0.004)
    for _ in range(10):
        e.add(piece(judged={"deck": judged(size * std * rng.standard_normal((600, 3)), std, e.limit)}))
    g = e.gated["deck"]
    assert g.count == 6000
    assert g.chance.sum() == 6000
    assert word in honest_words(g)
    assert np.abs(g.whiteness).max() < 0.05
    assert np.sqrt(g.used / g.accepted) == pytest.approx(0.0036)
    if size == 1.0:
        assert abs(g.mean_nis - 1.0) < 4 * g.std_nis + 0.01  # the refused ones are missing
        assert np.abs(g.chance - 6000 / BINS).max() < 4.5 * math.sqrt(6000 / BINS)
    times, values = g.nis.columns()
    assert len(times) == 10
    assert values.mean() == pytest.approx(g.mean_nis, rel=0.01)


def test_coloured_innovations_are_named(raw: Path) -> None:
    e = Estimates(recorded_config(raw))
    x = np.random.default_rng(5).standard_normal((4000, 3))
    x[1:, 1] = 0.8 * x[:-1, 1] + 0.6 * x[1:, 1]
    std = np.full((4000, 3), 0.003)
    e.add(piece(judged={"deck": judged(0.9 * std * x, std, e.limit)}))
    assert e.gated["deck"].whiteness[1] > 0.4
    assert "alike in y " in honest_words(e.gated["deck"])


def test_a_track_is_bounded_and_keeps_its_mean() -> None:
    track = Track()
    values = np.random.default_rng(1).standard_normal(10 * KEPT)
    for k, v in enumerate(values.tolist()):
        track.add(k * S, np.array([v]), 3)
    assert len(track.rows) <= KEPT
    n = sum(n for _, _, n in track.rows)
    assert n >= 3 * 9.9 * KEPT
    assert sum(v[0] * n for _, v, n in track.rows) / n == pytest.approx(values.mean(), abs=0.01)


def test_headings_and_ticks_are_read_as_recorded(raw: Path) -> None:
    e = Estimates(recorded_config(raw))
    noted = []
    for k in range(1200):
        t = 10**12 + k * S // 10
        h = (359.9 + 0.0004 * k) % 360.0  # over north
        said = HeadingEstimate(t, h, 0.02, (h + 0.1) % 360.0, 0.1, 0.0, 2.0, 0.5 if k % 40 else 3.0,
                               Verdict.ACCEPTED if k % 40 else Verdict.REJECTED)  # fmt: skip
        utc = BEGIN + k * S // 10
        noted.append(Stored("/fusion/deck/heading", topics.HEADING, utc, utc, k, topics.heading(said, utc)))
    for k in range(120):
        t = 10**12 + k * S
        tick = Tick(BEGIN + k * S + k * 20_000, k % 2 == 0, 3_000_000)  # UTC runs 20 ppm faster
        record = topics.raw_record(Raw(t, k, "clock", tick), BEGIN + k * S)
        noted.append(Stored(record.topic, topics.TICK, record.log_ns, record.publish_ns, k, record.data))
    e.add(piece(noted=noted))
    h = e.headed["deck"]
    assert h.verdicts == {int(Verdict.ACCEPTED): 1170, int(Verdict.REJECTED): 30}
    assert h.baseline_m == 2.0
    assert h.mean_nis == pytest.approx(0.5 * chi2.isf(0.001, 1), rel=1e-5)
    low, high = h.estimate.spans()[1:3]
    assert float(np.nanmax(high) - np.nanmin(low)) == pytest.approx(0.0004 * 1199, abs=1e-6)
    assert h.last_deg == pytest.approx((359.9 + 0.0004 * 1199) % 360.0)
    clock = e.clocks["run"]
    assert clock.ticks == 120
    assert clock.synchronised == 60
    assert clock.error_s == pytest.approx(0.003)
    assert clock.rate_ppm() == pytest.approx(20.0, abs=0.01)
    assert wrapped(np.array([180.0, -180.0, 359.0, -359.0])).tolist() == [180.0, 180.0, -1.0, 1.0]


def test_the_head_of_a_segment_tells_what_was_learned(raw: Path) -> None:
    config = recorded_config(raw)
    pipeline = assemble.pipeline(config)
    pipeline.station.q[0] = (1e-6, 2e-6, 3e-6)
    head = learned(pipeline, BEGIN)
    assert head.points["deck"][0].tolist() == [1e-6, 2e-6, 3e-6]
    pipeline.station.q[0] = 7.0  # what was told stays
    assert head.points["deck"][0][0] == 1e-6
    assert head.latencies["rover"][1] in ("assumed", "configured", "learned")


def test_the_page_shows_headings_clocks_and_noise(raw: Path) -> None:
    """A recording without an estimate, then what a long run with two antennas would have told."""
    r = gather([raw])
    assert panels_estimates.headings(r) == ""
    assert "no fix came to the gate" in panels_estimates.honesty(r)
    rover = replace(r.config.receivers["rover"], heading=True)
    r = replace(r, config=replace(r.config, receivers={"rover": rover}))
    assert "none is in these files" in panels_estimates.headings(r)
    noted = []
    for k in range(600):
        h = (359.9 + 0.0004 * k) % 360.0
        utc = BEGIN + k * S // 10
        said = HeadingEstimate(k * S // 10, h, 0.02, h + 0.05, 0.1, 0.0, 2.0, 0.4, Verdict.ACCEPTED)
        noted.append(Stored("/fusion/deck/heading", topics.HEADING, utc, utc, k, topics.heading(said, utc)))
    std = np.full((6000, 3), 0.004)
    gate = judged(2.0 * std * np.random.default_rng(2).standard_normal((6000, 3)), std, r.estimates.limit)
    r.estimates.add(piece(noted=noted, judged={"deck": gate}))
    r.estimates.heads = [
        Learned(
            BEGIN + k * 3600 * S, {"deck": (np.full(3, 1e-6), np.full(3, 1e-9), np.full(3, 1.5))}, {"acc": 3e-6}, {}
        )
        for k in range(4)
    ]
    html = panels_estimates.headings(r)
    assert "0.140 \u00b1 0.020" in html
    assert "accepted 600 (100 %)" in html
    assert html.count("<figure") == 1
    assert "too sure of itself" in panels_estimates.honesty(r)
    noise = panels_estimates.noise(r)
    assert "the last of 4 files" in noise
    assert noise.count("at the heads of the files</b>") == 3
    assert "1e-06 / 1e-06 / 1e-06" in noise
    assert "+3.0 ppm in the state of the last file" in panels_estimates.clocks(r)
    twin = as_json(r)["points"]["deck"]
    assert twin["heading"]["last_deg"] == pytest.approx(0.1396, abs=1e-4)
    assert twin["innovations"]["verdict"].startswith("too sure")


# ------------------------------------------------------------------------------------------------------------- sources


def file(name: str, run_id: str, order: int, last: int, messages: int, begin: int = 5, state: str = "complete") -> File:
    return File(
        Path(name), run={"run": run_id}, state=state, messages=messages, begin_ns=begin, order=order, last_order=last
    )


def test_copies_are_found_by_the_blocks_that_they_hold() -> None:
    whole = [file("a0", "a", 0, 99, 100), file("a1", "a", 100, 199, 100)]
    assert copies(whole) == {}
    again, torn = file("b0", "a", 0, 99, 100), file("cut", "a", 100, 150, 40, state="open")
    assert copies([*whole, again, torn]) == {Path("b0"): Path("a0"), Path("cut"): Path("a1")}
    clip = file("clip", "a", 80, 120, 30)  # over the border of two segments
    assert copies([*whole, clip]) == {Path("clip"): Path("a0")}
    assert copies([whole[0], clip]) == {}  # the second half is in no other file
    assert copies([whole[0], file("other run", "b", 0, 99, 100)]) == {}
    nameless = [file("x", "", 0, 99, 100, 7), file("y", "", 0, 99, 90, 7), file("z", "", 0, 99, 90, 8)]
    assert copies(nameless) == {Path("y"): Path("x")}
    assert copies([*whole, file("empty", "a", -1, -1, 0)]) == {}


def test_configurations_and_what_differs(raw: Path, tmp_path: Path) -> None:
    write_files(run(SCENARIOS["P3"], 1, 3.0), tmp_path / "other")
    other = tmp_path / "other" / "raw.mcap"
    (tmp_path / "same.mcap").write_bytes(raw.read_bytes())
    (tmp_path / "empty.mcap").touch()
    found = setups([raw, other, tmp_path / "same.mcap", tmp_path / "empty.mcap"])
    assert [s.files for s in found] == [[raw, tmp_path / "same.mcap"], [other]]
    told = dict(differences(found))
    assert told["site"] == ["simulated-clean", "simulated-P3"]
    assert all(len(set(values)) == 2 for values in told.values())
    assert differences(found[:1]) == []
    extra = replace(found[1].config, points={"more": found[1].config.points["deck"]})
    both = together(found[0].config, [found[0], replace(found[1], config=extra)])
    assert set(both.points) == {"deck", "more"}
    assert both.site == "simulated-clean"
