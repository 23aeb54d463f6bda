"""Sparse rows and their reductions against loops, in NumPy alone and with SciPy."""

import numpy as np
import pytest

from jaxltl.core.sparse import rows as host_rows
from jaxltl.core.sparse.rows import (
    concatenated_ranges,
    first_action,
    rows_from_dense,
    rows_from_padded,
    some_action,
)

NUM_STATES = 7


def random_lists(rng, wide=False):
    """Padded lists with rows without entries, repeated ones, and nonsense where none is."""
    shape = (12, 300 if wide else 4)
    used = rng.random(shape) < rng.choice([0, 0.4, 0.9, 1.0], (12, 1))
    successor = rng.integers(NUM_STATES, size=shape, dtype=np.int32)
    return np.where(used, successor, -99).astype(np.int32), used


@pytest.mark.parametrize("wide", [False, True])
@pytest.mark.parametrize("large", [-1, 10**9])
def test_reductions_equal_loops(large, wide, monkeypatch):
    monkeypatch.setattr(host_rows, "SCIPY_SIZE", large)
    rng = np.random.default_rng(0)
    for _ in range(20):
        successor, used = random_lists(rng, wide)
        rows = rows_from_padded(successor, used, NUM_STATES)
        lists = [s[u] for s, u in zip(successor, used, strict=True)]
        assert rows.count.tolist() == [len(x) for x in lists]
        region = rng.random(NUM_STATES) < rng.choice([0.0, 0.3, 1.0])
        np.testing.assert_array_equal(
            rows.some_successor_in(region), [region[x].any() for x in lists]
        )
        value = rng.integers(50, size=NUM_STATES)
        least = [value[x].min() if len(x) else 99 for x in lists]
        np.testing.assert_array_equal(rows.least(value, 99), least)
        start, row = rows.predecessors
        for t in range(NUM_STATES):
            into = np.repeat(np.arange(12), [np.sum(x == t) for x in lists])
            np.testing.assert_array_equal(row[start[t] : start[t + 1]], into)


def test_full_lists_and_matrices():
    rng = np.random.default_rng(1)
    successor = rng.integers(NUM_STATES, size=(5, 3), dtype=np.int32)
    rows = rows_from_padded(successor, np.ones((5, 3), bool), NUM_STATES)
    assert rows.successor.tolist() == successor.ravel().tolist()
    assert rows.entry_start.tolist() == [0, 3, 6, 9, 12, 15]
    used = rng.random((4, 2, NUM_STATES)) < 0.3
    rows = rows_from_dense(used)
    region = rng.random(NUM_STATES) < 0.5
    np.testing.assert_array_equal(rows.some_successor_in(region), (used & region).any(-1).ravel())


def test_spans():
    assert concatenated_ranges(np.array([5, 0, 9]), np.array([2, 0, 3])).tolist() == [
        5,
        6,
        9,
        10,
        11,
    ]
    assert concatenated_ranges(np.array([], int), np.array([], int)).tolist() == []


@pytest.mark.parametrize("num_actions", [1, 2, 5, 16, 17, 40])
def test_actions_of_a_mask(num_actions):
    rng = np.random.default_rng(2)
    mask = rng.random((6, 9, num_actions)) < 1 / num_actions
    some, first = first_action(mask)
    np.testing.assert_array_equal(some, mask.any(-1))
    np.testing.assert_array_equal(first, mask.argmax(-1))
    np.testing.assert_array_equal(some_action(mask), some)
    assert first.dtype == np.int32
