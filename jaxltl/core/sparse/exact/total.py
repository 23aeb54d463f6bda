"""Optimal total rewards and reachability probabilities by policy iteration in fractions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.exact.model import ONE, ZERO, ExactMDP, Work, chain_values, flags
from jaxltl.core.sparse.graph.qualitative import (
    almost_sure_reachability,
    backward_reachable,
    end_components,
    positive_under_all_policies,
    shortest_path_rows,
)
from jaxltl.core.sparse.rows import mask_of


def reachability(
    mdp: ExactMDP, target: Booleans, stay: Booleans | None, maximize: bool, work: Work
) -> list[Fraction | float]:
    """Optimal probabilities of ``stay U target``."""
    lost = np.zeros_like(target) if stay is None else ~stay & ~target
    final = dict.fromkeys(flags(target), ONE) | dict.fromkeys(flags(lost), ZERO)
    return least_total(mdp, [ZERO] * len(mdp.rows), final, maximize, work)


def least_total(
    mdp: ExactMDP,
    constant: Sequence[Fraction],
    final: Mapping[int, Fraction],
    maximize: bool,
    work: Work,
) -> list[Fraction | float]:
    """Optimal total of nonnegative constants and a final value, 0 for a run without an end.

    The least solution of ``x = g`` in final states and ``x = opt_r (c_r + P_r x)`` elsewhere,
    infinite where a constant is earned for ever.
    """
    graph, ends = mdp.graph, _mask(mdp, final)
    positive = np.array([c > 0 for c in constant], bool)
    if maximize:
        components = end_components(graph, states=~ends)
        earning = graph.states_of(components.inside & positive)
        # All rows of a component are taken infinitely often by some policy.
        earning = mask_of(components.component[earning], mdp.num_states)[components.component]
        earning &= components.region(graph)
        infinite = backward_reachable(graph, earning, ~ends[graph.state])
        policy = graph.row_start[:-1]
        return _iterate(mdp, constant, final, infinite, policy, _Rule(True, None, work))
    zero = ~ends | _mask(mdp, [s for s, x in final.items() if not x])
    while True:
        free = ~positive & ~graph.support.some_successor_in(~zero)
        smaller = zero & (ends | graph.states_of(free))
        if (smaller == zero).all():
            break
        zero = smaller
    final = dict.fromkeys(flags(zero), ZERO) | dict(final)
    return until_end(mdp, constant, final, maximize, work)


def until_end(
    mdp: ExactMDP,
    constant: Sequence[Fraction],
    final: Mapping[int, Fraction],
    maximize: bool,
    work: Work,
) -> list[Fraction | float]:
    """Optimal total of nonnegative constants and a final value, infinite for a run without an end."""
    graph, ends = mdp.graph, _mask(mdp, final)
    if maximize:
        avoiding = ~positive_under_all_policies(graph, ends)
        infinite = backward_reachable(graph, avoiding, ~ends[graph.state])
        rule = _Rule(True, None, work)
        return _iterate(mdp, constant, final, infinite, graph.row_start[:-1], rule)
    inside, kept = almost_sure_reachability(graph, ends)
    policy = shortest_path_rows(graph, ends, kept)
    return _iterate(mdp, constant, final, ~inside, policy, _Rule(False, kept, work))


class _Rule:
    """The direction, the rows among which a policy chooses, and the work."""

    def __init__(self, maximize: bool, rows: Booleans | None, work: Work) -> None:
        self.maximize, self.rows, self.work = maximize, rows, work


def _iterate(
    mdp: ExactMDP,
    constant: Sequence[Fraction],
    final: Mapping[int, Fraction],
    infinite: Booleans,
    policy: Integers,
    rule: _Rule,
) -> list[Fraction | float]:
    """Policy iteration with strict improvements (Howard 1960).

    For maxima, a class of states that an improved policy never leaves earns nothing and contains no
    improvement, since the values are invariant there; so values ascend to a solution of the
    optimality equation that a policy attains. For minima, the first policy ends almost surely, and
    by the same argument so do its improvements.
    """
    states = [s for s in range(mdp.num_states) if s not in final and not infinite[s]]
    row = {s: int(policy[s]) for s in states}
    while True:
        value = chain_values(
            {s: mdp.rows[r] for s, r in row.items()},
            {s: constant[r] for s, r in row.items()},
            final,
            rule.work,
        )
        table = [value.get(s, ZERO) for s in range(mdp.num_states)]
        improved = False
        for s in states:
            best = table[s]
            for r in mdp.choices(s):
                if r == row[s] or not (rule.rows is None or rule.rows[r]):
                    continue
                image = constant[r] + mdp.expectation(r, table, rule.work)
                if (image > best) if rule.maximize else (image < best):
                    best, row[s], improved = Fraction(image), r, True
        if not improved:
            return [math.inf if infinite[s] else x for s, x in enumerate(table)]


def _mask(mdp: ExactMDP, states: object) -> Booleans:
    return mask_of(np.array(sorted(states), np.int64), mdp.num_states)  # type: ignore[call-overload]
