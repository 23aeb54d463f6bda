"""Gaussian policies and value networks of trust-region methods, on standardised observations."""

from __future__ import annotations

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from jaxltl.algos.common.moments import Moments, scale_of, standardized
from jaxltl.algos.common.settings import applied
from jaxltl.algos.trust_region.state import Hparams
from jaxltl.core.models.protocols import PyTree


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
