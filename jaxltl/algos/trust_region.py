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

A world is three pure functions of one trajectory::

    reset(key) -> world
    step(world, action, key) -> (world, reward, cost, done)
    observe(world) -> float[O]

Plain functions are accepted; ``jax.tree_util.Partial(function, *arrays)`` hands over arrays as
arguments, so that new ones do not recompile; a new function, as each evaluation of a ``lambda``
makes, does. ``world`` is any pytree. A trajectory ends when it
is done, or after ``horizon`` steps: what would come later does not count.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.sparse.linalg import cg
from jax.tree_util import Partial

from jaxltl.algos import learner
from jaxltl.core.types import require_shape, status_code

METHODS = ("trpo", "cpo")


class Case(enum.IntEnum):
    """Which part of the constrained problem decided a step."""

    FREE = 0  # the whole trust region keeps to the limit (always so for TRPO)
    INACTIVE = 1  # the best step of the trust region keeps to the limit (the paper's case b)
    ACTIVE = 2  # the best step ends on the limit (the paper's case a)
    RECOVERY = 3  # the whole trust region violates the limit: lower the cost alone


@struct.dataclass
class Problem:
    """A world, made by :func:`make_problem`.

    Attributes:
      reset, step, observe: see the module's text.
      limit: on the expected cost of a trajectory; None: there is none.
      num_actions: A, the length of an action ``float[A]``; static. Actions are not bounded:
        a world with bounds clips them.
      horizon: T; static.
    """

    reset: Callable[..., Any]
    step: Callable[..., Any]
    observe: Callable[..., jax.Array]
    limit: Any
    num_actions: int = struct.field(pytree_node=False)
    horizon: int = struct.field(pytree_node=False)


@struct.dataclass
class Hparams:
    """How to learn. Numbers are traced, so new values do not recompile; None is static.

    Attributes:
      discount: of rewards, in [0, 1].
      cost_discount: of costs; 1 limits the expected sum of a trajectory's costs.
      gae_lambda: of the generalised advantage of rewards: 1 has no bias, 0 least variance.
      cost_gae_lambda: the same of costs. Costs that come late need a value near 1.
      delta: the mean divergence that a step may cause.
      damping: added to the Fisher matrix, times the identity.
      penalty: TRPO only: learn from ``reward - penalty * cost``; None: from the reward.
      initial_deviation: the standard deviation of the first policy's actions.
      backtrack: how much shorter each try of the line search is than the one before.
      value_rate: learning rate of the value networks (Adam).
      method: ``"trpo"`` or ``"cpo"``; static.
      num_trajectories: N, drawn in each step; static.
      hidden, value_hidden: widths of the tanh layers of the policy and of the value networks;
        ``()`` is linear; static.
      normalize: whether networks read observations centred and scaled by their moments so far;
        the policy as a function is not changed by new moments; static.
      cg_steps: of the conjugate gradient; static.
      search_steps: tries of the line search; static.
      fisher_stride: the Fisher matrix is estimated from every so many-th sample; static.
      value_epochs, value_batches: passes over the samples, each in so many batches; static.
    """

    discount: jax.Array | float
    cost_discount: jax.Array | float = 1.0
    gae_lambda: jax.Array | float = 0.97
    cost_gae_lambda: jax.Array | float = 0.97
    delta: jax.Array | float = 0.01
    damping: jax.Array | float = 1e-3
    penalty: jax.Array | float | None = None
    initial_deviation: jax.Array | float = 1.0
    backtrack: jax.Array | float = 0.8
    value_rate: jax.Array | float = 3e-3
    method: str = struct.field(pytree_node=False, default="cpo")
    num_trajectories: int = struct.field(pytree_node=False, default=200)
    hidden: tuple[int, ...] = struct.field(pytree_node=False, default=(32, 32))
    value_hidden: tuple[int, ...] = struct.field(pytree_node=False, default=(32, 32))
    normalize: bool = struct.field(pytree_node=False, default=True)
    cg_steps: int = struct.field(pytree_node=False, default=10)
    search_steps: int = struct.field(pytree_node=False, default=15)
    fisher_stride: int = struct.field(pytree_node=False, default=1)
    value_epochs: int = struct.field(pytree_node=False, default=5)
    value_batches: int = struct.field(pytree_node=False, default=8)


@struct.dataclass
class Moments:
    """Of the observations so far: their number, ``mean[O]``, and summed squares around it."""

    count: jax.Array
    mean: jax.Array
    squares: jax.Array


@struct.dataclass
class State:
    """A policy on its way.

    Attributes:
      key: of the whole run.
      step: steps made.
      parameters: of the policy: ``{"mean": network, "log_deviation": float[A]}``.
      values: parameters of the value networks with a leading axis [V]: of rewards, and with
        CPO of costs. They also read the time, for sums over a finite horizon depend on it.
      value_moments: ``float[2, V]``, mean and deviation by which their output is scaled.
      optimizer: of `values`.
      moments: of the observations.
      trajectories: drawn so far; at most 2^31 - 1 are counted.
    """

    key: jax.Array
    step: jax.Array
    parameters: Any
    values: Any
    value_moments: jax.Array
    optimizer: Any
    moments: Moments
    trajectories: jax.Array


@struct.dataclass
class Metrics:
    """Figures of a step. Means are of the policy before it, over its finite trajectories.

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
      status: CONVERGED; MAX_STEPS if no length of the step would do, so that the policy stays;
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


class Batch(NamedTuple):
    """Trajectories side by side, zero where they are over or left out.

    Attributes:
      observation: ``float[T, N, O]``.
      action: ``float[T, N, A]``.
      reward, cost: ``float[T, N]``.
      valid: ``bool[T, N]``, whether the step was made.
      finite: ``bool[N]``; others are left out, so that all of their steps are not valid.
    """

    observation: jax.Array
    action: jax.Array
    reward: jax.Array
    cost: jax.Array
    valid: jax.Array
    finite: jax.Array


class Dual(NamedTuple):
    """Multipliers of the trust region and of the limit, and the :class:`Case`."""

    trust: jax.Array
    cost: jax.Array
    case: jax.Array


class Surrogate(NamedTuple):
    """What a policy would change, estimated from the trajectories of another one."""

    reward: jax.Array
    cost: jax.Array
    kl: jax.Array


# --- problems -------------------------------------------------------------------------------


def make_problem(
    reset: Callable[..., Any],
    step: Callable[..., Any],
    observe: Callable[..., jax.Array],
    *,
    num_actions: int,
    horizon: int,
    limit: chex.Numeric | None = None,
) -> Problem:
    """A checked :class:`Problem`.

    Args:
      reset, step, observe: see the module's text; functions or ``Partial`` objects.
      num_actions: A.
      horizon: T, at least 1.
      limit: on the expected cost of a trajectory; may be negative. CPO needs it.

    Raises:
      ValueError: a number below 1, a limit that is no number, or a world whose functions
        return something of another shape.

    Example:
      >>> def reset(key):
      ...     return jax.random.uniform(key, (1,))
      >>> def move(place, action, key):
      ...     place = place + jnp.clip(action, -1, 1)
      ...     return place, -abs(place[0]), action[0] ** 2, place[0] > 9
      >>> problem = make_problem(reset, move, lambda place: place, num_actions=1, horizon=5,
      ...                        limit=1.0)
      >>> float(problem.limit)
      1.0

      Then ``state, metrics = train(key, problem, Hparams(discount=0.99), num_steps=100)``.
    """
    for name, number in {"num_actions": num_actions, "horizon": horizon}.items():
        if number < 1:
            raise ValueError(f"{name}={number}; it must be at least 1.")
    if limit is not None:
        limit = jnp.asarray(limit, jnp.result_type(float))
        require_shape("limit", limit, ())
    reset, step, observe = (f if isinstance(f, Partial) else Partial(f)
                            for f in (reset, step, observe))
    problem = Problem(reset=reset, step=step, observe=observe, limit=limit,
                      num_actions=num_actions, horizon=horizon)
    key = jax.random.key(0)
    world = jax.eval_shape(reset, key)
    seen = jax.eval_shape(observe, world)
    if not isinstance(seen, jax.ShapeDtypeStruct) or len(seen.shape) != 1 or not jnp.issubdtype(
        seen.dtype, jnp.floating
    ):
        raise ValueError(f"observe returns {seen}; it must return floats of one axis.")
    action = jax.ShapeDtypeStruct((num_actions,), seen.dtype)
    found = jax.eval_shape(step, world, action, key)
    if not isinstance(found, tuple) or len(found) != 4:
        raise ValueError("step must return (world, reward, cost, done).")
    for name, number in zip(("reward", "cost", "done"), found[1:], strict=True):
        if getattr(number, "shape", None) != ():
            raise ValueError(f"step returns {name} = {number}; it must be a scalar.")
    if _described(found[0]) != _described(world):
        raise ValueError(
            f"step returns the world {_described(found[0])}, but reset {_described(world)}; "
            "both must have the same structure, shapes and dtypes."
        )
    return problem


def _described(world: Any) -> Any:
    return jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", world)


def _check(problem: Problem, hparams: Hparams) -> None:
    if hparams.method not in METHODS:
        raise ValueError(f'method={hparams.method!r}; choose "trpo" or "cpo".')
    if hparams.method == "cpo" and problem.limit is None:
        raise ValueError('method="cpo" needs a limit: pass one to make_problem, or use "trpo".')
    if hparams.method == "cpo" and hparams.penalty is not None:
        raise ValueError('penalty is for method="trpo": CPO finds its own multiplier.')
    for name in ("num_trajectories", "cg_steps", "search_steps", "fisher_stride", "value_batches"):
        if getattr(hparams, name) < 1:
            raise ValueError(f"{name}={getattr(hparams, name)}; it must be at least 1.")
    samples = hparams.num_trajectories * problem.horizon
    if hparams.value_batches > samples:
        raise ValueError(f"value_batches={hparams.value_batches} of {samples} samples; use fewer.")


# --- policies and values --------------------------------------------------------------------


class Network(nn.Module):
    """Tanh layers and a linear one, which starts at `last_scale` of the usual size."""

    hidden: tuple[int, ...]
    outputs: int
    last_scale: float
    dtype: Any

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        def layer(width: int, name: str, scale: float = 1.0) -> nn.Dense:
            start = nn.initializers.variance_scaling(scale**2, "fan_in", "normal")
            return nn.Dense(width, param_dtype=self.dtype, kernel_init=start, name=name)

        for i, width in enumerate(self.hidden):
            x = nn.tanh(layer(width, f"hidden_{i}")(x))
        return layer(self.outputs, "out", self.last_scale)(x)


def _mean_network(hparams: Hparams, num_actions: int, dtype: Any) -> Network:
    return Network(hparams.hidden, num_actions, 0.1, dtype)


def _value_network(hparams: Hparams, dtype: Any) -> Network:
    return Network(hparams.value_hidden, 1, 0.1, dtype)


def policy(state: State, problem: Problem, hparams: Hparams) -> Partial:
    """What was learned, as a function of the observation: :func:`act` of the state.

    ``policy(state, problem, hparams)(observation)`` are mean and standard deviation of the action;
    a pytree.
    """
    del problem
    return Partial(act, state, hparams)


def act(state: State, hparams: Hparams, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation of the action: both ``float[..., A]``.

    Args:
      state, hparams: of the learner.
      observation: ``float[..., O]``.
    """
    return _gaussian(state.parameters, hparams, _normalized(state.moments, hparams, observation))


def _gaussian(
    parameters: Any, hparams: Hparams, inputs: jax.Array
) -> tuple[jax.Array, jax.Array]:
    log_deviation = parameters["log_deviation"]
    network = _mean_network(hparams, log_deviation.shape[0], log_deviation.dtype)
    mean = jnp.asarray(network.apply({"params": parameters["mean"]}, inputs))
    return mean, jnp.broadcast_to(jnp.exp(log_deviation), mean.shape)


def _log_density(action: jax.Array, mean: jax.Array, deviation: jax.Array) -> jax.Array:
    """Up to a constant."""
    return -jnp.sum(((action - mean) / deviation) ** 2 / 2 + jnp.log(deviation), -1)


def _divergence(old: tuple[jax.Array, jax.Array], new: tuple[jax.Array, jax.Array]) -> jax.Array:
    """``KL(old || new)`` of Gaussians with independent entries."""
    (mean, deviation), (other, spread) = old, new
    ratio = deviation / spread
    return jnp.sum((ratio**2 + ((mean - other) / spread) ** 2 - 1) / 2 - jnp.log(ratio), -1)


def _evaluated(values: Any, hparams: Hparams, inputs: jax.Array) -> jax.Array:
    """``float[V, ...]``, before it is scaled."""
    network = _value_network(hparams, inputs.dtype)
    return jax.vmap(lambda p: jnp.asarray(network.apply({"params": p}, inputs))[..., 0])(values)


def _value_inputs(inputs: jax.Array) -> jax.Array:
    """``float[T, N, O + 1]``: the time beside the normalised observations."""
    time = jnp.linspace(-1, 1, inputs.shape[0], dtype=inputs.dtype)
    time = jnp.broadcast_to(time[:, None, None], (*inputs.shape[:2], 1))
    return jnp.concatenate([inputs, time], -1)


# --- observations, centred and scaled ---------------------------------------------------------


def _normalized(moments: Moments, hparams: Hparams, observation: jax.Array) -> jax.Array:
    return (observation - moments.mean) / _spread(moments) if hparams.normalize else observation


def _spread(moments: Moments) -> jax.Array:
    """What has not varied is not scaled."""
    spread = jnp.sqrt(moments.squares / jnp.maximum(moments.count, 1))
    noise = 8 * jnp.finfo(spread.dtype).eps * jnp.abs(moments.mean)
    return jnp.where(spread > noise, spread, 1)


def _updated_moments(moments: Moments, batch: Batch) -> Moments:
    """With a batch taken in (Chan et al. 1979)."""
    weight = batch.valid.astype(batch.observation.dtype)[..., None]
    count = weight.sum()
    mean = jnp.sum(weight * batch.observation, (0, 1)) / jnp.maximum(count, 1)
    squares = jnp.sum(weight * (batch.observation - mean) ** 2, (0, 1))
    total = jnp.maximum(moments.count + count, 1)
    shift = mean - moments.mean
    return Moments(
        count=moments.count + count, mean=moments.mean + shift * count / total,
        squares=moments.squares + squares + shift**2 * moments.count * count / total,
    )


def _refolded(network: Any, old: Moments, new: Moments) -> Any:
    """A network's parameters that make of newly scaled inputs what they made of old ones.

    Without this the policy would change with the moments, outside of any trust region.
    """
    first = "hidden_0" if "hidden_0" in network else "out"
    kernel, bias = network[first]["kernel"], network[first]["bias"]
    size, spread = old.mean.shape[0], _spread(old)
    head = kernel[:size]
    bias = bias + ((new.mean - old.mean) / spread) @ head
    head = head * (_spread(new) / spread)[:, None]
    return {**network, first: {"kernel": kernel.at[:size].set(head), "bias": bias}}


# --- trajectories -----------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("num_trajectories", "sampled"))
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
    """
    start, path = jax.random.split(key)
    worlds = jax.vmap(problem.reset)(jax.random.split(start, num_trajectories))

    def move(carry: Any, key: chex.PRNGKey) -> Any:
        worlds, active = carry
        action_key, world_key = jax.random.split(key)
        observation = jax.vmap(problem.observe)(worlds)
        mean, deviation = act(state, hparams, observation)
        action = mean
        if sampled:
            action += deviation * jax.random.normal(action_key, mean.shape, mean.dtype)
        keys = jax.random.split(world_key, num_trajectories)
        after, reward, cost, done = jax.vmap(problem.step)(worlds, action, keys)

        def held(x: jax.Array, y: jax.Array) -> jax.Array:
            return jnp.where(active.reshape(-1, *[1] * (x.ndim - 1)), x, y)

        row = (observation, action, reward, cost, active)
        return (jax.tree.map(held, after, worlds), active & ~done.astype(bool)), row

    active = jnp.ones(num_trajectories, bool)
    _, (observation, action, reward, cost, valid) = lax.scan(
        move, (worlds, active), jax.random.split(path, problem.horizon)
    )
    dtype = observation.dtype
    parts = (observation, action, reward[..., None], cost[..., None])
    finite = jnp.array([
        jnp.all(jnp.all(jnp.isfinite(x), -1) | ~valid, 0) for x in parts
    ]).all(0)
    valid &= finite
    observation, action, reward, cost = (
        jnp.where(valid[..., None], x, 0).astype(dtype) for x in parts
    )
    return Batch(observation, action, reward[..., 0], cost[..., 0], valid, finite)


def advantages(
    signal: jax.Array,
    value: jax.Array,
    valid: jax.Array,
    discount: chex.Numeric,
    gae_lambda: chex.Numeric,
) -> jax.Array:
    """Generalised advantages (Schulman et al. 2016, equation 16) of finite trajectories::

        A_t = sum_l (discount lambda)^l d_{t+l},    d_t = r_t + discount V_{t+1} - V_t,

    with V = 0 after the last step.

    Args:
      signal: ``float[T, ...]``, rewards or costs.
      value: ``float[T, ...]``, V of the states where they are earned.
      valid: ``bool[T, ...]``, whether the step was made; true up to the end of a trajectory.
      discount, gae_lambda: in [0, 1].

    Returns:
      ``float[T, ...]``, zero where `valid` is false.

    Example:
      >>> ones, zeros = jnp.ones(3), jnp.zeros(3)
      >>> advantages(ones, zeros, jnp.array([True, True, False]), 0.5, 1.0).tolist()
      [1.5, 1.0, 0.0]
    """
    value = jnp.where(valid, value, 0)
    following = jnp.concatenate([value[1:], jnp.zeros_like(value[:1])])
    error = jnp.where(valid, signal + discount * following - value, 0)

    def back(later: jax.Array, error: jax.Array) -> tuple[jax.Array, jax.Array]:
        now = error + discount * gae_lambda * later
        return now, now

    return lax.scan(back, jnp.zeros_like(error[0]), error, reverse=True)[1]


# --- the step -----------------------------------------------------------------------------------


def cpo_dual(
    q: chex.Numeric, r: chex.Numeric, s: chex.Numeric, c: chex.Numeric, delta: chex.Numeric
) -> Dual:
    """Multipliers ``(lambda, nu)`` of ``max g.x`` where ``c + b.x <= 0``, ``x.Hx / 2 <= delta``.

    The dual is ``max over lambda, nu >= 0`` of (Achiam et al. 2017, equation 12, whose delta
    is twice this one)::

        -(q - 2 r nu + s nu^2) / (2 lambda) + nu c - lambda delta,

    and the solution ``x = H^-1 (g - nu b) / lambda``. The paper compares the best multipliers
    with ``nu = 0`` (its case b) with the best with ``nu > 0`` (case a). As the dual is concave,
    one test decides: the limit is active if and only if the best step without it breaks it.

    Where the limit cannot be kept in the trust region the dual is unbounded, and the multipliers
    returned are those of the paper's recovery, ``max -b.x``: ``x = -H^-1 b / lambda``, nu = 1.

    Args:
      q, r, s: ``g.H^-1 g``, ``g.H^-1 b`` and ``b.H^-1 b``, where ``q s >= r^2``.
      c: by how much the limit is exceeded now.
      delta: positive.

    Returns:
      :class:`Dual`; lambda is 0 where `g` gives no direction to spend the trust region on.

    Example:
      >>> dual = cpo_dual(q=1.0, r=0.0, s=1.0, c=0.6, delta=0.5)
      >>> [round(float(x), 3) for x in dual[:2]], Case(int(dual.case)).name
      ([1.25, 0.75], 'ACTIVE')
    """
    q, r, s, c, delta = _floats(q, r, s, c, delta)
    room, rest, _ = _plane(q, r, s, c, delta)
    case = _case(q, r, s, c, delta)
    free, recovery = jnp.sqrt(q / (2 * delta)), jnp.sqrt(s / (2 * delta))
    active = jnp.sqrt(_ratio(rest, room))
    trust = jnp.where(case == Case.ACTIVE, active, free)
    cost = jnp.where(case == Case.ACTIVE, _ratio(jnp.maximum(active * c + r, 0), s), 0)
    return Dual(
        trust=jnp.where(case == Case.RECOVERY, recovery, trust),
        cost=jnp.where(case == Case.RECOVERY, 1, cost), case=case,
    )


def cpo_weights(
    q: chex.Numeric, r: chex.Numeric, s: chex.Numeric, c: chex.Numeric, delta: chex.Numeric
) -> tuple[jax.Array, jax.Array]:
    """``(u, w)`` of the step ``x = u H^-1 g + w H^-1 b`` that belongs to :func:`cpo_dual`.

    They are ``1 / lambda`` and ``-nu / lambda``, also where `g` and `b` are parallel and lambda
    is 0: then the step to the limit itself, ``w = -c / s``. Arguments as there.
    """
    q, r, s, c, delta = _floats(q, r, s, c, delta)
    room, rest, _ = _plane(q, r, s, c, delta)
    case = _case(q, r, s, c, delta)
    # The step to the limit, and on along the limit to the edge of the trust region.
    along = jnp.sqrt(_ratio(jnp.maximum(room, 0), rest))
    reward = jnp.where(case == Case.ACTIVE, along, jnp.sqrt(_ratio(2 * delta, q)))
    cost = jnp.where(case == Case.ACTIVE, -_ratio(along * r + c, s), 0)
    return (
        jnp.where(case == Case.RECOVERY, 0, reward),
        jnp.where(case == Case.RECOVERY, -jnp.sqrt(_ratio(2 * delta, s)), cost),
    )


def _floats(*numbers: chex.Numeric) -> tuple[jax.Array, ...]:
    dtype = jnp.result_type(float, *numbers) if not any(
        isinstance(x, jax.Array) for x in numbers
    ) else jnp.result_type(*numbers)
    return tuple(jnp.asarray(x, dtype) for x in numbers)


def _ratio(x: jax.Array, y: jax.Array) -> jax.Array:
    """Zero where `y` is not positive."""
    return jnp.where(y > 0, x / jnp.where(y > 0, y, 1), 0)


def _plane(
    q: jax.Array, r: jax.Array, s: jax.Array, c: jax.Array, delta: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Squared lengths, in H: what of the trust region is left on the limit, and of H^-1 g on it.

    The third is the distance to the limit, infinite if `b` is zero.
    """
    distance = jnp.where(s > 0, c / jnp.sqrt(jnp.where(s > 0, s, 1)),
                         jnp.where(c == 0, 0, jnp.sign(c) * jnp.inf))
    rest = q - _ratio(r, jnp.sqrt(s)) ** 2
    # What rounding leaves of parallel gradients has no direction.
    rest = jnp.where(rest > 16 * jnp.finfo(q.dtype).eps * q, rest, 0)
    return 2 * delta - distance**2, rest, distance


def _case(
    q: jax.Array, r: jax.Array, s: jax.Array, c: jax.Array, delta: jax.Array
) -> jax.Array:
    room, _, _ = _plane(q, r, s, c, delta)
    breaks = c + r * jnp.sqrt(_ratio(2 * delta, q)) > 0
    inside = jnp.where(breaks, Case.ACTIVE, Case.INACTIVE)
    outside = jnp.where(c > 0, Case.RECOVERY, Case.FREE)
    return jnp.where(room > 0, inside, outside).astype(jnp.int32)


def fisher_product(divergence: Callable[[jax.Array], jax.Array], parameters: jax.Array):
    """``v -> H v``, the Hessian of `divergence` at `parameters`, linearised once."""
    return jax.linearize(jax.grad(divergence), parameters)[1]


def surrogate(
    parameters: Any,
    old: tuple[jax.Array, jax.Array],
    inputs: jax.Array,
    action: jax.Array,
    weighted: jax.Array,
    valid: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, jax.Array]:
    """Gains ``float[V]`` of a policy over the one that drew the samples, and the mean divergence.

    ``sum_i (pi(a_i) / old(a_i) - 1) A_i``, and ``mean_i KL(old || pi)``. Differentiable in the
    parameters.

    Args:
      parameters: of the policy.
      old: mean and deviation ``float[B, A]`` of the policy that drew the actions.
      inputs: ``float[B, O]``, normalised observations.
      action: ``float[B, A]``.
      weighted: ``float[V, B]``, advantages times the weights of the samples.
      valid: ``bool[B]``.
      hparams: of the networks.
    """
    new = _gaussian(parameters, hparams, inputs)
    log_ratio = _log_density(action, *new) - _log_density(action, *old)
    gains = weighted @ jnp.where(valid, jnp.expm1(log_ratio), 0)
    divergence = jnp.where(valid, _divergence(old, new), 0)
    return gains, divergence.sum() / jnp.maximum(valid.sum(), 1)


@partial(jax.jit)
def init(key: chex.PRNGKey, problem: Problem, hparams: Hparams) -> State:
    """Random networks. If observations are normalised, a first batch of trajectories is drawn
    for their moments, and counted.

    Raises:
      ValueError: a method that does not fit the problem, or a number below 1.
    """
    _check(problem, hparams)
    seen = jax.eval_shape(problem.observe, jax.eval_shape(problem.reset, key))
    dtype, (size,), num_values = seen.dtype, seen.shape, 1 + (hparams.method == "cpo")
    mean_key, value_key, first_key = jax.random.split(learner.init_key(key), 3)
    mean = _mean_network(hparams, problem.num_actions, dtype).init(mean_key, jnp.zeros(size, dtype))
    log_deviation = jnp.full(problem.num_actions, jnp.log(hparams.initial_deviation), dtype)
    keys = jax.vmap(partial(jax.random.fold_in, value_key))(jnp.arange(num_values))
    values = jax.vmap(lambda k: _value_network(hparams, dtype).init(
        k, jnp.zeros(size + 1, dtype)))(keys)["params"]
    state = State(
        key=key, step=jnp.int32(0),
        parameters={"mean": mean["params"], "log_deviation": log_deviation}, values=values,
        value_moments=jnp.stack([jnp.zeros(num_values, dtype), jnp.ones(num_values, dtype)]),
        # optax starts from weakly typed zeros, which a second run would compile anew for.
        optimizer=jax.tree.map(
            lambda x: jnp.asarray(x, jnp.result_type(x)),
            optax.adam(hparams.value_rate).init(values),
        ),
        moments=Moments(jnp.zeros((), dtype), jnp.zeros(size, dtype), jnp.zeros(size, dtype)),
        trajectories=jnp.int32(0),
    )
    if not hparams.normalize:
        return state
    batch = rollout(
        first_key, state, problem, hparams, num_trajectories=hparams.num_trajectories
    )
    return replace(
        state, moments=_updated_moments(state.moments, batch),
        trajectories=jnp.int32(hparams.num_trajectories),
    )


def step(state: State, problem: Problem, hparams: Hparams) -> tuple[State, Metrics]:
    """N trajectories, one step of the policy, and the value networks fitted to the same ones."""
    _check(problem, hparams)
    draw_key, fit_key = jax.random.split(learner.step_key(state))
    batch = rollout(
        draw_key, state, problem, hparams, num_trajectories=hparams.num_trajectories
    )
    inputs = _normalized(state.moments, hparams, batch.observation)
    inputs = jnp.where(batch.valid[..., None], inputs, 0)
    value, found = _estimated(state, batch, inputs, hparams)
    parameters, told = _improved(state.parameters, batch, inputs, found, problem, hparams)
    values, optimizer, value_moments = _fitted(
        fit_key, state, _value_inputs(inputs), value + found, batch.valid, hparams
    )
    moments = state.moments
    if hparams.normalize:
        moments = _updated_moments(state.moments, batch)
        fold = partial(_refolded, old=state.moments, new=moments)
        parameters = {**parameters, "mean": fold(parameters["mean"])}
        values = jax.vmap(fold)(values)
    state = State(
        key=state.key, step=state.step + 1, parameters=parameters, values=values,
        value_moments=value_moments, optimizer=optimizer, moments=moments,
        trajectories=learner.count(state.trajectories, hparams.num_trajectories),
    )
    left_out = _weighted_variance(found, batch.valid)
    return state, replace(
        told, trajectories=state.trajectories,
        unexplained=left_out / _positive(_weighted_variance(value + found, batch.valid)),
    )


run = partial(learner.run, step)
train = partial(learner.train, init, step)
run_until = partial(learner.run_until, step)
train_until = partial(learner.train_until, init, step)


def _estimated(
    state: State, batch: Batch, inputs: jax.Array, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """Values and advantages ``float[V, T, N]`` of what is learned from."""
    mean, deviation = state.value_moments[..., None, None]
    value = _evaluated(state.values, hparams, _value_inputs(inputs)) * deviation + mean
    value = jnp.where(batch.valid, value, 0)
    reward = batch.reward
    if hparams.penalty is not None:
        reward = reward - hparams.penalty * batch.cost
    parts = [advantages(reward, value[0], batch.valid, hparams.discount, hparams.gae_lambda)]
    if hparams.method == "cpo":
        parts.append(advantages(
            batch.cost, value[1], batch.valid, hparams.cost_discount, hparams.cost_gae_lambda
        ))
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
    centre = jnp.sum(weight * found, (1, 2)) / _positive(weight.sum((1, 2)))
    weighted = weight * (found - centre[:, None, None])
    samples = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), (inputs, batch.action, batch.valid)
    )
    flat, unravel = ravel_pytree(parameters)
    old = _gaussian(parameters, hparams, samples[0])

    def judged(flat: jax.Array) -> Surrogate:
        gains, kl = surrogate(
            unravel(flat), old, samples[0], samples[1],
            weighted.reshape(len(weighted), -1), samples[2], hparams,
        )
        return Surrogate(gains[0], gains[1] if constrained else jnp.zeros((), dtype), kl)

    def divergence(flat: jax.Array) -> jax.Array:
        some = slice(None, None, hparams.fisher_stride)
        new = _gaussian(unravel(flat), hparams, samples[0][some])
        kl = jnp.where(samples[2][some], _divergence((old[0][some], old[1][some]), new), 0)
        return kl.sum() / jnp.maximum(samples[2][some].sum(), 1)

    product = fisher_product(divergence, flat)
    delta = jnp.asarray(hparams.delta, dtype)
    change, dual = _direction(judged, product, flat, excess, delta, hparams)
    scale, after = _search(judged, flat, change, excess, delta, hparams)
    accepted = scale > 0
    new = jnp.where(accepted, flat + scale * change, flat)
    nonfinite = jnp.sum(~batch.finite).astype(jnp.int32)
    spread = jnp.sum(jnp.where(batch.finite, (sums - cost) ** 2, 0)) / jnp.maximum(number - 1, 1)
    usable = (nonfinite == 0) & jnp.all(jnp.isfinite(change))
    return unravel(new), Metrics(
        trajectories=jnp.int32(0), reward=batch.reward.sum() / number, cost=cost,
        cost_error=jnp.sqrt(spread / number), length=batch.valid.sum() / number.astype(dtype),
        deviation=jnp.exp(parameters["log_deviation"].mean()), kl=after.kl,
        reward_gain=after.reward, cost_gain=after.cost, scale=scale, case=dual.case,
        trust_multiplier=dual.trust, cost_multiplier=dual.cost,
        unexplained=jnp.zeros(len(found), dtype), nonfinite=nonfinite,
        status=status_code(accepted, usable),
    )


def _direction(
    judged: Callable[[jax.Array], Surrogate],
    product: Callable[[jax.Array], jax.Array],
    flat: jax.Array,
    excess: jax.Array,
    delta: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, Dual]:
    """The solution of the linear-quadratic problem, in the span of ``H^-1 g`` and ``H^-1 b``."""
    damping = jnp.asarray(hparams.damping, flat.dtype)

    def damped(v: jax.Array) -> jax.Array:
        return product(v) + damping * v

    def solved(gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
        # Scaled to length 1, for tiny gradients would underflow when squared.
        length = jnp.sqrt(jnp.sum(gradient**2))
        found, _ = cg(damped, gradient / _positive(length), tol=1e-10, maxiter=hparams.cg_steps)
        found = found * length
        return found, damped(found)

    if hparams.method == "trpo":
        natural, times_fisher = solved(jax.grad(lambda x: judged(x).reward)(flat))
        q = natural @ times_fisher
        zero = jnp.zeros((), flat.dtype)
        dual = Dual(jnp.sqrt(q / (2 * delta)), zero, jnp.int32(Case.FREE))
        return natural * jnp.sqrt(_ratio(2 * delta, q)), dual
    gradients = jax.jacrev(lambda x: jnp.stack(judged(x)[:2]))(flat)
    natural, times_fisher = jax.vmap(solved)(gradients)
    # With H x for the gradients that conjugate gradients did not quite solve for, the step's
    # divergence is as promised.
    gram = natural @ times_fisher.T
    numbers = (gram[0, 0], (gram[0, 1] + gram[1, 0]) / 2, gram[1, 1], excess, delta)
    reward, cost = cpo_weights(*numbers)
    return reward * natural[0] + cost * natural[1], cpo_dual(*numbers)


def _search(
    judged: Callable[[jax.Array], Surrogate],
    flat: jax.Array,
    change: jax.Array,
    excess: jax.Array,
    delta: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, Surrogate]:
    """The longest of ever shorter steps that is good, and what it does; zero if there is none.

    Good is, with the true divergence and the sample's importance weights: a divergence of at
    most delta; a cost that is below the limit, or falls; and, unless the limit is exceeded now,
    a higher reward. Comparisons with NaN are false.
    """
    ratio = jnp.asarray(hparams.backtrack, flat.dtype)

    def good(after: Surrogate) -> jax.Array:
        found = (after.kl <= delta) & ((after.reward > 0) | (excess > 0))
        if hparams.method == "trpo":
            return found
        falls = jnp.where(excess > 0, after.cost < 0, after.cost <= -excess)
        return found & falls

    def search(carry: Any) -> Any:
        count, scale, _, _ = carry
        scale = jnp.where(count == 0, jnp.ones_like(scale), scale * ratio)
        after = judged(flat + scale * change)
        return count + 1, scale, after, good(after)

    def searching(carry: Any) -> jax.Array:
        return (carry[0] < hparams.search_steps) & ~carry[3]

    zero = jnp.zeros((), flat.dtype)
    nothing = Surrogate(zero, zero, zero)
    _, scale, after, found = lax.while_loop(
        searching, search, (jnp.int32(0), zero, nothing, jnp.bool_(False))
    )
    kept = jax.tree.map(lambda x: jnp.where(found, x, 0), after)
    return jnp.where(found, scale, 0), kept


def _fitted(
    key: chex.PRNGKey,
    state: State,
    inputs: jax.Array,
    target: jax.Array,
    valid: jax.Array,
    hparams: Hparams,
) -> tuple[Any, Any, jax.Array]:
    """Value networks fitted to targets ``float[V, T, N]`` by least squares, and their scales."""
    mean = jnp.where(valid, target, 0).sum((1, 2)) / jnp.maximum(valid.sum(), 1)
    deviation = jnp.sqrt(_weighted_variance(target, valid))
    deviation = jnp.where(deviation > 0, deviation, 1)
    target = (target - mean[:, None, None]) / deviation[:, None, None]
    moments = jnp.stack([mean, deviation])
    # Nothing finite was seen: nothing is learned.
    moments = jnp.where(valid.any(), moments, state.value_moments)
    inputs, target = inputs.reshape(-1, inputs.shape[-1]), target.reshape(len(target), -1)
    weight = valid.reshape(-1).astype(inputs.dtype)
    size = weight.shape[0] // hparams.value_batches
    optimizer = optax.adam(hparams.value_rate)

    def loss(values: Any, chosen: jax.Array) -> jax.Array:
        error = _evaluated(values, hparams, inputs[chosen]) - target[:, chosen]
        return jnp.sum(weight[chosen] * error**2) / jnp.maximum(weight[chosen].sum(), 1)

    def descend(carry: Any, chosen: jax.Array) -> Any:
        values, memory = carry
        updates, memory = optimizer.update(jax.grad(loss)(values, chosen), memory)
        return (optax.apply_updates(values, updates), memory), None

    def epoch(carry: Any, key: chex.PRNGKey) -> Any:
        order = jax.random.permutation(key, weight.shape[0])
        batches = order[: size * hparams.value_batches].reshape(hparams.value_batches, size)
        return lax.scan(descend, carry, batches)

    keys = jax.random.split(key, hparams.value_epochs)
    (values, memory), _ = lax.scan(epoch, (state.values, state.optimizer), keys)
    return values, memory, moments


def _weighted_variance(x: jax.Array, valid: jax.Array) -> jax.Array:
    """Of ``float[V, T, N]`` over valid entries: ``float[V]``."""
    number = jnp.maximum(valid.sum(), 1)
    mean = jnp.where(valid, x, 0).sum((1, 2), keepdims=True) / number
    return jnp.where(valid, (x - mean) ** 2, 0).sum((1, 2)) / number


def _positive(x: jax.Array) -> jax.Array:
    """`x`, or 1 where it is zero, to divide by."""
    return jnp.where(x > 0, x, 1)
