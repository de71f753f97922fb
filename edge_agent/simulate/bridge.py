"""A scenario run: motion and sensors into one record, and the same record as an oracle would see it.

Axes are E, N, U. Times are int64 ns: `t_ns` monotonic, UTC = t_ns + `SimRecord.utc_offset_ns`. The same seed gives
every scenario of one structure the same motion and the same white noise, whatever faults are switched on.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from edge_agent.simulate.motion import Motion, Truth, bridge_motion, pick
from edge_agent.simulate.sensors import AccelTrack, FixLabel, FixTrack, accel_samples, gnss_fixes
from edge_agent.simulate.specs import EPOCH_UTC_NS, START_NS, Scenario

MAX_S = 14_400.0
"""A record is held in memory as arrays, about 0.1 MB for each second on the way."""


@dataclass(frozen=True, slots=True)
class SimRecord:
    scenario: Scenario
    seed: int
    utc_offset_ns: int
    motion: Motion
    fixes: FixTrack
    truth_at_fixes: Truth
    accels: tuple[AccelTrack, ...]
    truths: tuple[Truth, ...]  # one per accelerometer, at its `true_ns`

    @property
    def accel(self) -> AccelTrack:
        return self.accels[0]

    @property
    def truth(self) -> Truth:
        """At the first accelerometer's instants, or the fixes' where there is none."""
        return self.truths[0] if self.truths else self.truth_at_fixes


def run(scenario: Scenario, seed: int, duration_s: float | None = None, utc_ns: int = EPOCH_UTC_NS) -> SimRecord:
    """Simulate `scenario`: `duration_s` None = its own length, `utc_ns` = UTC of second 0 (a multiple of the fixes'
    interval, as receivers fix at whole fractions of UTC). Raises ValueError for a length that is not positive."""
    length = scenario.duration_s if duration_s is None else duration_s
    if not 0 < length <= MAX_S:
        raise ValueError(f"simulate: the duration must be above 0 and at most {MAX_S:.0f} s")
    motion = bridge_motion(scenario, seed, length)
    fixes, at_fixes = gnss_fixes(scenario, seed, length, motion)
    pairs = [accel_samples(a, seed, length, motion) for a in scenario.accels]
    return SimRecord(
        scenario,
        seed,
        utc_ns - START_NS,
        motion,
        fixes,
        at_fixes,
        tuple(p[0] for p in pairs),
        tuple(p[1] for p in pairs),
    )


def oracle(record: SimRecord) -> SimRecord:
    """The same record with labelled outliers removed and the wrong fixes' true offsets subtracted.

    Drops, noise, latency, float spells and datum steps stay: what a filter with perfect labels would see.
    """
    f = record.fixes
    wrong = f.label == FixLabel.WRONG
    z = np.where(wrong[:, None], f.z_m - f.offset_m, f.z_m)
    offset = np.where(wrong[:, None], 0.0, f.offset_m)
    label = np.where(wrong, FixLabel.GOOD, f.label).astype(np.uint8)
    keep = f.label != FixLabel.OUTLIER
    fixes = FixTrack(
        f.t_ns[keep], f.arrival_ns[keep], z[keep], f.std_m[keep], f.quality[keep], label[keep], offset[keep]
    )
    return replace(record, fixes=fixes, truth_at_fixes=pick(record.truth_at_fixes, keep))
