"""`edge-agent verify`: the chain of files, and every gap with its reason."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from edge_agent.__main__ import main
from edge_agent.messages import Raw, Record, RecordSettings, Rotate, S, Tick
from edge_agent.recording import reader, topics
from edge_agent.recording.segments import Recorder, recover
from edge_agent.recording.writer import SegmentWriter
from edge_agent.verify import Verdict, as_json, as_text, verify

T = 1_780_300_800 * S  # 2026-06-01 08:00:00 UTC
SEGMENT_S = 60


class Run:
    """Writes what an agent would: one raw block of each port a second, a new file each minute of recording."""

    def __init__(self, folder: Path, run_id: str, begin_s: float, boot: str = "b1", **settings: Any) -> None:
        kept = RecordSettings(**{"free_gb": 0.0, "keep_days": 1e5, **settings})
        self.recorder = Recorder(folder, kept, "site", {"run": run_id, "boot": boot}, {}, lambda: 1 << 40)
        self.t = T + int(begin_s * S)
        self.order = 0
        self.rotate("start")

    def rotate(self, reason: str = "time") -> None:
        point = topics.checkpoint(self.order, self.t, self.t, b"", reason)
        self.recorder.handle(Rotate(Record("/raw/checkpoint", self.t, self.t, point, False), self.t, reason))

    def seconds(self, n: int, *ports: str, skip: bool = False) -> None:
        for _ in range(n):
            for port in ports or ("gnss", "can", "clock"):
                payload = Tick(self.t, True, 0) if port == "clock" else b"data"
                if not skip:
                    self.recorder.handle(topics.raw_record(Raw(self.t, self.order, port, payload), self.t))
                self.order += 1
            self.t += S

    def fault(self, kind: str, source: str, text: str, count: int = 0, begin_s: float = 0.0) -> None:
        values = (("count", float(count)),) if count else ()
        begin = self.t - int(begin_s * S)
        data = topics.event(kind, source, text, values, self.t, self.t, begin, self.t)
        self.recorder.handle(Record("/faults", self.t, self.t, data, False))

    def stop(self) -> Path:
        self.recorder.handle(Record("/rosout", self.t, self.t, topics.log(20, "a", "stopped", self.t), False))
        path = self.recorder.close()
        assert path is not None
        return path

    def kill(self) -> Path:
        """The open file as it stands at its last flush."""
        self.recorder.idle(10**18)
        path = self.recorder.path
        assert path is not None
        data = path.read_bytes()
        self.recorder.close()
        path.with_name(path.name.removesuffix(".part")).unlink()
        path.write_bytes(data)
        return path


def three(folder: Path, run_id: str = "r1", begin_s: float = 0.0, **more: Any) -> list[Path]:
    run = Run(folder, run_id, begin_s, **more)
    for _ in range(2):
        run.seconds(SEGMENT_S)
        run.rotate()
    run.seconds(SEGMENT_S)
    run.stop()
    return sorted(folder.glob("*.mcap"))


def gaps(verdict: Verdict) -> list[tuple[str, str, float]]:
    return [(g.reason, g.source, (g.end_ns - g.begin_ns) / S) for g in verdict.gaps]


def code(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    found = main(["verify", str(folder), "--json"])
    return found, json.loads(capsys.readouterr().out)


def test_two_runs_that_were_stopped_are_good(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    three(tmp_path)
    files = three(tmp_path, "r2", 200)
    verdict = verify([tmp_path])
    assert [f.path for f in verdict.files] == files
    assert (verdict.wanting, verdict.notes) == ([], [])
    assert gaps(verdict) == [("stop", "all", 21.0)]
    found, said = code(tmp_path, capsys)
    assert found == 0
    assert said["ok"]
    assert said["raw_blocks"] == {"can": 360, "clock": 360, "gnss": 360}
    assert (said["begin_utc"][:19], said["end_utc"][:19]) == ("2026-06-01T08:00:00", "2026-06-01T08:06:20")
    assert said["recorded_s"] == 6 * 60 - 4  # the last second of each file but a stopped one's has no length
    assert [f["sha256"] for f in said["files"]] == [hashlib.sha256(p.read_bytes()).hexdigest() for p in files]
    assert as_text(verdict).splitlines()[-1] == "verify: good"
    assert verify([files[1], files[0]]).wanting == []  # in any order, and a part of the whole
    assert main(["verify", str(tmp_path / "none")]) == 2
    (tmp_path / "empty").mkdir()
    assert main(["verify", str(tmp_path / "empty")]) == 2


def test_an_empty_file_is_named_with_its_reason(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = three(tmp_path)
    (tmp_path / "site_20260601T090000Z_000.mcap.part").touch()
    assert code(tmp_path, capsys)[0] == 0  # an agent makes its next file so
    (note,) = verify([tmp_path]).notes
    assert note.startswith("site_20260601T090000Z_000.mcap.part is empty: it is being made")
    empty = tmp_path / "site_20260601T100000Z_000.mcap"
    empty.touch()
    found, said = code(tmp_path, capsys)
    assert found == 1
    assert said["wanting"] == [
        f"{empty}: is empty (0 bytes): not a recording; a copy that failed, or a sick disk",
    ]
    assert {f["file"]: f["state"] for f in said["files"]}[str(empty)] == "damaged"
    assert main(["verify", str(empty)]) == 1
    assert "is empty (0 bytes)" in capsys.readouterr().out
    assert files[0].exists()


def test_what_is_named_twice_or_was_replayed_from_the_rest_is_counted_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = three(tmp_path)
    alone = code(tmp_path, capsys)[1]
    again = verify([tmp_path, files[1], files[1]])
    assert as_json(again) == {**alone, "notes": [f"{files[1]} is the same as {files[1]}: counted once"] * 2}
    metadata = {"run": "r1", "segment": "0", "replayed_from": ", ".join(p.name for p in files)}
    writer = SegmentWriter(tmp_path / "fused.mcap.part", metadata=metadata, attachments={})
    for path in files:
        for s in reader.read_messages(path, {"/raw/gnss", "/raw/can", "/raw/clock"}):
            writer.add(Record(s.topic, s.log_ns, s.publish_ns, s.data, False, s.schema))
    fused = writer.close()
    found, said = code(tmp_path, capsys)
    assert found == 0
    names = ", ".join(p.name for p in files)
    assert said == {**alone, "notes": [f"fused.mcap is a replay of {names}: its records are not counted again"]}
    assert verify([fused]).files[0].raws == {"gnss": 180, "can": 180, "clock": 180}  # alone it is what there is
    fused.write_bytes(fused.read_bytes()[:300] + b"x" + fused.read_bytes()[301:])
    assert code(tmp_path, capsys)[0] == 1  # but must be whole


def test_a_changed_byte_and_a_rewritten_file_are_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = three(tmp_path)
    good = files[1].read_bytes()
    chunk = next(p for p in reader.parts(good) if p.opcode == reader.CHUNK)
    bad = bytearray(good)
    bad[chunk.pos + chunk.length - 9] ^= 1
    files[1].write_bytes(bad)
    verdict = verify([tmp_path])
    assert any("damaged data" in w and files[1].name in w for w in verdict.wanting)
    assert f"{files[1].name} was altered after {files[2].name} began behind it" in verdict.wanting
    assert code(tmp_path, capsys)[0] == 1
    # a file that reads well, but is another one
    three(tmp_path / "other")
    other = next(p for p in sorted((tmp_path / "other").iterdir()) if p.name == files[1].name)
    shutil.copy(other, files[1])
    assert verify([tmp_path]).wanting == []  # the same content
    run = Run(tmp_path / "forged", "r1", 60)
    run.recorder.segments = 1
    run.seconds(SEGMENT_S, "can")
    forged = run.stop()
    shutil.copy(forged, files[1])
    assert f"{files[1].name} was altered after {files[2].name} began behind it" in verify([tmp_path]).wanting
    # seen from one file alone, for the other lies beside it
    assert verify([files[2]]).wanting == [f"{files[1].name} was altered after {files[2].name} began behind it"]


def test_a_missing_file_is_found_in_a_run_and_between_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    three(tmp_path)
    files = three(tmp_path, "r2", 200)
    keep = files[1].read_bytes()
    files[1].unlink()
    verdict = verify([tmp_path])
    assert ("missing", "all", 61.0) in gaps(verdict)
    assert f"{files[1].name} is missing: {files[2].name} follows it" in verdict.wanting
    assert code(tmp_path, capsys)[0] == 1
    assert main(["info", *map(str, sorted(tmp_path.iterdir()))]) == 1
    assert "  1 file(s) of this run before it are missing" in capsys.readouterr().out
    files[1].write_bytes(keep)
    assert main(["info", *map(str, files)]) == 0
    for f in files[:3]:  # a whole run but for its first two files, and then all of it
        f.unlink()
    verdict = verify([tmp_path])
    assert verdict.wanting == []
    assert verdict.notes == [f"what was before {files[3].name} is gone: {files[2].name}"]
    files[1].write_bytes(keep)
    verdict = verify([tmp_path])
    assert f"{files[2].name} is missing: {files[3].name} follows it" in verdict.wanting


def test_what_retention_deleted_is_said_and_no_fault(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = three(tmp_path / "a")[0].stat().st_size
    run = Run(tmp_path / "b", "r1", 0, keep_gb=2.5 * size / 1e9)
    for _ in range(5):
        run.seconds(SEGMENT_S)
        run.rotate()
        for f in run.recorder.drain_faults():
            run.fault(f.kind, f.source, f.text)
    run.seconds(5)
    run.stop()
    files = sorted((tmp_path / "b").iterdir())
    assert len(files) < 5
    found, said = code(tmp_path / "b", capsys)
    assert (found, said["gaps"]) == (0, [])
    assert said["notes"][0].startswith(f"what was before {files[0].name} is gone: site_")


@pytest.mark.parametrize(("boot", "reason"), [("b1", "kill"), ("b2", "power")])
def test_a_torn_file_tells_kill_from_power(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], boot: str, reason: str
) -> None:
    run = Run(tmp_path, "r1", 0, boot="b1")
    run.seconds(SEGMENT_S)
    run.rotate()
    run.seconds(30)
    torn = run.kill()
    found, said = code(tmp_path, capsys)
    assert found == 0  # an open file may be one that is being written
    assert "has no index" in said["notes"][0]
    recover(tmp_path)
    three(tmp_path, "r2", 120, boot=boot)
    found, said = code(tmp_path, capsys)
    assert (found, said["wanting"]) == (3, [])
    assert [(g["reason"], g["seconds"]) for g in said["gaps"]] == [(reason, 31.0)]
    assert torn.name.removesuffix(".part") in said["notes"][0]
    assert as_text(verify([tmp_path])).endswith("verify: good, with loss")


def test_a_kill_between_two_files_leaves_none_torn(tmp_path: Path) -> None:
    run = Run(tmp_path, "r1", 0)
    run.seconds(10)
    run.recorder.close()
    three(tmp_path, "r2", 20, boot="b2")
    assert gaps(verify([tmp_path])) == [("power", "all", 11.0)]


def test_a_run_that_ended_by_itself(tmp_path: Path) -> None:
    run = Run(tmp_path, "r1", 0)
    run.seconds(10)
    text = "failed: ZeroDivisionError: a bug"
    run.recorder.handle(Record("/rosout", run.t, run.t, topics.log(40, "a", text, run.t), False))
    run.recorder.close()
    three(tmp_path, "r2", 20)
    verdict = verify([tmp_path])
    assert gaps(verdict) == [("crash", "all", 11.0)]
    assert "ZeroDivisionError" in verdict.gaps[0].text
    assert verdict.lost


def test_losses_are_gaps_with_their_reason(tmp_path: Path) -> None:
    run = Run(tmp_path, "r1", 0)
    run.seconds(20)
    for _ in range(3):
        run.seconds(1)
        run.fault("LOSS", "can", "7 lost at inbox", 7, begin_s=1.0)
    run.seconds(10)
    run.fault("LOSS", "/raw/can", "2 lost at outbox", 2, begin_s=1.0)
    run.fault("LOSS", "/fusion/p/block", "9 lost at outbox", 9, begin_s=1.0)
    run.seconds(5, skip=True)
    run.rotate("disk")
    run.seconds(1)
    for port in ("gnss", "can", "clock"):
        run.fault("LOSS", f"/raw/{port}", "5 lost at disk", 5, begin_s=6.0)
    run.seconds(5)
    run.stop()
    verdict = verify([tmp_path])
    assert verdict.wanting == []
    assert [(g.reason, g.source, g.text) for g in verdict.gaps] == [
        ("overload", "can", "21 blocks lost at inbox"),
        ("overload", "can", "2 blocks lost at outbox"),
        *(("disk", port, "5 blocks lost at disk") for port in ("can", "clock", "gnss")),
    ]
    assert as_json(verdict)["derived_refused"] == {"/fusion/p/block": 9}
    assert verdict.lost


def test_the_same_without_a_word_is_wrong(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = Run(tmp_path, "r1", 0)
    run.seconds(20)
    run.seconds(2, skip=True)
    run.seconds(20)
    run.seconds(1, skip=True)
    run.rotate()
    run.seconds(3)
    run.stop()
    found, said = code(tmp_path, capsys)
    assert found == 1
    assert [(g["reason"], g["seconds"]) for g in said["gaps"]] == [("unknown", 3.0), ("unknown", 2.0)]
    assert "6 raw blocks are not in" in said["wanting"][0]
    assert "3 raw blocks between" in said["wanting"][1]


def test_a_lost_and_a_silent_port_and_a_frozen_agent(tmp_path: Path) -> None:
    run = Run(tmp_path, "r1", 0)
    run.seconds(10)
    run.fault("PORT_LOST", "gnss", "port gnss: no such device; next try in 1 s")
    run.seconds(30, "can", "clock")
    run.seconds(10)
    run.fault("SILENT", "can", "nothing has come for 5 s")
    run.seconds(8, "gnss", "clock")
    run.rotate()
    run.seconds(8, "gnss", "clock")
    run.seconds(10)
    run.t += 100 * S
    run.seconds(10)
    run.stop()
    verdict = verify([tmp_path])
    assert verdict.wanting == []
    assert gaps(verdict) == [("port lost", "gnss", 31.0), ("silent", "can", 17.0), ("stall", "all", 101.0)]
    assert verdict.gaps[0].text == "port gnss: no such device"


def test_a_clock_that_was_ahead_does_not_break_the_chain(tmp_path: Path) -> None:
    """GIVEN a run that was a year ahead for a while WHEN later runs begin THEN they follow the newest file."""
    run = Run(tmp_path, "r1", 0)
    run.seconds(10)
    ahead = 365 * 86400 * S
    run.t += ahead
    step = topics.event("CLOCK_STEP", "clock", "wall clock moved by a year", (), run.t, run.t)
    run.recorder.handle(Record("/events", run.t, run.t, step, True))
    run.rotate("clock")
    run.seconds(10)
    run.t -= ahead
    run.rotate("clock")
    run.seconds(10)
    run.stop()
    three(tmp_path, "r2", 100)
    three(tmp_path, "r3", 400)
    verdict = verify([tmp_path])
    assert (verdict.wanting, verdict.notes) == ([], [])
    assert [(f.run_id, f.segment) for f in verdict.files] == [(r, i) for r in ("r1", "r2", "r3") for i in range(3)]
    assert gaps(verdict) == [("stop", "all", 71.0), ("stop", "all", 121.0)]
    assert len(as_json(verdict)["clock_steps"]) == 1


def test_a_file_put_in_and_one_renamed(tmp_path: Path) -> None:
    files = three(tmp_path)
    run = Run(tmp_path / "foreign", "r1", 70)
    run.recorder.segments = 1
    run.seconds(3)
    shutil.copy(run.stop(), tmp_path)
    assert any("is named by no file behind it" in w for w in verify([tmp_path]).wanting)
    (tmp_path / "site_20260601T080110Z_000.mcap").unlink()
    files[1].rename(tmp_path / "copy of it.mcap")
    assert verify([tmp_path]).notes == [f"{files[1].name} is now called copy of it.mcap"]


def test_a_file_that_nobody_could_finish_is_no_break(tmp_path: Path) -> None:
    """GIVEN a torn file that could not be sealed at that time WHEN it is repaired later THEN it has its place."""
    run = Run(tmp_path, "r1", 0)
    run.seconds(10)
    run.rotate()
    run.seconds(10)
    torn = run.kill()
    run.recorder._writer = None
    run.recorder._previous = None  # as after a disk error
    torn = torn.rename(tmp_path / "aside")
    run.rotate("disk")
    run.seconds(10)
    run.stop()
    torn.rename(tmp_path / "site_20260601T080010Z_000.mcap.part")
    recover(tmp_path)
    verdict = verify([tmp_path])
    assert verdict.wanting == []
    assert any("was torn when" in n for n in verdict.notes)


def test_a_live_agent_may_finish_and_delete_files_meanwhile(tmp_path: Path) -> None:
    files = three(tmp_path)
    part = files[2].rename(files[2].with_name(files[2].name + ".part"))

    def meanwhile(path: Path) -> None:
        if path == files[0]:
            files[0].unlink()
            part.rename(files[2])

    verdict = verify([tmp_path], meanwhile)
    assert [f.path for f in verdict.files] == files[1:]
    assert verdict.wanting == []
    assert f"{files[0].name} went away meanwhile" in verdict.notes


def test_damage_in_one_file_does_not_hide_the_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    three(tmp_path)
    (tmp_path / "site_20250101T000000Z_000.mcap").write_bytes(b"somebody's notes" * 9)
    (tmp_path / "site_20250102T000000Z_000.mcap.part").touch()
    found, said = code(tmp_path, capsys)
    assert found == 1
    assert any("not an MCAP file" in w for w in said["wanting"])
    assert said["raw_blocks"]["can"] == 180
    assert replace(verify([tmp_path]), files=[]).wanting == said["wanting"]
    names = sorted(map(str, tmp_path.iterdir()))
    assert main(["info", *names, str(tmp_path / "none.mcap"), "--json"]) == 1
    listed = json.loads(capsys.readouterr().out)
    assert sum("bytes" in f for f in listed) >= 3
    assert [f["damage"] for f in listed if f["file"].endswith("none.mcap")] == [
        "cannot be read: No such file or directory"
    ]


def test_clips_are_looked_at(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = three(tmp_path)
    clips = tmp_path / "clips"
    clips.mkdir()
    good = clips / "site_20260601T080010Z_000.mcap"
    good.write_bytes(files[0].read_bytes())
    found, said = code(tmp_path, capsys)
    assert found == 0
    assert said["clips"] == [
        {"file": str(good), "bytes": good.stat().st_size, "state": "complete", "messages": said["files"][0]["messages"]}
    ]
    assert "clips: 1, 1 of them whole" in as_text(verify([tmp_path]))
    assert [f["file"] for f in said["files"]] == [str(f) for f in files]  # the chain and the gaps know nothing of them
    torn = clips / "site_20260601T080020Z_000.mcap.part"
    torn.write_bytes(files[1].read_bytes()[:-300])
    data = bytearray(files[2].read_bytes())
    data[len(data) // 3] ^= 1
    bad = clips / "site_20260601T080030Z_000.mcap"
    bad.write_bytes(data)
    found, said = code(tmp_path, capsys)
    assert found == 1
    assert [c["state"] for c in said["clips"]] == ["complete", "open", "damaged"]
    (wanting,) = said["wanting"]
    assert wanting.startswith(str(bad))
    assert any(torn.name in note for note in said["notes"])


@pytest.mark.parametrize("number", ["9" * 5000, "-1", "1e3", "", "\u0663"])
def test_a_number_of_a_file_that_is_none_is_no_crash(tmp_path: Path, number: str) -> None:
    """Also one that Python refuses to read because it is too long."""
    writer = SegmentWriter(
        tmp_path / "site_20260601T080000Z_000.mcap.part", metadata={"run": "r", "segment": number}, attachments={}
    )
    data = topics.checkpoint(0, 0, T, b"", "start")
    writer.add(Record(topics.CHECKPOINT_TOPIC, T, T, data, False))
    writer.close()
    verdict = verify([tmp_path])
    assert verdict.wanting == []
    assert verdict.files[0].segment == (3 if number == "\u0663" else 0)
    assert main(["info", *map(str, tmp_path.iterdir())]) == 0
