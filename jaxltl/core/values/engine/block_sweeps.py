"""Gauss-Seidel sweeps over a block schedule, forwards and backwards."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxltl.core import struct
from jaxltl.core.models.protocols import Array
from jax import lax

from jaxltl.core.values.engine.linear import solve_linear


# The new values, and the ranks of the chosen rows.
Sweep = Callable[..., tuple[jax.Array, jax.Array | None]]


@struct.dataclass
class Blocks:
    """A segment of a :class:`~jaxltl.core.sparse.prepared.block_schedule.Schedule` with its weights."""

    target: Array  # ``int32[C, A, W, B]``, places
    source: Array  # ``int32[C, A, W, B]``, which numbers the weights are
    weight: Array  # ``float[C, A, W, B]``
    name: Array  # ``int32[C, A, B]``, of the rows
    first: int = struct.field(pytree_node=False)  # the place of the first node, static

    @property
    def size(self) -> int:
        """Number of places."""
        return int(self.target.shape[0] * self.target.shape[3])

    @property
    def last(self) -> int:
        return self.first + self.size


def _look(x: jax.Array, place: jax.Array) -> jax.Array:
    return x.at[place].get(mode="promise_in_bounds")


def _combined(target: jax.Array, weight: jax.Array, x: jax.Array) -> list[jax.Array]:
    """``sum_w weight * x`` of each row of a block: A arrays ``[B]``."""
    images = []
    for t, w in zip(target, weight, strict=True):
        terms = [w[k] * _look(x, t[k]) for k in range(t.shape[0])]
        images.append(sum(terms[1:], terms[0]))
    return images


def sweep(
    blocks: Blocks,
    x: jax.Array,
    *,
    maximize: bool,
    rounding: tuple[float, float | jax.Array] = (1.0, 0.0),
    fixed: tuple[jax.Array, jax.Array] | None = None,
    choose: bool = False,
) -> tuple[jax.Array, jax.Array | None]:
    """One pass: ``x = opt_a sum_w weight * x`` from the first block on, in place.

    Images are mapped by the factor and summand of `rounding`, and by those of each place, `fixed`.
    """
    factor, shift = rounding
    count, _, _, size = blocks.target.shape
    if not count:
        return x, jnp.zeros((0, size), jnp.int32) if choose else None
    better = jnp.greater if maximize else jnp.less

    def body(x: jax.Array, block: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array | None]:
        c, target, weight = block
        images = _combined(target, weight, x)
        best, rank = images[0], jnp.zeros(size, jnp.int32)
        for a, image in enumerate(images[1:], 1):
            wins = better(image, best)
            best, rank = jnp.where(wins, image, best), jnp.where(wins, a, rank)
        start = blocks.first + c * size
        if factor != 1.0:
            best = best * factor
        if isinstance(shift, jax.Array) or shift != 0.0:
            best = jnp.maximum(best + shift, 0)
        if fixed is not None:
            keep, put = (lax.dynamic_slice(x, (start,), (size,)) for x in fixed)
            best = best * keep + put
        return lax.dynamic_update_slice(x, best, (start,)), rank if choose else None

    numbers = jnp.arange(count, dtype=jnp.int32)
    return lax.scan(body, x, (numbers, blocks.target, blocks.weight))


def images(blocks: Blocks, x: jax.Array) -> jax.Array:
    """``sum_w weight * x`` of all rows at once, ``float[C, A, B]``."""
    return jnp.sum(blocks.weight * _look(x, blocks.target), axis=2)


def chosen_names(names: jax.Array, rank: jax.Array, rounds: int) -> jax.Array:
    """Names of the rows chosen by the nodes, ``int32[N]``."""
    name = jnp.take_along_axis(names, rank[:, None], 1).ravel()
    for _ in range(rounds):
        name = jnp.where(name < 0, _look(name, jnp.maximum(-1 - name, 0)), name)
    return name


def meets(
    segments: tuple[Blocks, ...], support: tuple[jax.Array, ...], x: jax.Array, cyclic: bool
) -> jax.Array:
    """Backward reachability over entries with positive weight."""

    def once(blocks: Blocks, has: jax.Array, x: jax.Array) -> jax.Array:
        count, _, _, size = blocks.target.shape

        def body(x: jax.Array, block: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array | None]:
            c, target, has = block
            start = blocks.first + c * size
            reached = lax.dynamic_slice(x, (start,), (size,))
            for k in range(target.shape[1]):
                reached = reached | (has[0, k] & _look(x, target[0, k]))
            return lax.dynamic_update_slice(x, reached, (start,)), None

        if not count:
            return x
        return lax.scan(body, x, (jnp.arange(count, dtype=jnp.int32), blocks.target, has))[0]

    x = once(segments[0], support[0], x)
    if cyclic:

        def again(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            x, _ = state
            new = once(segments[1], support[1], x)
            return new, jnp.any(new != x)

        x, _ = lax.while_loop(lambda s: s[1], again, (x, jnp.asarray(True)))
    return once(segments[2], support[2], x)


# --- the linear system of chosen rows -----------------------------------------------------------


@struct.dataclass
class Chosen:
    """The rows of a policy: ``x = sum_w weight * x[target]``."""

    target: jax.Array  # ``int32[C, W, B]`` of all blocks
    weight: jax.Array  # ``float[C, W, B]``
    cyclic: bool = struct.field(pytree_node=False)  # static

    def image(self, x: jax.Array) -> jax.Array:
        """``sum_w weight * x[target]``, ``float[N]`` from ``float[N + 3]``."""
        return jnp.sum(self.weight * x[self.target], axis=1).ravel()

    @property
    def _starts(self) -> jax.Array:
        count, _, size = self.target.shape
        return jnp.arange(count, dtype=jnp.int32) * size

    def _forward(self, x: jax.Array, b: jax.Array) -> jax.Array:
        """A pass of ``x = b + P x``; the constants are 0."""
        size = self.target.shape[2]

        def body(x: jax.Array, block: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array | None]:
            start, target, weight = block
            (image,) = _combined(target[None], weight[None], x)
            image = image + lax.dynamic_slice(b, (start,), (size,))
            return lax.dynamic_update_slice(x, image, (start,)), None

        full = jnp.concatenate([x, jnp.zeros(3, x.dtype)])
        full, _ = lax.scan(body, full, (self._starts, self.target, self.weight))
        return full[:-3]

    def _backward(self, x: jax.Array, b: jax.Array) -> jax.Array:
        """A pass of ``x = b + P' x`` from the last block on."""
        size = self.target.shape[2]
        onward = self.target < self._starts[:, None, None]
        ahead = jnp.where(onward, self.weight, 0)
        sums = jnp.concatenate([b, jnp.zeros(3, b.dtype)])
        if self.cyclic:
            inner = onward | (self.target >= b.size)
            flow = jnp.where(inner, 0, self.weight) * x.reshape(self.target.shape[0], 1, size)
            sums = sums.at[self.target].add(flow)

        def body(
            sums: jax.Array, block: tuple[jax.Array, ...]
        ) -> tuple[jax.Array, jax.Array | None]:
            start, target, weight = block
            mine = lax.dynamic_slice(sums, (start,), (size,))
            return sums.at[target].add(weight * mine, mode="promise_in_bounds"), None

        sums, _ = lax.scan(body, sums, (self._starts, self.target, ahead), reverse=True)
        return sums[:-3]

    def solve(self, b: jax.Array) -> jax.Array:
        """x with ``x - P x = b``; the constants are 0."""
        return self._solved(self._forward, b)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """x with ``x - P' x = b``."""
        return self._solved(self._backward, b)

    def _solved(
        self, one_pass: Callable[[jax.Array, jax.Array], jax.Array], b: jax.Array
    ) -> jax.Array:
        # A pass leaves a residual on cycles only, for the solver below.
        first = one_pass(jnp.zeros_like(b), b)
        if not self.cyclic:
            return first
        return solve_linear(lambda x: x - one_pass(x, jnp.zeros_like(b)), first)
