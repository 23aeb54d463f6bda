"""Properties of several objectives: ``multi(...)`` as the arguments of the solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from jaxltl.core.logic.bounded import Bounded, Conditional, Earned, Recognized, unfolded
from jaxltl.core.logic.good_prefixes import is_plain_reachability
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.property import MAX_UNFOLDED_STEPS, Property
from jaxltl.core.models.construct.property_models import step_product
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.models.rewards import default_reward
from jaxltl.core.models.sparse import SparseMDP, choice_reward, reward_structure
from jaxltl.core.values.properties.exact_thresholds import acceptor
from jaxltl.core.values.multi_objective.multi_objective import (
    Achievable,
    ConstrainedOptimum,
    Objective,
    Pareto,
    achievable,
    constrained_optimum,
    pareto,
)


MAX_COUNTED = 10**7  # transitions of a product with a counter of steps


def solve_multi_objective(
    model: SparseMDP, prop: Property, tolerance: float
) -> Achievable | ConstrainedOptimum | Pareto:
    """Solution of ``multi(...)``: the objectives without a threshold say which of three questions it is."""
    model, prop = _without_steps(model, prop)
    parts = [_objective(model, x) for x in prop.parts]
    free = sum(part.threshold is None for part in parts)
    if not free:
        return achievable(model, parts, tolerance=tolerance)
    if free == 1:
        return constrained_optimum(model, parts, tolerance=tolerance)
    if free < len(parts):
        raise ValueError(
            f"{prop.text}: {free} of {len(parts)} objectives have no threshold; give one to all but one of "
            "them (the best value), to all (achievability) or to none (the curve)."
        )
    return pareto(model, parts, tolerance=max(tolerance, 1e-6))


def _without_steps(model: SparseMDP, prop: Property) -> tuple[SparseMDP, Property]:
    """The rewards of some steps, ``C<=k``, as total rewards of a product with a counter of steps."""
    parts, rewards = list(prop.parts), {}
    for i, part in enumerate(parts):
        steps = part.path.steps if isinstance(part.path, Earned) else None
        if steps is None or str(part.path)[0] != "C" or part.discount is not None:
            continue
        name = default_reward(model.rewards) if part.reward is None else part.reward
        reward_structure(model, name)  # which names the rewards
        counted = f"[{name} in {steps} steps]"
        rewards[counted] = name, steps
        parts[i] = replace(part, reward=counted, path=Earned("total"))
    if not rewards:
        return model, prop
    largest = max(steps for _, steps in rewards.values())
    if model.num_transitions * (largest + 1) > MAX_COUNTED:
        raise ValueError(
            f"{prop.text}: the model with a counter of {largest} steps has more than {MAX_COUNTED:.0e} "
            "transitions; ask for fewer steps."
        )
    return step_product(model, largest, rewards), replace(prop, parts=tuple(parts))


def _objective(model: SparseMDP, prop: Property) -> Objective:
    direction = prop.objective
    if prop.relation is not None:
        if prop.relation in (">", "<"):
            raise ValueError(
                f"{prop.text}: strict thresholds are not supported inside multi(...); "
                f"write {prop.relation}=."
            )
        wanted = "max" if prop.relation == ">=" else "min"
        if direction not in (None, wanted):
            raise ValueError(
                f"{prop.text}: inside multi(...) one strategy must meet the "
                f"threshold; write {prop.operator}{prop.relation}."
            )
        direction = wanted  # type: ignore[assignment]
    if direction is None:
        raise ValueError(
            f"{prop.text}: inside multi(...), ask for {prop.operator}max=? or "
            f"{prop.operator}min=?, or give a threshold."
        )
    quantity = _event(model, prop) if prop.operator == "P" else _sum(model, prop)
    return Objective(direction=direction, threshold=prop.threshold, **quantity)


def _event(model: SparseMDP, prop: Property) -> dict[str, PyTree]:
    path = prop.path
    if isinstance(path, Bounded):
        if path.reward is not None or max(path.lower, path.upper or 0) > MAX_UNFOLDED_STEPS:
            raise ValueError(
                f"{prop.text}: inside multi(...) a bound must be on at most "
                f"{MAX_UNFOLDED_STEPS} steps."
            )
        path = unfolded(path)
    if isinstance(path, Recognized):
        return {"formula": acceptor(path)}
    if isinstance(path, Conditional):
        raise ValueError(
            f"{prop.text}: inside multi(...) there are no conditional probabilities, ||; write "
            "(PATH) | (PATH) for at least one of two paths."
        )
    assert isinstance(path, Formula)
    if path.operator not in ("F", "G", "U") or not all(is_boolean(f) for f in path.operands):
        return {"formula": path}
    stay, right = (states_satisfying(model, path.operands[i], prop.text) for i in (0, -1))
    if path.operator == "G":
        return {"avoid": ~right}
    if path.operator == "F":
        return {"target": right}
    return {"target": right, "stay": stay}


def _sum(model: SparseMDP, prop: Property) -> dict[str, PyTree]:
    path = prop.path
    is_total = isinstance(path, Formula) or (isinstance(path, Earned) and path.kind == "total")
    if prop.operator == "LRA" or not is_total or prop.unreached != "infinite":
        raise ValueError(
            f"{prop.text}: inside multi(...) only probabilities, R [ F ... ], R [ C ], "
            "R [ C<=k ] and T are supported."
        )
    # By name, so that its exact numbers are those of the model's source.
    name = next(iter(model.rewards)) if len(model.rewards) == 1 else None
    reward = np.ones(model.num_rows) if prop.operator == "T" else prop.reward or name
    if reward is None:
        reward = choice_reward(model, None)  # which names the rewards
    if isinstance(path, Formula):
        if not is_plain_reachability(path):
            raise ValueError(
                f"{prop.text}: inside multi(...) rewards are earned until a state formula holds, R [ F ... ]."
            )
        target = states_satisfying(model, path.operands[0], prop.text)
        return {"reward": reward, "target": target}
    return {"reward": reward}
