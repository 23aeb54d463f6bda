"""Probably approximately correct learning of games: the constants, the bounds and the strategy.

The theory behind R-max in turn-based stochastic Buchi games (dissertation, chapter 6; Brafman
and Tennenholtz 2002). `epsilon` is the loss that is to be had in the end, `reward_bound` bounds
the rewards, which are not negative, and the discount is paid at every move.

The constants may be astronomical, so they are floats, and no intermediate result leaves the
range of the dtype unless the constant itself does. All arguments may be traced.

The constants are functions of numbers and differentiable in them, where they are not cut off; games
and strategies are made of concrete arrays.

Example: how often a pair is to be tried in a game of 144 states, by theorem 6.

  >>> from jaxltl.algos.common import pac
  >>> numbers = dict(epsilon=1e-4, discount=0.6, reward_bound=1.0)
  >>> print(f"{float(pac.visits(**numbers, failure=0.1, num_states=144, num_actions=6)):.2g}")
  1.4e+19
  >>> p = pac.exploration(**numbers)  # of any move, good or bad
  >>> gap = pac.hat_gap(p, pac.action_tolerance(1e-4, 0.6), 0.6, 1.0)
  >>> round(float(gap / 1e-4), 6)  # a sixth of what may be lost
  0.166667
"""

from __future__ import annotations

from dataclasses import replace

import chex
import jax
import jax.numpy as jnp

from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.ops.operators import action_max
from jaxltl.core.types import Solution, require_shape

# --- the constants of algorithm 5 -------------------------------------------------------------


def horizon(epsilon: chex.Numeric, discount: chex.Numeric, reward_bound: chex.Numeric) -> jax.Array:
    """Moves after which what may still be paid is worth at most ``epsilon / 6``: N.

    ``N = log(epsilon (1 - g)^2 / (6 R)) / log g`` (dissertation, section 6.6.2), not rounded,
    and at least 1. In the optimistic model a move pays up to ``R / (1 - g)``.

    Args:
      epsilon: positive.
      discount: g, in (0, 1).
      reward_bound: R, positive.

    Returns:
      ``float[]``, or as the arguments broadcast.

    Example:
      >>> round(float(horizon(1e-4, 0.6, 1.0)), 3)
      25.125
    """
    epsilon, discount, reward_bound = _floats(epsilon, discount, reward_bound)
    # A sum of logarithms, since the product of small numbers may be zero.
    log_tail = jnp.log(epsilon) + 2 * jnp.log1p(-discount) - jnp.log(reward_bound) - jnp.log(6.0)
    return jnp.maximum(log_tail / jnp.log(discount), 1)


def accuracy(
    epsilon: chex.Numeric,
    discount: chex.Numeric,
    reward_bound: chex.Numeric,
    num_states: chex.Numeric,
) -> jax.Array:
    """How well each transition probability has to be known: delta of algorithm 5, line 8.

    ``delta = epsilon (1 - g)^2 / (6 R S N)`` with N of :func:`horizon`, so that
    :func:`approximation_gap` is ``epsilon / 6``. (In the dissertation N is written out.)

    Args:
      epsilon, discount, reward_bound: as in :func:`horizon`.
      num_states: S.

    Returns:
      A float, or as the arguments broadcast.

    Example:
      >>> print(f"{float(accuracy(1e-4, 0.6, 1.0, 144)):.4g}")
      7.37e-10
    """
    steps = horizon(epsilon, discount, reward_bound)
    epsilon, discount, reward_bound, num_states = _floats(
        epsilon, discount, reward_bound, num_states
    )
    left = 1 - discount
    return epsilon / reward_bound / num_states / steps / 6 * left * left


def hoeffding_visits(
    deviation: chex.Numeric,
    failure: chex.Numeric,
    num_states: chex.Numeric,
    num_actions: chex.Numeric,
) -> jax.Array:
    """Visits after which all estimates of probabilities are good at once (lemma 11).

    ``K = log(2 A S^2 / failure) / (2 deviation^2)``: by Hoeffding's inequality and the union
    over all ``S^2 A`` transitions, every relative frequency after K visits of its pair is within
    `deviation` of the probability, but for a chance of at most `failure`.

    Args:
      deviation: positive.
      failure: in (0, 1).
      num_states, num_actions: S and A.

    Returns:
      A float, not rounded; infinite where the dtype ends.

    Example:
      >>> round(float(hoeffding_visits(0.01, 0.1, 10, 2)))
      41470
    """
    deviation, failure, num_states, num_actions = _floats(
        deviation, failure, num_states, num_actions
    )
    terms = jnp.log(2.0) + jnp.log(num_actions) + 2 * jnp.log(num_states) - jnp.log(failure)
    return terms / 2 / deviation / deviation


def visits(
    epsilon: chex.Numeric,
    failure: chex.Numeric,
    discount: chex.Numeric,
    reward_bound: chex.Numeric,
    num_states: chex.Numeric,
    num_actions: chex.Numeric,
) -> jax.Array:
    """Visits after which a pair with several successors counts as known: K of algorithm 5.

    ``K = log(4 A S^2 / failure) / (2 delta^2)``: :func:`hoeffding_visits` at the deviation
    delta of :func:`accuracy`, with half of `failure`; the other half is for the exploration
    that takes longer than expected. A pair with one successor is known after one visit.

    Args:
      epsilon, discount, reward_bound: as in :func:`horizon`.
      failure: the chance of not learning what is promised, in (0, 1): the dissertation's
        delta_c, one minus the confidence.
      num_states, num_actions: S and A.

    Returns:
      A float, or as the arguments broadcast.

    Example:
      >>> print(f"{float(visits(1e-4, 0.1, 0.6, 1.0, 144, 6)):.4e}")
      1.4193e+19
    """
    (failure,) = _floats(failure)
    delta = accuracy(epsilon, discount, reward_bound, num_states)
    return hoeffding_visits(delta, failure / 2, num_states, num_actions)


def action_tolerance(epsilon: chex.Numeric, discount: chex.Numeric) -> jax.Array:
    """How far below the best a move may be that the strategy plays freely: eps_1.

    ``eps_1 = epsilon (1 - g) / 12`` (algorithm 5, line 8).

    Args:
      epsilon, discount: as in :func:`horizon`.

    Returns:
      A float, or as the arguments broadcast.
    """
    epsilon, discount = _floats(epsilon, discount)
    return epsilon / 12 * (1 - discount)


def exploration(
    epsilon: chex.Numeric, discount: chex.Numeric, reward_bound: chex.Numeric
) -> jax.Array:
    """The probability of playing any allowed move, good or bad: p of algorithm 5, line 8.

    ``p = epsilon (1 - g)^3 / (12 R)``, and at most 1. With :func:`action_tolerance` it makes
    :func:`hat_gap` ``epsilon / 6``.

    Args:
      epsilon, discount, reward_bound: as in :func:`horizon`.

    Returns:
      A float, or as the arguments broadcast.
    """
    epsilon, discount, reward_bound = _floats(epsilon, discount, reward_bound)
    return jnp.minimum(epsilon / reward_bound / 12 * (1 - discount) ** 3, 1)


# --- the bounds ---------------------------------------------------------------------------------


def mixing_gap(
    probability: chex.Numeric,
    tolerance: chex.Numeric,
    discount: chex.Numeric,
    reward_bound: chex.Numeric,
) -> jax.Array:
    """What rare bad moves and frequent nearly best ones cost at most (lemma 7).

    ``max(V* - V) <= p R / (1 - g)^2 + tolerance / (1 - g)`` for the worst-case value V of a
    strategy that, wherever the system moves, plays moves that are more than `tolerance` below
    the best with probability at most p.

    Args:
      probability: p, in [0, 1].
      tolerance: at least 0.
      discount: g, in [0, 1).
      reward_bound: R; the rewards are in [0, R].

    Returns:
      A float, or as the arguments broadcast.

    Example:
      >>> round(float(mixing_gap(0.01, 0.1, 0.5, 1.0)), 6)
      0.24
    """
    probability, tolerance, discount, reward_bound = _floats(
        probability, tolerance, discount, reward_bound
    )
    left = 1 - discount
    return probability * reward_bound / left / left + tolerance / left


def hat_gap(
    probability: chex.Numeric,
    tolerance: chex.Numeric,
    discount: chex.Numeric,
    reward_bound: chex.Numeric,
) -> jax.Array:
    """What strategies of the hat game cost at most in the optimistic model (lemma 8).

    ``p R / (1 - g)^3 + tolerance / (1 - g)``: :func:`mixing_gap`, where a move that is not
    yet known pays ``R / (1 - g)``.

    Args:
      probability, tolerance, discount, reward_bound: as in :func:`mixing_gap`, R the bound
        of the true rewards.

    Returns:
      A float, or as the arguments broadcast.
    """
    discount, reward_bound = _floats(discount, reward_bound)
    return mixing_gap(probability, tolerance, discount, reward_bound / (1 - discount))


def approximation_gap(
    deviation: chex.Numeric,
    num_states: chex.Numeric,
    num_steps: chex.Numeric,
    discount: chex.Numeric,
    reward_bound: chex.Numeric,
) -> jax.Array:
    """How much inexact probabilities change what is paid in a number of moves (lemma 12).

    ``R S N deviation / (1 - g)^2``, for any strategies of both players, if the rewards are in
    ``[0, R / (1 - g)]`` and no probability changes by more than `deviation`.

    Args:
      deviation: at least 0.
      num_states: S.
      num_steps: N, the moves that are counted.
      discount, reward_bound: g and R.

    Returns:
      A float, or as the arguments broadcast.

    Example:
      >>> round(float(approximation_gap(1e-6, 10, 20, 0.5, 1.0)), 9)
      0.0008
    """
    deviation, num_states, num_steps, discount, reward_bound = _floats(
        deviation, num_states, num_steps, discount, reward_bound
    )
    left = 1 - discount
    return deviation * num_steps * num_states * reward_bound / left / left


def epsilon_optimal_states(optimal: Solution, value: Solution, epsilon: chex.Numeric) -> jax.Array:
    """Where a strategy is certainly within `epsilon` of the best: ``bool[S]``.

    Decided on the certified bounds, ``value.lower >= optimal.upper - epsilon``, so that a
    True is proved, and a False may only mean that the bounds are too wide.

    Args:
      optimal: of :func:`~jaxltl.core.values.discounted.minimax.minimax_value`.
      value: of :func:`~jaxltl.core.values.discounted.minimax.strategy_value`.
      epsilon: at least 0.

    Returns:
      ``bool[S]``, in a product ``[S, Q]``.

    Example:
      >>> from types import SimpleNamespace
      >>> best, own = (
      ...     SimpleNamespace(lower=x, upper=x) for x in (jnp.ones(2), jnp.array([0.5, 0.95])))
      >>> epsilon_optimal_states(best, own, 0.1).tolist()
      [False, True]
    """
    return value.lower >= optimal.upper - epsilon


# --- the strategy -------------------------------------------------------------------------------


def near_optimal(q: chex.Array, allowed: chex.Array, tolerance: chex.Numeric) -> jax.Array:
    """The allowed moves that are within a tolerance of the best one: ``bool[S, A]``.

    ``A*(s) = {a : max_b Q(s, b) - Q(s, a) <= tolerance}`` (dissertation, definition 5).
    Where Q has an error of at most e, a tolerance of ``t - 2 e`` keeps only moves that are
    within t of the best by the exact values, and ``t + 2 e`` keeps all of those.

    Args:
      q: ``float[S, A]``, the system's action values; only those of allowed moves are read.
      allowed: ``bool[S, A]``.
      tolerance: at least 0, a scalar.

    Returns:
      ``bool[S, A]``, nowhere empty where a move is allowed.

    Example:
      >>> q = jnp.array([[1.0, 0.95, 0.5, 2.0]])
      >>> near_optimal(q, jnp.array([[True, True, True, False]]), 0.1).tolist()
      [[True, True, False, False]]
    """
    q, allowed = jnp.asarray(q), jnp.asarray(allowed)
    best = action_max(q, allowed)[..., None]
    # Where the best is infinite the difference is not a number.
    return allowed & ((best - q <= tolerance) | (q == best))


def hat_strategy(near: chex.Array, allowed: chex.Array, exploration: chex.Numeric) -> jax.Array:
    """Nearly best moves, with all allowed ones now and then: ``float[S, A]``.

    ``sigma(s, .) = p uniform(allowed(s)) + (1 - p) uniform(near(s))``: what the uniform strategy
    of :func:`hat_game` plays (dissertation, remark 4 and algorithm 4, line 12). If the allowed
    moves are those that stay in the almost-sure region then all of them keep a positive
    probability, so it wins almost surely (lemma 6), and by lemma 8 it is nearly optimal.

    Args:
      near: ``bool[S, A]``, of :func:`near_optimal`.
      allowed: ``bool[S, A]``, which includes `near`.
      exploration: p, a scalar in (0, 1], see :func:`exploration`.

    Returns:
      ``float[S, A]``; rows sum to one up to rounding, and are zero where nothing is allowed.

    Differentiable in `exploration`.

    Example:
      >>> near, allowed = jnp.array([[True, False]]), jnp.array([[True, True]])
      >>> [round(p, 3) for p in hat_strategy(near, allowed, 0.1)[0].tolist()]
      [0.95, 0.05]
    """
    p = jnp.asarray(exploration, jnp.result_type(float))
    return p * _uniform(allowed) + (1 - p) * _uniform(near)


def hat_game(game: Game, near: chex.Array, exploration: chex.Numeric) -> Game:
    """The game whose strategies all play nearly best moves most of the time (algorithm 4).

    A state s of the system has one move, number A, which draws a copy of it: with probability
    p the state ``S + s``, which has all moves of s, else ``2 S + s``, which has the nearly best
    ones. Copies of the environment's states are unreachable; they move as it does. Copies show
    the label of their state. Runs take one move more at each state of the system, so values
    with a discount do not carry over, but almost-sure winning does (lemma 9).

    Args:
      game: an explicit game whose moves stay where the system wins almost surely.
      near: ``bool[S, A]``, of :func:`near_optimal`; read at the system's states.
      exploration: p, a scalar in (0, 1).

    Returns:
      A Game with ``3 S`` states, ``A + 1`` actions and at least two successors.

    Raises:
      ValueError: the game's model is not an MDP, or `near` has the wrong shape.

    Example:
      >>> from jaxltl import from_dense
      >>> game = Game(from_dense([[[1.0], [1.0]]]), jnp.array([True]))
      >>> hat = hat_game(game, jnp.array([[False, True]]), 0.25)
      >>> hat.mdp.successor[0, 2].tolist(), hat.mdp.probability[0, 2].tolist()
      ([1, 2], [0.25, 0.75])
      >>> hat.available.tolist()
      [[False, False, True], [True, True, False], [False, True, False]]
    """
    mdp = game.mdp
    if not isinstance(mdp, MDP):
        raise ValueError(
            f"hat_game needs a game on an MDP, not on a {type(mdp).__name__}; "
            "of a product pass restrict(game).model."
        )
    require_shape("near", near, mdp.available.shape)
    num_states, num_actions = mdp.available.shape
    extra = max(0, 2 - mdp.num_successors)
    system = game.system[:, None]
    choice = jnp.concatenate(
        [mdp.available & ~system, mdp.available, mdp.available & (near | ~system)]
    )
    draws = jnp.concatenate([system, jnp.zeros((2 * num_states, 1), bool)])
    available = jnp.concatenate([choice, draws], axis=1)
    pad = ((0, 0), (0, 1), (0, extra))
    successor = jnp.tile(jnp.pad(mdp.successor, pad), (3, 1, 1))
    probability = jnp.tile(jnp.pad(mdp.probability, pad), (3, 1, 1))
    state = jnp.arange(num_states, dtype=successor.dtype)
    p = jnp.asarray(exploration, mdp.dtype)
    successor = successor.at[:num_states, num_actions, :2].set(
        jnp.stack([num_states + state, 2 * num_states + state], axis=1)
    )
    probability = probability.at[:num_states, num_actions, :2].set(jnp.stack([p, 1 - p]))
    kept = available[:, :, None]
    return Game(
        replace(
            mdp,
            successor=jnp.where(kept, successor, 0),
            probability=jnp.where(kept, probability, 0),
            available=available,
            initial=jnp.pad(mdp.initial, (0, 2 * num_states)),
            label=jnp.tile(mdp.label, (3, 1)),
        ),
        jnp.tile(game.system, 3),
    )


def recover_hat_strategy(hat: Game, strategy: chex.Array) -> jax.Array:
    """What a strategy of the hat game plays in the game itself (algorithm 4, line 12).

    ``sigma(s, a) = p hat_sigma(S + s, a) + (1 - p) hat_sigma(2 S + s, a)`` at the system's
    states, with p of the hat game; the environment's rows are copied.

    Args:
      hat: a game of :func:`hat_game`, with ``3 S`` states and ``A + 1`` actions.
      strategy: ``float[3 S, A + 1]``.

    Returns:
      ``float[S, A]``.

    Raises:
      ValueError: the strategy has the wrong shape.

    Example:
      >>> from jaxltl import from_dense
      >>> game = Game(from_dense([[[1.0], [1.0]]]), jnp.array([True]))
      >>> hat = hat_game(game, jnp.array([[False, True]]), 0.25)
      >>> alike = hat.available / hat.available.sum(-1, keepdims=True)
      >>> [round(x, 3) for x in recover_hat_strategy(hat, alike)[0].tolist()]
      [0.125, 0.875]
    """
    require_shape("strategy", strategy, hat.available.shape)
    num_states, last = hat.num_states // 3, hat.num_actions - 1
    own, free, nearly = strategy.reshape(3, num_states, -1)[:, :, :last]
    drawn = hat.mdp.probability[:num_states, last]
    mixed = drawn[:, :1] * free + drawn[:, 1:2] * nearly
    return jnp.where(hat.system[:num_states, None], mixed, own)


def _uniform(moves: chex.Array) -> jax.Array:
    weight = jnp.asarray(moves, jnp.result_type(float))
    return weight / jnp.maximum(weight.sum(axis=-1, keepdims=True), 1)


def _floats(*numbers: chex.Numeric) -> list[jax.Array]:
    """Each as a float, an integer too, whose square might overflow."""
    return [jnp.asarray(x, jnp.result_type(x, float)) for x in numbers]
