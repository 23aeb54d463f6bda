"""Gaussian policies of trust-region methods: problems, networks, agents and trajectories."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax
from jax.tree_util import Partial
from jax.typing import DTypeLike

from jaxltl.algos.common import action_distributions as actions_of
from jaxltl.algos.common.actor_critic import Output
from jaxltl.algos.common.collection import acting, transition
from jaxltl.algos.common.moments import Moments, standardized
from jaxltl.algos.common.settings import (
    COUNT,
    MAX_INT,
    Number,
    RunState,
    applied,
    require_own,
    static,
    traced,
)
from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key, Numeric, PyTree
from jaxltl.core.environments.environment import (
    Box,
    Environment,
    flat_observation,
    require_environment,
    require_key,
    some_action,
)
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.pretty_print import brief
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
    horizon = validation.integer("horizon", horizon, least=1, limit=2**31 - 1)
    if limit is not None:
        known = isinstance(limit, jax.Array)
        limit = jnp.asarray(
            limit if known else validation.float_array("limit", limit), jnp.result_type(float)
        )
        require_shape("limit", limit, ())
    return Problem(environment=environment, limit=limit, horizon=horizon)


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
      num_cg_steps: iterations of the conjugate gradient method; static; default 10.
      max_search_steps: largest number of tries of the line search; static; default 15.
      fisher_stride: stride of the samples that estimate the Fisher matrix; static; default 1.
      num_value_epochs: passes of the value networks over the samples; static; default 5.
      num_value_batches: minibatches of each pass; static; default 8.
    """

    discount: Number = traced("closed_discount")
    cost_discount: Number = traced("closed_discount", default=1.0)
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
    num_cg_steps: int = static(COUNT, default=10)
    max_search_steps: int = static(COUNT, default=15)
    fisher_stride: int = static(COUNT, default=1)
    num_value_epochs: int = static(Range(0, MAX_INT, integer=True), default=5)
    num_value_batches: int = static(COUNT, default=8)


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


# --- the policy -------------------------------------------------------------------------------


class TanhNetwork(nn.Module):
    """Tanh layers and a linear layer, initialised at `last_scale` times the usual scale."""

    hidden: tuple[int, ...]
    outputs: int
    last_scale: float
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        def layer(width: int, name: str, scale: float = 1.0) -> nn.Dense:
            start = nn.initializers.variance_scaling(scale**2, "fan_in", "normal")
            return nn.Dense(width, param_dtype=self.dtype, kernel_init=start, name=name)

        for i, width in enumerate(self.hidden):
            x = nn.tanh(layer(width, f"hidden_{i}")(x))
        return layer(self.outputs, "out", self.last_scale)(x)


def mean_network(hparams: Hparams, num_actions: int, dtype: DTypeLike) -> TanhNetwork:
    """The network of a policy's mean."""
    return TanhNetwork(hparams.hidden, num_actions, 0.1, dtype)


def gaussian(
    parameters: PyTree, hparams: Hparams, inputs: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation of the actions."""
    log_deviation = parameters["log_deviation"]
    network = mean_network(hparams, log_deviation.shape[0], log_deviation.dtype)
    mean = jnp.asarray(applied(network, parameters["mean"], inputs))
    return mean, jnp.broadcast_to(jnp.exp(log_deviation), mean.shape)


def normalized(moments: Moments, hparams: Hparams, observation: jax.Array) -> jax.Array:
    """Standardised observations if ``hparams.normalize``."""
    return standardized(moments, observation) if hparams.normalize else observation


def observed_vector(problem: Problem, world: PyTree) -> jax.Array:
    """The flattened observation ``float[O]``."""
    return flat_observation(problem.environment.observe(world))


def policy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The learned policy as an agent that samples its actions, for ``run_episode``."""
    return _agent(state, problem, hparams, True)


def greedy(state: State, problem: Problem, hparams: Hparams) -> Agent:
    """The learned policy of a run's `state`, `problem` and `hparams`, taking the mean action."""
    return _agent(state, problem, hparams, False)


def _agent(state: State, problem: Problem, hparams: Hparams, sampled: bool) -> Agent:
    require_own((state, State), (problem, Problem), (hparams, Hparams))
    evaluate = Partial(_evaluate, (state, problem, hparams))
    return acting(evaluate, problem.environment.actions, (sampled, None))


def _evaluate(run: tuple[State, Problem, Hparams], memory: PyTree, observation: PyTree) -> Output:
    """Mean and log standard deviation of an action of the environment; there is no value."""
    state, problem, hparams = run
    mean, deviation = act(state, hparams, flat_observation(observation))
    shape = some_action(problem.environment.actions).shape
    action = (mean.reshape(shape), jnp.log(deviation).reshape(shape))
    return Output(memory, action, jnp.zeros((), mean.dtype))


def act(state: State, hparams: Hparams, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The mean and standard deviation of the action at an `observation` ``float[..., O]``.

    Both ``float[..., A]``, in units of the action before clipping, of a run's `state` and `hparams`;
    differentiable in the parameters.

    Raises:
      ValueError: observations of another size, or a state of another learner.
    """
    require_own((state, State), (hparams, Hparams))
    size = state.moments.mean.shape
    if not hasattr(observation, "dtype") or jnp.shape(observation)[-1:] != size:
        raise ValueError(
            f"observation is {validation.shorten(observation)}; the policy was trained on vectors "
            f"float[..., {size[0]}], as flat_observation makes of an environment's."
        )
    return gaussian(state.parameters, hparams, normalized(state.moments, hparams, observation))


# --- trajectories -----------------------------------------------------------------------------


@brief
class TrajectoryBatch(NamedTuple):
    """Trajectories, zero after their end or where excluded.

    Attributes:
      observation: ``float[T, N, O]``, flattened.
      action: ``float[T, N, A]``, flattened, before clipping.
      reward, cost: ``float[T, N]``.
      discount: ``float[T, N]``, the environment's.
      valid: ``bool[T, N]``, whether the step was made.
      finite: ``bool[N]``; other trajectories are excluded and have no valid step.
      last: ``float[N, O]``, the observation after the last step.
      truncated: ``bool[N]``, truncated and not terminated.
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


def rollout(
    key: Key,
    state: State,
    problem: Problem,
    hparams: Hparams,
    *,
    num_trajectories: int,
    sampled: bool = True,
) -> TrajectoryBatch:
    """The :class:`TrajectoryBatch` of `num_trajectories` trajectories of the policy, of a random `key`.

    Of a run's `state`, `problem` and `hparams`; actions are `sampled`, or the policy's mean is taken;
    both static. Sums over its first axis are those of trajectories.
    """
    require_own((state, State), (problem, Problem), (hparams, Hparams))
    number = validation.integer("num_trajectories", num_trajectories, least=1, limit=2**31 - 1)
    return _rollout(
        require_key(key), state, problem, hparams, number, validation.boolean("sampled", sampled)
    )


@partial(jax.jit, static_argnames=("num_trajectories", "sampled"))
def _rollout(
    key: Key, state: State, problem: Problem, hparams: Hparams, num_trajectories: int, sampled: bool
) -> TrajectoryBatch:
    environment, size = problem.environment, (problem.horizon, num_trajectories)
    start, noise_key, step_key = jax.random.split(key, 3)
    worlds = jax.vmap(environment.reset)(jax.random.split(start, num_trajectories))
    dtype, noise = state.parameters["log_deviation"].dtype, None
    if sampled:
        noise = actions_of.noise(noise_key, size, environment.actions, dtype)
    evaluate = partial(_evaluate, (state, problem, hparams))

    def move(carry: PyTree, chance: PyTree) -> PyTree:
        (world, active, cut), (noise, key) = carry, chance
        after, _, record = transition(key, environment, evaluate, None, (world, ()), noise)
        world = jax.tree.map(partial(jnp.where, active), after, world)
        cut |= active & record.truncated & ~record.terminated
        vectors = flat_observation(record.observation), record.raw.ravel()
        signals = jnp.stack([record.reward, record.cost, record.discount])
        active_after = active & ~(record.terminated | record.truncated)
        return (world, active_after, cut), (*vectors, signals, active)

    def trajectory(world: PyTree, noise: jax.Array | None, keys: jax.Array) -> PyTree:
        begin = (world, jnp.bool_(True), jnp.bool_(False))
        (world, _, cut), rows = lax.scan(move, begin, (noise, keys))
        return observed_vector(problem, world), cut, rows

    last, truncated, (*parts, valid) = jax.vmap(trajectory, (0, 1, 1), (0, 0, 1))(
        worlds, noise, jax.random.split(step_key, size)
    )
    finite = jnp.isfinite(last).all(-1) | ~truncated
    for x in parts:
        finite &= (jnp.isfinite(x).all(-1) | ~valid).all(0)
    valid, truncated = valid & finite, truncated & finite
    observation, action, signals = (jnp.where(valid[..., None], x, 0).astype(dtype) for x in parts)
    reward, cost, discount = jnp.moveaxis(signals, -1, 0)
    last = jnp.where(truncated[:, None], last, 0)
    return TrajectoryBatch(
        observation, action, reward, cost, discount, valid, finite, last, truncated
    )
