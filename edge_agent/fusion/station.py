"""Policy: which fix meets which accelerations when, and what is published meanwhile. All points stacked.

The state lives at the last fix (the anchor); accelerations up to now are integrals from there, so a fix is applied at
its measurement time however late it comes, without rewinding anything:

    d(t) = d + v D + S2 - b D^2 / 2        v(t) = v + S1 - b D          D = t - anchor

A fix waits for accelerations up to its time, at most `wait_s` of raw time; then the gap rule bridges what is missing
(mean of the last 10 s, extra noise q_gap = 2 var(a) tau with tau the reciprocal mean frequency). One receiver on one
wire delivers in order, so a fix not newer than the anchor, or older than the accelerations kept, is OLD: reported,
dropped.

Kinds of points. *Both sensors*: as above. *No accelerometer* (or one that is silent for `accel_lost_s`): the same
filter with zero integrals, where -b is the acceleration and its walk the model; one estimate per fix, mode GNSS_ONLY.
Of one that fell silent the last 10 s say how much motion to expect at least, as across a gap. *No receiver*: there is
no absolute displacement; displacement is held about zero by one pseudo-measurement a second with sd
`accel_only_std_m`, so vibration above some 0.05 Hz is right and the quasi-static part is not there; mode ACCEL_ONLY.

A sample's estimate uses every fix that was handed over before it and is not later than it, so it does not depend on how
the accelerations were cut into blocks. Samples with a NaN axis are left out (a missing sample). Nothing is emitted
before the start.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

import numpy as np

from edge_agent.fusion import kalman, live
from edge_agent.fusion.feed import Feed
from edge_agent.fusion.gate import Action, Gate, Three, quantile
from edge_agent.fusion.integrals import CHUNK, NS, SYNTHETIC, block
from edge_agent.fusion.model import B, D, N, O, V, gap_noise, process_noise, transition
from edge_agent.fusion.noise import CHI1_MEDIAN, Bank, Monitor, robust_mask, third_difference_std
from edge_agent.fusion.point import Point, Wait
from edge_agent.messages import (
    F64,
    I64,
    STUCK_SAMPLES,
    U8,
    AccelBlock,
    Estimate,
    Event,
    FusionFlag,
    FusionSettings,
    Innovation,
    Measurement,
    Mode,
    PointSettings,
    Quality,
    S,
    State,
    Verdict,
)

Out: TypeAlias = list[Estimate | Innovation | Event]

SOLID = (
    Quality.FIXED,
    Quality.PPS,
    Quality.MANUAL,
    Quality.SIMULATED,
    Quality.DGNSS,
    Quality.SINGLE,
    Quality.ESTIMATED,
)
"""Qualities whose declared sd is taken as it is; FLOAT wanders and has its own model."""
START_QUALITY = (Quality.FIXED, Quality.MANUAL, Quality.SIMULATED)
REBASE_NS = 30 * S
"""Integrals start anew at a fix at least so often: they stay below a few hundred metres."""
PSEUDO_NS = S
BLOW = 8.0
"""Bending of the accelerations beyond so many times the usual, of the interval and 0.1 s more, is a blow."""
DOUBT = 4.0
"""A value that stays is off by the motion and by where in it it stopped: twice the variance of the accelerations; twice
that, for the motion may have been growing."""
KNOWN = 4.0
"""Noise figures known from before the silence or the reboot: half the decades, for it is hardly ever another sensor."""
FOLLOW = 4.0
"""Without accelerations, two fixes in a row that agree and are not further away than twice the gate are motion."""
BEND_S = 60.0
"""Over which the usual bending is averaged."""
START_FIXES = 2000
"""Fixes of a start window at most, 15 s at more than 100 Hz: a full one is enough, however long `start_s`."""
PENDING = 256
"""Fixes that wait for accelerations at most; the oldest is applied without them."""
FUSED, ACCEL_ONLY = int(Mode.FUSED), int(Mode.ACCEL_ONLY)
FLOAT, JUMP_OPEN = int(FusionFlag.FLOAT), int(FusionFlag.JUMP_OPEN)
UNCERTAIN = int(FusionFlag.TIME_UNCERTAIN)
Piece: TypeAlias = tuple[I64, F64, U8]
"""t (n,); displacement, velocity and their sd (12, n); mode and flags (2, n)."""


class Station:
    """All points of a site. `unset` names receivers whose reference is provisional: the start window's median becomes
    their zero (`datum`)."""

    def __init__(
        self, points: Sequence[PointSettings], settings: FusionSettings, unset: frozenset[str] = frozenset()
    ) -> None:
        by_receiver: dict[str | None, list[PointSettings]] = {}
        for s in points:
            by_receiver.setdefault(s.receiver, []).append(s)
        self.settings = settings
        self.points = [Point(s) for group in by_receiver.values() for s in group]
        self.of_receiver: dict[str, list[int]] = {}
        for i, p in enumerate(self.points):
            if p.receiver is not None:
                self.of_receiver.setdefault(p.receiver, []).append(i)
        n = len(self.points)
        self.feed = Feed(self.points, settings)
        self.ring = self.feed.ring
        self.bank = Bank(n)
        self.monitor = Monitor(n)
        self.x: F64 = np.zeros((N, n, 3))
        self.C: F64 = np.zeros((N, N, n, 3))
        self.g: F64 = np.zeros((n, 6))  # integrals (g2, g1) at the anchor
        self.bent: F64 = np.zeros((n, 3))  # the ring's sum at the anchor
        self.bend_rate: F64 = np.zeros((n, 3))  # its usual rate [m2/s3]
        self.q: F64 = np.full((n, 3), settings.accel_noise_m2ps3)
        self.qb: F64 = np.full((n, 3), settings.bias_walk_m2ps5)
        self.q_least: F64 = np.zeros((n, 3))  # of a point that lost its accelerations
        self.scale: F64 = np.ones((n, 3))  # on the declared R
        self.bank_s1: F64 = np.zeros((n, 3))  # increments since the bank's last fix
        self.bank_s2: F64 = np.zeros((n, 3))
        self.known: list[State | None] = [None] * n  # adopted from an earlier run: centres of the priors
        self.unset = set(unset)
        self.datums: dict[str, F64] = {}
        self.quiet_ns = int(min(settings.coast_s, settings.invalid_outage_s) * S)
        self.limit = quantile(settings.gate_alpha, 3)
        self.old = 0
        self.prechecked = 0

    # ------------------------------------------------------------------------------------------------------ interface

    def accelerations(self, blocks: Mapping[str, AccelBlock], now_ns: int) -> Out:
        """Take blocks by accelerometer; returns what waiting fixes and the samples themselves cause."""
        out: Out = []
        pieces: dict[int, list[Piece]] = {}
        lo = 0
        more = True
        while more:
            points, events, more = self.feed.take(blocks, lo)
            lo += CHUNK
            out += events
            while self.feed.doubted:
                self._doubt(self.feed.doubted.pop(), out)
            if points:
                self._settle(points, now_ns, out, pieces)
                self._emit(points, None, pieces, out)
        if pieces:
            slow = self._slow()
            for p, parts in pieces.items():
                out.append(self._estimate(p, parts, slow))
        return out

    def fix(self, receiver: str, fix: Measurement, now_ns: int) -> Out:
        """Take one fix of a receiver."""
        out: Out = []
        points = self.of_receiver.get(receiver, [])
        finite = all(map(math.isfinite, fix.z_m)) and all(math.isfinite(v) and v > 0 for v in fix.std_m)
        if not finite or fix.quality == Quality.NONE:
            self.prechecked += 1
            for p in points:
                out.append(self._verdict(p, fix, Verdict.PRECHECK))
            return out
        deadline = now_ns + int(self.settings.wait_s * S)
        for p in points:
            self.points[p].pending.append(Wait(fix, deadline))
        self._settle(points, now_ns, out, None)
        return out

    def advance(self, now_ns: int) -> Out:
        """Raw time has come to `now_ns`: fixes whose wait is over are applied without their last accelerations."""
        out: Out = []
        waiting = [i for i, p in enumerate(self.points) if p.pending]
        if waiting:
            self._settle(waiting, now_ns, out, None)
        return out

    def datum(self, receiver: str) -> Three | None:
        """Median of the start window in structure axes [m] about the provisional reference, once it is known."""
        z = self.datums.get(receiver)
        return None if z is None else (float(z[0]), float(z[1]), float(z[2]))

    def fix_datum(self, receiver: str) -> None:
        """The receiver's reference is known after all: its zero stays where it is."""
        self.unset.discard(receiver)

    def _doubt(self, p: int, out: Out) -> None:
        """An axis has been stuck for some samples before it was noticed: what they did to the state is as unknown as
        the accelerations of that time, and a level that fixes seemed to have since is no level."""
        pt = self.points[p]
        last = self.ring.last_ns[p]
        _, a = self.ring.recent(p, last, self.settings.accel_mean_s)
        if not (pt.started and pt.aided) or len(a) < 8:
            return
        e = a - a.sum(axis=0) * (1.0 / len(a))
        T = STUCK_SAMPLES * pt.nominal_ns * NS
        v = (e * e).sum(axis=0) * (DOUBT / len(a) * T * T)
        C = self.C[:, :, p]
        C[V, V] += v
        C[D, V] += v * (0.5 * T)
        C[V, D] += v * (0.5 * T)
        C[D, D] += v * (T * T / 3.0)
        if pt.gate.open and pt.gate.begin_ns >= last - STUCK_SAMPLES * pt.nominal_ns:
            text = "the accelerometer was stuck: the fixes were right"
            out.append(Event(last, "JUMP_CLOSED", pt.name, text, (), pt.gate.begin_ns, last))
            pt.gate.forget()
            self.x[O, p] = 0.0
            C[O] = 0.0
            C[:, O] = 0.0
        self.bank.fresh[p] = True

    # ----------------------------------------------------------------------------------------------- fixes meet samples

    def _ready(self, p: int, w: Wait, now_ns: int) -> bool:
        pt = self.points[p]
        if pt.accelerometer is None:
            return True
        last = self.ring.last_ns[p]
        if last >= w.fix.t_ns or last < 0:
            return True
        if w.fix.t_ns - last > int(self.settings.accel_absent_s * S):
            return True
        return now_ns >= w.deadline_ns or len(pt.pending) > PENDING

    def _settle(self, points: Iterable[int], now_ns: int, out: Out, pieces: dict[int, list[Piece]] | None) -> None:
        """Apply every waiting fix that is ready, points of one receiver together."""
        points = list(points)
        for p in points:
            if self.points[p].receiver is None:
                self._pseudo(p)
        while True:
            ready = [p for p in points if self.points[p].pending and self._ready(p, self.points[p].pending[0], now_ns)]
            if not ready:
                return
            first = self.points[ready[0]].pending[0].fix
            group = [p for p in ready if self.points[p].pending[0].fix == first]
            for p in group:
                del self.points[p].pending[0]
            if pieces is not None:
                cut = [self.ring.row(p, first.t_ns) for p in group]
                self._emit(group, cut, pieces, out)
            self._apply(group, first, out)

    def _pseudo(self, p: int) -> None:
        """Points without receiver: one pseudo-measurement of zero at every whole second of monotonic time."""
        pt = self.points[p]
        last = self.ring.last_ns[p]
        begin = pt.pending[-1].fix.t_ns if pt.pending else max(pt.anchor_ns, self.ring.first_ns[p])
        t = (begin // PSEUDO_NS + 1) * PSEUDO_NS
        if last - t > 600 * PSEUDO_NS:
            t = (last // PSEUDO_NS) * PSEUDO_NS
        std = self.settings.accel_only_std_m
        while t <= last:
            pt.pending.append(Wait(Measurement(t, t, (0.0, 0.0, 0.0), (std, std, std), Quality.FIXED), t))
            t += PSEUDO_NS

    def _verdict(self, p: int, fix: Measurement, verdict: Verdict) -> Innovation:
        """A fix that met no gate: residual and offset are zero, the variance is its own."""
        R = [s * s if math.isfinite(s) else 0.0 for s in fix.std_m]
        return Innovation(
            self.points[p].name, fix.t_ns, np.zeros(3), np.diag(R), 0.0, verdict, fix.arrival_ns - fix.t_ns,
            np.array(fix.std_m), np.zeros(3),
        )  # fmt: skip

    def _apply(self, group: list[int], fix: Measurement, out: Out) -> None:
        """One fix to points whose accelerations are there (or will not come)."""
        live: list[int] = []
        for p in group:
            pt = self.points[p]
            late = pt.aided and fix.t_ns <= self.ring.last_ns[p] and not self.ring.covers(p, fix.t_ns)
            if late or ((pt.started or pt.window) and fix.t_ns <= pt.anchor_ns):
                self.old += 1
                out.append(self._verdict(p, fix, Verdict.OLD))
            elif not pt.started:
                self._window(p, fix, out)
            else:
                live.append(p)
        if live:
            self._step(live, fix, out)

    def _increments(self, points: list[int], t_ns: int, dt: F64) -> tuple[F64, F64, F64]:
        """Integrals (s1, s2) and the sums of `bend` (P', 3) from the anchors to t; their integrals move to t, their
        time does not. dt (P', 1) s."""
        k = block(points)
        g, bent = self.ring.anchor(points, t_ns)
        old, before = self.g[k], self.bent[k]
        s = g - old
        s2 = s[:, :3] - old[:, 3:] * dt
        bend = bent - before
        self.g[k], self.bent[k] = g, bent
        return s[:, 3:], s2, bend

    def _place(self, p: int, t_ns: int) -> None:
        """The anchor's integrals, without an increment."""
        i, _, self.g[p] = self.ring.at(p, t_ns)
        self.bent[p] = self.ring.bent[p, i]

    def _rebase(self, p: int, t_ns: int) -> None:
        if t_ns - self.ring.origin_ns[p] >= REBASE_NS:
            self.ring.rebase(p, t_ns)
            self.g[p] = 0.0
            self.bent[p] = 0.0

    # ---------------------------------------------------------------------------------------------------------- start

    def _zero(self, p: int) -> F64:
        z = self.datums.get(self.points[p].receiver or "")
        return np.zeros(3) if z is None else z

    def _window(self, p: int, fix: Measurement, out: Out) -> None:
        """Collect the start window; begin when it is long enough."""
        pt = self.points[p]
        s = self.settings
        if pt.receiver is None:
            self._start_accel_only(p, fix, out)
            return
        if fix.quality not in START_QUALITY:
            out.append(self._verdict(p, fix, Verdict.PRECHECK))
            return
        aided = self.ring.covers(p, fix.t_ns)
        pt.uncertain = fix.time_uncertain
        broken = pt.window and (aided != pt.window_aided or fix.t_ns - pt.anchor_ns > int(s.outage_s * S))
        zero = np.zeros(3)
        if broken or not pt.window:
            pt.window = []
            pt.gaps = []
            pt.window_aided = aided
            if aided:
                self._place(p, fix.t_ns)
            s1 = s2 = zero
        else:
            dt = (fix.t_ns - pt.anchor_ns) * NS
            s1 = s2 = bent = zero
            if aided:
                s1, s2, bent = (v[0] for v in self._increments([p], fix.t_ns, np.array([[dt]])))
            self.bend_rate[p] += (bent / dt - self.bend_rate[p]) * (1.0 / len(pt.window))
        pt.anchor_ns = fix.t_ns
        if aided:
            self._rebase(p, fix.t_ns)
        pt.window.append((fix.t_ns, s1, s2, np.array(fix.z_m), np.array(fix.std_m)))
        out.append(self._verdict(p, fix, Verdict.START))
        n = len(pt.window)
        if n == START_FIXES or (fix.t_ns - pt.window[0][0] >= int(s.start_s * S) - S // 20 and n >= 8):
            self._start(p, out)

    def _start(self, p: int, out: Out) -> None:
        pt = self.points[p]
        s = self.settings
        t_ns = np.array([w[0] for w in pt.window])
        z = np.stack([w[3] for w in pt.window])
        std = np.stack([w[4] for w in pt.window])
        receiver = pt.receiver or ""
        if receiver in self.unset:
            self.unset.discard(receiver)
            middle = np.sort(z, axis=0)
            n = len(z)
            zero = 0.5 * (middle[(n - 1) // 2] + middle[n // 2])
            self.datums[receiver] = zero
            values = tuple((k, float(v)) for k, v in zip(("x_m", "y_m", "z_m"), zero, strict=True))
            text = "reference is the median of the start window: displacement counts from here"
            out.append(Event(int(t_ns[-1]), "REFERENCE", receiver, text, values, int(t_ns[0]), int(t_ns[-1])))
        z = z - self._zero(p)
        t = (t_ns - t_ns[0]) * NS
        dt = np.diff(t)
        J = np.zeros_like(z)
        speed = np.zeros(3)
        for i in range(1, len(z)):
            J[i] = J[i - 1] + speed * dt[i - 1] + pt.window[i][2]
            speed = speed + pt.window[i][1]
        w = z - J
        mask = robust_mask(t, w)
        good = [i for i, v in enumerate(mask) if v]
        declared = np.sort(std, axis=0)[len(std) // 2]
        noise = third_difference_std(w[good])
        known = self.known[p]
        R0 = declared * declared
        if known is not None:
            self.scale[p] = known["scale"]
        else:
            ratio = np.array([v * v for v in noise]) / R0
            self.scale[p] = np.clip(ratio, s.r_least, s.r_most)
        bank = self.bank
        bank.forget(p)
        bank.reset(p, z[good[0]], np.zeros(3), np.zeros(3))
        k = [p]
        one = np.ones(1)
        bank.update(k, z[good[0]][None], one)
        for i in range(good[0] + 1, len(z)):
            bank.predict(k, dt[i - 1 : i], pt.window[i][1][None], pt.window[i][2][None])
            if mask[i]:
                bank.update(k, z[i][None], one)
            if i % 25 == 0:
                bank.fold(p)
        pt.started = True
        pt.aided = pt.window_aided
        pt.begun_ns = pt.anchor_ns = int(t_ns[-1])
        pt.used_ns = pt.anchor_ns
        pt.window = []
        pt.gaps = []
        R = R0 * self.scale[p]
        best = self._noise(p, R, 1e9)
        m = best if best else [0, 0, 0]
        self.C[:, :, p] = 0.0
        for axis in range(3):
            dd, dv, db, vv, vb, bb = (float(v) * float(R[axis]) for v in bank.C[:, m[axis], p])
            self.x[:3, p, axis] = bank.x[:, m[axis], p, axis]
            rows = ((dd, dv, db), (dv, vv, vb), (db, vb, bb))
            for i in range(3):
                for j in range(3):
                    self.C[i, j, p, axis] = rows[i][j]
        self.x[O, p] = 0.0
        pt.fixes = len(good)
        pt.gate = Gate()
        pt.posterior_ns = pt.anchor_ns
        pt.since_bank = 0.0
        self.bank_s1[p] = 0.0
        self.bank_s2[p] = 0.0
        values = tuple(
            (f"{n}_{a}", float(v[i]))
            for n, v in (("noise_std_m", np.sqrt(R)), ("q_m2ps3", self.q[p]), ("qb_m2ps5", self.qb[p]))
            for i, a in enumerate("xyz")
        )
        how = "with accelerations" if pt.aided else "without accelerations"
        text = f"fusion starts {how} from {len(good)} of {len(z)} fixes"
        out.append(Event(pt.anchor_ns, "START", pt.name, text, values, int(t_ns[0]), pt.anchor_ns))

    def _start_accel_only(self, p: int, fix: Measurement, out: Out) -> None:
        pt = self.points[p]
        if fix.t_ns - self.ring.first_ns[p] < int(self.settings.accel_settle_s * S):
            pt.anchor_ns = fix.t_ns
            return
        _, a = self.ring.recent(p, fix.t_ns, self.settings.accel_settle_s)
        if len(a) < 8:  # silent again before it began
            pt.anchor_ns = fix.t_ns
            return
        self.x[:, p] = 0.0
        self.x[B, p] = a.sum(axis=0) * (1.0 / len(a))
        self.C[:, :, p] = 0.0
        self.C[D, D, p] = self.settings.accel_only_std_m**2
        self.C[V, V, p] = 0.05**2
        self.C[B, B, p] = 0.05**2
        self._place(p, fix.t_ns)
        pt.started = pt.aided = True
        pt.anchor_ns = pt.used_ns = pt.begun_ns = fix.t_ns
        pt.gaps = []
        text = "vibration starts without a receiver: displacement is about zero, not absolute"
        out.append(Event(fix.t_ns, "START", pt.name, text))

    # ------------------------------------------------------------------------------------------------------------ step

    def _step(self, points: list[int], fix: Measurement, out: Out) -> None:
        """Predict to the fix, judge, update, learn; the anchor moves to the fix."""
        t = fix.t_ns
        n = len(points)
        seconds: list[float] = []
        aided: list[int] = []  # places in `points`
        calm = fix.quality in SOLID
        for i, p in enumerate(points):
            pt = self.points[p]
            if pt.aided:
                self._bridge(p, t, out)
            seconds.append((t - pt.anchor_ns) * NS)
            if pt.aided:
                aided.append(i)
            calm = calm and pt.gate.calm and not pt.floating and t - pt.used_ns <= 5 * S
        dt = np.array(seconds)[:, None]
        if len(aided) == n:
            s1, s2, bent = self._increments(points, t, dt)
        else:
            s1, s2, bent = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
            if aided:
                s1[aided], s2[aided], bent[aided] = self._increments([points[i] for i in aided], t, dt[aided])
        k = block(points)
        same = seconds[:1] if seconds.count(seconds[0]) == n else seconds
        Qa, Qb = process_noise(same)
        x, C = kalman.predict(self.x[:, k], self.C[:, :, k], transition(same), Qa, Qb, s1, s2, self.q[k], self.qb[k])
        self._blows(points, k, C, bent, dt)
        for i, p in enumerate(points):
            if self.points[p].gaps and self.points[p].aided:
                self._gap_variance(self.points[p], t, C[:, :, i])
        z = np.array(fix.z_m) - self._zero(points[0])
        R0 = np.array(fix.std_m)
        R0 *= R0
        R = R0 * self.scale[k]
        pseudo = self.points[points[0]].receiver is None
        nu, CH, S_ = kalman.innovation(x, C, z, R)
        ratio = self._ratio(nu, S_)
        if pseudo and max(ratio) > 1.0:
            # Far from zero, where no structure vibrates: the bias has moved. The state follows, and its sd says so.
            away = nu * nu * (nu * nu > 9.0 * S_)
            C[D, D] += away
            C[V, V] += away
            C[B, B] += 4.0 * away
            nu, CH, S_ = kalman.innovation(x, C, z, R)
            ratio = self._ratio(nu, S_)
        use: F64 | float = 1.0
        used = [True] * n
        verdicts = [Verdict.ACCEPTED] * n
        learn = [True] * n
        if not pseudo and not (calm and max(ratio) <= 1.0):
            for i, p in enumerate(points):
                verdicts[i], learn[i] = self._judge(p, fix, z, x[:, i], C[:, :, i], R[i], seconds[i], out)
                used[i] = verdicts[i] in (Verdict.ACCEPTED, Verdict.OFFSET)
            use = np.array(used, dtype=np.float64)[:, None]
            nu, CH, S_ = kalman.innovation(x, C, z, R)
            ratio = self._ratio(nu, S_)
        x, C = kalman.update(x, C, nu, CH, S_, R, use)
        self.x[:, k] = x
        self.C[:, :, k] = C
        std = np.sqrt(R)
        full = np.zeros((n, 3, 3))
        full.reshape(n, 9)[:, ::4] = S_
        offset = x[O].copy()
        late = fix.arrival_ns - t
        for i, p in enumerate(points):
            pt = self.points[p]
            if not pseudo:
                out.append(Innovation(pt.name, t, nu[i], full[i], ratio[i], verdicts[i], late, std[i], offset[i]))
            pt.anchor_ns = t
            pt.uncertain = fix.time_uncertain
            if used[i]:
                pt.used_ns = t
            if pt.aided:
                self._rebase(p, t)
        if not pseudo:
            if fix.quality in SOLID:
                self._contradiction(points, fix, seconds, z, R, nu, S_, out)
            self._learn_noise(points, k, z, R0, nu, S_, seconds, s1, s2, learn)
        for p in points:
            pt = self.points[p]
            if not pt.aided and pt.accelerometer is not None:
                self._resume(p, out)
            bridged = pt.hold is not None and self.ring.last_ns[p] <= t
            if not pseudo and (bridged or not pt.aided):
                out.append(self._single(p, t, out))
            pt.gaps = [g for g in pt.gaps if g.end_ns > t]

    def _ratio(self, nu: F64, S_: F64) -> list[float]:
        e = nu * nu
        e /= S_
        return [(a + b + c) / self.limit for a, b, c in e.tolist()]

    def _blows(self, points: list[int], k: slice | list[int], C: F64, bent: F64, dt: F64) -> None:
        """Velocity that the sampling may have missed: where the accelerations bend far more than usual (a blow, an
        impact), a hold across an interval is wrong by 1/12 of what `integrals.bend` sums. White over the interval."""
        usual = self.bend_rate[k]
        extra = bent - BLOW * usual * (dt + 0.1)
        if float(extra.max()) > 0.0:
            e = np.maximum(extra, 0.0) * (1 / 144)
            strong: F64 = (e - 10.0 * self.q[k] * dt).max(axis=1)
            for i, v in enumerate(strong.tolist()):
                if v > 0.0:
                    self.bank.fresh[points[i]] = True  # no evidence on q
            C[V, V] += e
            c = e * dt * 0.5
            C[D, V] += c
            C[V, D] += c
            C[D, D] += c * dt * (2 / 3)
        self.bend_rate[k] = usual + (np.minimum(bent / dt, 4.0 * usual + 1e-15) - usual) * np.minimum(dt / BEND_S, 0.5)

    def _gap_variance(self, pt: Point, t_ns: int, C: F64) -> None:
        for g in pt.gaps:
            begin = max(g.begin_ns, pt.anchor_ns)
            end = min(g.end_ns, t_ns)
            if end > begin:
                dd, dv, vv = gap_noise((end - begin) * NS, (t_ns - end) * NS, g.q)
                C[D, D] += dd
                C[D, V] += dv
                C[V, D] += dv
                C[V, V] += vv

    def _bridge(self, p: int, t_ns: int, out: Out) -> None:
        """Accelerations that are missing up to a fix at t are bridged, or given up."""
        pt = self.points[p]
        s = self.settings
        last = self.ring.last_ns[p]
        if last >= t_ns:
            return
        begin = last if pt.hold is None else pt.hold.begin_ns
        if t_ns - begin <= int(s.accel_lost_s * S) or pt.receiver is None:
            self.feed.bridge(p, t_ns)
            return
        # The structure goes on as it was seen to vibrate. Fixes alone do not tell vibration from their own noise and
        # would call it noise, so they may only find more of it.
        self.q_least[p] = self.feed.across(p)[1]
        if begin - pt.begun_ns > int(2 * s.bank_full_s * S):
            self.known[p] = self._figures(p)
        q = np.maximum(self.q_least[p], s.gnss_only_q_m2ps3)
        self._change_model(p, np.zeros(3), np.full(3, 0.05**2), q, s.gnss_only_qb_m2ps5)
        pt.aided = False
        pt.run_ns = -1
        pt.hold = None
        seconds = (t_ns - begin) / S
        text = f"no accelerations for {seconds:.0f} s: going on without"
        out.append(Event(t_ns, "ACCEL_LOST", pt.name, text, (("silent_s", seconds),), begin, t_ns))

    def _resume(self, p: int, out: Out) -> None:
        """Accelerations that have come steadily for a while drive the prediction from the anchor on."""
        pt = self.points[p]
        s = self.settings
        t_ns = pt.anchor_ns
        if pt.run_ns < 0 or t_ns - pt.run_ns < int(s.accel_settle_s * S) or not self.ring.covers(p, t_ns):
            return
        usual = self.feed.vibration(p, t_ns, s.accel_settle_s)
        if usual is None:
            return
        mean, var, tau = usual
        q, qb = s.accel_noise_m2ps3, s.bias_walk_m2ps5
        known = self.known[p]
        if known is not None and bool(known["aided"]):
            q, qb = known["q"], known["qb"]
        self._change_model(p, mean, var + 0.05**2, q, qb)
        # The velocity of a vibration that fixes alone may have taken for noise.
        self.C[V, V, p] += 4.0 * var * tau * tau
        self.q_least[p] = 0.0
        pt.aided = True
        self._place(p, t_ns)
        self._rebase(p, t_ns)
        out.append(Event(t_ns, "ACCEL_ON", pt.name, "accelerations are there: fusion goes on with them"))

    def _change_model(self, p: int, b: F64, var: F64, q: F64 | float, qb: F64 | float) -> None:
        pt = self.points[p]
        self.x[B, p] = b
        self.C[B, :, p] = 0.0
        self.C[:, B, p] = 0.0
        self.C[B, B, p] = var
        self.q[p] = q
        self.qb[p] = qb
        self.bank.forget(p)
        self.monitor.forget(p)
        pt.begun_ns = pt.posterior_ns = pt.anchor_ns
        pt.fixes = 0

    # ------------------------------------------------------------------------------------------------------------ gate

    def _judge(
        self, p: int, fix: Measurement, z: F64, x: F64, C: F64, R: F64, dt: float, out: Out
    ) -> tuple[Verdict, bool]:
        """Verdict for one point and whether its noise may learn from it; x, C (N, [N,] 3) and R (3,) in place."""
        pt = self.points[p]
        s = self.settings
        t = fix.t_ns
        gate = pt.gate
        if fix.quality not in SOLID:
            return self._judge_float(p, fix, z, x, C, R, dt, out), False
        need = t - pt.used_ns > int(s.outage_s * S) and bool((C[D, D] > 25.0 * R).any()) and not gate.open
        if pt.floating and not gate.confirm:
            need = True
            x[O] = 0.0
            C[O] = 0.0
            C[:, O] = 0.0
            gate.forget()
        dd = C[D, D] + R
        level = z - x[D]
        nu = level - x[O]
        S1 = dd + C[D, O] + C[O, D] + C[O, O]
        chi = (nu * nu / S1).tolist()
        chi0 = (level * level / dd).tolist()
        fits = sum(chi) <= self.limit
        fits_zero = sum(chi0) <= self.limit
        evidence = 0.0
        if gate.open:
            logs = sum(math.log(a / b) for a, b in zip(S1.tolist(), dd.tolist(), strict=True))
            evidence = 0.5 * (sum(chi) + logs - sum(chi0))
        # Without accelerations a sudden motion looks like a small jump.
        follow = (bool(pt.gaps) or not pt.aided) and sum(chi) <= FOLLOW * self.limit
        action = gate.judge(
            t, fits, fits_zero, evidence, _three(level), _three(R), _three(C[V, V]), self.limit, need,
            t - pt.used_ns, int(s.reacquire_s * S), int(s.lockout_s * S), follow,
        )  # fmt: skip
        if action == Action.USE:
            return Verdict.ACCEPTED, True
        if action in (Action.SKIP, Action.CONFIRM, Action.CONSUMED):
            if action == Action.CONFIRM:
                self.bank.fresh[p] = True
            return Verdict.REJECTED, False
        if action == Action.OFFSET:
            return Verdict.OFFSET, False
        self.bank.fresh[p] = True
        if action == Action.FOLLOW:
            C[D, D] += nu * nu
            C[V, V] += nu * nu * (1.0 / (dt * dt))
            return Verdict.OFFSET if gate.open else Verdict.ACCEPTED, False
        values = tuple((f"offset_{a}_m", float(v)) for a, v in zip("xyz", gate.level, strict=True))
        was_floating = pt.floating
        if was_floating:
            pt.floating = False
            out.append(Event(t, "FLOAT_END", pt.name, "fixed solution again: three epochs agree"))
        if action == Action.REACQUIRE:
            values = tuple((f"step_{a}_m", float(v)) for a, v in zip("xyz", z - x[D], strict=True))
            x[D] = z
            x[O] = 0.0
            bias = C[B, B] + 0.1**2
            C[:] = 0.0
            C[D, D] = 4.0 * R
            C[V, V] = 1.0
            C[B, B] = bias
            x[V] = 0.0
            # So tight a model was wrong: wide again, and nothing of what it seemed to know.
            self.q[p] = np.minimum(self.q[p] * 30.0, 0.1)
            self.qb[p] = np.minimum(self.qb[p] * 30.0, 0.1)
            self.bank.forget(p)
            pt.fixes = 0
            text = "refused fixes agree on nothing: the filter begins anew at this one"
            out.append(Event(t, "REACQUIRE", pt.name, text, values, pt.used_ns, t))
            return Verdict.ACCEPTED, False
        if action in (Action.OPEN, Action.REOPEN):
            x[O] = np.array(gate.level)
            C[O] = 0.0
            C[:, O] = 0.0
            C[O, O] = 1.0
            if action == Action.OPEN:
                text = "fixes agree on another level: fusion goes on with z - o"
                out.append(Event(t, "JUMP_OPEN", pt.name, text, values))
            else:
                out.append(Event(t, "JUMP_LEVEL", pt.name, "fixes agree on a new level", values))
            return Verdict.OFFSET, False
        if action == Action.CLOSE:
            values = tuple((f"offset_{a}_m", float(v)) for a, v in zip("xyz", x[O], strict=True))
            x[O] = 0.0
            C[O] = 0.0
            C[:, O] = 0.0
            out.append(Event(t, "JUMP_CLOSED", pt.name, "fixes are back at the old level", values, gate.begin_ns, t))
            return Verdict.ACCEPTED, False
        if action == Action.DATUM:
            values = tuple((f"offset_{a}_m", float(v)) for a, v in zip("xyz", x[O], strict=True))
            x[D] += x[O]
            C[D] += C[O]
            C[:, D] += C[:, O]
            x[O] = 0.0
            C[O] = 0.0
            C[:, O] = 0.0
            text = f"the level held for {s.reacquire_s:.0f} s: displacement takes it over"
            out.append(Event(t, "DATUM", pt.name, text, values, gate.begin_ns, t))
            return Verdict.ACCEPTED, False
        seconds = (t - pt.used_ns) / S  # RESUME
        if not was_floating:
            out.append(Event(t, "OUTAGE_END", pt.name, f"fixes agree again after {seconds:.1f} s", (), pt.used_ns, t))
        if bool((C[D, D] > 1.0).any()):
            # So wide a prediction knows nothing of d; keep the digits and the bias.
            x[D] = z
            C[D] = 0.0
            C[:, D] = 0.0
            C[D, D] = 1.0
            x[V] = np.where(C[V, V] > 1.0, 0.0, x[V])
            C[V, B] = 0.0
            C[B, V] = 0.0
            C[V, V] = np.minimum(C[V, V], 1.0)
            C[B, B] = np.minimum(C[B, B], 1.0)
        return Verdict.ACCEPTED, False

    def _judge_float(self, p: int, fix: Measurement, z: F64, x: F64, C: F64, R: F64, dt: float, out: Out) -> Verdict:
        pt = self.points[p]
        s = self.settings
        self.bank.fresh[p] = True
        pt.gate.calm = False
        pt.gate.confirm = False
        R *= s.float_r_factor
        if not pt.floating:
            # A level found before says nothing about the float solution's.
            pt.floating = True
            pt.gate.forget()
            x[O] = 0.0
            C[O] = 0.0
            C[:, O] = 0.0
            C[O, O] = s.float_std_m**2
            out.append(Event(fix.t_ns, "FLOAT_BEGIN", pt.name, "float solution: its wander is estimated beside"))
        else:
            phi = math.exp(-dt / s.float_tau_s)
            x[O] *= phi
            C[O] *= phi
            C[:, O] *= phi
            C[O, O] += (1.0 - phi * phi) * s.float_std_m**2
        nu = z - x[D] - x[O]
        S1 = C[D, D] + C[D, O] + C[O, D] + C[O, O] + R
        if float((nu * nu / S1).sum()) <= self.limit:
            return Verdict.OFFSET
        if fix.t_ns - pt.used_ns > int(s.lockout_s * S):
            x[O] = z - x[D]
            C[O] = 0.0
            C[:, O] = 0.0
            C[O, O] = 1.0
            return Verdict.OFFSET
        return Verdict.REJECTED

    # ----------------------------------------------------------------------------------------------------------- noise

    def _learn_noise(
        self, points: list[int], k: slice | list[int], z: F64, R0: F64, nu: F64, S_: F64,
        dt: list[float], s1: F64, s2: F64, learn: list[bool],
    ) -> None:  # fmt: skip
        s = self.settings
        self.bank_s2[k] = self.bank_s2[k] + self.bank_s1[k] * np.array(dt)[:, None] + s2
        self.bank_s1[k] = self.bank_s1[k] + s1
        due: list[int] = []
        steps: list[float] = []
        for i, p in enumerate(points):
            pt = self.points[p]
            pt.since_bank += dt[i]
            if pt.gaps:
                self.bank.fresh[p] = True
            pt.fixes += learn[i]
            # The receiver is what it was while the prediction is wide on purpose.
            held = pt.gaps or float(self.q_least[p, 0]) > 0.0
            steps.append(1.0 if held else 1.0 + s.r_step * max(1.0, 50.0 / (pt.fixes + 10)))
        step = np.array(steps)[:, None]
        scale = self.scale[k] * np.where(nu * nu > CHI1_MEDIAN * S_, step, 1.0 / step)
        scale = np.minimum(np.maximum(scale, s.r_least), s.r_most)
        self.scale[k] = scale if all(learn) else np.where(np.array(learn)[:, None], scale, self.scale[k])
        for i, p in enumerate(points):
            pt = self.points[p]
            if not learn[i]:
                continue
            if self.bank.fresh[p]:
                if not pt.gaps:
                    x = self.x[:, p]
                    self.bank.fold(p)
                    self.bank.reset(p, x[D], x[V], x[B])
                    self._bank_done(p)
            elif pt.since_bank >= s.bank_step_s or pt.anchor_ns - pt.begun_ns < int(s.bank_full_s * S):
                due.append(p)
        if due:
            run = due[-1] - due[0] + 1 == len(due)
            j: slice | list[int] = slice(due[0], due[-1] + 1) if run else due
            elapsed = np.array([self.points[p].since_bank for p in due])
            self.bank.predict(j, elapsed, self.bank_s1[j], self.bank_s2[j])
            self.bank.update(j, np.broadcast_to(z, (len(due), 3)), 1.0 - np.minimum(elapsed / s.bank_memory_s, 0.5))
            for p in due:
                self._bank_done(p)
                pt = self.points[p]
                young = pt.anchor_ns - pt.begun_ns < int(2 * s.bank_full_s * S)
                since = pt.anchor_ns - pt.posterior_ns
                if pt.fixes >= 20 and since >= (S if young else 5 * S):
                    pt.posterior_ns = pt.anchor_ns
                    self._noise(p, R0 * self.scale[p], 1e9 if young else 0.1 * since / S)

    def _contradiction(
        self, points: list[int], fix: Measurement, dt: list[float], z: F64, R: F64, nu: F64, S_: F64, out: Out
    ) -> None:
        rows = [i for i, p in enumerate(points) if self.points[p].aided]
        if not rows:
            return
        if len(rows) < len(points):
            points, dt = [points[i] for i in rows], [dt[i] for i in rows]
            R, nu, S_ = R[rows], nu[rows], S_[rows]
        for p in self.monitor.fix(points, dt, z, R, nu, S_, 2.0 * self.limit):
            if self.monitor.alarm[p]:
                text = "without the accelerometer the fixes are predicted better: the two do not see the same motion"
                out.append(Event(fix.t_ns, "CONTRADICTION", self.points[p].name, text))
            else:
                text = "accelerations and fixes agree again"
                out.append(Event(fix.t_ns, "CONTRADICTION_END", self.points[p].name, text))

    def _bank_done(self, p: int) -> None:
        self.points[p].since_bank = 0.0
        self.bank_s1[p] = 0.0
        self.bank_s2[p] = 0.0

    def _noise(self, p: int, R: F64, step: float) -> list[int]:
        """q and qb from the bank's posterior, at most `step` away in the logarithm; returns the best member per
        axis."""
        pt = self.points[p]
        s = self.settings
        w = 1.0 / (math.log(10.0) * s.accel_noise_decades) ** 2
        wb = 1.0 / (math.log(10.0) * s.bias_walk_decades) ** 2
        q0, qb0 = (s.accel_noise_m2ps3, s.bias_walk_m2ps5) if pt.aided else (s.gnss_only_q_m2ps3, s.gnss_only_qb_m2ps5)
        least = self.q_least[p].tolist()
        known = self.known[p]
        prior = []
        for axis in range(3):
            a, b, sure = q0, qb0, 1.0
            if known is not None and bool(known["aided"]) == pt.aided:
                a, b, sure = float(known["q"][axis]), float(known["qb"][axis]), KNOWN
            r = float(R[axis])
            prior.append((math.log(max(a, least[axis]) / r), w * sure, math.log(b / r), wb * sure))
        best = []
        for axis, (rho, beta, _, member) in enumerate(self.bank.posterior(p, prior)):
            r = float(R[axis])
            for figure, target in ((self.q, rho), (self.qb, beta)):
                old = math.log(float(figure[p, axis]))
                new = target + math.log(r)
                figure[p, axis] = math.exp(old + min(max(new - old, -step), step))
            self.q[p, axis] = max(float(self.q[p, axis]), least[axis])
            best.append(member)
        return best

    # ---------------------------------------------------------------------------------------------------------- output

    def _emit(self, points: list[int], upto: list[int] | None, pieces: dict[int, list[Piece]], out: Out) -> None:
        """Estimates of the rows from `ring.out` up to (not with) row `upto`, None = all, by the present anchors."""
        ring = self.ring
        alive: list[int] = []
        first: list[int] = []
        length: list[int] = []
        for i, p in enumerate(points):
            lo = ring.out[p]
            hi = ring.head[p] if upto is None else upto[i]
            if hi <= lo:
                continue
            ring.out[p] = hi
            if self.points[p].started and self.points[p].aided:
                alive.append(p)
                first.append(lo)
                length.append(hi - lo)
        if not alive:
            return
        n = max(length)
        k = block(alive)
        if isinstance(k, slice) and first.count(first[0]) == length.count(n) == len(alive):
            w = slice(first[0], first[0] + n)
            t, g, kind = ring.t[k, w], ring.g[k, w], ring.kind[k, w]
        else:
            last = np.array(first) + np.array(length) - 1
            rows = np.minimum(np.array(first)[:, None] + np.arange(n), last[:, None])
            pp = np.array(alive)[:, None]
            t, g, kind = ring.t[pp, rows], ring.g[pp, rows], ring.kind[pp, rows]
        pts = [self.points[p] for p in alive]
        anchor = np.array([pt.anchor_ns for pt in pts])
        y = live.stream(t, g, anchor, self.x[:, k], self.C[:, :, k], self.g[k], self.q[k], self.qb[k])
        sd = y[6:]
        for i, pt in enumerate(pts):
            if pt.gaps:
                live.add_gaps(pt.gaps, int(anchor[i]), t[i], sd[:, i].T)
        np.maximum(sd, 0.0, out=sd)
        np.sqrt(sd, out=sd)
        worst = sd[:3].max(axis=2).T.tolist()
        synthetic = bool(np.count_nonzero(kind))
        modes = np.empty((len(alive), 2, n), dtype=np.uint8)
        ends = t[:, -1].tolist()
        for i, p in enumerate(alive):
            pt = pts[i]
            c = length[i]
            mode, flags, usual = self._usual(pt)
            modes[i, 0] = mode
            modes[i, 1] = flags
            usual = usual and self._within(pt, ends[i], worst[i]) and not self.monitor.alarm[p]
            if not usual:
                self._modes(pt, t[i, :c], sd[:, i, :c].T, worst[i], self.monitor.alarm[p], modes[i, :, :c])
            piece = (t[i, :c].copy(), y[:, i, :c], modes[i, :, :c])
            if synthetic:
                real = kind[i, :c] != SYNTHETIC
                piece = (piece[0][real], piece[1][:, real], piece[2][:, real])
            if len(piece[0]):
                if not usual or mode != pt.mode:
                    self._mode_events(pt, piece[0], piece[2][0], out)
                pieces.setdefault(p, []).append(piece)

    @staticmethod
    def _usual(pt: Point) -> tuple[int, int, bool]:
        """Mode and flags of a point without regard to time and sd, and whether no gap changes them."""
        flags = (FLOAT if pt.floating else 0) | (JUMP_OPEN if pt.gate.open else 0) | (UNCERTAIN if pt.uncertain else 0)
        return ACCEL_ONLY if pt.receiver is None else FUSED, flags, not pt.gaps

    def _within(self, pt: Point, end_ns: int, worst: list[float]) -> bool:
        """Whether nothing up to `end_ns` is old or uncertain enough to change the mode."""
        s = self.settings
        return pt.receiver is None or (
            end_ns - pt.used_ns <= self.quiet_ns
            and worst[0] <= s.invalid_std_horizontal_m
            and worst[1] <= s.invalid_std_horizontal_m
            and worst[2] <= s.invalid_std_vertical_m
        )

    def _modes(self, pt: Point, t: I64, sd: F64, worst: list[float], contradicts: bool, modes: U8) -> None:
        """Mode and flags (2, n), in place, of rows t with sd (n, 6) that are not the usual ones; `worst` = the largest
        sd of displacement per axis."""
        s = self.settings
        mode, flags = modes
        for g in pt.gaps:
            flags[(t >= g.begin_ns) & (t > pt.anchor_ns)] |= np.uint8(FusionFlag.ACCEL_GAP)
        if pt.receiver is None:
            return
        if int(t[-1]) - pt.used_ns > int(s.coast_s * S):
            coast = t - pt.used_ns > int(s.coast_s * S)
            mode[coast] = Mode.COAST
            flags[coast & (sd[:, :3] > s.degraded_std_m).any(axis=1)] |= np.uint8(FusionFlag.DEGRADED)
        if contradicts:
            mode[:] = Mode.CONTRADICTION
        if int(t[-1]) - pt.used_ns > int(s.invalid_outage_s * S):
            mode[t - pt.used_ns > int(s.invalid_outage_s * S)] = Mode.INVALID
        if max(worst[:2]) > s.invalid_std_horizontal_m or worst[2] > s.invalid_std_vertical_m:
            bad = (sd[:, :2] > s.invalid_std_horizontal_m).any(axis=1) | (sd[:, 2] > s.invalid_std_vertical_m)
            mode[bad] = Mode.INVALID

    def _mode_events(self, pt: Point, t: I64, mode: U8, out: Out) -> None:
        if int(mode[0]) == pt.mode and int(mode[-1]) == pt.mode and not (mode != pt.mode).any():
            return
        for i in np.flatnonzero(np.diff(mode, prepend=np.uint8(pt.mode))):
            new = int(mode[i])
            text = f"{Mode(pt.mode).name} -> {Mode(new).name}"
            out.append(Event(int(t[i]), "MODE", pt.name, text, (("from", float(pt.mode)), ("to", float(new)))))
            pt.mode = new

    def _slow(self) -> tuple[F64, F64, F64, F64]:
        """Bias and level offset of all points with their sd, (P, 3) each."""
        return self.x[B] + self.ring.reference, np.sqrt(self.C[B, B]), self.x[O].copy(), np.sqrt(self.C[O, O])

    def _estimate(self, p: int, parts: list[Piece], slow: tuple[F64, F64, F64, F64]) -> Estimate:
        t, y, modes = parts[0]
        if len(parts) > 1:
            t = np.concatenate([a[0] for a in parts])
            y = np.concatenate([a[1] for a in parts], axis=1)
            modes = np.concatenate([a[2] for a in parts], axis=1)
        bias, bias_sd, offset, offset_sd = slow
        return Estimate(
            self.points[p].name, t, y[:3].T, y[3:6].T, y[6:9].T, y[9:].T, modes[0], modes[1],
            bias[p], bias_sd[p], offset[p], offset_sd[p],
        )  # fmt: skip

    def _single(self, p: int, t_ns: int, out: Out) -> Estimate:
        """The estimate at a fix of a point without accelerations."""
        pt = self.points[p]
        x, C = self.x[:, p], self.C[:, :, p]
        y = np.concatenate([x[D], x[V], np.sqrt(C[D, D]), np.sqrt(C[V, V])])[:, None]
        t = np.array([t_ns])
        mode, flags, _ = self._usual(pt)
        modes = np.array([[mode], [flags]], dtype=np.uint8)
        self._modes(pt, t, y[6:].T, y[6:9, 0].tolist(), False, modes)
        if modes[0, 0] == Mode.FUSED:
            modes[0, 0] = Mode.GNSS_ONLY
        if pt.aided:
            modes[1, 0] |= FusionFlag.ACCEL_GAP
        self._mode_events(pt, t, modes[0], out)
        return self._estimate(p, [(t, y, modes)], self._slow())

    # ----------------------------------------------------------------------------------------------------------- state

    def slow(self) -> State:
        """What an earlier run knew of the sensors, by point: noise and bias. Absent before the start."""
        return {pt.name: self._figures(p) for p, pt in enumerate(self.points) if pt.started and pt.receiver is not None}

    def _figures(self, p: int) -> State:
        return {
            "scale": self.scale[p].copy(), "q": self.q[p].copy(), "qb": self.qb[p].copy(),
            "aided": self.points[p].aided, "bias": self.x[B, p] + self.ring.reference[p],
        }  # fmt: skip

    def adopt(self, s: State) -> list[Event]:
        """Begin with another run's noise figures as centres of the priors and its scale of R. The bias is told only:
        temperature has changed it, and the start window finds it at once."""
        events = []
        for p, pt in enumerate(self.points):
            known = s.get(pt.name)
            if known is None:
                continue
            self.known[p] = known
            values = tuple(
                (f"{k}_{a}", float(known[k][i])) for k in ("scale", "q", "qb", "bias") for i, a in enumerate("xyz")
            )
            events.append(Event(0, "ADOPTED", pt.name, "noise figures of the run before", values))
        return events

    def save(self) -> State:
        return {
            "points": {p.name: p.save() for p in self.points},
            "ring": self.ring.save(),
            "bank": self.bank.save(),
            "monitor": self.monitor.save(),
            "arrays": [getattr(self, k) for k in _ARRAYS],
            "known": list(self.known),
            "unset": sorted(self.unset),
            "datums": dict(self.datums),
            "counts": [self.old, self.prechecked],
        }

    def load(self, s: State) -> None:
        for p in self.points:
            p.load(s["points"][p.name])
        self.ring.load(s["ring"])
        self.bank.load(s["bank"])
        self.monitor.load(s["monitor"])
        for k, a in zip(_ARRAYS, s["arrays"], strict=True):
            setattr(self, k, a.copy())
        self.known = list(s["known"])
        self.unset = set(s["unset"])
        self.datums = dict(s["datums"])
        self.old, self.prechecked = s["counts"]


_ARRAYS = ("x", "C", "g", "bent", "bend_rate", "q", "qb", "q_least", "scale", "bank_s1", "bank_s2")


def _three(v: F64) -> Three:
    a, b, c = v.tolist()
    return (a, b, c)
