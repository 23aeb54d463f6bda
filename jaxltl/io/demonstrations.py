"""Demonstrations in JSON, in a world whose cells, states and actions have names.

Example: one demonstration on a map.
  >>> import json, pathlib, tempfile, jaxltl as jl
  >>> from jaxltl.envs.gridworld import ACTIONS
  >>> path = pathlib.Path(tempfile.mkdtemp()) / "shown.json"
  >>> shown = {"cells": [[1, 1], [1, 2]], "actions": ["right"]}
  >>> _ = path.write_text(json.dumps({"demonstrations": [shown]}))
  >>> world = named_map("s g", ACTIONS)
  >>> read_demonstrations(path, world).state.tolist(), world.position_text(1)
  ([[0]], 'row 1, column 2')
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from jaxltl.core.array_types import PyTree
from jaxltl.core.models import MDP, Trajectories, make_trajectories
from jaxltl.core.models.construct.counts import listed
from jaxltl.core.validation import errors_in
from jaxltl.envs.gridworld import gridworld
from jaxltl.envs.text_map import parse_map


@dataclass(frozen=True)
class NamedWorld:
    """A model with the names that files use for its states and actions.

    Attributes:
      mdp: the model.
      cells: ``str[rows, columns]`` of a map, or None.
      actions: names of the A actions.
      states: names of the S states, or None for numbers from 0.
    """

    mdp: MDP
    cells: np.ndarray | None
    actions: tuple[str, ...]
    states: tuple[str, ...] | None = None

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Rows and columns of the map, if there is one."""
        return None if self.cells is None else self.cells.shape

    def position(self, state: int) -> dict[str, PyTree]:
        """A state's number from 0 and, on a map, its row and column from 1; of a log, its name."""
        position = state_position(state, self.shape)
        return position if self.states is None else {**position, "name": self.states[state]}

    def position_text(self, state: int) -> str:
        """The text of a state's position."""
        return position_text(self.position(state))


def named_map(text: str, actions: Sequence[str], **options: PyTree) -> NamedWorld:
    """The :class:`NamedWorld` of a text map.

    Args:
      text: the map.
      actions: names of its actions.
      **options: of :func:`~jaxltl.gridworld`.

    Returns:
      The world with its map.
    """
    return NamedWorld(gridworld(text, **options), parse_map(text), tuple(actions))


def state_position(state: int, shape: Sequence[int] | None) -> dict[str, PyTree]:
    """A state's number from 0 and, on a map of a shape, its row and column from 1."""
    if shape is None:
        return {"state": int(state)}
    row, column = divmod(int(state), shape[1])
    return {"state": int(state), "row": row + 1, "column": column + 1}


def position_text(where: Mapping[str, Any]) -> str:
    """Text of a position: row and column on a map, else the state's name or number."""
    if "row" in where:
        return f"row {where['row']}, column {where['column']}"
    return f"state {where.get('name', where['state'])}"


def off_map(shape: Sequence[int]) -> str:
    """End of an error about a cell that is not on a map."""
    return f"off the map, which has rows 1 to {shape[0]} and columns 1 to {shape[1]}."


def read_demonstrations(path: str | Path, world: NamedWorld) -> Trajectories:
    """Demonstrations of a JSON file, ``{"demonstrations": [...]}``.

    Each is an object with ``"cells"``, ``[row, column]`` counted from 1 at the top left (or
    ``"states"``, numbers from 0), and ``"actions"``, names or numbers from 0, one per cell; a final
    cell may have no action. In a world whose states have names, states and actions are named.

    Args:
      path: the file.
      world: the world in which they were made.

    Returns:
      Trajectories in the world.

    Raises:
      ValueError: a file that cannot be read, or a step that is impossible in the world.
    """
    path = Path(path)
    try:
        data = json.loads(path.read_bytes())
    except OSError as error:
        raise ValueError(
            f"the demonstrations cannot be read: {str(path)!r}: {error.strerror}."
        ) from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: this is not JSON: {error}") from None
    demonstrations = data.get("demonstrations") if isinstance(data, dict) else None
    if not isinstance(demonstrations, list) or not demonstrations:
        raise ValueError(
            f'{path}: expected {{"demonstrations": [...]}} with at least one demonstration.'
        )
    sequences = []
    for number, one in enumerate(demonstrations, start=1):
        with errors_in(f"{path}: demonstration {number}"):
            sequences.append(_read_demonstration(one, world))
    return make_trajectories(world.mdp, sequences)


def _read_demonstration(one: Any, world: NamedWorld) -> list[tuple[int, int]]:
    keys = set(one) if isinstance(one, dict) else set()
    if keys not in ({"cells", "actions"}, {"states", "actions"}):
        content = f"it has {', '.join(map(repr, sorted(keys)))}" if keys else f"got {one!r:.60}"
        raise ValueError(
            f': expected {{"cells": [[row, column], ...], "actions": [...]}}, or "states" in place '
            f'of "cells"; {content}.'
        )
    kind = "cells" if "cells" in keys else "states"
    places, names = one[kind], one["actions"]
    if not isinstance(places, list) or not isinstance(names, list) or not names:
        raise ValueError(f": {kind} and actions must be lists, with at least one action.")
    if len(places) - len(names) not in (0, 1):
        raise ValueError(
            f": {len(places)} {kind} and {len(names)} actions; give one action for each of the "
            f"{kind}, except perhaps the last."
        )
    read = _read_cell if kind == "cells" else _read_state
    states, actions = _each_step(read, places, world), _each_step(_read_action, names, world)
    _check_steps(states, actions, world)
    return list(zip(states, actions, strict=False))


def _check_steps(states: list[int], actions: list[int], world: NamedWorld) -> None:
    """Raises ValueError for an unavailable action, or a successor of probability 0."""
    available = np.asarray(world.mdp.available)
    successor, probability = np.asarray(world.mdp.successor), np.asarray(world.mdp.probability)
    for t, (s, a) in enumerate(zip(states, actions, strict=False)):
        step = f", step {t + 1}: {world.actions[a]!r} in {world.position_text(s)}"
        if not available[s, a]:
            options = ", ".join(np.array(world.actions)[available[s]])
            raise ValueError(f"{step} is not available there; available are {options}.")
        reached = np.unique(successor[s, a][probability[s, a] > 0])
        if t + 1 < len(states) and states[t + 1] not in reached:
            options = " or ".join(world.position_text(r) for r in reached)
            raise ValueError(
                f"{step} cannot lead to {world.position_text(states[t + 1])}, which comes next; it "
                f"leads to {options}."
            )


def _each_step(
    read: Callable[[object, NamedWorld], int], values: list[object], world: NamedWorld
) -> list[int]:
    numbers = []
    for step, value in enumerate(values, start=1):
        with errors_in(f", step {step}: "):
            numbers.append(read(value, world))
    return numbers


def _is_int(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _read_cell(value: object, world: NamedWorld) -> int:
    if world.shape is None:
        raise ValueError('the model has no map, so give "states" instead of "cells".')
    if not (isinstance(value, list) and len(value) == 2 and all(map(_is_int, value))):
        raise ValueError(f"the cell is {value!r}; it must be [row, column].")
    row, column = value
    rows, columns = world.shape
    if not (1 <= row <= rows and 1 <= column <= columns):
        raise ValueError(f"the cell [{row}, {column}] is {off_map(world.shape)}")
    return (row - 1) * columns + column - 1


def _read_state(value: object, world: NamedWorld) -> int:
    if world.states is not None:
        return _read_name("state", value, world.states)
    last = world.mdp.num_states - 1
    if not _is_int(value) or not 0 <= value <= last:
        raise ValueError(f"the state is {value!r}; states are 0 to {last}.")
    return int(value)


def _read_name(kind: str, value: object, names: tuple[str, ...]) -> int:
    """The index of a name of a log; a name that is a number may be given as one."""
    name = str(value) if _is_int(value) else value
    if name in names:
        return names.index(name)
    raise ValueError(f"the {kind} {value!r} is not in the log, which has {listed(names)}.")


def _read_action(value: object, world: NamedWorld) -> int:
    if world.states is not None:
        return _read_name("action", value, world.actions)
    if value in world.actions:
        return world.actions.index(value)
    if _is_int(value) and 0 <= value < len(world.actions):
        return int(value)
    raise ValueError(
        f"the action {value!r} is unknown; the actions are {', '.join(world.actions)}."
    )
