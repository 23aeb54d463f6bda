"""Formula progression: the residual formula after a letter, on canonical diagrams.

The function `af` of Esparza, Kretinsky & Sickert 2020, "A unified translation of linear temporal
logic to omega-automata": a formula after the letters read so far, up to propositional
equivalence, which a binary decision diagram over propositions and temporal subformulas makes
canonical.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.logic.diagram import FALSE, TRUE, Diagrams, prime_cubes
from jaxltl.core.logic.ltl import Formula, render, subformulas

MAX_NAME = 400  # characters of a state name before it is abbreviated
MAX_CUBES = 60

_TEMPORAL = frozenset("XFGURWM")


def encode(nodes: Iterable[Formula], diagrams: Diagrams, of: dict[Formula, int]) -> None:
    """Adds the diagrams of Boolean formulas, operands first, to those of propositions and others."""
    for node in nodes:
        # From the last operand to the first, so that the top variables are added last.
        operands = [of[operand] for operand in reversed(node.operands) if operand in of]
        match node.operator:
            case "true" | "false":
                of[node] = TRUE if node.operator == "true" else FALSE
            case "!":
                of[node] = diagrams.negation(operands[0])
            case "&":
                of[node] = reduce(lambda rest, f: diagrams.both(f, rest), operands)
            case "|":
                of[node] = reduce(lambda rest, f: diagrams.either(f, rest), operands)


class Progression:
    """Diagrams of formulas in negation normal form, and their successors under letters.

    `letters` is bool `[L, P]`, `max_nodes` limits the number of diagrams. `representative` has one
    letter of each class of equivalent letters, and `class_of` int `[L]` the class of each letter.
    """

    def __init__(
        self,
        formulas: Iterable[Formula],
        letters: NDArray[np.bool_],
        propositions: Sequence[str],
        max_nodes: int = 10_000_000,
    ) -> None:
        self.formulas = tuple(formulas)
        self.nodes = tuple(dict.fromkeys(f for root in self.formulas for f in subformulas(root)))
        self.diagrams = Diagrams(max_nodes)
        self.variables = [node for node in self.nodes if node.operator == "ap"]
        self.variables += [node for node in self.nodes if node.operator in _TEMPORAL]
        self.diagram_of: dict[Formula, int] = {}
        for i, variable in enumerate(self.variables):
            self.diagram_of[variable] = self.diagrams.node(i, FALSE, TRUE)
        encode(self.nodes, self.diagrams, self.diagram_of)
        self.class_of, self.representative = self._classes(letters, propositions)
        held = [
            {name for name, holds in zip(propositions, letters[i], strict=True) if holds}
            for i in self.representative
        ]
        self.after: list[Callable[[int], int]] = [self._step(letter) for letter in held]

    def _classes(
        self, letters: NDArray[np.bool_], propositions: Sequence[str]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Letters on which all outermost propositional subformulas agree are one letter."""
        column = {name: p for p, name in enumerate(propositions)}
        truth: dict[Formula, NDArray[np.bool_]] = {}
        outermost: dict[Formula, None] = {}
        for node in self.nodes:
            values = [truth[f] for f in node.operands if f in truth]
            match node.operator:
                case "true" | "false":
                    truth[node] = np.full(len(letters), node.operator == "true")
                case "ap":
                    truth[node] = letters[:, column[node.proposition]]
                case "!":
                    truth[node] = ~values[0]
                case "&" | "|" if len(values) == len(node.operands):
                    join = np.logical_and if node.operator == "&" else np.logical_or
                    truth[node] = join.reduce(values)
                case _:
                    outermost.update((f, None) for f in node.operands if f in truth)
        outermost.update((f, None) for f in self.formulas if f in truth)
        signature = [truth[f] for f in outermost] or [np.zeros(len(letters), bool)]
        _, first, inverse = np.unique(
            np.stack(signature), axis=1, return_index=True, return_inverse=True
        )
        return inverse.ravel(), first

    def _step(self, letter: set[str]) -> Callable[[int], int]:
        """Successors of diagrams after a letter: `af(f U g) = af(g) | (af(f) & f U g)`."""
        diagrams, of = self.diagrams, self.diagram_of
        both, either, nodes = diagrams.both, diagrams.either, diagrams.nodes
        successors: dict[int, int] = {}
        done = {FALSE: FALSE, TRUE: TRUE}

        def after(diagram: int) -> int:
            if diagram not in done:
                variable, low, high = nodes[diagram]
                if variable not in successors:
                    successors[variable] = successor(self.variables[variable])
                done[diagram] = diagrams.choice(successors[variable], after(high), after(low))
            return done[diagram]

        def successor(variable: Formula) -> int:
            if variable.operator == "ap":
                return TRUE if variable.proposition in letter else FALSE
            itself = of[variable]
            left, right = of[variable.operands[0]], of[variable.operands[-1]]
            match variable.operator:
                case "X":
                    return left
                case "F":
                    return either(after(right), itself)
                case "G":
                    return both(after(right), itself)
                case "U" | "W":
                    return either(after(right), both(after(left), itself))
                case _:
                    return both(after(right), either(after(left), itself))

        return after

    def restricted(self, keep: Callable[[Formula], bool]) -> Callable[[int], int]:
        """The function that makes each variable false that is not to be kept."""
        mask = [keep(variable) for variable in self.variables]
        diagrams = self.diagrams
        done = {FALSE: FALSE, TRUE: TRUE}

        def restrict(diagram: int) -> int:
            if diagram not in done:
                variable, low, high = diagrams.nodes[diagram]
                if mask[variable]:
                    done[diagram] = diagrams.node(variable, restrict(low), restrict(high))
                else:
                    done[diagram] = restrict(low)
            return done[diagram]

        return restrict


# --- Names -----------------------------------------------------------------------------------

_Text: TypeAlias = tuple[str, bool]  # and whether it needs parentheses inside a longer one


class Namer:
    """Texts of diagrams, the shorter of their disjunctive and conjunctive forms."""

    def __init__(self, progression: Progression) -> None:
        texts: dict[Formula, str] = {}
        for node in progression.nodes:
            text = render(node, [texts[operand] for operand in node.operands])
            texts[node] = text if len(text) <= MAX_NAME else "..."
        self.diagrams = progression.diagrams
        self.literals = [(texts[v], len(v.operands) > 1) for v in progression.variables]
        self.paths = {True: [0, 1], False: [1, 0]}  # from each diagram to true, and to false

    def name(self, diagram: int) -> str:
        """The text of a diagram, `...` if it is long."""
        nodes = self.diagrams.nodes
        for count in self.paths.values():
            for _, low, high in nodes[len(count) :]:
                count.append(count[low] + count[high])
        forms = [
            self._normal_form(diagram, disjunctive)
            for disjunctive, count in self.paths.items()
            if count[diagram] <= MAX_CUBES
        ]
        name = min(forms, key=len, default="...")
        return name if len(name) <= MAX_NAME else "..."

    def _normal_form(self, diagram: int, disjunctive: bool) -> str:
        if diagram in (FALSE, TRUE):
            return "true" if diagram == TRUE else "false"
        # The conjunctive form of f is the negation, literal by literal, of the disjunctive
        # one of !f.
        goal = diagram if disjunctive else self.diagrams.negation(diagram)
        outer, inner = ("|", "&") if disjunctive else ("&", "|")
        clauses = []
        for cube in prime_cubes(goal, goal, self.diagrams)[0]:
            texts = []
            for variable, value in cube:
                text, grouped = self.literals[variable]
                negated = f"!({text})" if grouped else f"!{text}"
                texts.append(self.literals[variable] if value == disjunctive else (negated, False))
            clauses.append(_joined(inner, texts))
        return _joined(outer, clauses)[0]


def _joined(operator: str, texts: list[_Text]) -> _Text:
    if len(texts) == 1:
        return texts[0]
    return f" {operator} ".join(f"({text})" if group else text for text, group in texts), True
