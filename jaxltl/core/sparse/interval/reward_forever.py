"""Certified expected total rewards of uncertain MDPs over the infinite horizon."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable, end_components
from jaxltl.core.sparse.interval.qualitative import attracting_rows
from jaxltl.core.sparse.interval.robust_values import Query, RobustValues
from jaxltl.core.sparse.interval.total_reward import total_reward
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts, row_entries


def reward_forever(model: UncertainMDP, reward: Floats, query: Query) -> RobustValues:
    """Optimal expected total reward where nature gives each successor some mass; rewards are at least 0.

    The graph is then that of the MDP. A minimum is the reward until an end component without rewards, in which
    the policy stays. A maximum is infinite where an end component with a reward is reached with some probability;
    elsewhere it is the reward until an end, to which the policy may go from all end components.

    Raises:
      ValueError: nature may drop a successor, or rows have L1 balls.
    """
    if not model.has_fixed_support or model.ball is not None:
        raise ValueError(
            "total rewards over the infinite horizon are solved for intervals without L1 balls whose lower ends are "
            "positive, so that nature cannot drop a successor; give a target or positive lower ends."
        )
    return _largest(model, reward, query) if query.maximize else _least(model, reward, query)


def _least(model: UncertainMDP, reward: Floats, query: Query) -> RobustValues:
    mdp = model.mdp
    inside = end_components(mdp, rows=reward == 0).inside
    ends, row = mdp.first_choice(inside)
    values = total_reward(model, reward, ends, query)
    return replace(values, row=np.where(ends, row, values.row))


def _largest(model: UncertainMDP, reward: Floats, query: Query) -> RobustValues:
    mdp, end = model.mdp, model.mdp.num_states
    component, inside = end_components(mdp)
    member, earning = mdp.states_of(inside), mdp.states_of(inside & (reward > 0))
    infinite = backward_reachable(mdp, earning)
    # The choices that leave a component are those of its first state, to which the others lead.
    chief = np.arange(end + 1)
    held = member & ~infinite
    _, first, number = np.unique(component[held], return_index=True, return_inverse=True)
    chief[:-1][held] = np.flatnonzero(held)[first][number]
    kept: Integers = np.flatnonzero(~inside & ~infinite[mdp.state])
    added: Integers = np.flatnonzero(np.append(held | infinite, True))
    follows = chief[added] != added
    state = np.concatenate([chief[mdp.state[kept]], added])
    order = np.argsort(state, kind="stable")
    entry, count = row_entries(mdp.entry_start, kept)
    starts = offsets_from_counts(np.concatenate([count, np.ones_like(added)]))
    place, width = row_entries(starts, order)

    def entries(old: Floats | Integers, new: Floats | Integers) -> np.ndarray:
        return np.concatenate([old[entry], new])[place]

    one = np.ones(added.size)
    host = HostMDP(
        offsets_from_counts(np.bincount(state, minlength=end + 1)),
        offsets_from_counts(width),
        entries(mdp.successor, np.where(follows, chief[added], end)).astype(np.int32),
        entries(mdp.probability, one),
    )
    larger = UncertainMDP(host, entries(model.lower, one), entries(model.upper, one))
    cost = np.concatenate([reward[kept], np.zeros(added.size)])[order]
    values = total_reward(larger, cost, np.arange(end + 1) == end, query)
    value, lower, upper = (
        np.where(infinite, np.inf, x[:-1]) for x in (values.value, values.lower, values.upper)
    )
    chosen = order[values.row[:-1]]
    leaves: Booleans = (chosen < kept.size) & ~infinite
    row = _policy(model, kept[chosen[leaves]], component, inside, reward)
    chance, old = mdp.probability.copy(), place < entry.size
    chance[entry[place[old]]] = values.probability[old]
    return replace(values, value=value, lower=lower, upper=upper, row=row, probability=chance)


def _policy(
    model: UncertainMDP, leaving: Integers, component: Integers, inside: Booleans, reward: Floats
) -> Integers:
    """Rows ``int[S]`` that leave components by the given rows, and earn for ever where that is possible."""
    mdp = model.mdp
    earning, earning_row = mdp.first_choice(inside & (reward > 0))
    finite = ~backward_reachable(mdp, earning)
    goal = earning.copy()
    goal[mdp.state[leaving]] = True
    stays = mdp.states_of(inside) & (finite | np.isin(component, component[earning]))
    row = np.where(stays, attracting_rows(model, goal, inside), attracting_rows(model, earning))
    row = np.where(earning, earning_row, row).astype(np.int64)
    row[mdp.state[leaving]] = leaving
    return row
