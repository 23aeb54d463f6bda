"""Lifting and projection of trajectories and policies between a model and its product."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct

from jaxltl.core.models import facts
from jaxltl.core.models.ops import operators
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel
from jaxltl.core.models.trajectories import Trajectories, require_states
from jaxltl.core.pretty_print import brief


def lift_trajectories(model: Product, trajectories: Trajectories) -> Trajectories:
    """Trajectories of the base model with the automaton states along them.

    Args:
      model, trajectories: the product, and trajectories of the base model.

    Returns:
      Trajectories of the product, with states ``s * Q + q``.

    Raises:
      ValueError: trajectories of another model.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.make_mdp([[[1]], [[2]], [[2]]], [[[1.0]], [[1.0]], [[1.0]]], label={"a": [1]})
      >>> runs = jl.models.make_trajectories(path, [[(0, 0), (1, 0), (2, 0)]])
      >>> lift_trajectories(jl.product(path, "F a"), runs).state.tolist()  # s * Q + q
      [[0, 3, 5]]
    """
    require_states(trajectories, model.mdp)
    if is_traced((model, trajectories)):
        return _lifted(model, trajectories)
    state = np.asarray(trajectories.state)
    lifted = np.where(trajectories.mask, state * model.num_memory + memory_along(model, state), 0)
    return replace(
        trajectories, state=to_jax(lifted.astype(np.int32)), state_shape=model.state_shape
    )


def _lifted(model: Product, trajectories: Trajectories) -> Trajectories:
    delta = jnp.asarray(model.automaton.delta)

    def one(states: jax.Array) -> jax.Array:
        letter = model.letter[states]
        read = letter[1:] if model.label_on == "entry" else letter[:-1]
        start = model.initial_memory[states[0]]
        _, rest = jax.lax.scan(lambda q, x: (delta[q, x],) * 2, start, read)
        return states * model.num_memory + jnp.concatenate([start[None], rest])

    inside = jnp.arange(trajectories.state.shape[1]) < trajectories.length[:, None]
    state = jax.vmap(one)(trajectories.state)
    return replace(
        trajectories,
        state=jnp.where(inside, state, 0).astype(jnp.int32),
        state_shape=model.state_shape,
    )


def project_trajectories(model: Product, trajectories: Trajectories) -> Trajectories:
    """Trajectories of a product without the memory; the inverse of :func:`lift_trajectories`.

    Args:
      model, trajectories: the product, and trajectories in it.

    Returns:
      :class:`Trajectories` of the base model.

    Raises:
      ValueError: trajectories of another model.

    Example:
      >>> import jaxltl as jl
      >>> prod = jl.product(jl.from_dense([[[0, 1.0]], [[0, 1.0]]], label={"a": [1]}), "F a")
      >>> runs = jl.models.Trajectories(jnp.array([[0, 3]]), jnp.zeros((1, 2), int), jnp.array([2]))
      >>> project_trajectories(prod, runs).state.tolist()
      [[0, 1]]
    """
    require_states(trajectories, model)
    return replace(
        trajectories,
        state=trajectories.state // model.num_memory,
        state_shape=model.mdp.state_shape,
    )


def memory_along(model: Product, state: np.ndarray) -> np.ndarray:
    """Automaton states along trajectories ``int[N, T]`` of the base model, continued in padding."""
    delta, letter = np.asarray(model.automaton.delta), np.asarray(model.letter)[state]
    read = letter[:, 1:] if model.label_on == "entry" else letter[:, :-1]
    memory = np.empty_like(state)
    memory[:, 0] = np.asarray(model.initial_memory)[state[:, 0]]
    for t in range(read.shape[1]):
        memory[:, t + 1] = delta[memory[:, t], read[:, t]]
    return memory


def allowed_steps(model: ActionModel, trajectories: Trajectories) -> np.ndarray:
    """Steps of the base model's trajectories with an available action, ``bool[N, T]``."""
    world = model.mdp if isinstance(model, Product) else model
    require_states(trajectories, world)
    state, action, inside = (
        np.asarray(x) for x in (trajectories.state, trajectories.action, trajectories.mask)
    )
    place = (state, memory_along(model, state)) if isinstance(model, Product) else (state,)
    kept = inside & np.asarray(model.available)[(*place, action)]
    if (lost := np.flatnonzero(inside.any(1) & ~kept.any(1))).size:
        n = lost[0]
        raise ValueError(
            f"trajectory {n}: none of its {inside[n].sum()} steps takes an allowed action, so "
            "nothing can be learned from it; leave it out, or allow more."
        )
    return kept


def lift_policy(model: Product, policy: jax.Array) -> jax.Array:
    """Memoryless policy of the base model as a policy of the product.

    Args:
      model, policy: the product, and a policy ``[S, ...]`` of the base model.

    Returns:
      ``[S, Q, ...]``, the same in all memory states. Differentiable in the policy.

    Example:
      >>> import jaxltl as jl
      >>> prod = jl.product(jl.from_dense([[[0, 1.0]], [[0, 1.0]]], label={"a": [1]}), "F a")
      >>> lift_policy(prod, jnp.array([0, 0])).shape
      (2, 2)
    """
    return jnp.repeat(policy[:, None], model.num_memory, axis=1)


@brief(facts=facts.memory_policy)
@struct.dataclass
class FiniteMemoryPolicy:
    """A policy of the base model with the automaton state as its memory.

    Attributes:
      action: ``float[S, Q, A]`` or ``int32[S, Q]``, the product policy.
      initial_memory: ``int32[S]``, the memory of the initial state s.
      next_memory: ``int32[S, Q]``, the memory after reading the label of s.
      label_on: static, as in :class:`Product`.

    Example:
      >>> import jaxltl as jl
      >>> prod = jl.product(jl.from_dense([[[0, 1.0]], [[0, 1.0]]], label={"a": [1]}), "F a")
      >>> runs = jl.project_policy(prod, jnp.zeros((2, 2), jnp.int32))
      >>> runs.initial_memory.tolist(), runs.next_memory.tolist()
      ([0, 1], [[0, 1], [1, 1]])
    """

    action: jax.Array
    initial_memory: jax.Array
    next_memory: jax.Array
    label_on: str = struct.field(pytree_node=False, default="entry")

    def update(self, memory: jax.Array, state: jax.Array, successor: jax.Array) -> jax.Array:
        """The memory after the step from `state` to `successor`."""
        return self.next_memory[successor if self.label_on == "entry" else state, memory]


def project_policy(model: Product, policy: jax.Array) -> FiniteMemoryPolicy:
    """Product policy as a finite-memory policy of the base model.

    Args:
      model, policy: the product, and ``float[S, Q, A]`` or ``int32[S, Q]``.

    Returns:
      :class:`FiniteMemoryPolicy`.

    Raises:
      ValueError: the policy does not have the product's shape.

    Example:
      >>> import jaxltl as jl
      >>> prod = jl.product(jl.from_dense([[[0, 1.0]], [[0, 1.0]]], label={"a": [1]}), "F a")
      >>> project_policy(prod, jnp.zeros((2, 2), jnp.int32)).action.shape
      (2, 2)
    """
    operators.policy_distribution(model, policy)
    return FiniteMemoryPolicy(policy, model.initial_memory, model.next_memory, model.label_on)
