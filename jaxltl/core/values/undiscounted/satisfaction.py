"""Satisfaction probabilities of LTL formulas in MDPs, games and interval models."""

from __future__ import annotations

import jax
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.pomdp import POMDP
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.refusals import refuse_traced
from jaxltl.core.types import Solution, check
from jaxltl.core.values.door.kinds import kind_of
from jaxltl.core.values.door.question import Acceptance, Accuracy, Question
from jaxltl.core.values.door.table import solve
from jaxltl.core.values.engine.host_solution import default_tolerance
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.interval.satisfaction import robust_satisfaction
from jaxltl.core.values.interval.sides import refuse_environment, refuse_nature
from jaxltl.core.values.partial_observability.solve import partially_observable_satisfaction
from jaxltl.core.values.undiscounted.acceptance import require_product
from jaxltl.core.values.undiscounted.sparse_satisfaction import sparse_satisfaction


@validated(games=True, method=("auto", "direct", "iterative"))
def satisfaction_probability(
    model: Product | Game,
    policy: Array,
    *,
    nature: str | None = None,
    environment: str | None = None,
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
    throw: bool = False,
) -> Solution:
    """Satisfaction probability of a policy, from every product state.

    For a co-safe task, the probability of reaching a final state (2.5); for a safety task, of never
    leaving the final states; for Buchi and parity, of reaching a bottom strongly connected
    component with an even least priority.

    Args:
      model: a product of any model, or a game on one.
      policy: actions ``int32[S, Q]`` or their weights ``float[S, Q, A]``, of a game the system's;
        for a sparse world also weights ``float[R, Q]`` of its rows.
      nature: for products of interval models only, ``"adversarial"`` (default), against the policy,
        or ``"cooperative"``.
      environment: of games, in the same words.
      method, tolerance, throw: as in :func:`reachability_probability`.

    Returns:
      :class:`Solution`; `value` is ``float[S, Q]``. The probability from the initial distribution
      is ``jnp.sum(model.initial * solution.value)``. Differentiable in the policy and in the
      world's transition probabilities, one-sided where one is 0; not for products of sparse and
      of interval models, which are solved on the host.

    Raises:
      ValueError: the model is not a product, the policy has the wrong shape or a row that is not a
        distribution over available actions (INVALID_POLICY under ``jit``), `nature` is given for a
        model without intervals, or the method is unknown.

    Example:
      >>> import numpy as np
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 1.0, 0], [0, 0.5, 0.5]], [[0, 1.0, 0]] * 2, [[0, 0, 1.0]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["goal"], initial=[1, 0, 0])
      >>> model = product(world, "F goal")
      >>> found = satisfaction_probability(model, np.full((3, 2, 2), 0.5))
      >>> round(float(np.sum(model.initial * found.value)), 6)
      0.75
    """
    question = Question(Acceptance(), "max", nature, environment, policy)
    named = None if method == "auto" else method
    return solve(require_product(model), question, Accuracy(tolerance), throw=throw, method=named)


@validated(games=True)
def optimal_satisfaction(
    model: Product | Model | IntervalMDP | Game | POMDP,
    formula: FormulaLike | None = None,
    *,
    objective: str = "max",
    nature: str | None = None,
    states: ArrayLike | None = None,
    label_on: str | None = None,
    environment: str | None = None,
    tolerance: jax.Array | float | None = None,
    relative: bool = False,
    max_steps: jax.Array | int | None = None,
    start: tuple[jax.Array, jax.Array] | None = None,
    throw: bool = False,
) -> Solution:
    """Maximal or minimal satisfaction probability of a product, or of a model and a formula.

    For Buchi and parity tasks, the probability of reaching an accepting end component, in which the
    policy is accepted almost surely (Baier and Katoen 2008, section 10.6.4); for other tasks as in
    :func:`satisfaction_probability`.

    Of all optimal policies of a concrete padded model with up to 10^5 states, the result is the
    **fastest**: it has the least expected number of steps, from every state, until the set or an
    accepting end component is reached (a set to be avoided: almost surely) or cannot be reached;
    inside the component, until its least priority is read next. This is a stochastic shortest path
    (Bertsekas and Tsitsiklis 1991) over the conserving actions; ties go to the first action.

    A model with a `formula` is solved on the host, on the reachable part of its product; an interval
    model with adversarial nature is a stochastic parity game.

    Args:
      model: a product; or with `formula` a concrete model, an interval model or a game on one of them, or
        a POMDP, with bounds from its initial belief: of co-safe and safe formulas those of all controllers,
        of others the value of a learned controller and the optimum of policies that see the states.
      formula: a formula, its text, or an automaton over the letters that occur in the model.
      objective: ``"max"`` or ``"min"``.
      nature: for interval models, ``"adversarial"`` (default) or ``"cooperative"``.
      states: with `formula`, ``int[I]``, the requested states; default the initial ones.
      label_on: with `formula`, ``"entry"`` (default) or ``"exit"``, when the policy's memory reads a
        state's label; the probability is the same. Interval models read on exit.
      environment: for games, ``"adversarial"`` (default) or ``"cooperative"``.
      tolerance, relative, throw: as for :func:`reachability_probability`.
      max_steps, start: as there; of a product.

    Returns:
      :class:`Solution`. Of a product, `value` is ``float[S, Q]`` and `policy` actions ``int32[S, Q]``.
      With a formula, `value`, `lower` and `upper` are ``float64[I]``, one for each requested state;
      `policy` is ``int32[N]``, the action in each of the N states of the reachable product, which
      `product_policy` holds (see :func:`~jaxltl.project_policy`, which runs and saves it).
      Differentiable in a product's transition probabilities, with the optimal
      policy held fixed; not for sparse and interval models, which are solved on the host.

    Raises:
      ValueError: neither a product nor a formula, an unknown label, state or objective, an option that
        is not for this model, or a product of a sparse world with restricted actions.

    Example:
      >>> import numpy as np
      >>> from jaxltl import from_dense, product
      >>> world = from_dense([[[0, 0.5, 0.5], [0, 0.75, 0.25]], [[0, 1, 0]] * 2, [[0, 0, 1]] * 2],
      ...                    label=[[0], [1], [0]], propositions=["goal"], initial=[1, 0, 0])
      >>> best = optimal_satisfaction(product(world, "F goal"))
      >>> best.value[0, 0].item(), best.policy[0, 0].item()
      (0.75, 1)
    """
    if isinstance(model, POMDP):
        if formula is None:
            raise ValueError(
                "optimal_satisfaction: formula is None; give the formula for the POMDP."
            )
        refuse_nature(nature)
        refuse_environment(environment)
        if states is not None or relative or label_on is not None:
            raise ValueError(
                "states, label_on and relative are not for a POMDP, which is solved from its initial belief."
            )
        answer = partially_observable_satisfaction(
            model, formula, objective=objective, tolerance=tolerance
        )
        return check(answer) if throw else answer
    if formula is None:
        if states is not None or label_on is not None:
            raise ValueError(
                "states and label_on are for a model and a formula, not for a product."
            )
        return solve(
            require_product(model),
            Question(Acceptance(), objective, nature, environment),
            Accuracy(tolerance, relative),
            throw=throw,
            max_steps=max_steps,
            start=start,
        )
    refuse_traced("optimal_satisfaction", [("model", model), ("tolerance", tolerance)])
    if max_steps is not None or start is not None:
        raise ValueError(
            "max_steps and start are options for a product; a model with a formula is solved without "
            "them. Leave them out, or give product(model, formula)."
        )
    kind = kind_of(model)
    if kind.container != "intervals":
        refuse_nature(nature)
    if not kind.is_game:
        refuse_environment(environment)
    if relative:
        if kind.column != "rows":
            raise ValueError(f"relative=True is for a SparseMDP, not for {kind} (see to_sparse).")
        tolerance = Accuracy(tolerance, True).width(default_tolerance(model))
    if kind.is_game or kind.container == "intervals":
        if label_on is not None:  # interval models read labels on exit
            validation.choice("label_on", label_on, ("exit",))
        answer = robust_satisfaction(
            model,
            formula,
            objective=objective,
            nature=nature,
            environment=environment,
            states=states,
            tolerance=tolerance,
        )
    else:
        answer = sparse_satisfaction(
            to_sparse(model),
            formula,
            objective=objective,
            states=states,
            label_on="entry" if label_on is None else label_on,
            tolerance=tolerance,
        )
    return check(answer) if throw else answer
