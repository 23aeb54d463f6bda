"""Interval models of a formula, a reward or a discount: laws, known values and messages."""

import numpy as np
import pytest

from jaxltl.core.models.construct.restrict import restrict, with_allowed
from jaxltl.core.models.interval import IntervalMDP, interval_rows, make_interval
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.interval.robust import robust_expectation
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from jaxltl.core.values.undiscounted.total_reward import total_reward
from tests.reference_intervals import random_model
from tests.support import nature_word

DIRECTIONS = [("max", "max"), ("max", "min"), ("min", "max"), ("min", "min")]
TASKS = [
    "F a",
    "G !b",
    "!b U a",
    "G F a",
    "F G a",
    "G F a & F G !b",
    "G (a -> F b)",
    "(G F a -> G F b) & F c",
    "X X a",
    "F (a & X b) | G c",
]


def labelled(rng, host=None):
    host = random_model(rng) if host is None else host
    mdp = host.mdp
    return interval_rows(
        mdp.row_start,
        mdp.entry_start,
        mdp.successor,
        host.lower,
        host.upper,
        label=rng.random((mdp.num_states, 3)) < 0.5,
        propositions=["a", "b", "c"],
    )


def around(model, width):
    """The same model with intervals around its probabilities."""
    p = np.asarray(model.probability)
    return make_interval(model, np.maximum(p - width, 0), np.minimum(p + width, 1))


@pytest.mark.few(1)
@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_products(label_on):
    """From every memory, whether letters are read on entry or on exit."""
    rng = np.random.default_rng(7)
    for task in TASKS:
        model = labelled(rng)
        pairs = product(model, task, label_on=label_on)
        start = pairs.automaton.initial
        if label_on == "entry":
            start = np.asarray(pairs.automaton.delta)[start, np.asarray(pairs.letter)]
        for objective, nature in DIRECTIONS:
            found = optimal_satisfaction(
                pairs, objective=objective, nature=nature_word(objective, nature)
            )
            alone = optimal_satisfaction(
                model,
                task,
                objective=objective,
                nature=nature_word(objective, nature),
                states=np.arange(4),
            )
            assert int(found.status) == Status.CONVERGED
            np.testing.assert_allclose(found.value[np.arange(4), start], alone.value, atol=2e-6)


@pytest.mark.few(1)
@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_policies_of_products(label_on):
    """The best policy is worth what it is worth; points are exact models, mixtures too."""
    rng = np.random.default_rng(12)
    for task in TASKS:
        model = labelled(rng)
        pairs = product(model, task, label_on=label_on)
        points = product(
            make_interval(model.nominal, *[model.nominal.probability] * 2), task, label_on=label_on
        )
        exact = product(model.nominal, task, label_on=label_on)
        host = model.nominal.host
        weight = rng.random((host.num_rows, pairs.num_memory))
        weight /= np.add.reduceat(weight, host.row_start[:-1])[host.state]
        alone = satisfaction_probability(exact, weight).value
        np.testing.assert_allclose(satisfaction_probability(points, weight).value, alone, atol=2e-6)
        for nature in ("min", "max"):
            best = optimal_satisfaction(pairs, nature=nature_word("max", nature))
            if nature == "min":  # else nature, too, has to keep to what attains it
                own = satisfaction_probability(
                    pairs, best.policy, nature=nature_word("max", nature)
                )
                np.testing.assert_allclose(own.value, best.value, atol=2e-6)
            found = satisfaction_probability(pairs, weight, nature=nature_word("max", nature))
            assert int(found.status) == Status.CONVERGED
            side = 1 if nature == "max" else -1
            assert (side * (found.value - alone) >= -2e-6).all()
            assert (found.lower <= best.upper + 1e-9).all()


def test_parts_of_interval_models():
    """Fewer rows, and what is reached, keep their ends."""
    model = labelled(np.random.default_rng(8), random_model(np.random.default_rng(8), 6, 3))
    host = model.nominal.host
    first = np.zeros(model.num_rows, bool)
    first[host.row_start[:-1]] = True
    less = with_allowed(model, first)
    chain, entry = model.host.under_policy(host.row_start[:-1])
    np.testing.assert_array_equal(less.upper, chain.upper)
    np.testing.assert_array_equal(less.lower, model.lower[entry])
    part = restrict(model, np.eye(6)[0], allowed=first)
    target = model.states_with_label("a")
    for nature in ("min", "max"):
        whole = reachability_probability(
            model, target, policy=np.zeros(6, int), nature=nature_word("max", nature)
        )
        found = reachability_probability(
            part.model, target[np.asarray(part.base_state)], nature=nature_word("max", nature)
        )
        np.testing.assert_allclose(found.value, whole.value[np.asarray(part.base_state)], atol=1e-6)


def test_mixed_policies():
    """A policy that mixes rows is as good as the one that its coin makes of them."""
    rng = np.random.default_rng(9)
    for _ in range(10):
        model = labelled(rng)
        host = model.nominal.host
        weight = rng.random(host.num_rows)
        weight /= np.add.reduceat(weight, host.row_start[:-1])[host.state]
        target = model.states_with_label("a")
        points = make_interval(model.nominal, *[model.nominal.probability] * 2)
        alone = reachability_probability(model.nominal, target, policy=weight)
        np.testing.assert_allclose(
            reachability_probability(points, target, policy=weight).value, alone.value, atol=1e-6
        )
        low, high = (
            reachability_probability(
                model, target, policy=weight, nature=nature_word("max", nature)
            )
            for nature in ("min", "max")
        )
        assert (low.lower <= alone.upper).all()
        assert (high.upper >= alone.lower).all()
        p = np.asarray(high.nature)
        assert ((model.lower - 1e-15 <= p) & (p <= model.upper + 1e-15)).all()
        again = reachability_probability(
            model.nominal.replace(probability=p), target, policy=weight
        )
        np.testing.assert_allclose(again.value, high.value, atol=1e-6)


COIN = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])


@pytest.mark.parametrize(
    ("lower", "upper", "message"),
    [
        (
            [0.6, 0.3, 1, 1],
            [0.5, 0.6, 1, 1],
            r"state 0, choice 0: the interval of successor 1 is "
            r"\[0.6, 0.5\]",
        ),
        ([-0.1, 0.3, 1, 1], [0.5, 0.6, 1, 1], r"\[-0.1, 0.5\]"),
        ([0.1, 0.3, 1, 1], [0.5, 1.6, 1, 1], r"\[0.3, 1.6\]"),
        ([0.1, np.nan, 1, 1], [0.5, 0.6, 1, 1], r"\[nan, 0.6\]"),
        ([0.6, 0.5, 1, 1], [0.7, 0.6, 1, 1], "lower ends sum to 1.1, which is above 1"),
        ([0.1, 0.2, 1, 1], [0.3, 0.4, 1, 1], "upper ends sum to 0.7, which is below 1"),
        ([0.1, 0.2, 1], [0.3, 0.4, 1], r"lower has shape \(3,\); expected \(4,\)"),
    ],
)
def test_ends_without_a_distribution(lower, upper, message):
    with pytest.raises(ValueError, match=message):
        make_interval(COIN, lower, upper)


def test_entries_without_mass_are_left_out():
    model = make_interval(COIN, [1, 0, 1, 1], [1, 0.5, 1, 1])
    assert model.nominal.successor.tolist() == [1, 1, 2]
    assert isinstance(model, IntervalMDP)


def test_one_successor_twice():
    model = interval_rows(None, [0, 3, 4], [1, 0, 1, 1], [0.1, 0.2, 0.1, 1], [0.3, 0.6, 0.3, 1])
    assert model.nominal.successor.tolist() == [0, 1, 1]
    np.testing.assert_allclose(model.lower, [0.2, 0.2, 1])
    np.testing.assert_allclose(model.upper, [0.6, 0.6, 1])


def test_bad_questions():
    model = make_interval(COIN, [0.1, 0.2, 1, 1], [0.8, 0.9, 1, 1])
    with pytest.raises(ValueError, match=r"IntervalMDP takes no intervals; .*its nominal one"):
        make_interval(model, [0.1, 0.2, 1, 1], [0.8, 0.9, 1, 1])
    target = [False, True, False]
    with pytest.raises(ValueError, match="nature='adverse'; choose one of adversarial"):
        reachability_probability(model, target, nature="adverse")
    for tolerance in (float("nan"), -1.0, "fine"):
        with pytest.raises(ValueError, match=r"tolerance=.*at least 0"):
            reachability_probability(model, target, tolerance=tolerance)
    for discount in (None, 1.0, [0.5]):
        with pytest.raises(ValueError, match=r"discount=.*below 1"):
            optimal_value(model, [0, 1, 0], discount)
    with pytest.raises(ValueError, match="SparseMDP has no intervals; give an IntervalMDP"):
        robust_expectation(COIN, [0, 1, 0])
    with pytest.raises(ValueError, match="not finite"):
        robust_expectation(model, [0, np.nan, 0])
    with pytest.raises(
        ValueError, match=r"target is \[0, 2, 0\]; give bool\[3\], one for each state\."
    ):
        reachability_probability(model, [0, 2, 0])
    with pytest.raises(ValueError, match="objective='best'"):
        reachability_probability(model, target, objective="best")
    with pytest.raises(ValueError, match=r"policy takes action 3 in state 0.*one of \[0\]"):
        reachability_probability(model, target, policy=[3, 1, 2])
    with pytest.raises(ValueError, match="reward of state 1, choice 0 is -1"):
        total_reward(model, [0, -1, 0], target)
    with pytest.raises(ValueError, match="differs between its successors"):
        total_reward(model, Rewards(transition=np.array([1.0, 2, 0, 0])), target)


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ([3], r"states has 3; the states are 0 to 2"),
        ([0, -1], r"states has -1"),
        ([True, False, True], r"states is bool\[3\]"),
        ([0.0], "states is float64"),
        ([], "at least one"),
    ],
)
def test_states_that_are_none(states, message):
    coin = make_sparse(
        None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1], initial=[1, 0, 0], label={"a": [1]}
    )
    model = make_interval(coin, coin.probability, coin.probability)
    for of in (model, coin):
        with pytest.raises(ValueError, match=message):
            optimal_satisfaction(of, "F a", states=states)
