"""Reachability probabilities, with certified bounds."""

from __future__ import annotations

from typing import Unpack, cast

import jax
import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.graphs.graph import is_table
from jaxltl.core import validation
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mdp import MDP, support
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.construct.convert import keep_with_model
from jaxltl.core.models.ops.operators import require_policy
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel, Array, Model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.solvers import reachability as solver
from jaxltl.core.sparse.solvers.layered_reachability import PaddedProduct, layered_reachability
from jaxltl.core.sparse.solvers.shortest_path_problem import Enclosure, RelativeTolerance, as_width
from jaxltl.core.types import Solution, require_states
from jaxltl.core.values.engine.host_solution import (
    induced_chain,
    default_tolerance,
    with_given_policy,
    is_sparse,
    solution_from_enclosure,
)
from jaxltl.core.values.engine.validated import SolverOptions, validated
from jaxltl.core.values.interval.robust import refuse_nature, robust_reachability
from jaxltl.core.values.undiscounted import optimum
from jaxltl.core.values.undiscounted.fastest import QUICK_LIMIT as QUICK_LIMIT
from jaxltl.core.values.undiscounted.fastest import fastest_optimum

_FINE_LIMIT = 4096  # states up to which bounds are as narrow as the dtype allows; it costs a round


@validated(method=("auto", "direct", "iterative"))
def reachability_probability(
    model: Model,
    target: jax.Array,
    *,
    stay: jax.Array | None = None,
    policy: jax.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
    **options: Unpack[SolverOptions],
) -> Solution:
    """Probability of reaching a set of target states.

    The least solution of ``y = 1`` on the target and ``y = sum_a pi(s, a) (P y)(s, a)`` elsewhere
    (2.5); for optima with the maximum or minimum over available actions (Baier and Katoen 2008,
    section 10.6). Concrete models are solved on the host by policy iteration
    (:mod:`jaxltl.core.sparse.solvers.reachability`), traced and sharded ones by interval iteration
    (Haddad and Monmege 2018), and policies by a linear system.

    Args:
      model: any model.
      target: ``bool[S]``.
      stay: ``bool[S]``, the states that a path may visit before the target (until); default all.
        Concrete models only.
      policy: ``float[S, A]`` or ``int32[S]``: evaluate this policy. Default: optimise. For a sparse
        model ``float[R]``, or rows ``int32[S]``.
      objective: ``"max"`` or ``"min"``; ignored when a policy is given.
      nature: for interval models only, see :func:`robust_reachability`.
      method: for a given policy: ``"direct"`` (elimination), ``"iterative"`` (Krylov) or
        ``"auto"``, direct on the host and for small traced models.
      tolerance: width of the enclosure. Default: twice the square root of the dtype's precision
        must be met, and an optimum is enclosed as closely as the dtype allows; for a sparse model,
        or with `stay`, 1e-6 (1e-3 in single precision).
      max_steps: maximal number of sweeps of interval iteration, which it selects; default 10^6.
      start: lower and upper bounds from which interval iteration starts, which it selects. They are
        not checked.
      relative: True for a width relative to the value, of sparse models only.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, exactly 0 or 1 where the graph decides. An
      optimum's `policy` is ``int32[S]`` and attains its bound on the safe side (`lower` for a
      maximum, `upper` for a minimum); on a concrete padded model it is the fastest such policy, see
      :func:`optimal_satisfaction`. Differentiable in the policy and in the probabilities, one-sided
      where one of them is 0 (see "Derivatives" in the documentation of solutions).

    Raises:
      ValueError: a shape is wrong, the objective or method is unknown, or `stay` or a sparse model
        is traced.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0.5, 0.25, 0.25]], [[0, 1.0, 0]], [[0, 0, 1.0]]])
      >>> round(reachability_probability(mdp, np.array([False, True, False])).value[0].item(), 3)
      0.5
    """
    max_steps, start, relative = validation.options(
        "reachability_probability", options, max_steps=None, start=None, relative=False
    )
    if isinstance(model, IntervalMDP) or is_sparse(model) or stay is not None:
        refuse_iteration(max_steps, start)
    if relative:
        tolerance = relative_width(model, tolerance)
    if isinstance(model, IntervalMDP):
        return robust_reachability(
            model,
            target,
            policy=policy,
            objective=objective,
            nature=nature,
            stay=stay,
            tolerance=tolerance,
        )
    refuse_nature(nature)
    require_states("target", target, model.state_shape)
    if stay is not None:
        require_states("stay", stay, model.state_shape)
    if policy is not None and not is_sparse(model):
        require_policy(model, policy)
    traced = is_sharded(model) or is_traced((model, target, stay, policy, tolerance))
    if is_sparse(model) or stay is not None:
        if traced:
            raise ValueError(
                "reachability of a sparse model, or with stay, needs concrete arrays; inside jit "
                "use prepare(model, target), or the product with the formula's automaton."
            )
        return _on_host(model, target, stay, policy, objective, tolerance)
    iterative = method == "iterative" and policy is not None
    if traced or not is_table(model) or iterative or max_steps is not None or start is not None:
        padded = cast(ActionModel, model)
        if policy is not None:
            limit = 1_000_000 if max_steps is None else max_steps
            return optimum.policy_reachability(
                padded, policy, target, tolerance, limit, method=method
            )
        return optimum.optimal_reachability(
            padded, target, tolerance, max_steps, start, objective=objective
        )
    solution = None
    if policy is None:
        solution = _by_layers(model, target, tolerance, objective)
    return (
        _on_host(model, target, None, policy, objective, tolerance)
        if solution is None
        else solution
    )


def refuse_iteration(max_steps: object, start: object) -> None:
    """Raises ValueError if an option of interval iteration is given to a solver of sparse rows."""
    if max_steps is not None or start is not None:
        raise ValueError(
            "max_steps and start are options of interval iteration on padded and dense models; "
            "sparse and interval models, and stay, are solved without them. Leave them out."
        )


def relative_width(model: Model | IntervalMDP, tolerance: Array | None) -> RelativeTolerance:
    """A tolerance relative to the value; ValueError unless the model is sparse, without intervals."""
    if isinstance(model, IntervalMDP) or not is_sparse(model):
        raise ValueError(
            f"relative=True is for a SparseMDP, not for a {type(model).__name__} (see to_sparse)."
        )
    return RelativeTolerance(default_tolerance(model) if tolerance is None else tolerance)


def _on_host(
    model: Model,
    target: Array,
    stay: Array | None,
    policy: Array | None,
    objective: str,
    tolerance: Array | None,
) -> Solution:
    """The probabilities by the sparse engine."""
    sparse = rows_of_model(model)
    # An optimum of a small model is as close as possible in any case, for its ties.
    exact = stay is None and not is_sparse(model) and (tolerance is None or policy is None)
    requested, fine = _tolerances(model, tolerance, exact=exact)
    host, depth = sparse.host, 0
    if policy is not None:
        host, _, depth = induced_chain(model, sparse, policy)
    enclosure = enclose(host, target, objective, fine, stay=stay, depth=depth)
    if policy is None and stay is None and not is_sparse(model):
        enclosure = fastest_optimum(host, np.asarray(target, bool).ravel(), objective, enclosure)
    return with_given_policy(
        solution_from_enclosure(
            model,
            sparse,
            enclosure,
            float(requested),
            relative=isinstance(requested, RelativeTolerance),
        ),
        policy,
    )


def _tolerances(model: Model, tolerance: Array | None, *, exact: bool) -> tuple[float, float]:
    """The width of the enclosure that counts as converged, and the width to aim for."""
    eps = float(np.finfo(np.dtype(model.dtype)).eps)
    requested = default_tolerance(model) if tolerance is None else as_width(tolerance)
    if exact and tolerance is None:
        requested = 2 * eps**0.5
    small = model.num_states <= _FINE_LIMIT
    if exact and (tolerance is None or small):
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
    """Complement of :func:`reachability_probability`, to a width relative to the value."""
    enclosure = solver.avoidance(
        model.host, target, maximize=objective == "max", stay=stay, tolerance=tolerance
    )
    return solution_from_enclosure(model, model, enclosure, float(tolerance), relative=True)


def rows_of_model(model: Model) -> SparseMDP:
    """The sparse rows of a concrete model or game; a float32 model means its normalised rows."""
    return _rows(model.mdp if isinstance(model, Game) else model)


_rows = keep_with_model(to_sparse)


def on_rows(sparse: SparseMDP, quantity: Array) -> Array:
    """A quantity on actions ``[S, A]`` as one on rows ``[R]``."""
    flat = np.asarray(quantity).reshape(sparse.num_states, -1)
    return flat[sparse.host.state, np.asarray(sparse.action)]


def on_actions(sparse: SparseMDP, quantity: Array, model: ActionModel) -> Array:
    """A quantity on rows ``[R]`` as one on actions ``[S, A]``, 0 at unavailable ones."""
    table = np.zeros((sparse.num_states, model.num_actions), quantity.dtype)
    table[sparse.host.state, np.asarray(sparse.action)] = quantity
    return table.reshape(*model.state_shape, -1)


def row_of_action(sparse: SparseMDP, action: Array) -> Integers:
    """The rows ``int[S]`` of a policy of actions ``int[S]``."""
    chosen = np.asarray(action).ravel()[sparse.host.state] == np.asarray(sparse.action)
    return sparse.host.first_choice(chosen)[1]


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
    requested, fine = _tolerances(model, tolerance, exact=True)
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
    return solution_from_enclosure(model, None, bounds, requested, relative=False)


def _normalised(weight: Floats) -> Floats:
    """Rows that sum to 1 in double precision."""
    weight = weight.astype(np.float64)
    total = weight.sum(-1, keepdims=True)
    result: Floats = np.divide(weight, total, out=weight, where=total > 0)
    return result
