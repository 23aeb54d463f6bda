"""Worlds of task files, from maps, models or logs, and their demonstrations."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from jaxltl.app.files.task import SyntheticTable
from jaxltl.app.files.task_irl import MlirlFile, ModelTable
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models import Product, Trajectories, make_trajectories, project_trajectories
from jaxltl.core.types import Solution
from jaxltl.io.demonstrations import read_demonstrations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import jax.numpy as jnp

from jaxltl.core.validation import errors_in
from jaxltl.app.files.schema import read_map
from jaxltl.app.files.task import GridTable
from jaxltl.core.logic.labels import satisfying
from jaxltl.core.models.mdp import MDP
from jaxltl.envs.gridworld import ACTIONS, gridworld
from jaxltl.envs.text_map import parse_map
from jaxltl.app.wording import Record
from jaxltl.io.demonstrations import NamedWorld

if TYPE_CHECKING:
    from jaxltl.app.certify import Logged


_STEP_BYTES = 128  # of a simulated step, measured while demonstrations are made and checked
_LARGEST_BYTES = 4e9


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


def load_demonstrations(task: MlirlFile, world: MappedModel) -> Trajectories:
    """The demonstrations of a task's file; see :func:`~jaxltl.io.read_demonstrations`."""
    assert task.demonstrations.file is not None
    return read_demonstrations(task.path.parent / task.demonstrations.file, world)


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
