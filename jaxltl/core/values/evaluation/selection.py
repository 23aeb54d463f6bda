"""Selection of the best of several agents by simulated episodes, without selection bias."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import chex
import jax
import numpy as np

from jaxltl.core import validation
from jaxltl.core.automata import Automaton
from jaxltl.core.environments.environment import Environment
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.environments.task_environment import task_tables, with_task_tables
from jaxltl.core.policies.episode_statistics import Evaluation
from jaxltl.core.values.evaluation.evaluation import evaluate


def select_agent(
    key: chex.PRNGKey,
    agents: Sequence[Agent],
    environment: Environment,
    automaton: Automaton,
    *,
    num_episodes: int = 1000,
    num_steps: int | None = None,
    confidence: float = 0.95,
    threshold: float | None = None,
    discount: float | None = None,
    report: Callable[[str], None] = lambda stage: None,
) -> tuple[int, list[Evaluation]]:
    """Index of the best of several agents of a task, and evaluations of all by fresh episodes.

    Agents are compared by their frequencies in episodes apart from those of the evaluations, so that
    the intervals of the selected one have no selection bias. The criterion is lexicographic: of a
    safety formula fewest violations, of a co-safe formula most successes, then fewest violations and
    shortest episodes; of others successes less violations, then accepting visits. Rewards are those of
    the formula, without shaping.

    Args:
      key: random key; the third of ``jax.random.split(key, 3)`` is not used.
      agents: one for each seed, for example.
      environment: with a task.
      automaton: of the task's formula.
      num_episodes, num_steps, confidence, threshold, discount: of
        :func:`~jaxltl.core.values.evaluation.evaluation.evaluate`; the threshold is tested for the
        selected agent alone.
      report: function that is called with the stages ``"choosing"`` and ``"evaluating"``.

    Returns:
      The index of the selected agent, and an evaluation of each.

    Raises:
      ValueError: no agent, an environment without a task, or an argument that `evaluate` refuses.

    Example:
      >>> import jax.numpy as jnp
      >>> import jaxltl as jl
      >>> from jaxltl.core.environments import make_agent, model_environment
      >>> world = jl.gridworld("home . goal", initial="home")
      >>> task = jl.task_environment(model_environment(world), "F goal")
      >>> left, right = (make_agent(lambda seen, key, a=a: jnp.int32(a)) for a in (2, 3))
      >>> best, each = select_agent(jax.random.key(0), [left, right], task, jl.to_automaton("F goal"),
      ...                           num_episodes=10, num_steps=4)
      >>> best, [x.success.mean for x in each]
      (1, [0.0, 1.0])
    """
    if not agents:
        raise ValueError("agents is empty; give at least one.")
    validation.instance("automaton", automaton, Automaton, "the automaton of the task's formula")
    plain, keys = without_shaping(environment), jax.random.split(key, 3)

    def estimate(key: chex.PRNGKey, agent: Agent, threshold: float | None) -> Evaluation:
        return evaluate(
            key,
            agent,
            plain,
            num_episodes=num_episodes,
            num_steps=num_steps,
            confidence=confidence,
            discount=discount,
            threshold=threshold,
        )

    chosen = 0
    if len(agents) > 1:
        report("choosing")
        merit = [_merit(automaton, estimate(keys[0], agent, None)) for agent in agents]
        chosen = merit.index(max(merit))
    report("evaluating")
    tests = [threshold if i == chosen else None for i in range(len(agents))]
    return chosen, [estimate(keys[1], *each) for each in zip(agents, tests, strict=True)]


def without_shaping(environment: Environment) -> Environment:
    """A task `environment` with the reward of the formula alone."""
    tables = task_tables(environment)
    flat = np.zeros_like(np.asarray(tables.potential))
    return with_task_tables(environment, replace(tables, potential=flat))


def _merit(automaton: Automaton, evaluation: Evaluation) -> tuple[float, float, float]:
    success, violation, visits = evaluation.success, evaluation.violation, evaluation.visits
    assert success is not None and violation is not None and visits is not None
    if automaton.is_safety:  # an undecided episode does not violate it
        return -violation.mean, success.mean, 0.0
    if automaton.is_cosafe:
        return success.mean, -violation.mean, -evaluation.length.mean
    return success.mean - violation.mean, visits.mean, 0.0
