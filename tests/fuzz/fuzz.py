"""Spoilt input for every parser: `python tests/fuzz/fuzz.py [MINUTES [TARGET...]]`, minutes for each target.

A target takes bytes and may refuse them only by the errors that it promises; anything else that it raises, more than a
second of CPU for one input, or growth by more than 64 MiB is a finding. Inputs are good ones (`seeds`, and what lies in
`corpus/<target>/`) that are mutated: bits, bytes, numbers at their limits, pieces cut out, doubled, swapped between
inputs. What makes a target answer in a way that was not seen before is mutated further. A finding is put into the
corpus, and `make test` runs the corpus and some mutations, so that it fails until the parser is mended.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import hashlib
import random
import resource
import shutil
import struct
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Hashable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import can
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "recording"))

from all_topics import checkpoint, records

import drivers
from drivers import can_port
from edge_agent import assemble, cat, config, importer, observe, status, verify, watch
from edge_agent.messages import AccelerometerSettings, CanFrames, Config, PortSettings, Raw, S, SignalField
from edge_agent.recording import reader, repair, topics
from edge_agent.recording.writer import SegmentWriter
from edge_agent.simulate import SCENARIOS, simulate
from edge_agent.simulate.encode import config_yaml, dbc_text, nmea_bursts, raw_blocks
from edge_agent.simulate.play import slcan_frame
from edge_agent.state import pack, unpack

HERE = Path(__file__).resolve().parent
CORPUS = HERE / "corpus"
CPU_S = 1.0
GROWTH = 64 << 20
LARGEST = 1 << 16
SCENARIO = SCENARIOS["clean"]
T = 1_700_000_001 * S

Run = Callable[[bytes], Hashable]


class Target(NamedTuple):
    """`run` returns what tells one behaviour from another; `allowed`: the errors with which it may refuse."""

    run: Run
    seeds: Callable[[], list[bytes]]
    allowed: tuple[type[Exception], ...]


# -------------------------------------------------------------------------------------------------------------- targets


def nmea(data: bytes) -> Hashable:
    """The receiver's stream, in two cuts that must give the same fixes; its state goes through a checkpoint between."""
    whole, cut = (drivers.load(drivers.CODECS, "nmea")() for _ in range(2))
    found = [*whole.feed(S, data, 10**18), *whole.finish()]
    half = len(data) // 2
    again = list(cut.feed(S, data[:half], 10**18))
    cut.load(unpack(pack(cut.save())))
    again += [*cut.feed(S, data[half:], 10**18), *cut.finish()]
    if repr(found) != repr(again):
        raise AssertionError(f"another cut gives other fixes: {found!r:.400} / {again!r:.400}")
    return tuple(sorted(k for k, v in whole.counters.items() if v))


def _summed(line: bytes) -> bytes:
    """A sentence up to its `*`, with the sum and the end."""
    return line + b"%02X\r\n" % functools.reduce(lambda a, b: a ^ b, line[1:-1])


def nmea_seeds() -> list[bytes]:
    some = b"".join(b for _, b in nmea_bursts(simulate("clean", 1, 2.0)))
    lines = (
        b"$GNRMC,120000.00,A,4730.0,N,00915.0,E,0.1,90,010126,,,A*", b"$GNZDA,120000.00,01,01,2026,00,00*",
        b"$GNTHS,12.3,A*", b"$PTNL,GGK,120000.00,010126,4730.0,N,00915.0,E,3,12,1.0,EHT455.1,M*", b"$GPHDT,9.1,T*",
        b"$PTNL,AVR,120000.00,+52.1,Yaw,-0.1,Tilt,,,1.2,3,1.4,12*", b"$GPVTG,1,T,,M,0.1,N,0.2,K*",
        b"$GNGNS,120000.00,4730.0,N,00915.0,E,RR,12,0.8,400.0,48.0,1.0,0000*", b"$GNGSA,A,3,1,2,3,,,,,,,,,,1,1,1*",
    )  # fmt: skip
    return [
        some[:400],
        b"".join(map(_summed, lines)),
    ]


def binary_seeds() -> list[bytes]:
    ubx = b"\xb5b\x01\x07\x04\x00abcd\x96\x0e"
    heads = [ubx, b"\xd3\x00\x04\x3e\xd0\x00\x00\x99\x99\x99", b"$@\x12\x34\x01\x00\x10\x00" + bytes(8)]
    heads += [
        b"\xaaD\x12\x1c\x2a\x00\x00\x20\x08\x00" + bytes(40),
        b"\xaaD\x13\x08" + bytes(20),
        b"\xaaD\xb5" + bytes(30),
    ]
    return [b"".join(heads), heads[0] * 9, heads[3] + nmea_seeds()[0]]


def _frames(data: bytes) -> CanFrames:
    """Frames out of bytes: 22 each: id, flags, length, step of time, data."""
    n = len(data) // 22
    rows = np.frombuffer(data, np.uint8, n * 22).reshape(n, 22)
    step = np.ascontiguousarray(rows[:, 6:14]).view("<i8")[:, 0] % (1 << 34)
    t_ns = 1000 * S + np.cumsum(step)
    can_id = np.ascontiguousarray(rows[:, :4]).view("<u4")[:, 0] & 0x1FFFFFFF
    return CanFrames(t_ns, can_id, rows[:, 4] & 0x7F, np.minimum(rows[:, 5], 8), rows[:, 14:].copy(), 0)


@functools.cache
def _codecs() -> tuple[AccelerometerSettings, ...]:
    x, y, z = (SignalField(1, 16 * i, 16) for i in range(3))
    wide = tuple(
        replace(f, can_id=2 + i, length=64 if i == 2 else 32, start=0, is_float=True) for i, f in enumerate((x, y, z))
    )
    return (
        AccelerometerSettings("a", "can", fields=(x, y, z), counter=SignalField(1, 48, 8), rate_hz=100.0),
        AccelerometerSettings("b", "can", fields=wide, unit="g"),
        AccelerometerSettings("c", "can", dbc="a.dbc", dbc_text=dbc_text(SCENARIO), signals=_signals(), unit="m/s2"),
    )


def _signals() -> tuple[str, str, str]:
    text = config_yaml(SCENARIO, dbc="a.dbc")
    made = config.parse(text, Path(), lambda name: dbc_text(SCENARIO).encode())
    (first, *_) = made.accelerometers.values()
    assert first.signals is not None
    return first.signals


def frames(data: bytes) -> Hashable:
    """CAN blocks through the codec, and through the bytes of a recording."""
    block = _frames(data)
    raw = Raw(1000 * S, 1, "can", block)
    if block.t_ns.size:
        back = topics.decode_raw("/raw/can", topics.CAN_FRAMES, topics.can_frames(raw))
        if not isinstance(back.payload, CanFrames) or any(
            (getattr(back.payload, k) != getattr(block, k)).any() for k in ("t_ns", "can_id", "flags", "length", "data")
        ):
            raise AssertionError("a block that was recorded is not what was read")
    seen = []
    for settings in _codecs():
        codec = drivers.load(drivers.CODECS, "accel")(settings)
        for part in np.array_split(np.arange(block.t_ns.size), 2):
            some = CanFrames(*(getattr(block, k)[part] for k in ("t_ns", "can_id", "flags", "length", "data")))
            codec.feed(some)
            codec.load(unpack(pack(codec.save())))
        seen += [k for k, v in codec.counters.items() if v]
    return tuple(seen)


def frames_seeds() -> list[bytes]:
    rng = random.Random(1)
    row = lambda i: struct.pack("<IBBq", 1 + i % 5, 0, 8, S // 100) + rng.randbytes(8)  # noqa: E731
    return [b"".join(row(i) for i in range(n)) for n in (1, 40)]


def kernel(data: bytes) -> Hashable:
    """What a CAN socket hands over, in structs of both sizes."""
    size = 72 if data[:1] > b"\x7f" else 16
    parts = [data[i : i + size] for i in range(1, len(data) - size + 1, size)]
    if not parts:
        return 0
    ids, flags, length, rows = can_port.unpack_frames(parts)
    if not len(ids) == len(flags) == len(length) == len(rows) == len(parts):
        raise AssertionError("columns of different lengths")
    return int(length.max()), int(np.bitwise_or.reduce(flags))


def kernel_seeds() -> list[bytes]:
    classic = struct.pack("=IB3x8s", 0x123, 8, b"12345678")
    fd = struct.pack("=IBB2x64s", 0x80000001, 64, 4, bytes(64))
    return [b"\0" + classic * 3, b"\xff" + fd * 2]


def slcan(data: bytes) -> Hashable:
    """An adapter's text, through python-can and our drain; a lost port is the only other answer."""
    counters = drivers.load(drivers.PORTS, "can")(PortSettings("can", "can", interface="slcan", channel="x")).counters
    bus = can.Bus(interface="slcan", channel="loop://", bitrate=500000, sleep_after_open=0)
    try:
        bus.serialPortOrig.reset_input_buffer()
        bus.serialPortOrig.write(data[:4000])
        drain = can_port.FrameBus(bus, counters)
        got = 0
        for _ in range(3):
            drain.drain()
            block = drain.block()
            got |= 0 if block is None else 1 << min(int(block.length.sum()), 60)
    finally:
        bus.shutdown()
    return got, drain.failure is None, tuple(k for k, v in counters.items() if v)


def slcan_seeds() -> list[bytes]:
    some = [slcan_frame(0x100 + i, 0, bytes(range(i))) for i in range(9)] + [slcan_frame(0x18FF1234, 1, b"abc")]
    return [b"".join(some), b"\r\a\rV1013\rz\rZ\rr1234\rR000000018\r" + some[8]]


YAML = config_yaml(SCENARIO, dbc="a.dbc")
FULL = (
    YAML.replace("{port: gnss}", "{port: gnss, heading: true}")
    + """\
triggers:
  sag: {point: deck, axis: z, above_m: 0.002}
  swing: {point: deck, axis: horizontal, above_mps: 0.01}
  shock: {point: deck, above_mps2: 0.05}
  plug: {fault: PORT_LOST}
events: {before_s: 2, after_s: 3, hold_s: 1, release: 0.5, max_s: 60, clips_gb: 1, hook: [/bin/true, -x], hook_s: 2}
"""
)


def dbc(data: bytes) -> Hashable:
    try:
        config.parse(YAML, Path(), lambda name: data)
    except config.ConfigError as e:
        return tuple(m.partition(":")[0] for m in e.mistakes[:3])
    return "good"


def dbc_seeds() -> list[bytes]:
    return [dbc_text(SCENARIO).encode(), Path(HERE.parents[1], "systemd", "example.dbc").read_bytes()]


def yaml(data: bytes) -> Hashable:
    try:
        config.parse(data.decode("utf-8", "replace"), Path(), lambda name: dbc_text(SCENARIO).encode())
    except config.ConfigError as e:
        return tuple(m.partition(":")[0][:40] for m in e.mistakes[:3])
    return "good"


def yaml_seeds() -> list[bytes]:
    example = Path(HERE.parents[1], "systemd", "example.yaml").read_bytes()
    return [
        YAML.encode(),
        FULL.encode(),
        example[:3000],
        b"site: a\nports: {a: {kind: serial, device: /dev/x}}\ndata_dir: x\nevents: {hook: [a]}",
    ]


@functools.cache
def _made() -> Config:
    return config.parse(FULL, Path(), lambda name: dbc_text(SCENARIO).encode())


@functools.cache
def _script() -> tuple[Raw, ...]:
    """Some seconds of a bridge that shakes, with a heading in every epoch."""
    found = []
    for raw in raw_blocks(simulate("clean", 1, 22.0)):
        if isinstance(raw.payload, bytes):
            heading = b"$GNHDT,%.2f,T*" % (45.0 + raw.order % 3)
            raw = replace(raw, payload=raw.payload + _summed(heading))
        found.append(raw)
    return tuple(found)


@functools.cache
def _saved() -> tuple[bytes, bytes]:
    pipeline = assemble.pipeline(_made())
    for raw in _script():
        if raw.t_ns <= PATH_NS:
            pipeline.step(raw)
    return pipeline.save(), pipeline.slow()


PATH_NS = 1017 * S  # where the path's input begins


def path(data: bytes) -> Hashable:
    """Garbage in mid-stream, through everything behind the ports: 3 bytes of head for each block (port and time, length
    in units of 4), then its content; good blocks of the script go on beside it. It must pass, and what has come of it
    must go through a checkpoint."""
    pipeline = assemble.pipeline(_made())
    pipeline.load(_saved()[0])
    rest = iter([raw for raw in _script() if raw.t_ns > PATH_NS])
    t_ns, kinds = PATH_NS, set()
    at = 0
    while at + 3 <= len(data) and at < 6000:
        what, length = data[at], 4 * int.from_bytes(data[at + 1 : at + 3], "little") % 1500
        content = data[at + 3 : at + 3 + length]
        at += 3 + length
        t_ns += (what >> 2) * (S // 50)
        raws = [Raw(t_ns, 0, "gnss", content)]
        if what & 3 == 1:
            raws = [Raw(t_ns, 0, "can", _frames(content))] if len(content) >= 22 else []
        elif what & 3 >= 2:
            raws = [r for r, _ in zip(rest, range(1 + length % 40), strict=False)]
            t_ns = max([t_ns, *(r.t_ns for r in raws)])
        for raw in raws:
            for record in pipeline.step(replace(raw, order=pipeline.order, t_ns=max(t_ns, raw.t_ns))):
                if record.topic == "/events":
                    kinds.add(topics.decode(topics.EVENT, record.data)["kind"])
    pipeline.load(pipeline.save())
    pipeline.finish()
    return tuple(sorted(kinds))


def path_seeds() -> list[bytes]:
    def block(what: int, content: bytes) -> bytes:
        content = content.ljust(-(-len(content) // 4) * 4, b" ")
        return bytes([what]) + (len(content) // 4).to_bytes(2, "little") + content

    good = [raw.payload for raw in _script() if raw.t_ns > PATH_NS and isinstance(raw.payload, bytes)]
    seeds = [b"".join(block(0, x) + block(2, bytes(24)) for x in good[:9]), block(2, bytes(1400)) * 3]
    seeds.append(b"".join(block(1, f) + block(2, bytes(64)) for f in frames_seeds()))
    return [*seeds, block(0, nmea_seeds()[1]) + block(0, binary_seeds()[0]) + seeds[0]]


def log(data: bytes) -> Hashable:
    """A log of somebody else, as NMEA and as candump."""
    shm = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=shm if shm.is_dir() else None) as name:
        source = Path(name, "log")
        source.write_bytes(data)
        said: list[Hashable] = []
        for wanted in ({"nmea": [("gnss", source)]}, {"can": [("can", source, None)]}):
            try:
                done = importer.import_logs(Path(name, f"{len(said)}.mcap"), **wanted)  # type: ignore[arg-type]
                said.append((min(done.raws, 5), done.lost > 0, done.logs[0].noted > 0))
            except importer.ImportRefusedError as e:
                said.append(str(e).rpartition(": ")[2][:20])
        return tuple(said)


def log_seeds() -> list[bytes]:
    candump = b"".join(b"(17800%05d.%06d) can%d %03X#%s\n" % (i, i * 999, i % 2, i, b"0A" * (i % 9)) for i in range(20))
    candump += b"(1780000030.5) can0 18FF1234#R\n(1780000031.1) can0 123##1AABB\n(1780000032.1) can0 20000080#00\n"
    return [candump, nmea_seeds()[0], nmea_seeds()[1] * 3, b"(1780000000.1) " + nmea_seeds()[1]]


def status_text(data: bytes) -> Hashable:
    """status.json as `edge-agent status` reads it and shows it."""
    try:
        found = status.from_json(data)
    except status.StatusError as e:
        return str(e)[:60]
    watch.report(Path("status.json"), found, T)
    status.to_prometheus(found)
    return len(status.render(found, 80, None, T)) // 64


def status_seeds() -> list[bytes]:
    pipeline = assemble.pipeline(_made())
    observer = observe.Observer(_made(), pipeline)
    for raw in _script():
        pipeline.step(raw)
    queues = [status.Queue("inbox", 1, 2, 3)]
    disk = status.Disk("/data", "recording", 1 << 30, 1 << 33, "a.mcap.part", 1000, 3.5, 4, 5000, T, 0.0, 0)
    found = observer.status(T, T, ("run", "0", "running"), [], queues, disk)
    return [status.to_json(found).encode()]


def state(data: bytes) -> Hashable:
    unpack(data)
    return "good"


def load(data: bytes) -> Hashable:
    """A checkpoint that holds something else than it should."""
    assemble.pipeline(_made()).load(_spoilt(_saved()[0], data))
    return "good"


def adopt(data: bytes) -> Hashable:
    """The same of what outlives a run."""
    assemble.pipeline(_made()).adopt(_spoilt(_saved()[1], data))
    return "good"


OTHERS = (
    None,
    True,
    0,
    -1,
    1 << 62,
    0.5,
    float("nan"),
    "",
    "x",
    b"y",
    [],
    [1, 2],
    {},
    {"a": 1},
    np.zeros(2),
    np.zeros((3, 1)),
)


def _spoilt(good: bytes, data: bytes) -> bytes:
    """A tree in which some nodes, as the data says, are taken away or replaced."""
    tree = unpack(good)
    for i in range(0, min(len(data), 24) - 2, 8):
        at = tree
        for step in data[i : i + 6]:
            inside = list(at) if isinstance(at, dict) else list(range(len(at)))
            if not inside:
                break
            key = inside[step % len(inside)]
            if isinstance(at[key], dict | list) and at[key] and step < 200:
                at = at[key]
                continue
            if data[i + 2] % 4 == 0:
                del at[key]
            else:
                at[key] = copy.deepcopy(OTHERS[data[i + 1] % len(OTHERS)])
            break
    return pack(tree)


def state_seeds() -> list[bytes]:
    deep = b"[" * 5000 + b"]" * 5000
    return [
        b"EASTATE1" + struct.pack("<I", len(deep)) + deep,
        pack({"a": [1, 2.5, None, "x", b"yz", np.arange(6.0).reshape(2, 3)], "b": {"c": True}}),
        _saved()[1],
    ]


@functools.cache
def _file() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        writer = SegmentWriter(
            Path(folder, "a.mcap"), metadata={"run": "r", "segment": "0"}, attachments={"c.yaml": b"x"}
        )
        writer.add(checkpoint(T, state=b"s"))
        for i, record in enumerate(records(blocks=2)):
            writer.add(record)
            if i % 20 == 0:
                writer.flush()
        return writer.close().read_bytes()


def mcap(data: bytes) -> Hashable:
    """A file that is read, described and repaired, whatever it is; and then reads without a complaint."""
    shm = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(dir=shm if shm.is_dir() else None))
    try:
        part = folder / "a.mcap.part"
        part.write_bytes(data)
        for look in (reader.info, reader.read_metadata, reader.read_attachments, reader.newest_ns):
            with contextlib.suppress(reader.DamagedError):
                look(part)
        verify.as_text(verify.verify([part]))
        cat.describe([part])
        for walk in (reader.read_messages(part), reader.read_between(part, 0, 1 << 62)):
            with contextlib.suppress(reader.DamagedError):
                for _ in walk:
                    pass
        (done,) = repair.recover(folder)
        if done.what == "failed":
            raise AssertionError(f"repair failed: {done.detail}")
        verdict = verify.as_json(verify.verify([folder]))
        cat.describe([done.path])
        found = reader.info(done.path)
        if found.damage or not found.complete or found.messages < done.messages:
            raise AssertionError(f"repaired, and still: {found.damage or 'no index'}, {found.messages} messages")
        return done.what, len(found.topics), bool(found.attachments), len(verdict["gaps"]), len(verdict["wanting"])
    finally:
        shutil.rmtree(folder)


@functools.cache
def _messages() -> tuple[tuple[str, str, bytes], ...]:
    seen: dict[str, tuple[str, str, bytes]] = {}
    for r in [checkpoint(T, state=b"s"), *records(blocks=2)]:
        schema = r.schema or topics.schema_of(r.topic)
        seen.setdefault(schema, (r.topic, schema, r.data))
    return tuple(seen.values())


def message(data: bytes) -> Hashable:
    """One message: the first byte chooses its schema."""
    topic, schema, _ = _messages()[data[0] % len(_messages())] if data else _messages()[0]
    body = data[1:]
    answers = []
    decoders: list[Callable[[], object]] = [lambda: topics.decode(schema, body)]
    if schema in (topics.RAW_BYTES, topics.CAN_FRAMES, topics.TICK):
        decoders += [lambda: topics.decode_raw(topic, schema, body), lambda: topics.raw_order(schema, body)]
    if schema == topics.CHECKPOINT:
        decoders.append(lambda: topics.decode_checkpoint(body))
    if schema == topics.FUSED_BLOCK:
        decoders.append(lambda: topics.decode_fused_block("p", body))
    if schema == topics.ACCEL_BLOCK:
        decoders.append(lambda: topics.decode_accel_block("a", body))
    for decode in decoders:
        try:
            decode()
            answers.append("good")
        except ValueError as e:
            answers.append(str(e)[:20])
    return schema, tuple(answers)


def message_seeds() -> list[bytes]:
    return [bytes([i]) + data[:4000] for i, (_, _, data) in enumerate(_messages())]


TARGETS: dict[str, Target] = {
    "nmea": Target(nmea, nmea_seeds, ()),
    "binary": Target(nmea, binary_seeds, ()),
    "frames": Target(frames, frames_seeds, ()),
    "kernel": Target(kernel, kernel_seeds, ()),
    "slcan": Target(slcan, slcan_seeds, ()),
    "dbc": Target(dbc, dbc_seeds, ()),
    "yaml": Target(yaml, yaml_seeds, ()),
    "state": Target(state, state_seeds, (ValueError,)),
    "load": Target(load, lambda: [bytes(range(i, i + 24)) for i in range(9)], (ValueError,)),
    "adopt": Target(adopt, lambda: [bytes(range(i, i + 24)) for i in range(9)], (ValueError,)),
    "path": Target(path, path_seeds, ()),
    "log": Target(log, log_seeds, ()),
    "status": Target(status_text, status_seeds, ()),
    "mcap": Target(mcap, lambda: [_file(), _file()[:2000]], ()),
    "message": Target(message, message_seeds, ()),
}


# ------------------------------------------------------------------------------------------------------------- mutation

EDGES = (
    0,
    1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    0x7FFFFFFF,
    0x80000000,
    0xFFFFFFFF,
    (1 << 63) - 1,
    1 << 63,
    (1 << 64) - 1,
)


def mutate(rng: random.Random, pool: list[bytes]) -> bytes:
    data = bytearray(rng.choice(pool))
    for _ in range(1 << rng.randrange(4)):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(9):
            case 0 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 1 if at < len(data):
                data[at] = rng.randrange(256)
            case 2:
                size = rng.choice((1, 2, 4, 8))
                data[at : at + size] = (rng.choice(EDGES) & ((1 << 8 * size) - 1)).to_bytes(size, "little")
            case 3:
                del data[at : at + rng.randrange(1, 40)]
            case 4:
                data[at:at] = data[at : at + rng.randrange(1, 40)]
            case 5:
                other = rng.choice(pool)
                begin = rng.randrange(len(other) + 1)
                data[at:at] = other[begin : begin + rng.randrange(1, 400)]
            case 6:
                del data[at:]
            case 7:
                data[at:at] = rng.choice(
                    (b"\r\n", b"$", b"*", b",", b"-", b"9" * 30, b"1e309", b"nan", b"\0" * 9, b"{", b"[", b": ")
                )
            case _:
                data[at:at] = rng.randbytes(rng.randrange(1, 9))
    return bytes(data[:LARGEST])


def resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def try_one(target: Target, data: bytes) -> tuple[Hashable, str]:
    """(behaviour, finding); finding "" = as it should be."""
    begin = time.process_time()
    try:
        seen: Hashable = target.run(data)
    except target.allowed as e:
        seen = type(e).__name__, str(e)[:24]
    except BaseException as e:  # the finding
        if isinstance(e, KeyboardInterrupt):
            raise
        return None, "".join(traceback.format_exception(e)[-3:])
    spent = time.process_time() - begin
    return seen, f"took {spent:.2f} s of CPU" if spent > CPU_S else ""


def corpus(name: str) -> list[Path]:
    folder = CORPUS / name
    return sorted(folder.iterdir()) if folder.is_dir() else []


def fuzz(name: str, seconds: float, seed: int, most: int = 1 << 60) -> tuple[int, int, list[str]]:
    """(inputs, behaviours, findings) of one target; stops after a dozen findings."""
    target = TARGETS[name]
    rng = random.Random(f"{name} {seed}")
    pool = [*target.seeds(), *(p.read_bytes() for p in corpus(name))]
    behaviours: set[Hashable] = set()
    findings: dict[str, str] = {}
    end = time.monotonic() + seconds
    count, base = 0, 0
    while time.monotonic() < end and count < most and len(findings) < 12:
        data = pool[count] if count < len(pool) and count < 40 else mutate(rng, pool)
        count += 1
        seen, finding = try_one(target, data)
        if count == 300:
            base = resident()
        elif base and count % 200 == 0 and resident() - base > GROWTH:
            finding = finding or f"grew by {(resident() - base) >> 20} MiB"
            base = resident()
        if finding:
            key = finding.strip().splitlines()[-1][:80]
            if key not in findings:
                path = CORPUS / name / hashlib.sha256(data).hexdigest()[:16]
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
                findings[key] = f"{path.relative_to(HERE)}: {finding}"
        elif seen not in behaviours:
            behaviours.add(seen)
            if len(pool) < 2000:
                pool.append(data)
    return count, len(behaviours), list(findings.values())


def main(argv: list[str]) -> int:
    minutes = float(argv[0]) if argv else 1.0
    names = argv[1:] or list(TARGETS)
    seed = int(time.time())
    print(f"seed {seed}, {minutes:g} minutes for each of: {', '.join(names)}")
    bad = 0
    for name in names:
        before = resident()
        count, behaviours, findings = fuzz(name, 60 * minutes, seed)
        grown = (resident() - before) / (1 << 20)
        print(
            f"{name:8} {count:8d} inputs, {behaviours:5d} behaviours, {len(findings)} findings, {grown:+.1f} MiB",
            flush=True,
        )
        for finding in findings:
            print(finding)
        bad += len(findings)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
