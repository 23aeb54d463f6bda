"""(f) Synthesis, exact values and regions of large games: seconds against what was asked."""

from __future__ import annotations

import statistics
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.timing import once
from jaxltl.core.games.objective import buchi, safety
from jaxltl.core.games.permissive import apply_strategy, permissive_strategy
from jaxltl.core.games.winning import winning_region
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import MDP
from jaxltl.core.types import check
from jaxltl.core.values.discounted.minimax import minimax_value
from jaxltl.envs.robots import diagonal_reward, robots


def synthesize(size: int) -> Any:
    """Example 1 of section 5.5 from nothing: the game, the strategy, the restricted game."""
    game = robots(size)
    return apply_strategy(permissive_strategy(game, safety(game, "!collision")))


def random_game(num_states: int) -> Game:
    """Two moves a state with five successors each, all at random."""
    rng = np.random.default_rng(0)
    shape = (num_states, 2, 5)
    mdp = MDP(
        successor=jnp.asarray(rng.integers(num_states, size=shape), jnp.int32),
        probability=jnp.full(shape, 0.2, jnp.float32),
        available=jnp.ones(shape[:2], bool),
        initial=jnp.full(num_states, 1 / num_states),
        label=jnp.zeros((num_states, 0), bool),
    )
    return Game(mdp, jnp.asarray(rng.random(num_states) < 0.5))


def _row(name: str, target: float, repeats: int, job: Callable[[], Any]) -> dict[str, Any]:
    first, _ = once(job)
    seconds = statistics.median(once(job)[0] for _ in range(repeats))
    return {
        "name": name,
        "peer": "seconds asked for",
        "compile_seconds": max(first - seconds, 0.0),
        "seconds": seconds,
        "peer_seconds": target,
        "ratio": seconds / target,
        "target": 1.0,
    }


def run(states: int = 1_000_000) -> list[dict[str, Any]]:
    """Rows whose ratio is to the seconds asked for."""
    rows = [
        _row("robots, N = 10: synthesis", 0.1, 5, lambda: synthesize(10)),
        _row("robots, N = 30: synthesis", 5.0, 3, lambda: synthesize(30)),
    ]
    with jax.enable_x64(True):  # single precision certifies 1e-4 at values of 10
        large = synthesize(30).model
        reward = diagonal_reward(large)
        rows.append(
            _row(
                "robots, N = 30: exact value to 1e-6",
                30.0,
                3,
                lambda: check(minimax_value(large, reward, 0.9, per="system_move", tolerance=1e-6)),
            )
        )
    game = random_game(states)
    accepting = jnp.asarray(np.random.default_rng(1).random(states) < 0.01)
    rows.append(
        _row(
            f"random stochastic Buchi game, {states} states",
            10.0,
            3,
            lambda: winning_region(game, buchi(game, accepting)),
        )
    )
    return rows
