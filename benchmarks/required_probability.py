"""Time of a required probability beside the best one: ``python -m benchmarks.required_probability``.

Random maps with rivers, walls and one demonstration with detours, tasks of ordered visits and
patrols, and probabilities from .5 to .9999: CPU seconds of the job of ``jaxltl learn`` with
``guarantee = "best"`` and with the probability in one process, compiled anew for each, and what is
attained. `--file TASK` measures a task file without `guarantee` at .9 and .999 instead.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jaxltl.algos.common.seeds import Training
from jaxltl.app import learn as job
from jaxltl.core.models.product import product
from jaxltl.core.values.undiscounted.mixture import at_starts
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.envs.gridworld import ACTIONS, gridworld

_FORMULAS = (
    "F(a & X F b) & (!o U b)",
    "F(a & X F(b & X F c)) & (!o U c)",
    "F a & F b & G !o",
    "G F a & G F b & G !o",
    "G F(a & X F(b & X F c)) & G !o",
)
_FILE = """
name = "map {number}"

[world]
map = '''
{map}
'''
slip = {slip}
initial = "s"

[task]
formula = "{formula}"
guarantee = {guarantee}

[demonstrations]
file = "map{number}.json"

[learner]
method = "mlirl"
discount = {discount}
avoid = ["o"]
"""
_DETOUR = 0.15  # probability of a random step
_ROUNDS = 2  # of a patrol


class Case(NamedTuple):
    """A task file but for its guarantee, its demonstration, and a probability to require."""

    text: dict[str, object]
    demonstration: dict[str, object]
    probability: float


def cases(count: int, seed: int = 0) -> list[Case]:
    """Random maps; the best probability of each is above the required one."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < count:
        one = _case(rng, len(found))
        if one is not None:
            found.append(one)
    return found


def _map(rng: np.random.Generator) -> str:
    """A river with a ford or two, some walls, and the places s, a, b and c."""
    rows, columns = int(rng.integers(5, 9)), int(rng.integers(6, 13))
    cells = np.full((rows, columns), ".")
    river = int(rng.integers(2, columns - 2))
    cells[:, river] = "o"
    for _ in range(int(rng.integers(1, 3))):
        top = int(rng.integers(0, rows - 1))
        cells[top : top + int(rng.integers(2, 4)), river] = "."
    for _ in range(int(rng.integers(0, 4))):
        row, column = int(rng.integers(rows - 1)), int(rng.integers(columns - 1))
        wall = cells[row : row + 2, column : column + 2]
        wall[wall == "."] = "#"
    free = np.argwhere(cells == ".")
    for name, (row, column) in zip("sabc", rng.permutation(free)[:4], strict=True):
        cells[row, column] = name
    return "\n".join(map(" ".join, cells))


def _case(rng: np.random.Generator, number: int) -> Case | None:
    text = {
        "number": number,
        "map": _map(rng),
        "slip": float(rng.choice([0.05, 0.1, 0.2])),
        "formula": str(rng.choice(_FORMULAS)),
        "discount": float(rng.choice([0.5, 0.9, 0.95])),
    }
    given = str(text["map"])
    if "o" not in given:
        return None
    world = gridworld(given, slip=text["slip"], initial="s")
    best = optimal_satisfaction(product(world, str(text["formula"])))
    probability = float(np.round(1 - 10 ** rng.uniform(-4, np.log10(0.5)), 4))
    if at_starts(product(world, str(text["formula"])), best.lower, "mean")[0] < probability:
        return None
    cells, actions = _demonstration(rng, given, str(text["formula"]))
    if not cells:
        return None
    return Case(text, {"demonstrations": [{"cells": cells, "actions": actions}]}, probability)


def _demonstration(rng: np.random.Generator, text: str, formula: str) -> tuple[list, list]:
    """Cells and actions of the quickest policy without slip, with random steps that avoid the river."""
    world = gridworld(text, slip=0, initial="s")
    model = product(world, formula)
    best = optimal_satisfaction(model)
    onward, label = np.asarray(world.successor)[..., 0], np.asarray(world.label)
    river = label[:, world.propositions.index("o")]
    final = np.asarray(model.final) if model.automaton.is_cosafe else None
    places = [world.propositions.index(x) for x in "abc" if x in formula]
    s = int(np.argmax(np.asarray(world.initial)))
    q, visits = int(model.initial_memory[s]), 0
    rows, columns = np.shape([line.split() for line in text.splitlines()])
    states, actions = [s], []
    while len(actions) < 40 * rows:
        a = int(np.asarray(best.policy)[s, q])
        if rng.random() < _DETOUR:
            a = int(rng.choice(np.flatnonzero(~river[onward[s]])))
        actions.append(a)
        s = int(onward[s, a])
        q = int(model.next_memory[s, q])
        states.append(s)
        visits += int(label[s, places].any())
        if final is not None and final[s, q]:
            break
        if final is None and visits >= _ROUNDS * len(places):
            break
    else:
        return [], []
    cells = [[s // columns + 1, s % columns + 1] for s in states]
    return cells, [ACTIONS[a] for a in actions]


def write(case: Case, guarantee: float | str, place: Path) -> Path:
    """Writes a task file and its demonstration."""
    number = case.text["number"]
    (place / f"map{number}.json").write_text(json.dumps(case.demonstration))
    path = place / f"map{number}-{guarantee}.toml"
    asked = f'"{guarantee}"' if isinstance(guarantee, str) else guarantee
    path.write_text(_FILE.format(**case.text, guarantee=asked))
    return path


def _run(path: Path) -> tuple[float, dict]:
    """CPU seconds of learning with nothing compiled, and the result."""
    jax.clear_caches()
    before = time.process_time()
    setup = job.prepare(job.FILE.read(path), 0)
    result = job.summary(job.learn(setup, Training(0, 1)))
    return time.process_time() - before, result


def _limit_share(result: dict) -> float:
    """Certified steps of the policy, as a share of their limit."""
    steps = result["expected_steps"]
    return steps["learned_bounds"][1] / steps["limit"]


def _measure(name: str, paths: list[tuple[Path, float]], best: Path) -> None:
    """Prints a line for each required probability."""
    before, first = _run(best)
    for path, probability in paths:
        seconds, result = _run(path)
        how, loss, steps = (
            result["guarantee"],
            result["neg_log_likelihood"],
            result["expected_steps"],
        )
        line = f"{name} {probability:.4f} | {before:5.1f} {seconds:6.1f} {seconds / before:5.2f} | "
        line += f"{result['num_states'] * result['num_memory']:5} "
        line += f"{result['satisfaction']['mean']['lower']:.6f} "
        line += f"{np.inf if loss is None else loss:.5f} mu {how['weight']} share {how['share']} | "
        line += f"{steps['quickest']:.1f} {steps['learned_bounds'][1]:.1f}; of the limit "
        print(f"{line}{_limit_share(result):.3f}, best {_limit_share(first):.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--count", type=int, default=50)
    parser.add_argument("--file", type=Path, help="a task file without guarantee")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    print(
        "map formula p | best s, p s, ratio | states, lower bound, neg. log-likelihood, how | steps"
    )
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        if given.file is not None:
            text, paths = given.file.read_text(), []
            text = text.replace('file = "', f'file = "{given.file.parent.resolve()}/')
            for asked in ('"best"', 0.9, 0.999):
                paths.append((place / f"task-{len(paths)}.toml", asked))
                paths[-1][0].write_text(text.replace("[task]", f"[task]\nguarantee = {asked}"))
            _measure(given.file.stem, paths[1:], paths[0][0])
            return
        for case in cases(given.first + given.count)[given.first :]:
            required = write(case, case.probability, place)
            line = f"{case.text['number']:3} {str(case.text['formula'])[:32]:32}"
            _measure(line, [(required, case.probability)], write(case, "best", place))


if __name__ == "__main__":
    main()
