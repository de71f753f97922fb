"""Frames of one to three messages, and perhaps a SYNC, put together to samples: one at a time, so that no cut matters.

Rules: a set of frames is never made of two samples; a set with a missing frame is handed back as broken.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.can_signals import WHOLE_ID, Decoder, SignalSpec
from edge_agent.messages import I64, U8, U32, CanFlag, S, State

LEARN_FRAMES = 64  # frames of a set of messages from which the first of the set is learned
LEARN_RATIO = 1.5  # the pause between sets must be so much longer than the pauses within, else order tells nothing
LATE_RATIO = 1.5  # a set of messages that takes longer than so many periods mixes two samples

SILENT_RATIO = 10  # opendbc's can/parser.py: ten periods without a message are an alert
SILENT_LEAST_NS = 2 * S  # a block may be half a second under way, and a Tick comes once a second
SILENT_LEARN = 64  # intervals from which the period is learned; a pause of a second begins anew


@dataclass(slots=True)
class Presence:
    """When frames of one message came: the learned period, and whether they have stopped."""

    last_ns: int = -1
    period_ns: int = 0  # 0 = not yet known
    silent: bool = False
    _begin_ns: int = -1
    _count: int = 0

    def seen(self, stamps: I64, places: I64) -> bool:
        """Frames came at these places (n >= 1) of a block; whether that ends a silence."""
        if self.period_ns and not self.silent:
            self.last_ns = int(stamps[places[-1]])
            return False
        t_ns = stamps[places]
        ended, self.silent = self.silent, False
        if ended:
            self.period_ns, self._begin_ns = 0, -1  # who comes back may have another rate
        for t in t_ns.tolist():
            if self._begin_ns < 0 or t - self.last_ns > S:
                self._begin_ns, self._count = t, 0
            else:
                self._count += 1
                if self._count == SILENT_LEARN:
                    self.period_ns = max(1, (t - self._begin_ns) // SILENT_LEARN)
                    self.last_ns = int(t_ns[-1])
                    break
            self.last_ns = t
        return ended

    def stopped(self, now_ns: int) -> bool:
        """Whether a silence has just been found to have begun."""
        if (
            self.silent
            or not self.period_ns
            or now_ns - self.last_ns <= max(SILENT_LEAST_NS, SILENT_RATIO * self.period_ns)
        ):
            return False
        self.silent = True
        return True

    def save(self) -> list[int]:
        return [self.last_ns, self.period_ns, int(self.silent), self._begin_ns, self._count]

    def load(self, s: Sequence[int]) -> None:
        self.last_ns, self.period_ns, self._begin_ns, self._count = s[0], s[1], s[3], s[4]
        self.silent = bool(s[2])


class Message:
    """Which frames carry some of the axes (one of them or all three, by identifier and selectors), and perhaps the
    counter. `leads`: the first of the messages that share an identifier; it answers for frames that none can read."""

    def __init__(self, axes: list[tuple[int, SignalSpec]], counter: SignalSpec | None, leads: bool) -> None:
        spec = axes[0][1]
        self.can_id, self.mask, self.extended = spec.can_id, spec.mask, spec.extended
        self.kind = int(CanFlag.EXT) if spec.extended else 0
        self.wild = spec.mask & 0xFF == 0  # J1939 from any source address
        self.leads = leads
        self.when = [(Decoder([s]), np.array(values)) for s, values in spec.when]
        self.select_need = max((s.need for s, _ in spec.when), default=0)
        self.axes = [axis for axis, _ in axes]
        self.counter = counter
        self.decoder = Decoder([s for _, s in axes])
        self.numbers = Decoder([counter]) if counter is not None else None
        self.skips = counter is not None and counter.modulus != 1 << counter.length
        self.need = max(self.decoder.need, self.numbers.need if self.numbers else 0)
        self.id_text = f"0x{self.can_id:X}"
        if self.mask != WHOLE_ID:
            self.id_text = f"PGN 0x{self.can_id >> 8:X}" + ("" if self.wild else f" from 0x{self.can_id & 0xFF:02X}")
        chosen = "".join(f", {s.name.rpartition('.')[2]} {_ranges(values)}" for s, values in spec.when)
        self.name = f"{self.id_text}{chosen} ({', '.join('xyz'[a] for a in self.axes)})"
        self.presence = Presence()

    def places(self, can_id: U32) -> I64:
        """Places of the frames with this identifier, whatever their kind."""
        if self.mask != WHOLE_ID:
            can_id = can_id & np.uint32(self.mask)
        places: I64 = (can_id == self.can_id).nonzero()[0]
        return places

    def chosen(self, data: U8, length: U8) -> npt.NDArray[np.bool_]:
        """Which of the frames, all at least `select_need` bytes long, the selectors give to this message."""
        good = np.ones(length.size, np.bool_)
        for decoder, values in self.when:
            raw = decoder.raw(data, length)[:, 0]
            good &= raw == values[0] if values.size == 1 else np.isin(raw, values)
        return good

    def shares(self, other: Message) -> bool:
        """Whether both read the same bits of the same frames."""
        both = self.mask & other.mask
        if self.extended != other.extended or (self.can_id ^ other.can_id) & both:
            return False
        mine = {(s.columns, s.shift, s.when) for s in self.decoder.specs}
        return any((s.columns, s.shift, s.when) in mine for s in other.decoder.specs)


def _ranges(values: tuple[int, ...]) -> str:
    shown = ", ".join(map(str, values[:4]))
    return f"{shown}, ..." if len(values) > 4 else shown


class Assembly:
    """Matches frames of several messages to samples.

    With a SYNC a set is the SYNC (message number `sync`) and the frames up to the next. With a counter in each message
    it is the frames of one counter value. Else a set begins with the message that comes first: until it is known the
    one with the lowest identifier (it wins the bus when a device queues its frames at once), then the one before which
    the pause is longest, learned from the kernel's stamps. A set that lasts longer than LATE_RATIO periods is broken
    too: frames of two samples would make a false one.
    """

    def __init__(self, messages: Sequence[Message], sync: bool) -> None:
        self.size = len(messages) + sync
        self.sync = len(messages) if sync else -1
        self.keyed = not sync and all(m.counter is not None for m in messages)
        self.first = (
            self.sync if sync else min(range(self.size), key=lambda j: (messages[j].extended, messages[j].can_id))
        )
        self.known = self.keyed or sync
        self.key = -1  # counter of the open set; of the last SYNC
        self.turn = 0  # largest value of the SYNC's counter, 0 = not yet known
        self.done = False  # that set has been handed out
        self.number = -1 if sync else 0  # sets so far, broken ones included
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

    def _steps(self, counter: int) -> int:
        """SYNCs since the last one seen, by the optional counter: 1 to its overflow value, then 1 again (CiA 301); 0
        stands for none. The overflow value is the largest that was seen before it began anew."""
        last, self.key = self.key, counter
        if counter < 1 or last < 1 or counter == last:
            return 1
        if counter > last:
            return counter - last
        self.turn = max(self.turn, last)
        return counter + self.turn - last

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
        counts = int(self.sync < 0)  # else the SYNC numbers the sets
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
                if counts:
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
                self.number += counts
                current = []
            if m == self.sync:
                self.number += self._steps(key[k])
            current.append(k)
            if len(current) == self.size:
                whole.append(current)
                numbers.append(self.number)
                self.number += counts
                current = []
                self.done = True
        self.open = current
        return whole, numbers, broken, duplicates

    def save(self) -> State:
        return {
            "first": self.first,
            "known": self.known,
            "key": self.key,
            "turn": self.turn,
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
        self.number, self.turn = s["number"], s["turn"]
        self.pending = [(m, t, c, f, list(values)) for m, t, c, f, values in s["pending"]]
        self.last_ns, self.pauses, self.seen = s["last_ns"], list(s["pauses"]), list(s["seen"])
        self.period_ns = s["period_ns"]
