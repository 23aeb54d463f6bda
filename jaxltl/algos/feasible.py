"""Feasible parameters of parametric Markov models by gradient ascent (Heck et al. 2022).

For a model with probabilities and rewards that are functions of parameters in a box: is there a
point at which a reachability probability or an expected total reward meets a threshold? Projected
gradient ascent from many starts, with implicit derivatives of a prepared solve. The objective is
the logarithm of the value, or of the odds of a probability, and coordinates are shares of the box,
so that a learning rate means the same for every model. Gradients find local optima, in floating
point: failure proves nothing, and :func:`feasible` has every point that meets the threshold
certified by the sparse engine, on the model at that point.

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
  >>> found = search.feasible(problem, 0.7, num_starts=4, budget=search.Budget(num_steps=100))
  >>> found.feasible.all().item(), sorted(found.valuation())
  (True, ['p', 'q'])
  >>> search.within(problem, 0.25, 0.5).low.tolist()
  [0.25, 0.25]
  >>> hparams = search.Hparams()
  >>> state = search.start_at(jax.random.key(0), jnp.array([0.5, 0.5]), problem, hparams)
  >>> value, status = search.evaluate(state.parameters, problem, hparams)
  >>> state, metrics = search.run(state, problem, hparams, num_steps=2)
  >>> value.item(), bool(state.best.value > value)
  (0.25, True)
  >>> low, high = search.certify(problem, search.policy(state, problem, hparams))
  >>> low <= float(state.best.value) + 1e-6 <= high + 2e-6
  True
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

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
from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.parametric import Ends, ParametricMDP
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP, choice_reward
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.types import Status, require_states
from jaxltl.core.validation import Range
from jaxltl.core.values.engine.state_quantities import safe_ends
from jaxltl.core.values.interval.sides import requested_width
from jaxltl.core.values.prepared.prepared import (
    Prepared,
    evaluate_prepared,
    is_direct,
    prepare,
    solve_prepared,
)


@struct.dataclass
class Problem:
    """A threshold question about a parametric model; made by :func:`make_problem`.

    Attributes:
      model: the model, with its box.
      prepared: the preprocessed question.
      weight: ``float[S]``, the initial distribution.
      low, high, inside: ``float[D]``, the box and a point in it, in the precision of the search.
      target, stay: ``bool[S]``, the target states, and the states allowed before them or None.
      reward: name of the reward, or None for a probability; static.
      objective: ``"max"`` or ``"min"``, over policies; static.
      bound: ``">="`` or ``"<="``, how the value is compared with the threshold; static.
    """

    model: ParametricMDP
    prepared: Prepared
    weight: Array
    low: Array
    high: Array
    inside: Array
    target: Array
    stay: Array
    reward: str | None = struct.field(pytree_node=False)
    objective: str = struct.field(pytree_node=False)
    bound: str = struct.field(pytree_node=False)

    @property
    def sign(self) -> float:
        """1 if the value is to be large, -1 if small."""
        return 1.0 if self.bound == ">=" else -1.0

    @property
    def highest(self) -> float:
        """The trivial upper bound: 1 of a probability, infinity of a reward."""
        return 1.0 if self.reward is None else np.inf


def make_problem(
    model: ParametricMDP,
    target: str | ArrayLike,
    *,
    bound: str,
    reward: str | None = None,
    stay: ArrayLike | None = None,
    objective: str = "max",
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      model: of ``make_parametric``, or ``read_parametric(path).over(low, high)``.
      target: ``bool[S]``, or a label.
      bound: ``">="`` or ``"<="``: the value is to be at least or at most the threshold.
      reward: name of the reward, for its expected total until the target; default: the probability of
        reaching the target.
      stay: ``bool[S]``, the states allowed before the target, of probabilities only.
      objective: ``"max"`` or ``"min"`` over policies; ``">="`` with ``"max"`` asks for some policy,
        ``"<="`` for all.

    Raises:
      ValueError: an unknown bound, objective, reward or label, a wrong shape, or a reward that is
        infinite at every point because the target is not reached almost surely.
    """
    if not isinstance(bound, str) or bound not in (">=", "<="):
        raise ValueError(f'bound={validation.shorten(bound)}; it must be ">=" or "<=".')
    validation.choice("objective", objective, ("max", "min"))
    if reward is not None and not isinstance(reward, str):
        raise ValueError(
            f"reward is {validation.shorten(reward)}; give the name of a reward of the model."
        )
    if not isinstance(model, ParametricMDP):
        raise ValueError(
            f"{type(model).__name__} has no box of parameters; give what "
            "make_parametric makes, or read_parametric(path).over(low, high)."
        )
    here = model.model
    target = here.states_with_label(target) if isinstance(target, str) else np.asarray(target)
    require_states("target", target, (here.num_states,))
    target = target.astype(bool)
    if here.is_chain:
        objective = "max"  # which allows rewards that become zero
    if reward is not None:
        choice_reward(here, reward)  # raises for an unknown name
    problem = Problem(
        model=model,
        prepared=cast(
            Prepared, prepare(here, target, stay=stay, reward=reward, objective=objective)
        ),
        weight=np.asarray(here.initial, np.float64),
        low=model.low,
        high=model.high,
        inside=model.inside,
        target=target,
        stay=None if stay is None else np.asarray(stay, bool),
        reward=reward,
        objective=objective,
        bound=bound,
    )
    if reward is not None and np.isinf(_bounds(problem, here, 1e-3)[1]):
        raise ValueError(
            "the expected reward is infinite at every point: from some initial state the target is "
            f'not reached almost surely (objective="{objective}").'
        )
    return _in_search_precision(problem)


def within(problem: Problem, low: Ends, high: Ends) -> Problem:
    """The `problem` over a smaller box, from `low` to `high`, without recompilation.

    Raises:
      ValueError: the box is empty, or not contained in the problem's.
    """
    require_problem(problem)
    return _in_search_precision(replace(problem, model=problem.model.within(low, high)))


def require_problem(problem: object) -> None:
    """Raises ValueError unless `problem` is a :class:`Problem`.

    Raises:
      ValueError: it is something else.

    >>> require_problem(0.5)
    Traceback (most recent call last):
    ValueError: problem is 0.5; give what make_problem returns.
    """
    if not isinstance(problem, Problem):
        raise ValueError(
            f"problem is {validation.shorten(problem)}; give what make_problem returns."
        )


def _in_search_precision(problem: Problem) -> Problem:
    """The box rounded inward to JAX's default precision."""
    dtype = np.dtype(jnp.zeros(()).dtype)
    model = problem.model
    low, high, inside = (x.astype(dtype) for x in (model.low, model.high, model.inside))
    low = np.where(low < model.low, np.nextafter(low, dtype.type(np.inf)), low)
    high = np.where(high > model.high, np.nextafter(high, dtype.type(-np.inf)), high)
    if not (low < high).all():
        d = int(np.flatnonzero(~(low < high))[0])
        raise ValueError(
            f"the interval of {model.parameters[d]} has no two numbers in {dtype}; widen it, or "
            "use float64."
        )
    inside, weight = np.clip(inside, low, high), np.asarray(problem.weight).astype(dtype)
    low, high, inside, weight = to_jax((low, high, inside, weight))
    return replace(problem, low=low, high=high, inside=inside, weight=weight)


def certify(
    problem: Problem, parameters: ArrayLike | Mapping[str, float], *, tolerance: float = 1e-6
) -> tuple[float, float]:
    """The certified lower and upper bound of the value of a `problem` at `parameters` of the box.

    Rounding is included. For a model read from a file they bound the value of its functions at
    exactly this point, for a JAX function that of the model with the computed numbers. The
    `tolerance` is the width of the bounds, for rewards relative to the value.

    Raises:
      ValueError: the point is outside of the box, or the functions give no model there.
    """
    require_problem(problem)
    return _bounds(problem, problem.model.at(parameters), requested_width(tolerance))


def _bounds(problem: Problem, model: SparseMDP, tolerance: float) -> tuple[float, float]:
    """Bounds of the mean over the initial distribution of a model."""
    options: dict[str, Any] = {
        "maximize": problem.objective == "max",
        "tolerance": tolerance,
        "depth": problem.model.roundings,
    }
    if problem.reward is None:
        solution = optimal.reachability(model.host, problem.target, stay=problem.stay, **options)
    else:
        earned = choice_reward(model, problem.reward)
        solution = optimal.total_reward(model.host, earned, problem.target, **options)
    return safe_ends(model, solution, highest=problem.highest)


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
    tolerance: Number | None = traced("tolerance", default=None)


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
        validation.integer("num_steps", self.num_steps, least=1, limit=loops.MAX_STEPS)
        if self.num_proofs is not None:
            validation.integer("num_proofs", self.num_proofs, least=1)
        validation.require_in_range("tolerance", self.tolerance)


@struct.dataclass
class BestPoint:
    """The best point so far: `parameters`, ``float[D]``, and its `value`; NaN before there is one.

    >>> BestPoint(jnp.full(2, jnp.nan), jnp.array(jnp.nan)).parameters.shape
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
      best: the best of all points, :class:`BestPoint`.
      optimizer: optax's state.
    """

    parameters: jax.Array
    inside: jax.Array
    best: BestPoint
    optimizer: optax.OptState


@struct.dataclass
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
        solution = solve_prepared(
            problem.prepared, probability=probability, reward=reward, tolerance=hparams.tolerance
        )
        value, status = solution.value, solution.status
    return jnp.sum(problem.weight * jnp.where(problem.weight > 0, value, 0)), status


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """A point drawn uniformly from the box."""
    share = jax.random.uniform(learner.init_key(key), problem.low.shape, problem.low.dtype)
    return start_at(key, problem.low + share * (problem.high - problem.low), problem, hparams)


def start_at(key: Key, parameters: jax.Array, problem: Problem, hparams: Hparams) -> State:
    """A :class:`State` at the point of the problem's box nearest to given `parameters`.

    As ``init(key, problem, hparams)``, which draws the point.
    """
    point = jnp.clip(jnp.asarray(parameters, problem.low.dtype), problem.low, problem.high)
    first = replace(hparams, learning_rate=at(hparams.learning_rate, 0))
    return State(
        key=key,
        step=jnp.int32(0),
        parameters=point,
        inside=problem.inside,
        best=BestPoint(jnp.full_like(point, jnp.nan), jnp.full((), jnp.nan, point.dtype)),
        optimizer=optimizers.start(first, point),
    )


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
    hparams = replace(hparams, learning_rate=at(hparams.learning_rate, state.step))
    updates, optimizer = optimizers.optimizer_of(hparams).update(
        jnp.where(good, slope, 0), state.optimizer, x
    )
    moved = jnp.clip(x + updates * size, problem.low, problem.high)
    better = good & ~(problem.sign * (value - state.best.value) <= 0)  # also if the best is NaN
    best = trees.choose(better, BestPoint(x, value), state.best)
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
    return state.best.parameters


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
    num_starts: int = 100,
    guess: ArrayLike | None = None,
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
      num_starts: number of random starting points.
      guess: ``float[N, D]``, starting points instead of random ones.
      key: of the random points; default ``jax.random.key(0)``.
      hparams: settings of the search.
      budget: steps, proofs and their tolerance; default :class:`Budget`.

    Raises:
      ValueError: the threshold is not finite, a number is out of range, or a start is outside of
        the box.
    """
    require_problem(problem)
    threshold = validation.finite_number("threshold", threshold)
    hparams = Hparams() if hparams is None else hparams
    validation.instance("hparams", hparams, Hparams, "Hparams")
    budget = Budget() if budget is None else budget
    validation.instance("budget", budget, Budget, "a Budget")
    key = jax.random.key(0) if key is None else key
    # A little beyond the threshold, so that rounding does not decide.
    beyond = 1e3 * float(jnp.finfo(problem.low.dtype).eps) * abs(threshold)
    goal = np.asarray(threshold + problem.sign * beyond, problem.low.dtype)
    max_steps = np.int32(budget.num_steps)
    num_starts = validation.integer("num_starts", num_starts, least=1, limit=loops.MAX_STEPS)
    points = None
    if guess is not None:
        points = problem.model.valid_points("guess", guess).astype(problem.low.dtype)
        num_starts = len(points)
    keys = jax.random.split(key, num_starts)
    # Only what the search reads, so that other models of the same shape do not recompile it.
    nothing: PyTree = None
    numbers = ParametricMDP(nothing, problem.model.numbers, None, None, None, ())
    lean = replace(problem, target=None, stay=None, model=numbers)
    return _prove(problem, threshold, _search(keys, points, lean, hparams, goal, max_steps), budget)


@jax.jit
def _search(
    keys: jax.Array,
    points: jax.Array | None,
    problem: Problem,
    hparams: Hparams,
    goal: jax.Array,
    max_steps: jax.Array,
) -> loops.Learned:
    """Searches from all starts: in parallel, or sequentially if their costs differ."""
    until = Partial(_met, problem.sign * goal, problem.sign)

    def one(key: jax.Array, point: jax.Array | None) -> loops.Learned:
        state = (
            init(key, problem, hparams) if point is None else start_at(key, point, problem, hparams)
        )
        return run_until(state, problem, hparams, until=until, num_steps=max_steps)

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
    result = Feasible(
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
    result.status[claimed] = Status.UNCERTIFIED
    for i in claimed[np.argsort(gap[claimed], kind="stable")]:
        if budget.num_proofs is not None and result.feasible.sum() >= budget.num_proofs:
            break
        try:
            low, high = certify(problem, result.parameters[i], tolerance=budget.tolerance)
            if low < threshold < high:
                low, high = certify(problem, result.parameters[i], tolerance=_FINEST)
        except ValueError:  # no model in double precision
            result.status[i] = Status.INVALID
            continue
        result.lower[i], result.upper[i] = low, high
        result.feasible[i] = low >= threshold if problem.sign > 0 else high <= threshold
        open_ = Status.PRECISION if low < threshold < high else Status.MAX_STEPS
        result.status[i] = Status.CONVERGED if result.feasible[i] else open_
    return result
