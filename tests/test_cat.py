"""Recordings as text: units, words, samples, times."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
from pathlib import Path

import numpy as np
import pytest

from edge_agent import cat
from edge_agent.messages import (
    MS,
    AccelBlock,
    AccelFlag,
    CanFlag,
    CanFrames,
    Estimate,
    FusionFlag,
    GnssFix,
    Innovation,
    Mode,
    Quality,
    Raw,
    Record,
    S,
    Tick,
    Verdict,
)
from edge_agent.recording import topics
from edge_agent.recording.writer import SegmentWriter

T0 = 1_700_000_000 * S
ISO0 = "2023-11-14T22:13:20.000000000Z"


def segment(path: Path, records: list[Record], **metadata: str) -> Path:
    writer = SegmentWriter(
        path.with_name(path.name + ".part"),
        metadata={"site": "s", **metadata},
        attachments={"config.yaml": b"site: s\n"},
    )
    for record in records:
        writer.add(record)
    return writer.close()


def estimate(t_ns: list[int], mode: list[int], flags: list[int]) -> Estimate:
    n = len(t_ns)
    table = np.arange(3.0 * n).reshape(n, 3) / 8  # exact in any rounding of the format
    three = np.array([0.1, 0.2, 0.3])
    return Estimate(
        "mid",
        np.array(t_ns),
        table,
        table + 1,
        table + 2,
        table + 3,
        np.array(mode, np.uint8),
        np.array(flags, np.uint8),
        three,
        three,
        three,
        three,
    )


FIX = GnssFix(
    *(1000, 1200, T0, True, 47.5, 9.25, 445.123, 45.0, Quality.FLOAT, 12, 0.9, math.nan, 1.5, 1.0, "0001"),
    *((0.01, 0.02, math.nan), (1e-4, 1e-4, 1e-3), ("GGA", "GST")),
)
INNOVATION = Innovation(
    "mid", 1000, np.array([0.1, 0.2, 0.3]), np.eye(3), 1.25, Verdict.REJECTED, 200 * MS, np.ones(3), np.zeros(3)
)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    frames = CanFrames(
        np.array([900, 1000]),
        np.array([0x188, 0x18FF34A0], np.uint32),
        np.array([CanFlag.DRAIN, CanFlag.EXT | CanFlag.FD], np.uint8),
        np.array([2, 3], np.uint8),
        np.array([[1, 255, *[0] * 62], [1, 2, 3, *[0] * 61]], np.uint8),
        dropped=7,
    )
    accel = AccelBlock(
        "deck",
        np.array([1000, 1000 + 10 * MS]),
        np.array([[0.1, 0.2, 9.8], [0.1, math.nan, 9.8]]),
        np.array([0, AccelFlag.SATURATED | AccelFlag.FITTED], np.uint8),
        np.array([5, 6]),
    )
    records = [
        topics.raw_record(Raw(1000, 0, "clock", Tick(T0, True, 0)), T0),
        topics.raw_record(Raw(1000, 1, "gps", b"$GN\\\xb5\r\n"), T0),
        topics.raw_record(Raw(1000, 2, "can", frames), T0),
        Record("/accel/deck/block", T0 + S, T0, topics.accel_block(accel, T0), True),
        Record("/gnss/r/solution", T0 + S, T0, topics.gnss_solution(FIX, T0, (1.0, 2.0, 3.0), 200, "map"), True),
        Record("/gnss/r/fix", T0 + S, T0, topics.navsatfix(FIX, T0, "r"), True),
        Record("/fusion/mid/update", T0 + S, T0, topics.fusion_update(INNOVATION, T0), True),
    ]
    for i in range(2):
        e = estimate(
            [1000 + i * S, 1000 + i * S + S // 2],
            [Mode.FUSED, Mode.COAST],
            [0, FusionFlag.FLOAT | FusionFlag.DEGRADED],
        )
        t = T0 + i * S
        records.append(Record("/fusion/mid/block", t + S, t, topics.fused_block(e, t), True))
    event = topics.event("JUMP", "mid", 'o = "3 cm", kept', [("o_m", 0.03), ("n", 4.0)], 1000, T0, T0 - S, T0)
    records.append(Record("/events", T0 + 2 * S, T0, event, True))
    status = topics.diagnostics(
        [topics.Status(0, "inbox", "ok", {"bytes": "12"}), topics.Status(1, "disk", "low", {"free": "1", "of": "9"})],
        T0,
    )
    records.append(Record("/diagnostics", T0 + 2 * S, T0, status, False))
    return segment(tmp_path / "a.mcap", records)


def table(
    path: Path | list[Path], topic: str, begin: int | None = None, end: int | None = None
) -> list[dict[str, str]]:
    out = io.StringIO()
    cat.write_csv(out, cat.rows([path] if isinstance(path, Path) else path, [topic], begin, end))
    return list(csv.DictReader(io.StringIO(out.getvalue())))


def test_blocks_are_unrolled_to_samples_with_units(recording: Path) -> None:
    rows = table(recording, "/fusion/mid/block")
    assert [r["time [UTC]"] for r in rows] == [
        ISO0,
        "2023-11-14T22:13:20.500000000Z",
        "2023-11-14T22:13:21.000000000Z",
        "2023-11-14T22:13:21.500000000Z",
    ]
    assert [r["log_time [UTC]"][17:22] for r in rows] == ["21.00", "21.00", "22.00", "22.00"]
    assert [r["monotonic [ns]"] for r in rows[:2]] == ["1000", "500001000"]
    second = rows[1]
    assert [second[f"displacement_{a} [m]"] for a in "xyz"] == ["0.375", "0.5", "0.625"]
    assert [second[f"velocity_{a} [m/s]"] for a in "xyz"] == ["1.375", "1.5", "1.625"]
    assert [second[f"std_displacement_{a} [m]"] for a in "xyz"] == ["2.375", "2.5", "2.625"]
    assert [second[f"bias_{a} [m/s2]"] for a in "xyz"] == ["0.1", "0.2", "0.3"]
    assert (second["mode"], second["flags"], second["revision"]) == ("COAST", "FLOAT|DEGRADED", "LIVE")
    assert (rows[0]["mode"], rows[0]["flags"]) == ("FUSED", "")


def test_accelerations(recording: Path) -> None:
    a, b = table(recording, "/accel/deck/block")
    assert (a["x [m/s2]"], a["z [m/s2]"], a["seq"], a["flags"]) == ("0.1", "9.8", "5", "")
    assert (b["y [m/s2]"], b["flags"], b["time [UTC]"][20:23]) == ("", "SATURATED|FITTED", "010")


def test_can_frames_one_a_row(recording: Path) -> None:
    a, b = table(recording, "/raw/can")
    assert (a["id"], a["flags"], a["length [bytes]"], a["data"], a["dropped"]) == ("188", "DRAIN", "2", "01FF", "7")
    assert (b["id"], b["flags"], b["data"], b["dropped"]) == ("18FF34A0", "EXT|FD", "010203", "0")
    assert (a["time [UTC]"], b["time [UTC]"]) == ("2023-11-14T22:13:19.999999900Z", ISO0)


def test_bytes_solution_update_event_and_diagnostics(recording: Path) -> None:
    (raw,) = table(recording, "/raw/gps")
    assert raw["data"] == "$GN\\\\\\xb5\\r\\n"
    (solution,) = table(recording, "/gnss/r/solution")
    assert (solution["fix"], solution["latitude [deg]"], solution["height [m]"]) == ("FLOAT", "47.5", "445.123")
    assert (solution["std_enu_x [m]"], solution["std_enu_z [m]"], solution["age [s]"]) == ("0.01", "", "1.0")
    (fix,) = table(recording, "/gnss/r/fix")
    assert (fix["altitude [m]"], fix["position_covariance_0 [m2]"]) == ("445.123", "0.0")
    (update,) = table(recording, "/fusion/mid/update")
    assert (update["residual_y [m]"], update["ratio"], update["verdict"]) == ("0.2", "1.25", "REJECTED")
    (event,) = table(recording, "/events")
    assert (event["kind"], event["text"], event["values"]) == ("JUMP", 'o = "3 cm", kept', "o_m=0.03;n=4.0")
    assert (event["begin"], event["end"]) == ("2023-11-14T22:13:19.000000000Z", ISO0)
    inbox, disk = table(recording, "/diagnostics")
    assert (inbox["level"], disk["level"], disk["name"], disk["values"]) == ("OK", "WARN", "disk", "free=1;of=9")


def test_a_range_of_time_and_several_files(recording: Path, tmp_path: Path) -> None:
    later = segment(
        tmp_path / "b.mcap",
        [
            Record(
                "/fusion/mid/block",
                T0 + 9 * S,
                T0 + 9 * S,
                topics.fused_block(estimate([5], [1], [0]), T0 + 9 * S),
                True,
            )
        ],
    )
    both = [recording, later]
    assert len(table(both, "/fusion/mid/block")) == 5
    assert len(table(both, "/fusion/mid/block", T0 + S // 2, T0 + 9 * S)) == 3
    assert [r["time [UTC]"][17:19] for r in table(both, "/fusion/mid/block", T0 + S)] == ["21", "21", "29"]


def test_json_lines_hold_every_topic(recording: Path) -> None:
    out = io.StringIO()
    n = cat.write_jsonl(out, cat.rows([recording]))
    lines = [json.loads(line, parse_constant=pytest.fail) for line in out.getvalue().splitlines()]
    assert n == len(lines) == 1 + 1 + 2 + 2 + 1 + 1 + 1 + 4 + 1 + 2
    accel = [line for line in lines if line["topic"] == "/accel/deck/block"]
    assert [a["y [m/s2]"] for a in accel] == [0.2, None]
    assert next(line for line in lines if line["topic"] == "/events")["values"] == {"o_m": 0.03, "n": 4.0}


@pytest.mark.parametrize(
    ("text", "t_ns"),
    [
        ("2023-11-14T22:13:20", T0),
        ("2023-11-14T22:13:20.25Z", T0 + S // 4),
        ("2023-11-14T23:13:20+01:00", T0),
        ("1700000000", T0),
        ("1700000000.000000001", T0 + 1),
        ("2023-11-14", T0 - T0 % (86_400 * S)),
    ],
)
def test_times(text: str, t_ns: int) -> None:
    assert cat.parse_time(text) == t_ns


@pytest.mark.parametrize("text", ["", "yesterday", "12", "1.2.3"])
def test_what_is_no_time(text: str) -> None:
    with pytest.raises(ValueError, match="is no time"):
        cat.parse_time(text)


def test_iso_inverts() -> None:
    for t in (T0, T0 + 123_456_789, 1):
        assert cat.iso(t).endswith(f"{t % S:09d}Z")
    assert cat.parse_time(cat.iso(T0 + 123_456_000)) == T0 + 123_456_000


def test_info(recording: Path, tmp_path: Path) -> None:
    (good,), wanting = cat.describe([recording])
    assert not wanting
    assert (good["complete"], good["messages"], good["damage"], good["missing_blocks"]) == (True, 11, "", [])
    assert good["topics"]["/fusion/mid/block"]["rate_hz"] == 1.0
    assert good["attachments"] == {"config.yaml": 8}
    json.dumps(good, allow_nan=False)
    text = cat.describe_text([good])
    assert "11 messages, complete" in text
    assert "edge_agent:run: site=s" in text
    torn = tmp_path / "torn.mcap.part"
    torn.write_bytes(recording.read_bytes()[:-200])
    (bad,), wanting = cat.describe([torn])
    assert not wanting  # one that is being written looks the same: read as far as it goes
    assert not bad["complete"]
    assert "no index: being written or torn" in cat.describe_text([bad])
    cut = torn.rename(tmp_path / "cut.mcap")
    assert cat.describe([cut])[1]
    gap = segment(
        tmp_path / "gap.mcap",
        [topics.raw_record(Raw(1000, order, "gps", b"x"), T0 + order * S) for order in (0, 1, 5)],
    )
    (missing,), wanting = cat.describe([gap])
    assert wanting
    assert missing["missing_blocks"] == [{"after_order": 1, "before_order": 5, "utc": "2023-11-14T22:13:25.000000000Z"}]
    assert "3 raw block(s) missing after number 1" in cat.describe_text([missing])


def test_continuity_of_segments(recording: Path, tmp_path: Path) -> None:
    sha256 = hashlib.sha256(recording.read_bytes()).hexdigest()
    tick = [topics.raw_record(Raw(1000, 0, "clock", Tick(T0, True, 0)), T0)]
    chain = [
        recording,
        segment(tmp_path / "b.mcap", tick, previous_name="a.mcap", previous_sha256=sha256),
        segment(tmp_path / "c.mcap", tick, previous_name="a.mcap", previous_sha256="0" * 64),
        segment(tmp_path / "d.mcap", tick, previous_name="gone.mcap", previous_sha256=sha256),
        segment(tmp_path / "e.mcap", tick, previous_name="../a.mcap", previous_sha256=sha256),
    ]
    said = [f["continuity"] for f in cat.describe(chain)[0]]
    assert said == [
        "names no file before it",
        "follows a.mcap",
        "changed: a.mcap is not as it was when this file began",
        "follows gone.mcap, which is not here",
        "follows ../a.mcap, which is not here",
    ]
    assert [cat.describe([path])[1] for path in chain] == [False, False, True, False, False]


def test_foreign_recordings_read_too(shared_data: Path) -> None:
    path = shared_data / "E1-mcap-rosbag2" / "talker.mcap"
    (info,), wanting = cat.describe([path])
    assert not wanting
    assert info["topics"]["/rosout"]["messages"] == 10
    rows = table(path, "/topic")
    assert len(rows) == 10
    assert rows[0]["data"].startswith("Hello, world!")
