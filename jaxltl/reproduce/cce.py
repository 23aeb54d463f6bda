"""Experiment of Wen (2019), section 4.5: constrained cross-entropy on LQR and robot navigation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike
import optax

from jaxltl.algos import cce, trust_region as tr
from jaxltl.algos.cce import exponential_family as families
from jaxltl.app.wording import Record
from jaxltl.core.environments import Agent, Environment, Episode, run_episode
from jaxltl.envs import lqr, navigation as nav
from jaxltl.envs.navigation_steps import as_environment
from jaxltl.envs.networks import apply, make_network, network_agent
from jaxltl.reproduce.experiment import experiment, render_table
from jaxltl.core.models.protocols import PyTree

NETWORKS = ("2-2-1", "2-10-1", "2-10-10-1", "2-50-1")
METHODS = ("CCE", "TRPO", "CPO", "penalised TRPO")
FEASIBLE_STARTS = ((1, ("CCE", "TRPO", "CPO")), (4, ("CCE", "CPO", "penalised TRPO")))
PENALTY = 100.0
LQR_SEEDS, SEEDS = 50, 5


@dataclass(frozen=True)
class CceExperimentPlan:
    """Sizes of the experiment; the defaults are those of the command line."""

    networks: tuple[str, ...] = NETWORKS  # of the regulator
    tasks: tuple[int, ...] = nav.TASKS  # tasks, methods: of the robot
    methods: tuple[str, ...] = METHODS
    # for some tasks, the methods that also start from feasible policies
    feasible_starts: tuple[tuple[int, tuple[str, ...]], ...] = FEASIBLE_STARTS
    lqr_steps: int = 400  # search steps for the regulator
    steps: int = 60  # search steps for the robot, 1,000 trajectories each
    trust_steps: int = 120  # of TRPO and CPO, 200 trajectories each
    # search steps, and TRPO and CPO steps, from feasible policies
    feasible_steps: tuple[int, int] = (20, 50)
    fresh: int = 1000  # trajectories that evaluate a returned policy


@experiment
def measure(
    progress: Callable[[str], None],
    *,
    seeds: int | None = None,
    plan: CceExperimentPlan | None = None,
) -> Record:
    """Figures 8, 10 and 11; `seeds` default to 50 for the regulator and 5 for the robot."""
    plan = plan or CceExperimentPlan()
    optimum = lqr.optimum(lqr.lqr())
    regulators = []
    for network in plan.networks:
        progress(f"the regulator, network {network}")
        regulators.append(_regulator(network, seeds or LQR_SEEDS, plan, optimum))
    # All searches of the robot are dispatched before the first result is read: JAX runs several in
    # parallel while it compiles the next.
    usual, pretrained = [], []
    for task in plan.tasks:
        robot = _robot(task)
        for method in plan.methods:
            progress(f"the robot, task {task}: {method}")
            usual.append((robot, _search(robot, method, seeds or SEEDS, plan)))
    for task, methods in plan.feasible_starts:
        progress(f"the robot, task {task}, from feasible policies: {', '.join(methods)}")
        robot = _robot(task)
        # A distribution of feasible policies for each seed, by minimising the cost alone.
        hparams, keys = replace(robot.hparams, margin=1e3), _keys(seeds or SEEDS, 100 + task)
        family = _train(keys, robot.problem, hparams, plan.steps // 2)[0].family
        pretrained += [(robot, _search(robot, m, seeds or SEEDS, plan, family)) for m in methods]
    progress("the robot: trajectories of the returned policies")
    usual_runs, pretrained_runs = (
        [_evaluated(robot, run, plan) for robot, run in runs] for runs in (usual, pretrained)
    )
    return {
        "lqr_optimum": optimum.total,
        "lqr": [row for row, _ in regulators],
        "navigation": [row for row, _, _ in usual_runs],
        "navigation_feasible_start": [row for row, _, _ in pretrained_runs],
        "figure8": {
            "optimum": {"state": optimum.state, "control": optimum.control[:, 0]},
            "learned": [curves for _, curves in regulators],
        },
        "figure10": [curve for _, curve, _ in usual_runs],
        "figure11": [curve for _, curve, _ in pretrained_runs],
        "maps": [paths for _, _, paths in usual_runs],
    }


# --- the regulator ------------------------------------------------------------------------------


@partial(jax.jit, static_argnums=3)
def _train(
    keys: jax.Array,
    problem: cce.Problem,
    hparams: cce.Hparams,
    num_steps: int,
    families_: PyTree = None,
) -> PyTree:
    """The search from every key, by default from the initial distribution of the problem."""

    def one(key: jax.Array, family: PyTree) -> PyTree:
        start = problem if family is None else replace(problem, family=family)
        return cce.train(key, start, hparams, num_steps=num_steps)

    return jax.vmap(one)(keys, families_)


def _keys(seeds: int, part: int) -> jax.Array:
    return jax.vmap(lambda i: jax.random.fold_in(jax.random.key(i), part))(jnp.arange(seeds))


def _regulator(
    name: str, seeds: int, plan: CceExperimentPlan, optimum: lqr.Optimum
) -> tuple[Record, Record]:
    """A network's row, and its curves of figure 8."""
    world, network = lqr.lqr(), make_network(name)
    size = network.num_parameters
    problem = cce.make_problem(
        lqr.evaluator(world, network), families.diagonal_gaussian(jnp.zeros(size), 1.0), limit=0.0
    )
    state, _ = _train(
        _keys(seeds, 0), problem, cce.Hparams(rate=0.1, population=100, rho=0.2), plan.lqr_steps
    )
    # The regulator is deterministic: one evaluation is exact.
    sampled = jnp.where(state.best.valid[:, None], state.best.parameters, state.least.parameters)
    both = jnp.stack([families.center(state.family), sampled], 1)
    objective, cost = jax.vmap(jax.vmap(lambda p: problem.evaluate(p, None)))(both)
    allowed = cost <= 0
    rank = jnp.where(allowed.any(1)[:, None], jnp.where(allowed, objective, -jnp.inf), -cost)
    chosen = jnp.argmax(rank, 1)
    run = lqr.simulate(world, network, both[jnp.arange(seeds), chosen].T)
    feasible = np.asarray(allowed.any(1))
    gap = np.asarray(run.total) - optimum.total
    good = gap[feasible]
    row = {
        "network": name,
        "parameters": size,
        "seeds": seeds,
        "feasible": feasible.sum(),
        "gap_median": np.median(good) if good.size else None,
        "gap_max": good.max() if good.size else None,
        "mean_policy_feasible": (cost[:, 0] <= 0).sum(),
        "gap_within_tenth": (good < 0.1).sum(),
    }
    curves = {
        "network": name,
        "state": _rounded(jnp.moveaxis(run.state, -1, 0)),
        "control": _rounded(run.control[:, 0].T),
        "gap": np.sort(gap),
        "violation": np.sort(run.violation),
    }
    return row, curves


def _rounded(x: ArrayLike, digits: int = 4) -> np.ndarray:
    return np.round(np.asarray(x, float), digits)


# --- the robot ----------------------------------------------------------------------------------


class Robot(NamedTuple):
    """A task of the robot for both kinds of learners, in single precision."""

    task: int
    world: nav.Navigation
    problem: cce.Problem
    hparams: cce.Hparams
    environment: Environment
    stepwise: tr.Problem


class MethodSearch(NamedTuple):
    """The learning curves ``[seeds, T]`` and final states of a method, perhaps not yet computed."""

    method: str
    keys: jax.Array
    trajectories: jax.Array
    objective: jax.Array
    cost: jax.Array
    state: PyTree
    hparams: PyTree


_NUM_TRAJECTORIES = 10  # of each sampled policy
_TRUST = tr.Hparams(
    discount=0.999,
    delta=0.01,
    num_trajectories=200,
    hidden=(30, 30),
    value_hidden=(30, 30),
    # With little damping the steps follow the noise of the sample: CPO then expects one step to
    # meet the limit, and stays above it.
    damping=0.1,
    fisher_stride=4,
    num_value_epochs=3,
)


def _robot(task: int) -> Robot:
    world = nav.navigation()
    evaluate = nav.evaluator(
        world,
        jax.tree_util.Partial(_scores, jnp.int32(task)),
        num_trajectories=_NUM_TRAJECTORIES,
        absorbing=task == 1,
    )
    size = nav.policy_network(world).num_parameters
    family = families.diagonal_gaussian(jnp.zeros(size, jnp.float32), 0.6)
    problem = cce.make_problem(evaluate, family, limit=nav.LIMITS[task])
    hparams = cce.Hparams(
        rate=0.8, temperature=30.0, margin=0.5 if task == 3 else 0.1, population=100, rho=0.2
    )
    environment = as_environment(world, task, dtype=jnp.float32)
    by_steps = tr.make_problem(environment, limit=nav.LIMITS[task])
    return Robot(task, world, problem, hparams, environment, by_steps)


def _scores(
    task: jax.Array, world: nav.Navigation, run: nav.NavigationRun
) -> tuple[jax.Array, jax.Array]:
    """J and Z of a traced task, so that one compiled search serves all tasks."""
    every = [nav.scores(world, run.state, number) for number in nav.TASKS]
    return tuple(jnp.stack(part)[task - 1] for part in zip(*every, strict=True))  # type: ignore


def _search(
    robot: Robot, method: str, seeds: int, plan: CceExperimentPlan, pretrained: PyTree = None
) -> MethodSearch:
    """A search by a method, from scratch or from pretrained distributions of policies."""
    keys = _keys(seeds, robot.task)
    num_steps, trust_steps = plan.steps, plan.trust_steps
    if pretrained is not None:
        num_steps, trust_steps = plan.feasible_steps
    if method == "CCE":
        state, metrics = _train(keys, robot.problem, robot.hparams, num_steps, pretrained)
        trajectories, cost = metrics.num_evaluated * _NUM_TRAJECTORIES, metrics.cost[..., 0]
        return MethodSearch(
            method, keys, trajectories, metrics.objective, cost, state, robot.hparams
        )
    hparams = replace(
        _TRUST,
        method="cpo" if method == "CPO" else "trpo",
        # A penalty of zero instead of None does not recompile.
        penalty=None if method == "CPO" else PENALTY * (method == "penalised TRPO"),
    )
    state = jax.vmap(lambda key: tr.init(key, robot.stepwise, hparams))(keys)
    if pretrained is not None:
        state = _imitate(state, robot, hparams, pretrained)
    state, metrics = _run(state, robot.stepwise, hparams, trust_steps)
    return MethodSearch(
        method, keys, metrics.trajectories, metrics.reward, metrics.cost, state, hparams
    )


@partial(jax.jit, static_argnums=3)
def _run(state: tr.State, problem: tr.Problem, hparams: tr.Hparams, num_steps: int) -> PyTree:
    """Runs of all seeds in sequence: batched matrix products are slower."""
    return jax.lax.map(lambda s: tr.run(s, problem, hparams, num_steps=num_steps), state)


def _imitate(state: tr.State, robot: Robot, hparams: tr.Hparams, families_: PyTree) -> tr.State:
    """Policy networks fitted to the distributions' centers by least squares on their trajectories."""
    network = nav.policy_network(robot.world)
    descent = optax.adam(3e-3)

    def imitate(state: tr.State, family: PyTree) -> tr.State:
        policy = families.center(family)
        agent = network_agent(network, robot.environment)(policy)
        seen = _episodes(state.key, robot.environment, agent, 200, robot.world.horizon).observation
        seen = seen.reshape(-1, seen.shape[-1])
        goal = apply(network, policy, seen)

        def loss(parameters: PyTree, chosen: jax.Array) -> jax.Array:
            mean, _ = tr.act(replace(state, parameters=parameters), hparams, seen[chosen])
            return jnp.mean((mean - goal[chosen]) ** 2)

        def descend(carry: PyTree, key: jax.Array) -> PyTree:
            parameters, memory = carry
            chosen = jax.random.randint(key, (256,), 0, len(seen))
            updates, memory = descent.update(jax.grad(loss)(parameters, chosen), memory)
            return (optax.apply_updates(parameters, updates), memory), None

        first = {**state.parameters, "log_deviation": jnp.full(2, jnp.log(0.2), jnp.float32)}
        keys = jax.random.split(jax.random.fold_in(state.key, 2), 3000)
        (parameters, _), _ = jax.lax.scan(descend, (first, descent.init(first)), keys)
        return replace(state, parameters={**parameters, "log_deviation": first["log_deviation"]})

    return jax.jit(lambda s, f: jax.lax.map(lambda x: imitate(*x), (s, f)))(state, families_)


# --- trajectories of returned policies -------------------------------------------------------------


@partial(jax.jit, static_argnums=(3, 4))
def _episodes(
    key: jax.Array, environment: Environment, agent: Agent, number: int, horizon: int
) -> Episode:
    keys = jax.random.split(key, number)
    return jax.vmap(lambda k: run_episode(k, environment, agent, num_steps=horizon))(keys)


def _agents(robot: Robot, run: MethodSearch, plan: CceExperimentPlan) -> Iterator[Agent]:
    """The returned policy of each seed; if none is feasible, the one of the least violation."""
    act = network_agent(nav.policy_network(robot.world), robot.environment)
    for i, key in enumerate(run.keys):
        state = jax.tree.map(lambda x, i=i: x[i], run.state)
        if run.method != "CCE":
            yield tr.policy(state, robot.stepwise, run.hparams)
            continue
        result = cce.result(
            jax.random.fold_in(key, 1),
            state,
            robot.problem,
            run.hparams,
            num_evaluations=max(plan.fresh // _NUM_TRAJECTORIES, 2),
        )
        least = min((result.mean, result.best), key=lambda a: float(a.excess))
        yield act(least.parameters if result.solution is None else result.solution)


def _evaluated(
    robot: Robot, run: MethodSearch, plan: CceExperimentPlan
) -> tuple[Record, Record, Record]:
    """A row, the learning curves, and trajectories of the first seed's policy."""
    limit = nav.LIMITS[robot.task]
    trajectories, objectives, costs = (
        np.asarray(x) for x in (run.trajectories, run.objective, run.cost)
    )
    path: Any = None
    objective, cost, interval = [], [], []
    for agent in _agents(robot, run, plan):
        episodes = _episodes(
            jax.random.key(10**6), robot.environment, agent, plan.fresh, robot.world.horizon
        )
        path = episodes.world.state if path is None else path
        total = episodes.cost.sum(1)
        objective.append(float(episodes.reward.sum(1).mean()))
        cost.append(float(total.mean()))
        margin = 1.96 * float(total.std(ddof=1)) / np.sqrt(plan.fresh)
        interval.append((cost[-1] - margin, cost[-1] + margin))
    reached = costs <= limit
    first = [
        int(t[c.argmax()]) if c.any() else None for t, c in zip(trajectories, reached, strict=True)
    ]
    row = {
        "task": robot.task,
        "method": run.method,
        "limit": limit,
        "seeds": len(cost),
        "seeds_feasible": sum(z <= limit for z in cost),
        "seeds_confident": sum(high <= limit for _, high in interval),
        "seeds_feasible_at_end": int(reached[:, -1].sum()),
        "trajectories": int(trajectories[0, -1]),
        "trajectories_to_feasible": first,
        "objective_mean": np.mean(objective),
        "cost_mean": np.mean(cost),
        "objective": _rounded(objective),
        "cost": _rounded(cost),
        "cost_interval": _rounded(interval),
        "final_objective": _rounded(objectives[:, -1]),
        "final_cost": _rounded(costs[:, -1]),
    }
    curve = {
        "task": robot.task,
        "method": run.method,
        "limit": limit,
        "trajectories": trajectories[0],
        **{
            f"{name}_{of}": _rounded(getattr(np, of)(x, axis=0), 3)
            for name, x in (("objective", objectives), ("cost", costs))
            for of in ("mean", "std")
        },
    }
    paths = {
        "task": robot.task,
        "method": run.method,
        "x": _rounded(path.x[:10, :-1], 3),
        "y": _rounded(path.y[:10, :-1], 3),
    }
    return row, curve, paths


# --- the table ----------------------------------------------------------------------------------


def table(result: Record) -> str:
    """The report of section 4.5."""
    return render_table("cce.txt", **result)


# --- pictures -----------------------------------------------------------------------------------


def pictures(result: Record) -> Record:
    """Figures 8, 10 and 11, and trajectories of the returned policies of the first seed."""
    from jaxltl import plot

    best = result["figure8"]["optimum"]
    drawn = {
        "figure_8_regulator": plot.lines(
            {
                x["network"]: {
                    **{
                        f"{name} state": (
                            np.asarray(x["state"])[..., i],
                            np.asarray(best["state"])[:, i],
                        )
                        for i, name in enumerate(("first", "second"))
                    },
                    "control": (x["control"], best["control"]),
                    "cost beyond the optimum": ([x["gap"]], None),
                    "violation": ([x["violation"]], None),
                }
                for x in result["figure8"]["learned"]
            },
            labels=("time", "time", "time", "seeds, sorted", "seeds, sorted"),
            names=("learned", "optimal"),
        )
    }
    for name, curves in (
        ("figure_10_robot", result["figure10"]),
        ("figure_11_feasible_start", result["figure11"]),
    ):
        if not curves:
            continue
        rows: Record = {}
        limits = {}
        for x in curves:
            row = rows.setdefault(f"task {x['task']}", {"objective": {}, "cost": {}})
            limits[f"task {x['task']}"] = {"cost": x["limit"]}
            for part in row:
                row[part][x["method"]] = tuple(
                    np.asarray(x[k]) for k in ("trajectories", f"{part}_mean", f"{part}_std")
                )
        drawn[name] = plot.bands(rows, limits=limits, label="trajectories")
    world = nav.navigation()
    drawn["maps"] = plot.paths(
        {f"task {x['task']}: {x['method']}": (x["x"], x["y"]) for x in result["maps"]},
        {"goal": world.goal, "obstacle": world.obstacle, "start": world.initial},
        bounds=world.bounds,
        num_columns=len({x["method"] for x in result["maps"]}),
    )
    return drawn
