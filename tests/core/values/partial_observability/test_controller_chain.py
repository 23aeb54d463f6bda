"""Chains of controllers as linear systems: both methods, both systems, and lanes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxltl.core.values.partial_observability import controller_chain as chains

SHAPE = NUM_MEMORY, NUM_STATES, NUM_ACTIONS, WIDTH = (
    2,
    40,
    3,
    2,
)  # pairs beyond one block of the factors


def random_chain(seed, leak):
    """Rows that end with probability `leak`, some of which list a successor twice."""
    rng = np.random.default_rng(seed)
    successor = rng.integers(NUM_STATES, size=(NUM_STATES, NUM_ACTIONS, WIDTH))
    probability = (1 - leak) * rng.dirichlet(np.ones(WIDTH), size=(NUM_STATES, NUM_ACTIONS))
    act = rng.dirichlet(np.ones(NUM_ACTIONS), size=(NUM_MEMORY, NUM_STATES))
    keep = rng.dirichlet(np.ones(NUM_MEMORY), size=(NUM_MEMORY, NUM_STATES))
    arrays = map(jnp.asarray, (successor, probability, act, keep, 0.99))
    return chains.ControllerChain(*arrays)


def table_of(chain):
    """The system by loops over pairs, actions and successors."""
    successor, probability, act, keep, discount = map(np.asarray, chain)
    table = np.eye(NUM_MEMORY * NUM_STATES).reshape(2 * (NUM_MEMORY, NUM_STATES))
    for m, s, a, k, n in np.ndindex(*SHAPE, NUM_MEMORY):
        t = successor[s, a, k]
        table[m, s, n, t] -= discount * act[m, s, a] * probability[s, a, k] * keep[m, t, n]
    return table.reshape(NUM_MEMORY * NUM_STATES, -1)


@pytest.mark.parametrize("limit", [0, 100])
def test_solutions_of_the_system_and_of_its_transpose_in_lanes(limit, monkeypatch):
    monkeypatch.setattr(chains, "_DENSE_LIMIT", limit)

    def both(chain, b):
        solver = chains.controller_solver(chain)
        return solver.solve(b), solver.transpose_solve(b)

    with jax.enable_x64(True):
        several = [random_chain(seed, leak) for seed, leak in enumerate((0.2, 1e-3, 1e-7))]
        right = np.random.default_rng(3).normal(size=(3, NUM_MEMORY, NUM_STATES))
        lanes = jax.tree.map(lambda *x: jnp.stack(x), *several)
        together = jax.jit(jax.vmap(both))(lanes, jnp.asarray(right))
        for i, chain in enumerate(several):
            table = table_of(chain)
            assert np.abs(chain.matrix() - table).max() < 1e-12
            for j, matrix in enumerate((table, table.T)):
                known = np.linalg.solve(matrix, right[i].ravel()).reshape(right[i].shape)
                np.testing.assert_allclose(together[j][i], known, rtol=1e-8, atol=1e-8)
