"""Policy updates of TRPO and CPO: direction from the dual in closed form, and line search."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import cg

from jaxltl.algos.trust_region.policies import Hparams
from jaxltl.core.array_types import Numeric, PyTree

# Of a policy's parameters: gains of reward and cost, float[V], and the divergence.
Surrogate = Callable[[jax.Array], tuple[jax.Array, jax.Array]]


class Case(enum.IntEnum):
    """The part of the constrained problem that determines a step."""

    FREE = 0  # the whole trust region keeps to the limit (always so for TRPO)
    INACTIVE = 1  # the best step of the trust region keeps to the limit (the paper's case b)
    ACTIVE = 2  # the best step ends on the limit (the paper's case a)
    RECOVERY = 3  # the whole trust region violates the limit: lower the cost alone


class Dual(NamedTuple):
    """Multipliers of the trust region and of the limit, and the :class:`Case`."""

    trust: jax.Array
    cost: jax.Array
    case: jax.Array


def cpo_step(
    q: Numeric, r: Numeric, s: Numeric, c: Numeric, delta: Numeric
) -> tuple[Dual, jax.Array]:
    """The solution of ``max g.x`` where ``c + b.x <= 0``, ``x.Hx / 2 <= delta``: multipliers, (u, w).

    The dual is ``max over lambda, nu >= 0`` of (Achiam et al. 2017, equation 12, with half its delta)::

        -(q - 2 r nu + s nu^2) / (2 lambda) + nu c - lambda delta,

    and the step ``x = u H^-1 g + w H^-1 b`` has ``u = 1 / lambda`` and ``w = -nu / lambda``, also where
    `g` and `b` are parallel and lambda is 0: then it is the step to the limit itself, ``w = -c / s``.
    As the dual is concave, one test replaces the paper's two cases: the limit is active if and only
    if the best step without it breaks it. Where the limit cannot be kept in the trust region the dual
    is unbounded, and the multipliers are those of the paper's recovery, ``max -b.x``: nu = 1.
    """
    plain = [] if any(isinstance(x, jax.Array) for x in (q, r, s, c, delta)) else [float]
    dtype = jnp.result_type(*plain, q, r, s, c, delta)
    q, r, s, c, delta = (jnp.asarray(x, dtype) for x in (q, r, s, c, delta))
    # Squared H-lengths of the trust region on the limit, and of H^-1 g on it.
    no_slope = jnp.where(c == 0, 0, jnp.sign(c) * jnp.inf)
    distance = jnp.where(s > 0, c / jnp.sqrt(positive(s)), no_slope)
    room, rest = 2 * delta - distance**2, q - ratio(r, jnp.sqrt(s)) ** 2
    # What rounding leaves of parallel gradients has no direction.
    rest = jnp.where(rest > 16 * jnp.finfo(q.dtype).eps * q, rest, 0)
    # Opposite gradients never break a limit that can be kept; their sum may, by rounding.
    breaks = (c + r * jnp.sqrt(ratio(2 * delta, q)) > 0) & ~((rest == 0) & (r < 0))
    inside = jnp.where(breaks, Case.ACTIVE, Case.INACTIVE)
    case = jnp.where(room > 0, inside, jnp.where(c > 0, Case.RECOVERY, Case.FREE))
    on_limit = jnp.sqrt(ratio(rest, room))
    # The step to the limit, and on along the limit to the edge of the trust region.
    along = jnp.sqrt(ratio(jnp.maximum(room, 0), rest))
    nu = ratio(jnp.maximum(on_limit * c + r, 0), s)
    zero, one = jnp.zeros_like(along), jnp.ones_like(along)
    # All numbers are chosen at once: for several choices the compiler may work out the case twice and
    # round in two ways, and a step that is half of one case and half of another is too long.
    active = jnp.stack([on_limit, nu, along, -ratio(along * r + c, s)])
    free = jnp.stack([jnp.sqrt(q / (2 * delta)), zero, jnp.sqrt(ratio(2 * delta, q)), zero])
    recovery = jnp.stack([jnp.sqrt(s / (2 * delta)), one, zero, -jnp.sqrt(ratio(2 * delta, s))])
    chosen = jnp.where(case == Case.ACTIVE, active, free)
    chosen = jnp.where(case == Case.RECOVERY, recovery, chosen)
    return Dual(chosen[0], chosen[1], case.astype(jnp.int32)), chosen[2:]


def positive(x: jax.Array) -> jax.Array:
    """The number, or 1 where it is zero, for a division."""
    return jnp.where(x > 0, x, 1)


def ratio(x: jax.Array, y: jax.Array) -> jax.Array:
    """Zero where `y` is not positive."""
    return jnp.where(y > 0, x / positive(y), 0)


def fisher_product(
    divergence: Callable[[jax.Array], jax.Array], parameters: jax.Array
) -> Callable[[jax.Array], jax.Array]:
    """``v -> H v`` with H the Hessian of `divergence` at `parameters`, linearised once."""
    return jax.linearize(jax.grad(divergence), parameters)[1]


def log_density(action: jax.Array, mean: jax.Array, deviation: jax.Array) -> jax.Array:
    """Log density of a Gaussian with independent entries, up to a constant."""
    return -jnp.sum(((action - mean) / deviation) ** 2 / 2 + jnp.log(deviation), -1)


def kl_divergence(old: tuple[jax.Array, jax.Array], new: tuple[jax.Array, jax.Array]) -> jax.Array:
    """``KL(old || new)`` of Gaussians with independent entries."""
    (mean, deviation), (other, spread) = old, new
    ratio = deviation / spread
    return jnp.sum((ratio**2 + ((mean - other) / spread) ** 2 - 1) / 2 - jnp.log(ratio), -1)


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
    return gains, jnp.where(valid, kl_divergence(old, new), 0).sum() / jnp.maximum(valid.sum(), 1)


def direction(
    surrogate_of: Surrogate,
    product: Callable[[jax.Array], jax.Array],
    flat: jax.Array,
    excess: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, Dual]:
    """The solution of the linear-quadratic problem in the span of ``H^-1 g`` and ``H^-1 b``."""

    def damped(v: jax.Array) -> jax.Array:
        return product(v) + jnp.asarray(hparams.damping, flat.dtype) * v

    def solved(gradient: jax.Array) -> jax.Array:
        # Scaled to length 1, for tiny gradients would underflow when squared.
        length = jnp.sqrt(jnp.sum(gradient**2))
        found, _ = cg(damped, gradient / positive(length), tol=1e-10, maxiter=hparams.cg_steps)
        return found * length

    natural = jax.vmap(solved)(jax.jacrev(lambda x: surrogate_of(x)[0])(flat))
    # With H x for the gradients that conjugate gradients did not quite solve for, the step's
    # divergence is as promised.
    gram = natural @ jax.vmap(damped)(natural).T
    delta = jnp.asarray(hparams.delta, flat.dtype)
    limit: tuple[Numeric, Numeric, Numeric] = (0.0, 0.0, -1.0)  # that no step breaks
    if hparams.method == "cpo":
        limit = ((gram[0, 1] + gram[1, 0]) / 2, gram[1, 1], excess)
    dual, weights = cpo_step(gram[0, 0], *limit, delta)
    return weights[: len(natural)] @ natural, dual


def line_search(
    surrogate_of: Surrogate,
    flat: jax.Array,
    change: jax.Array,
    excess: jax.Array,
    hparams: Hparams,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The longest accepted step of a geometric sequence, its gains and divergence; zero if there is none.

    Accepted are a divergence of at most delta; a cost below the limit, or falling; and, unless the
    limit is exceeded, a higher reward. Comparisons with NaN are false.
    """
    backtrack, delta = (jnp.asarray(x, flat.dtype) for x in (hparams.backtrack, hparams.delta))

    def search(carry: PyTree) -> PyTree:
        count, scale, *_ = carry
        scale = jnp.where(count == 0, jnp.ones_like(scale), scale * backtrack)
        gains, kl = surrogate_of(flat + scale * change)
        good = (kl <= delta) & ((gains[0] > 0) | (excess > 0))
        if hparams.method == "cpo":
            good &= jnp.where(excess > 0, gains[1] < 0, gains[1] <= -excess)
        return count + 1, scale, gains, kl, good

    def searching(carry: PyTree) -> jax.Array:
        return (carry[0] < hparams.search_steps) & ~carry[-1]

    zero = jnp.zeros((), flat.dtype)
    gains = jnp.zeros(1 + (hparams.method == "cpo"), flat.dtype)
    _, *after, found = lax.while_loop(
        searching, search, (jnp.int32(0), zero, gains, zero, jnp.bool_(False))
    )
    scale, gains, kl = (jnp.where(found, x, 0) for x in after)
    return scale, gains, kl
