"""Many seeds of a search under ``vmap`` against Python loops over the compiled search of one.

A search of one seed fills the vector units already, so that a batch can be no faster for each
number than a loop over whole searches; what it saves is the loop over steps.

``python -m benchmarks.seeds [--seeds N ...] [LEARNER ...]`` compares ``vmap`` with a loop for each
learner. A ratio of seconds means little if other programs share the cores. The processor's seconds,
divided by the threads that are ready to run, are the seconds of an idle machine: the second ratio.
"""

from __future__ import annotations

import argparse
import os
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from benchmarks.learner_cases import CASES
from benchmarks.timing import Spent, compare, spent
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


def learner(name: str, num_seeds: int, repeats: int) -> str:
    """A row: ``vmap`` and a loop of jitted calls, compiled, the least of runs in turn."""
    case = CASES[name]()
    keys = jax.random.split(jax.random.key(0), num_seeds)
    together, alone = jax.jit(jax.vmap(case.train, (0, None, None))), jax.jit(case.train)

    def loop() -> Any:
        return [jax.block_until_ready(alone(key, case.problem, case.hparams)) for key in keys]

    functions = partial(together, keys, case.problem, case.hparams), loop
    for function in functions:
        jax.block_until_ready(function())
    runs = [[spent(function) for function in functions] for _ in range(repeats)]
    ours, peer = (
        Spent(
            *(min(x) for x in list(zip(*r, strict=True))[:2]), sum(x.threads for x in r) / repeats
        )
        for r in zip(*runs, strict=True)
    )
    idle = [x.processor_seconds / max(x.threads, 1.0) for x in (ours, peer)]
    return " | ".join(
        [
            f"{name:24} | {num_seeds:4}",
            *(
                f"{x.seconds:7.3f} | {x.processor_seconds:7.3f} | {x.threads:4.2f}"
                for x in (ours, peer)
            ),
            f"{ours.seconds / peer.seconds:.2f} | {idle[0] / idle[1]:.2f}",
        ]
    )


def main() -> None:
    """A row for each learner and number of seeds."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.seeds")
    parser.add_argument("learners", nargs="*", default=[""], help="how their names begin")
    parser.add_argument("--seeds", type=int, nargs="*", default=[8, 64])
    parser.add_argument("--repeats", type=int, default=3)
    asked = parser.parse_args()
    print("learner | seeds | vmap: s | processor s | threads | loop: s | ... | ratio | idle ratio")
    for name in filter(lambda x: x.startswith(tuple(asked.learners)), CASES):
        for number in asked.seeds:
            load = ", ".join(f"{x:.0f}" for x in os.getloadavg())
            print(f"{learner(name, number, asked.repeats)} | load {load}", flush=True)


if __name__ == "__main__":
    main()
