"""CAN frames to accelerations: signals of a DBC file, or fields of the configuration, decoded in numpy blocks.

Rules:
- A frame of this accelerometer becomes part of a sample (`accepted`), a `duplicates` by its counter, or a Reject with
  its reason (`rejected`); `frames` = accepted + duplicates + rejected + pending. Nothing here raises for bad input.
- Error frames belong to the bus, not to a sensor: their identifier holds an error class. They are never candidates.
- Equal payloads are no duplicates; only an equal counter is one.
- x, y and z may come in one frame or in up to three, of several identifiers or multiplexed in one. A sample with a
  missing axis is dropped and counted, and the next one is flagged GAP_BEFORE: the filter can bridge a gap that it knows
  of, it cannot use half a vector. Frames are matched by the SYNC before them, by the counter where each of them carries
  one, else by their order; see `can_assembly`.
- A sensor that samples at the CANopen SYNC has sampled at the SYNC: that is the sample's time.
- J1939 messages are told by their PGN, from one source address only: where the settings name none, the first that came
  is taken and every other refused. Two sensors are never mixed.
- Samples that are not to be believed are flagged SPIKE and STUCK; see `accel_watch`.
- Any cut of the frames into blocks gives the same samples, bit for bit, except for what `CanFrames.dropped` says of a
  block. Arithmetic is + and * only, written out: no BLAS, no einsum.
- A mistake in the settings is a ValueError at construction that says what exists.

Left out: checksums; producing the SYNC (a device on the bus does, or nobody); J1939 transport protocol (an acceleration
fits into one frame).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from drivers.accel_watch import Watch
from drivers.can_assembly import LEARN_RATIO, Assembly, Message, Presence
from drivers.can_signals import Dbc, SignalSpec, by_pgn, compile_signal
from edge_agent.messages import (
    F64,
    I64,
    U8,
    AccelBlock,
    AccelerometerSettings,
    AccelFlag,
    CanFlag,
    CanFrames,
    Event,
    Reject,
    S,
    State,
)

GRAVITY_MPS2 = 9.80665  # standard gravity, CGPM 1901
UNITS = {"m/s2": 1.0, "g": GRAVITY_MPS2, "mg": GRAVITY_MPS2 / 1000.0, "gal": 0.01}
"""m/s2 per unit."""

DBC_UNITS = {
    "g": "g",
    "G": "g",
    "mg": "mg",
    "mG": "mg",
    "m/s2": "m/s2",
    "m/s^2": "m/s2",
    "m/s²": "m/s2",
    "m/s**2": "m/s2",
    "m/s/s": "m/s2",
    "gal": "gal",
    "Gal": "gal",
    "cm/s2": "gal",
    "cm/s^2": "gal",
}
"""Units as DBC files write them. Another text there is not judged."""

LARGEST_MPS2 = 1e4  # about 1000 g: no structure lives through it, and such a number is a damaged or misread frame
SATURATED_PART = 0.999  # of full scale: the last step of a 10-bit converter
ROTATION_TOLERANCE = 0.01  # rows orthonormal within: 1 % covers matrices written with three decimals
LEARN_SAMPLES = 1024  # samples from which the period is learned when the settings give no rate
DRAIN_PATIENCE_NS = 2 * S  # stamps made at a drain may bunch; only a silence beyond this means a stopped stream
TRUST_BITS = 8  # a counter wider than this that jumps too far was reset; a narrower one may have lost most of a turn

KIND = int(CanFlag.EXT | CanFlag.RTR | CanFlag.ERR)
SOFT = np.uint8(CanFlag.DRAIN | CanFlag.SPREAD)
"""Frames whose stamp is not an arrival."""
GAP_BEFORE = np.uint8(AccelFlag.GAP_BEFORE)  # numpy takes an IntFlag for an int64

COUNTERS = (
    "frames",
    "accepted",
    "duplicates",
    "rejected",
    "pending",
    "samples",
    "gaps",
    "lost",
    "incomplete",
    "resets",
    "saturated",
    "stuck",
    "spikes",
)


@dataclass(slots=True)
class _Rows:
    """Good frames of one message: places in the block, numbers among its candidates, scaled axes (n, k), counter."""

    places: I64
    slots: I64
    candidates: int
    values: F64
    counter: I64 | None


# -------------------------------------------------------------------------------------------------------------- codec


class AccelCodec:
    """One accelerometer's frames in, `AccelBlock`s in m/s2 and structure axes out.

    Raises ValueError at construction for settings that cannot be (unknown or ambiguous signal, unit, rotation, ...).
    `ids`: the (extended, identifier) that it listens to. Counters: frames = accepted + duplicates + rejected + pending;
    samples; gaps and lost (missing samples, by the counter or because a frame was refused); incomplete (samples with a
    missing axis); resets (of the device's counter); saturated, stuck, spikes (samples).
    """

    def __init__(self, settings: AccelerometerSettings) -> None:
        self.settings = settings
        self._source = settings.name
        self._messages = _messages_of(settings)
        self.ids: frozenset[tuple[bool, int]] = frozenset((m.extended, m.can_id) for m in self._messages)
        self._sync = -1 if settings.sync is None else settings.sync
        self._sync_kind = int(CanFlag.EXT) if self._sync > 0x7FF else 0
        self._sync_presence = Presence()
        if self._sync >= 0 and settings.counter is not None:
            raise ValueError("give either counter or sync: the SYNC numbers the samples")
        if any(m.extended == bool(self._sync_kind) and m.can_id == self._sync for m in self._messages):
            raise ValueError(f"sync 0x{self._sync:X} is the identifier of a message that carries an axis")
        several = len(self._messages) > 1 or self._sync >= 0
        self._assembly = Assembly(self._messages, self._sync >= 0) if several else None
        self._wild = [m for m in self._messages if m.wild]
        self._source_address = -1  # that came first, where the settings name none
        self._unit = UNITS[settings.unit]
        self._rotation = _rotation_of(settings)
        # one counter is enough: where each message has one, the assembly has made them equal
        counter = next((m.counter for m in self._messages if m.counter is not None), None)
        self._modulus = counter.modulus if counter else 0
        self._resettable = counter is not None and counter.length > TRUST_BITS
        self._last_raw = -1  # counter of the last sample
        self._last_count = -1
        self._last_ns = -1
        self._number = 0  # candidates so far, where one message carries everything
        self._learn_ns = -1  # time and count from which the period is learned
        self._learn_count = 0
        self._period_ns = S / settings.rate_hz if settings.rate_hz else 0.0
        self.counters: dict[str, int] = dict.fromkeys(COUNTERS, 0)
        self._watch = Watch(self._source, *self._bounds(), self.counters)

    def shared(self, other: AccelCodec) -> list[str]:
        """Identifiers of the messages in which another codec reads the same signals."""
        return list(dict.fromkeys(m.id_text for m in self._messages if any(m.shares(n) for n in other._messages)))

    # ------------------------------------------------------------------------------------------------------- the path

    def feed(self, frames: CanFrames) -> tuple[AccelBlock | None, list[Reject | Event]]:
        """Decode this accelerometer's frames of a block: the samples that they complete (None if none), and what was
        refused or noticed. The block's t_ns is the stamp of the frame that completed the sample, or of its SYNC."""
        notes: list[Reject | Event] = []
        if self._wild and self._source_address < 0:
            self._take_source(frames)
        if self._assembly is not None:
            return self._feed_several(self._assembly, frames, notes), notes
        message = self._messages[0]
        rows = self._take(message, frames, notes)
        if rows is None:
            return None, notes
        numbers = rows.slots + self._number
        self._number += rows.candidates
        if not rows.places.size:
            return None, notes
        self.counters["accepted"] += rows.places.size
        t_ns = frames.t_ns.take(rows.places)
        soft = frames.flags.take(rows.places) & SOFT
        return self._finish(frames, t_ns, rows.values, rows.counter, numbers, soft, 1, notes), notes

    def _take_source(self, frames: CanFrames) -> None:
        """The source address of the first frame with one of our PGNs becomes ours."""
        first = frames.can_id.size
        for message in self._wild:
            places = message.places(frames.can_id)
            places = places[frames.flags[places] & KIND == message.kind]
            if places.size:
                first = min(first, int(places[0]))
        if first < frames.can_id.size:
            self._source_address = int(frames.can_id[first]) & 0xFF

    def _from_source(self, message: Message, places: I64, frames: CanFrames, notes: list[Reject | Event]) -> I64:
        """The places of those frames that come from our source address; the others are refused, once."""
        source = frames.can_id.take(places) & 0xFF
        ours = source == self._source_address
        if ours.all():
            return places
        if message.leads:
            others = places[~ours]
            self.counters["frames"] += others.size
            taken, other = self._source_address, int(source[~ours][0])
            detail = (
                f"{message.id_text} comes from source address 0x{other:02X} too; 0x{taken:02X} came first and is "
                f"taken: write source_address: 0x{taken:02X} or 0x{other:02X}"
            )
            self._reject(notes, frames, others, "SOURCE", detail)
        own: I64 = places[ours]
        return own

    def _selected(self, message: Message, places: I64, frames: CanFrames, notes: list[Reject | Event]) -> I64:
        """The places of those frames that the selectors give to this message; the rest holds other signals."""
        length = frames.length.take(places)
        good = length >= message.select_need
        if not good.all():
            short = places[~good]
            if message.leads:
                self.counters["frames"] += short.size
                detail = (
                    f"{message.name}: {int(frames.length[short[0]])} bytes, the selector needs {message.select_need}"
                )
                self._reject(notes, frames, short, "SHORT", detail)
            places, length = places[good], length[good]
        chosen: I64 = places[message.chosen(frames.data.take(places, axis=0), length)]
        return chosen

    def _take(self, message: Message, frames: CanFrames, notes: list[Reject | Event]) -> _Rows | None:
        """Pick and decode the frames of one message; None if the block has none."""
        places = message.places(frames.can_id)
        if not places.size:
            return None
        flags = frames.flags.take(places)
        kinds = int(np.bitwise_or.reduce(flags)) & KIND
        if kinds != message.kind or (message.extended and not int(np.bitwise_and.reduce(flags)) & CanFlag.EXT):
            kind = flags & KIND
            remote = places[kind == message.kind | CanFlag.RTR]
            if remote.size and message.leads:
                self.counters["frames"] += remote.size
                detail = f"remote request for {message.name}: carries no data"
                self._reject(notes, frames, remote, "RTR", detail)
            places = places[kind == message.kind]
        if message.wild:
            places = self._from_source(message, places, frames, notes)
        if message.when and places.size:
            places = self._selected(message, places, frames, notes)
        if not places.size:
            return None
        candidates = places.size
        self.counters["frames"] += candidates
        if message.presence.seen(frames.t_ns, places):
            self._back(message.name, int(frames.t_ns[places[0]]), notes)
        slots = np.arange(candidates)
        length = frames.length.take(places)
        if np.minimum.reduce(length) < message.need:
            good = length >= message.need
            short = places[~good]
            detail = f"{message.name}: {int(frames.length[short[0]])} bytes, its signals need {message.need}"
            self._reject(notes, frames, short, "SHORT", detail)
            places, slots, length = places[good], slots[good], length[good]
        if not places.size:
            return _Rows(places, slots, candidates, np.empty((0, len(message.axes))), np.empty(0, np.int64))
        data = frames.data.take(places, axis=0)
        values = message.decoder(data, length)
        counter: I64 | None = None
        if message.numbers is not None:
            counter = message.numbers.raw(data, length)[:, 0].astype(np.int64)
        if message.decoder.is_float:
            good = np.asarray(np.isfinite(values).all(axis=1))
            if not good.all():
                self._reject(notes, frames, places[~good], "NOT_FINITE", f"{message.name}: NaN or infinite")
                places, slots, values = places[good], slots[good], values[good]
                counter = None if counter is None else counter[good]
        good = np.asarray((np.abs(values) <= LARGEST_MPS2 / self._unit).all(axis=1))
        if not good.all():
            self._reject(notes, frames, places[~good], "RANGE", f"{message.name}: beyond {LARGEST_MPS2:g} m/s2")
            places, slots, values = places[good], slots[good], values[good]
            counter = None if counter is None else counter[good]
        if counter is not None and message.skips:
            good = counter < self._modulus
            if not good.all():
                detail = f"{message.name}: the counter holds its value for invalid"
                self._reject(notes, frames, places[~good], "COUNTER", detail)
                places, slots, values, counter = places[good], slots[good], values[good], counter[good]
        return _Rows(places, slots, candidates, values, counter)

    def _take_sync(self, frames: CanFrames, notes: list[Reject | Event]) -> _Rows | None:
        """The SYNCs of a block, with their optional counter (else 0)."""
        places = (frames.can_id == self._sync).nonzero()[0]
        places = places[frames.flags[places] & KIND == self._sync_kind]
        if not places.size:
            return None
        if self._sync_presence.seen(frames.t_ns, places):
            self._back(f"SYNC 0x{self._sync:X}", int(frames.t_ns[places[0]]), notes)
        counter = np.where(frames.length.take(places) == 1, frames.data[places, 0], 0).astype(np.int64)
        return _Rows(places, np.arange(places.size), places.size, np.empty((places.size, 0)), counter)

    def _feed_several(self, assembly: Assembly, frames: CanFrames, notes: list[Reject | Event]) -> AccelBlock | None:
        """The same where a sample is more than one frame: merge their rows by arrival, assemble, finish."""
        taken = [(j, self._take(m, frames, notes)) for j, m in enumerate(self._messages)]
        if assembly.sync >= 0:
            taken.append((assembly.sync, self._take_sync(frames, notes)))
        parts = [(j, rows) for j, rows in taken if rows is not None and rows.places.size]
        if not parts:
            return None
        places = np.concatenate([rows.places for _, rows in parts])
        order = np.argsort(places)
        places = places[order]
        values = np.full((places.size, 3), np.nan)
        row = 0
        for j, rows in parts:
            n = rows.places.size
            if j != assembly.sync:
                values[row : row + n, self._messages[j].axes] = rows.values
            row += n
        waiting = assembly.pending
        msg = np.repeat([j for j, _ in parts], [rows.places.size for _, rows in parts])[order].tolist()
        key = np.concatenate(
            [np.full(rows.places.size, -1) if rows.counter is None else rows.counter for _, rows in parts]
        )[order].tolist()
        t_ns = [p[1] for p in waiting] + frames.t_ns[places].tolist()
        soft = [p[3] for p in waiting] + (frames.flags[places] & SOFT).tolist()
        msg = [p[0] for p in waiting] + msg
        key = [p[2] for p in waiting] + key
        values = np.concatenate([np.array([p[4] for p in waiting]).reshape(-1, 3), values[order]])

        whole, numbers, broken, duplicates = assembly.run(msg, t_ns, key, soft)
        assembly.pending = [(msg[k], t_ns[k], key[k], soft[k], values[k].tolist()) for k in assembly.open]
        self.counters["pending"] = sum(p[0] != assembly.sync for p in assembly.pending)
        self.counters["duplicates"] += duplicates
        if (
            assembly.sync >= 0
        ):  # a SYNC is nobody's frame, and one that no frame follows is a lost sample: its number is missing
            broken = [b for b in broken if any(msg[k] != assembly.sync for k in b)]
        if broken:
            self.counters["incomplete"] += len(broken)
            count = sum(msg[k] != assembly.sync for b in broken for k in b)
            self.counters["rejected"] += count
            have = {msg[k] for k in broken[0]}
            missing = ", ".join(m.name for j, m in enumerate(self._messages) if j not in have)
            if assembly.sync >= 0 and assembly.sync not in have:
                missing = f"SYNC 0x{self._sync:X}"
            detail = f"{len(broken)} samples with a missing axis; of the first no frame {missing}"
            notes.append(Reject(t_ns[broken[0][-1]], self._source, "INCOMPLETE", detail, count))
        if not whole:
            return None
        size = len(self._messages)
        self.counters["accepted"] += len(whole) * size
        done = np.array(whole)  # (samples, messages): places of their frames
        xyz = np.empty((len(whole), 3))
        which = np.array(msg)[done]
        for j, message in enumerate(self._messages):
            source = done[which == j]  # row by row one place, in the order of the samples
            for axis in message.axes:
                xyz[:, axis] = values[source, axis]
        counter = np.array(key)[done].max(axis=1) if self._modulus else None
        stamps = np.array(t_ns, np.int64)[done[:, -1 if assembly.sync < 0 else 0]]
        softs: U8 = np.bitwise_or.reduce(np.array(soft, np.uint8)[done], axis=1).astype(np.uint8)
        return self._finish(frames, stamps, xyz, counter, np.array(numbers, np.int64), softs, size, notes)

    def _finish(
        self,
        frames: CanFrames,
        t_ns: I64,
        values: F64,
        counter: I64 | None,
        numbers: I64,
        soft: U8,
        frames_each: int,
        notes: list[Reject | Event],
    ) -> AccelBlock | None:
        """Number the samples (n >= 1), drop duplicates, convert, flag, rotate."""
        reset: list[int] = []
        count = numbers
        if counter is not None:
            count, keep, reset = self._unwrap(counter, t_ns, soft)
            if keep is not None:
                dropped = t_ns.size - len(keep)
                self.counters["duplicates"] += dropped * frames_each
                self.counters["accepted"] -= dropped * frames_each
                if not keep:
                    return None
                t_ns, values, soft = t_ns[keep], values[keep], soft[keep]
        n = t_ns.size
        flags = np.zeros(n, np.uint8)
        last = self._last_count if self._last_count >= 0 else int(count[0]) - 1  # nothing is missing before the first
        if int(count[-1]) - last != n:
            self._gaps(last, count, t_ns, flags, notes)
        for k in reset:
            flags[k] |= GAP_BEFORE
            self.counters["resets"] += 1
            text = "the device's counter jumped further than time allows: it restarted"
            notes.append(Event(int(t_ns[k]), "COUNTER_RESET", self._source, text))
        if frames.dropped and counter is None:
            self._suspect(t_ns, flags)
        self._last_count, self._last_ns = int(count[-1]), int(t_ns[-1])

        if self._unit != 1.0:
            values = values * self._unit
        t_ns, values, flags, count, soft = self._watch.judge(t_ns, values, flags, count, soft, notes)
        n = t_ns.size
        if not n:
            return None
        if self._rotation is not None:
            r = self._rotation
            values = values[:, 0:1] * r[:, 0] + values[:, 1:2] * r[:, 1] + values[:, 2:3] * r[:, 2]
        self.counters["samples"] += n
        return AccelBlock(self._source, t_ns, values, flags, count, bool(np.bitwise_or.reduce(soft)))

    # ------------------------------------------------------------------------------------------------------- presence

    def silent(self, now_ns: int) -> list[Event]:
        """One Event for each message that has stopped coming, SILENT_RATIO of its periods ago; `feed` tells its end."""
        events = []
        named = [(m.name, m.presence) for m in self._messages]
        if self._sync >= 0:
            named.append((f"SYNC 0x{self._sync:X}", self._sync_presence))
        for name, p in named:
            if p.stopped(now_ns):
                silent_s, period_s = (now_ns - p.last_ns) / S, p.period_ns / S
                text = f"no frame {name} for {silent_s:.1f} s; it came every {period_s * 1000:.3g} ms"
                values = (("silent_s", silent_s), ("period_s", period_s))
                events.append(Event(now_ns, "ACCEL_SILENT", self._source, text, values, p.last_ns))
        return events

    def _back(self, name: str, t_ns: int, notes: list[Reject | Event]) -> None:
        notes.append(Event(t_ns, "ACCEL_SILENT_END", self._source, f"frames {name} come again"))

    # ------------------------------------------------------------------------------------------------- counter, gaps

    def _unwrap(self, raw: I64, t_ns: I64, soft: U8) -> tuple[I64, list[int] | None, list[int]]:
        """(unwrapped count of the kept samples, places kept or None for all, places among them of a counter reset).

        A step of 1 is the next sample, 0 a duplicate, more a gap. The counter only tells steps modulo its range; after
        a pause longer than half a turn the period, given or learned from the first LEARN_SAMPLES samples without a
        pause of a second, says how many turns went by. Sample by sample, so that no cut matters, unless all is well.
        """
        turn = self._modulus
        period_ns = self._period_ns
        limit_ns = turn * period_ns / 2 if period_ns else math.inf
        n = raw.size
        if period_ns and self._last_raw >= 0 and int(t_ns[-1]) - self._last_ns <= limit_ns:
            numbers = np.arange(1, n + 1)
            if np.array_equal((self._last_raw + numbers) % turn, raw):
                self._last_raw = int(raw[-1])
                return self._last_count + numbers, None, []
        counts: list[int] = []
        keep: list[int] = []
        reset: list[int] = []
        last_raw, last_count, last_ns = self._last_raw, self._last_count, self._last_ns
        for k, (value, t, unsure) in enumerate(zip(raw.tolist(), t_ns.tolist(), soft.tolist(), strict=True)):
            if last_raw < 0:
                step = value + 1  # the first sample's number is its counter; last_count is -1
            else:
                step = (value - last_raw) % turn
                pause = t - last_ns
                if pause > max(limit_ns, DRAIN_PATIENCE_NS if unsure else 0):
                    step += turn * max(0, round((pause / period_ns - step) / turn))
                elif self._resettable and (
                    step * period_ns > 2 * pause + DRAIN_PATIENCE_NS if period_ns else step > turn // 2
                ):  # more samples than there was time for
                    step = max(1, round(pause / period_ns)) if period_ns else 1
                    reset.append(len(keep))
                if step == 0:
                    continue
            last_raw, last_count = value, last_count + step
            keep.append(k)
            counts.append(last_count)
            if not period_ns:
                if self._learn_ns < 0 or t - last_ns > S:
                    self._learn_ns, self._learn_count = t, last_count
                elif last_count - self._learn_count >= LEARN_SAMPLES and t > self._learn_ns:
                    period_ns = (t - self._learn_ns) / (last_count - self._learn_count)
                    limit_ns = turn * period_ns / 2
            last_ns = t
        self._last_raw, self._period_ns = last_raw, period_ns
        return np.array(counts, np.int64), (None if len(keep) == n else keep), reset

    def _gaps(self, last: int, count: I64, t_ns: I64, flags: U8, notes: list[Reject | Event]) -> None:
        """Flag and count the samples before which some are missing; one Event for the block."""
        steps = np.diff(count, prepend=last)
        after = np.flatnonzero(steps > 1)
        if not after.size:
            return
        flags[after] |= GAP_BEFORE
        lost = int(steps[after].sum()) - after.size
        self.counters["gaps"] += after.size
        self.counters["lost"] += lost
        first = int(after[0])
        begin_ns = int(t_ns[first - 1]) if first else self._last_ns
        end_ns = int(t_ns[after[-1]])
        text = f"{lost} samples missing in {after.size} gaps"
        values = (("lost", float(lost)), ("gaps", float(after.size)))
        notes.append(Event(end_ns, "SAMPLES_LOST", self._source, text, values, begin_ns, end_ns))

    def _suspect(self, t_ns: I64, flags: U8) -> None:
        """The kernel dropped frames of this port and no counter tells whose: flag the longest pause if it is one."""
        if self._last_ns < 0 or t_ns.size < 3:
            return
        pauses = np.diff(t_ns, prepend=self._last_ns)
        longest = int(np.argmax(pauses))
        if pauses[longest] > LEARN_RATIO * float(np.sort(pauses)[pauses.size // 2]):
            flags[longest] |= GAP_BEFORE

    # ------------------------------------------------------------------------------------------------------- the rest

    def _reject(self, notes: list[Reject | Event], frames: CanFrames, places: I64, reason: str, detail: str) -> None:
        self.counters["rejected"] += places.size
        notes.append(Reject(int(frames.t_ns[places[0]]), self._source, reason, detail, int(places.size)))

    def _bounds(self) -> tuple[F64, F64]:
        """Lowest and highest good value (3,) in m/s2 of each sensor axis, exclusive: what the settings' range and the
        signal's own bits allow. An integer at its end says "or more", and for some devices "not available"."""
        low, high = np.full(3, -np.inf), np.full(3, np.inf)
        full = self.settings.range_mps2
        if full is not None:
            if not (math.isfinite(full) and full > 0.0):
                raise ValueError(f"range {full} m/s2 must be a positive number")
            low[:], high[:] = -SATURATED_PART * full, SATURATED_PART * full
        for message in self._messages:
            for axis, spec in zip(message.axes, message.decoder.specs, strict=False):
                if spec.is_float or spec.length < 8:
                    continue
                top = (1 << (spec.length - spec.signed)) - 1
                bottom = -top - 1 if spec.signed else 0
                ends = sorted((float(raw) * spec.scale + spec.offset) * self._unit for raw in (bottom, top))
                low[axis], high[axis] = max(low[axis], ends[0]), min(high[axis], ends[1])
        return low, high

    def save(self) -> State:
        """Everything that the next `feed` depends on."""
        return {
            "last_raw": self._last_raw,
            "last_count": self._last_count,
            "last_ns": self._last_ns,
            "number": self._number,
            "learn_ns": self._learn_ns,
            "learn_count": self._learn_count,
            "period_ns": self._period_ns,
            "assembly": self._assembly.save() if self._assembly is not None else None,
            "source_address": self._source_address,
            "presence": [m.presence.save() for m in self._messages] + [self._sync_presence.save()],
            "watch": self._watch.save(),
            "counters": dict(self.counters),
        }

    def load(self, s: State) -> None:
        """Go on where `save` was called, of a codec with the same settings."""
        if (s["assembly"] is None) != (self._assembly is None):
            raise ValueError(f"{self._source}: the saved state is of an accelerometer with other messages")
        self._last_raw, self._last_count, self._last_ns = s["last_raw"], s["last_count"], s["last_ns"]
        self._number = s["number"]
        self._learn_ns, self._learn_count = s["learn_ns"], s["learn_count"]
        self._period_ns = s["period_ns"]
        if self._assembly is not None:
            self._assembly.load(s["assembly"])
        self._source_address = s["source_address"]
        for p, kept in zip([m.presence for m in self._messages] + [self._sync_presence], s["presence"], strict=True):
            p.load(kept)
        self._watch.load(s["watch"])
        self.counters.update(s["counters"])  # the watch counts in the same


# ------------------------------------------------------------------------------------------------ settings to signals


def _messages_of(settings: AccelerometerSettings) -> list[Message]:
    """The messages that carry x, y, z and the counter. Raises ValueError with what exists."""
    if settings.unit not in UNITS:
        raise ValueError(f"unit {settings.unit!r} is not known; there are: {', '.join(UNITS)}")
    if (settings.signals is None) == (settings.fields is None):
        raise ValueError("give either dbc and signals, or fields: three of them, x, y and z")
    given = settings.signals if settings.signals is not None else settings.fields
    if given is None or len(given) != 3:
        raise ValueError(f"three signals are needed, x, y and z; there are {len(given or ())}")
    if settings.rate_hz is not None and not (math.isfinite(settings.rate_hz) and settings.rate_hz > 0.0):
        raise ValueError(f"rate_hz {settings.rate_hz} must be a positive number")
    named = settings.signals is not None or isinstance(settings.counter, str)
    if named and not settings.dbc_text:
        raise ValueError("signals are named, but there is no dbc file that says where they are")
    dbc = Dbc(settings.dbc_text, settings.dbc or "dbc") if named else None
    if settings.signals is not None and dbc is not None:
        specs = [dbc.one(name) for name in settings.signals]
        for spec in specs:
            unit = DBC_UNITS.get(spec.unit, settings.unit)
            if unit != settings.unit:
                raise ValueError(
                    f"signal {spec.name} is in {spec.unit!r} by the DBC file, unit says {settings.unit!r}: "
                    f"write unit: {unit}"
                )
    else:
        specs = [compile_signal(f"fields[{i}]", f) for i, f in enumerate(settings.fields or ())]
    specs = [_addressed(spec, settings) for spec in specs]
    for i in range(3):
        for j in range(i):
            a, b = specs[i], specs[j]
            if (_frame(a), a.columns, a.shift) == (_frame(b), b.columns, b.shift):
                raise ValueError(f"{'xyz'[j]} and {'xyz'[i]} are the same signal {a.name}")
    axes: dict[_Frame, list[tuple[int, SignalSpec]]] = {}
    for axis, spec in enumerate(specs):
        axes.setdefault(_frame(spec), []).append((axis, spec))
    counters = _counters_of(settings, dbc, specs)
    messages: list[Message] = []
    for frame, part in axes.items():
        leads = not any((m.extended, m.can_id, m.mask) == frame[:3] for m in messages)
        messages.append(Message(part, counters.get(frame), leads))
    for m in messages:  # one that is too short for a selector of any is for none
        same = [n for n in messages if (n.extended, n.can_id, n.mask) == (m.extended, m.can_id, m.mask)]
        m.select_need = max(n.select_need for n in same)
    return messages


_Frame: TypeAlias = tuple[bool, int, int, tuple[tuple[SignalSpec, tuple[int, ...]], ...]]


def _frame(spec: SignalSpec) -> _Frame:
    """Which frames hold a signal."""
    return spec.extended, spec.can_id, spec.mask, spec.when


def _addressed(spec: SignalSpec, settings: AccelerometerSettings) -> SignalSpec:
    """The signal as J1939 finds it, where the DBC file, the field or a source address says that it is J1939."""
    source = settings.source_address
    if source is None:
        return by_pgn(spec, None) if spec.j1939 else spec
    if not 0 <= source <= 253:
        raise ValueError(f"source_address {source} must be from 0 to 253")
    if not spec.extended:
        raise ValueError(
            f"source_address is for J1939, whose identifiers have 29 bits; {spec.name} is in 0x{spec.can_id:X}"
        )
    return by_pgn(spec, source)


def _counters_of(
    settings: AccelerometerSettings, dbc: Dbc | None, axes: Sequence[SignalSpec]
) -> dict[_Frame, SignalSpec]:
    """Counter signal by message: one, or one in each of the messages. Scale and sign of a counter do not matter."""
    if settings.counter is None:
        return {}
    if isinstance(settings.counter, str):
        found = dbc.find(settings.counter, among=axes) if dbc is not None else []
    else:
        found = [compile_signal("counter", settings.counter)]
    frames = dict.fromkeys(_frame(a) for a in axes)
    result: dict[_Frame, SignalSpec] = {}
    for spec in found:
        if spec.is_float or spec.length > 32:
            raise ValueError(f"counter {spec.name} must be an integer of at most 32 bits")
        spec = replace(_addressed(spec, settings), signed=False, scale=1.0, offset=0.0)
        # in every frame of its identifier, or in those that the same selectors choose
        mine = [f for f in frames if f[:3] == _frame(spec)[:3] and f[3][: len(spec.when)] == spec.when]
        if not mine:
            there = ", ".join(f"0x{i:X}" for i in sorted({f[1] for f in frames}))
            raise ValueError(f"counter {spec.name} must be in a message that carries an axis ({there})")
        for frame in mine:
            if frame in result:
                raise ValueError(f"counter {spec.name} is ambiguous: there are two of it in message 0x{spec.can_id:X}")
            result[frame] = spec
    if len({s.modulus for s in result.values()}) > 1:
        raise ValueError("the counters of the three messages have different lengths")
    if len(result) < len(frames):  # cannot match all frames: the first one numbers the samples
        frame = min(result, key=lambda f: f[:2])
        return {frame: result[frame]}
    return result


def _rotation_of(settings: AccelerometerSettings) -> F64 | None:
    """The mounting (3, 3), sensor to structure axes; None where it changes nothing. Raises ValueError."""
    rows = settings.rotation
    if len(rows) != 3 or any(len(row) != 3 for row in rows):
        raise ValueError("rotation must have three rows of three numbers")
    r = np.array(rows, np.float64)
    for i in range(3):
        for j in range(i, 3):
            product = float((r[i] * r[j]).sum())
            if not abs(product - float(i == j)) <= ROTATION_TOLERANCE:
                what = f"row {i} has length {math.sqrt(abs(product)):.3f}" if i == j else f"rows {i} and {j} lean"
                raise ValueError(f"rotation is not one: its rows must be at right angles and of length 1, but {what}")
    return None if np.array_equal(r, np.eye(3)) else r
