"""Trust-region policy search: TRPO, and CPO, which keeps to a limit on costs.

Both draw trajectories with a Gaussian policy ``pi`` and change its parameters by a step ``x``
that solves, to first order in the gains and to second order in the divergence::

    maximise   g . x    subject to   x . H x / 2 <= delta,   and for CPO   c + b . x <= 0,

where ``g`` and ``b`` are the gradients of the reward and of the cost of a trajectory, estimated
by generalised advantages (Schulman et al. 2016), ``H`` is the Fisher matrix, the Hessian of the
mean ``KL(old || new)``, and ``c = J_C - limit``. TRPO (Schulman et al. 2015) follows
``H^-1 g``; CPO (Achiam et al. 2017) a combination of ``H^-1 g`` and ``H^-1 b`` that the dual of
the problem gives in closed form, :func:`cpo_dual`. A line search then makes the step short
enough for the true divergence, and for the gains as far as the sample tells them.

A trajectory is an episode of an :class:`~jaxltl.core.environments.environment.Environment` with a box of
actions. It ends where the environment terminates or truncates it, or after ``horizon`` steps. After
a termination nothing comes, and what would come after the horizon does not count: both are the end
of a sum of rewards. Where the environment truncates an episode something would come, and what it
would be worth is added, as the value network expects it of the last observation. Costs are limited
as they are drawn: what would come after a trajectory never counts in them.

Example: a point that is pushed about; the reward is for being near, the cost is the push. (What is
compiled for a step takes seconds, so shapes alone are shown.)

  >>> import jax, jax.numpy as jnp
  >>> import jaxltl as jl
  >>> from jaxltl.algos import trust_region
  >>> def reset(key):
  ...     return jax.random.uniform(key, (2,), minval=-1)
  >>> def step(world, action, key):
  ...     place = world + 0.3 * action
  ...     return jl.environments.Timestep(
  ...         place, -jnp.sum(place**2), jnp.abs(place).max() > 4, cost=jnp.sum(action**2))
  >>> world = jl.make_environment(
  ...     reset, step, lambda world: world, actions=jl.environments.make_box(-jnp.inf, jnp.inf, (2,)))
  >>> problem = trust_region.make_problem(world, horizon=4, limit=6.0)
  >>> hparams = trust_region.Hparams(
  ...     discount=0.9, method="cpo", num_trajectories=6, hidden=(3,), value_hidden=(), cg_steps=3,
  ...     value_epochs=1, value_batches=2)
  >>> state = jax.eval_shape(  # of train, which is init and run
  ...     lambda key: trust_region.init(key, problem, hparams), jax.random.key(0))
  >>> after, metrics = jax.eval_shape(  # run is step after step; run_until, train_until end early
  ...     lambda state: trust_region.step(state, problem, hparams), state)
  >>> metrics.reward.shape, metrics.unexplained.shape  # of rewards and of costs
  ((), (2,))
  >>> mean, deviation = jax.eval_shape(  # trust_region.policy draws; greedy takes the mean
  ...     lambda state: trust_region.act(state, hparams, jnp.zeros(2)), state)
  >>> mean.shape, deviation.shape  # trust_region.rollout has whole trajectories
  ((2,), (2,))

``train`` is ``init`` and ``run``, which is ``step`` after ``step``; ``train_until`` and
``run_until`` end early. Many seeds are
``jax.vmap(lambda key: train(key, problem, hparams, num_steps=...))(keys)``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.tree_util import Partial

from jaxltl.algos.common.settings import COUNT, MAX_INT, Number, static, traced
from jaxltl.core.validation import Range
from jaxltl.algos.common import learner
from jaxltl.algos.common.moments import Moments, no_moments, updated_moments
from jaxltl.algos.trust_region._policy_networks import (
    gaussian,
    inputs_at,
    kl_divergence,
    mean_network,
    normalized,
    refolded,
    value_inputs,
    value_network,
    values_at,
)
from jaxltl.algos.trust_region._step import (
    Surrogate,
    direction,
    fisher_product,
    line_search,
    surrogate,
)
from jaxltl.algos.trust_region._value_fit import advantages, fitted, positive, weighted_variance
from jaxltl.core import validation
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    Timestep,
    clipped_action,
    flat_observation,
    require_environment,
    require_key,
    some_action,
)
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.pretty_print import brief, history
from jaxltl.core.types import Status, require_shape

__all__ = [
    "METHODS",
    "Batch",
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "act",
    "greedy",
    "init",
    "make_problem",
    "policy",
    "rollout",
    "run",
    "run_until",
    "step",
    "train",
    "train_until",
]

METHODS = ("trpo", "cpo")


@brief
@struct.dataclass
class Problem:
    """A world, made by :func:`make_problem`.

    Attributes:
      environment: whose actions are a box. Those that are drawn outside of it are clipped.
      limit: ``float[]``, on the expected cost of a trajectory; None: there is none.
      horizon: T, steps of a trajectory at most; static.
    """

    environment: Environment
    limit: Any
    horizon: int = struct.field(pytree_node=False)


@brief
@struct.dataclass
class Hparams:
    """How to learn. Numbers are traced, so new values do not recompile; None is static.

    Attributes:
      discount: of rewards, in [0, 1], times that of each step of the environment.
      cost_discount: of costs; 1 limits the expected sum of a trajectory's costs; default 1.0.
      gae_lambda: of the generalised advantage of rewards: 1 has no bias, 0 least variance;
        default 0.97.
      cost_gae_lambda: the same of costs. Costs that come late need a value near 1. Default 0.97.
      delta: the mean divergence that a step may cause; default 0.01.
      damping: added to the Fisher matrix, times the identity; default 1e-3.
      penalty: TRPO only: learn from ``reward - penalty * cost``; None: from the reward;
        default None.
      initial_deviation: the standard deviation of the first policy's actions; default 1.0.
      backtrack: how much shorter each try of the line search is than the one before; default 0.8.
      value_rate: learning rate of the value networks (Adam); default 3e-3.
      method: ``"trpo"`` or ``"cpo"``; static; default ``"cpo"``.
      num_trajectories: N, drawn in each step; static; default 200.
      hidden, value_hidden: widths of the tanh layers of the policy and of the value networks;
        ``()`` is linear; static; default ``(32, 32)``.
      normalize: whether networks read observations centred and scaled by their moments so far;
        the policy as a function is not changed by new moments; static; default True.
      cg_steps: of the conjugate gradient; static; default 10.
      search_steps: tries of the line search; static; default 15.
      fisher_stride: the Fisher matrix is estimated from every so many-th sample; static; default 1.
      value_epochs, value_batches: passes over the samples, each in so many batches; static;
        default 5 and 8.
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


@brief
@struct.dataclass
class State:
    """A policy on its way.

    Attributes:
      key: of the whole run.
      step: ``int32[]``, steps made.
      parameters: of the policy: ``{"mean": network, "log_deviation": float[A]}``.
      values: parameters of the value networks with a leading axis [V]: of rewards, and with
        CPO of costs. They also read the time, for sums over a finite horizon depend on it.
      value_moments: ``float[2, V]``, mean and deviation by which their output is scaled.
      optimizer: of `values`.
      moments: of the observations.
      trajectories: ``int32[]``, drawn so far; at most 2^31 - 1 are counted.
    """

    key: jax.Array
    step: jax.Array
    parameters: Any
    values: Any
    value_moments: jax.Array
    optimizer: Any
    moments: Moments
    trajectories: jax.Array


@brief(facts=partial(history, codes={"status": Status}))
@struct.dataclass
class Metrics:
    """Figures of a step; scalars unless a shape is given, of a run ``[T]``. Means are of the policy
    before it, over its finite trajectories.

    Attributes:
      trajectories: drawn so far, this step's included.
      reward: mean sum of a trajectory's rewards, without discount.
      cost: mean sum of its costs, discounted as the limit demands.
      cost_error: standard error of `cost`.
      length: mean number of its steps.
      deviation: geometric mean of the standard deviations of the actions.
      kl: mean divergence that the step caused.
      reward_gain, cost_gain: of the step, as the sample's importance weights tell; the reward
        gain in the discounted advantage that is maximised.
      scale: by which the line search shortened the step; 0 if no length would do.
      case: a code of :class:`Case`.
      trust_multiplier, cost_multiplier: lambda and nu, the dual variables.
      unexplained: ``float[V]``, the share of the variance of the values' targets that the
        networks that were used did not explain.
      nonfinite: trajectories with a number that is not finite; they are left out, so that
        all other figures leave them out too.
      status: COMPLETED; MAX_STEPS if no length of the step would do, so that the policy stays;
        NONFINITE if `nonfinite` is positive or the step was not finite (the policy then stays).
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


@brief
class Batch(NamedTuple):
    """Trajectories side by side, zero where they are over or left out.

    Attributes:
      observation: ``float[T, N, O]``, in one vector each.
      action: ``float[T, N, A]``, as drawn, in one vector each, before they are clipped.
      reward, cost: ``float[T, N]``.
      discount: ``float[T, N]``, the environment's of what comes after each step.
      valid: ``bool[T, N]``, whether the step was made.
      finite: ``bool[N]``; others are left out, so that all of their steps are not valid.
      last: ``float[N, O]``, the observation after the last step.
      truncated: ``bool[N]``, whether the environment cut it off, and it was not over.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    cost: jax.Array
    discount: jax.Array
    valid: jax.Array
    finite: jax.Array
    last: jax.Array
    truncated: jax.Array


# --- problems -------------------------------------------------------------------------------


def make_problem(
    environment: Environment, *, horizon: int | None = None, limit: chex.Numeric | None = None
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      environment: with a box of floating-point actions.
      horizon: T, at least 1; default the environment's.
      limit: on the expected cost of a trajectory; may be negative. CPO needs it.

    Returns:
      :class:`Problem`.

    Raises:
      ValueError: no environment, finitely many actions, episodes that never end, a horizon below
        1, or a limit that is no number.

    Example:
      >>> from jaxltl import make_environment
      >>> from jaxltl.core.environments import make_box
      >>> def reset(key):
      ...     return jax.random.uniform(key, (1,))
      >>> def move(place, action, key):
      ...     place = place + jnp.clip(action, -1, 1)
      ...     return Timestep(place, -abs(place[0]), place[0] > 9, cost=action[0] ** 2)
      >>> world = make_environment(
      ...     reset, move, lambda place: place, actions=make_box(-jnp.inf, jnp.inf, (1,)))
      >>> problem = make_problem(world, horizon=5, limit=1.0)
      >>> float(problem.limit)
      1.0

      Then ``state, metrics = train(key, problem, Hparams(discount=0.99), num_steps=100)``.
    """
    actions = require_environment(environment).actions
    if not isinstance(actions, Box) or not jnp.issubdtype(jnp.dtype(actions.dtype), jnp.floating):
        raise ValueError(
            f"the environment's actions are {actions}; trust-region search draws from a Gaussian: "
            "give a box of floats, or learn finitely many actions with ppo."
        )
    if horizon is None:
        horizon = environment.horizon
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


def _observed(problem: Problem, world: Any) -> jax.Array:
    """``float[O]``."""
    return flat_observation(problem.environment.observe(world))


def _num_actions(problem: Problem) -> int:
    """A, the length of an action as one vector."""
    return math.prod(some_action(problem.environment.actions).shape)


def _as_action(problem: Problem, action: jax.Array) -> jax.Array:
    """An action of the box, of a vector ``float[A]``."""
    actions: Any = problem.environment.actions
    return clipped_action(actions, action.reshape(actions.shape).astype(actions.dtype))


def _require_ours(problem: Problem, hparams: Hparams) -> None:
    validation.instance("problem", problem, Problem, "one of trust_region.make_problem")
    validation.instance("hparams", hparams, Hparams, "trust_region.Hparams")


def _require_state(state: State) -> None:
    validation.instance("state", state, State, "one of trust_region.init or trust_region.train")


def _require_observed(state: State, observation: jax.Array) -> None:
    """Refuses what the policy was not trained on."""
    size = state.moments.mean.shape
    if not hasattr(observation, "dtype") or jnp.shape(observation)[-1:] != size:
        raise ValueError(
            f"observation is {validation.shorten(observation)}; the policy was trained on vectors "
            f"float[..., {size[0]}], as flat_observation makes of an environment's."
        )


def _check(problem: Problem, hparams: Hparams) -> None:
    _require_ours(problem, hparams)
    if hparams.method == "cpo" and problem.limit is None:
        raise ValueError('method="cpo" needs a limit: pass one to make_problem, or use "trpo".')
    if hparams.method == "cpo" and hparams.penalty is not None:
        raise ValueError('penalty is for method="trpo": CPO finds its own multiplier.')
    samples = hparams.num_trajectories * problem.horizon
    if hparams.value_batches > samples:
        raise ValueError(f"value_batches={hparams.value_batches} of {samples} samples; use fewer.")


def policy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """What was learned, an :class:`~jaxltl.core.environments.episodes.Agent` that draws its actions.

    :func:`act` tells the distribution that they are drawn from.

    Args:
      state: of one run.
      problem, hparams: of the run.

    Returns:
      :class:`~jaxltl.core.environments.episodes.Agent`, a pytree.
    """
    return _agent(_drawn, state, problem, hparams)


def greedy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The same, taking the mean of the actions each time.

    Args:
      state: of one run.
      problem, hparams: of the run.

    Returns:
      :class:`~jaxltl.core.environments.episodes.Agent`, a pytree.
    """
    return _agent(_mean, state, problem, hparams)


def _agent(act: Any, state: State, problem: Problem, hparams: Hparams) -> Agent:
    _require_ours(problem, hparams)
    _require_state(state)
    return Agent(Partial(act, state, problem, hparams))


def _drawn(
    state: State,
    problem: Problem,
    hparams: Hparams,
    memory: Any,
    observation: Any,
    allowed: Any,
    key: chex.PRNGKey,
) -> tuple[jax.Array, Any]:
    del allowed
    mean, deviation = act(state, hparams, flat_observation(observation))
    noise = jax.random.normal(key, mean.shape, mean.dtype)
    return _as_action(problem, mean + deviation * noise), memory


def _mean(
    state: State,
    problem: Problem,
    hparams: Hparams,
    memory: Any,
    observation: Any,
    allowed: Any,
    key: chex.PRNGKey,
) -> tuple[jax.Array, Any]:
    del allowed, key
    return _as_action(problem, act(state, hparams, flat_observation(observation))[0]), memory


def act(state: State, hparams: Hparams, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation of the action: both ``float[..., A]``.

    Args:
      state, hparams: of the learner.
      observation: ``float[..., O]``.

    Returns:
      Two arrays, in units of the action before it is clipped; differentiable in the parameters.

    Raises:
      ValueError: what is not of this learner, or an observation of another size.
    """
    validation.instance("hparams", hparams, Hparams, "trust_region.Hparams")
    _require_state(state)
    _require_observed(state, observation)
    return gaussian(state.parameters, hparams, normalized(state.moments, hparams, observation))


# --- trajectories -----------------------------------------------------------------------------


def rollout(
    key: chex.PRNGKey,
    state: State,
    problem: Problem,
    hparams: Hparams,
    *,
    num_trajectories: int,
    sampled: bool = True,
) -> Batch:
    """Trajectories of the policy; the same key gives the same ones.

    Args:
      key: of everything that is drawn.
      state, problem, hparams: of the learner.
      num_trajectories: N; static.
      sampled: whether actions are drawn, or are the policy's mean; static.

    Returns:
      :class:`Batch`. Sums over its first axis are those of trajectories.

    Raises:
      ValueError: what is not of this learner, no number of trajectories, or no truth value.
    """
    _require_ours(problem, hparams)
    _require_state(state)
    number = validation.integer("num_trajectories", num_trajectories, least=1, most=2**31 - 1)
    return _rollout(
        require_key(key), state, problem, hparams, number, validation.boolean("sampled", sampled)
    )


@partial(jax.jit, static_argnames=("num_trajectories", "sampled"))
def _rollout(
    key: chex.PRNGKey,
    state: State,
    problem: Problem,
    hparams: Hparams,
    num_trajectories: int,
    sampled: bool,
) -> Batch:
    start, path = jax.random.split(key)
    worlds = jax.vmap(problem.environment.reset)(jax.random.split(start, num_trajectories))

    def taken(world: Any, action: jax.Array, key: chex.PRNGKey) -> Timestep:
        return Timestep(*problem.environment.step(world, _as_action(problem, action), key))

    def move(carry: Any, key: chex.PRNGKey) -> Any:
        worlds, active, cut = carry
        action_key, world_key = jax.random.split(key)
        observation = jax.vmap(partial(_observed, problem))(worlds)
        mean, deviation = act(state, hparams, observation)
        action = mean
        if sampled:
            action += deviation * jax.random.normal(action_key, mean.shape, mean.dtype)
        found = jax.vmap(taken)(worlds, action, jax.random.split(world_key, num_trajectories))

        def held(x: jax.Array, y: jax.Array) -> jax.Array:
            return jnp.where(active.reshape(-1, *[1] * (x.ndim - 1)), x, y)

        row = (observation, action, found.reward, found.cost, found.discount, active)
        after = jax.tree.map(held, found.world, worlds)
        cut |= active & found.truncated & ~found.terminated
        return (after, active & ~(found.terminated | found.truncated), cut), row

    active = jnp.ones(num_trajectories, bool)
    (worlds, _, truncated), (observation, action, reward, cost, discount, valid) = lax.scan(
        move, (worlds, active, ~active), jax.random.split(path, problem.horizon)
    )
    last, dtype = jax.vmap(partial(_observed, problem))(worlds), observation.dtype
    parts = (observation, action, reward[..., None], cost[..., None], discount[..., None])
    finite = jnp.array([jnp.all(jnp.all(jnp.isfinite(x), -1) | ~valid, 0) for x in parts]).all(
        0
    ) & (jnp.all(jnp.isfinite(last), -1) | ~truncated)
    valid &= finite
    truncated &= finite
    observation, action, reward, cost, discount = (
        jnp.where(valid[..., None], x, 0).astype(dtype) for x in parts
    )
    return Batch(
        observation,
        action,
        reward[..., 0],
        cost[..., 0],
        discount[..., 0],
        valid,
        finite,
        jnp.where(truncated[:, None], last, 0),
        truncated,
    )


def _init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """Random networks. If observations are normalised, a first batch of trajectories is drawn
    for their moments, and counted."""
    _check(problem, hparams)
    return _begun(require_key(key), problem, hparams)


@jax.jit
def _begun(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    seen = jax.eval_shape(lambda k: _observed(problem, problem.environment.reset(k)), key)
    num_actions = _num_actions(problem)
    dtype, (size,), num_values = seen.dtype, seen.shape, 1 + (hparams.method == "cpo")
    mean_key, value_key, first_key = jax.random.split(learner.init_key(key), 3)
    mean = mean_network(hparams, num_actions, dtype).init(mean_key, jnp.zeros(size, dtype))
    log_deviation = jnp.full(num_actions, jnp.log(hparams.initial_deviation), dtype)
    keys = jax.vmap(partial(jax.random.fold_in, value_key))(jnp.arange(num_values))
    values = jax.vmap(lambda k: value_network(hparams, dtype).init(k, jnp.zeros(size + 1, dtype)))(
        keys
    )["params"]
    state = State(
        key=key,
        step=jnp.int32(0),
        parameters={"mean": mean["params"], "log_deviation": log_deviation},
        values=values,
        value_moments=jnp.stack([jnp.zeros(num_values, dtype), jnp.ones(num_values, dtype)]),
        # optax starts from weakly typed zeros, which a second run would compile anew for.
        optimizer=jax.tree.map(
            lambda x: jnp.asarray(x, jnp.result_type(x)),
            optax.adam(hparams.value_rate).init(values),
        ),
        moments=no_moments((size,), dtype),
        trajectories=jnp.int32(0),
    )
    if not hparams.normalize:
        return state
    batch = rollout(first_key, state, problem, hparams, num_trajectories=hparams.num_trajectories)
    return replace(
        state,
        moments=updated_moments(state.moments, batch.observation, batch.valid),
        trajectories=jnp.int32(hparams.num_trajectories),
    )


def _step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """N trajectories, one step of the policy, and the value networks fitted to the same ones."""
    _check(problem, hparams)
    _require_state(state)
    draw_key, fit_key = jax.random.split(learner.step_key(state))
    batch = rollout(draw_key, state, problem, hparams, num_trajectories=hparams.num_trajectories)
    inputs = normalized(state.moments, hparams, batch.observation)
    inputs = jnp.where(batch.valid[..., None], inputs, 0)
    value, found = _estimated(state, batch, inputs, hparams)
    parameters, told = _improved(state.parameters, batch, inputs, found, problem, hparams)
    values, optimizer, value_moments = fitted(
        fit_key, state, value_inputs(inputs), value + found, batch.valid, hparams
    )
    moments = state.moments
    if hparams.normalize:
        moments = updated_moments(state.moments, batch.observation, batch.valid)
        fold = partial(refolded, old=state.moments, new=moments)
        parameters = {**parameters, "mean": fold(parameters["mean"])}
        values = jax.vmap(fold)(values)
    state = State(
        key=state.key,
        step=state.step + 1,
        parameters=parameters,
        values=values,
        value_moments=value_moments,
        optimizer=optimizer,
        moments=moments,
        trajectories=learner.saturating_add(state.trajectories, hparams.num_trajectories),
    )
    left_out = weighted_variance(found, batch.valid)
    return state, replace(
        told,
        trajectories=state.trajectories,
        unexplained=left_out / positive(weighted_variance(value + found, batch.valid)),
    )


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


def _estimated(
    state: State, batch: Batch, inputs: jax.Array, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """Values and advantages ``float[V, T, N]`` of what is learned from."""
    mean, deviation = state.value_moments[..., None, None]
    value = values_at(state.values, hparams, value_inputs(inputs)) * deviation + mean
    value = jnp.where(batch.valid, value, 0)
    length = batch.valid.sum(0)
    ending = normalized(state.moments, hparams, batch.last)
    ending = values_at(state.values, hparams, inputs_at(ending, length, batch.valid.shape[0]))
    after = jnp.where(batch.truncated, ending[0] * deviation[0, 0] + mean[0, 0], 0)
    reward = batch.reward
    if hparams.penalty is not None:
        reward = reward - hparams.penalty * batch.cost
    discount = hparams.discount * batch.discount
    parts = [advantages(reward, value[0], batch.valid, discount, hparams.gae_lambda, after)]
    if hparams.method == "cpo":
        parts.append(
            advantages(
                batch.cost, value[1], batch.valid, hparams.cost_discount, hparams.cost_gae_lambda
            )
        )
    return value, jnp.stack(parts)


def _improved(
    parameters: Any,
    batch: Batch,
    inputs: jax.Array,
    found: jax.Array,
    problem: Problem,
    hparams: Hparams,
) -> tuple[Any, Metrics]:
    """The policy after the step, and its figures."""
    dtype, constrained = inputs.dtype, hparams.method == "cpo"
    number = jnp.maximum(batch.finite.sum(), 1)
    paid = jnp.power(jnp.asarray(hparams.cost_discount, dtype), jnp.arange(problem.horizon))
    sums = jnp.sum(paid[:, None] * batch.cost, 0)
    cost = sums.sum() / number
    excess = cost - problem.limit.astype(dtype) if constrained else jnp.zeros((), dtype)

    # Advantages of rewards are weighted evenly, as is usual; those of costs as the limit demands.
    weight = batch.valid.astype(dtype) / number
    weight = jnp.stack([weight, weight * paid[:, None]][: len(found)])
    centre = jnp.sum(weight * found, (1, 2)) / positive(weight.sum((1, 2)))
    weighted = weight * (found - centre[:, None, None])
    samples = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), (inputs, batch.action, batch.valid)
    )
    flat, unravel = ravel_pytree(parameters)
    old = gaussian(parameters, hparams, samples[0])

    def judged(flat: jax.Array) -> Surrogate:
        gains, kl = surrogate(
            unravel(flat),
            old,
            samples[0],
            samples[1],
            weighted.reshape(len(weighted), -1),
            samples[2],
            hparams,
        )
        return Surrogate(gains[0], gains[1] if constrained else jnp.zeros((), dtype), kl)

    def divergence(flat: jax.Array) -> jax.Array:
        some = slice(None, None, hparams.fisher_stride)
        new = gaussian(unravel(flat), hparams, samples[0][some])
        kl = jnp.where(samples[2][some], kl_divergence((old[0][some], old[1][some]), new), 0)
        return kl.sum() / jnp.maximum(samples[2][some].sum(), 1)

    product = fisher_product(divergence, flat)
    delta = jnp.asarray(hparams.delta, dtype)
    change, dual = direction(judged, product, flat, excess, delta, hparams)
    scale, after = line_search(judged, flat, change, excess, delta, hparams)
    accepted = scale > 0
    new = jnp.where(accepted, flat + scale * change, flat)
    nonfinite = jnp.sum(~batch.finite).astype(jnp.int32)
    spread = jnp.sum(jnp.where(batch.finite, (sums - cost) ** 2, 0)) / jnp.maximum(number - 1, 1)
    usable = (nonfinite == 0) & jnp.all(jnp.isfinite(change))
    return unravel(new), Metrics(
        trajectories=jnp.int32(0),
        reward=batch.reward.sum() / number,
        cost=cost,
        cost_error=jnp.sqrt(spread / number),
        length=batch.valid.sum() / number.astype(dtype),
        deviation=jnp.exp(parameters["log_deviation"].mean()),
        kl=after.kl,
        reward_gain=after.reward,
        cost_gain=after.cost,
        scale=scale,
        case=dual.case,
        trust_multiplier=dual.trust,
        cost_multiplier=dual.cost,
        unexplained=jnp.zeros(len(found), dtype),
        nonfinite=nonfinite,
        status=learner.completion_status(accepted, usable),
    )
