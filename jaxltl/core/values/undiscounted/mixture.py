"""Mixtures of two policies with a certified satisfaction probability, on the host.

A mixture is ``(1 - share) policy + share other`` in each product state, again a memoryless policy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import Solution
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability

WINDOW = 0.02  # maximal excess of the certified probability over the required one
_AIM = WINDOW / 4  # excess at which the bisection ends
_HALVINGS = 30


@brief
class Mixture(NamedTuple):
    """A mixture with its certified satisfaction probability."""

    policy: np.ndarray  # ``float[S, Q, A]``
    share: float  # of the second policy, in [0, 1]
    attained: float  # lower bound of the probability, of the mean or the worst initial state


def at_starts(model: Product, value: Any, over: str) -> tuple[float, int]:
    """The mean or minimum of a value over the initial states, and the state of the minimum."""
    weight = np.asarray(model.mdp.initial, float)
    starts = np.flatnonzero(weight > 0)
    known = from_starts(model, value)[starts].astype(float)
    least, place = known.min(), int(starts[known.argmin()])
    if over == "worst":
        return float(least), place
    # Rounding must not move the mean out of the range.
    mean = known @ (weight[starts] / weight[starts].sum())
    return float(np.clip(mean, least, known.max())), place


def from_starts(model: Product, value: Any) -> np.ndarray:
    """The value ``[S]`` at the initial memory of each world state, from ``[S, Q]``."""
    memory = np.asarray(model.initial_memory)
    return np.asarray(value)[np.arange(len(memory)), memory]


def attained(model: Product, policy: Any, over: str) -> float:
    """Lower bound of a policy's probability, for the mean or the worst initial state."""
    found = satisfaction_probability(model, to_jax(np.asarray(policy, model.dtype)))
    return at_starts(model, found.lower, over)[0]


def require_attainable(
    model: Product, best: Solution, probability: float, over: str, place: Callable[[int], str]
) -> None:
    """Raises a ValueError if the required probability exceeds the optimal one."""
    possible, where = at_starts(model, best.lower, over)
    if possible < probability:
        raise ValueError(
            f"guarantee = {probability}: the best that can be achieved is "
            f"{np.floor(possible * 1e6) / 1e6:g} "
            + (
                "on average over the initial states"
                if over == "mean"
                else "from the worst initial state"
            )
            + f" (least from {place(where)}); ask for no more than that, or change the "
            "task, the map or where runs start."
        )


def least_mixture(
    model: Product, policy: Any, sure: Any, probability: float, *, over: str = "mean"
) -> Mixture:
    """The mixture with the least share of `sure` that has a certified probability, by bisection."""
    # The share is below 1 if possible, so that no action of `policy` gets probability 0.
    policy, sure = np.asarray(policy), np.asarray(sure)
    found = Mixture(policy, 0.0, attained(model, policy, over))
    if found.attained >= probability:
        return found
    found = Mixture(sure, 1.0, attained(model, sure, over))
    low, high = 0.0, 1.0
    aim = probability + min(_AIM, (found.attained - probability) / 64)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        mixed = (1 - middle) * policy + middle * sure
        reached = attained(model, mixed, over)
        if reached < probability:
            low = middle
            continue
        high, found = middle, Mixture(mixed, middle, reached)
        if reached <= aim:
            break
    return found


def reaching(
    model: Product,
    policy: Any,
    inside: Any,
    best: Solution,
    probability: float,
    *,
    over: str = "mean",
) -> Mixture:
    """The mixture with the least share of an optimal policy that has a required probability."""
    # If the mixture with `inside` exceeds the required probability by more than a window (because
    # `inside` takes long, so that the smallest share of suboptimal actions matters), the mixture
    # with the fastest optimal policy is tried too.
    found = least_mixture(model, policy, inside, probability, over=over)
    if found.share and found.attained > probability + WINDOW:
        quickest = np.eye(model.num_actions)[np.asarray(best.policy)]
        other = least_mixture(model, policy, quickest, probability, over=over)
        found = other if other.share < found.share else found
    return found


def safe_mean(share: np.ndarray, bound: np.ndarray, *, up: bool, highest: float = np.inf) -> float:
    """The weighted mean of nonnegative bounds, rounded up or down."""
    bound = np.asarray(bound, np.float64)
    if (bound == bound[0]).all():
        return float(bound[0])
    slack = (share.size + 4) * float(np.finfo(np.float64).eps)
    mean = float(share @ bound / share.sum())
    return min(mean * (1 + slack), highest) if up else mean * (1 - slack)


def safe_ends(model: Any, found: Any, *, highest: float = np.inf) -> tuple[float, float]:
    """Enclosure of the mean over the initial distribution, from `lower` and `upper`."""
    share = np.asarray(model.initial, np.float64)
    start = np.flatnonzero(share)
    low, high = (
        safe_mean(share[start], x[start], up=up, highest=highest)
        for x, up in ((found.lower, False), (found.upper, True))
    )
    return low, high
