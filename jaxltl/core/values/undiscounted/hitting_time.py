"""How long a policy takes to get somewhere."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.graphs.graph import host_graph
from jaxltl.core.graphs.reaching import policy_sets
from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.sparse.solvers.dense_reachability import policy_row, steps_until
from jaxltl.core.values.undiscounted.reachability import action_matrices


def hitting_time(model: Any, policy: Any, target: Any) -> NDArray[np.float64]:
    """Expected number of steps of a policy until a set is entered, on the host.

    ``h = 1 + P_pi h`` where the set is reached almost surely, which the graph decides; infinite
    elsewhere, zero in the set. Solved directly, in double precision.

    Args:
      model: a concrete model.
      policy: ``float[S, A]`` or ``int32[S]`` (``[S, Q, ...]``).
      target: ``bool[S]`` (``[S, Q]``).

    Returns:
      ``float64[S]``; NaN where the equation could not be solved to six digits, since the policy
      takes longer than double precision can tell.

    Raises:
      ValueError: something is traced.

    Concrete arrays only, on the host; not differentiable.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0.5, 0.5]], [[0.0, 1.0]]])
      >>> hitting_time(mdp, np.array([0, 0]), np.array([False, True])).tolist()
      [2.0, 0.0]
    """
    if is_traced((model, policy, target)):
        raise ValueError("hitting_time works on the host; call it outside jit and vmap.")
    policy, target = np.asarray(policy), np.asarray(target)
    if is_deterministic(policy):
        policy = (policy[..., None] == np.arange(model.num_actions)).astype(float)
    graph = host_graph(model)
    sure = np.asarray(policy_sets(graph, target, policy).one)
    weight = policy.reshape(-1, model.num_actions).astype(float)
    open_ = (sure & ~target).ravel()
    found = steps_until(policy_row(action_matrices(model), weight), open_)
    time = np.where(sure.ravel(), 0.0, np.inf)
    time[open_] = np.nan if found is None else found[open_]
    return time.reshape(target.shape)
