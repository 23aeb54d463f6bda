"""Values of the softmax policy of its own action values."""

from __future__ import annotations

from functools import partial
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.models.operators import (
    action_mean,
)
from jaxltl.core.types import Solution, Status, status_code
from jaxltl.core.values.discounted import optimal_value
from jaxltl.core.values.evidence import _attach, _Jacobian, _rounding, action_value, expected_reward
from jaxltl.core.values.soft import _with_softmax, policy_logits


def boltzmann_expansion(num_actions: int) -> float:
    """Largest row sum of the Jacobian of ``sum_a softmax(q)_a q_a`` over all q.

    The Boltzmann operator contracts for discounts below its inverse. The supremum is
    attained where one action stands above the rest, which are equal.

    Example:
      >>> [round(boltzmann_expansion(n), 2) for n in (1, 2, 3, 4)]
      [1.0, 1.2, 1.33, 1.42]
    """
    if num_actions == 1:
        return 1.0
    gap = np.linspace(0.0, 40.0, 400_001)
    top = 1 / (1 + (num_actions - 1) * np.exp(-gap))
    mean = top * gap
    row_sum = np.abs(top * (1 + gap - mean)) + np.abs((1 - top) * (1 - mean))
    # The grid misses the maximum by less than its spacing squared.
    return float(row_sum.max() + 1e-7)


@partial(jax.jit, static_argnames=("adjoint", "method"))
def boltzmann_value(
    model: Any,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    initial: jax.Array | None = None,
    adjoint: str = "exact",
    method: str = "damped",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 5_000,
) -> Solution:
    """Value of the softmax policy of its own action values (2.1)-(2.3).

    ``V = sum_a softmax(Q)_a Q_a`` with ``Q = R + discount * P V``. This operator
    contracts only while ``discount * boltzmann_expansion(A) < 1``. Beyond, it can cycle or
    have several fixed points: damped steps of one half are polished by Newton's method,
    the enclosure is infinite, and the status tells when no fixed point was reached. See
    :func:`boltzmann_fixed_points`.

    Args:
      model: the model.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      discount: scalar in [0, 1).
      initial: ``float[S]``, where to start; default zero.
      adjoint: ``"exact"``, or ``"approximate"`` for the sensitivity (2.7) that holds the
        policy constant.
      method: ``"damped"``, or ``"newton"`` for Newton steps from the start on, which may
        also find fixed points that repel.
      tolerance: on the certified error where the operator contracts, on the
        residual elsewhere; default: what the dtype allows.
      max_steps: damped steps at most.

    Returns:
      :class:`Solution`; `policy` is ``float[S, A]``, the softmax.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method or adjoint.

    Value and policy are differentiable in the reward, the discount and the probabilities.

    Example:
      >>> from jaxltl.core.models.mdp import from_dense
      >>> mdp = from_dense([[[1.0], [1.0]]])
      >>> round(boltzmann_value(mdp, jnp.ones((1, 2)), 0.5).value.item(), 4)
      2.0
    """
    if adjoint not in ("exact", "approximate"):
        raise ValueError(f"adjoint={adjoint!r}; choose exact or approximate.")
    if method not in ("damped", "newton"):
        raise ValueError(f"method={method!r}; choose damped or newton.")
    reward = expected_reward(model, reward)
    discount = jnp.asarray(discount, model.dtype)
    expansion = discount * boltzmann_expansion(model.num_actions)

    def backup(v: jax.Array, constant_policy: bool = False) -> jax.Array:
        policy = jax.nn.softmax(policy_logits(model, reward, discount, v), axis=-1)
        if constant_policy:
            policy = lax.stop_gradient(policy)
        return action_mean(policy, action_value(model, reward, discount, v))

    def jacobian(v: jax.Array, constant_policy: bool = False) -> _Jacobian:
        policy = jax.nn.softmax(policy_logits(model, reward, discount, v), axis=-1)
        if not constant_policy:
            q = action_value(model, reward, discount, v)
            policy *= 1 + q - action_mean(policy, q)[..., None]
        return lax.stop_gradient(_Jacobian(model, discount, policy))

    contracts = expansion < 1
    damping = jnp.where(contracts | (method == "newton"), 0.0, 0.5).astype(model.dtype)
    gap = jnp.where(contracts, 1 - expansion, 1)
    magnitude = jnp.max(jnp.abs(jnp.where(model.available, reward, 0))) / (1 - discount)
    rounding = _rounding(model, reward, magnitude, gap)
    goal = 4 * rounding if tolerance is None else jnp.asarray(tolerance, model.dtype)
    enough = jnp.maximum(goal, 2 * rounding)  # below which there is little but rounding

    def error(value: jax.Array, image: jax.Array) -> jax.Array:
        """Certified where the operator contracts; elsewhere the residual."""
        return jnp.max(jnp.abs(image - value)) / gap + rounding

    def damped(carry):
        value, image, _, better, n = carry
        value = value + (1 - damping) * (image - value)
        image = backup(value)
        return value, image, error(value, image), better, n + 1

    def newton(carry):
        value, image, before, _, n = carry
        trial = jacobian(value).newton(value, image)
        trial_image = backup(trial)
        now = error(trial, trial_image)
        better = now <= before / 2
        keep = partial(jnp.where, better)
        return keep(trial, value), keep(trial_image, image), keep(now, before), better, n + 1

    def polish(carry):
        value, image, bound, n = carry
        # Newton's method early, but ever more damped steps where it does not take hold.
        width = n + (0 if method == "newton" else 4 * (1 + n // 16))
        again = (value, image, bound, jnp.bool_(True), n)
        value, image, bound, _, n = lax.while_loop(
            lambda c: (c[2] > enough) & (c[4] < jnp.minimum(width, max_steps)), damped, again
        )
        again = (value, image, bound, jnp.bool_(True), n)
        value, image, bound, _, n = lax.while_loop(
            lambda c: (c[2] > enough) & c[3] & (c[4] < max_steps), newton, again
        )
        return value, image, bound, n

    def unfinished(carry):
        _, _, bound, n = carry
        return (bound > enough) & (n < max_steps) & jnp.isfinite(bound)

    start = jnp.zeros(model.state_shape, model.dtype) if initial is None else initial
    image = backup(start)
    first = (start, image, error(start, image), jnp.int32(1))
    value, image, bound, n = lax.stop_gradient(lax.while_loop(unfinished, polish, first))
    converged = bound <= goal
    half = jnp.where(converged & contracts, bound, jnp.inf)
    solution = Solution(
        value=value, policy=value, lower=value - half, upper=value + half,
        residual=jnp.max(jnp.abs(image - value)), num_steps=n,
        status=status_code(converged, jnp.isfinite(bound) & (discount < 1), bound <= enough),
    )
    constant = adjoint == "approximate"
    solution = _attach(
        solution, partial(backup, constant_policy=constant), jacobian(value, constant)
    )
    return _with_softmax(model, reward, discount, solution)


def boltzmann_fixed_points(
    model: Any,
    reward: jax.Array,
    discount: jax.Array | float,
    key: chex.PRNGKey,
    *,
    num_starts: int = 64,
    tolerance: float = 1e-6,
) -> list[Solution]:
    """Distinct fixed points of the Boltzmann operator that were found from many starts.

    Damped and Newton iterations from zero, from the optimal and the worst value, and from
    random values between. A search, not a proof that there are no others.

    Args:
      model, reward, discount: as in :func:`boltzmann_value`.
      key: a PRNG key, consumed.
      num_starts: starts for each of the two methods.
      tolerance: fixed points nearer than this (sup norm) are one; also the residual allowed.

    Returns:
      Converged solutions, ordered by the sum of their values. Works on the host.
    """
    best = optimal_value(model, reward, discount).value
    worst = -optimal_value(model, -jnp.asarray(reward), discount).value
    weight = jax.random.uniform(key, (num_starts, *(1 for _ in best.shape)), best.dtype)
    weight = weight.at[0].set(0).at[-1].set(1)
    starts = worst + weight * (best - worst)
    found: list[Solution] = []
    for method in ("damped", "newton"):
        run = jax.vmap(
            lambda v, method=method: boltzmann_value(
                model, reward, discount, initial=v, method=method)
        )
        batch = run(starts)
        for i in np.flatnonzero(np.asarray(batch.status) == Status.CONVERGED):
            one = jax.tree.map(lambda x, i=i: x[i], batch)
            if all(jnp.max(jnp.abs(one.value - f.value)) > tolerance for f in found):
                found.append(one)
    return sorted(found, key=lambda f: float(f.value.sum()))
