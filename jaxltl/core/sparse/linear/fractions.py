"""Optimal sums in fractions, for small systems that hardly ever end, beyond what floats can tell.

What the floats of the weights leave open is told by :mod:`jaxltl.core.sparse.linear.matrix_tree`.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.sparse.linear.matrix_tree import System

LARGEST = 1000  # unknowns
_OPERATIONS = 150_000  # on fractions, in one elimination
_BITS = 1024  # of numbers, from which an operation counts as more
_ROUNDS = 50


def exact_optimum(
    system: System, chosen: Integers, order: Integers, sign: int
) -> tuple[Floats, Integers] | None:
    """The optimum nearest to floats, and its rows, by policy iteration.

    Args:
      system: the equations.
      chosen: ``int[M]``, a policy that surely ends.
      order: ``int[M]``, in which unknowns are eliminated, the last first.
      sign: 1 for the largest, -1 for the smallest.

    Returns:
      The values, rounded to the nearest floats, and the rows; None where it takes too long.
    """
    rows = [_row(system, r) for r in range(system.owner.size)]
    chosen = np.array(chosen)
    for _ in range(_ROUNDS):
        value = _solved([rows[r] for r in chosen.tolist()], order.tolist())
        if value is None:
            return None
        better = _improved(rows, system.owner.tolist(), value, sign)
        if not better:
            return np.array([float(x) for x in value]), chosen
        for node, row in better.items():
            chosen[node] = row
    return None


class _Row(NamedTuple):
    total: Fraction
    known: Fraction
    weights: dict[int, Fraction]


def _row(system: System, row: int) -> _Row:
    matrix = system.matrix
    span = slice(matrix.indptr[row], matrix.indptr[row + 1])
    weights = {
        int(j): Fraction(float(w))
        for j, w in zip(matrix.indices[span], matrix.data[span], strict=True)
    }
    total = Fraction(float(system.leaving[row])) + sum(weights.values())
    return _Row(total, Fraction(float(system.known[row])), weights)


def _solved(rows: list[_Row], order: list[int]) -> list[Fraction] | None:
    """Elimination of one unknown after the other."""
    size, done = len(rows), 0
    weights = [dict(row.weights) for row in rows]
    total, known = [row.total for row in rows], [row.known for row in rows]
    into: list[set[int]] = [set() for _ in range(size)]
    for i, row in enumerate(weights):
        for j in row:
            into[j].add(i)
    for k in reversed(order):
        mine = weights[k]
        for j in mine:
            into[j].discard(k)
        if not total[k]:
            return None  # it never ends
        for i in into[k]:
            share = weights[i].pop(k) / total[k]
            known[i] += share * known[k]
            for j, w in mine.items():
                if j == i:
                    total[i] -= share * w
                else:
                    weights[i][j] = weights[i].get(j, Fraction(0)) + share * w
                    into[j].add(i)
            done += (len(mine) + 1) * (1 + share.denominator.bit_length() // _BITS)
            if done > _OPERATIONS:
                return None
    value = [Fraction(0)] * size
    for k in order:
        value[k] = (known[k] + sum(w * value[j] for j, w in weights[k].items())) / total[k]
    return value


def _improved(
    rows: list[_Row], owner: list[int], value: list[Fraction], sign: int
) -> dict[int, int]:
    """For each node whose policy can be bettered, its best row."""
    gain: dict[int, tuple[Fraction, int]] = {}
    for r, (row, i) in enumerate(zip(rows, owner, strict=True)):
        if not row.total:
            continue
        ahead = row.known + sum(w * value[j] for j, w in row.weights.items())
        more = sign * (ahead / row.total - value[i])
        if more > 0 and (i not in gain or more > gain[i][0]):
            gain[i] = more, r
    return {i: r for i, (_, r) in gain.items()}
