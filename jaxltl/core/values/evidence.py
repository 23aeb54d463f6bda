"""What certifies a discounted value: MacQueen's bounds with the rounding contained in them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.operators import (
    action_mean,
    expectation,
    pushforward,
)
from jaxltl.core.types import Solution, status_code
from jaxltl.core.values.fixed_point import implicit, solve_linear


def action_value(
    model: Any, reward: jax.Array, discount: jax.Array | float, value: jax.Array
) -> jax.Array:
    """``Q(s, a) = R(s, a) + discount * sum_t P(t | s, a) V(t)``; zero at unavailable actions.

    Args:
      model: the model.
      reward: ``float[S, A]``.
      discount: scalar.
      value: ``float[S]``.

    Returns:
      ``float[S, A]``.
    """
    q = reward + discount * expectation(model, value)
    return jnp.where(model.available, q, 0)


def expected_reward(model: Any, reward: jax.Array) -> jax.Array:
    """A reward on transitions, ``[S, A, K]``, as its expectation ``[S, A]``; ``[S, A]`` as it is.

    Raises:
      ValueError: the reward has another shape.
    """
    actions = (*model.state_shape, model.num_actions)
    transitions = (*actions, model.num_successors)
    reward = jnp.asarray(reward, model.dtype)
    if reward.shape == actions:
        return reward
    if reward.shape == transitions:
        return jnp.sum(model.successor_probability * reward, axis=-1)
    raise ValueError(f"reward has shape {reward.shape}; expected {actions} or {transitions}.")


def _rounding(
    model: Any, reward: jax.Array, value: jax.Array, gap: jax.Array, axis: int | None = None
) -> jax.Array:
    """What rounding in one backup can add to an error, amplified by ``1 / gap``.

    A backup sums at most as many products as a state has successors, over which rows may
    also miss one by a rounding each, and takes a maximum or a mean over the actions.
    """
    terms = model.num_successors + model.num_actions + 4
    magnitude = jnp.max(jnp.abs(reward), axis) + jnp.max(jnp.abs(value), axis)
    return terms * jnp.finfo(value.dtype).eps * magnitude / gap


def _macqueen(
    model: Any, reward: jax.Array, discount: jax.Array, value: jax.Array, image: jax.Array,
    axis: int | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Bounds on the fixed point of a monotone T with ``T(v + c) = T(v) + discount * c``.

    ``T v + discount / (1 - discount) * [min, max](T v - v)`` (MacQueen 1966).

    Returns:
      The shifts (down, up) of `image` that enclose the fixed point, the rounding error
      contained in them, and whether everything is finite.
    """
    change = image - value
    gap = jnp.where(discount < 1, 1 - discount, jnp.nan)
    rounding = _rounding(model, reward, image, gap, axis)
    down = discount / gap * jnp.min(change, axis) - rounding
    up = discount / gap * jnp.max(change, axis) + rounding
    finite = jnp.isfinite(down) & jnp.isfinite(up)
    return down, up, rounding, finite


def _certified(
    model: Any,
    reward: jax.Array,
    discount: jax.Array,
    tolerance: jax.Array | float | None,
    value: jax.Array,
    image: jax.Array,
    axis: int | None = None,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Midpoint shift of the enclosure, its half width, whether that meets the tolerance, and
    whether it is mostly rounding, so that further sweeps would not help."""
    down, up, rounding, finite = _macqueen(model, reward, discount, value, image, axis)
    half = (up - down) / 2
    goal = 4 * rounding if tolerance is None else tolerance
    half = jnp.where(finite, half, jnp.inf)
    return (up + down) / 2, half, half <= goal, half <= 2 * rounding


def _solution(model, reward, discount, tolerance, value, image, policy, num_steps) -> Solution:
    shift, half, converged, exhausted = _certified(
        model, reward, discount, tolerance, value, image
    )
    finite = jnp.all(jnp.isfinite(image)) & (discount < 1)
    # Without a certificate the shift is meaningless and the iterate itself is the answer.
    middle = image + jnp.where(jnp.isfinite(half), shift, 0)
    return Solution(
        value=middle,
        policy=policy,
        lower=middle - half,
        upper=middle + half,
        residual=jnp.max(jnp.abs(image - value)),
        num_steps=num_steps,
        status=status_code(converged, finite, exhausted),
    )


def _attach(solution: Solution, backup, jacobian: _Jacobian | None = None) -> Solution:
    """The solution with implicit derivatives on its value, and none on its evidence."""
    solution = jax.tree.map(lax.stop_gradient, solution)
    if jacobian is None:
        return replace(solution, value=implicit(backup, solution.value))
    value = implicit(
        backup, solution.value, solve=jacobian.solve, transpose_solve=jacobian.transpose_solve
    )
    return replace(solution, value=value)


class _Jacobian(NamedTuple):
    """A backup's derivative in the value, ``J x = discount * sum_a w(s, a) (P x)(s, a)``.

    Written out with its weights w, a product with it is far cheaper than what
    differentiating the backup gives. It only steers solvers: derivatives of any order
    are those of the backup itself.
    """

    model: Any
    discount: jax.Array
    weight: jax.Array

    def matvec(self, x: jax.Array) -> jax.Array:
        return x - self.discount * action_mean(self.weight, expectation(self.model, x))

    def solve(self, _, b: jax.Array) -> jax.Array:
        return solve_linear(self.matvec, b)

    def transpose_solve(self, _, b: jax.Array) -> jax.Array:
        def vecmat(x: jax.Array) -> jax.Array:
            return x - self.discount * pushforward(self.model, self.weight * x[..., None])

        return solve_linear(vecmat, b)

    def newton(self, value: jax.Array, image: jax.Array) -> jax.Array:
        """One inexact step of Newton's method from `value`, whose backup is `image`.

        A plain sweep where the linear solver gets nowhere, as it can in single precision.
        """
        change = image - value
        found = solve_linear(self.matvec, change, tolerance=1e-2, max_steps=48)
        left = self.matvec(found) - change
        solved = jnp.sum(left * left) <= jnp.sum(change * change) / 4
        return value + jnp.where(solved, found, change)
