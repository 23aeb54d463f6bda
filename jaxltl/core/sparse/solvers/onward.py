"""Improvements of a policy, carried on to the states that lead to those that improved.

A policy that improves in one state may do so in the states before it only after the next system is
solved: along a chain of n states it takes n systems. Value iteration, of the states alone whose
successors changed, takes the news all the way (Bertsekas and Tsitsiklis 1989, section 2.6).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.rows import group_starts, concatenated_ranges

_ROUND = 3000  # entries that a round costs besides those that it reads
_WORK = 40  # times the entries of the system that all rounds may cost,
_ROUNDS = 100  # and so many rounds
_LEAST = 0.01  # of the largest gain: less is not carried on


def propagate_improvements(
    matrix: Any,
    known: Floats,
    owner: Integers,
    value: Floats,
    chosen: Integers,
    sign: int,
    least: float,
) -> Integers:
    """A better policy than one of a known value.

    Each state that gains takes the row that it gains by. As values only get better on the way, no
    row that was taken gets worse, and the policy is better than the one before wherever it changed.

    Args:
      matrix: ``float64[R, M]``, SciPy's, without self-loops.
      known: ``float64[R]``, what a row earns.
      owner: ``int[R]``, the state of a row.
      value: ``float64[M]``, the policy's, of the same `known`.
      chosen: ``int[M]``, the policy.
      sign: 1 where more is better, -1 where less is.
      least: what counts as a gain.

    Returns:
      ``int[M]``.
    """
    back = matrix.tocsc()
    into = np.diff(back.indptr)
    value, chosen = value.copy(), chosen.copy()
    rows: Any = np.arange(owner.size)
    image = known + matrix @ value
    left = _WORK * matrix.nnz + _ROUND * _ROUNDS
    while True:
        state = owner[rows]
        gain = sign * (image - value[state])
        better = np.flatnonzero(gain > least)
        if not better.size:
            return chosen
        better = better[np.lexsort((-gain[better], state[better]))]
        better = better[group_starts(state[better])]
        front = state[better]
        value[front], chosen[front] = image[better], rows[better]
        least = max(least, _LEAST * float(gain[better].max()))
        rows = np.unique(back.indices[concatenated_ranges(back.indptr[front], into[front])])
        count = matrix.indptr[rows + 1] - matrix.indptr[rows]
        left -= int(count.sum()) + _ROUND
        if left < 0 or not rows.size:
            return chosen
        entry = concatenated_ranges(matrix.indptr[rows], count)
        reads = matrix.data[entry] * value[matrix.indices[entry]]
        image = known[rows] + np.bincount(np.repeat(np.arange(rows.size), count), reads, rows.size)
