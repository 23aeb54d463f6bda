"""The optimistic model of R-max: its update by observations, its solution, and its constants."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxltl.algos.common import loops, pac
from jaxltl.algos.common.play import take
from jaxltl.algos.rmax._rollout import Rollout
from jaxltl.algos.rmax.problem import Problem
from jaxltl.algos.rmax.state import Hparams, State
from jaxltl.core.values.discounted.warm_start import Models, span_iteration


def update_model(state: State, rollout: Rollout, problem: Problem, hparams: Hparams) -> State:
    """The state after a rollout, with the model solved again if it changed."""
    game, changed = problem.game, rollout.known | rollout.fresh
    place = jnp.divmod(rollout.pair, game.num_actions)
    probability, row = state.probability, take(state.probability, place)
    if game.num_successors > 1:
        # Every listed successor counts as observed at least once, which keeps the graph.
        listed = take(game.mdp.probability, place) > 0
        count = jnp.where(listed, jnp.maximum(take(rollout.counts, place), 1), 0)
        row = jnp.where(rollout.known, count / jnp.sum(count).astype(game.dtype), row)
        probability = probability.at[place].set(row, mode="promise_in_bounds")
    gain = jnp.sum(row * take(rollout.reward, place))
    gain = jnp.where(changed, gain, take(state.gain, place))
    known_at = jnp.where(rollout.known, rollout.moves, take(state.known_at, place))
    state = replace(
        state,
        moves=rollout.moves,
        position=rollout.position,
        fault=rollout.fault,
        counts=rollout.counts,
        reward=rollout.reward,
        probability=probability,
        known_at=state.known_at.at[place].set(known_at, mode="promise_in_bounds"),
        gain=state.gain.at[place].set(gain, mode="promise_in_bounds"),
        num_known=state.num_known + rollout.known,
        last_update=jnp.where(changed, rollout.moves, state.last_update),
        num_updates=state.num_updates + changed,
    )
    # A loop of one iteration, which is skipped if no lane has changed.
    value, error, best, _ = loops.while_active(
        lambda carry, _: carry[-1],
        _solve,
        (state.value, state.error, state.best, changed),
        (state.gain, state.probability, problem, hparams),
    )
    # Every allowed action then has positive probability, unless that underflows.
    least = exploration(problem, hparams) / game.num_actions
    sure = state.always_almost_sure & (least > 0)
    return replace(state, value=value, error=error, best=best, always_almost_sure=sure)


_Values = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


def _solve(carry: _Values, model: tuple[jax.Array, jax.Array, Problem, Hparams]) -> _Values:
    """Value, error and near-optimal actions of a model that has changed."""
    value, error, best, changed = carry
    gain, probability, problem, hparams = model
    dtype = problem.game.dtype
    value, width, quantity = span_iteration(
        problem.game,
        problem.allowed,
        Models(
            gain,
            probability,
            value,
            jnp.asarray(hparams.discount, dtype),
            solver_tolerance(problem, hparams),
            changed,
        ),
    )
    # Within eps_1 minus twice the error by these values implies within eps_1 by the exact values.
    tolerance = pac.action_tolerance(hparams.epsilon, hparams.discount)
    strict = jnp.maximum(tolerance - 2 * width, 0).astype(dtype)
    mine = problem.allowed & problem.game.system[:, None]
    near = pac.near_optimal(quantity, mine, strict)
    error, best = jnp.where(changed, width, error), jnp.where(changed, near, best)
    return value, error, best, jnp.zeros_like(changed)


def unknown_reward(hparams: Hparams) -> jax.Array:
    """The optimistic reward ``R_max / (1 - discount)`` of an unknown pair."""
    return jnp.asarray(hparams.reward_bound) / (1 - jnp.asarray(hparams.discount))


def exploration(problem: Problem, hparams: Hparams) -> jax.Array:
    """The probability of drawing any allowed action instead of a near-optimal one."""
    p = pac.exploration(hparams.epsilon, hparams.discount, hparams.reward_bound)
    return jnp.asarray(p, problem.game.dtype)


def required_visits(problem: Problem, hparams: Hparams) -> jax.Array:
    """The visits after which a pair is known."""
    visits = hparams.known_after
    if visits is None:
        visits = pac.visits(
            hparams.epsilon,
            hparams.failure,
            hparams.discount,
            hparams.reward_bound,
            jnp.sum(problem.region),
            problem.game.num_actions,
        )
    return jnp.asarray(visits, problem.game.dtype)


def solver_tolerance(problem: Problem, hparams: Hparams) -> jax.Array:
    """The error of the optimistic value at which a solve stops."""
    dtype = problem.game.dtype
    tolerance = pac.action_tolerance(hparams.epsilon, hparams.discount) / 4
    rest = 1 - jnp.asarray(hparams.discount, dtype)
    rounding = 8 * jnp.finfo(dtype).eps * jnp.asarray(unknown_reward(hparams), dtype) / rest
    return jnp.maximum(tolerance, rounding).astype(dtype)
