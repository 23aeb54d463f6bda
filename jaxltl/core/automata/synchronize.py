"""An automaton that runs two others side by side and accepts as the second does."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from jaxltl.core.automata.automaton import Automaton, make_automaton
from jaxltl.core.automata.translate import to_automaton
from jaxltl.core.logic.ltl import Formula, Letter

Task = Automaton | Formula | str


# --- the memory of one automaton, judged by another -----------------------------------------


def synchronize(
    memory: Task, task: Task, *, alphabet: Iterable[Letter] | None = None
) -> Automaton:
    """An automaton that runs two others side by side and accepts as the second does.

    So a policy with the memory of one automaton is judged by the task of another: make
    the product with this automaton, and lift the policy by :func:`lift_memory`. The pair
    of memory state q1 and task state q2 is the state ``q1 * Q2 + q2``.

    Args:
      memory: Q1 states; an automaton, a formula or its text.
      task: Q2 states, likewise.
      alphabet: what formulas are translated over, see
        :func:`~jaxltl.core.automata.translate.to_automaton`.

    Returns:
      An automaton of Q1 * Q2 states over the propositions of both, whose letters are the
      pairs of letters that agree on the propositions that both have.

    Raises:
      ValueError: no two letters agree.

    Example:
      >>> both = synchronize("true", "F a")
      >>> both.delta.tolist(), both.final.tolist()
      ([[0, 1], [1, 1]], [False, True])
    """
    alphabet = None if alphabet is None else list(alphabet)
    first, second = (
        x if isinstance(x, Automaton) else to_automaton(x, letters=alphabet)
        for x in (memory, task)
    )
    names = tuple(dict.fromkeys((*first.propositions, *second.propositions)))
    rows, pairs = _joint_letters(first, second, names)
    one, two = pairs.T
    delta1, delta2 = np.asarray(first.delta), np.asarray(second.delta)
    num1, num2 = len(delta1), len(delta2)
    delta = delta1[:, one][:, None] * num2 + delta2[:, two][None]
    delta = delta.reshape(num1 * num2, -1)
    initial = int(first.initial) * num2 + int(second.initial)
    titles = [x.state_names or tuple(map(str, range(len(x.delta)))) for x in (first, second)]
    state_names = [f"{a} | {b}" for a in titles[0] for b in titles[1]]
    if second.acceptance in ("cosafe", "safety"):
        final = np.tile(np.asarray(second.final), num1)
        return make_automaton(
            delta, initial, rows, names, final=final, acceptance=second.acceptance,
            state_names=state_names,
        )
    made = make_automaton(
        delta, initial, rows, names, state_names=state_names,
        priority=np.tile(np.asarray(second.priority)[:, two], (num1, 1)),
    )
    return replace(made, acceptance=second.acceptance)


def _joint_letters(
    first: Automaton, second: Automaton, names: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """``bool[L, P]`` over `names` and ``int[L, 2]``, the letters of either that it stands for."""
    rows1, rows2 = np.asarray(first.letters), np.asarray(second.letters)
    shared = [p for p in first.propositions if p in second.propositions]
    seen1 = rows1[:, [first.propositions.index(p) for p in shared]]
    seen2 = rows2[:, [second.propositions.index(p) for p in shared]]
    pairs = np.argwhere((seen1[:, None] == seen2[None]).all(-1))
    if not len(pairs):
        raise ValueError(
            "the two automata have no letter in common; translate both over the same letters."
        )
    columns = [
        rows1[pairs[:, 0], first.propositions.index(p)] if p in first.propositions
        else rows2[pairs[:, 1], second.propositions.index(p)]
        for p in names
    ]
    rows = np.stack(columns, -1) if columns else np.zeros((len(pairs), 0), bool)
    return rows, pairs
