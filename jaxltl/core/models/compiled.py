"""Models as compiled solvers read them, and solutions in the original shape."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.mesh.sharded import ShardedMDP, is_sharded
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.kernels import gather, segment_ids
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.models.product import Product, flat_successor
from jaxltl.core.models.protocols import Array, Model, PyTree
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
        model = _written_out(model) if is_traced(model) else to_sparse(model)
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


def _written_out(model: Product) -> SparseMDP:
    world: SparseMDP = model.mdp
    num_memory = model.num_memory
    row_start, entry_start = jnp.asarray(world.row_start), jnp.asarray(world.entry_start)
    # Rows of (s, q) are those of s, in order: state first, memory next, choice last.
    number = np.arange(model.num_states, dtype=np.int32)
    state, memory = number // num_memory, number % num_memory
    starts = _repeated(row_start, num_memory)
    of = segment_ids(starts, world.num_rows * num_memory)
    row = gather(row_start[state], of) + jnp.arange(of.size, dtype=jnp.int32) - starts[of]
    first = entry_start[row_start]  # of each state's entries
    begins = gather(_repeated(first, num_memory), of) + entry_start[row] - gather(first[state], of)
    begins = jnp.append(begins, world.num_transitions * num_memory).astype(entry_start.dtype)
    of_entry = segment_ids(begins, world.num_transitions * num_memory)
    entry = gather(entry_start[row], of_entry) + (
        jnp.arange(of_entry.size, dtype=jnp.int32) - begins[of_entry]
    )
    place = gather(of, of_entry)
    target = flat_successor(
        gather(world.successor, entry),
        model.next_memory,
        gather(state, place),
        gather(memory, place),
        model.label_on,
    )

    return SparseMDP(
        row_start=starts,
        entry_start=begins,
        successor=target.astype(jnp.int32),
        probability=gather(world.probability, entry),
        initial=model.initial.ravel(),
        label=world.label,
        rewards={n: x.gathered(state, row, entry) for n, x in world.rewards.items()},
    )


def _repeated(start: jax.Array, times: int) -> jax.Array:
    """The starts ``[S * times + 1]`` of segments, each of which is repeated `times` times."""
    width = jnp.diff(start)
    begins = start[:-1, None] * times + jnp.arange(times, dtype=start.dtype) * width[:, None]
    return jnp.append(begins.ravel(), start[-1] * times)
