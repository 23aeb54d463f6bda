"""Generalised advantages: how much better than expected what was done turned out."""

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
    """Generalised advantages (Schulman et al. 2016, equation 16), episodes one after the other::

        A_t = d_t + discount_t lambda A_{t+1},    d_t = r_t + discount_t V'_t - V_t,

    with A = 0 after the last of T steps, and after the last step of an episode.

    Args:
      reward: ``float[T, ...]``.
      value: ``float[T, ...]``, V of the worlds where they are earned.
      following: ``float[T, ...]``, V' of the worlds that the steps lead to, those in which an
        episode is cut off included; zero where nothing comes after.
      discount: in [0, 1]; one number, or ``float[T, ...]`` of what comes after each step.
      gae_lambda: in [0, 1].
      ended: ``bool[T, ...]``, whether an episode ended with the step, in whatever way.

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
