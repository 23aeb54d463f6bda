"""Optimality equations by what leads elsewhere, and how far their solutions err if weights do.

Each equation is written as ``sum_j w_j (x_i - x_j) + l_i x_i = c_i``, without what stays: then a
solution is a quotient of sums of products of the weights and costs (the matrix-tree theorem), so
that weights which err by a share of themselves make it err by no more than twice as many times
that share as there are unknowns, however long a run may take (O'Cinneide 1993).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from jaxltl.core.array_types import Floats, Integers


class System(NamedTuple):
    """Rows of an optimality equation.

    Attributes:
      matrix: ``float64[R, M]``, SciPy's, the weights, without self-loops.
      leaving: ``float64[R]``, the weight of what ends a run.
      known: ``float64[R]``, at least 0, the costs.
      owner: ``int[R]``, the unknown of a row.
    """

    matrix: Any
    leaving: Floats
    known: Floats
    owner: Integers


def share_of_values(share: float, num_unknowns: int) -> float:
    """The share by which the optimum errs, of policies that surely end, from that of the weights.

    A little more than ``2 (n + 1)`` times it, for the costs as well, which leaves room for powers:
    of a share of at most 1e-3 in all.
    """
    return share * (2.1 * (num_unknowns + 2))
