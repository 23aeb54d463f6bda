"""Reachability and total reward of a POMDP on measures of its undecided states.

The value of a measure m of states, a belief times the probability of the observations that lead to it,
is ``V(m) = opt_a (g_a . m + sum_o V(m T_a restricted to o))``, homogeneous in m, convex for a maximum
and concave for a minimum (Smallwood and Sondik 1973).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers, SparseMatrix
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.sparse.graph.components import forward_reachable
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.solvers import reachability as solver

_SWEEPS = 200  # of the fast informed bound, most; each costs one product with all transitions
_STILL = 1e-7  # change of the fast informed bound at which its sweeps end
EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class BeliefProblem:
    """A question about a POMDP, on the states whose value the graph does not decide.

    These are numbered in the order of their observations, N of them.
    """

    pomdp: POMDP
    maximize: bool
    is_reward: bool  # a total reward until the target; else the probability of reaching it
    state: Integers  # int[N], the states
    number: Integers  # int[S], the number of each state; -1 where it is decided
    observation: Integers  # int[N], ascending
    transition: tuple[SparseMatrix, ...]  # of each action, float64[N, N]
    gain: Floats  # float64[A, N], probability of entering the target, or the reward
    initial: Floats  # float64[N], the initial measure
    initial_gain: float  # the initial probability of the target, 0 of rewards
    corner: Floats  # float64[N], bound of the value of a policy that sees the states
    is_finite: Booleans  # bool[N], whether total rewards of such policies are finite
    is_infinite: bool  # whether they are from the initial belief

    @property
    def available(self) -> Booleans:
        """``bool[O, A]``."""
        return self.pomdp.available

    @property
    def has_infinite(self) -> bool:
        """True if total rewards of policies that see the states are infinite somewhere."""
        return not self.is_finite.all()

    @property
    def num_states(self) -> int:
        """N."""
        return self.state.size

    @cached_property
    def largest_class(self) -> int:
        """The largest number of undecided states of one observation."""
        return int(np.bincount(self.observation, minlength=1).max(initial=1))

    @cached_property
    def action_bound(self) -> Floats:
        """Fast informed bound of each action, ``float64[A, N]`` (Hauskrecht 2000), rounded outwards.

        ``q_a(s) = g_a(s) + sum_o opt_b sum_{t in o} P(t | s, a) q_b(t)`` from the fully observable values
        on; each sweep keeps the bound, since the operator is monotone.
        """
        sign = 1.0 if self.maximize else -1.0
        worst = -np.inf * sign
        legal = self.available.T[:, self.observation]
        outwards = 1 + sign * 4 * (self.largest_class + 20) * EPS
        bound = np.stack(
            [g + t @ self.corner for g, t in zip(self.gain, self.transition, strict=True)]
        )
        bound = np.where(legal, bound * outwards, worst)
        groups = [_groups(t, self.observation) for t in self.transition]
        for _ in range(_SWEEPS):
            change = 0.0
            finite = np.where(legal, bound, 0.0)
            for a, (matrix, (row, start)) in enumerate(zip(self.transition, groups, strict=True)):
                if not start.size:
                    continue
                best = np.full(start.size, worst)
                seen = self.observation[matrix.indices[start]]
                for b in range(len(bound)):
                    ends = np.add.reduceat(matrix.data * finite[b][matrix.indices], start)
                    ends = np.where(self.available[seen, b], ends, worst)
                    best = np.maximum(best, ends) if self.maximize else np.minimum(best, ends)
                total = self.gain[a] + np.bincount(row, best, minlength=self.num_states)
                total = total * outwards
                better = total < bound[a] if self.maximize else total > bound[a]
                better &= legal[a]
                step = np.abs(total[better] - bound[a][better])
                change = max(change, float(step.max(initial=0)))
                bound[a] = np.where(better, total, bound[a])
            if change < _STILL * max(1.0, float(np.abs(finite).max(initial=0))):
                break
        return bound


def _groups(matrix: SparseMatrix, observation: Integers) -> tuple[Integers, Integers]:
    """The rows of groups of entries of equal row and observation, and their first entries."""
    row = np.repeat(np.arange(matrix.shape[0]), np.diff(matrix.indptr))
    seen = observation[matrix.indices]
    first = np.ones(row.size, bool)
    first[1:] = (row[1:] != row[:-1]) | (seen[1:] != seen[:-1])
    start = np.flatnonzero(first)
    return row[start], start


def reach_problem(
    pomdp: POMDP, target: Booleans, stay: Booleans | None, *, maximize: bool
) -> BeliefProblem:
    """The optimal probability of reaching a target through states where one may stay."""
    host = pomdp.fully_observable.host
    blocked = np.zeros(host.num_states, bool) if stay is None else ~stay & ~target
    inner = ~(blocked | target)[host.state]
    maybe = backward_reachable(host, target, inner) & ~target & ~blocked
    bound = solver.reachability(host, target, maximize=maximize, stay=stay, tolerance=1e-9)
    corner = bound.upper if maximize else bound.lower
    return _problem(pomdp, maybe, target, corner, None, maximize=maximize)


def reward_problem(
    pomdp: POMDP, reward: Floats, target: Booleans, *, maximize: bool
) -> BeliefProblem:
    """The optimal expected reward ``float64[R]`` until a target is reached."""
    host = pomdp.fully_observable.host
    bound = solver.total_reward(host, reward, target, maximize=maximize, tolerance=1e-9)
    corner = bound.upper if maximize else bound.lower
    return _problem(pomdp, ~target, target, corner, reward, maximize=maximize)


def discounted_problem(
    pomdp: POMDP, reward: Floats, target: Booleans, *, maximize: bool
) -> BeliefProblem:
    """The states of a discounted reward ``float64[R]`` until a target is reached, without bounds."""
    nothing = np.zeros(pomdp.num_states)
    return _problem(pomdp, ~target, target, nothing, reward, maximize=maximize)


def leaking_problem(
    pomdp: POMDP, ends: Floats, succeeds: Booleans, *, maximize: bool
) -> BeliefProblem:
    """The probability that a run ends with success, where transitions ``[T]`` end it with some probability."""
    from scipy.sparse import csr_array

    host = pomdp.fully_observable.host
    index = host.successor, host.entry_start
    shape = host.num_rows, host.num_states
    chance = np.asarray(host.probability, np.float64)
    matrix = csr_array((chance * (1 - ends), *index), shape=shape)
    gain = np.zeros(host.num_rows)
    np.add.at(gain, host.row, chance * ends * succeeds)
    none = np.zeros(host.num_states, bool)
    corner = np.full(host.num_states, float(maximize))
    problem = _problem(pomdp, ~none, none, corner, gain, maximize=maximize, matrix=matrix)
    return replace(problem, is_reward=False)


def _problem(
    pomdp: POMDP,
    maybe: Booleans,
    target: Booleans,
    corner: Floats,
    reward: Floats | None,
    *,
    maximize: bool,
    matrix: SparseMatrix | None = None,
) -> BeliefProblem:
    from scipy.sparse import csr_array

    model = pomdp.fully_observable
    host, seen = model.host, np.asarray(pomdp.observation)
    among = np.asarray(model.initial) > 0
    source = host.state[host.row]
    among = forward_reachable(source, host.successor, among)
    state = np.flatnonzero(maybe & among)
    state = state[np.argsort(seen[state], kind="stable")]
    number = np.full(host.num_states, -1)
    number[state] = np.arange(state.size)
    table, steps = pomdp.row_of_action, host.matrix if matrix is None else matrix
    entering = host.expectation(target.astype(np.float64)) if reward is None else reward
    gain = np.zeros((pomdp.num_actions, state.size))
    transition = []
    for action in range(pomdp.num_actions):
        row = table[state, action]
        some = row >= 0
        gain[action, some] = entering[row[some]]
        inner = steps[row[some]][:, state].tocoo()
        place = np.flatnonzero(some)[inner.coords[0]]
        part = csr_array((inner.data, (place, inner.coords[1])), shape=(state.size, state.size))
        part.sort_indices()
        transition.append(part)
    initial = np.asarray(model.initial, np.float64)
    # Where the value is infinite, a large number is a lower bound that stays finite in sums.
    finite = np.isfinite(corner)
    corner = np.where(finite, corner, 1e9 * (1 + corner[finite].max(initial=0)))
    return BeliefProblem(
        pomdp,
        maximize,
        reward is not None,
        state,
        number,
        seen[state],
        tuple(transition),
        gain,
        initial[state],
        float(initial[target].sum()) if reward is None else 0.0,
        corner[state],
        finite[state],
        bool((~finite & (initial > 0)).any()),
    )
