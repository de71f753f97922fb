"""THE data path, top to bottom: raw -> decode -> time -> fuse -> records.

`Pipeline.step(raw)` takes what a port read and returns the records that it causes, the raw record itself first. It is
pure: no clock, no I/O, no randomness; live and replay call the same `step`, so the same raw bytes give the same fused
bytes. Everything that `step` depends on is in `save()`.

    Raw --- Tick ------> WallMap --------------------------------------------> CLOCK events, rotation asked for
     |----- bytes -----> NmeaCodec --> FixClock ---> Frame, R rule --> Station.fix ----------|
     |                           `--> its time ----> HeadingFilter --------------------------|
     `----- CanFrames -> AccelCodec -> DeviceClock ------------------> Station.accelerations -+-> Records

Left out: queues, files and faults (runtime), reading recordings back (replay).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Protocol, TypeAlias

from edge_agent import messages as m
from edge_agent.fusion import noise
from edge_agent.fusion.heading import HeadingFilter
from edge_agent.fusion.station import Station
from edge_agent.geodesy import Frame
from edge_agent.recording import topics
from edge_agent.state import pack, unpack
from edge_agent.timebase import STEP_NS, DeviceClock, FixClock, WallMap, with_times
from edge_agent.triggers import Triggers

STATE_VERSION = 2
SLOW_VERSION = 1
"""Of what outlives a run, which a newer program must still adopt: else an update would move the zero."""
FOLD_NS = m.S
"""Repeats of one Reject within this much Raw time become one record with a count."""

RANK = {m.Quality.FIXED: 3, m.Quality.FLOAT: 2, m.Quality.DGNSS: 1, m.Quality.SINGLE: 1, m.Quality.PPS: 1}
"""How good a solution is: GGA's numbers are not in that order. Dead reckoning and simulated are no measurement."""


class SerialCodec(Protocol):
    counters: dict[str, int]

    @property
    def waiting(self) -> int: ...
    def feed(
        self, t_ns: int, data: bytes, utc_hint_ns: int
    ) -> list[m.GnssFix | m.GnssHeading | m.Reject | m.Event]: ...
    def save(self) -> m.State: ...
    def load(self, s: m.State) -> None: ...


class FrameCodec(Protocol):
    counters: dict[str, int]

    def feed(self, frames: m.CanFrames) -> tuple[m.AccelBlock | None, list[m.Reject | m.Event]]: ...
    def silent(self, now_ns: int) -> list[m.Event]: ...
    def save(self) -> m.State: ...
    def load(self, s: m.State) -> None: ...


class Receiver:
    """What the path keeps for one GNSS receiver."""

    def __init__(self, settings: m.ReceiverSettings, config: m.Config, codec: SerialCodec) -> None:
        structure = config.structure
        self.settings = settings
        self.codec = codec
        self.clock = FixClock(settings.latency_ms)
        self.heading = HeadingFilter(settings.name, config.fusion) if settings.heading else None
        self.azimuth_deg = structure.azimuth_deg
        self.reference = structure.reference_llh
        self.frame = None if self.reference is None else Frame(self.reference, self.azimuth_deg)
        self.provisional = False  # the frame stands at the first fixed epoch until the start window's median is known

    def refer_to(self, llh: tuple[float, float, float], provisional: bool) -> None:
        self.reference, self.provisional = llh, provisional
        self.frame = Frame(llh, self.azimuth_deg)


class Accelerometer:
    """What the path keeps for one accelerometer."""

    def __init__(self, settings: m.AccelerometerSettings, codec: FrameCodec) -> None:
        self.settings = settings
        self.codec = codec
        self.clock = DeviceClock(settings.rate_hz, settings.counter is not None or settings.sync is not None)


Seen: TypeAlias = m.GnssFix | m.HeadingEstimate | m.AccelBlock | m.Estimate | m.Innovation | m.Event | m.Reject


class Pipeline:
    """The data path for one configuration. `rotate_due` holds the reason when a new segment must begin (clock step).

    `tap(name, value)` is shown every decoded and fused value by the name of its receiver, accelerometer or point, for
    those who watch the path while it runs; nothing comes back from it.
    """

    def __init__(
        self,
        config: m.Config,
        serial_codecs: Mapping[str, SerialCodec],
        frame_codecs: Mapping[str, FrameCodec],
    ) -> None:
        self.config = config
        self.receivers = {k: Receiver(s, config, serial_codecs[k]) for k, s in config.receivers.items()}
        self.accelerometers = {k: Accelerometer(s, frame_codecs[k]) for k, s in config.accelerometers.items()}
        unset = frozenset(k for k, r in self.receivers.items() if r.reference is None)
        self.station = Station(list(config.points.values()), config.fusion, unset)
        self.triggers = Triggers(config.triggers.values(), config.events, config.points)
        self.tap: Callable[[str, Seen], None] = lambda name, value: None
        self.wall = WallMap()
        self.order = 0  # of the next Raw
        self.rotate_due: str | None = None
        self._fingerprint = fingerprint(config)
        self._offset = 0  # the segment's map, UTC - monotonic
        self._log = 0  # log_time of the record before
        self._now = 0
        self._published: dict[str, int] = {}  # topic -> publish_time of its last record
        self._view_cell: dict[str, int] = {}  # topic -> last cell of the view grid that has a sample
        self._folded: dict[tuple[str, str], m.Reject] = {}
        self._folded_since: dict[tuple[str, str], int] = {}
        self._pending_events: list[m.Event] = []

    # ------------------------------------------------------------------------------------------------------- the path

    def step(self, raw: m.Raw) -> list[m.Record]:
        """Take one Raw; return its record and every record that it causes, in the order of cause."""
        self.order = raw.order + 1
        self._now = raw.t_ns
        out: list[m.Record] = []
        if isinstance(raw.payload, m.Tick):
            self._tick(raw.t_ns, raw.payload)
        self._log = max(self._log, raw.t_ns + self._offset)
        out.append(topics.raw_record(raw, self._log))
        if not isinstance(raw.payload, m.Tick):  # Ticks may come before there is a file that keeps events
            for event in self._drain_events():
                self._event(out, event if event.t_ns else replace(event, t_ns=raw.t_ns))  # adopted before any time
            if isinstance(raw.payload, m.CanFrames):
                self._can(out, raw, raw.payload)
            else:
                self._serial(out, raw, raw.payload)
        self._fused(out, self.station.advance(raw.t_ns))
        for event in self.triggers.expire(raw.t_ns):
            self._event(out, event)
        self._unfold(out, raw.t_ns)
        return out

    def finish(self) -> list[m.Record]:
        """Records that wait only for time to go on (folded Rejects); call once, when no Raw will follow."""
        out: list[m.Record] = []
        self._unfold(out, self._now + 2 * FOLD_NS)
        return out

    def _tick(self, t_ns: int, tick: m.Tick) -> None:
        for name, accelerometer in self.accelerometers.items():
            self._pending_events += [replace(e, source=name) for e in accelerometer.codec.silent(t_ns)]
        self.wall.tick(t_ns, tick)
        offset = self.wall.offset_ns
        if offset is None:
            return
        if self.order == 1:  # nothing has been written by another map
            self._offset = offset
        away = offset - self._offset
        if abs(away) > STEP_NS and not self.rotate_due:
            self.rotate_due = "clock"
            text = f"wall clock moved by {away / m.S:+.3f} s against the file's map; the estimate goes on in a new file"
            values = (("step_s", away / m.S), ("sync", float(tick.sync)))
            self._pending_events.append(m.Event(t_ns, "CLOCK_STEP", "clock", text, values))

    def _serial(self, out: list[m.Record], raw: m.Raw, data: bytes) -> None:
        hint = 0 if self.wall.offset_ns is None else raw.t_ns + self.wall.offset_ns
        for name, receiver in self.receivers.items():
            if receiver.settings.port != raw.source:
                continue
            for item in receiver.codec.feed(raw.t_ns, data, hint):
                if isinstance(item, m.GnssFix):
                    self._fix(out, name, receiver, item)
                elif isinstance(item, m.GnssHeading):
                    self._heading(out, name, receiver, item)
                elif isinstance(item, m.Reject):
                    self._reject(out, replace(item, source=name))
                else:
                    self._event(out, replace(item, source=name))

    def _fix(self, out: list[m.Record], name: str, receiver: Receiver, fix: m.GnssFix) -> None:
        t_ns, uncertain, step = receiver.clock.time(fix, self.wall)
        fix = replace(fix, t_ns=t_ns)
        self.tap(name, fix)
        if step:
            text = f"the receiver's time moved by {step / m.S:+.3f} s; fix times follow arrival until it holds"
            self._event(out, m.Event(t_ns, "GNSS_TIME_STEP", name, text, (("step_s", step / m.S),)))
        located = not (math.isnan(fix.lat_deg) or math.isnan(fix.lon_deg) or math.isnan(fix.h_m))
        if receiver.frame is None and located and fix.quality == m.Quality.FIXED:
            receiver.refer_to((fix.lat_deg, fix.lon_deg, fix.h_m), provisional=True)
        enu = z = (math.nan, math.nan, math.nan)
        if receiver.frame is not None and located:
            enu = receiver.frame.enu(fix.lat_deg, fix.lon_deg, fix.h_m)
            z = receiver.frame.to_structure(enu)
        latency = fix.arrival_ns - t_ns
        self._put(out, f"/gnss/{name}/fix", t_ns, lambda s: topics.navsatfix(fix, s, name))
        self._put(out, f"/gnss/{name}/solution", t_ns, lambda s: topics.gnss_solution(fix, s, enu, latency, name))
        if receiver.frame is None:
            return  # nothing to measure from yet: the first fixed epoch will be the place
        std = noise.fix_std(
            fix.quality,
            fix.std_enu_m,
            fix.hdop,
            fix.vdop,
            fix.age_s,
            fix.resolution_enu_m,
            receiver.settings.sigma_floor_m,
        )
        good = located and RANK.get(fix.quality, 0) >= RANK.get(receiver.settings.min_quality, 1)
        measurement = m.Measurement(
            t_ns,
            fix.arrival_ns,
            z,
            receiver.frame.std_to_structure(std),
            fix.quality if good else m.Quality.NONE,
            uncertain,
        )
        self._fused(out, self.station.fix(name, measurement, self._now))

    def _heading(self, out: list[m.Record], name: str, receiver: Receiver, seen: m.GnssHeading) -> None:
        """A heading goes to its own filter and to the topics of the receiver's points, never into a position."""
        if receiver.heading is None:
            return
        seen = replace(seen, t_ns=receiver.clock.time_of(seen.utc_ns, seen.arrival_ns))
        good = RANK.get(seen.quality, 0) >= RANK.get(receiver.settings.min_quality, 1)
        for item in receiver.heading.update(seen, good):
            if isinstance(item, m.Event):
                self._event(out, item)
                continue
            self.tap(name, item)
            for point in self.config.points.values():
                if point.receiver == name:
                    self._put(out, f"/fusion/{point.name}/heading", item.t_ns, partial(topics.heading, item))

    def _can(self, out: list[m.Record], raw: m.Raw, frames: m.CanFrames) -> None:
        blocks: dict[str, m.AccelBlock] = {}
        for name, accelerometer in self.accelerometers.items():
            if accelerometer.settings.port != raw.source:
                continue
            block, remarks = accelerometer.codec.feed(frames)
            for item in remarks:
                if isinstance(item, m.Reject):
                    self._reject(out, replace(item, source=name))
                else:
                    self._event(out, replace(item, source=name))
            if block is None or not block.t_ns.size:
                continue
            t_ns, gap = accelerometer.clock.times(block)
            blocks[name] = with_times(block, t_ns, t_ns is not block.t_ns, gap)
        for name, block in blocks.items():
            self.tap(name, block)
            self._accel(out, name, block)
            for event in self.triggers.accelerations(name, block):
                self._event(out, event)
        if blocks:
            self._fused(out, self.station.accelerations(blocks, raw.t_ns))

    # ------------------------------------------------------------------------------------------------------- records

    def _accel(self, out: list[m.Record], name: str, block: m.AccelBlock) -> None:
        topic = f"/accel/{name}"
        if self.config.record.accel_block:
            self._put(out, topic + "/block", int(block.t_ns[0]), partial(topics.accel_block, block))
        for i in self._view(topic, block.t_ns):
            seen = partial(topics.accel, int(block.count[i]), block.xyz[i], int(block.flags[i]))
            self._put(out, topic, int(block.t_ns[i]), seen)

    def _fused(self, out: list[m.Record], items: Iterable[m.Estimate | m.Innovation | m.Event]) -> None:
        for item in items:
            if isinstance(item, m.Estimate):
                self.tap(item.point, item)
                topic = f"/fusion/{item.point}"
                self._put(out, topic + "/block", int(item.t_ns[0]), partial(topics.fused_block, item))
                for i in self._view(topic, item.t_ns):
                    self._put(out, topic + "/state", int(item.t_ns[i]), partial(topics.fused_state, item, i))
                for event in self.triggers.estimate(item):
                    self._event(out, event)
            elif isinstance(item, m.Innovation):
                self.tap(item.point, item)
                self._put(out, f"/fusion/{item.point}/update", item.t_ns, partial(topics.fusion_update, item))
            else:
                self._event(out, item)
                if item.kind == "REFERENCE":
                    self._place(item.source)

    def _place(self, name: str) -> None:
        """The start window's median is known: it is the zero from now on, in files and after a restart."""
        receiver = self.receivers[name]
        datum = self.station.datum(name)
        if receiver.provisional and receiver.frame is not None and datum is not None:
            receiver.reference = receiver.frame.geodetic(receiver.frame.to_enu(datum))
            receiver.provisional = False

    def _view(self, topic: str, t_ns: m.I64) -> list[int]:
        """Indices of the samples for eyes: the first in each cell of a 1 / view_hz grid."""
        if self.config.record.view_hz <= 0:
            return []
        cell = t_ns // int(m.S / self.config.record.view_hz)
        before = self._view_cell.get(topic, -1)
        cells = cell.tolist()
        self._view_cell[topic] = cells[-1]
        return [i for i, (a, b) in enumerate(zip([before, *cells], cells, strict=False)) if b > a]

    def _put(self, out: list[m.Record], topic: str, t_ns: int, encode: Callable[[int], bytes]) -> None:
        """A derived record: log_time = that of its cause, publish_time = measurement time; neither steps back."""
        publish = min(self._log, max(t_ns + self._offset, self._published.get(topic, 0)))
        self._published[topic] = publish
        out.append(m.Record(topic, self._log, publish, encode(publish), True))

    def _event(self, out: list[m.Record], e: m.Event) -> None:
        self.tap(e.source, e)
        begin = e.begin_ns + self._offset if e.begin_ns else None
        end = e.end_ns + self._offset if e.end_ns else None
        self._put(
            out,
            "/events",
            e.t_ns,
            lambda s: topics.event(e.kind, e.source, e.text, e.values, e.t_ns, s, begin, end),
        )

    def _reject(self, out: list[m.Record], reject: m.Reject) -> None:
        self.tap(reject.source, reject)
        key = (reject.source, reject.reason)
        held = self._folded.get(key)
        if held is None:
            self._folded[key], self._folded_since[key] = reject, self._now
        else:
            self._folded[key] = replace(held, count=held.count + reject.count)

    def _unfold(self, out: list[m.Record], now_ns: int) -> None:
        for key in [k for k, t in self._folded_since.items() if now_ns - t >= FOLD_NS]:
            r = self._folded.pop(key)
            begin = self._folded_since.pop(key)
            text = f"{r.reason}: {r.detail}"
            values = (("count", float(r.count)),)
            self._event(out, m.Event(r.t_ns, "REJECT", r.source, text, values, begin, self._now))

    def _drain_events(self) -> list[m.Event]:
        events, self._pending_events = self._pending_events, []
        return events

    # --------------------------------------------------------------------------------------------- state and segments

    def rotate(self, reason: str, t_ns: int) -> m.Rotate:
        """Close the segment: take the wall clock's map as the next segment's and return the order with a checkpoint.

        `t_ns` is that of the Raw which will be stepped next. Replay calls it where the recording holds a checkpoint, so
        the map changes at the same place.
        """
        if self.wall.offset_ns is not None:
            if abs(self.wall.offset_ns - self._offset) > STEP_NS:
                self._published = {}
                self._log = 0
            self._offset = self.wall.offset_ns
        self.rotate_due = None
        self._log = max(self._log, t_ns + self._offset)
        data = topics.checkpoint(self.order, t_ns, t_ns + self._offset, self.save(), reason)
        return m.Rotate(
            m.Record("/raw/checkpoint", self._log, self._log, data, False), self._log, reason, self.wall.sync
        )

    @property
    def segment_utc_ns(self) -> int:
        """UTC by the segment's map at the last step: what decides on rotation by time."""
        return self._log

    def to_utc(self, t_ns: int) -> int:
        """UTC of a monotonic instant by the segment's map."""
        return t_ns + self._offset

    def save(self) -> bytes:
        """Everything that `step` depends on."""
        return pack(
            {
                "version": STATE_VERSION,
                "config": self._fingerprint,
                "order": self.order,
                "offset": self._offset,
                "log": self._log,
                "now": self._now,
                "rotate_due": self.rotate_due,
                "wall": self.wall.save(),
                "published": self._published,
                "view": self._view_cell,
                "folded": [
                    [r.t_ns, r.source, r.reason, r.detail, r.count, self._folded_since[k]]
                    for k, r in self._folded.items()
                ],
                "pending": [
                    [e.t_ns, e.kind, e.source, e.text, [list(v) for v in e.values], e.begin_ns, e.end_ns]
                    for e in self._pending_events
                ],
                "receivers": {
                    k: {
                        "codec": r.codec.save(),
                        "clock": r.clock.save(),
                        "frame": None if r.frame is None else list(r.frame.reference_llh),
                        "reference": None if r.reference is None else list(r.reference),
                        "provisional": r.provisional,
                        "heading": None if r.heading is None else r.heading.save(),
                    }
                    for k, r in self.receivers.items()
                },
                "accelerometers": {
                    k: {"codec": a.codec.save(), "clock": a.clock.save()} for k, a in self.accelerometers.items()
                },
                "station": self.station.save(),
                "triggers": self.triggers.save(),
            }
        )

    def load(self, data: bytes) -> None:
        """Go on from a checkpoint. Raises ValueError if it is damaged or was made with other settings."""
        s = unpack(data)
        if not isinstance(s, dict) or s.get("version") != STATE_VERSION:
            raise ValueError(f"checkpoint: version {STATE_VERSION} expected")
        if s.get("config") != self._fingerprint:
            raise ValueError("checkpoint: made with other settings of ports, sensors, points or fusion")
        try:
            self._load(s)
        except (AttributeError, IndexError, KeyError, OverflowError, TypeError) as e:
            raise ValueError(f"checkpoint: damaged ({type(e).__name__}: {e})") from None

    def _load(self, s: m.State) -> None:
        self.order, self._offset, self._log, self._now = s["order"], s["offset"], s["log"], s["now"]
        self.rotate_due = s["rotate_due"]
        self.wall.load(s["wall"])
        self._published, self._view_cell = dict(s["published"]), dict(s["view"])
        self._folded, self._folded_since = {}, {}
        for t, source, reason, detail, count, since in s["folded"]:
            self._folded[source, reason] = m.Reject(t, source, reason, detail, count)
            self._folded_since[source, reason] = since
        self._pending_events = [
            m.Event(t, kind, source, text, tuple((n, v) for n, v in values), begin, end)
            for t, kind, source, text, values, begin, end in s["pending"]
        ]
        for k, r in self.receivers.items():
            state = s["receivers"][k]
            r.codec.load(state["codec"])
            r.clock.load(state["clock"])
            r.frame = None if state["frame"] is None else Frame(tuple(state["frame"]), r.azimuth_deg)
            r.reference = None if state["reference"] is None else tuple(state["reference"])
            r.provisional = state["provisional"]
            if r.heading is not None:
                r.heading.load(state["heading"])
        for k, a in self.accelerometers.items():
            a.codec.load(s["accelerometers"][k]["codec"])
            a.clock.load(s["accelerometers"][k]["clock"])
        self.station.load(s["station"])
        self.triggers.load(s["triggers"])

    def slow(self) -> bytes:
        """What outlives a run: references, latencies, noise and bias. Kept in the state directory."""
        return pack(
            {
                "version": SLOW_VERSION,
                "axes": self.config.structure.azimuth_deg,
                "receivers": {
                    k: {
                        "reference": None if r.provisional or r.reference is None else list(r.reference),
                        "latency": r.clock.learned_ns,
                    }
                    for k, r in self.receivers.items()
                },
                "station": self.station.slow(),
            }
        )

    def adopt(self, data: bytes) -> None:
        """Begin a new run with what an earlier one learned; events in the first segment say what was adopted.

        Raises ValueError if the bytes are damaged; this pipeline must then not be used. Settings in the configuration
        win over what was learned.
        """
        s = unpack(data)
        if not isinstance(s, dict) or s.get("version") != SLOW_VERSION:
            raise ValueError(f"kept state: version {SLOW_VERSION} expected")
        try:
            self._adopt(s)
        except (AttributeError, IndexError, KeyError, TypeError) as e:
            raise ValueError(f"kept state: damaged ({type(e).__name__}: {e})") from None

    def _adopt(self, s: m.State) -> None:
        same_axes = s["axes"] == self.config.structure.azimuth_deg
        for k, r in self.receivers.items():
            kept = s["receivers"].get(k)
            if kept is None:
                continue
            if kept["latency"] is not None and r.clock.fixed_ns is None:
                r.clock.learned_ns = kept["latency"]
                self._adopted(k, "latency", (("latency_ms", kept["latency"] / m.MS),))
            if kept["reference"] is not None and r.reference is None:
                lat, lon, h = kept["reference"]
                r.refer_to((lat, lon, h), provisional=False)
                self.station.fix_datum(k)
                self._adopted(k, "reference", (("lat_deg", lat), ("lon_deg", lon), ("h_m", h)))
        if same_axes:
            for event in self.station.adopt(s["station"]):
                self._pending_events.append(event)

    def _adopted(self, source: str, what: str, values: tuple[tuple[str, float], ...]) -> None:
        text = f"{what} of an earlier run adopted: " + ", ".join(f"{n} {v:.9g}" for n, v in values)
        self._pending_events.append(m.Event(0, "ADOPTED", source, text, values))

    def counters(self) -> dict[str, dict[str, int]]:
        """Counters of every codec by the name of its receiver or accelerometer."""
        found: dict[str, dict[str, int]] = {k: dict(r.codec.counters) for k, r in self.receivers.items()}
        found.update({k: dict(a.codec.counters) for k, a in self.accelerometers.items()})
        return found


def fingerprint(config: m.Config) -> str:
    """Hash of every setting that the derived bytes depend on; not of paths, retention or the site's name."""
    parts: list[Any] = [config.structure, config.fusion, config.record.view_hz, config.record.accel_block]
    parts += [list(x.items()) for x in (config.receivers, config.accelerometers, config.points)]  # their order counts
    parts += [list(config.triggers.items()), config.events.hold_s, config.events.release]
    return hashlib.sha256(repr(parts).encode()).hexdigest()
