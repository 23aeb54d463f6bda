"""Rational probabilities and rewards of the model of a program."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from fractions import Fraction

import numpy as np

from jaxltl.core.language.exact import exact_tree, exact_value
from jaxltl.core.language.exact_program import exact_program
from jaxltl.core.language.expressions import Expression
from jaxltl.core.language.syntax import Program
from jaxltl.core.models.number_source import Part, RationalNumbers
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.programs.local_choices import Functions, Weight
from jaxltl.core.programs.rows import ProgramRows
from jaxltl.core.sparse.exact.model import ZERO, ExactMDP, pairs


def rational_numbers(
    program: Program, build_rows: Callable[..., ProgramRows], model: SparseMDP
) -> RationalNumbers | None:
    """The numbers of the model of a program in rational arithmetic; None if some are irrational."""
    exact = exact_program(program)
    if exact is None:
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            rows = build_rows(exact, max_states=model.num_states, weights=Functions())
        except ValueError:
            return None
    values = _Values(rows.functions)
    try:
        probability = values.at(rows.weight)
        rewards = {
            name: (values.part(state), values.part(choice))
            for name, (state, choice) in rows.rewards.items()
        }
    except ArithmeticError:
        return None
    place = _places(rows, model)
    if place is None:
        return None
    successor = rows.successor.tolist()
    distributions = []
    for entries in pairs(rows.entry_start.tolist()):
        row: dict[int, Fraction] = {}
        for e in entries:
            if probability[e]:
                t = place[successor[e]]
                row[t] = row.get(t, ZERO) + probability[e]
        total = sum(row.values())
        distributions.append({t: p / total for t, p in row.items()})
    states, order = _order(rows, distributions, model, place)
    return RationalNumbers(
        ExactMDP(model.host.row_start.tolist(), [distributions[r] for r in order]),
        {
            name: (
                None if state is None else [state[s] for s in states],
                None if choice is None else [choice[r] for r in order],
                None,
            )
            for name, (state, choice) in rewards.items()
        },
    )


def _places(rows: ProgramRows, model: SparseMDP) -> list[int] | None:
    """The state of the model with the valuation of each state; searches differ in their order."""
    valuation = rows.annotations["valuation"]
    columns = [np.asarray(model.valuation[name]).tolist() for name in valuation]
    number = {values: s for s, values in enumerate(zip(*columns, strict=True))}
    mine = zip(*(x.tolist() for x in valuation.values()), strict=True)
    place = [number.get(values, -1) for values in mine] if columns else [0]
    return place if sorted(place) == list(range(model.num_states)) else None


def _order(
    rows: ProgramRows, distributions: list[dict[int, Fraction]], model: SparseMDP, place: list[int]
) -> tuple[list[int], list[int]]:
    """The state and the row of the exact model for each of a model, by actions and numbers."""
    states = np.argsort(place).tolist()
    action = rows.annotations["action"].tolist()
    host, order = model.host, []
    start, entry = host.row_start.tolist(), host.entry_start.tolist()
    successor, probability = host.successor.tolist(), host.probability.tolist()
    names = [0] * host.num_rows if model.action is None else np.asarray(model.action).tolist()
    for s, mine in enumerate(states):
        unused = list(range(int(rows.row_start[mine]), int(rows.row_start[mine + 1])))
        for r in range(start[s], start[s + 1]):
            entries = range(entry[r], entry[r + 1])
            row = {successor[e]: probability[e] for e in entries}

            def distance(i: int, r: int = r, row: dict[int, float] = row) -> float:
                other = distributions[i]
                away = max(abs(float(other.get(t, ZERO)) - row.get(t, 0)) for t in {*other, *row})
                return float(away + (action[i] != names[r]))

            best = min(unused, key=distance, default=0)
            order.append(best)
            unused = [i for i in unused if i != best]
    return states, order


class _Values:
    """Rational values of expressions by number; ArithmeticError for one without."""

    def __init__(self, expressions: tuple[Expression, ...]) -> None:
        self.expressions = expressions
        self.known: dict[int, Fraction] = {}

    def at(self, numbers: Weight) -> list[Fraction]:
        return [self.value(i) for i in numbers.tolist()]

    def part(self, numbers: Weight | None) -> Part:
        return None if numbers is None else self.at(numbers)

    def value(self, number: int) -> Fraction:
        if (value := self.known.get(number)) is None:
            value = exact_value(exact_tree(self.expressions[number]), {})
            if value is None:
                raise ArithmeticError
            self.known[number] = value
        return value
