"""Certificates of values: MacQueen's bounds, the M-matrix bound, and rounding errors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp

from jaxltl.core.models.protocols import ActionModel, Model, SuccessorModel
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import Solution, Status


def rounding_unit(model: Model) -> jax.Array | float:
    """Rounding error of one backup, relative to the magnitude of its terms."""
    # A backup adds at most K products and takes a maximum or a mean over A actions. The sum of a
    # row may miss 1 by a rounding for each entry, since a model means its normalised rows.
    terms = widest_row(model) + most_choices(model) + 4
    return terms * float(jnp.finfo(model.dtype).eps)


def underflow(model: Model) -> jax.Array | float:
    """Absolute error of one backup by products that underflow, where XLA flushes them to zero."""
    return (widest_row(model) + most_choices(model) + 4) * float(jnp.finfo(model.dtype).tiny)


def most_choices(model: Model) -> jax.Array | int:
    """Maximal number of choices of a state: static, for a sparse model ``int32[]``."""
    world = getattr(model, "mdp", model)
    if isinstance(world, SparseMDP):
        return jnp.max(jnp.diff(jnp.asarray(world.row_start)))
    return cast(ActionModel, model).num_actions


def widest_row(model: Model) -> jax.Array | int:
    """Maximal number of successors of a choice: static, for a sparse model ``int32[]``."""
    world = getattr(model, "mdp", model)
    if isinstance(world, SparseMDP):
        return jnp.max(jnp.diff(jnp.asarray(world.entry_start)))
    return cast(SuccessorModel, model).num_successors


def backup_error(unit: jax.Array | float, *sizes: jax.Array) -> jax.Array:
    """Absolute error of one backup: rounding relative to the magnitudes, and underflow."""
    # XLA flushes results below the least normal number to zero. A backup has ``unit / epsilon``
    # roundings, each of which may flush a product and a sum, hence the least magnitude ``2 tiny /
    # epsilon``.
    info = jnp.finfo(jnp.asarray(sizes[0]).dtype)
    return unit * (sum(sizes[1:], sizes[0]) + 2 * float(info.tiny) / float(info.eps))


Operator = Callable[[jax.Array], jax.Array]


class Enclosure(NamedTuple):
    """An enclosure relative to an image; a field may have a last axis of lanes."""

    shift: jax.Array  # the middle of the enclosure minus the image
    half: jax.Array  # half of the width; infinite without a certificate
    converged: jax.Array  # whether the width is at most the tolerance
    # whether the width is mostly rounding, so that further sweeps would not help
    exhausted: jax.Array
    finite: jax.Array  # whether there is a certificate

    @property
    def ended(self) -> jax.Array:
        """True if further sweeps would not help."""
        return self.converged | self.exhausted | ~self.finite


def enclose(
    value: jax.Array,
    image: jax.Array,
    discount: jax.Array,
    rounding: jax.Array,
    tolerance: jax.Array | None,
) -> Enclosure:
    """MacQueen's (1966) bounds on the fixed point of a monotone T with ``T(v + c) = T(v) + g c``."""
    # ``T v + g / (1 - g) * [min, max](T v - v)`` for the discount g.
    change = image - value
    gap = jnp.where(discount < 1, 1 - discount, jnp.nan)
    rounding = rounding / gap
    down = discount / gap * jnp.min(change, axis=0) - rounding
    up = discount / gap * jnp.max(change, axis=0) + rounding
    return judged(down, up, rounding, tolerance)


def judged(
    down: jax.Array, up: jax.Array, rounding: jax.Array, tolerance: jax.Array | None
) -> Enclosure:
    """The enclosure between two ends, relative to the image; `rounding` is included in both."""
    # A quarter of `rounding` on each side pays for rounding in ``middle - half`` and ``middle +
    # half``, so that the width is at most the tolerance as computed.
    half = (up - down) / 2
    finite = jnp.isfinite(half)
    goal = 4 * rounding if tolerance is None else tolerance / 2 - rounding / 4
    return Enclosure(
        shift=jnp.where(finite, (up + down) / 2, 0),
        half=jnp.where(finite, half, jnp.inf),
        converged=finite & (half <= goal),
        exhausted=finite & (half <= 2 * rounding),
        finite=finite,
    )


def m_matrix_error(
    model: ActionModel,
    solve: Operator,
    onward: Operator,
    start: jax.Array,
    one: jax.Array,
    undecided: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A solution of ``y = one + P y`` from its approximation, its certified error and residual."""
    # If e >= 0 satisfies ``e - P e >= |r|`` there, where r is the residual of y and decided states
    # are absorbing, then ``|y - y*| <= e``, because ``I - P`` is an M-matrix. A second solve gives
    # e, and a check of the inequality, rounding included, proves it.
    value = jnp.where(undecided, start, one)
    # Elimination can break down where rounding closes a set that is hardly ever left.
    value = jnp.clip(jnp.where(jnp.isfinite(value), value, 0), 0, 1)
    unit = rounding_unit(model)
    residual = jnp.where(undecided, jnp.abs(onward(value) - value), 0)
    claim = jnp.where(undecided, 2 * residual + 4 * unit * (value + 1e-3), 0)
    error = solve(claim)
    enough = error - onward(error) >= residual + unit * (value + error)
    proven = jnp.all(jnp.where(undecided, enough, True) & (error >= 0))
    error = jnp.where(undecided, jnp.where(proven, error, 1), 0)
    return value, error, jnp.max(residual)


def refuse(
    solution: Solution, policy: jax.Array, valid: jax.Array, representable: jax.Array
) -> Solution:
    """The solution, without value and bounds if the policy or the model is invalid."""
    # `policy` is the argument of the solver, NaN at unavailable actions. The status is
    # INVALID_POLICY, or INVALID for a model with probabilities that are not representable.
    code = jnp.where(representable, Status.INVALID_POLICY, Status.INVALID)
    valid = valid & representable

    def where(good: jax.Array, bad: float) -> jax.Array:
        return jnp.where(valid, good, jnp.asarray(bad, good.dtype))

    return replace(
        solution,
        value=where(solution.value, jnp.nan),
        policy=jnp.where(valid, solution.policy, policy),
        lower=where(solution.lower, -jnp.inf),
        upper=where(solution.upper, jnp.inf),
        residual=where(solution.residual, jnp.nan),
        status=jnp.where(valid, solution.status, code).astype(jnp.int32),
    )
