"""Whether a function is pure, as far as tracing it twice tells."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np


def traced(name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """The shapes of what a function returns, if two calls are the same pure function.

    Raises:
      ValueError: it cannot be traced, keeps what it was called with, or is another one each time.
    """
    try:
        try:
            with jax.checking_leaks():
                first, again, shapes = _twice(function, *arguments)
        except Exception as problem:
            if not _kept_by_jax(problem):
                raise
            first, again, shapes = _twice(function, *arguments)
    except (jax.errors.JAXTypeError, jax.errors.ConcretizationTypeError) as problem:
        text = str(problem).split("\n", 1)[0]
        raise ValueError(
            f"{name} cannot be traced: {text} Write it with jax.numpy; lax.cond and jnp.where "
            "take the place of if."
        ) from problem
    except Exception as problem:
        if "Leaked" not in str(problem):
            raise
        raise ValueError(
            f"{name} is not pure: it keeps what it was called with. Keep it in the world that "
            "is returned."
        ) from problem
    if not _same(first, again):
        raise ValueError(
            f"{name} is not pure: called twice it is two different functions. Draw from the key "
            "that is given, and keep what changes in the world that is returned."
        )
    return shapes


def _twice(function: Callable[..., Any], *arguments: Any) -> tuple[Any, Any, Any]:
    first, shapes = jax.make_jaxpr(function, return_shape=True)(*arguments)
    # Another object, so that the second trace is not the first, remembered.
    return first, jax.make_jaxpr(lambda *given: function(*given))(*arguments), shapes


def _kept_by_jax(problem: Exception) -> bool:
    """Whether all that a leak tells of is held by tables of JAX's own, as with jaxopt's solvers.

    What another function then uses of it cannot be traced there.
    """
    head, *leaks = str(problem).strip().split("\n\n")
    own = "<PyTreeDef ", "<WeakrefLRUCache ", "jax._src."
    return (
        "Leaked" in head
        and bool(leaks)
        and all(any(f" is referred to by {x}" in leak for x in own) for leak in leaks)
    )


def _same(first: Any, again: Any) -> bool:
    constants = zip(first.consts, again.consts, strict=False)
    return (
        len(first.consts) == len(again.consts)
        and str(first.jaxpr) == str(again.jaxpr)
        and all(
            np.array_equal(np.asarray(x), np.asarray(y), equal_nan=np.asarray(x).dtype.kind == "f")
            for x, y in constants
            if not isinstance(x, jax.core.Tracer)
            and not jax.dtypes.issubdtype(getattr(x, "dtype", np.dtype(float)), jax.dtypes.prng_key)
        )
    )
