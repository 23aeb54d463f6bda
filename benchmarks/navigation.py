"""Steps of many robots in a second, sensor and policy included, against one compiled loop."""

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
from jaxltl.envs import navigation
from jaxltl.envs.networks import layers

_TRAJECTORIES = 10
_SPREAD = 0.6  # of the parameters, as in the search


def make_peer(world: navigation.Navigation, network: Any):
    """The same evaluation of table 4's task 2 by a loop over robots and steps, in float32.

    Products are written so that the compiler makes vector instructions of them. The peer is
    given the first states, which we draw.
    """
    import numba

    single = jax.tree.map(lambda x: np.asarray(x, np.float32), world)
    goal, obstacle, bounds, offset = single.goal, single.obstacle, single.bounds, single.offset
    inputs, first, second, _ = network.sizes
    horizon, stride, turn = world.horizon, single.speed * single.time_step, np.float32(single.turn)
    weight_of_distance = np.float32(single.weight)

    @numba.njit(fastmath=True)
    def layer(weight, bias, x, y):
        y[:] = bias
        for i in range(len(x)):
            for j in range(len(y)):
                y[j] += weight[i, j] * x[i]

    @numba.njit(fastmath=True)
    def rectify(y):
        for j in range(len(y)):
            y[j] = max(y[j], np.float32(0))

    @numba.njit(fastmath=True)
    def inside(box, x, y):
        return box[0, 0] <= x <= box[1, 0] and box[0, 1] <= y <= box[1, 1]

    @numba.njit(fastmath=True)
    def evaluate(starts, w1, b1, w2, b2, w3, b3, scores):
        num_policies, num_trajectories, _ = starts.shape
        seen = np.empty(inputs, np.float32)
        h1, h2 = np.empty(first, np.float32), np.empty(second, np.float32)
        out = np.empty(2, np.float32)
        middle_x, middle_y = (goal[0, 0] + goal[1, 0]) / 2, (goal[0, 1] + goal[1, 1]) / 2
        for p in range(num_policies):
            objective, visits = np.float32(0), np.float32(0)
            for n in range(num_trajectories):
                x, y, heading = starts[p, n]
                nearest, visited = np.float32(np.inf), False
                for _ in range(horizon):
                    dx = max(obstacle[0, 0] - x, x - obstacle[1, 0])
                    dy = max(obstacle[0, 1] - y, y - obstacle[1, 1])
                    ax, ay = max(dx, np.float32(0)), max(dy, np.float32(0))
                    distance = np.sqrt(ax * ax + ay * ay) + min(max(dx, dy), np.float32(0))
                    nearest = min(nearest, distance)
                    visited |= inside(goal, x, y)
                    c, s = np.cos(heading), np.sin(heading)
                    for i in range(len(offset)):
                        px = x + (c * offset[i, 0] - s * offset[i, 1])
                        py = y + (s * offset[i, 0] + c * offset[i, 1])
                        seen[i] = np.float32(inside(goal, px, py)) - np.float32(
                            inside(obstacle, px, py)
                        )
                    tx, ty = middle_x - x, middle_y - y
                    length = np.sqrt(tx * tx + ty * ty)
                    scale = np.float32(1) / length if length > 0 else np.float32(0)
                    seen[inputs - 2] = (c * tx + s * ty) * scale
                    seen[inputs - 1] = (c * ty - s * tx) * scale
                    layer(w1[p], b1[p], seen, h1)
                    rectify(h1)
                    layer(w2[p], b2[p], h1, h2)
                    rectify(h2)
                    layer(w3[p], b3[p], h2, out)
                    way = stride * np.tanh(out[0])
                    x = min(max(x + way * c, bounds[0, 0]), bounds[1, 0])
                    y = min(max(y + way * s, bounds[0, 1]), bounds[1, 1])
                    heading += turn * np.tanh(out[1])
                objective += nearest
                visits += visited
            scores[p, 0] = weight_of_distance * objective / num_trajectories
            scores[p, 1] = -visits / num_trajectories

    def run(starts, parameters) -> np.ndarray:
        arrays = [np.ascontiguousarray(x) for pair in parameters for x in pair]
        scores = np.empty((len(starts), 2), np.float32)
        evaluate(starts, *arrays, scores)
        return scores

    return run


def run(populations: tuple[int, ...] = (100, 500)) -> list[dict[str, Any]]:
    """float32, after compilation; our two cores against the peer's one."""
    world = navigation.navigation()
    network = navigation.policy_network(world)
    evaluate = navigation.evaluator(world, 2, network, num_trajectories=_TRAJECTORIES)
    population = jax.jit(lambda e, p, k: jax.vmap(e)(p, k))
    peer = make_peer(world, network)
    rows = []
    for size in populations:
        parameters = _SPREAD * jax.random.normal(
            jax.random.key(0), (size, network.num_parameters), "float32"
        )
        keys = jax.random.split(jax.random.key(1), size)
        states = jax.vmap(
            lambda k: navigation.initial_states(k, world, (_TRAJECTORIES,), "float32")
        )(keys)
        starts = np.stack([np.asarray(x) for x in states], axis=-1)
        lists = jax.vmap(lambda p: layers(network, p))(parameters)
        weights = jax.tree.map(np.asarray, lists)
        steps = size * _TRAJECTORIES * world.horizon
        timed = compare(
            partial(population, evaluate, parameters, keys),
            partial(peer, starts, weights),
            repeats=15,
        )
        objective, cost = population(evaluate, parameters, keys)
        theirs = peer(starts, weights)
        # Where a sensor's point is on an edge, rounding may decide what a robot does.
        same = np.isclose(np.stack([objective, cost], -1), theirs, atol=1e-2).all(-1)
        rows.append(
            {
                "name": f"navigation, {size} policies, {_TRAJECTORIES} trajectories each",
                "peer": "numba, one thread",
                "states": size * _TRAJECTORIES,
                "steps": steps,
                "steps_per_second": steps / timed["seconds"],
                "peer_steps_per_second": steps / timed["peer_seconds"],
                "agreeing": float(same.mean()),
                "target": 0.25,
                **timed,
            }
        )
    return rows


def main() -> None:
    """Prints a row each, and all as one JSON line."""
    begin = time.perf_counter()
    rows = run()
    for row in rows:
        print(
            f"{row['name']:<50} {row['steps_per_second'] / 1e6:8.2f} M/s "
            f"{row['peer_steps_per_second'] / 1e6:8.2f} M/s {row['ratio']:7.3f}"
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
