"""What the filter does with accelerations that are flagged: spikes, a stuck axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fusion_play import F64, I64, Played, S, accel_items, blocks_of, bridge, fix_items, play

from edge_agent.fusion.station import Station
from edge_agent.messages import STUCK_SAMPLES, AccelBlock, AccelFlag, FusionFlag, Mode, PointSettings
from edge_agent.state import pack, unpack

SPIKE, STUCK = np.uint8(AccelFlag.SPIKE), np.uint8(AccelFlag.STUCK)


def played(t: I64, xyz: F64, flags: np.ndarray, tf: I64, z: F64) -> Played:
    items = accel_items(t, xyz, blocks_of(t))
    items = [(w, n, replace(b, flags=flags[b.count]) if isinstance(b, AccelBlock) else b) for w, n, b in items]
    return play(items + fix_items(tf, z))


def test_a_spike_is_as_a_sample_that_never_came() -> None:
    t, xyz, _, tf, z, _ = bridge(60.0)
    flags = np.zeros(len(t), np.uint8)
    flags[[2222, 3333, 3335, 4444]] = SPIKE
    spiked = xyz.copy()
    spiked[flags > 0] += 10.0
    good = flags == 0
    a = played(t, spiked, flags, tf, z)
    b = played(t[good], xyz[good], np.zeros(int(good.sum()), np.uint8), tf, z)
    assert np.isin(t[good], a.t).sum() == len(a.t)
    assert a.d.tobytes() == b.d.tobytes()
    assert a.sd.tobytes() == b.sd.tobytes()


@pytest.mark.parametrize("begin_s", [40.0, 40.35, 40.7, 41.1])
@pytest.mark.parametrize(("rate", "axis"), [(20, 0), (50, 1), (100, 2)])
def test_a_stuck_axis_leaves_the_estimate_honest(rate: int, axis: int, begin_s: float) -> None:
    """GIVEN an axis that stays where it is in the swing, which is noticed as late as may be: after 2.4 s at 20 Hz.
    THEN no false level stays, the estimate goes on with fixes only, its sd says how well, and it recovers."""
    t, xyz, d, tf, z, df = bridge(100.0, rate=rate, seed=int(100 * begin_s))
    begin = int(begin_s * rate)
    end = begin + 20 * rate
    xyz[begin:end, axis] = xyz[begin, axis]
    flags = np.zeros(len(t), np.uint8)
    flags[begin + STUCK_SAMPLES - 1 : end + 100] = STUCK
    p = played(t, xyz, flags, tf, z)
    kinds = p.kinds()
    assert kinds.count("ACCEL_GAP") == 1
    assert kinds.count("JUMP_OPEN") == kinds.count("JUMP_CLOSED")
    assert not {"REACQUIRE", "CONTRADICTION", "DATUM"} & set(kinds)
    at = p.t
    truth = np.empty_like(p.d)
    for k in range(3):
        truth[:, k] = np.interp(at, t, d[:, k])
        at_fix = np.isin(at, tf)
        truth[at_fix, k] = df[np.isin(tf, at), k]
    error = np.abs(p.d - truth) / p.sd
    told = at > t[begin + STUCK_SAMPLES]
    assert (error[told] > 4.0).mean() < 0.01
    mode = p.column("mode")
    lost = (at > t[begin + STUCK_SAMPLES] + S) & (at < t[end])
    assert lost.sum() > 150  # one per fix
    assert set(mode[lost]) == {int(Mode.GNSS_ONLY)}
    assert (p.column("flags")[lost] & np.uint8(FusionFlag.ACCEL_GAP) > 0).all()
    assert np.abs(p.d - truth)[at > t[-1] - 5 * S].max() < 0.006


def test_what_is_known_of_a_stuck_axis_is_saved() -> None:
    t, xyz, _, tf, z, _ = bridge(60.0)
    flags = np.zeros(len(t), np.uint8)
    flags[4000:] = STUCK
    p = played(t[:4050], xyz[:4050], flags[:4050], tf[:405], z[:405])
    other = Station([PointSettings("p", "r", "a")], p.station.settings)
    other.load(unpack(pack(p.station.save())))
    assert pack(other.save()) == pack(p.station.save())
    assert [pt.stuck for pt in other.points] == [True]
    block = AccelBlock("a", t[4050:4060], xyz[4050:4060], flags[4050:4060], np.arange(4050, 4060))
    before = p.station.C.copy()
    for station in (p.station, other):
        station.accelerations({"a": block}, int(t[4060]))
        assert np.array_equal(station.C, before)  # doubted once
