"""The gate of one point: joint chi-square test of each fix and what follows from runs of refusals.

A fix fits when the sum over the axes of nu^2 / S stays below the chi-square quantile. Single misfits are dropped. A
wrong ambiguity fix, though, is a *constant* offset: at least four refusals of the last eight that agree with one
another open the level offset o, and fusion goes on with z - o, which still carries velocity, bias and relative
motion. The offset ends

- when fixes agree with o = 0 again: four in a row and the likelihood ratio of "o = 0" against "o as estimated" beyond
  e^6 (a small offset fits o = 0 now and then; the ratio tells them apart);
- after `reacquire_s`: the level is real, d takes it over (DATUM);
- another level that four refusals agree on replaces it (three levels within moments are none: REACQUIRE).

Refusals that agree on nothing for `lockout_s` mean that the prediction is wrong, not the fixes: the filter begins anew
at the next one (REACQUIRE), so nothing locks out. After a float spell
or an outage that left the prediction too wide to protect (P > 25 R) three fixes in a row must agree before one is
used. Without accelerations a motion that begins suddenly looks like a small jump: two misfits in a row that agree are
followed (FOLLOW).

Scalars only: this runs per point and only while a point is not calm.
"""

from __future__ import annotations

import enum
import math

from edge_agent.messages import State

Three = tuple[float, float, float]

QUANTILE = {
    0.001: (10.827566170662733, 13.815510557964274, 16.26623619623813),
    0.01: (6.6348966010212145, 9.21034037197618, 11.344866730144373),
    0.05: (3.841458820694124, 5.991464547107979, 7.814727903251179),
}
"""Chi-square quantiles at 1 - alpha for 1, 2 and 3 degrees of freedom."""


def quantile(alpha: float, dof: int) -> float:
    """Chi-square quantile at 1 - alpha for dof 1 to 3; other alphas by Newton steps on the exact distribution."""
    if alpha in QUANTILE:
        return QUANTILE[alpha][dof - 1]
    if not 1e-12 < alpha < 1.0 or dof not in (1, 2, 3):
        raise ValueError("gate: alpha must lie in (1e-12, 1) and dof in 1..3")
    x = QUANTILE[0.001][dof - 1]
    for _ in range(100):
        u = math.sqrt(0.5 * x)
        if dof == 2:
            tail, density = math.exp(-0.5 * x), 0.5 * math.exp(-0.5 * x)
        else:
            tail = math.erfc(u)
            density = math.exp(-0.5 * x) / math.sqrt(2 * math.pi * x)
            if dof == 3:
                tail += math.sqrt(2 * x / math.pi) * math.exp(-0.5 * x)
                density *= x
        # Newton in the logarithm of the tail, which is nearly straight.
        step = (math.log(tail) - math.log(alpha)) * tail / density
        x = max(1e-9, x + step)
        if abs(step) < 1e-12 * x:
            break
    return x


class Action(enum.IntEnum):
    USE = 0  # ACCEPTED
    SKIP = 1  # REJECTED
    OFFSET = 2  # use as z - o
    OPEN = 3  # set o to `level`, wide, then use
    REOPEN = 4  # the same while o was open
    CLOSE = 5  # o = 0, then use
    DATUM = 6  # d += o, then use
    CONFIRM = 7  # refused: waiting for three that agree
    REACQUIRE = 8  # the prediction is worth nothing: begin anew at this fix
    RESUME = 9  # three agree after an outage: use
    CONSUMED = 10  # refused, but counted towards closing
    FOLLOW = 11  # motion that was not predicted: widen, then use


HISTORY = 8
AGREE = 4
CLOSE_RATIO = 6.0
"""Log-likelihood ratio that closes an offset."""


class Gate:
    def __init__(self) -> None:
        self.open = False
        self.open_ns = 0
        self.begin_ns = 0  # of the first opening in a run of levels
        self.quick = 0  # levels found so soon after one another that they are none
        self.history: list[tuple[int, bool, Three, Three]] = []  # t, refused, level, variance of the level
        self.fits_zero = 0
        self.ratio = 0.0
        self.confirm = False
        self.confirm_ns = 0
        self.waiting: list[tuple[int, Three, Three]] = []
        self.level: Three = (0.0, 0.0, 0.0)
        self.calm = True  # nothing open and the last eight were accepted

    def judge(
        self,
        t_ns: int,
        fits: bool,
        fits_zero: bool,
        evidence: float,
        level: Three,
        R: Three,
        Pv: Three,
        limit: float,
        need_confirm: bool,
        since_used_ns: int,
        reacquire_ns: int,
        lockout_ns: int,
        follow: bool = False,
    ) -> Action:
        """What to do with a fix. `level` = z - d predicted; `R` its noise variance, `Pv` the velocity's; `evidence` =
        log-likelihood of o = 0 less that of the estimated o for this fix; `follow`: two misfits in a row that agree are
        motion."""
        if need_confirm and not self.confirm:
            self.confirm = True
            self.confirm_ns = t_ns
            self.waiting = []
        if self.confirm:
            self.calm = False
            if t_ns - self.confirm_ns > lockout_ns:
                self.confirm = False
                self.forget()
                return Action.REACQUIRE
            if self.waiting and not self._agree(t_ns, level, R, Pv, self.waiting[-1], limit):
                self.waiting = []
            self.waiting.append((t_ns, level, R))
            if len(self.waiting) < 3:
                return Action.CONFIRM
            self.confirm = False
            self.waiting = []
            if fits:
                return Action.RESUME
            self.history = []
            return self._open(t_ns, level)
        if self.open:
            if t_ns - self.open_ns > reacquire_ns or t_ns - self.begin_ns > 4 * reacquire_ns:
                self.forget()
                return Action.DATUM
            self.ratio = max(0.0, self.ratio + evidence)
            self.fits_zero = self.fits_zero + 1 if fits_zero else 0
            if not fits_zero:
                self.ratio = 0.0
            if self.fits_zero >= AGREE and self.ratio > CLOSE_RATIO:
                self.forget()
                return Action.CLOSE
        before = self.history[-1] if self.history else None
        self._push(t_ns, not fits, level, R)
        if fits:
            if not self.open:
                self.calm = len(self.history) == HISTORY and not any(h[1] for h in self.history)
                return Action.USE
            return Action.OFFSET
        self.calm = False
        if self.open and fits_zero:
            return Action.CONSUMED
        if follow and before and before[1] and self._agree(t_ns, level, R, Pv, (before[0], *before[2:]), limit):
            self.history = []
            return Action.FOLLOW
        agreeing = [h for h in self.history if h[1] and self._agree(t_ns, level, R, Pv, (h[0], h[2], h[3]), limit)]
        if len(agreeing) >= AGREE:
            n = len(agreeing)
            mean = (
                sum(h[2][0] for h in agreeing) / n,
                sum(h[2][1] for h in agreeing) / n,
                sum(h[2][2] for h in agreeing) / n,
            )
            self.quick = self.quick + 1 if self.open and t_ns - self.open_ns < lockout_ns else 0
            if self.quick >= 2:
                # Level after level after level: the prediction runs away, not the receiver.
                self.forget()
                return Action.REACQUIRE
            return self._open(t_ns, mean)
        if since_used_ns > lockout_ns and len(self.history) >= AGREE:
            self.forget()
            return Action.REACQUIRE
        return Action.SKIP

    def _open(self, t_ns: int, level: Three) -> Action:
        action = Action.REOPEN if self.open else Action.OPEN
        if not self.open:
            self.begin_ns = t_ns
        self.open = True
        self.open_ns = t_ns
        self.fits_zero = 0
        self.ratio = 0.0
        self.history = []
        self.level = level
        self.calm = False
        return action

    def forget(self) -> None:
        """Close without a word and forget the levels seen."""
        self.open = False
        self.quick = 0
        self.fits_zero = 0
        self.ratio = 0.0
        self.history = []

    def _push(self, t_ns: int, refused: bool, level: Three, R: Three) -> None:
        self.history.append((t_ns, refused, level, R))
        if len(self.history) > HISTORY:
            del self.history[0]

    @staticmethod
    def _agree(t_ns: int, a: Three, ra: Three, pv: Three, b: tuple[int, Three, Three], limit: float) -> bool:
        """Two levels differ by no more than their noise and the prediction's drift between them allow."""
        dt = (t_ns - b[0]) * 1e-9
        s = 0.0
        for i in range(3):
            d = a[i] - b[1][i]
            s += d * d / (ra[i] + b[2][i] + pv[i] * dt * dt)
        return s <= limit

    def save(self) -> State:
        return {
            "open": self.open, "quick": self.quick, "open_ns": self.open_ns, "begin_ns": self.begin_ns,
            "history": [[h[0], h[1], list(h[2]), list(h[3])] for h in self.history],
            "fits_zero": self.fits_zero, "ratio": self.ratio, "confirm": self.confirm, "confirm_ns": self.confirm_ns,
            "waiting": [[w[0], list(w[1]), list(w[2])] for w in self.waiting],
            "level": list(self.level), "calm": self.calm,
        }  # fmt: skip

    def load(self, s: State) -> None:
        self.open, self.quick = s["open"], s["quick"]
        self.open_ns, self.begin_ns = s["open_ns"], s["begin_ns"]
        self.history = [(t, r, _three(a), _three(b)) for t, r, a, b in s["history"]]
        self.fits_zero, self.ratio = s["fits_zero"], s["ratio"]
        self.confirm, self.confirm_ns = s["confirm"], s["confirm_ns"]
        self.waiting = [(t, _three(a), _three(b)) for t, a, b in s["waiting"]]
        self.level, self.calm = _three(s["level"]), s["calm"]


def _three(v: list[float]) -> Three:
    return (v[0], v[1], v[2])
