"""``python -m benchmarks.prepared_solves FOLDER [NAME...] [--deadline N]``: beside Storm.

Each property of the model files in a folder (see :mod:`benchmarks.real_models`) is prepared once
and then solved with numbers that are given anew, inside one compiled function; Storm solves it
from scratch by its sound methods. Wall-clock seconds, the least of some repetitions. With
--deadline a model is multiplied with a counter of steps first, so that targets count that are
reached until it ends: models without circles of any size.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.real_models import storm
from jaxltl.core.models.sparse import SparseMDP, choice_reward, make_sparse
from jaxltl.core.values.prepared.prepared import Prepared, prepare, solve_prepared
from jaxltl.io.model_files import read_model, write_model

REPEATS = 7


def with_deadline(model: SparseMDP, target: Any, deadline: int) -> tuple[SparseMDP, Any]:
    """What can be reached of the product with a counter of steps, and its target.

    States at the target and those whose time is up stay where they are.
    """
    host = model.host
    layer = np.flatnonzero(np.asarray(model.initial) > 0)
    number = np.full(host.num_states, -1)
    row_start, entry_start, successor, probability, goal = [0], [0], [], [], []
    begin = 0
    for step in range(deadline + 1):
        number[:] = -1
        number[layer] = begin + np.arange(layer.size)
        after: list[int] = []
        known: dict[int, int] = {}
        for s in layer.tolist():
            goal.append(bool(target[s]))
            if target[s] or step == deadline:
                successor.append(int(number[s]))
                probability.append(1.0)
                entry_start.append(len(successor))
            else:
                for r in range(host.row_start[s], host.row_start[s + 1]):
                    for e in range(host.entry_start[r], host.entry_start[r + 1]):
                        t = int(host.successor[e])
                        if t not in known:
                            known[t] = len(after)
                            after.append(t)
                        successor.append(begin + layer.size + known[t])
                        probability.append(float(host.probability[e]))
                    entry_start.append(len(successor))
            row_start.append(len(entry_start) - 1)
        begin, layer = begin + layer.size, np.asarray(after, np.int64)
    region = np.asarray(goal)
    initial = np.zeros(region.size)
    initial[0] = 1
    return make_sparse(
        None if len(entry_start) == len(row_start) and host.is_chain else np.asarray(row_start),
        np.asarray(entry_start),
        np.asarray(successor),
        np.asarray(probability),
        initial=initial,
        label={"goal_0": np.flatnonzero(region)},
    ), region


def least_seconds(run: Any) -> float:
    """The least of some wall-clock times."""
    times = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times)


def measure(
    model: SparseMDP, peer: Any, text: str, objective: str, target: Any, stay: Any, reward: Any
) -> dict[str, Any]:
    """Times of one property."""
    begin = time.perf_counter()
    prepared = prepare(model, target, stay=stay, reward=reward, objective=objective)
    row: dict[str, Any] = {
        "states": model.num_states,
        "property": text,
        "prepare": time.perf_counter() - begin,
    }
    numbers = {"probability": prepared.probability}
    if reward is not None:
        numbers["reward"] = prepared.reward

    @jax.jit
    def anew(prepared: Prepared, numbers: dict[str, Any]) -> Any:
        return solve_prepared(prepared, **numbers)

    begin = time.perf_counter()
    found = jax.block_until_ready(anew(prepared, numbers))
    row["compile"] = time.perf_counter() - begin
    row["anew"] = least_seconds(lambda: jax.block_until_ready(anew(prepared, numbers)))
    jax.block_until_ready(anew(prepared, {}))
    row["same"] = least_seconds(lambda: jax.block_until_ready(anew(prepared, {})))
    slope = jax.jit(jax.grad(lambda x, p: solve_prepared(prepared=p, probability=x).value[0]))
    jax.block_until_ready(slope(prepared.probability, prepared))
    row["gradient"] = least_seconds(
        lambda: jax.block_until_ready(slope(prepared.probability, prepared))
    )
    times = []
    for _ in range(REPEATS):
        low, high, _ = storm(peer, text)
        begin = time.perf_counter()
        storm(peer, text)
        times.append(time.perf_counter() - begin)
    row["storm"] = min(times)
    start = int(np.argmax(np.asarray(model.initial)))
    row |= {
        "cyclic": prepared.cyclic,
        "places": prepared.size,
        "shape": [list(x.target.shape) for x in prepared.segments if x.target.size],
        "steps": int(found.num_steps),
        "status": int(found.status),
        "lower": float(found.lower[start]),
        "upper": float(found.upper[start]),
        "peer": (low, high),
        "ratio": row["anew"] / row["storm"],
    }
    return row


def main() -> None:
    """Prints a row for each property."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--deadline", type=int, default=0)
    parser.add_argument("--first", action="store_true", help="only the first property of a model")
    chosen = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    import stormpy

    expected = json.loads((chosen.folder / "expected.json").read_text())
    print(
        f"{'model':<34}{'property':<14}{'states':>8}{'prepare':>9}{'compile':>9}{'storm ms':>9}"
        f"{'anew ms':>9}{'same ms':>9}{'grad ms':>9}{'ratio':>7}  steps shape"
    )
    for path in sorted(chosen.folder.glob("*.umb")):
        if chosen.names and not any(x in path.stem for x in chosen.names):
            continue
        model = read_model(path)
        peer = stormpy.build_model_from_umb(str(path))
        for name, p in expected[path.stem]["properties"].items():
            objective = "min" if p["objective"] == "min" else "max"
            sign = "" if model.is_chain else objective
            target, stay = model.states_with_label(f"goal_{name}"), None
            reward = choice_reward(model, name) if p["kind"] == "reward" else None
            text = f'P{sign}=? [ F "goal_{name}" ]'
            if reward is not None:
                text = f'R{{"{name}"}}{sign}=? [ F "goal_{name}" ]'
            elif f"stay_{name}" in model.propositions:
                stay = model.states_with_label(f"stay_{name}")
                text = f'P{sign}=? [ "stay_{name}" U "goal_{name}" ]'
            used = model
            if chosen.deadline:
                if reward is not None or stay is not None:
                    continue
                used, target = with_deadline(model, target, chosen.deadline)
                write_model("/tmp/deadline.umb", used)
                peer = stormpy.build_model_from_umb("/tmp/deadline.umb")
                text = f'P{sign}=? [ F "goal_0" ]'
            row = measure(used, peer, text, objective, target, stay, reward)
            ms = "".join(f"{1e3 * row[x]:9.3f}" for x in ("storm", "anew", "same", "gradient"))
            print(
                f"{path.stem:<34}{name[:13]:<14}{row['states']:>8}{row['prepare']:9.2f}"
                f"{row['compile']:9.2f}{ms}{row['ratio']:7.2f}  {row['steps']} {row['shape']} "
                f"{row['status']} [{row['lower']:.6g}, {row['upper']:.6g}] {row['peer']}",
                flush=True,
            )
            if chosen.first:
                break


if __name__ == "__main__":
    main()
