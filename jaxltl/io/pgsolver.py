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
from jaxltl.core.games.objective import Parity, fewest_priorities
from jaxltl.core.models import Game, SparseMDP, make_game, make_sparse
from jaxltl.core.models.construct.convert import to_sparse
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


def min_even(priority: Integers) -> Integers:
    """Converts max-even to min-even priorities, compressed to the fewest values."""
    return fewest_priorities(-priority)


_SPACE = re.compile(r"(?:\s+|//[^\n]*)*")
_HEAD = re.compile(r"(?:parity\s+[0-9]+\s*;(?:\s+|//[^\n]*)*)?(?:start\s+([0-9]+)\s*;)?")
_FIELDS = (  # of a vertex
    (re.compile(r"([0-9]+)\s*"), "the number of a vertex, after 'parity MAX;' and 'start VERTEX;'"),
    (re.compile(r"([0-9]+)\s*"), "its priority, a number of at least 0"),
    (re.compile(r"([01])(?![0-9])\s*"), "its owner, 0 or 1"),
    (re.compile(r"([0-9]+\s*(?:,\s*[0-9]+\s*)*)(?![\s,])"), "its successors, as in 1,2"),
    (re.compile(r'(?:"([^"]*)"\s*)?;'), 'a name in double quotes, or ";"'),
)


class _Vertex(NamedTuple):
    place: int  # in the text
    priority: int
    owner: str
    successors: list[int]
    name: str


class _Reader:
    """Parser of PGSolver text."""

    def __init__(self, name: str, text: str) -> None:
        self.name, self.text = name, text

    def error(self, place: int, problem: str) -> ValueError:
        return ValueError(f"{self.name}, line {self.line(place)}: {problem}")

    def line(self, place: int) -> int:
        return self.text.count("\n", 0, place) + 1

    def number(self, digits: str, kind: str, place: int) -> int:
        if len(digits) > 10 or int(digits) > MAX_NUMBER:
            raise self.error(
                place, f"{kind} {digits:.30} is beyond {MAX_NUMBER}; number them from 0."
            )
        return int(digits)

    def skipped(self, pattern: re.Pattern[str], at: int) -> int:
        match = pattern.match(self.text, at)
        return at if match is None else match.end()

    def vertices(self, at: int) -> dict[int, _Vertex]:
        """The vertices from an offset on, by number, in the order of the file."""
        table: dict[int, _Vertex] = {}
        while at < len(self.text):
            place, fields = at, []
            for pattern, expected in _FIELDS:
                match = pattern.match(self.text, at)
                if match is None:
                    rest = self.text[at : at + 20]
                    actual = repr(rest) if rest else "the end of the file"
                    raise self.error(at, f"found {actual}; expected {expected}.")
                fields.append(match[1] or "")
                at = match.end()
            number = self.number(fields[0], "vertex", place)
            if number in table:
                raise self.error(
                    place,
                    f"vertex {number} is defined a second time, first in line "
                    f"{self.line(table[number].place)}; keep one of them.",
                )
            priority = self.number(fields[1], "priority", place)
            targets = [self.number(x.strip(), "a successor:", place) for x in fields[3].split(",")]
            table[number] = _Vertex(place, priority, fields[2], targets, fields[4])
            at = self.skipped(_SPACE, at)
        if not table:
            raise self.error(
                at, "the game has no vertex; expected one such as '0 2 1 0,1 \"name\";'."
            )
        return table

    def game(self) -> ParityGame:
        begin = self.skipped(_SPACE, 0)
        head = _HEAD.match(self.text, begin)
        assert head is not None
        vertices = self.vertices(self.skipped(_SPACE, head.end()))
        start = None if head[1] is None else self.number(head[1], "the start", begin)
        if start is not None and start not in vertices:
            raise self.error(begin, f"the start, vertex {start}, is not defined; define it.")
        index = {number: i for i, number in enumerate(vertices)}
        target = []
        for number, vertex in vertices.items():
            for other in vertex.successors:
                if other not in index:
                    raise self.error(
                        vertex.place,
                        f"vertex {number} leads to vertex {other}, which is not defined; define it.",
                    )
                target.append(index[other])
        numbers = np.array(list(vertices))
        valuation = {
            "vertex": numbers,
            "priority": np.array([v.priority for v in vertices.values()]),
        }
        names = [vertex.name for vertex in vertices.values()]
        if any(names):
            valuation["name"] = np.array(names, object)
        model = make_sparse(
            np.cumsum([0, *(len(vertex.successors) for vertex in vertices.values())]),
            np.arange(len(target) + 1),
            np.array(target),
            np.ones(len(target)),
            initial=None if start is None else (numbers == start).astype(np.float64),
            valuation=valuation,
        )
        game = make_game(model, np.array([vertex.owner == "0" for vertex in vertices.values()]))
        return ParityGame(game, objective_of(game))


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
    model = to_sparse(game.mdp)
    entry_start = np.asarray(model.entry_start)
    width = np.diff(entry_start)
    if (width > 1).any():
        s = model.host.state[np.argmax(width > 1)]
        raise ValueError(
            f"{place}: state {s} has a move that leads to several states; the format "
            "has no random moves. Solve the game with chance='adversarial', or make the "
            "environment choose."
        )
    return np.asarray(model.row_start), np.asarray(model.successor)[entry_start[:-1]]


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
