"""``python -m benchmarks.mesh [--states N] [--large N]``: models over devices and processes.

A grid, whose halo is small, and a random graph, of which all values are exchanged: seconds a sweep
of a certified discounted value and of a certified maximal reachability, on 1, 2 and 4 devices and,
for comparison, on none (the padded model itself); how much is exchanged against what is needed.
``--large N``: a model of 10 N transitions made by parts in two processes.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl
from benchmarks.timing import once
from jaxltl.core.models.mesh.lanes import on_host

_DEVICES = (1, 2, 4)
_ACTIONS, _WIDTH = 2, 5


def strip(columns: int, num_states: int) -> Callable[[int, int], jl.models.ModelPart]:
    """States in rows of so many: each action goes on, to and fro and across; some keep, some pay.

    A state's number alone says what it is, so that any part can be made anywhere.
    """

    def part(start: int, stop: int) -> jl.models.ModelPart:
        state = np.arange(start, stop, dtype=np.int64)
        noise = _mixed(state)
        kind = noise % 20  # 0: a goal, 1 and 2: traps
        still = kind <= 2
        moves = np.array([1, -1, columns, -columns, 0])
        ahead = (state[:, None] + moves) % num_states
        ahead[still] = state[still, None]
        share = 0.1 + (_mixed(state + num_states) % 1000) / 2000  # 0.1 to 0.6
        first = np.stack(
            [share, 0.8 - share, *[np.full(state.size, x) for x in (0.1, 0.05, 0.05)]], 1
        )
        probability = np.stack([first, first[:, [2, 3, 0, 1, 4]]], 1)
        successor = np.broadcast_to(ahead[:, None], probability.shape)
        earned = (noise // 20 % 1000) / 1000
        return jl.models.ModelPart(
            np.arange(0, successor.size + 1, _WIDTH),
            successor.ravel(),
            probability.ravel(),
            np.arange(0, _ACTIONS * state.size + 1, _ACTIONS),
            label=(kind == 0)[:, None],
            rewards={"earned": np.repeat(earned, _ACTIONS)},
        )

    return part


def scattered(num_states: int) -> Callable[[int, int], jl.models.ModelPart]:
    """The same with successors anywhere."""
    near = strip(1, num_states)

    def part(start: int, stop: int) -> jl.models.ModelPart:
        found = near(start, stop)
        number = np.arange(found.successor.size, dtype=np.int64) + start * _ACTIONS * _WIDTH
        anywhere = _mixed(number) % num_states
        own = np.repeat(np.arange(start, stop), _ACTIONS * _WIDTH)
        stays = _mixed(own) % 20 <= 2
        return jl.models.ModelPart(
            found.entry_start,
            np.where(stays, own, anywhere),
            found.probability,
            found.row_start,
            label=found.label,
            rewards=found.rewards,
        )

    return part


def _mixed(x: np.ndarray) -> np.ndarray:
    """The finaliser of SplitMix64 (Steele, Lea and Flood 2014), 62 bits of it."""
    z = x.astype(np.uint64) + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return ((z ^ (z >> np.uint64(31))) >> np.uint64(2)).astype(np.int64)


def questions(model: Any, reward: Any, goal: Any) -> dict[str, Callable[[], Any]]:
    """Certified solves; each returns a solution."""
    return {
        "discounted": lambda: jl.optimal_value(
            model, reward, 0.95, method="value_iteration", tolerance=5e-3
        ),
        "reachability": lambda: jl.reachability_probability(model, goal, tolerance=5e-3),
    }


def _asked_of(model: Any) -> tuple[Any, Any, Any]:
    return model, model.rewards["earned"], jax.jit(lambda x: x.label[:, 0])(model)


def measure(part: Any, num_states: int, num_devices: int, repeats: int = 3) -> dict[str, Any]:
    """Seconds a sweep on so many devices; on 0 of the padded model."""
    if num_devices:
        mesh = jax.make_mesh((num_devices,), ("states",), devices=jax.devices()[:num_devices])
        given = _asked_of(
            jl.models.model_from_parts(part, num_states, mesh, propositions=("goal",))
        )
    else:
        given = _padded(part, num_states)
    found: dict[str, Any] = {"devices": num_devices}
    for name, ask in questions(*given).items():
        first, solution = once(ask)
        seconds = min(once(ask)[0] for _ in range(repeats))
        found[name] = {
            "seconds": seconds,
            "first": first,
            "steps": int(solution.num_steps),
            "a_step": seconds / int(solution.num_steps),
            "status": int(solution.status),
            "width": float(jnp.max(solution.upper - solution.lower)),
        }
    if num_devices:
        found["exchanged"] = given[0].num_exchanged
    return found


def _padded(part: Any, num_states: int) -> tuple[Any, Any, Any]:
    whole = part(0, num_states)
    shape = (num_states, _ACTIONS, _WIDTH)
    model = jl.make_mdp(
        whole.successor.reshape(shape),
        whole.probability.reshape(shape),
        label=whole.label,
        propositions=("goal",),
    )
    reward = whole.rewards["earned"].reshape(shape[:2]).astype(np.float32)
    return model, jax.device_put(reward), model.label[:, 0]


# --- a model that is made by parts in two processes -----------------------------------------------


def large(num_states: int, processes: int) -> None:
    """What each of some processes tells of a strip of so many states."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        port = one.getsockname()[1]
    command = [sys.executable, "-m", "benchmarks.mesh", "--states", str(num_states), "--part"]
    running = [subprocess.Popen([*command, f"{i},{processes},{port}"]) for i in range(processes)]
    for process in running:
        process.wait()


def _of_process(num_states: int, place: str) -> None:
    process, processes, port = (int(x) for x in place.split(","))
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    jax.distributed.initialize(f"127.0.0.1:{port}", processes, process)
    mesh = jax.make_mesh((jax.device_count(),), ("states",))
    begin = time.perf_counter()
    model = jl.models.model_from_parts(
        strip(1000, num_states), num_states, mesh, propositions=("goal",)
    )
    told: dict[str, Any] = {
        "process": process,
        "transitions": num_states * _ACTIONS * _WIDTH,
        "made_seconds": time.perf_counter() - begin,
        "bytes_a_device": sum(
            piece.data.nbytes for x in jax.tree.leaves(model) for piece in x.addressable_shards
        ),
        "exchanged": model.num_exchanged,
    }
    for name, ask in questions(*_asked_of(model)).items():
        seconds, solution = once(ask)
        told[name] = {
            "seconds": seconds,
            "steps": int(on_host(solution.num_steps)),
            "status": int(on_host(solution.status)),
            "width": float(on_host(jax.jit(lambda s: jnp.max(s.upper - s.lower))(solution))),
            "mean": float(on_host(jax.jit(jnp.mean)(solution.value))),
        }
    told["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(json.dumps(told), flush=True)
    jax.distributed.shutdown()


def main() -> None:
    """A line a case."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mesh", description=__doc__)
    parser.add_argument("--states", type=int, default=200_000)
    parser.add_argument("--large", type=int, help="states of a model in two processes")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--part", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.part:
        _of_process(asked.states, asked.part)
        return
    if asked.large:
        large(asked.large, asked.processes)
        return
    jax.config.update("jax_num_cpu_devices", max(_DEVICES))
    load = ", ".join(f"{x:.1f}" for x in os.getloadavg())
    print(f"jax {jax.__version__}, {os.cpu_count()} cores, load {load}")
    for name, part in (("strip", strip(400, asked.states)), ("random", scattered(asked.states))):
        for devices in (0, *_DEVICES):
            print(
                json.dumps(
                    {"model": name, "states": asked.states, **measure(part, asked.states, devices)}
                ),
                flush=True,
            )
    for devices in _DEVICES[1:]:  # weak scaling: as many states a device
        size = asked.states * devices
        print(
            json.dumps(
                {"model": "strip, weak", "states": size, **measure(strip(400, size), size, devices)}
            ),
            flush=True,
        )


if __name__ == "__main__":
    main()
