"""Checkpoint bytes: everything comes back exactly, anything else is refused."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge_agent.state import pack, unpack

LEAF = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(allow_nan=False),
    st.text(max_size=20),
    st.binary(max_size=40),
)
TREE = st.recursive(
    LEAF,
    lambda t: st.one_of(st.lists(t, max_size=4), st.dictionaries(st.text("abc_", max_size=4), t, max_size=4)),
    max_leaves=12,
)


@given(TREE)
def test_a_tree_comes_back_and_packs_the_same_again(tree: object) -> None:
    data = pack(tree)
    assert unpack(data) == tree
    assert pack(unpack(data)) == data


def test_arrays_and_odd_floats_come_back_bit_for_bit() -> None:
    a = np.array([[1.5, -0.0], [math.nan, math.inf]])
    back = unpack(pack({"a": a, "i": np.arange(5), "nan": math.nan, "empty": np.zeros((0, 3))}))
    assert back["a"].tobytes() == a.tobytes()
    assert back["i"].dtype == np.int64
    assert back["empty"].shape == (0, 3)
    assert math.isnan(back["nan"])
    back["a"][0, 0] = 2.0  # fresh and writable


@pytest.mark.parametrize("bad", [object(), {1: 2}, {"$a": 1}, np.array(["x"]), {"s": {1, 2}}])
def test_what_cannot_be_saved_is_refused(bad: object) -> None:
    with pytest.raises(TypeError):
        pack(bad)


@given(st.binary(max_size=200))
def test_garbage_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError):
        unpack(b"EASTATE1" + data if len(data) % 2 else data)


def test_every_cut_is_refused_or_whole() -> None:
    data = pack({"a": np.arange(9), "b": b"xyz", "c": [1, 2.5, None]})
    for n in range(len(data)):
        with pytest.raises(ValueError):
            unpack(data[:n])
