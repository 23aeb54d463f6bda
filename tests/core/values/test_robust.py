"""Interval models of a formula, a reward or a discount: laws, known values and messages."""

import numpy as np
import pytest

from jaxltl.core.models.interval import IntervalMDP, interval_rows, make_interval
from jaxltl.core.models.product import product
from jaxltl.core.models.restrict import restrict, with_allowed
from jaxltl.core.models.sparse import Rewards, make_sparse
from jaxltl.core.types import Status
from jaxltl.core.values.reachability import reachability_probability
from jaxltl.core.values.robust import robust_reachability, robust_total_reward
from jaxltl.core.values.robust_satisfaction import robust_satisfaction
from jaxltl.core.values.satisfaction import optimal_satisfaction
from jaxltl.core.values.sparse_satisfaction import sparse_satisfaction
from jaxltl.core.values.total_reward import total_reward
from tests.reference_intervals import random_model

DIRECTIONS = [("max", "max"), ("max", "min"), ("min", "max"), ("min", "min")]
TASKS = ["F a", "G !b", "!b U a", "G F a", "F G a", "G F a & F G !b", "G (a -> F b)",
         "(G F a -> G F b) & F c", "X X a", "F (a & X b) | G c"]


def labelled(rng, host=None):
    host = random_model(rng) if host is None else host
    mdp = host.mdp
    return interval_rows(
        mdp.row_start, mdp.entry_start, mdp.successor, host.lower, host.upper,
        label=rng.random((mdp.num_states, 3)) < 0.5, propositions=["a", "b", "c"])


def around(model, width):
    """The same model with intervals around its probabilities."""
    p = np.asarray(model.probability)
    return make_interval(model, np.maximum(p - width, 0), np.minimum(p + width, 1))


def test_points_are_the_exact_model():
    rng = np.random.default_rng(0)
    for i in range(20):
        given = labelled(rng).nominal
        model = around(given, 0.0)
        np.testing.assert_array_equal(model.nominal.probability, given.probability)
        task = TASKS[i % len(TASKS)]
        for objective, nature in DIRECTIONS:
            exact = sparse_satisfaction(given, task, objective=objective).solution
            found = robust_satisfaction(model, task, objective=objective, nature=nature).solution
            assert int(found.status) == Status.CONVERGED
            np.testing.assert_allclose(found.value, exact.value, atol=2e-6)


def test_wider_intervals_give_nature_more():
    """Values move apart with the width, and hold the exact ones between them."""
    rng = np.random.default_rng(1)
    for i in range(10):
        given = labelled(rng).nominal
        task = TASKS[i % len(TASKS)]
        for objective in ("max", "min"):
            exact = sparse_satisfaction(given, task, objective=objective).solution
            low = high = exact.value
            for width in (0.05, 0.2, 1.0):
                model = around(given, width)
                least, most = (robust_satisfaction(
                    model, task, objective=objective, nature=nature).solution
                    for nature in ("min", "max"))
                assert int(least.status) == int(most.status) == Status.CONVERGED
                assert (least.lower <= low + 1e-6).all()
                assert (most.upper >= high - 1e-6).all()
                low, high = least.value, most.value


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
            found = optimal_satisfaction(pairs, objective=objective, nature=nature)
            alone = robust_satisfaction(
                model, task, objective=objective, nature=nature, states=np.arange(4)).solution
            assert int(found.status) == Status.CONVERGED
            np.testing.assert_allclose(
                found.value[np.arange(4), start], alone.value, atol=2e-6)


def test_parts_of_interval_models():
    """Fewer rows, and what is reached, keep their ends."""
    model = labelled(np.random.default_rng(8), random_model(np.random.default_rng(8), 6, 3))
    host = model.nominal.host
    first = np.zeros(model.num_rows, bool)
    first[host.row_start[:-1]] = True
    less = with_allowed(model, first)
    chain, entry = model.host.chain(host.row_start[:-1])
    np.testing.assert_array_equal(less.upper, chain.upper)
    np.testing.assert_array_equal(less.lower, model.lower[entry])
    part = restrict(model, np.eye(6)[0], allowed=first)
    target = model.states_where("a")
    for nature in ("min", "max"):
        whole = robust_reachability(model, target, policy=host.row_start[:-1], nature=nature)
        found = robust_reachability(
            part.model, target[np.asarray(part.base_state)], nature=nature)
        np.testing.assert_allclose(
            found.value, whole.value[np.asarray(part.base_state)], atol=1e-6)


def test_policies_are_evaluated():
    rng = np.random.default_rng(2)
    for _ in range(10):
        model = labelled(rng)
        target = model.states_where("a")
        for nature in ("min", "max"):
            best = robust_reachability(model, target, nature=nature)
            own = robust_reachability(model, target, policy=best.policy, nature=nature)
            np.testing.assert_allclose(own.value, best.value, atol=1e-6)
            np.testing.assert_array_equal(own.policy, best.policy)
            other = robust_reachability(
                model, target, policy=model.nominal.host.row_start[:-1], nature=nature)
            assert (other.lower <= best.upper + 1e-12).all()


def test_one_function_takes_both_kinds():
    model = labelled(np.random.default_rng(3))
    target = model.states_where("a")
    for objective, nature in DIRECTIONS:
        np.testing.assert_array_equal(
            reachability_probability(model, target, objective=objective, nature=nature).value,
            robust_reachability(model, target, objective=objective, nature=nature).value)
        np.testing.assert_array_equal(
            total_reward(model, np.ones(4), target, objective=objective, nature=nature).value,
            robust_total_reward(
                model, np.ones(4), target, objective=objective, nature=nature).value)
    with pytest.raises(ValueError, match=r"nature='max'.*intervals"):
        reachability_probability(model.nominal, target, nature="max")


COIN = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])


@pytest.mark.parametrize(("lower", "upper", "message"), [
    ([0.6, 0.3, 1, 1], [0.5, 0.6, 1, 1], r"state 0, choice 0: the interval of successor 1 is "
                                         r"\[0.6, 0.5\]"),
    ([-0.1, 0.3, 1, 1], [0.5, 0.6, 1, 1], r"\[-0.1, 0.5\]"),
    ([0.1, 0.3, 1, 1], [0.5, 1.6, 1, 1], r"\[0.3, 1.6\]"),
    ([0.1, np.nan, 1, 1], [0.5, 0.6, 1, 1], r"\[nan, 0.6\]"),
    ([0.6, 0.5, 1, 1], [0.7, 0.6, 1, 1], "lower ends sum to 1.1, which is above 1"),
    ([0.1, 0.2, 1, 1], [0.3, 0.4, 1, 1], "upper ends sum to 0.7, which is below 1"),
    ([0.1, 0.2, 1], [0.3, 0.4, 1], r"lower has shape \(3,\); expected \(4,\)"),
])
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
    target = [False, True, False]
    with pytest.raises(ValueError, match=r'nature=.adverse.; it must be "min"'):
        robust_reachability(model, target, nature="adverse")
    with pytest.raises(ValueError, match="objective='best'"):
        robust_reachability(model, target, objective="best")
    with pytest.raises(ValueError, match="takes row 3 in state 0, whose rows are 0 to 0"):
        robust_reachability(model, target, policy=[3, 1, 2])
    with pytest.raises(ValueError, match="reward of state 1, choice 0 is -1"):
        robust_total_reward(model, [0, -1, 0], target)
    with pytest.raises(ValueError, match="differs between its successors"):
        robust_total_reward(model, Rewards(transition=np.array([1.0, 2, 0, 0])), target)
