"""Questions about so many steps, or so much reward: sweeps over sparse rows, with their rounding.

Sums of what is not negative have small relative errors however many there are, so n sweeps are
enclosed in advance: each product and sum adds less than a unit of rounding to the relative error.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.choice_order import Choices, choices_of
from jaxltl.core.sparse.graph.qualitative import reaching
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import distinct, spans

UNDERFLOW = 1e-300  # more than all that is lost where numbers are too small
_HUGE = 1e150
_MANY = 32  # steps from which it pays to leave out the states that these do not lead to the target


class Steps(NamedTuple):
    """What some sweeps found.

    Attributes:
      value: ``float64[S]``.
      error: ``float64[S]``, how far that may be off.
      row: ``int32[S]``, the first choices; ``int32[n, S]`` if all are asked for.
      num_steps: sweeps that were done until nothing changed.
    """

    value: Floats
    error: Floats
    row: Integers
    num_steps: int


def backup_unit(mdp: HostMDP) -> float:
    """The relative rounding of one backup, and by how much its row may miss one."""
    width = int(np.diff(mdp.entry_start).max(initial=1))
    return (2 * width + 6) * float(np.finfo(np.float64).eps)


def relative_error(unit: float, num_steps: int) -> float:
    """The relative error of so many backups of what is not negative; huge if they are too many."""
    total = unit * num_steps
    return total / (1 - total) if total < 0.5 else _HUGE


class Backup(NamedTuple):
    """``x -> opt (cost + P x)`` over the choices of N states, the other states being zero.

    Attributes:
      matrix: ``P``, SciPy's sparse ``float64[R', N]``.
      taken: the same with the columns of all states, ``float64[R', S]``.
      choices: the order of the states and of their choices.
      row: ``int[R']``, the model's rows, in that order.
      places: ``int[N]``, the states.
      operation: ``np.maximum`` or ``np.minimum``.
    """

    matrix: Any
    taken: Any
    choices: Choices
    row: Integers
    places: Integers
    operation: Any

    def best(self, quantity: Floats) -> Floats:
        """The optimum over each state's choices: ``[N]`` of a number a row."""
        return self.choices.best(quantity, self.operation)

    def first(self, quantity: Floats, best: Floats) -> Integers:
        """The model's row of each state's first best choice: ``int32[N]``."""
        return self.row[self.choices.first(quantity, best)].astype(np.int32)

    def sweeps(
        self, cost: Floats, value: Floats, num_steps: int, every: list[Integers] | None = None
    ) -> tuple[Floats, Integers, int]:
        """So many backups, fewer if nothing changes any more.

        Args:
          cost: ``float64[R']``, of the rows.
          value: ``float64[N]``, where it begins.
          num_steps: how many.
          every: takes the choices of each backup.

        Returns:
          The value, the choices of the last backup ``int32[N]`` (of none the next one's), and how
          many there were.
        """
        before, done = value, 0
        while done < num_steps:
            done += 1
            image = self.matrix @ value
            image += cost
            before, value = value, self.best(image)
            if every is not None:
                every.append(self.first(image, value))
            if np.array_equal(before, value):
                break
        image = self.matrix @ before
        image += cost
        row = self.first(image, self.best(image))
        return value, row, done


def backup_on(mdp: HostMDP, places: Integers, operation: Any) -> Backup:
    """The :class:`Backup` of some states, ascending."""
    count = np.diff(mdp.row_start)[places]
    choices = choices_of(count)
    row = spans(mdp.row_start[places], count)[choices.order]
    whole = places.size == mdp.num_states and choices.is_chain
    taken = mdp.matrix if whole else mdp.matrix[row]
    places = places[choices.states]
    matrix = taken if whole else taken[:, places]
    return Backup(matrix, taken, choices, row, places, operation)


def _policy(mdp: HostMDP, backup: Backup, row: Integers) -> Integers:
    """Choices of some states, and the first row of the others: ``int32[S]``."""
    found = mdp.row_start[:-1].astype(np.int32)
    found[backup.places] = row
    return found


def _policies(mdp: HostMDP, backup: Backup, every: list[Integers], num_steps: int) -> Integers:
    """All choices, the first step's first: ``int32[n, S]``. What came to rest goes on so."""
    found = np.tile(mdp.row_start[:-1].astype(np.int32), (num_steps, 1))
    for i in range(num_steps):
        found[num_steps - 1 - i, backup.places] = every[min(i, len(every) - 1)]
    return found


def until(
    mdp: HostMDP,
    target: Booleans,
    stay: Booleans,
    num_steps: int,
    operation: Any,
    by_step: bool = False,
) -> Steps:
    """Optimal probability of a target within so many steps, through states where one may stay.

    Args:
      mdp: the model.
      target, stay: ``bool[S]``.
      num_steps: n.
      operation: ``np.maximum`` or ``np.minimum``.
      by_step: whether the choices of all steps are asked for.
    """
    open_ = stay & ~target
    if num_steps >= _MANY:
        open_ &= _near(mdp, target, open_, num_steps)
    backup = backup_on(mdp, np.flatnonzero(open_), operation)
    cost = backup.taken @ target.astype(np.float64)
    every: list[Integers] | None = [] if by_step else None
    found, row, done = backup.sweeps(cost, np.zeros(backup.places.size), num_steps, every)
    value = target.astype(np.float64)
    value[backup.places] = found
    relative = relative_error(backup_unit(mdp), num_steps)
    error = np.where(open_ & (num_steps > 0), np.minimum(value * relative + UNDERFLOW, 1), 0)
    # What is exactly zero or one, the graph tells.
    choose_some = operation is np.maximum
    if num_steps and (open_ & (value == 0)).any():
        zero = open_ & ~_within(mdp, target, open_, num_steps, False, choose_some)
        value[zero] = error[zero] = 0
    if num_steps and (open_ & (value + error >= 1)).any():
        one = open_ & _within(mdp, target, open_, num_steps, True, choose_some)
        value[one], error[one] = 1, 0
    if every is not None:
        return Steps(value, error, _policies(mdp, backup, every, num_steps), done)
    return Steps(value, error, _policy(mdp, backup, row), done)


def _near(mdp: HostMDP, target: Booleans, open_: Booleans, num_steps: int) -> Booleans:
    """The states that some choices may lead to a target in so many steps."""
    start, pred = mdp.predecessors
    seen = target.copy()
    frontier: Integers = np.flatnonzero(target)
    for _ in range(num_steps):
        state = mdp.state[pred[spans(start[frontier], start[frontier + 1] - start[frontier])]]
        state = distinct(state, mdp.num_states)
        frontier = state[open_[state] & ~seen[state]]
        if not frontier.size:
            break
        seen[frontier] = True
    return seen


def _within(
    mdp: HostMDP,
    target: Booleans,
    open_: Booleans,
    num_steps: int,
    surely: bool,
    choose_some: bool,
) -> Booleans:
    """Whether a target is met in so many steps possibly, or surely, by some choice or by all."""
    region = target
    choose = np.logical_or if choose_some else np.logical_and
    for _ in range(num_steps):
        rows = ~mdp.support.lead_to(~region) if surely else mdp.support.lead_to(region)
        new = target | (open_ & mdp.over_choices(choose, rows))
        if (new == region).all():
            break
        region = new
    return region


def total(
    mdp: HostMDP,
    reward: Floats,
    magnitude: Floats,
    start: Floats,
    num_steps: int,
    operation: Any,
    by_step: bool = False,
) -> Steps:
    """Optimal expected reward of so many steps, and then of the state where one is.

    Args:
      mdp: the model.
      reward: ``float64[R]``, of each step.
      magnitude: ``float64[R]``, the same with absolute values of all that it is a sum of.
      start: ``float64[S]``, of the last state.
      num_steps, operation, by_step: as for :func:`until`.
    """
    backup = backup_on(mdp, np.arange(mdp.num_states), operation)
    every: list[Integers] | None = [] if by_step else None
    places = backup.places
    found, row, done = backup.sweeps(reward[backup.row], start[places], num_steps, every)
    size = found
    if (start < 0).any() or (magnitude != reward).any():
        # What rounding is relative to: the largest sum of absolute values.
        most = (
            backup
            if operation is np.maximum
            else backup_on(mdp, np.arange(mdp.num_states), np.maximum)
        )
        size = most.sweeps(magnitude[backup.row], np.abs(start)[places], num_steps)[0]
    error = size * relative_error(backup_unit(mdp), 2 * num_steps + 1) + UNDERFLOW
    some = start != 0
    some[mdp.state[magnitude > 0]] = True
    value, off = np.zeros(mdp.num_states), np.zeros(mdp.num_states)
    value[places], off[places] = found, error
    off = np.where(reaching(mdp, some), off, 0)
    if not num_steps:
        off = np.zeros_like(off)
    if every is not None:
        return Steps(value, off, _policies(mdp, backup, every, num_steps), done)
    return Steps(value, off, _policy(mdp, backup, row), done)
