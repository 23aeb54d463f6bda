"""Values of small chains and MDPs in fractions, by enumeration of memoryless policies.

Independent of the package: rows are ``[[{successor: probability}]]`` by state and choice.
"""

import itertools
import math
from fractions import Fraction

from tests.reference_fractions import solve

INF = math.inf


def policies(rows):
    return itertools.product(*(range(len(choices)) for choices in rows))


def chain_of(rows, policy):
    return [choices[a] for choices, a in zip(rows, policy, strict=True)]


def reached(chain, start):
    found, todo = {start}, [start]
    while todo:
        for t in chain[todo.pop()]:
            if t not in found:
                found.add(t)
                todo.append(t)
    return found


def classes(chain):
    """The recurrent classes."""
    after = [reached(chain, s) for s in range(len(chain))]
    return {frozenset(after[s]) for s in range(len(chain)) if all(s in after[t] for t in after[s])}


def absorbed(chain, final, cost):
    """Expected cost and final value until a final state; 0 in recurrent classes without cost."""
    size, value = len(chain), dict(final)
    stopped = [{s: Fraction(1)} if s in final else row for s, row in enumerate(chain)]
    for members in classes(stopped):
        if not members & final.keys():
            assert not any(cost[s] for s in members)
            value |= dict.fromkeys(members, Fraction(0))
    inner = [s for s in range(size) if s not in value]
    matrix = [[int(s == t) - chain[s].get(t, 0) for t in inner] for s in inner]
    right = [cost[s] + sum(p * value[t] for t, p in chain[s].items() if t in value) for s in inner]
    return [(value | dict(zip(inner, solve(matrix, right), strict=True)))[s] for s in range(size)]


def until(chain, goal, stay):
    final = {s: Fraction(int(s in goal)) for s in range(len(chain)) if s in goal or s not in stay}
    return absorbed(chain, final, [0] * len(chain))


def total(chain, goal, cost, *, must_end):
    """The expected cost until a goal; infinite where it may be missed, or has costs for ever."""
    stopped = [{s: Fraction(1)} if s in goal else row for s, row in enumerate(chain)]
    bad = {
        s
        for members in classes(stopped)
        if not members & goal and (must_end or any(cost[s] for s in members))
        for s in members
    }
    infinite = {s for s in range(len(chain)) if reached(stopped, s) & bad}
    final = dict.fromkeys(goal | infinite, Fraction(0))
    value = absorbed(chain, final, cost)
    return [INF if s in infinite else value[s] for s in range(len(chain))]


def mean(chain, cost):
    """The long-run average cost."""
    final = {}
    for members in classes(chain):
        order = sorted(members)
        # Stationary equations, the last of which is replaced by the sum.
        matrix = [[chain[t].get(s, 0) - int(s == t) for t in order] for s in order[:-1]]
        share = solve([*matrix, [1] * len(order)], [0] * (len(order) - 1) + [1])
        gain = sum((x * cost[s] for x, s in zip(share, order, strict=True)), Fraction(0))
        final |= dict.fromkeys(members, gain)
    return absorbed(chain, final, [0] * len(chain))


def infinitely(chain, sets, *, always):
    """The probability that a class with (within) one of the sets is entered."""
    good = {
        s
        for members in classes(chain)
        if any(members <= x if always else members & x for x in sets)
        for s in members
    }
    return until(chain, good, set(range(len(chain))))


def steps(rows, best, value, count, reward=None, fixed=frozenset()):
    """Backward induction from a value after some steps; the value of fixed states stays."""
    for _ in range(count):
        value = [
            value[s]
            if s in fixed
            else best(
                (reward[s] if reward else 0) + sum(p * value[t] for t, p in row.items())
                for row in choices
            )
            for s, choices in enumerate(rows)
        ]
    return value


def with_budget(rows, cost, limit):
    """States with what was spent, up to the limit plus one, by number ``s * (limit + 2) + spent``."""
    width = limit + 2
    return [
        [
            {t * width + min(spent + cost[s], limit + 1): p for t, p in row.items()}
            for row in choices
        ]
        for s, choices in enumerate(rows)
        for spent in range(width)
    ]


def optimum(rows, best, solve_chain):
    """The best value of memoryless policies, by state."""
    values = [solve_chain(chain_of(rows, policy)) for policy in policies(rows)]
    return [best(x) for x in zip(*values, strict=True)]
