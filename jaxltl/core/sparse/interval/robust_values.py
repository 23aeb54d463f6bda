"""Questions to uncertain MDPs, and certified values of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.array_types import Floats
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure

_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Query:
    """Optimisation directions of policy and nature, and accuracy of the enclosure."""

    maximize: bool  # True if the policy maximises the value, else it minimises it
    nature_maximizes: bool  # the same of nature
    # requested width of the enclosure, of expected rewards relative to the value
    tolerance: float = 1e-6
    depth: int = 0  # roundings behind each number of the model

    @property
    def cooperative(self) -> bool:
        """True if policy and nature optimise in the same direction."""
        return self.maximize == self.nature_maximizes

    @property
    def opposite(self) -> Query:
        return replace(self, maximize=not self.maximize, nature_maximizes=not self.nature_maximizes)


@dataclass(frozen=True)
class RobustValues(Enclosure):
    """Certified values of an uncertain MDP, with choices of both sides."""

    probability: Floats  # float64[T], nature's distributions

    def hull(self, other: RobustValues) -> RobustValues:
        """The same values with bounds that enclose both enclosures."""
        return replace(
            self,
            lower=np.minimum(self.lower, other.lower),
            upper=np.maximum(self.upper, other.upper),
        )

    def complement(self) -> RobustValues:
        """Probabilities of the complement, rounded outwards; 0 and 1 stay exact."""
        lower, upper = (
            np.clip(np.where((x == 0) | (x == 1), 1 - x, 1 - x + side * 1e-16), 0, 1)
            for x, side in ((self.upper, -1), (self.lower, 1))
        )
        value = np.clip(1 - self.value, lower, upper)
        return replace(self, value=value, lower=lower, upper=upper)


def differences(model: UncertainMDP, value: Floats) -> Floats:
    """``x_t - x_s`` of each entry."""
    mdp = model.mdp
    return value[mdp.successor] - value[mdp.state[mdp.row]]


def row_gains(
    model: UncertainMDP, value: Floats, cost: Floats, *, nature_maximizes: bool
) -> tuple[Floats, Floats]:
    """Gains ``opt_p sum_t p_t (x_t - x_s) + c_r`` of the rows, and nature's distributions."""
    ahead = differences(model, value)
    p = model.extreme_distributions(ahead, maximize=nature_maximizes)
    return model.sum_rows(p * ahead) + cost, p


def gain_noise(value: Floats) -> Floats:
    """Gains that rounding can make."""
    size = np.abs(value)
    return 64 * _EPS * (size + float(size.max(initial=0)))


def distribution_depth(mdp: HostMDP) -> int:
    """Roundings that may stand behind nature's distributions."""
    return int(np.diff(mdp.entry_start).max()) + 4
