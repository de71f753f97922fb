"""What the pipeline has learned of its sensors, as the state at the head of a segment tells it."""

from __future__ import annotations

from typing import NamedTuple

from edge_agent.messages import F64, S
from edge_agent.pipeline import Pipeline


class Learned(NamedTuple):
    """At UTC ns. Per point (3,): q [m2/s3], qb [m2/s5] and the factor on the variance of its fixes; per accelerometer
    its clock's rate against the nominal one, less 1; per receiver its latency [s] and whether that is configured,
    learned or assumed."""

    utc_ns: int
    points: dict[str, tuple[F64, F64, F64]]
    rates: dict[str, float]
    latencies: dict[str, tuple[float, str]]


def learned(pipeline: Pipeline, utc_ns: int) -> Learned:
    """What a pipeline knows now; accelerometers whose clock has not told its rate yet are left out."""
    station = pipeline.station
    points = {
        p.name: (station.q[i].copy(), station.qb[i].copy(), station.scale[i].copy())
        for i, p in enumerate(station.points)
    }
    rates = {name: e for name, a in pipeline.accelerometers.items() if (e := a.clock.rate_error) is not None}
    latencies = {}
    for name, r in pipeline.receivers.items():
        how = (
            "configured" if r.clock.fixed_ns is not None else "learned" if r.clock.learned_ns is not None else "assumed"
        )
        latencies[name] = r.clock.latency_ns() / S, how
    return Learned(utc_ns, points, rates, latencies)
