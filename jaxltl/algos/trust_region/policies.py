"""Policies learned by trust-region methods: their distribution, agents and trajectories."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common import action_distributions as actions_of
from jaxltl.algos.common.actor_critic import Output
from jaxltl.algos.common.collection import Transition, transition
from jaxltl.algos.trust_region._policy_networks import gaussian, normalized
from jaxltl.algos.trust_region.state import Hparams, Problem, State, observed_vector
from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import flat_observation, require_key, some_action
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.pretty_print import brief


@brief
class Batch(NamedTuple):
    """Trajectories, zero after their end or where excluded.

    Attributes:
      observation: ``float[T, N, O]``, flattened.
      action: ``float[T, N, A]``, flattened, before clipping.
      reward, cost: ``float[T, N]``.
      discount: ``float[T, N]``, the environment's.
      valid: ``bool[T, N]``, whether the step was made.
      finite: ``bool[N]``; other trajectories are excluded and have no valid step.
      last: ``float[N, O]``, the observation after the last step.
      truncated: ``bool[N]``, truncated and not terminated.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    cost: jax.Array
    discount: jax.Array
    valid: jax.Array
    finite: jax.Array
    last: jax.Array
    truncated: jax.Array


def require_run(problem: Problem, hparams: Hparams) -> None:
    """Raises ValueError for a problem or hyperparameters of another learner."""
    validation.instance("problem", problem, Problem, "one of trust_region.make_problem")
    validation.instance("hparams", hparams, Hparams, "trust_region.Hparams")


def require_state(state: State) -> None:
    """Raises ValueError for a state of another learner."""
    validation.instance("state", state, State, "one of trust_region.init or trust_region.train")


def policy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The learned policy as an agent that samples its actions, for ``run_episode``."""
    return _agent(_sampled_action, state, problem, hparams)


def greedy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The learned policy of a run's `state`, `problem` and `hparams`, taking the mean action."""
    return _agent(_mean_action, state, problem, hparams)


_Run = tuple[State, Problem, Hparams]


def _agent(
    choose: Callable[..., tuple[jax.Array, PyTree]],
    state: State,
    problem: Problem,
    hparams: Hparams,
) -> Agent:
    require_run(problem, hparams)
    require_state(state)
    return Agent(Partial(choose, (state, problem, hparams)))


def _sampled_action(
    run: _Run, memory: PyTree, observation: PyTree, allowed: None, key: Key
) -> tuple[jax.Array, PyTree]:
    """Random: fails without a key, by which proofs refuse it."""
    state, problem, hparams = run
    mean, deviation = act(state, hparams, flat_observation(observation))
    action = mean + deviation * jax.random.normal(key, mean.shape, mean.dtype)
    return actions_of.as_action(problem.environment.actions, action, None), memory


def _mean_action(
    run: _Run, memory: PyTree, observation: PyTree, allowed: None, key: Key
) -> tuple[jax.Array, PyTree]:
    state, problem, hparams = run
    mean, _ = act(state, hparams, flat_observation(observation))
    return actions_of.as_action(problem.environment.actions, mean, None), memory


def act(state: State, hparams: Hparams, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The mean and standard deviation of the action at an `observation` ``float[..., O]``.

    Both ``float[..., A]``, in units of the action before clipping, of a run's `state` and `hparams`;
    differentiable in the parameters.

    Raises:
      ValueError: observations of another size, or a state of another learner.
    """
    validation.instance("hparams", hparams, Hparams, "trust_region.Hparams")
    require_state(state)
    size = state.moments.mean.shape
    if not hasattr(observation, "dtype") or jnp.shape(observation)[-1:] != size:
        raise ValueError(
            f"observation is {validation.shorten(observation)}; the policy was trained on vectors "
            f"float[..., {size[0]}], as flat_observation makes of an environment's."
        )
    return gaussian(state.parameters, hparams, normalized(state.moments, hparams, observation))


def rollout(
    key: Key,
    state: State,
    problem: Problem,
    hparams: Hparams,
    *,
    num_trajectories: int,
    sampled: bool = True,
) -> Batch:
    """The :class:`Batch` of `num_trajectories` trajectories of the policy, of a random `key`.

    Of a run's `state`, `problem` and `hparams`; actions are `sampled`, or the policy's mean is taken;
    both static. Sums over its first axis are those of trajectories.
    """
    require_run(problem, hparams)
    require_state(state)
    number = validation.integer("num_trajectories", num_trajectories, least=1, most=2**31 - 1)
    return _rollout(
        require_key(key), state, problem, hparams, number, validation.boolean("sampled", sampled)
    )


@partial(jax.jit, static_argnames=("num_trajectories", "sampled"))
def _rollout(
    key: Key, state: State, problem: Problem, hparams: Hparams, num_trajectories: int, sampled: bool
) -> Batch:
    environment, size = problem.environment, (problem.horizon, num_trajectories)
    start, noise_key, step_key = jax.random.split(key, 3)
    worlds = jax.vmap(environment.reset)(jax.random.split(start, num_trajectories))

    def evaluate(memory: PyTree, observation: PyTree) -> Output:
        mean, deviation = act(state, hparams, flat_observation(observation))
        shape = some_action(environment.actions).shape
        action = (mean.reshape(shape), jnp.log(deviation).reshape(shape))
        return Output(memory, action, jnp.zeros((), mean.dtype))

    def one(world: PyTree, *chance: jax.Array) -> tuple[PyTree, Transition]:
        after, _, record = transition(environment, evaluate, None, (world, ()), *chance)
        return after, record

    def move(carry: PyTree, chance: PyTree) -> PyTree:
        worlds, active, cut = carry
        after, made = jax.vmap(one)(worlds, *chance)

        def held(x: jax.Array, y: jax.Array) -> jax.Array:
            return jnp.where(active.reshape(-1, *[1] * (x.ndim - 1)), x, y)

        worlds = jax.tree.map(held, after, worlds)
        vectors = jax.vmap(flat_observation)(made.observation), made.raw.reshape(size[1], -1)
        row = (*vectors, made.reward, made.cost, made.discount, active)
        cut |= active & made.truncated & ~made.terminated
        active &= ~(made.terminated | made.truncated)
        return (worlds, active, cut), row

    dtype, noise = state.parameters["log_deviation"].dtype, None
    if sampled:
        noise = actions_of.noise(noise_key, size, environment.actions, dtype)
    active = jnp.ones(num_trajectories, bool)
    (worlds, _, truncated), (observation, action, reward, cost, discount, valid) = lax.scan(
        move, (worlds, active, ~active), (noise, jax.random.split(step_key, size))
    )
    last = jax.vmap(partial(observed_vector, problem))(worlds)
    parts = (observation, action, reward[..., None], cost[..., None], discount[..., None])
    finite = jnp.array([jnp.all(jnp.all(jnp.isfinite(x), -1) | ~valid, 0) for x in parts]).all(
        0
    ) & (jnp.all(jnp.isfinite(last), -1) | ~truncated)
    valid &= finite
    truncated &= finite
    observation, action, reward, cost, discount = (
        jnp.where(valid[..., None], x, 0).astype(dtype) for x in parts
    )
    return Batch(
        observation,
        action,
        reward[..., 0],
        cost[..., 0],
        discount[..., 0],
        valid,
        finite,
        jnp.where(truncated[:, None], last, 0),
        truncated,
    )
