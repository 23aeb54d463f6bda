"""Three-valued verdicts on finite traces: satisfied, violated or undecided.

A verdict is decided if all infinite continuations agree (Bauer, Leucker & Schallhart 2011, "Runtime
verification for LTL and TLTL"). The letter of a terminal state repeats for ever, so that
`accepts_lasso` decides its trace; a truncated trace stays undecided.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from jaxltl.core import struct, validation
from jaxltl.core.automata import Automaton, to_automaton
from jaxltl.core.automata.automaton import MAX_FREE_PROPOSITIONS, named_propositions
from jaxltl.core.automata.runs import (
    Verdict as Verdict,
    lasso_verdicts as lasso_verdicts,
    verdict as verdict,
    verdicts as verdicts,
)
from jaxltl.core.logic.labels import require_known
from jaxltl.core.logic.ltl import Formula, parse_ltl
from jaxltl.core.models.protocols import Array
from jaxltl.core.pretty_print import brief


@brief
@struct.dataclass
class Monitor:
    """A runtime monitor: an automaton with a verdict in each state.

    Attributes:
      delta: ``int32[Q, L]``, the successor state by letter number, as in ``Product.letter``.
      initial: ``int32``, the state before the first letter.
      verdict: ``int32[Q]``, the :class:`Verdict` in each state.

    >>> from jaxltl import to_automaton
    >>> monitor = make_monitor(to_automaton("F a"))
    >>> monitor.delta.tolist(), monitor.verdict.tolist()
    ([[0, 1], [1, 1]], [0, 1])
    """

    delta: jax.Array
    initial: jax.Array
    verdict: jax.Array


def make_monitor(automaton: Automaton) -> Monitor:
    """The monitor of an automaton, with any acceptance; computed on the host.

    Args:
      automaton: the task.

    Returns:
      :class:`Monitor`, for :func:`monitor_step`.

    >>> from jaxltl import to_automaton
    >>> make_monitor(to_automaton("G a")).verdict.tolist()
    [0, 2]
    """
    return Monitor(
        delta=jnp.asarray(automaton.delta, jnp.int32),
        initial=jnp.asarray(automaton.initial, jnp.int32),
        verdict=jnp.asarray(verdicts(automaton)),
    )


def monitor_step(monitor: Monitor, state: Array, letter: Array) -> jax.Array:
    """The state after reading one letter, for ``jit``, ``vmap`` and ``scan``.

    Args:
      monitor: from :func:`make_monitor`.
      state: ``int32[...]``; start with ``monitor.initial``.
      letter: ``int[...]`` in 0..L-1, of a shape that broadcasts with the state's.

    Returns:
      ``int32[...]``; its verdict is ``monitor.verdict[state]``. Integers: there is no derivative.

    Raises:
      TypeError: letters that are not integers, such as a row of booleans.

    >>> from jaxltl import to_automaton
    >>> monitor = make_monitor(to_automaton("F a"))
    >>> monitor_step(monitor, monitor.initial, jnp.array([0, 1])).tolist()
    [0, 1]
    """
    _check_integers(letter, "monitor_step: letter")
    return monitor.delta[state, letter]


def monitor_verdict(monitor: Monitor, state: Array) -> jax.Array:
    """The verdict in given states of a monitor, for ``jit``, ``vmap`` and ``scan``.

    Args:
      monitor, state: as for :func:`monitor_step`.

    Returns:
      ``int32[...]``, of :class:`Verdict`. Integers: there is no derivative.

    >>> from jaxltl import to_automaton
    >>> Verdict(int(monitor_verdict(make_monitor(to_automaton("true")), 0))).name
    'SATISFIED'
    """
    return monitor.verdict[state]


def trace_verdicts(monitor: Monitor, letters: Array, length: Array | None = None) -> jax.Array:
    """The verdict after each prefix of traces, the empty one first.

    A decided verdict never changes, and padding after `length` letters is not read.

    Args:
      monitor: from :func:`make_monitor`.
      letters: ``int[..., T]`` in 0..L-1 as far as `length` reaches.
      length: ``int[...]``, the number of letters of each trace; default: T.

    Returns:
      ``int32[..., T + 1]``. Integers: there is no derivative.

    Raises:
      TypeError: letters or lengths that are not integers.
      ValueError: a concrete letter or length out of range.

    >>> from jaxltl import to_automaton
    >>> trace_verdicts(make_monitor(to_automaton("F a")), [[0, 1, 0], [0, 1, 1]], [3, 1]).tolist()
    [[0, 0, 1, 1], [0, 0, 0, 0]]
    """
    letters = jnp.asarray(letters)
    if letters.ndim == 0:
        raise ValueError("trace_verdicts: letters is one number. Pass an array [..., T].")
    steps = letters.shape[-1]
    if letters.size == 0:  # an empty list has no integer type
        letters = letters.astype(jnp.int32)
    length = jnp.asarray(steps if length is None else length)
    _check_integers(letters, "trace_verdicts: letters")
    _check_integers(length, "trace_verdicts: length")
    if length.shape not in ((), letters.shape[:-1]):
        raise ValueError(
            f"trace_verdicts: length has shape {length.shape} for letters of shape "
            f"{letters.shape}. Pass one number, or shape {letters.shape[:-1]}."
        )
    counts = jnp.broadcast_to(jnp.arange(steps) < length[..., None], letters.shape)
    _check_range(monitor, letters, length, counts)
    return cast(jax.Array, _scan(monitor, letters, counts))


@jax.jit  # so that calls outside of jit share one compilation
def _scan(monitor: Monitor, letters: jax.Array, counts: jax.Array) -> jax.Array:
    def step(state: jax.Array, read: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        letter, inside = read
        state = jnp.where(inside, monitor_step(monitor, state, letter), state)
        return state, monitor_verdict(monitor, state)

    start = jnp.broadcast_to(monitor.initial, letters.shape[:-1])
    _, rest = jax.lax.scan(step, start, (jnp.moveaxis(letters, -1, 0), jnp.moveaxis(counts, -1, 0)))
    first = monitor_verdict(monitor, start)[..., None]
    return jnp.concatenate([first, jnp.moveaxis(rest, 0, -1)], axis=-1)


def _check_integers(array: Array, place: str) -> None:
    dtype = jnp.asarray(array).dtype
    if not jnp.issubdtype(dtype, jnp.integer):
        raise TypeError(
            f"{place} has type {dtype}. Pass integers; letters are indices into the automaton's "
            "letters (letter_index gives one, Product.letter those of a world)."
        )


def _check_range(
    monitor: Monitor, letters: jax.Array, length: jax.Array, counts: jax.Array
) -> None:
    """Raises ValueError for letters and lengths out of range, which indexing would clip."""
    if any(isinstance(x, jax.core.Tracer) for x in (monitor.delta, letters, length, counts)):
        return
    steps, width = letters.shape[-1], monitor.delta.shape[-1]
    lengths = np.asarray(length)
    for wrong in lengths[(lengths < 0) | (lengths > steps)][:1]:
        raise ValueError(
            f"trace_verdicts: length {wrong} with {steps} letters. Pass one of 0..{steps}."
        )
    read = np.asarray(letters)
    for place in np.argwhere(((read < 0) | (read >= width)) & np.asarray(counts))[:1].tolist():
        raise ValueError(
            f"trace_verdicts: letters{place} = {read[tuple(place)]} is no letter. "
            f"The automaton has the letters 0..{width - 1}."
        )


# --- finite trajectories -----------------------------------------------------------------------


@struct.dataclass
class FiniteTask:
    """A formula over the columns of a label matrix; see :func:`make_finite_task`.

    Attributes:
      monitor: the runtime monitor of the formula.
      letter: ``int32[2^n]``, the monitor's letter for each subset of the formula's propositions, as a
        binary number; bit i is the i-th of `columns`.
      columns: the columns of the formula's n propositions; static.
      num_columns: P, the number of columns; static.

    >>> task = make_finite_task("!wet U dry", ["wet", "dry"])
    >>> task.num_columns, task.letter.tolist()
    (2, [0, 1, 2, 3])
    """

    monitor: Monitor
    letter: jax.Array
    columns: tuple[int, ...] = struct.field(pytree_node=False)
    num_columns: int = struct.field(pytree_node=False)


@brief
class VerdictFrequencies(NamedTuple):
    """Frequencies of the verdicts among trajectories; their sum is 1.

    Attributes:
      satisfied, violated, undecided: ``float[...]``.

    >>> found = VerdictFrequencies(satisfied=0.5, violated=0.25, undecided=0.25)
    >>> found.satisfied + found.undecided  # an upper bound on eventual satisfaction
    0.75
    """

    satisfied: jax.Array
    violated: jax.Array
    undecided: jax.Array


def automaton_of_any_labels(formula: Formula | str | Automaton) -> Automaton:
    """The automaton that reads every set of the propositions of a formula; an automaton as it is.

    Raises:
      ValueError: a formula of more than 12 propositions.

    >>> automaton_of_any_labels("a U b").letters.shape
    (4, 2)
    """
    if isinstance(formula, Automaton):
        return formula
    parsed = parse_ltl(formula) if isinstance(formula, str) else formula
    names = parsed.propositions if isinstance(parsed, Formula) else ()
    if len(names) > MAX_FREE_PROPOSITIONS:
        raise ValueError(
            f"the formula has {len(names)} propositions, and the limit is {MAX_FREE_PROPOSITIONS} where "
            f"trajectories may have any labels, since all 2^{len(names)} sets of them are read. Let the "
            "environment label what the formula says of several, such as one proposition for 'c1 | c2'."
        )
    return to_automaton(formula)


def make_finite_task(formula: Formula | str | Automaton, propositions: Sequence[str]) -> FiniteTask:
    """A formula over the columns of a label matrix; computed on the host.

    Args:
      formula: a formula, its text, or an automaton that reads every subset of its propositions.
      propositions: the names of the P columns, in order; the formula need not use all.

    Returns:
      :class:`FiniteTask`.

    Raises:
      ValueError: a proposition without a column, a name twice, over 12 propositions, or an automaton that
        does not read every subset.

    >>> make_finite_task("!wet U dry", ["wet", "dry"]).columns
    (1, 0)
    """
    names = validation.distinct_names("propositions", propositions)
    automaton = automaton_of_any_labels(formula)
    text = "the automaton" if isinstance(formula, Automaton) else f"the formula {str(formula)!r}"
    require_known(named_propositions(automaton), names, text)
    count = len(automaton.propositions)
    code = np.asarray(automaton.letters) @ (1 << np.arange(count))
    missing = np.setdiff1d(np.arange(1 << count), code)
    if missing.size:
        holds = [p for i, p in enumerate(automaton.propositions) if missing[0] >> i & 1]
        raise ValueError(
            f"{text} does not read the letter {{{', '.join(holds)}}}. Trajectories may have any "
            "labels: make it with all letters, as to_automaton does by default."
        )
    letter = np.empty(1 << count, np.int32)
    letter[code] = np.arange(len(code))
    columns = tuple(names.index(p) for p in automaton.propositions)
    return FiniteTask(make_monitor(automaton), jnp.asarray(letter), columns, len(names))


def finite_verdicts(task: FiniteTask, label: Array, length: Array | None = None) -> jax.Array:
    """The verdict of each trajectory at its end."""
    label = jnp.asarray(label)
    if label.dtype != bool or label.ndim < 2 or label.shape[-1] != task.num_columns:
        raise ValueError(
            f"labels have shape {list(label.shape)} and type {label.dtype}; give booleans "
            f"[..., T, {task.num_columns}], a column for each proposition of the task."
        )
    code = jnp.zeros(label.shape[:-1], jnp.int32)
    for i, column in enumerate(task.columns):
        code |= label[..., column].astype(jnp.int32) << i
    return trace_verdicts(task.monitor, task.letter[code], length)[..., -1]


def verdict_frequencies(
    verdict: Array, axis: int | tuple[int, ...] | None = -1
) -> VerdictFrequencies:
    """Frequencies of the three verdicts among trajectories, along an axis."""
    verdict = jnp.asarray(verdict)
    order = (Verdict.SATISFIED, Verdict.VIOLATED, Verdict.UNDECIDED)
    return VerdictFrequencies(*(jnp.mean(verdict == v, axis=axis, dtype=float) for v in order))


def finite_verdict_frequencies(
    task: FiniteTask, label: Array, length: Array | None = None
) -> VerdictFrequencies:
    """:func:`verdict_frequencies` of the M trajectories of a batch.

    Args:
      task, label, length: as for :func:`finite_verdicts`, with ``bool[..., M, T, P]``.

    Returns:
      Arrays ``float[...]``.

    Raises:
      ValueError: as :func:`finite_verdicts`, or labels without an axis of trajectories.

    >>> task = make_finite_task("F dry", ["wet", "dry"])
    >>> float(finite_verdict_frequencies(task, jnp.array([[[0, 1]], [[1, 0]]], bool)).satisfied)
    0.5
    """
    if jnp.ndim(label) < 3:
        raise ValueError(
            f"labels have shape {list(jnp.shape(label))}; give [..., M, T, P], with an axis of "
            "trajectories."
        )
    return verdict_frequencies(finite_verdicts(task, label, length))
