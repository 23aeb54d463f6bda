"""Mean payoffs of deterministic games, in exact arithmetic."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.models.compiled import compiled_form, reshape_solution
from jaxltl.core.models.construct.padded import pad_rows
from jaxltl.core.models.game import Game, as_game, as_padded_game, is_deterministic
from jaxltl.core.models.mesh.sharded import refuse_sharded
from jaxltl.core.models.ops.array_namespace import jit, is_traced
from jaxltl.core.models.ops.operators import induced_chain
from jaxltl.core.models.protocols import Model
from jaxltl.core.models.sparse import SparseMDP, choice_reward
from jaxltl.core.types import Solution, status_code
from jaxltl.core.values.discounted.compiled import expected_reward
from jaxltl.core.values.engine.validated import validated


@validated(games=True)
def mean_payoff(game: Model | Game, reward: chex.Array, *, max_steps: int = 100_000) -> Solution:
    """Mean payoff: the exact average reward that the system secures in a deterministic game.

    The value of ``liminf (r_1 + ... + r_n) / n`` under optimal play (Ehrenfeucht and
    Mycielski 1979), by policy iteration with gains and biases (Cochet-Terrasson and Gaubert 2006)
    in exact arithmetic, on integers with the rewards' common denominator.
    :func:`average_reward` answers for every game, within a tolerance; ask this one for exact means, with
    which ties and thresholds are decided.

    Args:
      game: a deterministic Game; any other model is the game in which the system always moves.
      reward: ``float[S, A]`` or ``float[S, A, K]``, finite; moves of both players count. In a game
        on a sparse model, which is padded for it, as of
        :func:`~jaxltl.core.models.sparse.choice_reward`.
      max_steps: maximal number of pairs of strategies.

    Returns:
      :class:`Solution`; `policy` is ``int32[S]``, optimal for both players; rows in a game on a
      sparse model. `lower` and `upper` are the neighbouring floats where the mean is not a float,
      and infinite where `max_steps` did not suffice. Concrete arrays only; not differentiable.

    Raises:
      ValueError: a move has several successors, the reward has a wrong shape or is not finite,
        or the values are traced.

    Example:
      >>> from jaxltl import from_dense, make_game
      >>> world = from_dense([[[1.0, 0], [0, 1.0]], [[1.0, 0], [0, 1.0]]])
      >>> game = make_game(world, [True, False])
      >>> mean = mean_payoff(game, jnp.array([[1.0, 4.0], [0.0, 3.0]]))
      >>> mean.value.tolist(), mean.policy.tolist()
      ([2.0, 2.0], [1, 0])
    """
    game_model = as_game(game)
    refuse_sharded(game_model)
    if is_traced((game_model, reward)):
        raise ValueError("mean_payoff works on the host; call it outside jit and vmap.")
    form, reward = compiled_form(game_model, reward)
    if isinstance(form.mdp, SparseMDP):
        host = form.mdp.host
        earned = pad_rows(form.mdp, choice_reward(form.mdp, reward))
        solution = mean_payoff(as_padded_game(form), earned, max_steps=max_steps)
        row = pad_rows(form.mdp, np.arange(host.num_rows))
        policy = row[np.arange(host.num_states), np.asarray(solution.policy)]
        return reshape_solution(
            game_model, replace(solution, policy=jnp.asarray(policy, jnp.int32))
        )
    game, reward = form, expected_reward(form, reward)
    if not is_deterministic(game):
        raise ValueError(
            "mean_payoff is for deterministic games, and some move of this one has several "
            "successors; use minimax_value with a discount near 1, or remove chance."
        )
    graph, scale = _graph(form, reward)
    policy, gain, num_steps, done = _mean_iteration(graph, max_steps)
    exact = [Fraction(int(p), int(q) * scale) for p, q in zip(*gain, strict=True)]
    value, lower, upper = _as_floats(exact, np.dtype(game.dtype))
    shape = game.state_shape
    if not done:
        lower, upper = np.full_like(value, -np.inf), np.full_like(value, np.inf)
    return Solution(
        value=jnp.asarray(value.reshape(shape)),
        policy=jnp.asarray(policy.reshape(shape), jnp.int32),
        lower=jnp.asarray(lower.reshape(shape)),
        upper=jnp.asarray(upper.reshape(shape)),
        residual=jnp.zeros((), game.dtype),
        num_steps=jnp.int32(num_steps),
        status=status_code(jnp.bool_(done), jnp.bool_(True)),
    )


class _Graph(NamedTuple):
    """A deterministic game over flat states, with integer rewards."""

    successor: Integers  # int[S, A]
    weight: Integers  # int64[S, A], or Python's integers where these are too small
    available: Booleans
    system: Booleans


class _Biases(NamedTuple):
    """``T(v + t g) = v + (t + 1) g`` for large t, exactly."""

    # g is ``numerator / denominator`` in lowest terms, `rank` orders the gains, and `bias` is the
    # denominator times v.

    numerator: Integers
    denominator: Integers
    rank: Integers
    bias: Integers


def _graph(game: Game, reward: jax.Array) -> tuple[_Graph, int]:
    """The game's graph with its rewards times a common denominator, which is returned."""
    columns = [np.asarray(_only_successor(game, a)) for a in range(game.num_actions)]
    available = np.asarray(game.available).reshape(-1, game.num_actions)
    values = np.where(available, np.asarray(reward, float).reshape(available.shape), 0)
    if not np.isfinite(values).all():
        s, a = np.argwhere(~np.isfinite(values))[0]
        raise ValueError(f"the reward of state {s}, action {a} is {values[s, a]}; make it finite.")
    distinct, place = np.unique(values, return_inverse=True)
    exact = [Fraction(x) for x in distinct.tolist()]
    scale = max(x.denominator for x in exact)  # powers of two
    whole = [int(x * scale) for x in exact]
    # A bias is a sum over a path, times a denominator; sums of slack are longer by a factor S.
    small = 2 * len(values) ** 2 * max(map(abs, whole)) < _most_bias(len(values))
    weight = np.array(whole, np.int64 if small else object)[place.reshape(values.shape)]
    system = np.asarray(game.system).ravel()
    return _Graph(np.stack(columns, -1), weight, available, system), scale


@jit()
def _only_successor(game: Game, action: int) -> jax.Array:
    chain = induced_chain(game, jnp.full(game.state_shape, action, jnp.int32))
    slot = chain.successor_probability[:, 0].argmax(-1)
    if hasattr(chain, "successor"):
        return jnp.take_along_axis(chain.successor[:, 0], slot[:, None], axis=-1)[:, 0]
    return slot


def _most_bias(num_states: int) -> int:
    """The largest bias with which no sum can leave the range of int64."""
    return 2**61 // (8 * num_states)


def _mean_iteration(
    graph: _Graph, max_steps: int
) -> tuple[Integers, tuple[Integers, Integers], int, bool]:
    """Optimal strategies of both players, the gains, the steps, and whether they are optimal."""
    states = np.arange(len(graph.system))
    policy = graph.available.argmax(-1)
    zero = np.zeros(len(states), graph.weight.dtype)
    old = inner = _Biases(zero, zero + 1, np.zeros(len(states), int), zero)
    for n in range(1, max_steps + 1):
        inner = _evaluate(graph.successor[states, policy], graph.weight[states, policy], inner)
        if np.abs(inner.bias).max() > _most_bias(len(states)):
            graph = graph._replace(weight=graph.weight.astype(object))
        answer = _improve(graph, inner, policy, ~graph.system)
        if (answer != policy).any():
            policy = answer
            continue
        inner = old = _taken_over(graph, policy, inner, old)
        # Other biases can make other answers the best ones.
        policy = _improve(graph, inner, policy, ~graph.system)
        better = _improve(graph, inner, policy, graph.system)
        if (better == policy).all():
            return policy, (inner.numerator, inner.denominator), n, True
        policy = better
    return policy, (inner.numerator, inner.denominator), max_steps, False


def _evaluate(successor: Integers, weight: Integers, old: _Biases) -> _Biases:
    """Gains and biases of fixed choices, for which all paths end in cycles, by step doubling."""
    # On each cycle the bias of its first state is the old one where the gain is, and else zero.
    states = np.arange(len(successor))
    doublings = len(states).bit_length()
    first, ahead = states, successor
    for _ in range(doublings):
        first, ahead = np.minimum(first, first[ahead]), ahead[ahead]
    root = first[ahead]
    at_root = root == states
    ahead = np.where(at_root, states, successor)
    paid, length = np.where(at_root, 0, weight), np.where(at_root, 0, 1)
    for _ in range(doublings):
        paid, length, ahead = paid + paid[ahead], length + length[ahead], ahead[ahead]
    total = (weight + paid[successor])[root]
    size = (1 + length[successor])[root]
    if weight.dtype == object:
        length, size = length.astype(object), size.astype(object)
    common = np.gcd(total, size)
    numerator, denominator = total // common, size // common
    same = (numerator == old.numerator[root]) & (denominator == old.denominator[root])
    start = np.where(same, old.bias[root], 0)
    bias = denominator * paid - numerator * length + start
    return _Biases(numerator, denominator, _ranks(numerator, denominator), bias)


def _ranks(numerator: Integers, denominator: Integers) -> Integers:
    pairs = list(zip(numerator.tolist(), denominator.tolist(), strict=True))
    order = sorted(set(pairs), key=lambda pair: Fraction(*pair))
    number = {pair: i for i, pair in enumerate(order)}
    return np.array([number[pair] for pair in pairs])


def _images(graph: _Graph, v: _Biases) -> Integers:
    """Denominator times ``r - g + v(t)`` for each move to t, with the gain g of t."""
    t = graph.successor
    return v.denominator[t] * graph.weight - v.numerator[t] + v.bias[t]


def _improve(graph: _Graph, v: _Biases, policy: Integers, chooser: Booleans) -> Integers:
    """The choosers' best moves, by gain and then by bias; changed only if strictly better."""
    states = np.arange(len(policy))
    sign = np.where(graph.system, 1, -1)[:, None]
    rank = np.where(graph.available, sign * v.rank[graph.successor], -len(states) - 1)
    best = rank.max(-1, keepdims=True)
    image = sign * _images(graph, v)
    level = rank == best
    image = np.where(level, image, image.min() - 1)
    action = image.argmax(-1)
    better = (best[:, 0] > rank[states, policy]) | (image[states, action] > image[states, policy])
    return np.where(chooser & better, action, policy)


def _taken_over(graph: _Graph, policy: Integers, v: _Biases, old: _Biases) -> _Biases:
    """Biases of the environment's best answer that agree with old ones where these fit."""
    # They fit if no gain has changed. Then, on cycles of moves without slack, the bias is the old
    # one; elsewhere it exceeds v by the least sum of slack and excess on the way to such states.
    changed = (v.numerator != old.numerator) | (v.denominator != old.denominator)
    if changed.any():
        return v
    states = np.arange(len(policy))
    own = graph.available & ~graph.system[:, None]
    own[states, policy] = True
    own &= v.rank[graph.successor] == v.rank[:, None]
    slack = _images(graph, v) - v.bias[:, None]
    critical = _on_cycles(graph.successor, own & (slack == 0))
    lift = np.where(critical, old.bias - v.bias, 0)
    ceiling = np.abs(lift).max() + np.where(own, slack, 0).max() * len(states) + 1
    lift = np.where(critical, lift, ceiling)
    slack = np.where(own, slack, 2 * ceiling)
    while True:
        least = np.minimum(lift, (slack + lift[graph.successor]).min(-1))
        if (least == lift).all():
            return v._replace(bias=v.bias + lift)
        lift = least


def _on_cycles(successor: Integers, used: Booleans) -> Booleans:
    """States on a cycle of used moves."""
    from scipy import sparse  # a tenth of a second that only host graphs need

    source = np.broadcast_to(np.arange(len(used))[:, None], used.shape)[used]
    target = successor[used]
    edges = sparse.coo_array((np.ones(len(source), bool), (source, target)), 2 * (len(used),))
    count, part = sparse.csgraph.connected_components(edges, connection="strong")
    large: Booleans = np.bincount(part, minlength=count)[part] > 1
    large[source[source == target]] = True
    return large


def _as_floats(exact: list[Fraction], dtype: np.dtype[np.floating]) -> tuple[Floats, ...]:
    """The nearest floats, and floats that enclose the exact numbers."""
    value = np.array([float(x) for x in exact]).astype(dtype)
    lower, upper = value.copy(), value.copy()
    for i, x in enumerate(exact):
        if Fraction(float(value[i])) != x:
            lower[i] = np.nextafter(value[i], dtype.type(-np.inf))
            upper[i] = np.nextafter(value[i], dtype.type(np.inf))
    return value, lower, upper
