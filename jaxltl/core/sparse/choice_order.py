"""Permutation of choices for fast maxima and minima over the choices of each state."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.rows import concatenated_ranges

# Nanoseconds: of an operation on slices and on an entry of them, and of a reduction, on each of its
# spans and on an entry.
_SLICE, _ENTRY, _REDUCTION, _SPAN, _REDUCED = 1000, 0.25, 2000, 20, 0.15


class ChoiceOrder(NamedTuple):
    """The choices of N states, states with the most choices first, for reductions over slices.

    The first choices of all states come first, in order, then the second ones of states that have
    two, and so on. Where few states have further choices, these are listed state by state.
    """

    states: Integers  # int[N], the number of each state in the original order
    order: Integers  # int[R], each choice's original number, state by state
    owner: Integers  # int[R], the state of each choice, among `states`
    starts: list[int]  # starts of the first, second, ... choices, and the end
    further: Integers  # int[W], starts of the further choices of W states

    @property
    def is_chain(self) -> bool:
        """True if each state has one choice."""
        return self.order.size == self.states.size

    def best(self, quantity: Floats, operation: np.ufunc) -> Floats:
        """The optimum over the choices of each state, by ``np.maximum`` or ``np.minimum``."""
        if self.is_chain:
            return quantity
        optimum = quantity[: self.starts[1]].copy()
        for a, b in pairwise(self.starts[1:]):
            operation(optimum[: b - a], quantity[a:b], out=optimum[: b - a])
        if self.further.size:
            rest = operation.reduceat(quantity[self.starts[-1] :], self.further)
            operation(optimum[: rest.size], rest, out=optimum[: rest.size])
        return optimum

    def first(self, quantity: Floats, best: Floats) -> Integers:
        """The first choice that attains the optimum of each state: ``int[N]``."""
        choice = np.arange(self.states.size)
        if self.further.size:
            end = self.starts[-1]
            hit = end + np.flatnonzero(quantity[end:] == best[self.owner[end:]])
            choice[self.owner[hit[::-1]]] = hit[::-1]  # the first one is written last
        for a, b in reversed(list(pairwise(self.starts))):
            hit = quantity[a:b] == best[: b - a]
            choice[: b - a] = np.where(hit, np.arange(a, b), choice[: b - a])
        return choice


def choices_of(count: Integers) -> ChoiceOrder:
    """The order of choices, from the number of choices of each state ``int[N]``, at least one."""
    states = np.argsort(-count, kind="stable")
    base, sizes = (count.cumsum() - count)[states], count[states]
    # How many states have a choice of each rank, and up to which rank slices are faster.
    largest = int(count.max(initial=1))
    having = count.size - np.bincount(count, minlength=largest)[:largest].cumsum()
    ranks = _ranks(having)
    owner = concatenated_ranges(np.zeros(ranks, np.int64), having[:ranks])
    rank = np.repeat(np.arange(ranks), having[:ranks])
    starts = [0, *having[:ranks].cumsum().tolist()]
    wide = int(having[ranks]) if ranks < having.size else 0
    remaining = sizes[:wide] - ranks
    owner = np.concatenate([owner, np.repeat(np.arange(wide), remaining)])
    rank = np.concatenate([rank, ranks + concatenated_ranges(np.zeros(wide, np.int64), remaining)])
    return ChoiceOrder(states, base[owner] + rank, owner, starts, remaining.cumsum() - remaining)


def _ranks(having: Integers) -> int:
    """The number of ranks listed as slices, at least one, that costs least."""
    entries = having.cumsum()
    by_rank = _SLICE * np.arange(1, having.size + 1) + _ENTRY * entries
    after = np.append(having[1:], 0)
    by_state = (
        np.where(after > 0, _REDUCTION, 0) + _SPAN * after + _REDUCED * (entries[-1] - entries)
    )
    return int((by_rank + by_state).argmin()) + 1
