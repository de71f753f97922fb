"""Settings by maximum likelihood: against known noise, and against configurations that are wrong on purpose."""

from __future__ import annotations

import json
import math
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.__main__ import main
from edge_agent.recording.reader import read_messages
from edge_agent.recording.topics import decode_fused_block
from edge_agent.review.series import Accelerated, Piece
from edge_agent.review.smooth import Accelerations, plain
from edge_agent.review.tune import Gain, Stretch, _Keeper, as_json, as_text, gain, most_likely, ready, scores, tune
from edge_agent.simulate import SCENARIOS, SimRecord, run
from edge_agent.simulate.files import write_files

F64 = npt.NDArray[np.float64]
S = 1_000_000_000


def stretch(seed: int, q: float, qb: float, sigma_m: float, seconds: float = 60.0) -> Stretch:
    """Motion of two sines; an accelerometer at 100 Hz with white noise of density q [m2/s3] and a bias that walks with
    density qb [m2/s5]; a fix every 0.2 s, declared at 3 mm."""
    rng = np.random.default_rng(seed)
    h = 0.01
    t = np.arange(round(seconds / h)) * h
    w = 2 * math.pi * np.array([0.3, 0.9])
    size, phase = np.array([0.02, 0.004])[:, None], rng.uniform(0, 6, (2, 3))
    angle = w[:, None, None] * t[:, None] + phase[:, None]
    d = (size[:, None] * np.sin(angle)).sum(axis=0)
    a = (-size[:, None] * (w**2)[:, None, None] * np.sin(angle)).sum(axis=0)
    bias = np.cumsum(math.sqrt(qb * h) * rng.standard_normal((len(t), 3)), axis=0) + 0.05
    xyz = a + bias + math.sqrt(q / h) * rng.standard_normal((len(t), 3))
    every = slice(None, None, 20)
    z = d[every] + sigma_m * rng.standard_normal((len(t[every]), 3))
    t_ns = np.rint(t * S).astype(np.int64) + seed * 1000 * S
    fixes = plain(t_ns[every], z, 0.003)
    none = np.zeros_like(z)
    return Stretch(int(t_ns[0]), fixes, Accelerations(t_ns, xyz), np.full(3, 0.003), 0.1, none, none + 1.0, 1.0)


@pytest.mark.parametrize(("q", "qb", "sigma_m"), [(1e-4, 1e-4, 0.002), (1e-5, 1e-6, 0.002)])
def test_known_noise_is_found_within_its_sd(q: float, qb: float, sigma_m: float) -> None:
    found, sd = most_likely([ready(stretch(seed, q, qb, sigma_m)) for seed in range(4)])
    r = (sigma_m / 0.003) ** 2
    off = np.log(np.stack([found.q / q, found.qb / qb, found.r / r])) / sd
    print(found, np.exp(sd), off)
    assert np.isfinite(sd).all()
    assert np.abs(off).max() < 3.3
    assert math.sqrt(float((off**2).mean())) < 1.7  # nine values of sd 1
    assert (sd[2] < 0.15).all()
    assert (sd[1] < math.log(10)).all()


def test_no_neighbour_is_more_likely_on_a_plain_filter() -> None:
    """The likelihood at the estimate and beside it, by matrices."""
    s = stretch(7, 1e-5, 1e-4, 0.002, 40.0)
    part = ready(s)
    found, _ = most_likely([part])

    def plainly(q: float, qb: float, r: float) -> float:
        x, P = np.array([part.z[0, 0], 0.0, 0.0]), np.diag([9e-6 * r, 900.0 * r, 900.0 * r])
        total = 0.0
        for k in range(1, len(part.dt)):
            T = float(part.dt[k])
            F = np.array([[1, T, -T * T / 2], [0, 1, -T], [0, 0, 1]])
            white = np.array([[T**3 / 3, T**2 / 2, 0], [T**2 / 2, T, 0], [0, 0, 0]])
            walk = np.array(
                [[T**5 / 20, T**4 / 8, -(T**3) / 6], [T**4 / 8, T**3 / 3, -(T**2) / 2], [-(T**3) / 6, -(T**2) / 2, T]]
            )
            x = F @ x + np.array([part.s2[k, 0], part.s1[k, 0], 0.0])
            P = F @ P @ F.T + (q + part.gap[k, 0]) * white + qb * walk
            v, e = P[0, 0] + 9e-6 * r, part.z[k, 0] - x[0]
            if part.counted[k]:
                total -= 0.5 * (math.log(2 * math.pi * v) + e * e / v)
            gain_ = P[:, 0] / v
            x, P = x + gain_ * e, P - np.outer(gain_, P[0])
        return total

    at = [float(v[0]) for v in (found.q, found.qb, found.r)]
    best = plainly(*at)
    told = scores(part, found)[0]
    assert np.nansum(told[:, 0]) == pytest.approx(best, abs=0.05)
    for i in range(3):
        for factor in (0.5, 2.0):
            moved = list(at)
            moved[i] *= factor
            assert plainly(*moved) < best + 0.05


def test_a_gain_must_stand_out_of_its_scatter() -> None:
    assert Gain(20.0, 4.0, 100).sure
    assert not Gain(20.0, 8.0, 100).sure
    assert not Gain(2.0, 0.1, 100).sure
    assert not Gain(20.0, math.inf, 100).sure
    s = stretch(1, 1e-6, 1e-5, 0.003)
    one = np.zeros((len(s.fixes), 3))
    two = one + 0.01
    two[:5] = math.nan
    won = gain([s], [one], [two])
    assert won.fixes == len(s.fixes) - 5
    assert won.value == pytest.approx(0.03 * won.fixes)


# ---------------------------------------------------------------------------------------------------------- the command


def told(path: Path) -> tuple[Any, str]:
    """The JSON twin as a program reads it, and the text."""
    found = tune([path])
    return json.loads(json.dumps(as_json(found), allow_nan=False)), as_text(found)


def error(path: Path, record: SimRecord, after_s: float = 60.0) -> F64:
    """rms (3,) of the live displacement against the truth, about its mean."""
    t, d = [], []
    for m in read_messages(path, {"/fusion/deck/block"}):
        e = decode_fused_block("deck", m.data)
        t.append(e.t_ns)
        d.append(e.displacement_m)
    times, moved = np.concatenate(t), np.concatenate(d)
    truth = np.stack([np.interp(times, record.accel.t_ns, record.truth.d_m[:, i]) for i in range(3)], axis=1)
    e = (moved - truth)[times > times[0] + after_s * S]
    return np.asarray((e - e.mean(axis=0)).std(axis=0))


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SimRecord]:
    """Five minutes with fixes 200 ms late, configured as 60 ms, with an accelerometer whose mounting is configured 20
    degrees wrong and whose noise is insisted on 90 times too large in sd."""
    folder = tmp_path_factory.mktemp("tune")
    clean = SCENARIOS["clean"]
    assert clean.gnss is not None
    scenario = replace(clean, gnss=replace(clean.gnss, latency_s=0.2))
    record = run(scenario, 11, 300.0)
    write_files(record, folder)
    c, s = math.cos(math.radians(20)), math.sin(math.radians(20))
    sets = (
        "receivers.rover.latency_ms=60",
        f"accelerometers.acc.rotation=[[{c:.6f},{-s:.6f},0],[{s:.6f},{c:.6f},0],[0,0,1]]",
        "fusion.accel_noise_m2ps3=1e-3",
        "fusion.accel_noise_decades=0.1",
    )
    flags = [part for text in sets for part in ("--set", text)]
    raw, config = str(folder / "raw.mcap"), str(folder / "config.yaml")
    assert main(["replay", raw, "-c", config, *flags, "-o", str(folder / "fused.mcap")]) == 0
    return folder, record


def test_wrong_settings_are_found_and_what_is_proposed_helps(
    wrong: tuple[Path, SimRecord], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, record = wrong
    found, text = told(folder / "fused.mcap")
    changes = {p["key"]: p for p in found["proposals"] if not p["keep"]}
    assert set(changes) == {
        "receivers.rover.latency_ms", "accelerometers.acc.rotation", "fusion.accel_noise_m2ps3",
    }  # fmt: skip
    latency = changes["receivers.rover.latency_ms"]
    sd = float(latency["std"].split()[1])
    assert 0.3 < sd < 6
    assert abs(latency["new"] - 200.0) < 3 * sd
    rotation = np.array(changes["accelerometers.acc.rotation"]["new"])
    assert np.abs(rotation - np.eye(3)).max() < math.radians(3.0)
    true_q = 5e-4**2 / 2
    spread = float(changes["fusion.accel_noise_m2ps3"]["std"].split()[1])
    assert 1.05 < spread < 2.5
    assert abs(math.log(changes["fusion.accel_noise_m2ps3"]["new"] / true_q)) < 3 * math.log(spread)
    for p in changes.values():
        assert p["gain"]["log_likelihood"] > 3 * p["gain"]["std"]
    point = found["points"]["deck"]
    assert point["gain_over_live"]["log_likelihood"] > 200
    assert all(a < b for a, b in zip(point["rms_innovation_m"], point["rms_innovation_live_m"], strict=True))
    assert point["fix_std_m"] == pytest.approx([0.003, 0.003, 0.006], rel=0.12)
    # the snippet is YAML that the configuration takes, the command is one that runs, and it helps
    assert "# paste into the configuration:" in text
    assert found["yaml"].strip() in text
    assert found["command"] == text.strip().splitlines()[-1]
    monkeypatch.chdir(folder)
    program, *command = shlex.split(found["command"])
    assert program == "edge-agent"
    assert main([*command, "-o", str(folder / "tuned.mcap"), "--json"]) == 0
    compared = json.loads(capsys.readouterr().out)
    assert compared["points"]["deck"]["verdict"] == "the new settings predict the fixes better"
    before, after = error(folder / "fused.mcap", record), error(folder / "tuned.mcap", record)
    print(f"live rms against truth {1e3 * before} -> {1e3 * after} mm")
    assert (after < 0.7 * before).all()
    assert (after < [0.0013, 0.0013, 0.0022]).all()


def test_good_settings_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_files(run(SCENARIOS["clean"], 4, 150.0), tmp_path)
    raw, config, fused = (str(tmp_path / n) for n in ("raw.mcap", "config.yaml", "fused.mcap"))
    assert main(["tune", raw]) == 2
    assert "make one: edge-agent replay" in capsys.readouterr().err
    assert main(["replay", raw, "-c", config, "-o", fused]) == 0
    found, text = told(tmp_path / "fused.mcap")
    assert [p["key"] for p in found["proposals"] if not p["keep"]] == []
    assert found["yaml"] == ""
    assert found["command"] is None
    assert "keep what you have" in text
    assert {p["key"] for p in found["proposals"]} == {
        "receivers.rover.latency_ms", "accelerometers.acc.rotation", "fusion.accel_noise_m2ps3",
        "fusion.bias_walk_m2ps5", "receivers.rover.sigma_floor_m",
    }  # fmt: skip
    assert all(p["why"] for p in found["proposals"])


def test_a_receiver_that_says_far_too_little_needs_a_floor(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It declares 0.15 mm and scatters by 3 and 6; the filter follows up to 7 times. No accelerometer here."""
    clean = SCENARIOS["clean"]
    assert clean.gnss is not None
    quiet = replace(clean.structure, modes=())
    record = run(replace(clean, structure=quiet, gnss=replace(clean.gnss, rate_hz=5.0, declared=0.05)), 4, 400.0)
    write_files(replace(record), tmp_path)
    raw, config, fused = (str(tmp_path / n) for n in ("raw.mcap", "config.yaml", "fused.mcap"))
    sets = ("receivers.rover.sigma_floor_m=[1e-4,1e-4,1e-4]", "points.deck={receiver: rover}")
    flags = [part for text in sets for part in ("--set", text)]
    assert main(["replay", raw, "-c", config, *flags, "-o", fused]) == 0
    capsys.readouterr()
    assert main(["tune", fused, "--json"]) == 0  # the command itself
    found = json.loads(capsys.readouterr().out)
    by_key = {p["key"]: p for p in found["proposals"]}
    floor = by_key["receivers.rover.sigma_floor_m"]
    assert not floor["keep"]
    assert floor["new"] == pytest.approx([0.003, 0.003, 0.006], rel=0.15)
    assert {"fusion.gnss_only_q_m2ps3", "fusion.gnss_only_qb_m2ps5"} <= by_key.keys()


def test_what_cannot_be_read_is_wrong_use(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tune", str(tmp_path / "none.mcap"), "--json"]) == 2
    (tmp_path / "empty.mcap").write_bytes(b"")
    assert main(["tune", str(tmp_path / "empty.mcap")]) == 2
    assert "empty" in capsys.readouterr().err


def test_what_waits_for_verdicts_is_bounded() -> None:
    """Hours without a reference, or with accelerations alone, are not kept."""
    keeper = _Keeper("rover", "acc", "deck")
    most = 0
    for minute in range(240):
        t = (np.arange(600) * (S // 10) + minute * 60 * S).astype(np.int64)
        accel = Accelerated(t, t, np.zeros((600, 3)), np.zeros(600, np.uint8))
        keeper.add(Piece(Path("f"), "run", False, {}, {}, {}, {"acc": accel}, []))
        most = max(most, len(keeper._accel))
    assert most < 15
    keeper.close()
    assert keeper.halves() == ([], [])
