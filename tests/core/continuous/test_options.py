"""Options of proofs of a wrong type or range are refused by name."""

import jax
import jax.numpy as jnp
import numpy as np

import jaxltl as jl
from jaxltl import continuous
from tests.core.values.test_options import WRONG, accepted_or_raw

SMALL = {"cells": [30], "max_cells": 100}


def calls():
    world = continuous.make_dynamics(
        lambda x, u, w: x + u + 0.02 * w,
        domain=([-1.0], [1.0]),
        noise=continuous.triangular(-1.0, 1.0),
        actions=([-0.5], [0.5]),
        labels={"goal": ([-0.1], [0.1])},
        initial=([0.5], [0.6]),
    )
    actions = np.array([[-0.3], [0.0], [0.3]])
    proof = {"tolerance": 1e-3, "threshold": 0.5, "max_sweeps": 10, "upper": True, "report": print}
    policy, key = continuous.synthesize_policy(world, "F goal", actions, **SMALL), jax.random.key(0)
    return [
        (
            continuous.certify_policy,
            {"dynamics": world, "policy": lambda x: -0.2 * x, "formula": "F goal"} | SMALL,
            proof | SMALL | {"formula": "F goal"},
        ),
        (
            continuous.synthesize_policy,
            {"dynamics": world, "formula": "F goal", "actions": actions} | SMALL,
            proof | SMALL,
        ),
        (
            continuous.counterexample,
            {"dynamics": world, "policy": lambda x: x, "formula": "G goal", "key": key},
            {"num_steps": 5, "certificate": None},
        ),
        (
            continuous.simulate_cells,
            {"policy": policy, "key": key, "state": jnp.array([0.5]), "num_steps": 3},
            {"num_steps": 3, "policy": None},
        ),
        (continuous.make_grid, {"low": [0.0], "high": [1.0], "shape": [3]}, {"shape": [3]}),
        (jl.enclose, {"function": jnp.sin}, {"method": "linear", "function": jnp.sin}),
    ]


def test_wrong_options_are_refused_by_name():
    problems = accepted_or_raw(calls(), WRONG | {"infinite": float("inf"), "negative": -1})
    assert not problems, "\n".join(problems)
