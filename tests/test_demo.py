"""The demo's parts that need no 60 s: what it reads back, how it judges, what it draws, how it refuses."""

from __future__ import annotations

import dataclasses
import itertools
import math
import sys

import numpy as np
import pytest

from edge_agent import demo
from edge_agent.messages import Estimate, GnssFix, Innovation, Mode, Quality, Record, S, Verdict
from edge_agent.recording import topics
from edge_agent.recording.writer import SegmentWriter
from edge_agent.simulate import FixLabel, run
from edge_agent.simulate.encode import geodetic
from edge_agent.simulate.specs import START_NS

NAN3 = (math.nan, math.nan, math.nan)
ZERO3 = np.zeros(3)


@pytest.fixture(scope="module")
def record():
    return run(demo.scenario(), 4, 60.0)


@pytest.fixture(scope="module")
def files(record, tmp_path_factory):
    """Recordings of an agent that fuses with an error of exactly 1/1/2 mm sd, from 15 s on, and labels perfectly."""
    folder = tmp_path_factory.mktemp("recordings")
    rng = np.random.default_rng(0)
    sd = np.array([0.001, 0.001, 0.002])
    records: list[Record] = []

    def add(topic: str, t_ns: int, data: bytes) -> None:
        utc = t_ns + record.utc_offset_ns
        records.append(Record(topic, utc + 300_000_000, utc, data, True))

    t = record.accel.true_ns[1500:]
    truth = demo.truth_at(record, (t - START_NS) / S)
    for i in range(0, len(t), 10):
        s = slice(i, i + 10)
        n = len(t[s])
        d = truth[s] + rng.standard_normal((n, 3)) * sd
        two, u8 = np.tile(sd, (n, 1)), np.full(n, Mode.FUSED, np.uint8)
        made = Estimate("deck", t[s], d, d, two, two, u8, 0 * u8, ZERO3, ZERO3, ZERO3, ZERO3)
        add("/fusion/deck/block", int(t[i]), topics.fused_block(made, int(t[i]) + record.utc_offset_ns))
    llh = geodetic(record.fixes.z_m, record.scenario.reference_llh)
    for i, t_ns in enumerate(record.fixes.t_ns.tolist()):
        utc = t_ns + record.utc_offset_ns
        fix = GnssFix(
            t_ns, t_ns, utc, True, *llh[i], 0.0, Quality.FIXED, 9, 1.0, 1.0, 1.0, 1.0, "", NAN3, NAN3, ("GGA",)
        )
        add("/gnss/rover/solution", t_ns, topics.gnss_solution(fix, utc, record.fixes.z_m[i].tolist(), 0, "rover"))
        label = FixLabel(int(record.fixes.label[i]))
        verdict = {FixLabel.OUTLIER: Verdict.REJECTED, FixLabel.WRONG: Verdict.OFFSET}.get(label, Verdict.ACCEPTED)
        said = Innovation("deck", t_ns, ZERO3, np.eye(3), 0.5, verdict, 0, ZERO3, ZERO3)
        add("/fusion/deck/update", t_ns, topics.fusion_update(said, utc))
    records.sort(key=lambda r: r.log_ns)
    paths = []
    for k, part in enumerate((records[: len(records) // 2], records[len(records) // 2 :])):
        writer = SegmentWriter(folder / f"{k}.mcap.part", metadata={}, attachments={"a.txt": b"a"})
        for r in part:
            writer.add(r)
        paths.append(writer.close())
    return paths


def test_faults_are_where_the_story_needs_them():
    """After the start window, apart from each other, with room to see the return; and lorries on the deck in each."""
    spans = [(f.start_s, f.start_s + f.length_s) for f in (demo.OUTLIERS, demo.WRONG, demo.OUTAGE)]
    assert spans[0][0] > 22
    assert all(b[0] - a[1] >= 3 for a, b in itertools.pairwise(spans))
    assert spans[-1][1] <= 55
    truth = run(demo.scenario(), 1, 60.0)
    t = np.arange(0.0, 60.0, 0.01)
    z = demo.truth_at(truth, t)[:, 2]
    for begin, end in spans[1:]:
        assert np.ptp(z[(t > begin) & (t < end)]) > 0.015


def test_reads_back_what_the_agent_wrote_and_judges_it(files, record):
    seen = demo.read_back(files, record)
    assert len(seen.t_s) == len(record.accel.t_ns[1500:])
    assert len(seen.fix_t_s) == len(record.fixes.t_ns)
    assert demo.truth_at(record, seen.fix_t_s) == pytest.approx(
        seen.fix_m - (record.fixes.z_m - record.truth_at_fixes.d_m) @ rotation().T, abs=1e-6
    )
    figures = demo.judge(seen, record)
    assert figures.fused_rms_m == pytest.approx((0.001, 0.001, 0.002), rel=0.05)
    assert figures.good_rms_m == pytest.approx((0.003, 0.003, 0.006), rel=0.15)
    assert min(figures.raw_rms_m) > 0.03
    assert figures.within == pytest.approx((0.683, 0.954, 0.997), abs=0.02)
    labels = record.fixes.label[(record.fixes.t_ns - START_NS) / S >= 15]
    assert figures.rejected == figures.outliers == figures.caught == np.sum(labels == FixLabel.OUTLIER)
    assert figures.outliers >= 5
    assert figures.offset == np.sum(labels == FixLabel.WRONG)
    assert figures.better
    line = figures.line(1234, 2)
    assert "fused 1.0" in line
    assert "1234 bytes in 2 files" in line
    assert "\n" not in line
    bad = dataclasses.replace(seen, d_m=seen.d_m + 1.0)
    assert not demo.judge(bad, record).better


def rotation():
    """x along 60 deg from north, y 90 deg left of it."""
    a = math.radians(60.0)
    return np.array([[math.sin(a), math.cos(a), 0], [-math.cos(a), math.sin(a), 0], [0, 0, 1]])


def test_draws_a_picture(files, record, tmp_path):
    seen = demo.read_back(files, record)
    path = tmp_path / "demo.png"
    demo.draw(path, seen, record, demo.judge(seen, record))
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert len(data) > 50_000


def test_refuses_a_demo_that_is_too_short(tmp_path, capsys):
    assert demo.run_demo(tmp_path / "out", seconds=10.0) == 2
    assert "at least 25" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_says_what_the_agent_said_when_it_fails(tmp_path, capsys, monkeypatch):
    """GIVEN an agent that ends at once WHEN the demo runs THEN it gives up with the agent's own words."""
    fake = tmp_path / "python"
    fake.write_text("#!/bin/sh\necho no such thing as $4 >&2\nexit 1\n")
    fake.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(fake))
    assert demo.run_demo(tmp_path / "out") == 1
    error = capsys.readouterr().err
    assert "did not open its ports" in error
    assert "no such thing as -c" in error
    (folder,) = (tmp_path / "out").iterdir()
    assert sorted(p.name for p in folder.iterdir()) == ["accelerometers.dbc", "agent.log", "config.yaml"]


def test_configuration_is_valid(tmp_path, monkeypatch, capsys):
    from edge_agent import config

    monkeypatch.setattr(demo, "_live", lambda *a: None)
    assert demo.run_demo(tmp_path) == 1
    (folder,) = tmp_path.iterdir()
    made = config.load(folder / "config.yaml")
    assert made.record.rotate_s == 20
    assert made.receivers["rover"].latency_ms == pytest.approx(208)
    assert np.array(made.accelerometers["acc"].rotation) == pytest.approx(rotation(), abs=1e-8)
    assert made.data_dir == str(folder / "recordings")
