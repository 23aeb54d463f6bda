"""Objectives: sets from arrays and formulas, what each means in priorities, and what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.games.objective import (
    buchi,
    cobuchi,
    gr1,
    parity,
    reach,
    safety,
    states_with_label,
)
from jaxltl.core.models.game import make_game
from jaxltl.core.models.product import product


def world():
    """Three states in a circle that show {}, {a} and {a, b}."""
    return jl.from_dense(
        np.roll(np.eye(3), 1, axis=1)[:, None],
        label=[[0, 0], [1, 0], [1, 1]],
        propositions=["a", "b"],
    )


def game():
    return make_game(world(), [True, False, True])


@pytest.mark.parametrize(
    ("condition", "expected"),
    [
        ("a", [False, True, True]),
        ("a & !b", [False, True, False]),
        ("a -> b", [True, False, True]),
        ("true", [True] * 3),
        ("false", [False] * 3),
        (np.array([True, False, True]), [True, False, True]),
    ],
)
def test_sets_of_states(condition, expected):
    for model in (world(), jl.models.to_dense(world()), game()):
        assert states_with_label(model, condition).tolist() == expected


def test_parsed_formulas_are_formulas():
    assert states_with_label(world(), jl.parse_ltl("a xor b")).tolist() == [False, True, False]


def test_in_a_product_a_formula_speaks_of_the_world():
    for model in (product(world(), "G F b"), product(game(), "G (a -> F b)")):
        found = states_with_label(model, "b")
        assert found.shape == model.state_shape
        for q in range(model.state_shape[1]):
            assert found[:, q].tolist() == [False, False, True]


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("c", "safe: 'c' mentions the proposition 'c', which the world does not have"),
        ("F a", "safe: 'F a' is not Boolean: 'F a' is temporal"),
        ("a & X b", "'X b' is temporal"),
        (np.array([True, False]), r"safe is bool\[2\]; give bool\[3\]"),
        (np.array([1, 0, 1]), r"safe is int64\[3\]; give bool\[3\]"),
        (np.ones((3, 1), bool), r"safe is bool\[3, 1\]; give bool\[3\]"),
    ],
)
def test_wrong_sets(condition, message):
    with pytest.raises(ValueError, match=message):
        safety(game(), condition)


@pytest.mark.parametrize(
    ("make", "place"),
    [
        (lambda x: safety(game(), x), "safe"),
        (lambda x: reach(game(), x), "goal"),
        (lambda x: reach(game(), "a", safe=x), "safe"),
        (lambda x: buchi(game(), x), "accepting"),
        (lambda x: cobuchi(game(), x), "persistent"),
        (lambda x: parity(game(), [0, 1, 2], safe=x), "safe"),
        (lambda x: gr1(game(), (), ["a", x]), r"guarantees\[1\]"),
        (lambda x: gr1(game(), [x], ["a"]), r"assumptions\[0\]"),
        (lambda x: gr1(game(), [], ["a"], safe=x), "safe"),
    ],
)
def test_errors_name_the_place(make, place):
    with pytest.raises(ValueError, match=f"{place}: 'c' mentions the proposition 'c'"):
        make("c")
    with pytest.raises(ValueError, match=f"{place}: 'G F a' is not Boolean"):
        make("G F a")


# --- what each stands for ---------------------------------------------------------------------


def test_safety_only_loses():
    found = safety(game(), "a")
    assert found.lost.tolist() == [True, False, False]
    assert not found.won.any()
    assert not found.priority.any()
    assert found.num_priorities == 1


def test_reach_wins_at_the_goal_even_where_that_is_unsafe():
    found = reach(game(), "b", safe="a & !b")
    assert found.won.tolist() == [False, False, True]
    assert found.lost.tolist() == [True, False, False]
    assert found.priority.tolist() == [1, 1, 1]
    assert not reach(game(), "b").lost.any()


def test_buchi_and_cobuchi_priorities():
    found = buchi(game(), "b", safe="a")
    assert found.priority.tolist() == [1, 1, 0]
    assert found.lost.tolist() == [True, False, False]
    assert found.num_priorities == 2
    found = cobuchi(game(), "a", safe="!b")
    assert found.priority.tolist() == [1, 2, 2]
    assert found.lost.tolist() == [False, False, True]
    assert found.num_priorities == 3


def test_parity():
    found = parity(game(), [3, 0, 2])
    assert found.priority.tolist() == [3, 0, 2]
    assert found.priority.dtype == jnp.int32
    assert found.num_priorities == 4
    assert not (found.won | found.lost).any()


def test_parity_with_traced_priorities():
    one = game()
    found = jax.jit(lambda p: parity(one, p, num_priorities=5))(jnp.array([3, 0, 2]))
    assert found.priority.tolist() == [3, 0, 2]
    assert found.num_priorities == 5


@pytest.mark.parametrize(
    ("priority", "message"),
    [
        ([0, -2, 1], r"state \[1\] has priority -2; priorities start at 0"),
        ([0.0, 1.0, 2.0], r"priority is float64\[3\]; give int\[3\]"),
        ([True, False, True], r"priority is bool\[3\]; give int\[3\]"),
        ([0, 1], r"priority is int64\[2\]; give int\[3\]"),
        (1, r"priority is int64\[\]; give int\[3\]"),
    ],
)
def test_wrong_priorities(priority, message):
    with pytest.raises(ValueError, match=message):
        parity(game(), priority)


def test_gr1_and_generalized_buchi():
    found = gr1(game(), ["b"], ["a", np.array([True, False, False])], safe="!b")
    assert found.assumptions.tolist() == [[False, False, True]]
    assert found.guarantees.tolist() == [[False, True, True], [True, False, False]]
    assert found.lost.tolist() == [False, False, True]
    found = gr1(game(), (), ["a", "b"], safe="a")
    assert found.assumptions.tolist() == [[True] * 3], "no assumption is one that always holds"
    assert found.guarantees.shape == (2, 3)
    assert found.lost.tolist() == [True, False, False]


def test_without_guarantees_one_always_holds():
    found = gr1(game(), ["a"], [])
    assert found.guarantees.tolist() == [[True] * 3]


def test_a_string_is_not_a_list_of_sets():
    with pytest.raises(ValueError, match="assumptions is 'a'; give a list of sets of states"):
        gr1(game(), "a", ["b"])
    with pytest.raises(ValueError, match="guarantees is 'a & b'; give a list"):
        gr1(game(), [], "a & b")
    with pytest.raises(ValueError, match="guarantees is 'b'; give a list"):
        gr1(game(), (), jl.parse_ltl("b"))


def test_objectives_on_a_product_have_its_shape():
    joint = product(game(), "G F b")
    shape = joint.state_shape
    found = buchi(joint, "b", safe=np.ones(shape, bool))
    assert found.priority.shape == found.lost.shape == shape
    assert gr1(joint, ["a"], ["b"]).guarantees.shape == (1, *shape)


def test_objectives_are_made_of_traced_games_too():
    def region(game, accepting):
        return jl.winning_region(game, buchi(game, accepting)).region

    accepting = jnp.array([True, False, False])
    np.testing.assert_array_equal(jax.jit(region)(game(), accepting), region(game(), accepting))
