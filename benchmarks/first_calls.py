"""(l) First calls, each in a fresh process after its imports: seconds and compiled programs."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

_PROGRAM = """
import sys, time, json
import jax
import numpy as np
import jaxltl as jl
count = [0]
jax.monitoring.register_event_duration_secs_listener(
    lambda event, _, **k: count.__setitem__(
        0, count[0] + event.endswith("backend_compile_duration")))
name, cells = sys.argv[1], int(sys.argv[2])
side = max(2, round(cells ** 0.5))
rows = [["."] * side for _ in range(side)]
rows[0][0], rows[-1][-1], rows[0][-1], rows[side // 2][side // 2] = "s", "g", "r", "b"
world = jl.gridworld("\\n".join(map(" ".join, rows)), slip=0.1, initial="s")
tasks = {"co-safe": "(!r U g) & F b", "parity": "G F g & G F b & G !r"}
models = {key: jl.product(world, task) for key, task in tasks.items()}
game = jl.make_game(world, np.arange(world.num_states) % 2 == 0)
some = np.ones((world.num_states, 4))
calls = {
    "optimal_satisfaction, co-safe": lambda: jl.optimal_satisfaction(models["co-safe"]),
    "optimal_satisfaction, parity": lambda: jl.optimal_satisfaction(models["parity"]),
    "satisfaction_probability": lambda: jl.satisfaction_probability(
        models["co-safe"], np.full((*models["co-safe"].state_shape, 4), 0.25)),
    "winning_region": lambda: jl.winning_region(game, jl.games.buchi(game, "g")),
    "verify": lambda: jl.verify(jl.winning_region(game, jl.games.buchi(game, "g"))),
    "permissive_strategy": lambda: jl.permissive_strategy(game, jl.games.safety(game, "!r")),
    "end_components": lambda: jl.graphs.end_components(world, np.ones(world.num_states, bool)),
    "minimax_value": lambda: jl.minimax_value(game, some, 0.9),
    "optimal_value": lambda: jl.optimal_value(world, some, 0.9),
    "soft_value": lambda: jl.soft_value(world, some, 0.9),
}
short = name.split(",")[0]  # names are imported when they are first looked up
getattr(jl.graphs if short == "end_components" else jl, short), jl.games.buchi, jl.verify
import scipy.sparse.linalg, scipy.sparse.csgraph  # by the first solve on the host
count[0], begin = 0, time.perf_counter()
try:
    jax.block_until_ready(jax.tree.leaves(calls[name]()))
except ValueError as error:  # a task that cannot be done is an answer too
    assert "unrealizable" in str(error)
print(json.dumps({"seconds": time.perf_counter() - begin, "programs": count[0]}))
"""
_TARGETS = {
    "optimal_satisfaction, co-safe": 0.8,
    "optimal_satisfaction, parity": 0.8,
    "satisfaction_probability": 0.8,
    "winning_region": 0.1,
    "verify": 0.1,
    "permissive_strategy": 0.1,
    "end_components": 0.1,
    "minimax_value": 0.8,
    "optimal_value": None,
    "soft_value": None,
}


def run() -> list[dict[str, Any]]:
    """float32, worlds of 25 and 400 cells; the ratio is to one second."""
    rows = []
    for name, target in _TARGETS.items():
        for cells in (25, 400):
            done = subprocess.run(
                [sys.executable, "-c", _PROGRAM, name, str(cells)],
                capture_output=True,
                text=True,
                check=True,
            )
            found = json.loads(done.stdout.splitlines()[-1])
            rows.append(
                {
                    "name": f"{name}, {cells} cells",
                    "peer": f"{found['programs']} programs",
                    "ratio": found["seconds"],
                    "target": target,
                    **found,
                }
            )
    return rows
