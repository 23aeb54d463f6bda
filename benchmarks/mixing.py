"""``python -m benchmarks.mixing [--states N]``: large random models, where elimination would fill.

A sparse model of two to four choices with four successors each, half of which risk a trap: the
largest probability of a goal beside the padded engine, and the least expected steps; then the
product of a padded world and ten automaton states, largest and least. CPU seconds of single calls
in double precision, of the padded engine without compilation, and how wide the bounds are.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.memory import large_product
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.sparse import SparseMDP, make_sparse
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.core.values.undiscounted.total_reward import total_reward


def random_sparse(num_states: int, seed: int = 0) -> tuple[SparseMDP, np.ndarray, np.ndarray]:
    """The model, its goal states, one in a thousand, and those where runs end, three more."""
    rng = np.random.default_rng(seed)
    choices = rng.integers(2, 5, num_states)
    state = np.repeat(np.arange(num_states), choices)
    successor = rng.integers(0, num_states, (state.size, 4))
    ends = num_states * 4 // 1000
    risky = (rng.random(state.size) < 0.5) | (state < num_states // 2)
    trap = rng.integers(num_states // 1000, ends, state.size)
    successor[:, 0] = np.where(risky, trap, successor[:, 0])
    successor[state < ends] = state[state < ends, None]
    successor.sort(1)
    kept = np.diff(successor, axis=1, prepend=-1) > 0
    weight = np.where(kept, rng.random(successor.shape), 0)
    weight /= weight.sum(1, keepdims=True)
    initial = np.zeros(num_states)
    initial[-1] = 1
    start = [0, *choices.cumsum()], [0, *kept.sum(1).cumsum()]
    model = make_sparse(*start, successor[kept], weight[kept], initial=initial)
    where = np.arange(num_states)
    return model, where < num_states // 1000, where < ends


def measure(name: str, solve: Callable[[], Any], *, relative: bool = False) -> Any:
    """Prints CPU seconds and elapsed ones of a call."""
    cpu, wall = time.process_time(), time.perf_counter()
    found = jax.block_until_ready(solve())
    cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    lower, upper = np.asarray(found.lower), np.asarray(found.upper)
    width = (upper - lower) / np.maximum(upper if relative else 1, 1e-300)
    print(
        f"{name:<44} {cpu:8.2f} {wall:8.2f} {int(found.num_steps):6d} {width.max():9.1e} "
        f"{int(found.status)}",
        flush=True,
    )
    return found


def main() -> None:
    """Prints a row for each question."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--states", type=int, default=1_000_000)
    size = parser.parse_args().states
    print(f"{'':<44} {'CPU s':>8} {'wall s':>8} {'sweeps':>6} {'width':>9} status")
    with jax.enable_x64(True):
        model, goal, ends = random_sparse(size)
        measure("sparse: largest probability", lambda: reachability_probability(model, goal))
        measure(
            "sparse: least expected steps",
            lambda: total_reward(model, np.ones(model.num_rows), ends, objective="min"),
            relative=True,
        )
        padded, target = to_padded(model), jnp.asarray(goal)
        for name in ("with compilation", "padded"):
            measure(
                f"{name}: largest probability",
                lambda: reachability_probability(padded, target, tolerance=5e-7),
            )
    product = large_product(size)
    for objective in ("max", "min"):
        measure(
            f"product, {objective}",
            lambda o=objective: optimal_satisfaction(product, objective=o, tolerance=1e-4),
        )


if __name__ == "__main__":
    main()
