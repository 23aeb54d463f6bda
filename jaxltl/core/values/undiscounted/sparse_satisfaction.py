"""Maximal or minimal satisfaction probability of an LTL task on a sparse MDP, with a policy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax
import numpy as np
from numpy.typing import ArrayLike

from jaxltl.core.automata.automaton import Automaton, letter_index, named_propositions
from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.automata.translate import FormulaLike, to_automaton
from jaxltl.core.deferred import Deferred
from jaxltl.core.logic.ltl import as_formula
from jaxltl.core.models.construct.state_formulas import state_letters
from jaxltl.core.models.action_numbers import row_actions
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.graph.accepting import AcceptingRegion, accepting_region
from jaxltl.core.models.product_policy import ProductPolicy
from jaxltl.core.sparse.product import (
    SparseProduct,
    product_without_memory,
    sparse_product,
)
from jaxltl.core.sparse.solvers.reachability import avoidance, reachability
from jaxltl.core.sparse.solvers.shortest_path_problem import RelativeTolerance, as_width
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, Question
from jaxltl.core.values.engine.state_quantities import reduction_for
from jaxltl.core.values.undiscounted.fastest import QUICK_LIMIT, certified_fastest_rows
from jaxltl.core.values.engine.host_solution import (
    complement_event,
    default_tolerance,
    policy_chain,
    solution_from_enclosure,
    with_given_policy,
)
from jaxltl.core.values.engine.row_form import row_form


def sparse_satisfaction(
    model: SparseMDP,
    formula: FormulaLike,
    *,
    objective: str = "max",
    states: ArrayLike | None = None,
    label_on: str = "entry",
    tolerance: jax.Array | float | None = None,
) -> Solution:
    """Optimal satisfaction probability on the reachable product, up to states with a verdict."""
    reduction_for(objective)
    if label_on not in ("entry", "exit"):
        raise ValueError(f'label_on={label_on!r}; it must be "entry" or "exit".')
    automaton, letter = automaton_and_letters(model, formula)
    start, initial = weights_of_starts(model, states)
    reader = _LetterReader(automaton, letter, label_on == "entry")
    product = _product(model, reader, start)
    solution, row = _best(product, reader, objective, tolerance)
    chosen: Array = product.base_row[row]
    if not product.host.is_chain and product.host.num_states <= QUICK_LIMIT:
        problem = _problem(product, reader, objective)
        chosen = Deferred(lambda: product.base_row[_fastest(product, problem, row)])
    actions: Array = row_actions(model)[product.base_row[row]].astype(np.int32)
    value = np.asarray(solution.value)
    return replace(
        at_states(solution, product.start),
        policy=actions,
        product_policy=ProductPolicy(automaton, letter, product, chosen, value, label_on),
        initial=initial,
    )


def weights_of_starts(model: Model, states: ArrayLike | None) -> tuple[np.ndarray, Array | None]:
    """The requested states ``int64[I]`` and, if they are the initial ones, their distribution."""
    start = starting_states(model, states)
    return start, None if states is not None else np.asarray(model.initial)[start]


def starting_states(model: Model, states: Array) -> np.ndarray:
    """The given states ``int64[I]``, else the initial states; ValueError if they are not states."""
    if states is None:
        return np.flatnonzero(np.asarray(model.initial) > 0)
    numbers = np.asarray(states)
    if not numbers.size or numbers.dtype.kind not in "iu":
        raise ValueError(
            f"states is {numbers.dtype}{list(numbers.shape)}; give the numbers of states, at least one."
        )
    wrong = (numbers < 0) | (numbers >= model.num_states)
    if wrong.any():
        raise ValueError(
            f"states has {numbers[wrong][0]}; the states are 0 to {model.num_states - 1}."
        )
    return numbers.astype(np.int64)


@dataclass(frozen=True)
class _LetterReader:
    """An automaton, the letter of each state ``int[S]``, and whether it is read on entry."""

    automaton: Automaton
    letter: np.ndarray
    on_entry: bool

    @cached_property
    def accepting(self) -> np.ndarray:
        """The states from which every word is accepted, ``bool[Q]``."""
        return universal_states(self.automaton)

    @cached_property
    def rejecting(self) -> np.ndarray:
        """The states from which no word is accepted, ``bool[Q]``."""
        return ~live_states(self.automaton)


def _best(
    product: SparseProduct,
    reader: _LetterReader,
    objective: str,
    tolerance: jax.Array | float | None,
    depth: int = 0,
) -> tuple[Solution, np.ndarray]:
    """The optimal probability from all states of a product, and the rows that attain it."""
    problem = _problem(product, reader, objective)
    whole = sparse_mdp_of_product(product)
    requested = default_tolerance(whole) if tolerance is None else as_width(tolerance)
    relative = isinstance(requested, RelativeTolerance)
    # One minus a probability near one has no relative accuracy.
    avoids = problem.complement and relative
    solve, maximize = (
        (avoidance, not problem.maximize) if avoids else (reachability, problem.maximize)
    )
    enclosure = solve(
        product.host, problem.goal, maximize=maximize, tolerance=requested, depth=depth
    )
    solution = solution_from_enclosure(row_form(whole), enclosure, requested, relative=relative)
    row = enclosure.row
    if problem.visiting is not None:
        row = np.where(problem.visiting.region, problem.visiting.row, row)
    return (complement_event(solution) if problem.complement and not relative else solution), row


def _fastest(product: SparseProduct, problem: ReachabilityProblem, row: np.ndarray) -> np.ndarray:
    """Rows of the fastest optimal policy, and of the accepting one in accepting components."""
    objective = "max" if problem.maximize else "min"
    fastest = certified_fastest_rows(product.host, problem.goal, None, objective, row)
    return fastest if problem.visiting is None else np.where(problem.visiting.region, row, fastest)


class ReachabilityProblem(NamedTuple):
    """Satisfaction as the probability of reaching states of a product, or of its complement."""

    goal: np.ndarray  # bool[N]
    maximize: bool
    complement: bool
    visiting: AcceptingRegion | None  # of a formula that is not decided by a prefix


def reachability_problem(policy: ProductPolicy, objective: str) -> ReachabilityProblem:
    """The reachability problem that a satisfaction probability was solved by."""
    reader = _LetterReader(policy.automaton, policy.letter, policy.label_on == "entry")
    return _problem(policy.product, reader, objective)


def _problem(product: SparseProduct, reader: _LetterReader, objective: str) -> ReachabilityProblem:
    automaton = reader.automaton
    opposite = automaton.is_safety or (not automaton.has_final_states and objective == "min")
    goal: np.ndarray = (reader.rejecting if opposite else reader.accepting)[product.memory]
    if automaton.has_final_states:
        return ReachabilityProblem(goal, (objective == "max") != opposite, opposite, None)
    entry_letter = product.entry_letter(reader.letter, reader.on_entry)
    source = product.host.state[product.host.row]
    priority = automaton.priority[product.memory[source], entry_letter] + opposite
    # Absorbing states have their verdict, and no other end component.
    priority[product.still[source]] = 1
    visiting = accepting_region(product.host, priority)
    return ReachabilityProblem(goal | visiting.region, True, opposite, visiting)


def accept_rows(model: Model, question: Question, accuracy: Accuracy) -> Solution:
    """Optimal probability of acceptance on every state of a lazy product of a sparse model."""
    assert isinstance(model, Product)
    if model.allowed is not None:
        raise ValueError(
            "a product of a sparse model takes no mask of actions; restrict the world "
            "by with_allowed(world, rows), or write the product out by to_sparse."
        )
    world: SparseMDP = model.mdp
    task, policy, objective = model.automaton, question.policy, question.objective
    automaton = replace(task, delta=np.asarray(task.delta), priority=np.asarray(task.priority))
    letter, shape = np.asarray(model.letter), model.state_shape
    on_entry = model.label_on == "entry"
    state, memory = (x.ravel() for x in np.indices(shape))
    product = sparse_product(
        world.host, automaton.delta, letter, (state, memory), on_entry=on_entry
    )
    depth = 0
    if policy is not None:
        chain = policy_chain(product.host, row_form(model).weights(policy))
        product, depth, objective = product._replace(host=chain.mdp), chain.depth, "max"
    reader = _LetterReader(automaton, letter, on_entry)
    width = accuracy.width(default_tolerance(model))
    solution, row = _best(product, reader, objective, width, depth)
    parts: dict[str, Array] = {
        name: np.asarray(getattr(solution, name)).reshape(shape)
        for name in ("value", "lower", "upper")
    }
    if policy is None:
        parts["policy"] = row_actions(world)[product.base_row[row]].astype(np.int32).reshape(shape)
    return with_given_policy(replace(solution, **parts), policy)


def _product(model: SparseMDP, reader: _LetterReader, states: np.ndarray) -> SparseProduct:
    automaton, letter, on_entry = reader.automaton, reader.letter, reader.on_entry
    still = reader.accepting | reader.rejecting
    if still.size == 1 and not still.any():
        return product_without_memory(model.host, states)
    initial = np.broadcast_to(automaton.initial, states.shape)
    memory = automaton.delta[initial, letter[states]] if on_entry else initial
    return sparse_product(
        model.host, automaton.delta, letter, (states, memory), on_entry=on_entry, still=still
    )


def automaton_and_letters(model: SparseMDP, formula: FormulaLike) -> tuple[Automaton, np.ndarray]:
    """The automaton of a formula over the letters of a model, and the letter of each state."""
    if not isinstance(formula, Automaton):
        formula = as_formula(formula)
        letters, number = state_letters(model, formula.propositions)
        formula = to_automaton(formula, letters=letters)
    else:
        letters, number = state_letters(model, named_propositions(formula))
    index = np.array([letter_index(formula, letter) for letter in letters], np.int64)
    automaton = replace(
        formula,
        delta=np.asarray(formula.delta),
        priority=np.asarray(formula.priority),
        letters=np.asarray(formula.letters),
    )
    return automaton, index[number]


def sparse_mdp_of_product(product: SparseProduct) -> SparseMDP:
    """A product as a model without labels, with its starts as initial states."""
    host = product.host
    initial = np.zeros(host.num_states)
    initial[product.start] = 1
    return SparseMDP(
        host.row_start,
        host.entry_start,
        host.successor,
        host.probability,
        initial / initial.sum(),
        np.zeros((host.num_states, 0), bool),
    )


def at_states(solution: Solution, states: np.ndarray) -> Solution:
    """A solution's value and bounds at some states."""
    taken: dict[str, Array] = {
        name: np.asarray(getattr(solution, name), np.float64)[states]
        for name in ("value", "lower", "upper")
    }
    return replace(solution, **taken)
