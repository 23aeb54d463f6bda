"""Controllers that rollouts of policies with full sight begin, against all sequences of actions."""

from itertools import product

import numpy as np

import jaxltl as jl
from jaxltl.core.values.partial_observability.beliefs import BeliefGraph
from jaxltl.core.values.partial_observability.bounds import BeliefRows
from jaxltl.core.values.partial_observability.interpolation import near_visits, policy_visits
from jaxltl.core.values.partial_observability.problem import reach_problem
from jaxltl.core.values.partial_observability.rollouts import (
    action_guides,
    deviations,
    heaviest,
    roll_out,
)
from jaxltl.core.values.partial_observability.solve import belief_bounds

CELLS, FUEL, STATIONS = 13, 9, (5, 10)


def line():
    """A robot on a line that sees its fuel, and stations of which the first one fills it up again."""
    size = CELLS * (FUEL + 1) * 2
    number = np.arange(size).reshape(2, FUEL + 1, CELLS)
    chance = np.zeros((2, size, size))
    seen = np.zeros(size, int)
    for done, fuel, cell in np.ndindex(number.shape):
        state = number[done, fuel, cell]
        seen[state] = fuel + (FUEL + 1) * done
        for action, sign in enumerate((1, -1)):
            for length, p in ((1, 0.7), (2, 0.3)):
                to = min(max(cell + sign * length, 0), CELLS - 1)
                if fuel == 0 or (done and cell == STATIONS[1]):
                    after = state
                elif not done and to == STATIONS[0]:
                    after = number[1, FUEL, to]
                else:
                    after = number[done, fuel - 1, to]
                chance[action, state, after] += p
    goal = np.isin(np.arange(size), number[1, :, STATIONS[1]])
    model = jl.from_dense(chance.transpose(1, 0, 2), initial=np.eye(size)[number[0, FUEL, 0]])
    return jl.models.make_pomdp(jl.to_sparse(model), seen), goal, chance, number


def best_sequence(chance, start, hit, fuel):
    """The largest probability of being in `hit` at some time, over all sequences of actions."""
    best = 0.0
    for actions in product((0, 1), repeat=fuel):
        mass, total = np.eye(len(hit))[start], 0.0
        for action in actions:
            mass = mass @ chance[action]
            total += mass[hit].sum()
            mass[hit] = 0
        best = max(best, total)
    return best


def test_rollouts_begin_with_good_controllers_where_sight_would_always_win():
    pomdp, goal, chance, number = line()
    first = np.isin(np.arange(goal.size), number[1, FUEL, STATIONS[0]])
    optimum = best_sequence(chance, number[0, FUEL, 0], first, FUEL)
    optimum *= best_sequence(chance, number[1, FUEL, STATIONS[0]], goal, FUEL)
    answer = belief_bounds(pomdp, goal, max_beliefs=2000)
    assert answer.lower <= optimum + 1e-9 and optimum <= answer.upper + 1e-9
    assert answer.upper - answer.lower <= 1e-3
    problem = reach_problem(pomdp, goal, None, maximize=True)
    graph, values = BeliefGraph(problem), []
    mass = np.bincount(*graph.root[:2], minlength=graph.size).astype(float)
    guides = action_guides(problem)
    for _ in range(3):
        for guide in guides:
            leaves = np.append(mass, np.zeros(graph.size - mass.size))
            leaves[graph.expanded] = 0
            roll_out(graph, leaves, guide, 100)
        rows = BeliefRows(graph, graph.rows())
        policy = rows.solve(np.zeros(graph.size), safe=False, tolerance=1e-6)
        values.append(rows.at_root(policy.value))
        mass = deviations(rows, policy.row)
        assert (mass[graph.expanded] == 0).all()
    assert graph.expanded.sum() <= 100
    assert values == sorted(values) and values[0] > 0.5 * optimum
    assert 0.97 * optimum <= values[-1] <= optimum + 1e-6


def walked(rows, near):
    """Expected visits by all paths; `near` gives the rows of a node that are equally likely."""
    table, expected = rows.table, np.zeros(rows.graph.size)
    stack = [(int(rows.graph.root[0][0]), 1.0)]
    while stack:
        node, mass = stack.pop()
        expected[node] += mass
        own = near(np.flatnonzero(table["node"] == node))
        for r in own:
            for e in range(table["start"][r], table["start"][r + 1]):
                stack.append((int(table["to"][e]), mass / len(own) * table["by"][e]))
    return expected


def test_visits_of_a_policy_and_of_all_near_actions():
    pomdp, goal, _, _ = line()
    graph = BeliefGraph(reach_problem(pomdp, goal, None, maximize=True))
    for _ in range(4):
        graph.expand(np.flatnonzero(~graph.expanded))
    rows = BeliefRows(graph, graph.rows())
    table, bound = rows.table, np.linspace(1, 0.5, graph.size)
    value = table["gain"] + table["lost"] + rows.matrix @ bound
    for width in (0.0, 0.01, np.inf, np.nan):
        expected = walked(
            rows, lambda own, w=width: [r for r in own if not value[own].max() - value[r] > w]
        )
        np.testing.assert_allclose(near_visits(rows, bound, width), expected, atol=1e-12)
    policy = np.full(graph.size, -1)
    policy[table["node"]] = np.arange(table["node"].size)
    np.testing.assert_allclose(
        policy_visits(rows, policy), walked(rows, lambda own: own[-1:]), atol=1e-12
    )
    assert heaviest(np.array([0.1, 0.0, 3.0, 2.0]), 2).tolist() == [2, 3]
