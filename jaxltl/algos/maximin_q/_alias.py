"""Walker's alias method: samples from a categorical distribution by one table look-up."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxltl.algos.common.play import take

# An entry holds 24 bits of a threshold, and in 8 bits the alias drawn above the threshold.
_BITS = 24
MOST_ACTIONS = 256


def alias_table(rows: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Alias tables ``uint32[S, A]`` of distributions ``float[S, A]`` (Walker 1977)."""
    num_states, num_actions = rows.shape
    mass = rows * num_actions
    share, alias = np.ones(rows.shape), np.tile(np.arange(num_actions), (num_states, 1))
    unfilled, s = np.ones(rows.shape, bool), np.arange(num_states)
    for _ in range(num_actions - 1):
        least = np.where(unfilled, mass, np.inf).argmin(-1)
        most = np.where(unfilled, mass, -np.inf).argmax(-1)
        share[s, least], alias[s, least] = mass[s, least], most
        mass[s, most] -= 1 - mass[s, least]
        unfilled[s, least] = False
    # Rounding must not give weight to an action of probability zero.
    threshold = np.where(rows > 0, np.rint(np.clip(share, 0, 1) * 2**_BITS), 0).astype(np.int64)
    heaviest = rows.argmax(-1)[:, None]
    alias = np.where(np.take_along_axis(rows, alias, -1) > 0, alias, heaviest)
    full = threshold == 2**_BITS
    alias = np.where(full, np.arange(num_actions), alias)
    return (np.where(full, 0, threshold) << 8 | alias).astype(np.uint32)


def draw_alias(table: jax.Array, row: jax.Array, words: jax.Array) -> jax.Array:
    """A sample ``int32[N]`` from given rows of an alias table, by 32 random bits each."""
    num_actions = table.shape[-1]
    word = (words >> 8) * jnp.uint32(num_actions)
    slot = (word >> _BITS).astype(jnp.int32)
    entry = take(table.ravel(), row * num_actions + slot)
    alias = (entry & 0xFF).astype(jnp.int32)
    return jnp.where((word & (2**_BITS - 1)) < entry >> 8, slot, alias)
