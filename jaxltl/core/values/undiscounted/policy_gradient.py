"""Policy gradient of the satisfaction probability, for policies with full support, on the host.

The probability y of the undecided states solves ``y = P_pi y + b``, and its mean over the initial
states has the derivative ``d(s) (P y)(s, a)`` in ``pi(s, a)``, where d are the expected visits
(Sutton et al. 2000). Both are sparse linear systems with one matrix, solved in double precision
without a certificate.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.graphs.end_components import accepting_bottom_components
from jaxltl.core.graphs.graph import graph_of
from jaxltl.core.graphs.attractor import policy_sets
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.values.engine.host_solution import induced_chain
from jaxltl.core.values.engine.row_form import on_actions, rows_of

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU

_OUTSIDE = 1e-9  # of [0, 1], beyond which a solution is not a probability


def transient_factors(chain: HostMDP, inner: Booleans) -> SuperLU:
    """LU factors of ``I - P`` among the states `inner` of a chain that leaves them."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    among = np.flatnonzero(inner)
    step = chain.matrix[among][:, among]
    return splu((sparse.eye_array(among.size) - step).tocsc())


@dataclass(frozen=True)
class FullSupport:
    """The satisfaction probability of policies that take each available action sometimes."""

    model: Product
    over: str  # initial states, their "mean" or the "worst"

    @cached_property
    def sets(self) -> tuple[Floats, Booleans]:
        """``float[N]``, 1 where the target is reached almost surely, and undecided ``bool[N]``."""
        model, available = self.model, np.asarray(self.model.available)
        if not model.automaton.has_final_states:
            target = np.asarray(accepting_bottom_components(model, to_jax(available)))
        else:
            target = np.asarray(model.final) != model.automaton.is_safety
        sets = policy_sets(graph_of(model), target, available)
        one, zero = (np.asarray(x).ravel() for x in sets[:2])
        return one.astype(float), ~(one | zero)

    def probability(self, policy: np.ndarray) -> tuple[float, Floats]:
        """The probability and its derivative ``float[S, Q, A]``; NaN if they are not solved."""
        model, sparse = self.model, rows_of(self.model)
        (value, undecided), start = self.sets, np.asarray(model.initial, float).ravel()
        visits, failed = np.zeros(value.size), (np.nan, np.full(policy.shape, np.nan))
        if undecided.any():
            chain = induced_chain(model, policy).mdp
            try:
                factors = transient_factors(chain, undecided)
            except RuntimeError:  # singular: rounding makes it impossible to leave
                return failed
            solved = factors.solve((chain.matrix @ value)[undecided])
            if not ((solved >= -_OUTSIDE) & (solved <= 1 + _OUTSIDE)).all():
                return failed
            value = value.copy()
            value[undecided] = solved
        if self.over == "worst":
            starts = np.flatnonzero(start)
            pick = np.argmin if not model.automaton.is_safety else np.argmax
            start = np.eye(1, start.size, starts[pick(value[starts])])[0]
        start = start / start.sum()
        if undecided.any():
            visits[undecided] = factors.solve(start[undecided], "T")
        rows = visits[sparse.host.state] * sparse.host.expectation(value)
        slope: Floats = on_actions(sparse, rows, model)
        mean = float(start @ value)
        return (1 - mean, -slope) if model.automaton.is_safety else (mean, slope)
