"""Vectorised evaluation of many polynomials and rational functions of parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

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
    most = max((power for powers in number for power in powers), default=1)
    return Polynomials(
        table,
        np.asarray(owner, np.int32),
        np.asarray(monomial, np.int32),
        np.asarray(coefficient, np.float64),
        len(polynomials),
        max(most.bit_length() - 1, 0),
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
