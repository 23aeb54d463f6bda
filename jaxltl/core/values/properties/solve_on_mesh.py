"""Model checking of models over a device mesh, with reports of progress.

Bounds are computed by sweeps, and a run can resume from saved bounds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from jaxltl.core import validation
from jaxltl.core.logic.good_prefixes import is_plain_reachability
from jaxltl.core.logic.labels import is_boolean, satisfying
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.logic.properties import Property
from jaxltl.core.models.mesh.lanes import on_host
from jaxltl.core.models.mesh.sharded import ShardedMDP
from jaxltl.core.models.ops import kernels
from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.models.product import Product, product
from jaxltl.core.models.protocols import Array, PyTree
from jaxltl.core.models.sparse import default_reward
from jaxltl.core.types import Solution, Status
from jaxltl.core.values.properties.solve_property import TOLERANCE_SHARES, Answer, as_answer
from jaxltl.core.values.undiscounted.reachability import reachability_probability
from jaxltl.core.values.undiscounted.satisfaction import optimal_satisfaction
from jaxltl.core.values.undiscounted.total_reward import total_reward

Bounds = tuple[jax.Array, jax.Array]


@dataclass(frozen=True)
class MeshProperty:
    """A property of a sharded model, with its solver."""

    prop: Property
    states: np.ndarray  # int[I], the initial states, by their numbers in the given model
    shape: tuple[int, ...]  # of the bounds: (N,), of a product (N, Q)
    # The next solution from bounds, half the requested width and a number of steps; of rewards
    # the last one.
    advance: Callable[[Bounds, float, int], Solution]
    # Quantities of the initial states, float64[I], from those of all states.
    taken: Callable[[jax.Array], np.ndarray]

    @property
    def goes_on(self) -> bool:
        """True if the solver narrows bounds step by step."""
        return self.prop.operator == "P"

    def tolerance(self, wanted: float, part: float = 1.0) -> float:
        """Half the width to ask for, a little less: bounds have to be as narrow as is wanted."""
        return 0.49 * wanted * part

    def answer(self, solution: Solution, wanted: float) -> Answer:
        """The answer of a solution."""
        names = ("value", "lower", "upper")
        small: dict[str, Array] = {name: self.taken(getattr(solution, name)) for name in names}
        no_policy: Array = np.zeros(0, np.int32)
        answer = replace(solution, **small, policy=no_policy, status=on_host(solution.status))
        method = "interval iteration" if self.goes_on else "policy iteration by a Krylov method"
        return as_answer(self.prop, self.states, answer, wanted, f"{method} on the mesh")

    def is_answered(self, answer: Answer, part: float) -> bool:
        """True if the answer needs no narrower bounds of those in :data:`TOLERANCE_SHARES`."""
        return (
            self.prop.relation is None
            or answer.status == Status.CONVERGED
            or part <= TOLERANCE_SHARES[-1]
        )


def question_on_mesh(model: ShardedMDP, prop: Property) -> MeshProperty:
    """Solver of a property of a model on a mesh of devices."""
    path = _path(prop)
    if prop.definitions or prop.aggregate is not None:
        raise ValueError(
            f"{prop.text}: nested properties, variables and filters are not solved for on a mesh; "
            "write labels, or solve on one device."
        )
    if prop.nature is not None:
        raise ValueError(f"{prop.text}: the model has no intervals from which nature could pick.")
    objective = _objective(model, prop)
    starts = _starts(model)
    states = np.asarray(on_host(_pick(model, model.number, starts)))
    shape: tuple[int, ...] = model.state_shape
    index: tuple[jax.Array, ...] = (starts,)
    advance: Callable[[Bounds, float, int], Solution]
    if path.operator == "F" and is_boolean(path.operands[0]):
        holds = satisfying(
            np.asarray(model.label_rows), model.propositions, path.operands[0], prop.text
        )
        target = jax.jit(lambda kind: kernels.gather(jnp.asarray(holds), kind))(model.kind)
        reward = None if prop.operator == "P" else _reward(model, prop)

        def advance(start: Bounds, half: float, steps: int) -> Solution:
            if reward is None:
                return _reach_for(model, target, start, half, np.int32(steps), objective)
            return _earn_until(model, reward, target, 2 * half, objective)

    else:
        both = product(model, path)
        shape, advance = both.state_shape, partial(_satisfy, both, objective)
        memory = _everywhere(model, lambda x, i: x.initial_memory[i], both, starts)
        index = starts, memory

    def taken(quantity: jax.Array) -> np.ndarray:
        return np.asarray(on_host(_pick(model, quantity, *index)), np.float64)

    return MeshProperty(prop, states, shape, advance, taken)


def _path(prop: Property) -> Formula:
    """The reduction of the property, if it is supported."""
    path = prop.path
    if isinstance(path, Formula):
        is_reach = is_plain_reachability(path) and prop.unreached == "infinite"
        if prop.operator == "P" or (prop.operator in ("R", "T") and is_reach):
            return path
    quantity = {
        "LRA": "averages in the long run",
        "multi": "several objectives",
        "value": "expressions",
        **dict.fromkeys("EA", "quantifiers over paths"),
        "P": "bounds on steps or rewards",
    }.get(prop.operator, f"rewards [ {path} ]")
    raise ValueError(
        f"{prop.text}: {quantity} are not solved for over a mesh; probabilities of formulas are, and "
        "expected rewards and steps until a state is reached (F). Leave --mesh out for this one."
    )


def _reward(model: ShardedMDP, prop: Property) -> jax.Array:
    """On choices, ``float[N, A]``; where none is named the only one."""
    if prop.operator == "T":
        result: jax.Array = jax.jit(lambda x: jnp.ones(x.shape, model.dtype))(model.available)
        return result
    with validation.errors_in(f"{prop.text}: "):
        name = default_reward(model.rewards) if prop.reward is None else prop.reward
        if name not in model.rewards:
            listed = ", ".join(map(repr, model.rewards)) or "none"
            raise ValueError(f"there is no reward {name!r}; the model has {listed}.")
    return model.rewards[name]


def first_bounds(model: ShardedMDP, question: MeshProperty) -> Bounds:
    """Those that any probability has, where the model's values are."""

    def full(number: jax.Array) -> jax.Array:
        return jnp.full(question.shape, number, model.dtype)

    make = jax.jit(full, out_shardings=model.sharding)
    return make(0.0), make(1.0)


def _objective(model: ShardedMDP, prop: Property) -> str:
    if prop.direction is not None:
        return prop.direction
    if bool(on_host(jax.jit(lambda x: (x.sum(-1) > 1).any())(model.available))):
        raise ValueError(
            f"{prop.text}: the model has states with several choices, so the value depends on a "
            "strategy; ask for Pmax=? or Pmin=?."
        )
    return "max"


def _starts(model: ShardedMDP) -> jax.Array:
    """Positions of the initial states in order; on every device."""
    number = int(on_host(jax.jit(lambda x: (x > 0).sum())(model.initial)))
    positions = _everywhere(model, lambda x: jnp.flatnonzero(x > 0, size=number), model.initial)
    order = np.argsort(on_host(_pick(model, model.number, positions)), kind="stable")
    return _everywhere(model, lambda x: x[order], positions)


def _everywhere(
    model: ShardedMDP, function: Callable[..., jax.Array], *arrays: PyTree
) -> jax.Array:
    """The result of a function of arrays, on every device."""
    whole = NamedSharding(model.mesh, PartitionSpec())
    result: jax.Array = jax.jit(function, out_shardings=whole)(*arrays)
    return result


def _pick(model: ShardedMDP, quantity: jax.Array, *index: jax.Array) -> jax.Array:
    return _everywhere(model, lambda x, *i: x[i], quantity, *index)


@jit("objective")
def _reach_for(
    model: ShardedMDP,
    target: Array,
    start: Bounds,
    half: Array | float,
    steps: Array,
    objective: str,
) -> Solution:
    return reachability_probability(
        model, target, objective=objective, tolerance=half, max_steps=steps, start=start
    )


@jit("objective")
def _earn_until(
    model: ShardedMDP, reward: jax.Array, target: jax.Array, share: Array | float, objective: str
) -> Solution:
    return total_reward(model, reward, target, objective=objective, tolerance=share)


def _satisfy(both: Product, objective: str, start: Bounds, half: float, steps: int) -> Solution:
    return optimal_satisfaction(
        both, objective=objective, tolerance=half, max_steps=steps, start=start
    )
