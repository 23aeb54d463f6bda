"""Discounted rewards of properties as undiscounted ones of models that may end after each step."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np

from jaxltl.core.logic.bounded import Earned
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.properties import Property
from jaxltl.core.models.construct.state_formulas import states_satisfying
from jaxltl.core.models.exact_numbers import exact_numbers, exact_reward
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.number_source import NumberSource, RationalNumbers
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.rewards import default_reward
from jaxltl.core.models.sparse import Rewards, SparseMDP, choice_reward, reward_structure
from jaxltl.core.sparse.exact.model import ONE, ZERO, ExactMDP
from jaxltl.core.values.engine.state_quantities import finite_reward
from jaxltl.core.values.properties.aims import CheckableModel

_UNIT = 2.0**-53
_END = "[end]"  # the label of the last state and of targets


def without_discount(model: CheckableModel, prop: Property) -> tuple[CheckableModel, Property]:
    """The model with a last state, which earns nothing and is entered with one minus the discount.

    The total reward there is the discounted one (Puterman 1994, section 5.3), and a run that does not reach a
    target earns its sum.
    """
    inner = model.mdp if isinstance(model, Game) else model
    assert prop.discount is not None
    if isinstance(inner, IntervalMDP):
        return _intervals_without_discount(model, inner, prop)
    name = default_reward(inner.rewards) if prop.reward is None else prop.reward
    larger: CheckableModel = _with_end(inner, name, prop.discount)
    if isinstance(model, Game):
        larger = Game(larger, to_jax(np.append(np.asarray(model.system), True)))
    return larger, replace(prop, reward=name, discount=None)


def _intervals_without_discount(
    model: CheckableModel, inner: IntervalMDP, prop: Property
) -> tuple[CheckableModel, Property]:
    """The same of intervals, where the last state counts as a target, which is reached almost surely."""
    graph, path = inner.nominal, prop.path
    name = default_reward(graph.rewards) if prop.reward is None else prop.reward
    if isinstance(model, Game) or graph.rewards[name].transition is not None:
        raise ValueError(
            f"{prop.text}: discounted rewards of models with intervals are those of states and choices, "
            "without a second player; optimal_value solves others."
        )
    assert prop.discount is not None
    ends, target = [True], np.zeros(graph.num_states, bool)
    if isinstance(path, Formula):
        target = states_satisfying(graph, path.operands[0], prop.text)
    if not isinstance(path, Earned) or path.steps is None:
        path = Formula("F", (Formula("ap", proposition=_END),))
    larger = _with_end(graph, name, prop.discount)
    label = np.column_stack([np.asarray(larger.label), np.append(target, ends)])
    larger = replace(larger, label=label, propositions=(*larger.propositions, _END))
    inner_entries = larger.successor[: larger.num_transitions] != graph.num_states

    def scaled(x: Array) -> Array:
        """Ends or centers of intervals in the larger model."""
        new = np.where(inner_entries, 0, np.asarray(larger.probability))
        assert prop.discount is not None
        new[inner_entries] = np.asarray(x)[: inner_entries.sum()] * float(prop.discount)
        return new

    center, radius = inner.center, inner.radius
    if center is not None and radius is not None:
        center, radius = scaled(center), np.append(np.asarray(radius) * float(prop.discount), 0)
    intervals = IntervalMDP(larger, scaled(inner.lower), scaled(inner.upper), center, radius)
    return intervals, replace(prop, reward=name, path=path, discount=None, unreached="infinite")


def rounding_of_discount(model: CheckableModel, prop: Property) -> float:
    """Bound of the difference of values of :func:`without_discount` that its rounded numbers make.

    With optimality operators T and T' that contract by d, values differ by at most
    ``max |T V' - T' V'| / (1 - d)``. A row of probabilities times d is off by ``4 u`` in total, of which each
    unit counts at most ``max |V'|``, and an expected reward of K terms by ``(K + 3) u`` relative to their sizes.
    """
    inner = model.mdp if isinstance(model, Game) else model
    inner = inner.nominal if isinstance(inner, IntervalMDP) else inner
    assert prop.discount is not None
    largest = float(finite_reward(inner, prop.reward)[1].max(initial=0))
    steps = 1 / float(1 - prop.discount)
    if isinstance(prop.path, Earned) and prop.path.steps is not None:
        steps = min(steps, prop.path.steps)
    terms = int(np.diff(inner.host.entry_start).max())
    return 1.01 * _UNIT * largest * steps * (terms + 3 + 4 * steps)


def _with_end(model: SparseMDP, name: str, discount: Fraction) -> SparseMDP:
    host, end = model.host, model.num_states
    # With discount 0 only the transitions to the end remain.
    inner = host.num_transitions if discount else 0
    size = np.append(np.diff(host.entry_start) * bool(discount) + 1, 1)
    last = np.cumsum(size)[:-1] - 1
    successor, probability = np.full(size.sum(), end), np.full(size.sum(), float(1 - discount))
    is_inner = np.ones(size.sum(), bool)
    is_inner[last] = is_inner[-1] = False
    successor[is_inner] = host.successor[:inner]
    probability[is_inner] = host.probability[:inner] * float(discount)
    probability[-1] = 1

    def read(larger: SparseMDP) -> RationalNumbers:
        numbers = exact_numbers(model)
        rows = [
            {t: p * discount for t, p in row.items() if discount} | {end: 1 - discount}
            for row in numbers.mdp.rows
        ]
        mdp = ExactMDP([*numbers.mdp.row_start, len(rows) + 1], [*rows, {end: ONE}])
        earned = exact_reward(model, numbers, reward_structure(model, name), name)
        return RationalNumbers(mdp, {name: (None, [*earned, ZERO], None)})

    return replace(
        model,
        row_start=np.append(host.row_start, host.num_rows + 1).astype(host.row_start.dtype),
        entry_start=np.append(0, np.cumsum(size)).astype(host.entry_start.dtype),
        successor=successor.astype(host.successor.dtype),
        probability=probability,
        initial=np.append(np.asarray(model.initial), 0),
        label=np.concatenate(
            [np.asarray(model.label), np.zeros((1, len(model.propositions)), bool)]
        ),
        rewards={name: Rewards(choice=np.append(choice_reward(model, name), 0))},
        action=None if model.action is None else np.append(np.asarray(model.action), 0),
        valuation={
            x: np.append(np.asarray(v), np.asarray(v)[:1]) for x, v in model.valuation.items()
        },
        numbers=NumberSource(read),
    )
