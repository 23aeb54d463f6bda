"""The policies of sparse models are the fastest optimal ones, against fractions."""

import pickle
from fractions import Fraction

import jax
import numpy as np

import jaxltl as jl
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.values.properties.solve_property import solve_property
from tests import reference_fractions
from tests.core.values.undiscounted.test_quickest import random_world


def exact_choices(host):
    """Of each state its rows with distributions, in the fractions that the world was made of."""
    return [
        [
            (
                r,
                {
                    int(host.successor[e]): Fraction(float(host.probability[e])).limit_denominator(
                        4000
                    )
                    for e in range(*host.entry_start[r : r + 2])
                },
            )
            for r in range(*host.row_start[s : s + 2])
        ]
        for s in range(host.num_states)
    ]


def require_fastest(found, maximize=True):
    """The policy attains the optimum in the least steps, from every state of the product."""
    host, automaton = found.product.host, found.automaton
    from jaxltl.core.automata.runs import universal_states

    goal = np.flatnonzero(universal_states(automaton)[found.product.memory])
    choices = exact_choices(host)
    worth = {int(s): Fraction(1) for s in goal}
    value = reference_fractions.optimum(choices, worth, None, maximize)
    ended = {s: Fraction(0) for s in range(len(choices)) if s in worth or not value[s]}
    optimal = [
        [a for a in some if s in ended or sum(p * value[t] for t, p in a[1].items()) == value[s]]
        for s, some in enumerate(choices)
    ]
    cost = np.ones(host.num_rows)
    least = reference_fractions.optimum(optimal, ended, cost, False)
    taken = [
        [a for a in some if found.product.base_row[a[0]] == found.row[s]]
        for s, some in enumerate(choices)
    ]
    attained = reference_fractions.optimum(taken, worth, None, True)
    steps = reference_fractions.optimum(taken, ended, cost, False)
    for s in range(len(choices)):
        np.testing.assert_allclose(float(attained[s]), float(value[s]), rtol=1e-9)
        np.testing.assert_allclose(float(steps[s]), float(least[s]), rtol=1e-6)


def test_policies_of_sparse_models_take_the_least_steps():
    with jax.enable_x64(True):
        for seed in range(8):
            sparse = to_sparse(random_world(seed))
            require_fastest(jl.optimal_satisfaction(sparse, "!o U b").product_policy)
            answer = solve_property(sparse, 'Pmax=? [ (F "b") & (!"o" U "b") ]')
            require_fastest(answer.strategy.memory)
            assert (answer.strategy.row == answer.strategy.memory.row).all()
            plain = solve_property(sparse, 'Pmax=? [ !"o" U "b" ]').strategy.row
            states = np.arange(sparse.num_states)
            found = jl.optimal_satisfaction(sparse, "!o U b", states=states).product_policy
            live = found.value > 0
            steps = found.product.base_state
            assert (found.row == plain[steps])[live & (found.value < 1)].all()


def test_deferred_rows_are_arrays_and_can_be_pickled():
    found = jl.optimal_satisfaction(to_sparse(random_world(0)), "!o U b").product_policy
    again = pickle.loads(pickle.dumps(found))
    assert isinstance(found.row, np.ndarray) and (again.row == found.row).all()


def test_a_deferred_strategy_is_an_array_also_as_an_item():
    model = jl.make_sparse(
        [0, 2, 3, 4],
        [0, 1, 2, 3, 4],
        [1, 2, 1, 2],
        [1, 1, 1, 1],
        initial=[1, 0, 0],
        label={"a": [1]},
    )
    strategy = jl.solve_property(model, 'Pmax=? [ F "a" ]').strategy
    row, *_ = strategy
    assert row[0] == strategy.row[0] == strategy[0][0] and len(row) == 3
    assert row.shape == (3,) and list(row) == strategy._asdict()["row"].tolist()
