"""Deterministic automata in the Hanoi Omega-Automata (HOA) format, version 1.

https://adl.github.io/hoaf/ (Babiak et al. 2015, "The Hanoi omega-automata format").
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import Automaton, make_alphabet, named_propositions
from jaxltl.core.automata.emerson_lei import to_parity
from jaxltl.core.automata.text import prime_cover
from jaxltl.core.logic.diagram import Cube
from jaxltl.core.logic.ltl import Letter, as_letters
from jaxltl.io.hoa.header import (
    MAX_PRIORITIES,
    HoaHeader,
    acceptance_of,
    colors_of,
    decisive_sets,
    edge_priority,
)
from jaxltl.io.hoa.grammar import ParsedState, split_texts
from jaxltl.io.hoa.table import EdgeTable, only_text, parsed, read_table

if TYPE_CHECKING:
    from lark import Token


def read_hoa(text: str, letters: Iterable[Letter] | None = None) -> Automaton:
    """Deterministic automaton of a HOA text.

    Reads labels and acceptance marks on edges and states, implicit labels, aliases and any
    acceptance formula. Buchi, co-Buchi and parity conditions keep their states, others are
    converted to parity. Missing edges lead to an added rejecting state. Propositions are sorted.

    Args:
      text: the automaton, from `HOA:` to `--END--`.
      letters: possible letters, each a collection of proposition names, of which unknown names are
        ignored; None for all 2^P subsets.

    Returns:
      An automaton with Buchi acceptance for priorities 0 and 1, else parity; the output of
      `write_hoa` keeps its acceptance. Letters are ordered as binary numbers, proposition p as bit
      p.

    Raises:
      ValueError: with the line, for malformed text, nondeterminism, no or several automata, or more
        than 12 propositions without `letters`.

    Example:
      >>> infinitely_often_a = read_hoa('''
      ... HOA: v1 States: 1 Start: 0 AP: 1 "a" Acceptance: 1 Inf(0)
      ... --BODY-- State: 0 [0] 0 {0} [!0] 0 --END--''')
      >>> infinitely_often_a.acceptance, infinitely_often_a.priority.tolist()
      ('buchi', [[1, 0]])
    """
    return _read(only_text(text, " Read several with read_hoa_stream."), letters)


def read_hoa_stream(text: str, letters: Iterable[Letter] | None = None) -> list[Automaton]:
    """Automata of a HOA text, without those that end with `--ABORT--`.

    Args:
      text: the automata, each from `HOA:` to `--END--`.
      letters: as in `read_hoa`, for all automata.

    Returns:
      The automata.

    Raises:
      ValueError: as `read_hoa`.

    Example:
      >>> always = 'HOA: v1 Start: 0 Acceptance: 0 t --BODY-- State: 0 [t] 0 --END--'
      >>> len(read_hoa_stream(always + always))
      2
    """
    alphabet = None if letters is None else as_letters(letters, "read_hoa: letters")
    return [_read(tokens, alphabet) for tokens in split_texts(text)]


def write_hoa(automaton: Automaton, name: str = "") -> str:
    """HOA text of an automaton, version 1.

    Co-safe and safety automata become Buchi automata with marks on states; Buchi and parity (min
    even) automata have marks on transitions. If the letters are not all subsets of the
    propositions, each letter has its own edge, and `read_hoa` needs `letters` to restore the
    automaton.

    Args:
      automaton: the automaton.
      name: its name, such as a formula.

    Returns:
      The text; `read_hoa` restores the same tables if propositions and letters are sorted.

    Raises:
      ValueError: for priorities above 255.

    Example:
      >>> from jaxltl import to_automaton
      >>> write_hoa(to_automaton("F a")).split("--BODY--")[1].split()[:6]
      ['State:', '0', '"F', 'a"', '[!0]', '0']
    """
    names = named_propositions(automaton)
    lines = header_lines(name, len(automaton.delta), int(automaton.initial), names)
    if automaton.is_parity:
        count = int(automaton.priority.max()) + 1
        lines += [f"acc-name: parity min even {count}", f"Acceptance: {count} {parity_text(count)}"]
    elif (automaton.marked_priority or 0) % 2 == 0:
        lines += ["acc-name: Buchi", "Acceptance: 1 Inf(0)"]
    else:
        lines += ["acc-name: co-Buchi", "Acceptance: 1 Fin(0)"]
    lines.append("properties: " + " ".join(_properties(automaton)))
    lines.append("--BODY--")
    for q in range(len(automaton.delta)):
        lines += _written_state(automaton, q)
    return "\n".join([*lines, "--END--", ""])


def _is_full(automaton: Automaton) -> bool:
    return len(automaton.letters) == 2 ** len(automaton.propositions)


def _properties(automaton: Automaton) -> list[str]:
    """HOA properties; `terminal`, `cosafe` and `weak` determine the acceptance on reading."""
    full = _is_full(automaton)
    words = ["trans-labels", "explicit-labels"]
    words.append("state-acc" if automaton.has_final_states else "trans-acc")
    words += ["complete", "deterministic"] if full else ["deterministic"]
    if automaton.is_parity:
        words.append("colored")
    if automaton.has_final_states:
        words.append("weak")
    if automaton.is_cosafe:  # a terminal automaton is complete where it accepts
        words.append("terminal" if full else "cosafe")
    return words


def parity_text(count: int, style: str = "min") -> str:
    """Acceptance formula of min-even or max-even parity over sets 0..count-1, as in Spot."""
    if count > MAX_PRIORITIES:
        raise ValueError(
            f"write_hoa: priority {count - 1} takes an acceptance formula of {count} sets; the "
            f"limit is {MAX_PRIORITIES}. Renumber the priorities, keeping their order and parity."
        )
    text = ""
    for i in range(count) if style == "max" else reversed(range(count)):
        atom, operator = (f"Inf({i})", "|") if i % 2 == 0 else (f"Fin({i})", "&")
        inner = f"({text})" if " " in text else text
        text = f"{atom} {operator} {inner}" if text else atom
    return text


def _written_state(automaton: Automaton, q: int) -> Iterator[str]:
    """Lines of state q and its edges."""
    on_state = automaton.has_final_states
    priorities = automaton.priority[q]
    head = f"State: {q}"
    if automaton.state_names:
        head += f" {quoted(automaton.state_names[q])}"
    if on_state and priorities[0] == 0:
        head += " {0}"
    yield head
    for successor, priority, chosen in _edges(automaton, q):
        label = " | ".join(
            "&".join(f"{p}" if value else f"!{p}" for p, value in cube) for cube in chosen
        )
        mark = f" {{{priority}}}" if automaton.is_parity else ""
        if priority == automaton.marked_priority:
            mark = " {0}"
        yield f"[{label or 't'}] {successor}{mark}"


def _edges(automaton: Automaton, q: int) -> Iterator[tuple[int, int, list[Cube]]]:
    """Successor, priority and cubes of each edge of state q, with disjoint labels."""
    pairs = list(zip(automaton.delta[q].tolist(), automaton.priority[q].tolist(), strict=True))
    if not _is_full(automaton):
        for row, (successor, priority) in zip(automaton.letters.tolist(), pairs, strict=True):
            yield successor, priority, [tuple(enumerate(row))]
        return
    width = len(automaton.propositions)
    numbers = (automaton.letters @ (1 << np.arange(width))).tolist()
    letters_of: dict[tuple[int, int], set[int]] = {}
    for number, pair in zip(numbers, pairs, strict=True):
        letters_of.setdefault(pair, set()).add(number)
    for pair, chosen in letters_of.items():
        yield *pair, prime_cover(chosen, set(numbers) - chosen, width)


def header_lines(name: str, states: int, start: int, names: Sequence[str]) -> list[str]:
    """The first lines of an automaton: its name, number of states, start and propositions."""
    lines = ["HOA: v1", 'tool: "jaxltl"', *([f"name: {quoted(name)}"] if name else [])]
    propositions = " ".join([f"AP: {len(names)}", *map(quoted, names)])
    return [*lines, f"States: {states}", f"Start: {start}", propositions]


def quoted(text: str) -> str:
    """Quotes and escapes a text."""
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"') + '"'


def _read(tokens: list[Token], letters: Iterable[Letter] | None) -> Automaton:
    def make(header: HoaHeader, states: list[ParsedState]) -> Automaton:
        names = tuple(sorted(header.propositions))
        alphabet = make_alphabet(names, letters, f"read_hoa: line {header.line}")
        # Columns of the sorted alphabet in the order of AP.
        columns = alphabet[:, [names.index(name) for name in header.propositions]]
        return _automaton(header, read_table(header, states, columns), alphabet, names)

    return parsed(tokens, make)


def _automaton(
    header: HoaHeader, table: EdgeTable, alphabet: NDArray[np.bool_], names: tuple[str, ...]
) -> Automaton:
    """Automaton with min-even priorities."""
    delta: Integers = table.target[table.edge_of]
    initial = int(header.start)
    base: Integers = np.arange(len(delta))
    order = decisive_sets(header.condition)
    priority: Integers
    if order is not None:
        of_edge = [edge_priority(marks, header.sets, *order) for marks in table.marks]
        priority = np.array(of_edge, np.int64)[table.edge_of]
    else:
        colors, compact = colors_of(header.condition, table.marks, header)
        colors = colors[table.edge_of]
        delta, priority, initial, base = to_parity(delta, colors, initial, compact)
    # The added sink rejects, even if the condition accepts runs without marks.
    priority[base == (-1 if table.sink is None else table.sink)] = 1
    return Automaton(
        delta=np.asarray(delta, np.int32),
        initial=np.asarray(initial, np.int32),
        priority=np.asarray(priority, np.int32),
        letters=alphabet,
        propositions=names,
        acceptance=acceptance_of(header, delta, priority),
        state_names=tuple(table.names[q] for q in base) if table.names else (),
    )
