"""Demonstrations of task files: of a file, or simulated."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np

from jaxltl.app.files.task import SyntheticTable
from jaxltl.app.files.task_mlirl import MlirlFile
from jaxltl.app.files.worlds import MappedModel
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models import Product, Trajectories, make_trajectories, project_trajectories
from jaxltl.core.types import Solution
from jaxltl.io.demonstrations import read_demonstrations

_STEP_BYTES = 128  # of a simulated step, measured while demonstrations are made and checked
_LARGEST_BYTES = 4e9


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
