"""Implicit products of a model and an automaton: all pairs [S, Q], with transitions not stored.

A value on the product has the shape ``[S, Q]``; the automaton determines the memory state at which
the value of a successor is read.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import singledispatch
from typing import Generic, cast, overload

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct, validation

from jaxltl.core.automata.automaton import Automaton, letter_index, named_propositions
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.labels import distinct_rows, require_known
from jaxltl.core.logic.ltl import Formula, parse_ltl
from jaxltl.core.pretty_print import brief
from jaxltl.core.models.game import Game
from jaxltl.core.models.ops import kernels, operators
from jaxltl.core.models.ops.array_namespace import jax_array, namespace, to_jax
from jaxltl.core.models.protocols import Array, LabelledModel, SuccessorModel, World


struct.register(
    Automaton,
    arrays=("delta", "initial", "priority", "letters"),
    static=("acceptance",),
    text={"propositions": (), "state_names": ()},
)


@brief(drawn=True)
@struct.dataclass
class Product(Generic[World]):
    """Product of a model and an automaton that tracks the progress of a task.

    With ``label_on="entry"``, ``(s, q) -> (t, delta(q, L(t)))``, starting in ``delta(q_I, L(s0))``: the
    automaton reads the label of the successor. With ``label_on="exit"``,
    ``(s, q) -> (t, delta(q, L(s)))``, starting in ``q_I``: it reads the label of the current state.

    Attributes:
      mdp, automaton: the base model, and the automaton of the task.
      letter: ``int32[S]``, the letter of each state of the base model.
      label_on: ``"entry"`` or ``"exit"``; static.
      allowed: ``bool[S, Q, A]``, a restriction of the actions, or None; see
        :func:`~jaxltl.core.models.construct.restrict.with_allowed`.

    Example:
      >>> import jaxltl as jl
      >>> path = jl.make_mdp([[[1]], [[2]], [[2]]], [[[1.0]], [[1.0]], [[1.0]]], label={"a": [1]})
      >>> prod = jl.product(path, "F a")
      >>> prod.state_shape, prod.next_memory.tolist(), prod.final[1].tolist()
      ((3, 2), [[0, 1], [1, 1], [0, 1]], [False, True])
    """

    mdp: World
    automaton: Automaton
    letter: jax.Array | np.ndarray
    label_on: str = struct.field(pytree_node=False, default="entry")
    allowed: jax.Array | np.ndarray | None = None

    @property
    def num_states(self) -> int:
        """S times Q."""
        return self.mdp.num_states * self.num_memory

    @property
    def num_memory(self) -> int:
        """Q, the number of automaton states."""
        return int(self.automaton.delta.shape[-2])

    @property
    def num_actions(self) -> int:
        """A."""
        return cast(SuccessorModel, self.mdp).num_actions

    @property
    def state_shape(self) -> tuple[int, ...]:
        """The shape of a value: ``(S, Q)``."""
        return (self.mdp.num_states, self.num_memory)

    @property
    def num_successors(self) -> int:
        """K."""
        return cast(SuccessorModel, self.mdp).num_successors

    @property
    def successor_probability(self) -> Array:
        """``float[S, 1, A, K]``: the same in every memory state."""
        return cast(SuccessorModel, self.mdp).successor_probability[:, None]

    @property
    def dtype(self) -> jnp.dtype:
        """The dtype of the probabilities."""
        return self.mdp.dtype

    @property
    def available(self) -> jax.Array:
        """``bool[S, Q, A]``."""
        xp, available, allowed = namespace(cast(SuccessorModel, self.mdp).available, self.allowed)
        shape = (*self.state_shape, self.num_actions)
        available = xp.broadcast_to(available[:, None, :], shape)
        return jax_array(available if allowed is None else available & allowed)

    @property
    def next_memory(self) -> jax.Array:
        """``int32[S, Q]``: the memory state after reading the label of s in memory state q."""
        _, delta, letter = namespace(self.automaton.delta, self.letter)
        return jax_array(delta[:, letter].T)

    @property
    def initial_memory(self) -> jax.Array:
        """``int32[S]``: the initial memory state at each initial state."""
        automaton = self.automaton
        xp, start, delta, letter = namespace(automaton.initial, automaton.delta, self.letter)
        if self.label_on == "exit":
            return jax_array(xp.full(letter.shape, start, np.int32))
        return jax_array(delta[start, letter])

    @property
    def initial(self) -> jax.Array:
        """``float[S, Q]``, the initial distribution."""
        xp, world, memory = namespace(self.mdp.initial, self.initial_memory)
        starts = memory[:, None] == xp.arange(self.num_memory)
        return jax_array(xp.where(starts, world[:, None], 0).astype(self.dtype))

    @property
    def final(self) -> jax.Array:
        """``bool[S, Q]``: the final automaton states."""
        xp, automaton = namespace(self.automaton)
        final = automaton.final
        return jax_array(xp.broadcast_to(final, self.state_shape))


def occurring_letters(
    world: LabelledModel, propositions: Collection[str] | None = None
) -> list[frozenset[str]]:
    """Distinct letters of a model, for ``to_automaton``.

    Args:
      world, propositions: the model, and the propositions of the letters; default: all.

    Returns:
      Sets of propositions.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[1.0, 0]], [[0, 1.0]]], label={"a": [1]})
      >>> [sorted(letter) for letter in occurring_letters(world)]
      [[], ['a']]
    """
    keep = [
        i for i, p in enumerate(world.propositions) if propositions is None or p in propositions
    ]
    names = [world.propositions[i] for i in keep]
    rows, _ = distinct_rows(distinct_labels(world)[:, keep])
    return [frozenset(n for n, holds in zip(names, row, strict=True) if holds) for row in rows]


@overload
def product(
    world: Game, formula: Automaton | Formula | str, *, label_on: str = ...
) -> Game[Product]: ...


@overload
def product(
    world: World, formula: Automaton | Formula | str, *, label_on: str = ...
) -> Product[World]: ...


def product(
    world: LabelledModel, formula: Automaton | Formula | str, *, label_on: str = "entry"
) -> Product | Game:
    """Lazy product of a model and the automaton of a formula.

    Args:
      world: an MDP, a DenseMDP, a SparseMDP, a ShardedMDP or a Game, with concrete labels.
      formula: a formula, translated over the letters that occur in the model, or an automaton.
      label_on: ``"entry"`` or ``"exit"``, see :class:`Product`.

    Returns:
      A :class:`Product`; of a game, the :class:`~jaxltl.core.models.game.Game` on the product.

    Raises:
      ValueError: an unknown proposition in the formula, or a letter that the automaton does not have.

    Example:
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[0, 1.0]], [[0, 1.0]]], label={"goal": [1]})
      >>> product(world, "F goal").state_shape
      (2, 2)
    """
    validation.choice("label_on", label_on, ("entry", "exit"))
    if hasattr(world, "fully_observable"):
        raise ValueError(validation.unsupported_model(world))
    if isinstance(world, Game):
        model = product(world.mdp, formula, label_on=label_on)
        xp, system = namespace(world.system)
        return Game(model, to_jax(xp.broadcast_to(system[:, None], model.state_shape)))
    if isinstance(world, Product):
        raise ValueError(
            "world is a product with a task already; give its model and the conjunction of both "
            'formulas: product(world.mdp, "(F a) & (G b)").'
        )
    if isinstance(world.label, jax.core.Tracer):
        raise ValueError(
            "world has traced labels, from which no product is made; make it outside jit and vmap, "
            "and pass the product in."
        )
    automaton = formula
    if isinstance(formula, str | Formula):
        parsed = parse_ltl(formula) if isinstance(formula, str) else formula
        require_known(parsed.propositions, world.propositions, "the formula")
        automaton = to_automaton(parsed, letters=occurring_letters(world, parsed.propositions))
    if not isinstance(automaton, Automaton):
        raise ValueError(
            f"formula is {validation.shorten(formula)}; give a formula, its text, or an automaton."
        )
    names = named_propositions(automaton)
    require_known(names, world.propositions, "the formula")
    column = [world.propositions.index(p) for p in names]
    labels = distinct_labels(world)
    rows, letter = distinct_rows(labels[:, column])
    index = np.array(
        [_letter(automaton, row, int(np.argmax(letter == i))) for i, row in enumerate(rows)],
        np.int32,
    )
    return Product(
        world, to_jax(automaton), letters_by_state(world, index[letter.ravel()]), label_on
    )


@singledispatch
def distinct_labels(world: LabelledModel) -> np.ndarray:
    """``bool[S, P]``, the labels of a model; of one on a mesh the distinct ones."""
    return np.asarray(world.label)


@singledispatch
def letters_by_state(world: LabelledModel, letter: np.ndarray) -> jax.Array:
    """``int32[S]``, the letter of each state, from that of each of the :func:`distinct_labels`."""
    return jax_array(letter)


def _letter(automaton: Automaton, row: np.ndarray, state: int) -> int:
    propositions = {p for p, holds in zip(automaton.propositions, row, strict=True) if holds}
    try:
        return letter_index(automaton, propositions)
    except ValueError as error:
        raise ValueError(
            f"world state {state} shows the letter {{{', '.join(sorted(propositions))}}}, which the "
            "automaton was not built for; translate with letters=occurring_letters(world)."
        ) from error


_SELECT = 16  # memory states up to which reading at a memory is a selection


# --- the primitives -----------------------------------------------------------------------


def reads(model: Product, marked: jax.Array) -> jax.Array:
    """``bool[S, Q, A]``: choices that may make a marked transition ``bool[Q, L]`` of the automaton."""
    here = jnp.asarray(marked)[:, model.letter].T
    if model.label_on == "exit":
        return here[:, :, None] & model.available
    hit = operators.combined(model.mdp, here, kernels.positive_hits, jnp.logical_or)
    return hit & model.available


def read_probability(model: Product, marked: jax.Array) -> jax.Array:
    """Expectation ``float[S, Q, A]`` of numbers ``[Q, L]``, or a mask, on the transition of the automaton."""
    here = jnp.asarray(marked)[:, model.letter].T.astype(model.dtype)
    if model.label_on == "exit":
        return here[:, :, None] * model.available
    probability = operators.combined(model.mdp, here, jnp.multiply, jnp.add)
    return probability * model.available


def _read_at(value: jax.Array, memory: jax.Array) -> jax.Array:
    """``value[s, memory[s, q]]``; selection for few memory states avoids a transposed scatter."""
    num_memory = value.shape[1]
    if num_memory > _SELECT:
        return jnp.take_along_axis(value, memory, axis=1)
    if value.size * num_memory <= kernels.FEW:
        # In one pass, which makes smaller programs.
        here = memory.reshape(*value.shape[:2], 1) == jnp.arange(num_memory)
        here = here.reshape(here.shape + (1,) * (value.ndim - 2))
        if value.dtype == bool:
            return jnp.any(here & value[:, None], axis=2)
        return jnp.where(here, value[:, None], 0).sum(axis=2, dtype=value.dtype)
    result = jnp.broadcast_to(value[:, :1], value.shape)
    for q in range(1, num_memory):
        result = jnp.where(memory == q, value[:, q : q + 1], result)
    return result


@operators.combined.register
def _(model: Product, value: jax.Array, term: kernels.Term, combine: kernels.Term) -> jax.Array:
    # On entry the value of t is read at delta(q, L(t)), before the base operator; on exit at
    # delta(q, L(s)), after it.
    if model.label_on == "entry":
        value = _read_at(value, model.next_memory)
        result = operators.combined(model.mdp, value, term, combine)
    else:
        result = operators.combined(model.mdp, value, term, combine)
        result = _read_at(result, model.next_memory[:, :, None])
    if model.allowed is None:
        return result
    empty = kernels.dtype_max(result.dtype) if combine is jnp.minimum else 0
    return jnp.where(model.allowed, result, jnp.asarray(empty, result.dtype))


@operators.sample_successor.register
def _(model: Product, key: chex.PRNGKey, state: jax.Array, action: jax.Array) -> jax.Array:
    world, memory = state // model.num_memory, state % model.num_memory
    successor = operators.sample_successor(model.mdp, key, world, action)
    read = successor if model.label_on == "entry" else world
    memory = jnp.asarray(model.automaton.delta)[memory, model.letter[read]]
    return successor * model.num_memory + memory


@operators.flat_transitions.register
def _(model: Product) -> tuple[jax.Array, jax.Array]:
    successor, probability = operators.flat_transitions(model.mdp)
    s = jnp.arange(model.mdp.num_states)[:, None, None, None]
    q = jnp.arange(model.num_memory)[:, None, None]
    flat = flat_successor(successor[:, None], model.next_memory, s, q, model.label_on)
    shape = (model.num_states, *successor.shape[1:])
    probability = jnp.broadcast_to(probability[:, None], flat.shape)
    return flat.astype(jnp.int32).reshape(shape), probability.reshape(shape)


@operators.unpadded_states.register
def _(model: Product) -> Array:
    states: Array = operators.unpadded_states(model.mdp)
    return states if states is True else states[:, None]


@operators.greatest_predecessor.register
def _(model: Product, quantity: jax.Array) -> jax.Array:
    moves = model.next_memory[:, :, None] == jnp.arange(model.num_memory)  # [S, Q, Q']

    def moved(here: jax.Array) -> jax.Array:
        """``[S, Q']`` from ``[S, Q]``."""
        return jnp.max(jnp.where(moves, here[:, :, None], 0), axis=1)

    if model.label_on == "entry":
        return moved(operators.greatest_predecessor(model.mdp, quantity))
    quantity = jax.vmap(moved, in_axes=-1, out_axes=-1)(quantity)
    return operators.greatest_predecessor(model.mdp, quantity)


def flat_successor(
    successor: Array, next_memory: Array, s: Array, q: Array, label_on: str
) -> Array:
    """Numbers ``t * Q + q'`` of the product states that follow (s, q) when t follows s."""
    read = successor if label_on == "entry" else s
    return successor * next_memory.shape[1] + next_memory[read, q]
