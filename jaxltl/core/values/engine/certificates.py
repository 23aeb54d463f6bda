"""Certificates of values: MacQueen's bounds, the M-matrix bound, and rounding errors."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops import double_word as dw
from jaxltl.core.models.ops.operators import CheckedPolicy
from jaxltl.core.models.protocols import ActionModel, Model, SuccessorModel
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.engine.linear import Operator
from jaxltl.core.values.engine.validated import invalidated


def rounding_unit(model: Model) -> jax.Array | float:
    """Rounding error of one backup, relative to the magnitude of its terms."""
    # A backup adds at most K products and takes a maximum or a mean over A actions. The sum of a
    # row may miss 1 by a rounding for each entry, since a model means its normalised rows.
    return _terms(model) * float(jnp.finfo(model.dtype).eps)


def underflow(model: Model) -> jax.Array | float:
    """Absolute error of one backup by products that underflow, where XLA flushes them to zero."""
    return _terms(model) * float(jnp.finfo(model.dtype).tiny)


def most_choices(model: Model) -> jax.Array | int:
    """Maximal number of choices of a state: static, for a sparse model ``int32[]``."""
    world = getattr(model, "mdp", model)
    if isinstance(world, SparseMDP):
        return jnp.max(jnp.diff(jnp.asarray(world.row_start)))
    return cast(ActionModel, model).num_actions


def _terms(model: Model) -> jax.Array | int:
    """Maximal number of terms and choices of a backup."""
    world = getattr(model, "mdp", model)
    if isinstance(world, SparseMDP):
        widest: jax.Array | int = jnp.max(jnp.diff(jnp.asarray(world.entry_start)))
    else:
        widest = cast(SuccessorModel, model).num_successors
    return widest + most_choices(model) + 4


def backup_error(unit: jax.Array | float, *sizes: jax.Array) -> jax.Array:
    """Absolute error of one backup: rounding relative to the magnitudes, and underflow."""
    # XLA flushes results below the least normal number to zero. A backup has ``unit / epsilon``
    # roundings, each of which may flush a product and a sum, hence the least magnitude ``2 tiny /
    # epsilon``.
    info = jnp.finfo(jnp.asarray(sizes[0]).dtype)
    return unit * (sum(sizes[1:], sizes[0]) + 2 * float(info.tiny) / float(info.eps))


Carry = tuple[jax.Array, jax.Array, jax.Array, jax.Array]
Pair = tuple[jax.Array, jax.Array]  # a double word, and a residual


class RelativeEnclosure(NamedTuple):
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
    low: jax.Array | float = 0,
) -> RelativeEnclosure:
    """MacQueen's (1966) bounds on the fixed point of a monotone T with ``T(v + c) = T(v) + g c``."""
    # ``T v + g / (1 - g) * [min, max](T v - v)`` for the discount g, and its low word.
    change = image - value
    gap = jnp.where(discount < 1, (1 - discount) - low, jnp.nan)
    rounding = rounding / gap
    down = discount / gap * jnp.min(change, axis=0) - rounding
    up = discount / gap * jnp.max(change, axis=0) + rounding
    return make_enclosure(down, up, rounding, tolerance)


def make_enclosure(
    down: jax.Array, up: jax.Array, rounding: jax.Array, tolerance: jax.Array | None
) -> RelativeEnclosure:
    """The enclosure between two ends, relative to the image; `rounding` is included in both."""
    # A quarter of `rounding` on each side pays for rounding in ``middle - half`` and ``middle +
    # half``, so that the width is at most the tolerance as computed.
    half = (up - down) / 2
    finite = jnp.isfinite(half)
    goal = 4 * rounding if tolerance is None else tolerance / 2 - rounding / 4
    return RelativeEnclosure(
        shift=jnp.where(finite, (up + down) / 2, 0),
        half=jnp.where(finite, half, jnp.inf),
        converged=finite & (half <= goal),
        exhausted=finite & (half <= 2 * rounding),
        finite=finite,
    )


_REFINEMENTS = 9  # of an approximate solution; each multiplies its error by that of the solver


def m_matrix_error(
    rows: dw.DoubleWordRows, solve: Operator, start: jax.Array, one: jax.Array, undecided: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Bounds on the solution of ``y = one + P y`` from its approximation, its value and residual."""
    # If e >= 0 satisfies ``e - P e >= |r|`` there, where r is the residual of y and decided states
    # are absorbing, then ``|y - y*| <= e``, because ``I - P`` is an M-matrix. A second solve gives
    # e, and a check of the inequality, rounding included, proves it. All are refined by residuals in
    # double words.

    def refined(y: jax.Array, constant: jax.Array, enough: jax.Array) -> Pair:
        """y, and ``constant + P y - y`` of at most `enough`, if the solver converges."""

        def step(carry: Carry) -> Carry:
            best, least, y, n = carry
            image = dw.plus(rows.mean(rows.expectation(y)), dw.double_word(constant))
            rest = jnp.where(undecided, dw.minus(image, y), 0)
            better = jnp.max(jnp.abs(rest)) < jnp.max(jnp.abs(least)) / 2  # false for NaN
            best, least = (jnp.where(better, *x) for x in ((y, best), (rest, least)))
            ended = ~better | jnp.all(jnp.abs(rest) <= enough)
            correction = solve(jnp.where(ended, 0, rest))
            correction = jnp.where(undecided & jnp.isfinite(correction), correction, 0)
            y = dw.plus(y, dw.double_word(correction))
            return best, least, y, jnp.where(ended, _REFINEMENTS, n + 1)

        never = jnp.full_like(one, jnp.inf)
        start = y, never, y, jnp.int32(0)
        return lax.while_loop(lambda k: k[3] < _REFINEMENTS, step, start)[:2]

    value = jnp.where(undecided, start, one)
    # Elimination can break down where rounding closes a set that is hardly ever left.
    value = jnp.clip(jnp.where(jnp.isfinite(value), value, 0), 0, 1)
    zero = jnp.zeros_like(one)
    unit, least = rows.unit, rows.underflow(jnp.ones_like(one))
    approximation, value = value, lax.stop_gradient(value)

    def claimed(exact: jax.Array, residual: jax.Array) -> jax.Array:
        size = jnp.abs(dw.words(exact)[0])
        claim = 2 * jnp.abs(residual) + 4 * unit * (size + 1e-3) + 4 * least
        return jnp.where(undecided, claim, 0)

    def refine(last: jax.Array, pairs: tuple[Pair, Pair]) -> tuple[Pair, Pair]:
        """The value and its residual, then its error and the residual of that."""
        claim = claimed(*pairs[1])
        y = jnp.where(last, 0, dw.double_word(value))
        enough = jnp.where(last, claim, max(unit, 1e-20)) / 4
        return pairs[1], refined(y, jnp.where(last, claim, 0), enough)

    # One loop, so that the program has each operation once.
    none = dw.double_word(zero), zero
    (exact, residual), (error, rest) = lax.fori_loop(0, 2, refine, (none, none))
    claim, residual = claimed(exact, residual), jnp.abs(residual)
    size, half = jnp.abs(dw.words(exact)[0]), dw.words(error)[0]
    enough = claim - rest >= residual + unit * (size + half) + least * (1 + half)
    proven = jnp.all(jnp.where(undecided, enough, True) & (half >= 0))
    lower, upper = dw.outwards(dw.plus(exact, -error), -1), dw.outwards(dw.plus(exact, error), 1)
    lower = jnp.where(proven, jnp.maximum(lower, 0), 0)
    # XLA flushes subnormal numbers to zero.
    upper = jnp.where(proven, jnp.clip(upper, jnp.finfo(one.dtype).tiny, 1), 1)
    lower, upper = (jnp.where(undecided, x, one) for x in (lower, upper))
    # The derivative is that of the approximation.
    value = approximation + lax.stop_gradient(
        jnp.clip(dw.words(exact)[0], lower, upper) - approximation
    )
    return value, lower, upper, jnp.max(residual)


def refuse(solution: Solution, checked: CheckedPolicy | None) -> Solution:
    """The solution, without value and bounds if the given policy or the model is invalid."""
    # The status is INVALID_POLICY, or INVALID for a model with probabilities that are not
    # representable.
    if checked is None:
        return solution
    code = jnp.where(checked.representable, Status.INVALID_POLICY, Status.INVALID)
    valid = checked.valid & checked.representable

    policy = jnp.where(valid, solution.policy, checked.masked)
    reason = jnp.where(valid, Status.CONVERGED, code)
    result: Solution = invalidated(replace(solution, policy=policy), reason)
    return result
