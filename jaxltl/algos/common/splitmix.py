"""SplitMix pseudorandom words of 32 bits, seeded by JAX keys.

A keyed hash for each number costs more than a transition of a small game. Here a key gives streams,
each with a start and an odd increment; the words of a stream are the mixed terms of a Weyl
sequence, ``mix32(start + i * increment)``: the construction of SplitMix (Steele, Lea and Flood,
Fast splittable pseudorandom number generators, 2014, section 3), with the 32-bit mixer of C.
Wellons' hash prospector (github.com/skeeto/hash-prospector, ``[16 21f0aaad 15 d35a2d97 15]``, bias
.108). Streams are short: a learner seeds new ones from its key at every step.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from jaxltl.core.array_types import Key

Stream = tuple[jax.Array, jax.Array]


def streams(key: Key, shape: Sequence[int] = ()) -> Stream:
    """Starts and odd increments of independent streams, each ``uint32[*shape]``."""
    words = jax.random.bits(key, (2, *shape), jnp.uint32)
    return words[0], words[1] | 1


def words(stream: Stream, i: jax.Array) -> jax.Array:
    """The i-th 32 random bits of each stream, ``uint32``; shapes are broadcast."""
    return mix32(stream[0] + stream[1] * i)


def mix32(x: jax.Array) -> jax.Array:
    """A bijection of 32-bit words in which each input bit flips half of the output bits."""
    x = (x ^ (x >> 16)) * jnp.uint32(0x21F0AAAD)
    x = (x ^ (x >> 15)) * jnp.uint32(0xD35A2D97)
    return x ^ (x >> 15)


def uniform(word: jax.Array, dtype: DTypeLike) -> jax.Array:
    """24 random bits as a number in [0, 1)."""
    return (word >> 8).astype(dtype) / 2.0**24
