"""The papers side by side in the report's figures: simulated records through the real path (bytes of the ports, codecs,
clocks, filter, MCAP), then `review`, then its JSON twin. Nominal frequencies are the simulation's input; sd is the
twin's."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edge_agent.__main__ import main
from edge_agent.review.figures import as_json
from edge_agent.review.gather import Review, gather
from edge_agent.review.report import page
from edge_agent.review.spectra import band
from edge_agent.simulate import SCENARIOS, run
from edge_agent.simulate.bridge import SimRecord
from edge_agent.simulate.files import write_files


def reviewed(
    folder: Path, name: str, seconds: float, accelerometer: int = 0
) -> tuple[SimRecord, Review, dict[str, Any], str]:
    """A scenario with one of its accelerometers: the record, what the review gathered, its twin, its page."""
    scenario = SCENARIOS[name]
    record = run(replace(scenario, accels=(scenario.accels[accelerometer],)), 1, seconds)
    write_files(record, folder)
    raw, config, fused = (str(folder / n) for n in ("raw.mcap", "config.yaml", "fused.mcap"))
    assert main(["replay", raw, "-c", config, "-o", fused]) == 0
    gathered = gather([Path(fused)])
    twin = json.loads(json.dumps(as_json(gathered), allow_nan=False))
    return record, gathered, twin, page(gathered)


def near(point: dict[str, Any], want: float) -> dict[str, Any]:
    """The one frequency of the twin that is this one: within 0.5 %, or three of its sd where the record is short."""
    found = [f for f in point["frequencies"] if abs(f["freq_hz"] - want) < max(0.005 * want, 3 * f["std_hz"])]
    assert len(found) == 1, (want, point["frequencies"])
    return dict(found[0])


def test_p0_the_bridge_model_rings_in_the_fused_displacement_and_hardly_in_the_receiver(tmp_path: Path) -> None:
    """Lima et al.: 1.13, 4.45, 7.27 Hz from accelerations and from the fused displacement; GNSS alone misses the
    third."""
    _, _, twin, _ = reviewed(tmp_path, "P0", 150.0, 1)
    point = twin["points"]["deck"]
    assert len(point["frequencies"]) <= 4
    for want in (1.13, 4.45, 7.27):
        f = near(point, want)
        assert abs(f["fused_hz"] - want) < 0.03 * want
        if want == 1.13:
            assert abs(f["gnss_hz"] - want) < 0.03 * want
        if want == 7.27:
            assert f["gnss_hz"] is None
    assert point["displacement"]["x"]["largest"]["value_m"] > 0.01  # the slider


def test_p1_the_high_rise_on_its_weak_axis(tmp_path: Path) -> None:
    """Wang et al.: .21, .34, .44 Hz equal in both sensors; higher modes only in the fused displacement; its second
    difference is the acceleration, also on the weakly excited axis, where that of the raw fixes is noise; bands."""
    record, gathered, twin, html = reviewed(tmp_path, "P1", 600.0)
    point = twin["points"]["deck"]
    for want in (0.21, 0.34, 0.44):
        f = near(point, want)
        assert abs(f["fused_hz"] - want) < 0.03 * want
        assert abs(f["gnss_hz"] - want) < 0.03 * want
    for want in (1.05, 1.72):
        f = near(point, want)
        assert abs(f["fused_hz"] - want) < 0.03 * want
        assert f["gnss_hz"] is None
    weak = 1
    differences = point["second_difference"]
    assert differences["smoothed"]["correlation"][weak] > 0.98
    assert abs(differences["smoothed"]["gain"][weak] - 1) < 0.02
    assert differences["live"]["correlation"][weak] > 0.6
    assert abs(differences["raw GNSS"]["correlation"][weak]) < 0.3
    bands = point["wavelets"]["bands"]
    assert [round(b["freq_hz"], 2) for b in bands] == [0.21, 0.34, 0.44]
    p = gathered.points["deck"]
    assert p.wavelets is not None
    t = (record.truth.t_ns + record.utc_offset_ns - p.wavelets.begin_ns) / 1e9
    for b, told in zip(p.wavelets.bands, bands, strict=True):  # what was taken out moves as the truth does there
        assert told["rms_fused_m"] < 1.02 * told["rms_gnss_m"]
        true = np.interp((b.t_ns - p.wavelets.begin_ns) / 1e9, t, record.truth.d_m[:, p.wavelets.axis])
        true = band(true, 1e9 / (b.t_ns[1] - b.t_ns[0]), b.low_hz, b.high_hz, per_octave=24)
        inside = slice(len(true) // 5, -len(true) // 5)
        assert np.corrcoef(true[inside], b.value_m[inside])[0, 1] > 0.9
    assert html.count("data:image/png;base64,") == 1


def test_p3_g_type_and_d_type_beside_the_filter(tmp_path: Path) -> None:
    """The arch-bridge patent: split at the fundamental; both types follow the motion as the filter does."""
    record, gathered, twin, html = reviewed(tmp_path, "P3", 200.0)
    told = twin["points"]["deck"]["split"]
    assert abs(told["critical_hz"] - 0.91) < 0.02
    assert told["compared_s"] > 60
    p = gathered.points["deck"]
    assert p.split is not None
    assert p.apart is not None
    assert p.busy is not None
    fair = p.apart.fair
    t = p.split.t_ns + p.busy.utc_minus_ns - record.utc_offset_ns
    for axis in range(3):
        true = np.interp(t, record.truth.t_ns, record.truth.d_m[:, axis])
        wrong = {
            "filter": p.apart.live_m[:, axis] - true,
            "g": p.split.g_type_m[:, axis] - true,
            "d": p.split.d_type_m[:, axis] - true,
        }
        rms = {k: float(np.std(v[fair])) for k, v in wrong.items()}
        print(f"P3 {'xyz'[axis]}: error {', '.join(f'{k} {1e3 * v:.2f} mm' for k, v in rms.items())}")
        assert max(rms["g"], rms["d"]) < 0.003 if axis < 2 else 0.005
        for kind, error in (("g", rms["g"]), ("d", rms["d"])):
            assert told[f"rms_{kind}_type_less_filter_m"][axis] < 1.5 * np.hypot(error, rms["filter"])
    section = html.split('<section id="split">')[1].split("</section>")[0]
    for text in ("G-type", "D-type", "live filter"):
        assert section.count(f"</i>{text}<") == 3


def test_p4_the_long_bridge_from_fixes_of_one_hertz(tmp_path: Path) -> None:
    """Shan & Qi: .309, .507, .645 Hz from accelerations and fused displacement; from fixes at 1 Hz only the first."""
    _, _, twin, _ = reviewed(tmp_path, "P4", 600.0)
    point = twin["points"]["deck"]
    for want in (0.309, 0.507, 0.645):
        f = near(point, want)
        assert abs(f["fused_hz"] - want) < 0.03 * want
        if want > 0.5:
            assert f["gnss_hz"] is None
