"""Sums whose sign is right and that are right in their leading digits, however much cancels.

By error-free additions (Knuth; Ogita, Rump and Oishi 2005), and by :func:`math.fsum` where these do
not tell a sum from zero.
"""

from __future__ import annotations

import math

import numpy as np

from jaxltl.core.array_types import Floats

_EPS = float(np.finfo(np.float64).eps)
SHARE = 2.0**-30  # by how much of itself a sum may be off


def exact_sum(terms: Floats, share: float = SHARE) -> Floats:
    """Sums over the first axis, ``float64[N]`` from ``float64[W, N]``; zero where they are zero.

    Args:
      terms: finite, none beyond 1e100.
      share: by how much of itself a sum may be off, besides its last rounding.
    """
    high = terms[0].copy()
    low, size = np.zeros_like(high), np.zeros_like(high)
    for x in terms[1:]:
        total = high + x
        part = total - high
        lost = (high - (total - part)) + (x - part)
        low += lost
        size += np.abs(lost)
        high = total
    found = high + low
    unsure = np.flatnonzero(share * np.abs(found) < len(terms) * _EPS * size)
    if unsure.size:
        found[unsure] = [math.fsum(x) for x in terms[:, unsure].T.tolist()]
    return found
