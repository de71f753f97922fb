"""Samples that are not to be believed: single ones far from their neighbours (SPIKE), and an axis that no longer moves
though its noise always did (STUCK).

Rules:
- What is plausible is learned from the sensor itself, in chunks of CHUNK samples: how far its values reach, how they
  scatter from sample to sample, and how much of that is noise in the quietest chunk so far. Nothing is judged before.
- A spike leaves the range of the chunk before by SPIKE_RANGE times its half and SPIKE_SCALE times its scatter; the two
  samples on either side of it agree with each other to 1 / SPIKE_ALONE of its height, and SPIKE_AFTER samples behind it
  stay within 1 / SPIKE_CALM of it. An impact or an earthquake does not: it goes on. A suspect (nothing else) waits for
  them, or until one of them acquits it.
- An axis is stuck when STUCK_RUN samples hold one value, while the noise was above STUCK_NOISE steps of the converter
  in every chunk that was looked at, up to the moment at which the value stopped. With so much noise the likeliest
  value comes up in less than half of the samples, so 32 of them are no chance (2^-32); with less a quiet sensor on a
  quiet structure holds one value for minutes, and nothing can be said. Who has been seen so is never called stuck.
- Noise is what the third difference leaves: it takes out motion below about a tenth of the rate. Medians, so that a
  blow does not count as noise.
- Any cut of the samples gives the same samples and flags. What is learned ends with the process.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64, STUCK_SAMPLES, U8, AccelFlag, Event, Reject, State

CHUNK = 64
LEARN_CHUNKS = 16  # 1024 samples before an axis can be called stuck
EVERY = 8  # later the noise of one chunk in so many is looked at
SPIKE_RANGE = 3.0
SPIKE_SCALE = 20.0
SPIKE_ALONE = 8.0
SPIKE_AFTER = 8
SPIKE_CALM = 3.0
LOOK = 16  # samples from one look for a stuck axis to the next
STUCK_RUN = STUCK_SAMPLES - LOOK
STUCK_NOISE = 0.75  # steps; see above
ABRUPT = 0.6  # the same for the last samples before the value stopped, which are few
STUCK_SPREAD = 2.5  # steps: going to and fro between two or three values says nothing about the noise
ALIVE_CHUNKS = 2  # a stuck axis is believed again after so many chunks with motion from sample to sample
QUIET_CHUNKS = 16  # a run of spikes has ended after so many without one

MEDIAN_TO_SD = 1.0 / 0.6744897501960817  # of a Gaussian
SCATTER = MEDIAN_TO_SD / math.sqrt(2.0)  # median first difference of white noise to its sd
WHITE = MEDIAN_TO_SD / math.sqrt(20.0)  # the same of the third difference, whose coefficients are 1 -3 3 -1

# numpy takes an IntFlag for an int64
SATURATED, SPIKE, STUCK = np.uint8(AccelFlag.SATURATED), np.uint8(AccelFlag.SPIKE), np.uint8(AccelFlag.STUCK)
Rows = tuple[I64, F64, U8, I64, U8]
"""t_ns (n,), values (n, 3) in sensor axes, flags (n,), count (n,), soft (n,)."""


class _Axis:
    """What is known of one axis."""

    __slots__ = ("alive", "floor", "scatter", "step", "stuck", "stuck_ns", "waiting")

    def __init__(self) -> None:
        self.step = math.inf  # smallest difference seen: a step of the converter
        self.scatter = math.inf  # from sample to sample (sd), motion included; at least a step
        self.floor = math.inf  # noise (sd) of the quietest chunk
        self.waiting = math.inf  # noise of the last chunk, which may hold the begin of a stuck stretch
        self.stuck = False
        self.stuck_ns = 0
        self.alive = 0  # chunks with motion since

    @property
    def can_stick(self) -> bool:
        return not self.stuck and STUCK_NOISE * self.step <= self.floor < math.inf

    def save(self) -> list[float]:
        return [self.step, self.scatter, self.floor, self.waiting, self.stuck, self.alive, self.stuck_ns]

    def load(self, s: list[float]) -> None:
        self.step, self.scatter, self.floor, self.waiting = s[:4]
        self.stuck, self.alive, self.stuck_ns = bool(s[4]), int(s[5]), int(s[6])


class Watch:
    """One accelerometer's three axes. `low`, `high` (3,): the ends of the range, at and beyond which a sample is
    saturated. Counters: saturated, stuck, spikes (samples)."""

    def __init__(self, source: str, low: F64, high: F64, counters: dict[str, int]) -> None:
        self._source = source
        self._end_low, self._end_high = low, high
        self._ends = low.tolist(), high.tolist()
        self.counters = counters
        self._low, self._high = low.copy(), high.copy()  # what no plausible sample reaches
        self._now: F64 = np.zeros((3, CHUNK))  # the chunk under way,
        self._fill = 0  # of which so many samples are there,
        self._old: F64 = np.zeros((3, CHUNK))  # and the one before
        self._chunks = 0
        self._axes = [_Axis() for _ in range(3)]
        self._any_stuck = False
        self._sticky: list[int] = []  # axes with noise enough to be called stuck
        self._last: F64 = np.zeros((2, 3))  # the two samples before the next
        self._was_out = np.zeros(3, np.bool_)  # the sample before was beyond what is plausible,
        self._any_out = False  # perhaps (a hint that saves a look)
        self._held: Rows | None = None  # a suspect and what came behind it
        self._suspects: list[tuple[int, int, float]] = []  # row among them, axis, least height of a spike
        self._spike_ns = 0  # a run of spikes goes on since,
        self._spike_chunk = 0  # the last one in this chunk,
        self._spike_count = 0  # so many

    def judge(self, t_ns: I64, values: F64, flags: U8, count: I64, soft: U8, notes: list[Reject | Event]) -> Rows:
        """Flag the next samples (n >= 1; flags in place) and return those that are judged, in m/s2 of sensor axes."""
        n = t_ns.size
        ready: list[Rows] = []
        waited = False
        at = 0
        while at < n:
            begin = self._fill
            end = min(n, at + CHUNK - begin)
            rows: Rows = (t_ns[at:end], values[at:end], flags[at:end], count[at:end], soft[at:end])
            part = rows[1]
            out: list[tuple[int, int, float]] = []
            if self._any_stuck:
                rows[2][:] |= STUCK
                self.counters["stuck"] += end - at
            beyond = (part >= self._high) | (part <= self._low)
            if np.count_nonzero(beyond):
                part = self._beyond(rows, beyond, values[at - 1 : at] if at else None, out)
            elif self._any_out:
                self._was_out, self._any_out = np.zeros(3, np.bool_), False
            self._now[:, begin : begin + end - at] = part.T
            self._fill += end - at
            for look in range(begin - begin % LOOK + LOOK, self._fill + 1, LOOK) if self._sticky else ():
                same = [i for i in self._sticky if self._now.item(i, look - 1) == self._now.item(i, look - LOOK)]
                if same and self._stops(same, look, int(t_ns[at + look - begin - 1]), notes):
                    rows[2][look - begin :] |= STUCK
                    self.counters["stuck"] += end - (at + look - begin)
            if out or self._held is not None:
                rows = self._spikes(rows, out, notes)
                waited = True
            else:
                self._last = rows[1][-2:] if end - at > 1 else np.concatenate([self._last[1:], rows[1]])
            ready.append(rows)
            if self._fill == CHUNK:
                self._fill = 0
                self._chunk(int(t_ns[end - 1]), notes)
            at = end
        if not waited:
            return t_ns, values, flags, count, soft
        return _joined(ready)

    def _beyond(
        self, rows: Rows, beyond: npt.NDArray[np.bool_], before: F64 | None, out: list[tuple[int, int, float]]
    ) -> F64:
        """Samples that are saturated or leave the plausible range (n, 3): suspects go to `out`; returns what the chunk
        shall hold instead of the values. `before` (1, 3): the sample before, None: that of the block before."""
        part = rows[1]
        end = (part >= self._end_high) | (part <= self._end_low)
        if np.count_nonzero(end):
            hit = end.any(axis=1)
            rows[2][hit] |= SATURATED
            self.counters["saturated"] += int(np.count_nonzero(hit))
        if not self._chunks:
            return part
        if before is None:
            before = self._last[1:] if self._held is None else self._held[1][-1:]
        before = np.concatenate([before, part])
        was = np.concatenate([self._was_out[None], beyond])
        for row, axis in zip(*(i.tolist() for i in beyond.nonzero()), strict=True):
            least = SPIKE_SCALE * self._axes[axis].scatter
            # it agrees with none of its neighbours, which agree with each other: a smooth motion does not wait for them
            if abs(part[row, axis] - before[row, axis]) >= (1.0 - 1.0 / SPIKE_ALONE) * least:
                out.append((row, axis, least))
        self._was_out = beyond[-1]
        self._any_out = True
        # one alone does not widen what is plausible, two in a row do
        return np.where(beyond & ~was[:-1], before[:-1], part)

    def _spikes(self, rows: Rows, out: list[tuple[int, int, float]], notes: list[Reject | Event]) -> Rows:
        """Judge the suspects whose neighbours are there; hold the rest back."""
        if self._held is not None:
            k = self._held[0].size
            rows = _joined([self._held, rows])
            out = self._suspects + [(row + k, axis, least) for row, axis, least in out]
        n = rows[0].size
        around = np.concatenate([self._last, rows[1]])  # row i stands at i + 2
        self._suspects = []
        keep = n
        for row, axis, least in out:
            a, b, x, *after = around[row : row + 3 + SPIKE_AFTER, axis].tolist()
            height = 0.0
            if len(after) >= 2:
                low, m0, m1, high = sorted((a, b, after[0], after[1]))
                level = 0.5 * (m0 + m1)
                height = abs(x - level)
                if height < least or height < SPIKE_ALONE * (high - low):
                    continue
                if max(abs(y - level) for y in after) * SPIKE_CALM > height:
                    continue
            if len(after) < SPIKE_AFTER:
                keep = min(keep, row)
                self._suspects.append((row - keep, axis, least))
            else:
                first = not rows[2][row] & SPIKE
                rows[2][row] |= SPIKE
                self._spike(int(rows[0][row]), axis, height, int(first), notes)
        self._last = around[keep : keep + 2].copy()
        self._held = None
        if keep < n:
            self._held = (rows[0][keep:], rows[1][keep:], rows[2][keep:], rows[3][keep:], rows[4][keep:])
        return rows[0][:keep], rows[1][:keep], rows[2][:keep], rows[3][:keep], rows[4][:keep]

    def _spike(self, t_ns: int, axis: int, height: float, new: int, notes: list[Reject | Event]) -> None:
        self.counters["spikes"] += new
        self._spike_count += new
        self._spike_chunk = self._chunks
        if self._spike_ns:
            return
        self._spike_ns = t_ns
        text = f"single samples far from their neighbours, first by {height:.3g} m/s2 on {'xyz'[axis]}: left out"
        notes.append(Event(t_ns, "ACCEL_SPIKE", self._source, text, (("height_mps2", height),), t_ns))

    # ------------------------------------------------------------------------------------------------------- learning

    def _chunk(self, t_ns: int, notes: list[Reject | Event]) -> None:
        """A chunk is full: learn from it, and see whether an axis moves."""
        v = self._now
        top, bottom = np.maximum.reduce(v, axis=1).tolist(), np.minimum.reduce(v, axis=1).tolist()
        learn = self._chunks < 2 * LEARN_CHUNKS or self._chunks % EVERY == 0
        step, scatter, noise = self._look(v) if learn else ([], [], [])
        for i, axis in enumerate(self._axes):
            half = 0.5 * (top[i] - bottom[i])
            if axis.stuck:
                self._alive(i, axis, t_ns, notes)
            elif half == 0.0:
                axis.floor = axis.waiting = 0.0  # this sensor may do so
            else:
                axis.floor = min(axis.floor, axis.waiting)
                axis.waiting = math.inf
            if learn:
                axis.step = min(axis.step, step[i])
                axis.scatter = max(scatter[i], axis.step)
                if half > 0.0 and not axis.stuck:
                    # equal neighbours in half of the samples: who repeats his samples has less noise than it seems
                    enough = scatter[i] > 0.0 and 2.0 * half > STUCK_SPREAD * axis.step
                    axis.waiting = noise[i] if enough else 0.0
            reach = half + max(SPIKE_SCALE * axis.scatter, SPIKE_RANGE * half)
            middle = bottom[i] + half
            self._high[i] = min(self._ends[1][i], middle + reach)
            self._low[i] = max(self._ends[0][i], middle - reach)
        self._chunks += 1
        self._now, self._old = self._old, v
        self._settle()
        if self._spike_ns and self._chunks - self._spike_chunk > QUIET_CHUNKS:
            text = f"{self._spike_count} samples were far from their neighbours"
            values = (("samples", float(self._spike_count)),)
            notes.append(Event(t_ns, "ACCEL_SPIKE_END", self._source, text, values, self._spike_ns, t_ns))
            self._spike_ns = self._spike_count = 0

    def _look(self, v: F64) -> tuple[list[float], list[float], list[float]]:
        """Of each row: the smallest difference that is not zero (inf: none), scatter from sample to sample, noise."""
        d = np.abs(v[:, 1:] - v[:, :-1])
        d.sort(axis=1)
        zeros = np.count_nonzero(d == 0.0, axis=1).tolist()
        step = [float(d[i, n]) if n < CHUNK - 1 else math.inf for i, n in enumerate(zeros)]
        return step, (d[:, CHUNK // 2] * SCATTER).tolist(), _white(v).tolist()

    def _settle(self) -> None:
        """What follows from the axes' states."""
        self._any_stuck = any(a.stuck for a in self._axes)
        self._sticky = [i for i in range(3) if self._chunks >= LEARN_CHUNKS and self._axes[i].can_stick]

    def _stops(self, axes: list[int], look: int, t_ns: int, notes: list[Reject | Event]) -> bool:
        """Whether after so many samples of the chunk one of the axes is found stuck, and none was before."""
        was_stuck = self._any_stuck
        for i in axes:
            axis = self._axes[i]
            past = np.concatenate([self._old[i], self._now[i, :look]])
            moved = np.flatnonzero(past[1:] != past[:-1])
            n = int(moved[-1]) + 1 if moved.size else 0  # samples before the value that stays
            if past.size - n < STUCK_RUN:
                continue
            # a structure that comes to rest does so bit by bit; who stops at once is stuck
            before = past[None, max(0, n - STUCK_RUN) : n]
            if n < LOOK or _white(before)[0] < ABRUPT * axis.step:
                axis.floor = axis.waiting = 0.0
                continue
            axis.stuck, axis.stuck_ns, axis.alive, axis.waiting = True, t_ns, 0, math.inf
            value, steps = float(past[-1]), axis.floor / axis.step
            text = f"{'xyz'[i]} stays at {value:.6g} m/s2 though its noise was never below {steps:.1f} steps: not used"
            values = (("value_mps2", value), ("noise_mps2", axis.floor), ("step_mps2", axis.step))
            notes.append(Event(t_ns, "ACCEL_STUCK", self._source, text, values, t_ns))
        self._settle()
        return self._any_stuck and not was_stuck

    def _alive(self, i: int, axis: _Axis, t_ns: int, notes: list[Reject | Event]) -> None:
        v = self._now[i]
        axis.alive = axis.alive + 1 if np.count_nonzero(v[1:] != v[:-1]) >= CHUNK // 2 else 0
        if axis.alive < ALIVE_CHUNKS:
            return
        axis.stuck = False
        text = f"{'xyz'[i]} moves again"
        notes.append(Event(t_ns, "ACCEL_STUCK_END", self._source, text, (), axis.stuck_ns, t_ns))

    # ---------------------------------------------------------------------------------------------------------- state

    def save(self) -> State:
        return {
            "band": [self._low.copy(), self._high.copy()],
            "now": self._now.copy(),
            "old": self._old,
            "count": [self._fill, self._chunks],
            "axes": [a.save() for a in self._axes],
            "last": self._last,
            "was_out": self._was_out,
            "held": None if self._held is None else list(self._held),
            "suspects": [list(s) for s in self._suspects],
            "spike": [self._spike_ns, self._spike_chunk, self._spike_count],
        }

    def load(self, s: State) -> None:
        self._low, self._high = s["band"]
        self._any_out = True
        self._now, self._old, self._last, self._was_out = s["now"], s["old"], s["last"], s["was_out"]
        self._fill, self._chunks = s["count"]
        for axis, kept in zip(self._axes, s["axes"], strict=True):
            axis.load(kept)
        self._settle()
        held = s["held"]
        self._held = None if held is None else (held[0], held[1], held[2], held[3], held[4])
        self._suspects = [(row, axis, least) for row, axis, least in s["suspects"]]
        self._spike_ns, self._spike_chunk, self._spike_count = s["spike"]


def _joined(parts: list[Rows]) -> Rows:
    return (
        np.concatenate([p[0] for p in parts]),
        np.concatenate([p[1] for p in parts]),
        np.concatenate([p[2] for p in parts]),
        np.concatenate([p[3] for p in parts]),
        np.concatenate([p[4] for p in parts]),
    )


def _white(v: F64) -> F64:
    """Standard deviation (k,) of the white part of k rows: the median third difference's."""
    d = np.abs(v[:, 3:] - v[:, :-3] - 3.0 * (v[:, 2:-1] - v[:, 1:-2]))
    d.sort(axis=1)
    noise: F64 = d[:, d.shape[1] // 2] * WHITE
    return noise
