"""Learner protocol: binds init and step to the training loops; random keys, early stopping.

A learner is a module with the members of :class:`Learner`. It writes two pure functions, ``_init``
and ``_step``; :func:`bind` checks hyperparameters and adds the loops::

    init, step, run, train, run_until, train_until = learner.bind(_init, _step)

The root key stays in the state: step n draws from ``step_key(state)``, the key with n folded in,
and ``init`` from ``init_key(key)``, a number that no step reaches.

Example: a learner of the fixed point of ``x -> (1 - rate) x + rate * target``.
  >>> import jax, jax.numpy as jnp
  >>> from jaxltl.core import struct
  >>> import jaxltl as jl
  >>> from jaxltl.algos.common import learner
  >>> from jaxltl.algos.common.settings import traced
  >>> from jaxltl.core.validation import Range
  >>> @struct.dataclass
  ... class Hparams:
  ...     rate: jax.Array | float = traced(Range(0, 1), default=0.5)
  >>> @struct.dataclass
  ... class State:
  ...     key: jax.Array
  ...     step: jax.Array
  ...     guess: jax.Array
  >>> @struct.dataclass
  ... class Metrics:
  ...     error: jax.Array
  ...     status: jax.Array
  >>> def _init(key, problem, hparams):
  ...     return State(key, jnp.int32(0), jax.random.normal(learner.init_key(key)))
  >>> def _step(state, problem, hparams):
  ...     guess = state.guess + hparams.rate * (problem - state.guess)
  ...     return (State(state.key, state.step + 1, guess),
  ...             Metrics(jnp.abs(guess - problem), jnp.int32(jl.Status.COMPLETED)))
  >>> init, step, run, train, run_until, train_until = learner.bind(_init, _step)
  >>> state, metrics = train(jax.random.key(0), 5.0, Hparams(), num_steps=4)
  >>> state.step.item(), metrics.error.shape, bool(metrics.error[3] < metrics.error[0])
  (4, (4,), True)
  >>> learned = train_until(jax.random.key(0), 5.0, Hparams(), num_steps=100,
  ...                       until=lambda before, after, metrics: metrics.error < 1e-3)
  >>> jl.Status(int(learned.status)).name, learned.num_steps.item() < 20
  ('COMPLETED', True)
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, Protocol, TypeVar

import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxltl.algos.common import loops
from jaxltl.algos.common.loops import MAX_STEPS, Learned, Until
from jaxltl.algos.common.settings import HasStatus, RunState, flag_invalid, require_hparams
from jaxltl.algos.common.trees import choose
from jaxltl.core import struct
from jaxltl.core.models.protocols import Array, Key, Numeric, PyTree
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import Status

ProblemT = TypeVar("ProblemT")
HparamsT = TypeVar("HparamsT")
StateT = TypeVar("StateT", bound=RunState)
MetricsT = TypeVar("MetricsT", bound=HasStatus)


# Arguments are contravariant and results covariant.
ProblemIn = TypeVar("ProblemIn", contravariant=True)
HparamsIn = TypeVar("HparamsIn", contravariant=True)
MetricsOut = TypeVar("MetricsOut", bound=HasStatus, covariant=True)


class Learner(Protocol[ProblemIn, HparamsIn, StateT, MetricsOut]):
    """Interface of a learner, which modules such as ``jaxltl.algos.ppo`` implement.

    ``Problem`` holds the model or the environment, ``Hparams`` the numbers (with ranges declared by
    :mod:`~jaxltl.algos.common.settings`), ``State`` everything that a step changes, ``Metrics`` the
    figures of a step. All are pytrees; batches are a ``vmap`` over keys, states or hyperparameters.
    A hyperparameter out of range is a ValueError; a traced one gives the status INVALID.
    """

    def init(self, key: Key, problem: ProblemIn, hparams: HparamsIn) -> StateT:
        """The state before the first step, of a random key, which it keeps.

        Raises:
          ValueError: a hyperparameter is out of range.
        """
        ...

    def step(
        self, state: StateT, problem: ProblemIn, hparams: HparamsIn
    ) -> tuple[StateT, MetricsOut]:
        """The next ``State``, and ``Metrics`` of the step; pure, for ``jit`` and ``vmap``.

        New values in `problem` and `hparams` do not recompile.

        Raises:
          ValueError: a hyperparameter is out of range.
        """
        ...

    def run(
        self,
        state: StateT,
        problem: ProblemIn,
        hparams: HparamsIn,
        *,
        num_steps: int,
        max_rows: int = 1000,
    ) -> tuple[StateT, MetricsOut]:
        """`num_steps` steps from a state, compiled as one loop.

        Args:
          state: from ``init`` or an earlier run.
          problem, hparams: arrays; new values do not recompile.
          num_steps: number of steps; another one with as many rows does not recompile.
          max_rows: bound on the rows of metrics, evenly spaced steps that include the last, so that
            memory does not grow with `num_steps`.

        Returns:
          The ``State`` after the last step, and ``Metrics`` with a leading axis of rows.

        Raises:
          ValueError: num_steps or max_rows is not positive, or a hyperparameter is out of range.
        """
        ...

    def train(
        self,
        key: Key,
        problem: ProblemIn,
        hparams: HparamsIn,
        *,
        num_steps: int,
        max_rows: int = 1000,
    ) -> tuple[StateT, MetricsOut]:
        """``init`` and ``run``; ``vmap`` it over keys for many seeds. Raises as they do.

        Args:
          key: random key of ``init``; the state keeps it.
          problem, hparams, num_steps, max_rows: as for ``run``.

        Returns:
          The ``State`` after the last step, and ``Metrics`` with a leading axis of rows.
        """
        ...

    def run_until(
        self,
        state: StateT,
        problem: ProblemIn,
        hparams: HparamsIn,
        *,
        until: Until[StateT, MetricsOut],
        num_steps: Numeric,
        check_every: int = 1,
        keep: str = "after",
    ) -> Learned:
        """Steps until a condition holds, at most `num_steps`; for ``jit`` and ``vmap``.

        Under ``vmap`` the state of a finished lane stays unchanged while others continue.

        Args:
          state: from ``init`` or an earlier run.
          problem, hparams: arrays; new values do not recompile.
          until: ``(before, after, metrics) -> bool[]``: the states before and after `check_every` steps
            and the metrics of the last of them; a ``Partial`` of numbers does not recompile for new ones.
          num_steps: maximal number of steps; traced.
          check_every: steps between `before` and `after`; static.
          keep: which state is returned when the condition holds, ``"after"`` or ``"before"``; static.

        Returns:
          :class:`~jaxltl.algos.common.loops.Learned`; :func:`~jaxltl.check` accepts it.

        Raises:
          ValueError: an unknown `keep`, a number below 1, or a hyperparameter out of range.
        """
        ...

    def train_until(
        self,
        key: Key,
        problem: ProblemIn,
        hparams: HparamsIn,
        *,
        until: Until[StateT, MetricsOut],
        num_steps: Numeric,
        check_every: int = 1,
        keep: str = "after",
    ) -> Learned:
        """``init`` and ``run_until``; ``vmap`` it over keys for many seeds. Raises as they do.

        Args:
          key: random key of ``init``; the state keeps it.
          problem, hparams, until, num_steps, check_every, keep: as for ``run_until``.

        Returns:
          :class:`~jaxltl.algos.common.loops.Learned`; :func:`~jaxltl.check` accepts it.
        """
        ...

    def policy(self, state: StateT, problem: ProblemIn, hparams: HparamsIn) -> PyTree:
        """The learned policy: ``float[S, A]`` for models, an ``Agent`` for environments."""
        ...


@brief
class Bound(NamedTuple, Generic[ProblemT, HparamsT, StateT, MetricsT]):
    """Public functions of a learner, made by :func:`bind`; see :class:`Learner`.

    Attributes:
      init, step: with hyperparameters checked.
      run, train: a fixed number of steps, from a state or a key.
      run_until, train_until: the same until a condition holds.
    """

    init: Callable[[Key, ProblemT, HparamsT], StateT]
    step: Callable[[StateT, ProblemT, HparamsT], tuple[StateT, MetricsT]]
    run: Callable[..., tuple[StateT, MetricsT]]
    train: Callable[..., tuple[StateT, MetricsT]]
    run_until: Callable[..., Learned]
    train_until: Callable[..., Learned]


def bind(
    init: Callable[[Key, ProblemT, HparamsT], StateT],
    step: Callable[[StateT, ProblemT, HparamsT], tuple[StateT, MetricsT]],
    *,
    step_if: Callable[..., tuple[StateT, MetricsT]] | None = None,
    keep: str = "after",
) -> Bound[ProblemT, HparamsT, StateT, MetricsT]:
    """A learner's public functions, with the signatures of :class:`Learner`, in the module of `step`.

    Of `init` and `step`. A `step_if` is the step of ``run_until`` with a fourth argument ``bool[]``,
    and returns the state unchanged where that is False; by default finished lanes are masked array by
    array. `keep` is the default of that argument of ``run_until``.
    """

    def checked(function: Callable[..., tuple[StateT, MetricsT]]) -> Callable[..., Any]:
        def call(
            state: StateT, problem: ProblemT, hparams: HparamsT, *going: jax.Array
        ) -> tuple[StateT, MetricsT]:
            require_hparams(hparams)
            after, metrics = function(state, problem, hparams, *going)
            return after, flag_invalid(metrics, hparams, state.step)

        return call

    checked_step = checked(step)
    early = checked_step if step_if is None else checked(step_if)

    def checked_init(key: Key, problem: ProblemT, hparams: HparamsT) -> StateT:
        require_hparams(hparams)
        return init(key, problem, hparams)

    def run(
        state: StateT, problem: ProblemT, hparams: HparamsT, **options: Any
    ) -> tuple[StateT, MetricsT]:
        return loops.run(checked_step, state, problem, hparams, **options)

    def train(
        key: Key, problem: ProblemT, hparams: HparamsT, **options: object
    ) -> tuple[StateT, MetricsT]:
        return run(checked_init(key, problem, hparams), problem, hparams, **options)

    def run_until(
        state: StateT,
        problem: ProblemT,
        hparams: HparamsT,
        *,
        until: Until[StateT, MetricsT],
        num_steps: Numeric,
        **options: Any,
    ) -> Learned:
        options = {"keep": keep, "idle": step_if is not None, **options}
        return loops.run_until(early, state, (problem, hparams, until, num_steps), **options)

    def train_until(key: Key, problem: ProblemT, hparams: HparamsT, **options: Any) -> Learned:
        return run_until(checked_init(key, problem, hparams), problem, hparams, **options)

    functions = Bound(checked_init, checked_step, run, train, run_until, train_until)
    for name, function in functions._asdict().items():
        function.__name__ = function.__qualname__ = name
        function.__module__ = step.__module__
        function.__doc__ = getattr(Learner, name).__doc__
        signature = inspect.signature(getattr(Learner, name))
        _, *parameters = signature.parameters.values()
        parameters = [x.replace(default=keep) if x.name == "keep" else x for x in parameters]
        function.__signature__ = signature.replace(parameters=parameters)
    return functions


# --- statuses, random keys and counters ---------------------------------------------------------------


def completion_status(completed: Array, finite: Array) -> jax.Array:
    """The status of a step: NONFINITE unless `finite`, else COMPLETED or MAX_STEPS by `completed`.

    COMPLETED certifies nothing.

    >>> completion_status(jnp.bool_(True), jnp.bool_(True)).item() == Status.COMPLETED
    True
    """
    code = jnp.where(completed, Status.COMPLETED, Status.MAX_STEPS)
    return jnp.where(finite, code, Status.NONFINITE).astype(jnp.int32)


def init_key(key: Key) -> Key:
    """The random key of ``init``: `key` with a number folded in that no step reaches.

    >>> init_key(jax.random.key(0)).shape
    ()
    """
    return jax.random.fold_in(key, 0xFFFFFFFF)


def step_key(state: RunState) -> Key:
    """The random key of the next step: the root key of `state` with its number of steps folded in.

    >>> from types import SimpleNamespace
    >>> step_key(SimpleNamespace(key=jax.random.key(0), step=1)).shape
    ()
    """
    return jax.random.fold_in(state.key, state.step)


def saturating_add(total: jax.Array, increment: Numeric) -> jax.Array:
    """The sum `total` + `increment` of counters ``int32``, at most ``2 ** 31 - 1``.

    >>> saturating_add(jnp.int32(5), 3).item()
    8
    """
    increment = jnp.asarray(increment, jnp.int32)
    return jnp.where(total > MAX_STEPS - increment, MAX_STEPS, total + increment).astype(jnp.int32)


# --- stopping conditions --------------------------------------------------------------------


def has_stopped(before: PyTree, after: PyTree, metrics: PyTree) -> jax.Array:
    """The stopping condition of early stopping: ``after.stopped``; `before`, `metrics` are unused.

    >>> from types import SimpleNamespace
    >>> has_stopped(None, SimpleNamespace(stopped=True), None)
    True
    """
    return after.stopped


def gradient_vanishes(tolerance: Numeric) -> Until[PyTree, PyTree]:
    """A stopping condition for ``run_until``: the gradient's norm is at most `tolerance`.

    >>> from types import SimpleNamespace
    >>> gradient_vanishes(1e-3)(None, None, SimpleNamespace(gradient_norm=1e-4))
    True
    """
    return Partial(_gradient_vanishes, tolerance)


def _gradient_vanishes(
    tolerance: Numeric, before: PyTree, after: PyTree, metrics: PyTree
) -> jax.Array:
    return metrics.gradient_norm <= tolerance


@struct.dataclass
class Best:
    """The parameters with the best held-out likelihood; without held-out data the newest.

    Attributes:
      parameters, step: of the network, a pytree, and steps made until then, ``int32[]``.
      neg_log_likelihood: ``float[]``, held out, in nats a pair; NaN without held-out data.
    """

    parameters: PyTree
    neg_log_likelihood: jax.Array
    step: jax.Array


def stop_early(
    state: PyTree, after: PyTree, held_out: jax.Array, evaluated: jax.Array, patience: Numeric
) -> tuple[Best, jax.Array]:
    """The :class:`Best` parameters so far, and ``bool[]``, whether patience has run out.

    Of the `state` before a step, with ``parameters``, ``step``, ``best`` and ``stopped``; the
    parameters `after` it; their predecessors' negative log-likelihood `held_out`, ``float[]``; `evaluated`,
    True with held-out data; and `patience`, in steps.

    >>> from types import SimpleNamespace
    >>> best = Best(jnp.zeros(1), jnp.array(0.5), jnp.int32(2))
    >>> state = SimpleNamespace(
    ...     parameters=jnp.ones(1), step=jnp.int32(9), best=best, stopped=jnp.bool_(False))
    >>> stop_early(state, jnp.full(1, 2.0), jnp.array(0.6), jnp.bool_(True), 5)[1].item()
    True
    """
    better = evaluated & (held_out < state.best.neg_log_likelihood) & ~state.stopped
    best = choose(better, Best(state.parameters, held_out, state.step), state.best)
    newest = Best(after, jnp.full_like(held_out, jnp.nan), state.step + 1)
    stopped = state.stopped | (evaluated & (state.step - best.step >= patience))
    return choose(evaluated, best, newest), stopped
