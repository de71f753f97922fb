"""The command line: exit codes, results on stdout, talk on stderr, examples that work."""

from __future__ import annotations

import argparse
import json
import re
import shlex
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

from edge_agent import __main__ as cli

README = Path(__file__).resolve().parents[1] / "README.md"

SITE = """
site: s
data_dir: rec
ports: {gps: {kind: serial, device: /dev/x}, can: {kind: can}}
receivers: {r: {port: gps}}
accelerometers:
  a:
    port: can
    fields: {x: {id: 1, start: 0, length: 16}, y: {id: 1, start: 16, length: 16}, z: {id: 1, start: 32, length: 16}}
points: {p: {receiver: r, accelerometer: a}}
"""
CANDUMP = "".join(f"({1_700_000_000 + i * 0.01:.6f}) can0 001#010002000300\n" for i in range(150))


class Run:
    """One command in this process: exit code, stdout, stderr."""

    def __init__(self, capsys: pytest.CaptureFixture[str], *argv: str | Path) -> None:
        capsys.readouterr()
        try:
            self.code = cli.main([str(a) for a in argv])
        except SystemExit as e:  # argparse's own way out
            self.code = int(e.code or 0)
        self.out, self.err = capsys.readouterr()


def commands() -> dict[str, argparse.ArgumentParser]:
    parser = cli._parser()
    (actions,) = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    return dict(actions.choices)


@pytest.fixture
def site(tmp_path: Path) -> Path:
    (tmp_path / "site.yaml").write_text(SITE)
    (tmp_path / "can.log").write_text(CANDUMP)
    return tmp_path


def test_check(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = Run(capsys, "check", "-c", site / "site.yaml")
    assert (good.code, good.err) == (0, "")
    head, *notes = good.out.splitlines()
    assert head.endswith("site.yaml: good; ports: gps, can; receivers: r; accelerometers: a; points: p")
    assert notes[0].startswith("note: ports.gps.device: /dev/x is not there now: ")
    bad = Run(capsys, "check", "-c", site / "site.yaml", "--set", "points.p.receiver=q", "--set", "fusion.x=1")
    assert (bad.code, bad.err) == (1, "")
    assert bad.out.splitlines()[0].endswith("site.yaml: 2 mistakes")
    assert "points.p.receiver: no receiver named 'q'; there are: r" in bad.out
    as_json = Run(capsys, "check", "-c", site / "site.yaml", "--json", "--set", "site=a/b")
    assert as_json.code == 1
    assert json.loads(as_json.out) == {
        "ok": False,
        "mistakes": ["site: 'a/b' is no name: a name is 1 to 32 of the characters A-Z a-z 0-9 _ - (--set site=a/b)"],
    }
    none = Run(capsys, "check", "-c", site / "none.yaml")
    assert none.code == 1
    assert "No such file" in none.out


def test_import_info_cat_recover(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = site / "raw.mcap"
    done = Run(capsys, "import", "-c", site / "site.yaml", "--can", f"{site / 'can.log'}:can0", "-o", out, "--json")
    assert (done.code, done.err) == (0, "")
    result = json.loads(done.out)
    assert (result["output"], result["ticks"], result["lost"], result["logs"][0]["frames"]) == (str(out), 2, 0, 150)

    info = Run(capsys, "info", out, "--json")
    assert info.code == 0
    assert json.loads(info.out)[0]["topics"]["/raw/can"]["schema"] == "edge_agent_msgs/msg/CanFrames"

    cat = Run(capsys, "cat", "--topic", "/raw/can", "--from", "2023-11-14T22:13:21", out)
    assert (cat.code, cat.err) == (0, "")
    assert len(cat.out.splitlines()) == 1 + 50
    unnamed = Run(capsys, "cat", out)
    assert unnamed.code == 2
    assert unnamed.out == ""
    assert "There are:\n  /raw/can\n  /raw/clock" in unnamed.err
    nothing = Run(capsys, "cat", "--topic", "/fusion/p/block", out)
    assert (nothing.code, nothing.out) == (1, "")

    torn = site / "torn.mcap.part"
    torn.write_bytes(out.read_bytes()[:-300])
    recover = Run(capsys, "recover", site, "--json")
    assert recover.code == (3 if json.loads(recover.out)[0]["lost_bytes"] else 0)
    assert Run(capsys, "info", site / "torn.mcap").code == 0
    assert Run(capsys, "recover", site).out == "nothing to recover\n"
    whole = out.read_bytes()
    assert Run(capsys, "recover", out).out == "nothing to recover\n"
    assert out.read_bytes() == whole
    out.write_bytes(whole[:-100])  # a cut file under its final name
    assert Run(capsys, "recover", out).code in (0, 3)
    assert Run(capsys, "info", out).code == 0
    assert Run(capsys, "recover", site).out == "nothing to recover\n"
    (site / "notes.txt").write_text("x")
    assert Run(capsys, "recover", site / "notes.txt").code == 2


def test_an_import_with_lost_lines_says_so(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (site / "can.log").write_text(CANDUMP + "what is this\n")
    done = Run(capsys, "import", "--can", f"bus={site / 'can.log'}", "-o", site / "raw.mcap")
    assert done.code == 3
    assert done.err == "can.log:151: is no candump frame: 'what is this'\n"
    assert "  bus: 150 frames of 151 lines of " in done.out
    assert done.out.endswith(", 1 lines lost\n")


def test_simulate_makes_files_that_check_and_read(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = Run(capsys, "simulate", "rough", "--seed", "3", "--seconds", "20", "-o", tmp_path / "sim")
    assert done.code == 0
    assert sorted(Path(p).name for p in done.out.split()) == sorted(p.name for p in (tmp_path / "sim").iterdir())
    assert Run(capsys, "check", "-c", tmp_path / "sim" / "config.yaml").code == 0
    assert Run(capsys, "info", tmp_path / "sim" / "raw.mcap").code == 0
    assert Run(capsys, "simulate", "nope", "-o", tmp_path / "x").code == 2


@pytest.mark.parametrize(
    "argv",
    [
        [],
        ["nope"],
        ["run"],
        ["run", "-c", "none.yaml"],
        ["import", "-o", "x.mcap"],
        ["import", "--can", "none.log", "-o", "x.mcap"],
        ["import", "--nmea", "none.nmea", "--date", "today", "-o", "x.mcap"],
        ["replay", "x.mcap"],
        ["replay", "x.mcap", "-o", "y", "--set", "a=1"],
        ["info", "none.mcap"],
        ["cat", "--topic", "/a", "none.mcap"],
        ["cat", "--topic", "/a", "--from", "soon", "none.mcap"],
    ],
)
def test_wrong_use_is_2_and_said_on_stderr(argv: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    run = Run(capsys, *argv)
    assert (run.code, run.out) == (2, "")
    assert run.err


def test_a_file_that_is_no_recording(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert Run(capsys, "info", site / "site.yaml").code == 2
    run = Run(capsys, "cat", "--topic", "/a", site / "site.yaml")
    assert run.code in (1, 2)
    assert "not an MCAP file" in run.err


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    run = Run(capsys, "--version")
    assert (run.code, run.out) == (0, f"edge-agent {version('edge-agent')}\n")


@pytest.mark.parametrize("name", list(commands()))
def test_every_command_has_an_example_that_parses(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run(capsys, name, "--help")
    assert run.code == 0
    examples = run.out.partition("example:\n")[2].partition("\n\n")[0].strip().splitlines()
    assert examples
    for example in examples:
        words = shlex.split(example.partition(">")[0])
        assert words[:2] == ["edge-agent", name]
        cli._parser().parse_args(words[1:])


def test_start_is_light() -> None:
    """The parser alone must not load what a single command needs."""
    code = "import sys, edge_agent.__main__ as m; m._parser(); print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    heavy = {"numpy", "yaml", "can", "cantools", "mcap", "serial", "zstandard", "matplotlib", "importlib.metadata"}
    assert heavy.isdisjoint(loaded)


def test_a_reader_that_stops_early_is_no_error(site: Path) -> None:
    """`edge-agent cat ... | head`: no traceback, no complaint."""
    (site / "can.log").write_text(CANDUMP * 100)
    assert cli.main(["import", "--can", str(site / "can.log"), "-o", str(site / "raw.mcap")]) == 0
    command = [sys.executable, "-m", "edge_agent", "cat", "--topic", "/raw/can", str(site / "raw.mcap")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


def test_readme_names_every_command_and_no_other() -> None:
    named = set(re.findall(r"^\| `edge-agent ([a-z]+)", README.read_text(), re.MULTILINE))
    assert named == set(commands())


def test_replay_verifies_and_retunes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sim, fused, other = tmp_path / "sim", tmp_path / "fused.mcap", tmp_path / "other.mcap"
    assert Run(capsys, "simulate", "rough", "--seconds", "25", "-o", sim).code == 0
    assert Run(capsys, "replay", sim / "raw.mcap", "-o", fused).code == 0
    verified = Run(capsys, "replay", "--verify", "--json", fused)
    report = json.loads(verified.out)
    assert (verified.code, report["ok"], report["differing"], report["missing"]) == (0, True, 0, 0)
    assert report["compared"] == report["derived"] > 500
    retune = ["-c", sim / "config.yaml", "--set", "fusion.start_s=10"]
    assert Run(capsys, "replay", sim / "raw.mcap", *retune, "-o", other).code == 0
    early = Run(capsys, "cat", "--topic", "/fusion/deck/block", "--to", "2026-06-01T08:00:14", other)
    assert early.code == 0
    late = Run(capsys, "cat", "--topic", "/fusion/deck/block", "--to", "2026-06-01T08:00:14", fused)
    assert late.code == 1
    attached = Run(capsys, "replay", "--verify", other)  # with the overridden configuration that it carries
    assert attached.code == 0
    (tmp_path / "can.log").write_text(CANDUMP)
    assert Run(capsys, "import", "--can", tmp_path / "can.log", "-o", tmp_path / "bare.mcap").code == 0
    bare = Run(capsys, "replay", tmp_path / "bare.mcap", "-o", tmp_path / "x.mcap")
    assert bare.code == 2
    assert "holds no config.yaml: give one with -c" in bare.err
    again = Run(capsys, "replay", sim / "raw.mcap", "-o", fused)
    assert (again.code, again.out) == (2, "")


# ----------------------------------------------------------------------------------------- what cannot be, said clearly

MCAP_COMMANDS = (
    ["review", "IN", "-o", "OUT/r.html"],
    ["tune", "IN"],
    ["replay", "IN", "-o", "OUT/o.mcap"],
    ["verify", "IN"],
    ["recover", "IN"],
    ["layouts", "IN", "-o", "OUT/l"],
)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good raw recording, an empty folder, text, another program's MCAP, and one whose configuration is cut out."""
    from mcap.writer import Writer

    folder = tmp_path_factory.mktemp("places")
    for name in ("empty", "out", "deep/inside"):
        (folder / name).mkdir(parents=True)
    (folder / "text.mcap").write_text("hello")
    assert cli.main(["simulate", "P2", "--seconds", "5", "-o", str(folder / "sim")]) == 0
    (folder / "sim" / "raw.mcap").rename(folder / "raw.mcap")
    (folder / "deep" / "inside" / "raw.mcap").write_bytes((folder / "raw.mcap").read_bytes())
    with (folder / "strange.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start("x", "y")
        channel = writer.register_channel("/camera", "json", writer.register_schema("a/B", "jsonschema", b"{}"))
        writer.add_message(channel, 10**18, b"{}", 10**18)
        writer.finish()
    return folder


@pytest.mark.parametrize("command", MCAP_COMMANDS, ids=lambda c: c[0])
@pytest.mark.parametrize("what", ["nowhere.mcap", "empty", "text.mcap", "strange.mcap", "deep"])
def test_what_is_no_recording_is_named_in_one_line(
    places: Path, command: list[str], what: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {p: p.read_bytes() for p in places.rglob("*.mcap*") if p.is_file()}
    argv = [w.replace("IN", str(places / what)).replace("OUT", str(places / "out")) for w in command]
    run = Run(capsys, *argv)
    name = command[0]
    nothing_to_do = name == "recover" and what in ("empty", "strange.mcap", "deep")
    expected = 0 if nothing_to_do or (name, what) == ("verify", "strange.mcap") else 2
    if what == "text.mcap" and name in ("verify", "replay"):
        expected = 1
    assert run.code == expected
    told = run.out + run.err
    assert "Traceback" not in told
    assert "Errno" not in told
    assert "in nothing" not in told
    if expected == 2:
        assert run.out == ""
        (line,) = run.err.splitlines()
        assert what in line
        assert line.startswith("edge-agent: ")
    if what == "deep" and name in ("review", "tune", "layouts"):
        assert f"there are some in {places / 'deep' / 'inside'}" in run.err
    if what == "strange.mcap" and name in ("review", "tune", "layouts"):
        assert "no recording of edge-agent: it holds /camera" in run.err
    if (name, what) == ("verify", "strange.mcap"):
        assert "note: strange.mcap holds no raw data" in run.out
    assert {p: p.read_bytes() for p in places.rglob("*.mcap*") if p.is_file()} == before


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["review", "raw.mcap", "-o", "gone/r.html"], "there is no folder"),
        (["review", "raw.mcap", "-o", "out"], "the page is HTML, name it so"),
        (["review", "raw.mcap", "-o", "out/raw.mcap"], "the page is HTML, name it so"),
        (["review", "raw.mcap", "-o", "recording.html"], "is a recording"),
        (["review", "raw.mcap", "-o", "page.html"], "is a folder: name a file in it"),
        (["replay", "raw.mcap", "-o", "gone/o.mcap"], "there is no folder"),
        (["replay", "raw.mcap", "-o", "raw.mcap"], "is one of the recordings that are read"),
        (["replay", ".", "-o", "raw.mcap"], "is one of the recordings that are read"),
        (["replay", "raw.mcap", "-o", "out"], "is a folder: name a file in it"),
        (["replay", "raw.mcap", "--set", "fusion.gate_alpha=0.01", "--compare", "--page", "gone/p.html"], "no folder"),
        (["layouts", "raw.mcap", "-o", "raw.mcap"], "File exists"),
        (["simulate", "clean", "--seconds", "5", "-o", "raw.mcap"], "File exists"),
        (["simulate", "clean", "--seconds", "0", "-o", "new"], "the duration must be above 0"),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, list) else "",
)
def test_an_output_that_cannot_be_is_refused_before_the_work_and_nothing_is_lost(
    places: Path, argv: list[str], words: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(places)
    (places / "recording.html").write_bytes((places / "raw.mcap").read_bytes())
    (places / "page.html").mkdir(exist_ok=True)
    before = {p: p.read_bytes() for p in places.rglob("*") if p.is_file()}
    run = Run(capsys, *argv)
    assert (run.code, run.out) == (2, "")
    (line,) = run.err.splitlines()
    assert words in line
    assert "Errno" not in line
    assert {p: p.read_bytes() for p in places.rglob("*") if p.is_file()} == before


def test_a_folder_or_a_file_without_permission_is_said(
    places: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As another user: here tests may run as root, whom nothing is refused."""
    monkeypatch.setattr("os.access", lambda *_: False)
    run = Run(capsys, "review", places / "raw.mcap", "-o", places / "r.html")
    assert (run.code, run.err) == (2, f"edge-agent: review: may not write into {places}\n")

    def refused(path: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("edge_agent.review.series.read_messages", refused)
    run = Run(capsys, "tune", places / "raw.mcap")
    assert (run.code, run.err) == (2, f"edge-agent: tune: {places / 'raw.mcap'}: Permission denied\n")


def test_simulate_says_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    from edge_agent.simulate import SCENARIOS

    said = Run(capsys, "simulate", "--help").out.partition("scenarios:\n")[2].splitlines()
    assert [line.split()[0] for line in said] == list(SCENARIOS)
    for line, scenario in zip(said, SCENARIOS.values(), strict=True):
        assert len(line.split(maxsplit=1)[1]) > 20
        for mode in scenario.structure.modes[:2] if scenario.name.startswith("P") else ():
            assert f"{mode.freq_hz:g}".lstrip("0") in line


def test_review_says_its_exit_codes(capsys: pytest.CaptureFixture[str]) -> None:
    said = Run(capsys, "review", "--help").out
    assert all(f"{k} " in said.partition("Exit codes:")[2] for k in range(4))
