"""Temporal logic on finite trajectories, for objectives and constraints of black-box optimisation.

The frequencies of the verdicts among sampled trajectories are maximised or bounded: reaching a
goal with probability .9 is ``-frequencies.satisfied <= -.9``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct, validation

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.environments.monitor import Monitor, Verdict, make_monitor, trace_verdicts
from jaxltl.core.logic.labels import require_known
from jaxltl.core.logic.ltl import Formula
from jaxltl.core.pretty_print import brief


@brief
@struct.dataclass
class FiniteTask:
    """A formula over the columns of a label matrix; see :func:`make_finite_task`.

    Attributes:
      monitor: the runtime monitor of the formula.
      letter: ``int32[2^n]``, the monitor's letter for each subset of the formula's propositions, as a
        binary number; bit i is the i-th of `columns`.
      columns: the columns of the formula's n propositions; static.
      num_columns: P, the number of columns; static.

    Example:
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

    Example:
      >>> found = VerdictFrequencies(satisfied=0.5, violated=0.25, undecided=0.25)
      >>> found.satisfied + found.undecided  # an upper bound on eventual satisfaction
      0.75
    """

    satisfied: jax.Array
    violated: jax.Array
    undecided: jax.Array


def make_finite_task(formula: Formula | str | Automaton, propositions: Sequence[str]) -> FiniteTask:
    """A formula over the columns of a label matrix; computed on the host.

    Args:
      formula: a formula, its text, or an automaton that reads every subset of its propositions.
      propositions: the names of the P columns, in order; the formula need not use all.

    Returns:
      :class:`FiniteTask`.

    Raises:
      ValueError: a proposition without a column, a name twice, or an automaton that does not read
        every subset.

    Example:
      >>> make_finite_task("!wet U dry", ["wet", "dry"]).columns
      (1, 0)
    """
    names = validation.distinct_names("propositions", propositions)
    automaton = formula if isinstance(formula, Automaton) else to_automaton(formula)
    text = "the automaton" if isinstance(formula, Automaton) else f"the formula {str(formula)!r}"
    require_known(automaton.propositions, names, text)
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


def finite_verdicts(
    task: FiniteTask, label: chex.Array, length: chex.Array | None = None
) -> jax.Array:
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
    verdict: chex.Array, axis: int | tuple[int, ...] | None = -1
) -> VerdictFrequencies:
    """Frequencies of the three verdicts among trajectories, along an axis."""
    verdict = jnp.asarray(verdict)
    order = (Verdict.SATISFIED, Verdict.VIOLATED, Verdict.UNDECIDED)
    return VerdictFrequencies(*(jnp.mean(verdict == v, axis=axis, dtype=float) for v in order))


def finite_verdict_frequencies(
    task: FiniteTask, label: chex.Array, length: chex.Array | None = None
) -> VerdictFrequencies:
    """:func:`verdict_frequencies` of the M trajectories of a batch.

    Args:
      task, label, length: as for :func:`finite_verdicts`, with ``bool[..., M, T, P]``.

    Returns:
      Arrays ``float[...]``.

    Raises:
      ValueError: as :func:`finite_verdicts`, or labels without an axis of trajectories.

    Example:
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
