"""Finite models and games as simulated environments."""

from __future__ import annotations

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.validation import first_true
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import (
    Environment,
    Timestep,
    make_box,
    make_environment,
    of_world,
)
from jaxltl.core.models import MDP, DenseMDP, Game, SparseMDP, sample_successor, to_padded
from jaxltl.core.models.construct.padded import pad_rows
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.sparse import Rewards, choice_reward


def model_environment(
    model: MDP | DenseMDP | SparseMDP | Game | POMDP,
    *,
    reward: ArrayLike | Rewards | str | None = None,
    observe: PyTree = None,
    opponent: ArrayLike | None = None,
) -> Environment:
    """The simulated environment of a finite MDP or POMDP, or of a game against a given opponent.

    States ``int32[]``, labels and available actions are the model's. Episodes have no end. In a game
    each move is a step, and on the opponent's turn its policy replaces the action.

    Args:
      model: an MDP, a DenseMDP, a SparseMDP, which is padded, a Game on one of them, or a POMDP.
      reward: ``float[S, A]``, of the action, or ``float[S]``, of the state in which it is taken, as for
        all solvers; of a sparse model also what
        :func:`~jaxltl.core.models.sparse.choice_reward` takes or returns, ``float[R]``. Default: zero.
      observe: ``state -> observation``; default: one-hot, of a POMDP the observation's number.
      opponent: ``float[S, A]``, the policy of the game's environment; default: uniform.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment`.

    Raises:
      ValueError: rewards or an opponent of another shape, an opponent without a game, or a product
        (use ``task_environment`` on its model).

    >>> from jaxltl import from_dense
    >>> coin = model_environment(from_dense(
    ...     [[[.5, .5]], [[0, 1]]], label=[[0], [1]], propositions=["heads"]))
    >>> coin.actions.num, coin.observations.shape, coin.labels(1).tolist()
    (1, (2,), [True])
    """
    observations = None
    if isinstance(model, POMDP):
        seen = np.asarray(model.observation)
        observations = None if observe is not None else make_box(0, 1, (model.num_observations,))
        if observe is None:
            observe = Partial(_one_hot_observation, jnp.zeros(model.num_observations), seen)
        model = model.fully_observable
    owner = model.system if isinstance(model, Game) else None
    model = model.mdp if isinstance(model, Game) else model
    if isinstance(model, SparseMDP):
        sparse, model = model, to_padded(model)
        if isinstance(reward, str | Rewards):
            reward = choice_reward(sparse, reward)
        rows = None if reward is None else np.asarray(reward)
        if rows is not None and rows.shape == (sparse.num_rows,) != (sparse.num_states,):
            reward = pad_rows(sparse, validation.float_array("reward", rows))
    if not isinstance(model, MDP | DenseMDP):
        raise ValueError(
            f"model_environment: {type(model).__name__} is no world; simulate the MDP under it, and "
            "give the task to task_environment."
        )
    size, num_actions = model.num_states, model.num_actions
    if observe is None:
        observations = make_box(0, 1, (size,))
    table = np.zeros(size) if reward is None else np.asarray(reward)
    if table.shape not in ((size,), (size, num_actions)) or table.dtype.kind not in "biuf":
        raise ValueError(
            f"reward has shape {list(table.shape)} and type {table.dtype}; give numbers [{size}], "
            f"of states, or [{size}, {num_actions}], of their actions."
        )
    table = np.broadcast_to(table.T, (num_actions, size)).T.astype(jnp.result_type(float))
    step, outcomes = Partial(_step, model, table), Partial(_outcomes, model, table)
    if owner is not None:
        other = _opponent(model, np.asarray(owner), opponent)
        step = Partial(_step_of_two, other, owner, step)
        outcomes = Partial(_outcomes_of_two, other, owner, outcomes)
    elif opponent is not None:
        raise ValueError("opponent is for games; make_game tells whose turn it is in a state.")
    return make_environment(
        Partial(_reset, model.initial),
        step,
        Partial(_one_hot, model.initial) if observe is None else observe,
        actions=num_actions,
        labels=Partial(_row, model.label),
        propositions=model.propositions,
        allowed=Partial(_row, model.available),
        observations=observations,
        starts=Partial(_starts, model.initial),
        outcomes=outcomes,
    )


def _starts(initial: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jnp.arange(len(initial), dtype=jnp.int32), jnp.asarray(initial)


def _reset(initial: jax.Array, key: Key) -> jax.Array:
    return jax.random.choice(key, len(initial), p=jnp.asarray(initial)).astype(jnp.int32)


def _step(
    model: MDP | DenseMDP, reward: jax.Array, state: jax.Array, action: jax.Array, key: Key
) -> Timestep:
    after = sample_successor(model, key, state, action).astype(jnp.int32)
    return Timestep(after, jnp.asarray(reward)[state, action], terminated=jnp.bool_(False))


def _outcomes(
    model: MDP | DenseMDP, reward: jax.Array, state: jax.Array, action: jax.Array
) -> tuple[Timestep, jax.Array]:
    probability = model.successor_probability[state, action]
    if isinstance(model, MDP):
        after = jnp.asarray(model.successor)[state, action].astype(jnp.int32)
    else:
        after = jnp.arange(model.num_states, dtype=jnp.int32)
    earned = jnp.broadcast_to(jnp.asarray(reward)[state, action], after.shape)
    return Timestep(after, earned, terminated=jnp.bool_(False)), probability


def _opponent(model: MDP | DenseMDP, system: np.ndarray, policy: ArrayLike | None) -> np.ndarray:
    """Logarithms of the opponent's policy."""
    available = np.asarray(model.available)
    plays = (
        available.astype(float) if policy is None else validation.float_array("opponent", policy)
    )
    if plays.shape != available.shape or not np.isfinite(plays).all() or (plays < 0).any():
        raise ValueError(
            f"opponent has shape {list(plays.shape)}; give weights "
            f"{list(available.shape)}, of each action in each state."
        )
    weight = np.where(available, plays, 0)
    for state in first_true(~system & ~weight.any(1)):
        raise ValueError(
            f"opponent: it moves in state {state}, but has no weight on what is "
            "available there; give some."
        )
    with np.errstate(divide="ignore"):
        weight[system] = 1
        return np.log(weight).astype(jnp.result_type(float))


def _step_of_two(
    opponent: jax.Array,
    system: jax.Array,
    step: PyTree,
    state: jax.Array,
    action: jax.Array,
    key: Key,
) -> Timestep:
    key, other = jax.random.split(key)
    reply = jax.random.categorical(other, jnp.asarray(opponent)[state])
    mine = jnp.asarray(system)[state]
    return cast(Timestep, step(state, jnp.where(mine, action, reply).astype(jnp.int32), key))


def _outcomes_of_two(
    opponent: jax.Array, system: jax.Array, outcomes: PyTree, state: jax.Array, action: jax.Array
) -> tuple[Timestep, jax.Array]:
    weight = jax.nn.softmax(jnp.asarray(opponent)[state])
    weight = jnp.where(jnp.asarray(system)[state], jnp.arange(len(weight)) == action, weight)
    outcome, probability = jax.vmap(lambda a: outcomes(state, a))(jnp.arange(len(weight)))
    outcome = Timestep(outcome.world.ravel(), outcome.reward.ravel(), terminated=jnp.bool_(False))
    return outcome, (weight[:, None] * probability).ravel()


def _one_hot(initial: jax.Array, state: jax.Array) -> jax.Array:
    return jax.nn.one_hot(state, len(initial))


def _one_hot_observation(like: jax.Array, seen: jax.Array, state: jax.Array) -> jax.Array:
    return jax.nn.one_hot(jnp.asarray(seen)[state], len(like))


def allows_all(environment: Environment) -> bool:
    """True if all actions are available in all states of a model's environment, or of a task in one.

    >>> from jaxltl import gridworld
    >>> allows_all(model_environment(gridworld("a .", initial="a")))
    True
    """
    function: PyTree = environment.allowed
    while isinstance(function, Partial) and function.func is of_world:
        (function,) = function.args
    is_table = isinstance(function, Partial) and function.func is _row
    return function is None or (is_table and bool(np.asarray(function.args[0]).all()))


def _row(table: jax.Array, state: jax.Array) -> jax.Array:
    return jnp.asarray(table)[state]
