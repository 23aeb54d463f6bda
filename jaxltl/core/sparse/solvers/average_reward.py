"""Long-run averages: the best of each end component, and then of where to end.

In an end component the optimal gain g is one number, and any v bounds it:
``min (T v - v) <= g <= max (T v - v)`` for ``T v = opt_r (c_r + P_r v)`` (Puterman 1994, section
8.5). Value iteration of all components at once finds such a v, and policy iteration where that
mixes too slowly. Components with a choice to stop in them, for their gains, as one state each then
leave a problem whose every policy ends, which :mod:`jaxltl.core.sparse.solvers.policy_iteration` encloses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.graph.qualitative import (
    EndComponents,
    end_components,
    backward_reachable,
    shortest_path_rows,
)
from jaxltl.core.sparse.linear.elimination import factorize
from jaxltl.core.sparse.linear.extended_precision import (
    perturbation_bound,
    two_float_difference,
    two_sum,
)
from jaxltl.core.sparse.linear.topological_order import Edges, ordered_components
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, offsets_from_counts
from jaxltl.core.sparse.solvers.policy_iteration import policy_iteration
from jaxltl.core.sparse.solvers.total_cost import ShortestPathProblem
from jaxltl.core.sparse.solvers.step_bounded import backup_unit

_EPS = float(np.finfo(np.float64).eps)
_LAZY = 0.5  # the share of a step by which value iteration moves, so that no period keeps it apart
_SWEEPS = 400  # of value iteration before policies are solved for
_JUDGED = 32  # sweeps after which it is seen whether more would do
_PATIENCE = 64  # sweeps for each state before the last ones are judged: news passes all of them
_EVERY = 8  # sweeps between two looks at the bounds
_TURNS = 4  # of policies and of as many sweeps, before sweeps alone go on
_ROUNDS = 60  # policies at most
_LOOKS = 30  # steps after which it is asked where a policy is most often
_REFINED = 6  # solves of one bias, each of what the last ones left
_ELIMINATED = 2_000_000  # states up to which they are
_LINGERS = 1e12  # times the largest reward: biases that far apart are of states hardly ever left
_IDLE = 6  # policies in a row that earn more by no more than
_IDLE_SHARE = 1e-12  # of what the ones before did
_NEAR = 1e-3  # of their range: the best ones
_TINY = 1e-13
_LOOSEST = 1e-3  # share up to which its powers are left out
_FLOOR = 1e-6  # of the tolerance, times the largest reward: what counts where a gain is near zero


class Average(NamedTuple):
    """Enclosed long-run averages.

    Attributes:
      value, lower, upper: ``float64[S]``.
      row: ``int64[S]``, a policy that attains the bound on the safe side.
      residual: half the width of the widest gain's enclosure.
      rounds: sweeps, and systems solved.
    """

    value: Floats
    lower: Floats
    upper: Floats
    row: Integers
    residual: float
    rounds: int


def average(
    mdp: HostMDP,
    reward: Floats,
    magnitude: Floats,
    *,
    tolerance: float,
    max_steps: int,
    sign: int = 1,
) -> Average:
    """The largest long-run average reward of a step.

    Args:
      mdp: the model.
      reward: ``float64[R]``.
      magnitude: ``float64[R]``, the sum of the absolute values of what a reward is made of.
      tolerance: the width asked for, as a share of the value.
      max_steps: sweeps at most.
      sign: -1 where the rewards are the negatives of what is to be made small.
    """
    found = end_components(mdp)
    states = np.flatnonzero(found.region(mdp))
    leader = found.component[states]
    states = states[np.argsort(leader, kind="stable")]
    leaders, start = np.unique(found.component[states], return_index=True)
    part = _part(mdp, found.inside, states, start, reward, magnitude)
    gains = _gains(part, tolerance, max_steps)
    middle, half = (gains.lower + gains.upper) / 2, float((gains.upper - gains.lower).max()) / 2
    row = mdp.row_start[:-1].astype(np.int64)
    row[states] = gains.row
    if middle.min() == middle.max():
        value = np.full(mdp.num_states, middle[0])
        return Average(
            value, value - half, value + half, _all_to(mdp, states, row), half, gains.rounds
        )
    stopping = _with_stops(mdp, found, leaders)
    least = max(float(np.abs(middle).min()), _FLOOR * float(magnitude.max()))
    width = tolerance / 4 * least
    if half <= width:
        (low, high, taken, more), slack = _stopped(stopping, middle, tolerance, width, sign), half
    else:
        # Where little is earned what is not known of other components would be too much.
        low, _, taken, more = _stopped(stopping, gains.lower, tolerance, width, sign)
        high, slack = _stopped(stopping, gains.upper, tolerance, width, sign)[1], 0.0
    return Average(
        (low + high) / 2,
        low - slack,
        high + slack,
        _routed(mdp, found, taken, row),
        half,
        gains.rounds + more,
    )


def _stopped(
    stopping: _Stopping, gain: Floats, tolerance: float, width: float, sign: int
) -> tuple[Floats, Floats, Integers, int]:
    """Bounds on the best expected gain, rows that attain the lower one, and systems solved.

    What is to be made small, and was not negative, is made small as it is, and found to a share.
    """
    node, mdp, origin = stopping
    size, worth = mdp.num_states - gain.size, sign * gain
    shift = min(float(worth.min()), 0.0)
    # Beside large ones, a share of what is all but nothing cannot be had.
    relative = shift == 0 and bool((worth[worth > 0] > _TINY * worth.max()).all())
    known = np.concatenate([np.zeros(size), worth - shift])
    open_ = np.arange(mdp.num_states) < size
    problem = ShortestPathProblem(mdp, open_, known, np.zeros(mdp.num_rows))
    found = policy_iteration(
        problem,
        maximize=sign > 0,
        relative=relative,
        tolerance=tolerance / 4 if relative else width,
    )
    slack = 4 * _EPS * (abs(shift) + known.max()) if shift else 0.0
    low, high = (x[node] + shift for x in (found.lower, found.upper))
    low, high = (low, high) if sign > 0 else (-high, -low)
    # It is a mean of what the components earn.
    low, high = np.maximum(low - slack, gain.min()), np.minimum(high + slack, gain.max())
    return low, high, origin[found.row[node]], found.rounds


def _all_to(mdp: HostMDP, states: Integers, row: Integers) -> Integers:
    """Rows that lead to components from everywhere, as all are worth the same."""
    inside = np.zeros(mdp.num_states, bool)
    inside[states] = True
    if inside.all():
        return row
    return np.where(inside, row, shortest_path_rows(mdp, inside, np.ones(mdp.num_rows, bool)))


def _routed(mdp: HostMDP, found: EndComponents, taken: Integers, row: Integers) -> Integers:
    """Rows of states from those of nodes, -1 for components to stop in."""
    region = found.region(mdp)
    moves = taken >= 0
    exits = np.zeros(mdp.num_states, bool)
    exits[mdp.state[taken[moves & region]]] = True
    at_exit = moves & (mdp.state[np.maximum(taken, 0)] == np.arange(mdp.num_states))
    row = np.where(at_exit, taken, row)
    inner = moves & region & ~at_exit
    if inner.any():
        row = np.where(inner, shortest_path_rows(mdp, exits, found.inside), row)
    return row


class _Stopping(NamedTuple):
    """Components as one node each, with a row more by which it stops at a node of its own.

    Attributes:
      node: ``int[S]``, the node of each state.
      mdp: the model; its last nodes are the stops.
      origin: ``int[R']``, the row that each of its rows is; -1 for stops.
    """

    node: Integers
    mdp: HostMDP
    origin: Integers


def _with_stops(mdp: HostMDP, found: EndComponents, leaders: Integers) -> _Stopping:
    heads = np.flatnonzero(found.component == np.arange(mdp.num_states))
    node = np.searchsorted(heads, found.component)
    stops = np.arange(leaders.size) + heads.size
    row = np.flatnonzero(~found.inside)
    owner = np.concatenate([node[mdp.state[row]], node[leaders], stops])
    width = np.concatenate([np.diff(mdp.entry_start)[row], np.ones(2 * stops.size, np.int64)])
    entry = concatenated_ranges(mdp.entry_start[row], width[: row.size])
    successor = np.concatenate([node[mdp.successor[entry]], stops, stops]).astype(np.int32)
    probability = np.concatenate([mdp.probability[entry], np.ones(2 * stops.size)])
    origin = np.concatenate([row, np.full(2 * stops.size, -1)])
    order = np.argsort(owner, kind="stable")
    begin = (width.cumsum() - width)[order]
    entry = concatenated_ranges(begin, width[order])
    count = np.bincount(owner, minlength=heads.size + stops.size)
    small = HostMDP(
        offsets_from_counts(count),
        offsets_from_counts(width[order]),
        successor[entry],
        probability[entry],
    )
    return _Stopping(node, small, origin[order])


# --- the gain of each component ------------------------------------------------------------------


class _Part(NamedTuple):
    """Some components as a model of their own, without what leaves them.

    Attributes:
      mdp: its states are those of the components, one component after the other.
      start: ``int[C]``, where the states of each begin.
      size: ``int[C]``, how many each has.
      row: ``int[R']``, which rows these are.
      reward, magnitude: ``float64[R']``.
      unit: the rounding of one backup.
    """

    mdp: HostMDP
    start: Integers
    size: Integers
    row: Integers
    reward: Floats
    magnitude: Floats
    unit: float

    def change(self, v: Floats) -> Floats:
        """``T v - v``."""
        image = self.mdp.expectation(v)
        image += self.reward
        return self.mdp.over_choices(np.maximum, image) - v

    def gain(self, v: Floats, low: Floats | None = None) -> tuple[Floats, Floats]:
        """``c + P v - v`` of each row and its rounding, by differences, which are often small."""
        mdp = self.mdp
        source, target = mdp.state[mdp.row], mdp.successor
        ahead = (
            v[target] - v[source]
            if low is None
            else two_float_difference(v[target], low[target], v[source], low[source])
        )
        step = mdp.probability * ahead
        slack = np.add.reduceat(np.abs(step), mdp.entry_start[:-1])
        return (
            self.reward + np.add.reduceat(step, mdp.entry_start[:-1]),
            self.unit * (self.magnitude + slack),
        )

    def asked(self, low: Floats, high: Floats, tolerance: float) -> Floats:
        """How wide bounds may be."""
        weight = np.maximum.reduceat(self.mdp.over_choices(np.maximum, self.magnitude), self.start)
        return tolerance * np.maximum(np.minimum(np.abs(low), np.abs(high)), _FLOOR * weight)

    def first_best(self, quantity: Floats) -> Integers:
        """The first row of each state with the most."""
        best = self.mdp.over_choices(np.maximum, quantity)
        return self.mdp.first_choice(quantity == best[self.mdp.state])[1].astype(np.int64)

    def centred(self, v: Floats) -> Floats:
        """The value with 0 at each component's first state."""
        return v - np.repeat(v[self.start], self.size)


def _part(
    mdp: HostMDP,
    inside: Booleans,
    states: Integers,
    start: Integers,
    reward: Floats,
    magnitude: Floats,
) -> _Part:
    """Some components of a model, with the rows that stay inside."""
    number: Any = np.full(mdp.num_states, -1, np.int32)
    number[states] = np.arange(states.size)
    row = np.flatnonzero(inside & (number[mdp.state] >= 0))
    row = row[np.argsort(number[mdp.state[row]], kind="stable")]
    width = np.diff(mdp.entry_start)[row]
    entry = concatenated_ranges(mdp.entry_start[row], width)
    count = np.bincount(number[mdp.state[row]], minlength=states.size)
    small = HostMDP(
        offsets_from_counts(count),
        offsets_from_counts(width),
        number[mdp.successor[entry]],
        mdp.probability[entry],
    )
    return _Part(
        small,
        start,
        np.diff(start, append=states.size),
        row,
        reward[row],
        magnitude[row],
        backup_unit(small),
    )


@dataclass
class _Gains:
    """What is known of C components.

    Attributes:
      lower, upper: ``float64[C]``.
      row: ``int64[S']``, rows of their states that attain the lower bound.
      rounds: what was spent.
    """

    lower: Floats
    upper: Floats
    row: Integers
    rounds: int = 0

    def note(self, left: _Left) -> None:
        """Takes what a value shows of some components."""
        part, which = left.part, left.which
        gain, slack = part.gain(left.v)
        low = np.minimum.reduceat(part.mdp.over_choices(np.maximum, gain - slack), part.start)
        high = np.maximum.reduceat(part.mdp.over_choices(np.maximum, gain + slack), part.start)
        better = low > self.lower[which]
        if better.any():
            inner = np.repeat(better, part.size)
            self.row[left.states[inner]] = part.row[part.first_best(gain - slack)[inner]]
        self.lower[which] = np.maximum(self.lower[which], low)
        self.upper[which] = np.minimum(self.upper[which], high)

    def note_by_weights(
        self, left: _Left, chosen: Integers, high: Floats, low: Floats, gain: float
    ) -> None:
        """Takes what a policy's bias, in two floats, shows of one component.

        With costs ``c = r - min r`` and ``g = gain - min r``, a row has the balance
        ``c - g + sum_t P_t (v_t - v_s)``. If that of each chosen row is at most a share e of the
        sum of its absolute terms, the policy has the gain g for weights and costs that differ by e;
        if no row has more, no policy has a greater one. As quotients of sums of their products
        (:func:`~jaxltl.core.sparse.linear.extended_precision.perturbation_bound`), gains of the true ones
        differ by a small multiple of e, however far apart biases are.
        """
        part, which = left.part, left.which[0]
        mdp, base = part.mdp, float(part.reward.min())
        start, cost, earned = mdp.entry_start[:-1], part.reward - base, max(gain - base, 0.0)
        source, target = mdp.state[mdp.row], mdp.successor
        flow = mdp.probability * two_float_difference(
            high[target], low[target], high[source], low[source]
        )
        gap = (part.reward - gain) + np.add.reduceat(flow, start)
        scale = cost + earned + np.add.reduceat(np.abs(flow), start)
        share = np.abs(gap) / np.maximum(scale, 1e-300)
        own = float(share[chosen].max())
        every = max(own, float(share[gap > 0].max(initial=0)))
        slack = part.unit * float(part.magnitude.max())
        bounds = []
        for side, error in ((-1, own), (1, every)):
            error = perturbation_bound(error + 2 * part.unit, mdp.num_states)
            far = gain + side * (error * earned + slack) if error < _LOOSEST else side * np.inf
            bounds.append(far)
        if bounds[0] > self.lower[which]:
            self.lower[which] = bounds[0]
            self.row[left.states] = part.row[chosen]
        self.upper[which] = min(self.upper[which], bounds[1])

    def wide(self, left: _Left, tolerance: float) -> Booleans:
        """Whose bounds are wider than asked."""
        low, high = self.lower[left.which], self.upper[left.which]
        return high - low > left.part.asked(low, high, tolerance)


def _gains(whole: _Part, tolerance: float, max_steps: int) -> _Gains:
    """Bounds on the largest gain of each component."""
    count, size = whole.start.size, whole.mdp.num_states
    known = _Gains(np.full(count, -np.inf), np.full(count, np.inf), np.zeros(size, np.int64))
    left = _Left(np.arange(count), np.arange(size), whole, np.zeros(size))
    left = _swept(known, left, tolerance, min(_SWEEPS, max_steps), patience=0)
    for turn in range(_TURNS):
        settled, v = np.zeros(left.which.size, bool), left.v.copy()
        for i in np.flatnonzero(left.part.size <= _ELIMINATED):
            one = np.arange(settled.size) == i
            found = _by_policies(known, left.only(one), tolerance)
            settled[i] = found is None
            if found is not None:
                v[np.repeat(one, left.part.size)] = found
        # Value iteration goes on where it was, and later from what policies found.
        left = (left._replace(v=v) if turn else left).only(~settled)
        if not left.which.size or max_steps <= _SWEEPS:
            break
        left = _swept(known, left, tolerance, _SWEEPS)
    rest, patience = max_steps - (_TURNS + 1) * _SWEEPS, _PATIENCE * left.v.size
    _swept(known, left, tolerance, rest, patience)
    return known


class _Left(NamedTuple):
    """Components that are not narrow yet: which, their states, as a part, and a value."""

    which: Integers
    states: Integers
    part: _Part
    v: Floats

    def only(self, kept: Booleans) -> _Left:
        """Some of these."""
        if kept.all():
            return self
        states = np.flatnonzero(np.repeat(kept, self.part.size))
        size = self.part.size[kept]
        part = self.part
        small = _part(
            part.mdp,
            np.ones(part.mdp.num_rows, bool),
            states,
            size.cumsum() - size,
            part.reward,
            part.magnitude,
        )
        small = small._replace(row=part.row[small.row])
        return _Left(self.which[kept], self.states[states], small, self.v[states])


def _swept(
    known: _Gains, left: _Left, tolerance: float, num_steps: int, patience: float = np.inf
) -> _Left:
    """Value iteration of all components at once, until each is narrow.

    After `patience` sweeps it also ends where the steps are too few at the rate of convergence.
    """
    before: Floats | None = None
    done = 0
    while left.which.size and done <= num_steps:
        v = left.v
        for _ in range(_EVERY if done else 0):
            v = left.part.centred(v + _LAZY * left.part.change(v))
        done += _EVERY
        left = left._replace(v=v)
        known.note(left)
        left = left.only(known.wide(left, tolerance))
        if done >= patience and done % _JUDGED == 0 and left.which.size:
            if (
                before is not None
                and (_steps_left(known, left, before, tolerance) > num_steps - done).all()
            ):
                break
            before = known.upper - known.lower
    known.rounds += done
    return left


def _steps_left(known: _Gains, left: _Left, before: Floats, tolerance: float) -> Floats:
    """How many more it takes, by how much narrower bounds became since they were judged last."""
    low, high = known.lower[left.which], known.upper[left.which]
    now = high - low
    rate = np.log(np.minimum(now / before[left.which], 1 - _EPS))
    asked = np.maximum(left.part.asked(low, high, tolerance), _EPS * now)
    return _JUDGED * np.log(asked / now) / rate


# --- policies of one component -------------------------------------------------------------------


def _by_policies(known: _Gains, left: _Left, tolerance: float) -> Floats | None:
    """Policy iteration (Howard 1960) of one component, each policy with one recurrent class.

    Returns:
      None where it came to an end, where nothing but rounding can be better; else, as policies of
      one gain take turns whose states for ever are others, the value of one of the best.
    """
    part = left.part
    chosen, best, idle = part.first_best(part.gain(left.v)[0]), left.v, 0
    for _ in range(_ROUNDS):
        known.rounds += 1
        before, solved = float(known.lower[left.which[0]]), _bias(part, chosen)
        if solved is None:
            return best
        v, chosen = solved
        known.note(left._replace(v=v[0]))
        known.note_by_weights(left, chosen, *v)
        if not known.wide(left, tolerance).any():
            return None
        more = float(known.lower[left.which[0]]) - before
        idle = 0 if more > _IDLE_SHARE * abs(before) else idle + 1
        if idle > _IDLE:
            break
        best, range_ = v[0], float(np.ptp(v[0]))
        gain, slack = part.gain(v[0], v[1])
        better = part.mdp.over_choices(np.maximum, gain - slack) > (gain + slack)[chosen]
        if better.any():
            chosen = np.where(better, part.first_best(gain - slack), chosen)
        elif range_ > _LINGERS * part.magnitude.max():
            # Some states are left hardly ever: the rest goes to the best of these.
            goal = best >= best.max() - _NEAR * range_
            chosen = np.where(
                goal, chosen, shortest_path_rows(part.mdp, goal, np.ones(part.row.size, bool))
            )
        else:
            return None
    return best


def _bias(part: _Part, chosen: Integers) -> tuple[tuple[Floats, Floats, float], Integers] | None:
    """A policy's bias v in two floats, its gain ``c + P v - v``, and the policy.

    Where it has several recurrent classes, it is first led to the one of the largest gain.
    """
    mdp, size = part.mdp, part.mdp.num_states
    chain = mdp.matrix[chosen]
    source = np.repeat(np.arange(size), np.diff(chain.indptr))
    label = strong_components(source, chain.indices, size)
    crossing = label[source] != label[chain.indices]
    bottom = np.ones(size, bool)
    bottom[label[source[crossing]]] = False
    heads = np.unique(label[bottom[label]])
    if heads.size > 1:
        alone = [_cycle(part, chosen, np.flatnonzero(label == head)) for head in heads]
        if any(found is None for found in alone):
            return None
        best = int(np.argmax([found[0] for found in alone if found is not None]))
        goal = label == heads[best]
        taken = np.zeros(mdp.num_rows, bool)
        taken[chosen] = True
        goal = backward_reachable(mdp, goal, taken)
        chosen = np.where(goal, chosen, shortest_path_rows(mdp, goal, np.ones(mdp.num_rows, bool)))
        heads = heads[[best]]
    recurrent = np.flatnonzero(label == heads[0])
    found = _cycle(part, chosen, np.arange(size), recurrent)
    return None if found is None else ((found[1], found[2], found[0]), chosen)


def _cycle(
    part: _Part, chosen: Integers, states: Integers, recurrent: Integers | None = None
) -> tuple[float, Floats, Floats] | None:
    """The gain and bias (in two floats) of a chain with one recurrent class, through visits of one state.

    What is earned between two visits, by how long that takes.
    """
    mdp = part.mdp
    matrix = mdp.matrix[chosen[states]]
    if states.size < mdp.num_states:
        matrix = matrix[:, states]
    often = np.full(states.size, 1 / states.size)
    for _ in range(_LOOKS):
        often = (often + matrix.T @ often) / 2
    among = np.arange(states.size) if recurrent is None else recurrent
    visited = among[often[among].argmax()]
    # Loops are left out, however likely: what they take is in how rarely a state is left.
    source = np.repeat(np.arange(states.size), np.diff(matrix.indptr))
    loops = source == matrix.indices
    leaves: Any = np.bincount(source[~loops], matrix.data[~loops], states.size)
    if leaves[visited] == 0:
        leaves[visited] = 1  # it is never left, and so every step is a visit
    if (leaves == 0).any():
        return None
    cut = matrix.copy()
    cut.data = np.where(loops | (matrix.indices == visited), 0, matrix.data / leaves[source])
    cut.eliminate_zeros()
    label = ordered_components(Edges(cut.indptr, cut.indices))
    system = factorize(cut, label, np.arange(states.size))
    if system is None:
        return None
    time, reward = system.solve(1 / leaves), part.reward[chosen[states]]
    gain, high, low = 0.0, np.zeros(states.size), np.zeros(states.size)
    target = matrix.indices
    with np.errstate(all="ignore"):
        for _ in range(_REFINED):
            step = matrix.data * two_float_difference(
                high[target], low[target], high[source], low[source]
            )
            earned = system.solve((reward - gain + np.bincount(source, step, states.size)) / leaves)
            share = earned[visited] / time[visited]
            if not np.isfinite(earned).all() or not np.isfinite(share):
                return None
            gain += float(share)
            high, lost = two_sum(high, earned - share * time)
            high, low = two_sum(high, low + lost)
    return gain, high - high[visited], low - low[visited]
