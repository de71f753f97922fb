"""Layouts for viewers: everything that they name is in the recordings under that name."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from edge_agent import __main__ as cli
from edge_agent import config, layouts
from edge_agent.recording.schemas import PRIMITIVES, SCHEMAS, full_name, parse_fields, schema_of

SITE = """
site: s
data_dir: rec
ports: {gps: {kind: serial, device: /dev/x}, can: {kind: can}}
receivers: {r-1: {port: gps}}
accelerometers:
  a:
    port: can
    fields: {x: {id: 1, start: 0, length: 16}, y: {id: 1, start: 16, length: 16}, z: {id: 1, start: 32, length: 16}}
points: {mid: {receiver: r-1, accelerometer: a}, pier-2: {receiver: r-1}}
"""


@pytest.fixture
def site(tmp_path: Path) -> Any:
    return config.parse(SITE, tmp_path)


def has(topic: str, fields: list[str]) -> bool:
    """Whether a topic's schema has that field, and it is a number."""
    own, *others = SCHEMAS[schema_of(topic)].split("=" * 80 + "\nMSG: ")
    texts = {full_name(text.split("\n", 1)[0]): text.split("\n", 1)[1] for text in others}
    kind = ""
    for name in fields:
        there = {f.name: f for f in parse_fields(texts[kind] if kind else own)}
        if name not in there:
            return False
        kind = full_name(there[name].type)
    return kind in PRIMITIVES


def test_every_path_of_lichtblick_is_a_field_of_a_topic(site: Any) -> None:
    layout = json.loads(layouts.lichtblick(site))
    paths = [p["value"] for panel in layout["configById"].values() for p in panel.get("paths", [])]
    checked = 0
    for path in paths:
        if path == "1" or path.startswith("/studio_script/"):
            continue
        topic, *fields = path.split(".")
        assert has(topic, fields), path
        checked += 1
    assert checked == 2 * (3 + 3 + 1 + 2)
    assert not has("/fusion/mid/state", ["displacement_m"])
    assert not has("/fusion/mid/state", ["nothing"])


def test_every_panel_of_lichtblick_is_arranged_once(site: Any) -> None:
    layout = json.loads(layouts.lichtblick(site))

    def leaves(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else leaves(node["first"]) + leaves(node["second"])

    tabs = layout["configById"]["Tab!points"]["tabs"]
    assert [t["title"] for t in tabs] == ["mid", "pier-2"]
    placed = leaves(layout["layout"]) + [p for t in tabs for p in leaves(t["layout"])]
    assert sorted(placed) == sorted(layout["configById"])
    assert {p.split("!")[0] for p in placed} == {
        "Tab", "map", "RosOut", "DiagnosticSummary", "Plot", "StateTransitions",
    }  # fmt: skip


def test_the_script_names_the_topics_that_its_panel_reads(site: Any) -> None:
    layout = json.loads(layouts.lichtblick(site))
    source = layout["userNodes"]["spectrum-pier-2"]["sourceCode"]
    assert 'inputs = ["/fusion/pier-2/state"]' in source
    assert 'Input<"/fusion/pier-2/state">' in source
    (output,) = re.findall(r'output = "(.*)"', source)
    panel = layout["configById"]["Plot!spectrum-pier-2"]
    (kind,) = re.findall(r"type Output = \{(.*)\}", source)
    fields = re.findall(r"(\w+): number\[\]", kind)
    assert [p["value"] for p in (panel["xAxisPath"], *panel["paths"])] == [f"{output}.{f}[:]" for f in fields]


def test_every_curve_of_plotjuggler_is_a_field_of_a_topic(site: Any) -> None:
    root = ET.fromstring(layouts.plotjuggler(site))
    assert [t.get("tab_name") for t in root.iter("Tab")] == ["mid", "pier-2", "receivers"]
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.get("count", "")) == len(splitter) == len(splitter.get("sizes", "").split(";"))
    names = [c.get("name", "") for c in root.iter("curve")]
    assert len(names) == 2 * (3 + 3 + 1 + 2) + 3
    for name in names:
        _, area, who, kind, *fields = name.split("/")
        assert has(f"/{area}/{who}/{kind}", fields), name


def test_the_script_finds_the_frequency_and_its_height(site: Any, tmp_path: Path) -> None:
    """Its types taken away it is JavaScript, which node runs: the density against numpy's."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    source = json.loads(layouts.lichtblick(site))["userNodes"]["spectrum-mid"]["sourceCode"]
    source = re.sub(r"^import .*$|^type .*$", "", source, flags=re.M)
    source = re.sub(
        r": (?:number\[\]\[\]|number\[\]|number|void|Output \| undefined|Input<[^>]*>)(?=[ ,)=;])", "", source
    )
    source = source.replace("new Array<number>(", "new Array(").replace("!", "").replace("export default ", "")
    source = source.replace("export const", "const")
    rate, n = 25.0, 1100
    t = np.arange(n) / rate
    x = 0.003 * np.sin(2 * np.pi * 1.7 * t) + 0.4
    harness = """
    const x = JSON.parse(require("fs").readFileSync(0, "utf8"));
    let found, count = 0;
    x.forEach((v, i) => {
      const ns = Math.round(i * 4e7);
      const stamp = { sec: 100 + Math.floor(ns / 1e9), nsec: ns % 1e9 };
      const out = script({ message: { header: { stamp }, displacement_m: { x: v, y: 2 * v, z: 0 } } });
      if (out !== undefined) { found = out; count++; }
    });
    console.log(JSON.stringify({ count, last: found }));
    """
    done = subprocess.run(
        [node, "-e", source + harness], input=json.dumps(x.tolist()), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    got = json.loads(done.stdout)
    assert got["count"] == 1 + (n - 1024) // 25
    end = 1023 + 25 * ((n - 1024) // 25)
    part = x[end - 1023 : end + 1]
    window = (1 - np.cos(2 * np.pi * np.arange(1024) / 1024)) / 2
    power = np.abs(np.fft.rfft((part - part.mean()) * window)) ** 2 * 2 / (rate * 1024 * 0.375)
    assert np.allclose(got["last"]["x"], 1000 * np.sqrt(power[1:512]), rtol=1e-6, atol=1e-9)
    assert np.allclose(got["last"]["y"], 2 * np.array(got["last"]["x"]), rtol=1e-6, atol=1e-9)
    assert got["last"]["z"] == [0.0] * 511
    assert np.allclose(got["last"]["frequency_hz"], np.arange(1, 512) * rate / 1024)
    assert abs(got["last"]["frequency_hz"][int(np.argmax(got["last"]["x"]))] - 1.7) < rate / 1024


def test_the_command_writes_them_for_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "site.yaml").write_text(SITE)
    (tmp_path / "can.log").write_text("(1700000000.000000) can0 001#010002000300\n")
    raw = tmp_path / "raw.mcap"
    assert (
        cli.main(["import", "-c", str(tmp_path / "site.yaml"), "--can", str(tmp_path / "can.log"), "-o", str(raw)]) == 0
    )
    capsys.readouterr()
    assert cli.main(["layouts", str(raw), "-o", str(tmp_path / "new" / "viewers")]) == 0
    written = [Path(line) for line in capsys.readouterr().out.splitlines()]
    assert [p.name for p in written] == list(layouts.NAMES)
    assert "/fusion/pier-2/state.displacement_m.x" in written[0].read_text()
    assert ET.parse(written[1]).getroot().tag == "root"
    assert cli.main(["layouts", str(tmp_path / "none.mcap"), "-o", str(tmp_path / "new")]) == 2
