"""``python -m benchmarks.interval_models [SIZE...] [--prepared]``: intervals beside Storm.

Reachability on interval models of about SIZE states, with nature against the policy and for it:
grids with slips and traps, queues in tandem, and random graphs. Each is written once and read by
both. Ours encloses the value by bounds of width 1e-6, of all states; Storm finds it by value
iteration, which proves nothing, for the initial state. CPU seconds, the least of some runs in turn.
With --prepared, 1,000 models of 100 states with one graph are solved in one vmapped call, in a
loop over a compiled function, and in a loop over the host's engine.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from jaxltl.core.models.interval import IntervalMDP, interval_rows
from jaxltl.core.types import Status
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.io.model_files import read_model, write_model

REPEATS = 2
LANES = 1000


def _intervals(rng: Any, probability: Any, entry_start: Any, share: float) -> tuple[Any, Any]:
    """Intervals around distributions, up to a share of each probability wide on either side."""
    below, above = share * rng.random((2, probability.size))
    sure = np.repeat(np.diff(entry_start) == 1, np.diff(entry_start))
    return (
        np.where(sure, 1, probability * (1 - below)),
        np.where(sure, 1, np.minimum(probability * (1 + above), 1)),
    )


def _model(
    rng: Any, rows: list[list[list[tuple[int, float]]]], goal: Any, share: float = 0.3
) -> IntervalMDP:
    """The model of the successors of each choice of each state; it starts in state 0."""
    flat = [row for state in rows for row in state]
    entry_start = np.cumsum([0, *map(len, flat)])
    row_start = np.cumsum([0, *map(len, rows)])
    successor = np.array([t for row in flat for t, _ in row])
    probability = np.array([p for row in flat for _, p in row])
    lower, upper = _intervals(rng, probability, entry_start, share)
    return interval_rows(
        row_start,
        entry_start,
        successor,
        lower,
        upper,
        initial=np.arange(len(rows)) == 0,
        label={"goal": np.flatnonzero(goal)},
    )


def _joined(row: list[tuple[int, float]]) -> list[tuple[int, float]]:
    """A row in which each successor stands once."""
    found: dict[int, float] = {}
    for t, p in row:
        found[t] = found.get(t, 0) + p
    return sorted(found.items())


def grid(size: int, rng: Any) -> IntervalMDP:
    """A grid with slips to both sides; one cell in ten is a trap, where one breakdown in 500 leads
    from everywhere, and the goal is far away.
    """
    n = max(round(size**0.5), 4)
    trap = rng.random((n, n)) < 0.1
    trap[0, 0] = trap[-1, -1] = False
    rows: list[Any] = []
    moves = [(-1, 0), (0, 1), (1, 0), (0, -1)]
    for i in range(n):
        for j in range(n):
            to = [min(max(i + a, 0), n - 1) * n + min(max(j + b, 0), n - 1) for a, b in moves]
            if trap[i, j] or i == j == n - 1:
                rows.append([[(i * n + j, 1.0)]])
                continue
            rows.append(
                [
                    _joined(
                        [(to[a], 0.798), (to[a - 1], 0.1), (to[(a + 1) % 4], 0.1), (n * n, 0.002)]
                    )
                    for a in range(4)
                ]
            )
    rows.append([[(n * n, 1.0)]])
    return _model(rng, rows, np.arange(n * n + 1) == n * n - 1)


def queues(size: int, rng: Any) -> IntervalMDP:
    """Two queues in tandem and which one to serve faster, until one overflows or all is empty."""
    n = max(round(size**0.5), 4)
    rows: list[Any] = []
    for i in range(n):
        for j in range(n):
            if i == j == n - 1 or i == j == 0:
                rows.append([[(i * n + j, 1.0)]])
                continue
            new, on = min(i + 1, n - 1) * n + j, max(i - 1, 0) * n + min(j + (i > 0), n - 1)
            off, choices = i * n + max(j - 1, 0), []
            for a, b in ((0.4, 0.25), (0.25, 0.4)):
                choices.append(_joined([(new, 0.35), (on, a), (off, b)]))
            rows.append(choices)
    initial = n // 2 * n + n // 2
    order = np.arange(n * n)
    order[[0, initial]] = order[[initial, 0]]
    place = np.argsort(order)
    rows = [[[(int(place[t]), p) for t, p in row] for row in rows[s]] for s in order]
    return _model(rng, rows, order == n * n - 1, 0.1)


def random_graph(size: int, rng: Any) -> IntervalMDP:
    """Two choices of four successors each, and of an end with one chance in fifty."""
    rows: list[Any] = []
    end = rng.random(size) < 0.04
    end[0], end[-1] = False, True
    ends = np.flatnonzero(end)
    for s in range(size):
        if end[s]:
            rows.append([[(s, 1.0)]])
            continue
        rows.append(
            [
                _joined(
                    [
                        (int(rng.choice(ends)), 0.02),
                        *zip(
                            rng.integers(size, size=4).tolist(),
                            (0.98 * rng.dirichlet(np.ones(4))).tolist(),
                            strict=True,
                        ),
                    ]
                )
                for _ in range(2)
            ]
        )
    goal = end & (rng.random(size) < 0.5)
    goal[-1] = True
    return _model(rng, rows, goal)


FAMILIES: dict[str, Callable[[int, Any], IntervalMDP]] = {
    "grid": grid,
    "queues": queues,
    "random graph": random_graph,
}


def storm(model: Any, text: str, cooperative: bool) -> tuple[float, float]:
    """What Storm finds for the initial state, and its CPU seconds."""
    import stormpy

    (prop,) = stormpy.parse_properties(text)
    mode = stormpy.UncertaintyResolutionMode
    begin = time.process_time()
    result = stormpy.model_checking(
        model,
        prop,
        only_initial_states=True,
        uncertainty_resolution_mode=mode.COOPERATIVE if cooperative else mode.ROBUST,
    )
    seconds = time.process_time() - begin
    return float(result.get_value(next(iter(model.initial_states)))), seconds


def measure(name: str, size: int, folder: Path, objectives: tuple[str, ...] = ("max", "min")):
    """A row for each pair of directions."""
    import stormpy
    from scipy.sparse import csgraph, linalg  # noqa: F401 - imported before the clock starts

    path = folder / "model.drn"
    write_model(path, FAMILIES[name](size, np.random.default_rng(size)))
    model = read_model(path)
    peer = stormpy.build_model_from_drn[stormpy.Interval](str(path))
    target = model.states_with_label("goal")
    for objective in objectives:
        for nature in ("adversarial", "cooperative"):
            ours, theirs = [], []
            for _ in range(REPEATS):
                fresh = model.replace(lower=model.lower)  # nothing is remembered
                begin = time.process_time()
                found = reachability_probability(fresh, target, objective=objective, nature=nature)
                ours.append(time.process_time() - begin)
                value, seconds = storm(peer, f'P{objective}=? [F "goal"]', nature == "cooperative")
                theirs.append(seconds)
            yield {
                "model": name,
                "states": model.num_states,
                "transitions": model.num_transitions,
                "policy": objective,
                "nature": nature,
                "ours": min(ours),
                "storm": min(theirs),
                "status": Status(int(found.status)).name,
                "lower": float(found.lower[0]),
                "upper": float(found.upper[0]),
                "peer": value,
                "rounds": int(found.num_steps),
                "method": str(found.method),
            }


def prepared() -> None:
    """Prints the seconds of 1,000 models of 100 states, solved in three ways."""
    import jax

    from jaxltl.core.values import prepare, solve_prepared

    jax.config.update("jax_enable_x64", True)
    rng = np.random.default_rng(0)
    model = random_graph(100, rng)
    chance, start = np.asarray(model.nominal.probability), np.asarray(model.nominal.entry_start)
    lower, upper = (
        np.stack(x)
        for x in zip(*(_intervals(rng, chance, start, 0.3) for _ in range(LANES)), strict=True)
    )
    target = model.states_with_label("goal")
    for nature in ("adversarial", "cooperative"):
        question = prepare(model, target, nature=nature)
        one = jax.jit(lambda q, a, b: solve_prepared(q, lower=a, upper=b))
        many = jax.jit(jax.vmap(one, in_axes=(None, 0, 0)))

        jax.block_until_ready((one(question, lower[0], upper[0]), many(question, lower, upper)))
        clock, few = [time.process_time()], LANES // 20
        found = jax.block_until_ready(many(question, lower, upper))
        clock.append(time.process_time())
        for a, b in zip(lower, upper, strict=True):
            jax.block_until_ready(one(question, a, b))
        clock.append(time.process_time())
        for a, b in zip(lower[:few], upper[:few], strict=True):
            reachability_probability(model.replace(lower=a, upper=b), target, nature=nature)
        clock.append(time.process_time())
        batch, loop, host = np.diff(clock)
        print(
            f"nature {nature}: one call {batch:.2f} s, a loop over it {loop:.2f} s, a loop over "
            f"the host's engine {host * LANES / few:.1f} s, statuses {np.bincount(found.status)}"
        )


def main() -> None:
    """Prints a row for each model and pair of directions."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("sizes", nargs="*", type=int, default=[1000, 10_000, 100_000])
    parser.add_argument("--prepared", action="store_true")
    parser.add_argument("--only", default="", help="part of a family's name")
    parser.add_argument("--objectives", nargs="+", default=["max", "min"])
    chosen = parser.parse_args()
    if chosen.prepared:
        prepared()
        return
    print(
        f"{'model':<14}{'states':>8}{'policy':>7}{'nature':>12}{'ours s':>9}{'storm s':>9}"
        f"{'ratio':>7}  status [lower, upper] storm"
    )
    with TemporaryDirectory() as folder:
        for name in FAMILIES:
            if chosen.only not in name:
                continue
            for size in chosen.sizes:
                for row in measure(name, size, Path(folder), tuple(chosen.objectives)):
                    print(
                        f"{row['model']:<14}{row['states']:>8}{row['policy']:>7}"
                        f"{row['nature']:>12}{row['ours']:9.3f}{row['storm']:9.3f}"
                        f"{row['ours'] / row['storm']:7.2f}  {row['status']} "
                        f"[{row['lower']:.7g}, {row['upper']:.7g}] {row['peer']:.7g} "
                        f"{row['rounds']} {row['method']}",
                        flush=True,
                    )


if __name__ == "__main__":
    main()
