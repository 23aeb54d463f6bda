"""``python -m benchmarks.conveyor_world [--chains N ...] [--steps N]``: PPO in ConveyorWorld.

For each size and each of its two tasks, ``F(a & F(b & ... F last))`` with either last letter, PPO learns
one agent a seed. The value of each, of drawn and of likeliest actions, is certified by `tabulate_policy`,
next to the certified optimum. Both corridors look alike up to the last item, and no belt leads back, so
that a seed may settle on the wrong one: its certified value shows it.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import jax

from jaxltl.algos import ppo
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.tabulate import tabulate
from jaxltl.core.environments.task_environment import task_environment
from jaxltl.core.values.evaluation.optimality_gap import optimality_gap, tabulate_policy
from jaxltl.envs.conveyor_world import conveyor_world

HPARAMS = ppo.Hparams(
    discount=1.0,
    learning_rate=1e-3,
    entropy_weight=0.05,
    num_envs=32,
    num_steps=64,
    normalize_observation=True,
)


def chain_formula(letters: list[str]) -> str:
    """``F(a & F(b & F c))`` of the letters a, b, c."""
    formula = f"F {letters[-1]}"
    for letter in reversed(letters[:-1]):
        formula = f"F({letter} & {formula})"
    return formula


def learned(chain: int, task: int, num_steps: int, num_seeds: int) -> dict[str, Any]:
    """The certified values of the agents of a task, and the optimum."""
    world = conveyor_world(chain)
    names = list(world.propositions)
    formula = chain_formula([*names[: chain - 1], names[chain - 1 + task]])
    environment = task_environment(world, formula, discount=0.95, shaping="distance")
    problem = ppo.make_problem(environment)
    table, num_memory = tabulate(world), len(to_automaton(formula).delta)
    begin = time.process_time()
    row: dict[str, Any] = {"chain": chain, "formula": formula, "drawn": [], "likeliest": []}
    for seed in range(num_seeds):
        state, metrics = ppo.train(jax.random.key(seed), problem, HPARAMS, num_steps=num_steps)
        for name, agent in (("drawn", ppo.policy), ("likeliest", ppo.greedy)):
            policy = tabulate_policy(agent(state, problem, HPARAMS), environment, table, num_memory)
            gap = optimality_gap(table, formula, policy)
            row[name].append(round(gap.mean_value[0], 6))
            row["optimum"] = gap.mean_optimum
        row["transitions"] = int(metrics.transitions[-1])
    return row | {"CPU seconds": round(time.process_time() - begin, 1)}


def main() -> None:
    """Prints a row for each size and task."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.conveyor_world", description=__doc__
    )
    parser.add_argument("--chains", type=int, nargs="+", default=[2, 4, 8])
    parser.add_argument("--steps", type=int, default=150, help="of the learner")
    parser.add_argument("--seeds", type=int, default=4)
    asked = parser.parse_args()
    for chain in asked.chains:
        for task in (0, 1):
            print(json.dumps(learned(chain, task, asked.steps, asked.seeds)), flush=True)


if __name__ == "__main__":
    main()
