"""Discounted values of zero-sum games, and of one strategy in the worst case.

The system maximises and the environment minimises. Values come with a certified
enclosure, and are differentiable by the implicit function theorem. Shapes are written for
states ``[S]``; a game on a Product has ``[S, Q]``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.concrete import is_traced
from jaxltl.core.models.game import Game, as_game
from jaxltl.core.models.operators import (
    action_argmax,
    action_max,
    action_mean,
    exists_successor,
    expectation,
    induced_chain,
)
from jaxltl.core.models.operators import is_deterministic as is_one_action
from jaxltl.core.types import Solution, require_shape, status_code
from jaxltl.core.values.discounted import expected_reward
from jaxltl.core.values.fixed_point import implicit
from jaxltl.core.values.linear import solve_linear

_METHODS = ("modified_policy_iteration", "value_iteration", "strategy_iteration")


def minimax_value(
    game: Any,
    reward: chex.Array,
    discount: chex.Numeric,
    *,
    per: str = "move",
    method: str = "modified_policy_iteration",
    allowed: chex.Array | None = None,
    tolerance: chex.Numeric | None = None,
    max_steps: chex.Numeric = 100_000,
    evaluation_sweeps: chex.Numeric = 24,
) -> Solution:
    """Discounted reward that the system can secure against every environment.

    ``V(s) = max_a R(s, a) + g(s) * sum_t P(t | s, a) V(t)`` where the system moves, the same
    with min where the environment does (Shapley 1953; dissertation, section 5.2.4). With
    ``per="move"``, g is the discount; with ``per="system_move"`` it is the discount at the
    system's states and 1 at the environment's, so that time is counted in moves of the system.

    The bounds rest on a function h with ``h >= 1 + g P h`` for all moves of both players, the
    discounted time that is left at most: ``|T v - v| <= e`` puts the value within ``e * h`` of
    v. Each sweep touches every transition once.

    Args:
      game: a Game; any other model is the game in which the system always moves.
      reward: ``float[S, A]`` or ``float[S, A, K]``; what is paid at environment states counts.
      discount: scalar in [0, 1).
      per: ``"move"`` or ``"system_move"``, which moves are discounted.
      method: ``"modified_policy_iteration"``: between sweeps of the operator, cheap sweeps
        under both players' greedy choices, kept where they bring the residual down;
        ``"value_iteration"``; or ``"strategy_iteration"`` (Hoffman and Karp 1966): linear
        solves, the environment answering best before the system improves.
      allowed: ``bool[S, A]``, the moves that may be made, such as a permissive strategy's;
        default the available ones. A play that reaches a state without any is worth minus
        infinity, so the system keeps away, and that is the value where it cannot.
      tolerance: certified absolute error asked for; default: what the dtype allows.
      max_steps: sweeps of the operator at most.
      evaluation_sweeps: sweeps between them under fixed choices.

    Returns:
      :class:`Solution`; `policy` is ``int32[S]``, greedy for both players: the system's part
      secures at least `lower`, the environment's concedes at most `upper`. Where the value is
      minus infinity the policy means nothing.

    Raises:
      ValueError: a wrong shape, an unknown method or `per`, or, with ``per="system_move"``,
        an environment that can move for ever without the system, which leaves the value
        undefined. (Under ``jit`` the status is then NONFINITE.)

    Differentiable in the reward, the discount and the probabilities, wherever the greedy
    choices are unique.

    Example:
      >>> from jaxltl.core.models.game import make_game
      >>> from jaxltl.core.models.mdp import from_dense
      >>> world = from_dense([[[0, 1.0], [0, 1.0]], [[1.0, 0], [1.0, 0]]])
      >>> game = make_game(world, [True, False])
      >>> reward = jnp.array([[1.0, 2.0], [0.0, 1.0]])
      >>> [round(v, 4) for v in minimax_value(game, reward, 0.5).value.tolist()]
      [2.6667, 1.3333]
      >>> best = minimax_value(game, reward, 0.5, per="system_move")
      >>> [round(v, 4) for v in best.value.tolist()], best.policy.tolist()
      ([4.0, 4.0], [1, 0])
    """
    _require("method", method, _METHODS)
    game = as_game(game)
    moves = game.available
    if allowed is not None:
        require_shape("allowed", allowed, moves.shape)
        moves = moves & jnp.asarray(allowed, bool)
    play = _make_play(game, reward, discount, per, moves)
    return _solve(play, tolerance, max_steps, evaluation_sweeps, method=method)


def strategy_value(
    game: Any,
    strategy: chex.Array,
    reward: chex.Array,
    discount: chex.Numeric,
    *,
    per: str = "move",
    environment: chex.Array | str = "adversarial",
    method: str = "modified_policy_iteration",
    tolerance: chex.Numeric | None = None,
    max_steps: chex.Numeric = 100_000,
    evaluation_sweeps: chex.Numeric = 24,
) -> Solution:
    """Discounted reward of a strategy of the system, in the worst case or against a policy.

    ``V(s) = sum_a mu(s, a) (R(s, a) + g(s) * P V)`` where the system moves; where the
    environment does, the minimum over its moves (dissertation, (5.2)), or the mean under its
    policy. Discounts, methods and bounds are those of :func:`minimax_value`.

    Args:
      game, reward, discount, per, method, tolerance, max_steps, evaluation_sweeps: as in
        :func:`minimax_value`.
      strategy: ``int32[S]`` or ``float[S, A]``, read at the system's states only. The rows of
        a stochastic strategy sum to one. A play that reaches a state where an action is
        chosen that is not available (-1, say), or none, is worth minus infinity, and so is
        each state from which it can get there.
      environment: ``"adversarial"``, or a policy ``int32[S]`` or ``float[S, A]``, read at the
        environment's states only.

    Returns:
      :class:`Solution`; `policy` holds both players' choices: ``int32[S]``, or ``float[S, A]``
      if one of those given is stochastic.

    Raises:
      ValueError: as :func:`minimax_value`; or the strategy has a wrong shape.

    Differentiable in the reward, the discount, the probabilities and stochastic strategies,
    wherever the environment's best answer is unique.

    Example:
      >>> from jaxltl.core.models.game import make_game
      >>> from jaxltl.core.models.mdp import from_dense
      >>> world = from_dense([[[0, 1.0], [0, 1.0]], [[1.0, 0], [1.0, 0]]])
      >>> game = make_game(world, [True, False])
      >>> reward = jnp.array([[1.0, 2.0], [0.0, 1.0]])
      >>> worst = strategy_value(game, jnp.array([0, 0]), reward, 0.5, per="system_move")
      >>> [round(v, 4) for v in worst.value.tolist()]
      [2.0, 2.0]
      >>> mild = jnp.array([[0.0, 0.0], [0.5, 0.5]])
      >>> met = strategy_value(game, jnp.array([0, 0]), reward, 0.5, environment=mild)
      >>> [round(v, 4) for v in met.value.tolist()]
      [1.6667, 1.3333]
    """
    _require("method", method, _METHODS)
    game = as_game(game)
    if isinstance(environment, str):
        _require("environment", environment, ("adversarial",))
        given = [(strategy, game.system, "strategy")]
    else:
        given = [(strategy, game.system, "strategy"), (environment, ~game.system, "environment")]
    moves, fixed, weight = game.available, None, None
    for policy, states, name in given:
        moves, fixed, weight = _follow(game, policy, states, name, moves, fixed, weight)
    play = _make_play(game, reward, discount, per, moves, fixed, weight, follows=len(given))
    return _solve(play, tolerance, max_steps, evaluation_sweeps, method=method)


def _follow(game, policy, states, name, moves, fixed, weight):
    """Moves left by a player who plays a policy; with `weight` where they are drawn."""
    policy = jnp.asarray(policy)
    deterministic = is_one_action(policy)
    if deterministic:
        require_shape(f"{name} (of integers)", policy, game.state_shape)
        used = policy[..., None] == jnp.arange(game.num_actions)
    else:
        require_shape(f"{name} (stochastic)", policy, moves.shape)
        used = policy > 0
    wrong = jnp.any(used & ~game.available, axis=-1, keepdims=True)
    moves = jnp.where(states[..., None], used & ~wrong, moves)
    if deterministic:
        return moves, fixed, weight
    fixed = states if fixed is None else fixed | states
    weight = policy if weight is None else jnp.where(states[..., None], policy, weight)
    return moves, fixed, weight.astype(game.dtype)


def _require(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name}={value!r}; choose {' or '.join(choices)}.")


# --- what is played ------------------------------------------------------------------------


class _Play(NamedTuple):
    """A discounted game, its moves pruned so that no play from a live state gets stuck.

    `free` marks states whose moves are not discounted; `fixed` those whose moves are drawn by
    the rows of `weight`. Where neither player draws, both are None.
    """

    game: Game
    reward: jax.Array  # [S, A], zero at moves that are not allowed
    discount: jax.Array
    free: jax.Array
    allowed: jax.Array
    live: jax.Array
    defined: jax.Array  # whether the environment always has to return to the system
    fixed: Any
    weight: Any

    @property
    def rate(self) -> jax.Array:
        return jnp.where(self.live, jnp.where(self.free, 1, self.discount), 0)

    @property
    def sign(self) -> jax.Array:
        """What each state's player maximises is sign times the reward."""
        return jnp.where(self.game.system, 1, -1).astype(self.game.dtype)

    def quantities(self, value: jax.Array) -> jax.Array:
        return self.reward + self.rate[..., None] * expectation(self.game, value)

    def backup(self, value: jax.Array) -> jax.Array:
        q = self.quantities(value)
        best = self.sign * action_max(self.sign[..., None] * q, self.allowed)
        return self._settled(best, q)

    def greedy(self, value: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """The backup, the actions that attain it, and the quantities compared."""
        q = self.quantities(value)
        best, action = action_argmax(self.sign[..., None] * q, self.allowed)
        return self._settled(self.sign * best, q), action, q

    def _settled(self, best: jax.Array, q: jax.Array) -> jax.Array:
        if self.fixed is not None:
            best = jnp.where(self.fixed, action_mean(self.weight, q), best)
        return jnp.where(self.live, best, 0)

    def distribution(self, action: jax.Array) -> jax.Array:
        """One action for each state, or the distribution where some are drawn."""
        if self.fixed is None:
            return action
        chosen = jax.nn.one_hot(action, self.game.num_actions, dtype=self.game.dtype)
        return jnp.where(self.fixed[..., None], self.weight, chosen)

    def chain(self, action: jax.Array) -> tuple[jax.Array, Callable[[jax.Array], jax.Array]]:
        """``r`` and ``x -> g P x`` of fixed choices."""
        policy, rate = self.distribution(action), self.rate
        paid = jnp.where(self.live, action_mean(policy, self.reward), 0)
        if self.fixed is not None:
            return paid, lambda x: rate * action_mean(policy, expectation(self.game, x))
        chain = induced_chain(self.game, policy)
        return paid, lambda x: rate * expectation(chain, x.ravel())[:, 0].reshape(x.shape)


def _make_play(
    game, reward, discount, per, moves, fixed=None, weight=None, *, follows=0
) -> _Play:
    """Prunes moves that lead to where play gets stuck; `follows` players have no choice."""
    _require("per", per, ("move", "system_move"))
    chosen = jnp.ones_like(game.system) if follows else ~game.system
    stuck = ~moves.any(axis=-1)
    # Chance, the environment and a strategy that is followed may all lead there.
    lost = attractor(game, stuck, moves, rule=chosen, chance="some").region
    moves = moves & ~lost[..., None] & ~exists_successor(game, lost)
    if per == "move":
        free, defined = jnp.zeros_like(game.system), jnp.bool_(True)
    else:
        free = ~game.system
        drawn = jnp.zeros_like(free) if fixed is None else fixed
        back = attractor(game, game.system | lost, moves, rule=drawn, chance="some").region
        defined = back.all()
        if not is_traced(back) and not defined:
            first = tuple(int(i) for i in np.argwhere(~np.asarray(back))[0])
            raise ValueError(
                f"from state {first[0] if len(first) == 1 else first} the environment can move "
                "for ever without the system, and such moves are not discounted with "
                "per='system_move', so there is no value; use per='move', or give the system "
                "a move in every cycle."
            )
    return _Play(
        game=game,
        reward=jnp.where(moves, expected_reward(game, reward), 0),
        discount=jnp.asarray(discount, game.dtype),
        free=free, allowed=moves, live=~lost, defined=defined, fixed=fixed, weight=weight,
    )


# --- bounds --------------------------------------------------------------------------------


def _terms(play: _Play) -> float:
    """Rounding errors of one backup, in units of eps times its magnitude (see bellman.py)."""
    count = play.game.num_successors + play.game.num_actions + 4
    return count * float(jnp.finfo(play.game.dtype).eps)


def _horizon(play: _Play, max_steps: jax.Array | int) -> jax.Array:
    """A function h with ``h >= 1 + g P h`` for all moves; infinite or NaN if there is none.

    With tau the expected number of undiscounted moves before the next discounted one, at most,
    and L its maximum: ``h = (1 + discount * L) / (1 - discount) + tau``.
    """
    def count(tau: jax.Array) -> jax.Array:
        moves = 1 + expectation(play.game, tau)
        most = action_max(moves, play.allowed)
        if play.fixed is not None:
            most = jnp.where(play.fixed, action_mean(play.weight, moves), most)
        return jnp.where(play.free & play.live, most, 0)

    def growing(carry):
        tau, after, n = carry
        return (jnp.max(after - tau) > 2.0**-7) & (n < max_steps) & play.defined

    zero = jnp.zeros(play.game.state_shape, play.game.dtype)
    tau, after, _ = lax.while_loop(
        growing, lambda c: (c[1], count(c[1]), c[2] + 1), (zero, count(zero), jnp.int32(0))
    )
    # From 1 + P tau <= tau + growth follows that tau / (1 - growth) is enough.
    growth = jnp.max(after - tau)
    tau = jnp.where(growth < 0.5, tau / (1 - growth), jnp.inf)
    gap = 1 - play.discount
    horizon = (1 + play.discount * jnp.max(tau)) / gap + tau
    slack = 2 * _terms(play) * jnp.max(horizon)
    horizon = jnp.where(slack < 0.5, horizon * (1 + slack), jnp.inf)
    valid = play.defined & (play.discount >= 0) & (play.discount < 1)
    return jnp.where(valid, horizon, jnp.nan)


class _Evidence(NamedTuple):
    """Midpoint of the enclosure seen from the image, its half width, and what they show."""

    shift: jax.Array
    half: jax.Array
    converged: jax.Array
    exhausted: jax.Array  # as narrow as rounding lets it be
    finite: jax.Array


def _certify(play: _Play, horizon, tolerance, value, image) -> _Evidence:
    """``T v + [down, up]`` encloses the fixed point of T.

    With ``c = max(T v - v)``: if c >= 0, ``u = v + c h`` has ``T u <= u``, so the fixed point
    is at most ``T u <= T v + c (h - 1)``. If c < 0 the same holds with the constant
    ``1 / (1 - discount)``, as no move is discounted more. Likewise below. As the width grows
    with h, its maximum in place of h tells whether the enclosure is narrow enough everywhere.
    """
    unit = _terms(play) * (jnp.max(jnp.abs(play.reward)) + jnp.max(jnp.abs(image)))
    change = image - value
    top, bottom = jnp.max(change), jnp.min(change)
    least = play.discount / (1 - play.discount)
    up = top * jnp.where(top > 0, horizon - 1, least) + unit * horizon
    down = bottom * jnp.where(bottom < 0, horizon - 1, least) - unit * horizon
    half = (up - down) / 2
    known = jnp.all(jnp.isfinite(half))
    goal = 4 * unit * horizon if tolerance is None else tolerance
    return _Evidence(
        shift=jnp.where(known, (up + down) / 2, 0),
        half=jnp.where(known, half, jnp.inf),
        converged=known & jnp.all(half <= goal),
        exhausted=known & jnp.all(half <= 2 * unit * horizon),
        finite=jnp.isfinite(top - bottom) & ~jnp.any(jnp.isnan(horizon)),
    )


# --- solvers -------------------------------------------------------------------------------


@partial(jax.jit, static_argnames=("method",))
def _solve(play: _Play, tolerance, max_steps, evaluation_sweeps, *, method: str) -> Solution:
    still = jax.tree.map(lax.stop_gradient, play)
    horizon = _horizon(still, max_steps)
    if method == "strategy_iteration":
        found = _strategy_iteration(still, horizon, tolerance, max_steps)
    elif method == "value_iteration":
        found = _value_iteration(still, horizon, tolerance, max_steps)
    else:
        found = _policy_sweeps(still, horizon, tolerance, max_steps, evaluation_sweeps)
    value, image, action, num_steps = found
    verdict = _certify(still, jnp.max(horizon), tolerance, value, image)
    evidence = _certify(still, horizon, tolerance, value, image)
    middle = image + evidence.shift

    def live(x: jax.Array) -> jax.Array:
        return jnp.where(still.live, x, -jnp.inf)

    solution = Solution(
        value=middle,
        policy=still.distribution(action),
        lower=live(jnp.where(evidence.half < jnp.inf, middle - evidence.half, -jnp.inf)),
        upper=live(jnp.where(evidence.half < jnp.inf, middle + evidence.half, jnp.inf)),
        residual=jnp.max(jnp.abs(image - value)),
        num_steps=num_steps,
        status=status_code(verdict.converged, verdict.finite, verdict.exhausted),
    )
    solution = jax.tree.map(lax.stop_gradient, solution)
    return replace(solution, value=live(implicit(play.backup, middle)))


def _unfinished(evidence: _Evidence, n: jax.Array, max_steps) -> jax.Array:
    # Where the horizon is not finite no number of sweeps proves anything.
    done = evidence.converged | evidence.exhausted
    return ~done & evidence.finite & (n < max_steps)


def _policy_sweeps(play: _Play, horizon, tolerance, max_steps, sweeps):
    """Sweeps of the operator, with some under both players' choices in between.

    Evaluating both players' greedy choices can lead away from the value of a game (unlike that
    of an MDP). So the outcome is kept only if its residual shrinks as a sweep would make it; if
    not, plain sweeps follow, twice as many each time, which always contract in the norm that
    is weighted by the horizon.
    """
    certify = partial(_certify, play, jnp.max(horizon), tolerance)
    rate = 1 - 1 / jnp.max(horizon)

    def size(value: jax.Array, image: jax.Array) -> jax.Array:
        return jnp.max(jnp.abs(image - value) / horizon)

    def evaluate(value: jax.Array, action: jax.Array) -> jax.Array:
        paid, onward = play.chain(action)
        return lax.fori_loop(0, sweeps, lambda _, v: paid + onward(v), value)

    def body(carry):
        old, plain, pause, n, _ = carry
        value = lax.cond(plain > 0, lambda v, _: v, evaluate, *old[1:])
        image, action, _ = play.greedy(value)
        kept = (plain > 0) | (size(value, image) <= rate * size(*old[:2]))
        new = jax.tree.map(partial(jnp.where, kept), (value, image, action), old)
        pause = jnp.where(plain > 0, pause, jnp.where(kept, 0, 2 * pause + 1))
        plain = jnp.where(plain > 0, plain - 1, pause)
        return new, plain, pause, n + 1, certify(*new[:2])

    zero = jnp.zeros(play.game.state_shape, play.game.dtype)
    first = (zero, *play.greedy(zero)[:2])
    start = (first, jnp.int32(0), jnp.int32(0), jnp.int32(1), certify(*first[:2]))
    found, *_, n, _ = lax.while_loop(lambda c: _unfinished(c[4], c[3], max_steps), body, start)
    return *found, n


def _value_iteration(play: _Play, horizon, tolerance, max_steps):
    certify = partial(_certify, play, jnp.max(horizon), tolerance)

    def body(carry):
        _, value, n, _ = carry
        image = play.backup(value)
        return value, image, n + 1, certify(value, image)

    value = jnp.zeros(play.game.state_shape, play.game.dtype)
    image = play.backup(value)
    start = (value, image, jnp.int32(1), certify(value, image))
    value, image, n, _ = lax.while_loop(lambda c: _unfinished(c[3], c[2], max_steps), body, start)
    return value, *play.greedy(value)[:2], n


_QUIET = 3  # solves without a change of strategy after which more would not help


def _strategy_iteration(play: _Play, horizon, tolerance, max_steps):
    """Solves for the value of both players' choices, then improves the environment's, or,
    where those are a best answer already, the system's (Hoffman and Karp 1966)."""
    certify = partial(_certify, play, jnp.max(horizon), tolerance)

    def body(carry):
        (value, _, _), policy, n, quiet, _ = carry
        paid, onward = play.chain(policy)
        # Solving for the correction refines the value where the choices stay the same.
        value = value + solve_linear(lambda x: x - onward(x), paid + onward(value) - value)
        image, action, q = play.greedy(value)
        margin = 2 * _terms(play) * (jnp.max(jnp.abs(play.reward)) + jnp.max(jnp.abs(value)))
        own = jnp.where(play.live, action_mean(policy, q), 0)
        better = play.live & (play.sign * (image - own) > margin)
        if play.fixed is not None:
            better &= ~play.fixed
        answers = better & ~play.game.system
        change = jnp.where(answers.any(), answers, better)
        policy = jnp.where(change, action, policy)
        quiet = jnp.where(change.any(), 0, quiet + 1)
        return (value, image, action), policy, n + 1, quiet, certify(value, image)

    def unfinished(carry):
        _, _, n, quiet, evidence = carry
        return _unfinished(evidence, n, max_steps) & (quiet < _QUIET)

    zero = jnp.zeros(play.game.state_shape, play.game.dtype)
    first = (zero, *play.greedy(zero)[:2])
    start = (first, first[2], jnp.int32(1), jnp.int32(0), certify(*first[:2]))
    found, _, n, _, _ = lax.while_loop(unfinished, body, start)
    return *found, n
