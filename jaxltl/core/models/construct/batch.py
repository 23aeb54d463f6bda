"""Batches of products with one task, and demonstrations in them."""

from __future__ import annotations

from typing import cast

import math
from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import FormulaLike, to_automaton
from jaxltl.core.logic.ltl import Formula, parse_ltl
from jaxltl.core.models.ops.array_namespace import jax_array, is_traced, namespace, to_jax
from jaxltl.core.models.construct.lifting import allowed_steps, memory_along
from jaxltl.core.models.mdp import MDP
from jaxltl.core.models.product import Product, occurring_letters, product
from jaxltl.core.models.construct.restrict import with_allowed
from jaxltl.core.models.protocols import Model, PyTree
from jaxltl.core.models.trajectories import Trajectories, make_trajectories, require_states


def stack_products(
    worlds: Sequence[MDP], formula: FormulaLike, *, label_on: str = "exit"
) -> Product:
    """The products of several models with one automaton, stacked along a leading axis for ``vmap``.

    Smaller models are padded with unreachable states, and so are successor lists.

    Args:
      worlds: W models with the same actions and the same propositions, in any order.
      formula: a formula, translated over the letters of all models, or an automaton.
      label_on: ``"exit"`` or ``"entry"``, see :class:`~jaxltl.core.models.product.Product`.

    Returns:
      A :class:`Product` with arrays of the leading axis ``[W]``.

    Raises:
      ValueError: no model, or one (counted from 0) that is not an MDP, has other actions or
        propositions than the first, or a letter that the automaton does not have.

    Example:
      >>> from jaxltl import from_dense
      >>> one = from_dense([[[0, 1.0]], [[0, 1.0]]], label={"goal": [1]})
      >>> stack_products([one, from_dense([[[1.0]]], label={"goal": [0]})], "F goal").letter.tolist()
      [[0, 1], [1, 1]]
    """
    worlds = [_like_first(world, i, worlds[0]) for i, world in enumerate(worlds)]
    if not worlds:
        raise ValueError("there are no worlds to stack; give at least one.")
    automaton = formula
    if isinstance(formula, str | Formula):
        parsed = parse_ltl(formula) if isinstance(formula, str) else formula
        known = set(parsed.propositions)
        letters = {
            x for world in worlds for x in occurring_letters(world, known & set(world.propositions))
        }
        automaton = to_automaton(parsed, letters=sorted(letters, key=sorted))
    num_states = max(world.num_states for world in worlds)
    width = max(world.num_successors for world in worlds)
    products = []
    for i, world in enumerate(worlds):
        try:
            lane = product(world, automaton, label_on=label_on)
        except ValueError as error:
            raise ValueError(f"world {i}: {error}") from error
        extra = num_states - world.num_states
        # Padded states have the label of state 0, which adds no letter.
        shown_here = np.asarray(lane.letter)
        letter = np.concatenate([shown_here, np.repeat(shown_here[:1], extra)])
        padded = pad_states(world, num_states, width)
        products.append(replace(lane, mdp=jax.tree.map(np.asarray, padded), letter=letter))
    return cast(
        Product, to_jax(jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *products))
    )


def _like_first(world: Model, number: int, first: MDP) -> MDP:
    """The model with labels in the order of the first model's propositions."""
    if not isinstance(world, MDP):
        raise ValueError(
            f"world {number} is a {type(world).__name__}; give MDPs, for example by from_dense."
        )
    if world.num_actions != first.num_actions:
        raise ValueError(
            f"world {number} has {world.num_actions} actions and world 0 has "
            f"{first.num_actions}; make the missing ones unavailable."
        )
    if world.propositions == first.propositions:
        return world
    if set(world.propositions) != set(first.propositions):
        missing = sorted(set(first.propositions) - set(world.propositions))
        added = sorted(set(world.propositions) - set(first.propositions))
        difference = f"lacks {', '.join(missing)}" if missing else f"has {', '.join(added)} besides"
        raise ValueError(
            f"world {number} does not have the propositions of world 0: it {difference}. Give "
            "every world the same ones, with labels that are false where nothing shows them."
        )
    column = [world.propositions.index(p) for p in first.propositions]
    label = to_jax(np.asarray(world.label)[:, column])
    return replace(world, label=label, propositions=first.propositions)


def pad_states(mdp: MDP, num_states: int, num_successors: int | None = None) -> MDP:
    """The model with unreachable absorbing states appended, labelled like state 0, and longer lists."""
    own = mdp.num_states
    extra, width = num_states - own, num_successors or mdp.num_successors
    if extra < 0:
        raise ValueError(f"the world has {own} states, more than {num_states}; pad to the most.")
    added = (0, extra), (0, 0), (0, width - mdp.num_successors)
    successor, probability = (
        np.pad(np.asarray(x), added) for x in (mdp.successor, mdp.probability)
    )
    successor[own:, :, 0] = np.arange(own, num_states)[:, None]
    probability[own:, :, 0] = 1
    parts: dict[str, PyTree] = {
        "successor": successor,
        "probability": probability,
        "available": np.pad(np.asarray(mdp.available), added[:2], constant_values=True),
        "initial": np.pad(np.asarray(mdp.initial), added[0]),
        "label": np.asarray(mdp.label)[np.arange(num_states) * (np.arange(num_states) < own)],
    }
    return replace(mdp, **to_jax(parts))


def is_stacked(model: Product) -> bool:
    """True if a product has a first axis of worlds."""
    return jnp.ndim(model.letter) == 2


def as_stacked(model: Product) -> Product:
    """The product with a leading batch axis: itself, or W = 1."""
    return model if is_stacked(model) else _stacked([model])


def _stacked(models: Sequence[Product]) -> Product:
    xp, *models = namespace(*models)
    return cast(Product, to_jax(jax.tree.map(lambda *x: xp.stack(x), *models)))


def num_worlds(model: Product) -> int:
    """Number of stacked worlds."""
    return model.letter.shape[0] if is_stacked(model) else 1


def unstack_product(model: Product, number: int) -> Product:
    """One product of a batch, padding included."""
    if is_traced((model, number)):
        result: Product = jax.tree.map(lambda x: x[number], model)
    else:
        result = to_jax(jax.tree.map(lambda x: np.asarray(x)[number], model))
    return result


def restrict_stacked_actions(models: Product, allowed: PyTree) -> Product:
    """Stacked products restricted to masks ``bool[W, S, Q, A]``; ValueError names the product."""
    masks = allowed if isinstance(allowed, list | tuple) or np.ndim(allowed) > 3 else [allowed]
    if len(masks) != num_worlds(models):
        raise ValueError(f"there are {len(masks)} masks for {num_worlds(models)} worlds.")
    for w, mask in enumerate(masks):
        try:
            with_allowed(unstack_product(models, w), np.asarray(mask))
        except ValueError as error:
            raise ValueError(f"world {w}: {error}") from error
    return replace(models, allowed=to_jax(np.stack([np.asarray(x) for x in masks])))


def lift_memory_policy(policy: jax.Array, automaton: Automaton | int) -> jax.Array:
    """A policy with the memory of one automaton in the product with a synchronised second automaton.

    Args:
      policy: ``[S, Q1, ...]``, or with leading axes before S if it is ``float[..., S, Q1, A]``.
      automaton: the second automaton of :func:`synchronize`, or its number Q2 of states.

    Returns:
      ``[S, Q1 * Q2, ...]``, independent of the second automaton. Differentiable in the policy.

    Example:
      >>> lift_memory_policy(jnp.array([[[0.0, 1.0], [1.0, 0.0]]]), 2)[0, :, 1].tolist()
      [1.0, 1.0, 0.0, 0.0]
    """
    num2 = automaton if isinstance(automaton, int) else len(automaton.delta)
    stochastic = jnp.issubdtype(jnp.result_type(policy), jnp.floating)
    return jnp.repeat(policy, num2, axis=-2 if stochastic else -1)


# --- demonstrations in several worlds --------------------------------------------------------


def stack_models(models: Product | Sequence[Product]) -> Product:
    """Products of equal shapes with one automaton, stacked; stacked ones are returned unchanged."""
    if isinstance(models, Product):
        return as_stacked(models)
    if not models or not all(isinstance(x, Product) for x in models):
        raise ValueError("give a product, or several; product(world, task) makes one.")
    first = models[0]
    for i, other in enumerate(models):
        if other.mdp.propositions != first.mdp.propositions:
            _like_first(other.mdp, i, first.mdp)
        same = _equal(other.automaton, first.automaton)
        if not same or other.label_on != first.label_on:
            raise ValueError(
                f"world {i} has another automaton than world 0, so that memory would mean "
                "another thing; build the products with one, or by stack_products."
            )
        if _shapes(other.mdp) != _shapes(first.mdp):
            raise ValueError(
                f"world {i} does not have the shapes of world 0; stack_products(worlds, task) "
                "pads worlds."
            )
    return _stacked(models)


def _equal(one: Automaton, other: Automaton) -> bool:
    if one.propositions != other.propositions:
        return False
    kinds: list[PyTree] = [jax.tree.structure(x) for x in (one, other)]
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=False)
    return bool(kinds[0] == kinds[1]) and all(np.array_equal(x, y) for x, y in pairs)


def _shapes(tree: PyTree) -> list[tuple[int, ...]]:
    return [np.shape(x) for x in jax.tree.leaves(tree)]


Demonstrations = Trajectories | Sequence[Trajectories]


def _of_each_world(trajectories: Demonstrations) -> list[Trajectories]:
    """The nonempty trajectories of each model."""
    if isinstance(trajectories, Trajectories):
        stacked = np.ndim(trajectories.length) == 2
        lanes = range(len(trajectories.length)) if stacked else ()
        split = [jax.tree.map(lambda x, w=w: x[w], trajectories) for w in lanes]
        trajectories = split if stacked else [trajectories]
    parts = []
    for one in trajectories:
        rows = np.flatnonzero(np.asarray(one.length))
        parts.append(jax.tree.map(lambda x, rows=rows: np.asarray(x)[rows], one))
    return parts


def split_trajectories(
    trajectories: Demonstrations, share: float
) -> tuple[list[Trajectories], list[Trajectories]]:
    """A split of each model's trajectories: the last fraction `share` is held out."""
    if not 0 <= share < 1:
        raise ValueError(f"held_out={share}; it must be a share in [0, 1).")
    first, second = [], []
    for one in _of_each_world(trajectories):
        num_first = len(one.length) - round(share * len(one.length))
        first.append(jax.tree.map(lambda x, n=num_first: x[:n], one))
        second.append(jax.tree.map(lambda x, n=num_first: x[n:], one))
    return first, second


def demonstration_counts(
    models: Product, trajectories: Demonstrations, *, horizon: int | None = None
) -> jax.Array:
    """State-action counts ``float[W, S, Q, A]`` in each product; ``[W, T, S, Q, A]`` with a horizon T."""
    split, count = _of_each_world(trajectories), num_worlds(models)
    if len(split) != count:
        raise ValueError(f"there are demonstrations in {len(split)} worlds; expected {count}.")
    tensors = []
    for w, one in enumerate(split):
        model = unstack_product(models, w)
        shape: tuple[int, ...] = (*model.state_shape, model.num_actions)
        state, action, length = (np.asarray(x) for x in (one.state, one.action, one.length))
        if horizon is not None:
            if length.max(initial=0) > horizon:
                raise ValueError(
                    f"demonstrations in world {w}: one has {length.max()} steps; "
                    f"horizon={horizon} is shorter."
                )
            shape = (horizon, *shape)
        rows = [
            list(zip(s[:n].tolist(), a[:n].tolist(), strict=True))
            for s, a, n in zip(state, action, length, strict=True)
        ]
        size = math.prod(shape)
        counts = np.zeros(size, int)
        if rows:
            try:
                if len(one.state_shape or ()) > 1:  # smaller worlds than the stack's are no mistake
                    require_states(one, model.mdp)
                checked = make_trajectories(model.mdp, rows)
                inside = allowed_steps(model, checked)
            except ValueError as error:
                raise ValueError(f"demonstrations in world {w}: {error}") from error
            state, action = np.asarray(checked.state), np.asarray(checked.action)
            lifted = state * model.num_memory + memory_along(model, state)
            pair = lifted * model.num_actions + action
            if horizon is not None:
                pair = pair + np.arange(pair.shape[1]) * (model.num_states * model.num_actions)
            counts = np.bincount(pair[inside], minlength=size)
        tensors.append(counts.reshape(shape))
    return jax_array(np.stack(tensors).astype(models.dtype))


def stack_observations(models: Product, observation: PyTree) -> jax.Array:
    """Checked observations of the states of each model, ``float[W, S, O]``."""
    if isinstance(observation, list | tuple):
        observation = np.stack([np.asarray(x) for x in observation])
    observation = jnp.asarray(observation, models.dtype)
    if observation.ndim == 2:
        observation = observation[None]
    rows = models.letter.shape
    if observation.ndim != 3 or observation.shape[:2] != rows:
        raise ValueError(f"observation has shape {observation.shape}; expected {(*rows, 'O')}.")
    if not np.isfinite(np.asarray(observation)).all():
        w, s, _ = np.argwhere(~np.isfinite(np.asarray(observation)))[0].tolist()
        raise ValueError(f"world {w}: the observation in state {s} is not finite.")
    return cast(jax.Array, observation)


def training_counts(
    models: Product,
    demonstrations: Demonstrations,
    held_out: float | Demonstrations | None,
    *,
    horizon: int | None = None,
) -> tuple[jax.Array, jax.Array]:
    """Counts of training and of held-out trajectories, or of the last fraction `held_out`."""
    test: PyTree = held_out
    if held_out is None or isinstance(held_out, int | float):
        demonstrations, test = split_trajectories(demonstrations, held_out or 0.0)
    counts = demonstration_counts(models, demonstrations, horizon=horizon)
    if not (np.asarray(counts) > 0).any():
        raise ValueError(
            "demonstrations: no pair is left to learn from; give more, or a smaller held_out."
        )
    return counts, demonstration_counts(models, test, horizon=horizon)
