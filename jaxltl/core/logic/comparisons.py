"""Comparisons of a model's variables, such as ``x + y <= 3``, in properties."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core.array_types import Booleans
from jaxltl.core.pretty_print import brief

RELATIONS: Mapping[str, np.ufunc] = {
    "=": np.equal,
    "!=": np.not_equal,
    "<": np.less,
    "<=": np.less_equal,
    ">": np.greater,
    ">=": np.greater_equal,
}
_OPERATIONS: Mapping[str, np.ufunc] = {
    "+": np.add,
    "-": np.subtract,
    "*": np.multiply,
    "/": np.divide,
    **RELATIONS,
}


@brief(facts=lambda self: [self.text])
@dataclass(frozen=True)
class Comparison:
    """A comparison of arithmetic expressions over variables.

    Attributes:
      text: as it was written.
      program: numbers, names of variables and operators in postfix order.

    Example:
      >>> both = Comparison("x < 2", ("x", Fraction(2), "<"))
      >>> both.holds({"x": np.array([1, 2])}).tolist()
      [True, False]
    """

    text: str
    program: tuple[str | Fraction, ...]

    def holds(self, valuation: Mapping[str, ArrayLike]) -> Booleans:
        """The states ``bool[S]`` in which it holds; ValueError for an unknown variable."""
        stack: list[NDArray[np.float64]] = []
        for one in self.program:
            if isinstance(one, Fraction):
                stack.append(np.array(float(one)))
            elif one in _OPERATIONS:
                right, left = stack.pop(), stack.pop()
                with np.errstate(all="ignore"):
                    stack.append(_OPERATIONS[one](left, right))
                if not np.isfinite(stack[-1]).all():
                    raise ValueError(f"{self.text} divides by zero or overflows in some state.")
            else:
                stack.append(self._values(one, valuation))
        size = max((np.size(x) for x in valuation.values()), default=0)
        found: Booleans = np.broadcast_to(stack.pop(), (size,))
        return found

    def _values(self, name: str, valuation: Mapping[str, ArrayLike]) -> np.ndarray:
        if name not in valuation:
            raise ValueError(
                f"{self.text} mentions {name}, which is no variable of the model; it has "
                f"{', '.join(valuation) or 'none'}. Labels are written in double quotes."
            )
        values = np.asarray(valuation[name])
        if values.dtype.kind not in "biuf":
            raise ValueError(f"{self.text}: the variable {name} has no numbers as values.")
        return values.astype(np.float64)
