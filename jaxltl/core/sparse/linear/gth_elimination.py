"""Elimination without subtractions (Grassmann, Taksar and Heyman 1985) in a band.

``(D - W) x = b`` with weights ``W >= 0`` and ``D = sum_j W_ij + l_i`` is solved with each pivot as the
sum of the weights that remain, so that its relative error does not grow with the length of episodes
(O'Cinneide 1993, Entrywise perturbation theory and error analysis for Markov chains).
"""

from __future__ import annotations

import numpy as np

from jaxltl.core.array_types import Floats, SparseMatrix
from jaxltl.core.sparse.linear.extended_precision import Solver

_MOST, _WORK = 2**27, 4e9  # limits of the entries of a band, and of its multiplications


def gth_solver(matrix: SparseMatrix, leaving: Floats) -> Solver | None:
    """Solver of ``(D - W) x = b``; None if the band is too large or some state is never left."""
    from scipy.sparse import csgraph

    size = leaving.size
    both = (matrix + matrix.T).tocsr()
    order = csgraph.reverse_cuthill_mckee(both, symmetric_mode=True)
    place = np.empty(size, np.int64)
    place[order] = np.arange(size)
    row = place[np.repeat(np.arange(size), np.diff(matrix.indptr))]
    column = place[matrix.indices]
    width = max(int(np.abs(row - column).max(initial=0)), 1)
    if size * (2 * width + 1) > _MOST or size * float(width) ** 2 > _WORK:
        return None
    # Row i of the band holds the columns from i - width to i + width.
    flat = np.zeros(size * (2 * width + 1))
    flat[width + 2 * width * row + column] = matrix.data
    step = flat.itemsize
    band = np.lib.stride_tricks.as_strided(
        flat[width:], (size, size), (2 * width * step, step), writeable=True
    )
    total, out = np.empty(size), leaving[order].astype(np.float64)
    first = np.maximum(np.arange(size) - width, 0).tolist()
    for k in reversed(range(size)):
        earlier = slice(first[k], k)
        total[k] = band[k, earlier].sum() + out[k]
        if not total[k] > 0:
            return None
        share = band[earlier, k]
        share /= total[k]
        band[earlier, earlier] += share[:, None] * band[k, earlier]
        out[earlier] += share * out[k]

    def solve(b: Floats) -> Floats:
        x = b[order]
        for k in reversed(range(size)):
            x[first[k] : k] += band[first[k] : k, k] * x[k]
        for k in range(size):
            x[k] = (x[k] + band[k, first[k] : k] @ x[first[k] : k]) / total[k]
        result: Floats = x[place]
        return result

    return solve
