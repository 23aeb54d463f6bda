"""Gauss-Seidel sweeps over a block schedule, and certified bounds on its cyclic blocks.

A lower bound rises from zero, and a guess a little above it is an upper bound once a pass does not
raise it (Hartmanns and Kaminski 2020). Where that takes long, policies are evaluated by Krylov
steps on passes (Howard 1960), for the problem in which every step costs a little more: its solution
is a bound by one application of the operator, and its policy attains a bound that the policy's
expected time proves. Each bound is rounded outwards.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core import struct
from jaxltl.core.models.protocols import Array
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


SLACK = 1e6  # smallest numbers that a guess is above nothing
_GUESS_SHARE = (
    0.9  # distance of the first guess of a bound from the other, as a share of the tolerance
)
_FINER = 0.25  # how much nearer values come before the next guess
_PATIENCE = 20  # passes, and a quarter of those before, until a guess is given up
_PASSES = 100  # until policy iteration is tried
_ROUNDS = 40  # of it
_HASTY = 15  # rounds continued by passes; then policy improvement alone, which must end
_SWEEPS = 12
_AIM = 0.1  # of the tolerance: how much of it the extra cost of the steps may take
_KEPT = 0.75  # of the extra cost: rows that gain less are kept, and the rest proves the bound


class Problem(NamedTuple):
    """The cyclic blocks of a system."""

    core: Blocks
    maximize: bool
    fixed: tuple[jax.Array, jax.Array]  # float[N] of all places: 0 and the value where it is known
    unit: float  # relative rounding error of a sum
    least: float  # loss of a sum to underflow
    tolerance: jax.Array  # width of the enclosure
    relative: bool  # whether the tolerance is a share of the value

    @property
    def span(self) -> slice:
        return slice(self.core.first, self.core.last)

    @property
    def keep(self) -> jax.Array:
        return self.fixed[0][self.span]

    @property
    def put(self) -> jax.Array:
        return self.fixed[1][self.span]

    @property
    def ceiling(self) -> float:
        """Upper bound of all values."""
        return jnp.inf if self.relative else 1.0

    @property
    def sign(self) -> float:
        return 1.0 if self.maximize else -1.0

    def sweep(self, x: jax.Array, factor: float, shift: float | jax.Array) -> jax.Array:
        rounding = (factor, shift)
        swept = sweep(self.core, x, maximize=self.maximize, fixed=self.fixed, rounding=rounding)
        return swept[0]

    def image(self, outer: jax.Array, x: jax.Array) -> jax.Array:
        """``c + P x`` of all rows, ``[C, A, B]``."""
        count, _, _, block = self.core.target.shape
        rows = images(self.core, outer.at[self.span].set(x))
        return rows * self.keep.reshape(count, 1, block) + self.put.reshape(count, 1, block)

    def best(self, image: jax.Array) -> tuple[jax.Array, jax.Array]:
        rank = jnp.argmax(self.sign * image, axis=1).astype(jnp.int32)
        return rank, _of(rank, image)

    def system(self, rank: jax.Array) -> Chosen:
        core = self.core
        count, _, _, block = core.target.shape
        target, weight = (
            jnp.take_along_axis(x, rank[:, None, None], 1)[:, 0] for x in (core.target, core.weight)
        )
        inside = (target >= core.first) & (target < core.last)
        return Chosen(
            jnp.where(inside, target - core.first, count * block),
            jnp.where(inside, weight, 0) * self.keep.reshape(count, 1, block),
            cyclic=True,
        )


class State(NamedTuple):
    """State of the iteration, with values of all places ``float[N + 3]``."""

    low: jax.Array
    high: jax.Array
    guessed: jax.Array
    proven: jax.Array
    threshold: jax.Array  # how little values move before a guess
    wide: jax.Array  # how far a guess is above
    since: jax.Array
    steps: jax.Array
    moved: jax.Array


def enclose_cycles(
    problem: Problem, low: jax.Array, high: jax.Array, max_steps: jax.Array | int
) -> State:
    """Encloses the values of the cyclic blocks."""
    none, zero = jnp.asarray(False), jnp.asarray(0, jnp.int32)
    tolerance = problem.tolerance
    state = State(
        low,
        high,
        none,
        none,
        tolerance,
        _GUESS_SHARE * tolerance,
        zero,
        zero,
        jnp.full((), jnp.inf, low.dtype),
    )

    def body(state: tuple[State, jax.Array]) -> tuple[State, jax.Array]:
        s, tried = state
        now = ~tried & (s.steps >= _PASSES)
        s = lax.cond(now, lambda s: _by_policies(problem, s, high), partial(_risen, problem), s)
        return s, tried | now

    def goes_on(state: tuple[State, jax.Array]) -> jax.Array:
        s = state[0]
        return ~s.proven & (s.steps < max_steps) & jnp.all(jnp.isfinite(s.low))

    state, _ = lax.while_loop(goes_on, body, (state, none))
    top = jnp.where(state.proven, state.high[problem.span], problem.ceiling)
    return state._replace(high=state.high.at[problem.span].set(top))


def _above(problem: Problem, low: jax.Array, high: jax.Array, wide: jax.Array) -> jax.Array:
    """Candidate upper bound a little above the lower one."""
    x = low[problem.span]
    if problem.relative:
        x = x * (1 + wide) + SLACK * problem.least
    else:
        x = jnp.minimum(x + wide, 1)
    return high.at[problem.span].set(x * problem.keep + problem.put)


def _risen(problem: Problem, s: State) -> State:
    """One sweep of the lower bound and of the candidate upper bound."""
    span, unit, least = problem.span, problem.unit, problem.least
    low = problem.sweep(s.low, 1 - unit, -least)
    high = lax.cond(s.guessed, lambda x: problem.sweep(x, 1 + unit, least), lambda x: x, s.high)
    new, old = low[span], s.low[span]
    change = jnp.abs(new - old)
    if problem.relative:
        change = change / jnp.maximum(new, SLACK * problem.least)
    moved = jnp.max(change)
    proven = s.guessed & jnp.all(high[span] <= s.high[span])
    crossed = jnp.any(high[span] < new) | jnp.all(high[span] >= s.high[span])
    failed = s.guessed & ~proven & (crossed | (s.since > _PATIENCE + s.steps // 4))
    threshold = jnp.where(failed, s.threshold * _FINER, s.threshold)
    wide = jnp.where(failed & (moved <= 4 * unit), 4 * s.wide, s.wide)
    guess = (~s.guessed | failed) & (moved <= jnp.maximum(threshold, 4 * unit))
    high = jnp.where(guess, _above(problem, low, high, wide), high)
    guessed = guess | (s.guessed & ~failed)
    since = jnp.where(guess, 0, s.since + 1)
    return State(low, high, guessed, proven, threshold, wide, since, s.steps + 1, moved)


# --- policy iteration ---------------------------------------------------------------------------


class _Policy(NamedTuple):
    value: jax.Array
    rank: jax.Array
    time: jax.Array
    extra: jax.Array
    done: jax.Array  # whether no row gains
    ended: jax.Array  # and the time of the policy is known
    rounds: jax.Array


def _of(rank: jax.Array, image: jax.Array) -> jax.Array:
    """The images of the chosen rows alone."""
    return jnp.take_along_axis(image, rank[:, None], 1).ravel()


def _by_policies(problem: Problem, state: State, high: jax.Array) -> State:
    """Bounds by policy iteration; the unchanged state if it fails."""
    core, x, sign = problem.core, state.low[problem.span], problem.sign
    # Values of earlier blocks lie between their bounds, so each side is proven with its own bound.
    middle = state.low.at[: core.first].set((state.low[: core.first] + high[: core.first]) / 2)

    def improve(p: _Policy) -> _Policy:
        timing = (p.rounds == 1) | p.done
        residual = _of(p.rank, problem.image(middle, p.value)) + sign * p.extra - p.value
        solution = problem.system(p.rank).solve(jnp.where(timing, 1, residual))
        time = jnp.where(timing, solution, p.time)
        value = jnp.where(timing, p.value, p.value + solution)
        extra = jnp.where(p.rounds == 1, _extra(problem, value, time), p.extra)
        now = problem.image(middle, value)
        rank, optimum = problem.best(now)
        own = _of(p.rank, now)
        better = (sign * (optimum - own) > _KEPT * extra).reshape(p.rank.shape) & ~timing
        exact = jnp.max(jnp.abs(own + sign * extra - value)) <= extra / 16
        done = p.done | ((p.rounds > 1) & ~jnp.any(better) & exact)
        hasty = jnp.any(better) & (p.rounds < _HASTY)
        ahead = partial(_swept, problem, middle, shift=extra * sign, rank=p.rank)
        rank = lax.cond(hasty, ahead, lambda _: jnp.where(better, rank, p.rank), value)
        return _Policy(value, rank, time, extra, done, p.done, p.rounds + 1)

    none = jnp.asarray(False)
    return _proven(
        problem,
        state,
        high,
        lax.while_loop(
            lambda p: ~p.ended & (p.rounds < _ROUNDS) & jnp.all(jnp.isfinite(p.value)),
            improve,
            _Policy(
                x,
                problem.best(problem.image(middle, x))[0],
                jnp.ones_like(x),
                jnp.zeros((), x.dtype),
                none,
                none,
                jnp.asarray(0, jnp.int32),
            ),
        ),
    )


def _proven(problem: Problem, state: State, high: jax.Array, p: _Policy) -> State:
    """Bounds certified by the last policy; the unchanged state if it proves none."""
    core, span, sign, time = problem.core, problem.span, problem.sign, p.time
    bound, attained = p.value, p.value - sign * 1.5 * p.extra * time
    outer_bound, outer_attained = (high, state.low) if sign > 0 else (state.low, high)
    beyond = sign * bound - sign * problem.best(problem.image(outer_bound, bound))[1]
    gain = sign * _of(p.rank, problem.image(outer_attained, attained)) - sign * attained
    # Known values, and places without a node, which have the value 0.
    fixed = (problem.keep == 0) | jnp.all(core.weight == 0, axis=(1, 2)).ravel()
    bound, attained = (jnp.where(fixed, problem.put, y) for y in (bound, attained))
    slack = problem.unit * jnp.abs(bound) * 2 + problem.least
    onward = time - problem.system(p.rank).image(jnp.concatenate([time, jnp.zeros(3, time.dtype)]))
    proven = jnp.all(fixed | ((beyond >= slack) & (gain >= slack) & (time >= 0) & (onward >= 0.5)))
    low, top = (attained, bound) if sign > 0 else (bound, attained)
    proven, low = proven & jnp.all(top >= 0), jnp.maximum(low, 0)
    width = problem.tolerance * top if problem.relative else problem.tolerance
    good = proven & jnp.all(top - low <= width)
    low_, top_ = state.low.at[span].set(low), high.at[span].set(top)
    return state._replace(
        low=jnp.where(good, low_, state.low),
        high=jnp.where(good, top_, state.high),
        proven=good,
        steps=state.steps + p.rounds + 1,
        moved=jnp.where(good, jnp.max(jnp.abs(beyond)), state.moved),
    )


def _swept(
    problem: Problem, outer: jax.Array, value: jax.Array, *, shift: jax.Array, rank: jax.Array
) -> jax.Array:
    """Greedy rows after some sweeps, which propagate improvements."""

    def again(_: int, carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        x, rank = sweep(
            problem.core,
            carry[0],
            maximize=problem.maximize,
            rounding=(1.0, shift),
            fixed=problem.fixed,
            choose=True,
        )
        assert rank is not None
        return x, rank

    start = outer.at[problem.span].set(value), rank
    result: jax.Array = lax.fori_loop(0, _SWEEPS, again, start)[1]
    return result


def _extra(problem: Problem, value: jax.Array, time: jax.Array) -> jax.Array:
    """Extra cost of a step: small relative to the tolerance, and more than rounding."""
    time = jnp.maximum(time, 1)
    share = 1 / jnp.max(time)
    if problem.relative:
        some = (value > SLACK * problem.least) & (problem.keep > 0)
        share = jnp.min(jnp.where(some, value / time, jnp.inf))
        share = jnp.where(jnp.isfinite(share), share, 1)
    largest = jnp.maximum(jnp.max(jnp.abs(value)), 1e-30)
    return jnp.maximum(_AIM * problem.tolerance * share, 32 * problem.unit * largest)
