"""Model checking of ``multi(...)``: several objectives of one strategy."""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np

from jaxltl.core.logic.bounded import Bounded, unfolded
from jaxltl.core.logic.labels import is_boolean
from jaxltl.core.logic.ltl import TRUE, Formula
from jaxltl.core.logic.properties import MAX_UNFOLDED_STEPS, Property
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.models.sparse import SparseMDP, choice_reward
from jaxltl.core.types import Status
from jaxltl.core.values.multi_objective.front_search import nearest_mixture
from jaxltl.core.values.multi_objective.multi_objective import (
    Achievable,
    ConstrainedOptimum,
    NearestMixture,
    Objective,
    Pareto,
    multi_objective,
)


def solve_multi_objective(
    model: SparseMDP, prop: Property, tolerance: float
) -> Achievable | ConstrainedOptimum | Pareto:
    """Solution of ``multi(...)``; thresholds that are not doubles are rounded to either side."""
    strict = _solved(model, prop, tolerance, strict=True)
    exact = all(_rounded(x, True) == _rounded(x, False) for x in prop.parts)
    if exact or isinstance(strict, Pareto) or (isinstance(strict, Achievable) and strict.holds):
        return strict
    loose = _solved(model, prop, tolerance, strict=False)
    if isinstance(strict, Achievable) or isinstance(loose, Achievable):
        if isinstance(loose, Achievable) and loose.holds:
            return loose._replace(
                holds=None, share=None, status=Status.PRECISION, nearest=_missing(prop, loose)
            )
        return loose
    assert isinstance(strict, ConstrainedOptimum) and isinstance(loose, ConstrainedOptimum)
    return _between(prop, strict, loose)


def _between(
    prop: Property, strict: ConstrainedOptimum, loose: ConstrainedOptimum
) -> ConstrainedOptimum:
    """The result for thresholds between those of two results."""
    if loose.holds is False or strict.holds is None:
        return loose if loose.holds is False else strict
    if not strict.holds:
        return loose._replace(
            holds=None, share=None, status=Status.PRECISION, nearest=_missing(prop, loose)
        )
    return strict._replace(
        lower=min(strict.lower, loose.lower),
        upper=max(strict.upper, loose.upper),
        status=max(strict.status, loose.status),
    )


def _missing(prop: Property, loose: Achievable | ConstrainedOptimum) -> NearestMixture | None:
    """The mixture of strategies nearest to the thresholds."""
    if loose.share is None:
        return loose.nearest
    wanted = [_rounded(x, True) for x in prop.parts]
    signs = np.array([-1 if x.relation == "<=" or x.objective == "min" else 1 for x in prop.parts])
    thresholds = np.array(
        [-s * np.inf if x is None else x for x, s in zip(wanted, signs, strict=True)]
    )
    return nearest_mixture(loose.front, loose.share, thresholds, signs)


def _solved(
    model: SparseMDP, prop: Property, tolerance: float, *, strict: bool
) -> Achievable | ConstrainedOptimum | Pareto:
    parts = [_objective(model, x, strict) for x in prop.parts]
    return multi_objective(model, parts, tolerance=tolerance)


def _rounded(prop: Property, strict: bool) -> float | None:
    """The threshold rounded to a double that is not easier to meet (`strict`), or not harder."""
    if prop.threshold is None:
        return None
    found = float(prop.threshold)
    up = (prop.relation == ">=") == strict
    if up and Fraction(found) < prop.threshold:
        return math.nextafter(found, math.inf)
    if not up and Fraction(found) > prop.threshold:
        return math.nextafter(found, -math.inf)
    return found


def _objective(model: SparseMDP, prop: Property, strict: bool) -> Objective:
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
    given: dict[str, PyTree] = {"direction": direction, "threshold": _rounded(prop, strict)}
    if prop.operator == "P":
        return Objective(**given, **_event(model, prop))
    return Objective(**given, **_sum(model, prop))


def _event(model: SparseMDP, prop: Property) -> dict[str, PyTree]:
    path = prop.path
    if isinstance(path, Bounded):
        if path.reward is not None or max(path.lower, path.upper or 0) > MAX_UNFOLDED_STEPS:
            raise ValueError(
                f"{prop.text}: inside multi(...) a bound must be on at most "
                f"{MAX_UNFOLDED_STEPS} steps."
            )
        path = unfolded(path)
    assert isinstance(path, Formula)

    def where(condition: Formula) -> np.ndarray:
        return states_satisfying(model, condition, prop.text)

    if path.operator in ("F", "G", "U") and all(is_boolean(f) for f in path.operands):
        left, right = path.operands[0], path.operands[-1]
        if path.operator == "G":
            return {"avoid": ~where(right)}
        if path.operator == "F" or left == TRUE:
            return {"target": where(right)}
        return {"target": where(right), "stay": where(left)}
    return {"formula": path}


def _sum(model: SparseMDP, prop: Property) -> dict[str, PyTree]:
    path = prop.path
    if prop.operator == "LRA" or not (isinstance(path, Formula) or path.kind == "total"):  # type: ignore[union-attr]
        raise ValueError(
            f"{prop.text}: inside multi(...) only probabilities, R [ F ... ], R [ C ] "
            "and T are supported."
        )
    reward = np.ones(model.num_rows) if prop.operator == "T" else choice_reward(model, prop.reward)
    if isinstance(path, Formula):
        target = states_satisfying(model, path.operands[0], prop.text)
        return {"reward": reward, "target": target}
    return {"reward": reward}
