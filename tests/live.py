"""Helpers of tests that run a whole Agent: in-memory ports that play a script, an agent in a thread, reading back."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

from edge_agent import assemble, config, runtime
from edge_agent.messages import Config, Fault, Raw, Tick
from edge_agent.recording import topics
from edge_agent.recording.reader import Stored, read_messages
from edge_agent.recording.segments import Recorder
from edge_agent.simulate import SCENARIOS
from edge_agent.simulate.encode import config_yaml, dbc_text
from edge_agent.simulate.specs import EPOCH_UTC_NS, START_NS

GNSS, CAN, CLOCK = "gnss", "can", "clock"
PATIENCE_S = 300.0
"""How long a test waits for what must come; only a broken program takes so long, no machine however slow or loaded."""


def until(condition: Callable[[], object], what: str, poll_s: float = 0.002) -> None:
    """Wait until `condition` holds."""
    end = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > end:
            raise AssertionError(f"waited {PATIENCE_S:g} s in vain: {what}")
        time.sleep(poll_s)


class ScriptedPort:
    """A port that hands out what the test pushes, in lockstep: `push` returns when the reader has offered it."""

    def __init__(self) -> None:
        self.counters: dict[str, int] = {"opens": 0, "closes": 0}
        self.refuse: deque[OSError] = deque()  # what the next calls of open raise
        self._items: deque[list[tuple[int, Any]] | Exception] = deque()
        self._change = threading.Condition()
        self._handed = False  # something was handed out and the reader has not come back for more

    def open(self) -> None:
        self.counters["opens"] += 1
        if self.refuse:
            raise self.refuse.popleft()

    def read(self) -> list[tuple[int, Any]]:
        with self._change:
            self._handed = False
            self._change.notify_all()
            if not self._items:
                self._change.wait(0.05)
            if not self._items:
                return []
            self._handed = True
            item = self._items.popleft()
        if isinstance(item, Exception):
            raise item
        return item

    def close(self, silently: bool = False) -> None:
        self.counters["closes"] += 1

    def push(self, *items: tuple[int, Any]) -> None:
        """One read's worth."""
        with self._change:
            self._items.append(list(items))
            self._change.notify_all()
            done = self._change.wait_for(lambda: not self._items and not self._handed, PATIENCE_S)
        if not done:
            raise AssertionError("nobody reads this port")

    def fail(self, error: Exception) -> None:
        """The next read raises."""
        with self._change:
            self._items.append(error)
            self._change.notify_all()


def settings(folder: Path, *sets: str) -> Config:
    """The simulator's clean bridge, recorded below `folder`."""
    text = config_yaml(SCENARIOS["clean"], dbc="a.dbc", site="site", data_dir="rec")
    dbc = dbc_text(SCENARIOS["clean"]).encode()
    return config.parse(text, folder, lambda name: dbc, ["record.free_gb=0", "record.flush_s=0.05", *sets])


def ports() -> dict[str, ScriptedPort]:
    """Its ports."""
    return {GNSS: ScriptedPort(), CAN: ScriptedPort(), CLOCK: ScriptedPort()}


def tick(t_ns: int) -> Raw:
    """What its clock says at a monotonic time."""
    return Raw(t_ns, 0, CLOCK, Tick(t_ns - START_NS + EPOCH_UTC_NS, True, 0))


class Live:
    """An Agent in a thread. Leaving the context stops it and raises what it raised."""

    def __init__(
        self,
        settings: Config,
        ports: Mapping[str, Any],
        *,
        free_bytes: Callable[[], int] = lambda: 1 << 40,
        run_id: str = "test",
        found: Sequence[Fault] = (),
        make_recorder: Callable[..., Recorder] = Recorder,
        status_dir: Path | None = None,
        make_port: Callable[[str], Any] | None = None,
        now: Callable[[], int] = lambda: 0,
    ) -> None:
        """`now` decides what hangs; by default its time stands still, so that a slow machine is no fault."""
        data_dir = Path(settings.data_dir)
        data_dir.mkdir(parents=True, exist_ok=True)
        attachments = {"config.yaml": settings.text.encode(), **dict(settings.files)}
        recorder = make_recorder(
            data_dir, settings.record, settings.site, runtime.run_metadata(settings, run_id), attachments, free_bytes
        )
        self.said: list[str] = []
        pipeline = assemble.pipeline(settings)
        self.agent = runtime.Agent(
            settings, pipeline, ports, recorder, self.said.append, None, status_dir, make_port, now
        )
        self.ports = ports
        self.put = {"inbox": 0, "outbox": 0}
        self.taken = {"inbox": 0, "outbox": 0}
        self._lock = threading.Lock()  # readers and main put into one queue
        self._count(self.agent.inbox, self.agent, "_arrived", "inbox")
        self._count(self.agent.outbox, self.agent.writer, "_one", "outbox")
        self.failure: BaseException | None = None
        self._found = found
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _count(self, queue: Any, taker: Any, method: str, name: str) -> None:
        """Count what goes into a queue and what has been dealt with, so that a test can wait for both to be equal."""
        put, take = queue.put, getattr(taker, method)

        def counted_put(*args: Any) -> bool:
            with self._lock:
                good = put(*args)
                self.put[name] += good
            return bool(good)

        def counted_take(*args: Any) -> None:
            take(*args)
            self.taken[name] += 1

        queue.put = counted_put
        setattr(taker, method, counted_take)

    def _run(self) -> None:
        try:
            self.agent.run(self._found)
        except BaseException as e:  # noqa: BLE001 - raised again where the test leaves the context
            self.failure = e

    def __enter__(self) -> Live:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.agent.stop.set()
        self._thread.join(PATIENCE_S)
        for late in (self.agent.publisher, self.agent.clips):  # for which the agent itself waits seconds only
            if late is not None and late.ident is not None:
                late.join(PATIENCE_S)
        if error is None:
            if self.failure is not None:
                raise self.failure
            assert not self._thread.is_alive()

    def play(self, raws: Iterable[Raw], *, step: bool = False) -> None:
        """Push each Raw's payload into the port of its source, in order. `step`: main has dealt with each before the
        next comes."""
        for raw in raws:
            self.ports[raw.source].push((raw.t_ns, raw.payload))
            if step:
                self.stepped()

    def _idle(self, name: str) -> bool:
        with self._lock:  # what is in the queue is counted
            return self.taken[name] == self.put[name]

    def stepped(self) -> None:
        """Wait until main has dealt with everything that came."""
        until(lambda: self._idle("inbox"), "an idle main thread")

    def offered(self, port: str) -> tuple[int, int]:
        """(blocks, bytes) of a port that its reader has put into the inbox, or had to drop."""
        account = self.agent.accounts[port]
        with account.lock:  # in which a reader counts a block and puts it
            return account.received, account.bytes

    def crash(self) -> BaseException:
        """Wait until the agent has ended by itself; what it raised, which is then settled."""
        until(lambda: self.failure, "the agent's end")
        failure, self.failure = self.failure, None
        assert failure is not None
        return failure

    def balance(self) -> dict[str, str]:
        """After the end: ports whose account does not balance, or says something else than the files do."""
        return unbalanced(self.agent)

    def settle(self) -> None:
        """Wait until main and the writer have dealt with everything that came."""
        self.stepped()
        until(lambda: self._idle("outbox"), "an idle writer")


def parse(text: str, folder: Path, files: Mapping[str, bytes] | None = None) -> Config:
    """A configuration whose files are given; its data_dir is relative to `folder`."""
    return config.parse(text, folder, None if files is None else lambda name: files[name])


def recordings(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.name.endswith((".mcap", ".mcap.part")))


def stored(files: Iterable[Path], *wanted: str) -> list[Stored]:
    """Messages of the topics in file order, all if none is named."""
    return [s for f in files for s in read_messages(f, set(wanted) or None)]


def decoded(files: Iterable[Path], topic: str) -> list[dict[str, Any]]:
    return [topics.decode(s.schema, s.data) for s in stored(files, topic)]


def faults(files: Iterable[Path], kind: str = "") -> list[dict[str, Any]]:
    return [f for f in decoded(files, "/faults") if not kind or f["kind"] == kind]


def values(event: Mapping[str, Any]) -> dict[str, float]:
    return {v["name"]: v["value"] for v in event["values"]}


def raws(files: Iterable[Path]) -> list[Raw]:
    """Every raw block of the files, in file order."""
    found = [s for s in stored(files) if s.topic.startswith("/raw/") and s.topic != "/raw/checkpoint"]
    return [topics.decode_raw(s.topic, s.schema, s.data) for s in found]


def unbalanced(agent: runtime.Agent) -> dict[str, str]:
    """Ports of an agent that has ended whose account does not balance, or says something else than the files do."""
    there = [r.source for r in raws(recordings(agent.recorder.data_dir))]
    wrong = {}
    for name, a in agent.accounts.items():
        if a.received != a.written + a.dropped + a.refused + a.lost or a.written != there.count(name):
            said = f"received {a.received}, written {a.written}, dropped {a.dropped}, refused {a.refused}"
            wrong[name] = f"{said}, lost {a.lost}; in the files {there.count(name)}"
    return wrong


def ledgers(files: Iterable[Path]) -> dict[str, dict[str, int]]:
    """The last /diagnostics: port -> its account."""
    last = decoded(files, "/diagnostics")[-1]
    return {
        s["name"].removeprefix("port/"): {v["key"]: int(v["value"]) for v in s["values"]}
        for s in last["status"]
        if s["name"].startswith("port/")
    }
