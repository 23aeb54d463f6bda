"""Certified values of interval models: policy and nature together, or one against the other.

Together they are one player (`joint_bound`). Against each other, the side that makes a probability
large (or a sum small, which must reach its target) improves its choices as long as something is
gained, while the other one answers best; what is found at last is bounded from each side by fixing
the one player and optimising the other (strategy improvement, Hoffman and Karp 1966).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import backward_reachable, shortest_path_rows
from jaxltl.core.sparse.interval.policy_iteration import Joint, joint_bound
from jaxltl.core.sparse.interval.qualitative import (
    Decided,
    attracting,
    decided,
    held,
    joint_components,
    surely,
)
from jaxltl.core.sparse.interval.uncertainty_set import HostInterval
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import reachability as optimal
from jaxltl.core.sparse.solvers.total_cost import Enclosure

_EPS = float(np.finfo(np.float64).eps)
_ROUNDS = 100
_STARTS = 60  # improvements to begin with
_SWEEPS = 100  # of what each of them found
_SLOW = 1e-7  # change of a sweep at which they are improved
_NEARLY = 1e-5  # and change since the last improvement at which systems are solved


class Robust(NamedTuple):
    """Certified values, with both players' choices.

    Attributes:
      value, lower, upper: ``float64[S]``.
      row: ``int64[S]``, a policy.
      probability: ``float64[T]``, nature's distributions.
      rounds: systems solved.
      residual: how far the value is from satisfying its equation.
      method: how it was found, in words.
    """

    value: Floats
    lower: Floats
    upper: Floats
    row: Integers
    probability: Floats
    rounds: int
    residual: float
    method: str

    def covering(self, other: Robust) -> Robust:
        """The same with bounds that enclose what is enclosed by others too."""
        return self._replace(
            lower=np.minimum(self.lower, other.lower), upper=np.maximum(self.upper, other.upper)
        )


class _Solve(NamedTuple):
    """How a question is answered: of a decision process, and of policy and nature together.

    Attributes:
      exact: an enclosure of an MDP's optimum, from the MDP and whether to maximise.
      joint: values of an interval model's joint optimum; from the model, its rewards of rows, and
        whether to maximise.
      cost: ``float64[R]``.
      tolerance, relative: the width asked for, and whether as a share of the value.
    """

    exact: Callable[[HostMDP, Floats, bool], Enclosure]
    joint: Callable[[HostInterval, Floats, bool], Robust]
    cost: Floats
    tolerance: float
    relative: bool

    def narrow(self, low: Floats, high: Floats) -> bool:
        """Whether bounds are as near as asked."""
        scale = high if self.relative else 1.0
        return bool((np.isfinite(high) & (high - low <= self.tolerance * scale)).all())


def reachability(
    model: HostInterval,
    target: Booleans,
    *,
    maximize: bool,
    helpful: bool,
    stay: Booleans | None = None,
    tolerance: float = 1e-6,
    depth: int = 0,
) -> Robust:
    """The probability of reaching a target, optimal for policy and nature.

    Where sums that miss one by rounding would decide what is 0 or 1 in another way if they counted
    as one, bounds enclose what the probability is then too.

    Args:
      model: the model.
      target: ``bool[S]``.
      maximize: whether the policy makes it large.
      helpful: whether nature makes it large.
      stay: ``bool[S]``, the states that may be passed; default all.
      tolerance: the width of the enclosure asked for.
      depth: how many roundings stand behind each number of the model.
    """
    ask: Any = {"maximize": maximize, "helpful": helpful}
    stop = target if stay is None else target | ~stay
    found = _reachability(model, target, stop, tolerance=tolerance, depth=depth, **ask)
    wide = model.widened
    if wide is None:
        return found
    mine, other = (decided(x.halted(stop)[0], target, **ask) for x in (model, wide))
    if (mine.zero == other.zero).all() and (mine.one == other.one).all():
        return found
    return found.covering(
        _reachability(wide, target, stop, tolerance=tolerance, depth=depth, **ask)
    )


def _reachability(
    model: HostInterval,
    target: Booleans,
    stop: Booleans,
    *,
    maximize: bool,
    helpful: bool,
    tolerance: float,
    depth: int,
) -> Robust:
    halted, row = model.halted(stop)

    def exact(mdp: HostMDP, _: Floats, up: bool) -> Enclosure:
        return optimal.reachability(
            mdp, target, maximize=up, tolerance=tolerance / 2, depth=depth + terms(mdp)
        )

    def joint(part: HostInterval, _: Floats, up: bool) -> Robust:
        return _joint_reachability(part, target, up, tolerance, depth, exact)

    solve = _Solve(exact, joint, np.zeros(halted.mdp.num_rows), tolerance, False)
    if maximize == helpful:
        found = joint(halted, solve.cost, maximize)
    elif (both := _opposed_reachability(halted, target, maximize, tolerance, depth)) is not None:
        found = both
    elif maximize:
        start, _ = _started(halted, target, maximize=True)
        found = _led_by_policy(halted, start, solve, 1)
    else:
        _, p = _started(halted, target, maximize=False)
        found = _led_by_nature(halted, p, solve, 1)
    return _unhalted(model, halted, row, stop, found)


def total_reward(
    model: HostInterval,
    reward: Floats,
    target: Booleans,
    *,
    maximize: bool,
    large: bool,
    tolerance: float = 1e-6,
    depth: int = 0,
) -> Robust:
    """The expected reward until a target is reached, optimal for policy and nature.

    Infinite where the target is not surely reached: by both sides' choice if they make the reward
    small, by the choice of that side which does, or at all if none does. Where sums that miss one
    by rounding would decide that in another way if they counted as one, bounds enclose both.

    Args:
      model: the model.
      reward: ``float64[R]``, at least 0.
      target: ``bool[S]``.
      maximize: whether the policy makes the reward large.
      large: whether nature does.
      tolerance: the width of the enclosure asked for, as a share of the value.
      depth: how many roundings stand behind each number of the model.
    """
    ask: Any = {"maximize": maximize, "large": large}
    found = _total_reward(model, reward, target, tolerance=tolerance, depth=depth, **ask)
    wide = model.widened
    if (
        wide is None
        or (
            _finite(wide.halted(target)[0], target, **ask)[0]
            == _finite(model.halted(target)[0], target, **ask)[0]
        ).all()
    ):
        return found
    return found.covering(
        _total_reward(wide, reward, target, tolerance=tolerance, depth=depth, **ask)
    )


def _finite(
    model: HostInterval, target: Booleans, *, maximize: bool, large: bool
) -> tuple[Booleans, Booleans]:
    """Where a reward until a target is finite, and the rows that keep it so."""
    if maximize and large:
        one = decided(model, target, maximize=False, helpful=False).one
        return one, one[model.mdp.state]
    return surely(
        model, target, np.ones(target.size, bool), maximize=not maximize, helpful=not large
    )


def _total_reward(
    model: HostInterval,
    reward: Floats,
    target: Booleans,
    *,
    maximize: bool,
    large: bool,
    tolerance: float,
    depth: int,
) -> Robust:
    halted, row = model.halted(target)
    cost = np.where(target[halted.mdp.state], 0, reward[row])
    finite, kept = _finite(halted, target, maximize=maximize, large=large)
    part, origin, entry = _restricted(halted, finite, kept)

    def exact(mdp: HostMDP, earned: Floats, up: bool) -> Enclosure:
        return optimal.total_reward(
            mdp, earned, ends, maximize=up, tolerance=tolerance / 2, depth=depth + terms(mdp)
        )

    def joint(some: HostInterval, earned: Floats, up: bool) -> Robust:
        return _joint_reward(some, earned, ends, up, tolerance, depth, exact)

    ends = target | ~finite
    cost = np.where(ends[part.mdp.state], 0, cost[origin])
    solve = _Solve(exact, joint, cost, tolerance, True)
    if maximize == large:
        found = joint(part, cost, maximize)
    elif maximize:
        found = _led_by_nature(
            part, part.within(np.ones(part.mdp.num_transitions, bool)), solve, -1
        )
    else:
        found = _led_by_policy(part, _surely_soon(part, ends, solve), solve, -1)
    value, lower, upper = (
        np.where(finite, x, np.inf) for x in (found.value, found.lower, found.upper)
    )
    # Where it is infinite, and of rows that are not taken, nature is anything.
    taken, open_ = np.zeros(halted.mdp.num_rows, bool), finite[part.mdp.state]
    taken[origin[open_]] = True
    chance = np.where(taken[halted.mdp.row], 0, halted.mdp.probability)
    chance[entry[open_[part.mdp.row]]] = found.probability[open_[part.mdp.row]]
    found = found._replace(
        value=value, lower=lower, upper=upper, row=origin[found.row], probability=chance
    )
    return _unhalted(model, halted, row, target, found)


def terms(mdp: HostMDP) -> int:
    """How many roundings may stand behind nature's distributions."""
    return int(np.diff(mdp.entry_start).max()) + 4


def _joint_reachability(
    model: HostInterval,
    target: Booleans,
    up: bool,
    tolerance: float,
    depth: int,
    exact: Callable[[HostMDP, Floats, bool], Enclosure],
) -> Robust:
    """Policy and nature together make the probability large, or small."""
    mdp = model.mdp
    zero, one = decided(model, target, maximize=up, helpful=up)
    open_ = ~(zero | one)
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    chance = mdp.probability.copy()
    bound, rounds = one.astype(np.float64), 0
    of: Enclosure | None = Enclosure(bound, bound, bound, row, 0, 0.0, "")
    component: Integers = np.arange(mdp.num_states)
    if open_.any():
        if up:
            component, inside, used = _components(model, open_, None)
        found = joint_bound(
            Joint(model, open_, bound, np.zeros(mdp.num_rows), component, depth),
            maximize=up,
            tolerance=tolerance,
            relative=False,
        )
        bound, rounds = np.clip(found.bound, 0, 1), found.rounds
        of = found.enclosed(up, tolerance, relative=False)
        row, chance = np.where(open_, found.row, row), found.probability
        if up and inside.any():
            row, chance = _inner(model, row, chance, component, inside, used)
    # Where it is decided: choices that keep it so.
    keep = one if up else zero
    rows = model.may_stay(keep) & keep[mdp.state]
    entries = keep[mdp.successor] & rows[mdp.row]
    chance = np.where(rows[mdp.row], model.within(entries), chance)
    some = (
        shortest_path_rows(model.fixed(chance), target, rows) if up else mdp.first_choice(rows)[1]
    )
    row = np.where(keep, some, row)
    if of is None:
        chain, entry = model.chain(row)
        of = _pinned(exact, chain, chance[entry], np.zeros(0), up)
    low, high = (
        (of.lower, np.maximum(bound, of.lower))
        if up
        else (np.minimum(bound, of.upper), np.minimum(of.upper, 1))
    )
    return Robust(of.value, low, high, row, chance, rounds + of.rounds, of.residual, _METHOD)


def _opposed_reachability(
    model: HostInterval, target: Booleans, up: bool, tolerance: float, depth: int
) -> Robust | None:
    """The policy makes the probability large (or small), nature the opposite: if that is proven."""
    mdp = model.mdp
    zero, one = decided(model, target, maximize=up, helpful=not up)
    row, within = held(model, target, Decided(zero, one), maximize=up)
    chance = mdp.probability if within.all() else model.within(within)
    open_, known = ~(zero | one), one.astype(np.float64)
    low = high = value = known
    rounds = 0
    if open_.any():
        first = attracting(model, one) if up else row
        found = joint_bound(
            Joint(model, open_, known, np.zeros(mdp.num_rows), np.arange(mdp.num_states), depth),
            maximize=up,
            tolerance=tolerance,
            relative=False,
            against=True,
            first=first,
        )
        if found.attained is None:
            return None
        low, high = (found.attained, found.bound) if up else (found.bound, found.attained)
        low, high = np.clip(low, 0, 1), np.clip(high, 0, 1)
        value, rounds = found.value, found.rounds
        row = np.where(open_, found.row, row)
        chance = np.where(open_[mdp.state][mdp.row], found.probability, chance)
        if (high - low).max() > tolerance:
            return None
    return _between(value, low, high, row, chance, rounds, float((high - low).max()))


def _joint_reward(
    model: HostInterval,
    cost: Floats,
    target: Booleans,
    up: bool,
    tolerance: float,
    depth: int,
    exact: Callable[[HostMDP, Floats, bool], Enclosure],
) -> Robust:
    """Policy and nature together make the reward large, or small, in a model that surely ends."""
    mdp = model.mdp
    row: Integers = mdp.row_start[:-1].astype(np.int64)
    chance = mdp.probability.copy()
    bound, rounds = np.zeros(mdp.num_states), 0
    of: Enclosure | None = Enclosure(bound, bound, bound, row, 0, 0.0, "")
    earning = np.zeros(mdp.num_states, bool)
    earning[mdp.state[cost > 0]] = True
    open_ = ~target & (backward_reachable(mdp, earning) if up else True)
    component: Integers = np.arange(mdp.num_states)
    inside, used = (np.zeros(size, bool) for size in (mdp.num_rows, mdp.num_transitions))
    if open_.any():
        if not up:
            component, inside, used = _components(model, open_, cost == 0)
        found = joint_bound(
            Joint(model, open_, bound, cost, component, depth, wandering=not up),
            maximize=up,
            tolerance=tolerance,
            relative=True,
        )
        bound, rounds = found.bound, found.rounds
        of = found.enclosed(up, tolerance, relative=True)
        row, chance = np.where(open_, found.row, row), found.probability
        if inside.any():
            row, chance = _inner(model, row, chance, component, inside, used)
    if of is None:
        chain, entry = model.chain(row)
        of = _pinned(exact, chain, chance[entry], cost[row], up)
    low, high = (
        (of.lower, np.maximum(bound, of.lower)) if up else (np.minimum(bound, of.upper), of.upper)
    )
    return Robust(of.value, low, high, row, chance, rounds + of.rounds, of.residual, _METHOD)


_METHOD = "policy iteration with nature"


def _pinned(
    exact: Callable[[HostMDP, Floats, bool], Enclosure],
    model: HostInterval,
    p: Floats,
    cost: Floats,
    up: bool,
) -> Enclosure:
    """The policy's optimum where nature picks what is next to some distributions."""
    settled, able = model.settled(p)
    found = exact(model.fixed(settled), cost, up)
    if able:
        return found
    return found._replace(lower=np.zeros_like(found.lower), upper=np.full_like(found.upper, np.inf))


def _components(
    model: HostInterval, open_: Booleans, rows: Booleans | None
) -> tuple[Integers, Booleans, Booleans]:
    """Components of policy and nature among some states, by some rows, with their entries."""
    entries = None if rows is None else rows[model.mdp.row]
    found, used = joint_components(model, open_, entries)
    return found.component, found.inside, used


def _inner(
    model: HostInterval,
    row: Integers,
    chance: Floats,
    component: Integers,
    inside: Booleans,
    used: Booleans,
) -> tuple[Integers, Floats]:
    """A policy that moves inside each component until it is where its row leaves."""
    mdp = model.mdp
    number = np.arange(mdp.num_states)
    exits = mdp.state[row] == number
    held = np.zeros(mdp.num_states, bool)
    held[mdp.state[inside]] = True
    moving = held & ~exits
    taken = inside & moving[mdp.state]
    chance = np.where(taken[mdp.row], model.within(used & taken[mdp.row]), chance)
    goal = exits | ~held
    return np.where(moving, shortest_path_rows(model.fixed(chance), goal, taken), row), chance


def _led_by_policy(model: HostInterval, row: Integers, solve: _Solve, sign: int) -> Robust:
    """The policy improves, nature answers best.

    Args:
      sign: 1 if the policy makes the sum large, else -1.
    """
    mdp, up = model.mdp, sign > 0
    rounds = 0
    while True:
        rounds += 1
        part, _ = model.chain(row)
        inner = solve.joint(part, solve.cost[row], not up)
        gain, p = gains(model, inner.value, solve.cost, up=not up)
        best = mdp.over_choices(np.maximum, sign * gain)
        better = best > _noise(inner.value)
        if rounds == _ROUNDS or not better.any():
            break
        if _is_tried(rounds):
            other = _pinned(solve.exact, model, p, solve.cost, up)
            low, high = (inner.lower, other.upper) if up else (other.lower, inner.upper)
            if solve.narrow(low, high):
                break
        new = mdp.first_choice(sign * gain == best[mdp.state])[1]
        row = np.where(better, new, row)
    other = _pinned(solve.exact, model, p, solve.cost, up)
    low, high = (inner.lower, other.upper) if up else (other.lower, inner.upper)
    return _between(inner.value, low, high, row, p, rounds + other.rounds, float(best.max()))


def _led_by_nature(model: HostInterval, p: Floats, solve: _Solve, sign: int) -> Robust:
    """Nature improves, the policy answers best.

    Args:
      sign: 1 if nature makes the sum large, else -1.
    """
    mdp, up = model.mdp, sign > 0
    rounds = 0
    while True:
        rounds += 1
        found = _pinned(solve.exact, model, p, solve.cost, not up)
        gain, q = gains(model, found.value, solve.cost, up=up)
        now = model.total(p * _differences(model, found.value)) + solve.cost
        more = sign * (gain - now)
        better = more > _noise(found.value)[mdp.state]
        if rounds == _ROUNDS or not better.any():
            break
        if _is_tried(rounds):
            row = _least(mdp, sign * gain)
            part, _ = model.chain(row)
            inner = solve.joint(part, solve.cost[row], up)
            low, high = (found.lower, inner.upper) if up else (inner.lower, found.upper)
            if solve.narrow(low, high):
                break
        p = np.where(better[mdp.row], q, p)
    row = _least(mdp, sign * gain)
    part, _ = model.chain(row)
    inner = solve.joint(part, solve.cost[row], up)
    low, high = (found.lower, inner.upper) if up else (inner.lower, found.upper)
    return _between(found.value, low, high, row, p, rounds + inner.rounds, float(more.max()))


def _is_tried(rounds: int) -> bool:
    """Whether bounds are looked at while something is gained: after 4, 8, 16, ... rounds."""
    return rounds >= 4 and rounds & (rounds - 1) == 0


def _least(mdp: HostMDP, gain: Floats) -> Integers:
    """The first row of each state that gains least."""
    best = mdp.over_choices(np.minimum, gain)
    return mdp.first_choice(gain == best[mdp.state])[1].astype(np.int64)


def _between(
    value: Floats,
    low: Floats,
    high: Floats,
    row: Integers,
    p: Floats,
    rounds: int,
    residual: float,
) -> Robust:
    return Robust(
        np.clip(value, low, np.maximum(low, high)),
        low,
        np.maximum(low, high),
        row,
        p,
        rounds,
        abs(residual),
        "strategy improvement against nature",
    )


def _differences(model: HostInterval, value: Floats) -> Floats:
    mdp = model.mdp
    return value[mdp.successor] - value[mdp.state[mdp.row]]


def gains(model: HostInterval, value: Floats, cost: Floats, *, up: bool) -> tuple[Floats, Floats]:
    """What each row gains when nature makes that large or small, and nature's distributions."""
    ahead = _differences(model, value)
    p = model.nature(ahead, maximize=up)
    return model.total(p * ahead) + cost, p


def _noise(value: Floats) -> Floats:
    """Differences that rounding makes."""
    return 64 * _EPS * (np.abs(value) + np.abs(value).max(initial=0))


def _started(model: HostInterval, target: Booleans, *, maximize: bool) -> tuple[Integers, Floats]:
    """Good rows and distributions where policy and nature want the opposite of a probability.

    Both are improved as values rise from zero by sweeps of what they chose.
    """
    from scipy.sparse import csr_array

    mdp, value = model.mdp, target.astype(np.float64)
    row: Integers = attracting(model, target)
    opt: Any = np.maximum if maximize else np.minimum
    shape = (mdp.num_states, mdp.num_states)
    for _ in range(_STARTS):
        ahead = value[mdp.successor]
        p = model.nature(ahead, maximize=not maximize)
        image = model.total(p * ahead)
        best = mdp.over_choices(opt, image)
        better = np.abs(best - image[row]) > _noise(value)
        found = mdp.first_choice(image == best[mdp.state])[1]
        row = np.where(better, found, row)
        taken = np.zeros(mdp.num_rows, bool)
        taken[row] = True
        kept = taken[mdp.row]
        start = np.concatenate([[0], np.diff(mdp.entry_start)[row].cumsum()])
        chain = csr_array((p[kept], mdp.successor[kept], start), shape=shape)
        before = value
        for _ in range(_SWEEPS):
            last, value = value, chain @ value
            if np.abs(value - last).max() <= _SLOW:
                break
        if np.abs(value - before).max() <= _NEARLY:
            break
    return row, model.nature(value[mdp.successor], maximize=not maximize)


def _surely_soon(model: HostInterval, goal: Booleans, solve: _Solve) -> Integers:
    """Rows by which a goal is surely reached whatever nature picks; cheap ones where that does.

    Any rows that surely get there will do to begin with, but slips that lead there by chance alone
    may take longer than floats can tell.
    """
    row = solve.exact(model.mdp, solve.cost, False).row
    sure, _ = surely(
        model.chain(row)[0], goal, np.ones(goal.size, bool), maximize=True, helpful=False
    )
    return np.where(sure, row, attracting(model, goal | sure))


def _restricted(
    model: HostInterval, inside: Booleans, rows: Booleans
) -> tuple[HostInterval, Integers, Integers]:
    """Some rows, kept to some states by nature; all else stands still.

    Returns:
      The model, which row each row was, and which entry each entry was.
    """
    mdp = model.mdp
    whole = inside.all() and rows.all()
    if whole:
        return model, np.arange(mdp.num_rows), np.arange(mdp.num_transitions)
    some, first = mdp.first_choice(rows & inside[mdp.state])
    taken = rows & inside[mdp.state]
    taken[first[~some]] = True
    row = np.flatnonzero(taken)
    count = np.bincount(mdp.state[row], minlength=mdp.num_states)
    starts = np.concatenate([[0], count.cumsum()])
    part, entry = model.of_rows(starts, row)
    source = part.mdp.state[part.mdp.row]
    kept = inside[part.mdp.successor] & inside[source]
    lone = ~some[source]
    head = np.zeros(entry.size, bool)
    head[part.mdp.entry_start[:-1]] = True
    kept = np.where(lone, head, kept)
    successor = np.where(lone, source, part.mdp.successor)[kept]
    lower, upper = (np.where(lone, 1, x)[kept] for x in (part.lower, part.upper))
    ball = part.ball
    if ball is not None:
        ball = ball._replace(center=np.where(lone, 1, ball.center)[kept])
    width = np.add.reduceat(kept.astype(np.int64), part.mdp.entry_start[:-1])
    inner = part.within(kept)
    chance = np.where(lone, 1, inner)[kept]
    small = HostMDP(
        starts, np.concatenate([[0], width.cumsum()]), successor.astype(np.int32), chance
    )
    return HostInterval(small, lower, upper, ball), row, entry[kept]


def _unhalted(
    model: HostInterval, halted: HostInterval, row: Integers, states: Booleans, found: Robust
) -> Robust:
    """What was found of a model in which some states stand still, for the model."""
    if halted is model:
        return found
    chance = model.mdp.probability.copy()
    moves, moved = (~states[x.state[x.row]] for x in (model.mdp, halted.mdp))
    chance[moves] = found.probability[moved]
    return found._replace(row=row[found.row], probability=chance)
