"""From Emerson-Lei conditions, any Boolean combination of "infinitely often", to parity.

The alternating cycle decomposition (Casares, Colcombet & Fijalkow 2021, "Optimal transformations
of games and automata using Muller conditions") of a strongly connected part is a tree of its
cycles: the root holds all transitions, and the children of a node are its maximal strongly
connected parts with the opposite verdict. No parity automaton on top of the same states has
fewer states or priorities than the one that it gives. For one state on which any set of colors can
recur, it is the Zielonka tree (Zielonka 1998).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial, reduce
from operator import or_
from typing import Any, TypeAlias

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.table import (
    ParityTable,
    components,
    distinct_columns,
    explore,
    too_many_states,
)
from jaxltl.core.sparse.graph.components import strong_components

Condition: TypeAlias = tuple[Any, ...]  # see `residual`
Part: TypeAlias = frozenset[int]  # of the transitions or colors that can recur together

MAX_COLORS = 62  # the bits of a set of colors
MAX_SUBSETS = 20_000  # parts examined for one tree before it is given up


def holds(condition: Condition, colors: int) -> bool:
    """True if a condition holds of the set of colors that occur infinitely often."""
    return residual(condition, ~colors, colors) == ("true",)


def polarities(condition: Condition) -> tuple[int, int]:
    """The colors that occur under `inf` and under `fin`, as sets."""
    match condition[0]:
        case "inf":
            return 1 << condition[1], 0
        case "fin":
            return 0, 1 << condition[1]
        case "and" | "or":
            parts = [polarities(part) for part in condition[1:]]
            return (
                reduce(or_, (part[0] for part in parts), 0),
                reduce(or_, (part[1] for part in parts), 0),
            )
    return 0, 0


def residual(condition: Condition, absent: int, present: int) -> Condition:
    """The condition if some colors never recur and others always do, without constants below."""
    operator, *parts = condition
    if operator in ("true", "false"):
        return condition
    if operator in ("inf", "fin"):
        recurs, never = present >> parts[0] & 1, absent >> parts[0] & 1
        if not recurs and not never:
            return condition
        return ("true" if bool(recurs) == (operator == "inf") else "false",)
    if operator not in ("and", "or"):
        raise ValueError(f"unknown condition {operator!r}. Use true false inf fin and or.")
    neutral, absorbing = (("true",), ("false",)) if operator == "and" else (("false",), ("true",))
    parts = [residual(part, absent, present) for part in parts]
    if absorbing in parts:
        return absorbing
    parts = [part for part in parts if part != neutral]
    if len(parts) < 2:
        return parts[0] if parts else neutral
    return (operator, *parts)


def parity_condition(num_priorities: int, first: int = 0) -> Condition:
    """The condition that the least priority seen infinitely often is even; 0 has color `first`."""
    condition: Condition = ("false",)
    for priority in reversed(range(num_priorities)):
        atom = "fin" if priority % 2 else "inf"
        condition = ("and" if priority % 2 else "or", (atom, first + priority), condition)
    return condition


def members(colors: int) -> list[int]:
    """The colors of a set."""
    return [color for color in range(colors.bit_length()) if colors >> color & 1]


# --- Trees of sets that can recur ------------------------------------------------------------


class CycleTree:
    """Sets of transitions or colors: the children of a node are its maximal parts of other verdict.

    `colors_of` gives the colors of a part, and `without` its largest parts that lack a color.
    """

    def __init__(
        self,
        whole: Part,
        condition: Condition,
        colors_of: Callable[[Part], int],
        without: Callable[[Part, int], list[Part]],
        max_states: int,
    ) -> None:
        self._condition, self._without, self._examined = condition, without, 0
        self._colors_of = cache(colors_of)
        self._holds = cache(partial(holds, condition))
        self.accepting = self._holds(colors_of(whole))
        self.labels, self.parent, self.depth = [whole], [0], [0]
        self.children: list[list[int]] = []
        maximal = cache(self._maximal)  # a part may stand below several others
        for node, label in enumerate(self.labels):  # grows
            below = maximal(label)
            self.children.append([len(self.labels) + i for i in range(len(below))])
            self.labels += below
            self.parent += [node] * len(below)
            self.depth += [self.depth[node] + 1] * len(below)
            if len(self.labels) > 2 * max_states:
                raise too_many_states(max_states, "to_parity")

    def _maximal(self, part: Part) -> list[Part]:
        accepting = self._holds(self._colors_of(part))
        parts: list[Part] = []
        seen, waiting = {part}, [part]
        while waiting:
            whole = waiting.pop()
            for color in self._to_remove(self._colors_of(whole), accepting):
                for smaller in self._without(whole, color):
                    if smaller in seen:
                        continue
                    seen.add(smaller)
                    same = self._holds(self._colors_of(smaller)) == accepting
                    (waiting if same else parts).append(smaller)
                    self._examined += 1
                    if self._examined > MAX_SUBSETS:
                        raise ValueError(
                            f"to_parity: more than {MAX_SUBSETS} sets of transitions or colors to "
                            "examine. The acceptance condition has too many independent parts."
                        )
        return [one for one in parts if not any(one < other for other in parts)]

    def _to_remove(self, colors: int, accepting: bool) -> list[int]:
        """The colors one of which has to go; one alone if no smaller part can keep it.

        A rejecting part of an accepting one lacks a color of an `inf` condition, an accepting part
        of a rejecting one a color of a `fin` condition.
        """
        inf, fin = polarities(residual(self._condition, ~colors, 0))
        choices, others = (inf, fin) if accepting else (fin, inf)
        if not inf & fin:
            for color in members(choices):
                if self._holds(1 << color | others) == accepting:
                    return [color]
        return members(choices)

    def lowest(self, node: int, admits: Callable[[int], bool]) -> int:
        """The first lowest admitted node below a node."""
        while admitted := [child for child in self.children[node] if admits(child)]:
            node = admitted[0]
        return node

    def turn(
        self, leaf: int, contains: Callable[[int], bool], admits: Callable[[int], bool]
    ) -> tuple[int, int]:
        """The next leaf, and the priority: that of the lowest ancestor that contains a transition."""
        node, came_from = leaf, leaf
        while not contains(node):
            node, came_from = self.parent[node], node
        priority = self.depth[node] + (not self.accepting)
        siblings = self.children[node]
        first = siblings.index(came_from) + 1 if came_from in siblings else 0
        for child in siblings[first:] + siblings[:first]:
            if admits(child):
                return self.lowest(child, admits), priority
        return node, priority


class ZielonkaTree(CycleTree):
    """The tree of the colors of a condition; `missing[n]` are the colors that end node n's turn."""

    def __init__(self, condition: Condition, max_states: int) -> None:
        self.colors = reduce(or_, polarities(condition))

        def colors_of(part: Part) -> int:
            return sum(1 << color for color in part)

        def without(part: Part, color: int) -> list[Part]:
            return [part - {color}]

        whole = frozenset(members(self.colors))
        super().__init__(whole, condition, colors_of, without, max_states)
        self.missing = [self.colors & ~colors_of(label) for label in self.labels]

    def leaf_below(self, node: int) -> int:
        """The first leaf below a node."""
        return self.lowest(node, lambda _: True)

    def step(self, leaf: int, colors: int) -> tuple[int, int]:
        """The next leaf and the priority of a transition with some colors."""
        return self.turn(leaf, lambda node: not colors & self.missing[node], lambda _: True)


def to_parity(
    delta: Integers,
    colors: Integers,
    initial: int,
    condition: Condition,
    max_states: int = 1_000_000,
) -> tuple[Integers, Integers, int, Integers]:
    """A deterministic min-even parity automaton with the language of an Emerson-Lei one.

    Its states are pairs of a state and a lowest node of its component's tree that holds it.
    """
    used = reduce(or_, polarities(condition))
    if used >> MAX_COLORS:
        raise ValueError(
            f"to_parity: color {used.bit_length() - 1} is in the condition. "
            f"Number at most {MAX_COLORS} colors from 0."
        )
    columns, place = distinct_columns(delta, colors)
    delta, colors = delta[:, columns], colors[:, columns]
    component = components(ParityTable(delta, colors, initial))
    # Transitions with the same ends and colors are one to the trees.
    _, color = np.unique(colors, return_inverse=True)
    ends = np.arange(len(delta))[:, None] * len(delta) + delta
    code = ends.ravel() * (color.max() + 1) + color.ravel()
    _, first, edge = np.unique(code, return_index=True, return_inverse=True)
    source, target, mask = first // len(columns), delta.ravel()[first], colors.ravel()[first]
    inside = component[source] == component[target]

    def colors_of(part: Part) -> int:
        return int(np.bitwise_or.reduce(mask[list(part)])) if part else 0

    def without(part: Part, color: int) -> list[Part]:
        remaining = np.array([e for e in sorted(part) if not mask[e] >> color & 1], int)
        states, numbers = np.unique([source[remaining], target[remaining]], return_inverse=True)
        begin, end = numbers.reshape(2, -1)
        label = strong_components(begin, end, len(states))
        cyclic = label[begin] == label[end]
        remaining, label = remaining[cyclic], label[begin[cyclic]]
        return [frozenset(remaining[label == each].tolist()) for each in np.unique(label)]

    @cache
    def tree_of(number: int) -> tuple[CycleTree, list[frozenset[int]]]:
        """The tree of a component, and the states of its nodes."""
        whole = frozenset(np.flatnonzero(inside & (component[source] == number)).tolist())
        tree = CycleTree(whole, condition, colors_of, without, max_states)
        return tree, [frozenset(source[list(part)].tolist()) for part in tree.labels]

    follow: list[list[int]] = delta.tolist()
    edges: list[list[int]] = [row.tolist() for row in edge.reshape(delta.shape)]
    part_of: list[int] = component.tolist()

    def entered(state: int) -> tuple[int, int]:
        tree, states = tree_of(part_of[state])
        return state, tree.lowest(0, lambda node: state in states[node])

    def step(pair: tuple[int, int]) -> Iterator[tuple[tuple[int, int], int]]:
        state, leaf = pair
        tree, states = tree_of(part_of[state])
        for end, taken in zip(follow[state], edges[state], strict=True):
            if part_of[end] != part_of[state]:
                yield entered(end), 1
                continue
            node, priority = tree.turn(
                leaf,
                lambda node, taken=taken: taken in tree.labels[node],  # type: ignore[misc]
                lambda node, end=end: end in states[node],  # type: ignore[misc]
            )
            yield (end, node), priority

    order, rows, marks = explore(entered(initial), step, max_states, "to_parity")
    base = np.array([state for state, _ in order])
    return np.stack(rows)[:, place], np.stack(marks).astype(np.int32)[:, place], 0, base
