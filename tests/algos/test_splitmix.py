"""Cheap random words: the published mixer, word for word, and what is drawn from it."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos.common import splitmix

MASK = 2**32 - 1
# Of the reference program in C: hash prospector, [16 21f0aaad 15 d35a2d97 15].
VECTORS = {
    0x00000000: 0x00000000,
    0x00000001: 0x06D3FA73,
    0x00000002: 0x0DA7F4E7,
    0x12345678: 0xF6E6B6BD,
    0x80000000: 0xC0BD1472,
    0xDEADBEEF: 0x8A2B8AF2,
    0xFFFFFFFF: 0xD9B56683,
}


def prospected(x):
    """``x ^= x >> 16; x *= 0x21f0aaad; x ^= x >> 15; x *= 0xd35a2d97; x ^= x >> 15;``"""
    x ^= x >> 16
    x = x * 0x21F0AAAD & MASK
    x ^= x >> 15
    x = x * 0xD35A2D97 & MASK
    return x ^ x >> 15


def undone(x):
    """The inverse: shifts undone twice, and inverse factors modulo 2^32."""
    x ^= x >> 15 ^ x >> 30
    x = x * pow(0xD35A2D97, -1, 2**32) & MASK
    x ^= x >> 15 ^ x >> 30
    x = x * pow(0x21F0AAAD, -1, 2**32) & MASK
    return x ^ x >> 16


def test_the_mixer_is_the_published_one():
    some = np.random.default_rng(0).integers(2**32, size=1000, dtype=np.uint32)
    found = np.asarray(splitmix.mix32(jnp.asarray(some))).tolist()
    assert found == [prospected(x) for x in some.tolist()]
    assert [undone(x) for x in found] == some.tolist()
    given = jnp.asarray(np.array(list(VECTORS), np.uint32))
    assert np.asarray(splitmix.mix32(given)).tolist() == list(VECTORS.values())


def test_words_are_mixed_terms_of_a_weyl_sequence():
    start, increment = splitmix.streams(jax.random.key(0), (3,))
    assert start.dtype == increment.dtype == jnp.uint32
    assert (np.asarray(increment) % 2 == 1).all()
    found = splitmix.words((start[:, None], increment[:, None]), jnp.arange(5, dtype=jnp.uint32))
    for s, i, row in zip(start.tolist(), increment.tolist(), found.tolist(), strict=True):
        assert row == [prospected(s + i * n & MASK) for n in range(5)]
    assert len(set(np.ravel(found).tolist())) == 15


def test_bits_are_fair_and_streams_apart():
    """Each bit, and each bit beside the same one of the next word and of the next stream."""
    stream = splitmix.streams(jax.random.key(1), (64, 1))
    words = np.asarray(splitmix.words(stream, jnp.arange(4096, dtype=jnp.uint32)))
    bits = (words[..., None] >> np.arange(32, dtype=np.uint32) & 1).astype(float) - 0.5
    size = 6 / np.sqrt(words.size)
    assert (np.abs(2 * bits.mean((0, 1))) < size).all()
    assert (np.abs(4 * (bits[:, 1:] * bits[:, :-1]).mean((0, 1))) < size).all()
    assert (np.abs(4 * (bits[1:] * bits[:-1]).mean((0, 1))) < size).all()


def test_numbers_are_in_the_unit_interval():
    ends = jnp.asarray(np.array([0, 255, 256, MASK], np.uint32))
    assert splitmix.uniform(ends, jnp.float32).tolist() == [0, 0, 2**-24, 1 - 2**-24]
