"""Policy updates of TRPO and CPO: direction from the dual in closed form, and line search."""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.scipy.sparse.linalg import cg

from jaxltl.algos.trust_region._policy_networks import kl_divergence, log_density, positive
from jaxltl.algos.trust_region.state import Hparams
from jaxltl.core.array_types import Numeric, PyTree


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


def cpo_dual(q: Numeric, r: Numeric, s: Numeric, c: Numeric, delta: Numeric) -> Dual:
    """Multipliers ``(lambda, nu)`` of ``max g.x`` where ``c + b.x <= 0``, ``x.Hx / 2 <= delta``.

    The dual is ``max over lambda, nu >= 0`` of (Achiam et al. 2017, equation 12, with half its delta)::

        -(q - 2 r nu + s nu^2) / (2 lambda) + nu c - lambda delta,

    and the solution ``x = H^-1 (g - nu b) / lambda``. As the dual is concave, one test replaces the
    paper's two cases: the limit is active if and only if the best step without it breaks it. Where
    the limit cannot be kept in the trust region the dual is unbounded, and the multipliers are those
    of the paper's recovery, ``max -b.x``: ``x = -H^-1 b / lambda``, nu = 1.
    """
    q, r, s, c, delta = _floats(q, r, s, c, delta)
    room, rest, _ = _plane(q, r, s, c, delta)
    case = _case(q, r, s, c, delta)
    on_limit = jnp.sqrt(ratio(rest, room))
    zero = jnp.zeros_like(on_limit)
    # Chosen at once, as in `cpo_weights`.
    active = jnp.stack([on_limit, ratio(jnp.maximum(on_limit * c + r, 0), s)])
    free = jnp.stack([jnp.sqrt(q / (2 * delta)), zero])
    recovery = jnp.stack([jnp.sqrt(s / (2 * delta)), zero + 1])
    chosen = jnp.where(case == Case.ACTIVE, active, free)
    trust, cost = jnp.where(case == Case.RECOVERY, recovery, chosen)
    return Dual(trust=trust, cost=cost, case=case)


def cpo_weights(
    q: Numeric, r: Numeric, s: Numeric, c: Numeric, delta: Numeric
) -> tuple[jax.Array, jax.Array]:
    """``(u, w)`` of the step ``x = u H^-1 g + w H^-1 b`` that belongs to :func:`cpo_dual`.

    They are ``1 / lambda`` and ``-nu / lambda``, also where `g` and `b` are parallel and lambda
    is 0: then the step to the limit itself, ``w = -c / s``. Arguments as there.
    """
    q, r, s, c, delta = _floats(q, r, s, c, delta)
    room, rest, _ = _plane(q, r, s, c, delta)
    case = _case(q, r, s, c, delta)
    # The step to the limit, and on along the limit to the edge of the trust region.
    along = jnp.sqrt(ratio(jnp.maximum(room, 0), rest))
    zero = jnp.zeros_like(along)
    # Both numbers are chosen at once: for two choices the compiler may work out the case twice and
    # round in two ways, and a step that is half of one case and half of another is too long.
    active = jnp.stack([along, -ratio(along * r + c, s)])
    free = jnp.stack([jnp.sqrt(ratio(2 * delta, q)), zero])
    recovery = jnp.stack([zero, -jnp.sqrt(ratio(2 * delta, s))])
    chosen = jnp.where(case == Case.ACTIVE, active, free)
    reward, cost = jnp.where(case == Case.RECOVERY, recovery, chosen)
    return reward, cost


def _floats(*numbers: Numeric) -> tuple[jax.Array, ...]:
    plain = [] if any(isinstance(x, jax.Array) for x in numbers) else [float]
    return tuple(jnp.asarray(x, jnp.result_type(*plain, *numbers)) for x in numbers)


def ratio(x: jax.Array, y: jax.Array) -> jax.Array:
    """Zero where `y` is not positive."""
    return jnp.where(y > 0, x / jnp.where(y > 0, y, 1), 0)


def _plane(
    q: jax.Array, r: jax.Array, s: jax.Array, c: jax.Array, delta: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Squared H-lengths of the trust region on the limit and of H^-1 g on it; distance to the limit."""
    distance = jnp.where(
        s > 0, c / jnp.sqrt(jnp.where(s > 0, s, 1)), jnp.where(c == 0, 0, jnp.sign(c) * jnp.inf)
    )
    rest = q - ratio(r, jnp.sqrt(s)) ** 2
    # What rounding leaves of parallel gradients has no direction.
    rest = jnp.where(rest > 16 * jnp.finfo(q.dtype).eps * q, rest, 0)
    return 2 * delta - distance**2, rest, distance


def _case(q: jax.Array, r: jax.Array, s: jax.Array, c: jax.Array, delta: jax.Array) -> jax.Array:
    room, rest, _ = _plane(q, r, s, c, delta)
    # Opposite gradients never break a limit that can be kept; their sum may, by rounding.
    breaks = (c + r * jnp.sqrt(ratio(2 * delta, q)) > 0) & ~((rest == 0) & (r < 0))
    inside = jnp.where(breaks, Case.ACTIVE, Case.INACTIVE)
    return jnp.where(room > 0, inside, jnp.where(c > 0, Case.RECOVERY, Case.FREE)).astype(jnp.int32)


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
    return gains, jnp.where(valid, kl_divergence(old, new), 0).sum() / jnp.maximum(valid.sum(), 1)


def direction(
    surrogate_of: Callable[[jax.Array], Surrogate],
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
        natural, times_fisher = solved(jax.grad(lambda x: surrogate_of(x).reward)(flat))
        q = natural @ times_fisher
        dual = Dual(jnp.sqrt(q / (2 * delta)), jnp.zeros((), flat.dtype), jnp.int32(Case.FREE))
        return natural * jnp.sqrt(ratio(2 * delta, q)), dual
    gradients = jax.jacrev(lambda x: jnp.stack(surrogate_of(x)[:2]))(flat)
    natural, times_fisher = jax.vmap(solved)(gradients)
    # With H x for the gradients that conjugate gradients did not quite solve for, the step's
    # divergence is as promised.
    gram = natural @ times_fisher.T
    numbers = (gram[0, 0], (gram[0, 1] + gram[1, 0]) / 2, gram[1, 1], excess, delta)
    reward, cost = cpo_weights(*numbers)
    return reward * natural[0] + cost * natural[1], cpo_dual(*numbers)


def line_search(
    surrogate_of: Callable[[jax.Array], Surrogate],
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
        return found & jnp.where(excess > 0, after.cost < 0, after.cost <= -excess)

    def search(carry: PyTree) -> PyTree:
        count, scale, _, _ = carry
        scale = jnp.where(count == 0, jnp.ones_like(scale), scale * ratio)
        after = surrogate_of(flat + scale * change)
        return count + 1, scale, after, good(after)

    def searching(carry: PyTree) -> jax.Array:
        return (carry[0] < hparams.search_steps) & ~carry[3]

    zero = jnp.zeros((), flat.dtype)
    _, scale, after, found = lax.while_loop(
        searching, search, (jnp.int32(0), zero, Surrogate(zero, zero, zero), jnp.bool_(False))
    )
    return jnp.where(found, scale, 0), jax.tree.map(lambda x: jnp.where(found, x, 0), after)
