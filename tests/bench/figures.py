"""Arithmetic of the benchmark: medians, ratios, verdicts, the table. No clock, no process."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

MET, MISSED, SKIPPED, TOLD = "met", "MISSED", "skipped", "told"
"""TOLD: a figure without a goal."""


@dataclass(frozen=True)
class Goal:
    """One limit. `of` None = the figure itself, else its ratio to that peer: "figure" = figure / peer at most `limit`,
    "peer" = peer / figure at least `limit` ("so many times cheaper"), both for figures where less is better; where
    more is better ("rate"), figure / peer or the figure itself is at least `limit`."""

    limit: float
    of: str | None = None
    kind: str = "figure"

    def value(self, figure: float, peers: dict[str, float]) -> float:
        if self.of is None:
            return figure
        peer = peers[self.of]
        return peer / figure if self.kind == "peer" else figure / peer

    def holds(self, figure: float, peers: dict[str, float]) -> bool:
        value = self.value(figure, peers)
        return value >= self.limit if self.kind in ("peer", "rate") else value <= self.limit

    def text(self, unit: str) -> str:
        sign = ">=" if self.kind in ("peer", "rate") else "<="
        if self.of is None:
            return f"{sign} {self.limit:g} {unit}"
        return f"{sign} {self.limit:g} x cheaper" if self.kind == "peer" else f"{sign} {self.limit:g} x {self.of}"


@dataclass
class Result:
    """What one row found. `figures` and each list of `peers` hold one number per round, in the rounds' order."""

    name: str
    unit: str
    goals: tuple[Goal, ...]
    figures: list[float] = field(default_factory=list)
    peers: dict[str, list[float]] = field(default_factory=dict)
    reason: str = ""  # why it was skipped
    without: dict[str, str] = field(default_factory=dict)  # peer -> why it is not there

    @property
    def figure(self) -> float:
        return median(self.figures)

    @property
    def peer_medians(self) -> dict[str, float]:
        return {k: median(v) for k, v in self.peers.items()}

    def judged(self) -> list[tuple[Goal, float, bool]]:
        """Each goal whose peer is there: (goal, value, holds). Ratios are medians of the ratios of each round, so that
        a machine that changes its speed between the rounds does not matter."""
        found = []
        for goal in self.goals:
            if goal.of is not None and not self.peers.get(goal.of):
                continue
            if goal.of is None:
                found.append((goal, self.figure, goal.holds(self.figure, {})))
            else:
                pairs = zip(self.figures, self.peers[goal.of], strict=True)
                value = median([goal.value(a, {goal.of: b}) for a, b in pairs])
                holds = value >= goal.limit if goal.kind in ("peer", "rate") else value <= goal.limit
                found.append((goal, value, holds))
        return found

    @property
    def verdict(self) -> str:
        if not self.figures:
            return SKIPPED
        judged = self.judged()
        if not judged:
            return TOLD
        return MET if all(holds for _, _, holds in judged) else MISSED


def median(values: Sequence[float]) -> float:
    """The middle value, or the mean of the two in the middle. ValueError for none."""
    if not values:
        raise ValueError("median of nothing")
    s = sorted(values)
    half = len(s) // 2
    return s[half] if len(s) % 2 else 0.5 * (s[half - 1] + s[half])


def spread(values: Sequence[float]) -> float:
    """Half of the range over the median: 0.1 = plus or minus 10 %."""
    return 0.5 * (max(values) - min(values)) / median(values)


def number(value: float) -> str:
    """Three digits, without an exponent."""
    size = abs(value)
    if size >= 100:
        return f"{value:,.0f}".replace(",", " ")
    return f"{value:.1f}" if size >= 10 else f"{value:.2f}" if size >= 1 else f"{value:.3f}"


def table(results: Sequence[Result]) -> str:
    """One line per goal; a row without a goal or without a figure has one line too."""
    rows = [("row", "measured", "beside it", "ratio", "goal", "verdict")]
    for r in results:
        if not r.figures:
            rows.append((r.name, "", "", "", "", f"{SKIPPED}: {r.reason}"))
            continue
        measured = f"{number(r.figure)} {r.unit} +-{100 * spread(r.figures):.0f} %"
        name = r.name
        told = set()
        for goal, value, holds in r.judged():
            beside = ""
            if goal.of is not None:
                told.add(goal.of)
                beside = f"{goal.of} {number(median(r.peers[goal.of]))}"
            ratio = "" if goal.of is None else f"{number(value)} x"
            rows.append((name, measured, beside, ratio, goal.text(r.unit), MET if holds else MISSED))
            name = measured = ""
        for peer, values in r.peers.items():
            if peer not in told:
                pairs = zip(r.figures, values, strict=True)
                ratio = median([a / b for a, b in pairs])
                rows.append((name, measured, f"{peer} {number(median(values))}", f"{number(ratio)} x", "", ""))
                name = measured = ""
        if name:
            rows.append((name, measured, "", "", "", TOLD))
        rows += [("", "", peer, "", "", f"{SKIPPED}: {why}") for peer, why in r.without.items()]
    return columns(rows)


def columns(rows: Sequence[tuple[str, ...]]) -> str:
    """Rows of text in aligned columns, a line of dashes below the first."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    widths[-1] = 0
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([lines[0], "-" * max(map(len, lines)), *lines[1:]])


def misses(results: Sequence[Result]) -> list[str]:
    """One line for each goal that was not reached."""
    return [
        f"{r.name}: {number(value)} {'x' if goal.of else r.unit}, goal {goal.text(r.unit)}"
        for r in results
        if r.figures
        for goal, value, holds in r.judged()
        if not holds
    ]


def comparison(name: str, unit: str, old: Sequence[float], new: Sequence[float]) -> tuple[str, ...]:
    """A line of the table of two checkouts; old and new are pairs, run one after the other."""
    ratios = [b / a for a, b in zip(old, new, strict=True)]
    span = f"{number(min(ratios))} ... {number(max(ratios))}"
    return (name, unit, number(median(old)), number(median(new)), f"{number(median(ratios))} x", span)


def as_json(results: Sequence[Result]) -> list[dict[str, object]]:
    """The same for programs."""
    return [
        {
            "row": r.name,
            "unit": r.unit,
            "figures": r.figures,
            "peers": r.peers,
            "verdict": r.verdict,
            "reason": r.reason,
            "without": r.without,
            "goals": [
                {"goal": g.text(r.unit), "of": g.of, "value": value, "met": holds} for g, value, holds in r.judged()
            ]
            if r.figures
            else [],
        }
        for r in results
    ]
