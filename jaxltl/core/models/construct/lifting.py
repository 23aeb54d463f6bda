"""Lifting and projection of trajectories and policies between a model and its product."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.validation import first_true
from jaxltl.core.models.game import Game
from jaxltl.core.models.ops import operators
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.action_numbers import named_actions, row_actions
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Model, PyTree, base_model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.models.trajectories import Trajectories, require_states
from jaxltl.core.policies.finite_memory import (
    Controller as Controller,
    FiniteMemoryPolicy as FiniteMemoryPolicy,
    Policy as Policy,
    Progress as Progress,
)
from jaxltl.core.models.product_policy import ProductPolicy
from jaxltl.core.types import Solution


def _product_of(model: Model) -> Product:
    """The product, also that of a game on one."""
    lazy = model.mdp if isinstance(model, Game) else model
    if not isinstance(lazy, Product):
        raise ValueError(f"model is a {type(lazy).__name__}; give product(world, formula).")
    return lazy


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
    model = _product_of(model)
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
    model = _product_of(model)
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
    valid: np.ndarray = inside & np.asarray(model.available)[(*place, action)]
    for n in first_true(inside.any(1) & ~valid.any(1)):
        raise ValueError(
            f"trajectory {n}: none of its {inside[n].sum()} steps takes an allowed action, so "
            "nothing can be learned from it; leave it out, or allow more."
        )
    return valid


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
    return jnp.repeat(policy[:, None], _product_of(model).num_memory, axis=1)


def project_policy(
    model: Model, policy: PyTree, *, actions: Sequence[str] = (), states: Sequence[str] = ()
) -> FiniteMemoryPolicy:
    """Policy of a product as a finite-memory policy of the base model, to run and to save.

    Args:
      model: a product, a model without memory, or a game on one of these; or the model that a
        formula was solved on.
      policy: ``float[S, Q, A]`` or ``int32[S, Q]``, or with an axis of T steps in front; for a sparse
        world also weights ``float[R, Q]`` of rows; or the :class:`Solution` of the model, of a
        formula with its `product_policy`.
      actions, states: names of the actions and of the base model's states.

    Returns:
      :class:`~jaxltl.core.policies.finite_memory.FiniteMemoryPolicy`.

    Raises:
      ValueError: the policy does not have the product's shape.

    Example:
      >>> import jaxltl as jl
      >>> prod = jl.product(jl.from_dense([[[0, 1.0]], [[0, 1.0]]], label={"a": [1]}), "F a")
      >>> found = jl.project_policy(prod, jnp.zeros((2, 2), jnp.int32))
      >>> found.action.shape, found.initial_memory.tolist(), found.next_memory.tolist()
      ((2, 2), [0, 1], [[0, 1], [1, 1]])
    """
    model = model.mdp if isinstance(model, Game) else model
    if isinstance(policy, Solution):
        policy = policy.policy if policy.product_policy is None else policy.product_policy
    world, table = base_model(model), policy
    rows = getattr(world, "nominal", world)
    rows = rows if isinstance(rows, SparseMDP) else None
    names = () if rows is None else named_actions(rows)[1]
    named = tuple(actions) or names, tuple(states)
    if isinstance(policy, ProductPolicy) and rows is not None:
        memory = Product(rows, policy.automaton, policy.letter, policy.label_on)
        count = len(policy.automaton.delta)
        number = row_actions(rows)
        table = np.repeat(number[np.asarray(rows.row_start)[:-1], None], count, axis=1)
        table[policy.product.base_state, policy.product.memory] = number[policy.row]
    elif isinstance(model, Product):
        memory = model
    else:
        memory, zeros = None, np.zeros((model.num_states, 1), np.int32)
    if rows is not None:
        table = with_named_actions(rows, table)
    elif memory is None:
        operators.policy_distribution(model, table)
    else:
        lead = np.ndim(table) - 2 - (not operators.is_deterministic(table))
        operators.policy_distribution(memory, table[0] if lead > 0 else table)
    if memory is None:
        table = jnp.expand_dims(jnp.asarray(table), 1)
        return FiniteMemoryPolicy(table, zeros[:, 0], zeros, "entry", None, None, *named)
    return FiniteMemoryPolicy(
        table,
        memory.initial_memory,
        memory.next_memory,
        memory.label_on,
        memory.automaton,
        memory.letter,
        *named,
    )


def with_named_actions(world: SparseMDP, policy: PyTree) -> jax.Array:
    """Actions ``[S, Q]`` or weights ``[S, Q, A]`` by the names' numbers, from a policy of a sparse world."""
    own, state, number = np.asarray(policy), world.host.state, row_actions(world)
    named, names = named_actions(world)
    if own.dtype.kind in "iu":
        if own.shape[:1] != (world.num_states,):
            raise ValueError(
                f"policy has shape {own.shape}; give actions int32[{world.num_states}, Q]."
            )
        row = np.full((world.num_states, int(number.max()) + 1), -1)
        row[state, number] = np.arange(number.size)
        place = np.arange(world.num_states).reshape(-1, *[1] * (own.ndim - 1))
        known = (own >= 0) & (own < row.shape[1])
        taken = np.where(known, row[place, np.where(known, own, 0)], -1)
        for at in map(tuple, np.argwhere(taken < 0)[:1].tolist()):
            raise ValueError(
                f"policy{list(at)} = {own[at]} is no action of its state; choose one of "
                f"{number[state == at[0]].tolist()}."
            )
        return jnp.asarray(named[taken].astype(np.int32))
    if own.shape[0] == world.num_states and own.ndim > 1 and own.shape[-1] > number.max():
        own = np.moveaxis(own, -1, 1)[state, number]
    width = max(int(named.max(initial=0)) + 1, len(names))
    weight = np.zeros((world.num_states, width, *own.shape[1:]), own.dtype)
    np.add.at(weight, (state, named), own)
    return jnp.asarray(np.moveaxis(weight, 1, -1))
