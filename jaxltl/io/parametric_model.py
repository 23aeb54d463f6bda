"""Parametric Markov models with exact rational functions, and their arithmetic."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, reduce
from hashlib import sha256
from operator import mul

import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct, validation
from numpy.typing import ArrayLike

from jaxltl.core.models.parametric import (
    Ends,
    ParametricMDP,
    Ranges,
    Rationals,
    box_of,
    make_rationals,
    point_inside,
    ranges,
)
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse
from jaxltl.core.pretty_print import brief
from jaxltl.core.array_types import Integers
from jaxltl.io.drn.body import Names

# Far above the needs of models; they prevent short texts from exhausting the memory.
_MAX_TERMS, MAX_POWER, _MAX_BITS = 10_000, 1_000, 20_000

# The coefficient of each monomial, which is the power of each parameter: 3 p q^2 is {(1, 2): 3}.
Polynomial = dict[tuple[int, ...], Fraction]
Term = tuple[Fraction, list[tuple[int, int]]]  # a coefficient, and parameters with their powers


@brief
@dataclass(frozen=True)
class RationalFunction:
    """Quotient of two polynomials in the parameters; ``at`` evaluates it exactly.

    Attributes:
      numerator, denominator: polynomials, as maps from exponents to exact coefficients.

    Example:
      >>> third = RationalFunction({(1,): Fraction(1)}, {(0,): Fraction(3)})  # p / 3
      >>> str(third.at((Fraction(1, 4),)))
      '1/12'
    """

    numerator: Polynomial
    denominator: Polynomial

    def at(self, point: tuple[Fraction, ...]) -> Fraction:
        """Exact value at a point; raises ZeroDivisionError at a pole."""
        above, below = (_value(factors, point) for factors in self._factors)
        return above / below

    @property
    def constant(self) -> Fraction | None:
        """The value of a constant function; None for another."""
        if any(map(any, (*self.numerator, *self.denominator))):
            return None
        return self.at(())

    def __add__(self, other: RationalFunction) -> RationalFunction:
        if self.denominator == other.denominator:
            return RationalFunction(_sum(self.numerator, other.numerator), self.denominator)
        return RationalFunction(
            _sum(
                _times(self.numerator, other.denominator), _times(other.numerator, self.denominator)
            ),
            _times(self.denominator, other.denominator),
        )

    def __neg__(self) -> RationalFunction:
        return RationalFunction({k: -c for k, c in self.numerator.items()}, self.denominator)

    def __sub__(self, other: RationalFunction) -> RationalFunction:
        return self + -other

    def __mul__(self, other: RationalFunction) -> RationalFunction:
        return RationalFunction(
            _times(self.numerator, other.numerator), _times(self.denominator, other.denominator)
        )

    def __truediv__(self, other: RationalFunction) -> RationalFunction:
        if not other.numerator:
            raise Malformed("divided by zero")
        above, below = other.denominator, other.numerator
        if len(below) == 1 and not any(next(iter(below))):  # by a number
            ((powers, number),) = below.items()
            above, below = {q: c / number for q, c in above.items()}, {powers: Fraction(1)}
        return self * RationalFunction(above, below)

    def __pow__(self, exponent: int) -> RationalFunction:
        terms = max(len(self.numerator), len(self.denominator))
        if (terms - 1) * abs(exponent) > MAX_POWER:
            raise Malformed("too large")
        one = {(0,) * len(next(iter(self.denominator))): Fraction(1)}
        result = reduce(mul, [self] * abs(exponent), RationalFunction(one, one))
        return result if exponent >= 0 else RationalFunction(one, one) / result

    @cached_property
    def _factors(self) -> tuple[list[Term], list[Term]]:
        """Terms of numerator and denominator, with nonzero exponents only."""
        above, below = (
            [(c, [(d, k) for d, k in enumerate(powers) if k]) for powers, c in of.items()]
            for of in (self.numerator, self.denominator)
        )
        return above, below


@brief
@dataclass(frozen=True)
class ParametricModel:
    """Markov chain or MDP with rational functions as probabilities and rewards.

    Same layout as :class:`~jaxltl.core.models.sparse.SparseMDP`, with the successors of a row in
    the order of the file.

    Attributes:
      parameters: names of the parameters.
      functions: distinct functions, the first of which is zero.
      row_start, entry_start, successor: transitions.
      probability: function index of each transition, ``int32[T]``.
      rewards: function indices on states, ``int32[S]``, and choices, ``int32[R]``, by name.
      names: labels, initial states and actions, as arguments of ``make_sparse``.

    Example:
      >>> import pathlib, tempfile
      >>> import jaxltl as jl
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "coin.prism"
      >>> _ = path.write_text("dtmc const double p; module coin x : [0..1]; "
      ...     "[] x=0 -> p : (x'=1) + 1-p : true; [] x=1 -> true; endmodule")
      >>> coin = jl.io.read_parametric(path)
      >>> [str(f.at((1,))) for f in coin.functions], coin.probability.tolist()
      (['0', '1', '1', '0'], [2, 3, 1])
    """

    parameters: tuple[str, ...]
    functions: tuple[RationalFunction, ...]
    row_start: Integers
    entry_start: Integers
    successor: Integers
    probability: Integers
    rewards: dict[str, tuple[Integers, Integers]]
    names: Names

    def at(self, values: Mapping[str, float | Fraction]) -> SparseMDP:
        """Instantiates the model at a point, in exact arithmetic rounded to doubles.

        Args:
          values: a finite number for each parameter.

        Raises:
          ValueError: for missing or unknown parameters, a pole, or rows that are no distributions.
        """
        if not isinstance(values, Mapping):
            raise ValueError(
                f"values is {validation.shorten(values)}; give a number for each name, in a dict."
            )
        if set(values) != set(self.parameters):
            raise ValueError(
                f"values are given for {', '.join(sorted(values)) or 'nothing'}; the "
                f"parameters are {', '.join(self.parameters) or 'none'}."
            )
        for name, x in values.items():
            validation.finite_number(f"values[{name!r}]", x)
        point = tuple(Fraction(values[name]) for name in self.parameters)
        try:
            value = np.array([float(f.at(point)) for f in self.functions])
        except (ZeroDivisionError, OverflowError):
            raise ValueError(f"a function has a pole at {dict(values)}, or is too large.") from None
        rewards = {
            name: Rewards(
                state=value[state] if state.any() else None,
                choice=value[choice] if choice.any() else None,
            )
            for name, (state, choice) in self.rewards.items()
        }
        return make_sparse(
            self.row_start,
            self.entry_start,
            self.successor,
            value[self.probability],
            rewards=rewards,
            **self.names,
        )

    def over(self, low: Ends, high: Ends) -> ParametricMDP:
        """Parametric MDP in JAX over a box of parameters in which no probability vanishes.

        Args:
          low, high: bounds, as one number, a number per name, or ``float[D]``.

        Raises:
          ValueError: for missing names, crossed bounds, or rows that are no distributions in the
            box.
        """
        low, high = box_of(low, high, self.parameters)
        some = np.array([bool(f.numerator) for f in self.functions])[self.probability]
        row = np.repeat(np.arange(self.entry_start.size - 1), np.diff(self.entry_start))
        row, successor, function = (x[some] for x in (row, self.successor, self.probability))
        order = np.lexsort((successor, row))
        row, successor, function = (x[order] for x in (row, successor, function))
        new = np.ones(row.size, bool)
        new[1:] = (row[1:] != row[:-1]) | (successor[1:] != successor[:-1])
        exact = _Exact(self, successor[new])
        inside, model = point_inside(low, high, exact)
        states = np.repeat(np.arange(self.row_start.size - 1), np.diff(self.row_start))
        pairs = [(f.numerator, f.denominator) for f in self.functions]
        numbers = _ParametricNumbers(
            make_rationals(pairs, len(self.parameters)),
            function.astype(np.int32),
            None if new.all() else (new.cumsum() - 1).astype(np.int32),
            {
                name: (of_state[states].astype(np.int32), of_choice.astype(np.int32))
                for name, (of_state, of_choice) in self.rewards.items()
            },
            int(new.sum()),
        )
        widest = int(np.bincount(row).max(initial=1))
        return ParametricMDP(
            replace(model, valuation={}),
            numbers,
            low,
            high,
            inside,
            self.parameters,
            exact,
            2 * widest + 6,
        )


@struct.dataclass
class _ParametricNumbers:
    """Probabilities and rewards as functions of the parameters."""

    functions: Rationals  # all functions
    function: Integers  # function of each nonzero entry, int32[E]
    # transition to which each entry contributes, int32[E]; None for one entry each
    entry: Integers | None
    # functions on the state of each choice and on the choice, int32[R] both
    rewards: dict[str, tuple[Integers, Integers]]
    num_transitions: int = struct.field(pytree_node=False)  # static

    def __call__(self, x: ArrayLike) -> tuple[jax.Array, dict[str, jax.Array]]:
        value = self.functions(jnp.asarray(x))
        probability = value[self.function]
        if self.entry is not None:
            probability = jax.ops.segment_sum(
                probability, self.entry, self.num_transitions, indices_are_sorted=True
            )
        rewards = {
            name: value[of_state] + value[of_choice]
            for name, (of_state, of_choice) in self.rewards.items()
        }
        return probability, rewards

    def ranges(self, low: np.ndarray, high: np.ndarray) -> tuple[Ranges, dict[str, Ranges]]:
        """Enclosures of probabilities and rewards over a box of non-negative parameters (host)."""
        value = ranges(self.functions, low, high)
        lower, upper = (x[self.function] for x in value)
        if self.entry is not None:
            count = np.bincount(self.entry, minlength=self.num_transitions)
            slack = 1 + count * np.finfo(np.float64).eps
            lower, upper = (
                np.bincount(self.entry, x, self.num_transitions) for x in (lower, upper)
            )
            lower, upper = lower / slack, upper * slack
        rewards = {
            name: Ranges(*(x[of_state] + x[of_choice] for x in value))
            for name, (of_state, of_choice) in self.rewards.items()
        }
        return Ranges(np.clip(lower, 0, 1), np.clip(upper, 0, 1)), rewards


class _Exact:
    """Exact instantiation, hashed by content: reading a file again triggers no recompilation."""

    def __init__(self, model: ParametricModel, successor: Integers) -> None:
        self.model, self.successor = model, successor
        parts = repr((model.parameters, model.functions, sorted(model.rewards))).encode()
        arrays = (
            model.row_start,
            model.entry_start,
            model.successor,
            model.probability,
            *(x for name in sorted(model.rewards) for x in model.rewards[name]),
        )
        self.digest = sha256(
            parts + b"".join(np.asarray(x, np.int64).tobytes() for x in arrays)
        ).hexdigest()

    def __call__(self, point: np.ndarray) -> SparseMDP:
        model = self.model.at(dict(zip(self.model.parameters, point.tolist(), strict=True)))
        if not np.array_equal(model.successor, self.successor):
            raise ValueError(
                "some transitions are gone; keep the box away from where probabilities become zero."
            )
        return model

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Exact) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        return f"exact {self.digest[:16]}"


# --- arithmetic ---------------------------------------------------------------------------------


class Malformed(ValueError):
    """Syntax error in a rational function; the message completes "it is ..."."""


def number(parameters: tuple[str, ...], value: Fraction | int) -> RationalFunction:
    """Constant rational function."""
    powers = (0,) * len(parameters)
    return RationalFunction({powers: Fraction(value)} if value else {}, {powers: Fraction(1)})


def parameter(parameters: tuple[str, ...], name: str) -> RationalFunction:
    """One of the parameters as a rational function."""
    if name not in parameters:
        raise Malformed(f"malformed at {name[:20]!r}")
    powers = tuple(int(x == name) for x in parameters)
    return RationalFunction({powers: Fraction(1)}, number(parameters, 1).denominator)


def _value(terms: list[Term], point: tuple[Fraction, ...]) -> Fraction:
    total = Fraction(0)
    for coefficient, factors in terms:
        for d, power in factors:
            coefficient *= point[d] ** power
        total += coefficient
    return total


def _checked(polynomial: Polynomial) -> Polynomial:
    result = {powers: c for powers, c in polynomial.items() if c}
    bits = (x.bit_length() for c in result.values() for x in (c.numerator, c.denominator))
    if (
        len(result) > _MAX_TERMS
        or any(max(powers, default=0) > MAX_POWER for powers in result)
        or max(bits, default=0) > _MAX_BITS
    ):
        raise Malformed("too large")
    return result


def _sum(a: Polynomial, b: Polynomial) -> Polynomial:
    result = dict(a)
    for powers, c in b.items():
        result[powers] = result.get(powers, Fraction(0)) + c
    return _checked(result)


def _times(a: Polynomial, b: Polynomial) -> Polynomial:
    if len(a) * len(b) > _MAX_TERMS:
        raise Malformed("too large")
    result: Polynomial = {}
    for p, c in a.items():
        for q, d in b.items():
            powers = tuple(i + j for i, j in zip(p, q, strict=True))
            result[powers] = result.get(powers, Fraction(0)) + c * d
    return _checked(result)
