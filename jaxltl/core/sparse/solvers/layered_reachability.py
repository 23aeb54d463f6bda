"""Bounds of reachability on a large padded product, one component of the automaton at a time.

The strongly connected components of the automaton (most of them single states) are left for good in
topological order. From the last one on, each is a reachability problem on the model alone, in which
entering a state that leaves the component has a known value, between two bounds. Qualitative sets
are computed for all automaton states at once (:mod:`jaxltl.core.sparse.graph.bitsets`), and the
other values by sweeps (:mod:`jaxltl.core.sparse.linear.gauss_seidel`).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.contraction import quotient
from jaxltl.core.sparse.graph.bitsets import LARGEST, BitSets, bit_graph, decided, pack
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.linear.gauss_seidel import (
    BlockProblem,
    SweepSettings,
    RowBlocks,
    SweptBounds,
    row_blocks,
    solve_by_sweeps,
)
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.sparse.solvers.reachability import expands_fast, quotient_policy
from jaxltl.core.sparse.solvers.shortest_path_problem import TINY, Enclosure

_EPS = float(np.finfo(np.float64).eps)
_STARTS = 8  # states from one of which few steps
_MET = 4096  # lead to that many, so that the graph is shallow and sweeps end soon
_LIMIT = 2**27  # transitions of a component that is written out, at most


class PaddedProduct(NamedTuple):
    """A padded MDP and an automaton that reads the labels of entered states."""

    successor: Integers  # int[S, A, K]
    used: Booleans  # bool[S, A, K]
    probability: Floats  # float[S, A, K]
    available: Booleans  # bool[S, A]
    delta: Integers  # int[Q, L]
    letter: Integers  # int[S]
    allowed: Booleans | None = None  # bool[S, Q, A], or None for all


class _LayeredRows:
    """The model's rows, their actions, and their blocks."""

    def __init__(self, world: PaddedProduct) -> None:
        available, used = world.available, world.used
        self.regular = bool(available.all() and used.all())
        num_states, num_actions, width = used.shape
        if self.regular:
            count = np.full(num_states, num_actions)
            starts = np.arange(
                0, used.size + 1, width, dtype=offsets_from_counts(count * width).dtype
            )
            column, weight = world.successor.reshape(-1), world.probability.reshape(-1)
            self.action = np.tile(np.arange(num_actions, dtype=np.int32), num_states)
        else:
            kept = used & available[:, :, None]
            count, starts = available.sum(1), offsets_from_counts(kept.sum(2)[available])
            column, weight = world.successor[kept], world.probability[kept]
            self.action = np.nonzero(available)[1].astype(np.int32)
        self.available = available
        self.host = HostMDP(
            offsets_from_counts(count),
            starts,
            column.astype(np.int32, copy=False),
            weight.astype(np.float64),
        )

    @cached_property
    def cut(self) -> RowBlocks:
        """Blocks of all rows."""
        return _cut(self.host)

    def of(self, choices: Booleans) -> Booleans:
        """A mask of actions ``bool[S, A]`` as a mask of rows."""
        return choices.reshape(-1) if self.regular else choices[self.available]


def layered_reachability(
    world: PaddedProduct, target: Booleans, *, maximize: bool, tolerance: float
) -> Enclosure | None:
    """Probability of reaching ``bool[S, Q]``, with actions as rows; None if slow or unproven."""
    num_memory = world.delta.shape[0]
    if num_memory > LARGEST or not _mixes(world):
        return None
    graph = bit_graph(
        world.successor, world.used, world.available, world.delta, world.letter, world.allowed
    )
    sets = decided(graph, pack(target), num_memory, maximize=maximize)
    del graph
    if sets is None:
        return None
    search = _LayeredSearch(world, sets, 1 if maximize else -1, tolerance)
    return search.bounds() if search.solve() else None


def _mixes(world: PaddedProduct) -> bool:
    """True if few steps from some state lead to many others."""
    size = world.letter.size

    def follow(states: Integers) -> Integers:
        return world.successor[states][world.used[states]]

    return any(
        expands_fast(follow, np.array([i * size // _STARTS]), size, _MET) for i in range(_STARTS)
    )


class _LayeredSearch:
    """Bounds by automaton state, ``float64[Q, S]``, filled in component after component."""

    def __init__(self, world: PaddedProduct, sets: BitSets, sign: int, tolerance: float) -> None:
        self.world, self.sets, self.sign, self.tolerance = world, sets, sign, tolerance
        num_memory = world.delta.shape[0]
        self.attained = np.stack([self.has(sets.one, q) for q in range(num_memory)]).astype(float)
        self.outer = self.attained.copy()
        self.action, self.sweeps, self.known = sets.action, 0, 0.0
        self.guess: tuple[Floats, float] | None = None  # of values, and of how long runs stay

    @cached_property
    def rows(self) -> _LayeredRows:
        """The world's rows."""
        return _LayeredRows(self.world)

    @staticmethod
    def has(words: Integers, q: int) -> Booleans:
        """The states in which a set holds an automaton state."""
        return (words >> q & 1).astype(bool)

    def undecided(self, q: int) -> Booleans:
        """The states in which the probability is neither 0 nor 1."""
        return ~self.has(self.sets.one | self.sets.zero, q)

    def solve(self) -> bool:
        """Solves all components; whether that succeeded."""
        num_memory = self.world.delta.shape[0]
        read = np.unique(self.world.letter)
        label = ordered_components(
            Edges(
                np.arange(0, num_memory * read.size + 1, read.size),
                self.world.delta[:, read].ravel().astype(np.int32),
            )
        )
        parts = [np.flatnonzero(label == i) for i in range(label.max() + 1)]
        parts = [x for x in parts if any(self.undecided(int(q)).any() for q in x)]
        for i, part in enumerate(parts, 1):
            budget = self.tolerance * i / len(parts) - self.known
            if budget <= 0 or not self.component(part, budget):
                return False
        return True

    def component(self, part: Integers, budget: float) -> bool:
        """Solves one component, to bounds at most `budget` wider than the known ones."""
        host = self.rows.host
        if part.size > 1 and host.num_transitions * part.size > _LIMIT:
            return False
        # Columns are pairs that a step may enter; of one memory, numbered by the state.
        problem = _alone(self, int(part[0])) if part.size == 1 else _together(self, part)
        guess = self.guess if part.size == 1 else None
        bounds = _solved(problem, self.sign, budget, self.unit, guess)
        if bounds is None:
            return False
        attained, outer, row = bounds.attained, bounds.outer, bounds.row
        self.sweeps += bounds.sweeps
        self.known = max(
            self.known,
            float(np.abs(outer - attained)[problem.undecided[: outer.size]].max(initial=0)),
        )
        for i, q in enumerate(part):
            span = slice(i * host.num_states, (i + 1) * host.num_states)
            open_ = problem.undecided[span]
            np.copyto(self.attained[q], attained[span], where=open_)
            np.copyto(self.outer[q], outer[span], where=open_)
            action = self.rows.action[row[span] - i * host.num_rows]
            np.copyto(self.action[:, q], action, where=open_)
        self.guess = (self.attained[part[0]], bounds.time) if part.size == 1 else None
        return True

    @cached_property
    def unit(self) -> float:
        """The relative rounding of one backup."""
        return (4 * int(self.world.used.shape[2]) + 16) * _EPS

    def bounds(self) -> Enclosure:
        """The final bounds."""
        low, high = (self.attained, self.outer) if self.sign > 0 else (self.outer, self.attained)
        # Products too small for a float to hold are lost; relative errors do not count them.
        open_ = low != high
        low = np.where(open_, np.clip(low - TINY, 0, 1), low)
        high = np.where(open_, np.clip(high + TINY, 0, 1), high)
        half = (high - low).T / 2
        # The operator contracts the bounds towards each other, so the residual is at most `half`.
        residual = float(half.max())
        return Enclosure(
            low.T + half, low.T, high.T, self.action, self.sweeps, residual, "sweeps in place"
        )


class _LayeredProblem(NamedTuple):
    """Problem of a component: :class:`BlockProblem`, and where end components may be."""

    host: HostMDP  # as many states as columns; the first ones are nodes
    cut: RowBlocks | None  # the blocks of its rows, if known
    undecided: Booleans  # as of BlockProblem, for all columns (open, live, attained, outer)
    live: Booleans
    attained: Floats
    outer: Floats
    rows: Booleans | None  # bool[R], or None
    stays: Booleans  # bool[M], where end components are searched
    inner: Booleans  # bool[M], the columns that are read as nodes


def _alone(search: _LayeredSearch, q: int) -> _LayeredProblem:
    """The problem of one automaton state: entering a state stays in it, or leads to another one."""
    world, rows = search.world, search.rows
    after = world.delta[q][world.letter]
    place = np.arange(after.size)
    inner, open_ = after == q, search.undecided(q)
    mask = None if world.allowed is None else rows.of(world.allowed[:, q])
    return _LayeredProblem(
        rows.host,
        rows.cut,
        open_,
        inner & open_,
        search.attained[after, place],
        search.outer[after, place],
        mask,
        search.has(search.sets.stays, q),
        inner,
    )


def _together(search: _LayeredSearch, part: Integers) -> _LayeredProblem:
    """The problem of several automaton states: their rows written out, with a state for each exit."""
    world, host = search.world, search.rows.host
    size = host.num_states
    after = world.delta[part][:, world.letter]  # [C, S]
    others = np.setdiff1d(after, part)
    number = np.zeros(world.delta.shape[0], np.int64)
    number[part] = np.arange(part.size)
    number[others] = part.size + np.arange(others.size)
    column = (number[after] * size + np.arange(size)).astype(np.int32)
    ends = others.size * size
    nodes = part.size * size
    entries = np.concatenate([x[host.successor] for x in column])
    width = np.concatenate([np.tile(np.diff(host.entry_start), part.size), np.ones(ends, int)])
    written = HostMDP(
        offsets_from_counts(
            np.concatenate([np.tile(np.diff(host.row_start), part.size), np.ones(ends, int)])
        ),
        offsets_from_counts(width),
        np.concatenate([entries, np.arange(nodes, nodes + ends, dtype=np.int32)]),
        np.concatenate([np.tile(host.probability, part.size), np.ones(ends)]),
    )
    every = np.concatenate([part, others])
    attained, outer = (x[every].ravel() for x in (search.attained, search.outer))
    none = np.zeros(ends, bool)
    open_ = np.concatenate([*map(search.undecided, part), none])
    stays = np.concatenate([*(search.has(search.sets.stays, q) for q in part), none])
    mask = None
    if world.allowed is not None:
        mask = np.concatenate(
            [*(search.rows.of(world.allowed[:, q]) for q in part), np.ones(ends, bool)]
        )
    return _LayeredProblem(
        written, None, open_, open_, attained, outer, mask, stays, np.arange(nodes + ends) < nodes
    )


def _solved(
    problem: _LayeredProblem,
    sign: int,
    budget: float,
    unit: float,
    guess: tuple[Floats, float] | None,
) -> SweptBounds | None:
    """Bounds of the nodes, and their rows."""
    host, cut, allowed, part = problem.host, problem.cut, problem.rows, None
    # Rows that stay in the component of the automaton, and where they can be taken for ever.
    rows = problem.stays[host.state]
    if rows.any():
        rows &= ~host.support.some_successor_in(~(problem.stays & problem.inner))
        if allowed is not None:
            rows &= allowed
    circles = end_components(host, problem.stays, rows) if rows.any() else None
    leader: slice | Integers = slice(None)
    if circles is not None and circles.inside.any():
        part, cut, guess = (
            quotient(host, circles.component, circles.inside, np.zeros(host.num_rows)),
            None,
            None,
        )
        leader = np.flatnonzero(circles.component == np.arange(host.num_states))
        allowed = None if allowed is None else allowed[part.row]
    blocks = cut or _cut(host if part is None else part.mdp)
    settings = SweepSettings(sign=sign, tolerance=budget, relative=False, unit=unit)
    sums = BlockProblem(
        blocks,
        problem.undecided[leader],
        problem.live[leader],
        problem.attained[leader],
        problem.outer[leader],
        None,
        allowed,
    )
    bounds = solve_by_sweeps(sums, settings, *(guess or (None, None)))
    if bounds is None or part is None or circles is None:
        return bounds
    row = quotient_policy(host, circles, part.row[bounds.row][part.node])
    return replace(
        bounds, attained=bounds.attained[part.node], outer=bounds.outer[part.node], row=row
    )


def _cut(host: HostMDP) -> RowBlocks:
    return row_blocks(
        host.row_start, host.entry_start, host.successor, host.probability, host.num_states
    )
