"""Models: what is let in, what is refused and where the message points."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl import DenseMDP, from_dense, make_mdp
from jaxltl.core.models import to_dense
from tests import reference
from tests.support import as_mdp

SUCCESSOR = [[[0, 1], [1, 0]], [[1, 0], [0, 1]]]
PROBABILITY = [[[0.5, 0.5], [1.0, 0.0]], [[1.0, 0.0], [0.25, 0.75]]]


def changed(place, value, array=PROBABILITY):
    result = np.array(array, float)
    result[place] = value
    return result


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        ((0, 0, 1), 0.4, "state 0, action 0: the probabilities sum to 0.9, not 1"),
        ((1, 1, 0), 0.3, "state 1, action 1: the probabilities sum to 1.05, not 1"),
        ((1, 1, 0), -0.25, r"state 1, action 1: probability -0.25 \(entry 0\)"),
        ((0, 0, 1), np.nan, r"state 0, action 0: probability nan \(entry 1\)"),
        ((1, 0, 1), np.inf, r"state 1, action 0: probability inf \(entry 1\)"),
    ],
)
def test_bad_probabilities_are_refused_at_their_place(place, value, message):
    with pytest.raises(ValueError, match=message):
        make_mdp(SUCCESSOR, changed(place, value))


@pytest.mark.parametrize("number", [-1, 2])
def test_successor_out_of_range(number):
    successor = np.array(SUCCESSOR)
    successor[1, 1, 1] = number
    message = f"state 1, action 1: successor {number} is out of range; states are 0 to 1"
    with pytest.raises(ValueError, match=message):
        make_mdp(successor, PROBABILITY)


def test_successors_without_probability_are_padding():
    successor = np.array(SUCCESSOR)
    successor[0, 1, 1] = 99
    assert make_mdp(successor, PROBABILITY).successor[0, 1, 1] == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"available": [[True, True], [False, False]]}, "state 1 has no available action"),
        ({"available": [[True, True]]}, r"available has shape \(1, 2\); expected \(2, 2\)"),
        ({"initial": [1.0]}, r"initial has shape \(1,\); expected \(2,\)"),
        ({"initial": [1.5, -0.5]}, "initial probability of state 1 is -0.5"),
        ({"initial": [np.nan, 1.0]}, "initial probability of state 0 is nan"),
        ({"initial": [0.5, 0.4]}, "the initial distribution sums to 0.9, not 1"),
        (
            {"label": [[True], [False]]},
            r"label has shape \(2, 1\); expected \(2, P\).*name in propositions, which is empty",
        ),
        ({"label": [["a"], []]}, r'give True or False.*label=\{"goal": \[3\]\}'),
        ({"propositions": ("a", "a")}, "not distinct"),
        (
            {"label": [[True]], "propositions": ("a",)},
            r"label has shape \(1, 1\); expected \(2, 1\)",
        ),
        ({"propositions": ("a",)}, r"propositions \('a',\) but no label.*; give label as bool"),
        ({"label": {"a": [2]}}, r"label\['a'\] has the state 2; states are 0 to 1"),
        ({"label": {"a": [-1]}}, r"label\['a'\] has the state -1"),
        ({"label": {"a": [True, False]}}, r"label\['a'\] has dtype bool .* numbers of the states"),
        ({"label": {"a": 1}}, r"label\['a'\] has dtype int64 and shape \(\); it must be a list"),
        (
            {"label": {"a": [1]}, "propositions": ("a", "b")},
            r"label names \('a',\), propositions are \('a', 'b'\); give the states of each",
        ),
    ],
)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_mdp(SUCCESSOR, PROBABILITY, **arguments)


def test_labels_by_the_states_where_they_hold():
    label = {"b": [1], "a": np.array([1, 0]), "c": []}
    lists = partial(make_mdp, SUCCESSOR, PROBABILITY)
    for build in (lists, partial(from_dense, [[[0.5, 0.5]]] * 2)):
        mdp = build(label=label)
        assert mdp.propositions == ("b", "a", "c")
        assert mdp.label.tolist() == [[False, True, False], [True, True, False]]
        ordered = build(label=label, propositions=["a", "b", "c"])
        assert ordered.propositions == ("a", "b", "c")
        assert ordered.label.tolist() == [[True, False, False], [True, True, False]]


def test_a_state_without_any_positive_row_has_no_action():
    with pytest.raises(ValueError, match="state 1 has no available action"):
        make_mdp(SUCCESSOR, [[[0.5, 0.5], [1.0, 0.0]], [[0.0, 0.0], [0.0, 0.0]]])


@pytest.mark.parametrize(
    ("successor", "probability", "message"),
    [
        (SUCCESSOR, PROBABILITY[0], r"successor has shape \(2, 2, 2\) and probability \(2, 2\)"),
        (SUCCESSOR[0], PROBABILITY[0], r"must be \[states, actions, successors\]"),
        (np.zeros((2, 0, 1), int), np.zeros((2, 0, 1)), "2 states and 0 actions"),
        (np.zeros((0, 1, 1), int), np.zeros((0, 1, 1)), "0 states and 1 actions"),
        (np.array(SUCCESSOR, float), PROBABILITY, "successor has dtype float64"),
    ],
)
def test_bad_shapes(successor, probability, message):
    with pytest.raises(ValueError, match=message):
        make_mdp(successor, probability)


def test_bad_dense_matrices():
    with pytest.raises(ValueError, match=r"shape \(1, 1, 2\); it must be \[S, A, S\]"):
        from_dense([[[0.5, 0.5]]])
    with pytest.raises(ValueError, match=r"state 1, action 0: the probabilities sum to 0\.5"):
        from_dense([[[0.5, 0.5]], [[0.5, 0.0]]])
    with pytest.raises(ValueError, match=r"state 1, action 0: probability -1.0 \(entry 1\)"):
        from_dense([[[0.5, 0.5]], [[2.0, -1.0]]])


def test_rows_that_nearly_sum_to_one_are_scaled():
    mdp = make_mdp(SUCCESSOR, changed((0, 0, 1), 0.5 + 5e-7))
    np.testing.assert_allclose(mdp.probability.sum(-1), 1, rtol=0, atol=1e-15)


def test_rows_of_unavailable_actions_are_cleared_and_need_not_sum_to_one():
    mdp = make_mdp(SUCCESSOR, changed((0, 0, 1), 0.1), available=[[False, True], [True, True]])
    assert not mdp.probability[0, 0].any()
    assert not mdp.successor[0, 0].any()
    assert mdp.available.tolist() == [[False, True], [True, True]]


def test_defaults():
    mdp = make_mdp(SUCCESSOR, changed((0, 1), 0.0))
    assert mdp.available.tolist() == [[True, False], [True, True]]
    assert mdp.initial.tolist() == [0.5, 0.5]
    assert mdp.label.shape == (2, 0)
    assert mdp.state_shape == (2,)
    assert mdp.num_successors == 2


def test_dtype_follows_jax():
    assert make_mdp(SUCCESSOR, PROBABILITY).dtype == jnp.float64
    with jax.enable_x64(False):
        mdp = make_mdp(SUCCESSOR, PROBABILITY, initial=[0.25, 0.75])
        assert mdp.dtype == mdp.initial.dtype == jnp.float32
        assert mdp.successor.dtype == jnp.int32


def test_dense_and_sparse_are_the_same_process():
    rng = np.random.default_rng(0)
    for _ in range(20):
        model = reference.random_model(rng, 5, 3, 3)
        label = rng.random((5, 2)) < 0.5
        mdp = as_mdp(model, label=label, propositions=("a", "b"))
        dense = to_dense(mdp)
        assert isinstance(dense, DenseMDP)
        np.testing.assert_array_equal(dense.transition, model.transition)
        again = from_dense(
            dense.transition,
            available=dense.available,
            initial=dense.initial,
            label=dense.label,
            propositions=dense.propositions,
        )
        np.testing.assert_array_equal(to_dense(again).transition, model.transition)
        for field in ("available", "initial", "label"):
            np.testing.assert_array_equal(getattr(again, field), getattr(mdp, field))
        assert again.propositions == ("a", "b")
        assert again.num_successors == max(1, int((model.transition > 0).sum(-1).max()))


def test_a_model_is_a_pytree_with_static_propositions():
    mdp = make_mdp(SUCCESSOR, PROBABILITY, label=[[True], [False]], propositions=["a"])
    leaves, structure = jax.tree.flatten(mdp)
    assert len(leaves) == 5
    assert jax.tree.unflatten(structure, leaves).propositions == ("a",)
