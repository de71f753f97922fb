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
above the worst latency at the rates of structural sensors (2048 rows = 2 s at 1 kHz, 8 s at 250 Hz).
"""

from __future__ import annotations

import numpy as np

from edge_agent.messages import F64, I64, U8, State

KEEP = 4096
"""Rows kept per point at least, once there have been so many."""
LATEST = KEEP // 2
"""A fix may be late by so many rows at most: 2 s at 1 kHz,"""
LATEST_NS = 12_000_000_000
"""and by so much. The rest of the rows is for means before it."""
SAVED_NS = 25_000_000_000
"""Rows older than this before the newest are not saved: no fix and no mean reaches them."""
ROWS = 2 * KEEP
"""Rows allocated per point: half of them moves to the front when the end is reached."""
CHUNK = 1024
"""Longest block appended at once; longer ones are cut, which changes nothing."""
SYNTHETIC = 1
"""`Ring.kind` of a row that no sample stands behind."""
NS = 1e-9


def hold(t: I64, a: F64, g: F64) -> F64:
    """Integrals (g2, g1) of stacked rows t (P, n+1) ns, a (P, n+1, 3), from g (P, 6) at row 0: (P, n+1, 6).

    Rows of equal time add nothing, which is how shorter blocks are padded.
    """
    h = (t[:, 1:] - t[:, :-1])[:, :, None] * NS
    a0 = a[:, :-1]
    s = a0 + a[:, 1:]
    out = np.empty((*t.shape, 6))
    out[:, 0] = g
    o2, o1 = out[:, :, :3], out[:, :, 3:]
    o1[:, 1:] = s * (h * 0.5)
    o1.cumsum(axis=1, out=o1)
    o2[:, 1:] = h * (o1[:, :-1] + (s + a0) * (h * (1 / 6)))
    o2.cumsum(axis=1, out=o2)
    return out


def bend(t: I64, a: F64) -> F64:
    """(h x second difference)^2 per axis [m2/s2] of rows a (P, n+2, 3), t (P, n+1) ns from the second on: (P, n, 3).

    A first-order hold across a sample interval misses h/12 of the second difference, so the sum over an interval tells
    how much velocity may have been missed: nothing for what the sampling resolves, much for a blow.
    """
    e = a[:, 2:] - 2.0 * a[:, 1:-1] + a[:, :-2]
    e *= ((t[:, 1:] - t[:, :-1]) * NS)[:, :, None]
    e *= e
    return e


class Ring:
    """Rows of P points: t (P, ROWS) ns, a less reference (P, ROWS, 3), g = (g2, g1) (P, ROWS, 6), the running sum of
    `bend` (P, ROWS, 3) since the origin, kind (P, ROWS).

    `head` is the next row to write, `out` the next to be emitted.
    """

    def __init__(self, points: int) -> None:
        self.t: I64 = np.zeros((points, ROWS), dtype=np.int64)
        self.a: F64 = np.zeros((points, ROWS, 3))
        self.g: F64 = np.zeros((points, ROWS, 6))
        self.bent: F64 = np.zeros((points, ROWS, 3))
        self.kind: U8 = np.zeros((points, ROWS), dtype=np.uint8)
        self.head = [0] * points
        self.out = [0] * points
        self.first_ns = [-1] * points  # time of the first row ever
        self.last_ns = [-1] * points  # of the newest, -1 = none
        self.reference: F64 = np.zeros((points, 3))
        self.origin_ns = [0] * points

    def append(self, points: list[int], t: I64, a: F64, kind: U8 | None, count: list[int]) -> None:
        """Add rows t (P', n), a (P', n, 3) with gravity, kind (P', n) or None for all real, of which the first count[i]
        count and the rest repeat the last one. Times rise weakly; n <= CHUNK."""
        n = t.shape[1]
        for i, p in enumerate(points):
            h = self.head[p]
            if h == 0:
                self.first_ns[p] = self.origin_ns[p] = int(t[i, 0])
                self.reference[p] = a[i, 0]
            elif h + n > ROWS:
                for rows in (self.t, self.a, self.g, self.bent, self.kind):
                    rows[p, :KEEP] = rows[p, h - KEEP : h].copy()
                self.out[p] += KEEP - h
                self.head[p] = KEEP
        heads = [self.head[p] for p in points]
        h0 = heads[0]
        tt = np.empty((len(points), n + 1), dtype=np.int64)
        aa = np.empty((len(points), n + 2, 3))  # the two rows before, then the new ones
        tt[:, 1:] = t
        k = block(points)
        if isinstance(k, slice) and heads.count(h0) == len(heads):
            np.subtract(a, self.reference[k, None], out=aa[:, 2:])
            if h0:
                tt[:, 0] = self.t[k, h0 - 1]
                aa[:, 1] = self.a[k, h0 - 1]
                aa[:, 0] = self.a[k, h0 - 2] if h0 > 1 else aa[:, 1]
                g, bent = self.g[k, h0 - 1], self.bent[k, h0 - 1]
            else:
                tt[:, 0] = t[:, 0]
                aa[:, :2] = aa[:, 2:3]
                g, bent = np.zeros((len(points), 6)), np.zeros((len(points), 3))
            w = slice(h0, h0 + n)
            self.t[k, w] = t
            self.a[k, w] = aa[:, 2:]
            self.g[k, w] = hold(tt, aa[:, 1:], g)[:, 1:]
            self.bent[k, w] = _sum(bent, bend(tt, aa) if kind is None else np.zeros_like(a))
            self.kind[k, w] = 0 if kind is None else kind
        else:
            index = np.array(points)
            head = np.array(heads)
            np.subtract(a, self.reference[index, None], out=aa[:, 2:])
            some = (head > 0)[:, None]
            before = np.maximum(head - 1, 0)
            tt[:, 0] = np.where(some[:, 0], self.t[index, before], t[:, 0])
            aa[:, 1] = np.where(some, self.a[index, before], aa[:, 2])
            aa[:, 0] = np.where((head > 1)[:, None], self.a[index, np.maximum(head - 2, 0)], aa[:, 1])
            g = np.where(some, self.g[index, before], 0.0)
            bent = np.where(some, self.bent[index, before], 0.0)
            rows = head[:, None] + np.arange(n)
            k2 = index[:, None]
            self.t[k2, rows] = t
            self.a[k2, rows] = aa[:, 2:]
            self.g[k2, rows] = hold(tt, aa[:, 1:], g)[:, 1:]
            self.bent[k2, rows] = _sum(bent, bend(tt, aa) if kind is None else np.zeros_like(a))
            self.kind[k2, rows] = 0 if kind is None else kind
        for i, p in enumerate(points):
            self.head[p] += count[i]
            self.last_ns[p] = int(t[i, count[i] - 1])

    def at(self, p: int, t_ns: int) -> tuple[int, F64, F64]:
        """Row at or before t, and a (3,), g (6,) at t, exact under the hold. Raises ValueError outside of the rows."""
        h = self.head[p]
        i = int(self.t[p, :h].searchsorted(t_ns, side="right")) - 1
        if i < 0 or t_ns > self.last_ns[p]:
            raise ValueError("integrals: the time lies outside of the ring")
        a0, g = self.a[p, i], self.g[p, i]
        before = int(self.t[p, i])
        dt = t_ns - before
        if dt == 0:
            return i, a0, g.copy()
        s = dt * NS
        a1 = a0 + (self.a[p, i + 1] - a0) * (dt / (int(self.t[p, i + 1]) - before))
        out = np.empty(6)
        total = a0 + a1
        out[:3] = g[:3] + s * (g[3:] + (total + a0) * (s * (1 / 6)))
        out[3:] = g[3:] + total * (s * 0.5)
        return i, a1, out

    def anchor(self, points: list[int], t_ns: int) -> tuple[F64, F64]:
        """Integrals g (P', 6) at t and the sum of `bend` (P', 3) of the rows at or before it, of some points at once;
        as `at`, whose arithmetic it is."""
        if len(points) == 1:
            p = points[0]
            i, _, one = self.at(p, t_ns)
            return one[None], self.bent[p, i][None]
        rows = []
        for p in points:
            i = int(self.t[p, : self.head[p]].searchsorted(t_ns, side="right")) - 1
            if i < 0 or t_ns > self.last_ns[p]:
                raise ValueError("integrals: the time lies outside of the ring")
            rows.append(i)
        k, i0 = np.array(points), np.array(rows)
        i1 = np.minimum(i0 + 1, np.array(self.head)[k] - 1)
        t0, t1 = self.t[k, i0], self.t[k, i1]
        a0, g = self.a[k, i0], self.g[k, i0]
        dt = t_ns - t0
        s = (dt * NS)[:, None]
        total = a0 + (a0 + (self.a[k, i1] - a0) * (dt / np.maximum(t1 - t0, 1))[:, None])
        g[:, :3] += s * (g[:, 3:] + (total + a0) * (s * (1 / 6)))
        g[:, 3:] += total * (s * 0.5)
        return g, self.bent[k, i0]

    def covers(self, p: int, t_ns: int) -> bool:
        """Whether a fix at t finds its accelerations: not later than the newest row, not older than LATEST_NS or LATEST
        rows before it. The bound is tighter than what is kept: a loaded ring answers as the saved one did."""
        h = self.head[p]
        if not h or t_ns > self.last_ns[p]:
            return False
        return t_ns >= max(int(self.t[p, max(0, h - LATEST)]), self.last_ns[p] - LATEST_NS)

    def row(self, p: int, t_ns: int) -> int:
        """First row not before t."""
        return int(self.t[p, : self.head[p]].searchsorted(t_ns, side="left"))

    def rebase(self, p: int, t_ns: int) -> None:
        """Make t the origin: g = 0 there, and all later rows integrated anew from it."""
        i, a, _ = self.at(p, t_ns)
        h = self.head[p]
        tt = np.concatenate([[t_ns], self.t[p, i + 1 : h]])[None]
        aa = np.concatenate([a[None], self.a[p, i + 1 : h]])[None]
        self.g[p, i + 1 : h] = hold(tt, aa, np.zeros((1, 6)))[0, 1:]
        if h > i + 1:
            rows = np.maximum(np.arange(i - 1, h), 0)
            e = bend(self.t[p, i:h][None], self.a[p, rows][None])
            e[0, self.kind[p, i + 1 : h] == SYNTHETIC] = 0.0
            self.bent[p, i + 1 : h] = _sum(np.zeros((1, 3)), e)[0]
        self.bent[p, i] = 0.0
        # The row before, backwards from the origin: another time may lie between this one and the next row.
        step = (t_ns - int(self.t[p, i])) * NS
        a0 = self.a[p, i]
        g1 = (a0 + a) * (-0.5 * step)
        self.g[p, i, 3:] = g1
        self.g[p, i, :3] = (g1 + (a0 + a0 + a) * (step * (1 / 6))) * -step
        self.origin_ns[p] = t_ns

    def recent(self, p: int, until_ns: int, seconds: float, limit: int = LATEST - 2) -> tuple[I64, F64]:
        """Real rows of the last `seconds` up to `until_ns`, at most `limit` rows: t, a less reference."""
        h = int(self.t[p, : self.head[p]].searchsorted(until_ns, side="right"))
        lo = max(0, h - limit)
        lo += int(self.t[p, lo:h].searchsorted(until_ns - round(seconds * 1e9)))
        real = self.kind[p, lo:h] != SYNTHETIC
        return self.t[p, lo:h][real], self.a[p, lo:h][real]

    def save(self) -> State:
        """Everything that a later step may read: the kept rows, cut to what is in use."""
        rows: list[State] = []
        for p, h in enumerate(self.head):
            lo = max(0, h - KEEP, self.row(p, self.last_ns[p] - SAVED_NS) - 2)
            w = slice(lo, h)
            rows.append(
                {
                    "t": self.t[p, w], "a": self.a[p, w], "g": self.g[p, w],
                    "bent": self.bent[p, w], "kind": self.kind[p, w],
                    "out": self.out[p] - lo, "first": self.first_ns[p], "origin": self.origin_ns[p],
                    "reference": self.reference[p],
                }
            )  # fmt: skip
        return {"rows": rows}

    def load(self, s: State) -> None:
        for p, r in enumerate(s["rows"]):
            n = len(r["t"])
            self.t[p, :n] = r["t"]
            self.a[p, :n] = r["a"]
            self.g[p, :n] = r["g"]
            self.bent[p, :n] = r["bent"]
            self.kind[p, :n] = r["kind"]
            self.head[p] = n
            self.last_ns[p] = int(r["t"][-1]) if n else -1
            self.out[p] = r["out"]
            self.first_ns[p] = r["first"]
            self.origin_ns[p] = r["origin"]
            self.reference[p] = r["reference"]


def _sum(begin: F64, steps: F64) -> F64:
    """Running sum of steps (P, n, 3) from begin (P, 3); the begin is carried in, so the cut does not matter."""
    out = np.empty((steps.shape[0], steps.shape[1] + 1, 3))
    out[:, 0] = begin
    out[:, 1:] = steps
    out.cumsum(axis=1, out=out)
    return out[:, 1:]


def block(points: list[int]) -> slice | list[int]:
    """Index of some points: a slice (a view) where they are neighbours."""
    return slice(points[0], points[-1] + 1) if points[-1] - points[0] + 1 == len(points) else points
