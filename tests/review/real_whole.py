"""Whole real records through `import`, `replay` and `review`; minutes, so not among the tests: `make real`."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
import real_logs
from test_real_records import check_the_night, near, told


def test_the_whole_night_in_one_command(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """13.3 hours across midnight, quality 1/4/5 = 2/5908/40247, 1224 steps of more than a second."""
    packed = shared_data / "A3-rtklib-static-13h-nmea" / "test_nmea_27_05_clean.txt.gz"
    found = told(real_logs.night(shared_data, tmp_path), capsys)
    check_the_night(found, gzip.decompress(packed.read_bytes()).splitlines())
    assert found["receivers"]["rover"]["fixes_by_quality"] == {"SINGLE": 2, "FIXED": 5908, "FLOAT": 40247}


def test_the_whole_test_bridge(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frequencies = told(real_logs.bridge(shared_data, tmp_path), capsys)["points"]["deck"]["frequencies"]
    for freq_hz, within in ((10.79, 0.1), (13.60, 0.15), (16.26, 0.1)):
        assert near(frequencies, freq_hz) == pytest.approx(freq_hz, abs=within)


def test_the_whole_drive(shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = told(real_logs.car(shared_data, tmp_path), capsys)
    a = found["points"]["deck"]["agreement"]
    assert a["offset_by_speed_s"] == pytest.approx(3.37, abs=0.10)
    assert not a["mounting_observable"]
    assert "yaw between the sensors is not fixed" in found["findings"][0]
