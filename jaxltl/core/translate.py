"""From linear temporal logic to deterministic automata.

A state of the automaton is what is left to satisfy: the formula after the letters read so far
(Esparza, Kretinsky & Sickert 2016, "From LTL to deterministic automata", the function `af`), up
to propositional equivalence, which a binary decision diagram over propositions and temporal
subformulas makes canonical.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import reduce
from itertools import chain, combinations
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.automaton import Automaton, equivalence_classes, quotient
from jaxltl.core.ltl import (
    TRUE,
    Formula,
    Letter,
    as_formula,
    as_letters,
    is_syntactically_cosafe,
    is_syntactically_safe,
    negation_normal_form,
    offending_subformula,
    render,
    subformulas,
)

MAX_FREE_PROPOSITIONS = 12  # 2^12 letters
MAX_NAME = 400  # characters of a state name before it is abbreviated
MAX_CUBES = 60


def to_automaton(
    formula: Formula | str,
    letters: Iterable[Letter] | None = None,
    max_states: int = 100_000,
) -> Automaton:
    """The minimal complete deterministic automaton of a co-safe or safety formula.

    It accepts exactly the infinite words over `letters` that satisfy the formula. Co-safe and
    safety are read off the syntax (`is_syntactically_cosafe`, `is_syntactically_safe`;
    Kupferman & Vardi 2001); a formula that is both, with no operator but X, becomes co-safe.
    A state is final as early as the given letters allow: for co-safe as soon as every
    continuation satisfies the formula, for safety until no continuation does.

    Args:
        formula: A formula or its text (see `parse_ltl`).
        letters: The letters that occur, each a collection of proposition names; names that are
            not in the formula are ignored. None stands for all 2^P subsets of its propositions.
        max_states: The number of states, before minimisation, at which to give up.

    Returns:
        An automaton over the sorted propositions of the formula. Letters are in the order of the
        binary numbers with proposition p as bit p, states in breadth-first order, and each state
        is named by the formula that is left to satisfy there.

    Raises:
        ValueError: For a formula in neither fragment, more than 12 propositions without
            `letters`, a letter that is no collection, or too many states.

    >>> automaton = to_automaton("!r U g", letters=[{}, {"r"}, {"g"}])
    >>> automaton.delta.tolist(), automaton.state_names
    ([[0, 1, 2], [1, 1, 1], [2, 2, 2]], ('!r U g', 'true', 'false'))
    """
    formula = as_formula(formula)
    alphabet = _alphabet(formula.propositions, letters)
    normal = negation_normal_form(formula)
    if is_syntactically_cosafe(normal):
        acceptance = "cosafe"
    elif is_syntactically_safe(normal):
        acceptance = "safety"
    else:
        raise ValueError(_outside_fragments(formula, normal))
    try:
        return _progression_automaton(normal, alphabet, acceptance, max_states)
    except RecursionError:  # a diagram is as deep as the subformulas that a state combines
        raise ValueError(
            "to_automaton: too many subformulas are combined in one state (several hundred). "
            "Split the formula into parts that are tracked side by side."
        ) from None


def _alphabet(
    propositions: tuple[str, ...], letters: Iterable[Letter] | None
) -> list[frozenset[str]]:
    """The letters over the propositions, distinct, by binary number."""
    if letters is None:
        if len(propositions) > MAX_FREE_PROPOSITIONS:
            raise ValueError(
                f"to_automaton: the formula has {len(propositions)} propositions, so "
                f"2^{len(propositions)} letters; the limit is 2^{MAX_FREE_PROPOSITIONS}. "
                "Pass letters=, the sets of propositions that can hold at once."
            )
        sizes = range(len(propositions) + 1)
        letters = chain.from_iterable(combinations(propositions, size) for size in sizes)
    bit = {name: 1 << p for p, name in enumerate(propositions)}
    given = as_letters(letters, "to_automaton: letters")
    distinct = {letter.intersection(bit) for letter in given}
    if not distinct:
        raise ValueError(
            "to_automaton: letters is empty. Pass at least one letter, such as set(), or None "
            "for all of them."
        )
    return sorted(distinct, key=lambda letter: sum(bit[name] for name in letter))


def _outside_fragments(formula: Formula, normal: Formula) -> str:
    unsafe = offending_subformula(formula, "safety")
    uncosafe = offending_subformula(formula, "cosafe")
    assert unsafe is not None and uncosafe is not None
    inwards = "" if normal == formula else f"  With its negations pushed inwards: {normal}\n"
    return (
        f"to_automaton: {formula} is neither co-safe nor a safety formula.\n{inwards}"
        f"  Not co-safe, because of {uncosafe}: {uncosafe.operator} asks something of infinitely "
        "many steps, which no finite prefix proves (co-safe has X F U M).\n"
        f"  Not safety, because of {unsafe}: {unsafe.operator} may be fulfilled arbitrarily "
        "late, so no finite prefix refutes it (safety has X G R W).\n"
        f"  For co-safe, ask {uncosafe.operator} only up to an event, as in 'p U done' for "
        f"'G p'; for safety, replace {unsafe.operator} by a deadline of X, or U by W; or "
        "translate the co-safe and the safety parts of a conjunction one by one."
    )


def _progression_automaton(
    formula: Formula, alphabet: list[frozenset[str]], acceptance: str, max_states: int
) -> Automaton:
    """The minimal automaton of a formula in negation normal form."""
    diagrams = _Diagrams()
    variables, diagram_of = _encode(formula, diagrams)
    steps = [_step(letter, variables, diagram_of, diagrams) for letter in alphabet]
    states, delta = _explore(diagram_of[formula], steps, max_states)
    reached = np.array(states) == (_TRUE if acceptance == "cosafe" else _FALSE)
    decided = _forced(delta, reached)
    propositions = formula.propositions
    final = decided if acceptance == "cosafe" else ~decided
    automaton = Automaton(
        delta=delta,
        initial=0,
        priority=np.where(final, 0, 1)[:, None].repeat(len(alphabet), axis=1).astype(np.int32),
        letters=np.array([[name in letter for name in propositions] for letter in alphabet], bool),
        propositions=propositions,
        acceptance=acceptance,
    )
    classes = equivalence_classes(automaton)
    minimal = quotient(automaton, classes)
    _, first = np.unique(classes, return_index=True)  # every state is reachable
    names = _state_names([states[q] for q in first], minimal, variables, diagrams)
    return replace(minimal, state_names=names)


def _explore(
    start: int, steps: list[Callable[[int], int]], max_states: int
) -> tuple[list[int], NDArray[np.int32]]:
    """The states reached from `start`, breadth first, and their transition table `[Q, L]`."""
    states = [start]
    index = {start: 0}
    rows = []
    for state in states:
        row = [step(state) for step in steps]
        for successor in row:
            if successor not in index:
                index[successor] = len(states)
                states.append(successor)
        rows.append(np.array([index[successor] for successor in row], np.int32))
        if len(states) > max_states:
            raise ValueError(
                f"to_automaton: more than {max_states} states. Pass fewer letters=, split the "
                "formula into parts that are tracked side by side, or raise max_states."
            )
    return states, np.array(rows)


def _forced(delta: NDArray[np.int32], target: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The states from which every word reaches the target, bool `[Q]`."""
    while True:
        wider = target | target[delta].all(axis=1)
        if (wider == target).all():
            return target
        target = wider


# ---------------------------------------------------------------------------------------------
# Progression
# ---------------------------------------------------------------------------------------------

_FALSE, _TRUE = 0, 1
_TEMPORAL = frozenset("XFGURWM")


class _Diagrams:
    """Reduced ordered binary decision diagrams (Bryant 1986), equal iff equivalent.

    A diagram is an index into `nodes`, which holds (variable, diagram if it is false, diagram if
    it is true); 0 is false and 1 is true.
    """

    def __init__(self) -> None:
        bottom = sys.maxsize  # the constants come after every variable
        self.nodes = [(bottom, _FALSE, _FALSE), (bottom, _TRUE, _TRUE)]
        self._index: dict[tuple[int, int, int], int] = {}
        self._choices: dict[tuple[int, int, int], int] = {}

    def node(self, variable: int, low: int, high: int) -> int:
        if low == high:
            return low
        found = self._index.setdefault((variable, low, high), len(self.nodes))
        if found == len(self.nodes):
            self.nodes.append((variable, low, high))
        return found

    def cofactors(self, diagram: int, variable: int) -> tuple[int, int]:
        top, low, high = self.nodes[diagram]
        return (low, high) if top == variable else (diagram, diagram)

    def choice(self, test: int, then: int, other: int) -> int:
        """The diagram of `(test & then) | (!test & other)`."""
        if test == _TRUE or then == other:
            return then
        if test == _FALSE:
            return other
        if then == _TRUE and other == _FALSE:
            return test
        key = (test, then, other)
        if key not in self._choices:
            variable = min(self.nodes[diagram][0] for diagram in key)
            low, high = zip(*[self.cofactors(diagram, variable) for diagram in key], strict=True)
            self._choices[key] = self.node(variable, self.choice(*low), self.choice(*high))
        return self._choices[key]

    def both(self, left: int, right: int) -> int:
        return self.choice(left, right, _FALSE)

    def either(self, left: int, right: int) -> int:
        return self.choice(left, _TRUE, right)

    def negation(self, diagram: int) -> int:
        return self.choice(diagram, _FALSE, _TRUE)


def _encode(formula: Formula, diagrams: _Diagrams) -> tuple[list[Formula], dict[Formula, int]]:
    """The variables, propositions before temporal subformulas, and each subformula's diagram."""
    nodes = subformulas(formula)
    variables = [node for node in nodes if node.operator == "ap"]
    variables += [node for node in nodes if node.operator in _TEMPORAL]
    diagram_of = {v: diagrams.node(i, _FALSE, _TRUE) for i, v in enumerate(variables)}
    for node in nodes:
        # From the last operand to the first, so that the top variables are added last.
        operands = [diagram_of[operand] for operand in reversed(node.operands)]
        match node.operator:
            case "true" | "false":
                diagram_of[node] = _TRUE if node.operator == "true" else _FALSE
            case "!":
                diagram_of[node] = diagrams.negation(operands[0])
            case "&":
                diagram_of[node] = reduce(lambda rest, f: diagrams.both(f, rest), operands)
            case "|":
                diagram_of[node] = reduce(lambda rest, f: diagrams.either(f, rest), operands)
    return variables, diagram_of


def _step(
    letter: frozenset[str],
    variables: list[Formula],
    diagram_of: dict[Formula, int],
    diagrams: _Diagrams,
) -> Callable[[int], int]:
    """The function from the diagram of a formula to that of what is left of it after `letter`.

    It replaces each variable by its own successor: `af(f U g) = af(g) | (af(f) & f U g)`.
    """
    both, either = diagrams.both, diagrams.either
    successors: list[int] = []
    done = {_FALSE: _FALSE, _TRUE: _TRUE}

    def after(diagram: int) -> int:
        if diagram not in done:
            variable, low, high = diagrams.nodes[diagram]
            done[diagram] = diagrams.choice(successors[variable], after(high), after(low))
        return done[diagram]

    for variable in variables:
        if variable.operator == "ap":
            successors.append(_TRUE if variable.proposition in letter else _FALSE)
            continue
        itself = diagram_of[variable]
        left, right = diagram_of[variable.operands[0]], diagram_of[variable.operands[-1]]
        match variable.operator:
            case "X":
                successors.append(left)
            case "F":
                successors.append(either(after(right), itself))
            case "G":
                successors.append(both(after(right), itself))
            case "U" | "W":
                successors.append(either(after(right), both(after(left), itself)))
            case "R" | "M":
                successors.append(both(after(right), either(after(left), itself)))
    return after


# ---------------------------------------------------------------------------------------------
# State names
# ---------------------------------------------------------------------------------------------

_Text: TypeAlias = tuple[str, bool]  # and whether it needs parentheses inside a longer one


def _state_names(
    states: list[int], minimal: Automaton, variables: list[Formula], diagrams: _Diagrams
) -> tuple[str, ...]:
    """What is left to satisfy in each state: the shorter of its disjunctive and conjunctive form.

    Args:
        states: `[Q]` diagrams, one for each state of `minimal`.
        minimal: The minimal automaton.
        variables: The formula of each variable of the diagrams.
        diagrams: The diagrams.
    """
    texts: dict[Formula, str] = {}
    for node in subformulas(Formula("&", (TRUE, TRUE, *variables))):
        text = render(node, [texts[operand] for operand in node.operands])
        texts[node] = text if len(text) <= MAX_NAME else "..."
    literals = [(texts[variable], len(variable.operands) > 1) for variable in variables]
    paths = {True: [0, 1], False: [1, 0]}  # how many lead from each diagram to true, to false
    for count in paths.values():
        for _, low, high in diagrams.nodes[2:]:
            count.append(count[low] + count[high])
    names = []
    for q, state in enumerate(states):
        if (minimal.delta[q] == q).all():
            names.append("true" if minimal.final[q] else "false")
            continue
        forms = [
            _normal_form(state, disjunctive, literals, diagrams)
            for disjunctive, count in paths.items()
            if count[state] <= MAX_CUBES
        ]
        name = min(forms, key=len, default="...")
        names.append(name if len(name) <= MAX_NAME else "...")
    return tuple(names)


def _normal_form(
    diagram: int, disjunctive: bool, literals: list[_Text], diagrams: _Diagrams
) -> str:
    # The conjunctive form of f is the negation, literal by literal, of the disjunctive one of !f.
    goal = diagram if disjunctive else diagrams.negation(diagram)
    outer, inner = ("|", "&") if disjunctive else ("&", "|")
    clauses = []
    for cube in _cubes(goal, goal, diagrams)[0]:
        texts = []
        for variable, value in cube:
            text, grouped = literals[variable]
            negated = f"!({text})" if grouped else f"!{text}"
            texts.append(literals[variable] if value == disjunctive else (negated, False))
        clauses.append(_joined(inner, texts))
    return _joined(outer, clauses)[0]


def _joined(operator: str, texts: list[_Text]) -> _Text:
    if len(texts) == 1:
        return texts[0]
    return f" {operator} ".join(f"({text})" if group else text for text, group in texts), True


def _cubes(
    lower: int, upper: int, diagrams: _Diagrams
) -> tuple[list[tuple[tuple[int, bool], ...]], int]:
    """An irredundant disjunction of prime cubes between two diagrams, and its own diagram.

    Minato 1993, "Fast generation of prime-irredundant covers from binary decision diagrams".
    """
    if lower == _FALSE:
        return [], _FALSE
    if upper == _TRUE:
        return [()], _TRUE
    both, either, negation = diagrams.both, diagrams.either, diagrams.negation
    variable = min(diagrams.nodes[lower][0], diagrams.nodes[upper][0])
    lower0, lower1 = diagrams.cofactors(lower, variable)
    upper0, upper1 = diagrams.cofactors(upper, variable)
    cubes0, cover0 = _cubes(both(lower0, negation(upper1)), upper0, diagrams)
    cubes1, cover1 = _cubes(both(lower1, negation(upper0)), upper1, diagrams)
    missing = either(both(lower0, negation(cover0)), both(lower1, negation(cover1)))
    cubes, cover = _cubes(missing, both(upper0, upper1), diagrams)
    with_variable = [((variable, False), *cube) for cube in cubes0]
    with_variable += [((variable, True), *cube) for cube in cubes1]
    whole = diagrams.node(variable, either(cover0, cover), either(cover1, cover))
    return with_variable + cubes, whole
