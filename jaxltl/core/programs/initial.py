"""Initial states of a program."""

from __future__ import annotations

import math

import numpy as np

from jaxltl.core.array_types import Integers
from jaxltl.core.language.compiled import compile_expressions
from jaxltl.core.language.expressions import conjuncts, names_in
from jaxltl.core.language.source import LanguageError
from jaxltl.core.language.syntax import Program
from jaxltl.core.programs.bit_layout import Layout, Words

_CANDIDATES = 2**24  # partial assignments that are held at once


def initial_states(program: Program, layout: Layout, max_states: int) -> Words:
    """The initial states as packed words; errors as of :func:`initial_columns`."""
    return layout.packed(*initial_columns(program, max_states))


def initial_columns(program: Program, max_states: int) -> tuple[dict[str, Integers], int]:
    """Values of the variables in the initial states, and the number of these.

    There is one, or those that satisfy the ``init`` block: variables are assigned one after the
    other, and each conjunct of the condition is evaluated as soon as its variables are.

    Raises:
      LanguageError: no state satisfies the condition, or too many do.
    """
    if program.initial is None:
        return {v.name: np.array([v.initial]) for v in program.variables}, 1
    todo = [(names_in(e), compile_expressions([e])) for e in conjuncts(program.initial)]
    variables = {v.name: v for v in program.variables}
    width_of = {v.name: v.high - v.low + 1 for v in program.variables}
    columns: dict[str, Integers] = {}
    size = int(all(condition({})[0] for names, condition in todo if not names))
    todo = [p for p in todo if p[0]]
    limit = min(_CANDIDATES, max(max_states, 2**16))
    while len(columns) < len(variables):
        # Next are the variables of the conjunct that needs the fewest combinations.
        needs = [sorted(names - columns.keys()) for names, _ in todo]
        rest = [n for n in variables if n not in columns]
        chosen = min(needs, key=lambda some: math.prod(width_of[n] for n in some), default=rest)
        for name in chosen:
            v, width = variables[name], width_of[name]
            if size * width > limit:
                raise LanguageError(
                    program.initial.place,
                    f"the init block has more than {limit} candidates; restrict the variables "
                    "one by one, as in x=0 & y<=3, or give a larger max_states.",
                )
            columns = {n: x.repeat(width) for n, x in columns.items()}
            columns[name] = np.tile(np.arange(v.low, v.high + 1), size)
            size *= width
        ready = [condition for names, condition in todo if names <= columns.keys()]
        todo = [p for p in todo if not p[0] <= columns.keys()]
        for condition in ready:
            typed = {n: x != 0 if variables[n].type == "bool" else x for n, x in columns.items()}
            holds = np.flatnonzero(np.broadcast_to(condition(typed)[0], (size,)))
            columns = {n: x[holds] for n, x in columns.items()}
            size = holds.size
    if not size:
        raise LanguageError(program.initial.place, "no state satisfies the init block.")
    return columns, size
