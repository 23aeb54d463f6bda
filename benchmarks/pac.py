"""(g) PAC learning in stochastic games: seconds, and what a batch of seeds costs."""

from __future__ import annotations

import statistics
from typing import Any

import jax
import numpy as np
from jax.tree_util import Partial

from benchmarks.games import random_game
from benchmarks.timing import once
from jaxltl.algos import rmax
from jaxltl.envs.post_offices import patrol

_REST = 20_000
_SEEDS = 256


def _row(name: str, peer: str, seconds: float, asked: float, first: float, **more: Any):
    return {
        "name": name,
        "peer": peer,
        "compile_seconds": max(first - seconds, 0.0),
        "seconds": seconds,
        "peer_seconds": asked,
        "ratio": seconds / asked,
        **more,
    }


def _made(moves: Any, before: Any, after: Any, metrics: Any) -> Any:
    return after.moves >= moves


def run() -> list[dict[str, Any]]:
    """The example of section 6.7, alone and as a batch, and a large random game."""
    found = patrol()
    problem = rmax.make_problem(found.game, found.accepting, found.reward)
    hparams = rmax.Hparams(discount=0.6, reward_bound=1.0, epsilon=1e-4, restart=1 / 50)
    train = jax.jit(
        lambda key, p, h: rmax.train_until(
            key, p, h, until=rmax.strategy_is_stable(_REST), num_steps=10**6
        )
    )
    keys = jax.random.split(jax.random.key(0), _SEEDS)
    first, _ = once(lambda: train(keys[0], problem, hparams))
    times = [once(lambda i=i: train(keys[i], problem, hparams))[0] for i in range(11)]
    alone = statistics.median(times)
    batch = jax.jit(jax.vmap(train, (0, None, None)))
    first_batch, _ = once(lambda: batch(keys, problem, hparams))
    together = statistics.median(once(lambda: batch(keys, problem, hparams))[0] for _ in range(5))
    rows = [
        _row(
            "R-max, two post offices, one seed", "seconds asked for", alone, 0.3, first, target=1.0
        ),
        _row(
            f"R-max, two post offices, {_SEEDS} seeds",
            "one seed",
            together,
            alone,
            first_batch,
            target=20.0,
        ),
    ]
    game, rng = random_game(10_000), np.random.default_rng(1)
    large = rmax.make_problem(
        game, rng.random(game.num_states) < 0.01, rng.random((game.num_states, 2))
    )
    hparams = rmax.Hparams(discount=0.9, reward_bound=1.0, epsilon=0.1, known_after=20)

    def million(moves: int):
        return rmax.train_until(
            jax.random.key(0), large, hparams, until=Partial(_made, moves), num_steps=moves
        )

    first, _ = once(lambda: million(1))
    seconds, learned = once(lambda: million(1_000_000))
    rows.append(
        _row(
            "R-max, 10^4 states, a million moves",
            "seconds asked for",
            seconds,
            60.0,
            first + seconds,
            target=1.0,
            updates=int(learned.state.num_updates),
        )
    )
    return rows
