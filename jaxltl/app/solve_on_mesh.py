"""Model checking over the devices of a mesh, with checkpoints: ``jaxltl solve --mesh``."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np

import jaxltl
from jaxltl.algos.common import checkpoint as files
from jaxltl.app.processes import ProcessGroup, is_loss
from jaxltl.app.run_job import make_directory
from jaxltl.app.solve import PropertyResult, answers, load
from jaxltl.io.prism.properties import PropertyQuery
from jaxltl.core.logic import Formula, Property
from jaxltl.core.models.construct.state_formulas import BUILT_IN, label_columns
from jaxltl.core.models import POMDP, Game, IntervalMDP, MultiplayerGame, ShardedMDP, SparseMDP
from jaxltl.core.models import on_host, shard, to_mesh
from jaxltl.core.types import NotConverged
from jaxltl.core.values.properties.solve_on_mesh import (
    Bounds,
    first_bounds,
    question_on_mesh,
)
from jaxltl.core.values.properties.solve_property import TOLERANCE_SHARES, Answer
from jaxltl.io.umb.sharded import read_sharded
from jaxltl.app.wording import Record

_WORK = 1e9  # transition updates between checkpoints
_ROUND = 24  # approximate sweeps of a step of interval iteration
MAX_STEPS = 1_000_000


def on_mesh(model: SparseMDP | IntervalMDP, group: ProcessGroup) -> ShardedMDP:
    """Distributes a model over devices, with the built-in labels."""
    if isinstance(model, IntervalMDP):
        raise ValueError(
            "models whose probabilities are intervals are not solved over a mesh; leave --mesh out."
        )
    missing = tuple(x for x in BUILT_IN if x not in model.propositions)
    label = np.hstack([np.asarray(model.label), label_columns(model, missing, "the model")])
    whole = replace(model, label=label, propositions=(*model.propositions, *missing))
    assert group.mesh is not None
    return shard(whole, group.mesh)


def read(
    path: Path, queries: Sequence[PropertyQuery], group: ProcessGroup
) -> tuple[ShardedMDP, dict[str, str], Record]:
    """Reads a model over the devices: UMB by states, unless properties use built-in labels."""
    begin, mesh = time.perf_counter(), group.mesh
    assert mesh is not None
    formulas = [one.parsed.path for one in queries if one.parsed is not None]
    named = {name for x in formulas if isinstance(x, Formula) for name in x.propositions}
    if path.suffix == ".umb" and not named & set(BUILT_IN):
        with group.together():
            model = read_sharded(path, mesh)
        with group.together():
            mark = {"file": _digest(path)}
    else:
        with group.together():
            whole = load(path)
            if isinstance(whole, POMDP):
                raise ValueError(f"{str(path)!r} holds a POMDP, which is solved on one device.")
            if isinstance(whole, Game | MultiplayerGame):
                raise ValueError(f"{str(path)!r} is a game, which is solved without --mesh.")
        with group.together():
            model = on_mesh(whole, group)
        mark = files.fingerprint(model=whole)
    return model, mark, _entry(model, time.perf_counter() - begin)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _entry(model: ShardedMDP, seconds: float) -> Record:
    def count(x: jax.Array) -> int:
        return int(on_host(jax.jit(lambda x: (x > 0).sum())(x)))

    filled = model.num_states - model.num_unpadded
    choices = count(model.available) - filled
    ours = filled if model.place is None else model.num_devices  # transitions of padding states
    return {
        "kind": "chain" if choices == model.num_unpadded else "mdp",
        "states": model.num_unpadded,
        "choices": choices,
        "transitions": sum(count(table.probability) for table in model.tables) - ours,
        "seconds": seconds,
    }


@dataclass(frozen=True)
class MeshSolver:
    """Solver of properties over the devices of a mesh, with checkpoints."""

    group: ProcessGroup  # the processes and devices
    model: ShardedMDP  # distributed over the devices
    fingerprint: Mapping[str, str]  # of the model
    tolerance: float  # width of the bounds, absolute for probabilities and relative otherwise
    directory: Path | None = None  # of checkpoints, or None

    def agree(self, properties: list[str]) -> None:
        """Checks that all processes have the same arguments, files and versions."""
        directory = self.directory
        self.group.agree(
            {
                "the model": _digest_text(self.fingerprint),
                "the properties": properties,
                "--tolerance": self.tolerance,
                "--checkpoint": directory,
                "jax": jax.__version__,
                "jaxltl": jaxltl.__version__,
            }
        )
        if directory is not None:
            with self.group.together():
                if self.group.is_first:
                    make_directory(directory)
            self.group.sees(str(directory), directory.is_dir())

    def solve(self, queries: Sequence[PropertyQuery]) -> Iterator[PropertyResult]:
        """Yields the result of each property in order; errors of one do not end the others."""
        return answers(queries, self._answer, self._is_fatal)

    def _is_fatal(self, error: Exception) -> bool:
        """True for bugs, which leave checkpoints in place, and if other processes are lost."""
        lost = self.group.processes > 1 and is_loss(error)
        return lost or not isinstance(error, ValueError | NotConverged)

    def _answer(self, prop: Property) -> Answer:
        model, group = self.model, self.group
        question = question_on_mesh(model, prop)
        mark = {**self.fingerprint, "property": prop.text, "tolerance": repr(self.tolerance)}
        path = None
        if self.directory is not None:
            path = self.directory / f"solve-{_digest_text(mark)[:12]}.npz"
        bounds, part, num_steps = first_bounds(model, question), 0, 0
        if path is not None and group.sees(str(path), path.exists()):
            bounds, part, num_steps = _restored(path, mark, model, bounds)
        chunk = steps_between(model)
        while True:
            solution = question.advance(
                bounds, question.tolerance(self.tolerance, TOLERANCE_SHARES[part]), chunk
            )
            bounds, steps = (solution.lower, solution.upper), int(np.asarray(solution.num_steps))
            num_steps += steps
            if question.goes_on and steps >= chunk and num_steps < MAX_STEPS:
                if path is not None:
                    files.save(path, _state(model, bounds, part, num_steps), mark)
                continue
            answer = question.answer(solution, self.tolerance)
            if question.is_answered(answer, TOLERANCE_SHARES[part]):
                break
            part += 1
        if path is not None and group.is_first:
            files.remove(path)
        return answer


def steps_between(model: ShardedMDP) -> int:
    """Steps between checkpoints; a constant of the model, so that resumed runs are identical."""
    return max(16, int(_WORK / (_ROUND * sum(table.successor.size for table in model.tables))))


def _digest_text(mark: Mapping[str, str]) -> str:
    return hashlib.sha256(repr(sorted(mark.items())).encode()).hexdigest()


def _state(model: ShardedMDP, bounds: Bounds, part: int, num_steps: int) -> Record:
    return {
        "bounds": bounds,
        "devices": np.int32(model.num_devices),
        "part": np.int32(part),
        "made": np.int32(num_steps),
    }


def _restored(
    path: Path, mark: Mapping[str, str], model: ShardedMDP, bounds: Bounds
) -> tuple[Bounds, int, int]:
    """Bounds from a checkpoint, which may be of another number of devices."""
    empty = jax.tree.map(lambda x: np.zeros((0, *x.shape[1:]), x.dtype), bounds)
    state = files.load(path, _state(model, empty, 0, 0), mark)
    devices = int(state["devices"])
    if devices == model.num_devices:
        state = files.load(path, _state(model, bounds, 0, 0), mark)
    else:
        count, size = model.num_unpadded, -(-model.num_unpadded // devices)
        ends = enumerate(pairwise(np.arange(devices + 1) * count // devices))
        each = np.concatenate([np.arange(b - a) + i * size for i, (a, b) in ends])
        state["bounds"] = tuple(
            to_mesh(model, np.asarray(x)[each], fill)
            for x, fill in zip(state["bounds"], (0, 1), strict=True)
        )
    return state["bounds"], int(state["part"]), int(state["made"])
