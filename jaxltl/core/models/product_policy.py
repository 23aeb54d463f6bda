"""Finite-memory policies of a model and a formula, on the reachable product."""

from __future__ import annotations

from typing import NamedTuple

from jaxltl.core.array_types import Floats, Integers
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.deferred import deferred_field
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.product import SparseProduct


@brief
class ProductPolicy(NamedTuple):
    """A finite-memory policy of a model and a formula: rows on the reachable product.

    Attributes:
      automaton: of the formula, over the letters that occur.
      letter: ``int[S]``, the letter of each state.
      product: the reachable product of the model and the automaton, N states.
      row: ``int32[N]``, the policy's row of the model in each of them. Of a sparse model with up to
        10^5 states of the product it is the fastest optimal policy, computed when it is first read.
      value: ``float64[N]``, the probability in each of them.
      label_on: the label that a step of the policy reads, of the state entered or left.

    Example:
      >>> import jaxltl as jl
      >>> two_ways = jl.make_sparse([0, 2, 3, 4], [0, 1, 2, 3, 4], [1, 2, 1, 2], [1, 1, 1, 1],
      ...                        initial=[1, 0, 0], label={"a": [1]})
      >>> best = jl.optimal_satisfaction(two_ways, "F a")
      >>> on_product = best.product_policy
      >>> float(best.at_initial.value), on_product.row[on_product.product.start].tolist()
      (1.0, [0])
    """

    automaton: Automaton
    letter: Integers
    product: SparseProduct
    row: Integers
    value: Floats
    label_on: str = "entry"

    # Static in a Solution: equal to itself alone, without comparing arrays.
    def __eq__(self, other: object) -> bool:
        return self is other

    def __hash__(self) -> int:
        return id(self)


ProductPolicy.row = deferred_field(3, "Rows of the policy in each state.")  # type: ignore[assignment]
