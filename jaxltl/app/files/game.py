"""Game files: a game and what the system is to achieve in it. Reading and checking them.

A game file is TOML with the tables ``[game]`` and ``[task]``, and ``[strategy]`` where one is
demanded; ``examples/robots.toml`` and ``examples/patrol.toml`` show the keys. Files that it names
are looked up beside it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxltl.app.files import tables
from jaxltl.app.files.models import read_padded
from jaxltl.app.files.tables import COUNT, TEXT, TRUTH, Rule, choice, is_list, number_in
from jaxltl.app.files.task import initial_where
from jaxltl.core.games.objective import GR1, Parity, gr1, safety
from jaxltl.core.games.permissive import METHODS
from jaxltl.core.games.winning import task_game
from jaxltl.core.models.game import Game, make_game
from jaxltl.core.models.product import Product
from jaxltl.envs.robots import ACTIONS, grid_game, places
from jaxltl.envs.text_map import parse_map


@dataclass(frozen=True)
class GameFile:
    """A checked game file.

    Attributes:
      path: the file; `name` is its stem, unless the file gives one.
      game, task, strategy: the tables' keys and values, all known and of the right kind;
        keys that were left out are absent.
      demanded: whether the file has a table ``[strategy]``.
    """

    path: Path
    name: str
    game: Mapping[str, Any]
    task: Mapping[str, Any]
    strategy: Mapping[str, Any]
    demanded: bool


@dataclass(frozen=True)
class World:
    """A game, with its map if it has one.

    Attributes:
      game: the game, with successor lists.
      actions: A names.
      text: the map; None for a game from arrays.
      wall: the kind of cell that is not a place.
      places: ``int[C, 2]``, row and column of each place from 0; None without a map.
      objective: what the game's own file asks for, a parity condition; None if it does not.
    """

    game: Game
    actions: tuple[str, ...]
    text: str | None = None
    wall: str = "#"
    places: np.ndarray | None = None
    objective: Parity | None = None

    def where(self, state: int) -> dict[str, Any]:
        """A state for people: both robots' rows and columns from 1, else its number from 0."""
        if self.places is None:
            return {"state": int(state)}
        count = len(self.places)
        environment, system, _ = np.unravel_index(int(state), (count, count, 2))
        return {
            name: {"row": int(row) + 1, "column": int(column) + 1}
            for name, (row, column) in (
                ("system", self.places[system]),
                ("environment", self.places[environment]),
            )
        }

    def describe(self, state: int) -> str:
        """:meth:`where` as a text."""
        where = self.where(state)
        if self.places is None:
            return f"state {where['state']}"
        return ", ".join(
            f"{name} in row {cell['row']}, column {cell['column']}" for name, cell in where.items()
        )


_START = Rule(
    lambda v: (isinstance(v, str) and bool(v.strip())) or (is_list(v, int) and len(v) == 2),
    "a Boolean formula over the map's propositions, or a cell as [row, column], from 1",
)
_FORMULAS = Rule(
    lambda v: is_list(v, str) and bool(v), 'a list of Boolean formulas, such as ["a", "b & !c"]'
)
_KEYS: dict[str, dict[str, Rule]] = {
    "game": {
        "map": tables.MAP,
        "legend": tables.LEGEND,
        "wall": TEXT,
        "slip": number_in(0, 1),
        "system_start": _START,
        "environment_start": _START,
        "system_stays": TRUTH,
        "environment_stays": TRUTH,
        "model": TEXT,
        "initial": TEXT,
    },
    "task": {
        "formula": TEXT,
        "assumptions": _FORMULAS,
        "guarantees": _FORMULAS,
        "safe": TEXT,
        "parity": choice("model"),
        "chance": choice("random", "adversarial"),
    },
    "strategy": {"method": choice(*METHODS), "bound": COUNT},
}


def read_game(path: str | Path) -> GameFile:
    """Reads a game file.

    Raises:
      ValueError: the file is missing or malformed, or a key is unknown, missing or wrong.
        The message names the file, the place and the fix.
    """
    path = Path(path)
    data, _ = tables.read_tables(path, "the game file", _KEYS, {"": ("game", "task")})
    game = data["game"]
    tables.check_source(path, "game", game, [k for k in game if k not in ("model", "initial")])
    if "map" in game:
        tables.refuse(
            path,
            "game",
            game,
            ("initial",),
            ("a model; on a map give system_start and environment_start"),
        )
    _check_task(path, data["task"])
    return GameFile(
        path=path,
        name=data.get("name", path.stem),
        game=game,
        task=data["task"],
        strategy=data.get("strategy", {}),
        demanded="strategy" in data,
    )


def _check_task(path: Path, task: Mapping[str, Any]) -> None:
    lists = [k for k in ("assumptions", "guarantees", "safe") if k in task]
    tables.reject(
        path,
        "task",
        (
            (
                "formula" in task and bool(lists),
                f"has both formula and {''.join(lists[:1])}; give either a formula, or guarantees with "
                "assumptions and safe where needed",
            ),
            (
                "parity" in task and ("formula" in task or bool(lists)),
                'has parity = "model", the condition in the file of a parity game, and another one; keep '
                "one of them",
            ),
            (
                not {"formula", "guarantees", "safe", "parity"} & set(task),
                'lacks what the system is to achieve: formula = "...", or guarantees = ["..."], each to '
                'be met again and again, or safe = "...", to hold for ever, or parity = "model", of a '
                "parity game from a file",
            ),
            (
                "assumptions" in task and "guarantees" not in task,
                "has assumptions but no guarantees, so that they assume in vain; add guarantees or leave "
                "them out",
            ),
        ),
    )


def load_game(file: GameFile) -> World:
    """The game that a game file describes.

    Raises:
      ValueError: a malformed map or model. The message names the file and the place.
    """
    spec = dict(file.game)
    with tables.errors_in(f"{file.path}: [game] "):
        if "model" in spec:
            return _from_arrays(file.path.parent / spec["model"], spec.get("initial"))
        text = tables.read_map(file.path, spec.pop("map"))
        wall = spec.get("wall", "#")
        for key in ("system_start", "environment_start"):
            if isinstance(spec.get(key), list):
                spec[key] = _cell(spec[key], key, parse_map(text), wall)
        game = grid_game(text, **spec)
    return World(game, ACTIONS, text, wall, places(text, wall=wall))


def _from_arrays(path: Path, initial: str | None) -> World:
    found = read_padded(path, ("system",))
    if "system" not in found.more:
        raise ValueError(
            f"{str(path)!r} is no game: it lacks the array system: for each state True where the "
            "system moves and False where the environment does."
        )
    mdp = initial_where(found.mdp, initial, path)
    with tables.errors_in(f"{str(path)!r}: "):
        game = make_game(mdp, found.more["system"])
    return World(game, found.actions, objective=found.objective)


def _cell(given: list[int], key: str, cells: np.ndarray, wall: str) -> tuple[int, int]:
    (row, column), (rows, columns) = given, cells.shape
    if not (1 <= row <= rows and 1 <= column <= columns):
        raise ValueError(f"{key} = {given} is {tables.off_map(cells.shape)}")
    if cells[row - 1, column - 1] == wall:
        raise ValueError(f"{key} = {given} is a wall of the map; start in another cell.")
    return row - 1, column - 1


def load_objective(file: GameFile, world: World) -> tuple[Game, Parity | GR1]:
    """What the system is to achieve, and the game on whose states that is written.

    Returns:
      Of a formula, the product with its automaton; else the world's own game.

    Raises:
      ValueError: a formula is malformed or mentions an unknown proposition, or one that
        must be Boolean is not.
    """
    task, game = file.task, world.game
    with tables.errors_in(f"{file.path}: [task] "):
        if "formula" in task:
            return task_game(game, task["formula"])
        if "parity" in task:
            if world.objective is None:
                raise ValueError(
                    'parity = "model" takes the file of a parity game (PGSolver, '
                    "extended HOA); this game has no condition of its own."
                )
            return game, world.objective
        safe = task.get("safe", "true")
        if "guarantees" not in task:
            return game, safety(game, safe)
        return game, gr1(game, task.get("assumptions", ()), task["guarantees"], safe=safe)


def task_text(task: Mapping[str, Any]) -> str:
    """What the system is to achieve, as one formula.

    Example:
      >>> task_text({"assumptions": ["a"], "guarantees": ["b", "c | d"], "safe": "!e"})
      'G (!e) & (G F (a) -> G F (b) & G F (c | d))'
    """
    if "formula" in task:
        return str(task["formula"])
    if "parity" in task:
        return "the parity condition of the model's file"

    def all_of(sets: list[str]) -> str:
        return " & ".join(f"G F ({x})" for x in sets)

    parts = [f"G ({task['safe']})"] if "safe" in task else []
    if "guarantees" in task:
        goals = all_of(task["guarantees"])
        if "assumptions" in task:
            goals = f"({all_of(task['assumptions'])} -> {goals})"
        parts.append(goals)
    return " & ".join(parts)


def automaton_of(game: Game) -> Any:
    """The task's automaton, if the game is a product with one."""
    return game.mdp.automaton if isinstance(game.mdp, Product) else None
