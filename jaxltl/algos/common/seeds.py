"""Learning with several seeds in parallel, from the host, with reports, checkpoints and a mesh.

Example: two seeds of a tabular learner.
  >>> import numpy as np, jaxltl as jl
  >>> from jaxltl.algos import expected_sarsa
  >>> ring = jl.gridworld("s.\\n.g", slip=0.1, initial="s")
  >>> problem = expected_sarsa.make_problem(ring, np.eye(4))
  >>> hparams = expected_sarsa.Hparams(discount=0.9)
  >>> chunks, history = run_seeds(expected_sarsa, problem, hparams, Training(0, 2), num_steps=6)
  >>> chunks.state.step.tolist(), history["residual"].shape
  ([6, 6], (6, 2))
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from jaxltl.algos.common.chunks import ChunkOptions, Chunks, run_in_chunks
from jaxltl.core.array_types import PyTree
from jaxltl.core.models.mesh.lanes import on_host, vmap_over_mesh

HparamsT = TypeVar("HparamsT")


class MetricsReport(Protocol):
    """A function of the number of steps and of the newest metrics, ``[N]`` each."""

    def __call__(self, num_steps: int, metrics: Mapping[str, np.ndarray], /) -> None: ...


class Algorithm(Protocol):
    """The functions of a learner that are called here; implemented by its module."""

    init: Callable[..., PyTree]
    step: Callable[..., tuple[PyTree, PyTree]]


def _silent(_: str) -> None:
    pass


@dataclasses.dataclass(frozen=True)
class Training:
    """Seeds of a run, and what happens during it.

    Attributes:
      seed: the first seed.
      num_seeds: the number of seeds, which learn in parallel.
      report: called with the steps made and the newest metrics.
      stage: called with the name of each stage after learning.
      checkpoint: file from which an interrupted run resumes.
      mesh: devices over which several seeds are distributed.
    """

    seed: int = 0
    num_seeds: int = 1
    report: MetricsReport | None = None
    stage: Callable[[str], None] = dataclasses.field(default_factory=lambda: _silent, repr=False)
    checkpoint: Path | None = None
    mesh: Mesh | None = None

    def key(self, use: int, lane: int = 0) -> jax.Array:
        """Random key of a lane: learning has the `use` 1, demonstrations 0, and evaluation 2."""
        return jax.random.fold_in(jax.random.fold_in(jax.random.key(self.seed), use), lane)


ONE_SEED = Training()


def make_hparams(kind: Callable[..., HparamsT], values: Mapping[str, PyTree]) -> HparamsT:
    """A learner's Hparams of those of some `values` that it has; ``method`` names the learner."""
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
    """A learner's run from N seeds in parallel: its chunks, and metrics ``[T, N]`` by name.

    Args:
      algorithm: a learner's module.
      problem, hparams: of the learner.
      training: seeds, reports, checkpoint and mesh.
      num_steps: number of steps of each seed.
      options: of :func:`~jaxltl.algos.common.chunks.run_in_chunks`.
    """
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
    """Seed `i` of `learned`, a frozen dataclass of arrays ``[N, ...]`` with a history ``[T, N]``."""
    one = {k: v[i : i + 1] for k, v in vars(learned).items() if isinstance(v, np.ndarray)}
    history = {k: v if v.ndim == 1 else v[:, i : i + 1] for k, v in learned.history.items()}
    return dataclasses.replace(learned, **one, history=history)
