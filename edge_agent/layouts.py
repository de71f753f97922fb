"""Layouts of viewers that other people wrote: a recording opens on what matters, without building panels by hand.

`lichtblick` (Lichtblick and Foxglove: Layouts > Import from file) shows displacement, its standard deviation, the
gate's ratio, modes and verdicts, the spectrum, the map, the log and the diagnostics; `plotjuggler` (File > Load layout)
the curves of the same topics. Both are made from the configuration, for the topics carry its names.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from edge_agent.messages import Config

AXES = "xyz"
COLOURS = {"x": "#0072b2", "y": "#d55e00", "z": "#009e73"}
"""Told apart by colour-blind readers (Okabe and Ito)."""
NAMES = ("lichtblick.json", "plotjuggler.xml")
SPECTRUM = "spectrum.ts"
"""The script that Lichtblick runs for the spectrum, with TOPIC and OUTPUT in the place of its topics."""


def write(config: Config, folder: Path) -> list[Path]:
    """Write both layouts into `folder`, which is made; their paths. OSError where it cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / name for name in NAMES]
    for path, text in zip(paths, (lichtblick(config), plotjuggler(config)), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


# ------------------------------------------------------------------------------------------------ Lichtblick, Foxglove


def lichtblick(config: Config) -> str:
    """Layout as JSON: one tab per point beside map, log and diagnostics."""
    panels: dict[str, Any] = {}
    scripts: dict[str, Any] = {}
    tabs = [{"title": point, "layout": _point(point, panels, scripts)} for point in config.points]
    panels["Tab!points"] = {"activeTabIdx": 0, "tabs": tabs}
    panels["map!fixes"] = {
        "customTileUrl": "",
        "disabledTopics": [],
        "followTopic": "",
        "layer": "map",
        "topicColors": {},
    }
    panels["RosOut!log"] = {"searchTerms": [], "minLogLevel": 2, "topicToRender": "/rosout"}
    panels["DiagnosticSummary!state"] = {
        "minLevel": 0,
        "pinnedIds": [],
        "hardwareIdFilter": "",
        "topicToRender": "/diagnostics",
        "sortByLevel": True,
    }
    side = _stack("column", ["map!fixes", "RosOut!log", "DiagnosticSummary!state"])
    layout = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": scripts,
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": "Tab!points", "second": side, "splitPercentage": 70},
    }
    return json.dumps(layout, indent=2) + "\n"


def _point(point: str, panels: dict[str, Any], scripts: dict[str, Any]) -> Any:
    """Panels of one point, added to `panels`; how they are arranged."""
    state, update, spectrum = (
        f"/fusion/{point}/state",
        f"/fusion/{point}/update",
        f"/studio_script/{point}/spectrum",
    )
    source = files("edge_agent").joinpath(SPECTRUM).read_text("utf-8")
    scripts[f"spectrum-{point}"] = {
        "name": f"/studio_script/{point}/spectrum.ts",
        "sourceCode": source.replace("TOPIC", state).replace("OUTPUT", spectrum),
    }
    panels[f"Plot!displacement-{point}"] = _plot(
        "displacement", "m", [_line(f"{state}.displacement_m.{a}", a, COLOURS[a]) for a in AXES]
    )
    panels[f"Plot!std-{point}"] = _plot(
        "standard deviation", "m", [_line(f"{state}.std_displacement_m.{a}", a, COLOURS[a]) for a in AXES]
    )
    panels[f"Plot!ratio-{point}"] = _plot(
        "innovation ratio: fits at 1 and below",
        "",
        [_line(f"{update}.ratio", "ratio", COLOURS["x"]), _line("1", "limit", "#888888")],
    )
    panels[f"StateTransitions!modes-{point}"] = {
        "isSynced": True,
        "foxglovePanelTitle": "mode, verdict",
        "paths": [
            {"value": f"{state}.mode", "label": "mode", "timestampMethod": "headerStamp"},
            {"value": f"{update}.verdict", "label": "verdict", "timestampMethod": "headerStamp"},
        ],
    }
    lines = [_line(f"{spectrum}.{a}[:]", a, COLOURS[a]) for a in AXES]
    panels[f"Plot!spectrum-{point}"] = _plot("spectrum of the last 40 s", "mm/sqrt(Hz)", lines) | {
        "xAxisVal": "currentCustom",
        "xAxisPath": {"value": f"{spectrum}.frequency_hz[:]", "enabled": True},
        "xAxisLabel": "Hz",
    }
    kinds = ("Plot!displacement", "Plot!std", "Plot!ratio", "StateTransitions!modes", "Plot!spectrum")
    return _stack("column", [f"{kind}-{point}" for kind in kinds])


def _plot(title: str, unit: str, paths: list[dict[str, Any]]) -> dict[str, Any]:
    return {
        "foxglovePanelTitle": title,
        "paths": paths,
        "yAxisLabel": unit,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "sidebarDimension": 240,
    }


def _line(value: str, label: str, colour: str) -> dict[str, Any]:
    return {"value": value, "label": label, "color": colour, "enabled": True, "timestampMethod": "headerStamp"}


def _stack(direction: str, panels: Sequence[str]) -> Any:
    """Panels of equal size, one below (column) or beside (row) the other: a split is always one in two."""
    if len(panels) == 1:
        return panels[0]
    rest = _stack(direction, panels[1:])
    return {"direction": direction, "first": panels[0], "second": rest, "splitPercentage": 100 / len(panels)}


# --------------------------------------------------------------------------------------------------------- PlotJuggler


def plotjuggler(config: Config) -> str:
    """Layout as XML: a tab per point, and one with the receivers' positions. Spectra: its FFT tool, on any curve."""
    root = ET.Element("root")
    window = ET.SubElement(root, "tabbed_widget", {"name": "Main Window", "parent": "main_window"})
    for point in config.points:
        state, update = f"/fusion/{point}/state", f"/fusion/{point}/update"
        curves = [
            ("displacement, m", _three(f"{state}/displacement_m")),
            ("standard deviation, m", _three(f"{state}/std_displacement_m")),
            ("innovation ratio: fits at 1 and below", [(f"{update}/ratio", COLOURS["x"])]),
            ("mode, verdict", [(f"{state}/mode", COLOURS["y"]), (f"{update}/verdict", COLOURS["z"])]),
        ]
        _tab(window, point, curves)
    if config.receivers:
        fields = zip(("east_m", "north_m", "up_m"), COLOURS.values(), strict=True)
        named = list(fields)
        curves = [
            (f"{name}, m about the reference", [(f"/gnss/{name}/solution/{f}", colour) for f, colour in named])
            for name in config.receivers
        ]
        _tab(window, "receivers", curves)
    ET.SubElement(window, "currentTabIndex", index="0")
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    ET.indent(root)
    return ET.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _three(field: str) -> list[tuple[str, str]]:
    return [(f"{field}/{a}", COLOURS[a]) for a in AXES]


def _tab(window: ET.Element, title: str, plots: Sequence[tuple[str, Sequence[tuple[str, str]]]]) -> None:
    """A tab with plots one below the other, each with its curves: name and colour."""
    tab = ET.SubElement(window, "Tab", tab_name=title, containers="1")
    sizes = ";".join(f"{1 / len(plots):.6f}" for _ in plots)
    inside = ET.SubElement(tab, "Container")
    splitter = ET.SubElement(inside, "DockSplitter", orientation="-", count=str(len(plots)), sizes=sizes)
    for name, curves in plots:
        area = ET.SubElement(splitter, "DockArea", name=name)
        plot = ET.SubElement(area, "plot", style="Lines", mode="TimeSeries", flip_x="false", flip_y="false")
        ET.SubElement(plot, "limitY")
        for curve, colour in curves:
            ET.SubElement(plot, "curve", name=curve, color=colour)
