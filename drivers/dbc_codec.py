"""CAN frames to accelerations: signals of a DBC file, or fields of the configuration, decoded in numpy blocks.

Rules:
- A frame of this accelerometer becomes part of a sample (`accepted`), a `duplicates` by its counter, or a Reject with
  its reason (`rejected`); `frames` = accepted + duplicates + rejected + pending. Nothing here raises for bad input.
- Error frames belong to the bus, not to a sensor: their identifier holds an error class. They are never candidates.
- Equal payloads are no duplicates; only an equal counter is one.
- x, y and z may come in one frame or in up to three. A sample with a missing axis is dropped and counted, and the next
  one is flagged GAP_BEFORE: the filter can bridge a gap that it knows of, it cannot use half a vector. Frames are
  matched by the counter where each of them carries one, else by their order; see `_Assembly`.
- Any cut of the frames into blocks gives the same samples, bit for bit, except for what `CanFrames.dropped` says of a
  block. Arithmetic is + and * only, written out: no BLAS, no einsum.
- A mistake in the settings is a ValueError at construction that says what exists.

Left out: multiplexed signals (refused by name), checksums, flatline and spike flags.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.can_signals import Dbc, Decoder, SignalSpec, compile_signal
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
LEARN_FRAMES = 64  # frames of a set of messages from which the first of the set is learned
LEARN_RATIO = 1.5  # the pause between sets must be so much longer than the pauses within, else order tells nothing
LEARN_SAMPLES = 1024  # samples from which the period is learned when the settings give no rate
DRAIN_PATIENCE_NS = 2 * S  # stamps made at a drain may bunch; only a silence beyond this means a stopped stream
TRUST_BITS = 8  # a counter wider than this that jumps too far was reset; a narrower one may have lost most of a turn
LATE_RATIO = 1.5  # a set of messages that takes longer than so many periods mixes two samples

KIND = int(CanFlag.EXT | CanFlag.RTR | CanFlag.ERR)
SOFT = np.uint8(CanFlag.DRAIN | CanFlag.SPREAD)
"""Frames whose stamp is not an arrival."""
# numpy takes an IntFlag for an int64
GAP_BEFORE, SATURATED = np.uint8(AccelFlag.GAP_BEFORE), np.uint8(AccelFlag.SATURATED)

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
)


# ----------------------------------------------------------------------------------------------------------- assembly


class _Message:
    """One of the one to three messages that carry the axes, and perhaps the counter."""

    def __init__(self, axes: list[tuple[int, SignalSpec]], counter: SignalSpec | None) -> None:
        spec = axes[0][1]
        self.can_id = spec.can_id
        self.extended = spec.extended
        self.kind = int(CanFlag.EXT) if spec.extended else 0
        self.axes = [axis for axis, _ in axes]
        self.counter = counter
        self.decoder = Decoder([s for _, s in axes])
        self.numbers = Decoder([counter]) if counter is not None else None
        self.skips = counter is not None and counter.modulus != 1 << counter.length
        self.need = max(self.decoder.need, self.numbers.need if self.numbers else 0)
        self.name = f"0x{self.can_id:X} ({', '.join('xyz'[a] for a in self.axes)})"


@dataclass(slots=True)
class _Rows:
    """Good frames of one message: places in the block, numbers among its candidates, scaled axes (n, k), counter."""

    places: I64
    slots: I64
    candidates: int
    values: F64
    counter: I64 | None


class _Assembly:
    """Matches frames of several messages to samples, frame by frame, so that no cut matters.

    With a counter in each message a set is the frames of one counter value. Else a set begins with the message that
    comes first: until it is known the one with the lowest identifier (it wins the bus when a device queues its frames
    at once), then the one before which the pause is longest, learned from the kernel's stamps. A set that lasts longer
    than LATE_RATIO periods is broken too: frames of two samples would make a false one.
    """

    def __init__(self, messages: Sequence[_Message]) -> None:
        self.size = len(messages)
        self.keyed = all(m.counter is not None for m in messages)
        self.first = min(range(self.size), key=lambda j: (messages[j].extended, messages[j].can_id))
        self.known = self.keyed
        self.key = -1  # counter of the open set
        self.done = False  # that set has been handed out
        self.number = 0  # sets so far, broken ones included
        self.pending: list[tuple[int, int, int, int, list[float]]] = []  # message, t_ns, counter, flags, three values
        self.open: list[int] = []  # places of the set that `run` left open
        self.last_ns = -1
        self.pauses = [0] * self.size
        self.seen = [0] * self.size
        self.period_ns = 0

    def _learn(self, m: int, t: int, soft: int) -> None:
        """Learn from LEARN_FRAMES kernel-stamped frames which message begins a set, and the period."""
        if soft:  # these stamps say nothing about pauses
            self.last_ns = -1
            return
        if self.last_ns >= 0:
            self.pauses[m] += t - self.last_ns
            self.seen[m] += 1
        self.last_ns = t
        if sum(self.seen) < LEARN_FRAMES or min(self.seen) == 0:
            return
        means = [p / n for p, n in zip(self.pauses, self.seen, strict=True)]
        order = sorted(range(self.size), key=lambda j: means[j])
        if means[order[-1]] > LEARN_RATIO * means[order[-2]]:
            self.first = order[-1]
        self.period_ns = sum(self.pauses) // max(self.seen)
        self.known = True

    def run(
        self, msg: list[int], t: list[int], key: list[int], soft: list[int]
    ) -> tuple[list[list[int]], list[int], list[list[int]], int]:
        """Walk the pending frames and then the new ones, given as columns.

        Returns (complete sets as places in the order of arrival, their numbers, broken sets, duplicates). What is still
        open afterwards is `self.open`.
        """
        whole: list[list[int]] = []
        numbers: list[int] = []
        broken: list[list[int]] = []
        duplicates = 0
        late_ns = int(LATE_RATIO * self.period_ns)
        current = list(range(len(self.pending)))
        for k in range(len(current), len(msg)):
            m = msg[k]
            if not self.known:
                self._learn(m, t[k], soft[k])
                late_ns = int(LATE_RATIO * self.period_ns)
            if key[k] != self.key if self.keyed else m == self.first:
                begins = True
                self.done = False
                self.key = key[k]
            elif self.keyed:
                if self.done or any(msg[i] == m for i in current):
                    duplicates += 1
                    continue
                begins = False
            else:  # a repeated or a late frame: the frame that begins a set, and more, was lost
                begins = any(msg[i] == m for i in current) or bool(
                    late_ns and current and not soft[k] and t[k] - t[current[0]] > late_ns
                )
            if begins and current:
                broken.append(current)
                self.number += 1
                current = []
            current.append(k)
            if len(current) == self.size:
                whole.append(current)
                numbers.append(self.number)
                self.number += 1
                current = []
                self.done = True
        self.open = current
        return whole, numbers, broken, duplicates

    def save(self) -> State:
        return {
            "first": self.first,
            "known": self.known,
            "key": self.key,
            "done": self.done,
            "number": self.number,
            "pending": [list(p) for p in self.pending],
            "last_ns": self.last_ns,
            "pauses": list(self.pauses),
            "seen": list(self.seen),
            "period_ns": self.period_ns,
        }

    def load(self, s: State) -> None:
        self.first, self.known, self.key, self.done = s["first"], s["known"], s["key"], s["done"]
        self.number = s["number"]
        self.pending = [(m, t, c, f, list(values)) for m, t, c, f, values in s["pending"]]
        self.last_ns, self.pauses, self.seen = s["last_ns"], list(s["pauses"]), list(s["seen"])
        self.period_ns = s["period_ns"]


# -------------------------------------------------------------------------------------------------------------- codec


class AccelCodec:
    """One accelerometer's frames in, `AccelBlock`s in m/s2 and structure axes out.

    Raises ValueError at construction for settings that cannot be (unknown or ambiguous signal, unit, rotation, ...).
    `ids`: the (extended, identifier) that it listens to. Counters: frames = accepted + duplicates + rejected + pending;
    samples; gaps and lost (missing samples, by the counter or because a frame was refused); incomplete (samples with a
    missing axis); resets (of the device's counter); saturated (samples).
    """

    def __init__(self, settings: AccelerometerSettings) -> None:
        self.settings = settings
        self._source = settings.name
        self._messages = _messages_of(settings)
        self.ids: frozenset[tuple[bool, int]] = frozenset((m.extended, m.can_id) for m in self._messages)
        self._assembly = _Assembly(self._messages) if len(self._messages) > 1 else None
        self._unit = UNITS[settings.unit]
        self._low, self._high = self._bounds()
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

    # ------------------------------------------------------------------------------------------------------- the path

    def feed(self, frames: CanFrames) -> tuple[AccelBlock | None, list[Reject | Event]]:
        """Decode this accelerometer's frames of a block: the samples that they complete (None if none), and what was
        refused or noticed. The block's t_ns is the stamp of the frame that completed the sample."""
        notes: list[Reject | Event] = []
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

    def _take(self, message: _Message, frames: CanFrames, notes: list[Reject | Event]) -> _Rows | None:
        """Pick and decode the frames of one message; None if the block has none."""
        places = (frames.can_id == message.can_id).nonzero()[0]
        if not places.size:
            return None
        flags = frames.flags.take(places)
        kinds = int(np.bitwise_or.reduce(flags)) & KIND
        if kinds != message.kind or (message.extended and not int(np.bitwise_and.reduce(flags)) & CanFlag.EXT):
            kind = flags & KIND
            remote = places[kind == message.kind | CanFlag.RTR]
            if remote.size:
                self.counters["frames"] += remote.size
                detail = f"remote request for {message.name}: carries no data"
                self._reject(notes, frames, remote, "RTR", detail)
            places = places[kind == message.kind]
            if not places.size:
                return None
        candidates = places.size
        self.counters["frames"] += candidates
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
            good = np.isfinite(values).all(axis=1)
            if not good.all():
                self._reject(notes, frames, places[~good], "NOT_FINITE", f"{message.name}: NaN or infinite")
                places, slots, values = places[good], slots[good], values[good]
                counter = None if counter is None else counter[good]
        good = (np.abs(values) <= LARGEST_MPS2 / self._unit).all(axis=1)
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

    def _feed_several(self, assembly: _Assembly, frames: CanFrames, notes: list[Reject | Event]) -> AccelBlock | None:
        """The same where x, y, z come in several messages: merge their rows by arrival, assemble, finish."""
        taken = [(j, self._take(m, frames, notes)) for j, m in enumerate(self._messages)]
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
        self.counters["pending"] = len(assembly.pending)
        self.counters["duplicates"] += duplicates
        if broken:
            self.counters["incomplete"] += len(broken)
            count = sum(len(b) for b in broken)
            self.counters["rejected"] += count
            have = {msg[k] for k in broken[0]}
            missing = ", ".join(m.name for j, m in enumerate(self._messages) if j not in have)
            detail = f"{len(broken)} samples with a missing axis; of the first no frame {missing}"
            notes.append(Reject(t_ns[broken[0][-1]], self._source, "INCOMPLETE", detail, count))
        if not whole:
            return None
        self.counters["accepted"] += len(whole) * assembly.size
        done = np.array(whole)  # (samples, messages): places of their frames
        xyz = np.empty((len(whole), 3))
        which = np.array(msg)[done]
        for j, message in enumerate(self._messages):
            source = done[which == j]  # row by row one place, in the order of the samples
            for axis in message.axes:
                xyz[:, axis] = values[source, axis]
        counter = np.array(key)[done].max(axis=1) if self._modulus else None
        stamps = np.array(t_ns, np.int64)[done[:, -1]]
        softs: U8 = np.bitwise_or.reduce(np.array(soft, np.uint8)[done], axis=1).astype(np.uint8)
        size = assembly.size
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
        hit = (values >= self._high) | (values <= self._low)
        if np.count_nonzero(hit):
            saturated = hit.any(axis=1)
            flags[saturated] |= SATURATED
            self.counters["saturated"] += int(np.count_nonzero(saturated))
        if self._rotation is not None:
            r = self._rotation
            values = values[:, 0:1] * r[:, 0] + values[:, 1:2] * r[:, 1] + values[:, 2:3] * r[:, 2]
        self.counters["samples"] += n
        return AccelBlock(self._source, t_ns, values, flags, count, bool(np.bitwise_or.reduce(soft)))

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
        self.counters = dict(s["counters"])


# ------------------------------------------------------------------------------------------------ settings to signals


def _messages_of(settings: AccelerometerSettings) -> list[_Message]:
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
    for i in range(3):
        for j in range(i):
            a, b = specs[i], specs[j]
            if (a.extended, a.can_id, a.columns, a.shift) == (b.extended, b.can_id, b.columns, b.shift):
                raise ValueError(f"{'xyz'[j]} and {'xyz'[i]} are the same signal {a.name}")
    axes: dict[tuple[bool, int], list[tuple[int, SignalSpec]]] = {}
    for axis, spec in enumerate(specs):
        axes.setdefault((spec.extended, spec.can_id), []).append((axis, spec))
    counters = _counters_of(settings, dbc, set(axes))
    return [_Message(part, counters.get(key)) for key, part in axes.items()]


def _counters_of(
    settings: AccelerometerSettings, dbc: Dbc | None, ids: set[tuple[bool, int]]
) -> dict[tuple[bool, int], SignalSpec]:
    """Counter signal by message: one, or one in each of the messages. Scale and sign of a counter do not matter."""
    if settings.counter is None:
        return {}
    if isinstance(settings.counter, str):
        found = dbc.find(settings.counter, among=ids) if dbc is not None else []
    else:
        found = [compile_signal("counter", settings.counter)]
    result: dict[tuple[bool, int], SignalSpec] = {}
    for spec in found:
        if spec.is_float or spec.length > 32:
            raise ValueError(f"counter {spec.name} must be an integer of at most 32 bits")
        key = (spec.extended, spec.can_id)
        if key not in ids:
            there = ", ".join(f"0x{i:X}" for _, i in sorted(ids))
            raise ValueError(f"counter {spec.name} must be in a message that carries an axis ({there})")
        if key in result:
            raise ValueError(f"counter {spec.name} is ambiguous: there are two of it in message 0x{spec.can_id:X}")
        result[key] = replace(spec, signed=False, scale=1.0, offset=0.0)
    if len({s.modulus for s in result.values()}) > 1:
        raise ValueError("the counters of the three messages have different lengths")
    if len(result) < len(ids):  # cannot match all frames: the first one numbers the samples
        key = min(result)
        return {key: result[key]}
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
