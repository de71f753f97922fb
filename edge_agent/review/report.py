"""`edge-agent review`: the panels on one page that needs nothing but itself.

No address outside the file is in it; script and style stand inside (page.css, page.js beside this module). Conclusions
come first, then what went wrong, then the panels. On paper every panel keeps together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from html import escape
from importlib.metadata import version
from importlib.resources import files as package_files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from edge_agent.messages import S
from edge_agent.review import panels, panels_checks, panels_estimates, panels_modes
from edge_agent.review.charts import length, utc
from edge_agent.review.figures import as_json, availability_of, conclusions, findings
from edge_agent.review.gather import Review, gather
from edge_agent.review.panels import AXES, came, mm, number, percent, quality_name
from edge_agent.review.received import Due
from edge_agent.review.sources import opened, sites

LEVELS = ("doubt", "lost", "known")


class Panel(NamedTuple):
    """A section of the page."""

    key: str
    title: str
    draw: Callable[[Review], str]


PANELS = (
    Panel("displacement", "Displacement", panels.displacement),
    Panel("extremes", "Extremes", panels.extremes),
    Panel("frequencies", "Spectra and frequencies", panels_modes.frequencies),
    Panel("modes", "Modes of the structure", panels_modes.modes),
    Panel("wavelets", "When it moved at which frequency", panels_modes.wavelets),
    Panel("heading", "Heading", panels_estimates.headings),
    Panel("availability", "Availability and gaps", panels.availability),
    Panel("events", "Events", panels.events),
    Panel("gate", "Innovations and verdicts", panels.gate),
    Panel("honesty", "Is the stated accuracy honest?", panels_estimates.honesty),
    Panel("noise", "Noise and bias", panels_estimates.noise),
    Panel("clocks", "Clocks", panels_estimates.clocks),
    Panel("receivers", "Fix quality and latency", panels.receivers),
    Panel("sensors", "Sensor health", panels.sensors),
    Panel("agreement", "Do the sensors agree?", panels_checks.agreement),
    Panel("integration", "Integration and differences", panels_checks.integration),
    Panel("split", "Split by frequency, beside the filter", panels_checks.split),
    Panel("losses", "Losses", panels.losses),
    Panel("place", "Where it stands", panels.place),
    Panel("files", "Files", panels.files),
    Panel("settings", "Configuration", panels.settings),
)
"""The page from top to bottom; a panel that returns "" has nothing to tell."""


def page(r: Review) -> str:
    """The whole page."""
    here = package_files("edge_agent.review")
    css, js = (here.joinpath(n).read_text(encoding="utf-8") for n in ("page.css", "page.js"))
    sections, links = [], []
    for panel in PANELS:
        body = panel.draw(r)
        if body:
            sections.append(f'<section id="{panel.key}"><h2>{escape(panel.title)}</h2>{body}</section>')
            links.append(f'<a href="#{panel.key}">{escape(panel.title)}</a>')
    found = findings(r)
    trouble = (
        "".join(f'<li class="{LEVELS[f.level]}">{escape(f.text)}.</li>' for f in found)
        or "<li class=fine>Nothing: no gap, no loss, no jump, no damaged file.</li>"
    )
    said = "".join(f"<li>{escape(t)}</li>" for t in conclusions(r))
    title = f"{r.config.site}: review of {utc(r.begin_ns)[:10]}"
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<link rel="icon" href="data:,"><title>{escape(title)}</title><style>{css}</style></head><body><main>'
        f"<header><h1>{escape(r.config.site)}</h1><p>Displacement review</p>"
        f'{_plate(r)}</header><div class="cards">{_cards(r)}</div>'
        f'<section id="summary"><h2>Summary</h2><ul>{said}</ul><h3>What went wrong</h3><ul class="trouble">{trouble}'
        f"</ul></section><nav>{''.join(links)}</nav>{''.join(sections)}"
        f"<footer>Made by edge-agent review from {len(r.verdict.files)} files. All times UTC; sd = standard deviation. "
        f"</footer></main><script>{js}</script></body></html>\n"
    )


def _plate(r: Review) -> str:
    """The title block: what, when, from what, by which software with which settings."""
    runs = [f.run for f in r.verdict.files]
    agents = sorted({run["version"] for run in runs if run.get("version")})
    sources = sorted({run["source"] for run in runs if run.get("source")})
    made = ", ".join([*(f"edge-agent {v}" for v in agents), *sources]) or "not told"
    settings = [s.digest for s in r.setups]
    told = ", ".join(settings[:3]) + (f" and {len(settings) - 3} more" if len(settings) > 3 else "")
    recorded = sum(f.end_ns - f.begin_ns for f in r.verdict.files if f.messages) / S
    size = sum(f.size for f in r.verdict.files) / 1e6
    rows = [
        ("Site", r.config.site),
        ("Period", f"{utc(r.begin_ns)} to {utc(r.end_ns)} UTC"),
        ("Recorded", f"{length(min(recorded, r.seconds))} of {length(r.seconds)}"),
        ("Files", f"{len(r.verdict.files)}, {size:.1f} MB"),
        ("Points", ", ".join(r.points) or "none"),
        ("Recorded by", made),
        ("Settings (SHA-256 of config.yaml)", told or "none attached"),
        ("Reviewed by", f"edge-agent {version('edge-agent')}"),
    ]
    body = "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in rows)
    return f'<dl class="plate">{body}</dl>'


def _cards(r: Review) -> str:
    out = [("Period", length(r.seconds), f"{utc(r.begin_ns)[:16]} UTC")]
    for name, p in list(r.points.items())[:4]:
        if not p.receiver:
            rms = r.received.rms(p.accelerometer)
            told = " / ".join(f"{1e3 * v:.3g}" for v in rms.tolist()) if np.isfinite(rms).all() else "no sample"
            out.append((f"{name}: accelerometer only", told, "rms x / y / z [mm/s\u00b2]"))
            if p.frequencies:
                f = p.frequencies[0]
                more = len(p.frequencies) - 1
                out.append((f"{name}: lowest frequency", f"{number(f.freq_hz, 3)} Hz", f"{more} more" if more else ""))
            continue
        if not p.moments.n:
            out.append((f"{name}", "no valid displacement", ""))
            continue
        out.append((f"{name}: availability", percent(availability_of(r, p)), "valid displacement"))
        moved = [
            (hi.value_m - lo.value_m, i, lo, hi)
            for i, (lo, hi) in enumerate(zip(p.low, p.high, strict=True))
            if lo and hi
        ]
        size, i, lo, hi = max(moved)
        sd = math.hypot(lo.std_m, hi.std_m)
        doubt = ", in doubt: the sensors contradict each other" if p.agreement and p.agreement.in_doubt else ""
        out.append((f"{name}: largest peak to peak", f"{mm(size)} \u00b1 {mm(sd)} mm", f"axis {AXES[i]}{doubt}"))
        if p.frequencies:
            f = p.frequencies[0]
            more = len(p.frequencies) - 1
            out.append((f"{name}: lowest frequency", f"{number(f.freq_hz, 3)} Hz", f"{more} more" if more else "alone"))
    for name, x in list(r.overview.receivers.items())[:2]:
        if x.stream.samples:
            q, n = max(x.qualities.items(), key=lambda row: row[1])
            out.append(
                (
                    f"{name}: fixes",
                    f"{percent(n / x.stream.samples)} {quality_name(q).lower()}",
                    came(r.received.receivers.get(name, Due()), "epochs"),
                )
            )
    return "".join(
        f"<div><span>{escape(a)}</span><b>{escape(b)}</b><small>{escape(c)}</small></div>" for a, b, c in out
    )


class Reviewed(NamedTuple):
    """What was gathered of one site, its JSON twin and its page (None: none was asked for)."""

    review: Review
    figures: dict[str, Any]
    page: Path | None


def review(
    inputs: Sequence[Path], output: Path | None, progress: Callable[[str], None] | None = None
) -> list[Reviewed]:
    """Read recordings and write a page for each of their sites (`output` None: none); of more than one, each page has
    the site in its name. Raises as `sources.opened`."""
    parts = sites(opened(inputs))
    out = []
    for site, part in parts.items():
        gathered = gather(part, progress)
        path = output
        if output is not None:
            path = output if len(parts) == 1 else output.with_name(f"{output.stem}-{site}{output.suffix}")
            beside = path.with_name(path.name + ".part")
            beside.write_text(page(gathered), encoding="utf-8")
            beside.replace(path)
        out.append(Reviewed(gathered, as_json(gathered), path))
    return out


def as_text(r: Review) -> str:
    """For people on a terminal: the page's first words."""
    lines = [*conclusions(r), *(f"{('WRONG', 'LOSS', 'note')[f.level]}: {f.text}" for f in findings(r))]
    return "\n".join(lines)
