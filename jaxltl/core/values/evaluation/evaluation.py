"""Statistical evaluation of agents: frequencies and means over fresh episodes, with intervals.

With a task (:mod:`~jaxltl.core.environments.task_environment`) also the frequencies of satisfaction
and violation. Episodes are independent, so each interval is that of a binomial test or of a mean of
independent numbers. Estimates are for ``num_steps`` steps: other episodes count as undecided.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import NamedSharding
from jax.tree_util import Partial

from jaxltl.core import struct, validation
from jaxltl.core.environments.environment import (
    Environment,
    allowed_in,
    as_partial,
    require_environment,
    require_key,
    some_action,
)
from jaxltl.core.environments.episodes import Agent, begin_episode, continue_episode, require_agent
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.models.mesh.lanes import on_host, require_split, vmap_split
from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.policies.episode_statistics import (
    ESTIMATES as ESTIMATES,
    EpisodeTotals as EpisodeTotals,
    Estimate as Estimate,
    Evaluation as Evaluation,
    evaluation_of,
    frequency_estimate as frequency_estimate,
)
from jaxltl.core.pretty_print import brief
from jaxltl.core.statistics.binomial import anytime


def episode_totals(
    key: chex.PRNGKey,
    environment: Environment,
    agent: Agent,
    *,
    num_steps: int,
    discount: chex.Numeric = 1.0,
) -> EpisodeTotals:
    """Totals of the episode that ``run_episode`` returns for the same key, without its steps."""
    begin, path = begin_episode(key, environment, agent)
    task, number = task_world(begin.world), jnp.result_type(float)
    counted = hasattr(task, "accepted")
    zero, one = jnp.zeros((), number), jnp.ones((), number)

    def accepting(world: PyTree) -> jax.Array:
        return jnp.asarray(task_world(world).accepted) if counted else jnp.bool_(False)

    first = accepting(begin.world)
    sums = (zero, zero, zero, first.astype(jnp.int32), first.astype(number))

    def going(carry: PyTree) -> jax.Array:
        now, time, *_ = carry
        result: jax.Array = (time < num_steps) & ~(now.terminated | now.truncated)
        return result

    def move(carry: PyTree) -> PyTree:
        now, time, paid, factor, sums = carry
        now, transition = continue_episode(jax.random.fold_in(path, time), now, environment, agent)
        factor, read = factor * discount, accepting(now.world)
        reward, discounted, cost, visits, early = sums
        sums = (
            reward + transition.reward,
            discounted + paid * transition.reward,
            cost + transition.cost,
            visits + read.astype(jnp.int32),
            early + jnp.where(read, factor, 0),
        )
        sums = tuple(x.astype(y.dtype) for x, y in zip(sums, carry[-1], strict=True))
        paid = (paid * discount * transition.discount).astype(number)
        return now, time + 1, paid, factor.astype(number), sums

    now, time, _, _, sums = lax.while_loop(going, move, (begin, jnp.int32(0), one, one, sums))
    reward, discounted, cost, visits, early = sums
    task = task_world(now.world)
    return EpisodeTotals(
        reward,
        discounted,
        cost,
        time,
        now.terminated,
        now.truncated & ~now.terminated,
        None if task is None else jnp.asarray(task.verdict, jnp.int32),
        visits if counted else None,
        early if counted else None,
    )


def task_world(world: PyTree) -> PyTree:
    """The part of an environment's state that has a verdict, also nested; None without one."""

    def tells(x: object) -> bool:
        return hasattr(x, "verdict")

    return next(filter(tells, jax.tree.leaves(world, is_leaf=tells)), None)


@brief
@dataclass(frozen=True)
class Batch:
    """Episodes simulated at a time, and the devices among which they are split.

    Attributes:
      size: number of episodes; memory grows with it.
      sharding: a ``NamedSharding`` with the mesh axis over which episodes are split; all processes
        make the same call.

    Example:
      >>> Batch(size=64).sharding is None
      True
    """

    size: int = 256
    sharding: NamedSharding | None = None


def evaluate(
    key: chex.PRNGKey,
    agent: Agent,
    environment: Environment,
    *,
    num_episodes: int = 1000,
    num_steps: int | None = None,
    confidence: float = 0.95,
    threshold: float | None = None,
    discount: float | None = None,
    batch: int | Batch = 256,
) -> Evaluation:
    """Evaluates an agent: frequencies and means over fresh episodes, with confidence intervals.

    Episode i is ``run_episode(fold_in(key, i), environment, agent, num_steps=num_steps)`` for every
    batch size. Each interval alone holds with probability `confidence` (several at once: take
    ``1 - (1 - confidence) / number`` for each).

    - Shares of success, violation and undecided: exact by Clopper and Pearson (1934).
    - With a `threshold` the simulation stops after the first batch that decides it; the shares'
      intervals are then anytime-valid (Jeffreys' mixture; Ville; Robbins 1970), and the decision is
      wrong with probability at most ``1 - confidence``.
    - Lengths and visits: empirical Bernstein, anytime-valid (Waudby-Smith and Ramdas 2024, thm. 2).
    - Rewards and costs: Student's interval, by the central limit theorem for a fixed number.

    Args:
      key: random key.
      agent: such as ``ppo.policy(state, problem, hparams)``, or ``make_agent(function)``.
      environment: plain, or with a task.
      num_episodes: number of episodes; with a threshold at most.
      num_steps: maximal length of an episode; default the environment's horizon.
      confidence: of each interval, in (0, 1).
      threshold: on the success probability, in (0, 1).
      discount: in (0, 1), of `discounted_reward` and `discounted_visits`.
      batch: episodes simulated at a time, or a :class:`Batch` with a sharding.

    Returns:
      :class:`Evaluation`, on the host; not differentiable.

    Raises:
      ValueError: episodes that never end, a number out of range, a threshold without a task, an
        invalid agent, or invalid actions.

    Example:
      >>> from jaxltl import from_dense, task_environment
      >>> from jaxltl.core.environments import make_agent, model_environment
      >>> coin = from_dense(
      ...     [[[.0, .6, .4]], [[.0, 1., .0]], [[.0, .0, 1.]]], initial=[1, 0, 0],
      ...     label=[[0, 0], [1, 0], [0, 1]], propositions=["heads", "tails"])
      >>> task = task_environment(model_environment(coin), "!tails U heads")
      >>> agent = make_agent(lambda observation, key: jnp.int32(0))
      >>> found = evaluate(jax.random.key(0), agent, task, num_steps=5, threshold=0.8)
      >>> print(str(found).rpartition("\\n")[2].strip())
      success is not at least 0.8
    """
    environment = require_environment(environment)
    num_steps = checked_steps(environment, num_steps)
    limit = 2**31 - 1
    num_episodes = validation.integer("num_episodes", num_episodes, least=1, limit=limit)
    batch = batch if isinstance(batch, Batch) else Batch(batch)
    size = validation.integer("batch", batch.size, least=1, limit=limit)
    confidence = validation.fraction("confidence", confidence, ends=(False, False))
    if threshold is not None:
        threshold = validation.fraction("threshold", threshold, ends=(False, False))
    if discount is not None:
        discount = validation.fraction("discount", discount, ends=(False, False))
    require_key(key)
    require_split("sharding", batch.sharding)
    agent, world = _checked_agent(agent, environment)
    if threshold is not None and task_world(world) is None:
        raise ValueError(
            f"threshold={threshold}, but the environment has no task; make one with "
            "task_environment."
        )
    failure, parts, count, success, decision = 1 - confidence, [], 0, 0, None
    while count < num_episodes and decision is None:
        episodes = on_host(
            _batch(
                key,
                (environment, agent),
                jnp.int32(count),
                1.0 if discount is None else discount,
                num_steps=num_steps,
                batch=Batch(min(size, num_episodes), batch.sharding),
            )
        )
        parts.append(jax.tree.map(lambda x, limit=num_episodes - count: x[:limit], episodes))
        count += len(parts[-1].length)
        if threshold is not None:
            success += int((parts[-1].verdict == Verdict.SATISFIED).sum())
            decision = _decided(success, count, threshold, failure)
    totals = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    return evaluation_of(totals, num_steps, confidence, threshold, discount, decision)


@jit("num_steps", "batch")
def _batch(
    key: chex.PRNGKey,
    players: tuple[Environment, Agent],
    first: jax.Array,
    discount: chex.Numeric,
    *,
    num_steps: int,
    batch: Batch,
) -> EpisodeTotals:
    def one(
        key: chex.PRNGKey, players: tuple[Environment, Agent], discount: chex.Numeric
    ) -> EpisodeTotals:
        return episode_totals(key, *players, num_steps=num_steps, discount=discount)

    keys = jax.vmap(partial(jax.random.fold_in, key))(first + jnp.arange(batch.size))
    result: EpisodeTotals = vmap_split(one, batch.sharding, (0, None, None))(
        keys, players, discount
    )
    return result


def _decided(success: int, count: int, threshold: float, failure: float) -> bool | None:
    """True if the success probability is at least a threshold; None if undecided."""
    lower, upper = anytime(np.array([success]), np.array([count]), failure)
    if lower[0] >= threshold:
        return True
    return False if upper[0] < threshold else None


# --- checks ---------------------------------------------------------------------------------------


def checked_steps(environment: Environment, num_steps: int | None) -> int:
    """Number of steps after which episodes are truncated; ValueError if it is unknown."""
    steps = environment.horizon if num_steps is None else num_steps
    if steps is None:
        raise ValueError(
            "episodes that never end: neither the environment nor num_steps says after how many "
            "steps; give num_steps, or with_time_limit(environment, num_steps)."
        )
    return validation.integer("num_steps", steps, least=1, limit=2**31 - 1)


def _checked_agent(agent: object, environment: Environment) -> tuple[Agent, PyTree]:
    """The agent as a tree of arrays, checked against the environment; and the state's shapes."""
    agent = require_agent(agent)
    agent = replace(agent, act=as_partial(agent.act, "agent.act"))

    def first(key: chex.PRNGKey) -> tuple[PyTree, PyTree]:
        world = environment.reset(key)
        seen, mask = environment.observe(world), allowed_in(environment, world)
        return agent.act(agent.memory, seen, mask, key)[0], world

    action, world = jax.eval_shape(first, jax.random.key(0))
    space = some_action(environment.actions)
    whole = jnp.issubdtype(space.dtype, jnp.integer)
    if getattr(action, "shape", None) != space.shape or (
        whole and not jnp.issubdtype(action.dtype, jnp.integer)
    ):
        raise ValueError(
            f"the agent's action is {action}; the environment takes {space.dtype}"
            f"{list(space.shape)}."
        )
    return agent, world


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
