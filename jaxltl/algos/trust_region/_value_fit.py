"""Regression of value networks on their targets."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import optax

from jaxltl.algos.common.collection import minibatch_epochs
from jaxltl.algos.trust_region._policy_networks import values_at
from jaxltl.algos.trust_region.state import Hparams, State
from jaxltl.core.models.protocols import PyTree


def fitted(
    key: chex.PRNGKey,
    state: State,
    inputs: jax.Array,
    target: jax.Array,
    valid: jax.Array,
    hparams: Hparams,
) -> tuple[PyTree, PyTree, jax.Array]:
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
        num_epochs=hparams.value_epochs,
        num_minibatches=hparams.value_batches,
    )
    return values, memory, moments


def weighted_variance(x: jax.Array, valid: jax.Array) -> jax.Array:
    """Variance ``float[V]`` of ``float[V, T, N]`` over valid entries."""
    number = jnp.maximum(valid.sum(), 1)
    mean = jnp.where(valid, x, 0).sum((1, 2), keepdims=True) / number
    return jnp.where(valid, (x - mean) ** 2, 0).sum((1, 2)) / number


def positive(x: jax.Array) -> jax.Array:
    """The number, or 1 where it is zero, for a division."""
    return jnp.where(x > 0, x, 1)
