"""Certified reachability probabilities on small concrete models, by elimination.

A first answer takes milliseconds, and it does not matter how slowly a policy makes progress. What
is solved is proven by one application of the operator, with the rounding of the proof.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

DENSE_LIMIT = 1024  # states up to which matrices are dense
_MAX_ROUNDS = 200
_NOISE = 1e-11  # relative gain that may be rounding
_SMALL = 1e-8  # and one with which bounds are still worth a try
_PATIENCE = 3  # rounds with no more than that
_LOSSES = (1e-12, 1e-9, 1e-6, np.inf)

Floats = NDArray[np.float64]
Booleans = NDArray[np.bool_]
Integers = NDArray[np.integer[Any]]


class Bounds(NamedTuple):
    """A proven enclosure.

    Attributes:
      value, lower, upper: ``float64[N]``.
      residual: how far the value is from satisfying its equation.
      rounds: systems solved.
      action: ``int[N]``, of an optimum: where `exits`, the action that attains it.
      exits: ``bool[N]``, the undecided states that choose: in an end component those that leave.
    """

    value: Floats
    lower: Floats
    upper: Floats
    residual: float
    rounds: int
    action: Integers
    exits: Booleans


def transition_rows(
    successor: NDArray[Any] | None, weight: NDArray[Any], memory: Integers, on_entry: bool
) -> list[Any]:
    """Transition matrices of a model beside a memory, ``float64[N, N]`` for each action.

    Sparse ones (SciPy's) beyond 1024 states.

    Args:
      successor: ``int[S, A, K]``, or None where every state is one.
      weight: ``float[S, A, K]``, zero where unavailable.
      memory: ``int[S, Q]``, the memory after reading the label of a world state.
      on_entry: whether the label that is read is that of the state entered.
    """
    num_states, num_actions, _ = weight.shape
    num_memory = memory.shape[1]
    s, a, k = np.nonzero(weight)
    target = k if successor is None else successor[s, a, k]
    after = memory[target if on_entry else s]  # [T, Q]
    source = s[:, None] * num_memory + np.arange(num_memory)
    size = num_states * num_memory
    column = target[:, None] * num_memory + after
    entries = np.broadcast_to(weight[s, a, k][:, None].astype(float), column.shape)
    if size <= DENSE_LIMIT:
        rows = np.zeros((num_actions, size, size))
        np.add.at(rows, (a[:, None], source, column), entries)
        return list(rows)
    from scipy import sparse  # a tenth of a second that small models do not need

    return [
        sparse.csr_array(
            (entries[a == i].ravel(), (source[a == i].ravel(), column[a == i].ravel())),
            shape=(size, size),
        )
        for i in range(num_actions)
    ]


def policy_row(rows: list[Any], weight: Floats) -> Any:
    """The chain of a policy ``float[N, A]``."""
    total = rows[0] * weight[:, :1]
    for row, w in zip(rows[1:], weight.T[1:], strict=True):
        total = total + row * w[:, None]
    return total if isinstance(total, np.ndarray) else total.tocsr()


def of_policy(row: Any, one: Booleans, undecided: Booleans, unit: float) -> Bounds | None:
    """Probability of reaching `one` in the chain with transitions ``row[N, N]``.

    The bound is that of :func:`jaxltl.core.values.engine.certificates.m_matrix_error`.

    Args:
      row: the chain.
      one, undecided: ``bool[N]``, where the probability is 1, and where it is not known.
      unit: relative rounding of one backup.

    Returns:
      The bounds, or None if nothing could be proven.
    """
    open_ = np.flatnonzero(undecided)
    kept = row[open_]
    inner, hit = kept[:, open_], kept @ one.astype(float)
    matrix = _minus(inner)
    found = solved(matrix, hit)
    if found is None:
        return None
    found = np.clip(found, 0, 1)
    residual = np.abs(hit + inner @ found - found)
    error = solved(matrix, 2 * residual + 4 * unit * (found + 1e-3))
    if error is None or (error < 0).any():
        return None
    if (error - inner @ error < residual + unit * (found + error)).any():
        return None
    value, margin = one.astype(float), np.zeros(len(one))
    value[open_], margin[open_] = found, error
    return Bounds(
        value,
        np.maximum(value - margin, 0),
        np.minimum(value + margin, 1),
        float(residual.max(initial=0)),
        2,
        np.zeros(len(one), np.int32),
        undecided,
    )


class _Choices(NamedTuple):
    """Matrices of the actions, which rows may be taken, and which states choose together."""

    rows: list[Any]
    allowed: Booleans
    group: Integers

    def best(self, value: Floats, sign: int) -> tuple[Floats, Integers, Integers]:
        """The optimum of ``rows @ value`` for each state, who chooses, and its action."""
        ahead = np.stack([row @ value for row in self.rows])
        images = np.where(self.allowed, sign * ahead, -np.inf)
        action = images.argmax(0)
        image = images.max(0)
        order = np.lexsort((-image, self.group))
        first = order[np.unique(self.group[order], return_index=True)[1]]
        chooser = np.empty(len(image), int)
        chooser[self.group[first]] = first
        chosen = chooser[self.group]
        return sign * image[chosen], chosen, action

    def taken(self, state: Integers, action: Integers) -> Any:
        """The rows of some states and actions, one below the other."""
        if isinstance(self.rows[0], np.ndarray):
            return np.stack(self.rows)[action, state]
        picked = [row[state] * (action == i)[:, None] for i, row in enumerate(self.rows)]
        return sum(picked[1:], start=picked[0]).tocsr()


def optimum(
    rows: list[Any],
    allowed: Booleans,
    group: Integers,
    one: Booleans,
    undecided: Booleans,
    sign: int,
    unit: float,
) -> Bounds | None:
    """The largest or smallest probability of reaching `one`, by policy iteration (Howard 1960).

    Args:
      rows: of :func:`transition_rows`.
      allowed: ``bool[N, A]``, the actions that may be taken; in an end component those that leave.
      group: ``int[N]``, a number that the states of an end component share.
      one, undecided: ``bool[N]``.
      sign: 1 for the largest, -1 for the smallest.
      unit: relative rounding of one backup.

    Returns:
      The bounds, or None if they could not be proven.
    """
    choices = _Choices(rows, allowed.T, group)
    target = one.astype(float)
    if not undecided.any():
        return Bounds(target, target, target, 0.0, 1, np.zeros(len(one), np.int32), undecided)
    first = _getting_out(choices, one) if sign > 0 else None
    found = _iterate(choices, undecided, target, np.zeros(len(one)), sign, first)
    if found is None:
        return None
    value, rounds = found
    image, chosen, action = choices.best(value, sign)
    residual = np.abs(image - value)[undecided].max(initial=0)
    loss = sign * (image - np.stack([row @ value for row in rows]))
    for most in _LOSSES:
        # How long a run can stay undecided at most: errors grow with it. Runs that take what loses
        # more than the errors grow by need not be counted: that they need not is proven below.
        near = choices._replace(allowed=choices.allowed & (loss <= most))
        time = _iterate(near, undecided, np.zeros(len(one)), np.ones(len(one)), 1)
        if time is None or (time[0] < 0).any():
            continue
        margin = np.where(undecided, (2 * residual + 2 * unit) * time[0], 0)
        lower, upper = np.maximum(value - margin, 0), value + margin
        below = choices.best(lower, sign)[0] * (1 - unit) >= lower
        above = choices.best(upper, sign)[0] * (1 + unit) <= upper
        if (below & above)[undecided].all():
            exits = undecided & (chosen == np.arange(len(one)))
            return Bounds(
                np.where(undecided, np.clip(value, 0, 1), target),
                lower,
                np.minimum(upper, 1),
                float(residual),
                rounds + time[1],
                action.astype(np.int32),
                exits,
            )
    return None


def _iterate(
    choices: _Choices,
    open_: Booleans,
    known: Floats,
    cost: Floats,
    sign: int,
    first: tuple[Integers, Integers] | None = None,
) -> tuple[Floats, int] | None:
    """The optimum of ``x = cost + row @ x`` on the open states, `known` on the others.

    Args:
      first: whose action each state takes at first, and which, so that it surely gets out.
    """
    value, places = known, np.flatnonzero(open_)
    leader, taken = choices.best(value, sign)[1:] if first is None else first
    if first is None:
        taken = taken[leader]
    best, least, noisy = value, np.inf, 0
    for round_ in range(1, _MAX_ROUNDS + 1):
        row = choices.taken(leader[places], taken[places])
        found = solved(_minus(row[:, places]), cost[places] + row @ np.where(open_, 0, known))
        if found is None:
            return None
        size = np.abs(found).max(initial=0)
        if round_ > 1 and (sign * (found - value[places]) < -_NOISE * size).any():
            break  # a policy that hardly ever gets out, whose system is too near to a singular one
        value = known.copy()
        value[places] = found
        image, chosen, action = choices.best(value, sign)
        gain = sign * (cost + image - value)
        if (gain[places] <= 1e-15 * np.abs(found)).all():
            return value, round_
        if (most := gain[places].max(initial=0) / size) < least:
            best, least = value, most
        # Actions that tie but for rounding may take turns for ever.
        noisy += most <= _NOISE
        if noisy > _PATIENCE:
            break
        # Only who gains changes, by which a policy that gets out is followed by such a one.
        better = gain > 1e-15 * np.abs(value)
        leader = np.where(better, chosen, leader)
        taken = np.where(better, action[chosen], taken)
    return (best, round_) if least <= _SMALL else None


def _getting_out(choices: _Choices, goal: Booleans) -> tuple[Integers, Integers]:
    """Whose action each state takes, and which, so that each may get to a goal."""
    near = goal.copy()
    leader, taken = np.arange(len(goal)), np.zeros(len(goal), int)
    while True:
        hit = choices.allowed & np.stack([row @ near.astype(float) > 0 for row in choices.rows])
        new = hit.any(0) & ~near
        if not new.any():
            return leader, taken
        of_group = np.full(choices.group.max() + 1, -1)
        of_group[choices.group[new]] = np.flatnonzero(new)
        chosen = of_group[choices.group]
        joins = (chosen >= 0) & ~near
        leader = np.where(joins, chosen, leader)
        taken = np.where(joins, hit.argmax(0)[chosen], taken)
        near |= joins


def _minus(inner: Any) -> Any:
    """The identity minus a square matrix."""
    if isinstance(inner, np.ndarray):
        return np.eye(len(inner)) - inner
    from scipy import sparse

    return (sparse.eye_array(inner.shape[0]) - inner).tocsc()


def solved(matrix: Any, b: Floats) -> NDArray[Any] | None:
    """The solution of a system, dense or sparse; None where it is singular."""
    if not b.size:
        return b
    x: NDArray[Any]
    try:
        if isinstance(matrix, np.ndarray):
            x = np.linalg.solve(matrix, b)
        else:
            from scipy.sparse import linalg

            x = linalg.splu(matrix).solve(b)
    except (np.linalg.LinAlgError, RuntimeError):  # singular
        return None
    return x if np.isfinite(x).all() else None


def steps_until(row: Any, open_: Booleans) -> Floats | None:
    """Expected steps of a chain ``row[N, N]`` that surely leaves some states, ``float64[N]``.

    Zero elsewhere; None where the equation could not be solved to six digits, since it takes
    longer than double precision can tell.
    """
    places = np.flatnonzero(open_)
    inner = row[places][:, places]
    found = solved(_minus(inner), np.ones(places.size))
    if found is None or (np.abs(1 + inner @ found - found) > 1e-6 * found).any():
        return None
    steps = np.zeros(len(open_))
    steps[places] = found
    return steps
