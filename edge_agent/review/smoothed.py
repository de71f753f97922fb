"""Recordings -> the smoothed stream of a point, of any length, and back into a recording.

The gate's recorded verdicts decide what is used: ACCEPTED as it is, OFFSET on a level of its own that is estimated
beside (a new one with every JUMP_OPEN and JUMP_LEVEL), the rest not at all; float fixes wander and are left out. DATUM
and REACQUIRE move the displacement itself. The declared sd is that which the filter used. Noise is found by
maximum likelihood in the chapters, anew every quarter of an hour at 10 Hz; the sd of the fixes is left as it is where
`fusion.r_least` and `r_most` are both 1.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edge_agent.fusion.model import B, O
from edge_agent.messages import F64, I64, Config, Estimate, FusionSettings, Mode, Quality, Record, S, Verdict
from edge_agent.recording import topics
from edge_agent.recording.reader import read_attachments, read_messages, read_metadata
from edge_agent.recording.writer import PART, RUN_METADATA, SegmentWriter
from edge_agent.replay import FINAL
from edge_agent.review.likelihood import Fit, fit, fits
from edge_agent.review.series import Piece, configuration, pieces
from edge_agent.review.smooth import CHAPTER, NO_ACCELERATIONS, Accelerations, Fixes, Noise, Smooth, Smoother

CUT_NS = 300 * S
"""An outage so long connects nothing: the smoother begins anew behind it."""
BLOCK = 256
"""Samples of a FusedBlock."""
HELD = 8192
"""Blocks that wait for points that are behind, at most: a receiver that is silent for an hour must not fill memory."""
LEAST = 20
"""Fixes of a chapter at least; fewer are not smoothed."""
NOISE = 1000
"""Fixes from which noise is found."""
NOISE_EVERY = 9_000
"""It is found anew in the first chapter behind so many fixes."""
SIDE_BY_SIDE = 2
"""Chapters of several points whose noise is found at the same time: 30 MB each."""
_USED = frozenset((int(Verdict.ACCEPTED), int(Verdict.OFFSET)))
_NO_FIX = np.zeros(3), False, 0


@dataclass
class _Waiting:
    """What a chapter is made of, not yet smoothed. Fixes and their verdicts come in records of their own."""

    z: dict[int, tuple[F64, bool, int]] = field(default_factory=dict)  # t_ns -> z, whether it is one, UTC - monotonic
    rows: list[tuple[int, F64, F64, int, bool, int]] = field(default_factory=list)  # t, z, std, level, step, offset
    accel: list[tuple[I64, F64]] = field(default_factory=list)
    jumps: list[int] = field(default_factory=list)  # t_ns of every new level
    steps: set[int] = field(default_factory=set)  # t_ns at which the displacement was moved
    accel_to_ns: int = -(1 << 62)


class Smoothed:
    """Feed pieces of one point in order; each call yields blocks with their UTC - monotonic [ns]."""

    def __init__(
        self,
        config: Config,
        point: str,
        *,
        noise: Noise | None = None,
        chapter: int = CHAPTER,
        block: int = BLOCK,
        velocity: bool = True,
    ) -> None:
        """`velocity`: wanted, else the blocks' velocities and their sd are empty."""
        settings = config.points[point]
        self.point, self.receiver, self.accelerometer = point, settings.receiver, settings.accelerometer
        self.fusion = config.fusion
        # the configuration may insist on the declared variances
        self.fixed_r = 1.0 if config.fusion.r_least == config.fusion.r_most == 1.0 else None
        self.noise, self.chapter, self.block, self.velocity = noise, chapter, block, velocity
        self._smoother: Smoother | None = None
        self._wait = _Waiting()
        self._r = np.ones(3)  # factor on the declared variance that belongs to the smoother's noise
        self._since = 0  # fixes since noise was found
        self._run = ""
        self._last_ns = -(1 << 62)
        self._offsets: list[tuple[int, int]] = []  # t_ns, UTC - monotonic of fixes not yet given out

    def add(self, piece: Piece) -> Iterator[tuple[Estimate, int]]:
        yield from self._take(piece)
        if self._full:
            yield from self._close(*self._chapter(self.chapter))

    def _take(self, piece: Piece) -> Iterator[tuple[Estimate, int]]:
        """Take in what a piece holds; yields what ends with it."""
        accel = piece.accelerations.get(self.accelerometer or "")
        back = accel is not None and int(accel.t_ns[0]) <= self._wait.accel_to_ns  # another record of the same time
        if piece.run != self._run or back:
            yield from self.finish()
            self._run = piece.run
        w = self._wait
        for h in piece.happened:
            if h.source == self.point and not h.fault:
                if h.kind in ("JUMP_OPEN", "JUMP_LEVEL"):
                    w.jumps.append(h.t_ns)
                elif h.kind in ("DATUM", "REACQUIRE"):
                    w.steps.add(h.t_ns)
        fixes = piece.fixes.get(self.receiver or "")
        if fixes is not None:
            good = np.isfinite(fixes.z_m).all(axis=1) & (fixes.quality != Quality.FLOAT)
            offset_ns = (fixes.utc_ns - fixes.t_ns).tolist()
            for t, z, usable, offset in zip(fixes.t_ns.tolist(), fixes.z_m, good.tolist(), offset_ns, strict=True):
                w.z[t] = z, usable, offset
        if accel is not None:
            w.accel.append((accel.t_ns, accel.xyz))
            w.accel_to_ns = int(accel.t_ns[-1])
        judged = piece.judged.get(self.point)
        if judged is not None:
            for t, verdict, std in zip(judged.t_ns.tolist(), judged.verdict.tolist(), judged.std_m, strict=True):
                z, usable, offset = w.z.pop(t, _NO_FIX)
                if not usable or verdict not in _USED:
                    continue
                if t - self._last_ns > CUT_NS and w.rows:
                    yield from self.finish(keep=True)
                if t <= self._last_ns:
                    continue
                self._last_ns = t
                level = 0
                if verdict == Verdict.OFFSET:
                    level = 1 + sum(1 for j in w.jumps if j <= t)
                w.rows.append((t, z, std, level, t in w.steps, offset))
            for t in [t for t in w.z if t < self._last_ns - 60 * S]:
                del w.z[t]

    @property
    def _full(self) -> bool:
        """Whether a chapter waits, with the accelerations that cover it."""
        w, n = self._wait, self.chapter
        return len(w.rows) > n and (self.accelerometer is None or w.accel_to_ns > w.rows[n - 1][0])

    def finish(self, *, keep: bool = False) -> Iterator[tuple[Estimate, int]]:
        """What is left, at the end of a run or before a long outage (`keep`: verdicts that wait stay)."""
        w = self._wait
        if w.rows:
            yield from self._close(*self._chapter(len(w.rows)))
        if self._smoother is not None:
            for s in self._smoother.finish():
                yield from self._blocks(s)
        self._smoother = None
        self._offsets = []
        waiting = w.z if keep else {}
        self._wait = _Waiting(z=waiting, jumps=w.jumps if keep else [], steps=w.steps if keep else set())
        if keep:
            self._wait.accel, self._wait.accel_to_ns = w.accel, w.accel_to_ns
        else:
            self._last_ns = -(1 << 62)

    def _chapter(self, n: int) -> tuple[Fixes, Accelerations]:
        """Take the first n fixes that wait as a chapter, with the accelerations so far."""
        w = self._wait
        rows, w.rows = w.rows[:n], w.rows[n:]
        t, z, std, level, step, offset = zip(*rows, strict=True)
        fixes = Fixes(
            np.array(t, np.int64), np.array(z), np.array(std), np.array(level, np.int64), np.array(step, np.bool_)
        )
        accel = NO_ACCELERATIONS
        if w.accel:
            all_t = np.concatenate([a for a, _ in w.accel])
            all_a = np.concatenate([a for _, a in w.accel])
            rising = np.diff(all_t, prepend=all_t[:1] - 1) > 0
            accel = Accelerations(all_t[rising], all_a[rising])
            kept = accel.t_ns >= fixes.t_ns[-1] - 12 * S  # a mean of 10 s may be asked for, and the last sample
            w.accel = [(accel.t_ns[kept], accel.xyz[kept])]
        self._offsets += list(zip(fixes.t_ns.tolist(), offset, strict=True))
        return fixes, accel

    def _asks(self, fixes: Fixes) -> bool:
        """Whether a chapter's noise is to be found."""
        if self._smoother is None:
            return self.noise is None and len(fixes) >= LEAST
        return self.noise is None and len(fixes) >= 10 * LEAST and self._since >= NOISE_EVERY

    def _close(self, fixes: Fixes, accel: Accelerations, found: Fit | None = None) -> Iterator[tuple[Estimate, int]]:
        """Filter a chapter; `found`: its noise, where that is known already."""
        if self._smoother is None and len(fixes) < LEAST:
            self._offsets = []
            return
        if self._asks(fixes):
            found = found or fit(fixes, accel, r=self.fixed_r, most=NOISE)
            # an axis that is known to stand still for one hour may move in the next
            least = FusionSettings().gnss_only_q_m2ps3 * 1e-6
            noise = Noise(np.maximum(found.noise.q, least), np.maximum(found.noise.qb, least * 1e-3))
            self._r, self._since = np.maximum(found.r, 1e-3), 0
        elif self.noise is not None:
            noise = self.noise
        elif self._smoother is not None:
            noise = self._smoother.noise
        else:
            return
        self._since += len(fixes)
        if self.noise is None:
            fixes = Fixes(fixes.t_ns, fixes.z_m, fixes.std_m * np.sqrt(self._r), fixes.level, fixes.step)
        if self._smoother is None:
            self._smoother = Smoother(noise, velocity=self.velocity)
        self._smoother.noise = noise
        for s in self._smoother.add(fixes, accel):
            yield from self._blocks(s)

    def _blocks(self, s: Smooth) -> Iterator[tuple[Estimate, int]]:
        """A smoothed chapter as blocks of the stream."""
        times = np.array([t for t, _ in self._offsets], np.int64)
        aided = self.accelerometer is not None
        limit = np.array([self.fusion.invalid_std_horizontal_m] * 2 + [self.fusion.invalid_std_vertical_m])
        for lo in range(0, len(s.t_ns), self.block):
            k = slice(lo, min(lo + self.block, len(s.t_ns)))
            first = int(s.t_ns[lo])
            node = int(np.clip(np.searchsorted(s.fix_ns, first, side="right") - 1, 0, len(s.fix_ns) - 1))
            sd = np.sqrt(np.maximum(np.diagonal(s.P[node], axis1=0, axis2=1).T, 0.0))
            valid = (s.std_displacement_m[k] <= limit).all(axis=1)
            mode = np.where(valid, Mode.FUSED if aided else Mode.GNSS_ONLY, Mode.INVALID).astype(np.uint8)
            yield (
                Estimate(
                    self.point, s.t_ns[k], s.displacement_m[k], s.velocity_mps[k], s.std_displacement_m[k],
                    s.std_velocity_mps[k], mode, np.zeros(len(mode), np.uint8), s.reference + s.x[node, B], sd[B],
                    s.x[node, O], sd[O], FINAL,
                ),
                self._offsets[max(0, int(np.searchsorted(times, first, side="right")) - 1)][1],
            )  # fmt: skip
        done = int(np.searchsorted(times, s.fix_ns[-1]))
        self._offsets = self._offsets[max(0, done - 1) :]


def add_all(each: Mapping[str, Smoothed], piece: Piece) -> Iterator[tuple[str, Estimate, int]]:
    """Feed a piece to all points; yields as `Smoothed.add` with the point's name in front. Chapters that end together
    are computed together."""
    for name, one in each.items():
        for e, offset in one._take(piece):
            yield name, e, offset
    full = [(name, one) for name, one in each.items() if one._full]
    for lo in range(0, len(full), SIDE_BY_SIDE):
        part = [(name, one, one._chapter(one.chapter)) for name, one in full[lo : lo + SIDE_BY_SIDE]]
        asking = [chapter for _, one, chapter in part if one._asks(chapter[0])]
        found = iter(fits(asking, r=part[0][1].fixed_r, most=NOISE))
        for name, one, chapter in part:
            for e, offset in one._close(*chapter, next(found) if one._asks(chapter[0]) else None):
                yield name, e, offset


def smoothed(
    files: Sequence[Path], points: Sequence[str], *, noise: Noise | None = None, chapter: int = CHAPTER
) -> Iterator[tuple[Estimate, int]]:
    """The smoothed streams of points from recordings with fused data, in order of time over all of them (as far as
    HELD blocks reach), with UTC - monotonic [ns]. One walk over the files; memory is two chapters for each point.

    ReplayError without a configuration, KeyError for a point that it does not name."""
    config = configuration(files)
    each = {name: Smoothed(config, name, noise=noise, chapter=chapter) for name in points}
    aided = any(config.points[name].accelerometer is not None for name in points)
    held: list[tuple[int, int, Estimate, int]] = []
    reached = dict.fromkeys(points, -(1 << 62))  # UTC up to which a point has come
    count = 0

    def take(name: str, e: Estimate, offset: int) -> None:
        nonlocal count
        count += 1
        reached[name] = int(e.t_ns[0]) + offset
        heapq.heappush(held, (reached[name], count, e, offset))

    def ready(everything: bool) -> Iterator[tuple[Estimate, int]]:
        while held and (everything or held[0][0] <= min(reached.values()) or len(held) > HELD):
            _, _, e, offset = heapq.heappop(held)
            yield e, offset

    for piece in pieces(files, config, accelerations=aided):
        for name, e, offset in add_all(each, piece):
            take(name, e, offset)
        yield from ready(False)
    for name, one in each.items():
        for e, offset in one.finish():
            take(name, e, offset)
    yield from ready(True)


def final(topic: str, data: bytes) -> bool:
    """Whether a message is of this stream."""
    return topic.endswith("/smoothed") and topics.decode_fused_block("", data).revision == FINAL


def add_smoothed(path: Path) -> dict[str, int]:
    """Write the smoothed stream of every point into a recording, as `/fusion/<point>/smoothed` beside what it holds, in
    order of time; return the samples per point. Raises as `smoothed`, and OSError."""
    config = configuration([path])
    names = [name for name, p in config.points.items() if p.receiver is not None]
    counts = dict.fromkeys(names, 0)

    def stream() -> Iterator[Record]:
        for e, offset in smoothed([path], names):
            counts[e.point] += len(e.t_ns)
            utc_ns = int(e.t_ns[0]) + offset
            yield Record(f"/fusion/{e.point}/smoothed", utc_ns, utc_ns, topics.fused_block(e, utc_ns), True)

    stored = (Record(s.topic, s.log_ns, s.publish_ns, s.data, False, s.schema) for s in read_messages(path))
    part = path.with_name(path.name + ".smooth" + PART)
    attachments = {a.name: a.data for a in read_attachments(path)}
    writer = SegmentWriter(part, metadata=read_metadata(path).get(RUN_METADATA, {}), attachments=attachments)
    try:
        for record in heapq.merge(stored, stream(), key=lambda r: r.log_ns):
            if record.derived or not final(record.topic, record.data):  # what was smoothed before is replaced
                writer.add(record)
        done = writer.close()
    except BaseException:
        writer.abandon()
        part.unlink(missing_ok=True)
        raise
    done.replace(path)
    return counts
