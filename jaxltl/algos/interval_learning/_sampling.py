"""Episodes of robust anytime learning, as transition counts."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxltl.core import struct
from jax import lax

from jaxltl.algos.common import learner, splitmix
from jaxltl.algos.common.play import draw, successor_slot, take
from jaxltl.algos.interval_learning.problem import Problem
from jaxltl.algos.interval_learning.state import Hparams, State
from jaxltl.core.models.game import as_game
from jaxltl.core.models.ops.operators import sample_successor

_States = tuple[jax.Array, jax.Array]  # states and memory states of all episodes


@struct.dataclass
class _Rules:
    """Constants of a step."""

    problem: Problem
    best: jax.Array
    explore: jax.Array
    restart: jax.Array
    start: jax.Array
    next_memory: jax.Array


def sampled_counts(state: State, problem: Problem, hparams: Hparams) -> jax.Array:
    """Transition counts of a step's episodes, ``int32[S, A, K]``."""
    model = problem.model
    dtype, num_runs = model.dtype, hparams.num_runs
    key = learner.step_key(state)
    stream = splitmix.streams(jax.random.fold_in(key, 0), (num_runs,))
    rules = _Rules(
        problem=problem,
        best=state.best,
        explore=jnp.asarray(hparams.exploration, dtype),
        restart=jnp.asarray(hparams.restart, dtype),
        start=jnp.asarray(model.automaton.initial, jnp.int32),
        next_memory=model.next_memory,
    )
    first = draw(problem.start_table, splitmix.words(stream, jnp.uint32(0)))
    states = first, jnp.broadcast_to(rules.start, (num_runs,))
    keys = jax.random.split(jax.random.fold_in(key, 1), hparams.length)

    def move(states: _States, x: tuple[jax.Array, jax.Array]) -> tuple[_States, tuple]:
        number, key = x
        words = [splitmix.words(stream, 4 * number + i) for i in range(1, 5)]
        return _move(rules, states, words, jax.random.split(key, num_runs))

    number = jnp.arange(hparams.length, dtype=jnp.uint32)
    _, (s, a, k) = lax.scan(move, states, (number, keys))
    return jnp.zeros(state.counts.shape, jnp.int32).at[s, a, k].add(1)


def _move(
    rules: _Rules, states: _States, words: list[jax.Array], keys: jax.Array
) -> tuple[_States, tuple[jax.Array, jax.Array, jax.Array]]:
    """One move of each episode: the next states, and the indices of the transitions."""
    problem, (s, q) = rules.problem, states
    world, dtype = problem.model.mdp, problem.model.dtype
    ends = splitmix.uniform(words[0], dtype) < rules.restart
    restarts = take(problem.losing, (s, q)) | (take(problem.winning, (s, q)) & ends)
    s = jnp.where(restarts, draw(problem.start_table, words[1]), s)
    q = jnp.where(restarts, rules.start, q)
    explore = splitmix.uniform(words[2], dtype) < rules.explore
    moves = jnp.where(explore[:, None], take(problem.allowed, (s, q)), take(rules.best, (s, q)))
    total = jnp.cumsum(moves.astype(dtype), axis=-1)
    drawn = splitmix.uniform(words[3], dtype)[:, None] * total[:, -1:]
    a = jnp.argmax(total > drawn, axis=-1).astype(jnp.int32)
    t = jax.vmap(sample_successor, (None, 0, 0, 0))(world, keys, s, a)
    slot = successor_slot(as_game(world), s, a, t)
    return (t, take(rules.next_memory, (s, q))), (s, a, slot)
