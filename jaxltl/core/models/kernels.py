"""Successors and predecessors of numbered states, for sweeps whose speed matters.

A model's states are numbered in order of their arrays (``s * Q + q`` in a product). One
gather per action and successor then reads all that a sweep needs, and the transposed sweep
gathers from lists of predecessors: XLA runs a scatter on a CPU one entry at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import Product

_WRITTEN_OUT = 64  # transitions per state up to which a sweep is written out
_WIDEST = 6  # predecessor lists are at most this many times wider than successor lists


class Successors(NamedTuple):
    """Where the pairs of a model lead, an array ``[N]`` for each action and successor.

    Separate arrays lie side by side in memory whatever layout XLA chooses, without which
    its loops over states are not vectorised.

    Attributes:
      successor: ``int32[N]``, by action and number of the successor.
      probability: ``float[N]``, likewise.
    """

    successor: list[list[jax.Array]]
    probability: list[list[jax.Array]]

    def expectation(self, value: jax.Array) -> list[jax.Array]:
        """Expected value of the next state, ``[N, ...]`` for each action, from ``[N, ...]``."""
        result = []
        for targets, weights in zip(self.successor, self.probability, strict=True):
            terms = [_times(w, _gather(value, t)) for t, w in zip(targets, weights, strict=True)]
            result.append(reduce(jnp.add, terms))
        return result


class Predecessors(NamedTuple):
    """The pairs that lead to each state, ``a * N + i``, padded with probability zero.

    Attributes:
      pair: ``int32[P, N]``.
      probability: ``float[P, N]``.
    """

    pair: jax.Array
    probability: jax.Array

    def pushforward(self, mass: jax.Array) -> jax.Array:
        """Mass that flows into each state: ``[N, ...]`` from ``[A * N, ...]``."""
        pairs = zip(self.pair, self.probability, strict=True)
        terms = [_times(w, _gather(mass, i)) for i, w in pairs]
        return reduce(jnp.add, terms)


def _times(weight: jax.Array, rows: jax.Array) -> jax.Array:
    return weight.reshape(weight.shape + (1,) * (rows.ndim - 1)) * rows


def _gather(value: jax.Array, index: jax.Array) -> jax.Array:
    return value.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def successors(model: Any) -> Successors | None:
    """The successor table of an MDP or of a product of one; None where it is too wide."""
    world = model.mdp if isinstance(model, Product) else model
    if not isinstance(world, MDP) or np.prod(world.probability.shape[-2:]) > _WRITTEN_OUT:
        return None
    if world is model:
        return Successors(_columns(world.successor), _columns(world.probability))
    num_memory, memory = model.num_memory, model.next_memory
    shape = (*model.state_shape, *world.successor.shape[1:])
    if model.label_on == "exit":
        after = jnp.broadcast_to(memory[:, :, None, None], shape)
    else:
        after = jnp.swapaxes(memory[world.successor], 1, -1)  # [S, Q, K, A]
        after = jnp.swapaxes(after, 2, 3)
    flat = world.successor[:, None] * num_memory + after
    probability = jnp.broadcast_to(world.probability[:, None], shape)
    rows = (model.num_states, *shape[2:])
    return Successors(_columns(flat.reshape(rows)), _columns(probability.reshape(rows)))


def _columns(table: jax.Array) -> list[list[jax.Array]]:
    """``[N, A, K]`` as arrays ``[N]``."""
    _, num_actions, width = table.shape
    return [[table[:, a, k] for k in range(width)] for a in range(num_actions)]


def predecessors(models: Sequence[Any]) -> Predecessors | None:
    """The predecessor lists of models of one shape, with a leading axis, on the host.

    Args:
      models: W models.

    Returns:
      Lists padded to the longest, ``[W, P, N]``; None if there is no successor table, or if
      some state has too many predecessors for that to pay.
    """
    table_of = jax.jit(successors)
    tables = [table_of(model) for model in models]
    lists = []
    for table in tables:
        if table is None:
            return None
        target, weight = (np.asarray(x) for x in table)
        num_actions, width, num_states = target.shape
        numbers = np.arange(num_actions * num_states).reshape(num_actions, 1, num_states)
        pair = np.broadcast_to(numbers, target.shape).ravel()
        used = weight.ravel() > 0
        target, weight, pair = target.ravel()[used], weight.ravel()[used], pair[used]
        order = np.argsort(target, kind="stable")
        target, weight, pair = target[order], weight[order], pair[order]
        count = np.bincount(target, minlength=num_states)
        rank = np.arange(target.size) - np.repeat(np.cumsum(count) - count, count)
        lists.append((target, rank, pair, weight, count.max()))
        if lists[-1][-1] > _WIDEST * num_actions * width:
            return None
    widest = max(x[-1] for x in lists)
    pairs = np.zeros((len(lists), widest, num_states), np.int32)
    probability = np.zeros(pairs.shape, weight.dtype)
    for w, (target, rank, pair, weight, _) in enumerate(lists):
        pairs[w, rank, target], probability[w, rank, target] = pair, weight
    return Predecessors(jnp.asarray(pairs), jnp.asarray(probability))
