"""The constrained cross-entropy method (Wen 2019, chapter 4, algorithm 2).

A policy is a vector of parameters with ``evaluate(parameters, key) -> (objective, cost)``: an
objective to maximise, and costs that are feasible up to limits. Policies are sampled from a natural
exponential family. The elites are the k = ceil(rho n) feasible samples of the highest objective, or
while fewer are feasible, the k samples of the least violation. The mean parameter moves towards
theirs (4.14)::

    eta' = alpha sum_i w_i Gamma(x_i) + (1 - alpha) (lambda mean_i Gamma(x_i) + (1 - lambda) eta).

The objective G of the dissertation is positive and weighs the elites; here it is given by its
logarithm, and the weights are ``exp(objective / temperature)``, shifted against overflow.

Only the share of feasible *samples* is controlled: the mean policy can be infeasible, and the best
sample can be best by chance. :func:`result` evaluates both again and names a solution only if it is
feasible. For environments see
:func:`~jaxltl.core.values.evaluation.evaluation.episode_evaluator`.

Example: the point nearest to (1, 1) with a first coordinate of at most 0.5.
  >>> import jax, jax.numpy as jnp
  >>> from jaxltl.algos import cce
  >>> from jaxltl.algos.cce.exponential_family import diagonal_gaussian
  >>> def evaluate(x, key):
  ...     return -jnp.sum((x - 1.0) ** 2), x[0]  # an objective, and a cost
  >>> problem = cce.make_problem(evaluate, diagonal_gaussian(jnp.zeros(2), 1.0), limit=0.5)
  >>> key, fresh = jax.random.split(jax.random.key(0))
  >>> hparams = cce.Hparams(rate=0.5)
  >>> state, metrics = cce.train(key, problem, hparams, num_steps=50)
  >>> metrics.max_deviation.shape, cce.policy(state, problem, hparams).shape
  ((50,), (2,))
  >>> solved = cce.result(fresh, state, problem, hparams)
  >>> solved.solution.round(2).tolist(), bool(solved.solution[0] <= 0.5)
  ([0.5, 1.0], True)
  >>> again = jax.eval_shape(
  ...     lambda key, x: cce.assess(key, problem, x, num_evaluations=10), key, problem.family.mean)
  >>> again.upper.shape
  (1,)
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.cce import exponential_family as families
from jaxltl.algos.cce.state import (
    WEIGHTINGS,
    Hparams,
    Metrics,
    Problem,
    Sample,
    State,
    better,
    elite_weights,
    evaluate_all,
    excess_of,
    make_problem,
    num_elites,
    rows_of,
    scores,
    select,
)
from jaxltl.algos.common import learner
from jaxltl.algos.common.schedules import Polynomial as Polynomial, SLACK, at, is_schedule
from jaxltl.algos.common.settings import require_own
from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import require_key
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import Status, require_shape
from jaxltl.core.validation import Range


__all__ = [
    "WEIGHTINGS",
    "Assessment",
    "Hparams",
    "Metrics",
    "Polynomial",
    "Problem",
    "SearchResult",
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


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """The first distribution, without samples."""
    _check(problem, hparams)
    require_key(key)
    point = families.center(problem.family)
    none = Sample(
        jnp.zeros_like(point),
        jnp.asarray(-jnp.inf, point.dtype),
        jnp.full_like(problem.limit, jnp.nan),
        jnp.asarray(jnp.inf, point.dtype),
        jnp.bool_(False),
    )
    elites = None
    if hparams.elite_reuse:
        num = num_elites(hparams.rho, hparams.population)
        elites = jax.tree.map(lambda x: jnp.zeros((num, *x.shape), x.dtype), none)
    zero = jnp.int32(0)
    return State(
        key=key,
        step=zero,
        family=problem.family,
        best=none,
        least=replace(none, objective=none.objective * jnp.nan),
        elites=elites,
        num_evaluated=zero,
        num_invalid=zero,
        num_restarts=zero,
        status=jnp.int32(Status.COMPLETED),
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """One population: sampled, evaluated and ranked, and the distribution moved."""
    _check(problem, hparams)
    _require_state(state, problem)
    draw_key, evaluate_key = jax.random.split(learner.step_key(state))
    draw = families.sample_antithetic if hparams.antithetic else families.sample
    samples = draw(state.family, draw_key, hparams.population)
    objective, cost = evaluate_all(evaluate_key, problem, hparams, samples)
    num_samples, count = _sizes(hparams, state.step)
    active = jnp.arange(hparams.population) < num_samples
    limit = problem.limit - hparams.margin
    excess = excess_of(cost, limit, problem.scale)
    fresh = Sample(samples, objective, cost, excess, active)
    pool = fresh
    if hparams.elite_reuse:
        pool = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), fresh, state.elites)
    chosen = select(
        jnp.where(pool.valid, pool.objective, jnp.inf),
        pool.cost,
        limit,
        num=num_elites(hparams.rho, hparams.population),
        count=count,
        scale=problem.scale,
    )
    elites = replace(rows_of(pool, chosen.index), valid=chosen.taken)
    rate = jnp.asarray(at(hparams.rate, state.step), samples.dtype)
    family = _moved(state, hparams, fresh, elites, chosen.enough_feasible, rate)
    family, restarted = _restarted(family, problem, hparams)

    feasible, usable = (x[: hparams.population] for x in (chosen.feasible, chosen.usable))
    invalid = num_samples - jnp.sum(usable)
    fine = jnp.any(usable)
    for x in jax.tree.leaves(family):
        fine &= jnp.isfinite(x).all()
    new = replace(
        state,
        step=state.step + 1,
        family=family,
        best=better(state.best, fresh, feasible, objective, state.best.objective),
        least=better(state.least, fresh, usable, -excess, -state.least.excess),
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
        max_deviation=jnp.max(families.standard_deviation(family)),
        rate=rate,
        num_restarts=new.num_restarts,
        status=new.status,
    )


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def policy(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """The mean policy ``float[D]`` of the last distribution, which :func:`result` evaluates again."""
    require_own((state, State), (problem, Problem), (hparams, Hparams))
    return families.center(state.family)


def _sizes(hparams: Hparams, step: jax.Array) -> tuple[jax.Array, jax.Array]:
    """n_l and k_l."""
    population, rho = hparams.population, hparams.rho
    if hparams.num_samples is None:
        return jnp.int32(population), jnp.int32(num_elites(rho, population))
    requested = jnp.round(jnp.asarray(at(hparams.num_samples, step), float))
    num_samples = jnp.clip(requested, math.ceil(1 / rho - SLACK), population).astype(jnp.int32)
    counts = jnp.asarray([num_elites(rho, n) for n in range(population + 1)], jnp.int32)
    return num_samples, counts[num_samples]


def _moved(
    state: State,
    hparams: Hparams,
    fresh: Sample,
    elites: Sample,
    enough: jax.Array,
    rate: jax.Array,
) -> PyTree:
    """The distribution after (4.14) and the options that add variance."""
    weights = elite_weights(
        elites.objective,
        elites.valid,
        enough,
        weighting=hparams.weighting,
        temperature=hparams.temperature,
    )
    some = jnp.any(elites.valid)
    samples, total = elites.parameters, rate
    if hparams.sample_share is not None:
        share = (1 - rate) * at(hparams.sample_share, state.step)
        total = jnp.asarray(rate + share, rate.dtype)
        own = fresh.valid / jnp.sum(fresh.valid, dtype=rate.dtype)
        samples = jnp.concatenate([samples, fresh.parameters])
        weights = jnp.concatenate([rate * weights, share * own])
    weights = jnp.where(some, weights, 1)
    moved = families.project(state.family, samples, weights, total)
    if hparams.noise is not None:
        moved = families.widen(moved, at(hparams.noise, state.step))
    if hparams.variance_floor is not None:
        moved = families.at_least(moved, hparams.variance_floor)
    return jax.tree.map(lambda x, y: jnp.where(some, x, y).astype(y.dtype), moved, state.family)


def _restarted(family: PyTree, problem: Problem, hparams: Hparams) -> tuple[PyTree, jax.Array]:
    if hparams.restart_below is None:
        return family, jnp.bool_(False)
    narrow = jnp.all(families.standard_deviation(family) < hparams.restart_below)
    return jax.tree.map(lambda x, y: jnp.where(narrow, x, y), problem.family, family), narrow


def _require_state(state: State, problem: Problem) -> None:
    require_own((state, State))
    shape, own = (families.center(x.family).shape for x in (state, problem))
    if shape != own or state.best.cost.shape != problem.limit.shape:
        raise ValueError(
            f"state is of policies float{[*shape]} with {len(state.best.cost)} costs, the problem "
            f"of float{[*own]} with {len(problem.limit)}; give the state of a run on this problem."
        )


def _check(problem: Problem, hparams: Hparams) -> None:
    require_own((problem, Problem), (hparams, Hparams))
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


@struct.dataclass
class Assessment:
    """A policy with fresh evaluations.

    Attributes:
      parameters: ``float[D]``.
      objective: ``float[]``, mean over the evaluations.
      cost: ``float[C]``, likewise; the estimate of H.
      lower, upper: ``float[C]``, a 95% confidence interval of each cost (Student's t); of length zero
        for a constant cost.
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
class SearchResult(NamedTuple):
    """The solution of a search, by fresh evaluations.

    Attributes:
      solution: ``float[D]``, the feasible one of `mean` and `best` with the higher objective; None if
        neither is feasible.
      solution_name: ``"mean"`` or ``"best"``, or None.
      mean: the mean policy of the last distribution.
      best: the best feasible sample, or without any, the sample of the least violation.
      violation: the least `excess` of the two; at most 0 if there is a solution.
      num_evaluations: of each.
      message: one sentence.
    """

    solution: jax.Array | None
    solution_name: str | None
    mean: Assessment
    best: Assessment
    violation: float
    num_evaluations: int
    message: str


def assess(
    key: Key, problem: Problem, parameters: jax.Array, *, num_evaluations: int = 1000
) -> Assessment:
    """The :class:`Assessment` of a policy `parameters`, ``float[D]``, on fresh evaluations.

    With `num_evaluations`, at least 2, static, of a `problem` with keys of a fresh `key`; for ``jit``
    and ``vmap``; not differentiable.

    Raises:
      ValueError: fewer than two evaluations, or arguments of another search.
    """
    num_evaluations = validation.integer("num_evaluations", num_evaluations, limit=2**31 - 1)
    if num_evaluations < 2:
        raise ValueError(
            f"num_evaluations={num_evaluations}; a confidence interval needs at least 2."
        )
    require_own((problem, Problem))
    shape = families.center(problem.family).shape
    if not hasattr(parameters, "dtype") or jnp.shape(parameters) != shape:
        raise ValueError(
            f"parameters is {validation.shorten(parameters)}; give those of one policy, float{[*shape]}, "
            "such as cce.policy(state, problem, hparams). Many are a vmap."
        )
    return _assessed(require_key(key), problem, parameters, num_evaluations)


@partial(jax.jit, static_argnames="num_evaluations")
def _assessed(
    key: Key, problem: Problem, parameters: jax.Array, num_evaluations: int
) -> Assessment:
    from scipy.special import stdtrit

    keys = jax.random.split(key, num_evaluations)
    objective, cost = jax.vmap(lambda key: scores(key, problem, parameters))(keys)
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
        excess=excess_of(mean, problem.limit, problem.scale),
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
    key: Key, state: State, problem: Problem, hparams: Hparams, *, num_evaluations: int = 1000
) -> SearchResult:
    """The :class:`SearchResult` of a search: the mean policy and the best sample on fresh evaluations.

    On the host, of the `state`, `problem` and `hparams` of one run, with `num_evaluations` of each policy by
    keys of a fresh `key`.

    Raises:
      ValueError: the last step had no usable sample, a batch of states, or arguments of another search.
    """
    require_own((state, State), (problem, Problem), (hparams, Hparams))
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
    sampled = state.best if bool(state.best.valid) else state.least
    points = {"mean": families.center(state.family), "best": sampled.parameters}
    both = {
        name: assess(key, problem, point, num_evaluations=num_evaluations)
        for key, (name, point) in zip(keys, points.items(), strict=True)
    }
    if not bool(sampled.valid):  # no step was made
        both["best"] = both["mean"]
    feasible = [name for name in both if bool(both[name].feasible)]
    name = max(feasible, key=lambda n: float(both[n].objective), default=None)
    violation = float(np.fmin.reduce([float(a.excess) for a in both.values()]))
    if name is None:
        seen = "" if bool(state.best.valid) else " and no sample was"
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
    return SearchResult(
        None if name is None else both[name].parameters,
        name,
        both["mean"],
        both["best"],
        violation,
        num_evaluations,
        message,
    )
