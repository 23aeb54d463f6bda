"""The constrained cross-entropy method (dissertation, chapter 4, algorithm 2).

A policy is a vector of parameters, and all that is asked of it is ``evaluate(parameters, key) ->
(objective, cost)``: an objective to be maximised and costs that are feasible up to limits.
Policies are drawn from a natural exponential family. While fewer than ``k = ceil(rho n)`` of the
n samples are feasible the elites are the k with the least violation, else the k feasible ones
of the highest objective. The mean parameter of the family moves towards theirs,

    eta' = alpha sum_i w_i Gamma(x_i) + (1 - alpha) (lambda mean_i Gamma(x_i) + (1 - lambda) eta),

(4.14), and starts at the initial family's. The dissertation's objective G is positive and weighs
the elites; here it is given by its logarithm, or is any number, and the weights are
``exp(objective / temperature)``, shifted so that nothing overflows.

Only the share of feasible *samples* is controlled: the mean policy can be infeasible, and the best
sample can owe its place to luck. :func:`result` evaluates both anew and names a solution
only if it is feasible.

Example: to be near (1, 1), with a first coordinate of at most 0.5.

  >>> import jax, jax.numpy as jnp
  >>> from jaxltl.algos import cce
  >>> from jaxltl.algos.cce.exponential_family import diagonal_gaussian
  >>> def evaluate(x, key):
  ...     return -jnp.sum((x - 1.0) ** 2), x[0]  # an objective, and a cost
  >>> problem = cce.make_problem(evaluate, diagonal_gaussian(jnp.zeros(2), 1.0), limit=0.5)
  >>> key, fresh = jax.random.split(jax.random.key(0))
  >>> hparams = cce.Hparams(rate=0.5)
  >>> state, metrics = cce.train(key, problem, hparams, num_steps=50)
  >>> metrics.spread.shape, cce.policy(state, problem, hparams).shape
  ((50,), (2,))
  >>> found = cce.result(state, problem, hparams, fresh)
  >>> found.solution.round(2).tolist(), bool(found.solution[0] <= 0.5)
  ([0.5, 1.0], True)

A run is made of steps, goes on from a state, and may end early:

  >>> state = cce.init(jax.random.key(0), problem, hparams)  # train is init and run
  >>> state, metrics = cce.run(state, problem, hparams, num_steps=50)  # step after step
  >>> until = lambda before, after, metrics: metrics.spread < 1e-3  # for run_until and train_until
  >>> state.step.item()
  50
  >>> anew = jax.eval_shape(  # as result does it
  ...     lambda x, key: cce.assess(problem, x, key, num_evaluations=10), problem.family.mean, key)
  >>> anew.upper.shape
  (1,)

Many seeds are ``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``; so are
many settings, by ``vmap`` over the numbers of ``Hparams``. Policies
of environments are searched with :func:`~jaxltl.core.values.evaluation.episode_scores.episode_evaluator`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jaxltl.algos.common.settings import COUNT, Number, static, traced
from jaxltl.core.validation import Range
from jaxltl.algos.cce import exponential_family as families
from jaxltl.algos.cce._elites import (
    Pool,
    Sample,
    better,
    elite_weights,
    num_elites,
    rows_of,
    select,
)
from jaxltl.algos.cce._evaluation import evaluate_all, per_cost, scores, split
from jaxltl.algos.common import learner
from jaxltl.algos.common.schedules import SLACK, Schedule, at, is_schedule
from jaxltl.algos.common.schedules import Polynomial as Polynomial
from jaxltl.core import validation
from jaxltl.core.environments.environment import as_partial, require_key
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Status, require_shape

__all__ = [
    "WEIGHTINGS",
    "Assessment",
    "Hparams",
    "Metrics",
    "Polynomial",
    "Problem",
    "Result",
    "State",
    "assess",
    "init",
    "make_problem",
    "policy",
    "result",
    "run",
    "run_until",
    "step",
    "train",
    "train_until",
]

WEIGHTINGS = ("until_feasible", "literal", "uniform")


@brief
@struct.dataclass
class Problem:
    """What is searched; made by :func:`make_problem`.

    Attributes:
      evaluate: ``(float[D], key) -> (objective, cost)``, a pytree.
      family: the first distribution of policies.
      limit: ``float[C]``, feasible is a cost of at most this.
      scale: ``float[C]``, what violations are divided by to compare constraints.
    """

    evaluate: Any
    family: Any
    limit: jax.Array
    scale: jax.Array


@brief
@struct.dataclass
class Hparams:
    """How to search. Numbers are traced, so new values do not recompile; None is static.

    The theorem's schedules are ``rate=Polynomial(a, p)`` with p in [-1, 0) and
    ``num_samples=Polynomial(n, beta)``, with `weighting` ``"literal"``: see
    :func:`theorem_conditions`. The defaults are outside of it.

    Attributes:
      rate: alpha_l, in (0, 1]; a schedule; default 0.1.
      sample_share: lambda_l, the weight in [0, 1] of the samples' own mean instead of the last mean
        parameter; a schedule, or None for 0; default None.
      num_samples: n_l, a schedule, rounded and kept between 1 / rho and `population`; later samples
        are masked, but drawn and evaluated. None: always `population`. Default None.
      temperature: of the weights, positive. At 1 the objective is the logarithm of G. Default 1.0.
      margin: taken off the limits for the search, a number or ``float[C]``; :func:`result` is not
        concerned. Where costs are random, samples are feasible by luck: with normal noise of
        deviation s and a rho of .2 the search can rest .84 s above a limit without margin.
        Default 0.0.
      population: the largest n_l; static; default 100.
      rho: the share of elites; static; default 0.2.
      weighting: static. ``"until_feasible"``: elites count equally until k of them are feasible,
        then by G, because G-weights while nothing is feasible narrow the search around policies
        that are merely good; ``"literal"``: always by G; ``"uniform"``: always equally.
        Default ``"until_feasible"``.

      elite_reuse: outside of the theorem, as what comes next: the last elites compete again with
        the values they had; static. Where values are random, lucky ones stay. Default False.
      antithetic: samples come in pairs mirrored about the mean; static; default False.
      variance_floor: the variance is at least this in every direction; default None.
      noise: a variance added after every step, a schedule (Szita and Lorincz 2006); default None.
      restart_below: the search starts again from the first distribution when all standard
        deviations are below this. What was found is kept. Default None.

      sharding: a ``NamedSharding`` whose spec names the mesh axis over which the population's axis
        is split, such as ``NamedSharding(mesh, PartitionSpec("population"))``; static;
        default None.
    """

    rate: Schedule = traced(Range(0, 1, open_below=True), default=0.1, schedule=True)
    sample_share: Schedule = traced(Range(0, 1), default=None, schedule=True)
    num_samples: Schedule = traced(Range(0), default=None, schedule=True)
    temperature: Number = traced(Range(0, open_below=True, open_above=True), default=1.0)
    margin: jax.Array | float = 0.0
    population: int = static(COUNT, default=100)
    rho: float = static(Range(0, 1, open_below=True, open_above=True), default=0.2)
    weighting: str = static(WEIGHTINGS, default="until_feasible")
    elite_reuse: bool = static(bool, default=False)
    antithetic: bool = static(bool, default=False)
    variance_floor: Number | None = traced(Range(0), default=None)
    noise: Schedule = None
    restart_below: Number | None = traced(Range(0), default=None)
    sharding: Any = struct.field(pytree_node=False, default=None)


@brief(codes={"status": Status})
@struct.dataclass
class State:
    """A distribution on its way, and the best that it has drawn.

    Attributes:
      key: of the whole run.
      step: ``int32[]``, steps made.
      family: the distribution of policies.
      best: the feasible sample of the highest objective, by its one evaluation: its parameters
        ``float[D]``, objective ``float[]`` and cost ``float[C]``.
      least: the sample of the least violation, likewise.
      elites: the last ones; None without reuse.
      num_evaluated, num_invalid: ``int32[]``, samples so far, and those that could not be used: an
        objective that is NaN or plus infinity, or a cost that is NaN. At most 2^31 - 1 are counted.
      num_restarts: ``int32[]``, so far.
      status: ``int32[]``, NONFINITE if no sample of the last step could be used (the distribution
        then stays as it was), else COMPLETED.
    """

    key: jax.Array
    step: jax.Array
    family: Any
    best: Sample
    least: Sample
    elites: Any
    num_evaluated: jax.Array
    num_invalid: jax.Array
    num_restarts: jax.Array
    status: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures of a step; scalars unless a shape is given, of a run with ``[T]`` before it.

    Attributes:
      num_evaluated: samples so far.
      num_feasible, num_invalid: of this step's samples.
      enough_feasible: whether the elites were chosen by the objective (case 2).
      objective: mean over this step's samples that could be used.
      cost: ``float[C]``, likewise.
      best_objective: of the best feasible sample so far; minus infinity before there is one.
      least_excess: of the sample of the least violation so far.
      spread: the largest standard deviation after the step.
      rate: alpha_l.
      num_restarts, status: see :class:`State`.
    """

    num_evaluated: jax.Array
    num_feasible: jax.Array
    num_invalid: jax.Array
    enough_feasible: jax.Array
    objective: jax.Array
    cost: jax.Array
    best_objective: jax.Array
    least_excess: jax.Array
    spread: jax.Array
    rate: jax.Array
    num_restarts: jax.Array
    status: jax.Array


# --- problems, on the host ------------------------------------------------------------------


def make_problem(
    evaluate: Callable[..., Any],
    family: Any,
    *,
    limit: chex.Array | float | None = None,
    scale: chex.Array | float | None = None,
) -> Problem:
    """A checked :class:`Problem`, on the host.

    Args:
      evaluate: ``(parameters float[D], key) -> (objective, cost)`` of one policy, with a scalar
        objective, a scalar cost or ``float[C]``; or the objective alone, for the
        unconstrained method. Give arrays that it needs by
        ``jax.tree_util.Partial(function, *arrays)``: what a function closes over is compiled in.
      family: the first distribution, such as ``diagonal_gaussian(mean, std)``.
      limit: feasible is ``cost <= limit``: a number for one cost, ``float[C]`` for several;
        infinite for none. None: no constraint.
      scale: what violations are divided by before the largest counts, a number or ``float[C]``;
        default ``|limit|``, or 1 where that is zero or infinite. Of no effect with one cost.

    Returns:
      :class:`Problem`.

    Raises:
      ValueError: evaluate returns other shapes, or a limit or scale that does not fit or is no
        limit or scale.

    Example:
      >>> def evaluate(x, key):
      ...     return -jnp.sum((x - 1.0) ** 2), x[0]
      >>> problem = make_problem(evaluate, families.diagonal_gaussian(jnp.zeros(2), 1.0), limit=0.5)
      >>> problem.limit.tolist(), problem.scale.tolist()
      ([0.5], [0.5])
    """
    evaluate = as_partial(evaluate, "evaluate")
    try:
        point = families.center(family)
    except TypeError as problem:
        raise ValueError(f"family: {problem}") from None
    shapes = jax.eval_shape(lambda e, x, k: split(e(x, k)), evaluate, point, jax.random.key(0))
    num_costs = shapes[1].shape[0]
    if num_costs == 0 and limit is not None:
        raise ValueError(
            f"limit={limit}, but evaluate returns no cost; return (objective, cost), or give no "
            "limit."
        )
    if num_costs > 1 and limit is not None and np.ndim(limit) == 0:
        raise ValueError(
            f"limit={limit}, but evaluate returns {num_costs} costs; give one limit for each, "
            f"float[{num_costs}], infinite where there is none."
        )
    limits = per_cost("limit", math.inf if limit is None else limit, num_costs)
    if np.isnan(limits).any() or (limits == -np.inf).any():
        raise ValueError(
            f"limit={limits.tolist()}; no cost is at most NaN or minus infinity: give numbers, or "
            "infinity for no limit."
        )
    if scale is None:
        size = np.abs(limits)
        scale = np.where((size > 0) & np.isfinite(size), size, 1.0)
    scales = per_cost("scale", scale, num_costs)
    if not ((scales > 0) & np.isfinite(scales)).all():
        raise ValueError(f"scale={scales.tolist()}; it must be positive and finite.")
    return Problem(
        evaluate, family, jnp.asarray(limits, point.dtype), jnp.asarray(scales, point.dtype)
    )


# --- the learner ----------------------------------------------------------------------------


def _init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """The first distribution, before any sample."""
    _check(problem, hparams)
    require_key(key)
    point = families.center(problem.family)
    dtype = point.dtype

    def sample(objective: float, excess: float) -> Sample:
        return Sample(
            jnp.zeros_like(point),
            jnp.asarray(objective, dtype),
            jnp.full_like(problem.limit, jnp.nan),
            jnp.asarray(excess, dtype),
            jnp.bool_(False),
        )

    elites = None
    if hparams.elite_reuse:
        num = num_elites(hparams.rho, hparams.population)
        elites = Pool(
            jnp.zeros((num, *point.shape), dtype),
            jnp.zeros(num, dtype),
            jnp.zeros((num, *problem.limit.shape), dtype),
            jnp.zeros(num, bool),
        )
    zero = jnp.int32(0)
    return State(
        key=key,
        step=zero,
        family=problem.family,
        best=sample(-jnp.inf, jnp.inf),
        least=sample(jnp.nan, jnp.inf),
        elites=elites,
        num_evaluated=zero,
        num_invalid=zero,
        num_restarts=zero,
        status=jnp.int32(Status.COMPLETED),
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One population: drawn, evaluated, ranked, and the distribution moved."""
    _check(problem, hparams)
    _require_state(state, problem)
    draw_key, evaluate_key = jax.random.split(learner.step_key(state))
    draw = families.sample_antithetic if hparams.antithetic else families.sample
    samples = draw(state.family, draw_key, hparams.population)
    objective, cost = evaluate_all(problem, hparams, samples, evaluate_key)
    num_samples, count = _sizes(hparams, state.step)
    fresh = Pool(samples, objective, cost, jnp.arange(hparams.population) < num_samples)
    pool = fresh
    if hparams.elite_reuse:
        pool = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), fresh, state.elites)
    limit = problem.limit - hparams.margin
    chosen = select(
        pool.objective,
        pool.cost,
        limit,
        num=num_elites(hparams.rho, hparams.population),
        count=count,
        scale=problem.scale,
        active=pool.active,
    )
    elites = replace(rows_of(pool, chosen.index), active=chosen.taken)
    rate = jnp.asarray(at(hparams.rate, state.step), samples.dtype)
    family = _moved(state, hparams, fresh, elites, chosen.enough_feasible, rate)
    family, restarted = _restarted(family, problem, hparams)

    feasible, usable, excess = (
        x[: hparams.population] for x in (chosen.feasible, chosen.usable, chosen.excess)
    )
    invalid = num_samples - jnp.sum(usable)
    fine = jnp.any(usable)
    for x in jax.tree.leaves(family):
        fine &= jnp.isfinite(x).all()
    new = replace(
        state,
        step=state.step + 1,
        family=family,
        best=better(state.best, fresh, excess, feasible, objective, state.best.objective),
        least=better(state.least, fresh, excess, usable, -excess, -state.least.excess),
        elites=elites if hparams.elite_reuse else None,
        num_evaluated=learner.saturating_add(state.num_evaluated, num_samples),
        num_invalid=learner.saturating_add(state.num_invalid, invalid),
        num_restarts=state.num_restarts + restarted.astype(jnp.int32),
        status=jnp.where(fine, Status.COMPLETED, Status.NONFINITE).astype(jnp.int32),
    )
    num_usable = jnp.sum(usable)
    return new, Metrics(
        num_evaluated=new.num_evaluated,
        num_feasible=jnp.sum(feasible),
        num_invalid=invalid,
        enough_feasible=chosen.enough_feasible,
        objective=jnp.sum(jnp.where(usable, objective, 0)) / num_usable,
        cost=jnp.sum(jnp.where(usable[:, None], cost, 0), axis=0) / num_usable,
        best_objective=new.best.objective,
        least_excess=new.least.excess,
        spread=jnp.max(families.standard_deviation(family)),
        rate=rate,
        num_restarts=new.num_restarts,
        status=new.status,
    )


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The mean policy of the last distribution: parameters ``float[D]`` of what is evaluated.

    It may be infeasible: see :func:`result`, which evaluates it anew.

    Args:
      state: of one run; ``vmap`` over several.
      problem, hparams: of the run.

    Returns:
      ``float[D]``.

    Raises:
      ValueError: what is given is not of this search.
    """
    _require_ours(problem, hparams)
    validation.instance("state", state, State, "one of cce.init or cce.train")
    return families.center(state.family)


def _sizes(hparams: Hparams, step: jax.Array) -> tuple[jax.Array, jax.Array]:
    """n_l and k_l."""
    most, rho = hparams.population, hparams.rho
    if hparams.num_samples is None:
        return jnp.int32(most), jnp.int32(num_elites(rho, most))
    asked = jnp.round(jnp.asarray(at(hparams.num_samples, step), float))
    num_samples = jnp.clip(asked, math.ceil(1 / rho - SLACK), most).astype(jnp.int32)
    counts = jnp.asarray([num_elites(rho, n) for n in range(most + 1)], jnp.int32)
    return num_samples, counts[num_samples]


def _moved(
    state: State, hparams: Hparams, fresh: Pool, elites: Pool, enough: jax.Array, rate: jax.Array
) -> Any:
    """The distribution after (4.14), and after what is added to it."""
    weights = elite_weights(
        elites.objective,
        elites.active,
        enough,
        weighting=hparams.weighting,
        temperature=hparams.temperature,
    )
    some = jnp.any(elites.active)
    samples, total = elites.parameters, rate
    if hparams.sample_share is not None:
        share = (1 - rate) * at(hparams.sample_share, state.step)
        total = jnp.asarray(rate + share, rate.dtype)
        own = fresh.active / jnp.sum(fresh.active, dtype=rate.dtype)
        samples = jnp.concatenate([samples, fresh.parameters])
        weights = jnp.concatenate([rate * weights, share * own])
    weights = jnp.where(some, weights, 1)
    moved = families.project(state.family, samples, weights, total)
    if hparams.noise is not None:
        moved = families.widen(moved, at(hparams.noise, state.step))
    if hparams.variance_floor is not None:
        moved = families.at_least(moved, hparams.variance_floor)
    return jax.tree.map(lambda x, y: jnp.where(some, x, y).astype(y.dtype), moved, state.family)


def _restarted(family: Any, problem: Problem, hparams: Hparams) -> tuple[Any, jax.Array]:
    if hparams.restart_below is None:
        return family, jnp.bool_(False)
    narrow = jnp.all(families.standard_deviation(family) < hparams.restart_below)
    return jax.tree.map(lambda x, y: jnp.where(narrow, x, y), problem.family, family), narrow


# --- what was found -------------------------------------------------------------------------


@brief
@struct.dataclass
class Assessment:
    """A policy evaluated anew.

    Attributes:
      parameters: ``float[D]``.
      objective: ``float[]``, the mean over the evaluations.
      cost: ``float[C]``, likewise; the estimate of H.
      lower, upper: ``float[C]``, a 95% confidence interval of each cost (Student's). A cost that
        never varied has an interval of length zero.
      excess: ``float[]``, ``max_c (cost_c - limit_c) / scale_c``.
      feasible: ``bool[]``, whether every cost is at most its limit.
      confident: ``bool[]``, whether every `upper` is.
    """

    parameters: jax.Array
    objective: jax.Array
    cost: jax.Array
    lower: jax.Array
    upper: jax.Array
    excess: jax.Array
    feasible: jax.Array
    confident: jax.Array


@brief
class Result(NamedTuple):
    """What a search found, by evaluations of its own.

    Attributes:
      solution: ``float[D]``, the feasible one of `mean` and `best` with the higher objective;
        None if neither is feasible.
      solution_name: ``"mean"`` or ``"best"``, or None.
      mean: the mean policy of the last distribution.
      best: the best feasible sample; if there was none, the sample of the least violation.
      violation: the least `excess` of the two; of at most 0 where there is a solution.
      num_evaluations: of each.
      message: one sentence that tells it.
    """

    solution: jax.Array | None
    solution_name: str | None
    mean: Assessment
    best: Assessment
    violation: float
    num_evaluations: int
    message: str


def assess(
    problem: Problem, parameters: jax.Array, key: chex.PRNGKey, *, num_evaluations: int = 1000
) -> Assessment:
    """A policy evaluated with `num_evaluations` keys of its own. Under ``jit`` and ``vmap``.

    Args:
      problem: of the search.
      parameters: ``float[D]``.
      key: fresh.
      num_evaluations: calls of evaluate, at least 2; static.

    Returns:
      :class:`Assessment`.

    Raises:
      ValueError: fewer than two evaluations, or what is not of this search.
    """
    num_evaluations = validation.integer("num_evaluations", num_evaluations, most=2**31 - 1)
    if num_evaluations < 2:
        raise ValueError(
            f"num_evaluations={num_evaluations}; a confidence interval needs at least 2."
        )
    validation.instance("problem", problem, Problem, "one of cce.make_problem")
    shape = families.center(problem.family).shape
    if not hasattr(parameters, "dtype") or jnp.shape(parameters) != shape:
        raise ValueError(
            f"parameters is {validation.shorten(parameters)}; give those of one policy, float{[*shape]}, "
            "such as cce.policy(state, problem, hparams). Many are a vmap."
        )
    return _assessed(problem, parameters, require_key(key), num_evaluations)


@partial(jax.jit, static_argnames="num_evaluations")
def _assessed(
    problem: Problem, parameters: jax.Array, key: chex.PRNGKey, num_evaluations: int
) -> Assessment:
    from scipy.special import stdtrit

    keys = jax.random.split(key, num_evaluations)
    objective, cost = jax.vmap(partial(scores, problem), (None, 0))(parameters, keys)
    objective, (mean, deviation) = _moments(objective)[0], _moments(cost)
    margin = float(stdtrit(num_evaluations - 1, 0.975)) / math.sqrt(num_evaluations) * deviation
    known = jnp.isfinite(mean)
    lower, upper = (jnp.where(known, mean + s * margin, s * jnp.inf) for s in (-1, 1))
    real = objective < jnp.inf  # and no NaN
    return Assessment(
        parameters=parameters,
        objective=objective,
        cost=mean,
        lower=lower,
        upper=upper,
        excess=jnp.max((mean - problem.limit) / problem.scale, axis=-1, initial=-jnp.inf),
        feasible=real & (mean <= problem.limit).all(),
        confident=real & (upper <= problem.limit).all(),
    )


def _moments(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation; a constant's are exact."""
    offset = x - x[0]
    mean = jnp.mean(offset, axis=0)
    deviation = jnp.sqrt(jnp.sum(jnp.square(offset - mean), axis=0) / (len(x) - 1))
    return jnp.where(jnp.isfinite(x[0]), x[0] + mean, jnp.mean(x, axis=0)), deviation


def result(
    state: State,
    problem: Problem,
    hparams: Hparams,
    key: chex.PRNGKey,
    *,
    num_evaluations: int = 1000,
) -> Result:
    """The mean policy and the best sample on fresh randomness, and the solution; on the host.

    Args:
      state: of one run; take one lane of a batch.
      problem, hparams: of the run.
      key: fresh.
      num_evaluations: calls of evaluate for each of the two.

    Returns:
      :class:`Result`.

    Raises:
      ValueError: no sample of the last step could be evaluated, a batch of states, or what is not
        of this search.
    """
    _require_ours(problem, hparams)
    validation.instance("state", state, State, "one of cce.init or cce.train")
    require_key(key)
    if jnp.ndim(state.step):
        raise ValueError(
            f"state holds a batch of {np.shape(state.step)} runs; take one: "
            "jax.tree.map(lambda x: x[i], state)."
        )
    if int(state.status) == Status.NONFINITE:
        raise ValueError(
            f"step {int(state.step) - 1}: evaluate returned NaN for all samples "
            f"({int(state.num_invalid)} of {int(state.num_evaluated)} in the run). Look for NaN in "
            "the rollout or in the parameters that are drawn."
        )
    keys = jax.random.split(key)
    sampled = state.best if bool(state.best.found) else state.least
    look = partial(assess, problem, num_evaluations=num_evaluations)
    both = {
        "mean": look(families.center(state.family), keys[0]),
        "best": look(sampled.parameters, keys[1]),
    }
    if not bool(sampled.found):  # no step was made
        both["best"] = both["mean"]
    feasible = [name for name in both if bool(both[name].feasible)]
    name = max(feasible, key=lambda n: float(both[n].objective), default=None)
    violation = float(min((float(a.excess) for a in both.values()), key=_nan_last))
    if name is None:
        seen = "" if bool(state.best.found) else " and no sample was"
        message = (
            f"No feasible policy: neither the mean nor the best sample is feasible on "
            f"{num_evaluations} fresh evaluations{seen}; the least violation is {violation:.4g}."
        )
    else:
        sure = "" if bool(both[name].confident) else ", but the interval reaches beyond a limit"
        message = (
            f"The {name} policy is feasible on {num_evaluations} fresh evaluations{sure}; its "
            f"objective is {float(both[name].objective):.6g}."
        )
    return Result(
        None if name is None else both[name].parameters,
        name,
        both["mean"],
        both["best"],
        violation,
        num_evaluations,
        message,
    )


def _nan_last(x: float) -> float:
    return math.inf if math.isnan(x) else x


# --- checks ---------------------------------------------------------------------------------


def _require_ours(problem: Problem, hparams: Hparams) -> None:
    validation.instance("problem", problem, Problem, "one of cce.make_problem")
    validation.instance("hparams", hparams, Hparams, "cce.Hparams")


def _require_state(state: State, problem: Problem) -> None:
    validation.instance("state", state, State, "one of cce.init or cce.train")
    found, own = (families.center(x.family).shape for x in (state, problem))
    if found != own or state.best.cost.shape != problem.limit.shape:
        raise ValueError(
            f"state is of policies float{[*found]} with {len(state.best.cost)} costs, the problem "
            f"of float{[*own]} with {len(problem.limit)}; give the state of a run on this problem."
        )


def _check(problem: Problem, hparams: Hparams) -> None:
    _require_ours(problem, hparams)
    if hparams.rho * hparams.population < 1 - SLACK:
        raise ValueError(
            f"rho={hparams.rho} of population={hparams.population} leaves no elite; "
            "rho * population must be at least 1."
        )
    several = {"margin": problem.limit.shape}
    if hparams.noise is not None and not is_schedule(hparams.noise):
        several["noise"] = families.center(problem.family).shape
    for name, shape in several.items():
        number = getattr(hparams, name)
        if np.ndim(number):
            require_shape(name, number, shape)
        else:
            validation.require_in_range(name, number, Range())
    sharding = hparams.sharding
    if sharding is not None and not isinstance(sharding, jax.sharding.NamedSharding):
        raise ValueError(
            f"sharding is a {type(sharding).__name__}; give a jax.sharding.NamedSharding."
        )
