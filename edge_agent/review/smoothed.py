"""Recordings -> the smoothed stream of a point, of any length, and back into a recording.

The gate's recorded verdicts decide what is used: ACCEPTED as it is, OFFSET on a level of its own that is estimated
beside (a new one with every JUMP_OPEN and JUMP_LEVEL), the rest not at all; float fixes wander and are left out. DATUM
and REACQUIRE move the displacement itself. The declared sd is that which the filter used. Noise of each chapter is its
own maximum likelihood.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from edge_agent.fusion.model import B, O
from edge_agent.messages import F64, I64, Config, Estimate, FusionSettings, Mode, Quality, Record, S, Verdict
from edge_agent.recording import topics
from edge_agent.recording.reader import read_attachments, read_messages, read_metadata
from edge_agent.recording.writer import PART, RUN_METADATA, SegmentWriter
from edge_agent.replay import FINAL
from edge_agent.review.likelihood import fit
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


@dataclass
class _Waiting:
    """What a chapter is made of, not yet smoothed. Fixes and their verdicts come in records of their own."""

    z: dict[int, tuple[F64, int, int]] = field(default_factory=dict)  # t_ns -> z, quality, UTC - monotonic
    rows: list[tuple[int, F64, F64, int, bool, int]] = field(default_factory=list)  # t, z, std, level, step, offset
    accel: list[tuple[I64, F64]] = field(default_factory=list)
    jumps: list[int] = field(default_factory=list)  # t_ns of every new level
    steps: set[int] = field(default_factory=set)  # t_ns at which the displacement was moved
    accel_to_ns: int = -(1 << 62)


class Smoothed:
    """Feed pieces of one point in order; each call yields blocks with their UTC - monotonic [ns]."""

    def __init__(self, config: Config, point: str, *, noise: Noise | None = None, chapter: int = CHAPTER) -> None:
        settings = config.points[point]
        self.point, self.receiver, self.accelerometer = point, settings.receiver, settings.accelerometer
        self.fusion = config.fusion
        self.noise, self.chapter = noise, chapter
        self._smoother: Smoother | None = None
        self._wait = _Waiting()
        self._run = ""
        self._last_ns = -(1 << 62)
        self._offsets: list[tuple[int, int]] = []  # t_ns, UTC - monotonic of fixes not yet given out

    def add(self, piece: Piece) -> Iterator[tuple[Estimate, int]]:
        if piece.run != self._run:
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
            for i, t in enumerate(fixes.t_ns.tolist()):
                w.z[t] = fixes.z_m[i], int(fixes.quality[i]), int(fixes.utc_ns[i]) - t
        accel = piece.accelerations.get(self.accelerometer or "")
        if accel is not None:
            w.accel.append((accel.t_ns, accel.xyz))
            w.accel_to_ns = int(accel.t_ns[-1])
        judged = piece.judged.get(self.point)
        if judged is not None:
            for i, t in enumerate(judged.t_ns.tolist()):
                z, quality, offset = w.z.pop(t, (np.zeros(0), 0, 0))
                verdict = int(judged.verdict[i])
                usable = verdict in (Verdict.ACCEPTED, Verdict.OFFSET) and quality != Quality.FLOAT
                if not usable or not len(z) or not np.isfinite(z).all():
                    continue
                if t - self._last_ns > CUT_NS and w.rows:
                    yield from self.finish(keep=True)
                if t <= self._last_ns:
                    continue
                self._last_ns = t
                level = 0
                if verdict == Verdict.OFFSET:
                    level = 1 + sum(1 for j in w.jumps if j <= t)
                w.rows.append((t, z, judged.std_m[i], level, t in w.steps, offset))
            for t in [t for t in w.z if t < self._last_ns - 60 * S]:
                del w.z[t]
        if len(w.rows) > self.chapter and (self.accelerometer is None or w.accel_to_ns > w.rows[self.chapter - 1][0]):
            yield from self._close(self.chapter)

    def finish(self, *, keep: bool = False) -> Iterator[tuple[Estimate, int]]:
        """What is left, at the end of a run or before a long outage (`keep`: verdicts that wait stay)."""
        w = self._wait
        if w.rows:
            yield from self._close(len(w.rows))
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

    def _close(self, n: int) -> Iterator[tuple[Estimate, int]]:
        """Filter the first n fixes as a chapter."""
        w = self._wait
        rows, w.rows = w.rows[:n], w.rows[n:]
        if self._smoother is None and len(rows) < LEAST:
            return
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
        noise = self.noise
        if noise is None:
            if self._smoother is None or len(rows) >= 10 * LEAST:
                found = fit(fixes, accel, most=1000)
                # an axis that is known to stand still for one hour may move in the next
                least = FusionSettings().gnss_only_q_m2ps3 * 1e-6
                noise = Noise(np.maximum(found.noise.q, least), np.maximum(found.noise.qb, least * 1e-3))
                fixes = Fixes(
                    fixes.t_ns, fixes.z_m, fixes.std_m * np.sqrt(np.maximum(found.r, 1e-3)), fixes.level, fixes.step
                )
            else:
                noise = self._smoother.noise
        if self._smoother is None:
            self._smoother = Smoother(noise)
        self._smoother.noise = noise
        self._offsets += list(zip(fixes.t_ns.tolist(), offset, strict=True))
        for s in self._smoother.add(fixes, accel):
            yield from self._blocks(s)

    def _blocks(self, s: Smooth) -> Iterator[tuple[Estimate, int]]:
        """A smoothed chapter as blocks of the stream."""
        times = np.array([t for t, _ in self._offsets], np.int64)
        aided = self.accelerometer is not None
        limit = np.array([self.fusion.invalid_std_horizontal_m] * 2 + [self.fusion.invalid_std_vertical_m])
        for lo in range(0, len(s.t_ns), BLOCK):
            k = slice(lo, min(lo + BLOCK, len(s.t_ns)))
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

    def take(name: str, blocks: Iterator[tuple[Estimate, int]]) -> None:
        nonlocal count
        for e, offset in blocks:
            count += 1
            reached[name] = int(e.t_ns[0]) + offset
            heapq.heappush(held, (reached[name], count, e, offset))

    def ready(everything: bool) -> Iterator[tuple[Estimate, int]]:
        while held and (everything or held[0][0] <= min(reached.values()) or len(held) > HELD):
            _, _, e, offset = heapq.heappop(held)
            yield e, offset

    for piece in pieces(files, config, accelerations=aided):
        for name, one in each.items():
            take(name, one.add(piece))
        yield from ready(False)
    for name, one in each.items():
        take(name, one.finish())
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
