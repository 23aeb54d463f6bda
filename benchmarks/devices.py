"""``python -m benchmarks.devices``: eight lanes, a population, environments on 1, 2 and 4 devices.

Devices of a processor share its cores. So beside seconds stand those of all its threads, which are
what the work costs however many devices share it, also where others are at work on the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

import jaxltl as jl
from benchmarks.lanes import delivery, mlirl_case
from jaxltl.algos import cce, maximin_q, ppo
from jaxltl.algos.cce import exponential_family as families
from jaxltl.envs import lqr
from jaxltl.envs.networks import make_network
from jaxltl.envs.robots import diagonal_reward, robots

_LANES = 8
_DEVICES = (1, 2, 4)


class Case(NamedTuple):
    """What is done on a mesh, or for None by ``vmap`` on one device, without a word of meshes."""

    name: str
    make: Callable[[Mesh | None], Callable[[], Any]]


def _lanes(function: Callable[..., Any], *arguments: Any) -> Callable[[Mesh | None], Any]:
    """Lanes along the first argument."""
    axes = (0, *[None] * (len(arguments) - 1))

    def make(mesh: Mesh | None) -> Callable[[], Any]:
        over = (
            jax.jit(jax.vmap(function, axes))
            if mesh is None
            else jl.vmap_over_mesh(function, mesh, in_axes=axes)
        )
        return partial(over, *arguments)

    return make


def cases() -> Iterator[Case]:
    """Lanes whose loops are long and short, whose steps are many and small; one seed, split."""
    keys = jax.random.split(jax.random.key(0), _LANES)
    game = robots(4)
    inside = jl.games.apply_strategy(
        jl.permissive_strategy(game, jl.games.safety(game, "!collision"))
    ).model
    problem = maximin_q.make_problem(inside, diagonal_reward(inside))
    yield Case(
        "maximin Q-learning, 8 seeds, 60 steps",
        _lanes(
            lambda key, problem: maximin_q.train(
                key, problem, maximin_q.Hparams(discount=0.9), num_steps=60, max_rows=1
            ),
            keys,
            problem,
        ),
    )
    yield Case("inverse RL, 8 values of mu, 10 steps", _lanes(*_irl()))
    world = jl.gridworld(
        "s...\n.t..\n..t.\n...g",
        slip=0.2,
        initial="s",
        legend={"s": ["s"], "t": ["trap"], "g": ["goal"], ".": []},
    )
    task = ppo.make_problem(
        jl.task_environment(jl.environments.model_environment(world), "!trap U goal")
    )
    hparams = ppo.Hparams(discount=1.0, num_envs=16, num_steps=64)
    yield Case(
        "PPO, 8 seeds of 16 environments, 4 steps",
        _lanes(
            lambda key, problem: ppo.train(key, problem, hparams, num_steps=4, max_rows=1),
            keys,
            task,
        ),
    )
    network = make_network("2-2-1")
    search = cce.make_problem(
        lqr.evaluator(lqr.lqr(), network),
        families.diagonal_gaussian(jnp.zeros(network.num_parameters), 1.0),
        limit=0.0,
    )
    yield Case(
        "one search, a population of 2,000, 10 steps",
        _split(cce, search, cce.Hparams(rate=0.1, population=2000), 10),
    )
    yield Case(
        "one PPO, 256 environments, 2 steps", _split(ppo, task, replace(hparams, num_envs=256), 2)
    )


def _irl() -> tuple[Any, ...]:
    case = mlirl_case(delivery())
    return case.function, case.lanes


def _split(module: Any, problem: Any, hparams: Any, num_steps: int) -> Any:
    """One seed, whose settings say where what is drawn lies."""

    def make(mesh: Mesh | None) -> Callable[[], Any]:
        over = None if mesh is None else NamedSharding(mesh, PartitionSpec("devices"))
        train = jax.jit(partial(module.train, num_steps=num_steps, max_rows=1))
        return partial(train, jax.random.key(0), problem, replace(hparams, sharding=over))

    return make


def _spent(function: Callable[[], Any]) -> tuple[float, float]:
    """Seconds, and those of all threads."""
    begin = time.perf_counter(), time.process_time()
    jax.block_until_ready(function())
    return time.perf_counter() - begin[0], time.process_time() - begin[1]


def measure(case: Case, repeats: int) -> dict[str, Any]:
    """Medians of runs in turn: ``vmap`` without a mesh, and on meshes of each number of devices."""
    meshes = [None, *(Mesh(np.array(jax.devices()[:n]), ("devices",)) for n in _DEVICES)]
    functions = [case.make(mesh) for mesh in meshes]
    for function in functions:
        jax.block_until_ready(function())
    spent = [[_spent(function) for function in functions] for _ in range(repeats)]
    seconds, of_threads = (
        [statistics.median(row[i][k] for row in spent) for i in range(len(functions))]
        for k in range(2)
    )
    one = seconds[1]
    return {
        "name": case.name,
        "vmap_seconds": seconds[0],
        "seconds": seconds[1:],
        "vmap_processor_seconds": of_threads[0],
        "processor_seconds": of_threads[1:],
        "speedup": [one / x for x in seconds[1:]],
        "efficiency": [
            one / x / min(n, os.cpu_count() or 1)
            for n, x in zip(_DEVICES, seconds[1:], strict=True)
        ],
    }


def main() -> None:
    """A row a case, and all as one JSON line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.devices", description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    asked = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", max(_DEVICES))
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    print(
        f"jax {jax.__version__}, {os.cpu_count()} cores, load {load}; efficiency is a share of "
        "as many times as there are devices, at most cores"
    )
    rows = []
    for case in cases():
        row = measure(case, asked.repeats)
        rows.append(row)
        print(
            f"{row['name']:48} vmap {row['vmap_seconds']:7.3f} s "
            f"({row['vmap_processor_seconds']:.3f})",
            end="",
        )
        for n, s, p, e in zip(
            _DEVICES, row["seconds"], row["processor_seconds"], row["efficiency"], strict=True
        ):
            print(f" | {n}: {s:7.3f} s ({p:.3f}), {e:.0%}", end="")
        print(flush=True)
    print(json.dumps({"load": load, "rows": rows}))


if __name__ == "__main__":
    main()
