"""The order of choices against loops over states."""

import numpy as np
import pytest

from jaxltl.core.sparse import choice_order as choices
from jaxltl.core.sparse.choice_order import choices_of

COUNTS = {
    "none": [],
    "a chain": [1, 1, 1],
    "few": [2, 1, 4, 2, 1, 3],
    "one of many": [1, 2, 900, 1, 3],
    "all of many": [40] * 7,
    "one state": [5],
}


@pytest.mark.parametrize("count", COUNTS.values(), ids=COUNTS)
@pytest.mark.parametrize("slices", ("free", "as it is", "dear"))
@pytest.mark.parametrize("operation", (np.maximum, np.minimum))
def test_optima_and_the_first_that_attains_them(count, slices, operation, monkeypatch):
    if slices != "as it is":  # by rank alone, or all but the first ones by state
        monkeypatch.setattr(choices, "_SLICE", 0 if slices == "free" else 10**9)
        monkeypatch.setattr(choices, "_ENTRY", 0)
    count = np.array(count, np.int32)
    found = choices_of(count)
    assert (found.further.size > 0) == (slices == "dear" and count.max(initial=1) > 1) or (
        slices == "as it is"
    )
    assert sorted(found.order.tolist()) == list(range(count.sum()))
    assert sorted(found.states.tolist()) == list(range(count.size))
    start = count.cumsum() - count
    owner = np.repeat(np.arange(count.size), count)
    assert (found.states[found.owner] == owner[found.order]).all()
    rng = np.random.default_rng(0)
    for levels in (2, 1000):  # with ties, and with next to none
        quantity = rng.integers(0, levels, count.sum()).astype(float)
        best = found.best(quantity[found.order], operation)
        first = found.order[found.first(quantity[found.order], best)]
        for i, s in enumerate(found.states):
            own = quantity[start[s] : start[s] + count[s]]
            assert best[i] == operation.reduce(own)
            assert first[i] == start[s] + np.flatnonzero(own == best[i])[0]


def test_a_state_of_many_choices_takes_no_slice_for_each():
    found = choices_of(np.array([1, 20_000, 2] * 3 + [1] * 1000))
    assert len(found.starts) < 10 and found.further.size < 10
