"""Questions about partially observable models, for the table of engines."""

from __future__ import annotations

from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.rewards import default_reward
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, Question, Reach, TotalReward, Until
from jaxltl.core.values.partial_observability.solve import (
    TOLERANCE,
    belief_bounds,
    controller_value,
)


def reach(pomdp: POMDP, question: Question, accuracy: Accuracy) -> Solution:
    """Probabilities from the initial belief, of a controller or optimal between bounds."""
    path = question.path
    assert isinstance(path, Reach | Until)
    stay = path.stay if isinstance(path, Until) else None
    if question.policy is not None:
        return controller_value(
            pomdp, question.policy, path.target, stay=stay, tolerance=accuracy.width(1e-6)
        )
    return belief_bounds(
        pomdp,
        path.target,
        stay=stay,
        objective=question.objective,
        tolerance=accuracy.width(TOLERANCE),
    )


def earn(pomdp: POMDP, question: Question, accuracy: Accuracy) -> Solution:
    """Total rewards until a target, of a controller or optimal between bounds."""
    path = question.path
    assert isinstance(path, TotalReward)
    if path.target is None or path.unreached != "infinite":
        raise ValueError(
            "total rewards of a POMDP need a target, and are infinite unless it is reached almost surely; "
            "give a target, without unreached."
        )
    reward = default_reward(pomdp.rewards) if path.reward is None else path.reward
    if question.policy is not None:
        return controller_value(
            pomdp, question.policy, path.target, reward=reward, tolerance=accuracy.width(1e-6)
        )
    return belief_bounds(
        pomdp,
        path.target,
        reward=reward,
        objective=question.objective,
        tolerance=accuracy.width(TOLERANCE),
    )
