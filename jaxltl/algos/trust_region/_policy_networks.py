"""Gaussian policies and value networks of trust-region methods, and the fit of the latter."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
from jax.typing import DTypeLike

from jaxltl.algos.common.collection import minibatch_epochs
from jaxltl.algos.common.moments import Moments, scale_of, standardized
from jaxltl.algos.common.settings import applied
from jaxltl.algos.trust_region.state import Hparams, State
from jaxltl.core.array_types import Key, PyTree


class Network(nn.Module):
    """Tanh layers and a linear layer, initialised at `last_scale` times the usual scale."""

    hidden: tuple[int, ...]
    outputs: int
    last_scale: float
    dtype: DTypeLike

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        def layer(width: int, name: str, scale: float = 1.0) -> nn.Dense:
            start = nn.initializers.variance_scaling(scale**2, "fan_in", "normal")
            return nn.Dense(width, param_dtype=self.dtype, kernel_init=start, name=name)

        for i, width in enumerate(self.hidden):
            x = nn.tanh(layer(width, f"hidden_{i}")(x))
        return layer(self.outputs, "out", self.last_scale)(x)


def mean_network(hparams: Hparams, num_actions: int, dtype: DTypeLike) -> Network:
    """The network of a policy's mean."""
    return Network(hparams.hidden, num_actions, 0.1, dtype)


def value_network(hparams: Hparams, dtype: DTypeLike) -> Network:
    """The network of a value of rewards or costs."""
    return Network(hparams.value_hidden, 1, 0.1, dtype)


def gaussian(
    parameters: PyTree, hparams: Hparams, inputs: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Mean and standard deviation of the actions."""
    log_deviation = parameters["log_deviation"]
    network = mean_network(hparams, log_deviation.shape[0], log_deviation.dtype)
    mean = jnp.asarray(applied(network, parameters["mean"], inputs))
    return mean, jnp.broadcast_to(jnp.exp(log_deviation), mean.shape)


def log_density(action: jax.Array, mean: jax.Array, deviation: jax.Array) -> jax.Array:
    """Log density of a Gaussian with independent entries, up to a constant."""
    return -jnp.sum(((action - mean) / deviation) ** 2 / 2 + jnp.log(deviation), -1)


def kl_divergence(old: tuple[jax.Array, jax.Array], new: tuple[jax.Array, jax.Array]) -> jax.Array:
    """``KL(old || new)`` of Gaussians with independent entries."""
    (mean, deviation), (other, spread) = old, new
    ratio = deviation / spread
    return jnp.sum((ratio**2 + ((mean - other) / spread) ** 2 - 1) / 2 - jnp.log(ratio), -1)


def values_at(values: PyTree, hparams: Hparams, inputs: jax.Array) -> jax.Array:
    """Values ``float[V, ...]`` before scaling."""
    network = value_network(hparams, inputs.dtype)
    return jax.vmap(lambda p: jnp.asarray(applied(network, p, inputs))[..., 0])(values)


def value_inputs(inputs: jax.Array) -> jax.Array:
    """``float[T, N, O + 1]``: standardised observations and the time."""
    time = jnp.linspace(-1, 1, inputs.shape[0], dtype=inputs.dtype)
    time = jnp.broadcast_to(time[:, None, None], (*inputs.shape[:2], 1))
    return jnp.concatenate([inputs, time], -1)


def inputs_at(inputs: jax.Array, time: jax.Array, horizon: int) -> jax.Array:
    """``float[N, O + 1]``: inputs and times ``int[N]``; times beyond the horizon count as its last step."""
    times = jnp.linspace(-1, 1, horizon, dtype=inputs.dtype)
    return jnp.concatenate([inputs, times[jnp.minimum(time, horizon - 1)][:, None]], -1)


def normalized(moments: Moments, hparams: Hparams, observation: jax.Array) -> jax.Array:
    """Standardised observations if ``hparams.normalize``."""
    return standardized(moments, observation) if hparams.normalize else observation


def refolded(network: PyTree, old: Moments, new: Moments) -> PyTree:
    """Parameters of the same function of observations under new moments."""
    first = "hidden_0" if "hidden_0" in network else "out"
    kernel, bias = network[first]["kernel"], network[first]["bias"]
    size, spread = old.mean.shape[0], scale_of(old)
    head = kernel[:size]
    bias = bias + ((new.mean - old.mean) / spread) @ head
    head = head * (scale_of(new) / spread)[:, None]
    return {**network, first: {"kernel": kernel.at[:size].set(head), "bias": bias}}


def fitted(
    key: Key, state: State, inputs: jax.Array, target: jax.Array, valid: jax.Array, hparams: Hparams
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
