"""Markov decision processes with rational probabilities, and the values of their policies."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from graphlib import TopologicalSorter

import numpy as np

from jaxltl.core.array_types import Booleans
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.mdp import HostGraph
from jaxltl.core.sparse.rows import offsets_from_counts

MAX_WORK = 100_000  # products of fractions of few digits, in total: a third of a second
_BITS = 256  # of a fraction whose products take twice the time of those of small ones

Row = Mapping[int, Fraction]  # a distribution of successors
Values = Sequence[Fraction | float]  # by state; the only floats are infinite
ZERO, ONE = Fraction(0), Fraction(1)


class TooLarge(Exception):
    """A problem that takes too long in rational arithmetic."""


class Work:
    """The remaining work; raises TooLarge once there is none."""

    def __init__(self, limit: float = MAX_WORK) -> None:
        self.limit = limit

    def spend(self, number: Fraction, count: int = 1) -> None:
        """Counts products with a fraction."""
        self.limit -= count * (1 + number.denominator.bit_length() / _BITS)
        if self.limit < 0:
            raise TooLarge


@dataclass(frozen=True)
class ExactMDP:
    """The distribution of each choice; choices of state s are ``row_start[s]`` to the next."""

    row_start: Sequence[int]
    rows: Sequence[Row]

    @property
    def num_states(self) -> int:
        return len(self.row_start) - 1

    @cached_property
    def graph(self) -> HostGraph:
        """The support of the rows."""
        successor = [t for row in self.rows for t in sorted(row)]
        return HostGraph(
            np.array(self.row_start, np.int32),
            offsets_from_counts(np.array([len(row) for row in self.rows])),
            np.array(successor, np.int32),
        )

    def choices(self, state: int) -> range:
        """The rows of a state."""
        return range(self.row_start[state], self.row_start[state + 1])

    def expectation(self, row: int, value: Values, work: Work) -> Fraction | float:
        """The expected value of the next state."""
        total: Fraction | float = ZERO
        for t, p in self.rows[row].items():
            x = value[t]
            if isinstance(x, Fraction):
                if x:
                    work.spend(x)
                    total += p * x
            elif x:
                return x
        return total

    def backup(
        self, constant: Sequence[Fraction], value: Values, maximize: bool | Booleans, work: Work
    ) -> list[Fraction | float]:
        """Optimal sums of the constant of a row and the expected value of its successor.

        In a game `maximize` is ``bool[S]``, the states of the maximiser.
        """
        best: dict[bool, Callable[[Iterable[Fraction | float]], Fraction | float]]
        best = {True: max, False: min}
        return [
            best[up](constant[r] + self.expectation(r, value, work) for r in self.choices(s))
            for s, up in enumerate(np.broadcast_to(maximize, self.num_states).tolist())
        ]


def chain_values(
    rows: Mapping[int, Row],
    constant: Mapping[int, Fraction],
    known: Mapping[int, Fraction],
    work: Work,
) -> dict[int, Fraction]:
    """Solution of ``x = c + P x`` from known values of the other states; 0 where no path ends there.

    Strongly connected components are solved one after the other, successors first, by elimination.
    """
    value = dict(known)
    for block in _blocks(rows):
        if all(t in rows and t in block for s in block for t in rows[s]):
            value |= dict.fromkeys(block, ZERO)
            continue
        inside = {s: {t: p for t, p in rows[s].items() if t in block} for s in block}
        right = {}
        for s in block:
            right[s] = constant[s]
            for t, p in rows[s].items():
                if t not in block and value[t]:
                    work.spend(value[t])
                    right[s] += p * value[t]
        _eliminate(inside, right, work)
        value |= right
    return value


def _blocks(rows: Mapping[int, Row]) -> list[set[int]]:
    """Strongly connected components, successors first."""
    number = {s: i for i, s in enumerate(rows)}
    edges = [(i, number[t]) for s, i in number.items() for t in rows[s] if t in number]
    source, target = np.array(edges, np.int64).reshape(-1, 2).T
    leader = strong_components(source, target, len(number)).tolist()
    members: dict[int, set[int]] = {}
    for s, i in number.items():
        members.setdefault(leader[i], set()).add(s)
    after: dict[int, set[int]] = {block: set() for block in members}
    for i, j in edges:
        if leader[i] != leader[j]:
            after[leader[i]].add(leader[j])
    return [members[block] for block in TopologicalSorter(after).static_order()]


def _eliminate(
    rows: dict[int, dict[int, Fraction]], right: dict[int, Fraction], work: Work
) -> None:
    """Replaces the constants of ``x = c + P x`` by its solution, by state elimination."""
    order = sorted(rows, key=lambda s: len(rows[s]))
    for i, s in enumerate(order):
        loop = rows[s].pop(s, ZERO)
        if loop:
            scale = 1 / (1 - loop)
            rows[s] = {t: p * scale for t, p in rows[s].items()}
            right[s] *= scale
            work.spend(scale, len(rows[s]) + 1)
        for u in order[i + 1 :]:
            weight = rows[u].pop(s, ZERO)
            if not weight:
                continue
            work.spend(weight, len(rows[s]) + 1)
            right[u] += weight * right[s]
            for t, p in rows[s].items():
                work.spend(p)
                rows[u][t] = rows[u].get(t, ZERO) + weight * p
    for s in reversed(order):
        for t, p in rows[s].items():
            work.spend(right[t])
            right[s] += p * right[t]


def double_bounds(number: Fraction | float) -> tuple[float, float]:
    """The largest double below a number or equal to it, and the smallest above."""
    if not isinstance(number, Fraction):
        return number, number
    try:
        nearest = float(number)
    except OverflowError:
        largest = math.copysign(np.finfo(np.float64).max, number)
        ends = sorted((largest, math.copysign(math.inf, number)))
        return ends[0], ends[1]
    lower = math.nextafter(nearest, -math.inf) if nearest > number else nearest
    upper = math.nextafter(nearest, math.inf) if nearest < number else nearest
    return lower, upper


def pairs(start: Sequence[int]) -> Iterable[range]:
    """The indices between consecutive starts."""
    return (range(a, b) for a, b in itertools.pairwise(start))


def flags(mask: Booleans) -> list[int]:
    """The indices of True."""
    result: list[int] = np.flatnonzero(mask).tolist()
    return result
