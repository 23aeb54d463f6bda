"""Game files: a two-player game, the objective of the system player, and the synthesis.

A game file is TOML with the tables ``[game]``, ``[task]`` and optionally ``[strategy]``; see
``examples/robots.toml`` and ``examples/patrol.toml``. Names of files are relative to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np

from jaxltl.core.validation import errors_in
from jaxltl.io.demonstrations import off_map
from jaxltl.io.padded_models import read_padded
from jaxltl.app.files.schema import (
    Count,
    File,
    Legend,
    Map,
    TomlTable,
    Text,
    Unit,
    read_map,
    Meta,
    key,
    table,
)
from jaxltl.app.files.worlds import initial_where
from jaxltl.core.games.objective import GR1, Parity, gr1, safety
from jaxltl.core.games.synthesis import PlayStep, Synthesis, synthesize
from jaxltl.core.games.winning import task_game
from jaxltl.core.models import Game, make_game
from jaxltl.envs.robots import ACTIONS, grid_game, places
from jaxltl.envs.text_map import parse_map
from jaxltl.app.wording import Record

Start = Annotated[
    Text | tuple[int, int],
    Meta("a Boolean formula over the map's propositions, or a cell as [row, column], from 1"),
]
Formulas = Annotated[list[str], Meta('a list of Boolean formulas, such as ["a", "b & !c"]', bool)]


@table
class GameTable(TomlTable):
    """``[game]``: two robots on a map, or a model file."""

    map: Map | None = key("Rows of a text map, or the file that has them; default none.")
    legend: Legend | None = key("Propositions of each kind of cell; default the kind itself.")
    wall: Text | None = key("Kind of cell that cannot be entered; default #.", '"x"')
    slip: Unit | None = key("Probability of slipping to either side; default 0.")
    system_start: Start | None = key("Initial cells of the system; default all.", "[1, 4]")
    environment_start: Start | None = key("Initial cells of the other; default all.", '"b"')
    system_stays: bool | None = key("True if the system may stay; default true.", "false")
    environment_stays: bool | None = key("True if the other may stay; default false.")
    model: Text | None = key("Model file of a game; default none.", '"game.umb"')
    constants: Text | None = key("Constants of a program (.prism); default none.", '"N=64,MAX=4"')
    initial: Text | None = key("Formula of initial states; default the model's.", '"start"')

    def __attrs_post_init__(self) -> None:
        self.require_one(("map", "model"), "a map or a model (a file)")
        if self.map is not None:
            self.refuse(
                ("initial", "constants"),
                "a model; on a map give system_start and environment_start",
            )
            return
        of_map = (key for key in self.specified() if key not in ("model", "initial", "constants"))
        self.refuse(of_map, "a map; a model has it in its arrays")


@table
class ObjectiveTable(TomlTable):
    """``[task]``: the objective of the system."""

    formula: Text | None = key("Temporal-logic formula; default none.", '"G !collision"')
    assumptions: Formulas | None = key("Assumed infinitely often (GR(1)); default none.")
    guarantees: Formulas | None = key("Required infinitely often (GR(1)); default none.")
    safe: Text | None = key("Formula that must hold always; default none.", '"!collision"')
    chance: Literal["random", "adversarial"] = key(
        "Random moves: by probability, or by the environment.", default="random"
    )

    def __attrs_post_init__(self) -> None:
        lists = [k for k in ("assumptions", "guarantees", "safe") if getattr(self, k) is not None]
        if self.formula is not None and lists:
            raise ValueError(
                f"has both formula and {lists[0]}; give either a formula, or guarantees with "
                "assumptions and safe where needed."
            )
        self.require(
            any(x is not None for x in (self.formula, self.guarantees, self.safe)),
            'lacks what the system is to achieve: formula = "...", or guarantees = ["..."], '
            'each to hold infinitely often, or safe = "...", to hold always.',
        )
        self.require(
            self.assumptions is None or self.guarantees is not None,
            "has assumptions but no guarantees, so that they have no effect; add guarantees "
            "or leave them out.",
        )


@table
class StrategyTable(TomlTable):
    """``[strategy]``: how a permissive strategy is computed."""

    method: Literal["auto", "stay", "rank", "counter", "parity"] = key(
        "Method of permissive strategies.", default="auto"
    )
    bound: Count | None = key("Bound of counter (required) and parity; default none.", "6")


@table
class GameFile(File):
    """A checked game file."""

    KIND: ClassVar[str] = "the game file"
    game: GameTable = key("The game.")
    task: ObjectiveTable = key("The objective of the system.")
    strategy: StrategyTable | None = key("Demands a strategy.")


@dataclass(frozen=True)
class MappedGame:
    """A game, with its map if it has one."""

    game: Game  # the game, with successor lists
    actions: tuple[str, ...]  # A names
    text: str | None = None  # the map; None for a game from a model file
    # the kind of cell that cannot be entered
    wall: str = "#"
    # int[C, 2], row and column of each other cell from 0; None without a map
    places: np.ndarray | None = None

    def position(self, state: int) -> Record:
        """Both robots' rows and columns from 1, or the state's number from 0."""
        if self.places is None:
            return {"state": int(state)}
        return {
            name: {"row": int(row) + 1, "column": int(column) + 1}
            for name, (row, column) in zip(
                ("system", "environment"), self.places[list(self.robots(state))], strict=True
            )
        }

    def robots(self, state: int) -> tuple[int, int]:
        """The places of the system and of the environment in a state of a map."""
        assert self.places is not None
        count = len(self.places)
        environment, system, _ = np.unravel_index(int(state), (count, count, 2))
        return int(system), int(environment)

    def describe(self, state: int) -> str:
        where = self.position(state)
        if self.places is None:
            return f"state {where['state']}"
        return ", ".join(
            f"{name} in row {cell['row']}, column {cell['column']}" for name, cell in where.items()
        )


def load_game(file: GameFile) -> MappedGame:
    """The game that a game file describes."""
    table = file.game
    with errors_in(f"{file.path}: [game] "):
        if table.model is not None:
            return _from_model(file.path.parent / table.model, table)
        assert table.map is not None
        text, wall = read_map(file.path, table.map), table.wall or "#"
        options = {key: value for key, value in table.specified().items() if key != "map"}
        for key in ("system_start", "environment_start"):
            if isinstance(options.get(key), tuple):
                options[key] = _cell(options[key], key, parse_map(text), wall)
        game = grid_game(text, **options)
    return MappedGame(game, ACTIONS, text, wall, places(text, wall=wall))


def _from_model(path: Path, table: GameTable) -> MappedGame:
    loaded = read_padded(path, ("system",), table.constants)
    if "system" not in loaded.more:
        raise ValueError(
            f"{str(path)!r} is no game: it lacks the array system: for each state True where the "
            "system moves and False where the environment does."
        )
    mdp = initial_where(loaded.mdp, table.initial, path)
    with errors_in(f"{str(path)!r}: "):
        game = make_game(mdp, loaded.more["system"])
    return MappedGame(game, loaded.actions)


def _cell(cell: tuple[int, int], key: str, cells: np.ndarray, wall: str) -> tuple[int, int]:
    (row, column), (rows, columns) = cell, cells.shape
    if not (1 <= row <= rows and 1 <= column <= columns):
        raise ValueError(f"{key} = {list(cell)} is {off_map(cells.shape)}")
    if cells[row - 1, column - 1] == wall:
        raise ValueError(f"{key} = {list(cell)} is a wall of the map; start in another cell.")
    return row - 1, column - 1


def load_objective(file: GameFile, world: MappedGame) -> tuple[Game, Parity | GR1]:
    """Objective, and the game with the states on which it is defined."""
    task, game = file.task, world.game
    with errors_in(f"{file.path}: [task] "):
        if task.formula is not None:
            return task_game(game, task.formula)
        safe = task.safe or "true"
        if task.guarantees is None:
            return game, safety(game, safe)
        return game, gr1(game, task.assumptions or (), task.guarantees, safe=safe)


def task_text(task: ObjectiveTable) -> str:
    """The objective as one formula.

    Example:
      >>> task_text(ObjectiveTable(assumptions=["a"], guarantees=["b", "c | d"], safe="!e"))
      'G (!e) & (G F (a) -> G F (b) & G F (c | d))'
    """
    if task.formula is not None:
        return task.formula

    def recurrence(formulas: list[str]) -> str:
        return " & ".join(f"G F ({x})" for x in formulas)

    parts = [] if task.safe is None else [f"G ({task.safe})"]
    if task.guarantees is not None:
        goals = recurrence(task.guarantees)
        if task.assumptions is not None:
            goals = f"({recurrence(task.assumptions)} -> {goals})"
        parts.append(goals)
    return " & ".join(parts)


@dataclass(frozen=True)
class SolvedGame(Synthesis):
    """A solved game, with its file."""

    file: GameFile
    world: MappedGame

    def position(self, step: PlayStep) -> Record:
        """The place of a step of a play."""
        return self.world.position(self.nodes.world_state[step.node])

    def demand(self) -> None:
        """Raises ValueError if the file demands a strategy and the task is unrealizable."""
        if self.file.strategy and self.strategy is None:
            where = self.world.describe(int(self.starts[0]))
            raise ValueError(
                f"{self.file.path}: [strategy] demands a strategy, but the task is unrealizable: the "
                f"environment wins from every initial state, for example: {where}. Weaken the task, "
                "assume something of the environment, or leave [strategy] out."
            )


def solve_game(file: GameFile, progress: Callable[[str], None] = lambda stage: None) -> SolvedGame:
    """Solves the game of a file."""
    progress("reading")
    world = load_game(file)
    game, objective = load_objective(file, world)
    table = file.strategy or StrategyTable(bound=None)
    with errors_in(f"{file.path}: [strategy] "):
        solved = synthesize(
            game,
            objective,
            chance=file.task.chance,
            actions=world.actions,
            progress=progress,
            **table.specified(),
        )
    return SolvedGame(**vars(solved), file=file, world=world)
