"""Worlds in which a drawn sequence of what to reach and what to avoid is the task.

Who can follow any such sequence can do any formula: its automaton tells which sequences lead to
acceptance (see ``core/automata/sequences.py``). So an agent is trained on sequences that are drawn
anew with each episode, and does formulas that it never saw.
"""

from __future__ import annotations

from collections.abc import Sequence as Ordered
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.tree_util import Partial
from numpy.typing import ArrayLike

from jaxltl.core import validation
from jaxltl.core.environments.environment import (
    Environment,
    Timestep,
    make_box,
    require_environment,
)
from jaxltl.core.environments.monitor import Verdict
from jaxltl.core.pretty_print import brief


@brief
class Sequence(NamedTuple):
    """What to do, step after step; rows from `length` on are False.

    Attributes:
      reach: ``bool[D, E]``, of which events a step asks for one.
      avoid: ``bool[D, E]``, those that must not happen before it.
      length: ``int32[]``, the number of steps; more than D where later ones are not told.
    """

    reach: jax.Array
    avoid: jax.Array
    length: jax.Array


@brief
@struct.dataclass
class SequenceSampler:
    """A distribution of sequences; made by :func:`sequence_sampler`. Its numbers are traced.

    Attributes:
      length: ``float[D]``, how often there are 1 to D steps.
      reach: ``float[N]``, how often a step asks for one of 1 to N sets of events.
      avoid: ``float[N]``, how often 0 to N - 1 sets are to be avoided.
      sets: ``bool[G, E]``, the sets of events that are drawn.

    Example:
      >>> import jaxltl as jl
      >>> events = jl.environments.make_events(["a", "b"])
      >>> sampler = jl.environments.sequence_sampler([1, 1], [1], [1, 1], jl.environments.proposition_sets(events))
      >>> sampler.sets.shape, sampler.length.tolist()
      ((2, 3), [1.0, 1.0])
    """

    length: chex.Array
    reach: chex.Array
    avoid: chex.Array
    sets: chex.Array


@brief(codes={"verdict": Verdict})
class SequenceWorld(NamedTuple):
    """A world and how far its sequence has come.

    Attributes:
      world: the inner one.
      sequence: what was asked for.
      stage: ``int32[]``, the steps that are done.
      verdict: ``int32[]``, a :class:`~jaxltl.environments.Verdict`.
    """

    world: Any
    sequence: Sequence
    stage: jax.Array
    verdict: jax.Array


@brief
class SequenceObservation(NamedTuple):
    """What an agent sees of the world, and what it still has to do, the next step first."""

    world: Any
    sequence: Sequence


def make_events(propositions: Ordered[str], at_most: int = 1) -> np.ndarray:
    """The labels in which at most so many propositions hold, first that of none.

    Args:
      propositions: the P names.
      at_most: how many may hold at once.

    Returns:
      ``bool[E, P]``, NumPy's.

    Raises:
      ValueError: a name twice, or a number below 0.

    Example:
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


def nearest_event(events: chex.Array, label: chex.Array) -> jax.Array:
    """``int32[]``: which event a label is; of labels that are none, the one most like it.

    Args:
      events: ``bool[E, P]``.
      label: ``bool[P]``.
    """
    return jnp.argmin((events != label).sum(-1)).astype(jnp.int32)


def proposition_sets(events: ArrayLike) -> np.ndarray:
    """For each proposition the events in which it holds, to be drawn as sets.

    Args:
      events: ``bool[E, P]``, as of :func:`make_events`.

    Returns:
      ``bool[P, E]``, NumPy's.

    Example:
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
      sets: ``bool[G, E]``, as of :func:`proposition_sets`; or ``bool[E]``, the events that are
        drawn one by one.

    Returns:
      :class:`SequenceSampler`.

    Raises:
      ValueError: weights that are negative or all zero, an empty set, or more sets a step than
        there are.

    Example:
      >>> sampler = sequence_sampler([1, 1], [1], [1, 1], [False, True, True, True])
      >>> drawn = jax.jit(draw_sequence)(jax.random.key(0), sampler)
      >>> drawn.reach.shape, bool((drawn.reach & drawn.avoid).any())
      ((2, 4), False)
    """
    rows = {"length": length, "reach": reach, "avoid": avoid}
    found = {name: validation.float_array(name, row) for name, row in rows.items()}
    for name, row in found.items():
        if row.ndim != 1 or not (np.isfinite(row) & (row >= 0)).all() or not row.sum() > 0:
            raise ValueError(
                f"{name}={row.tolist()}; give weights of one axis, none of them "
                "negative, some of them positive."
            )
    groups = _booleans(sets)
    if groups.dtype != np.bool_ or groups.ndim not in (1, 2):
        raise ValueError(
            f"sets has type {groups.dtype} and shape {list(groups.shape)}; give "
            "Booleans, a row for each set and a column for each event."
        )
    if groups.ndim == 1:
        groups = np.eye(groups.size, dtype=bool)[groups]
    for row in np.flatnonzero(~groups.any(-1))[:1]:
        raise ValueError(f"sets: row {row} has no event; leave it out.")
    most = int(np.flatnonzero(found["reach"])[-1]) + 1 + int(np.flatnonzero(found["avoid"])[-1])
    if most > len(groups):
        raise ValueError(
            f"reach and avoid ask for up to {most} sets in a step, but there are "
            f"{len(groups)}; give fewer weights."
        )
    return SequenceSampler(found["length"], found["reach"], found["avoid"], groups)


def _booleans(table: ArrayLike) -> np.ndarray:
    try:
        return np.asarray(table)
    except ValueError:  # ragged
        return np.asarray(None)


def draw_sequence(key: chex.PRNGKey, sampler: SequenceSampler) -> Sequence:
    """A sequence: for each step some sets to reach and others to avoid, without repetition.

    Of the sets to avoid the events that are to be reached are taken out, as automata do. A set is
    left out if any of its events may have ended the step before: who has just done that step could
    not help it.
    """
    keys = jax.random.split(key, 4)
    depth, count = sampler.length.shape[0], sampler.sets.shape[0]
    sets = jnp.asarray(sampler.sets)

    def size(key: chex.PRNGKey, weight: jax.Array, shape: tuple[int, ...]) -> jax.Array:
        return jax.random.categorical(key, jnp.log(jnp.asarray(weight)), shape=shape)

    length = 1 + size(keys[0], sampler.length, ()).astype(jnp.int32)
    wanted = 1 + size(keys[1], sampler.reach, (depth, 1))
    shunned = size(keys[2], sampler.avoid, (depth, 1))
    rank = jnp.argsort(jnp.argsort(jax.random.uniform(keys[3], (depth, count)), -1), -1)
    asked = (jnp.arange(depth) < length)[:, None]
    reach = asked & ((rank < wanted)[..., None] & sets).any(1)
    before = jnp.concatenate([jnp.zeros_like(reach[:1]), reach[:-1]])
    chosen = (rank >= wanted) & (rank < wanted + shunned) & ~(before[:, None] & sets).any(-1)
    return Sequence(reach, asked & (chosen[..., None] & sets).any(1) & ~reach, length)


def sequence_environment(
    environment: Environment,
    events: ArrayLike,
    sampler: SequenceSampler,
    *,
    violation: float = -1.0,
    progress: float = 0.0,
) -> Environment:
    """A world in which each episode's task is a sequence that is drawn at its start.

    The event of the first world is read at once, then that of each world that is entered. One of
    the step's events to reach makes the next step the current one; one to avoid ends the episode,
    as does the last step's. With T steps in all, the rewards are 1 for doing all, `violation`, and
    ``progress / T`` for each step that is done.

    Args:
      environment: the inner world, whose rewards do not count.
      events: ``bool[E, P]``, the labels that occur, as of :func:`make_events`.
      sampler: of sequences over these events.
      violation, progress: rewards.

    Returns:
      An :class:`~jaxltl.core.environments.environment.Environment` of worlds :class:`SequenceWorld` and
      observations :class:`SequenceObservation`.

    Raises:
      ValueError: events or a sampler that do not fit.

    Example:
      >>> import jaxltl as jl
      >>> coin = jl.make_environment(
      ...     lambda key: jnp.int32(0), lambda world, action, key: jl.environments.Timestep(action, 0.0, False),
      ...     lambda world: world[None], actions=2,
      ...     labels=lambda world: world == jnp.array([1]), propositions=["a"])
      >>> events = make_events(["a"])
      >>> drawn = sequence_environment(
      ...     coin, events, sequence_sampler([1], [1], [1], proposition_sets(events)))
      >>> jax.eval_shape(drawn.reset, jax.random.key(0)).sequence.reach.shape  # steps, events
      (1, 2)
    """
    rows, inner = _booleans(events), require_environment(environment)
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
    told: Any = Sequence(marks, marks, steps)  # type: ignore[arg-type]
    numbers = np.array(
        [
            validation.finite_number("violation", violation),
            validation.finite_number("progress", progress),
        ]
    )
    return replace(
        inner,
        reset=Partial(_reset, inner, rows, sampler),
        step=Partial(_step, inner, rows, numbers),
        observe=Partial(_observe, inner),
        labels=Partial(_labels, inner),
        allowed=None if inner.allowed is None else Partial(_allowed, inner),
        observations=SequenceObservation(inner.observations, told),
        starts=None,
        outcomes=None,
    )  # so many sequences are drawn that they are not told


def remaining(sequence: Sequence, index: chex.Numeric) -> Sequence:
    """What is left of a sequence when `index` steps are done, the next one first."""
    depth = sequence.reach.shape[-2]
    row = jnp.arange(depth) + index
    kept, row = (row < depth)[:, None], jnp.minimum(row, depth - 1)
    return Sequence(sequence.reach[row] & kept, sequence.avoid[row] & kept, sequence.length - index)


def _read(
    inner: Environment, events: jax.Array, world: Any, sequence: Sequence, index: jax.Array
) -> SequenceWorld:
    """A world, once its event is read."""
    event = nearest_event(events, inner.labels(world))
    wanted, shunned = sequence.reach[index, event], sequence.avoid[index, event]
    after = index + wanted
    verdict = jnp.where(
        shunned,
        Verdict.VIOLATED,
        jnp.where(after == sequence.length, Verdict.SATISFIED, Verdict.UNDECIDED),
    )
    return SequenceWorld(world, sequence, after.astype(jnp.int32), verdict.astype(jnp.int32))


def _reset(
    inner: Environment, events: jax.Array, sampler: SequenceSampler, key: chex.PRNGKey
) -> SequenceWorld:
    world_key, key = jax.random.split(key)
    drawn = draw_sequence(key, sampler)
    found = _read(inner, events, inner.reset(world_key), drawn, jnp.int32(0))
    # An episode has a first step: what is over at once is asked for again.
    over = found.verdict != Verdict.UNDECIDED
    return found._replace(
        stage=jnp.where(over, 0, found.stage),
        verdict=jnp.where(over, Verdict.UNDECIDED, found.verdict).astype(jnp.int32),
    )


def _step(
    inner: Environment,
    events: jax.Array,
    numbers: jax.Array,
    state: SequenceWorld,
    action: Any,
    key: chex.PRNGKey,
) -> Timestep:
    found = Timestep(*inner.step(state.world, action, key))
    after = _read(inner, events, found.world, state.sequence, state.stage)
    violation, progress = numbers
    reward = (
        (after.verdict == Verdict.SATISFIED)
        + violation * (after.verdict == Verdict.VIOLATED)
        + progress * (after.stage - state.stage) / state.sequence.length
    )
    decided = after.verdict != Verdict.UNDECIDED
    return Timestep(
        world=after,
        reward=reward.astype(jnp.result_type(float)),
        terminated=jnp.asarray(found.terminated, bool) | decided,
        truncated=found.truncated,
        cost=found.cost,
        discount=found.discount,
    )


def _observe(inner: Environment, state: SequenceWorld) -> SequenceObservation:
    return SequenceObservation(inner.observe(state.world), remaining(state.sequence, state.stage))


def _labels(inner: Environment, state: SequenceWorld) -> jax.Array:
    return inner.labels(state.world)


def _allowed(inner: Environment, state: SequenceWorld) -> jax.Array:
    assert inner.allowed is not None
    return inner.allowed(state.world)
