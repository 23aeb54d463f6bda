"""Polynomials and rational functions of parameters: vectorised evaluation, and ranges over boxes.

Multiaffine polynomials attain extrema at corners of the box, which are enumerated; others are
bounded term by term, with rounding errors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import struct
from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import brief


Terms = Mapping[tuple[int, ...], Fraction]  # the coefficient of each monomial, by its powers


@brief
@struct.dataclass
class Polynomials:
    """Polynomials, evaluated together."""

    factor: Array  # int32[M, W]; 0: one; 1 + k D + d: the power 2^k of parameter d
    owner: Array  # int32[C], the polynomial of each term, ascending
    monomial: Array  # int32[C]
    coefficient: Array  # float[C]
    count: int = struct.field(pytree_node=False)  # of polynomials
    squares: int = struct.field(pytree_node=False)  # the most repeated squarings

    def __call__(self, x: jax.Array) -> jax.Array:
        """Values at ``float[D]``, ``float[count]``; differentiable."""
        powers = [jnp.ones(1, x.dtype), x]
        for _ in range(self.squares):
            powers.append(powers[-1] * powers[-1])
        table = jnp.concatenate(powers)
        factors = [
            table.at[self.factor[:, w]].get(mode="promise_in_bounds")
            for w in range(self.factor.shape[1])
        ]
        product = jnp.ones(self.factor.shape[0], x.dtype)
        for factor in factors:
            product = product * factor
        terms = jnp.asarray(self.coefficient, x.dtype) * product[self.monomial]
        return jax.ops.segment_sum(terms, self.owner, self.count, indices_are_sorted=True)


def make_polynomials(polynomials: Sequence[Terms], num_parameters: int) -> Polynomials:
    """Polynomials from exact coefficients by the powers of the D parameters; each is rounded once."""
    number: dict[tuple[int, ...], int] = {}
    owner, monomial, coefficient = [], [], []
    for i, terms in enumerate(polynomials):
        for powers, c in terms.items():
            owner.append(i)
            monomial.append(number.setdefault(powers, len(number)))
            coefficient.append(float(c))
    factors = [
        [
            1 + k * num_parameters + d
            for d, power in enumerate(powers)
            if power
            for k in range(power.bit_length())
            if power >> k & 1
        ]
        for powers in number
    ]
    width = max(map(len, factors), default=0)
    table = np.zeros((len(factors), width), np.int32)
    for row, places in zip(table, factors, strict=True):
        row[: len(places)] = places
    degree = max((power for powers in number for power in powers), default=1)
    return Polynomials(
        table,
        np.asarray(owner, np.int32),
        np.asarray(monomial, np.int32),
        np.asarray(coefficient, np.float64),
        len(polynomials),
        max(degree.bit_length() - 1, 0),
    )


@brief
@struct.dataclass
class Rationals:
    """Quotients of polynomials; no denominator if all are constants."""

    numerator: Polynomials
    denominator: Polynomials | None

    def __call__(self, x: jax.Array) -> jax.Array:
        """Values at ``float[D]``, ``float[F]``; infinite or NaN at poles."""
        value = self.numerator(x)
        return value if self.denominator is None else value / self.denominator(x)


def make_rationals(functions: Sequence[tuple[Terms, Terms]], num_parameters: int) -> Rationals:
    """Rational functions from pairs of numerator and nonzero denominator."""
    one = (0,) * num_parameters
    constant = [set(below) == {one} for _, below in functions]
    above = [
        {powers: c / below[one] for powers, c in terms.items()} if known else terms
        for (terms, below), known in zip(functions, constant, strict=True)
    ]
    if all(constant):
        return Rationals(make_polynomials(above, num_parameters), None)
    under = [
        {one: Fraction(1)} if known else below
        for (_, below), known in zip(functions, constant, strict=True)
    ]
    return Rationals(
        make_polynomials(above, num_parameters), make_polynomials(under, num_parameters)
    )


_EPS = float(np.finfo(np.float64).eps)
_MOST = 10  # parameters of a polynomial up to which its 2^n corners are enumerated


class Ends(NamedTuple):
    """Bounds ``float64[F]`` on the values of functions."""

    lower: np.ndarray
    upper: np.ndarray


def ranges(functions: Rationals, low: np.ndarray, high: np.ndarray) -> Ends:
    """Bounds on F rational functions over a box ``low <= x <= high`` of nonnegative parameters."""
    if not (low >= 0).all():
        d = int(np.flatnonzero(~(low >= 0))[0])
        raise ValueError(
            f"the box reaches down to {low[d]:.6g} in parameter {d}; ranges are found "
            "for parameters of at least 0."
        )
    above = _ranges(functions.numerator, low, high)
    if functions.denominator is None:
        return above
    below = _ranges(functions.denominator, low, high)
    if ((below.lower <= 0) & (below.upper >= 0)).any():
        raise ValueError("a denominator may be 0 in the box; take a smaller one.")
    quotients = np.stack([x / y for x in above for y in below])
    lower, upper = quotients.min(0), quotients.max(0)
    return Ends(lower - _EPS * np.abs(lower), upper + _EPS * np.abs(upper))


def _ranges(of: Polynomials, low: np.ndarray, high: np.ndarray) -> Ends:
    powers = _powers(of, low.size)
    owner, monomial = np.asarray(of.owner), np.asarray(of.monomial)
    coefficient = np.asarray(of.coefficient, np.float64)
    ends = np.stack([low, high])
    # Term by term: monomials of nonnegative parameters are monotone.
    least, greatest = (np.prod(x**powers, axis=1)[monomial] for x in ends)
    small = np.where(coefficient > 0, coefficient * least, coefficient * greatest)
    large = np.where(coefficient > 0, coefficient * greatest, coefficient * least)
    lower, upper = (np.bincount(owner, x, of.count) for x in (small, large))
    size = np.bincount(owner, np.abs(coefficient) * greatest, of.count)
    terms = np.bincount(owner, minlength=of.count)
    used = np.zeros((of.count, low.size), bool)
    np.logical_or.at(used, owner, powers[monomial] > 0)
    linear = np.ones(of.count, bool)
    np.logical_and.at(linear, owner, np.all(powers <= 1, axis=1)[monomial])
    number = used.sum(1)
    for n in np.unique(number[linear & (terms > 1) & (number <= _MOST)]):
        some = np.flatnonzero(linear & (terms > 1) & (number == n))
        extremes = _corners(some, n, used, _Terms(owner, powers[monomial], coefficient), ends)
        lower[some], upper[some] = (
            np.maximum(lower[some], extremes[0]),
            np.minimum(upper[some], extremes[1]),
        )
    # Powers, products, the sum and the coefficient are rounded.
    slack = (2 * powers.max(initial=0) + 2 * low.size + terms + 4) * _EPS * size
    return Ends(lower - slack, upper + slack)


def _powers(of: Polynomials, num_parameters: int) -> np.ndarray:
    """The power of each parameter in each monomial, ``int[M, D]``."""
    factor = np.asarray(of.factor)
    power_table = np.zeros((factor.shape[0], num_parameters), np.int64)
    m, w = np.nonzero(factor)
    square, d = np.divmod(factor[m, w] - 1, num_parameters)
    np.add.at(power_table, (m, d), 1 << square)
    return power_table


class _Terms(NamedTuple):
    owner: np.ndarray
    powers: np.ndarray
    coefficient: np.ndarray


def _corners(
    some: np.ndarray, n: int, used: np.ndarray, terms: _Terms, ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Extrema at the corners, of polynomials in n parameters each."""
    owner, powers, coefficient = terms
    place = np.full(used.shape[0], -1)
    place[some] = np.arange(some.size)
    parameter = np.nonzero(used[some])[1].reshape(some.size, n)
    term = np.flatnonzero(place[owner] >= 0)
    of = place[owner[term]]
    rank = np.take_along_axis(powers[term], parameter[of], 1)
    value = np.zeros((some.size, *(2,) * n))
    np.add.at(value, (of, *rank.T), coefficient[term])
    for i in range(n):
        # The coefficients of 1 and x become the values at both ends of x.
        constant, slope = np.moveaxis(value, i + 1, 0)
        x = ends[:, parameter[:, i]].reshape(2, some.size, *(1,) * (n - 1))
        value = np.moveaxis(constant + slope * x, 0, i + 1)
    flat = value.reshape(some.size, -1)
    return flat.min(1), flat.max(1)
