"""Thresholds on fused motion: when an event begins and when it is over. Pure: live and replay find the same events.

An event begins with the first sample at or above the threshold. It is over when no sample has reached `release` times
the threshold for `hold_s`; its end is the last sample that did. So one oscillation is one event, and noise about the
threshold is not a hundred. Displacement and velocity count where their mode is valid; acceleration is the measured one
less the filter's bias, which holds gravity. Where the data ends, the event ends after `hold_s` + `LOST_S`.

Left out: what is kept of an event (recording/clips), faults (runtime).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from edge_agent.messages import (
    F64,
    I64,
    VALID_MODES,
    AccelBlock,
    Estimate,
    Event,
    EventSettings,
    PointSettings,
    S,
    State,
    TriggerSettings,
)

BEGIN, END = "TRIGGER", "TRIGGER_END"
LOST_S = 10.0
_AXES = {"x": 0, "y": 1, "z": 2}


class _Trigger:
    """One threshold and where it stands. `begin_ns` 0 = not in an event."""

    def __init__(self, settings: TriggerSettings, events: EventSettings) -> None:
        self.settings = settings
        self.above, self.unit, self.quantity = threshold(settings)
        self.low = events.release * self.above
        self.hold_ns = int(events.hold_s * S)
        self.begin_ns = self.last_ns = self.peak_ns = 0
        self.peak = 0.0

    def feed(self, t_ns: I64, size: F64) -> Iterable[Event]:
        """Samples in order of time; NaN counts as nothing."""
        if not t_ns.size or (not self.begin_ns and not (size >= self.above).any()):
            return
        at = 0
        while at < t_ns.size:
            if not self.begin_ns:
                over = np.flatnonzero(size[at:] >= self.above)
                if not over.size:
                    return
                at += int(over[0])
                self.begin_ns = self.last_ns = int(t_ns[at])
                self.peak, self.peak_ns = float(size[at]), self.begin_ns
                yield self._begun()
            high = at + np.flatnonzero(size[at:] >= self.low)
            times = np.concatenate([[self.last_ns], t_ns[high], [t_ns[-1]]])
            broken = np.flatnonzero(np.diff(times) > self.hold_ns)
            good = high if not broken.size else high[: int(broken[0])]
            if good.size:
                self.last_ns = int(t_ns[good[-1]])
                best = int(good[np.argmax(size[good])])
                if size[best] > self.peak:
                    self.peak, self.peak_ns = float(size[best]), int(t_ns[best])
            if not broken.size:
                return
            at = int(np.searchsorted(t_ns, self.last_ns + self.hold_ns, side="right"))
            yield self._over(int(t_ns[min(at, t_ns.size - 1)]))

    def expire(self, now_ns: int) -> Iterable[Event]:
        if self.begin_ns and now_ns - self.last_ns > self.hold_ns + LOST_S * S:
            yield self._over(now_ns)

    def _begun(self) -> Event:
        text = f"{self._what()} {self.peak:.4g} {self.unit}, at least {self.above:g}"
        values = (("value", self.peak), ("threshold", self.above))
        return Event(self.begin_ns, BEGIN, self.settings.name, text, values)

    def _over(self, t_ns: int) -> Event:
        seconds = (self.last_ns - self.begin_ns) / S
        text = f"{self._what()} reached {self.peak:.4g} {self.unit} in {seconds:.3f} s"
        values = (
            ("peak", self.peak),
            ("threshold", self.above),
            ("seconds", seconds),
            ("peak_after_s", (self.peak_ns - self.begin_ns) / S),
        )
        event = Event(t_ns, END, self.settings.name, text, values, self.begin_ns, self.last_ns)
        self.begin_ns = 0
        return event

    def _what(self) -> str:
        return f"{self.settings.point} {self.settings.axis} {self.quantity}"

    def size(self, values: F64) -> F64:
        """(n, 3) -> (n,): the magnitude that is compared."""
        axis = self.settings.axis
        if axis in _AXES:
            return np.abs(values[:, _AXES[axis]])
        if axis == "horizontal":
            return np.sqrt(values[:, 0] * values[:, 0] + values[:, 1] * values[:, 1])
        largest: F64 = np.abs(values).max(axis=1)
        return largest


def threshold(settings: TriggerSettings) -> tuple[float, str, str]:
    """The one threshold of a trigger on motion, its unit and its quantity. ValueError where there is none."""
    for above, unit, quantity in (
        (settings.above_m, "m", "displacement"),
        (settings.above_mps, "m/s", "velocity"),
        (settings.above_mps2, "m/s2", "acceleration"),
    ):
        if above is not None:
            return above, unit, quantity
    raise ValueError(f"trigger {settings.name}: no threshold")


class Triggers:
    """Every trigger on motion of a configuration."""

    def __init__(
        self, triggers: Iterable[TriggerSettings], events: EventSettings, points: Mapping[str, PointSettings]
    ) -> None:
        self._all = [_Trigger(t, events) for t in triggers if t.fault is None]
        self._of_accelerometer: dict[str, list[_Trigger]] = {}
        for t in self._all:
            name = points[t.settings.point or ""].accelerometer
            if t.quantity == "acceleration" and name is not None:
                self._of_accelerometer.setdefault(name, []).append(t)
        wanted = {t.settings.point for some in self._of_accelerometer.values() for t in some}
        self._bias: dict[str, F64 | None] = {p or "": None for p in wanted}

    def estimate(self, e: Estimate) -> list[Event]:
        """Take a block of the fused stream."""
        if not self._all or e.revision:
            return []
        if e.point in self._bias:
            self._bias[e.point] = e.bias_mps2
        out: list[Event] = []
        valid: np.ndarray | None = None
        for t in self._all:
            if t.settings.point != e.point or t.quantity == "acceleration":
                continue
            if valid is None:
                valid = np.isin(e.mode, VALID_MODES)
            values = e.displacement_m if t.quantity == "displacement" else e.velocity_mps
            out += t.feed(e.t_ns, np.where(valid, t.size(values), np.nan))
        return out

    def accelerations(self, name: str, block: AccelBlock) -> list[Event]:
        """Take a block of an accelerometer, times as the pipeline uses them."""
        out: list[Event] = []
        for t in self._of_accelerometer.get(name, ()):
            bias = self._bias[t.settings.point or ""]
            if bias is not None:
                out += t.feed(block.t_ns, t.size(block.xyz - bias))
        return out

    def expire(self, now_ns: int) -> list[Event]:
        """End events whose data has ended."""
        return [event for t in self._all if t.begin_ns for event in t.expire(now_ns)]

    def save(self) -> State:
        return {
            "at": {t.settings.name: [t.begin_ns, t.last_ns, t.peak_ns, t.peak] for t in self._all},
            "bias": self._bias,
        }

    def load(self, s: State) -> None:
        for t in self._all:
            t.begin_ns, t.last_ns, t.peak_ns, t.peak = s["at"][t.settings.name]
        self._bias = dict(s["bias"])
