"""Segments: which file is written, what it is called, when it is on the disk, and which old ones go.

A `Rotate` closes the open segment and opens the next, whose first record is the Rotate's checkpoint; nothing else
opens or closes one. Names are `<site>_<YYYYMMDDTHHMMSSZ>_<NNN>.mcap`, with `.part` behind while the file is open; NNN
counts files of one second, so no two files ever share a name. Each file's metadata names the file before it and that
file's SHA-256. An fsync takes at most three quarters of the time: after it comes a pause of a third of what it took.
Where a slow disk makes a power cut cost more than `fsync_s` for that, FSYNC_LATE says so, and FSYNC_OK when it has kept
up again for a minute. Retention looks only at names of this form and this site: older than `keep_days` (by a
disciplined clock only, that has run for hours without a step: one wrong step must not empty the disk), more than
`keep_gb` together, less than `free_gb` free where deleting can reach that, and else less than `FLOOR` of it; it never
touches the open file.

One thread drives a Recorder; time is an argument (monotonic ns). When the disk fails, the open file is sealed as far as
it goes and RecordingError is raised; the Recorder then has no open file until the next Rotate.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

from edge_agent.messages import Fault, Record, RecordSettings, Rotate, S
from edge_agent.recording.reader import DamagedError, head_metadata
from edge_agent.recording.repair import DAMAGED, Repaired, recover, repair
from edge_agent.recording.writer import PART, RUN_METADATA, SegmentWriter, fsync_folder

__all__ = ["Recorder", "RecordingError", "Repaired", "Segment", "list_segments", "recover"]

GB = 1e9
PLAUSIBLE = datetime(2020, 1, 1, tzinfo=UTC)
"""Names before this come from a gateway whose clock had not been set; their age is not known."""
HEAD_BYTES = 1 << 20
"""Free space without which no file is begun: head, checkpoint and an index."""
FLOOR = 1 / 16
"""So much of `free_gb` is kept free even where all of it cannot be: 62 MB by default, an hour of most sites. Without it
the disk would run full again and again, and each time cost what is in the open chunk."""
REST = 3
"""The pause behind an fsync is what it took, divided by this: more would break the promise of `fsync_s` earlier."""
LATE_NS = S // 2
"""How much later than `fsync_s` an fsync may end before that is told."""
KEPT_UP_NS = 60 * S
"""After so long without a late one the disk is said to keep up again."""
RECENT = 1000
"""Files of this run whose names are kept for event clips; an hour of them where a file lasts four seconds."""
RETENTION_NS = 60 * S
"""How often retention looks at the folder while a file is open: other programs fill disks too."""
BELIEVED_NS = 6 * 3600 * S
"""How long a disciplined clock must have run without a step before files are deleted for their age: one that was set a
year ahead, and is set back within hours, must not empty the disk."""

_NAME = r"_(\d{8}T\d{6}Z)_(\d{3,})\.mcap"


class RecordingError(Exception):
    """The disk refused. `reason`: "full", "read-only", "io" or "closed"; `unwritten`: records that are in no file.
    Recording goes on if the Recorder's `path` is not None, else it waits for the next Rotate."""

    def __init__(self, reason: str, text: str, unwritten: tuple[Record, ...] = ()) -> None:
        super().__init__(text)
        self.reason = reason
        self.unwritten = unwritten


class Segment(NamedTuple):
    """A finished file of a site, or the damaged original of one. Sorts oldest first."""

    begin: datetime  # of the name, UTC
    number: int
    path: Path
    size: int


def list_segments(data_dir: Path, site: str) -> list[Segment]:
    """Finished files of a site, oldest first; anything with another form of name is not seen."""
    form = re.compile(re.escape(site) + _NAME + rf"(?:{re.escape(DAMAGED)}\d*)?", re.ASCII)
    found = []
    for path in data_dir.iterdir():
        match = form.fullmatch(path.name)
        if match is None:
            continue
        try:
            begin = datetime.strptime(match[1], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
            found.append(Segment(begin, int(match[2]), path, path.stat().st_size))
        except (ValueError, FileNotFoundError):  # no date, or taken away by someone meanwhile
            continue
    return sorted(found)


class Recorder:
    """Writes one run's segments into `data_dir` (made if missing).

    `metadata` and `attachments` go into every file; `free_bytes()` tells the free space of the file system.
    """

    def __init__(
        self,
        data_dir: Path,
        settings: RecordSettings,
        site: str,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes],
        free_bytes: Callable[[], int],
    ) -> None:
        self.data_dir = Path(data_dir)
        self.settings = settings
        self.site = site
        self.metadata = dict(metadata)
        self.attachments = dict(attachments)
        self.free_bytes = free_bytes
        self.segments = 0  # opened by this run
        self.recent: tuple[Path, ...] = ()  # final names of this run's latest files, the open one last
        self._writer: SegmentWriter | None = None
        self._previous: tuple[str, str] | None = None  # name and SHA-256 of the file before; ("", "") = none
        self._faults: list[Fault] = []
        self._now_ns = 0
        self._utc = PLAUSIBLE
        self._sync = False
        self._since_ns: int | None = None  # since when the clock has gone on without a step, monotonic
        self._short = False  # of space that deleting cannot give, as told
        self._flushed_ns = self._synced_ns = self._pruned_ns = 0
        self._ahead_ns = 0  # an fsync begins so much before it is due,
        self._rest_ns = 0  # and not before this
        self._covered_ns = 0  # what came until then is on the disk
        self.fsync_ns = 0  # how long the last one took, with the records before it
        self.fsyncs_late = 0  # ended later than promised, in this run
        self._late_ns = 0  # the last of them; 0 = the disk keeps up, as told

    @property
    def path(self) -> Path | None:
        """The open file."""
        return None if self._writer is None else self._writer.path

    @property
    def open_bytes(self) -> int:
        """Size of the open file, without what waits in its open chunk; 0 = no file is open."""
        return 0 if self._writer is None else self._writer.size

    def drain_faults(self) -> list[Fault]:
        """What happened since the last call: files deleted by retention."""
        faults, self._faults = self._faults, []
        return faults

    def handle(self, item: Record | Rotate, now_ns: int | None = None) -> None:
        """Write a record, or begin a new segment. Raises RecordingError (disk), ValueError or TypeError for a record
        that the format cannot hold; a Record while no file is open is a RecordingError that returns it."""
        if now_ns is not None:
            self._now_ns = now_ns
        if isinstance(item, Rotate):
            self._rotate(item)
            return
        if self._writer is None:
            raise RecordingError("closed", "no segment is open", (item,))
        try:
            self._writer.add(item)
        except OSError as e:
            raise self._fail(e) from e

    def wait_s(self, now_ns: int) -> float:
        """Seconds until `idle` has to flush or fsync, at most 1: time that the disk took counts, or a kill would cost
        more."""
        if self._writer is None:
            return min(self.settings.flush_s, 1.0)
        due_ns = min(self._flushed_ns + self.settings.flush_s * S, self._fsync_due_ns)
        return min(max((due_ns - now_ns) / S, 0.0), 1.0)

    @property
    def _fsync_due_ns(self) -> float:
        return max(self._synced_ns + self.settings.fsync_s * S - self._ahead_ns, self._rest_ns)

    def fsync_took(self, ns: int) -> None:
        """How long the last fsync took, with the records before it. What a power cut costs counts until its end, so on
        a slow disk the next ones begin earlier, by half of `fsync_s` at most; but the disk gets its pause."""
        promised = self.settings.fsync_s * S
        self._ahead_ns = int(min(max(ns, 0.9 * self._ahead_ns), promised / 2))
        end = self._synced_ns + ns
        self._rest_ns = end + int(min(ns, promised)) // REST
        covered, self._covered_ns, self.fsync_ns = self._covered_ns, self._synced_ns, ns
        late = end - covered if covered else ns  # a power cut just before its end would have cost so much
        if late > promised + LATE_NS:
            self.fsyncs_late += 1
            if not self._late_ns:
                text = (
                    f"what came {late / S:.1f} s ago is only now on the disk: a power cut would have cost it, "
                    f"not the {self.settings.fsync_s:g} s of fsync_s; the last fsync took {ns / S:.1f} s"
                )
                self._faults.append(Fault(end, "recorder", "FSYNC_LATE", text, (("lost_s", late / S),)))
            self._late_ns = end
        elif self._late_ns and end - self._late_ns > KEPT_UP_NS:
            self._late_ns = 0
            text = f"the disk keeps up again: a power cut costs at most {self.settings.fsync_s:g} s"
            self._faults.append(Fault(end, "recorder", "FSYNC_OK", text, (("late", float(self.fsyncs_late)),)))

    def idle(self, now_ns: int, begun_ns: int = 0) -> bool:
        """Do what is due: flush every `flush_s`, fsync every `fsync_s`, retention every minute. Whether an fsync was
        done. `begun_ns`: records that came later may still wait outside (0 = none does). RecordingError."""
        self._now_ns = now_ns
        writer = self._writer
        if writer is None:
            return False
        synced = now_ns >= self._fsync_due_ns
        try:
            if synced or now_ns - self._flushed_ns >= self.settings.flush_s * S:
                writer.look()
            if synced:
                writer.fsync()
                self._synced_ns, self._flushed_ns = begun_ns or now_ns, now_ns
            elif now_ns - self._flushed_ns >= self.settings.flush_s * S:
                writer.flush()
                self._flushed_ns = now_ns
        except OSError as e:
            raise self._fail(e) from e
        if now_ns - self._pruned_ns >= RETENTION_NS:
            try:
                self._retain()
            except OSError as e:  # the folder cannot be read; whether it can be written shows at the next record
                self._faults.append(Fault(now_ns, "recorder", "RETENTION_FAILED", f"{self.data_dir}: {e}"))
        return synced

    def close(self) -> Path | None:
        """Finish the open segment; return its final path. RecordingError."""
        writer = self._writer
        if writer is None:
            return None
        try:
            final = writer.close()
        except OSError as e:
            raise self._fail(e) from e
        self._writer = None
        self._previous = final.name, writer.sha256
        return final

    # ------------------------------------------------------------------------------------------------------- segments

    def _rotate(self, rotate: Rotate) -> None:
        unfinished: RecordingError | None = None
        was_open = self._writer is not None
        try:
            self.close()
        except RecordingError as e:  # the next segment is tried all the same; the loss is told behind
            unfinished = e
        lost = unfinished.unwritten if unfinished else ()
        self._utc = datetime.fromtimestamp(rotate.utc_ns // S, UTC)
        self._sync = rotate.sync
        if self._since_ns is None or rotate.reason == "clock" or not rotate.sync:
            self._since_ns = self._now_ns
        try:
            self.data_dir.mkdir(parents=True, exist_ok=True)
            self._retain()
            self._writer = self._open(rotate)
        except OSError as e:
            text = f"no segment can be opened: {e}"
            if e.errno == errno.EROFS:
                text += "; where systemd runs it, a data_dir of one's own needs the drop-in data-dir.conf"
            raise RecordingError(_reason(e), text, (*lost, rotate.checkpoint)) from e
        self.segments += 1
        self.recent = (*self.recent[-RECENT + 1 :], self._writer.final)
        # What comes behind a Rotate has waited with it since the last flush: it has no further `flush_s` to wait.
        self._synced_ns = self._flushed_ns
        self._covered_ns = self._flushed_ns if was_open and not unfinished else 0
        if unfinished:
            raise RecordingError(unfinished.reason, f"{unfinished}; a new segment is open", lost) from unfinished

    def _open(self, rotate: Rotate) -> SegmentWriter:
        """A new file with its head and checkpoint on the disk; on an OSError nothing of it is left."""
        if self.free_bytes() < HEAD_BYTES:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.data_dir))
        if self._previous is None:
            self._previous = self._last_on_disk()
        name, sha256 = self._previous
        path = self._free_name()
        metadata = {
            **self.metadata,
            "site": self.site,
            "segment": str(self.segments),
            "opened_because": rotate.reason,
            "previous_name": name,
            "previous_sha256": sha256,
        }
        writer = SegmentWriter(path, metadata=metadata, attachments=self.attachments, utc_ns=max(rotate.utc_ns, 0))
        try:
            writer.add(rotate.checkpoint)
            writer.fsync()  # schemas and channels of the first chunk are what makes the rest readable
            fsync_folder(self.data_dir)
        except OSError:
            writer.abandon()
            with suppress(OSError):
                path.unlink()  # holds nothing but a head; tries to record on a full disk must not pile up
            raise
        return writer

    def _free_name(self) -> Path:
        stem = f"{self.site}_{self._utc:%Y%m%dT%H%M%SZ}"
        taken = [path.name for path in self.data_dir.iterdir()]
        number = 0
        while any(name.startswith(f"{stem}_{number:03d}.mcap") for name in taken):
            number += 1
        return self.data_dir / f"{stem}_{number:03d}.mcap{PART}"

    def _last_on_disk(self) -> tuple[str, str]:
        """The newest file of the run before, and its hash: the chain goes on over a restart."""
        finished = [s for s in list_segments(self.data_dir, self.site) if s.path.suffix == ".mcap"]
        if not finished:
            return "", ""
        last = finished[-1]
        if last.begin > self._utc:  # a clock was ahead then: the newest is the one that no other file names
            named = {_previous_name(s.path) for s in finished}
            last = next((s for s in reversed(finished) if s.path.name not in named), last)
        with open(last.path, "rb") as file:
            return last.path.name, hashlib.file_digest(file, "sha256").hexdigest()

    # ------------------------------------------------------------------------------------------------------ retention

    def _retain(self) -> None:
        """Delete what is too old, then the oldest while there is too much or too little space is free."""
        self._pruned_ns = self._now_ns
        segments = list_segments(self.data_dir, self.site)
        keep = timedelta(days=self.settings.keep_days)
        if self._utc >= PLAUSIBLE and self._sync and self._now_ns - (self._since_ns or 0) >= BELIEVED_NS:
            for segment in list(segments):
                if PLAUSIBLE <= segment.begin < self._utc - keep:
                    self._delete(segment, f"older than {self.settings.keep_days:g} days")
                    segments.remove(segment)
        total = sum(segment.size for segment in segments) + self.open_bytes
        while segments and total > self.settings.keep_gb * GB:
            segment = segments.pop(0)
            if self._delete(segment, f"more than {self.settings.keep_gb:g} GB of recordings"):
                total -= segment.size
        free = self.free_bytes()
        if free < 0:
            return  # the file system does not say
        limit, why = self.settings.free_gb * GB, f"less than {self.settings.free_gb:g} GB free"
        missing = limit - free
        held = sum(segment.size for segment in segments)
        self._short = missing > held and (self._short or self._tell_short(missing, held))
        if self._short:  # something else fills the disk, or it is smaller: deleting every recording would not help
            limit, why = FLOOR * limit, "the disk is all but full"
        while segments and self.free_bytes() < limit:
            self._delete(segments.pop(0), why)

    def _tell_short(self, missing: float, held: int) -> bool:
        """Clips, or what is not ours, fill the disk; told once until there is room again. True."""
        kept = 0
        with suppress(OSError):
            kept = sum(p.stat().st_size for p in (self.data_dir / "clips").iterdir())
        text = (
            f"{missing / GB:.3g} GB are missing to the {self.settings.free_gb:g} GB that should stay free; all files "
            f"that could be deleted hold {held / GB:.3g} GB, clips, which are never deleted, {kept / GB:.3g} GB: move "
            "clips away, or what else fills the disk"
        )
        self._faults.append(Fault(self._now_ns, "recorder", "SPACE_SHORT", text, (("missing_bytes", missing),)))
        return True

    def _delete(self, segment: Segment, why: str) -> bool:
        try:
            segment.path.unlink()
        except OSError as e:
            self._tell("RETENTION_FAILED", f"{segment.path.name} cannot be deleted: {e.strerror or e}", segment)
            return False
        self._tell("RETENTION", f"{segment.path.name} deleted: {why}", segment)
        return True

    def _tell(self, kind: str, text: str, segment: Segment) -> None:
        self._faults.append(Fault(self._now_ns, "recorder", kind, text, (("bytes", float(segment.size)),)))

    # ---------------------------------------------------------------------------------------------------- disk errors

    def _fail(self, error: OSError) -> RecordingError:
        """Let go of the open file, seal it as far as it goes, and make the error that the caller raises."""
        writer, self._writer = self._writer, None
        unwritten: tuple[Record, ...] = ()
        sealed = ""
        if writer is not None:
            unwritten = writer.pending
            writer.abandon()
            self._previous = None  # its hash is not that of what was written
            sealed = self._seal(writer.path, error.errno == errno.ENOSPC)
        return RecordingError(_reason(error), f"recording stopped: {error}; {sealed}", unwritten)

    def _seal(self, part: Path, full: bool) -> str:
        try:
            if full:  # the index needs some kilobytes: the oldest segment makes room for them
                segments = list_segments(self.data_dir, self.site)
                if segments:
                    self._delete(segments[0], "the disk is full")
            return f"{repair(part).path.name} was sealed"
        except OSError as e:
            return f"{part.name} waits for repair ({e.strerror or e})"


def _previous_name(path: Path) -> str:
    """The file that a recording follows; "" where it does not say. OSError."""
    try:
        return head_metadata(path, RUN_METADATA).get("previous_name", "")
    except DamagedError:
        return ""


def _reason(error: OSError) -> str:
    return {errno.ENOSPC: "full", errno.EDQUOT: "full", errno.EROFS: "read-only"}.get(error.errno or 0, "io")
