"""Environments with random sequences of reach-avoid subtasks, for zero-shot generalisation.

A policy for all sequences satisfies any formula by following sequences of its automaton that lead
to acceptance (``core/automata/sequences.py``).
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import struct, validation
from jaxltl.core.validation import first_true
from jaxltl.core.environments.environment import (
    Environment,
    Timestep,
    as_array,
    make_box,
    of_world,
    optional,
    require_environment,
)
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.models.protocols import Array, Key, Numeric, PyTree
from jaxltl.core.pretty_print import brief


@brief
class Sequence(NamedTuple):
    """D reach-avoid steps over E events; `length` exceeds D if later steps are hidden."""

    reach: jax.Array
    avoid: jax.Array
    length: jax.Array


@struct.dataclass
class SequenceSampler:
    """A distribution of sequences, with traced weights; see :func:`sequence_sampler`.

    Attributes:
      length: ``float[D]``, weights of 1 to D steps.
      reach: ``float[N]``, weights of 1 to N sets of events to reach in a step.
      avoid: ``float[N]``, weights of 0 to N - 1 sets to avoid.
      sets: ``bool[G, E]``, the sets of events.

    >>> from jaxltl import environments
    >>> events = environments.make_events(["a", "b"])
    >>> sets = environments.proposition_sets(events)
    >>> sampler = environments.sequence_sampler([1, 1], [1], [1, 1], sets)
    >>> sampler.sets.shape, sampler.length.tolist()
    ((2, 3), [1.0, 1.0])
    """

    length: Array
    reach: Array
    avoid: Array
    sets: Array


@brief
class SequenceWorld(NamedTuple):
    """A state with its sequence, the number of completed steps, and the verdict."""

    world: PyTree
    sequence: Sequence
    stage: jax.Array
    verdict: jax.Array


@brief
class SequenceObservation(NamedTuple):
    """An observation of the environment, and the remaining sequence."""

    world: PyTree
    sequence: Sequence


def make_events(propositions: Ordered[str], at_most: int = 1) -> np.ndarray:
    """The labels with at most `at_most` propositions, starting with the empty one.

    Args:
      propositions, at_most: the P names, and the maximal number of true propositions.

    Returns:
      ``bool[E, P]``, NumPy's.

    Raises:
      ValueError: a repeated name, or a negative number.

    >>> make_events(["a", "b"]).astype(int).tolist()
    [[0, 0], [1, 0], [0, 1]]
    """
    width = len(validation.distinct_names("propositions", propositions))
    at_most = min(validation.integer("at_most", at_most), width)
    rows = [held for n in range(at_most + 1) for held in combinations(range(width), n)]
    events = np.zeros((len(rows), width), bool)
    for row, held in zip(events, rows, strict=True):
        row[list(held)] = True
    return events


def nearest_event(events: Array, label: Array) -> jax.Array:
    """``int32[]``: the event with the least Hamming distance to a label."""
    return jnp.argmin((events != label).sum(-1)).astype(jnp.int32)


def proposition_sets(events: ArrayLike) -> np.ndarray:
    """For each proposition, the set of the events in which it holds.

    Args:
      events: ``bool[E, P]``, as of :func:`make_events`.

    Returns:
      ``bool[P, E]``, NumPy's.

    >>> proposition_sets(make_events(["a", "b"], at_most=2)).astype(int).tolist()
    [[0, 1, 0, 1], [0, 0, 1, 1]]
    """
    return np.asarray(events, bool).T


def sequence_sampler(
    length: ArrayLike, reach: ArrayLike, avoid: ArrayLike, sets: ArrayLike
) -> SequenceSampler:
    """A checked :class:`SequenceSampler`; weights need not sum to 1.

    Args:
      length, reach, avoid: see :class:`SequenceSampler`.
      sets: ``bool[G, E]``, as of :func:`proposition_sets`; or ``bool[E]``, for sets of one event.

    Returns:
      :class:`SequenceSampler`.

    Raises:
      ValueError: negative or zero weights, an empty set, or more sets in a step than there are.

    >>> sampler = sequence_sampler([1, 1], [1], [1, 1], [False, True, True, True])
    >>> drawn = jax.jit(draw_sequence)(jax.random.key(0), sampler)
    >>> drawn.reach.shape, bool((drawn.reach & drawn.avoid).any())
    ((2, 4), False)
    """
    rows = {"length": length, "reach": reach, "avoid": avoid}
    checked = {name: validation.float_array(name, row) for name, row in rows.items()}
    for name, row in checked.items():
        if row.ndim != 1 or not (np.isfinite(row) & (row >= 0)).all() or not row.sum() > 0:
            raise ValueError(
                f"{name}={row.tolist()}; give weights of one axis, none of them "
                "negative, some of them positive."
            )
    groups = as_array(sets)
    if groups.dtype != np.bool_ or groups.ndim not in (1, 2):
        raise ValueError(
            f"sets has type {groups.dtype} and shape {list(groups.shape)}; give "
            "Booleans, a row for each set and a column for each event."
        )
    groups = np.eye(groups.size, dtype=bool)[groups] if groups.ndim == 1 else groups
    for row in first_true(~groups.any(-1)):
        raise ValueError(f"sets: row {row} has no event; leave it out.")
    num_sets = (
        int(np.flatnonzero(checked["reach"])[-1]) + 1 + int(np.flatnonzero(checked["avoid"])[-1])
    )
    if num_sets > len(groups):
        raise ValueError(
            f"reach and avoid ask for up to {num_sets} sets in a step, but there are "
            f"{len(groups)}; give fewer weights."
        )
    return SequenceSampler(checked["length"], checked["reach"], checked["avoid"], groups)


def draw_sequence(key: Key, sampler: SequenceSampler) -> Sequence:
    """A random sequence of disjoint sets to reach and to avoid in each step."""
    keys = jax.random.split(key, 4)
    depth, count = sampler.length.shape[0], sampler.sets.shape[0]
    sets = jnp.asarray(sampler.sets)

    def size(key: Key, weight: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        return jax.random.categorical(key, jnp.log(jnp.asarray(weight)), shape=shape)

    length = 1 + size(keys[0], sampler.length, ()).astype(jnp.int32)
    wanted = 1 + size(keys[1], sampler.reach, (depth, 1))
    shunned = size(keys[2], sampler.avoid, (depth, 1))
    rank = jnp.argsort(jnp.argsort(jax.random.uniform(keys[3], (depth, count)), -1), -1)
    is_within = (jnp.arange(depth) < length)[:, None]
    reach = is_within & ((rank < wanted)[..., None] & sets).any(1)
    before = jnp.concatenate([jnp.zeros_like(reach[:1]), reach[:-1]])
    chosen = (rank >= wanted) & (rank < wanted + shunned) & ~(before[:, None] & sets).any(-1)
    return Sequence(reach, is_within & (chosen[..., None] & sets).any(1) & ~reach, length)


def sequence_environment(
    environment: Environment,
    events: ArrayLike,
    sampler: SequenceSampler,
    *,
    violation: float = -1.0,
    progress: float = 0.0,
) -> Environment:
    """An environment with a random sequence of subtasks in each episode.

    The event of each state is read, that of the initial state included. An event to reach completes
    the step, and an event to avoid ends the episode, as does the last step. With T steps in all, the
    rewards are 1 for completing all, `violation`, and ``progress / T`` for each completed step.

    Args:
      environment: the environment; its rewards are replaced.
      events: ``bool[E, P]``, the labels that occur, as of :func:`make_events`.
      sampler: the distribution of sequences over these events.
      violation, progress: rewards.

    Returns:
      :class:`~jaxltl.core.environments.environment.Environment` with states :class:`SequenceWorld` and
      observations :class:`SequenceObservation`.

    Raises:
      ValueError: events or a sampler of another shape.

    >>> from jaxltl import environments, from_dense
    >>> walk = environments.model_environment(from_dense(
    ...     [[[.5, .5]], [[.5, .5]]], label=[[0], [1]], propositions=["a"]))
    >>> events = make_events(["a"])
    >>> sampler = sequence_sampler([1], [1], [1], proposition_sets(events))
    >>> drawn = sequence_environment(walk, events, sampler)
    >>> jax.eval_shape(drawn.reset, jax.random.key(0)).sequence.reach.shape  # steps, events
    (1, 2)
    """
    rows, inner = as_array(events), require_environment(environment)
    validation.instance("sampler", sampler, SequenceSampler, "one of sequence_sampler")
    count = len(inner.propositions)
    if rows.ndim != 2 or rows.dtype != np.bool_ or rows.shape[1] != count:
        raise ValueError(
            f"events has shape {list(rows.shape)} and type {rows.dtype}; give "
            f"Booleans [E, {count}], a column for each of the environment's "
            "propositions."
        )
    width = np.shape(sampler.sets)[-1]
    if width != len(rows):
        raise ValueError(
            f"the sampler is of {width} events, but {len(rows)} are given; both must "
            "be of the same events."
        )
    shape = (len(sampler.length), len(rows))
    marks, steps = make_box(0, 1, shape, bool), make_box(0, np.inf, (), np.int32)
    spaces: PyTree = Sequence(marks, marks, steps)  # type: ignore[arg-type]
    rewards = {"violation": violation, "progress": progress}
    numbers = np.array([validation.finite_number(*reward) for reward in rewards.items()])
    return replace(
        inner,
        reset=Partial(_reset, inner, rows, sampler),
        step=Partial(_step, inner, rows, numbers),
        observe=Partial(_observe, inner),
        labels=Partial(of_world, inner.labels),
        allowed=optional(of_world, inner.allowed),
        observations=SequenceObservation(inner.observations, spaces),
        starts=None,
        outcomes=None,
    )  # there are too many sequences for `starts`


def remaining(sequence: Sequence, index: Numeric) -> Sequence:
    """The sequence after `index` completed steps."""
    depth = sequence.reach.shape[-2]
    row = jnp.arange(depth) + index
    within, row = (row < depth)[:, None], jnp.minimum(row, depth - 1)
    return Sequence(
        sequence.reach[row] & within, sequence.avoid[row] & within, sequence.length - index
    )


def _read(
    inner: Environment, events: jax.Array, world: PyTree, sequence: Sequence, index: jax.Array
) -> SequenceWorld:
    """A state after reading the event of its label."""
    event = nearest_event(events, inner.labels(world))
    wanted, shunned = sequence.reach[index, event], sequence.avoid[index, event]
    after = index + wanted
    open_ = jnp.where(after == sequence.length, Verdict.SATISFIED, Verdict.UNDECIDED)
    verdict = jnp.where(shunned, Verdict.VIOLATED, open_)
    return SequenceWorld(world, sequence, after.astype(jnp.int32), verdict.astype(jnp.int32))


def _reset(
    inner: Environment, events: jax.Array, sampler: SequenceSampler, key: Key
) -> SequenceWorld:
    world_key, key = jax.random.split(key)
    state = _read(inner, events, inner.reset(world_key), draw_sequence(key, sampler), jnp.int32(0))
    # A sequence that the first event decides starts again, since an episode has at least one step.
    over = state.verdict != Verdict.UNDECIDED
    return state._replace(
        stage=jnp.where(over, 0, state.stage),
        verdict=jnp.where(over, Verdict.UNDECIDED, state.verdict).astype(jnp.int32),
    )


def _step(
    inner: Environment,
    events: jax.Array,
    numbers: jax.Array,
    state: SequenceWorld,
    action: PyTree,
    key: Key,
) -> Timestep:
    step = Timestep(*inner.step(state.world, action, key))
    after = _read(inner, events, step.world, state.sequence, state.stage)
    violation, progress = numbers
    reward = (
        (after.verdict == Verdict.SATISFIED)
        + violation * (after.verdict == Verdict.VIOLATED)
        + progress * (after.stage - state.stage) / state.sequence.length
    )
    return Timestep(
        world=after,
        reward=reward.astype(jnp.result_type(float)),
        terminated=jnp.asarray(step.terminated, bool) | (after.verdict != Verdict.UNDECIDED),
        truncated=step.truncated,
        cost=step.cost,
        discount=step.discount,
    )


def _observe(inner: Environment, state: SequenceWorld) -> SequenceObservation:
    return SequenceObservation(inner.observe(state.world), remaining(state.sequence, state.stage))
