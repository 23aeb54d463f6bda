"""Named features of state-action pairs for linear rewards: Table 1, generalised to any task.

Example: one step leads to the goal.
  >>> import jaxltl as jl
  >>> from jaxltl.algos import mlirl
  >>> world = jl.from_dense([[[0, 1.0]], [[0, 1.0]]], label=[[0], [1]], propositions=["g"])
  >>> shown = jl.make_trajectories(world, [[(0, 0)]])
  >>> model = jl.product(world, "F g")
  >>> mlirl.task_features(model, shown).names, mlirl.progress_states(model)
  (('demonstrated', 'goal', 'progress', 'time'), ())
  >>> mlirl.world_features(world, shown, goal=["g"]).values[0].tolist()
  [[1.0, 1.0, 0.0, -1.0]]
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core.models import MDP, DenseMDP, Trajectories, expectation, lift_trajectories
from jaxltl.core.models.ops.array_namespace import namespace, to_jax
from jaxltl.core.models.product import Product, read_probability
from jaxltl.core.models.protocols import ActionModel, Array
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.solvers.shortest_path import expected_steps
from jaxltl.core.types import Solution
from jaxltl.core.values.engine.row_form import on_actions, row_of_action, rows_of
from jaxltl.core.values.undiscounted.acceptance import as_reachability, until_visit


def pair_counts(
    model: ActionModel, trajectories: Trajectories, counted: Array | None = None
) -> jax.Array:
    """The state-action counts ``float[S, A]`` of `trajectories` of a `model`.

    Only steps that are `counted`, ``bool[N, T]``, enter; default all.
    """
    xp, steps, counted = namespace(trajectories, trajectories.mask if counted is None else counted)
    actions = (*model.state_shape, model.num_actions)
    pair, counted = steps.state * model.num_actions + steps.action, counted.astype(model.dtype)
    flat = xp.zeros(int(np.prod(actions)), model.dtype)
    if xp is jnp:
        flat = flat.at[pair].add(counted)
    else:
        np.add.at(flat, pair, counted)
    return to_jax(flat.reshape(actions))


@brief
@dataclass(frozen=True)
class Features:
    """Features of state-action pairs.

    Attributes:
      values: ``float[S, A, F]``, in a product ``[S, Q, A, F]``.
      names: of the F features.
      remark: the reason why a feature is missing, or None.
    """

    values: jax.Array
    names: tuple[str, ...]
    remark: str | None = None


def task_features(
    model: Product,
    demonstrations: Trajectories,
    *,
    avoid: Collection[str] = (),
    progress: Sequence[int] | None = None,
    best: Solution | None = None,
) -> Features:
    """The features of Table 1 in a product, and their analogues for tasks that are not co-safe.

    ==============  ==============================================================================
    demonstrated    1 if the pair occurs in the lifted demonstrations
    goal            (co-safe) probability that the next automaton state is final
    progress        (co-safe) probability of entering an automaton state of `progress` from another
    accepting       (Buchi, parity) probability of reading a transition of the least even priority
    avoid           minus the probability that the next cell has a proposition of `avoid`
    time            (co-safe) -1
    nearer          (with `best`, not safety) decrease of the best policy's expected steps to the
                    end of the task, or to an accepting component and its next accepting visit;
                    missing, with a remark, if these exceed double precision
    ==============  ==============================================================================

    All are zero where the automaton state is final.

    Args:
      model: the product.
      demonstrations: in the world.
      avoid: propositions.
      progress: automaton states; default :func:`progress_states`.
      best: of :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction`; concrete.

    Raises:
      ValueError: an unknown state or proposition, or `progress` for a task that is not co-safe.
    """
    task = model.automaton
    if progress is not None and not task.is_cosafe:
        raise ValueError("progress belongs to co-safe tasks, which have final states.")
    chosen: tuple[int, ...] = ()
    if task.is_cosafe:
        chosen = progress_states(model) if progress is None else tuple(progress)
    for q in chosen:
        if not 0 <= q < model.num_memory:
            raise ValueError(
                f"progress: automaton state {q} does not exist; there are {model.num_memory}."
            )
    _require_known(model.mdp, avoid, "avoid")
    nearer, remark = None, None
    if best is not None and not task.is_safety:
        nearer = _nearer(model, best)
        remark = _TOO_LONG if nearer is None else None
    counts = pair_counts(model, lift_trajectories(model, demonstrations))
    values = _task_values(model, counts, nearer, avoid=tuple(avoid), progress=chosen)
    main = {"cosafe": ("goal", "progress"), "safety": ()}.get(task.acceptance, ("accepting",))
    names = ("demonstrated", *main, *(("avoid",) if avoid else ()))
    names += (("time",) if task.is_cosafe else ()) + (("nearer",) if nearer is not None else ())
    return Features(values=values, names=names, remark=remark)


_TOO_LONG = (
    "The feature nearer is left out: the best policy's expected number of steps exceeds double "
    "precision, so that the actions that decrease it are unknown."
)


def _nearer(model: Product, best: Solution) -> np.ndarray | None:
    """Decrease ``float[S, Q, A]`` of the expected steps to the goal; None if these are too many."""
    problem, lost = as_reachability(model, "max"), np.asarray(best.upper).ravel() <= 0
    reached = np.asarray(problem.target).ravel()
    sparse = rows_of(model)
    mdp, row = sparse.host, row_of_action(sparse, best.policy)
    ahead = expected_steps(mdp, row, reached | lost)
    visit_steps: np.ndarray | None = np.zeros(reached.size)
    visits = mdp
    if problem.accepting is not None:
        visits = until_visit(problem, mdp)
        visit_steps = expected_steps(
            visits, np.append(row, mdp.num_rows), np.append(~reached, True)
        )
    if ahead is None or visit_steps is None:
        return None
    inside = np.where(reached, visit_steps[: reached.size], 0)
    longest = inside.max(initial=0)  # outside of the component, a longest visit inside is added
    ahead = np.where(reached, 0, np.where(lost, ahead.max(initial=0), ahead)) + longest
    way = np.where(reached, inside, ahead)
    entered = np.where(reached, longest, ahead)
    # Differences of expected steps are rounded by about this much; the best action's one is 1.
    if not np.finfo(np.float64).eps * max(way.max(), entered.max()) < 0.1:
        return None
    next_way = visits.expectation(np.append(way, 0)[: visits.num_states])[: mdp.num_rows]
    decrease = way[mdp.state] - np.where(reached[mdp.state], next_way, mdp.expectation(entered))
    return on_actions(sparse, decrease, model).astype(model.dtype)


@partial(jax.jit, static_argnames=("avoid", "progress"))
def _task_values(
    model: Product,
    counts: jax.Array,
    nearer: jax.Array | None,
    *,
    avoid: tuple[str, ...],
    progress: tuple[int, ...],
) -> jax.Array:
    task, num_memory = model.automaton, model.num_memory
    columns = [(counts > 0).astype(model.dtype)]
    done = model.final if task.is_cosafe else jnp.zeros(model.state_shape, bool)
    regions = [_labelled(model.mdp, avoid)[:, None]] if avoid else []
    if task.is_cosafe:
        target, every = np.isin(np.arange(num_memory), progress), np.arange(num_memory)
        regions += [model.final, *(target & (every != q) for q in every)]
    entered: list[jax.Array] = []  # probabilities of each region after a step, traced once for all
    if regions:
        inside = jnp.stack([jnp.broadcast_to(x, model.state_shape) for x in regions])
        entered = list(jax.vmap(partial(expectation, model))(inside.astype(model.dtype)))
    if task.is_cosafe:
        goal, *entering = entered[-1 - num_memory :]
        columns += [goal, jnp.stack([x[:, q] for q, x in enumerate(entering)], axis=1)]
    elif not task.is_safety:
        priority = jnp.asarray(model.automaton.priority)
        even = jnp.where(priority % 2 == 0, priority, jnp.iinfo(priority.dtype).max)
        columns.append(read_probability(model, priority == jnp.min(even)))
    if avoid:
        columns.append(-entered[0])
    if task.is_cosafe:
        columns.append(-jnp.ones_like(columns[0]))
    if nearer is not None:
        columns.append(nearer)
    return _stacked(columns, done)


def world_features(
    world: MDP | DenseMDP,
    demonstrations: Trajectories,
    *,
    goal: Collection[str],
    progress: Collection[str] = (),
    avoid: Collection[str] = (),
) -> Features:
    """The features of Table 1 in a `world` without an automaton (case 1), with `demonstrations`.

    As :func:`task_features`, by the probabilities that the next cell has a proposition of `goal`,
    `progress` and `avoid`; zero in cells of `goal`.

    Raises:
      ValueError: a proposition does not exist.
    """
    for names, argument in ((goal, "goal"), (progress, "progress"), (avoid, "avoid")):
        _require_known(world, names, argument)
    counts = pair_counts(world, demonstrations)
    values = _world_values(
        world, counts, goal=tuple(goal), progress=tuple(progress), avoid=tuple(avoid)
    )
    names = ("demonstrated", "goal", "progress", *(("avoid",) if avoid else ()), "time")
    return Features(values=values, names=names)


@partial(jax.jit, static_argnames=("goal", "progress", "avoid"))
def _world_values(
    world: MDP | DenseMDP,
    counts: jax.Array,
    *,
    goal: tuple[str, ...],
    progress: tuple[str, ...],
    avoid: tuple[str, ...],
) -> jax.Array:
    columns = [
        (counts > 0).astype(world.dtype),
        expectation(world, _labelled(world, goal).astype(world.dtype)),
        expectation(world, _labelled(world, progress).astype(world.dtype)),
    ]
    if avoid:
        columns.append(-expectation(world, _labelled(world, avoid).astype(world.dtype)))
    return _stacked([*columns, -jnp.ones_like(columns[0])], _labelled(world, goal))


def _stacked(columns: list[jax.Array], done: jax.Array) -> jax.Array:
    return jnp.where(done[..., None, None], 0, jnp.stack(columns, axis=-1))


def _labelled(world: MDP | DenseMDP, names: tuple[str, ...]) -> jax.Array:
    """The states ``bool[S]`` in which any of the propositions holds."""
    return jnp.any(world.label[:, [world.propositions.index(n) for n in names]], axis=1)


def _require_known(world: MDP | DenseMDP, names: Collection[str], argument: str) -> None:
    for name in names:
        if name not in world.propositions:
            raise ValueError(
                f"{argument}: {name!r} is not a proposition of the world; "
                f"it has {', '.join(world.propositions) or '(none)'}."
            )


def progress_states(model: Product) -> tuple[int, ...]:
    """The automaton states of a `model` closer to a final state than its farthest initial one.

    Distances count letters that occur in the world; final states are excluded.
    """
    automaton = jax.tree.map(np.asarray, model.automaton)
    delta = automaton.delta[:, np.unique(np.asarray(model.letter))]
    distance = np.where(automaton.final, 0.0, np.inf)
    for _ in range(len(delta)):
        distance = np.minimum(distance, 1 + distance[delta].min(axis=1))
    starts = np.asarray(model.initial_memory)[np.asarray(model.mdp.initial) > 0]
    farthest = distance[starts][np.isfinite(distance[starts])].max(initial=0)
    return tuple(int(q) for q in np.flatnonzero((distance > 0) & (distance < farthest)))
