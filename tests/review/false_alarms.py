"""How often does `review` accuse sound sensors? Simulated records of several scenarios and seeds through the real path
(bytes of the ports, codecs, filter, MCAP), then the review's own comparison of the sensors.

    python tests/review/false_alarms.py [RECORDS OF EACH SCENARIO]

Every record is sound, so every window that speaks against its accelerometer, and every report that tells of a
contradiction, is false. Then the same records with something wrong: what is found of it. Minutes, so not among the
tests.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
from pathlib import Path

import numpy as np

from edge_agent.__main__ import main
from edge_agent.review.agree import Agreement, agree
from edge_agent.review.gather import Busy, gather
from edge_agent.review.smooth import Accelerations, Fixes, plain
from edge_agent.simulate import SCENARIOS, run
from edge_agent.simulate.files import write_files

SECONDS = {"clean": 300, "rough": 300, "hostile": 600, "floaty": 600, "P0": 600, "P1": 600, "P3": 400, "P4": 900}
WRONG = {
    "sign": np.diag([-1.0, -1.0, -1.0]),
    "x and y swapped": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "twice the scale": 2.0 * np.eye(3),
}


def sensors(busy: Busy) -> tuple[Fixes, Accelerations]:
    """Fixes that the gate let in, and accelerations."""
    t, z, std = (v[busy.taken] if busy.trusted else v for v in busy.fixes)
    return plain(t, z, std), Accelerations(*busy.accel)


def records(name: str, seed: int) -> list[tuple[Agreement, Fixes, Accelerations]]:
    """What a review says of each point of a simulated record, and what it went by."""
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        at = Path(folder)
        write_files(run(SCENARIOS[name], seed, float(SECONDS[name])), at)
        with contextlib.redirect_stderr(io.StringIO()):
            assert main(["replay", str(at / "raw.mcap"), "-c", str(at / "config.yaml"), "-o", str(at / "f.mcap")]) == 0
        points = gather([at / "f.mcap"], smooth=False).points.values()
        return [(p.agreement, *sensors(p.busy)) for p in points if p.agreement is not None and p.busy is not None]


def tell(each: int) -> int:
    reports = wrong = windows = against = 0
    found: dict[str, int] = {}
    for name in SECONDS:
        for seed in range(1, each + 1):
            for a, fixes, accel in records(name, seed):
                w = a.windows
                bad = int(w.against.sum())
                reports, wrong = reports + 1, wrong + (a.verdict == "CONTRADICTION")
                windows, against = windows + len(w.share), against + bad
                print(f"{name} {seed}: {a.verdict}, windows {len(w.share)}, against {bad}: {a.text}", flush=True)
                cases = {k: Accelerations(accel.t_ns, accel.xyz @ M.T) for k, M in WRONG.items()}
                cases["0.5 s late"] = Accelerations(accel.t_ns + 500_000_000, accel.xyz)
                for case, spoilt in cases.items():
                    found[case] = found.get(case, 0) + (agree(fixes, spoilt).verdict == "CONTRADICTION")
    print(f"sound: {wrong} of {reports} reports and {against} of {windows} windows speak against the accelerometer")
    print("spoilt, told as a contradiction: " + ", ".join(f"{k} {n} of {reports}" for k, n in found.items()))
    return wrong


if __name__ == "__main__":
    sys.exit(1 if tell(int(sys.argv[1]) if len(sys.argv) > 1 else 6) else 0)
