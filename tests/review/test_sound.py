"""A review says nothing false of sound sensors: the hostile scenario through the real path (bytes of the ports, codecs,
filter, MCAP), with outliers in the start window, wrong fixes and lost samples. How often it is wrong over many records
is told by `false_alarms.py`."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge_agent.__main__ import main
from edge_agent.review.figures import as_json
from edge_agent.review.gather import gather
from edge_agent.review.report import page
from edge_agent.simulate import SCENARIOS, run
from edge_agent.simulate.files import write_files


def test_sound_sensors_with_hostile_fixes_are_not_accused(tmp_path: Path) -> None:
    write_files(run(SCENARIOS["hostile"], 1, 180.0), tmp_path)
    raw, config, fused = (str(tmp_path / n) for n in ("raw.mcap", "config.yaml", "fused.mcap"))
    assert main(["replay", raw, "-c", config, "-o", fused]) == 0
    r = gather([Path(fused)])
    twin, html = as_json(r), page(r)
    point = twin["points"]["deck"]
    a = point["agreement"]
    assert a["verdict"] == "AGREE"
    assert a["share_shown"] == pytest.approx(1.0, abs=0.1)
    assert len(a["windows"]) > 8
    assert sum(w["log_likelihood_with_less_without"] for w in a["windows"]) > 300
    assert not any("contradict" in text or "speak against" in text for text in twin["findings"])
    assert any("tell of the same motion" in text for text in twin["conclusions"])
    section = html.split('<section id="agreement">')[1].split("</section>")[0]
    assert "contradict" not in section
    assert "agree" in section
    assert "0 against" in section
    # two modes, and no third on the skirt of the second
    assert [round(f["freq_hz"], 1) for f in point["frequencies"]] == [0.5, 1.7]
    # what was assumed stands beside what was estimated, each under its name
    clocks = html.split('<section id="clocks">')[1].split("</section>")[0]
    assert "assumed 100 ms" in clocks
    assert "replaced as soon as" in clocks
    assert "estimated by the host\u2019s synchronised clock" in clocks
    assert "receivers.rover.latency_ms: 20" in clocks
    # one definition of the furthest displacement: from the reference
    d = point["displacement"]
    for axis, close in zip("xyz", r.points["deck"].close, strict=True):
        furthest = max((d[axis][k]["value_m"] for k in ("least", "largest")), key=abs)
        assert close.displacement_m[abs(close.displacement_m).argmax()] == pytest.approx(furthest, abs=1e-6)
    assert "in doubt" not in html
