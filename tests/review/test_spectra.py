"""Spectra, modes and wavelets: against scipy, against exact damped oscillators, and on real structures."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy import signal, stats

from edge_agent.review.likelihood import fit
from edge_agent.review.smooth import Accelerations, plain, smooth
from edge_agent.review.spectra import (
    Spectrum,
    band,
    fit_mode,
    peaks,
    rise_db,
    scalogram,
    track,
    uniform,
    welch,
)
from edge_agent.simulate import SCENARIOS, SimRecord, run

F64 = npt.NDArray[np.float64]
S = 1_000_000_000


def oscillator(f0: float, damping: float, rate: float, seconds: float, seed: int) -> F64:
    """Displacement of one damped oscillator under white force, sampled exactly (Lyapunov start, matrix exponential)."""
    rng = np.random.default_rng(seed)
    w, dt = 2 * math.pi * f0, 1 / rate
    wd = w * math.sqrt(1 - damping**2)
    c, s, e = math.cos(wd * dt), math.sin(wd * dt), math.exp(-damping * w * dt)
    F = e * np.array([[c + damping * w / wd * s, s / wd], [-(w**2) / wd * s, c - damping * w / wd * s]])
    P = np.diag([1.0, w * w])  # unit variance of displacement
    L = np.linalg.cholesky(P - F @ P @ F.T)
    x = rng.standard_normal(2) * np.array([1.0, w])
    drive = rng.standard_normal((round(seconds * rate), 2)) @ L.T
    out = np.empty(len(drive))
    for k, d in enumerate(drive):
        x = F @ x + d
        out[k] = x[0]
    return out


def test_welch_is_scipys() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal((10_000, 2)) + np.sin(np.arange(10_000) * 0.3)[:, None]
    s = welch(x, 50.0, 512)
    f, p = signal.welch(x, 50.0, "hann", 512, detrend="linear", axis=0)
    assert np.abs(s.freq_hz - f).max() < 1e-12
    assert np.abs(s.psd / p - 1)[2:-1].max() < 1e-9
    assert s.segments == 38


def test_the_confidence_limits_hold_the_truth_as_often_as_they_say() -> None:
    """White noise of density 0.02: 95 % of the limits hold it; and the limits are chi-square's."""
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(40):
        s = welch(rng.standard_normal(4000), 100.0, 400)
        inside.append(((s.low < 0.02) & (s.high > 0.02))[1:-1].mean())
    assert 0.93 < np.mean(inside) < 0.97
    dof = 2 * s.segments / (1 + 2 / 36 * (s.segments - 1) / s.segments)
    assert (s.psd / s.low)[5, 0] == pytest.approx(stats.chi2.ppf(0.975, dof) / dof, rel=1e-3)
    assert (s.psd / s.high)[5, 0] == pytest.approx(stats.chi2.ppf(0.025, dof) / dof, rel=5e-3)


def test_gaps_take_no_part() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(6000) / 100
    x = rng.standard_normal(6000)
    keep = (t < 20) | (t > 27.5)
    u = uniform(np.rint(t[keep] * S).astype(np.int64), x[keep])
    assert u.rate_hz == pytest.approx(100)
    assert len(u.x) == 6000
    assert (u.valid == ((t <= 20) | (t > 27.5))).mean() > 0.9995
    s = welch(u.x, 100.0, 400, valid=u.valid)
    assert s.segments == 9 + 15  # of the 20 s before and the 32.5 s behind
    assert s.psd[1:-1].mean() == pytest.approx(0.02, rel=0.1)
    with pytest.raises(ValueError, match="no whole segment"):
        welch(u.x, 100.0, 5000, valid=u.valid)
    with pytest.raises(ValueError, match="two samples"):
        uniform(np.array([1]), np.zeros(1))


def test_a_mode_is_found_with_an_honest_sd() -> None:
    """24 records of one oscillator: the errors are as large as the sd says, in frequency and damping."""
    z, zd = [], []
    for seed in range(24):
        x = oscillator(1.3, 0.012, 20.0, 600.0, seed) + 0.05 * np.random.default_rng(seed).standard_normal(12_000)
        m = fit_mode(x, 20.0, 1.25, 0.5)
        z.append((m.freq_hz - 1.3) / m.std_freq_hz)
        zd.append((m.damping - 0.012) / m.std_damping)
    print(f"modes: spread {np.std(z):.2f} {np.std(zd):.2f}, mean {np.mean(z):.2f} {np.mean(zd):.2f}")
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.35
    assert 0.7 < np.sqrt(np.mean(np.square(zd))) < 1.5


def test_no_mode_is_found_in_noise() -> None:
    rng = np.random.default_rng(6)
    found = [fit_mode(rng.standard_normal(8000), 20.0, 3.0, 0.5) for _ in range(20)]
    assert sum(math.isfinite(m.freq_hz) for m in found) <= 1
    assert math.isnan(fit_mode(rng.standard_normal(40), 20.0, 3.0, 0.5).freq_hz)


def test_skirts_are_no_peaks() -> None:
    """A mode with a broad skirt, nine segments: chance makes lines on the skirt stand far above the median around, but
    none rises from a valley, wherever the band begins. Two modes side by side are two."""
    skirts = 0
    for seed in range(8):
        x = oscillator(1.7, 0.01, 100.0, 300.0, seed)
        noise = 1e-6 * np.random.default_rng(seed).standard_normal(len(x) - 2)
        s = welch(np.diff(x, 2) + noise, 100.0, 6000)
        found = peaks(s, low_hz=0.5, high_hz=6.0, above_db=9.0, width_hz=2.0)
        assert [round(p.freq_hz, 1) for p in found] == [1.7]
        assert not peaks(s, low_hz=1.8, high_hz=6.0, above_db=9.0, width_hz=2.0)
        skirts += bool(peaks(s, low_hz=1.8, high_hz=6.0, above_db=9.0, width_hz=2.0, alone=False))
    assert skirts > 5  # without the rule they are told
    x = oscillator(0.34, 0.005, 20.0, 900.0, 1) + oscillator(0.44, 0.005, 20.0, 900.0, 2)
    found = peaks(welch(x, 20.0, 2000), low_hz=0.2, high_hz=2.0, width_hz=0.4)
    assert [round(p.freq_hz, 2) for p in found] == [0.34, 0.44]


def test_the_rise_of_a_line_is_from_the_higher_valley() -> None:
    psd = np.array([1.0, 1, 1, 100, 10, 10, 10, 40, 1, 1, 1, 1])
    assert rise_db(psd, 7) == pytest.approx(10 * math.log10(40 / 10), abs=0.01)
    assert rise_db(psd, 3) == math.inf


def test_a_moving_mode_is_tracked() -> None:
    first, second = oscillator(2.0, 0.01, 20.0, 600.0, 1), oscillator(1.9, 0.01, 20.0, 600.0, 2)
    t_ns = (np.arange(24_000) * (S // 20)).astype(np.int64)
    stream = uniform(t_ns, np.concatenate([first, second]))
    out = track(stream, [1.95], 300.0, 0.4)
    assert len(out.t_ns) == 7
    assert (np.diff(out.t_ns) == 150 * S).all()
    f = np.array([row[0].freq_hz for row in out.modes])
    assert np.abs(f[:3] - 2.0).max() < 0.015
    assert np.abs(f[-3:] - 1.9).max() < 0.015


def test_a_band_is_what_moves_in_it_and_a_scalogram_shows_when() -> None:
    t = np.arange(8000) / 50
    slow, fast = np.sin(2 * math.pi * 0.4 * t), 0.3 * np.sin(2 * math.pi * 3.0 * t) * (t > 80)
    x = 5.0 + slow + fast
    inside = slice(500, -500)
    assert np.std((band(x, 50.0, 0.2, 0.8) - slow)[inside]) < 0.02
    assert np.std((band(x, 50.0, 1.5, 6.0) - fast)[inside]) < 0.02
    assert np.std((band(x, 50.0, 0.05, 20.0) - (x - 5.0))[inside]) < 0.03
    g = scalogram(x, 50.0, 0.2, 8.0, most=160)
    assert g.power.shape == (len(g.freq_hz), len(g.t_s))
    assert len(g.t_s) == 160
    row = int(np.argmin(np.abs(g.freq_hz - 3.0)))
    assert g.power[row, 90:150].min() > 20 * g.power[row, 10:70].max()
    assert g.freq_hz[int(np.argmax(g.power[:, 40]))] == pytest.approx(0.4, rel=0.06)
    assert g.edge_s[0] > g.edge_s[-1] > 0
    with pytest.raises(ValueError, match="low_hz"):
        band(x, 50.0, 2.0, 1.0)


def munich(shared: Path) -> F64:
    """Acceleration of the bridge at 100 Hz in g."""
    folder = shared / "C1-munich-test-bridge"
    data = next(folder.glob("*.zip")).read_bytes()
    while data[:2] == b"PK":  # packed twice
        archive = zipfile.ZipFile(io.BytesIO(data))
        data = archive.read(archive.namelist()[0])
    return np.array([float(line.split(b",")[1]) for line in data.splitlines()[1:]])


def test_the_munich_bridge_rings_at_its_known_frequencies(shared_data: Path) -> None:
    x = munich(shared_data)
    found = peaks(welch(x, 100.0, 2048), low_hz=2.0, high_hz=24.0)
    print("Munich:", [f"{p.freq_hz:.3f} Hz {p.above_db:.1f} dB" for p in found])
    assert all(p.above_db >= 6.0 for p in found)
    for want, within in ((10.79, 0.1), (13.60, 0.15), (16.26, 0.1)):
        assert min(abs(p.freq_hz - want) for p in found) < within
        m = fit_mode(x, 100.0, want, 0.8, accelerations=True)
        assert abs(m.freq_hz - want) < within
        assert 0.001 < m.damping < 0.02
    assert len(found) <= 5


@pytest.mark.parametrize("column", [3, 5, 7, 8])
def test_the_shaken_tower_has_its_two_modes_in_every_sensor(shared_data: Path, column: int) -> None:
    x = np.loadtxt(shared_data / "B3-unison-tower-shaker" / "wn_02.dat", usecols=column - 1)
    first = fit_mode(x, 100.0, 0.55, 0.2, accelerations=column != 8)
    second = fit_mode(x, 100.0, 1.7, 0.4, accelerations=column != 8)
    print(f"tower, column {column}: {first.freq_hz:.4f} +- {first.std_freq_hz:.4f}, {second.freq_hz:.4f} Hz")
    assert abs(first.freq_hz - 0.525) < 0.02
    assert abs(second.freq_hz - 1.74) < 0.04
    spectrum = welch(x, 100.0, 4096)
    for want in (0.52, 1.73):
        assert min(abs(p.freq_hz - want) for p in peaks(spectrum, low_hz=0.2, high_hz=3.0, width_hz=0.5)) < 0.03


def fused(r: SimRecord, accel: int) -> tuple[F64, float]:
    """Smoothed displacement of a simulated record at its accelerometer's rate, and that rate."""
    track_ = r.accels[accel]
    fixes = plain(r.fixes.t_ns, r.fixes.z_m, r.fixes.std_m)
    accelerations = Accelerations(track_.t_ns, track_.xyz)
    s = smooth(fixes, accelerations, fit(fixes, accelerations, most=1000).noise, std=False)
    return s.displacement_m, r.scenario.accels[accel].rate_hz


def spectrum_of(x: F64, rate: float, seconds: float) -> Spectrum:
    return welch(x, rate, int(seconds * rate))


def test_the_bridge_model_shows_its_third_mode_in_the_fused_displacement_only() -> None:
    """P0 (Lima et al.): 1.13, 4.45 and 7.27 Hz from accelerations and fused displacement, receiver alone without the
    third, under a slider of 18 cm."""
    r = run(SCENARIOS["P0"], 1, 600.0)
    d, rate = fused(r, 0)
    gnss = r.fixes.z_m[:, 0]
    for want in (1.13, 4.45, 7.27):
        f = fit_mode(d[:, 0], rate, want, 0.4)
        a = fit_mode(r.accel.xyz[:, 0], rate, want, 0.4, accelerations=True)
        true = fit_mode(r.truth.d_m[:, 0], rate, want, 0.4)
        print(f"P0 {want}: fused {f.freq_hz:.4f}, accelerations {a.freq_hz:.4f}, truth {true.freq_hz:.4f}")
        assert abs(f.freq_hz / true.freq_hz - 1) < 0.002
        assert abs(f.freq_hz / want - 1) < 0.005
        assert abs(a.freq_hz / want - 1) < 0.005
        in_fused = peaks(spectrum_of(d[:, 0], rate, 20.0), low_hz=0.8, high_hz=9.0)
        assert min(abs(p.freq_hz - want) for p in in_fused) < 0.1
    assert abs(fit_mode(gnss, 20.0, 1.13, 0.4).freq_hz - 1.13) < 0.01
    assert math.isnan(fit_mode(gnss, 20.0, 7.27, 0.4).freq_hz)
    seen = peaks(spectrum_of(gnss, 20.0, 20.0), low_hz=0.8, high_hz=9.0)
    assert all(abs(p.freq_hz - 7.27) > 0.3 for p in seen)


@pytest.mark.parametrize(("name", "seconds", "axis"), [("P1", 1800.0, 1), ("P4", 3000.0, 0)])
def test_tall_and_long_structures_keep_their_modes(name: str, seconds: float, axis: int) -> None:
    """P1 (Wang et al.): .21, .34, .44 Hz on the weakly excited axis too; P4 (Shan & Qi): .309, .507, .645 Hz from fixes
    at 1 Hz. Frequency against the same fit on the truth within 0.2 %, or as near as the record's length can tell."""
    r = run(SCENARIOS[name], 1, seconds)
    d, rate = fused(r, 0)
    for mode in r.scenario.structure.modes[:3]:
        f = fit_mode(d[:, axis], rate, mode.freq_hz, 0.08)
        true = fit_mode(r.truth.d_m[:, axis], rate, mode.freq_hz, 0.08)
        print(f"{name} {mode.freq_hz}: fused {f.freq_hz:.4f} +- {f.std_freq_hz:.4f}, truth {true.freq_hz:.4f}")
        assert abs(f.freq_hz / true.freq_hz - 1) < 0.002
        assert abs(f.freq_hz - mode.freq_hz) < max(0.005 * mode.freq_hz, 3 * f.std_freq_hz)
