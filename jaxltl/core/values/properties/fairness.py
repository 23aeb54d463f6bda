"""Probabilities over the fair strategies of MDPs, by the bottom components in which these end."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.automata.translate import FormulaLike
from jaxltl.core.logic.bounded import Bounded, Recognized, unfolded
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.property import MAX_UNFOLDED_STEPS, Property
from jaxltl.core.models.construct.property_models import END, LOST, model_of_product
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.graph.components import strong_components
from jaxltl.core.sparse.product import sparse_product
from jaxltl.core.values.properties.aims import CheckableModel, aim_of
from jaxltl.core.values.properties.exact_thresholds import acceptor
from jaxltl.core.values.undiscounted.sparse_satisfaction import automaton_and_letters


def over_fair_strategies(
    model: CheckableModel, prop: Property, states: Integers
) -> tuple[SparseMDP, Integers, Property]:
    """The property over all strategies of a product that has the value of one over fair strategies.

    Under strong fairness, where each choice of a state that is visited for ever is taken for ever, almost all runs
    end in a component of the graph that no choice leaves, and read all of its priorities for ever (Baier and
    Kwiatkowska 1998). So the maximum is that of reaching components that accept, and the minimum leaves out the
    maximum of reaching others.

    Raises:
      ValueError: no probability of a formula in an MDP, or bounds that are not on few steps.
    """
    path = prop.path
    is_path = isinstance(path, Formula | Bounded | Recognized) and prop.operator == "P"
    if not is_path or not isinstance(model, SparseMDP):
        raise ValueError(
            f"{prop.text}: fair=True is for probabilities of formulas in MDPs without intervals and players."
        )
    direction: Literal["max", "min"] = "max" if aim_of(model, prop).policy == "max" else "min"
    formula: FormulaLike
    if isinstance(path, Recognized):
        formula = acceptor(path)
    elif isinstance(path, Bounded):
        if path.reward is not None or max(path.lower, path.upper or 0) > MAX_UNFOLDED_STEPS:
            raise ValueError(
                f"{prop.text}: with fair=True a bound must be on at most {MAX_UNFOLDED_STEPS} steps."
            )
        formula = unfolded(path)
    else:
        assert isinstance(path, Formula)
        formula = path
    automaton, letter = automaton_and_letters(model, formula)
    memory = automaton.delta[automaton.initial, letter[states]]
    product = sparse_product(model.host, automaton.delta, letter, (states, memory))
    host = product.host
    source = host.state[host.row]
    component = strong_components(source, host.successor, host.num_states)
    priority = automaton.priority[product.memory[source], product.entry_letter(letter, True)]
    bottom = np.ones(component.max() + 1, bool)
    bottom[component[source[component[source] != component[host.successor]]]] = False
    least = np.full(bottom.size, priority.max(initial=1))
    np.minimum.at(least, component[source], priority)
    accepts = least % 2 == 0
    label = np.column_stack([(bottom & accepts)[component], (bottom & ~accepts)[component]])
    larger = model_of_product(model, product)
    larger = replace(
        larger,
        label=np.column_stack([np.asarray(larger.label), label]),
        propositions=(*larger.propositions, END, LOST),
    )
    end, lost = (Formula("ap", proposition=name) for name in (END, LOST))
    simple = Formula("F", (end,)) if direction == "max" else Formula("G", (~lost,))
    part = replace(prop, path=simple, objective=direction, definitions=())
    return larger, product.start, part
