"""What a policy is to guarantee of its task, beside being likely, and how that is reached."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from jaxltl.app.files.task import World
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
from jaxltl.core.values.undiscounted.reachability import action_matrices

_AIM = WINDOW / 4  # how far above an asked probability the certified one is aimed to be
_WEIGHTS = 10.0 ** np.arange(-1, 5.5, 0.5)  # of the task's probability, tried in this order
_HALVINGS = 30


@dataclass(frozen=True)
class Guarantee:
    """What is asked, and what is known before anything is learned.

    Attributes:
      asked: ``"best"``, ``"none"`` or a probability.
      over: of which initial states, if it is a probability: their ``"mean"`` or the ``"worst"``.
      best: the best probability of the task.
      actions: the actions that lose nothing of it; None where they are not asked for.
      forbidden: ``bool[N, T]``, the demonstrated steps that are left out, as they lose something.
      cost: of the first of them, the best probability before it and after it.
      usable: whether each demonstration has a step that loses nothing.
    """

    asked: str | float
    over: str
    best: Solution
    actions: OptimalActions | None
    forbidden: np.ndarray
    cost: tuple[float, float] | None
    usable: bool = True

    @property
    def allowed(self) -> np.ndarray | None:
        """``bool[S, Q, A]``, the actions to choose from; None: all."""
        return np.asarray(self.actions.allowed) if self.asked == "best" and self.actions else None


def ask(
    model: Product,
    world: World,
    shown: Trajectories,
    best: Solution,
    asked: str | float,
    over: str = "mean",
) -> Guarantee:
    """What is to be guaranteed of a product's task.

    Raises:
      ValueError: the probability is more than any policy has, with what is possible and from
        where; or a demonstration of which nothing is left.
    """
    nothing = np.zeros(np.shape(shown.state), bool)
    if asked == "none":
        return Guarantee(asked, over, best, None, nothing, None)
    if not isinstance(asked, str):
        require_attainable(model, best, asked, over, world.place)
        if asked == 1:  # which the best policies alone have
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
            f"demonstration {n + 1}: {what} lowers the best probability of the task, so that "
            'nothing of it is left to learn from; leave it out, or write guarantee = "none".'
        )
    return Guarantee(asked, over, best, actions, lost, cost)


def _losing(
    model: Product, best: Solution, allowed: np.ndarray, shown: Trajectories
) -> tuple[np.ndarray, tuple[float, float] | None]:
    """The steps that are not allowed, and the best probability before and after the first."""
    state, action, inside = (np.asarray(x) for x in (shown.state, shown.action, shown.mask))
    memory = memory_along(model, state)
    lost = inside & ~allowed[state, memory, action]
    if not lost.any():
        return lost, None
    first = tuple(np.argwhere(lost)[0])
    s, q, a = state[first], memory[first], action[first]
    value = np.asarray(best.value, float)
    row = action_matrices(model)[a][[s * model.num_memory + q]]
    return lost, (float(value[s, q]), float(np.asarray(row @ value.ravel()).item()))


def check_formula(automaton: Automaton) -> str | None:
    """What is to be said of a formula that is true of every run.

    Args:
      automaton: of the formula.

    Returns:
      A sentence, or None.

    Raises:
      ValueError: no run can satisfy it.

    Example:
      >>> from jaxltl import to_automaton
      >>> check_formula(to_automaton("F a")), check_formula(to_automaton("a | !a")) is None
      (None, False)
    """
    verdict = verdicts(automaton)[int(automaton.initial)]
    if verdict == Verdict.VIOLATED:
        raise ValueError(
            "formula: nothing satisfies it, whichever cells a run visits; it contradicts itself "
            "or asks for labels that no state of this world shows together."
        )
    if verdict == Verdict.SATISFIED:
        return "The formula is true of every run in this world, so any policy does the task."
    return None


def left_out(
    model: Product, guarantee: Guarantee, shown: Trajectories
) -> list[tuple[int, int, int]]:
    """State, memory and action of the demonstrated steps that are left out, each once."""
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
) -> dict[str, Any]:
    """What was asked and done, for ``result.json``."""
    found: dict[str, Any] = {"asked": guarantee.asked, "over": guarantee.over}
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
        if missing > 1e-3:  # what the remedy would give
            sure = optimal_actions(model, guarantee.best).attained
            found["remedy"] = at_starts(model, sure.lower, "mean")[0]
    return found


# --- a probability ---------------------------------------------------------------------------


class Attempt(NamedTuple):
    """A policy that was learned or mixed, ``float[S, Q, A]``.

    Attributes:
      policy: the policy.
      neg_log_likelihood: of the demonstrations.
      attained: its certified probability, of the mean or the worst start.
      weight: mu, if it was learned with one.
      share: of the actions that lose nothing, if they were mixed in.
      learned: what it was made from.
    """

    policy: np.ndarray
    neg_log_likelihood: float
    attained: float
    weight: float | None
    share: float
    learned: Any


Train = Callable[[float, Any], Any]


def at_least(
    model: Product,
    guarantee: Guarantee,
    counts: np.ndarray,
    free: Any,
    inside: Callable[[], tuple[np.ndarray, Any]],
    train: Train,
    policy_of: Callable[[Any], np.ndarray],
) -> Attempt:
    """The most likely policy found whose certified probability is at least the one asked for.

    The least weight mu of the task's probability (2.6) that reaches it is searched for. Where a
    little more weight makes the probability jump, or none reaches it, policies of both sides are
    mixed; and the likeliest policy is with the likeliest of those that lose nothing, or, if that
    gives no probability near the one asked for, with the quickest of them.

    Args:
      model: the product.
      guarantee: what is asked.
      counts: ``float[S, Q, A]``, how often each pair was demonstrated.
      free: what is learned without any weight.
      inside: a policy of the actions that lose nothing, and what it was learned as.
      train: what is learned with a weight, from what was learned before.
      policy_of: the policy ``float[S, Q, A]`` of what was learned.
    """
    asked = float(guarantee.asked)

    def loss_of(policy: np.ndarray) -> float:
        seen = counts > 0
        with np.errstate(divide="ignore"):
            return float(-np.sum(counts[seen] * np.log(policy[seen])))

    def attempt(policy: np.ndarray, learned: Any, weight: float | None, share: float) -> Attempt:
        reached = attained(model, policy, guarantee.over)
        return Attempt(policy, loss_of(policy), reached, weight, share, learned)

    def between(below: Attempt, above: Attempt) -> Attempt:
        found = least_mixture(model, below.policy, above.policy, asked, over=guarantee.over)
        return (
            above
            if found.share == 1
            else Attempt(
                found.policy,
                loss_of(found.policy),
                found.attained,
                above.weight,
                found.share,
                above.learned,
            )
        )

    first = attempt(policy_of(free), free, 0.0, 0.0)
    if first.attained >= asked:
        return first
    below, above, found = first, None, []
    for tried in bracket(train, first, lambda x, mu: attempt(policy_of(x), x, mu, 0.0), asked):
        if tried.attained < asked:
            below = tried
        else:
            above = tried
            found.append(tried)
    if above is not None and above.attained > asked + WINDOW:
        found.append(between(below, above))
    policy, learned = inside()
    sure = attempt(policy, learned, None, 1.0)
    found += [between(x, sure) for x in ([first] if below is first else [first, below])]
    if all(one.attained > asked + WINDOW for one in found):
        # Where what was learned takes its time, any share of steps that lose is too much.
        quick = np.asarray(guarantee.best.policy)[..., None] == np.arange(policy.shape[-1])
        sure = attempt(quick.astype(float), learned, None, 1.0)
        found.append(between(first, sure))
    return min(found, key=lambda one: one.neg_log_likelihood)


def bracket(
    train: Train,
    first: Any,
    judged: Callable[[Any, float], Any],
    asked: float,
    halvings: int = _HALVINGS,
) -> Iterator[Any]:
    """Attempts with more and more weight until it is enough, then between the last two.

    Each is learned from the one of the next lesser weight: the likelihood has other maxima, and
    those that are found from too great a weight are lesser ones.

    Args:
      train: what is learned with a weight, from what was learned before.
      first: what was found without any weight: with `learned`, and what is `attained`.
      judged: the same of what was learned with a weight.
      asked: what is to be attained.
      halvings: attempts between two weights, at most.
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
