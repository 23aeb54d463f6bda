"""Reward-bounded reachability: the probability of a target before a reward bound is exceeded.

By induction over the remaining budget: with l units left, a step of cost c leads to level ``l - c``
(Andova, Hermanns and Katoen 2003). Steps without cost stay on a level, as a linear system that is
the same on every level: it is factored once, and one bound on the number of consecutive steps
without cost bounds the error of all levels. Games and uncertain models are unfolded over the levels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.bounded.row_game import RowGame
from jaxltl.core.sparse.graph.qualitative import (
    end_components,
    backward_reachable,
    shortest_path_rows,
)
from jaxltl.core.sparse.interval.l1_ball import Ball
from jaxltl.core.sparse.interval.reachability import reachability
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, first_hits, offsets_from_counts

if TYPE_CHECKING:
    from scipy.sparse import csr_array
    from scipy.sparse.linalg import SuperLU

_LEVELS = 10**7  # amounts of reward at most
_LARGEST = 8 * 2**30  # bytes of the levels that are kept
_UNFOLDED = 2 * 10**7  # entries of a game or an uncertain model on all levels
_WIDTH = 1e-11  # of the bounds of such a model
_DENOMINATOR = 10**9  # of the fractions that rewards are taken for
_GAIN = 1e-13  # relative gain that may be rounding
_ROUNDS = 100
_DEPTH = 64  # steps without cost, up to which a level is solved by substitution


class BudgetLevel(NamedTuple):
    """Probabilities with the whole budget left."""

    value: Floats  # float64[S]
    error: Floats  # float64[S]
    # int32[S], the choices with the whole budget left; int32[L + 1, S] with `by_level`
    row: Integers
    probability: Floats | None = None  # float64[T], nature's distributions with the whole budget


def in_units(cost: Floats, bound: float) -> tuple[Integers, int]:
    """Costs as multiples of their greatest common unit, and the bound in units.

    Each number is read as the simplest fraction that rounds to it.

    Raises:
      ValueError: the bound has more than 10^7 units.

    Example:
      >>> units, most = in_units(np.array([0.1, 0.0, 0.3]), 0.7)
      >>> units.tolist(), most
      ([1, 0, 3], 7)
    """
    distinct, place = np.unique(cost, return_inverse=True)
    exact = [_simplest(float(x)) for x in distinct]
    scale = math.lcm(*(x.denominator for x in exact))
    whole = [int(x * scale) for x in exact]
    unit = Fraction(math.gcd(*whole) or scale, scale)
    limit = math.floor(_simplest(float(bound)) / unit)
    if limit > _LEVELS:
        worst = max(exact, key=lambda x: x.denominator)
        raise ValueError(
            f"the rewards have no unit in common but {float(unit):.3g} (one of them is "
            f"{float(worst)!r}), and the bound {bound} has {limit:.3g} of these; at most {_LEVELS} "
            "can be counted. Round the rewards to multiples of a larger unit."
        )
    # What costs more than everything costs just too much.
    units = np.array([min(int(x / unit), limit + 1) for x in exact], np.int64)
    return units[place.reshape(cost.shape)], limit


def _simplest(x: float) -> Fraction:
    exact = Fraction(x)
    for size in (10, 10**3, 10**6, _DENOMINATOR):
        simple = exact.limit_denominator(size)
        if float(simple) == x:
            return simple
    return exact


def until_at_cost(
    game: RowGame,
    target: Booleans,
    stay: Booleans,
    budget: tuple[Integers, int],
    by_level: bool = False,
) -> BudgetLevel:
    """Probability of a target through `stay`, within a budget of :func:`in_units`."""
    if not game.is_mdp:
        return _unfolded(game, target, stay, budget, by_level)
    mdp, maximal, (cost, limit) = game.mdp, bool(game.sole_direction), budget
    open_ = stay & ~target
    shape = _shape(mdp, target, open_, cost, maximal)
    parts = _parts(mdp, shape, target, cost, limit)
    system = _LayerSystem(shape, parts[0][1], maximal)
    size = parts[-1][0] + 1
    if 8.0 * size * shape.starts.size > _LARGEST:
        raise ValueError(
            f"{shape.starts.size} states with rewards of up to {size - 1} units would take "
            f"{8 * size * shape.starts.size / 2**30:.0f} GB; round them to a larger unit."
        )
    ring = np.zeros((size, shape.starts.size))  # the last levels
    error, every = 0.0, []
    for level in range(limit + 1):
        b = parts[0][2].copy()
        for c, matrix, hit in parts[1:]:
            if c > level:
                break
            b += matrix @ ring[(level - c) % size]
            b += hit
        value, off = system.solve(b, mdp.backup_unit * (len(parts) + 1))
        error += off
        ring[level % size] = value
        if by_level or level == limit:
            every.append(_policy(mdp, shape, system.policy(b, value)))
    probability = target.astype(np.float64)
    probability[shape.member] = ring[limit % size][shape.node[shape.member]]
    errors = np.where(shape.member, error, 0.0)
    return BudgetLevel(probability, errors, np.stack(every) if by_level else every[-1])


def _unfolded(
    game: RowGame,
    target: Booleans,
    stay: Booleans,
    budget: tuple[Integers, int],
    by_level: bool,
) -> BudgetLevel:
    """Reachability in the model of pairs of an amount left and a state.

    The first block of states has nothing left, the last one the whole budget; those before have
    spent more than it, and are absorbing.
    """
    mdp, (cost, limit) = game.mdp, budget
    size, levels = mdp.num_states, limit + 1
    if levels * mdp.num_transitions > _UNFOLDED:
        raise ValueError(
            f"{levels} levels of {mdp.num_transitions} transitions are more than {_UNFOLDED}, which is "
            "the most for games and models with intervals; round the rewards to a larger unit."
        )
    encoded, query = game.encoded()
    model, source = encoded.model, encoded.source
    size = source.size
    paid = np.where(encoded.entry < 0, 0, cost[encoded.entry])
    level = np.repeat(np.arange(levels), paid.size)
    left = np.maximum(level - np.tile(paid, levels), -1) + 1
    after = left * size + np.tile(model.mdp.successor, levels)
    # Successors ascend in each row.
    row = np.tile(model.mdp.row, levels) + level * model.mdp.num_rows
    order = np.lexsort((after, row))

    def entries(inner: Floats, loop: float) -> Floats:
        return np.append(np.full(size, loop), np.tile(inner, levels)[order])

    def starts(inner: Integers) -> Integers:
        return offsets_from_counts(
            np.append(np.ones(size, np.int64), np.tile(np.diff(inner), levels))
        )

    host = HostMDP(
        starts(model.mdp.row_start),
        starts(model.mdp.entry_start),
        np.append(np.arange(size), after[order]).astype(np.int32),
        entries(model.mdp.probability, 1.0),
    )
    ball = model.ball
    if ball is not None:
        gain = np.append(np.zeros(size), np.tile(ball.gain, levels))
        ball = Ball(entries(ball.center, 1.0), gain)
    sets = UncertainMDP(host, entries(model.lower, 1.0), entries(model.upper, 1.0), ball)
    spent = np.zeros(size, bool)
    goal = np.append(spent, np.tile(target[source], levels))
    passable = np.append(spent, np.tile((stay | target)[source], levels))
    values = reachability(sets, goal, replace(query, tolerance=_WIDTH), stay=passable)
    num_rows, num_entries = model.mdp.num_rows, model.mdp.num_transitions
    chance = np.empty((levels, num_entries))
    chance.ravel()[order] = values.probability[size:]
    rows = values.row[size:].reshape(levels, size) - size - np.arange(levels)[:, None] * num_rows
    policy = [encoded.policy(x, p) for x, p in zip(rows, chance, strict=True)]
    low, high = (x[-size:][: mdp.num_states] for x in (values.lower, values.upper))
    return BudgetLevel(
        (low + high) / 2,
        (high - low) / 2,
        np.stack(policy) if by_level else policy[-1],
        None if game.sets is None else encoded.nature(chance[-1], mdp.probability),
    )


class _Shape(NamedTuple):
    """Nodes of the linear system: undecided states, those of an end component as one."""

    member: Booleans  # bool[S], the undecided states
    node: Integers  # int[S], the node of a member
    row: Integers  # int[R'], the rows of the nodes, in order
    starts: Integers  # int[N], where those of each node begin
    inside: Booleans  # bool[R], rows without cost that stay in their end component


def _shape(
    mdp: HostMDP, target: Booleans, open_: Booleans, cost: Integers, maximal: bool
) -> _Shape:
    free = np.maximum.reduceat(cost, mdp.entry_start[:-1]) == 0
    member = backward_reachable(mdp, target, open_[mdp.state]) & open_
    components = end_components(mdp, member if maximal else open_, free)
    inside = components.inside
    if not maximal:
        # A policy that stays in an end component without cost avoids the target.
        member &= ~components.region(mdp)
        inside = np.zeros_like(inside)
    leader = np.where(member & maximal, components.component, np.arange(mdp.num_states))
    row = np.flatnonzero(member[mdp.state] & ~inside)
    row = row[np.argsort(leader[mdp.state[row]], kind="stable")]
    leaders, starts = np.unique(leader[mdp.state[row]], return_index=True)
    node = np.searchsorted(leaders, leader)
    return _Shape(member, node, row, starts, inside)


def _parts(
    mdp: HostMDP, shape: _Shape, target: Booleans, cost: Integers, limit: int
) -> list[tuple[int, csr_array, Floats]]:
    """For each cost: the matrix of the entries of that cost, and the probability of the target."""
    from scipy import sparse

    count = np.diff(mdp.entry_start)[shape.row]
    entry = concatenated_ranges(mdp.entry_start[shape.row], count)
    row = np.repeat(np.arange(shape.row.size), count)
    goal, probability = mdp.successor[entry], mdp.probability[entry]
    parts = []
    for c in np.union1d([0], cost[entry]).tolist():
        if c > limit:
            break
        of = cost[entry] == c
        hit = of & target[goal]
        of &= shape.member[goal]
        place = row[of], shape.node[goal[of]]
        matrix = sparse.csr_array(
            (probability[of], place), shape=(shape.row.size, shape.starts.size)
        )
        enters = np.bincount(row[hit], probability[hit], shape.row.size).astype(np.float64)
        parts.append((c, matrix, enters))
    return parts


def _policy(mdp: HostMDP, shape: _Shape, chosen: Integers) -> Integers:
    """The chosen rows, and in end components the rows that lead to them."""
    policy = mdp.row_start[:-1].astype(np.int32)
    row = shape.row[chosen].astype(np.int32)
    policy[mdp.state[row]] = row
    if shape.inside.any():
        goal = mdp.states_of(row)
        moving = mdp.states_of(shape.inside) & ~goal
        policy = np.where(moving, shortest_path_rows(mdp, goal, shape.inside), policy)
    return policy


class _Layer(NamedTuple):
    """Nodes with equally long paths of steps without cost."""

    nodes: Integers
    rows: Integers
    matrix: csr_array  # of the rows
    starts: Integers  # of each node among the rows


@dataclass
class _LayerSystem:
    """``x = opt (b + P x)``, which every policy leaves.

    `longest` bounds the expected number of consecutive steps without cost. Without cycles of such
    steps `layers` has the nodes by the length of their longest path, and the solution is a
    substitution. Else `chosen` ``int[N]`` is the row of each node, and `factors` are those of these
    rows.
    """

    shape: _Shape
    matrix: csr_array
    maximal: bool

    def __post_init__(self) -> None:
        self.chosen = self.shape.starts
        self.factors: SuperLU = None
        self.count = np.diff(np.append(self.shape.starts, self.shape.row.size))
        self.layers = self._layers()
        if self.layers is not None:
            self.longest = float(len(self.layers))
            return
        wish, self.maximal = self.maximal, True
        self._factor()
        steps = self._iterate(np.ones(self.shape.row.size))
        ahead = np.repeat(steps, self.count)
        enough = (ahead - self.matrix @ steps >= 0.5).all() and (steps >= 0).all()
        self.longest = 2 * float(steps.max()) if enough else math.inf
        self.maximal = wish

    def _layers(self) -> list[_Layer] | None:
        """The nodes with steps without cost by the longest path, or None for long ones or cycles."""
        depth = np.zeros(self.shape.starts.size, np.int64)
        ahead = np.ones(depth.size, bool)  # nodes with paths of `round` steps
        for _ in range(_DEPTH):
            if not self.matrix.nnz or not ahead.any():
                break
            ahead = np.maximum.reduceat(self.matrix @ ahead.astype(float), self.shape.starts) > 0
            depth += ahead
        else:
            return None
        layers = []
        for d in range(int(depth.max(initial=-1)) + 1):
            nodes = np.flatnonzero(depth == d)
            rows = concatenated_ranges(self.shape.starts[nodes], self.count[nodes])
            starts = np.cumsum(self.count[nodes]) - self.count[nodes]
            layers.append(_Layer(nodes, rows, self.matrix[rows], starts))
        return layers

    def best(self, image: Floats) -> Floats:
        operation = np.maximum if self.maximal else np.minimum
        return operation.reduceat(image, self.shape.starts) if image.size else image

    def solve(self, b: Floats, unit: float) -> tuple[Floats, float]:
        """The solution, and its error if each sum has a relative error `unit`."""
        if self.layers is not None:
            value = np.zeros(self.count.size)
            operation = np.maximum if self.maximal else np.minimum
            for nodes, rows, matrix, starts in self.layers:
                value[nodes] = operation.reduceat(b[rows] + matrix @ value, starts)
            return np.clip(value, 0, 1), unit * self.longest
        value = np.clip(self._iterate(b), 0, 1)
        residual = np.abs(self.best(b + self.matrix @ value) - value).max(initial=0)
        return value, float(residual + unit) * self.longest

    def policy(self, b: Floats, value: Floats) -> Integers:
        """The optimal row of each node."""
        if self.layers is not None:
            image = b + self.matrix @ value
            self._choose(image, self.best(image), np.zeros(value.size, bool))
        return self.chosen

    def _iterate(self, b: Floats) -> Floats:
        """Policy iteration (Howard 1960) from the last policy and its factors."""
        for _ in range(_ROUNDS):
            value: Floats = self.factors.solve(b[self.chosen])
            image = b + self.matrix @ value
            best = self.best(image)
            kept = np.abs(best - image[self.chosen]) <= _GAIN * np.abs(best)
            if kept.all():
                break
            self._choose(image, best, kept)
            self._factor()
        return value

    def _choose(self, image: Floats, best: Floats, kept: Booleans) -> None:
        starts = self.shape.starts
        if starts.size < self.shape.row.size:
            node = np.repeat(np.arange(starts.size), self.count)
            better = (image == best[node]) & ~kept[node]
            self.chosen = first_hits(better, node, self.chosen)

    def _factor(self) -> None:
        from scipy import sparse
        from scipy.sparse import linalg

        system = sparse.eye_array(self.shape.starts.size) - self.matrix[self.chosen]
        self.factors = linalg.splu(system.tocsc())
