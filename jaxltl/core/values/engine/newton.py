"""Newton's method for discounted values of every kind, with sweeps where it does not take hold.

A backup is ``T v = f(g + c P v)`` with a reward g, a discount c and a way f to combine the actions:
a policy's mean, the maximum, the soft maximum, the softmax mean. Its derivative is ``c P_w`` with
weights w of the actions, so that Newton's method is policy iteration with the policy w (Puterman
and Brumelle 1979). One loop holds the sweeps, the linear solver and the judging of both.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops.choices import Layout, Quantity, SweepOperator
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.values.engine.iterate import iterate
from jaxltl.core.values.engine.linear import (
    Bicgstab,
    System,
    inverse,
    is_small,
    norm,
    start_bicgstab,
)

# From the choices, their values, and parameters: the value and the weights of its derivative.
Combine = Callable[[Layout, Quantity, PyTree], tuple[jax.Array, Quantity]]
# From value, image and parameters: whether it is good enough, and how good it is.
Judge = Callable[[jax.Array, jax.Array, PyTree], tuple[jax.Array, jax.Array]]

_INNER = 128  # applications of P in the linear solver for one step of Newton's
_EXACT = 1e-2  # relative residual asked of it


class Backup(NamedTuple):
    """A backup at some numbers; lanes may differ in all of it."""

    reward: Quantity  # ``float[N]`` for each action, of a sparse model ``float[R]``
    scale: jax.Array  # the discount, a scalar or ``float[N]``
    damping: jax.Array  # how much of the old value a sweep keeps
    extra: PyTree  # what `combine` and `judge` read besides


class Method(NamedTuple):
    """A search: by steps of Newton's method or by sweeps alone, of a backup that may be monotone."""

    combine: Combine
    judge: Judge
    newton: bool = True
    monotone: bool = True


class _Search(NamedTuple):
    """State of the search of a lane: the next argument of P, and its purpose."""

    phase: jax.Array
    z: jax.Array
    value: jax.Array  # the best so far, with its image and the weights of the derivative there
    image: jax.Array
    weight: jax.Array  # [A, N], or [R]
    error: jax.Array
    done: jax.Array
    newton: jax.Array  # whether z is a step of Newton's, to be judged
    plain: jax.Array  # sweeps to come before the next of Newton's
    pause: jax.Array
    solved: jax.Array  # whether its linear system was solved
    krylov: Bicgstab  # on the correction
    target: jax.Array
    inner: jax.Array


_LOOK, _FIRST, _SECOND, _DIRECT = range(4)


def solve(
    table: SweepOperator,
    method: Method,
    backup: Backup,
    value: jax.Array,
    *,
    first_sweeps: int = 0,
    max_steps: jax.Array | int,
) -> tuple[jax.Array, ...]:
    """A value near a backup's fixed point, its image, number of steps and weights; unproven."""
    # Sweeps ``v <- v + (1 - damping) (T v - v)`` and steps of Newton's method, with linear
    # systems solved to a hundredth by BiCGSTAB, or where that fails, on small models with a monotone
    # backup, by elimination. A step is kept if it halves the error, and where the backup is
    # monotone and convex also if its system was solved; if not, ever more sweeps come before the
    # next.
    # Elsewhere an exact step is no better than another.
    newton = method.newton
    small = method.monotone and is_small(table, value.shape[0])
    over = table.choices

    def step(table: SweepOperator, k: _Search, given: Backup) -> _Search:
        over, ahead = table.choices, table.expectation(k.z)
        branches = [partial(_look, over, method, given)]
        if newton:
            branches += [partial(_first, over, given), partial(_second, over, small, given)]
        if newton and small:
            branches += [partial(_direct, table, given)]
        if len(branches) == 1:
            return branches[0](k, ahead)
        result: _Search = lax.switch(k.phase, branches, k, ahead)
        return result

    zero = jnp.zeros_like(value)
    weight: Quantity = over.spread(zero, backup.reward)
    scalar, none, no = zero[0], jnp.int32(0), jnp.bool_(False)
    start = _Search(
        phase=jnp.int32(_LOOK),
        z=value,
        value=value,
        image=value,
        weight=over.packed(weight),
        error=jnp.full_like(scalar, jnp.inf),
        done=no,
        newton=no,
        plain=jnp.int32(first_sweeps),
        pause=none,
        solved=no,
        krylov=start_bicgstab(zero, zero),
        target=scalar,
        inner=none,
    )
    # Side by side wins where a row of lanes fills a vector unit, which doubles do not.
    lanes = "side by side" if not newton and value.dtype.itemsize <= 4 else "in turn"
    last, n = iterate(
        step, lambda k, _: k.done, (table, start, backup), max_steps=max_steps, lanes=lanes
    )
    return last.value, last.image, n, last.weight


def _look(over: Layout, method: Method, given: Backup, k: _Search, ahead: Quantity) -> _Search:
    """Judges z by its image, and says what follows."""
    image, weight = method.combine(over, action_values(over, given, ahead), given.extra)
    done, error = method.judge(k.z, image, given.extra)
    if not method.newton:
        sweep = k.z + (1 - given.damping) * (image - k.z)
        return k._replace(z=sweep, value=k.z, image=image, error=error, done=done)
    weight = over.packed(weight)
    kept = ~k.newton | (error <= k.error / 2)  # false for NaN
    if method.monotone:
        kept |= k.solved & jnp.isfinite(error)
    value, image, weight, error = jax.tree.map(
        partial(jnp.where, kept), (k.z, image, weight, error), (k.value, k.image, k.weight, k.error)
    )
    change = image - value
    pause = jnp.where(kept, jnp.where(k.newton, 0, k.pause), 2 * k.pause + 4)
    plain = jnp.where(kept, jnp.maximum(k.plain - 1, 0), pause)
    sweeps = plain > 0
    sweep = value + (1 - given.damping) * change
    return k._replace(
        phase=jnp.where(sweeps, _LOOK, _FIRST).astype(jnp.int32),
        z=jnp.where(sweeps, sweep, change),
        value=value,
        image=image,
        weight=weight,
        error=error,
        done=done & kept,
        newton=~sweeps,
        plain=plain,
        pause=pause,
        solved=jnp.zeros_like(done),
        krylov=start_bicgstab(jnp.zeros_like(change), change),
        target=_EXACT * norm(change),
        inner=jnp.zeros_like(k.inner),
    )


def action_values(over: Layout, given: Backup, ahead: Quantity) -> Quantity:
    """Action values ``g + c x``, with x the expected next value of each choice."""
    return jax.tree.map(
        lambda g, c, x: g + c * x, given.reward, over.spread(given.scale, ahead), ahead
    )


def _applied(over: Layout, given: Backup, k: _Search, ahead: Quantity) -> jax.Array:
    weight: Quantity = over.unpacked(k.weight)
    return k.z - given.scale * over.mean(weight, ahead)


def _first(over: Layout, given: Backup, k: _Search, ahead: Quantity) -> _Search:
    krylov = k.krylov.first(_applied(over, given, k, ahead))
    return k._replace(krylov=krylov, z=krylov.r, phase=jnp.full_like(k.phase, _SECOND))


def _second(over: Layout, small: bool, given: Backup, k: _Search, ahead: Quantity) -> _Search:
    krylov = k.krylov.second(_applied(over, given, k, ahead))
    size, inner = krylov.size, k.inner + 2
    solved = size <= k.target
    failed = ~solved & ((inner >= _INNER) | ~jnp.isfinite(size))
    after = jnp.where(solved, _LOOK, jnp.where(failed, _DIRECT if small else _LOOK, _FIRST))
    return k._replace(
        phase=after.astype(jnp.int32),
        krylov=krylov,
        inner=inner,
        solved=solved,
        z=jnp.where(solved | failed, k.value + krylov.x, krylov.p),
    )


def _direct(table: SweepOperator, given: Backup, k: _Search, ahead: Quantity) -> _Search:
    del ahead
    matrix = System(table, table.choices.unpacked(k.weight), given.scale).matrix()
    z = k.value + inverse(matrix) @ (k.image - k.value)
    return k._replace(phase=jnp.full_like(k.phase, _LOOK), z=z, solved=jnp.ones_like(k.solved))
