"""Task-oriented deep inverse reinforcement learning: the job of ``method = "todirl"``.

A reward network is learned in training worlds (dissertation, chapter 3). Its soft-optimal policies
are compared there and in test worlds with an expert for the formula and the uniform policy.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.algos import todirl
from jaxltl.algos.common.demonstrations import require_cosafe
from jaxltl.algos.common.guarantees import check_formula
from jaxltl.algos.common.seeds import Training, make_hparams
from jaxltl.algos.todirl.worlds import part_of
from jaxltl.app.files.scenes import (
    ObservedScene,
    cell_kinds,
    load_automata,
    load_scenes,
)
from jaxltl.app.files.task_irl import TodirlFile
from jaxltl.app.files.worlds import read_all, synthetic_demonstrations
from jaxltl.app.reports import steps
from jaxltl.app.reports import page
from jaxltl.app.todirl_results import LENGTH, TodirlOutcome, TodirlSetup, summary as summary
from jaxltl.app.wording import Record, Result
from jaxltl.core.automata import Automaton
from jaxltl.core.environments.monitor import Verdict, verdicts
from jaxltl.core import models
from jaxltl.core.policies.policy_file import save_policy
from jaxltl.core.types import Solution
from jaxltl.core.validation import errors_in
from jaxltl.core.values import optimal_satisfaction, soft_value
from jaxltl.envs import temporal_gridworld
from jaxltl.envs.cell_kinds import COLORS
from jaxltl.envs.gridworld import ACTIONS
from jaxltl.io.learned_reward import LearnedReward, save_reward
from jaxltl.plot.drawing import Picture, automaton_picture, drawing, short_name
from jaxltl.plot import explorer

DOUBLE, FILE = True, TodirlFile

_BATCH = 64  # worlds in a batch of planning
_EXPERT_DISCOUNT = 0.99  # largest default


def prepare(task: TodirlFile, seed: int) -> TodirlSetup:
    """Worlds, automata and demonstrations of a task; ValueError for one that does not fit."""
    automaton, memory = load_automata(task)
    table = task.demonstrations
    if table.discount is not None:
        with errors_in(f"{task.path}: [demonstrations] "):
            require_cosafe(automaton)
    with errors_in(f"{task.path}: [task] "):
        trivial = check_formula(automaton)
    training, others = load_scenes(task, automaton)
    scenes = [*training, *others]
    demonstrations = read_all(task.path, table.files, training) if table.files is not None else []
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
        # The formula's automaton state varies fastest.
        expert = np.tile(expert, (1, 1, len(memory.delta), 1))
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
        products = models.stack_products([s.mdp for s in scenes], automaton, label_on=task.label_on)
        return np.asarray(_expert(products, discount, table.rewards())), []
    bests = [
        optimal_satisfaction(models.product(s.mdp, automaton, label_on=task.label_on))
        for s in scenes
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
def _expert(products: models.Product, discount: float, rewards: Mapping[str, float]) -> jax.Array:
    def one(model: models.Product) -> jax.Array:
        reward = temporal_gridworld.expert_reward(model, **rewards)
        return soft_value(model, reward, discount, method="value_iteration").policy

    return lax.map(one, products, batch_size=_BATCH)


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
        table = models.project_policy(model, policy, actions=ACTIONS)
        save_policy(out / f"policy_{w + 1}.npz", table, {"satisfaction": value})


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


# --- the report ---------------------------------------------------------------------------


_POLICIES = {
    "learned": "learned reward",
    "expert": "expert, who knows the formula",
    "random": "random actions",
}
_EXPERT = {
    "soft": "The expert knows the formula and is soft-optimal for a reward of it.",
    "quickest": "The expert knows the formula: its policy is the quickest of those with maximal "
    "satisfaction probability.",
}


def _values(result: Result) -> Record:
    # The training worlds and, if there are any, the test worlds.
    groups = [(kind, result[kind]) for kind in ("training", "test") if result[kind]]
    evidence = [
        (
            f"{kind}, {policy}",
            *page.cells(one["mean"]),
            page.number(one["std"]) if about["num_counted"] > 1 else "",
            f"{page.probability(one['worst_world']['value'])}, {one['worst_world']['name']}",
            page.probability(one["worst_start"]),
        )
        for kind, about in reversed(groups)
        for policy in _POLICIES
        for one in [about[policy]]
    ]

    def mean_value(world: Result) -> float:
        value: float | None = world["mean"]["value"]
        return -1.0 if value is None else value

    return {
        "evidence": evidence,
        "steps": steps,
        "expert": _EXPERT[result["expert"]],
        "groups": groups,
        "policies": _POLICIES,
        "world_tables": [
            (f"{kind.capitalize()} worlds", about, sorted(about["worlds"], key=mean_value))
            for kind, about in reversed(groups)
        ],
        "counted_worlds": [
            x for _, about in groups for x in about["worlds"] if x["name"] not in about["left_out"]
        ],
    }


report = page.Report("todirl", _values)


_PICTURES = 3  # worlds that are drawn, of each kind

_FIGURES = ("per_pair", "held_out", "gradient_norm")


def task_pictures(setup: TodirlSetup) -> list[Picture]:
    """Pictures of the automata of the formula and of the memory."""
    same = setup.worlds.memory is setup.worlds.automaton
    drawings = [automaton_picture(setup.worlds.automaton, "training-1" if same else "")]
    if not same:
        text = "The automaton whose state is the learner's memory; the formula's automaton evaluates it."
        drawn = drawing("automaton", setup.worlds.memory)
        drawings.append(Picture("memory.svg", "Memory of the learner", drawn, text, "training-1"))
    return drawings


def sections(outcome: TodirlOutcome) -> list[page.Section]:
    """Learning curves, expected steps, and policies in worlds."""
    scores = outcome.kept.learned.held_out
    caption = (
        "Negative log-likelihood of the average demonstrated pair, of the average held-out pair "
        "if there are any, and the norm of the gradient, before each step"
    )
    if not np.isnan(scores).any():
        caption += ". The parameters with the least held-out figure are kept"
    parts = page.learning_curves(outcome.kept.learned.history, _FIGURES, caption, len(scores))
    if time := summary(outcome)["training"].get("expected_steps"):
        parts += steps.pictures({**time, "likelihood": []})
    for one in _drawn_worlds(outcome):
        parts += _world_sections(outcome, *one)
    return parts


def _drawn_worlds(outcome: TodirlOutcome) -> Iterator[tuple[int, str, str, bool]]:
    """Number, file stem and title of the worlds that are drawn, and whether their policy is."""
    setup, mean = outcome.setup, np.asarray(outcome.kept.performance["learned"].mean)

    def title(kind: str, w: int) -> str:
        return f"{kind}: {setup.worlds.names[w]} ({mean[w]:.4f})"

    for w in range(min(_PICTURES, setup.worlds.num_training)):
        yield w, f"training_{w + 1}", title("Training world", w), True
    # The test worlds of least, median and greatest satisfaction probability, each once.
    counted = setup.counted
    if order := counted[np.argsort(mean[counted], kind="stable")].tolist():
        ranks = {"best": order[-1], "median": order[len(order) // 2], "worst": order[0]}
        named = {w: rank for rank, w in ranks.items()}
        for n, (w, rank) in enumerate(reversed(named.items())):
            yield w, f"test_{n + 1}", title(f"Test world, {rank}", w), n == 0


def _world_sections(
    outcome: TodirlOutcome, w: int, stem: str, title: str, arrows: bool
) -> list[page.Section]:
    """A world: its policy, and trajectories of it and of the demonstrations."""
    setup, scene, worlds = outcome.setup, outcome.setup.scenes[w], outcome.setup.worlds
    size, live, names = scene.mdp.num_states, stem.replace("_", "-"), _memory_names(setup)
    # float[S, Q, A], or with a horizon [T, S, Q, A]; the first step is drawn.
    policy = outcome.kept.policy[w][..., :size, :, :]
    moving = policy if policy.ndim == 3 else policy[0]
    value = np.asarray(outcome.kept.performance["learned"].value[w])[:size]
    place = scene.cells if scene.colored is None else part_of(scene.colored, ...)
    wall, runs = setup.task.world.wall or "#", _runs(outcome, w, policy)
    layers = {str(q): explorer.MapLayer(name, None, moving[:, q]) for q, name in names.items()}
    at_start = np.where(np.asarray(scene.mdp.initial) > 0, value, np.nan)
    layers[explorer.START] = explorer.MapLayer("initial states", at_start, None)
    demonstrated = []
    if w < worlds.num_training:
        trajectories = setup.demands.demonstrations[w]
        demonstrated = explorer.demonstrated_runs(part_of(worlds.model, w), trajectories)
    caption = (
        "One map for each memory state; lengths of arrows are the probabilities of actions"
        f"{'' if policy.ndim == 3 else ' at the first step'}. The title has the mean "
        "satisfaction probability."
    )
    same = worlds.memory is worlds.automaton
    parts: list[page.Section] = [
        explorer.Explorer(
            name=live,
            title=title,
            caption=caption,
            size=size,
            automaton=worlds.memory,
            layers=layers,
            runs=[*demonstrated, *runs],
            place=place,
            actions=ACTIONS,
            label="satisfaction probability",
            wall=wall,
            goal="the formula" if same else "the memory's formula",
        )
    ]
    # About as many characters as a panel is wide.
    width = int(np.clip(5 * scene.shape[1], 9, 50))
    memories, titles = list(names), [short_name(name, width) for name in names.values()]
    if scene.colored is None:
        drawn = drawing(
            "grid",
            place,
            np.broadcast_to(value, (len(memories), size)),
            moving.transpose(1, 0, 2)[memories],
            titles=titles,
            label="satisfaction probability",
            wall=wall,
        )
        caption += " Colours: the satisfaction probability from there as an initial state."
    else:
        drawn = drawing("temporal_gridworld", place, moving, memory=memories, title=titles)
    if arrows or scene.colored is None:
        parts.append(Picture(f"{stem}.svg", title, drawn, caption, live))
    pairs = [[(s, a) for s, _, a in run.steps if a is not None] for run in runs]
    if scene.colored is not None and policy.ndim == 3 and any(pairs):
        walks = models.make_trajectories(scene.mdp, [each for each in pairs if each])
        end = f"violated, or for {explorer.LONGEST_RUN} steps"
        if worlds.automaton.is_cosafe:  # by a finite prefix
            end = "satisfied or violated"
        text = (
            f"{len(walks.length)} trajectories of the learned policy from random initial states, "
            f"each until the formula is {end}."
        )
        drawn = drawing("temporal_gridworld", place, trajectories=walks)
        title = f"Trajectories in {scene.name}" if arrows else title
        parts.append(Picture(f"{stem}_runs.svg", title, drawn, text, live))
    return parts


def _memory_names(setup: TodirlSetup) -> dict[int, str]:
    """The undecided memory states, with their names."""
    memory = setup.worlds.memory
    names = memory.state_names or ("",) * len(memory.delta)
    undecided = np.flatnonzero(verdicts(memory) == Verdict.UNDECIDED).tolist()
    return {q: f"memory state {q}: {names[q]}" for q in undecided or [0]}


def _runs(outcome: TodirlOutcome, w: int, policy: np.ndarray) -> list[explorer.ReportTrajectory]:
    """Rollouts of the learned policy with the learner's memory, until the formula is decided."""
    worlds, count = outcome.setup.worlds, 1
    if worlds.memory is not worlds.automaton:
        policy = np.asarray(models.lift_memory_policy(jnp.asarray(policy), worlds.automaton))
        count = len(worlds.automaton.delta)  # the formula's automaton state varies fastest
    return [
        explorer.ReportTrajectory(run.name, [(s, q // count, a) for s, q, a in run.steps])
        for run in explorer.learned_runs(part_of(worlds.task_model, w), policy, outcome.seed)
    ]
