"""Reachability probabilities of every kind of model, with certified bounds."""

from __future__ import annotations

import jax

from jaxltl.core.models.protocols import Model
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, Question, Reach, Until
from jaxltl.core.values.door.table import solve
from jaxltl.core.values.engine.validated import validated


@validated(games=True, method=("auto", "direct", "iterative"))
def reachability_probability(
    model: Model,
    target: jax.Array | str,
    *,
    stay: jax.Array | str | None = None,
    policy: jax.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    environment: str | None = None,
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
    relative: bool = False,
    max_steps: jax.Array | int | None = None,
    start: tuple[jax.Array, jax.Array] | None = None,
    throw: bool = False,
) -> Solution:
    """Probability of reaching a set of target states, through the states of another one.

    The least solution of ``y = 1`` on the target and ``y = sum_a pi(s, a) (P y)(s, a)`` elsewhere
    (2.5); for optima with the maximum or minimum over available actions (Baier and Katoen 2008,
    section 10.6). Concrete models are solved on the host by policy iteration
    (:mod:`jaxltl.core.sparse.solvers.reachability`), traced and sharded ones by interval iteration
    (Haddad and Monmege 2018), and policies by a linear system. Under intervals nature picks the distribution
    of each step (Nilim and El Ghaoui 2005); in a game the environment has the opposite objective.

    Args:
      model: any model.
      target: ``bool[S]``, a label's name, or a Boolean formula of labels.
      stay: in the same forms, the states that a path may visit before the target (until); default
        all.
      policy: actions ``int32[S]`` or their weights ``float[S, A]``: evaluate this policy, of a game
        the system's. Default: optimise. Of sparse models also weights of rows ``float[R]``.
      objective: ``"max"`` or ``"min"``, of the system; of a given policy without a second player or
        intervals it says nothing.
      nature: of interval models: ``"adversarial"`` (default), against the objective, or
        ``"cooperative"``.
      environment: of games, in the same words.
      method: for a given policy: ``"direct"`` (elimination), ``"iterative"`` (Krylov) or
        ``"auto"``, direct on the host and for small traced models.
      tolerance: width of the enclosure. Default: twice the square root of the dtype's precision
        must be met, and an optimum is enclosed as closely as the dtype allows; for a sparse model,
        or with `stay`, 1e-6 (1e-3 in single precision).
      max_steps: maximal number of sweeps of interval iteration, which it selects; default 10^6.
      start: lower and upper bounds from which interval iteration starts, which it selects. They are
        not checked.
      relative: True for a width relative to the value, of sparse models only.
      throw: raise NotConverged unless the solution converged; outside ``jit``.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, exactly 0 or 1 where the graph decides. An
      optimum's `policy` is ``int32[S]`` and attains its bound on the safe side (`lower` for a
      maximum, `upper` for a minimum); on a concrete padded model it is the fastest such policy, see
      :func:`optimal_satisfaction`. Differentiable in the policy and in the probabilities, one-sided
      where one of them is 0 (see "Derivatives" in the documentation of solutions); inside ``jit`` not with
      `stay`, and not of sparse and interval models and games, which the host solves there too. Of interval models
      with `nature`; :func:`robust_sensitivity` has the derivatives in their ends.

    Raises:
      ValueError: a shape is wrong, the objective or method is unknown, a direction is stated where nobody
        has it, or an option is of another kind of model.

    Example:
      >>> import numpy as np
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0.5, 0.25, 0.25]], [[0, 1.0, 0]], [[0, 0, 1.0]]])
      >>> round(reachability_probability(mdp, np.array([False, True, False])).value[0].item(), 3)
      0.5
    """
    path = Reach(target) if stay is None else Until(target, stay)
    return solve(
        model,
        Question(path, objective, nature, environment, policy),
        Accuracy(tolerance, relative),
        throw=throw,
        method=None if method == "auto" else method,
        max_steps=max_steps,
        start=start,
    )
