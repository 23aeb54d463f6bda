"""``python -m benchmarks.programs FOLDER [--only NAMES]``: programs in the PRISM language, with Storm.

The folder has a folder for each family with an ``instances.json``: the model file, the property file,
the constants, the number of states and the values of the properties of each instance. For each instance
both tools read the text, build the model and solve the properties, Storm with its sound methods; states,
choices, transitions and values are compared. Times are CPU seconds of one thread, the two tools in
turns, and medians of several runs where a run is short. Each instance has a process of its own.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import statistics
import time
import warnings
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

WIDTH = 1e-6  # relative width of an enclosure
SHORT = 1.0  # seconds of runs that are repeated


def storm_constants(given: dict[str, Any]) -> str:
    """Values of constants as text."""
    return ",".join(f"{k}={str(v).lower()}" for k, v in given.items())


def timed(function: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of a call, and its result."""
    begin = time.process_time()
    found = function()
    return time.process_time() - begin, found


def build(folder: Path, instance: dict[str, Any]) -> tuple[Any, Any]:
    """The program of an instance and its model, from the text."""
    from jaxltl.core.programs.build import build_model
    from jaxltl.io.prism.properties import read_queries

    program, queries = read_queries(
        folder / instance["model"],
        storm_constants(instance["constants"]) or None,
        [str(folder / instance["properties_file"])] if instance["properties_file"] else [],
    )
    return build_model(program), queries


def storm_build(folder: Path, instance: dict[str, Any]) -> tuple[Any, Any]:
    """Storm's model and properties."""
    import stormpy

    program = stormpy.parse_prism_program(str(folder / instance["model"]))
    text = (folder / instance["properties_file"]).read_text()
    properties = stormpy.parse_properties(text, program)
    values = storm_constants(instance["constants"])
    if values:
        program, properties = stormpy.instantiate_constants(program, values, properties)
    # Storm omits the states behind the targets of a single formula.
    options = stormpy.BuilderOptions([*properties, properties[0]])
    options.set_build_all_labels()
    options.set_build_all_reward_models()
    return stormpy.build_model(program, options=options), properties


def storm_until_targets(folder: Path, instance: dict[str, Any]) -> int:
    """The number of states of Storm's model without those behind targets, as some are published."""
    import stormpy

    program = stormpy.parse_prism_program(str(folder / instance["model"]))
    text = (folder / instance["properties_file"]).read_text()
    properties = stormpy.parse_properties(text, program)
    values = storm_constants(instance["constants"])
    program, properties = stormpy.instantiate_constants(program, values, properties)
    return int(stormpy.build_model(program, properties[0]).nr_states)


def solve(model: Any, queries: Any) -> dict[str, tuple[float, float, float, str]]:
    """Bounds of each property by name, its seconds and its status."""
    from scipy.sparse import csgraph, linalg  # noqa: F401 - as `jaxltl solve` does before it begins

    from jaxltl.core.types import Status
    from jaxltl.core.values.properties.solve_property import solve_property

    found = {}
    for query in queries:
        if query.parsed is None:
            found[str(query.text)] = (math.nan, math.nan, 0.0, f"REFUSED {query.error}")
            continue
        begin = time.process_time()
        answer = solve_property(model, query.parsed, tolerance=WIDTH, relative=True)
        lower, upper = float(answer.lower[0]), float(answer.upper[0])
        if answer.holds is not None:
            lower = upper = float(bool(answer.holds[0]))
        seconds = time.process_time() - begin
        found[query.parsed.name] = (lower, upper, seconds, Status(answer.status).name)
    return found


def storm_solve(model: Any, properties: Any) -> dict[str, tuple[float, float]]:
    """Storm's values by its sound methods, and the seconds of each."""
    import stormpy
    from stormpy import environments

    found = {}
    for p in properties:
        begin = time.process_time()
        try:
            result = stormpy.model_checking(
                model, p, only_initial_states=True, environment=environments.sound()
            )
            if "Qualitative" in type(result).__name__:
                truth = result.get_truth_values_vector()
                value = float(all(truth[s] for s in model.initial_states))
            else:
                value = max(float(result.get_value(s)) for s in model.initial_states)
        except RuntimeError:
            value = math.nan
        found[p.get_name()] = value, time.process_time() - begin
    return found


def measure(folder: Path, instance: dict[str, Any], chosen: argparse.Namespace) -> dict[str, Any]:
    """The row of an instance."""
    import jaxltl  # noqa: F401 - imports are not timed

    warnings.simplefilter("ignore")
    row: dict[str, Any] = {
        "instance": f"{instance['model'].removesuffix('.prism')} "
        f"{storm_constants(instance['constants'])}",
        "expected": instance["states"],
    }
    seconds: list[float] = []
    peers: list[float] = []
    while not seconds or (sum(seconds + peers) < SHORT and len(seconds) < 9):
        model = peer = None
        once, (model, queries) = timed(lambda: build(folder, instance))
        seconds.append(once)
        if not chosen.alone:
            once, (peer, properties) = timed(lambda: storm_build(folder, instance))
            peers.append(once)
    row["first"], row["build"] = seconds[0], statistics.median(seconds)
    row["size"] = model.num_states, model.num_rows, model.num_transitions
    if peers:
        row["storm_build"] = statistics.median(peers)
        rows = peer.transition_matrix.nr_rows
        row["storm_size"] = peer.nr_states, rows, peer.nr_transitions
        if peer.nr_states != instance["states"] and instance["states"] is not None:
            row["until_targets"] = storm_until_targets(folder, instance)
    if not chosen.build:
        found = solve(model, queries)
        theirs = storm_solve(peer, properties) if peers else {}
        row["values"] = {
            name: (*x, *theirs.get(name, (math.nan, math.nan)), instance["values"].get(name))
            for name, x in found.items()
        }
    return row


def faults(row: dict[str, Any]) -> list[str]:
    """Differences from the published sizes and values, and from those of Storm."""
    found = []
    if row["expected"] not in (None, row["size"][0], row.get("until_targets")):
        found.append(f"{row['size'][0]} states, not {row['expected']}")
    if row.get("storm_size", row["size"]) != row["size"]:
        found.append(f"states, choices and transitions {row['size']}, of Storm {row['storm_size']}")
    for name, (lower, upper, _, status, peer, _, reference) in row.get("values", {}).items():
        # Only the graph proves a probability of 0 to a relative width.
        if status != "CONVERGED" and not lower == 0 < upper <= WIDTH:
            found.append(f"{name}: {status}")
        value, slack = peer, 2e-6
        if reference is not None:
            value, slack = expected(reference)
        if lower != upper and not upper - lower <= WIDTH * (lower or value == 0):
            found.append(f"{name}: [{lower}, {upper}] is wide")
        if not math.isnan(value) and not (
            lower - abs(value) * slack <= value <= upper + abs(value) * slack
        ):
            found.append(f"{name}: [{lower}, {upper}], expected {value}")
    return found


def expected(reference: Any) -> tuple[float, float]:
    """A reference value, and the relative error of its last digit."""
    if isinstance(reference, dict):
        return float(Fraction(reference["num"], reference["den"])), 4e-16
    if isinstance(reference, bool) or reference in ("true", "false"):
        return float(reference in (True, "true")), 0.0
    text = str(reference)
    digits = len(text.lower().partition("e")[0].replace(".", "").lstrip("-0"))
    return float(reference), 2 * 10.0 ** (1 - max(digits, 1)) if digits < 15 else 2e-6


def _work(task: tuple[Path, dict[str, Any], argparse.Namespace], pipe: Any) -> None:
    try:
        pipe.send(measure(*task))
    except Exception as error:
        pipe.send(f"{type(error).__name__}: {error}")


def show(row: dict[str, Any], shown: bool) -> None:
    """Prints a row."""
    ratio = row["build"] / row["storm_build"] if "storm_build" in row else math.nan
    values = row.get("values", {}).values()
    mine, peer = (
        row["build"] + sum(x[2] for x in values),
        row.get("storm_build", math.nan) + sum(x[5] for x in values),
    )
    print(
        f"{row['instance']:<42} {row['size'][0]:>8} {row['size'][1]:>9} {row['size'][2]:>9} "
        f"{row['first']:8.3f} {row['build']:8.3f} {row.get('storm_build', math.nan):8.3f} "
        f"{ratio:6.2f}  {mine:8.3f} {peer:8.3f} {mine / peer:6.2f}",
        flush=True,
    )
    for name, x in row.get("values", {}).items() if shown else ():
        print(f"    {name:<16} [{x[0]!r}, {x[1]!r}] {x[2]:.3f} s; Storm {x[4]!r} {x[5]:.3f} s")
    for fault in faults(row):
        print("    FAULT", fault, flush=True)


def summary(rows: list[dict[str, Any]]) -> None:
    """Prints ratios of building by size, and of all answers."""
    for name, some in (
        ("above 10^5 states", [r for r in rows if r["size"][0] > 1e5]),
        ("10^4 to 10^5", [r for r in rows if 1e4 <= r["size"][0] <= 1e5]),
        ("below 10^4", [r for r in rows if r["size"][0] < 1e4]),
    ):
        ratios = [r["build"] / r["storm_build"] for r in some if "storm_build" in r]
        if ratios:
            mean = statistics.geometric_mean(ratios)
            print(
                f"{name}: {len(ratios)} instances, geometric mean {mean:.2f}, largest "
                f"{max(ratios):.2f}, longest {max(r['build'] for r in some):.3f} s"
            )
    sums = [
        sum(r["build"] + sum(x[2] for x in r.get("values", {}).values()) for r in rows),
        sum(
            r.get("storm_build", math.nan) + sum(x[5] for x in r.get("values", {}).values())
            for r in rows
        ),
    ]
    ratio = sums[0] / sums[1] if sums[1] else math.nan
    print(f"answers from text: {sums[0]:.2f} s, Storm {sums[1]:.2f} s, {ratio:.2f}")
    omitted = sum("until_targets" in r for r in rows)
    print(
        f"{sum(map(len, map(faults, rows)))} faults in {len(rows)} instances, of which {omitted} are "
        "published without the states behind targets"
    )


def main() -> None:
    """Prints a row for each instance, and sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="parts of names, such as wlan,csma.3")
    parser.add_argument("--least", type=float, default=0, help="states")
    parser.add_argument("--most", type=float, default=5e6, help="states")
    parser.add_argument("--alone", action="store_true", help="without Storm")
    parser.add_argument("--build", action="store_true", help="without answers")
    parser.add_argument("--values", action="store_true", help="print each value")
    chosen = parser.parse_args()
    rows = []
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["jaxltl.app.solve", "jaxltl.core.programs.build"])
    for path in sorted(chosen.folder.glob("*/instances.json")):
        for instance in json.loads(path.read_text())["instances"]:
            if not chosen.least <= (instance["states"] or math.inf) <= chosen.most:
                continue
            if not any(x in instance["model"] for x in chosen.only.split(",")):
                continue
            receive, send = context.Pipe(False)
            process = context.Process(target=_work, args=((path.parent, instance, chosen), send))
            process.start()
            send.close()
            try:
                row = receive.recv()
            except EOFError:
                row = "the process ended"
            process.join()
            if isinstance(row, str):
                print(f"{instance['model']} {instance['constants']}: FAULT {row}", flush=True)
                continue
            rows.append(row)
            show(row, chosen.values)
    summary(rows)


if __name__ == "__main__":
    main()
