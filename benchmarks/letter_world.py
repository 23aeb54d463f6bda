"""``python -m benchmarks.letter_world [--seeds N] [--layouts N] [--chunks N]``: unseen formulas.

One network a seed is trained by PPO on drawn sequences in the letter world; then it does the ten
finite tasks of Jackermeier, Cloete and Abate (2026, "Jaxolotl") and one more of Jackermeier and Abate
(2025), of which it has seen none: success with its exact interval, steps to it, and how far from the
certified optimum it is, map by map. Published in 2025, after 15 million steps, for the first four and
the last: success .999, .982, 1.000, .969, .997 in 9.7, 7.3, 12.2, 12.1, 9.5 steps. Then infinite
tasks, two of theirs and one of ours: accepting visits in 1,000 steps, on average. ``--episodes 0``
computes the gaps alone.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import jax
import numpy as np
from jax.tree_util import Partial

from jaxltl.algos import many_tasks, ppo
from jaxltl.core.automata.automaton import Automaton, make_automaton
from jaxltl.core.automata.runs import Verdict, lasso_verdicts
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.sequence_task import (
    make_events,
    sequence_environment,
    sequence_sampler,
)
from jaxltl.core.environments.tabulate import tabulate
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.values.evaluation.evaluation import evaluate
from jaxltl.core.values.evaluation.optimality_gap import optimality_gap, tabulate_policy
from jaxltl.envs.letter_world import events_seen, letter_world

TASKS = (
    "F(a & (!b U c)) & F d",
    "(F d) & (!f U (d & F b))",
    "F((a | c | j) & F b) & F(c & F d) & F k",
    "!a U (b & (!c U (d & (!e U f))))",
    "G !(k | l) & F(a & F(e & F(i & F d)))",
    "G !(a | b | c | d) & G(h -> (!f U g)) & F g & F(h & F i)",
    "F((a | l) & (a -> (!b U (c & F d))) & (l -> F g))",
    "F(a & F(b & F(c & F(d & F(e & F(f & F(g & F h)))))))",
    "G !l & F(i & F(e & F(a & F(k & F(g & F c)))))",
    "!(b | d | f | h | j) U (l & F((a | k) & (a -> F c)))",
    "((a | b | c | d) -> F(e & (F f & F g))) U (h & F i)",
)
INFINITE = (  # the first two are theirs
    "G F (e & (!a U f))",
    "G F a & G F b & G F c & G F d & G (!e & !f)",
    "G F (e & X F a) & G F (c & X F d) & G !b",
)
DEPTH = 6
HPARAMS = ppo.Hparams(
    discount=0.94, learning_rate=5e-4, num_envs=256, num_steps=64, num_epochs=3, num_minibatches=8
)
CHUNK = 10  # steps of the learner


def finite_task(formula: str) -> Automaton:
    """A formula of finite runs: a run has succeeded once it satisfies the formula by staying on empty
    cells for ever, so that ``G !l`` has to hold up to then."""
    task = to_automaton(formula)
    empty = int(np.flatnonzero(~task.letters.any(axis=1))[0])
    done = lasso_verdicts(task)[:, empty] == Verdict.SATISFIED
    delta = np.where(done[:, None], np.arange(len(done))[:, None], task.delta)
    return make_automaton(
        delta,
        int(task.initial),
        task.letters,
        task.propositions,
        final=done,
        acceptance="cosafe",
    )


def problems(depth: int = DEPTH) -> list[ppo.Problem]:
    """Sequences of one step, then up to two, three, four, and of up to six."""
    world = letter_world()
    events = make_events(world.propositions)
    network = many_tasks.SequenceNetwork(num_actions=4, events_seen=events_seen)
    found = []
    for longest in (1, 2, 3, 4, depth):
        length = (np.arange(depth) < longest).astype(float)
        sampler = sequence_sampler(
            length, [0.7, 0.2, 0.05, 0.05], [0.3, 0.25, 0.25, 0.1, 0.1], events.any(1)
        )
        found.append(
            ppo.make_problem(sequence_environment(world, events, sampler), network=network)
        )
    return found


def learn(seed: int, chunks: int) -> tuple[Any, many_tasks.Staged]:
    """The trained network of a seed, and how it was learned."""
    stages = problems()

    def told(chunk: int, stage: int, metrics: Any) -> None:
        print(
            f"  seed {seed}: {int(metrics.transitions[-1]):>9,} steps, stage {stage}, "
            f"mean return {np.nanmean(metrics.episode_return):.3f}",
            flush=True,
        )

    found = many_tasks.train_in_stages(
        jax.random.key(seed),
        stages,
        HPARAMS,
        init=ppo.init,
        run=ppo.run,
        num_chunks=chunks,
        num_steps=CHUNK,
        report=told,
    )
    return many_tasks.trained(stages[0].network, found.state.parameters), found


def maps(count: int) -> Any:
    """Maps that are drawn, listed side by side, from each of their empty cells."""
    world = letter_world()
    keys = jax.random.split(jax.random.key(10_000), count)
    state, clock = jax.tree.map(np.asarray, jax.vmap(world.reset)(keys))
    empty = state.letter >= len(world.propositions)
    number, place = np.nonzero(empty)
    begun = state._replace(letter=state.letter[number], place=place.astype(state.place.dtype))
    return tabulate(world, worlds=(begun, clock[number]))


def gaps(network: Any, automaton: Any, table: Any) -> dict[str, float]:
    """The certified optimum and the agent's gap to it, over maps and all their beginnings."""
    world = letter_world()
    plan = many_tasks.make_plan(
        automaton, make_events(world.propositions), world.propositions, depth=DEPTH
    )
    policy = Partial(many_tasks.sequence_policy, network, plan)
    acts = tabulate_policy(policy, world, table, len(automaton.delta))
    found = optimality_gap(table, automaton, acts)
    return {
        "optimum": found.mean_optimum[0],
        "gap": found.mean[1],
        "largest gap": float(found.upper.max()),
        "width": found.mean[1] - found.mean[0],
        "beginnings": len(found.start),
    }


def succeeded(network: Any, automaton: Automaton, number: int, episodes: int) -> dict[str, Any]:
    """Success, with its interval, and steps of an agent that keeps its sequence."""
    world = letter_world()
    plan = many_tasks.make_plan(
        automaton, make_events(world.propositions), world.propositions, depth=DEPTH
    )
    found = evaluate(
        jax.random.key(1000 + number),
        many_tasks.sequence_agent(network, plan),
        task_environment(world, automaton),
        num_episodes=episodes,
    )
    return {
        "success": found.success.mean,
        "interval": [found.success.lower, found.success.upper],
        "violation": found.violation.mean,
        "steps": found.length.mean,
    }


def visited(network: Any, formula: str, number: int, episodes: int) -> dict[str, Any]:
    """How often an infinite task is accepted within 1,000 steps."""
    world, automaton = letter_world(horizon=1000), to_automaton(formula)
    plan = many_tasks.make_plan(
        automaton, make_events(world.propositions), world.propositions, depth=DEPTH
    )
    found = evaluate(
        jax.random.key(2000 + number),
        many_tasks.sequence_agent(network, plan),
        task_environment(world, automaton),
        num_episodes=episodes,
    )
    assert found.visits is not None and found.violation is not None
    return {
        "task": formula,
        "visits": found.visits.mean,
        "interval": [found.visits.lower, found.visits.upper],
        "violation": [found.violation.lower, found.violation.mean, found.violation.upper],
    }


def main() -> None:
    """Trains, evaluates and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--chunks", type=int, default=24)
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--layouts", type=int, default=200)
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    table = maps(given.layouts) if given.layouts else None
    seeds = range(given.first, given.first + given.seeds)
    for seed in seeds:
        cpu = time.process_time()
        network, run = learn(seed, given.chunks)
        cpu = time.process_time() - cpu
        steps = int(run.metrics[-1].transitions[-1])
        print(
            f"seed {seed}: {steps:,} steps in {run.seconds[-1]:.0f} s, {cpu:.0f} CPU s, "
            f"{steps / cpu:,.0f} a CPU second",
            flush=True,
        )
        for number, formula in enumerate(TASKS):
            automaton, row = finite_task(formula), {"seed": seed, "task": formula}
            if given.episodes:
                row |= succeeded(network, automaton, number, given.episodes)
            if given.layouts:
                begin = time.process_time()
                row |= gaps(network, automaton, table)
                row["CPU seconds"] = time.process_time() - begin
            rows.append(row)
            print("  " + json.dumps(row), flush=True)
        if not given.episodes:
            continue
        for number, formula in enumerate(INFINITE):
            row = {"seed": seed, **visited(network, formula, number, given.episodes)}
            print("  " + json.dumps(row), flush=True)
    if given.layouts:
        worst = max(row["gap"] for row in rows)
        print(f"gap: at most {worst:.5f}; {time.process_time():.0f} CPU s in all")
    if not given.episodes:
        return
    shares = np.array([row["success"] for row in rows]).reshape(given.seeds, -1)
    print("mean of each task over seeds: " + " ".join(f"{x:.4f}" for x in shares.mean(0)))
    print(f"mean {shares.mean():.4f}, least {shares.min():.4f}")


if __name__ == "__main__":
    main()
