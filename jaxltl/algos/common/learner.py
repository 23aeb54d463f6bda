"""What all learners share: one loop, ended early or not.

A learner is a module with ``init(key, problem, hparams) -> State`` and
``step(state, problem, hparams) -> (State, Metrics)``, both pure. From these follows the rest::

    run, train, run_until, train_until = learner.bind(init, step)

What was learned is ``policy(state, problem, hparams)``. The root key stays in the state: what step
n draws comes from ``step_key(state)``, the key with n folded in, and what ``init`` draws from
``init_key(key)``, a number that no step reaches.

Example: a learner of one's own, of a number that is asked for.

  >>> import jax, jax.numpy as jnp
  >>> from flax import struct
  >>> from jaxltl.algos.common import learner
  >>> @struct.dataclass
  ... class State:
  ...     key: jax.Array
  ...     step: jax.Array
  ...     guess: jax.Array
  >>> @struct.dataclass
  ... class Metrics:
  ...     error: jax.Array
  ...     status: jax.Array
  >>> def init(key, problem, hparams):
  ...     return State(key, jnp.int32(0), jax.random.normal(learner.init_key(key)))
  >>> def step(state, problem, hparams):
  ...     guess = state.guess + hparams * (problem - state.guess)
  ...     return (State(state.key, state.step + 1, guess),
  ...             Metrics(jnp.abs(guess - problem), jnp.int32(0)))
  >>> run, train, run_until, train_until = learner.bind(init, step)
  >>> state, metrics = train(jax.random.key(0), 5.0, 0.5, num_steps=4)
  >>> state.step.item(), metrics.error.shape, bool(metrics.error[3] < metrics.error[0])
  (4, (4,), True)
  >>> learned = train_until(jax.random.key(0), 5.0, 0.5, num_steps=100,
  ...                       until=lambda before, after, metrics: metrics.error < 1e-3)
  >>> learned.status.item(), learned.num_steps.item() < 20
  (0, True)
  >>> lengths = learner.block_lengths(4, 2)  # metrics of every other step
  >>> learner.run_blocks(step, state, 5.0, 0.5, lengths)[1].error.shape
  (2,)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax import lax
from jax.tree_util import Partial

from jaxltl.algos.common.settings import require_arrays
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import Status, worst
from jaxltl.core import validation

Init = Callable[..., Any]
Step = Callable[..., tuple[Any, Any]]
Until = Callable[[Any, Any, Any], Any]

MOST = np.iinfo(np.int32).max  # counters stay here; see `count`


def init_key(key: chex.PRNGKey) -> chex.PRNGKey:
    """The key of what ``init`` draws; no step folds in as large a number.

    Args:
      key: the root key.

    Returns:
      A PRNG key.
    """
    return jax.random.fold_in(key, 0xFFFFFFFF)


def step_key(state: Any) -> chex.PRNGKey:
    """The key of what the next step draws: the root key with the number of steps folded in.

    Args:
      state: of any learner, with ``key`` and ``step``.

    Returns:
      A PRNG key.

    Example:
      >>> from types import SimpleNamespace
      >>> one, two = (SimpleNamespace(key=jax.random.key(0), step=step) for step in (0, 1))
      >>> bool(step_key(one) == step_key(two))
      False
    """
    return jax.random.fold_in(state.key, state.step)


def count(total: jax.Array, more: jax.Array | int) -> jax.Array:
    """``total + more`` of counters ``int32``, which stay at ``2 ** 31 - 1`` once they are there.

    Args:
      total: ``int32``.
      more: at least 0.

    Returns:
      ``int32``.

    Example:
      >>> count(jnp.int32(5), 3).item()
      8
    """
    more = jnp.asarray(more, jnp.int32)
    return jnp.where(total > MOST - more, MOST, total + more).astype(jnp.int32)


def run(
    step: Step, state: Any, problem: Any, hparams: Any, *, num_steps: int, max_rows: int = 1000
) -> tuple[Any, Any]:
    """`num_steps` steps of a learner's `step`; the rest is as for the ``run`` of :func:`bind`.

    Args:
      step: the learner's.
      state, problem, hparams, num_steps, max_rows: as there.

    Returns:
      The state, and metrics with a first axis of rows.

    Raises:
      ValueError: num_steps or max_rows is not positive.
    """
    num_steps, max_rows = (
        x if isinstance(x, int) else validation.integer(name, x, least=1)
        for name, x in (("num_steps", num_steps), ("max_rows", max_rows))
    )
    if num_steps < 1 or max_rows < 1:
        raise ValueError(f"num_steps={num_steps}, max_rows={max_rows}; both must be at least 1.")
    if num_steps > MOST:
        raise ValueError(f"num_steps={num_steps}; at most {MOST} are made at once.")
    require_arrays(state=state, problem=problem, hparams=hparams)
    return run_blocks(step, state, problem, hparams, block_lengths(num_steps, max_rows))


def block_lengths(num_steps: int, max_rows: int) -> np.ndarray:
    """Of at most so many blocks of steps; the first is short, so that rows end full strides.

    Args:
      num_steps: of all blocks.
      max_rows: blocks at most.

    Returns:
      ``int32[rows]``.
    """
    stride = -(-num_steps // max_rows)
    lengths = np.full(-(-num_steps // stride), stride, np.int32)
    lengths[0] = num_steps - (num_steps - 1) // stride * stride
    return lengths


@partial(jax.jit, static_argnames="step")
def run_blocks(step: Step, state: Any, problem: Any, hparams: Any, lengths: jax.Array) -> Any:
    """Blocks of steps, as one program.

    Args:
      step, state, problem, hparams: as for :func:`run`.
      lengths: ``int32[rows]``, of the blocks.

    Returns:
      The state, and the metrics of each block's last step.
    """
    empty = _no_metrics(step, state, problem, hparams)

    def block(state: Any, length: jax.Array) -> tuple[Any, Any]:
        return lax.fori_loop(
            0, length, lambda _, carry: step(carry[0], problem, hparams), (state, empty)
        )

    return lax.scan(block, state, lengths)


def _no_metrics(step: Step, *arguments: Any) -> Any:
    # One trace of the step serves all: two could be compiled to different roundings.
    _, shape = jax.eval_shape(step, *arguments)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)


# --- ended early ----------------------------------------------------------------------------


@brief(codes={"status": Status})
@struct.dataclass
class Learned:
    """What a run that ends early ends with; ``check`` accepts it.

    Attributes:
      state: where it ended.
      metrics: of the last step.
      num_steps: ``int32[]``, steps made by this run.
      status: ``int32[]``, CONVERGED if the condition was met, MAX_STEPS if it was not; or worse, as
        the last step's metrics say.
    """

    state: Any
    metrics: Any
    num_steps: jax.Array
    status: jax.Array

    @property
    def residual(self) -> jax.Array:
        """Of the last step's metrics, or their ``gradient_norm``; NaN if they have neither."""
        norm = getattr(self.metrics, "gradient_norm", jnp.full(self.status.shape, jnp.nan))
        return getattr(self.metrics, "residual", norm)


def run_until(
    step: Step,
    state: Any,
    problem: Any,
    hparams: Any,
    *,
    until: Until,
    num_steps: chex.Numeric,
    check_every: int = 1,
    keep: str = "after",
    idle: bool = False,
) -> Learned:
    """Steps until a condition is met: as the ``run_until`` of :func:`bind`, but for these.

    Args:
      step: the learner's step.
      state, problem, hparams, until, num_steps, check_every, keep: as there.
      idle: whether the step takes another argument, ``bool[]``, and by itself leaves alone a
        state for which that is False; else its arrays are chosen one by one; static.

    Returns:
      :class:`Learned`.

    Raises:
      ValueError: an unknown `keep`, or a number below 1.
    """
    if keep not in ("after", "before"):
        raise ValueError(f'keep={keep!r}; choose "after" or "before".')
    if idle and (check_every, keep) != (1, "after"):
        raise ValueError('idle=True goes with check_every=1 and keep="after".')
    for name, number in {"num_steps": num_steps, "check_every": check_every}.items():
        if not isinstance(number, jax.Array):
            validation.integer(name, number, least=1, most=MOST)
    until = until if isinstance(until, Partial) else Partial(validation.function("until", until))
    require_arrays(state=state, problem=problem, hparams=hparams, until=until)
    most = jnp.asarray(num_steps, jnp.int32)
    return _run_until(step, state, problem, hparams, until, most, check_every, keep, idle)


@struct.dataclass
class Progress:
    """A run on its way.

    Attributes:
      state, metrics: as the last step left them.
      count: ``int32[]``, steps asked for.
      done: ``bool[]``, whether the condition was met.

    Example:
      >>> Progress(0.5, {}, jnp.int32(3), jnp.bool_(False)).count.item()
      3
    """

    state: Any
    metrics: Any
    count: jax.Array
    done: jax.Array


@partial(jax.jit, static_argnames=("step", "check_every", "keep", "idle"))
def _run_until(step, state, problem, hparams, until, most, check_every, keep, idle) -> Learned:
    def active(carry: Any, given: Any) -> jax.Array:
        return ~carry[0].done & (carry[0].count < given[-1])

    def body(carry: Any, given: Any) -> Any:
        going, (problem, hparams, until, _) = active(carry, given), given
        now, window = carry
        before = now.state if window is None else window
        arguments = (now.state, problem, hparams, *([going] if idle else []))
        after, metrics = step(*arguments)
        number = now.count + 1
        due = number % check_every == 0
        done = due & jnp.asarray(until(before, after, metrics))
        last = choose(done, before, after) if keep == "before" else after
        new = Progress(last, metrics, jnp.where(going, number, now.count), done & going)
        if idle:  # `after` is as it was where nothing is to go on
            metrics = choose(going, metrics, now.metrics)
            new = replace(new, metrics=metrics, done=new.done | now.done)
        else:
            new = choose(going, new, now)
        return new, None if window is None else choose(due, new.state, window)

    empty = _no_metrics(step, state, problem, hparams, *([jnp.bool_(True)] if idle else []))
    begin = Progress(state, empty, jnp.int32(0), jnp.bool_(False))
    window = None if check_every == 1 else state
    found, _ = while_active(active, body, (begin, window), (problem, hparams, until, most))
    status = jnp.where(found.done, Status.CONVERGED, Status.MAX_STEPS).astype(jnp.int32)
    said = getattr(found.metrics, "status", status)
    return Learned(found.state, found.metrics, found.count, worst(status, said))


def has_stopped(before: Any, after: Any, metrics: Any) -> jax.Array:
    """A condition for :func:`run_until`: the learner has stopped early, as its state says.

    Args:
      before, after, metrics: as ``until`` is given them.

    Returns:
      ``bool[]``.

    Example:
      >>> from types import SimpleNamespace
      >>> has_stopped(None, SimpleNamespace(stopped=True), None)
      True
    """
    return after.stopped


def gradient_vanishes(tolerance: chex.Numeric) -> Until:
    """A condition for :func:`run_until`: the gradient's norm is at most a tolerance.

    Args:
      tolerance: at least 0; traced.

    Returns:
      A condition, for ``until``.

    Example:
      >>> from types import SimpleNamespace
      >>> gradient_vanishes(1e-3)(None, None, SimpleNamespace(gradient_norm=1e-4))
      True
    """
    return Partial(_gradient_vanishes, tolerance)


def _gradient_vanishes(tolerance: Any, before: Any, after: Any, metrics: Any) -> jax.Array:
    return metrics.gradient_norm <= tolerance


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

    Returns:
      The carry, once no lane is active.

    Example:
      >>> def half(x, most):  # leaves what is small alone
      ...     return jnp.where(x > most, x / 2, x)
      >>> run = jax.vmap(lambda x: while_active(lambda x, most: x > most, half, x, 1.0))
      >>> run(jnp.array([0.5, 4.0])).tolist()
      [0.5, 1.0]
    """
    carry, given = jax.tree.map(jnp.asarray, (carry, given))

    @jax.custom_batching.custom_vmap
    def loop(carry: Any, given: Any) -> Any:
        return lax.while_loop(lambda c: active(c, given), lambda c: body(c, given), carry)

    @loop.def_vmap
    def _(size: int, batched: Any, carry: Any, given: Any) -> Any:
        lanes, shared = batched
        carry = jax.tree.map(
            lambda x, b: x if b else jnp.broadcast_to(x, (size, *x.shape)), carry, lanes
        )
        axes = (0, jax.tree.map(lambda b: 0 if b else None, shared))
        found = lax.while_loop(
            lambda c: jnp.any(jax.vmap(active, axes)(c, given)),
            lambda c: jax.vmap(body, axes)(c, given),
            carry,
        )
        return found, jax.tree.map(lambda _: True, lanes)

    return loop(carry, given)


# --- the functions of a learner --------------------------------------------------------------


@brief
class Bound(NamedTuple):
    """What follows from a learner's ``init`` and ``step``; each has its own help.

    Attributes:
      run: steps from a state.
      train: the same from a key.
      run_until, train_until: the same until a condition is met.
    """

    run: Callable[..., tuple[Any, Any]]
    train: Callable[..., tuple[Any, Any]]
    run_until: Callable[..., Learned]
    train_until: Callable[..., Learned]


def bind(init: Init, step: Step, *, step_if: Step | None = None, keep: str = "after") -> Bound:
    """The functions that run and train a learner, to the end or until a condition is met.

    They are plain functions of the module that `step` is of, and are to stand there by these names.

    Args:
      init: ``(key, problem, hparams) -> State``.
      step: ``(state, problem, hparams) -> (State, Metrics)``.
      step_if: a step that takes another argument, ``bool[]``, and by itself leaves alone a state
        for which that is False; for runs that end early. Default: arrays are chosen one by one.
      keep: the default of that argument.

    Returns:
      :class:`Bound`.
    """
    both = (
        *_whole(init, step),
        *_early(init, step if step_if is None else step_if, keep, step_if is not None),
    )
    for name, function in zip(Bound._fields, both, strict=True):
        function.__name__ = function.__qualname__ = name
        function.__module__ = step.__module__
    return Bound(*both)


def _whole(init: Init, step: Step) -> tuple[Callable[..., Any], Callable[..., Any]]:
    def from_state(
        state: Any, problem: Any, hparams: Any, *, num_steps: int, max_rows: int = 1000
    ) -> tuple[Any, Any]:
        """`num_steps` steps from a state, compiled as one loop.

        Args:
          state: where to go on from.
          problem, hparams: arrays; new values do not recompile.
          num_steps: a number; another one with as many rows does not recompile.
          max_rows: metrics are kept of at most this many evenly spaced steps, always
            including the last, so memory does not grow with `num_steps`.

        Returns:
          The ``State`` after the last step, and ``Metrics`` with a leading axis of rows.

        Raises:
          ValueError: num_steps or max_rows is not positive.
        """
        return run(step, state, problem, hparams, num_steps=num_steps, max_rows=max_rows)

    def from_key(
        key: chex.PRNGKey, problem: Any, hparams: Any, *, num_steps: int, max_rows: int = 1000
    ) -> tuple[Any, Any]:
        """A fresh state and `num_steps` steps from it; ``vmap`` it over keys for many seeds.

        Args:
          key: of ``init(key, problem, hparams)``; the state keeps it.
          problem, hparams, num_steps, max_rows: as for ``run``.

        Returns:
          The ``State`` after the last step, and ``Metrics`` with a leading axis of rows.

        Raises:
          ValueError: num_steps or max_rows is not positive.
        """
        state = init(key, problem, hparams)
        return from_state(state, problem, hparams, num_steps=num_steps, max_rows=max_rows)

    return from_state, from_key


def _early(
    init: Init, step: Step, kept: str, idle: bool
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    def from_state(
        state: Any,
        problem: Any,
        hparams: Any,
        *,
        until: Until,
        num_steps: chex.Numeric,
        check_every: int = 1,
        keep: str = kept,
    ) -> Learned:
        """Steps until a condition is met, or `num_steps` of them. Under ``jit`` and ``vmap``.

        Under ``vmap`` a run that has ended stays as it is while others go on.

        Args:
          state: where to go on from.
          problem, hparams: arrays; new values do not recompile.
          until: ``(before, after, metrics) -> bool[]``: the states before and after some steps
            and the metrics of the last of them. Traced numbers go into
            ``jax.tree_util.Partial(function, *numbers)``, with which new ones do not recompile; a
            new function does.
          num_steps: steps at most; traced.
          check_every: steps between `before` and `after`; static.
          keep: which state a run ends with that met the condition, ``"after"`` or ``"before"``:
            the one that the learner's metrics describe; static.

        Returns:
          :class:`~jaxltl.algos.common.learner.Learned`: the state, its metrics, the number of steps and
          the status; :func:`~jaxltl.check` accepts it.

        Raises:
          ValueError: an unknown `keep`, or a number below 1.
        """
        return run_until(
            step,
            state,
            problem,
            hparams,
            until=until,
            num_steps=num_steps,
            check_every=check_every,
            keep=keep,
            idle=idle,
        )

    def from_key(
        key: chex.PRNGKey,
        problem: Any,
        hparams: Any,
        *,
        until: Until,
        num_steps: chex.Numeric,
        check_every: int = 1,
        keep: str = kept,
    ) -> Learned:
        """A fresh state and steps until a condition is met; ``vmap`` it over keys for many seeds.

        Args:
          key: of ``init(key, problem, hparams)``; the state keeps it.
          problem, hparams, until, num_steps, check_every, keep: as for ``run_until``.

        Returns:
          :class:`~jaxltl.algos.common.learner.Learned`: the state, its metrics, the number of steps and
          the status; :func:`~jaxltl.check` accepts it.

        Raises:
          ValueError: an unknown `keep`, or a number below 1.
        """
        return from_state(
            init(key, problem, hparams),
            problem,
            hparams,
            until=until,
            num_steps=num_steps,
            check_every=check_every,
            keep=keep,
        )

    return from_state, from_key


# --- optimisers --------------------------------------------------------------------------


def optimizer(name: str, learning_rate: Any) -> optax.GradientTransformationExtraArgs:
    """One of optax's: ``"lbfgs"``, ``"adam"``, ``"rmsprop"`` or ``"sgd"``.

    Args:
      name: which one.
      learning_rate: of all but ``"lbfgs"``, which searches along its lines.

    Returns:
      The gradient transformation.

    Raises:
      ValueError: an unknown name.

    Example:
      >>> optimizer("adam", 1e-3).init(jnp.zeros(2))[0].mu.shape
      (2,)
    """
    if name == "lbfgs":
        return optax.lbfgs()
    kinds = {"adam": optax.scale_by_adam, "rmsprop": optax.scale_by_rms, "sgd": optax.identity}
    if name not in kinds:
        raise ValueError(f"optimizer={name!r}; choose one of {', '.join(('lbfgs', *kinds))}.")
    rate = optax.scale_by_learning_rate(learning_rate)
    return optax.with_extra_args_support(optax.chain(kinds[name](), rate))


# --- trees ----------------------------------------------------------------------------------


def strong(tree: Any) -> Any:
    """Arrays whose type is not weak, so that the first chunk's program serves the others too.

    Args:
      tree: any tree of arrays.

    Returns:
      The same tree.

    Example:
      >>> number = jnp.asarray(1.0)
      >>> number.weak_type, strong({"x": number})["x"].weak_type
      (True, False)
    """

    def one(x: jax.Array) -> jax.Array:
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return x if is_key else lax.convert_element_type(x, x.dtype)

    return jax.tree.map(one, tree)


def either(condition: jax.Array, one: Any, other: Any) -> Any:
    """As :func:`choose`, as one branch, which compiles sooner than a choice of each array.

    Args:
      condition: ``bool[]``.
      one, other: trees of the same structure.

    Returns:
      The first where the condition holds, else the second.

    Example:
      >>> either(jnp.bool_(False), {"x": jnp.zeros(2)}, {"x": jnp.ones(2)})["x"].tolist()
      [1.0, 1.0]
    """
    return lax.cond(condition, lambda: one, lambda: other)


def choose(condition: jax.Array, one: Any, other: Any) -> Any:
    """``jnp.where`` on trees; keys, which steps do not change, are those of `one`.

    Args:
      condition: ``bool[]``.
      one, other: trees of the same structure.

    Returns:
      The first where the condition holds, else the second.

    Example:
      >>> choose(jnp.bool_(False), {"x": jnp.zeros(2)}, {"x": jnp.ones(2)})["x"].tolist()
      [1.0, 1.0]
    """

    def leaf(x: jax.Array, y: jax.Array) -> jax.Array:
        is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return x if is_key else jnp.where(condition, x, y)

    return jax.tree.map(leaf, one, other)
