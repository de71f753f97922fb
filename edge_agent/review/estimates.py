"""What a recording says of noise, clocks, mounting and headings beside the displacement, in bounded memory.

`Estimates` takes the pieces of a review one by one. Innovations are held against chi-square: where the filter's sd is
honest the probability that chi-square gives each is spread evenly, their squares over the variance are 1 in the mean,
and one does not tell the next. Bias, sd of the fixes, headings, clocks and rates become envelopes and tracks. Left out:
drawing (panels_estimates).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from edge_agent.fusion.gate import quantile
from edge_agent.messages import F64, I64, AccelFlag, Config, Quality, S, Verdict
from edge_agent.recording import topics
from edge_agent.recording.reader import Stored
from edge_agent.review.columns import groups
from edge_agent.review.learned import Learned
from edge_agent.review.series import Envelope, Piece

BINS = 20
"""Of the probability of an innovation."""
FINEST_NS, SPANS = S, 1000
"""Shortest span of an envelope here, and how many there are at most."""
KEPT = 2000
"""Rows of a track at most; beyond, neighbours are averaged."""


def at_the_gate(verdicts: Mapping[int, int]) -> int:
    """Fixes that the gate had to do with: taken, refused, or used less an open level. Every share of refused fixes in
    review and compare is of these."""
    return sum(verdicts.get(int(v), 0) for v in (Verdict.ACCEPTED, Verdict.REJECTED, Verdict.OFFSET))


class Track:
    """Means over time: rows of (UTC ns, values (c,), how many samples), averaged in pairs when there are too many."""

    def __init__(self) -> None:
        self.rows: list[tuple[int, F64, int]] = []
        self.folds = 0  # how often pairs were made

    def add(self, utc_ns: int, values: F64, count: int = 1) -> None:
        self.rows.append((utc_ns, values, count))
        if len(self.rows) > KEPT:
            self.folds += 1
            pairs = zip(self.rows[::2], self.rows[1::2], strict=False)
            self.rows = [
                ((a[0] + b[0]) // 2, (a[1] * a[2] + b[1] * b[2]) / (a[2] + b[2]), a[2] + b[2]) for a, b in pairs
            ]

    def columns(self) -> tuple[I64, F64]:
        """UTC ns (k,), values (k, c)."""
        return np.array([t for t, _, _ in self.rows], np.int64), np.array([v for _, v, _ in self.rows], np.float64)


@dataclass
class Gated:
    """Innovations of the accepted and refused fixes of a point. `chance`: how many fell into each of BINS bins of the
    probability that chi-square gives a smaller one; `over`: refused; `pairs`: products of neighbours and squares,
    normalised, per axis; `nis`: in time, mean of v'S^-1 v over the axes; sd of the fixes as declared and as used."""

    chance: I64 = field(default_factory=lambda: np.zeros(BINS, np.int64))
    count: int = 0
    total: float = 0.0  # of v'S^-1 v of the accepted
    accepted: int = 0
    pairs: F64 = field(default_factory=lambda: np.zeros((2, 3)))
    nis: Track = field(default_factory=Track)
    used_std: Envelope = field(default_factory=lambda: Envelope(3, FINEST_NS, SPANS))
    used: F64 = field(default_factory=lambda: np.zeros(3))  # sums of variances
    declared: F64 = field(default_factory=lambda: np.zeros(3))
    declared_count: int = 0

    @property
    def whiteness(self) -> F64:
        """Correlation of neighbouring innovations per axis (3,); NaN where there are none."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(self.pairs[0] / self.pairs[1])

    @property
    def mean_nis(self) -> float:
        """Mean of v'S^-1 v of the accepted fixes over three axes; 1 = honest."""
        return self.total / (3 * self.accepted) if self.accepted else math.nan

    @property
    def std_nis(self) -> float:
        """sd of that mean for an honest filter with independent innovations."""
        return math.sqrt(2.0 / (3 * self.accepted)) if self.accepted else math.nan


@dataclass
class Headed:
    """Headings of a point's receiver about the first one, deg: envelopes of the estimate, of what the receiver said,
    of the estimate's sd; verdicts; squares of what was accepted over its variance."""

    first_deg: float
    estimate: Envelope = field(default_factory=lambda: Envelope(1, FINEST_NS, SPANS))
    measured: Envelope = field(default_factory=lambda: Envelope(1, FINEST_NS, SPANS))
    std: Envelope = field(default_factory=lambda: Envelope(1, FINEST_NS, SPANS))
    verdicts: dict[int, int] = field(default_factory=dict)
    baseline_m: float = math.nan
    limit: float = 0.0
    total: float = 0.0
    accepted: int = 0
    last_deg: float = math.nan
    last_std_deg: float = math.nan

    @property
    def mean_nis(self) -> float:
        return self.total / self.accepted if self.accepted else math.nan


@dataclass
class HostClock:
    """UTC less the monotonic clock of one run, ms from its first tick; ticks, those that were synchronised, the
    largest error that the host admitted [s]."""

    offset_ms: Track = field(default_factory=Track)
    first_ns: int | None = None
    ticks: int = 0
    synchronised: int = 0
    error_s: float = 0.0

    def rate_ppm(self) -> float:
        """Slope of the offset: how much faster UTC runs than the host's monotonic clock; NaN for less than a minute."""
        t, y = self.offset_ms.columns()
        if len(t) < 3 or t[-1] - t[0] < 60 * S:
            return math.nan
        x = (t - t[0]) / S
        x -= x.mean()
        return float((x @ y[:, 0]) / (x @ x)) * 1e3


class Estimates:
    """Everything of a set of recordings. `add` each piece; then read the fields."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.limit = quantile(config.fusion.gate_alpha, 3)
        self.heads: list[Learned] = []
        self.gated: dict[str, Gated] = {}
        self.headed: dict[str, Headed] = {}
        self.bias: dict[str, tuple[Envelope, Envelope]] = {}  # m/s2 and its sd
        self.clocks: dict[str, HostClock] = {}  # by run
        self.rates: dict[str, Track] = {}  # Hz of the fitted times, per accelerometer

    def add(self, piece: Piece) -> None:
        if len(self.heads) < KEPT:
            self.heads += piece.learned
        for name, judged in piece.judged.items():
            g = self.gated.setdefault(name, Gated())
            gate = np.isin(judged.verdict, (Verdict.ACCEPTED, Verdict.REJECTED)) & np.isfinite(judged.ratio)
            gate &= (judged.std_residual_m > 0).all(axis=1)
            self._innovations(g, judged.utc_ns[gate], judged.ratio[gate] * self.limit, judged.verdict[gate])
            good = gate & (judged.verdict == Verdict.ACCEPTED)
            if good.any():
                nu = judged.residual_m[good] / judged.std_residual_m[good]
                g.pairs[0] += (nu[1:] * nu[:-1]).sum(axis=0)
                g.pairs[1] += (nu[1:] * nu[1:]).sum(axis=0)
                g.used += (judged.std_m[good] ** 2).sum(axis=0)
                g.used_std.add(judged.utc_ns[good], judged.std_m[good])
        for name, point in self.config.points.items():
            fixes = piece.fixes.get(point.receiver or "")
            if fixes is not None:
                told = (fixes.quality == Quality.FIXED) & np.isfinite(fixes.std_m).all(axis=1)
                g = self.gated.setdefault(name, Gated())
                g.declared += (fixes.std_m[told] ** 2).sum(axis=0)
                g.declared_count += int(told.sum())
        for name, (utc_ns, bias, std) in piece.bias.items():
            envelopes = self.bias.setdefault(name, (Envelope(3, FINEST_NS, SPANS), Envelope(3, FINEST_NS, SPANS)))
            known = (np.isfinite(std) & (std > 0)).all(axis=1)  # 0 where there is no accelerometer
            envelopes[0].add(utc_ns[known], bias[known])
            envelopes[1].add(utc_ns[known], std[known])
        for name, a in piece.accelerations.items():
            steps = np.diff(a.t_ns)[(a.flags[1:] & AccelFlag.FITTED.value) != 0]
            if len(steps) >= 100:
                rate = S / float(np.median(steps))
                self.rates.setdefault(name, Track()).add(int(a.utc_ns[len(a.utc_ns) // 2]), np.array([rate]))
        self._noted(piece)

    @staticmethod
    def _innovations(g: Gated, utc_ns: I64, square: F64, verdict: np.ndarray[tuple[int], np.dtype[np.uint8]]) -> None:
        """`square` = v'S^-1 v of three axes."""
        if not len(square):
            return
        g.chance += np.bincount(np.minimum((chi2_3(square) * BINS).astype(np.int64), BINS - 1), minlength=BINS)
        g.count += len(square)
        good = verdict == Verdict.ACCEPTED
        n = int(good.sum())
        if n:
            g.total += float(square[good].sum())
            g.accepted += n
            g.nis.add(int(utc_ns[good][n // 2]), np.array([square[good].mean() / 3.0]), n)

    def _noted(self, piece: Piece) -> None:
        headings: dict[str, list[Stored]] = {}
        ticks = []
        for s in piece.noted:
            if s.schema == topics.TICK:
                ticks.append(s)
            else:
                headings.setdefault(s.topic.split("/")[2], []).append(s)
        for name, messages in headings.items():
            self._headings(name, messages)
        if ticks:
            self._ticks(piece.run, ticks)

    def _headings(self, name: str, messages: list[Stored]) -> None:
        publish = np.array([m.publish_ns for m in messages], np.int64)
        for group in groups(messages[0].schema, [m.data for m in messages]):
            utc = publish[group.rows]
            c = {k: v[:, 0].astype(np.float64) for k, v in group.columns.items()}
            said = c["measured_deg"]
            if name not in self.headed:
                known = said[np.isfinite(said)]
                if not len(known):
                    continue
                self.headed[name] = Headed(float(known[0]), limit=quantile(self.config.fusion.gate_alpha, 1))
            h = self.headed[name]
            h.estimate.add(utc, wrapped(c["heading_deg"] - h.first_deg))
            h.measured.add(utc, wrapped(said - h.first_deg))
            h.std.add(utc, c["std_deg"])
            for value, n in zip(*np.unique(c["verdict"], return_counts=True), strict=True):
                h.verdicts[int(value)] = h.verdicts.get(int(value), 0) + int(n)
            good = (c["verdict"] == Verdict.ACCEPTED) & np.isfinite(c["ratio"])
            h.total += float(c["ratio"][good].sum()) * h.limit
            h.accepted += int(good.sum())
            told = np.isfinite(c["baseline_m"]) & (c["baseline_m"] > 0)
            if told.any():
                h.baseline_m = float(c["baseline_m"][told][-1])
            known_at = np.flatnonzero(np.isfinite(c["heading_deg"]))
            if len(known_at):
                h.last_deg = float(c["heading_deg"][known_at[-1]])
                h.last_std_deg = float(c["std_deg"][known_at[-1]])

    def _ticks(self, run: str, messages: list[Stored]) -> None:
        clock = self.clocks.setdefault(run, HostClock())
        log = np.array([m.log_ns for m in messages], np.int64)
        for group in groups(messages[0].schema, [m.data for m in messages]):
            c = {k: v[:, 0] for k, v in group.columns.items()}
            offset = c["utc_ns"].astype(np.int64) - c["monotonic_ns"].astype(np.int64)
            if clock.first_ns is None:
                clock.first_ns = int(offset[0])
            for t, ms in zip(log[group.rows].tolist(), ((offset - clock.first_ns) / 1e6).tolist(), strict=True):
                clock.offset_ms.add(t, np.array([ms]))
            clock.ticks += len(offset)
            clock.synchronised += int(c["sync"].astype(np.bool_).sum())
            clock.error_s = max(clock.error_s, float(c["error_ns"].max()) / S)


def wrapped(deg: F64) -> F64:
    """Angles in (-180, 180]; NaN stays."""
    return np.asarray(deg - 360.0 * np.ceil((deg - 180.0) / 360.0))


def chi2_3(x: F64) -> F64:
    """Probability that chi-square of three degrees of freedom is below x (n,): erf(u) - 2 u exp(-u^2) / sqrt(pi) with
    u^2 = x / 2."""
    u = np.sqrt(0.5 * x)
    erf = np.array([math.erf(v) for v in u.tolist()])
    return np.asarray(np.clip(erf - 2.0 / math.sqrt(math.pi) * u * np.exp(-u * u), 0.0, 1.0))
