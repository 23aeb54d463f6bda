"""Task-oriented deep inverse reinforcement learning: the job of ``method = "todirl"``.

A reward network is learned in training worlds (dissertation, chapter 3). Its soft-optimal policies
are compared there and in test worlds with an expert for the formula and the uniform policy.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.algos import todirl
from jaxltl.algos.common.guarantees import check_formula
from jaxltl.algos.common.seeds import Training, make_hparams
from jaxltl.algos.todirl.worlds import part_of
from jaxltl.app.files.worlds import require_cosafe, synthetic_demonstrations
from jaxltl.app.files.scenes import (
    cell_kinds,
    load_automata,
    load_demonstrations,
    load_scenes,
    ObservedScene,
)
from jaxltl.app.files.task_todirl import TodirlFile
from jaxltl.app.wording import postfix as postfix
from jaxltl.app.reports.learn_todirl import (
    live as live,
    pictures as pictures,
    report as report,
    task_pictures as task_pictures,
)
from jaxltl.app.todirl_results import LENGTH, TodirlOutcome, TodirlSetup, summary as summary
from jaxltl.core.automata import Automaton
from jaxltl.core.models import Product, product, project_policy, stack_products
from jaxltl.core.policies.policy_file import save_policy
from jaxltl.core.types import Solution
from jaxltl.core.validation import errors_in
from jaxltl.core.values import optimal_satisfaction, soft_value
from jaxltl.envs import temporal_gridworld
from jaxltl.envs.cell_kinds import COLORS
from jaxltl.envs.gridworld import ACTIONS
from jaxltl.io.learned_reward import LearnedReward, save_reward

DOUBLE, FILE = True, TodirlFile

_BATCH = 64  # worlds in a batch of planning
_EXPERT_DISCOUNT = 0.99  # largest default


def prepare(task: TodirlFile, seed: int) -> TodirlSetup:
    """Worlds, automata and demonstrations of a task; ValueError for one that does not fit."""
    automaton, memory = load_automata(task)
    table = task.demonstrations
    require_cosafe(task.path, table, automaton)
    with errors_in(f"{task.path}: [task] "):
        trivial = check_formula(automaton)
    training, others = load_scenes(task, automaton)
    scenes = [*training, *others]
    demonstrations = load_demonstrations(task, training) if table.files is not None else []
    with errors_in(f"{task.path}: "):
        worlds = todirl.make_worlds(
            [scene.mdp for scene in scenes],
            [scene.observation for scene in scenes],
            automaton,
            memory,
            label_on=task.label_on,
            names=[scene.name for scene in scenes],
            places=[scene.position_text for scene in scenes],
            num_training=len(training),
        )
    soft = automaton.is_cosafe and (table.discount is not None or bool(demonstrations))
    expert, bests = _experts(task, scenes, automaton, soft=soft)
    dropped = 0
    if not demonstrations:
        key = jax.random.fold_in(jax.random.key(seed), 0)
        for w, scene in enumerate(training):
            # Without padding and the learner's memory: tasks that differ only in these have the
            # same demonstrations.
            model, own = worlds.own_product(w), jax.random.fold_in(key, w)
            if soft:
                policy = expert[w, : scene.mdp.num_states]
                count, length = table.synthetic or 0, table.length or LENGTH
                runs = temporal_gridworld.demonstrations(own, model, policy, count, length)
            else:
                runs, lost = synthetic_demonstrations(own, task.path, table, model, bests[w])
                dropped += lost
            demonstrations.append(runs)
    if memory is not automaton:
        expert = np.tile(
            expert, (1, 1, len(memory.delta), 1)
        )  # the formula's automaton state varies fastest
    with errors_in(f"{task.path}: [task] "):
        demands = todirl.make_demands(
            worlds,
            demonstrations,
            task.guarantee,
            over=task.over,
            steps=task.steps,
            steps_factor=task.steps_factor,
            exempt=task.left_out,
        )
    return TodirlSetup(task, scenes, demands, jnp.asarray(expert), soft, dropped, trivial)


def _experts(
    task: TodirlFile, scenes: list[ObservedScene], automaton: Automaton, *, soft: bool
) -> tuple[np.ndarray, list[Solution]]:
    """Policies ``[W, S, Q, A]`` of the expert, and optimal solutions unless it is soft-optimal."""
    if soft:
        table = task.demonstrations
        discount = table.discount
        if discount is None:
            discount = min(task.learner.discount, _EXPERT_DISCOUNT)
        models = stack_products([s.mdp for s in scenes], automaton, label_on=task.label_on)
        return np.asarray(_expert(models, discount, table.rewards())), []
    bests = [
        optimal_satisfaction(product(s.mdp, automaton, label_on=task.label_on)) for s in scenes
    ]
    size = max(scene.mdp.num_states for scene in scenes)
    # Actions in padding states never matter.
    chosen = [np.pad(np.asarray(x.policy), ((0, size - len(x.policy)), (0, 0))) for x in bests]
    return np.eye(len(ACTIONS))[np.stack(chosen)], bests


def describe(setup: TodirlSetup) -> str:
    """Numbers of worlds, memory states and demonstrations, as text."""
    lengths = [np.asarray(x.length) for x in setup.demands.demonstrations]
    training, worlds = setup.worlds.num_training, setup.worlds
    return (
        f"{training} training and {len(setup.scenes) - training} test worlds, "
        f"{worlds.model.num_memory} memory states, {sum(map(len, lengths))} demonstrations of "
        f"{sum(int(x.sum()) for x in lengths)} pairs"
    )


def learn(setup: TodirlSetup, training: Training) -> TodirlOutcome:
    """Learns with N seeds, keeps one without looking at test worlds, and evaluates it."""
    table = setup.task.learner
    kept = todirl.train_in_worlds(
        setup.demands,
        make_hparams(todirl.Hparams, table.specified()),
        training,
        network=todirl.RewardNetwork(tuple(table.hidden)),
        num_steps=table.steps,
        held_out=table.held_out,
        references={"expert": setup.expert},
    )
    return TodirlOutcome(setup, kept, training.seed)


@jax.jit
def _expert(models: Product, discount: float, rewards: Mapping[str, float]) -> jax.Array:
    def one(model: Product) -> jax.Array:
        reward = temporal_gridworld.expert_reward(model, **rewards)
        return soft_value(model, reward, discount, method="value_iteration").policy

    return lax.map(one, models, batch_size=_BATCH)


def save(out: Path, outcome: TodirlOutcome) -> None:
    """Writes ``network.npz`` and, for each training world, ``policy_1.npz`` and so on.

    :func:`jaxltl.io.load_reward` reads the network, and :func:`jaxltl.io.load_policy` a policy, whose
    file also has the satisfaction probabilities ``satisfaction [S]``.
    """
    for pattern in ("policy_*.npz", "training_*.svg", "test_*.svg"):
        for stale in out.glob(pattern):
            stale.unlink()
    save_reward(out / "network.npz", learned_reward(outcome))
    worlds, kept = outcome.setup.worlds, outcome.kept
    for w, scene in enumerate(outcome.setup.scenes[: worlds.num_training]):
        size = scene.mdp.num_states
        model = replace(part_of(worlds.model, w), mdp=scene.mdp)
        model = replace(model, letter=model.letter[:size])
        policy = kept.policy[w][..., :size, :, :]
        value = kept.performance["learned"].value[w, :size]
        save_policy(
            out / f"policy_{w + 1}.npz",
            project_policy(model, policy, actions=ACTIONS),
            {"satisfaction": value},
        )


def learned_reward(outcome: TodirlOutcome) -> LearnedReward:
    """The kept seed's reward with the parameters of planning."""
    task, kept = outcome.setup.task, outcome.kept
    kinds = COLORS if task.is_colored else (*cell_kinds(task.world), "off the map")
    return LearnedReward(
        parameters=part_of(kept.learned.parameters, kept.chosen),
        hidden=tuple(task.learner.hidden),
        memory=outcome.setup.worlds.memory,
        label_on=task.label_on,
        discount=task.learner.discount,
        horizon=task.learner.horizon,
        radius=task.learner.radius,
        formula=task.formula,
        kinds=tuple(kinds),
        guarantee=outcome.setup.demands.requested,
        over=task.over,
        steps_factor=task.steps_factor,
    )
