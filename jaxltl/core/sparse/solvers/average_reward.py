"""Certified long-run average rewards of multichain MDPs.

Within an end component the optimal gain g is one number, and every v bounds it:
``min (T v - v) <= g <= max (T v - v)`` for ``T v = max_r (c_r + P_r v)`` (Puterman 1994, section
8.5). Value iteration on all components at once finds such a v, and policy iteration where that
converges too slowly. End components as single states, with an action to stop for their gain, are
then a shortest path problem (Puterman 1994, chapter 9).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.contraction import with_stops
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.graph.qualitative import (
    SparseEndComponents,
    almost_sure_reachability,
    backward_reachable,
    end_components,
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
from jaxltl.core.sparse.rows import mask_of, offsets_from_counts, positions
from jaxltl.core.sparse.solvers.policy_iteration import policy_iteration
from jaxltl.core.sparse.solvers.reachability import quotient_policy
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure, ShortestPathProblem

_EPS = float(np.finfo(np.float64).eps)
_METHOD = "value iteration and policy iteration"
_LAZY = 0.5  # the step of value iteration: with self-loops no chain is periodic
_SWEEPS = 400  # of value iteration before policy iteration
_JUDGED = 32  # sweeps between two estimates of the rate of convergence
_PATIENCE = 64  # sweeps for each state before the last ones are judged: news passes all of them
_EVERY = 8  # sweeps between two bounds
_TURNS = 4  # of policy iteration and as many sweeps, before sweeps alone
_ROUNDS = 60  # policies at most
_LOOKS = 30  # steps that estimate the most frequent state of a policy
_REFINED = 6  # refinements of a bias
_ELIMINATED = 2_000_000  # states up to which policies are evaluated by elimination
_LINGERS = 1e12  # range of biases, relative to rewards, that shows states that are hardly left
_IDLE = 6  # policies that improve the gain by no more than
_IDLE_SHARE = 1e-12  # this share, after which policy iteration ends
_BEST_SHARE = 1e-3  # of the range of biases: the best states
_TINY = 1e-13  # relative size of gains that have no relative tolerance
_LOOSEST = 1e-3  # share up to which second-order terms are negligible


class Scale(NamedTuple):
    """Signs and sizes of the numbers, on which the accuracy depends."""

    sign: int = 1  # -1 if rewards are negated ones
    depth: int = 0  # the number of roundings behind each probability
    # share of the largest reward: gains nearer to zero are not resolved relatively
    floor: float = 1e-6


_UNSCALED = Scale()


def average(
    mdp: HostMDP,
    reward: Floats,
    magnitude: Floats,
    *,
    tolerance: float,
    max_steps: int,
    scale: Scale = _UNSCALED,
) -> Enclosure:
    """Largest long-run average reward per step; the residual is half the widest gain's enclosure."""
    components = end_components(mdp)
    states = np.flatnonzero(components.region(mdp))
    states = states[np.argsort(components.component[states], kind="stable")]
    leaders, start = np.unique(components.component[states], return_index=True)
    part = submodel(mdp, components.inside, states, start, (reward, magnitude), scale)
    gains = component_gains(part, tolerance, max_steps)
    middle, half = (gains.lower + gains.upper) / 2, float((gains.upper - gains.lower).max()) / 2
    row = mdp.row_start[:-1].astype(np.int64)
    row[states] = gains.row
    if middle.min() == middle.max():
        value = np.full(mdp.num_states, middle[0])
        inside = components.region(mdp)
        if not inside.all():
            onward = shortest_path_rows(mdp, inside, np.ones(mdp.num_rows, bool))
            row = np.where(inside, row, onward)
        return Enclosure(value, value - half, value + half, row, gains.rounds, half, _METHOD)
    stopping = _stopping_problem(mdp, components, leaders, scale.depth)
    least = max(float(np.abs(middle).min()), scale.floor * float(magnitude.max()))
    width = tolerance / 4 * least
    if half <= width:
        (low, high, taken, rounds), slack = (
            stopping.solve(middle, tolerance, width, scale.sign),
            half,
        )
    else:
        # The error of large gains would be too much for small ones: both sides separately.
        low, _, taken, rounds = stopping.solve(gains.lower, tolerance, width, scale.sign)
        high, slack = stopping.solve(gains.upper, tolerance, width, scale.sign)[1], 0.0
    return Enclosure(
        value=(low + high) / 2,
        lower=low - slack,
        upper=high + slack,
        row=quotient_policy(mdp, components, taken, row),
        rounds=gains.rounds + rounds,
        residual=half,
        method=_METHOD,
    )


class RewardRange(NamedTuple):
    """The least and the largest reward of a row, and whether sums of rewards equal them exactly."""

    least: float
    largest: float
    is_exact: tuple[bool, bool]

    @property
    def negated(self) -> RewardRange:
        return RewardRange(-self.largest, -self.least, (self.is_exact[1], self.is_exact[0]))


def within_range(
    mdp: HostMDP, reward: Floats, enclosure: Enclosure, ends: RewardRange
) -> Enclosure:
    """The enclosure of a largest average, clipped to the range of the rewards.

    The graph decides where it is an end of the range: the least reward where no end component with
    a larger one is reachable, and the largest reward where end components without a smaller one are
    reached almost surely.
    """
    lower = np.clip(enclosure.lower, ends.least, ends.largest)
    upper = np.clip(enclosure.upper, ends.least, ends.largest)
    if ends.is_exact[0] and ((lower <= ends.least) & (upper > ends.least)).any():
        components = end_components(mdp)
        row = components.inside & (reward > ends.least)
        larger = mask_of(components.component[mdp.state[row]], mdp.num_states)
        larger = larger[components.component] & components.region(mdp)
        upper[~backward_reachable(mdp, larger)] = ends.least
    if ends.is_exact[1] and ((upper >= ends.largest) & (lower < ends.largest)).any():
        best = end_components(mdp, rows=reward >= ends.largest).region(mdp)
        lower[almost_sure_reachability(mdp, best)[0]] = ends.largest
    value = np.clip(enclosure.value, lower, upper)
    return replace(enclosure, value=value, lower=lower, upper=upper)


@dataclass(frozen=True)
class _Stopping:
    """End components as one node each, with a row that leads to a terminal node of each."""

    node: Integers  # int[S], the node of each state
    mdp: HostMDP  # the model; its last nodes are terminal
    origin: Integers  # int[R'], the model's row of each row; -1 for stopping
    depth: int

    def solve(
        self, gain: Floats, tolerance: float, width: float, sign: int
    ) -> tuple[Floats, Floats, Integers, int]:
        """Bounds on the best expected gain, rows that attain the lower one, and linear systems."""
        mdp = self.mdp
        size, worth = mdp.num_states - gain.size, sign * gain
        shift = min(float(worth.min()), 0.0)
        # Gains that are almost zero compared with others are not resolved relatively.
        relative = shift == 0 and bool((worth[worth > 0] > _TINY * worth.max()).all())
        known = np.concatenate([np.zeros(size), worth - shift])
        interior = np.arange(mdp.num_states) < size
        enclosure = policy_iteration(
            ShortestPathProblem(mdp, interior, known, np.zeros(mdp.num_rows), depth=self.depth),
            maximize=sign > 0,
            relative=relative,
            tolerance=tolerance / 4 if relative else width,
        )
        slack = 4 * _EPS * (abs(shift) + known.max()) if shift else 0.0
        low, high = (x[self.node] + shift for x in (enclosure.lower, enclosure.upper))
        low, high = (low, high) if sign > 0 else (-high, -low)
        # It is a mean of the gains of the components.
        low, high = np.maximum(low - slack, gain.min()), np.minimum(high + slack, gain.max())
        return low, high, self.origin[enclosure.row[self.node]], enclosure.rounds


def _stopping_problem(
    mdp: HostMDP, components: SparseEndComponents, leaders: Integers, depth: int
) -> _Stopping:
    heads = np.flatnonzero(components.component == np.arange(mdp.num_states))
    node = np.searchsorted(heads, components.component)
    stops = np.arange(leaders.size) + heads.size
    row = np.flatnonzero(~components.inside)
    ends = np.concatenate([node[leaders], stops]), np.tile(stops, 2)
    small, order = with_stops(mdp, row, node, ends, heads.size + stops.size)
    origin = np.concatenate([row, np.full(2 * stops.size, -1)])
    return _Stopping(node, small, origin[order], depth)


# --- the gain of each component ------------------------------------------------------------------


@dataclass(frozen=True)
class Submodel:
    """Some components as a separate model, without the rows that leave them."""

    mdp: HostMDP  # its states are those of the components, one component after the other
    start: Integers  # int[C], the first state and the number of states of each
    size: Integers
    row: Integers  # int[R'], the rows of the model
    reward: Floats  # float64[R'] (reward, magnitude)
    magnitude: Floats
    scale: Scale

    @cached_property
    def unit(self) -> float:
        """The rounding of one backup."""
        return self.mdp.backup_unit + self.scale.depth * _EPS

    def change(self, v: Floats) -> Floats:
        """``T v - v``."""
        image = self.mdp.expectation(v)
        image += self.reward
        return self.mdp.over_choices(np.maximum, image) - v

    def gain(self, v: Floats, low: Floats | None = None) -> tuple[Floats, Floats]:
        """``c + P v - v`` of each row, and its rounding; `low` is a second float of v."""
        start, step = self.mdp.entry_start[:-1], self.flow(v, low)
        slack = self.unit * (self.magnitude + np.add.reduceat(np.abs(step), start))
        return self.reward + np.add.reduceat(step, start), slack

    def flow(self, v: Floats, low: Floats | None = None) -> Floats:
        """``P_t (v_t - v_s)`` of each entry."""
        source, target = self.mdp.state[self.mdp.row], self.mdp.successor
        if low is None:
            return self.mdp.probability * (v[target] - v[source])
        ahead = two_float_difference(v[target], low[target], v[source], low[source])
        return self.mdp.probability * ahead

    def allowed_width(self, low: Floats, high: Floats, tolerance: float) -> Floats:
        """The width of bounds that the tolerance allows."""
        weight = np.maximum.reduceat(self.mdp.over_choices(np.maximum, self.magnitude), self.start)
        return tolerance * np.maximum(
            np.minimum(np.abs(low), np.abs(high)), self.scale.floor * weight
        )

    def first_best(self, quantity: Floats) -> Integers:
        """The first row of each state with the largest quantity."""
        best = self.mdp.over_choices(np.maximum, quantity)
        return self.mdp.first_choice(quantity == best[self.mdp.state])[1].astype(np.int64)

    def centred(self, v: Floats) -> Floats:
        """The value with 0 at each component's first state."""
        return v - np.repeat(v[self.start], self.size)

    def restricted(self, states: Integers, start: Integers) -> Submodel:
        """The submodel of some components."""
        rows, rewards = np.ones(self.mdp.num_rows, bool), (self.reward, self.magnitude)
        small = submodel(self.mdp, rows, states, start, rewards, self.scale)
        return replace(small, row=self.row[small.row])

    def policy_iteration(self, known: Gains, rest: Unsettled, tolerance: float) -> Floats | None:
        """Policy iteration on one component; None at its end, else a bias to continue from."""
        return _policy_iteration(known, rest, tolerance)


def submodel(
    mdp: HostMDP,
    inside: Booleans,
    states: Integers,
    start: Integers,
    rewards: tuple[Floats, Floats],
    scale: Scale,
) -> Submodel:
    """Some components of a model, with the rows that stay inside."""
    number = positions(states, mdp.num_states)
    row = np.flatnonzero(inside & (number[mdp.state] >= 0))
    row = row[np.argsort(number[mdp.state[row]], kind="stable")]
    count = np.bincount(number[mdp.state[row]], minlength=states.size)
    small, _ = mdp.select(offsets_from_counts(count), row, number)
    reward, magnitude = (x[row] for x in rewards)
    size = np.diff(start, append=states.size)
    return Submodel(small, start, size, row, reward, magnitude, scale)


@dataclass(frozen=True)
class Bias:
    """A policy's gain, and its bias in two floats."""

    gain: float
    high: Floats
    low: Floats


@dataclass
class Gains:
    """Bounds of the gains of C components."""

    lower: Floats  # float64[C] (lower, upper)
    upper: Floats
    row: Integers  # int64[S'], rows of their states that attain the lower bound
    rounds: int = 0  # sweeps, and linear systems

    def update(self, rest: Unsettled) -> None:
        """Applies the span bound of a value."""
        part, which = rest.part, rest.which
        gain, slack = part.gain(rest.v)
        low = np.minimum.reduceat(part.mdp.over_choices(np.maximum, gain - slack), part.start)
        high = np.maximum.reduceat(part.mdp.over_choices(np.maximum, gain + slack), part.start)
        better = low > self.lower[which]
        if better.any():
            inner = np.repeat(better, part.size)
            self.row[rest.states[inner]] = part.row[part.first_best(gain - slack)[inner]]
        self.lower[which] = np.maximum(self.lower[which], low)
        self.upper[which] = np.minimum(self.upper[which], high)

    def update_by_weights(self, rest: Unsettled, chosen: Integers, bias: Bias) -> None:
        """Applies the bound by perturbed weights to a policy of one component.

        With costs ``c = r - min r`` and ``g = gain - min r``, a row has the balance
        ``c - g + sum_t P_t (v_t - v_s)``. If that of each chosen row is at most a share e of the
        sum of its absolute terms, the policy has gain g for weights and costs that differ by e; if
        no row has more, no policy has a larger one. As quotients of sums of products of the
        weights, the gains of the true ones differ by a small multiple of e, however far apart
        biases are (:func:`~jaxltl.core.sparse.linear.extended_precision.perturbation_bound`).
        """
        part, which = rest.part, rest.which[0]
        base, start = float(part.reward.min()), part.mdp.entry_start[:-1]
        flow, earned = part.flow(bias.high, bias.low), max(bias.gain - base, 0.0)
        gap = (part.reward - bias.gain) + np.add.reduceat(flow, start)
        scale = (part.reward - base) + earned + np.add.reduceat(np.abs(flow), start)
        share = np.abs(gap) / np.maximum(scale, 1e-300)
        own = float(share[chosen].max())
        every = max(own, float(share[gap > 0].max(initial=0)))
        slack = part.unit * float(part.magnitude.max())
        bounds = []
        for side, error in ((-1, own), (1, every)):
            error = perturbation_bound(error + 2 * part.unit, part.mdp.num_states)
            width = error * earned + slack if error < _LOOSEST else np.inf
            bounds.append(bias.gain + side * width)
        if bounds[0] > self.lower[which]:
            self.lower[which] = bounds[0]
            self.row[rest.states] = part.row[chosen]
        self.upper[which] = min(self.upper[which], bounds[1])

    def too_wide(self, rest: Unsettled, tolerance: float) -> Booleans:
        """Components with bounds wider than the tolerance."""
        low, high = self.lower[rest.which], self.upper[rest.which]
        return high - low > rest.part.allowed_width(low, high, tolerance)


@dataclass(frozen=True)
class Unsettled:
    """Components with too wide bounds: their numbers, states, submodel, and a value."""

    which: Integers
    states: Integers
    part: Submodel
    v: Floats

    def only(self, kept: Booleans) -> Unsettled:
        """Some of these."""
        if kept.all():
            return self
        part, size = self.part, self.part.size[kept]
        states = np.flatnonzero(np.repeat(kept, part.size))
        small = part.restricted(states, size.cumsum() - size)
        return Unsettled(self.which[kept], self.states[states], small, self.v[states])


def component_gains(whole: Submodel, tolerance: float, max_steps: int) -> Gains:
    """Bounds on the largest gain of each component."""
    count, size = whole.start.size, whole.mdp.num_states
    known = Gains(np.full(count, -np.inf), np.full(count, np.inf), np.zeros(size, np.int64))
    rest = Unsettled(np.arange(count), np.arange(size), whole, np.zeros(size))
    rest = _value_iteration(known, rest, tolerance, min(_SWEEPS, max_steps), patience=0)
    for turn in range(_TURNS):
        settled, v = np.zeros(rest.which.size, bool), rest.v.copy()
        for i in np.flatnonzero(rest.part.size <= _ELIMINATED):
            one = np.arange(settled.size) == i
            one_part = rest.only(one)
            bias = one_part.part.policy_iteration(known, one_part, tolerance)
            settled[i] = bias is None
            if bias is not None:
                v[np.repeat(one, rest.part.size)] = bias
        # Value iteration continues its own values first, and later those of policies.
        rest = (replace(rest, v=v) if turn else rest).only(~settled)
        if not rest.which.size or max_steps <= _SWEEPS:
            break
        rest = _value_iteration(known, rest, tolerance, _SWEEPS)
    num_steps = max_steps - (_TURNS + 1) * _SWEEPS
    _value_iteration(known, rest, tolerance, num_steps, _PATIENCE * rest.v.size)
    return known


def _value_iteration(
    known: Gains, rest: Unsettled, tolerance: float, num_steps: int, patience: float = np.inf
) -> Unsettled:
    """Value iteration of all components at once, until each is narrow or convergence is slow."""
    before: Floats | None = None
    done = 0
    while rest.which.size and done <= num_steps:
        v = rest.v
        for _ in range(_EVERY if done else 0):
            v = rest.part.centred(v + _LAZY * rest.part.change(v))
        done += _EVERY
        rest = replace(rest, v=v)
        known.update(rest)
        rest = rest.only(known.too_wide(rest, tolerance))
        if done >= patience and done % _JUDGED == 0 and rest.which.size:
            if before is not None:
                needed = _steps_needed(known, rest, before, tolerance)
                if (needed > num_steps - done).all():
                    break
            before = known.upper - known.lower
    known.rounds += done
    return rest


def _steps_needed(known: Gains, rest: Unsettled, before: Floats, tolerance: float) -> Floats:
    """The number of further steps, by the rate at which bounds became narrower since `before`."""
    low, high = known.lower[rest.which], known.upper[rest.which]
    now = high - low
    rate = np.log(np.minimum(now / before[rest.which], 1 - _EPS))
    goal = np.maximum(rest.part.allowed_width(low, high, tolerance), _EPS * now)
    return _JUDGED * np.log(goal / now) / rate


# --- policies of one component -------------------------------------------------------------------


def _policy_iteration(known: Gains, rest: Unsettled, tolerance: float) -> Floats | None:
    """Policy iteration (Howard 1960) on one component, over policies with one recurrent class.

    Returns None at its end; the bias of a best policy where recurrent classes alternate.
    """
    part = rest.part
    chosen, best, idle = part.first_best(part.gain(rest.v)[0]), rest.v, 0
    for _ in range(_ROUNDS):
        known.rounds += 1
        before, solved = float(known.lower[rest.which[0]]), evaluated(part, chosen)
        if solved is None:
            return best
        bias, chosen = solved
        known.update(replace(rest, v=bias.high))
        known.update_by_weights(rest, chosen, bias)
        if not known.too_wide(rest, tolerance).any():
            return None
        more = float(known.lower[rest.which[0]]) - before
        idle = 0 if more > _IDLE_SHARE * abs(before) else idle + 1
        if idle > _IDLE:
            break
        best, range_ = bias.high, float(np.ptp(bias.high))
        gain, slack = part.gain(bias.high, bias.low)
        better = part.mdp.over_choices(np.maximum, gain - slack) > (gain + slack)[chosen]
        if better.any():
            chosen = np.where(better, part.first_best(gain - slack), chosen)
        elif range_ > _LINGERS * part.magnitude.max():
            # Some states are hardly ever left: the others go to the best of these.
            goal = best >= best.max() - _BEST_SHARE * range_
            onward = shortest_path_rows(part.mdp, goal, np.ones(part.row.size, bool))
            chosen = np.where(goal, chosen, onward)
        else:
            return None
    return best


def evaluated(part: Submodel, chosen: Integers) -> tuple[Bias, Integers] | None:
    """A policy's gain and bias, and the policy, led to its recurrent class of the largest gain."""
    mdp, size = part.mdp, part.mdp.num_states
    chain = mdp.matrix[chosen]
    source = np.repeat(np.arange(size), np.diff(chain.indptr))
    label = strong_components(source, chain.indices, size)
    crossing = label[source] != label[chain.indices]
    bottom = np.ones(size, bool)
    bottom[label[source[crossing]]] = False
    heads = np.unique(label[bottom[label]])
    if heads.size > 1:
        gains = []
        for head in heads:
            bias = _gain_and_bias(part, chosen, np.flatnonzero(label == head))
            if bias is None:
                return None
            gains.append(bias.gain)
        heads = heads[[int(np.argmax(gains))]]
        goal = backward_reachable(mdp, label == heads[0], mask_of(chosen, mdp.num_rows))
        onward = shortest_path_rows(mdp, goal, np.ones(mdp.num_rows, bool))
        chosen = np.where(goal, chosen, onward)
    bias = _gain_and_bias(part, chosen, np.arange(size), np.flatnonzero(label == heads[0]))
    return None if bias is None else (bias, chosen)


def _gain_and_bias(
    part: Submodel, chosen: Integers, states: Integers, recurrent: Integers | None = None
) -> Bias | None:
    """Gain and bias of a chain with one recurrent class, by renewal at a frequent state.

    The bias is refined in two floats (Wilkinson 1963): it may exceed the resolution of one float.
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
    # Self-loops are eliminated, however likely: their time is in how rarely a state is left.
    source, target = np.repeat(np.arange(states.size), np.diff(matrix.indptr)), matrix.indices
    loops = source == target
    leaves = np.bincount(source[~loops], matrix.data[~loops], states.size).astype(np.float64)
    if leaves[visited] == 0:
        leaves[visited] = 1  # absorbing: every step is a visit
    if (leaves == 0).any():
        return None
    cut = matrix.copy()
    cut.data = np.where(loops | (target == visited), 0, matrix.data / leaves[source])
    cut.eliminate_zeros()
    label = ordered_components(Edges(cut.indptr, cut.indices))
    system = factorize(cut, label, np.arange(states.size))
    if system is None:
        return None
    time, reward = system.solve(1 / leaves), part.reward[chosen[states]]
    gain, high, low = 0.0, np.zeros(states.size), np.zeros(states.size)
    with np.errstate(all="ignore"):
        for _ in range(_REFINED):
            ahead = two_float_difference(high[target], low[target], high[source], low[source])
            step = np.bincount(source, matrix.data * ahead, states.size)
            earned = system.solve((reward - gain + step) / leaves)
            share = earned[visited] / time[visited]
            if not np.isfinite(earned).all() or not np.isfinite(share):
                return None
            gain += float(share)
            high, lost = two_sum(high, earned - share * time)
            high, low = two_sum(high, low + lost)
    return Bias(gain, high - high[visited], low - low[visited])
