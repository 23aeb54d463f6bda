"""``python -m benchmarks.certificates FOLDER [--only NAME] [--json]``: certificates of real models.

Of each property of the models of :mod:`benchmarks.real_models`: CPU seconds of solving, of writing
and of checking its certificate, the width of the claims, and whether they contain the expected value.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from fractions import Fraction
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxltl as jl
from benchmarks.real_models import questions
from jaxltl.checker import verdict

SLACK = 1e-5  # relative, of the expected values


def solve(model: Any, text: str) -> jl.Solution:
    """The solution of a property of reachability, until or reachability reward."""
    quoted = text.split('"')[1::2]
    objective = "min" if text[1:].startswith("min") or '"}min' in text else "max"
    if text.startswith("R"):
        return jl.total_reward(model, quoted[0], quoted[1], objective=objective)
    stay = quoted[0] if len(quoted) > 1 else None
    return jl.reachability_probability(model, quoted[-1], stay=stay, objective=objective)


def bounds(lines: list[str]) -> tuple[float, float]:
    """The least and the largest value that the claims leave."""
    low, high = -np.inf, np.inf
    for line in lines:
        if line.startswith("claimed"):
            relation, bound = line.rpartition("=? [")[2].rpartition(" is ")[2].split()[:2]
            number = np.inf if bound == "inf" else float(Fraction(bound))
            low, high = (number, high) if relation == ">=" else (low, number)
    return low, high


def measure(folder: Path, only: str = ""):
    """A row for each property."""
    expected = json.loads((folder / "expected.json").read_text())
    target = Path(tempfile.mkdtemp()) / "certificate.umb"
    for path in sorted(folder.glob("*.umb")):
        if only not in path.stem:
            continue
        model = jl.read_model(path)
        for text, value in questions(path, expected, list(model.propositions), False):
            row: dict[str, Any] = {"model": path.stem, "property": text}
            row["transitions"] = model.num_transitions
            times = [time.process_time()]
            try:
                solution = solve(model, text)
                times.append(time.process_time())
                jl.io.write_certificate(target, model, solution, text)
                times.append(time.process_time())
                status, lines = verdict(str(target))
                times.append(time.process_time())
            except ValueError as error:
                yield {**row, "refused": str(error)}
                continue
            low, high = bounds(lines)
            seconds = np.diff(times).tolist()
            row |= dict(zip(("solve", "write", "check"), seconds, strict=True))
            slack = SLACK * max(1.0, abs(value)) if np.isfinite(value) else 0.0
            row |= {"accepted": status == 0, "contains": low - slack <= value <= high + slack}
            yield {**row, "width": 0.0 if low == high else high - low}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for row in measure(options.folder, options.only):
        rows.append(row)
        if options.json:
            print(json.dumps(row), flush=True)
        else:
            times = [f"{row[x]:8.3f}" if x in row else "" for x in ("solve", "write", "check")]
            print(row["model"], row["property"], *times, row.get("refused", ""), flush=True)
    done = [row for row in rows if "check" in row]
    ratios = np.array([[r["write"] / r["solve"], r["check"] / r["solve"]] for r in done])
    large = [1e6 * r["check"] / r["transitions"] for r in done if r["transitions"] > 1_000]
    print(f"{sum(r['accepted'] and r['contains'] for r in done)} of {len(rows)} accepted and right")
    print("writing and checking relative to solving, median:", np.median(ratios, axis=0))
    print(
        "relative to solving, all together:",
        *(sum(r[x] for r in done) / sum(r["solve"] for r in done) for x in ("write", "check")),
    )
    print(
        "microseconds a transition of checking, median and largest:", np.median(large), max(large)
    )


if __name__ == "__main__":
    main()
