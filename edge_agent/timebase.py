"""Clocks: which monotonic instant belongs to a wall time, a GNSS epoch, a device's sample number.

Four clocks meet here: the receiver's UTC in the sentence, the host's monotonic clock at arrival, the host's wall clock
(seen once a second as a Tick), each device's sample counter. Everything is kept in monotonic int64 ns; UTC is put on
when a record is written. No function here reads a clock.

- `WallMap`   monotonic -> UTC from the Ticks; the segment's map is a copy that stays fixed while a file is open.
- `FixClock`  a receiver's epoch -> monotonic, free of the arrival's jitter and of the host's clock steps.
- `DeviceClock`  sample number -> monotonic, from the lower envelope of the arrival stamps: a delay only ever adds.

Left out: what the motion itself says about the latency (needs both sensors; belongs to the fusion).
"""

from __future__ import annotations

import numpy as np

from edge_agent.messages import I64, MS, AccelBlock, AccelFlag, GnssFix, S, State, Tick

STEP_NS = S // 2
"""A clock that moves by more than this has been found or stepped; anything less is slewed."""


class WallMap:
    """Monotonic -> UTC, smoothed over some Ticks; a step above 0.5 s is taken at once and reported."""

    GAIN = 0.1  # 10 Ticks: averages the scheduling jitter of a read, follows an NTP slew of 500 ppm within 5 ms

    def __init__(self) -> None:
        self.offset_ns: int | None = None  # utc - monotonic
        self.sync = False
        self.error_ns = 0

    def tick(self, t_ns: int, tick: Tick) -> int:
        """Take a Tick; return the step in ns (0 = none). The first Tick is not a step."""
        new = tick.utc_ns - t_ns
        found = tick.sync and not self.sync
        self.sync, self.error_ns = tick.sync, tick.error_ns
        if self.offset_ns is None:
            self.offset_ns = new
            return 0
        move = new - self.offset_ns
        if abs(move) > STEP_NS:
            self.offset_ns = new
            return move
        self.offset_ns = new if found else self.offset_ns + int(self.GAIN * move)
        return 0

    def save(self) -> State:
        return {"offset": self.offset_ns, "sync": self.sync, "error": self.error_ns}

    def load(self, s: State) -> None:
        self.offset_ns, self.sync, self.error_ns = s["offset"], s["sync"], s["error"]


class FixClock:
    """When a fix was true, on the monotonic clock.

    The receiver's epochs are exact in its own UTC; only the map B = monotonic - UTC is unknown. It is -offset of the
    host's wall map while that is synchronised and agrees with the arrivals (latency within [-20 ms, 2 s]); otherwise
    (smoothed arrival - epoch) - latency, with the latency configured, learned while the host was synchronised, or
    100 ms with an sd of 50 ms and `time_uncertain`. B moves at 5 ms/s at most, so fixes never jump against
    each other; a change above 0.5 s is a step of the receiver's time.
    """

    DEFAULT_LATENCY_NS = 100 * MS  # middle of the 50-500 ms that RTK receivers show, weighted to the usual
    LATENCY_RANGE_NS = (-20 * MS, 2 * S)
    SLEW = 0.005  # s/s
    TAU_NS = 10 * S  # of the smoothed arrival: 50 ppm of a cheap crystal lag 0.5 ms
    CONVERGED_NS = 2 * MS
    STEP_COUNT = 3  # epochs that agree on a new receiver time before it is believed
    LATE_NS = 10 * S  # a backlog is late for some seconds, a stepped receiver for ever

    def __init__(self, latency_ms: float | None) -> None:
        self.fixed_ns = None if latency_ms is None else int(latency_ms * MS)
        self.learned_ns: int | None = None
        self._delta: int | None = None  # smoothed arrival - utc
        self._map: int | None = None  # B
        self._last_ns = 0  # arrival of the fix before
        self._odd = 0  # consecutive epochs against the map
        self._odd_since_ns = 0

    def latency_ns(self) -> int:
        if self.fixed_ns is not None:
            return self.fixed_ns
        return self.learned_ns if self.learned_ns is not None else self.DEFAULT_LATENCY_NS

    def time(self, fix: GnssFix, wall: WallMap) -> tuple[int, bool, int]:
        """Return (t_ns, time_uncertain, step_ns of the receiver's time, 0 = none) for the next fix of this receiver."""
        known = self.fixed_ns is not None or self.learned_ns is not None
        if fix.utc_ns == 0:
            return fix.arrival_ns - self.latency_ns(), not known, 0
        x = fix.arrival_ns - fix.utc_ns
        dt = max(0, fix.arrival_ns - self._last_ns)
        self._last_ns = fix.arrival_ns
        step = 0
        if self._delta is None:
            self._delta = x
        move = x - self._delta
        if abs(move) > STEP_NS:
            if self._odd == 0:
                self._odd_since_ns = fix.arrival_ns
            self._odd += 1
            early = move < 0  # nothing arrives before it is true: the receiver's time itself has moved
            if self._odd >= self.STEP_COUNT and (early or fix.arrival_ns - self._odd_since_ns > self.LATE_NS):
                step, self._delta, self._map, self._odd = -move, x, None, 0
            elif early:
                return fix.arrival_ns - self.latency_ns(), True, 0
        else:
            self._odd = 0
            self._delta += int(move * min(1.0, max(0.02, dt / self.TAU_NS)))

        target = self._delta - self.latency_ns()
        exact = False
        if wall.sync and wall.offset_ns is not None:
            latency = x + wall.offset_ns
            if self.LATENCY_RANGE_NS[0] <= latency <= self.LATENCY_RANGE_NS[1]:
                if self.learned_ns is None:
                    self.learned_ns = latency
                self.learned_ns += int((latency - self.learned_ns) * min(1.0, max(0.01, dt / (6 * self.TAU_NS))))
                known = True
                if self.fixed_ns is None:
                    target, exact = -wall.offset_ns, True
        if self._map is None or (exact and self._map is not None and abs(target - self._map) > STEP_NS):
            self._map = target
        limit = max(1, int(self.SLEW * dt))
        self._map += max(-limit, min(limit, target - self._map))
        uncertain = not known or abs(target - self._map) > self.CONVERGED_NS
        return fix.utc_ns + self._map, uncertain, step

    def time_of(self, utc_ns: int, arrival_ns: int) -> int:
        """t_ns of a sentence that is no fix; teaches the clock nothing."""
        if utc_ns and self._map is not None:
            t_ns = utc_ns + self._map
            if self.LATENCY_RANGE_NS[0] <= arrival_ns - t_ns <= self.LATENCY_RANGE_NS[1]:
                return t_ns
        return arrival_ns - self.latency_ns()

    def save(self) -> State:
        return {
            "learned": self.learned_ns,
            "delta": self._delta,
            "map": self._map,
            "last": self._last_ns,
            "odd": [self._odd, self._odd_since_ns],
        }

    def load(self, s: State) -> None:
        self.learned_ns, self._delta, self._map, self._last_ns = s["learned"], s["delta"], s["map"], s["last"]
        self._odd, self._odd_since_ns = s["odd"]


class DeviceClock:
    """Sample times of one accelerometer, strictly increasing.

    Frames with the kernel's stamp, from a device without a counter and without a configured rate, keep their stamps.
    Otherwise t = line through the lower envelope of (sample number, arrival): bins of the earliest arrival against the
    line before, at most 64 of them, pairwise merged until each spans 10 s, then sliding; the least-squares line through
    the bins moves the output by at most 5 % of the elapsed time. Without a counter, a lasting lateness of a whole
    period or more means lost samples: the number is advanced and the sample flagged GAP_BEFORE.
    """

    BINS = 64
    BIN_NS = 10 * S
    SLEW_YOUNG, SLEW = 0.05, 0.005
    RESET_NS = STEP_NS
    WATCH = 12  # blocks, about a second at block_ms 100

    def __init__(self, rate_hz: float | None, counted: bool) -> None:
        self.counted = counted
        self.nominal_ns = None if rate_hz is None else S / rate_hz
        self.period_ns = self.nominal_ns or 0.0
        self._shift = 0  # samples that never came, where the device does not count
        self._bin_c: list[int] = []
        self._bin_t: list[int] = []
        self._span = 1  # blocks in a full bin
        self._fill = 0  # blocks in the newest bin
        self._c0 = 0  # the line: t = _t0 + period (c - _c0)
        self._t0 = 0
        self._late: list[float] = []  # earliest residuals of the last blocks, ns
        self._last_t = -1
        self._last_c = 0

    @property
    def rate_error(self) -> float | None:
        """The device's rate against the nominal one, less 1; None until arrivals of 30 s have told it."""
        if self.nominal_ns is None or not self._bin_t or self._bin_t[-1] - self._bin_t[0] < 3 * self.BIN_NS:
            return None
        return self.nominal_ns / self.period_ns - 1.0

    def times(self, block: AccelBlock) -> tuple[I64, bool]:
        """Return (t_ns (n,), gap) for the next block; gap = samples were found missing before its first."""
        a = block.t_ns
        if not self.counted and self.nominal_ns is None and not block.drain_stamped:
            return self._increasing(a), False
        c = block.count + self._shift
        if not self._bin_t and not self._begin(a, c):
            return self._increasing(a), False
        p = self._t0 + np.rint((c - self._c0) * self.period_ns).astype(np.int64)
        e = a - p
        k = int(e.argmin())
        early = float(e[k])
        if abs(early) > self.RESET_NS:  # the device restarted, or the host slept: a new line
            self._bin_c, self._bin_t, self._late, self._span, self._fill = [], [], [], 1, 0
            if not self._begin(a, c):
                return self._increasing(a), True
            p = self._t0 + np.rint((c - self._c0) * self.period_ns).astype(np.int64)
            self._put(int(c[k]), int(a[k]))
            return self._increasing(p), True
        gap = False
        self._late = [*self._late[-(self.WATCH - 1) :], early]
        if not self.counted and len(self._late) == self.WATCH and min(self._late) > 0.75 * self.period_ns:
            lost = int(round(min(self._late) / self.period_ns))
            self._shift += lost
            self._late = []
            c = c + lost
            gap = True
            p = self._t0 + np.rint((c - self._c0) * self.period_ns).astype(np.int64)
            k = int((a - p).argmin())
        self._put(int(c[k]), int(a[k]))
        move = self._refit(int(c[-1]))
        # spread over the block, so that no single step between samples takes the whole correction
        span = max(1, int(c[-1]) - self._last_c)
        p = p + np.rint(move * ((c - self._last_c) / span)).astype(np.int64)
        self._last_c = int(c[-1])
        return self._increasing(p), gap

    def _begin(self, a: I64, c: I64) -> bool:
        """Lay the first line; False while one block says nothing about the rate."""
        if self.period_ns == 0.0:
            if c.size < 2 or c[-1] <= c[0] or a[-1] <= a[0]:
                return False
            self.period_ns = float(a[-1] - a[0]) / float(c[-1] - c[0])
        e = a - np.rint((c - c[0]) * self.period_ns).astype(np.int64)
        self._c0, self._t0, self._last_c = int(c[0]), int(e.min()), int(c[0])
        return True

    def _put(self, c: int, t: int) -> None:
        if self._fill in (0, self._span):
            if len(self._bin_c) == self.BINS:
                wide = self._bin_t[-1] - self._bin_t[-2]
                if wide >= self.BIN_NS:
                    del self._bin_c[0], self._bin_t[0]
                else:
                    self._merge()
            self._bin_c.append(c)
            self._bin_t.append(t)
            self._fill = 1
            return
        self._fill += 1
        if t - self._bin_t[-1] < (c - self._bin_c[-1]) * self.period_ns:
            self._bin_c[-1], self._bin_t[-1] = c, t

    def _merge(self) -> None:
        cs, ts = [], []
        for i in range(0, self.BINS, 2):
            later = self._bin_t[i + 1] - self._bin_t[i] < (self._bin_c[i + 1] - self._bin_c[i]) * self.period_ns
            cs.append(self._bin_c[i + later])
            ts.append(self._bin_t[i + later])
        self._bin_c, self._bin_t, self._span = cs, ts, 2 * self._span

    def _refit(self, c_now: int) -> float:
        """Least-squares line through the bins; move the line towards it within the slew limit; return the move, ns."""
        n = len(self._bin_c)
        if n < 2:
            return 0.0
        c_last, t_last = self._bin_c[-1], self._bin_t[-1]
        x = (np.array(self._bin_c) - c_last).astype(np.float64)
        y = (np.array(self._bin_t) - t_last).astype(np.float64)
        mx, my = float(x.sum()) / n, float(y.sum()) / n
        x -= mx
        y -= my
        sxx = float((x * x).sum())
        period = float((x * y).sum()) / sxx if sxx > 0 else self.period_ns
        if n < 8 and self.nominal_ns is not None:
            period = self.nominal_ns  # a configured rate beats a fit over less than a second
        if not 0.5 * self.period_ns < period < 2.0 * self.period_ns:
            period = self.period_ns
        # the line lies on the envelope: through the mean of the bins, then down to the mean of the lower half
        y -= x * period
        y.sort()
        low = float(y[: (n + 1) // 2].sum()) / ((n + 1) // 2)
        target = float(t_last) + my + low + period * (float(c_now - c_last) - mx)
        here = self._t0 + (c_now - self._c0) * self.period_ns
        slew = self.SLEW if self._bin_t[-1] - self._bin_t[0] >= self.BIN_NS else self.SLEW_YOUNG
        limit = slew * max(self.period_ns, here - self._last_t) if self._last_t >= 0 else float(self.RESET_NS)
        move = float(max(-limit, min(limit, target - here)))
        self._c0, self._t0, self.period_ns = c_now, int(round(here + move)), period
        return move

    def _increasing(self, t: I64) -> I64:
        """Strictly increasing and after everything given before; ties are one ns apart."""
        n = np.arange(t.size, dtype=np.int64)
        out: I64 = np.maximum.accumulate(np.maximum(t - n, self._last_t + 1)) + n
        if t.size:
            self._last_t = int(out[-1])
        return out

    def save(self) -> State:
        return {
            "period": self.period_ns,
            "shift": self._shift,
            "bin_c": list(self._bin_c),
            "bin_t": list(self._bin_t),
            "span": [self._span, self._fill],
            "line": [self._c0, self._t0],
            "late": list(self._late),
            "last": [self._last_t, self._last_c],
        }

    def load(self, s: State) -> None:
        self.period_ns, self._shift = s["period"], s["shift"]
        self._last_t, self._last_c = s["last"]
        self._bin_c, self._bin_t, self._late = list(s["bin_c"]), list(s["bin_t"]), list(s["late"])
        self._span, self._fill = s["span"]
        self._c0, self._t0 = s["line"]


def with_times(block: AccelBlock, t_ns: I64, fitted: bool, gap: bool) -> AccelBlock:
    """The block with its final times, flags FITTED and GAP_BEFORE put in."""
    flags = block.flags | np.uint8(AccelFlag.FITTED) if fitted else block.flags.copy()
    if gap and flags.size:
        flags[0] |= np.uint8(AccelFlag.GAP_BEFORE)
    return AccelBlock(block.source, t_ns, block.xyz, flags, block.count, block.drain_stamped)
