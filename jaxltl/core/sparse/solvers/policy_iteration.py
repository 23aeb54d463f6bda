"""Optimal sums until some states are left: ``x = opt_r (c_r + P_r x)``, proven on both sides.

States from which no circle can be entered are solved level by level, with an error that is known
in advance; so are, at the end, those to which no circle leads. In between there is policy
iteration by sparse elimination (Howard 1960), of the problem in which every step costs a little
more than it does: its solution then is a bound by one application of the operator, and its
policy attains a bound that the policy's own expected time proves.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.choice_order import Choices, choices_of
from jaxltl.core.sparse.graph.qualitative import forward_search
from jaxltl.core.sparse.linear.elimination import Factors, factorize, elimination_order
from jaxltl.core.sparse.linear.fractions import LARGEST, exact_optimum
from jaxltl.core.sparse.linear.matrix_tree import System, share_of_values
from jaxltl.core.sparse.linear.refinement import refined
from jaxltl.core.sparse.linear.topological_order import (
    Edges,
    Levels,
    ordered_components,
    topological_levels,
)
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import SCIPY_SIZE, concatenated_ranges, offsets_from_counts
from jaxltl.core.sparse.solvers.onward import propagate_improvements

_EPS = float(np.finfo(np.float64).eps)
_TINY = 1e-290
_AIM = 0.1  # of the tolerance: how much of it the extra cost of the steps may take
_AIM_CHAIN = 1e-5  # where there is nothing to choose, so that ties do not matter
_FIRST_SWEEPS = 60  # of value iteration, to begin with a policy that is not bad
_SWEEPS = 12  # after each system, by which news goes on from where policies change
_HASTY = 12  # exact rounds after which its own improvement alone goes on, which must end
_KEPT = 0.75  # of the extra cost: who gains less stays, and the rest is what proves the bound
_MAX_ROUNDS = 300
_GOOD = 0.1  # bounds so narrow that their policy is one to begin with


class ShortestPathProblem(NamedTuple):
    """A problem whose every policy that counts leaves all of its states.

    What a row leads to besides itself is taken to be all that it leads to, in these proportions:
    rows sum to one.

    Attributes:
      mdp: the model; its rows may be unsorted and repeat successors.
      open: ``bool[S]``, the states to solve for.
      known: ``float64[S]``, at least 0: what is earned at the other states for ever after.
      cost: ``float64[R]``, at least 0.
      rows: ``bool[R]``, the rows that may be taken.
      first: ``int[S]``, rows by which every open state is left almost surely; needed only where
        some policies never leave.
      depth: how many roundings may stand behind one of the numbers.
    """

    mdp: HostMDP
    open: Booleans
    known: Floats
    cost: Floats
    rows: Booleans | None = None
    first: Integers | None = None
    depth: int = 0


class Enclosure(NamedTuple):
    """Certified values of an optimum, or of a chain.

    Attributes:
      value, lower, upper: ``float64[S]``; where nothing could be proven, 0 and infinity.
      row: ``int[S]``: rows that attain the bound on the safe side, of a maximum `lower`.
      rounds: systems solved.
      residual: how far the value is from satisfying its equation, as a share of it where it
        exceeds one.
      method: how it was found, in words.
    """

    value: Floats
    lower: Floats
    upper: Floats
    row: Integers
    rounds: int
    residual: float
    method: str


class _System(NamedTuple):
    """The open states as nodes, and a last node of value 1 through which what is known comes in.

    Self-loops are eliminated. Attributes as of a HostMDP; `row` and `node` name what they were, and
    `leaving` is how likely a row leads to what is known. `widest` is the greatest number of
    successors of a row, those that are known and itself included: sums go over all of them.
    """

    row_start: Integers
    entry_start: Integers
    target: Integers
    weight: Floats
    row: Integers
    node: Integers
    leaving: Floats
    widest: int

    @property
    def num_nodes(self) -> int:
        return self.node.size

    def taken(self, node: Integers) -> _System:
        """The rows of some nodes, in their order; targets stay as they are numbered."""
        count = np.diff(self.row_start)[node]
        row = concatenated_ranges(self.row_start[node], count)
        width = np.diff(self.entry_start)[row]
        entry = concatenated_ranges(self.entry_start[row], width)
        return _System(
            offsets_from_counts(count),
            offsets_from_counts(width),
            self.target[entry],
            self.weight[entry],
            self.row[row],
            self.node[node],
            self.leaving[row],
            self.widest,
        )


def optimum(
    problem: ShortestPathProblem, *, maximize: bool, tolerance: float, relative: bool
) -> Enclosure:
    """The optimal sums, enclosed.

    Args:
      problem: what is asked.
      maximize: whether the largest sum is asked for, else the smallest. A maximum needs that every
        policy leaves the open states almost surely, a minimum that those which do not cost
        infinitely much.
      tolerance: the width of the enclosure that is asked for.
      relative: whether that is a share of the value.
    """
    system = _system(problem)
    sign = 1 if maximize else -1
    n = system.num_nodes
    unit = (4 * system.widest + problem.depth + 16) * _EPS
    bounds: Any = np.zeros((3, n + 1))  # attained, beyond, and the value of the policy
    bounds[:, n] = 1
    chosen: Any = system.row_start[:-1].copy()
    edges = _edges(system)
    back, among = edges.reverse(), np.ones(n, bool)
    number = np.diff(edges.start).astype(np.int32)
    below = topological_levels(back, number, among)
    _sweep(system, below, bounds, chosen, sign)
    grown = (len(below.start) - 1) * unit
    _widen(bounds, below.node, sign, grown)
    rounds, method = 0, "levels"
    if among.any():
        above = topological_levels(edges, _number_left(back, among), among)
        core = np.flatnonzero(among)
        if core.size:
            found = _solve_core(
                system, core, bounds, (unit, grown), sign, problem, tolerance, relative
            )
            rounds, method = found.rounds, found.method
            node = found.node
            bounds[:, node], chosen[node] = (found.near, found.far, found.value), found.chosen
            # No sum is below nothing; with lower bounds that were, errors would not be shares.
            low = 0 if maximize else 1
            bounds[low, node] = np.maximum(bounds[low, node], 0)
        after = Levels(above.node[::-1], [above.start[-1] - x for x in above.start[::-1]])
        _sweep(system, after, bounds, chosen, sign)
        _widen(bounds, above.node, sign, (len(above.start) - 1) * unit)
    return _found(problem, system, bounds[:, :n], chosen, sign, rounds, method)


def _found(
    problem: ShortestPathProblem,
    system: _System,
    bounds: Floats,
    chosen: Integers,
    sign: int,
    rounds: int,
    method: str,
) -> Enclosure:
    near, far, value = bounds
    low, high = (near, far) if sign > 0 else (far, near)
    # Products too small for a float to hold are lost; relative errors do not count them.
    low = np.where(np.isfinite(low), np.maximum(low - _TINY, 0), 0)
    high = np.where(np.isnan(high), np.inf, high + _TINY)
    value = np.clip(value, low, high)

    def everywhere(x: Floats) -> Floats:
        full = problem.known.copy()
        full[system.node] = x
        return full

    row = problem.mdp.row_start[:-1].astype(np.int64)
    row[system.node] = system.row[chosen]
    return Enclosure(
        everywhere(value),
        everywhere(low),
        everywhere(high),
        row,
        rounds,
        _residual(system, value, sign),
        method,
    )


def _residual(system: _System, value: Floats, sign: int) -> float:
    if not value.size or not np.isfinite(value).all():
        return np.inf if value.size else 0.0
    image = _backup(system, np.append(value, 1))
    operation = np.maximum if sign > 0 else np.minimum
    best = operation.reduceat(image, system.row_start[:-1])
    return float((np.abs(best - value) / np.maximum(value, 1)).max())


def _system(problem: ShortestPathProblem) -> _System:
    mdp = problem.mdp
    kept = problem.open[mdp.state]
    if problem.rows is not None:
        kept &= problem.rows
    row = np.flatnonzero(kept)
    width = np.diff(mdp.entry_start)[row]
    widest = int(width.max(initial=1))
    if row.size == mdp.num_rows:
        target, weight, of = mdp.successor, mdp.probability, mdp.row
    else:
        entry = concatenated_ranges(mdp.entry_start[row], width)
        target, weight = mdp.successor[entry], mdp.probability[entry]
        of = np.repeat(np.arange(row.size, dtype=np.int32), width)
    state = mdp.state[row]
    inner = problem.open[target]
    known: Any = problem.cost[row]
    leaving: Any = np.zeros(row.size)
    if not inner.all():
        outer = ~inner
        leaving = np.bincount(of[outer], weight[outer], row.size)
        known = known + np.bincount(
            of[outer], weight[outer] * problem.known[target[outer]], row.size
        )
    loops = inner & (target == state[of])
    node = np.flatnonzero(problem.open)
    number: Any = np.zeros(mdp.num_states, np.int32)
    number[node] = np.arange(node.size)
    if loops.any():
        rest = np.bincount(of[~loops], weight[~loops], row.size)
        looping = np.zeros(row.size, bool)
        looping[of[loops]] = True
        scale = np.where(looping & (rest > 0), rest, 1)
        known, leaving, weight = known / scale, leaving / scale, weight / scale[of]
        inner &= ~loops
        if (stuck := looping & (rest == 0)).any():  # rows that never get anywhere
            inner &= ~stuck[of]
            keep = ~stuck
            renumber = np.cumsum(keep) - 1
            row, state, known, leaving = row[keep], state[keep], known[keep], leaving[keep]
            target, weight, of, inner = (x[keep[of]] for x in (target, weight, renumber[of], inner))
    if not inner.all():
        target, weight, of = target[inner], weight[inner], of[inner]
    count = np.bincount(of, minlength=row.size)
    # What is known comes first in a row where it is something, or where the row is empty else.
    some = (known != 0) | (count == 0)
    start = offsets_from_counts(count + some)
    first = start[:-1][some]
    targets, weights = np.empty(start[-1], np.int32), np.empty(start[-1])
    inside = np.ones(start[-1], bool)
    inside[first] = False
    targets[first], weights[first] = node.size, known[some]
    targets[inside], weights[inside] = number[target], weight
    row_start = offsets_from_counts(np.bincount(number[state], minlength=node.size))
    return _System(row_start, start, targets, weights, row, node, leaving, widest)


def _edges(system: _System) -> Edges:
    """From node to node, without the last one."""
    kept = system.target != system.num_nodes
    place = np.zeros(kept.size + 1, np.int32)
    np.cumsum(kept, out=place[1:])
    return Edges(place[system.entry_start[system.row_start]], system.target[kept])


def _number_left(back: Edges, among: Booleans) -> Integers:
    """How many edges into a node come from nodes that are left."""
    left = np.concatenate([[0], np.cumsum(among[back.target])])
    return (left[back.start[1:]] - left[back.start[:-1]]).astype(np.int32)


def _backup(system: _System, value: Floats) -> Floats:
    """``c_r + P_r x`` of each row."""
    if system.target.size > SCIPY_SIZE:
        from scipy import sparse

        arrays = system.weight, system.target, system.entry_start
        return sparse.csr_array(arrays, shape=(system.row.size, value.size)) @ value
    return np.add.reduceat(system.weight * value[system.target], system.entry_start[:-1])


def _widen(bounds: Floats, node: Integers, sign: int, share: float) -> None:
    bounds[0, node] *= 1 - sign * share
    bounds[1, node] *= 1 + sign * share


def _sweep(system: _System, levels: Levels, bounds: Floats, chosen: Integers, sign: int) -> None:
    """Solves level by level, in place; rounding is accounted for by the caller."""
    if not levels.node.size:
        return
    part = system.taken(levels.node)
    single = part.row.size == part.node.size
    same = bool((bounds[0] == bounds[1]).all())
    sides = [bounds[2]] if same else [bounds[2], bounds[1], bounds[0]]
    operation = np.maximum if sign > 0 else np.minimum
    images: Any = np.empty(part.row.size)
    row_at = part.row_start[levels.start]
    entry_at = part.entry_start[row_at].tolist()
    for (a, b), (r0, r1), (e0, e1) in zip(
        pairwise(levels.start), pairwise(row_at.tolist()), pairwise(entry_at), strict=True
    ):
        if a == b:
            continue
        target, weight, node = part.target[e0:e1], part.weight[e0:e1], levels.node[a:b]
        starts, image = part.entry_start[r0:r1] - e0, images[r0:r1]
        begin = None if single else part.row_start[a:b] - r0
        for side in sides:
            np.add.reduceat(weight * side[target], starts, out=image)
            side[node] = image if begin is None else operation.reduceat(image, begin)
    if not single:
        rank = _first(images, sides[-1][levels.node], part.row_start)
        chosen[levels.node] = system.row_start[levels.node] + rank
    if same:
        bounds[:2, levels.node] = bounds[2, levels.node]


def _first(image: Floats, best: Floats, row_start: Integers) -> Integers:
    """The rank of the first row that attains the best of its state."""
    owner = np.arange(best.size, dtype=np.int32).repeat(np.diff(row_start))
    hit = np.flatnonzero(image == best[owner])[::-1]
    found = np.empty(best.size, np.int64)
    found[owner[hit]] = hit  # the first one is written last
    return found - row_start[:-1]


# --- the states on circles, and between them ----------------------------------------------------


class _Core(NamedTuple):
    node: Integers
    near: Floats
    far: Floats
    value: Floats
    chosen: Integers
    rounds: int
    method: str


class _Circles(NamedTuple):
    """The core as matrices.

    Attributes:
      matrix: ``float64[R, M]``, SciPy's.
      known: ``float64[R]``, what comes in from elsewhere.
      leaving: ``float64[R]``, how likely a row leaves the core.
      owner: ``int[R]``, the node of a row.
      row: ``int[R]``, the row of the system that it is.
      choices: the order of the nodes and of their rows.
      sign: 1 to maximise.
    """

    matrix: Any
    known: Floats
    leaving: Floats
    owner: Integers
    row: Integers
    choices: Choices
    sign: int

    @property
    def num_nodes(self) -> int:
        return self.choices.states.size

    @property
    def is_chain(self) -> bool:
        return self.choices.is_chain

    def backup(self, value: Floats) -> Floats:
        return self.known + self.matrix @ value

    def best(self, image: Floats) -> Floats:
        """The optimum over the rows of each node."""
        return self.choices.best(image, np.maximum if self.sign > 0 else np.minimum)

    def argbest(self, image: Floats, best: Floats) -> Integers:
        """The first row that attains the best of each node."""
        return self.choices.first(image, best)


def _circles(
    system: _System, core: Integers, bounds: Floats, sign: int
) -> tuple[_Circles, Integers, Edges]:
    """The matrices, the nodes in their order, and the edges among them."""
    from scipy import sparse

    count = np.diff(system.row_start)[core]
    choices = choices_of(count)
    row, owner = concatenated_ranges(system.row_start[core], count)[choices.order], choices.owner
    core = core[choices.states]
    width = np.diff(system.entry_start)[row]
    entry = concatenated_ranges(system.entry_start[row], width)
    number: Any = np.full(system.num_nodes + 1, -1, np.int32)
    number[core] = np.arange(core.size)
    target, weight = number[system.target[entry]], system.weight[entry]
    inner = target >= 0
    of = np.repeat(np.arange(row.size, dtype=np.int32), width)
    middle = bounds[2]
    outer = ~inner
    earned = weight[outer] * middle[system.target[entry[outer]]]
    known: Any = np.bincount(of[outer], earned, row.size)
    below = outer & (system.target[entry] != system.num_nodes)
    leaving: Any = np.bincount(of[below], weight[below], row.size) + system.leaving[row]
    start = offsets_from_counts(np.bincount(of[inner], minlength=row.size))
    shape = (row.size, core.size)
    matrix = sparse.csr_array((weight[inner], target[inner], start), shape=shape)
    matrix.sum_duplicates()
    source = np.repeat(owner, np.diff(matrix.indptr))
    edges = sparse.coo_array(
        (np.ones(source.size, bool), (source, matrix.indices)), shape=(core.size, core.size)
    ).tocsr()
    circles = _Circles(matrix, known, leaving, owner, row, choices, sign)
    return circles, core, Edges(edges.indptr, edges.indices)


def _solve_core(
    system: _System,
    core: Integers,
    bounds: Floats,
    errors: tuple[float, float],
    sign: int,
    problem: ShortestPathProblem,
    tolerance: float,
    relative: bool,
) -> _Core:
    """Policy iteration of the problem whose every step costs a little more."""
    unit = sum(errors)  # the shares by which a backup may err, and what is known outside
    circles, core, edges = _circles(system, core, bounds, sign)
    label = ordered_components(edges)
    proper = partial(_proper, circles, _way_out(circles, system, core, problem))
    chosen = proper(_greedy(circles, 0.0, np.zeros(core.size), _FIRST_SWEEPS))
    first, solver = chosen, factorize(circles.matrix, label, chosen)
    aim = (_AIM_CHAIN if circles.is_chain else _AIM) * tolerance
    extra, rounds = None, 0
    best: _Core | None = None
    while rounds < _MAX_ROUNDS and solver is not None:
        rounds += 1
        if extra is None:
            time = solver.solve(np.ones(core.size))
            value = solver.solve(circles.known[chosen])
            extra = _extra(time, value, unit, aim, relative)
        value = solver.solve(circles.known[chosen] + sign * extra)
        if not np.isfinite(value).all():
            solver, extra = solver.eliminated(chosen), extra if np.isfinite(extra) else None
            continue
        if rounds % (2 * _HASTY) == 0 and not (solver.solve(np.ones(core.size)) < 1 / _EPS).all():
            break  # runs so long that systems are not solved to any digit
        image = circles.backup(value)
        gain = sign * (circles.best(image) - value) + extra
        better = gain > _KEPT * extra
        if better.any():
            before = chosen
            if rounds <= _HASTY and not circles.is_chain:
                chosen = proper(_greedy(circles, sign * extra, value, _SWEEPS))
            else:
                chosen = propagate_improvements(
                    circles.matrix,
                    circles.known + sign * extra,
                    circles.owner,
                    value,
                    chosen,
                    sign,
                    _KEPT * extra,
                )
                if (chosen == before).all():
                    break  # what gains is rounding
            solver = solver.other(chosen)
            continue
        found = _prove(circles, solver, chosen, value, extra, unit)
        if found is not None:
            near, far, time = found
            own = value - sign * extra * time
            best = _Core(core, near, far, own, chosen, rounds, solver.method)
            if _narrow(best, sign, tolerance / 2, relative):
                break
        else:
            time = solver.solve(np.ones(core.size))
        other = _extra(time, value, unit, aim, relative)
        # A better policy may be worth so much more that its rounding asks for more.
        if extra / 2 <= other <= (2 * extra if found is None else np.inf):
            break
        extra = other
    for other_way in (_refined, _in_fractions):
        if best is not None and _narrow(best, sign, tolerance, relative):
            break
        # A policy that costs of steps led to, where little is proven, may linger nearly for ever.
        good = best is not None and _narrow(best, sign, _GOOD, relative)
        more = other_way(
            circles, core, label, best.chosen if best and good else first, errors, tolerance
        )
        if more is not None:
            best = more._replace(rounds=rounds + more.rounds)
    if best is None:
        low, high = np.zeros(core.size), np.full(core.size, np.inf)
        near, far = (low, high) if sign > 0 else (high, low)
        best = _Core(core, near, far, low, chosen, rounds, "nothing proven")
    return best._replace(chosen=circles.row[best.chosen])


def _narrow(found: _Core, sign: int, tolerance: float, relative: bool) -> bool:
    width = sign * (found.far - found.near)
    size = np.abs(found.near if sign > 0 else found.far) if relative else 1
    return bool((width <= tolerance * size).all())


def _system_of(circles: _Circles) -> System:
    return System(circles.matrix, circles.leaving, circles.known, circles.owner)


def _refined(
    circles: _Circles,
    core: Integers,
    label: Integers,
    chosen: Integers,
    errors: tuple[float, float],
    tolerance: float,
) -> _Core | None:
    """The same of a core that takes very long to end, by refinement beyond double precision."""

    def solver_of(rows: Integers) -> Any:
        solver = factorize(circles.matrix, label, rows)
        return None if solver is None else (solver.eliminated(rows) or solver).solve

    unit, grown = errors
    found = refined(_system_of(circles), unit, chosen, solver_of, circles.sign, tolerance)
    if found is None:
        return None
    share = found.share + grown
    near, far = (found.value * (1 - end * circles.sign * share) for end in (1, -1))
    return _Core(
        core,
        near,
        far,
        found.value,
        found.chosen,
        found.rounds,
        "policy iteration by elimination, refined",
    )


def _in_fractions(
    circles: _Circles,
    core: Integers,
    label: Integers,
    chosen: Integers,
    errors: tuple[float, float],
    tolerance: float,
) -> _Core | None:
    """The same of a small core, however rarely it ends: of the weights as floats give them."""
    del tolerance
    if core.size > LARGEST:
        return None
    order = elimination_order(circles.matrix[chosen], label)
    if order is None:
        return None
    found = exact_optimum(_system_of(circles), chosen, order, circles.sign)
    if found is None:
        return None
    value, rows = found
    share = share_of_values(sum(errors), core.size)
    near, far = (value * (1 - end * circles.sign * share) for end in (1, -1))
    return _Core(core, near, far, value, rows, 0, "policy iteration in fractions")


def _way_out(
    circles: _Circles, system: _System, core: Integers, problem: ShortestPathProblem
) -> Integers | None:
    """Rows by which the core is left almost surely, where some policies never leave."""
    if problem.first is None or circles.is_chain:
        return None
    given = problem.first[system.node[core]]
    hit = np.flatnonzero(system.row[circles.row] == given[circles.owner])
    found = np.arange(core.size)
    found[circles.owner[hit]] = hit
    return found


def _proper(circles: _Circles, leaving: Integers | None, chosen: Integers) -> Integers:
    """The policy, with other rows where it may never leave."""
    if leaving is None:
        return chosen
    rows = circles.matrix[chosen]
    leaves = rows.sum(1) < 1 - 1e-9  # what hardly leaves need not be counted
    return np.where(_getting_out(rows, leaves), chosen, leaving)


def _greedy(circles: _Circles, extra: float, value: Floats, sweeps: int) -> Integers:
    """The greedy policy after some sweeps of value iteration."""
    if circles.is_chain:
        return np.arange(circles.num_nodes)
    for _ in range(sweeps):
        image = circles.backup(value) + extra
        value = circles.best(image)
    return circles.argbest(image, value)


def _getting_out(rows: Any, leaves: Booleans) -> Booleans:
    back = Edges(rows.indptr, rows.indices).reverse()
    return forward_search(back.start, back.target, leaves)


def _extra(time: Floats, value: Floats, unit: float, aim: float, relative: bool) -> float:
    """What every step shall cost besides: little, but more than rounding."""
    most = float(np.abs(value).max(initial=0))
    if relative:
        some = value > 0
        share = float((value[some] / time[some]).min(initial=np.inf)) if some.any() else 1.0
        share = share if np.isfinite(share) and share > 0 else 1.0
    else:
        share = 1 / max(float(time.max(initial=1)), 1)
    return max(aim * share, 32 * unit * max(most, 1e-300))


def _prove(
    circles: _Circles, solver: Factors, chosen: Integers, value: Floats, extra: float, unit: float
) -> tuple[Floats, Floats, Floats] | None:
    """The bound that the policy attains, the one that nothing exceeds, and the policy's time.

    A value that the operator does not carry away from the optimum is a bound beyond it; and one
    that the policy's own operator does not carry towards it is attained, as the policy leaves.
    """
    sign = circles.sign
    slack = unit * (circles.known + circles.matrix @ np.abs(value))
    if not (sign * circles.backup(value) + slack <= sign * value[circles.owner]).all():
        return None
    time = solver.solve(np.ones(value.size))
    rows = circles.matrix[chosen]
    if not ((time >= 0) & (time - rows @ time >= 0.5)).all():
        return None
    near = value - sign * 1.5 * extra * time
    image = circles.known[chosen] + rows @ near
    slack = unit * (circles.known[chosen] + rows @ np.abs(near))
    if not (sign * near <= sign * image - slack).all():
        return None
    return near, value, time
