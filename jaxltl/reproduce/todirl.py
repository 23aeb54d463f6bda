"""Section 3.5: task-oriented deep inverse RL, and planning in unseen worlds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.algos import behavioral_cloning as cloning, todirl
from jaxltl.app.wording import Record
from jaxltl.core.automata import Automaton, synchronize, to_automaton
from jaxltl.core.models.construct.batch import lift_memory_policy, stack_products
from jaxltl.core.models.product import Product
from jaxltl.core.models.trajectories import Trajectories, make_trajectories
from jaxltl.core.values.undiscounted.performance import task_performances
from jaxltl.envs import temporal_gridworld as grid
from jaxltl.io.colored_world import read_world, write_world
from jaxltl.reproduce.experiment import experiment, render_table
from jaxltl.core.models.protocols import PyTree

METHODS = ("todirl", "incomplete", "patch5", "memoryless", "cloning")
_MEMORY = {"incomplete": grid.INCOMPLETE, "memoryless": "true"}  # of the others, the task's
_RADIUS = {"patch5": 2}  # of the others, 1
_DISCOUNT = 0.95


@dataclass(frozen=True)
class TodirlExperimentPlan:
    """Sizes of the experiment; the defaults are those of the command line."""

    methods: tuple[str, ...] = METHODS  # the learners
    demonstrations: tuple[int, ...] = (10, 30, 100, 300)  # numbers of demonstrations
    curves: int = 100  # the number of demonstrations of the learning curves (figure 6)
    steps: int = 300  # steps, cloning_steps: of learning, at most; early stopping may end it
    cloning_steps: int = 1500
    points: int = 10  # of a learning curve
    test_worlds: int = 20  # number of unseen worlds


@experiment
def measure(
    progress: Callable[[str], None],
    *,
    seeds: int | None = None,
    plan: TodirlExperimentPlan | None = None,
) -> Record:
    """Figures 6 and 7; the test worlds are the same for all `seeds` (default 10) of learning."""
    plan, num_seeds = plan or TodirlExperimentPlan(), seeds or 10
    setting = _setting(num_seeds, plan)
    rows, drawn = [], []
    for method in plan.methods:
        for number in plan.demonstrations:
            progress(f"{method}, {number} demonstrations")
            row, curve = _learned(setting, method, number, plan)
            rows.append(row)
            drawn += [curve] if curve else []
    progress("the expert, and a random policy")
    return {
        "by_demonstrations": rows,
        "reference": _references(setting),
        "seeds": num_seeds,
        "figure6": drawn,
    }


# --- worlds and demonstrations ------------------------------------------------------------------


class Setting(NamedTuple):
    """Training worlds, one for each of N seeds, and M test worlds."""

    train: list[grid.World]  # train, test: the worlds
    test: list[grid.World]
    task: Automaton  # the automaton of the whole task
    # demonstrations in each training world, the largest number of the plan
    demonstrations: list[Trajectories]


def _setting(num_seeds: int, plan: TodirlExperimentPlan) -> Setting:
    train = [grid.training_world(seed, margin=2) for seed in range(num_seeds)]
    test = grid.random_worlds(range(1000, 1000 + plan.test_worlds), margin=2)
    task = _automaton(grid.COMPLETE, train)
    models = _stacked(train, task)
    policies = jax.vmap(lambda m: grid.expert_policy(m, _DISCOUNT))(models)
    keys = jax.vmap(jax.random.key)(jnp.arange(num_seeds))
    draw = partial(grid.demonstrations, num_trajectories=max(plan.demonstrations), horizon=100)
    demonstrations = jax.vmap(draw)(keys, models, policies)
    return Setting(train, test, task, [_lane(demonstrations, i) for i in range(num_seeds)])


def _automaton(formula: str, worlds: list[grid.World]) -> Automaton:
    """The automaton of a formula over the letters of the worlds: at most one proposition a cell."""
    names = worlds[0].mdp.propositions
    return to_automaton(formula, letters=[frozenset(), *(frozenset([p]) for p in names)])


def _stacked(worlds: list[grid.World], memory: Automaton) -> Product:
    """Products in single precision along a leading axis."""
    return jax.tree.map(
        lambda x: x.astype(jnp.float32) if jnp.issubdtype(x.dtype, jnp.floating) else x,
        stack_products([w.mdp for w in worlds], memory, label_on="exit"),
    )


def _lane(tree: PyTree, number: int) -> PyTree:
    return jax.tree.map(lambda x: x[number], tree)


def _observed(worlds: list[grid.World], radius: int) -> jax.Array:
    return jnp.stack([grid.observations(w, radius) for w in worlds]).astype(jnp.float32)


# --- learning -----------------------------------------------------------------------------------

_HPARAMS = todirl.Hparams(discount=_DISCOUNT, l2=1e-3, learning_rate=3e-3, patience=50)
_CLONING = cloning.Hparams(learning_rate=3e-3, patience=500)


@partial(jax.jit, static_argnums=0)
def _begin(learner: Any, keys: jax.Array, problems: PyTree, hparams: PyTree) -> PyTree:
    return jax.vmap(lambda k, p: learner.init(k, p, hparams))(keys, problems)


@partial(jax.jit, static_argnums=(0, 4))
def _run(learner: Any, states: PyTree, problems: PyTree, hparams: PyTree, num_steps: int) -> PyTree:
    return jax.vmap(lambda s, p: learner.run(s, p, hparams, num_steps=num_steps, max_rows=1)[0])(
        states, problems
    )


def _learned(
    setting: Setting, method: str, number: int, plan: TodirlExperimentPlan
) -> tuple[Record, Record | None]:
    """A row, and its learning curve for one number of demonstrations."""
    memory = setting.task
    if method in _MEMORY:
        memory = _automaton(_MEMORY[method], setting.train)
    radius = _RADIUS.get(method, 1)
    learner, hparams = (cloning, _CLONING) if method == "cloning" else (todirl, _HPARAMS)
    models, seen = _stacked(setting.train, memory), _observed(setting.train, radius)
    demonstrations = [jax.tree.map(lambda x: x[:number], t) for t in setting.demonstrations]
    # Each seed learns in its own world only.
    problems = jax.tree.map(
        lambda x: x[:, None], learner.make_problem(models, seen, demonstrations)
    )
    keys = jax.vmap(jax.random.key)(1000 + jnp.arange(len(setting.train)))
    states = _begin(learner, keys, problems, hparams)
    evaluate = partial(_evaluated, setting, memory, method, radius)
    chunk = max((plan.cloning_steps if method == "cloning" else plan.steps) // plan.points, 1)
    curve: list[Any] = []
    for _ in range(plan.points):
        if not curve or not np.all(states.stopped):
            states = _run(learner, states, problems, hparams, chunk)
            latest = evaluate(states.parameters) if number == plan.curves else None
        curve.append(latest)
    name = {"demonstrations": number, "method": method}
    row = {**name, **_row(evaluate(states.best.parameters), states)}
    if number != plan.curves:
        return row, None
    steps = chunk * (1 + np.arange(plan.points))
    worlds = _trajectories(setting, states) if method == "todirl" else []
    return row, {**name, "steps": steps, **_curve(curve), "worlds": worlds}


Performance = tuple[np.ndarray, np.ndarray]


def _evaluated(
    setting: Setting, memory: Automaton, method: str, radius: int, parameters: PyTree
) -> Performance:
    """L_phi and half the width of its bounds, of each seed's parameters.

    In the seed's training world, ``float[2, N]``, and in all M test worlds, ``float[2, N, M]``.
    """
    seeds = len(setting.train)
    own = _policies(
        method, parameters, _stacked(setting.train, memory), _observed(setting.train, radius)
    )
    new_models, new_seen = _stacked(setting.test, memory), _observed(setting.test, radius)
    new = _everywhere(method, parameters, new_models, new_seen)
    flat = new.reshape(-1, *new.shape[2:])
    return (
        _performance(setting, memory, setting.train, own),
        _performance(setting, memory, setting.test * seeds, flat).reshape(2, seeds, -1),
    )


@partial(jax.jit, static_argnums=0)
def _policies(method: str, parameters: PyTree, models: Product, seen: jax.Array) -> jax.Array:
    """Policies of each seed in its world: ``float[N, S, Q, A]``."""
    if method == "cloning":
        network = cloning.ConvolutionalPolicy(num_actions=models.num_actions)
        return jax.vmap(partial(cloning.policy_in_world, network))(parameters, models, seen)
    return jax.vmap(lambda p, m, o: todirl.plan(todirl.RewardNetwork(), p, m, o, _HPARAMS).policy)(
        parameters, models, seen
    )


@partial(jax.jit, static_argnums=0)
def _everywhere(method: str, parameters: PyTree, models: Product, seen: jax.Array) -> jax.Array:
    """Policies of each seed in all worlds: ``float[N, M, S, Q, A]``."""

    def one(parameters: PyTree) -> jax.Array:
        copies = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(seen), *x.shape)), parameters)
        return _policies(method, copies, models, seen)

    return jax.lax.map(one, parameters)


def _performance(
    setting: Setting, memory: Automaton, worlds: list[grid.World], policies: jax.Array
) -> np.ndarray:
    """L_phi of the complete task and half the width of its bounds, for policies with any memory."""
    models = _stacked(worlds, setting.task)
    if memory is not setting.task:
        models = _stacked(worlds, synchronize(memory, setting.task))
        policies = lift_memory_policy(policies, setting.task)
    performance = task_performances(models, policies)
    return np.stack(
        [
            np.asarray(x, float)
            for x in (performance.mean, (performance.upper - performance.lower) / 2)
        ]
    )


def _row(performance: Performance, states: PyTree) -> Record:
    (train, train_width), (test, test_width) = performance
    return {
        "train_mean": train.mean(),
        "train_std": _deviation(train),
        "test_mean": test.mean(1).mean(),
        "test_std": _deviation(test.mean(1)),
        "test_worst": test.min(),
        "test_of_each_seed": np.round(test.mean(1), 5),
        "test_worst_of_each_seed": np.round(test.min(1), 5),
        "seeds": len(train),
        "steps": np.mean(states.best.step),
        "half_width": max(train_width.max(), test_width.max()),
    }


def _deviation(x: np.ndarray) -> float:
    return float(x.std(ddof=1)) if len(x) > 1 else 0.0


def _curve(points: list[Performance]) -> Record:
    curve: Record = {}
    for k, part in enumerate(("train", "test")):
        each = [point[k][0].reshape(len(point[k][0]), -1).mean(1) for point in points]
        curve[f"{part}_mean"] = [x.mean() for x in each]
        curve[f"{part}_std"] = [_deviation(x) for x in each]
    return curve


def _trajectories(setting: Setting, states: PyTree) -> list[Record]:
    """Trajectories of the first seed's policy in its training world and in two test worlds."""
    parameters, drawn = jax.tree.map(lambda x: x[:1], states.best.parameters), []
    worlds = {
        "training world": setting.train[0],
        "test world": setting.test[0],
        "another test world": setting.test[1],
    }
    for title, world in worlds.items():
        models = _stacked([world], setting.task)
        ((policy,),) = _everywhere("todirl", parameters, models, _observed([world], 1))
        runs = grid.demonstrations(jax.random.key(0), _lane(models, 0), policy, 6, horizon=60)
        pairs = np.stack([runs.state, runs.action], -1).tolist()
        cut = [row[:n] for row, n in zip(pairs, np.asarray(runs.length), strict=True)]
        drawn.append({"title": title, "world": write_world(world), "runs": cut})
    return drawn


def _references(setting: Setting) -> list[Record]:
    """L_phi of the expert and of the uniform policy."""
    rows = []
    for name in ("expert", "random"):
        train, test = (
            _reference(setting, worlds, name) for worlds in (setting.train, setting.test)
        )
        means = {"train_mean": train.mean(), "test_mean": test.mean(), "test_worst": test.min()}
        rows.append({"policy": name, **means})
    return rows


def _reference(setting: Setting, worlds: list[grid.World], name: str) -> np.ndarray:
    models = _stacked(worlds, setting.task)
    policies = jax.vmap(lambda m: grid.expert_policy(m, _DISCOUNT))(models)
    if name == "random":
        policies = jnp.full_like(policies, 1 / models.num_actions)
    return np.asarray(task_performances(models, policies).mean, float)


# --- table and pictures -------------------------------------------------------------------------


def table(result: Record) -> str:
    """The report of section 3.5."""
    return render_table("todirl.txt", orders=_orders(result["by_demonstrations"]), **result)


def _orders(rows: list[Record]) -> list[str]:
    """Differences of the methods that know the task, paired by seed."""
    lines = []
    by = {(x["demonstrations"], x["method"]): x for x in rows}
    for (number, method), x in by.items():
        full = by.get((number, "todirl"))
        if method not in ("incomplete", "patch5") or full is None:
            continue
        ahead = np.asarray(full["test_of_each_seed"]) - np.asarray(x["test_of_each_seed"])
        mean, error = ahead.mean(), _deviation(ahead) / np.sqrt(len(ahead))
        verdict = "ahead" if mean > 2 * error else "behind" if mean < -2 * error else "level"
        lines.append(
            f"{number:>4} demonstrations: todirl less {method:10} {mean:+.4f} +- {2 * error:.4f}, "
            f"{verdict}"
        )
    return lines


def pictures(result: Record) -> Record:
    """Figures 6 and 7, and trajectories of learned policies."""
    from jaxltl import plot

    columns = {"train": "training world", "test": "test worlds"}
    rows = result["by_demonstrations"]
    by_method = {x["method"]: [y for y in rows if y["method"] == x["method"]] for x in rows}
    by_number = {
        title: {
            method: (
                np.log10([x["demonstrations"] for x in mine]),
                [x[f"{part}_mean"] for x in mine],
                [x[f"{part}_std"] for x in mine],
            )
            for method, mine in by_method.items()
        }
        for part, title in columns.items()
    }
    drawn = {
        "figure_7_demonstrations": plot.bands(
            {"satisfaction probability": by_number}, label="demonstrations, decimal logarithm"
        )
    }
    if result["figure6"]:
        learning = {
            title: {
                x["method"]: (
                    np.asarray(x["steps"], float) / x["steps"][-1],
                    np.asarray(x[f"{part}_mean"], float),
                    np.asarray(x[f"{part}_std"], float),
                )
                for x in result["figure6"]
            }
            for part, title in columns.items()
        }
        drawn["figure_6_learning"] = plot.bands(
            {"satisfaction probability": learning}, label="share of all steps"
        )
    for place in (place for x in result["figure6"] for place in x["worlds"]):
        world = read_world(place["world"])
        drawn[place["title"].replace(" ", "_")] = plot.temporal_gridworld(
            world,
            trajectories=make_trajectories(world.mdp, place["runs"]),
            title=f"{place['title']}: trajectories of the learned policy",
        )
    return drawn
