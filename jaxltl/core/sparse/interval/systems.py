"""Systems ``x = P x + b`` of changing choices, as exactly as asked, each from the last solution.

Where a model mixes, a Krylov method (van der Vorst 1992) finds them soon. Elsewhere factors of one
system make it fast for those that follow, as long as these are like it; then there are new ones.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.linear.elimination import Factors, factorize

_DIRECT = 2000  # unknowns up to which each system is eliminated
_LIKE = 10  # steps after which old factors do not help
_STEPS = 200  # of a method without factors,
_AGAIN = 3  # and how often it begins
_NOISE = 32 * float(np.finfo(np.float64).eps)


@dataclass
class Systems:
    """Systems of one size, with factors of an earlier one.

    Attributes:
      label: of ``int[M]``, strongly connected components in order.
      mixes: whether few steps lead to many.
      factors: of an earlier system, and that system.
    """

    label: Callable[[], Integers]
    mixes: bool
    factors: Factors | None = None
    matrix: Any = None

    def solve(self, matrix: Any, b: Floats, start: Floats, left: float) -> Floats | None:
        """The solution.

        Args:
          matrix: ``float64[M, M]``, SciPy's.
          b: ``float64[M]``.
          start: ``float64[M]``, a guess.
          left: the largest residual that may be left, if that is beyond rounding.

        Returns:
          ``float64[M]``; None where there is none.
        """
        if self.mixes:
            found = _krylov(matrix, b, start, left, _STEPS, None)
            if found is not None:
                return found
            self.mixes = False
        if self.factors is not None and self.matrix is not matrix and b.size > _DIRECT:
            found = _krylov(matrix, b, start, left, _LIKE, self.factors.solve)
            if found is not None:
                return found
        return self.direct(matrix, b)

    def direct(self, matrix: Any, b: Floats) -> Floats | None:
        """The solution by factors of this very system; None where there is none."""
        if self.matrix is not matrix and not self._renew(matrix):
            return None
        assert self.factors is not None
        x = self.factors.solve(b)
        return x if np.isfinite(x).all() else None

    def _renew(self, matrix: Any) -> bool:
        every = np.arange(matrix.shape[0])
        if self.factors is None:
            self.factors = factorize(matrix, self.label(), every)
        else:
            self.factors = self.factors._replace(rows=matrix).other(every)
        self.matrix = matrix
        return self.factors is not None


def _krylov(
    matrix: Any,
    b: Floats,
    x: Floats,
    left: float,
    steps: int,
    solve: Callable[[Floats], Floats] | None,
) -> Floats | None:
    """BiCGSTAB, begun anew where it breaks down; None where it does not get there."""
    left = max(left, _NOISE * float(np.abs(b).max(initial=0) + np.abs(x).max(initial=0)))
    with np.errstate(all="ignore"):
        for _ in range(1 if solve else _AGAIN):
            new = _bicgstab(matrix, b, x, left, steps, solve or (lambda y: y))
            r = np.abs(b - (new - matrix @ new)).max(initial=0)
            if r <= 2 * left:
                return new
            if not np.isfinite(r):
                return None
            x = new
    return None


def _bicgstab(
    matrix: Any, b: Floats, x: Floats, left: float, steps: int, solve: Callable[[Floats], Floats]
) -> Floats:
    r = b - (x - matrix @ x)
    shadow, rho, p = r, _dot(r, r), r
    for _ in range(steps):
        if not rho or np.abs(r).max() <= left:
            break
        y = solve(p)
        v = y - matrix @ y
        turned = _dot(shadow, v)
        if not turned:
            break
        alpha = rho / turned
        s = r - alpha * v
        z = solve(s)
        t = z - matrix @ z
        omega = _dot(t, s) / max(_dot(t, t), 1e-300)
        if not (np.isfinite(alpha) and np.isfinite(omega) and omega):
            break
        x = x + (alpha * y + omega * z)
        r = s - omega * t
        before, rho = rho, _dot(shadow, r)
        p = r + (rho / before * alpha / omega) * (p - omega * v)
    return x


def _dot(x: Floats, y: Floats) -> float:
    """Without the threads that a library may start, which cost more than such a sum."""
    return float(np.einsum("i,i->", x, y))
