"""Automata in readable forms: guards as Boolean formulas, tables, Graphviz, and JSON."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.automata.automaton import (
    CONDITIONS,
    Automaton,
    extent_text,
    make_automaton,
    named_propositions,
)
from jaxltl.core.logic.diagram import FALSE, TRUE, Cube, Diagrams, prime_cubes
from jaxltl.core.logic.ltl import proposition_text


def guards(automaton: Automaton) -> dict[tuple[int, int], str]:
    """A short condition on the propositions for each pair of states joined by a letter.

    An irredundant disjunction of prime cubes, free on combinations that are no letter.
    """
    same = np.zeros_like(np.asarray(automaton.priority))
    return {(q, end): text for (q, end, _), text in _guards(automaton, same).items()}


def edge_guards(automaton: Automaton) -> dict[tuple[int, int, int], str]:
    """The condition of each (state, successor, priority) that some letter has, see `guards`."""
    return _guards(automaton, np.asarray(automaton.priority))


def _guards(automaton: Automaton, marks: NDArray[Any]) -> dict[tuple[int, int, int], str]:
    """A guard for each (state, successor, mark), with the marks `[Q, L]` of transitions."""
    literals = [proposition_text(name) for name in named_propositions(automaton)]
    # As numbers of any size, for automata over many propositions and few letters.
    numbers = [
        sum(1 << p for p in np.flatnonzero(row).tolist()) for row in np.asarray(automaton.letters)
    ]
    result = {}
    for q, row in enumerate(np.asarray(automaton.delta).tolist()):
        groups = defaultdict(set)
        for number, successor, mark in zip(numbers, row, marks[q].tolist(), strict=True):
            groups[successor, mark].add(number)
        for successor, mark in sorted(groups):
            chosen = groups[successor, mark]
            cubes = prime_cover(chosen, set(numbers) - chosen, len(literals))
            texts = [
                " & ".join(literals[p] if value else f"!{literals[p]}" for p, value in cube)
                for cube in cubes
            ]
            if len(texts) > 1:
                texts = [f"({text})" if " & " in text else text for text in texts]
            result[q, successor, mark] = " | ".join(texts) or "true"
    return result


def prime_cover(chosen: set[int], others: set[int], width: int) -> list[Cube]:
    """Irredundant prime cubes of the chosen letters; letters of neither set are free."""
    if len(chosen) + len(others) < 1 << width:
        # Where few letters occur, a few propositions tell, and guards of others would be long.
        mask = _telling(chosen, others, width)
        chosen, others = ({n & mask for n in part} for part in (chosen, others))
    diagrams = Diagrams()
    lower = _diagram_of(chosen, width, diagrams)
    upper = diagrams.negation(_diagram_of(others, width, diagrams))
    cubes, _ = prime_cubes(lower, upper, diagrams)
    return sorted(tuple((-variable, value) for variable, value in cube[::-1]) for cube in cubes)


def _telling(chosen: set[int], others: set[int], width: int) -> int:
    """Propositions, as bits, that tell all chosen letters from the others, found greedily."""
    mask = 0
    while True:
        alike: dict[int, tuple[list[int], list[int]]] = defaultdict(lambda: ([], []))
        for side, part in enumerate((chosen, others)):
            for n in part:
                alike[n & mask][side].append(n)
        mixed = [(left, right) for left, right in alike.values() if left and right]
        if not mixed:
            return mask

        def score(p: int, mixed: list[tuple[list[int], list[int]]] = mixed) -> int:
            pairs = 0
            for left, right in mixed:
                held, others_held = (sum(n >> p & 1 for n in part) for part in (left, right))
                pairs += held * (len(right) - others_held) + (len(left) - held) * others_held
            return pairs

        mask |= 1 << max(range(width), key=score)


def _diagram_of(letters: set[int], width: int, diagrams: Diagrams) -> int:
    """The diagram that holds in the given letters; proposition p is the variable -p."""
    if not letters or not width:
        return TRUE if letters else FALSE
    bit = 1 << (width - 1)
    low = _diagram_of({n for n in letters if not n & bit}, width - 1, diagrams)
    high = _diagram_of({n - bit for n in letters if n & bit}, width - 1, diagrams)
    return diagrams.node(1 - width, low, high)


def _state_labels(automaton: Automaton) -> list[str]:
    names = automaton.state_names or [""] * len(automaton.delta)
    return [f"{q}: {name}" if name else f"{q}" for q, name in enumerate(names)]


def to_text(automaton: Automaton) -> str:
    """Readable automaton: `>` marks the initial state, `*` final states or Buchi transitions."""
    lines = [f"{automaton.acceptance} automaton: {extent_text(automaton)}"]
    final = _final_states(automaton)
    edges = defaultdict(list)
    for (q, successor, priority), text in edge_guards(automaton).items():
        mark = _mark(automaton, priority, " *")
        edges[q].append(f"     {text} -> {successor}{mark}")
    for q, label in enumerate(_state_labels(automaton)):
        marks = (">" if q == automaton.initial else " ") + ("*" if final[q] else " ")
        lines += [f"{marks} {label}", *edges[q]]
    return "\n".join(lines)


def _final_states(automaton: Automaton) -> NDArray[np.bool_]:
    """bool `[Q]`, none where acceptance is on transitions."""
    if automaton.has_final_states:
        return np.asarray(automaton.final)
    return np.zeros(len(automaton.delta), bool)


def _mark(automaton: Automaton, priority: int, sign: str) -> str:
    """Acceptance marks of a transition, for acceptance on transitions."""
    if automaton.is_parity:
        return f" {{{priority}}}"
    return sign if priority == automaton.marked_priority else ""


def to_dot(automaton: Automaton) -> str:
    """Automaton in DOT: final states double circled, accepting transitions bold."""
    lines = ["rankdir=LR;", 'start [shape=point, label=""];', f"start -> {automaton.initial};"]
    final = _final_states(automaton)
    for q, label in enumerate(_state_labels(automaton)):
        shape = "doublecircle" if final[q] else "circle"
        lines.append(f"{q} [shape={shape}, label={_dot_string(label)}];")
    for (q, successor, priority), text in edge_guards(automaton).items():
        label = _dot_string(text + _mark(automaton, priority, " ●"))
        bold = priority == automaton.marked_priority
        style = ', style=bold, color="#1f6f8b"' if bold else ""
        lines.append(f"{q} -> {successor} [label={label}{style}];")
    return "\n".join(["digraph automaton {", *(f"  {line}" for line in lines), "}"])


def _dot_string(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'


def to_dict(automaton: Automaton) -> dict[str, Any]:
    """The automaton as lists, numbers and strings, for JSON; `from_dict` is the inverse."""
    table = CONDITIONS[automaton.acceptance].table
    return {
        "delta": automaton.delta.tolist(),
        "initial": int(automaton.initial),
        table: getattr(automaton, table).tolist(),
        "letters": automaton.letters.tolist(),
        "propositions": list(named_propositions(automaton)),
        "acceptance": automaton.acceptance,
        "state_names": list(automaton.state_names),
    }


def from_dict(tables: Mapping[str, Any]) -> Automaton:
    """The automaton that `to_dict` wrote."""
    table = CONDITIONS.get(tables.get("acceptance", ""), CONDITIONS["cosafe"]).table
    fields = set(Automaton.__dataclass_fields__) - {"priority"} | {table}
    if set(tables) != fields:
        wrong = ", ".join(sorted(map(str, set(tables) ^ fields)))
        raise ValueError(
            f"from_dict: missing or unknown entries: {wrong}. Pass what to_dict returned."
        )
    return make_automaton(**tables)
