"""Makes learned policies meet a task file's demands: optimal actions, a least probability, few steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from jaxltl.app.files.worlds import MappedModel
from jaxltl.app.wording import enclosure, Record
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models import Product, Trajectories
from jaxltl.core.models.construct.lifting import memory_along
from jaxltl.core.types import Solution
from jaxltl.core.values.undiscounted.mixture import (
    at_starts,
    attained,
    attained_if_near,
    least_mixture,
    Mixture,
    probable_mixture,
    require_attainable,
)
from jaxltl.core.values.undiscounted.optimal_actions import optimal_actions, OptimalActions
from jaxltl.core.values.engine.row_form import rows_of
from jaxltl.core.values.undiscounted.satisfaction_steps import (
    constrained_policy,
    Quickest,
    StepAnalysis,
    steps_front,
)

_COARSE = 1e-6  # width of the enclosure of a probability that is positive or not
_LOSS = 1e-9  # of the best probability, that counts as a rounding error
_COMPARED = 3  # policies that are compared after mixing for the expected steps


@dataclass(frozen=True)
class Guarantee:
    """An asked guarantee, and the optimal actions."""

    requested: str | float  # "best", "none" or a probability
    over: str  # initial states of an asked probability, their "mean" or the "worst"
    best: Solution  # the maximal satisfaction probability
    actions: OptimalActions | None  # the optimal actions; None without a guarantee
    forbidden: np.ndarray  # bool[N, T], demonstrated steps that are not optimal, and are left out
    # maximal satisfaction probability before and after the first of them
    cost: tuple[float, float] | None
    usable: bool = True  # whether each demonstration has an optimal step
    # int[N], the number of each demonstration's steps until the formula is lost or, for "best",
    # until a mistake has left the best probability; later ones are not used
    used: np.ndarray | None = None

    def unused(self, demonstrations: Trajectories) -> np.ndarray:
        """``bool[N, T]``, the steps after the formula or the best probability is lost."""
        length = np.asarray(demonstrations.length) if self.used is None else self.used
        return np.asarray(demonstrations.mask) & (
            np.arange(demonstrations.state.shape[1]) >= length[:, None]
        )

    @property
    def allowed(self) -> np.ndarray | None:
        """``bool[S, Q, A]``, the actions to choose from; None for all."""
        return (
            np.asarray(self.actions.allowed) if self.requested == "best" and self.actions else None
        )


def ask(
    model: Product,
    world: MappedModel,
    demonstrations: Trajectories,
    best: Solution,
    requested: str | float,
    over: str = "mean",
) -> Guarantee:
    """Guarantee for a product, as the task file requests it."""
    nothing = np.zeros(np.shape(demonstrations.state), bool)
    if requested == "none":
        used = used_steps(model, best, nothing, demonstrations)
        return Guarantee(requested, over, best, None, nothing, None, used=used)
    if not isinstance(requested, str):
        require_attainable(model, best, requested, over, world.position_text)
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


def require_possible(model: Product, world: MappedModel, best: Solution) -> None:
    """Raises ValueError if no policy satisfies the formula from any initial state."""
    starts = np.argwhere(np.asarray(model.initial) > 0)
    if (np.asarray(best.upper)[tuple(starts.T)] > 0).any():
        return
    place = world.position_text(int(starts[0, 0]))
    others = "" if len(starts) == 1 else f" and the other {len(starts) - 1} initial states"
    raise ValueError(
        f"initial: no policy satisfies the formula with positive probability from {place}{others}; "
        "change initial, the map or the formula."
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


def left_out(
    model: Product, guarantee: Guarantee, demonstrations: Trajectories
) -> list[tuple[int, int, int]]:
    """World state, memory state and action of the steps that are left out, each once."""
    state, action = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
    marked = guarantee.forbidden | guarantee.unused(demonstrations)
    if not marked.any():
        return []
    steps = np.stack([state, memory_along(model, state), action], -1)[marked]
    return [(s, q, a) for s, q, a in np.unique(steps, axis=0).tolist()]


def guarantee_entry(
    guarantee: Guarantee,
    attempt: Attempt | None,
    model: Product,
    world: MappedModel,
    demonstrations: Trajectories,
    solution: Solution,
) -> Record:
    """The guarantee and how it was attained, for ``result.json``."""
    record: Record = {"asked": guarantee.requested, "over": guarantee.over}
    if guarantee.requested == "best" and guarantee.actions is not None:
        record["loss"] = guarantee.actions.loss
    if attempt is not None:
        record |= {"attained": attempt.attained, "weight": attempt.weight, "share": attempt.share}
        state, action = np.asarray(demonstrations.state), np.asarray(demonstrations.action)
        taken = attempt.policy[state, memory_along(model, state), action] > 0
        record["never"] = int(
            (np.asarray(demonstrations.mask) & ~guarantee.unused(demonstrations) & ~taken).sum()
        )
    if unused := int(guarantee.unused(demonstrations).sum()):
        record["unused"] = {"steps": unused, "of": int(np.sum(demonstrations.length))}
    excluded = guarantee.forbidden & ~guarantee.unused(demonstrations)
    if excluded.any():
        n, t = np.argwhere(excluded)[0]
        before, after = guarantee.cost or (None, None)
        record["left_out"] = {
            "steps": int(excluded.sum()),
            "of": int(np.sum(demonstrations.length)),
            "demonstration": int(n) + 1,
            "step": int(t) + 1,
            "from": before,
            "to": after,
            **world.position(int(np.asarray(demonstrations.state)[n, t])),
        }
    if guarantee.requested == "none":
        missing = at_starts(model, np.subtract(guarantee.best.value, solution.value), "mean")[0]
        if missing > 1e-3:  # the guarantee of the remedy
            sure = optimal_actions(model, guarantee.best).attained
            record["remedy"] = at_starts(model, sure.lower, "mean")[0]
    return record


# --- a probability ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Attempt:
    """A policy that was learned or mixed."""

    policy: np.ndarray  # float[S, Q, A]
    neg_log_likelihood: float  # of the demonstrations
    attained: float  # certified probability, of the mean or the worst initial state
    weight: float | None  # mu, if it was learned with one
    share: float  # of optimal actions, if they were mixed in
    learned: Any  # the underlying result of learning


def is_weighable(model: Product) -> bool:
    """True if rewards matter: the uniform policy satisfies the formula sometimes.

    Softmax policies have full support; else none of them satisfies it, for any reward.
    """
    available = np.asarray(model.available)
    return attained(model, available / available.sum(-1, keepdims=True), "mean", _COARSE) > 0


Learned = TypeVar("Learned")


@dataclass(frozen=True)
class GuaranteeSearch(Generic[Learned]):
    """Search for the most likely policy with at least a given certified probability."""

    model: Product  # the product
    guarantee: Guarantee  # the probability
    counts: np.ndarray  # float[S, Q, A], the number of demonstrations of each pair
    policy_of: Callable[[Learned], np.ndarray]  # the policy float[S, Q, A] of a result
    # likely results at and below the required probability, with their weights mu (2.6)
    constrained: Callable[[], list[tuple[Learned, float]]]
    within_steps: Callable[[np.ndarray], np.ndarray]  # a policy mixed for the bound of its steps

    def at_least(self, free: Learned, policy: np.ndarray, inside: Learned) -> Attempt:
        """Most likely policy found: learned with the constraint, or a mixture.

        Arguments are the result without constraint, and the policy and result of optimal actions.
        Where no reward attains the probability, a policy is mixed with the likeliest or with the
        quickest one of optimal actions.
        """
        requested = float(self.guarantee.requested)
        first = self._attempt(free, 0.0)
        if first.attained >= requested:
            return first
        more = self.constrained() if is_weighable(self.model) else []
        tried = [first, *(self._attempt(learned, weight) for learned, weight in more)]
        candidates = [one for one in tried if one.attained >= requested]
        quickest = np.asarray(self.guarantee.best.policy)[..., None] == np.arange(policy.shape[-1])
        # A learned policy that delays satisfaction leaves no share for other actions.
        for sure in (policy, quickest.astype(float)):
            candidates += [
                self._mixed(one, sure, inside) for one in tried if one.attained < requested
            ]
        likeliest = sorted(candidates, key=lambda one: one.neg_log_likelihood)[:_COMPARED]
        return min(likeliest, key=lambda one: self._loss(self.within_steps(one.policy)))

    def _loss(self, policy: np.ndarray) -> float:
        return neg_log_likelihood(policy, self.counts)

    def _attempt(self, learned: Learned, weight: float) -> Attempt:
        policy, requested = self.policy_of(learned), float(self.guarantee.requested)
        reached = attained_if_near(self.model, policy, self.guarantee.over, requested)
        return Attempt(policy, self._loss(policy), reached, weight, 0.0, learned)

    def _mixed(self, below: Attempt, sure: np.ndarray, inside: Learned) -> Attempt:
        """The mixture with the least share of a policy of optimal actions."""
        requested, over = float(self.guarantee.requested), self.guarantee.over
        mixture = probable_mixture(self.model, below.policy, sure, requested, over)
        return Attempt(
            mixture.policy,
            self._loss(mixture.policy),
            mixture.attained,
            None,
            mixture.share,
            inside,
        )


# --- expected steps -----------------------------------------------------------------------


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
    front_point = constrained_policy(model, requested, steps, quickest)
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
        "quickest_status": bound.quickest.status.name,
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
