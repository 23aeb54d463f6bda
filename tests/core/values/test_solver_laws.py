"""Laws that every solver keeps, whatever its quantity: one table of solvers, one test per law."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
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
    random_representation,
    stack,
)

MAX_PROGRAMS = 350  # that the default tests compile at most


@dataclass(frozen=True)
class Solver:
    """A solver as ``solve(model, inputs, **options)``.

    Attributes:
      needs: the inputs that it reads, in all of which it is differentiable.
      steps: whether it takes max_steps.
      stochastic: whether the policy that it returns is part of its differentiable answer.
      kinds: the representations that it takes.
      differentiated: whether its derivatives are tested here.
    """

    solve: Callable[..., jl.Solution]
    needs: tuple[str, ...]
    steps: bool = True
    stochastic: bool = False
    kinds: tuple[str, ...] = REPRESENTATIONS
    differentiated: bool = True


def game_of(model):
    """The system moves in the first state and wherever its number is even."""
    number = np.arange(int(np.prod(model.state_shape))).reshape(model.state_shape)
    return jl.Game(model, jnp.asarray(number % 2 == 0))


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
                m, x["reward"], x["discount"], method=method, **o
            ),
            ("reward", "discount"),
        )
        for method in ("policy_iteration", "modified_policy_iteration", "value_iteration")
    },
    **{
        f"soft_value-{method}": Solver(
            lambda m, x, method=method, **o: jl.soft_value(
                m, x["reward"], x["discount"], method=method, **o
            ),
            ("reward", "discount"),
            stochastic=True,
        )
        for method in ("newton", "value_iteration")
    },
    "boltzmann_value": Solver(
        lambda m, x, **o: jl.values.boltzmann_value(m, x["reward"], x["discount"], **o),
        ("reward", "discount"),
        stochastic=True,
    ),
    **{
        f"minimax_value-{method}": Solver(
            lambda m, x, method=method, **o: jl.minimax_value(
                game_of(m), x["reward"], x["discount"], method=method, **o
            ),
            ("reward", "discount"),
            differentiated=False,
        )
        for method in ("policy_iteration", "value_iteration", "strategy_iteration")
    },
    "strategy_value": Solver(
        lambda m, x, **o: jl.values.strategy_value(
            game_of(m), x["policy"], x["reward"], x["discount"], **o
        ),
        ("reward", "discount", "policy"),
        differentiated=False,
    ),
    "occupancy_measure": Solver(
        lambda m, x, **o: jl.occupancy_measure(m, x["policy"], x["discount"], **o),
        ("discount", "policy"),
        steps=False,
    ),
}
UNDISCOUNTED = {
    "reachability-max": Solver(partial(reach, objective="max"), ()),
    "reachability-min": Solver(partial(reach, objective="min"), ()),
    "reachability-policy": Solver(reach, ("policy",), steps=False),
    "satisfaction_probability": Solver(
        lambda m, x, **o: jl.satisfaction_probability(m, x["policy"], **o),
        ("policy",),
        steps=False,
        kinds=("product",),
    ),
    "optimal_satisfaction": Solver(
        lambda m, x, **o: jl.optimal_satisfaction(m, **o), (), kinds=("product",)
    ),
}
SOLVERS = {**DISCOUNTED, **UNDISCOUNTED}
# Elimination is one step.
SOLVED_AT_ONCE = ("reachability-policy", "satisfaction_probability", "occupancy_measure")
# Every representation is compiled for anew: by default, a dense model for two solvers alone.
DENSE = ("policy_value", "reachability-max")


def pair(name: str, kind: str) -> Any:
    marks = pytest.mark.slow if kind == "dense" and name not in DENSE else ()
    return pytest.param(name, kind, marks=marks)


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


@cache
def example(kind: str, seed: int = 0) -> tuple[Any, reference.Model, dict]:
    """A model in which some probabilities of reaching are neither zero nor one.

    All copies have as many states as the product, so one program solves them.
    """
    size = {} if kind == "product" else {"num_states": 12}
    rng = np.random.default_rng(seed)
    for _ in range(1000):
        model, explicit = random_representation(rng, kind, num_successors=3, certainty=0.1, **size)
        target = target_of(model).ravel()
        best, worst = (
            reference.exact_optimal_reachability(explicit, target, o) for o in ("max", "min")
        )
        if any(0 < x < 1 for x in best) and any(0 < x < 1 for x in worst):
            return model, explicit, random_inputs(rng, model, explicit)
    raise AssertionError("no such model was found")


def flat_inputs(inputs: dict, explicit: reference.Model) -> dict:
    shape = explicit.available.shape
    return {
        **inputs,
        **{name: inputs[name].reshape(shape) for name in ("reward", "policy")},
        "target": inputs["target"].ravel(),
    }


def limits_of(
    solver: Solver, *, tolerance: float = 1e-6, max_steps: int = 10_000
) -> dict[str, np.generic]:
    """Limits always of one kind, for which no second program is compiled."""
    steps = {"max_steps": np.int32(max_steps)} if solver.steps else {}
    return {"tolerance": np.float64(tolerance), **steps}


# --- representations ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        pair(name, kind)
        for name, solver in SOLVERS.items()
        for kind in ("dense", "product")
        if "dense" in solver.kinds
    ],
)
def test_representations_agree(name, kind):
    """A dense model or a lazy product has the solution of its explicit sparse model."""
    model, explicit, inputs = example(kind)
    solver = SOLVERS[name]
    limits = limits_of(solver, tolerance=1e-8 if name in UNDISCOUNTED else 1e-11)
    one = solver.solve(model, inputs, **limits)
    other = solver.solve(as_mdp(explicit), flat_inputs(inputs, explicit), **limits)
    assert one.status == other.status <= Status.UNCERTIFIED
    assert one.status == Status.CONVERGED or name == "boltzmann_value"
    loose = 1e-6 if name in UNDISCOUNTED else 1e-10  # within the default tolerance
    for field in ("value", "lower", "upper", "policy"):
        np.testing.assert_allclose(
            np.ravel(getattr(one, field)),
            np.ravel(getattr(other, field)),
            rtol=loose,
            atol=loose,
            err_msg=field,
        )


# --- lanes ---------------------------------------------------------------------------------------
# Of each solver one program is compiled, whose lanes are a case each.

HARDER = {  # discount, tolerance and the steps allowed
    "one step": (0.999, 1e-9, 1),
    "few steps": (0.5, 1e-9, 3),
    "easy": (0.1, 1e-6, 10_000),
    "harder": (0.9, 1e-6, 10_000),
    "hard": (0.999, 1e-6, 100_000),
}
INVALID = {
    "too much": lambda row: 2.5 * row,
    "negative": lambda row: row * np.where(np.arange(row.size) == row.argmax(), 1, -1),
    "nan": lambda row: np.where(row == row.max(), np.nan, row),
    "unavailable": lambda row: np.arange(row.size) == (row == 0).argmax(),
}


DISCOUNTS = (-0.5, 1.0, 1.5, np.nan, np.inf)  # out of range
TOLERANCES = (-1.0, np.nan, np.inf)


def nonsense(rng, model, inputs, values):
    """The same model and inputs with anything at all where nothing is possible."""
    world = getattr(model, "mdp", model)
    none = ~np.asarray(world.available)
    probability, successor = np.array(world.probability), np.array(world.successor)
    nowhere = none[..., None] | (probability == 0)
    successor[nowhere] = rng.integers(world.num_states, size=successor.shape)[nowhere]
    probability[none] = rng.uniform(0.5, 9, probability.shape)[none]
    assert none.any() and nowhere.any()
    world = world.replace(probability=jnp.asarray(probability), successor=jnp.asarray(successor))
    model = model.replace(mdp=world) if isinstance(model, jl.Product) else world
    unavailable = ~np.asarray(model.available)
    reward = inputs["reward"].copy()
    reward[unavailable] = np.resize(values, unavailable.sum())
    return model, {**inputs, "reward": reward}


def cases_of(solver) -> dict[str, tuple[Any, dict, dict]]:
    """Model, inputs and limits, by name."""
    rng = np.random.default_rng(6)
    kind = "product" if solver.kinds == ("product",) else "sparse"
    usual = limits_of(solver)
    found = {}
    for i, (name, (discount, tolerance, most)) in enumerate(HARDER.items()):
        model, _, inputs = example(kind, i)
        limits = limits_of(solver, tolerance=tolerance, max_steps=most)
        found[name] = model, {**inputs, "discount": np.asarray(discount)}, limits
    model, _, inputs = example(kind, 9)
    found["usual"] = model, inputs, usual
    for name, values in (("large", [1e9, -1e9]), ("infinite", [np.inf, -np.inf, np.nan])):
        found[name] = *nonsense(rng, model, inputs, values), usual
    # The last state of a game's system where one action is not available and two are.
    flat = inputs["policy"].reshape(-1, inputs["policy"].shape[-1])
    place = max(s for s in range(0, len(flat), 2) if (flat[s] == 0).sum() == 1)
    for name, change in INVALID.items():
        policy = flat.copy()
        policy[place] = change(policy[place])
        found[name] = model, {**inputs, "policy": policy.reshape(inputs["policy"].shape)}, usual
    for name, bad in (("nan reward", np.nan), ("infinite reward", np.inf)):
        reward = inputs["reward"].copy()
        reward.reshape(flat.shape)[place, flat[place].argmax()] = bad
        found[name] = model, {**inputs, "reward": reward}, usual
    for discount in DISCOUNTS:
        found[f"discount {discount}"] = model, {**inputs, "discount": np.asarray(discount)}, usual
    for tolerance in TOLERANCES:
        found[f"tolerance {tolerance}"] = model, inputs, limits_of(solver, tolerance=tolerance)
    if solver.steps:
        found["max_steps -3"] = model, inputs, limits_of(solver, max_steps=-3)
    return found


@cache
def solved(name: str) -> tuple[dict, dict[str, jl.Solution]]:
    """The cases of a solver, and their solutions as lanes of one program."""
    solver = SOLVERS[name]
    cases = cases_of(solver)
    models, inputs, limits = zip(*cases.values(), strict=True)
    batch = jax.jit(jax.vmap(lambda m, x, o: solver.solve(m, x, **o)))(
        stack(models), stack(inputs), stack(limits)
    )
    batch = jax.tree.map(np.asarray, batch)
    return cases, {case: lane(batch, i) for i, case in enumerate(cases)}


@cache
def compiled(name: str) -> Callable[..., jl.Solution]:
    """A solver that never answers on the host: what the host cannot do is compiled as it is."""
    solver = SOLVERS[name]
    run = jax.jit if name in UNDISCOUNTED else lambda x: x
    return run(lambda model, inputs, limits: solver.solve(model, inputs, **limits))


@pytest.mark.parametrize("name", SOLVERS)
def test_every_lane_is_as_if_alone(name):
    """Lanes of different models, difficulty and step limits do not disturb one another."""
    cases, found = solved(name)
    for case in HARDER:
        alone = compiled(name)(*cases[case])
        assert_solutions_agree(found[case], alone, 1e-9)
        np.testing.assert_array_equal(found[case].num_steps, alone.num_steps)
        np.testing.assert_allclose(found[case].policy, alone.policy, atol=1e-9)


@pytest.mark.parametrize("name", SOLVERS)
def test_what_stands_where_nothing_is_possible_changes_nothing(name):
    _, found = solved(name)
    for other in ("large", "infinite"):
        jax.tree.map(np.testing.assert_array_equal, found["usual"], found[other])


@pytest.mark.parametrize("name", [n for n, s in SOLVERS.items() if "policy" in s.needs])
def test_what_is_no_policy_is_invalid(name):
    solver = SOLVERS[name]
    cases, found = solved(name)
    assert found["usual"].status == Status.CONVERGED
    for case in INVALID:
        assert found[case].status == Status.INVALID_POLICY, case
        with pytest.raises(ValueError, match=r"the policy's row .* of state"):
            jl.check(found[case])
        model, inputs, limits = cases[case]
        with pytest.raises(ValueError, match=r"the policy's row .* of state"):
            solver.solve(model, inputs, **limits)
    model, inputs, limits = cases["usual"]
    actions = inputs["policy"].argmax(-1)
    for action in (5, -1):
        actions.flat[0] = action
        with pytest.raises(ValueError, match=f"takes action {action} in state"):
            solver.solve(model, {**inputs, "policy": actions}, **limits)


@pytest.mark.parametrize("name", SOLVERS)
def test_what_is_not_certified_has_not_converged(name):
    solver = SOLVERS[name]
    cases, found = solved(name)
    for case, one in found.items():
        certain = np.isfinite(one.lower).all() and np.isfinite(one.upper).all()
        assert certain or one.status != Status.CONVERGED, case
        if one.status == Status.CONVERGED:
            assert (one.lower <= one.value).all() and (one.value <= one.upper).all(), case
            width = (one.upper - one.lower).max()
            assert width <= cases[case][2]["tolerance"], case
    for case in [c for c in found if c.split()[-1] in solver.needs]:
        assert found[case].status == Status.NONFINITE, case
        assert found[case].num_steps <= 8, case


@pytest.mark.parametrize("name", SOLVERS)
def test_numbers_out_of_range_are_refused(name):
    """A ValueError for concrete ones; inside jit a status that names the reason."""
    solver = SOLVERS[name]
    cases, found = solved(name)
    reasons = {"tolerance": Status.INVALID_OPTION, "max_steps": Status.INVALID_OPTION}
    if "discount" in solver.needs:
        reasons["discount"] = Status.INVALID_DISCOUNT
    bad = [case for case in found if case.split()[0] in reasons]
    assert len(bad) == len(TOLERANCES) + solver.steps + len(DISCOUNTS) * ("discount" in reasons)
    for case in bad:
        argument, one = case.split()[0], found[case]
        assert one.status == reasons[argument], case
        assert np.isnan(one.value).all(), case
        assert np.isneginf(one.lower).all() and np.isposinf(one.upper).all(), case
        with pytest.raises(ValueError, match=f"{argument} .*must be"):
            jl.check(one)
        model, inputs, limits = cases[case]
        with pytest.raises(ValueError, match=rf"{argument}=.*; it must be"):
            solver.solve(model, inputs, **limits)


@pytest.mark.parametrize("name", [n for n, s in SOLVERS.items() if s.steps])
def test_no_more_steps_are_made_than_allowed(name):
    cases, found = solved(name)
    for case, one in found.items():
        allowed = max(cases[case][2]["max_steps"], 1)
        assert one.num_steps <= allowed, case
    assert found["one step"].status == Status.MAX_STEPS or name in SOLVED_AT_ONCE


# --- how narrow bounds are ---------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-3, 1e-7])
@pytest.mark.parametrize(("name", "kind"), [pair(*x) for x in PAIRS])
def test_the_tolerance_is_the_width_of_the_enclosure(name, kind, tolerance):
    """For every kind of model, on the host and inside jit."""
    solver = SOLVERS[name]
    model, _, inputs = example(kind)
    one = solver.solve(model, inputs, **limits_of(solver, tolerance=tolerance))
    assert one.status == Status.CONVERGED or name == "boltzmann_value"
    if one.status == Status.CONVERGED:
        assert (one.upper - one.lower <= tolerance).all()


HOMOGENEOUS = [n for n, s in DISCOUNTED.items() if "reward" in s.needs and n[:4] not in "soft bolt"]


@pytest.mark.parametrize("exponent", [-1000, -1023, -1060])
@pytest.mark.parametrize("name", HOMOGENEOUS)
def test_bounds_hold_for_rewards_near_underflow(name, exponent):
    """Values are linear in the reward; XLA flushes numbers below 2 ** -1022 to zero."""
    solver = SOLVERS[name]
    model, _, inputs = example("sparse")
    small = np.ldexp(inputs["reward"], exponent)
    exact = np.ldexp(small, -exponent)  # what was not rounded off
    expected = solver.solve(model, {**inputs, "reward": exact}, **limits_of(solver, tolerance=1e-9))
    assert expected.status == Status.CONVERGED
    for limits in ({}, limits_of(solver, tolerance=2.0**exponent * 1e-3)):
        one = solver.solve(model, {**inputs, "reward": small}, **limits)
        lower, upper = (np.ldexp(np.asarray(x), -exponent) for x in (one.lower, one.upper))
        assert (lower <= expected.upper).all() and (expected.lower <= upper).all()
    if exponent < -1010:
        assert one.status != Status.CONVERGED


# --- jit and traces ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", UNDISCOUNTED)  # the others are compiled as they are
def test_compiled_within_another_function_is_the_same(name):
    solver = SOLVERS[name]
    model, _, inputs = example(solver.kinds[-1] if solver.kinds == ("product",) else "sparse", 2)
    limits = limits_of(solver, tolerance=1e-8)
    # Outside it is the host that answers, as near as the tolerance asks.
    assert_solutions_agree(
        compiled(name)(model, inputs, limits), solver.solve(model, inputs, **limits), 1e-7
    )


@pytest.mark.parametrize("name", SOLVERS)
def test_new_numbers_do_not_retrace(name):
    solver = SOLVERS[name]
    model, _, inputs = example("product" if solver.kinds == ("product",) else "sparse", 3)

    def solve(discount, tolerance, max_steps):
        limits = limits_of(solver, tolerance=tolerance, max_steps=max_steps)
        solver.solve(model, {**inputs, "discount": np.asarray(discount)}, **limits)

    solve(0.5, 1e-6, 100)
    with counted_traces() as traced:
        solve(0.7, 1e-4, 200)
        solve(0.2, 1e-8, 50)
    assert not traced
    with counted_traces() as traced:
        jax.jit(lambda x: x + 1)(1.0)
    assert traced, "the counter works"


# --- how a solver ends -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", [n for n, s in DISCOUNTED.items() if s.steps and n != "policy_value"]
)
def test_an_impossible_tolerance_does_not_use_up_all_steps(name):
    solver = SOLVERS[name]
    model, _, inputs = example("product" if solver.kinds == ("product",) else "sparse")
    inputs = {**inputs, "discount": np.asarray(0.5)}
    possible = solver.solve(model, inputs, **limits_of(solver, tolerance=1e-13))
    solution = solver.solve(model, inputs, **limits_of(solver, tolerance=0, max_steps=100_000))
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
    solver = SOLVERS[name]
    solution = solver.solve(model, {**inputs, "reward": reward}, **limits_of(solver))
    assert solution.status == Status.NONFINITE
    with pytest.raises(jl.NotConverged, match=r"NONFINITE.*look for NaN or infinity"):
        jl.check(solution)


# --- derivatives -------------------------------------------------------------------------------


# Compiling each pair takes seconds; by default every solver and every representation occurs.
DERIVATIVES = [
    pytest.param(
        name,
        kind,
        marks=[]
        if kind == SOLVERS[name].kinds[0] and name != "reachability-min"
        else pytest.mark.slow
        if name in ("policy_value", "reachability-min")
        else pytest.mark.exhaustive,
    )
    for name, kind in PAIRS
    if "value_iteration" not in name and SOLVERS[name].differentiated
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
        # So tight that the error does not drown the differences; a tenth of it is in places more
        # than rounding lets a solver certify.
        options = {"tolerance": 1e-12} if name in UNDISCOUNTED else {}
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


@pytest.mark.parametrize("option", ["max_step", "evaluation_sweeps", "start"])
def test_an_option_of_another_solver_is_refused(option):
    with pytest.raises(TypeError, match=f"unexpected keyword argument '{option}'"):
        jl.values.soft_value(jl.from_dense([[[1.0]]]), np.ones((1, 1)), 0.5, **{option: 1})
