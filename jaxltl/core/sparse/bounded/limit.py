"""Bounds of step-bounded probabilities by the unbounded ones, for many steps."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.graph.qualitative import positive_under_all_policies
from jaxltl.core.sparse.interval import reachability as uncertain
from jaxltl.core.sparse.interval.qualitative import zero_one_states
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues, distribution_depth
from jaxltl.core.sparse.interval.total_reward import total_reward as uncertain_reward
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.reachability import reachability, total_reward
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure

_WIDTH = 2.5e-10  # of the unbounded probabilities, below the effect at which backups end


def unbounded_limit(
    game: RowGame, target: Booleans, undecided: Booleans, num_steps: int
) -> UnboundedLimit | _UncertainLimit:
    """Bounds ``float64[S]`` of the probability of reaching a target in n steps, for many steps.

    With T a bound on the expected time until the target or a state of value zero is met, from every
    state, a run has met neither after 2 T steps with probability at most 1/2 (Markov's inequality),
    and after n steps with at most ``2 ** -floor(n / ceil(2 T))``. The bounded probability is at
    most the unbounded one. Players who maximise may keep to their optimal choices of the unbounded
    problem. Against these the others cannot do better than avoid the target for ever from a state of
    value zero, once it is met: the value is lower than the unbounded one by at most that probability.
    """
    if game.is_mdp:
        maximize = bool(game.sole_direction)
        return UnboundedLimit(game.mdp, target, undecided, num_steps, maximize)
    encoded, query = game.encoded()
    source = encoded.source
    return _UncertainLimit(
        encoded.model, target[source], undecided[source], num_steps, query, target.size
    )


@dataclass(frozen=True)
class UnboundedLimit:
    """Bounds for an MDP."""

    mdp: HostMDP
    target: Booleans
    undecided: Booleans
    num_steps: int
    maximize: bool
    depth: int = 0  # roundings behind each number of the model

    @cached_property
    def unbounded(self) -> Enclosure:
        """The unbounded probability."""
        return reachability(
            self.mdp,
            self.target,
            maximize=self.maximize,
            stay=self.undecided | self.target,
            tolerance=_WIDTH,
            depth=self.depth,
        )

    @property
    def upper(self) -> Floats:
        return self.unbounded.upper

    @cached_property
    def lower(self) -> Floats:
        mdp = self.mdp
        if self.maximize and not mdp.is_chain:
            mdp = mdp.chain(self.unbounded.row)
        ended = ~self.undecided | ~positive_under_all_policies(
            mdp, self.target, among=self.undecided
        )
        one = np.ones(mdp.num_rows)
        time = total_reward(mdp, one, ended, maximize=True, tolerance=0.1, depth=self.depth)
        return self.unbounded.lower - _unfinished(time.upper, self.num_steps)


@dataclass(frozen=True)
class _UncertainLimit:
    """Bounds for the encoding of a game; its steps are at least those of the game."""

    model: UncertainMDP
    target: Booleans
    undecided: Booleans
    num_steps: int
    query: Query
    num_states: int  # of the game

    @cached_property
    def unbounded(self) -> RobustValues:
        """The unbounded probability."""
        query = replace(self.query, tolerance=_WIDTH)
        return uncertain.reachability(
            self.model, self.target, query, stay=self.undecided | self.target
        )

    @property
    def upper(self) -> Floats:
        return self.unbounded.upper[: self.num_states]

    @cached_property
    def lower(self) -> Floats:
        return self._lower()[: self.num_states]

    def _lower(self) -> Floats:
        part, chance = self.model, self.unbounded.probability
        if self.query.maximize:
            part, entry = part.under_policy(self.unbounded.row)
            chance = chance[entry]
        depth = self.query.depth + distribution_depth(part.mdp)
        if self.query.nature_maximizes:
            chance, able = part.nearest_distributions(chance)
            if not able:
                return np.zeros(self.target.size)
            fixed = part.resolve(chance)
            return UnboundedLimit(
                fixed, self.target, self.undecided, self.num_steps, maximize=False, depth=depth
            ).lower
        least = Query(False, False, tolerance=_WIDTH, depth=self.query.depth)
        value = uncertain.reachability(
            part, self.target, least, stay=self.undecided | self.target
        ).lower
        absorbing = part.with_absorbing(~self.undecided)[0]
        ended = ~self.undecided | zero_one_states(absorbing, self.target, least).zero
        longest = Query(True, True, tolerance=0.1, depth=self.query.depth)
        time = uncertain_reward(part, np.ones(part.mdp.num_rows), ended, longest).upper
        return value - _unfinished(time, self.num_steps)


def _unfinished(time: Floats, num_steps: int) -> float:
    """Bound of the probability that a run lasts n steps, from bounds of its expected time."""
    twice = max(2 * float(time.max()), 1)
    halvings = num_steps // math.ceil(twice) if twice < num_steps else 0
    return 2.0 ** -min(halvings, 1000)
