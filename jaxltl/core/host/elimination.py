"""Systems ``(I - P) x = b`` of policies that leave, solved by sparse elimination where it pays.

Unknowns are ordered by strongly connected component, so that elimination fills at most these, and
in each by Cuthill and McKee (1969). Where even that would fill (graphs that mix well), Krylov steps
and sweeps converge.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.host.rows import Integers
from jaxltl.core.host.sparse import Floats

_SMALL = 3000  # states of a component up to which it may be filled
_SPREAD = 8  # how many times its mean bandwidth a larger one must have states
_FILL = 4  # growth of the fill after which the order is sought anew
_KRYLOV = 500  # steps of a Krylov method where elimination would fill
_SWEEPS = 20_000  # and sweeps after it
_LEFT = 1e-14  # largest residual of what they find, as a share of the right side


class Factors(NamedTuple):
    """The system of a policy, ready to be solved.

    Attributes:
      rows: ``float64[R, M]``, all rows, SciPy's.
      label: ``int[M]``, components in order.
      order: ``int[M]``, or None where it is swept.
      matrix: ``float64[M, M]``, the policy's, in that order if there is one.
      factor: of SuperLU, or None.
      fill: of the first factors in this order.
    """

    rows: Any
    label: Integers
    order: Integers | None
    matrix: Any
    factor: Any
    fill: int

    @property
    def method(self) -> str:
        """How it is solved, in words."""
        return "policy iteration by " + ("sweeps" if self.order is None else "elimination")

    def solve(self, b: Floats) -> Floats:
        """The solution; NaN where it could not be found."""
        if self.order is None:
            return _swept(self.matrix, b)
        x = np.empty(b.size)
        x[self.order] = self.factor.solve(b[self.order], trans="T")
        return x

    def other(self, chosen: Integers) -> Factors | None:
        """The same for another policy."""
        if self.order is None:
            return self._replace(matrix=self.rows[chosen])
        found = _factored(self.rows, self.label, self.order, chosen)
        if found is not None and found.fill > _FILL * self.fill:
            return factors(self.rows, self.label, chosen)
        return None if found is None else found._replace(fill=self.fill)


def factors(rows: Any, label: Integers, chosen: Integers) -> Factors | None:
    """The system of a policy.

    Args:
      rows: ``float64[R, M]``, SciPy's.
      label: ``int[M]``, numbers of components; no row leads to a greater one.
      chosen: ``int[M]``, the row of each state.

    Returns:
      Its factors; None where it is singular.
    """
    matrix = rows[chosen]
    order = order_of(matrix, label)
    if order is None:
        return Factors(rows, label, None, matrix, None, 0)
    return _factored(rows, label, order, chosen)


def order_of(matrix: Any, label: Integers) -> Integers | None:
    """By component, and in each one after its neighbours; None where that would not help."""
    from scipy.sparse import csgraph

    size = np.bincount(label)
    if size.max(initial=0) <= 1:
        return np.argsort(label, kind="stable")
    source = np.repeat(np.arange(label.size), np.diff(matrix.indptr))
    between = label[source] != label[matrix.indices]
    into, out_of = (int(size[label[x[between]]].sum()) for x in (matrix.indices, source))
    within = matrix.copy()
    within.data[between] = 0
    within.eliminate_zeros()
    both = (within + within.T).tocsr()
    order = csgraph.reverse_cuthill_mckee(both, symmetric_mode=True)
    order = order[np.argsort(label[order], kind="stable")]
    large = size[label] > _SMALL
    if large.any():
        place = np.empty(label.size, np.int64)
        place[order] = np.arange(label.size)
        source = np.repeat(np.arange(label.size), np.diff(both.indptr))
        furthest = np.zeros(label.size, np.int64)
        np.maximum.at(furthest, source, place[source] - place[both.indices])
        largest = label == size.argmax()
        if furthest[largest].mean() * _SPREAD > np.count_nonzero(largest):
            return None
    # What leads from one component to another fills, of the two, the one that stands first.
    return order[::-1] if out_of < into else order


def _factored(rows: Any, label: Integers, order: Integers, chosen: Integers) -> Factors | None:
    from scipy.sparse import linalg

    place = np.empty(order.size, np.int32)
    place[order] = np.arange(order.size, dtype=np.int32)
    matrix = rows[chosen[order]]
    matrix.indices = place[matrix.indices]
    matrix.has_sorted_indices = False
    try:
        factor = linalg.splu(
            _minus(matrix).T, permc_spec="NATURAL", diag_pivot_thresh=0,
            options={"SymmetricMode": True})
    except (RuntimeError, MemoryError):
        return None
    return Factors(rows, label, order, matrix, factor, int(factor.nnz))


def _minus(matrix: Any) -> Any:
    from scipy import sparse

    found = (sparse.eye_array(matrix.shape[0], format="csr") - matrix).tocsr()
    found.sort_indices()
    return found


def _swept(matrix: Any, b: Floats) -> Floats:
    """By a Krylov method (van der Vorst 1992), and by sweeps as long as what is left shrinks."""
    from scipy.sparse import linalg

    size = np.abs(b).max(initial=0)
    system = linalg.LinearOperator(matrix.shape, matvec=lambda x: x - matrix @ x, dtype=float)
    x, _ = linalg.bicgstab(system, b, rtol=0, atol=_LEFT * size, maxiter=_KRYLOV)
    left = b - (x - matrix @ x)
    if not np.isfinite(x).all() or np.abs(left).max() > size:
        x, left = np.zeros(b.size), np.array(b)
    for _ in range(_SWEEPS):
        if np.abs(left).max(initial=0) <= _LEFT * size:
            return x
        x = x + left
        left = matrix @ left
    return np.full(b.size, np.nan)
