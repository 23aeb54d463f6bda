"""Sharded MDPs: states partitioned over the devices of a mesh, and their Bellman operators.

A device holds a range of the states with the rows of their choices, by local places: its own states
first, then those received before a sweep by one exchange, of a halo or of all values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxltl.core import struct, validation
from jaxltl.core.models.mesh.lanes import automatic, axes_of
from jaxltl.core.models.ops import kernels, operators
from jaxltl.core.models.ops.underflow import is_positive
from jaxltl.core.models.product import distinct_labels, letters_by_state
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.pretty_print import brief


class StateLayout(NamedTuple):
    """The assignment of states to devices."""

    mesh: Mesh
    axis: str
    num_unpadded: int
    order: np.ndarray | None = None

    @property
    def starts(self) -> np.ndarray:
        """The first state of each range, and S."""
        return np.arange(self.parts + 1) * self.num_unpadded // self.parts

    @property
    def size(self) -> int:
        return -(-self.num_unpadded // self.parts)

    def place(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The range of each state, and its place there."""
        range_ = np.searchsorted(self.starts, state, "right") - 1
        return range_, state - self.starts[range_]

    @property
    def parts(self) -> int:
        return int(self.mesh.shape[self.axis])

    @property
    def sharding(self) -> NamedSharding:
        return NamedSharding(self.mesh, PartitionSpec(self.axis))

    def devices(self, d: int) -> list[jax.Device]:
        """The devices with the d-th range, more than one where the mesh has other axes."""
        along = self.mesh.axis_names.index(self.axis)
        return list(np.moveaxis(self.mesh.devices, along, 0)[d : d + 1].ravel())

    def owner(self, d: int) -> int:
        """The process that sends a range's data."""
        return int(min(device.process_index for device in self.devices(d)))

    @property
    def mine(self) -> list[int]:
        """The ranges of which this process holds a copy."""
        here, each = jax.process_index(), range(self.parts)
        return [d for d in each if any(x.process_index == here for x in self.devices(d))]

    def span(self, d: int) -> tuple[int, int]:
        return int(self.starts[d]), int(self.starts[d + 1])

    def array(self, pieces: Mapping[int, np.ndarray]) -> jax.Array:
        arrays = [
            jax.device_put(piece, device)
            for d, piece in pieces.items()
            for device in self.devices(d)
            if device.process_index == jax.process_index()
        ]
        some = next(iter(pieces.values()))
        shape = (some.shape[0] * self.parts, *some.shape[1:])
        return jax.make_array_from_single_device_arrays(shape, self.sharding, arrays)

    def replicated(self, x: np.ndarray) -> jax.Array:
        return jax.make_array_from_callback(
            x.shape, NamedSharding(self.mesh, PartitionSpec()), lambda index: x[index]
        )

    def exchanged(self, pieces: Mapping[int, np.ndarray]) -> list[np.ndarray]:
        """The pieces of all ranges, in every process; only their first axes differ."""
        if jax.process_count() == 1:
            return [pieces[d] for d in range(self.parts)]
        from jax.experimental import multihost_utils

        length = np.zeros(self.parts, np.int64)
        for d, piece in pieces.items():
            length[d] = len(piece)
        length = np.asarray(multihost_utils.process_allgather(length)).max(0)
        some = next(iter(pieces.values()))
        padded = np.zeros((self.parts, int(length.max()), *some.shape[1:]), some.dtype)
        for d, piece in pieces.items():
            padded[d, : len(piece)] = piece
        # As bytes, since JAX may be restricted to single precision.
        every = np.asarray(multihost_utils.process_allgather(padded.view(np.uint8)))
        return [
            np.ascontiguousarray(every[self.owner(d), d]).view(some.dtype)[: length[d]]
            for d in range(self.parts)
        ]


def state_layout(num_states: int, mesh: Mesh, axis: str | None) -> StateLayout:
    """Layout of states on the devices of a mesh axis."""
    validation.instance("mesh", mesh, Mesh, "a jax.sharding.Mesh, such as jax.make_mesh makes")
    names = axes_of(mesh, axis)
    if len(names) != 1:
        raise ValueError(f"the mesh has axes {mesh.axis_names}; name one of them as axis.")
    axis = names[0]
    if num_states < mesh.shape[axis]:
        raise ValueError(
            f"{num_states} states cannot lie on {mesh.shape[axis]} devices; give a mesh of fewer."
        )
    return StateLayout(automatic(mesh), axis, num_states)


class ShardedRowTable(NamedTuple):
    """Rows of one width, by local places."""

    successor: Array  # int32[M, W]
    probability: Array  # float[M, W], zero in padding

    def fill(self, place: tuple[Array, Array], successor: Array, probability: Array) -> None:
        """Sets entries of a table of NumPy arrays."""
        self.successor[place], self.probability[place] = successor, probability


@brief
@struct.dataclass
class ShardedMDP:
    """Labelled MDP distributed over the devices of a mesh axis; see :func:`~jaxltl.models.shard`.

    All devices have the same number of the N places for states; padded places hold absorbing states
    without reward and initial probability.

    Attributes:
      tables: the rows by width; those of a device are contiguous.
      place: ``int32[N, A]``, the local row of each choice, over all tables; None: one table, in the order
        of states and actions.
      available: ``bool[N, A]``.
      sent: for each round of an exchange ``int32[D * H]``, the local states that a device sends.
      initial: ``float[N]``, the initial distribution.
      kind, label_rows: ``int32[N]`` and ``bool[U, P]``; ``label_rows[kind]`` are the labels of the states.
      rewards: expected rewards of choices by name, ``float[N, A]``.
      number, row: ``int32[N]`` and ``int32[N, A]``, the state and the row of the original model, or -1;
        `row` only for a sparse original model, else None.
      propositions: the P names; static.
      num_unpadded: S, the states of the original model; static.
      mesh, axis: the devices, and the mesh axis of the states; static.
      rounds: for each round the pairs (source, target) of devices; None: all-gather; static.

    >>> import jaxltl as jl
    >>> path = jl.make_sparse(None, [0, 1, 2], [1, 1], [1, 1])
    >>> model = jl.models.shard(path, jax.make_mesh((1,), ("states",)))
    >>> model.num_unpadded, model.num_devices, model.num_exchanged
    (2, 1, 0)
    """

    tables: tuple[ShardedRowTable, ...]
    place: jax.Array | None
    available: jax.Array
    sent: tuple[jax.Array, ...]
    initial: jax.Array
    kind: jax.Array
    label_rows: jax.Array
    rewards: dict[str, jax.Array]
    number: jax.Array
    row: jax.Array | None
    propositions: tuple[str, ...] = struct.field(pytree_node=False)
    num_unpadded: int = struct.field(pytree_node=False)
    mesh: Mesh = struct.field(pytree_node=False)
    axis: str = struct.field(pytree_node=False)
    rounds: tuple[tuple[tuple[int, int], ...], ...] | None = struct.field(pytree_node=False)

    @property
    def num_states(self) -> int:
        """N, padded states included."""
        return self.available.shape[0]

    @property
    def num_actions(self) -> int:
        """A, the largest number of choices of a state."""
        return self.available.shape[1]

    @property
    def state_shape(self) -> tuple[int, ...]:
        """The shape of a value: ``(N,)``."""
        return (self.num_states,)

    @property
    def num_successors(self) -> int:
        """The largest number of successors of a choice."""
        return int(max(table.successor.shape[1] for table in self.tables))

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the probabilities."""
        return cast(np.dtype, np.dtype(self.tables[0].probability.dtype))

    @property
    def label(self) -> jax.Array:
        """``bool[N, P]``, the propositions that hold in each state."""
        return kernels.gather(self.label_rows, self.kind)

    @property
    def num_devices(self) -> int:
        """D."""
        return int(self.mesh.shape[self.axis])

    @property
    def sharding(self) -> NamedSharding:
        """The sharding of arrays ``[N, ...]``."""
        return NamedSharding(self.mesh, PartitionSpec(self.axis))

    @property
    def num_exchanged(self) -> int:
        """The number of values communicated before a sweep."""
        if self.rounds is None:
            return self.num_states * (self.num_devices - 1)
        each = (x.shape[0] // self.num_devices for x in self.sent)
        return sum(len(pairs) * size for pairs, size in zip(self.rounds, each, strict=True))


def is_sharded(model: Model) -> bool:
    """True if a model, or the base model of a product or a game, is distributed."""
    while not isinstance(model, ShardedMDP) and hasattr(model, "mdp"):
        model = model.mdp
    return isinstance(model, ShardedMDP)


def refuse_sharded(model: Model) -> None:
    """Raises ValueError for a distributed model, naming the supported functions."""
    while hasattr(model, "mdp"):
        model = model.mdp
    if isinstance(model, ShardedMDP):
        raise ValueError(validation.unsupported_model(model))


def over_devices(model: ShardedMDP, function: Callable[..., PyTree], *arguments: PyTree) -> PyTree:
    """``function(*arguments)`` on each device's share of the arguments."""
    spec = PartitionSpec(model.axis)
    return jax.shard_map(function, mesh=model.mesh, in_specs=spec, out_specs=spec)(*arguments)


def seen_by(model: ShardedMDP, sent: tuple[jax.Array, ...], value: jax.Array) -> jax.Array:
    """On a device: its own values and the received ones, by local place."""
    if model.rounds is None:
        return cast(jax.Array, lax.all_gather(value, model.axis, tiled=True))
    parts = [value]
    for index, pairs in zip(sent, model.rounds, strict=True):
        parts.append(lax.ppermute(kernels.gather(value, index), model.axis, pairs))
    return jnp.concatenate(parts)


@operators.combined.register
def _(model: ShardedMDP, value: jax.Array, term: kernels.Term, combine: kernels.Term) -> jax.Array:
    def one(
        tables: PyTree, place: Array, sent: PyTree, available: Array, value: jax.Array
    ) -> jax.Array:
        seen = seen_by(model, sent, value)
        if place is None:
            shape = (*available.shape, -1)
            ((successor, weight),) = tables
            return kernels.by_action(
                successor.reshape(shape), weight.reshape(shape), seen, term, combine
            )
        rows = jnp.concatenate([_rows(table, seen, term, combine) for table in tables])
        return jnp.moveaxis(kernels.gather(rows, place), 1, -1)

    return cast(
        jax.Array,
        over_devices(
            model, one, model.tables, model.place, model.sent, model.available, jnp.asarray(value)
        ),
    )


def _rows(
    table: ShardedRowTable, seen: jax.Array, term: kernels.Term, combine: kernels.Term
) -> jax.Array:
    successor, weight = table
    width = successor.shape[1]
    if width > kernels.UNROLL:
        return kernels.folded(successor, weight, seen, term, combine, axis=1)
    return kernels.fold(kernels.columns(successor), kernels.columns(weight), seen, term, combine)


@operators.greatest_predecessor.register
def _(model: ShardedMDP, quantity: jax.Array) -> jax.Array:
    def one(tables: PyTree, place: Array, sent: PyTree, quantity: jax.Array) -> jax.Array:
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
            used = is_positive(weight).reshape(count, width, *(1,) * len(wide))
            seen = seen.at[successor].max(jnp.where(used, mine, 0))
            first += count
        if model.rounds is None:
            # The largest value from all devices at each state of this device.
            every = lax.all_to_all(
                seen.reshape(model.num_devices, size, *wide), model.axis, 0, 0, tiled=False
            )
            return cast(jax.Array, every.max(axis=0))
        rows, first = seen[:size], size
        for index, pairs in zip(sent, model.rounds, strict=True):
            back = [(target, source) for source, target in pairs]
            part = lax.ppermute(seen[first : first + index.size], model.axis, back)
            rows = rows.at[index].max(part)
            first += index.size
        return rows

    available, missing = model.available, quantity.ndim - model.available.ndim
    available = available.reshape(available.shape[0], *(1,) * missing, available.shape[1])
    quantity = jnp.where(available, quantity, 0)
    return cast(
        jax.Array, over_devices(model, one, model.tables, model.place, model.sent, quantity)
    )


@distinct_labels.register
def _(world: ShardedMDP) -> np.ndarray:
    return np.asarray(world.label_rows)


@letters_by_state.register
def _(world: ShardedMDP, letter: np.ndarray) -> jax.Array:
    return cast(jax.Array, _looked_up(world.kind, letter))


_looked_up = jax.jit(lambda kind, letter: kernels.gather(letter, kind))


@operators.unpadded_states.register
def _(model: ShardedMDP) -> jax.Array:
    return model.number >= 0


@operators.policy_operator.register
def _(model: ShardedMDP, policy: jax.Array) -> Callable[[jax.Array], jax.Array]:
    def one(
        tables: PyTree, place: Array, sent: PyTree, available: Array, policy: Array, value: Array
    ) -> Array:
        seen = seen_by(model, sent, value)
        if place is None:
            shape = (*available.shape, -1)
            pick = policy[:, None, None]
            chosen = (jnp.take_along_axis(x.reshape(shape), pick, 1)[:, 0] for x in tables[0])
            return _rows(ShardedRowTable(*chosen), seen, jnp.multiply, jnp.add)
        rows = [_rows(table, seen, jnp.multiply, jnp.add) for table in tables]
        row = jnp.take_along_axis(place, policy[:, None], 1)[:, 0]
        return kernels.gather(jnp.concatenate(rows), row)

    return lambda value: over_devices(
        model, one, model.tables, model.place, model.sent, model.available, policy, value
    )
