"""``python -m benchmarks.flat_world [--box] [--seeds N] [--chunks N]``: unseen formulas.

As :mod:`benchmarks.letter_world`, among the discs of the flat world, with its nine velocities, or
with all those of a box: the
share of episodes that do finite reach-avoid tasks, and for infinite ones how often they are
accepted in 1,000 steps, each with its interval. The network reads which events hold around the
agent, a fixed function of the position, which is all that is seen. Jackermeier and Abate (2025)
publish success about 1.0, in 77 to 82 steps, after 15 million steps, with velocities from a box.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import jax
import numpy as np

from jaxltl.algos import many_tasks, ppo
from jaxltl.algos.common.schedules import Linear
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.environment import Environment, Finite
from jaxltl.core.environments.sequence_task import (
    proposition_sets,
    sequence_environment,
    sequence_sampler,
)
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.values.evaluation.evaluation import evaluate
from jaxltl.envs.flat_world import discs_of, events_around, flat_world

FINITE = (  # the first five are theirs
    "F((red & magenta) & F((blue & green) & F yellow))",
    "F(orange & (!red U magenta))",
    "(!red U (green & blue & aqua)) & F(orange & F(red & magenta))",
    "((!yellow & !orange) U (green & blue)) & (!green U magenta)",
    "(blue -> F magenta) U (yellow | ((green & blue) & F orange))",
    "(!red U (green & blue & aqua)) & F magenta",
    "!(magenta | yellow) U (blue & F orange)",
    "(!yellow U magenta) & F(red & F aqua)",
)
INFINITE = (  # the first two are theirs
    "G F (blue & green) & G F (red & magenta)",
    "G F (aqua & blue) & G F red & G F yellow & G !green",
    "F G blue",
)
DEPTH = 4
CHUNK = 10  # steps of the learner


def hparams(chunks: int) -> ppo.Hparams:
    """Of PPO, whose learning rate falls to a tenth."""
    return ppo.Hparams(
        discount=0.98,
        learning_rate=Linear(1e-3, 1e-4, CHUNK * chunks),
        entropy_weight=0.003,
        num_envs=256,
        num_steps=64,
        num_epochs=3,
        num_minibatches=8,
        num_resets=2048,
    )


def events_in(environment: Environment, cells: int = 400) -> np.ndarray:
    """``bool[E, P]``: the labels that occur at the corners of a fine grid."""
    scene = discs_of(environment)
    line = np.linspace(-scene.extent, scene.extent, cells + 1)
    place = np.stack(np.meshgrid(line, line), -1).reshape(-1, 1, 2)
    inside = ((place - scene.center) ** 2).sum(-1) <= np.asarray(scene.radius) ** 2
    return np.unique(inside @ np.asarray(scene.color), axis=0)


def problems(world: Environment, events: np.ndarray, depth: int = DEPTH) -> list[ppo.Problem]:
    """Sequences of one step, then of up to two, three and four.

    Sets of events are what propositions mean, and single events: automata tell of both.
    """
    actions: Any = world.actions
    acts: dict[str, Any] = (
        {"num_actions": actions.num} if isinstance(actions, Finite) else {"shape": actions.shape}
    )
    network = many_tasks.SequenceNetwork(
        **acts,
        hidden=(128, 128),
        embedding=24,
        detailed=2,
        by_name=True,
        events_seen=events_around(world, events),
    )
    single = np.eye(len(events), dtype=bool)[events.any(1)]
    sets = np.unique(np.concatenate([proposition_sets(events), single]), axis=0)
    found = []
    for longest in range(1, depth + 1):
        length = (np.arange(depth) < longest).astype(float)
        sampler = sequence_sampler(length, [0.75, 0.25], [0.3, 0.3, 0.25, 0.15], sets)
        found.append(
            ppo.make_problem(sequence_environment(world, events, sampler), network=network)
        )
    return found


def learn(seed: int, chunks: int, enough: float, discrete: bool) -> tuple[Any, many_tasks.Staged]:
    """The trained network of a seed, and how it was learned."""
    world = flat_world(discrete=discrete)
    stages = problems(world, events_in(world))

    def told(chunk: int, stage: int, metrics: Any) -> None:
        print(
            f"  seed {seed}: {int(metrics.transitions[-1]):>10,} steps, stage {stage}, "
            f"mean return {np.nanmean(metrics.episode_return):.3f}",
            flush=True,
        )

    found = many_tasks.train_in_stages(
        jax.random.key(seed),
        stages,
        hparams(chunks),
        init=ppo.init,
        run=ppo.run,
        num_chunks=chunks,
        num_steps=CHUNK,
        enough=enough,
        report=told,
    )
    return many_tasks.trained(stages[0].network, found.state.parameters), found


def judged(
    network: Any, formula: str, number: int, episodes: int, discrete: bool
) -> dict[str, Any]:
    """Success within 500 steps of a finite task; of an infinite one its visits in 1,000."""
    finite = formula in FINITE
    world = flat_world(discrete=discrete, horizon=500 if finite else 1000)
    automaton = to_automaton(formula)
    plan = many_tasks.make_plan(automaton, events_in(world), world.propositions, depth=DEPTH)
    found = evaluate(
        jax.random.key(1000 + number),
        many_tasks.sequence_agent(network, plan, actions=world.actions),
        task_environment(world, automaton),
        num_episodes=episodes,
    )
    told = found.success if finite else found.visits
    assert told is not None and found.violation is not None
    return {
        "task": formula,
        "of": "success" if finite else "visits",
        "mean": told.mean,
        "interval": [told.lower, told.upper],
        "violation": found.violation.mean,
        "steps": found.length.mean,
    }


def main() -> None:
    """Trains, evaluates and prints a line for each task."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--box", action="store_true")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--chunks", type=int, default=13)
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--enough", type=float, default=0.8)
    given = parser.parse_args()
    shares = []
    for seed in range(given.first, given.first + given.seeds):
        cpu = time.process_time()
        network, run = learn(seed, given.chunks, given.enough, not given.box)
        cpu = time.process_time() - cpu
        steps = int(run.metrics[-1].transitions[-1])
        print(
            f"seed {seed}: {steps:,} steps in {run.seconds[-1]:.0f} s, {cpu:.0f} CPU s, "
            f"{steps / cpu:,.0f} a CPU second",
            flush=True,
        )
        for number, formula in enumerate((*FINITE, *INFINITE)):
            row = {"seed": seed, **judged(network, formula, number, given.episodes, not given.box)}
            print("  " + json.dumps(row), flush=True)
            shares += [row["mean"]] if row["of"] == "success" else []
    print(f"mean success {np.mean(shares):.4f}, least {np.min(shares):.4f}")


if __name__ == "__main__":
    main()
