"""What the agent says of itself: the tree, its three faces, and that saying it never costs the recording."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from live import CAN, CLOCK, GNSS, PATIENCE_S, Live, faults, ports, recordings, settings, until

from edge_agent import __main__ as cli
from edge_agent import observe, watch
from edge_agent import status as st
from edge_agent.messages import MS, Estimate, Innovation, Raw, S, Verdict
from edge_agent.simulate import simulate
from edge_agent.simulate.encode import raw_blocks
from edge_agent.simulate.specs import EPOCH_UTC_NS, START_NS

NOW = 1_780_302_645 * S  # 2026-06-01 08:30:45 UTC
MB = 1_000_000


def point(name: str, **other: Any) -> st.Point:
    verdicts = (st.Count("ACCEPTED", 174), st.Count("OFFSET", 95), st.Count("REJECTED", 19), st.Count("START", 150))
    gate = st.Gate("ACCEPTED", 0.3, 0.1312, (0.0110, 0.0146, 0.0312), verdicts)
    made = st.Point(
        name,
        "rover",
        "deck",
        "FUSED",
        True,
        (),
        0.12,
        (0.00123, -0.01204, -0.12345),
        (0.00052, 0.0006, 0.0011),
        (0.00001, -0.0123, 0.456),
        (0.0003, 0.0004, 0.0005),
        gate,
    )
    return replace(made, **other)


def port(name: str, **other: Any) -> st.Port:
    made = st.Port(name, "/dev/x", "OK", 4000.0, 0.0, 123456, 1573.2, 0, 360, 355, 5, 0, 0, 0, 0, 0)
    return replace(made, **other)


def healthy() -> st.Status:
    return st.Status(
        st.FORMAT,
        "bridge-1",
        "0.1.0",
        "a51c7cf4",
        "running",
        NOW,
        4012.3,
        (point("mid"), point("pier", accelerometer=None, mode="GNSS_ONLY", flags=("FLOAT",), gate=None)),
        (
            st.Receiver(
                "rover",
                "gnss",
                "FIXED",
                18,
                0.7,
                0.31,
                0.208,
                "learned",
                9.97,
                40123,
                40120,
                84000,
                123.456,
                0.021,
                0.3,
                (),
            ),
        ),
        (st.Accelerometer("deck", "can", 99.98, 100.0, 0.12, 401230, 9, 4, (), -12.34, (st.Count("LENGTH", 3),)),),
        (port("gnss"), port("can", bytes_per_s=12000.0)),
        (st.Queue("inbox", 152, 4 * MB, 1), st.Queue("outbox", 9611, 16 * MB, 27), st.Queue("ring", 0, 16 * MB, 0)),
        (),
        st.Clock(True, 0.0004, 0.0),
        st.Disk(
            "/var/lib/edge-agent",
            "recording",
            12_300_000_000,
            32_000_000_000,
            "bridge-1_20260601T080000Z_000.mcap.part",
            34_500_000,
            1845.0,
            345,
            9_870_000_000,
            NOW - 30 * 86400 * S,
            0.0,
            0,
        ),
        st.Process(4711, 58_500_000, 123.4, 0.0412, 6),
        (st.Count("PORT_LOST", 2),),
        (
            st.Happening(NOW - 4000 * S, "START", "mid", "fusion starts with 148 of 148 fixes", False, 1),
            st.Happening(NOW - 700 * S, "JUMP_OPEN", "mid", "fixes agree on another level", False, 2),
            st.Happening(NOW - 60 * S, "PORT_LOST", "can", "unplugged; next try in 4 s", True, 3),
        ),
    )


WIDE = """\
bridge-1  edge-agent 0.1.0  running  up 67 min  2026-06-01 08:30:45 UTC
mid       FUSED  valid  0.1 s old
  displ.  x +1.23 sd 0.52 mm      y -12.04 sd 0.60 mm     z -123.45 sd 1.10 mm
  veloc.  x +0.01 sd 0.30 mm/s    y -12.30 sd 0.40 mm/s   z +456.00 sd 0.50 mm/s
  gate    ACCEPTED, ratio 13 %  rejected 19 fixes 6.6 %  offset 95 fixes 33 %
          accepted 174 fixes 60 %  refuses steps of 11.0/14.6/31.2 mm
pier      GNSS_ONLY  valid  FLOAT  0.1 s old
  displ.  x +1.23 sd 0.52 mm      y -12.04 sd 0.60 mm     z -123.45 sd 1.10 mm
  veloc.  x +0.01 sd 0.30 mm/s    y -12.30 sd 0.40 mm/s   z +456.00 sd 0.50 mm/s
rover     FIXED  18 sat  0.3 s ago  10.0 Hz  latency 208 ms learned
          heading 123.46 sd 0.02 deg
deck      100.0 Hz of 100.0 Hz  0.1 s ago  missing 9 samples in 4 gaps
          rejects 3 frames  clock -12.3 ppm
ports     gnss OK 67 min 1.6 kB/s  can OK 67 min 12.0 kB/s
disk      recording  free 12.3 GB = 38 %  bridge-1_20260601T080000Z_000
          34.5 MB, 31 min  345 finished files, 9.9 GB  oldest 2026-05-02 UTC
lost      nothing
queues    inbox 0.0 % 152 B  outbox 0.1 % 9.6 kB  ring 0 % 0 B
clock     synchronised  error 0.4 ms
agent     RSS 58.5 MB  CPU 4.1 % of a core  6 threads  pid 4711
last
  07:24:05 UTC mid START: fusion starts with 148 of 148 fixes
  08:19:05 UTC mid JUMP_OPEN (2 times): fixes agree on another level
  08:29:45 UTC can PORT_LOST (3 times): unplugged; next try in 4 s
"""


NARROW = """\
bridge-1 edge-agent 0.1.0  running
     up 67 min  2026-06-01 08:30:45 UTC
! port can LOST for 12 s
! point mid CONTRADICTION: not valid
! the host's clock is not synchronised
mid  CONTRADICTION  not valid  0.1 s old
  x +1.23 sd 0.52 mm
  y -12.04 sd 0.60 mm
  z -123.45 sd 1.10 mm
pier GNSS_ONLY  valid  FLOAT  0.1 s old
  x +1.23 sd 0.52 mm
  y -12.04 sd 0.60 mm
  z -123.45 sd 1.10 mm
rover FIXED  18 sat  0.3 s ago  10.0 Hz
     latency 208 ms learned
     heading 123.46 sd 0.02 deg
deck 100.0 Hz of 100.0 Hz  0.1 s ago
     missing 9 samples in 4 gaps
     rejects 3 frames  clock -12.3 ppm
ports gnss OK 67 min 1.6 kB/s
     can LOST 12 s
lost nothing
08:29:45 UTC can PORT_LOST (3 times)
26 lines hidden
"""


def wanting() -> st.Status:
    s = healthy()
    return replace(
        s,
        points=(replace(s.points[0], mode="CONTRADICTION", valid=False), s.points[1]),
        ports=(s.ports[0], replace(s.ports[1], state="LOST", since_s=12.0)),
        clock=replace(s.clock, synchronised=False),
    )


# -------------------------------------------------------------------------------------------------------------- a view


def test_the_view_at_80_columns() -> None:
    text = st.render(healthy(), 80, 24, NOW)
    assert text + "\n" == WIDE
    assert len(text.split("\n")) <= 24
    assert max(map(len, text.split("\n"))) <= 80


def test_the_view_at_40_columns_keeps_what_matters() -> None:
    text = st.render(wanting(), 40, 24, NOW)
    assert text + "\n" == NARROW
    assert len(text.split("\n")) <= 24
    assert max(map(len, text.split("\n"))) <= 40


UNIT = r"(?: ?%| (?:s|ms|min|h|d|deg|mm|mm/s|Hz|ppm|B|kB|MB|GB|TB|[kMG]?B/s|sat|fix|fixes|samples?|gaps?|frames?|"
UNIT += r"sentences?|records?|blocks?|threads?|times|lines|finished files?|ago|old|UTC|lost)\b)"
NUMBER = rf"[+-]?\d+(?:\.\d+)?(?:/[\d.]+)*(?: sd \d+\.\d+)?{UNIT}"
NAMES = r"bridge-1_\S+|bridge-1|edge-agent 0\.1\.0|\d{4}-\d\d-\d\d|\d\d:\d\d:\d\d|pid \d+"


@pytest.mark.parametrize("width", [80, 40, 120, 20])
def test_every_number_has_its_unit_on_its_line(width: int) -> None:
    lost = (st.Loss("disk", "/raw/can", 12, 3.0), st.Loss("kernel", "can", 1, 400.0))
    many = replace(wanting(), losses=lost, events=())
    assert re.search(r"\d", re.sub(NUMBER, "", "-1.23 sd 0.52, 7"))  # the test can fail
    for status in (healthy(), many, replace(many, state="stopped"), replace(many, written_utc_ns=NOW - 37 * S)):
        for line in st.render(replace(status, events=()), width, None, NOW).split("\n"):
            assert len(line) <= max(width, 44), line  # a file's name is not cut
            left = re.sub(NUMBER, "", re.sub(NAMES, "", line))
            if width >= 40:
                assert not re.search(r"\d", left), f"{line!r}: {left!r}"


def test_colours_add_nothing_but_colour() -> None:
    plain, painted = (st.render(wanting(), 80, 24, NOW, colour) for colour in (False, True))
    assert "\x1b" not in plain
    bare = re.sub(r"\x1b\[[\d;]*m", "", painted)
    assert [line.rstrip() for line in bare.split("\n")] == plain.split("\n")
    assert "\x1b[1;31m! port can LOST for 12 s\x1b[0m" in painted


def test_before_the_first_fix_and_in_huge_trouble_there_is_a_view() -> None:
    s = healthy()
    nothing = replace(
        s,
        points=(point("mid", mode="INIT", valid=False, age_s=None, displacement_m=(), velocity_mps=(), gate=None),),
        receivers=(replace(s.receivers[0], age_s=None, latency_s=None, rate_hz=None, hdop=None),),
        accelerometers=(replace(s.accelerometers[0], age_s=None, rate_hz=None, expected_hz=None),),
        disk=replace(s.disk, state="waiting", free_bytes=-1, file="", file_age_s=None, oldest_utc_ns=0),
        uptime_s=5.0,
    )
    assert st.problems(nothing, NOW) == []
    text = st.render(nothing, 80, 24, NOW)
    assert "INIT  not valid" in text
    assert "no fix yet" in text
    assert "no sample yet" in text
    huge = replace(s, points=(point("mid", displacement_m=(-12345.6, 1e9, float("nan"))),), uptime_s=1e12)
    for width in (1, 7, 40, 80):
        assert st.render(huge, width + 12, 24, 2**62)


def test_a_device_cannot_steer_the_terminal() -> None:
    evil = st.Happening(NOW, "REJECT", "rover", "\x1b]0;owned\x07 \x9b2J \r\n\x00", False, 1)
    for width in (80, 40):
        text = st.render(replace(healthy(), events=(evil,)), width, None, NOW)
        assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]", text)


def test_a_view_of_many_points_says_what_it_hides() -> None:
    s = replace(healthy(), points=tuple(point(f"p{i}") for i in range(12)))
    lines = st.render(s, 80, 24, NOW).split("\n")
    assert len(lines) == 24
    assert sum(line.startswith("  displ.") for line in lines) >= 10
    hidden = len(st.render(s, 80, None, NOW).split("\n")) - 23
    assert lines[-1] == f"{hidden} lines hidden: a taller window shows them"


# ----------------------------------------------------------------------------------------------------------- judgement


def test_what_somebody_should_see_to() -> None:
    s = healthy()
    assert st.problems(s, NOW) == []

    def told(**other: Any) -> list[str]:
        return st.problems(replace(s, **other), NOW)

    assert told(clock=replace(s.clock, synchronised=False)) == ["the host's clock is not synchronised"]
    assert told(disk=replace(s.disk, state="refused")) == ["the disk refuses: records wait in memory"]
    assert "has not answered for 37 s" in told(disk=replace(s.disk, state="stalled", stalled_s=37.0))[0]
    silent = replace(s.ports[1], state="SILENT", since_s=32.0, age_s=37.0)
    slow = (replace(s.accelerometers[0], rate_hz=50.0),)
    assert told(ports=(s.ports[0], silent), accelerometers=slow) == ["port can SILENT for 37 s"]
    assert told(accelerometers=slow) == ["deck gives 50.0 Hz of 100.0 Hz"]
    assert told(ports=(replace(s.ports[0], unaccounted=2),)) == ["ledger: 2 blocks of gnss unaccounted for"]
    assert told(points=(point("mid", mode="INVALID", valid=False),)) == ["point mid INVALID: not valid"]
    assert told(points=(point("mid", mode="GNSS_ONLY"),)) == ["point mid goes on without deck"]
    (level,) = told(points=(point("mid", flags=("JUMP_OPEN",)),))
    assert level == "point mid: its fixes stand on another level; they or the estimate are wrong"
    assert told(points=(point("mid", valid=False, age_s=40.0),)) == ["point mid: no estimate for 40 s"]
    assert told(points=(point("mid", receiver=None, mode="ACCEL_ONLY", valid=False),)) == []
    assert told(losses=(st.Loss("disk", "/raw/can", 12, 3.0),)) == ["lost at disk: 12 blocks of can"]
    lost = (
        st.Loss("outbox", "/raw/gnss", 1, 9.0),
        st.Loss("outbox", "/events", 2, 4.0),
        st.Loss("kernel", "can", 7, 1.0),
    )
    assert told(losses=lost) == [
        "lost at outbox: 1 block of gnss, 2 derived records",
        "lost at kernel: 7 frames of can",
    ]
    assert told(losses=(st.Loss("disk", "/raw/can", 12, 3000.0),)) == []


def test_a_status_that_is_not_renewed_is_said_loudly() -> None:
    s = healthy()
    assert not st.stale(s, NOW + 5 * S)
    assert st.stale(s, NOW + 6 * S)
    assert st.stale(s, NOW - 6 * S)
    assert st.problems(s, NOW + 37 * S)[0] == "written 37 s ago: agent not running?"
    assert "ahead of this clock" in st.problems(s, NOW - 37 * S)[0]
    lines = st.render(s, 80, 24, NOW + 37 * S).split("\n")
    assert "NOT RUNNING?" in lines[0]
    assert lines[1] == "! written 37 s ago: agent not running?"
    ended = replace(s, state="stopped")
    assert not st.stale(ended, NOW + 3600 * S)
    assert st.problems(ended, NOW + 3600 * S) == ["the agent was stopped 60 min ago; this is its last word"]
    assert "failed and ended" in st.problems(replace(s, state="failed"), NOW)[0]


# ---------------------------------------------------------------------------------------------------------------- JSON


def test_json_holds_the_whole_tree() -> None:
    for status in (healthy(), wanting()):
        assert st.from_json(st.to_json(status)) == status
    count = replace(healthy().accelerometers[0], samples=np.int64(7), age_s=np.float32(0.5))  # as codecs may count
    got = st.from_json(st.to_json(replace(healthy(), accelerometers=(count,)))).accelerometers[0]
    assert (got.samples, got.age_s) == (7, 0.5)
    odd = replace(healthy(), receivers=(replace(healthy().receivers[0], latency_s=float("inf")),))
    text = st.to_json(odd)
    assert "Infinity" not in text
    assert st.from_json(text).receivers[0].latency_s is None


def test_what_is_no_status_is_said_and_not_guessed() -> None:
    whole = json.loads(st.to_json(wanting()))
    with pytest.raises(st.StatusError, match="another version runs there"):
        st.from_json(json.dumps({**whole, "format": 2}))
    for text in ("", "[]", "{}", "null", '{"format": 1}', "\x00", "[" * 100_000):
        with pytest.raises(st.StatusError, match="is no status of edge-agent"):
            st.from_json(text)
    seen = 0
    for path in _paths(whole):
        for wrong in ("?", [None], {"a": 1}):
            broken = json.loads(json.dumps(whole))
            spot = broken
            for key in path[:-1]:
                spot = spot[key]
            if spot[path[-1]] is None or type(spot[path[-1]]) is type(wrong):
                continue
            spot[path[-1]] = wrong
            with pytest.raises(st.StatusError):
                st.from_json(json.dumps(broken))
            seen += 1
    assert seen > 300
    whole["points"][0]["std_velocity_mps"].append(0.1)
    with pytest.raises(st.StatusError, match=r"damaged status of edge-agent: the axes of point '\w+' are not complete"):
        st.from_json(json.dumps(whole))
    whole["points"][0]["std_velocity_mps"].pop()
    del whole["disk"]["files"]
    with pytest.raises(st.StatusError, match="damaged status of edge-agent: disk is not"):
        st.from_json(json.dumps(whole))


def _paths(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    below = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [p for k, v in below for p in [(*at, k), *_paths(v, (*at, k))]]


# ---------------------------------------------------------------------------------------------------------- Prometheus


def samples(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """An independent reading of the exposition format: HELP and TYPE once and before their samples, no time stamps."""
    found: dict[tuple[str, tuple[tuple[str, str], ...]], float] = {}
    kind = helped = ""
    seen: set[str] = set()
    for line in text.splitlines():
        if line.startswith("# HELP "):
            helped = line.split(" ", 3)[2]
            assert line.split(" ", 3)[3]
            assert helped not in seen
        elif line.startswith("# TYPE "):
            _, _, name, kind = line.split(" ")
            assert name == helped
            seen.add(name)
            assert kind in ("gauge", "counter")
            assert (kind == "counter") == name.endswith("_total")
        else:
            match = re.fullmatch(r'([a-z_]+)(?:\{((?:[a-z_]+="(?:[^"\\\n]|\\["\\n])*",?)*)\})? (\S+)', line)
            assert match, line
            assert match[1] == helped
            labels = tuple(re.findall(r'([a-z_]+)="((?:[^"\\]|\\.)*)"', match[2] or ""))
            assert (match[1], labels) not in found
            found[match[1], labels] = float(match[3])
    assert text.endswith("\n")
    return found


def test_prometheus_text_says_the_same() -> None:
    got = samples(st.to_prometheus(wanting()))
    assert got["edge_agent_displacement_meters", (("point", "mid"), ("axis", "z"))] == -0.12345
    assert got["edge_agent_displacement_stddev_meters", (("point", "mid"), ("axis", "x"))] == 0.00052
    assert got["edge_agent_valid", (("point", "mid"),)] == 0
    assert got["edge_agent_mode", (("point", "mid"),)] == 5
    assert got["edge_agent_mode", (("point", "pier"),)] == 2
    assert got["edge_agent_flag", (("point", "pier"), ("flag", "FLOAT"))] == 1
    assert got["edge_agent_fix_quality", (("receiver", "rover"),)] == 4
    assert got["edge_agent_fixes_judged_total", (("point", "mid"), ("verdict", "REJECTED"))] == 19
    assert got["edge_agent_rejects_total", (("source", "deck"), ("reason", "LENGTH"))] == 3
    assert got["edge_agent_port_state", (("port", "can"), ("state", "LOST"))] == 1
    assert got["edge_agent_port_state", (("port", "can"), ("state", "OK"))] == 0
    assert got["edge_agent_faults_total", (("kind", "PORT_LOST"),)] == 2
    assert got["edge_agent_problems", ()] == 3
    assert got["edge_agent_status_time_seconds", ()] == NOW / S
    assert got["edge_agent_device_clock_deviation_ratio", (("accelerometer", "deck"),)] == pytest.approx(-12.34e-6)
    assert got["edge_agent_running", ()] == 1
    assert samples(st.to_prometheus(replace(wanting(), state="stopped")))["edge_agent_running", ()] == 0


def test_prometheus_leaves_out_what_is_not_known_and_escapes_names() -> None:
    s = healthy()
    odd = replace(
        s, site='a"b\\c\nd', points=(point("mid", age_s=None, displacement_m=()),), clock=st.Clock(True, 0, 0)
    )
    got = samples(st.to_prometheus(odd))
    assert got["edge_agent_info", (("site", 'a\\"b\\\\c\\nd'), ("version", "0.1.0"), ("run", "a51c7cf4"))] == 1
    assert not any(name == "edge_agent_displacement_meters" for name, _ in got)
    assert ("edge_agent_clock_error_seconds", ()) not in got


def test_every_number_of_the_tree_is_in_the_metrics() -> None:
    """A value that is added to the tree and forgotten here fails."""
    base = set(samples(st.to_prometheus(wanting())).items())
    left_out = {"format", "pid", "since_s", "items", "times", "utc_ns", "positions", "oldest_utc_ns", "shift_s"}
    left_out |= {"cpu_share", "bytes_per_s"}  # cpu_s and bytes say them
    left_out |= {"stalled_s"}  # changes `problems` too

    def numbers(value: Any, path: tuple[Any, ...]) -> list[tuple[Any, ...]]:
        if isinstance(value, tuple):
            return [p for i, v in enumerate(value[:1]) for p in numbers(v, (*path, i))]
        if hasattr(value, "__dataclass_fields__"):
            return [p for f in fields(value) for p in numbers(getattr(value, f.name), (*path, f.name))]
        return [path] if isinstance(value, (int, float)) and not isinstance(value, bool) else []

    def changed(value: Any, path: tuple[Any, ...]) -> Any:
        if not path:
            return value * 2 + 1
        if isinstance(path[0], int):
            return (*value[: path[0]], changed(value[path[0]], path[1:]), *value[path[0] + 1 :])
        return replace(value, **{path[0]: changed(getattr(value, path[0]), path[1:])})

    full = replace(wanting(), losses=(st.Loss("disk", "/raw/can", 12, 300.0),))
    base = set(samples(st.to_prometheus(full)).items())
    missing = []
    for path in numbers(full, ()):
        names = {p for p in path if isinstance(p, str)}
        if (
            names & left_out
            or (path[0] in ("losses", "events") and path[-1] != "count")
            or path[-2:] == ("gate", "age_s")
        ):
            continue
        if set(samples(st.to_prometheus(changed(full, path))).items()) == base:
            missing.append(path)
    assert missing == []


# ------------------------------------------------------------------------------------------------------------ the file


def put(folder: Path, status: st.Status) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / st.NAME).write_text(st.to_json(status))
    return folder


def test_the_newest_status_of_the_right_agent_is_found(tmp_path: Path) -> None:
    s = healthy()
    old, new = put(tmp_path / "old", s), put(tmp_path / "new", replace(s, written_utc_ns=NOW + S))
    assert st.load([old, tmp_path / "none", new])[0] == new / st.NAME
    assert st.load([old], s.disk.path)[1] == s
    with pytest.raises(st.StatusError, match="is of another agent: site bridge-1, which records into /var/lib"):
        st.load([old], "/elsewhere")
    with pytest.raises(FileNotFoundError, match=r"looked for .*none/status\.json"):
        st.load([tmp_path / "none"])
    (old / st.NAME).write_text("x" * (st.MAX_BYTES + 1))
    with pytest.raises(st.StatusError, match="larger than"):
        st.load([old])
    assert st.load([old, new])[0] == new / st.NAME


def test_where_the_service_writes_and_where_status_looks(tmp_path: Path) -> None:
    assert st.folder({"RUNTIME_DIRECTORY": "/run/edge-agent:/run/more"}, "/data") == Path("/run/edge-agent")
    assert st.folder({}, "/data") == Path("/data/state")
    assert watch.places({}, [], None) == [Path("/run/edge-agent")]
    assert watch.places({}, [], "/data") == [Path("/run/edge-agent"), Path("/data/state")]
    assert watch.places({}, [tmp_path], None) == [tmp_path, tmp_path / "state"]


def status_command(monkeypatch: pytest.MonkeyPatch, now_ns: int, *args: str) -> int:
    monkeypatch.setattr("time.time_ns", lambda: now_ns)
    monkeypatch.setenv("COLUMNS", "80")
    return cli.main(["status", *args])


def test_the_command_and_its_exit_codes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    where = ("--dir", str(put(tmp_path, healthy())))
    assert status_command(monkeypatch, NOW, *where) == 0
    assert capsys.readouterr().out == WIDE
    assert status_command(monkeypatch, NOW + 37 * S, *where) == 1
    assert "written 37 s ago: agent not running?" in capsys.readouterr().out
    assert status_command(monkeypatch, NOW + 37 * S, *where, "--json") == 1
    said = json.loads(capsys.readouterr().out)
    assert (said["ok"], said["stale"], said["age_s"], said["site"]) == (False, True, 37.0, "bridge-1")
    assert said["problems"] == ["written 37 s ago: agent not running?"]
    put(tmp_path, wanting())
    assert status_command(monkeypatch, NOW, *where) == 1
    assert status_command(monkeypatch, NOW, "--dir", str(tmp_path / "none")) == 2
    assert str(tmp_path / "none" / "status.json") in capsys.readouterr().err
    (tmp_path / st.NAME).write_text("garbled")
    assert status_command(monkeypatch, NOW, *where) == 1
    assert f"{tmp_path / 'status.json'} is no status of edge-agent" in capsys.readouterr().err


class Tty(io.StringIO):
    def isatty(self) -> bool:
        return True


def watched(out: io.StringIO, environment: dict[str, str], look: Callable[[], tuple[Path, st.Status]]) -> str:
    """Two frames and then Ctrl-C."""
    left = [1, 1]

    def pause() -> None:
        if not left:
            raise KeyboardInterrupt
        left.pop()

    watch.watch(out, environment, look, lambda: NOW, pause)
    return out.getvalue()


def test_watching_uses_the_terminal_as_it_is_and_leaves_it_clean(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = [(80, 24), (40, 24), (40, 24)]
    monkeypatch.setattr(watch, "size", lambda: sizes.pop(0))
    text = watched(Tty(), {"TERM": "xterm", "NO_COLOR": "1"}, lambda: (Path("x"), wanting()))
    assert text.startswith(watch.ENTER)
    assert text.endswith(watch.LEAVE)
    frames = text.removeprefix(watch.ENTER).removesuffix(watch.LEAVE).split(watch.HOME)[1:]
    assert len(frames) == 3
    bare = [re.sub(r"\x1b\[[A-Z]|\r", "", f) for f in frames]
    assert bare == [st.render(wanting(), w, 24, NOW) for w in (80, 40, 40)]
    assert "\x1b[1;31m" not in text


def test_watching_without_a_terminal_or_a_status_is_plain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(watch, "size", lambda: (80, 24))

    def nothing() -> tuple[Path, st.Status]:
        raise FileNotFoundError("no status: looked for /run/edge-agent/status.json")

    text = watched(io.StringIO(), {"TERM": "xterm"}, nothing)
    assert "\x1b" not in text
    assert text.count("looked for /run/edge-agent/status.json\nwaiting for it; Ctrl-C ends\n\n") == 3
    assert watched(Tty(), {"TERM": "dumb"}, lambda: (Path("x"), healthy())).count("\x1b") == 0
    assert "\x1b[32m" in watched(Tty(), {"TERM": "xterm"}, lambda: (Path("x"), healthy()))


# ------------------------------------------------------------------------------------------------------- a live agent


@pytest.fixture(scope="module")
def script() -> list[Raw]:
    return list(raw_blocks(simulate("clean", 1, 25.0)))


def written(live: Live, folder: Path, ticks: int) -> st.Status:
    """The status of the newest Tick, once its writer has come to it."""
    t = EPOCH_UTC_NS + ticks * S
    until(lambda: (folder / st.NAME).exists() and st.load([folder])[1].written_utc_ns >= t, "the status of that Tick")
    return st.load([folder])[1]


def test_the_agent_says_at_each_tick_what_it_does(script: list[Raw], tmp_path: Path) -> None:
    run = tmp_path / "run"
    made = settings(tmp_path)
    with Live(made, ports(), status_dir=run) as live:
        last = max(i for i, r in enumerate(script) if r.source == CLOCK)
        live.play(script[: last + 1], step=True)
        seconds = (script[last].t_ns - START_NS) // S
        s = written(live, run, seconds)
        assert (s.site, s.run, s.state, s.uptime_s) == ("site", "test", "running", float(seconds))
        assert s.written_utc_ns == EPOCH_UTC_NS + seconds * S
        (p,) = s.points
        assert (p.name, p.mode, p.valid, p.flags) == ("deck", "FUSED", True, ())
        assert p.age_s is not None
        assert 0 < p.age_s < 0.5
        assert all(0 < sd < 0.01 for sd in p.std_displacement_m)
        assert p.gate is not None
        assert {v.name for v in p.gate.verdicts} <= {"ACCEPTED", "REJECTED", "START"}
        assert all(0.002 < step < 0.2 for step in p.gate.step_m)
        (r,) = s.receivers
        assert (r.quality, r.latency_from, r.rejects) == ("FIXED", "learned", ())
        assert r.rate_hz == pytest.approx(10.0, abs=0.5)
        assert r.fixes == pytest.approx(10 * seconds, abs=15)
        (a,) = s.accelerometers
        assert a.rate_hz == pytest.approx(100.0, abs=5)
        assert a.expected_hz == 100.0
        assert [(q.name, q.state) for q in s.ports] == [(GNSS, "OK"), (CAN, "OK")]
        assert all(q.received == q.written + q.queued and not q.unaccounted for q in s.ports)
        assert s.ports[0].received == sum(x.source == GNSS for x in script[: last + 1])
        assert s.clock.synchronised
        assert s.disk.path == str(tmp_path / "rec")
        assert "START" in {e.kind for e in s.events}
        assert samples((run / st.METRICS).read_text())["edge_agent_mode", (("point", "deck"),)] == 1
        assert st.render(s, 80, 24, s.written_utc_ns)
    ended = st.load([run])[1]
    assert (ended.state, ended.disk.state, ended.disk.files) == ("stopped", "closed", 1)
    assert sorted(x.name for x in run.iterdir()) == [st.METRICS, st.NAME]


def test_a_crash_is_the_last_word(script: list[Raw], tmp_path: Path) -> None:
    with Live(settings(tmp_path), made := ports(), status_dir=tmp_path / "run") as live:
        live.play(script[:40])
        made[CAN].fail(ZeroDivisionError("a bug"))
        live.crash()
    s = st.load([tmp_path / "run"])[1]
    assert s.state == "failed"
    assert [(e.kind, e.text) for e in s.events if e.fault] == [("CRASH", "ZeroDivisionError: a bug")]


def test_a_folder_that_takes_no_status_is_told_once_and_the_agent_goes_on(script: list[Raw], tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.write_text("a file where the folder should be")
    with Live(settings(tmp_path), ports(), status_dir=run) as live:
        publisher = live.agent.publisher
        assert publisher is not None
        for i, raw in enumerate(script[:100]):
            live.play([raw], step=True)
            if raw.source == CLOCK and i < 90:
                until(lambda n=raw.t_ns: publisher.attempts >= (n - START_NS) // S, "the try")
        assert publisher.failed >= 3
        run.unlink()
        before = publisher.written
        live.play(script[100:130], step=True)
        until(lambda: publisher.written > before, "a status that could be written")
        live.play(script[130:160], step=True)
        live.settle()
    files = recordings(tmp_path / "rec")
    told = [(f["kind"], f["source"]) for f in faults(files) if f["source"] == "status"]
    assert told == [("STATUS_NOT_WRITTEN", "status"), ("STATUS_OK", "status")]
    assert "the agent goes on" in faults(files, "STATUS_NOT_WRITTEN")[0]["text"]
    assert live.balance() == {}


def test_a_folder_that_hangs_holds_up_nobody(
    script: list[Raw], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import threading

    gate, waiting = threading.Event(), threading.Event()
    real = observe.replace

    def stuck(path: Path, text: str) -> None:
        waiting.set()
        assert gate.wait(PATIENCE_S)
        real(path, text)

    monkeypatch.setattr(observe, "replace", stuck)
    with Live(settings(tmp_path), ports(), status_dir=tmp_path / "run") as live:
        live.play(script[:30])
        assert waiting.wait(PATIENCE_S)
        live.play(script[30:200])
        live.settle()
        publisher = live.agent.publisher
        assert publisher is not None
        assert publisher.written == 0
        gate.set()
    assert st.load([tmp_path / "run"])[1].state == "stopped"
    assert live.balance() == {}


def test_a_replaced_file_is_the_old_or_the_new_one(tmp_path: Path) -> None:
    target = tmp_path / "new" / "status.json"
    observe.replace(target, "one")
    observe.replace(target, "two")
    assert target.read_text() == "two"
    observe.replace(target, '"\udc80"')  # of a file name that is no UTF-8
    assert json.loads(target.read_text()) == "\udc80"
    (tmp_path / "folder" / "status.json").mkdir(parents=True)
    with pytest.raises(IsADirectoryError):
        observe.replace(tmp_path / "folder" / "status.json", "x")
    assert [p.name for p in (tmp_path / "folder").iterdir()] == ["status.json"]


def test_the_last_of_each_kind_is_remembered_and_no_more(tmp_path: Path) -> None:
    from edge_agent import assemble
    from edge_agent.messages import Event

    made = settings(tmp_path)
    observer = observe.Observer(made, assemble.pipeline(made))
    for i in range(1000):
        observer.take("deck", Event(i * MS, f"KIND{i % 50}", "deck", "x" * 1000))
    assert len(observer._events) == 4 * st.EVENTS
    newest = list(observer._events.values())[-1]
    assert (newest.kind, newest.utc_ns, len(newest.text)) == ("KIND49", 999 * MS, 200)


def test_the_gate_and_an_estimate_that_grows_old(tmp_path: Path) -> None:
    from edge_agent import assemble

    made = settings(tmp_path)
    observer = observe.Observer(made, assemble.pipeline(made))
    three = np.zeros((1, 3))
    t = START_NS + 100 * S
    observer.take(
        "deck",
        Estimate("deck", np.array([t]), three, three, three, three, np.array([1], np.uint8), np.array([2], np.uint8),
                 three[0], three[0], three[0], three[0]),
    )  # fmt: skip
    variance = np.diag([1e-6, 4e-6, 9e-6])
    for verdict in (Verdict.REJECTED, Verdict.REJECTED, Verdict.ACCEPTED, Verdict.OLD):
        observer.take("deck", Innovation("deck", t, three[0], variance, 0.5, verdict, 0, three[0], three[0]))
    disk, clock = healthy().disk, EPOCH_UTC_NS

    def seen(now_ns: int) -> st.Point:
        (p,) = observer.status(now_ns, clock, ("run", "1", "running"), (), (), disk).points
        return p

    p = seen(t + 5 * S)
    assert (p.mode, p.valid, p.flags, p.age_s) == ("FUSED", True, ("JUMP_OPEN",), 5.0)
    assert not seen(t + 5 * S + 1).valid
    assert p.gate is not None
    assert p.gate.verdict == "ACCEPTED"  # the last that the gate itself gave
    assert p.gate.verdicts == (st.Count("ACCEPTED", 1), st.Count("OLD", 1), st.Count("REJECTED", 2))
    # chi-square quantile at 0.999 with three degrees of freedom, from a table
    assert [s * s / v for s, v in zip(p.gate.step_m, np.diag(variance), strict=True)] == pytest.approx(
        [16.266] * 3, 1e-4
    )
