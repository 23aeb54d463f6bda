"""Interval estimates of transition probabilities, updated by counts."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxltl.algos.interval_learning.state import Hparams, State


def linear_intervals(state: State, new: jax.Array, hparams: Hparams) -> tuple[jax.Array, jax.Array]:
    """Linearly updating intervals (Suilen et al. 2022, definition 4; Walter and Augustin 2009).

    ``(n P + k) / (n + N)`` for both ends P and N `new` observations, k of them of the transition.
    The strength n is the larger one if all frequencies ``k / N`` of the action are on the inner
    side of P, else the smaller one. Strengths grow by N.
    """
    dtype = state.lower.dtype
    before = jnp.sum(state.counts - new, -1, keepdims=True).astype(dtype)
    weak, strong = before + hparams.strength, before + hparams.most_strength
    number = jnp.sum(new, -1, keepdims=True).astype(dtype)
    share = new / jnp.maximum(number, 1)

    def end(prior: jax.Array, agrees: jax.Array) -> jax.Array:
        n = jnp.where(jnp.all(agrees, -1, keepdims=True), strong, weak)
        return (n * prior + new) / (n + number)

    lower = end(state.lower, share >= state.lower)
    return consistent(lower, end(state.upper, share <= state.upper))


def confidence_intervals(
    state: State, num_claims: jax.Array, hparams: Hparams
) -> tuple[jax.Array, jax.Array]:
    """Anytime-valid confidence intervals of all probabilities at once, in closed form.

    The set of :func:`~jaxltl.core.statistics.binomial.anytime` is contained in ``n kl(k / n, p) <=
    log(2 sqrt(n) / failure)``, since Jeffreys' mixture is at least ``1 / (2 sqrt(n))`` of any
    likelihood (Willems, Shtarkov and Tjalkens 1995). An enclosure follows from ``kl(a, b) >= 2 (a -
    b)^2`` and ``kl(a, b) >= (a - b)^2 / (2 max(a, b))``, for a probability and for its complement.
    All these sets hold simultaneously, hence so does their intersection over time.
    """
    dtype = state.lower.dtype
    used = state.upper > 0
    failure = (1 - jnp.asarray(hparams.confidence, dtype)) / num_claims.astype(dtype)
    total = jnp.sum(state.counts, -1, keepdims=True).astype(dtype)
    n = jnp.maximum(total, 1)
    share, c = state.counts / n, (jnp.log(2 * jnp.sqrt(n)) - jnp.log(failure)) / n
    lower, upper = kl_lower_end(share, c), 1 - kl_lower_end(1 - share, c)
    floor = jnp.minimum(jnp.asarray(hparams.least, dtype), upper)
    lower = jnp.where(used, jnp.maximum(jnp.maximum(lower, floor), state.lower), 0)
    upper = jnp.where(used, jnp.minimum(upper, state.upper), 0)
    return consistent(lower, upper)


def kl_lower_end(a: jax.Array, c: jax.Array) -> jax.Array:
    """A lower bound of all b with ``kl(a, b) <= c``."""
    a = jnp.clip(a, 0, 1)  # rounding may leave [0, 1]
    other = 1 - a
    below = jnp.minimum(jnp.sqrt(c / 2), jnp.sqrt(2 * c * a))
    return jnp.maximum(a - jnp.minimum(below, c + jnp.sqrt(c * c + 2 * c * other)), 0)


def consistent(lower: jax.Array, upper: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The ends, widened or scaled so that they contain a distribution in spite of rounding."""
    lower = lower / jnp.maximum(jnp.sum(lower, -1, keepdims=True), 1)
    upper = jnp.maximum(upper, lower)
    total = jnp.sum(upper, -1, keepdims=True)
    short = (total > 0) & (total < 1)
    return lower, jnp.minimum(jnp.where(short, upper / jnp.where(short, total, 1), upper), 1)
