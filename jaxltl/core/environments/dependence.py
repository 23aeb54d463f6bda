"""Dependence of a function's results on its arguments, read off the jaxpr."""

from __future__ import annotations

from collections.abc import Callable

import jax
from jax.extend.core import Jaxpr

from jaxltl.core.models.protocols import PyTree


def reads_key(function: Callable[..., PyTree], *arguments: PyTree) -> bool:
    """True if a result may depend on the last argument; False is a proof, by the jaxpr."""
    program = jax.make_jaxpr(function)(*arguments).jaxpr
    count = len(jax.tree.leaves(arguments[-1]))
    marked = [False] * (len(program.invars) - count) + [True] * count
    return any(marked_results(program, marked))


def marked_results(program: Jaxpr, given: list[bool]) -> list[bool]:
    """The results that may depend on marked arguments."""
    marks = {id(x) for x, mark in zip(program.invars, given, strict=True) if mark}
    for line in program.eqns:
        reads = [id(x) in marks for x in line.invars]
        if not any(reads):
            continue
        written = [True] * len(line.outvars)
        part = line.params.get("jaxpr") if line.primitive.name in ("pjit", "jit") else None
        if part is not None:
            written = marked_results(part.jaxpr, reads)
        marks |= {id(x) for x, mark in zip(line.outvars, written, strict=True) if mark}
    return [id(x) in marks for x in program.outvars]
