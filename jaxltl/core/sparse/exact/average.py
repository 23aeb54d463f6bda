"""Optimal long-run averages by policy iteration in fractions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from jaxltl.core.array_types import Booleans
from jaxltl.core.sparse.exact.model import ONE, ZERO, ExactMDP, Work, chain_values, flags
from jaxltl.core.sparse.exact.total import least_total
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.graph.qualitative import end_components


def average(
    mdp: ExactMDP, reward: Sequence[Fraction], maximize: bool, work: Work
) -> list[Fraction | float]:
    """Optimal expected long-run average rewards: optimal stopping with the gains of end components.

    Puterman 1994, chapter 9.
    """
    sign = 1 if maximize else -1
    least = min(sign * c for c in reward)
    earned = [sign * c - least for c in reward]  # not negative
    graph = mdp.graph
    components = end_components(graph)
    member = components.region(graph)
    gains: dict[int, Fraction] = {}
    for first in sorted(set(components.component[member].tolist())):
        part = _Part(mdp, earned, components.inside, work)
        gains[first] = part.gain(flags(member & (components.component == first)))
    # A state of a component may stop with its gain, in a state of its own.
    rows, row_start = [], [0]
    end = {first: mdp.num_states + i for i, first in enumerate(gains)}
    for s in range(mdp.num_states):
        rows += [mdp.rows[r] for r in mdp.choices(s)]
        if member[s]:
            rows.append({end[int(components.component[s])]: ONE})
        row_start.append(len(rows))
    for t in end.values():
        rows.append({t: ONE})
        row_start.append(len(rows))
    final = {end[first]: gain for first, gain in gains.items()}
    stopped = ExactMDP(row_start, rows)
    value = least_total(stopped, [ZERO] * len(rows), final, True, work)
    return [sign * (x + least) for x in value[: mdp.num_states]]


class _Part:
    """Rows that stay in end components."""

    def __init__(
        self, mdp: ExactMDP, reward: Sequence[Fraction], inside: Booleans, work: Work
    ) -> None:
        self.mdp, self.reward, self.inside, self.work = mdp, reward, inside, work

    def gain(self, states: Sequence[int]) -> Fraction:
        """The maximal gain of an end component, by policy iteration (Haviv and Puterman 1991).

        Each policy has one recurrent class. An improved policy has another one only if its gain is
        larger; the other states are then led to a class with the largest gain.
        """
        choices = {s: [r for r in self.mdp.choices(s) if self.inside[r]] for s in states}
        row = self.one_class(choices, {s: rows[0] for s, rows in choices.items()})
        while True:
            gain, bias = self.evaluate(row)
            improved = dict(row)
            for s, rows in choices.items():
                best = gain + bias[s]
                for r in rows:
                    self.work.spend(best, len(self.mdp.rows[r]))
                    image = self.reward[r] + self.mdp.expectation(r, bias, self.work)
                    if image > best:
                        best, improved[s] = Fraction(image), r
            if improved == row:
                return gain
            row = self.one_class(choices, improved)

    def evaluate(self, row: Mapping[int, int]) -> tuple[Fraction, list[Fraction]]:
        """The gain and the bias of a policy, which is 0 in a recurrent state, by renewal there."""
        (states,) = self.classes(row)
        z = states[0]
        rest = {s: self.mdp.rows[r] for s, r in row.items() if s != z}
        earned = {s: self.reward[row[s]] for s in rest}
        total = chain_values(rest, earned, {z: ZERO}, self.work)
        steps = chain_values(rest, dict.fromkeys(rest, ONE), {z: ZERO}, self.work)
        cycle = [
            c + sum((p * x[t] for t, p in self.mdp.rows[row[z]].items()), ZERO)
            for c, x in ((self.reward[row[z]], total), (ONE, steps))
        ]
        gain = cycle[0] / cycle[1]
        bias = [ZERO] * self.mdp.num_states
        for s in row:
            bias[s] = total[s] - gain * steps[s]
        return gain, bias

    def classes(self, row: Mapping[int, int]) -> list[list[int]]:
        """The recurrent classes of a policy."""
        number = {s: i for i, s in enumerate(row)}
        edges = [(number[s], number[t]) for s, r in row.items() for t in self.mdp.rows[r]]
        source, target = np.array(edges, np.int64).T
        leader = strong_components(source, target, len(number))
        left = set(leader[source[leader[source] != leader[target]]].tolist())
        parts: dict[int, list[int]] = {}
        for s, i in number.items():
            if leader[i] not in left:
                parts.setdefault(int(leader[i]), []).append(s)
        return list(parts.values())

    def one_class(
        self, choices: Mapping[int, Sequence[int]], row: Mapping[int, int]
    ) -> dict[int, int]:
        """The policy, or where it has several classes one that leads to the best of these."""
        classes = self.classes(row)
        if len(classes) == 1:
            return dict(row)
        best = max(classes, key=lambda states: self.evaluate({s: row[s] for s in states})[0])
        led = {s: row[s] for s in best}
        while len(led) < len(row):
            for s, rows in choices.items():
                if s not in led:
                    nearer = [r for r in rows if any(t in led for t in self.mdp.rows[r])]
                    if nearer:
                        led[s] = nearer[0]
        return {s: led[s] for s in row}
