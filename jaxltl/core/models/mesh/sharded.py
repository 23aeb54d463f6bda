"""Models whose states lie on the devices of a mesh, and how values get from one to another.

A device holds a range of the states with the rows of their choices. What a row leads to is numbered
as the device sees it: its own states first, then those of others that it is sent before a sweep. So
every sweep is the one of any other model, on what a device holds, after one exchange: of a halo
where most successors are near, of all values where they are not. All that solvers do besides is
elementwise or a reduction, which JAX splits over the mesh by itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxltl.core.models import facts
from jaxltl.core.models.ops import kernels, operators
from jaxltl.core.models.product import distinct_labels, letters_by_state
from jaxltl.core.models.protocols import Model
from jaxltl.core.pretty_print import brief
from jaxltl.core import validation


class RowTable(NamedTuple):
    """Rows of one width.

    Attributes:
      successor: ``int32[M, W]``, places among what the row's device sees.
      probability: ``float[M, W]``, zero in padding.
    """

    successor: Any
    probability: Any


@brief(facts=facts.sharded)
@struct.dataclass
class ShardedMDP:
    """A labelled decision process whose states lie on the devices of a mesh axis.

    Of N places for states, a device has the same number in a row. Those that are left over are
    filled with absorbing states, where nothing is earned and no run starts. Quantities on choices
    are ``[N, A]``. Make one with :func:`~jaxltl.core.models.mesh.shard.shard` or
    :func:`~jaxltl.core.models.mesh.shard.model_from_parts`, which also put quantities of the given model
    in its places and bring them back.

    Attributes:
      tables: the rows by their width; those of a device stand together.
      place: ``int32[N, A]``, which of its device's rows a choice is, over all tables; None: one
        table, in the order of states and actions.
      available: ``bool[N, A]``.
      sent: for each round of an exchange ``int32[D * H]``, which of its own states a device sends.
      initial: ``float[N]``, the initial distribution.
      kind: ``int32[N]``, which of the rows of `shown` a state's label is.
      shown: ``bool[U, P]``, the labels that occur.
      rewards: named expected rewards of choices, ``float[N, A]``.
      number: ``int32[N]``, of the state in the given model; -1 where there is none.
      row: ``int32[N, A]``, of the choice in the given sparse model; -1 where there is none. None
        if there was no such model.
      propositions: the P names, static.
      num_given: S, the states of the given model; static.
      mesh, axis: the devices, and over which of the mesh's axes the states lie; static.
      rounds: for each round the pairs (from, to) of devices; None: all values go to all; static.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.make_sparse(None, [0, 1, 2], [1, 1], [1, 1])
      >>> model = jl.shard(path, jax.make_mesh((1,), ("states",)))
      >>> model.num_given, model.num_devices, model.num_exchanged
      (2, 1, 0)
    """

    tables: tuple[RowTable, ...]
    place: jax.Array | None
    available: jax.Array
    sent: tuple[jax.Array, ...]
    initial: jax.Array
    kind: jax.Array
    shown: jax.Array
    rewards: dict[str, jax.Array]
    number: jax.Array
    row: jax.Array | None
    propositions: tuple[str, ...] = struct.field(pytree_node=False)
    num_given: int = struct.field(pytree_node=False)
    mesh: Mesh = struct.field(pytree_node=False)
    axis: str = struct.field(pytree_node=False)
    rounds: tuple[tuple[tuple[int, int], ...], ...] | None = struct.field(pytree_node=False)

    @property
    def num_states(self) -> int:
        """Places for states, filled ones among them."""
        return self.available.shape[0]

    @property
    def num_actions(self) -> int:
        """A, the most choices of a state."""
        return self.available.shape[1]

    @property
    def state_shape(self) -> tuple[int, ...]:
        """The shape of a value: ``(N,)``."""
        return (self.num_states,)

    @property
    def num_successors(self) -> int:
        """The most successors of a choice."""
        return max(table.successor.shape[1] for table in self.tables)

    @property
    def dtype(self) -> Any:
        """Of the probabilities."""
        return self.tables[0].probability.dtype

    @property
    def label(self) -> jax.Array:
        """``bool[N, P]``, which propositions hold in a state."""
        return kernels.gather(self.shown, self.kind)

    @property
    def num_devices(self) -> int:
        """Over which the states lie."""
        return self.mesh.shape[self.axis]

    @property
    def sharding(self) -> NamedSharding:
        """Of arrays ``[N, ...]``."""
        return NamedSharding(self.mesh, PartitionSpec(self.axis))

    @property
    def num_exchanged(self) -> int:
        """How many values go from device to device before a sweep, in all."""
        if self.rounds is None:
            return self.num_states * (self.num_devices - 1)
        each = (x.shape[0] // self.num_devices for x in self.sent)
        return sum(len(pairs) * size for pairs, size in zip(self.rounds, each, strict=True))


def is_sharded(model: Model) -> bool:
    """Whether a model, or the world of a product or a game, lies on a mesh."""
    while not isinstance(model, ShardedMDP) and hasattr(model, "mdp"):
        model = model.mdp
    return isinstance(model, ShardedMDP)


def refuse_sharded(model: Model) -> None:
    """Raises where something reads a model on the host, and it lies on a mesh.

    Raises:
      ValueError: it does, with what there is over a mesh.
    """
    while hasattr(model, "mdp"):
        model = model.mdp
    if isinstance(model, ShardedMDP):
        raise ValueError(validation.unsupported_model(model))


def over_devices(model: ShardedMDP, function: Any, *arguments: Any) -> Any:
    """``function(*arguments)`` on what each device has of them, side by side."""
    spec = PartitionSpec(model.axis)
    return jax.shard_map(function, mesh=model.mesh, in_specs=spec, out_specs=spec)(*arguments)


def seen_by(model: ShardedMDP, sent: tuple[jax.Array, ...], value: jax.Array) -> jax.Array:
    """On a device: its values and those that it is sent, in the order of its tables' places."""
    if model.rounds is None:
        return lax.all_gather(value, model.axis, tiled=True)
    parts = [value]
    for index, pairs in zip(sent, model.rounds, strict=True):
        parts.append(lax.ppermute(kernels.gather(value, index), model.axis, pairs))
    return jnp.concatenate(parts)


@operators.combined.register
def _(model: ShardedMDP, value: jax.Array, term: Any, combine: Any) -> jax.Array:
    def one(tables: Any, place: Any, sent: Any, available: Any, value: jax.Array) -> jax.Array:
        seen = seen_by(model, sent, value)
        if place is None:
            shape = (*available.shape, -1)
            ((successor, weight),) = tables
            return kernels.stacked(
                kernels.by_action(
                    successor.reshape(shape), weight.reshape(shape), seen, term, combine
                )
            )
        found = jnp.concatenate([_rows(table, seen, term, combine) for table in tables])
        return jnp.moveaxis(kernels.gather(found, place), 1, -1)

    return over_devices(
        model, one, model.tables, model.place, model.sent, model.available, jnp.asarray(value)
    )


def _rows(table: RowTable, seen: jax.Array, term: Any, combine: Any) -> jax.Array:
    successor, weight = table
    width = successor.shape[1]
    if width > kernels.UNROLL:
        return kernels.folded(successor, weight, seen, term, combine, axis=1)
    return kernels.fold(
        [successor[:, k] for k in range(width)],
        [weight[:, k] for k in range(width)],
        seen,
        term,
        combine,
    )


@operators.greatest_predecessor.register
def _(model: ShardedMDP, quantity: jax.Array) -> jax.Array:
    def one(tables: Any, place: Any, sent: Any, quantity: jax.Array) -> jax.Array:
        size = quantity.shape[0]
        wide = (*quantity.shape[1:-1],)
        last = jnp.moveaxis(quantity, -1, 1)
        if place is None:
            rows = last.reshape(-1, *wide)
        else:
            total = sum(table.successor.shape[0] for table in tables)
            rows = jnp.zeros((total, *wide), quantity.dtype).at[place].max(last)
        length = size + sum(x.shape[0] for x in sent)
        if model.rounds is None:
            length = size * model.num_devices
        seen, first = jnp.zeros((length, *wide), quantity.dtype), 0
        for successor, weight in tables:
            count, width = successor.shape
            mine = rows[first : first + count].reshape(count, 1, *wide)
            used = (weight > 0).reshape(count, width, *(1,) * len(wide))
            seen = seen.at[successor].max(jnp.where(used, mine, 0))
            first += count
        if model.rounds is None:
            # What all see of one another's, and of that the largest.
            every = lax.all_to_all(
                seen.reshape(model.num_devices, size, *wide), model.axis, 0, 0, tiled=False
            )
            return every.max(axis=0)
        found, first = seen[:size], size
        for index, pairs in zip(sent, model.rounds, strict=True):
            back = [(target, source) for source, target in pairs]
            part = lax.ppermute(seen[first : first + index.size], model.axis, back)
            found = found.at[index].max(part)
            first += index.size
        return found

    quantity = jnp.where(_across(model.available, quantity), quantity, 0)
    return over_devices(model, one, model.tables, model.place, model.sent, quantity)


def _across(available: jax.Array, quantity: jax.Array) -> jax.Array:
    """``[N, A]`` beside quantities ``[N, ..., A]``."""
    missing = quantity.ndim - available.ndim
    return available.reshape(available.shape[0], *(1,) * missing, available.shape[1])


@distinct_labels.register
def _(world: ShardedMDP) -> np.ndarray:
    return np.asarray(world.shown)


@letters_by_state.register
def _(world: ShardedMDP, letter: np.ndarray) -> jax.Array:
    return _looked_up(world.kind, letter)


_looked_up = jax.jit(lambda kind, letter: kernels.gather(letter, kind))


@operators.unpadded_states.register
def _(model: ShardedMDP) -> jax.Array:
    return model.number >= 0


@operators.expectation.register
def _(model: ShardedMDP, value: jax.Array) -> jax.Array:
    return operators.combined(model, value, jnp.multiply, jnp.add)


@operators.exists_successor.register
def _(model: ShardedMDP, region: jax.Array) -> jax.Array:
    return operators.combined(model, region, kernels.positive_hits, jnp.logical_or)


@operators.forall_successor.register
def _(model: ShardedMDP, region: jax.Array) -> jax.Array:
    return ~operators.exists_successor(model, ~jnp.asarray(region))


@operators.least_successor.register
def _(model: ShardedMDP, value: jax.Array) -> jax.Array:
    return operators.combined(model, value, kernels.where_positive, jnp.minimum)


@operators.policy_operator.register
def _(model: ShardedMDP, policy: jax.Array) -> Any:
    def one(tables: Any, place: Any, sent: Any, available: Any, policy: Any, value: Any) -> Any:
        seen = seen_by(model, sent, value)
        if place is None:
            shape = (*available.shape, -1)
            pick = policy[:, None, None]
            chosen = (jnp.take_along_axis(x.reshape(shape), pick, 1)[:, 0] for x in tables[0])
            return _rows(RowTable(*chosen), seen, jnp.multiply, jnp.add)
        found = [_rows(table, seen, jnp.multiply, jnp.add) for table in tables]
        row = jnp.take_along_axis(place, policy[:, None], 1)[:, 0]
        return kernels.gather(jnp.concatenate(found), row)

    return lambda value: over_devices(
        model, one, model.tables, model.place, model.sent, model.available, policy, value
    )


@operators.transition_matrix.register
def _(model: ShardedMDP, policy: jax.Array) -> jax.Array:
    eye = jnp.eye(model.num_states, dtype=model.dtype)
    ahead = operators.expectation(model, eye)  # [N, N, A]
    return jnp.einsum("nta,na->nt", ahead, policy)
