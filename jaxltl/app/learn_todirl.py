"""From demonstrations to a reward that carries over: what `jaxltl learn` does for todirl.

The reward network is learned in the training worlds (dissertation, chapter 3), and the policies
that are soft-optimal for it are judged there and in test worlds, beside the one of an expert who
knows the task and one that moves at random.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxltl
from jaxltl.algos import learner, todirl
from jaxltl.algos.checkpoint import atomic_write
from jaxltl.app.drawing import Picture, drawing
from jaxltl.app.files.task_todirl import (
    Scene,
    Task,
    cell_kinds,
    expert_rewards,
    load_automata,
    load_demonstrations,
    load_scenes,
    read_task,
)
from jaxltl.app.learn import Report, by_name, fingerprint, history_of, plain, short_name
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.synchronize import synchronize
from jaxltl.core.models.batch import lift_memory, stack_products
from jaxltl.core.models.monitor import Verdict, verdicts
from jaxltl.core.models.operators import action_mean, expectation
from jaxltl.core.models.product import Product, product, project_policy
from jaxltl.core.models.trajectories import Trajectories
from jaxltl.core.types import Status, status_code
from jaxltl.core.values.performance import (
    Performance,
    infeasible_starts,
    summarize,
    task_performances,
)
from jaxltl.core.values.soft import soft_value
from jaxltl.envs import temporal_gridworld
from jaxltl.envs.cell_kinds import COLORS
from jaxltl.envs.gridworld import ACTIONS
from jaxltl.io.learned_reward import LearnedReward, save_reward

__all__ = [
    "STEPS", "Outcome", "Setup", "describe", "fingerprint", "learn", "pictures", "prepare",
    "read_task", "save", "summary", "task_pictures",
]

STEPS = 300  # at most, unless the task says otherwise
_LENGTH = 100  # of a synthetic demonstration, at most
_BATCH = 64  # worlds that are planned in at once
_EXPERT_DISCOUNT = 0.99  # at most, where the file does not give one
_PICTURES = 3  # worlds that are drawn, of each kind
_WALKS = 3  # trajectories drawn in a world


# --- the parts ------------------------------------------------------------------------------


class Worlds(NamedTuple):
    """Worlds beside the learner's memory, and beside what judges the learner.

    Attributes:
      scenes: W worlds.
      model: their products with the learner's memory, stacked.
      judged: their products with memory and task side by side, stacked.
      observation: ``float[W, S, O]``.
    """

    scenes: list[Scene]
    model: Product
    judged: Product
    observation: jax.Array

    @property
    def names(self) -> list[str]:
        """Of the worlds."""
        return [scene.name for scene in self.scenes]

    def part(self, chosen: slice) -> Worlds:
        """Some of the worlds."""
        arrays = _part((self.model, self.judged, self.observation), chosen)
        return Worlds(self.scenes[chosen], *arrays)


def _part(tree: Any, chosen: Any) -> Any:
    """A part of arrays along their first axis; as NumPy's, which has nothing to compile for it."""
    return jax.tree.map(lambda x: np.asarray(x)[chosen], tree)


@dataclass(frozen=True)
class Setup:
    """A task file's contents as the library's objects; see :func:`prepare`.

    Attributes:
      task: the file.
      judge, memory: the automata of the task and of the learner's memory.
      worlds: those to learn in, and then those to test in.
      num_training: how many there are to learn in.
      expert: ``float[W, S, Q, A]``, the policy of an expert in the judged products.
      demonstrations: in each of the training worlds.
    """

    task: Task
    judge: Automaton
    memory: Automaton
    worlds: Worlds
    num_training: int
    expert: jax.Array
    demonstrations: list[Trajectories]

    @property
    def training(self) -> Worlds:
        """The worlds to learn in."""
        return self.worlds.part(slice(self.num_training))

    @property
    def test(self) -> Worlds | None:
        """The worlds to test in."""
        if len(self.worlds.scenes) == self.num_training:
            return None
        return self.worlds.part(slice(self.num_training, None))


@dataclass(frozen=True)
class Learned:
    """What was learned, with N seeds side by side.

    Attributes:
      parameters: of the network, leading axis N.
      held_out: ``float[N]``, negative log-likelihood of the average held-out pair.
      best_step: ``int[N]``, after which the parameters were reached.
      stopped: ``bool[N]``, whether learning ended by patience.
      num_steps: ``int``, made until all had ended.
      history: metrics ``[T, N]`` and ``step [T]``.
    """

    parameters: Any
    held_out: np.ndarray
    best_step: np.ndarray
    stopped: np.ndarray
    num_steps: int
    history: Mapping[str, np.ndarray]


class Judged(NamedTuple):
    """Policies in some worlds, and how well they do.

    Attributes:
      policy: ``float[W, S, Q, A]`` with the learner's memory, of the kept seed.
      status: ``int32[W]``, of the solver that found it.
      performance: by the name of who acts: learned, expert, random; leading axis W.
      seeds: ``float[N, W]``, L_phi of each seed's policy.
    """

    policy: np.ndarray
    status: np.ndarray
    performance: dict[str, Performance]
    seeds: np.ndarray

    def part(self, chosen: slice) -> Judged:
        """In some of the worlds."""
        each = _part(self.performance, chosen)
        return Judged(self.policy[chosen], self.status[chosen], each, self.seeds[:, chosen])


@dataclass(frozen=True)
class Outcome:
    """A finished job: what was asked, learned and found out about it.

    Attributes:
      setup, learned: the parts.
      chosen: the seed's position that is kept: the best held-out likelihood, or the least loss.
      training, test: how the policies of the learned reward do; test is None without worlds.
      seed: the first of the seeds.
      seconds: spent.
    """

    setup: Setup
    learned: Learned
    chosen: int
    training: Judged
    test: Judged | None
    seed: int
    seconds: float


def prepare(task: Task, seed: int) -> Setup:
    """The worlds, products and demonstrations of a task; all of its files checked.

    Raises:
      ValueError: something in the task or its files is wrong.
    """
    judge, memory = load_automata(task)
    scenes, others = load_scenes(task, judge)
    found = load_demonstrations(task, scenes) if "files" in task.demonstrations else []
    worlds = _stack(task, [*scenes, *others], judge, memory)
    shown = task.demonstrations
    discount = shown.get("discount", min(task.learner["discount"], _EXPERT_DISCOUNT))
    models = stack_products(
        [scene.mdp for scene in worlds.scenes], judge, label_on=task.label_on
    )
    expert = np.asarray(_expert(models, discount, expert_rewards(task)))
    if not found:
        key = jax.random.fold_in(jax.random.key(seed), 0)
        found = [
            temporal_gridworld.demonstrations(
                # Without padding, and whatever the learner remembers: tasks that differ only in
                # that, or in their test worlds, have the same demonstrations.
                jax.random.fold_in(key, w), product(scene.mdp, judge, label_on=task.label_on),
                expert[w, : scene.mdp.num_states], shown["synthetic"],
                shown.get("length", _LENGTH),
            )
            for w, scene in enumerate(scenes)
        ]
    if memory is not judge:
        expert = np.tile(expert, (1, 1, len(memory.delta), 1))  # the task's state varies fastest
    return Setup(task, judge, memory, worlds, len(scenes), jnp.asarray(expert), found)


def _stack(task: Task, scenes: list[Scene], judge: Automaton, memory: Automaton) -> Worlds:
    """All worlds at once, so that what works in them is compiled once."""
    mdps = [scene.mdp for scene in scenes]
    both = judge if memory is judge else synchronize(memory, judge)
    try:
        model = stack_products(mdps, memory, label_on=task.label_on)
        judged = stack_products(mdps, both, label_on=task.label_on)
    except ValueError as error:
        raise ValueError(f"{task.path}: {error}") from None
    return Worlds(scenes, model, judged, _observations(scenes, model))


def _observations(scenes: list[Scene], model: Product) -> jax.Array:
    size = model.mdp.num_states
    return jnp.asarray(np.stack([
        np.pad(np.asarray(s.observation), ((0, size - len(s.observation)), (0, 0))) for s in scenes
    ]))


def describe(setup: Setup) -> str:
    """What a task comes to, in one line."""
    pairs = sum(int(np.sum(shown.length)) for shown in setup.demonstrations)
    number = sum(len(shown.length) for shown in setup.demonstrations)
    tests = len(setup.worlds.scenes) - setup.num_training
    return (
        f"{setup.num_training} training and {tests} test worlds, "
        f"{setup.worlds.model.num_memory} memory states, {number} demonstrations of {pairs} pairs"
    )


# --- learning -------------------------------------------------------------------------------


def learn(
    setup: Setup,
    seed: int,
    num_seeds: int,
    *,
    report: Report | None = None,
    checkpoint: Path | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> tuple[Learned, int, Judged, Judged | None]:
    """Learns with N seeds, keeps one without looking at test worlds, and judges it.

    What it is at is told to `report`, steps and figures, and to `progress`, the stage's name.

    Raises:
      ValueError: the learner cannot work on this task.
    """
    spec = setup.task.learner
    network = todirl.RewardNetwork(tuple(spec.get("hidden", (80, 80))))
    scenes = setup.worlds.scenes[: setup.num_training]
    # Stacked anew, without the padding that larger test worlds ask for.
    model = stack_products(
        [scene.mdp for scene in scenes], setup.memory, label_on=setup.task.label_on
    )
    problem = todirl.make_problem(
        model, _observations(scenes, model), setup.demonstrations,
        held_out=spec.get("held_out", 0.2), network=network, horizon=spec.get("horizon"),
    )
    hparams = _hparams(spec)
    root = jax.random.fold_in(jax.random.key(seed), 1)
    keys = jax.vmap(partial(jax.random.fold_in, root))(jnp.arange(num_seeds))
    states = jax.jit(jax.vmap(todirl.init, (0, None, None)))(keys, problem, hparams)
    found = learner.run_in_chunks(
        todirl.step, states, problem, hparams, num_steps=spec.get("steps", STEPS), lanes=True,
        until=learner.has_stopped, report=by_name(report), checkpoint=checkpoint,
    )
    states, history = found.state, history_of(found)
    best = states.best
    learned = Learned(
        parameters=best.parameters, held_out=np.asarray(best.neg_log_likelihood),
        best_step=np.asarray(best.step), stopped=np.asarray(states.stopped),
        num_steps=int(np.max(states.step)), history=history,
    )
    score = np.where(np.isfinite(learned.held_out), learned.held_out, np.inf)
    loss = np.where(np.isfinite(history["loss"][-1]), history["loss"][-1], np.inf)
    chosen = int(np.argmin(score if np.isfinite(score).any() else loss))
    progress("checking")
    judged, count = _judge(setup, learned, network, hparams, chosen), setup.num_training
    test = judged.part(slice(count, None)) if count < len(judged.status) else None
    return learned, chosen, judged.part(slice(count)), test


def _hparams(spec: Mapping[str, Any]) -> todirl.Hparams:
    options = ("discount", "l2", "learning_rate", "patience", "optimizer", "horizon")
    return todirl.Hparams(**{k: spec[k] for k in options if k in spec})


def _judge(
    setup: Setup, learned: Learned, network: todirl.RewardNetwork, hparams: todirl.Hparams,
    chosen: int,
) -> Judged:
    worlds = setup.worlds
    performances, policies, codes = [], [], []
    for i in range(len(learned.held_out)):
        parameters = _part(learned.parameters, i)
        policy, status = _plan(network, parameters, worlds.model, worlds.observation, hparams)
        lifted = policy if setup.memory is setup.judge else lift_memory(policy, setup.judge)
        performances.append(_probability(worlds.judged, lifted, hparams.horizon))
        policies.append(policy if i == chosen else None)
        codes.append(status)
    judged, expert = worlds.judged, setup.expert
    available = judged.mdp.available[:, :, None]
    blind = available / jnp.sum(available, axis=-1, keepdims=True)
    blind = jnp.broadcast_to(blind, (*expert.shape[:-1], blind.shape[-1]))
    horizon = hparams.horizon
    return Judged(
        policy=np.asarray(policies[chosen]), status=np.asarray(codes[chosen]),
        performance={
            "learned": performances[chosen],
            "expert": _probability(judged, expert, horizon),
            "random": _probability(judged, blind.astype(expert.dtype), horizon),
        },
        seeds=np.stack([np.asarray(found.mean) for found in performances]),
    )


@partial(jax.jit, static_argnames=("network",))
def _plan(
    network: todirl.RewardNetwork, parameters: Any, model: Product, observation: jax.Array,
    hparams: todirl.Hparams,
) -> tuple[jax.Array, jax.Array]:
    """Policies ``float[W, S, Q, A]``, with a horizon ``[W, T, S, Q, A]``, and statuses."""

    def one(given: tuple[Product, jax.Array]) -> tuple[jax.Array, jax.Array]:
        solution = todirl.plan(network, parameters, *given, hparams)
        return solution.policy, solution.status

    return lax.map(one, (model, observation), batch_size=_BATCH)


@jax.jit
def _expert(judged: Product, discount: float, rewards: Mapping[str, float]) -> jax.Array:
    def one(model: Product) -> jax.Array:
        reward = temporal_gridworld.expert_reward(model, **rewards)
        return soft_value(model, reward, discount, method="value_iteration").policy

    return lax.map(one, judged, batch_size=_BATCH)


def _probability(judged: Product, policy: jax.Array, horizon: int | None) -> Performance:
    if horizon is None:
        return task_performances(judged, policy)
    if policy.ndim == 4:
        shape = (policy.shape[0], horizon, *policy.shape[1:])
        policy = jnp.broadcast_to(policy[:, None], shape)
    return _within_each(judged, policy)


@jax.jit
def _within_each(judged: Product, policy: jax.Array) -> Performance:
    return lax.map(lambda given: _within(*given), (judged, policy), batch_size=_BATCH)


def _within(model: Product, policy: jax.Array) -> Performance:
    """The probability of doing the task within the steps of a policy ``[T, S, Q, A]``."""
    done = model.final.astype(model.dtype)

    def backup(value: jax.Array, policy: jax.Array) -> tuple[jax.Array, None]:
        return jnp.maximum(done, action_mean(policy, expectation(model, value))), None

    value, _ = lax.scan(backup, done, policy, reverse=True)
    value = jnp.take_along_axis(value, model.initial_memory[:, None], axis=1)[:, 0]
    starts = model.mdp.initial > 0
    # Sums of products of numbers of at most one, which round in each of T steps.
    terms = model.num_successors + model.num_actions + 4
    half = len(policy) * terms * jnp.finfo(model.dtype).eps
    worst = jnp.argmin(jnp.where(starts, value, jnp.inf)).astype(jnp.int32)
    mean = jnp.sum(model.mdp.initial * value)
    finite = jnp.all(jnp.isfinite(value))
    slack = half + 4 * jnp.finfo(model.dtype).eps * jnp.sqrt(1.0 * value.size)
    return Performance(
        mean=mean, lower=jnp.maximum(mean - slack, 0), upper=jnp.minimum(mean + slack, 1),
        worst=value[worst], worst_lower=jnp.maximum(value[worst] - half, 0),
        worst_upper=jnp.minimum(value[worst] + half, 1), worst_state=worst, value=value,
        status=status_code(finite, finite),
    )


# --- results --------------------------------------------------------------------------------


def summary(outcome: Outcome) -> dict[str, Any]:
    """The outcome as numbers, lists and texts, for ``result.json``; NaN becomes None."""
    setup, learned, i = outcome.setup, outcome.learned, outcome.chosen
    task, history, count = setup.task, learned.history, setup.num_training
    infeasible = np.asarray(jax.vmap(infeasible_starts)(setup.worlds.judged)).sum(axis=1)
    result = {
        "task": task.name,
        "formula": task.formula,
        "method": "todirl",
        "memory": task.memory,
        "label_on": task.label_on,
        "radius": task.radius,
        "horizon": task.learner.get("horizon"),
        "num_memory": setup.worlds.model.num_memory,
        "demonstrations": {
            "number": [len(shown.length) for shown in setup.demonstrations],
            "pairs": [int(np.sum(shown.length)) for shown in setup.demonstrations],
            "synthetic": "synthetic" in task.demonstrations,
        },
        "training": _about_worlds(setup.training, outcome.training, infeasible[:count], ()),
        "test": outcome.test and setup.test and _about_worlds(
            setup.test, outcome.test, infeasible[count:], task.test.get("leave_out", ())),
        "learning": {
            "loss": history["loss"][-1][i],
            "neg_log_likelihood": history["neg_log_likelihood"][-1][i],
            "held_out": learned.held_out[i],
            "best_step": learned.best_step[i],
            "stopped_early": bool(learned.stopped[i]),
            "steps": learned.num_steps,
            "gradient_norm": history["gradient_norm"][-1][i],
            "solver": Status(int(history["status"][:, i].max())).name,
            "solver_error": history["error"][:, i].max(),
            "hyperparameters": {k: v for k, v in task.learner.items() if k != "method"},
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
            "test_mean": outcome.test and outcome.test.seeds[:, _counted(setup)].mean(axis=1),
        },
        "network": {
            "file": "network.npz",
            "load": 'jaxltl.io.learned_reward.load_reward("network.npz")',
            "hidden": list(task.learner.get("hidden", (80, 80))),
        },
        "seconds": round(outcome.seconds, 2),
        "versions": {"jaxltl": jaxltl.__version__, "jax": jax.__version__},
    }
    return plain(result)


def _counted(setup: Setup) -> np.ndarray:
    """Which test worlds count."""
    names = setup.worlds.names[setup.num_training :]
    return np.array([name not in setup.task.test.get("leave_out", ()) for name in names])


def _about_worlds(
    worlds: Worlds, judged: Judged, infeasible: np.ndarray, leave_out: Sequence[str]
) -> dict[str, Any]:
    found: dict[str, Any] = {"num_worlds": len(worlds.scenes)}
    for who, performance in judged.performance.items():
        about = summarize(worlds.judged, performance, names=worlds.names, leave_out=leave_out)
        found[who] = {
            "mean": {"value": about.mean, "lower": about.lower, "upper": about.upper},
            "std": about.std,
            "worst_world": {"name": about.worst_world, "value": about.worst},
            "worst_start": about.worst_start,
            "uncertain": list(about.uncertain),
        }
        found["infeasible"], found["left_out"] = list(about.infeasible), list(about.left_out)
        found["num_counted"] = about.num_worlds
    found["solver"] = Status(int(judged.status.max())).name
    found["worlds"] = [
        _about_world(scene, judged, w, int(infeasible[w]))
        for w, scene in enumerate(worlds.scenes)
    ]
    return found


def _about_world(scene: Scene, judged: Judged, w: int, infeasible: int) -> dict[str, Any]:
    one = _part(judged.performance["learned"], w)
    return {
        "name": scene.name,
        "mean": {"value": one.mean, "lower": one.lower, "upper": one.upper},
        "minimum": {
            "value": one.worst, "lower": one.worst_lower, "upper": one.worst_upper,
            **scene.place(one.worst_state),
        },
        "status": Status(int(one.status)).name,
        "expert": judged.performance["expert"].mean[w],
        "random": judged.performance["random"].mean[w],
        "num_starts": int(np.sum(np.asarray(scene.mdp.initial) > 0)),
        "infeasible_starts": infeasible,
    }


# --- files ----------------------------------------------------------------------------------


def save(out: Path, outcome: Outcome) -> None:
    """Writes ``network.npz`` and, for each training world, ``policy_1.npz`` and so on.

    The network is read by :func:`jaxltl.io.learned_reward.load_reward`. The arrays of a policy:
    ``policy [S, Q, A]`` (with a horizon ``[T, S, Q, A]``); ``initial_memory [S]`` and
    ``next_memory [S, Q]``, the memory at the start in s and after reading the label of s;
    ``label_on``; ``actions [A]``; and ``satisfaction [S]``, the probability of the task from there.

    Raises:
      ValueError: a place cannot be written to.
    """
    for pattern in ("policy_*.npz", "training_*.svg", "test_*.svg"):
        for stale in out.glob(pattern):
            stale.unlink()
    save_reward(out / "network.npz", learned_reward(outcome))
    worlds = outcome.setup.training
    for w, scene in enumerate(worlds.scenes):
        model, size = _part(worlds.model, w), scene.mdp.num_states
        policy = outcome.training.policy[w]
        kept = project_policy(model, policy if policy.ndim == 3 else policy[0])
        arrays = {
            "policy": policy[..., :size, :, :],
            "initial_memory": kept.initial_memory[:size],
            "next_memory": kept.next_memory[:size],
            "label_on": kept.label_on,
            "actions": np.array(ACTIONS),
            "satisfaction": outcome.training.performance["learned"].value[w, :size],
        }
        with atomic_write(out / f"policy_{w + 1}.npz") as file:
            np.savez(file, allow_pickle=False, **{k: np.asarray(v) for k, v in arrays.items()})


def learned_reward(outcome: Outcome) -> LearnedReward:
    """The kept seed's reward, with all that planning with it needs."""
    task, i = outcome.setup.task, outcome.chosen
    spec = task.learner
    kinds = (COLORS if task.is_colored
             else (*cell_kinds(task.world), "off the map"))
    return LearnedReward(
        parameters=_part(outcome.learned.parameters, i),
        hidden=tuple(spec.get("hidden", (80, 80))), memory=outcome.setup.memory,
        label_on=task.label_on, discount=spec["discount"], horizon=spec.get("horizon"),
        radius=task.radius, formula=task.formula, kinds=tuple(kinds),
    )


# --- pictures -------------------------------------------------------------------------------


def task_pictures(setup: Setup) -> list[Picture]:
    """The report's pictures that nothing has to be learned for."""
    found = [Picture(
        "automaton.svg", "The task as an automaton", drawing("automaton", setup.judge),
        "States with a double circle: the task is done, whatever follows. Grey: it has failed. "
        "Each state is named by the formula that is left to satisfy.",
    )]
    if setup.memory is not setup.judge:
        found.append(Picture(
            "memory.svg", "What the learner remembers", drawing("automaton", setup.memory),
            "The automaton whose state is the learner's memory; the task above judges it.",
        ))
    return found


def pictures(outcome: Outcome) -> list[Picture]:
    """The report's pictures of what was learned."""
    setup, history = outcome.setup, outcome.learned.history
    found = [Picture(
        "learning.svg", "Learning",
        drawing("curves", {k: history[k].T for k in ("per_pair", "held_out", "gradient_norm")},
                steps=history["step"]),
        "Negative log-likelihood of the average demonstrated pair, of the average held-out pair "
        "where there are any, and the gradient's length, before each step"
        + ("" if np.isnan(outcome.learned.held_out).any()
           else ". What is kept has the least held-out figure")
        + ("; the line is the median over seeds, the band holds all of them."
           if len(outcome.learned.held_out) > 1 else "."),
    )]
    for w, scene in list(enumerate(setup.training.scenes))[:_PICTURES]:
        found += _draw(outcome, setup.training, outcome.training, w, f"training_{w + 1}",
                       f"Training world: {scene.name}", True)
    if setup.test is not None and outcome.test is not None:
        for n, (rank, w) in enumerate(_chosen_worlds(setup, outcome.test)):
            title = f"Test world, {rank}: {setup.test.scenes[w].name}"
            found += _draw(outcome, setup.test, outcome.test, w, f"test_{n + 1}", title, n == 0)
    return found


def _chosen_worlds(setup: Setup, judged: Judged) -> list[tuple[str, int]]:
    """The test worlds where the learned policy does worst, middling and best."""
    counted = np.flatnonzero(_counted(setup))
    mean = np.asarray(judged.performance["learned"].mean)
    order = counted[np.argsort(mean[counted], kind="stable")]
    ranks = {"worst": order[0], "median": order[len(order) // 2], "best": order[-1]}
    found: dict[int, str] = {}
    for rank, w in ranks.items():
        found.setdefault(int(w), rank)
    return [(rank, w) for w, rank in found.items()]


def _draw(
    outcome: Outcome, worlds: Worlds, judged: Judged, w: int, stem: str, title: str,
    arrows: bool,
) -> list[Picture]:
    """A world with runs of its policy and, if asked for, the policy itself."""
    setup, scene = outcome.setup, worlds.scenes[w]
    size = scene.mdp.num_states
    policy = judged.policy[w][..., :size, :, :]
    moving = policy if policy.ndim == 3 else policy[0]
    mean = float(judged.performance["learned"].mean[w])
    title = f"{title} ({mean:.4f})"
    shown = _memory_shown(setup)
    names = setup.memory.state_names or ("",) * len(setup.memory.delta)
    # About as many characters as a panel is wide.
    width = int(np.clip(5 * scene.shape[1], 9, 50))
    titles = [short_name(f"memory {q}: {names[q]}", width) for q in shown]
    when = "" if policy.ndim == 3 else " at the first step"
    caption = (
        f"One map for each state of the learner's memory; an arrow is as long as its action is "
        f"likely{when}. In the title, the mean probability of doing the task."
    )
    if scene.colored is None:
        assert scene.cells is not None
        panels = np.broadcast_to(
            np.asarray(judged.performance["learned"].value[w])[:size], (len(shown), size))
        drawn = drawing(
            "grid", scene.cells, panels, moving.transpose(1, 0, 2)[shown], titles=titles,
            label="probability from a start there",
            wall=setup.task.world.get("wall", "#"),
        )
        caption += " Colours: the probability of doing the task if a run starts there."
        return [Picture(f"{stem}.svg", title, drawn, caption)]
    found: list[Picture] = []
    if arrows:
        drawn = drawing("temporal_gridworld", _part(scene.colored, ...), moving, memory=shown,
                        title=titles)
        found.append(Picture(f"{stem}.svg", title, drawn, caption))
    if policy.ndim == 3:
        walks = _walks(outcome, worlds, w, judged.policy[w])
        found.append(Picture(
            f"{stem}_runs.svg", title if not arrows else f"Runs in {scene.name}",
            drawing("temporal_gridworld", _part(scene.colored, ...), trajectories=walks),
            f"{len(walks.length)} runs of the learned policy from random starts, each until the "
            "task is done or has failed.",
        ))
    return found


def _memory_shown(setup: Setup) -> list[int]:
    """Memory states in which there is something left to do."""
    open_ = np.flatnonzero(verdicts(setup.memory) == Verdict.UNDECIDED)
    return [int(q) for q in open_] or [0]


def _walks(outcome: Outcome, worlds: Worlds, w: int, policy: np.ndarray) -> Trajectories:
    setup = outcome.setup
    array = jnp.asarray(policy)
    lifted = array if setup.memory is setup.judge else lift_memory(array, setup.judge)
    key = jax.random.fold_in(jax.random.key(outcome.seed), 2)
    shown = setup.task.demonstrations
    # As many as there were demonstrations, for which the program is there already.
    walks = temporal_gridworld.demonstrations(
        key, _part(worlds.judged, w), lifted, shown.get("synthetic", _WALKS),
        shown.get("length", _LENGTH),
    )
    return _part(walks, slice(_WALKS))
