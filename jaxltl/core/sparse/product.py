"""Reachable product of a sparse MDP and an automaton, without padding."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import (
    concatenated_ranges,
    mask_of,
    offsets_from_counts,
    positions,
    row_entries,
)

MAX_PAIRS = 2**31  # pairs of a state and a memory; a bit vector of them takes 2 GB
_DENSE = 2**27  # pairs up to which the number of each is looked up in a table
_ROUNDS = 64  # after which a narrow search is handed over
_NARROW = 2000  # states a round, below which NumPy's overhead outweighs its work
_MAX_EDGES = 2**27  # of the whole product, that are written down for the search


@brief
class SparseProduct(NamedTuple):
    """Reachable states of a product, ordered by model state first and automaton state next."""

    host: HostMDP  # the product MDP, N states
    base_state: Integers  # int32[N], the model's state
    memory: Integers  # int32[N], the automaton's state
    base_row: Integers  # int32[R'], the model's row of each row; its first where absorbing
    start: Integers  # int64[I], the product state of each start
    still: Booleans  # bool[N], states with a known verdict, made absorbing

    def entry_letter(self, letter: Integers, on_entry: bool) -> Integers:
        """Letter of each entry ``int[T']``: of the entered state if `on_entry`, else of the left."""
        if on_entry:
            return letter[self.base_state[self.host.successor]]
        return letter[self.base_state[self.host.state[self.host.row]]]


def sparse_product(
    host: HostMDP,
    delta: np.ndarray,
    letter: Integers,
    start: tuple[Integers, Integers],
    *,
    on_entry: bool = True,
    still: Booleans | None = None,
) -> SparseProduct:
    """The part of the product that is reachable from pairs of a state and a memory, `start`.

    A step leads from ``(s, q)`` to ``(t, delta[q, letter[t]])``, or to ``(t, delta[q, letter[s]])``
    where letters are read on exit.
    """
    num_memory = delta.shape[0]
    if host.num_states * num_memory > MAX_PAIRS:
        raise ValueError(
            f"the product of {host.num_states} states and an automaton of {num_memory} has up to "
            f"{host.num_states * num_memory:.3g} states, more than 2^31; use a smaller formula."
        )
    step = delta.T.astype(np.int64)  # [L, Q], so that one letter's column is together
    still = np.zeros(num_memory, bool) if still is None else still
    world = _ProductSource(host, step, np.asarray(letter), still, on_entry)
    first = np.asarray(start[0], np.int64) * num_memory + np.asarray(start[1])
    seen = _reached(world, first)
    code = np.flatnonzero(seen)
    if host.num_states * num_memory <= _DENSE:
        number = positions(code, seen.size)
        return _written(world, code, number.__getitem__, first)
    return _written(world, code, lambda x: np.searchsorted(code, x).astype(np.int32), first)


def product_without_memory(host: HostMDP, state: Integers) -> SparseProduct:
    """The model as its product with an automaton of one state, reachable or not."""
    number = np.arange(host.num_states, dtype=np.int32)
    return SparseProduct(
        host,
        number,
        np.zeros_like(number),
        np.arange(host.num_rows, dtype=np.int32),
        np.asarray(state, np.int64),
        np.zeros(host.num_states, bool),
    )


class _ProductSource(NamedTuple):
    host: HostMDP
    step: NDArray[np.int64]
    letter: Integers
    still: Booleans
    on_entry: bool

    @property
    def num_memory(self) -> int:
        result: int = self.step.shape[1]
        return result

    def after(self, target: Integers, source: Integers, memory: Integers) -> NDArray[np.int64]:
        """The pairs that follow when ``source`` leads to ``target``."""
        read = self.letter[target if self.on_entry else source]
        return target.astype(np.int64) * self.num_memory + self.step[read, memory]


def _reached(world: _ProductSource, start: Integers) -> Booleans:
    """The reachable pairs, ``bool[S * Q]``, by breadth-first search."""
    host = world.host
    seen = mask_of(start, host.num_states * world.num_memory)
    first_entry = host.entry_start[host.row_start]
    scratch = np.empty(seen.size, np.int32) if seen.size <= _DENSE else None
    frontier, rounds, work = np.flatnonzero(seen), 0, 0
    while frontier.size:
        state, memory = np.divmod(frontier, world.num_memory)
        moving = ~world.still[memory]
        state, memory = state[moving], memory[moving]
        entry, count = row_entries(first_entry, state)
        follower = world.after(
            host.successor[entry], np.repeat(state, count), np.repeat(memory, count)
        )
        follower = follower[~seen[follower]]
        seen[follower] = True
        if scratch is None:
            frontier = np.unique(follower)
        else:  # of each pair's repetitions the last one stays
            place = np.arange(follower.size, dtype=np.int32)
            scratch[follower] = place
            frontier = follower[scratch[follower] == place]
        rounds, work = rounds + 1, work + follower.size
        if rounds == _ROUNDS:
            if work < _NARROW * rounds and (host.num_transitions * world.num_memory <= _MAX_EDGES):
                return _searched(world, start)
            rounds = work = 0
    return seen


def _searched(world: _ProductSource, start: Integers) -> Booleans:
    """The same by SciPy's search of the whole product, in time independent of its depth."""
    from scipy.sparse import csgraph, csr_array

    host, (num_states, num_memory) = world.host, (world.host.num_states, world.num_memory)
    first_entry = host.entry_start[host.row_start].astype(np.int64)
    read = host.state[host.row] if not world.on_entry else host.successor
    # Pairs are numbered by memory first here, so that each memory's edges are together.
    target, count = [], []
    for q in range(num_memory):
        moves = not world.still[q]
        count.append(np.diff(first_entry) * moves)
        if moves:
            target.append(world.step[world.letter[read], q] * num_states + host.successor)
    first = np.unique(start % num_memory * num_states + start // num_memory)
    target.append(first)  # of an additional node
    size = num_states * num_memory + 1
    index = np.concatenate([[0], np.concatenate([*count, [first.size]]).cumsum()])
    edges = np.concatenate(target)
    graph = csr_array((np.ones(edges.size), edges, index), shape=(size, size))
    order = csgraph.breadth_first_order(graph, size - 1, return_predecessors=False)[1:]
    memory, state = np.divmod(order.astype(np.int64), num_states)
    return mask_of(state * num_memory + memory, size - 1)


def _written(
    world: _ProductSource, code: Integers, number: Callable[[Integers], Integers], start: Integers
) -> SparseProduct:
    """The rows of the reachable pairs."""
    host = world.host
    state, memory = np.divmod(code, world.num_memory)
    still = world.still[memory]
    choices = np.where(still, 1, np.diff(host.row_start)[state])
    base_row = concatenated_ranges(host.row_start[state], choices)
    owner = np.repeat(np.arange(code.size), choices)
    width = np.where(still[owner], 1, np.diff(host.entry_start)[base_row])
    entry = concatenated_ranges(host.entry_start[base_row], width)
    source = np.repeat(owner, width)
    follower = world.after(host.successor[entry], state[source], memory[source])
    alone = still[source]
    successor = number(np.where(alone, code[source], follower) if alone.any() else follower)
    probability = host.probability[entry]
    probability[alone] = 1.0
    product = HostMDP(
        offsets_from_counts(choices), offsets_from_counts(width), successor, probability
    )
    return SparseProduct(
        product,
        state.astype(np.int32),
        memory.astype(np.int32),
        base_row.astype(np.int32),
        number(start).astype(np.int64),
        still,
    )
