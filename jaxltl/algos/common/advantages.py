"""Generalised advantage estimation."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax import lax


def generalized_advantages(
    reward: jax.Array,
    value: jax.Array,
    following: jax.Array,
    discount: chex.Numeric,
    gae_lambda: chex.Numeric,
    ended: chex.Numeric = False,
) -> jax.Array:
    """Generalised advantages (Schulman et al. 2016, equation 16) of consecutive episodes.

    ``A_t = d_t + discount_t lambda A_{t+1}`` with ``d_t = r_t + discount_t V'_t - V_t``, and A = 0 after
    the last of T steps and after the end of an episode.

    Args:
      reward: ``float[T, ...]``.
      value: ``float[T, ...]``, V before each step.
      following: ``float[T, ...]``, V' after each step, also where an episode is truncated; zero after
        a termination.
      discount: in [0, 1]; a number, or ``float[T, ...]``.
      gae_lambda: in [0, 1].
      ended: ``bool[T, ...]``, whether an episode ended with the step.

    Returns:
      ``float[T, ...]``.

    Example:
      >>> ones, zeros = jnp.ones(3), jnp.zeros(3)
      >>> ended = jnp.array([False, True, False])
      >>> generalized_advantages(ones, zeros, zeros, 0.5, 1.0, ended).tolist()
      [1.5, 1.0, 1.0]
    """
    error = reward + discount * following - value
    kept = jnp.broadcast_to(jnp.where(ended, 0, discount * gae_lambda), error.shape)

    def back(later: jax.Array, row: Any) -> tuple[jax.Array, jax.Array]:
        error, kept = row
        now = error + kept * later
        return now, now

    return lax.scan(back, jnp.zeros_like(error[0]), (error, kept), reverse=True)[1]
