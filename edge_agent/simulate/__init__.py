"""Simulated structures and sensors with exact truth: numbers, wire bytes, players for real ports.

`specs` says what there can be, `scenarios` is the table of named cases, `motion` and `sensors` make the numbers,
`bridge` a record of them; `encode` puts them on the wires, `files` into a recording, `play` onto real ports. Only this
package draws random numbers, always from a seed: the same seed gives the same bytes.
"""

from edge_agent.simulate.bridge import SimRecord, oracle, run
from edge_agent.simulate.motion import Motion, Truth
from edge_agent.simulate.scenarios import SCENARIOS, simulate
from edge_agent.simulate.sensors import AccelTrack, FixLabel, FixTrack
from edge_agent.simulate.specs import Accel, Fault, Gnss, Modal, Ramp, Scenario, Structure

__all__ = [
    "SCENARIOS",
    "Accel",
    "AccelTrack",
    "Fault",
    "FixLabel",
    "FixTrack",
    "Gnss",
    "Modal",
    "Motion",
    "Ramp",
    "Scenario",
    "SimRecord",
    "Structure",
    "Truth",
    "oracle",
    "run",
    "simulate",
]
