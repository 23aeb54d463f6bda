"""From Emerson-Lei conditions, any Boolean combination of "infinitely often", to parity.

The alternating cycle decomposition (Casares, Colcombet & Fijalkow 2021, "Optimal transformations
of games and automata using Muller conditions") of a strongly connected part is a tree of its
cycles: the root holds all transitions, and the children of a node are its maximal strongly
connected parts with the opposite verdict. No parity automaton on top of the same states has
fewer states or priorities than the one that it gives.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import reduce
from operator import or_
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.sparse.graph.components import strong_components

Condition: TypeAlias = tuple[Any, ...]  # see `holds`

MAX_COLORS = 62  # the bits of a set of colors
MAX_SUBSETS = 20_000  # parts examined in one decomposition before it is given up


def holds(condition: Condition, colors: int) -> bool:
    """True if a condition holds of the set of colors that occur infinitely often."""
    match condition[0]:
        case "true" | "false":
            return bool(condition[0] == "true")
        case "inf" | "fin":
            return bool((colors >> condition[1] & 1) == (condition[0] == "inf"))
        case "and":
            return all(holds(part, colors) for part in condition[1:])
        case "or":
            return any(holds(part, colors) for part in condition[1:])
    raise ValueError(f"holds: unknown condition {condition[0]!r}. Use true false inf fin and or.")


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
    if condition[0] in ("inf", "fin"):
        recurs, never = present >> condition[1] & 1, absent >> condition[1] & 1
        if not recurs and not never:
            return condition
        return ("true" if bool(recurs) == (condition[0] == "inf") else "false",)
    if condition[0] in ("true", "false"):
        return condition
    neutral, absorbing = ("true",), ("false",)
    if condition[0] == "or":
        neutral, absorbing = absorbing, neutral
    parts = [residual(part, absent, present) for part in condition[1:]]
    if absorbing in parts:
        return absorbing
    parts = [part for part in parts if part != neutral]
    if len(parts) < 2:
        return parts[0] if parts else neutral
    return (condition[0], *parts)


def parity_condition(num_priorities: int) -> Condition:
    """The condition that the least color seen infinitely often is even."""
    condition: Condition = ("false",)
    for color in reversed(range(num_priorities)):
        if color % 2 == 0:
            condition = ("or", ("inf", color), condition)
        else:
            condition = ("and", ("fin", color), condition)
    return condition


def to_parity(
    delta: Integers,
    colors: Integers,
    initial: int,
    condition: Condition,
    max_states: int = 1_000_000,
) -> tuple[Integers, Integers, int, Integers]:
    """A deterministic min-even parity automaton with the language of an Emerson-Lei one."""
    inf, fin = polarities(condition)
    if (inf | fin) >> MAX_COLORS:
        raise ValueError(
            f"to_parity: color {(inf | fin).bit_length() - 1} is in the condition. "
            f"Number at most {MAX_COLORS} colors from 0."
        )
    columns, inverse = _distinct_columns(delta, colors)
    few_delta, few_colors = delta[:, columns], colors[:, columns]
    component = strong_components(
        np.repeat(np.arange(len(delta)), len(columns)), few_delta.ravel(), len(delta)
    )
    memo: dict[int, bool] = {}

    def verdict(mask: int) -> bool:
        if mask not in memo:
            memo[mask] = holds(condition, mask)
        return memo[mask]

    trees: dict[int, _Tree] = {}
    for c in np.unique(component[reached_from(few_delta, initial)]).tolist():
        trees[c] = _tree(few_delta, few_colors, component, c, (verdict, inf, fin), max_states)
    new_delta, priority, base = _unfold(few_delta, component, trees, initial, max_states)
    return new_delta[:, inverse], priority[:, inverse], 0, base


def _distinct_columns(delta: Integers, colors: Integers) -> tuple[Integers, Integers]:
    both = np.concatenate([delta, colors]).T
    _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
    return first, inverse.ravel()


def reached_from(delta: Integers, initial: int) -> NDArray[np.bool_]:
    """The states that some word leads to, bool `[Q]`."""
    reached = np.zeros(len(delta), bool)
    frontier = np.array([initial])
    while frontier.size:
        reached[frontier] = True
        following = np.unique(delta[frontier])
        frontier = following[~reached[following]]
    return reached


# ---------------------------------------------------------------------------------------------
# The decomposition of one component
# ---------------------------------------------------------------------------------------------


@dataclass
class _Tree:
    """Nodes of a decomposition, parents first; `edges[n]` are ``q * K + k``, `states[n]` sources."""

    accepting: bool = False
    edges: list[frozenset[int]] = field(default_factory=list)
    states: list[frozenset[int]] = field(default_factory=list)
    parent: list[int] = field(default_factory=list)
    depth: list[int] = field(default_factory=list)
    children: list[list[int]] = field(default_factory=list)

    def add(self, edges: frozenset[int], states: frozenset[int], parent: int) -> None:
        if self.edges:
            self.children[parent].append(len(self.edges))
        self.edges.append(edges)
        self.states.append(states)
        self.parent.append(parent)
        self.depth.append(self.depth[parent] + 1 if len(self.edges) > 1 else 0)
        self.children.append([])


def _tree(
    delta: Integers,
    colors: Integers,
    component: Integers,
    chosen: int,
    judge: tuple[Callable[[int], bool], int, int],
    max_nodes: int,
) -> _Tree:
    width = delta.shape[1]
    members = np.flatnonzero(component == chosen)
    inside = component[delta[members]] == chosen
    row, column = np.nonzero(inside)
    source = members[row]
    target, mask = delta[source, column], colors[source, column]
    tree = _Tree()
    number = source * width + column

    def sets(part: Integers) -> tuple[frozenset[int], frozenset[int]]:
        return frozenset(number[part].tolist()), frozenset(source[part].tolist())

    # Transitions with the same ends and colors stand together.
    ends = np.stack([source, target, mask], axis=1)
    _, first, twin = np.unique(ends, axis=0, return_index=True, return_inverse=True)
    twin = twin.ravel()
    known: dict[bytes, tuple[frozenset[int], frozenset[int]]] = {}
    parts = _Parts(source[first], target[first], mask[first], *judge)
    whole = np.arange(len(first))
    tree.accepting = bool(len(source)) and judge[0](_union(mask))
    tree.add(*sets(np.arange(len(source))), 0)
    waiting: list[tuple[Integers, bool, int]] = []
    if len(source):
        waiting.append((whole, tree.accepting, 0))
    while waiting:
        part, accepting, node = waiting.pop()
        for smaller in parts.maximal(part, accepting):
            key = smaller.tobytes()
            if key not in known:  # the same part may stand below several others
                known[key] = sets(np.flatnonzero(np.isin(twin, smaller)))
            waiting.append((smaller, not accepting, len(tree.edges)))
            tree.add(*known[key], node)
        if len(tree.edges) > 2 * max_nodes:
            raise ValueError(
                f"to_parity: more than {max_nodes} states. Use fewer letters, or raise the limit."
            )
    return tree


def _union(masks: Integers) -> int:
    return int(np.bitwise_or.reduce(masks)) if len(masks) else 0


@dataclass
class _Parts:
    """Searches strongly connected sets of transitions."""

    source: Integers
    target: Integers
    mask: Integers
    verdict: Callable[[int], bool]
    inf: int
    fin: int
    examined: int = 0
    known: dict[bytes, list[Integers]] = field(default_factory=dict)

    def maximal(self, part: Integers, accepting: bool) -> list[Integers]:
        """The maximal strongly connected subsets with the other verdict.

        A rejecting subset of an accepting part lacks a color of an `inf` condition, an accepting
        subset of a rejecting part one of a `fin` condition. So it lies in a component of the part
        without the transitions of that color.
        """
        key = part.tobytes()
        if key not in self.known:
            self.known[key] = self._maximal(part, accepting)
        return self.known[key]

    def _maximal(self, part: Integers, accepting: bool) -> list[Integers]:
        removable = self.inf if accepting else self.fin
        found: dict[bytes, Integers] = {}
        seen: set[bytes] = set()
        waiting = [part]
        while waiting:
            whole = waiting.pop()
            colors = self._to_remove(_union(self.mask[whole]), removable, accepting)
            for color in range(colors.bit_length()):
                if not colors >> color & 1:
                    continue
                for smaller in self._components(whole[self.mask[whole] >> color & 1 == 0]):
                    key = smaller.tobytes()
                    if key in seen:
                        continue
                    seen.add(key)
                    self.examined += 1
                    if self.examined > MAX_SUBSETS:
                        raise ValueError(
                            f"to_parity: more than {MAX_SUBSETS} sets of transitions to "
                            "examine. The acceptance condition has too many independent parts."
                        )
                    if self.verdict(_union(self.mask[smaller])) != accepting:
                        found[key] = smaller
                    else:
                        waiting.append(smaller)
        return _largest(list(found.values()))

    def _to_remove(self, colors: int, removable: int, accepting: bool) -> int:
        """The colors one of which has to go; one alone if no smaller part can keep it."""
        choices = colors & removable
        if self.inf & self.fin:
            return choices
        other = colors & (self.fin if accepting else self.inf)
        for color in range(choices.bit_length()):
            if choices >> color & 1 and self.verdict(1 << color | other) == accepting:
                return 1 << color
        return choices

    def _components(self, part: Integers) -> list[Integers]:
        source, target = self.source[part], self.target[part]
        if not len(part):
            return []
        if (source == source[0]).all() and (target == source[0]).all():
            return [part]
        states, ends = np.unique(np.concatenate([source, target]), return_inverse=True)
        ends = ends.ravel()
        label = strong_components(ends[: len(part)], ends[len(part) :], len(states))
        start, stop = label[ends[: len(part)]], label[ends[len(part) :]]
        part, start = part[start == stop], start[start == stop]
        return [part[start == c] for c in np.unique(start)]


def _largest(parts: list[Integers]) -> list[Integers]:
    """The parts that are in no other."""
    kept: list[tuple[Integers, frozenset[int]]] = []
    for part in sorted(parts, key=len, reverse=True):
        members = frozenset(part.tolist())
        if not any(members <= other for _, other in kept):
            kept.append((part, members))
    return [part for part, _ in kept]


# ---------------------------------------------------------------------------------------------
# The parity automaton
# ---------------------------------------------------------------------------------------------


def _unfold(
    delta: Integers, component: Integers, trees: dict[int, _Tree], initial: int, max_states: int
) -> tuple[Integers, Integers, Integers]:
    """The automaton on pairs of a state and a lowest node of the tree that holds it."""
    width = delta.shape[1]
    component_of = component.tolist()
    table = delta.tolist()

    found: dict[tuple[int, int], int] = {}

    def lowest(tree: _Tree, node: int, state: int) -> int:
        key = (node, state)  # a state is in one tree only
        if key not in found:
            below = next((n for n in tree.children[node] if state in tree.states[n]), None)
            found[key] = node if below is None else lowest(tree, below, state)
        return found[key]

    def step(state: int, leaf: int, k: int) -> tuple[int, int, int]:
        target = table[state][k]
        tree = trees[component_of[state]]
        if component_of[target] != component_of[state]:
            return target, lowest(trees[component_of[target]], 0, target), 1
        edge = state * width + k
        node, came_from = leaf, -1
        while edge not in tree.edges[node]:
            node, came_from = tree.parent[node], node
        priority = tree.depth[node] + (not tree.accepting)
        siblings = tree.children[node]
        turn = siblings.index(came_from) + 1 if came_from >= 0 else 0
        for child in siblings[turn:] + siblings[:turn]:
            if target in tree.states[child]:
                return target, lowest(tree, child, target), priority
        return target, node, priority

    start = (initial, lowest(trees[component_of[initial]], 0, initial))
    index = {start: 0}
    order = [start]
    rows, priorities = [], []
    for state, leaf in order:
        row, marks = [], []
        for k in range(width):
            target, node, priority = step(state, leaf, k)
            pair = (target, node)
            if pair not in index:
                index[pair] = len(order)
                order.append(pair)
            row.append(index[pair])
            marks.append(priority)
        rows.append(row)
        priorities.append(marks)
        if len(order) > max_states:
            raise ValueError(
                f"to_parity: more than {max_states} states. Use fewer letters, or raise the limit."
            )
    base = np.array([state for state, _ in order])
    return np.array(rows, np.int32), np.array(priorities, np.int32), base


# ---------------------------------------------------------------------------------------------
# The Zielonka tree
# ---------------------------------------------------------------------------------------------


class ZielonkaTree:
    """The decomposition for one state on which any set of colors can recur (Zielonka 1998)."""

    def __init__(self, condition: Condition, max_nodes: int) -> None:
        inf, fin = polarities(condition)
        self.colors = inf | fin
        self.accepting = holds(condition, self.colors)
        labels, self.parent, self.depth = [self.colors], [0], [0]
        self.children: list[list[int]] = []
        for node, label in enumerate(labels):  # grows
            below = _largest_sets(condition, label, self.accepting == (self.depth[node] % 2 == 0))
            self.children.append([len(labels) + i for i in range(len(below))])
            labels += below
            self.parent += [node] * len(below)
            self.depth += [self.depth[node] + 1] * len(below)
            if len(labels) > 2 * max_nodes:
                raise ValueError(
                    f"to_parity: more than {max_nodes} states. Use fewer letters, or raise the limit."
                )
        self.missing = [self.colors & ~label for label in labels]

    def leaf_below(self, node: int) -> int:
        """The first leaf below a node."""
        while self.children[node]:
            node = self.children[node][0]
        return node

    def step(self, leaf: int, colors: int) -> tuple[int, int]:
        """The next leaf and the priority of a transition with some colors."""
        node, came_from = leaf, leaf
        while colors & self.missing[node]:
            node, came_from = self.parent[node], node
        priority = self.depth[node] + (not self.accepting)
        siblings = self.children[node]
        turn = siblings.index(came_from) + 1 if siblings else 0
        return self.leaf_below(siblings[turn % len(siblings)] if siblings else node), priority


def _largest_sets(condition: Condition, colors: int, accepting: bool) -> list[int]:
    """The maximal subsets of a set of colors that have the other verdict."""
    found: list[int] = []
    seen: set[int] = set()
    waiting = [colors]
    while waiting:
        whole = waiting.pop()
        inf, fin = polarities(residual(condition, ~whole, 0))
        for color in range(MAX_COLORS):
            smaller = whole & ~(1 << color)
            if (inf if accepting else fin) >> color & 1 and smaller not in seen:
                seen.add(smaller)
                (waiting if holds(condition, smaller) == accepting else found).append(smaller)
        if len(seen) > MAX_SUBSETS:
            raise ValueError(f"to_parity: more than {MAX_SUBSETS} sets of colors to examine.")
    return [one for one in found if not any(one & other == one != other for other in found)]
