"""What all learners share: one loop, progress, and resuming bitwise.

A learner is a module with ``init(key, problem, hparams) -> State`` and
``step(state, problem, hparams) -> (State, Metrics)``, both pure. From these follow
its ``run`` and ``train``::

    run = partial(learner.run, step)
    train = partial(learner.train, init, step)
"""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax import lax

Init = Callable[..., Any]
Step = Callable[..., tuple[Any, Any]]


@partial(jax.jit, static_argnames=("step", "num_steps", "max_rows"))
def run(
    step: Step, state: Any, problem: Any, hparams: Any, *, num_steps: int, max_rows: int = 1000
) -> tuple[Any, Any]:
    """`num_steps` steps of a learner, compiled as one loop.

    Args:
      step: the learner's step.
      state: where to go on from.
      problem, hparams: arrays; new values do not recompile.
      num_steps: static.
      max_rows: metrics are kept of at most this many evenly spaced steps, always
        including the last, so memory does not grow with `num_steps`.

    Returns:
      The state after the last step, and metrics with a leading axis of rows.

    Raises:
      ValueError: num_steps or max_rows is not positive.
    """
    if num_steps < 1 or max_rows < 1:
        raise ValueError(f"num_steps={num_steps}, max_rows={max_rows}; both must be at least 1.")
    stride = -(-num_steps // max_rows)
    # The first block is the short one, so that every row ends a full stride.
    first = num_steps - (num_steps - 1) // stride * stride

    # One trace of the step serves all: two could be compiled to different roundings.
    _, shape = jax.eval_shape(step, state, problem, hparams)
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)

    def block(state: Any, length: jax.Array) -> tuple[Any, Any]:
        return lax.fori_loop(
            0, length, lambda _, carry: step(carry[0], problem, hparams), (state, empty)
        )

    lengths = jnp.full(-(-num_steps // stride), stride).at[0].set(first)
    return lax.scan(block, state, lengths)


def train(
    init: Init,
    step: Step,
    key: chex.PRNGKey,
    problem: Any,
    hparams: Any,
    *,
    num_steps: int,
    max_rows: int = 1000,
) -> tuple[Any, Any]:
    """:func:`run` from a fresh state; ``vmap`` it over keys for a sweep of seeds."""
    state = init(key, problem, hparams)
    return run(step, state, problem, hparams, num_steps=num_steps, max_rows=max_rows)


def while_active(
    active: Callable[..., Any], body: Callable[..., Any], carry: Any, given: Any
) -> Any:
    """``while active(carry, given): carry = body(carry, given)``, cheap under ``vmap``.

    A vmapped ``lax.while_loop`` copies all of a finished lane's arrays in every pass to keep
    them as they are. Here `body` promises to leave a finished lane as it is, so that an
    entry that it writes is all that is touched.

    Args:
      active: whether a lane goes on, ``bool[]``.
      body: changes nothing in a lane that does not.
      carry, given: what changes and what does not.
    """
    carry, given = jax.tree.map(jnp.asarray, (carry, given))

    @jax.custom_batching.custom_vmap
    def loop(carry: Any, given: Any) -> Any:
        return lax.while_loop(lambda c: active(c, given), lambda c: body(c, given), carry)

    @loop.def_vmap
    def _(size: int, batched: Any, carry: Any, given: Any) -> Any:
        lanes, shared = batched
        carry = jax.tree.map(
            lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape)), carry, lanes)
        axes = (0, jax.tree.map(lambda b: 0 if b else None, shared))
        found = lax.while_loop(
            lambda c: jnp.any(jax.vmap(active, axes)(c, given)),
            lambda c: jax.vmap(body, axes)(c, given), carry,
        )
        return found, jax.tree.map(lambda _: True, lanes)

    return loop(carry, given)


def run_in_chunks(
    step: Step,
    state: Any,
    problem: Any,
    hparams: Any,
    *,
    num_steps: int,
    chunk: int = 50,
    report: Callable[[int, Any], None] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> tuple[Any, Any]:
    """The same steps in compiled chunks, with a report and a saved state after each.

    Args:
      step, state, problem, hparams: as for :func:`run`.
      num_steps: the step counter to reach: a state that has already made some steps
        (``state.step``) makes only the rest.
      chunk: steps between reports.
      report: called with the steps made and the newest metrics.
      checkpoint: a file that holds the state after every chunk, written atomically. If
        it exists, the run goes on from it.

    Returns:
      The state, and the metrics of the steps made in this call (None if there were none).

    Raises:
      ValueError: the checkpoint belongs to another learner or problem.
    """
    if checkpoint is not None and os.path.exists(checkpoint):
        state = load(checkpoint, state)
    rows = []
    while (done := int(np.max(state.step))) < num_steps:
        state, metrics = run(
            step, state, problem, hparams, num_steps=min(chunk, num_steps - done)
        )
        rows.append(jax.device_get(metrics))
        if checkpoint is not None:
            save(checkpoint, state)
        if report is not None:
            report(int(np.max(state.step)), jax.tree.map(lambda x: x[-1], rows[-1]))
    if not rows:
        return state, None
    return state, jax.tree.map(lambda *x: np.concatenate(x), *rows)


# --- optimisers --------------------------------------------------------------------------


def optimizer(name: str, learning_rate: Any) -> optax.GradientTransformationExtraArgs:
    """One of optax's: ``"lbfgs"``, ``"adam"``, ``"rmsprop"`` or ``"sgd"``.

    Args:
      name: which one.
      learning_rate: of all but ``"lbfgs"``, which searches along its lines.

    Raises:
      ValueError: an unknown name.
    """
    if name == "lbfgs":
        return optax.lbfgs()
    kinds = {"adam": optax.scale_by_adam, "rmsprop": optax.scale_by_rms, "sgd": optax.identity}
    if name not in kinds:
        raise ValueError(f"optimizer={name!r}; choose one of {', '.join(('lbfgs', *kinds))}.")
    rate = optax.scale_by_learning_rate(learning_rate)
    return optax.with_extra_args_support(optax.chain(kinds[name](), rate))


# --- early stopping ------------------------------------------------------------------------


@struct.dataclass
class Best:
    """The parameters with the best held-out likelihood; without held-out data the newest.

    Attributes:
      parameters: of the network.
      neg_log_likelihood: held out, per pair; NaN without held-out data.
      step: the number of steps after which they were reached.
    """

    parameters: Any
    neg_log_likelihood: jax.Array
    step: jax.Array


def stop_early(
    state: Any, after: Any, held_out: jax.Array, judged: jax.Array, patience: jax.Array | int
) -> tuple[Best, jax.Array]:
    """The best parameters so far, and whether patience has run out.

    Args:
      state: before a step, with ``parameters``, ``step``, ``best`` and ``stopped``.
      after: the parameters after it.
      held_out: negative log-likelihood of the parameters before it.
      judged: whether there is held-out data.
      patience: steps without anything better after which learning stops.
    """
    better = judged & (held_out < state.best.neg_log_likelihood) & ~state.stopped
    best = choose(better, Best(state.parameters, held_out, state.step), state.best)
    newest = Best(after, jnp.full_like(held_out, jnp.nan), state.step + 1)
    stopped = state.stopped | (judged & (state.step - best.step >= patience))
    return choose(judged, best, newest), stopped


def choose(condition: jax.Array, one: Any, other: Any) -> Any:
    """``jnp.where`` on trees; keys, which steps do not change, are those of `one`."""
    def leaf(x: jax.Array, y: jax.Array) -> jax.Array:
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return x if is_key else jnp.where(condition, x, y)

    return jax.tree.map(leaf, one, other)


# --- files ---------------------------------------------------------------------------------


@contextlib.contextmanager
def atomic_write(path: str | os.PathLike[str]):
    """A binary file that appears under its name only when complete.

    Raises:
      ValueError: the place cannot be written to.
    """
    path = Path(path)
    try:
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise ValueError(
            f"cannot write {str(path)!r}: {error.strerror}; choose a directory that exists and is "
            "writable."
        ) from error
    try:
        with os.fdopen(handle, "wb") as file:
            yield file
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def save(path: str | os.PathLike[str], state: Any) -> None:
    """Writes a learner's state as an ``.npz``, atomically.

    Raises:
      ValueError: the place cannot be written to.
    """
    arrays: dict[str, Any] = {name: np.asarray(_data(leaf)) for name, leaf in _named(state)}
    with atomic_write(path) as file:
        np.savez(file, **arrays)


def load(path: str | os.PathLike[str], like: Any) -> Any:
    """Reads a state saved by :func:`save`, bit for bit.

    Args:
      path: the file.
      like: a state of the same learner and problem (for example from ``init``).

    Raises:
      ValueError: the file is damaged, or its arrays do not fit `like`.
    """
    try:
        # An open file of our own is closed even where a damaged archive is given up.
        with open(path, "rb") as handle, np.load(handle, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{str(path)!r} is not a saved state: {error}") from error
    leaves = []
    for name, leaf in _named(like):
        expected = _data(leaf)
        found = arrays.get(name)
        if found is None or found.shape != expected.shape or found.dtype != expected.dtype:
            is_ = "missing" if found is None else f"{found.dtype}{list(found.shape)}"
            raise ValueError(
                f"{str(path)!r} does not belong to this run: {name} is {is_}, expected "
                f"{expected.dtype}{list(expected.shape)}. Delete the file to start afresh."
            )
        value = jnp.asarray(found)
        if expected is not leaf:
            value = jax.random.wrap_key_data(value, impl=jax.random.key_impl(leaf))
        leaves.append(value)
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


def _named(tree: Any) -> list[tuple[str, Any]]:
    """Leaves with distinct file-safe names, whose numbers keep nested paths apart."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return [
        (f"{i}{jax.tree_util.keystr(path)}".replace("/", "_"), jnp.asarray(leaf))
        for i, (path, leaf) in enumerate(leaves)
    ]


def _data(leaf: jax.Array) -> jax.Array:
    is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return jax.random.key_data(leaf) if is_key else leaf
