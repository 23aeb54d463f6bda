"""(a) One optimality sweep against a hand-written parallel loop."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numba
import numpy as np

from benchmarks.models import random_mdp
from benchmarks.timing import compare
from jaxltl.core.models.ops.operators import action_max, expectation

_SWEEPS = 10


@numba.njit(parallel=True, fastmath=True)
def _numba_sweep(successor, probability, reward, discount, value, out):
    for s in numba.prange(successor.shape[0]):
        best = -np.inf
        for a in range(successor.shape[1]):
            q = np.float32(0)
            for k in range(successor.shape[2]):
                q += probability[s, a, k] * value[successor[s, a, k]]
            best = max(best, reward[s, a] + discount * q)
        out[s] = best


@jax.jit
def _sweeps(model, reward, discount, value):
    def sweep(_, v):
        return action_max(reward + discount * expectation(model, v), model.available)

    return jax.lax.fori_loop(0, _SWEEPS, sweep, value)


def run(num_states: int) -> list[dict[str, Any]]:
    """float32, 4 actions, 4 successors; both run ten sweeps a call."""
    model = random_mdp(num_states)
    rng = np.random.default_rng(1)
    reward = rng.random((num_states, 4), dtype=np.float32)
    start = rng.random(num_states, dtype=np.float32)
    successor, probability = np.asarray(model.successor), np.asarray(model.probability)
    discount = np.float32(0.95)
    buffers = [start.copy(), np.empty_like(start)]

    def peer():
        buffers[0][:] = start
        for i in range(_SWEEPS):
            _numba_sweep(
                successor, probability, reward, discount, buffers[i % 2], buffers[1 - i % 2]
            )
        return buffers[_SWEEPS % 2]

    arguments = (model, jnp.asarray(reward), discount, jnp.asarray(start))
    error = np.abs(np.asarray(_sweeps(*arguments)) - peer()).max()
    row = compare(lambda: _sweeps(*arguments), peer, repeats=11)
    return [
        {
            "name": "optimality sweep x10",
            "states": num_states,
            "peer": "numba, parallel",
            "target": 1.6,
            "error": float(error),
            **row,
        }
    ]
