"""Synthesis games in the extended HOA format of SYNTCOMP.

A deterministic automaton with `controllable-AP:` (Pérez 2019, "The extended HOA format for
synthesis"): in each step the environment chooses the inputs, then the system the outputs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.table import explore
from jaxltl.core.automata.text import prime_cover
from jaxltl.core.games.objective import Parity
from jaxltl.core.logic.diagram import FALSE, TRUE, Diagrams, prime_cubes
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import (
    Formula,
    negation_normal_form,
    parse_ltl,
    proposition_text,
    subformulas,
)
from jaxltl.core.logic.progression import encode
from jaxltl.core.models import Game, SparseMDP, make_game, make_sparse
from jaxltl.core.pretty_print import brief
from jaxltl.io.files import read_text
from jaxltl.io.hoa.header import Header, decisive_sets, edge_priority
from jaxltl.io.hoa.grammar import Edge, State, error_at
from jaxltl.io.hoa.table import (
    guarded_edges,
    label_reader,
    marks_of,
    nondeterminism,
    only_text,
    parsed,
)
from jaxltl.io.hoa.hoa import header_lines, parity_text
from jaxltl.io.pgsolver import edges_of, max_even, min_even, objective_of

MAX_MOVES = 2**22
_MAX_NODES = 2**20  # of the diagrams of all guards
_LONGEST, _LONGEST_ALL = 1000, 10**6  # paths in the diagrams of guards that are written out


@brief
class HoaGame(NamedTuple):
    """Parity game with the propositions of the environment (inputs) and the system (outputs).

    Attributes:
      game: a Game over a :class:`~jaxltl.core.models.sparse.SparseMDP`.
      objective: the parity objective.
      inputs, outputs: propositions of the environment and of the system.
    """

    game: Game
    objective: Parity
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


def read_hoa_game(source: str | os.PathLike[str]) -> HoaGame:
    """Parity game from a deterministic HOA automaton with `controllable-AP:`.

    The environment moves in the automaton's states, one copy per priority of an incoming edge.
    Inputs with the same residual guards form a class; each class leads to a state of the system,
    with the classes of outputs as moves. Action names are the conditions. The `valuation` holds in
    ``"state"`` the automaton state (-1 for the losing sink of missing edges) and in ``"priority"``
    max-even priorities. Unreachable states are removed.

    Args:
      source: a file, plain or compressed, or HOA text.

    Returns:
      :class:`HoaGame`.

    Raises:
      ValueError: with file and line, for malformed text, nondeterminism, an acceptance condition
        other than parity, a missing `controllable-AP:`, or too many classes of guards.

    Example:
      >>> text = '''HOA: v1 States: 1 Start: 0 AP: 2 "request" "grant" controllable-AP: 1
      ...   acc-name: parity max even 3 Acceptance: 3 Inf(2) | (Fin(1) & Inf(0))
      ...   --BODY-- State: 0 [0 & 1] 0 {2} [0 & !1] 0 {1} [!0] 0 {0} --END--'''
      >>> game = read_hoa_game(text)
      >>> game.inputs, game.outputs, game.game.mdp.action_names
      (('request',), ('grant',), ('!request', 'request', 'true', 'grant', '!grant'))
    """
    if isinstance(source, str) and ("\n" in source or source.lstrip()[:4] in ("HOA:", "/*")):
        place, text = "read_hoa_game", source
    else:
        place, text = str(source), read_text(source, "a game in the Hanoi format")
    try:
        return parsed(
            only_text(text),
            lambda header, states: _Reader(header, _controllable(header)).game(states),
        )
    except ValueError as error:
        raise ValueError(f"{place}: {str(error).removeprefix('read_hoa: ')}") from None


def _controllable(header: Header) -> list[int]:
    """Indices of the propositions that the system controls."""
    headers = [values for values in header.others if values[0] == "controllable-AP:"]
    if len(headers) != 1:
        raise error_at(
            headers[1][0].line if headers else header.line,
            "the header controllable-AP: is given twice. Keep one of them." if headers else
            "the header controllable-AP: is missing. Add it, with the numbers of the propositions "
            "that the system chooses.",
        )  # fmt: skip
    key, *values = headers[0]
    for value in values:
        if value.type != "INT" or int(value) >= len(header.propositions):
            raise error_at(
                key.line, f"controllable-AP: names {value}, expected numbers of propositions, "
                f"below {len(header.propositions)} (AP:)."
            )  # fmt: skip
    return sorted({int(value) for value in values})


class _TooMany(ValueError):
    """The guards exceed the limits on diagram nodes or moves."""


class _Guards(Diagrams):
    """Binary decision diagrams of guards, with inputs ordered before outputs."""

    def __init__(self, variable: list[int]) -> None:
        super().__init__()
        self.variable = variable  # of each proposition
        self.paths = [0, 1]

    def node(self, variable: int, low: int, high: int) -> int:
        if len(self.nodes) > _MAX_NODES or len(self._choices) > 4 * _MAX_NODES:
            raise _TooMany
        return super().node(variable, low, high)

    def num_paths(self, guard: int) -> int:
        """Number of paths to true, an upper bound on the length of a guard's text."""
        for _, low, high in self.nodes[len(self.paths) :]:  # children precede their parents
            self.paths.append(min(self.paths[low] + self.paths[high], 2**40))
        return self.paths[guard]

    def text(self, names: Sequence[str], guard: int, true: str) -> str:
        """A guard as a disjunction of prime cubes."""
        cubes, _ = prime_cubes(guard, guard, self)
        return _disjunction([[("" if v else "!") + names[p] for p, v in x] for x in cubes], true)

    def constant(self, value: bool) -> int:
        return TRUE if value else FALSE

    def proposition(self, number: int) -> int:
        return self.node(self.variable[number], FALSE, TRUE)

    def letter(self, number: int) -> int:
        guard = TRUE
        for p, v in sorted(enumerate(self.variable), key=lambda pair: -pair[1]):
            guard = self.node(v, *((FALSE, guard) if number >> p & 1 else (guard, FALSE)))
        return guard


class _Split:
    """Partition of the inputs (variables below `width`) into classes with equal residual guards."""

    def __init__(self, guards: Diagrams, width: int) -> None:
        self.guards, self.width, self.work = guards, width, 0
        self.known: dict[tuple[int, ...], dict[tuple[int, ...], int]] = {}

    def of(self, parts: tuple[int, ...]) -> dict[tuple[int, ...], int]:
        """Residual guards by class of inputs, each with its input condition."""
        if parts in self.known:
            return self.known[parts]
        top = min(self.guards.nodes[part][0] for part in parts)
        if top >= self.width:
            return {parts: TRUE}
        low, high = zip(*[self.guards.cofactors(part, top) for part in parts], strict=True)
        sides = self.of(low), self.of(high)
        self.work += sum(map(len, sides)) * len(parts)
        if self.work > 4 * MAX_MOVES:
            raise _TooMany
        classes = {
            rest: self.guards.node(top, sides[0].get(rest, FALSE), sides[1].get(rest, FALSE))
            for rest in {**sides[0], **sides[1]}
        }
        self.known[parts] = classes
        return classes


_Entry = tuple[int, int]  # a state, with the priority of the edge by which it is entered
_Node = tuple[int, int | tuple[int, ...]]  # an entry, or a state with residuals of its guards


class _Reader:
    """Builds the game from a parsed header and states."""

    def __init__(self, header: Header, outputs: list[int]) -> None:
        inputs = [p for p in range(len(header.propositions)) if p not in set(outputs)]
        order = inputs + outputs
        self.header = header
        self.inputs = tuple(header.propositions[p] for p in inputs)
        self.outputs = tuple(header.propositions[p] for p in outputs)
        self.names = self.inputs + self.outputs
        self.guards = _Guards([order.index(p) for p in range(len(order))])
        self.texts: dict[int, str] = {}
        self.length = 0  # total number of paths of the written guards
        sets_by_importance = decisive_sets(header.condition)
        if sets_by_importance is None:
            raise error_at(
                header.line, "the acceptance formula is no parity condition. Let the tool that "
                "wrote it turn it into one."
            )  # fmt: skip
        self.order = sets_by_importance

    def game(self, states: list[State]) -> HoaGame:
        try:
            return self._made(*self._moves(states))
        except _TooMany:
            raise error_at(
                self.header.line,
                f"the guards have too many classes, for diagrams of {_MAX_NODES} nodes and a game "
                f"of {MAX_MOVES} moves. Solve it by a symbolic tool.",
            ) from None

    def _moves(self, states: list[State]) -> tuple[list[dict[_Entry, int]], bool]:
        """Guard of each successor of each state; and True if a losing sink was appended."""
        truth = label_reader(self.header, self.guards)
        successors: list[dict[_Entry, int]] = []
        lost = (len(states), 1)
        for q, state in enumerate(states):
            taken = FALSE
            seen: list[tuple[Edge, int]] = []
            moves: dict[_Entry, int] = {}
            for edge, guard in guarded_edges(self.header, state, self.guards, truth):
                if both := self.guards.both(guard, taken):
                    other, g = next(x for x in seen if self.guards.both(x[1], both))
                    letter = self._letter(self.guards.both(g, both))
                    raise nondeterminism(self.header, q, edge, other, letter)
                taken = self.guards.either(taken, guard)
                seen.append((edge, guard))
                marks = marks_of(self.header, state, edge)
                entry = int(edge.targets[0]), edge_priority(marks, self.header.sets, *self.order)
                moves[entry] = self.guards.either(moves.get(entry, FALSE), guard)
            if taken != TRUE:
                moves[lost] = self.guards.negation(taken)
            successors.append({entry: guard for entry, guard in moves.items() if guard != FALSE})
        incomplete = any(lost in moves for moves in successors)
        return [*successors, {lost: TRUE}] if incomplete else successors, incomplete

    def _letter(self, guard: int) -> NDArray[np.bool_]:
        """A letter that satisfies a guard, by the indices of propositions."""
        held: set[int] = set()
        while guard != TRUE:
            variable, low, high = self.guards.nodes[guard]
            held |= {variable} if high != FALSE else set()
            guard = high if high != FALSE else low
        return np.array([v in held for v in self.guards.variable], bool)

    def _made(self, moves: list[dict[_Entry, int]], incomplete: bool) -> HoaGame:
        entries = sorted({entry for to in moves for entry in to})
        start = int(self.header.start), max(p for _, p in entries)
        # The first visit is one among many, so that its priority is irrelevant.
        begin: _Node = next((entry for entry in entries if entry[0] == start[0]), start)
        split, size = _Split(self.guards, len(self.inputs)), 0

        def step(node: _Node) -> list[tuple[_Node, int]]:
            nonlocal size
            q, residuals = node
            edges: list[tuple[_Node, int]]
            if isinstance(residuals, tuple):
                edges = [(x, g) for x, g in zip(moves[q], residuals, strict=True) if g != FALSE]
            else:
                classes = split.of(tuple(moves[q].values()))
                edges = [((q, rest), guard) for rest, guard in classes.items()]
            size += len(edges)
            if size > MAX_MOVES:
                raise _TooMany
            return edges

        order, rows, guards = explore(begin, step)
        state = np.array([q for q, _ in order])
        system = np.array([isinstance(x, tuple) for _, x in order])
        largest = max(x for _, x in order if isinstance(x, int))
        # The system's states have the neutral priority.
        priority = np.array([x if isinstance(x, int) else largest for _, x in order])
        texts = [self._text(guard) for guard in np.concatenate(guards).tolist()]
        number = {text: i for i, text in enumerate(dict.fromkeys(texts))}
        model = make_sparse(
            np.cumsum([0, *map(len, rows)]),
            np.arange(len(texts) + 1),
            np.concatenate(rows),
            np.ones(len(texts)),
            initial=np.arange(len(order)) == 0,
            action=np.array([number[text] for text in texts]),
            action_names=tuple(number),
            valuation={
                "state": np.where(incomplete & (state == len(moves) - 1), -1, state),
                "priority": largest + largest % 2 - priority,
            },
        )
        game = make_game(model, system)
        return HoaGame(game, objective_of(game), self.inputs, self.outputs)

    def _text(self, guard: int) -> str:
        """Formula of a guard; a long one is abbreviated to ``condition`` and a number."""
        if guard in self.texts:
            return self.texts[guard]
        self.length += (length := self.guards.num_paths(guard))
        if length > _LONGEST or self.length > _LONGEST_ALL:
            self.texts[guard] = f"condition {len(self.texts)}"
            self.length -= length
        else:
            names = [proposition_text(name) for name in self.names]
            self.texts[guard] = self.guards.text(names, guard, "true")
        return self.texts[guard]


def _disjunction(cubes: Sequence[Sequence[str]], true: str) -> str:
    texts = [" & ".join(cube) for cube in cubes]
    if len(texts) > 1:
        texts = [f"({text})" if " & " in text else text for text in texts]
    return " | ".join(texts) or true


def write_hoa_game(
    game: Game,
    objective: Parity | None = None,
    inputs: Sequence[str] = (),
    outputs: Sequence[str] = (),
    *,
    name: str = "",
) -> str:
    """Text of a deterministic game in the extended HOA format, with max-even parity acceptance.

    If the players alternate and the system's states have neutral priority, each pair of moves is an
    edge; else each game state is an automaton state, with edges over the owner's propositions.
    Action names that form a partition are the guards; otherwise moves are numbered in binary by
    ``i0, i1, ...`` (environment) and ``o0, o1, ...`` (system).

    Args:
      game: a Game over an MDP, DenseMDP or SparseMDP with one initial state.
      objective: the system's objective; default that of the file of the game.
      inputs, outputs: propositions of the environment and the system; default those of the guards.
      name: name of the automaton.

    Returns:
      HOA text.

    Raises:
      ValueError: for random moves, several initial states, over 256 priorities or no objective.

    Example:
      >>> import jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0], [1, 0]], [[1.0, 0], [1, 0]]], initial=[1, 0])
      >>> game = jl.make_game(world, [True, False])
      >>> read_hoa_game(write_hoa_game(game, jl.games.parity(game, [0, 1]))).outputs
      ('o0',)
    """
    row_start, successor = edges_of(game, "write_hoa_game")
    valuation = game.mdp.valuation if isinstance(game.mdp, SparseMDP) else {}
    priority, stays = max_even(valuation, objective)
    least = min_even(priority)
    color = int(least.max()) + int(least.max()) % 2 - least
    starts = np.flatnonzero(np.asarray(game.initial) > 0)
    if starts.size != 1:
        raise ValueError(f"write_hoa_game: the game has {starts.size} initial states, expected one;"
                         " replace its model's initial distribution.")  # fmt: skip
    system = np.asarray(game.system)
    labels = _named(game, row_start, inputs, outputs) or _numbered(row_start, system)
    arena = _Arena(row_start, successor, system, color, stays, labels.text)
    number, edges = arena.paired(int(starts[0])) or arena.plain()
    count = int(color.max()) + 1
    names = (*labels.inputs, *labels.outputs)
    lines = [
        *header_lines(name, len(edges), int(number[starts[0]]), names),
        " ".join(["controllable-AP:", *map(str, range(len(labels.inputs), len(names)))]),
        f"acc-name: parity max even {count}",
        f"Acceptance: {count} {parity_text(count, 'max')}",
        "properties: trans-labels explicit-labels trans-acc colored complete deterministic",
        "--BODY--",
    ]
    for i, leave in enumerate(edges):
        lines.append(f"State: {i}")
        lines += [f"[{label}] {target} {{{mark}}}" for label, target, mark in leave]
    return "\n".join([*lines, "--END--", ""])


_Edges = list[list[tuple[str, int, int]]]  # of each state: label, successor, colour


@dataclass(frozen=True)
class _Arena:
    """Deterministic game graph with labelled moves."""

    row_start: Integers
    successor: Integers
    system: NDArray[np.bool_]
    color: Integers
    stays: NDArray[np.bool_]
    label: list[str]

    def plain(self) -> tuple[Integers, _Edges]:
        """One automaton state per game state; returns the state numbers and the edges."""
        number = np.arange(self.system.size)
        edges: _Edges = []
        for v in number.tolist():
            moves = [("t", v)] if self.stays[v] else self._moves(v)
            edges.append([(label, w, int(self.color[v])) for label, w in moves])
        return number, edges

    def paired(self, start: int) -> tuple[Integers, _Edges] | None:
        """Merges each move of both players into one edge; None if players do not alternate."""
        source = np.repeat(self.system, np.diff(self.row_start))
        takes_turns = (source != self.system[self.successor]).all() and not self.system[start]
        system, environment = self.color[self.system], self.color[~self.system]
        if not takes_turns or self.stays.any() or system.max() > environment.min():
            return None
        number = np.full(self.system.size, -1)
        index: dict[tuple[tuple[str, int], ...], int] = {}
        edges: list[list[tuple[str, int]]] = []
        for v in np.flatnonzero(~self.system).tolist():
            moves = self._moves(v)
            number[v] = index.setdefault(tuple(moves), len(index))
            if number[v] == len(edges):
                edges.append(moves)
        return number, [
            [
                (_both(guard, label), int(number[t]), int(self.color[t]))
                for guard, w in moves for label, t in self._moves(w)
            ]
            for moves in edges
        ]  # fmt: skip

    def _moves(self, v: int) -> list[tuple[str, int]]:
        rows = slice(self.row_start[v], self.row_start[v + 1])
        return list(zip(self.label[rows], self.successor[rows].tolist(), strict=True))


def _both(left: str, right: str) -> str:
    if "t" in (left, right):
        return right if left == "t" else left
    return " & ".join(f"({x})" if "|" in x else x for x in (left, right))


@dataclass(frozen=True)
class _Labels:
    """HOA label of each move, over the indices of propositions."""

    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    text: list[str]


def _numbered(row_start: Integers, system: NDArray[np.bool_]) -> _Labels:
    """Labels that encode the moves of each state in binary."""
    count = np.diff(row_start)
    widths = [max([(int(n) - 1).bit_length() for n in np.unique(count[owned])], default=0)
              for owned in (~system, system)]  # fmt: skip
    text: list[str] = []
    for n, own in zip(count.tolist(), system.tolist(), strict=True):
        bits, shift = (n - 1).bit_length(), widths[0] if own else 0
        cubes = [[tuple((b, bool(i >> b & 1)) for b in range(bits))] for i in range(n - 1)]
        cubes.append(prime_cover(set(range(n - 1, 1 << bits)), set(range(n - 1)), bits))
        for chosen in cubes:
            literals = [[f"{'' if v else '!'}{b + shift}" for b, v in cube] for cube in chosen]
            text.append(_disjunction(literals, "t"))
    names = [tuple(f"{x}{b}" for b in range(w)) for x, w in zip("io", widths, strict=True)]
    return _Labels(names[0], names[1], text)


def _named(
    game: Game, row_start: Integers, inputs: Sequence[str], outputs: Sequence[str]
) -> _Labels | None:
    """Labels from action names that are guards; None if they are long, or no partition."""
    model = game.mdp
    if not isinstance(model, SparseMDP) or model.action is None or not model.action_names:
        return None
    try:
        formulas = [parse_ltl(text) for text in model.action_names]
    except ValueError:
        return None
    system, action = np.asarray(game.system), np.asarray(model.action)
    source = np.repeat(system, np.diff(row_start))
    sides = []
    for own, requested in ((False, inputs), (True, outputs)):
        used = [formulas[a] for a in np.unique(action[source == own])]
        occurring = dict.fromkeys(p for formula in used for p in formula.propositions)
        sides.append(tuple(dict.fromkeys([*requested, *occurring])))
    names = sides[0] + sides[1]
    if len(set(names)) < len(names):
        return None
    if not all(map(is_boolean, formulas)):
        return None
    guards = _Guards(list(range(len(names))))
    of = {Formula("ap", proposition=name): guards.proposition(i) for i, name in enumerate(names)}
    for formula in formulas:
        encode(subformulas(negation_normal_form(formula)), guards, of)
    read = [of[negation_normal_form(formula)] for formula in formulas]
    for s in range(system.size):
        taken = FALSE
        for guard in (read[a] for a in action[row_start[s] : row_start[s + 1]]):
            if guards.num_paths(guard) > _LONGEST or guards.both(taken, guard):
                return None
            taken = guards.either(taken, guard)
        if taken != TRUE:
            return None
    texts = [guards.text([str(i) for i in range(len(names))], x, "t") for x in read]
    return _Labels(sides[0], sides[1], [texts[a] for a in action])
