"""Models as compiled solvers read them, and solutions in the original shape."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import validation
from jaxltl.core.models.construct.convert import product_rows, to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.mesh.sharded import ShardedMDP, is_sharded
from jaxltl.core.models.action_numbers import row_actions, rows_of_policy, weights_of_policy
from jaxltl.core.models.ops.array_namespace import is_traced, namespace
from jaxltl.core.models.ops.kernels import segment_ids
from jaxltl.core.models.ops.operators import is_deterministic, row_weights
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Array, Model, PyTree, base_model
from jaxltl.core.models.sparse import Reward, Rewards, SparseMDP, reward_structure
from jaxltl.core.types import Solution


def is_sparse(model: Model) -> bool:
    """True for a SparseMDP and a product of one."""
    return isinstance(model.mdp if isinstance(model, Product) else model, SparseMDP)


def compiled_form(model: Model, reward: Reward = None) -> tuple[PyTree, Array]:
    """A model and a reward for compiled solvers; only sparse models change."""
    # A product becomes a sparse model with the rows of `to_sparse`, inside `jit` too. Names, rewards
    # and variables, for which programs would be recompiled, are dropped.
    if isinstance(model, Game):
        form, reward = compiled_form(model.mdp, reward)
        system = jnp.asarray(model.system).reshape(form.state_shape)
        return (model if form is model.mdp else Game(form, system)), reward
    if is_sharded(model):
        return _of_actions(*_named_reward(model, reward))
    lazy = model
    if isinstance(model, Product) and isinstance(model.mdp, SparseMDP):
        model = product_rows(model.mdp, model) if is_traced(model) else to_sparse(model)
    if hasattr(base_model(model), "nominal"):
        raise ValueError(validation.unsupported_model(base_model(model)))
    if not isinstance(model, SparseMDP):
        return _of_actions(model, reward)
    if reward is not None:
        reward = reward_structure(model, _on_form(lazy, reward))
    none = np.zeros((model.num_states, 0), bool)
    return replace(
        model, label=none, propositions=(), rewards={}, valuation={}, action=None, action_names=()
    ), reward


def _on_form(lazy: Model, reward: Array) -> Reward:
    """A reward ``[S, A]`` of a sparse model, or ``[S, Q]`` or ``[S, Q, A]`` of a product, on its rows."""
    if isinstance(reward, str | Rewards) or np.ndim(reward) < 2:
        return reward
    shape = lazy.state_shape
    if np.shape(reward) == shape:
        return Rewards(state=reward.reshape(-1))
    if np.shape(reward)[:-1] != shape:
        return reward
    _, number, state, table = namespace(*_row_numbers(lazy), reward)
    return Rewards(choice=table.reshape(lazy.num_states, -1)[state, number])


def _of_actions(model: Model, reward: Array) -> tuple[Model, Array]:
    """A model, and a reward of states as one of its actions."""
    if reward is not None and jnp.shape(reward) == model.state_shape:
        actions = (*model.state_shape, cast(ActionModel, model).num_actions)
        reward = jnp.broadcast_to(jnp.asarray(reward)[..., None], actions)
    return model, reward


def _named_reward(model: Model, reward: Reward) -> tuple[Model, Array]:
    if isinstance(reward, str):
        rewards = getattr(model, "rewards", {})
        if reward not in rewards:
            names = ", ".join(map(repr, rewards)) or "none"
            raise ValueError(f"there is no reward {reward!r}; the model has {names}.")
        reward = rewards[reward]
    if isinstance(model, ShardedMDP):
        model = replace(model, rewards={}, propositions=())
    return model, reward


def reshape_solution(model: Model, solution: Solution) -> Solution:
    """A solution of a model's compiled form in the model's shape of states, with action numbers."""
    lazy = model.mdp if isinstance(model, Game) else model
    if not is_sparse(lazy):
        return solution
    shape, policy = model.state_shape, solution.policy

    def one(x: jax.Array) -> jax.Array:
        return x.reshape(shape)

    return replace(
        solution,
        value=one(solution.value),
        lower=one(solution.lower),
        upper=one(solution.upper),
        policy=one(jnp.asarray(_row_numbers(lazy)[0], jnp.int32)[policy])
        if is_deterministic(policy)
        else policy,
    )


def compiled_policy(model: Model, policy: Array, where: Array = True) -> Array:
    """A policy for the compiled form: of sparse models rows ``int32[S * Q]`` or weights ``float[R]``.

    The given one has actions ``int32[S]``, weights of actions ``float[S, A]``, or weights of rows. A
    concrete one is checked in the states `where`; of a traced one, an action that a state does not
    have becomes a row that no state has.
    """
    lazy = model.mdp if isinstance(model, Game) else model
    if policy is None or not is_sparse(lazy):
        return policy
    shape, count = lazy.state_shape, lazy.num_states
    is_action, flat = is_deterministic(policy), policy
    if (jnp.shape(policy) if is_action else jnp.shape(policy)[:-1]) == shape:
        flat = policy.reshape(count) if is_action else policy.reshape(count, -1)
    if not is_traced((lazy, policy, where)):
        sparse, where = to_sparse(lazy), np.broadcast_to(where, shape).ravel()
        row_weights(sparse, flat, where, shape)  # checks it
        if is_action:
            return jnp.asarray(rows_of_policy(sparse, flat, where), jnp.int32)
        return jnp.asarray(weights_of_policy(sparse, flat))
    flat, number, state = (jnp.asarray(x) for x in (flat, *_row_numbers(lazy)))
    if is_action and flat.shape == (count,):
        place = jnp.where(number == flat[state], jnp.arange(state.size), state.size)
        rows = jax.ops.segment_min(place, state, num_segments=count, indices_are_sorted=True)
        return rows.astype(jnp.int32)
    if flat.ndim == 2 and flat.shape[0] == count:
        known = number < flat.shape[1]
        return jnp.where(known, flat[state, jnp.where(known, number, 0)], 0)
    return flat


def _row_numbers(lazy: Model) -> tuple[Array, Array]:
    """The action number of each row of a sparse model or its product, and the state of each row."""
    if not is_traced(lazy):
        sparse = to_sparse(lazy)
        return row_actions(sparse), sparse.host.state
    world = lazy.mdp if isinstance(lazy, Product) else lazy
    assert isinstance(world, SparseMDP)
    form = product_rows(world, lazy) if isinstance(lazy, Product) else world
    state = segment_ids(form.row_start, form.num_rows)
    rank = jnp.arange(state.size) - jnp.asarray(form.row_start)[state]
    if form.action is None or world.action_names:
        return rank, state
    number = jnp.asarray(form.action)
    order = jnp.lexsort((number, state))
    same = (jnp.diff(number[order]) == 0) & (jnp.diff(state[order]) == 0)
    return jnp.where(same.any(), rank, number), state  # as SparseMDP.action_number
