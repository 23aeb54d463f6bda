"""Problems, hyperparameters, state and metrics of trust-region methods."""

from __future__ import annotations


import jax
import jax.numpy as jnp

from jaxltl.algos.common.moments import Moments
from jaxltl.algos.common.settings import COUNT, MAX_INT, Number, RunState, static, traced
from jaxltl.core import struct, validation
from jaxltl.core.array_types import Numeric, PyTree
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    flat_observation,
    require_environment,
)
from jaxltl.core.types import require_shape
from jaxltl.core.validation import Range


@struct.dataclass
class Problem:
    """An environment with a horizon and a limit on costs; made by :func:`make_problem`.

    Attributes:
      environment: with a box of actions; actions outside are clipped.
      limit: ``float[]``, on the expected cost of a trajectory, or None.
      horizon: T, maximal number of steps of a trajectory; static.
    """

    environment: Environment
    limit: jax.Array | None
    horizon: int = struct.field(pytree_node=False)


def make_problem(
    environment: Environment, *, horizon: int | None = None, limit: Numeric | None = None
) -> Problem:
    """A checked :class:`Problem` of an `environment` with a box of floating-point actions.

    `horizon` is T, at least 1, by default the environment's; `limit` bounds the expected cost of a
    trajectory, and may be negative. CPO needs it.

    Raises:
      ValueError: not an environment, finitely many actions, no horizon, a horizon below 1, or a limit
        that is not a number.

    >>> from jaxltl import make_environment
    >>> from jaxltl.core.environments.environment import Timestep, make_box
    >>> world = make_environment(
    ...     lambda key: jax.random.uniform(key, (1,)),
    ...     lambda place, action, key: Timestep(place, place[0], place[0] > 9, cost=action[0]),
    ...     lambda place: place, actions=make_box(-jnp.inf, jnp.inf, (1,)))
    >>> float(make_problem(world, horizon=5, limit=1.0).limit)
    1.0
    """
    environment = require_environment(environment)
    actions = environment.actions
    if not isinstance(actions, Box) or not jnp.issubdtype(jnp.dtype(actions.dtype), jnp.floating):
        raise ValueError(
            f"the environment's actions are {actions}; trust-region search draws from a Gaussian: "
            "give a box of floats, or learn finitely many actions with ppo."
        )
    horizon = environment.horizon if horizon is None else horizon
    if horizon is None:
        raise ValueError(
            "episodes that never end: neither the environment nor horizon says after how many "
            "steps; give horizon, or with_time_limit(environment, num_steps)."
        )
    horizon = validation.integer("horizon", horizon, least=1, most=2**31 - 1)
    if limit is not None:
        known = isinstance(limit, jax.Array)
        limit = jnp.asarray(
            limit if known else validation.float_array("limit", limit), jnp.result_type(float)
        )
        require_shape("limit", limit, ())
    return Problem(environment=environment, limit=limit, horizon=horizon)


def observed_vector(problem: Problem, world: PyTree) -> jax.Array:
    """The flattened observation ``float[O]``."""
    return flat_observation(problem.environment.observe(world))


METHODS = ("trpo", "cpo")


@struct.dataclass
class Hparams:
    """Settings; numbers are traced, None is static.

    Attributes:
      discount: of rewards, in [0, 1]; multiplied by the environment's.
      cost_discount: of costs; 1 limits the expected sum of a trajectory's costs; default 1.0.
      gae_lambda, cost_gae_lambda: of the advantages of rewards and of costs: 1 has no bias, 0 least
        variance; default 0.97 and 0.97.
      delta: bound on the mean divergence of a step; default 0.01.
      damping: multiple of the identity added to the Fisher matrix; default 1e-3.
      penalty: TRPO only: maximise ``reward - penalty * cost``; None: the reward; default None.
      initial_deviation: standard deviation of the first policy; default 1.0.
      backtrack: factor of the line search; default 0.8.
      value_rate: Adam's learning rate for the value networks; default 3e-3.
      method: ``"trpo"`` or ``"cpo"``; static; default ``"cpo"``.
      num_trajectories: N, sampled in each step; static; default 200.
      hidden, value_hidden: widths of the tanh layers of the policy and of the value networks;
        ``()`` is linear; static; default ``(32, 32)``.
      normalize: networks read observations standardised by their moments so far; static; default True.
      cg_steps: iterations of the conjugate gradient method; static; default 10.
      search_steps: largest number of tries of the line search; static; default 15.
      fisher_stride: stride of the samples that estimate the Fisher matrix; static; default 1.
      value_epochs: passes of the value networks over the samples; static; default 5.
      value_batches: minibatches of each pass; static; default 8.
    """

    discount: Number = traced(Range(0, 1))
    cost_discount: Number = traced(Range(0, 1), default=1.0)
    gae_lambda: Number = traced(Range(0, 1), default=0.97)
    cost_gae_lambda: Number = traced(Range(0, 1), default=0.97)
    delta: Number = traced(Range(0, open_above=True), default=0.01)
    damping: Number = traced(Range(0, open_above=True), default=1e-3)
    penalty: Number | None = traced(Range(open_below=True, open_above=True), default=None)
    initial_deviation: Number = traced(Range(0, open_above=True), default=1.0)
    backtrack: Number = traced(Range(0, 1), default=0.8)
    value_rate: Number = traced(Range(0, open_above=True), default=3e-3)
    method: str = static(METHODS, default="cpo")
    num_trajectories: int = static(COUNT, default=200)
    hidden: tuple[int, ...] = static(COUNT, default=(32, 32))
    value_hidden: tuple[int, ...] = static(COUNT, default=(32, 32))
    normalize: bool = static(bool, default=True)
    cg_steps: int = static(COUNT, default=10)
    search_steps: int = static(COUNT, default=15)
    fisher_stride: int = static(COUNT, default=1)
    value_epochs: int = static(Range(0, MAX_INT, integer=True), default=5)
    value_batches: int = static(COUNT, default=8)


@struct.dataclass
class State(RunState):
    """A policy, value networks and moments of observations.

    Attributes:
      parameters: of the policy: ``{"mean": network, "log_deviation": float[A]}``.
      values: parameters of the value networks with a leading axis [V]: of rewards, and with CPO of
        costs. They also read the time, on which sums over a finite horizon depend.
      value_moments: ``float[2, V]``, mean and deviation that scale their output.
      optimizer: of `values`.
      moments: of the observations.
      trajectories: ``int32[]``, sampled so far; saturates at 2^31 - 1.
    """

    parameters: PyTree
    values: PyTree
    value_moments: jax.Array
    optimizer: PyTree
    moments: Moments
    trajectories: jax.Array


@struct.metrics
class Metrics:
    """Figures of a step; scalars; means over finite trajectories of the policy before the step.

    Attributes:
      trajectories: sampled so far.
      reward, cost: mean sum of a trajectory's rewards, and of its costs discounted by `cost_discount`.
      cost_error: standard error of `cost`.
      length: mean number of steps.
      deviation: geometric mean of the actions' standard deviations.
      kl: mean divergence of the step.
      reward_gain, cost_gain: of the step, estimated by importance weights; the reward gain in the
        discounted advantage that is maximised.
      scale: factor of the line search; 0 if no step was accepted.
      case: a code of :class:`Case`.
      trust_multiplier, cost_multiplier: lambda and nu, the dual variables.
      unexplained: ``float[V]``, share of the variance of the values' targets that networks miss.
      nonfinite: trajectories with a number that is not finite; no other figure includes them.
      status: COMPLETED; MAX_STEPS if no step was accepted; NONFINITE if `nonfinite` is positive or the
        step was not finite (the policy then stays unchanged).
    """

    trajectories: jax.Array
    reward: jax.Array
    cost: jax.Array
    cost_error: jax.Array
    length: jax.Array
    deviation: jax.Array
    kl: jax.Array
    reward_gain: jax.Array
    cost_gain: jax.Array
    scale: jax.Array
    case: jax.Array
    trust_multiplier: jax.Array
    cost_multiplier: jax.Array
    unexplained: jax.Array
    nonfinite: jax.Array
    status: jax.Array
