"""What a few seconds of bytes and frames say about wiring and settings, planted fault by planted fault."""

from __future__ import annotations

import functools
import gzip
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge_agent import judge
from edge_agent.judge import BAD, GOOD, NOTE, Finding, judge_can, judge_serial, scan
from edge_agent.messages import (
    MS,
    AccelerometerSettings,
    CanFlag,
    CanFrames,
    PortSettings,
    Quality,
    Raw,
    ReceiverSettings,
    S,
    SignalField,
    Tick,
)
from edge_agent.simulate.encode import nmea_epoch, sentence

PORT = PortSettings("gnss", "serial", device="/dev/x")
ROVER = ReceiverSettings("rover", "gnss")
UTC = 1_780_300_800 * S
UBX = bytes.fromhex("b562010700005064"[:12]) + bytes.fromhex("0819")  # NAV-PVT poll: Fletcher of 01 07 00 00


def ticks(sync: bool = True, error_ns: int = 0) -> list[Raw]:
    return [Raw(100 * S, 0, "clock", Tick(UTC + error_ns, sync, 0))]


def stream(
    seconds: int = 10, hz: int = 5, quality: int = 4, latency_ms: int = 80, date: bool = True, **form: object
) -> list[Raw]:
    """Reads of a receiver whose clock and the host's agree."""
    out = []
    for i in range(seconds * hz):
        t = i * S // hz
        data = nmea_epoch(
            UTC + t, (46.5, 7.5, 610.0), (0.003, 0.003, 0.006), quality, date=date and i % hz == 0, **form
        )  # type: ignore[arg-type]
        out.append(Raw(100 * S + t + latency_ms * MS, i, "gnss", data))
    return out


def levels(findings: list[Finding]) -> dict[str, str]:
    """Worst level by path."""
    worst: dict[str, str] = {}
    for f in findings:
        if [GOOD, NOTE, BAD].index(f.level) >= [GOOD, NOTE, BAD].index(worst.get(f.where, GOOD)):
            worst[f.where] = f.level
    return worst


def said(findings: list[Finding], level: str) -> list[str]:
    return [f"{f.where}: {f.text}" for f in findings if f.level == level]


# -------------------------------------------------------------------------------------------------------------- serial


def test_a_good_receiver_has_nothing_to_mend() -> None:
    found = judge_serial(PORT, ROVER, stream(), ticks(), 10.0)
    assert levels(found) == {"ports.gnss": GOOD, "receivers.rover": GOOD, "receivers.rover.latency_ms": GOOD}
    text = "\n".join(said(found, GOOD))
    assert "GNGGA 5/s, GNGST 5/s, GNZDA 1/s" in text
    assert "5 fixes/s: fixed 100 %; 18 satellites, HDOP 0.7 at worst" in text
    assert "one step of the last decimal is 0.0019 mm north, 0.01 mm up" in text
    assert "fixes arrive 80 ms after their time, sd 0.0 ms" in text


@pytest.mark.parametrize(
    ("raws", "receiver", "clock", "where", "level", "text"),
    [
        ([], ROVER, ticks(), "ports.gnss", BAD, "nothing came: check power, the cable"),
        (
            [Raw(S, 0, "gnss", bytes(range(128, 256)) * 20)],
            ROVER,
            ticks(),
            "ports.gnss",
            BAD,
            "256 bytes/s, but no sentence and no frame of a known protocol",
        ),
        (
            stream(quality=1),
            ROVER,
            ticks(),
            "receivers.rover.min_quality",
            BAD,
            "no fix reaches float: are corrections",
        ),
        (stream(quality=5), ROVER, ticks(), "receivers.rover", NOTE, "no fixed solution: the start waits for 15 s of"),
        (
            stream(quality=0),
            ROVER,
            ticks(),
            "receivers.rover",
            BAD,
            "5 fixes/s, none with a position: check the antenna",
        ),
        (
            stream(minute_decimals=5, height_decimals=2),
            ROVER,
            ticks(),
            "receivers.rover",
            BAD,
            "one step of the last decimal is 19 mm north, 10 mm up, too coarse: send at least 7 decimals",
        ),
        (stream(sentences=("GGA",)), ROVER, ticks(), "receivers.rover", NOTE, "no GST comes: accuracy is guessed"),
        (stream(date=False), ROVER, ticks(), "receivers.rover", NOTE, "no date comes (RMC or ZDA)"),
        (
            stream(sentences=("GST",), date=False),
            ROVER,
            ticks(),
            "receivers.rover",
            BAD,
            "no position comes: switch on GGA",
        ),
        (
            stream(),
            ROVER,
            ticks(sync=False),
            "receivers.rover.latency_ms",
            NOTE,
            "the gateway's clock is not disciplined (chrony), so the latency of the fixes cannot be told",
        ),
        (
            stream(),
            replace(ROVER, latency_ms=200.0),
            ticks(),
            "receivers.rover.latency_ms",
            BAD,
            "fixes arrive 80 ms after their time, sd 0.0 ms, not 200: correct it",
        ),
        (stream(), replace(ROVER, latency_ms=90.0), ticks(), "receivers.rover.latency_ms", GOOD, "fixes arrive 80 ms"),
        (
            stream(),
            ROVER,
            ticks(error_ns=-3 * S),
            "receivers.rover.latency_ms",
            BAD,
            "fixes arrive -2920 ms after their time, sd 0.0 ms: before it, so the gateway's clock",
        ),
        (
            stream(),
            replace(ROVER, heading=True),
            ticks(),
            "receivers.rover.heading",
            BAD,
            "no heading comes: switch on",
        ),
    ],
)
def test_each_fault_of_a_receiver_is_told(
    raws: list[Raw], receiver: ReceiverSettings, clock: list[Raw], where: str, level: str, text: str
) -> None:
    found = judge_serial(PORT, receiver, raws, clock, 10.0)
    assert any(f.where == where and f.level == level and f.text.startswith(text) for f in found), found
    assert len(said(found, BAD)) == (level == BAD)


def test_noise_on_the_line_is_told() -> None:
    raws = stream()
    for i in range(0, len(raws), 5):
        data = raws[i].payload
        assert isinstance(data, bytes)
        raws[i] = replace(raws[i], payload=data.replace(b"GGA", b"GGB"))
    assert said(judge_serial(PORT, ROVER, raws, ticks(), 10.0), BAD) == [
        "ports.gnss: 10 of 110 fail their checksum: noise, a bad ground, or bytes lost"
    ]


def test_a_heading_that_comes_is_no_fault() -> None:
    raws = [replace(r, payload=r.payload + sentence("GNTHS,123.4,A")) for r in stream() if isinstance(r.payload, bytes)]
    assert levels(judge_serial(PORT, replace(ROVER, heading=True), raws, ticks(), 10.0))["receivers.rover"] == GOOD


def test_a_port_without_receiver_is_only_counted() -> None:
    assert [f.level for f in judge_serial(PORT, None, stream(quality=1), ticks(), 10.0)] == [GOOD]


def test_binary_frames_are_told_by_protocol_and_hide_no_sentence() -> None:
    rtcm = bytes.fromhex("d300133ed7d30202980edeef34b4bd62ac0941986f33360b98")  # RTCM 10403's example of message 1005
    gga = sentence("GNGGA,1")
    found = scan(b"ga\r\n" + UBX + gga + rtcm + UBX[:-1] + b"\0" + gga + b"\xd3\x00" + gga[:5])
    assert found.sentences == {"GNGGA": 2}
    assert found.binary == {"UBX": 1, "RTCM3": 1}
    assert found.bad == 1


CHECKED = re.compile(rb"\$([A-Z]{2}(?:GGA|GST)),([^$*\r\n]*)\*([0-9A-F]{2})")


def oracle(data: bytes) -> dict[str, int]:
    found: dict[str, int] = {}
    for m in CHECKED.finditer(data):
        if functools.reduce(lambda a, b: a ^ b, m[0][1:-3]) == int(m[3], 16):
            found[m[1].decode()] = found.get(m[1].decode(), 0) + 1
    return found


@pytest.mark.parametrize(
    "name",
    [
        "A1-dresden-10hz-gga-gst/Messg_4.log",
        "A2-ublox-m8p-ubx-nmea-static/*",
        "A4-gpsd-regression-logs/ublox-f9p-hpnmea.log",
        "A4-gpsd-regression-logs/unicore-um621.log",
        "A8-mixed-and-damaged-streams/pygpsdata-MIXED2.log",
    ],
)
def test_real_streams_are_counted_as_another_count_says(shared_data: Path, name: str) -> None:
    (path, *_) = sorted(p for p in shared_data.glob(name) if p.suffix not in (".md", ".txt"))
    data = path.read_bytes()
    data = (gzip.decompress(data) if path.suffix == ".gz" else data)[:400_000]
    found = scan(data)
    assert {k: n for k, n in found.sentences.items() if k[2:] in ("GGA", "GST")} == oracle(data)


def test_a_real_receiver_of_few_decimals_is_told_so(shared_data: Path) -> None:
    (path,) = (shared_data / "A2-ublox-m8p-ubx-nmea-static").glob("*.ubx.gz")
    data = gzip.decompress(path.read_bytes())[:200_000]
    raws = [Raw(100 * S + i * MS, i, "gnss", data[i : i + 500]) for i in range(0, len(data), 500)]
    found = judge_serial(PORT, ROVER, raws, ticks(sync=False), 100.0)
    assert any("18 mm north" in text or "19 mm north" in text for text in said(found, BAD)), found
    assert any("UBX" in text for text in said(found, GOOD))


# ----------------------------------------------------------------------------------------------------------------- CAN

BUS = PortSettings("can", "can")
FIELDS = tuple(SignalField(0x188, start, 16, scale=0.001) for start in (0, 16, 32))
DECK = AccelerometerSettings("deck", "can", fields=FIELDS)  # type: ignore[arg-type]


def block(xyz: tuple[float, float, float], n: int = 200, hz: int = 100, can_id: int = 0x188) -> CanFrames:
    """A sensor at rest with a little noise, counting; in mm/s2."""
    rng = np.random.default_rng(1)
    data = np.zeros((n, 8), np.uint8)
    raw = np.rint(np.array(xyz) * 1000 + rng.normal(0, 5, (n, 3))).astype("<i2")
    data[:, :6] = raw.view(np.uint8)
    data[:, 6] = np.arange(n)
    t = 100 * S + (np.arange(n) * S) // hz
    return CanFrames(t, np.full(n, can_id, np.uint32), np.zeros(n, np.uint8), np.full(n, 8, np.uint8), data)


def can_raws(*blocks: CanFrames) -> list[Raw]:
    return [Raw(int(b.t_ns[-1]), i, "can", b) for i, b in enumerate(blocks)]


def judged(sensor: AccelerometerSettings, *blocks: CanFrames) -> list[Finding]:
    return judge_can(BUS, [sensor], can_raws(*blocks), 2.0, 500_000, {(False, 0x188): "Imu"})


REST = (0.02, -0.03, 9.81)


def test_a_good_sensor_has_nothing_to_mend() -> None:
    found = judged(DECK, block(REST))
    assert set(levels(found).values()) == {GOOD}
    assert [f.text for f in found] == [
        "100 frames/s, at most 3 % of what the bus can carry",
        "0x188 100/s of 8 bytes (Imu) -> deck",
        "200 samples, 100/s; the first is (0.022, -0.026, 9.812) m/s2",
        "gravity 9.81 m/s2 on +z, 0.2 deg from it; sd 0.0048 m/s2",
    ]


@pytest.mark.parametrize(
    ("sensor", "frames", "where", "level", "text"),
    [
        (
            DECK,
            block((0.0, 0.0, 9.81), can_id=0x189),
            "accelerometers.deck",
            BAD,
            "none of its frames came: 0x188; check the sensor's address",
        ),
        (
            DECK,
            block((-9.8, 0.1, 0.2)),
            "accelerometers.deck.rotation",
            BAD,
            "gravity is not on z but at (-9.8, 0.1, 0.2): the sensor's own -x points up, so the third row should be "
            "[-1, 0, 0]",
        ),
        (
            replace(DECK, rotation=((0, 0, 1), (1, 0, 0), (0, 1, 0))),
            block((0.0, 0.0, 9.81)),
            "accelerometers.deck.rotation",
            BAD,
            "gravity is not on z but at (9.8, 0.0, 0.0): the sensor's own +z points up, so the third row should be "
            "[0, 0, 1]",
        ),
        (
            DECK,
            block((1.7, 0.0, 9.66)),
            "accelerometers.deck.rotation",
            NOTE,
            "gravity is 10 deg from z: put that into",
        ),
        (
            DECK,
            block((0.0, 0.0, 1.0)),
            "accelerometers.deck.unit",
            BAD,
            "mean (0.00, 0.00, 1.00) m/s2: with unit: g it",
        ),
        (
            replace(DECK, unit="g"),
            block((0.0, 0.0, 9.81)),
            "accelerometers.deck.unit",
            BAD,
            "mean (0.00, 0.00, 96.19) m/s2: with unit: m/s2 it would be gravity",
        ),
        (
            DECK,
            block((0.0, 0.0, 0.0)),
            "accelerometers.deck",
            NOTE,
            "mean (0.00, 0.00, 0.00) m/s2: no gravity; a sensor",
        ),
        (
            DECK,
            block((0.0, 0.0, 5.0)),
            "accelerometers.deck",
            BAD,
            "mean (0.00, 0.00, 5.00) m/s2, length 5.00: at rest",
        ),
        (
            replace(DECK, rate_hz=200.0),
            block(REST),
            "accelerometers.deck.rate_hz",
            BAD,
            "samples come at 100 Hz, not 200: correct it, or leave it out",
        ),
        (
            DECK,
            replace(block(REST), length=np.full(200, 4, np.uint8)),
            "accelerometers.deck",
            BAD,
            "frames refused: 200 SHORT",
        ),
    ],
)
def test_each_fault_of_a_sensor_is_told(
    sensor: AccelerometerSettings, frames: CanFrames, where: str, level: str, text: str
) -> None:
    found = judged(sensor, frames)
    assert any(f.where == where and f.level == level and f.text.startswith(text) for f in found), found
    assert len(said(found, BAD)) == (level == BAD)


def test_a_wrong_row_of_the_rotation_that_was_told_is_right_when_put_in() -> None:
    raws = block((-9.8, 0.1, 0.2))
    right = replace(DECK, rotation=((0, 0, 1), (0, 1, 0), (-1, 0, 0)))
    assert said(judged(right, raws), BAD) == []


def in_three_frames(order: str, begin: int, gone: int = 0) -> CanFrames:
    """The sensor at rest as a message per axis in this order, from the frame `begin` on, without every `gone`-th."""
    whole = block(REST)
    keep = [k for k in range(begin, 600) if not gone or k % gone]
    at = np.array(keep) // 3
    axis = np.array(["xyz".index(order[k % 3]) for k in keep])
    data = np.zeros((at.size, 8), np.uint8)
    for k in (0, 1):
        data[:, k] = whole.data[at, 2 * axis + k]
    t = whole.t_ns[at] + np.array(keep) % 3 * 300_000
    flags = np.zeros(at.size, np.uint8)
    return CanFrames(t, (0x188 + axis).astype(np.uint32), flags, np.full(at.size, 8, np.uint8), data)


@pytest.mark.parametrize("order", ["xyz", "zyx"])
@pytest.mark.parametrize("begin", [0, 1, 2])
def test_listening_begins_amid_a_sample_of_several_frames(order: str, begin: int) -> None:
    """That is nobody's fault; frames that are missing again and again are, and each is counted."""
    fields = tuple(SignalField(0x188 + i, 0, 16, scale=0.001) for i in range(3))
    sensor = replace(DECK, fields=fields)
    assert set(levels(judged(sensor, in_three_frames(order, begin))).values()) == {GOOD}
    bad = said(judged(sensor, in_three_frames(order, begin, gone=30)), BAD)
    assert re.match(r"accelerometers.deck: frames refused: [34]\d INCOMPLETE; check the DBC file", bad[0])


def test_samples_that_the_sensor_counted_and_nobody_saw_are_told() -> None:
    counted = replace(DECK, counter=SignalField(0x188, 48, 8, signed=False))
    full = block(REST)
    keep = np.arange(200) % 10 != 3
    half = CanFrames(full.t_ns[keep], full.can_id[keep], full.flags[keep], full.length[keep], full.data[keep])
    assert said(judged(counted, half), BAD) == ["accelerometers.deck: 20 samples missing by the sensor's own counter"]
    assert said(judged(counted, full), BAD) == []


def test_what_nobody_decodes_is_named_and_the_rest_is_not_hidden() -> None:
    found = judged(DECK, block(REST), block(REST, n=20, hz=10, can_id=0x7A1))
    assert said(found, NOTE) == ["ports.can: recorded, decoded by nobody: 0x7A1 10/s"]
    assert said(found, BAD) == []


def test_a_silent_bus_and_error_frames_say_what_to_measure() -> None:
    (silent,) = judge_can(BUS, [DECK], [], 2.0, 500_000, {})
    assert silent.level == BAD
    assert "the bit rate, CAN_H and CAN_L, the termination (60 ohm between them)" in silent.text
    errors = replace(block(REST, n=3), flags=np.full(3, CanFlag.ERR, np.uint8))
    found = judged(DECK, block(REST), errors)
    assert said(found, BAD) == [
        "ports.can: 3 error frames: check the bit rate, the termination (60 ohm from CAN_H to CAN_L) and the ground"
    ]
    dropped = replace(block(REST), dropped=7)
    assert said(judged(DECK, dropped), BAD) == ["ports.can: the kernel dropped 7 frames: is this machine too busy?"]


def test_the_load_is_that_of_the_published_formula() -> None:
    """R. I. Davis et al. 2007: at most 135 bits for 8 bytes with an 11-bit identifier, 160 with a 29-bit one."""
    one = block(REST, n=1)
    assert judge._load([one], 1.0, 1000) == pytest.approx(13.5)
    assert judge._load([replace(one, flags=np.array([CanFlag.EXT], np.uint8))], 1.0, 1000) == pytest.approx(16.0)
    assert judge._load([replace(one, length=np.array([0], np.uint8))], 1.0, 1000) == pytest.approx(5.5)
    assert np.isnan(judge._load([one], 1.0, None))
    full = block(REST, n=400, hz=1000)
    assert said(judge_can(BUS, [DECK], can_raws(full), 0.4, 125_000, {}), BAD) == [
        "ports.can: 1000 frames/s, at most 108 % of what the bus can carry"
    ]


def test_a_real_bus_with_an_inertial_unit_in_a_car(shared_data: Path) -> None:
    folder = shared_data / "D1-canedge-imu-mf4"
    t, ids, data = [], [], []
    for line in (folder / "derived" / "00000005-60FEB5A8.candump.log").read_text().splitlines():
        stamp, _, frame = line.split()[:3]
        can_id, _, payload = frame.partition("#")
        t.append(int(stamp.strip("()").replace(".", "")) * 1000)
        ids.append(int(can_id, 16))
        data.append(bytes.fromhex(payload))
    n = len(t)
    frames = CanFrames(
        np.array(t) - t[0] + S,
        np.array(ids, np.uint32),
        np.zeros(n, np.uint8),
        np.array([len(d) for d in data], np.uint8),
        np.frombuffer(b"".join(d.ljust(8, b"\0") for d in data), np.uint8).reshape(n, 8).copy(),
    )
    text = (folder / "canmod-gps.dbc").read_text(encoding="cp1252")
    signals = ("gnss_imu.AccelerationX", "gnss_imu.AccelerationY", "gnss_imu.AccelerationZ")
    imu = AccelerometerSettings("imu", "can", dbc="canmod-gps.dbc", dbc_text=text, signals=signals)
    seconds = (t[-1] - t[0]) / S
    found = judge_can(BUS, [imu], can_raws(frames), seconds, 500_000, {(False, 9): "gnss_imu"})
    good = "\n".join(said(found, GOOD))
    assert "0x9 101" in good
    assert "(gnss_imu) -> imu" in good
    assert "4518 samples" in good
    assert said(found, BAD) == [  # it stands on end in that car
        "accelerometers.imu.rotation: gravity is not on z but at (9.6, 0.2, 0.5): the sensor's own +x points up, so "
        "the third row should be [1, 0, 0]"
    ]


def test_quality_names_are_those_of_the_configuration() -> None:
    assert {q.name.lower() for q in (Quality.FIXED, Quality.FLOAT, Quality.SINGLE)} == {"fixed", "float", "single"}
