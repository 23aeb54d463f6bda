"""Problems and settings of PPO; transitions of parallel environments, and their advantages."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import NamedSharding

from jaxltl.algos.common import action_distributions as actions_of, trees
from jaxltl.algos.common.actor_critic import Output, evaluated
from jaxltl.algos.common.collection import Transition, generalized_advantages, transition
from jaxltl.algos.common.moments import Moments, normalized, scale_of, updated_moments
from jaxltl.algos.common.networks import NetworkLike
from jaxltl.algos.common.schedules import Schedule
from jaxltl.algos.common.settings import COUNT, MAX_INT, Number, RunState, static, traced
from jaxltl.core import struct
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import Environment
from jaxltl.core.models.mesh import lanes
from jaxltl.core.validation import Range


@struct.dataclass
class Problem:
    """An environment and a network; made by :func:`make_problem`.

    Attributes:
      environment: with finitely many actions, or a box of floats.
      memory: initial memory of the network, a tree of arrays; ``()`` without memory.
      network: static.
    """

    environment: Environment
    memory: PyTree
    network: NetworkLike = struct.field(pytree_node=False)


@struct.dataclass
class Hparams:
    """Settings; numbers are traced, None is static.

    A *schedule* is a number, ``schedules.Linear(first, last, num_steps)``, ``schedules.Polynomial``, or
    a ``Partial(function)`` of the number of the step from 1.

    Attributes:
      discount: of rewards, in [0, 1]; multiplied by the environment's.
      gae_lambda: of the advantages: 1 has no bias, 0 least variance; default 0.95.
      learning_rate: of Adam; a schedule; default 2.5e-4.
      clip: bound on the change of the probability ratio in the surrogate; a schedule; default 0.2.
      value_clip: bound on the change of values in their loss; a schedule, or None; default None.
      value_weight: of half the squared error of values; default 0.5.
      entropy_weight: of the entropy of the actions; default 0.01.
      max_gradient_norm: gradients are clipped to this norm, or None; default 0.5.
      target_kl: updates of a step stop when a minibatch's estimated divergence from the collecting
        policy exceeds it, or None; default None.
      adam_epsilon: of Adam; default 1e-5.
      num_envs: N, parallel environments; static; default 8.
      num_steps: T, transitions of each of them in a step; static; default 128.
      num_epochs: passes over the collected transitions; static; default 4.
      num_minibatches: of each pass; with a recurrent network of whole environments; static; default 4.
      normalize_advantage: standardises advantages in each minibatch; static; default True.
      normalize_observation: standardises the floats of observations by their moments up to the last
        step, clipped to ten deviations; static; default False.
      normalize_reward: divides rewards by the standard deviation of discounted sums of rewards so far,
        and clips them to ten; static; default False.
      squash: map of a Gaussian action into its box: ``"clip"``, or ``"tanh"`` along axes with both
        bounds; static. Networks use units in which such axes are [-1, 1]. Default ``"clip"``.
      num_resets: initial states drawn before the T transitions of a step; static. None: T N, one for
        every possible end: fast, and takes memory. 0: N in each transition, with the same results.
        Another number: that many, used cyclically. Default None.
      sharding: of the environments and of each minibatch, such as
        ``NamedSharding(mesh, PartitionSpec("environments"))``; static. Runs are equal up to the order
        of sums; collected transitions are replicated once for each step. Default None.
    """

    discount: Number = traced("closed_discount")
    gae_lambda: Number = traced(Range(0, 1), default=0.95)
    learning_rate: Schedule = traced(Range(0, open_above=True), default=2.5e-4, schedule=True)
    clip: Schedule = traced(Range(0), default=0.2, schedule=True)
    value_clip: Schedule | None = traced(Range(0), default=None, schedule=True)
    value_weight: Number = traced(Range(0, open_above=True), default=0.5)
    entropy_weight: Number = traced(Range(0, open_above=True), default=0.01)
    max_gradient_norm: Number | None = traced(Range(0), default=0.5)
    target_kl: Number | None = traced(Range(0), default=None)
    adam_epsilon: Number = traced(Range(0, open_above=True), default=1e-5)
    num_envs: int = static(COUNT, default=8)
    num_steps: int = static(COUNT, default=128)
    num_epochs: int = static(COUNT, default=4)
    num_minibatches: int = static(COUNT, default=4)
    normalize_advantage: bool = static(bool, default=True)
    normalize_observation: bool = static(bool, default=False)
    normalize_reward: bool = static(bool, default=False)
    squash: str = static(actions_of.SQUASHES, default="clip")
    num_resets: int | None = static(Range(0, MAX_INT, integer=True), default=None)
    sharding: NamedSharding | None = struct.field(pytree_node=False, default=None)


@struct.dataclass
class Walkers:
    """N parallel environments: states, memories, and figures of their current episodes, ``[N, ...]``."""

    world: PyTree
    memory: PyTree
    episode_return: jax.Array
    episode_length: jax.Array
    discounted: jax.Array


@struct.dataclass
class State(RunState):
    """A policy, its optimiser, and the environments.

    Attributes:
      parameters: of the network, a pytree.
      optimizer: optax's state.
      walkers: the N environments.
      moments: of the floats of observations, a tree of the observation's structure; or None.
      return_moments: of discounted sums of rewards; or None.
      transitions: ``int32[]``, of environments so far; saturates at 2^31 - 1.
    """

    parameters: PyTree
    optimizer: PyTree
    walkers: Walkers
    moments: PyTree
    return_moments: Moments | None
    transitions: jax.Array


@struct.dataclass
class Metrics:
    """Figures of a step; scalars. Those of episodes are of the policy before it.

    Attributes:
      transitions: of environments so far.
      reward, cost: mean of a transition.
      episodes, episode_return, episode_length: number of episodes that ended, and their mean
        undiscounted return and length; NaN without any.
      policy_loss, value_loss, entropy: mean parts of the loss over the updates.
      kl: mean estimate of the divergence from the collecting policy, ``mean(r - 1 - log r)``.
      clip_fraction: share of clipped ratios.
      gradient_norm, learning_rate: mean before clipping, and rate of this step.
      explained_variance: share of the variance of the values' targets that values explained.
      updates, nonfinite: minibatches that changed the parameters, and those skipped because a number
        was not finite.
      status: COMPLETED; NONFINITE if `nonfinite` is positive or an advantage was not finite; INVALID if
        no action was allowed somewhere (the first is taken there, and parameters stay unchanged).
    """

    transitions: jax.Array
    reward: jax.Array
    cost: jax.Array
    episodes: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    policy_loss: jax.Array
    value_loss: jax.Array
    entropy: jax.Array
    kl: jax.Array
    clip_fraction: jax.Array
    gradient_norm: jax.Array
    explained_variance: jax.Array
    learning_rate: jax.Array
    updates: jax.Array
    nonfinite: jax.Array
    status: jax.Array


class TransitionRows(NamedTuple):
    """Transitions ``[T, N, ...]``, flattened, or a minibatch; observations are normalised."""

    observation: PyTree
    start: jax.Array
    allowed: jax.Array | None
    raw: jax.Array
    log_density: jax.Array
    value: jax.Array
    advantage: jax.Array


def _unless_nonfinite(moments: Moments, numbers: jax.Array) -> Moments:
    """Moments with a batch added, or unchanged if a number of it is not finite."""
    new = updated_moments(moments, numbers)
    fine = jnp.all(jnp.isfinite(new.mean)) & jnp.all(jnp.isfinite(new.squares))
    return trees.choose(fine, new, moments)


class _TransitionRecord(NamedTuple):
    """Records of the transitions, ``[T, N, ...]``, and figures of their episodes so far."""

    of: Transition
    start: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    discounted: jax.Array


def evaluate(run: tuple[Problem, PyTree, PyTree], memory: PyTree, observation: PyTree) -> Output:
    """The network's output for an observation that is not normalised yet."""
    problem, parameters, moments = run
    return evaluated(problem, parameters, memory, normalized(moments, observation))


def collected(
    key: Key, state: State, problem: Problem, hparams: Hparams
) -> tuple[State, PyTree, TransitionRows, dict[str, jax.Array]]:
    """T transitions of N environments: the next state, initial memories, transitions, and figures."""
    walkers, record = _walked(key, state, problem, hparams)
    path = record.of
    dtype = walkers.discounted.dtype
    look = partial(evaluate, (problem, state.parameters, state.moments))
    before = jax.vmap(jax.vmap(look))(path.memory, path.observation)
    ahead = jax.vmap(jax.vmap(look))(before.memory, path.last)
    value, following = (x.value.astype(dtype) for x in (before, ahead))
    following = jnp.where(path.terminated, 0, following)
    discount = jnp.asarray(hparams.discount, dtype) * path.discount.astype(dtype)
    reward, ended = path.reward.astype(dtype), path.terminated | path.truncated
    moments, returns = state.moments, state.return_moments
    if returns is not None:
        returns = _unless_nonfinite(returns, record.discounted)
        reward = jnp.clip(reward / scale_of(returns), -10, 10)
    if moments is not None:
        moments = jax.tree.map(lambda x, m: _unless_nonfinite(m, x), path.observation, moments)
    advantage = generalized_advantages(
        reward, value, following, discount, hparams.gae_lambda, ended
    )
    seen = normalized(state.moments, path.observation)
    rows = TransitionRows(
        seen, record.start, path.allowed, path.raw, path.log_density, value, advantage
    )
    number = ended.sum()
    mean_of = jnp.where(number > 0, 1 / jnp.maximum(number, 1), jnp.nan).astype(dtype)
    variance = jnp.var(advantage + value)
    figures = {
        "reward": path.reward.astype(dtype).mean(),
        "cost": path.cost.astype(dtype).mean(),
        "episodes": number.astype(jnp.int32),
        "episode_return": jnp.sum(jnp.where(ended, record.episode_return, 0)) * mean_of,
        "episode_length": jnp.sum(jnp.where(ended, record.episode_length, 0)) * mean_of,
        "explained_variance": jnp.where(
            variance > 0, 1 - jnp.var(advantage) / jnp.where(variance > 0, variance, 1), jnp.nan
        ),
        "permitted": jnp.bool_(True) if path.allowed is None else path.allowed.any(-1).all(),
        "finite": jnp.all(jnp.isfinite(advantage)),
    }
    after = replace(state, walkers=walkers, moments=moments, return_moments=returns)
    return after, state.walkers.memory, rows, figures


def _walked(
    key: Key, state: State, problem: Problem, hparams: Hparams
) -> tuple[Walkers, _TransitionRecord]:
    environment, size = problem.environment, (hparams.num_steps, hparams.num_envs)
    noise_key, move_key, reset_key = jax.random.split(key, 3)
    dtype = state.walkers.discounted.dtype
    # All at once: on few numbers an operation takes as long as on many.
    noise = actions_of.noise(noise_key, size, environment.actions, dtype)
    keys = jax.random.split(move_key, size)
    begin, pool = _starts(reset_key, environment, hparams)
    step = ((problem, state.parameters, state.moments), hparams, pool)
    walk = lanes.shard_function(
        partial(_walk, sharding=hparams.sharding), hparams.sharding, (0, 0, 1, None), (0, 1)
    )
    rows = (begin, noise, keys)
    walkers, path = walk(lanes.device_ranks(hparams.sharding), state.walkers, rows, step)
    return trees.strong(walkers), path


def _walk(
    rank: jax.Array,
    walkers: Walkers,
    rows: PyTree,
    step: PyTree,
    *,
    sharding: NamedSharding | None,
) -> tuple[Walkers, _TransitionRecord]:
    """Transitions of all environments, or of one device's."""
    run, hparams, pool = step
    problem, environment = run[0], run[0].environment

    def one(walker: Walkers, noise: jax.Array, key: Key) -> tuple[Walkers, _TransitionRecord]:
        before = (walker.world, walker.memory)
        world, memory, record = transition(
            key, environment, partial(evaluate, run), hparams.squash, before, noise
        )
        row = _TransitionRecord(
            of=record,
            start=walker.episode_length == 0,
            episode_return=walker.episode_return + record.reward,
            episode_length=walker.episode_length + 1,
            discounted=walker.discounted + record.reward.astype(walker.discounted.dtype),
        )
        return replace(walker, world=world, memory=memory), row

    def following(walker: Walkers, fresh: PyTree, row: _TransitionRecord) -> Walkers:
        """The environment before its next transition, restarted at the end of an episode."""
        discount = jnp.asarray(hparams.discount * row.of.discount, row.discounted.dtype)
        figures = (row.episode_return, row.episode_length, discount * row.discounted)
        goes_on = Walkers(walker.world, walker.memory, *figures)
        restarted = Walkers(fresh, problem.memory, *jax.tree.map(jnp.zeros_like, figures))
        ended = row.of.terminated | row.of.truncated
        return jax.tree.map(partial(jnp.where, ended), restarted, goes_on)

    def move(carry: PyTree, inputs: PyTree) -> PyTree:
        walkers, used = carry
        start, *chance = inputs
        walkers, row = jax.vmap(one)(walkers, *chance)
        if pool is not None:
            number, last = lanes.running_sum(row.of.terminated | row.of.truncated, rank, sharding)
            start = jax.tree.map(lambda x: x[(used + number - 1) % hparams.num_resets], pool)
            used = (used + last) % hparams.num_resets
        elif hparams.num_resets == 0:
            start = jax.vmap(environment.reset)(start)
        return (jax.vmap(following)(walkers, start, row), used), row

    (walkers, _), path = lax.scan(move, (walkers, jnp.int32(0)), rows)
    return walkers, path


def _starts(key: Key, environment: Environment, hparams: Hparams) -> tuple[PyTree, PyTree]:
    """Initial states or keys ``[T, N]`` of the episodes that begin, or a pool of initial states."""
    size, number = (hparams.num_steps, hparams.num_envs), hparams.num_resets
    if number:
        return None, jax.vmap(environment.reset)(jax.random.split(key, number))
    keys = jax.random.split(key, size)
    return (keys if number == 0 else jax.vmap(jax.vmap(environment.reset))(keys)), None
