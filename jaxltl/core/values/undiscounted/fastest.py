"""Fastest optimal policies: of all rows that are optimal up to rounding, those that decide soonest.

Optimal rows conserve the value, ``(P V)(s, a) = V(s)``, which rounding does not show. All rows that
certified bounds do not exclude are candidates; the least expected time to decide is a stochastic
shortest path over them, and the probability of its policy is certified by itself.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import end_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import offsets_from_counts
from jaxltl.core.sparse.solvers import reachability as solver
from jaxltl.core.sparse.solvers.shortest_path import Fastest, fastest_policy
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure, RelativeTolerance

QUICK_LIMIT = 100_000  # states up to which ties are broken by the expected time
_TIE_ROUNDINGS = 4  # that a bound gives up for each step, for ties to attain it
_TIED = 64  # roundings of a backup up to which rows are tied with the value
_LARGEST_TIE = 1e-11  # of a value, relative, for ties despite its error
_TIE_WIDTH = 1e-11  # relative width of an optimum, for ties between its actions
_POLICY_LOSS = 1e-9  # of a fastest policy, relative, that counts as a rounding error
_WIDTHS, _LOSS = 2, 1e-12  # the loss of a policy of tied rows: widths of the enclosure, or absolute
_ROUNDING_LOSS = 1e-10  # absolute, the limit of a loss that is the rounding of each step


def fastest_optimum(
    mdp: HostMDP, target: Booleans, objective: str, enclosure: Enclosure
) -> Enclosure:
    """The enclosure with the fastest optimal policy, and a bound that this policy attains."""
    if mdp.num_states > QUICK_LIMIT or mdp.is_chain:
        return enclosure
    decided = decided_states(target, objective, enclosure)
    conserving = conserving_rows(mdp, objective, enclosure)
    conserving[enclosure.row[enclosure.lower != enclosure.upper]] = True
    free = _optimal_where_decided(mdp, objective, enclosure)
    rows = conserving | _tied(mdp, objective, enclosure)
    if (rows != conserving).any():
        fastest = fastest_policy(mdp, rows | free, decided, enclosure.row)
        bound = None if fastest is None else _attained(mdp, objective, enclosure, fastest)
        if fastest is not None and bound is not None:
            if objective == "max":
                return replace(enclosure, row=fastest.row, lower=bound)
            return replace(enclosure, row=fastest.row, upper=bound)
    fastest = fastest_policy(mdp, conserving | free, decided, enclosure.row)
    return enclosure if fastest is None else replace(enclosure, row=fastest.row)


def certified_fastest_rows(
    mdp: HostMDP, target: Booleans, stay: Booleans | None, objective: str, row: Integers
) -> Integers:
    """Rows of the fastest policy that attains the optimum, solved finely; else the given rows."""
    maximize = objective == "max"
    optimum = solver.reachability(
        mdp, target, maximize=maximize, stay=stay, tolerance=RelativeTolerance(_TIE_WIDTH)
    )
    fastest = fastest_optimum(mdp, target, objective, optimum).row
    own = solver.reachability(
        mdp.chain(fastest),
        target,
        maximize=True,
        stay=stay,
        tolerance=RelativeTolerance(_POLICY_LOSS / 4),
    )
    if maximize:
        attains = own.lower >= optimum.upper * (1 - _POLICY_LOSS)
    else:
        attains = own.upper <= optimum.lower * (1 + _POLICY_LOSS)
    return fastest if attains.all() else row


def decided_states(target: Booleans, objective: str, enclosure: Enclosure) -> Booleans:
    """States at which the time ends: of value 0 or 1; for a maximum of 1 only the target."""
    decided = enclosure.lower == enclosure.upper
    if objective == "max":
        decided = decided & ((enclosure.lower != 1) | target)
    result: Booleans = decided
    return result


def possibly_optimal_rows(mdp: HostMDP, objective: str, enclosure: Enclosure) -> Booleans:
    """Rows that bounds do not exclude from optimal policies, a superset of the optimal ones."""
    ends = enclosure.upper, enclosure.lower
    ahead, here = ends if objective == "max" else ends[::-1]
    rows = _not_worse(mdp, objective, enclosure, mdp.expectation(ahead), here, backup_unit(mdp))
    return rows | _optimal_by_graph(mdp, objective, enclosure)


def tied_rows(mdp: HostMDP, objective: str, enclosure: Enclosure) -> Booleans:
    """Rows that conserve the value up to rounding, and those of the enclosure's policy."""
    tied = _tied(mdp, objective, enclosure)
    tied[enclosure.row[enclosure.lower != enclosure.upper]] = True
    return tied | _optimal_by_graph(mdp, objective, enclosure)


def _optimal_by_graph(mdp: HostMDP, objective: str, enclosure: Enclosure) -> Booleans:
    """Optimal rows of the states of value 0 or 1, and of end components with a constant value."""
    rows = _optimal_where_decided(mdp, objective, enclosure)
    if objective == "max":
        undecided = enclosure.lower != enclosure.upper
        rows |= undecided[mdp.state] & end_components(mdp, undecided).inside
    return rows


def _optimal_where_decided(mdp: HostMDP, objective: str, enclosure: Enclosure) -> Booleans:
    """Optimal rows of the states of value 0 or 1."""
    decided = enclosure.lower == enclosure.upper
    good = decided & (enclosure.lower == (1 if objective == "max" else 0))
    rows: Booleans = (decided & ~good)[mdp.state]
    rows |= good[mdp.state] & ~mdp.support.some_successor_in(~good)
    return rows


def _tied(mdp: HostMDP, objective: str, enclosure: Enclosure) -> Booleans:
    """Rows of undecided states that conserve the value up to its rounding."""
    value, row, unit = enclosure.value, enclosure.row, backup_unit(mdp)
    ahead = mdp.expectation(value)
    off = np.abs(ahead[row] - value) / np.maximum(value, 1e-300)
    off = off[enclosure.lower != enclosure.upper]
    # The value's own error shows in the rows of its policy.
    share = max(_TIED * unit, min(4 * float(off.max(initial=0)), _LARGEST_TIE))
    return _not_worse(mdp, objective, enclosure, ahead, value, share)


def _not_worse(
    mdp: HostMDP,
    objective: str,
    enclosure: Enclosure,
    ahead: Floats,
    here: Floats,
    share: float,
) -> Booleans:
    """Rows of undecided states with values ahead not worse than a value, up to a share of it."""
    undecided, least = enclosure.lower != enclosure.upper, here[mdp.state]
    sign = 1 if objective == "max" else -1
    rows = sign * (ahead - least) >= -share * np.maximum(ahead, least)
    result: Booleans = rows & undecided[mdp.state]
    return result


def _attained(
    mdp: HostMDP, objective: str, enclosure: Enclosure, fastest: Fastest
) -> Floats | None:
    """A bound on the safe side that a policy attains; None if it loses more than rounding."""
    sign, side = (1, enclosure.lower) if objective == "max" else (-1, enclosure.upper)
    bound = _attained_in_time(mdp.chain(fastest.row), sign, enclosure, fastest.time)
    rounding = 3 * backup_unit(mdp) * float(fastest.time.max(initial=0))
    width = float((enclosure.upper - enclosure.lower).max())
    limit = max(_WIDTHS * width, _LOSS, min(rounding, _ROUNDING_LOSS))
    if bound is None or (sign * (enclosure.value - bound) > limit).any():
        return None
    return np.minimum(bound, side) if sign > 0 else np.maximum(bound, side)


def _attained_in_time(
    chain: HostMDP, sign: int, enclosure: Enclosure, time: Floats
) -> Floats | None:
    """The value less what rows lose in each step, if these bounds are carried by the chain."""
    # ``P l >= l`` for the lower bound l of a maximum makes l a submartingale, and bounds the value
    # of a policy that decides almost surely from below; likewise ``P u <= u`` for a minimum.
    undecided, value = enclosure.lower != enclosure.upper, enclosure.value
    unit = backup_unit(chain)
    loss = np.maximum(sign * (value - chain.expectation(value)), 0) + unit * value
    each = float(loss[undecided].max(initial=0))
    for margin in (1.1, 2.5):  # times one step, of which a step of the chain takes nearly one
        bound = np.clip(value - sign * margin * each * time, 0, 1)
        bound = np.where(undecided, bound, enclosure.lower if sign > 0 else enclosure.upper)
        ahead = chain.expectation(bound) * (1 - sign * unit)
        if (sign * ahead >= sign * bound)[undecided].all():
            return bound
    return None


def conserving_rows(mdp: HostMDP, objective: str, enclosure: Enclosure) -> Booleans:
    """Rows in undecided states by which every policy that decides almost surely attains the bound."""
    # ``P l >= l`` for the lower bound l of a maximum makes l a submartingale, and bounds the value
    # of a policy of such rows from below by its limit, which is 0 or 1; likewise ``P u <= u`` for
    # the upper bound of a minimum.
    undecided = enclosure.lower != enclosure.upper
    unit = backup_unit(mdp)
    if objective == "max":
        keeps = mdp.expectation(enclosure.lower) * (1 - unit) >= enclosure.lower[mdp.state]
        keeps |= end_components(mdp, undecided).inside
    else:
        keeps = mdp.expectation(enclosure.upper) * (1 + unit) <= enclosure.upper[mdp.state]
    result: Booleans = keeps & undecided[mdp.state]
    return result


def attained_by_ties(mdp: HostMDP, objective: str, enclosure: Enclosure) -> Enclosure | None:
    """Enclosure with a bound that every policy of tied rows may attain."""
    # The value less a few roundings for each step that the slowest policy of tied rows takes; it is
    # not proven, except by :func:`conserving_rows`. None if such policies may never decide.
    largest, undecided = objective == "max", enclosure.lower != enclosure.upper
    sign, pessimistic, optimistic = 1, enclosure.lower, enclosure.upper
    if not largest:
        sign, pessimistic, optimistic = -1, optimistic, pessimistic
    unit = backup_unit(mdp)
    ahead = mdp.expectation(optimistic)
    ties = sign * ahead + unit * ahead >= sign * pessimistic[mdp.state]
    ties[enclosure.row] = True
    free = ~undecided[mdp.state]
    if largest:
        free |= end_components(mdp, undecided).inside
    rows = np.flatnonzero(ties | free)
    count = np.bincount(mdp.state[rows], minlength=mdp.num_states)
    tied, _ = mdp.select(offsets_from_counts(count), rows)
    cost = np.where(free[rows], 0.0, 1.0)
    time = solver.reward_forever(tied, cost, maximize=True).value
    if not np.isfinite(time).all():
        return None
    bound = np.clip(enclosure.value - sign * _TIE_ROUNDINGS * unit * time, 0, 1)
    bound = np.where(undecided, bound, pessimistic)
    return replace(enclosure, lower=bound) if largest else replace(enclosure, upper=bound)


def backup_unit(mdp: HostMDP) -> float:
    """The relative rounding of a backup."""
    return (int(np.diff(mdp.entry_start).max(initial=1)) + 8) * float(np.finfo(np.float64).eps)
