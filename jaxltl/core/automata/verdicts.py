"""Verdicts on finite words: whether all, some or none of the continuations are accepted."""

from __future__ import annotations

import enum
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from jaxltl.core.automata.automaton import Automaton, run
from jaxltl.core.automata.runs import live_states, universal_states
from jaxltl.core.logic.ltl import Letter


class Verdict(enum.IntEnum):
    """The verdict of a finite word on its infinite continuations.

    - ``UNDECIDED``: some are accepted, and some are not.
    - ``SATISFIED``: all are accepted.
    - ``VIOLATED``: none is accepted.

    Example:
      >>> import jaxltl as jl
      >>> jl.environments.verdict(jl.automata.to_automaton("G a"), [{"a"}, set()]).name
      'VIOLATED'
    """

    UNDECIDED = 0
    SATISFIED = 1  # every continuation is accepted
    VIOLATED = 2  # none is


def verdict(automaton: Automaton, word: Iterable[Letter]) -> Verdict:
    """The verdict after a finite word, on the host.

    Args:
      automaton: the task, with any acceptance.
      word: T letters, each the collection of the propositions that hold.

    Returns:
      :class:`Verdict`.

    Raises:
      ValueError: a letter is not among the automaton's.

    Example:
      >>> from jaxltl import to_automaton
      >>> verdict(to_automaton("F a"), [set(), {"a"}]).name, verdict(to_automaton("F a"), []).name
      ('SATISFIED', 'UNDECIDED')
    """
    return Verdict(int(verdicts(automaton)[run(automaton, word)[-1]]))


def verdicts(automaton: Automaton) -> NDArray[np.int32]:
    """``int32[Q]``: the verdict in each state of an automaton."""
    table = np.full(len(automaton.delta), Verdict.UNDECIDED, np.int32)
    table[universal_states(automaton)] = Verdict.SATISFIED
    table[~live_states(automaton)] = Verdict.VIOLATED
    return table


def lasso_verdicts(automaton: Automaton) -> NDArray[np.int32]:
    """``int32[Q, L]``: the verdict, never undecided, if a letter repeats for ever from a state on."""
    delta, least = np.asarray(automaton.delta), np.asarray(automaton.priority)
    # The state after 2^n readings of one letter, and the least priority among them. After as many
    # as there are states the run is on its cycle, and as many more read all of it.
    letter = np.arange(delta.shape[1])
    for _ in range(len(delta).bit_length()):
        least = np.minimum(least, least[delta, letter])
        delta = delta[delta, letter]
    even = least[delta, letter] % 2 == 0
    return np.where(even, Verdict.SATISFIED, Verdict.VIOLATED).astype(np.int32)
