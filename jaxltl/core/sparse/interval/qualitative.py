"""What is certain of intervals, whatever nature picks or as it pleases: sets decided on supports.

Nature may take an edge away where its lower end is 0, if the others can carry all mass. So the
graph is a game: a row may *keep* to a set of states (some distribution does), or it *must enter*
one (every distribution does with positive probability).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.graph.qualitative import (
    EndComponents,
    positive_under_all_policies,
    backward_reachable,
    shortest_path_rows,
)
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.rows import decrement, sorted_unique, concatenated_ranges


def compelled(
    model: HostInterval, goal: Booleans, *, every: bool, rows: Booleans | None = None
) -> Booleans:
    """The states from which a goal is reached with positive probability against nature.

    The least set with the goal and with each state some row of which (all of whose rows) must
    enter it.

    Args:
      model: the model.
      goal: ``bool[S]``.
      every: whether all rows must, else some.
      rows: ``bool[R]``, the rows that may be taken; default all.
    """
    if model.firm:  # the graph is the same whatever nature picks
        if every and rows is None:
            return positive_under_all_policies(model.mdp, goal)
        if not every:
            return backward_reachable(model.mdp, goal, rows)
    return _compelled(model, goal, every, rows)[0]


def attracting(model: HostInterval, goal: Booleans, rows: Booleans | None = None) -> Integers:
    """Rows by which states must come nearer to a goal against nature: ``int[S]``.

    Any row at the goal, and where it cannot be forced.

    Args:
      model, goal, rows: as of :func:`compelled`.
    """
    if model.firm:
        rows = np.ones(model.mdp.num_rows, bool) if rows is None else rows
        return shortest_path_rows(model.mdp, goal, rows).astype(np.int64)
    return _compelled(model, goal, False, rows)[1]


def _compelled(
    model: HostInterval, goal: Booleans, every: bool, rows: Booleans | None
) -> tuple[Booleans, Integers]:
    """The states of :func:`compelled`, and rows that make it so."""
    mdp = model.mdp
    region = goal.copy()
    found: Integers = mdp.row_start[:-1].astype(np.int64)
    waiting = np.ones(mdp.num_rows, bool) if rows is None else rows.copy()
    left = np.bincount(mdp.state[waiting], minlength=mdp.num_states)
    start, before = mdp.predecessors
    frontier: Integers = np.flatnonzero(region)
    while frontier.size:
        row = before[concatenated_ranges(start[frontier], start[frontier + 1] - start[frontier])]
        row = sorted_unique(row[waiting[row]], mdp.num_rows)
        row = row[model.must_enter(row, region)]
        waiting[row] = False
        state = mdp.state[row]
        if every:
            decrement(left, state)
            state = state[left[state] == 0]
        else:
            new = ~region[state]
            found[state[new]] = row[new]
        frontier = sorted_unique(state[~region[state]], mdp.num_states)
        region[frontier] = True
    return region, found


class Decided(NamedTuple):
    """Where a probability is 0 and where it is 1.

    Attributes:
      zero, one: ``bool[S]``.
    """

    zero: Booleans
    one: Booleans


def decided(model: HostInterval, goal: Booleans, *, maximize: bool, helpful: bool) -> Decided:
    """Where the probability of reaching a goal is 0 and where it is 1.

    Args:
      model: the model; states of the goal, and those that may not be passed, stand still.
      goal: ``bool[S]``.
      maximize: whether the policy makes the probability large.
      helpful: whether nature does.
    """
    mdp = model.mdp
    if maximize and helpful:
        zero = ~backward_reachable(mdp, goal)
    elif maximize:
        zero = ~compelled(model, goal, every=False)
    elif helpful:
        zero = ~positive_under_all_policies(mdp, goal)
    else:
        zero = ~compelled(model, goal, every=True)
    if not maximize and not helpful:
        return Decided(zero, ~backward_reachable(mdp, zero))
    return Decided(zero, surely(model, goal, ~zero, maximize=maximize, helpful=helpful)[0])


def held(
    model: HostInterval, target: Booleans, known: Decided, *, maximize: bool
) -> tuple[Integers, Booleans]:
    """What keeps a probability against the other side where it is decided.

    Args:
      model, target, maximize: as of :func:`decided`, of a policy and nature that are opposed.
      known: what is decided.

    Returns:
      ``int[S]``, rows of the policy: where it has what it wants, these keep it. And ``bool[T]``,
      the entries to which nature keeps: all, unless it has what it wants.
    """
    mdp = model.mdp
    mine, other = (known.one, known.zero) if maximize else (known.zero, known.one)
    rows = ~mdp.support.some_successor_in(~mine) & mine[mdp.state]
    row = attracting(model, target, rows) if maximize else mdp.first_choice(rows)[1]
    keeps = model.may_stay(other) & other[mdp.state]
    return row.astype(np.int64), other[mdp.successor] | ~keeps[mdp.row]


def surely(
    model: HostInterval, goal: Booleans, inside: Booleans, *, maximize: bool, helpful: bool
) -> tuple[Booleans, Booleans]:
    """The states from which a goal is reached almost surely, and the rows that stay among them.

    The greatest set that can be kept and in which the goal is reached with positive probability:
    by a policy and nature together, by one against the other (de Alfaro, Henzinger and Kupferman
    2007), but not by neither.

    Args:
      model, goal, maximize, helpful: as of :func:`decided`.
      inside: ``bool[S]``, a set that holds it.

    Returns:
      ``bool[S]``, and ``bool[R]``: rows that nature may keep inside if it is helpful, else those
      that stay inside whatever it does.
    """
    mdp = model.mdp
    while True:
        # Who cannot keep to the set goes all the way back, not by one step a round.
        inside = inside & ~(
            compelled(model, ~inside, every=maximize)
            if helpful
            else positive_under_all_policies(mdp, ~inside)
        )
        kept = model.may_stay(inside) if helpful else ~mdp.support.some_successor_in(~inside)
        if maximize:
            kept &= inside[mdp.state]
            found = (
                backward_reachable(mdp, goal & inside, kept)
                if helpful
                else compelled(model, goal & inside, every=False, rows=kept)
            )
        else:
            bad = np.zeros(mdp.num_states, bool)
            bad[mdp.state[~kept]] = True
            found = positive_under_all_policies(mdp, goal & inside, among=inside & ~bad)
        if (found == inside).all():
            return inside, kept & inside[mdp.state]
        inside = found


def joint_components(
    model: HostInterval, states: Booleans | None = None, entries: Booleans | None = None
) -> tuple[EndComponents, Booleans]:
    """The maximal end components that policy and nature can keep to together.

    Args:
      model: the model.
      states: ``bool[S]``; default all.
      entries: ``bool[T]``, those that may be used; default all.

    Returns:
      The components, whose rows nature may keep inside, and the entries that it may use there.
    """
    mdp = model.mdp
    used = np.ones(mdp.num_transitions, bool) if entries is None else entries.copy()
    if states is not None:
        used &= states[mdp.successor] & states[mdp.state[mdp.row]]
    source = mdp.state[mdp.row]
    while True:
        kept = model.may_keep(used)
        used &= kept[mdp.row]
        if not kept.any():
            return EndComponents(np.arange(mdp.num_states), kept), used
        alive = np.zeros(mdp.num_states, bool)
        alive[mdp.state[kept]] = True
        stays = ~_compelled(model, ~alive, True, kept)[0]
        now = used & stays[mdp.successor] & stays[source]
        label = strong_components(source[now], mdp.successor[now], mdp.num_states)
        now &= label[source] == label[mdp.successor]
        if (now == used).all():
            break
        used = now
    component = np.where(alive, label, np.arange(mdp.num_states))
    return EndComponents(component, kept), used


class JointRegion(NamedTuple):
    """Where policy and nature together can have the least priority even for ever.

    Attributes:
      region: ``bool[S]``.
      row: ``int[S]``, in the region the rows of a policy that has it.
      probability: ``float64[T]``, and nature's distributions; elsewhere some.
    """

    region: Booleans
    row: Integers
    probability: Any


def joint_accepting(model: HostInterval, priority: Integers) -> JointRegion:
    """The end components of policy and nature together whose least priority can be even.

    As :func:`~jaxltl.core.sparse.graph.accepting.accepting_region`, but nature may drop the entries that
    read a lesser priority.

    Args:
      model: the product.
      priority: ``int[T]``, what each entry reads.
    """
    mdp = model.mdp
    region = np.zeros(mdp.num_states, bool)
    row = mdp.row_start[:-1].astype(np.int64)
    chance = mdp.probability.copy()
    for p in np.unique(priority[priority % 2 == 0]):
        found, used = joint_components(model, ~region, priority >= p)
        hit = used & (priority == p)
        wins = np.zeros(mdp.num_states, bool)
        wins[found.component[mdp.state[mdp.row[hit]]]] = True
        new = wins[found.component] & found.region(mdp)
        if not new.any():
            continue
        region |= new
        takes = np.zeros(mdp.num_rows, bool)
        takes[mdp.row[hit]] = True
        some, first = mdp.first_choice(takes)
        keep = used & new[mdp.state[mdp.row]]
        inside = found.inside & new[mdp.state]
        way = HostInterval.fixed(model, np.where(keep | ~inside[mdp.row], chance, 0))
        row = np.where(new, np.where(some, first, shortest_path_rows(way, some, inside)), row)
        chance = np.where(inside[mdp.row], model.within(keep), chance)
    return JointRegion(region, row, chance)
