"""Fresh evaluations of policies, and the solution of a search."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.cce import exponential_family as families
from jaxltl.algos.cce.state import Hparams, Problem, State, scores
from jaxltl.algos.common.schedules import Polynomial as Polynomial
from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key
from jaxltl.core.environments.environment import require_key
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import Status


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
class Result(NamedTuple):
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
    problem: Problem, parameters: jax.Array, key: Key, *, num_evaluations: int = 1000
) -> Assessment:
    """The :class:`Assessment` of a policy `parameters`, ``float[D]``, on fresh evaluations.

    With `num_evaluations`, at least 2, static, of a `problem` with keys of a fresh `key`; for ``jit``
    and ``vmap``; not differentiable.

    Raises:
      ValueError: fewer than two evaluations, or arguments of another search.
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
    problem: Problem, parameters: jax.Array, key: Key, num_evaluations: int
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
    state: State, problem: Problem, hparams: Hparams, key: Key, *, num_evaluations: int = 1000
) -> Result:
    """The :class:`Result` of a search: the mean policy and the best sample on fresh evaluations.

    On the host, of the `state`, `problem` and `hparams` of one run, with `num_evaluations` of each policy by
    keys of a fresh `key`.

    Raises:
      ValueError: the last step had no usable sample, a batch of states, or arguments of another search.
    """
    require_run(problem, hparams)
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
    violation = float(np.fmin.reduce([float(a.excess) for a in both.values()]))
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


def require_run(problem: Problem, hparams: Hparams) -> None:
    """Raises ValueError for a problem or hyperparameters of another learner."""
    validation.instance("problem", problem, Problem, "one of cce.make_problem")
    validation.instance("hparams", hparams, Hparams, "cce.Hparams")
