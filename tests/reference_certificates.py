"""Exact values of tiny models by brute force over positional strategies and vertices of intervals."""

import itertools
import math
from fractions import Fraction


def vertices(row):
    """The extreme distributions of a row of intervals, or the normalised row of doubles."""
    if not isinstance(row[0][1], tuple):
        total = sum(Fraction(p) for _, p in row)
        return [[(t, Fraction(p) / total) for t, p in row]]
    results = []
    for order in itertools.permutations(range(len(row))):
        mass = [Fraction(low) for _, (low, _) in row]
        missing = 1 - sum(mass)
        for i in order:
            more = min(missing, Fraction(row[i][1][1]) - mass[i])
            mass[i] += more
            missing -= more
        distribution = [(t, p) for (t, _), p in zip(row, mass, strict=True)]
        if distribution not in results:
            results.append(distribution)
    return results


def solve(matrix, right):
    """The solution of a regular linear system in fractions."""
    size = len(matrix)
    table = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for i in range(size):
        pivot = next(j for j in range(i, size) if table[j][i])
        table[i], table[pivot] = table[pivot], table[i]
        table[i] = [x / table[i][i] for x in table[i]]
        for j in range(size):
            if j != i and table[j][i]:
                table[j] = [x - table[j][i] * y for x, y in zip(table[j], table[i], strict=True)]
    return [row[-1] for row in table]


def reaching(chain, target, stay):
    """States from which a path through `stay` reaches the target."""
    result = set(target)
    while more := {s for s in stay - result if any(p and t in result for t, p in chain[s])}:
        result |= more
    return result


def chain_values(chain, target, stay, reward=None, discount=None):
    """Values of a chain: probabilities of `stay U target`, or rewards until the target."""
    states = set(range(len(chain)))
    positive = reaching(chain, target, stay)
    values = [Fraction(int(s in target and reward is None)) for s in states]
    open_states = sorted(positive - set(target))
    if discount is not None:
        open_states = sorted(states)
    elif reward is not None:
        lost = reaching(chain, states - positive, states - set(target)) | (states - positive)
        for s in lost:
            values[s] = math.inf
        open_states = sorted(positive - lost - set(target))
    place = {s: i for i, s in enumerate(open_states)}
    matrix = [[Fraction(int(i == j)) for j in range(len(place))] for i in range(len(place))]
    right = []
    for s in open_states:
        total = Fraction(0) if reward is None else Fraction(reward[s])
        for t, p in chain[s]:
            if t in place:
                matrix[place[s]][place[t]] -= p * (1 if discount is None else discount)
            elif p and discount is None:
                total += p * values[t]
        right.append(total)
    for s, x in zip(open_states, solve(matrix, right), strict=True):
        values[s] = x
    return values


def total_values(chain, reward):
    """Total rewards of at least 0: infinite where a recurrent state with a reward is reachable."""
    states = set(range(len(chain)))
    ahead = {s: {t for t in states if s in reaching(chain, {t}, states)} for s in states}
    recurrent = {s for s in states if all(s in ahead[t] for t in ahead[s])}
    idle = {s for s in recurrent if not any(reward[t] for t in ahead[s])}
    return chain_values(chain, idle, states, reward)


def better(values, others, direction):
    """The better of two lists, state by state; the first may be None."""
    choose = max if direction == "max" else min
    return others if values is None else [*map(choose, values, others)]


def optimum(states, owner, directions, value_of_chain):
    """Optimal values, and by direction the rows of its players that attain them.

    `directions` are those of the system (owner 0), the environment (owner 1) and nature;
    `value_of_chain` gives the values of one distribution and the row's number for each state.
    """
    numbers = range(len(states))

    def choices(direction):
        mine = [directions[x] == direction for x in owner]
        return itertools.product(*(range(len(states[s]) if mine[s] else 1) for s in numbers))

    def of_nature(rows):
        values = None
        for chain in itertools.product(*(vertices(states[s][rows[s]]) for s in numbers)):
            values = better(values, value_of_chain(list(chain), rows), directions[2])
        return values

    table = {
        (a, b): of_nature([a[s] + b[s] for s in numbers])
        for a in choices("max")
        for b in choices("min")
    }
    guaranteed = {}
    for (a, b), values in table.items():
        guaranteed["max", a] = better(guaranteed.get(("max", a)), values, "min")
        guaranteed["min", b] = better(guaranteed.get(("min", b)), values, "max")
    best = None
    for (direction, _), values in guaranteed.items():
        if direction == "max":
            best = better(best, values, "max")
    attained = {}
    for (direction, rows), values in guaranteed.items():
        if values == best:
            attained[direction] = list(rows)
    return best, attained
