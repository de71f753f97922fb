"""Real recordings through `import`, `replay` and `review` as a user runs them: what the page's JSON twin says of them.

Whole records that take minutes are in `real_whole.py` (`make real`); here they are cut.
"""

from __future__ import annotations

import gzip
import json
import math
from collections import Counter
from datetime import UTC, datetime, timedelta
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import real_logs
from real_logs import Logs

from edge_agent.__main__ import main
from edge_agent.recording.reader import read_messages
from edge_agent.recording.topics import decode_fused_block

S = 1_000_000_000


def told(logs: Logs, capsys: pytest.CaptureFixture[str], *more: str) -> Any:
    """The JSON twin."""
    commands = logs.commands(*more)
    for command in commands:
        capsys.readouterr()
        assert main(command) == 0
    text = capsys.readouterr().out
    html = (logs.folder / "report.html").read_text()
    assert html.startswith("<!DOCTYPE html>")
    return json.loads(text)


def near(frequencies: list[dict[str, float]], freq_hz: float) -> float:
    """Of the frequencies at least 6 dB above the floor that nearest to one."""
    return min((f["freq_hz"] for f in frequencies if f["above_db"] >= 6), key=lambda f: abs(f - freq_hz))


def check_the_night(found: Any, lines: list[bytes]) -> None:
    """Fixes by quality, and when the quality changed, against the commas of the log."""
    names = {b"1": "SINGLE", b"2": "DGNSS", b"4": "FIXED", b"5": "FLOAT"}
    fields = [line.split(b",") for line in lines]
    rover = found["receivers"]["rover"]
    counts = Counter(names[f[5]] for f in fields)
    assert rover["fixes_by_quality"] == dict(counts)
    assert rover["fixes"] == len(lines)
    day = datetime(2015, 5, 27, tzinfo=UTC)
    rows: list[tuple[datetime, str]] = []
    for f in fields:
        clock = f[0].decode()
        at = day + timedelta(hours=int(clock[:2]), minutes=int(clock[2:4]), seconds=float(clock[4:]))
        if rows and at < rows[-1][0]:
            day, at = day + timedelta(days=1), at + timedelta(days=1)
        rows.append((at, names[f[5]]))
    changes = [(next(group)[0], quality) for quality, group in groupby(rows, key=lambda row: row[1])]
    said: list[tuple[datetime, str]] = []
    for spell in rover["quality_history"]:
        if not said or said[-1][1] != spell["quality"]:  # a silence ends a spell too
            said.append((datetime.fromisoformat(spell["begin_utc"]), spell["quality"]))
    assert [q for _, q in said] == [q for _, q in changes]
    assert max(abs((a - b).total_seconds()) for (a, _), (b, _) in zip(said, changes, strict=True)) < 0.01
    steps = np.array([(b - a).total_seconds() for (a, _), (b, _) in pairwise(rows)])
    assert len(rover["gaps"]) == (steps > 3.5).sum()


def test_the_earthquake_as_labelled_is_reported_as_a_contradiction_first(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs = real_logs.tohoku(shared_data, tmp_path)
    found = told(logs, capsys)
    a = found["points"]["deck"]["agreement"]
    assert a["verdict"] == "CONTRADICTION"
    assert a["offset_s"] == pytest.approx(43.0, abs=0.1)
    assert a["std_offset_s"] < 0.02
    assert not a["mounting_observable"]  # one axis does not tell a yaw
    assert a["offset_by_speed_s"] is None
    first = found["findings"][0]
    assert "contradict each other" in first
    assert "early" in first
    assert f"{a['offset_s']:.3f} s" in first
    html = (tmp_path / "report.html").read_text()
    trouble = html[html.index("What went wrong") :]
    assert trouble.index(first[:60]) == trouble.index("<li") + len('<li class="doubt">')
    cards = html[html.index('<div class="cards">') : html.index('<section id="summary">')]
    assert "in doubt: the sensors contradict each other" in cards  # no peak to peak that looks like a result
    section = html.split('<section id="agreement">')[1].split("</section>")[0]
    assert "contradict each other" in section
    assert "contradiction" in section
    assert not any("same motion" in c for c in found["conclusions"])


def test_the_shaker_has_its_modes_and_is_smoothed_to_a_tenth_of_a_millimetre(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One displacement a second as a fix whose sd of 0.1 mm is taken as it is; the record at 100 Hz is the truth."""
    logs, t, d = real_logs.shaker(shared_data, tmp_path)
    found = told(logs, capsys, "--smooth")
    frequencies = found["points"]["deck"]["frequencies"]
    assert near(frequencies, 0.525) == pytest.approx(0.525, abs=0.02)
    assert near(frequencies, 1.74) == pytest.approx(1.74, abs=0.04)
    midnight = int(datetime(2008, 2, 29, tzinfo=UTC).timestamp()) * S
    times, moved, said, live_t, live_d = [], [], [], [], []
    for m in read_messages(tmp_path / "fused.mcap"):
        if m.topic in ("/fusion/deck/smoothed", "/fusion/deck/block"):
            e = decode_fused_block("deck", m.data)
            into_t, into_d = (times, moved) if m.topic.endswith("smoothed") else (live_t, live_d)
            into_t.append(e.t_ns - int(e.t_ns[0]) + m.publish_ns - midnight)
            into_d.append(e.displacement_m[:, 0])
            if m.topic.endswith("smoothed"):
                said.append(e.std_displacement_m[:, 0])
    k = np.rint((np.concatenate(times) / S - t[0]) * 100).astype(int)
    error = np.concatenate(moved) - d[k]
    late = k > 6000
    live = np.concatenate(live_d) - d[np.rint((np.concatenate(live_t) / S - t[0]) * 100).astype(int)]
    sd = float(np.concatenate(said)[late].mean())
    print(
        f"smoothed {1e3 * error[late].std():.4f} mm of {1e3 * d.std():.3f} mm, live {1e3 * live.std():.3f} mm; sd {sd}"
    )
    assert len(k) > 0.95 * len(d)
    assert error[late].std() <= 0.10e-3
    assert sd == pytest.approx(0.1315e-3, rel=0.03)  # with the variance of the fixes learnt as well it is 0.1438 mm
    assert live.std() > error.std()


def test_the_test_bridge_shows_its_peaks(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = told(real_logs.bridge(shared_data, tmp_path, samples=30_000), capsys)
    frequencies = found["points"]["deck"]["frequencies"]
    for freq_hz, within in ((10.79, 0.1), (13.60, 0.15), (16.26, 0.1)):
        assert near(frequencies, freq_hz) == pytest.approx(freq_hz, abs=within)
    assert all(f["axes"] == "z" for f in frequencies)  # the other two are nothing
    assert any("accelerometer only: vibration" in c for c in found["conclusions"])


def test_a_turning_car_has_a_clock_and_no_fixed_yaw(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GNSS second of day = ms/1000 + 70196.593 + 3.37 +- 0.10 by the speeds that the receiver told. By its positions it
    is 3.22: its speed is that over the epoch before, so half an epoch of 0.25 s late; 3.37 - 0.125 = 3.245."""
    found = told(real_logs.car(shared_data, tmp_path, until_s=300.0), capsys)
    a = found["points"]["deck"]["agreement"]
    assert a["verdict"] == "CONTRADICTION"
    assert a["offset_by_speed_s"] == pytest.approx(3.37, abs=0.10)
    assert a["offset_s"] == pytest.approx(3.245, abs=0.05)
    assert not a["mounting_observable"]
    assert a["yaw_deg"] is None
    assert "yaw between the sensors is not fixed" in found["findings"][0]
    assert f"{a['offset_by_speed_s']:.3f} s" in found["findings"][0]
    html = (tmp_path / "report.html").read_text()
    assert "the yaw between the sensors is not fixed" in html
    assert math.isfinite(a["std_offset_s"])


def test_a_night_keeps_its_quality_history(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Around midnight, with float, fixed and gaps."""
    packed = shared_data / "A3-rtklib-static-13h-nmea" / "test_nmea_27_05_clean.txt.gz"
    first, last = 29_000, 35_000
    found = told(real_logs.night(shared_data, tmp_path, first, last), capsys)
    check_the_night(found, gzip.decompress(packed.read_bytes()).splitlines()[first:last])
