"""Results of a deep inverse RL job: learned rewards, evaluations, and their JSON summary."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import EllipsisType
from typing import TypeVar

import jax
import numpy as np

from jaxltl.app.files.scenes import ObservedScene
from jaxltl.app.files.task_todirl import TodirlFile
from jaxltl.app.guarantee import StepBound, front
from jaxltl.app.job import about, plain
from jaxltl.app.wording import Record, enclosure
from jaxltl.core.automata import Automaton
from jaxltl.core.models import Product, Trajectories, product
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.types import Status
from jaxltl.core.values import OptimalActions, Performance
from jaxltl.core.values.undiscounted.performance import infeasible_starts, summarize

TreeT = TypeVar("TreeT")

LENGTH = 100  # limit of a demonstration of a soft-optimal expert


@dataclass(frozen=True)
class Worlds:
    """Worlds, and their products with the learner's memory and with the formula."""

    scenes: list[ObservedScene]  # W worlds
    # their products with the learner's memory, stacked; with a guarantee, restricted to optimal
    # actions
    model: Product
    task_model: Product  # their products with memory and formula, stacked
    observation: jax.Array  # float[W, S, O]

    @property
    def names(self) -> list[str]:
        return [scene.name for scene in self.scenes]


def part_of(tree: TreeT, chosen: int | slice | EllipsisType) -> TreeT:
    """Part of arrays along their first axis, as NumPy arrays, which need no compilation."""
    return jax.tree.map(lambda x: np.asarray(x)[chosen], tree)


@dataclass(frozen=True)
class TodirlSetup:
    """A task, ready for learning."""

    task: TodirlFile  # the file
    automaton: Automaton  # of the formula
    memory: Automaton  # of the learner's memory
    worlds: Worlds  # training worlds, then test worlds
    num_training: int  # number of training worlds
    expert: jax.Array  # float[W, S, Q, A], the expert's policy in the products `task_model`
    soft: bool  # whether the expert is soft-optimal for a reward, not the quickest optimal policy
    demonstrations: list[Trajectories]  # in each of the training worlds
    dropped: int  # number of simulated demonstrations that do not satisfy the formula
    requested: str | float  # the guarantee; a probability of 1 is "best"
    optimal: list[OptimalActions] | None = None  # in each world; None without a guarantee
    # bounds on the expected steps in each world; None without a guarantee and for safety formulas
    bounds: list[StepBound] | None = None
    left_out: int = 0  # number of demonstrated steps that are not optimal
    unused: int = 0  # number of those after the formula or the best probability is lost
    trivial: str | None = None  # remark on a formula that is always true

    @property
    def loss(self) -> float:
        """Certified loss of optimal actions, the largest over worlds."""
        return max((float(one.loss) for one in self.optimal or ()), default=0.0)

    @property
    def is_probability(self) -> bool:
        return not isinstance(self.requested, str)

    @property
    def groups(self) -> dict[str, slice]:
        """The training worlds and, if there are any, the test worlds."""
        groups = {"training": slice(self.num_training)}
        if len(self.worlds.scenes) > self.num_training:
            groups["test"] = slice(self.num_training, None)
        return groups


@dataclass(frozen=True)
class LearnedRewards:
    """Reward networks of N seeds."""

    parameters: PyTree  # of the network, leading axis N
    held_out: np.ndarray  # float[N], negative log-likelihood of the average held-out pair
    best_step: np.ndarray  # int[N], after which the parameters were reached
    stopped: np.ndarray  # bool[N], whether learning ended by patience
    num_steps: int  # until all seeds ended
    history: Mapping[str, np.ndarray]  # metrics [T, N] and step [T]
    weight: float | None = None  # mu, if a probability is asked


@dataclass(frozen=True)
class WorldEvaluation:
    """Policies in some worlds, and their satisfaction probabilities."""

    policy: np.ndarray  # float[W, S, Q, A] with the learner's memory, of the kept seed
    status: np.ndarray  # int32[W], of its solver
    # of the learned, expert and random policies; leading axis W
    performance: dict[str, Performance]
    seeds: np.ndarray  # float[N, W], mean satisfaction probability of each seed
    # share, attained: float[W], share of optimal actions and certified probability, if one is asked
    share: np.ndarray | None = None
    attained: np.ndarray | None = None
    # float[W, 3], expected steps with bounds, and float[W], the share of the quickest policy
    steps: np.ndarray | None = None
    quick_share: np.ndarray | None = None


@dataclass
class TodirlOutcome:
    """Learned rewards of all seeds and their evaluations."""

    setup: TodirlSetup  # setup, learned: the task, and the results of learning
    learned: LearnedRewards
    chosen: int  # index of the kept seed, by held-out likelihood or loss
    evaluation: WorldEvaluation  # in all worlds
    seed: int  # the first seed


def counted_worlds(setup: TodirlSetup) -> np.ndarray:
    """Indices of the test worlds that count."""
    names = enumerate(setup.worlds.names)
    counted = [w for w, x in names if w >= setup.num_training and x not in setup.task.left_out]
    return np.array(counted, int)


# --- summary ---------------------------------------------------------------------------------


def summary(outcome: TodirlOutcome) -> Record:
    """The result as a JSON object."""
    setup, task = outcome.setup, outcome.setup.task
    pairs = [int(np.sum(trajectories.length)) for trajectories in setup.demonstrations]
    result = {
        **about(task),
        "memory": task.memory,
        "label_on": task.label_on,
        "radius": task.learner.radius,
        "horizon": task.learner.horizon,
        "guarantee": {
            "asked": setup.requested,
            "over": task.over,
            "left_out": setup.left_out,
            "unused": setup.unused and {"steps": setup.unused, "of": setup.unused + sum(pairs)},
            "loss": setup.loss,
            "weight": outcome.learned.weight,
        },
        "trivial": setup.trivial,
        "acceptance": setup.automaton.acceptance,
        "expert": "soft" if setup.soft else "quickest",
        "num_memory": setup.worlds.model.num_memory,
        "demonstrations": {
            "number": [len(trajectories.length) for trajectories in setup.demonstrations],
            "pairs": pairs,
            "synthetic": task.demonstrations.synthetic is not None,
            "dropped": setup.dropped,
        },
        "training": None,
        "test": None,
        **{kind: _about_worlds(outcome, part) for kind, part in setup.groups.items()},
        **_about_learning(outcome),
        "network": {
            "file": "network.npz",
            "load": 'jaxltl.io.learned_reward.load_reward("network.npz")',
            "hidden": task.learner.hidden,
        },
    }
    time: Record | None = result["training"].get("expected_steps")
    if time and setup.automaton.is_cosafe:  # in the world of the largest multiple
        scene = setup.worlds.scenes[setup.worlds.names.index(time["worst_world"])]
        time["front"] = front(product(scene.mdp, setup.automaton, label_on=task.label_on))
    return plain(result)


def _about_learning(outcome: TodirlOutcome) -> Record:
    """The final figures and the history of the kept seed, and figures of all."""
    setup, learned, i = outcome.setup, outcome.learned, outcome.chosen
    history, seeds, counted = learned.history, outcome.evaluation.seeds, counted_worlds(setup)
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
            "training_mean": seeds[:, : setup.num_training].mean(axis=1),
            "test_mean": seeds[:, counted].mean(axis=1) if counted.size else None,
        },
    }


def _about_worlds(outcome: TodirlOutcome, part: slice) -> Record:
    setup, evaluation = outcome.setup, outcome.evaluation
    scenes, names = setup.worlds.scenes[part], setup.worlds.names[part]
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
        bounds, steps = (setup.bounds or [])[part], evaluation.steps[part]
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


def _about_world(scene: ObservedScene, evaluation: WorldEvaluation, w: int) -> Record:
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
