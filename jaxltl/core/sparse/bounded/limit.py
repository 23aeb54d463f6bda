"""Bounds of step-bounded probabilities by the unbounded ones, for many steps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.graph.qualitative import positive_under_all_policies
from jaxltl.core.sparse.interval import reachability as uncertain
from jaxltl.core.sparse.interval.qualitative import zero_one_states
from jaxltl.core.sparse.interval.robust_values import Query, distribution_depth
from jaxltl.core.sparse.interval.total_reward import total_reward as uncertain_reward
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers.reachability import reachability, total_reward

_WIDTH = 2.5e-10  # of the unbounded probabilities, below the effect at which backups end


def unbounded_limit(
    game: RowGame, target: Booleans, undecided: Booleans, num_steps: int
) -> tuple[Floats, Floats]:
    """Bounds ``float64[S]`` of the probability of reaching a target in n steps, for many steps.

    With T a bound on the expected time until the target or a state of value zero is met, from every
    state, a run has met neither after 2 T steps with probability at most 1/2 (Markov's inequality),
    and after n steps with at most ``2 ** -floor(n / ceil(2 T))``. The bounded probability is at
    most the unbounded one. Maximising players may keep to their optimal choices of the unbounded
    problem. Against these the others cannot do better than avoid the target for ever from a state of
    value zero, once it is met: the value is lower than the unbounded one by at most that probability.
    """
    if game.is_mdp:
        maximize = bool(game.sole_direction)
        return _of_mdp(game.mdp, target, undecided, num_steps, Query(maximize, maximize))
    encoded, query = game.encoded()  # its runs have at least as many steps
    source = encoded.source
    lower, upper = _of_sets(encoded.model, target[source], undecided[source], num_steps, query)
    return lower[: target.size], upper[: target.size]


def _of_mdp(
    mdp: HostMDP, target: Booleans, undecided: Booleans, num_steps: int, query: Query
) -> tuple[Floats, Floats]:
    best = reachability(
        mdp,
        target,
        maximize=query.maximize,
        stay=undecided | target,
        tolerance=_WIDTH,
        depth=query.depth,
    )
    if query.maximize and not mdp.is_chain:
        mdp = mdp.chain(best.row)
    ended = ~undecided | ~positive_under_all_policies(mdp, target, among=undecided)
    one = np.ones(mdp.num_rows)
    time = total_reward(mdp, one, ended, maximize=True, tolerance=0.1, depth=query.depth)
    return best.lower - _unfinished(time.upper, num_steps), best.upper


def _of_sets(
    model: UncertainMDP, target: Booleans, undecided: Booleans, num_steps: int, query: Query
) -> tuple[Floats, Floats]:
    stay, query = undecided | target, replace(query, tolerance=_WIDTH)
    best = uncertain.reachability(model, target, query, stay=stay)
    chance = best.probability
    if query.maximize:
        model, entry = model.under_policy(best.row)
        chance = chance[entry]
    least = Query(False, False, tolerance=_WIDTH)
    if query.nature_maximizes:
        chance, able = model.nearest_distributions(chance)
        if not able:
            return np.zeros(target.size), best.upper
        least = replace(least, depth=distribution_depth(model.mdp))
        fixed = model.resolve(chance)
        return _of_mdp(fixed, target, undecided, num_steps, least)[0], best.upper
    value = uncertain.reachability(model, target, least, stay=stay).lower
    absorbing = model.with_absorbing(~undecided)[0]
    ended = ~undecided | zero_one_states(absorbing, target, least).zero
    longest = Query(True, True, tolerance=0.1)
    time = uncertain_reward(model, np.ones(model.mdp.num_rows), ended, longest).upper
    return value - _unfinished(time, num_steps), best.upper


def _unfinished(time: Floats, num_steps: int) -> float:
    """Bound of the probability that a run lasts n steps, from bounds of its expected time."""
    twice = max(2 * float(time.max()), 1)
    halvings = num_steps // math.ceil(twice) if twice < num_steps else 0
    return 2.0 ** -min(halvings, 1000)
