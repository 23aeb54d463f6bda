"""Reachability probabilities of small Markov chains and MDPs in rational arithmetic."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.graph.qualitative import positive_under_all_policies
from jaxltl.core.sparse.mdp import HostMDP

MAX_STATES = 1000
MAX_UNDECIDED = 32  # elimination with fractions of thousands of bits: a tenth of a second
MAX_TERMS = 20_000  # products of fractions in all steps: a tenth of a second

Bounds = tuple[Floats, Floats]


def exact_reachability(
    mdp: HostMDP,
    target: Booleans,
    stay: Booleans | None = None,
    policy: Integers | None = None,
    objective: str = "max",
    complement: bool = False,
) -> Bounds | None:
    """Reachability bounds of a chain, or of an MDP by a policy `int[S]` of rows that is optimal.

    With `complement`, bounds of the probability of the complementary event.
    The value of a policy is optimal if it solves the optimality equation: it is at least the least
    solution, the maximum; the minimum is the only solution that is 0 where a policy avoids the
    target (Baier and Katoen 2008, section 10.6.1). None if the policy is not, or the model large.
    """
    inner = ~target if stay is None else stay & ~target
    value = _eliminated(mdp if policy is None else mdp.chain(policy), target, inner)
    if value is None:
        return None
    bounds = _bounds([1 - x for x in value] if complement else value)
    if policy is None:
        return bounds
    if mdp.successor.size > MAX_TERMS:
        return None
    best = _backup(mdp, value, objective)
    optimal = all(value[s] == best[s] for s in np.flatnonzero(inner))
    if objective == "min":
        avoided = ~positive_under_all_policies(mdp, target, among=inner | target)
        optimal &= not any(value[s] for s in np.flatnonzero(avoided))
    return bounds if optimal else None


def exact_steps(
    mdp: HostMDP,
    target: Booleans,
    objective: str,
    *,
    stay: Booleans | None = None,
    num_steps: int = 1,
    complement: bool = False,
) -> Bounds | None:
    """Step-bounded reachability bounds, without `stay` of being at a target after these steps.

    With `complement`, bounds of the complementary event.
    None if the model or the number of steps is large.
    """
    if num_steps * mdp.successor.size > MAX_TERMS:
        return None
    value = [Fraction(int(t)) for t in target]
    for _ in range(num_steps):
        value = _backup(mdp, value, objective)
        if stay is not None:
            states = zip(target, stay, value, strict=True)
            value = [Fraction(1) if t else x if s else Fraction(0) for t, s, x in states]
    return _bounds([1 - x for x in value] if complement else value)


def _backup(mdp: HostMDP, value: list[Fraction], objective: str) -> list[Fraction]:
    """Optimal expectation of the next state's value, for each state."""
    best: Callable[..., Fraction] = max if objective == "max" else min
    rows = (_row(mdp, r) for r in range(mdp.num_rows))
    image = [sum((p * value[t] for t, p in row.items()), Fraction(0)) for row in rows]
    return [best(image[a:b]) for a, b in itertools.pairwise(mdp.row_start.tolist())]


def _eliminated(chain: HostMDP, target: Booleans, inner: Booleans) -> list[Fraction] | None:
    """Reachability probabilities by state elimination; None if the chain is too large."""
    if chain.num_states > MAX_STATES:
        return None
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
    return [value[s] for s in range(chain.num_states)]


def _bounds(value: list[Fraction]) -> Bounds:
    return np.array([_rounded(x, -1) for x in value]), np.array([_rounded(x, 1) for x in value])


def _row(mdp: HostMDP, number: int) -> dict[int, Fraction]:
    """The normalised distribution of successors."""
    row: dict[int, Fraction] = {}
    for e in range(*mdp.entry_start[number : number + 2].tolist()):
        t = int(mdp.successor[e])
        row[t] = row.get(t, Fraction(0)) + Fraction(float(mdp.probability[e]))
    total = sum(row.values())
    return {t: p / total for t, p in row.items()}


def _rounded(number: Fraction, direction: int) -> float:
    """The double next to a fraction, not above it (-1) or not below it (1)."""
    nearest = float(number)
    beyond = (Fraction(nearest) - number) * direction < 0
    return math.nextafter(nearest, direction * math.inf) if beyond else nearest
