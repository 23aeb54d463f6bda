"""Sequences of similar linear systems ``x = P x + b``: BiCGSTAB and reused factors.

In policy iteration each system differs from the last one in a few rows. Where few steps lead to
many states, BiCGSTAB (van der Vorst 1992) from the last solution converges fast. Elsewhere the
factors of an earlier system precondition it, until they are too old and are computed anew.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from jaxltl.core.array_types import Floats, Integers, SparseMatrix
from jaxltl.core.sparse.linear.elimination import Factors, factorize
from jaxltl.core.sparse.linear.krylov import bicgstab

_DIRECT = 2000  # unknowns up to which each system is eliminated
_PRECONDITIONED = 10  # steps after which old factors are given up
_STEPS = 200  # of BiCGSTAB without factors


@dataclass
class SystemSequence:
    """Solver of systems of one size."""

    label: Callable[[], Integers]  # SCCs int[M] in topological order
    mixes: bool  # True if few steps lead to many unknowns
    factors: Factors | None = None  # of the earlier system `matrix`
    matrix: SparseMatrix | None = None

    def solve(
        self, matrix: SparseMatrix, b: Floats, start: Floats, residual: float
    ) -> Floats | None:
        """The solution up to a residual, or up to rounding if that is more; None if singular."""
        if self.mixes:
            solution = bicgstab(matrix, b, start, residual, steps=_STEPS)
            if solution is not None:
                return solution
            self.mixes = False
        if self.factors is not None and self.matrix is not matrix and b.size > _DIRECT:
            old = self.factors.solve
            solution = bicgstab(matrix, b, start, residual, steps=_PRECONDITIONED, precondition=old)
            if solution is not None:
                return solution
        return self.solve_directly(matrix, b)

    def solve_directly(self, matrix: SparseMatrix, b: Floats) -> Floats | None:
        """The solution by factors of this system; None if it is singular."""
        if self.matrix is not matrix and not self._factor(matrix):
            return None
        assert self.factors is not None
        x = self.factors.solve(b)
        return x if np.isfinite(x).all() else None

    def _factor(self, matrix: SparseMatrix) -> bool:
        rows = np.arange(matrix.shape[0])
        if self.factors is None:
            self.factors = factorize(matrix, self.label(), rows)
        else:
            self.factors = self.factors._replace(rows=matrix).other(rows)
        self.matrix = matrix
        return self.factors is not None
