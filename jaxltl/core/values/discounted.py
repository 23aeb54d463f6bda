"""Discounted values of a policy, and optimal ones."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.operators import (
    action_argmax,
    action_max,
    action_mean,
    expectation,
    induced_chain,
    policy_distribution,
)
from jaxltl.core.types import Solution
from jaxltl.core.values.evidence import (
    _attach,
    _certified,
    _solution,
    action_value,
    expected_reward,
)
from jaxltl.core.values.fixed_point import solve_linear


@jax.jit
def policy_value(
    model: Any,
    policy: jax.Array,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
) -> Solution:
    """Expected discounted reward of a policy.

    ``V = r_pi + discount * P_pi V`` (dissertation, section 2.2.1). Solved by BiCGSTAB with
    successive approximation where that stalls; the enclosure holds for any iterate.

    Args:
      model: the model.
      policy: ``float[S, A]`` or ``int32[S]``.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      discount: scalar in [0, 1).
      tolerance: certified absolute error asked for; default: what the dtype allows.
      max_steps: sweeps at most.

    Returns:
      :class:`Solution`; `value` is ``float[S]``.

    Raises:
      ValueError: policy or reward has the wrong shape.

    Differentiable in the policy, the reward, the discount and the probabilities.

    Example:
      >>> from jaxltl.core.models.mdp import from_dense
      >>> mdp = from_dense([[[1.0]]])
      >>> round(policy_value(mdp, jnp.array([0]), jnp.ones((1, 1)), 0.5).value.item(), 4)
      2.0
    """
    reward = expected_reward(model, reward)
    discount = jnp.asarray(discount, model.dtype)
    policy = policy_distribution(model, policy)
    reward = jnp.where(model.available, reward, 0)

    def backup(v: jax.Array) -> jax.Array:
        return action_mean(policy, action_value(model, reward, discount, v))

    constant = action_mean(policy, reward)
    scale = float(jnp.finfo(model.dtype).eps)
    relative = scale if tolerance is None else jnp.maximum(
        scale, tolerance * (1 - discount) / (4 * jnp.linalg.norm(constant.ravel()) + scale)
    )
    value = lax.stop_gradient(
        solve_linear(
            lambda v: v - (backup(v) - constant), constant,
            tolerance=relative, max_steps=max_steps,
        )
    )
    solution = _solution(
        model, reward, discount, tolerance, value, backup(value), policy, jnp.int32(1)
    )
    return _attach(solution, backup)


@partial(jax.jit, static_argnames=("method",))
def optimal_value(
    model: Any,
    reward: jax.Array,
    discount: jax.Array | float,
    *,
    method: str = "modified_policy_iteration",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 100_000,
    evaluation_sweeps: jax.Array | int = 24,
) -> Solution:
    """Largest expected discounted reward, ``V = max_a R + discount * P V``.

    Modified policy iteration (Puterman and Shin 1978): after each sweep of the
    optimality operator, `evaluation_sweeps` cheap sweeps under the greedy policy.
    Stops on MacQueen's bounds, so a tolerance met is a certified error.

    Args:
      model: the model.
      reward: ``float[S, A]`` or ``float[S, A, K]``.
      discount: scalar in [0, 1).
      method: ``"modified_policy_iteration"`` or ``"value_iteration"``.
      tolerance: certified absolute error asked for; default: what the dtype allows.
      max_steps: sweeps of the optimality operator at most.
      evaluation_sweeps: sweeps between them under a fixed policy.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, `policy` ``int32[S]`` is greedy and its
      own value is at least `lower`.

    Raises:
      ValueError: the reward has the wrong shape, or an unknown method.

    Differentiable in the reward, the discount and the probabilities, wherever the
    greedy policy is unique.

    Example:
      >>> from jaxltl.core.models.mdp import from_dense
      >>> mdp = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]])
      >>> best = optimal_value(mdp, jnp.array([[0.0, 0.0], [1.0, 1.0]]), 0.5)
      >>> [round(v, 4) for v in best.value.tolist()], best.policy.tolist()
      ([1.0, 2.0], [1, 0])
    """
    if method not in ("modified_policy_iteration", "value_iteration"):
        raise ValueError(f"method={method!r}; choose modified_policy_iteration or value_iteration.")
    reward = expected_reward(model, reward)
    discount = jnp.asarray(discount, model.dtype)

    def backup(v: jax.Array) -> jax.Array:
        q = reward + discount * expectation(model, v)
        return action_max(q, model.available)

    def greedy(v: jax.Array) -> tuple[jax.Array, jax.Array]:
        q = reward + discount * expectation(model, v)
        return action_argmax(q, model.available)

    def evaluate(v: jax.Array, policy: jax.Array) -> jax.Array:
        chain = induced_chain(model, policy)
        gain = action_mean(policy, reward)
        return lax.fori_loop(
            0, evaluation_sweeps,
            lambda _, v: gain + discount * expectation(chain, v.ravel())[:, 0].reshape(v.shape), v,
        )

    def body(carry):
        _, image, policy, n, _ = carry
        value = image if method == "value_iteration" else evaluate(image, policy)
        image, policy = greedy(value)
        *_, done, exhausted = _certified(model, reward, discount, tolerance, value, image)
        return value, image, policy, n + 1, done | exhausted | ~jnp.isfinite(image.ravel()[0])

    def unfinished(carry):
        *_, n, done = carry
        return ~done & (n < max_steps)

    zero = jnp.zeros(model.state_shape, model.dtype)
    start = (zero, *greedy(zero), jnp.int32(1), jnp.bool_(False))
    value, image, policy, n, _ = lax.stop_gradient(lax.while_loop(unfinished, body, start))
    solution = _solution(model, reward, discount, tolerance, value, image, policy, n)
    return _attach(solution, backup)
