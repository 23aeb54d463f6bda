"""Worlds of task files, from maps, models or logs, and their demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common.demonstrations import sample_demonstrations
from jaxltl.app.files.schema import read_map
from jaxltl.app.files.task import GridTable, SyntheticTable
from jaxltl.app.files.task_irl import MlirlFile, ModelTable
from jaxltl.app.wording import Record
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.models import Product, Trajectories
from jaxltl.core.models.mdp import MDP
from jaxltl.core.types import Solution
from jaxltl.core.validation import errors_in
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.envs.text_map import parse_map
from jaxltl.io.demonstrations import NamedWorld, read_demonstrations

if TYPE_CHECKING:
    from jaxltl.app.certify import Logged


@dataclass(frozen=True)
class MappedModel(NamedWorld):
    """A world of a task file."""

    logged: Logged | None = None  # the log that the model was estimated from, or None


def grid_options(table: GridTable) -> Record:
    """The arguments of :func:`~jaxltl.envs.gridworld.gridworld` that a table gives."""
    names = ("legend", "wall", "slip", "absorbing", "initial")
    return {name: value for name, value in table.specified().items() if name in names}


def load_world(path: Path, table: ModelTable) -> MappedModel:
    """The model that ``[world]`` of a task file describes."""
    with errors_in(f"{path}: [world] "):
        # Imports here: most tasks have a map, and need no reader of logs or models.
        if table.transitions is not None:
            from jaxltl.app.certify import load_logged

            mdp, actions, logged = load_logged(path.parent, table)
            return MappedModel(mdp, None, actions, logged.states, logged)
        if table.model is not None:
            from jaxltl.io.padded_models import read_padded

            file = path.parent / table.model
            loaded = read_padded(file, constants=table.constants)
            assert not isinstance(table.initial, list)
            return MappedModel(initial_where(loaded.mdp, table.initial, file), None, loaded.actions)
        assert table.map is not None
        text = read_map(path, table.map)
        return MappedModel(gridworld(text, **grid_options(table)), parse_map(text), ACTIONS)


def initial_where(mdp: MDP, formula: str | None, path: Path) -> MDP:
    """A model with uniform initial distribution over the states of a Boolean formula, if any."""
    if formula is None:
        return mdp
    with errors_in(f"{str(path)!r}: "):
        holds = satisfying(np.asarray(mdp.label), mdp.propositions, formula, "initial")
        if not holds.any():
            raise ValueError(f"initial={formula!r} holds in no state.")
        return replace(mdp, initial=jnp.asarray(holds / holds.sum(), mdp.dtype))


# --- demonstrations -------------------------------------------------------------------------------


def read_all(path: Path, files: Sequence[str], worlds: Sequence[NamedWorld]) -> list[Trajectories]:
    """The demonstrations of the files that a task file names, one for each world."""
    pairs = zip(files, worlds, strict=True)
    return [read_demonstrations(path.parent / name, world) for name, world in pairs]


def load_demonstrations(task: MlirlFile, world: MappedModel) -> Trajectories:
    """The demonstrations of a task's file; see :func:`~jaxltl.io.read_demonstrations`."""
    assert task.demonstrations.file is not None
    return read_all(task.path, [task.demonstrations.file], [world])[0]


def synthetic_demonstrations(
    key: jax.Array, path: Path, table: SyntheticTable, model: Product, best: Solution
) -> tuple[Trajectories, int]:
    """Demonstrations of an optimal policy, and the number of rollouts that are dropped."""
    number, length, discount = table.synthetic or 0, table.length or 200, table.discount
    with errors_in(f"{path}: [demonstrations] "):
        return sample_demonstrations(
            key, model, number, length=length, discount=discount, best=best
        )
