"""(b) Time to a certified 1e-6 against Storm, graph precomputation included."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import storm
from benchmarks.models import random_mdp, risky_mdp, slippery_grid
from benchmarks.timing import once
from jaxltl.core.values.discounted.discounted import optimal_value
from jaxltl.core.values.undiscounted.reachability import reachability_probability

_REPEATS = 5


def _measure(function) -> dict[str, float]:
    first, _ = once(function)
    seconds = float(np.median([once(function)[0] for _ in range(_REPEATS)]))
    return {"compile_seconds": max(first - seconds, 0.0), "seconds": seconds}


def discounted(name: str, model, target: float) -> dict[str, Any]:
    """Value at discount .95, our half width and Storm's measured error both at most 1e-6."""
    reward = np.random.default_rng(1).random((model.num_states, model.num_actions))
    ours = lambda: optimal_value(model, jnp.asarray(reward), 0.95, tolerance=1e-6)  # noqa: E731
    row = _measure(ours)
    solution = ours()
    exact = optimal_value(model, jnp.asarray(reward), 0.95, tolerance=1e-9).value
    peer = storm.build(model, reward, {})
    seconds, values = once(
        lambda: storm.check(peer, 'R{"r"}max=? [Cdiscount=0.95]', "value_iteration", 1e-6)
    )
    return {
        "name": f"discounted value, {name}",
        "states": model.num_states,
        "peer": "Storm value iteration",
        **row,
        "peer_seconds": seconds,
        "ratio": row["seconds"] / seconds,
        "target": target,
        "half_width": float(jnp.max(solution.upper - solution.lower) / 2),
        "error": float(jnp.max(jnp.abs(solution.value - exact))),
        "peer_error": float(np.abs(values - np.asarray(exact)).max()),
    }


def reachability(num_states: int) -> list[dict[str, Any]]:
    """Maximal probability of a goal among traps, against each sound method of Storm."""
    model, goal = risky_mdp(num_states)
    target = jnp.asarray(goal)
    ours = lambda: reachability_probability(model, target, tolerance=1e-6)  # noqa: E731
    row = _measure(ours)
    solution = ours()
    exact = np.asarray(reachability_probability(model, target, tolerance=1e-8).value)
    peer = storm.build(model, np.zeros((num_states, model.num_actions)), {"goal": goal})
    rows = []
    for method in storm.METHODS:
        seconds, values = once(lambda m=method: storm.check(peer, 'Pmax=? [F "goal"]', m, 1e-6))
        rows.append(
            {
                "name": "maximal reachability",
                "states": num_states,
                "peer": f"Storm {method.replace('_', ' ')}",
                **row,
                "peer_seconds": seconds,
                "ratio": row["seconds"] / seconds,
                "target": None if method == "value_iteration" else 1.0,
                "half_width": float(jnp.max(solution.upper - solution.lower) / 2),
                "error": float(np.abs(np.asarray(solution.value) - exact).max()),
                "peer_error": float(np.abs(values - exact).max()),
            }
        )
    return rows


def run(num_states: int) -> list[dict[str, Any]]:
    """float64 throughout."""
    with jax.enable_x64(True):
        side = round(num_states**0.5)
        return [
            discounted("random", random_mdp(num_states), 1 / 8),
            discounted("slippery grid", slippery_grid(side), 1 / 2),
            discounted("random with traps", risky_mdp(num_states)[0], None),
            *reachability(num_states),
        ]
