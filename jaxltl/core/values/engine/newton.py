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
    System,
    bicgstab,
    inverse,
    is_small,
    norm,
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


class _NewtonSearch(NamedTuple):
    """State of the search of a lane."""

    z: jax.Array  # the value to be judged next
    value: jax.Array  # the best so far, with its image and the weights of the derivative there
    image: jax.Array
    weight: jax.Array  # [A, N], or [R]
    error: jax.Array
    done: jax.Array
    newton: jax.Array  # whether z is a step of Newton's
    solved: jax.Array  # whether its linear system was solved
    plain: jax.Array  # sweeps to come before the next of Newton's
    pause: jax.Array
    num_steps: jax.Array


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
    zero = jnp.zeros_like(value)
    weight: Quantity = table.choices.broadcast(zero, backup.reward)
    over, none, no = table.choices, jnp.int32(0), jnp.bool_(False)
    start = _NewtonSearch(
        z=value,
        value=value,
        image=value,
        weight=over.packed(weight),
        error=jnp.full_like(zero[0], jnp.inf),
        done=no,
        newton=no,
        solved=no,
        plain=jnp.int32(first_sweeps),
        pause=none,
        num_steps=none,
    )
    # Side by side wins where a row of lanes fills a vector unit, which doubles do not.
    together = not method.newton and value.dtype.itemsize <= 4
    last, n = iterate(
        partial(_newton_step if method.newton else _sweep, method),
        lambda k, _: k.done,
        (table, start, (backup, jnp.asarray(max_steps, jnp.int32))),
        max_steps=max_steps,
        lanes="side by side" if together else "in turn",
    )
    return last.value, last.image, last.num_steps if method.newton else n, last.weight


_Parameters = tuple[Backup, jax.Array]


def _judged(
    method: Method, table: SweepOperator, k: _NewtonSearch, backup: Backup
) -> tuple[jax.Array, Quantity, jax.Array, jax.Array]:
    """The image of z, the weights of its derivative, and the judgement."""
    values = action_values(table.choices, backup, table.expectation(k.z))
    image, weight = method.combine(table.choices, values, backup.extra)
    return image, weight, *method.judge(k.z, image, backup.extra)


def _sweep(
    method: Method, table: SweepOperator, k: _NewtonSearch, parameters: _Parameters
) -> _NewtonSearch:
    image, _, done, error = _judged(method, table, k, parameters[0])
    z = k.z + (1 - parameters[0].damping) * (image - k.z)
    return k._replace(z=z, value=k.z, image=image, error=error, done=done)


def _newton_step(
    method: Method, table: SweepOperator, k: _NewtonSearch, parameters: _Parameters
) -> _NewtonSearch:
    """Judges z, and makes a step of Newton's method or a sweep."""
    (backup, limit), over = parameters, table.choices
    image, weight, done, error = _judged(method, table, k, backup)
    accepted = ~k.newton | (error <= k.error / 2)  # false for NaN
    if method.monotone:
        accepted |= k.solved & jnp.isfinite(error)
    value, image, weight, error = jax.tree.map(
        partial(jnp.where, accepted),
        (k.z, image, over.packed(weight), error),
        (k.value, k.image, k.weight, k.error),
    )
    change, num_steps = image - value, k.num_steps + 1
    pause = jnp.where(accepted, jnp.where(k.newton, 0, k.pause), 2 * k.pause + 4)
    plain = jnp.where(accepted, jnp.maximum(k.plain - 1, 0), pause)
    done = (done & accepted) | (num_steps >= limit)
    products = jnp.minimum(_INNER, limit - num_steps - 1)  # one more step judges the result
    sweeps = (plain > 0) | done | (products < 2)

    def swept() -> tuple[jax.Array, jax.Array, jax.Array]:
        return (1 - backup.damping) * change, jnp.bool_(False), num_steps

    def solved() -> tuple[jax.Array, jax.Array, jax.Array]:
        system = System(table, over.unpacked(weight), backup.scale)
        target = _EXACT * norm(change)
        inner, n = bicgstab(system.matvec, change, tolerance=target, max_steps=products)
        x, enough = inner.x, inner.size <= target
        if method.monotone and is_small(table, change.size):
            x = lax.cond(enough, lambda: x, lambda: inverse(system.matrix()) @ change)
            enough = jnp.bool_(True)
        return x, enough, num_steps + n

    step, enough, num_steps = lax.cond(sweeps, swept, solved)
    return _NewtonSearch(
        z=value + step,
        value=value,
        image=image,
        weight=weight,
        error=error,
        done=done,
        newton=~sweeps,
        solved=enough,
        plain=plain,
        pause=pause,
        num_steps=num_steps,
    )


def action_values(over: Layout, backup: Backup, ahead: Quantity) -> Quantity:
    """Action values ``g + c x``, with x the expected next value of each choice."""
    return jax.tree.map(
        lambda g, c, x: g + c * x, backup.reward, over.broadcast(backup.scale, ahead), ahead
    )
