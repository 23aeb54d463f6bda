"""What runs of interval learning bring: samples, and the intervals after them.

The state, the problem and the hyperparameters are those of
:mod:`~jaxltl.algos.interval_learning`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.algos.common import learner, splitmix
from jaxltl.algos.common.play import draw, successor_slot, take
from jaxltl.core.models.game import as_game
from jaxltl.core.models.ops.operators import sample_successor


class _Rules(NamedTuple):
    """What the moves of a step need."""

    problem: Any
    best: jax.Array
    explore: jax.Array
    restart: jax.Array
    start: jax.Array
    next_memory: jax.Array


def sampled(state: Any, problem: Any, hparams: Any) -> jax.Array:
    """How often transitions came in a step's runs, ``int32[S, A, K]``."""
    model = problem.model
    dtype, num_runs = model.dtype, hparams.num_runs
    key = learner.step_key(state)
    stream = splitmix.streams(jax.random.fold_in(key, 0), (num_runs,))
    rules = _Rules(
        problem,
        state.best,
        jnp.asarray(hparams.exploration, dtype),
        jnp.asarray(hparams.restart, dtype),
        jnp.asarray(model.automaton.initial, jnp.int32),
        model.next_memory,
    )
    begin = draw(problem.start_table, splitmix.words(stream, jnp.uint32(0)))
    places = begin, jnp.broadcast_to(rules.start, (num_runs,))
    keys = jax.random.split(jax.random.fold_in(key, 1), hparams.length)

    def move(places: Any, given: Any) -> Any:
        number, key = given
        words = [splitmix.words(stream, 4 * number + i) for i in range(1, 5)]
        return _move(rules, places, words, jax.random.split(key, num_runs))

    number = jnp.arange(hparams.length, dtype=jnp.uint32)
    _, (s, a, k) = lax.scan(move, places, (number, keys))
    return jnp.zeros(state.counts.shape, jnp.int32).at[s, a, k].add(1)


def _move(rules: _Rules, places: Any, words: Any, keys: jax.Array) -> Any:
    """A move of each run, and which transitions these were."""
    problem, (s, q) = rules.problem, places
    world, dtype = problem.model.mdp, problem.model.dtype
    ends = splitmix.uniform(words[0], dtype) < rules.restart
    anew = take(problem.lost, (s, q)) | (take(problem.won, (s, q)) & ends)
    s = jnp.where(anew, draw(problem.start_table, words[1]), s)
    q = jnp.where(anew, rules.start, q)
    explore = splitmix.uniform(words[2], dtype) < rules.explore
    moves = jnp.where(explore[:, None], take(problem.allowed, (s, q)), take(rules.best, (s, q)))
    total = jnp.cumsum(moves.astype(dtype), axis=-1)
    drawn = splitmix.uniform(words[3], dtype)[:, None] * total[:, -1:]
    a = jnp.argmax(total > drawn, axis=-1).astype(jnp.int32)
    t = jax.vmap(sample_successor, (None, 0, 0, 0))(world, keys, s, a)
    slot = successor_slot(as_game(world), s, a, t)
    return (t, take(rules.next_memory, (s, q))), (s, a, slot)


def linear(
    state: Any, counts: jax.Array, new: jax.Array, problem: Any, hparams: Any
) -> tuple[jax.Array, jax.Array]:
    """Linearly updating intervals (Suilen et al. 2022, definition 4; Walter and Augustin 2009).

    ``(n P + k) / (n + N)`` for both ends P, with the larger strength n if all of a choice's
    frequencies ``k / N`` are on the right side of P, and the smaller one if any is not. Strengths
    grow by N.
    """
    dtype = state.lower.dtype
    before = jnp.sum(counts - new, -1, keepdims=True).astype(dtype)
    weak, strong = before + hparams.strength, before + hparams.most_strength
    number = jnp.sum(new, -1, keepdims=True).astype(dtype)
    share = new / jnp.maximum(number, 1)

    def end(prior: jax.Array, agrees: jax.Array) -> jax.Array:
        n = jnp.where(jnp.all(agrees, -1, keepdims=True), strong, weak)
        return (n * prior + new) / (n + number)

    lower = end(state.lower, share >= state.lower)
    return with_room(lower, end(state.upper, share <= state.upper))


def confident(
    state: Any, counts: jax.Array, new: jax.Array, problem: Any, hparams: Any
) -> tuple[jax.Array, jax.Array]:
    """Intervals of all times at once, in closed form.

    The set of :func:`~jaxltl.core.statistics.binomial.anytime` lies in ``n kl(k / n, p) <= log(2 sqrt(n)
    / failure)``, since Jeffreys' mixture is at least ``1 / (2 sqrt(n))`` of any likelihood
    (Willems, Shtarkov and Tjalkens 1995). That is enclosed by ``kl(a, b) >= 2 (a - b)^2`` and
    ``kl(a, b) >= (a - b)^2 / (2 max(a, b))``, of the probabilities and of what is left of one. As
    all these sets hold at once, so does what they have in common.
    """
    dtype = state.lower.dtype
    used = state.upper > 0
    failure = (1 - jnp.asarray(hparams.confidence, dtype)) / problem.num_claims.astype(dtype)
    total = jnp.sum(counts, -1, keepdims=True).astype(dtype)
    n = jnp.maximum(total, 1)
    share, c = counts / n, (jnp.log(2 * jnp.sqrt(n)) - jnp.log(failure)) / n
    lower, upper = _least(share, c), 1 - _least(1 - share, c)
    floor = jnp.minimum(jnp.asarray(hparams.least, dtype), upper)
    lower = jnp.where(used, jnp.maximum(jnp.maximum(lower, floor), state.lower), 0)
    upper = jnp.where(used, jnp.minimum(upper, state.upper), 0)
    return with_room(lower, upper)


def _least(a: jax.Array, c: jax.Array) -> jax.Array:
    """A number below all b with ``kl(a, b) <= c``."""
    a = jnp.clip(a, 0, 1)  # a quotient of equal numbers may be rounded beyond
    other = 1 - a
    near = jnp.minimum(jnp.sqrt(c / 2), jnp.sqrt(2 * c * a))
    return jnp.maximum(a - jnp.minimum(near, c + jnp.sqrt(c * c + 2 * c * other)), 0)


def with_room(lower: jax.Array, upper: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Ends between which there is a distribution, which data may deny, and rounding."""
    lower = lower / jnp.maximum(jnp.sum(lower, -1, keepdims=True), 1)
    upper = jnp.maximum(upper, lower)
    total = jnp.sum(upper, -1, keepdims=True)
    short = (total > 0) & (total < 1)
    return lower, jnp.minimum(jnp.where(short, upper / jnp.where(short, total, 1), upper), 1)
