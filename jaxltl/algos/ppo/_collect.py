"""Transitions of parallel environments, and their generalised advantages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.sharding import NamedSharding

from jaxltl.algos.common import action_distributions as actions_of, loops, trees
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


def collected(
    key: Key, state: State, problem: Problem, hparams: Hparams
) -> tuple[State, PyTree, Rows, dict[str, jax.Array]]:
    """T transitions of N environments: the next state, initial memories, transitions, and figures."""
    walkers, record = _walked(key, state, problem, hparams)
    path = record.of
    dtype = walkers.discounted.dtype
    seen = normalized(state.moments, path.observation)
    every = _evaluated_all(problem, state.parameters, path.memory, seen, 2)
    end = jax.vmap(problem.environment.observe)(walkers.world)
    final = _evaluated_all(
        problem, state.parameters, walkers.memory, normalized(state.moments, end), 1
    )
    value, last = every.value.astype(dtype), final.value.astype(dtype)
    following = jnp.concatenate([value[1:], last[None]])
    cut = path.truncated & ~path.terminated
    at_ends = lanes.shard_function(_at_ends, hparams.sharding, (1, 1, 1, None), 1)
    following = at_ends(
        cut, following, (every.memory, path.last), (problem, state.parameters, state.moments)
    )
    following = jnp.where(path.terminated, 0, following)
    discount = jnp.asarray(hparams.discount, dtype) * path.discount.astype(dtype)
    reward, ended = path.reward.astype(dtype), path.terminated | path.truncated
    moments, returns = state.moments, state.return_moments
    if returns is not None:
        sums, walkers = _discounted_sums(walkers, reward, discount, ended)
        returns = _unless_nonfinite(returns, sums)
        reward = jnp.clip(reward / scale_of(returns), -10, 10)
    if moments is not None:
        moments = jax.tree.map(lambda x, m: _unless_nonfinite(m, x), path.observation, moments)
    found = generalized_advantages(reward, value, following, discount, hparams.gae_lambda, ended)
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


def _discounted_sums(
    walkers: Walkers, reward: jax.Array, discount: jax.Array, ended: jax.Array
) -> tuple[jax.Array, Walkers]:
    """``float[T, N]``, discounted rewards of each episode so far, and the environments with the last."""

    def on(before: jax.Array, row: PyTree) -> tuple[jax.Array, jax.Array]:
        reward, discount, ended = row
        now = before + reward
        return jnp.where(ended, 0, discount * now), now

    last, sums = lax.scan(on, walkers.discounted, (reward, discount, ended))
    return sums, replace(walkers, discounted=last)


def _walked(key: Key, state: State, problem: Problem, hparams: Hparams) -> tuple[Walkers, _Record]:
    environment, size = problem.environment, (hparams.num_steps, hparams.num_envs)
    noise_key, move_key, reset_key = jax.random.split(key, 3)
    dtype = state.walkers.discounted.dtype
    # All at once: on few numbers an operation takes as long as on many.
    noise = actions_of.noise(noise_key, size, environment.actions, dtype)
    keys = jax.random.split(move_key, size)
    begin, pool = _starts(reset_key, environment, hparams)
    step = (state.parameters, state.moments, problem, hparams, pool)
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
    parameters, moments, problem, hparams, pool = given
    environment = problem.environment

    def evaluate(memory: PyTree, observation: PyTree) -> Output:
        return evaluated(problem, parameters, memory, normalized(moments, observation))

    def one(walker: Walkers, noise: jax.Array, key: Key) -> tuple[Walkers, _Record]:
        before = (walker.world, walker.memory)
        world, memory, made = transition(environment, evaluate, hparams.squash, before, noise, key)
        total, length = walker.episode_return + made.reward, walker.episode_length + 1
        row = _Record(made, walker.episode_length == 0, total, length)
        return replace(walker, world=world, memory=memory), row

    def restarted(walker: Walkers, fresh: PyTree, row: _Record) -> Walkers:
        ended = row.of.terminated | row.of.truncated
        world, memory = jax.tree.map(
            lambda x, y: jnp.where(ended, x, y),
            (fresh, problem.memory),
            (walker.world, walker.memory),
        )
        return Walkers(
            world,
            memory,
            jnp.where(ended, 0, row.episode_return),
            jnp.where(ended, 0, row.episode_length),
            walker.discounted,
        )

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
        return (jax.vmap(restarted)(walkers, start, row), used), row

    (walkers, _), path = lax.scan(move, (walkers, jnp.int32(0)), rows)
    return walkers, path


def _starts(key: Key, environment: Environment, hparams: Hparams) -> tuple[PyTree, PyTree]:
    """Initial states or keys ``[T, N]`` of the episodes that begin, or a pool of initial states."""
    size, number = (hparams.num_steps, hparams.num_envs), hparams.num_resets
    if number:
        return None, jax.vmap(environment.reset)(jax.random.split(key, number))
    keys = jax.random.split(key, size)
    return (keys if number == 0 else jax.vmap(jax.vmap(environment.reset))(keys)), None


def _evaluated_all(
    problem: Problem, parameters: PyTree, memory: PyTree, observation: PyTree, num_axes: int
) -> Output:
    """Outputs of the network for observations with `num_axes` leading axes."""
    function: Callable[..., Output] = partial(evaluated, problem, parameters)
    for _ in range(num_axes):
        function = jax.vmap(function)
    return function(memory, observation)


def _at_ends(cut: jax.Array, following: jax.Array, ends: PyTree, judge: PyTree) -> jax.Array:
    """Next values, with those at truncated observations, which are rare, inserted batch by batch."""
    size, some = cut.size, min(cut.size, max(cut.shape[1], 32))
    problem, parameters, moments = judge
    flat = jax.tree.map(lambda x: x.reshape(size, *x.shape[2:]), ends)
    place = jnp.nonzero(cut.ravel(), size=size, fill_value=size)[0]
    place = jnp.concatenate([place, jnp.full(some, size, place.dtype)])

    def active(carry: PyTree, given: PyTree) -> jax.Array:
        return carry[0] * some < given[0]

    def body(carry: PyTree, given: PyTree) -> PyTree:
        turn, values = carry
        _, place, (memory, last), moments, parameters = given
        chosen = lax.dynamic_slice(place, (turn * some,), (some,))
        rows = jax.tree.map(lambda x: x[jnp.minimum(chosen, size - 1)], (memory, last))
        found = _evaluated_all(problem, parameters, rows[0], normalized(moments, rows[1]), 1)
        values = values.at[chosen].set(found.value.astype(values.dtype), mode="drop")
        return turn + active(carry, given), values

    given = cut.sum(), place, flat, moments, parameters
    _, values = loops.while_active(active, body, (jnp.int32(0), following.ravel()), given)
    return values.reshape(following.shape)
