"""Optimal strategies of properties as JSON: choices by state, memory, and nature's distributions.

Example:
  >>> import jaxltl as jl
  >>> from jaxltl.io.strategies import strategy_entry
  >>> world = jl.make_mdp([[[1], [0]], [[1], [1]]], [[[1.0], [1.0]]] * 2, label=[[0], [1]],
  ...                     propositions=["goal"], initial=[1, 0])
  >>> model = jl.to_sparse(world)
  >>> answer = jl.solve_property(model, 'Pmax=? [ F "goal" ]')
  >>> strategy_entry(model, answer.strategy)["kind"]
  'memoryless'
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from jaxltl.core.array_types import PyTree
from jaxltl.core.models import SparseMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.values import PropertyStrategy
from jaxltl.core.values.properties.aims import SourceModel, graph_of_model


def strategy_entry(solved: SourceModel, strategy: PropertyStrategy) -> dict[str, PyTree]:
    """The JSON object of an optimal strategy of `solve_property`, as ``jaxltl solve --strategy`` writes it.

    Args:
      solved: the model.
      strategy: of the answer.
    """
    model = graph_of_model(solved)
    host = model.host
    row = np.asarray(strategy.row)
    choice = (row - host.row_start[host.state[row]]).tolist()
    names = _names(model)
    entry: dict[str, PyTree] = {"kind": "memoryless", "choice": choice}
    if strategy.by:
        entry["kind"] = f"first choice, then by the {strategy.by} left"
    if names is not None:
        entry["action"] = names(row)
    memory = strategy.memory
    if memory is None:
        if strategy.nature is not None:
            entry["nature"] = _nature(host, host.successor, strategy.nature)
        return entry
    product, start = memory.product, memory.product.start
    if strategy.nature is not None:
        entry["letter_of"] = "the state that is left"
        entry["nature"] = _nature(
            product.host, product.base_state[product.host.successor], strategy.nature, product.still
        )
    return {
        "kind": "memory",
        "initial": np.stack([product.base_state[start], product.memory[start]], 1).tolist(),
        "letters": [
            sorted(
                p for p, holds in zip(memory.automaton.propositions, letter, strict=True) if holds
            )
            for letter in memory.automaton.letters
        ],
        "letter": memory.letter.tolist(),
        "update": memory.automaton.delta.tolist(),
        "state": product.base_state.tolist(),
        "memory": product.memory.tolist(),
        **{k: v for k, v in entry.items() if k != "kind"},
    }


def _nature(
    host: HostMDP, successor: np.ndarray, probability: np.ndarray, still: np.ndarray | None = None
) -> list[list[dict[str, float]]]:
    """Nature's distribution of each choice by numbers of successors; empty in states of `still`."""
    names, mass = list(map(str, successor.tolist())), probability.tolist()
    starts = host.entry_start.tolist()
    rows = [{names[t]: mass[t] for t in range(a, b) if mass[t]} for a, b in pairwise(starts)]
    choices = [rows[a:b] for a, b in pairwise(host.row_start.tolist())]
    return (
        choices
        if still is None
        else [[] if stands else x for x, stands in zip(choices, still.tolist(), strict=True)]
    )


def _names(model: SparseMDP) -> Callable[[np.ndarray], list[str]] | None:
    if model.action is None or not model.action_names:
        return None
    action, names = np.asarray(model.action), np.array(model.action_names, dtype=object)
    return lambda row: names[action[row]].tolist()
