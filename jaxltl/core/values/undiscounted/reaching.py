"""Reachability probabilities of concrete models without intervals and of one player."""

from __future__ import annotations

import numpy as np

from jaxltl.core.array_types import Booleans, Floats
from jaxltl.core.models.mdp import MDP, support
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import reachability as solver
from jaxltl.core.sparse.solvers.layered_reachability import PaddedProduct, layered_reachability
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, Question, Reach, Until
from jaxltl.core.values.engine.host_solution import (
    default_tolerance,
    padded_solution,
    policy_chain,
    solution_from_enclosure,
    with_given_policy,
)
from jaxltl.core.values.engine.row_form import row_form
from jaxltl.core.values.undiscounted.fastest import QUICK_LIMIT, fastest_optimum

_FINE_LIMIT = 4096  # states up to which bounds are as narrow as the dtype allows; it costs a round


def reach(
    model: Model, question: Question, accuracy: Accuracy, *, method: str = "auto"
) -> Solution:
    """The probabilities by the engine on rows, or by the layers of a large product."""
    if method == "iterative":
        raise ValueError(
            "method='iterative' is for policies on padded and dense models, without stay; leave it out."
        )
    path, policy, objective = question.path, question.policy, question.objective
    assert isinstance(path, Reach | Until)
    stay = path.stay if isinstance(path, Until) else None
    if policy is None and stay is None and not isinstance(path.target, str):
        solution = _by_layers(model, path.target, accuracy.tolerance, objective)
        if solution is not None:
            return solution
    form = row_form(model)
    target = form.states("target", path.target)
    if stay is not None:
        stay = form.states("stay", stay)
    # An optimum of a small model is as close as possible in any case, for its ties.
    exact = stay is None and form.is_padded and (accuracy.tolerance is None or policy is None)
    requested, fine = _tolerances(model, accuracy, exact=exact)
    host, depth = form.host, 0
    if policy is not None:
        host, _, depth = policy_chain(host, form.weights(policy))
    enclosure = enclose(host, target, objective, fine, stay=stay, depth=depth)
    if policy is None and stay is None and form.is_padded:
        enclosure = fastest_optimum(host, target, objective, enclosure)
    return with_given_policy(
        solution_from_enclosure(form, enclosure, requested, relative=accuracy.relative), policy
    )


def _tolerances(model: Model, accuracy: Accuracy, *, exact: bool) -> tuple[float, float]:
    """The width of the enclosure that counts as converged, and the width to aim for."""
    eps = float(np.finfo(np.dtype(model.dtype)).eps)
    requested = accuracy.width(default_tolerance(model))
    is_set = accuracy.tolerance is not None
    if exact and not is_set:
        requested = 2 * eps**0.5
    small = model.num_states <= _FINE_LIMIT
    if exact and (not is_set or small):
        return requested, min(requested, max(4 * eps, 1e-12 if small else 1e-11))
    return requested, requested


def avoidance_probability(
    model: SparseMDP,
    target: Booleans,
    *,
    stay: Booleans | None,
    objective: str,
    tolerance: float,
) -> Solution:
    """Complement of reachability in a sparse model, to a width relative to the value."""
    enclosure = solver.avoidance(
        model.host, target, maximize=objective == "max", stay=stay, tolerance=tolerance
    )
    return solution_from_enclosure(row_form(model), enclosure, float(tolerance), relative=True)


def enclose(
    mdp: HostMDP,
    target: Array,
    objective: str,
    tolerance: float,
    *,
    stay: Array | None = None,
    depth: int = 0,
) -> Enclosure:
    """The enclosure on sparse rows."""
    return solver.reachability(
        mdp,
        np.asarray(target, bool).ravel(),
        maximize=objective == "max",
        stay=None if stay is None else np.asarray(stay, bool).ravel(),
        tolerance=tolerance,
        depth=depth,
    )


# --- large products -------------------------------------------------------------------------------


def _by_layers(
    model: Model, target: Array, tolerance: Array | None, objective: str
) -> Solution | None:
    """A large product by the automaton's components; None where that does not help."""
    if not isinstance(model, Product):
        return None
    world = model.mdp
    if not isinstance(world, MDP) or model.label_on != "entry" or model.num_states <= QUICK_LIMIT:
        return None
    requested, fine = _tolerances(model, Accuracy(tolerance), exact=True)
    eps = float(np.finfo(np.dtype(model.dtype)).eps)
    width = fine if tolerance is None else requested - 4 * eps  # bounds are rounded outwards
    if not width > 0:
        return None
    used = support(world)
    layers = PaddedProduct(
        np.asarray(world.successor),
        used,
        _normalised(np.where(used, np.asarray(world.probability), 0)),
        np.asarray(world.available),
        np.asarray(model.automaton.delta),
        np.asarray(model.letter),
        None if model.allowed is None else np.asarray(model.allowed),
    )
    bounds = layered_reachability(
        layers, np.asarray(target), maximize=objective == "max", tolerance=width
    )
    if bounds is None:
        return None
    return padded_solution(model, bounds, bounds.row, requested)


def _normalised(weight: Floats) -> Floats:
    """Rows that sum to 1 in double precision."""
    weight = weight.astype(np.float64)
    total = weight.sum(-1, keepdims=True)
    result: Floats = np.divide(weight, total, out=weight, where=total > 0)
    return result
