"""Likelihood of a demonstration with a mistake: ``python -m benchmarks.mistakes``.

A patrol between two cells of a 30 by 30 map whose demonstration enters the forbidden cell once and
then goes on: the negative log-likelihood of ``mlirl`` with the steps until the mistake, and with all.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from jaxltl.algos.common.seeds import Training
from jaxltl.app import learn as job

_SIZE, _ROUNDS = 30, 2
_TASK = """
[world]
map = '''
{map}
'''
slip = 0.0
initial = "a"
[task]
formula = "G F a & G F b & G !o"
[demonstrations]
file = "shown.json"
[learner]
method = "mlirl"
discount = 0.9
"""


def write(place: Path) -> Path:
    """A task file and its demonstration."""
    cells = np.full((_SIZE, _SIZE), ".")
    cells[0, 0], cells[0, -1], cells[1, _SIZE // 2] = "a", "b", "o"
    there, back = ["right"] * (_SIZE - 1), ["left"] * (_SIZE - 1)
    actions, where = (there + back) * _ROUNDS, np.array([1, 1])
    half = _SIZE // 2
    actions += ["right"] * half + ["down", "up"] + ["right"] * (_SIZE - 1 - half) + back + ["right"]
    shown = [where.tolist()]
    for action in actions[:-1]:
        step = {"right": (0, 1), "left": (0, -1), "down": (1, 0), "up": (-1, 0)}[action]
        where = where + step
        shown.append(where.tolist())
    file = {"demonstrations": [{"cells": shown, "actions": actions}]}
    (place / "shown.json").write_text(json.dumps(file))
    path = place / "task.toml"
    path.write_text(_TASK.format(map="\n".join(map(" ".join, cells))))
    return path


def losses(place: Path) -> Iterator[tuple[str, int, float]]:
    """Number of steps and negative log-likelihood of the kept policy, with and without the cut."""
    setup = job.prepare(job.FILE.read(write(place)), 0)
    every = dataclasses.replace(setup.guarantee, used=None)
    for title, guarantee in (("until the mistake", setup.guarantee), ("all", every)):
        one = dataclasses.replace(setup, guarantee=guarantee)
        outcome = job.learn(one, Training(0, 1))
        loss = float(outcome.kept.learned.neg_log_likelihood[outcome.kept.chosen])
        yield title, int(np.sum(guarantee.until_lost(setup.demonstrations).length)), loss


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as name:
        for title, steps, loss in losses(Path(name)):
            print(f"{title:18} {steps:4} steps, negative log-likelihood {loss:.3g}", flush=True)


if __name__ == "__main__":
    main()
