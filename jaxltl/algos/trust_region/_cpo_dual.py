"""CPO's linear-quadratic problem in closed form: multipliers and weights."""

from __future__ import annotations

import enum
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp


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


def cpo_dual(
    q: chex.Numeric, r: chex.Numeric, s: chex.Numeric, c: chex.Numeric, delta: chex.Numeric
) -> Dual:
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
    q: chex.Numeric, r: chex.Numeric, s: chex.Numeric, c: chex.Numeric, delta: chex.Numeric
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


def _floats(*numbers: chex.Numeric) -> tuple[jax.Array, ...]:
    plain = [] if any(isinstance(x, jax.Array) for x in numbers) else [float]
    dtype = jnp.result_type(*plain, *numbers)
    return tuple(jnp.asarray(x, dtype) for x in numbers)


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
    opposite = (rest == 0) & (r < 0)
    breaks = (c + r * jnp.sqrt(ratio(2 * delta, q)) > 0) & ~opposite
    inside = jnp.where(breaks, Case.ACTIVE, Case.INACTIVE)
    outside = jnp.where(c > 0, Case.RECOVERY, Case.FREE)
    return jnp.where(room > 0, inside, outside).astype(jnp.int32)
