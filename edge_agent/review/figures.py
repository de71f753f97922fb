"""The figures of a review as plain values (the JSON twin), and what an engineer would say of them first.

`as_json` holds every number that the page shows, in SI units with the unit in the name; NaN is null. `findings` says
what went wrong, the worst first, `conclusions` what was found, one sentence each.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from edge_agent.cat import iso
from edge_agent.messages import F64, AccelFlag, S, Verdict
from edge_agent.review.charts import length, utc
from edge_agent.review.estimates import at_the_gate
from edge_agent.review.gather import Extreme, PointFigures, Review, gaps_of, modes_of
from edge_agent.review.modal import in_phase
from edge_agent.review.panels import (
    AXES,
    MM,
    SENSOR_EVENTS,
    absent,
    accelerometer_only,
    came,
    mm,
    number,
    percent,
    quality_name,
)
from edge_agent.review.panels_estimates import honest_words
from edge_agent.review.received import UNRECORDED, Due
from edge_agent.review.sources import differences
from edge_agent.review.spectra import Spectrum

MISSED = 0.001
"""Epochs or samples that are missing count as lost data above this share."""
LISTED = 2000
"""Events and gaps in the JSON twin at most."""


class Finding(NamedTuple):
    """`level`: 0 the result is in doubt, 1 data was lost or is missing, 2 worth knowing."""

    level: int
    text: str


def _value(x: float, digits: int = 9) -> float | None:
    return float(f"{x:.{digits}g}") if math.isfinite(x) else None


def availability_of(r: Review, p: PointFigures) -> float:
    """Share of the period for which a valid displacement is there."""
    return min(p.valid.covered_ns / S / r.seconds, 1.0)


def _extreme(e: Extreme | None) -> dict[str, Any] | None:
    if e is None:
        return None
    return {"value_m": _value(e.value_m), "std_m": _value(e.std_m), "utc": iso(e.utc_ns)}


def _spectrum(s: Spectrum | None) -> dict[str, Any] | None:
    if s is None:
        return None
    keep = slice(None, None, max(1, len(s.freq_hz) // 1500))
    return {
        "segments": s.segments,
        "resolution_hz": _value(float(s.freq_hz[1])),
        "lines": len(s.freq_hz),
        "freq_hz": [_value(v, 6) for v in s.freq_hz[keep].tolist()],
        **{f"psd_{a}": [_value(v, 5) for v in s.psd[keep, i].tolist()] for i, a in enumerate(AXES)},
    }


def _point(r: Review, name: str, p: PointFigures) -> dict[str, Any]:
    point = r.overview.points[name]
    a = p.agreement
    n = sum(point.verdicts.values())
    return {
        "receiver": p.receiver or None,
        "accelerometer": p.accelerometer or None,
        "availability": _value(availability_of(r, p)),
        "valid_s": _value(p.valid.covered_ns / S),
        "samples": point.stream.samples,
        "valid_samples": p.moments.n,
        "modes": {k: _value(v) for k, v in modes_of(point).items()},
        "displacement": {
            axis: {
                "least": _extreme(p.low[i]),
                "largest": _extreme(p.high[i]),
                "mean_m": _value(float(p.moments.mean[i])),
                "rms_about_mean_m": _value(float(p.moments.std[i])),
                "mean_std_m": _value(float(p.std_m.mean[i])),
                "mean_std_smoothed_m": _value(float(p.smoothed_std_m.mean[i])) if p.smoothed_std_m.n else None,
            }
            for i, axis in enumerate(AXES)
            if p.moments.n
        },
        "gate": {
            "fixes": n,
            "verdicts": {Verdict(v).name: k for v, k in sorted(point.verdicts.items())},
            "share_refused": _value(point.verdicts.get(int(Verdict.REJECTED), 0) / max(at_the_gate(point.verdicts), 1)),
            "over_limit": point.over,
            "innovation2_over_variance": [_value(float(v)) for v in p.nis] if p.gated else None,
            "smallest_step_refused_m": [_value(math.sqrt(16.27) * float(v)) for v in p.std_residual_m]
            if p.gated
            else None,
        },
        "gaps": _listed(absent(r, p)),
        "frequencies": [
            {k: _value(v) if isinstance(v, float) else v for k, v in f._asdict().items()} for f in p.frequencies
        ],
        "track": {
            "utc": [iso(t) for t in p.track[0].tolist()],
            "freq_hz": [[_value(v, 6) for v in row] for row in p.track[1].tolist()],
            "std_hz": [[_value(v, 3) for v in row] for row in p.track[2].tolist()],
        },
        "spectra": {
            "accelerations_m2ps4pHz": _spectrum(p.accel_spectrum),
            "fused_m2pHz": _spectrum(p.fused_spectrum),
            "gnss_m2pHz": _spectrum(p.gnss_spectrum),
        },
        "agreement": None
        if a is None
        else {
            "verdict": a.verdict,
            "text": a.text,
            "offset_s": _value(a.offset.value_s) if a.offset.observable else None,
            "std_offset_s": _value(a.offset.std_s) if a.offset.observable else None,
            "offset_observable": a.offset.observable,
            "offset_by_speed_s": None if a.by_speed is None else _value(a.by_speed.value_s),
            "std_offset_by_speed_s": None if a.by_speed is None else _value(a.by_speed.std_s),
            "yaw_deg": _value(a.mounting.yaw_deg),
            "std_yaw_deg": _value(a.mounting.std_yaw_deg),
            "axes": list(a.mounting.axes),
            "mounting_observable": a.mounting.observable,
            "share_shown": _value(a.windows.together[0]),
            "std_share_shown": _value(a.windows.together[1]),
            "windows": [
                {
                    "begin_utc": iso(begin + p.busy.utc_minus_ns),
                    "end_utc": iso(end + p.busy.utc_minus_ns),
                    "log_likelihood_with_less_without": _value(support, 5),
                    "share_shown": _value(share, 4) if loud else None,
                    "std_share_shown": _value(std, 4) if loud else None,
                }
                for begin, end, share, std, support, loud in zip(
                    *(v.tolist() for v in (a.windows.begin_ns, a.windows.end_ns, a.windows.share, a.windows.std)),
                    *(v.tolist() for v in (a.windows.support, a.windows.loud)),
                    strict=True,
                )
            ]
            if p.busy is not None
            else [],
        },
        "second_difference": {
            what: {
                "correlation": _three(d.correlation),
                "gain": _three(d.gain),
                "rms_mps2": _three(d.rms_mps2),
                "rms_difference_mps2": _three(d.rms_difference_mps2),
            }
            for what, d in ({} if p.checks is None else p.checks.differences).items()
        },
        "smoothed_less_two_filter_m": None if p.checks is None else _value(p.checks.second_way[0], 3),
        "split": _split(p),
        "wavelets": _wavelets(p),
        "heading": _heading(r, name),
        "innovations": _innovations(r, name),
        "notes": p.notes,
    }


def _three(x: F64) -> list[float | None]:
    return [_value(float(v)) for v in x]


def _split(p: PointFigures) -> dict[str, Any] | None:
    if p.split is None:
        return None
    a = p.apart
    return {
        "critical_hz": _value(p.split.critical_hz),
        "compared_s": None if a is None else _value(a.seconds),
        "share_of_d_type": None if a is None else _value(a.d_share),
        "rms_filter_m": None if a is None else _three(a.filter_m),
        "rms_g_type_less_filter_m": None if a is None else _three(a.g_type_m),
        "rms_d_type_less_filter_m": None if a is None else _three(a.d_type_m),
        "rms_merged_less_filter_m": None if a is None else _three(a.merged_m),
    }


def _wavelets(p: PointFigures) -> dict[str, Any] | None:
    w = p.wavelets
    if w is None:
        return None
    return {
        "axis": AXES[w.axis],
        "begin_utc": iso(w.begin_ns),
        "seconds": _value(w.seconds),
        "bands": [
            {
                "freq_hz": _value(b.freq_hz),
                "low_hz": _value(b.low_hz),
                "high_hz": _value(b.high_hz),
                "rms_fused_m": _value(b.rms_m),
                "rms_gnss_m": _value(b.fixes_rms_m),
                "largest_fused_m": _value(b.largest_m),
            }
            for b in w.bands
        ],
    }


def _heading(r: Review, name: str) -> dict[str, Any] | None:
    h = r.estimates.headed.get(name)
    if h is None:
        return None
    return {
        "headings": sum(h.verdicts.values()),
        "verdicts": {Verdict(v).name: k for v, k in sorted(h.verdicts.items())},
        "last_deg": _value(h.last_deg),
        "std_last_deg": _value(h.last_std_deg),
        "baseline_m": _value(h.baseline_m),
        "innovation2_over_variance": _value(h.mean_nis),
    }


def _innovations(r: Review, name: str) -> dict[str, Any] | None:
    g = r.estimates.gated.get(name)
    if g is None or not g.count:
        return None
    n, used = g.declared_count, g.accepted
    return {
        "at_the_gate": g.count,
        "accepted": used,
        "innovation2_over_variance": _value(g.mean_nis),
        "std_innovation2_over_variance": _value(g.std_nis),
        "likeness_of_neighbours": _three(g.whiteness),
        "per_bin_of_chi2_probability": g.chance.tolist(),
        "verdict": honest_words(g),
        "rms_std_declared_m": _three(np.sqrt(g.declared / n)) if n else None,
        "rms_std_used_m": _three(np.sqrt(g.used / used)) if used else None,
    }


def _modal(r: Review) -> dict[str, Any] | None:
    m = r.modal
    if m is None:
        return None
    return {
        "begin_utc": iso(m.begin_ns),
        "seconds": _value(m.seconds),
        "channels": m.names,
        "missing": m.why or None,
        "modes": [
            {
                "freq_hz": _value(k.freq_hz),
                "std_freq_hz": _value(k.std_freq_hz),
                "damping": _value(k.damping),
                "std_damping": _value(k.std_damping),
                "singular_values_hz": _value(k.fdd_hz),
                "share_of_orders": _value(k.share),
                "in_phase": _value(in_phase(k.shape)),
                "shape": {n: [_value(v.real, 4), _value(v.imag, 4)] for n, v in zip(b.names, k.shape, strict=True)},
            }
            for b in m.bands
            for k in b.modes
        ],
    }


def _clocks(r: Review) -> dict[str, Any]:
    e = r.estimates
    return {
        "host": [
            {
                "run": run,
                "ticks": c.ticks,
                "synchronised": _value(c.synchronised / c.ticks),
                "largest_error_s": _value(c.error_s) if c.error_s > 0 else None,
                "utc_against_monotonic_ppm": _value(c.rate_ppm()),
            }
            for run, c in e.clocks.items()
        ],
        "accelerometers": {name: {"rate_hz": _value(float(t.columns()[1].mean()))} for name, t in e.rates.items()},
        "at_the_heads_of_files": [
            {
                "utc": iso(h.utc_ns),
                "points": {
                    name: {"q_m2ps3": _three(q), "qb_m2ps5": _three(qb), "factor_on_variance": _three(factor)}
                    for name, (q, qb, factor) in h.points.items()
                },
                "accelerometer_rate_error": {name: _value(v) for name, v in h.rates.items()},
                "latency_s": {name: _value(v) for name, (v, _) in h.latencies.items()},
                "latency_is": {name: how for name, (_, how) in h.latencies.items()},
            }
            for h in e.heads[:LISTED]
        ],
    }


def _due(due: Due | None) -> dict[str, Any] | None:
    """What was due and what came. A gap is a place where at least one is missing."""
    if due is None:
        return None
    return {
        "expected": due.expected,
        "received": due.received,
        "missing": due.lost,
        "missing_for_want_of_a_recording": due.unrecorded,
        "missing_by_reason": due.missing,
        "gaps": due.gaps,
        "longest_gap_s": None if due.longest is None else _value((due.longest.end_ns - due.longest.begin_ns) / S),
        "interval_s": _value(due.interval_ns / S),
    }


def _gaps(r: Review, stream: Any) -> list[dict[str, Any]]:
    return _listed([(a, b, why.lower().replace("_", " ")) for a, b, why in gaps_of(r, stream)])


def _listed(gaps: list[tuple[int, int, str]]) -> list[dict[str, Any]]:
    return [
        {"begin_utc": iso(a), "end_utc": iso(b), "seconds": _value((b - a) / S), "reason": why}
        for a, b, why in gaps[:LISTED]
    ]


def as_json(r: Review) -> dict[str, Any]:
    """Everything, as plain values."""
    receivers, sensors = {}, {}
    for name, x in r.overview.receivers.items():
        latency = r.latency[name]
        n = x.stream.samples
        place = r.places.get(name)
        receivers[name] = {
            "fixes": n,
            "rate_hz": _value(S / x.stream.usual_ns) if x.stream.usual_ns else None,
            "quality": {quality_name(q): _value(k / n) for q, k in sorted(x.qualities.items())},
            "fixes_by_quality": {quality_name(q): k for q, k in sorted(x.qualities.items())},
            "quality_history": [
                {"begin_utc": iso(a), "end_utc": iso(b), "quality": quality_name(q)} for a, b, q in x.spells[:LISTED]
            ],
            "mean_latency_s": _value(float(latency.mean[0])) if latency.n else None,
            "std_latency_s": _value(float(latency.std[0])) if latency.n else None,
            "llh_deg_deg_m": [_value(v, 12) for v in place] if place else None,
            "epochs": _due(r.received.receivers.get(name)),
            "gaps": _gaps(r, x.stream),
        }
    for name, a in r.overview.accelerometers.items():
        low, high = a.xyz.spans()[1:3]
        sensors[name] = {
            "samples": a.stream.samples,
            "rate_hz": _value(S * (a.stream.samples - 1) / a.stream.covered_ns) if a.stream.covered_ns else None,
            "due": _due(r.received.accelerometers.get(name)),
            "rms_mps2": _three(r.received.rms(name)),
            "flags": {AccelFlag(v).name: n for v, n in sorted(a.flags.items())},
            "least_mps2": [_value(float(v)) for v in np.nanmin(low, axis=0)] if len(low) else None,
            "largest_mps2": [_value(float(v)) for v in np.nanmax(high, axis=0)] if len(high) else None,
            "gaps": _gaps(r, a.stream),
        }
    from edge_agent.verify import as_json as verify_json

    checked = verify_json(r.verdict)
    return {
        "site": r.config.site,
        "begin_utc": iso(r.begin_ns),
        "end_utc": iso(r.end_ns),
        "seconds": _value(r.seconds),
        "conclusions": conclusions(r),
        "findings": [f.text for f in findings(r)],
        "damaged": [{"file": str(p), "what": why} for p, why in sorted(r.damaged.items())],
        "points": {name: _point(r, name, p) for name, p in r.points.items()},
        "receivers": receivers,
        "accelerometers": sensors,
        "losses": [
            {"source": s, "where": w, "count": n}
            for (s, w), n in sorted(
                {
                    (s, w): sum(c for f in r.verdict.files for a, b, c, _, _ in f.losses if (a, b) == (s, w))
                    for f in r.verdict.files
                    for s, w, _, _, _ in f.losses
                }.items()
            )
        ],
        "rejected": [{"source": s, "reason": w, "count": n} for (s, w), n in sorted(r.rejects.items())],
        "missing_raw_blocks": r.overview.missing,
        "event_counts": dict(sorted(r.overview.kinds.items())),
        "events": [
            {
                "begin_utc": iso(h.begin_ns),
                "end_utc": iso(h.end_ns),
                "kind": h.kind,
                "source": h.source,
                "text": h.text,
                "values": {k: _value(v) for k, v in h.values.items()},
                "fault": h.fault,
            }
            for h in r.overview.happened[:LISTED]
        ],
        "modal": _modal(r),
        "clocks": _clocks(r),
        "runs": len([run for run in r.overview.runs if run]) or 1,
        "configurations": [{"files": [str(p) for p in s.files]} for s in r.setups],
        "settings_that_differ": dict(differences(r.setups)),
        "copies": [{"file": str(a), "all_of_it_is_in": str(b)} for a, b in sorted(r.copies.items())],
        "verify": checked,
    }


# --------------------------------------------------------------------------------------------------------- first words


def conclusions(r: Review) -> list[str]:
    """What an engineer would say of the record, in a few sentences."""
    n = len(r.verdict.files)
    out = [
        f"{r.config.site}: {utc(r.begin_ns)} to {utc(r.end_ns)} UTC, {length(r.seconds)}, "
        f"from {n} file{'s' if n != 1 else ''}."
    ]
    for name, p in r.points.items():
        if not p.moments.n:
            text = "no valid displacement in this period" if p.receiver else accelerometer_only(r, p)
            out.append(f"{name}: {text}.")
            out += _frequencies(name, p)
            continue
        words = [f"{name}: a valid displacement for {percent(availability_of(r, p))} of the time"]
        begin = p.valid.begin_ns
        if begin - r.begin_ns > 5 * S:
            words.append(f"it begins {length((begin - r.begin_ns) / S)} into the record")
            started = (h for h in r.overview.happened if h.kind == "START" and h.source == name)
            if any(abs(h.end_ns - begin) < 2 * S for h in started):
                words[-1] += ", when the filter has started"
        out.append("; ".join(words) + ".")
        told = []
        for i, axis in enumerate(AXES):
            lo, hi = p.low[i], p.high[i]
            if lo is None or hi is None:
                continue
            e = max((lo, hi), key=lambda v: abs(v.value_m))
            told.append(f"{axis} {mm(e.value_m)} \u00b1 {mm(e.std_m)} mm at {utc(e.utc_ns)[11:]}")
        out.append(f"{name}: furthest displacement from the reference (\u00b1 one sd) " + ", ".join(told) + ".")
        out += _frequencies(name, p)
        if p.agreement is not None and not p.agreement.in_doubt:
            out.append(f"{name}: {p.agreement.text}.")
    for name, x in r.overview.receivers.items():
        if x.stream.samples:
            shares = sorted(x.qualities.items(), key=lambda i: -i[1])
            told = [f"{percent(k / x.stream.samples)} {quality_name(q).lower()}" for q, k in shares]
            latency = r.latency[name]
            words_late = f", latency {1e3 * float(latency.mean[0]):.0f} ms in the mean" if latency.n else ""
            due = r.received.receivers.get(name, Due())
            out.append(f"{name}: {came(due, 'epochs')}; {', '.join(told)}{words_late}.")
    return out


def _frequencies(name: str, p: PointFigures) -> list[str]:
    if not p.frequencies:
        return []
    seen = ", ".join(number(f.freq_hz, 2 if f.freq_hz >= 10 else 3) for f in p.frequencies)
    told = f"{name}: dominating frequencies {seen} Hz in the accelerations"
    if p.fused_spectrum is not None:
        fused = sum(math.isfinite(f.fused_hz) for f in p.frequencies)
        told += f"; {fused} of {len(p.frequencies)} stand out of the fused displacement"
    if p.gnss_spectrum is not None:
        told += f", {sum(math.isfinite(f.gnss_hz) for f in p.frequencies)} of the raw fixes"
    return [f"{told}."]


def findings(r: Review) -> list[Finding]:
    """What went wrong, the worst first."""
    out = []
    for name, p in r.points.items():
        if p.agreement is not None and p.agreement.in_doubt:
            out.append(Finding(0, f"{name}: {p.agreement.text}"))
        out += [
            Finding(0, f"{name}: {kind.lower().replace('_', ' ')} told {_times(n)}")
            for kind, n in _counted(r, name, ("CONTRADICTION",))
        ]
        worst = max((float(v) for v in p.nis), default=0.0)
        if p.gated > 100 and not 0.3 < worst < 3.0:
            out.append(
                Finding(0, f"{name}: the filter's sd is not honest: innovations\u00b2 are {worst:.1f} x the variance")
            )
    for copy, home in sorted(r.copies.items()):
        out.append(Finding(2, f"{copy.name} is a copy of data in {home.name}: counted once"))
    if len(r.setups) > 1:
        n = len(differences(r.setups))
        out.append(Finding(2, f"the files were made with {len(r.setups)} configurations that differ in {n} settings"))
    for path, why in sorted(r.damaged.items()):
        out.append(Finding(1, f"{path.name} is damaged: {why}"))
    for path, why in sorted(r.strange.items()):
        out.append(Finding(2, f"{path.name} is left out: {why}"))
    for name, far in r.apart.items():
        told = f"{far / 1e3:.1f} km" if far >= 1e3 else f"{far:.0f} m"
        text = f"{name} stands {told} from where it stands in other files: two structures under one name of a site"
        out.append(Finding(0, f"{text}; review their files apart"))
    by_reason: dict[str, list[float]] = {}
    for g in r.verdict.gaps:
        by_reason.setdefault(g.reason, []).append((g.end_ns - g.begin_ns) / S)
    for reason, gaps in sorted(by_reason.items()):
        out.append(Finding(1, f"raw data missing {_times(len(gaps))}, {length(sum(gaps))} in all: {reason}"))
    for what, found in (("epochs", r.received.receivers), ("samples", r.received.accelerometers)):
        for name, due in found.items():
            lost = due.lost - due.unrecorded
            if lost:
                why = "; ".join(
                    f"{n} {k}" for k, n in sorted(due.missing.items(), key=lambda i: -i[1]) if k not in UNRECORDED
                )
                level = 1 if lost / (due.expected - due.unrecorded) > MISSED else 2
                out.append(Finding(level, f"{name}: {came(due, what)}: {why}"))
    for name in r.config.receivers:
        if name not in r.received.receivers:
            out.append(Finding(1, f"{name}: no fix in these files"))
    if r.overview.missing:
        out.append(Finding(1, f"{r.overview.missing} raw blocks are in no file"))
    for name, p in r.points.items():
        for kind, n in _counted(r, name, ("JUMP_OPEN", "DATUM", "REACQUIRE", "OUTAGE_END", "ACCEL_LOST", "ACCEL_GAP")):
            out.append(Finding(2, f"{name}: {_WORDS[kind]}, {_times(n)}"))
        verdicts = r.overview.points[name].verdicts
        refused, n = verdicts.get(int(Verdict.REJECTED), 0), at_the_gate(verdicts)
        if refused:
            out.append(Finding(2, f"{name}: {refused} of {n} fixes at the gate were refused ({percent(refused / n)})"))
        dead = sum(b - a for a, b, m in p.spells if m in (5, 6)) / S
        if dead > 1:
            out.append(Finding(1, f"{name}: the estimate was invalid for {length(dead)}"))
    for name in (*r.overview.accelerometers, *r.overview.receivers, *r.config.ports):
        for kind, n in _counted(r, name, SENSOR_EVENTS):
            if not kind.endswith(("_END", "_OPEN")):
                out.append(Finding(2, f"{name}: {kind.lower().replace('_', ' ')}, {_times(n)}"))
    for name, sensor in r.overview.accelerometers.items():
        hit = sensor.flags.get(AccelFlag.SATURATED.value, 0)
        if hit:
            out.append(Finding(1, f"{name}: {hit} samples at the end of the sensor's range"))
        if not sensor.stream.samples:
            out.append(Finding(1, f"{name}: no sample in these files"))
    for (source, reason), n in sorted(r.rejects.items(), key=lambda i: -i[1])[:5]:
        out.append(Finding(2, f"{source}: input refused {_times(n)}, {reason}"))
    out += [Finding(1, text) for text in r.verdict.wanting if not any(p.name in text for p in r.damaged)][:10]
    if r.open_files:
        out.append(Finding(2, f"{', '.join(p.name for p in r.open_files[:5])}: being written, or torn (`recover`)"))
    return sorted(out, key=lambda f: f.level)


_WORDS = {
    "JUMP_OPEN": "fixes jumped to another level (they were used less that level)",
    "DATUM": "the zero moved: a level that stayed was taken over",
    "REACQUIRE": "the estimate was opened anew",
    "OUTAGE_END": "an outage of fixes",
    "ACCEL_LOST": "accelerations were lost",
    "ACCEL_GAP": "a gap in the accelerations",
}


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"


def _counted(r: Review, source: str, kinds: tuple[str, ...]) -> list[tuple[str, int]]:
    seen = r.received.events
    return [(k, seen[k, source].count) for k in kinds if (k, source) in seen]


__all__ = ["MM", "Finding", "as_json", "conclusions", "findings"]
