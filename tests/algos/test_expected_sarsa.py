"""Expected SARSA against policy evaluation, and its mask."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.algos import expected_sarsa as sarsa
from tests.algos.cases import LearnerCase, numbers, world

HPARAMS = sarsa.Hparams(discount=0.6, step_size=1.0, epsilon=0.3, restart=0.1)


def ring():
    """A deterministic ring; two actions go either way, the third leads to state 0."""
    place = np.arange(5)
    successor = np.stack([np.roll(place, 1), np.roll(place, -1), 0 * place], 1)[..., None]
    model = jl.make_mdp(successor, np.ones(successor.shape))
    return model, np.random.default_rng(0).normal(size=(5, 3))


@pytest.mark.parametrize("mask", [None, [True, True, False]])
def test_a_deterministic_model_is_learned_exactly(mask):
    """With step size 1 the table attains the fixed point: the value of its own policy."""
    model, reward = ring()
    allowed = None if mask is None else np.tile(mask, (5, 1))
    problem = sarsa.make_problem(model, reward, allowed=allowed)
    state, metrics = sarsa.train(jax.random.key(0), problem, HPARAMS, num_steps=100)
    policy = sarsa.policy(state, problem, HPARAMS)
    np.testing.assert_allclose(policy.sum(-1), 1, rtol=1e-6)
    if mask is not None:
        assert (policy[:, 2] == 0).all() and (state.q[:, 2] == 0).all()
    exact = jl.policy_value(problem.model, policy, problem.reward, HPARAMS.discount).value
    np.testing.assert_allclose(jnp.sum(policy * state.q, -1), exact, atol=1e-6)
    assert metrics.residual[-1] < 1e-6 and (metrics.status == jl.Status.COMPLETED).all()


def test_mistakes_are_named():
    model, reward = ring()
    with pytest.raises(ValueError, match="reward has shape"):
        sarsa.make_problem(model, reward[:2])
    with pytest.raises(ValueError, match="allowed"):
        sarsa.make_problem(model, reward, allowed=np.ones((5, 2), bool))


# --- the laws of all learners ------------------------------------------------------------------


def temporal_difference():
    problem = sarsa.make_problem(world()[0], numbers(3, 2))
    setting = partial(sarsa.Hparams, num_transitions=7, restart=0.3)
    return LearnerCase(sarsa, problem, setting(0.9), setting(0.8, step_size=0.3), reward="reward")


CASES = {
    "sarsa": temporal_difference,
}
