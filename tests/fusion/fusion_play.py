"""Hands numbers to a `Station` as the pipeline would, and collects what comes back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from edge_agent.fusion.station import Station
from edge_agent.messages import (
    AccelBlock,
    Estimate,
    Event,
    FusionSettings,
    Innovation,
    Measurement,
    PointSettings,
    Quality,
)
from edge_agent.simulate import SimRecord

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
S = 1_000_000_000
T0 = 1000 * S
STD = (0.003, 0.003, 0.006)


@dataclass
class Played:
    station: Station
    estimates: list[Estimate] = field(default_factory=list)
    innovations: list[Innovation] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    def take(self, items: Sequence[Estimate | Innovation | Event]) -> None:
        for m in items:
            if isinstance(m, Estimate):
                self.estimates.append(m)
            elif isinstance(m, Innovation):
                self.innovations.append(m)
            else:
                self.events.append(m)

    def of(self, point: str) -> list[Estimate]:
        return [e for e in self.estimates if e.point == point]

    def column(self, name: str, point: str | None = None) -> F64:
        chosen = self.estimates if point is None else self.of(point)
        return np.concatenate([getattr(e, name) for e in chosen])

    @property
    def t(self) -> I64:
        return np.concatenate([e.t_ns for e in self.estimates])

    @property
    def d(self) -> F64:
        return self.column("displacement_m")

    @property
    def sd(self) -> F64:
        return self.column("std_displacement_m")

    def kinds(self) -> list[str]:
        return [e.kind for e in self.events if e.kind != "MODE"]


Item = tuple[int, str, object]  # when, "a" or "r", block or measurement


def accel_items(t: I64, xyz: F64, cuts: Sequence[int], arrival: I64 | None = None, name: str = "a") -> list[Item]:
    """Blocks of samples cut before each index of `cuts`; each arrives with its last sample."""
    edges = [0, *cuts, len(t)]
    when = t if arrival is None else arrival
    return [
        (int(when[j - 1]), name, AccelBlock(name, t[i:j], xyz[i:j], np.zeros(j - i, np.uint8), np.arange(i, j)))
        for i, j in pairwise(edges)
        if j > i
    ]


def fix_items(
    t: I64,
    z: F64,
    latency_ns: int | I64 = 0,
    std: tuple[float, float, float] = STD,
    quality: Sequence[int] | None = None,
) -> list[Item]:
    late = np.broadcast_to(np.asarray(latency_ns), t.shape)
    return [
        (
            int(t[i] + late[i]),
            "r",
            Measurement(
                int(t[i]),
                int(t[i] + late[i]),
                (float(z[i, 0]), float(z[i, 1]), float(z[i, 2])),
                std,
                Quality.FIXED if quality is None else Quality(int(quality[i])),
            ),
        )
        for i in range(len(t))
    ]


def hand(played: Played, item: Item) -> None:
    now, _, what = item
    st = played.station
    if isinstance(what, AccelBlock):
        played.take(st.accelerations({what.source: what}, now))
    else:
        assert isinstance(what, Measurement)
        played.take(st.fix("r", what, now))
    played.take(st.advance(now))


def play(
    items: list[Item], settings: FusionSettings | None = None, points: Sequence[PointSettings] | None = None
) -> Played:
    """In the order of arrival; of two at the same instant the one that stands first."""
    played = Played(Station(points or [PointSettings("p", "r", "a")], settings or FusionSettings()))
    for item in sorted(items, key=lambda i: i[0]):
        hand(played, item)
    return played


def blocks_of(t: I64, step_ns: int = S // 10) -> list[int]:
    """Cuts of a block every 100 ms."""
    return [int(i) for i in np.flatnonzero(np.diff((t - t[0]) // step_ns)) + 1]


def play_record(record: SimRecord, settings: FusionSettings | None = None) -> Played:
    """A simulated record, accelerations in blocks of 100 ms."""
    f, a = record.fixes, record.accel
    arrival = np.maximum.accumulate(a.arrival_ns)
    items = accel_items(a.t_ns, a.xyz, blocks_of(arrival), arrival)
    items += [
        (
            int(f.arrival_ns[i]),
            "r",
            Measurement(
                int(f.t_ns[i]),
                int(f.arrival_ns[i]),
                tuple(f.z_m[i].tolist()),
                tuple(f.std_m[i].tolist()),
                Quality(int(f.quality[i])),
            ),
        )
        for i in range(len(f.t_ns))
    ]
    return play(items, settings)


def bridge(
    seconds: float, rate: int = 100, seed: int = 0, offset_ns: int = 0, hz: int = 10
) -> tuple[I64, F64, F64, I64, F64, F64]:
    """A swinging point: sample times, accelerations with bias and gravity, truth there; fix times, fixes, truth there.

    The fixes lie `offset_ns` after samples, so they fall between them.
    """
    rng = np.random.default_rng(seed)
    n = int(seconds * rate) + 1
    t = T0 + (np.arange(n) * S) // rate
    w = 2 * np.pi * 0.5
    amp = np.array([0.006, 0.004, 0.003])

    def d(at: F64) -> F64:
        return np.sin(w * at)[:, None] * amp + 0.01 * np.sin(2 * np.pi * at / 900)[:, None]

    def acc(at: F64) -> F64:
        return -w * w * np.sin(w * at)[:, None] * amp

    at = (t - T0) / S
    xyz = acc(at) + np.array([0.03, -0.02, 9.82]) + rng.standard_normal((n, 3)) * 2.2e-4 * np.sqrt(rate / 2)
    tf = T0 + offset_ns + (np.arange(int(seconds * hz)) * S) // hz
    af = (tf - T0) / S
    z = d(af) + rng.standard_normal((len(tf), 3)) * np.array(STD)
    return t, xyz, d(at), tf, z, d(af)


def same(a: Played, b: Played) -> bool:
    """Every byte of the fused stream, but for the borders of the blocks, and of every innovation."""
    names = ("t_ns", "displacement_m", "velocity_mps", "std_displacement_m", "std_velocity_mps", "mode", "flags")
    stream = all(a.column(n).tobytes() == b.column(n).tobytes() for n in names)
    gate = len(a.innovations) == len(b.innovations) and all(
        (x.t_ns, x.ratio, x.verdict) == (y.t_ns, y.ratio, y.verdict)
        and x.residual_m.tobytes() == y.residual_m.tobytes()
        and x.variance_m2.tobytes() == y.variance_m2.tobytes()
        and x.offset_m.tobytes() == y.offset_m.tobytes()
        for x, y in zip(a.innovations, b.innovations, strict=True)
    )
    return stream and gate and [e.kind for e in a.events] == [e.kind for e in b.events]
