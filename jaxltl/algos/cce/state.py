"""Hyperparameters, state and metrics of the cross-entropy method."""

from __future__ import annotations

from functools import partial

import jax
from jaxltl.core import struct
from jax.sharding import NamedSharding

from jaxltl.algos.cce._elites import Sample
from jaxltl.algos.common.schedules import Polynomial as Polynomial, Schedule
from jaxltl.algos.common.settings import COUNT, Number, static, traced
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Status
from jaxltl.core.validation import Range

WEIGHTINGS = ("until_feasible", "literal", "uniform")


@brief
@struct.dataclass
class Hparams:
    """Settings; numbers are traced, None is static.

    The schedules of theorem 1 are ``rate=Polynomial(a, p)`` with p in [-1, 0) and
    ``num_samples=Polynomial(n, beta)``, with `weighting` ``"literal"``: see
    :func:`theorem_conditions`. The defaults do not satisfy its conditions.

    Attributes:
      rate: alpha_l, in (0, 1]; a schedule; default 0.1.
      sample_share: lambda_l, the weight in [0, 1] of the samples' mean against the last mean
        parameter; a schedule, or None for 0; default None.
      num_samples: n_l, a schedule, rounded and clipped to between 1 / rho and `population`; further
        samples are evaluated and masked. None: `population`. Default None.
      temperature: of the weights, positive; 1 if the objective is the logarithm of G. Default 1.0.
      margin: subtracted from the limits in the search, a number or ``float[C]``, not in
        :func:`result`. Random costs are feasible by chance: with normal noise of deviation s and rho
        .2, the search can rest .84 s above a limit without margin. Default 0.0.
      population: the largest n_l; static; default 100.
      rho: share of elites; static; default 0.2.
      weighting: static. ``"until_feasible"``: equal weights until k elites are feasible, then weights
        by G; ``"literal"``: always by G; ``"uniform"``: always equal. Default ``"until_feasible"``.
      elite_reuse: not in the theorem, like all further options: the last elites compete again with
        their old values; static. Default False.
      antithetic: mirrored pairs of samples; static; default False.
      variance_floor: lower bound of the variance in every direction; default None.
      noise: variance added after each step, a schedule (Szita and Lorincz 2006); default None.
      restart_below: the search restarts from the first distribution when all standard deviations are
        below this number, and keeps the best samples. Default None.
      sharding: of the population, such as ``NamedSharding(mesh, PartitionSpec("population"))``; static;
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
    sharding: NamedSharding | None = struct.field(pytree_node=False, default=None)


@brief(codes={"status": Status})
@struct.dataclass
class State:
    """A distribution of policies, and the best samples.

    Attributes:
      key, step: root key, and steps made, ``int32[]``.
      family: the distribution.
      best: the feasible sample with the highest objective by its one evaluation: parameters
        ``float[D]``, objective ``float[]`` and cost ``float[C]``.
      least: the sample of the least violation, likewise.
      elites: of the last step; None without reuse.
      num_evaluated, num_invalid: ``int32[]``, numbers of samples, and of those with an objective NaN
        or plus infinity, or a cost NaN; saturate at 2^31 - 1.
      num_restarts: ``int32[]``.
      status: ``int32[]``, NONFINITE if no sample of the last step was usable (the distribution then
        stays unchanged), else COMPLETED.
    """

    key: jax.Array
    step: jax.Array
    family: PyTree
    best: Sample
    least: Sample
    elites: PyTree
    num_evaluated: jax.Array
    num_invalid: jax.Array
    num_restarts: jax.Array
    status: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures of a step; scalars unless a shape is given.

    Attributes:
      num_evaluated: samples so far.
      num_feasible, num_invalid: of this step's samples.
      enough_feasible: True if the objective chose the elites (case 2).
      objective, cost: means over this step's usable samples; the cost is ``float[C]``.
      best_objective: of the best feasible sample so far; minus infinity without any.
      least_excess: of the sample of the least violation so far.
      spread: the largest standard deviation after the step.
      rate, num_restarts, status: alpha_l, and see :class:`State`.
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
