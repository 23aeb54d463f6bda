"""Environments and learners of task files: the set-up of reinforcement learning by simulation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import chex
import jax
import jax.numpy as jnp
from jax.tree_util import Partial

from jaxltl.algos import cce, ppo, trust_region
from jaxltl.algos.cce.exponential_family import diagonal_gaussian
from jaxltl.algos.common.actor_critic import default_network
from jaxltl.algos.common.schedules import Linear
from jaxltl.algos.common.seeds import Algorithm, make_hparams
from jaxltl.app.files.schema import LARGEST_INT
from jaxltl.app.files.task_rl import CceTable, CpoTable, EnvironmentFile
from jaxltl.app.wording import Record
from jaxltl.core.continuous.dynamics import Dynamics
from jaxltl.core.environments import Agent, Box, Finite, Timestep, Verdict
from jaxltl.core.environments.environment import Environment, require_environment
from jaxltl.core.environments.episodes import with_time_limit
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.validation import errors_in
from jaxltl.core.values.evaluation.evaluation import episode_evaluator
from jaxltl.envs.by_name import function_of, make, make_dynamics_of
from jaxltl.envs.networks import make_network, network_agent


def load_environment(
    task: EnvironmentFile, world: Environment | Dynamics | None = None
) -> Environment:
    """The environment of a task file, with its labels and its horizon."""
    world, table = load_world(task) if world is None else world, task.world
    with errors_in(f"{task.path}: [world] "):
        world = require_environment(world)
        return world if table.horizon is None else with_time_limit(world, table.horizon)


def load_world(task: EnvironmentFile) -> Environment | Dynamics:
    """The environment or the dynamics of a task file, with its labels."""
    table, folder = task.world, task.path.parent
    if table.dynamics is not None:
        with errors_in(f"{task.path}: [world] dynamics: "):
            return make_dynamics_of(table.dynamics, table.arguments, folder)
    with errors_in(f"{task.path}: [world] labels: "):
        labels = None if table.labels is None else function_of(table.labels, folder)
    with errors_in(f"{task.path}: [world] environment: "):
        return make(
            table.environment or "",
            table.arguments,
            labels=labels,
            propositions=table.propositions or (),
            folder=folder,
        )


# --- learners --------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class LearnerSetup:
    """A learner with its problem and hyperparameters."""

    algorithm: Algorithm  # its module
    problem: PyTree  # with `hparams`, arguments of its functions
    hparams: PyTree
    drawn: tuple[str, ...]  # names of the metrics that are drawn
    transitions: int  # bound of the environment's steps in a step of the learner
    description: str  # of the policy
    # names of the state's fields that determine a policy
    policy_fields: tuple[str, ...] = ("parameters", "moments")
    make: Callable[[PyTree], Agent] | None = None  # the agent of a sample, in searches

    def agent(self, state: PyTree, likeliest: bool) -> Agent:
        """The policy of a state: greedy, or with drawn actions."""
        learner: Any = self.algorithm
        if self.make is not None:
            return self.make(learner.policy(state, self.problem, self.hparams))
        rule = learner.greedy if likeliest else learner.policy
        agent: Agent = rule(state, self.problem, self.hparams)
        return agent

    def state_shapes(self) -> Any:
        """The shapes of a state."""
        problem, hparams = self.problem, self.hparams  # not traced
        return jax.eval_shape(lambda x: self.algorithm.init(x, problem, hparams), jax.random.key(0))


def make_method(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    """The learner of a task file."""
    make = {"ppo": _ppo, "cce": _cce, "cpo": _cpo}[task.learner.method]
    method = make(task, environment, num_steps)
    if method.transitions > LARGEST_INT:  # int32 counters of the learners
        raise ValueError(
            f"a step of the learner would make {method.transitions:,} simulated steps; at most "
            f"{LARGEST_INT:,} are counted: simulate fewer or shorter episodes."
        )
    method.state_shapes()  # with concrete numbers, so that the learner's own checks see them
    return method


def _settings(task: EnvironmentFile) -> Record:
    """The method's keys, with pairs of numbers as schedules and lists as tuples."""
    steps = task.learner.steps
    hparams = task.settings.specified()
    for name, value in hparams.items():
        if isinstance(value, tuple):
            hparams[name] = Linear(first=value[0], last=value[1], num_steps=steps)
        elif isinstance(value, list):
            hparams[name] = tuple(value)
    return hparams


def _ppo(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    spec = _settings(task)
    parts = {k: spec[k] for k in ("hidden", "activation", "initial_deviation") if k in spec}
    network = dataclasses.replace(default_network(environment.actions), **parts)
    problem = ppo.make_problem(environment, network=network)
    hparams = make_hparams(ppo.Hparams, spec)
    return LearnerSetup(
        ppo,
        problem,
        hparams,
        ("episode_return", "episode_length", "entropy", "explained_variance"),
        hparams.num_envs * hparams.num_steps,
        f"two networks with hidden layers {list(network.hidden)}",
    )


def _cce(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    table, actions = task.settings, environment.actions
    assert isinstance(table, CceTable)
    outputs = actions.num if isinstance(actions, Finite) else math.prod(actions.shape)
    seen = jax.tree.leaves(environment.observations, is_leaf=lambda x: isinstance(x, Box))
    inputs = sum(math.prod(x.shape) for x in seen)
    network = make_network((inputs, *table.hidden, outputs), hidden=table.activation)
    make = network_agent(network, environment)
    score = episode_evaluator(
        environment,
        make,
        objective=table.objective,
        costs=table.cost or (),
        num_episodes=table.episodes,
        num_steps=num_steps,
    )
    first = diagonal_gaussian(jnp.zeros(network.num_parameters, jnp.float32), table.deviation)
    problem = cce.make_problem(score, first, limit=table.limit)
    hparams = make_hparams(cce.Hparams, _settings(task))
    return LearnerSetup(
        cce,
        problem,
        hparams,
        ("objective", "cost", "best_objective", "num_feasible", "max_deviation"),
        hparams.population * table.episodes * num_steps,
        f"a network {'-'.join(map(str, network.sizes))} of {network.num_parameters} parameters",
        ("family",),
        make,
    )


def _cpo(task: EnvironmentFile, environment: Environment, num_steps: int) -> LearnerSetup:
    table = task.settings
    assert isinstance(table, CpoTable) and table.limit is not None
    if not isinstance(environment.actions, Box):
        raise ValueError(
            "the environment has finitely many actions, and this learner needs a box: choose "
            'method = "ppo" or "cce".'
        )
    if table.cost == "violation":
        step = Partial(_costs_where_violated, environment.step)
        environment = dataclasses.replace(environment, step=step, outcomes=None)
    problem = trust_region.make_problem(environment, horizon=num_steps, limit=table.limit)
    hparams = make_hparams(trust_region.Hparams, _settings(task))
    return LearnerSetup(
        trust_region,
        problem,
        hparams,
        ("reward", "cost", "length", "deviation", "kl"),
        hparams.num_trajectories * num_steps,
        f"a Gaussian whose mean is a network with hidden layers {list(hparams.hidden)}",
    )


def _costs_where_violated(
    step: Callable[..., Timestep], world: PyTree, action: PyTree, key: chex.PRNGKey
) -> Timestep:
    """Cost 1 where the formula is violated; its expected sum is the violation probability."""
    timestep = Timestep(*step(world, action, key))
    # An episode ends with the first such step.
    return timestep._replace(cost=jnp.where(timestep.world.verdict == Verdict.VIOLATED, 1.0, 0.0))
