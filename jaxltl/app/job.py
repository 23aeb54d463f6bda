"""Shared parts of learning jobs: parallel seeds, fingerprints, result entries, files."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import inspect
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl
from jaxltl.algos.common.chunks import Chunks, ChunkOptions, run_in_chunks
from jaxltl.app.files.task import FormulaFile
from jaxltl.app.protocols import Algorithm, Training
from jaxltl.app.reports.drawing import Picture, drawing
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models.mesh.lanes import on_host, vmap_over_mesh
from jaxltl.app.wording import Record, Result
from jaxltl.core.models.protocols import PyTree

Hparams = TypeVar("Hparams")


def settings(kind: Callable[..., Hparams], values: Result) -> Hparams:
    """A learner's Hparams with the given keys that it has; ``method`` names the learner."""
    names = inspect.signature(kind).parameters.keys() - {"method"}
    return kind(**{name: value for name, value in values.items() if name in names})


def run_seeds(
    algorithm: Algorithm,
    problem: PyTree,
    hparams: PyTree,
    training: Training,
    *,
    num_steps: int,
    options: ChunkOptions | None = None,
) -> tuple[Chunks, dict[str, np.ndarray]]:
    """Runs a learner from N seeds in parallel; returns chunks and metrics ``[T, N]`` by name."""
    mesh = training.mesh if training.num_seeds > 1 else None
    if mesh is None:
        states = _first_states(algorithm.init, training.seed, training.num_seeds, problem, hparams)
    else:
        make = vmap_over_mesh(_first_of(algorithm.init), mesh, in_axes=(0, None, None, None))
        states = make(np.arange(training.num_seeds), np.int32(training.seed), problem, hparams)
    report = training.report
    chunks = run_in_chunks(
        algorithm.step,
        states,
        problem,
        hparams,
        num_steps=num_steps,
        options=dataclasses.replace(
            options or ChunkOptions(),
            lanes=True,
            report=report and (lambda step, metrics: report(step, vars(metrics))),
            checkpoint=training.checkpoint,
            mesh=mesh,
        ),
    )
    if mesh is not None:  # later work is done in each process
        chunks = chunks._replace(state=jax.tree.map(jnp.asarray, on_host(chunks.state)))
    return chunks, {"step": chunks.step, **vars(chunks.metrics)}


@functools.partial(jax.jit, static_argnames=("init", "num_seeds"))
def _first_states(
    init: Callable[..., PyTree], seed: int, num_seeds: int, problem: PyTree, hparams: PyTree
) -> PyTree:
    """The initial states of N seeds, by one program."""

    def first(n: jax.Array | int) -> PyTree:
        return _first_of(init)(n, seed, problem, hparams)

    if num_seeds == 1:  # a smaller program than with vmap
        return jax.tree.map(lambda x: x[None], first(0))
    return jax.vmap(first)(jnp.arange(num_seeds))


@functools.cache  # the same function for each learner, so that it is compiled once
def _first_of(init: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """The initial state of lane n."""

    def first(n: jax.Array | int, seed: int, problem: PyTree, hparams: PyTree) -> PyTree:
        root = jax.random.fold_in(jax.random.key(seed), 1)
        return init(jax.random.fold_in(root, n), problem, hparams)

    return first


def one_seed(learned: PyTree, i: int) -> PyTree:
    """Seed i of a frozen dataclass of arrays ``[N, ...]`` with a history ``[T, N]``."""
    one = {k: v[i : i + 1] for k, v in vars(learned).items() if isinstance(v, np.ndarray)}
    history = {k: v if v.ndim == 1 else v[:, i : i + 1] for k, v in learned.history.items()}
    return dataclasses.replace(learned, **one, history=history)


def postfix(metrics: Mapping[str, np.ndarray]) -> dict[str, str]:
    """Least loss and greatest gradient norm over seeds, for the progress bar."""
    return {
        "loss": f"{metrics['loss'].min():.4f}",
        "gradient": f"{metrics['gradient_norm'].max():.1e}",
    }


def fingerprint(digest: str, seed: int, num_seeds: int) -> str:
    """Fingerprint of a run of a task, which a checkpoint must have to be resumed."""
    parts = [
        digest,
        seed,
        num_seeds,
        jaxltl.__version__,
        jax.__version__,
        str(jnp.result_type(float)),
    ]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]


def about(task: FormulaFile) -> Record:
    """The first entries of a result."""
    return {"task": task.name, "formula": task.formula, "method": task.learner.method}


def took(seconds: float) -> Record:
    """The last entries of a result."""
    versions = {"jaxltl": jaxltl.__version__, "jax": jax.__version__}
    return {"seconds": round(seconds, 2), "versions": versions}


def plain(value: object) -> Any:
    """A value of JSON: arrays become lists, NaN and infinity become None."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return plain(np.asarray(value).tolist())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def automaton_picture(automaton: Automaton, live: str) -> Picture:
    """The picture of the formula's automaton."""
    return Picture(
        "automaton.svg",
        "Automaton of the formula",
        drawing("automaton", automaton),
        "Double circle: any continuation satisfies the formula. Grey: it is violated. States are "
        "named by the remaining formula.",
        live,
    )


def learning_picture(
    history: Mapping[str, np.ndarray], caption: str, show: Sequence[str]
) -> Picture:
    """The picture of some learning curves."""
    series = {k: history[k].T for k in show if k in history}
    drawn = drawing("curves", series, steps=history["step"])
    return Picture("learning.svg", "Learning", drawn, caption, "learning")


def over_seeds(count: int) -> str:
    """The end of a caption of learning curves."""
    band = "; the line is the median over seeds, the band their range"
    return f"{band if count > 1 else ''}."


def short_name(text: str, width: int = 44) -> str:
    """A name truncated to `width` characters."""
    return text if len(text) <= width else text[: width - 1] + "…"
