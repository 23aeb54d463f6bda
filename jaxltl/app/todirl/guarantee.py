"""Attains a requested satisfaction probability in every world of a todirl job.

In each world, also in new ones, the policy is the plan of the learned reward, mixed with the least
share of optimal actions for which the probability is certified. Among the rewards learned with
increasing weights of the satisfaction probability, the one with the most likely demonstrations is
kept.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxltl.app.todirl.results import Learned, Setup, part_of
from jaxltl.app.wording import place as name_of
from jaxltl.app.files.scenes import Scene
from jaxltl.app.guarantee import bracket
from jaxltl.core.values.undiscounted.mixture import attained, reaching, require_attainable

_HALVINGS = 5  # few bisections of the weight, since the mixture closes the gap


@dataclass(frozen=True)
class Held:
    """Policies with the asked probability."""

    policy: np.ndarray  # float[W, S, Q, A]
    share: np.ndarray  # float[W], of optimal actions
    attained: np.ndarray  # float[W], certified, of the mean or the worst initial state


def check_attainable(setup: Setup) -> None:
    """Raises ValueError for a probability that no policy attains in a world that counts."""
    task, scenes = setup.task, setup.worlds.scenes
    assert setup.sure is not None
    for w, (scene, sure) in enumerate(zip(scenes, setup.sure, strict=True)):
        if w >= setup.num_training and scene.name in task.left_out:
            continue

        def place(state: int, scene: Scene = scene) -> str:
            return name_of(scene.place(state))

        try:
            require_attainable(
                part_of(setup.worlds.model, w), sure.best, float(setup.asked), task.over, place
            )
        except ValueError as error:
            kind = "training" if w < setup.num_training else "test"
            fix = "" if kind == "training" else " Or name it in [test] leave_out."
            raise ValueError(
                f"{task.path}: [task] in the {kind} world {scene.name}: {error}{fix}"
            ) from None


def hold(setup: Setup, policy: Any, inside: Any) -> Held:
    """Mixes plans ``[W, S, Q, A]`` of all actions and of optimal ones, in the first W worlds."""
    assert setup.sure is not None
    found = []
    for w, sure in enumerate(setup.sure[: len(policy)]):
        found.append(
            reaching(
                part_of(setup.worlds.model, w),
                np.asarray(policy[w]),
                np.asarray(inside[w]),
                sure.best,
                float(setup.asked),
                over=setup.task.over,
            )
        )
    policies, shares, reached = zip(*found, strict=True)
    return Held(np.stack(policies), np.array(shares), np.array(reached))


@dataclass(frozen=True)
class _Tried:
    """An attempt with a weight."""

    learned: Learned  # learned, weight: the network, and mu
    weight: float
    attained: float  # least certified probability over the training worlds, before mixing
    neg_log_likelihood: float  # of the demonstrations, after mixing


def is_weighable(setup: Setup) -> bool:
    """True if a weight has an effect: the uniform policy satisfies the formula sometimes.

    Soft policies have full support; else none of them satisfies it, for any reward.
    """
    for w in range(setup.num_training):
        model = part_of(setup.worlds.model, w)
        available = np.asarray(model.available)
        if attained(model, available / available.sum(-1, keepdims=True), "mean") > 0:
            return True
    return False


def likeliest(
    setup: Setup,
    counts: np.ndarray,
    free: Learned,
    train: Callable[[float, Learned], Learned] | None,
    plans: Callable[[Learned], tuple[np.ndarray, np.ndarray]],
) -> tuple[Learned, float]:
    """The network of greatest likelihood over some weights, and its weight."""
    models = [part_of(setup.worlds.model, w) for w in range(setup.num_training)]
    seen = counts > 0

    def judged(learned: Learned, weight: float) -> _Tried:
        policy, inside = plans(learned)
        held = hold(setup, policy, inside).policy[:, : counts.shape[1]]
        with np.errstate(divide="ignore"):
            loss = -np.sum(counts[seen] * np.log(held[seen]))
        each = [attained(m, p, setup.task.over) for m, p in zip(models, policy, strict=True)]
        return _Tried(learned, weight, min(each), float(loss))

    first = judged(free, 0.0)
    found = [first]
    if first.attained < float(setup.asked) and train is not None:
        found += bracket(train, first, judged, float(setup.asked), _HALVINGS)
    best = min(found, key=lambda one: np.nan_to_num(one.neg_log_likelihood, nan=np.inf))
    return best.learned, best.weight
