"""Programs in rational arithmetic."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

from jaxltl.core.language.exact import exact_constant
from jaxltl.core.language.resolve import exact_syntax, resolved
from jaxltl.core.language.syntax import Program


def exact_program(program: Program) -> Program | None:
    """The program with its probabilities and rewards folded in rational arithmetic.

    Guards and updates are those of the program, so that both have the same states. None if the
    program has no syntax tree, or is not resolved in fractions.
    """
    if program.syntax is None:
        return None
    try:
        values = {name: exact_constant(x) for name, x in program.arguments.items()}
        exact = resolved(exact_syntax(program.syntax), values, real=Fraction)
        modules = []
        for m, other in zip(program.modules, exact.modules, strict=True):
            commands = []
            for c, d in zip(m.commands, other.commands, strict=True):
                outcomes = [
                    replace(o, probability=p.probability)
                    for o, p in zip(c.outcomes, d.outcomes, strict=True)
                ]
                commands.append(replace(c, outcomes=tuple(outcomes)))
            modules.append(replace(m, commands=tuple(commands)))
        rewards = []
        for r, s in zip(program.rewards, exact.rewards, strict=True):
            items = [replace(i, value=j.value) for i, j in zip(r.items, s.items, strict=True)]
            rewards.append(replace(r, items=tuple(items)))
    except (ValueError, ArithmeticError, TypeError):
        return None
    return replace(
        program,
        modules=tuple(modules),
        rewards=tuple(rewards),
        constants=exact.constants,
        formulas=exact.formulas,
    )
