"""Successor and predecessor tables of models, for sweeps.

States are numbered in the order of their arrays (``s * Q + q`` for a product). Swept values have
the states first and a batch axis last, so that one gather moves whole rows of the batch. The
transposed sweep gathers from predecessor lists, since XLA on a CPU runs scatters sequentially.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct

from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.mesh.sharded import ShardedMDP, over_devices, seen_by
from jaxltl.core.models.ops import kernels, operators
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.ops.choices import (
    Columns,
    RowEntries,
    action_columns as action_columns,
    row_entries,
)
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Model, PyTree
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.pretty_print import brief

_LARGEST = 2**22  # transitions up to which those of a product are tabulated
_WIDEST = 6  # predecessor lists are at most this many times wider than successor lists


@brief
class SuccessorTable(NamedTuple):
    """Successors of all state-action pairs, ``[A, K, N]``: an array ``[N]`` for each action and successor."""

    # Separate arrays are contiguous in every layout of XLA, which lets it vectorise the loops over
    # states. Small tables are one array, for smaller programs.
    successor: list[list[jax.Array]] | jax.Array
    probability: list[list[jax.Array]] | jax.Array

    @property
    def choices(self) -> Columns:
        return Columns()

    def expectation(self, value: jax.Array) -> list[jax.Array]:
        """Expected value of the next state, ``[N, ...]`` for each action, from ``[N, ...]``."""
        if not (isinstance(self.successor, list) or isinstance(self.probability, list)):
            return list(kernels.folded(self.successor, self.probability, value, axis=1))
        pairs = zip(self.successor, self.probability, strict=True)
        return [kernels.fold(targets, weights, value) for targets, weights in pairs]


@brief
@struct.dataclass
class ModelOperator:
    """The operator of a `model` without a table: too wide, too large or of another representation."""

    model: Model

    @property
    def choices(self) -> Columns:
        return Columns()

    def expectation(self, value: jax.Array) -> list[jax.Array]:
        shape = self.model.state_shape

        def one(value: jax.Array) -> list[jax.Array]:
            values = operators.expectation(self.model, value.reshape(shape))
            return [x.ravel() for x in jnp.moveaxis(values, -1, 0)]

        if value.ndim == 1:
            return one(value)
        return jax.vmap(one, in_axes=-1, out_axes=-1)(value)


@brief
@struct.dataclass
class ShardedSuccessorTable:
    """The :class:`SuccessorTable` of a model on a mesh, by local places."""

    model: ShardedMDP
    successor: list[list[jax.Array]]
    probability: list[list[jax.Array]]

    @property
    def choices(self) -> Columns:
        return Columns()

    def expectation(self, value: jax.Array) -> list[jax.Array]:

        def one(
            successor: PyTree, probability: PyTree, sent: PyTree, value: jax.Array
        ) -> list[jax.Array]:
            seen = seen_by(self.model, sent, value)
            pairs = zip(successor, probability, strict=True)
            return [kernels.fold(targets, weights, seen) for targets, weights in pairs]

        return cast(
            list[jax.Array],
            over_devices(self.model, one, self.successor, self.probability, self.model.sent, value),
        )


@brief
class PredecessorTable(NamedTuple):
    """State-action pairs ``a * N + i`` that lead to each state, padded with probability zero."""

    pair: jax.Array  # int32[P, N]
    probability: jax.Array  # float[P, N]

    def pushforward(self, mass: jax.Array) -> jax.Array:
        """Mass that flows into each state: ``[N, ...]`` from ``[A * N, ...]``."""
        return kernels.fold(list(self.pair), list(self.probability), mass)


def sweep_operator(
    model: Model,
) -> SuccessorTable | ShardedSuccessorTable | ModelOperator | RowEntries:
    """The fastest operator for sweeps over a model: a table where it fits, else :class:`ModelOperator`."""
    world = model.mdp if isinstance(model, Game) else model
    if isinstance(world, SparseMDP):
        return row_entries(world)
    if isinstance(world, ShardedMDP) and (ranges := _spread_out(world)):
        return ranges
    return successor_table(model) or ModelOperator(model)


def _spread_out(model: ShardedMDP) -> ShardedSuccessorTable | None:
    num_actions, width = model.num_actions, model.num_successors
    if model.place is not None or num_actions * width > kernels.WRITTEN_OUT:
        return None
    successor, probability = (
        [kernels.columns(x.reshape(-1, num_actions, width)[:, a]) for a in range(num_actions)]
        for x in model.tables[0]
    )
    return ShardedSuccessorTable(model, successor, probability)


def successor_table(model: Model) -> SuccessorTable | None:
    """The successor table of an MDP, a product of one, or a game on them; None if too large."""
    model = model.mdp if isinstance(model, Game) else model
    world = model.mdp if isinstance(model, Product) else model
    if not isinstance(world, MDP) or not isinstance(model, MDP | Product):
        return None
    num_pairs = int(np.prod(world.probability.shape[-2:]))
    if num_pairs > kernels.WRITTEN_OUT:
        return None
    if isinstance(model, Product) and model.num_states * num_pairs > _LARGEST:
        return None
    return SuccessorTable(*map(_columns, operators.flat_transitions(model)))


def _columns(entries: jax.Array) -> list[list[jax.Array]] | jax.Array:
    """``[N, A, K]`` as arrays ``[N]``, or as one ``[A, K, N]``."""
    if entries.size <= kernels.FEW:
        return jnp.moveaxis(entries, 0, -1)
    return [kernels.columns(entries[:, a]) for a in range(entries.shape[1])]


def predecessor_table(models: Sequence[Model]) -> PredecessorTable | None:
    """Predecessor tables of models of one shape, ``[W, P, N]``; None where padding would waste too much."""
    table_of = jax.jit(successor_table)
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
    return PredecessorTable(to_jax(pairs), to_jax(probability))
