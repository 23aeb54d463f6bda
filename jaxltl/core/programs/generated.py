"""Python code of the commands of a module, for the expansion of single states."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.language.expressions import SCALAR, Expression
from jaxltl.core.language.syntax import Command, Module, Variable
from jaxltl.core.programs.bit_layout import Layout
from jaxltl.core.validation import ROW_SUM_TOLERANCE

# Joint updates of a state as (difference of the packed state, probability).
Updates = tuple[tuple[int, float], ...]
Local = Callable[[int], tuple[list[Updates], ...]]  # of a packed state, for each action

_MAX_SIZE = 20_000  # nodes of a module's expressions; compilation takes a microsecond for each
_INFIX = {
    "&": " and ",
    "|": " or ",
    "=": " == ",
    "<=>": " == ",
    "!=": " != ",
    **{x: f" {x} " for x in ("<", "<=", ">", ">=", "+", "-", "*")},
}


class Unsupported(Exception):
    """A state or a program that is left to the vectorised search, which also names errors."""


def generate(module: Module, actions: tuple[str, ...], layout: Layout) -> Local:
    """A function of packed states to the enabled commands of a module, for each of its actions.

    Raises:
      Unsupported: the module is too large or too deep for Python's compiler.
    """
    if sum(e.size for c in module.commands for e in c.expressions) > _MAX_SIZE:
        raise Unsupported
    local = {name: f"v{i}" for i, name in enumerate(sorted(module.names))}
    lines = ["def local(s):"]
    for name, code in local.items():
        field = layout.fields[name]
        v, shift = field.variable, field.shift + 64 * field.word
        lines.append(f"    {code} = ((s >> {shift}) & {(1 << v.bits) - 1}) + {v.low}")
    lines += [f"    a{i} = []" for i in range(len(actions))]
    for c in module.commands:
        lines.append(f"    if {_source(c.guard, local)}:")
        lines += [f"        {x}" for x in _command(c, actions.index(c.action), layout, local)]
    lines.append(f"    return {', '.join(f'a{i}' for i in range(len(actions)))},")
    space: dict[str, Any] = {"apply": SCALAR, "check": _check, "Unsupported": Unsupported}
    try:
        exec(compile("\n".join(lines), "<generated>", "exec"), space)
    except (SyntaxError, RecursionError, MemoryError):
        raise Unsupported from None
    local_function: Local = space["local"]
    return local_function


def _command(c: Command, column: int, layout: Layout, local: dict[str, str]) -> list[str]:
    """Lines that append the updates of an enabled command."""
    lines, pairs = [], []
    for k, o in enumerate(c.outcomes):
        change = ["0"]
        for i, a in enumerate(o.assignments):
            field = layout.fields[a.variable]
            v, new = field.variable, f"n{k}_{i}"
            lines.append(f"{new} = {_source(a.expression, local)}")
            if may_leave(v, a.expression):
                lines.append(f"if {new} < {v.low} or {new} > {v.high}: raise Unsupported")
            change.append(f"(({new} - {local[a.variable]}) << {field.shift + 64 * field.word})")
        pairs.append(f"({' + '.join(change)}, {_source(o.probability, local)})")
    updates = f"({', '.join(pairs)},)"
    if fixed_probabilities(c) is None:
        updates = f"check({updates})"
    return [*lines, f"a{column}.append({updates})"]


def fixed_probabilities(c: Command) -> NDArray[np.float64] | None:
    """The probabilities of a command, if they are positive literals with the sum one."""
    values = [o.probability.value for o in c.outcomes if o.probability.is_literal]
    probabilities = np.array(values, np.float64)
    valid = probabilities.size == len(c.outcomes) and (probabilities > 0).all()
    return probabilities if valid and abs(probabilities.sum() - 1) <= ROW_SUM_TOLERANCE else None


def may_leave(v: Variable, e: Expression) -> bool:
    """False for values that are in the range of a variable."""
    return v.type == "int" and not (isinstance(e.value, int) and v.low <= e.value <= v.high)


def _check(updates: Any) -> Updates:
    """Updates with positive probabilities, which must sum to one."""
    total = sum([p for _, p in updates])
    if not abs(total - 1) <= ROW_SUM_TOLERANCE or min([p for _, p in updates]) < 0:
        raise Unsupported
    return tuple([(d, float(p)) for d, p in updates if p])


def _source(e: Expression, local: dict[str, str]) -> str:
    """An expression as Python code."""
    if e.operator == "literal":
        if isinstance(e.value, float) and not math.isfinite(e.value):
            raise Unsupported
        return f"({e.value!r})"
    if e.operator == "name":
        return local[str(e.value)]
    parts = [_source(x, local) for x in e.operands]
    if e.operator in _INFIX:
        return f"({_INFIX[e.operator].join(parts)})"
    if e.operator == "?:":
        return f"({parts[1]} if {parts[0]} else {parts[2]})"
    if e.operator in ("!", "neg"):
        return f"({'not ' if e.operator == '!' else '-'}{parts[0]})"
    if e.operator in ("min", "max") and len(parts) > 1:
        return f"{e.operator}({', '.join(parts)})"
    return f"apply[{e.operator!r}]({', '.join(parts)})"
