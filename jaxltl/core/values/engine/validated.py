"""Validation of the arguments of solvers, by their names."""

from __future__ import annotations

import contextlib
import inspect
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import wraps
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.models.refusals import refuse_game, refuse_traced
from jaxltl.core.models.protocols import Array, PyTree, base_model
from jaxltl.core.models.sparse import Rewards
from jaxltl.core.suggestions import unknown_keyword
from jaxltl.core.types import Solution, Status
from jaxltl.core.validation import RANGES, choice, is_concrete, require_in_range, require_real

P = ParamSpec("P")
R = TypeVar("R")


WORDS = {"objective": ("max", "min"), "over": ("mean", "worst"), "label_on": ("entry", "exit")}
BOOLEANS = ("relative", "by_step", "by_level")
NUMBERS = ("reward", "initial", "guess")  # arrays, which may be lists


def validated(
    *, games: bool = False, host: bool = False, **words: tuple[str, ...]
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of solvers that checks arguments by their names.

    Numbers in :data:`validation.RANGES`, words, Booleans, and arrays of numbers; `words` are those of
    more arguments. A game is refused unless `games` says that the solver knows who moves;
    traced arrays are refused by solvers on the `host`.
    """
    # Concrete arguments out of range, complex arrays and unknown words raise ValueError. A traced
    # argument out of range is replaced by the least valid number, so that the solver ends, and the
    # solution has the status :func:`argument_status`, NaN for its value, and infinite bounds. (An
    # array instead of a solution becomes NaN.)

    def decorate(solve: Callable[P, R]) -> Callable[P, R]:
        signature = inspect.signature(solve)
        optional = {x.name for x in signature.parameters.values() if x.default is None}
        takes_more = any(x.kind is x.VAR_KEYWORD for x in signature.parameters.values())

        @wraps(solve)
        def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
            for name in kwargs:
                if name not in signature.parameters and not takes_more:
                    raise unknown_keyword(solve.__name__, name, signature.parameters)
            bound = signature.bind(*args, **kwargs)
            if not games:
                refuse_game(solve.__name__, bound.arguments.items())
            if host:
                refuse_traced(solve.__name__, bound.arguments.items())
            arguments = dict(bound.arguments)
            for name, known in (WORDS | words).items():
                if name in arguments and (arguments[name] is not None or name not in optional):
                    choice(name, arguments[name], known)
            for name in BOOLEANS:
                if name in arguments:
                    validation.boolean(name, arguments[name])
            for name in NUMBERS:
                if arguments.get(name) is not None:
                    bound.arguments[name] = arguments[name] = _numbers(name, arguments)
            traced = traced_arguments(
                {name: x for name, x in arguments.items() if x is not None or name not in optional}
            )
            if not traced:
                return solve(*bound.args, **bound.kwargs)
            for name, value in traced.items():
                valid = RANGES[name]
                bound.arguments[name] = jnp.where(valid.contains(value), value, valid.low)
            result: R = invalidated(solve(*bound.args, **bound.kwargs), argument_status(traced))
            return result

        return wrapper

    return decorate


def _numbers(name: str, arguments: Mapping[str, PyTree]) -> PyTree:
    """An array of numbers, or a name or structure of rewards, which sparse models have."""
    value = arguments[name]
    if isinstance(value, str | Rewards) and name == "reward":
        model = base_model(arguments.get("model", arguments.get("game")))
        if model is not None and not hasattr(getattr(model, "nominal", model), "rewards"):
            raise ValueError(
                f"reward={validation.shorten(value)}; {type(model).__name__} has no named rewards: "
                "give an array."
            )
        return value
    if isinstance(value, jax.Array | Rewards):
        return value
    array: Array = np.empty(0, object)
    with contextlib.suppress(TypeError, ValueError):
        array = np.asarray(value)
    require_real(name, array)
    if array.dtype.kind in "biuf":
        return value if hasattr(value, "dtype") or not array.ndim else array
    raise ValueError(f"{name} is {validation.shorten(value)}; give an array of numbers.")


def traced_arguments(arguments: Mapping[str, PyTree]) -> dict[str, jax.Array]:
    """Checks concrete arguments by their names; returns the scalar ones that are traced."""
    traced = {}
    for name, value in arguments.items():
        if name in RANGES:
            require_in_range(name, value)
            if not is_concrete(value):
                traced[name] = value
        else:
            require_real(name, value)
    return traced


def argument_status(arguments: Mapping[str, ArrayLike]) -> jax.Array:
    """Status code of scalar arguments: CONVERGED, or the reason why one is out of range."""
    status: jax.Array = jnp.int32(Status.CONVERGED)
    for name, value in arguments.items():
        reason = Status.INVALID_DISCOUNT if name == "discount" else Status.INVALID_OPTION
        invalid = jnp.where(RANGES[name].contains(value), Status.CONVERGED, reason)
        status = jnp.maximum(status, invalid.astype(jnp.int32))
    return status


def invalidated(solution: PyTree, reason: jax.Array) -> PyTree:
    """A solution, without value and bounds, or an array of NaN, if `reason` is not CONVERGED."""
    valid = reason == Status.CONVERGED

    def where(x: jax.Array, bad: float) -> jax.Array:
        return jnp.where(valid, x, jnp.asarray(bad, x.dtype))

    if not isinstance(solution, Solution):
        return where(solution, jnp.nan)
    return replace(
        solution,
        value=where(solution.value, jnp.nan),
        lower=where(solution.lower, -jnp.inf),
        upper=where(solution.upper, jnp.inf),
        residual=where(solution.residual, jnp.nan),
        status=jnp.maximum(solution.status, reason).astype(jnp.int32),
    )
