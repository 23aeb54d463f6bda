"""Speed of simulated programs in the PRISM language against stormpy's simulator, and PPO on one.

A batch on each of two devices takes actions that are drawn evenly among the available ones; so
does the peer, which makes one step a call. Rates are steps a second of wall time, and of
processor time, which other programs on the same cores do not change. The folder has a folder for
each family of the Quantitative Verification Benchmark Set, with its programs.

    python -m benchmarks.simulation FOLDER [--lanes 4096] [--steps 1000] [--ppo]
"""

from __future__ import annotations

import argparse
import os
import random
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=2")

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl
from jaxltl.algos import ppo

CASES = {
    "brp": ("brp/brp.prism", "N=64,MAX=5"),
    "consensus.4": ("consensus/consensus.4.prism", "K=4"),
    "zeroconf": ("zeroconf/zeroconf.prism", "N=1000,K=8,reset=false"),
}
_PEER_SECONDS = 5.0
_UPDATES = 50


def batch_of_steps(path: Path, constants: str, lanes: int, steps: int) -> Any:
    """A compiled function of a key: some steps in each lane; the last worlds."""
    program = jl.io.read_program(path, constants)
    environment = jl.io.program_environment(program, labels=[])

    def step(world: Any, key: jax.Array) -> Any:
        first, second = jax.random.split(key)
        action: jax.Array | int = 0
        if program.kind == "mdp":
            mask = environment.allowed(world)
            action = jnp.argmax(jnp.where(mask, jax.random.uniform(first, mask.shape), -1.0))
        return environment.step(world, action, second).world

    def run(key: jax.Array) -> Any:
        begin = jax.vmap(environment.reset)(jax.random.split(key, lanes))
        every = jax.vmap(step)
        return jax.lax.scan(
            lambda world, k: (every(world, jax.random.split(k, lanes)), None),
            begin,
            jax.random.split(key, steps),
        )[0]

    return jax.jit(run)


def our_rates(path: Path, constants: str, lanes: int, steps: int) -> tuple[float, float, float]:
    """Steps a second of wall time and of processor time, and seconds of the first call."""
    run = batch_of_steps(path, constants, lanes, steps)
    devices = jax.devices()[:2]
    keys = [jax.device_put(jax.random.key(i), d) for i, d in enumerate(devices)]
    pool = ThreadPoolExecutor(len(devices))  # calls of one thread follow each other

    def both() -> None:
        list(pool.map(lambda key: jax.block_until_ready(run(key)), keys))

    begin = time.perf_counter()
    both()
    first = time.perf_counter() - begin
    rates = []
    for _ in range(5):
        wall, processor = time.perf_counter(), time.process_time()
        both()
        number = lanes * steps * len(devices)
        wall, processor = time.perf_counter() - wall, time.process_time() - processor
        rates.append((number / wall, number / processor))
    return max(r[0] for r in rates), max(r[1] for r in rates), first


def peer_rates(path: Path, constants: str) -> tuple[float, float]:
    """The same of the engine of stormpy's simulator, without the reports of its Python class."""
    import stormpy
    import stormpy.simulator

    program = stormpy.parse_prism_program(str(path))
    given = dict(part.split("=") for part in constants.split(","))
    values = {k: int(v) if v.isdigit() else v == "true" for k, v in given.items()}
    program, _ = stormpy.instantiate_constants(program, values, [])
    engine = stormpy.simulator.create_simulator(program, seed=1)._engine
    draw, count = random.Random(1), 0
    wall, processor = time.perf_counter(), time.process_time()
    while time.perf_counter() - wall < _PEER_SECONDS:
        for _ in range(100):
            if engine.is_sink_state():
                engine.reset_to_initial()
            engine.step(draw.randrange(len(engine.get_choices())))
            count += 1
    return count / (time.perf_counter() - wall), count / (time.process_time() - processor)


def learn(path: Path) -> None:
    """PPO on consensus.2: the probability that the processes disagree, against its optimum.

    The value of the learned policy, which takes the most likely actions, is that of a chain.
    """
    program = jl.io.read_program(path, "K=2")

    def one_hot(world: Any) -> jax.Array:
        parts = [(world[v.name] - v.low, v.high - v.low + 1) for v in program.variables]
        return jnp.concatenate([jax.nn.one_hot(x, n) for x, n in parts])

    environment = jl.io.program_environment(program, observe=one_hot)
    task = jl.task_environment(environment, "!(finished & agree) U (finished & !agree)")
    problem = ppo.make_problem(task)
    hparams = ppo.Hparams(
        discount=1.0,
        learning_rate=2e-3,
        entropy_weight=0.015,
        num_envs=256,
        num_steps=128,
        num_resets=0,
    )
    begin = time.perf_counter()
    state = ppo.init(jax.random.key(0), problem, hparams)
    state, _ = ppo.run(state, problem, hparams, num_steps=_UPDATES)
    seconds = time.perf_counter() - begin
    model = jl.io.build_model(program)
    worlds = {name: jnp.asarray(x, jnp.int32) for name, x in model.valuation.items()}
    # The available actions of a state are its choices, in the same order.
    mask = np.asarray(jax.vmap(environment.allowed)(worlds))
    assert np.array_equal(mask.sum(1), np.diff(model.row_start))
    begins = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), model.num_states))
    observed = jax.vmap(task.observe)(begins._replace(world=worlds))
    scores, _ = jax.vmap(lambda o: problem.network.apply({"params": state.parameters}, o))(observed)
    action = np.asarray(jnp.argmax(jnp.where(mask, scores, -jnp.inf), -1))
    place = (np.cumsum(mask, 1) - 1)[np.arange(model.num_states), action]
    host = model.host.chain(model.row_start[:-1] + place)
    chain = jl.make_sparse(None, host.entry_start, host.successor, host.probability)
    finished, agree = (model.states_with_label(x) for x in ("finished", "agree"))
    value = jl.reachability_probability(chain, finished & ~agree).value[0]
    best = jl.reachability_probability(model, finished & ~agree, objective="max")
    print(
        f"PPO, consensus.2, K = 2, {_UPDATES * 256 * 128} steps in {seconds:.0f} s: disagreement "
        f"{value:.8f}; optimum [{best.lower[0]:.8f}, {best.upper[0]:.8f}]"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--lanes", type=int, default=4096)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--ppo", action="store_true", help="learn in consensus.2 alone")
    given = parser.parse_args()
    if given.ppo:
        learn(given.folder / "consensus/consensus.2.prism")
        return
    for name, (file, constants) in CASES.items():
        path = given.folder / file
        wall, processor, first = our_rates(path, constants, given.lanes, given.steps)
        peer_wall, peer_processor = peer_rates(path, constants)
        print(
            f"{name}: {wall:.3g} steps/s on {len(jax.devices())} devices, {processor:.3g} a "
            f"processor second, first call {first:.1f} s; stormpy {peer_wall:.3g}, "
            f"{peer_processor:.3g}; ratio {processor / peer_processor:.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
