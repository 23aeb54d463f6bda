"""Total rewards of games, and rewards that count only if a target is reached, in fractions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.sparse.exact.model import ONE, ZERO, ExactMDP, Values, Work
from jaxltl.core.sparse.exact.total import least_total
from jaxltl.core.sparse.solvers.reward_if_reached import LevelEnds

Final = Mapping[int, Fraction]


def game_total(
    mdp: ExactMDP, constant: Sequence[Fraction], final: Final, maximizing: Booleans, work: Work
) -> Values:
    """Value of the total of a game, by strict improvements of the maximiser (Hoffman and Karp 1966).

    As :func:`~jaxltl.core.sparse.exact.total.least_total`, a maximum in some states ``bool[S]``.
    """
    row = {s: mdp.row_start[s] for s in np.flatnonzero(maximizing).tolist() if s not in final}
    while True:
        taken = [[row[s]] if s in row else list(mdp.choices(s)) for s in range(mdp.num_states)]
        starts = [0, *np.cumsum([len(rows) for rows in taken]).tolist()]
        used = [r for rows in taken for r in rows]
        part = ExactMDP(starts, [mdp.rows[r] for r in used])
        value = least_total(part, [constant[r] for r in used], final, False, work)
        improved = False
        for s in row:
            best = value[s]
            for r in mdp.choices(s):
                image = constant[r] + mdp.expectation(r, value, work)
                if image > best:
                    best, row[s], improved = image, r, True
        if not improved:
            return value


def game_if_reached(
    mdp: ExactMDP, units: Integers, target: Booleans, ends: LevelEnds, up: Booleans, work: Work
) -> tuple[Values, Values]:
    """Bounds of rewards in units that count if a target is reached, by levels of collected reward.

    Args:
      units: ``int[T]``, of the entries in the order of the successors of each row.
      ends: bounds of the values of states in which a number of units is collected.
    """
    place = np.concatenate([[0], np.cumsum([len(row) for row in mdp.rows])]).tolist()
    sink, open_ = mdp.num_states, ends.open_.tolist()
    earned = [
        dict(zip(sorted(row), units[i:j].tolist(), strict=True))
        for row, i, j in zip(mdp.rows, place[:-1], place[1:], strict=True)
    ]
    # The rows within a level; the last state stands for all that leaves it.
    starts, rows, origin = [0], list[dict[int, Fraction]](), list[int]()
    for s in range(sink):
        for r in mdp.choices(s):
            if open_[s] and ends.rows[r]:
                inner = {t: p for t, p in mdp.rows[r].items() if open_[t] and not earned[r][t]}
                rest = 1 - sum(inner.values(), ZERO)
                rows.append(inner | ({sink: rest} if rest else {}))
                origin.append(r)
        if len(rows) == starts[-1]:
            rows.append({s: ONE})
            origin.append(-1)
        starts.append(len(rows))
    level = ExactMDP([*starts, len(rows) + 1], [*rows, {sink: ONE}])
    final = {sink: ZERO} | {s: ZERO for s in range(sink) if not open_[s]}

    reach, kept = ([Fraction(x) for x in end.tolist()] for end in (ends.reach, ends.kept))

    def solve(upper: bool) -> Values:
        table: dict[int, Values] = {}
        for z in range(ends.num_units, ends.num_units + int(units.max(initial=0))):
            more = [x + z - ends.num_units if x else ZERO for x in kept]
            table[z] = more if upper else [z * x for x in reach]
        for z in reversed(range(ends.num_units)):
            constant = [ZERO] * (len(rows) + 1)
            for i, r in enumerate(origin):
                for t, p in mdp.rows[r].items() if r >= 0 else ():
                    if target[t]:
                        constant[i] += p * (z + earned[r][t])
                    elif earned[r][t] and open_[t]:
                        x = table[z + earned[r][t]][t]
                        assert isinstance(x, Fraction)
                        work.spend(x)
                        constant[i] += p * x
            table[z] = game_total(level, constant, final, np.append(up, False), work)[:sink]
        return table[0]

    infinite = ends.infinite.tolist()
    low, high = (
        [math.inf if inf else x for x, inf in zip(solve(upper), infinite, strict=True)]
        for upper in (False, True)
    )
    return low, high
