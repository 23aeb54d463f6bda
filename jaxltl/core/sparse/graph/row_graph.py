"""Graph operations of models on sparse rows, with NumPy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Booleans, Integers, PyTree
from jaxltl.core.sparse.graph.attractor import attracted
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.mdp import HostGraph
from jaxltl.core.sparse.rows import concatenated_ranges, first_action, mask_of, offsets_from_counts


@dataclass(frozen=True)
class RowGraph:
    """Graph operations on rows; ``TracedGraph`` is their JAX form.

    A mask of choices has the shape of `available`. Rows of a padded model are numbered
    ``s * A + a``; an action of a sparse model is a row.
    """

    host: HostGraph  # without entries where an action is unavailable
    state_shape: tuple[int, ...]  # (S,), or (S, Q) of a product
    available: Booleans  # bool[S, A], or bool[R] of a sparse model
    letter: Integers | None = None  # int[S] of a product, the letter of each world state
    on_entry: bool = True  # the automaton reads the label of the entered state

    xp = np

    @property
    def is_padded(self) -> bool:
        """True if choices are actions."""
        return self.available.ndim > len(self.state_shape)

    def on_choices(self, states: Booleans) -> Booleans:
        """A set of states as a mask of choices: ``bool[S, 1]`` or ``bool[R]``."""
        return states[..., None] if self.is_padded else states[self.host.state]

    def exists(self, region: Booleans) -> Booleans:
        """Tests if some successor lies in a region; False where unavailable."""
        rows = self.host.support.some_successor_in(region.reshape(-1))
        return rows.reshape(self.available.shape)

    def forall(self, region: Booleans) -> Booleans:
        """Tests if all successors lie in a region; True where unavailable."""
        return ~self.exists(~region)

    def least(self, value: Integers) -> Integers:
        """The smallest value among the successors; the dtype's largest without any."""
        smallest = self.host.support.least(value.reshape(-1), np.iinfo(value.dtype).max)
        return smallest.reshape(self.available.shape)

    def reads(self, marked: Booleans) -> Booleans:
        """Tests if an action can read a marked transition ``bool[Q, L]``: ``bool[S, Q, A]``."""
        assert self.letter is not None
        here = marked[:, self.letter].T  # [S, Q]
        if not self.on_entry:
            return here[:, :, None] & self.available
        support, num_memory = self.host.support, self.state_shape[1]
        row = np.arange(support.num_rows) // self.available.shape[-1] % num_memory
        entry = self.host.successor // num_memory * num_memory + np.repeat(row, support.count)
        rows = support.reduce(np.logical_or, here.reshape(-1)[entry], False)
        return rows.reshape(self.available.shape)

    def first(self, mask: Booleans) -> tuple[Booleans, Integers]:
        """Tests if a mask holds for some choice of a state; and the first one (or first of all)."""
        return first_action(mask) if self.is_padded else self.host.first_choice(mask)

    def attract(
        self, goal: Booleans, allowed: Booleans, rule: Booleans, among: Booleans, chance: str
    ) -> tuple[Booleans, Integers, Integers]:
        """Region, choice and rank of an attractor."""
        allowed, shape = allowed & self.available, self.state_shape
        attraction = attracted(
            self.host,
            goal.reshape(-1),
            allowed.reshape(-1),
            exists=rule.reshape(-1),
            chance=chance,
            among=among.reshape(-1),
        )
        region, rank = attraction.region.reshape(shape), attraction.rank.reshape(shape)
        row = attraction.row - self.host.row_start[:-1] if self.is_padded else attraction.row
        joined = region & ~goal
        # Where every choice leads nearer none is better than the first.
        action = np.where(rule, row.reshape(shape), self.first(allowed)[1])
        action = np.where(joined, action, self.first(self.available)[1])
        return region, action.astype(np.int32), rank

    def components(
        self, core: Booleans, allowed: Booleans, closed: bool
    ) -> tuple[Integers, Booleans]:
        """Maximal end components, or BSCCs if `closed`, ``int32[S]``, and the choices inside."""
        host = self.host
        rows = (allowed & self.available).reshape(-1)
        if not closed:
            component, inside = end_components(host, core.reshape(-1), rows)
        else:
            used = rows[host.row]
            source, target = host.state[host.row[used]], host.successor[used]
            label = strong_components(source, target, host.num_states)
            crossing = label[source] != label[target]
            exited = mask_of(label[source[crossing]], host.num_states)
            inside = rows & ~exited[label][host.state]
            alive = host.first_choice(inside)[0]
            component = np.where(alive, label, np.arange(host.num_states))
        return (
            component.astype(np.int32).reshape(self.state_shape),
            inside.reshape(self.available.shape),
        )

    def anywhere(self, mark: Booleans, component: Integers) -> Booleans:
        """Tests if a state of the same component is marked: ``bool[S]``."""
        return mask_of(component[mark], component.size)[component]

    # --- loops --------------------------------------------------------------------------------

    def repeat(self, body: Callable[[PyTree], PyTree], start: PyTree) -> PyTree:
        """Repeats `body` while the last entry of the carry is true."""
        while start[-1]:
            start = body(start)
        return start

    def times(self, count: int, body: Callable[[int, PyTree], PyTree], start: PyTree) -> PyTree:
        """``body(i, carry)`` for i below a count."""
        for i in range(int(count)):
            start = body(i, start)
        return start


def product_graph(
    world: HostGraph,
    available: Booleans,
    memory: Integers,
    letter: Integers,
    *,
    on_entry: bool,
    allowed: Booleans | None,
) -> RowGraph:
    """The graph of a padded world with a memory, ``int[S, Q]`` after a state's label is read."""
    (num_states, num_memory), num_actions = memory.shape, available.shape[-1]
    shape = (num_states, num_memory, num_actions)
    count = np.broadcast_to(np.diff(world.entry_start).reshape(num_states, 1, -1), shape)
    lazy = np.broadcast_to(available[:, None], shape)
    if allowed is not None:
        count, lazy = count * allowed, lazy & allowed
    entry_start = offsets_from_counts(count.ravel())
    start = np.broadcast_to(world.entry_start[:-1].reshape(num_states, 1, -1), shape)
    target = world.successor[concatenated_ranges(start.ravel(), count.ravel())]
    width = count.sum(-1).ravel()
    target = target * entry_start.dtype.type(num_memory)
    if on_entry:
        target += np.tile(np.arange(num_memory, dtype=target.dtype), num_states).repeat(width)
        after = np.arange(num_states)[:, None] * num_memory + memory
        target = after.astype(np.int32).ravel()[target]
    else:
        target += memory.astype(target.dtype).ravel().repeat(width)
    row_start = np.arange(0, lazy.size + 1, num_actions)
    host = HostGraph(row_start, entry_start, target)
    return RowGraph(host, shape[:2], lazy, letter, on_entry)
