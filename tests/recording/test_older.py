"""Recordings of another version: decoded by the message text inside their own file."""

from __future__ import annotations

import itertools
import math
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from all_topics import records

from edge_agent import cat
from edge_agent.messages import Estimate, Record
from edge_agent.recording import older, reader, topics, writer
from edge_agent.recording.older import OtherVersionWarning
from edge_agent.recording.reader import DamagedError
from edge_agent.recording.schemas import SCHEMAS

SOLUTION, BLOCK, RAW = topics.GNSS_SOLUTION, topics.FUSED_BLOCK, topics.RAW_BYTES
NOW = list(records(blocks=2, sensors=1))


def text_without(name: str, *fields: str, add: str = "") -> str:
    """A schema's text as an older version could have had it; `add` in front of its last field but one."""
    own, rule, rest = SCHEMAS[name].partition("=" * 80)
    lines = [line for line in own.splitlines() if not any(f" {f}" in line.split("#")[0] + " " for f in fields)]
    if add:
        lines.insert(2, add)
    return "\n".join(lines) + "\n" + rule + rest


def write(folder: Path, changed: dict[str, str], some: list[Record], monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file whose schemas are those of another version."""
    with monkeypatch.context() as patch:
        patch.setattr(writer, "SCHEMAS", {**SCHEMAS, **changed})
        w = writer.SegmentWriter(folder / "a.mcap.part", metadata={"run": "r"}, attachments={})
        for r in some:
            w.add(r)
        return w.close()


def aligned(parts: list[tuple[str, Any]]) -> bytes:
    """CDR by struct, with the rules written here once more."""
    out = bytearray()
    for code, value in parts:
        if code == "s":
            raw = value.encode() + b"\0"
            out += bytes(-len(out) % 4) + struct.pack("<I", len(raw)) + raw
            continue
        size = struct.calcsize(code)
        out += bytes(-len(out) % size) + struct.pack("<" + code, value)
    return b"\0\1\0\0" + bytes(out)


OLD_TEXT = """# as an older version had it
std_msgs/Header header
int64 monotonic_ns
uint16 satellites
uint8 OTHER=49
uint8 fix
string note
float64 latitude_deg
float32[2] pair
"""
HEADER = "=" * 80 + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
HEADER += "=" * 80 + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"


def test_a_solution_of_another_layout_is_read_by_its_own_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not by today's, which showed one field's bytes as another's."""
    data = aligned(
        [("i", 7), ("I", 8), ("s", "a"), ("q", 123), ("H", 17), ("B", 4), ("s", "n"), ("d", 43.5), ("f", 1.0), ("f", 2)]
    )
    old = {SOLUTION: OLD_TEXT + HEADER}
    path = write(tmp_path, old, [Record("/gnss/a/solution", 5, 4, data, True)], monkeypatch)
    with pytest.warns(OtherVersionWarning) as told:
        (stored,) = reader.read_messages(path)
    assert len(told) == 1
    said = str(told[0].message)
    assert said.startswith(f"recorded by another version: {SOLUTION} lacks ")
    assert "it has what is not known here: note, " in said
    message = topics.decode(stored.schema, stored.data)
    assert (message["header"]["stamp"], message["header"]["frame_id"]) == ({"sec": 7, "nanosec": 8}, "a")
    assert (message["monotonic_ns"], message["satellites"], message["fix"]) == (123, 17, 4)
    assert message["station"] == ""
    assert (message["date_known"], message["latency_ns"]) == (False, 0)
    floats = [v for k, v in message.items() if isinstance(v, float)]
    assert floats
    assert all(math.isnan(v) for v in floats if v != 43.5)
    (row,) = (row for _, row in cat.rows([path]))
    assert next(v for k, v in row.items() if k.startswith("satellites")) == 17
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it has been told
        assert [s.data for s in reader.read_between(path, 0, 9)] == [stored.data]


def test_a_block_without_a_column_gets_one_of_unknown_values(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n = 5
    zero = np.zeros((n, 3))
    estimate = Estimate(
        "p", np.arange(n, dtype=np.int64), zero + 1.0, zero, zero, zero, np.ones(n, np.uint8), np.zeros(n, np.uint8),
        np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3), 0,
    )  # fmt: skip
    whole = topics.fused_block(estimate, 1000)
    text = text_without(BLOCK, "flags", "velocity_z_mps")
    assert "velocity_z_mps" not in text.replace("std_velocity_z_mps", "")
    text = text.replace("float32[] std_velocity_x_mps", "float32[] std_velocity_x_mps\nfloat32[] std_velocity_z_mps_")
    fields = topics.decode(BLOCK, whole)
    names = ["displacement_x_m", "displacement_y_m", "displacement_z_m", "velocity_x_mps", "velocity_y_mps"]
    parts: list[tuple[str, Any]] = [("i", 0), ("I", 1000), ("s", "structure"), ("q", 0), *[("f", 0.0)] * 12, ("B", 0)]
    kept = [line.split()[1] for line in text.partition("=" * 80)[0].splitlines() if line.startswith(("float32[]",))]
    kept += ["mode"]
    for name in kept:
        values = fields.get(name, np.zeros(n, np.float32))
        parts += [("I", n), *(("B" if name == "mode" else "f", v) for v in values.tolist())]
    parts += [("I", n), *(("q", i) for i in range(n))]
    path = write(tmp_path, {BLOCK: text}, [Record("/fusion/p/block", 5, 4, aligned(parts), True)], monkeypatch)
    with pytest.warns(OtherVersionWarning, match="lacks velocity_z_mps, flags; it has"):
        (stored,) = reader.read_messages(path)
    back = topics.decode_fused_block("p", stored.data)
    assert names[0] in kept
    assert (back.displacement_m == 1.0).all()
    assert np.isnan(back.velocity_mps[:, 2]).all()
    assert (back.velocity_mps[:, :2] == 0).all()
    assert (back.flags.tolist(), back.mode.tolist()) == ([0] * n, [1] * n)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (rows,) = reader.read_rows(path)
    assert rows.data[rows.begin[0] : rows.end[0]] == stored.data


def test_what_every_topic_says_survives_a_change_of_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The old text here is today's with one more field in front of it; the old bytes are today's with its bytes."""
    for schema, group in itertools.groupby(sorted(NOW, key=_schema), key=_schema):
        record = next(group)
        text = "int64 extra\n" + SCHEMAS[schema]
        data = record.data[:4] + bytes(8) + record.data[4:]  # alignment is as it was
        older.converter.cache_clear()
        with pytest.warns(OtherVersionWarning, match="not known here: extra"):
            convert = older.converter(schema, text.encode())
        assert convert is not None
        assert convert(data) == record.data, schema
        with pytest.raises(ValueError, match=r"ends inside|CDR|elements"):
            convert(data[: len(data) // 2])


def _schema(record: Record) -> str:
    return record.schema or topics.schema_of(record.topic)


def test_a_text_with_other_constants_or_comments_costs_nothing() -> None:
    text = SCHEMAS[SOLUTION].replace("uint8 FLOAT=5", "uint8 FLOAT=5\nuint8 NEWER=9  # and a remark")
    assert text != SCHEMAS[SOLUTION]
    assert older.converter(SOLUTION, text.encode()) is None
    assert older.converter(SOLUTION, SCHEMAS[SOLUTION].encode()) is None
    assert older.converter("others/msg/Thing", b"int32 x\n") is None
    assert older.converter("sensor_msgs/msg/NavSatFix", b"module sensor_msgs { module msg {") is None
    assert older.converter("sensor_msgs/msg/NavSatFix", b"\xff\xfe") is None
    rule = "\n" + "=" * 80 + "\nMSG: "
    nested = rule.join(["x/A a\n", *(f"x/{a}\n" + f"x/{b} p\nx/{b} q" for a, b in itertools.pairwise("ABCDEFGHIJKL"))])
    for text in (nested + rule + "x/L\nint8 p", "x/A a" + rule + "x/A\nx/A a"):  # 2^11 fields; one in itself
        assert older.converter(SOLUTION, text.encode()) is None


def test_damaged_bytes_of_another_version_are_damage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path, {RAW: "int64 extra\n" + SCHEMAS[RAW]}, [Record("/raw/g", 5, 5, b"\0\1\0\0ab", False, RAW)],
                 monkeypatch)  # fmt: skip
    older.converter.cache_clear()
    with pytest.warns(OtherVersionWarning), pytest.raises(DamagedError, match="ends inside a field"):
        list(reader.read_messages(path))
