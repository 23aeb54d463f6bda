"""Claims of certificates for formulas of linear temporal logic, of chains, MDPs, games and intervals."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import cast

import numpy as np

from jaxltl import checker
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.models.game import Game
from jaxltl.core.models.product import product
from jaxltl.core.models.protocols import Array, LabelledModel
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.row_form import row_form, row_of_action
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.io.certificate.belief_claims import Improvement
from jaxltl.io.certificate.inductive_bounds import (
    Certified,
    Integers,
    Values,
    candidates,
    proven,
    store,
)

_OTHER = {"adversarial": "cooperative", "cooperative": "adversarial"}


def formula_claims(
    problem: Certified,
    file: checker.CertificateFile,
    automaton: Automaton,
    improve: Improvement | None = None,
) -> list[dict[str, object]]:
    """A lower and an upper claim of the probability of a formula, with values ``[S, Q]``.

    Those players whose objective is that of the claim have a policy on the product, and the values
    are bounds for all policies of the others.
    """
    num_states, memory = problem.shape[0], int(np.prod(problem.shape[1:]))
    size, states = len(automaton.delta), problem.host.num_states
    joint = cast(Game, product(cast(LabelledModel, problem.model), automaton, label_on="exit"))
    form = row_form(joint)
    state, q = (x.ravel() for x in np.indices((states, size)))
    world, m = np.divmod(problem.node[state], memory)
    whole = replace(
        problem,
        sparse=form.sparse,
        uncertain=None if form.interval is None else form.interval.host,
        system=np.ones(state.size, bool) if form.system is None else form.system,
        target=np.zeros(state.size, bool),
        stay=np.ones(state.size, bool),
        gain=np.zeros(form.host.num_transitions),
        node=(world * size + q) * memory + m,
        shape=(num_states, size, *problem.shape[1:]),
    )
    best = optimal_satisfaction(joint, objective=problem.objective, nature=problem.nature)
    claims = []
    for side in problem.sides:
        ours = "max" if side == "lower" else "min"
        name, answer = "", best
        if ours in (problem.objective, problem.directions[0]) and not form.host.is_chain:
            if ours != problem.objective:
                # The environment is the system of the game with swapped players.
                nature = _OTHER.get(problem.nature or "")
                swapped = replace(joint, system=cast(Array, ~np.asarray(joint.system)))
                answer = optimal_satisfaction(swapped, objective=ours, nature=nature)
            policy = np.zeros(int(np.prod(whole.shape)), np.int64)
            policy[whole.node] = _rows(whole, answer) - form.host.row_start[:-1]
            name = f"{side}_policy"
            store(file, name, policy, whole.shape)
        claim = proven(whole, file, side, _bounds(whole, side, answer), policy=name)
        claims.append(claim if improve is None else improve(whole, file, claim))
    return claims


def _rows(problem: Certified, solution: Solution) -> Integers:
    rows: Integers = row_of_action(problem.sparse, np.asarray(solution.policy)).astype(np.int64)
    return rows


def _bounds(problem: Certified, side: str, solution: Solution) -> Iterator[Values]:
    """Candidates for bounds: lower ones are upper ones of the complement."""
    bound = np.asarray(getattr(solution, side), np.float64).ravel()
    value, rows = np.asarray(solution.value, np.float64).ravel(), _rows(problem, solution)
    if side == "lower":
        problem, bound, value = problem.complement(), 1 - bound, 1 - value
    problem = replace(problem, target=bound >= 1)
    for upper in candidates(problem, "upper", bound, value, rows):
        yield [1 - Fraction(x) for x in upper] if side == "lower" else upper
