"""Feasible parameters of parametric Markov models by gradient ascent (Heck et al. 2022).

For a model with probabilities and rewards that are functions of parameters in a box: is there a
point at which a reachability probability or an expected total reward meets a threshold? Projected
gradient ascent from many starts, with implicit derivatives of a prepared solve. The objective is
the logarithm of the value, or of the odds of a probability, and coordinates are shares of the box,
so that a learning rate means the same for every model.

Gradients find local optima, in floating point: failure proves nothing, and :func:`feasible` has
every point that meets the threshold certified by the sparse engine, on the model at that point.

Example: a head of one coin, then a tail of another; their biases are parameters.
  >>> import jax, jax.numpy as jnp, numpy as np
  >>> import jaxltl as jl
  >>> from jaxltl.algos import feasible as search
  >>> chain = jl.make_sparse(None, [0, 2, 4, 5, 6], [1, 3, 2, 3, 2, 3], [0.5] * 4 + [1, 1],
  ...                        initial=[1, 0, 0, 0], label={"both": [2]})
  >>> def numbers(x):  # of each transition
  ...     p, q = x
  ...     return jnp.array([p, 1 - p, 1 - q, q, 1, 1])
  >>> model = jl.make_parametric(chain, numbers, [0.1, 0.2], [0.9, 0.8], parameters=["p", "q"])
  >>> problem = search.make_problem(model, "both", bound=">=")
  >>> found = search.feasible(problem, 0.7, starts=4, budget=search.Budget(num_steps=100))
  >>> found.feasible.all().item(), sorted(found.valuation())
  (True, ['p', 'q'])
  >>> search.within(problem, 0.25, 0.5).low.tolist()
  [0.25, 0.25]
  >>> hparams = search.Hparams()
  >>> state = search.start_at(jnp.array([0.5, 0.5]), jax.random.key(0), problem, hparams)
  >>> value, status = search.evaluate(state.parameters, problem, hparams)
  >>> state, metrics = search.run(state, problem, hparams, num_steps=2)
  >>> value.item(), bool(state.best.value > value)
  (0.25, True)
  >>> low, high = search.certify(problem, search.policy(state, problem, hparams))
  >>> low <= float(state.best.value) + 1e-6 <= high + 2e-6
  True
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.algos.common import learner, loops, optimizers, trees
from jaxltl.algos.common.schedules import Schedule, at
from jaxltl.algos.common.settings import Number, RunState, static, traced
from jaxltl.algos.feasible.problem import Problem, certify, require_problem
from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.models.parametric.parametric import ParametricMDP
from jaxltl.core.types import Status
from jaxltl.core.validation import Range
from jaxltl.core.values.prepared.prepared import (
    evaluate_prepared,
    is_direct,
    solve_prepared,
)

_FINEST = 1e-12  # the width of bounds if those of the requested width contain the threshold


@struct.dataclass
class Hparams:
    """Settings of the search.

    Attributes:
      learning_rate: in shares of the box; a number or a schedule; default 0.1.
      optimizer: the name of one of optax, such as ``"rmsprop"``, or ``"sign"``, which uses the signs
        of the gradient only; static; default ``"adam"``.
      tolerance: of solves of decision processes, see
        :func:`~jaxltl.core.values.prepared.prepared.solve_prepared`; default None.
    """

    learning_rate: Schedule = traced(Range(0, open_above=True), default=0.1, schedule=True)
    optimizer: str = static((*optimizers.NAMES, "sign"), default="adam")
    tolerance: Number | None = traced(Range(0, open_above=True), default=None)


@dataclass(frozen=True, kw_only=True)
class Budget:
    """The effort of :func:`feasible`.

    Attributes:
      num_steps: gradient steps at most, from each start.
      num_proofs: points to prove feasible, best values first; None: all.
      tolerance: width of the certified bounds, for rewards relative to the value.
    """

    num_steps: int = 200
    num_proofs: int | None = None
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        """Raises ValueError if a number is out of range."""
        validation.integer("num_steps", self.num_steps, least=1, most=loops.MAX_STEPS)
        if self.num_proofs is not None:
            validation.integer("num_proofs", self.num_proofs, least=1)
        validation.require_in_range("tolerance", self.tolerance)


@struct.dataclass
class Best:
    """The best point so far: `parameters`, ``float[D]``, and its `value`; NaN before there is one.

    >>> Best(jnp.full(2, jnp.nan), jnp.array(jnp.nan)).parameters.shape
    (2,)
    """

    parameters: jax.Array
    value: jax.Array


@struct.dataclass
class State(RunState):
    """A search from one start.

    Attributes:
      parameters: ``float[D]``, the point that the next step evaluates.
      inside: ``float[D]``, the last point at which the functions gave a model.
      best: the best of all points, :class:`Best`.
      optimizer: optax's state.
    """

    parameters: jax.Array
    inside: jax.Array
    best: Best
    optimizer: optax.OptState


@struct.metrics
class Metrics:
    """Figures of the point before a step; scalars, of a run ``[T]``.

    Attributes:
      value: at the point.
      best_value: of all points including this one.
      gradient_norm: Euclidean, of the logarithm of the value (or odds), by shares of the box.
      status: of the solve; INVALID where the functions give no model.
    """

    value: jax.Array
    best_value: jax.Array
    gradient_norm: jax.Array
    status: jax.Array


# --- the search -----------------------------------------------------------------------------


def evaluate(
    parameters: jax.Array, problem: Problem, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """The value ``float[]`` at `parameters` of a `problem`, and its status ``int32[]``.

    INVALID where the functions give no model; the solves of Markov chains are UNCERTIFIED, those of
    decision processes have the tolerance of `hparams`. Differentiable in the parameters, for an
    optimum over policies with the optimal policy held fixed.
    """
    probability, rewards = problem.model.numbers(parameters)
    reward = None if problem.reward is None else rewards.get(problem.reward)
    if problem.prepared.num_rows == problem.prepared.num_states:  # a chain
        value, status = evaluate_prepared(problem.prepared, probability=probability, reward=reward)
    else:
        found = solve_prepared(
            problem.prepared, probability=probability, reward=reward, tolerance=hparams.tolerance
        )
        value, status = found.value, found.status
    return jnp.sum(problem.weight * jnp.where(problem.weight > 0, value, 0)), status


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """A point drawn uniformly from the box."""
    share = jax.random.uniform(learner.init_key(key), problem.low.shape, problem.low.dtype)
    return start_at(problem.low + share * (problem.high - problem.low), key, problem, hparams)


def start_at(parameters: jax.Array, key: Key, problem: Problem, hparams: Hparams) -> State:
    """A :class:`State` at the point of the problem's box nearest to given `parameters`.

    As ``init(key, problem, hparams)``, which draws the point.
    """
    point = jnp.clip(jnp.asarray(parameters, problem.low.dtype), problem.low, problem.high)
    return State(
        key=key,
        step=jnp.int32(0),
        parameters=point,
        inside=problem.inside,
        best=Best(jnp.full_like(point, jnp.nan), jnp.full((), jnp.nan, point.dtype)),
        optimizer=trees.strong(_optimizer(hparams, jnp.int32(0)).init(point)),
    )


def _optimizer(hparams: Hparams, step: jax.Array) -> optax.GradientTransformationExtraArgs:
    rate = at(hparams.learning_rate, step)
    if hparams.optimizer == "sign":
        return optax.with_extra_args_support(
            optax.chain(optax.scale_by_sign(), optax.scale_by_learning_rate(rate))
        )
    return optimizers.optimizer(hparams.optimizer, rate)


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """A projected gradient step; from a point without a model, half way back to the last one with."""
    x = state.parameters
    size = problem.high - problem.low

    def loss(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        value, status = evaluate(x, problem, hparams)
        return -problem.sign * value, (value, status)

    slope, (value, status) = jax.grad(loss, has_aux=True)(x)
    slope = slope * size / _unit(problem, value)
    good = (status < Status.NONFINITE) & jnp.isfinite(value) & jnp.all(jnp.isfinite(slope))
    updates, optimizer = _optimizer(hparams, state.step).update(
        jnp.where(good, slope, 0), state.optimizer, x
    )
    moved = jnp.clip(x + updates * size, problem.low, problem.high)
    better = good & ~(problem.sign * (value - state.best.value) <= 0)  # also if the best is NaN
    best = trees.choose(better, Best(x, value), state.best)
    after = State(
        key=state.key,
        step=state.step + 1,
        parameters=jnp.where(good, moved, x + (state.inside - x) / 2),
        inside=jnp.where(good, x, state.inside),
        best=best,
        optimizer=trees.choose(good, optimizer, state.optimizer),
    )
    status = jnp.where(good | (status >= Status.NONFINITE), status, Status.NONFINITE)
    return after, Metrics(
        value=value,
        best_value=best.value,
        gradient_norm=optax.tree.norm(slope),
        status=status.astype(jnp.int32),
    )


def _unit(problem: Problem, value: jax.Array) -> jax.Array:
    """The divisor that makes a gradient that of the logarithm of the value, or of the odds."""
    limits = jnp.finfo(value.dtype)
    unit = jnp.abs(value)
    if problem.reward is None:
        unit = unit * jnp.maximum(1 - value, 1e3 * limits.eps)
    return jnp.maximum(unit, limits.tiny)


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The parameters ``float[D]`` of the best value; NaN before there is one."""
    del problem, hparams
    return state.best.parameters


# --- many starts, and certificates ------------------------------------------------------------


@struct.dataclass
class Feasible:
    """Results of N searches.

    Attributes:
      parameters: ``float64[N, D]``, the best point of each; NaN if the functions gave no model.
      value: ``float64[N]``, at these points, not certified.
      lower, upper: ``float64[N]``, certified bounds of the value if the threshold seems met; else
        the trivial ones, 0 and 1 or infinity.
      feasible: ``bool[N]``, whether the bounds prove that the threshold is met.
      num_steps: ``int32[N]``, of the searches.
      status: ``int32[N]``: CONVERGED if feasible; UNCERTIFIED if the threshold seems met and enough
        other points were proven; PRECISION if the bounds contain the threshold; MAX_STEPS if the
        search was stopped; INVALID or NONFINITE if nothing was found.
      names: of the parameters, static.
    """

    parameters: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    feasible: np.ndarray
    num_steps: np.ndarray
    status: np.ndarray
    names: tuple[str, ...] = struct.field(pytree_node=False)

    def valuation(self, i: int | None = None) -> dict[str, float]:
        """Parameters by name of start i; default the first feasible one.

        Raises:
          ValueError: none is feasible.
        """
        if i is None:
            if not self.feasible.any():
                raise ValueError("no parameters were proven feasible; read value and status.")
            i = int(np.argmax(self.feasible))
        return dict(zip(self.names, self.parameters[i].tolist(), strict=True))


def feasible(
    problem: Problem,
    threshold: float,
    *,
    starts: int | ArrayLike = 100,
    key: Key | None = None,
    hparams: Hparams | None = None,
    budget: Budget | None = None,
) -> Feasible:
    """The certified points of a box at which the value meets a threshold, searched from many starts.

    All starts are one compiled program, in which each ends for itself; new thresholds, boxes and
    numbers of steps do not recompile it. Points that meet the threshold are certified in double
    precision; for a model read from a file, on the model at exactly that point.

    Args:
      problem: the question.
      threshold: finite.
      starts: number of random starts, or starting points, ``float[N, D]``.
      key: of the random starts; default ``jax.random.key(0)``.
      hparams: settings of the search.
      budget: steps, proofs and their tolerance; default :class:`Budget`.

    Raises:
      ValueError: the threshold is not finite, a number is out of range, or a start is outside of
        the box.
    """
    require_problem(problem)
    threshold = validation.finite_number("threshold", threshold)
    hparams = validation.instance(
        "hparams", Hparams() if hparams is None else hparams, Hparams, "Hparams"
    )
    budget = validation.instance(
        "budget", Budget() if budget is None else budget, Budget, "a Budget"
    )
    key = jax.random.key(0) if key is None else key
    # A little beyond the threshold, so that rounding does not decide.
    beyond = 1e3 * float(jnp.finfo(problem.low.dtype).eps) * abs(threshold)
    goal = np.asarray(threshold + problem.sign * beyond, problem.low.dtype)
    most = np.int32(budget.num_steps)
    points = None
    if np.ndim(starts) == 0:
        keys = jax.random.split(
            key, validation.integer("starts", starts, least=1, most=loops.MAX_STEPS)
        )
    else:
        points = problem.model.valid_points("start", starts).astype(problem.low.dtype)
        keys = jax.random.split(key, len(points))
    # Only what the search reads, so that other models of the same shape do not recompile it.
    nothing: PyTree = None
    numbers = ParametricMDP(nothing, problem.model.numbers, None, None, None, ())
    lean = replace(problem, target=None, stay=None, model=numbers)
    return _prove(problem, threshold, _search(keys, points, lean, hparams, goal, most), budget)


@jax.jit
def _search(
    keys: jax.Array,
    points: jax.Array | None,
    problem: Problem,
    hparams: Hparams,
    goal: jax.Array,
    most: jax.Array,
) -> loops.Learned:
    """Searches from all starts: in parallel, or sequentially if their costs differ."""
    until = Partial(_met, problem.sign * goal, problem.sign)

    def one(key: jax.Array, point: jax.Array | None) -> loops.Learned:
        state = (
            init(key, problem, hparams) if point is None else start_at(point, key, problem, hparams)
        )
        return run_until(state, problem, hparams, until=until, num_steps=most)

    prepared = problem.prepared
    # The work of a solve depends on the numbers.
    if not is_direct(prepared) if prepared.num_rows == prepared.num_states else prepared.cyclic:
        return lax.map(lambda start: one(*start), (keys, points))
    return jax.vmap(one)(keys, points)


def _met(
    goal: jax.Array, sign: jax.Array, before: State, after: State, metrics: Metrics
) -> jax.Array:
    return sign * metrics.best_value >= goal


def _prove(problem: Problem, threshold: float, learned: loops.Learned, budget: Budget) -> Feasible:
    """Certified bounds at the points that seem to meet the threshold, best values first."""
    best = learned.state.best
    value = np.asarray(best.value, np.float64)
    slack = max(1e-6, 1e4 * float(jnp.finfo(best.value.dtype).eps))
    value = np.clip(value, 0, 1) if problem.reward is None else value
    size = value.size
    last = np.maximum(learned.metrics.status, Status.NONFINITE)
    found = Feasible(
        parameters=np.asarray(best.parameters, np.float64),
        value=value,
        lower=np.zeros(size),
        upper=np.full(size, problem.highest),
        feasible=np.zeros(size, bool),
        num_steps=np.asarray(learned.num_steps),
        status=np.where(np.isnan(value), last, Status.MAX_STEPS).astype(np.int32),
        names=problem.model.parameters,
    )
    gap = problem.sign * (threshold - value)
    claimed = np.flatnonzero(gap <= slack * max(abs(threshold), slack))
    found.status[claimed] = Status.UNCERTIFIED
    for i in claimed[np.argsort(gap[claimed], kind="stable")]:
        if budget.num_proofs is not None and found.feasible.sum() >= budget.num_proofs:
            break
        try:
            low, high = certify(problem, found.parameters[i], tolerance=budget.tolerance)
            if low < threshold < high:
                low, high = certify(problem, found.parameters[i], tolerance=_FINEST)
        except ValueError:  # no model in double precision
            found.status[i] = Status.INVALID
            continue
        found.lower[i], found.upper[i] = low, high
        found.feasible[i] = low >= threshold if problem.sign > 0 else high <= threshold
        open_ = Status.PRECISION if low < threshold < high else Status.MAX_STEPS
        found.status[i] = Status.CONVERGED if found.feasible[i] else open_
    return found
