"""Deterministic automata over infinite words, as integer tables.

An automaton reads one letter per step; a letter is the set of the propositions true then.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.logic.ltl import Letter, as_letters
from jaxltl.core.pretty_print import brief


class Condition(NamedTuple):
    """An acceptance condition: what differs from the other ones in tables, files and pictures."""

    table: Literal["final", "accepting", "priority"]  # the argument of `make_automaton`
    priorities: tuple[int, int] | None  # where the table is True and False; None: any
    complement: str | None  # None: that of the priorities of the complement
    reward: str  # the name of the default reward of tasks


# The first condition that has all priorities of an automaton is its own, see `condition_of`.
CONDITIONS = {
    "cosafe": Condition("final", (0, 1), "safety", "reach"),
    "safety": Condition("final", (0, 1), "cosafe", "keep"),
    "buchi": Condition("accepting", (0, 1), None, "eventual"),
    "parity": Condition("priority", None, None, "parity"),
}
ACCEPTANCES = tuple(CONDITIONS)
MAX_FREE_PROPOSITIONS = 12  # 2^12 letters


@brief(fields=("acceptance", "delta", "propositions", "state_names"), drawn=True)
@dataclass(frozen=True, eq=False)
class Automaton:
    """A complete deterministic automaton; see `make_automaton` for checked construction.

    A word is accepted iff the least priority that its run reads infinitely often is even
    (min-even parity, on transitions). The acceptance determines the priorities:

    - `"cosafe"`: 0 in final states, which are absorbing, else 1: the run must reach one.
    - `"safety"`: the same, with absorbing non-final states: the run must avoid them.
    - `"buchi"`: 0 on accepting transitions, else 1.
    - `"parity"`: any.

    Attributes:
      delta: int32 `[Q, L]`, the state after reading letter l in state q.
      initial: int32 scalar, the state before anything is read.
      priority: int32 `[Q, L]`, of reading letter l in state q.
      letters: bool `[L, P]`, True if proposition p holds in letter l.
      propositions: `[P]` names.
      acceptance: `"cosafe"`, `"safety"`, `"buchi"` or `"parity"`.
      state_names: `[Q]` readable names, one formula per state, or empty.

    Example:
      >>> import jaxltl as jl
      >>> task = jl.to_automaton("F a")
      >>> task.acceptance, task.delta.tolist(), task.letters.tolist(), task.final.tolist()
      ('cosafe', [[0, 1], [1, 1]], [[False], [True]], [False, True])
    """

    delta: NDArray[np.int32]
    initial: int | NDArray[np.int32]
    priority: NDArray[np.int32]
    letters: NDArray[np.bool_]
    propositions: tuple[str, ...]
    acceptance: str
    state_names: tuple[str, ...] = ()

    @property
    def has_final_states(self) -> bool:
        """True if finite prefixes decide acceptance: co-safe and safety automata."""
        return CONDITIONS[self.acceptance].table == "final"

    @property
    def is_cosafe(self) -> bool:
        """True if words are accepted by reaching a final state."""
        return self.acceptance == "cosafe"

    @property
    def is_safety(self) -> bool:
        """True if words are accepted by never leaving the final states."""
        return self.acceptance == "safety"

    @property
    def is_parity(self) -> bool:
        """True if the parity of the least priority taken infinitely often decides acceptance."""
        return self.acceptance == "parity"

    @property
    def marked_priority(self) -> int | None:
        """Priority of the transitions that files and pictures mark; None for marks on states, and
        for parity, where each transition has its number."""
        condition = CONDITIONS[self.acceptance]
        on_states = condition.table == "final"
        return None if on_states or condition.priorities is None else min(condition.priorities)

    @property
    def final(self) -> NDArray[np.bool_]:
        """bool `[Q]`, the final states of a co-safe or safety automaton.

        Raises:
          ValueError: for Buchi and parity acceptance, which is on transitions.
        """
        if not self.has_final_states:
            raise ValueError(
                f"final: an automaton with {self.acceptance} acceptance has no final states. "
                "Read its priority[Q, L], or accepting[Q, L]."
            )
        final: NDArray[np.bool_] = self.priority[..., 0] == 0
        return final

    @property
    def accepting(self) -> NDArray[np.bool_]:
        """bool `[Q, L]`, the transitions of even priority."""
        even: NDArray[np.bool_] = self.priority % 2 == 0
        return even


def make_automaton(
    delta: ArrayLike,
    initial: int,
    letters: ArrayLike,
    propositions: Iterable[str],
    *,
    final: ArrayLike | None = None,
    accepting: ArrayLike | None = None,
    priority: ArrayLike | None = None,
    acceptance: str | None = None,
    state_names: Iterable[str] = (),
) -> Automaton:
    """An `Automaton` from checked tables.

    Args:
      delta: `[Q, L]` integers in 0..Q-1.
      initial: in 0..Q-1.
      letters: `[L, P]` booleans, no two rows equal.
      propositions: `[P]` distinct names.
      final: `[Q]` booleans, absorbing as `acceptance` asks.
      accepting: `[Q]` or `[Q, L]` booleans, visited infinitely often (Buchi).
      priority: `[Q]` or `[Q, L]` integers from 0 up; the least one met infinitely often is even.
      acceptance: `"cosafe"` or `"safety"` with `final`; otherwise derived from the other arguments.
      state_names: `[Q]` names, or none.

    Returns:
      The `Automaton`, on the host.

    Raises:
      ValueError: naming the table, the entry and the fix.

    Example:
      >>> eventually_a = make_automaton([[0, 1], [1, 1]], 0, [[False], [True]], ["a"],
      ...                               final=[False, True], acceptance="cosafe")
      >>> int(eventually_a.delta[0, 1])
      1
    """
    names, states = tuple(propositions), tuple(state_names)
    table = np.asarray(delta)
    if table.ndim != 2 or 0 in table.shape or table.dtype.kind not in "iu":
        raise ValueError(
            f"make_automaton: delta has shape {table.shape} and type {table.dtype}. "
            "Pass integers [states, letters], with at least one of each."
        )
    count, width = table.shape
    for q, letter in np.argwhere((table < 0) | (table >= count))[:1]:
        raise ValueError(
            f"make_automaton: delta[{q}, {letter}] = {table[q, letter]} is no state. "
            f"The {count} rows of delta are the states 0..{count - 1}."
        )
    if initial not in range(count):
        raise ValueError(
            f"make_automaton: initial = {initial} is no state. Pass one of 0..{count - 1}."
        )
    if states and len(states) != count:
        raise ValueError(
            f"make_automaton: {len(states)} state_names for {count} states. Pass one each, or none."
        )
    rows = _booleans(letters, "letters", (width, len(names)))
    _check_distinct(names, rows)
    kind, priorities = _priorities(table, final, accepting, priority, acceptance)
    return Automaton(
        delta=table.astype(np.int32),
        initial=np.asarray(initial, np.int32),
        priority=priorities.astype(np.int32),
        letters=rows,
        propositions=names,
        acceptance=kind,
        state_names=states,
    )


def _priorities(
    delta: Integers,
    final: ArrayLike | None,
    accepting: ArrayLike | None,
    priority: ArrayLike | None,
    acceptance: str | None,
) -> tuple[str, Integers]:
    """The acceptance and its priorities `[Q, L]`, from the one table that is given."""
    acceptance_arrays = {"final": final, "accepting": accepting, "priority": priority}
    (name, *more) = [key for key, table in acceptance_arrays.items() if table is not None] or [""]
    if not name or more:
        raise ValueError("make_automaton: give exactly one of final, accepting and priority.")
    kinds = [kind for kind, condition in CONDITIONS.items() if condition.table == name]
    kind = kinds[0] if acceptance is None and name != "final" else acceptance
    if kind is None or kind not in kinds:
        raise ValueError(
            f"make_automaton: acceptance = {acceptance!r} with {name}. "
            f"Pass one of {', '.join(kinds)}."
        )
    numbers = CONDITIONS[kind].priorities or (0, 1)
    if name == "priority":
        table = np.asarray(priority)
        if table.dtype.kind not in "iu" or table.shape not in (delta.shape, delta.shape[:1]):
            raise ValueError(
                f"make_automaton: priority has shape {table.shape} and type {table.dtype}. "
                f"Pass integers of shape {delta.shape} or {delta.shape[:1]}."
            )
        if (table < 0).any():
            raise ValueError(f"make_automaton: priority {table.min()} is negative. Count from 0.")
    elif name == "accepting":
        shape = delta.shape[:1] if np.ndim(accepting) == 1 else delta.shape  # type: ignore[arg-type]
        table = np.where(_booleans(accepting, "accepting", shape), *numbers)
    else:
        is_final = _booleans(final, "final", delta.shape[:1])
        absorbing = is_final if kind == "cosafe" else ~is_final
        for q, letter in np.argwhere(absorbing[:, None] & ~absorbing[delta])[:1]:
            inside = "final" if kind == "cosafe" else "non-final"
            raise ValueError(
                f"make_automaton: delta[{q}, {letter}] = {delta[q, letter]} leaves the {inside} "
                f"states, which {kind!r} acceptance has absorbing. Redirect it, or change final."
            )
        table = np.where(is_final, *numbers)
    if table.ndim == 1:
        table = np.repeat(table[:, None], delta.shape[1], axis=1)
    return kind, table


def condition_of(priority: Integers) -> str:
    """The acceptance on transitions of an automaton with some priorities."""
    numbers = set(np.unique(priority).tolist())
    return next(
        kind
        for kind, condition in CONDITIONS.items()
        if condition.table != "final" and numbers.issubset(condition.priorities or numbers)
    )


def _check_distinct(names: tuple[str, ...], rows: NDArray[np.bool_]) -> None:
    for name in names:
        if names.count(name) > 1 or not isinstance(name, str):
            raise ValueError(f"make_automaton: propositions has {name!r}. Pass distinct strings.")
    first: dict[bytes, int] = {}
    for letter, row in enumerate(rows):
        twin = first.setdefault(row.tobytes(), letter)
        if twin != letter:
            held = letter_text(names, row)
            raise ValueError(
                f"make_automaton: letters {twin} and {letter} are both {held}. Keep one of them."
            )


def _booleans(values: ArrayLike | None, place: str, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    array = np.asarray(values)
    if array.size == 0:  # an empty list says nothing of its type
        array = array.astype(bool)
    if array.shape != shape or array.dtype.kind != "b":
        raise ValueError(
            f"make_automaton: {place} has shape {array.shape} and type {array.dtype}. "
            f"Pass booleans of shape {shape}."
        )
    return array


def named_propositions(automaton: Automaton) -> tuple[str, ...]:
    """The names of the columns of the letters; ValueError for an automaton without them."""
    names, count = automaton.propositions, np.shape(automaton.letters)[-1]
    if len(names) != count:  # a compiled program keeps arrays only
        raise ValueError(
            f"the automaton has {len(names)} names for {count} propositions: a function under jit "
            "returns its arrays alone. Use the automaton from outside of jit, or name them: "
            "dataclasses.replace(automaton, propositions=...)."
        )
    return names


def make_alphabet(
    names: Sequence[str], letters: Iterable[Letter] | None, place: str
) -> NDArray[np.bool_]:
    """Letters `[L, P]` in the order of the binary numbers with proposition p as bit p.

    All of them for None, else those given, without names that are not among the propositions.
    """
    if letters is None:
        if len(names) > MAX_FREE_PROPOSITIONS:
            raise ValueError(
                f"{place}: {len(names)} propositions make 2^{len(names)} letters; the limit is "
                f"2^{MAX_FREE_PROPOSITIONS}. Pass letters=, the sets of propositions that can hold "
                "at once."
            )
        numbers = list(range(2 ** len(names)))
    else:
        alphabet = as_letters(letters, f"{place.partition(':')[0]}: letters")
        sums = (
            sum(1 << p for p, name in enumerate(names) if name in letter) for letter in alphabet
        )
        numbers = sorted(set(sums))
    if not numbers:
        raise ValueError(
            f"{place}: letters is empty. Pass at least one letter, such as set(), or None for all "
            "of them."
        )
    rows = [[bool(number >> p & 1) for p in range(len(names))] for number in numbers]
    return np.array(rows, bool).reshape(len(rows), len(names))


# --- Runs ------------------------------------------------------------------------------------


def letter_index(automaton: Automaton, letter: Letter) -> int:
    """The index l of a letter, so that `delta[q, l]` reads it."""
    return _read(automaton, [letter], "letter_index: letter")[0]


def _read(automaton: Automaton, word: Iterable[Letter], place: str) -> list[int]:
    names = named_propositions(automaton)
    index = {
        frozenset(name for name, holds in zip(names, row, strict=True) if holds): i
        for i, row in enumerate(automaton.letters)
    }
    read = []
    for position, letter in enumerate(as_letters(word, place)):
        known = letter.intersection(names)
        if known not in index:
            raise ValueError(
                f"{place} {position} is {set(known) or '{}'}, which is not among the "
                f"{len(index)} letters of the automaton. Add it where the automaton is built "
                "(the argument letters=)."
            )
        read.append(index[known])
    return read


def run(automaton: Automaton, word: Iterable[Letter]) -> NDArray[np.int32]:
    """States ``q[t+1] = delta[q[t], w[t]]`` of a finite word, from ``q[0] = initial``."""
    states = [int(automaton.initial)]
    for letter in _read(automaton, word, "run: letter"):
        states.append(int(automaton.delta[states[-1], letter]))
    return np.array(states, np.int32)


def accepts_lasso(automaton: Automaton, prefix: Iterable[Letter], cycle: Iterable[Letter]) -> bool:
    """True if the automaton accepts the infinite word prefix·cycle^ω.

    Args:
      automaton: the automaton.
      prefix: `[n]` letters, may be empty.
      cycle: `[m]` letters, at least one.

    Returns:
      True if the word is accepted.

    Raises:
      ValueError: if the cycle is empty, or a letter is not among the automaton's.

    Example:
      >>> from jaxltl import to_automaton
      >>> accepts_lasso(to_automaton("F a"), prefix=[set()], cycle=[set(), {"a"}])
      True
    """
    laps = _read(automaton, cycle, "accepts_lasso: cycle letter")
    if not laps:
        raise ValueError("accepts_lasso: the cycle is empty. Pass at least one letter.")
    state = int(automaton.initial)
    for letter in _read(automaton, prefix, "accepts_lasso: prefix letter"):
        state = int(automaton.delta[state, letter])
    # The least priority of each lap, by the state in which the lap starts.
    least: dict[int, int] = {}
    lap_end: dict[int, int] = {}
    while state not in least:
        start = state
        read = []
        for letter in laps:
            read.append(int(automaton.priority[state, letter]))
            state = int(automaton.delta[state, letter])
        least[start], lap_end[start] = min(read), state
    on_cycle = {state}
    while (state := lap_end[state]) not in on_cycle:
        on_cycle.add(state)
    return min(least[q] for q in on_cycle) % 2 == 0


def complement(automaton: Automaton) -> Automaton:
    """The automaton that accepts exactly the words that `automaton` rejects.

    Final states become non-final and vice versa, which turns co-safe into safety acceptance; other
    priorities grow by one, which turns Buchi into parity.

    Args:
      automaton: with any acceptance.

    Returns:
      The complement, over the same letters.

    Example:
      >>> from jaxltl import to_automaton
      >>> complement(to_automaton("F a")).state_names
      ('!(F a)', 'false')
    """
    constants = {"true": "false", "false": "true"}
    priority = automaton.priority + 1
    if automaton.has_final_states:
        priority = 1 - automaton.priority
    elif automaton.priority.min() > 0:
        priority = automaton.priority - 1
    return replace(
        automaton,
        priority=priority,
        acceptance=CONDITIONS[automaton.acceptance].complement or condition_of(priority),
        state_names=tuple(constants.get(name, f"!({name})") for name in automaton.state_names),
    )


def extent_text(automaton: Automaton) -> str:
    """Numbers of states and letters as text."""
    counts = zip(automaton.delta.shape, ("state", "letter"), strict=True)
    sizes = ", ".join(f"{n} {name}{'' if n == 1 else 's'}" for n, name in counts)
    if automaton.letters.shape[-1] != len(automaton.propositions):  # returned by a program
        return f"{sizes} over {automaton.letters.shape[-1]} propositions"
    return f"{sizes} over {', '.join(automaton.propositions) or 'no propositions'}"


def letter_text(names: Collection[str], row: NDArray[np.bool_]) -> str:
    """A letter as the set of its propositions."""
    return "{" + ", ".join(name for name, holds in zip(names, row, strict=True) if holds) + "}"
