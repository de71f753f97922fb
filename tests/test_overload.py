"""More than the machine can take: memory stays inside its bounds, raw data outlives what is computed from it, every
block is accounted for, and it goes on by itself. In simulated time, without threads (`stepped.py`)."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live import CAN, CLOCK, GNSS, decoded, faults, ledgers, raws, settings, stored, values
from stepped import Stepped, estimates

from edge_agent import runtime
from edge_agent.messages import MS, CanFrames, Mode, Raw, S
from edge_agent.recording import topics
from edge_agent.replay import replay
from edge_agent.simulate import simulate
from edge_agent.simulate.encode import raw_blocks
from edge_agent.simulate.specs import START_NS
from edge_agent.verify import verify
from edge_agent.writing import DERIVED_SHARE

BLOCK = 20_000  # no block of these scripts with all that is computed from it is larger
FUSED = "/fusion/deck/block"


@pytest.fixture(scope="module")
def script() -> list[Raw]:
    return list(raw_blocks(simulate("clean", 1, 58.0)))


def seconds(script: list[Raw]) -> Iterator[tuple[int, list[Raw]]]:
    """The script by seconds since the start."""
    at, some = 0, []
    for raw in script:
        while raw.t_ns >= START_NS + (at + 1) * S:
            yield at, some
            at, some = at + 1, []
        some.append(raw)
    yield at, some


def sound(run: Stepped, *reasons: str) -> None:
    """What holds after every fault: bounds, ledgers, files, chain, replay."""
    assert run.within_bounds(BLOCK), run.most
    assert run.checked == []
    assert run.balance() == {}
    assert not faults(run.files(), "LEDGER")
    verdict = verify(run.files())
    assert verdict.wanting == []
    assert {g.reason for g in verdict.gaps} == set(reasons)
    report = replay(run.files(), None, None, True)
    assert report.ok, str(report)
    assert report.compared > 300
    assert (report.unverifiable, report.unexpected) == (0, 0)


def fused_times(run: Stepped) -> np.ndarray:
    """Instants of the fused stream in the files, ns."""
    blocks = [topics.decode_fused_block("p", s.data) for s in stored(run.files(), FUSED)]
    return np.concatenate([b.t_ns for b in blocks])


def losses(run: Stepped, where: str) -> dict[str, int]:
    """What the files say was lost there: source -> count."""
    found: dict[str, int] = {}
    for f in faults(run.files(), "LOSS"):
        if f["text"].endswith(f"at {where}"):
            found[f["source"]] = found.get(f["source"], 0) + int(values(f)["count"])
    return found


# ----------------------------------------------------------------------------------------------------------- the writer


def stall(run: Stepped, script: list[Raw], begin: int, end: int) -> None:
    """Play the script; the writer does not come back from the disk in seconds [begin, end)."""
    for second, some in seconds(script):
        for raw in some:
            run.offer(raw)
            if begin <= second < end:
                run.writer.busy_ns = run.writer.busy_ns or run.now_ns
            run.main()
            if not begin <= second < end:
                run.write()
    run.close()


def test_a_writer_that_stalls_for_30_s_loses_nothing_with_the_default_bounds(script: list[Raw], tmp_path: Path) -> None:
    calm, run = Stepped(settings(tmp_path / "calm")), Stepped(settings(tmp_path / "stall"))
    calm.play(script)
    calm.close()
    stall(run, script, 20, 50)
    sound(run)
    assert estimates(run.files()) == estimates(calm.files())
    assert [(r.source, r.t_ns) for r in raws(run.files())] == [(r.source, r.t_ns) for r in script]
    assert [f["kind"] for f in faults(run.files())] == ["WRITER_STALLED", "FSYNC_LATE", "WRITER_OK"]
    assert values(faults(run.files(), "WRITER_OK")[0])["stalled_s"] == 30
    assert run.most["outbox"] * 10 < run.agent.outbox.limit_bytes * DERIVED_SHARE


@pytest.mark.parametrize("outbox_mb", [1.0, 0.3])
def test_a_stall_beyond_the_bound_costs_derived_records_first_and_then_raw_ones(
    script: list[Raw], tmp_path: Path, outbox_mb: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runtime, "RESERVE_BYTES", 200_000)
    run = Stepped(settings(tmp_path, f"record.outbox_mb={outbox_mb}"))
    stall(run, script, 20, 50)
    sound(run, *(() if outbox_mb == 1.0 else ("overload",)))
    lost = losses(run, "outbox")
    raw_lost = {k: v for k, v in lost.items() if k.startswith("/raw/")}
    assert lost[FUSED] > 80
    assert raw_lost == ({} if outbox_mb == 1.0 else raw_lost)
    for name, account in run.agent.accounts.items():
        assert raw_lost.get(f"/raw/{name}", 0) == account.refused
    assert run.agent.accounts[CLOCK].refused == 0  # Ticks have a reserve: time goes on
    if outbox_mb == 0.3:
        assert raw_lost[f"/raw/{CAN}"] > 50
    # the estimate went on all the while, and replay gives what was refused of it
    report = replay(run.files(), tmp_path / "again.mcap", None, False)
    again = [topics.decode_fused_block("p", s.data) for s in stored([tmp_path / "again.mcap"], FUSED)]
    modes = np.concatenate([b.mode for b in again])
    assert report.ok
    if outbox_mb == 1.0:
        assert sum(b.t_ns.size for b in again) == len(fused_times(run)) + 10 * lost[FUSED]
        assert (modes[2000:] == Mode.FUSED).all()
    last = topics.decode_fused_block("p", stored(run.files(), FUSED)[-1].data)
    assert set(last.mode.tolist()) == {Mode.FUSED}
    assert last.t_ns[-1] > script[-1].t_ns - 2 * S


def test_a_disk_ten_times_too_slow_is_lived_with_and_caught_up(
    script: list[Raw], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN a writer that takes one item of ten for 33 s WHEN it recovers THEN what was kept is on the disk, the rest
    is counted, and the end is as if nothing had been."""
    monkeypatch.setattr(runtime, "RESERVE_BYTES", 200_000)
    run = Stepped(settings(tmp_path, "record.outbox_mb=0.15"))
    calm = 0  # items a second, before
    for second, some in seconds(script):
        before = run.came
        for raw in some:
            run.offer(raw)
            run.main()
            if not 17 <= second < 50:
                run.write()
        if second < 17:
            calm = run.came - before
        elif second < 50:
            run.write(calm // 10)
    run.close()
    sound(run, "overload")
    lost = losses(run, "outbox")
    raw_lost = sum(v for k, v in lost.items() if k.startswith("/raw/"))
    raw_came = sum(a.received for a in run.agent.accounts.values())
    assert 0 < raw_lost < raw_came / 2
    # of what is computed nearly nothing got through, of what came in as much as the disk took
    blocks = [topics.decode_fused_block("p", s.data).t_ns[0] for s in stored(run.files(), FUSED)]
    there = [
        sum(START_NS + 25 * S < t < START_NS + 50 * S for t in some)
        for some in ([r.t_ns for r in raws(run.files()) if r.source == CAN], blocks)
    ]
    assert there[0] > 4 * there[1]
    assert there[0] > 10
    assert lost[FUSED] > 20
    t = fused_times(run)
    assert (np.diff(t[t > START_NS + 52 * S]) == S // 100).all()
    assert t[-1] >= script[-1].t_ns - S
    last = topics.decode_fused_block("p", stored(run.files(), FUSED)[-1].data)
    assert set(last.mode.tolist()) == {Mode.FUSED}


# -------------------------------------------------------------------------------------------------------------- the bus


def flood(raw: Raw, count: int) -> Raw:
    """That block of frames among `count` others of ids that nobody asked for."""
    assert isinstance(raw.payload, CanFrames)
    p = raw.payload
    n = len(p.t_ns)
    t = np.concatenate([p.t_ns, raw.t_ns - np.linspace(100 * MS, 0, count).astype(np.int64)])
    order = np.argsort(t, kind="stable")
    ids = np.concatenate([p.can_id, 0x600 + np.arange(count, dtype=np.uint32) % 16])
    flags = np.concatenate([p.flags, np.zeros(count, np.uint8)])
    length = np.concatenate([p.length, np.full(count, 8, np.uint8)])
    data = np.zeros((n + count, p.data.shape[1]), np.uint8)
    data[:n] = p.data
    data[n:, 0] = np.arange(count) % 251
    return replace(raw, payload=CanFrames(t[order], ids[order], flags[order], length[order], data[order], 0))


def test_20_000_frames_a_second_change_nothing(script: list[Raw], tmp_path: Path) -> None:
    some = [r for r in script if r.t_ns < START_NS + 25 * S]
    busy = [flood(r, 2000) if r.source == CAN else r for r in some]
    calm, run = Stepped(settings(tmp_path / "calm")), Stepped(settings(tmp_path / "busy"))
    calm.play(some)
    calm.close()
    run.play(busy)
    run.close()
    assert run.within_bounds(2000 * 30 + BLOCK), run.most
    assert run.balance() == {}
    assert faults(run.files()) == []
    assert estimates(run.files()) == estimates(calm.files())
    found = [r.payload for r in raws(run.files()) if isinstance(r.payload, CanFrames)]
    assert sum(len(p.t_ns) for p in found) == sum(len(r.payload.t_ns) for r in busy if isinstance(r.payload, CanFrames))
    assert verify(run.files()).wanting == []
    assert replay(run.files(), None, None, True).ok


def test_a_main_thread_too_slow_for_20_000_frames_a_second_drops_the_newest_and_says_so(
    script: list[Raw], tmp_path: Path
) -> None:
    """GIVEN 20 000 frames/s for 18 s WHEN main deals with a block in four THEN the inbox stays inside its bound, what
    is dropped is counted, the estimate says what it lacks, and all is well 10 s behind it."""
    run = Stepped(settings(tmp_path, "record.inbox_mb=0.3"))
    turn = 0
    for second, some in seconds(script):
        busy = 20 <= second < 38
        for raw in some:
            run.offer(flood(raw, 2000) if busy and raw.source == CAN else raw)
            turn += 1
            if not busy or turn % 4 == 0:
                run.main(1 if busy else 1 << 60)
            run.write()
    run.close()
    assert run.most["inbox"] > 250_000
    assert run.most["inbox"] <= 300_000
    assert run.within_bounds(2000 * 30 + BLOCK)
    assert run.checked == []
    assert run.balance() == {}
    dropped = losses(run, "inbox")
    assert dropped[CAN] > 60
    assert dropped == {k: a.dropped for k, a in run.agent.accounts.items() if a.dropped}
    assert ledgers(run.files())[CAN]["dropped_inbox"] == dropped[CAN]
    verdict = verify(run.files())
    assert verdict.wanting == []
    assert {g.reason for g in verdict.gaps} >= {"overload"}
    report = replay(run.files(), None, None, True)
    assert report.ok, str(report)
    blocks = [topics.decode_fused_block("p", s.data) for s in stored(run.files(), FUSED)]
    t = np.concatenate([b.t_ns for b in blocks])
    modes = np.concatenate([b.mode for b in blocks])
    during = (t > START_NS + 25 * S) & (t < START_NS + 38 * S)
    assert set(modes[during].tolist()) - {Mode.FUSED}  # it says that something is missing
    after = t > START_NS + 48 * S
    assert after.sum() > 800
    assert (modes[after] == Mode.FUSED).all()
    assert (np.diff(t[after]) == S // 100).all()


# ------------------------------------------------------------------------------------------------------ the serial line


def garbage(size: int, seed: int) -> bytes:
    """What a receiver in another mode, at another rate, or a broken cable sends: bytes of any kind, heads of sentences
    and of binary messages among them, none of which is whole."""
    rng = random.Random(seed)
    data = bytearray(rng.randbytes(size))
    heads = (b"$GNGGA,", b"$GPGST,1,2,3*00\r\n", b"$", b"\r\n", b"$GNGGA,120000.00,4630.0,N*11\r\n")
    for _ in range(size // 200):
        at = rng.randrange(size)
        head = rng.choice(heads)
        data[at : at + len(head)] = head
    return bytes(data[:size])


def test_a_megabyte_of_garbage_a_second_hides_no_good_sentence(script: list[Raw], tmp_path: Path) -> None:
    some = [r for r in script if r.t_ns < START_NS + 26 * S]
    calm, run = Stepped(settings(tmp_path / "calm")), Stepped(settings(tmp_path / "noisy"))
    calm.play(some)
    calm.close()
    good = longest = bytes_in = 0
    codec = run.agent.pipeline.receivers["rover"].codec
    for i, raw in enumerate(some):
        noisy = START_NS + 17 * S <= raw.t_ns < START_NS + 23 * S
        if noisy and raw.source == GNSS:
            assert isinstance(raw.payload, bytes)
            noise = garbage(100_000, i)
            for at in range(0, len(noise), 50_000):
                part = Raw(raw.t_ns - 50 * MS, 0, GNSS, noise[at : at + 50_000] + b"\r\n" * 600)
                run.play([part])
                bytes_in += len(part.payload)  # type: ignore[arg-type]
                longest = max(longest, codec.waiting)
        if raw.source == GNSS:
            good += raw.payload.count(b"$")  # type: ignore[union-attr]
        run.play([raw])
    run.close()
    assert bytes_in > 6_000_000
    heard = codec.counters["accepted"] - codec.counters["not_decoded"]  # the sum of garbage is right now and then
    assert heard == good
    solution = "/gnss/rover/solution"
    assert [s.data for s in stored(run.files(), solution)] == [s.data for s in stored(calm.files(), solution)]
    assert longest < 70_000
    assert run.within_bounds(200_000)
    assert run.checked == []
    assert run.balance() == {}
    rejects = [e for e in decoded(run.files(), "/events") if e["kind"] == "REJECT"]
    told = sum(int(values(e)["count"]) for e in rejects)
    assert told == codec.counters["rejected"] > 1000
    assert len(rejects) < 100  # 6 s of it: a record a second for each reason, not one for each sentence
    t = fused_times(run)
    assert (np.diff(t) == S // 100).all()  # the estimate went on
    report = replay(run.files(), None, None, True)
    assert report.ok, str(report)
    assert verify(run.files()).wanting == []


def test_nothing_but_garbage_is_told_once(script: list[Raw], tmp_path: Path) -> None:
    run = Stepped(settings(tmp_path))
    some = [r for r in script if r.t_ns < START_NS + 30 * S]
    for raw in some:
        if raw.source == GNSS and raw.t_ns >= START_NS + 17 * S:
            raw = replace(raw, payload=garbage(100_000, raw.t_ns // MS).replace(b"$", b"#"))
        run.play([raw])
    run.close()
    kinds = [f["kind"] for f in faults(run.files())]
    assert kinds == ["GARBAGE"]
    assert run.balance() == {}
    assert run.within_bounds(400_000)
    last = topics.decode_fused_block("p", stored(run.files(), FUSED)[-1].data)
    assert set(last.mode.tolist()) <= {Mode.COAST, Mode.INVALID}  # no estimate without a fix is called good
