"""Properties of partially observable models, from their initial beliefs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.logic.bounded import Bounded, Conditional, Earned
from jaxltl.core.logic.comparisons import Definitions
from jaxltl.core.logic.good_prefixes import is_plain_reachability
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.properties import Property, parse_property
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.rewards import default_reward
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.partial_observability.solve import (
    TOLERANCE,
    belief_bounds,
    partially_observable_satisfaction,
)
from jaxltl.core.values.properties.answers import Answer, with_definitions


def solve_partially_observable(pomdp: POMDP, prop: Property | str, tolerance: float) -> Answer:
    """The answer for the first initial state, which stands for the initial belief.

    `strategy` is a finite-memory policy over observations. The width of the bounds is at least 1e-3, or
    the tolerance if that is greater.
    """
    world = pomdp.fully_observable
    if isinstance(prop, str):
        prop = parse_property(prop, Definitions(variables=tuple(world.valuation)))
    if prop.aggregate is not None or prop.coalition is not None or prop.nature is not None:
        raise ValueError(
            f"{prop.text}: a POMDP is solved from its initial belief, for one player and without intervals; "
            "leave out filters, coalitions and directions of nature."
        )
    world = _defined(world, prop)
    joint = replace(pomdp, fully_observable=world)
    objective = prop.direction
    if objective is None:
        raise ValueError(
            f"{prop.text}: the value depends on the controller; ask for {prop.operator}max=? or "
            f"{prop.operator}min=?."
        )
    width = max(tolerance, TOLERANCE)
    solution = _solved(joint, prop, objective, width)
    lower, upper = float(solution.lower), float(solution.upper)
    holds, status = None, Status(int(solution.status))
    if prop.relation is not None:
        holds = [_meets(prop, lower, upper)]
        status = Status.PRECISION if holds[0] is None else Status.CONVERGED
    return Answer(
        np.flatnonzero(np.asarray(pomdp.initial) > 0)[:1],
        np.array([float(solution.value)]),
        np.array([lower]),
        np.array([upper]),
        holds,
        status,
        solution.method,
        solution.policy,  # type: ignore[arg-type]
    )


def _defined(world: SparseMDP, prop: Property) -> SparseMDP:
    def refuse(model: object, part: Property) -> Answer:
        raise ValueError(
            f"{part.text}: nested properties of a POMDP are not supported; a state does not determine what a "
            "controller knows."
        )

    changed = with_definitions(world, prop, refuse)
    assert isinstance(changed, SparseMDP)
    return changed


def _meets(prop: Property, lower: float, upper: float) -> bool | None:
    assert prop.relation is not None and prop.threshold is not None
    tests = {
        ">=": lambda x: x >= prop.threshold,
        ">": lambda x: x > prop.threshold,
        "<=": lambda x: x <= prop.threshold,
        "<": lambda x: x < prop.threshold,
    }
    first, last = tests[prop.relation](lower), tests[prop.relation](upper)
    return bool(first) if first == last else None


def _solved(pomdp: POMDP, prop: Property, objective: str, width: float) -> Solution:
    path, world = prop.path, pomdp.fully_observable
    if prop.operator == "P" and isinstance(path, Formula):
        return partially_observable_satisfaction(pomdp, path, objective=objective, tolerance=width)
    if prop.operator == "P" and isinstance(path, Bounded | Conditional):
        raise ValueError(
            f"{prop.text}: step bounds and conditions are not supported for a POMDP; count the steps in a "
            "variable of the program."
        )
    is_total = isinstance(path, Formula) and prop.unreached == "infinite"
    is_total = is_total and isinstance(path, Formula) and is_plain_reachability(path)
    if prop.operator not in ("R", "T") or not is_total or isinstance(path, Earned):
        raise ValueError(
            f"{prop.text}: of a POMDP there are bounds of P with a co-safe or safe formula, and of Rmin and Tmin "
            "with F; evaluate a controller by solve_property(controlled_chain(pomdp, policy), ...)."
        )
    assert isinstance(path, Formula)
    target = states_satisfying(world, path.operands[0], prop.text)
    reward = np.ones(world.num_rows) if prop.operator == "T" else prop.reward
    if reward is None:
        reward = default_reward(world.rewards)
    return belief_bounds(pomdp, target, reward=reward, objective=objective, tolerance=width)
