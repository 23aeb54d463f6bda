"""Model checking over the devices of a mesh, with checkpoints: ``jaxltl solve --mesh``."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxltl
from jaxltl.algos.common import checkpoint as files
from jaxltl.app.processes import Place, is_loss
from jaxltl.app.run_job import make_directory
from jaxltl.app.solve import INVALID, NOT_CONVERGED, Asked, Result, load
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.properties import Property
from jaxltl.core.models.construct.state_formulas import BUILT_IN, label_columns
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mesh.lanes import on_host
from jaxltl.core.models.mesh.shard import shard, to_mesh
from jaxltl.core.models.mesh.sharded import ShardedMDP
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import NotConverged
from jaxltl.core.values.properties.solve_on_mesh import (
    Bounds,
    Question,
    first_bounds,
    question_on_mesh,
)
from jaxltl.core.values.properties.solve_property import FINER, Answer
from jaxltl.io.umb.sharded import read_sharded

_WORK = 1e9  # transition updates between checkpoints
_ROUND = 24  # approximate sweeps of a step of interval iteration
MAX_STEPS = 1_000_000


def on_mesh(model: SparseMDP | IntervalMDP, place: Place) -> ShardedMDP:
    """Distributes a model over devices, with the built-in labels.

    Raises:
      ValueError: it has intervals, or fewer states than there are devices.
    """
    if isinstance(model, IntervalMDP):
        raise ValueError(
            "models whose probabilities are intervals are not solved over a mesh; leave --mesh out."
        )
    missing = tuple(x for x in BUILT_IN if x not in model.propositions)
    label = np.hstack([np.asarray(model.label), label_columns(model, missing, "the model")])
    whole = replace(model, label=label, propositions=(*model.propositions, *missing))
    assert place.mesh is not None
    return shard(whole, place.mesh)


def read(
    path: Path, asked: Sequence[Asked], place: Place
) -> tuple[ShardedMDP, dict[str, str], dict[str, Any]]:
    """Reads a model file over the devices; of a UMB file each process reads its own states.

    If a property has built-in labels, each process reads the whole file.

    Returns:
      The model, its fingerprint, and its JSON object.

    Raises:
      ValueError: it is no chain or decision process, or cannot be distributed.
    """
    begin, mesh = time.perf_counter(), place.mesh
    assert mesh is not None
    formulas = [one.parsed.path for one in asked if one.parsed is not None]
    named = {name for x in formulas if isinstance(x, Formula) for name in x.propositions}
    if path.suffix == ".umb" and not named & set(BUILT_IN):
        model = place.together(lambda: read_sharded(path, mesh))
        given = {"file": place.together(lambda: _digest(path))}
    else:
        whole = place.together(lambda: load(path))
        model = place.together(lambda: on_mesh(whole, place))
        given = files.fingerprint(model=whole)
    return model, given, _entry(model, time.perf_counter() - begin)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _entry(model: ShardedMDP, seconds: float) -> dict[str, Any]:
    def count(x: jax.Array) -> int:
        return int(on_host(jax.jit(lambda x: (x > 0).sum())(x)))

    filled = model.num_states - model.num_given
    choices = count(model.available) - filled
    ours = filled if model.place is None else model.num_devices  # transitions of padding states
    transitions = sum(count(table.probability) for table in model.tables) - ours
    kind = "chain" if choices == model.num_given else "mdp"
    return {
        "kind": kind,
        "states": model.num_given,
        "choices": choices,
        "transitions": transitions,
        "seconds": seconds,
    }


def solve_in(
    place: Place,
    model: ShardedMDP,
    given: Mapping[str, str],
    asked: Sequence[Asked],
    tolerance: float,
    directory: Path | None,
    properties: list[str],
) -> Iterator[Result]:
    """The result of each property, when the processes have agreed on what is asked.

    Raises:
      ValueError: they were not asked the same, or the directory is not one of all.
    """
    place.agree(
        {
            "the model": hashlib.sha256(repr(sorted(given.items())).encode()).hexdigest(),
            "the properties": properties,
            "--tolerance": tolerance,
            "--checkpoint": directory,
            "jax": jax.__version__,
            "jaxltl": jaxltl.__version__,
        }
    )
    if directory is not None:
        place.together(lambda: make_directory(directory) if place.is_first else None)
        place.sees(str(directory), directory.is_dir())
    yield from solve_on_mesh(model, given, asked, tolerance, place, directory)


def solve_on_mesh(
    model: ShardedMDP,
    given: Mapping[str, str],
    asked: Sequence[Asked],
    tolerance: float,
    place: Place,
    directory: Path | None,
) -> Iterator[Result]:
    """The result of each property, as soon as it is there.

    Args:
      model: over the devices.
      given: what tells the model apart from others.
      asked: the properties.
      tolerance: the width of the bounds.
      place: the devices and processes.
      directory: where bounds are kept until their property is answered; None: nowhere.
    """
    for one in asked:
        begin = time.perf_counter()
        found: Answer | None = None
        error, fault = one.error, INVALID
        if one.parsed is not None:
            try:
                found = _answered(model, given, one.parsed, tolerance, place, directory)
            except ValueError as mistake:
                if place.processes > 1 and is_loss(mistake):
                    raise
                error = str(mistake)
            except NotConverged as failure:
                error, fault = str(failure), NOT_CONVERGED
        yield Result(one, found, time.perf_counter() - begin, error, fault)


def _answered(
    model: ShardedMDP,
    given: Mapping[str, str],
    prop: Property,
    tolerance: float,
    place: Place,
    directory: Path | None,
) -> Answer:
    question = question_on_mesh(model, prop)
    given = {**given, "property": prop.text, "tolerance": repr(tolerance)}
    path = None if directory is None else directory / f"{_name(given)}.npz"
    bounds, part, made = first_bounds(model, question), 0, 0
    if path is not None and place.sees(str(path), path.exists()):
        bounds, part, made = _restored(path, given, model, question, bounds)
    most = steps_between(model)
    while True:
        half = question.tolerance(tolerance, FINER[part])
        found = question.advance(bounds, half, most)
        bounds, steps = (found.lower, found.upper), int(np.asarray(found.num_steps))
        made += steps
        if question.goes_on and steps >= most and made < MAX_STEPS:
            if path is not None:
                files.save(path, _state(model, bounds, part, made), given)
            continue
        answer = question.answer(found, tolerance)
        if question.is_answered(answer, FINER[part]):
            break
        part += 1
    if path is not None and place.is_first:
        files.remove(path)
    return answer


def steps_between(model: ShardedMDP) -> int:
    """How many steps are made before bounds are saved; always as many, so that runs are alike."""
    size = sum(table.successor.size for table in model.tables)
    return max(16, int(_WORK / (_ROUND * size)))


def _name(given: Mapping[str, str]) -> str:
    text = repr(sorted(given.items())).encode()
    return f"solve-{hashlib.sha256(text).hexdigest()[:12]}"


def _state(model: ShardedMDP, bounds: Bounds, part: int, made: int) -> dict[str, Any]:
    return {
        "bounds": bounds,
        "devices": np.int32(model.num_devices),
        "part": np.int32(part),
        "made": np.int32(made),
    }


def _restored(
    path: Path, given: Mapping[str, str], model: ShardedMDP, question: Question, bounds: Bounds
) -> tuple[Bounds, int, int]:
    """Bounds that were saved, also from another number of devices."""
    like = _state(model, bounds, 0, 0)
    small = {name: x for name, x in like.items() if name != "bounds"}
    empty = jax.tree.map(lambda x: np.zeros((0, *x.shape[1:]), x.dtype), bounds)
    devices = int(files.load(path, {**small, "bounds": empty}, given)["devices"])
    if devices == model.num_devices:
        found = files.load(path, like, given)
    else:
        found = files.load(path, {**small, "bounds": empty}, given)
        count, size = model.num_given, -(-model.num_given // devices)
        begins = np.arange(devices + 1) * count // devices
        each = np.concatenate(
            [np.arange(b - a) + i * size for i, (a, b) in enumerate(pairwise(begins))]
        )
        found["bounds"] = tuple(
            to_mesh(model, np.asarray(x)[each], fill)
            for x, fill in zip(found["bounds"], (0, 1), strict=True)
        )
    return found["bounds"], int(found["part"]), int(found["made"])
