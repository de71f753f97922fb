"""Who may import whom: read from the sources, so that a shortcut shows at once."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
IMPURE = {"time", "threading", "queue", "os", "socket", "random", "logging", "serial", "can", "mcap", "subprocess"}
PURE = [
    "edge_agent/messages.py",
    "edge_agent/state.py",
    "edge_agent/timebase.py",
    "edge_agent/geodesy.py",
    "edge_agent/pipeline.py",
    "edge_agent/judge.py",
    "edge_agent/recording/topics.py",
    "edge_agent/recording/schemas.py",
    "edge_agent/recording/cdr.py",
    "drivers/nmea_codec.py",
    "drivers/nmea_fields.py",
    "drivers/binary_frames.py",
    "drivers/dbc_codec.py",
    "drivers/can_signals.py",
    "drivers/can_assembly.py",
    "drivers/accel_watch.py",
    "drivers/slcan_lines.py",
    *(str(p.relative_to(ROOT)) for p in sorted((ROOT / "edge_agent/fusion").glob("*.py"))),
]
OWN = ("edge_agent", "drivers")


def imports(path: Path) -> set[str]:
    """Every module that a file names in an import, at the top or inside a function."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {a.name for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
            found |= {f"{node.module}.{a.name}" for a in node.names}
    return found


def own(path: Path) -> set[str]:
    return {name for name in imports(path) if name.split(".")[0] in OWN}


@pytest.mark.parametrize("name", PURE)
def test_pure_modules_read_no_clock_and_touch_no_world(name: str) -> None:
    names = imports(ROOT / name)
    assert not {n.split(".")[0] for n in names} & IMPURE
    assert "datetime.datetime.now" not in names
    source = (ROOT / name).read_text()
    for call in (".now(", "utcnow(", "today("):
        assert call not in source


def test_every_codec_is_among_the_pure() -> None:
    assert {f"drivers/{p.name}" for p in (ROOT / "drivers").glob("*_codec.py")} <= set(PURE)


@pytest.mark.parametrize("path", sorted((ROOT / "drivers").glob("*.py")), ids=lambda p: p.name)
def test_drivers_know_only_the_messages(path: Path) -> None:
    foreign = {n for n in own(path) if n.startswith("edge_agent") and not n.startswith("edge_agent.messages")}
    assert not foreign
    if path.name.endswith("_codec.py"):
        assert not {n for n in own(path) if n.endswith("_port")}


def test_messages_know_nobody() -> None:
    assert own(ROOT / "edge_agent/messages.py") == set()


def test_the_pipeline_knows_no_driver_and_the_fusion_only_messages() -> None:
    assert not {n for n in own(ROOT / "edge_agent/pipeline.py") if n.startswith("drivers")}
    for path in (ROOT / "edge_agent/fusion").glob("*.py"):
        assert all(n.startswith(("edge_agent.fusion", "edge_agent.messages")) for n in own(path)), path
    for name in ("timebase", "geodesy"):
        assert all(n.startswith("edge_agent.messages") for n in own(ROOT / f"edge_agent/{name}.py"))


@pytest.mark.parametrize("name", ["replay", "assemble"])
def test_replay_imports_no_port(name: str) -> None:
    names = own(ROOT / f"edge_agent/{name}.py")
    assert not {n for n in names if n.endswith("_port") or "runtime" in n}


@pytest.mark.parametrize("path", sorted((ROOT / "edge_agent/review").glob("*.py")), ids=lambda p: p.name)
def test_the_review_imports_no_port_no_runtime_and_no_picture_library(path: Path) -> None:
    assert not {n for n in own(path) if n.endswith("_port") or "runtime" in n or "simulate" in n}
    assert not {n.split(".")[0] for n in imports(path)} & {"time", "threading", "socket", "subprocess", "matplotlib"}
