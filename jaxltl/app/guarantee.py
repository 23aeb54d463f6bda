"""Guarantees of learned policies: optimal actions, or a satisfaction probability to attain."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np

from jaxltl.app.files.worlds import World
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core.models.construct.lifting import memory_along
from jaxltl.core.models.product import Product
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.core.types import Solution
from jaxltl.core.values.undiscounted.mixture import (
    WINDOW,
    at_starts,
    attained,
    least_mixture,
    require_attainable,
)
from jaxltl.core.values.undiscounted.optimal_actions import OptimalActions, optimal_actions
from jaxltl.core.values.undiscounted.reachability import rows_of_model
from jaxltl.app.wording import Record

_AIM = WINDOW / 4  # margin of the certified probability over the asked one
_WEIGHTS = 10.0 ** np.arange(-1, 5.5, 0.5)  # of the satisfaction probability, in this order
_HALVINGS = 30


@dataclass(frozen=True)
class Guarantee:
    """An asked guarantee, and the optimal actions."""

    asked: str | float  # "best", "none" or a probability
    over: str  # initial states of an asked probability, their "mean" or the "worst"
    best: Solution  # the maximal satisfaction probability
    actions: OptimalActions | None  # the optimal actions; None without a guarantee
    forbidden: np.ndarray  # bool[N, T], demonstrated steps that are not optimal, and are left out
    # maximal satisfaction probability before and after the first of them
    cost: tuple[float, float] | None
    usable: bool = True  # whether each demonstration has an optimal step

    @property
    def allowed(self) -> np.ndarray | None:
        """``bool[S, Q, A]``, the actions to choose from; None for all."""
        return np.asarray(self.actions.allowed) if self.asked == "best" and self.actions else None


def ask(
    model: Product,
    world: World,
    shown: Trajectories,
    best: Solution,
    asked: str | float,
    over: str = "mean",
) -> Guarantee:
    """Guarantee for a product, as the task file requests it."""
    nothing = np.zeros(np.shape(shown.state), bool)
    if asked == "none":
        return Guarantee(asked, over, best, None, nothing, None)
    if not isinstance(asked, str):
        require_attainable(model, best, asked, over, world.place)
        if asked == 1:  # attained by optimal policies alone
            asked = "best"
    actions = optimal_actions(model, best)
    lost, cost = _losing(model, best, np.asarray(actions.allowed), shown)
    useless = np.flatnonzero(lost.any(1) & (lost.sum(1) == np.asarray(shown.length)))
    if not isinstance(asked, str):
        return Guarantee(asked, over, best, actions, nothing, None, not useless.size)
    if useless.size:
        n, count = useless[0], int(lost[useless[0]].sum())
        what = "its only step" if count == 1 else f"each of its {count} steps"
        raise ValueError(
            f"demonstration {n + 1}: {what} lowers the best probability of satisfying the formula, "
            'so that none is left to learn from; leave it out, or write guarantee = "none".'
        )
    return Guarantee(asked, over, best, actions, lost, cost)


def _losing(
    model: Product, best: Solution, allowed: np.ndarray, shown: Trajectories
) -> tuple[np.ndarray, tuple[float, float] | None]:
    """The steps that are not allowed, and the maximal probability before and after the first."""
    state, action, inside = (np.asarray(x) for x in (shown.state, shown.action, shown.mask))
    memory = memory_along(model, state)
    lost = inside & ~allowed[state, memory, action]
    if not lost.any():
        return lost, None
    first = tuple(np.argwhere(lost)[0])
    s, q, a = state[first], memory[first], action[first]
    value = np.asarray(best.value, float)
    sparse = rows_of_model(model)
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
    model: Product, guarantee: Guarantee, shown: Trajectories
) -> list[tuple[int, int, int]]:
    """World state, memory state and action of the steps that are left out, each once."""
    state, action = np.asarray(shown.state), np.asarray(shown.action)
    if not guarantee.forbidden.any():
        return []
    steps = np.stack([state, memory_along(model, state), action], -1)[guarantee.forbidden]
    return [(s, q, a) for s, q, a in np.unique(steps, axis=0).tolist()]


def kept(
    guarantee: Guarantee,
    attempt: Attempt | None,
    model: Product,
    world: World,
    shown: Trajectories,
    solution: Solution,
) -> Record:
    """The guarantee and how it was attained, for ``result.json``."""
    found: Record = {"asked": guarantee.asked, "over": guarantee.over}
    if guarantee.asked == "best" and guarantee.actions is not None:
        found["loss"] = guarantee.actions.loss
    if attempt is not None:
        found |= {"attained": attempt.attained, "weight": attempt.weight, "share": attempt.share}
    if guarantee.forbidden.any():
        n, t = np.argwhere(guarantee.forbidden)[0]
        before, after = guarantee.cost or (None, None)
        found["left_out"] = {
            "steps": int(guarantee.forbidden.sum()),
            "of": int(np.sum(shown.length)),
            "demonstration": int(n) + 1,
            "step": int(t) + 1,
            "from": before,
            "to": after,
            **world.where(int(np.asarray(shown.state)[n, t])),
        }
    if guarantee.asked == "none":
        missing = at_starts(model, np.subtract(guarantee.best.value, solution.value), "mean")[0]
        if missing > 1e-3:  # the guarantee of the remedy
            sure = optimal_actions(model, guarantee.best).attained
            found["remedy"] = at_starts(model, sure.lower, "mean")[0]
    return found


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


Learned = TypeVar("Learned")
Train = Callable[[float, Learned], Learned]


@dataclass(frozen=True)
class Search(Generic[Learned]):
    """Search for the most likely policy with at least a given certified probability."""

    model: Product  # the product
    guarantee: Guarantee  # the probability
    counts: np.ndarray  # float[S, Q, A], the number of demonstrations of each pair
    # learns with a weight mu of the satisfaction probability (2.6), starting from the previous
    # result
    train: Train[Learned]
    policy_of: Callable[[Learned], np.ndarray]  # the policy float[S, Q, A] of a result

    def at_least(self, free: Learned, inside: Callable[[], tuple[np.ndarray, Learned]]) -> Attempt:
        """Most likely policy found, by a search for the least sufficient weight mu.

        Where the probability jumps with the weight, or no weight attains it, policies of both sides
        are mixed; and the likeliest policy is mixed with the likeliest one of optimal actions or,
        if that gives no probability near the requested one, with the quickest of these.
        """
        asked = float(self.guarantee.asked)
        first = self._attempt(self.policy_of(free), free, 0.0, 0.0)
        if first.attained >= asked:
            return first
        below, above, found = first, None, []
        tries = bracket(
            self.train, first, lambda x, mu: self._attempt(self.policy_of(x), x, mu, 0.0), asked
        )
        for tried in tries:
            if tried.attained < asked:
                below = tried
            else:
                above = tried
                found.append(tried)
        if above is not None and above.attained > asked + WINDOW:
            found.append(self._between(below, above))
        policy, learned = inside()
        sure = self._attempt(policy, learned, None, 1.0)
        found += [self._between(x, sure) for x in ([first] if below is first else [first, below])]
        if all(one.attained > asked + WINDOW for one in found):
            # A learned policy that delays satisfaction leaves no share for other actions.
            quick = np.asarray(self.guarantee.best.policy)[..., None] == np.arange(policy.shape[-1])
            sure = self._attempt(quick.astype(float), learned, None, 1.0)
            found.append(self._between(first, sure))
        return min(found, key=lambda one: one.neg_log_likelihood)

    def _loss(self, policy: np.ndarray) -> float:
        """Negative log-likelihood of the demonstrations."""
        seen = self.counts > 0
        with np.errstate(divide="ignore"):
            return float(-np.sum(self.counts[seen] * np.log(policy[seen])))

    def _attempt(
        self, policy: np.ndarray, learned: Learned, weight: float | None, share: float
    ) -> Attempt:
        reached = attained(self.model, policy, self.guarantee.over)
        return Attempt(policy, self._loss(policy), reached, weight, share, learned)

    def _between(self, below: Attempt, above: Attempt) -> Attempt:
        """The mixture of two policies with the least share of the second."""
        asked, over = float(self.guarantee.asked), self.guarantee.over
        found = least_mixture(self.model, below.policy, above.policy, asked, over=over)
        if found.share == 1:
            return above
        return replace(
            above,
            policy=found.policy,
            neg_log_likelihood=self._loss(found.policy),
            attained=found.attained,
            share=found.share,
        )


def bracket(
    train: Train,
    first: Any,
    judged: Callable[[Any, float], Any],
    asked: float,
    halvings: int = _HALVINGS,
) -> Iterator[Any]:
    """Yields attempts with increasing weights until one suffices, then by bisection.

    Each starts from the result of the next smaller weight: the likelihood has several maxima, and
    those found from too large a weight are lower.
    """
    low, below = 0.0, first
    for high in map(float, _WEIGHTS):
        last = judged(train(high, below.learned), high)
        yield last
        if last.attained >= asked:
            break
        low, below = high, last
    else:
        return
    low = low or high * 1e-3
    for _ in range(halvings):
        if asked <= last.attained <= asked + _AIM or high / low < 1 + 1e-9:
            return
        middle = float(np.sqrt(low * high))
        last = judged(train(middle, below.learned), middle)
        yield last
        if last.attained >= asked:
            high = middle
        else:
            low, below = middle, last
