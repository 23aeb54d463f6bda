"""Models as compiled solvers read them, and solutions in the original shape."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import validation
from jaxltl.core.models.construct.convert import product_rows, to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.mesh.sharded import ShardedMDP, is_sharded
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model, PyTree, base_model
from jaxltl.core.models.sparse import Reward, SparseMDP, reward_structure
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
        return _named_reward(model, reward)
    if isinstance(model, Product) and isinstance(model.mdp, SparseMDP):
        model = product_rows(model.mdp, model) if is_traced(model) else to_sparse(model)
    if hasattr(base_model(model), "nominal"):
        raise ValueError(validation.unsupported_model(base_model(model)))
    if not isinstance(model, SparseMDP):
        return model, reward
    if reward is not None:
        reward = reward_structure(model, reward)
    none = np.zeros((model.num_states, 0), bool)
    return replace(
        model, label=none, propositions=(), rewards={}, valuation={}, action=None, action_names=()
    ), reward


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
    """A solution of a model's compiled form, with the model's shape of states."""
    lazy = model.mdp if isinstance(model, Game) else model
    if not (is_sparse(lazy) and isinstance(lazy, Product)):
        return solution
    shape, policy = model.state_shape, solution.policy

    def one(x: jax.Array) -> jax.Array:
        return x.reshape(shape)

    return replace(
        solution,
        value=one(solution.value),
        lower=one(solution.lower),
        upper=one(solution.upper),
        policy=one(policy) if is_deterministic(policy) else policy,
    )


def flatten_policy(model: Model, policy: Array) -> Array:
    """A policy for the compiled form: of a product of a sparse model rows ``int32[S * Q]``."""
    if is_sparse(model) and isinstance(model, Product) and np.ndim(policy) == 2:
        return policy.reshape(-1)
    return policy
