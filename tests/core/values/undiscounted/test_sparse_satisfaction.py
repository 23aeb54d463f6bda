"""Formulas on sparse models: against the padded engine, and the chain of the strategy."""

import jax
import numpy as np
import pytest

from jaxltl.core.models.construct.lifting import project_policy
from jaxltl.core.models.construct.padded import to_padded
from jaxltl.core.models.product import product
from jaxltl.core.models.product_policy import ProductPolicy
from jaxltl.core.models.sparse import SparseMDP, make_sparse
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction

FORMULAS = (
    "F (a & X F b)",
    "!a U (b & F c)",
    "X X a",
    "a & F b",
    "true",
    "a",  # a prefix proves
    "G (a -> X b)",
    "G !(a & b) & X !c",
    "a W (b & X a)",  # a prefix refutes
    "G F a",
    "G F a & G F b",
    "G (a -> F b)",
    "G F a & G !c",  # Buchi
    "F G a",
    "F G !a | G F b",
    "G F a -> G F b",
    "F G a & G F b & !c U b",
    "G F a & F G (b | c)",
)


def random_sparse(seed: int, num_states: int = 6, most_rows: int = 3) -> SparseMDP:
    rng = np.random.default_rng(seed)
    rows = rng.integers(1, most_rows + 1, num_states)
    width = rng.integers(1, 4, rows.sum())
    successor = np.concatenate([rng.choice(num_states, w, replace=False) for w in width])
    weight = rng.integers(1, 5, successor.size).astype(float)
    start = np.append(0, width.cumsum())
    weight /= np.repeat(np.add.reduceat(weight, start[:-1]), width)
    initial = np.zeros(num_states)
    initial[:3] = 1 / 3
    return make_sparse(
        np.append(0, rows.cumsum()),
        start,
        successor,
        weight,
        initial=initial,
        label=rng.random((num_states, 3)) < 0.4,
        propositions=["a", "b", "c"],
    )


def chain_of(model: SparseMDP, found: ProductPolicy) -> SparseMDP:
    """The Markov chain that the strategy makes, with the labels of the model's states."""
    mdp, n = found.product.host, found.product.base_state.size
    # The row that the product has for the model's row, by its rank among the state's choices.
    rank = found.row - model.host.row_start[found.product.base_state]
    row = mdp.row_start[:-1] + np.where(found.product.still, 0, rank)
    entry = [np.arange(mdp.entry_start[r], mdp.entry_start[r + 1]) for r in row]
    start = np.append(0, np.cumsum([e.size for e in entry]))
    entry = np.concatenate(entry)
    initial = np.bincount(found.product.start, minlength=n) / found.product.start.size
    return make_sparse(
        None,
        start,
        mdp.successor[entry],
        mdp.probability[entry],
        initial=initial,
        label=np.asarray(model.label)[found.product.base_state],
        propositions=model.propositions,
    )


@pytest.mark.few(9)
@pytest.mark.parametrize("formula", FORMULAS)
def test_values_are_those_of_the_padded_product(formula):
    for seed in range(3):
        model = random_sparse(seed)
        lazy = product(to_padded(model), formula)
        states = np.arange(model.num_states)
        for objective in ("max", "min"):
            wanted = optimal_satisfaction(lazy, objective=objective)
            at = states, np.asarray(lazy.initial_memory)
            for label_on in ("entry", "exit"):
                solution = optimal_satisfaction(
                    model, formula, objective=objective, states=states, label_on=label_on
                )
                assert (solution.lower <= solution.value).all()
                assert (solution.value <= solution.upper).all()
                assert (solution.upper - solution.lower <= 1e-6).all()
                np.testing.assert_allclose(solution.value, np.asarray(wanted.value)[at], atol=1e-5)


@pytest.mark.few(9)
@pytest.mark.parametrize("formula", FORMULAS)
def test_strategies_attain_what_they_are_said_to(formula):
    for seed in range(3, 6):
        model = random_sparse(seed)
        for objective in ("max", "min"):
            found = optimal_satisfaction(model, formula, objective=objective)
            chain = chain_of(model, found.product_policy)
            start = found.product_policy.product.start
            attained = optimal_satisfaction(chain, formula, states=start)
            np.testing.assert_allclose(attained.value, found.value, atol=1e-6)


def test_bad_arguments_are_named():
    model = random_sparse(0)
    with pytest.raises(ValueError, match="objective='most'"):
        optimal_satisfaction(model, "F a", objective="most")
    with pytest.raises(ValueError, match="label_on='left'"):
        optimal_satisfaction(model, "F a", label_on="left")
    with pytest.raises(ValueError, match="'goal', which the world does not have"):
        optimal_satisfaction(model, "F goal")


def test_options_of_other_models_are_refused():
    model = random_sparse(np.random.default_rng(0), 4)
    for option in ({"max_steps": 3}, {"start": (0, 1)}, {"nature": "adversarial"}):
        with pytest.raises(ValueError, match=r"options for a product|is for models with intervals"):
            optimal_satisfaction(model, "F a", **option)
    for option in ({"states": [0]}, {"label_on": "exit"}):
        with pytest.raises(ValueError, match="for a model and a formula"):
            optimal_satisfaction(product(model, "F a"), **option)
    with pytest.raises(ValueError, match="is no product of a world and a task"):
        optimal_satisfaction(model)


def test_answers_of_a_formula_are_solutions():
    model = random_sparse(0)
    start = np.flatnonzero(np.asarray(model.initial) > 0)
    best = optimal_satisfaction(model, "F a & G !c")
    padded = optimal_satisfaction(product(to_padded(model), "F a & G !c"))
    np.testing.assert_allclose(best.at_initial.value, padded.at_initial.value, atol=1e-5)
    assert best.at_initial.lower <= best.at_initial.value <= best.at_initial.upper
    # The policy is a static field, which jit and tree functions keep.
    again = jax.jit(lambda solution: jax.tree.map(lambda x: x + 0, solution))(best)
    assert again.product_policy is best.product_policy
    assert project_policy(model, best).action.shape[0] == model.num_states
    chosen = optimal_satisfaction(model, "F a & G !c", states=start)
    np.testing.assert_array_equal(chosen.value, best.value)
    with pytest.raises(ValueError, match="initial"):
        _ = chosen.at_initial
