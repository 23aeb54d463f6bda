"""Distributions of actions: masked categorical, or Gaussian within a box.

All functions concern one action. A *raw* action is the index of the action, or a Gaussian sample in
units in which a box with both bounds is ``[-1, 1]``. The environment receives :func:`as_action` of
it: clipped, or squashed by a hyperbolic tangent.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike

from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import Box, Finite, clipped_action

Actions = Finite | Box
SQUASHES = ("clip", "tanh")

# Abscissas and weights that integrate against the standard normal density.
_NODES, _WEIGHTS = np.polynomial.hermite_e.hermegauss(16)
_WEIGHTS = _WEIGHTS / np.sqrt(2 * np.pi)


def noise(key: Key, shape: tuple[int, ...], actions: Actions, dtype: DTypeLike) -> jax.Array:
    """Gumbel or normal noise of a batch of actions."""
    if isinstance(actions, Finite):
        return jax.random.gumbel(key, (*shape, actions.num), dtype)
    return jax.random.normal(key, (*shape, *actions.shape), dtype)


def drawn(
    actions: Actions, parameters: PyTree, allowed: jax.Array | None, noise: jax.Array | None
) -> jax.Array:
    """A raw action; without noise the most likely one."""
    if isinstance(actions, Finite):
        scores = _masked(parameters, allowed)
        return jnp.argmax(scores if noise is None else scores + noise).astype(jnp.int32)
    mean, log_deviation = parameters
    return mean if noise is None else mean + jnp.exp(log_deviation) * noise


def as_action(actions: Actions, raw: jax.Array, squash: str | None) -> jax.Array:
    """The action of a raw action; with `squash` None clipped in the environment's own units."""
    if isinstance(actions, Finite):
        return raw
    if squash is None:
        return clipped_action(actions, raw.reshape(actions.shape).astype(actions.dtype))
    low, high = (jnp.broadcast_to(x, actions.shape) for x in (actions.low, actions.high))
    bounded = jnp.isfinite(low) & jnp.isfinite(high)
    middle, half = jnp.where(bounded, (low + high) / 2, 0), jnp.where(bounded, (high - low) / 2, 1)
    inside = jnp.where(bounded, jnp.tanh(raw), raw) if squash == "tanh" else raw
    return clipped_action(actions, middle + half * inside).astype(actions.dtype)


def chosen(
    key: Key,
    actions: Actions,
    parameters: PyTree,
    allowed: jax.Array | None,
    *,
    sampled: bool,
    squash: str | None,
) -> jax.Array:
    """The action of an agent: sampled, or the most likely one."""
    kind = jax.tree.leaves(parameters)[0].dtype
    raw = drawn(actions, parameters, allowed, noise(key, (), actions, kind) if sampled else None)
    return as_action(actions, raw, squash)


def log_density(
    actions: Actions, parameters: PyTree, allowed: jax.Array | None, raw: jax.Array
) -> jax.Array:
    """Log density of a raw action; that of the action differs by a term without parameters."""
    if isinstance(actions, Finite):
        return jax.nn.log_softmax(_masked(parameters, allowed))[raw]
    mean, log_deviation = parameters
    scaled = (raw - mean) * jnp.exp(-log_deviation)
    return -jnp.sum(scaled**2 / 2 + log_deviation + np.log(2 * np.pi) / 2)


def probabilities(logits: jax.Array, allowed: jax.Array | None) -> jax.Array:
    """Probabilities of finitely many actions, zero where they are not allowed."""
    share = jax.nn.softmax(_masked(logits, allowed))
    return share if allowed is None else jnp.where(allowed, share, 0)


def entropy(
    actions: Actions, parameters: PyTree, allowed: jax.Array | None, squash: str
) -> jax.Array:
    """Entropy over allowed actions; of a squashed Gaussian by Gauss-Hermite quadrature."""
    if isinstance(actions, Finite):
        log = jax.nn.log_softmax(_masked(parameters, allowed))
        log = log if allowed is None else jnp.where(allowed, log, 0)
        mass = jnp.exp(log) if allowed is None else jnp.where(allowed, jnp.exp(log), 0)
        return -jnp.sum(mass * log)
    mean, log_deviation = parameters
    own = log_deviation + (1 + np.log(2 * np.pi)) / 2
    if squash != "tanh":
        return jnp.sum(own)
    nodes = jnp.asarray(_NODES, mean.dtype).reshape(-1, *[1] * mean.ndim)
    points = mean + jnp.exp(log_deviation) * nodes
    slope = 2 * (np.log(2) - points - jax.nn.softplus(-2 * points))  # log(1 - tanh^2)
    stretch = jnp.tensordot(jnp.asarray(_WEIGHTS, mean.dtype), slope, 1)
    bounded = jnp.isfinite(actions.low) & jnp.isfinite(actions.high)
    return jnp.sum(own + jnp.where(bounded, stretch, 0))


def _masked(logits: jax.Array, allowed: jax.Array | None) -> jax.Array:
    """Logits with those of disallowed actions minus infinity."""
    if allowed is None:
        return logits
    # An infinitely bad one that is allowed must still be better than all that are not.
    return jnp.where(allowed, jnp.maximum(logits, jnp.finfo(logits.dtype).min / 2), -jnp.inf)
