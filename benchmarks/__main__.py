"""``python -m benchmarks [a b c d e f g h i j k l] [--states N] [--json]``: a table, and JSON."""

from __future__ import annotations

import argparse
import json
import os
import platform
from typing import Any

import jax


def _row_text(row: dict[str, Any]) -> str:
    def seconds(key: str) -> str:
        return f"{row[key]:10.4f}" if key in row else " " * 10

    target = row.get("target")
    verdict = "" if target is None else ("met" if row["ratio"] <= target else "MISSED")
    aim = "" if target is None else f"<= {target:.3g}"
    return (
        f"{row['name']:<50} {row['peer']:<34} {seconds('compile_seconds')} "
        f"{seconds('seconds')} {seconds('peer_seconds')} {row['ratio']:8.3f} {aim:>9} {verdict}"
    )


def _search() -> list[dict[str, Any]]:
    from benchmarks import navigation, seeds

    return navigation.run() + seeds.run()


def main() -> None:
    """Measures the chosen parts, prints a row each and at the end all as one JSON line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "parts",
        nargs="*",
        default=list("abcdefghikl"),
        help="a to l; j takes minutes and is left out unless it is named",
    )
    parser.add_argument("--states", type=int, default=1_000_000)
    parser.add_argument("--json", action="store_true", help="only the JSON line")
    chosen = parser.parse_args()
    rows: list[dict[str, Any]] = []
    header = (
        f"{'what':<50} {'peer':<34} {'compile s':>10} {'run s':>10} {'peer s':>10} "
        f"{'ratio':>8} {'target':>9}"
    )
    if not chosen.json:
        print(f"jax {jax.__version__} on {platform.machine()}, {os.cpu_count()} cores\n{header}")
    for part in chosen.parts:
        if part == "a":
            from benchmarks.sweep import run as measure
        elif part == "b":
            from benchmarks.solvers import run as measure
        elif part == "c":
            from benchmarks.gradient import run as measure
        elif part == "d":
            from benchmarks.memory import run as measure
        elif part == "e":
            from benchmarks.q_learning import run as measure
        elif part == "f":
            from benchmarks.games import run as measure
        elif part == "g":
            from benchmarks.pac import run as measure
        elif part == "h":
            measure = _search
        elif part == "i":
            from benchmarks.todirl import run as measure
        elif part == "j":
            from benchmarks.todirl import run_large as measure
        elif part == "k":
            from benchmarks.lanes import run as measure
        elif part == "l":
            from benchmarks.first_calls import run as measure
        else:
            parser.error(f"unknown part {part!r}; choose among {', '.join('abcdefghijkl')}")
        found = measure() if part in "ceghijkl" else measure(chosen.states)
        rows += found
        if not chosen.json:
            print(*map(_row_text, found), sep="\n", flush=True)
    machine = {"cores": os.cpu_count(), "machine": platform.machine(), "jax": jax.__version__}
    print(json.dumps({"machine": machine, "rows": rows}))


if __name__ == "__main__":
    main()
