"""Geometry of Pareto fronts: convex hulls of attained points, and half-spaces.

All objectives are maximised. Vectors below mixtures of points are attained; values lie in
half-spaces with nonnegative normals. Linear programs find where the two are farthest apart; results
are certified in floating point with its rounding, or in fractions.
"""

from __future__ import annotations

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from jaxltl.core.array_types import Floats, Integers

_EPS = float(np.finfo(np.float64).eps)
_RESOLUTION = 1e-6  # of the size of a program: differences that it does not resolve
_ZOOMS = 12
_EXACT = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}


class Separation(NamedTuple):
    """Distance of a vector beyond the attained values."""

    distance: float  # the least t for which the vector less t times the scale is attained
    normal: Floats  # float64[n], of the separating hyperplane; sums to one in units of the scale
    share: Floats  # float64[N], the nearest mixture of points


def separation(points: Floats, vector: Floats, scale: Floats) -> Separation:
    """Distance of a vector ``float64[n]`` beyond the mixtures of points ``float64[N, n]``.

    A linear program resolves distances relative to its largest one. It is therefore solved again
    for the points near the face that it finds, relative to the vector, until all of these are far
    apart. `scale` ``float64[n]`` is the unit of each objective.
    """
    ahead = (points - vector) / scale
    chosen = np.arange(len(points))
    distance, normal, share = 0.0, np.full(scale.size, 1 / scale.size), np.eye(len(points))[0]
    for _ in range(_ZOOMS):
        size = float(np.abs(ahead[chosen]).max())
        face = _apart(ahead[chosen] / size, np.ones(scale.size)) if size > 0 else None
        if face is None:
            break
        distance, normal, share = face[0] * size, face[1], np.zeros(len(points))
        share[chosen] = face[2]
        height = ahead @ normal
        top = height[chosen].max()
        beyond = np.flatnonzero(height > top + 8 * _EPS * np.abs(ahead).max(1))
        upper = np.flatnonzero(height >= top - _RESOLUTION * size)
        if beyond.size:
            chosen = np.union1d(chosen, beyond)
        elif np.abs(ahead[upper]).max() > size / 2:
            break
        else:
            chosen = upper
    return Separation(distance, normal / scale, share)


def _apart(ahead: Floats, along: Floats) -> tuple[float, Floats, Floats] | None:
    """The least t with ``sum_i share_i ahead_i >= -t along``, the normal of that face, the shares."""
    from scipy import optimize

    count, size = ahead.shape
    program = optimize.linprog(
        np.append(np.zeros(count), 1.0),
        A_ub=np.hstack([-ahead.T, -along[:, None]]),
        b_ub=np.zeros(size),
        A_eq=np.append(np.ones(count), 0.0)[None],
        b_eq=[1.0],
        bounds=[(0, None)] * count + [(None, None)],
        method="highs",
        options=_EXACT,
    )
    if program.status != 0:
        return None
    normal = np.maximum(-np.asarray(program.ineqlin.marginals), 0)
    total = normal.sum()
    share = np.maximum(program.x[:-1], 0)
    return (
        float(program.x[-1]),
        normal / total if total > 0 else np.full(size, 1 / size),
        share / share.sum(),
    )


def mixture(lower: Floats, share: Floats) -> Floats:
    """Lower bound of the value of a mixture of policies, ``float64[n]``."""
    scale = 4 * _EPS * (len(share) + 2) / max(share.sum(), 1e-300)
    lower_bound: Floats = share @ lower - scale * (share @ np.abs(lower))
    return lower_bound


def meets(lower: Floats, share: Floats, wanted: Floats) -> bool:
    """True if a mixture certainly attains a vector, in exact arithmetic.

    Example:
      >>> meets(np.eye(2), np.array([0.5, 0.5]), np.array([0.5, 0.5]))
      True
    """
    used = np.flatnonzero(share)
    parts = [Fraction(float(x)) for x in share[used]]
    total = sum(parts, Fraction(0))
    for column, least in zip(lower[used].T, wanted, strict=True):
        if np.isfinite(least):
            sums = sum(
                (p * Fraction(float(x)) for p, x in zip(parts, column, strict=True)), Fraction(0)
            )
            if sums < Fraction(float(least)) * total:
                return False
    return True


def plain(share: Floats) -> Floats:
    """A mixture with simple fractions in place of numbers within rounding of them.

    >>> plain(np.array([0.25000000000000006, 0.75])).tolist()
    [0.25, 0.75]
    """
    simple = np.array([float(Fraction(float(x)).limit_denominator(1000)) for x in share])
    return np.where(np.abs(simple - share) < 1e-12, simple, share)


def exceeds(normal: Floats, bound: float, vector: Floats) -> bool:
    """True if a vector is certainly outside of a half-space ``normal @ y <= bound``."""
    slack = 4 * _EPS * (vector.size + 2) * (normal @ np.abs(vector) + abs(bound))
    return bool(normal @ vector - slack > bound)


class Largest(NamedTuple):
    """Largest value of one objective under thresholds on the others."""

    lower: float  # attained by the mixture; minus infinity without any
    share: Floats  # float64[N]
    upper: float  # not exceeded
    vector: Floats | None  # float64[n], the extreme vector within the half-spaces; None without any


def largest(
    points: Floats,
    half_spaces: tuple[Floats, Floats],
    index: int,
    thresholds: tuple[Floats, Floats],
    scale: Floats,
    known: Floats | None = None,
) -> Largest:
    """Bounds of the largest value of an objective under thresholds on the others.

    The value of the mixture meets the first ones; no value that meets the second ones is larger.
    """
    least, count = thresholds[0], len(points)
    constrained = np.flatnonzero(np.isfinite(least))
    lower, share = -np.inf, np.full(count, 1 / count)
    mixtures = (
        _largest_mixtures(points, index, least, constrained, scale) if constrained.size else []
    )
    if known is not None:
        mixtures.append(np.append(known, np.zeros(count - known.size)))
    mixtures += list(np.eye(count)[(points[:, constrained] >= least[constrained]).all(1)])
    for tried in mixtures:
        single = np.count_nonzero(tried) == 1
        value = points[tried.argmax()] if single else mixture(points, tried)
        if value[index] > lower and meets(points, tried, least):
            lower, share = float(value[index]), tried
    upper, vector = _outer(*half_spaces, index, thresholds[1], scale)
    return Largest(lower, share, upper, vector)


def _largest_mixtures(
    points: Floats, index: int, least: Floats, constrained: Integers, scale: Floats
) -> list[Floats]:
    """Candidates for the best mixture under thresholds."""
    inner = separation(points[:, constrained], least[constrained], scale[constrained]).share
    kept = np.append(constrained, index)
    ahead = (points - np.where(np.isfinite(least), least, 0))[:, kept] / scale[kept]
    face = _apart(ahead, np.append(np.zeros(constrained.size), 1.0))
    if face is None:
        return [inner]
    best = face[2]
    # A program is rounded: a small share of an inner point makes up for its error.
    misses = (least - mixture(points, best))[constrained] + 4 * _EPS * np.abs(least[constrained])
    misses = np.maximum(misses, 0)
    spare = (mixture(points, inner) - least)[constrained]
    if not (spare > 0).all():
        return [best, inner]
    part = float((misses / (misses + spare)).max())
    return [best, (1 - part) * best + part * inner]


def _outer(
    normals: Floats, bounds: Floats, index: int, least: Floats, scale: Floats
) -> tuple[float, Floats | None]:
    """Upper bound of an objective within half-spaces, and the vector that attains it."""
    from scipy import optimize

    constrained = np.isfinite(least)
    normals, bounds = normals[np.isfinite(bounds)], bounds[np.isfinite(bounds)]
    size = len(scale)
    goal = np.zeros(size)
    goal[index] = -1
    floor = [(x / s if np.isfinite(x) else None, None) for x, s in zip(least, scale, strict=True)]
    program = optimize.linprog(
        goal, A_ub=normals * scale, b_ub=bounds, bounds=floor, method="highs", options=_EXACT
    )
    if program.status != 0:
        return np.inf, None
    weight = np.maximum(-np.asarray(program.ineqlin.marginals), 0)
    # Any nonnegative combination of half-spaces is one; the others meet their thresholds.
    normal, bound = weight @ normals, float(weight @ bounds)
    if not normal[index] > 0:
        return np.inf, program.x * scale
    others = np.arange(size) != index
    needless = others & ~constrained
    if (normal[needless] > 1e-12 * normal[index]).any():
        return np.inf, program.x * scale
    taken = np.where(others & constrained, least, 0)
    upper = (bound - normal @ taken) / normal[index]
    slack = (
        8
        * _EPS
        * (len(weight) + size)
        * (weight @ np.abs(bounds) + normal @ np.abs(taken))
        / normal[index]
    )
    return float(upper + slack), program.x * scale


def corners(normals: Floats, bounds: Floats, floor: Floats) -> Floats:
    """The corners of half-spaces above a floor, ``float64[V, n]``."""
    normals, bounds = normals[np.isfinite(bounds)], bounds[np.isfinite(bounds)]
    size = len(floor)
    if size == 2:
        return _corners_of_two(normals, bounds, floor)
    from scipy import optimize, spatial

    faces = np.vstack([normals, -np.eye(size)])
    limits = np.concatenate([bounds, -floor])
    length = np.linalg.norm(faces, axis=1)
    inner = optimize.linprog(
        np.append(np.zeros(size), -1.0),
        A_ub=np.hstack([faces, length[:, None]]),
        b_ub=limits,
        bounds=[(None, None)] * size + [(0, None)],
        method="highs",
    )
    if inner.status != 0 or inner.x[-1] <= 1e-12:
        return np.zeros((0, size))
    sides = np.hstack([faces, -limits[:, None]])
    vertices: Floats = spatial.HalfspaceIntersection(
        sides, inner.x[:-1], qhull_options="QJ"
    ).intersections
    return vertices


def _corners_of_two(normals: Floats, bounds: Floats, floor: Floats) -> Floats:
    faces = np.vstack([normals, -np.eye(2)])
    limits = np.concatenate([bounds, -floor])
    first, second = np.triu_indices(len(faces), 1)
    a, b = faces[first], faces[second]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    kept = np.abs(det) > 1e-12 * np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    a, b, det = a[kept], b[kept], det[kept]
    c, d = limits[first[kept]], limits[second[kept]]
    points = np.stack([(c * b[:, 1] - d * a[:, 1]) / det, (a[:, 0] * d - b[:, 0] * c) / det], -1)
    slack = 1e-9 * (1 + np.abs(limits) + np.abs(faces) @ np.abs(floor))
    kept = (points @ faces.T <= limits + slack).all(1)
    vertices: Floats = points[kept]
    return vertices
