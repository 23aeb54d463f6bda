"""Behavioral cloning: its loss, its minibatches, and what it learns from demonstrations."""

from __future__ import annotations

from functools import cache, partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos import behavioral_cloning as bc
from jaxltl.core.models.construct.batch import stack_products, unstack_product
from tests.algos.cases import LearnerCase, world

MAX_PROGRAMS = 450  # that the default tests compile at most

SMALL = bc.DensePolicy(hidden=(16,))


@cache
def two_worlds():
    return stack_products([jl.gridworld("b . r\n. . g"), jl.gridworld("g . r\n. . b")], "!r U g")


def runs(*pairs):
    """Trajectories without a check, of one pair each."""
    state, action = np.array(pairs).T[:, :, None]
    return jl.models.Trajectories(
        jnp.asarray(state), jnp.asarray(action), jnp.ones(len(pairs), jnp.int32)
    )


def demonstrations():
    """Down, then right, whatever the world."""
    return [runs((0, 1), (3, 3), (4, 3), (0, 1), (3, 3))] * 2


@cache
def problem(held_out=None):
    return bc.make_problem(
        two_worlds(),
        jnp.stack([jnp.eye(6)] * 2),
        demonstrations(),
        held_out=held_out,
        network=SMALL,
    )


def test_the_loss_is_cross_entropy_of_the_logits():
    found = problem()
    state = bc.init(jax.random.key(0), found, bc.Hparams())
    total, pairs = 0.0, np.argwhere(np.asarray(found.counts) > 0)
    layers = jax.tree.map(np.asarray, state.parameters["params"])
    for w, s, q, a in pairs:
        seen = np.concatenate([found.observation[w, s], np.arange(found.counts.shape[2]) == q])
        hidden = np.maximum(seen @ layers["kernel"] + layers["bias"], 0)
        scores = hidden @ layers["Dense_0"]["kernel"] + layers["Dense_0"]["bias"]
        probability = np.exp(scores) / np.exp(scores).sum()
        total -= float(found.counts[w, s, q, a]) * np.log(probability[a])
    assert len(pairs) > 2 and float(found.counts.sum()) == 10
    np.testing.assert_allclose(
        bc.neg_log_likelihood(state.parameters, found, found.counts), total / 10, rtol=1e-10
    )


def test_minibatches_are_drawn_by_counts():
    counts = jnp.zeros((2, 3, 2, 4)).at[0, 1, 0, 2].set(3.0).at[1, 2, 1, 3].set(1.0)
    w, s, q, a = bc._draw(jax.random.key(0), counts, 8000)
    drawn = {tuple(x) for x in np.stack([w, s, q, a], 1).tolist()}
    assert drawn == {(0, 1, 0, 2), (1, 2, 1, 3)}
    assert abs(float(w.mean()) - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 8000)


def test_what_was_demonstrated_is_learned():
    found = problem()
    hparams = bc.Hparams(learning_rate=0.03, batch=16)
    state, metrics = bc.train(jax.random.key(0), found, hparams, num_steps=150)
    assert float(metrics.loss[-1]) < 0.02 < float(metrics.loss[0])
    assert not state.stopped and state.best.step == 150
    for w in range(2):
        model = unstack_product(two_worlds(), w)
        policy = bc.policy_in_world(SMALL, state.best.parameters, model, found.observation[w])
        np.testing.assert_allclose(policy.sum(-1), 1, rtol=1e-9)
        seen = np.asarray(found.counts[w]) > 0
        assert (np.asarray(policy)[seen] > 0.95).all()


def test_the_prior_keeps_the_policy_soft():
    found = problem()
    ends = [
        bc.train(
            jax.random.key(0),
            found,
            bc.Hparams(learning_rate=0.03, batch=16, l2=l2),
            num_steps=150,
        )[1].loss[-1]
        for l2 in (0.0, 10.0)
    ]
    assert ends[0] < 0.02 and ends[1] > 0.5


def test_learning_stops_at_the_best_held_out_likelihood():
    """Held out is what contradicts the demonstrations, so that learning soon makes it worse."""
    other = [runs((0, 1), (3, 0))] * 2
    found = bc.make_problem(
        two_worlds(), [jnp.eye(6)] * 2, demonstrations(), held_out=other, network=SMALL
    )
    hparams = bc.Hparams(learning_rate=0.03, patience=20, batch=16)
    state, metrics = bc.train(jax.random.key(0), found, hparams, num_steps=150)
    curve = np.asarray(metrics.held_out)
    best = int(state.best.step)
    assert state.stopped and state.step == 150
    assert best == int(np.argmin(curve)) < 100
    np.testing.assert_allclose(state.best.neg_log_likelihood, curve.min())
    np.testing.assert_allclose(
        bc.neg_log_likelihood(state.best.parameters, found, found.held_out), curve.min(), rtol=1e-9
    )
    assert (curve[best + 21 :] == curve[best + 20]).all(), "it stays as it was"
    longer, _ = bc.run(state, found, hparams, num_steps=150)
    jax.tree.map(np.testing.assert_array_equal, longer.parameters, state.parameters)


def test_a_share_is_held_out():
    found = problem(0.4)
    assert float(found.held_out.sum()) == 4 and float(found.counts.sum()) == 6
    np.testing.assert_array_equal(found.counts + found.held_out, problem().counts)


def test_the_network_is_that_of_the_dissertation():
    network = bc.ConvolutionalPolicy()
    observation, memory = jnp.zeros((7, 1, 45)), jnp.eye(5)[None]
    scores, parameters = jax.eval_shape(
        network.init_with_output, jax.random.key(0), observation, memory
    )
    assert scores.shape == (7, 5, 4)
    shapes = sorted(x.shape for x in jax.tree.leaves(parameters) if x.ndim > 1)
    # What two convolutions leave of 3 x 3 are 24 numbers; with the memory 29 go into 100.
    assert shapes == sorted([(2, 2, 5, 12), (2, 2, 12, 24), (29, 100), (100, 100), (100, 4)])


@pytest.mark.slow
def test_memory_enters_beside_what_is_seen():
    """The sum of two parts is one dense layer on both side by side."""
    rng = np.random.default_rng(0)
    seen, memory = jnp.asarray(rng.normal(size=(3, 1, 6))), jnp.eye(2)[None]
    network = bc.DensePolicy(hidden=())
    scores, parameters = network.init_with_output(jax.random.key(0), seen, memory)
    kernel = parameters["params"]["kernel"]
    both = jnp.concatenate([jnp.repeat(seen, 2, 1), jnp.repeat(memory, 3, 0)], -1)
    np.testing.assert_allclose(scores, both @ kernel, atol=1e-6)
    conv = bc.ConvolutionalPolicy(observation_shape=(3, 3, 1), kernels=(2,), hidden=(4,))
    values = conv.init_with_output(jax.random.key(0), jnp.zeros((1, 9)), memory[0])[0]
    assert values.shape == (2, 4)


def test_unavailable_actions_have_no_probability():
    mdp = jl.make_mdp(
        [[[0], [1]], [[1], [0]]],
        [[[1.0], [1.0]], [[1.0], [0.0]]],
        label=[[0], [1]],
        propositions=["g"],
    )
    model = stack_products([mdp], "F g")
    network = bc.DensePolicy(num_actions=2, hidden=())
    found = bc.make_problem(model, jnp.eye(2), runs((0, 1), (1, 0)), held_out=None, network=network)
    state = bc.init(jax.random.key(0), found, bc.Hparams())
    policy = bc.policy_in_world(network, state.parameters, unstack_product(model, 0), jnp.eye(2))
    assert policy[1].tolist() == [[1, 0]] * 2
    gradient = jax.grad(bc.neg_log_likelihood)(state.parameters, found, found.counts)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(gradient))


class Single(nn.Module):
    @nn.compact
    def __call__(self, observation, memory):
        return nn.Dense(1)(observation)


make = partial(bc.make_problem, held_out=None, network=SMALL)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: make(two_worlds(), jnp.eye(6), demonstrations()), "observation has shape"),
        (
            lambda: make(two_worlds(), [np.eye(6), np.full((6, 6), np.inf)], demonstrations()),
            "world 1: the observation in state 0 is not finite",
        ),
        (lambda: make(two_worlds(), [np.eye(6)] * 2, demonstrations()[:1]), "in 1 worlds"),
        (lambda: make(two_worlds(), [np.eye(6)] * 2, demonstrations(), held_out=1.0), "held_out=1"),
        (
            lambda: make(two_worlds(), [np.eye(6)] * 2, demonstrations(), held_out=0.95),
            "no pair is left",
        ),
        (lambda: make(two_worlds(), [np.eye(6)] * 2, [runs((0, 7))] * 2), "action 7"),
        (
            lambda: make(two_worlds(), [np.eye(6)] * 2, demonstrations(), network=Single()),
            r"scores have shape \(6, 1, 1\); expected \(6, 3, 4\)",
        ),
        (
            lambda: make(
                two_worlds(), [np.eye(6)] * 2, demonstrations(), network=bc.ConvolutionalPolicy()
            ),
            "6 numbers, which do not fit the shape",
        ),
    ],
)
def test_what_does_not_fit_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


# --- the laws of all learners ------------------------------------------------------------------


def cloning():
    mdp, demonstrations = world()
    network = bc.DensePolicy(num_actions=2, hidden=(4,))
    problem = bc.make_problem(
        jl.product(mdp, "!r U g"), jnp.eye(3), demonstrations, held_out=0.5, network=network
    )
    setting = partial(bc.Hparams, batch=5)
    return LearnerCase(bc, problem, setting(), setting(learning_rate=0.1, l2=0.1, patience=3))


CASES = {
    "cloning": cloning,
}
