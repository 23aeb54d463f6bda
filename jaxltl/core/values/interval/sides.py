"""The sides of a question about intervals and games: who chooses, and in which direction.

One policy and one nature choose in the model that is solved. A second player joins the side that has its
direction: its choices of rows become choices of nature, or nature's player keeps the rows and the other
one becomes nature (:func:`~jaxltl.core.sparse.interval.game_encoding.choices_as_nature`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.game_encoding import EncodedChoices, choices_as_nature
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP

TOLERANCE = 1e-6


class PlayerAims(NamedTuple):
    """What each side does to the value: True if it maximises."""

    system: bool
    environment: bool
    nature: bool


def require_objective(objective: str) -> str:
    """The objective; ValueError unless it is ``"max"`` or ``"min"``."""
    return validation.choice("objective", objective, ("max", "min"))


def nature_direction(nature: str | None, objective: str) -> str:
    """``"max"`` or ``"min"``, the direction in which nature optimises."""
    return "max" if directions(objective, nature).nature else "min"


def directions(
    objective: str, nature: str | None = None, environment: str | None = None
) -> PlayerAims:
    """The directions of an objective of the system, against or with nature and the environment."""
    system = require_objective(objective) == "max"
    sides = []
    for name, side in (("environment", environment), ("nature", nature)):
        known = validation.choice(
            name, "adversarial" if side is None else side, ("adversarial", "cooperative")
        )
        sides.append(system == (known == "cooperative"))
    return PlayerAims(system, *sides)


def requested_width(tolerance: object) -> float:
    """The width of the enclosure: `tolerance`, or the default."""
    if tolerance is None:
        return TOLERANCE
    validation.require_in_range("tolerance", tolerance)
    return float(tolerance)  # type: ignore[arg-type]


def refuse_nature(nature: str | None) -> None:
    """Raises ValueError if `nature` is given for a model without uncertainty sets."""
    if nature is not None:
        raise ValueError(
            f"nature={nature!r} is for models with intervals (make_interval); the "
            "probabilities of this one are given. Leave it out."
        )


def refuse_environment(environment: str | None) -> None:
    """Raises ValueError if `environment` is given for a model of one player."""
    if environment is not None:
        raise ValueError(
            f"environment={environment!r} is for games (make_game); one player chooses here. "
            "Leave it out."
        )


class Sides(NamedTuple):
    """An uncertain MDP with the directions of policy and nature."""

    maximize: bool  # whether the policy maximises
    helpful: bool  # whether nature maximises
    encoded: EncodedChoices  # the model in which a policy and nature choose, and its origin

    @property
    def host(self) -> UncertainMDP:
        return self.encoded.model

    def query(self, tolerance: float) -> Query:
        return Query(self.maximize, self.helpful, tolerance)

    def is_mixed(self, probability: Floats) -> bool:
        """True if nature, as one of the players, mixes rows."""
        mdp, chosen = self.host.mdp, probability > 0
        several = np.add.reduceat(chosen.astype(np.int64), mdp.entry_start[:-1]) > 1
        return bool((several & self.choosing).any())

    @property
    def choosing(self) -> Booleans:
        """Rows ``bool[R']`` by which nature chooses among rows, without a step."""
        return self.encoded.row < 0

    @property
    def added(self) -> Booleans:
        """Auxiliary states, ``bool[S']``."""
        result: Booleans = self.encoded.source != np.arange(self.encoded.source.size)
        return result

    def states(self, quantity: Booleans) -> Booleans:
        """A set of states ``bool[S']``, without auxiliary ones."""
        result: Booleans = quantity[self.encoded.source] & ~self.added
        return result


def pure_rows(
    host: UncertainMDP,
    system: Booleans,
    aims: PlayerAims,
    probability: Floats,
    solve: Callable[[Sides], RobustValues],
) -> Integers:
    """The system's rows ``int[S]`` where it is part of nature, against the environment.

    Nature's distribution over rows may mix them, where the graph decides a value, and the most likely
    one alone need not attain it. With nature's distributions of successors fixed the system's rows are
    a policy of their own, and a pure one attains what the mixed one does.
    """
    fixed = host.resolve(probability)
    sets = UncertainMDP(fixed, fixed.probability, fixed.probability)
    against = aims._replace(nature=aims.environment)
    sides = sides_of(sets, system, against)
    values = solve(sides)
    return sides.encoded.policy(values.row, values.probability)


def sides_of(
    host: UncertainMDP, system: Booleans | None, aims: PlayerAims, weights: Floats | None = None
) -> Sides:
    """The sides of a model, in a game with the states ``bool[S]`` of the system.

    With `weights` ``float64[R]`` the rows are mixed by them in all states, or in those of the system.
    """
    if system is not None and weights is None and aims.environment == aims.system:
        system = None
    if weights is not None:
        return _under(host, system, aims, weights)
    if system is None:
        return Sides(aims.system, aims.nature, _rows_of(host, np.arange(host.mdp.num_rows)))
    # The player with nature's direction becomes nature where it has a choice; the rest is the policy's.
    rows = np.ones(host.mdp.num_rows)
    moved = (system if aims.system == aims.nature else ~system) & (np.diff(host.mdp.row_start) > 1)
    return Sides(not aims.nature, aims.nature, choices_as_nature(host, moved, 0 * rows, rows))


def _under(host: UncertainMDP, system: Booleans | None, aims: PlayerAims, weights: Floats) -> Sides:
    # The remaining choices are those of the environment.
    maximize = aims.nature if system is None else aims.environment
    own = np.ones(host.mdp.num_states, bool) if system is None else system
    if own.all() and np.isin(weights, (0, 1)).all():
        return Sides(maximize, aims.nature, _rows_of(host, np.flatnonzero(weights)))
    total = host.mdp.over_choices(np.add, weights)
    weights = weights / np.where(total > 0, total, 1)[host.mdp.state]
    return Sides(maximize, aims.nature, choices_as_nature(host, own, weights, weights))


def _rows_of(host: UncertainMDP, row: Integers) -> EncodedChoices:
    """The model, or a chain of one row for each state, without choices of nature."""
    model: UncertainMDP = host
    entry: Integers = np.arange(host.mdp.num_transitions)
    if row.size < host.mdp.num_rows:
        model, entry = host.under_policy(row)
    return EncodedChoices(model, np.arange(host.mdp.num_states), row, entry, 0 * entry - 1)
