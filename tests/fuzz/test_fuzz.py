"""Every parser against its corpus (what the fuzzer once found) and some fresh mutations of good input."""

from __future__ import annotations

import random

import fuzz
import pytest

ROUNDS = {
    "frames": 40,
    "dbc": 15,
    "load": 25,
    "adopt": 40,
    "yaml": 60,
    "mcap": 60,
    "slcan": 60,
    "path": 40,
    "log": 60,
    "status": 60,
}


@pytest.mark.parametrize("name", sorted(fuzz.TARGETS))
def test_spoilt_input_is_refused_as_promised(name: str) -> None:
    target = fuzz.TARGETS[name]
    rng = random.Random(name)
    pool = target.seeds()
    inputs = [*pool, *(path.read_bytes() for path in fuzz.corpus(name))]
    inputs += [fuzz.mutate(rng, pool) for _ in range(ROUNDS.get(name, 200))]
    for data in inputs:
        _, finding = fuzz.try_one(target, data)
        assert not finding or finding.startswith("took"), f"{data[:400]!r}: {finding}"  # how long is for fuzz.py


def test_the_fuzzer_notices(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error that is not promised, and a behaviour that is new."""

    def fragile(data: bytes) -> int:
        if b"$" in data:
            raise KeyError("dollar")
        return len(data) % 3

    target = fuzz.Target(fragile, lambda: [b"abc"], (ValueError,))
    assert fuzz.try_one(target, b"abcd") == (1, "")
    assert "KeyError: 'dollar'" in fuzz.try_one(target, b"a$")[1]
    assert fuzz.try_one(fuzz.Target(int, list, (ValueError,)), b"x")[1] == ""
    rng = random.Random(1)
    assert any(fuzz.try_one(target, fuzz.mutate(rng, [b"abc"]))[1] for _ in range(300))
