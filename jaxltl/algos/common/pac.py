"""PAC bounds for discounted rewards in stochastic games with an almost-sure Buchi objective.

The theory of R-max (Brafman and Tennenholtz 2002) for turn-based stochastic games with an
almost-sure Buchi objective (dissertation, chapter 6). Throughout, `epsilon` is the loss of value
that the final strategy may have, rewards lie in ``[0, reward_bound]``, and every move is discounted
by g, the `discount`; S and A count states and actions.

The constants may be astronomical, so they are floats, and intermediate results stay in the range of
the dtype if the constant does. Arguments broadcast and may be traced; constants and bounds are
differentiable in them where they are not clipped.

Example: the visits of each pair that theorem 6 requires in a game of 144 states.
  >>> from jaxltl.algos.common import pac
  >>> numbers = dict(epsilon=1e-4, discount=0.6, reward_bound=1.0)
  >>> print(f"{float(pac.visits(**numbers, failure=0.1, num_states=144, num_actions=6)):.4e}")
  1.4193e+19
  >>> p = pac.exploration(**numbers)
  >>> gap = pac.hat_gap(p, pac.action_tolerance(1e-4, 0.6), 0.6, 1.0)
  >>> round(float(gap / 1e-4), 6)  # a sixth of epsilon
  0.166667
"""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp

from jaxltl.core.models import MDP, Game
from jaxltl.core.models.ops.operators import action_max
from jaxltl.core.models.protocols import Array, Numeric
from jaxltl.core.types import Solution, require_shape

# --- the constants of algorithm 5 -------------------------------------------------------------


def horizon(epsilon: Numeric, discount: Numeric, reward_bound: Numeric) -> jax.Array:
    """The number N of moves after which all later rewards are worth at most ``epsilon / 6``.

    ``N = log(epsilon (1 - g)^2 / (6 R)) / log g`` for the `discount` g and the `reward_bound` R
    (section 6.6.2), not rounded, at least 1. In the optimistic model a move pays up to R / (1 - g).

    >>> round(float(horizon(1e-4, 0.6, 1.0)), 3)
    25.125
    """
    epsilon, discount, reward_bound = _floats(epsilon, discount, reward_bound)
    # A sum of logarithms, since the product of small numbers may underflow.
    log_tail = jnp.log(epsilon) + 2 * jnp.log1p(-discount) - jnp.log(reward_bound) - jnp.log(6.0)
    return jnp.maximum(log_tail / jnp.log(discount), 1)


def accuracy(
    epsilon: Numeric, discount: Numeric, reward_bound: Numeric, num_states: Numeric
) -> jax.Array:
    """The required accuracy delta of transition probabilities (algorithm 5, line 8).

    ``delta = epsilon (1 - g)^2 / (6 R S N)`` for the `discount` g, the `reward_bound` R, S the
    `num_states` and N of :func:`horizon`, so that :func:`approximation_gap` is ``epsilon / 6``.

    >>> print(f"{float(accuracy(1e-4, 0.6, 1.0, 144)):.4g}")
    7.37e-10
    """
    steps = horizon(epsilon, discount, reward_bound)
    epsilon, discount, reward_bound, num_states = _floats(
        epsilon, discount, reward_bound, num_states
    )
    rest = 1 - discount
    return epsilon / reward_bound / num_states / steps / 6 * rest * rest


def hoeffding_visits(
    deviation: Numeric, failure: Numeric, num_states: Numeric, num_actions: Numeric
) -> jax.Array:
    """The visits K after which all estimated probabilities are accurate at once (lemma 11).

    ``K = log(2 A S^2 / failure) / (2 deviation^2)``, not rounded, for S `num_states` and A
    `num_actions`: by Hoeffding's inequality and the union bound over all ``S^2 A`` transitions,
    every relative frequency is within `deviation` of its probability except with probability
    `failure`.

    >>> round(float(hoeffding_visits(0.01, 0.1, 10, 2)))
    41470
    """
    deviation, failure, num_states, num_actions = _floats(
        deviation, failure, num_states, num_actions
    )
    terms = jnp.log(2.0) + jnp.log(num_actions) + 2 * jnp.log(num_states) - jnp.log(failure)
    return terms / 2 / deviation / deviation


def visits(
    epsilon: Numeric,
    failure: Numeric,
    discount: Numeric,
    reward_bound: Numeric,
    num_states: Numeric,
    num_actions: Numeric,
) -> jax.Array:
    """The visits K after which a pair with several successors is known (algorithm 5).

    :func:`hoeffding_visits` at the deviation of :func:`accuracy` for `epsilon`, `discount`,
    `reward_bound`, `num_states` and `num_actions`, with half of `failure`, the dissertation's
    delta_c; the other half covers exploration that takes longer than expected.
    """
    (failure,) = _floats(failure)
    delta = accuracy(epsilon, discount, reward_bound, num_states)
    return hoeffding_visits(delta, failure / 2, num_states, num_actions)


def action_tolerance(epsilon: Numeric, discount: Numeric) -> jax.Array:
    """The tolerance ``eps_1 = epsilon (1 - g) / 12`` of near-optimal actions, g the `discount`.

    Algorithm 5, line 8.
    """
    epsilon, discount = _floats(epsilon, discount)
    return epsilon / 12 * (1 - discount)


def exploration(epsilon: Numeric, discount: Numeric, reward_bound: Numeric) -> jax.Array:
    """The probability p of a uniformly drawn allowed action (algorithm 5, line 8).

    ``p = epsilon (1 - g)^3 / (12 R)``, at most 1, for the `discount` g and the `reward_bound` R.
    With :func:`action_tolerance` it makes :func:`hat_gap` equal to ``epsilon / 6``.
    """
    epsilon, discount, reward_bound = _floats(epsilon, discount, reward_bound)
    return jnp.minimum(epsilon / reward_bound / 12 * (1 - discount) ** 3, 1)


# --- the bounds ---------------------------------------------------------------------------------


def mixing_gap(
    probability: Numeric, tolerance: Numeric, discount: Numeric, reward_bound: Numeric
) -> jax.Array:
    """The largest loss of a strategy that mixes near-optimal and arbitrary actions (lemma 7).

    ``max(V* - V) <= p R / (1 - g)^2 + tolerance / (1 - g)`` for the worst-case value V of a
    strategy that plays actions more than `tolerance` below the best with `probability` at most p;
    g is the `discount` and R the `reward_bound`.

    >>> round(float(mixing_gap(0.01, 0.1, 0.5, 1.0)), 6)
    0.24
    """
    probability, tolerance, discount, reward_bound = _floats(
        probability, tolerance, discount, reward_bound
    )
    rest = 1 - discount
    return probability * reward_bound / rest / rest + tolerance / rest


def hat_gap(
    probability: Numeric, tolerance: Numeric, discount: Numeric, reward_bound: Numeric
) -> jax.Array:
    """The largest loss of hat-game strategies in the optimistic model (lemma 8).

    ``p R / (1 - g)^3 + tolerance / (1 - g)``: :func:`mixing_gap` of `probability`, `tolerance`,
    `discount` and `reward_bound`, where an unknown action pays ``R / (1 - g)``.
    """
    discount, reward_bound = _floats(discount, reward_bound)
    return mixing_gap(probability, tolerance, discount, reward_bound / (1 - discount))


def approximation_gap(
    deviation: Numeric,
    num_states: Numeric,
    num_steps: Numeric,
    discount: Numeric,
    reward_bound: Numeric,
) -> jax.Array:
    """The largest change of an N-step value by inexact probabilities (lemma 12).

    ``R S N deviation / (1 - g)^2`` for any strategies of both players, if rewards lie in
    ``[0, R / (1 - g)]`` and no probability changes by more than `deviation`; S is `num_states`, N
    `num_steps`, g the `discount` and R the `reward_bound`.

    >>> round(float(approximation_gap(1e-6, 10, 20, 0.5, 1.0)), 9)
    0.0008
    """
    deviation, num_states, num_steps, discount, reward_bound = _floats(
        deviation, num_states, num_steps, discount, reward_bound
    )
    rest = 1 - discount
    return deviation * num_steps * num_states * reward_bound / rest / rest


def epsilon_optimal_states(optimal: Solution, value: Solution, epsilon: Numeric) -> jax.Array:
    """The states in which a strategy is certified to be `epsilon`-optimal: ``bool[S]``.

    ``value.lower >= optimal.upper - epsilon`` for the certified bounds of the `optimal` value
    (``minimax_value``) and the strategy's `value` (``strategy_value``): True is proved, False may
    only mean that the bounds are too wide.

    >>> from types import SimpleNamespace
    >>> best, own = SimpleNamespace(upper=jnp.ones(2)), SimpleNamespace(lower=jnp.array([0.5, 0.95]))
    >>> epsilon_optimal_states(best, own, 0.1).tolist()
    [False, True]
    """
    return value.lower >= optimal.upper - epsilon


# --- the strategy -------------------------------------------------------------------------------


def near_optimal(q: Array, allowed: Array, tolerance: Numeric) -> jax.Array:
    """The `allowed` actions within a `tolerance` of the best one: ``bool[S, A]``.

    ``A*(s) = {a : max_b Q(s, b) - Q(s, a) <= tolerance}`` (definition 5) for action values `q`,
    ``float[S, A]``. If Q has an error of at most e, a tolerance of ``t - 2 e`` keeps only actions
    within t of the best by the exact values, and ``t + 2 e`` keeps all of those.

    >>> q = jnp.array([[1.0, 0.95, 0.5, 2.0]])
    >>> near_optimal(q, jnp.array([[True, True, True, False]]), 0.1).tolist()
    [[True, True, False, False]]
    """
    q, allowed = jnp.asarray(q), jnp.asarray(allowed)
    best = action_max(q, allowed)[..., None]
    # If the best is infinite, the difference is NaN.
    return allowed & ((best - q <= tolerance) | (q == best))


def hat_strategy(near_optimal: Array, allowed: Array, exploration: Numeric) -> jax.Array:
    """The mixture of uniform strategies over allowed and near-optimal actions: ``float[S, A]``.

    ``sigma(s, .) = p uniform(allowed(s)) + (1 - p) uniform(near_optimal(s))`` with p the `exploration`
    (remark 4; algorithm 4, line 12), for masks `near_optimal` and `allowed`, ``bool[S, A]``. If `allowed`
    are the actions that stay in the almost-sure winning region, the strategy wins almost surely
    (lemma 6) and is near-optimal (lemma 8). Rows without allowed actions are zero.

    >>> best, allowed = jnp.array([[True, False]]), jnp.array([[True, True]])
    >>> [round(p, 3) for p in hat_strategy(best, allowed, 0.1)[0].tolist()]
    [0.95, 0.05]
    """
    p = jnp.asarray(exploration, jnp.result_type(float))
    return p * _uniform(allowed) + (1 - p) * _uniform(near_optimal)


def hat_game(game: Game, near_optimal: Array, exploration: Numeric) -> Game:
    """The hat game, every strategy of which mostly plays near-optimal actions (algorithm 4).

    A system state s has one action, number A, which draws a copy of s: with probability p, the
    `exploration`, state ``S + s``, which has all actions of s, else ``2 S + s``, which has those of
    `near_optimal`, ``bool[S, A]``. Copies keep labels; those of environment states are unreachable. Plays
    take an additional move at each system state of `game`, so discounted values do not carry over,
    but almost-sure winning does (lemma 9).

    Raises:
      ValueError: the game's model is not an MDP, or `near_optimal` has the wrong shape.

    >>> from jaxltl import from_dense
    >>> game = Game(from_dense([[[1.0], [1.0]]]), jnp.array([True]))
    >>> hat_game(game, jnp.array([[False, True]]), 0.25).available.tolist()
    [[False, False, True], [True, True, False], [False, True, False]]
    """
    mdp = game.mdp
    if not isinstance(mdp, MDP):
        raise ValueError(
            f"hat_game needs a game on an MDP, not on a {type(mdp).__name__}; "
            "of a product pass restrict(game).model."
        )
    require_shape("near_optimal", near_optimal, mdp.available.shape)
    num_states, num_actions = mdp.available.shape
    extra = max(0, 2 - mdp.num_successors)
    system = game.system[:, None]
    choice = jnp.concatenate(
        [mdp.available & ~system, mdp.available, mdp.available & (near_optimal | ~system)]
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
    available_entry = available[:, :, None]
    mdp = replace(
        mdp,
        successor=jnp.where(available_entry, successor, 0),
        probability=jnp.where(available_entry, probability, 0),
        available=available,
        initial=jnp.pad(mdp.initial, (0, 2 * num_states)),
        label=jnp.tile(mdp.label, (3, 1)),
    )
    return Game(mdp, jnp.tile(game.system, 3))


def recover_hat_strategy(hat: Game, strategy: Array) -> jax.Array:
    """The strategy ``float[S, A]`` of the game that a hat-game strategy induces.

    ``sigma(s, a) = p hat_sigma(S + s, a) + (1 - p) hat_sigma(2 S + s, a)`` (algorithm 4, line 12)
    at the system's states, for a `strategy` ``float[3 S, A + 1]`` of a game `hat` of
    :func:`hat_game`; the environment's rows are copied.

    Raises:
      ValueError: the strategy has the wrong shape.

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


def _uniform(mask: Array) -> jax.Array:
    weight = jnp.asarray(mask, jnp.result_type(float))
    return weight / jnp.maximum(weight.sum(axis=-1, keepdims=True), 1)


def _floats(*numbers: Numeric) -> list[jax.Array]:
    """Floats of all arguments: the square of an integer might overflow."""
    return [jnp.asarray(x, jnp.result_type(x, float)) for x in numbers]
