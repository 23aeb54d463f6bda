"""``python -m benchmarks.real_models FOLDER [--ltl] [--json]``: model files beside Storm.

The folder holds UMB files and an ``expected.json`` that names their properties: for each model
``properties`` with ``kind`` ("probability" or "reward"), ``objective`` ("max", "min" or "chain")
and the ``value``. Property p is about the labels ``goal_p`` and, where there is one, ``stay_p``,
and the reward p. With --ltl formulas of temporal logic over the labels of each model are solved
instead, and what Storm finds is expected. Times are CPU seconds of the first call, after loading;
both run in one thread.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from jaxltl.core.types import Status
from jaxltl.core.values.properties.solve_property import solve_property
from jaxltl.io.model_files import read_model

LTL = (  # of a label a and another one b: recurrence, persistence, with safety, response
    'G F "{a}"',
    'F G !"{a}"',
    '(F G "{a}") & (G (!"{b}" | F "{a}"))',
    '(F "{b}") & (G F !"{a}")',
)
WIDTH, WRONG = 1e-6, 2e-6


def questions(path: Path, expected: dict[str, Any], labels: list[str], ltl: bool):
    """The properties of one model, each with the value that is expected or None."""
    properties = expected[path.stem]["properties"]
    if ltl:
        goals = [x for x in labels if x.startswith("goal_")]
        sign = "" if any(p["objective"] == "chain" for p in properties.values()) else "max"
        for form in LTL:
            yield f"P{sign}=? [ {form.format(a=goals[0], b=goals[-1])} ]", None
        return
    for name, p in properties.items():
        sign = "" if p["objective"] == "chain" else p["objective"]
        value = {"true": 1.0, "inf": math.inf}.get(p["value"], p["value"])
        if p["kind"] == "reward":
            yield f'R{{"{name}"}}{sign}=? [ F "goal_{name}" ]', float(value)
        elif f"stay_{name}" in labels:
            yield f'P{sign}=? [ "stay_{name}" U "goal_{name}" ]', float(value)
        else:
            yield f'P{sign}=? [ F "goal_{name}" ]', float(value)


def storm(model: Any, text: str) -> tuple[float, float, float]:
    """Storm's bounds by its sound methods, and its seconds."""
    import stormpy
    from stormpy import environments

    (prop,) = stormpy.parse_properties(text)
    environment = environments.sound()
    begin = time.process_time()
    result = stormpy.model_checking(model, prop, only_initial_states=True, environment=environment)
    seconds = time.process_time() - begin
    (state,) = model.initial_states
    value = result.get_value(state)
    low, high = result.get_lower_bound(state), result.get_upper_bound(state)
    return value if low is None else low, value if high is None else high, seconds


def measure(folder: Path, ltl: bool = False, only: str = "", with_storm: bool = True):
    """A row for each property of each model in a folder."""
    from scipy.sparse import csgraph, linalg  # noqa: F401 - as `jaxltl solve` does before it begins

    expected = json.loads((folder / "expected.json").read_text())
    for path in sorted(folder.glob("*.umb")):
        if only not in path.stem:
            continue
        begin = time.process_time()
        model = read_model(path)
        load = time.process_time() - begin
        peer = None
        if with_storm:
            import stormpy

            begin = time.process_time()
            peer = stormpy.build_model_from_umb(str(path))
            peer_load = time.process_time() - begin
        for text, value in questions(path, expected, list(model.propositions), ltl):
            row: dict[str, Any] = {
                "model": path.stem,
                "states": model.num_states,
                "property": text,
                "load": load,
            }
            begin = time.process_time()
            found = solve_property(model, text)
            row["seconds"] = time.process_time() - begin
            lower, upper = float(found.lower[0]), float(found.upper[0])
            if peer is not None:
                low, high, row["storm"] = storm(peer, text)
                row["storm_load"] = peer_load
                value = (low + high) / 2 if value is None else value
            size = max(abs(upper), 1e-300) if text.startswith("R") else 1.0
            row |= {
                "value": float(found.value[0]),
                "width": 0.0 if lower == upper else (upper - lower) / size,
                "status": Status(found.status).name,
                "method": found.method,
            }
            row["verdict"] = _verdict(row, lower, upper, value, size)
            yield row


def _verdict(
    row: dict[str, Any], lower: float, upper: float, value: float | None, size: float
) -> str:
    """Whether bounds hold what is expected, up to the digits to which that is known."""
    if value is None:
        return "alone"
    slack = WRONG * max(size, abs(value)) if math.isfinite(value) else 0.0
    if not lower - slack <= value <= upper + slack:
        return "WRONG" if row["status"] == "CONVERGED" else "off"
    return "ok" if row["width"] <= WIDTH and row["status"] == "CONVERGED" else "wide"


def main() -> None:
    """Prints a row for each property, and sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--ltl", action="store_true")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--only", default="", help="models whose name holds this")
    parser.add_argument("--alone", action="store_true", help="without Storm")
    chosen = parser.parse_args()
    rows = []
    for row in measure(chosen.folder, chosen.ltl, chosen.only, not chosen.alone):
        rows.append(row)
        peer = f"{row['storm']:8.4f} {row['seconds'] / row['storm']:7.2f}" if "storm" in row else ""
        print(
            f"{row['model']:<40} {row['states']:>8} {row['property']:<48} {row['value']:<12.6g} "
            f"{row['width']:8.1e} {row['seconds']:8.4f} {peer} {row['verdict']:<6} "
            f"{row['method']}",
            flush=True,
        )
    verdicts = [row["verdict"] for row in rows]
    print(
        f"\n{len(rows)} properties:",
        *(f"{verdicts.count(x)} {x}" for x in sorted(set(verdicts))),
        f"- seconds {sum(r['seconds'] for r in rows):.2f}",
        end=" ",
    )
    if rows and "storm" in rows[0]:
        print(
            f"Storm {sum(r['storm'] for r in rows):.2f}, ratio "
            f"{np.divide(sum(r['seconds'] for r in rows), sum(r['storm'] for r in rows)):.2f}; "
            f"missed: {sum(map(_missed, rows))}"
        )
    if chosen.json:
        print(json.dumps(rows))


def _missed(row: dict[str, Any]) -> bool:
    """Beyond twice Storm's time above 10^5 states, five times and 10 ms below 10^4."""
    if row["states"] > 10**5:
        return row["seconds"] > 2 * row["storm"]
    return row["states"] < 10**4 and row["seconds"] > max(5 * row["storm"], 0.01)


if __name__ == "__main__":
    main()
