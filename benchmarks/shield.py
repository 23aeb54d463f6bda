"""(n) PPO inside a permissive strategy of a game, beside the same training without its mask.

Two robots on a grid, in turns; the other one mostly comes nearer. The task is never to meet it and
to visit two corners again and again. A permissive strategy of the first half, which holds against
whatever the other one does, is computed once; the shielded run may do only what it allows, from
its first step on. Both runs have the same settings and rewards. Meetings are counted over every
step of training.

    python -m benchmarks.shield [--steps 10000000] [--size 4]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial

import jaxltl as jl
from jaxltl.algos import ppo
from jaxltl.algos.common.schedules import Linear
from jaxltl.core.environments.environment import Timestep
from jaxltl.core.environments.episodes import with_time_limit
from jaxltl.envs.robots import robots

_SAFE = "G !collision"
_PATROL = "G F system_lower_left & G F system_upper_right"
_EPISODE = 100
_DISCOUNT = 0.95


def _seen(cells: int, state: jax.Array) -> jax.Array:
    """Both places and whose turn it is, one-hot."""
    other, own, turn = jnp.unravel_index(state, (cells, cells, 2))
    return jnp.concatenate(
        [jax.nn.one_hot(other, cells), jax.nn.one_hot(own, cells), turn[None].astype(float)]
    )


def _counted(step: Any, meeting: jax.Array, world: Any, action: jax.Array, key: jax.Array) -> Any:
    """A meeting costs 1."""
    found = Timestep(*step(world, action, key))
    return found._replace(cost=jnp.asarray(meeting)[found.world.world].astype(float))


def _state(world: Any) -> jax.Array:
    return world.world


def chaser(game: Any, size: int) -> np.ndarray:
    """The other robot's weights: nearer is better, but not always."""
    after = np.asarray(game.mdp.successor)[..., 0]
    other, own, _ = np.unravel_index(after, (size**2, size**2, 2))
    apart = np.abs(np.subtract(np.divmod(other, size), np.divmod(own, size))).sum(0)
    return np.where(np.asarray(game.mdp.available), np.exp(-1.0 * apart), 0.0)


def worlds(size: int) -> dict[str, Any]:
    """The task's environment without and with the shield, and the seconds that this took."""
    begin = time.perf_counter()
    game = robots(size)
    strategy = jl.permissive_strategy(game, _SAFE)
    seconds = time.perf_counter() - begin
    world = jl.environments.model_environment(
        game, observe=Partial(partial(_seen, size**2)), opponent=chaser(game, size)
    )
    task = jl.task_environment(world, f"{_SAFE} & {_PATROL}", reward="eventual", discount=_DISCOUNT)
    meeting = np.asarray(game.mdp.label)[:, game.mdp.propositions.index("collision")]
    task = task.replace(step=Partial(_counted, task.step, meeting))
    shielded = jl.games.shield_environment(task, strategy, Partial(_state))
    return {
        "unshielded": with_time_limit(task, _EPISODE),
        "shielded": with_time_limit(shielded, _EPISODE),
        "shield_seconds": seconds,
    }


def measure(size: int, steps: int, seed: int = 0) -> Iterator[dict[str, Any]]:
    """A row for each run: meetings in all steps of training, and what was earned."""
    found = worlds(size)
    for name in ("shielded", "unshielded"):
        problem, updates = ppo.make_problem(found[name]), -(-steps // (64 * 128))
        hparams = ppo.Hparams(
            discount=1.0,
            num_envs=64,
            num_steps=128,
            num_minibatches=8,
            normalize_reward=True,
            learning_rate=Linear(1e-3, 0.0, updates),
        )
        begin, used = time.perf_counter(), time.process_time()
        _, metrics = jax.block_until_ready(
            ppo.train(jax.random.key(seed), problem, hparams, num_steps=updates, max_rows=updates)
        )
        meetings = np.rint(np.asarray(metrics.cost, float) * 64 * 128).astype(int)
        tenth = max(updates // 10, 1)
        yield {
            "run": name,
            "size": size,
            "steps": updates * 64 * 128,
            "meetings": int(meetings.sum()),
            "meetings_in_last_tenth": int(meetings[-tenth:].sum()),
            "episodes": int(metrics.episodes.sum()),
            "episode_return": round(float(jnp.nanmean(metrics.episode_return[-tenth:])), 4),
            "first_episode_return": round(float(jnp.nanmean(metrics.episode_return[:tenth])), 4),
            "status": int(metrics.status.max()),
            "seconds": round(time.perf_counter() - begin, 1),
            "cpu_seconds": round(time.process_time() - used, 1),
            "shield_seconds": round(found["shield_seconds"], 2),
        }


def main() -> None:
    """Prints a line of JSON for each run."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.shield", description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000_000)
    parser.add_argument("--size", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    for row in measure(chosen.size, chosen.steps, chosen.seed):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
