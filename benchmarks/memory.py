"""(d) Peak memory against the model's arrays, each measured in a fresh process."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import resource
import subprocess
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.models import random_mdp, risky_mdp
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import Product, occurring_letters, product
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction


def _settled() -> int:
    """Gives free memory back, forgets earlier peaks, and returns what is resident."""
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)
    with open("/proc/self/clear_refs", "w", encoding="ascii") as file:
        file.write("5")
    return _rss()


def _peak() -> int:
    with open("/proc/self/status", encoding="ascii") as file:
        (line,) = [line for line in file if line.startswith("VmHWM")]
    return int(line.split()[1]) * 1024


def _bytes(tree: Any) -> int:
    return sum(x.nbytes for x in jax.tree.leaves(tree))


def large_product(num_states: int) -> Product:
    """A random world beside ten automaton states: visit eight kinds of states in order."""
    world, _ = risky_mdp(num_states)
    kinds = np.random.default_rng(2).integers(0, 64, num_states)
    names = tuple(f"g{i}" for i in range(8))
    label = kinds[:, None] == np.arange(8)
    world = MDP(
        world.successor,
        world.probability,
        world.available,
        world.initial,
        jnp.asarray(label),
        names,
    )
    formula = "F (g0 & F (g1 & F (g2 & F (g3 & F (g4 & F (g5 & F (g6 & F g7)))))))"
    task = to_automaton(f"X {formula}", letters=occurring_letters(world))
    return product(world, task)


def child(case: str, num_states: int) -> dict[str, Any]:
    """Runs one case in this process and reports its peak above what was there before."""
    jnp.zeros(1).block_until_ready()
    if case == "product":
        model = large_product(num_states)
        solve = lambda: optimal_satisfaction(model, tolerance=1e-4)  # noqa: E731
        reward = None
    elif case == "reachability":
        model, goal = risky_mdp(num_states)
        solve = lambda: reachability_probability(model, jnp.asarray(goal), tolerance=1e-4)  # noqa: E731
        reward = None
    else:
        model = random_mdp(num_states)
        reward = jnp.ones((num_states, model.num_actions)).at[0].set(0)
        solve = lambda: optimal_value(model, reward, 0.95, tolerance=1e-3)  # noqa: E731
    model = jax.block_until_ready(model)
    jax.block_until_ready(solve())  # compilation takes memory of its own
    before = _settled()
    solution = jax.block_until_ready(solve())
    arrays = _bytes(model) + (0 if reward is None else _bytes(reward))
    # What the solver added at its peak, plus the arrays that it was given.
    peak = max(_peak() - before, 0) + arrays
    result = {
        "peak_bytes": peak,
        "model_bytes": arrays,
        "status": int(solution.status),
        "value_bytes": int(solution.value.nbytes),
    }
    if case == "product":
        begin = time.perf_counter()
        jax.block_until_ready(solve())
        result["seconds"] = time.perf_counter() - begin
    return result


def _rss() -> int:
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * resource.getpagesize()


def run(num_states: int) -> list[dict[str, Any]]:
    """float32."""
    rows = []
    for case in ("discounted", "reachability", "product"):
        command = [sys.executable, "-m", "benchmarks.memory", case, str(num_states)]
        done = subprocess.run(command, check=True, capture_output=True, text=True)
        result = json.loads(done.stdout.splitlines()[-1])
        ratio = result["peak_bytes"] / result["model_bytes"]
        rows.append(
            {
                "name": f"peak memory, {case}",
                "states": num_states,
                "peer": "the model's arrays",
                "ratio": ratio,
                "target": 3.0 if case != "product" else None,
                **result,
            }
        )
    return rows


if __name__ == "__main__":
    print(json.dumps(child(sys.argv[1], int(sys.argv[2]))))
