"""Attains a requested satisfaction probability in every world of a todirl job.

In each world, also in new ones, the policy is the plan of the learned reward, mixed with the least
share of optimal actions for which the probability is certified. Among the rewards learned with
increasing weights of the satisfaction probability, the one with the most likely demonstrations is
kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from jaxltl.app.todirl.results import Learned, Setup, part_of
from jaxltl.app.guarantee import Attempt
from jaxltl.app.practical import StepBound, neg_log_likelihood, step_bound
from jaxltl.core.validation import errors_in
from jaxltl.core.values.undiscounted.mixture import (
    WINDOW,
    Mixture,
    attained,
    reaching,
    require_attainable,
)
from jaxltl.core.values.undiscounted.satisfaction_steps import StepAnalysis

_AIM = WINDOW / 4  # margin of the certified probability over the asked one
_WEIGHTS = 10.0 ** np.arange(-1, 5.5, 0.5)  # of the satisfaction probability, in this order
_HALVINGS = 5  # few bisections of the weight, since the mixture closes the gap


def check_attainable(setup: Setup) -> None:
    """Raises ValueError for a probability that no policy attains in a world that counts."""
    task, scenes = setup.task, setup.worlds.scenes
    assert setup.sure is not None
    for w, (scene, sure) in enumerate(zip(scenes, setup.sure, strict=True)):
        if w >= setup.num_training and scene.name in task.left_out:
            continue
        try:
            require_attainable(
                part_of(setup.worlds.model, w),
                sure.best,
                float(setup.requested),
                task.over,
                scene.place,
            )
        except ValueError as error:
            kind = "training" if w < setup.num_training else "test"
            fix = "" if kind == "training" else " Or name it in [test] leave_out."
            raise ValueError(
                f"{task.path}: [task] in the {kind} world {scene.name}: {error}{fix}"
            ) from None


def hold(setup: Setup, policy: np.ndarray, inside: np.ndarray) -> list[Mixture]:
    """Mixes plans ``[W, S, Q, A]`` of all actions and of optimal ones, in the first W worlds."""
    assert setup.sure is not None
    requested, over = float(setup.requested), setup.task.over
    return [
        reaching(
            part_of(setup.worlds.model, w), policy[w], inside[w], sure.best, requested, over=over
        )
        for w, sure in enumerate(setup.sure[: len(policy)])
    ]


def step_bounds(setup: Setup) -> list[StepBound] | None:
    """The bounds on the expected steps in all worlds; None for safety formulas."""
    task, bounds = setup.task, []
    for w, (scene, sure) in enumerate(zip(setup.worlds.scenes, setup.sure or (), strict=True)):
        with errors_in(f"{task.path}: [task] in the world {scene.name}: "):
            model = part_of(setup.worlds.model, w)
            bound = step_bound(
                model, sure, setup.requested, task.over, task.steps, task.steps_factor
            )
        if bound is None:
            return None
        bounds.append(bound)
    return bounds


def within_steps(setup: Setup, bounds: list[StepBound], policy: np.ndarray) -> list[Mixture]:
    """The policies ``[W, S, Q, A]`` of all worlds with their expected steps within the bounds."""
    mixtures = []
    for w, bound in enumerate(bounds):
        model = part_of(setup.worlds.model, w)
        mixture = bound.keep(model, policy[w])
        mixtures.append(
            mixture._replace(steps=mixture.steps or StepAnalysis(model).steps(mixture.policy))
        )
    return mixtures


def likeliest(
    setup: Setup,
    counts: np.ndarray,
    free: Learned,
    train: Callable[[float], Learned] | None,
    plans: Callable[[Learned], tuple[np.ndarray, np.ndarray]],
) -> Attempt:
    """The network of greatest likelihood over some weights."""
    models = [part_of(setup.worlds.model, w) for w in range(setup.num_training)]

    def judged(learned: Learned, weight: float) -> Attempt:
        policy, inside = plans(learned)
        held = np.stack([one.policy for one in hold(setup, policy, inside)])
        loss = neg_log_likelihood(held[:, : counts.shape[1]], counts)
        each = [attained(m, p, setup.task.over) for m, p in zip(models, policy, strict=True)]
        # The least certified probability over the training worlds, before mixing.
        return Attempt(held, loss, min(each), weight, 0.0, learned)

    attempts = [judged(free, 0.0)]
    if attempts[0].attained < float(setup.requested) and train is not None:
        attempts += _bracket(lambda mu: judged(train(mu), mu), float(setup.requested))
    return min(attempts, key=lambda one: np.nan_to_num(one.neg_log_likelihood, nan=np.inf))


def _bracket(tried: Callable[[float], Attempt], requested: float) -> Iterator[Attempt]:
    """Yields attempts with increasing weights until one suffices, then by bisection."""
    # The likelihood has several maxima, and those found from too large a weight are lower.
    low = 0.0
    for high in map(float, _WEIGHTS):
        last = tried(high)
        yield last
        if last.attained >= requested:
            break
        low = high
    else:
        return
    low = low or high * 1e-3
    for _ in range(_HALVINGS):
        if requested <= last.attained <= requested + _AIM:
            return
        middle = float(np.sqrt(low * high))
        last = tried(middle)
        yield last
        low, high = (low, middle) if last.attained >= requested else (middle, high)
