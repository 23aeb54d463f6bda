"""Propagated improvements go all the way, and never make a policy worse."""

import numpy as np
import pytest
from scipy import sparse

from jaxltl.core.sparse.choice_order import choices_of
from jaxltl.core.sparse.linear.optimality_equation import (
    OptimalityEquation,
    propagate_improvements,
)


def improvement(matrix, cost, count, value, policy, sign, threshold):
    """The improved policy, as rows in the order of the states."""
    choices = choices_of(np.asarray(count))
    assert (choices.states == np.arange(len(count))).all()
    order, place = choices.order, np.argsort(choices.order)
    equation = OptimalityEquation(matrix[order], cost[order], 0 * cost, choices, sign)
    least = np.full(value.size, threshold)
    return order[propagate_improvements(equation, value, place[policy], least)]


def value_of(matrix, known, chosen):
    rows = matrix[chosen].toarray()
    return np.linalg.solve(np.eye(len(chosen)) - rows, known[chosen])


def test_along_a_chain_one_call_is_enough():
    """Each state waits at a cost, or goes on to the next; the first of them ends."""
    size = 80
    target, wait = np.arange(size) - 1, 2.0 * size
    matrix = sparse.csr_array(
        (np.ones(size - 1), (2 * np.arange(1, size) + 1, target[1:])), shape=(2 * size, size)
    )
    known = np.where(np.arange(2 * size) % 2 == 0, wait, 1.0)
    chosen = improvement(
        matrix, known, [2] * size, np.full(size, wait), 2 * np.arange(size), -1, 1e-9
    )
    np.testing.assert_array_equal(chosen, 2 * np.arange(size) + 1)


@pytest.mark.parametrize("sign", [1, -1])
def test_no_state_is_worse_off(sign):
    rng = np.random.default_rng(0)
    improved = 0
    for _ in range(40):
        size, most = 12, 3
        rows = rng.dirichlet(np.ones(size), size * most) * (rng.random((size * most, size)) < 0.3)
        matrix, known = sparse.csr_array(0.95 * rows), rng.random(size * most)
        chosen = most * np.arange(size)
        before = value_of(matrix, known, chosen)
        after = improvement(matrix, known, [most] * size, before, chosen, sign, 1e-12)
        np.testing.assert_array_equal(after // most, np.arange(size))
        gain = sign * (value_of(matrix, known, after) - before)
        assert (gain >= -1e-12).all()
        improved += gain.max() > 1e-3
    assert improved > 30
