"""BiCGSTAB (van der Vorst 1992) for linear systems ``x = P x + b``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jaxltl.core.array_types import Floats, SparseMatrix

_RESTARTS = 3
_NOISE = 32 * float(np.finfo(np.float64).eps)


def bicgstab(
    matrix: SparseMatrix,
    b: Floats,
    x: Floats,
    residual: float,
    *,
    steps: int,
    precondition: Callable[[Floats], Floats] | None = None,
) -> Floats | None:
    """``x = P x + b`` from a guess, restarted at breakdown; None if it does not converge."""
    size = float(np.abs(b).max(initial=0) + np.abs(x).max(initial=0))
    residual = max(residual, _NOISE * size)
    with np.errstate(all="ignore"):
        for _ in range(1 if precondition else _RESTARTS):
            new = iterate(matrix, b, x, residual, steps, precondition)
            r = np.abs(b - (new - matrix @ new)).max(initial=0)
            if r <= 2 * residual:
                return new
            if not np.isfinite(r):
                return None
            x = new
    return None


def iterate(
    matrix: SparseMatrix,
    b: Floats,
    x: Floats,
    residual: float,
    steps: int,
    precondition: Callable[[Floats], Floats] | None = None,
) -> Floats:
    """At most some steps from a guess, up to a residual or a breakdown."""
    r = b - (x - matrix @ x)
    shadow, rho, p = r, _dot(r, r), r
    for _ in range(steps):
        if not rho or np.abs(r).max() <= residual:
            break
        y = precondition(p) if precondition else p
        v = y - matrix @ y
        turned = _dot(shadow, v)
        if not turned:
            break
        alpha = rho / turned
        s = r - alpha * v
        z = precondition(s) if precondition else s
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
    # Not BLAS: its threads cost more than the sum.
    return float(np.einsum("i,i->", x, y))
