"""Engines on rows inside ``jit``: a compiled program calls the host, where no compiled engine answers."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from jaxltl.core.models.ops.array_namespace import is_traced
from jaxltl.core.models.protocols import Array, Model
from jaxltl.core.types import Solution
from jaxltl.core.values.door.question import Accuracy, Question
from jaxltl.core.values.door.shapes import require_known_parts
from jaxltl.core.values.engine.host_callback import on_host_inside_jit, solution_layout

Solver = Callable[[Model, Question, Accuracy], Solution]


def called(solve: Solver, *, relative: bool = False) -> Solver:
    """An engine of the host for traced arguments: not differentiable, and without `nature`.

    Lanes of ``vmap`` are solved one after the other. What is wrong with the values of arrays, which a program
    cannot raise, gives the status INVALID. `relative` engines bound a share of the value.
    """

    def inside(model: Model, question: Question, accuracy: Accuracy) -> Solution:
        require_known_parts(model, question)
        asked = question, accuracy
        leaves, tree = jax.tree.flatten(asked, is_leaf=lambda x: isinstance(x, str))
        arrays = [x if is_traced(x) else None for x in leaves]

        def on_host(world: Model, numbers: list[Array | None]) -> Solution:
            pairs = zip(leaves, numbers, strict=True)
            return solve(
                world, *jax.tree.unflatten(tree, [x if y is None else y for x, y in pairs])
            )

        policy = None if question.policy is None else jnp.asarray(question.policy)
        layout = solution_layout(model, policy=policy)
        return on_host_inside_jit(
            on_host, layout, model, arrays, relative=relative, tolerance=accuracy.tolerance
        )

    return inside
