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
            shape=(size, size))
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

    The bound is that of :func:`jaxltl.core.values.evidence.m_matrix_error`.

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
        value, np.maximum(value - margin, 0), np.minimum(value + margin, 1),
        float(residual.max(initial=0)), 2, np.zeros(len(one), np.int32), undecided)


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
    rows: list[Any], allowed: Booleans, group: Integers, one: Booleans, undecided: Booleans,
    sign: int, unit: float,
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
    found = _iterate(choices, undecided, target, np.zeros(len(one)), sign)
    # How long a run can stay undecided at most: errors grow with it.
    time = _iterate(choices, undecided, np.zeros(len(one)), np.ones(len(one)), 1)
    if found is None or time is None:
        return None
    value, rounds = found
    image, chosen, action = choices.best(value, sign)
    residual = np.abs(image - value)[undecided].max(initial=0)
    margin = np.where(undecided, (2 * residual + 2 * unit) * time[0], 0)
    lower, upper = np.maximum(value - margin, 0), value + margin
    below = choices.best(lower, sign)[0] * (1 - unit) >= lower
    above = choices.best(upper, sign)[0] * (1 + unit) <= upper
    if not (below & above)[undecided].all():
        return None
    exits = undecided & (chosen == np.arange(len(one)))
    return Bounds(
        np.where(undecided, np.clip(value, 0, 1), target), lower, np.minimum(upper, 1),
        float(residual), rounds + time[1], action.astype(np.int32), exits)


def _iterate(
    choices: _Choices, open_: Booleans, known: Floats, cost: Floats, sign: int
) -> tuple[Floats, int] | None:
    """The optimum of ``x = cost + row @ x`` on the open states, `known` on the others."""
    value = known
    places = np.flatnonzero(open_)
    for round_ in range(_MAX_ROUNDS):
        image, chosen, action = choices.best(value, sign)
        gain = sign * (cost + image - value)[open_]
        if round_ and (gain <= 1e-15 * np.abs(value[open_])).all():
            return value, round_
        leader = chosen[places]
        row = choices.taken(leader, action[leader])
        known_part = row @ np.where(open_, 0, known)
        found = solved(_minus(row[:, places]), cost[places] + known_part)
        if found is None:
            return None
        value = known.copy()
        value[places] = found
    return value, _MAX_ROUNDS


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
