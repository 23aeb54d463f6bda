"""Bounds on the expected number of steps of learned policies, and their trade-offs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jaxltl.app.wording import Record, enclosure
from jaxltl.core.models.product import Product
from jaxltl.core.values.undiscounted.mixture import Mixture, least_mixture
from jaxltl.core.values.undiscounted.optimal_actions import OptimalActions
from jaxltl.core.values.undiscounted.satisfaction_steps import StepAnalysis, Quickest
from jaxltl.core.values.undiscounted.satisfaction_steps import meeting, steps_front

_SHARES = np.linspace(0, 0.9, 7)  # of the quickest policy, in the trade-off with the likelihood


@dataclass(frozen=True)
class StepBound:
    """A bound on the expected number of steps to satisfaction, and a policy that keeps it."""

    quickest: Quickest  # the quickest optimal policy
    limit: float  # infinite without a bound
    anchor: np.ndarray  # float[S, Q, A], meets all requirements; its share is mixed in
    factor: float | None  # multiple of the quickest optimal policy's steps, if the limit is one
    probability: float  # certified satisfaction probability that is kept; 0 if actions ensure it
    over: str

    def keep(self, model: Product, policy: np.ndarray) -> Mixture:
        """The policy with the least share of the anchor that keeps the bound."""
        if np.isinf(self.limit):
            return Mixture(policy, 0.0, 0.0)
        return least_mixture(
            model, policy, self.anchor, self.probability, over=self.over, steps=self.limit
        )


def step_bound(
    model: Product,
    actions: OptimalActions,
    requested: str | float,
    over: str,
    steps: float | None,
    factor: float | None,
) -> StepBound | None:
    """The bound that a task file requests; None for safety tasks, which take no steps."""
    if model.automaton.is_safety:
        if steps is not None:
            raise ValueError(
                f"guarantee has steps = {steps:g}, but a safety formula is never decided by being "
                "satisfied: leave steps out."
            )
        return None
    quickest = StepAnalysis(model).quickest(actions)
    anchor, least = np.eye(model.num_actions)[quickest.policy], quickest.steps.upper
    probability = 0.0 if isinstance(requested, str) else float(requested)
    if steps is None:
        bounded = factor is not None and requested != "none" and np.isfinite(least)
        limit = factor * least if bounded and factor is not None else np.inf
        return StepBound(quickest, limit, anchor, factor, probability, over)
    if steps < least:
        anchor = _anchor(model, quickest, requested, over, steps)
    return StepBound(quickest, steps, anchor, None, probability, over)


def _anchor(
    model: Product, quickest: Quickest, requested: str | float, over: str, steps: float
) -> np.ndarray:
    """A policy with an asked probability in fewer steps than the quickest optimal policy takes."""
    text = (
        f"guarantee = {{ probability = {1 if requested == 'best' else requested}, steps = {steps:g} }}: the "
        f"quickest policy with the best probability takes {quickest.steps.value:.6g} steps"
    )
    if isinstance(requested, str) or over != "mean" or not model.automaton.is_cosafe:
        raise ValueError(f"{text}; ask for at least so many.")
    front_point = meeting(model, requested, steps, quickest)
    if front_point.policy is None:
        raise ValueError(
            f"{text}, and in {steps:g} steps no policy has more than {max(front_point.upper, 0):.6g}; ask "
            "for more steps or a smaller probability."
        )
    return front_point.policy


def about_steps(
    model: Product, bound: StepBound, before: np.ndarray, mixture: Mixture, counts: np.ndarray
) -> Record:
    """The steps of a policy, its trade-off with the likelihood, and the front of the task.

    Args:
      before: ``float[S, Q, A]``, the policy before mixing.
      counts: ``float[S, Q, A]``, of demonstrated pairs.
    """
    clock = StepAnalysis(model)
    learned = mixture.steps or clock.steps(mixture.policy)
    record: Record = {
        "until": "the formula is decided" if model.automaton.is_cosafe else "acceptance",
        "learned": learned.value,
        "learned_bounds": [learned.lower, learned.upper],
        "quickest": bound.quickest.steps.value,
        "quickest_bounds": [bound.quickest.steps.lower, bound.quickest.steps.upper],
        "least": bound.quickest.least,
        "limit": bound.limit,
        "factor": bound.factor if np.isfinite(bound.limit) else None,
        "share": mixture.share,
        "status": learned.status.name,
    }
    shares = [0.0] if np.isinf(bound.limit) else sorted({*_SHARES.tolist(), mixture.share})
    mixed = [(x, (1 - x) * before + x * bound.anchor) for x in shares]
    record["likelihood"] = [
        {
            "share": share,
            "steps": enclosure(*clock.steps(policy)[:3]),
            "neg_log_likelihood": neg_log_likelihood(policy, counts),
        }
        for share, policy in mixed
    ]
    if model.automaton.is_cosafe:
        record["front"] = front(model, bound.quickest)
    return record


def front(model: Product, quickest: Quickest | None = None) -> list[Record]:
    """The front of probability and steps of a co-safe task."""
    return [
        {"probability": enclosure(*one.probability), "steps": enclosure(*one.steps)}
        for one in steps_front(model, quickest)
    ]


def neg_log_likelihood(policy: np.ndarray, counts: np.ndarray) -> float:
    """Negative log-likelihood of demonstrations."""
    seen = counts > 0
    with np.errstate(divide="ignore"):
        return float(-np.sum(counts[seen] * np.log(policy[seen])))
