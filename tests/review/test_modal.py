"""Modes of several sensors: what is kept, how it is thinned, which poles are told; the library where it is there."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.messages import S
from edge_agent.review import modal
from edge_agent.review.modal import Channels, Poles, Together, bands_of, identify, in_phase, modes_of, thinned
from edge_agent.review.series import Accelerated, Piece

F64 = npt.NDArray[np.float64]


def piece(run: str, streams: dict[str, tuple[npt.NDArray[np.int64], F64]]) -> Piece:
    accel = {k: Accelerated(t, t, x, np.zeros(len(t), np.uint8)) for k, (t, x) in streams.items()}
    return Piece(Path("x.mcap"), run, False, {}, {}, {}, accel, [])


def oscillator(f0: float, zeta: float, rate: float, n: int, seed: int) -> F64:
    """Acceleration of an oscillator under white force, exact at the samples but for its first difference."""
    w = 2 * math.pi * f0 / rate
    pole = math.exp(-zeta * w)
    a, b = 2 * pole * math.cos(w * math.sqrt(1 - zeta * zeta)), pole * pole
    y = [0.0, 0.0]
    for force in np.random.default_rng(seed).standard_normal(n).tolist():
        y.append(a * y[-1] - b * y[-2] + force)
    return np.diff(np.array(y), 2)


def test_the_liveliest_stretch_of_all_sensors_is_kept_on_one_grid() -> None:
    rng = np.random.default_rng(1)
    kept = Together()
    begin = 1_780_300_800 * S
    for k, size in enumerate((1.0, 5.0, 2.0)):  # three runs of 100 s, the second moves most
        for part in range(2):
            t = begin + (200 * k + 50 * part) * S + np.arange(5000) * (S // 100)
            u = begin + (200 * k + 50 * part) * S + np.arange(2500) * (S // 50) + 3_000_000
            a, b = size * rng.standard_normal((5000, 3)), size * rng.standard_normal((2500, 3))
            kept.add(piece(f"run {k}", {"one": (t, a), "two": (u, b)}))
    kept.close()
    c = kept.channels()
    assert c is not None
    assert c.names == ["one x", "one y", "one z", "two x", "two y", "two z"]
    assert abs(c.rate_hz - 50.0) < 1e-6
    assert c.begin_ns == begin + 200 * S + 3_000_000
    assert abs(len(c.x) - 5000) <= 2
    assert 4.0 < c.x[:, 3].std() < 5.5


def test_a_sensor_with_gaps_is_left_out_and_too_little_is_none() -> None:
    t = np.arange(10_000) * (S // 100)
    x = np.random.default_rng(2).standard_normal((10_000, 3))
    kept = Together()
    hole = np.ones(10_000, np.bool_)
    hole[3000:3400] = False
    kept.add(piece("run", {"whole": (t, x), "torn": (t[hole], x[hole])}))
    kept.close()
    c = kept.channels()
    assert c is not None
    assert c.names == ["whole x", "whole y", "whole z"]
    short = Together()
    short.add(piece("run", {"whole": (t[:4000], x[:4000])}))
    short.close()
    assert short.channels() is None


def test_bands_and_thinning() -> None:
    assert bands_of([1.72, 0.21, 0.34, 1.05, 0.44]) == [[0.21, 0.34, 0.44], [1.05, 1.72]]
    t = np.arange(20_000) / 100.0
    x = np.stack([np.sin(2 * np.pi * 1.3 * t), 0.4 * t + np.sin(2 * np.pi * 20.0 * t)], axis=1)
    y, rate = thinned(x, 100.0, 8.0)
    assert abs(rate - 8.0) < 0.01
    at = np.arange(len(y)) / rate
    inside = slice(100, -100)
    assert np.abs(y[inside, 0] - np.sin(2 * np.pi * 1.3 * at)[inside]).max() < 0.02
    assert np.abs(y[inside, 1]).max() < 0.02  # the line is off, the fast motion is above


def test_only_poles_that_stand_still_are_told() -> None:
    rng = np.random.default_rng(3)
    rows = []
    for order in range(2, 30, 2):
        rows.append((2.0 + 0.002 * rng.standard_normal(), 0.004, 0.01, order, True, (1.0, -0.5)))
        rows.append((0.5 + 4 * rng.random(), 0.01, 0.02, order, True, (1.0, 1j)))  # wanders
        rows.append((3.0, 0.5, 0.02, order, True, (1.0, 0.0)))  # not sure of itself
        rows.append((3.5, 0.002, 0.3, order, True, (1.0, 0.0)))  # too damped
        rows.append((1.5, 0.002, 0.01, order, False, (1.0, 0.0)))
    columns = [np.array(c) for c in zip(*(r[:5] for r in rows), strict=True)]
    poles = Poles(columns[0], columns[1], columns[2], 0.1 * columns[2], columns[3].astype(np.int64), columns[4] > 0)
    shapes = np.array([r[5] for r in rows], dtype=np.complex128)
    freq = np.arange(0.0, 5.0, 0.02)
    singular = (1.0 / ((freq - 2.03) ** 2 + 0.001))[:, None]
    found = modes_of(poles, shapes, freq, singular, (0.3, 4.0))
    assert len(found) == 1
    m = found[0]
    assert abs(m.freq_hz - 2.0) < 0.006
    assert 0.004 <= m.std_freq_hz < 0.006
    assert m.share == 1.0
    assert abs(m.fdd_hz - 2.03) < 0.01
    assert np.allclose(m.shape, (1.0, -0.5))
    assert in_phase(m.shape) == pytest.approx(1.0)
    assert in_phase(np.array([1.0, 1j])) == pytest.approx(0.0)
    assert modes_of(poles, shapes, freq, singular, (2.5, 4.0)) == []


def test_without_the_library_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modal, "installed", lambda: False)
    c = Channels(0, 50.0, np.random.default_rng(1).standard_normal((5000, 3)), ["a x", "a y", "a z"])
    assert "pip install" in identify(c, [1.0]).why
    assert "stands out" in identify(c, []).why
    monkeypatch.setattr(modal, "installed", lambda: True)
    assert "too short for 0.5 Hz" in identify(Channels(0, 50.0, c.x[:500], c.names), [0.5]).why


def test_two_modes_of_three_channels() -> None:
    pytest.importorskip("pyoma2", reason="the extra `review` is not installed")
    one, two = oscillator(1.3, 0.012, 50.0, 30_000, 1), oscillator(3.1, 0.01, 50.0, 30_000, 2)
    one, two = one / one.std(), two / two.std()
    x = np.stack([one + 0.3 * two, 0.8 * one - 0.4 * two, 0.4 * one + 0.5 * two], axis=1)
    x += 0.05 * np.random.default_rng(3).standard_normal(x.shape)
    found = identify(Channels(0, 50.0, x, ["a x", "a y", "a z"]), [1.3, 3.1])
    assert found.why == ""
    assert len(found.modes) == 2
    for m, f, shape in zip(found.modes, (1.3, 3.1), ((1.0, 0.8, 0.4), (0.6, -0.8, 1.0)), strict=True):
        assert abs(m.freq_hz - f) < 4 * m.std_freq_hz + 0.002
        assert abs(m.damping - 0.011) < 5 * m.std_damping + 0.004
        assert abs(m.fdd_hz - f) < 0.05
        assert np.abs(m.shape.real - shape).max() < 0.15
        assert in_phase(m.shape) > 0.95
