"""What was due and what came: epochs of receivers, samples of accelerometers, why the rest is missing, and when which
flag and which verdict stood, in bounded memory.

One definition, everywhere in the report: a *gap* is a place where at least one epoch or sample is missing. Epochs are
counted on the receiver's own interval, from its first fix to its last. Samples are missing where the codec or the clock
flagged it (GAP_BEFORE: by the sample counter, or by a pause where there is none) and in every silence above `QUIET_NS`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from edge_agent.messages import F64, I64, U8, AccelFlag, Config, FusionFlag, S, Verdict
from edge_agent.review.estimates import Track
from edge_agent.review.series import Envelope, Happened, Piece
from edge_agent.verify import File, Gap

FINEST_NS, SPANS = 20_000_000, 2000
QUIET_NS = S // 2
STEADY = 0.5
"""Share of the steps of a piece that must be alike for them to be the interval."""
NEAR_NS = S
"""Refused input this near to an epoch that is missing may have been it."""
NOT_SENT = "not sent by the receiver, or lost on its line"
UNRECORDED = ("no file", "missing", "damaged", "stop", "power", "kill", "crash")
LOST = "lost between sensor and gateway"

ACCEL_FLAGS = tuple(f for f in AccelFlag if f != AccelFlag.FITTED)


def unrecorded(files: Sequence[File], gaps: Sequence[Gap]) -> list[Gap]:
    """Stretches between files for which nothing is there and `verify` has no reason: those files tell of no run."""
    out = []
    end = 0
    for f in sorted((f for f in files if f.messages), key=lambda f: f.begin_ns):
        if end and f.begin_ns - end > 2 * S and not any(g.begin_ns < f.begin_ns and g.end_ns > end for g in gaps):
            out.append(Gap(end, f.begin_ns, "all", "no file", f"no file of the time before {f.path.name} is here"))
        end = max(end, f.end_ns)
    return out


class Break(NamedTuple):
    """A gap: UTC ns of what came before and behind it, how many are missing, why."""

    begin_ns: int
    end_ns: int
    missing: int
    why: str


@dataclass
class Due:
    """One stream: what came, what is missing by reason, in how many gaps, the longest, the share that came in time."""

    received: int = 0
    missing: dict[str, int] = field(default_factory=dict)
    gaps: int = 0
    longest: Break | None = None
    interval_ns: float = 0.0
    share: Track = field(default_factory=Track)
    end_ns: int = -1
    run: str = ""

    @property
    def lost(self) -> int:
        return sum(self.missing.values())

    @property
    def unrecorded(self) -> int:
        """Missing for want of a recording, whatever was sent."""
        return sum(n for why, n in self.missing.items() if why in UNRECORDED)

    @property
    def expected(self) -> int:
        return self.received + self.lost


class Marked:
    """When which of some bits or values stood: `counts` of samples, and spans of time."""

    def __init__(self, kinds: Sequence[int]) -> None:
        self.kinds = tuple(kinds)
        self.counts = dict.fromkeys(self.kinds, 0)
        self._when = Envelope(len(self.kinds), FINEST_NS, SPANS)

    def add(self, utc_ns: I64, hit: npt.NDArray[np.bool_]) -> None:
        """`hit` (n, kinds) at utc_ns (n,)."""
        some = hit.any(axis=1)
        if some.any():
            self._when.add(utc_ns[some], hit[some].astype(np.float64))
            for k, n in zip(self.kinds, hit.sum(axis=0).tolist(), strict=True):
                self.counts[k] += n

    def boxes(self, kind: int, near_ns: float = 1.0) -> list[tuple[int, int]]:
        """Begins and ends [UTC ns] of the stretches in which that one stood, as fine as the envelope is; those that lie
        nearer than `near_ns` are one."""
        t, _, high, _ = self._when.spans()
        out: list[tuple[int, int]] = []
        half = self._when.span_ns // 2
        for middle in t[high[:, self.kinds.index(kind)] > 0].tolist():
            if out and middle - half <= out[-1][1] + near_ns:
                out[-1] = out[-1][0], middle + half
            else:
                out.append((middle - half, middle + half))
        return out


class Stretches:
    """Stretches of time of one kind of event: how many, and begins and ends [UTC ns], those that lie closest as one
    when there are too many."""

    def __init__(self) -> None:
        self.count = 0
        self.boxes: list[tuple[int, int]] = []
        self._near = FINEST_NS

    def add(self, begin_ns: int, end_ns: int) -> None:
        self.count += 1
        self.boxes.append((begin_ns, max(begin_ns, end_ns)))
        while len(self.boxes) > SPANS:
            merged: list[tuple[int, int]] = []
            for a, b in sorted(self.boxes):
                if merged and a - merged[-1][1] <= self._near:
                    merged[-1] = merged[-1][0], max(b, merged[-1][1])
                else:
                    merged.append((a, b))
            self.boxes = merged
            self._near *= 2


class Received:
    """Everything of a set of recordings; `gaps` of the raw data are those of `verify`. `add` each piece."""

    def __init__(self, config: Config, gaps: Sequence[Gap]) -> None:
        self.config = config
        self.gaps = gaps
        self.receivers: dict[str, Due] = {}
        self.accelerometers: dict[str, Due] = {}
        self.flags: dict[str, Marked] = {}  # of accelerometers: AccelFlag
        self.states: dict[str, Marked] = {}  # of points: FusionFlag
        self.verdicts: dict[str, Marked] = {}  # of points: Verdict
        self.events: dict[tuple[str, str], Stretches] = {}  # kind, source
        self.shaking: dict[str, Track] = {}  # of accelerometers: variance of each piece about its mean (3,)

    def add(self, piece: Piece) -> None:
        for h in piece.happened:
            self.events.setdefault((h.kind, h.source), Stretches()).add(h.begin_ns or h.end_ns, h.end_ns)
        for name, x in piece.fixes.items():
            due = self.receivers.setdefault(name, Due())
            port = self.config.receivers[name].port if name in self.config.receivers else ""
            refused = [h for h in piece.happened if h.kind == "REJECT" and h.source in (name, port)]
            self._epochs(due, piece.run, x.utc_ns, port, refused)
        for name, a in piece.accelerations.items():
            due = self.accelerometers.setdefault(name, Due())
            port = self.config.accelerometers[name].port if name in self.config.accelerometers else ""
            self._samples(due, piece.run, a.utc_ns, a.flags, port)
            flagged = self.flags.setdefault(name, Marked([int(f) for f in ACCEL_FLAGS]))
            some = (a.flags & ~np.uint8(AccelFlag.FITTED)) != 0
            if some.any():
                flagged.add(a.utc_ns[some], bits(a.flags[some], flagged.kinds))
            known = np.isfinite(a.xyz).all(axis=1)
            if known.sum() > 1:
                at = int(a.utc_ns[len(a.utc_ns) // 2])
                self.shaking.setdefault(name, Track()).add(at, a.xyz[known].var(axis=0), int(known.sum()))
        for name, f in piece.fused.items():
            state = self.states.setdefault(name, Marked([int(k) for k in FusionFlag]))
            state.add(f.utc_ns[f.flags != 0], bits(f.flags[f.flags != 0], state.kinds))
        for name, j in piece.judged.items():
            marked = self.verdicts.setdefault(name, Marked([int(v) for v in Verdict if v != Verdict.ACCEPTED]))
            marked.add(j.utc_ns, j.verdict[:, None] == np.array(marked.kinds, np.uint8))

    def rms(self, name: str) -> F64:
        """rms of an accelerometer about the mean of each half minute (3,) m/s2; NaN without a sample."""
        rows = self.shaking[name].rows if name in self.shaking else []
        total = sum(n for _, _, n in rows)
        if not total:
            return np.full(3, math.nan)
        return np.asarray(np.sqrt(sum(v * n for _, v, n in rows) / total))

    def _steps(self, due: Due, run: str, utc_ns: I64) -> I64:
        """Steps to each from the one before; 0 for the very first and where time does not go on."""
        if not due.received:
            due.run = run
        before = due.end_ns if due.end_ns >= 0 else int(utc_ns[0])
        last = np.maximum.accumulate(np.concatenate([[before], utc_ns[:-1]]))
        due.received += len(utc_ns)
        due.end_ns = max(before, int(utc_ns.max()))
        return np.maximum(utc_ns - last, 0)

    def _epochs(self, due: Due, run: str, utc_ns: I64, port: str, refused: Sequence[Happened]) -> None:
        if not len(utc_ns):
            return
        steps = self._steps(due, run, utc_ns)
        inner = steps[steps > 0]
        if len(inner):
            usual = float(np.median(inner))
            steady = float((np.abs(inner - usual) < 0.2 * usual).mean())
            if not due.interval_ns or (len(inner) >= 10 and steady > STEADY):
                due.interval_ns = usual
        if not due.interval_ns:
            return
        absent = np.maximum(np.rint(steps / due.interval_ns).astype(np.int64) - 1, 0)
        known = self._near(int(utc_ns[0] - steps[0]), due.end_ns, port)
        pool = {i: int(h.values.get("count", 1.0)) for i, h in enumerate(refused)}
        for i in np.flatnonzero(absent).tolist():
            begin, end, n = int(utc_ns[i] - steps[i]), int(utc_ns[i]), int(absent[i])
            why = _known(known, begin, end)
            if not why:
                for k, h in enumerate(refused):
                    took = min(pool[k], n)
                    if took and h.begin_ns - NEAR_NS <= end and h.end_ns + NEAR_NS >= begin:
                        pool[k] -= took
                        n -= took
                        _count(due, Break(begin, end, took, f"came damaged ({h.text.split(':')[0].lower()})"), False)
                why = NOT_SENT
            if n:
                _count(due, Break(begin, end, n, why), False)
            due.gaps += 1
        short = steps < 10 * S  # what is missing in a long gap is not of this piece
        n, gone = len(utc_ns), int(absent[short].sum())
        due.share.add(int(utc_ns[n // 2]), np.array([n / (n + gone)]), n + gone)

    def _samples(self, due: Due, run: str, utc_ns: I64, flags: U8, port: str) -> None:
        if not len(utc_ns):
            return
        steps = self._steps(due, run, utc_ns)
        inner = steps[steps > 0]
        if len(inner) and (not due.interval_ns or len(inner) >= 100):
            due.interval_ns = float(np.median(inner))
        gap = ((flags & AccelFlag.GAP_BEFORE.value) != 0) & (steps > 0)
        gap |= steps > max(QUIET_NS, 3.5 * due.interval_ns)
        known = self._near(int(utc_ns[0] - steps[0]), due.end_ns, port)
        for i in np.flatnonzero(gap).tolist():
            begin, end = int(utc_ns[i] - steps[i]), int(utc_ns[i])
            n = max(round(steps[i] / due.interval_ns) - 1, 1)
            _count(due, Break(begin, end, n, _known(known, begin, end) or LOST))

    def _near(self, begin: int, end: int, port: str) -> list[Gap]:
        """The gaps of a port's raw data about a stretch of time."""
        first, last = begin - NEAR_NS, end + NEAR_NS
        return [g for g in self.gaps if g.source in ("all", port) and g.begin_ns <= last and g.end_ns >= first]


def _known(gaps: Sequence[Gap], begin: int, end: int) -> str:
    """The reason that `verify` has for what is missing in a stretch, "" = none."""
    return next((g.reason for g in gaps if g.begin_ns < end and g.end_ns > begin), "")


def _count(due: Due, b: Break, gap: bool = True) -> None:
    due.missing[b.why] = due.missing.get(b.why, 0) + b.missing
    due.gaps += gap
    if due.longest is None or b.end_ns - b.begin_ns > due.longest.end_ns - due.longest.begin_ns:
        due.longest = b


def bits(flags: U8, kinds: Sequence[int]) -> npt.NDArray[np.bool_]:
    """Which bits stand in each (n, kinds)."""
    return np.asarray((flags[:, None] & np.array(kinds, np.uint8)) != 0)
