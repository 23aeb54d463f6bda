"""An automaton that runs two others side by side and accepts as the second does."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.automata.runs import align
from jaxltl.core.automata.translate import Task, as_automaton
from jaxltl.core.logic.ltl import Letter


def synchronize(memory: Task, task: Task, *, alphabet: Iterable[Letter] | None = None) -> Automaton:
    """Synchronous product of two automata, with the acceptance of the second.

    A policy with the memory of one automaton is judged by the task of another: make the product
    with this automaton, and lift the policy by :func:`lift_memory_policy`. The pair of memory state
    q1 and task state q2 is the state ``q1 * Q2 + q2``.

    Args:
      memory: Q1 states; an automaton, a formula or its text.
      task: Q2 states, likewise.
      alphabet: the letters for formulas, see `to_automaton`.

    Returns:
      An automaton of Q1 * Q2 states over the joint letters, see `align`.

    Raises:
      ValueError: there is no joint letter, or too many.

    Example:
      >>> both = synchronize("true", "F a")
      >>> both.delta.tolist(), both.final.tolist()
      ([[0, 1], [1, 1]], [False, True])
    """
    alphabet = None if alphabet is None else list(alphabet)
    first, second = align(as_automaton(memory, alphabet), as_automaton(task, alphabet))
    delta1, delta2 = np.asarray(first.delta), np.asarray(second.delta)
    num1, num2 = len(delta1), len(delta2)
    delta = delta1[:, None] * num2 + delta2[None]
    delta = delta.reshape(num1 * num2, -1)
    initial = int(first.initial) * num2 + int(second.initial)
    titles = [x.state_names or tuple(map(str, range(len(x.delta)))) for x in (first, second)]
    state_names = [f"{a} | {b}" for a in titles[0] for b in titles[1]]
    return Automaton(
        delta=delta.astype(np.int32),
        initial=np.asarray(initial, np.int32),
        priority=np.tile(np.asarray(second.priority), (num1, 1)),
        letters=second.letters,
        propositions=second.propositions,
        acceptance=second.acceptance,
        state_names=tuple(state_names),
    )
