"""Reduced ordered binary decision diagrams: Boolean functions in a canonical form."""

from __future__ import annotations

import sys

FALSE, TRUE = 0, 1

Cube = tuple[tuple[int, bool], ...]  # (variable, its value), by variable


class Diagrams:
    """Reduced ordered binary decision diagrams (Bryant 1986), equal iff equivalent.

    A diagram is an index into `nodes`, which holds (variable, diagram if it is false, diagram if
    it is true); 0 is false and 1 is true.
    """

    def __init__(self, max_nodes: int = 10_000_000) -> None:
        self.max_nodes = max_nodes
        bottom = sys.maxsize  # the constants come after every variable
        self.nodes = [(bottom, FALSE, FALSE), (bottom, TRUE, TRUE)]
        self._index: dict[tuple[int, int, int], int] = {}
        self._choices: dict[tuple[int, int, int], int] = {}

    def node(self, variable: int, low: int, high: int) -> int:
        if low == high:
            return low
        index = self._index.setdefault((variable, low, high), len(self.nodes))
        if index == len(self.nodes):
            if index >= self.max_nodes:
                raise ValueError(
                    f"to_automaton: the states combine subformulas in more than {index} "
                    "diagrams. Split the formula into parts that are tracked side by side."
                )
            self.nodes.append((variable, low, high))
        return index

    def cofactors(self, diagram: int, variable: int) -> tuple[int, int]:
        top, low, high = self.nodes[diagram]
        return (low, high) if top == variable else (diagram, diagram)

    def choice(self, test: int, then: int, other: int) -> int:
        """The diagram of `(test & then) | (!test & other)`."""
        if test == TRUE or then == other:
            return then
        if test == FALSE:
            return other
        if then == TRUE and other == FALSE:
            return test
        key = (test, then, other)
        if key not in self._choices:
            variable = min(self.nodes[diagram][0] for diagram in key)
            low, high = zip(*[self.cofactors(diagram, variable) for diagram in key], strict=True)
            self._choices[key] = self.node(variable, self.choice(*low), self.choice(*high))
        return self._choices[key]

    def both(self, left: int, right: int) -> int:
        return self.choice(left, right, FALSE)

    def either(self, left: int, right: int) -> int:
        return self.choice(left, TRUE, right)

    def negation(self, diagram: int) -> int:
        return self.choice(diagram, FALSE, TRUE)


def prime_cubes(lower: int, upper: int, diagrams: Diagrams) -> tuple[list[Cube], int]:
    """Irredundant prime cubes between two diagrams (Minato 1993), and their union's diagram."""
    if lower == FALSE:
        return [], FALSE
    if upper == TRUE:
        return [()], TRUE
    both, either, negation = diagrams.both, diagrams.either, diagrams.negation
    variable = min(diagrams.nodes[lower][0], diagrams.nodes[upper][0])
    lower0, lower1 = diagrams.cofactors(lower, variable)
    upper0, upper1 = diagrams.cofactors(upper, variable)
    cubes0, cover0 = prime_cubes(both(lower0, negation(upper1)), upper0, diagrams)
    cubes1, cover1 = prime_cubes(both(lower1, negation(upper0)), upper1, diagrams)
    missing = either(both(lower0, negation(cover0)), both(lower1, negation(cover1)))
    cubes, cover = prime_cubes(missing, both(upper0, upper1), diagrams)
    with_variable = [((variable, False), *cube) for cube in cubes0]
    with_variable += [((variable, True), *cube) for cube in cubes1]
    whole = diagrams.node(variable, either(cover0, cover), either(cover1, cover))
    return with_variable + cubes, whole
