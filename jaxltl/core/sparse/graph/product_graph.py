"""Graph of a padded model or a lazy product on the host: successors, attractors, components.

The states of a product are pairs ``[S, Q]``; other models have one memory state, whose axis is not
shown. The product is not written out: rows are the world's, and the memory selects the entry of a
successor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse import rows as host_rows
from jaxltl.core.sparse.graph.attractor import Search, attract
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.rows import Rows, concatenated_ranges


@dataclass(frozen=True)
class HostGraph:
    """Graph operations of a model with NumPy; ``TracedGraph`` is their JAX form.

    Attributes:
      rows: the world's rows, numbered ``s * A + a``; none where an action is unavailable.
      world_available: ``bool[S, A]``.
      next_memory: ``int[S, Q]``, the memory after reading the label of a world state in q.
      letter: ``int[S]``, the letter of each world state.
      on_entry: whether the automaton reads the label of the state that is entered.
      state_shape: ``(S,)`` or ``(S, Q)``.
      allowed: ``bool[S, Q, A]``, a mask of the product's actions, or None.
    """

    rows: Rows
    world_available: Booleans
    next_memory: Integers
    letter: Integers
    on_entry: bool
    state_shape: tuple[int, ...]
    allowed: Booleans | None = None

    xp = np

    @property
    def num_actions(self) -> int:
        return self.world_available.shape[-1]

    @property
    def num_memory(self) -> int:
        return self.next_memory.shape[1]

    @cached_property
    def available(self) -> Booleans:
        """``bool[S, A]``."""
        lazy = self.world_available[:, None]
        shape = (*self.next_memory.shape, self.num_actions)
        lazy = np.broadcast_to(lazy, shape) if self.allowed is None else lazy & self.allowed
        return lazy.reshape(*self.state_shape, -1)

    @cached_property
    def memory_before(self) -> tuple[Integers, Integers]:
        """The memories q from which reading a letter leads to q', in order.

        They are ``q[start[c] : start[c + 1]]`` for the letter and q' of ``c = letter * Q + q'``.
        """
        reader = np.zeros(int(self.letter.max(initial=0)) + 1, np.int64)
        reader[self.letter[::-1]] = np.arange(self.letter.size)[::-1]
        after = self.next_memory[reader].astype(np.int64)  # [L, Q]
        code = (np.arange(reader.size)[:, None] * self.num_memory + after).ravel()
        count = np.bincount(code, minlength=reader.size * self.num_memory)
        order = np.argsort(code, kind="stable") % self.num_memory
        return np.concatenate([[0], count.cumsum()]), order

    def on_choices(self, states: Booleans) -> Booleans:
        """A set of states as a mask of actions: ``bool[S, 1]``."""
        return states[..., None]

    def exists(self, region: Booleans) -> Booleans:
        """Whether some successor lies in a region: ``bool[S, A]``; False where unavailable."""
        found = self.through(region, self.rows.some_successor_in).reshape(*self.state_shape, -1)
        return found if self.allowed is None else found & self.available

    def forall(self, region: Booleans) -> Booleans:
        """Whether all successors lie in a region: ``bool[S, A]``; True where unavailable."""
        return ~self.exists(~region)

    def least(self, value: Integers) -> Integers:
        """The smallest value among the successors: ``[S, A]``; the dtype's largest without any."""
        most = np.iinfo(value.dtype).max
        found = self.through(value, lambda x: self.rows.least(x, most))
        found = found.reshape(*self.state_shape, -1)
        return found if self.allowed is None else np.where(self.available, found, most)

    def through(
        self,
        value: NDArray[Any],
        reduce: Callable[[NDArray[Any]], NDArray[Any]],
        states: Any = slice(None),
    ) -> NDArray[Any]:
        """A reduction over the rows of some world states, through the memory: ``[N, Q, A]``."""
        value, num_memory = value.reshape(self.next_memory.shape), self.num_memory
        if num_memory == 1:
            return reduce(value[:, 0]).reshape(-1, 1, self.num_actions)
        if self.on_entry:
            value = np.take_along_axis(value, self.next_memory, 1)
        found = reduce(value).reshape(-1, self.num_actions, num_memory)
        if not self.on_entry:
            found = np.take_along_axis(found, self.next_memory[states][:, None], 2)
        return np.ascontiguousarray(found.swapaxes(1, 2))

    def reads(self, marked: Booleans) -> Booleans:
        """Whether an action can read a marked transition ``bool[Q, L]``: ``bool[S, Q, A]``."""
        here = marked[:, self.letter].T
        if not self.on_entry:
            return here[:, :, None] & self.available
        found = self.rows.some_successor_in(np.ascontiguousarray(here))
        found = found.reshape(-1, self.num_actions, self.num_memory).swapaxes(1, 2)
        return found if self.allowed is None else found & self.available

    def first(self, mask: Booleans) -> tuple[Booleans, Integers]:
        """Whether a mask ``bool[S, A]`` holds for some action, and the first one (or 0)."""
        return host_rows.first_action(mask)

    def attract(
        self, goal: Booleans, allowed: Booleans, rule: Booleans, among: Booleans, chance: str
    ) -> tuple[Booleans, Integers, Integers]:
        """Region, action and rank of an attractor."""
        shape = self.next_memory.shape
        search = Search(
            graph=self,
            chance=chance,
            region=goal.reshape(shape).copy(),
            action=self.first(self.available)[1].reshape(shape),
            rank=np.zeros(shape, np.int32),
            allowed=(allowed & self.available).reshape(*shape, -1),
            rule=rule.reshape(shape),
            open=(among & ~goal).reshape(shape),
        )
        attract(search)
        shape = self.state_shape
        return (
            search.region.reshape(shape),
            search.action.reshape(shape),
            (search.rank.reshape(shape)),
        )

    def components(
        self, core: Booleans, allowed: Booleans, closed: bool
    ) -> tuple[Integers, Booleans]:
        """Components among some states, ``int32[S]``, and the actions inside, ``bool[S, A]``.

        Maximal end components; or, if `closed`, bottom strongly connected components.
        """
        num_actions = self.num_actions
        states = np.flatnonzero(core)
        stay = (allowed & self.available).reshape(-1, num_actions)[states]
        local = np.full(core.size, -1)
        local[states] = np.arange(states.size)
        pair, target = self._edges(states)
        target = local[target]
        kept = stay.ravel()[pair] & (target >= 0)
        pair, target = pair[kept], target[kept]
        while True:
            source = pair // num_actions
            label = strong_components(source, target, states.size)
            crossing = label[source] != label[target]
            if closed:
                left = np.zeros(states.size, bool)
                left[label[source[crossing]]] = True
                stay &= ~left[label][:, None]
            if closed or not crossing.any():
                break
            stay.ravel()[pair[crossing]] = False
            kept = stay.ravel()[pair]
            pair, target = pair[kept], target[kept]
        component = np.arange(core.size, dtype=np.int32)
        alive = host_rows.some_action(stay)
        component[states[alive]] = states[label[alive]]
        inside = np.zeros((core.size, num_actions), bool)
        inside[states] = stay
        return component.reshape(self.state_shape), inside.reshape(*self.state_shape, -1)

    def _edges(self, states: Integers) -> tuple[Integers, Integers]:
        """Edges of some flat states: ``i * A + a`` for the i-th, and the flat successor."""
        num_actions, num_memory = self.num_actions, self.num_memory
        s, q = np.divmod(states, num_memory)
        row = (s[:, None] * num_actions + np.arange(num_actions)).ravel()
        count = self.rows.count[row]
        pair = np.repeat(np.arange(row.size), count)
        target = self.rows.successor[concatenated_ranges(self.rows.entry_start[row], count)]
        if num_memory == 1:
            return pair, target
        owner = pair // num_actions
        read = target if self.on_entry else s[owner]
        return pair, target.astype(np.int64) * num_memory + self.next_memory[read, q[owner]]

    def anywhere(self, mark: Booleans, component: Integers) -> Booleans:
        """Whether a state of the same component is marked: ``bool[S]``."""
        found = np.zeros(component.size, bool)
        found[component[mark]] = True
        return found[component]

    # --- loops and arrays ---------------------------------------------------------------------

    def repeat(self, body: Any, start: tuple[Any, ...]) -> tuple[Any, ...]:
        """Repeats `body` while the last entry of the carry is true."""
        while start[-1]:
            start = body(start)
        return start

    def times(self, count: Any, body: Any, start: Any) -> Any:
        """``body(i, carry)`` for i below a count."""
        for i in range(int(count)):
            start = body(i, start)
        return start
