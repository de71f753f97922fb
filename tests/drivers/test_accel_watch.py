"""Spikes and stuck axes: found where they are planted, and nowhere in what real sensors and quiet ones send."""

from __future__ import annotations

import dataclasses
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from can_play import COUNTER, T0, TRIPLE, accel, cut, frames, run, triple
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.accel_watch import CHUNK, LEARN_CHUNKS, STUCK_RUN, Watch
from drivers.dbc_codec import AccelCodec
from edge_agent.messages import MS, STUCK_SAMPLES, AccelFlag, CanFrames, Event, Reject
from edge_agent.state import pack, unpack

F64 = npt.NDArray[np.float64]
SPIKE, STUCK = int(AccelFlag.SPIKE), int(AccelFlag.STUCK)
LEARNED = CHUNK * (LEARN_CHUNKS + 1)


@dataclasses.dataclass
class Seen:
    xyz: F64
    flags: npt.NDArray[np.uint8]
    notes: list[Reject | Event]
    counters: dict[str, int]

    def kinds(self) -> list[str]:
        return [n.kind for n in self.notes if isinstance(n, Event)]

    def at(self, flag: int) -> list[int]:
        return np.flatnonzero(self.flags & flag).tolist()


def watch(values: F64, step: int = 25, watcher: Watch | None = None, begin: int = 0) -> Seen:
    """Values (n, 3) or (n,) at 100 Hz through a watch in blocks."""
    if values.ndim == 1:
        values = np.stack([values, np.zeros_like(values), np.zeros_like(values)], axis=1)
    counters = {"saturated": 0, "stuck": 0, "spikes": 0}
    w = watcher or Watch("imu", np.full(3, -np.inf), np.full(3, np.inf), counters)
    notes: list[Reject | Event] = []
    xyz, flags = [], []
    for i in range(begin, len(values), step):
        part = values[i : i + step]
        n = len(part)
        t = T0 + np.arange(i, i + n) * 10 * MS
        rows = w.judge(t, part, np.zeros(n, np.uint8), np.arange(i, i + n), np.zeros(n, np.uint8), notes)
        xyz.append(rows[1])
        flags.append(rows[2])
    return Seen(np.concatenate(xyz), np.concatenate(flags), notes, w.counters)


def noise(n: int, steps: float, seed: int = 0, axes: int = 3) -> F64:
    """White noise of a sensor with steps of 1 mm/s2, `steps` of them, gravity on z."""
    x = np.random.default_rng(seed).standard_normal((n, axes)) * steps
    x[:, axes - 1] += 9806.65
    return np.asarray(np.rint(x) * 0.001)


# ------------------------------------------------------------------------------------------------------------ planted


@pytest.mark.parametrize("steps", [0.2, 1.0, 30.0])
@pytest.mark.parametrize("block", [1, 7, 25, 100])
def test_every_single_spike_is_found_and_nothing_else(steps: float, block: int) -> None:
    """GIVEN spikes of 10 m/s2 on any axis, some close together. THEN just these are flagged, in whatever blocks."""
    x = noise(6000, steps)
    x[:, 1] += 0.05 * np.sin(np.arange(6000) * 0.03)
    places = [200, 333, 350, 2000, 2020, 2040, 4444, 5980]
    for k, place in enumerate(places):
        x[place, k % 3] += 10.0 * (-1) ** k
    seen = watch(x, block)
    assert seen.at(SPIKE) == places
    assert seen.counters["spikes"] == len(places)
    assert np.array_equal(seen.xyz, x)  # told, not changed
    assert seen.at(STUCK) == []
    assert seen.kinds() == ["ACCEL_SPIKE", "ACCEL_SPIKE_END"] * 3 + ["ACCEL_SPIKE"]
    end = [n for n in seen.notes if isinstance(n, Event)][1]
    assert dict(end.values) == {"samples": 3.0}
    assert end.begin_ns == T0 + 200 * 10 * MS


def test_a_suspect_waits_for_its_neighbours_and_others_do_not() -> None:
    x = noise(1000, 2.0)
    x[949, 0] += 10.0  # the last of a block
    w = Watch("imu", np.full(3, -np.inf), np.full(3, np.inf), {"saturated": 0, "stuck": 0, "spikes": 0})
    assert len(watch(x[:949], 25, w).xyz) == 949
    assert len(watch(x[:950], 25, w, 949).xyz) == 0
    assert len(watch(x[:957], 25, w, 950).xyz) == 0
    after = watch(x[:958], 25, w, 957)
    assert after.flags.tolist() == [SPIKE] + [0] * 8
    assert len(watch(x, 25, w, 958).xyz) == 42


@pytest.mark.parametrize("seed", range(5))
def test_what_goes_on_is_no_spike(seed: int) -> None:
    """Steps, bursts of two, blows that ring, an earthquake out of silence: 20 to 4000 times the noise."""
    rng = np.random.default_rng(seed)
    x = noise(20_000, 1.0, seed)
    t = np.arange(400) / 100.0
    for place in range(1000, 19_000, 500):
        size = 10 ** rng.uniform(-1.7, 0.6)
        match place // 500 % 4:
            case 0:
                x[place:, 0] += size
            case 1:
                x[place : place + 2, 0] += size
            case 2:  # first sample at its height, as an impact is
                x[place : place + 400, 0] += size * np.exp(-t / 0.2) * np.cos(2 * np.pi * rng.uniform(5, 40) * t)
            case _:
                x[place : place + 400, 0] += size * rng.standard_normal(400) * np.minimum(1.0, t / 0.3) * np.exp(-t)
    seen = watch(x)
    assert seen.at(SPIKE) == []
    assert seen.kinds() == []


@pytest.mark.parametrize("steps", [2.0, 4.0, 50.0])
@pytest.mark.parametrize("place", [LEARNED, LEARNED + 1, LEARNED + 37, 9001])
@pytest.mark.parametrize("block", [1, 25, 64])
def test_an_axis_that_stops_moving_is_found_in_time(steps: float, place: int, block: int) -> None:
    x = noise(12_000, steps, seed=place)
    x[place : place + 500, 2] = x[place, 2]
    seen = watch(x, block)
    flagged = seen.at(STUCK)
    last = place + 500
    assert place + STUCK_RUN - 2 <= flagged[0] <= place + STUCK_SAMPLES  # the value may have come up before
    assert flagged == list(range(flagged[0], flagged[-1] + 1))
    assert last + CHUNK <= flagged[-1] + 1 <= last + 3 * CHUNK  # believed again after two chunks of motion
    assert seen.counters["stuck"] == len(flagged)
    assert seen.kinds() == ["ACCEL_STUCK", "ACCEL_STUCK_END"]
    begin = seen.notes[0]
    assert isinstance(begin, Event)
    assert begin.text.startswith(f"z stays at {x[place, 2]:.6g} m/s2 though")


def test_a_sensor_that_hangs_is_told_for_each_axis() -> None:
    x = noise(4000, 5.0)
    x[3000:] = x[3000]
    seen = watch(x)
    assert seen.kinds() == ["ACCEL_STUCK"] * 3
    assert seen.at(STUCK)[-1] == 3999


# --------------------------------------------------------------------------------------------- what must not be flagged


def quiet(steps: float, wander: float, n: int, seed: int) -> F64:
    """A sensor of coarse steps whose noise is a fraction of one, while temperature takes it across the steps."""
    rng = np.random.default_rng(seed)
    slow = np.cumsum(rng.standard_normal((n, 3)), axis=0) * wander
    return np.asarray(np.rint(slow + rng.standard_normal((n, 3)) * steps) * 0.125)


@pytest.mark.parametrize("steps", [0.0, 0.05, 0.2, 0.4, 0.6, 0.8, 1.0])
def test_a_quiet_sensor_of_coarse_steps_is_never_stuck(steps: float) -> None:
    """4 hours at 100 Hz in four runs: values that stay for minutes between the edges of a step, and toggle at them."""
    longest = 0
    for seed in range(4):
        x = quiet(steps, 0.002, 360_000 // 4, seed)
        seen = watch(x, 100)
        assert seen.at(STUCK) == [], (steps, seed)
        assert seen.at(SPIKE) == []
        moved = np.flatnonzero(np.diff(x[:, 0]))
        longest = max(longest, int(np.diff(moved, prepend=0, append=len(x)).max()))
    if steps <= 0.2:
        assert longest > 10 * STUCK_RUN  # what it would be taken for by its run alone


def test_a_busy_day_and_the_quiet_after_it_are_no_stuck_axis() -> None:
    """GIVEN an 8-bit sensor that has seen nothing but traffic. WHEN the bridge comes to rest. THEN it is not stuck."""
    rng = np.random.default_rng(3)
    n = 20_000
    for decay in (50, 200, 1000):  # samples: 0.5 to 10 s
        level = np.where(np.arange(n) < 12_000, 1.0, np.exp(-(np.arange(n) - 12_000) / decay))
        x = np.rint(rng.standard_normal((n, 3)) * 6.0 * level[:, None] + rng.standard_normal((n, 3)) * 0.05) * 0.125
        seen = watch(x)
        assert np.ptp(x[-2000:], axis=0).max() == 0.0
        assert seen.at(STUCK) == [], decay


def test_a_sensor_that_repeats_its_samples_is_no_stuck_one() -> None:
    """Sent four times faster than it samples."""
    x = np.repeat(noise(20_000, 1.2), 4, axis=0)
    assert watch(x).at(STUCK) == []


def test_false_rates_in_noise() -> None:
    """10 million samples of noise of every size: none."""
    for steps in (0.3, 0.7, 0.8, 1.0, 2.0, 10.0):
        x = noise(550_000, steps, seed=int(steps * 10))
        seen = watch(x, 5000)
        assert not seen.flags.any()
        assert seen.kinds() == []


def real(shared: Path) -> dict[str, F64]:
    """Real accelerations in m/s2 (n, 1 or 3)."""
    found: dict[str, F64] = {}
    found["B1"] = np.loadtxt(shared / "B1-tohoku2011-gps0041-fks011" / "acc.dat")[:, 1]
    tower = np.loadtxt(shared / "B3-unison-tower-shaker" / "wn_02.dat")
    for k, scale in enumerate((1.0, 9.8, -9.8, 2.0, 2.0, 1.0, 1.0)):
        found[f"B3 {k}"] = tower[:, k] * scale
    car = np.genfromtxt(shared / "B4-f9p-rtk-and-imu-walk-drive" / "imu_1934.csv", delimiter=",")
    found["B4"] = car[:, :3] * 9.80665
    bridge = next((shared / "C1-munich-test-bridge").glob("*.zip"))
    with zipfile.ZipFile(bridge) as z, z.open(z.namelist()[0]) as f:
        found["C1"] = np.genfromtxt(f, delimiter=",", skip_header=1, usecols=1) * 9.80665
    knet = (shared / "C2-obspy-strong-motion" / "test.knet").read_text().splitlines()[17:]
    found["C2"] = np.array([int(v) for line in knet for v in line.split()]) * (20.0 / 8388608)
    return found


def test_real_structures_earthquakes_and_cars(shared_data: Path) -> None:
    """GIVEN 560 000 real samples: an earthquake of magnitude 9, a tower on a shaker, a drive, a bridge under load.
    THEN nothing is stuck, and the only spikes are the glitches of one of the tower's channels: single samples by
    -0.25 to -0.3 m/s2 out of quiet."""
    samples = 0
    for name, x in real(shared_data).items():
        seen = watch(x)
        samples += x.size
        assert seen.at(STUCK) == [], name
        if name != "B3 2":
            assert seen.at(SPIKE) == [], name
            continue
        places = seen.at(SPIKE)
        assert 4 <= len(places) <= 5
        for k in places:
            assert 0.2 < np.median(x[k - 3 : k + 4]) - x[k] < 0.35
    assert samples > 550_000


def test_a_real_recording_of_coarse_steps(shared_data: Path) -> None:
    """D1: 0.125 m/s2 a step, 95 equal payloads in a row."""
    lines = (shared_data / "D1-canedge-imu-mf4" / "derived" / "00000005-60FEB5A8.gnss_imu.csv").read_text().splitlines()
    columns = [lines[0].split(",").index(f"Acceleration{a}") for a in "XYZ"]
    x = np.array([[float(line.split(",")[c]) for c in columns] for line in lines[1:]])
    for k in range(20):  # once is not long enough to learn from and to be judged
        seen = watch(np.concatenate([x] * (1 + k % 2)), 10 + k)
        assert not seen.flags.any()


# ---------------------------------------------------------------------------------------------------- through the codec


def codec_frames(x: F64) -> CanFrames:
    raw = np.rint(x / 0.001).astype(int)
    return frames([triple(T0 + k * 10 * MS, (a, b, c), k % 256) for k, (a, b, c) in enumerate(raw.tolist())])


def rough(seed: int) -> F64:
    rng = np.random.default_rng(seed)
    x = noise(2200, 3.0, seed)
    x[:, 2] -= 9.806
    for place in rng.integers(200, 2190, 12):
        x[place, rng.integers(3)] += rng.choice([-1, 1]) * 10 ** rng.uniform(-1, 1)
    begin = int(rng.integers(LEARNED, 1800))
    x[begin : begin + int(rng.integers(20, 400)), rng.integers(3)] = 0.004
    return x


@settings(deadline=None, max_examples=25, derandomize=True)
@given(seed=st.integers(0, 10_000), places=st.lists(st.integers(0, 2200), max_size=60), at=st.integers(0, 61))
def test_any_cut_gives_the_same_flags_and_a_loaded_codec_goes_on(seed: int, places: Sequence[int], at: int) -> None:
    config = accel(unit="m/s2", counter=COUNTER, range_mps2=8.0)
    block = codec_frames(rough(seed))
    whole_codec = AccelCodec(config)
    whole, whole_notes = run(whole_codec, [block])
    pieces = cut(block, places)
    codec = AccelCodec(config)
    first, notes = run(codec, pieces[:at])
    fresh = AccelCodec(config)
    fresh.load(unpack(pack(codec.save())))
    second, more = run(fresh, pieces[at:])
    for name in ("t_ns", "xyz", "flags", "count"):
        assert np.concatenate([getattr(b, name) for b in (first, second)]).tobytes() == getattr(whole, name).tobytes()
    found = [[n for n in each if isinstance(n, Event)] for each in (notes + more, whole_notes)]
    assert sorted(found[0], key=str) == sorted(found[1], key=str)
    assert pack(fresh.save()) == pack(whole_codec.save())


def test_the_rough_records_have_everything() -> None:
    """Else the test above would prove little."""
    total: dict[str, int] = {}
    for seed in range(20):
        codec = AccelCodec(accel(unit="m/s2", counter=COUNTER, range_mps2=8.0))
        run(codec, [codec_frames(rough(seed))])
        total = {k: total.get(k, 0) + v for k, v in codec.counters.items()}
    assert min(total[k] for k in ("spikes", "stuck", "saturated")) > 0


def test_the_codec_hands_on_the_flags_in_structure_axes() -> None:
    x = noise(2000, 3.0)
    x[:, 2] -= 9.806
    x[1500, 1] = 5.0
    x[1700:, 0] = 0.002
    turned = ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    codec = AccelCodec(accel(unit="m/s2", fields=TRIPLE, rotation=turned))
    samples, notes = run(codec, cut(codec_frames(x), list(range(25, 2000, 25))))
    assert np.flatnonzero(samples.flags & SPIKE).tolist() == [1500]
    assert samples.xyz[1500, 0] == pytest.approx(5.0)
    assert np.flatnonzero(samples.flags & STUCK).size == codec.counters["stuck"] > 200
    assert [n.kind for n in notes if isinstance(n, Event)][:2] == ["ACCEL_SPIKE", "ACCEL_STUCK"]
