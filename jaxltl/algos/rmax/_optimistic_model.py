"""The optimistic model of R-max: after news, its solution, and the constants of both.

The state, the problem and the hyperparameters are those of :mod:`~jaxltl.algos.rmax`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp

from jaxltl.algos.common import learner, pac
from jaxltl.algos.common.play import take
from jaxltl.algos.rmax._walk import Walk
from jaxltl.core.values.discounted.warm_start import span_iteration


def updated(state: Any, walk: Walk, problem: Any, hparams: Any) -> Any:
    """The state after a walk; with something new, the model and the strategy are too."""
    game, news = problem.game, walk.known | walk.fresh
    place = jnp.divmod(walk.pair, game.num_actions)
    probability, share = state.probability, take(state.probability, place)
    if game.num_successors > 1:
        # Every listed successor is taken to have been seen once, which keeps the graph.
        listed = take(game.mdp.probability, place) > 0
        row = jnp.where(listed, jnp.maximum(take(walk.counts, place), 1), 0)
        share = jnp.where(walk.known, row / jnp.sum(row).astype(game.dtype), share)
        probability = probability.at[place].set(share, mode="promise_in_bounds")
    gain = jnp.sum(share * take(walk.reward, place))
    since = jnp.where(walk.known, walk.moves, take(state.known_at, place))
    gain = jnp.where(news, gain, take(state.gain, place))
    state = replace(
        state,
        moves=walk.moves,
        position=walk.position,
        fault=walk.fault,
        counts=walk.counts,
        reward=walk.reward,
        probability=probability,
        known_at=state.known_at.at[place].set(since, mode="promise_in_bounds"),
        gain=state.gain.at[place].set(gain, mode="promise_in_bounds"),
        num_known=state.num_known + walk.known,
        last_update=jnp.where(news, walk.moves, state.last_update),
        num_updates=state.num_updates + news,
    )
    return _solved(state, problem, hparams, news)


def _solved(state: Any, problem: Any, hparams: Any, news: jax.Array) -> Any:
    """The optimistic model's value and near-optimal moves; the same state without news."""
    given = (state.gain, state.probability, problem, hparams)
    # A loop of one pass, which is left out where no lane has news.
    value, error, best, _ = learner.while_active(
        lambda now, _: now[-1], _solve, (state.value, state.error, state.best, news), given
    )
    # Every allowed move then has a positive probability, unless that is too small a number.
    least = exploration(problem, hparams) / problem.game.num_actions
    return replace(
        state,
        value=value,
        error=error,
        best=best,
        always_almost_sure=state.always_almost_sure & (least > 0),
    )


def _solve(now: Any, given: Any) -> Any:
    value, error, best, news = now
    gain, probability, problem, hparams = given
    dtype = problem.game.dtype
    discount = jnp.asarray(hparams.discount, dtype)
    value, width, quantity = span_iteration(
        problem.game,
        problem.allowed,
        gain,
        probability,
        value,
        discount,
        enough=solver_tolerance(problem, hparams),
        active=news,
    )
    # What is within eps_1 by these values less twice their error is within eps_1 by the true.
    asked = pac.action_tolerance(hparams.epsilon, hparams.discount)
    strict = jnp.maximum(asked - 2 * width, 0).astype(dtype)
    mine = problem.allowed & problem.game.system[:, None]
    near = pac.near_optimal(quantity, mine, strict)
    return value, jnp.where(news, width, error), jnp.where(news, near, best), jnp.zeros_like(news)


def unknown_reward(hparams: Any) -> jax.Array:
    """What an unknown move is taken to pay."""
    return jnp.asarray(hparams.reward_bound) / (1 - jnp.asarray(hparams.discount))


def exploration(problem: Any, hparams: Any) -> jax.Array:
    """The chance of any allowed move in place of a preferred one."""
    p = pac.exploration(hparams.epsilon, hparams.discount, hparams.reward_bound)
    return jnp.asarray(p, problem.game.dtype)


def enough(problem: Any, hparams: Any) -> jax.Array:
    """Visits after which a pair is known."""
    if hparams.known_after is not None:
        return jnp.asarray(hparams.known_after, problem.game.dtype)
    visits = pac.visits(
        hparams.epsilon,
        hparams.failure,
        hparams.discount,
        hparams.reward_bound,
        jnp.sum(problem.region),
        problem.game.num_actions,
    )
    return jnp.asarray(visits, problem.game.dtype)


def solver_tolerance(problem: Any, hparams: Any) -> jax.Array:
    """The error of the optimistic model's value at which a solve ends."""
    dtype = problem.game.dtype
    asked = pac.action_tolerance(hparams.epsilon, hparams.discount) / 4
    left = 1 - jnp.asarray(hparams.discount, dtype)
    rounding = 8 * jnp.finfo(dtype).eps * jnp.asarray(unknown_reward(hparams), dtype) / left
    return jnp.maximum(asked, rounding).astype(dtype)
