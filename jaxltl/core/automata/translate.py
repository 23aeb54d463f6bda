"""Translation of linear temporal logic to deterministic automata.

A syntactically co-safe or safety formula becomes the automaton of its progression. Any other is
a combination of Sigma-2 and Pi-2 formulas and limits (`normal_form`), each followed by one
tracker. Two automata are made of the trackers, and the smaller is kept and reduced (`parity`):
their synchronous product has an Emerson-Lei condition, which becomes parity (`emerson_lei`), or
they follow their formulas only where the condition needs it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from jaxltl.core import validation
from jaxltl.core.array_types import Integers
from jaxltl.core.automata.automaton import Automaton, condition_of, make_alphabet
from jaxltl.core.automata.emerson_lei import (
    Condition,
    MAX_COLORS,
    ZielonkaTree,
    polarities,
    residual,
    to_parity,
)
from jaxltl.core.automata.parity import is_weak, reduce_table
from jaxltl.core.automata.products import EVEN, ODD
from jaxltl.core.automata.runs import find_lasso, live_states, universal_states
from jaxltl.core.automata.table import ParityTable, explore, quotient, reachable
from jaxltl.core.logic.diagram import FALSE, TRUE
from jaxltl.core.logic.ltl import (
    Formula,
    Letter,
    as_formula,
    is_syntactically_cosafe,
    is_syntactically_safe,
    negation_normal_form,
)
from jaxltl.core.logic.normal_form import (
    Combination,
    LimitPart,
    combination,
    extent,
    is_pure,
    limit_parts,
)
from jaxltl.core.logic.progression import Namer, Progression
from jaxltl.core.logic.simplify import GREATEST, LEAST, negated, simplify


Alphabet: TypeAlias = tuple[NDArray[np.bool_], tuple[str, ...]]  # letters [L, P], propositions
States: TypeAlias = tuple[int, ...]  # of each tracker

_State: TypeAlias = tuple[int, int, int]  # the residual formula, the guess, the turn
_Followed: TypeAlias = tuple[
    Formula | None, tuple[Formula, ...]
]  # Sigma-2, or limits one after another
_PROVEN, _REFUTED, IDLE = -1, -2, -3
_ASLEEP = -1  # in place of a guess


class Tracker:
    """The run for one Sigma-2 formula, or for some F G f, that marks each refuted guess.

    A Sigma-2 formula holds iff from some point on its residual holds by its safety part alone,
    with every `F U M` taken as false (Esparza, Kretinsky & Sickert 2020, the master theorem). The
    tracker guesses that this point has come, follows that safety formula, and guesses again when
    it is refuted: the formula holds iff it guesses finitely often. Pi-2 formulas are negations.
    """

    def __init__(self, followed: _Followed, alphabet: Alphabet, max_nodes: int) -> None:
        self.whole, limits = followed
        # Limits are tracked round-robin: all of some G F f hold iff every turn ends.
        turns = [limit.operands[0] for limit in limits]
        formulas = turns if self.whole is None else [self.whole]
        self.progression = Progression(formulas, *alphabet, max_nodes)
        self.guesses = [self.progression.diagram_of[f] for f in turns]
        whole = TRUE if self.whole is None else self.progression.diagram_of[self.whole]
        # A co-safe formula has no safety part to guess on: it holds once nothing is left of it.
        reaches = self.whole is not None and is_pure(self.whole, GREATEST)
        safe = self.progression.restricted(lambda variable: is_pure(variable, LEAST))
        self.restrict = (lambda _: FALSE) if reaches else safe
        self.index: dict[_State, int] = {}
        self.states: list[_State] = []
        self.rows: list[tuple[list[int], list[bool]]] = []
        self.start = self._number((whole, self._guess(whole, 0), 0))

    def _guess(self, whole: int, turn: int) -> int:
        return self.guesses[turn] if self.guesses else self.restrict(whole)

    def _number(self, state: _State) -> int:
        whole, _, _ = state
        if not self.guesses and whole in (TRUE, FALSE):
            return _PROVEN if whole == TRUE else _REFUTED
        number = self.index.setdefault(state, len(self.states))
        if number == len(self.states):
            self.states.append(state)
        return number

    def awake(self, state: int, needed: bool) -> int:
        """The state with a guess if one is needed, and without one otherwise."""
        if state < 0:
            return state
        whole, guess, _ = self.states[state]
        if not needed:
            return self._number((whole, _ASLEEP, 0))
        return state if guess != _ASLEEP else self._number((whole, self._guess(whole, 0), 0))

    def row(self, state: int) -> tuple[list[int], list[bool]]:
        """For each class of letters, the next state and whether the tracker marks the step."""
        width = len(self.progression.after)
        if state < 0:
            return [state] * width, [state == _REFUTED] * width
        while len(self.rows) <= state:
            self.rows.append(self._row(self.states[len(self.rows)]))
        return self.rows[state]

    def _row(self, state: _State) -> tuple[list[int], list[bool]]:
        whole, guess, turn = state
        states, marks = [], []
        for after in self.progression.after:
            left, following = after(whole), turn
            guessed = guess if guess == _ASLEEP else after(guess)
            refuted = guessed == FALSE
            if refuted:
                following = (turn + 1) % max(len(self.guesses), 1)
                guessed = self._guess(left, following)
            marks.append(refuted and following == 0)
            states.append(self._number((left, guessed, following)))
        return states, marks


class Trackers:
    """The trackers of a combination, one for a part and its negation, and the condition on them."""

    def __init__(self, parts: Combination, alphabet: Alphabet, max_nodes: int) -> None:
        number: dict[_Followed, int] = {}
        self.condition = _condition(parts, number)
        if len(number) > MAX_COLORS:
            raise ValueError(
                f"to_automaton: the formula falls into {len(number)} parts, and at most "
                f"{MAX_COLORS} can be tracked together. Split it into formulas that are tracked "
                "side by side."
            )
        self.trackers = [Tracker(followed, alphabet, max_nodes) for followed in number]
        self.start = tuple(tracker.start for tracker in self.trackers)
        classes = np.stack([t.progression.class_of for t in self.trackers])
        # The letters that the trackers tell apart, and each letter's place among them.
        self.letters, place = np.unique(classes, axis=1, return_inverse=True)
        self.class_of = place.ravel()
        self._remaining = cache(self._residual)
        self.heard = cache(self._heard)

    def remaining(self, states: States, condition: Condition) -> tuple[Condition, int]:
        """A condition restricted to some states, and the trackers that it depends on."""
        return self._remaining(condition, tuple(min(q, 0) for q in states))

    def _residual(self, condition: Condition, status: States) -> tuple[Condition, int]:
        proven, refuted = (
            sum(1 << i for i, q in enumerate(status) if q == kind) for kind in (_PROVEN, _REFUTED)
        )
        condition = residual(condition, proven, refuted)
        inf, fin = polarities(condition)
        return condition, inf | fin

    def _heard(self, chosen: int) -> tuple[list[list[int]], NDArray[np.intp]]:
        """The letters that some trackers tell apart, and each letter's place among them."""
        letters = self.letters.copy()
        letters[[not chosen >> i & 1 for i in range(len(letters))]] = 0
        distinct, place = np.unique(letters, axis=1, return_inverse=True)
        return distinct.tolist(), place.ravel()

    def successors(self, states: States, chosen: int) -> list[tuple[States, int]]:
        """For each letter that some trackers tell apart, the next states and the marks."""
        targets, marks = [], []
        letters, _ = self.heard(chosen)
        for i, (tracker, state, classes) in enumerate(
            zip(self.trackers, states, letters, strict=True)
        ):
            following, marked = tracker.row(state)
            targets.append([following[k] for k in classes])
            marks.append([marked[k] << i for k in classes])
        every = zip(*targets, strict=True), map(sum, zip(*marks, strict=True))
        return list(zip(*every, strict=True))


def _followed(part: LimitPart) -> tuple[str, _Followed]:
    """The polarity of the marks of a part's tracker, and the formulas that it follows."""
    limits = limit_parts(part.formula) if part.kind == "limit" else ()
    often = limits[0].operator == "G" if limits else part.kind == "pi2"
    sign = negated if often else lambda f: f
    return "inf" if often else "fin", (
        None if limits else sign(part.formula),
        tuple(sign(limit) for limit in limits),
    )


def _condition(parts: Combination, number: dict[_Followed, int]) -> Condition:
    if isinstance(parts, LimitPart):
        polarity, followed = _followed(parts)
        return polarity, number.setdefault(followed, len(number))
    operator = {"&": "and", "|": "or"}[parts[0]]
    return (operator, *(_condition(part, number) for part in parts[1:]))


def track_together(run: Trackers, max_states: int) -> ParityTable:
    """A parity automaton of all trackers, whose product has an Emerson-Lei condition."""
    decided: dict[Condition, States] = {}
    every = (1 << len(run.start)) - 1

    @cache
    def canonical(states: States) -> States:
        """The state with idle trackers set aside; decided states are one state each."""
        condition, live = run.remaining(states, run.condition)
        small = tuple(
            q if q in (_PROVEN, _REFUTED) or live >> i & 1 else IDLE for i, q in enumerate(states)
        )
        return small if live else decided.setdefault(condition, small)

    def step(states: States) -> list[tuple[States, int]]:
        return [(canonical(end), colors) for end, colors in run.successors(states, every)]

    _, rows, marks = explore(canonical(run.start), step, max_states)
    delta, priority, initial, _ = to_parity(
        np.stack(rows), np.stack(marks), 0, run.condition, max_states
    )
    return ParityTable(delta, priority, initial)


# Of the trackers; the condition that remains; the leaf of its Zielonka tree.
_Node: TypeAlias = tuple[States, Condition, int]


def track_on_demand(run: Trackers, max_states: int) -> ParityTable:
    """A parity automaton of trackers.

    Trackers follow a formula only where the Zielonka tree of their condition needs its marks: a
    leaf of the tree waits for colors outside of its label, so that marks inside of it need not be
    seen. A guess may be made anew at any time, hence a tracker can sleep in these leaves. For
    limits with memory this takes a sum over the leaves, in place of the product of all trackers.
    """
    tree_of = cache(lambda condition: ZielonkaTree(condition, max_states))
    places: list[Integers] = []

    def settled(states: States, condition: Condition, live: int, leaf: int) -> _Node:
        needed = tree_of(condition).missing[leaf]
        is_kept = (
            tracker.awake(q, bool(needed >> i & 1)) if live >> i & 1 else IDLE
            for i, (tracker, q) in enumerate(zip(run.trackers, states, strict=True))
        )
        return tuple(is_kept), condition, leaf

    def entered(states: States, condition: Condition, live: int) -> _Node:
        return settled(states, condition, live, tree_of(condition).leaf_below(0))

    def step(node: _Node) -> Iterator[tuple[_Node, int]]:
        states, condition, leaf = node
        awake = tree_of(condition).missing[leaf]
        heard = sum(
            1 << i
            for i, (t, q) in enumerate(zip(run.trackers, states, strict=True))
            if q >= 0 and (awake >> i & 1 or t.whole is not None)
        )
        places.append(run.heard(heard)[1])
        for target, colors in run.successors(states, heard):
            remaining, live = run.remaining(target, condition)
            if remaining == condition:
                after, priority = tree_of(condition).step(leaf, colors & awake)
                yield settled(target, condition, live, after), priority
            else:
                yield entered(target, remaining, live), 1

    start = entered(run.start, *run.remaining(run.start, run.condition))
    _, *tables = explore(start, step, max_states)
    delta, priority = (
        np.stack([row[place] for row, place in zip(rows, places, strict=True)]) for rows in tables
    )
    return ParityTable(delta, priority, 0)


Acceptance = Literal["auto", "dfa", "buchi", "parity"]
FormulaLike = Automaton | Formula | str

GOOD_ENOUGH = 3  # states up to which no other combination is tried
WORTHWHILE = 3  # how many times as much the other combinations may track
MAX_STEPS = 200_000  # of rewriting
MAX_NODES = 600_000  # of diagrams
LEEWAY = 3  # times the states of the best automaton so far that another may have
LARGE = 200_000  # transitions of an automaton that is taken as it is
NAMED_STATES = 300


def to_automaton(
    formula: Formula | str,
    letters: Iterable[Letter] | None = None,
    max_states: int = 100_000,
    *,
    acceptance: Acceptance = "auto",
) -> Automaton:
    """A small complete deterministic automaton of a formula of linear temporal logic.

    It accepts exactly the infinite words over `letters` that satisfy the formula. For co-safe
    and safety languages it is minimal, and the verdict comes as early as the letters allow.

    Args:
      formula: a formula or its text (see `parse_ltl`).
      letters: the letters that occur, each a collection of proposition names; names that are
        not in the formula are ignored. None stands for all 2^P subsets of its propositions.
      max_states: limit of the number of states at any stage.
      acceptance: `"auto"`, the first that the language has of `"cosafe"` or `"safety"`,
        `"buchi"` (deterministic) and `"parity"`; `"dfa"` (either of the first two), `"buchi"` and
        `"parity"` require that form.

    Returns:
      An automaton over the sorted propositions of the formula. Letters are in the order of the
      binary numbers with proposition p as bit p, states in breadth-first order, and each state
      is named by its residual formula.

    Raises:
      ValueError: for a language without the requested acceptance, more than 12 propositions
        without `letters`, a letter that is no collection, or too many states.

    Example:
      >>> automaton = to_automaton("!r U g", letters=[{}, {"r"}, {"g"}])
      >>> automaton.delta.tolist(), automaton.state_names
      ([[0, 1, 2], [1, 1, 1], [2, 2, 2]], ('!r U g', 'true', 'false'))
      >>> often = to_automaton("G F a & G F b")
      >>> often.acceptance, often.accepting.astype(int).tolist()
      ('buchi', [[0, 1, 0, 1], [0, 0, 1, 1]])
    """
    validation.choice("acceptance", acceptance, ("auto", "dfa", "buchi", "parity"))
    max_states = validation.integer("max_states", max_states, least=1)
    formula = as_formula(formula)
    alphabet = make_alphabet(formula.propositions, letters, "to_automaton")
    normal = negation_normal_form(formula)
    try:
        if is_syntactically_cosafe(normal):
            automaton = _progression_automaton(normal, alphabet, "cosafe", max_states)
        elif is_syntactically_safe(normal):
            automaton = _progression_automaton(normal, alphabet, "safety", max_states)
        else:
            automaton = _general(formula, alphabet, max_states)
    except RecursionError:  # a diagram is as deep as the subformulas that a state combines
        raise ValueError(
            "to_automaton: too many subformulas are combined in one state (several hundred). "
            "Split the formula into parts that are tracked side by side."
        ) from None
    return _with_acceptance(formula, automaton, acceptance)


# --- The fragments ---------------------------------------------------------------------------


def _progression_automaton(
    formula: Formula, alphabet: NDArray[np.bool_], acceptance: str, max_states: int
) -> Automaton:
    """The minimal automaton of a co-safe or safety formula in negation normal form."""
    propositions = formula.propositions
    progression = Progression([formula], alphabet, propositions)
    states, rows, _ = explore(
        progression.diagram_of[formula],
        lambda diagram: ((after(diagram), 0) for after in progression.after),
        max_states,
    )
    delta = np.stack(rows)
    decided = _forced(delta, np.array(states) == (TRUE if acceptance == "cosafe" else FALSE))
    priority = 1 - (decided if acceptance == "cosafe" else ~decided)
    delta = delta[:, progression.class_of]
    small, base = quotient(
        ParityTable(delta, np.repeat(priority[:, None], delta.shape[1], axis=1), 0)
    )
    automaton = _automaton(small, alphabet, propositions, acceptance)
    return replace(automaton, state_names=_names(automaton, progression, [states[q] for q in base]))


def _automaton(
    table: ParityTable, alphabet: NDArray[np.bool_], propositions: tuple[str, ...], acceptance: str
) -> Automaton:
    return Automaton(
        delta=table.delta.astype(np.int32),
        initial=np.asarray(table.initial, np.int32),
        priority=table.priority.astype(np.int32),
        letters=alphabet,
        propositions=propositions,
        acceptance=acceptance,
    )


def _forced(delta: Integers, target: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The states from which every word reaches the target, bool `[Q]`."""
    while True:
        wider = target | target[delta].all(axis=1)
        if (wider == target).all():
            return target
        target = wider


def _names(
    automaton: Automaton, progression: Progression, diagrams: list[int] | None
) -> tuple[str, ...]:
    namer = Namer(progression)
    names = []
    still = (automaton.delta == np.arange(len(automaton.delta))[:, None]).all(axis=1)
    for q, priorities in enumerate(automaton.priority):
        if still[q] and (priorities % 2 == priorities[0] % 2).all():
            names.append("false" if priorities[0] % 2 else "true")
        else:
            names.append("..." if diagrams is None else namer.name(diagrams[q]))
    return tuple(names)


# --- All of the logic ------------------------------------------------------------------------


def _general(formula: Formula, alphabet: NDArray[np.bool_], max_states: int) -> Automaton:
    """The smallest automaton that the ways to combine trackers give."""
    plain = simplify(formula)
    table, letter = _smallest(_combinations(plain), (alphabet, formula.propositions), max_states)
    small, kind, _ = reduce_table(table)
    table, _ = reachable(ParityTable(small.delta[:, letter], small.priority[:, letter], 0))
    automaton = _automaton(table, alphabet, formula.propositions, kind)
    return replace(automaton, state_names=_residual_names(plain, automaton))


def _combinations(formula: Formula) -> list[tuple[Combination, int]]:
    """The different combinations of a formula, with how much they track, least first."""
    combinations: list[tuple[Combination, int]] = []
    errors = []
    for steps in (MAX_STEPS // 20, MAX_STEPS):
        for grouped, dual in product((True, False), repeat=2):
            try:
                parts = combination(formula, grouped, dual, steps)
            except ValueError as error:
                errors.append(error)
                continue
            if all(parts != other for other, _ in combinations):
                combinations.append((parts, extent(parts)))
        if combinations:
            return sorted(combinations, key=lambda entry: entry[1])
    raise errors[-1]


def _smallest(
    ways: list[tuple[Combination, int]], alphabet: Alphabet, max_states: int
) -> tuple[ParityTable, Integers]:
    """The smallest table of trackers over classes of letters, and the class of each letter."""
    best: tuple[ParityTable, Integers] | None = None
    errors, spent = [], 0
    # The way that tracks least may explode where another does not, so all start with little.
    for work, (parts, cost) in product((MAX_NODES // 30, MAX_NODES // 5, MAX_NODES), ways):
        if best is not None and (
            work > spent or cost > WORTHWHILE * ways[0][1] or _is_enough(best[0])
        ):
            break
        try:
            run = Trackers(parts, alphabet, work)
        except ValueError as error:
            errors.append(error)
            continue
        for construct in (track_on_demand, track_together):
            limit = max_states if work == MAX_NODES else min(max_states, work // 10)
            if best is not None:
                limit = min(limit, LEEWAY * len(best[0].delta) + 100)
            try:
                table, _, _ = reduce_table(construct(run, limit), thorough=False)
            except ValueError as error:
                errors.append(error)
                continue
            if best is None or _size(table) < _size(best[0]):
                best, spent = (table, run.class_of), work
            if is_weak(best[0]):
                break
    if best is None:
        raise errors[-1]
    return best


def _is_enough(table: ParityTable) -> bool:
    """True if a table is minimal, as a weak one is, or tiny, or takes too long to do again."""
    return is_weak(table) or _size(table)[0] <= GOOD_ENOUGH or table.delta.size > LARGE


def _size(table: ParityTable) -> tuple[int, int]:
    """States, a rejecting sink apart, then priorities."""
    still = (table.delta == np.arange(len(table.delta))[:, None]).all(axis=1)
    sink = still & (table.priority % 2 == 1).all(axis=1)
    return len(table.delta) - int(sink.any()), len(np.unique(table.priority))


def _residual_names(formula: Formula, automaton: Automaton) -> tuple[str, ...]:
    """The formula left after a shortest word to each state, which has the state's language."""
    progression = Progression([formula], automaton.letters, automaton.propositions)
    if len(automaton.delta) > NAMED_STATES:
        return _names(automaton, progression, None)
    diagrams = {int(automaton.initial): progression.diagram_of[formula]}
    delta = automaton.delta[:, progression.representative].tolist()
    for state in (queue := list(diagrams)):
        for after, successor in zip(progression.after, delta[state], strict=True):
            if successor not in diagrams:
                diagrams[successor] = after(diagrams[state])
                queue.append(successor)
    return _names(automaton, progression, [diagrams[q] for q in range(len(delta))])


def as_automaton(formula: FormulaLike, letters: Iterable[Letter] | None = None) -> Automaton:
    """The automaton itself, or that of a formula or its text; see `to_automaton`."""
    return formula if isinstance(formula, Automaton) else to_automaton(formula, letters)


def _undecided(automaton: Automaton) -> str:
    """Words that show why no finite prefix decides."""

    def states(final: NDArray[np.bool_]) -> Automaton:
        priority = np.repeat(np.where(final, 0, 1)[:, None], automaton.delta.shape[1], axis=1)
        return replace(automaton, priority=priority.astype(np.int32), acceptance="buchi")

    hopeful, sure = states(live_states(automaton)), states(universal_states(automaton))
    fails = find_lasso([hopeful, automaton], [(EVEN, ODD)])
    holds = find_lasso([automaton, sure], [(EVEN, ODD)])
    assert fails is not None and holds is not None
    return (
        f"  It fails on {_lasso_text(fails)}, though each prefix can still be continued well.\n"
        f"  It holds on {_lasso_text(holds)}, though each prefix can still be continued badly.\n"
    )


def _lasso_text(lasso: tuple[list[frozenset[str]], list[frozenset[str]]]) -> str:
    prefix, cycle = (" ".join("{" + ", ".join(sorted(x)) + "}" for x in part) for part in lasso)
    return f"{prefix} ({cycle})^w".strip()


def _with_acceptance(formula: Formula, automaton: Automaton, acceptance: Acceptance) -> Automaton:
    """The automaton with the requested acceptance, if the language has one."""
    if acceptance == "auto":
        return automaton
    if acceptance == "dfa":
        if automaton.has_final_states:
            return automaton
        raise ValueError(
            f"to_automaton: {formula} has no finite acceptance, because neither a finite prefix "
            "proves it wherever it holds (co-safe) nor one refutes it wherever it fails "
            f"(safety).\n{_undecided(automaton)}"
            '  Ask for acceptance="auto", or bound the formula by an event.'
        )
    if acceptance == "buchi":
        if condition_of(automaton.priority) != "buchi":
            raise ValueError(
                f"to_automaton: {formula} has no deterministic Buchi automaton: some word is "
                "accepted because certain letters stop occurring, which a deterministic run "
                'cannot foresee. Ask for acceptance="parity".'
            )
        return replace(automaton, acceptance="buchi")
    return replace(automaton, acceptance="parity")
