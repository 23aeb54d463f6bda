"""One case of :mod:`benchmarks.continuous`, in a process of its own; prints a JSON line."""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jax.tree_util import Partial

import jaxltl as jl
from jaxltl.algos import cce, ppo
from jaxltl.algos.cce.exponential_family import diagonal_gaussian
from jaxltl.algos.common.actor_critic import ActorCritic
from jaxltl.algos.common.schedules import Linear
from jaxltl.core.continuous.certificate import Certificate, certify_policy, first_grid, state_policy
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.continuous.regions import box
from jaxltl.core.continuous.synthesis import (
    CellPolicy,
    shield_dynamics,
    simulate_cells,
    synthesize_policy,
)
from jaxltl.core.environments import Environment, Timestep, Verdict, make_agent
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.values.evaluation.evaluation import episode_evaluator
from jaxltl.envs import continuous_worlds as worlds
from jaxltl.envs.networks import make_network, network_agent

Policy = Callable[[jax.Array], jax.Array]
THRESHOLD = 0.999999
# Of tasks beyond reach-avoid: halves of the target, which the noise visits, and two distant places.
HALVES = {
    "a": box([-0.2, -0.2], [0.2, 0.0]),
    "b": box([-0.2, 0.0], [0.2, 0.2]),
    "far": box([0.2, -0.7], [0.7, 0.7]),
}
APART = {"a": box([-0.5, -0.3], [-0.2, 0.3]), "b": box([0.2, -0.3], [0.5, 0.3])}


@dataclass
class Meter:
    """CPU seconds, wall seconds and the peak of resident memory since construction."""

    def __post_init__(self) -> None:
        jnp.zeros(1).block_until_ready()
        self.memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        self.begin = time.process_time(), time.perf_counter()

    def read(self) -> dict[str, float]:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - self.memory
        return {
            "cpu": time.process_time() - self.begin[0],
            "wall": time.perf_counter() - self.begin[1],
            "megabytes": peak / 1024,
        }


def network(folder: str, world: str, seed: int) -> Policy:
    """A ReLU network of a file of policies."""
    with np.load(Path(folder) / f"{world}.npz") as file:
        layers = []
        while f"seed{seed}_kernel{len(layers)}" in file:
            i = len(layers)
            layers.append((file[f"seed{seed}_kernel{i}"], file[f"seed{seed}_bias{i}"]))

    def policy(x: jax.Array) -> jax.Array:
        for i, (kernel, bias) in enumerate(layers):
            x = x @ kernel + bias
            x = jax.nn.relu(x) if i < len(layers) - 1 else x
        return x

    return policy


def _stages(certificate: Certificate) -> str:
    times = ", ".join(f"{name} {x:.2g} s" for name, x in certificate.seconds.items())
    count = [int((certificate.how[certificate.initial] == i).sum()) for i in (3, 2, 1, 0)]
    return (
        f"{times}; cells surely {count[0]}, almost {count[1]}, iterated {count[2]}, no {count[3]}"
    )


def _of_certificate(certificate: Certificate) -> dict[str, Any]:
    lower, upper = certificate.initial_bounds
    return {
        "cells": certificate.grid.num_cells,
        "lower": lower,
        "upper": upper,
        "mean_lower": float(certificate.lower[certificate.initial].mean()),
        "mean_upper": float(certificate.upper[certificate.initial].mean()),
        "seconds": certificate.seconds,
        "status": certificate.status.name,
        "remark": _stages(certificate),
    }


def simulated(
    dynamics: Dynamics, policy: Policy, formula: str, episodes: int, num_steps: int = 100
) -> dict[str, list[float]]:
    """Clopper-Pearson intervals of satisfied and violated episodes, at level 1 - 1e-6."""
    task = jl.task_environment(dynamics, formula)
    agent = make_agent(lambda seen, key: policy(seen.world))
    found = jl.evaluate(
        jax.random.key(0), agent, task, num_episodes=episodes, num_steps=num_steps,
        confidence=1 - 1e-6,
    )  # fmt: skip
    return {
        "satisfied": [found.success.lower, found.success.upper],
        "violated": [found.violation.lower, found.violation.upper],
    }


def _with_simulation(row: dict[str, Any], intervals: dict[str, list[float]]) -> dict[str, Any]:
    """The row with simulated intervals, which must meet the bounds of the mean initial state."""
    good, bad = intervals["satisfied"], intervals["violated"]
    sound = good[0] <= row["mean_upper"] + 1e-9 and 1 - bad[0] >= row["mean_lower"] - 1e-9
    remark = f"{row['remark']}; simulated {good[0]:.6f} to {1 - bad[0]:.6f}"
    remark += "" if sound else " CONTRADICTS THE BOUNDS"
    return row | {"simulated": intervals, "sound": sound, "remark": remark}


def policies(case: dict[str, Any]) -> dict[str, Any]:
    """The certificate of a trained network."""
    world = getattr(worlds, case["world"])()
    meter = Meter()
    policy = network(case["folder"], case["world"], case["seed"])
    proof = certify_policy(
        world.dynamics, policy, world.formula, threshold=1.0, max_cells=case["max_cells"]
    )
    row = _of_certificate(proof) | meter.read()
    found = simulated(world.dynamics, policy, world.formula, case["episodes"])
    return _with_simulation(row, found)


# --- learning -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Course:
    """Settings of learning a policy: in the whole domain, with larger unsafe and smaller target sets, and
    a penalty of the squared actions, which makes policies smooth; and the half-width of the domain of
    the proof, outside which the task counts as violated."""

    cells: list[int]
    unsafe_margin: float
    target_margin: float
    discount: float
    threshold: float = THRESHOLD
    max_cells: int = 2**20
    whole_domain: bool = True
    hidden: tuple[int, ...] = (32, 32)
    activation: str = "relu"
    penalty: float = 0.0
    half_width: float | None = None


COURSES = {
    "hard": Course([800, 800], 0.03, 0.01, 0.95),
    "collision": Course([200, 200], 0.03, 0.01, 0.95),
    "triple_integrator": Course(
        [56] * 3, 0.1, 0.04, 0.9, 0.95, 3 * 10**6, False, (16,), "tanh", 0.1, 0.45
    ),
}


def train(dynamics: Dynamics, formula: str, course: Course, seed: int, steps: int = 60) -> Agent:
    """The greedy policy of PPO after 250,000 transitions."""
    unsafe, target = dynamics.labels["unsafe"], dynamics.labels["target"]
    labels = dynamics.labels | {
        "unsafe": box(unsafe.low - course.unsafe_margin, unsafe.high + course.unsafe_margin),
        "target": box(target.low + course.target_margin, target.high - course.target_margin),
    }
    initial = dynamics.initial
    if course.whole_domain:
        initial = box(*(np.concatenate([getattr(initial, side), np.tile(end, (4, 1))])
                        for side, end in zip(("low", "high"), dynamics.domain, strict=True)))  # fmt: skip
    world = jl.environments.with_time_limit(replace(dynamics, labels=labels, initial=initial), 60)
    network = ActorCritic(
        shape=(dynamics.num_actions,), hidden=course.hidden, activation=course.activation
    )
    task = jl.task_environment(world, formula)
    task = task.replace(step=Partial(_penalized, task.step, course.penalty))
    problem = ppo.make_problem(task, network=network)
    hparams = ppo.Hparams(
        discount=course.discount, num_envs=64, num_steps=64, num_minibatches=8, num_epochs=8,
        entropy_weight=0.0, learning_rate=Linear(3e-3, 1.5e-4, steps),
    )  # fmt: skip
    state, _ = ppo.train(jax.random.key(seed), problem, hparams, num_steps=steps)
    return ppo.greedy(jax.block_until_ready(state), problem, hparams)


def _penalized(step: Any, weight: float, world: Any, action: jax.Array, key: jax.Array) -> Timestep:
    """The squared clipped action costs reward."""
    found = Timestep(*step(world, action, key))
    return found._replace(reward=found.reward - weight * (jnp.clip(action, -1, 1) ** 2).sum())


def learned(case: dict[str, Any]) -> dict[str, Any]:
    """The certificate of a network that PPO trains first."""
    name = case["world"]
    world = worlds.linear("hard") if name == "hard" else getattr(worlds, name)()
    course, meter = COURSES[name], Meter()
    agent = train(world.dynamics, world.formula, course, case["seed"])
    training = meter.read()
    policy = state_policy(agent, jl.task_environment(world.dynamics, world.formula))
    part = world.dynamics
    if course.half_width is not None:  # leaving the smaller domain violates: lower bounds hold
        half = np.full(part.num_states, course.half_width)
        part = replace(part, domain=(-half, half), outside="violates")
    proof = certify_policy(
        part, policy, world.formula, cells=course.cells, threshold=course.threshold,
        max_cells=course.max_cells, upper=False,
    )  # fmt: skip
    row = _of_certificate(proof) | meter.read()
    row["remark"] = f"training {training['cpu']:.1f} of the cpu s; {row['remark']}"
    found = simulated(world.dynamics, policy, world.formula, case["episodes"])
    return _with_simulation(row, found) | {"training": training}


def _worst_step(base: Dynamics) -> Any:
    """The step with the greatest disturbance away from the origin."""
    return lambda x, u, w: base.step(x, u, jnp.sign(x).astype(x.dtype))


def _with_violations(step: Any, world: Any, action: jax.Array, key: jax.Array) -> Timestep:
    """A violation costs 1."""
    found = Timestep(*step(world, action, key))
    return found._replace(cost=(found.world.verdict == Verdict.VIOLATED).astype(float))


def shield(case: dict[str, Any]) -> dict[str, Any]:
    """Violations while PPO or the cross-entropy method learn in the linear world, its noise chosen by
    an adversary; inside the permissive strategy of safety, or without it."""
    base = worlds.linear().dynamics
    wide = box([-1.2, -0.4], [1.2, 0.4])
    adverse = replace(base, noise=(), disturbance=(-np.ones(2), np.ones(2)), initial=wide)
    meter = Meter()
    actions = np.linspace(-1, 1, 21)[:, None]
    policy = synthesize_policy(adverse, "G !unsafe", actions, cells=[100, 100], upper=False)
    row = _of_certificate(policy.certificate)
    pushed = replace(adverse, step=_worst_step(base))
    inner = shield_dynamics(replace(policy, dynamics=pushed)) if case["shielded"] else pushed
    formula, options = "G !unsafe & G F target", {"reward": "eventual", "discount": 0.95}
    task = jl.task_environment(getattr(inner, "environment", inner), formula, **options)
    task = task.replace(step=Partial(_with_violations, task.step))
    learner = {"ppo": _ppo_violations, "cce": _cce_violations}[case["learner"]]
    violations, transitions = learner(jl.environments.with_time_limit(task, 50), case["steps"])
    row |= meter.read() | {"violations": violations, "transitions": transitions}
    return row | {"remark": f"{violations:,} violations in {transitions:,} transitions"}


def _ppo_violations(task: Environment, steps: int) -> tuple[int, int]:
    updates, batch = -(-steps // 4096), 64 * 64
    hparams = ppo.Hparams(
        discount=1.0, num_envs=64, num_steps=64, num_minibatches=4, learning_rate=1e-3
    )
    problem = ppo.make_problem(task)
    _, metrics = ppo.train(jax.random.key(0), problem, hparams, num_steps=updates, max_rows=updates)
    return int(np.rint(np.asarray(metrics.cost, float) * batch).sum()), updates * batch


def _cce_violations(task: Environment, steps: int) -> tuple[int, int]:
    """Lengths of all episodes are scored too, since they end with a violation."""
    seen = jax.eval_shape(lambda: task.observe(task.reset(jax.random.key(0))))
    size = sum(x.size for x in jax.tree.leaves(seen))
    network = make_network((size, 16, 1), hidden="tanh")
    score = episode_evaluator(
        task, network_agent(network, task), objective="discounted_visits",
        costs=("violation", "length"), num_episodes=4, num_steps=50, discount=0.95,
    )  # fmt: skip
    first = diagonal_gaussian(jnp.zeros(network.num_parameters), 1.0)
    problem, hparams = cce.make_problem(score, first), cce.Hparams(population=50)
    state = cce.init(jax.random.key(1), problem, hparams)
    violations = transitions = 0.0
    while transitions < steps:
        state, metrics = cce.step(state, problem, hparams)
        violations += 200 * float(metrics.cost[0])
        transitions += 200 * float(metrics.cost[1])
    return round(violations), round(transitions)


def tasks(case: dict[str, Any]) -> dict[str, Any]:
    """The certificate of a task beyond reach-avoid."""
    base = getattr(worlds, case["world"])().dynamics
    if case["world"] == "robot":
        return _robot_task(base, case["formula"])
    dynamics = replace(base, labels={**base.labels, **HALVES})
    meter = Meter()
    if case["policy"] == "synthesis":
        actions = np.linspace(-1, 1, 9)[:, None]
        found = synthesize_policy(
            replace(dynamics, labels={**base.labels, **APART}), case["formula"], actions,
            cells=[60, 60], max_cells=3600, upper=False,
        )  # fmt: skip
        return _of_certificate(found.certificate) | meter.read()
    policy = network(case["folder"], case["world"], 1)
    proof = certify_policy(
        dynamics, policy, case["formula"], threshold=THRESHOLD, max_cells=case["max_cells"]
    )
    row = _of_certificate(proof) | meter.read()
    episodes = max(case["episodes"] // 50, 1)
    return _with_simulation(row, simulated(dynamics, policy, case["formula"], episodes, 300))


def _robot_task(base: Dynamics, formula: str) -> dict[str, Any]:
    """Synthesis for a task with two goals, on the published cells and a fifth of the actions."""
    goals = {"a": base.labels["target"], "b": box([-8.0, -8.0], [-5.0, -5.0])}
    dynamics, meter = replace(base, labels={**base.labels, **goals}), Meter()
    found = synthesize_policy(
        dynamics,
        formula,
        np.asarray(base.actions)[::5],
        cells=[41, 41],
        max_cells=2000,
        upper=False,
    )
    return _over_all_cells(_of_certificate(found.certificate) | meter.read())


def _over_all_cells(row: dict[str, Any]) -> dict[str, Any]:
    """Mean bounds: from unsafe cells the probability is 0."""
    row |= {"lower": row["mean_lower"], "upper": row["mean_upper"]}
    return row | {"remark": f"mean bounds; {row['remark']}"}


# --- synthesis ------------------------------------------------------------------------------------


def published_cells(world: worlds.BenchmarkWorld) -> list[int]:
    """Cells along each axis of the published grid."""
    low, high = world.dynamics.domain
    return np.round((high - low) / np.array(world.cell_width)).astype(int).tolist()


def synthesis(case: dict[str, Any]) -> dict[str, Any]:
    """A policy on the published grid, with the mean bounds of all cells."""
    world = getattr(worlds, case["world"])()
    cells = published_cells(world)
    formula = world.formula
    if world.num_steps is not None:
        formula = " & ".join("X " * k + "!outside" for k in range(world.num_steps + 1))
    meter = Meter()
    options: dict[str, Any] = {"cells": cells, "max_cells": _grid_size(world, cells)}
    options["upper"] = case["upper"]
    if world.dynamics.actions is None:
        certificate = certify_policy(world.dynamics, _no_action, formula, **options)
    else:
        certificate = synthesize_policy(world.dynamics, formula, **options).certificate
    return _over_all_cells(_of_certificate(certificate) | meter.read())


def _no_action(x: jax.Array) -> jax.Array:
    return jnp.zeros(0, x.dtype)


def _grid_size(world: worlds.BenchmarkWorld, cells: list[int]) -> int:
    """Number of cells of the first grid, in which edges of labels may be inserted."""
    return first_grid(world.dynamics, cells, 2**30).num_cells


def models(case: dict[str, Any]) -> dict[str, Any]:
    """The robot on a coarse grid: bounds of the policy on cells, and simulated runs of it."""
    side, base = case["side"], worlds.robot().dynamics
    actions = np.array([[v, angle] for v in (-1.0, 0.0, 1.0) for angle in (-1.0, -0.5, 0, 0.5, 1)])
    meter = Meter()
    options: dict[str, Any] = {"cells": [side, side], "max_cells": (side + 4) ** 2}
    policy = synthesize_policy(base, worlds.REACH_AVOID, actions, **options)
    row = _of_certificate(policy.certificate) | meter.read()
    starts = jax.vmap(base.sample_initial)(jax.random.split(jax.random.key(1), case["episodes"]))
    good = int(np.asarray(_reaches(policy, starts)).sum())
    interval = clopper_pearson(good, len(starts))
    lower, upper = (float(x.mean()) for x in policy.certificate.at(np.asarray(starts, float)))
    row |= {"lower": lower, "upper": upper, "simulated": {"satisfied": interval}}
    row["sound"] = interval[1] >= lower  # its upper bounds are those of all policies
    row["remark"] = (
        f"mean bounds of initial states; simulated {interval[0]:.6f} to {interval[1]:.6f}; "
        f"{row['remark']}"
    )
    return row


def _reaches(policy: CellPolicy, starts: jax.Array, num_steps: int = 300) -> jax.Array:
    """Runs that enter the target before unsafe states or leaving the domain: ``bool[N]``."""
    names = list(policy.dynamics.propositions)
    columns = np.array([names.index("target"), names.index("unsafe")])

    def run(key: jax.Array, start: jax.Array) -> jax.Array:
        states, _, _ = simulate_cells(key, policy, start, num_steps)
        label = jax.vmap(policy.dynamics.label)(states)[:, columns]
        lost = label[:, 1] | ~jax.vmap(policy.dynamics.inside)(states)
        first = jnp.where(label[:, 0].any(), label[:, 0].argmax(), num_steps)
        return first < jnp.where(lost.any(), lost.argmax(), num_steps)

    return jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(2), len(starts)), starts)


def clopper_pearson(hits: int, runs: int, level: float = 1e-6) -> list[float]:
    """The exact confidence interval of a probability."""
    low = scipy.stats.beta.ppf(level / 2, hits, runs - hits + 1) if hits else 0.0
    high = scipy.stats.beta.isf(level / 2, hits + 1, runs - hits) if hits < runs else 1.0
    return [float(low), float(high)]


def main() -> None:
    case = json.loads(sys.argv[1])
    print(json.dumps(globals()[case["part"]](case)))


if __name__ == "__main__":
    main()
