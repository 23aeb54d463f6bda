"""Values of small games with intervals, by trying all positional strategies and all vertices.

A case is a game of two players against, or with, a nature that picks each row's distribution among
the vertices of its intervals. A decision process has one player, a chain has rows of one state each,
and an exact row has one vertex. Positional strategies suffice for every question here (Chatterjee and
Henzinger 2012), but for those within k steps, which the recursion over the steps defines.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

SUCCESSORS = 2  # so that a row of intervals has two vertices


@dataclass(frozen=True)
class Case:
    """A game on the actions ``[S, A]``; see :func:`random_case`."""

    successor: np.ndarray  # int[S, A, K]
    probability: np.ndarray  # float[S, A, K], multiples of 1 / 16
    lower: np.ndarray  # float[S, A, K], ends of the intervals
    upper: np.ndarray
    available: np.ndarray  # bool[S, A]
    system: np.ndarray  # bool[S]
    label: np.ndarray  # bool[S, 2], of the propositions a and b
    reward: np.ndarray  # float[S, A], at least 0
    policy: np.ndarray  # int[S]

    @property
    def num_states(self) -> int:
        return len(self.system)

    @property
    def a(self) -> np.ndarray:
        return self.label[:, 0]

    @property
    def b(self) -> np.ndarray:
        return self.label[:, 1]


def random_case(rng: np.random.Generator, num_states: int, *, is_chain: bool = False) -> Case:
    """Rows of two successors, some of them certain; each action leads somewhere."""
    num_actions = 1 if is_chain else 2
    shape = (num_states, num_actions)
    successor = np.argsort(rng.random((*shape, num_states)), axis=-1)[..., :SUCCESSORS]
    first = rng.integers(2, 15, shape) / 16
    certain = rng.random(shape) < 0.25
    slack = np.where(certain | (rng.random(shape) < 0.3), 0, rng.integers(1, 3, shape) / 16)
    first = np.where(certain, 1.0, first)
    middle = np.stack([first, 1 - first], -1)
    available = rng.random(shape) < 0.8
    available[np.arange(num_states), rng.integers(num_actions, size=num_states)] = True
    still = rng.random(num_states) < 0.2
    successor[still] = np.stack([np.arange(num_states)[still]] * 2, -1)[:, None]
    successor[still, :, 1] = (successor[still, :, 0] + 1) % num_states
    middle[still] = [1.0, 0.0]
    slack[still] = 0
    on = available[..., None]
    reward = np.where(available, rng.integers(0, 9, shape) / 4, 0)
    label = rng.random((num_states, 2)) < [0.6, 0.35]
    return Case(
        np.where(on & (middle > 0), successor, 0),
        np.where(on, middle, 0),
        np.where(on, np.maximum(middle - slack[..., None], 0), 0),
        np.where(on & (middle > 0), np.minimum(middle + slack[..., None], 1), 0),
        available,
        rng.random(num_states) < 0.5,
        label,
        reward,
        np.array([rng.choice(np.flatnonzero(row)) for row in available]),
    )


@dataclass(frozen=True)
class Aims:
    """The direction in which each player optimises, 1 or -1, or 0 if there is no such player."""

    system: int
    environment: int = 0
    nature: int = 0


def vertices(case: Case, s: int, a: int, intervals: bool) -> list[np.ndarray]:
    """The extreme distributions ``[S]`` of a row."""
    ends = [case.probability[s, a]]
    if intervals:
        low, high = case.lower[s, a], case.upper[s, a]
        # Two successors: one end of the first one decides both.
        least, most = max(low[0], 1 - high[1]), min(high[0], 1 - low[1])
        ends = [np.array([p, 1 - p]) for p in sorted({least, most})]
    result = []
    for end in ends:
        row = np.zeros(case.num_states)
        np.add.at(row, case.successor[s, a], end)
        result.append(row)
    return result


def options(case: Case, aims: Aims, policy: np.ndarray | None) -> list[tuple[list, list]]:
    """For each state, the rows ``[[(row, reward)]]`` by the choices of who maximises and minimises."""
    found = []
    for s in range(case.num_states):
        own = bool(case.system[s]) or aims.environment == 0
        owner, fixed = (aims.system, policy is not None) if own else (aims.environment, False)
        actions = [policy[s]] if fixed else np.flatnonzero(case.available[s])
        rows = [
            [(p, case.reward[s, a]) for p in vertices(case, s, a, aims.nature != 0)]
            for a in actions
        ]
        same = aims.nature in (0, owner) or all(len(row) == 1 for row in rows)
        if same:
            flat = [x for row in rows for x in row]
            table = [[x] for x in flat] if owner > 0 else [flat]
        else:
            # Nature answers with a vertex for each action.
            answers = list(itertools.product(*(range(len(row)) for row in rows)))
            table = [[rows[i][answer[i]] for answer in answers] for i in range(len(rows))]
            if owner < 0:
                table = [list(column) for column in zip(*table, strict=True)]
        found.append(table)
    return found


def optimum(case: Case, aims: Aims, value, policy: np.ndarray | None = None) -> np.ndarray:
    """``max`` over one side's strategies of ``min`` over the other's of a value of chains.

    `value` is a function of matrices ``[N, S, S]`` and rewards ``[N, S]`` to values ``[N, S]``.
    """
    return minimax(options(case, aims, policy), value)


def minimax(tables, value) -> np.ndarray:
    """The value of the game in which each state has a table as of :func:`options`."""
    outer = list(itertools.product(*(range(len(t)) for t in tables)))
    inner = list(itertools.product(*(range(len(t[0])) for t in tables)))
    chosen = [[tables[s][i[s]][j[s]] for s in range(len(tables))] for i in outer for j in inner]
    matrices = np.array([[row for row, _ in one] for one in chosen])
    rewards = np.array([[paid for _, paid in one] for one in chosen])
    values = value(matrices, rewards)
    return values.reshape(len(outer), len(inner), len(tables)).min(1).max(0)


# --- values of chains [N, S, S] ---------------------------------------------------------------------


def leads(matrix: np.ndarray) -> np.ndarray:
    """Reflexive and transitive closure of the supports."""
    size = matrix.shape[-1]
    step = (matrix > 0) | np.eye(size, dtype=bool)
    for _ in range(size.bit_length()):
        step = step.astype(int) @ step.astype(int) > 0
    return step


def stopped(matrix: np.ndarray, still: np.ndarray) -> np.ndarray:
    """The chains in which some states ``bool[S]`` or ``bool[N, S]`` are absorbing."""
    return np.where(still[..., None], np.eye(matrix.shape[-1]), matrix)


def solve(matrix: np.ndarray, inner: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``x = right + P x`` on the inner states ``bool[N, S]``, and 0 elsewhere."""
    part = np.where(inner[:, :, None] & inner[:, None, :], matrix, 0)
    system = np.eye(matrix.shape[-1]) - part
    return np.linalg.solve(system, np.where(inner, right, 0)[..., None])[..., 0]


def reach(matrix: np.ndarray, goal: np.ndarray, stay: np.ndarray | None = None) -> np.ndarray:
    """Probability of the goal ``bool[S]`` or ``bool[N, S]``, through the states of `stay`."""
    goal = np.broadcast_to(goal, matrix.shape[:2])
    chain = stopped(matrix, goal if stay is None else goal | ~stay)
    inner = (leads(chain) & goal[:, None, :]).any(-1) & ~goal
    value = solve(chain, inner, (chain * goal[:, None, :]).sum(-1))
    sure = ~(leads(chain) & ~(inner | goal)[:, None, :]).any(-1)
    return np.where(goal | sure, 1.0, value)


def total(matrix: np.ndarray, reward: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Expected reward until the goal, infinite where it is not reached almost surely."""
    sure = reach(matrix, goal) == 1
    return np.where(sure, solve(matrix, sure & ~goal, reward), np.inf)


def discounted(matrix: np.ndarray, reward: np.ndarray, discount: float) -> np.ndarray:
    return np.linalg.solve(np.eye(matrix.shape[-1]) - discount * matrix, reward[..., None])[..., 0]


def average(matrix: np.ndarray, reward: np.ndarray) -> np.ndarray:
    """The mean reward in the long run, by the limit of the lazy chain."""
    limit = (matrix + np.eye(matrix.shape[-1])) / 2
    for _ in range(50):
        limit = limit @ limit
        limit /= limit.sum(-1, keepdims=True)
    return (limit @ reward[..., None])[..., 0]


def recurring(matrix: np.ndarray, often: np.ndarray, *, always: bool) -> np.ndarray:
    """Probability that the set is visited infinitely often, or in the end for ever."""
    path = leads(matrix)
    recurrent = (~path | path.transpose(0, 2, 1)).all(-1)
    good = (~path | often).all(-1) if always else (path & often).any(-1)
    return reach(matrix, recurrent & good)


# --- recursions over steps -----------------------------------------------------------------------------


def steps(
    case: Case, aims: Aims, number: int, start: np.ndarray, update, policy: np.ndarray | None = None
) -> np.ndarray:
    """``x_{k+1}(s) = update(s, opt (r + P x_k)(s))`` from ``x_0 = start``; the reward may be 0."""
    tables, value = options(case, aims, policy), start
    for _ in range(number):
        ahead = [
            max(min(update(s, row @ value, paid) for row, paid in line) for line in table)
            for s, table in enumerate(tables)
        ]
        value = np.array(ahead)
    return value


def within_budget(
    case: Case,
    aims: Aims,
    goal: np.ndarray,
    reward: np.ndarray,
    budget: float,
    policy: np.ndarray | None = None,
) -> np.ndarray:
    """Probability of a goal before more than a budget of positive rewards is earned."""
    tables = options(replace(case, reward=reward), aims, policy)

    @cache
    def value(left: float) -> np.ndarray:
        if left < 0:
            return np.zeros(case.num_states)
        ahead = [
            max(min(row @ value(left - paid) for row, paid in line) for line in table)
            for table in tables
        ]
        return np.where(goal, 1.0, ahead)

    return value(budget)
