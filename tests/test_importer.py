"""Logs of others become a raw recording: no byte lost, times as the logs say, named where they cannot be."""

from __future__ import annotations

import csv
import datetime
import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.dbc_codec import AccelCodec
from drivers.nmea_codec import NmeaCodec
from edge_agent import config
from edge_agent.importer import (
    DAY_NS,
    DEFAULT_LATENCY_NS,
    MONOTONIC_START_NS,
    ImportRefusedError,
    Log,
    can_pieces,
    import_logs,
    merged,
    nmea_pieces,
)
from edge_agent.messages import MS, CanFlag, CanFrames, GnssFix, Raw, S, Tick
from edge_agent.recording import reader, topics

T0 = 1_700_000_000 * S  # 2023-11-14 22:13:20 UTC
DATE = datetime.date(2023, 11, 14)


def sentence(body: str) -> bytes:
    x = 0
    for c in body.encode():
        x ^= c
    return f"${body}*{x:02X}\r\n".encode()


def gga(tod: str) -> bytes:
    return sentence(f"GNGGA,{tod},4730.0,N,00915.0,E,4,12,0.9,400.0,M,45.0,M,1.0,0001")


def rmc(tod: str, date: str, status: str = "A") -> bytes:
    return sentence(f"GNRMC,{tod},{status},4730.0,N,00915.0,E,0.0,0.0,{date},,,R")


def nmea(
    tmp_path: Path, data: bytes, date: datetime.date | None = None, latency_ns: int = 0
) -> list[tuple[int, bytes]]:
    path = tmp_path / "log.nmea"
    path.write_bytes(data)
    out = []
    for utc, _, _, payload in nmea_pieces(Log(path, "gnss"), 0, latency_ns, date):
        assert isinstance(payload, bytes)
        out.append((utc, payload))
    return out


def can(tmp_path: Path, text: str, interface: str | None = None) -> tuple[list[CanFrames], Log]:
    path = tmp_path / "can.log"
    path.write_text(text)
    log = Log(path, "can", interface)
    blocks = [p for _, _, _, p in can_pieces(log, 0, 100 * MS) if isinstance(p, CanFrames)]
    return blocks, log


# ---------------------------------------------------------------------------------------------------------------- NMEA


def test_lines_without_stamps_arrive_at_their_epoch_plus_latency(tmp_path: Path) -> None:
    gst = sentence("GNGST,221320.00,0.02,0.01,0.01,12.6,0.01,0.01,0.02")
    vtg = sentence("GNVTG,0.0,T,,M,0.0,N,0.0,K,R")
    data = gga("221320.00") + gst + vtg + gga("221320.10")
    assert nmea(tmp_path, data, DATE, 200 * MS) == [
        (T0 + 200 * MS, gga("221320.00") + gst + vtg),
        (T0 + 300 * MS, gga("221320.10")),
    ]


def test_lines_with_stamps_arrive_when_they_say(tmp_path: Path) -> None:
    data = b"(1700000000.123456) " + gga("221320.00") + b"(1700000000.5) " + gga("221320.20") + gga("221321.00")
    assert nmea(tmp_path, data, None, 100 * MS) == [
        (T0 + 123_456_000, gga("221320.00")),
        (T0 + 500 * MS, gga("221320.20")),
        (T0 + S + 100 * MS, gga("221321.00")),  # without a stamp: epoch plus latency, on the day of the stamps
    ]


def test_the_date_comes_from_the_first_sentence_that_has_one(tmp_path: Path) -> None:
    """GIVEN epochs before the first RMC, on both sides of midnight THEN they are dated back from it."""
    before, after = gga("235959.50"), gga("000000.50")
    dated = rmc("000001.50", "151123")
    midnight = (DATE.toordinal() - 719_163 + 1) * DAY_NS
    assert [t for t, _ in nmea(tmp_path, before + after + dated)] == [
        midnight - 500 * MS,
        midnight + 500 * MS,
        midnight + 1500 * MS,
    ]


def test_midnight_is_crossed_without_a_date(tmp_path: Path) -> None:
    times = [t for t, _ in nmea(tmp_path, b"".join(gga(f"{h}5959.00") for h in (21, 22, 23)) + gga("000000.00"), DATE)]
    assert np.diff(times).tolist() == [3600 * S, 3600 * S, S]


@pytest.mark.parametrize(
    "undated",
    [
        rmc("221321.00", "151123", "V"),  # a receiver without a fix may say any date
        rmc("221321.00", "991399"),
        rmc("221321.00", "151123")[:-4] + b"00\r\n",  # bad checksum
    ],
)
def test_a_log_without_a_date_is_refused(tmp_path: Path, undated: bytes) -> None:
    with pytest.raises(ImportRefusedError, match="no RMC or ZDA carries a date; give it with --date"):
        nmea(tmp_path, gga("221320.00") + undated)
    assert nmea(tmp_path, gga("221320.00") + undated, DATE)[0][0] == T0


def test_zda_carries_a_date(tmp_path: Path) -> None:
    assert nmea(tmp_path, sentence("GPZDA,221320.00,14,11,2023,00,00"))[0][0] == T0


def test_binary_travels_with_the_line_that_it_precedes(tmp_path: Path) -> None:
    ubx = b"\xb5\x62\x01\x07\n\x00\x01\n"
    data = ubx + gga("221320.00") + ubx + gga("221321.00") + ubx
    assert [p for _, p in nmea(tmp_path, data, DATE)] == [ubx + gga("221320.00"), ubx + gga("221321.00") + ubx]


def test_binary_that_runs_into_a_sentence_hides_no_time(tmp_path: Path) -> None:
    data = b"\xd3\x00\x04$GN" + gga("221320.00")
    assert nmea(tmp_path, data, DATE) == [(T0, data)]


def test_time_that_steps_back_is_carried_on_and_named(tmp_path: Path) -> None:
    path = tmp_path / "log.nmea"
    data = gga("221320.00") + gga("221319.90") + gga("221310.00") + gga("221311.00")
    path.write_bytes(data)
    log = Log(path, "gnss")
    pieces = list(nmea_pieces(log, 0, 0, DATE))
    assert [p[0] - T0 for p in pieces] == [0, S]
    assert b"".join(p[3] for p in pieces if isinstance(p[3], bytes)) == data
    assert log.notes == ["log.nmea:3: time steps back by 10.000 s; carried on without a step"]


def test_a_log_without_any_time_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImportRefusedError, match="no sentence carries a time"):
        nmea(tmp_path, sentence("GNVTG,0.0,T,,M,0.0,N,0.0,K,R"), DATE)
    assert nmea(tmp_path, b"", DATE) == []


PIECES = st.sampled_from(
    [
        gga("221320.00"),
        gga("221321.00"),
        gga("000001.00"),
        rmc("221322.00", "141123"),
        b"$GNGGA,2",
        b"\n",
        b"\xb5b\x01$",
    ]
) | st.binary(max_size=12)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(parts=st.lists(PIECES, max_size=12))
def test_no_byte_is_lost_and_time_never_goes_back(tmp_path_factory: pytest.TempPathFactory, parts: list[bytes]) -> None:
    data = gga("221319.00") + b"".join(parts)
    pieces = nmea(tmp_path_factory.mktemp("any"), data, DATE)
    assert b"".join(p for _, p in pieces) == data
    times = [t for t, _ in pieces]
    assert times == sorted(set(times))


# ----------------------------------------------------------------------------------------------------------------- CAN


def test_every_kind_of_frame(tmp_path: Path) -> None:
    blocks, log = can(
        tmp_path,
        "(1700000000.000001) can0 123#\n"
        "(1700000000.000002) can0 18FF34A0#0102030405060708\n"
        "(1700000000.000003) can0 7FF#R\n"
        "(1700000000.000004) can0 7FF#R8\n"
        "(1700000000.000005) can0 20000004#0001000000000000\n"
        "(1700000000.000006) can0 1AB##3" + "A5" * 64 + "\n"
        "(1700000000.000007) can0 1ABCDEF0##0FF\n"
        "(1700000000.123456789) can1 001#11_F T\n"
        "\n",
    )
    assert [len(b.t_ns) for b in blocks] == [7, 1]
    b = blocks[0]
    assert b.can_id.tolist() == [0x123, 0x18FF34A0, 0x7FF, 0x7FF, 0x4, 0x1AB, 0x1ABCDEF0]
    fd = CanFlag.FD
    assert b.flags.tolist() == [
        0,
        CanFlag.EXT,
        CanFlag.RTR,
        CanFlag.RTR,
        CanFlag.ERR,
        fd | CanFlag.BRS | CanFlag.ESI,
        fd | CanFlag.EXT,
    ]
    assert b.length.tolist() == [0, 8, 0, 8, 8, 64, 1]
    assert b.data.shape == (7, 64)
    assert b.data[1, :8].tobytes() == bytes(range(1, 9))
    assert b.data[5].tobytes() == b"\xa5" * 64
    assert blocks[1].data.shape == (1, 8)
    assert blocks[1].t_ns.tolist() == [T0 + 123_456_789]
    assert (log.items, log.lost) == (8, 0)


def test_blocks_close_after_their_length(tmp_path: Path) -> None:
    times = [0, 40, 99, 100, 150, 199, 200, 500]
    blocks, _ = can(tmp_path, "".join(f"({1_700_000_000 + t / 1000:.6f}) can0 001#\n" for t in times))
    assert [len(b.t_ns) for b in blocks] == [3, 3, 1, 1]


def test_what_is_no_frame_is_counted_and_named(tmp_path: Path) -> None:
    bad = [
        "no frame",
        "(1.0) can0 12#00",
        "(1.0) can0 123#0",
        "(1.0) can0 123#000102030405060708",
        "(1) can0 123#",
        "; x",
    ]
    blocks, log = can(tmp_path, "\n".join(["(1700000000.0) can0 123#00", *bad, "(1700000000.1) can0 123#00"]))
    assert sum(len(b.t_ns) for b in blocks) == 2
    assert log.lost == len(bad)
    assert log.notes[0] == "can.log:2: is no candump frame: 'no frame'"
    assert len(log.notes) == len(bad)


def test_one_interface_of_a_log(tmp_path: Path) -> None:
    text = "(1700000000.0) can0 001#\n(1700000000.0) can1 002#\n(1700000000.0) can0 003#\n"
    blocks, log = can(tmp_path, text, "can0")
    assert blocks[0].can_id.tolist() == [1, 3]
    assert (log.items, log.other, log.lost) == (2, 1, 0)


# --------------------------------------------------------------------------------------------------------------- merge


def test_sources_and_ticks_are_merged_in_the_order_of_time() -> None:
    def frames(*t_ns: int) -> CanFrames:
        n = len(t_ns)
        return CanFrames(
            np.array(t_ns),
            np.zeros(n, np.uint32),
            np.zeros(n, np.uint8),
            np.zeros(n, np.uint8),
            np.zeros((n, 8), np.uint8),
        )

    a = [(T0 + 50 * MS, 0, "gnss", b"a"), (T0 + 2 * S, 0, "gnss", b"b")]
    b = [(T0 + 100 * MS, 1, "can", frames(T0, T0 + 100 * MS)), (T0 + 2 * S, 1, "can", frames(T0 + 2 * S))]
    out = list(merged([a, b]))
    assert [(r.source, r.t_ns - MONOTONIC_START_NS, utc - T0) for r, utc in out] == [
        ("clock", 0, 0),
        ("gnss", 50 * MS, 50 * MS),
        ("can", 100 * MS, 100 * MS),
        ("clock", S, S),
        ("clock", 2 * S, 2 * S),
        ("gnss", 2 * S, 2 * S),
        ("can", 2 * S, 2 * S),
    ]
    assert [r.order for r, _ in out] == list(range(7))
    assert out[0][0].payload == Tick(T0, True, 0)
    block = out[2][0].payload
    assert isinstance(block, CanFrames)
    assert (block.t_ns - MONOTONIC_START_NS).tolist() == [0, 100 * MS]


def test_a_pause_of_days_is_not_filled_with_ticks() -> None:
    out = list(merged([[(T0, 0, "gnss", b"a"), (T0 + 30 * DAY_NS + 1, 0, "gnss", b"b")]]))
    ticks = [utc - T0 for r, utc in out if isinstance(r.payload, Tick)]
    assert ticks == [0, 30 * DAY_NS]


# --------------------------------------------------------------------------------------------------------------- files

SITE = """
site: s
data_dir: rec
ports: {gps: {kind: serial, device: /dev/x}, bus: {kind: can, block_ms: 50}}
receivers: {r: {port: gps, latency_ms: 250}}
accelerometers:
  a:
    port: bus
    fields: {x: {id: 1, start: 0, length: 16}, y: {id: 1, start: 16, length: 16}, z: {id: 1, start: 32, length: 16}}
points: {p: {receiver: r, accelerometer: a}}
"""


def raws(path: Path) -> list[Raw]:
    return [topics.decode_raw(m.topic, m.schema, m.data) for m in reader.read_messages(path)]


def test_a_recording_holds_configuration_and_data(tmp_path: Path) -> None:
    (tmp_path / "a.nmea").write_bytes(gga("221320.00") + gga("221321.00"))
    (tmp_path / "a.log").write_text("".join(f"({1_700_000_000 + i * 0.01:.6f}) can0 001#00\n" for i in range(20)))
    (tmp_path / "x.dbc").write_text('VERSION ""\n')
    site = config.parse(SITE, tmp_path)
    done = import_logs(
        tmp_path / "out.mcap",
        nmea=[("gps", tmp_path / "a.nmea")],
        can=[("bus", tmp_path / "a.log", None)],
        config=site,
        dbc=[tmp_path / "x.dbc"],
        date=DATE,
    )
    assert done.path == str(tmp_path / "out.mcap")
    assert {p.name for p in tmp_path.iterdir()} == {"a.nmea", "a.log", "x.dbc", "out.mcap"}
    stored = raws(tmp_path / "out.mcap")
    assert len(stored) == done.raws
    assert [len(r.payload.t_ns) for r in stored if isinstance(r.payload, CanFrames)] == [5, 5, 5, 5]
    fixes = [r for r in stored if r.source == "gps"]
    assert [r.t_ns - MONOTONIC_START_NS for r in fixes] == [250 * MS, 1250 * MS]
    attached = {a.name: a.data for a in reader.read_attachments(tmp_path / "out.mcap")}
    assert attached == {"config.yaml": SITE.encode(), "x.dbc": b'VERSION ""\n'}
    assert [m.log_ns for m in reader.read_messages(tmp_path / "out.mcap", {"/raw/gps"})] == [
        T0 + 250 * MS,
        T0 + 1250 * MS,
    ]


@pytest.mark.parametrize(
    ("kwargs", "said"),
    [
        ({"nmea": [("bus", "a.nmea")]}, r"the configuration has no serial port 'bus'; there are: gps"),
        ({"nmea": [("gps", "none.nmea")]}, r"no such file"),
        ({"nmea": [("gps", "empty")]}, r"the logs hold nothing to import"),
        ({"nmea": [("gps", "a.nmea")], "output": "a.nmea"}, r"is there already"),
        ({"nmea": [("p", "a.nmea")], "can": [("p", "a.nmea", None)], "config": None}, r"cannot hold both NMEA and CAN"),
    ],
)
def test_an_import_that_cannot_be_made_leaves_nothing(tmp_path: Path, kwargs: dict[str, object], said: str) -> None:
    (tmp_path / "a.nmea").write_bytes(gga("221320.00"))
    (tmp_path / "empty").write_bytes(b"")
    args: dict[str, object] = {"config": config.parse(SITE, tmp_path), **kwargs}
    for kind in ("nmea", "can"):
        args[kind] = [(port, tmp_path / name, *rest) for port, name, *rest in args.get(kind, [])]  # type: ignore[attr-defined]
    output = tmp_path / str(args.pop("output", "out.mcap"))
    with pytest.raises(ImportRefusedError, match=said):
        import_logs(output, date=DATE, **args)  # type: ignore[arg-type]
    assert {p.name for p in tmp_path.iterdir()} == {"a.nmea", "empty"}


# ------------------------------------------------------------------------------------------------------ real recordings


def test_real_candump_gives_the_accelerations_of_its_csv(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "D1-canedge-imu-mf4"
    log = folder / "derived" / "00000005-60FEB5A8.candump.log"
    site = config.parse(
        "site: d1\ndata_dir: rec\nports: {can: {kind: can}}\naccelerometers:\n  imu: {port: can, dbc: canmod-gps.dbc, "
        "signals: [gnss_imu.AccelerationX, gnss_imu.AccelerationY, gnss_imu.AccelerationZ]}\n",
        folder,
    )
    done = import_logs(tmp_path / "d1.mcap", can=[("can", log, "can1")], config=site)
    codec = AccelCodec(site.accelerometers["imu"])
    blocks = [codec.feed(r.payload)[0] for r in raws(tmp_path / "d1.mcap") if isinstance(r.payload, CanFrames)]
    xyz = np.concatenate([b.xyz for b in blocks if b is not None])
    t_ns = np.concatenate([b.t_ns for b in blocks if b is not None])
    with (folder / "derived" / "00000005-60FEB5A8.gnss_imu.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert len(rows) == len(xyz) == 4518
    assert done.lost == 0
    wanted = np.array([[float(r[f"Acceleration{a}"]) for a in "XYZ"] for r in rows])
    assert np.array_equal(xyz, wanted)
    stamps = [round(float(r["t_unix"]) * 1e6) * 1000 for r in rows]
    assert (t_ns - MONOTONIC_START_NS + done.first_utc_ns).tolist() == stamps


def test_real_thirteen_hours_cross_midnight_without_a_jump(shared_data: Path, tmp_path: Path) -> None:
    packed = shared_data / "A3-rtklib-static-13h-nmea" / "test_nmea_27_05_clean.txt.gz"
    lines = [b"$GPGGA," + line for line in gzip.decompress(packed.read_bytes()).splitlines(keepends=True)]
    (tmp_path / "a3.nmea").write_bytes(b"".join(lines))
    date = datetime.date(2015, 5, 27)
    done = import_logs(tmp_path / "a3.mcap", nmea=[("gnss", tmp_path / "a3.nmea")], date=date)
    stored = [r for r in raws(tmp_path / "a3.mcap") if isinstance(r.payload, bytes)]
    assert b"".join(r.payload for r in stored if isinstance(r.payload, bytes)) == b"".join(lines)
    tod = np.array([int(li[7:9]) * 3600 + int(li[9:11]) * 60 + int(li[11:13]) for li in lines])
    days = np.concatenate([[0], np.cumsum(np.diff(tod) < 0)])
    assert days[-1] == 1
    midnight = (date.toordinal() - 719_163) * DAY_NS
    wanted = midnight + (tod + 86_400 * days) * S + DEFAULT_LATENCY_NS
    arrivals = np.array([r.t_ns for r in stored]) - MONOTONIC_START_NS + done.first_utc_ns
    assert np.array_equal(arrivals, wanted)
    codec = NmeaCodec()
    fixes = [
        fix.utc_ns
        for r in stored
        if isinstance(r.payload, bytes)
        for fix in codec.feed(r.t_ns, r.payload, r.t_ns - MONOTONIC_START_NS + done.first_utc_ns)
        if isinstance(fix, GnssFix)
    ]
    assert fixes == (wanted - DEFAULT_LATENCY_NS).tolist()[: len(fixes)]
    assert len(fixes) >= len(lines) - 1  # the last epoch may still be open


@pytest.mark.parametrize(
    "name",
    [
        "A1-dresden-10hz-gga-gst/Messg_4.log",
        "A2-ublox-m8p-ubx-nmea-static/rover-20181004-1237.ubx.gz",
        "A5-budapest-nmea/nmea2.txt",
        "A8-mixed-and-damaged-streams/pygpsdata-MIXED2.log",
        "A8-mixed-and-damaged-streams/2023-4-17_82912_serial-COM3.ubx",
        "A4-gpsd-regression-logs/skytraq-PX1172RH_DS.log",
    ],
)
def test_real_captures_lose_no_byte(shared_data: Path, tmp_path: Path, name: str) -> None:
    data = (shared_data / name).read_bytes()
    data = gzip.decompress(data) if name.endswith(".gz") else data
    pieces = nmea(tmp_path, data, DATE)
    assert b"".join(p for _, p in pieces) == data
    times = [t for t, _ in pieces]
    assert times == sorted(set(times))
    assert times
