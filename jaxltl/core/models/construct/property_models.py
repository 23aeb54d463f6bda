"""Models on which properties become simpler ones: products with prefixes, and graphs."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import cast

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.logic.good_prefixes import prefix_automaton, state_formulas
from jaxltl.core.logic.labels import distinct_rows
from jaxltl.core.logic.ltl import Formula, negation_normal_form
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.exact_numbers import exact_numbers, exact_reward
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.number_source import NumberSource, Part, RationalNumbers
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.sparse import Rewards, SparseMDP, choice_reward
from jaxltl.core.sparse.exact.model import ONE, ZERO, ExactMDP
from jaxltl.core.sparse.product import SparseProduct, sparse_product
from jaxltl.core.sparse.rows import row_entries

LOST = "[lost]"  # the label of states from which the formula cannot be proven
END = "[end]"  # the label of states after a prefix that proves the formula


def prefix_product(
    model: SparseMDP | IntervalMDP | Game, formula: Formula, states: Integers, place: str
) -> tuple[SparseMDP | IntervalMDP | Game, Integers]:
    """Product with the automaton of a co-safe formula, of the kind of the model, and the states in it.

    The label :data:`END` holds where the formula is proven by the prefix up to the state.
    """
    inner = model.mdp if isinstance(model, Game) else model
    world = inner.nominal if isinstance(inner, IntervalMDP) else inner
    normal = negation_normal_form(formula)
    propositions = state_formulas(normal)
    columns = [states_satisfying(world, f, place) for f in propositions]
    letters, letter = distinct_rows(np.column_stack(columns))
    delta = prefix_automaton(normal, letters).delta
    start = states, delta[0, letter[states]]
    product = sparse_product(world.host, delta, letter, start)

    def change(base: SparseMDP) -> SparseMDP:
        return _unrolled(base, product)

    larger = inner.changed(change) if isinstance(inner, IntervalMDP) else change(inner)
    if not isinstance(model, Game):
        return larger, product.start
    system = np.asarray(model.system)[product.base_state]
    return Game(larger, to_jax(system)), product.start


def step_product(
    model: SparseMDP, num_steps: int, rewards: dict[str, tuple[str, int]]
) -> SparseMDP:
    """Product with a counter of steps up to a number, from the initial states.

    `rewards` has new structures by name: the name of one of the model, and the number of steps in which it is earned.
    """
    first = np.flatnonzero(np.asarray(model.initial) > 0)
    delta = np.minimum(np.arange(1, num_steps + 2), num_steps)[:, None]
    letter, start = np.zeros(model.num_states, np.int64), (first, np.zeros_like(first))
    product = sparse_product(model.host, delta, letter, start)
    larger = _unrolled(model, product)
    initial = np.zeros(larger.num_states)
    initial[product.start] = np.asarray(model.initial)[first]
    passed, source = product.memory[product.host.state], larger.numbers.read
    structures = dict(larger.rewards)
    for name, (old, count) in rewards.items():
        earned = np.where(passed < count, choice_reward(model, old)[product.base_row], 0)
        structures[name] = Rewards(choice=earned)

    def read(whole: SparseMDP) -> RationalNumbers:
        assert source is not None
        numbers, own = cast(RationalNumbers, source(whole)), exact_numbers(model)
        for name, (old, count) in rewards.items():
            each = exact_reward(model, own, model.rewards[old], old)
            rows = zip(product.base_row.tolist(), (passed < count).tolist(), strict=True)
            numbers.rewards[name] = None, [each[r] if x else ZERO for r, x in rows], None
        return numbers

    return replace(larger, initial=initial, rewards=structures, numbers=NumberSource(read))


def transition_graph(model: SparseMDP) -> SparseMDP:
    """The model in which each possible transition is a choice: some path is some policy."""
    host = model.host
    return replace(
        model,
        row_start=host.entry_start[host.row_start],
        entry_start=np.arange(host.num_transitions + 1),
        probability=np.ones(host.num_transitions),
        rewards={},
        action=None,
        numbers=NumberSource(),
    )


def model_of_product(model: SparseMDP, product: SparseProduct) -> SparseMDP:
    """The product as a model, with the labels and exact probabilities of the model, without rewards."""
    row, state, still = product.base_row, product.base_state, product.still

    def read(larger: SparseMDP) -> RationalNumbers:
        numbers = exact_numbers(model)
        host = product.host
        rows: list[dict[int, Fraction]] = []
        for base, s, (first, last) in zip(
            row.tolist(), host.state.tolist(), _pairs(host.entry_start), strict=True
        ):
            after = host.successor[first:last].tolist()
            entries = {t: numbers.mdp.rows[base].get(int(state[t]), ZERO) for t in after}
            rows.append({s: ONE} if still[s] else entries)
        return RationalNumbers(ExactMDP(host.row_start.tolist(), rows), {})

    return replace(
        model,
        row_start=product.host.row_start,
        entry_start=product.host.entry_start,
        successor=product.host.successor,
        probability=product.host.probability,
        initial=np.bincount(product.start, minlength=state.size) / product.start.size,
        label=np.asarray(model.label)[state],
        rewards={},
        action=None if model.action is None else np.asarray(model.action)[row],
        valuation={name: np.asarray(x)[state] for name, x in model.valuation.items()},
        numbers=NumberSource(read),
    )


def _unrolled(model: SparseMDP, product: SparseProduct) -> SparseMDP:
    """The model of a product in which all states go on, with the rewards of the model."""
    row, state = product.base_row, product.base_state
    entry, _ = row_entries(model.host.entry_start, row)
    plain = model_of_product(model, product)

    def read(larger: SparseMDP) -> RationalNumbers:
        numbers, mdp = exact_numbers(model), exact_numbers(plain).mdp
        rewards = {
            name: (_taken(parts[0], state), _taken(parts[1], row), _taken(parts[2], entry))
            for name, parts in numbers.rewards.items()
        }
        return RationalNumbers(mdp, rewards)

    return replace(
        plain,
        probability=np.asarray(model.probability)[entry],
        label=np.column_stack([plain.label, product.memory == 1]),
        propositions=(*model.propositions, END),
        rewards={name: x.gathered(state, row, entry) for name, x in model.rewards.items()},
        numbers=NumberSource(read),
    )


def _pairs(starts: Integers) -> list[tuple[int, int]]:
    return list(zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True))


def _taken(part: Part, index: Integers) -> Part:
    return None if part is None else [part[i] for i in index.tolist()]
