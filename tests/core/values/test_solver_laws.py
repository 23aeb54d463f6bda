"""Laws that every solver keeps, whatever its quantity: one table of solvers, one test per law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import Status
from tests import reference
from tests.support import (
    REPRESENTATIONS,
    as_mdp,
    assert_gradients,
    assert_solutions_agree,
    counted_traces,
    lane,
    mass_preserving,
    random_product,
    random_representation,
    stack,
)


@dataclass(frozen=True)
class Solver:
    """A solver as ``solve(model, inputs, **options)``.

    Attributes:
      needs: the inputs that it reads, in all of which it is differentiable.
      steps: whether it takes max_steps.
      stochastic: whether the policy that it returns is part of its differentiable answer.
      kinds: the representations that it takes.
    """

    solve: Callable[..., jl.Solution]
    needs: tuple[str, ...]
    steps: bool = True
    stochastic: bool = False
    kinds: tuple[str, ...] = REPRESENTATIONS


def reach(model, x, *, objective=None, **options):
    policy = None if objective else x["policy"]
    objective = objective or "max"
    return jl.reachability_probability(
        model, x["target"], policy=policy, objective=objective, **options
    )


DISCOUNTED = {
    "policy_value": Solver(
        lambda m, x, **o: jl.policy_value(m, x["policy"], x["reward"], x["discount"], **o),
        ("reward", "discount", "policy"),
    ),
    **{
        f"optimal_value-{method}": Solver(
            lambda m, x, method=method, **o: jl.optimal_value(
                m, x["reward"], x["discount"], method=method, **o),
            ("reward", "discount"),
        )
        for method in ("modified_policy_iteration", "value_iteration")
    },
    **{
        f"soft_value-{method}": Solver(
            lambda m, x, method=method, **o: jl.soft_value(
                m, x["reward"], x["discount"], method=method, **o),
            ("reward", "discount"), stochastic=True,
        )
        for method in ("newton", "value_iteration")
    },
    "boltzmann_value": Solver(
        lambda m, x, **o: jl.boltzmann_value(m, x["reward"], x["discount"], **o),
        ("reward", "discount"), stochastic=True,
    ),
    "occupancy_measure": Solver(
        lambda m, x, **o: jl.occupancy_measure(m, x["policy"], x["discount"], **o),
        ("discount", "policy"), steps=False,
    ),
}
UNDISCOUNTED = {
    "reachability-max": Solver(partial(reach, objective="max"), ()),
    "reachability-min": Solver(partial(reach, objective="min"), ()),
    "reachability-policy": Solver(reach, ("policy",), steps=False),
    "satisfaction_probability": Solver(
        lambda m, x, **o: jl.satisfaction_probability(m, x["policy"], **o),
        ("policy",), steps=False, kinds=("product",),
    ),
    "optimal_satisfaction": Solver(
        lambda m, x, **o: jl.optimal_satisfaction(m, **o), (), kinds=("product",)
    ),
}
SOLVERS = {**DISCOUNTED, **UNDISCOUNTED}
PAIRS = [(name, kind) for name, solver in SOLVERS.items() for kind in solver.kinds]


def random_inputs(rng: np.random.Generator, model: Any, explicit: reference.Model) -> dict:
    """A reward, a discount and a policy in the shapes of the model."""
    actions = (*model.state_shape, model.num_actions)
    weight = (rng.random(explicit.available.shape) + 0.2) * explicit.available
    policy = weight / weight.sum(axis=1, keepdims=True)
    return {
        "reward": rng.normal(size=actions),
        "discount": np.asarray(0.9),
        "policy": policy.reshape(actions),
        "target": target_of(model),
    }


def target_of(model: Any) -> np.ndarray:
    """The final states of a product's task, and two states of a world."""
    if isinstance(model, jl.Product):
        return np.asarray(model.final)
    return np.arange(model.num_states) >= model.num_states - 2


def example(kind: str, seed: int = 0) -> tuple[Any, reference.Model, dict]:
    """A model in which some probabilities of reaching are neither zero nor one."""
    rng = np.random.default_rng(seed)
    for _ in range(1000):
        model, explicit = random_representation(rng, kind, num_successors=3, certainty=0.1)
        target = target_of(model).ravel()
        best, worst = (
            reference.exact_optimal_reachability(explicit, target, o) for o in ("max", "min")
        )
        if any(0 < x < 1 for x in best) and any(0 < x < 1 for x in worst):
            return model, explicit, random_inputs(rng, model, explicit)
    raise AssertionError("no such model was found")


def flat_inputs(inputs: dict, explicit: reference.Model) -> dict:
    shape = explicit.available.shape
    return {**inputs, **{name: inputs[name].reshape(shape) for name in ("reward", "policy")},
            "target": inputs["target"].ravel()}


def tables(explicit: reference.Model) -> jl.MDP:
    return as_mdp(explicit)


# --- representations ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n, s in SOLVERS.items() if "dense" in s.kinds])
@pytest.mark.parametrize("kind", ["dense", "product"])
def test_representations_agree(name, kind):
    """A dense model or a lazy product has the solution of its explicit sparse model."""
    model, explicit, inputs = example(kind)
    solve = SOLVERS[name].solve
    one = solve(model, inputs)
    other = solve(tables(explicit), flat_inputs(inputs, explicit))
    assert one.status == other.status == Status.CONVERGED
    loose = 1e-6 if name in UNDISCOUNTED else 1e-10  # within the default tolerance
    for field in ("value", "lower", "upper", "policy"):
        np.testing.assert_allclose(
            np.ravel(getattr(one, field)), np.ravel(getattr(other, field)),
            rtol=loose, atol=loose, err_msg=field,
        )


# --- vmap, jit and traces ----------------------------------------------------------------------


@pytest.mark.parametrize("name", SOLVERS)
def test_every_lane_is_as_if_alone(name):
    """Lanes of different models, difficulty and step limits do not disturb one another."""
    solver = SOLVERS[name]
    rng = np.random.default_rng(1)
    models, inputs = [], []
    for discount in (0.0, 0.5, 0.9, 0.99):
        model, explicit = (
            random_product(rng) if solver.kinds == ("product",)
            else random_representation(rng, "sparse")
        )
        models.append(model)
        inputs.append({**random_inputs(rng, model, explicit), "discount": np.asarray(discount)})
    options = {"tolerance": jnp.array([1e-3, 1e-9, 1e-6, 1e-8])}
    if solver.steps:
        options["max_steps"] = jnp.array([1, 3, 10_000, 10_000])
    batched = jax.vmap(lambda m, x, o: solver.solve(m, x, **o))(
        stack(models), stack(inputs), options
    )
    for i in range(4):
        alone = solver.solve(models[i], inputs[i], **lane(options, i))
        assert_solutions_agree(lane(batched, i), alone)
        np.testing.assert_array_equal(batched.num_steps[i], alone.num_steps)
        np.testing.assert_allclose(batched.policy[i], alone.policy, atol=1e-11)


@pytest.mark.parametrize("name", UNDISCOUNTED)  # the others are compiled as they are
def test_compiled_within_another_function_is_the_same(name):
    solver = SOLVERS[name]
    model, _, inputs = example(solver.kinds[-1] if solver.kinds == ("product",) else "sparse", 2)
    compiled = jax.jit(solver.solve)(model, inputs)
    assert_solutions_agree(compiled, solver.solve(model, inputs))


@pytest.mark.parametrize("name", SOLVERS)
def test_new_numbers_do_not_retrace(name):
    solver = SOLVERS[name]
    model, _, inputs = example("product" if solver.kinds == ("product",) else "sparse", 3)

    def solve(discount, tolerance, max_steps):
        limits = {"max_steps": max_steps} if solver.steps else {}
        solver.solve(model, {**inputs, "discount": discount}, tolerance=tolerance, **limits)

    solve(0.5, 1e-6, 100)
    with counted_traces() as traced:
        solve(0.7, 1e-4, 200)
        solve(0.2, 1e-8, 50)
    assert not traced
    with counted_traces() as traced:
        jax.jit(lambda x: x + 1)(1.0)
    assert traced, "the counter works"


# --- how a solver ends -------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n, s in SOLVERS.items() if s.steps and n != "policy_value"])
def test_one_step_is_not_enough(name):
    solver = SOLVERS[name]
    model, _, inputs = example("product" if solver.kinds == ("product",) else "sparse")
    # The Boltzmann solver polishes its one damped step, so only an impossible wish fails.
    tolerance = 0.0 if name == "boltzmann_value" else 1e-12
    solution = solver.solve(
        model, {**inputs, "discount": 0.999}, tolerance=tolerance, max_steps=1
    )
    assert solution.status == Status.MAX_STEPS
    with pytest.raises(jl.NotConverged, match=r"MAX_STEPS.*raise max_steps"):
        jl.check(solution)


@pytest.mark.parametrize(
    "name", [n for n, s in DISCOUNTED.items() if s.steps and n != "policy_value"])
def test_an_impossible_tolerance_does_not_use_up_all_steps(name):
    solver = SOLVERS[name]
    model, _, inputs = example("product" if solver.kinds == ("product",) else "sparse")
    inputs = {**inputs, "discount": 0.5}
    possible = solver.solve(model, inputs)
    solution = solver.solve(model, inputs, tolerance=0.0)
    assert solution.status == Status.PRECISION
    assert solution.num_steps <= possible.num_steps + 60
    with pytest.raises(jl.NotConverged, match=r"PRECISION.*use float64"):
        jl.check(solution)


def test_one_round_is_not_enough_for_a_long_ring():
    size = 500
    ring = jl.make_mdp((np.arange(size)[:, None, None] + 1) % size, np.ones((size, 1, 1)))
    reward = jnp.asarray(np.random.default_rng(0).normal(size=(size, 1)))
    arguments = ring, jnp.zeros(size, int), reward, 0.999
    assert jl.policy_value(*arguments, tolerance=1e-6, max_steps=1).status == Status.MAX_STEPS
    assert jl.policy_value(*arguments, tolerance=1e-6).status == Status.CONVERGED


@pytest.mark.parametrize("name", [n for n, s in DISCOUNTED.items() if "reward" in s.needs])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_rewards_that_are_not_finite_are_reported(name, bad):
    model, _, inputs = example("sparse")
    s, a = np.argwhere(np.asarray(model.available))[0]
    reward = inputs["reward"].copy()
    reward[s, a] = bad
    solution = SOLVERS[name].solve(model, {**inputs, "reward": reward})
    assert solution.status == Status.NONFINITE
    with pytest.raises(jl.NotConverged, match=r"NONFINITE.*look for NaN or infinity"):
        jl.check(solution)


@pytest.mark.parametrize("name", [n for n, s in SOLVERS.items() if "policy" in s.needs])
def test_policies_that_are_not_finite_are_reported(name):
    solver = SOLVERS[name]
    model, _, inputs = example("product" if solver.kinds == ("product",) else "sparse")
    policy = inputs["policy"].copy()
    policy.flat[0] = np.nan
    solution = solver.solve(model, {**inputs, "policy": policy})
    assert solution.status == Status.NONFINITE


@pytest.mark.parametrize("name", DISCOUNTED)
@pytest.mark.parametrize("discount", [1.0, 1.5, np.nan])
def test_discounts_outside_the_promise_never_converge(name, discount):
    solver = SOLVERS[name]
    model, _, inputs = example("sparse")
    limits = {"max_steps": 50} if solver.steps else {}
    solution = solver.solve(model, {**inputs, "discount": discount}, **limits)
    assert solution.status != Status.CONVERGED
    # Whatever the bounds are, they enclose nothing less than everything.
    assert not np.isfinite(solution.lower).any() or (solution.lower == 0).any()
    assert not np.isfinite(solution.upper).any()


# --- derivatives -------------------------------------------------------------------------------


# Compiling each pair takes seconds; by default every solver and every representation occurs.
USUAL = {"policy_value", "boltzmann_value", "reachability-policy"}
DERIVATIVES = [
    pytest.param(
        name, kind,
        marks=[] if kind == SOLVERS[name].kinds[0] or name in USUAL else pytest.mark.exhaustive,
    )
    for name, kind in PAIRS if "value_iteration" not in name
]


@pytest.mark.parametrize(("name", "kind"), DERIVATIVES)
def test_derivatives(name, kind):
    """Forward, reverse and central differences, in all inputs and the transition probabilities."""
    solver = SOLVERS[name]
    model, _, inputs = example(kind)
    world = getattr(model, "mdp", model)
    field = "transition" if kind == "dense" else "probability"
    rng = np.random.default_rng(4)
    # Optima have derivatives where no two actions tie, as they may in eighths.
    probability = np.asarray(getattr(world, field))
    probability = probability + 0.02 * mass_preserving(rng, probability)
    point = {name: inputs[name] for name in solver.needs} | {"probability": probability}
    directions = {
        "reward": rng.normal(size=inputs["reward"].shape),
        "discount": np.ones(()),
        "policy": mass_preserving(rng, inputs["policy"]),
        "probability": mass_preserving(rng, probability),
    }

    def answer(x):
        changed = world.replace(**{field: x["probability"]})
        changed = model.replace(mdp=changed) if kind == "product" else changed
        # The tightest tolerance, so that the iteration's error does not drown the differences.
        options = {"tolerance": 1e-13} if name in UNDISCOUNTED else {}
        solution = solver.solve(changed, {**inputs, **x}, **options)
        return (solution.value, solution.policy) if solver.stochastic else solution.value

    assert_gradients(answer, point, {name: directions[name] for name in point})


@pytest.mark.parametrize("name", ["policy_value", "soft_value-newton", "boltzmann_value"])
def test_evidence_has_no_derivative(name):
    """Bounds and residuals are evidence: constants to differentiation, never NaN."""
    model, _, inputs = example("sparse")
    solver = SOLVERS[name]

    def evidence(discount):
        solution = solver.solve(model, {**inputs, "discount": discount})
        return jnp.sum(solution.lower) + jnp.sum(solution.upper) + solution.residual

    with jax.debug_nans(False):
        assert jax.grad(evidence)(0.5) == 0
