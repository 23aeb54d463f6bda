"""Many cheap random words from a few of JAX's: SplitMix with 32-bit words.

A keyed hash of each number costs more than a move in a small game or the evaluation of a small
policy. Here a key gives streams, each a start and an odd increment, and the words of a stream are
the mixed terms of a Weyl sequence, ``mix32(start + i increment)``: the construction of SplitMix
(Steele, Lea and Flood, Fast splittable pseudorandom number generators, 2014, section 3), whose
mixer is written for 64 bits. The mixer here is the 32-bit one of C. Wellons' hash prospector
(github.com/skeeto/hash-prospector, ``[16 21f0aaad 15 d35a2d97 15]``, bias .108).

Streams are short: a learner begins new ones from its key at every step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp

Stream = tuple[jax.Array, jax.Array]


def streams(key: chex.PRNGKey, shape: Sequence[int] = ()) -> Stream:
    """Streams of their own starts and odd increments, each ``uint32[*shape]``."""
    words = jax.random.bits(key, (2, *shape), jnp.uint32)
    return words[0], words[1] | 1


def words(stream: Stream, i: jax.Array) -> jax.Array:
    """The i-th 32 random bits of each stream, ``uint32``; shapes are broadcast.

    Args:
      stream: of :func:`streams`.
      i: ``uint32``, below ``2 ** 32``, after which a stream repeats itself.
    """
    return mix32(stream[0] + stream[1] * i)


def mix32(x: jax.Array) -> jax.Array:
    """A bijection of 32-bit words that flips half of the bits for each bit of its argument.

    Example:
      >>> [f"{int(mix32(jnp.uint32(x))):08x}" for x in (1, 2, 0xFFFFFFFF)]
      ['06d3fa73', '0da7f4e7', 'd9b56683']
    """
    x = (x ^ (x >> 16)) * jnp.uint32(0x21F0AAAD)
    x = (x ^ (x >> 15)) * jnp.uint32(0xD35A2D97)
    return x ^ (x >> 15)


def uniform(word: jax.Array, dtype: Any) -> jax.Array:
    """24 random bits as a number in [0, 1)."""
    return (word >> 8).astype(dtype) / 2.0**24
