"""Bounds beyond double precision for policy and nature, where runs take very long.

A value in one float satisfies no optimality equation more accurately than its own rounding
``u |x|``, so a proof by one application of the operator needs an extra of at least ``u |x|`` in
each step, which costs ``u |x| T`` in a run of T steps. Here values are kept in two floats (as in
:mod:`jaxltl.core.sparse.linear.extended_precision`), found by iterative refinement (Wilkinson 1963).
Their differences are right to two roundings, so the operator errs only by a share of the flows
``p_t |x_t - x_s|``, and these are small wherever a run lingers. The extra of a step is a multiple of
that error, plus a tiny share of the distance from the largest possible value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jaxltl.core.array_types import Floats
from jaxltl.core.sparse.interval.row_operator import PairSystem, PolicyPair, RowOperator, TwoFloats
from jaxltl.core.sparse.linear.extended_precision import two_sum

if TYPE_CHECKING:
    from scipy.sparse import csr_array

_ROUNDS = 30  # policies
_STEPS = 16  # of iterative refinement
_SHARE = 0.05  # of the tolerance that the proportional extras of all steps take
_MOST = 0.3  # and that they may take before their share is reduced
_ERRORS = 4  # extra of a step, in rounding errors of its row
_NARROW = 0.4  # share of the tolerance that a bound may be from the value
_LEAST = 2.0**-80  # smallest share of a proportional extra
_FLOOR = 1e-8  # of the distance that it is a share of, as a share of the largest value

Solver = Callable[["csr_array", Floats], Floats | None]


@dataclass(frozen=True)
class Refinement:
    """Settings of a refinement."""

    solve: Solver  # solves x = P x + b in double precision
    tolerance: float  # absolute distance that a bound may have from the other one

    def bound(self, operator: RowOperator, pair: PolicyPair, side: int) -> PolicyPair | None:
        """A pair with an upper bound of all pairs (side 1), or with one that it attains (-1)."""
        share = np.inf
        for _ in range(_ROUNDS):
            system = operator.system(pair)
            value = None if system is None else self._value(operator, pair, system)
            if system is None or value is None:
                return None
            extra = self._extra(operator, pair, system, value, share)
            if extra is None:
                return None
            share, step, cost = extra
            high, lost = two_sum(value.high, side * cost)
            z = TwoFloats(*two_sum(high, lost + value.low))
            proven = self._proven(operator, pair, z, side)
            if proven is not None:
                narrow = cost.max(initial=0) <= _NARROW * self.tolerance
                return replace(proven, value=value.high) if narrow else None
            better, _ = operator.improve(pair, z, side * step)
            same = (better.chosen == pair.chosen).all() and all(
                np.array_equal(p, q) for p, q in zip(better.p, pair.p, strict=True)
            )
            if same:
                return None
            pair = better
        return None

    def _value(
        self, operator: RowOperator, pair: PolicyPair, system: PairSystem
    ) -> TwoFloats | None:
        """The values of a pair, by iterative refinement."""
        high = self.solve(system.matrix, system.earned)
        if high is None:
            return None
        value, last = TwoFloats(high, np.zeros_like(high)), float(np.abs(high).max(initial=0))
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                more = self.solve(system.matrix, operator.residual(pair, value))
                step = np.inf if more is None else float(np.abs(more).max(initial=0))
                if more is None or not step < last / 2:  # also if NaN
                    break
                high, lost = two_sum(value.high, more)
                value, last = TwoFloats(*two_sum(high, value.low + lost)), step
        return value if np.isfinite(value.high).all() else None

    def _extra(
        self,
        operator: RowOperator,
        pair: PolicyPair,
        system: PairSystem,
        value: TwoFloats,
        share: float,
    ) -> tuple[float, Floats, Floats] | None:
        """Proportional extra of a step, its share, and extras of whole runs; None if unknown."""
        size = max(np.abs(value.high).max(initial=0), np.abs(operator.known).max(initial=0))
        weight = np.full(operator.size, size)
        if np.isfinite(operator.ceiling):
            weight = np.maximum(operator.ceiling - value.high, _FLOOR * size)
        steps = self.solve(system.matrix, weight)
        if steps is None or not (steps >= 0).all():
            return None
        # A smaller extra lets the next pair linger longer, so it shrinks only where it has to.
        if share * steps.max() > _MOST * self.tolerance:
            share = max(_SHARE * self.tolerance / steps.max(), _LEAST)
        errors, leaving = operator.row_errors(pair, value)
        cost = self.solve(system.matrix, share * weight + _ERRORS * errors / leaving)
        if cost is None or not (cost >= 0).all():
            return None
        return share, share * weight, cost

    @staticmethod
    def _proven(
        operator: RowOperator, pair: PolicyPair, z: TwoFloats, side: int
    ) -> PolicyPair | None:
        if side > 0:
            p = operator.proves_upper_bound(z)
            if p is None:
                return None
            pair = replace(pair, p=p) if operator.adversarial else pair
        elif not operator.proves_attained(z, pair):
            return None
        return replace(pair, bound=np.nextafter(z.high + z.low, side * np.inf))
