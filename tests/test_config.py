"""The strict configuration: every mistake at once, with its path and what would be right."""

from __future__ import annotations

import dataclasses
import re
import typing
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_agent import config
from edge_agent.__main__ import main
from edge_agent.config import PORT_KEYS, ConfigError, keys_of, load, parse
from edge_agent.messages import (
    AccelerometerSettings,
    EventSettings,
    FusionSettings,
    PointSettings,
    PortSettings,
    Quality,
    ReceiverSettings,
    RecordSettings,
    SignalField,
    Structure,
    TriggerSettings,
)

DBC = """VERSION ""
BO_ 392 Imu: 6 Vector__XXX
 SG_ AccX : 0|16@1- (0.001,0) [-32|32] "g" Vector__XXX
 SG_ AccY : 16|16@1- (0.001,0) [-32|32] "g" Vector__XXX
 SG_ AccZ : 32|16@1- (0.001,0) [-32|32] "g" Vector__XXX
"""

GOOD = """
site: bridge-1
data_dir: rec
structure: {azimuth_deg: 30, reference_llh: [47.5, 9.25, 410.5]}
ports:
  gps: {kind: serial, device: /dev/serial/by-id/rover, baud: 460800}
  can: {kind: can, channel: can0, bitrate: 500000}
receivers:
  gps1: {port: gps, latency_ms: 200, min_quality: fixed}
accelerometers:
  deck:
    port: can
    dbc: imu.dbc
    signals: {x: Imu.AccX, y: Imu.AccY, z: Imu.AccZ}
    unit: g
    rotation: [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
  tower:
    port: can
    fields:
      x: {id: 0x18FF34A0, extended: true, start: 0, length: 16, scale: 1e-3}
      y: {id: 0x18FF34A0, extended: true, start: 16, length: 16, scale: 1e-3}
      z: {id: 0x18FF34A0, extended: true, start: 32, length: 16, scale: 1e-3, byteorder: little}
points:
  mid: {receiver: gps1, accelerometer: deck}
  top: {accelerometer: tower}
fusion: {gate_alpha: 0.01}
record: {rotate_s: 600}
"""

MINIMAL = "site: s\ndata_dir: d\nports: {gps: {kind: serial, device: /dev/ttyS0}}\n"


def files(name: str) -> bytes:
    return {"imu.dbc": DBC.encode()}[name]


def mistakes(text: str, sets: tuple[str, ...] = ()) -> list[str]:
    with pytest.raises(ConfigError) as e:
        parse(text, Path(), files, sets)
    return list(e.value.mistakes)


def test_a_good_file_becomes_frozen_values() -> None:
    c = parse(GOOD, Path("site"), files)
    assert c.site == "bridge-1"
    assert c.data_dir == "site/rec"
    assert c.structure == Structure(30.0, (47.5, 9.25, 410.5))
    assert c.ports["gps"] == PortSettings("gps", "serial", device="/dev/serial/by-id/rover", baud=460800)
    assert c.ports["can"].bitrate == 500000
    assert c.receivers["gps1"] == ReceiverSettings("gps1", "gps", latency_ms=200.0, min_quality=Quality.FIXED)
    deck = c.accelerometers["deck"]
    assert deck.dbc_text == DBC
    assert deck.signals == ("Imu.AccX", "Imu.AccY", "Imu.AccZ")
    assert deck.rotation == ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    tower = c.accelerometers["tower"].fields
    assert tower is not None
    assert tower[1] == SignalField(0x18FF34A0, 16, 16, scale=0.001, extended=True)
    assert c.points["top"].receiver is None
    assert c.fusion == FusionSettings(gate_alpha=0.01)
    assert c.record == RecordSettings(rotate_s=600)
    assert c.text == GOOD
    assert c.files == (("imu.dbc", DBC.encode()),)
    with pytest.raises(dataclasses.FrozenInstanceError):
        c.site = "other"  # type: ignore[misc]


def test_load_reads_the_dbc_beside_the_file(tmp_path: Path) -> None:
    (tmp_path / "imu.dbc").write_text(DBC)
    (tmp_path / "site.yaml").write_text(GOOD)
    c = load(tmp_path / "site.yaml")
    assert c.accelerometers["deck"].dbc_text == DBC
    assert c.data_dir == str(tmp_path / "rec")


def test_a_minimal_file_holds_every_default() -> None:
    c = parse(MINIMAL, Path(), files)
    assert (c.structure, c.fusion, c.record) == (Structure(), FusionSettings(), RecordSettings())
    assert not c.receivers
    assert not c.points


# (what is put in place of what in GOOD) -> the mistake that must be named, in full or its beginning
PLANTED = [
    ("fusion: {", "fusoin: {}\nfusion: {", "fusoin: unknown key; did you mean fusion?"),
    ("gate_alpha", "gate_alfa", "fusion.gate_alfa: unknown key; did you mean gate_alpha?"),
    ("baud: 460800", "baud: fast", "ports.gps.baud: must be a whole number, not 'fast'"),
    ("baud: 460800", "baud: 9600.5", "ports.gps.baud: must be a whole number, not 9600.5"),
    ("baud: 460800", "baud: 1", "ports.gps.baud: must be from 300 to 4e+06, not 1"),
    ("kind: serial", "kind: seriel", "ports.gps.kind: must be one of: serial, can; not 'seriel'; did you mean serial?"),
    ("bitrate: 500000", "fd: yes", "ports.can.fd: must be true or false, not 'yes'"),
    ("channel: can0", "channel: 0", "ports.can.channel: must be text, not 0; put it in quotes"),
    ("channel: can0", "chanel: can0", "ports.can.chanel: unknown key; did you mean channel?"),
    (
        "bitrate: 500000",
        "interface: socketcann",
        "ports.can.interface: python-can has no interface 'socketcann'; did you",
    ),
    ("bitrate: 500000", "device: x", "ports.can.device: unknown key"),
    ("/dev/serial/by-id/rover", "COM3", "ports.gps.device: must be a path such as /dev/COM3 or socket://HOST:PORT"),
    (
        "/dev/serial/by-id/rover",
        "socket://rover",
        "ports.gps.device: must be socket://HOST:PORT or rfc2217://HOST:PORT",
    ),
    ("/dev/serial/by-id/rover", "'socket://rover:99999'", "ports.gps.device: must be socket://HOST:PORT or rfc2217"),
    ("/dev/serial/by-id/rover", "'loop://'", "ports.gps.device: must be socket://HOST:PORT or rfc2217://HOST:PORT"),
    (
        "port: gps, lat",
        "port: gsp, lat",
        "receivers.gps1.port: no port named 'gsp'; there are: gps, can (did you mean gps?)",
    ),
    ("port: gps, lat", "port: can, lat", "receivers.gps1.port: 'can' is a can port; a serial port is needed"),
    (
        "min_quality: fixed",
        "min_quality: fix",
        "receivers.gps1.min_quality: must be one of: single, fixed, float; not 'fix'",
    ),
    ("min_quality: fixed", "heading: yes", "receivers.gps1.heading: must be true or false, not 'yes'"),
    ("latency_ms: 200", "latency_ms: -1", "receivers.gps1.latency_ms: must be from 0 to 10000, not -1"),
    ("receiver: gps1", "receiver: gps2", "points.mid.receiver: no receiver named 'gps2'; there are: gps1"),
    ("{accelerometer: tower}", "{}", "points.top: names neither a receiver nor an accelerometer"),
    (
        "top: {acc",
        "mid2: {receiver: gps1, accelerometer: deck}\n  top: {acc",
        "points.mid2: is the same pair as points.mid",
    ),
    ("top: {acc", "../top: {acc", "points.../top: '../top' is no name: a name is 1 to 32 of the characters"),
    ("site: bridge-1", "site: ../../etc", "site: '../../etc' is no name"),
    ("site: bridge-1", "site: a very long name that does not fit into it", "site: 'a very long name"),
    ("site: bridge-1\n", "", "site: is missing"),
    (
        "gps: {kind",
        "clock: {kind: serial, device: /dev/x}\n  gps: {kind",
        "ports.clock: the name 'clock' is the agent's own",
    ),
    ("device: /dev/serial/by-id/rover, ", "", "ports.gps.device: is missing"),
    (
        "can: {kind",
        "can2: {kind: can, channel: can0}\n  can: {kind",
        "ports.can: opens the same can device as ports.can2",
    ),
    ("dbc: imu.dbc", "dbc: emu.dbc", "accelerometers.deck.dbc: the file 'emu.dbc' is not there"),
    ("x: Imu.AccX", "x: Imu.AccQ", "accelerometers.deck.signals: imu.dbc: no signal 'AccQ'"),
    ("x: Imu.AccX", "x: Imu.AccY", "accelerometers.deck.signals: two axes name the same signal"),
    ("z: Imu.AccZ}", "q: Imu.AccZ}", "accelerometers.deck.signals.z: is missing"),
    (
        "    unit: g\n",
        "",
        "accelerometers.deck.unit: signal Imu.AccX is in 'g' by the DBC file, unit says 'm/s2': write",
    ),
    ("unit: g", "unit: g\n    counter: Imu.Cnt", "accelerometers.deck.counter: imu.dbc: no signal 'Cnt'"),
    (
        "unit: g",
        "unit: g\n    counter: {id: 5, start: 0, length: 8}",
        "accelerometers.deck.counter: counter counter must",
    ),
    (
        "    fields:\n",
        "    counter: Imu.Cnt\n    fields:\n",
        "accelerometers.tower.dbc: is missing: the DBC file that holds the c",
    ),
    (
        "    fields:\n",
        "    dbc: imu.dbc\n    fields:\n",
        "accelerometers.tower.dbc: goes with signals, not with fields",
    ),
    ("    dbc: imu.dbc\n", "", "accelerometers.deck.dbc: is missing: the DBC file that holds these signals"),
    ("[0, 0, 1]]\n", "[0, 0, -1]]\n", "accelerometers.deck.rotation: is no rotation: it mirrors"),
    ("[0, 0, 1]]\n", "[0, 0, 1.01]]\n", "accelerometers.deck.rotation: is no rotation: row 3 has length 1.0100, not 1"),
    (
        "[-1, 0, 0], ",
        "[-1, 0.1, 0], ",
        "accelerometers.deck.rotation: is no rotation: rows 1 and 2 are not perpendicular",
    ),
    (", [0, 0, 1]]\n", "]\n", "accelerometers.deck.rotation: must be 3 rows of 3 numbers, not 2 rows"),
    ("unit: g", "unit: G", "accelerometers.deck.unit: must be one of: m/s2, g, mg, gal; not 'G'"),
    ("byteorder: little", "byteorder: intel", "accelerometers.tower.fields.z.byteorder: must be one of: little, big"),
    ("extended: true, start: 0,", "start: 0,", "accelerometers.tower.fields.x.id: 0x18FF34A0 does not fit 11 bits"),
    ("[47.5, 9.25, 410.5]", "[47.5, 9.25]", "structure.reference_llh: must be a list of 3 numbers, not [47.5, 9.25]"),
    ("[47.5, 9.25, 410.5]", "[97.5, 9.25, 410.5]", "structure.reference_llh: must be [latitude -90 to 90 deg"),
    ("gate_alpha: 0.01", "start_s: -1", "fusion.start_s: must be from 1 to 3600, not -1"),
    ("rotate_s: 600", "keep_gb: 0.1", "record.keep_gb: must hold two files of rotate_mb: at least 0.512"),
    ("rotate_s: 600", "fsync_s: 0.5", "record.fsync_s: must not be below flush_s (1)"),
    ("rotate_s: 600", "rotate_s: 600, rotate_s: 60", "record.rotate_s: stands twice, first on line 27"),
    ("rotate_s: 600}", "rotate_s: 600}\nevents: {threshold: 1}", "events.threshold: unknown key; there are: before_s"),
    ("fusion: {gate_alpha: 0.01}", "fusion: 3", "fusion: must be keys with values, not 3"),
]


@pytest.mark.parametrize(("old", "new", "said"), PLANTED)
def test_a_planted_mistake_is_named_alone(old: str, new: str, said: str) -> None:
    assert GOOD.count(old) == 1 or old in ("top: {acc", "can: {kind")
    found = mistakes(GOOD.replace(old, new))
    assert found[0].startswith(said) or any(m.startswith(said) for m in found), found
    # nothing else is said, but for a key that was renamed: what is then missing
    assert len(found) <= (2 if "unknown key" in said or "is missing" in said else 1), found
    assert all("(line " in m for m in found if not m.startswith("site: is missing"))


@pytest.mark.parametrize("device", ["socket://10.0.0.5:5017", "rfc2217://moxa-1.site:4001?ign_set_control&timeout=5"])
def test_a_network_source_is_a_device(device: str) -> None:
    assert parse(GOOD.replace("/dev/serial/by-id/rover", f"'{device}'"), Path(), files).ports["gps"].device == device


MISTAKES = Path(__file__).with_name("mistakes.yaml")


def test_each_mistake_of_a_file_full_of_them_is_named_once_with_its_line_in_one_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """GIVEN a file that tells its own mistakes WHEN it is checked by the command THEN those are said and no other."""
    planted = {}
    for line, text in enumerate(MISTAKES.read_text().splitlines(), 1):
        if "#! " in text:
            planted[line] = text.partition("#! ")[2]
    assert len(planted) == 28
    (tmp_path / "imu.dbc").write_text(DBC)
    (tmp_path / "site.yaml").write_text(MISTAKES.read_text())
    assert main(["check", "-c", str(tmp_path / "site.yaml")]) == 1
    head, *said = capsys.readouterr().out.splitlines()
    assert head == f"{tmp_path / 'site.yaml'}: {len(planted)} mistakes"
    told = {}
    for text in said:
        mistake, _, line = text.removesuffix(")").rpartition(" (line ")
        assert int(line) not in told, text
        told[int(line)] = mistake
    wrong = {
        n: (told.get(n), planted.get(n)) for n in told | planted if not told.get(n, "").startswith(planted.get(n, "?"))
    }
    assert not wrong
    assert list(told) == sorted(told)


def test_two_accelerometers_on_the_same_signals_are_refused() -> None:
    again = GOOD.replace(
        "points:\n",
        "  deck2:\n    port: can\n    dbc: imu.dbc\n    unit: g\n    signals: [AccX, AccY, AccZ]\npoints:\n",
    )
    assert mistakes(again) == [
        "accelerometers.deck2: reads the same signals of CAN id 0x188 as accelerometers.deck (line 23)"
    ]
    other_bus = again.replace("  can: {kind", "  can1: {kind: can, channel: can1}\n  can: {kind").replace(
        "deck2:\n    port: can", "deck2:\n    port: can1"
    )
    parse(other_bus, Path(), files)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: [1", "not readable as YAML: while parsing a flow sequence: expected ',' or ']', but got '<stream end>'"),
        ("a: b: c", "not readable as YAML: mapping values are not allowed here (line 1, column 5)"),
        ("a: &x 1\nb: *x", "not readable as YAML: anchors and aliases are refused: write it out (line 1, column 4)"),
        ("a: " + "[" * 3000, f"not readable as YAML: nested deeper than {config.MAX_DEPTH} levels"),
        ("a: \0", "not readable as YAML: unacceptable character #x0000"),
        ("- a", "the configuration must be keys with values, not ['a']"),
        (
            "--- {}\n--- {}",
            "not readable as YAML: expected a single document in the stream: but found another document",
        ),
        ("x" * (config.MAX_YAML_BYTES + 1), "the configuration is larger than 256 KiB"),
        ("site: !!python/object/apply:os.system ['true']", "site: the YAML tag 'python/object/"),
        ("site: !!int many", "site: 'many' is no int"),
        ("site: !!python/name:os.system x", "site: the YAML tag 'python/name:os.system' is refused"),
        ("site: s\nports:\n\tgps: x", "not readable as YAML: while scanning for the next token: found character '\\t'"),
        ("{" * 3000, f"not readable as YAML: nested deeper than {config.MAX_DEPTH} levels"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]", "not readable as YAML: anchors and aliases are refused"),
        ("<<: {a: 1}", "<<: unknown key"),
        ("a" * 500 + ": 1", "'aaaaaaaa"),
    ],
)
def test_what_is_no_plain_yaml_is_refused(text: str, said: str) -> None:
    assert any(m.startswith(said) for m in mistakes(text)), mistakes(text)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("0x188", 0x188),
        ("010", 10),  # YAML 1.1 says 8
        ("12:30:00", "12:30:00"),  # YAML 1.1 says 45000
        ("on", "on"),
        ("2026-05-01", "2026-05-01"),
        (".inf", ".inf"),
        ("'1'", "1"),
        ("~", None),
        ("[1, 2.5, true]", [1, 2.5, True]),
        ("99999999999999999999", 1e20),
    ],
)
def test_scalars_are_those_of_yaml_1_2(text: str, value: object) -> None:
    tree: dict[str, object] = {}
    config.apply_set(tree, f"a={text}")
    assert tree == {"a": value}
    assert type(tree["a"]) is type(value)


def test_an_override_changes_the_text_that_is_recorded() -> None:
    sets = ("fusion.gate_alpha=0.02", "accelerometers.deck.rotation.0=[0, -1, 0]", "accelerometers.deck.rotation.1.0=1")
    c = parse(GOOD, Path(), files, sets)
    assert c.fusion.gate_alpha == 0.02
    assert c.accelerometers["deck"].rotation[:2] == ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0))
    again = parse(c.text, Path(), files)
    assert dataclasses.replace(again, text="") == dataclasses.replace(c, text="")
    assert c.text.startswith('# --set "fusion.gate_alpha=0.02"\n')


@pytest.mark.parametrize(
    ("assignment", "said"),
    [
        ("fusion.gate_alpha", "--set fusion.gate_alpha: write path=value"),
        ("=1", "--set =1: write path=value"),
        ("site.x=1", "--set site.x=1: site holds 'bridge-1', not further keys"),
        (
            "accelerometers.deck.rotation.3=1",
            "--set accelerometers.deck.rotation.3=1: accelerometers.deck.rotation has",
        ),
        ("fusion.gate_alpha=[", "--set fusion.gate_alpha=[: not readable as YAML"),
        (
            "fusion.gate_alpho=1",
            "fusion.gate_alpho: unknown key; did you mean gate_alpha? (--set fusion.gate_alpho=1)",
        ),
        ("fusion.gate_alpha=often", "fusion.gate_alpha: must be a number, not 'often' (--set fusion.gate_alpha=often)"),
        ("points.mid.receiver=q", "points.mid.receiver: no receiver named 'q'; there are: gps1 (--set points.mid.rec"),
        (
            "ports.gps.kind=can",
            "ports.gps.device: unknown key; there are: kind, interface, channel, bitrate, fd, drain_",
        ),
        ("receivers.gps1=3", "receivers.gps1: must be keys with values, not 3 (--set receivers.gps1=3)"),
    ],
)
def test_a_wrong_override_is_named(assignment: str, said: str) -> None:
    assert mistakes(GOOD, (assignment,))[0].startswith(said)


def test_an_override_is_not_blamed_for_what_stands_in_the_file() -> None:
    found = mistakes(GOOD.replace("gate_alpha", "gate_alfa"), ("ports.gps.kind=can", "fusion.start_s=20"))
    assert found == [
        "ports.gps.device: unknown key; there are: kind, interface, channel, bitrate, fd, drain_ms, block_ms "
        "(--set ports.gps.kind=can)",
        "ports.gps.baud: unknown key; there are: kind, interface, channel, bitrate, fd, drain_ms, block_ms "
        "(--set ports.gps.kind=can)",
        "receivers.gps1.port: 'gps' is a can port; a serial port is needed "
        "(--set ports.gps.kind=can, --set fusion.start_s=20)",
        "fusion.gate_alfa: unknown key; did you mean gate_alpha? (line 26)",
    ]


def test_ten_thousand_mistakes_do_not_take_long() -> None:
    text = GOOD + "".join(f"unknown{i}: 1\n" for i in range(10_000))
    assert len(mistakes(text)) == 10_000
    assert sum("did you mean" in m for m in mistakes(text)) <= config.MAX_GUESSES


def test_what_was_forgotten_is_noted() -> None:
    assert config.notes(parse(GOOD, Path(), files)) == []
    text = GOOD.replace("  top: {accelerometer: tower}\n", "").replace("receiver: gps1, ", "")
    text = text.replace("receivers:\n  gps1: {port: gps, latency_ms: 200, min_quality: fixed}\n", "")
    assert config.notes(parse(text, Path(), files)) == [
        "ports.gps: no receiver or accelerometer reads it: recorded, not decoded",
        "accelerometers.tower: no point uses it: recorded, not fused",
    ]
    text = GOOD.partition("points:")[0]
    assert config.notes(parse(text, Path(), files)) == [
        "receivers.gps1: no point uses it: recorded, not fused",
        "accelerometers.deck: no point uses it: recorded, not fused",
        "accelerometers.tower: no point uses it: recorded, not fused",
        "points: none: nothing is fused",
    ]


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    for path, said in [
        (tmp_path / "none.yaml", "No such file"),
        (tmp_path, "not a regular file"),
    ]:
        with pytest.raises(ConfigError, match=said):
            load(path)
    latin = tmp_path / "latin.yaml"
    latin.write_bytes(b"site: M\xfcnchen\n")
    with pytest.raises(ConfigError, match="is not UTF-8 text"):
        load(latin)
    (tmp_path / "imu.dbc").mkdir()
    (tmp_path / "site.yaml").write_text(GOOD)
    with pytest.raises(ConfigError, match=r"accelerometers\.deck\.dbc: cannot be read: not a regular file"):
        load(tmp_path / "site.yaml")


def test_every_field_of_a_port_belongs_to_a_kind() -> None:
    """A field that no kind lists would be a key that nobody can write."""
    assert set(keys_of(PortSettings)) == {"kind", *(k for keys in PORT_KEYS.values() for k in keys)}


def test_every_number_has_a_least_and_a_largest_value() -> None:
    """A new numeric key needs a row in config._LIMITS: nobody must be able to ask for 1e9 MB or a rate of -1."""
    every = {
        key
        for cls in (*config._SECTIONS.values(), *config._TABLES.values(), SignalField)
        for key, f in keys_of(cls).items()
        if re.search(r"\b(int|float)\b", str(f.type)) and not re.search(r"\bbool\b", str(f.type))
    }
    missing = every - set(config._LIMITS) - {"reference_llh"}  # has a check of its own
    assert not missing, f"give these keys their smallest and largest value in config._LIMITS: {sorted(missing)}"


@pytest.mark.parametrize("cls", [Structure, FusionSettings, RecordSettings, ReceiverSettings, AccelerometerSettings])
def test_every_default_passes_its_own_check(cls: type) -> None:
    """Whatever is added to the settings later, its default written out in the YAML is accepted and changes nothing."""
    hints = typing.get_type_hints(cls)
    report = config._Report()
    name = {"name": "n", "port": "p"} if "name" in hints else {}
    default = cls(**name)
    written = {}
    for key, field in keys_of(cls).items():
        value = getattr(default, field.name)
        value = value.name.lower() if isinstance(value, Quality) else value
        written[key] = [list(v) if isinstance(v, tuple) else v for v in value] if isinstance(value, tuple) else value
    built = config._build(cls, written, "x", report, **({"name": "n"} if name else {}))
    assert report.lines() == []
    assert built == default


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    st.integers(0, len(GOOD)),
    st.integers(0, 40),
    st.text(max_size=8) | st.sampled_from(["{", "}", "[", ": ", "? ", "|", "!!", "\n", "- "]),
)
def test_any_damage_gives_a_config_or_mistakes(at: int, cut: int, put: str) -> None:
    said: tuple[str, ...] | None = None
    try:
        parse(GOOD[:at] + put + GOOD[at + cut :], Path(), files)
    except ConfigError as e:
        said = e.mistakes
    assert said is None or (said and all(len(m) < 2000 for m in said))


# -------------------------------------------------------------------------------------------------------------- README

README = (Path(__file__).resolve().parents[1] / "README.md").read_text()


def test_the_example_of_the_readme_is_good() -> None:
    text, instead = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    site = parse(text, Path(), lambda name: {"sensor.dbc": DBC.replace('"g"', '"m/s2"').encode()}[name])
    assert site.data_dir == "/var/lib/edge-agent"
    assert set(site.points) == {"mid"}
    kept = [line for line in text.splitlines() if not line.strip().startswith(("dbc:", "signals:"))]
    at = next(i for i, line in enumerate(kept) if line.strip().startswith("rotation:"))
    site = parse("\n".join([*kept[:at], instead, *kept[at:]]), Path())
    fields = site.accelerometers["deck"].fields
    assert fields is not None
    assert [f.start for f in fields] == [0, 16, 32]


def test_the_readme_lists_every_key_with_its_default() -> None:
    """A key that is added, removed or given another default must change the README too."""

    def shown(value: object) -> str:
        match value:
            case None | "":
                return "unset"
            case bool():
                return str(value).lower()
            case Quality():
                return value.name.lower()
            case tuple():
                return f"[{', '.join(shown(v) for v in value)}]"
            case float():
                return f"{value:g}"
            case _:
                return str(value)

    classes = {
        "structure": Structure,
        "ports.NAME": PortSettings,
        "receivers.ID": ReceiverSettings,
        "accelerometers.ID": AccelerometerSettings,
        "accelerometers.ID.fields.x": SignalField,
        "points.ID": PointSettings,
        "fusion": FusionSettings,
        "record": RecordSettings,
        "triggers.ID": TriggerSettings,
        "events": EventSettings,
    }
    wanted = {
        f"{path}.{key}": "required" if field.default is dataclasses.MISSING else shown(field.default)
        for path, cls in classes.items()
        for key, field in keys_of(cls).items()
    }
    section = README.partition("## Configuration")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `([\w.]+)` \|[^|]*\| ([^|]*) \|", section, re.MULTILINE)
    assert dict(rows) == wanted
    assert len(rows) == len(wanted)
