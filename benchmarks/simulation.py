"""Speed of simulated programs in the PRISM language against stormpy's simulator, and PPO on one.

A batch on each of two devices takes actions that are drawn evenly among the available ones; so
does the peer, which makes one step a call. Rates are steps a second of wall time, and of
processor time, which other programs on the same cores do not change. The folder has a folder for
each family of the Quantitative Verification Benchmark Set, with its programs.

With `--seeds`, the frequencies of 10^6 steps are tested against the probabilities of the built model.

    python -m benchmarks.simulation FOLDER [--lanes 4096] [--steps 1000] [--ppo] [--seeds 10]
"""

from __future__ import annotations

import argparse
import math
import os
import random
import time
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import sparse, stats

import jaxltl as jl
from jaxltl.algos import ppo
from jaxltl.core.language.syntax import Program

CASES = {
    "brp": ("brp/brp.prism", "N=64,MAX=5"),
    "consensus.4": ("consensus/consensus.4.prism", "K=4"),
    "zeroconf": ("zeroconf/zeroconf.prism", "N=1000,K=8,reset=false"),
}
TESTED = {
    "brp": ("brp/brp.prism", "N=64,MAX=5"),
    "consensus.4": ("consensus/consensus.4.prism", "K=4"),
    "zeroconf": ("zeroconf/zeroconf.prism", "N=1000,K=2,reset=false"),
}
LEVEL = 0.01  # of all tests of one program together
_LEAST = 5.0  # expected number of steps to a cell of the test
_PEER_SECONDS = 5.0
_UPDATES = 50


def batch_of_steps(
    program: Program, lanes: int, steps: int, trace: Callable[[Any], Any] | None = None
) -> Any:
    """A compiled function of a key: some steps in each lane; the last worlds and the traces."""
    environment = jl.io.program_environment(program, labels=[])

    def step(world: Any, key: jax.Array) -> Any:
        first, second = jax.random.split(key)
        action: jax.Array | int = 0
        if program.kind == "mdp":
            mask = environment.allowed(world)
            action = jnp.argmax(jnp.where(mask, jax.random.uniform(first, mask.shape), -1.0))
        after = environment.step(world, action, second).world
        return after, None if trace is None else (trace(world), trace(after))

    def run(key: jax.Array) -> Any:
        begin = jax.vmap(environment.reset)(jax.random.split(key, lanes))
        every = jax.vmap(step)
        return jax.lax.scan(
            lambda world, k: every(world, jax.random.split(k, lanes)),
            begin,
            jax.random.split(key, steps),
        )

    return jax.jit(run)


def our_rates(path: Path, constants: str, lanes: int, steps: int) -> tuple[float, float, float]:
    """Steps a second of wall time and of processor time, and seconds of the first call."""
    run = batch_of_steps(jl.io.read_program(path, constants), lanes, steps)
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


def p_values(program: Program, seeds: int, lanes: int = 1000, steps: int = 1000) -> list[float]:
    """Pearson's test of simulated transitions given their states, once for each seed.

    Available actions are drawn evenly. States whose cells have less than 5 expected transitions
    are not tested; a transition that the model does not have is an error.
    """
    model = jl.io.build_model(program)
    names = [v.name for v in program.variables]
    sizes = [v.high - v.low + 1 for v in program.variables]
    assert math.prod(sizes) < 2**63, "the states of a tested program have numbers"
    base = np.cumprod([1, *sizes[:-1]])
    own = np.stack([model.valuation[n].astype(np.int64) for n in names], -1) @ base
    order, size = np.argsort(own), model.num_states
    host, rows = model.host, np.diff(model.row_start)
    state_of_row = np.repeat(np.arange(size), rows)
    share = (1 / rows[state_of_row]).repeat(np.diff(host.entry_start))
    shape, start = (host.num_rows, size), host.entry_start
    every = sparse.csr_array((host.probability * share, host.successor, start), shape)
    mean = sparse.csr_array((np.ones(state_of_row.size), state_of_row, np.arange(shape[0] + 1)))
    law = (mean.T @ every).tocsr()
    law.sort_indices()
    of_entry = np.repeat(np.arange(size), np.diff(law.indptr))
    entry = of_entry * size + law.indices
    run = batch_of_steps(
        program, lanes, steps, lambda w: jnp.stack([w[n].astype(jnp.int32) for n in names])
    )
    found = []
    for seed in range(seeds):
        worlds = [np.asarray(x).astype(np.int64) @ base for x in run(jax.random.key(seed))[1]]
        state, target = (order[np.searchsorted(own, x, sorter=order).ravel()] for x in worlds)
        at = np.searchsorted(entry, state * size + target)
        assert (entry[at] == state * size + target).all()
        count = np.bincount(at, minlength=entry.size)
        expected = np.bincount(state, minlength=size)[of_entry] * law.data
        kept = ~np.isin(of_entry, of_entry[expected < _LEAST])
        free = kept.sum() - np.unique(of_entry[kept]).size
        statistic = ((count - expected)[kept] ** 2 / expected[kept]).sum()
        found.append(float(stats.chi2.sf(statistic, free)))
    return found


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
    parser.add_argument("--seeds", type=int, help="test the frequencies of 10^6 steps of each seed")
    given = parser.parse_args()
    os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=2")
    if given.seeds:
        warnings.simplefilter("ignore")
        for name, (file, constants) in TESTED.items():
            program = jl.io.read_program(given.folder / file, constants)
            p = sorted(p_values(program, given.seeds))
            passed = p[0] >= LEVEL / given.seeds
            print(
                f"{name}: p-values {', '.join(f'{x:.3f}' for x in p)}; agree: {passed}", flush=True
            )
        return
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
