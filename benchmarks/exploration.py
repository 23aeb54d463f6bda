"""Partial exploration of programs of the Quantitative Verification Benchmark Set.

Small instances first: the bounds must enclose the published probabilities, also after a few states.
Then large instances, to 1e-3 with at most 10^6 states: zeroconf has 5.0 million, others more than 10^7.

    python -m benchmarks.exploration FOLDER [--small 20000] [--large NAME]
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxltl.core.logic.bounded import Bounded
from jaxltl.core.programs.partial import solve_program
from jaxltl.io.prism.properties import read_queries

CASES = (
    ("zeroconf, N=1000, K=16", "zeroconf/zeroconf", "N=1000,K=16,reset=false", "correct_max"),
    ("zeroconf, N=1000, K=16", "zeroconf/zeroconf", "N=1000,K=16,reset=false", "correct_min"),
    ("wlan.6, COL=20", "wlan/wlan.6", "COL=20", "collisions"),
    ("csma.3-6", "csma/csma.3-6", None, "all_before_max"),
    ("csma.3-6", "csma/csma.3-6", None, "all_before_min"),
    ("csma.4-6", "csma/csma.4-6", None, "some_before"),
    ("crowds, 6 runs of 20", "crowds/crowds", "TotalRuns=6,CrowdSize=20", "positive"),
    ("egl, N=10, L=2", "egl/egl", "N=10,L=2", "unfairA"),
    ("nand, N=60, K=3", "nand/nand", "N=60,K=3", "reliable"),
    ("nand, N=60, K=4", "nand/nand", "N=60,K=4", "reliable"),
    ("consensus.8, K=2", "consensus/consensus.8", "K=2", "c2"),
    ("consensus.10, K=2", "consensus/consensus.10", "K=2", "c2"),
    (
        "firewire, delay 36, deadline 400",
        "firewire/firewire.true",
        "delay=36,deadline=400",
        "deadline",
    ),
)


def instances(folder: Path) -> Iterator[tuple[Path, dict[str, Any]]]:
    """Each instance with the folder of its family."""
    for path in sorted(folder.glob("*/instances.json")):
        for instance in json.loads(path.read_text())["instances"]:
            yield path.parent, instance


def check_small(folder: Path, most: int) -> None:
    """Bounds of small instances against published values."""
    checked, narrow = 0, 0
    for family, instance in instances(folder):
        if not instance["states"] or instance["states"] > most:
            continue
        text = ",".join(f"{k}={str(v).lower()}" for k, v in instance["constants"].items())
        properties = str(family / instance["properties_file"])
        program, queries = read_queries(family / instance["model"], text or None, [properties])
        assert program is not None
        for query in queries:
            prop = query.parsed
            value = instance["values"].get(prop.name) if prop is not None else None
            if value is None or isinstance(value, bool) or prop is None or prop.operator != "P":
                continue
            if isinstance(prop.path, Bounded) and prop.path.reward is not None:
                continue
            value = float(value["approx"] if isinstance(value, dict) else value)
            for states in (10, 100, 1000, 10**6):
                found = solve_program(
                    program, prop, method="partial", max_states=states, tolerance=1e-6
                )
                slack = 1e-6 * value + 1e-15
                assert found.lower[0] <= value + slack and value - slack <= found.upper[0], (
                    instance["model"],
                    text,
                    prop.name,
                )
                checked += 1
            narrow += found.status.name == "CONVERGED"
    print(f"small instances: {checked} explorations enclose the value; {narrow} properties to 1e-6")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--small", type=int, default=20_000)
    parser.add_argument("--large", help="part of the name of the large instances")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if given.small:
        check_small(given.folder, given.small)
    for name, file, constants, asked in CASES:
        if given.large is not None and given.large not in name:
            continue
        path = given.folder / f"{file}.prism"
        family = path.parent.name
        named = (
            path.with_suffix(".props") if family == "firewire" else path.parent / f"{family}.props"
        )
        program, queries = read_queries(path, constants, [str(named)])
        assert program is not None
        (prop,) = (q.parsed for q in queries if q.parsed is not None and q.parsed.name == asked)
        begin, spent = time.perf_counter(), time.process_time()
        found = solve_program(program, prop, method="partial", tolerance=1e-3, max_states=10**6)
        seconds = time.perf_counter() - begin, time.process_time() - spent
        print(
            f"{name} | {asked} | [{found.lower[0]:.6g}, {found.upper[0]:.6g}] | {found.status.name} | "
            f"{found.method} | {seconds[0]:.1f} s, {seconds[1]:.1f} processor seconds",
            flush=True,
        )


if __name__ == "__main__":
    main()
