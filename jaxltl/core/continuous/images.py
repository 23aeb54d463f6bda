"""Boxes of the successors of cells, from linear bounds over blocks of cells.

The next state of state x under noise w is enclosed, over a block of cells, by an affine form in x and
w with an error. Where the error is small against the variation over one cell, the form serves all
cells of the block; elsewhere the block is cut. One coordinate of the noise stays random for each
coordinate of the state; the rest of the noise is treated as chosen by an adversary.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from jaxltl.core.array_types import Booleans, Floats, Integers
from jaxltl.core.continuous.grid import Grid
from jaxltl.core.continuous.regions import UndefinedError
from jaxltl.core.enclosures.interval import Interval
from jaxltl.core.enclosures.linear_bounds import AffineForm, EnclosedProgram, propagate
from jaxltl.core.enclosures.program import Elementwise, StraightLineProgram, make_program
from jaxltl.core.models.ops.array_namespace import enable_x64
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.pretty_print import brief


Step = Callable[[PyTree, PyTree, PyTree], PyTree]
# Coordinate i of the next state is `m_i + g_i w_i`. Its interval probabilities hold for every value of
# `m_i` that does not depend on `w_i`; products of them over the coordinates hold if each `m_i` depends
# on noises of earlier coordinates alone, given which the next one is bounded. Bounds of the
# derivatives in the noise decide both: by the mean value theorem `m_i` varies with a noise at most as
# much as the derivative differs from the gain that was taken out.
_UNDERFLOW = 1e-200  # of products with 0 that are rounded outward
# Functions that may jump: their derivatives do not bound their variation.
_JUMPS = {"sign", "floor", "ceil", "round", "lt", "le", "gt", "ge", "eq", "ne", "atan2", "pow"}
_ADVERSARY = (
    "all noise is treated as chosen by an adversary, so that the bounds may be wide; write the step as a "
    "smooth function of the noise."
)


def gain_program(step: Step, specs: Sequence[jax.ShapeDtypeStruct]) -> StraightLineProgram:
    """A step, and its derivatives ``[k, n]`` in the noise unless they bound no variation.

    One program for both, since the derivatives need what the step computes: of a policy, say.
    """
    program = make_program(lambda x, u, w: step(x, u, w), *specs)
    if specs[2].shape[0] == 0:
        return program
    if jumps(program):
        warnings.warn(f"the step may jump in the noise: {_ADVERSARY}", stacklevel=2)
        return program

    def gains(x: jax.Array, u: jax.Array, w: jax.Array) -> tuple[PyTree, jax.Array]:
        following, push = jax.linearize(lambda v: step(x, u, v), w)
        units = np.eye(len(w), dtype=w.dtype)
        return following, jnp.concatenate([push(unit)[None] for unit in units])

    try:
        return make_program(gains, *specs)
    except ValueError as error:
        warnings.warn(
            f"the derivative of the step in the noise has no enclosure ({error}) {_ADVERSARY}",
            stacklevel=2,
        )
        return program


def jumps(program: StraightLineProgram) -> bool:
    """True if a function that may jump is applied to variables that depend on the last input."""
    noisy = {program.inputs[-1]}
    for operation in program.operations:
        if not noisy.intersection(operation.inputs):
            continue
        noisy.add(operation.output)
        if isinstance(operation, Elementwise):
            real = jnp.issubdtype(program.shapes[operation.output].dtype, jnp.floating)
            if operation.name in _JUMPS or not real:
                return True
    return False


def gain_bounds(known: EnclosedProgram, shape: tuple[int, ...]) -> tuple[Floats, Floats]:
    """Bounds ``[C, k, n]`` of the derivatives over boxes; infinite where none is known."""
    if len(known.program.outputs) == 1:
        return np.full(shape, -np.inf), np.full(shape, np.inf)
    derivatives = known.intervals[known.program.outputs[1]]
    low, high = (
        np.broadcast_to(x.reshape(-1, *shape[1:]), shape)
        for x in (derivatives.low, derivatives.high)
    )
    finite = np.isfinite(low) & np.isfinite(high)
    zero = np.maximum(np.abs(low), np.abs(high)) < _UNDERFLOW
    low, high = np.where(zero, 0.0, low), np.where(zero, 0.0, high)
    return np.where(finite, low, -np.inf), np.where(finite, high, np.inf)


def conditioning_order(
    noise_of: Sequence[int], depends: Booleans, share: Floats
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """An order of the coordinates, and the noises that remain assigned to them.

    Coordinates may depend on the noises of ``depends bool[k, n]``. In a cycle of dependences the one
    with the least share loses its noise, which is then treated as chosen by an adversary.
    """
    assigned, order = list(noise_of), list[int]()
    remaining = list(range(len(assigned)))
    while remaining:
        free = [
            i for i in remaining
            if not any(depends[assigned[j], i] for j in remaining if j != i and assigned[j] >= 0)
        ]  # fmt: skip
        if free:
            order.append(free[0])
            remaining.remove(free[0])
        else:
            assigned[min((i for i in remaining if assigned[i] >= 0), key=lambda i: share[i])] = -1
    return tuple(order), tuple(assigned)


_LENGTHS = (16, 4, 1)  # of blocks, in cells along an axis
# A block's form is used if its error is below these shares of the half-width of a cell's image and
# of the noise: less trades more evaluations for narrower images.
CELL_SHARE, NOISE_SHARE = 0.15, 0.02
_CHUNK = 1024  # boxes of one evaluation, which then fits into the caches
_ROWS = 2**12  # pairs of cells and actions at once, which bounds the memory
_ROUNDING = 1e-13  # relative error of a few operations in float64, with a margin of 100
_CONSTANT = 1e-14  # relative width of the bounds of a constant gain
_EQUAL_GAINS = 1e-6  # gains of the noise that differ by less are one


@brief
@dataclass(frozen=True)
class Images:
    """Boxes of successors, for rows that are pairs of cells and actions, the cell first.

    Coordinate i of the next state is in `[low_i, high_i] + gain_i w_i` with the noise `w_i` that
    `noise_of` assigns to it.
    """

    cells: Integers  # int[M], the cells of the rows
    low: Floats  # float[M * A, n]
    high: Floats
    gain: Floats  # float[M * A, n], not negative; 0 without noise
    noise_of: tuple[int, ...]  # for each coordinate the index of its noise, or -1
    # float[M * A, n], the part of the box that may depend on `w_i` itself; None: 0
    varying: Floats | None = None
    # the coordinates in an order in which each box depends on noises of earlier ones alone; ()
    # for any order
    order: tuple[int, ...] = ()

    def columns(self, axis: int, rows: Integers | None) -> list[Floats]:
        """Low, high, gain and variation of a coordinate in some rows; equal rows stay one in memory."""
        none = np.broadcast_to(0.0, self.low.shape) if self.varying is None else self.varying
        arrays = [x[:, axis] for x in (self.low, self.high, self.gain, none)]
        if rows is None:
            return arrays
        return [x[: len(rows)] if x.strides[0] == 0 else x[rows] for x in arrays]


@dataclass(frozen=True)
class NoiseBox:
    """Bounds of the noise: `low <= w <= high`, and the coordinates that are random and symmetric.

    The noise is outside with probability at most `lost`.
    """

    low: Floats
    high: Floats
    random: Booleans
    symmetric: Booleans
    lost: float = 0.0


def image_boxes(
    step: Step, grid: Grid, cells: Integers, actions: Floats, noise: NoiseBox
) -> Images:
    """Boxes of successors of cells under each action of ``float[A, m]``.

    Raises:
      ValueError: if `step` cannot be traced or enclosed, with the place, or is unbounded on a cell.
      UndefinedError: if it may be NaN on a cell.
    """
    cells = np.asarray(cells)
    sizes = grid.num_axes, actions.shape[1], len(noise.low)
    with enable_x64(True):
        program = gain_program(step, [jax.ShapeDtypeStruct((k,), np.float64) for k in sizes])
    num_actions, n = len(actions), grid.num_axes
    arrays = [np.empty((len(cells), num_actions, n)) for _ in range(4)]
    todo = np.ones(len(cells), bool)
    order, noise_of = tuple(range(n)), (-1,) * n
    index = np.stack(np.unravel_index(cells, grid.shape), -1)
    usual: Floats | None = None
    adversarial: Integers | None = None  # a cell on which a derivative in the noise is unbounded
    for length in _LENGTHS:
        size = tuple(min(length, k) for k in grid.shape)
        rows = np.flatnonzero(todo)
        start, of_block = _blocks(index[rows], grid.shape, size)
        # The largest blocks are few, and decide the order of the coordinates for all cells.
        many = max(len(start), 1) if usual is None else max(_ROWS // num_actions, 1)
        for first in range(0, len(start), many):
            form = _forms(program, grid, start[first : first + many], size, actions, noise)
            if usual is None:
                order, noise_of = _assigned(form, noise)
            random = _random_part(form, noise, noise_of, usual)
            usual = random.usual
            mine = np.flatnonzero((of_block >= first) & (of_block < first + many))
            for part in np.array_split(mine, -(-len(mine) * num_actions // _ROWS)):
                here = rows[part]
                block = of_block[part] - first
                image, accepted = _cell_images(form, random, grid, cells[here], block)
                accepted |= max(size) == 1
                missing = accepted & random.unknown[block] & (len(program.outputs) > 1)
                if missing.any():
                    adversarial = cells[here[missing]][:1]
                for array, new in zip(arrays, image, strict=True):
                    array[here[accepted]] = new[accepted]
                todo[here[accepted]] = False
        if not todo.any():
            break
    undefined = np.isnan(arrays[0]).any((1, 2))
    if undefined.any():
        raise UndefinedError(
            f"the step or the policy may be NaN on the cell {_text(grid, cells[[undefined.argmax()]])}; "
            "define it in the whole domain, or give more cells, or a domain without such states."
        )
    with np.errstate(invalid="ignore"):
        unbounded = ~np.isfinite(arrays[1] - arrays[0]).all((1, 2))
    if unbounded.any():
        raise ValueError(
            "the step or the policy is unbounded, as far as intervals show, on the cell "
            f"{_text(grid, cells[[unbounded.argmax()]])}; bound it by jnp.clip or jnp.where, give more "
            "cells, or a domain without such states."
        )
    if adversarial is not None:
        warnings.warn(
            "a derivative of the step in the noise is unbounded, as far as intervals show, on the cell "
            f"{_text(grid, adversarial)}: there {_ADVERSARY}",
            stacklevel=2,
        )
    low, high, gain, varying = (x.reshape(-1, n) for x in arrays)
    return Images(cells, low, high, _compact(gain), noise_of, _compact(varying), order)


def _text(grid: Grid, cell: Integers) -> str:
    """The ends of one cell."""
    low, high = (x[0].round(6).tolist() for x in grid.boxes(cell))
    return f"{low} to {high}"


def _blocks(
    index: Integers, shape: tuple[int, ...], size: tuple[int, ...]
) -> tuple[Integers, Integers]:
    """First cells ``int[B, n]`` of the blocks that contain cells ``int[M, n]``, and the block of each."""
    block_shape = tuple(-(-k // b) for k, b in zip(shape, size, strict=True))
    number = np.ravel_multi_index(tuple((index // np.array(size)).T), block_shape)
    blocks, of_block = np.unique(number, return_inverse=True)
    start = np.stack(np.unravel_index(blocks, block_shape), -1) * np.array(size)
    return start, of_block.reshape(-1)


def _compact(rows: Floats) -> Floats:
    """Equal rows as one row in memory."""
    return np.broadcast_to(rows[0].copy(), rows.shape) if (rows == rows[:1]).all() else rows


@dataclass(frozen=True)
class _Forms:
    """Affine forms of blocks (N) and actions (A): `middle + slope e + gains (w - w_mid) +- error`."""

    low: Floats  # [N, A, n], of the whole block and all noise
    high: Floats
    middle: Floats  # [N, A, n]
    error: Floats  # [N, A, n]
    gain_low: Floats  # [N, A, k, n], bounds of the derivatives in the noise
    gain_high: Floats
    slope: Floats  # [N, A, n, n], of the block's e in [-1, 1]^n: state coordinate, then output
    gains: Floats  # [N, A, k, n]
    centre: Floats  # [N, n], of the blocks
    radius: Floats


def _forms(
    program: StraightLineProgram,
    grid: Grid,
    start: Integers,
    size: tuple[int, ...],
    actions: Floats,
    noise: NoiseBox,
) -> _Forms:
    """Forms over blocks, evaluated in chunks on two threads or more."""
    n, k, num_actions = grid.num_axes, len(noise.low), len(actions)
    stop = np.minimum(start + np.array(size), np.array(grid.shape))
    first, last = (
        np.stack([e[i] for e, i in zip(grid.edges, at.T, strict=True)], -1) for at in (start, stop)
    )
    total, width = len(start) * num_actions, n + actions.shape[1] + k

    def evaluate(begin: int) -> list[Floats]:
        row = np.arange(begin, min(begin + _CHUNK, total))
        block, action = row // num_actions, actions[row % num_actions]
        wide = (np.broadcast_to(x, (len(row), k)) for x in (noise.low, noise.high))
        boxes = [Interval(first[block], last[block]), Interval(action, action), Interval(*wide)]
        known = propagate(program, boxes)
        y = program.outputs[0]
        bounds, form = known.intervals[y], known.forms.get(y)
        if form is None:  # the output does not depend on the inputs
            form = AffineForm(np.zeros((1, 0, n)), bounds.middle, bounds.radius)
        gains = gain_bounds(known, (len(row), k, n))
        slope = np.zeros((len(row), width, n))
        slope[:, : form.slope.shape[1]] = form.slope
        usable = np.isfinite(form.error)
        slope, middle = np.where(usable[:, None], slope, 0.0), np.where(usable, form.middle, 0.0)
        error = np.where(usable, form.error, np.inf)
        parts_of_chunk = (bounds.low, bounds.high, middle, error, *gains, slope)
        return [np.broadcast_to(x, (len(row), *x.shape[1:])) for x in parts_of_chunk]

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        parts = list(pool.map(evaluate, range(0, total, _CHUNK)))
    *arrays, slope = (
        np.concatenate(x).reshape(len(start), num_actions, *x[0].shape[1:])
        for x in zip(*parts, strict=True)
    )
    state, gains = slope[:, :, :n], slope[:, :, width - k :]
    low, high, middle, error, gain_low, gain_high = arrays
    centre, radius = (first + last) / 2, (last - first) / 2
    return _Forms(low, high, middle, error, gain_low, gain_high, state, gains, centre, radius)


def _assigned(form: _Forms, noise: NoiseBox) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """The order of the coordinates and the random noise of each: at most one coordinate each.

    The largest gains are random. All other noise is treated as chosen by an adversary that knows the
    noises of earlier coordinates.
    """
    noise_of = [-1] * form.gains.shape[-1]
    size = np.abs(np.nan_to_num(form.gains)).mean((0, 1))  # [k, n], of one radius of the noise
    for j, i in zip(*scipy.optimize.linear_sum_assignment(-size), strict=True):
        if noise.random[j] and size[j, i] > 0:
            noise_of[i] = int(j)
    depends = ((form.gain_low != 0) | (form.gain_high != 0)).any((0, 1))
    own = np.array([size[j, i] if j >= 0 else 0.0 for i, j in enumerate(noise_of)])
    return conditioning_order(noise_of, depends, own / np.maximum(size.sum(0), 1e-300))


def _cell_images(
    form: _Forms, random: _Random, grid: Grid, cells: Integers, of_block: Integers
) -> tuple[list[Floats], Booleans]:
    """Low, high, gain and variation ``[M, A, n]`` of cells by the forms of their blocks.

    The second result marks the cells ``bool[M]`` for which the forms are accurate.
    """
    low, high = grid.boxes(cells)
    radius = np.where(form.radius > 0, form.radius, 1)[of_block]
    offset = ((low + high) / 2 - form.centre[of_block]) / radius
    share = (high - low) / 2 / radius * (1 + _ROUNDING)
    slope = form.slope[of_block]
    size = np.abs(slope)
    middle = form.middle[of_block] + np.einsum("ca,cuai->cui", offset, slope)
    half_width = np.einsum("ca,cuai->cui", share, size)
    fuzzy = np.abs(form.middle[of_block]) + size.sum(-2) + np.abs(form.gains[of_block]).sum(-2)
    own, reach, varying = (x[of_block] for x in (random.gain, random.reach, random.varying))
    noise_low, noise_high = random.low, random.high
    error = form.error[of_block] + fuzzy * _ROUNDING
    allowed = CELL_SHARE * half_width + NOISE_SHARE * own * (noise_high - noise_low) / 2
    small = (error <= allowed) & (varying <= allowed)
    half = (half_width + error + reach) * (1 + _ROUNDING)
    middle = (
        middle - own * (noise_low + noise_high) / 2
    )  # forms are centred at the middle of the noise
    low, high = middle - half, middle + half
    # Where these are infinite, the interval with all of the noise.
    unknown = ~(np.isfinite(low) & np.isfinite(high))
    low = np.where(unknown, form.low[of_block] - own * noise_high, low)
    high = np.where(unknown, form.high[of_block] - own * noise_low, high)
    return [low, high, own, varying], (small & ~unknown).all((1, 2))


@dataclass(frozen=True)
class _Random:
    """Gain of the random noise, half-width of all other noise, and variation with the random one."""

    gain: Floats  # [N, A, n]
    reach: Floats
    varying: Floats
    low: Floats  # [n], bounds of the random noise
    high: Floats
    usual: Floats  # [n], gains to which nearly equal ones are set
    unknown: Booleans  # [N], blocks on which a derivative in random noise has no bounds


def _random_part(
    form: _Forms, noise: NoiseBox, noise_of: tuple[int, ...], usual: Floats | None
) -> _Random:
    """The parts of the noise; the usual gains are those of the largest blocks."""
    ends = [(noise.low[j], noise.high[j]) if j >= 0 else (0.0, 0.0) for j in noise_of]
    typical = np.zeros(len(noise_of)) if usual is None else usual
    radius = (noise.high - noise.low) / 2
    reach = np.abs(form.gains).sum(2)
    gain, varying = np.zeros(reach.shape), np.zeros(reach.shape)
    bounded = np.isfinite(form.gain_low) & np.isfinite(form.gain_high)
    unknown: Booleans = np.logical_not(bounded[:, :, noise.random].all(axis=(1, 2, 3)))
    for i, j in enumerate(noise_of):
        if j < 0:
            continue
        slope = form.gains[:, :, j, i]
        low, high = form.gain_low[:, :, j, i], form.gain_high[:, :, j, i]
        if noise.symmetric[j]:  # the noise and its reflection have one distribution
            flip = slope < 0
            slope = np.abs(slope)
            low, high = np.where(flip, -high, low), np.where(flip, -low, high)
        known = np.isfinite(low) & np.isfinite(high)
        low, high = np.where(known, low, 0.0), np.where(known, high, 0.0)
        # The form's slope errs by its error; the derivative's bounds may be wider, as of a clip.
        own, wide = low / 2 + high / 2, 2 * form.error[:, :, i] / radius[j]
        by_form = known & np.isfinite(slope + wide) & (wide < high / 2 - low / 2)
        own = np.where(by_form, slope / radius[j], own)
        low, high = (np.where(by_form, own + d * wide, x) for d, x in ((-1, low), (1, high)))
        if usual is None:
            typical[i] = np.median(own)
        is_typical = np.abs(own - typical[i]) <= _EQUAL_GAINS * abs(typical[i])
        own = np.where(is_typical, typical[i], own)
        own = np.where(own > 0, own, 0.0)
        apart = np.maximum(high - own, own - low) * radius[j]
        # Bounds of a constant derivative differ by their rounding.
        constant = apart <= _CONSTANT * own * radius[j]
        varying[:, :, i] = np.where((own > 0) & ~constant, apart * (1 + _ROUNDING), 0.0)
        gain[:, :, i] = own
        reach[:, :, i] += np.abs(slope - own * radius[j]) - np.abs(slope)
        reach[:, :, i] = np.maximum(reach[:, :, i], 0) + np.abs(slope) * _ROUNDING
    low, high = np.array(ends).T
    return _Random(gain, reach, varying, low, high, typical, unknown)
