"""Sparse models: what enters is checked, and they are what padded ones are."""

import jax
import numpy as np
import pytest

from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.mdp import MDP, make_mdp, support, to_dense
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import Rewards, choice_reward, make_sparse


def random_padded(rng, num_states, num_actions=3, width=3) -> MDP:
    successor = rng.integers(0, num_states, (num_states, num_actions, width))
    probability = rng.random(successor.shape) * (rng.random(successor.shape) < 0.7)
    probability[..., 0] += 0.1
    probability /= probability.sum(-1, keepdims=True)
    available = rng.random((num_states, num_actions)) < 0.6
    available[:, 0] |= ~available.any(-1)
    label = rng.random((num_states, 2)) < 0.3
    return make_mdp(
        successor, probability, available=available, label=label, propositions=["a", "b"]
    )


def matrix(model) -> np.ndarray:
    """``[S, A, S]`` of a sparse model, entry by entry."""
    found = np.zeros((model.num_states, int(model.action.max()) + 1, model.num_states))
    for s in range(model.num_states):
        for r in range(model.row_start[s], model.row_start[s + 1]):
            for e in range(model.entry_start[r], model.entry_start[r + 1]):
                found[s, model.action[r], model.successor[e]] += model.probability[e]
    return found


def dense(mdp: MDP) -> np.ndarray:
    found = np.array(to_dense(mdp).transition)
    found[~np.asarray(mdp.available)] = 0
    return found


@pytest.mark.parametrize("seed", range(5))
def test_sparse_models_are_the_padded_ones(seed):
    mdp = random_padded(np.random.default_rng(seed), 7)
    sparse = to_sparse(mdp)
    assert sparse.num_transitions == (dense(mdp) > 0).sum() <= support(mdp).sum()
    np.testing.assert_allclose(matrix(sparse), dense(mdp)[:, : matrix(sparse).shape[1]], atol=1e-6)
    back = to_padded(sparse)
    actions = back.num_actions
    np.testing.assert_array_equal(back.available, np.asarray(mdp.available)[:, :actions])
    np.testing.assert_allclose(dense(back), dense(mdp)[:, :actions], atol=1e-6)
    np.testing.assert_array_equal(back.label, mdp.label)


@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_products_are_written_out(label_on):
    mdp = random_padded(np.random.default_rng(3), 6)
    lazy = product(mdp, to_automaton("F(a & X F b)"), label_on=label_on)
    found = matrix(to_sparse(lazy))
    step, num_memory = np.asarray(lazy.next_memory), lazy.num_memory
    world = dense(mdp)
    for s in range(6):
        for q in range(num_memory):
            for a in range(found.shape[1]):
                row = np.zeros(6 * num_memory)
                for t in range(6):
                    read = t if label_on == "entry" else s
                    row[t * num_memory + step[read, q]] += world[s, a, t]
                np.testing.assert_allclose(found[s * num_memory + q, a], row, atol=1e-6)


def test_repeated_successors_become_one():
    model = make_sparse(
        None,
        [0, 3, 4],
        [1, 0, 1, 1],
        [0.25, 0.5, 0.25, 1.0],
        rewards={"r": Rewards(state=[1, 0], choice=[2, 0], transition=[4, 0, 8, 0])},
    )
    assert model.successor.tolist() == [0, 1, 1]
    assert model.probability.tolist() == [0.5, 0.5, 1.0]
    assert model.rewards["r"].transition.tolist() == [0, 6, 0]
    assert choice_reward(model).tolist() == choice_reward(model, "r").tolist() == [6, 0]
    assert choice_reward(model, np.array([1.0, 2.0])).tolist() == [1, 2]


def test_unsigned_numbers_are_taken():
    arrays = [np.array(x, np.uint64) for x in ([0, 1, 2], [0, 2, 3], [1, 0, 1])]
    model = make_sparse(*arrays, [0.5, 0.5, 1.0])
    assert model.row_start.dtype == model.entry_start.dtype == np.int32
    assert model.successor.tolist() == [0, 1, 1]


def test_a_model_passes_through_jit():
    model = make_sparse(None, [0, 1], [0], [1.0], rewards={"r": Rewards(state=[2.0])})
    found = jax.jit(lambda m: m.probability * 2 + m.rewards["r"].state)(model)
    assert found.tolist() == [4.0]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (([0, 1], [0, 1], [3], [1.0]), "state 0, choice 0: successor 3 is out of range"),
        (([0, 1], [0, 1], [0], [0.5]), "state 0, choice 0: the probabilities sum to 0.5"),
        (([0, 1], [0, 1], [0], [np.nan]), "probability nan"),
        (([0, 1], [0, 1], [0], [-1.0]), "probability -1"),
        (([0, 0, 1], [0, 1], [0], [1.0]), "state 0 has no choice"),
        (([0, 2], [0, 0, 1], [0], [1.0]), "state 0, choice 0 leads nowhere"),
        (([0, 2, 1, 2], [0, 1, 2], [0, 0], [1.0, 1.0]), "row_start falls from 2 to 1"),
        (([0, 2], [0, 1], [0], [1.0]), "row_start goes from 0 to 2"),
        (([0, 1], [0, 1], [0.5], [1.0]), "it must hold integers"),
        (([0, 1], [0, 2], [0, 0], [0.0, 0.0]), "sum to 0, not 1"),
    ],
)
def test_what_is_wrong_is_named(arrays, message):
    with pytest.raises(ValueError, match=message):
        make_sparse(*arrays)
