"""The simulator: exact truth, the stated noise, the stated faults, the same bytes from the same seed."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import termios
import threading
import time

import numpy as np
import pytest
from live import PATIENCE_S, until
from oracles import accel_q, dense_smoother, riccati_bound, smoothed_bound

from edge_agent.messages import CanFrames, GnssFix, S, Tick
from edge_agent.simulate import (
    SCENARIOS,
    Accel,
    Fault,
    FixLabel,
    Gnss,
    Ramp,
    Scenario,
    Structure,
    oracle,
    run,
    simulate,
)
from edge_agent.simulate.encode import can_frames, config_yaml, dbc_text, geodetic, nmea_bursts, nmea_epoch, raw_blocks
from edge_agent.simulate.files import write_files
from edge_agent.simulate.play import Slcan, Terminal, play, serial_schedule, slcan_schedule, socketcan_schedule
from edge_agent.simulate.specs import GRAVITY_MPS2, START_NS


def arrays(x):
    """Every array of a record, depth first."""
    if isinstance(x, np.ndarray):
        yield x
    elif isinstance(x, tuple):
        for y in x:
            yield from arrays(y)
    elif dataclasses.is_dataclass(x):
        for f in dataclasses.fields(x):
            yield from arrays(getattr(x, f.name))


@pytest.mark.parametrize("name", [n for n in SCENARIOS if n != "P2"])
def test_truth_is_consistent(name):
    """The second integral of a and the first of v are d, far below 0.01 mm, with ramps, modes and impacts."""
    record = simulate(name, 3, 100.0)
    step = S // 4000
    t = START_NS + np.arange(0, 100 * S, step)
    truth = record.motion.at(t)
    h = step / S

    def integral(y):  # Simpson over pairs of steps
        return np.cumsum(h / 3 * (y[:-2:2] + 4 * y[1:-1:2] + y[2::2]), axis=0)

    assert np.abs(truth.v_mps[2::2] - truth.v_mps[0] - integral(truth.a_mps2)).max() < 1e-8
    assert np.abs(truth.d_m[2::2] - truth.d_m[0] - integral(truth.v_mps)).max() < 1e-8
    assert np.abs(truth.d_m).max() > 1e-3


def test_truth_between_nodes_is_what_the_sensors_see():
    record = simulate("P0", 2, 20.0)
    for track, truth in zip(record.accels, record.truths, strict=True):
        again = record.motion.at(track.true_ns)
        assert np.array_equal(again.d_m, truth.d_m)
    with pytest.raises(ValueError, match="outside"):
        record.motion.at(np.array([START_NS + 30 * S]))


def test_modes_have_the_stated_size_and_frequency():
    structure = Structure(modes=SCENARIOS["clean"].structure.modes)
    rms = np.zeros(3)
    for seed in range(4):
        record = run(Scenario("modes", structure, None, (Accel(),)), seed, 600.0)
        rms += record.truth.d_m.var(axis=0) / 4
    expected = np.array([math.hypot(0.006, 0.002), math.hypot(0.004, 0.0015), math.hypot(0.003, 0.001)])
    assert np.sqrt(rms) == pytest.approx(expected, rel=0.25)  # 4 x 600 s of a mode with 1 % damping: sd about 9 %
    power = np.abs(np.fft.rfft(record.truth.a_mps2[:60000, 0])) ** 2
    f = np.fft.rfftfreq(60000, 0.01)
    low, high = (f > 0.3) & (f < 1.0), (f > 1.2) & (f < 2.5)
    assert f[low][power[low].argmax()] == pytest.approx(0.5, rel=0.02)
    assert f[high][power[high].argmax()] == pytest.approx(1.7, rel=0.02)


def test_ramp_ends_where_it_says_and_slides_evenly():
    structure = Structure(ramps=(Ramp(10.0, 60.0, (0.01, 0.0, -0.02), smooth_s=0.5),))
    motion = run(Scenario("ramp", structure, Gnss(), ()), 1, 100.0).motion
    truth = motion.at(START_NS + np.array([10, 40, 70, 99]) * S)
    assert truth.d_m[:, 0] == pytest.approx([0, 0.005, 0.01, 0.01], abs=1e-12)
    assert truth.d_m[:, 2] == pytest.approx([0, -0.01, -0.02, -0.02], abs=1e-12)
    assert truth.v_mps[1, 0] == pytest.approx(0.01 / 59.5)


def test_noise_densities():
    record = simulate("clean", 5, 900.0)
    noise = record.accel.xyz - record.truth.a_mps2 - [0, 0, GRAVITY_MPS2]
    assert noise.var(axis=0) / 100.0 == pytest.approx(accel_q(5e-4), rel=0.03)
    assert np.abs(np.corrcoef(noise[1:, 0], noise[:-1, 0])[0, 1]) < 0.02  # white
    error = record.fixes.z_m - record.truth_at_fixes.d_m
    assert error.std(axis=0) == pytest.approx([0.003, 0.003, 0.006], rel=0.04)
    assert record.fixes.std_m[0] == pytest.approx([0.003, 0.003, 0.006])
    assert np.array_equal(record.fixes.arrival_ns, record.fixes.t_ns)


def test_multipath_is_gauss_markov():
    gnss = Gnss(rate_hz=1.0, sigma_m=(1e-9,) * 3, multipath_m=(0.01, 0.01, 0.02), multipath_s=20.0)
    record = run(Scenario("mp", Structure(), gnss, ()), 7, 14000.0)
    z = record.fixes.z_m
    assert z.std(axis=0) == pytest.approx([0.01, 0.01, 0.02], rel=0.1)
    for lag in (5, 20):
        r = np.mean(z[lag:] * z[:-lag], axis=0) / np.mean(z * z, axis=0)
        assert r == pytest.approx(np.full(3, math.exp(-lag / 20)), abs=0.1)


def test_counts_of_gnss_faults():
    record = simulate("floaty", 11, 3600.0)
    fixes = record.fixes
    total = 36001
    assert len(fixes.t_ns) / total == pytest.approx(0.90, abs=0.01)
    outlier = fixes.label == FixLabel.OUTLIER
    assert outlier.mean() == pytest.approx(0.05, abs=0.005)
    size = np.linalg.norm(fixes.offset_m[outlier], axis=1)
    assert 0.03 <= size.min() < 0.06
    assert 0.9 < size.max() <= 1.0
    assert np.sum(fixes.quality == 5) == pytest.approx(20 * 150 * 0.9, rel=0.05)
    # wrong fixes: levels, each with one offset of 2 to 30 cm, 20 an hour
    wrong = fixes.label == FixLabel.WRONG
    levels = np.unique(fixes.offset_m[wrong], axis=0)
    assert 17 <= len(levels) <= 21
    size = np.linalg.norm(levels, axis=1)
    assert size.min() >= 0.02
    assert size.max() <= 0.30
    for level in levels:
        t = fixes.t_ns[wrong][(fixes.offset_m[wrong] == level).all(axis=1)]
        assert t[-1] - t[0] <= 60 * S
    latency = (fixes.arrival_ns - fixes.t_ns) / S
    assert latency.min() >= 0.18 - 1e-9
    assert latency.max() <= 0.22 + 1e-9
    assert np.all(np.diff(fixes.arrival_ns) > 0)


def test_scheduled_faults_quantisation_and_declared_sigma():
    faults = (
        Fault("outage", 10.0, 5.0),
        Fault("wrong", 20.0, 10.0, (0.08, 0.0, 0.0)),
        Fault("datum", 50.0, 0.0, (0.0, 0.05, 0.0)),
        Fault("outliers", 40.0, 2.0, (1.0, 0.0, 0.0)),
    )
    gnss = Gnss(declared=2.0, minute_decimals=5, height_decimals=2, faults=faults)
    record = run(Scenario("s", Structure(), gnss, ()), 1, 60.0)
    f = record.fixes
    t = (f.t_ns - START_NS) / S
    assert not np.any((t >= 10) & (t < 15))
    assert np.array_equal(f.label[(t >= 20) & (t < 30)], np.full(100, FixLabel.WRONG))
    assert np.sum(f.label == FixLabel.OUTLIER) == 20
    assert f.offset_m[t >= 50] == pytest.approx(np.broadcast_to([0, 0.05, 0], (101, 3)))
    assert f.std_m[0] == pytest.approx([0.006, 0.006, 0.012])
    north = np.unique(f.z_m[:, 1])
    assert np.diff(north).min() == pytest.approx(1852e-5, rel=1e-3)
    assert np.diff(np.unique(f.z_m[:, 2])).min() == pytest.approx(0.01, rel=1e-3)
    clean = oracle(record)
    assert not np.any(clean.fixes.label == FixLabel.OUTLIER)
    assert len(clean.fixes.t_ns) == len(f.t_ns) - 20
    error = clean.fixes.z_m - clean.truth_at_fixes.d_m
    before = (clean.fixes.t_ns - START_NS) / S < 50
    assert np.abs(error[before]).max() < 0.05  # the wrong fix is gone, noise and steps of the decimals stay
    assert error[~before, 1].mean() == pytest.approx(0.05, abs=0.005)  # the datum step is real to every filter


def test_accelerometer_faults():
    base = Accel(noise=1e-6, gravity=False)
    still = Structure(ramps=(Ramp(2.0, 4.0, (0.5, 0.0, 0.0)),))

    def track(**change):
        return run(Scenario("a", still, None, (dataclasses.replace(base, **change),)), 1, 100.0)

    plain = track()
    a = plain.truth.a_mps2
    assert track(scale=0.01).accel.xyz[:, 0] == pytest.approx(1.01 * a[:, 0], abs=1e-4)
    turned = track(misalignment_deg=(0.0, 0.0, 1.0)).accel.xyz
    assert turned[:, 1] == pytest.approx(math.sin(math.radians(1)) * a[:, 0], abs=1e-4)
    tilted = track(tilt_per_m=(0.01, 0.0, 0.0)).accel.xyz[-1, 0]
    assert tilted == pytest.approx(-GRAVITY_MPS2 * 0.01 * 0.5, abs=1e-4)
    lsb = track(lsb_mps2=0.01).accel.xyz
    assert np.abs(lsb / 0.01 - np.rint(lsb / 0.01)).max() < 1e-6
    assert np.abs(track(range_mps2=0.05).accel.xyz).max() == 0.05
    biased = track(bias_mps2=(0.02, 0.05), bias_walk=1e-8, temperature_mps2=1e-3)
    assert np.all((np.abs(biased.accel.bias_mps2[0]) > 0.018) & (np.abs(biased.accel.bias_mps2[0]) < 0.052))
    assert biased.accel.xyz - biased.accel.bias_mps2 == pytest.approx(a, abs=1e-4)
    walk = run(Scenario("w", still, None, (dataclasses.replace(base, bias_walk=1e-8),)), 1, 2000.0).accel.bias_mps2
    assert np.diff(walk, axis=0).var() * 100 == pytest.approx(1e-8, rel=0.05)
    moved = track(clock_offset_s=0.1, clock_ppm=20.0)
    assert moved.accel.t_ns[0] - moved.accel.true_ns[0] == 100_000_000
    drift = (moved.accel.t_ns - moved.accel.true_ns)[-1] - 100_000_000
    assert drift == pytest.approx(20e-6 * 100 * S, rel=1e-3)
    lossy = track(drop_share=0.01, duplicate_share=0.02, late_share=0.01, jitter_s=0.002, gaps=((50.0, 3.0),)).accel
    missing = set(range(10001)) - set(lossy.count.tolist())
    assert set(range(5000, 5300)) <= missing
    assert len(missing) - 300 == pytest.approx(97, abs=35)
    assert lossy.duplicate.sum() == pytest.approx(194, abs=50)
    assert np.all(np.diff(lossy.arrival_ns) > 0)
    assert np.max(lossy.arrival_ns - lossy.true_ns) > 30_000_000
    assert plain.accel.xyz[-1, 2] == pytest.approx(0, abs=1e-4)
    assert track(gravity=True).accel.xyz[-1, 2] == pytest.approx(GRAVITY_MPS2, abs=1e-4)


def test_same_seed_same_bytes_and_faults_leave_the_rest_alone():
    one, two, other = (list(arrays(simulate("floaty", s, 60.0))) for s in (4, 4, 5))
    assert all(x.tobytes() == y.tobytes() for x, y in zip(one, two, strict=True))
    assert any(x.tobytes() != y.tobytes() for x, y in zip(one, other, strict=True))
    rough, hostile = simulate("rough", 4, 300.0), simulate("hostile", 4, 300.0)
    assert np.array_equal(rough.truth.d_m, hostile.truth.d_m)
    good = hostile.fixes.label != FixLabel.WRONG
    assert np.array_equal(rough.fixes.z_m[good], hostile.fixes.z_m[good])


def test_unknown_names_and_lengths_are_refused():
    with pytest.raises(ValueError, match=r"there are clean, rough"):
        simulate("smooth", 1)
    for length in (0.0, -1.0, 1e6, math.nan):
        with pytest.raises(ValueError, match="duration"):
            simulate("clean", 1, length)


def test_bounds_agree_with_the_closed_form_and_with_least_squares():
    """Many fixes in one time constant: P = sqrt2 q^(1/4) r^(3/4), smoothed a quarter; and the dense smoother's own
    covariance in mid-record equals the smoothed bound."""
    q, sigma, rate = 1.25e-7, 0.003, 1000.0
    r = sigma**2 / rate
    assert riccati_bound(rate, sigma, q) ** 2 == pytest.approx(math.sqrt(2) * q**0.25 * r**0.75, rel=0.02)
    assert smoothed_bound(rate, sigma, q) == pytest.approx(riccati_bound(rate, sigma, q) / 2, rel=0.01)
    assert riccati_bound(10.0, sigma, q, 0.2) > riccati_bound(10.0, sigma, q) > smoothed_bound(10.0, sigma, q)
    t = np.arange(200) * 0.1
    flat = dense_smoother(t, np.zeros(200), t, np.zeros(200), sigma, q, 1e-20, covariance=True)
    assert math.sqrt(flat.cov[100, 0, 0]) == pytest.approx(smoothed_bound(10.0, sigma, q), rel=0.02)


def test_dense_smoother_recovers_the_truth_and_equals_a_plain_kalman_filter_at_the_end():
    record = simulate("clean", 8, 60.0)
    t_a, a = record.accel.t_ns / S - 1000, record.accel.xyz[:, 2] - GRAVITY_MPS2
    t_z, z = record.fixes.t_ns / S - 1000, record.fixes.z_m[:, 2]
    prior = (np.array([z[0], 0.0, 0.0]), np.diag([1e-2, 1e-2, 1e-2]))
    out = dense_smoother(t_a, a, t_z, z, 0.006, 1.25e-7, 1e-9, prior=prior)
    error = (out.x[:, 0] - record.truth_at_fixes.d_m[:, 2])[100:-100]
    assert np.sqrt(np.mean(error**2)) < 1.5 * smoothed_bound(10.0, 0.006, 1.25e-7)
    x, P = prior
    from oracles import first_order_hold, process_noise, transition

    for k, t in enumerate(t_z):
        if k:
            v, d = first_order_hold(t_a, a, t_z[k - 1], t)
            F = transition(t - t_z[k - 1])
            x, P = F @ x + [d, v, 0.0], F @ P @ F.T + process_noise(t - t_z[k - 1], 1.25e-7, 1e-9)
        K = P[:, 0] / (P[0, 0] + 0.006**2)
        x, P = x + K * (z[k] - x[0]), P - np.outer(K, P[0])
    assert out.x[-1] == pytest.approx(x, abs=1e-9)


# ------------------------------------------------------------------------------------------------------------ encoders


def split_sentences(data: bytes) -> list[list[str]]:
    """Fields of each sentence, by string functions alone; checks the checksum."""
    out = []
    for line in data.decode().splitlines():
        body, check = line[1:].split("*")
        value = 0
        for c in body:
            value ^= ord(c)
        assert int(check, 16) == value
        out.append(body.split(","))
    return out


def minutes(text: str) -> float:
    """Degrees of an NMEA angle."""
    dot = text.index(".")
    return int(text[: dot - 2]) + float(text[dot - 2 :]) / 60


def enu_by_ecef(llh, reference):
    """Textbook ENU, an independent inverse of `geodetic`."""

    def ecef(lat, lon, h):
        n = 6378137.0 / np.sqrt(1 - 0.00669437999014132 * np.sin(lat) ** 2)
        return np.stack(
            [
                (n + h) * np.cos(lat) * np.cos(lon),
                (n + h) * np.cos(lat) * np.sin(lon),
                (n * (1 - 0.00669437999014132) + h) * np.sin(lat),
            ],
            axis=-1,
        )

    lat, lon = np.radians(reference[0]), np.radians(reference[1])
    turn = np.array(
        [
            [-np.sin(lon), np.cos(lon), 0],
            [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)],
            [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)],
        ]
    )
    there = ecef(np.radians(llh[:, 0]), np.radians(llh[:, 1]), llh[:, 2])
    return (there - ecef(lat, lon, reference[2])) @ turn.T


@pytest.mark.parametrize(
    "reference", [(46.5, 7.5, 610.0), (-33.9, -151.2, 20.0), (0.0, 0.0, 0.0), (71.0, 179.99999, -5.0)]
)
def test_geodetic_inverts_enu(reference):
    enu = np.random.default_rng(1).uniform(-50, 50, (200, 3))
    enu[:3] = [[0, 0, 0], [10_000, -20_000, 100], [1e-6, 0, 0]]
    assert np.abs(enu_by_ecef(np.array(geodetic(enu, reference)), reference) - enu).max() < 1e-8


def test_sentences_carry_the_fixes():
    record = simulate("rough", 6, 30.0)
    bursts = nmea_bursts(record)
    assert [t for t, _ in bursts] == record.fixes.arrival_ns.tolist()
    dates = 0
    llh = []
    for (_, data), t_ns in zip(bursts, record.fixes.t_ns.tolist(), strict=True):
        parts = split_sentences(data)
        if parts[0][0] == "GNZDA":
            dates += 1
            assert parts.pop(0)[2:5] == ["01", "06", "2026"]
        (gga, gst) = parts
        seconds = (t_ns + record.utc_offset_ns) % (86400 * S) / S
        clock = int(gga[1][:2]) * 3600 + int(gga[1][2:4]) * 60 + float(gga[1][4:])
        assert clock == pytest.approx(seconds, abs=1e-6)
        assert gst[1] == gga[1]
        assert gga[6] == "4"
        assert [float(x) for x in gst[6:9]] == [0.003, 0.003, 0.006]  # latitude, longitude, height
        assert (gga[3], gga[5]) == ("N", "E")
        llh.append((minutes(gga[2]), minutes(gga[4]), float(gga[9]) + float(gga[11])))
    assert dates == np.sum(record.fixes.t_ns % S == 0)
    enu = enu_by_ecef(np.array(llh), record.scenario.reference_llh)
    assert np.abs(enu - record.fixes.z_m).max() < 6e-6  # nine decimals of a minute, 0.01 mm of height


def test_sentence_rounding_carries_and_hemispheres():
    data = nmea_epoch(1_780_300_799_990_000_000, (-0.999999999999, -179.999999999999, 10.0), (0.01, 0.02, 0.03), 5)
    gga, gst = split_sentences(data)
    assert gga[1:7] == ["075959.99", "0100.000000000", "S", "18000.000000000", "W", "5"]
    assert gst[6:] == ["0.0200", "0.0100", "0.0300"]
    rmc = split_sentences(nmea_epoch(0, (1.0, 2.0, 3.0), (0.01,) * 3, minute_decimals=4, sentences=("RMC",)))[0]
    assert rmc == ["GNRMC", "000000.00", "A", "0100.0000", "N", "00200.0000", "E", "0.00", "", "010170", "", "", "R"]
    with pytest.raises(ValueError, match="XYZ"):
        nmea_epoch(0, (1.0, 2.0, 3.0), (0.01,) * 3, sentences=("XYZ",))


@pytest.mark.parametrize("name", ["rough", "P0"])
def test_frames_decode_to_the_samples_by_cantools(name):
    import cantools

    record = simulate(name, 3, 20.0)
    database = cantools.database.load_string(dbc_text(record.scenario), "dbc")
    frames = can_frames(record)
    assert np.all(np.diff(frames.t_ns) >= 0)
    got: dict[str, dict[int, dict[str, float]]] = {a.name: {} for a in record.accels}
    for can_id, length, data in zip(frames.can_id.tolist(), frames.length.tolist(), frames.data, strict=True):
        values = database.decode_message(can_id, data[:length].tobytes())
        name_of = database.get_message_by_frame_id(can_id).name.split("_")[1]
        got[name_of].setdefault(int(values.pop("Counter")), {}).update(values)
    for accel, track in zip(record.scenario.accels, record.accels, strict=True):
        samples = got[track.name]
        assert sorted(samples) == track.count.tolist()
        xyz = np.array([[samples[c][axis] for axis in "XYZ"] for c in sorted(samples)])
        step = 1e-6 if name == "P0" else 6e-4
        assert np.abs(xyz - track.xyz).max() <= step / 2 + 1e-12
        assert step / math.sqrt(12) < accel.noise * math.sqrt(accel.rate_hz / 2) / 3  # rounding far below the noise
    per = 3 if name == "P0" else 1
    assert len(frames.t_ns) == per * sum(len(t.count) + int(t.duplicate.sum()) for t in record.accels)


def test_raw_blocks_are_all_the_bytes_in_order():
    record = simulate("rough", 3, 10.0)
    blocks = list(raw_blocks(record))
    assert [b.order for b in blocks] == list(range(len(blocks)))
    assert all(a.t_ns <= b.t_ns for a, b in itertools.pairwise(blocks))
    serial = b"".join(b.payload for b in blocks if isinstance(b.payload, bytes))
    assert serial == b"".join(data for _, data in nmea_bursts(record))
    can = [b for b in blocks if isinstance(b.payload, CanFrames)]
    assert {b.source for b in can} == {"can"}
    assert np.array_equal(np.concatenate([b.payload.data for b in can]), can_frames(record).data)
    assert all(0 <= b.t_ns - int(t) <= S // 10 for b in can for t in b.payload.t_ns[[0, -1]])
    ticks = [b for b in blocks if isinstance(b.payload, Tick)]
    assert [b.payload.utc_ns - b.t_ns for b in ticks] == [record.utc_offset_ns] * 11


@pytest.mark.parametrize("name", SCENARIOS)
def test_configuration_of_every_scenario_is_valid(name, tmp_path):
    from edge_agent import config

    scenario = SCENARIOS[name]
    (tmp_path / "accelerometers.dbc").write_text(dbc_text(scenario))
    (tmp_path / "config.yaml").write_text(config_yaml(scenario, rotate_s=20))
    made = config.load(tmp_path / "config.yaml")
    assert len(made.points) == max(1, len(scenario.accels))
    assert made.structure.reference_llh == scenario.reference_llh
    assert made.record.rotate_s == 20


# --------------------------------------------------------------------------------------------------------------- files


@pytest.mark.parametrize("name", ["hostile", "P2"])
def test_files_hold_the_raw_blocks_and_the_truth(name, tmp_path):
    from edge_agent import config
    from edge_agent.recording import reader, topics

    record = simulate(name, 9, 20.0)
    paths = {p.name: p for p in write_files(record, tmp_path / "new")}
    stored = [topics.decode_raw(m.topic, m.schema, m.data) for m in reader.read_messages(paths["raw.mcap"])]
    expected = list(raw_blocks(record))
    assert [(r.t_ns, r.order, r.source) for r in stored] == [(r.t_ns, r.order, r.source) for r in expected]
    for a, b in zip(stored, expected, strict=True):
        if isinstance(a.payload, CanFrames):
            assert all(x.tobytes() == y.tobytes() for x, y in zip(arrays(a.payload), arrays(b.payload), strict=True))
        else:
            assert a.payload == b.payload
    attached = {a.name: a.data for a in reader.read_attachments(paths["raw.mcap"])}
    assert attached["config.yaml"] == paths["config.yaml"].read_bytes()
    assert config.load(paths["config.yaml"]).site == f"simulated-{name}"
    truth = np.genfromtxt(paths["truth.csv"], delimiter=",", names=True)
    assert truth["displacement_up_m"] == pytest.approx(record.truth.d_m[:, 2], abs=1e-9)
    assert (
        int(paths["truth.csv"].read_text().splitlines()[1].split(",")[0]) == record.truth.t_ns[0] + record.utc_offset_ns
    )
    rows = paths["fixes.csv"].read_text().splitlines()
    assert len(rows) == len(record.fixes.t_ns) + 1
    assert sum(",outlier," in r for r in rows) == np.sum(record.fixes.label == FixLabel.OUTLIER)
    with pytest.raises(FileExistsError):
        write_files(record, tmp_path / "new")


# ------------------------------------------------------------------------------------------------------------- players


def test_slcan_adapter_answers_as_the_protocol_says_in_any_cut():
    commands = b"\rC\rS6\rO\rO\rS6\rV\rN\rt0981FF\rQ\rC\rt0981FF\r" + b"x" * 500 + b"\r"
    answers = b"\r\a\r\r\a\aV1013\rNSIM1\rz\r\a\r\a\a"
    whole = Slcan()
    assert whole.feed(commands) == answers
    assert (whole.open, whole.bitrate) == (False, "S6")
    single = Slcan()
    assert b"".join(single.feed(commands[i : i + 1]) for i in range(len(commands))) == answers


def test_schedules_carry_every_byte_in_order():
    record = simulate("rough", 2, 20.0)
    schedule = serial_schedule(record)
    assert b"".join(d for _, d in schedule) == b"".join(d for _, d in nmea_bursts(record))
    t = np.array([t for t, _ in schedule])
    assert np.all(np.diff(t) > 0)
    size = np.array([len(d) for _, d in schedule])
    assert np.all(np.diff(t) >= size[1:] * 10 * S // 115_200)  # never faster than the line
    frames = can_frames(record)
    lines = b"".join(d for _, d in slcan_schedule(frames)).split(b"\r")[:-1]
    assert len(lines) == len(frames.t_ns)
    assert lines[0] == b"t0988" + frames.data[0].tobytes().hex().upper().encode()
    kernel = socketcan_schedule(frames)[0][1]
    assert (len(kernel), kernel[:5], kernel[8:]) == (16, b"\x98\0\0\0\x08", frames.data[0].tobytes())
    extended = dataclasses.replace(frames, flags=np.ones_like(frames.flags))
    assert slcan_schedule(extended)[0][1].startswith(b"T000000988")
    assert socketcan_schedule(extended)[0][1][:4] == b"\x98\0\0\x80"


def read_all(fd: int, size: int) -> bytes:
    out = b""
    while len(out) < size:
        out += os.read(fd, 65536)
    return out


def test_terminals_play_to_a_reader_and_to_nobody():
    """Bytes of a serial line and of an opened adapter arrive as they are; before that they are gone."""
    line, adapter = Terminal(), Terminal(Slcan())
    try:
        assert not line.ready
        line.send(b"lost")
        assert line.unheard == 4
        gnss = os.open(line.path, os.O_RDWR | os.O_NOCTTY)
        can = os.open(adapter.path, os.O_RDWR | os.O_NOCTTY)
        assert line.ready
        assert not termios.tcgetattr(gnss)[3] & (termios.ECHO | termios.ICANON)  # raw: no echo, no line editing
        assert not adapter.ready  # the channel is closed
        os.write(can, b"C\rS6\rO\r")
        until(lambda: adapter.serve() or adapter.ready, "an open channel")  # what was written comes through in time
        assert read_all(can, 3) == b"\a\r\r"
        assert adapter.ready
        serial = [(i * 1000, bytes([i % 256, 13, 10, 3, 4, 17, 19, 26])) for i in range(2000)]  # control codes too
        frames = [(i * 1000 + 500, b"t0988%016X\r" % i) for i in range(900)]
        sent = [b"".join(d for _, d in part) for part in (serial, frames)]
        got: list[bytes] = [b"", b""]

        def reader(i: int, fd: int) -> None:
            got[i] = read_all(fd, len(sent[i]))

        threads = [threading.Thread(target=reader, args=x, daemon=True) for x in ((0, gnss), (1, can))]
        for thread in threads:
            thread.start()
        told: list[int] = []
        play([(line, serial), (adapter, frames)], time.monotonic_ns(), progress=told.append)
        while any(t.is_alive() for t in threads):  # what did not fit into the terminals yet
            line.serve()
            adapter.serve()
        assert got == sent
        assert told == [0]
        assert (line.lost, adapter.lost) == (0, 0)
        os.close(gnss)
        os.close(can)
        assert not line.ready
        adapter.serve()
        assert adapter.adapter is not None
        assert not adapter.adapter.open
        stop = threading.Event()
        stop.set()
        play([(line, [(0, b"never")])], time.monotonic_ns() + 3600 * S, stop=stop)  # returns at once
        assert line.unheard == 4
    finally:
        line.close()
        adapter.close()


def test_python_can_reads_the_adapter():
    """The library that the agent uses for other adapters sees the frames as they were sent."""
    can = pytest.importorskip("can")
    record = simulate("rough", 2, 1.0)
    frames = can_frames(record)
    adapter = Terminal(Slcan())
    ended = threading.Event()

    def serve() -> None:
        while not ended.is_set() and not adapter.ready:
            adapter.serve()
        for _, data in slcan_schedule(frames):
            adapter.send(data)
        while not ended.is_set():
            adapter.serve()

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        with can.Bus(interface="slcan", channel=adapter.path, bitrate=500_000, sleep_after_open=0.0) as bus:
            got = [bus.recv(PATIENCE_S) for _ in range(len(frames.t_ns))]
    finally:
        ended.set()
        thread.join()
        adapter.close()
    assert [m.arbitration_id for m in got] == frames.can_id.tolist()
    assert b"".join(bytes(m.data) for m in got) == frames.data.tobytes()


@pytest.mark.parametrize("name", ["floaty", "P4"])
def test_the_agents_codecs_read_what_was_simulated(name, tmp_path):
    """Both ends of the wire agree: every fix and every sample comes back, with the faults of the wire accounted for."""
    from drivers.dbc_codec import AccelCodec
    from drivers.nmea_codec import NmeaCodec
    from edge_agent import config
    from edge_agent.geodesy import Frame

    record = simulate(name, 1, 130.0)
    (tmp_path / "accelerometers.dbc").write_text(dbc_text(record.scenario))
    made = config.parse(config_yaml(record.scenario), tmp_path)
    nmea, accel = NmeaCodec(), AccelCodec(made.accelerometers["acc"])
    fixes, blocks, odd = [], [], []
    for raw in raw_blocks(record):
        if isinstance(raw.payload, bytes):
            for x in nmea.feed(raw.t_ns, raw.payload, 0):
                (fixes if isinstance(x, GnssFix) else odd).append(x)
        elif isinstance(raw.payload, CanFrames):
            block, notes = accel.feed(raw.payload)
            odd += notes
            blocks += [] if block is None else [block]
    assert {x.kind for x in odd} <= {"SAMPLES_LOST"}  # no Reject
    assert len(fixes) == len(record.fixes.t_ns)
    assert [f.utc_ns - record.utc_offset_ns for f in fixes] == record.fixes.t_ns.tolist()
    assert all(f.date_known for f in fixes)
    assert [int(f.quality) for f in fixes] == record.fixes.quality.tolist()
    frame = Frame(record.scenario.reference_llh)
    enu = np.array([frame.enu(f.lat_deg, f.lon_deg, f.h_m) for f in fixes])
    assert np.abs(enu - record.fixes.z_m).max() < 6e-6
    assert np.concatenate([b.count for b in blocks]).tolist() == record.accel.count.tolist()
    assert np.abs(np.concatenate([b.xyz for b in blocks]) - record.accel.xyz).max() <= 3.1e-4
    count = record.accel.count
    assert accel.counters["duplicates"] == record.accel.duplicate.sum()
    assert accel.counters["lost"] == count[-1] - count[0] + 1 - len(count)
