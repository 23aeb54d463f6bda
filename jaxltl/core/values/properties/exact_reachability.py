"""Reachability probabilities of small Markov chains in rational arithmetic."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.sparse.mdp import HostMDP

MAX_STATES = 1000
MAX_UNDECIDED = 32  # elimination with fractions of thousands of bits: a tenth of a second


def exact_reachability(
    chain: HostMDP, target: Booleans, stay: Booleans | None = None
) -> tuple[Floats, Floats] | None:
    """Reachability bounds by rational state elimination; None if the chain is too large."""
    if chain.num_states > MAX_STATES:
        return None
    inner = ~target if stay is None else stay & ~target
    source = chain.state[chain.row]
    reaches = target.copy()
    while (more := inner[source] & reaches[chain.successor] & ~reaches[source]).any():
        reaches[source[more]] = True
    undecided = np.flatnonzero(inner & reaches)
    if undecided.size > MAX_UNDECIDED:
        return None
    rows = {int(s): _row(chain, int(s)) for s in undecided}
    order: list[int] = []
    for s in list(rows):  # substitutes the equation of s into those of the states that follow
        loop = rows[s].pop(s, Fraction(0))
        rows[s] = {t: p / (1 - loop) for t, p in rows[s].items()}
        order.append(s)
        for u in list(rows)[len(order) :]:
            weight = rows[u].pop(s, Fraction(0))
            for t, p in rows[s].items() if weight else ():
                rows[u][t] = rows[u].get(t, Fraction(0)) + weight * p
    value = {s: Fraction(int(target[s])) for s in range(chain.num_states)}
    for s in reversed(order):
        value[s] = sum((p * value[t] for t, p in rows[s].items()), Fraction(0))
    exact = [value[s] for s in range(chain.num_states)]
    return np.array([_rounded(x, -1) for x in exact]), np.array([_rounded(x, 1) for x in exact])


def _row(chain: HostMDP, state: int) -> dict[int, Fraction]:
    """The normalised distribution of successors."""
    row: dict[int, Fraction] = {}
    for e in range(*chain.entry_start[state : state + 2].tolist()):
        t = int(chain.successor[e])
        row[t] = row.get(t, Fraction(0)) + Fraction(float(chain.probability[e]))
    total = sum(row.values())
    return {t: p / total for t, p in row.items()}


def _rounded(number: Fraction, direction: int) -> float:
    """The double next to a fraction, not above it (-1) or not below it (1)."""
    found = float(number)
    beyond = (Fraction(found) - number) * direction < 0
    return math.nextafter(found, direction * math.inf) if beyond else found
