"""Advantages of finite trajectories, and regression of value networks on their targets."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from jax import lax

from jaxltl.algos.common.advantages import generalized_advantages
from jaxltl.algos.trust_region._policy_networks import (
    values_at,
)


def advantages(
    signal: jax.Array,
    value: jax.Array,
    valid: jax.Array,
    discount: chex.Numeric,
    gae_lambda: chex.Numeric,
    after: chex.Numeric = 0.0,
) -> jax.Array:
    """Generalised advantages (Schulman et al. 2016, equation 16) of finite trajectories.

    ``A_t = d_t + discount_t lambda A_{t+1}`` with ``d_t = r_t + discount_t V_{t+1} - V_t``; after the
    last valid step ``A = 0`` and ``V = after``. Zero where `valid` is false.

    >>> ones, zeros = jnp.ones(3), jnp.zeros(3)
    >>> advantages(ones, zeros, jnp.array([True, True, False]), 0.5, 1.0).tolist()
    [1.5, 1.0, 0.0]
    """
    value = jnp.where(valid, value, 0)
    following = jnp.concatenate([value[1:], jnp.zeros_like(value[:1])])
    goes_on = jnp.concatenate([valid[1:], jnp.zeros_like(valid[:1])])
    following = jnp.where(valid, jnp.where(goes_on, following, after), 0)
    return generalized_advantages(
        jnp.where(valid, signal, 0), value, following, discount, gae_lambda
    )


def fitted(
    key: chex.PRNGKey,
    state: Any,
    inputs: jax.Array,
    target: jax.Array,
    valid: jax.Array,
    hparams: Any,
) -> tuple[Any, Any, jax.Array]:
    """Value networks after Adam's steps on the squared error to targets ``float[V, T, N]``."""
    mean = jnp.where(valid, target, 0).sum((1, 2)) / jnp.maximum(valid.sum(), 1)
    deviation = jnp.sqrt(weighted_variance(target, valid))
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
        error = values_at(values, hparams, inputs[chosen]) - target[:, chosen]
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


def weighted_variance(x: jax.Array, valid: jax.Array) -> jax.Array:
    """Variance ``float[V]`` of ``float[V, T, N]`` over valid entries."""
    number = jnp.maximum(valid.sum(), 1)
    mean = jnp.where(valid, x, 0).sum((1, 2), keepdims=True) / number
    return jnp.where(valid, (x - mean) ** 2, 0).sum((1, 2)) / number


def positive(x: jax.Array) -> jax.Array:
    """The number, or 1 where it is zero, for a division."""
    return jnp.where(x > 0, x, 1)
