"""Optima of policy and nature together where policy iteration finds no narrow bounds.

The extreme distributions of short rows become choices of an MDP, whose solver has bounds however
long runs may last. Longer rows and balls have the bounds of value iteration from both sides.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.sparse.interval.row_table import exact_greedy, row_parts
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.mdp import HostMDP
from jaxltl.core.sparse.rows import concatenated_ranges, mask_of, offsets_from_counts

_EPS = float(np.finfo(np.float64).eps)
_LONGEST = 5  # successors of a row up to which all orders of them are tried
_MOST = 5_000_000  # masses of all orders
_LEAST = 2.0**-44  # masses below have fewer correct digits
_SWEEPS, _WORK = 2000, 2e8  # sweeps of value iteration, and entries read by them


class VertexModel(NamedTuple):
    """An MDP whose choices are extreme distributions of rows."""

    mdp: HostMDP
    row: Integers  # int[V], the row of each choice
    place: Integers  # int[T'], the original entry of each transition
    full: HostMDP  # the original rows

    def distributions(self, chosen: Integers, otherwise: Floats) -> Floats:
        """Nature's distributions ``float64[T]`` of chosen vertices; others in rows not taken."""
        start = self.mdp.entry_start
        entry = concatenated_ranges(start[chosen], start[chosen + 1] - start[chosen])
        p = np.where(mask_of(self.row[chosen], self.full.num_rows)[self.full.row], 0, otherwise)
        p[self.place[entry]] = self.mdp.probability[entry]
        return p


def vertex_model(model: UncertainMDP) -> VertexModel | None:
    """The MDP of extreme distributions, if rows are short and all masses accurate; None otherwise."""
    mdp, width = model.mdp, np.diff(model.mdp.entry_start)
    longest = int(width.max())
    if model.ball is not None or longest > _LONGEST:
        return None
    if math.factorial(longest) * mdp.num_transitions > _MOST:
        return None
    single = np.logical_and.reduceat(model.lower == model.upper, mdp.entry_start[:-1])
    rows, masses, entries = [], [], []
    for part in row_parts(mdp.entry_start):
        size = part.entry.shape[0]
        lower, upper = (
            (x[part.entry] if part.used is None else np.where(part.used, x[part.entry], 0)).T
            for x in (model.lower, model.upper)
        )
        alone = single[part.row]
        extreme = np.empty((part.row.size, math.factorial(size), size))
        for k, turn in enumerate(itertools.permutations(range(size))):
            extreme[:, k, turn] = exact_greedy(lower[:, turn], upper[:, turn])
        extreme[alone] = mdp.probability[part.entry].T[alone][:, None]
        if part.used is not None:
            extreme *= part.used.T[:, None]
        # Equal vertices of a row are next to each other in lexicographic order.
        flat = extreme.reshape(-1, size)
        row = np.repeat(part.row, extreme.shape[1])
        order = np.lexsort((*flat.T, row))
        row, flat = row[order], flat[order]
        new = np.ones(row.size, bool)
        new[1:] = (row[1:] != row[:-1]) | (flat[1:] != flat[:-1]).any(1)
        place = np.repeat(part.entry.T, extreme.shape[1], axis=0)
        rows.append(row[new])
        masses.append(flat[new])
        entries.append(place[new])
    row = np.concatenate(rows)
    order = np.argsort(row, kind="stable")
    wide = max(x.shape[1] for x in masses)
    mass, place = (
        np.concatenate([np.pad(x, ((0, 0), (0, wide - x.shape[1]))) for x in arrays])[order]
        for arrays in (masses, entries)
    )
    row, kept = row[order], mass > 0
    if (mass[kept] < _LEAST).any():
        return None
    place = place[kept]
    starts = offsets_from_counts(np.bincount(mdp.state[row], minlength=mdp.num_states))
    vertices = HostMDP(starts, offsets_from_counts(kept.sum(1)), mdp.successor[place], mass[kept])
    return VertexModel(vertices, row, place, mdp)


def swept_bounds(
    model: UncertainMDP, interior: Booleans, known: Floats, cost: Floats, *, maximize: bool
) -> tuple[Floats, Floats]:
    """Bounds of the joint optimum by value iteration from zero and, of probabilities, from one."""
    mdp, opt = model.mdp, np.maximum if maximize else np.minimum
    widest = int(np.diff(mdp.entry_start).max())
    num_sweeps = min(_SWEEPS, int(_WORK / (mdp.num_transitions + 1)) + 1)
    bounds = []
    for side in (-1, 1):
        if side > 0 and cost.any():
            bounds.append(np.where(interior, np.inf, known))
            continue
        value, error = np.where(interior, float(side > 0), known), 0.0
        for _ in range(num_sweeps):
            before, ahead = value, value[mdp.successor]
            p = model.extreme_distributions(ahead, maximize=maximize)
            image = model.sum_rows(p * ahead) + cost
            value = np.where(interior, mdp.over_choices(opt, image), known)
            size = float(value.max(initial=0))
            if not np.isfinite(size):
                value = before
                break
            error += 64 * (widest + 8) * _EPS * size  # rows sum to at most one
            if np.abs(value - before).max(initial=0) <= 4 * _EPS * size:
                break
        bounds.append(np.where(interior, np.maximum(value + side * error, 0), known))
    return bounds[0], bounds[1]
