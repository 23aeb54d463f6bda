"""What callers give: numbers, whole numbers and words, or a ValueError that says what to give."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from jaxltl.core.array_types import Floats, Integers

_SHOWN = 60  # characters


def shown(given: Any) -> str:
    """What was given, for messages."""
    if isinstance(given, np.ndarray) and given.size <= _SHOWN:
        given = given.tolist()
    text = " ".join(repr(given).split())
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


def numbers(name: str, given: Any) -> Floats:
    """An array of numbers, in double precision.

    Raises:
      ValueError: some of it is no number.

    Example:
      >>> numbers("lower", ["x"])
      Traceback (most recent call last):
      ValueError: lower is ['x']; give numbers.
    """
    try:
        return np.asarray(given, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} is {shown(given)}; give numbers.") from None


def wholes(name: str, given: Any) -> Integers:
    """An array of whole numbers.

    Raises:
      ValueError: some of it is none, or too large to be told from the next one.
    """
    found = numbers(name, given)
    if not (np.abs(found) < 2.0**53).all() or (found != np.floor(found)).any():
        raise ValueError(f"{name} is {shown(given)}; give whole numbers.")
    return found.astype(np.int64)


def number(name: str, given: Any) -> float:
    """One finite number.

    Raises:
      ValueError: it is something else, NaN or infinite.
    """
    found = numbers(name, np.nan if given is None else given)
    if found.ndim or not np.isfinite(found):
        raise ValueError(f"{name}={shown(given)}; give a finite number.")
    return float(found)


def whole(name: str, given: Any, *, least: int = 0, most: int = 2**63 - 1) -> int:
    """One whole number.

    Raises:
      ValueError: it is something else, or out of its range.

    Example:
      >>> whole("num_steps", 1.5, least=1)
      Traceback (most recent call last):
      ValueError: num_steps=1.5; it must be a whole number of at least 1.
    """
    try:
        found = int(given)
        fits = np.ndim(given) == 0 and bool(found == given)
    except (TypeError, ValueError, OverflowError):
        found, fits = 0, False
    if not fits:
        raise ValueError(f"{name}={shown(given)}; it must be a whole number of at least {least}.")
    if found < least or found > most:
        bound = f"at least {least}" if found < least else f"at most {most}"
        raise ValueError(f"{name}={shown(given)}; it must be {bound}.")
    return found


def one_of(name: str, given: Any, known: Sequence[str]) -> str:
    """One of some words.

    Raises:
      ValueError: it is none of them.
    """
    if not isinstance(given, str) or given not in known:
        raise ValueError(f"{name}={shown(given)}; choose one of {', '.join(known)}.")
    return given


def truth(name: str, given: Any) -> bool:
    """True or False, also as NumPy and JAX have it.

    Raises:
      ValueError: it is something else, or several of them.

    Example:
      >>> truth("flat", [True, False])
      Traceback (most recent call last):
      ValueError: flat=[True, False]; give True or False.
    """
    kind = getattr(given, "dtype", None)
    if isinstance(given, bool) or (kind == np.bool_ and np.ndim(given) == 0):
        with contextlib.suppress(TypeError):  # one that is traced, and not known yet
            return bool(given)
    raise ValueError(f"{name}={shown(given)}; give True or False.")


def share(name: str, given: Any, *, ends: tuple[bool, bool] = (True, True)) -> float:
    """One number from 0 to 1.

    Args:
      name, given: as they are told.
      ends: whether 0 and 1 are.

    Raises:
      ValueError: it is something else.

    Example:
      >>> share("confidence", 1, ends=(False, False))
      Traceback (most recent call last):
      ValueError: confidence=1; it must be above 0 and below 1.
    """
    found = number(name, given)
    if not (0 <= found <= 1) or (found == 0 and not ends[0]) or (found == 1 and not ends[1]):
        low, high = "at least" if ends[0] else "above", "at most" if ends[1] else "below"
        raise ValueError(f"{name}={shown(given)}; it must be {low} 0 and {high} 1.")
    return found


def called(name: str, given: Any) -> Callable[..., Any]:
    """A function.

    Raises:
      ValueError: it cannot be called.
    """
    if not callable(given):
        raise ValueError(f"{name} is {shown(given)}; give a function.")
    return given


def instance(name: str, given: Any, kind: Any, remedy: str) -> Any:
    """Something of a type, or of one of several.

    Raises:
      ValueError: it is of another one.
    """
    if not isinstance(given, kind):
        found = "an array" if hasattr(given, "aval") else type(given).__name__
        raise ValueError(f"{name} is {found}; give {remedy}.")
    return given


def listed(name: str, given: Any) -> list[Any]:
    """What can be gone through, one by one; of a text its letters.

    Raises:
      ValueError: it cannot.
    """
    if isinstance(given, Iterable):
        with contextlib.suppress(TypeError):  # an array without axes
            return list(given)
    raise ValueError(f"{name} is {shown(given)}; give a list.")


def names(name: str, given: Any) -> tuple[str, ...]:
    """Texts, none of them twice.

    Raises:
      ValueError: something else, or one that is given twice.
    """
    found = listed(name, given)
    for one in found:
        if not isinstance(one, str) or found.count(one) > 1:
            raise ValueError(
                f"{name}: {shown(one)} is no name, or is given twice; give each its name."
            )
    return tuple(found)


def no_model(model: Any) -> str:
    """Why something is no model with known probabilities, and what to give, for a message."""
    name = type(model).__name__
    if hasattr(model, "nominal"):
        return (
            f"{name} has intervals for its probabilities, which this does not take; ask what does "
            "(reachability_probability, total_reward, robust_discounted_value, "
            "robust_satisfaction, robust_bounded_reachability), or give its nominal model, "
            "model.nominal, whose probabilities are one choice of nature."
        )
    if hasattr(model, "num_exchanged"):
        return (
            f"{name} lies on a mesh of devices, where this is not to be had: give it the model on "
            "one. Over a mesh there are discounted, soft, Boltzmann and minimax values, occupancy, "
            "reachability, total rewards, formulas, end components and winning regions."
        )
    return (
        f"{name} has no transitions; give an MDP, a DenseMDP, a SparseMDP, or a product of one of "
        "them."
    )
