"""Runs of any learner from the host: reports and checkpoints during a run, and sweeps.

:func:`train` is the ``train`` of a learner, bit for bit, as compiled chunks of steps; between them
it calls a function of the caller and saves the run. :func:`sweep` runs many seeds of many
settings on all cores, each of them bit for bit the run by itself.

Example: tabular learning in a ring of states.
  >>> import jax, numpy as np
  >>> import jaxltl as jl
  >>> from jaxltl.algos import expected_sarsa, training
  >>> ring = jl.gridworld("s.\\n.g", slip=0.1, initial="s")
  >>> problem = expected_sarsa.make_problem(ring, np.eye(4))
  >>> hparams = expected_sarsa.Hparams(discount=0.9)
  >>> errors = []
  >>> state, metrics = training.train(
  ...     expected_sarsa, jax.random.key(0), problem, hparams, num_steps=6, every=2,
  ...     callback=lambda state, metrics: errors.append(float(metrics.residual)))
  >>> len(errors), metrics.residual.shape, state.step.item()
  (3, (6,), 6)
  >>> runs = training.sweep(expected_sarsa, jax.random.split(jax.random.key(0), 2), problem,
  ...                       hparams, {"step_size": [0.1, 0.5]}, num_steps=6)
  >>> runs.names, runs.metrics.residual.shape  # settings, seeds, steps
  (('step_size=0.1', 'step_size=0.5'), (2, 2, 6))
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common import checkpoint as files
from jaxltl.algos.common.loops import MAX_STEPS, block_lengths, run_blocks
from jaxltl.algos.common.settings import require_arrays, require_hparams
from jaxltl.core import validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import require_key
from jaxltl.core.models.mesh.cores import num_cores
from jaxltl.core.models.ops.array_namespace import enable_x64
from jaxltl.core.pretty_print import brief


class HasSteps(Protocol):
    """What is called of a :class:`~jaxltl.algos.common.learner.Learner`."""

    @property
    def init(self) -> Callable[..., PyTree]:
        """The state before the first step."""

    @property
    def step(self) -> Callable[..., tuple[PyTree, PyTree]]:
        """The next state, and metrics."""


Callback = Callable[[PyTree, PyTree], object]


# --- one run --------------------------------------------------------------------------------------


def train(
    learner: HasSteps,
    start: Key | PyTree,
    problem: PyTree,
    hparams: PyTree,
    *,
    num_steps: int,
    callback: Callback | None = None,
    every: int | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    max_rows: int = 1000,
) -> tuple[PyTree, PyTree]:
    """State and metrics of a learner's run, with a call of `callback` and a saved run between chunks.

    The result is that of ``learner.train(key, problem, hparams, num_steps=num_steps,
    max_rows=max_rows)``, bit for bit, with or without a callback, interrupted or not.

    Args:
      learner: a module of the protocol :class:`~jaxltl.algos.common.learner.Learner`, such as ``ppo``.
      start: a random key, or the state of an earlier run, from which it continues.
      problem, hparams: of the learner.
      num_steps: number of steps in total; those of `start` and of the `checkpoint` count.
      callback: called after each chunk with the state and the newest metrics, numbers of NumPy. If it
        raises StopIteration, the run ends and is returned; after another exception, such as
        KeyboardInterrupt, the checkpoint remains.
      every: steps of a chunk, rounded up to whole rows of metrics; default a fortieth of the run.
      checkpoint: a file, written atomically before each call of `callback`. If it exists, the run
        continues from it; with all steps made it is read only.
      max_rows: bound on the rows of metrics, evenly spaced steps that include the last.

    Returns:
      The ``State`` after the last step, and ``Metrics`` with a leading axis of rows, arrays of NumPy.

    Raises:
      ValueError: a number out of range, no steps to make, or a checkpoint that is damaged or of
        another learner, key, problem or hyperparameters.
    """
    num_steps = validation.integer("num_steps", num_steps, least=1, limit=MAX_STEPS)
    stride = int(block_lengths(num_steps, _positive("max_rows", max_rows))[-1])
    every = -(-num_steps // 40) if every is None else _positive("every", every)
    if callback is not None:
        validation.function("callback", callback)
    state = _first_state(learner, start, problem, hparams)
    rows: list[PyTree] = []
    saved, description = False, dict[str, str]()
    if checkpoint is not None:
        name = f"{learner.step.__module__}.{learner.step.__qualname__}"
        description = files.fingerprint(
            learner=name, key=state.key, problem=problem, hparams=hparams
        )
        if saved := os.path.exists(checkpoint):
            like = (state, _no_rows(learner, state, problem, hparams))
            state, before = files.load(checkpoint, like, description)
            rows = [jax.device_get(before)]
    made = int(state.step)
    if made > num_steps or (made == num_steps and not saved):
        raise ValueError(
            f"num_steps={num_steps}, and the run has made {made} steps; num_steps is their total: "
            "give a larger one."
        )
    ends = np.cumsum(block_lengths(num_steps, max_rows))
    lengths = np.diff(ends[ends > made], prepend=made).astype(np.int32)
    size = min(-(-every // stride), len(ends))
    count = -(-len(lengths) // size)
    # Blocks without steps at the end: one program for all chunks.
    chunks = np.pad(lengths, (0, count * size - len(lengths))).reshape(count, size)

    def advance(state: PyTree, chunk: int) -> tuple[PyTree, PyTree]:
        return run_blocks(learner.step, state, problem, hparams, chunks[chunk])

    following: PyTree = advance(state, 0) if count else ()
    for i in range(count):
        state, fresh = following
        # Computed while the host reports this chunk.
        following = advance(state, i + 1) if i + 1 < count else ()
        number = np.count_nonzero(chunks[i])
        fresh = jax.tree.map(lambda x, n=number: x[:n], jax.device_get(fresh))
        rows.append(fresh)
        if checkpoint is not None:
            rows = [_concatenated(rows)]
            files.save(checkpoint, (state, *rows), description)
        if callback is not None:
            try:
                callback(state, jax.tree.map(lambda x: x[-1], fresh))
            except StopIteration:
                break
    return state, _concatenated(rows)


def _positive(name: str, value: object) -> int:
    return validation.integer(name, value, least=1)


def _first_state(learner: HasSteps, start: PyTree, problem: PyTree, hparams: PyTree) -> PyTree:
    """The state of `start`, a key or a state, on concrete arrays."""
    _require_learner(learner)
    _require_concrete(start=start, problem=problem, hparams=hparams)
    is_state = hasattr(start, "key") and hasattr(start, "step")
    state = start if is_state else learner.init(require_key(start), problem, hparams)
    require_arrays(start=state, problem=problem, hparams=hparams)
    require_hparams(hparams)
    if np.ndim(state.step):
        raise ValueError(
            f"start has {len(state.step)} lanes; continue one of them, or vmap the learner's run."
        )
    return state


def _require_learner(learner: HasSteps) -> None:
    lacking = [x for x in ("init", "step") if not callable(getattr(learner, x, None))]
    if lacking:
        raise ValueError(
            f"learner is {validation.shorten(learner)}, without {' and '.join(lacking)}; give a "
            "module such as jaxltl.algos.ppo."
        )


def _require_concrete(**trees: PyTree) -> None:
    for name, tree in trees.items():
        if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree)):
            raise ValueError(f"{name} is traced; inside jit and vmap call the learner's own train.")


def _no_rows(learner: HasSteps, *arguments: PyTree) -> PyTree:
    """Metrics without a row."""
    _, metrics = jax.eval_shape(jax.jit(learner.step), *arguments)
    return jax.tree.map(lambda x: np.zeros((0, *x.shape), x.dtype), metrics)


def _concatenated(rows: Sequence[PyTree]) -> PyTree:
    return jax.tree.map(lambda *x: np.concatenate(x), *rows)


# --- seeds and settings ---------------------------------------------------------------------------


@brief(fields=("settings", "metrics"))
@dataclass(frozen=True)
class Sweep:
    """Runs of H settings and N seeds.

    Attributes:
      settings: for each setting its hyperparameters by name, those that vary.
      hparams: for each setting its ``Hparams``.
      states: ``states[h][n]`` is the last state of a run.
      metrics: of the runs, arrays ``[H, N, rows]`` of NumPy.
      step: ``int[rows]``, the number of the step of each row, from 1.

    Example:
      >>> from types import SimpleNamespace
      >>> rows = {"loss": np.array([[[3.0, 1.0], [5.0, 2.0]]])}  # a setting, two seeds, two steps
      >>> one = Sweep(({"rate": 0.1},), (None,), (), rows, np.array([1, 2]))
      >>> one.summary("loss")
      [{'rate': 0.1, 'seeds': 2, 'loss': 1.5, 'loss deviation': 0.7071067811865476}]
      >>> print(one.table("loss"))
      | rate | seeds | loss |
      |---|---|---|
      | 0.1 | 2 | 1.5 ± 0.7071 |
    """

    settings: tuple[dict[str, PyTree], ...]
    hparams: tuple[PyTree, ...]
    states: tuple[tuple[PyTree, ...], ...]
    metrics: PyTree
    step: np.ndarray

    @property
    def names(self) -> tuple[str, ...]:
        """A name for each setting, such as ``learning_rate=0.001``."""
        return tuple(
            ", ".join(f"{name}={_text(x)}" for name, x in setting.items()) or "all seeds"
            for setting in self.settings
        )

    def summary(self, *names: str, last: int = 1) -> list[dict[str, PyTree]]:
        """Mean and standard deviation over seeds, a dict for each setting, as for a data frame.

        Args:
          names: of metrics.
          last: number of rows at the end; a seed's mean over their finite numbers is taken first.

        Returns:
          The values that vary, the number of seeds, and for each name the mean and the sample
          deviation, without seeds that have no finite number.

        Raises:
          ValueError: an unknown name.
        """
        metrics = self.metrics if isinstance(self.metrics, Mapping) else vars(self.metrics)
        rows: list[dict[str, PyTree]] = [dict(setting) for setting in self.settings]
        last = _positive("last", last)
        for name in names:
            validation.choice("name of a metric", name, list(metrics))
            for row, values in zip(rows, np.asarray(metrics[name], float), strict=True):
                each = np.ma.masked_invalid(values[:, -last:]).mean(axis=1).compressed()
                row["seeds"] = len(values)
                row[name] = float(each.mean()) if len(each) else float("nan")
                deviation = each.std(ddof=1) if len(each) > 1 else float("nan")
                row[f"{name} deviation"] = float(deviation)
        return rows

    def table(self, *names: str, last: int = 1) -> str:
        """The :meth:`summary` as a table in Markdown, mean ± standard deviation.

        Args:
          names, last: as for :meth:`summary`.

        Raises:
          ValueError: an unknown name.
        """
        cells = [
            {
                name: f"{_text(x)} ± {_text(row[f'{name} deviation'])}"
                if name in names
                else _text(x)
                for name, x in row.items()
                if not name.endswith(" deviation")
            }
            for row in self.summary(*names, last=last)
        ]
        first, *others = [f"| {' | '.join(x)} |" for x in (cells[0], *(x.values() for x in cells))]
        return "\n".join([first, f"|{'---|' * len(cells[0])}", *others])


def _text(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def sweep(
    learner: HasSteps,
    keys: Key,
    problem: PyTree,
    hparams: PyTree,
    over: Mapping[str, Iterable[PyTree]] | Sequence[Mapping[str, PyTree]] = (),
    *,
    num_steps: int,
    max_rows: int = 1000,
    callback: Callable[[dict[str, PyTree], int, PyTree], object] | None = None,
) -> Sweep:
    """Runs of a learner for all seeds and settings, on all cores, each bit for bit the run by itself.

    One compiled program of a single run is called by a thread for each core, so that a run is
    ``learner.train(keys[n], problem, hparams)`` exactly, and compiles no longer. Lanes of a ``vmap``
    of ``train`` share their work instead, which is faster for tables and slower for networks, and
    rounds products of matrices differently. On accelerators the runs of a setting are such lanes.

    Args:
      learner: a module of the protocol :class:`~jaxltl.algos.common.learner.Learner`, such as ``ppo``.
      keys: random keys ``[N]``, one for each seed: ``jax.random.split(jax.random.key(0), N)``.
      problem, hparams: of the learner; those of all runs but for `over`.
      over: hyperparameters by name with their values, of which all combinations are run; or a sequence
        of settings, each with values by name. Static ones are compiled once for each value.
        Default: `hparams` alone.
      num_steps, max_rows: as for the learner's ``train``.
      callback: called after each run with its setting, the number of its seed and its metrics.

    Returns:
      The :class:`Sweep`; ``jl.plot.sweep`` draws it.

    Raises:
      ValueError: an unknown or invalid hyperparameter, or other keys.
    """
    num_steps = validation.integer("num_steps", num_steps, least=1, limit=MAX_STEPS)
    lengths = block_lengths(num_steps, _positive("max_rows", max_rows))
    _require_learner(learner)
    _require_keys(keys)
    _require_concrete(keys=keys, problem=problem, hparams=hparams)
    if callback is not None:
        validation.function("callback", callback)
    settings = _settings(hparams, over)
    each = tuple(replace(hparams, **setting) if setting else hparams for setting in settings)
    for one in each:
        require_hparams(one)
        if getattr(one, "sharding", None) is not None:
            raise ValueError(
                "hparams.sharding is set, and a run of a sweep has one device; set it to None, or "
                "use vmap_over_mesh."
            )
    require_arrays(problem=problem, hparams=each)
    run = _run_in_threads if jax.default_backend() == "cpu" else _run_as_lanes
    runs: dict[tuple[int, int], tuple[PyTree, PyTree]] = {}
    for (h, n), result in run(learner, keys, problem, each, lengths):
        runs[h, n] = result
        if callback is not None:
            callback(settings[h], n, result[1])
    table = [[runs[h, n] for n in range(len(keys))] for h in range(len(each))]
    stacked = [jax.tree.map(lambda *x: np.stack(x), *(x[1] for x in row)) for row in table]
    return Sweep(
        settings=settings,
        hparams=each,
        states=tuple(tuple(state for state, _ in row) for row in table),
        metrics=jax.tree.map(lambda *x: np.stack(x), *stacked),
        step=np.cumsum(lengths),
    )


Runs = Iterable[tuple[tuple[int, int], tuple[PyTree, PyTree]]]


def _run_in_threads(
    learner: HasSteps, keys: Key, problem: PyTree, hparams: Sequence[PyTree], lengths: np.ndarray
) -> Runs:
    """Runs as they end, of one program each, in a thread for each core."""
    x64 = jnp.result_type(float) == np.float64

    def run(program: Future[jax.stages.Compiled], *arguments: PyTree) -> tuple[PyTree, PyTree]:
        with enable_x64(x64):  # local to a thread
            return jax.block_until_ready(program.result()(*arguments))

    running: dict[Future[tuple[PyTree, PyTree]], tuple[int, int]] = {}
    pool = ThreadPoolExecutor(min(num_cores(), len(keys) * len(hparams)))
    try:
        for h, settings in enumerate(hparams):
            settings = jax.tree.map(jnp.asarray, settings)
            # Traced here, where JAX's settings are the caller's, and compiled while init is.
            state = jax.eval_shape(learner.init, keys[0], problem, settings)
            lowered = run_blocks.lower(learner.step, state, problem, settings, lengths)
            program = pool.submit(lowered.compile)
            for n in range(len(keys)):
                state = learner.init(keys[n], problem, settings)
                running[pool.submit(run, program, state, problem, settings, lengths)] = (h, n)
        for future in as_completed(running):
            state, metrics = future.result()
            yield running[future], (state, jax.device_get(metrics))
    finally:  # an interrupt drops the runs that have not begun
        pool.shutdown(cancel_futures=True)


def _run_as_lanes(
    learner: HasSteps, keys: Key, problem: PyTree, hparams: Sequence[PyTree], lengths: np.ndarray
) -> Runs:
    """Runs of each setting as lanes of one program."""

    def one(key: Key, settings: PyTree) -> tuple[PyTree, PyTree]:
        state = learner.init(key, problem, settings)
        return run_blocks(learner.step, state, problem, settings, lengths)

    lanes = jax.jit(jax.vmap(one, (0, None)))
    for h, settings in enumerate(hparams):
        states, metrics = lanes(keys, settings)
        metrics = jax.device_get(metrics)
        for n in range(len(keys)):
            yield (h, n), jax.tree.map(lambda x, n=n: x[n], (states, metrics))


def _require_keys(keys: Key) -> None:
    dtype = getattr(keys, "dtype", None)
    typed = dtype is not None and jnp.issubdtype(dtype, jax.dtypes.prng_key)
    if not (typed and keys.ndim == 1 and len(keys)):
        raise ValueError(
            f"keys is {validation.shorten(keys)}; give random keys [N], such as "
            "jax.random.split(jax.random.key(0), 8)."
        )


def _settings(hparams: PyTree, over: PyTree) -> tuple[dict[str, PyTree], ...]:
    """For each setting the values that vary by name."""
    if isinstance(over, Mapping):
        values = {name: _values(name, x) for name, x in over.items()}
        settings = [dict(zip(values, x, strict=True)) for x in itertools.product(*values.values())]
    else:
        settings = [dict(validation.instance("over", x, Mapping, "dicts")) for x in over] or [{}]
    known = {x.name for x in fields(hparams)} if is_dataclass(hparams) else set()
    for name in {x: None for setting in settings for x in setting}:
        if name not in known:
            raise ValueError(
                f"over has {name!r}, which is no hyperparameter; choose one of "
                f"{', '.join(sorted(known)) or 'none: hparams has no fields'}."
            )
    return tuple(settings)


def _values(name: str, values: PyTree) -> list[PyTree]:
    """The values of a hyperparameter, numbers of one type."""
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise ValueError(f"over[{name!r}] is {validation.shorten(values)}; give a list of values.")
    several = [x.item() if isinstance(x, jax.Array | np.generic) else x for x in values]
    if not several:
        raise ValueError(f"over[{name!r}] has no values; give one or more.")
    if any(type(x) is float for x in several):
        several = [float(x) if type(x) is int else x for x in several]
    return several
