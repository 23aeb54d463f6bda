"""(e) Moves of Q-learning in a second against a compiled loop, and the time to learn a game."""

from __future__ import annotations

import json
import os
import platform
import time
from functools import partial
from typing import Any

import jax
import numpy as np

from benchmarks.timing import compare
from jaxltl.algos import maximin_q
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.construct.restrict import restrict
from jaxltl.core.models.game import Game
from jaxltl.core.models.ops.operators import forall_successor
from jaxltl.envs.robots import diagonal_reward, robots

_DISCOUNT = 0.9
_MOVES = 1 << 24


def safe_robots(size: int) -> Game:
    """The game of section 5.5, example 1, under its most permissive strategy."""
    game = robots(size)
    collision = game.label[:, game.propositions.index("collision")]
    region = ~attractor(game, collision, rule=~game.system).region
    start = np.where(region, game.initial, 0)
    mask = game.available & forall_successor(game, region)
    return restrict(game, start / start.sum(), allowed=mask).model


def exact_value(game: Game, reward: np.ndarray) -> np.ndarray:
    """Plain sweeps in double precision."""
    system, available = np.asarray(game.system), np.asarray(game.available)
    successor = np.asarray(game.mdp.successor)[..., 0]
    factor = np.where(system, _DISCOUNT, 1.0)[:, None]
    value = np.zeros(len(system))
    for _ in range(1000):
        q = reward + factor * value[successor]
        most = np.where(available, q, -np.inf).max(-1)
        least = np.where(available, q, np.inf).min(-1)
        value, before = np.where(system, most, least), value
        if np.abs(value - before).max() < 1e-12:
            break
    return value


def make_peer(game: Game, reward: np.ndarray):
    """The same learning by one chain in a compiled loop: uniform play, alpha 1, xorshift."""
    import numba

    available, system = np.asarray(game.available), np.asarray(game.system)
    successor = np.ascontiguousarray(np.asarray(game.mdp.successor)[..., 0])
    choice = np.argsort(~available, axis=1, kind="stable").astype(np.int32)
    count = available.sum(1).astype(np.int32)
    reward = reward.astype(np.float32)

    @numba.njit
    def loop(q, reward, successor, choice, count, system, discount, s, bits, num_moves):
        for _ in range(num_moves):
            bits ^= bits << np.uint64(13)
            bits ^= bits >> np.uint64(7)
            bits ^= bits << np.uint64(17)
            drawn = ((bits >> np.uint64(33)) * np.uint64(count[s])) >> np.uint64(31)
            a = choice[s, drawn]
            t = successor[s, a]
            best = q[t, choice[t, 0]]
            for i in range(1, count[t]):
                x = q[t, choice[t, i]]
                if (x > best) == system[t]:
                    best = x
            q[s, a] = reward[s, a] + (discount * best if system[s] else best)
            s = t
        return s, bits

    q = np.zeros(available.shape, np.float32)
    place = [np.int64(np.argmax(system)), np.uint64(88172645463325252)]

    def play(num_moves: int) -> np.ndarray:
        place[:] = loop(
            q,
            reward,
            successor,
            choice,
            count,
            system,
            np.float32(_DISCOUNT),
            place[0],
            np.uint64(place[1]),
            num_moves,
        )
        return q

    return play


def _error(q: np.ndarray, game: Game, exact: np.ndarray, where: np.ndarray) -> float:
    available, system = np.asarray(game.available), np.asarray(game.system)
    most, least = np.where(available, q, -np.inf).max(-1), np.where(available, q, np.inf).min(-1)
    return float(np.abs(np.where(system, most, least) - exact)[where].max())


def run(size: int = 10, num_chains: tuple[int, ...] = (1024, 4096, 16384)) -> list[dict[str, Any]]:
    """float32, after compilation; our two cores against the peer's one."""
    game = safe_robots(size)
    reward = np.asarray(diagonal_reward(game), float)
    exact = exact_value(game, reward)
    problem = maximin_q.make_problem(game, reward)
    problem = maximin_q.with_exact_value(problem, exact, maximin_q.recurrent_states(problem))
    play = make_peer(game, reward)
    play(10)
    rows = []
    for chains in num_chains:
        for name, step_size in (("alpha 1", None), ("any alpha", 0.5)):
            hparams = maximin_q.Hparams(discount=_DISCOUNT, num_chains=chains, step_size=step_size)
            start = maximin_q.init(jax.random.key(0), problem, hparams)
            num_steps = _MOVES // (chains * hparams.moves_per_step)
            ours = partial(maximin_q.run, start, problem, hparams, num_steps=num_steps)
            timed = compare(ours, partial(play, _MOVES), repeats=9)
            rows.append(
                {
                    "name": f"Q-learning, robots {size}, {chains} chains, {name}",
                    "states": game.num_states,
                    "peer": "numba, one chain, alpha 1",
                    "moves": _MOVES,
                    "moves_per_second": _MOVES / timed["seconds"],
                    "peer_moves_per_second": _MOVES / timed["peer_seconds"],
                    # Steps of other sizes are for games with chance; the peer makes none.
                    "target": 1.0 if step_size is None and chains == max(num_chains) else None,
                    **timed,
                }
            )
    rows.append(_learned_row(problem, game, reward, exact, max(num_chains)))
    return [{k: v for k, v in row.items() if v is not None} for row in rows]


def _learned_row(problem, game, reward, exact, num_chains: int) -> dict[str, Any]:
    """Seconds from nothing to a largest error of 1e-3 on the recurrent states, of both."""
    hparams = maximin_q.Hparams(discount=_DISCOUNT, num_chains=num_chains)
    start = maximin_q.init(jax.random.key(1), problem, hparams)
    _, metrics = maximin_q.run(start, problem, hparams, num_steps=60)
    num_steps = 1 + int(np.argmax(np.asarray(metrics.error) < 1e-3))
    ours = partial(maximin_q.run, start, problem, hparams, num_steps=num_steps)
    state, metrics = ours()
    where = np.asarray(problem.measured)
    play, needed, chunk = make_peer(game, reward), 0, 1 << 18
    play(0)
    while _error(play(chunk), game, exact, where) >= 1e-3:
        needed += chunk
    peer = partial(make_peer(game, reward), needed + chunk)
    peer()
    return {
        "name": f"Q-learning, robots to error 1e-3, {num_chains} chains",
        "states": game.num_states,
        "peer": "numba, one chain, alpha 1",
        "target": 1.0,
        "moves": float(metrics.moves[-1]),
        "peer_moves": needed + chunk,
        "error": float(metrics.error[-1]),
        "violations": int(state.violations),
        **compare(ours, peer, repeats=5),
    }


def main() -> None:
    """Prints a row each, and all as one JSON line."""
    begin = time.perf_counter()
    rows = run()
    for row in rows:
        print(
            f"{row['name']:<50} {row['compile_seconds']:8.2f} {row['seconds']:8.3f} "
            f"{row['peer_seconds']:8.3f} {row['ratio']:7.3f}"
        )
    machine = {
        "cores": os.cpu_count(),
        "machine": platform.machine(),
        "jax": jax.__version__,
        "total_seconds": time.perf_counter() - begin,
    }
    print(json.dumps({"machine": machine, "rows": rows}))


if __name__ == "__main__":
    main()
