"""Laws of solvers on sparse models that are compiled: one table of solvers, one test per law.

The padded model is the reference: same values, bounds, policies and statuses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.types import Status
from jaxltl.core.values.discounted.soft import boltzmann_expansion, soft_policy_adjoint
from tests.core.values.test_solver_laws import DISCOUNTED, Solver, game_of
from tests.sparse_models import exact_solve, random_sparse
from tests.support import (
    assert_encloses,
    assert_gradients,
    assert_solutions_agree,
    lane,
    stack,
)

MAX_PROGRAMS = 350  # that the default tests compile at most

COUNT = 9


def adversarial(model, x, **options):
    """The worst case of an environment whose policy is known too."""
    return jl.values.strategy_value(
        game_of(model), x["policy"], x["reward"], x["discount"], environment=x["policy"], **options
    )


SOLVERS = {
    **DISCOUNTED,
    "boltzmann_value-newton": Solver(
        lambda m, x, **o: jl.values.boltzmann_value(
            m, x["reward"], x["discount"] / 3, method="newton", **o
        ),
        ("reward", "discount"),
    ),
    "minimax_value-allowed": Solver(
        lambda m, x, **o: jl.minimax_value(
            game_of(m), x["reward"], x["discount"], allowed=x["allowed"], **o
        ),
        ("reward", "discount"),
    ),
    "strategy_value-environment": Solver(adversarial, ("reward", "discount", "policy")),
}


class Example(NamedTuple):
    """A model with very uneven rows, and how its rows stand in the padded one."""

    model: Any
    padded: Any
    inputs: dict[str, np.ndarray]
    action: np.ndarray

    def wide(self, rows: np.ndarray) -> np.ndarray:
        """``[S, A]`` from ``[R]``."""
        found = np.zeros((COUNT, self.padded.num_actions), rows.dtype)
        found[self.model.host.state, self.action] = rows
        return found

    def narrow(self, x: Any) -> np.ndarray:
        """``[R]`` from ``[S, A]``."""
        return np.asarray(x)[self.model.host.state, self.action]


@cache
def example(seed: int = 0) -> Example:
    rng = np.random.default_rng(seed)
    widths = np.array([1, 1, 1, 1, 7, 1, 2, 1, 1])  # choices of each state
    row_start = np.concatenate([[0], widths.cumsum()])
    count = np.where(rng.random(row_start[-1]) < 0.7, 1, 2)
    count[4:8] = COUNT  # successors of each choice
    start = np.concatenate([[0], count.cumsum()])
    successor = np.concatenate([rng.choice(COUNT, w, replace=False) for w in count])
    probability = rng.random(start[-1]) + 0.05
    probability /= np.repeat(np.add.reduceat(probability, start[:-1]), count)
    reward = jl.models.Rewards(*(rng.normal(size=n) for n in (COUNT, row_start[-1], start[-1])))
    model = jl.make_sparse(
        row_start,
        start,
        successor,
        probability,
        rewards={"gain": reward},
        label={"a": [1, 4], "b": [2]},
        valuation={"name": np.array(list("abcdefghi"))},
    )
    state, num_rows = model.host.state, model.num_rows
    weight = rng.random(num_rows) + 0.2
    inputs = {
        "reward": rng.normal(size=num_rows),
        "discount": np.asarray(0.9),
        "policy": weight / np.bincount(state, weight)[state],
        "allowed": (rng.random(num_rows) < 0.7) | (np.diff(row_start)[state] == 1),
    }
    return Example(model, jl.to_padded(model), inputs, np.arange(num_rows) - row_start[state])


def numbers(model: Any) -> Any:
    """The model as programs take it: without texts."""
    return replace(model, valuation={})


@cache
def compiled(name: str) -> Callable[..., jl.Solution]:
    return jax.jit(SOLVERS[name].solve)


@cache
def solved(name: str) -> jl.Solution:
    model, _, inputs, _ = example()
    return jax.tree.map(np.asarray, compiled(name)(numbers(model), inputs))


def assert_as_padded(found: jl.Solution, name: str, inputs: dict[str, Any]) -> None:
    case = example()
    wide = {n: case.wide(x) if np.shape(x) == case.action.shape else x for n, x in inputs.items()}
    expected = jax.tree.map(np.asarray, SOLVERS[name].solve(case.padded, wide))
    parts = {f: getattr(expected, f) for f in ("value", "lower", "upper", "policy")}
    expected = replace(
        expected, **{f: case.narrow(x) if x.ndim == 2 else x for f, x in parts.items()}
    )
    assert_solutions_agree(found, expected, 1e-10)
    if "value_iteration" in name:  # what else is done depends on rounding
        np.testing.assert_array_equal(found.num_steps, expected.num_steps)
    policy = np.asarray(found.policy)
    np.testing.assert_allclose(policy, expected.policy, atol=1e-9)


# A second method has the enclosures of the first one, for which the padded model is compiled.
SECOND = {
    "optimal_value-modified_policy_iteration": "optimal_value-policy_iteration",
    "optimal_value-value_iteration": "optimal_value-policy_iteration",
    "soft_value-value_iteration": "soft_value-newton",
    "minimax_value-value_iteration": "minimax_value-policy_iteration",
    "minimax_value-strategy_iteration": "minimax_value-policy_iteration",
}


@pytest.mark.parametrize("name", SOLVERS)
def test_the_answer_is_that_of_the_padded_model(name):
    found = solved(name)
    assert found.status == (Status.UNCERTIFIED if name == "boltzmann_value" else Status.CONVERGED)
    if name in SECOND:
        first = solved(SECOND[name])
        assert (found.lower <= first.upper).all() and (first.lower <= found.upper).all()
        np.testing.assert_allclose(found.policy, first.policy, atol=1e-6)
    else:
        assert_as_padded(found, name, example().inputs)


@pytest.mark.slow
@pytest.mark.parametrize("name", SECOND)
def test_every_method_makes_the_steps_of_the_padded_model(name):
    assert_as_padded(solved(name), name, example().inputs)


# Compiling derivatives takes seconds; by default each way to reduce choices occurs.
USUAL = ("policy_value", "optimal_value-policy_iteration", "soft_value-newton", "occupancy_measure")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in USUAL else pytest.mark.exhaustive) for n in SOLVERS]
)
def test_derivatives(name):
    """Forward, reverse and central differences, in all inputs and the probabilities."""
    model, _, inputs, _ = example()
    solver, host, rng = SOLVERS[name], model.host, np.random.default_rng(1)

    def balanced(owner):
        noise = rng.normal(size=owner.size)
        return noise - (np.bincount(owner, noise) / np.bincount(owner))[owner]

    directions = {
        "reward": rng.normal(size=host.num_rows),
        "discount": np.ones(()),
        "policy": balanced(host.state),
        "probability": balanced(host.row),
    }
    point = {n: inputs[n] for n in solver.needs} | {"probability": model.probability}

    def answer(x):
        changed = replace(numbers(model), probability=x["probability"])
        solution = solver.solve(changed, {**inputs, **x})
        is_part = name.startswith(("soft", "boltzmann"))
        return (solution.value, solution.policy) if is_part else solution.value

    assert_gradients(answer, point, {n: directions[n] for n in point})


def with_row(x: np.ndarray, row: int, number: float) -> np.ndarray:
    return np.where(np.arange(x.size) == row, number, x)


@cache
def cases() -> dict[str, tuple[Any, dict[str, Any]]]:
    """Lanes of one program: other probabilities and rewards, and what is none."""
    model, _, inputs, _ = example()
    rng, host = np.random.default_rng(2), model.host
    row = int(model.row_start[4])  # of a state with choices, the system's
    probability = rng.random(host.num_transitions) + 0.05
    probability /= np.bincount(host.row, probability)[host.row]
    other = replace(numbers(model), probability=probability)
    model = numbers(model)
    found = {
        "usual": (model, inputs),
        "other": (other, {**inputs, "reward": rng.normal(size=host.num_rows)}),
        "slow": (model, {**inputs, "discount": np.asarray(0.99)}),
    }
    for name, number in (("nan", np.nan), ("infinite", np.inf)):
        found[f"{name} reward"] = (
            model,
            {**inputs, "reward": with_row(inputs["reward"], row, number)},
        )
    for name, number in (("too much", 2.0), ("negative", -0.1), ("nan", np.nan)):
        found[f"{name} policy"] = (
            model,
            {**inputs, "policy": with_row(inputs["policy"], row, number)},
        )
    for name, discount in (("one", 1.0), ("nan", np.nan)):
        found[f"{name} discount"] = model, {**inputs, "discount": np.asarray(discount)}
    return found


LANES = (
    "policy_value",
    "optimal_value-modified_policy_iteration",
    "soft_value-newton",
    "occupancy_measure",
    "minimax_value-policy_iteration",
    "strategy_value",
)


@cache
def lanes(name: str) -> dict[str, jl.Solution]:
    models, inputs = zip(*cases().values(), strict=True)
    batch = jax.jit(jax.vmap(SOLVERS[name].solve))(stack(models), stack(inputs))
    batch = jax.tree.map(np.asarray, batch)
    return {case: lane(batch, i) for i, case in enumerate(cases())}


@pytest.mark.slow
@pytest.mark.parametrize("name", LANES)
def test_every_lane_is_as_if_alone(name):
    for case in ("usual", "other", "slow"):
        model, inputs = cases()[case]
        found, alone = lanes(name)[case], compiled(name)(model, inputs)
        assert_solutions_agree(found, alone, 1e-9)
        np.testing.assert_array_equal(found.num_steps, alone.num_steps)
    assert_as_padded(lanes(name)["slow"], name, cases()["slow"][1])


@pytest.mark.few(2)
@pytest.mark.parametrize("name", LANES)
def test_what_is_not_certified_has_not_converged(name):
    for case, one in lanes(name).items():
        *_, of = case.split()
        if of not in (*SOLVERS[name].needs,):
            assert one.status == Status.CONVERGED, case
            assert (one.lower <= one.value).all() and (one.value <= one.upper).all(), case
            continue
        reasons = {"policy": Status.INVALID_POLICY, "discount": Status.INVALID_DISCOUNT}
        expected = reasons.get(of, Status.NONFINITE)
        assert one.status == expected, case
        assert not np.isfinite(one.upper).any(), case


@pytest.mark.few(1)
@pytest.mark.parametrize("name", [n for n in LANES if "policy" in SOLVERS[n].needs])
def test_what_is_no_policy_is_named(name):
    for case, (_, inputs) in cases().items():
        if case.endswith("policy"):
            with pytest.raises(ValueError, match=r"the policy's weight"):
                jl.check(lanes(name)[case])
            with pytest.raises(ValueError, match=r"the policy's row .* of state 4"):
                SOLVERS[name].solve(example().model, inputs)


# --- options -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["policy_value", "optimal_value"])
def test_options_have_one_meaning_on_the_host_and_in_programs(name):
    model, _, inputs, _ = example()
    solve = partial(getattr(jl, name), model)
    if name == "policy_value":
        solve = partial(solve, inputs["policy"])
    solve = partial(solve, inputs["reward"])
    for tolerance in (1e-2, 1e-5, 1e-9):
        found = [
            solve(0.9, tolerance=tolerance),
            solve(0.9, tolerance=tolerance, max_steps=10_000),
            jax.jit(solve)(0.9, tolerance=tolerance),
        ]
        for one in found:
            assert one.status == Status.CONVERGED
            assert (one.upper - one.lower <= tolerance).all()
            for other in found:
                assert (one.lower <= other.upper).all()
    assert solve(0.999, max_steps=1).status == Status.MAX_STEPS
    for wrong in ({"max_steps": -3}, {"tolerance": np.nan}, {"tolerance": -1}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))}=.*; it must be"):
            solve(0.9, **wrong)
    if name == "optimal_value":
        with pytest.raises(ValueError, match="method='bogus'; choose one of auto"):
            solve(0.9, method="bogus")
        with pytest.raises(ValueError, match="evaluation_sweeps=-1; it must be an integer"):
            solve(0.9, evaluation_sweeps=-1)
    with pytest.raises(ValueError, match=r"reward is complex128\[16\]; give real numbers"):
        jl.optimal_value(model, inputs["reward"] + 1j, 0.9)


# --- what is particular to sparse models ---------------------------------------------------------


def test_rows_and_weights_are_one_policy():
    model, _, inputs, _ = example()
    rows = np.asarray(model.row_start[1:] - 1)
    actions, weight = model.rank[rows], np.zeros(model.num_rows)
    weight[rows] = 1
    for name in ("policy_value", "occupancy_measure", "strategy_value"):
        one, other = (
            compiled(name)(numbers(model), {**inputs, "policy": p}) for p in (actions, weight)
        )
        assert_solutions_agree(one, other)
    wrong = with_row(actions, 0, 99).astype(int)
    found = compiled("policy_value")(numbers(model), {**inputs, "policy": wrong})
    assert found.status == Status.INVALID_POLICY


def test_rewards_are_named_inside_jit():
    model = example().model
    row = jl.models.choice_reward(model, "gain")
    solve = jax.jit(lambda m, r: jl.optimal_value(m, r, 0.9))

    @jax.jit
    def by_name(m):
        return jl.optimal_value(m, "gain", 0.9), jl.optimal_value(m, m.rewards["gain"], 0.9)

    expected = solve(numbers(model), row)
    for found in by_name(numbers(model)):
        assert_solutions_agree(found, expected, 1e-12)
    with pytest.raises(ValueError, match="there is no reward 'loss'"):
        jax.jit(lambda m: jl.soft_value(m, "loss", 0.9))(numbers(model))
    with pytest.raises(ValueError, match=r"reward has shape \(3,\)"):
        jl.soft_value(model, np.zeros(3), 0.9)


def test_the_compiled_answer_is_the_hosts():
    model, _, inputs, _ = example()
    for name in ("optimal_value-policy_iteration", "policy_value"):
        host = SOLVERS[name].solve(model, inputs)
        assert (host.lower <= solved(name).upper).all() and (solved(name).lower <= host.upper).all()
        np.testing.assert_allclose(host.value, solved(name).value, atol=1e-6)


def test_outside_jit_models_are_taken_as_they_are():
    """Texts of variables are no part of a program."""
    model, _, inputs, _ = example()
    for name in ("soft_value-newton", "occupancy_measure"):
        assert_solutions_agree(SOLVERS[name].solve(model, inputs), solved(name), 1e-12)
    with jax.enable_x64(False):
        found = SOLVERS["soft_value-newton"].solve(model, inputs)
        assert found.value.dtype == np.float32
        assert found.status == Status.CONVERGED
        assert (found.lower <= solved("soft_value-newton").value).all()
        assert (solved("soft_value-newton").value <= found.upper).all()


def test_the_adjoint_of_soft_policies():
    case = example()
    policy = solved("soft_value-newton").policy
    cotangent = np.random.default_rng(3).normal(size=policy.size)
    found = soft_policy_adjoint(numbers(case.model), policy, 0.9, cotangent)
    expected = soft_policy_adjoint(
        case.padded, case.wide(policy), 0.9, jnp.asarray(case.wide(cotangent))
    )
    np.testing.assert_allclose(found, case.narrow(expected), atol=1e-10)


def test_where_the_boltzmann_operator_contracts_is_known_inside_jit():
    for count in (1, 2, 7, 1000):
        expected = boltzmann_expansion(count)
        np.testing.assert_allclose(
            jax.jit(boltzmann_expansion)(jnp.int32(count)), expected, rtol=1e-12
        )


@pytest.mark.slow
@pytest.mark.parametrize("label_on", ["entry", "exit"])
def test_products_are_solved_without_padding(label_on):
    model, _, _, _ = example()
    lazy = jl.product(numbers(model), "F (a & X b)", label_on=label_on)
    flat = jl.to_sparse(lazy)
    reward = np.random.default_rng(4).normal(size=flat.num_rows)

    @jax.jit
    def solve(lazy, reward):
        best = jl.optimal_value(lazy, "gain", 0.9)
        again = jl.policy_value(lazy, best.policy, "gain", 0.9)
        soft = jl.soft_value(lazy, reward, 0.9)
        against = jl.minimax_value(jl.Game(lazy, jnp.ones(lazy.state_shape, bool)), reward, 0.9)
        visits = jl.occupancy_measure(lazy, best.policy, 0.9)
        return best, again, soft, against, visits

    best, again, soft, against, visits = solve(lazy, reward)
    assert best.value.shape == best.policy.shape == against.policy.shape == lazy.state_shape
    host = jl.optimal_value(lazy, "gain", 0.9)
    np.testing.assert_array_equal(best.policy, host.policy)
    for found in (best, again, jl.policy_value(lazy, host.policy, "gain", 0.9)):
        np.testing.assert_allclose(found.value, host.value, atol=1e-6)
    assert_solutions_agree(soft, jl.soft_value(flat, reward, 0.9), 1e-10)
    np.testing.assert_allclose(against.value, jl.optimal_value(lazy, reward, 0.9).value, atol=1e-6)
    np.testing.assert_allclose(
        visits.value @ jl.models.choice_reward(flat, "gain"),
        np.sum(flat.initial * host.value.ravel()),
        atol=1e-6,
    )


def test_the_environment_may_move_for_nothing():
    case = example()
    rng = np.random.default_rng(5)
    for _ in range(20):
        model = random_sparse(rng, COUNT, most=3, width=2)
        padded = jl.to_padded(model)
        action = np.arange(model.num_rows) - model.row_start[model.host.state]
        case = Example(model, padded, {}, action)
        reward = rng.normal(size=model.num_rows)
        try:
            expected = jl.minimax_value(game_of(padded), case.wide(reward), 0.8, per="system_move")
        except ValueError as error:
            with pytest.raises(ValueError, match="the environment can move for ever"):
                jl.minimax_value(game_of(model), reward, 0.8, per="system_move")
            assert "for ever" in str(error)
            continue
        found = jl.minimax_value(game_of(model), reward, 0.8, per="system_move")
        assert_solutions_agree(found, expected, 1e-10)
        return
    raise AssertionError("no such model was found")


@pytest.mark.parametrize("kind", ["padded", "rows"])
def test_rewards_that_cancel_leave_their_rounding(kind):
    """The sum of what large rewards of transitions leave is enclosed, exactly computed."""
    rng, size = np.random.default_rng(6), 3
    matrix = rng.dirichlet(np.ones(size), size=(size, 1))
    padded = jl.from_dense(matrix)
    reward = rng.normal(size=matrix.shape) * 1e8
    reward -= (matrix * reward).sum(-1, keepdims=True)
    exact = [[Fraction(float(x)) for x in row] for row in np.asarray(padded.probability)[:, 0]]
    earned = [
        sum(p * Fraction(float(x)) for p, x in zip(row, reward[s, 0], strict=True))
        for s, row in enumerate(exact)
    ]
    system = [
        [Fraction(int(s == t)) - Fraction(1, 2) * p for t, p in enumerate(row)]
        for s, row in enumerate(exact)
    ]
    solve = jax.jit(lambda m, r: jl.optimal_value(m, r, 0.5))
    found = (
        solve(padded, reward) if kind == "padded" else solve(jl.to_sparse(padded), reward.ravel())
    )
    assert found.status == Status.CONVERGED
    assert_encloses(found, exact_solve(system, earned))
