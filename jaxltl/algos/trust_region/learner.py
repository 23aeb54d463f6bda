"""Trust-region policy optimisation (TRPO) and constrained policy optimisation (CPO).

A step draws trajectories with a Gaussian policy ``pi`` and changes its parameters by ``x``, the
solution of a linear-quadratic problem::

    maximise   g . x    subject to   x . H x / 2 <= delta,   and for CPO   c + b . x <= 0,

where ``g`` and ``b`` are the gradients of a trajectory's reward and cost, estimated by generalised
advantages (Schulman et al. 2016), ``H`` is the Fisher matrix (the Hessian of the mean
``KL(old || new)``) and ``c = J_C - limit``. TRPO (Schulman et al. 2015) follows ``H^-1 g``; CPO
(Achiam et al. 2017) a combination of ``H^-1 g`` and ``H^-1 b`` from the dual in closed form. A
backtracking line search then enforces the true divergence and the estimated gains.

A trajectory is an episode, cut after ``horizon`` steps. The value after a termination or after the
horizon is 0; after a truncation it is that of the value network at the last observation.

Example: a point in the plane; the reward is for being near 0, the cost is the action. (A step
compiles for seconds, so only shapes are shown.)

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
  ...     discount=0.9, method="cpo", num_trajectories=6, hidden=(3,), value_hidden=(), num_cg_steps=3,
  ...     num_value_epochs=1, num_value_batches=2)
  >>> state = jax.eval_shape(
  ...     lambda key: trust_region.init(key, problem, hparams), jax.random.key(0))
  >>> after, metrics = jax.eval_shape(
  ...     lambda state: trust_region.step(state, problem, hparams), state)
  >>> metrics.reward.shape, metrics.unexplained.shape  # of rewards and of costs
  ((), (2,))
  >>> mean, deviation = jax.eval_shape(
  ...     lambda state: trust_region.act(state, hparams, jnp.zeros(2)), state)
  >>> mean.shape, deviation.shape  # trust_region.policy samples; trust_region.greedy is the mean
  ((2,), (2,))
  >>> batch = jax.eval_shape(lambda state: trust_region.rollout(
  ...     jax.random.key(1), state, problem, hparams, num_trajectories=3), state)
  >>> batch.reward.shape  # a trust_region.Batch
  (4, 3)
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jax.flatten_util import ravel_pytree
from jax.scipy.sparse.linalg import cg

from jaxltl.algos.common import learner, trees
from jaxltl.algos.common.collection import masked_advantages, minibatch_epochs
from jaxltl.algos.common.moments import Moments, no_moments, scale_of, updated_moments
from jaxltl.algos.common.settings import applied, require_own
from jaxltl.algos.trust_region.policies import (
    METHODS,
    TrajectoryBatch,
    Hparams,
    TanhNetwork,
    Problem,
    State,
    act,
    gaussian,
    greedy,
    make_problem,
    mean_network,
    normalized,
    observed_vector,
    policy,
    rollout,
)
from jaxltl.core import struct
from jaxltl.core.array_types import Key, Numeric, PyTree
from jaxltl.core.environments.environment import require_key, some_action


__all__ = [
    "METHODS",
    "Hparams",
    "Metrics",
    "Problem",
    "State",
    "TrajectoryBatch",
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


@struct.dataclass
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


def _check(problem: Problem, hparams: Hparams) -> None:
    require_own((problem, Problem), (hparams, Hparams))
    if hparams.method == "cpo" and problem.limit is None:
        raise ValueError('method="cpo" needs a limit: pass one to make_problem, or use "trpo".')
    if hparams.method == "cpo" and hparams.penalty is not None:
        raise ValueError('penalty is for method="trpo": CPO finds its own multiplier.')
    samples = hparams.num_trajectories * problem.horizon
    if hparams.num_value_batches > samples:
        raise ValueError(
            f"num_value_batches={hparams.num_value_batches} of {samples} samples; use fewer."
        )


def _init(key: Key, problem: Problem, hparams: Hparams) -> State:
    """Random networks; moments of observations from a first batch if observations are normalised."""
    _check(problem, hparams)
    return _begun(require_key(key), problem, hparams)


@jax.jit
def _begun(key: Key, problem: Problem, hparams: Hparams) -> State:
    seen = jax.eval_shape(lambda k: observed_vector(problem, problem.environment.reset(k)), key)
    num_actions = math.prod(some_action(problem.environment.actions).shape)
    dtype, (size,), num_values = seen.dtype, seen.shape, 1 + (hparams.method == "cpo")
    mean_key, value_key, first_key = jax.random.split(learner.init_key(key), 3)
    mean = mean_network(hparams, num_actions, dtype).init(mean_key, jnp.zeros(size, dtype))
    log_deviation = jnp.full(num_actions, jnp.log(hparams.initial_deviation), dtype)
    values = jax.vmap(lambda k: _value_network(hparams, dtype).init(k, jnp.zeros(size + 1, dtype)))(
        jax.vmap(partial(jax.random.fold_in, value_key))(jnp.arange(num_values))
    )["params"]
    state = State(
        key=key,
        step=jnp.int32(0),
        parameters={"mean": mean["params"], "log_deviation": log_deviation},
        values=values,
        value_moments=jnp.stack([jnp.zeros(num_values, dtype), jnp.ones(num_values, dtype)]),
        optimizer=trees.strong(optax.adam(hparams.value_rate).init(values)),
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
    """N trajectories, one step of the policy, and a fit of the value networks to the same samples."""
    _check(problem, hparams)
    require_own((state, State))
    draw_key, fit_key = jax.random.split(learner.step_key(state))
    batch = rollout(draw_key, state, problem, hparams, num_trajectories=hparams.num_trajectories)
    inputs = normalized(state.moments, hparams, batch.observation)
    inputs = jnp.where(batch.valid[..., None], inputs, 0)
    value, advantage = _estimated(state, batch, inputs, hparams)
    parameters, statistics = _improved(state.parameters, batch, inputs, advantage, problem, hparams)
    values, optimizer, value_moments = fitted(
        fit_key, state, value_inputs(inputs), value + advantage, batch.valid, hparams
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
    (_, left_out), (_, total) = (_moments(x, batch.valid) for x in (advantage, value + advantage))
    return state, replace(
        statistics,
        trajectories=state.trajectories,
        unexplained=left_out / positive(total),
    )


init, step, run, train, run_until, train_until = learner.bind(_init, _step)


# --- values -----------------------------------------------------------------------------------


def _value_network(hparams: Hparams, dtype: jax.typing.DTypeLike) -> TanhNetwork:
    return TanhNetwork(hparams.value_hidden, 1, 0.1, dtype)


def values_at(values: PyTree, hparams: Hparams, inputs: jax.Array) -> jax.Array:
    """Values ``float[V, ...]`` before scaling."""
    network = _value_network(hparams, inputs.dtype)
    return jax.vmap(lambda p: jnp.asarray(applied(network, p, inputs))[..., 0])(values)


def value_inputs(inputs: jax.Array) -> jax.Array:
    """``float[T, N, O + 1]``: standardised observations and the time."""
    time = jnp.linspace(-1, 1, inputs.shape[0], dtype=inputs.dtype)
    time = jnp.broadcast_to(time[:, None, None], (*inputs.shape[:2], 1))
    return jnp.concatenate([inputs, time], -1)


def _estimated(
    state: State, batch: TrajectoryBatch, inputs: jax.Array, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """Values and advantages ``float[V, T, N]``."""
    mean, deviation = state.value_moments[..., None, None]
    value = values_at(state.values, hparams, value_inputs(inputs)) * deviation + mean
    value = jnp.where(batch.valid, value, 0)
    times = value_inputs(inputs)[:, 0, -1]
    time = times[jnp.minimum(batch.valid.sum(0), len(times) - 1)]  # at most that of the last step
    ending = normalized(state.moments, hparams, batch.last)
    ending = jnp.concatenate([ending, time[:, None]], -1)
    ending = values_at(state.values, hparams, ending)
    after = jnp.where(batch.truncated, ending[0] * deviation[0, 0] + mean[0, 0], 0)
    reward = batch.reward
    if hparams.penalty is not None:
        reward = reward - hparams.penalty * batch.cost
    discount = hparams.discount * batch.discount
    parts = [masked_advantages(reward, value[0], batch.valid, discount, hparams.gae_lambda, after)]
    if hparams.method == "cpo":
        parts.append(
            masked_advantages(
                batch.cost, value[1], batch.valid, hparams.cost_discount, hparams.cost_gae_lambda
            )
        )
    return value, jnp.stack(parts)


def refolded(network: PyTree, old: Moments, new: Moments) -> PyTree:
    """Parameters of the same function of observations under new moments."""
    first = "hidden_0" if "hidden_0" in network else "out"
    kernel, bias = network[first]["kernel"], network[first]["bias"]
    size, deviation = old.mean.shape[0], scale_of(old)
    head = kernel[:size]
    bias = bias + ((new.mean - old.mean) / deviation) @ head
    head = head * (scale_of(new) / deviation)[:, None]
    return {**network, first: {"kernel": kernel.at[:size].set(head), "bias": bias}}


def fitted(
    key: Key, state: State, inputs: jax.Array, target: jax.Array, valid: jax.Array, hparams: Hparams
) -> tuple[PyTree, PyTree, jax.Array]:
    """Value networks after Adam's steps on the squared error to targets ``float[V, T, N]``."""
    mean, variance = _moments(target, valid)
    moments = jnp.stack([mean, positive(jnp.sqrt(variance))])
    target = (target - moments[0][:, None, None]) / moments[1][:, None, None]
    # Nothing finite was seen: nothing is learned.
    moments = jnp.where(valid.any(), moments, state.value_moments)
    inputs, target = inputs.reshape(-1, inputs.shape[-1]), target.reshape(len(target), -1)
    weight = valid.reshape(-1).astype(inputs.dtype)
    optimizer = optax.adam(hparams.value_rate)

    def loss(values: PyTree, chosen: jax.Array) -> jax.Array:
        error = values_at(values, hparams, inputs[chosen]) - target[:, chosen]
        return jnp.sum(weight[chosen] * error**2) / jnp.maximum(weight[chosen].sum(), 1)

    def descend(carry: PyTree, chosen: jax.Array) -> PyTree:
        values, memory = carry
        updates, memory = optimizer.update(jax.grad(loss)(values, chosen), memory)
        return (optax.apply_updates(values, updates), memory), None

    (values, memory), _ = minibatch_epochs(
        key,
        descend,
        (state.values, state.optimizer),
        len(weight),
        num_epochs=hparams.num_value_epochs,
        num_minibatches=hparams.num_value_batches,
    )
    return values, memory, moments


def _moments(x: jax.Array, valid: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and variance ``float[V]`` of ``float[V, T, N]`` over valid entries."""
    number = jnp.maximum(valid.sum(), 1)
    mean = jnp.where(valid, x, 0).sum((1, 2)) / number
    return mean, jnp.where(valid, (x - mean[:, None, None]) ** 2, 0).sum((1, 2)) / number


# --- the policy -------------------------------------------------------------------------------


def _improved(
    parameters: PyTree,
    batch: TrajectoryBatch,
    inputs: jax.Array,
    advantage: jax.Array,
    problem: Problem,
    hparams: Hparams,
) -> tuple[PyTree, Metrics]:
    """The policy after the step, and metrics."""
    dtype, constrained = inputs.dtype, hparams.method == "cpo"
    number = jnp.maximum(batch.finite.sum(), 1)
    paid = jnp.power(jnp.asarray(hparams.cost_discount, dtype), jnp.arange(problem.horizon))
    sums = jnp.sum(paid[:, None] * batch.cost, 0)
    cost = sums.sum() / number
    excess = jnp.zeros((), dtype)
    if problem.limit is not None and constrained:
        excess = cost - problem.limit.astype(dtype)

    # Advantages of rewards are weighted evenly, as is usual; those of costs as the limit demands.
    weight = batch.valid.astype(dtype) / number
    weight = jnp.stack([weight, weight * paid[:, None]][: len(advantage)])
    centre = jnp.sum(weight * advantage, (1, 2)) / positive(weight.sum((1, 2)))
    weighted = weight * (advantage - centre[:, None, None])
    samples = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), (inputs, batch.action, batch.valid)
    )
    flat, unravel = ravel_pytree(parameters)
    old = gaussian(parameters, hparams, samples[0])

    def surrogate_of(flat: jax.Array) -> tuple[jax.Array, jax.Array]:
        new = gaussian(unravel(flat), hparams, samples[0])
        return surrogate(new, old, samples[1], weighted.reshape(len(weighted), -1), samples[2])

    def divergence(flat: jax.Array) -> jax.Array:
        some = slice(None, None, hparams.fisher_stride)
        new = gaussian(unravel(flat), hparams, samples[0][some])
        kl = jnp.where(samples[2][some], kl_divergence((old[0][some], old[1][some]), new), 0)
        return kl.sum() / jnp.maximum(samples[2][some].sum(), 1)

    product = fisher_product(divergence, flat)
    change, dual = direction(surrogate_of, product, flat, excess, hparams)
    scale, gains, kl = line_search(surrogate_of, flat, change, excess, hparams)
    accepted = scale > 0
    new = jnp.where(accepted, flat + scale * change, flat)
    nonfinite = jnp.sum(~batch.finite).astype(jnp.int32)
    variance = jnp.sum(jnp.where(batch.finite, (sums - cost) ** 2, 0)) / jnp.maximum(number - 1, 1)
    usable = (nonfinite == 0) & jnp.all(jnp.isfinite(change))
    return unravel(new), Metrics(
        trajectories=jnp.int32(0),
        reward=batch.reward.sum() / number,
        cost=cost,
        cost_error=jnp.sqrt(variance / number),
        length=batch.valid.sum() / number.astype(dtype),
        deviation=jnp.exp(parameters["log_deviation"].mean()),
        kl=kl,
        reward_gain=gains[0],
        cost_gain=gains[1] if constrained else jnp.zeros((), dtype),
        scale=scale,
        case=dual.case,
        trust_multiplier=dual.trust,
        cost_multiplier=dual.cost,
        unexplained=jnp.zeros(len(advantage), dtype),
        nonfinite=nonfinite,
        status=learner.completion_status(accepted, usable),
    )


# Of a policy's parameters: gains of reward and cost, float[V], and the divergence.
Surrogate = Callable[[jax.Array], tuple[jax.Array, jax.Array]]


class Case(enum.IntEnum):
    """The part of the constrained problem that determines a step."""

    FREE = 0  # the whole trust region keeps to the limit (always so for TRPO)
    INACTIVE = 1  # the best step of the trust region keeps to the limit (the paper's case b)
    ACTIVE = 2  # the best step ends on the limit (the paper's case a)
    RECOVERY = 3  # the whole trust region violates the limit: lower the cost alone


class Dual(NamedTuple):
    """Multipliers of the trust region and of the limit, and the :class:`Case`."""

    trust: jax.Array
    cost: jax.Array
    case: jax.Array


def cpo_step(
    q: Numeric, r: Numeric, s: Numeric, c: Numeric, delta: Numeric
) -> tuple[Dual, jax.Array]:
    """The solution of ``max g.x`` where ``c + b.x <= 0``, ``x.Hx / 2 <= delta``: multipliers, (u, w).

    The dual is ``max over lambda, nu >= 0`` of (Achiam et al. 2017, equation 12, with half its delta)::

        -(q - 2 r nu + s nu^2) / (2 lambda) + nu c - lambda delta,

    and the step ``x = u H^-1 g + w H^-1 b`` has ``u = 1 / lambda`` and ``w = -nu / lambda``, also where
    `g` and `b` are parallel and lambda is 0: then it is the step to the limit itself, ``w = -c / s``.
    As the dual is concave, one test replaces the paper's two cases: the limit is active if and only
    if the best step without it breaks it. Where the limit cannot be kept in the trust region the dual
    is unbounded, and the multipliers are those of the paper's recovery, ``max -b.x``: nu = 1.
    """
    plain = [] if any(isinstance(x, jax.Array) for x in (q, r, s, c, delta)) else [float]
    dtype = jnp.result_type(*plain, q, r, s, c, delta)
    q, r, s, c, delta = (jnp.asarray(x, dtype) for x in (q, r, s, c, delta))
    # Squared H-lengths of the trust region on the limit, and of H^-1 g on it.
    no_slope = jnp.where(c == 0, 0, jnp.sign(c) * jnp.inf)
    distance = jnp.where(s > 0, c / jnp.sqrt(positive(s)), no_slope)
    room, rest = 2 * delta - distance**2, q - ratio(r, jnp.sqrt(s)) ** 2
    # What rounding leaves of parallel gradients has no direction.
    rest = jnp.where(rest > 16 * jnp.finfo(q.dtype).eps * q, rest, 0)
    # Opposite gradients never break a limit that can be kept; their sum may, by rounding.
    breaks = (c + r * jnp.sqrt(ratio(2 * delta, q)) > 0) & ~((rest == 0) & (r < 0))
    inside = jnp.where(breaks, Case.ACTIVE, Case.INACTIVE)
    case = jnp.where(room > 0, inside, jnp.where(c > 0, Case.RECOVERY, Case.FREE))
    on_limit = jnp.sqrt(ratio(rest, room))
    # The step to the limit, and on along the limit to the edge of the trust region.
    along = jnp.sqrt(ratio(jnp.maximum(room, 0), rest))
    nu = ratio(jnp.maximum(on_limit * c + r, 0), s)
    zero, one = jnp.zeros_like(along), jnp.ones_like(along)
    # All numbers are chosen at once: for several choices the compiler may work out the case twice and
    # round in two ways, and a step that is half of one case and half of another is too long.
    active = jnp.stack([on_limit, nu, along, -ratio(along * r + c, s)])
    free = jnp.stack([jnp.sqrt(q / (2 * delta)), zero, jnp.sqrt(ratio(2 * delta, q)), zero])
    recovery = jnp.stack([jnp.sqrt(s / (2 * delta)), one, zero, -jnp.sqrt(ratio(2 * delta, s))])
    chosen = jnp.where(case == Case.ACTIVE, active, free)
    chosen = jnp.where(case == Case.RECOVERY, recovery, chosen)
    return Dual(chosen[0], chosen[1], case.astype(jnp.int32)), chosen[2:]


def positive(x: jax.Array) -> jax.Array:
    """The number, or 1 where it is zero, for a division."""
    return jnp.where(x > 0, x, 1)


def ratio(x: jax.Array, y: jax.Array) -> jax.Array:
    """Zero where `y` is not positive."""
    return jnp.where(y > 0, x / positive(y), 0)


def fisher_product(
    divergence: Callable[[jax.Array], jax.Array], parameters: jax.Array
) -> Callable[[jax.Array], jax.Array]:
    """``v -> H v`` with H the Hessian of `divergence` at `parameters`, linearised once."""
    return jax.linearize(jax.grad(divergence), parameters)[1]


def log_density(action: jax.Array, mean: jax.Array, deviation: jax.Array) -> jax.Array:
    """Log density of a Gaussian with independent entries, up to a constant."""
    return -jnp.sum(((action - mean) / deviation) ** 2 / 2 + jnp.log(deviation), -1)


def kl_divergence(old: tuple[jax.Array, jax.Array], new: tuple[jax.Array, jax.Array]) -> jax.Array:
    """``KL(old || new)`` of Gaussians with independent entries."""
    (old_mean, old_deviation), (mean, deviation) = old, new
    ratio = old_deviation / deviation
    shift = (old_mean - mean) / deviation
    return jnp.sum((ratio**2 + shift**2 - 1) / 2 - jnp.log(ratio), -1)


def surrogate(
    new: tuple[jax.Array, jax.Array],
    old: tuple[jax.Array, jax.Array],
    action: jax.Array,
    weighted: jax.Array,
    valid: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Gains ``sum_i (pi(a_i) / old(a_i) - 1) A_i``, ``float[V]``, and the mean divergence."""
    log_ratio = log_density(action, *new) - log_density(action, *old)
    gains = weighted @ jnp.where(valid, jnp.expm1(log_ratio), 0)
    return gains, jnp.where(valid, kl_divergence(old, new), 0).sum() / jnp.maximum(valid.sum(), 1)


def direction(
    surrogate_of: Surrogate,
    product: Callable[[jax.Array], jax.Array],
    flat: jax.Array,
    excess: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, Dual]:
    """The solution of the linear-quadratic problem in the span of ``H^-1 g`` and ``H^-1 b``."""

    def damped(v: jax.Array) -> jax.Array:
        return product(v) + jnp.asarray(hparams.damping, flat.dtype) * v

    def solved(gradient: jax.Array) -> jax.Array:
        # Scaled to length 1, for tiny gradients would underflow when squared.
        length = jnp.sqrt(jnp.sum(gradient**2))
        solution, _ = cg(
            damped, gradient / positive(length), tol=1e-10, maxiter=hparams.num_cg_steps
        )
        return solution * length

    natural = jax.vmap(solved)(jax.jacrev(lambda x: surrogate_of(x)[0])(flat))
    # With H x for the gradients that conjugate gradients did not quite solve for, the step's
    # divergence is as promised.
    gram = natural @ jax.vmap(damped)(natural).T
    delta = jnp.asarray(hparams.delta, flat.dtype)
    limit: tuple[Numeric, Numeric, Numeric] = (0.0, 0.0, -1.0)  # that no step breaks
    if hparams.method == "cpo":
        limit = ((gram[0, 1] + gram[1, 0]) / 2, gram[1, 1], excess)
    dual, weights = cpo_step(gram[0, 0], *limit, delta)
    return weights[: len(natural)] @ natural, dual


def line_search(
    surrogate_of: Surrogate,
    flat: jax.Array,
    change: jax.Array,
    excess: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The longest accepted step of a geometric sequence, its gains and divergence; zero if there is none.

    Accepted are a divergence of at most delta; a cost below the limit, or falling; and, unless the
    limit is exceeded, a higher reward. Comparisons with NaN are false.
    """
    backtrack, delta = (jnp.asarray(x, flat.dtype) for x in (hparams.backtrack, hparams.delta))

    def search(carry: PyTree) -> PyTree:
        count, scale, *_ = carry
        scale = jnp.where(count == 0, jnp.ones_like(scale), scale * backtrack)
        gains, kl = surrogate_of(flat + scale * change)
        good = (kl <= delta) & ((gains[0] > 0) | (excess > 0))
        if hparams.method == "cpo":
            good &= jnp.where(excess > 0, gains[1] < 0, gains[1] <= -excess)
        return count + 1, scale, gains, kl, good

    def searching(carry: PyTree) -> jax.Array:
        return (carry[0] < hparams.max_search_steps) & ~carry[-1]

    zero = jnp.zeros((), flat.dtype)
    gains = jnp.zeros(1 + (hparams.method == "cpo"), flat.dtype)
    _, *after, accepted = lax.while_loop(
        searching, search, (jnp.int32(0), zero, gains, zero, jnp.bool_(False))
    )
    scale, gains, kl = (jnp.where(accepted, x, 0) for x in after)
    return scale, gains, kl
