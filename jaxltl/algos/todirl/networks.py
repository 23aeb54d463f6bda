"""Reward networks of observation, automaton state and action."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn


class RewardNetwork(nn.Module):
    """A multilayer perceptron with ReLU on (observation, memory, action).

    Maps ``float[..., O]``, ``float[..., Q]`` and ``float[..., A]``, which broadcast, to
    ``float[...]``. The first layer is a sum of three, so that no input is repeated for each
    combination with the others.

    Attributes:
      hidden: widths of the hidden layers; section 3.5 has two of 80. Empty: a linear reward.
    """

    hidden: Sequence[int] = (80, 80)

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array, action: jax.Array) -> jax.Array:
        widths = (*self.hidden, 1)
        inputs = (observation, memory, action)
        sizes = [x.shape[-1] for x in inputs]
        kernel = self.param("kernel", nn.initializers.lecun_normal(), (sum(sizes), widths[0]))
        bias = self.param("bias", nn.initializers.zeros_init(), (widths[0],))
        parts = jnp.split(kernel, np.cumsum(sizes)[:-1])
        terms = [x @ part for x, part in zip(inputs, parts, strict=True)]
        x = terms[0] + (terms[1] + terms[2] + bias)
        rows = x.shape[:-1]
        x = x.reshape(-1, widths[0])  # matrix products are faster than batched ones
        for width in widths[1:]:
            x = nn.Dense(width)(nn.relu(x))
        return x.reshape(rows)


class Concatenated(nn.Module):
    """A reward network from one of concatenated inputs, ``[..., O + Q + A] -> [...]`` or ``[..., 1]``.

    Attributes:
      network: the flax module, of vectors ``float[N, O + Q + A]``, or of any leading axes.

    Example:
      >>> import jax
      >>> read = jnp.zeros((5, 3)), jnp.zeros((5, 2)), jnp.zeros((5, 4))
      >>> jax.eval_shape(Concatenated(nn.Dense(1)).init_with_output, jax.random.key(0), *read)[0].shape
      (5,)
    """

    network: nn.Module

    @nn.compact
    def __call__(self, observation: jax.Array, memory: jax.Array, action: jax.Array) -> jax.Array:
        inputs = (observation, memory, action)
        rows = jnp.broadcast_shapes(*(x.shape[:-1] for x in inputs))
        wide = [jnp.broadcast_to(x, (*rows, x.shape[-1])) for x in inputs]
        result = self.network(jnp.concatenate(wide, axis=-1))
        return result[..., 0] if result.shape == (*rows, 1) else result
