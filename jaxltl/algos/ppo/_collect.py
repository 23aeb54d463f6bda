"""Transitions of parallel environments, and their generalised advantages."""

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
from jaxltl.algos.ppo.state import Hparams, Problem, State, Walkers
from jaxltl.core.array_types import Key, PyTree
from jaxltl.core.environments.environment import Environment
from jaxltl.core.models.mesh import lanes


class Rows(NamedTuple):
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


class _Record(NamedTuple):
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
) -> tuple[State, PyTree, Rows, dict[str, jax.Array]]:
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
    found = generalized_advantages(reward, value, following, discount, hparams.gae_lambda, ended)
    seen = normalized(state.moments, path.observation)
    rows = Rows(seen, record.start, path.allowed, path.raw, path.log_density, value, found)
    number = ended.sum()
    mean_of = jnp.where(number > 0, 1 / jnp.maximum(number, 1), jnp.nan).astype(dtype)
    spread = jnp.var(found + value)
    figures = {
        "reward": path.reward.astype(dtype).mean(),
        "cost": path.cost.astype(dtype).mean(),
        "episodes": number.astype(jnp.int32),
        "episode_return": jnp.sum(jnp.where(ended, record.episode_return, 0)) * mean_of,
        "episode_length": jnp.sum(jnp.where(ended, record.episode_length, 0)) * mean_of,
        "explained_variance": jnp.where(
            spread > 0, 1 - jnp.var(found) / jnp.where(spread > 0, spread, 1), jnp.nan
        ),
        "permitted": jnp.bool_(True) if path.allowed is None else path.allowed.any(-1).all(),
        "finite": jnp.all(jnp.isfinite(found)),
    }
    after = replace(state, walkers=walkers, moments=moments, return_moments=returns)
    return after, state.walkers.memory, rows, figures


def _walked(key: Key, state: State, problem: Problem, hparams: Hparams) -> tuple[Walkers, _Record]:
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
    given: PyTree,
    *,
    sharding: NamedSharding | None,
) -> tuple[Walkers, _Record]:
    """Transitions of all environments, or of one device's."""
    run, hparams, pool = given
    problem, environment = run[0], run[0].environment

    def one(walker: Walkers, noise: jax.Array, key: Key) -> tuple[Walkers, _Record]:
        before = (walker.world, walker.memory)
        world, memory, made = transition(
            environment, partial(evaluate, run), hparams.squash, before, noise, key
        )
        row = _Record(
            of=made,
            start=walker.episode_length == 0,
            episode_return=walker.episode_return + made.reward,
            episode_length=walker.episode_length + 1,
            discounted=walker.discounted + made.reward.astype(walker.discounted.dtype),
        )
        return replace(walker, world=world, memory=memory), row

    def following(walker: Walkers, fresh: PyTree, row: _Record) -> Walkers:
        """The environment before its next transition, restarted at the end of an episode."""
        discount = jnp.asarray(hparams.discount * row.of.discount, row.discounted.dtype)
        figures = (row.episode_return, row.episode_length, discount * row.discounted)
        goes_on = Walkers(walker.world, walker.memory, *figures)
        restarted = Walkers(fresh, problem.memory, *jax.tree.map(jnp.zeros_like, figures))
        ended = row.of.terminated | row.of.truncated
        return jax.tree.map(partial(jnp.where, ended), restarted, goes_on)

    def move(carry: PyTree, given: PyTree) -> PyTree:
        walkers, used = carry
        start, *chance = given
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
