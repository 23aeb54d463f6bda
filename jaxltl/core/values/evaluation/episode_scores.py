"""Objective and costs of a policy, estimated from episodes for parameter search."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import chex
import jax
import jax.numpy as jnp
from jaxltl.core import struct, validation
from jax.tree_util import Partial

from jaxltl.core.environments.environment import Environment, as_partial, require_environment
from jaxltl.core.environments.episodes import Agent
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.values.evaluation.evaluation import (
    EpisodeTotals,
    checked_steps,
    episode_totals,
    task_world,
)

Score = str | Callable[[EpisodeTotals], chex.Numeric]

SUMS = ("reward", "discounted_reward", "cost", "length")
OF_TASKS = ("success", "failure", "violation", "undecided", "visits", "discounted_visits")


@struct.dataclass
class _Scores:
    """Settings: quantities to estimate and number of episodes; static."""

    objective: Score = struct.field(pytree_node=False)
    costs: tuple[Score, ...] = struct.field(pytree_node=False)
    num_episodes: int = struct.field(pytree_node=False)
    num_steps: int = struct.field(pytree_node=False)


def episode_evaluator(
    environment: Environment,
    agent: Callable[..., Agent],
    *,
    objective: Score = "reward",
    costs: Score | Sequence[Score] = (),
    num_episodes: int = 10,
    num_steps: int | None = None,
    discount: chex.Numeric = 1.0,
) -> Partial:
    """``evaluate(parameters, key) -> (objective, costs)`` of a policy, means over episodes.

    Scores are fields of :class:`~jaxltl.core.values.evaluation.evaluation.EpisodeTotals` by name
    or function of the totals; with a task also the shares ``"success"``, ``"violation"``,
    ``"undecided"`` and ``"failure"`` (``1 - success``).

    Args:
      environment: plain or with a task.
      agent: ``parameters -> Agent``, such as of :func:`~jaxltl.envs.networks.network_agent`.
      objective: the score to be maximised.
      costs: a score, or several.
      num_episodes: M, of each evaluation.
      num_steps: maximal length of an episode; default the environment's horizon.
      discount: of ``"discounted_reward"`` and ``"discounted_visits"``.

    Returns:
      A pytree; ``evaluate(parameters, key)`` under ``jit`` and ``vmap``. One cost is a number,
      several are ``float[C]``. Episode i has the key ``split(key, M)[i]``. Differentiable in
      forward mode only: an episode is a ``while_loop``.

    Raises:
      ValueError: an unknown score, one of a task without a task, episodes that never end, or no
        episodes.

    Example:
      >>> from jaxltl import make_environment
      >>> from jaxltl.core.environments import Timestep, make_agent, make_box
      >>> def step(place, action, key):
      ...     return Timestep(place + action, -jnp.sum(place**2), False, cost=jnp.sum(action**2))
      >>> cart = make_environment(
      ...     lambda key: jnp.ones(1), step, lambda place: place,
      ...     actions=make_box(-1, 1, (1,)), horizon=3)
      >>> def proportional(gain):
      ...     return make_agent(jax.tree_util.Partial(lambda gain, place, key: -gain * place, gain))
      >>> evaluate = episode_evaluator(cart, proportional, costs="cost")
      >>> [float(x) for x in evaluate(jnp.array([0.5]), jax.random.key(0))]
      [-1.3125, 0.328125]
    """
    num_episodes = validation.integer("num_episodes", num_episodes, least=1, limit=2**31 - 1)
    several = (
        (costs,)
        if isinstance(costs, str) or callable(costs)
        else tuple(validation.sequence("costs", costs))
    )
    environment = require_environment(environment)
    task = task_world(jax.eval_shape(environment.reset, jax.random.key(0)))
    names = SUMS if task is None else SUMS + OF_TASKS
    for score in (objective, *several):
        if not callable(score) and not (isinstance(score, str) and score in names):
            of_task = isinstance(score, str) and score in OF_TASKS
            why = "needs a task, which task_environment gives" if of_task else "is none"
            raise ValueError(
                f"the score {validation.shorten(score)} {why}; choose one of {', '.join(names)}, or "
                "give a function of the totals."
            )
    settings = _Scores(objective, several, num_episodes, checked_steps(environment, num_steps))
    if not isinstance(discount, jax.core.Tracer):
        validation.fraction("discount", discount)
    return Partial(_evaluate, settings, environment, as_partial(agent, "agent"), discount)


@jax.jit  # so that calls outside of jit share one compilation
def _evaluate(
    settings: _Scores,
    environment: Environment,
    agent: Callable[..., Agent],
    discount: chex.Numeric,
    parameters: chex.Array,
    key: chex.PRNGKey,
) -> jax.Array | tuple[jax.Array, jax.Array]:
    run = partial(
        episode_totals,
        environment=environment,
        agent=agent(parameters),
        num_steps=settings.num_steps,
        discount=discount,
    )
    totals = jax.vmap(run)(jax.random.split(key, settings.num_episodes))

    def mean(score: Score) -> jax.Array:
        return jnp.mean(jax.vmap(partial(_of_one, score))(totals).astype(jnp.result_type(float)))

    objective, costs = mean(settings.objective), [mean(score) for score in settings.costs]
    if not costs:
        return objective
    return objective, costs[0] if len(costs) == 1 else jnp.stack(costs)


_VERDICTS = {
    "success": Verdict.SATISFIED,
    "violation": Verdict.VIOLATED,
    "undecided": Verdict.UNDECIDED,
}


def _of_one(score: Score, totals: EpisodeTotals) -> jax.Array:
    if callable(score):
        return jnp.asarray(score(totals))
    if score in _VERDICTS:
        return jnp.asarray(totals.verdict == _VERDICTS[score])
    if score == "failure":
        return jnp.asarray(totals.verdict != Verdict.SATISFIED)
    result: jax.Array = getattr(totals, score)
    return result
