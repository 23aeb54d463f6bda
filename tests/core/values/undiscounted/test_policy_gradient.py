"""Policy gradients of the satisfaction probability, against certified values and differences."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.undiscounted.mixture import at_starts
from jaxltl.core.values.undiscounted.policy_gradient import FullSupport
from tests.algos.test_guaranteed import A, Q, S, random_automaton, random_world


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", ["cosafe", "safety", "buchi", "parity"])
def test_probability_and_slope_agree_with_certified_values(kind):
    rng, between = np.random.default_rng(7), 0
    for _ in range(10):
        label_on = rng.choice(["entry", "exit"])
        model = jl.product(random_world(rng), random_automaton(rng, kind), label_on=label_on)
        first, second = (
            np.asarray(model.available) * rng.dirichlet(np.ones(A), (S, Q)) for _ in range(2)
        )
        first, second = (x / x.sum(-1, keepdims=True) for x in (first, second))
        over = rng.choice(["mean", "worst"])
        soft = FullSupport(model, over)
        found, slope = soft.probability(first)
        exact = jl.satisfaction_probability(model, first, tolerance=1e-10)
        assert found == pytest.approx(at_starts(model, exact.value, over)[0], abs=1e-9)
        step = 1e-5
        ahead, behind = (soft.probability(first + h * (second - first))[0] for h in (step, -step))
        difference = (ahead - behind) / (2 * step)
        assert np.sum(slope * (second - first)) == pytest.approx(difference, abs=1e-7)
        between += 1e-6 < found < 1 - 1e-6
    assert between >= 3
