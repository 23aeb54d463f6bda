"""Proofs and synthesis in continuous worlds: ``python -m benchmarks.continuous policies tasks ...``.

Parts, each case in a fresh process:

- policies: certificates of the networks of ``--policies FOLDER`` (``linear.npz``, ``pendulum.npz``:
  ``seedN_kernelI``, ``seedN_biasI`` of ReLU layers) against simulated episodes;
- learned: policies trained by PPO and proven, with ten seeds;
- tasks: recurrence, response and persistence under the first policy of each file, and synthesis;
- synthesis: policies on the published grids against published times and memory (IMPaCT, Wooding and
  Lavaei 2024);
- shield: violations while learning, with and without a permissive strategy;
- models: bounds of policies on coarse grids against simulation.

Seconds are CPU seconds of all threads, `wall` is the elapsed time, MB the peak resident memory above
that after imports.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

PARTS = ("policies", "learned", "tasks", "synthesis", "models", "shield")
RECURRENCE, RESPONSE = "G F a & G F b & G !unsafe", "G (far -> F a) & G !unsafe"
PERSISTENCE = "F G target & G !unsafe"
SEQUENCE = "!unsafe U (a & (!unsafe U b))"
# Published seconds (transition bounds and synthesis) and GB, on a larger machine.
PUBLISHED: dict[str, tuple[float, float]] = {
    "robot": (80 + 1047, 8.8),
    "vehicle": (203 + 286, 7.4),
    "building_safety": (3.5 * 3600 + 24 * 3600, 92.0),
}
SYNTHESIS = ("building", "robot", "vehicle", "building_safety")
# Published seconds of proofs at .999999 on a GPU (logRASM, Badings et al. 2025).
PROOFS = {"linear": 42.0, "pendulum": 137.0, "hard": 175.0, "collision": 137.0,
          "triple_integrator": 517.0}  # fmt: skip


def _cases(chosen: argparse.Namespace) -> list[dict[str, Any]]:
    """The cases of the chosen parts."""
    found: list[dict[str, Any]] = []
    shared = {"max_cells": chosen.max_cells, "episodes": chosen.episodes, "folder": chosen.policies}
    for part in chosen.parts:
        if part == "policies":
            found += [
                {"part": part, "world": world, "seed": seed}
                for world in ("linear", "pendulum")
                if (Path(chosen.policies) / f"{world}.npz").exists()
                for seed in chosen.seeds or range(1, 6)
            ]
        elif part == "learned":
            found += [
                {"part": part, "world": world, "seed": seed}
                for world in ("hard", "collision", "triple_integrator")
                for seed in chosen.seeds or range(10)
            ]
        elif part == "tasks":
            found += [
                {"part": part, "world": world, "formula": formula, "policy": "trained"}
                for world in ("linear", "pendulum")
                for formula in (RECURRENCE, RESPONSE, PERSISTENCE)
            ]
            found += [
                {"part": part, "world": world, "formula": formula, "policy": "synthesis"}
                for world, formula in (("linear", RECURRENCE), ("robot", SEQUENCE))
            ]
        elif part == "synthesis":
            found += [{"part": part, "world": x, "upper": not chosen.lower} for x in SYNTHESIS]
        elif part == "shield":
            found += [
                {"part": part, "world": "linear", "learner": x, "shielded": y, "steps": 10**6}
                for x in ("ppo", "cce")
                for y in (True, False)
            ]
        else:
            found += [{"part": part, "world": "robot", "side": x} for x in (9, 15, 21)]
    kept = [x for x in found if not chosen.worlds or x["world"] in chosen.worlds]
    return [shared | x for x in kept]


def _run(case: dict[str, Any], limit: int) -> dict[str, Any]:
    """The result of a case from a fresh process, or how it failed."""
    command = [sys.executable, "-m", "benchmarks.continuous_cases", json.dumps(case)]
    environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false"}
    begin = time.perf_counter()
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=limit, env=environment, check=False
        )
    except subprocess.TimeoutExpired:
        return {"error": f"not finished after {limit} s"}
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        return {"error": lines[-1] if lines else f"exit code {done.returncode}"}
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found | {"process_wall": time.perf_counter() - begin}


def _compared(row: dict[str, Any]) -> dict[str, Any]:
    """Ratios to the published figures."""
    if "cpu" not in row:
        return row
    if row["part"] == "synthesis" and row["world"] in PUBLISHED:
        seconds, gigabytes = PUBLISHED[row["world"]]
        return row | {
            "published": seconds,
            "time_ratio": row["cpu"] / seconds,
            "memory_ratio": row["megabytes"] / (gigabytes * 1000),
        }
    if row["part"] in ("policies", "learned"):
        seconds = PROOFS[row["world"]]
        return row | {"published": seconds, "time_ratio": row["cpu"] / seconds}
    return row


HEADER = (
    f"{'part':<10}{'world':<18}{'case':<32}{'cells':>10} {'lower':>10} {'upper':>10} "
    f"{'cpu s':>8} {'wall s':>8} {'MB':>7} {'published':>9} {'ratio':>7}  stages and simulation"
)


def _text(row: dict[str, Any]) -> str:
    names = {
        "policies": "seed {seed}",
        "learned": "seed {seed}",
        "shield": "{learner}, shielded {shielded}",
        "tasks": "{formula}",
        "models": "{side} x {side}",
    }
    name = names.get(row["part"], "").format(**row)
    front = f"{row['part']:<10}{row['world']:<18}{name[:31]:<32}"
    if "error" in row:
        return front + row["error"]
    published = (
        f"{row['published']:9.0f} {row['time_ratio']:7.4f}" if "published" in row else " " * 17
    )
    return (
        f"{front}{row['cells']:>10,} {row['lower']:10.7f} {row['upper']:10.7f} {row['cpu']:8.1f} "
        f"{row['wall']:8.1f} {row['megabytes']:7.0f} {published}  {row['remark']}"
    )


def main() -> None:
    """Measures the chosen parts, prints a row each and at the end all as one JSON line."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.continuous",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("parts", nargs="*", default=list(PARTS), help=", ".join(PARTS))
    parser.add_argument("--policies", default="policies", help="folder of linear.npz, pendulum.npz")
    parser.add_argument("--worlds", nargs="*", default=[], help="these worlds alone")
    parser.add_argument("--seeds", type=int, nargs="*", help="default 1 to 5, learned 0 to 9")
    parser.add_argument("--episodes", type=int, default=100_000, help="simulated for each policy")
    parser.add_argument("--max-cells", type=int, default=2**20, help="of a proof's finest grid")
    parser.add_argument("--lower", action="store_true", help="lower bounds of synthesis alone")
    parser.add_argument("--limit", type=int, default=1800, help="seconds of a case")
    parser.add_argument("--json", action="store_true", help="only the JSON line")
    chosen = parser.parse_args()
    for part in chosen.parts:
        if part not in PARTS:
            parser.error(f"unknown part {part!r}; choose among {', '.join(PARTS)}")
    rows = []
    if not chosen.json:
        print(HEADER, flush=True)
    for case in _cases(chosen):
        row = _compared(case | _run(case, chosen.limit))
        rows.append({key: value for key, value in row.items() if key != "folder"})
        if not chosen.json:
            print(_text(row), flush=True)
    print(json.dumps({"cores": os.cpu_count(), "rows": rows}))


if __name__ == "__main__":
    main()
