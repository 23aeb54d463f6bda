"""Training loops: a fixed number of steps, or until a condition holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common.settings import require_arrays, require_hparams
from jaxltl.algos.common.trees import choose
from jaxltl.core import struct, validation
from jaxltl.core.models.mesh.cores import over_cores
from jaxltl.core.models.protocols import Array, Numeric, PyTree
from jaxltl.core.types import Status, worst

ProblemT = TypeVar("ProblemT")
HparamsT = TypeVar("HparamsT")
StateT = TypeVar("StateT")
MetricsT = TypeVar("MetricsT")
CarryT = TypeVar("CarryT")
ConstantsT = TypeVar("ConstantsT")

Step = Callable[[StateT, ProblemT, HparamsT], tuple[StateT, MetricsT]]
Until = Callable[[StateT, StateT, MetricsT], Numeric]

MAX_STEPS = np.iinfo(np.int32).max  # counters of steps are int32


def run(
    step: Step[StateT, ProblemT, HparamsT, MetricsT],
    state: StateT,
    problem: ProblemT,
    hparams: HparamsT,
    *,
    num_steps: int,
    max_rows: int = 1000,
) -> tuple[StateT, MetricsT]:
    """:meth:`~jaxltl.algos.common.learner.Learner.run` of a learner with this `step`."""
    num_steps = validation.integer("num_steps", num_steps, least=1, limit=MAX_STEPS)
    max_rows = validation.integer("max_rows", max_rows, least=1)
    require_arrays(state=state, problem=problem, hparams=hparams)
    require_hparams(hparams)
    return run_blocks(step, state, problem, hparams, block_lengths(num_steps, max_rows))


def block_lengths(num_steps: int, max_rows: int) -> np.ndarray:
    """Lengths of at most `max_rows` blocks of `num_steps` steps, equal but for the first."""
    stride = -(-num_steps // max_rows)
    lengths = np.full(-(-num_steps // stride), stride, np.int32)
    lengths[0] = num_steps - (num_steps - 1) // stride * stride
    return lengths


@partial(jax.jit, static_argnames="step")
def run_blocks(
    step: Step[StateT, ProblemT, HparamsT, MetricsT],
    state: StateT,
    problem: ProblemT,
    hparams: HparamsT,
    lengths: Array,
) -> tuple[StateT, MetricsT]:
    """Blocks of steps as one program; returns the metrics of each block's last step."""
    return over_cores(partial(_blocks, step), state, problem, hparams, lengths)


def _blocks(
    step: Step[StateT, ProblemT, HparamsT, MetricsT],
    state: StateT,
    problem: ProblemT,
    hparams: HparamsT,
    lengths: jax.Array,
) -> tuple[StateT, MetricsT]:
    empty = _zero_metrics(step, state, problem, hparams)

    def block(state: StateT, length: jax.Array) -> tuple[StateT, MetricsT]:
        return lax.fori_loop(
            0, length, lambda _, carry: step(carry[0], problem, hparams), (state, empty)
        )

    return lax.scan(block, state, lengths)


def _zero_metrics(step: Callable[..., tuple[PyTree, MetricsT]], *arguments: PyTree) -> MetricsT:
    # One trace of the step serves all: two could be compiled to different roundings.
    _, shape = jax.eval_shape(step, *arguments)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)


@struct.dataclass
class Learned:
    """Result of a run with a stopping condition; ``check`` accepts it.

    Attributes:
      state: the last state.
      metrics: of the last step.
      num_steps: ``int32[]``, steps of this run.
      status: ``int32[]``, COMPLETED if the condition was met, else MAX_STEPS; or worse, the status
        of the last step's metrics.
    """

    state: PyTree
    metrics: PyTree
    num_steps: jax.Array
    status: jax.Array

    @property
    def residual(self) -> jax.Array:
        """The last step's ``residual`` or ``gradient_norm``; NaN if the metrics have neither."""
        norm = getattr(self.metrics, "gradient_norm", jnp.full(self.status.shape, jnp.nan))
        return getattr(self.metrics, "residual", norm)


def run_until(
    step: Callable[..., tuple[StateT, MetricsT]],
    state: StateT,
    arguments: tuple[ProblemT, HparamsT, Until[StateT, MetricsT], Numeric],
    *,
    check_every: int = 1,
    keep: str = "after",
    idle: bool = False,
) -> Learned:
    """The ``run_until`` of a learner; `arguments`: problem, hyperparameters, condition and maximal steps.

    With `idle`, a fourth argument False of `step` keeps the state.
    """
    problem, hparams, until, num_steps = arguments
    validation.choice("keep", keep, ("after", "before"))
    if idle and (check_every, keep) != (1, "after"):
        raise ValueError('idle=True requires check_every=1 and keep="after".')
    for name, number in {"num_steps": num_steps, "check_every": check_every}.items():
        if not isinstance(number, jax.Array):
            validation.integer(name, number, least=1, limit=MAX_STEPS)
    until = until if isinstance(until, Partial) else Partial(validation.function("until", until))
    require_arrays(state=state, problem=problem, hparams=hparams, until=until)
    require_hparams(hparams)
    arrays = (problem, hparams, until, jnp.asarray(num_steps, jnp.int32))
    return _run_until(step, state, arrays, check_every, keep, idle)


@struct.dataclass
class RunProgress:
    """A run: `state` and `metrics` of the last step, `count` of steps, and `done`, the condition's value."""

    state: PyTree
    metrics: PyTree
    count: jax.Array
    done: jax.Array


@partial(jax.jit, static_argnames=("step", "check_every", "keep", "idle"))
def _run_until(
    step: Callable[..., tuple[PyTree, PyTree]],
    state: PyTree,
    arguments: tuple[PyTree, ...],
    check_every: int,
    keep: str,
    idle: bool,
) -> Learned:
    return over_cores(partial(_loop, step, check_every, keep, idle), state, arguments)


def _loop(
    step: Callable[..., tuple[PyTree, PyTree]],
    check_every: int,
    keep: str,
    idle: bool,
    state: PyTree,
    arguments: tuple[PyTree, ...],
) -> Learned:
    def active(carry: tuple[RunProgress, PyTree], arguments: tuple[PyTree, ...]) -> jax.Array:
        return ~carry[0].done & (carry[0].count < arguments[-1])

    def body(
        carry: tuple[RunProgress, PyTree], arguments: tuple[PyTree, ...]
    ) -> tuple[RunProgress, PyTree]:
        going, (problem, hparams, until, _) = active(carry, arguments), arguments
        now, window = carry
        before = now.state if window is None else window
        after, metrics = step(now.state, problem, hparams, *([going] if idle else []))
        number = now.count + 1
        due = number % check_every == 0
        done = due & jnp.asarray(until(before, after, metrics))
        last = choose(done, before, after) if keep == "before" else after
        new = RunProgress(last, metrics, jnp.where(going, number, now.count), done & going)
        if idle:  # the step left the state of a finished lane unchanged
            metrics = choose(going, metrics, now.metrics)
            new = replace(new, metrics=metrics, done=new.done | now.done)
        else:
            new = choose(going, new, now)
        return new, None if window is None else choose(due, new.state, window)

    problem, hparams, *_ = arguments
    empty = _zero_metrics(step, state, problem, hparams, *([jnp.bool_(True)] if idle else []))
    begin = RunProgress(state, empty, jnp.int32(0), jnp.bool_(False))
    end, _ = while_active(active, body, (begin, None if check_every == 1 else state), arguments)
    status = jnp.where(end.done, Status.COMPLETED, Status.MAX_STEPS).astype(jnp.int32)
    return Learned(
        end.state, end.metrics, end.count, worst(status, getattr(end.metrics, "status", status))
    )


def while_active(
    active: Callable[[CarryT, ConstantsT], jax.Array],
    body: Callable[[CarryT, ConstantsT], CarryT],
    carry: CarryT,
    constants: ConstantsT,
) -> CarryT:
    """``while active(carry, constants): carry = body(carry, constants)`` without masking under ``vmap``.

    A vmapped ``lax.while_loop`` copies all arrays of finished lanes in every iteration. Here `body`
    must return the carry of an inactive lane unchanged, so that only written entries are touched.
    """
    carry, constants = jax.tree.map(jnp.asarray, (carry, constants))

    @jax.custom_batching.custom_vmap
    def loop(carry: CarryT, constants: ConstantsT) -> CarryT:
        return lax.while_loop(lambda c: active(c, constants), lambda c: body(c, constants), carry)

    @loop.def_vmap
    def _(
        size: int, batched: PyTree, carry: CarryT, constants: ConstantsT
    ) -> tuple[CarryT, PyTree]:
        lanes, shared = batched
        carry = jax.tree.map(
            lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape)), carry, lanes
        )
        axes = (0, jax.tree.map(lambda b: 0 if b else None, shared))
        last = lax.while_loop(
            lambda c: jnp.any(jax.vmap(active, axes)(c, constants)),
            lambda c: jax.vmap(body, axes)(c, constants),
            carry,
        )
        return last, jax.tree.map(lambda _: True, lanes)

    return loop(carry, constants)
