"""A trust-region step: its direction and the line search."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import cg

from jaxltl.algos.trust_region._cpo_dual import Case, Dual, cpo_dual, cpo_weights, ratio
from jaxltl.algos.trust_region._policy_networks import kl_divergence, log_density
from jaxltl.algos.trust_region._value_fit import positive
from jaxltl.algos.trust_region.state import Hparams
from jaxltl.core.models.protocols import PyTree


class Surrogate(NamedTuple):
    """Gains and divergence of a policy, estimated from trajectories of another."""

    reward: jax.Array
    cost: jax.Array
    kl: jax.Array


def fisher_product(divergence: Callable[[jax.Array], jax.Array], parameters: jax.Array):
    """``v -> H v`` with H the Hessian of `divergence` at `parameters`, linearised once."""
    return jax.linearize(jax.grad(divergence), parameters)[1]


def surrogate(
    new: tuple[jax.Array, jax.Array],
    old: tuple[jax.Array, jax.Array],
    action: jax.Array,
    weighted: jax.Array,
    valid: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Gains ``sum_i (pi(a_i) / old(a_i) - 1) A_i``, ``float[V]``, and the mean divergence."""
    log_ratio = log_density(action, *new) - log_density(action, *old)
    gains = weighted @ jnp.where(valid, jnp.expm1(log_ratio), 0)
    divergence = jnp.where(valid, kl_divergence(old, new), 0)
    return gains, divergence.sum() / jnp.maximum(valid.sum(), 1)


def direction(
    judged: Callable[[jax.Array], Surrogate],
    product: Callable[[jax.Array], jax.Array],
    flat: jax.Array,
    excess: jax.Array,
    delta: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, Dual]:
    """The solution of the linear-quadratic problem in the span of ``H^-1 g`` and ``H^-1 b``."""
    damping = jnp.asarray(hparams.damping, flat.dtype)

    def damped(v: jax.Array) -> jax.Array:
        return product(v) + damping * v

    def solved(gradient: jax.Array) -> tuple[jax.Array, jax.Array]:
        # Scaled to length 1, for tiny gradients would underflow when squared.
        length = jnp.sqrt(jnp.sum(gradient**2))
        found, _ = cg(damped, gradient / positive(length), tol=1e-10, maxiter=hparams.cg_steps)
        found = found * length
        return found, damped(found)

    if hparams.method == "trpo":
        natural, times_fisher = solved(jax.grad(lambda x: judged(x).reward)(flat))
        q = natural @ times_fisher
        zero = jnp.zeros((), flat.dtype)
        dual = Dual(jnp.sqrt(q / (2 * delta)), zero, jnp.int32(Case.FREE))
        return natural * jnp.sqrt(ratio(2 * delta, q)), dual
    gradients = jax.jacrev(lambda x: jnp.stack(judged(x)[:2]))(flat)
    natural, times_fisher = jax.vmap(solved)(gradients)
    # With H x for the gradients that conjugate gradients did not quite solve for, the step's
    # divergence is as promised.
    gram = natural @ times_fisher.T
    numbers = (gram[0, 0], (gram[0, 1] + gram[1, 0]) / 2, gram[1, 1], excess, delta)
    reward, cost = cpo_weights(*numbers)
    return reward * natural[0] + cost * natural[1], cpo_dual(*numbers)


def line_search(
    judged: Callable[[jax.Array], Surrogate],
    flat: jax.Array,
    change: jax.Array,
    excess: jax.Array,
    delta: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, Surrogate]:
    """The longest accepted step of a geometric sequence, and its effect; zero if none is accepted.

    Accepted are a divergence of at most delta; a cost below the limit, or falling; and, unless the
    limit is exceeded, a higher reward. Comparisons with NaN are false.
    """
    ratio = jnp.asarray(hparams.backtrack, flat.dtype)

    def good(after: Surrogate) -> jax.Array:
        found = (after.kl <= delta) & ((after.reward > 0) | (excess > 0))
        if hparams.method == "trpo":
            return found
        falls = jnp.where(excess > 0, after.cost < 0, after.cost <= -excess)
        return found & falls

    def search(carry: PyTree) -> PyTree:
        count, scale, _, _ = carry
        scale = jnp.where(count == 0, jnp.ones_like(scale), scale * ratio)
        after = judged(flat + scale * change)
        return count + 1, scale, after, good(after)

    def searching(carry: PyTree) -> jax.Array:
        return (carry[0] < hparams.search_steps) & ~carry[3]

    zero = jnp.zeros((), flat.dtype)
    nothing = Surrogate(zero, zero, zero)
    _, scale, after, found = lax.while_loop(
        searching, search, (jnp.int32(0), zero, nothing, jnp.bool_(False))
    )
    kept = jax.tree.map(lambda x: jnp.where(found, x, 0), after)
    return jnp.where(found, scale, 0), kept
