"""Guarantees of policies learned from demonstrations: optimal actions, a probability, few steps.

A guarantee is requested for a product: ``"best"`` restricts the policy to optimal actions of the formula,
a probability is attained in the mean or from the worst initial state, and the expected steps to
satisfaction are bounded by those of the quickest optimal policy. Demonstrated steps that contradict
the guarantee are not learned from.

Example: the demonstrator of a corridor with a trap makes no mistake.
  >>> import jaxltl as jl
  >>> world = jl.gridworld("s . g\\n. t .", slip=0.1, initial="s", absorbing=["t"])
  >>> model = jl.product(world, "!t U g")
  >>> shown = jl.make_trajectories(world, [[(0, 3), (1, 3)]])  # to the right, twice
  >>> guarantee = make_guarantee(model, shown, 0.9)
  >>> guarantee.requested, guarantee.used.tolist(), bool(guarantee.forbidden.any())
  (0.9, [2], False)
  >>> bound = step_bound(model, guarantee.actions, factor=2.0)
  >>> round(bound.limit / bound.quickest.steps.upper, 6)
  2.0
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import Product, Trajectories
from jaxltl.core.models.construct.lifting import memory_along
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.row_form import rows_of
from jaxltl.core.values.undiscounted.mixture import (
    attained,
    least_mixture,
    Mixture,
    require_attainable,
)
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions, OptimalActions
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.core.values.undiscounted.satisfaction_steps import (
    constrained_policy,
    Quickest,
    StepAnalysis,
)

_COARSE = 1e-6  # width of the enclosure of a probability that is positive or not
_LOSS = 1e-9  # of the best probability, that counts as a rounding error


Place = Callable[[int], str]  # the text of a state in errors


@dataclass(frozen=True)
class Guarantee:
    """A requested guarantee, the optimal actions, and the demonstrated steps that contradict it.

    Attributes:
      requested: ``"best"``, ``"none"`` or a probability.
      over: initial states of a probability, their ``"mean"`` or the ``"worst"``.
      best: the maximal satisfaction probability.
      actions: the optimal actions; None without a guarantee.
      forbidden: ``bool[N, T]``, demonstrated steps that are not optimal, for ``"best"``.
      cost: maximal satisfaction probability before and after the first of them.
      usable: True if each demonstration has an optimal step.
      used: ``int[N]``, the number of each demonstration's steps until the formula is lost or, for
        ``"best"``, until a mistake has left the best probability.
    """

    requested: str | float
    over: str
    best: Solution
    actions: OptimalActions | None
    forbidden: np.ndarray
    cost: tuple[float, float] | None
    usable: bool = True
    used: np.ndarray | None = None

    def unused(self, demonstrations: Trajectories) -> np.ndarray:
        """``bool[N, T]``, the steps after the formula or the best probability is lost."""
        length = np.asarray(demonstrations.length) if self.used is None else self.used
        return np.asarray(demonstrations.mask) & (
            np.arange(demonstrations.state.shape[1]) >= length[:, None]
        )

    def until_lost(self, demonstrations: Trajectories) -> Trajectories:
        """The demonstrations without those steps."""
        if self.used is None:
            return demonstrations
        return replace(demonstrations, length=to_jax(self.used.astype(np.int32)))

    @property
    def allowed(self) -> np.ndarray | None:
        """``bool[S, Q, A]``, the actions to choose from; None for all."""
        return (
            np.asarray(self.actions.allowed) if self.requested == "best" and self.actions else None
        )


def make_guarantee(
    model: Product,
    demonstrations: Trajectories,
    requested: str | float = "best",
    *,
    over: str = "mean",
    best: Solution | None = None,
    place: Place = "state {}".format,
) -> Guarantee:
    """A :class:`Guarantee` of policies of a product that are learned from demonstrations.

    Args:
      model: the product of the world with the task.
      demonstrations: in the world.
      requested: ``"best"`` for the maximal satisfaction probability, a probability in (0, 1], or
        ``"none"``.
      over: initial states of a probability, their ``"mean"`` or the ``"worst"``.
      best: of :func:`~jaxltl.optimal_satisfaction`; default: it is computed.
      place: the text of a world state in errors.

    Raises:
      ValueError: a probability that no policy attains, or a demonstration without an optimal step.
    """
    best = optimal_satisfaction(model) if best is None else best
    nothing = np.zeros(np.shape(demonstrations.state), bool)
    if requested == "none":
        used = used_steps(model, best, nothing, demonstrations)
        return Guarantee(requested, over, best, None, nothing, None, used=used)
    if not isinstance(requested, str):
        require_attainable(model, best, requested, over, place)
        if requested == 1:  # attained by optimal policies alone
            requested = "best"
    actions = optimal_actions(model, best)
    lost, cost = _losing(model, best, np.asarray(actions.allowed), demonstrations)
    used = used_steps(model, best, lost if isinstance(requested, str) else nothing, demonstrations)
    lost_use = (lost & (np.arange(lost.shape[1]) < used[:, None])).sum(1)
    useless = np.flatnonzero((used > 0) & (lost_use == used))
    if not isinstance(requested, str):
        return Guarantee(requested, over, best, actions, nothing, None, not useless.size, used)
    if useless.size:
        n, count = useless[0], int(lost_use[useless[0]])
        first = "its first step" if demonstrations.length[n] > 1 else "its only step"
        steps = first if count == 1 else f"each of its {count} steps"
        raise ValueError(
            f"demonstration {n + 1}: {steps} lowers the best probability of satisfying the formula, "
            'so that none is left to learn from; leave it out, or write guarantee = "none".'
        )
    return Guarantee(requested, over, best, actions, lost, cost, used=used)


def require_possible(model: Product, best: Solution, place: Place = "state {}".format) -> None:
    """Raises ValueError if no policy satisfies the formula from any initial state."""
    starts = np.argwhere(np.asarray(model.initial) > 0)
    if (np.asarray(best.upper)[tuple(starts.T)] > 0).any():
        return
    others = "" if len(starts) == 1 else f" and the other {len(starts) - 1} initial states"
    raise ValueError(
        f"initial: no policy satisfies the formula with positive probability from "
        f"{place(int(starts[0, 0]))}{others}; change initial, the map or the formula."
    )


def used_steps(
    model: Product, best: Solution, mistake: np.ndarray, demonstrations: Trajectories
) -> np.ndarray:
    """Steps ``int[N]`` until the formula is lost, or a mistake leads to less probability."""
    state = np.asarray(demonstrations.state)
    memory, inside = memory_along(model, state), np.asarray(demonstrations.mask)
    value, upper = (np.asarray(x, float)[state, memory] for x in (best.value, best.upper))
    less = mistake[:, :-1] & inside[:, 1:] & (value[:, 1:] < value[:, :-1] - _LOSS)
    gone = inside & (upper <= 0)
    gone[:, 1:] |= less
    length = np.asarray(demonstrations.length)
    used = np.where(gone.any(1), gone.argmax(1), length)
    return used if used.any() else length  # else there is nothing to learn from


def mistakes(model: Product, allowed: np.ndarray, demonstrations: Trajectories) -> np.ndarray:
    """The demonstrated steps ``bool[N, T]`` that a mask ``bool[S, Q, A]`` does not allow."""
    state, action = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
    wrong: np.ndarray = (
        np.asarray(demonstrations.mask) & ~allowed[state, memory_along(model, state), action]
    )
    return wrong


def _losing(
    model: Product, best: Solution, allowed: np.ndarray, demonstrations: Trajectories
) -> tuple[np.ndarray, tuple[float, float] | None]:
    """The steps that are not allowed, and the maximal probability before and after the first."""
    lost = mistakes(model, allowed, demonstrations)
    if not lost.any():
        return lost, None
    state, action = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
    memory = memory_along(model, state)
    first = tuple(np.argwhere(lost)[0])
    s, q, a = state[first], memory[first], action[first]
    value = np.asarray(best.value, float)
    sparse = rows_of(model)
    chosen = (sparse.host.state == s * model.num_memory + q) & (np.asarray(sparse.action) == a)
    after = sparse.host.expectation(value.ravel())[chosen]
    return lost, (float(value[s, q]), float(after.sum()))


def check_formula(automaton: Automaton) -> str | None:
    """A remark on a formula that every trajectory satisfies, or None.

    Example:
      >>> from jaxltl import to_automaton
      >>> check_formula(to_automaton("F a")), check_formula(to_automaton("a | !a")) is None
      (None, False)
    """
    verdict = verdicts(automaton)[int(automaton.initial)]
    if verdict == Verdict.VIOLATED:
        raise ValueError(
            "formula: nothing satisfies it: no trajectory of this world does. It is contradictory, or "
            "needs labels that no state has together."
        )
    if verdict == Verdict.SATISFIED:
        return "Every trajectory of this world satisfies the formula, so any policy does."
    return None


# --- a probability ---------------------------------------------------------------------------


def is_weighable(model: Product) -> bool:
    """True if rewards matter: the uniform policy satisfies the formula sometimes.

    Softmax policies have full support; else none of them satisfies it, for any reward.
    """
    available = np.asarray(model.available)
    return attained(model, available / available.sum(-1, keepdims=True), "mean", _COARSE) > 0


def neg_log_likelihood(policy: np.ndarray, counts: np.ndarray) -> float:
    """Negative log-likelihood of demonstrated pairs, as counts of the policy's shape, in nats."""
    seen = counts > 0
    with np.errstate(divide="ignore"):
        return float(-np.sum(counts[seen] * np.log(policy[seen])))


# --- expected steps -----------------------------------------------------------------------


@dataclass(frozen=True)
class StepBound:
    """A bound on the expected number of steps to satisfaction, and a policy that keeps it.

    Attributes:
      quickest: the quickest optimal policy.
      limit: the bound; infinite without one.
      anchor: ``float[S, Q, A]``, a policy that meets all requirements, whose share is mixed in.
      factor: the bound as a multiple of the quickest optimal policy's steps, or None.
      probability: certified satisfaction probability that is kept; 0 if actions ensure it.
      over: its initial states.
    """

    quickest: Quickest
    limit: float
    anchor: np.ndarray
    factor: float | None
    probability: float
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
    requested: str | float = "best",
    *,
    over: str = "mean",
    steps: float | None = None,
    factor: float | None = None,
) -> StepBound | None:
    """The :class:`StepBound` of policies with a guarantee; None for safety formulas, which take no steps.

    Args:
      model, actions: the product and its optimal actions.
      requested, over: the guarantee, as for :func:`make_guarantee`.
      steps: the bound, or None.
      factor: the bound as a multiple of the quickest optimal policy's steps, or None.

    Raises:
      ValueError: a bound that no policy with the guarantee keeps.
    """
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
    front_point = constrained_policy(model, requested, steps, quickest)
    if front_point.policy is None:
        raise ValueError(
            f"{text}, and in {steps:g} steps no policy has more than {max(front_point.upper, 0):.6g}; ask "
            "for more steps or a smaller probability."
        )
    return front_point.policy
