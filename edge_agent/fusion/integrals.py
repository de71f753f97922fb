"""Accelerations of all points in a ring, integrated once under a first-order hold.

Between samples the acceleration is a straight line, so over a step h with ends a0, a1

    g1 += h (a0 + a1) / 2            g2 += g1 h + h^2 (2 a0 + a1) / 6

are exact, and so is any time between two samples. g1 and g2 run on from an origin that moves to a fix now and then
(`rebase`), which keeps them small. The integrals from an anchor f to t follow without another pass:

    S1 = g1(t) - g1(f)               S2 = g2(t) - g2(f) - g1(f) (t - f)

A block is a cumulative sum led by the value carried in, so the cut into blocks does not change a bit. A reference (the
first sample) is taken off before integration: gravity and bias would only cost digits.

A gap holds the mean of the last seconds: two synthetic rows (gap's begin, mean) and (its end, mean) make the step
without a straight line across it. Rows beyond the bound are forgotten, oldest first; the bound is by count and far
above the worst latency at the rates of structural sensors (4096 rows = 2 s at 2 kHz, 16 s at 250 Hz).
"""

from __future__ import annotations

import numpy as np

from edge_agent.messages import F64, I64, U8, State

KEEP = 4096
"""Rows kept per point at least, once there have been so many."""
ROWS = 2 * KEEP
"""Rows allocated per point: half of them moves to the front when the end is reached."""
CHUNK = 1024
"""Longest block appended at once; longer ones are cut, which changes nothing."""
SYNTHETIC, AFTER_GAP = 1, 2
"""Bits of `Ring.kind`."""
NS = 1e-9


def hold(t: I64, a: F64, g1: F64, g2: F64) -> tuple[F64, F64]:
    """Integrals of stacked rows t (P, n+1) ns, a (P, n+1, 3) from g1, g2 (P, 3) at row 0; returns both (P, n+1, 3).

    Rows of equal time add nothing, which is how shorter blocks are padded.
    """
    h = (t[:, 1:] - t[:, :-1])[:, :, None] * NS
    a0 = a[:, :-1]
    a1 = a[:, 1:]
    o1 = np.empty_like(a)
    o1[:, 0] = g1
    s = a0 + a1
    o1[:, 1:] = s * (h * 0.5)
    o1.cumsum(axis=1, out=o1)
    o2 = np.empty_like(a)
    o2[:, 0] = g2
    o2[:, 1:] = h * (o1[:, :-1] + (s + a0) * (h * (1 / 6)))
    o2.cumsum(axis=1, out=o2)
    return o1, o2


class Ring:
    """Rows of P points: t (P, ROWS) ns, a less reference, g1, g2 (P, ROWS, 3), kind (P, ROWS); `head` = next to write."""

    def __init__(self, points: int) -> None:
        self.t: I64 = np.zeros((points, ROWS), dtype=np.int64)
        self.a: F64 = np.zeros((points, ROWS, 3))
        self.g1: F64 = np.zeros((points, ROWS, 3))
        self.g2: F64 = np.zeros((points, ROWS, 3))
        self.kind: U8 = np.zeros((points, ROWS), dtype=np.uint8)
        self.head = [0] * points
        self.out = [0] * points  # next row to be emitted
        self.first_ns = [-1] * points  # time of the first row ever
        self.reference: F64 = np.zeros((points, 3))
        self.origin_ns = [0] * points

    def last_ns(self, p: int) -> int:
        """Time of the newest row, -1 = none."""
        h = self.head[p]
        return int(self.t[p, h - 1]) if h else -1

    def append(self, points: list[int], t: I64, a: F64, kind: U8, count: list[int]) -> None:
        """Add rows t (P', n), a (P', n, 3) with gravity, kind (P', n), of which the first count[i] are real and the
        rest repeat the last one. Times rise weakly; n <= CHUNK."""
        n = t.shape[1]
        for i, p in enumerate(points):
            h = self.head[p]
            if h == 0:
                self.first_ns[p] = int(t[i, 0])
                self.reference[p] = a[i, 0]
                self.origin_ns[p] = self.first_ns[p]
            elif h + n > ROWS:
                for rows in (self.t, self.a, self.g1, self.g2, self.kind):
                    rows[p, :KEEP] = rows[p, h - KEEP : h].copy()
                self.out[p] += KEEP - h
                self.head[p] = KEEP
        heads = [self.head[p] for p in points]
        h0 = heads[0]
        p0 = points[0]
        even = heads.count(h0) == len(heads)
        run = slice(p0, p0 + len(points)) if points == list(range(p0, p0 + len(points))) else None
        tt = np.empty((len(points), n + 1), dtype=np.int64)
        aa = np.empty((len(points), n + 1, 3))
        tt[:, 1:] = t
        if run is not None and even:
            aa[:, 1:] = a - self.reference[run, None]
            if h0:
                tt[:, 0] = self.t[run, h0 - 1]
                aa[:, 0] = self.a[run, h0 - 1]
                g1, g2 = self.g1[run, h0 - 1], self.g2[run, h0 - 1]
            else:
                tt[:, 0] = t[:, 0]
                aa[:, 0] = aa[:, 1]
                g1, g2 = self.g1[run, 0] * 0.0, self.g2[run, 0] * 0.0
            s1, s2 = hold(tt, aa, g1, g2)
            w = slice(h0, h0 + n)
            self.t[run, w] = t
            self.a[run, w] = aa[:, 1:]
            self.g1[run, w] = s1[:, 1:]
            self.g2[run, w] = s2[:, 1:]
            self.kind[run, w] = kind
        else:
            k = np.array(points)
            head = np.array(heads)
            aa[:, 1:] = a - self.reference[k, None]
            old = (head > 0)[:, None]
            before = np.maximum(head - 1, 0)
            tt[:, 0] = np.where(old[:, 0], self.t[k, before], t[:, 0])
            aa[:, 0] = np.where(old, self.a[k, before], aa[:, 1])
            s1, s2 = hold(
                tt, aa, np.where(old, self.g1[k, before], 0.0), np.where(old, self.g2[k, before], 0.0)
            )
            rows = head[:, None] + np.arange(n)
            k2 = k[:, None]
            self.t[k2, rows] = t
            self.a[k2, rows] = aa[:, 1:]
            self.g1[k2, rows] = s1[:, 1:]
            self.g2[k2, rows] = s2[:, 1:]
            self.kind[k2, rows] = kind
        for i, p in enumerate(points):
            self.head[p] += count[i]

    def at(self, p: int, t_ns: int) -> tuple[int, F64, F64, F64]:
        """Row at or before t and a, g1, g2 (3,) at t, exact under the hold. t must lie within the rows."""
        h = self.head[p]
        i = int(self.t[p, :h].searchsorted(t_ns, side="right")) - 1
        if i < 0:
            raise ValueError("time before the ring")
        a0, g1, g2 = self.a[p, i], self.g1[p, i], self.g2[p, i]
        dt = t_ns - int(self.t[p, i])
        if dt == 0:
            return i, a0, g1, g2
        s = dt * NS
        a1 = a0 + (self.a[p, i + 1] - a0) * (dt / (int(self.t[p, i + 1]) - int(self.t[p, i])))
        return i, a1, g1 + (a0 + a1) * (s * 0.5), g2 + s * (g1 + (a0 + a0 + a1) * (s * (1 / 6)))

    def covers(self, p: int, t_ns: int) -> bool:
        h = self.head[p]
        return h > 0 and int(self.t[p, 0]) <= t_ns <= int(self.t[p, h - 1])

    def rebase(self, p: int, t_ns: int) -> None:
        """Make t the origin: g1 = g2 = 0 there, and all later rows integrated anew from it."""
        i, a, _, _ = self.at(p, t_ns)
        h = self.head[p]
        tt = np.concatenate([[t_ns], self.t[p, i + 1 : h]])[None]
        aa = np.concatenate([a[None], self.a[p, i + 1 : h]])[None]
        zero = np.zeros((1, 3))
        g1, g2 = hold(tt, aa, zero, zero)
        self.g1[p, i + 1 : h] = g1[0, 1:]
        self.g2[p, i + 1 : h] = g2[0, 1:]
        if int(self.t[p, i]) == t_ns:
            # Rows of equal time (a gap's end and the sample there) are one instant.
            self.g1[p, i] = 0.0
            self.g2[p, i] = 0.0
        self.origin_ns[p] = t_ns

    def recent(self, p: int, until_ns: int, seconds: float, limit: int = 2048) -> tuple[I64, F64]:
        """Real rows of the last `seconds` up to `until_ns`, at most `limit` rows: t, a less reference."""
        h = int(self.t[p, : self.head[p]].searchsorted(until_ns, side="right"))
        lo = max(0, h - limit)
        lo += int(self.t[p, lo:h].searchsorted(until_ns - int(seconds * 1e9)))
        real = (self.kind[p, lo:h] & SYNTHETIC) == 0
        return self.t[p, lo:h][real], self.a[p, lo:h][real]

    def save(self) -> State:
        """Everything a later step may read: the kept rows, cut to what is in use."""
        rows: list[State] = []
        for p, h in enumerate(self.head):
            lo = max(0, h - KEEP)
            w = slice(lo, h)
            rows.append(
                {
                    "t": self.t[p, w], "a": self.a[p, w], "g1": self.g1[p, w], "g2": self.g2[p, w],
                    "kind": self.kind[p, w], "out": self.out[p] - lo, "first": self.first_ns[p],
                    "origin": self.origin_ns[p], "reference": self.reference[p],
                }
            )  # fmt: skip
        return {"rows": rows}

    def load(self, s: State) -> None:
        for p, r in enumerate(s["rows"]):
            n = len(r["t"])
            self.t[p, :n] = r["t"]
            self.a[p, :n] = r["a"]
            self.g1[p, :n] = r["g1"]
            self.g2[p, :n] = r["g2"]
            self.kind[p, :n] = r["kind"]
            self.head[p] = n
            self.out[p] = r["out"]
            self.first_ns[p] = r["first"]
            self.origin_ns[p] = r["origin"]
            self.reference[p] = r["reference"]
