"""What the running agent says of itself: gathers a `Status` at each Tick and has it written beside the data path.

`Observer` is shown every value of the pipeline (its `tap`) and keeps the last of each and counts, so that a Tick costs
little. `Publisher` is a thread of its own that writes status.json and edge-agent.prom, each by a rename over the one
before: a folder that does not answer holds up neither main nor the writer, and a stalled writer does not hold up the
status, which is when it is wanted. Only the newest status waits; a failure to write is told once, and the agent goes
on.
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from edge_agent import messages as m
from edge_agent import status as st
from edge_agent.fusion.gate import quantile
from edge_agent.pipeline import Pipeline, Seen

RATE_TICKS = 10  # rates are over the last 10 s
TEXT_MOST = 200  # characters of an event's text
JUDGED = (m.Verdict.ACCEPTED, m.Verdict.REJECTED, m.Verdict.OFFSET)
"""Verdicts that come from the gate: their Innovation has a residual and its variance."""


class Observer:
    """Last values and counts of one run. Main's thread only."""

    def __init__(self, config: m.Config, pipeline: Pipeline) -> None:
        self.config, self.pipeline = config, pipeline
        self.rejects: dict[str, Counter[str]] = {n: Counter() for n in (*config.receivers, *config.accelerometers)}
        self._estimates: dict[str, m.Estimate] = {}
        self._judged: dict[str, m.Innovation] = {}  # with a residual
        self._verdicts: dict[str, Counter[str]] = {n: Counter() for n in config.points}
        self._fixes: dict[str, m.GnssFix] = {}
        self._headings: dict[str, m.HeadingEstimate] = {}
        self._blocks: dict[str, m.AccelBlock] = {}
        self._flags: dict[str, int] = {}  # of samples since the Tick before
        self._faults: Counter[str] = Counter()
        self._events: dict[tuple[str, str], st.Happening] = {}  # (kind, source), in the order of the last one
        self._losses: dict[tuple[str, str], tuple[int, int]] = {}  # (where, source) -> count, t_ns of the last
        self._states: dict[str, tuple[str, int]] = {}  # port -> state, since
        self._ports_seen: dict[str, tuple[int, int]] = {}  # port -> bytes, t_ns of the last that came
        self._began_ns = 0
        self._counts: deque[tuple[int, dict[str, int]]] = deque(maxlen=RATE_TICKS + 1)
        self._cpu: deque[tuple[float, float]] = deque(maxlen=RATE_TICKS + 1)  # real time, CPU time [s]
        self._limit = quantile(config.fusion.gate_alpha, 3)
        pipeline.tap = self.take

    # -------------------------------------------------------------------------------------------------- what is shown

    def take(self, name: str, value: Seen) -> None:
        """The pipeline's tap."""
        if isinstance(value, m.Estimate):
            self._estimates[name] = value
        elif isinstance(value, m.AccelBlock):
            self._blocks[name] = value
            self._flags[name] = self._flags.get(name, 0) | int(np.bitwise_or.reduce(value.flags))
        elif isinstance(value, m.GnssFix):
            self._fixes[name] = value
        elif isinstance(value, m.Innovation):
            self._verdicts[name][value.verdict.name] += 1
            if value.verdict in JUDGED:
                self._judged[name] = value
        elif isinstance(value, m.HeadingEstimate):
            self._headings[name] = value
        elif isinstance(value, m.Reject):
            self.rejects[name][value.reason] += value.count
        else:
            self._happened(value.kind, value.source, value.text, value.t_ns, False)

    def fault(self, fault: m.Fault) -> None:
        self._faults[fault.kind] += 1
        self._happened(fault.kind, fault.source, fault.text, fault.t_ns, True)

    def loss(self, where: str, source: str, count: int, t_ns: int) -> None:
        self._losses[where, source] = self._losses.get((where, source), (0, 0))[0] + count, t_ns

    def _happened(self, kind: str, source: str, text: str, t_ns: int, fault: bool) -> None:
        before = self._events.pop((kind, source), None)
        times = 1 if before is None else before.times + 1
        utc = self.pipeline.to_utc(t_ns)
        self._events[kind, source] = st.Happening(utc, kind, source, text[:TEXT_MOST], fault, times)
        if len(self._events) > 4 * st.EVENTS:
            del self._events[next(iter(self._events))]

    # ------------------------------------------------------------------------------------------------------- the tree

    def status(
        self,
        t_ns: int,
        utc_ns: int,
        run: tuple[str, str, str],
        ports: Sequence[st.Port],
        queues: Sequence[st.Queue],
        disk: st.Disk,
    ) -> st.Status:
        """The tree at a Tick. `run` = run id, version, state."""
        self._began_ns = self._began_ns or t_ns
        counters = self.pipeline.counters()
        rates = self._rates(t_ns, counters)
        wall = self.pipeline.wall
        shift = 0 if wall.offset_ns is None else wall.offset_ns - self.pipeline.to_utc(0)
        config = self.config
        newest = sorted(self._events.values(), key=lambda e: e.utc_ns)[-st.EVENTS :]
        made = st.Status(
            st.FORMAT,
            config.site,
            run[1],
            run[0],
            run[2],
            utc_ns,
            (t_ns - self._began_ns) / m.S,
            tuple(self._point(t_ns, p) for p in config.points.values()),
            tuple(self._receiver(t_ns, r, counters[r.name], rates) for r in config.receivers.values()),
            tuple(self._accelerometer(t_ns, a, counters[a.name], rates) for a in config.accelerometers.values()),
            tuple(ports),
            tuple(queues),
            tuple(st.Loss(w, s, n, (t_ns - t) / m.S) for (w, s), (n, t) in self._losses.items()),
            st.Clock(wall.sync, wall.error_ns / m.S, shift / m.S),
            disk,
            self._process(),
            _counts(self._faults),
            tuple(newest),
        )
        self._flags.clear()
        return made

    def port_state(self, name: str, state: str, t_ns: int) -> float:
        """Seconds that the port has been in this state."""
        if self._states.get(name, ("", 0))[0] != state:
            self._states[name] = state, t_ns
        return (t_ns - self._states[name][1]) / m.S

    def port_flow(self, name: str, count: int, t_ns: int) -> tuple[float | None, float | None]:
        """(age of the last bytes in s, to a second; bytes a second since the Tick before) of a port."""
        before = self._ports_seen.get(name)
        if before is None or before[0] != count:
            self._ports_seen[name] = count, t_ns
        age = None if not count else (t_ns - self._ports_seen[name][1]) / m.S
        key = f"port {name}"
        old = next(((t, c[key]) for t, c in self._counts if key in c), None)
        return age, None if old is None or old[0] >= t_ns else (count - old[1]) * m.S / (t_ns - old[0])

    def _rates(self, t_ns: int, counters: Mapping[str, Mapping[str, int]]) -> dict[str, float]:
        """Fixes and samples a second by receiver and accelerometer, over the last Ticks."""
        now = {n: counters[n].get("fixes", counters[n].get("samples", 0)) for n in counters}
        for name, (count, _) in self._ports_seen.items():
            now[f"port {name}"] = count
        self._counts.append((t_ns, now))
        rates = {}
        for name, count in now.items():  # since the first Tick of the window by which anything had come
            then = next(((t, c[name]) for t, c in self._counts if c.get(name)), (t_ns, count))
            if then[0] < t_ns:
                rates[name] = (count - then[1]) * m.S / (t_ns - then[0])
        return rates

    def _point(self, t_ns: int, p: m.PointSettings) -> st.Point:
        e = self._estimates.get(p.name)
        if e is None:
            mode, flags, age = m.Mode.INIT, 0, None
            numbers: tuple[st.Triple, st.Triple, st.Triple, st.Triple] = ((), (), (), ())
        else:
            mode, flags = m.Mode(int(e.mode[-1])), int(e.flags[-1])
            age = (t_ns - int(e.t_ns[-1])) / m.S
            numbers = (
                _three(e.displacement_m[-1]),
                _three(e.std_displacement_m[-1]),
                _three(e.velocity_mps[-1]),
                _three(e.std_velocity_mps[-1]),
            )
        valid = mode in m.VALID_MODES and age is not None and age <= st.STALE_S
        words = tuple(str(f.name) for f in m.FusionFlag if flags & f)
        return st.Point(
            p.name, p.receiver, p.accelerometer, mode.name, valid, words, age, *numbers, self._gate(t_ns, p)
        )

    def _gate(self, t_ns: int, p: m.PointSettings) -> st.Gate | None:
        judged = self._judged.get(p.name)
        if judged is None or p.receiver is None:
            return None
        # one axis alone off by s is refused when s^2 / S > limit
        step = tuple(math.sqrt(self._limit * float(judged.variance_m2[i, i])) for i in range(3))
        age = (t_ns - judged.t_ns) / m.S
        return st.Gate(judged.verdict.name, age, float(judged.ratio), step, _counts(self._verdicts[p.name]))

    def _receiver(
        self, t_ns: int, r: m.ReceiverSettings, counters: Mapping[str, int], rates: Mapping[str, float]
    ) -> st.Receiver:
        fix = self._fixes.get(r.name)
        heading = self._headings.get(r.name)
        started = heading is not None and math.isfinite(heading.heading_deg)
        clock = self.pipeline.receivers[r.name].clock
        known = "configured" if clock.fixed_ns is not None else "learned" if clock.learned_ns is not None else "assumed"
        return st.Receiver(
            r.name,
            r.port,
            m.Quality.NONE.name if fix is None else fix.quality.name,
            0 if fix is None else fix.satellites,
            None if fix is None or math.isnan(fix.hdop) else fix.hdop,
            None if fix is None else (t_ns - fix.arrival_ns) / m.S,
            None if fix is None else (fix.arrival_ns - fix.t_ns) / m.S,
            known,
            rates.get(r.name),
            counters.get("fixes", 0),
            counters.get("positions", 0),
            counters.get("accepted", 0),
            heading.heading_deg if heading and started else None,
            heading.std_deg if heading and started else None,
            (t_ns - heading.t_ns) / m.S if heading and started else None,
            _counts(self.rejects[r.name]),
        )

    def _accelerometer(
        self, t_ns: int, a: m.AccelerometerSettings, counters: Mapping[str, int], rates: Mapping[str, float]
    ) -> st.Accelerometer:
        block = self._blocks.get(a.name)
        clock = self.pipeline.accelerometers[a.name].clock
        learned = [p.nominal_ns for p in self.pipeline.station.points if p.accelerometer == a.name and p.nominal_ns]
        expected = a.rate_hz or (m.S / learned[0] if learned else None)
        error = clock.rate_error
        flags = self._flags.get(a.name, 0)
        return st.Accelerometer(
            a.name,
            a.port,
            rates.get(a.name),
            expected,
            None if block is None else (t_ns - int(block.t_ns[-1])) / m.S,
            counters.get("samples", 0),
            counters.get("lost", 0),
            counters.get("gaps", 0),
            tuple(str(f.name) for f in m.AccelFlag if flags & f and f != m.AccelFlag.FITTED),
            None if error is None else error * 1e6,
            _counts(self.rejects[a.name]),
        )

    def _process(self) -> st.Process:
        self._cpu.append((time.monotonic(), time.process_time()))
        (t0, c0), (t1, c1) = self._cpu[0], self._cpu[-1]
        share = (c1 - c0) / (t1 - t0) if t1 - t0 > 0.5 else None
        return st.Process(os.getpid(), resident_bytes(), c1, share, threading.active_count())


def _counts(counter: Counter[str]) -> tuple[st.Count, ...]:
    return tuple(st.Count(name, count) for name, count in sorted(counter.items()))


def _three(row: m.F64) -> tuple[float, ...]:
    return tuple(float(v) for v in row)


def resident_bytes() -> int:
    """Resident memory of this process; 0 where /proc does not say."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError, ValueError):
        return 0


class Publisher(threading.Thread):
    """Writes the newest status that it is offered into `folder`, as JSON and as Prometheus text."""

    def __init__(self, folder: Path) -> None:
        super().__init__(name="status", daemon=True)
        self.folder = folder
        self.error = ""  # why the last one could not be written
        self.failed = 0  # how many could not
        self.written = 0
        self.attempts = 0
        self.failure: BaseException | None = None
        self._next: st.Status | None = None
        self._change = threading.Condition()
        self._closed = False

    def offer(self, status: st.Status) -> None:
        """To be written soon, unless a newer one comes before."""
        with self._change:
            self._next = status
            self._change.notify()

    def close(self, patience_s: float = 2.0) -> None:
        """Write what was offered last and end; a folder that hangs is left to hang."""
        with self._change:
            self._closed = True
            self._change.notify()
        if self.ident is not None:
            self.join(patience_s)

    def run(self) -> None:
        try:
            while self._once():
                pass
        except BaseException as e:  # noqa: BLE001 - main raises it and ends the process
            self.failure = e

    def _once(self) -> bool:
        with self._change:
            while self._next is None and not self._closed:
                self._change.wait()
            status, self._next = self._next, None
        if status is None:
            return False
        self.attempts += 1
        try:
            replace(self.folder / st.NAME, st.to_json(status))
            replace(self.folder / st.METRICS, st.to_prometheus(status))
            self.error = ""
            self.written += 1
        except OSError as e:
            self.error = f"{e.filename or self.folder}: {e.strerror or e}"
            self.failed += 1
        return True


def replace(path: Path, text: str) -> None:
    """Put a whole new file in the place of `path`, so that a reader finds the old one or the new one. OSError."""
    data = text.encode("utf-8", "backslashreplace")  # an error's text may hold what is no character
    temporary = path.with_name(f".{path.name}.new")
    try:
        try:
            temporary.write_bytes(data)
        except FileNotFoundError:
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError:
        with suppress(OSError):
            temporary.unlink()
        raise
