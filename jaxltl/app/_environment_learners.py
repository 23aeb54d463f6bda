"""The learners of simulated worlds, each with the hyperparameters of a task file."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxltl.algos import cce, ppo, trust_region
from jaxltl.algos.cce.exponential_family import diagonal_gaussian
from jaxltl.algos.common.actor_critic import default_network
from jaxltl.algos.common.schedules import Linear
from jaxltl.app.files.task_environment import EnvironmentTask
from jaxltl.app.job import settings
from jaxltl.core.environments.environment import Box, Environment, Finite, Timestep
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.values.evaluation.episode_scores import episode_evaluator
from jaxltl.envs.networks import make_network, network_agent


class Method(NamedTuple):
    """A learner with all that it takes.

    Attributes:
      algorithm: its module.
      problem, hparams: what its functions take.
      agent: ``(state, likeliest) -> Agent``, what was learned.
      figures: names of the metrics that are drawn.
      kept: names of the state's fields that a policy is made of.
      transitions: at most so many steps of the environment are made by a step of the learner.
      told: the policy in words.
    """

    algorithm: Any
    problem: Any
    hparams: Any
    agent: Callable[[Any, bool], Agent]
    figures: tuple[str, ...]
    kept: tuple[str, ...]
    transitions: int
    told: str


def make_method(task: EnvironmentTask, environment: Environment, num_steps: int) -> Method:
    """The learner that a task file asks for.

    Args:
      task: the file.
      environment: with the task.
      num_steps: after which an episode is cut off.

    Raises:
      ValueError: hyperparameters, or actions, that the learner does not take.
    """
    make = {"ppo": _ppo, "cce": _cce, "cpo": _cpo}[task.method]
    spec = {k: _value(k, v, task.learner["steps"]) for k, v in task.settings.items()}
    found = make(spec, environment, num_steps)
    if found.transitions > _MOST:
        raise ValueError(
            f"a step of the learner would make {found.transitions:,} simulated steps; at most "
            f"{_MOST:,} are counted: simulate fewer side by side, or shorter."
        )
    # With numbers that are no tracers, so that the learner's own checks see them.
    jax.eval_shape(
        lambda key: found.algorithm.init(key, found.problem, found.hparams), jax.random.key(0)
    )
    return found


_MOST = 2**31 - 1
_SCHEDULES = ("learning_rate", "clip", "value_clip", "rate", "noise")


def _value(name: str, value: Any, num_steps: int) -> Any:
    """A value of a file as a learner takes it."""
    if not isinstance(value, list):
        return value
    if name not in _SCHEDULES:
        return tuple(value)
    return Linear(first=float(value[0]), last=float(value[1]), num_steps=num_steps)


def _size(shape: Any) -> int:
    return sum(
        math.prod(x.shape) for x in jax.tree.leaves(shape, is_leaf=lambda x: isinstance(x, Box))
    )


def _ppo(spec: Mapping[str, Any], environment: Environment, num_steps: int) -> Method:
    parts = {k: spec[k] for k in ("hidden", "activation", "initial_deviation") if k in spec}
    network = dataclasses.replace(default_network(environment.actions), **parts)
    problem = ppo.make_problem(environment, network=network)
    hparams = settings(ppo.Hparams, {"discount": 1.0, **spec})

    def agent(state: Any, likeliest: bool) -> Agent:
        return (ppo.greedy if likeliest else ppo.policy)(state, problem, hparams)

    return Method(
        ppo,
        problem,
        hparams,
        agent,
        ("episode_return", "episode_length", "entropy", "explained_variance"),
        ("parameters", "moments"),
        hparams.num_envs * hparams.num_steps,
        f"two networks with hidden layers {list(network.hidden)}",
    )


def _cce(spec: Mapping[str, Any], environment: Environment, num_steps: int) -> Method:
    actions, hidden = environment.actions, spec.get("hidden", (16,))
    outputs = actions.num if isinstance(actions, Finite) else math.prod(actions.shape)
    network = make_network(
        (_size(environment.observations), *hidden, outputs), hidden=spec.get("activation", "tanh")
    )
    make, episodes = network_agent(network, environment), spec.get("episodes", 10)
    score = episode_evaluator(
        environment,
        make,
        objective=spec.get("objective", "reward"),
        costs=spec.get("cost", ()),
        num_episodes=episodes,
        num_steps=num_steps,
    )
    first = diagonal_gaussian(
        jnp.zeros(network.num_parameters, jnp.float32), spec.get("deviation", 1.0)
    )
    problem = cce.make_problem(score, first, limit=spec.get("limit"))
    hparams = settings(cce.Hparams, {"rate": 0.5, **spec})

    def agent(state: Any, likeliest: bool) -> Agent:
        del likeliest
        return make(cce.policy(state, problem, hparams))

    return Method(
        cce,
        problem,
        hparams,
        agent,
        ("objective", "cost", "best_objective", "num_feasible", "spread"),
        ("family",),
        hparams.population * episodes * num_steps,
        f"a network {'-'.join(map(str, network.sizes))} of {network.num_parameters} parameters",
    )


def _cpo(spec: Mapping[str, Any], environment: Environment, num_steps: int) -> Method:
    if not isinstance(environment.actions, Box):
        raise ValueError(
            "the actions are finitely many, and this learner takes those of a box: choose "
            'method = "ppo" or "cce".'
        )
    if spec.get("cost", "world") == "violation":
        step = Partial(_costs_where_violated, environment.step)
        environment = dataclasses.replace(environment, step=step, outcomes=None)
    problem = trust_region.make_problem(environment, horizon=num_steps, limit=spec["limit"])
    hparams = settings(trust_region.Hparams, {"discount": 1.0, **spec})

    def agent(state: Any, likeliest: bool) -> Agent:
        return (trust_region.greedy if likeliest else trust_region.policy)(state, problem, hparams)

    return Method(
        trust_region,
        problem,
        hparams,
        agent,
        ("reward", "cost", "length", "deviation", "kl"),
        ("parameters", "moments"),
        hparams.num_trajectories * num_steps,
        f"a Gaussian whose mean is a network with hidden layers {list(hparams.hidden)}",
    )


def _costs_where_violated(
    step: Callable[..., Timestep], world: Any, action: Any, key: chex.PRNGKey
) -> Timestep:
    """A cost of one where the task is violated, whose expected sum is how likely that is."""
    found = Timestep(*step(world, action, key))
    # There is but one such step: an episode ends with it.
    return found._replace(cost=jnp.where(found.world.verdict == Verdict.VIOLATED, 1.0, 0.0))
