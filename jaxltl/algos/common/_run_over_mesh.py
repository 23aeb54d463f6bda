"""Runs of lanes over the devices of a mesh, with metrics on the host."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import jax
import numpy as np
from jax.sharding import Mesh

from jaxltl.core.models.mesh.lanes import on_host, vmap_over_mesh
from jaxltl.core.models.protocols import PyTree

Run = Callable[..., tuple[PyTree, PyTree]]


def run_over_mesh(
    mesh: Mesh, run: Run, step: Callable[..., PyTree]
) -> Callable[..., tuple[PyTree, PyTree]]:
    """Runs of lanes by ``run(step, state, problem, hparams, lengths)``, with metrics on the host."""
    lanes = vmap_over_mesh(_lane(run, step), mesh, in_axes=(0, None, (0, None), None))

    def advance(
        state: PyTree, problem: PyTree, given: PyTree, lengths: np.ndarray
    ) -> tuple[PyTree, PyTree]:
        state, rows = lanes(state, problem, given, lengths)
        return state, jax.tree.map(lambda x: np.swapaxes(x, 0, 1), on_host(rows))

    return advance


@cache  # compiled once for each step, so it must stay the same function
def _lane(run: Run, step: Callable[..., PyTree]) -> Callable[..., PyTree]:
    return partial(run, step)
