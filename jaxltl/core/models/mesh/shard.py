"""Distribution of models and of quantities over the devices of a mesh."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple, cast

import jax
import numpy as np
from jax.sharding import Mesh
from numpy.typing import ArrayLike, DTypeLike

from jaxltl.core import validation
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.mesh.lanes import on_host
from jaxltl.core.models.mdp import MDP, DenseMDP
from jaxltl.core.models.mesh.sharded import ShardedRowTable, ShardedMDP, StateLayout, state_layout
from jaxltl.core.models.ops.underflow import target_dtype, underflow_text, underflows
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.models.sparse import (
    Rewards,
    SparseMDP,
    choice_reward,
    refuse_underflow,
    sparse_part,
)
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.rows import offsets_from_counts, row_entries

_WIDTHS = np.array(sorted({int(m * 2**e) for e in range(26) for m in (1, 1.5)} | {3}))
_PADDED = 1.25  # size of a single table of all rows, relative to the transitions, at most
_HALO = 0.6  # fraction of the other devices' values from which on all of them are sent


@brief
@dataclass(frozen=True)
class ModelPart:
    """A range of states of a model, with their choices.

    Attributes:
      entry_start: ``int[r + 1]``.
      successor: ``int[t]``, state numbers of the whole model.
      probability: ``float[t]``; rows sum to one.
      row_start: ``int[n + 1]``; None: one row in each state.
      action: ``int[r]``, action numbers; default: the rank in the state.
      initial: ``float[n]``; default: uniform over all states.
      label: ``bool[n, P]``.
      rewards: expected rewards of rows by name, ``float[r]``.
      row: ``int[r]``, row numbers of the whole model, for quantities on rows in :func:`to_mesh`.

    >>> part = ModelPart(np.arange(3), np.array([1, 0]), np.ones(2))  # a cycle of two states
    >>> part.successor.tolist(), part.row_start is None
    ([1, 0], True)
    """

    entry_start: np.ndarray
    successor: np.ndarray
    probability: np.ndarray
    row_start: np.ndarray | None = None
    action: np.ndarray | None = None
    initial: np.ndarray | None = None
    label: np.ndarray | None = None
    rewards: Mapping[str, np.ndarray] = field(default_factory=dict)
    row: np.ndarray | None = None


def shard(
    model: Model, mesh: Mesh, *, axis: str | None = None, order: str | np.ndarray = "given"
) -> ShardedMDP:
    """A model distributed over the devices of a mesh axis.

    Accepted by solvers of discounted and soft values, reachability, satisfaction and total rewards,
    inside ``jit`` too. All processes give the same model.

    Args:
      model: a concrete MDP, DenseMDP or SparseMDP.
      mesh, axis: the devices, and the mesh axis of the states; default: the only one.
      order: ``"given"``: contiguous ranges of state numbers; ``"near"``: reverse Cuthill-McKee order
        (1969), which reduces communication; or a permutation ``int[S]``.

    Returns:
      :class:`~jaxltl.core.models.mesh.sharded.ShardedMDP`. The actions of a sparse model are those of
      :func:`~jaxltl.core.models.construct.padded.to_padded`.

    Raises:
      ValueError: an invalid model, axis or order, or a probability that is zero or subnormal in JAX's
        default precision.

    >>> from jaxltl import from_dense
    >>> sharded = shard(from_dense([[[0.5, 0.5]], [[0.0, 1.0]]]), jax.make_mesh((1,), ("states",)))
    >>> from_mesh(sharded, to_mesh(sharded, np.array([1.0, 2.0]))).tolist()
    [1.0, 2.0]
    """
    sparse = to_sparse(model)
    host, column = sparse.host, row_actions(sparse)
    ordered = _order(sparse, order)
    place = np.empty(ordered.size, np.int64)
    place[ordered] = np.arange(ordered.size)
    rewards = {name: choice_reward(sparse, name) for name in sparse.rewards}
    initial, label = np.asarray(sparse.initial, np.float64), np.asarray(sparse.label)

    def part(start: int, stop: int) -> ModelPart:
        state = ordered[start:stop]
        row, choices = row_entries(host.row_start, state)
        entry, width = row_entries(host.entry_start, row)
        return ModelPart(
            row_start=offsets_from_counts(choices),
            entry_start=offsets_from_counts(width),
            successor=place[host.successor[entry]],
            probability=host.probability[entry],
            action=column[row],
            initial=initial[state],
            label=label[state],
            rewards={name: x[row] for name, x in rewards.items()},
            row=row,
        )

    # An action that is available nowhere has no rows, but a column in rewards and policies.
    num_actions = model.num_actions if isinstance(model, MDP | DenseMDP) else 1
    layout = state_layout(host.num_states, mesh, axis)._replace(order=ordered)
    return _assembled(part, layout, sparse.propositions, num_actions)


def model_from_parts(
    part: Callable[[int, int], ModelPart],
    num_states: int,
    mesh: Mesh,
    *,
    axis: str | None = None,
    propositions: tuple[str, ...] = (),
) -> ShardedMDP:
    """Distributed model from parts, for models that are too large for one process.

    Args:
      part: the :class:`ModelPart` of a range of states ``(start, stop)``; each process calls it for
        its own devices.
      num_states: S.
      mesh, axis: as for :func:`shard`.
      propositions: names of the labels.

    Returns:
      :class:`~jaxltl.core.models.mesh.sharded.ShardedMDP`.

    Raises:
      ValueError: an invalid part, naming the state and the value.

    >>> def cycle(start, stop):  # from each state to the next
    ...     state = np.arange(start, stop)
    ...     return ModelPart(np.arange(state.size + 1), (state + 1) % 10, np.ones(state.size))
    >>> model_from_parts(cycle, 10, jax.make_mesh((1,), ("states",))).num_states
    10
    """
    if not isinstance(num_states, int | np.integer) or num_states < 1:
        raise ValueError(
            f"num_states is {validation.shorten(num_states)}; give a whole number of at least 1."
        )
    layout = state_layout(int(num_states), mesh, axis)._replace(order=None)
    return _assembled(part, layout, tuple(propositions))


def ranges_of(num_states: int, mesh: Mesh, axis: str | None = None) -> list[tuple[int, int]]:
    """The ranges of states ``(start, stop)`` of this process's devices."""
    layout = state_layout(num_states, mesh, axis)
    return [layout.span(d) for d in layout.mine]


def to_mesh(model: ShardedMDP, quantity: Array, fill: Array = 0) -> jax.Array:
    """A quantity of the original model on the mesh.

    Args:
      model: the distributed model.
      quantity: ``[S, ...]`` on states or state-action pairs, or ``[R]`` on rows of a sparse model;
        concrete, and the same in every process.
      fill: the value at padded states and choices.

    Returns:
      ``[N, ...]``, of rows ``[N, A]``. Not differentiable in `quantity`.

    Raises:
      ValueError: a wrong shape, or a weight that underflows in the model's precision.

    >>> import jaxltl as jl
    >>> path = jl.make_sparse(None, [0, 1, 2], [1, 1], [1, 1])
    >>> to_mesh(shard(path, jax.make_mesh((1,), ("states",))), np.array([1.0, 2.0])).shape
    (2,)
    """
    quantity, index = np.asarray(quantity), model.number
    if quantity.shape[:1] != (model.num_unpadded,):
        index = _rows_of(model, quantity.shape)
    if quantity.dtype.kind == "f":
        if index is model.row or quantity.ndim > 1:
            _refuse_underflow(quantity, model.dtype)
        quantity = quantity.astype(model.dtype)
    sharding, pieces = model.sharding, {}
    for piece in index.addressable_shards:
        number = np.asarray(piece.data)
        taken = quantity[np.maximum(number, 0)]
        missing = (number < 0).reshape(*number.shape, *(1,) * (taken.ndim - number.ndim))
        pieces[piece.device] = np.where(missing, quantity.dtype.type(fill), taken)
    shape = (*index.shape, *quantity.shape[1:])
    return jax.make_array_from_single_device_arrays(
        shape, sharding, [jax.device_put(x, device) for device, x in pieces.items()]
    )


def _refuse_underflow(weight: np.ndarray, dtype: np.dtype) -> None:
    if (small := underflows(weight, dtype)) is not None:
        place = np.argwhere(small)[0].tolist()
        raise ValueError(f"the weight at {place} {underflow_text(weight[tuple(place)], dtype)}.")


def _rows_of(model: ShardedMDP, shape: tuple[int, ...]) -> jax.Array:
    available = int(jax.jit(lambda x: x.sum())(model.available))
    # The states that fill the last device have one choice each.
    if model.row is None or shape != (available - (model.num_states - model.num_unpadded),):
        raise ValueError(
            f"the quantity has shape {shape}; expected ({model.num_unpadded}, ...), a number for each "
            "state or each pair of a state and an action, or for each choice of a sparse model."
        )
    return model.row


def from_mesh(model: ShardedMDP, quantity: jax.Array) -> np.ndarray:
    """A quantity ``[N, ...]`` on the mesh as one of the original model, collected in every process.

    Args:
      model, quantity: the distributed model, and an array ``[N, ...]``, such as a solution's value.

    Returns:
      A NumPy array ``[S, ...]``.

    >>> import jaxltl as jl
    >>> path = jl.make_sparse(None, [0, 1, 2], [1, 1], [1, 1])
    >>> model = shard(path, jax.make_mesh((1,), ("states",)))
    >>> from_mesh(model, to_mesh(model, np.array([1.0, 2.0]))).tolist()
    [1.0, 2.0]
    """
    number, laid = on_host((model.number, quantity))
    result = np.zeros((model.num_unpadded, *laid.shape[1:]), laid.dtype)
    result[number[number >= 0]] = laid[number >= 0]
    return result


# --- parts ----------------------------------------------------------------------------------------


def _order(model: SparseMDP, order: ArrayLike) -> np.ndarray:
    host = model.host
    if isinstance(order, str):
        if order not in ("given", "near"):
            raise ValueError(f'order={order!r}; it must be "given", "near" or the states in order.')
        if order == "given":
            return np.arange(host.num_states)
        from scipy.sparse import csgraph, csr_array

        start = host.entry_start[host.row_start]
        one = np.ones(host.num_transitions, np.int8)
        graph = csr_array((one, host.successor, start), shape=(host.num_states,) * 2)
        return np.asarray(csgraph.reverse_cuthill_mckee(graph.tocsr(), symmetric_mode=False))
    order = np.asarray(order)
    if order.shape != (host.num_states,) or not np.array_equal(
        np.sort(order), np.arange(host.num_states)
    ):
        raise ValueError(f"order must hold each of the {host.num_states} states once.")
    return order


# --- assembling -----------------------------------------------------------------------------------


def _assembled(
    part: Callable[[int, int], ModelPart],
    layout: StateLayout,
    propositions: tuple[str, ...],
    num_actions: int = 1,
) -> ShardedMDP:
    parts, rows = {}, {}
    for d in layout.mine:
        parts[d], rows[d] = _checked(part, layout, d, propositions)
    facts = np.concatenate(layout.exchanged({d: _facts(x) for d, x in parts.items()}))
    facts[:, _ACTIONS] = np.maximum(facts[:, _ACTIONS], num_actions)
    halo = _halo(layout, parts)
    total = facts[:, _INITIAL].sum()
    if abs(total - 1) > validation.ROW_SUM_TOLERANCE:
        raise ValueError(f"the initial distribution sums to {total:.9g}, not 1.")
    labels = np.unique(
        np.concatenate(layout.exchanged({d: np.unique(x.label, axis=0) for d, x in parts.items()})),
        axis=0,
    )
    pieces = {}
    for d, x in parts.items():
        tables, place = _tables(layout, halo, facts, d, x)
        pieces[d] = _of_states(layout, facts, d, x, rows[d], labels)
        pieces[d] |= {"tables": tables, "place": place}
    whole = jax.tree.map(
        lambda *each: layout.array(dict(zip(pieces, each, strict=True))), *pieces.values()
    )
    return ShardedMDP(
        **whole,
        sent=tuple(layout.array(x) for x in halo.sent),
        label_rows=layout.replicated(labels),
        propositions=propositions,
        num_unpadded=layout.num_unpadded,
        mesh=layout.mesh,
        axis=layout.axis,
        rounds=halo.rounds,
    )


def _checked(
    part: Callable[[int, int], ModelPart], layout: StateLayout, d: int, names: tuple[str, ...]
) -> tuple[SparseMDP, np.ndarray | None]:
    """The validated range of a device as a sparse model, and the numbers of its rows."""
    start, stop = layout.span(d)
    place, count, piece = f"part({start}, {stop})", stop - start, part(start, stop)
    if not isinstance(piece, ModelPart):
        raise ValueError(f"{place} is {validation.shorten(piece)}; it must return a ModelPart.")
    starts = piece.entry_start if piece.row_start is None else piece.row_start
    if np.size(starts) != count + 1:
        raise ValueError(f"{place} has {np.size(starts) - 1} states; it must have {count}.")
    initial = np.full(count, 1 / layout.num_unpadded)
    if piece.initial is not None:
        initial = validation.float_array("initial", piece.initial)
    label = np.zeros((count, len(names)), bool) if piece.label is None else piece.label
    num_rows = np.size(piece.entry_start) - 1
    row = np.empty(num_rows) if piece.row is None else piece.row
    shapes = {
        "initial": (initial, (count,)),
        "label": (label, (count, len(names))),
        "row": (row, (num_rows,)),
    }
    for name, (x, shape) in shapes.items():
        if np.shape(x) != shape:
            raise ValueError(f"{place}: {name} has shape {np.shape(x)}; expected {shape}.")
    model = sparse_part(
        piece.row_start,
        piece.entry_start,
        piece.successor,
        piece.probability,
        (start, 0, 0),
        layout.num_unpadded,
        label=label,
        propositions=names,
        action=piece.action,
        rewards={name: Rewards(choice=x) for name, x in piece.rewards.items()},
    )
    dtype, host = target_dtype(np.float64), model.host
    refuse_underflow(host.row_start, host.entry_start, host.probability, dtype, first=start)
    if (small := underflows(initial, dtype)) is not None:
        s = int(np.argmax(small))
        raise ValueError(
            f"initial probability of state {start + s} {underflow_text(initial[s], dtype)}."
        )
    return replace(model, initial=initial), piece.row


_ACTIONS, _WIDEST, _TRANSITIONS, _INITIAL, _COUNTS = range(5)


def _facts(part: SparseMDP) -> np.ndarray:
    """Actions, widest row, transitions, initial mass, and the number of rows of each width."""
    width = np.diff(part.host.entry_start)
    limits = row_actions(part).max(initial=0) + 1.0, width.max(initial=1)
    counts = np.bincount(np.searchsorted(_WIDTHS, width), minlength=_WIDTHS.size)
    return np.array([[*limits, part.num_transitions, part.initial.sum(), *counts]])


class _Halo(NamedTuple):
    """The communication before a sweep."""

    layout: StateLayout
    rounds: PyTree
    sent: list[dict[int, np.ndarray]]
    requested: list[np.ndarray] | None  # the states that each range asks for, in order
    first: dict[tuple[int, int], int]  # the first place of each received range

    def own(self, d: int) -> int:
        """The place of a device's first own state."""
        return d * self.layout.size if self.requested is None else 0

    def places(self, d: int, successor: np.ndarray) -> np.ndarray:
        owner, position = self.layout.place(successor)
        if self.requested is None:
            return cast(np.ndarray, (owner * self.layout.size + position).astype(np.int32))
        for e in np.unique(owner[owner != d]):
            here = owner == e
            of_e = _within(self.requested[d], *self.layout.span(int(e)))
            position[here] = self.first[d, int(e)] + np.searchsorted(of_e, successor[here])
        return position.astype(np.int32)


def _within(ascending: np.ndarray, start: int, stop: int) -> np.ndarray:
    return ascending[slice(*np.searchsorted(ascending, (start, stop)))]


def _halo(layout: StateLayout, parts: Mapping[int, SparseMDP]) -> _Halo:
    count, size = layout.parts, layout.size
    requested = {}
    for d, part in parts.items():
        wanted = np.zeros(layout.num_unpadded, bool)
        wanted[part.successor] = True
        wanted[slice(*layout.span(d))] = False
        requested[d] = np.flatnonzero(wanted)
    lengths = np.concatenate(
        layout.exchanged({d: np.array([x.size]) for d, x in requested.items()})
    )
    if lengths.sum() > _HALO * layout.num_unpadded * (count - 1):
        return _Halo(layout, None, [], None, {})
    every = layout.exchanged(requested)
    rounds, sent, first, begins = [], [], {}, size
    for k in range(1, count):
        lists = [_within(x, *layout.span((d + k) % count)) for d, x in enumerate(every)]
        longest = max(x.size for x in lists)
        if not longest:
            continue
        rounds.append(tuple(((d + k) % count, d) for d, x in enumerate(lists) if x.size))
        pieces = {}
        for e in parts:
            asking = lists[(e - k) % count]
            pieces[e] = np.zeros(longest, np.int32)
            pieces[e][: asking.size] = asking - layout.starts[e]
        sent.append(pieces)
        first.update({(d, (d + k) % count): begins for d in range(count)})
        begins += longest
    return _Halo(layout, tuple(rounds), sent, every, first)


def _tables(
    layout: StateLayout, halo: _Halo, facts: np.ndarray, d: int, part: SparseMDP
) -> tuple[tuple[ShardedRowTable, ...], np.ndarray | None]:
    """Rows by width, and the row of each choice; padded states have self-loops."""
    num_actions, widest = (int(x) for x in facts[:, [_ACTIONS, _WIDEST]].max(0))
    host, action = part.host, row_actions(part)
    here, size, own, row = host.num_states, layout.size, halo.own(d), host.row
    successor, dtype = halo.places(d, host.successor), target_dtype(np.float64)
    width, rank = np.diff(host.entry_start), np.arange(row.size) - host.entry_start[row]
    if layout.parts * size * num_actions * widest <= _PADDED * facts[:, _TRANSITIONS].sum():
        table = _empty_table(size * num_actions, widest, dtype)
        table.fill(((host.state * num_actions + action)[row], rank), successor, host.probability)
        filled = np.arange(here, size)
        table.fill((filled * num_actions, 0), own + filled, 1)
        return (table,), None
    counts, kind = facts[:, _COUNTS:].max(0).astype(np.int64), np.searchsorted(_WIDTHS, width)
    # The first two rows are those of padded states and of missing choices.
    tables = [_empty_table(2, 1, dtype)]
    tables[0].fill((0, 0), own + min(here, size - 1), 1)
    place, begins = np.ones((size, num_actions), np.int32), 2
    place[here:, 0] = 0
    for c in np.flatnonzero(counts):
        rows, entry = np.flatnonzero(kind == c), kind[row] == c
        number = np.cumsum(kind == c) - 1
        table = _empty_table(int(counts[c]), int(_WIDTHS[c]), dtype)
        table.fill((number[row[entry]], rank[entry]), successor[entry], host.probability[entry])
        place[host.state[rows], action[rows]] = begins + np.arange(rows.size)
        tables.append(table)
        begins += int(counts[c])
    return tuple(tables), place


def _empty_table(rows: int, width: int, dtype: np.dtype) -> ShardedRowTable:
    return ShardedRowTable(np.zeros((rows, width), np.int32), np.zeros((rows, width), dtype))


def _of_states(
    layout: StateLayout,
    facts: np.ndarray,
    d: int,
    part: SparseMDP,
    row: np.ndarray | None,
    labels: np.ndarray,
) -> dict[str, PyTree]:
    """Quantities on a device's states and choices, by field of :class:`ShardedMDP`."""
    here, own, float_dtype = part.num_states, slice(*layout.span(d)), target_dtype(np.float64)
    num_actions, choice = int(facts[:, _ACTIONS].max()), (part.host.state, row_actions(part))

    def on_choices(x: Array, fill: float, dtype: DTypeLike) -> np.ndarray:
        array = np.full((layout.size, num_actions), fill, dtype)
        array[choice] = x
        return array

    def on_states(x: Array, fill: float, dtype: DTypeLike) -> np.ndarray:
        array = np.full(layout.size, fill, dtype)
        array[:here] = x
        return array

    available = on_choices(True, False, bool)
    if available.sum() != part.num_rows:
        raise ValueError(
            f"two choices of one of the states {layout.span(d)} have the same action; "
            "number them apart."
        )
    available[here:, 0] = True
    different, of = np.unique(part.label, axis=0, return_inverse=True)
    place_of = {labels_of_kind.tobytes(): i for i, labels_of_kind in enumerate(labels)}
    kind = np.array([place_of[x.tobytes()] for x in different], np.int32)[of.ravel()]
    number = np.arange(own.start, own.stop) if layout.order is None else layout.order[own]
    return {
        "available": available,
        "initial": on_states(part.initial, 0, float_dtype),
        "kind": on_states(kind, 0, np.int32),  # padded states have some label that occurs
        "rewards": {name: on_choices(x.choice, 0, float_dtype) for name, x in part.rewards.items()},
        "number": on_states(number, -1, np.int32),
        "row": None if row is None else on_choices(row, -1, np.int32),
    }
