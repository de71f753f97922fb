"""What the benchmark plays: a bridge in ambient vibration, triaxial accelerometers at 250 Hz on one CAN bus, one
receiver at 10 Hz that serves a fusion point for each of them."""

from __future__ import annotations

from pathlib import Path

from edge_agent.simulate.bridge import SimRecord, run
from edge_agent.simulate.files import write_files
from edge_agent.simulate.specs import Accel, Gnss, Modal, Scenario, Structure

RATE_HZ = 250
FIX_HZ = 10
SECONDS = {1: 200.0, 2: 110.0, 8: 170.0}
"""Points -> length of the record."""

_BRIDGE = Structure(
    thermal_m=(0.020, 0.010, 0.010),
    modes=(Modal(0.5, (0.006, 0.004, 0.003)), Modal(1.7, (0.002, 0.0015, 0.001))),
)


def simulate(points: int) -> SimRecord:
    """The record with so many points; frames lie evenly on the bus, with 0.1 ms of jitter, as a loaded one has."""
    slot = 1.0 / (RATE_HZ * points)
    accels = tuple(
        Accel(name=f"a{i}", rate_hz=float(RATE_HZ), latency_s=0.002 + i * slot, jitter_s=1e-4, bias_mps2=(0.01, 0.03))
        for i in range(points)
    )
    scenario = Scenario("bench", _BRIDGE, Gnss(latency_s=0.05, jitter_s=0.005), accels)
    return run(scenario, 1, SECONDS[points])


def prepare(folder: Path, points: int) -> Path:
    """The record as files in `folder`/`points`, made once."""
    place = folder / str(points)
    if not place.exists():
        write_files(simulate(points), place)
    return place
