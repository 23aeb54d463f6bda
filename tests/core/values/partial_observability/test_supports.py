"""Winning supports of beliefs: against definitions on small models, and controllers inside the shield."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.partial_observability.solve import belief_bounds
from jaxltl.core.values.partial_observability.supports import support_shield

from .reference import controller_values, random_pomdp


def uniform(pomdp):
    weight = pomdp.available / np.maximum(pomdp.available.sum(1, keepdims=True), 1)
    count = pomdp.num_observations
    return jl.FiniteMemoryPolicy(weight[:, None], np.zeros(count, int), np.zeros((count, 1), int))


@pytest.mark.parametrize("seed", range(12))
def test_almost_sure_reachability(seed):
    pomdp, table = random_pomdp(seed)
    shield = support_shield(pomdp, "goal")
    best = controller_values(pomdp, table, len(table) - 2)[0].max()
    if best > 1 - 1e-9:
        assert shield.is_winning
    if not shield.is_winning:
        assert shield.pomdp is None
        assert float(belief_bounds(pomdp, "goal", max_beliefs=60).lower) < 1
        return
    # Inside the shield every action keeps the target reachable, so all of them at random reach it.
    value = jl.reachability_probability(shield.pomdp, "goal", policy=uniform(shield.pomdp))
    assert float(value.lower) > 1 - 1e-6


@pytest.mark.parametrize("seed", range(12))
def test_safety(seed):
    pomdp, table = random_pomdp(seed)
    shield = support_shield(pomdp, safe="!sink")
    least = belief_bounds(pomdp, "sink", objective="min", max_beliefs=60, tolerance=1e-6)
    if shield.is_winning:
        assert float(least.lower) == 0
        value = jl.reachability_probability(shield.pomdp, "sink", policy=uniform(shield.pomdp))
        assert float(value.upper) == 0
    else:
        assert float(least.upper) > 0
        best = controller_values(pomdp, table, len(table) - 1)[0].min()
        assert best > 0


def test_wrong_questions():
    pomdp, _ = random_pomdp(0)
    with pytest.raises(ValueError, match="target"):
        support_shield(pomdp)
    with pytest.raises(ValueError, match="max_supports"):
        support_shield(pomdp, "goal", max_supports=1)
