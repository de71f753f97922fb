"""What a technician gets: unit, example configuration and installer, as far as they can be tested without installing.

The rest is in tests/vm.
"""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import subprocess
import typing
from pathlib import Path
from typing import Any

import pytest
import yaml

from edge_agent import config, runtime
from edge_agent.config import keys_of, load, parse
from edge_agent.messages import (
    AccelerometerSettings,
    Config,
    EventSettings,
    FusionSettings,
    PointSettings,
    PortSettings,
    ReceiverSettings,
    RecordSettings,
    SignalField,
    Structure,
    TriggerSettings,
)

SYSTEMD = Path(__file__).resolve().parents[1] / "systemd"
UNIT = SYSTEMD / "edge-agent.service"
EXAMPLE = SYSTEMD / "example.yaml"
INSTALL = SYSTEMD / "install.sh"
LEFT_OUT = re.compile(r"^#( {2,}[a-z]\w*:.*)$", re.MULTILINE)
"""A key of the example that may be left out: `#  key: default`."""


def tool(name: str) -> str:
    path = shutil.which(name)
    if path is None:
        pytest.skip(f"{name} is not here")
    return path


def run(*command: str | Path, **env: str) -> subprocess.CompletedProcess[str]:
    """A program's end; English, whatever the machine speaks."""
    return subprocess.run(
        command, env=os.environ | {"LC_ALL": "C"} | env, stdin=subprocess.DEVNULL, capture_output=True, text=True
    )


# ---------------------------------------------------------------------------------------------------------------- unit


def complaints(folder: Path, unit: str, drop_in: str | None = None, name: str = "network.conf") -> list[str]:
    """What systemd has to say about a unit file and a drop-in; not what it says of the machine's own units."""
    path = folder / UNIT.name
    # the agent's program is not installed here
    path.write_text(unit.replace("/opt/edge-agent/venv/bin/edge-agent", shutil.which("true") or "/bin/true"))
    if drop_in is not None:
        (folder / f"{UNIT.name}.d").mkdir(exist_ok=True)
        (folder / f"{UNIT.name}.d" / name).write_text(drop_in)
    done = run(tool("systemd-analyze"), "verify", "--man=no", path)
    return [line for line in (done.stdout + done.stderr).splitlines() if "edge-agent" in line]


def test_systemd_finds_no_fault_in_the_unit(tmp_path: Path) -> None:
    """And would find one: an unknown key, a wrong value."""
    unit = UNIT.read_text()
    assert complaints(tmp_path, unit) == []
    assert complaints(tmp_path, unit.replace("ProtectHome=", "ProtectHomes="))
    assert complaints(tmp_path, unit.replace("WatchdogSec=90", "WatchdogSec=ninety"))


def test_the_drop_in_for_network_sources_is_good_too(tmp_path: Path) -> None:
    drop_in = (SYSTEMD / "network.conf").read_text()
    assert complaints(tmp_path, UNIT.read_text(), drop_in) == []
    assert complaints(tmp_path, UNIT.read_text(), drop_in.replace("IPAddressAllow=", "IPAdressAllow="))


def test_the_drop_in_for_recordings_elsewhere_is_good_and_asks_for_no_folder_that_is_not_there(tmp_path: Path) -> None:
    drop_in = (SYSTEMD / "data-dir.conf").read_text()
    assert complaints(tmp_path, UNIT.read_text(), drop_in, "data-dir.conf") == []
    assert complaints(tmp_path, UNIT.read_text(), drop_in.replace("ReadWritePaths", "ReadWritePath"), "data-dir.conf")
    (paths,) = re.findall(r"^ReadWritePaths=(.*)$", drop_in, re.MULTILINE)
    assert paths.startswith("-/")  # without the dash the service could not start at all: code 226, for ever
    assert "data-dir.conf" in UNIT.read_text()


def test_exposure_is_at_most_two() -> None:
    """Of 10, as systemd weighs what the service could do to the machine."""
    analyze = tool("systemd-analyze")
    if int(run(analyze, "--version").stdout.split()[1]) < 250:
        pytest.skip("this systemd-analyze looks at running services only")
    done = run(analyze, "security", "--offline=true", "--no-pager", "--threshold=20", UNIT)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    assert "Overall exposure level" in done.stdout


def test_the_unit_keeps_what_was_promised() -> None:
    lines = UNIT.read_text().splitlines()
    for line in (
        "Type=notify",
        "WatchdogSec=90",
        "ExecStartPre=/opt/edge-agent/venv/bin/edge-agent check -c /etc/edge-agent/site.yaml",
        "ExecStart=/opt/edge-agent/venv/bin/edge-agent run -c /etc/edge-agent/site.yaml",
        "StateDirectory=edge-agent",
        "RuntimeDirectory=edge-agent",
        "RuntimeDirectoryPreserve=yes",
        "MemoryMax=256M",
        "Restart=always",
        "TimeoutStopSec=30",
        "User=edge-agent",
        "IPAddressDeny=any",
    ):
        assert line in lines, line
    assert not [x for x in lines if "AF_INET" in x]


def test_the_unit_says_which_boot_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """ProcSubset=pid hides boot_id from the agent, and without it a power cut looks like a kill."""
    assert f"Environment={runtime.BOOT_VARIABLE}=%b" in UNIT.read_text().splitlines()
    monkeypatch.setenv(runtime.BOOT_VARIABLE, "4f2a")
    assert runtime.boot_id() == "4f2a"
    monkeypatch.setenv(runtime.BOOT_VARIABLE, "4f-2a")  # as /proc spells it
    assert runtime.boot_id() == "4f2a"
    monkeypatch.delenv(runtime.BOOT_VARIABLE)
    assert "-" not in runtime.boot_id()
    assert runtime.boot_id() != "4f2a"


# ------------------------------------------------------------------------------------------------------------- example


def test_the_example_loads() -> None:
    c = load(EXAMPLE)
    assert (c.site, c.data_dir) == ("bridge-1", "/var/lib/edge-agent")
    assert list(c.points) == ["mid", "top"]


def all_keys() -> str:
    """The example with every key that may be left out."""
    return LEFT_OUT.sub(r"\1", EXAMPLE.read_text())


def test_the_example_with_every_key_loads() -> None:
    parse(all_keys(), SYSTEMD)


def written(tree: dict[str, Any]) -> dict[type, list[dict[str, Any]]]:
    """The mappings of the example by what they become."""
    accelerometers = list(tree["accelerometers"].values())
    fields = [f for a in accelerometers for f in (a.get("fields") or {}).values()]
    return {
        Structure: [tree["structure"]],
        FusionSettings: [tree["fusion"]],
        RecordSettings: [tree["record"]],
        EventSettings: [tree["events"] or {}],
        PortSettings: list(tree["ports"].values()),
        ReceiverSettings: list(tree["receivers"].values()),
        AccelerometerSettings: accelerometers,
        PointSettings: list(tree["points"].values()),
        SignalField: fields,
        TriggerSettings: list(tree["triggers"].values()),
    }


def test_the_example_has_every_key_and_no_other() -> None:
    tree = yaml.safe_load(all_keys())
    assert set(tree) == set(config._TOP)
    known = {*config._SECTIONS.values(), *config._TABLES.values(), SignalField}
    found = written(tree)
    assert set(found) == known
    for cls, mappings in found.items():
        assert {key for mapping in mappings for key in mapping} == set(keys_of(cls)), cls.__name__


def test_what_the_example_leaves_out_is_the_default() -> None:
    """A key behind # shows its default; where that is "nothing", an example."""
    full, short = parse(all_keys(), SYSTEMD), load(EXAMPLE)
    checked = 0

    def compare(a: Any, b: Any, path: str) -> None:
        nonlocal checked
        if dataclasses.is_dataclass(a) and dataclasses.is_dataclass(b):
            for f in dataclasses.fields(a):
                if (type(a), f.name) != (Config, "text"):
                    compare(getattr(a, f.name), getattr(b, f.name), f"{path}.{f.name}")
        elif isinstance(a, typing.Mapping):
            assert a.keys() == b.keys(), path
            for key in a:
                compare(a[key], b[key], f"{path}.{key}")
        elif b is not None:
            checked += 1
            assert a == b, f"{path}: systemd/example.yaml says {a!r}, the default is {b!r}"

    compare(full, short, "")
    assert checked > 60


# ----------------------------------------------------------------------------------------------------------- installer


def test_the_installer_is_a_plain_shell_script() -> None:
    assert INSTALL.read_text().startswith("#!/bin/sh\n")
    assert os.access(INSTALL, os.X_OK)
    done = run("sh", "-n", INSTALL)
    assert done.returncode == 0, done.stderr


def test_shellcheck_is_content() -> None:
    done = run(tool("shellcheck"), INSTALL, SYSTEMD.parent / "tests/vm/guest/init", "-s", "sh")
    assert done.returncode == 0, done.stdout


def files(root: Path) -> dict[str, str]:
    return {str(p.relative_to(root)): p.read_text() for p in root.rglob("*") if p.is_file()}


def test_a_dry_run_lays_every_file(tmp_path: Path) -> None:
    """GIVEN an empty root WHEN it is installed there THEN all files are there, and nothing outside of it is needed."""
    done = run(INSTALL, DESTDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    found = files(tmp_path)
    assert found["etc/edge-agent/site.yaml"] == EXAMPLE.read_text()
    assert found["etc/systemd/system/edge-agent.service"] == UNIT.read_text()
    share = {p.name for p in SYSTEMD.iterdir()}
    assert {Path(p).name for p in found if p.startswith("opt/edge-agent/share/")} == share
    assert os.access(tmp_path / "opt/edge-agent/share/install.sh", os.X_OK)
    assert {p for p in found if p.startswith("etc/")} == {
        "etc/edge-agent/site.yaml",
        "etc/edge-agent/example.yaml",
        "etc/edge-agent/example.dbc",
        "etc/systemd/system/edge-agent.service",
        "etc/systemd/network/80-can0.network",
        "etc/udev/rules.d/80-edge-agent.rules",
        "etc/modules-load.d/edge-agent.conf",
        "etc/sysctl.d/80-edge-agent.conf",
    }
    assert load(tmp_path / "etc/edge-agent/site.yaml").site == "bridge-1"


def test_a_second_run_keeps_what_the_technician_wrote(tmp_path: Path) -> None:
    run(INSTALL, DESTDIR=str(tmp_path))
    mine = {
        "etc/edge-agent/site.yaml": "site: mine\n",
        "etc/edge-agent/example.dbc": "of my sensor\n",
        "etc/systemd/network/80-can0.network": "[CAN]\nBitRate=250K\n",
    }
    for name, text in mine.items():
        (tmp_path / name).write_text(text)
    before = files(tmp_path)
    done = run(INSTALL, DESTDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert files(tmp_path) == before
    assert done.stdout.count("stays as it is") == 3


def test_uninstalling_keeps_configuration_and_data_and_purging_does_not(tmp_path: Path) -> None:
    run(INSTALL, DESTDIR=str(tmp_path))
    recording = tmp_path / "var/lib/edge-agent/bridge-1.mcap"
    recording.parent.mkdir(parents=True)
    recording.write_text("data")
    (tmp_path / "etc/edge-agent/site.yaml").write_text("site: mine\n")
    done = run(INSTALL, "--uninstall", DESTDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert set(files(tmp_path)) == {
        "etc/edge-agent/site.yaml",
        "etc/edge-agent/example.dbc",
        "var/lib/edge-agent/bridge-1.mcap",
    }
    done = run(INSTALL, "--uninstall", "--purge", DESTDIR=str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert files(tmp_path) == {}


def test_uninstalling_keeps_a_network_file_that_was_changed(tmp_path: Path) -> None:
    run(INSTALL, DESTDIR=str(tmp_path))
    network = tmp_path / "etc/systemd/network/80-can0.network"
    network.write_text("[CAN]\nBitRate=250K\n")
    done = run(INSTALL, "--uninstall", DESTDIR=str(tmp_path))
    assert network.exists()
    assert "kept: /etc/systemd/network/80-can0.network" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--frobnicate"], "unknown option --frobnicate"),
        (["--wheels"], "--wheels needs a folder"),
        (["--purge"], "--purge goes with --uninstall"),
        (["--wheels", "/nonexistent"], "/nonexistent is no folder"),
        (["--wheels", str(SYSTEMD)], "holds no wheel of edge-agent"),
    ],
)
def test_wrong_use_is_told(arguments: list[str], says: str, tmp_path: Path) -> None:
    done = run(INSTALL, *arguments, DESTDIR=str(tmp_path))
    assert done.returncode == 1
    assert says in done.stderr
    assert files(tmp_path) == {}
