"""Finite models and games as worlds: what is drawn has the model's probabilities."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.environments.episodes import make_agent, run_episode
from jaxltl.core.environments.model_environment import model_environment
from jaxltl.core.environments.tabulate import tabulate
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import make_game
from jaxltl.core.models.mdp import to_dense
from jaxltl.core.models.product import product
from jaxltl.core.models.sparse import Rewards, choice_reward, make_sparse
from jaxltl.core.values.undiscounted.satisfaction import (
    optimal_satisfaction,
    satisfaction_probability,
)
from tests import reference
from tests.support import as_mdp, random_action

S, A, K = 6, 2, 3
COUNT = 4000
MODEL = reference.random_model(np.random.default_rng(1), S, A, K, certainty=0)
LABEL = np.random.default_rng(3).random((S, 2)) < 0.4


def world():
    return as_mdp(MODEL, label=LABEL, propositions=["a", "b"])


def transitions(environment):
    """``float[S, A, S]``, by what the environment tells."""

    def row(state, action):
        found, probability = environment.outcomes(state, action)
        return jnp.zeros(S).at[found.world].add(probability)

    rows = jax.vmap(jax.vmap(row, (None, 0)), (0, None))
    return np.asarray(jax.jit(rows)(jnp.arange(S), jnp.arange(A)))


@pytest.mark.parametrize("kind", ["padded", "dense", "sparse"])
def test_what_is_told_is_the_model(kind):
    model = {
        "padded": world,
        "dense": lambda: to_dense(world()),
        "sparse": lambda: to_sparse(world()),
    }[kind]()
    environment = model_environment(model)
    np.testing.assert_allclose(transitions(environment), MODEL.transition)
    states, chance = environment.starts()
    np.testing.assert_allclose(chance, MODEL.initial)
    for s in range(S):
        assert environment.labels(states[s]).tolist() == LABEL[s].tolist()
        assert environment.allowed(states[s]).tolist() == MODEL.available[s].tolist()
        assert environment.observe(states[s]).tolist() == np.eye(S)[s].tolist()


def drawn_and_told(environment, told):
    """How far the shares of what is drawn are from ``float[S, A, S]``, at most."""
    keys = jax.random.split(jax.random.key(0), COUNT)
    states, actions = np.argwhere(MODEL.available).T
    draw = jax.jit(
        jax.vmap(
            jax.vmap(lambda s, a, key: environment.step(s, a, key).world, (None, None, 0)),
            (0, 0, None),
        )
    )
    drawn = np.asarray(draw(states, actions, keys))
    share = (drawn[..., None] == np.arange(S)).mean(1)
    return np.abs(share - told[states, actions]).max()


def test_what_is_drawn_is_as_likely_as_told():
    environment = model_environment(world())
    assert drawn_and_told(environment, MODEL.transition) < 4 * 0.5 / np.sqrt(COUNT)
    first = np.asarray(jax.vmap(environment.reset)(jax.random.split(jax.random.key(0), COUNT)))
    assert np.abs(np.bincount(first, minlength=S) / COUNT - MODEL.initial).max() < 0.04


def test_rewards_are_of_states_or_actions():
    of_states, of_actions = np.arange(S), np.arange(S * A).reshape(S, A) / 2
    key = jax.random.key(0)
    state, action = np.argwhere(MODEL.available)[-1]
    found = model_environment(world(), reward=of_states).step(state, action, key)
    assert float(found.reward) == state
    found = model_environment(world(), reward=of_actions).step(state, action, key)
    assert float(found.reward) == of_actions[state, action]
    for reward in (np.zeros(S + 1), np.zeros((A, S)), np.array(["x"] * S)):
        with pytest.raises(ValueError, match=r"give numbers \[6\]"):
            model_environment(world(), reward=reward)


def test_an_observation_of_ones_own():
    environment = model_environment(world(), observe=lambda state: {"number": state})
    assert environment.observe(jnp.int32(3)) == {"number": 3}
    assert environment.observations["number"].shape == ()


def test_tabulated_it_is_the_model_again():
    table = tabulate(model_environment(world()))
    for formula in ("F (a & X b)", "G F a"):
        joint = product(world(), formula)
        expected = (np.asarray(joint.initial) * optimal_satisfaction(joint).value).sum()
        other = product(table.model, formula)
        found = (np.asarray(other.initial) * optimal_satisfaction(other).value).sum()
        assert float(found) == pytest.approx(float(expected), abs=1e-9)


@pytest.mark.slow
def test_success_by_simulation_is_the_probability_by_the_solver():
    """For a task that is decided soon, within four standard deviations."""
    formula, count = "!b U (a & X !b)", 4000
    joint = product(world(), formula)
    policy = jnp.asarray(joint.available / joint.available.sum(-1, keepdims=True))
    value = satisfaction_probability(joint, policy).value
    expected = float((np.asarray(joint.initial) * value).sum())
    task = task_environment(model_environment(world()), formula)
    agent = make_agent(lambda seen, key: 0)
    agent = agent.replace(
        act=lambda memory, seen, allowed, key: (random_action(key, task.actions, allowed), memory)
    )
    run = jax.jit(jax.vmap(lambda key: run_episode(key, task, agent, num_steps=60).reward.sum()))
    rewards = np.asarray(run(jax.random.split(jax.random.key(7), count)))
    assert 0.05 < expected < 0.95
    # What the first label decides is satisfied with the first step, hence no difference in reward.
    assert abs(rewards.mean() - expected) < 4 * 0.5 / np.sqrt(count)


# --- games ----------------------------------------------------------------------------------------


def test_a_game_is_played_against_its_opponent():
    system = np.array([1, 0, 1, 0, 1, 0], bool)
    rng = np.random.default_rng(5)
    weight = rng.random((S, A)) * MODEL.available
    for opponent in (None, weight):
        environment = model_environment(make_game(world(), system), opponent=opponent)
        share = MODEL.available if opponent is None else weight
        share = share / share.sum(1, keepdims=True)
        told = transitions(environment)
        replies = (share[:, :, None] * MODEL.transition).sum(1)
        for s, a in np.ndindex(S, A):
            np.testing.assert_allclose(
                told[s, a], MODEL.transition[s, a] if system[s] else replies[s], atol=1e-12
            )
    assert drawn_and_told(environment, told) < 4 * 0.5 / np.sqrt(COUNT)


@pytest.mark.parametrize(
    ("model", "options", "text"),
    [
        (lambda: product(world(), "F a"), {}, "Product is no world"),
        (lambda: make_game(product(world(), "F a"), [[True] * 2] * S), {}, "Product is no world"),
        (world, {"opponent": np.ones((S, A))}, "opponent is for games"),
        (lambda: make_game(world(), [True] * S), {"opponent": np.ones(S)}, r"weights \[6, 2\]"),
        (lambda: make_game(world(), [True] * S), {"opponent": -np.ones((S, A))}, "give weights"),
        (lambda: make_game(world(), [False] * S), {"opponent": np.zeros((S, A))}, "state 0"),
    ],
)
def test_bad_models_are_named(model, options, text):
    with pytest.raises(ValueError, match=text):
        model_environment(model(), **options)


@pytest.mark.parametrize("chain", [True, False])
def test_rewards_of_sparse_models_are_paid_by_the_choice(chain):
    rng = np.random.default_rng(int(chain))
    starts = None if chain else [0, 2, 3, 4]
    model = make_sparse(
        starts,
        np.arange(4 if chain else 5),
        rng.permutation(3 if chain else 4) % 3,
        np.ones(3 if chain else 4),
        rewards={"r": Rewards(state=rng.random(3), transition=rng.random(3 if chain else 4))},
    )
    earned = choice_reward(model, "r")
    for reward in (earned, "r", model.rewards["r"]):
        environment = model_environment(model, reward=reward)
        for row, state in enumerate(model.host.state):
            action = model.rank[row]
            step = environment.step(state, action, jax.random.key(0))
            assert float(step.reward) == pytest.approx(earned[row])
            told, _ = environment.outcomes(state, action)
            np.testing.assert_allclose(told.reward, earned[row])
