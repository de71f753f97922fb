"""Accelerations into the ring: only newer ones, only complete ones, gaps bridged. A saturated sample says only that
the motion was beyond the range, a spike or a stuck axis says nothing: they are left out like samples that never came.

A gap is an interval longer than 3.5 usual ones and 50 ms; shorter ones are what a lost frame makes, and a straight line
across them is better than anything else. Across a gap stands the mean of the last `accel_mean_s`, with white noise
q_gap = 2 var(a) tau on top, tau = the reciprocal mean angular frequency of the accelerations, at most 0.5 s. The usual
interval is the median of the first 33 and is learnt anew when 33 in a row are gaps (the sensor's rate was changed).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from edge_agent.fusion.integrals import CHUNK, NS, SYNTHETIC, Ring
from edge_agent.fusion.point import Gap, Point
from edge_agent.messages import F64, I64, AccelBlock, AccelFlag, Event, FusionSettings, S

_STUCK = np.uint8(AccelFlag.STUCK)
_UNUSED = np.uint8(AccelFlag.SATURATED | AccelFlag.SPIKE | AccelFlag.STUCK)
NOMINAL = 33
LEAST_GAP_NS = 50_000_000
GAPS = 64
"""Gaps kept per point while no fix ends them; beyond, the two oldest become one."""


class Feed:
    """Writes the ring of all points; keeps their gaps."""

    def __init__(self, points: list[Point], settings: FusionSettings) -> None:
        self.points = points
        self.settings = settings
        self.ring = Ring(len(points))
        self.doubted: list[int] = []  # points whose accelerometer has just been found stuck; the station takes them
        self.of: dict[str, list[int]] = {}
        for i, p in enumerate(points):
            if p.accelerometer is not None:
                self.of.setdefault(p.accelerometer, []).append(i)

    def take(self, blocks: Mapping[str, AccelBlock], lo: int) -> tuple[list[int], list[Event], bool]:
        """Append samples lo to lo + CHUNK of each block: the points that got any, events, and whether more follow."""
        even: list[tuple[int, I64, F64]] = []
        touched: list[int] = []
        events: list[Event] = []
        more = False
        for name, b in blocks.items():
            points = self.of.get(name)
            if not points or len(b.t_ns) <= lo:
                continue
            t, a = b.t_ns[lo : lo + CHUNK], b.xyz[lo : lo + CHUNK]
            more = more or len(b.t_ns) > lo + CHUNK
            unused = b.flags[lo : lo + CHUNK] & _UNUSED
            stuck = False
            if np.count_nonzero(unused) or np.count_nonzero(np.isfinite(a)) < a.size:
                stuck = bool((unused & _STUCK).any())
                good = np.isfinite(a).all(axis=1) & (unused == 0)
                t, a = t[good], a[good]
            for p in points:
                if stuck and not self.points[p].stuck:
                    self.doubted.append(p)
                self.points[p].stuck = stuck
            if not len(t):
                continue
            longest = int((t[1:] - t[:-1]).max()) if len(t) > 1 else 0
            for p in points:
                done = self._one(p, t, a, longest, even, events)
                if done:
                    touched.append(p)
        if even:
            even.sort(key=lambda r: r[0])
            self._stack(even)
            touched.sort()
        return touched, events, more

    def bridge(self, p: int, t_ns: int) -> None:
        """Rows up to t without accelerations."""
        ring = self.ring
        ring_end = ring.last_ns[p]
        mean, q, opened = self.across(p)
        times = [ring_end, t_ns] if opened else [t_ns]
        self._synthetic(p, times, mean)
        self._gap(p, ring_end, t_ns, q)
        ring.out[p] = ring.head[p]

    def _one(self, p: int, t: I64, a: F64, longest: int, even: list[tuple[int, I64, F64]], events: list[Event]) -> bool:
        pt = self.points[p]
        ring = self.ring
        last = ring.last_ns[p]
        t0 = int(t[0])
        if t0 <= last:
            keep = t > last
            t, a = t[keep], a[keep]
            if not len(t):
                return False
            t0 = int(t[0])
        if last < 0:
            last = t0
        if pt.run_ns < 0:
            pt.run_ns = t0
        bridged = pt.hold is not None
        limit = max(LEAST_GAP_NS, pt.nominal_ns * 7 // 2)
        if pt.nominal_ns and not bridged and longest <= limit and t0 - last <= limit:
            if pt.intervals:
                pt.intervals = []
            even.append((p, t, a))
            return True
        begin = 0
        for i in self._gaps_in(pt, np.diff(t, prepend=last).tolist(), bridged):
            self._rows(p, t[begin:i], a[begin:i])
            begin = i
            self._close(p, int(t[i]), events)
        self._rows(p, t[begin:], a[begin:])
        return True

    def _gaps_in(self, pt: Point, steps: list[int], bridged: bool) -> list[int]:
        """Indices of the steps that are gaps; learns the usual interval on the way, sample by sample."""
        found = []
        for i, step in enumerate(steps):
            gap = step > (max(LEAST_GAP_NS, pt.nominal_ns * 7 // 2) if pt.nominal_ns else S)
            if step > 0 and (gap or not pt.nominal_ns):
                pt.intervals.append(step)
                if len(pt.intervals) == NOMINAL:
                    pt.nominal_ns = sorted(pt.intervals)[NOMINAL // 2]
                    pt.intervals = []
            elif pt.intervals and pt.nominal_ns:
                pt.intervals = []
            if gap or (bridged and i == 0):
                found.append(i)
        return found

    def _close(self, p: int, t_ns: int, events: list[Event]) -> None:
        """A gap ends at sample time t."""
        pt = self.points[p]
        last = self.ring.last_ns[p]
        mean, q, opened = self.across(p)
        self._synthetic(p, [last, t_ns] if opened else [t_ns], mean)
        self._gap(p, last, t_ns, q)
        g = pt.hold
        pt.hold = None
        if g is None:
            return
        if t_ns - g.begin_ns > int(self.settings.accel_absent_s * S):
            pt.run_ns = t_ns
        if pt.started and pt.aided:
            seconds = (t_ns - g.begin_ns) / S
            text = f"no accelerations for {seconds:.3f} s, bridged by their mean"
            events.append(Event(t_ns, "ACCEL_GAP", pt.name, text, (("gap_s", seconds),), g.begin_ns, t_ns))

    def _gap(self, p: int, begin_ns: int, end_ns: int, q: F64) -> None:
        pt = self.points[p]
        if pt.hold is None:
            pt.hold = Gap(begin_ns, end_ns, q)
        pt.hold.end_ns = end_ns
        gaps = pt.gaps
        if gaps and gaps[-1].end_ns == begin_ns:
            gaps[-1].end_ns = end_ns
            return
        gaps.append(Gap(begin_ns, end_ns, q))
        if len(gaps) > GAPS:
            gaps[1] = Gap(gaps[0].begin_ns, gaps[1].end_ns, np.maximum(gaps[0].q, gaps[1].q))
            del gaps[0]

    def across(self, p: int) -> tuple[F64, F64, bool]:
        """Mean with gravity (3,), q_gap (3,), and whether the gap begins here; else the one that goes on is held."""
        ring = self.ring
        pt = self.points[p]
        h = ring.head[p]
        if pt.hold is not None:
            return ring.a[p, h - 1] + ring.reference[p], pt.hold.q, False
        usual = self.vibration(p, ring.last_ns[p], self.settings.accel_mean_s)
        if usual is None:
            return ring.a[p, h - 1] + ring.reference[p], np.full(3, 1e-3), True
        mean, var, tau = usual
        return mean + ring.reference[p], 2.0 * var * tau + 1e-12, True

    def vibration(self, p: int, until_ns: int, seconds: float) -> tuple[F64, F64, F64] | None:
        """Mean less reference, variance, reciprocal mean angular frequency (3,) of the last accelerations."""
        t, a = self.ring.recent(p, until_ns, seconds)
        if len(t) < 8:
            return None
        mean = a.sum(axis=0) * (1.0 / len(a))
        e = a - mean
        var = (e * e).sum(axis=0) * (1.0 / len(a))
        d = a[1:] - a[:-1]
        rate = (d * d).sum(axis=0) * (1.0 / len(d))
        h_s = (int(t[-1]) - int(t[0])) * NS / (len(t) - 1)
        tau = np.minimum(np.maximum(np.sqrt(var / np.maximum(rate, 1e-30)) * h_s, h_s), 0.5)
        return mean, var, tau

    def _synthetic(self, p: int, times: list[int], mean: F64) -> None:
        n = len(times)
        a = np.empty((1, n, 3))
        a[0] = mean
        self.ring.append([p], np.array([times]), a, np.full((1, n), SYNTHETIC, dtype=np.uint8), [n])

    def _rows(self, p: int, t: I64, a: F64) -> None:
        if len(t):
            self.ring.append([p], t[None], a[None], None, [len(t)])

    def _stack(self, rows: list[tuple[int, I64, F64]]) -> None:
        if len(rows) == 1:
            self._rows(*rows[0])
            return
        count = [len(r[1]) for r in rows]
        n = max(count)
        t = np.empty((len(rows), n), dtype=np.int64)
        a = np.empty((len(rows), n, 3))
        for i, (_, ti, ai) in enumerate(rows):
            c = count[i]
            t[i, :c] = ti
            a[i, :c] = ai
            if c < n:
                t[i, c:] = ti[-1]
                a[i, c:] = ai[-1]
        self.ring.append([r[0] for r in rows], t, a, None, count)
