"""Qualitative analysis of interval MDPs: prob0 and prob1 states, and joint end components.

Nature may drop an edge with lower end 0 if the others can carry all mass, so the graph is a
game: nature *can stay* in a set of states (some distribution does), or a row *must enter* one
(every distribution does with positive probability).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.graph.qualitative import (
    SparseEndComponents,
    positive_under_all_policies,
    backward_reachable,
    shortest_path_rows,
)
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.rows import decrement, mask_of, row_entries, sorted_unique


def attractor_against_nature(
    model: UncertainMDP, goal: Booleans, *, all_rows: bool, rows: Booleans | None = None
) -> Booleans:
    """Positive-probability attractor of a goal against nature, under some or all policies."""
    if model.has_fixed_support:
        if all_rows and rows is None:
            return positive_under_all_policies(model.mdp, goal)
        if not all_rows:
            return backward_reachable(model.mdp, goal, rows)
    return _attractor(model, goal, all_rows, rows)[0]


def attracting_rows(model: UncertainMDP, goal: Booleans, rows: Booleans | None = None) -> Integers:
    """Rows that lead towards a goal against nature, ``int[S]``; elsewhere any row."""
    if model.has_fixed_support:
        rows = np.ones(model.mdp.num_rows, bool) if rows is None else rows
        return shortest_path_rows(model.mdp, goal, rows).astype(np.int64)
    return _attractor(model, goal, False, rows)[1]


def _attractor(
    model: UncertainMDP, goal: Booleans, all_rows: bool, rows: Booleans | None
) -> tuple[Booleans, Integers]:
    """The attractor, and rows by which states entered it."""
    mdp = model.mdp
    region = goal.copy()
    entering: Integers = mdp.row_start[:-1].astype(np.int64)
    waiting = np.ones(mdp.num_rows, bool) if rows is None else rows.copy()
    remaining = np.bincount(mdp.state[waiting], minlength=mdp.num_states)
    start, before = mdp.predecessors
    frontier: Integers = np.flatnonzero(region)
    while frontier.size:
        row = before[row_entries(start, frontier)[0]]
        row = sorted_unique(row[waiting[row]], mdp.num_rows)
        row = row[model.must_enter(row, region)]
        waiting[row] = False
        state = mdp.state[row]
        if all_rows:
            decrement(remaining, state)
            state = state[remaining[state] == 0]
        else:
            new = ~region[state]
            entering[state[new]] = row[new]
        frontier = sorted_unique(state[~region[state]], mdp.num_states)
        region[frontier] = True
    return region, entering


class ZeroOneStates(NamedTuple):
    """States with reachability probability 0 and 1, ``bool[S]`` each."""

    zero: Booleans
    one: Booleans


def zero_one_states(model: UncertainMDP, goal: Booleans, query: Query) -> ZeroOneStates:
    """The prob0 and prob1 states of a model in which the goal and its complement are absorbing."""
    mdp = model.mdp
    if query.nature_maximizes:
        zero = ~(backward_reachable if query.maximize else positive_under_all_policies)(mdp, goal)
    else:
        zero = ~attractor_against_nature(model, goal, all_rows=not query.maximize)
        if not query.maximize:
            return ZeroOneStates(zero, ~backward_reachable(mdp, zero))
    return ZeroOneStates(zero, almost_sure_states(model, goal, ~zero, query)[0])


def certain_choices(
    model: UncertainMDP, target: Booleans, known: ZeroOneStates, *, maximize: bool
) -> tuple[Integers, Booleans]:
    """Rows ``int[S]`` of the policy and entries ``bool[T]`` of nature that keep values 0 or 1."""
    mdp = model.mdp
    mine, other = (known.one, known.zero) if maximize else (known.zero, known.one)
    rows = ~mdp.support.some_successor_in(~mine) & mine[mdp.state]
    row = attracting_rows(model, target, rows) if maximize else mdp.first_choice(rows)[1]
    keeps = model.can_stay_in(other) & other[mdp.state]
    return row.astype(np.int64), other[mdp.successor] | ~keeps[mdp.row]


def almost_sure_states(
    model: UncertainMDP, goal: Booleans, inside: Booleans, query: Query
) -> tuple[Booleans, Booleans]:
    """Almost-sure states of a goal, and the rows that stay among them.

    The greatest set that can be kept and in which the goal is reached with positive probability, by
    the players that maximise against those that minimise (de Alfaro, Henzinger and Kupferman
    2007); not for two that minimise.
    """
    mdp, helps = model.mdp, query.nature_maximizes
    while True:
        # All states that cannot keep to the set leave it at once, not one step a round.
        inside = inside & ~(
            attractor_against_nature(model, ~inside, all_rows=query.maximize)
            if helps
            else positive_under_all_policies(mdp, ~inside)
        )
        kept = model.can_stay_in(inside) if helps else ~mdp.support.some_successor_in(~inside)
        if query.maximize:
            kept &= inside[mdp.state]
            reached = (
                backward_reachable(mdp, goal & inside, kept)
                if helps
                else attractor_against_nature(model, goal & inside, all_rows=False, rows=kept)
            )
        else:
            among = inside & ~mdp.states_of(~kept)
            reached = positive_under_all_policies(mdp, goal & inside, among=among)
        if (reached == inside).all():
            return inside, kept & inside[mdp.state]
        inside = reached


def preventing_choices(
    model: UncertainMDP, goal: Booleans, query: Query
) -> tuple[Integers, Booleans]:
    """Rows ``int[S]`` and entries ``bool[T]`` by which those that minimise prevent almost-sure states.

    Outside of :func:`almost_sure_states`, and with two that minimise outside of the prob1 states, the
    absorbing goal is then missed with positive probability: by the rows where the policy minimises,
    and by distributions whose support are the entries, where nature may keep to these.
    """
    mdp, both = model.mdp, not (query.maximize or query.nature_maximizes)
    source = mdp.state[mdp.row]
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    entries = np.ones(mdp.num_transitions, bool)
    inside = np.ones(mdp.num_states, bool)
    if both:
        inside = attractor_against_nature(model, goal, all_rows=True)
        row = np.where(inside, row, mdp.first_choice(model.can_stay_in(~inside))[1])
        entries = inside[source] | ~inside[mdp.successor]
        return np.where(inside, shortest_path_rows(mdp, ~inside, ~goal[mdp.state]), row), entries
    while True:
        if query.nature_maximizes:
            away, leaving = _attractor(model, ~inside, query.maximize, None)
            row = np.where(inside & away, leaving, row)
        else:
            away = positive_under_all_policies(mdp, ~inside)
        inside = inside & ~away
        if query.nature_maximizes:
            reached = positive_under_all_policies(mdp, goal & inside, among=inside)
            avoiding = mdp.first_choice(~mdp.support.some_successor_in(reached))[1]
            row = np.where(inside & ~reached, avoiding, row)
        else:
            kept = ~mdp.support.some_successor_in(~inside) & inside[mdp.state]
            reached = attractor_against_nature(model, goal & inside, all_rows=False, rows=kept)
            stuck = (inside & ~reached)[mdp.state] & kept
            entries &= ~(stuck[mdp.row] & reached[mdp.successor])
        if (reached == inside).all():
            return row, entries
        inside = reached


def joint_end_components(
    model: UncertainMDP, states: Booleans | None = None, entries: Booleans | None = None
) -> tuple[SparseEndComponents, Booleans]:
    """Maximal end components of policy and nature together."""
    mdp = model.mdp
    used = np.ones(mdp.num_transitions, bool) if entries is None else entries.copy()
    source = mdp.state[mdp.row]
    if states is not None:
        used &= states[mdp.successor] & states[source]
    while True:
        kept = model.can_stay_on(used)
        used &= kept[mdp.row]
        if not kept.any():
            return SparseEndComponents(np.arange(mdp.num_states), kept), used
        alive = mdp.states_of(kept)
        stays = ~_attractor(model, ~alive, True, kept)[0]
        now = used & stays[mdp.successor] & stays[source]
        label = strong_components(source[now], mdp.successor[now], mdp.num_states)
        now &= label[source] == label[mdp.successor]
        if (now == used).all():
            break
        used = now
    component = np.where(alive, label, np.arange(mdp.num_states))
    return SparseEndComponents(component, kept), used


class RobustRegion(NamedTuple):
    """States from which policy and nature together accept for ever, with their choices."""

    region: Booleans  # bool[S]
    row: Integers  # int[S], accepting rows inside the region
    probability: Floats  # float64[T], nature's distributions


def joint_accepting_region(model: UncertainMDP, priority: Integers) -> RobustRegion:
    """Joint end components with an even least priority; nature may drop entries of lesser ones."""
    mdp = model.mdp
    region = np.zeros(mdp.num_states, bool)
    row = mdp.row_start[:-1].astype(np.int64)
    chance = mdp.probability.copy()
    for p in np.unique(priority[priority % 2 == 0]):
        components, used = joint_end_components(model, ~region, priority >= p)
        hit = used & (priority == p)
        accepting = mask_of(components.component[mdp.state[mdp.row[hit]]], mdp.num_states)
        new = accepting[components.component] & components.region(mdp)
        if not new.any():
            continue
        region |= new
        some, first = mdp.first_choice(mask_of(mdp.row[hit], mdp.num_rows))
        keep = used & new[mdp.state[mdp.row]]
        inside = components.inside & new[mdp.state]
        way = model.resolve(np.where(keep | ~inside[mdp.row], chance, 0))
        row = np.where(new, np.where(some, first, shortest_path_rows(way, some, inside)), row)
        chance = np.where(inside[mdp.row], model.interior_distributions(keep), chance)
    return RobustRegion(region, row, chance)
