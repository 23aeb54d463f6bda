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
  ...     discount=0.9, method="cpo", num_trajectories=6, hidden=(3,), value_hidden=(), cg_steps=3,
  ...     value_epochs=1, value_batches=2)
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

import math
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree

from jaxltl.algos.common import learner, trees
from jaxltl.algos.common.collection import masked_advantages
from jaxltl.algos.common.moments import no_moments, updated_moments
from jaxltl.algos.trust_region._policy_networks import (
    fitted,
    gaussian,
    inputs_at,
    kl_divergence,
    mean_network,
    normalized,
    positive,
    refolded,
    value_inputs,
    value_network,
    values_at,
    weighted_variance,
)
from jaxltl.algos.trust_region._step import (
    Surrogate,
    direction,
    fisher_product,
    line_search,
    surrogate,
)
from jaxltl.algos.trust_region.policies import (
    Batch,
    act,
    greedy,
    policy,
    require_run,
    require_state,
    rollout,
)
from jaxltl.algos.trust_region.state import (
    METHODS,
    Hparams,
    Metrics,
    Problem,
    State,
    make_problem,
    observed_vector,
)
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import require_key, some_action

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


def _check(problem: Problem, hparams: Hparams) -> None:
    require_run(problem, hparams)
    if hparams.method == "cpo" and problem.limit is None:
        raise ValueError('method="cpo" needs a limit: pass one to make_problem, or use "trpo".')
    if hparams.method == "cpo" and hparams.penalty is not None:
        raise ValueError('penalty is for method="trpo": CPO finds its own multiplier.')
    samples = hparams.num_trajectories * problem.horizon
    if hparams.value_batches > samples:
        raise ValueError(f"value_batches={hparams.value_batches} of {samples} samples; use fewer.")


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
    values = jax.vmap(lambda k: value_network(hparams, dtype).init(k, jnp.zeros(size + 1, dtype)))(
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
    require_state(state)
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
    """Values and advantages ``float[V, T, N]``."""
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
    parts = [masked_advantages(reward, value[0], batch.valid, discount, hparams.gae_lambda, after)]
    if hparams.method == "cpo":
        parts.append(
            masked_advantages(
                batch.cost, value[1], batch.valid, hparams.cost_discount, hparams.cost_gae_lambda
            )
        )
    return value, jnp.stack(parts)


def _improved(
    parameters: PyTree,
    batch: Batch,
    inputs: jax.Array,
    found: jax.Array,
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
    weight = jnp.stack([weight, weight * paid[:, None]][: len(found)])
    centre = jnp.sum(weight * found, (1, 2)) / positive(weight.sum((1, 2)))
    weighted = weight * (found - centre[:, None, None])
    samples = jax.tree.map(
        lambda x: x.reshape(-1, *x.shape[2:]), (inputs, batch.action, batch.valid)
    )
    flat, unravel = ravel_pytree(parameters)
    old = gaussian(parameters, hparams, samples[0])

    def surrogate_of(flat: jax.Array) -> Surrogate:
        new = gaussian(unravel(flat), hparams, samples[0])
        gains, kl = surrogate(new, old, samples[1], weighted.reshape(len(weighted), -1), samples[2])
        return Surrogate(gains[0], gains[1] if constrained else jnp.zeros((), dtype), kl)

    def divergence(flat: jax.Array) -> jax.Array:
        some = slice(None, None, hparams.fisher_stride)
        new = gaussian(unravel(flat), hparams, samples[0][some])
        kl = jnp.where(samples[2][some], kl_divergence((old[0][some], old[1][some]), new), 0)
        return kl.sum() / jnp.maximum(samples[2][some].sum(), 1)

    product = fisher_product(divergence, flat)
    delta = jnp.asarray(hparams.delta, dtype)
    change, dual = direction(surrogate_of, product, flat, excess, delta, hparams)
    scale, after = line_search(surrogate_of, flat, change, excess, delta, hparams)
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
