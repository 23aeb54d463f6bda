"""Compiled engines of undiscounted questions: padded models inside ``jit`` and over a mesh."""

from __future__ import annotations

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.mesh.sharded import ShardedMDP
from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.models.ops.operators import require_policy
from jaxltl.core.models.ops.state_sets import state_set
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Array, Model
from jaxltl.core.models.sparse import Reward, Rewards
from jaxltl.core.types import Solution, require_shape
from jaxltl.core.values.door.question import (
    Accuracy,
    Question,
    Reach,
    TotalReward,
    require_infinite,
)
from jaxltl.core.values.engine.host_solution import default_tolerance
from jaxltl.core.values.undiscounted import optimum
from jaxltl.core.values.undiscounted.traced_total_reward import total_reward_by_sweeps

World = MDP | DenseMDP | ShardedMDP


def reach(
    model: Model,
    question: Question,
    accuracy: Accuracy,
    *,
    method: str = "auto",
    max_steps: jax.Array | int | None = None,
    start: tuple[jax.Array, jax.Array] | None = None,
) -> Solution:
    """Probabilities of reaching a set in padded models, by interval iteration or a linear system."""
    path, policy, tolerance = question.path, question.policy, accuracy.tolerance
    assert isinstance(path, Reach)
    target, padded = state_set(model, "target", path.target), cast(ActionModel, model)
    if policy is None:
        return optimum.optimal_reachability(
            padded, target, tolerance, max_steps, start, objective=question.objective
        )
    require_policy(model, policy)
    limit = 1_000_000 if max_steps is None else max_steps
    return optimum.policy_reachability(padded, policy, target, tolerance, limit, method=method)


def earn(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Total rewards of padded models inside ``jit`` and over a mesh."""
    path, policy = question.path, question.policy
    assert isinstance(path, TotalReward)
    world: Array = model.mdp if isinstance(model, Product) else model
    reward = path.reward
    require_infinite(path)
    target = state_set(model, "target", path.target)
    padded = cast(ActionModel, model)
    earned = _on_choices(padded, world, reward)
    _require_rewards(padded, world, earned)
    requested = default_tolerance(model) if accuracy.tolerance is None else accuracy.tolerance
    return total_reward_by_sweeps(
        padded, earned, target, policy, requested, objective=question.objective
    )


def _on_choices(model: ActionModel, world: World, reward: Reward) -> Array:
    """A reward as one on actions: ``float[S, A]``."""
    actions = (*model.state_shape, model.num_actions)
    if reward is None or isinstance(reward, str | Rewards):
        named = world.rewards if isinstance(world, ShardedMDP) else {}
        if reward not in named:
            known = f"; it has {', '.join(named)}" if named else ": give an array"
            raise ValueError(
                f"reward={reward!r} is no reward of this {type(world).__name__}{known}."
            )
        earned = named[reward]
        return earned if world is model else jnp.broadcast_to(earned[:, None], actions)
    if np.shape(reward) == model.state_shape:
        return jnp.broadcast_to(jnp.asarray(reward)[..., None], actions)
    require_shape("reward", reward, actions)
    return reward


def _require_rewards(model: ActionModel, world: World, reward: Array) -> None:
    least, state = _least_reward(model, world, reward)
    # Inside jit the status is NONFINITE.
    if not isinstance(least, jax.core.Tracer) and not least >= 0:
        raise _negative(state, least)


def _negative(state: Array | int, reward: Array | float) -> ValueError:
    return ValueError(
        f"the reward of a choice of state {state} is {reward:.6g}; expected total rewards need "
        "rewards of at least 0."
    )


@jit()
def _least_reward(model: ActionModel, world: World, reward: Array) -> tuple[jax.Array, jax.Array]:
    """The least reward of an available action, and its state; NaN if one is NaN."""
    least = jnp.min(jnp.where(model.available, reward, jnp.inf), axis=-1)
    least = least.reshape(world.num_states, -1).min(-1)
    if isinstance(world, ShardedMDP):
        least = jnp.where(world.number >= 0, least, jnp.inf)
        number = world.number
    else:
        number = jnp.arange(world.num_states)
    return jnp.min(least), number[jnp.argmin(least)]
