"""The engine of sparse rows and the padded one enclose the same numbers, with policies as good."""

from fractions import Fraction

import numpy as np
import pytest

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.construct.restrict import restrict, with_allowed
from jaxltl.core.models.mdp import to_dense
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.discounted.discounted import optimal_value, policy_value
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from jaxltl.core.values.undiscounted.total_reward import total_reward
from tests.core.models.test_sparse import random_padded
from tests.support import counts

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


def reachability_agrees(rng, sparse, padded, goal):
    for objective in ("max", "min"):
        ours = reachability_probability(sparse, goal, objective=objective)
        overlap(ours, reachability_probability(padded, goal, objective=objective))
        assert ours.status == Status.CONVERGED
        # What the policy attains is what was promised.
        own = reachability_probability(sparse, goal, policy=ours.policy)
        slack = 1e-12
        if objective == "max":
            assert (own.upper >= ours.lower - slack).all()
        else:
            assert (own.lower <= ours.upper + slack).all()
    weight = rng.random(sparse.num_rows) + 0.01
    total = np.add.reduceat(weight, sparse.row_start[:-1])
    weight = weight / total[sparse.host.state]
    table = np.zeros(padded.available.shape)
    table[sparse.host.state, sparse.action] = weight
    ours = reachability_probability(sparse, goal, policy=weight)
    overlap(ours, reachability_probability(padded, goal, policy=table))


def test_reachability():
    for case in cases(60, 0):
        reachability_agrees(*case)


def test_until_is_the_formula():
    for rng, sparse, padded, goal in cases(25, 1):
        stay = rng.random(sparse.num_states) < 0.7
        sparse = sparse.replace(label=np.stack([stay, goal], -1), propositions=("a", "b"))
        for objective in ("max", "min"):
            until = reachability_probability(sparse, goal, stay=stay, objective=objective)
            formula = optimal_satisfaction(
                sparse, "a U b", objective=objective, states=np.arange(sparse.num_states)
            )
            overlap(until, formula, 1e-12)
            again = reachability_probability(padded, goal, stay=stay, objective=objective)
            overlap(until, again)


FORMULAS = (
    "G F a & G F b",
    "F G a | G F b",
    "F (a & X F b)",
    "G (a -> X b)",
    "F a & G !b",
    "G F a -> G F b",
    "a U (b & X a)",
)


@pytest.mark.few(3)
@pytest.mark.parametrize("formula", FORMULAS)
def test_formulas(formula):
    for _, sparse, padded, _ in cases(8, FORMULAS.index(formula)):
        lazy = product(padded, formula)
        states = np.arange(sparse.num_states)
        for objective in ("max", "min"):
            ours = optimal_satisfaction(sparse, formula, objective=objective, states=states)
            theirs = optimal_satisfaction(lazy, objective=objective)
            automaton, letter = lazy.automaton, np.asarray(lazy.letter)
            memory = np.asarray(automaton.delta)[int(automaton.initial), letter]
            start = theirs.replace(
                **{
                    name: np.asarray(getattr(theirs, name))[states, memory]
                    for name in ("lower", "upper", "value")
                }
            )
            overlap(ours, start)


def test_rewards_are_those_of_every_kind_of_model():
    for rng, sparse, padded, goal in cases(25, 2):
        reward = rng.integers(0, 3, padded.available.shape).astype(float)
        rows = reward[sparse.host.state, sparse.action]
        for objective in ("max", "min"):
            ours = total_reward(sparse, rows, goal, objective=objective)
            assert ours.status == Status.CONVERGED
            for model in (padded, to_dense(padded)):
                overlap(ours, total_reward(model, reward, goal, objective=objective), 1e-9)
            own = total_reward(sparse, rows, goal, policy=ours.policy)
            finite = np.isfinite(ours.upper)
            if objective == "max":
                assert (own.upper[finite] >= ours.lower[finite] * (1 - 1e-9)).all()
                assert np.isinf(own.value[~finite]).all()
            else:
                assert (own.lower[finite] <= ours.upper[finite] * (1 + 1e-9)).all()


@pytest.mark.parametrize("formula", FORMULAS[:4])
@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_lazy_products_of_sparse_worlds(formula, label_on):
    for rng, sparse, padded, _ in cases(4, 10 + FORMULAS.index(formula)):
        ours, theirs = (product(m, formula, label_on=label_on) for m in (sparse, padded))
        np.testing.assert_array_equal(ours.letter, theirs.letter)
        for objective in ("max", "min"):
            best = optimal_satisfaction(ours, objective=objective)
            overlap(best, optimal_satisfaction(theirs, objective=objective))
            own = satisfaction_probability(ours, best.policy)
            if objective == "max":
                assert (own.upper >= best.lower - 1e-12).all()
            else:
                assert (own.lower <= best.upper + 1e-12).all()
        weight = rng.random((sparse.num_rows, ours.num_memory)) + 0.01
        weight /= np.add.reduceat(weight, sparse.row_start[:-1])[sparse.host.state]
        table = np.zeros((*ours.state_shape, padded.num_actions))
        table[sparse.host.state, :, sparse.action] = weight
        overlap(
            satisfaction_probability(ours, weight), satisfaction_probability(theirs, table), 1e-9
        )


@counts(6, 60)  # of each size the padded model's program is another one
def test_discounted_values(count):
    for rng, sparse, padded, _ in cases(count, 4):
        reward = rng.normal(size=padded.available.shape)
        rows = reward[sparse.host.state, sparse.action]
        discount = float(rng.choice([0.0, 0.5, 0.95, 0.999]))
        ours = optimal_value(sparse, rows, discount)
        assert ours.status == Status.CONVERGED
        close(ours, optimal_value(padded, reward, discount), discount)
        own = policy_value(sparse, ours.policy, rows, discount)
        assert (own.upper >= ours.lower - 1e-9 / (1 - discount)).all()
        value = np.zeros(sparse.num_states)
        for _ in range(200):
            image = rows + discount * (sparse.host.matrix @ value)
            value = np.maximum.reduceat(image, sparse.row_start[:-1])
        far = discount**200 * np.abs(rows).max() / (1 - discount) + 1e-9
        assert (ours.lower <= value + far).all()
        assert (value - far <= ours.upper).all()


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


def close(ours, theirs, discount):
    np.testing.assert_allclose(ours.value, theirs.value, atol=1e-7 / (1 - discount), rtol=1e-7)


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
    for rng, sparse, _, _ in cases(60, 3):
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
    assert some > 15


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


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(10))
def test_many(seed):
    for case in cases(5000, 1000 + seed):
        reachability_agrees(*case)
