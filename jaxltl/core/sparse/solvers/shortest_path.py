"""The quickest way out of some states: stochastic shortest paths, where every step costs one.

Value iteration while it is fast, else policy iteration from a policy that surely gets out
(Bertsekas and Tsitsiklis 1991); both end with a proof of how long their policy takes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.sparse.solvers.dense_reachability import (
    DENSE_LIMIT,
    Booleans,
    Floats,
    Integers,
    solved,
)

_MAX_SWEEPS = 1000
_MAX_ROUNDS = 200
_MOST = 2048  # open states up to which systems are solved, which elimination may fill
_SETTLED = 1e-12  # change of a sweep, in steps, below which times are taken for exact
_TIE = 1e-10  # relative difference below which expected times are equal


class _Moves(NamedTuple):
    """What the allowed actions of the open states do within them.

    Attributes:
      allowed: ``bool[A, N]``, N open states.
      pair, source, target: ``int[T]``: transition i is of the pair ``action * N + source``.
      weight: ``float64[T]``.
    """

    allowed: Booleans
    pair: Integers
    source: Integers
    target: Integers
    weight: Floats

    def ahead(self, time: Floats) -> Floats:
        """The expected time that is left after each action, ``float64[A, N]``."""
        left = np.bincount(self.pair, self.weight * time[self.target], self.allowed.size)
        return np.where(self.allowed, left.reshape(self.allowed.shape), np.inf)

    def time_of(self, chosen: Integers) -> Floats | None:
        """The expected time of a policy ``int[N]``; None if it may never end."""
        size = chosen.size
        used = np.flatnonzero(self.pair == chosen[self.source] * size + self.source)
        source, target, weight = self.source[used], self.target[used], self.weight[used]
        if size <= DENSE_LIMIT:
            matrix: Any = np.eye(size)
            np.subtract.at(matrix, (source, target), weight)
        else:
            from scipy import sparse

            chain = sparse.csc_array((weight, (source, target)), shape=(size, size))
            matrix = (sparse.eye_array(size) - chain).tocsc()
        time = solved(matrix, np.ones(size))
        return None if time is None or (time < 1 - 1e-9).any() else time


def quickest(
    rows: list[Any], allowed: Booleans, open_: Booleans, action: Integers
) -> Integers | None:
    """The actions that leave some states in the least expected number of steps, ``int[N]``.

    Of equally quick actions the first. Rows may lack what ends the count, such as a visit.

    Args:
      rows: of :func:`~jaxltl.core.sparse.solvers.dense_reachability.transition_rows`.
      allowed: ``bool[N, A]``.
      open_: ``bool[N]``, the states to leave.
      action: ``int[N]``, a policy that leaves them almost surely.

    Returns:
      The actions, those given where it is not open; None if a time could not be proven.
    """
    places = np.flatnonzero(open_)
    if not places.size:
        return action
    moves = _moves(rows, allowed, places)
    chosen = np.asarray(action)[places]
    time, change = np.zeros(places.size), np.inf
    for _ in range(_MAX_SWEEPS):
        # Times only grow. When none grows by one any more, the greedy policy surely ends.
        before, time = time, 1 + moves.ahead(time).min(0)
        change = (time - before).max()
        if change <= _SETTLED:
            break
    else:
        if places.size > _MOST:
            return None
        if change < 0.5:
            chosen = moves.ahead(time).argmin(0)
        improved = _improved(moves, chosen)
        if improved is None:
            return None
        time, chosen = improved
    ahead = moves.ahead(time)
    slack = _TIE * time  # which is too small to go round in a circle by, unless it takes for ever
    first = (ahead <= ahead.min(0) + slack).argmax(0)
    found = np.array(action)
    found[places] = np.where(slack < 0.1, first, chosen)
    return found


def _moves(rows: list[Any], allowed: Booleans, places: Integers) -> _Moves:
    parts = []
    for row in rows:
        inner = row[places][:, places]
        if isinstance(inner, np.ndarray):
            source, target = np.nonzero(inner)
            parts.append((source, target, inner[source, target]))
        else:
            inner = inner.tocoo()
            parts.append((*inner.coords, inner.data))
    first = np.arange(len(parts)) * places.size
    pair = np.concatenate([n + x for n, (x, _, _) in zip(first, parts, strict=True)])
    source, target, weight = (np.concatenate(x) for x in zip(*parts, strict=True))
    mask = allowed[places].T
    kept = mask.reshape(-1)[pair]
    return _Moves(mask, pair[kept], source[kept], target[kept], weight[kept])


def _improved(moves: _Moves, chosen: Integers) -> tuple[Floats, Integers] | None:
    """The least times and a policy that attains them, by policy iteration."""
    own = np.arange(chosen.size)
    for _ in range(_MAX_ROUNDS):
        time = moves.time_of(chosen)
        if time is None:
            return None
        ahead = moves.ahead(time)
        better = ahead[chosen, own] > ahead.min(0) + _TIE / 100 * time
        if not better.any():
            return time, chosen
        chosen = np.where(better, ahead.argmin(0), chosen)
    return None


def until_read(rows: list[Any], marked: Booleans, letter: Integers) -> list[Any]:
    """Rows without the transitions that read a letter that is marked where they start.

    Args:
      rows: of :func:`~jaxltl.core.sparse.solvers.dense_reachability.transition_rows`.
      marked: ``bool[N, L]``.
      letter: ``int[N]``, what is read of the state that is entered.
    """
    if isinstance(rows[0], np.ndarray):
        kept = ~marked[:, letter]
        return [row * kept for row in rows]
    found = []
    for row in rows:
        row = row.copy()
        source = np.repeat(np.arange(row.shape[0]), np.diff(row.indptr))
        row.data[marked[source, letter[row.indices]]] = 0
        found.append(row)
    return found
