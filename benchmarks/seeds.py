"""Many seeds of a search under ``vmap`` against Python loops over the compiled search of one.

A search of one seed fills the vector units already, so that a batch can be no faster for each
number than a loop over whole searches; what it saves is the loop over steps.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.timing import compare
from jaxltl.algos import cce
from jaxltl.algos.cce import exponential_family as families
from jaxltl.envs import lqr
from jaxltl.envs.networks import make_network

_STEPS = 400


def run(num_seeds: int = 50) -> list[dict[str, Any]]:
    """The regulator's network 2-2-1, 400 steps of 100 samples each."""
    network = make_network("2-2-1")
    family = families.diagonal_gaussian(jnp.zeros(network.num_parameters), 1.0)
    problem = cce.make_problem(lqr.evaluator(lqr.lqr(), network), family, limit=0.0)
    hparams = cce.Hparams(rate=0.1)
    train = partial(cce.train, num_steps=_STEPS, max_rows=1)
    together, alone = jax.jit(jax.vmap(train, (0, None, None))), jax.jit(train)
    by_steps = jax.jit(cce.step)
    keys = jax.random.split(jax.random.key(0), num_seeds)

    def seed_by_seed() -> Any:
        return [alone(key, problem, hparams) for key in keys]

    def step_by_step() -> Any:
        state = cce.init(keys[0], problem, hparams)
        for _ in range(_STEPS):
            state, _ = by_steps(state, problem, hparams)
        return state

    rows = []
    for peer, slow, times, target in (
        ("a loop over the jitted seed", seed_by_seed, 1, 1.0),
        ("a loop over jitted steps", step_by_step, num_seeds, 0.1),
    ):
        timed = compare(partial(together, keys, problem, hparams), slow, repeats=3)
        timed = {k: v * times if k == "peer_seconds" else v for k, v in timed.items()}
        timed |= {k: timed[k] / times for k in timed if k.startswith("ratio")}
        row = {"name": f"LQR, {num_seeds} seeds, {_STEPS} steps", "peer": peer, **timed}
        rows.append({**row, "target": target})
    return rows
