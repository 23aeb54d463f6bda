"""Results of a deep inverse RL job: its setup, its outcome, and their JSON summary."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import jax
import numpy as np

from jaxltl.algos.todirl import TransferredReward, WorldDemands, Worlds
from jaxltl.algos.todirl.worlds import part_of
from jaxltl.app.files.scenes import ObservedScene
from jaxltl.app.files.task_irl import TodirlFile
from jaxltl.app.reports.steps import front_entry
from jaxltl.app.wording import Record, about, enclosure, plain
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.performance import infeasible_starts, summarize

LENGTH = 100  # limit of a demonstration of a soft-optimal expert


@dataclass(frozen=True)
class TodirlSetup:
    """A task, ready for learning."""

    task: TodirlFile  # the file
    scenes: list[ObservedScene]  # training worlds, then test worlds
    demands: WorldDemands  # the worlds, their demonstrations, and the guarantee
    expert: jax.Array  # float[W, S, Q, A], the expert's policy in the products `task_model`
    soft: bool  # whether the expert is soft-optimal for a reward, not the quickest optimal policy
    dropped: int  # number of simulated demonstrations that do not satisfy the formula
    trivial: str | None = None  # remark on a formula that is always true

    @property
    def worlds(self) -> Worlds:
        return self.demands.worlds

    @property
    def counted(self) -> np.ndarray:
        """Indices of the test worlds that count."""
        names = enumerate(self.worlds.names)
        count, exempt = self.worlds.num_training, self.task.left_out
        return np.array([w for w, name in names if w >= count and name not in exempt], int)


@dataclass(eq=False)  # hashed by identity
class TodirlOutcome:
    """Learned rewards of all seeds and their evaluations."""

    setup: TodirlSetup
    kept: TransferredReward
    seed: int  # the first seed


@lru_cache(maxsize=1)
def summary(outcome: TodirlOutcome) -> Record:
    """The results for ``result.json``."""
    setup, task, demands = outcome.setup, outcome.setup.task, outcome.setup.demands
    pairs = [int(np.sum(trajectories.length)) for trajectories in demands.demonstrations]
    count = setup.worlds.num_training
    result = {
        **about(task.name, task.formula, task.learner.method),
        "memory": task.memory,
        "label_on": task.label_on,
        "radius": task.learner.radius,
        "horizon": task.learner.horizon,
        "guarantee": {
            "asked": demands.requested,
            "over": task.over,
            "left_out": demands.left_out,
            "unused": demands.unused
            and {"steps": demands.unused, "of": demands.unused + sum(pairs)},
            "loss": demands.loss,
            "weight": outcome.kept.learned.weight,
        },
        "trivial": setup.trivial,
        "acceptance": setup.worlds.automaton.acceptance,
        "expert": "soft" if setup.soft else "quickest",
        "num_memory": setup.worlds.model.num_memory,
        "demonstrations": {
            **task.demonstrations.entry([len(x.length) for x in demands.demonstrations], pairs),
            "dropped": setup.dropped,
        },
        "training": _about_worlds(outcome, slice(count)),
        "test": _about_worlds(outcome, slice(count, None)) if len(setup.scenes) > count else None,
        **_about_learning(outcome),
        "network": {
            "file": "network.npz",
            "load": 'jaxltl.io.learned_reward.load_reward("network.npz")',
            "hidden": task.learner.hidden,
        },
    }
    time: Record | None = result["training"].get("expected_steps")
    if time and setup.worlds.automaton.is_cosafe:  # in the world of the largest multiple
        worst = setup.worlds.names.index(time["worst_world"])
        time["front"] = front_entry(setup.worlds.own_product(worst))
    return plain(result)


def _about_learning(outcome: TodirlOutcome) -> Record:
    """The final figures and the history of the kept seed, and figures of all."""
    setup, kept = outcome.setup, outcome.kept
    learned, i = kept.learned, kept.chosen
    history, seeds, counted = learned.history, kept.seeds, setup.counted
    return {
        "learning": {
            **{k: history[k][-1][i] for k in ("loss", "neg_log_likelihood", "gradient_norm")},
            "held_out": learned.held_out[i],
            "best_step": learned.best_step[i],
            "stopped_early": bool(learned.stopped[i]),
            "steps": learned.num_steps,
            "solver": Status(int(history["status"][:, i].max())).name,
            "solver_error": history["error"][:, i].max(),
            "hyperparameters": setup.task.learner.hyperparameters(),
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
            "training_mean": seeds[:, : setup.worlds.num_training].mean(axis=1),
            "test_mean": seeds[:, counted].mean(axis=1) if counted.size else None,
        },
    }


def _about_worlds(outcome: TodirlOutcome, part: slice) -> Record:
    setup, evaluation = outcome.setup, outcome.kept
    scenes, names = setup.scenes[part], setup.worlds.names[part]
    models = part_of(setup.worlds.task_model, part)
    infeasible = [int(infeasible_starts(part_of(models, w)).sum()) for w in range(len(names))]
    leave_out = setup.task.left_out if part.start else ()
    record: Record = {"num_worlds": len(scenes)}
    for who, performance in evaluation.performance.items():
        mean = summarize(models, part_of(performance, part), names=names, leave_out=leave_out)
        record[who] = {
            "mean": enclosure(mean.mean, mean.lower, mean.upper),
            "std": mean.std,
            "worst_world": {"name": mean.worst_world, "value": mean.worst},
            "worst_start": mean.worst_start,
            "uncertain": list(mean.uncertain),
        }
        record["infeasible"], record["left_out"] = list(mean.infeasible), list(mean.left_out)
        record["num_counted"] = mean.num_worlds
    if evaluation.steps is not None and evaluation.quick_share is not None:
        bounds, steps = (setup.demands.bounds or [])[part], evaluation.steps[part]
        least = np.array([b.quickest.steps.upper for b in bounds])
        possible = np.isfinite(least) & (least > 0)
        w = int(np.argmax(np.where(possible, steps[:, 2], 0) / np.where(possible, least, 1)))
        record["expected_steps"] = {
            "factor": bounds[w].factor,
            "mixed": int((evaluation.quick_share[part] > 0).sum()),
            "worst_world": names[w],
            "learned": steps[w, 0],
            "learned_bounds": steps[w, 1:],
            "quickest": bounds[w].quickest.steps.value,
            "quickest_bounds": bounds[w].quickest.steps[1:3],
            "worlds": [
                {"name": name, "steps": each, "quickest": bound.quickest.steps.value}
                for name, each, bound in zip(names, steps, bounds, strict=True)
            ],
        }
    record["solver"] = Status(int(evaluation.status[part].max())).name
    first = part.start or 0
    record["worlds"] = [
        {**_about_world(scene, evaluation, first + w), "infeasible_starts": infeasible[w]}
        for w, scene in enumerate(scenes)
    ]
    return record


def _about_world(scene: ObservedScene, evaluation: TransferredReward, w: int) -> Record:
    one = part_of(evaluation.performance["learned"], w)
    record = {
        "name": scene.name,
        "mean": enclosure(one.mean, one.lower, one.upper),
        "minimum": {
            **enclosure(one.worst, one.worst_lower, one.worst_upper),
            **scene.position(int(one.worst_state)),
        },
        "status": Status(int(one.status)).name,
        "expert": evaluation.performance["expert"].mean[w],
        "random": evaluation.performance["random"].mean[w],
        "num_starts": int(np.sum(np.asarray(scene.mdp.initial) > 0)),
    }
    if evaluation.share is not None and evaluation.attained is not None:
        record |= {"share": evaluation.share[w], "attained": evaluation.attained[w]}
    return record
