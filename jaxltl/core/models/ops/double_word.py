"""Double-word arithmetic inside ``jit``, for residuals and bounds beyond the precision of the dtype.

A number is the unevaluated sum of a high and a low word, the high one its nearest float (Dekker 1971;
Joldes, Muller and Popescu 2017). Both are stored as one complex number, so that every gather, exchange
and reshape of values moves them together; it is never multiplied as such.

Compilers contract a product and a sum into one operation with one rounding, which breaks the usual
algorithms for the error of a product. Here factors are split in halves by a mask, so that products of
halves are exact, and contraction cannot change them.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.models.ops import kernels
from jaxltl.core.models.ops.choices import action_argmax, action_mean
from jaxltl.core.models.ops.operators import combined
from jaxltl.core.models.protocols import ActionModel, SuccessorModel

_HALF = {4: (jnp.uint32, 12), 8: (jnp.uint64, 27)}  # bits of a significand that a mask clears


def two_sum(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The float nearest to ``a + b``, and the rest, exactly (Knuth 1969)."""
    # XLA folds ``(a + b) - a`` where a is a constant, but not through a change of precision, even
    # one to the same precision.
    info = jnp.finfo(a.dtype)
    total = lax.reduce_precision(a + b, info.nexp, info.nmant)
    rest = total - a
    return total, (a - (total - rest)) + (b - rest)


def _fast_sum(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    """:func:`two_sum` of floats where b is not larger than a, or a is 0 (Dekker 1971)."""
    info = jnp.finfo(a.dtype)
    total = lax.reduce_precision(a + b, info.nexp, info.nmant)
    return total, b - (total - a)


def double_word(high: jax.Array, low: jax.Array | float = 0) -> jax.Array:
    """``high + low`` as a normalised double word."""
    return lax.complex(*two_sum(high, jnp.broadcast_to(low, high.shape).astype(high.dtype)))


def words(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The high and the low word."""
    return lax.real(x), lax.imag(x)


@jit()
def plus(x: jax.Array, y: jax.Array) -> jax.Array:
    """Sum with a relative error of at most ``4 u^2`` for the unit roundoff u."""
    # AccurateDWPlusDW of Joldes, Muller and Popescu (2017, theorem 3.1): 3 u^2 / (1 - 4 u).
    (a, c), (b, d) = words(x), words(y)
    high, rest = two_sum(a, b)
    low, more = two_sum(c, d)
    high, rest = _fast_sum(high, rest + low)
    return lax.complex(*_fast_sum(high, more + rest))


def minus(x: jax.Array, y: jax.Array) -> jax.Array:
    """Difference, rounded to one float; its sign is exact."""
    return lax.real(plus(x, -y))


@jit()
def times(w: jax.Array, x: jax.Array) -> jax.Array:
    """Product of a float and a double word, with a relative error of at most ``64 u^2``."""
    # With 12 of 24 bits in either half, products of halves are exact, and the three of them that
    # reach beyond u are added without error. The low word grows by at most 16 u |w x|,
    # with at most four roundings.
    high, low = words(x)
    (a, b), (c, d) = _halves(w), _halves(high)
    total, rest = _fast_sum(a * c, a * d)
    total, more = _fast_sum(total, b * c)
    return lax.complex(*_fast_sum(total, (rest + more) + (b * d + w * low)))


@jit()
def product(x: jax.Array, y: jax.Array) -> jax.Array:
    """Product of two double words, with a relative error of at most ``80 u^2``."""
    high, low = words(x)
    total, rest = words(times(high, y))
    return lax.complex(*_fast_sum(total, rest + low * lax.real(y)))


@jit()
def reciprocal(x: jax.Array) -> jax.Array:
    """``1 / x`` with a relative error of at most ``128 u^2``, 0 where x is 0."""
    # One step of Newton's method squares the relative error u of the first guess.
    high = lax.real(x)
    guess = jnp.where(high == 0, 0, 1 / jnp.where(high == 0, 1, high))
    product, rest = words(times(guess, x))
    remainder = (1 - product) - rest  # the first difference is exact (Sterbenz 1974)
    return double_word(guess, jnp.where(high == 0, 0, guess * remainder))


def _halves(x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Two floats with the sum x and half of its bits each."""
    kind, bits = _HALF[x.dtype.itemsize]
    mask = jnp.array(~((1 << bits) - 1) & (2 ** (8 * x.dtype.itemsize) - 1), kind)
    high = lax.bitcast_convert_type(lax.bitcast_convert_type(x, kind) & mask, x.dtype)
    return high, x - high


def outwards(x: jax.Array, end: int) -> jax.Array:
    """The nearest float that is not below a double word, for `end` 1, or not above it, for -1."""
    high, low = words(x)
    # Floats of one sign are ordered like their bits; the low word of 0 is 0.
    kind = jnp.int64 if high.dtype.itemsize == 8 else jnp.int32
    bits = lax.bitcast_convert_type(high, kind) + jnp.where(high < 0, -end, end).astype(kind)
    return jnp.where(end * low > 0, lax.bitcast_convert_type(bits, high.dtype), high)


def best(quantity: jax.Array, available: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Maximum of ``[S, A]`` over available actions, and the first maximiser."""
    # Normalised double words are ordered like their words.
    high, low = words(quantity)
    top = action_argmax(high, available)[0]
    action = action_argmax(low, available & (high >= top[..., None]))[1]
    return jnp.where(top == -jnp.inf, top, action_mean(action, quantity)), action


class DoubleWordRows(NamedTuple):
    """The normalised rows of a padded model, and of a policy: backups in double words."""

    model: ActionModel
    scale: jax.Array  # [S, A], the reciprocals of the sums of rows
    policy: jax.Array | None  # [S, A], weights with the sum one, or None

    def expectation(self, value: jax.Array) -> jax.Array:
        """Expected value of the next state, ``[S, A]``."""
        return product(self.scale, combined(self.model, value, times, plus))

    def mean(self, quantity: jax.Array) -> jax.Array:
        """Mean over the policy's actions, ``[S]``."""
        assert self.policy is not None
        return kernels.reduced(plus, product(self.policy, quantity), -1)

    @property
    def terms(self) -> int:
        """Number of terms of a backup."""
        return cast(SuccessorModel, self.model).num_successors + self.model.num_actions

    @property
    def unit(self) -> float:
        """Relative error of a backup with a policy, a discount and a reward."""
        # In units of u^2: 64 for each term, 4 for each sum, over the entries, and over their sum
        # too; 128 for its reciprocal and 80 for the product with it; the same for a policy, whose
        # terms are products of double words; and 160 for a discount and a reward.
        return (700 + 8 * self.terms) * (float(jnp.finfo(self.model.dtype).eps) / 2) ** 2

    def underflow(self, size: jax.Array) -> jax.Array:
        """Absolute error of a backup by words that are flushed to zero, for values up to `size`."""
        return 32 * (self.terms + 8) * float(jnp.finfo(self.model.dtype).tiny) * (1 + size)


def normalised_rows(model: ActionModel, policy: jax.Array | None = None) -> DoubleWordRows:
    """The rows of a model, and of a policy ``float[S, A]``, each divided by its sum."""
    one = double_word(jnp.ones(model.state_shape, model.dtype))
    total = combined(model, one, times, plus)
    if policy is None:
        scale = reciprocal(total)
    else:
        weight = double_word(policy)
        whole = kernels.reduced(plus, weight, -1)[..., None]
        scale = reciprocal(jnp.concatenate([total, whole], -1))
        scale, policy = scale[..., :-1], product(weight, scale[..., -1:])
    return lax.stop_gradient(DoubleWordRows(model, scale, policy))
