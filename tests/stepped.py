"""An Agent without threads: readers, main and writer get their turns from the test, in simulated time.

What is said to be too slow is slow by the number of items that it takes, so nothing depends on the machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from live import recordings, stored, unbalanced

from edge_agent import assemble, runtime
from edge_agent.messages import Config, Raw
from edge_agent.reading import Reader
from edge_agent.recording.segments import Recorder
from edge_agent.writing import Keep


class Stepped:
    """`offer` is what a port has read, `main` and `write` are turns of the two threads. `most`: the largest that each
    buffer has been, in the bytes of its own account."""

    def __init__(
        self, settings: Config, *, free_bytes: Callable[[], int] = lambda: 1 << 40, run_id: str = "test"
    ) -> None:
        self.settings, self.data_dir = settings, Path(settings.data_dir)
        self.data_dir.mkdir(parents=True, exist_ok=True)
        attachments = {"config.yaml": settings.text.encode(), **dict(settings.files)}
        metadata = runtime.run_metadata(settings, run_id)
        self.recorder = Recorder(self.data_dir, settings.record, settings.site, metadata, attachments, free_bytes)
        self.said: list[str] = []
        self.now_ns = 0
        ports: dict[str, Any] = {n: SimpleNamespace(counters={}) for n in (*settings.ports, "clock")}
        self.agent = runtime.Agent(
            settings, assemble.pipeline(settings), ports, self.recorder, self.said.append, now=lambda: self.now_ns
        )
        self.writer = self.agent.writer
        self.readers: dict[str, Reader] = self.agent.readers
        self.most = {"inbox": 0, "outbox": 0, "ring": 0}
        self.checked: list[str] = []  # what the ledger of each turn could not account for
        self.came = 0  # items that main has put into the outbox
        put = self.agent.outbox.put

        def counted(*args: Any) -> bool:
            good = put(*args)
            self.came += good
            return good

        self.agent.outbox.put = counted  # type: ignore[method-assign]

    def offer(self, *some: Raw) -> None:
        """The ports have read these; time has come to them."""
        for raw in some:
            self.now_ns = max(self.now_ns, raw.t_ns)
            self.readers[raw.source]._offer(raw.t_ns, raw.payload)
            self._measure()

    def main(self, most: int = 1 << 60) -> int:
        """Main deals with up to `most` arrivals; how many they were."""
        done = 0
        if most > 0 and len(self.agent.inbox):
            for arrival in self.agent.inbox.take(0.0, 0):
                self.agent._arrived(arrival)
                self._measure()
                done += 1
                if done == most:
                    break
        self.checked += [f"{n}: {p}" for n, p in self.agent._pages().items() if p.unaccounted]
        return done

    def write(self, most: int = 1 << 60) -> int:
        """The writer deals with up to `most` items, and with what is due; how many they were."""
        done = 0
        if most > 0 and len(self.agent.outbox):
            for item in self.agent.outbox.take(0.0, 0):
                self.writer._one(item, self.now_ns)
                self._measure()
                done += 1
                if done == most:
                    break
        self.writer._due(self.now_ns)
        self.writer.busy_ns = 0
        self._measure()
        return done

    def play(self, script: Iterable[Raw]) -> None:
        """Everybody keeps up."""
        for raw in script:
            self.offer(raw)
            self.main()
            self.write()

    def close(self) -> None:
        """An orderly stop, as `Agent._run` and `Writer.run` do it."""
        self.main()
        for record in self.agent.pipeline.finish():
            self.agent._put(record)
        self.agent._tell_losses()
        self.agent._put(Keep(self.agent.pipeline.slow()))
        self.agent.say(runtime.INFO, "stopped")
        self.write()
        self.writer._end(self.now_ns)
        self.writer._close_books()
        self.agent._losses.close()

    def _measure(self) -> None:
        for name, size in (
            ("inbox", self.agent.inbox.bytes),
            ("outbox", self.agent.outbox.bytes),
            ("ring", self.writer.ring_bytes),
        ):
            self.most[name] = max(self.most[name], size)

    def within_bounds(self, largest: int) -> bool:
        """Whether no buffer was ever above its bound; `largest` = bytes of the largest block with its derived records,
        which may come on top of the outbox since raw data is weighed before it is stepped."""
        r = self.settings.record
        outbox = self.agent.outbox.limit_bytes + runtime.RESERVE_BYTES + largest
        return (
            self.most["inbox"] <= r.inbox_mb * 1e6
            and self.most["outbox"] <= outbox
            and self.most["ring"] <= r.ring_mb * 1e6
        )

    def files(self) -> list[Path]:
        return recordings(self.data_dir)

    def balance(self) -> dict[str, str]:
        """Ports whose account does not balance, or says something else than the files do; after `close`."""
        return unbalanced(self.agent)


def estimates(files: Iterable[Path]) -> list[tuple[str, int, bytes]]:
    """Every block of the fused stream that the files hold, in order."""
    found = [s for s in stored(files) if s.topic.startswith("/fusion/") and s.topic.endswith("/block")]
    return [(s.topic, s.publish_ns, s.data) for s in found]
