"""The engine of sparse rows and the padded one enclose the same numbers, with policies as good."""

from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.construct.restrict import restrict, with_allowed
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.values.discounted.discounted import policy_value
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.total_reward import total_reward
from tests.core.models.test_sparse import random_padded

ROUNDING = 1e-12  # of the policies


def overlap(one, other, slack=ROUNDING):
    """Two enclosures of one number meet."""
    lower = np.maximum(np.asarray(one.lower, float).ravel(), np.asarray(other.lower, float).ravel())
    upper = np.minimum(np.asarray(one.upper, float).ravel(), np.asarray(other.upper, float).ravel())
    finite = np.isfinite(upper)
    assert (np.isinf(lower) == ~finite).all()
    assert (lower[finite] <= upper[finite] + slack * np.maximum(upper[finite], 1)).all()


def cases(count, seed):
    rng = np.random.default_rng(seed)
    for i in range(count):
        sparse = to_sparse(random_padded(rng, int(rng.integers(2, 12)), 1 + i % 3, 1 + i % 3))
        goal = rng.random(sparse.num_states) < 0.2
        yield rng, sparse, to_padded(sparse), goal


def test_policies_of_many_choices_are_enclosed():
    """What a sum over choices loses counts too: here most of what they add up to."""
    count = 20_000
    weight = np.full(count + 2, 2.5e-17)
    weight[0], weight[-1] = 0.5, 0.5
    successor = np.concatenate([np.ones(count + 1, int), [2], [1, 2]])
    model = make_sparse(
        [0, count + 2, count + 3, count + 4], np.arange(count + 5), successor, np.ones(count + 4)
    )
    policy = np.concatenate([weight, [1, 1]])
    exact = [Fraction(float(w)) for w in weight]
    share = sum(exact[:-1]) / sum(exact)
    goal = np.array([False, True, False])
    found = reachability_probability(model, goal, policy=policy)
    assert Fraction(float(found.lower[0])) <= share <= Fraction(float(found.upper[0]))
    reward = np.concatenate([np.ones(count + 1), [0, 0, 0]])
    for target in (~np.array([True, False, False]), None):
        earned = total_reward(model, reward, target, policy=policy)
        assert Fraction(float(earned.lower[0])) <= share <= Fraction(float(earned.upper[0]))
    value = policy_value(model, policy, reward, 0.5)
    assert Fraction(float(value.lower[0])) <= share <= Fraction(float(value.upper[0]))


def test_restricted_models():
    for rng, sparse, padded, goal in cases(20, 5):
        start = np.zeros(sparse.num_states)
        start[rng.integers(sparse.num_states)] = 1
        ours, theirs = restrict(sparse, start), restrict(padded, start)
        np.testing.assert_array_equal(ours.base_state, theirs.base_state)
        theirs = to_sparse(theirs.model)
        np.testing.assert_array_equal(ours.model.row_start, theirs.row_start)
        np.testing.assert_array_equal(ours.model.successor, theirs.successor)
        np.testing.assert_array_equal(ours.model.action, theirs.action)
        np.testing.assert_allclose(ours.model.probability, theirs.probability, atol=1e-6)
        rows = np.zeros(sparse.num_rows, bool)
        rows[sparse.host.row_start[:-1]] = True
        first = with_allowed(sparse, rows)
        assert first.is_chain
        overlap(
            reachability_probability(first, goal),
            reachability_probability(
                sparse, goal, policy=np.asarray(sparse.action)[sparse.row_start[:-1]]
            ),
            1e-12,
        )


def test_rewards_for_ever():
    """Against the sum of so many steps that little is left to earn, where it is finite."""
    some = 0
    for rng, sparse, _, _ in cases(20, 3):
        rows = rng.integers(0, 2, sparse.num_rows) * (rng.random(sparse.num_rows) < 0.4)
        host = sparse.host
        for objective, best in (("max", np.maximum), ("min", np.minimum)):
            found = total_reward(sparse, rows.astype(float), objective=objective)
            value = np.zeros(host.num_states)
            for _ in range(3000):
                value = best.reduceat(rows + host.matrix @ value, host.row_start[:-1])
            finite = np.isfinite(found.upper)
            assert (value[finite] <= found.upper[finite] * (1 + 1e-9) + 1e-9).all()
            assert (value[finite] >= found.lower[finite] * (1 - 1e-6) - 1e-6).all()
            assert (value[~finite] > 10).all()
            some += (found.value[finite] > 0).any()
    assert some > 5


def test_what_is_wrong_is_named():
    _, sparse, padded, goal = next(cases(1, 0))
    with pytest.raises(ValueError, match=r"at least 0"):
        total_reward(sparse, -np.ones(sparse.num_rows), goal)
    with pytest.raises(ValueError, match=r"takes action .* in state 0"):
        reachability_probability(
            sparse, goal, policy=np.full(sparse.num_states, sparse.num_rows - 1, np.int32)
        )
    with pytest.raises(ValueError, match="policy has shape"):
        reachability_probability(sparse, goal, policy=np.ones(3 + sparse.num_rows))
    with pytest.raises(ValueError, match="sums to"):
        reachability_probability(sparse, goal, policy=np.full(sparse.num_rows, 0.9))
    with pytest.raises(ValueError, match="named rewards"):
        total_reward(padded, "steps", goal)
    with pytest.raises(ValueError, match="there is no reward 'steps'"):
        total_reward(sparse, "steps", goal)
