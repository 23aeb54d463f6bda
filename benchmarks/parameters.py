"""``python -m benchmarks.parameters FOLDER [NAME...]``: parameters by gradients, beside Storm.

With ``--layered LAYERS WIDTH PARAMETERS`` a random chain of layers is written to the folder first.

For each parametric Markov chain (DRN) in a folder: are there parameters, each within a margin of 0
and 1, for which the expected reward until ``goal`` is at most a threshold? Ours from many random
starts in one program, each claim certified; Storm's gradient descent from its one start, with
the same threshold. Processor seconds (they depend less on what else runs): of compiling, once; of
all starts with all proofs, and that by what was proven; of all starts with one proof; of Storm.
What is certified is compared with Storm's exact value, in fractions, of the chain that Storm
instantiates itself.
"""

from __future__ import annotations

import argparse
import json
import re
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jaxltl.algos.feasible import Budget, feasible, make_problem
from jaxltl.io.drn.parametric import read_parametric

# Of the networks, by K, what the literature asks for.
THRESHOLDS = {"2": 3.0, "4": 4.0}
REPEATS = 5
PATIENCE = 10.0  # seconds after which Storm is not asked again


def threshold_of(name: str) -> float:
    """The usual threshold of a network, by its name."""
    found = re.match(r"network2K-(\d+)_", name)
    if found is None or found[1] not in THRESHOLDS:
        raise SystemExit(f"{name} has no usual threshold: give --threshold")
    return THRESHOLDS[found[1]]


def write_layered(path: Path, layers: int, width: int, num_parameters: int) -> None:
    """Layers of states, each of which leads to the next by chance or by a parameter.

    As in the networks many states share a parameter, and what is lost depends on parameters.
    """
    rng = np.random.default_rng(0)
    names = [f"p{d}" for d in range(num_parameters)]
    lines = [
        "@type: DTMC",
        "@parameters",
        " ".join(names),
        "@reward_models",
        "dropped_packets",
        "@nr_states",
        str(layers * width + 1),
        "@model",
        "state 0 [0] goal",
        "\taction 0",
        "\t\t0 : 1",
    ]
    shares = {
        1: ["1"],
        2: ["1/4", "3/4"],
        3: ["1/4", "1/4", "1/2"],
        4: ["2/25", "3/25", "8/25", "12/25"],
    }
    for number in range(layers * width):
        layer, p = number // width, names[rng.integers(num_parameters)]
        kind = int(rng.integers(3))
        ahead = 1 + (layer + 1) * width + rng.integers(width, size=2 if kind < 2 else 4)
        ahead = np.unique(ahead if layer + 1 < layers else 0 * ahead)
        weights = [p, f"1-{p}"] if kind < 2 and ahead.size == 2 else shares[ahead.size]
        lost = ["0", str(int(rng.random() < 0.3)), f"2*{p}"][kind] if 2 * layer > layers else "0"
        lines += [f"state {1 + number} [{lost}]{' init' if number == 0 else ''}", "\taction 0"]
        lines += [f"\t\t{t} : {w}" for t, w in zip(ahead, weights, strict=True)]
    path.write_text("\n".join(lines) + "\n")


def seconds(function: Any) -> tuple[float, Any]:
    """Processor seconds of a call, and its result."""
    begin = time.process_time()
    result = function()
    return time.process_time() - begin, result


def ours(path: Path, threshold: float, chosen: Any) -> tuple[dict[str, Any], Any]:
    """Figures of our search, and what it found."""
    model = read_parametric(path).over(chosen.margin, 1 - chosen.margin)
    problem = make_problem(model, "goal", reward=chosen.reward, bound="<=")

    def search(key: int, enough: int | None = None) -> Any:
        return feasible(
            problem,
            threshold,
            num_starts=chosen.starts,
            key=jax.random.key(key),
            budget=Budget(num_steps=chosen.steps, num_proofs=enough),
        )

    first, found = seconds(lambda: search(0))
    again = [seconds(lambda k=k: search(k)) for k in range(1, REPEATS + 1)]
    whole = min(x for x, _ in again)
    one = min(seconds(lambda k=k: search(k, 1))[0] for k in range(1, REPEATS + 1))
    return {
        "states": model.model.num_states,
        "parameters": len(model.parameters),
        "proven": int(found.feasible.sum()),
        "least_prove": min(int(x.feasible.sum()) for _, x in again),
        "steps": [float(np.median(found.num_steps)), int(found.num_steps.max())],
        "compile": first - whole,
        "all": whole,
        "one": one,
    }, found


def storms(path: Path, threshold: float, chosen: Any) -> dict[str, Any]:
    """Figures of Storm's gradient descent."""
    import stormpy
    from stormpy import pars

    model = stormpy.build_model_from_drn[stormpy.RationalFunction](str(path))
    (asked,) = stormpy.parse_properties(f'R{{"{chosen.reward}"}}<={threshold} [ F "goal" ]')

    def run() -> Any:
        return pars.check_feasibility(
            model, asked, region_bound=chosen.margin, method=pars.FeasibilityMethod.GD
        )

    begin, times = time.process_time(), [seconds(run)]
    while len(times) < REPEATS and time.process_time() - begin < PATIENCE:
        times.append(seconds(run))
    spent, found = min(times, key=lambda x: x[0])
    value = None if found.witness is None else float(found.witness.value)
    return {"storm": spent, "storm_value": value}


def agreement(path: Path, found: Any, chosen: Any) -> int:
    """How many of the certified bounds hold Storm's exact value of the chain at their point."""
    import stormpy
    from stormpy import models, pars

    model = stormpy.build_model_from_drn[stormpy.RationalFunction](str(path))
    exact = pars.ModelInstantiator[models.ModelType.DTMC, stormpy.Rational](model)
    variables = {v.name: v for v in model.collect_all_parameters()}
    (asked,) = stormpy.parse_properties(f'R{{"{chosen.reward}"}}=? [ F "goal" ]')
    good = 0
    for i in np.flatnonzero(found.feasible)[: chosen.checks]:
        point = {
            variables[name]: stormpy.numbers.RationalFunctionCoefficient(str(Fraction(x)))
            for name, x in found.valuation(i).items()
            if name in variables
        }
        chain = exact.instantiate(point)
        result = stormpy.model_checking(chain, asked, only_initial_states=True)
        value = Fraction(str(result.get_value(chain.initial_states[0])))
        good += Fraction(found.lower[i]) <= value <= Fraction(found.upper[i])
    return good


def main() -> None:
    """Prints a row for each model."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", help="models whose name holds one of these")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--threshold", type=float, help="default: the usual one of a network")
    parser.add_argument("--reward", default="dropped_packets")
    parser.add_argument("--margin", type=float, default=1e-6)
    parser.add_argument("--checks", type=int, default=100, help="points compared with Storm")
    parser.add_argument("--alone", action="store_true", help="without Storm")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--layered", type=int, nargs=3, metavar=("LAYERS", "WIDTH", "PARAMETERS"))
    chosen = parser.parse_args()
    if chosen.layered:
        chosen.folder.mkdir(parents=True, exist_ok=True)
        name = "layered_{}x{}_{}".format(*chosen.layered)
        write_layered(chosen.folder / f"{name}.drn", *chosen.layered)
        chosen.names = [name]
    jax.config.update("jax_enable_x64", True)
    rows = []
    print(
        f"{'model':<20}{'states':>8}{'D':>5}{'at most':>9}{'proven':>9}{'steps':>11}"
        f"{'compile':>9}{'all':>9}{'each':>9}{'one':>9}{'storm':>9}{'agree':>7}"
    )
    for path in sorted(chosen.folder.glob("*.drn")):
        if chosen.names and not any(x in path.stem for x in chosen.names):
            continue
        threshold = threshold_of(path.stem) if chosen.threshold is None else chosen.threshold
        row, found = ours(path, threshold, chosen)
        if not chosen.alone:
            row |= storms(path, threshold, chosen)
            row["agree"] = agreement(path, found, chosen)
        rows.append({"model": path.stem, "threshold": threshold, **row})
        each = row["all"] / max(row["proven"], 1)
        print(
            f"{path.stem:<20}{row['states']:>8}{row['parameters']:>5}{threshold:>9.4g}"
            f"{row['proven']:>5}/{chosen.starts:<3}"
            f"{row['steps'][0]:>6.4g} {row['steps'][1]:>4}{row['compile']:>9.2f}"
            f"{row['all']:>9.4f}{each:>9.5f}{row['one']:>9.5f}"
            f"{row.get('storm', np.nan):>9.5f}{row.get('agree', ''):>7}",
            flush=True,
        )
    if chosen.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
