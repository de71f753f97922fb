"""The heading of a receiver with two antennas: a gated state of its own that no position ever sees.

**State**: heading h [deg] as a random walk, and the receiver's multipath m [deg], a Gauss-Markov process that a
measurement cannot tell from h at once (z = h + m + noise). As in Duong et al., who keep the azimuth among their states
but update it apart from the coordinates, the innovation is wrapped to (-180, 180]. A rate state was tried and left out:
on simulated headings of a structure (standing, turning by 0.05 deg in hours, swaying at 0.3 Hz; 1 and 10 Hz; noise
0.1 deg with and without multipath of 0.05 deg) a random walk alone or with a rate was too sure of itself wherever
there was multipath (mean NEES 6 to 500); with the multipath state it never exceeded 2.4.

**R**: the sd of a fixed solution by the distance of the antennas (PTNL,AVR tells it, else 1 m is taken), times a factor
that starts from the start window's scatter and then follows the median of nu^2 / S like that of the positions; one step
of the last decimal adds its uniform variance.

**Gate**: chi-square of one degree at `gate_alpha`. Refusals that agree with one another for `reacquire_s` are a real
turn: taken over with the event HEADING_JUMP; from the fifth on nothing is used until that is decided, even if it fits,
or a turn of 3 or 4 sd would be smeared over an hour. Refusals that agree on nothing for `lockout_s` mean that
the estimate, or the receiver, is wrong: the start begins anew with HEADING_LOST. So nothing locks out, and neither lone
wrong headings nor wrong solutions shorter than `reacquire_s` move the estimate. Without headings the sd grows.

Scalars only, `math.exp` once per heading. Left out: the angle between the antennas and the structure's axis.
"""

from __future__ import annotations

import math

from edge_agent.fusion.gate import quantile
from edge_agent.messages import Event, FusionSettings, GnssHeading, HeadingEstimate, Quality, S, State, Verdict

WALK_DEG2PS = 1e-7
"""Of h: 0.02 deg in an hour, 0.09 deg in a day, as a tower turns in the sun."""
MULTIPATH = 0.5
"""sd of m as a share of the sd by baseline: both come from the reflections around the antennas."""
MULTIPATH_S = 300.0
"""Its time constant; that of positions by the project's numerical study on a standing antenna."""
FIXED_M = 0.0035
"""Across the baseline: 0.20 deg at 1 m (NovAtel, OEM7 manual, ALIGN); 0.09 deg at 2 m is usual too."""
BASELINE_M = 1.0
"""Where no sentence tells it: the shortest that makers recommend, so the sd is rather too large."""
LEAST_BASELINE_M = 0.1
DEG = 57.29577951308232
START_LEAST, START_MOST = 8, 4096
START_SPREAD = 5.0
"""A start window whose robust spread is beyond so many sd holds no heading yet."""
AGREE = 5
REFUSALS = 8
"""Fewer in `lockout_s` are lone wrong headings of a slow receiver."""
CHI1_MEDIAN = 0.4549364231195724
MAD_SD = 1.4826022185056018
"""sd of a normal distribution / median absolute deviation."""


def wrap(deg: float) -> float:
    """An angle in (-180, 180]."""
    return deg - 360.0 * math.ceil((deg - 180.0) / 360.0)


def compass(deg: float) -> float:
    """An angle in [0, 360)."""
    turned = deg % 360.0
    return turned if turned < 360.0 else 0.0  # a tiny negative angle rounds to 360


def heading_std(quality: Quality, baseline_m: float, settings: FusionSettings) -> float:
    """sd [deg] of a heading by its quality and the distance of the antennas; infinite where it is no measurement."""
    if quality == Quality.FIXED:
        across = FIXED_M
    elif quality == Quality.FLOAT:
        across = settings.float_std_m
    else:
        return math.inf
    baseline = baseline_m if baseline_m > 0.0 else BASELINE_M  # False for NaN
    return min(90.0, DEG * across / max(baseline, LEAST_BASELINE_M))


class HeadingFilter:
    """One receiver's heading. `name` is the source of its events."""

    def __init__(self, name: str, settings: FusionSettings) -> None:
        self.name, self.settings = name, settings
        self.limit = quantile(settings.gate_alpha, 1)
        self.started = False
        self.t_ns = 0  # of the state
        self.h = self.m = 0.0  # deg
        self.hh = self.hm = self.mm = 0.0  # their covariance, deg2
        self.factor = 1.0  # on the variance by baseline
        self.learnt = 0  # headings that the factor has followed
        self.window: list[tuple[int, float, float, float]] = []  # start: t, heading, variance by baseline, of the step
        self.refused = 0  # in a row,
        self.refused_ns = 0  # since
        # headings that agree on another level: since, how many, how many others came between, their mean
        self.run: tuple[int, int, int, float] = (0, 0, 0, 0.0)
        self.apart = 0  # those others in a row

    def update(self, x: GnssHeading, usable: bool) -> list[HeadingEstimate | Event]:
        """Take a heading, with `t_ns` set; `usable` False = worse than the receiver's least quality."""
        sd = heading_std(x.quality, x.baseline_m, self.settings)
        if not usable or sd == math.inf or x.heading_deg != x.heading_deg:
            return [self._told(x, math.nan, math.nan, Verdict.PRECHECK)]
        step = x.resolution_deg * x.resolution_deg / 12.0
        r = sd * sd * self.factor + step
        if not self.started:
            return self._start(x, sd * sd, step)
        if x.t_ns <= self.t_ns:
            return [self._told(x, r, math.nan, Verdict.OLD)]
        multipath = self._multipath(x.baseline_m)
        self._predict((x.t_ns - self.t_ns) / S, multipath)
        self.t_ns = x.t_ns
        nu = wrap(x.heading_deg - self.h - self.m)
        variance = self.hh + 2.0 * self.hm + self.mm + r
        ratio = nu * nu / variance / self.limit
        self._count(x, nu, ratio <= 1.0, r, multipath)
        turned = self.run[1] >= AGREE
        if x.quality == Quality.FIXED and not turned:
            self._learn(nu * nu > CHI1_MEDIAN * variance)
        if ratio > 1.0 or turned:
            return self._refuse(x, r, ratio, multipath)
        self._correct(nu, r)
        return [self._told(x, r, ratio, Verdict.ACCEPTED)]

    # ----------------------------------------------------------------------------------------------------- mathematics

    def _multipath(self, baseline_m: float) -> float:
        """Stationary variance of m [deg2]; a float solution knows no other reflections."""
        sd = MULTIPATH * heading_std(Quality.FIXED, baseline_m, self.settings)
        return sd * sd

    def _predict(self, dt: float, multipath: float) -> None:
        """h and m over dt [s]; `multipath` = the stationary variance of m [deg2]."""
        a = math.exp(-dt / MULTIPATH_S)
        self.m *= a
        self.hh += WALK_DEG2PS * dt
        self.hm *= a
        self.mm = self.mm * a * a + multipath * (1.0 - a * a)

    def _correct(self, nu: float, r: float) -> None:
        """Joseph form of the update with z = h + m, two states written out."""
        hh, hm, mm = self.hh, self.hm, self.mm
        s = hh + 2.0 * hm + mm + r
        k, n = (hh + hm) / s, (hm + mm) / s
        k1, n1 = 1.0 - k, 1.0 - n
        self.h = compass(self.h + k * nu)
        self.m += n * nu
        self.hh = k1 * k1 * hh - 2.0 * k1 * k * hm + k * k * mm + k * k * r
        self.hm = -k1 * n * hh + (k1 * n1 + k * n) * hm - k * n1 * mm + k * n * r
        self.mm = n * n * hh - 2.0 * n * n1 * hm + n1 * n1 * mm + n * n * r

    def _place(self, t_ns: int, deg: float, variance: float, multipath: float) -> None:
        """Begin at `deg`, a mean whose noise has this variance: nothing else is known of h."""
        self.t_ns = t_ns
        self.h, self.m = compass(deg), 0.0
        self.hh, self.hm, self.mm = variance + multipath, -multipath, multipath
        self.refused = self.apart = 0
        self.run = (0, 0, 0, 0.0)

    def _learn(self, above: bool) -> None:
        """One step of the median tracker on the factor of R: wide at first, then `r_step`."""
        s = self.settings
        self.learnt += 1
        step = 1.0 + s.r_step * max(1.0, 50.0 / (self.learnt + 10))
        factor = self.factor * step if above else self.factor / step
        self.factor = min(max(factor, s.r_least), s.r_most)

    # ---------------------------------------------------------------------------------------------------------- policy

    def _start(self, x: GnssHeading, base: float, step: float) -> list[HeadingEstimate | Event]:
        """Gather the window; begin where it agrees with itself."""
        w = self.window
        if w and x.t_ns <= w[-1][0]:
            return [self._told(x, base + step, math.nan, Verdict.OLD)]
        if x.quality != Quality.FIXED:
            return [self._told(x, base + step, math.nan, Verdict.PRECHECK)]
        w.append((x.t_ns, x.heading_deg, base, step))
        n = len(w)
        if n < START_LEAST or (n < START_MOST and (x.t_ns - w[0][0]) / S < self.settings.start_s):
            return [self._told(x, base + step, math.nan, Verdict.START)]
        from_first = [wrap(v[1] - w[0][1]) for v in w]
        level = sorted(from_first)[n // 2]
        spread = MAD_SD * sorted(abs(u - level) for u in from_first)[n // 2]
        moves = sorted(abs(from_first[i + 1] - from_first[i]) for i in range(n - 1))
        noise = MAD_SD * moves[(n - 1) // 2]
        base = max(v[2] for v in w)
        step = max(v[3] for v in w)
        s = self.settings
        self.factor = min(max((0.5 * noise * noise - step) / base, s.r_least), s.r_most)
        r = base * self.factor + step
        if spread > START_SPREAD * math.sqrt(r):
            del w[: n // 2]
            return [self._told(x, r, math.nan, Verdict.START)]
        begin = w[0][0]
        # a median has pi / 2 times the variance of a mean
        self._place(x.t_ns, w[0][1] + level, 0.5 * math.pi * r / n, MULTIPATH * MULTIPATH * base)
        self.started, self.learnt, self.window = True, 0, []
        text = (
            f"heading {self.h:.3f} deg from {n} headings, sd {math.sqrt(self.hh):.3g} deg; of one: {math.sqrt(r):.3g}"
        )
        values = (("heading_deg", self.h), ("std_deg", math.sqrt(self.hh)), ("std_measured_deg", math.sqrt(r)))
        event = Event(x.t_ns, "HEADING_START", self.name, text, values, begin, x.t_ns)
        return [self._told(x, r, math.nan, Verdict.START), event]

    def _count(self, x: GnssHeading, nu: float, fits: bool, r: float, multipath: float) -> None:
        """Keep the run of headings that agree on another level.

        A turn by little more than the gate lets some headings pass: what lies nearer to the run's mean than to the
        estimate belongs to the run. Five in a row that do not, or as many in all as the run has, end it.
        """
        begin, n, others, mean = self.run
        off = wrap(x.heading_deg - mean)
        if n and abs(off) < abs(nu) and off * off <= self.limit * (r + r / n + multipath):
            n += 1
            self.apart = 0
            self.run = (begin, n, others, compass(mean + off / n))
            return
        self.apart += 1
        if n and others + 1 < n and not (fits and self.apart >= AGREE):
            self.run = (begin, n, others + 1, mean)
        elif fits:
            self.run = (0, 0, 0, 0.0)
        else:
            self.run = (x.t_ns, 1, 0, x.heading_deg)
        if fits:
            self.refused = 0

    def _refuse(self, x: GnssHeading, r: float, ratio: float, multipath: float) -> list[HeadingEstimate | Event]:
        """A heading that is not used: alone, one of a level that will hold, or one of a chaos."""
        s = self.settings
        if self.refused == 0:
            self.refused_ns = x.t_ns
        self.refused += 1
        begin, n, _, mean = self.run
        if n >= AGREE and self.apart == 0 and (x.t_ns - begin) / S >= s.reacquire_s:
            before = self.h
            self._place(x.t_ns, mean, r / n, multipath)
            text = f"heading turned by {wrap(self.h - before):+.3f} deg and has held there for {s.reacquire_s:g} s"
            values = (("before_deg", before), ("after_deg", self.h), ("turn_deg", wrap(self.h - before)))
            event = Event(x.t_ns, "HEADING_JUMP", self.name, text, values, begin, x.t_ns)
            return [event, self._told(x, r, ratio, Verdict.ACCEPTED)]
        scattered = (x.t_ns - begin) / S < 0.5 * s.lockout_s
        if scattered and self.refused >= REFUSALS and (x.t_ns - self.refused_ns) / S >= s.lockout_s:
            text = f"{self.refused} headings in a row do not fit and do not agree: the estimate begins anew"
            count = (("count", float(self.refused)), ("heading_deg", self.h))
            event = Event(x.t_ns, "HEADING_LOST", self.name, text, count, self.refused_ns, x.t_ns)
            self.started = False
            self.window = []
            return [event, self._told(x, r, ratio, Verdict.REJECTED)]
        return [self._told(x, r, ratio, Verdict.REJECTED)]

    def _told(self, x: GnssHeading, r: float, ratio: float, verdict: Verdict) -> HeadingEstimate:
        h = std = math.nan
        if self.started:
            h = self.h
            std = math.sqrt(self.hh + WALK_DEG2PS * max(0.0, (x.t_ns - self.t_ns) / S))
        used = math.sqrt(r) if r == r else math.nan
        return HeadingEstimate(x.t_ns, h, std, x.heading_deg, used, x.tilt_deg, x.baseline_m, ratio, verdict)

    # ----------------------------------------------------------------------------------------------------------- state

    def save(self) -> State:
        return {
            "started": self.started, "t": self.t_ns, "x": [self.h, self.m], "C": [self.hh, self.hm, self.mm],
            "factor": self.factor, "learnt": self.learnt, "window": [list(v) for v in self.window],
            "refused": [self.refused, self.refused_ns], "apart": self.apart, "run": list(self.run),
        }  # fmt: skip

    def load(self, s: State) -> None:
        self.started, self.t_ns = s["started"], s["t"]
        self.h, self.m = s["x"]
        self.hh, self.hm, self.mm = s["C"]
        self.factor, self.learnt = s["factor"], s["learnt"]
        self.window = [(v[0], v[1], v[2], v[3]) for v in s["window"]]
        self.refused, self.refused_ns = s["refused"]
        self.apart = s["apart"]
        self.run = (s["run"][0], s["run"][1], s["run"][2], s["run"][3])
