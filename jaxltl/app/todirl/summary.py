"""Results of a todirl job for ``result.json``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxltl.app.files.scenes import Scene
from jaxltl.app.job import about, plain, took
from jaxltl.app.todirl.results import (
    Judged,
    Outcome,
    Worlds,
    counted_worlds,
    part_of,
)
from jaxltl.app.practical import StepBound, front
from jaxltl.core.models.product import product
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.performance import infeasible_starts, summarize
from jaxltl.app.wording import Record, enclosure


def summary(outcome: Outcome) -> Record:
    """The result as a JSON object."""
    setup, learned, i = outcome.setup, outcome.learned, outcome.chosen
    task, history, count = setup.task, learned.history, setup.num_training
    bounds, leave_out = setup.bounds or [], task.left_out
    infeasible = np.array(
        [
            np.asarray(infeasible_starts(part_of(setup.worlds.judged, w))).sum()
            for w in range(len(setup.worlds.scenes))
        ]
    )
    pairs = [int(np.sum(shown.length)) for shown in setup.demonstrations]
    result = {
        **about(task),
        "memory": task.memory,
        "label_on": task.label_on,
        "radius": task.learner.radius,
        "horizon": task.learner.horizon,
        "guarantee": {
            "asked": setup.asked,
            "over": task.over,
            "left_out": setup.left_out,
            "unused": setup.unused and {"steps": setup.unused, "of": setup.unused + sum(pairs)},
            "loss": setup.loss,
            "weight": learned.weight,
        },
        "trivial": setup.trivial,
        "acceptance": setup.judge.acceptance,
        "expert": "soft" if setup.soft else "quickest",
        "num_memory": setup.worlds.model.num_memory,
        "demonstrations": {
            "number": [len(shown.length) for shown in setup.demonstrations],
            "pairs": pairs,
            "synthetic": task.demonstrations.synthetic is not None,
            "dropped": setup.dropped,
        },
        "training": _about_worlds(
            setup.training, outcome.training, infeasible[:count], (), bounds[:count]
        ),
        "test": outcome.test
        and setup.test
        and _about_worlds(setup.test, outcome.test, infeasible[count:], leave_out, bounds[count:]),
        "learning": {
            **{k: history[k][-1][i] for k in ("loss", "neg_log_likelihood", "gradient_norm")},
            "held_out": learned.held_out[i],
            "best_step": learned.best_step[i],
            "stopped_early": bool(learned.stopped[i]),
            "steps": learned.num_steps,
            "solver": Status(int(history["status"][:, i].max())).name,
            "solver_error": history["error"][:, i].max(),
            "hyperparameters": task.learner.hyperparameters(),
        },
        "history": {
            "step": history["step"],
            **{k: history[k][:, i] for k in ("loss", "per_pair", "held_out", "gradient_norm")},
        },
        "seeds": {
            "first": outcome.seed,
            "number": len(learned.held_out),
            "kept": i,
            "held_out": learned.held_out,
            "best_step": learned.best_step,
            "training_mean": outcome.training.seeds.mean(axis=1),
            "test_mean": (
                outcome.test and outcome.test.seeds[:, counted_worlds(setup)].mean(axis=1)
            ),
        },
        "network": {
            "file": "network.npz",
            "load": 'jaxltl.io.learned_reward.load_reward("network.npz")',
            "hidden": task.learner.hidden,
        },
        **took(outcome.seconds),
    }
    time: Record | None = result["training"].get("expected_steps")
    if time and setup.judge.is_cosafe:  # in the world of the largest multiple
        scene = setup.worlds.scenes[setup.worlds.names.index(time["worst_world"])]
        time["front"] = front(product(scene.mdp, setup.judge, label_on=task.label_on))
    return plain(result)


def _about_worlds(
    worlds: Worlds,
    judged: Judged,
    infeasible: np.ndarray,
    leave_out: Sequence[str],
    bounds: Sequence[StepBound],
) -> Record:
    found: Record = {"num_worlds": len(worlds.scenes)}
    for who, performance in judged.performance.items():
        mean = summarize(worlds.judged, performance, names=worlds.names, leave_out=leave_out)
        found[who] = {
            "mean": enclosure(mean.mean, mean.lower, mean.upper),
            "std": mean.std,
            "worst_world": {"name": mean.worst_world, "value": mean.worst},
            "worst_start": mean.worst_start,
            "uncertain": list(mean.uncertain),
        }
        found["infeasible"], found["left_out"] = list(mean.infeasible), list(mean.left_out)
        found["num_counted"] = mean.num_worlds
    if judged.steps is not None:
        least = np.array([b.quickest.steps.upper for b in bounds])
        possible = np.isfinite(least) & (least > 0)
        w = int(np.argmax(np.where(possible, judged.steps[:, 2], 0) / np.where(possible, least, 1)))
        found["expected_steps"] = {
            "factor": bounds[w].factor,
            "mixed": int((judged.quick_share > 0).sum()) if judged.quick_share is not None else 0,
            "worst_world": worlds.names[w],
            "learned": judged.steps[w, 0],
            "learned_bounds": judged.steps[w, 1:],
            "quickest": bounds[w].quickest.steps.value,
            "quickest_bounds": bounds[w].quickest.steps[1:3],
            "worlds": [
                {"name": name, "steps": steps, "quickest": bound.quickest.steps.value}
                for name, steps, bound in zip(worlds.names, judged.steps, bounds, strict=True)
            ],
        }
    found["solver"] = Status(int(judged.status.max())).name
    found["worlds"] = [
        _about_world(scene, judged, w, int(infeasible[w])) for w, scene in enumerate(worlds.scenes)
    ]
    return found


def _about_world(scene: Scene, judged: Judged, w: int, infeasible: int) -> Record:
    one = part_of(judged.performance["learned"], w)
    return {
        "name": scene.name,
        "mean": enclosure(one.mean, one.lower, one.upper),
        "minimum": {
            **enclosure(one.worst, one.worst_lower, one.worst_upper),
            **scene.place(int(one.worst_state)),
        },
        "status": Status(int(one.status)).name,
        "expert": judged.performance["expert"].mean[w],
        "random": judged.performance["random"].mean[w],
        "num_starts": int(np.sum(np.asarray(scene.mdp.initial) > 0)),
        "infeasible_starts": infeasible,
        **{
            key: x[w]
            for key, x in (("share", judged.share), ("attained", judged.attained))
            if x is not None
        },
    }
