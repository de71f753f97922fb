"""The page and its JSON twin: the figures against the files, damaged files, nothing from outside, bounded size."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
from dataclasses import replace
from datetime import datetime
from html.parser import HTMLParser
from importlib.metadata import version
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
import pytest

from edge_agent.__main__ import main
from edge_agent.messages import Mode, S
from edge_agent.review import charts, spectra
from edge_agent.review.charts import Plot, Scale, limits, ticks, time_scale
from edge_agent.review.figures import as_json
from edge_agent.review.gather import SPANS, Averaged, Extreme, Moments, PointFigures, Review, _point, gather
from edge_agent.review.panels import percent
from edge_agent.review.report import PANELS, page
from edge_agent.review.series import Fused, Piece
from edge_agent.simulate import SCENARIOS, run
from edge_agent.simulate.files import write_files

F64 = npt.NDArray[np.float64]
SECONDS = 75.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """75 s with outliers, lost samples and dropped fixes, fused."""
    folder = tmp_path_factory.mktemp("review")
    write_files(run(SCENARIOS["rough"], 5, SECONDS), folder)
    raw, config, fused = (str(folder / n) for n in ("raw.mcap", "config.yaml", "fused.mcap"))
    assert main(["replay", raw, "-c", config, "-o", fused]) == 0
    return folder / "fused.mcap"


@pytest.fixture(scope="module")
def gathered(recording: Path) -> Review:
    return gather([recording])


@pytest.fixture(scope="module")
def html(gathered: Review) -> str:
    return page(gathered)


@pytest.fixture(scope="module")
def twin(gathered: Review) -> dict[str, dict[str, dict[str, dict[str, dict[str, float]]]]]:
    """As a program reads it: through JSON text."""
    made = json.loads(json.dumps(as_json(gathered), allow_nan=False))
    assert isinstance(made, dict)
    return made


class Page(HTMLParser):
    """Checks that tags are closed in order; keeps what the tests ask for."""

    VOID = ("meta", "link", "br")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text: list[str] = []
        self.cells: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {k: v or "" for k, v in attrs}
        self.tags.append((tag, values))
        if "id" in values:
            self.ids.append(values["id"])
        if tag not in self.VOID:
            self.open.append(tag)
        if tag == "td":
            self.cells.append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {k: v or "" for k, v in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)
        if "td" in self.open:
            self.cells[-1] += data


def parse(html: str) -> Page:
    p = Page()
    p.feed(html)
    p.close()
    assert p.open == []
    return p


def column(recording: Path, topic: str, capsys: pytest.CaptureFixture[str]) -> list[dict[str, str]]:
    """A topic by `edge-agent cat`, which knows nothing of the review."""
    assert main(["cat", str(recording), "--topic", topic]) == 0
    return list(csv.DictReader(io.StringIO(capsys.readouterr().out)))


def utc_ns(text: str) -> int:
    """ISO with nanoseconds."""
    whole, part = text.rstrip("Z").split(".")
    return int(datetime.fromisoformat(whole + "+00:00").timestamp()) * S + int(part.ljust(9, "0"))


def test_figures_are_those_of_the_files(
    recording: Path,
    twin: dict[str, dict[str, dict[str, dict[str, dict[str, float]]]]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    rows = column(recording, "/fusion/deck/block", capsys)
    point = twin["points"]["deck"]
    keys = list(rows[0])
    t = np.array([utc_ns(r[keys[0]]) for r in rows])
    order = np.argsort(t, kind="stable")
    valid = np.array(
        [r[next(k for k in keys if k.startswith("mode"))] in ("FUSED", "GNSS_ONLY", "COAST") for r in rows]
    )
    assert point["samples"] == len(rows)
    assert point["valid_samples"] == valid.sum() > 5000
    good = order[valid[order]]
    for axis in "xyz":
        d_key, sd_key = (next(k for k in keys if k.startswith(f"{n}displacement_{axis}")) for n in ("", "std_"))
        d = np.array([float(r[d_key]) for r in rows])[good]
        sd = np.array([float(r[sd_key]) for r in rows])[good]
        said = point["displacement"][axis]
        for name, at in (("least", int(np.argmin(d))), ("largest", int(np.argmax(d)))):
            assert said[name]["value_m"] == pytest.approx(d[at], abs=1e-8)
            assert said[name]["std_m"] == pytest.approx(sd[at], rel=1e-6)
            assert utc_ns(said[name]["utc"]) == t[good][at]  # type: ignore[arg-type]
        assert said["mean_m"] == pytest.approx(d.mean(), abs=1e-8)
        assert said["rms_about_mean_m"] == pytest.approx(d.std(), rel=1e-5)
        assert said["mean_std_m"] == pytest.approx(sd.mean(), rel=1e-5)
    steps = np.diff(t[good])
    seconds = float(twin["seconds"])  # type: ignore[arg-type]
    assert point["availability"] == pytest.approx(steps[steps <= S].sum() / S / seconds, abs=1e-6)
    absent = sum(g["seconds"] for g in point["gaps"])  # type: ignore[misc,index]
    assert point["availability"] + absent / seconds == pytest.approx(1.0, abs=2.0 / seconds)

    fixes = column(recording, "/gnss/rover/solution", capsys)
    receiver = twin["receivers"]["rover"]
    assert receiver["fixes"] == len(fixes)
    latency = np.array([float(r[next(k for k in r if k.startswith("latency"))]) for r in fixes])
    assert receiver["mean_latency_s"] == pytest.approx(latency.mean() / S, rel=1e-6)
    shares = {q: sum(r[next(k for k in r if k.startswith("fix"))] == q for r in fixes) / len(fixes) for q in ("FIXED",)}
    assert receiver["quality"] == pytest.approx(shares)
    updates = column(recording, "/fusion/deck/update", capsys)
    verdicts = [r[next(k for k in r if k.startswith("verdict"))] for r in updates]
    assert point["gate"]["verdicts"] == {v: verdicts.count(v) for v in set(verdicts)}
    assert point["gate"]["verdicts"]["REJECTED"] > 10
    assert twin["accelerometers"]["acc"]["samples"] > 0.99 * SECONDS * 100


def test_frequencies_are_those_of_the_structure(gathered: Review) -> None:
    p = gathered.points["deck"]
    for true_hz in (0.5, 1.7):
        near = [f for f in p.frequencies if abs(f.freq_hz - true_hz) < 0.03]
        assert len(near) == 1
        assert abs(near[0].fused_hz - true_hz) < 0.05
    assert len(p.frequencies) <= 4


def test_the_page_stands_for_itself(html: str) -> None:
    html = re.sub(r'"data:image/png;base64,[A-Za-z0-9+/=]+"', '"data:,"', html)  # pictures stand inside
    p = parse(html)
    assert "//" not in re.sub(r"<script>.*?</script>", "", html, flags=re.DOTALL).replace("<!--", "")
    assert not re.search(r"https?:|url\(|@import|fetch\(|XMLHttp|import\(", html)
    for tag, values in p.tags:
        assert "src" not in values
        if "href" in values:
            assert values["href"].startswith(("#", "geo:", "data:,"))
        if tag == "path":
            assert "nan" not in values["d"]
            assert "inf" not in values["d"]
    assert len(p.ids) == len(set(p.ids))
    assert {panel.key for panel in PANELS} - set(p.ids) == {"heading"}  # no receiver gives one
    inside = [values["href"][1:] for tag, values in p.tags if tag == "a" and values["href"].startswith("#")]
    assert set(inside) == set(p.ids) - {"summary"}
    text = "".join(p.text)
    assert text.index("What went wrong") < text.index("Displacement\n" if "Displacement\n" in text else "deck x")


def test_every_axis_has_a_unit(html: str) -> None:
    figures = html.split('<figure class="chart"')[1:]
    assert len(figures) > 12
    for figure in figures:
        figure = figure.split("</figure>")[0]
        below = re.search(r'class="xl">([^<]*)<', figure)
        assert below
        assert below[1] in ("UTC", "frequency [Hz]", "probability of a smaller innovation by chi-square")
        if 'data-values="1"' in figure:
            unit = re.search(r'class="unit">([^<]+)<', figure)
            assert unit
            assert unit[1] in (
                "mm",
                "ms",
                "Hz",
                "satellites",
                "ratio",
                "m/s\u00b2",
                "(m/s\u00b2)\u00b2/Hz",
                "mm\u00b2/Hz",
                "mm/s\u00b2",
                "ppm",
                "order",
                "times as often",
                "%",
            )
            assert figure.split('class="yt">')[1].split("</div>")[0].count("<span") >= 2
        assert figure.split('class="xt">')[1].count("<span") >= 2


def test_the_page_shows_the_numbers_of_the_twin(
    html: str, twin: dict[str, dict[str, dict[str, dict[str, dict[str, float]]]]]
) -> None:
    text = parse(html)
    said = twin["points"]["deck"]["displacement"]
    for axis in "xyz":
        for name in ("least", "largest"):
            value = f"{1e3 * said[axis][name]['value_m']:.1f} \u00b1 {1e3 * said[axis][name]['std_m']:.1f}"  # type: ignore[index]
            assert any(cell.startswith(value.replace("-", "\u2212")) for cell in text.cells)
    whole = "".join(text.text)
    for sentence in [*twin["conclusions"], *twin["findings"]]:
        assert sentence in whole


def test_what_is_missing_is_told_once_and_the_same_everywhere(
    recording: Path, gathered: Review, html: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """The scenario leaves out a tenth of the epochs and single samples."""
    fixes = column(recording, "/gnss/rover/solution", capsys)
    t = np.array([utc_ns(r[next(iter(r))]) for r in fixes])
    due = int(round((t[-1] - t[0]) / S * 10)) + 1
    places = int((np.round(np.diff(t) / (S // 10)) > 1).sum())
    said = as_json(gathered)
    epochs, samples = said["receivers"]["rover"]["epochs"], said["accelerometers"]["acc"]["due"]
    lost = due - len(fixes)
    assert lost > 30
    assert (epochs["expected"], epochs["received"], epochs["missing"], epochs["gaps"]) == (
        due,
        len(fixes),
        lost,
        places,
    )
    assert sum(epochs["missing_by_reason"].values()) == lost
    assert samples["gaps"] == said["accelerometers"]["acc"]["flags"]["GAP_BEFORE"] > 3
    assert samples["expected"] == samples["received"] + samples["missing"]
    text = parse(html)
    for name, what, d in (("rover", "epochs", epochs), ("acc", "samples", samples)):
        at = text.cells.index(f"{name}: {what}")
        assert text.cells[at + 1 : at + 3] == [str(d["expected"]), str(d["received"])]
        assert text.cells[at + 3].startswith(f"{d['missing']} (")
        assert text.cells[at + 4] == str(d["gaps"])
        told = f"{name}: {d['received']} of {d['expected']} {what}, {d['missing']} missing ("
        assert any(line.startswith(told) for line in said["findings"])
    health = parse(html.split('<section id="sensors">')[1].split("</section>")[0]).cells
    assert health[:2] == ["acc", str(samples["received"])]
    assert health[3:5] == [f"{samples['missing']} of {samples['expected']}", str(samples["gaps"])]
    assert not any("gap before" in cell for cell in health)


def test_every_event_and_flag_has_a_strip_with_its_name(gathered: Review, html: str) -> None:
    strips = [text.strip() for text in re.findall(r'<i style="--c:#\w{6}"></i>([^<]*)', html)]
    kinds = {f"{k.lower().replace('_', ' ')}, {source}" for k, source in gathered.received.events}
    assert {"samples lost, acc", "start, deck"} <= kinds
    assert kinds <= set(strips)
    assert {"rejected", "start"} <= set(strips)
    assert "flag: gap before" in strips
    assert "fused" in strips


def test_a_point_without_a_receiver_is_told_by_its_vibration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    write_files(run(SCENARIOS["clean"], 2, 45.0), tmp_path)
    config = tmp_path / "config.yaml"
    text = config.read_text()
    assert "deck: {receiver: rover, accelerometer: acc}" in text
    config.write_text(text.replace("deck: {receiver: rover, accelerometer: acc}", "pier: {accelerometer: acc}"))
    fused = tmp_path / "only" / "fused.mcap"
    fused.parent.mkdir()
    assert main(["replay", str(tmp_path / "raw.mcap"), "-c", str(config), "-o", str(fused)]) == 0
    r = gather([fused])
    told = page(r)
    assert "accelerometer only" in told
    assert "no valid displacement" not in told
    truth = np.genfromtxt(tmp_path / "truth.csv", delimiter=",", names=True)
    for axis, name in enumerate(("east", "north", "up")):
        rms = truth[f"acceleration_{name}_mps2"].std()
        assert as_json(r)["accelerometers"]["acc"]["rms_mps2"][axis] == pytest.approx(rms, rel=0.05)
    assert r.points["pier"].frequencies
    cards = re.findall(r"<div><span>([^<]*)</span><b>([^<]*)</b>", told)
    assert dict(cards)["pier: accelerometer only"].count(" / ") == 2


def test_files_of_two_sites_get_a_page_each(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("edge_agent.review.gather._questions", lambda p: None)
    other = tmp_path / "other"
    write_files(run(SCENARIOS["P2"], 1, 30.0), other)
    out = tmp_path / "report.html"
    capsys.readouterr()
    assert main(["review", str(recording), str(other), "-o", str(out), "--json"]) == 1
    said = capsys.readouterr()
    assert set(json.loads(said.out)["sites"]) == {"simulated-rough", "simulated-P2"}
    assert "the files are of 2 sites, each has its own page: simulated-" in said.err
    assert not out.exists()
    assert "deck" in (tmp_path / "report-simulated-rough.html").read_text()
    page_of_other = (tmp_path / "report-simulated-P2.html").read_text()
    assert "<h1>simulated-P2</h1>" in page_of_other
    assert "acc: samples" not in page_of_other
    for command in (["tune"], ["layouts", "-o", str(tmp_path / "l")], ["replay", "-o", str(tmp_path / "o.mcap")]):
        assert main([command[0], str(recording), str(other / "raw.mcap"), *command[1:]]) == 2
        assert "of 2 sites" in capsys.readouterr().err
    assert not (tmp_path / "o.mcap").exists()


def test_a_file_of_another_program_is_left_out_and_said(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from mcap.writer import Writer

    monkeypatch.setattr("edge_agent.review.gather._questions", lambda p: None)
    strange = tmp_path / "strange.mcap"
    with strange.open("wb") as file:
        writer = Writer(file)
        writer.start("x", "y")
        channel = writer.register_channel("/camera", "json", writer.register_schema("a/B", "jsonschema", b"{}"))
        writer.add_message(channel, 1_700_000_000 * S, b"{}", 1_700_000_000 * S)
        writer.finish()
    r = gather([recording, strange])
    assert r.damaged == {}
    assert r.begin_ns > 1_780_000_000 * S
    assert any("strange.mcap is left out: no recording of edge-agent" in text for text in as_json(r)["findings"])


def test_a_structure_that_moved_away_is_named_first(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same names, another place."""
    monkeypatch.setattr("edge_agent.review.gather._questions", lambda p: None)
    scenario = SCENARIOS["rough"]
    lat, lon, h = scenario.reference_llh
    write_files(
        run(replace(scenario, reference_llh=(lat + 0.1, lon, h)), 5, 20.0, (1_780_300_800 + 3600) * S), tmp_path
    )
    fused = tmp_path / "fused.mcap"
    assert main(["replay", str(tmp_path / "raw.mcap"), "-o", str(fused)]) == 0
    said = as_json(gather([recording, fused]))
    assert said["findings"][0].startswith("rover stands 11.1 km from where it stands in other files")


def test_the_title_block_tells_site_period_software_and_settings(recording: Path, html: str) -> None:
    block = html.split('<dl class="plate">')[1].split("</dl>")[0]
    config = (recording.parent / "config.yaml").read_bytes()
    told = dict(re.findall(r"<dt>([^<]*)</dt><dd>([^<]*)</dd>", block))
    assert told["Site"] == "simulated-rough"
    assert told["Period"] == "2026-06-01 08:00:00 to 2026-06-01 08:01:15 UTC"
    assert told["Settings (SHA-256 of config.yaml)"] == hashlib.sha256(config).hexdigest()[:12]
    assert told["Reviewed by"] == f"edge-agent {version('edge-agent')}"


def test_damaged_files_are_named_and_the_rest_is_told(
    recording: Path,
    gathered: Review,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("edge_agent.review.gather._questions", lambda p: None)  # slow, and asked above
    whole = recording.read_bytes()
    (tmp_path / "good.mcap").write_bytes(whole)
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) * 6 // 10])
    (tmp_path / "flipped.mcap").write_bytes(
        whole[: len(whole) // 3] + bytes([whole[len(whole) // 3] ^ 4]) + whole[len(whole) // 3 + 1 :]
    )
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "again.mcap").write_bytes(whole)
    out = tmp_path / "report.html"
    assert main(["review", str(tmp_path), "-o", str(out), "--json"]) == 3
    said = json.loads(capsys.readouterr().out)
    assert {Path(d["file"]).name for d in said["damaged"]} == {"cut.mcap", "flipped.mcap", "empty.mcap"}
    cells = parse(out.read_text()).cells
    for name in ("cut.mcap", "flipped.mcap", "empty.mcap"):
        assert cells[cells.index(name) + 1] == "damaged"
        assert any(name in text for text in said["findings"])
    kept, copy = ("again.mcap", "good.mcap")
    assert cells[cells.index(kept) + 1] == "complete"
    assert cells[cells.index(copy) + 1] == "a copy: counted once"
    assert {Path(c["file"]).name for c in said["copies"]} >= {"cut.mcap", copy}  # the other is broken at its begin
    assert any(f"{copy} is a copy of data in {kept}" in text for text in said["findings"])
    assert said["points"]["deck"]["samples"] == gathered.overview.points["deck"].stream.samples
    assert said["receivers"]["rover"]["fixes"] == gathered.overview.receivers["rover"].stream.samples
    assert not list(tmp_path.glob("*.part"))


def test_exit_codes(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "report.html"
    assert main(["review", str(tmp_path / "nowhere"), "-o", str(out)]) == 2
    empty = tmp_path / "empty.mcap"
    empty.touch()
    assert main(["review", str(empty), "-o", str(out)]) == 2
    assert "empty.mcap: empty" in capsys.readouterr().err
    assert main(["review", str(recording)]) == 2
    assert not out.exists()
    raw = recording.parent / "raw.mcap"
    assert main(["review", str(raw), "-o", str(out)]) == 0
    assert "no valid displacement" in capsys.readouterr().out
    parse(out.read_text())


def test_a_month_is_as_large_as_a_minute(gathered: Review, recording: Path) -> None:
    r = gather([recording.parent / "raw.mcap"])  # holds no estimate: what is drawn is what is put in here
    begin, day = r.begin_ns, 86400 * S
    r.end_ns = begin + 30 * day
    p, point, x = r.points["deck"], r.overview.points["deck"], r.overview.receivers["rover"]
    rng = np.random.default_rng(1)
    n, spike = 5_000, 0.5
    for k in range(60):  # half a day each, then a single sample far off
        t = begin + k * day // 2 + np.arange(n) * (day // 2 // n)
        d = 0.01 * rng.standard_normal((n, 3))
        if k == 37:
            d[4321] = spike
        point.displacement.add(t, d)
        p.valid.add(t)
        p.moments.add(d)
        point.std.add(t, np.full((n, 3), 0.001))
        point.ratio.add(t, rng.random(n))
        point.residual.add(t, d)
        x.stream.samples += n
        x.qualities[4] = x.stream.samples
        x.position.add(t, d)
        x.latency.add(t, rng.random(n))
        p.spells += [(int(v), int(v) + S, 1) for v in t[:40]]
    p.low = [Extreme(-0.05, 0.001, begin)] * 3
    p.high = [Extreme(spike, 0.001, begin)] * 3
    times, _, high, _ = point.displacement.spans()
    assert len(times) <= SPANS
    assert high.max() == spike
    html = page(r)
    parse(html)
    assert len(html) < 3_000_000
    assert "\u2026" in html
    assert len(page(gathered)) < 1_500_000


# -------------------------------------------------------------------------------------------------------------- parts


def test_a_picture_is_a_png_of_its_shades() -> None:
    shade = np.linspace(0.0, 1.0, 12).reshape(3, 4)
    seen = plt.imread(io.BytesIO(charts.png(shade)), format="png")
    assert seen.shape[:2] == (3, 4)
    for row in range(3):
        for column in range(4):
            want = [int(charts.shade_colour(shade[row, column])[k : k + 2], 16) / 255 for k in (1, 3, 5)]
            assert np.abs(seen[row, column, :3] - want).max() < 0.02
    light = seen[..., :3].sum(axis=2).ravel()
    assert (np.diff(light) < 0).all()  # the more, the darker


def test_a_logarithmic_axis_has_round_numbers_that_do_not_crowd() -> None:
    for low, high in ((-0.35, 0.67), (0.001, 0.04), (-3.4, -0.2), (-7.0, 2.0), (-1.0, 1.9)):
        found = ticks(Scale(low, high, "", log=True), 5)
        assert 2 <= len(found) <= 8
        places = [p for p, _ in found]
        assert places == sorted(places)
        for p, text in found:
            at = low + p / 100 * (high - low)
            value = text.replace("10<sup>", "1e").replace("</sup>", "").replace("\u2212", "-")
            assert float(value) == pytest.approx(10**at, rel=1e-6)
            assert len(text.replace("<sup>", "").replace("</sup>", "")) <= 6


def piece(t: npt.NDArray[np.int64], d: F64, mode: npt.NDArray[np.uint8]) -> Piece:
    """Fused samples of a point, and nothing else."""
    sd = np.full((len(t), 3), 0.001) + np.arange(len(t))[:, None] * 1e-9
    fused = Fused(t, d, sd, mode, np.zeros(len(t), np.uint8))
    return Piece(Path("x.mcap"), "run", False, {"deck": fused}, {}, {}, {}, [])


def test_what_is_not_valid_counts_for_nothing_and_a_close_look_holds_every_sample() -> None:
    n, begin = 6000, 1_780_300_800 * S
    t = begin + np.arange(n) * 10_000_000
    rng = np.random.default_rng(4)
    d = 0.001 * rng.standard_normal((n, 3))
    d[2995] = 0.1  # close to the border of two pieces
    mode = np.full(n, Mode.FUSED, np.uint8)
    mode[1000:2000] = Mode.INVALID
    d[1500] = -50.0
    mode[4000:5000] = Mode.COAST
    p = PointFigures("", "")
    for k in range(0, n, 500):
        _point(p, piece(t[k : k + 500], d[k : k + 500], mode[k : k + 500]), "deck", Averaged(8.0), Averaged(8.0))
    assert p.moments.n == 5000
    assert p.valid.covered_ns / S == pytest.approx(49.98, abs=0.011)
    assert [m for _, _, m in p.spells] == [Mode.FUSED, Mode.INVALID, Mode.FUSED, Mode.COAST, Mode.FUSED]
    for axis in range(3):
        high, low = p.high[axis], p.low[axis]
        assert high is not None
        assert low is not None
        assert (high.value_m, high.utc_ns) == (0.1, t[2995])
        assert low.value_m > -0.01
        look = p.looks[axis, True]
        around = (np.abs(t - t[2995]) <= 6 * S) & (mode != Mode.INVALID)
        assert np.array_equal(look.utc_ns, t[around])
        assert np.array_equal(look.displacement_m, d[around, axis])


def test_the_average_of_parts_is_welchs() -> None:
    rng = np.random.default_rng(2)
    x = rng.standard_normal((48_000, 3)).cumsum(axis=0)
    t = np.arange(len(x), dtype=np.int64) * 10_000_000
    a = Averaged(20.0)
    for k in range(0, len(x), 1000):
        a.add("run", t[k : k + 1000], x[k : k + 1000])
    s = a.spectrum()
    whole = spectra.welch(x, 100.0, 2000)
    assert s is not None
    assert s.segments >= 0.8 * whole.segments
    assert np.array_equal(s.freq_hz, whole.freq_hz)
    ratio = s.psd[5:400] / whole.psd[5:400]
    assert abs(float(np.log(ratio).mean())) < 0.05
    one = spectra.welch(x, 100.0, 24_000)
    b = Averaged(240.0)
    b.add("run", t, x)
    other = b.spectrum()
    assert other is not None
    assert np.allclose(other.psd, one.psd)
    assert np.allclose(other.low, one.low, rtol=1e-4)
    assert np.allclose(other.high, one.high, rtol=1e-4)


def test_a_frequency_is_tracked_in_time_with_an_honest_sd_in_bounded_memory() -> None:
    """An oscillator of 1 % damping under noise, whose frequency sinks by 3 %; lines are wider than its peak."""
    rate, n = 20.0, 20 * 60 * 400
    seconds = np.arange(n) / rate
    f = 1.0 - 0.03 * seconds / seconds[-1]
    pole = np.exp(-0.01 * 2 * np.pi * f / rate)
    first, second = (2 * pole * np.cos(2 * np.pi * f / rate)).tolist(), (pole * pole).tolist()
    force = np.random.default_rng(5).standard_normal(n).tolist()
    y = [0.0, 0.0]
    for k in range(2, n):
        y.append(first[k] * y[-1] - second[k] * y[-2] + force[k])
    acceleration = np.diff(y, 2, prepend=[0.0, 0.0]) * (rate * rate / 40.0)
    x = acceleration[:, None] * np.ones(3) + 3.0 * np.random.default_rng(6).standard_normal((n, 3))
    a = Averaged(25.0, keep=True)
    t = np.rint(seconds * S).astype(np.int64)
    for k in range(0, n, 1200):
        a.add("run", t[k : k + 1200], x[k : k + 1200])
    assert a.spectrum() is not None
    middles, found, std = a.track([0.985, 5.0])
    assert 48 <= len(middles) <= 96
    wrong = (found[:, 0] - np.interp(middles, t, f)) / std[:, 0]
    assert np.isfinite(wrong).all()
    assert 0.6 < math.sqrt(float(np.mean(wrong * wrong))) < 1.4
    assert abs(float(np.mean(wrong))) < 1.0  # a twentieth of a line
    assert std[:, 0].max() < 0.01
    assert np.isnan(found[:, 1]).mean() > 0.8


def test_moments_of_parts() -> None:
    x = np.random.default_rng(3).standard_normal((1000, 3)) + 1e4
    m = Moments()
    for part in np.split(x, [3, 3, 500]):
        m.add(part)
    assert np.allclose(m.mean, x.mean(axis=0), rtol=1e-12)
    assert np.allclose(m.std, x.std(axis=0), rtol=1e-8)


def test_an_area_keeps_every_extreme_and_breaks_at_gaps() -> None:
    x = np.array([0.0, 1.0, 2.0, 10.0, 11.0])
    plot = Plot(Scale(0.0, 20.0, "s"), Scale(-1.0, 1.0, "mm"))
    plot.area(x, np.array([-1.0, 0, 0, 0, math.nan]), np.array([0.0, 1.0, 0, 0, math.nan]), 3.0, "#000", "t")
    assert len(plot.layers) == 2  # the gap of 8 breaks it
    (d,) = re.findall(r'd="([^"]*)"', plot.layers[0])
    at, seen = (0, 0), []
    for kind, a, b in re.findall(r"([ML l])\s*(-?\d+)\s*(-?\d+)", d):
        at = (int(a), int(b)) if kind in "ML" else (at[0] + int(a), at[1] + int(b))
        seen.append(at)
    assert (500, 0) in seen  # the largest, 1 mm, at the top of the box
    assert (0, charts.H) in seen  # the least at its bottom


@pytest.mark.parametrize(
    ("scale", "texts"),
    [
        (Scale(-1.0, 4.0, ""), ["\u22121", "0", "1", "2", "3", "4"]),
        (Scale(-3.0, 1.0, "", log=True), ["0.001", "0.01", "0.1", "1", "10"]),
        (time_scale(1_780_300_800 * S, 1_780_300_860 * S), ["08:00:00", "08:00:10", "08:00:20"]),
        (time_scale(1_780_300_800 * S, 1_780_905_600 * S), ["06-02", "06-03", "06-04"]),
    ],
)
def test_ticks(scale: Scale, texts: list[str]) -> None:
    found = ticks(scale, 7)
    assert [t for _, t in found][: len(texts)] == texts
    assert all(-1e-6 <= at <= 100 + 1e-6 for at, _ in found)
    assert 2 <= len(found) <= 9


def test_limits_and_shares() -> None:
    assert limits(np.array([math.nan])) == (-1.0, 1.0)
    low, high = limits(np.array([0.0, 10.0]), np.array([math.nan, -5.0]))
    assert low < -5.0
    assert high > 10.0
    assert percent(0.99999) == "99.99 %"
    assert percent(1.0) == "100 %"
    assert percent(0.000001) == "0.01 %"


def test_a_file_named_twice_and_a_replay_beside_its_input_count_once(tmp_path: Path) -> None:
    """What `simulate` and `replay` leave in one folder."""
    made = tmp_path / "made"
    assert main(["simulate", "clean", "--seconds", "40", "-o", str(made)]) == 0
    other = tmp_path / "other"
    assert main(["simulate", "rough", "--seconds", "40", "-o", str(other)]) == 0
    for folder in (made, other):
        raw, fused = str(folder / "raw.mcap"), str(folder / "fused.mcap")
        assert main(["replay", raw, "-c", str(folder / "config.yaml"), "-o", fused]) == 0
    once = gather([made / "fused.mcap"])
    twice = gather([made / "fused.mcap", made / "fused.mcap"])
    beside = gather([made])
    fixes = {name: sum(r.qualities.values()) for name, r in once.overview.receivers.items()}
    assert {name: sum(r.qualities.values()) for name, r in twice.overview.receivers.items()} == fixes
    assert {name: sum(r.qualities.values()) for name, r in beside.overview.receivers.items()} == fixes
    assert beside.copies == {made / "raw.mcap": made / "fused.mcap"}
    assert twice.copies == {}
    both = gather([made / "fused.mcap", other / "fused.mcap"])  # another record of the same time is no copy
    assert both.copies == {}
