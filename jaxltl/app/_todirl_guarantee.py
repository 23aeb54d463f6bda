"""How a job of todirl reaches a probability that is asked for, in every world.

In each world the policy is the plan of the learned reward with the least share of moves that lose
nothing by which the probability is certified; so it is in worlds never seen. Which reward that is:
of those that are learned with more and more weight of the task's probability, the one by which the
demonstrations are most likely then.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxltl.app._todirl_parts import Learned, Setup, part_of
from jaxltl.app.files.task import place as name_of
from jaxltl.app.files.task_todirl import Scene
from jaxltl.app.guarantee import bracket
from jaxltl.core.values.undiscounted.mixture import attained, reaching, require_attainable

_HALVINGS = 5  # between two weights, since what is still too much is mixed away


class Held(NamedTuple):
    """Policies that have the probability asked for, and what of it is their own.

    Attributes:
      policy: ``float[W, S, Q, A]``.
      share: ``float[W]``, of moves that lose nothing.
      attained: ``float[W]``, certified, of the mean or the worst start.
    """

    policy: np.ndarray
    share: np.ndarray
    attained: np.ndarray


def check_attainable(setup: Setup) -> None:
    """Refuses a probability that no policy has in a world that counts.

    Raises:
      ValueError: with the world, and what is possible there.
    """
    task, scenes = setup.task, setup.worlds.scenes
    assert setup.sure is not None
    for w, (scene, sure) in enumerate(zip(scenes, setup.sure, strict=True)):
        if w >= setup.num_training and scene.name in task.test.get("leave_out", ()):
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
    """Plans ``[W, S, Q, A]`` of all moves and of those that lose nothing, mixed as asked.

    In all worlds, or in the first of them.
    """
    assert setup.sure is not None
    found = []
    for w, sure in enumerate(setup.sure[: len(policy)]):
        model = part_of(setup.worlds.model, w)
        found.append(
            reaching(
                model,
                np.asarray(policy[w]),
                np.asarray(inside[w]),
                sure.best,
                float(setup.asked),
                over=setup.task.over,
            )
        )
    policies, shares, reached = zip(*found, strict=True)
    return Held(np.stack(policies), np.array(shares), np.array(reached))


class _Tried(NamedTuple):
    """What was learned with a weight.

    Attributes:
      learned, weight: what, and with which.
      attained: the least certified probability over the training worlds, before anything is mixed.
      neg_log_likelihood: of the demonstrations, after it.
    """

    learned: Learned
    weight: float
    attained: float
    neg_log_likelihood: float


def is_weighable(setup: Setup) -> bool:
    """Whether a weight of the task changes anything: all moves alike do it now and then.

    A soft policy takes them all, so that else it never does the task, whatever its reward.
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
    """What is kept of what is learned with some weights of the task, and its weight.

    Args:
      setup: what is asked.
      counts: ``float[W, S, Q, A]``, how often each pair was demonstrated in a training world.
      free: what is learned without any weight.
      train: what is learned with a weight; None where no weight changes anything.
      plans: in the training worlds, of all moves and of those that lose nothing.
    """
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
