"""The clock port on clocks that the test moves."""

from __future__ import annotations

from collections.abc import Callable

import pytest

import drivers
from drivers import CODECS, PORTS, clock_port
from drivers.clock_port import ClockPort, clock_pair, kernel_sync, sync_from
from edge_agent.messages import PortSettings, S, Tick

WALL = 1_700_000_000 * S


class Clocks:
    """Stands in for the module `time`: monotonic moves when slept on, and by `cost_ns` at each reading."""

    def __init__(self, mono_ns: int, cost_ns: int = 0) -> None:
        self.mono = mono_ns
        self.cost = cost_ns
        self.wall_offset = WALL
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        self.mono += self.cost
        return self.mono

    def time_ns(self) -> int:
        return self.mono + self.wall_offset

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.mono += round(seconds * S)


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    fake = Clocks(10 * S + 200_000_000)
    monkeypatch.setattr(clock_port, "time", fake)
    monkeypatch.setattr(clock_port, "kernel_sync", lambda: (True, 1234))
    return fake


def ticks(port: ClockPort, reads: int) -> list[tuple[int, Tick]]:
    return [entry for _ in range(reads) for entry in port.read()]


def test_one_tick_at_each_full_second(clocks: Clocks) -> None:
    port = ClockPort(PortSettings("clock", "clock"))
    port.open()
    got = ticks(port, 8)
    assert [t for t, _ in got] == [11 * S, 12 * S, 13 * S, 14 * S]
    assert [tick for _, tick in got] == [Tick(WALL + t, True, 1234) for t, _ in got]
    assert port.counters == {"ticks": 4, "late": 0}


def test_a_read_never_waits_longer_than_half_a_second(clocks: Clocks) -> None:
    port = ClockPort(PortSettings("clock", "clock"))
    port.open()
    assert port.read() == []  # 0.8 s to go
    ticks(port, 5)
    assert max(clocks.slept) <= 0.5


def test_after_a_stall_it_goes_on_at_the_next_second_and_counts_what_passed(clocks: Clocks) -> None:
    port = ClockPort(PortSettings("clock", "clock"))
    port.open()
    ticks(port, 2)
    clocks.mono += 3 * S + 300_000_000
    got = ticks(port, 3)
    assert [t for t, _ in got] == [14 * S + 300_000_000, 15 * S]
    assert port.counters["late"] == 2  # the seconds 12 and 13


def test_a_clock_step_is_handed_on_as_it_is(clocks: Clocks) -> None:
    port = ClockPort(PortSettings("clock", "clock"))
    port.open()
    first = ticks(port, 2)[0]
    clocks.wall_offset += 3600 * S
    second = ticks(port, 2)[0]
    assert second[1].utc_ns - first[1].utc_ns == 3601 * S
    assert second[0] - first[0] == S


def test_the_pair_takes_the_middle_of_the_narrowest_bracket(monkeypatch: pytest.MonkeyPatch) -> None:
    # a thread switch of 1 ms inside of the first bracket, none in the second
    readings = iter([0, 1_000_000, 2_000_000, 2_010_000])
    walls = iter([WALL, WALL + 2_004_000])
    fake = type("Time", (), {"monotonic_ns": lambda self: next(readings), "time_ns": lambda self: next(walls)})()
    monkeypatch.setattr(clock_port, "time", fake)
    assert clock_pair() == (2_005_000, WALL + 2_004_000)


def test_the_pair_gives_up_on_a_busy_core_with_the_best_that_it_saw(monkeypatch: pytest.MonkeyPatch) -> None:
    fake = Clocks(0, cost_ns=60_000)
    monkeypatch.setattr(clock_port, "time", fake)
    mono, wall = clock_pair()
    assert abs(wall - WALL - mono) <= 60_000


@pytest.mark.parametrize(
    ("state", "status", "maxerror_us", "esterror_us", "expected"),
    [
        (0, 0x2001, 500_000, 150, (True, 150_000)),  # chrony: estimate and bound
        (0, 0x2001, 120_000, 0, (True, 120_000_000)),  # systemd-timesyncd sets no estimate
        (5, 0x40, 16_000_000, 16_000_000, (False, 16_000_000_000)),  # never set
        (0, 0x40, 10, 10, (False, 10_000)),  # STA_UNSYNC alone
        (5, 0, 10, 10, (False, 10_000)),  # TIME_ERROR alone
        (1, 0x11, 900, 20, (True, 20_000)),  # a leap second is pending: still synchronised
        (-1, 0, 77, 77, (False, 0)),  # refused by a sandbox
    ],
)
def test_what_adjtimex_says(
    state: int, status: int, maxerror_us: int, esterror_us: int, expected: tuple[bool, int]
) -> None:
    assert sync_from(state, status, maxerror_us, esterror_us) == expected


def no_library(name: object) -> object:
    raise OSError("no C library")


@pytest.mark.parametrize("library", [no_library, lambda name: object()])
def test_without_adjtimex_nothing_is_claimed(
    monkeypatch: pytest.MonkeyPatch, library: Callable[[object], object]
) -> None:
    monkeypatch.setattr("drivers.clock_port.ctypes.CDLL", library)
    assert kernel_sync() == (False, 0)


def test_this_kernel_answers() -> None:
    sync, error_ns = kernel_sync()
    assert isinstance(sync, bool)
    assert error_ns >= 0


def test_the_tables_name_classes_that_exist() -> None:
    assert drivers.load(PORTS, "clock") is ClockPort
    assert {drivers.load(PORTS, kind).__name__ for kind in PORTS} == {"SerialPort", "CanPort", "ClockPort"}
    assert {drivers.load(CODECS, kind).__name__ for kind in CODECS} == {"NmeaCodec", "AccelCodec"}


def test_an_unknown_kind_says_what_there_is() -> None:
    with pytest.raises(ValueError, match="'lora' is not known; there are: can, clock, serial"):
        drivers.load(PORTS, "lora")
