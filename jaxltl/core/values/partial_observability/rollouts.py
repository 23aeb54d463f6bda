"""Expansion of beliefs along policies that act as if states were seen: good controllers begin there.

Such a policy takes the action of the best expected value over the states of a belief (Littman, Cassandra and
Kaelbling 1995). Values are discounted, since those of states that are seen often tie at one, and the way that
ends sooner is the better guess. The rows of the beliefs that it reaches then improve it, action by action
(rollout; Bertsekas and Castanon 1999). Nothing here is a bound.
"""

from __future__ import annotations

import numpy as np

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.values.partial_observability.beliefs import BeliefGraph
from jaxltl.core.values.partial_observability.bounds import BeliefRows
from jaxltl.core.values.partial_observability.interpolation import policy_visits
from jaxltl.core.values.partial_observability.problem import BeliefProblem

_DISCOUNTS = 0.9, 0.99
_SWEEPS = 1000  # of the values of states that are seen
_STILL = 1e-6  # change of these, relative to the largest one, at which sweeps end
_LARGEST = 600  # beliefs of a rollout
_LEFT = 1e-3  # share of the mass that need not arrive
_LEAST = 1e-12  # share of the heaviest belief that is worth an expansion


def action_guides(problem: BeliefProblem) -> list[Floats]:
    """Discounted values of actions where states are seen, ``float64[A, N]`` for each discount."""
    worst = -np.inf if problem.maximize else np.inf
    legal = problem.available.T[:, problem.observation]
    guides = []
    for discount in _DISCOUNTS:
        value = np.zeros(problem.num_states)
        for _ in range(_SWEEPS):
            steps = [t @ value for t in problem.transition]
            table = np.where(legal, problem.gain + discount * np.stack(steps), worst)
            new = table.max(0) if problem.maximize else table.min(0)
            change, value = np.abs(new - value).max(initial=0), new
            if change <= _STILL * np.abs(value).max(initial=0):
                break
        guides.append(np.where(legal, table, 0.0))
    return guides


def deviations(rows: BeliefRows, policy: Integers) -> Floats:
    """Expected visits of leaves, ``float64[nodes]``, one action away from a policy of rows ``int[nodes]``."""
    graph, table = rows.graph, rows.table
    mass = policy_visits(rows, policy)
    row = np.arange(table["node"].size).repeat(np.diff(table["start"]))
    arriving = np.bincount(
        table["to"], table["by"] * mass[table["node"]][row], minlength=graph.size
    )
    return np.where(graph.expanded, 0.0, np.maximum(arriving, mass))


def heaviest(mass: Floats, most: int) -> Integers:
    """The nodes of the largest mass ``float64[nodes]``, in ascending order."""
    chosen = np.flatnonzero(mass > _LEAST * mass.max(initial=0))
    return np.sort(chosen[np.argsort(-mass[chosen], kind="stable")][:most])


def roll_out(graph: BeliefGraph, mass: Floats, guide: Floats, room: int) -> int:
    """Expands leaves of a mass ``float64[nodes]`` and, level by level, those that follow by a guide; how many."""
    problem, done = graph.problem, 0
    room, least = min(room, _LARGEST), _LEFT * mass.sum()
    while done < room and mass.sum() > least:
        chosen = heaviest(mass, room - done)
        before = graph.num_rows
        graph.expand(chosen)
        done += chosen.size
        worth = graph.measures().take(chosen).matrix(problem.num_states) @ guide.T
        legal = problem.available[graph.observation()[chosen]]
        worth = np.where(legal, worth, -np.inf if problem.maximize else np.inf)
        action = np.full(graph.size, -1)
        action[chosen] = worth.argmax(1) if problem.maximize else worth.argmin(1)
        part = graph.rows_from(before)
        arriving = (part["action"] == action[part["node"]]) * mass[part["node"]]
        weight = part["by"] * arriving.repeat(part["count"])
        mass = np.bincount(part["to"], weight, minlength=graph.size).astype(np.float64)
        mass[graph.expanded] = 0
    return done
