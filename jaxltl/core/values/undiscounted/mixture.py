"""Mixtures of two policies with certified satisfaction probability and expected steps, on the host.

A mixture is ``(1 - share) policy + share other`` in each product state, again a memoryless policy.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import brief
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.undiscounted.optimal_actions import OptimalActions, optimal_actions
from jaxltl.core.values.undiscounted.satisfaction import satisfaction_probability
from jaxltl.core.values.undiscounted.satisfaction_steps import StepAnalysis, Steps

WINDOW = 0.02  # maximal excess of the certified probability over the required one
_AIM = WINDOW / 4  # excess at which a search ends
_HALVINGS = 30  # of the share where steps are bounded
_TRIALS = 20  # mixtures of a search
_LEAST_REST = -20.0  # logarithm of the least share of the first policy
# Widths of enclosures: narrower ones than needed take exact fractions for policies that hardly ever
# end.
_COARSE, _FINE, _FINEST = 1e-3, 1e-9, 1e-12


@brief
class Mixture(NamedTuple):
    """A mixture with its certified satisfaction probability and expected steps.

    Attributes:
      policy: ``float[S, Q, A]``.
      share: of the second policy, in [0, 1].
      attained: lower bound of the probability, of the mean or the worst initial state; 0 if none
        is required.
      steps: expected steps to satisfaction, if they are bounded.

    Example:
      >>> Mixture(np.ones((1, 1, 1)), 0.5, 0.9).share
      0.5
    """

    policy: np.ndarray
    share: float
    attained: float
    steps: Steps | None = None


def at_starts(model: Product, value: Array, over: str) -> tuple[float, int]:
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


def from_starts(model: Product, value: Array) -> np.ndarray:
    """The value ``[S]`` at the initial memory of each world state, from ``[S, Q]``."""
    memory = np.asarray(model.initial_memory)
    result: np.ndarray = np.asarray(value)[np.arange(len(memory)), memory]
    return result


def attained(model: Product, policy: Array, over: str, tolerance: float | None = None) -> float:
    """Lower bound of a policy's probability, for the mean or the worst initial state."""
    policy = to_jax(np.asarray(policy, model.dtype))
    solution = satisfaction_probability(model, policy, tolerance=tolerance)
    return at_starts(model, solution.lower, over)[0]


def attained_if_near(model: Product, policy: Array, over: str, probability: float) -> float:
    """:func:`attained`, as close as a comparison with a required probability needs."""
    for tolerance in (_COARSE, _FINE):
        reached = attained(model, policy, over, tolerance)
        if reached >= probability or reached + tolerance < probability:
            return reached
    return attained(model, policy, over)


def certified(model: Product, policy: Array, over: str, probability: float) -> Solution:
    """A policy's satisfaction probability, enclosed as closely as a required one needs."""
    policy = to_jax(np.asarray(policy, model.dtype))
    solution = satisfaction_probability(model, policy, tolerance=_FINE)
    if at_starts(model, solution.lower, over)[0] >= probability:
        return solution
    return satisfaction_probability(model, policy)


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
    model: Product,
    policy: Array,
    sure: Array,
    probability: float,
    *,
    over: str = "mean",
    steps: float = np.inf,
) -> Mixture:
    """The mixture with the least share of `sure` that meets certified requirements.

    Requires a satisfaction probability, and a bound on the expected steps to satisfaction, if
    `sure` has both; else the result is `sure`.
    """
    # The share is below 1 if possible, so that no action of `policy` gets probability 0.
    policy, sure = np.asarray(policy), np.asarray(sure)
    if np.isinf(steps):
        mixture = probable_mixture(model, policy, sure, probability, over)
        close = attained(model, mixture.policy, over, _FINE)
        return mixture._replace(attained=max(mixture.attained, close))
    clock, tolerance = StepAnalysis(model), None

    def mix(share: float) -> Mixture:
        mixed = (policy, sure)[int(share)] if share in (0, 1) else _mixed(policy, sure, share)
        taken = clock.steps(mixed)
        # The probability of a policy that takes very long is expensive.
        if not (probability > 0 and (taken.upper <= steps or share == 1)):
            return Mixture(mixed, share, 0.0, taken)
        if tolerance is None:
            return Mixture(mixed, share, attained_if_near(model, mixed, over, probability), taken)
        return Mixture(mixed, share, attained(model, mixed, over, tolerance), taken)

    def upper(mixture: Mixture) -> float:
        return np.inf if mixture.steps is None else mixture.steps.upper

    def suffices(mixture: Mixture) -> bool:
        return mixture.attained >= probability and upper(mixture) <= steps

    mixture = mix(0)
    if suffices(mixture):
        return mixture
    mixture = mix(1)
    low, high = 0.0, 1.0
    aim = probability + min(_AIM, (mixture.attained - probability) / 64)
    tolerance = max((aim - probability) / 4, _FINEST)
    longest = max(steps * (1 - _AIM), upper(mixture))
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        tried = mix(middle)
        if not suffices(tried):
            low = middle
            continue
        high, mixture = middle, tried
        if (probability > 0 and tried.attained <= aim) or upper(tried) >= longest:
            break
    return mixture


def probable_mixture(
    model: Product, policy: np.ndarray, sure: np.ndarray, probability: float, over: str
) -> Mixture:
    """The mixture with the least share of `sure` that has a certified probability.

    By the secant method on logarithms of the rest of `policy` and of the loss of probability, in
    which mixtures are nearly linear, within brackets. The bound is no closer than that takes.
    """
    reached = attained_if_near(model, policy, over, probability)
    if reached >= probability:
        return Mixture(policy, 0.0, reached)
    mixture = Mixture(sure, 1.0, attained(model, sure, over))
    top, excess = mixture.attained, min(_AIM, (mixture.attained - probability) / 64)
    tolerance = max(excess / 4, _FINEST)
    aim = np.log(max(top - probability - excess / 2, _FINEST))
    # Logarithms of 1 - share and of top - probability: the bracket, and the last two mixtures.
    low, high, rest = 0.0, _LEAST_REST, -1.0
    before = low, np.log(max(top - reached, _FINEST))
    for _ in range(_TRIALS):
        share = -np.expm1(rest)
        mixed = _mixed(policy, sure, share)
        reached = attained(model, mixed, over, tolerance)
        now = rest, np.log(max(top - reached, _FINEST))
        if reached >= probability:
            high, mixture = rest, Mixture(mixed, float(share), reached)
            if reached <= probability + excess:
                break
        else:
            low = rest
        if low - high < 1e-9:
            break
        slope = (now[1] - before[1]) / (now[0] - before[0])
        rest, before = now[0] + (aim - now[1]) / slope if slope > 0 else np.nan, now
        # The step is at most to twice the logarithm, and into the bracket; else half of that.
        end = high if mixture.share < 1 else max(high, 2 * low - 1)
        if not end < rest < low:
            rest = end if mixture.share == 1 else (low + high) / 2
    return mixture


def _mixed(policy: np.ndarray, sure: np.ndarray, share: float) -> np.ndarray:
    mixed: np.ndarray = (1 - share) * policy + share * sure
    return mixed


@validated(host=True)
def practical_policy(
    model: Product,
    policy: Array,
    factor: float = 2.0,
    *,
    actions: OptimalActions | None = None,
    probability: float = 0.0,
    over: str = "mean",
) -> Mixture:
    """The policy with the least share of the quickest optimal one that is quick enough.

    Its expected steps to satisfaction are at most a multiple of the quickest optimal policy's. A
    policy inside the mask of optimal actions stays in it.

    Args:
      model: a concrete product.
      policy: ``float[S, Q, A]``.
      factor: the multiple, at least 1; infinite for no bound.
      actions: of :func:`optimal_actions`; default: they are computed.
      probability: a satisfaction probability to attain as well, at most the optimal one.
      over: initial states of the probability, their ``"mean"`` or the ``"worst"``.

    Returns:
      :class:`Mixture`. Concrete arrays only; not differentiable.

    Example:
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0]] * 2], label=[[0], [1]],
      ...                    propositions=["a"], initial=[1, 0])
      >>> model = product(world, "F a")
      >>> found = practical_policy(model, np.broadcast_to([0.999, 0.001], (2, 2, 2)))
      >>> round(found.steps.value, 1), round(found.share, 1)
      (2.0, 0.5)
    """
    quickest = StepAnalysis(model).quickest(optimal_actions(model) if actions is None else actions)
    one_hot = np.eye(model.num_actions)[quickest.policy]
    limit = np.inf if np.isinf(factor) else quickest.steps.upper * factor
    return least_mixture(model, policy, one_hot, probability, over=over, steps=limit)


def reaching(
    model: Product,
    policy: Array,
    inside: Array,
    best: Solution,
    probability: float,
    *,
    over: str = "mean",
) -> Mixture:
    """The mixture with the least share of an optimal policy that has a required probability."""
    # If the mixture with `inside` exceeds the required probability by more than a window (because
    # `inside` takes long, so that the smallest share of suboptimal actions matters), the mixture
    # with the fastest optimal policy is tried too.
    mixture = least_mixture(model, policy, inside, probability, over=over)
    if mixture.share and mixture.attained > probability + WINDOW:
        quickest = np.eye(model.num_actions)[np.asarray(best.policy)]
        other = least_mixture(model, policy, quickest, probability, over=over)
        mixture = other if other.share < mixture.share else mixture
    return mixture
