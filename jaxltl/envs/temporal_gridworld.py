"""Coloured gridworlds with objects to visit in a given order (Wen 2019, section 3.5).

The colours of the 3 x 3 patch around a cell determine its kind: an object, an obstacle, or a
distractor. Cells are ``(row, column)`` from 1 at the top left, with state
``(row - 1) * columns + column - 1``.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxltl.core import struct, validation
from jaxltl.core.array_types import Key
from jaxltl.core.automata.automaton import Automaton, letter_index
from jaxltl.core.automata.translate import FormulaLike, to_automaton
from jaxltl.core.logic.labels import require_known
from jaxltl.core.logic.ltl import parse_ltl
from jaxltl.core.models import MDP, Trajectories, project_trajectories, rollout
from jaxltl.core.models.ops import operators
from jaxltl.core.models.ops.array_namespace import to_jax
from jaxltl.core.models.product import Product, product
from jaxltl.core.values.discounted.soft import soft_value
from jaxltl.core.values.undiscounted.performance import infeasible_starts
from jaxltl.envs.cell_kinds import (
    COLORS,
    OBJECTS,
    OBSTACLES,
    Counts,
    Kinds,
    Placement,
    categories,
    codes_of,
    filled,
    make_kinds,
    placed,
    plan_map,
    planned,
    stamps_of,
)
from jaxltl.envs.gridworld import gridworld

COMPLETE = "(!o2 & !o3 & !ob) U (o1 & ((!o3 & !ob) U (o2 & (!ob U o3))))"
INCOMPLETE = "(!o2 & !o3) U (o1 & ((!o3) U (o2 & F o3)))"


@struct.dataclass
class World:
    """A coloured gridworld, see :func:`make_world`.

    Attributes:
      mdp: the world as an MDP, labelled with the kinds of cells, with an initial distribution that is
        uniform over distractors.
      colors: ``int32[rows + 2 * margin, columns + 2 * margin]``, indices into ``COLORS``.
      margin: rings of coloured cells around the grid.
      shape: ``(rows, columns)``.
      kinds: the name of each kind of cell, and its number of cells of each colour in a patch.
    """

    mdp: MDP
    colors: jax.Array
    margin: int = struct.field(pytree_node=False, default=1)
    shape: tuple[int, int] = struct.field(pytree_node=False, default=(10, 10))
    kinds: Kinds = struct.field(pytree_node=False, default=())


def colored_world(
    colors: ArrayLike,
    *,
    objects: Counts = OBJECTS,
    obstacles: Counts = OBSTACLES,
    margin: int = 1,
    slip: float = 0.0,
) -> World:
    """A world from an array of `colors`.

    `objects`, `obstacles` and `margin` are as for :func:`~jaxltl.envs.cell_kinds.categories`; `slip`
    is the probability of moving sideways. ValueError if no cell is a distractor.

    >>> world = make_world({"o1": [(1, 2)]}, seed=0, shape=(4, 4))
    >>> again = colored_world(np.asarray(world.colors))
    >>> again.shape, int(again.mdp.label.sum())
    ((4, 4), 1)
    """
    kind = categories(colors, objects=objects, obstacles=obstacles, margin=margin)
    kinds = make_kinds(objects, obstacles)
    return _assemble(_blank(kind.shape, slip), np.asarray(colors), kind, kinds, margin)


def _blank(shape: Sequence[int], slip: float) -> MDP:
    rows, columns = shape
    return gridworld("\n".join(["." * columns] * rows), slip=slip)


def _assemble(
    blank: MDP, colors: np.ndarray, kind: NDArray[np.int32], kinds: Kinds, margin: int
) -> World:
    start = (kind < 0).ravel()
    if not start.any():
        raise ValueError("no cell is a distractor, so that no run can start; use a larger grid.")
    mdp = replace(
        blank,
        label=to_jax(kind.reshape(-1, 1) == np.arange(len(kinds))),
        initial=to_jax(np.asarray(start / start.sum(), blank.dtype)),
        propositions=tuple(name for name, _ in kinds),
    )
    rows, columns = kind.shape
    return World(mdp, to_jax(np.asarray(colors, np.int32)), margin, (rows, columns), kinds)


def _grid(shape: tuple[int, int], margin: int, slip: float) -> MDP:
    """A world of no kinds, of validated size."""
    validation.integer("margin", margin, least=1)
    if len(shape) != 2 or min(shape) < 1:
        raise ValueError(f"shape={tuple(shape)}; give (rows, columns), both at least 1.")
    return _blank(shape, slip)


def make_world(
    plan: Mapping[str, Sequence[tuple[int, int]]],
    seed: int | np.random.Generator,
    *,
    shape: tuple[int, int] = (10, 10),
    objects: Counts = OBJECTS,
    obstacles: Counts = OBSTACLES,
    margin: int = 1,
    slip: float = 0.0,
) -> World:
    """A world with objects and obstacles in given cells and random colours elsewhere.

    The most frequent colours of a kind come first on the cross of its patch, centre and corners (5 and
    4 cells make an X). Other cells are redrawn until exactly the planned cells are of their kind.
    ValueError for an unknown name, a cell outside the grid or used twice, or patches that conflict.

    Args:
      plan: cells ``(row, column)``, from 1, of each kind by its name.
      seed: of the random colours. The inner rings do not depend on the margin.
      shape: rows and columns.
      objects, obstacles, margin, slip: see :func:`colored_world`.

    >>> world = make_world({"o1": [(1, 2)], "ob": [(4, 3)]}, seed=0, shape=(4, 4))
    >>> world.mdp.label[1].tolist(), int(world.mdp.label.sum())
    ([True, False, False, False], 2)
    """
    kinds, blank = make_kinds(objects, obstacles), _grid(shape, margin, slip)
    kind = plan_map(plan, kinds, shape)
    colors = filled(
        np.random.default_rng(seed), planned(kind, kinds), kind, codes_of(kinds), margin
    )
    return _assemble(blank, colors, kind, kinds, margin)


def training_world(seed: int = 0, *, margin: int = 1, slip: float = 0.0) -> World:
    """The training world of figure 5a, with random colours of free cells from `seed`.

    `margin` and `slip` are as for :func:`make_world`.

    >>> training_world().mdp.label.sum(0).tolist()
    [1, 1, 1, 5]
    """
    plan = {
        "o1": [(1, 7)],
        "o2": [(7, 1)],
        "o3": [(10, 10)],
        "ob": [(4, 4), (4, 5), (4, 6), (4, 7), (10, 7)],
    }
    return make_world(plan, seed, margin=margin, slip=slip)


class _Family(NamedTuple):
    """Quantities shared by a family of random worlds."""

    blank: MDP
    kinds: Kinds
    automaton: Automaton
    step: NDArray[np.int32]  # [P + 1, Q], the memory after leaving a cell; the last row: of no kind


def random_worlds(
    seeds: Iterable[int],
    formula: FormulaLike = COMPLETE,
    *,
    num_obstacles: int = 5,
    min_distance: int = 3,
    obstacle_distance: int = 3,
    max_tries: int = 1000,
    shape: tuple[int, int] = (10, 10),
    objects: Counts = OBJECTS,
    obstacles: Counts = OBSTACLES,
    margin: int = 1,
    slip: float = 0.0,
) -> list[World]:
    """The random worlds of some seeds in which the task is satisfiable from every distractor cell.

    Args:
      seeds: one for each world, which depends on its own seed alone.
      formula: an automaton, or a formula over the kinds of cells. A cell's label is read on exit.
      num_obstacles: cells of each kind of obstacle, which may touch; each object has one.
      min_distance, obstacle_distance: of objects from objects, and of obstacles from objects, in the
        maximum norm.
      max_tries: placements to try for each world.
      shape: rows and columns.
      objects, obstacles, margin, slip: see :func:`colored_world`.

    Raises:
      ValueError: an unknown proposition, or no placement found.

    >>> worlds = random_worlds([3, 4], shape=(6, 8), num_obstacles=2)
    >>> [world.shape for world in worlds]
    [(6, 8), (6, 8)]
    """
    kinds, blank = make_kinds(objects, obstacles), _grid(shape, margin, slip)
    num_objects = len(objects)
    num_obstacles = validation.integer("num_obstacles", num_obstacles)
    automaton, step = _on_kinds(formula, kinds)
    family = _Family(blank, kinds, automaton, step)
    num_kinds = len(kinds) - num_objects
    placement = Placement(
        shape,
        (1,) * num_objects + (num_obstacles,) * num_kinds,
        (min_distance,) * num_objects + (obstacle_distance,) * num_kinds,
        num_objects,
        stamps_of(kinds),
        codes_of(kinds),
    )
    worlds = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        for _ in range(max_tries):
            layout = placed(random, placement)
            if layout is not None and _is_feasible(family, layout[1]):
                break
        else:
            raise ValueError(
                f"seed {seed}: in {max_tries} placements on {shape[0]} x {shape[1]} cells the "
                "objects had no room, or the task could not be done from every distractor cell. "
                "Use a larger grid or fewer obstacles, or check the task."
            )
        colors = filled(random, *layout, placement.codes, margin)
        worlds.append(_assemble(blank, colors, layout[1], kinds, margin))
    return worlds


def random_world(
    seed: int,
    formula: FormulaLike = COMPLETE,
    *,
    num_obstacles: int = 5,
    min_distance: int = 3,
    obstacle_distance: int = 3,
    max_tries: int = 1000,
    shape: tuple[int, int] = (10, 10),
    objects: Counts = OBJECTS,
    obstacles: Counts = OBSTACLES,
    margin: int = 1,
    slip: float = 0.0,
) -> World:
    """The random world of one `seed`; see :func:`random_worlds` for all arguments.

    Args:
      seed, formula: of the random number generator, and the task that is satisfiable.
      num_obstacles, min_distance, obstacle_distance, max_tries: of the placement.
      shape, objects, obstacles, margin, slip: of the world.

    >>> random_world(3, shape=(6, 8), num_obstacles=2).shape
    (6, 8)
    """
    (world,) = random_worlds(
        [seed],
        formula,
        num_obstacles=num_obstacles,
        min_distance=min_distance,
        obstacle_distance=obstacle_distance,
        max_tries=max_tries,
        shape=shape,
        objects=objects,
        obstacles=obstacles,
        margin=margin,
        slip=slip,
    )
    return world


def _on_kinds(formula: FormulaLike, kinds: Kinds) -> tuple[Automaton, NDArray[np.int32]]:
    """The automaton of a formula, and its transition table by cell kind ``[P + 1, Q]``."""
    names = [name for name, _ in kinds]
    if isinstance(formula, Automaton):
        automaton = formula
    else:
        parsed = parse_ltl(formula) if isinstance(formula, str) else formula
        require_known(parsed.propositions, names, "the formula")
        labels = [frozenset({n} & set(parsed.propositions)) for n in [*names, ""]]
        automaton = to_automaton(parsed, letters=list(dict.fromkeys(labels)))
    require_known(automaton.propositions, names, "the formula")
    read = [letter_index(automaton, {n} & set(automaton.propositions)) for n in [*names, ""]]
    return automaton, np.asarray(automaton.delta)[:, read].T


def _is_feasible(family: _Family, kind: NDArray[np.int32]) -> bool:
    flat, task = kind.ravel(), family.automaton
    if not task.is_cosafe:
        world = replace(
            family.blank,
            label=to_jax(flat[:, None] == np.arange(len(family.kinds))),
            initial=to_jax(flat < 0),
            propositions=tuple(name for name, _ in family.kinds),
        )
        return not np.asarray(infeasible_starts(product(world, task, label_on="exit"))).any()
    # The last row of the table is for cells without a kind, number -1.
    can = _can_finish(np.asarray(family.blank.successor), family.step[flat], np.asarray(task.final))
    return bool(can[flat < 0, int(task.initial)].all())


def _can_finish(
    successor: np.ndarray, step: np.ndarray, final: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """World and memory states from which acceptance is reachable, ``bool[S, Q]``, in NumPy for speed."""
    columns = [np.ascontiguousarray(c) for c in successor.reshape(len(successor), -1).T]
    can = np.broadcast_to(final, step.shape)
    while True:
        after = can[columns[0]]
        for c in columns[1:]:
            after |= can[c]
        after = np.take_along_axis(after, step, 1) | can
        if np.array_equal(after, can):
            return after
        can = after


def patches(world: World, radius: int = 1) -> jax.Array:
    """The colours of the patch around each cell of a `world`, ``int32[S, 2 * radius + 1, 2 * radius + 1]``.

    Raises:
      ValueError: `radius` is negative or larger than the margin.

    >>> patches(training_world())[6].tolist()  # o1 in cell (1, 7)
    [[0, 4, 0], [4, 0, 4], [0, 4, 0]]
    """
    if not 0 <= radius <= world.margin:
        raise ValueError(
            f"radius={radius}; this world shows 0 to {world.margin} cells around each. Make it "
            f"with margin={radius}."
        )
    return _patches(world.colors, *world.shape, world.margin, radius)


@partial(jax.jit, static_argnums=(1, 2, 3, 4))
def _patches(colors: jax.Array, rows: int, columns: int, margin: int, radius: int) -> jax.Array:
    around = np.arange(2 * radius + 1) + margin - radius
    down = (np.arange(rows)[:, None, None, None]) + around[:, None]
    across = np.arange(columns)[:, None, None] + around
    return colors[down, across].reshape(rows * columns, around.size, around.size)


def observations(world: World, radius: int = 1) -> jax.Array:
    """The one-hot colours of the patch of a `radius` around each cell of a `world`, ``float[S, O]``.

    ``O = (2 * radius + 1)**2 * 5``, as an image ``[2 * radius + 1, 2 * radius + 1, 5]``.

    >>> world = make_world({"o1": [(1, 2)]}, seed=0, shape=(4, 4))
    >>> observations(world, 0).shape, observations(world, 0).sum().item()
    ((16, 5), 16.0)
    """
    hot = jax.nn.one_hot(patches(world, radius), len(COLORS), dtype=world.mdp.dtype)
    return hot.reshape(hot.shape[0], -1)


def _distance(automaton: Automaton) -> jax.Array:
    """Distance to a final state in letters: ``float[Q]``, infinite after a violation."""
    delta, final = jnp.asarray(automaton.delta), jnp.asarray(automaton.final)

    def sweep(_: int, distance: jax.Array) -> jax.Array:
        return jnp.where(final, 0.0, jnp.minimum(distance, 1 + distance[delta].min(-1)))

    return jax.lax.fori_loop(0, delta.shape[0], sweep, jnp.where(final, 0.0, jnp.inf))


def is_over(model: Product) -> jax.Array:
    """The memory states of a `model` in which a co-safe task is satisfied or violated, ``bool[S, Q]``.

    >>> world = make_world({"o1": [(1, 2)]}, seed=0, shape=(4, 4))
    >>> model = product(world.mdp, "F o1", label_on="exit")
    >>> jax.jit(is_over)(model)[0].tolist()
    [False, True]
    """
    distance = _distance(model.automaton)
    return jnp.broadcast_to((distance == 0) | jnp.isinf(distance), model.state_shape)


def expert_reward(
    model: Product,
    *,
    progress: jax.Array | float = 10.0,
    failure: jax.Array | float = -10.0,
    step: jax.Array | float = -1.0,
    won: jax.Array | float = 3.0,
    lost: jax.Array | float = -3.0,
) -> jax.Array:
    """The reward of an expert, from the distance to acceptance in letters: ``float[S, Q, A]``.

    While the task is open, a step earns `progress` if the distance decreases, `failure` if it becomes
    infinite, else `step`; afterwards `won` or `lost`. `model` is the product of a world and a co-safe
    task. Differentiable in the five rewards.

    >>> world = make_world({"o1": [(1, 2)]}, seed=0, shape=(4, 4))
    >>> model = product(world.mdp, "F o1", label_on="exit")
    >>> jax.jit(expert_reward)(model)[:2, 0, 0].tolist()  # o1 is read where it is left
    [-1.0, 10.0]
    """
    dtype = model.dtype
    distance = _distance(model.automaton)
    following = distance[model.next_memory]  # [S, Q]
    reward = jnp.where(following < distance, progress, step)
    reward = jnp.where(jnp.isinf(following), failure, reward)
    reward = jnp.where(distance == 0, won, jnp.where(jnp.isinf(distance), lost, reward))
    reward = reward.astype(dtype)
    if model.label_on == "exit":
        return jnp.broadcast_to(reward[:, :, None], (*reward.shape, model.num_actions))
    return jax.vmap(partial(operators.expectation, model.mdp), in_axes=1, out_axes=1)(reward)


def expert_policy(
    model: Product,
    discount: jax.Array | float = 0.95,
    *,
    reward: jax.Array | None = None,
    method: str = "value_iteration",
    tolerance: jax.Array | float | None = None,
) -> jax.Array:
    """The soft-optimal policy (3.4), (3.5) of a `model` for a `reward`: ``float[S, Q, A]``.

    The default reward is :func:`expert_reward`. `discount`, `method` and `tolerance` are those of
    :func:`~jaxltl.core.values.discounted.soft.soft_value`; use ``"newton"`` for discounts near 1.

    >>> world = make_world({"o1": [(1, 2)]}, seed=0, shape=(4, 4))
    >>> model = product(world.mdp, "F o1", label_on="exit")
    >>> jax.eval_shape(lambda: expert_policy(model)).shape
    (16, 2, 4)
    """
    reward = expert_reward(model) if reward is None else reward
    return soft_value(model, reward, discount, method=method, tolerance=tolerance).policy


@partial(jax.jit, static_argnames=("num_trajectories", "horizon"))
def demonstrations(
    key: Key, model: Product, policy: jax.Array, num_trajectories: int, horizon: int = 100
) -> Trajectories:
    """The trajectories of a policy in the world, cut where the task is satisfied or violated.

    Args:
      key, model, policy: the random key, the product, and ``float[S, Q, A]``.
      num_trajectories, horizon: the number of trajectories and the largest number of steps; static.

    >>> world = make_world({"o1": [(1, 2)]}, seed=0, shape=(4, 4))
    >>> model = product(world.mdp, "F o1", label_on="exit")
    >>> policy = jnp.full((*model.state_shape, 4), 0.25)
    >>> runs = jax.eval_shape(
    ...     lambda key: demonstrations(key, model, policy, num_trajectories=3, horizon=5), jax.random.key(0))
    >>> runs.state.shape, runs.state_shape
    ((3, 5), (16,))
    """
    stop = is_over(model)
    runs = rollout(
        model, policy, key, num_trajectories=num_trajectories, num_steps=horizon, stop=stop
    )
    return project_trajectories(model, runs)
