"""Parametric MDPs: probabilities and rewards as differentiable functions on a box."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import struct, validation
from jaxltl.core.models.ops.array_namespace import is_traced, jit
from jaxltl.core.models.protocols import Array, PyTree
from jaxltl.core.models.sparse import Rewards, SparseMDP, make_sparse
from jaxltl.core.pretty_print import brief
from jaxltl.core.validation import first_true


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
_LIMIT = 10  # parameters of a polynomial up to which its 2^n corners are enumerated


class Ranges(NamedTuple):
    """Bounds ``float64[F]`` on the values of functions."""

    lower: np.ndarray
    upper: np.ndarray


def ranges(functions: Rationals, low: np.ndarray, high: np.ndarray) -> Ranges:
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
    return Ranges(lower - _EPS * np.abs(lower), upper + _EPS * np.abs(upper))


def _ranges(of: Polynomials, low: np.ndarray, high: np.ndarray) -> Ranges:
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
    for n in np.unique(number[linear & (terms > 1) & (number <= _LIMIT)]):
        some = np.flatnonzero(linear & (terms > 1) & (number == n))
        extremes = _corners(some, n, used, _Terms(owner, powers[monomial], coefficient), ends)
        lower[some], upper[some] = (
            np.maximum(lower[some], extremes[0]),
            np.minimum(upper[some], extremes[1]),
        )
    # Powers, products, the sum and the coefficient are rounded.
    slack = (2 * powers.max(initial=0) + 2 * low.size + terms + 4) * _EPS * size
    return Ranges(lower - slack, upper + slack)


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


Ends = Array  # for all parameters, for each name, or float[D]
_TRIALS = 64  # candidate points for a valid model


@brief
@struct.dataclass
class ParametricMDP:
    """Markov chain or MDP with probabilities that depend on parameters in a box, with a constant graph.

    Attributes:
      model: the model at the point `inside`.
      numbers: ``float[D] -> (float[T], {name: float[R]})``, the probabilities and the rewards of
        choices, a pytree.
      low, high: ``float64[D]``, the box.
      inside: ``float64[D]``, a point at which the probabilities are valid.
      parameters: the D names; static.
      exact: ``float64[D] -> SparseMDP`` with at most `roundings` roundings of each number; None if only
        `numbers` are known. Static, as is `roundings`.

    Example:
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> biased = make_parametric(coin, lambda x: jnp.array([x[0], 1 - x[0], 1, 1]),
      ...                          {"heads": 0.1}, {"heads": 0.9})
      >>> biased.parameters, biased.low.tolist(), biased.high.tolist()
      (('heads',), [0.1], [0.9])
    """

    model: SparseMDP
    numbers: PyTree
    low: Array
    high: Array
    inside: Array
    parameters: tuple[str, ...] = struct.field(pytree_node=False)
    exact: Callable[[np.ndarray], SparseMDP] | None = struct.field(pytree_node=False, default=None)
    roundings: int = struct.field(pytree_node=False, default=0)

    def at(self, values: Mapping[str, float] | chex.Array) -> SparseMDP:
        """The model at a point, ``float[D]`` or a number for each name; ValueError outside of the box."""
        point = _point("values", values, self.parameters)
        outside = (point < self.low) | (point > self.high)
        for d in first_true(outside):
            raise ValueError(
                f"{self.parameters[d]} = {point[d]:.9g} is outside of its interval "
                f"[{self.low[d]:.9g}, {self.high[d]:.9g}]."
            )
        return self._at(point)

    def valid_points(self, name: str, points: ArrayLike) -> np.ndarray:
        """Validated points of the box, ``float64[N, D]``."""
        array, names = validation.float_array(name, points), self.parameters
        if array.ndim != 2 or array.shape[1] != len(names) or not len(array):
            raise ValueError(
                f"{name} has shape {array.shape}; expected (N, {len(names)}), a number "
                f"for each of {', '.join(names)}."
            )
        out = ~((array >= self.low) & (array <= self.high))
        for n, d in first_true(out):
            raise ValueError(
                f"{name} {n} has {names[d]} = {array[n, d]:.9g}; its interval is "
                f"[{self.low[d]:.9g}, {self.high[d]:.9g}]."
            )
        return array

    def _at(self, point: np.ndarray) -> SparseMDP:
        if self.exact is None:
            return _evaluated(self.model, self.numbers, point)
        return self.exact(point)

    def within(self, low: Ends, high: Ends) -> ParametricMDP:
        """The model on a smaller box; ValueError if it is not contained in this one."""
        low, high = box_of(low, high, self.parameters)
        out = (low < self.low) | (high > self.high)
        for d in first_true(out):
            raise ValueError(
                f"the interval [{low[d]:.9g}, {high[d]:.9g}] of {self.parameters[d]} is not within "
                f"[{self.low[d]:.9g}, {self.high[d]:.9g}]."
            )
        inside, model = point_inside(low, high, self._at)
        return replace(self, low=low, high=high, inside=inside, model=model)


def make_parametric(
    model: SparseMDP,
    numbers: Callable[[jax.Array], PyTree],
    low: Ends,
    high: Ends,
    *,
    parameters: Sequence[str] | None = None,
) -> ParametricMDP:
    """Validated :class:`ParametricMDP` from a JAX function.

    Args:
      model: a model with the common transitions, labels and rewards.
      numbers: ``float[D] -> float[T]``, the probabilities, or a pair of them and of a dict of
        rewards by name, on states ``[S]`` or choices ``[R]``; other rewards are constant. Pass arrays
        by ``jax.tree_util.Partial(function, *arrays)``.
      low, high: ``float[D]``, one number for all, or a number for each name; no probability may
        become zero in the box.
      parameters: the names; default: those of `low`, else p0, p1 and so on.

    Returns:
      :class:`ParametricMDP`.

    Raises:
      ValueError: an invalid box or names, or functions of another shape or without a valid model.

    Example:
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> biased = make_parametric(coin, lambda x: jnp.array([x[0], 1 - x[0], 1, 1]), [0.1], [0.9])
      >>> biased.at({"p0": 0.25}).probability.tolist()
      [0.25, 0.75, 1.0, 1.0]
    """
    if is_traced((model, low, high)):
        raise ValueError("make_parametric reads its model: call it before jit.")
    if not isinstance(model, SparseMDP):
        raise ValueError(
            f"{type(model).__name__} has no entries whose probabilities could be "
            "functions; give a SparseMDP (to_sparse makes one; of an interval model, "
            "its nominal one)."
        )
    if not callable(numbers):
        raise ValueError(f"numbers is {validation.shorten(numbers)}; give a function of float[D].")
    if parameters is None:
        parameters = (
            tuple(low)
            if isinstance(low, Mapping)
            else tuple(f"p{d}" for d in range(max(np.size(low), np.size(high))))
        )
    names = tuple(validation.sequence("parameters", parameters))
    if not all(isinstance(x, str) for x in names) or len(set(names)) < len(names):
        raise ValueError(f"parameters are {validation.shorten(names)}; name each once.")
    low, high = box_of(low, high, names)
    numbers = numbers if isinstance(numbers, Partial) else Partial(numbers)
    numbers = Partial(_paired, numbers, model.host.state)
    model = replace(model, valuation={})
    _check_shapes(numbers, model, len(names))
    inside, nominal = point_inside(low, high, lambda x: _evaluated(model, numbers, x))
    return ParametricMDP(nominal, numbers, low, high, inside, names)


def _paired(
    numbers: Callable[[jax.Array], PyTree], state: Array, x: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Probabilities and rewards of choices."""
    result = numbers(x)
    probability, rewards = result if isinstance(result, tuple) else (result, {})
    size = state.shape[0]
    return jnp.asarray(probability), {
        name: jnp.asarray(r) if jnp.shape(r) == (size,) else jnp.asarray(r)[state]
        for name, r in rewards.items()
    }


def _check_shapes(
    numbers: Callable[[jax.Array], PyTree], model: SparseMDP, num_parameters: int
) -> None:
    x = jax.ShapeDtypeStruct((num_parameters,), jnp.zeros(()).dtype)
    probability, rewards = jax.eval_shape(numbers, x)
    shapes = {
        "probabilities": (probability.shape, (model.num_transitions,)),
        **{f"reward {n!r}": (r.shape, (model.num_rows,)) for n, r in rewards.items()},
    }
    for name, (shape, expected) in shapes.items():
        if shape != expected:
            raise ValueError(f"{name} of numbers have shape {shape}; expected {expected}.")


@jit()
def _evaluate(numbers: Callable[[jax.Array], PyTree], x: jax.Array | np.ndarray) -> PyTree:
    return numbers(jnp.asarray(x))


def _evaluated(
    model: SparseMDP, numbers: Callable[[jax.Array], PyTree], point: np.ndarray
) -> SparseMDP:
    """The validated model at a point."""
    values = _evaluate(numbers, np.asarray(point, jnp.zeros(()).dtype))
    probability, rewards = jax.tree.map(lambda x: np.asarray(x, np.float64), values)
    host = model.host
    wrong = ~(probability > 0)  # NaN too
    for e in first_true(wrong):
        raise ValueError(
            f"the probability from state {host.state[host.row[e]]} to state {host.successor[e]} "
            f"is {probability[e]:.6g}; it must be positive."
        )
    structures = {**model.rewards, **{n: Rewards(choice=r) for n, r in rewards.items()}}
    return make_sparse(
        model.row_start,
        model.entry_start,
        model.successor,
        probability,
        initial=model.initial,
        label=model.label,
        propositions=model.propositions,
        rewards=structures,
        action=model.action,
        action_names=model.action_names,
    )


def point_inside(
    low: np.ndarray, high: np.ndarray, model_at: Callable[[np.ndarray], SparseMDP]
) -> tuple[np.ndarray, SparseMDP]:
    """A point of a box at which functions are a valid model, and the model there."""
    # Multiples of distinct irrational numbers, at which a nonzero rational function rarely vanishes.
    step = np.modf(np.sqrt(np.arange(low.size) + 2.0))[0]
    first = ""
    for trial in range(_TRIALS):
        share = 0.5 + 0.01 * (step - 0.5) if trial == 0 else np.modf(trial * (step + 0.618))[0]
        point = np.clip(low + share * (high - low), low, high)
        try:
            return point, model_at(point)
        except ValueError as error:
            first = first or f"at {point.round(6).tolist()}: {error}"
    raise ValueError(f"the functions are no model at any of {_TRIALS} points of the box; {first}")


def box_of(low: Ends, high: Ends, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    """The validated bounds of a box, ``float64[D]`` both."""
    ends = [_point(of, x, names) for of, x in (("low", low), ("high", high))]
    crossed = ~(ends[0] < ends[1])
    for d in first_true(crossed):
        raise ValueError(
            f"the interval of {names[d]} is [{ends[0][d]:.9g}, {ends[1][d]:.9g}]; "
            "low must be below high."
        )
    return ends[0], ends[1]


def _point(of: str, values: PyTree, names: Sequence[str]) -> np.ndarray:
    """A number for each name, ``float64[D]``."""
    if isinstance(values, Mapping):
        if set(values) != set(names):
            missing = sorted(set(names) - set(values)) or sorted(set(values) - set(names))
            word = "missing" if set(names) - set(values) else "unknown"
            raise ValueError(
                f"{of}: {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} "
                f"{word}; the parameters are {', '.join(names)}."
            )
        values = [values[name] for name in names]
    point = validation.float_array(of, values)
    if point.ndim == 0 and of != "values":
        point = np.full(len(names), point)
    if point.shape != (len(names),):
        raise ValueError(
            f"{of} has shape {point.shape}; expected ({len(names)},), a number for "
            f"each of {', '.join(names)}."
        )
    if not np.isfinite(point).all():
        d = int(np.flatnonzero(~np.isfinite(point))[0])
        raise ValueError(f"{of} of {names[d]} is {point[d]}; give a finite number.")
    return point
