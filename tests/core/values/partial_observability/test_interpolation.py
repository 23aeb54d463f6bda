"""Decompositions of beliefs, and bounds of all nodes by them, against controllers and their own definition."""

import numpy as np
import pytest

import jaxltl as jl
from jaxltl.core.values.partial_observability.beliefs import BeliefGraph
from jaxltl.core.values.partial_observability.bounds import BeliefRows
from jaxltl.core.values.partial_observability.certified_controllers import Library
from jaxltl.core.values.partial_observability.controller_gradient import SoftmaxAscent
from jaxltl.core.values.partial_observability.interpolation import (
    Interpolation,
    improve_bounds,
    visits,
)
from jaxltl.core.values.partial_observability.problem import reach_problem

from .reference import random_pomdp


@pytest.mark.parametrize("maximize", [True, False])
def test_decompositions_add_up_and_bound_every_controller(maximize):
    saved = 0.0
    for seed in (0, 2):
        pomdp, table = random_pomdp(seed)
        target = np.eye(len(table), dtype=bool)[-2]
        problem = reach_problem(pomdp, target, None, maximize=maximize)
        graph = BeliefGraph(problem)
        interpolation = Interpolation(graph)
        assert not interpolation.expand_states(graph.root[0], 0)  # no room for the states
        assert interpolation.expand_states(graph.root[0], 100)
        for _ in range(3):
            graph.expand(np.flatnonzero(~graph.expanded)[:12])
        bound = np.full(graph.size, 1.0 if maximize else 0.0)
        rows = BeliefRows(graph, graph.rows())
        improve_bounds(rows, interpolation.leaves(), bound, 1e-3)
        leaves = np.flatnonzero(~graph.expanded)
        interpolation.expand_states(leaves, 100)
        bound = np.append(bound, np.full(graph.size - bound.size, 1.0 if maximize else 0.0))
        rows = BeliefRows(graph, graph.rows())
        improve_bounds(rows, interpolation.leaves(), bound, 1e-3)
        interpolation.refine(leaves, bound)
        parts = interpolation.leaves()
        dense = graph.measures().matrix(problem.num_states).toarray()
        np.testing.assert_allclose(parts.matrix @ dense, dense[parts.leaf], atol=1e-14)
        assert (parts.matrix.data > 0).all()
        before = bound.copy()
        values = improve_bounds(rows, parts, bound, 1e-3)
        saved += np.abs(before - values.value).sum()
        # Every controller's certified value is on the other side, at every node.
        some = [SoftmaxAscent.random(problem, 2, 1.0, i).policies()[-1] for i in range(3)]
        attained, _ = Library(problem, some).best_at(graph.measures())
        gap = values.value - attained if maximize else attained - values.value
        assert (gap >= -1e-9).all(), (seed, gap.min())
        mass, moving = visits(rows, parts, values.row)
        assert (mass >= 0).all() and 0 <= moving <= 1 + 1e-9
    assert saved > 0


def test_the_belief_of_a_state_whose_stored_mass_is_one_up_to_rounding():
    # Ten weights of .1 add up to less than one, and lead to one state.
    table = np.zeros((13, 1, 13))
    table[0, 0, 1:11] = 0.1
    table[1:11, 0, 11] = 1
    table[11:, 0, 12] = 1
    model = jl.to_sparse(jl.from_dense(table, initial=np.eye(13)[0]))
    pomdp = jl.models.make_pomdp(model, np.minimum(np.arange(13), 1))
    problem = reach_problem(pomdp, np.eye(13, dtype=bool)[12], None, maximize=True)
    graph = BeliefGraph(problem)
    for _ in range(2):
        graph.expand(np.flatnonzero(~graph.expanded))
    known = np.flatnonzero(problem.state == 11)
    weight = graph.measures().take(graph.corners(known)).weight
    assert weight.size == 1 and 0 < 1 - weight[0] < 1e-15
