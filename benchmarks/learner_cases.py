"""A problem of ordinary size for each learner: runs of one seed that take .02 to .3 s on a core."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl
from jaxltl.algos import (
    behavioral_cloning,
    cce,
    expected_sarsa,
    feasible,
    finite_state_controllers,
    interval_learning,
    many_tasks,
    maximin_q,
    mlirl,
    ppo,
    rmax,
    todirl,
    trust_region,
)
from jaxltl.algos.cce import exponential_family as families
from jaxltl.core.environments.environment import Timestep, make_box, make_environment
from jaxltl.core.models.parametric import make_parametric
from jaxltl.envs import lqr
from jaxltl.envs.letter_world import events_seen
from jaxltl.envs.networks import make_network
from jaxltl.envs.robots import diagonal_reward, robots

_MAP = """
. . . . b
. o . . .
a . . o .
. . s . .
"""
_TASK = "F (a & X F b) & (!o U b)"


class Case(NamedTuple):
    """A learner with a problem, its settings and the steps of a run."""

    module: Any
    problem: Any
    hparams: Any
    num_steps: int

    def train(self, key: jax.Array, problem: Any, hparams: Any) -> Any:
        """One seed."""
        return self.module.train(key, problem, hparams, num_steps=self.num_steps, max_rows=1)


@cache
def _world() -> Any:
    return jl.gridworld(_MAP, slip=0.1, absorbing=["o"], initial="s")


@cache
def _product() -> tuple[Any, Any]:
    """20 cells beside the task, and four demonstrations."""
    model = jl.product(_world(), _TASK)
    best = jl.optimal_satisfaction(model)
    policy = 0.9 * jax.nn.one_hot(best.policy, model.num_actions) + 0.1 / model.num_actions
    shown = jl.rollout(model, policy, jax.random.key(0), num_steps=40, num_trajectories=4)
    return model, jl.models.project_trajectories(model, shown)


def _mlirl(mu: float | None, **options: Any) -> Case:
    model, shown = _product()
    features = mlirl.task_features(model, shown, avoid=["o"])
    problem = mlirl.make_problem(model, features.values, shown)
    return Case(mlirl, problem, mlirl.Hparams(discount=0.9, mu=mu, **options), 20)


def _todirl() -> Case:
    model, shown = _product()
    network = todirl.RewardNetwork((20, 20))
    problem = todirl.make_problem(model, np.eye(20), shown, network=network)
    return Case(todirl, problem, todirl.Hparams(discount=0.9), 30)


def _cloning() -> Case:
    model, shown = _product()
    network = behavioral_cloning.DensePolicy(num_actions=4, hidden=(32,))
    problem = behavioral_cloning.make_problem(model, np.eye(20), shown, network=network)
    return Case(behavioral_cloning, problem, behavioral_cloning.Hparams(batch=16), 500)


def _cce() -> Case:
    network = make_network("2-2-1")
    family = families.diagonal_gaussian(jnp.zeros(network.num_parameters), 1.0)
    problem = cce.make_problem(lqr.evaluator(lqr.lqr(), network), family, limit=0.0)
    return Case(cce, problem, cce.Hparams(rate=0.1), 400)


def _point_reset(key: jax.Array) -> jax.Array:
    return jax.random.uniform(key, (2,), minval=-1)


def _point_step(place: jax.Array, action: jax.Array, key: jax.Array) -> Timestep:
    place = place + 0.3 * action
    return Timestep(place, -jnp.sum(place**2), jnp.abs(place).max() > 4, cost=jnp.sum(action**2))


def _trust(method: str) -> Case:
    point = make_environment(
        _point_reset, _point_step, lambda x: x, actions=make_box(-jnp.inf, jnp.inf, (2,))
    )
    problem = trust_region.make_problem(point, horizon=20, limit=6.0)
    hparams = trust_region.Hparams(discount=0.9, method=method, num_trajectories=20, hidden=(16,))
    return Case(trust_region, problem, hparams, 5)


def _ppo() -> Case:
    task = jl.task_environment(jl.environments.model_environment(_world()), _TASK)
    return Case(
        ppo, ppo.make_problem(task), ppo.Hparams(discount=0.99, num_envs=8, num_steps=32), 10
    )


def _many_tasks() -> Case:
    world = jl.envs.letter_world(size=4, letters=3, num_copies=1, horizon=30)
    events = jl.environments.make_events(world.propositions)
    network = many_tasks.SequenceNetwork(num_actions=4, events_seen=events_seen, hidden=(16,))
    sampler = jl.environments.sequence_sampler(
        np.arange(3) < 3, reach=[1.0], avoid=[0.5, 0.5], sets=events.any(1)
    )
    task = jl.environments.sequence_environment(world, events, sampler)
    problem = ppo.make_problem(task, network=network)
    return Case(ppo, problem, ppo.Hparams(discount=0.94, num_envs=8, num_steps=32), 5)


def _q_learning(method: str) -> Case:
    game = robots(4)
    safe = jl.permissive_strategy(game, jl.games.safety(game, "!collision"))
    inside = jl.games.apply_strategy(safe).model
    problem = maximin_q.make_problem(inside, diagonal_reward(inside), method=method)
    return Case(maximin_q, problem, maximin_q.Hparams(discount=0.9), 10)


def _rmax() -> Case:
    problem = rmax.make_problem(_world(), "G F a", np.full((20, 4), 0.5))
    hparams = rmax.Hparams(discount=0.9, known_after=20, epsilon=0.1, reward_bound=1.0)
    return Case(rmax, problem, hparams, 100)


def _intervals() -> Case:
    problem = interval_learning.make_problem(_world(), _TASK)
    return Case(interval_learning, problem, interval_learning.Hparams(num_runs=10, length=40), 10)


def _throws(x: jax.Array) -> jax.Array:
    return jnp.stack([x, 1 - x], -1).ravel()


def _feasible(size: int = 400) -> Case:
    """A chain of coins, each with its own bias."""
    state = np.arange(size)
    successor = np.stack([state + 1, np.maximum(state - 1, 0)], 1).ravel()
    chain = jl.make_sparse(
        None,
        [*range(0, 2 * size + 1, 2), 2 * size + 1],
        [*successor, size],
        [0.5] * (2 * size) + [1.0],
        initial=np.eye(size + 1)[0],
        rewards=None,
    )
    model = make_parametric(
        chain,
        lambda x: jnp.concatenate([_throws(x), jnp.ones(1)]),
        np.full(size, 0.1),
        np.full(size, 0.9),
    )
    problem = feasible.make_problem(model, np.arange(size + 1) == size, bound=">=")
    return Case(feasible, problem, feasible.Hparams(), 2000)


def _sarsa() -> Case:
    reward = np.random.default_rng(0).normal(size=(20, 4))
    problem = expected_sarsa.make_problem(_world(), reward)
    return Case(
        expected_sarsa, problem, expected_sarsa.Hparams(discount=0.9, num_transitions=100), 30
    )


def _controllers(size: int, num_memory: int, formula: str | None, num_steps: int) -> Case:
    """A robot on a square map that sees the cells around it, and not the goal nor the trap."""
    cells = np.full((size, size), ".")
    cells[1::3, 1::2], cells[2::4, 2::3] = "#", "#"
    cells[0, 0], cells[-1, -1], cells[size // 2, -1] = "a", "g", "x"
    text = "\n".join(map(" ".join, cells))
    world = jl.envs.partial_gridworld(text, 3, hidden=["g", "x"], slip=0.1, initial="a")
    question = {"target": "g", "stay": "!x"} if formula is None else {"formula": formula}
    problem = finite_state_controllers.make_problem(world, **question)
    hparams = finite_state_controllers.Hparams(num_memory=num_memory)
    return Case(finite_state_controllers, problem, hparams, num_steps)


CASES: dict[str, Callable[[], Case]] = {
    "mlirl": partial(_mlirl, None),
    "mlirl, soft policy": partial(_mlirl, None, policy="soft"),
    "mlirl, mu": partial(_mlirl, 1.0),
    "mlirl, adam": partial(_mlirl, None, optimizer="adam"),
    "todirl": _todirl,
    "behavioral_cloning": _cloning,
    "cce": _cce,
    "trust_region, TRPO": partial(_trust, "trpo"),
    "trust_region, CPO": partial(_trust, "cpo"),
    "ppo": _ppo,
    "ppo, many_tasks": _many_tasks,
    "maximin_q": partial(_q_learning, "maximin"),
    "maximin_q, generalized": partial(_q_learning, "generalized"),
    "rmax": _rmax,
    "interval_learning": _intervals,
    "feasible": _feasible,
    "expected_sarsa": _sarsa,
    "controllers, 25 cells": partial(_controllers, 5, 1, None, 100),
    "controllers, 100 cells": partial(_controllers, 10, 2, None, 100),
    "controllers, formula": partial(_controllers, 10, 2, "G F g & G F a & G !x", 10),
    "controllers, 400 cells": partial(_controllers, 20, 2, None, 10),
}
