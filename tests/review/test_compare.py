"""Two settings side by side: every figure against the two recordings, read by other means."""

from __future__ import annotations

import csv
import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.__main__ import main
from edge_agent.review.compare import Both, Side, as_text, compare
from edge_agent.simulate import SCENARIOS, run
from edge_agent.simulate.files import write_files

F64 = npt.NDArray[np.float64]
SETS = ("fusion.accel_noise_m2ps3=1e-3", "fusion.accel_noise_decades=0.05", "fusion.gate_alpha=0.05")
FLAGS = tuple(part for s in SETS for part in ("--set", s))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """75 s with outliers, lost samples and late fixes: fused; and replayed from nothing by each of the settings."""
    at = tmp_path_factory.mktemp("compare")
    write_files(run(SCENARIOS["rough"], 5, 75.0), at)
    raw, config = str(at / "raw.mcap"), str(at / "config.yaml")
    assert main(["replay", raw, "-c", config, "-o", str(at / "fused.mcap")]) == 0
    assert main(["replay", raw, "-c", config, *FLAGS, "-o", str(at / "other.mcap")]) == 0
    return at


@pytest.fixture(scope="module")
def told(folder: Path) -> Any:
    """The JSON that the command prints, with its page written."""
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as m:
        m.setattr("sys.stdout", out)
        (folder / "kept").mkdir()
        out_files = ("-o", str(folder / "kept" / "new.mcap"), "--page", str(folder / "page.html"))
        assert main(["replay", str(folder / "fused.mcap"), *FLAGS, "--compare", *out_files, "--json"]) == 0
    return json.loads(out.getvalue())


def column(path: Path, topic: str, capsys: pytest.CaptureFixture[str]) -> list[dict[str, str]]:
    capsys.readouterr()
    assert main(["cat", str(path), "--topic", topic]) == 0
    return list(csv.DictReader(io.StringIO(capsys.readouterr().out)))


def numbers(rows: list[dict[str, str]], *starts: str) -> F64:
    """Columns whose names start so."""
    keys = [next(k for k in rows[0] if k.startswith(s)) for s in starts]
    return np.array([[float(r[k]) for k in keys] for r in rows])


def test_every_figure_is_that_of_the_two_recordings(
    folder: Path, told: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    point = told["points"]["deck"]
    assert told["settings"] == list(SETS)
    moved, scores = {}, {}
    for side, name in (("old", "fused.mcap"), ("new", "other.mcap")):
        rows = column(folder / name, "/fusion/deck/block", capsys)
        d = numbers(rows, "displacement_x", "displacement_y", "displacement_z")
        sd = numbers(rows, "std_displacement_x", "std_displacement_y", "std_displacement_z")
        mode = next(k for k in rows[0] if k.startswith("mode"))
        valid = np.array([r[mode] in ("FUSED", "GNSS_ONLY", "COAST") for r in rows])
        times = [r[next(iter(r))] for r in rows]
        moved[side] = {t: (a, b) for t, a, b, v in zip(times, d, sd, valid, strict=True) if v}
        assert point[side]["samples"] == len(rows)
        at = np.array([t[:26] for t in times], "datetime64[us]").astype(np.int64) / 1e6
        steps = np.diff(at[valid])  # of the time from the first fix to the last sample
        fixes = column(folder / name, "/gnss/rover/solution", capsys)
        begin = np.array([r[next(iter(r))][:26] for r in fixes], "datetime64[us]").astype(np.int64).min() / 1e6
        assert point[side]["availability"] == pytest.approx(steps[steps < 1].sum() / (at[-1] - begin), rel=1e-3)
        rows = column(folder / name, "/fusion/deck/update", capsys)
        verdict = [r["verdict"] for r in rows]
        e = numbers(rows, "residual_x", "residual_y", "residual_z")
        s = numbers(rows, "std_residual_x", "std_residual_y", "std_residual_z")
        taken = np.array([v == "ACCEPTED" for v in verdict])
        gated = sum(v in ("ACCEPTED", "REJECTED", "OFFSET") for v in verdict)
        assert point[side]["share_refused"] == pytest.approx(verdict.count("REJECTED") / gated, rel=1e-5)
        assert point[side]["rms_innovation_m"] == pytest.approx(np.sqrt((e[taken] ** 2).mean(axis=0)), rel=1e-4)
        assert point[side]["mean_nis"] == pytest.approx(((e / s)[taken] ** 2).sum(axis=1).mean(), rel=1e-4)
        each = -0.5 * (np.log(2 * math.pi * s**2) + (e / s) ** 2).sum(axis=1)
        scores[side] = {r[next(iter(r))]: v for r, v, t in zip(rows, each, taken, strict=True) if t}
    both = sorted(moved["old"].keys() & moved["new"].keys())
    apart = np.array([moved["new"][t][0] - moved["old"][t][0] for t in both])
    assert point["common_samples"] == len(both) > 5000
    assert point["rms_difference_m"] == pytest.approx(np.sqrt((apart**2).mean(axis=0)), rel=1e-4)
    assert point["largest_difference_m"] == pytest.approx(np.abs(apart).max(axis=0), rel=1e-4)
    for side in ("old", "new"):
        assert point[side]["mean_std_m"] == pytest.approx(np.mean([moved[side][t][1] for t in both], axis=0), rel=1e-4)
    fixes = scores["old"].keys() & scores["new"].keys()
    gain = sum(scores["new"][t] - scores["old"][t] for t in fixes)
    assert point["fixes_both_took"] == len(fixes)
    assert point["log_likelihood_gain"] == pytest.approx(gain, rel=1e-3)


def test_worse_settings_are_called_worse_and_lie_further_from_the_smoothed_stream(told: Any) -> None:
    """The noise of the accelerometer 40 000 times too large."""
    point = told["points"]["deck"]
    assert point["verdict"] == "the new settings predict the fixes worse"
    assert point["log_likelihood_gain"] < -3 * point["std_log_likelihood_gain"] < 0
    old, new = point["old"], point["new"]
    for axis in range(3):
        assert new["rms_against_smoothed_m"][axis] > 1.3 * old["rms_against_smoothed_m"][axis] > 0
        assert new["mean_std_m"][axis] > 1.3 * old["mean_std_m"][axis]


def test_the_page_needs_nothing_but_itself(folder: Path, told: Any) -> None:
    html = (folder / "page.html").read_text()
    assert html.count("<figure") == 9  # displacement, difference and sd of three axes
    assert "http" not in html.replace("http://www.w3.org", "")
    for text in (*SETS, "new less old", "old ± 2 sd", "new ± 2 sd", told["points"]["deck"]["verdict"]):
        assert text in html
    assert not list(folder.glob("edge-agent-*"))  # what lay beside it meanwhile


def test_the_same_settings_do_not_differ(folder: Path) -> None:
    from edge_agent.replay import recorded_config

    files = [folder / "fused.mcap"]
    old, new = recorded_config(files[0]), recorded_config(files[0], ["fusion.gate_alpha=0.001"])
    both = compare(files, None, old, new, folder=folder).points["deck"]
    assert both.gain == (0.0, 0.0)
    assert both.verdict == "no difference that the fixes could tell"
    assert both.common > 5000
    assert both.smooth > 200
    assert both.furthest.tolist() == [0.0] * 3
    assert both.old.off2.tolist() == both.new.off2.tolist()


def test_a_later_latency_is_compared_fix_by_fix(folder: Path) -> None:
    """Fixes then have other times; they are matched by their arrival."""
    from edge_agent.replay import recorded_config

    files = [folder / "fused.mcap"]
    old, new = recorded_config(files[0]), recorded_config(files[0], ["receivers.rover.latency_ms=500"])
    found = compare(files, None, old, new, folder=folder)
    both = found.points["deck"]
    assert both.fixes > 300
    assert both.verdict == "the new settings predict the fixes worse"
    text = as_text(found)
    assert "deck: the new settings predict the fixes worse: log likelihood -" in text
    assert "rms against the smoothed stream [mm]" in text


def test_gains_must_stand_out_of_their_scatter() -> None:
    def gained(windows: list[float]) -> Both:
        return Both("r", "a", Side(), Side(), fixes=99, likelihood_new=sum(windows), windows=dict(enumerate(windows)))

    assert "better" in gained([4.0, 5.0, 6.0, 5.0]).verdict
    assert "worse" in gained([-4.0, -5.0, -6.0, -5.0]).verdict
    assert "no difference" in gained([9.0, -8.0, 7.0, -4.0]).verdict
    assert "no difference" in gained([0.1, 0.1, 0.11, 0.1]).verdict
    assert "nothing to judge by" in Both("r", "a").verdict


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--set", "fusion.q=1e-8", "--compare"), "fusion.q: unknown key"),
        (("--set", "fusion.gate_alpha=7", "--compare"), "fusion.gate_alpha"),
        (("--compare",), "--compare needs other settings"),
        (("--set", "fusion.gate_alpha=0.01", "--compare", "--verify"), "choose one"),
        (("--set", "fusion.gate_alpha=0.01", "--compare", "--page", "rec.mcap"), "HTML"),
    ],
)
def test_wrong_use_is_explained(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], text: str
) -> None:
    assert main(["replay", str(folder / "fused.mcap"), *arguments]) == 2
    assert text in capsys.readouterr().err


def test_a_new_recording_is_kept_where_it_is_asked_for(
    folder: Path, told: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    assert told["points"]
    rows = column(folder / "kept" / "new.mcap", "/fusion/deck/block", capsys)
    assert rows == column(folder / "other.mcap", "/fusion/deck/block", capsys)
    assert sorted(p.name for p in (folder / "kept").iterdir()) == ["new.mcap"]
