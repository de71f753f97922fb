"""One measurement each, run as a process of its own: `python tasks.py NAME DATA [ARG...]` prints one line of JSON.

The agent's part comes from the checkout that stands first on PYTHONPATH. Figures are CPU time of this process unless
they say otherwise. Imports stand where they are used, so that what is measured loads nothing else.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

S = 1_000_000_000
STEADY_S = 140.0
"""Start window and first two minutes, in which the filter learns its noise faster, are not measured."""
Figures = dict[str, float]


def cpu_ns() -> int:
    return time.process_time_ns()


# -------------------------------------------------------------------------------------------------- computation alone


def _config(data: Path) -> Any:
    from edge_agent import config

    return config.load(data / "config.yaml")


def _raws(data: Path) -> list[Any]:
    from edge_agent.recording import topics
    from edge_agent.recording.reader import read_messages

    found = [m for m in read_messages(data / "raw.mcap") if m.topic.startswith("/raw/")]
    return [topics.decode_raw(m.topic, m.schema, m.data) for m in found if m.topic != "/raw/checkpoint"]


def filter_(data: Path) -> Figures:
    """The station alone, as the pipeline calls it: us per sample and axis."""
    from edge_agent import assemble
    from edge_agent.fusion.station import Station

    settings = _config(data)
    pipeline = assemble.pipeline(settings)
    calls: list[tuple[int, str, tuple[Any, ...]]] = []
    now = 0

    class Spy:
        def __init__(self, station: Any) -> None:
            self.station = station

        def __getattr__(self, name: str) -> Any:
            inner = getattr(self.station, name)
            if name not in ("accelerations", "fix", "advance"):
                return inner

            def call(*args: Any) -> Any:
                calls.append((now, name, args))
                return inner(*args)

            return call

    pipeline.station = Spy(pipeline.station)  # type: ignore[assignment]
    raws = _raws(data)
    for raw in raws:
        now = raw.t_ns
        pipeline.step(raw)
    begin = raws[0].t_ns + int(STEADY_S * S)
    unset = frozenset(k for k, r in settings.receivers.items() if settings.structure.reference_llh is None)
    station = Station(list(settings.points.values()), settings.fusion, unset)
    bound = [(t, getattr(station, name), args) for t, name, args in calls]
    for t, call, args in bound:
        if t < begin:
            call(*args)
    late = [(call, args) for t, call, args in bound if t >= begin]
    axes = sum(b.t_ns.size * 3 for _, args in late for b in (args[0].values() if isinstance(args[0], dict) else ()))
    start = cpu_ns()
    for call, args in late:
        call(*args)
    return {"us": (cpu_ns() - start) / 1e3 / axes}


class _Counted:
    """A file that keeps only its size: the disk is not part of the computation."""

    def __init__(self) -> None:
        self.size = 0

    def write(self, data: bytes) -> int:
        self.size += len(data)
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        pass


def pipeline(data: Path, out: str) -> Figures:
    """Decode, time, filter, encode, compress: percent of a core at the record's rate."""
    from edge_agent import assemble
    from edge_agent.recording.writer import SegmentWriter

    raws = _raws(data)
    path = assemble.pipeline(_config(data))
    begin = raws[0].t_ns + int(STEADY_S * S)
    writer = SegmentWriter(Path(out) / f"pipeline{os.getpid()}.mcap.part", metadata={}, attachments={})
    flushed = start = 0
    for raw in raws:
        if raw.t_ns >= begin and not start:
            start = cpu_ns()
        for record in path.step(raw):
            writer.add(record)
        if raw.t_ns - flushed >= S:
            flushed = raw.t_ns
            writer.flush()
    used = cpu_ns() - start
    writer.abandon()
    writer.path.unlink()
    return {"percent": 100.0 * used / (raws[-1].t_ns - begin)}


def replay(data: Path, out: str) -> Figures:
    """raw.mcap to fused.mcap through the command's own function: times real time, by CPU time."""
    from edge_agent.replay import replay as run

    target = Path(out) / f"replay{os.getpid()}.mcap"
    raws = _raws(data)
    seconds = (raws[-1].t_ns - raws[0].t_ns) / S
    del raws
    settings = _config(data)
    start = cpu_ns()
    run([data / "raw.mcap"], target, settings, False)
    used = (cpu_ns() - start) / S
    target.unlink()
    return {"times": seconds / used}


def rts(_: Path) -> Figures:
    """Smoother of an hour of three axes, 250 Hz + 10 Hz: seconds."""
    import numpy as np

    from edge_agent.review import smooth

    rng = np.random.default_rng(1)
    t = np.arange(3600 * 250, dtype=np.int64) * (S // 250)
    fix_t = np.arange(3600 * 10, dtype=np.int64) * (S // 10)
    wave = np.sin(np.pi * t / S)[:, None]
    accel = -(np.pi**2) * 0.005 * wave + rng.standard_normal((len(t), 3)) * 2.5e-3 + 0.02
    z = 0.005 * np.sin(np.pi * fix_t / S)[:, None] + rng.standard_normal((len(fix_t), 3)) * 0.003
    fixes, samples = smooth.plain(fix_t, z, 0.003), smooth.Accelerations(t, accel)
    start = cpu_ns()
    smooth.smooth(fixes, samples, smooth.noise(1e-7, 1e-9))
    return {"s": (cpu_ns() - start) / S}


# ---------------------------------------------------------------------------------------------------------------- bus


def _udp(size: int = 4 << 20) -> Any:
    """A loopback socket that carries struct can_frame; the receive buffer as large as the system gives."""
    import socket

    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, 33, size)  # SO_RCVBUFFORCE
    except OSError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size)
    sock.bind(("127.0.0.1", 0))
    return sock


def _wire(block: Any) -> list[bytes]:
    """Frames of a block as the kernel's struct can_frame."""
    import numpy as np

    rows = np.zeros(len(block.t_ns), np.dtype([("id", "=u4"), ("length", "u1"), ("pad", "u1", 3), ("data", "u1", 8)]))
    rows["id"], rows["length"], rows["data"] = block.can_id, block.length, block.data[:, :8]
    data = rows.tobytes()
    return [data[i : i + 16] for i in range(0, len(data), 16)]


def _joined(data: Path, seconds: float, block_s: float) -> list[Any]:
    """Raw of the record with CAN blocks joined to blocks of `block_s`, as a port under load hands them over."""
    from dataclasses import replace

    import numpy as np

    from edge_agent.messages import CanFrames

    raws = _raws(data)
    end = raws[0].t_ns + int(seconds * S)
    out: list[Any] = []
    held: list[Any] = []
    for raw in raws:
        if raw.t_ns > end:
            break
        if isinstance(raw.payload, CanFrames):
            held.append(raw)
        else:
            out.append(raw)
        if held and held[-1].t_ns - held[0].t_ns >= int(block_s * S) - S // 10:
            parts = [r.payload for r in held]
            columns = [np.concatenate([getattr(p, c) for p in parts]) for c in ("t_ns", "can_id", "flags", "length")]
            joined = CanFrames(*columns, np.concatenate([p.data for p in parts]))
            out.append(replace(held[-1], payload=joined))
            held = []
    return [replace(raw, order=i) for i, raw in enumerate(out)]


def burst(data: Path, out: str) -> Figures:
    """Frames from the socket to the file, fused: frames per second of CPU. Blocks of half a second of the bus, which
    is what one of 100 ms holds at five times the rate. The blocks' times are the record's own: a burst's arrival says
    nothing about a sensor's clock."""
    import socket
    from dataclasses import replace

    from drivers.can_port import FrameSocket
    from edge_agent import assemble
    from edge_agent.messages import CanFrames
    from edge_agent.recording.writer import SegmentWriter

    raws = _joined(data, STEADY_S + 25.0, 0.5)
    path = assemble.pipeline(_config(data))
    receiver, sender = _udp(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(receiver.getsockname())
    counters = {"dropped": 0, "malformed": 0, "spread": 0, "error_frames": 0, "overruns": 0, "receive_buffer": 0}
    source = FrameSocket(receiver, counters, time.monotonic_ns())
    room = counters["receive_buffer"] // 1024
    writer = SegmentWriter(Path(out) / f"burst{os.getpid()}.mcap.part", metadata={}, attachments={})
    begin = raws[0].t_ns + int(STEADY_S * S)
    frames = used = got = 0
    for raw in raws:
        timed = raw.t_ns >= begin
        block = raw.payload
        if isinstance(block, CanFrames) and timed:
            wire = _wire(block)
            if len(wire) > room:
                raise SystemExit(f"the socket holds {room} frames: net.core.rmem_max is too small")
            for frame in wire:
                sender.send(frame)
            start = cpu_ns()
            source.drain()
            taken = source.block()
            used += cpu_ns() - start
            if taken is None or len(taken.t_ns) != len(wire):
                raise SystemExit("frames were lost between the sockets")
            frames += len(wire)
            raw = replace(raw, payload=replace(taken, t_ns=block.t_ns))
        start = cpu_ns()
        records = path.step(raw)
        for record in records:
            writer.add(record)
        if timed:
            used += cpu_ns() - start
            got += sum(r.topic.endswith("/block") for r in records)
    start = cpu_ns()
    writer.flush()
    used += cpu_ns() - start
    writer.abandon()
    writer.path.unlink()
    if not got:
        raise SystemExit("nothing was fused")
    return {"per_s": frames * S / used}


def _udp_bus(sock: Any) -> Any:
    """python-can's own SocketCAN bus on a socket of ours."""
    import socket

    import can
    from can.interfaces.socketcan.socketcan import SocketcanBus

    class UdpBus(SocketcanBus):  # type: ignore[misc]
        def __init__(self) -> None:
            self.socket = sock
            self.channel = "can0"
            self._is_filtered = False
            self._task_id = 0
            sock.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS
            can.BusABC.__init__(self, channel="can0")

        def _apply_filters(self, filters: Any) -> None:
            pass

        def shutdown(self) -> None:
            can.BusABC.shutdown(self)
            sock.close()

    return UdpBus()


def burst_peer(data: Path) -> Figures:
    """python-can reads the same frames and does nothing else."""
    import socket

    from edge_agent.messages import CanFrames

    receiver, sender = _udp(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.connect(receiver.getsockname())
    bus = _udp_bus(receiver)
    frames = used = 0
    for raw in _joined(data, 20.0, 0.5):
        if isinstance(raw.payload, CanFrames):
            wire = _wire(raw.payload)
            for frame in wire:
                sender.send(frame)
            start = cpu_ns()
            while bus.recv(0) is not None:
                frames += 1
            used += cpu_ns() - start
    bus.shutdown()
    return {"per_s": frames * S / used}


@contextmanager
def _fed(data: bytes) -> Iterator[str]:
    """A pseudo-terminal into which another process writes `data` as fast as it is read; its path. Whatever the reader
    writes is thrown away, and the feeder waits for the reader to open it."""
    import select
    import tty

    master, slave = os.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    pid = os.fork()
    if pid == 0:
        try:
            time.sleep(0.7)  # the reader opens, sets the line and throws away what came before
            os.set_blocking(master, False)
            at = 0
            while at < len(data):
                readable, writable, _ = select.select([master], [master], [], 1.0)
                if readable:
                    os.read(master, 4096)
                if writable:
                    at += os.write(master, data[at : at + 4096])
            time.sleep(60.0)
        finally:
            os._exit(0)
    try:
        yield path
    finally:
        import signal

        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(master)
        os.close(slave)


def _slcan_text(data: Path, count: int) -> bytes:
    from edge_agent.messages import CanFrames
    from edge_agent.simulate.play import slcan_frame

    out: list[bytes] = []
    for raw in _raws(data):
        if isinstance(raw.payload, CanFrames):
            p = raw.payload
            rows = zip(p.can_id.tolist(), p.flags.tolist(), p.length.tolist(), p.data, strict=True)
            out += [slcan_frame(i, f, d[:n].tobytes()) for i, f, n, d in rows]
            if len(out) >= count:
                break
    return b"".join(out[:count])


def slcan(data: Path) -> Figures:
    """The CAN port on an slcan adapter: us per frame."""
    from drivers.can_port import CanPort
    from edge_agent.messages import PortSettings

    count = 6000
    with _fed(_slcan_text(data, count)) as path:
        port = CanPort(PortSettings("can", "can", interface="slcan", channel=path, bitrate=500000))
        port.open()
        frames = 0
        start = cpu_ns()
        while frames < count:
            frames += sum(len(p.t_ns) for _, p in port.read())
        used = cpu_ns() - start
        port.close()
    return {"us": used / 1e3 / frames}


def slcan_peer(data: Path) -> Figures:
    """python-can's slcan bus, reading only."""
    import can

    count = 3000
    with _fed(_slcan_text(data, count)) as path:
        bus = can.Bus(interface="slcan", channel=path, bitrate=500000, sleep_after_open=0.0, ignore_config=True)
        frames = 0
        start = cpu_ns()
        while frames < count:
            frames += bus.recv(1.0) is not None
        used = cpu_ns() - start
        bus.shutdown()
    return {"us": used / 1e3 / frames}


# --------------------------------------------------------------------------------------------------------------- NMEA


def _sentences(data: Path, count: int) -> bytes:
    text = b"".join(r.payload for r in _raws(data) if isinstance(r.payload, bytes))
    lines = text.splitlines(keepends=True)
    return b"".join(lines[:count])


def nmea(data: Path) -> Figures:
    """The serial port and the codec, bytes on a pseudo-terminal to fixes: us per sentence."""
    from drivers.nmea_codec import NmeaCodec
    from drivers.serial_port import SerialPort
    from edge_agent.messages import GnssFix, PortSettings

    text = _sentences(data, 4000)
    sentences, last = text.count(b"\n"), len(text)
    with _fed(text) as path:
        port = SerialPort(PortSettings("gnss", "serial", device=path))
        codec = NmeaCodec()
        port.open()
        fixes = size = 0
        start = cpu_ns()
        while size < last:
            for t_ns, data_ in port.read():
                size += len(data_)
                fixes += sum(isinstance(x, GnssFix) for x in codec.feed(t_ns, data_, 0))
        used = cpu_ns() - start
        port.close()
    if fixes < sentences // 3:
        raise SystemExit(f"{fixes} fixes of {sentences} sentences")
    return {"us": used / 1e3 / sentences}


def nmea_peer(data: Path) -> Figures:
    """pyserial's readline and pynmeagps."""
    import serial
    from pynmeagps import NMEAReader

    text = _sentences(data, 1000)
    count = text.count(b"\n")
    with _fed(text) as path:
        port = serial.Serial(path, 115200, timeout=2.0)
        parsed = 0
        start = cpu_ns()
        for _ in range(count):
            message = NMEAReader.parse(port.readline())
            parsed += message.msgID != ""
        used = cpu_ns() - start
        port.close()
    return {"us": used / 1e3 / parsed}


# ---------------------------------------------------------------------------------------------------------- recording


def _torn(folder: Path, data: Path) -> tuple[Path, int]:
    """A file of one-second chunks with raw data, without its end; and how many chunks it has."""
    from edge_agent.recording import topics
    from edge_agent.recording.writer import SegmentWriter

    path = folder / f"torn{os.getpid()}.mcap.part"
    writer = SegmentWriter(path, metadata={"run": "bench"}, attachments={})
    raws = _raws(data)
    shift = raws[-1].t_ns - raws[0].t_ns + S
    flushed = chunks = 0
    for turn in range(4):
        for raw in raws:
            t_ns = raw.t_ns + turn * shift
            writer.add(topics.raw_record(raw, t_ns))
            if t_ns - flushed >= S:
                flushed = t_ns
                writer.flush()
                chunks += 1
    writer.flush()
    writer.abandon()
    with open(path, "r+b") as f:
        f.truncate(path.stat().st_size - 700)
    return path, chunks


def repair(data: Path, out: str) -> Figures:
    """What the start of the agent does with a torn file: us per chunk."""
    from edge_agent.recording.repair import repair as run

    path, chunks = _torn(Path(out), data)
    start = cpu_ns()
    found = run(path)
    used = cpu_ns() - start
    found.path.unlink()
    return {"us": used / 1e3 / chunks}


def reread(data: Path, out: str) -> Figures:
    """mcap's reader over every message of the same file, which is how its own tools recover."""
    from mcap.exceptions import McapError
    from mcap.reader import NonSeekingReader

    path, chunks = _torn(Path(out), data)
    start = cpu_ns()
    try:
        with open(path, "rb") as f:
            for _ in NonSeekingReader(f, validate_crcs=True).iter_messages(log_time_order=False):
                pass
    except (McapError, EOFError):
        pass  # the torn end
    used = cpu_ns() - start
    path.unlink()
    return {"us": used / 1e3 / chunks}


def sizes(data: Path, folder: str) -> Figures:
    """Bytes per CAN frame in the files of `folder`: all of them, and raw CAN alone written again with flushes each
    second."""
    from edge_agent.messages import Record
    from edge_agent.recording import topics
    from edge_agent.recording.reader import read_messages
    from edge_agent.recording.writer import SegmentWriter

    files = sorted(Path(folder).glob("*.mcap"))
    path = Path(folder) / "raw-only.mcap.part"
    writer = SegmentWriter(path, metadata={}, attachments={})
    frames = flushed = 0
    for file in files:
        for m in read_messages(file, {"/raw/can"}):
            frames += len(topics.decode_raw(m.topic, m.schema, m.data).payload.t_ns)
            writer.add(Record(m.topic, m.log_ns, m.publish_ns, m.data, False, m.schema))
            if m.log_ns - flushed >= S:
                flushed = m.log_ns
                writer.flush()
    raw = writer.close()
    return {
        "raw": raw.stat().st_size / frames,
        "all": sum(f.stat().st_size for f in files) / frames,
        "frames": float(frames),
    }


def ages(data: Path, folder: str, puts: str, late: str) -> Figures:
    """Age of each fused sample when it came to the outbox: p50 and p99 in ms, and the share of samples that counted.
    `puts` = times of the blocks' arrival there, in the order of the file; `late` = times at which the sender was late,
    around which an age says something about this machine alone."""
    import numpy as np

    from edge_agent.recording import topics
    from edge_agent.recording.reader import read_messages

    times = json.loads(Path(puts).read_text())
    files = sorted(Path(folder).glob("bench*.mcap"))
    blocks = [
        m for f in files for m in read_messages(f) if m.topic.startswith("/fusion/") and m.topic.endswith("/block")
    ]
    if len(blocks) != len(times):
        raise SystemExit(f"{len(blocks)} blocks in the files, {len(times)} at the outbox")
    taken = [topics.decode_fused_block("p", m.data).t_ns for m in blocks]
    t_ns = np.concatenate(taken)
    age = (np.repeat(times, [len(t) for t in taken]) - t_ns) / 1e6
    good = t_ns > t_ns[0] + 5 * S
    for t in json.loads(late):
        good &= (t_ns < t - S // 2) | (t_ns > t + S)
    if not good.any():
        return {"p50": float("nan"), "p99": float("nan"), "share": 0.0}
    p50, p99 = np.percentile(age[good], (50, 99))
    return {"p50": float(p50), "p99": float(p99), "share": float(good.mean())}


def _family(pid: int) -> list[int]:
    """A process and those that it started."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except OSError:
        children = []
    return [pid, *(p for c in children for p in _family(int(c)))]


def _shared_mib(pid: int) -> float:
    """Resident memory, pages that several processes share counted once between them."""
    try:
        rollup = Path(f"/proc/{pid}/smaps_rollup").read_text()
    except OSError:  # it has ended
        return 0.0
    return next((int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:")), 0) / 1024


def review(_: Path, folder: str, out: str) -> Figures:
    """`edge-agent review FOLDER` as people call it: seconds by the clock and of processors, the most memory that all of
    its processes had together (looked at five times a second)."""
    import resource
    import subprocess

    begin, most = time.monotonic(), 0.0
    command = [sys.executable, "-m", "edge_agent", "review", folder, "-o", out]
    p = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    while p.poll() is None:
        most = max(most, sum(_shared_mib(k) for k in _family(p.pid)))
        time.sleep(0.2)
    if p.returncode:
        raise SystemExit(f"review ended with {p.returncode}")
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"wall": time.monotonic() - begin, "cpu": used.ru_utime + used.ru_stime, "mib": most}


# --------------------------------------------------------------------------------------------------------------- live


def imports(data: Path) -> Figures:
    """The agent's libraries alone: CPU in ms from the interpreter's start, resident MiB."""
    import can  # noqa: F401
    import cantools  # noqa: F401
    import mcap.writer  # noqa: F401
    import numpy  # noqa: F401
    import serial  # noqa: F401
    import yaml  # noqa: F401

    return {"ms": cpu_ns() / 1e6, "mib": _rss_mib(os.getpid())}


def _rss_mib(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def agent(config: Path, fd: str, puts: str) -> Figures:
    """`edge-agent run` with the CAN bus on the UDP socket `fd`; writes when each fused block came to the outbox."""
    import signal
    import socket

    from edge_agent import __main__ as program
    from edge_agent import queues

    times: list[int] = []
    put = queues.ByteQueue.put

    def noted(self: Any, item: Any, *args: Any) -> bool:
        topic = getattr(item, "topic", "")
        if topic.endswith("/block") and topic.startswith("/fusion/"):
            times.append(time.monotonic_ns())
        return put(self, item, *args)

    queues.ByteQueue.put = noted  # type: ignore[method-assign]
    sock = socket.socket(fileno=int(fd))

    class Bus:
        def __init__(self, **_: Any) -> None:
            self.socket = sock

        def shutdown(self) -> None:
            sock.close()

    import can

    can.Bus = Bus  # type: ignore[assignment,misc]
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    code = program.main(["run", "-c", str(config)])
    Path(puts).write_text(json.dumps(times))
    return {"exit": float(code or 0)}


def notifier(_: Path, fd: str) -> Figures:
    """python-can's Notifier that only reads, until SIGTERM."""
    import signal
    import socket
    import threading

    import can

    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    count = [0]

    def listener(message: can.Message) -> None:
        count[0] += 1

    bus = _udp_bus(socket.socket(fileno=int(fd)))
    reading = can.Notifier(bus, [listener])
    stop.wait()
    reading.stop()
    bus.shutdown()
    return {"frames": float(count[0])}


def sender(plan: Path, master: str, *addresses: str) -> dict[str, Any]:
    """Plays a plan in real time: frames to every UDP address, sentences to the pseudo-terminal. `late`: when it was
    behind by more than 20 ms."""
    import socket

    import numpy as np

    with np.load(plan) as z:
        times, kinds, lengths, blob = (z[k] for k in ("t_ns", "kind", "length", "blob"))
    ends = np.cumsum(lengths)
    events = list(zip(times.tolist(), kinds.tolist(), (ends - lengths).tolist(), ends.tolist(), strict=True))
    blob = blob.tobytes()
    sockets = []
    for address in addresses:
        s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        s.connect(("127.0.0.1", int(address)))
        s.setblocking(False)
        sockets.append(s)
    fd = int(master)
    os.set_blocking(fd, False)
    refused = 0
    late: list[int] = []
    for t_ns, kind, lo, hi in events:
        wait = t_ns - time.monotonic_ns()
        if wait > 0:
            time.sleep(wait / S)
        elif wait < -20_000_000 and (not late or t_ns - late[-1] > S // 10):
            late.append(t_ns)
        part = blob[lo:hi]
        try:
            if kind:
                os.write(fd, part)
            else:
                for s in sockets:
                    s.send(part)
        except (BlockingIOError, ConnectionRefusedError):
            refused += 1
    return {"late": late, "refused": refused}


TASKS: dict[str, Callable[..., dict[str, Any]]] = {
    "filter": filter_,
    "pipeline": pipeline,
    "replay": replay,
    "rts": rts,
    "burst": burst,
    "burst_peer": burst_peer,
    "slcan": slcan,
    "slcan_peer": slcan_peer,
    "nmea": nmea,
    "nmea_peer": nmea_peer,
    "repair": repair,
    "reread": reread,
    "sizes": sizes,
    "ages": ages,
    "review": review,
    "imports": imports,
    "agent": agent,
    "notifier": notifier,
    "sender": sender,
}


def main(name: str, data: str, *args: str) -> None:
    task = TASKS.get(name)
    if task is None:
        import peers

        task = peers.TASKS[name]
    print(json.dumps(task(Path(data), *args)))


if __name__ == "__main__":
    main(*sys.argv[1:])
