"""Parity games in the PGSolver text format.

Friedmann and Lange, "The PGSolver collection of parity game solvers" (2010). Max-even: player 0,
here the system, wins if the largest priority visited infinitely often is even.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.array_types import Integers
from jaxltl.core.games.objective import Parity
from jaxltl.core.models import Game, SparseMDP, make_game, make_sparse
from jaxltl.core.models.mdp import support
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.pretty_print import brief
from jaxltl.io.files import read_text, write_bytes

MAX_NUMBER = 2**31 - 1  # of vertices and of priorities


@brief
class ParityGame(NamedTuple):
    """Parity game: game graph and objective of the system.

    Attributes:
      game: a Game over a :class:`~jaxltl.core.models.sparse.SparseMDP`.
      objective: min-even parity objective with the fewest priorities.
    """

    game: Game
    objective: Parity


def read_pgsolver(path: str | os.PathLike[str]) -> ParityGame:
    """Parity game of a PGSolver file.

    States and choices are the vertices and edges in the order of the file. The model's `valuation`
    has the vertex numbers in ``"vertex"``, max-even priorities in ``"priority"`` and, if any, names
    in ``"name"``. The initial distribution is the start vertex, or uniform without one.

    Args:
      path: the file, plain or compressed (``.gz``, ``.xz``).

    Returns:
      :class:`ParityGame`.

    Raises:
      ValueError: with file and line, for malformed text, duplicate or undefined vertices, and
        numbers beyond 2^31.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "game.pg"
      >>> _ = path.write_text('parity 2; start 0; 0 1 0 1,2 "a"; 1 2 1 0; 2 3 1 2;')
      >>> game, objective = read_pgsolver(path)
      >>> game.mdp.valuation["priority"].tolist(), objective.priority.tolist()
      ([1, 2, 3], [3, 2, 1])
    """
    return _Reader(str(path), read_text(path, "a game of PGSolver's format")).game()


def min_even(priority: Integers, neutral: NDArray[np.bool_] | None = None) -> Integers:
    """Converts max-even to min-even priorities, compressed to the fewest values."""
    decides = np.ones(priority.shape, bool) if neutral is None else ~neutral
    values = np.unique(priority[decides])[::-1]
    number = np.concatenate([values[:1] % 2, (np.diff(values) % 2 != 0).astype(np.int64)]).cumsum()
    converted = np.full(priority.shape, number[-1] if number.size else 0, np.int32)
    converted[decides] = number[::-1][np.searchsorted(values[::-1], priority[decides])]
    return converted


_SPACE = re.compile(r"(?:\s+|//[^\n]*)*")
_HEAD = re.compile(r"parity\s+([0-9]+)\s*;")
_START = re.compile(r"start\s+([0-9]+)\s*;")
_VERTEX = re.compile(
    r"([0-9]{1,18})\s+([0-9]{1,18})\s+([01])\s+([0-9]+(?:\s*,\s*[0-9]+)*)"
    r'(?:\s*"([^"]*)")?\s*;\s*'
)
_EXPECTED = (
    (re.compile(r"[0-9]+\s*"), "the number of a vertex"),
    (re.compile(r"[0-9]+\s*"), "its priority, a number of at least 0"),
    (re.compile(r"[01](?![0-9])\s*"), "its owner, 0 or 1"),
    (re.compile(r"[0-9]+\s*(?:,\s*[0-9]+\s*)*(?![\s,])"), "its successors, as in 1,2"),
    (re.compile(r'(?:"[^"]*"\s*)?(?=;)'), 'a name in double quotes, or ";"'),
)


class _Reader:
    """Parser of PGSolver text."""

    def __init__(self, name: str, text: str) -> None:
        self.name, self.text = name, text
        self.start: int | None = None
        # Of each vertex: where it is defined, its number, priority, owner, successors and name.
        self.rows: list[tuple[int, int, int, bool, str, str]] = []

    def error(self, place: int, problem: str) -> ValueError:
        line = self.text.count("\n", 0, place) + 1
        return ValueError(f"{self.name}, line {line}: {problem}")

    def game(self) -> ParityGame:
        self._statements()
        if not self.rows:
            raise self.error(
                len(self.text),
                "the game has no vertex; expected one such as '0 2 1 0,1 \"name\";'.",
            )
        place, *numbers, owner, successors, names = zip(*self.rows, strict=True)
        vertex, priority = map(np.array, numbers)
        for values, kind in ((vertex, "vertex"), (priority, "priority")):
            if values.max() > MAX_NUMBER:
                i = int(np.argmax(values > MAX_NUMBER))
                raise self.error(
                    place[i], f"{kind} {values[i]} is beyond {MAX_NUMBER}; number them from 0."
                )
        order = np.argsort(vertex, kind="stable")
        ordered = vertex[order]
        if (twice := np.flatnonzero(ordered[1:] == ordered[:-1])).size:
            first, again = order[twice[0]], order[twice[0] + 1]
            line = self.text.count("\n", 0, place[first]) + 1
            raise self.error(
                place[again],
                f"vertex {vertex[again]} is defined a second time, "
                f"first in line {line}; keep one of them.",
            )
        degree = np.array([text.count(",") + 1 for text in successors])
        try:
            target = np.array([int(x) for x in ",".join(successors).split(",")], np.int64)
        except (ValueError, OverflowError):  # thousands of digits, or beyond 2^63
            long = next(i for i, text in enumerate(successors) if re.search("[0-9]{11}", text))
            raise self.error(
                place[long], f"a successor is beyond {MAX_NUMBER}; give the number of a vertex."
            ) from None
        where = np.searchsorted(ordered, target)
        missing = (where == ordered.size) | (ordered[np.minimum(where, ordered.size - 1)] != target)
        if missing.any():
            edge = int(np.argmax(missing))
            source = int(np.searchsorted(degree.cumsum(), edge, "right"))
            raise self.error(
                place[source],
                f"vertex {vertex[source]} leads to vertex "
                f"{target[edge]}, which is not defined; define it.",
            )
        valuation = {"vertex": vertex, "priority": priority}
        if any(names):
            valuation["name"] = np.array(names, object)
        model = make_sparse(
            np.concatenate([[0], degree.cumsum()]),
            np.arange(target.size + 1),
            order[where],
            np.ones(target.size),
            initial=None if self.start is None else (vertex == self.start).astype(np.float64),
            valuation=valuation,
        )
        game = make_game(model, np.array(owner))
        return ParityGame(game, objective_of(game))

    def _statements(self) -> None:
        text = self.text
        at = self._skipped(0)
        if head := _HEAD.match(text, at):
            at = self._skipped(head.end())
        start = _START.match(text, at)
        start_place = at
        if start:
            at = self._skipped(start.end())
        while at < len(text):
            match = _VERTEX.match(text, at)
            if match is None:
                raise self._broken(at)
            number, priority, owner, successors, name = match.groups()
            row = at, int(number), int(priority), owner == "0", successors, name or ""
            self.rows.append(row)
            at = match.end()
            if text.startswith("/", at):
                at = self._skipped(at)
        if start:
            digits = start[1]
            self.start = int(digits) if len(digits) < 19 else MAX_NUMBER + 1
            if all(row[1] != self.start for row in self.rows):
                raise self.error(
                    start_place, f"the start, vertex {digits:.30}, is not defined; define it."
                )

    def _skipped(self, at: int) -> int:
        match = _SPACE.match(self.text, at)
        return at if match is None else match.end()

    def _broken(self, at: int) -> ValueError:
        """ValueError for the malformed statement at an offset."""
        text, begin = self.text, at
        if not self.rows and re.match("[a-z]", text[at]):
            return self.error(
                at,
                f"found {text[at : at + 20]!r}; expected 'parity MAX;', "
                "'start VERTEX;', or the number of a vertex.",
            )
        for pattern, expected in _EXPECTED:
            match = pattern.match(text, at)
            if match is None:
                actual = repr(text[at : at + 20]) if at < len(text) else "the end of the file"
                return self.error(at, f"found {actual}; expected {expected}.")
            at = match.end()
        return self.error(
            begin,
            f"a number of this vertex has more than 18 digits; numbers go up to {MAX_NUMBER}.",
        )


def write_pgsolver(
    path: str | os.PathLike[str], game: Game, objective: Parity | None = None
) -> None:
    """Writes a deterministic game as a PGSolver parity game.

    Games of :func:`read_pgsolver` keep their vertex numbers, priorities and names. Others are
    numbered from 0, with priorities converted to max-even. States decided by the objective become
    self-loops. The start is the initial state if there is exactly one.

    Args:
      path: the file, compressed if it ends in ``.gz`` or ``.xz``.
      game: a Game over an MDP, a DenseMDP or a SparseMDP.
      objective: the system's objective; default that of the file of the game.

    Raises:
      ValueError: for random moves, no objective, or names with a quotation mark.

    Example:
      >>> import pathlib, tempfile, jaxltl as jl
      >>> world = jl.from_dense([[[0, 1.0], [1, 0]], [[1.0, 0], [1, 0]]], initial=[1, 0])
      >>> game = jl.make_game(world, [True, False])
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "game.pg"
      >>> write_pgsolver(path, game, jl.games.parity(game, [0, 1]))
      >>> path.read_text().split("\\n")
      ['parity 1;', 'start 0;', '0 2 0 1,0;', '1 1 1 0,0;', '']
    """
    row_start, successor = edges_of(game, "write_pgsolver")
    valuation = game.mdp.valuation if isinstance(game.mdp, SparseMDP) else {}
    priority, stays = max_even(valuation, objective)
    count = row_start.size - 1
    vertex = np.asarray(valuation.get("vertex", np.arange(count)))
    names = [str(x) for x in np.asarray(valuation.get("name", np.full(count, ""))).tolist()]
    for i, name in enumerate(names):
        if '"' in name:
            raise ValueError(
                f"state {i} has the name {name!r}; the format has no way to write a "
                "quote in a name."
            )
    target = [str(x) for x in vertex[successor].tolist()]
    owner = np.where(np.asarray(game.system), "0", "1").tolist()
    lines = [f"parity {vertex.max()};"]
    initial = np.asarray(game.initial)
    if (initial > 0).sum() == 1 and count > 1:
        lines.append(f"start {vertex[np.argmax(initial)]};")
    leads = [",".join(target[a:b]) for a, b in pairwise(row_start.tolist())]
    for v, p, o, loops, to, name in zip(
        vertex.tolist(), priority.tolist(), owner, stays.tolist(), leads, names, strict=True
    ):
        quoted = f' "{name}"' if name else ""
        lines.append(f"{v} {p} {o} {v if loops else to}{quoted};")
    with write_bytes(path) as file:
        file.write("\n".join([*lines, ""]).encode())


def objective_of(game: Game) -> Parity:
    """Parity objective stored in the file of a game.

    Args:
      game: of :func:`read_pgsolver`, ``read_hoa_game`` or ``read_model``.

    Returns:
      The min-even parity objective.

    Raises:
      ValueError: the game stores no objective.

    Example:
      >>> import pathlib, tempfile
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "game.pg"
      >>> _ = path.write_text("parity 1; 0 0 0 1; 1 1 1 0;")
      >>> objective_of(read_pgsolver(path).game).priority.tolist()
      [2, 1]
    """
    valuation = game.mdp.valuation if isinstance(game.mdp, SparseMDP) else {}
    priority = min_even(max_even(valuation, None)[0])
    none = to_jax(np.zeros(priority.shape, bool))
    return Parity(to_jax(priority), none, none, int(priority.max(initial=0)) + 1)


def edges_of(game: Game, place: str) -> tuple[Integers, Integers]:
    """Row offsets ``int[S + 1]`` and successors ``int[R]`` of a deterministic game."""
    model = game.mdp
    if isinstance(model, SparseMDP):
        row_start, width = np.asarray(model.row_start), np.diff(np.asarray(model.entry_start))
        state = model.host.state
        successor = np.asarray(model.successor)[np.asarray(model.entry_start)[:-1]]
    else:
        used = support(model)
        state, action = np.nonzero(np.asarray(model.available))
        width, rank = used.sum(-1)[state, action], used.argmax(-1)[state, action]
        successor = rank
        if hasattr(model, "successor"):
            successor = np.asarray(model.successor)[state, action, rank]
        row_start = np.searchsorted(state, np.arange(game.num_states + 1))
    if (width > 1).any():
        s = state[np.argmax(width > 1)]
        raise ValueError(
            f"{place}: state {s} has a move that leads to several states; the format "
            "has no random moves. Solve the game with chance='adversarial', or make the "
            "environment choose."
        )
    return row_start, successor


def max_even(
    valuation: Mapping[str, NDArray[np.generic]], objective: Parity | None
) -> tuple[Integers, NDArray[np.bool_]]:
    """Max-even priorities of an objective, by default the valuation's, and decided states."""
    stored = valuation.get("priority")
    if objective is None:
        if stored is None:
            raise ValueError(
                "the game has no stored objective; pass one, such as buchi(game, ...)."
            )
        return np.asarray(stored), np.zeros(len(stored), bool)
    priority = np.asarray(objective.priority).ravel()
    won, lost = np.asarray(objective.won).ravel(), np.asarray(objective.lost).ravel()
    decided = won | lost
    if (
        stored is not None
        and not decided.any()
        and (min_even(np.asarray(stored)) == priority).all()
    ):
        return np.asarray(stored), decided
    largest = int(priority.max(initial=0))
    return np.where(decided, np.where(won & ~lost, 0, 1), largest + largest % 2 - priority), decided
