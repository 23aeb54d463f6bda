"""Restrictions of models: fewer actions, or the reachable states as a model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, cast

import chex
import jax
import numpy as np

from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mdp import MDP, DenseMDP, make_mdp, support
from jaxltl.core.models.ops.choices import choice_mask
from jaxltl.core.models.product import Product, flat_successor
from jaxltl.core import validation
from jaxltl.core.validation import first_true
from jaxltl.core.models.protocols import ActionModel, Model, ModelT, base_model
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.graph.components import forward_reachable
from jaxltl.core.sparse.rows import offsets_from_counts, row_entries
from jaxltl.core.pretty_print import brief


def with_allowed(model: ModelT, allowed: chex.Array) -> ModelT:
    """The model with its actions restricted to a mask.

    Args:
      model: an MDP, a DenseMDP, a SparseMDP, an IntervalMDP, a Product or a Game.
      allowed: ``bool[S, A]``, in a product ``bool[S, Q, A]``, of a sparse or interval model, or a
        game on one, ``bool[R]``.

    Returns:
      A model of the same kind and states; the mask is its available actions.

    Raises:
      ValueError: a mask of another shape or dtype; unless something is traced, an action that is not
        available, or a state without any.

    Example:
      >>> from jaxltl import from_dense
      >>> with_allowed(from_dense([[[1.0], [1.0]]]), np.array([[False, True]])).available.tolist()
      [[False, True]]
    """
    return cast(ModelT, _with_allowed(model, allowed))


def _with_allowed(model: Model, allowed: chex.Array) -> Model:
    if isinstance(model, IntervalMDP):
        return model.changed(lambda nominal: _with_rows(nominal, allowed))
    if isinstance(model, SparseMDP):
        return _with_rows(model, allowed)
    if not isinstance(model, MDP | DenseMDP | Product | Game):
        raise ValueError(validation.unsupported_model(model))
    if isinstance(base_model(model), SparseMDP | IntervalMDP):
        if isinstance(model, Game) and base_model(model) is model.mdp:
            return replace(model, mdp=with_allowed(model.mdp, allowed))
        raise ValueError(
            "a product of a sparse or an interval model takes no mask of actions; restrict the world "
            "first, product(with_allowed(world, rows), formula), or write the product out by to_sparse."
        )
    shape = (*model.state_shape, model.num_actions)
    allowed = allowed if isinstance(allowed, jax.Array) else np.asarray(allowed)
    if allowed.shape != shape or allowed.dtype != bool:
        raise ValueError(
            f"allowed is {allowed.dtype}{list(allowed.shape)}; expected bool{list(shape)}."
        )
    if not is_traced((model, allowed)):
        mask, available = np.asarray(allowed), np.asarray(model.available)
        for *state, action in first_true(mask & ~available):
            raise ValueError(f"allowed: action {action} is not available in state {_named(state)}.")
        if (stuck := np.argwhere(available.any(-1) & ~mask.any(-1))).size:
            raise ValueError(
                f"allowed: no action is left in state {_named(stuck[0].tolist())}; allow one."
            )
    if isinstance(model, Game):
        return replace(model, mdp=with_allowed(model.mdp, allowed))
    if isinstance(model, Product):
        return replace(model, allowed=allowed)
    return replace(model, available=allowed)


def _with_rows(model: SparseMDP, allowed: chex.Array) -> SparseMDP:
    mask = np.asarray(allowed)
    if mask.shape != (model.num_rows,) or mask.dtype != bool:
        raise ValueError(
            f"allowed is {mask.dtype}{list(mask.shape)}; expected "
            f"bool[{model.num_rows}], one for each choice of the sparse model."
        )
    return submodel(model, np.ones(model.num_states, bool), mask)


def _named(state: list[int]) -> str:
    return f"{state[0]}" + "".join(f" with memory {q}" for q in state[1:])


@brief
class Restriction(NamedTuple):
    """The reachable part of a model.

    Attributes:
      model: S' states, with the labels and propositions of the original.
      base_state, memory: ``int32[S']``, the original state, and the automaton state (or zero).

    Example:
      >>> import jaxltl as jl
      >>> path = jl.make_sparse(None, [0, 1, 2, 3], [1, 1, 0], [1, 1, 1], initial=[1, 0, 0])
      >>> part = jl.models.restrict(path)
      >>> part.model.num_states, part.base_state.tolist()
      (2, [0, 1])
    """

    model: Any
    base_state: jax.Array
    memory: jax.Array


def restrict(
    model: ActionModel, initial: chex.Array | None = None, *, allowed: chex.Array | None = None
) -> Restriction:
    """The states reachable from the initial ones by allowed actions, as a model.

    Args:
      model: an MDP, a SparseMDP, a Product of one, a Game on them, or an IntervalMDP.
      initial: ``float[S]`` or ``[S, Q]``, an initial distribution; default: the model's.
      allowed: ``bool[S, A]`` or ``[S, Q, A]``, of a sparse model ``bool[R]``; default: all actions.

    Returns:
      A :class:`Restriction` to an MDP or SparseMDP, or to a Game on one.

    Raises:
      ValueError: a model without successor lists, or a reachable state without an allowed action.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.make_sparse(None, [0, 1, 2, 3], [1, 1, 0], [1, 1, 1])
      >>> restrict(path, np.array([0, 1, 0])).base_state.tolist()
      [1]
    """
    if isinstance(model, IntervalMDP):
        restriction = restrict(model.nominal, initial, allowed=allowed)
        part = model.changed(lambda x: restrict(x, initial, allowed=allowed).model)
        return restriction._replace(model=part)
    lazy = model.mdp if isinstance(model, Game) else model
    world = lazy.mdp if isinstance(lazy, Product) else lazy
    if isinstance(world, SparseMDP):
        return _restrict_sparse(model, lazy, initial, allowed)
    if not isinstance(world, MDP):
        raise ValueError("restrict needs successor lists; convert the world by from_dense.")
    initial = _start(model, initial)
    available = np.asarray(model.available)
    mask = choice_mask(model, "allowed", allowed)
    allowed = available if mask is None else available & mask
    allowed = allowed.reshape(-1, model.num_actions)
    successor, used = np.asarray(world.successor), support(world)
    step, label_on = np.zeros((world.num_states, 1), np.int32), "entry"
    if isinstance(lazy, Product):
        step, label_on = np.asarray(lazy.next_memory), lazy.label_on
    num_memory = step.shape[1]

    def targets(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        s, q = np.divmod(states, num_memory)
        flat = flat_successor(successor[s], step, *_columns(s, q), label_on)
        return flat, used[s] & allowed[states][:, :, None]

    states = _reached(initial > 0, targets)
    stuck = states[~allowed[states].any(-1)]
    if stuck.size:
        place = list(divmod(int(stuck[0]), num_memory))[: 2 if num_memory > 1 else 1]
        raise ValueError(
            f"no action is allowed in state {_named(place)}, which is reachable; the mask is empty "
            "there. Start inside the winning region, or allow an action."
        )
    number = np.full(len(allowed), -1)
    number[states] = np.arange(states.size)
    (flat, real), s = targets(states), states // num_memory
    mdp = make_mdp(
        np.where(real, number[flat], 0),
        np.where(real, np.asarray(world.probability)[s], 0),
        available=allowed[states],
        initial=initial[states],
        label=np.asarray(world.label)[s],
        propositions=world.propositions,
    )
    return _restriction(model, mdp, states, num_memory)


def _start(model: Model, initial: chex.Array | None) -> np.ndarray:
    start = np.asarray(model.initial)
    if initial is not None:
        own, start = start, validation.float_array("initial", initial)
        if start.shape not in (own.shape, (own.size,)) or not (start >= 0).all():
            raise ValueError(
                f"initial is {validation.shorten(start)} of shape {list(start.shape)}; give weights "
                f"of the states, {list(own.shape)}."
            )
    start = start.ravel()
    if not (start > 0).any():
        raise ValueError("the initial distribution is zero; give a state to start from.")
    return start


def _reached(
    seen: np.ndarray, targets: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> np.ndarray:
    """The states reachable from the initial mask `seen`, ascending."""
    number = np.empty(seen.size, int)
    frontier = np.flatnonzero(seen)
    while frontier.size:
        flat, real = targets(frontier)
        new = flat[real]
        new = new[~seen[new]]
        # One of each without sorting: of equal entries, the one that `number` has kept.
        number[new] = np.arange(new.size)
        frontier = new[number[new] == np.arange(new.size)]
        seen[frontier] = True
    return np.flatnonzero(seen)


def _restriction(model: Model, part: Model, states: np.ndarray, num_memory: int) -> Restriction:
    base, memory = to_jax(tuple(x.astype(np.int32) for x in np.divmod(states, num_memory)))
    if isinstance(model, Game):
        part = Game(part, to_jax(np.asarray(model.system).ravel()[states]))
    return Restriction(part, base, memory)


def _restrict_sparse(
    model: Model, lazy: Model, initial: chex.Array | None, allowed: chex.Array | None
) -> Restriction:
    """The restriction of a sparse model, or of a product of one as a sparse model."""
    sparse = to_sparse(lazy)
    start = _start(model, initial)
    rows = np.ones(sparse.num_rows, bool)
    if allowed is not None:
        rows = validation.boolean_array("allowed", allowed)
        if rows.shape != (sparse.num_rows,):
            raise ValueError(
                f"allowed has shape {rows.shape}; expected ({sparse.num_rows},), the "
                "choices of to_sparse(model)."
            )
    host, used = sparse.host, rows[sparse.host.row]
    states = forward_reachable(host.state[host.row[used]], host.successor[used], start > 0)
    restriction = submodel(replace(sparse, initial=start / start.sum()), states, rows)
    num_memory = lazy.num_memory if isinstance(lazy, Product) else 1
    return _restriction(model, restriction, np.flatnonzero(states), num_memory)


def _columns(s: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return s[:, None, None], q[:, None, None]


# --- sparse models --------------------------------------------------------------------------------


def submodel(model: SparseMDP, states: np.ndarray, rows: np.ndarray) -> SparseMDP:
    """The sparse model of some states ``bool[S]`` and rows ``bool[R]``; ValueError for a state without rows."""
    host, kept_states = model.host, np.flatnonzero(states)
    row = np.flatnonzero(rows & states[host.state])
    number = np.cumsum(states, dtype=np.int32) - 1
    choices = np.bincount(number[host.state[row]], minlength=kept_states.size)
    for i in first_true(choices == 0):
        raise ValueError(f"no choice is left in state {kept_states[i]}; allow one.")
    entry, width = row_entries(host.entry_start, row)
    initial = np.asarray(model.initial)[kept_states]
    return replace(
        model,
        row_start=offsets_from_counts(choices),
        entry_start=offsets_from_counts(width),
        successor=number[host.successor[entry]],
        probability=host.probability[entry],
        initial=initial / initial.sum() if initial.sum() else initial,
        label=np.asarray(model.label)[kept_states],
        rewards={name: x.gathered(kept_states, row, entry) for name, x in model.rewards.items()},
        action=None if model.action is None else np.asarray(model.action)[row],
        valuation={name: np.asarray(x)[kept_states] for name, x in model.valuation.items()},
    )
