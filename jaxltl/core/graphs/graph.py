"""Graph operations of models, with NumPy on the host or with JAX inside ``jit``.

Concrete arrays use sparse rows (:class:`~jaxltl.core.sparse.graph.row_graph.RowGraph`) and compile
nothing; traced ones use a :class:`TracedGraph` of the primitives. The results are equal bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core import struct
from jaxltl.core.models.compiled import compiled_form
from jaxltl.core.models.construct.convert import keep_with_model
from jaxltl.core.models.game import Game
from jaxltl.core.models.mdp import DenseMDP, MDP, support
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops import kernels, operators
from jaxltl.core.models.ops.array_namespace import host_callback, is_traced, jit, to_jax
from jaxltl.core.models.ops.choices import choice_shape, choices
from jaxltl.core.models.product import Product, reads
from jaxltl.core.models.protocols import Array, Model, PyTree
from jaxltl.core.models.sparse import SparseMDP
from jaxltl.core.sparse.graph.row_graph import RowGraph, product_graph
from jaxltl.core.sparse.mdp import HostGraph
from jaxltl.core.sparse.rows import rows_from_dense, rows_from_padded


def components_by_sweeps(
    graph: PyTree, core: jax.Array, allowed: jax.Array, closed: bool
) -> tuple[jax.Array, jax.Array]:
    """Components ``int32[S]`` and inner actions ``bool[S, A]``, as ``RowGraph.components``."""
    stay = allowed & graph.available & core[..., None]

    def prune(
        carry: tuple[jax.Array, jax.Array, jax.Array],
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        stay, _, _ = carry
        label = strong_components(graph, core, stay)
        inside = (graph.least(label) == label[..., None]) & (
            -graph.least(-label) == label[..., None]
        )
        moves = stay & inside
        return moves, label, jnp.any(moves != stay)

    start = stay, jnp.zeros(core.shape, jnp.int32), jnp.bool_(True)
    if closed:
        moves, label, _ = prune(start)
        removed = graph.anywhere(jnp.any(moves != stay, axis=-1), label)
        moves = stay & ~removed[..., None]
    else:
        moves, label, _ = lax.while_loop(lambda carry: carry[2], prune, start)
    alive = jnp.any(moves, axis=-1)
    return jnp.where(alive, label, state_numbers(core.shape)), moves


def strong_components(graph: PyTree, states: jax.Array, moves: jax.Array) -> jax.Array:
    """The least state of the component of each state under some actions; itself outside of `states`."""
    number = state_numbers(states.shape)
    none = jnp.int32(number.size)

    def colour(rank: jax.Array, undecided: jax.Array) -> jax.Array:
        def grow(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            colour, _ = carry
            ahead = jnp.min(jnp.where(moves, graph.least(colour), none), axis=-1)
            new = jnp.where(undecided, jnp.minimum(colour, ahead), none)
            return new, jnp.any(new != colour)

        start = jnp.where(undecided, rank, none), jnp.bool_(True)
        return lax.while_loop(lambda carry: carry[1], grow, start)[0]

    def reached(colours: jax.Array, root: jax.Array, undecided: jax.Array) -> jax.Array:
        def grow(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            region, _ = carry
            sent = jnp.where(moves & region[..., None], (colours + 1)[..., None], 0)
            # Colours do not decrease along edges, so the greatest one that arrives is the state's
            # own, if that one arrives.
            new = region | (
                undecided & (operators.greatest_predecessor(graph.model, sent) == colours + 1)
            )
            return new, jnp.any(new != region)

        return lax.while_loop(lambda carry: carry[1], grow, (root, jnp.bool_(True)))[0]

    def body(carry: PyTree) -> PyTree:
        label, undecided, forward = carry
        rank = jnp.where(forward, number, none - 1 - number)
        colours = colour(rank, undecided)
        region = reached(colours, undecided & (colours == rank), undecided)
        root = jnp.where(forward, colours, none - 1 - colours)
        return jnp.where(region, root, label), undecided & ~region, ~forward

    label, _, _ = lax.while_loop(
        lambda carry: jnp.any(carry[1]), body, (number, states, jnp.bool_(True))
    )
    flat = label.ravel()
    least = jnp.full(flat.shape, none).at[flat].min(number.ravel())
    return least[flat].reshape(states.shape)


def state_numbers(shape: tuple[int, ...]) -> jax.Array:
    """The number of each state, ``int32[S]``."""
    return jnp.arange(math.prod(shape), dtype=jnp.int32).reshape(shape)


@dataclass(frozen=True)
class TracedGraph:
    """The operations of a RowGraph by the operators of a model, inside ``jit`` and ``vmap``."""

    model: Model

    xp = jnp

    @property
    def state_shape(self) -> tuple[int, ...]:
        return self.model.state_shape

    @property
    def available(self) -> jax.Array:
        """``bool[S, A]``, of a sparse model ``bool[R]``."""
        return choices(self.model).available

    def on_choices(self, states: jax.Array) -> jax.Array:
        """A set of states as a mask of choices: ``bool[S, 1]`` or ``bool[R]``."""
        return choices(self.model).broadcast(states)

    def exists(self, region: jax.Array) -> jax.Array:
        """Mask of choices with some successor in a region: ``bool[S, A]``; False where unavailable."""
        return self.available & operators.exists_successor(self.model, region)

    def forall(self, region: jax.Array) -> jax.Array:
        """Mask of choices with all successors in a region: ``bool[S, A]``; True where unavailable."""
        return ~self.exists(~region)

    def least(self, value: jax.Array) -> jax.Array:
        """The smallest value among the successors: ``[S, A]``; the dtype's largest without any."""
        least = operators.least_successor(self.model, value)
        return jnp.where(self.available, least, kernels.dtype_max(value.dtype))

    def reads(self, marked: jax.Array) -> jax.Array:
        """Mask of actions that may read a marked transition of the automaton: ``bool[S, Q, A]``."""
        return self.available & reads(cast(Product, self.model), marked)

    def first(self, mask: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mask of states with an action in a mask ``bool[S, A]``, and the first such action (or 0)."""
        return choices(self.model).first(mask)

    def attract(
        self, goal: Array, allowed: Array, rule: Array, among: Array, chance: str
    ) -> PyTree:
        """Region, action and rank of an attractor."""
        return _sweeps(self, goal, allowed & self.available, rule, among, chance=chance)

    def components(self, core: Array, allowed: Array, closed: bool) -> tuple[Array, Array]:
        """The components of a RowGraph, by a callback; by sweeps for a model over a mesh."""
        if is_sharded(self.model):
            return components_by_sweeps(self, core, allowed, closed)
        shape, flat = self.state_shape, int(np.prod(self.state_shape))
        shapes = (
            jax.ShapeDtypeStruct(shape, jnp.int32),
            jax.ShapeDtypeStruct(choice_shape(self.model), jnp.bool_),
        )

        def host(model: Model, core: Array, allowed: Array) -> PyTree:
            return graph_of(model).components(core, allowed, closed)

        def callback() -> PyTree:
            return host_callback(host, shapes, self.model, core, allowed)

        def trivial() -> PyTree:
            number = jnp.arange(flat, dtype=jnp.int32).reshape(shape)
            return number, jnp.zeros(shapes[1].shape, bool)

        result: tuple[Array, Array] = lax.cond(core.any(), callback, trivial)
        return result

    def anywhere(self, mark: jax.Array, component: jax.Array) -> jax.Array:
        """Mask of states with a marked state in their component: ``bool[S]``."""
        label = component.ravel()
        return jnp.zeros(label.size, bool).at[label].max(mark.ravel())[component]

    def repeat(self, body: Callable[[PyTree], PyTree], start: PyTree) -> PyTree:
        """Repeats `body` while the last entry of the carry is true."""
        return lax.while_loop(lambda carry: carry[-1], body, start)

    def times(self, count: Array, body: Callable[..., PyTree], start: PyTree) -> PyTree:
        """``body(i, carry)`` for i below a count."""
        return lax.fori_loop(0, count, body, start)


struct.register(TracedGraph, ["model"])

Result = TypeVar("Result")
Graph: TypeAlias = Any  # a RowGraph with NumPy's arrays, or a TracedGraph with JAX's


@jit("chance")
def _sweeps(
    graph: TracedGraph, goal: Array, allowed: Array, rule: Array, among: Array, *, chance: str
) -> PyTree:
    leads = graph.exists if chance == "some" else graph.forall

    def body(carry: PyTree) -> PyTree:
        region, action, rank, _, n = carry
        hit = allowed & leads(region)
        some, first = graph.first(hit)
        joins = jnp.where(rule, some, ~graph.first(allowed & ~hit)[0])
        new = joins & among & ~region
        # If all actions lead nearer, the first one is taken.
        action = jnp.where(new, jnp.where(rule, first, graph.first(allowed)[1]), action)
        return region | new, action, jnp.where(new, n + 1, rank), new.any(), n + 1

    _, first = graph.first(graph.available)
    start = (goal, first, jnp.zeros_like(first), jnp.bool_(True), jnp.int32(0))
    return lax.while_loop(lambda carry: carry[3], body, start)[:3]


def graph_of(model: Model, *arguments: PyTree) -> Graph:
    """The graph of a model: the host's, unless the model or an argument is traced."""
    if isinstance(model, Product) and isinstance(model.mdp, Game):
        raise ValueError(
            "the model is a Product around a Game; product(game, formula) is a Game on a Product."
        )
    world = model.mdp if isinstance(model, Game) else model
    if isinstance(world, SparseMDP):
        if not is_traced((model, arguments)):
            return RowGraph(world.host, world.state_shape, np.ones(world.num_rows, bool))
        model = compiled_form(model)[0]
    if is_traced((model, arguments)) or not is_table(model):
        return TracedGraph(lax.stop_gradient(model))  # supports have no derivative
    lazy = model.mdp if isinstance(model, Game) else model
    return host_graph(cast(MDP | DenseMDP | Product, lazy))


def is_table(model: Model) -> bool:
    """True for an MDP or DenseMDP, or a product or game of one."""
    lazy = model.mdp if isinstance(model, Game) else model
    world = lazy.mdp if isinstance(lazy, Product) else lazy
    return isinstance(world, MDP | DenseMDP)


@keep_with_model
def host_graph(model: MDP | DenseMDP | Product) -> RowGraph:
    """The graph of a concrete padded model; unavailable actions are not read."""
    world = model.mdp if isinstance(model, Product) else model
    available, used = np.asarray(world.available), support(world)
    if isinstance(world, DenseMDP):
        rows = rows_from_dense(used)
    else:
        rows = rows_from_padded(np.asarray(world.successor), used, world.num_states)
    row_start = np.arange(0, available.size + 1, available.shape[1])
    host = HostGraph(row_start, rows.entry_start, rows.successor)
    if not isinstance(model, Product):
        return RowGraph(host, world.state_shape, available)
    letter = np.asarray(model.letter)
    return product_graph(
        host,
        available,
        np.asarray(model.automaton.delta)[:, letter].T,
        letter,
        on_entry=model.label_on == "entry",
        allowed=None if model.allowed is None else np.asarray(model.allowed),
    )


def on_graph(function: Callable[..., Result], model: Model, *arguments: PyTree) -> Result:
    """``function(graph, *arguments)`` for the graph of a model, as JAX's arrays."""
    graph = graph_of(model, arguments)
    result: Result = to_jax(function(graph, *take(graph, arguments)))
    return result


def take(graph: Graph, tree: PyTree) -> PyTree:
    """A tree with the arrays of a graph's namespace."""
    return jax.tree.map(graph.xp.asarray, tree)
