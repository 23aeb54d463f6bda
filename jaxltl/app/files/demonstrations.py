"""Demonstrations of task files: read from JSON, or simulated."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeGuard

import jax
import numpy as np

from jaxltl.core.validation import errors_in
from jaxltl.app.files.schema import off_map, read_bytes
from jaxltl.app.files.task import SyntheticTable
from jaxltl.app.files.task_mlirl import MlirlFile
from jaxltl.app.files.worlds import MappedModel
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models.construct.counts import listed
from jaxltl.core.models import Product, Trajectories, make_trajectories, project_trajectories
from jaxltl.core.types import Solution

_STEP_BYTES = 128  # of a simulated step, measured while demonstrations are made and checked
_LARGEST_BYTES = 4e9


def load_demonstrations(task: MlirlFile, world: MappedModel) -> Trajectories:
    """The demonstrations of a task's file; see :func:`read_demonstrations`."""
    assert task.demonstrations.file is not None
    return read_demonstrations(task.path.parent / task.demonstrations.file, world)


def read_demonstrations(path: Path, world: MappedModel) -> Trajectories:
    """Demonstrations of a JSON file, ``{"demonstrations": [...]}``.

    Each is an object with ``"cells"``, ``[row, column]`` counted from 1 at the top left (or
    ``"states"``, numbers from 0), and ``"actions"``, names or numbers from 0, one per cell; a final
    cell may have no action. In the world of a log, states and actions have the names of the log.
    """
    try:
        data = json.loads(read_bytes(path, "the demonstrations"))
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


def _read_demonstration(one: Any, world: MappedModel) -> list[tuple[int, int]]:
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


def _check_steps(states: list[int], actions: list[int], world: MappedModel) -> None:
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
    read: Callable[[object, MappedModel], int], values: list[object], world: MappedModel
) -> list[int]:
    numbers = []
    for step, value in enumerate(values, start=1):
        with errors_in(f", step {step}: "):
            numbers.append(read(value, world))
    return numbers


def _is_int(value: object) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool)


def _read_cell(value: object, world: MappedModel) -> int:
    if world.shape is None:
        raise ValueError('the model has no map, so give "states" instead of "cells".')
    if not (isinstance(value, list) and len(value) == 2 and all(map(_is_int, value))):
        raise ValueError(f"the cell is {value!r}; it must be [row, column].")
    row, column = value
    rows, columns = world.shape
    if not (1 <= row <= rows and 1 <= column <= columns):
        raise ValueError(f"the cell [{row}, {column}] is {off_map(world.shape)}")
    return (row - 1) * columns + column - 1


def _read_state(value: object, world: MappedModel) -> int:
    if world.logged is not None:
        return _read_name("state", value, world.logged.states)
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


def _read_action(value: object, world: MappedModel) -> int:
    if world.logged is not None:
        return _read_name("action", value, world.actions)
    if value in world.actions:
        return world.actions.index(value)
    if _is_int(value) and 0 <= value < len(world.actions):
        return int(value)
    raise ValueError(
        f"the action {value!r} is unknown; the actions are {', '.join(world.actions)}."
    )


# --- simulated ------------------------------------------------------------------------------


def synthetic_demonstrations(
    key: jax.Array, path: Path, table: SyntheticTable, model: Product, best: Solution
) -> tuple[Trajectories, int]:
    """Rollouts of the quickest optimal policy, in the world.

    With a discount, the policy maximises the discounted reward of a co-safe formula. Rollouts of a
    co-safe formula end where it is satisfied, and are dropped if they need no step or too many;
    others have the given length, and are dropped if they violate the formula.
    """
    # Import here: tasks with a file of demonstrations compile no rollout.
    from jaxltl.core.models.trajectories import rollout

    number, length = table.synthetic or 0, table.length or 200
    if (size := number * (length + 1) * _STEP_BYTES) > _LARGEST_BYTES:
        raise ValueError(
            f"{path}: [demonstrations] synthetic = {number} rollouts of up to {length} steps would "
            f"take about {size / 1e9:.3g} GB; ask for fewer or shorter ones, at most "
            f"{_LARGEST_BYTES / 1e9:g} GB."
        )
    ends = model.automaton.is_cosafe
    stop = model.final if ends else jax.numpy.asarray(np.asarray(best.upper) <= 0)
    # One more step than the length separates arrival at the last step from no arrival.
    runs = rollout(
        model,
        _demonstrator(path, table, model, best),
        key,
        num_trajectories=number,
        num_steps=length + 1,
        stop=stop,
    )
    runs = project_trajectories(model, runs)
    states, actions, lengths = (np.asarray(x) for x in (runs.state, runs.action, runs.length))
    satisfying = [
        list(zip(x[: min(n, length)].tolist(), u[: min(n, length)].tolist(), strict=True))
        for x, u, n in zip(states, actions, lengths, strict=True)
        if (0 < n <= length if ends else n > length)
    ]
    if not satisfying:
        raise ValueError(
            f"{path}: [demonstrations] none of {number} synthetic rollouts satisfies the formula "
            f"within {length} steps; raise length or discount, or check that it can be satisfied."
        )
    return make_trajectories(model.mdp, satisfying), number - len(satisfying)


def _demonstrator(path: Path, table: SyntheticTable, model: Product, best: Solution) -> jax.Array:
    if table.discount is None:
        return best.policy
    require_cosafe(path, table, model.automaton)
    from jaxltl.core.models.ops.operators import expectation
    from jaxltl.core.values.discounted.discounted import optimal_value

    arriving = expectation(model, model.final.astype(model.dtype))
    reward = jax.numpy.where(model.final[..., None], 0, arriving)
    return optimal_value(model, reward, table.discount).policy


def require_cosafe(path: Path, table: SyntheticTable, automaton: Automaton) -> None:
    """Raises ValueError for a discount of the demonstrator if the formula is not co-safe."""
    if table.discount is not None and not automaton.is_cosafe:
        raise ValueError(
            f"{path}: [demonstrations] discount is that of the reward for satisfying the formula, "
            "which takes a co-safe formula; leave it out for rollouts of the quickest optimal policy."
        )
