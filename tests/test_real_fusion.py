"""Real motion through the whole path with default settings: an earthquake, a shaker, a night across midnight.

The configuration sets ports, axes and units; everything else is what an engineer gets who changes nothing.
"""

from __future__ import annotations

import datetime
import gzip
from pathlib import Path

import numpy as np
import pytest
import real_encode
from oracles import dense_smoother

from edge_agent.__main__ import main
from edge_agent.messages import Mode, S, Verdict
from edge_agent.recording.reader import read_messages
from edge_agent.recording.topics import decode, decode_fused_block
from edge_agent.replay import replay

# Maximum likelihood of the 257 s of the earthquake in which both sensors speak, by the innovations of a three-state
# filter over log q, log r, log qb (Nelder-Mead from three starts, equal to three digits): the fixes scatter by 2.7 mm,
# not by the 17.4 mm declared.
TOHOKU_Q, TOHOKU_SIGMA, TOHOKU_QB = 3.02e-7, 2.68e-3, 9.5e-10
BOTH = (20_803.0, 21_059.0)
"""Seconds of day from the first acceleration to the last fix."""


@pytest.fixture(scope="module")
def smoothed(shared_data: Path) -> tuple[np.ndarray, np.ndarray]:
    """Time and displacement of the earthquake by RTS at 50 Hz, from one least-squares problem."""
    both = real_encode.tohoku(shared_data).cut(*BOTH)
    inside = both.t_a[(both.t_a >= both.t_z[0]) & (both.t_a <= both.t_z[-1])][::2]
    s = dense_smoother(both.t_a, both.a, both.t_z, both.z, TOHOKU_SIGMA, TOHOKU_Q, TOHOKU_QB, extra_t=inside)
    return s.t, s.x[:, 0]


def test_the_smoother_finds_the_published_earthquake(smoothed: tuple[np.ndarray, np.ndarray]) -> None:
    t, d = smoothed
    assert d.max() == pytest.approx(2.587, abs=0.001)
    assert d[t > BOTH[1] - 20].mean() == pytest.approx(1.785, abs=0.005)


@pytest.mark.parametrize("whole", [True, False], ids=["whole record", "both sensors"])
def test_an_earthquake_is_followed(shared_data: Path, smoothed: tuple[np.ndarray, np.ndarray], whole: bool) -> None:
    """Whole record: the accelerometer begins 43 s late and goes on 43 s after the last fix."""
    record = real_encode.tohoku(shared_data)
    record = record if whole else record.cut(*BOTH)
    live = real_encode.run(record)
    used = (live.t >= record.begin + 60) & (live.t <= BOTH[1])
    t, d = live.t[used], live.d[used, 0]
    assert len(t) > 0.99 * 100 * (BOTH[1] - record.begin - 60)
    error = d - np.interp(t, *smoothed)
    assert np.sqrt((error**2).mean()) < 0.006
    assert np.abs(error).max() < 0.030
    assert d.max() == pytest.approx(2.587, abs=0.025)
    assert d[-1] == pytest.approx(1.785, abs=0.010)
    assert d[t > BOTH[1] - 10].mean() == pytest.approx(1.785, abs=0.010)
    assert np.abs(live.d[used, 1:]).max() < 0.001
    assert (live.mode[used] == Mode.FUSED).all()
    kinds = {kind for kind, _ in live.events}
    assert {"REFERENCE", "START"} <= kinds
    assert not kinds & {"JUMP_OPEN", "JUMP_LEVEL", "JUMP_CLOSED", "DATUM", "REACQUIRE", "GNSS_TIME_STEP"}
    assert Verdict.OFFSET not in live.verdicts
    assert live.verdicts.count(Verdict.REJECTED) <= 2
    if whole:  # behind the last fix nothing holds the displacement: it must say so
        assert live.t[-1] > BOTH[1] + 42
        assert live.mode[-1] == Mode.INVALID
        assert live.std[-1, 0] > 0.05


def test_an_earthquake_that_its_labels_put_43_s_apart_is_not_followed(
    shared_data: Path, smoothed: tuple[np.ndarray, np.ndarray]
) -> None:
    """The control: with the accelerations where their labels say, the same figures are out of reach."""
    record = real_encode.tohoku(shared_data)
    wrong = real_encode.Record(record.midnight_ns, record.t_z, record.z, record.sigma, record.t_a - 43.0, record.a)
    live = real_encode.run(wrong)
    used = (live.t >= record.begin + 60) & (live.t <= BOTH[1])
    error = live.d[used, 0] - np.interp(live.t[used], *smoothed)
    assert np.sqrt((error**2).mean()) > 0.012


@pytest.mark.parametrize(("noise_m", "limit_m"), [(0.0, 0.25e-3), (1e-3, 0.9e-3)], ids=["as recorded", "1 mm noise"])
def test_a_shaker_is_followed_between_the_fixes(shared_data: Path, noise_m: float, limit_m: float) -> None:
    record, truth = real_encode.shaker(shared_data, noise_m, seed=1)
    live = real_encode.run(record)
    used = live.t >= record.begin + 60
    error = live.d[used, 0] - np.interp(live.t[used], record.t_a, truth)
    assert len(error) > 34_900
    assert error.std() <= limit_m
    assert np.abs(live.d[used, 1:]).max() < 0.001
    assert (live.mode[used] == Mode.FUSED).all()
    assert set(live.verdicts) <= {Verdict.START, Verdict.ACCEPTED}


def test_an_imported_night_crosses_midnight_without_a_jump(shared_data: Path, tmp_path: Path) -> None:
    packed = shared_data / "A3-rtklib-static-13h-nmea" / "test_nmea_27_05_clean.txt.gz"
    lines = [b"$GPGGA," + line for line in gzip.decompress(packed.read_bytes()).splitlines(keepends=True)]
    lines = lines[25_000:36_000]  # 1.2 h before midnight to 1.9 h after it; the receiver is fixed from 0.6 h on
    tod = np.array([int(line[7:9]) * 3600 + int(line[9:11]) * 60 + int(line[11:13]) for line in lines])
    midnight = int(np.flatnonzero(np.diff(tod) < 0)[0]) + 1
    assert 3600 < midnight < len(lines) - 3600
    (tmp_path / "night.nmea").write_bytes(b"".join(lines))
    (tmp_path / "site.yaml").write_text(
        "site: night\ndata_dir: recordings\n"
        "ports:\n  gnss: {kind: serial, device: /dev/ttyUSB0}\n"
        "receivers:\n  rover: {port: gnss}\npoints:\n  roof: {receiver: rover}\n"
    )
    raw, out = tmp_path / "raw.mcap", tmp_path / "out.mcap"
    command = ["import", "-c", str(tmp_path / "site.yaml"), "--nmea", f"gnss={tmp_path / 'night.nmea'}"]
    assert main([*command, "--date", "2015-05-27", "-o", str(raw)]) == 0
    replay([raw], out, None, verify=False)
    t_ns, utc, stamps, fused = [], [], [], []
    for message in read_messages(out):
        if message.topic == "/gnss/rover/solution":
            fix = decode(message.schema, message.data)
            t_ns.append(fix["monotonic_ns"])
            utc.append(fix["gnss_utc_ns"])
            stamps.append(fix["header"]["stamp"]["sec"] * S + fix["header"]["stamp"]["nanosec"])
        elif message.topic == "/fusion/roof/block":
            fused += decode_fused_block("roof", message.data).t_ns.tolist()
    assert len(lines) - 1 <= len(utc) <= len(lines)  # the last epoch may still be open
    days = np.concatenate([[0], np.cumsum(np.diff(tod) < 0)])
    assert days[-1] == 1
    day = int(datetime.datetime(2015, 5, 27, tzinfo=datetime.UTC).timestamp())
    assert utc == ((day + tod + 86_400 * days) * S).tolist()[: len(utc)]
    assert (np.diff(t_ns) > 0).all()
    assert np.abs(np.diff(t_ns) - np.diff(utc)).max() < 1_000_000
    assert np.abs(np.array(stamps) - np.array(utc)).max() < 1_000_000
    before, after = (datetime.datetime.fromtimestamp(utc[i] // S, datetime.UTC) for i in (midnight - 1, midnight))
    assert (before.date().isoformat(), after.date().isoformat()) == ("2015-05-27", "2015-05-28")
    assert len(fused) > 3_000
    assert (np.diff(fused) > 0).all()
