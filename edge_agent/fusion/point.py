"""What the station keeps per point besides the stacked arrays: plain values, all of them saved."""

from __future__ import annotations

from typing import Any

from edge_agent.fusion.gate import Gate
from edge_agent.messages import F64, Measurement, Mode, PointSettings, Quality, State


class Gap:
    """A stretch without accelerations, bridged by their mean: noise q (3,) [m2/s3] between begin and end."""

    __slots__ = ("begin_ns", "end_ns", "q")

    def __init__(self, begin_ns: int, end_ns: int, q: F64) -> None:
        self.begin_ns, self.end_ns, self.q = begin_ns, end_ns, q


class Wait:
    """A fix that waits for accelerations up to its time."""

    __slots__ = ("deadline_ns", "fix")

    def __init__(self, fix: Measurement, deadline_ns: int) -> None:
        self.fix, self.deadline_ns = fix, deadline_ns


_SIMPLE = (
    "started", "aided", "floating", "uncertain", "anchor_ns", "used_ns", "begun_ns", "posterior_ns", "run_ns",
    "nominal_ns", "window_aided", "mode", "fixes", "since_bank", "stuck",
)  # fmt: skip


class Point:
    def __init__(self, settings: PointSettings) -> None:
        self.name = settings.name
        self.receiver = settings.receiver
        self.accelerometer = settings.accelerometer
        self.gate = Gate()
        self.started = False
        self.aided = False  # accelerations drive the prediction
        self.floating = False
        self.uncertain = False
        self.anchor_ns = 0
        self.used_ns = 0  # last fix that was used
        self.begun_ns = 0  # start of the present model (with or without accelerations)
        self.posterior_ns = 0
        self.run_ns = -1  # accelerations are uninterrupted since
        self.nominal_ns = 0  # interval of the samples, learnt; 0 = not yet
        self.stuck = False  # the newest samples are of a stuck axis
        self.intervals: list[int] = []
        self.gaps: list[Gap] = []  # that end after the anchor
        self.hold: Gap | None = None  # the gap that goes on, from its begin
        self.pending: list[Wait] = []
        self.window: list[tuple[int, F64, F64, F64, F64]] = []  # start window: t, s1, s2, z, sd
        self.window_aided = False
        self.mode = int(Mode.INIT)
        self.fixes = 0  # learnt from since the start, for the tracker's first steps
        self.since_bank = 0.0  # seconds of increments that the bank has not seen

    def save(self) -> State:
        s: State = {k: getattr(self, k) for k in _SIMPLE}
        s["gate"] = self.gate.save()
        s["intervals"] = list(self.intervals)
        s["gaps"] = [[g.begin_ns, g.end_ns, g.q] for g in self.gaps]
        s["hold"] = None if self.hold is None else [self.hold.begin_ns, self.hold.end_ns, self.hold.q]
        s["pending"] = [_save_fix(w) for w in self.pending]
        s["window"] = [list(w) for w in self.window]
        return s

    def load(self, s: State) -> None:
        for k in _SIMPLE:
            setattr(self, k, s[k])
        self.gate.load(s["gate"])
        self.intervals = list(s["intervals"])
        self.gaps = [Gap(*g) for g in s["gaps"]]
        self.hold = None if s["hold"] is None else Gap(*s["hold"])
        self.pending = [_load_fix(f) for f in s["pending"]]
        self.window = [(w[0], w[1], w[2], w[3], w[4]) for w in s["window"]]


def _save_fix(w: Wait) -> list[Any]:
    f = w.fix
    return [w.deadline_ns, f.t_ns, f.arrival_ns, list(f.z_m), list(f.std_m), int(f.quality), f.time_uncertain]


def _load_fix(v: list[Any]) -> Wait:
    deadline, t, arrival, z, std, quality, uncertain = v
    return Wait(
        Measurement(t, arrival, (z[0], z[1], z[2]), (std[0], std[1], std[2]), Quality(quality), uncertain), deadline
    )
