"""Step-bounded and reward-bounded values by backward induction in fractions."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction


from jaxltl.core.array_types import Booleans
from jaxltl.core.sparse.exact.model import ONE, ZERO, ExactMDP, Values, Work
from jaxltl.core.sparse.exact.total import least_total


_LEVEL_WORK = 100  # products that take as long as the graph searches of a level


def until_within(
    mdp: ExactMDP,
    target: Booleans,
    stay: Booleans | None,
    num_steps: int,
    maximize: bool | Booleans,
    work: Work,
) -> Values:
    """Optimal probabilities of a target within some steps, through states of `stay`."""
    free = [ZERO] * len(mdp.rows)
    inner = ~target if stay is None else stay & ~target
    value: list[Fraction | float] = [Fraction(int(x)) for x in target]
    for _ in range(num_steps):
        work.spend(ONE, len(mdp.rows))
        image = mdp.backup(free, value, maximize, work)
        value = [y if s else x for s, x, y in zip(inner, value, image, strict=True)]
    return value


def earned_within(
    mdp: ExactMDP,
    reward: Sequence[Fraction],
    final: Values,
    num_steps: int,
    maximize: bool | Booleans,
    work: Work,
) -> Values:
    """Optimal expected sums of the rewards of some steps and of a value after them."""
    value = list(final)
    for _ in range(num_steps):
        work.spend(ONE, len(mdp.rows))
        value = mdp.backup(reward, value, maximize, work)
    return value


def until_at_cost(
    mdp: ExactMDP,
    target: Booleans,
    stay: Booleans,
    budget: tuple[Sequence[dict[int, int]], int],
    maximize: bool,
    work: Work,
) -> Values:
    """Optimal probabilities of a target before steps cost more than a limit.

    Args:
      budget: for each row the cost of each successor, and the limit.
    """
    cost, limit = budget
    size = mdp.num_states
    # Steps that cost something lead to a state of their own, worth 0, and earn their value.
    free: list[dict[int, Fraction]] = []
    for row, costs in zip(mdp.rows, cost, strict=True):
        kept = {t: p for t, p in row.items() if not costs[t]}
        if rest := sum((p for t, p in row.items() if costs[t]), ZERO):
            kept[size] = rest
        free.append(kept)
    level_mdp = ExactMDP([*mdp.row_start, len(free) + 1], [*free, {size: ONE}])
    final = {s: Fraction(int(target[s])) for s in range(size) if target[s] or not stay[s]}
    final[size] = ZERO
    levels: list[Values] = []
    for level in range(limit + 1):
        work.spend(ONE, len(free) + _LEVEL_WORK)
        constant = [ZERO] * (len(free) + 1)
        for r, costs in enumerate(cost):
            for t, c in costs.items():
                if 0 < c <= level:
                    x = levels[level - c][t]
                    assert isinstance(x, Fraction)
                    work.spend(x)
                    constant[r] += mdp.rows[r][t] * x
        levels.append(least_total(level_mdp, constant, final, maximize, work)[:size])
    return levels[limit]
