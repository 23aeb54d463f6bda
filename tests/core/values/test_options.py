"""Options of solvers: of a wrong type or range they are refused by name, for every kind of model."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import jaxltl as jl
from jaxltl import values

# In place of a number, a word or a truth value; no option takes any of these.
WRONG = {
    "nan": float("nan"),
    "minus infinity": -float("inf"),
    "text": "wurst",
    "list": [],
    "numbers": [0.1, 0.2],
    "object": object(),
    "dict": {"x": 1},
    "array": np.zeros((2, 5)),
    "a JAX array": jnp.nan,
}
# What NumPy, Python and JAX say, which names neither the argument nor what to give.
RAW = re.compile(
    "could not|setting an array|inhomogeneous|truth value|invalid literal|zero-size|cannot convert|"
    "not enough values|ncompatible shapes|abstract array|unhashable|Non-hashable|jit"
)
S, A = 3, 2


def coin():
    return jl.make_sparse(
        [0, 2, 3, 4],
        [0, 2, 3, 4, 5],
        [1, 2, 0, 1, 2],
        [0.5, 0.5, 1, 1, 1],
        initial=[1, 0, 0],
        label={"a": [1]},
        rewards={"r": jl.models.Rewards(state=[1.0, 0, 0])},
    )


KINDS = {
    "sparse": coin,
    "padded": lambda: jl.to_padded(coin()),
    "dense": lambda: jl.models.to_dense(jl.to_padded(coin())),
}


def calls(kind):
    """Solvers with valid arguments, and those options of which every wrong value is refused."""
    model = KINDS[kind]()
    target, ones = np.arange(S) == 1, np.ones(S)
    rows = np.array([0.5, 0.5, 1, 1])
    policy = rows if kind == "sparse" else np.array([[0.5, 0.5], [1, 0], [1, 0]])
    earned = "r" if kind == "sparse" else np.ones((S, A))
    reach, until = {"model": model, "target": target}, {"tolerance": 1e-6, "objective": "min"}
    discounted = {"model": model, "reward": earned, "discount": 0.9}
    method = {"tolerance": 1e-6, "reward": earned, "discount": 0.9}
    steps = {"objective": "max", "by_step": False}
    game = jl.make_game(KINDS["padded"](), np.arange(S) == 0)
    prod = jl.product(KINDS["padded"](), "F a")
    one = np.zeros((*prod.state_shape, A))
    one[..., 0] = 1
    goals = [values.Objective(target=target, direction="max")]
    found = [
        (jl.reachability_probability, reach, until | {"method": "auto", "relative": False}),
        (jl.reachability_probability, reach, {"stay": ones > 0, "policy": policy}),
        (jl.total_reward, reach | {"reward": earned}, until | {"reward": ones, "policy": policy}),
        (jl.optimal_value, discounted, method | {"max_steps": 9, "method": "auto"}),
        (jl.policy_value, discounted | {"policy": policy}, method | {"policy": policy}),
        (jl.soft_value, discounted, method | {"method": "newton", "guess": ones}),
        (values.boltzmann_value, discounted, {"method": "damped", "guess": ones}),
        (
            jl.occupancy_measure,
            {"model": model, "policy": policy, "discount": 0.9},
            {"initial": ones, "tolerance": 1e-6, "discount": 0.9},
        ),
        (
            jl.average_reward,
            {"model": model, "reward": earned},
            {"objective": "max", "max_steps": 1000, "reward": ones, "tolerance": 1e-6},
        ),
        (values.next_probability, reach, {"objective": "max", "target": target}),
        (values.bounded_reachability, reach | {"num_steps": 3}, {"num_steps": 3} | steps),
        (
            values.cumulative_reward,
            {"model": model, "reward": earned, "num_steps": 3},
            {"num_steps": 3, "reward": ones} | steps,
        ),
        (
            values.instantaneous_reward,
            {"model": model, "reward": ones, "num_step": 3},
            {"num_step": 3, "reward": ones} | steps,
        ),
        (
            values.reward_bounded_reachability,
            reach | {"reward": ones, "bound": 2},
            {"bound": 2, "reward": ones, "by_level": False, "objective": "max"},
        ),
        (jl.prepare, reach, {"objective": "max", "target": target}),
        (
            jl.graphs.attractor,
            {"model": model, "goal": target},
            {"chance": "some", "rule": "exists"},
        ),
    ]
    if kind != "padded":
        return found
    return [
        *found,
        (jl.optimal_satisfaction, {"model": prod}, {"objective": "max", "tolerance": 1e-6}),
        (jl.satisfaction_probability, {"model": prod, "policy": one}, {"method": "auto"}),
        (jl.optimal_actions, {"model": prod}, {"objective": "max", "solution": None}),
        (jl.task_performance, {"model": prod, "policy": one}, {"method": "auto"}),
        (values.practical_policy, {"model": prod, "policy": one}, {"over": "mean"}),
        (jl.minimax_value, {"game": game, "reward": earned, "discount": 0.9}, {"per": "move"}),
        (jl.constrained_optimum, {"model": coin(), "objectives": goals}, {"tolerance": 1e-6}),
        (jl.solve_property, {"model": coin(), "prop": 'Pmax=? [F "a"]'}, {"tolerance": 1e-6}),
        (jl.to_automaton, {"formula": "F a"}, {"max_states": 9, "acceptance": "auto"}),
        (jl.product, {"world": KINDS["padded"](), "formula": "F a"}, {"label_on": "entry"}),
    ]


def accepted_or_raw(cases, wrong):
    """The options that take a wrong value, or refuse it without naming the argument."""
    problems = []
    for solve, given, options in cases:
        for name in options:
            for kind, value in wrong.items():
                place = f"{solve.__name__}({name}={kind})"
                try:
                    solve(**given | {name: value})
                except ValueError as error:
                    if RAW.search(str(error)):
                        problems.append(f"{place}: {error}")
                except Exception as error:
                    problems.append(f"{place}: {type(error).__name__} {error}")
                else:
                    problems.append(f"{place}: accepted")
    return problems


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_options_are_refused_by_name(kind):
    problems = accepted_or_raw(calls(kind), WRONG)
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("seed", range(3))
def test_rewards_of_all_shapes_are_those_of_choices(seed):
    """``[S]``, ``[S, A]`` and ``[S, A, K]`` of padded models are the sparse model's expected rewards."""
    rng = np.random.default_rng(seed)
    sparse = coin()
    padded, dense = KINDS["padded"](), KINDS["dense"]()
    of_state, of_pair = rng.random(S), rng.random((S, A))
    of_arc = rng.random((S, A, S))
    at = np.asarray(padded.successor)
    host = sparse.host
    pair = host.state, sparse.rank
    arcs = of_arc[host.state[host.row], sparse.rank[host.row], host.successor]
    same = [
        (of_state, of_state, of_state),
        (of_pair[pair], of_pair, of_pair),
        (arcs, np.take_along_axis(of_arc, at, axis=-1), of_arc),
    ]
    target = np.arange(S) == 2
    for rewards in same:
        for solve in (
            lambda m, r: jl.average_reward(m, r).value,
            lambda m, r: values.cumulative_reward(m, r, 4).value,
            lambda m, r: jl.total_reward(m, r, target, objective="min").value,
        ):
            found = [solve(m, r) for m, r in zip((sparse, padded, dense), rewards, strict=True)]
            np.testing.assert_allclose(found[1], found[0], rtol=1e-6)
            np.testing.assert_allclose(found[2], found[0], rtol=1e-6)
    for r in (of_state, of_pair):
        expected = values.reward_bounded_reachability(
            sparse, target, np.round(r, 1) if r is of_state else np.round(r, 1)[pair], 1.0
        ).value
        for m in (padded, dense):
            found = values.reward_bounded_reachability(m, target, np.round(r, 1), 1.0).value
            np.testing.assert_allclose(found, expected, rtol=1e-9)
