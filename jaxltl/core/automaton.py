"""Deterministic automata over infinite words, as integer tables.

An automaton reads one letter per step; a letter is the set of the propositions true then.
"""

from __future__ import annotations

import importlib
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.ltl import Letter, as_letters, proposition_text

ACCEPTANCES = ("cosafe", "safety", "buchi", "parity")
DRAWN_STATES, DRAWN_ARROWS = 40, 120  # up to which a notebook shows a picture


@dataclass(frozen=True, eq=False)
class Automaton:
    """A complete deterministic automaton; see `make_automaton` for checked construction.

    A word is accepted iff the least priority that its run reads infinitely often is even
    (min-even parity, on transitions). The acceptance tells which priorities there are:

    - `"cosafe"`: state q has priority 0 if it is final, else 1, and final states are absorbing:
      the run must reach one.
    - `"safety"`: the same, and non-final states are absorbing: the run must avoid them.
    - `"buchi"`: 0 on accepting transitions, else 1.
    - `"parity"`: any.

    Args:
        delta: int32 `[Q, L]`, the state after reading letter l in state q.
        initial: int32 scalar, the state before anything is read.
        priority: int32 `[Q, L]`, of reading letter l in state q.
        letters: bool `[L, P]`, whether proposition p holds in letter l.
        propositions: `[P]` names.
        acceptance: `"cosafe"`, `"safety"`, `"buchi"` or `"parity"`.
        state_names: `[Q]` readable names, one formula per state, or empty.
    """

    delta: NDArray[np.int32]
    initial: int | NDArray[np.int32]
    priority: NDArray[np.int32]
    letters: NDArray[np.bool_]
    propositions: tuple[str, ...]
    acceptance: str
    state_names: tuple[str, ...] = ()

    @property
    def final(self) -> NDArray[np.bool_]:
        """bool `[Q]`, the final states of a co-safe or safety automaton.

        Raises:
            ValueError: For Buchi and parity acceptance, which is on transitions.
        """
        if self.acceptance not in ("cosafe", "safety"):
            raise ValueError(
                f"final: an automaton with {self.acceptance} acceptance has no final states. "
                "Read its priority[Q, L], or accepting[Q, L]."
            )
        return self.priority[..., 0] == 0

    @property
    def accepting(self) -> NDArray[np.bool_]:
        """bool `[Q, L]`, the transitions of even priority."""
        return self.priority % 2 == 0

    def __repr__(self) -> str:
        return f"Automaton({self.acceptance}, {_extent(self)})"

    def _repr_svg_(self) -> str | None:
        """The picture that notebooks show; None, so that they show text, where it would crowd."""
        arrows = sum(len(set(row)) for row in np.asarray(self.delta).tolist())
        if len(self.delta) > DRAWN_STATES or arrows > DRAWN_ARROWS:
            return None
        # By name, since the core does not depend on drawing and only a notebook gets here.
        plot = importlib.import_module("jaxltl.plot")
        return plot.to_bytes(plot.automaton(self), "svg").decode()


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
        initial: In 0..Q-1.
        letters: `[L, P]` booleans, no two rows equal.
        propositions: `[P]` distinct names.
        final: `[Q]` booleans, absorbing as `acceptance` asks.
        accepting: `[Q]` or `[Q, L]` booleans, visited infinitely often (Buchi).
        priority: `[Q]` or `[Q, L]` integers from 0 up; the least one met infinitely often is even.
        acceptance: `"cosafe"` or `"safety"` with `final`; else follows from what is given.
        state_names: `[Q]` names, or none.

    Raises:
        ValueError: Naming the table, the entry and the fix.

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
    delta: NDArray[Any],
    final: ArrayLike | None,
    accepting: ArrayLike | None,
    priority: ArrayLike | None,
    acceptance: str | None,
) -> tuple[str, NDArray[Any]]:
    """The acceptance and its priorities `[Q, L]`, from the one table that is given."""
    given = {"final": final, "accepting": accepting, "priority": priority}
    (name, *more) = [key for key, table in given.items() if table is not None] or [""]
    kinds = {"final": ("cosafe", "safety"), "accepting": ("buchi",), "priority": ("parity",)}
    if not name or more:
        raise ValueError("make_automaton: give exactly one of final, accepting and priority.")
    kind = kinds[name][0] if acceptance is None and name != "final" else acceptance
    if kind not in kinds[name]:
        raise ValueError(
            f"make_automaton: acceptance = {acceptance!r} with {name}. "
            f"Pass one of {', '.join(kinds[name])}."
        )
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
        table = 1 - _booleans(accepting, "accepting", shape).astype(np.int32)
    else:
        is_final = _booleans(final, "final", delta.shape[:1])
        absorbing = is_final if kind == "cosafe" else ~is_final
        for q, letter in np.argwhere(absorbing[:, None] & ~absorbing[delta])[:1]:
            inside = "final" if kind == "cosafe" else "non-final"
            raise ValueError(
                f"make_automaton: delta[{q}, {letter}] = {delta[q, letter]} leaves the {inside} "
                f"states, which {kind!r} acceptance has absorbing. Redirect it, or change final."
            )
        table = 1 - is_final.astype(np.int32)
    if table.ndim == 1:
        table = np.repeat(table[:, None], delta.shape[1], axis=1)
    assert kind is not None
    return kind, table


def _check_distinct(names: tuple[str, ...], rows: NDArray[np.bool_]) -> None:
    for name in names:
        if names.count(name) > 1 or not isinstance(name, str):
            raise ValueError(f"make_automaton: propositions has {name!r}. Pass distinct strings.")
    first: dict[bytes, int] = {}
    for letter, row in enumerate(rows):
        twin = first.setdefault(row.tobytes(), letter)
        if twin != letter:
            held = _letter_text(names, row)
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


# ---------------------------------------------------------------------------------------------
# Runs
# ---------------------------------------------------------------------------------------------


def letter_index(automaton: Automaton, letter: Letter) -> int:
    """The index l of a letter, so that `delta[q, l]` reads it.

    Args:
        automaton: The automaton.
        letter: The propositions that hold; names unknown to the automaton are ignored.

    Raises:
        ValueError: For a combination of propositions that is not among the letters.

    >>> from jaxltl.core.translate import to_automaton
    >>> letter_index(to_automaton("F a"), {"a", "unrelated"})
    1
    """
    return _read(automaton, [letter], "letter_index: letter")[0]


def _read(automaton: Automaton, word: Iterable[Letter], place: str) -> list[int]:
    names = automaton.propositions
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
    """The states passed while reading a finite word, from `initial` on.

    `q[0] = initial` and `q[t+1] = delta[q[t], w[t]]`.

    Args:
        automaton: The automaton.
        word: `[T]` letters, each the collection of the propositions that hold.

    Returns:
        int32 `[T+1]`.

    >>> from jaxltl.core.translate import to_automaton
    >>> run(to_automaton("F a"), [set(), {"a"}, set()]).tolist()
    [0, 0, 1, 1]
    """
    states = [int(automaton.initial)]
    for letter in _read(automaton, word, "run: letter"):
        states.append(int(automaton.delta[states[-1], letter]))
    return np.array(states, np.int32)


def accepts_lasso(automaton: Automaton, prefix: Iterable[Letter], cycle: Iterable[Letter]) -> bool:
    """Whether the automaton accepts the infinite word prefix·cycle^ω.

    Args:
        automaton: The automaton.
        prefix: `[n]` letters, may be empty.
        cycle: `[m]` letters, at least one.

    >>> from jaxltl.core.translate import to_automaton
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


# ---------------------------------------------------------------------------------------------
# Minimal and complement automata
# ---------------------------------------------------------------------------------------------


def minimize(automaton: Automaton) -> Automaton:
    """The smallest automaton whose runs read the same priorities.

    Unreachable states are dropped and equivalent ones merged, by `equivalence_classes`. Co-safe
    and safety automata of one language, over the same letters, give identical tables. A merged
    state keeps the shortest of the names.

    >>> from jaxltl.core.translate import to_automaton
    >>> minimize(to_automaton("F a & F b")).delta.shape
    (4, 4)
    """
    return quotient(automaton, equivalence_classes(automaton))


def quotient(automaton: Automaton, classes: NDArray[np.int32]) -> Automaton:
    """The automaton whose states are classes of equivalent states.

    Args:
        automaton: The automaton.
        classes: int32 `[Q]`, the class of each state, -1 to drop it (see `equivalence_classes`).
    """
    kept = np.flatnonzero(classes >= 0)
    _, first = np.unique(classes[kept], return_index=True)
    members = kept[first]  # one state of each class, in the order of the classes
    names: dict[int, str] = {}
    for q in kept if automaton.state_names else ():
        name = automaton.state_names[q]
        names[classes[q]] = min(names.get(classes[q], name), name, key=len)
    return replace(
        automaton,
        delta=classes[automaton.delta[members]],
        initial=np.asarray(classes[int(automaton.initial)], np.int32),
        priority=automaton.priority[members],
        state_names=tuple(names[c] for c in sorted(names)),
    )


def equivalence_classes(automaton: Automaton) -> NDArray[np.int32]:
    """The state of `minimize(automaton)` that each state becomes, -1 if it is unreachable.

    Two states are equivalent when every finite word reads the same priorities from both.
    The coarsest such partition is found by refinement, always queueing the smaller half of a
    split block (Hopcroft 1971, "An n log n algorithm for minimizing states in a finite
    automaton"), and numbered breadth first from the initial state.

    Returns:
        int32 `[Q]`.
    """
    reached = _breadth_first(automaton.delta, int(automaton.initial))
    position = np.full(len(automaton.delta), -1)
    position[reached] = np.arange(len(reached))
    # Letters with equal columns are one letter to Hopcroft's algorithm.
    delta = np.unique(position[automaton.delta[reached]], axis=1)
    _, output = np.unique(automaton.priority[reached], axis=0, return_inverse=True)
    blocks = _coarsest_partition(delta, output.ravel())
    order = np.full(blocks.max() + 1, -1)
    found, first = np.unique(blocks, return_index=True)  # reached is in breadth-first order
    order[found[np.argsort(first)]] = np.arange(len(found))
    classes = np.full(len(automaton.delta), -1, np.int32)
    classes[reached] = order[blocks]
    return classes


def _breadth_first(delta: NDArray[np.integer[Any]], start: int) -> list[int]:
    order = {start: None}
    queue = [start]
    for state in queue:
        for successor in dict.fromkeys(delta[state].tolist()):
            if successor not in order:
                order[successor] = None
                queue.append(successor)
    return queue


def _coarsest_partition(
    delta: NDArray[np.integer[Any]], output: NDArray[np.integer[Any]]
) -> NDArray[np.int64]:
    count, width = delta.shape
    before: list[list[list[int]]] = [[[] for _ in range(count)] for _ in range(width)]
    for q, row in enumerate(delta.tolist()):
        for letter, successor in enumerate(row):
            before[letter][successor].append(q)
    block_of = output.tolist()
    members: list[set[int]] = [set() for _ in range(max(block_of) + 1)]
    for q, block in enumerate(block_of):
        members[block].add(q)
    largest = max(range(len(members)), key=lambda block: len(members[block]))
    waiting = [block for block in range(len(members)) if block != largest]
    while waiting:
        splitter = list(members[waiting.pop()])
        for sources in before:
            hit = defaultdict(set)
            for q in splitter:
                for source in sources[q]:
                    hit[block_of[source]].add(source)
            for block, inside in hit.items():
                whole = members[block]
                if len(inside) == len(whole):
                    continue
                # The smaller half gets the new number, so that a state is renumbered O(log Q)
                # times; the larger half stays in `waiting` if the block was there.
                smaller = inside if 2 * len(inside) <= len(whole) else whole - inside
                whole -= smaller
                members.append(smaller)
                for q in smaller:
                    block_of[q] = len(members) - 1
                waiting.append(len(members) - 1)
    return np.array(block_of)


def complement(automaton: Automaton) -> Automaton:
    """The automaton that accepts exactly the words that `automaton` rejects.

    The run is the same. Final states become the others, which turns co-safe into safety
    acceptance; other priorities grow by one, which turns Buchi into parity.

    >>> from jaxltl.core.translate import to_automaton
    >>> complement(to_automaton("F a")).state_names
    ('!(F a)', 'false')
    """
    constants = {"true": "false", "false": "true"}
    kind = automaton.acceptance
    priority = automaton.priority + 1
    if kind in ("cosafe", "safety"):
        priority = 1 - automaton.priority
    elif automaton.priority.min() > 0:
        priority = automaton.priority - 1
    only_two = priority.max() <= 1
    return replace(
        automaton,
        priority=priority,
        acceptance={"cosafe": "safety", "safety": "cosafe"}.get(
            kind, "buchi" if only_two else "parity"
        ),
        state_names=tuple(constants.get(name, f"!({name})") for name in automaton.state_names),
    )


# ---------------------------------------------------------------------------------------------
# Readable forms
# ---------------------------------------------------------------------------------------------


def guards(automaton: Automaton) -> dict[tuple[int, int], str]:
    """A short condition on the propositions for each pair of states joined by a letter.

    A guard is true of the letters that make the transition and false of the other letters; what
    it says of combinations that are no letter is left to brevity. It is an irredundant
    disjunction of prime cubes, not always the shortest.

    >>> from jaxltl.core.translate import to_automaton
    >>> guards(to_automaton("!r U g", letters=[{}, {"r"}, {"g"}]))
    {(0, 0): '!g & !r', (0, 1): 'g', (0, 2): 'r', (1, 1): 'true', (2, 2): 'true'}
    """
    same = np.zeros_like(np.asarray(automaton.priority))
    return {(q, end): text for (q, end, _), text in _guards(automaton, same).items()}


def edge_guards(automaton: Automaton) -> dict[tuple[int, int, int], str]:
    """The condition of each (state, successor, priority) that some letter has, see `guards`.

    >>> from jaxltl.core.translate import to_automaton
    >>> edge_guards(to_automaton("G F a"))
    {(0, 0, 0): 'a', (0, 0, 1): '!a'}
    """
    return _guards(automaton, np.asarray(automaton.priority))


def _guards(automaton: Automaton, marks: NDArray[Any]) -> dict[tuple[int, int, int], str]:
    """A guard for each (state, successor, mark), with the marks `[Q, L]` of transitions."""
    literals = [proposition_text(name) for name in automaton.propositions]
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


Cube = tuple[tuple[int, bool], ...]  # (proposition, its value), by proposition


def prime_cover(chosen: set[int], others: set[int], width: int) -> list[Cube]:
    """Prime cubes, none to spare, that together hold in the chosen letters and in no other.

    Minato 1993, "Fast generation of prime-irredundant covers from binary decision diagrams", on
    sets of letters; letters that are in neither set may fall on either side.

    Args:
        chosen: Letters as numbers, with proposition p as bit p.
        others: More letters.
        width: The number of propositions.

    >>> prime_cover({0b01, 0b11}, {0b00}, 2)
    [((0, True),)]
    """
    if len(chosen) + len(others) < 1 << width:
        # Where few letters occur, a few propositions tell, and guards of others would be long.
        kept = _telling(chosen, others, width)
        chosen, others = ({n & kept for n in part} for part in (chosen, others))
    return sorted(_prime_cover(chosen, others, width))


def _telling(chosen: set[int], others: set[int], width: int) -> int:
    """Propositions, as bits, that tell all chosen letters from the others, found greedily."""
    kept = 0
    while True:
        alike: dict[int, tuple[list[int], list[int]]] = defaultdict(lambda: ([], []))
        for side, part in enumerate((chosen, others)):
            for n in part:
                alike[n & kept][side].append(n)
        mixed = [(left, right) for left, right in alike.values() if left and right]
        if not mixed:
            return kept

        def told(p: int, mixed: list[tuple[list[int], list[int]]] = mixed) -> int:
            pairs = 0
            for left, right in mixed:
                held, others_held = (sum(n >> p & 1 for n in part) for part in (left, right))
                pairs += held * (len(right) - others_held) + (len(left) - held) * others_held
            return pairs

        kept |= 1 << max(range(width), key=told)


def _prime_cover(chosen: set[int], others: set[int], width: int) -> list[Cube]:
    cubes: list[Cube] = []
    for p in reversed(range(width)):
        if not chosen or not others:
            break
        bit = 1 << p
        chosen1, others1 = ({n - bit for n in part if n & bit} for part in (chosen, others))
        chosen0, others0 = ({n for n in part if not n & bit} for part in (chosen, others))
        # A literal of proposition p is needed just where it tells the two sides apart.
        cubes0 = _prime_cover(chosen0 & others1, others0, p)
        cubes1 = _prime_cover(chosen1 & others0, others1, p)
        cubes += [(*cube, (p, False)) for cube in cubes0]
        cubes += [(*cube, (p, True)) for cube in cubes1]
        chosen = _outside(chosen0, cubes0) | _outside(chosen1, cubes1)
        others = others0 | others1
    return [*cubes, ()] if chosen else cubes


def _outside(letters: set[int], cubes: list[Cube]) -> set[int]:
    """The letters that no cube holds in."""
    for cube in cubes:
        mask = sum(1 << p for p, _ in cube)
        held = sum(1 << p for p, value in cube if value)
        letters = {n for n in letters if n & mask != held}
    return letters


def _extent(automaton: Automaton) -> str:
    counts = zip(automaton.delta.shape, ("state", "letter"), strict=True)
    sizes = ", ".join(f"{n} {name}{'' if n == 1 else 's'}" for n, name in counts)
    return f"{sizes} over {', '.join(automaton.propositions) or 'no propositions'}"


def _letter_text(names: Collection[str], row: NDArray[np.bool_]) -> str:
    return "{" + ", ".join(name for name, holds in zip(names, row, strict=True) if holds) + "}"


def _state_labels(automaton: Automaton) -> list[str]:
    names = automaton.state_names or [""] * len(automaton.delta)
    return [f"{q}: {name}" if name else f"{q}" for q, name in enumerate(names)]


def to_text(automaton: Automaton) -> str:
    """The automaton for reading: `>` marks the initial state and `*` the final ones.

    In a Buchi automaton `*` marks the accepting transitions instead, and in a parity automaton
    each transition is followed by its priority in braces.

    >>> from jaxltl.core.translate import to_automaton
    >>> print(to_text(to_automaton("F a")))
    cosafe automaton: 2 states, 2 letters over a
    >  0: F a
         !a -> 0
         a -> 1
     * 1: true
         true -> 1
    >>> print(to_text(to_automaton("G F a")))
    buchi automaton: 1 state, 2 letters over a
    >  0: G F a
         a -> 0 *
         !a -> 0
    """
    lines = [f"{automaton.acceptance} automaton: {_extent(automaton)}"]
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
    if automaton.acceptance in ("cosafe", "safety"):
        return np.asarray(automaton.final)
    return np.zeros(len(automaton.delta), bool)


def _mark(automaton: Automaton, priority: int, accepting: str) -> str:
    """What follows a transition, where acceptance is on transitions."""
    if automaton.acceptance == "parity":
        return f" {{{priority}}}"
    return accepting if automaton.acceptance == "buchi" and priority == 0 else ""


def to_dot(automaton: Automaton) -> str:
    """The automaton as a graph in the DOT language, final states double circled.

    The accepting transitions of a Buchi automaton are bold and have a dot after their condition,
    and those of a parity automaton have their priority in braces there.

    >>> from jaxltl.core.translate import to_automaton
    >>> print(to_dot(to_automaton("true")))
    digraph automaton {
      rankdir=LR;
      start [shape=point, label=""];
      start -> 0;
      0 [shape=doublecircle, label="0: true"];
      0 -> 0 [label="true"];
    }
    """
    lines = ["rankdir=LR;", 'start [shape=point, label=""];', f"start -> {automaton.initial};"]
    final = _final_states(automaton)
    for q, label in enumerate(_state_labels(automaton)):
        shape = "doublecircle" if final[q] else "circle"
        lines.append(f"{q} [shape={shape}, label={_dot_string(label)}];")
    for (q, successor, priority), text in edge_guards(automaton).items():
        label = _dot_string(text + _mark(automaton, priority, " ●"))
        bold = automaton.acceptance == "buchi" and priority == 0
        style = ', style=bold, color="#1f6f8b"' if bold else ""
        lines.append(f"{q} -> {successor} [label={label}{style}];")
    return "\n".join(["digraph automaton {", *(f"  {line}" for line in lines), "}"])


def _dot_string(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") + '"'


def to_dict(automaton: Automaton) -> dict[str, Any]:
    """The automaton as lists, numbers and strings, for JSON; `from_dict` is the inverse.

    >>> from jaxltl.core.translate import to_automaton
    >>> to_dict(to_automaton("F a"))["delta"]
    [[0, 1], [1, 1]]
    """
    table = {"buchi": "accepting", "parity": "priority"}.get(automaton.acceptance, "final")
    return {
        "delta": automaton.delta.tolist(),
        "initial": int(automaton.initial),
        table: getattr(automaton, table).tolist(),
        "letters": automaton.letters.tolist(),
        "propositions": list(automaton.propositions),
        "acceptance": automaton.acceptance,
        "state_names": list(automaton.state_names),
    }


def from_dict(tables: Mapping[str, Any]) -> Automaton:
    """The automaton that `to_dict` wrote.

    Raises:
        ValueError: For a missing or unknown entry, or tables that are no automaton.

    >>> from jaxltl.core.translate import to_automaton
    >>> from_dict(to_dict(to_automaton("F a"))).acceptance
    'cosafe'
    """
    table = {"buchi": "accepting", "parity": "priority"}.get(tables.get("acceptance", ""), "final")
    fields = set(Automaton.__dataclass_fields__) - {"priority"} | {table}
    if set(tables) != fields:
        wrong = ", ".join(sorted(map(str, set(tables) ^ fields)))
        raise ValueError(
            f"from_dict: missing or unknown entries: {wrong}. Pass what to_dict returned."
        )
    return make_automaton(**tables)
