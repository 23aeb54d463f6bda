"""Controllers for formulas of linear temporal logic on POMDPs: parity objectives as reachability.

In the product with a deterministic parity automaton, whose state is hidden as far as labels are, the
satisfaction probability of a controller is that of reaching accepting bottom components of its chain. Optima
are undecidable, and a controller with random choices often violates the formula in the long run. Gradients
therefore follow a smooth objective: a transition that reads the priority of rank r ends the run with
probability ``leak_r``, with success if the priority is even, and ``leak_0 > leak_1 > ...`` (Hahn et al. 2019,
for Buchi conditions). As the leaks tend to 0, each one faster than the one before, its value tends to the
satisfaction probability of a fixed controller.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import FormulaLike, to_automaton
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.product import product
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.policies.finite_memory import FiniteMemoryPolicy
from jaxltl.core.sparse.graph.accepting import accepting_region
from jaxltl.core.sparse.graph.qualitative import backward_reachable
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import reachability as solver
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.partial_observability.chains import chain_solution, controlled_chain
from jaxltl.core.values.partial_observability.controller_gradient import SoftmaxAscent
from jaxltl.core.values.partial_observability.problem import (
    BeliefProblem,
    leaking_problem,
    reach_problem,
)
from jaxltl.core.values.partial_observability.reduction import without_rare_actions
from jaxltl.core.values.undiscounted.sparse_satisfaction import sparse_satisfaction

LEAK = 0.1  # of the least priority
_LEAST = 1e-4  # of the greatest one; chains have about 1 / _LEAST steps
# memory states, scale of the random logits, and rate of each start
_STARTS = ((1, 0.0, 0.3), (2, 0.5, 0.2), (2, 1.0, 0.3), (3, 0.5, 0.2), (3, 1.0, 0.3), (4, 1.0, 0.3))
_STEPS = 150  # of a start
_PATIENCE, _STILL = 25, 1e-4  # steps without a change, after which a start ends
_LARGE = 6000  # pairs of product states and memory states beyond which a start has a limit of time
_SECONDS = 30.0  # of such starts but the first, all together with the certificates of controllers
_CUTS = (1e-7, 1e-2, 0.1, 0.3)  # probabilities up to which actions are left out of a result
_DONE = 1e-9  # distance to the upper bound at which the search ends
_WIDTH = 1e-9  # of the bounds of a controller's value


def satisfaction_problem(
    pomdp: POMDP, formula: FormulaLike, *, maximize: bool, leak: float | None = LEAK
) -> BeliefProblem:
    """The smooth objective of a formula on the product's states; of a leak of None the exact probability.

    The exact one is the probability of reaching the bottom components that are accepting if all available
    actions have a positive probability, as in softmax controllers.
    """
    model, priority, size = _rows_of_product(pomdp.fully_observable, formula)
    joint = POMDP(model, np.repeat(np.asarray(pomdp.observation), size), pomdp.observables)
    if leak is None:
        region = accepting_region(*_union(model.host, priority)).region
        return reach_problem(joint, region, None, maximize=maximize)
    known, rank = np.unique(priority, return_inverse=True)
    least = min(_LEAST, leak ** (known.size + 1))
    ratio = (least / leak) ** (1 / max(known.size - 1, 1))
    ends = leak * ratio ** rank.ravel()
    return leaking_problem(joint, ends, priority % 2 == 0, maximize=maximize)


def _rows_of_product(world: SparseMDP, formula: FormulaLike) -> tuple[SparseMDP, Integers, int]:
    """The product with an automaton, the priority of each entry ``int[T]``, and the automaton's states."""
    joint = product(world, formula)
    model, size = to_sparse(joint), joint.num_memory
    host, letter = model.host, np.asarray(joint.letter)
    q = host.state[host.row] % size
    return model, np.asarray(joint.automaton.priority)[q, letter[host.successor // size]], size


def _union(host: HostMDP, priority: Integers) -> tuple[HostMDP, Integers]:
    """The graph in which each state has one choice, with all successors, and the priorities of its edges."""
    source = host.state[host.row].astype(np.int64)
    key, first = np.unique(source * host.num_states + host.successor, return_index=True)
    state, successor = np.divmod(key, host.num_states)
    count = np.bincount(state, minlength=host.num_states)
    start = np.concatenate([[0], np.cumsum(count)])
    chance = 1 / count[state]
    rows = np.arange(host.num_states + 1)
    return HostMDP(rows, start, successor, chance), priority[first]


def lost_states(pomdp: POMDP, formula: FormulaLike, *, maximize: bool) -> Booleans:
    """Product states ``bool[S * Q]`` from which no policy satisfies a formula, or of a minimum violates it."""
    model, priority, _ = _rows_of_product(pomdp.fully_observable, formula)
    region = accepting_region(model.host, priority if maximize else priority + 1).region
    return ~backward_reachable(model.host, region)


def controller_satisfaction(
    pomdp: POMDP, policy: FiniteMemoryPolicy, formula: FormulaLike
) -> tuple[float, float]:
    """Certified bounds of a controller's satisfaction probability from the initial belief."""
    chain, priority, _ = _rows_of_product(controlled_chain(pomdp, policy), formula)
    region = accepting_region(chain.host, priority).region
    bounds = solver.reachability(
        chain.host, region, maximize=True, tolerance=_WIDTH, depth=2 * pomdp.num_actions + 4
    )
    at = chain_solution(bounds, np.asarray(chain.initial)).at_initial
    return float(at.lower), float(at.upper)


def learned_satisfaction(
    pomdp: POMDP, formula: FormulaLike, *, objective: str, tolerance: float
) -> Solution:
    """The best of some controllers, with certified bounds of its value, and the fully observable optimum.

    A maximum lies between the lower bound of the controller and the upper bound of policies that see the
    states; a minimum the other way round.
    """
    maximize = objective == "max"
    automaton = formula if isinstance(formula, Automaton) else to_automaton(formula)
    visible = sparse_satisfaction(pomdp.fully_observable, automaton, objective=objective)
    sign, at = 1 if maximize else -1, visible.at_initial
    outer = float(at.upper if maximize else at.lower)
    best, policy, count = -np.inf, None, 0
    problem = satisfaction_problem(pomdp, automaton, maximize=maximize)
    try:
        for one in _candidates(problem):
            low, high = controller_satisfaction(pomdp, one, automaton)
            value, count = low if maximize else -high, count + 1
            if value > best:
                best, policy = value, one
            if sign * outer - best <= _DONE:
                break
    except KeyboardInterrupt:  # keeps the best controller so far
        if policy is None:
            raise
    assert policy is not None
    inner = sign * best
    lower, upper = (inner, max(outer, inner)) if maximize else (min(outer, inner), inner)
    policy = policy.replace(actions=pomdp.action_names, states=pomdp.observation_names)
    done = upper - lower <= tolerance
    parts: dict[str, Array] = {
        "value": np.float64(inner),
        "policy": policy,
        "lower": np.float64(lower),
        "upper": np.float64(upper),
        "residual": np.float64(upper - lower),
        "num_steps": np.int32(count),
        "status": np.int32(Status.CONVERGED if done else Status.MAX_STEPS),
        "initial": np.ones(()),
    }
    method = (
        f"{count} finite-state controllers; policies that see the states, or beliefs that have lost"
    )
    return Solution(**parts, method=method)


def _candidates(problem: BeliefProblem) -> Iterator[FiniteMemoryPolicy]:
    """Controllers by gradient ascent, each with its less likely actions and without them."""
    end = np.inf
    for seed, (num_memory, scale, rate) in enumerate(_STARTS):
        if seed and num_memory * problem.num_states > _LARGE:
            end = min(end, time.monotonic() + _SECONDS)
        if time.monotonic() >= end:
            break
        ascent = SoftmaxAscent.random(problem, num_memory, scale, seed)
        ascent.rate = rate
        values: list[float] = []
        for _ in range(_STEPS):
            values.append(ascent.step())
            still = len(values) > _PATIENCE and abs(values[-1] - values[-1 - _PATIENCE]) < _STILL
            late = time.monotonic() >= end
            if still or late or not np.isfinite(values[-1]):
                break
        policy = ascent.policies()[0]
        yield policy
        for cut in _CUTS:
            fewer = without_rare_actions(policy, cut)
            if (fewer.action != policy.action).any():
                policy = fewer
                yield policy
        yield ascent.policies()[-1]
