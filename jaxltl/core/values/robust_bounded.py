"""What can be reached in so many steps when probabilities lie in intervals, enclosed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from jaxltl.core.host import interval_bounded
from jaxltl.core.host.interval_bounded import RobustSteps
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.types import Method, Solution
from jaxltl.core.values.bounded import enclosed, states
from jaxltl.core.values.robust import require_direction


def robust_next_probability(
    model: IntervalMDP, target: Any, *, objective: str = "max", nature: str | None = None
) -> Solution:
    """Probability that the next state is in a set, when probabilities lie in intervals.

    ``opt_a opt_p sum_t p_t [t in target]``, p among the distributions of row a.

    Args:
      model: the model.
      target: ``bool[S]``, or the name of a label.
      objective: ``"max"`` or ``"min"``, what the policy makes of the probability.
      nature: ``"min"`` or ``"max"``, what nature makes of it; default: the opposite.

    Returns:
      :class:`~jaxltl.core.types.Solution`, exactly 0 or 1 where supports say so.

    Raises:
      ValueError: the target, or a direction.

    Example:
      >>> from jaxltl.core.models.interval import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> robust_next_probability(coin, [False, True]).value.tolist()
      [0.5, 1.0]
    """
    nature = require_direction(nature, objective)
    chosen = states(model.nominal, target, "target")
    return _solution(interval_bounded.next_step(
        model.host, chosen, maximize=objective == "max", helpful=nature == "max"))


def robust_bounded_reachability(
    model: IntervalMDP, target: Any, num_steps: int, *, stay: Any = None, objective: str = "max",
    nature: str | None = None,
) -> Solution:
    """Probability to reach a set within so many steps, when probabilities lie in intervals.

    ``x_0 = [s in target]``, and ``x_{k+1}(s) = 1`` on the target, ``opt_a opt_p sum_t p_t x_k(t)``
    where one may stay, else 0; nature picks anew in each step (Givan, Leach and Dean 2000).

    Args:
      model: the model.
      target: ``bool[S]``, or the name of a label.
      num_steps: how many steps there are at most.
      stay: ``bool[S]`` or a label, what must hold before the target is reached; default anything.
      objective, nature: as of :func:`robust_next_probability`.

    Returns:
      :class:`~jaxltl.core.types.Solution`; `policy` and `nature` are of the first
      step, with all steps left.

    Raises:
      ValueError: a shape, a direction, or a negative number of steps.

    Example:
      >>> from jaxltl.core.models.interval import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3], [0, 1, 1], [0.25, 0.5, 1], [0.5, 0.75, 1])
      >>> robust_bounded_reachability(coin, [False, True], 2, nature="max").value.tolist()
      [0.9375, 1.0]
    """
    nature = require_direction(nature, objective)
    if num_steps != int(num_steps) or num_steps < 0:
        raise ValueError(f"num_steps={num_steps}; it must be a whole number, at least 0.")
    goal = states(model.nominal, target, "target")
    free = np.ones_like(goal) if stay is None else states(model.nominal, stay, "stay")
    return _solution(interval_bounded.until(
        model.host, goal, free, int(num_steps), maximize=objective == "max",
        helpful=nature == "max"))


def _solution(found: RobustSteps) -> Solution:
    """What sweeps found, enclosed."""
    nature: Any = found.probability
    solution = enclosed(
        found.value, found.error, found.row.astype(np.int32), found.num_steps, highest=1)
    return replace(solution, nature=nature, method=Method("step by step"))
