"""Rows of a model, the players that own its states, and nature's choice of distributions.

A Markov chain, an MDP, a game and an uncertain model are settings of one structure: each state has an
owner that maximises or minimises, or has a fixed distribution over its rows; each row has one
distribution, or a set of which nature picks one each time that the row is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.game_encoding import EncodedChoices, choices_as_nature
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts

_EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class RowGame:
    """A model's rows, with the direction in which each state's owner and nature optimise."""

    mdp: HostMDP
    maximizes: Booleans  # bool[S], the states of the maximising player
    sets: UncertainMDP | None = None  # the uncertainty sets of the rows; None where they are points
    nature_maximizes: bool = False
    weight: Floats | None = None  # float64[R], of the rows in states with a mixed policy
    mixed: Booleans | None = None  # bool[S], those states

    @cached_property
    def sole_direction(self) -> bool | None:
        """True or False if all choices maximise or minimise; None if there are two players."""
        own = self.maximizes[self._chooses]
        return True if own.all() else None if own.any() else False

    @property
    def is_mdp(self) -> bool:
        """True if there is one player, without nature and without a mixed policy."""
        alone = self.sole_direction is not None
        return alone and self.sets is None and self.mixed is None

    @property
    def _chooses(self) -> Booleans:
        """The states whose owner has a choice, ``bool[S]``."""
        several = np.diff(self.mdp.row_start) > 1
        return several if self.mixed is None else several & ~self.mixed

    @cached_property
    def unit(self) -> float:
        """Rounding error of one backup, including that of row sums.

        Relative to nonnegative values where rows are points. Relative to the largest number in
        uncertainty sets: a greedy distribution of n entries misses an extreme one by at most
        (3 n + 3) u of mass that is placed wrongly, by n u that is lost in the sum, and by the slack of
        :attr:`UncertainMDP.rounding`, 8 (n + 1) u, which counts as none; the product and its sum lose
        (n + 1) u. Backups are not expansive, so errors of several add up. A mixed policy has two sums
        of as many terms as rows, one of which divides.
        """
        width = int(np.diff(self.mdp.entry_start).max(initial=1))
        unit = self.mdp.backup_unit if self.sets is None else 16 * (width + 1) * _EPS
        rows = 0 if self.mixed is None else int(np.diff(self.mdp.row_start).max())
        return unit + (2 * rows + 4) * _EPS if rows else unit

    # --- players ----------------------------------------------------------------------------------

    def under(self, weight: Floats, states: Booleans) -> tuple[RowGame, Integers, Integers]:
        """The game under a policy of some states, and the original rows and entries.

        The weights ``float64[R]`` of a state are not negative; those of the policy's states count.
        """
        mdp, ruled = self.mdp, states[self.mdp.state]
        row = np.flatnonzero(~ruled | (weight > 0))
        count = np.bincount(mdp.state[row], minlength=mdp.num_states)
        start = offsets_from_counts(count)
        part, entry = mdp.select(start, row)
        sets = None if self.sets is None else self.sets.select_rows(start, row)[0]
        game = replace(self, mdp=part, sets=sets)
        mixed = states & (count > 1)
        if mixed.any():
            share = np.where(mixed[part.state], weight[row], 0)
            total = np.where(mixed, part.over_choices(np.add, share), 1)
            game = replace(game, weight=share / total[part.state], mixed=mixed)
        return game, row, entry

    def holds(self, rows: Booleans, *, surely: bool) -> Booleans:
        """States in which the chosen row is marked; of a mixed policy some row, or surely all."""
        mdp, some, sole = self.mdp, np.logical_or, self.sole_direction
        if self.mixed is None and sole is not None:
            return mdp.over_choices(some if sole else np.logical_and, rows)
        attains = self.maximizes if self.mixed is None else self.maximizes & ~self.mixed
        if self.mixed is not None and not surely:
            attains = attains | self.mixed
        every = mdp.over_choices(np.logical_and, rows)
        return np.where(attains, mdp.over_choices(some, rows), every)

    def entering(self, region: Booleans, *, surely: bool) -> Booleans:
        """Rows that enter a region with positive probability, or surely, under nature's choice."""
        leads = self.mdp.support.some_successor_in
        if self.sets is None or self.nature_maximizes != surely:
            return ~leads(~region) if surely else leads(region)
        return self.sets.can_stay_in(region) if surely else ~self.sets.can_stay_in(~region)

    def encoded(self) -> tuple[EncodedChoices, Query]:
        """The game as an uncertain MDP of one player, in which nature has the other one's choices."""
        mdp, helps, free = self.mdp, self.nature_maximizes, self._chooses
        sets = UncertainMDP(mdp, mdp.probability, mdp.probability)
        sets = sets if self.sets is None else self.sets
        own = free & (self.maximizes == helps)
        alone = bool((own == free).all())
        own &= not alone
        weight = np.zeros(mdp.num_rows) if self.weight is None else self.weight
        states = own if self.mixed is None else own | self.mixed
        model = choices_as_nature(sets, states, weight, np.where(own[mdp.state], 1.0, weight))
        return model, Query(helps == alone, helps)
