"""(k) Eight lanes under ``vmap`` against a Python loop of eight jitted calls, on small models."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl
from benchmarks.models import random_mdp
from benchmarks.timing import compare
from jaxltl.algos import mlirl

_LANES = 8
_TASK = "F (a & X F (b & X F c)) & (!o U c)"
_MAP = """
. . . . b .
. o . . . .
a . . o . c
. . s . . .
"""


class Case(NamedTuple):
    """A function of one lane, and lanes that differ, stacked."""

    name: str
    function: Callable[..., Any]
    lanes: Any
    target: float = 1.0


def delivery() -> Any:
    """24 cells beside a task of eight memory states: 192 product states."""
    world = jl.gridworld(_MAP, slip=0.1, absorbing=["o"], initial="s")
    return jl.product(world, _TASK)


def _solver_cases(model: Any, name: str) -> Iterator[Case]:
    shape = (*model.state_shape, model.num_actions)
    rng = np.random.default_rng(0)
    scale = jnp.logspace(-1, 1, _LANES)
    reward = scale.reshape(-1, *(1,) * len(shape)) * rng.normal(size=(_LANES, *shape))
    policy = jax.nn.softmax(reward, axis=-1)
    for discount in (0.9, 0.99):
        at = f"{name}, discount {discount}"
        yield Case(
            f"policy_value, {at}",
            lambda x, d=discount: jl.policy_value(model, x[1], x[0], d),
            (reward, policy),
            0.5,
        )
        yield Case(
            f"optimal_value, {at}", lambda x, d=discount: jl.optimal_value(model, x, d), reward, 0.5
        )
        for method in ("newton", "value_iteration"):
            yield Case(
                f"soft_value, {method}, {at}",
                lambda x, d=discount, m=method: jl.soft_value(model, x, d, method=m),
                reward,
                0.5,
            )
        yield Case(
            f"boltzmann_value, {at}",
            lambda x, d=discount: jl.values.boltzmann_value(model, x, d),
            reward,
        )
        yield Case(
            f"occupancy_measure, {at}",
            lambda x, d=discount: jl.occupancy_measure(model, x, d),
            policy,
        )
        yield Case(
            f"minimax_value, {at}", lambda x, d=discount: jl.minimax_value(model, x, d), reward
        )
    target = jnp.arange(model.num_states).reshape(model.state_shape) % 97 == 5
    yield Case(
        f"reachability of a policy, {name}",
        lambda x: jl.reachability_probability(model, target, policy=x),
        policy,
    )


def _task_cases(model: Any, name: str) -> Iterator[Case]:
    rng = np.random.default_rng(1)
    shape = (*model.state_shape, model.num_actions)
    policy = jax.nn.softmax(3 * rng.normal(size=(_LANES, *shape)), axis=-1)
    yield Case(
        f"satisfaction_probability, {name}", lambda x: jl.satisfaction_probability(model, x), policy
    )
    yield Case(f"task_performance, {name}", lambda x: jl.task_performance(model, x), policy)
    slip = jnp.linspace(0.02, 0.3, _LANES)
    probability = model.mdp.probability

    def slippery(slip):
        mixed = (1 - slip) * probability + slip * jnp.where(
            probability > 0, 1 / jnp.sum(probability > 0, -1, keepdims=True), 0
        )
        world = model.mdp.replace(probability=mixed)
        return jl.optimal_satisfaction(model.replace(mdp=world))

    yield Case(f"optimal_satisfaction, {name}", slippery, slip)


def mlirl_case(model: Any, num_steps: int = 10) -> Case:
    """Seeds and weights mu from 1e-3 to 10 of inverse RL in the product."""
    key = jax.random.key(0)
    best = jl.optimal_satisfaction(model)
    policy = 0.9 * jax.nn.one_hot(best.policy, model.num_actions) + 0.1 / model.num_actions
    shown = jl.rollout(model, policy, key, num_steps=40, num_trajectories=1)
    world = jl.models.project_trajectories(model, shown)
    features = mlirl.task_features(model, world, avoid=["o"])
    problem = mlirl.make_problem(model, features.values, world)
    lanes = (jax.random.split(key, _LANES), jnp.logspace(-3, 1, _LANES))

    def train(lane):
        return mlirl.train(
            lane[0], problem, mlirl.Hparams(discount=0.9, mu=lane[1]), num_steps=num_steps
        )

    return Case(f"mlirl.train, {num_steps} steps, mu", train, lanes)


def measure(case: Case, repeats: int = 5) -> dict[str, Any]:
    """The ratio of run times, and of compilations, of the two ways."""
    jax.clear_caches()
    single, batch = jax.jit(case.function), jax.jit(jax.vmap(case.function))
    first = jax.tree.map(lambda x: x[0], case.lanes)
    begin = time.perf_counter()
    one = single.lower(first).compile()
    middle = time.perf_counter()
    many = batch.lower(case.lanes).compile()
    end = time.perf_counter()
    lanes = [jax.tree.map(lambda x, i=i: x[i], case.lanes) for i in range(_LANES)]
    row = compare(
        partial(many, case.lanes),
        lambda: [jax.block_until_ready(one(x)) for x in lanes],
        repeats=repeats,
    )
    row["compile_seconds"] = end - middle
    return {
        "name": case.name,
        "peer": "loop of 8",
        "target": case.target,
        **row,
        "compile_ratio": (end - middle) / (middle - begin),
        "peer_compile_seconds": middle - begin,
    }


def cases() -> Iterator[Case]:
    """All of them, models of 192 and 500 states."""
    grid, chance = delivery(), random_mdp(500)
    yield from _solver_cases(grid, "grid product")
    yield from _solver_cases(chance, "random")
    yield from _task_cases(grid, "grid product")
    yield mlirl_case(grid)


def run() -> list[dict[str, Any]]:
    """float64."""
    with jax.enable_x64(True):
        return [measure(case) for case in cases()]
