"""Values of small interval models in fractions: vertices of rows as actions, policy iteration."""

import itertools
from fractions import Fraction

import numpy as np


def box(lower, upper):
    """The vertices of a row between ends: all but one entry at an end."""
    found = set()
    for free in range(len(lower)):
        rest = [i for i in range(len(lower)) if i != free]
        for ends in itertools.product(*({lower[i], upper[i]} for i in rest)):
            last = 1 - sum(ends)
            if lower[free] <= last <= upper[free]:
                p = list(ends)
                p.insert(free, last)
                found.add(tuple(p))
    return found


def ball(lower, upper, center, most):
    """Of two or three entries that gain no more than that: where two constraints bind."""
    if len(lower) == 1:
        return {(Fraction(1),)}
    k, limits = len(lower), []
    for i in range(k):
        limits += [
            ([int(j == i) for j in range(k)], upper[i]),
            ([-int(j == i) for j in range(k)], -lower[i]),
        ]
    for some in itertools.product((0, 1), repeat=k):
        if any(some):
            limits.append(
                (list(some), most + sum(c for c, s in zip(center, some, strict=True) if s))
            )
    # The last entry is what the others leave.
    short = [([x - a[-1] for x in a[:-1]], b - a[-1]) for a, b in limits]
    found = set()
    for binding in itertools.combinations(short, k - 1):
        p = solve([a for a, _ in binding], [b for _, b in binding])
        if p is not None and all(
            sum(x * y for x, y in zip(a, p, strict=True)) <= b for a, b in short
        ):
            found.add((*p, 1 - sum(p)))
    return found


def solve(matrix, right):
    """The solution of a system; None if there is not one."""
    rows = [[Fraction(x) for x in (*a, b)] for a, b in zip(matrix, right, strict=True)]
    for j in range(len(rows)):
        pivot = next((i for i in range(j, len(rows)) if rows[i][j]), None)
        if pivot is None:
            return None
        rows[j], rows[pivot] = rows[pivot], rows[j]
        rows[j] = [x / rows[j][j] for x in rows[j]]
        for i in range(len(rows)):
            if i != j and rows[i][j]:
                rows[i] = [x - rows[i][j] * y for x, y in zip(rows[i], rows[j], strict=True)]
    return [row[-1] for row in rows]


def actions(host):
    """Of each state its rows, each a list of distributions ``{state: probability}``."""
    mdp, found = host.mdp, []
    for s in range(mdp.num_states):
        found.append([])
        for r in range(mdp.row_start[s], mdp.row_start[s + 1]):
            of = slice(mdp.entry_start[r], mdp.entry_start[r + 1])
            ends = [[Fraction(float(x)) for x in of_[of]] for of_ in (host.lower, host.upper)]
            if host.ball is None:
                every = box(*ends)
            else:
                every = ball(
                    *ends,
                    [Fraction(float(x)) for x in host.ball.center[of]],
                    Fraction(float(host.ball.gain[r])),
                )
            assert every
            found[-1].append(
                [
                    {int(t): x for t, x in zip(mdp.successor[of], p, strict=True) if x}
                    for p in sorted(every)
                ]
            )
    return found


def optimum(choices, goal, cost, maximize):
    """The best sum of costs until the goal, and what one ends with there: None where infinite.

    Args:
      choices: of each state its distributions, with the row of each.
      goal: what states are worth that end a run.
      cost: of each row; None for a probability.
    """
    states, open_ = range(len(choices)), [s for s in range(len(choices)) if s not in goal]
    value = dict(goal)
    if cost is None:
        # The least of a probability is found from policies that may never end: they get 0.
        good = {s for s in goal if goal[s]}
        able = _led(choices, good, open_, any if maximize else all)
        value |= {s: Fraction(0) for s in open_ if s not in able}
        open_ = [s for s in open_ if s in able]
        pick = _towards(choices, good, open_) if maximize else {s: choices[s][0] for s in open_}
    elif maximize:
        lost = set(open_) - _led(choices, set(goal), open_, all)
        lost = _led(choices, lost, open_, any) if lost else lost
        value |= dict.fromkeys(lost)
        open_ = [s for s in open_ if s not in lost]
        pick = {s: choices[s][0] for s in open_}
    else:
        inside = set(states)
        while True:
            kept = {s: [a for a in choices[s] if set(a[1]) <= inside] for s in inside}
            able = _led(kept, set(goal), [s for s in open_ if s in inside], any)
            if able == inside:
                break
            inside = able
        value |= {s: None for s in open_ if s not in inside}
        open_ = [s for s in open_ if s in inside]
        choices = [kept.get(s, []) for s in states]
        pick = _towards(choices, set(goal), open_)
    while True:
        index = {s: i for i, s in enumerate(open_)}
        matrix = [[int(s == t) - pick[s][1].get(t, 0) for t in open_] for s in open_]
        right = [
            _cost(cost, pick[s])
            + sum(p * value[t] for t, p in pick[s][1].items() if t not in index)
            for s in open_
        ]
        value |= dict(zip(open_, solve(matrix, right), strict=True))
        better = {}
        for s in open_:
            worth = [
                _cost(cost, a) + sum(p * value[t] for t, p in a[1].items()) for a in choices[s]
            ]
            best = max(worth) if maximize else min(worth)
            if best != value[s]:
                better[s] = choices[s][worth.index(best)]
        if not better:
            return [value[s] for s in states]
        pick |= better


def _cost(cost, action):
    return 0 if cost is None else Fraction(float(cost[action[0]]))


def _led(choices, goal, open_, some):
    """The states of which some (all) distributions lead to a goal with positive probability."""
    found = set(goal)
    while new := {
        s for s in open_ if s not in found and some(bool(set(a[1]) & found) for a in choices[s])
    }:
        found |= new
    return found


def _towards(choices, goal, open_):
    """A distribution of each open state that leads nearer to a goal."""
    found, pick = set(goal), {}
    while len(pick) < len(open_):
        for s in open_:
            near = [a for a in choices[s] if set(a[1]) & found]
            if s not in pick and near:
                pick[s] = near[0]
        found |= set(pick)
    return pick


def values(host, goal, ends, cost, *, maximize, large):
    """The probability of a goal, or the cost until an end, of policy and nature, by brute force."""
    worth = {int(s): Fraction(int(goal[s] and cost is None)) for s in np.flatnonzero(ends)}
    rows, start = actions(host), host.mdp.row_start
    every = [
        [(start[s] + i, p) for i, row in enumerate(rows[s]) for p in row] for s in range(len(rows))
    ]
    if maximize == large:
        return optimum(every, worth, cost, maximize)
    best = None
    for policy in itertools.product(*(range(len(row)) for row in rows)):
        found = optimum(
            [[(r, p) for r, p in every[s] if r == start[s] + policy[s]] for s in range(len(rows))],
            worth,
            cost,
            large,
        )
        found = [np.inf if x is None else x for x in found]
        best = (
            found
            if best is None
            else [(max if maximize else min)(x, y) for x, y in zip(best, found, strict=True)]
        )
    return [None if x == np.inf else x for x in best]
