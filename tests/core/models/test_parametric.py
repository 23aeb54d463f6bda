"""Models over a box of parameters: numbers, boxes, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.tree_util import Partial

from jaxltl.core.models.parametric import make_parametric
from jaxltl.core.models.sparse import Rewards, make_sparse


def triangle():
    """Three ways on from state 0, to states that stay."""
    return make_sparse(
        None,
        [0, 3, 4, 5, 6],
        [1, 2, 3, 1, 2, 3],
        [0.2, 0.3, 0.5, 1, 1, 1],
        initial=[1, 0, 0, 0],
        label={"goal": [1]},
        rewards={"toll": Rewards(state=np.array([1.0, 0, 0, 0]))},
    )


def shares(x):
    return jnp.concatenate([x, 1 - jnp.sum(x, keepdims=True), jnp.ones(3)])


def test_a_model_at_a_point():
    names = {"p": 0.1, "q": 0.2}
    found = make_parametric(
        triangle(), lambda x: (shares(x), {"steps": 2 * jnp.array([x[0], 0, 0, 0])}), names, 0.4
    )
    assert found.parameters == ("p", "q")
    for values in ({"q": 0.25, "p": 0.125}, np.array([0.125, 0.25])):
        model = found.at(values)
        assert model.probability.tolist() == [0.125, 0.25, 0.625, 1, 1, 1]
        assert model.rewards["steps"].choice.tolist() == [0.25, 0, 0, 0]
        assert model.rewards["toll"].state.tolist() == [1, 0, 0, 0]
        assert model.states_with_label("goal").tolist() == [False, True, False, False]
    probability, rewards = jax.jit(lambda f, x: f.numbers(x))(found, jnp.array([0.125, 0.25]))
    assert probability.tolist() == [0.125, 0.25, 0.625, 1, 1, 1] and set(rewards) == {"steps"}


def test_rewards_of_states_are_those_of_their_choices():
    model = make_sparse([0, 2, 3], [0, 1, 2, 3], [0, 1, 1], [1, 1, 1])
    found = make_parametric(
        model, lambda x: (jnp.ones(3), {"cost": jnp.array([x[0], 0])}), [0.0], [1.0]
    )
    assert found.at([0.5]).rewards["cost"].choice.tolist() == [0.5, 0.5, 0]


def test_smaller_boxes():
    found = make_parametric(triangle(), shares, [0.1, 0.1], [0.4, 0.4])
    small = found.within({"p0": 0.1, "p1": 0.2}, [0.2, 0.25])
    assert small.low.tolist() == [0.1, 0.2] and small.high.tolist() == [0.2, 0.25]
    assert ((small.low <= small.inside) & (small.inside <= small.high)).all()
    assert small.model.probability[:2].tolist() == small.inside.tolist()
    with pytest.raises(ValueError, match=r"p1 = 0.3 is outside of its interval \[0.2, 0.25\]"):
        small.at([0.15, 0.3])
    with pytest.raises(ValueError, match=r"\[0.1, 0.5\] of p0 is not within \[0.1, 0.4\]"):
        found.within([0.1, 0.1], [0.5, 0.4])


def test_a_box_may_reach_beyond_where_there_is_a_model():
    """Half of the square is none; there is a point inside all the same."""
    found = make_parametric(triangle(), shares, [0.55, 0.01], [0.98, 0.98])
    assert found.inside.sum() < 1 and (found.model.probability > 0).all()
    with pytest.raises(ValueError, match=r"from state 0 to state 3 is -0\.5; it must be positive"):
        found.at([0.75, 0.75])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"low": [0.5, 0.1]}, r"interval of p0 is \[0.5, 0.4\]; low must be below high"),
        ({"low": [0.4, 0.1]}, "low must be below high"),
        ({"low": [np.nan, 0.1]}, "low of p0 is nan; give a finite number"),
        ({"high": [0.4, np.inf]}, "high of p1 is inf"),
        ({"high": [0.4, 0.4, 0.4]}, r"low has shape \(2,\); expected \(3,\), a number for each of"),
        ({"high": {"p0": 0.4}}, "high: p1 is missing; the parameters are p0, p1"),
        ({"high": {"p0": 0.4, "p1": 0.4, "r": 1, "s": 2}}, "high: r, s are unknown"),
        ({"parameters": ["p", "p"]}, "name each once"),
        (
            {"low": 0.6, "high": 0.9, "parameters": ["p", "q"]},
            "no model at any of 64 points of the",
        ),
        ({"numbers": lambda x: x}, r"probabilities of numbers have shape \(2,\); expected \(6,\)"),
        (
            {"numbers": lambda x: (shares(x), {"r": jnp.ones((4, 2))})},
            "reward 'r' of numbers have sh",
        ),
        ({"numbers": lambda x: shares(x) * jnp.log(x[0] - 1)}, "is nan; it must be positive"),
        ({"numbers": lambda x: shares(x) * 0.9}, "sum to 0.9"),
    ],
)
def test_what_is_no_parametric_model_is_refused(changed, message):
    given = {"numbers": shares, "low": [0.1, 0.1], "high": [0.4, 0.4], **changed}
    with pytest.raises(ValueError, match=message):
        make_parametric(triangle(), given.pop("numbers"), **given)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"p0": 0.2}, "values: p1 is missing"),
        (0.2, r"values has shape \(\)"),
        ([0.2, np.nan], "values of p1 is nan"),
        ([0.2, 0.05], r"p1 = 0.05 is outside of its interval \[0.1, 0.4\]"),
    ],
)
def test_points_that_are_none(values, message):
    found = make_parametric(triangle(), shares, [0.1, 0.1], [0.4, 0.4])
    with pytest.raises(ValueError, match=message):
        found.at(values)


def test_arrays_of_a_function_are_arguments_and_it_stays_outside_of_jit():
    weight = jnp.array([0.5, 0.25])
    numbers = Partial(lambda w, x: shares(w * x), weight)
    found = make_parametric(triangle(), numbers, [0.1, 0.1], [0.9, 0.9])
    assert found.at([0.5, 0.5]).probability[:2].tolist() == [0.25, 0.125]
    assert any(np.array_equal(x, weight) for x in jax.tree.leaves(found.numbers))
    with pytest.raises(ValueError, match="call it before jit"):
        jax.jit(lambda low: make_parametric(triangle(), shares, low, [0.4, 0.4]))(jnp.ones(2))
