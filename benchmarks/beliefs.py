"""Bounds of partially observable models in the PRISM language, of the families of SAYNT and HSVI-RP.

Seconds are processor seconds of one core, so that they do not depend on the load of the machine.

    OMP_NUM_THREADS=1 python -m benchmarks.beliefs FOLDER [--only NAME] [--seconds 30]
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np

from jaxltl.core.language.resolve import read_program
from jaxltl.core.programs.build import build_model
from jaxltl.core.values.partial_observability.solve import belief_bounds

MAX_BELIEFS = 1_000_000
# of each family, the target and the states through which it must be reached
QUESTIONS = {
    "crypt": (("correct", 1), None),
    "drone": ("goal", "notbad"),
    "grid": ("goal", "!bad"),
    "nrp": ("unfair", None),
    "refuel": ("goal", "notbad"),
}


def solve(path: Path, seconds: float) -> tuple[float, float, float]:
    """Bounds of the maximal probability, and the processor seconds they took."""
    target, stay = QUESTIONS[path.stem.split("-")[0]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # deadlocks
        pomdp = build_model(read_program(path.read_text()))
    if isinstance(target, tuple):
        variable, value = target
        target = np.asarray(pomdp.fully_observable.valuation[variable]) == value
    begin = time.process_time()
    answer = belief_bounds(pomdp, target, stay=stay, max_beliefs=MAX_BELIEFS, max_seconds=seconds)
    return float(answer.lower), float(answer.upper), time.process_time() - begin


def main() -> None:
    """Prints a line for each model of a folder."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="a part of a model's name")
    parser.add_argument("--seconds", type=float, default=30)
    options = parser.parse_args()
    time.monotonic = time.process_time  # limits in processor seconds
    for path in sorted(options.folder.glob("*.prism")):
        if options.only in path.stem:
            lower, upper, seconds = solve(path, options.seconds)
            print(f"{path.stem:12} [{lower:.5f}, {upper:.5f}] {seconds:7.1f} s", flush=True)


if __name__ == "__main__":
    main()
