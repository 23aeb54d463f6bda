"""The opposite of an event, whose probability is one minus its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jax import lax

from jaxltl.core.models.ops.array_namespace import is_traced, namespace, to_jax
from jaxltl.core.types import Solution


def opposite_event(solution: Solution) -> Solution:
    """Solution for the complementary event, with bounds rounded outwards unless they are exact.

    Args:
      solution: of an event.

    Returns:
      :class:`Solution` in the precision that was given: NumPy's arrays stay NumPy's.

    Differentiable in the value.
    """
    parts = solution.value, solution.upper, solution.lower
    if is_traced(parts):
        parts = parts[0], *lax.stop_gradient(parts[1:])
    xp, value, far, near = namespace(*parts)
    one = xp.ones((), value.dtype)

    def outwards(bound: Any, end: int) -> Any:
        rounded = one - bound
        beyond = xp.clip(xp.nextafter(rounded, end * one), 0, 1)
        # By Sterbenz's lemma, 1 - rounded has no rounding error, so that this test is exact.
        return xp.where(one - rounded == bound, rounded, beyond)

    found: Any = one - value, outwards(far, -1), outwards(near, 2)
    if any(isinstance(x, jax.Array) for x in parts):
        found = to_jax(found)
    else:
        found = tuple(np.asarray(x) for x in found)
    return replace(solution, value=found[0], lower=found[1], upper=found[2])
