"""Validation of arguments: raises ValueError with the expected type and range.

The ranges of scalar arguments are declared once, in `RANGES`, for all solvers and learners. A
concrete number outside its range is a ValueError (:func:`require_in_range`); of a traced one
:meth:`Range.contains` is a traced flag, from which solvers and learners set an invalid status.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from jaxltl.core.suggestions import unknown_keyword
from jaxltl.core.array_types import Booleans, Floats

ROW_SUM_TOLERANCE = 1e-6  # largest error of the sum of a distribution that is given

_MAX_REPR = 60  # characters of a value in an error message


@contextlib.contextmanager
def errors_in(place: str, remedy: str = "") -> Iterator[None]:
    """Prepends a place to the message of a ValueError, and appends a remedy."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{place}{error}{remedy}") from None


@dataclass(frozen=True)
class Range:
    """An interval of valid numbers; NaN is in none.

    >>> str(Range(0, 1, open_above=True)), str(Range(1, integer=True))
    ('at least 0 and below 1', 'an integer of at least 1')
    """

    low: float = -math.inf
    high: float = math.inf
    open_below: bool = False
    open_above: bool = False
    integer: bool = False

    def contains(self, value: Any) -> Any:
        """Membership, elementwise; works on NumPy arrays, JAX arrays and tracers alike."""
        above = value > self.low if self.open_below else value >= self.low
        below = value < self.high if self.open_above else value <= self.high
        if not self.integer:
            return above & below
        with np.errstate(invalid="ignore"):  # inf // 1 is NaN, so that infinity is in no range
            return above & below & (value == value // 1)

    def __str__(self) -> str:
        ends = [f"{'above' if self.open_below else 'at least'} {self.low:.10g}"]
        if self.high == math.inf:
            ends += ["finite"] if self.open_above else []
        else:
            ends.append(f"{'below' if self.open_above else 'at most'} {self.high:.10g}")
        return ("an integer of " if self.integer else "") + " and ".join(ends)


_DISCOUNT = Range(0, 1, open_above=True)

RANGES = {
    "discount": _DISCOUNT,
    "positive_discount": replace(_DISCOUNT, open_below=True),
    "closed_discount": replace(_DISCOUNT, open_above=False),  # of finite horizons and episodes
    "tolerance": Range(0, open_above=True),
    "max_steps": Range(0, integer=True),
    "evaluation_sweeps": Range(0, integer=True),
    "confidence": Range(0, 1, open_below=True, open_above=True),
    "mu": Range(0, open_above=True),
}


def is_concrete(value: object) -> bool:
    """True if a scalar's value is known: it is not traced by JAX."""
    try:
        np.asarray(value)
    except TypeError:  # what JAX raises for tracers
        return False
    return True


def require_in_range(name: str, value: Any, valid: Range | None = None) -> None:
    """Raises ValueError unless `value` is one real number in its range.

    Of a traced value shape and dtype are checked; the range is checked by `contains` inside jit.
    """
    valid = RANGES[name] if valid is None else valid
    known = is_concrete(value)
    array = np.asarray(value) if known else value
    if array.ndim or array.dtype.kind in "cOSU":
        raise ValueError(
            f"{name}={shorten(value)}; it must be one real number, {valid} (vmap over many)."
        )
    if known and not valid.contains(array):
        raise ValueError(f"{name}={shorten(array)}; it must be {valid}.")


def require_real(name: str, value: Any) -> None:
    """Raises ValueError if an array is complex.

    >>> require_real("reward", np.array([1j]))
    Traceback (most recent call last):
    ValueError: reward is complex128[1]; give real numbers.
    """
    dtype = getattr(value, "dtype", None)
    if getattr(dtype, "kind", None) == "c":
        raise ValueError(f"{name} is {dtype}{list(np.shape(value))}; give real numbers.")


def shorten(value: object) -> str:
    """The representation of a value, abbreviated for error messages."""
    if isinstance(value, np.ndarray) and value.size <= _MAX_REPR:
        value = value.tolist()
    text = " ".join(repr(value).split())
    return text if len(text) <= _MAX_REPR else f"{text[:_MAX_REPR]}..."


def first_true(mask: Any) -> list[Any]:
    """At most one index, of the first True entry: an int, or a list of them along several axes.

    >>> first_true(np.array([False, True, True])), first_true(np.eye(2) > 1)
    ([1], [])
    """
    if not np.any(mask):  # ten times faster than the places of no entries
        return []
    place = np.argwhere(mask)[:1]
    return cast(list[Any], (place[:, 0] if place.shape[1] == 1 else place).tolist())


def float_array(name: str, value: object) -> Floats:
    """Converts to an array in double precision."""
    try:
        if np.asarray(value).dtype.kind != "c":
            return np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name} is {shorten(value)}; give numbers.")


def boolean_array(name: str, value: object) -> Booleans:
    """Converts to a Boolean array; the numbers 0 and 1 are accepted."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        array = np.asarray(None)
    if array.dtype != bool and (array.dtype.kind not in "iuf" or not np.isin(array, (0, 1)).all()):
        raise ValueError(f"{name} is {shorten(value)}; give True or False for each entry.")
    return array.astype(bool)


def finite_number(name: str, value: object) -> float:
    """Converts to a float."""
    array = float_array(name, np.nan if value is None else value)
    if array.ndim or not np.isfinite(array):
        raise ValueError(f"{name}={shorten(value)}; give a finite number.")
    return float(array)


def integer(name: str, value: Any, *, least: int = 0, limit: int = 2**63 - 1) -> int:
    """Converts to an int from `least` to `limit`."""
    try:
        number = int(value)
        exact = np.ndim(value) == 0 and bool(number == value)
    except (TypeError, ValueError, OverflowError):
        number, exact = 0, False
    if not exact:
        raise ValueError(f"{name}={shorten(value)}; it must be an integer of at least {least}.")
    if number < least or number > limit:
        bound = f"at least {least}" if number < least else f"at most {limit}"
        raise ValueError(f"{name}={shorten(value)}; it must be {bound}.")
    return number


def choice(name: str, value: object, known: Sequence[str]) -> str:
    """Returns `value` if it is one of some words."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{name}={shorten(value)}; choose one of {', '.join(known)}.")
    return value


def boolean(name: str, value: Any) -> bool:
    """Converts a Boolean of Python, NumPy or JAX to bool."""
    kind = getattr(value, "dtype", None)
    if isinstance(value, bool) or (kind == np.bool_ and np.ndim(value) == 0):
        with contextlib.suppress(TypeError):  # a tracer
            return bool(value)
    raise ValueError(f"{name}={shorten(value)}; give True or False.")


def fraction(name: str, value: object, *, ends: tuple[bool, bool] = (True, True)) -> float:
    """Converts to a float from 0 to 1; `ends` are whether 0 and 1 are valid."""
    number = finite_number(name, value)
    valid = Range(0, 1, open_below=not ends[0], open_above=not ends[1])
    if not valid.contains(number):
        raise ValueError(f"{name}={shorten(value)}; it must be {valid}.")
    return number


def function(name: str, value: object) -> Callable[..., Any]:
    """Returns `value` if it is callable."""
    if not callable(value):
        raise ValueError(f"{name} is {shorten(value)}; give a function.")
    return value


def instance(name: str, value: Any, kind: Any, remedy: str) -> Any:
    """Returns `value` if it is an instance of a type, or of one of several."""
    if not isinstance(value, kind):
        kind_name = "an array" if hasattr(value, "aval") else type(value).__name__
        raise ValueError(f"{name} is {kind_name}; give {remedy}.")
    return value


def sequence(name: str, value: object) -> list[Any]:
    """Converts an iterable to a list; a text becomes the list of its letters."""
    if isinstance(value, Iterable):
        with contextlib.suppress(TypeError):  # a scalar array
            return list(value)
    raise ValueError(f"{name} is {shorten(value)}; give a list.")


def distinct_names(name: str, value: object) -> tuple[str, ...]:
    """Converts an iterable of distinct strings to a tuple."""
    names = sequence(name, value)
    for one in names:
        if not isinstance(one, str) or names.count(one) > 1:
            raise ValueError(
                f"{name}: {shorten(one)} is not a string, or occurs twice; give distinct names."
            )
    return tuple(names)


def unsupported_model(model: object) -> str:
    """The error message for a model without exact probabilities on one device."""
    name = type(model).__name__
    if hasattr(model, "system") and hasattr(model, "mdp"):
        return (
            "the model is a Game, which is not supported here: convert the model on which it is, as "
            "make_game(to_sparse(game.mdp), game.system.ravel()) or "
            "make_game(to_padded(game.mdp), game.system), or give game.mdp, whose actions are all "
            "one player's."
        )
    if hasattr(model, "fully_observable"):
        return (
            "the model is a POMDP, and the answer would be for policies that see its states; ask for "
            "reachability_probability, total_reward, optimal_satisfaction or solve_property of the "
            "POMDP, or give its fully observable model, pomdp.fully_observable, whose maximum is an "
            "upper bound and whose minimum is a lower bound."
        )
    if hasattr(model, "players"):
        return (
            f"{name} has several players; solve_property answers for their coalitions. Elsewhere give "
            "model.game([...]), the game of a coalition against the others."
        )
    if hasattr(model, "nominal"):
        return (
            f"{name} has intervals for its probabilities, which are not supported here; use a "
            "solver that supports them (reachability_probability, total_reward, "
            "optimal_value, optimal_satisfaction, bounded_reachability), or give "
            "its nominal model, model.nominal, whose probabilities are one choice of nature."
        )
    if hasattr(model, "num_exchanged"):
        return (
            f"{name} lies on a mesh of devices, which is not supported here: give the model on one "
            "device. Over a mesh there are discounted, soft, Boltzmann and minimax values, "
            "occupancy, reachability, total rewards, formulas, end components and winning regions."
        )
    return (
        f"{name} has no transitions; give an MDP, a DenseMDP, a SparseMDP, or a product of one of "
        "them."
    )


def keywords(function: str, names: Iterable[str], options: type) -> None:
    """Raises TypeError, as Python does, for a keyword that a TypedDict of options lacks."""
    if unknown := sorted(set(names) - set(options.__annotations__)):
        raise unknown_keyword(function, unknown[0], options.__annotations__)
