"""Bounds on optimal reachability where sweeps make hardly any progress, by elimination.

A loop that is left with probability 1e-6 takes millions of sweeps, but a linear system solves
it at once. So for small models: policy iteration (Howard 1960), then a proof of the result by
one application of the operator, rounded outwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaxltl.core.graphs.end_components import EndComponents
from jaxltl.core.models.operators import transition_matrix

_MAX_ROUNDS = 200

Floats = NDArray[np.float64]


class _Choices(NamedTuple):
    """`rows[A, S, S]`, which of them may be taken, and which states choose together."""

    rows: Floats
    allowed: NDArray[np.bool_]
    group: NDArray[np.integer[Any]]

    def best(self, value: Floats, sign: int) -> tuple[Floats, Floats]:
        """The optimum of ``rows @ value`` for each state, and the row that attains it."""
        images = np.where(self.allowed, sign * (self.rows @ value), -np.inf)
        action = images.argmax(0)
        image = images.max(0)
        order = np.lexsort((-image, self.group))
        first = order[np.unique(self.group[order], return_index=True)[1]]
        chooser = np.empty(len(image), int)
        chooser[self.group[first]] = first
        chosen = chooser[self.group]
        return sign * image[chosen], self.rows[action[chosen], chosen]


def reachability_bounds(
    model: Any,
    one: jax.Array,
    undecided: jax.Array,
    components: EndComponents | None,
    objective: str,
) -> tuple[jax.Array, jax.Array] | None:
    """Proven lower and upper bounds of an optimal reachability probability, on the host.

    Args:
      model: a model with concrete arrays, small enough for ``A`` matrices ``[S, S]``.
      one, undecided: ``bool[S]``, where the probability is 1, and where it is not known.
      components: end components among the undecided states, for a maximum.
      objective: ``"max"`` or ``"min"``.

    Returns:
      Two arrays ``float[S]``; None if they could not be proven.
    """
    sign = 1 if objective == "max" else -1
    open_ = np.asarray(undecided).ravel()
    target = np.asarray(one).ravel().astype(float)
    choices = _choices(model, components)
    value = _iterate(choices, open_, target, np.zeros(len(target)), sign)
    # How long a run can stay undecided at most: errors grow with it.
    time = _iterate(choices, open_, np.zeros(len(target)), np.ones(len(target)), 1)
    if value is None or time is None:
        return None
    slack = (model.num_successors + model.num_actions + 4) * np.finfo(float).eps
    residual = np.abs(choices.best(value, sign)[0] - value)[open_].max(initial=0)
    margin = np.where(open_, (2 * residual + 2 * slack) * time, 0)
    lower, upper = np.maximum(value - margin, 0), value + margin
    below = choices.best(lower, sign)[0] * (1 - slack) >= lower
    above = choices.best(upper, sign)[0] * (1 + slack) <= upper
    if not (below & above)[open_].all():
        return None
    dtype = np.dtype(model.dtype)
    outwards = (np.nextafter(lower.astype(dtype), -1), np.nextafter(upper.astype(dtype), 2))
    known = target.astype(dtype)
    low, high = (np.where(open_, np.clip(x, 0, 1), known) for x in outwards)
    shape = model.state_shape
    return jnp.asarray(low.reshape(shape)), jnp.asarray(high.reshape(shape))


def _choices(model: Any, components: EndComponents | None) -> _Choices:
    shape = (*model.state_shape, model.num_actions)
    rows = [
        np.asarray(transition_matrix(model, jnp.zeros(shape, model.dtype).at[..., a].set(1)), float)
        for a in range(model.num_actions)
    ]
    allowed = np.asarray(model.available)
    group = np.arange(len(rows[0]))
    if components is not None:
        allowed = allowed & ~np.asarray(components.inside)
        group = np.asarray(components.component).ravel()
    return _Choices(np.stack(rows), allowed.reshape(-1, model.num_actions).T, group)


def _iterate(
    choices: _Choices, open_: NDArray[np.bool_], known: Floats, cost: Floats, sign: int
) -> Floats | None:
    """The optimum of ``x = cost + row @ x`` on the open states, `known` on the others."""
    value = known
    for round_ in range(_MAX_ROUNDS):
        image, rows = choices.best(value, sign)
        gain = sign * (cost + image - value)[open_]
        if round_ and (gain <= 1e-15 * np.abs(value[open_])).all():
            return value
        matrix = np.eye(open_.sum()) - rows[np.ix_(open_, open_)]
        try:
            solved = np.linalg.solve(matrix, cost[open_] + rows[open_] @ np.where(open_, 0, known))
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(solved).all():
            return None
        value = known.copy()
        value[open_] = solved
    return value
