"""Runs of a learner in compiled chunks, on the host: reports, saved states, and resuming bitwise.

Example: a contraction to a fixed point, for two lanes.
  >>> import jax, jax.numpy as jnp
  >>> from jaxltl.core import struct
  >>> from jaxltl.algos.common.chunks import ChunkOptions, run_in_chunks
  >>> @struct.dataclass
  ... class State:
  ...     step: jax.Array
  ...     guess: jax.Array
  >>> def step(state, problem, hparams):
  ...     guess = state.guess + hparams * (problem - state.guess)
  ...     return State(state.step + 1, guess), {"guess": guess}
  >>> start = State(jnp.zeros(2, jnp.int32), jnp.zeros(2))
  >>> chunks = run_in_chunks(step, start, 5.0, 0.5, num_steps=4,
  ...                        options=ChunkOptions(lanes=True, chunk=2))
  >>> chunks.state.step.tolist(), chunks.step.tolist(), chunks.metrics["guess"].shape
  ([4, 4], [1, 2, 3, 4], (4, 2))
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.algos.common import checkpoint as files
from jaxltl.algos.common.loops import RunProgress, Step, Until, block_lengths, run_blocks
from jaxltl.algos.common.settings import require_hparams
from jaxltl.algos.common.trees import either, strong
from jaxltl.core import validation
from jaxltl.core.array_types import PyTree
from jaxltl.core.models.mesh.lanes import on_host, vmap_over_mesh
from jaxltl.core.models.ops.array_namespace import to_jax


@dataclass(frozen=True, kw_only=True)
class ChunkOptions:
    """Options of :func:`run_in_chunks`.

    Attributes:
      until, keep: as for :meth:`~jaxltl.algos.common.learner.Learner.run_until`.
      lanes: whether there are N runs: the state has a first axis of N, and hyperparameters are shared
        or one for each, ``[N]``.
      chunk: steps between reports; default `max_rows`, or a hundredth of the steps.
      max_rows: bound on the rows of metrics of a chunk.
      report: called with the number of steps and the newest metrics after each chunk.
      checkpoint: a file written atomically after each chunk, from which a run resumes bitwise.
      mesh: devices of the lanes (:mod:`~jaxltl.core.models.mesh.lanes`). With several processes each
        passes the same arguments and receives the whole result except the state, which stays where
        it is. Checkpoints of other devices, or of none, are resumed too.

    >>> ChunkOptions(chunk=50).max_rows
    10
    """

    until: Until | None = None
    keep: str = "after"
    lanes: bool = False
    chunk: int | None = None
    max_rows: int = 10
    report: Callable[[int, PyTree], None] | None = None
    checkpoint: str | os.PathLike[str] | None = None
    mesh: Mesh | None = None


class Chunks(NamedTuple):
    """Result of :func:`run_in_chunks`.

    Attributes:
      state: the last state; with lanes, a first axis of N.
      metrics: of evenly spaced steps of each chunk, NumPy arrays with a first axis of rows, including
        those before an interruption; with lanes ``[rows, N, ...]``.
      step: ``int[rows]``, the number of the step of each row, from 1.
      done: whether the condition was met; with lanes ``bool[N]``.
    """

    state: PyTree
    metrics: PyTree
    step: np.ndarray
    done: np.ndarray


def run_in_chunks(
    step: Step,
    state: PyTree,
    problem: PyTree,
    hparams: PyTree,
    *,
    num_steps: int,
    options: ChunkOptions = ChunkOptions(),
) -> Chunks:
    """The :class:`Chunks` of steps in compiled chunks, with a report and a checkpoint after each.

    Steps of the learner's `step` with its `problem` and `hparams` are made until `num_steps`; a state
    with ``state.step`` steps makes the rest. A run in which the condition of `options` holds stays
    unchanged, so that lanes are independent; the loop ends when all have finished.

    Raises:
      ValueError: a hyperparameter is out of range, or the checkpoint belongs to another learner,
        problem or hyperparameters.
    """
    lanes, until = validation.boolean("lanes", options.lanes), options.until
    chunk = options.chunk or max(options.max_rows, -(-num_steps // 100))
    checkpoint = options.checkpoint
    num_lanes = len(state.step) if lanes else None
    require_hparams(hparams, batched=lanes)
    hparams = _spread(hparams, state) if lanes else hparams
    until = until if until is None or isinstance(until, Partial) else Partial(until)
    now = _begin(step, state, problem, hparams, num_lanes)
    rows = jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), (now.count, now.metrics))
    fingerprint: PyTree = None
    if checkpoint is not None:
        fingerprint = files.fingerprint(step=step, problem=problem, hparams=hparams)
        if os.path.exists(checkpoint):
            now, rows = files.load(checkpoint, (now, rows), fingerprint)
    advance: Callable[..., tuple[PyTree, PyTree]]
    single = _progress_step(step, options.keep)
    if not lanes:
        advance = partial(run_blocks, single)
    elif options.mesh is None:
        advance = partial(_run_lanes, single)
    else:
        advance = _run_over_mesh(options.mesh, single)
    ended, counts = on_host((now.done, now.count))
    while counts.max() < num_steps and not ended.all():
        lengths = block_lengths(min(chunk, num_steps - int(counts.max())), options.max_rows)
        now, fresh = advance(strong(now), problem, (hparams, until), lengths)
        rows = jax.tree.map(
            lambda x, y: np.concatenate([x, y]), jax.device_get(rows), jax.device_get(fresh)
        )
        ended, counts = on_host((now.done, now.count))
        if checkpoint is not None:
            files.save(checkpoint, (now, rows), fingerprint)
        if options.report is not None:
            options.report(int(counts.max()), jax.tree.map(lambda x: x[-1], rows[1]))
    step_of = np.asarray(rows[0])
    return Chunks(
        now.state, jax.tree.map(np.asarray, rows[1]), step_of[:, 0] if lanes else step_of, ended
    )


def _begin(
    step: Step, state: PyTree, problem: PyTree, hparams: PyTree, num_lanes: int | None
) -> RunProgress:
    """Progress before the first chunk, without compilation."""
    lanes = () if num_lanes is None else (num_lanes,)
    shape = _metrics_of(step, state, problem, hparams, num_lanes)
    metrics = jax.tree.map(lambda x: np.zeros((*lanes, *x.shape), x.dtype), shape)
    count = np.asarray(on_host(state.step), np.int32)
    return RunProgress(state, *to_jax((metrics, count, np.zeros(count.shape, bool))))


def _metrics_of(
    step: Step, state: PyTree, problem: PyTree, hparams: PyTree, num_lanes: int | None
) -> PyTree:
    """Shapes of the metrics of one run, from a step's trace."""
    one = (state, hparams)
    if num_lanes is not None:
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), one)
    # As a program, so that its trace is kept for the next run.
    return jax.eval_shape(jax.jit(step), one[0], problem, one[1])[1]


@cache  # compiled once for each step, so it must stay the same function
def _progress_step(step: Step, keep: str) -> Step:
    """A step of :class:`RunProgress`, with rows of counts and metrics."""

    def one(now: RunProgress, problem: PyTree, settings: PyTree) -> tuple[RunProgress, PyTree]:
        hparams, until = settings

        def go(now: RunProgress) -> RunProgress:
            after, metrics = step(now.state, problem, hparams)
            if until is None:
                return replace(now, state=after, metrics=metrics)
            done = jnp.asarray(until(now.state, after, metrics))
            state = either(done, now.state, after) if keep == "before" else after
            return replace(now, state=state, metrics=metrics, done=done)

        new = go(now) if until is None else lax.cond(now.done, lambda x: x, go, now)
        new = replace(new, count=now.count + 1)
        return new, (new.count, new.metrics)

    return one


@partial(jax.jit, static_argnames="step")
def _run_lanes(
    step: Step, now: RunProgress, problem: PyTree, settings: PyTree, lengths: np.ndarray
) -> tuple[RunProgress, PyTree]:
    """Blocks of steps of all lanes; the rows lie along the first axis."""

    def run(now: RunProgress, hparams: PyTree) -> tuple[RunProgress, PyTree]:
        return run_blocks(step, now, problem, (hparams, settings[1]), lengths)

    if len(now.count) > 1:
        return jax.vmap(run, out_axes=(0, 1))(now, settings[0])
    # Without vmap: its loops and branches take several times as long to compile.
    last, rows = run(*jax.tree.map(lambda x: x[0], (now, settings[0])))
    return jax.tree.map(lambda x: x[None], last), jax.tree.map(lambda x: x[:, None], rows)


def _spread(hparams: PyTree, state: PyTree) -> PyTree:
    """Hyperparameters of each of N runs, floats in the precision of the states."""
    size = len(state.step)
    floats = [x.dtype for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)]

    def one(number: ArrayLike) -> np.ndarray:
        x = np.asarray(number)
        x = x.astype(floats[0]) if floats and np.issubdtype(x.dtype, np.floating) else x
        return np.broadcast_to(x, (size, *x.shape[1:]))

    return to_jax(jax.tree.map(one, hparams))


def _run_over_mesh(mesh: Mesh, step: Step) -> Callable[..., tuple[PyTree, PyTree]]:
    """Blocks of steps of lanes over the devices of a mesh, with metrics on the host."""
    lanes = vmap_over_mesh(_blocks_of(step), mesh, in_axes=(0, None, (0, None), None))

    def advance(*arguments: PyTree) -> tuple[PyTree, PyTree]:
        state, rows = lanes(*arguments)
        return state, jax.tree.map(lambda x: np.swapaxes(x, 0, 1), on_host(rows))

    return advance


@cache  # compiled once for each step, so it must stay the same function
def _blocks_of(step: Step) -> Callable[..., PyTree]:
    return partial(run_blocks, step)
