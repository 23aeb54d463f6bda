"""Certificates of policies against quadrature, simulation and each other."""

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

from jaxltl.core.continuous import (
    box,
    certify_policy,
    gaussian,
    make_dynamics,
    synthesize_policy,
    transition_bounds,
    triangular,
    uniform,
)


def scalar(scale=0.3):
    return make_dynamics(
        lambda x, u, w: 0.8 * x + u + w,
        domain=([-2.0], [2.0]),
        noise=gaussian(scale),
        actions=([-1.0], [1.0]),
        labels={"goal": ([1.0], [1.5])},
        initial=([-0.5], [0.5]),
    )


def quadrature(points=1500, scale=0.3):
    """Reachability probabilities of the scalar system at the middles of a fine grid."""
    edges = np.linspace(-2, 2, points + 1)
    x = (edges[:-1] + edges[1:]) / 2
    mean = 0.8 * x + 0.2
    p = np.diff(scipy.special.ndtr((edges[None] - mean[:, None]) / scale), axis=1)
    goal = (x >= 1) & (x < 1.5)
    p[goal] = 0
    return x, np.linalg.solve(np.eye(points) - p, p[:, goal].sum(1) * 0 + goal)


def test_a_scalar_gaussian_system_against_quadrature():
    proof = certify_policy(
        scalar(), lambda x: jnp.full(1, 0.2), "F goal", cells=[200], tolerance=0.05
    )
    x, value = quadrature()
    lower, upper = proof.at(x[:, None])
    assert (lower <= value + 2e-3).all() and (value <= upper + 2e-3).all()
    assert 0 < (upper - lower)[np.abs(x) < 0.5].max() < 0.1 and proof.status.name == "CONVERGED"


def test_finer_cells_never_loosen():
    options = {"tolerance": 0.0, "upper": True}
    coarse, fine = (
        certify_policy(
            scalar(), lambda x: jnp.full(1, 0.2), "F goal", cells=[40], max_cells=k, **options
        )
        for k in (40, 160)
    )
    x = np.linspace(-1.9, 1.9, 300)[:, None]
    (low, high), (lower, upper) = coarse.at(x), fine.at(x)
    assert (low <= lower).all() and (upper <= high).all() and (lower - low).max() > 1e-3
    assert coarse.status.name == "MAX_STEPS"


def test_a_smaller_domain_gives_lower_bounds_of_the_whole_one():
    """Leaving the smaller box is counted as a violation."""
    x, value = quadrature()
    part = replace(scalar(), domain=(np.array([-0.9]), np.array([1.6])))
    proof = certify_policy(part, lambda x: jnp.full(1, 0.2), "F goal", cells=[200], max_cells=200)
    lower, _ = proof.at(x[:, None])
    assert (lower <= value + 2e-3).all() and lower[np.abs(x) < 0.5].min() > 0.1


def test_refinement_of_needed_cells_gives_the_bounds_of_a_fine_grid():
    """Cells that no initial state reaches keep the bounds of the coarse grid."""
    world = make_dynamics(
        lambda x, u, w: x + 0.3 * u + 0.02 * w,
        domain=([-1.0, -1.0], [1.0, 1.0]),
        noise=[triangular()] * 2,
        actions=([-1.0, -1.0], [1.0, 1.0]),
        labels={"goal": ([0.4, -0.2], [0.8, 0.2]), "pit": ([0.1, 0.3], [0.8, 0.9])},
        initial=([-0.1, 0.0], [0.1, 0.2]),
    )

    def policy(x):
        return jnp.array([0.6, 0.0], x.dtype) - x

    options = {"tolerance": 0.0, "upper": False}
    steps = certify_policy(world, policy, "!pit U goal", cells=[7, 7], max_cells=1000, **options)
    fine = certify_policy(world, policy, "!pit U goal", cells=[56, 56], max_cells=5000, **options)
    assert steps.initial_bounds == fine.initial_bounds == (1, 1)
    assert steps.grid.num_cells < 0.5 * fine.grid.num_cells


def plane(outside="violates", noise=None):
    return make_dynamics(
        lambda x, u, w: x + 0.3 * jnp.tanh(u) + 0.05 * w,
        domain=([-1.0, -1.0], [1.0, 1.0]),
        noise=[noise or triangular(-1.0, 1.0)] * 2,
        actions=([-3.0, -3.0], [3.0, 3.0]),
        outside=outside,
        labels={"a": ([-0.9, -0.9], [-0.3, -0.3]), "b": ([0.2, 0.2], [0.9, 0.9]),
                "c": box([-0.2, 0.4], [0.0, 1.0])},
        initial=([-0.6, -0.6], [-0.4, -0.4]),
    )  # fmt: skip


def to_b(x):
    return 2 * (jnp.array([0.5, 0.5], x.dtype) - x)


@pytest.mark.parametrize(
    "formula,bounds",
    [("F b", (1, 1)), ("G !c & F G b", (1, 1)), ("G F a", (0, 0)), ("G (a -> F b)", (1, 1)),
     ("F (b & X b)", (1, 1)), ("F c", (0, 0))],
)  # fmt: skip
def test_any_formula_is_decided_where_noise_is_bounded(formula, bounds):
    proof = certify_policy(plane(), to_b, formula, cells=[40, 40])
    assert proof.initial_bounds == bounds and proof.status.name == "CONVERGED"


def test_noise_that_may_do_anything_but_does_not_forever():
    """A target that a small random walk reaches with probability 1, and an adversary never."""
    walk = make_dynamics(
        lambda x, u, w: x + 0.3 * w,
        domain=([-1.0], [1.0]),
        noise=uniform(-1.0, 1.0),
        outside="clip",
        labels={"end": ([0.9], [1.0])},
        initial=([-0.5], [0.5]),
    )
    proof = certify_policy(walk, lambda x: jnp.zeros(0), "F end", cells=[50])
    assert proof.initial_bounds == (1, 1) and set(proof.how[proof.initial]) == {2}
    often = certify_policy(walk, lambda x: jnp.zeros(0), "G F end & G F !end", cells=[50])
    assert often.initial_bounds == (1, 1)


def test_unbounded_noise_leaves_the_domain_almost_surely():
    world = make_dynamics(
        lambda x, u, w: 0.5 * x + w, domain=([-1.0], [1.0]), labels={}, noise=gaussian(0.3),
        outside="out",
    )  # fmt: skip
    options = {"cells": [20], "max_cells": 20}
    proof = certify_policy(world, lambda x: jnp.zeros(0), "F out", **options)
    assert proof.initial_bounds == (1, 1) and set(proof.how) == {2}
    safe = certify_policy(world, lambda x: jnp.zeros(0), "G !out", **options)
    assert safe.initial_bounds == (0, 0) and safe.status.name == "CONVERGED"


def test_refutation_by_an_upper_bound():
    proof = certify_policy(plane(), lambda x: to_b(-x), "F b", cells=[20, 20], threshold=0.5)
    assert proof.initial_bounds[1] < 0.5 and proof.status.name == "CONVERGED"


def test_a_disturbance_is_an_adversary():
    def world(reach):
        return make_dynamics(
            lambda x, u, w: 0.5 * x + w[:1] * 0.05 + w[1:],
            domain=([-1.0], [1.0]),
            noise=triangular(-1.0, 1.0),
            disturbance=([-reach], [reach]),
            labels={"middle": ([-0.5], [0.5])},
            initial=([-0.9], [0.9]),
        )

    options = {"cells": [200], "max_cells": 400}
    found = [
        certify_policy(world(r), lambda x: jnp.zeros(0), "F G middle", **options).initial_bounds
        for r in (0.1, 0.4)
    ]
    assert found == [(1, 1), (0, 1)]


def simulated(world, policy, key, state, num_steps):
    """Labels ``bool[T, P]`` and whether the run stayed inside."""

    def step(x, key):
        after = world.next_state(key, x, jnp.clip(policy(x), *map(jnp.asarray, world.actions)))
        return after, (world.label(x), world.inside(x))

    return jax.lax.scan(step, state, jax.random.split(key, num_steps))[1]


def test_simulated_frequencies_lie_inside():
    """A Gaussian plane world whose probability is neither 0 nor 1."""
    world, runs = plane(noise=gaussian(1.0)), 4000
    proof = certify_policy(world, to_b, "!c U b", cells=[60, 60], tolerance=0.01, max_cells=15_000)
    keys = jax.random.split(jax.random.key(0), runs)
    starts = jax.vmap(world.sample_initial)(jax.random.split(jax.random.key(1), runs))
    run = jax.jit(jax.vmap(lambda k, x: simulated(world, to_b, k, x, 60)))
    label, inside = run(keys, starts)
    b, lost = label[..., 1], label[..., 2] | ~inside
    first = jnp.where(b.any(1), b.argmax(1), 60), jnp.where(lost.any(1), lost.argmax(1), 60)
    hit = (first[0] < first[1]).mean()
    lower, upper = proof.at(np.asarray(starts))
    slack = 5 * np.sqrt(0.25 / runs)
    assert lower.mean() - slack <= hit <= upper.mean() + slack and lower.mean() > 0.8


@pytest.mark.parametrize(
    "change,message",
    [
        ({"cells": [10_000, 10_000]}, "GiB"),
        ({"cells": [10_000, 10_000], "max_cells": 10**9}, "or fewer actions"),
        ({"cells": [10]}, "one positive number for each"),
        ({"formula": "F z"}, "is no label"),
        ({"policy": lambda x: x[:1]}, "return float\\[2\\]"),
        ({"policy": lambda x: x @ np.ones((3, 2))}, r"policy fails with a state float\[2\]"),
        (
            {"policy": (nn.Dense(2), {"kernel": np.ones((3, 2))})},
            r"policy fails.*; give a function",
        ),
        ({"policy": lambda x: x if float(x[0]) > 0 else -x}, "cannot be traced"),
    ],
)
def test_bad_input(change, message):
    given = {"policy": to_b, "formula": "F b", "cells": [4, 4]} | change
    with pytest.raises(ValueError, match=message) as caught:
        certify_policy(plane(), given.pop("policy"), given.pop("formula"), **given)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("step", [lambda x: 0.1 / x, jnp.log1p, lambda x: jnp.tan(2 * x)])
def test_a_step_that_is_unbounded_on_a_cell_is_refused(step):
    world = make_dynamics(
        lambda x, u, w: step(x), domain=([-1.0], [1.0]), labels={"goal": ([0.5], [1.0])}
    )
    with pytest.raises(ValueError, match=r"unbounded.* on the cell \[.*\] to \[.*jnp.clip"):
        certify_policy(world, lambda x: jnp.zeros(0), "F goal", cells=[11])


def test_more_pairs_of_cells_and_actions_than_fit_are_refused():
    with pytest.raises(ValueError, match=r"37.3 GiB with 1,000 actions; give at most 16,777"):
        synthesize_policy(scalar(), "F goal", np.ones((1000, 1)), cells=[100_000])


def test_more_probabilities_than_fit_end_the_refinement(monkeypatch):
    monkeypatch.setattr(transition_bounds, "MAX_PROBABILITIES", 2000)
    lines = []
    options = {"tolerance": 0.0, "report": lines.append}
    policy = lambda x: jnp.full(1, 0.2)  # noqa: E731
    found = certify_policy(scalar(), policy, "F goal", cells=[30], **options)
    whole = certify_policy(scalar(), policy, "F goal", cells=[30], max_cells=30, tolerance=0.0)
    assert found.status.name == "MAX_STEPS" and "transition probabilities" in lines[-1]
    assert found.initial_bounds[0] >= whole.initial_bounds[0] > 0
    with pytest.raises(ValueError, match="transition probabilities, of at most 2,000; give fewer"):
        certify_policy(scalar(), policy, "F goal", cells=[80])


def test_initial_states_outside_of_a_smaller_domain_are_refused():
    part = replace(scalar(), domain=(np.array([-0.4]), np.array([1.6])))
    with pytest.raises(ValueError, match=r"initial: box 0.*outside the domain.*give boxes inside"):
        certify_policy(part, lambda x: jnp.full(1, 0.2), "F goal", cells=[20])


def test_an_interrupt_keeps_the_bounds_of_the_grid_before():
    lines = []

    def interrupt(line):
        lines.append(line)
        if "images" in line and sum("images" in x for x in lines) == 2:
            raise KeyboardInterrupt

    def policy(x):
        return jnp.full(1, 0.2)

    options = {"cells": [40], "tolerance": 0.0}
    whole = certify_policy(scalar(), policy, "F goal", max_cells=40, **options)
    found = certify_policy(scalar(), policy, "F goal", report=interrupt, **options)
    assert found.status.name == "MAX_STEPS" and "interrupted" in lines[-1]
    x = np.linspace(-1.9, 1.9, 50)[:, None]
    np.testing.assert_array_equal(found.at(x), whole.at(x))
