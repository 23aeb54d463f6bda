"""Prepared solves: one graph, many probabilities and rewards, in ``jit``, ``vmap``, ``grad``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeAlias

import chex
import jax
import jax.numpy as jnp
from numpy.typing import ArrayLike
from jax import lax

from jaxltl.core.graphs.end_components import recurrent
from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.models.ops.underflow import is_subnormal
from jaxltl.core.models.protocols import PyTree
from jaxltl.core.types import Solution, require_shape, row_tolerance, status_code
from jaxltl.core.values.prepared.block_iteration import (
    Blocks,
    Chosen,
    Sweep,
    chosen_names,
    meets,
    sweep,
)
from jaxltl.core.values.engine.host_solution import default_tolerance
from jaxltl.core.values.engine.implicit_diff import LinearSystem, attach_derivative, implicit
from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import RowSystem, row_system
from jaxltl.core.values.engine.validated import validated
from jaxltl.core.values.prepared.block_iteration import SLACK, Problem, State, enclose_cycles
from jaxltl.core.values.prepared.preparation import Prepared, prepare
from jaxltl.core.values.prepared.prepared_interval import (
    PreparedInterval,
    require_prepared_reward,
    solve_prepared_interval,
)

__all__ = ["Prepared", "evaluate_prepared", "is_direct", "prepare", "solve_prepared"]

_Maybe: TypeAlias = jax.Array | None
ELIMINATED = 256  # nodes up to which cycles are solved by elimination


@validated()
def solve_prepared(
    prepared: Prepared | PreparedInterval,
    *,
    probability: chex.Array | None = None,
    lower: chex.Array | None = None,
    upper: chex.Array | None = None,
    reward: chex.Array | None = None,
    policy: chex.Array | None = None,
    tolerance: chex.Array | float | None = None,
    max_steps: chex.Array | int | None = None,
) -> Solution:
    """Solves a prepared question, with other probabilities, intervals or rewards.

    An acyclic system is solved by one pass, with an a priori rounding bound; a cyclic one by
    :mod:`jaxltl.core.values.prepared.block_iteration`.

    Args:
      prepared: the question.
      probability: ``float[T]``, of the same transitions, all positive; rows sum to one.
      lower, upper: ``float[T]``, of a prepared IntervalMDP in place of probabilities.
      reward: ``float[R]``, finite, at least 0, and 0 where it was; for a minimum also positive where
        it was. Only if a reward was prepared.
      policy: actions ``int32[S]`` or weights of rows ``float[R]``, if it was prepared for policies; a chain
        needs none.
      tolerance: width of the enclosure, for rewards relative to the value; default 1e-6 in double
        precision, 1e-3 in single.
      max_steps: maximal number of passes; default 100,000.

    Returns:
      :class:`Solution`; `value` ``float[S]``, exact where the graph decides, `policy` ``int32[S]``,
      actions that attain the bound on the safe side, or the given policy. The status is ``INVALID``
      for invalid numbers and ``NONFINITE`` for NaN or infinite ones. Differentiable, forward and
      reverse, in the probabilities, the rewards and the weights of a policy, along distributions;
      of an optimum with its policy held fixed.

    Raises:
      ValueError: a wrong shape, or a policy that does not match the preparation.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> prepared = prepare(coin, [False, True, False])
      >>> solve = jax.jit(lambda p: solve_prepared(prepared, probability=p))
      >>> found = solve(jnp.array([0.25, 0.75, 1, 1]))
      >>> round(found.value[0].item(), 3), found.status.item()
      (0.25, 0)
    """
    max_steps = 100_000 if max_steps is None else max_steps
    if isinstance(prepared, PreparedInterval):
        if probability is not None or policy is not None:
            raise ValueError("a question about intervals takes lower and upper ends and a reward.")
        return solve_prepared_interval(
            prepared,
            lower=lower,
            upper=upper,
            reward=reward,
            tolerance=tolerance,
            max_steps=max_steps,
        )
    if lower is not None or upper is not None:
        raise ValueError("lower and upper are for a prepared IntervalMDP; give probability.")
    probability, reward = _checked_shapes(prepared, probability, reward)
    policy = None if policy is None else jnp.asarray(policy)
    chain = prepared.num_rows == prepared.num_states
    if prepared.objective == "policy":
        if policy is None and not chain:
            raise ValueError("the question was prepared for policies: give one.")
        if policy is not None:
            shape = prepared.place if is_deterministic(policy) else prepared.row_state
            require_shape("policy", policy, shape.shape)
    elif policy is not None:
        raise ValueError(
            f"a policy is given, but the question is the optimum: prepare it with "
            f'objective="policy", not {prepared.objective!r}.'
        )
    if tolerance is None:
        tolerance = default_tolerance(prepared.probability)
    return _solve(prepared, probability, reward, policy, tolerance, max_steps)


def _checked_shapes(
    prepared: Prepared, probability: ArrayLike | None, reward: ArrayLike | None
) -> tuple[jax.Array | None, jax.Array | None]:
    """Given probabilities and rewards, with checked shapes."""
    p, r = (None if x is None else jnp.asarray(x) for x in (probability, reward))
    if p is not None:
        require_shape("probability", p, prepared.probability.shape)
    require_prepared_reward(prepared.reward, r)
    return p, r


@jit()
def _solve(
    prepared: Prepared,
    probability: _Maybe,
    reward: _Maybe,
    policy: _Maybe,
    tolerance: jax.Array | float,
    max_steps: jax.Array | int,
) -> Solution:
    tolerance = jnp.asarray(tolerance, prepared.probability.dtype)
    finite, valid = _checked_numbers(prepared, probability, reward)
    weights = _policy_rows(prepared, policy) if prepared.objective == "policy" else None
    decided = None if weights is None else _decided(prepared, reward, weights)
    if weights is not None:
        finite, valid = finite & weights.finite, valid & weights.valid
    prepared = _filled(prepared, probability, reward, None if weights is None else weights.weight)
    enclosure = _enclosed(prepared, decided, tolerance, max_steps)
    value = _attached(prepared, enclosure, decided)
    solution = _answer(
        prepared, enclosure._replace(value=value), decided, tolerance, (finite, valid)
    )
    return solution if weights is None else replace(solution, policy=weights.policy)


class _PolicyRows(NamedTuple):
    """A policy with the normalised weights of its rows."""

    policy: jax.Array
    weight: jax.Array
    used: jax.Array
    finite: jax.Array
    valid: jax.Array


def _policy_rows(prepared: Prepared, policy: _Maybe) -> _PolicyRows:
    """The policy; by default the only one of a chain."""
    dtype, state = prepared.probability.dtype, prepared.row_state
    policy = jnp.ones(prepared.num_rows, dtype) if policy is None else policy
    weight = policy
    if is_deterministic(policy):
        weight = policy[state] == prepared.action
    weight = weight.astype(dtype)
    total = jax.ops.segment_sum(weight, state, prepared.num_states, indices_are_sorted=True)
    valid = jnp.all(jnp.abs(total - 1) <= row_tolerance(dtype)) & jnp.all(weight >= 0)
    valid &= ~jnp.any(is_subnormal(weight))
    share = weight / jnp.where(total > 0, total, 1)[state]
    return _PolicyRows(policy, share, weight > 0, jnp.all(jnp.isfinite(weight)), valid)


def _checked_numbers(
    prepared: Prepared, probability: _Maybe, reward: _Maybe
) -> tuple[jax.Array, jax.Array]:
    """Tests that numbers are finite, and that they are valid."""
    finite, valid = jnp.asarray(True), jnp.asarray(True)
    if probability is not None:
        probability = lax.stop_gradient(probability).astype(prepared.probability.dtype)
        total = jax.ops.segment_sum(
            probability, prepared.entry_row, prepared.num_rows, indices_are_sorted=True
        )
        finite &= jnp.all(jnp.isfinite(total))
        slack = row_tolerance(probability.dtype)
        valid &= jnp.all(probability > 0) & jnp.all(jnp.abs(total - 1) <= slack)
    if reward is not None and prepared.reward is not None:
        finite &= jnp.all(jnp.isfinite(reward))
        before = prepared.reward > 0
        valid &= jnp.all(reward >= 0) & jnp.all(before | (reward == 0))
        if prepared.objective == "min":
            valid &= jnp.all((reward > 0) == before)
    return finite, valid


def _filled(
    prepared: Prepared, probability: _Maybe, reward: _Maybe, scale: _Maybe = None
) -> Prepared:
    """The prepared question with weights in its blocks; rows are scaled by those of a policy."""
    dtype = prepared.probability.dtype
    p = jnp.asarray(prepared.probability if probability is None else probability, dtype)
    r = prepared.reward if reward is None else jnp.asarray(reward, dtype)
    r = jnp.zeros(prepared.num_rows, dtype) if r is None else r
    if scale is not None:
        p, r = p * scale[prepared.entry_row], r * scale
    if prepared.loops is not None:
        entry, group, row, row_group = prepared.loops
        total = jax.ops.segment_sum(p[entry], group, prepared.groups, indices_are_sorted=True)
        inverse = jnp.where(total > 0, 1 / jnp.where(total > 0, total, 1), 0)
        ones = jnp.ones(prepared.num_rows, dtype)
        scale = ones.at[row].set(inverse[row_group], unique_indices=True)
        p, r = p * scale[prepared.entry_row], r * scale
    vector = jnp.concatenate([p, r, jnp.asarray([1, 0], dtype)])
    one, two, three = (
        replace(x, weight=vector.at[x.source].get(mode="promise_in_bounds"))
        for x in prepared.segments
    )
    return replace(prepared, segments=(one, two, three))


class _Decided(NamedTuple):
    """Qualitative values of a policy, ``bool[N + 3]`` each."""

    keep: jax.Array
    put: jax.Array
    infinite: jax.Array
    states: jax.Array  # places of states; others are parts of rows
    reached: jax.Array  # places from which the target, or what ends the reward, may be reached


def _decided(prepared: Prepared, reward: _Maybe, weights: _PolicyRows) -> _Decided:
    """Places where the value of a policy is 0, 1 or infinite."""
    size = prepared.size
    earned = prepared.reward if reward is None else reward
    paid = jnp.zeros(prepared.num_rows, bool) if earned is None else weights.used & (earned > 0)
    used = jnp.concatenate([weights.used[prepared.entry_row], paid, jnp.asarray([True, False])])
    support = tuple(used[x.source] for x in prepared.segments)
    goal = size if prepared.question == "probability" else size + 1
    seed = jnp.zeros(size + 3, bool).at[goal].set(True)
    reached = meets(prepared.segments, support, seed, prepared.cyclic)
    # States that never get there; other places are parts of rows, of which none may be taken.
    states = jnp.zeros(size + 3, bool).at[prepared.place].set(True)
    never = states & ~reached
    never = never.at[size:].set(jnp.asarray([False, False, True]))
    lost = meets(prepared.segments, support, never, prepared.cyclic)
    none = jnp.zeros(size + 3, bool)
    if prepared.question == "probability":
        keep, put = ~states | (reached & lost), states & reached & ~lost
        return _Decided(keep, put, none, states, reached)
    paying = jnp.zeros(size + 3, bool).at[size].set(True)
    earns = meets(prepared.segments, support, paying, prepared.cyclic)
    return _Decided(~lost & earns, none, lost, states, reached)


class _Transient(NamedTuple):
    """The linear system of a policy's rows in the transient places."""

    rows: Chosen
    keep: jax.Array  # ``bool[N]``

    def image(self, weight: jax.Array, x: jax.Array) -> jax.Array:
        """The rows with other weights ``float[C, W, B]``, 0 in the other places."""
        one = jnp.asarray([1, 0, 0], x.dtype)
        image = replace(self.rows, weight=weight).image(jnp.concatenate([x, one]))
        return jnp.where(self.keep, image, 0)

    def solve(self, b: jax.Array) -> jax.Array:
        """The solution of the system."""
        return self._kept.solve(b)

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        """The solution of the transposed system."""
        return self._kept.transpose_solve(b)

    @property
    def _kept(self) -> Chosen:
        count, _, block = self.rows.target.shape
        keep = self.keep.reshape(count, 1, block)
        return replace(self.rows, weight=jnp.where(keep, self.rows.weight, 0))


def _transient(known: tuple[Chosen, _Decided], _: jax.Array, *, relative: bool) -> _Transient:
    """The system of all places whose value changes continuously, also of decided ones."""
    rows, decided = known
    count, width, block = rows.target.shape
    size = count * block
    if relative:  # where rewards are finite, the target is reached almost surely
        return _Transient(rows, ~decided.infinite[:size])
    # The last three places are constants, which lead nowhere.
    target, used = (
        jnp.pad(jnp.moveaxis(x, 1, 2).reshape(size, width), ((0, 3), (0, 0)))
        for x in (rows.target, rows.weight > 0)
    )

    def taken(carry: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        # Parts of rows that are not taken lead nowhere, and so nothing leads to them.
        live, _ = carry
        new = live | jnp.any(used & live[target], axis=1)
        return new, jnp.any(new != live)

    start = decided.states.at[size:].set(True), jnp.bool_(True)
    used &= lax.while_loop(lambda c: c[1], taken, start)[0][target]

    def least(number: jax.Array) -> jax.Array:
        return jnp.min(jnp.where(used, number[target], size + 3), axis=1)

    def entered(region: jax.Array) -> jax.Array:
        sent = used & region[:, None]
        return jnp.zeros(size + 3, bool).at[target].max(sent)

    closed = recurrent(~decided.reached, least, entered)
    return _Transient(rows, (~decided.states | ~closed)[:size])


class _Enclosed(NamedTuple):
    """Enclosed values of the places, ``float[N]``."""

    value: jax.Array
    lower: jax.Array
    upper: jax.Array
    rank: jax.Array | None
    residual: jax.Array
    steps: jax.Array
    proven: jax.Array


def _rounding(prepared: Prepared) -> tuple[float, float]:
    """Relative rounding error of a sum, and its loss to underflow."""
    info = jnp.finfo(prepared.probability.dtype)
    return prepared.terms * float(info.eps), 4 * prepared.terms * float(info.tiny)


def _enclosed(
    prepared: Prepared, decided: _Decided | None, tolerance: jax.Array, max_steps: jax.Array | int
) -> _Enclosed:
    prepared = lax.stop_gradient(prepared)
    dtype, size = prepared.probability.dtype, prepared.size
    unit, least = _rounding(prepared)
    fixed = jnp.ones(size, dtype), jnp.zeros(size, dtype)
    if decided is not None:
        fixed = decided.keep[:size].astype(dtype), decided.put[:size].astype(dtype)
    start = jnp.zeros(size + 3, dtype).at[size].set(1)
    if prepared.cyclic:
        return _enclosed_cycles(prepared, fixed, start, tolerance, max_steps)
    maximize, choose = prepared.objective != "min", decided is None
    x, rank = sweep(prepared.segments[0], start, maximize=maximize, fixed=fixed, choose=choose)
    x = x[:size]
    share = 1.3 * prepared.levels * unit
    known = share <= 0.1
    lower = jnp.maximum(x * (1 - share) - prepared.levels * least, 0) if known else x * 0
    upper = x * (1 + share) + prepared.levels * least if known else x * 0 + jnp.inf
    zero = jnp.zeros((), dtype)
    return _Enclosed(x, lower, upper, rank, zero, jnp.asarray(1, jnp.int32), jnp.asarray(known))


def _enclosed_cycles(
    prepared: Prepared,
    fixed: tuple[jax.Array, jax.Array],
    start: jax.Array,
    tolerance: jax.Array,
    max_steps: jax.Array | int,
) -> _Enclosed:
    """Bounds from both sides where the system has cycles."""
    unit, least = _rounding(prepared)
    before, core, after = prepared.segments
    maximize, size = prepared.objective != "min", prepared.size
    one_sweep: Sweep = partial(sweep, maximize=maximize, fixed=fixed)
    down, up = (partial(one_sweep, rounding=x) for x in ((1 - unit, -least), (1 + unit, least)))

    def enclosed(core: Blocks, fixed: tuple[jax.Array, jax.Array], *numbers: jax.Array) -> State:
        tolerance, low, high, limit = numbers
        relative = prepared.question == "reward"
        problem = Problem(core, maximize, fixed, unit, least, tolerance, relative)
        return enclose_cycles(problem, low, high, limit)

    # How much work it is depends on the lane.
    s = sequential_vmap(
        enclosed,
        core,
        fixed,
        tolerance,
        down(before, start)[0],
        up(before, start)[0],
        jnp.asarray(max_steps, jnp.int32),
    )
    low, high = down(after, s.low)[0], up(after, s.high)[0]
    rank = None
    if prepared.objective != "policy":
        # Greedy in a bound that a pass does not worsen: its policy attains it.
        safe = low if maximize else jnp.where(s.proven, high, low)
        parts: list[PyTree] = []
        for part in prepared.segments:
            safe, ranks = one_sweep(part, safe, choose=True)
            parts.append(ranks)
        rank = jnp.concatenate(parts)
    low, high = low[:size], high[:size]
    middle = jnp.where(s.proven, low + (high - low) / 2, low)
    return _Enclosed(middle, low, high, rank, s.moved, s.steps, s.proven)


def _attached(
    prepared: Prepared, enclosure: _Enclosed | None, decided: _Decided | None = None
) -> jax.Array:
    """Values of the places with implicit derivatives; of a chain also their approximation."""
    size, dtype = prepared.size, prepared.probability.dtype
    if not size:
        return jnp.zeros(0, dtype)
    system = _chosen_rows(prepared, None if enclosure is None else enclosure.rank)
    if decided is not None and enclosure is not None:
        known, value = lax.stop_gradient((system, decided)), lax.stop_gradient(enclosure.value)
        run = partial(_transient, relative=prepared.question == "reward")
        return attach_derivative(_policy_image, system.weight, value, known, run)
    one = jnp.asarray([1, 0, 0], dtype)

    def operator(x: jax.Array) -> jax.Array:
        return system.image(jnp.concatenate([x, one]))

    fixed: LinearSystem = lax.stop_gradient(system)
    if enclosure is None and prepared.cyclic and is_direct(prepared):
        fixed = _Eliminated.of(lax.stop_gradient(system), prepared.nodes)
    if enclosure is None:
        value = fixed.solve(lax.stop_gradient(operator(jnp.zeros(size, dtype))))
    else:
        value = enclosure.value
    return implicit(operator, value, fixed)


def _policy_image(weight: jax.Array, x: jax.Array, system: _Transient) -> jax.Array:
    return system.image(weight, x)


def _chosen_rows(prepared: Prepared, rank: jax.Array | None) -> Chosen:
    """The linear system of the rows with given ranks; by default the first ones."""
    target = jnp.concatenate([x.target for x in prepared.segments])
    weight = jnp.concatenate([x.weight for x in prepared.segments])
    if rank is None:
        return Chosen(target[:, 0], weight[:, 0], prepared.cyclic)
    target, weight = (
        jnp.take_along_axis(x, rank[:, None, None], 1)[:, 0] for x in (target, weight)
    )
    return Chosen(target, weight, prepared.cyclic)


def _answer(
    prepared: Prepared,
    enclosure: _Enclosed,
    decided: _Decided | None,
    tolerance: jax.Array,
    checks: tuple[jax.Array, jax.Array],
) -> Solution:
    """The solution; checked at the nodes, which may be far fewer than the states."""
    finite, valid = checks
    dtype, size, value = prepared.probability.dtype, prepared.size, enclosure.value
    relative = prepared.question == "reward"
    highest = jnp.inf if relative else 1.0
    value = value + lax.stop_gradient(jnp.clip(value, 0, highest) - value)
    lower, upper = enclosure.lower, jnp.minimum(enclosure.upper, highest)
    if decided is not None:
        keep, put, infinite = (x[:size] for x in decided[:3])
        known = jnp.where(infinite, jnp.inf, put.astype(dtype))
        lower, upper = (jnp.where(keep, x, known) for x in (lower, upper))
        change = value - lax.stop_gradient(value)  # 0, with the derivative of the value
        value = jnp.where(keep, value, jnp.where(infinite, known, known + change))
    width = jnp.where(lower == upper, 0, upper - jnp.where(jnp.isfinite(lower), lower, 0))
    scale = jnp.where(jnp.isfinite(upper), upper, 1) if relative else 1
    floor = 1e3 * SLACK * _rounding(prepared)[1]  # what rewards of zero are known to
    narrow = jnp.all((width <= tolerance * scale + floor) & (lower <= upper))
    finite &= jnp.all(~jnp.isnan(lax.stop_gradient(value)))
    status = status_code(enclosure.proven & narrow, finite, enclosure.proven, valid=valid | ~finite)
    good = valid & finite

    def everywhere(x: jax.Array, bad: float) -> jax.Array:
        return jnp.where(good, _at_states(prepared, x), jnp.asarray(bad, dtype))

    return Solution(
        value=everywhere(value, jnp.nan),
        lower=everywhere(lower, -jnp.inf),
        upper=everywhere(upper, jnp.inf),
        policy=_policy(prepared, enclosure),
        residual=jnp.where(good, enclosure.residual, jnp.nan),
        num_steps=enclosure.steps,
        status=status,
    )


def _at_states(prepared: Prepared, x: jax.Array) -> jax.Array:
    """A quantity of the places, at the states."""
    ends = jnp.asarray([0, 0, jnp.inf] if prepared.question == "reward" else [1, 0, 0], x.dtype)
    return jnp.concatenate([x, ends]).at[prepared.place].get(mode="promise_in_bounds")


def _policy(prepared: Prepared, enclosure: _Enclosed) -> jax.Array:
    """An optimal policy, ``int32[S]``."""
    names = jnp.concatenate([x.name for x in prepared.segments])
    if enclosure.rank is None or not names.shape[0]:
        return prepared.action[prepared.row]
    chosen = chosen_names(names, enclosure.rank, prepared.choices)
    own = prepared.own
    rows = jnp.where(own >= 0, chosen[jnp.maximum(own, 0)], prepared.row)
    if prepared.cycles is not None:
        rows = _towards_exits(prepared, prepared.cycles, rows)
    return prepared.action[rows]


def _towards_exits(prepared: Prepared, cycles: tuple[jax.Array, ...], rows: jax.Array) -> jax.Array:
    """The policy completed inside end components by rows towards the exit."""
    state, inside, owner, entry_row, successor = cycles
    picked = rows[state]
    there = prepared.row_state[picked] == state
    count, many = state.shape[0], inside.shape[0]
    last = jnp.iinfo(jnp.int32).max

    def further(carry: PyTree) -> PyTree:
        there, row, _ = carry
        leads = (
            jax.ops.segment_max(
                there[successor].astype(jnp.int32), entry_row, many, indices_are_sorted=True
            )
            > 0
        )
        first = jax.ops.segment_min(
            jnp.where(leads, inside, last), owner, count, indices_are_sorted=True
        )
        new = ~there & (first < last)
        return there | new, jnp.where(new, first, row), jnp.any(new)

    _, picked, _ = lax.while_loop(lambda c: c[2], further, (there, picked, jnp.asarray(True)))
    return rows.at[state].set(picked, unique_indices=True)


def is_direct(prepared: Prepared) -> bool:
    """True if the work of :func:`evaluate_prepared` is independent of the numbers."""
    return not prepared.cyclic or prepared.nodes.shape[0] <= ELIMINATED


def evaluate_prepared(
    prepared: Prepared, *, probability: chex.Array | None = None, reward: chex.Array | None = None
) -> tuple[jax.Array, jax.Array]:
    """Uncertified values of a prepared Markov chain: one linear system ``x = r + P x``."""
    if prepared.num_rows != prepared.num_states or prepared.objective == "policy":
        raise ValueError(
            "evaluate_prepared takes Markov chains, not prepared for policies: use solve_prepared."
        )
    return _evaluate(prepared, *_checked_shapes(prepared, probability, reward))


@jit()
def _evaluate(
    prepared: Prepared, probability: _Maybe, reward: _Maybe
) -> tuple[jax.Array, jax.Array]:
    finite, valid = _checked_numbers(prepared, probability, reward)
    value = _attached(_filled(prepared, probability, reward), None)
    finite &= jnp.all(jnp.isfinite(lax.stop_gradient(value)))
    status = status_code(True, finite, certified=False, valid=valid | ~finite)
    return _at_states(prepared, value), status


class _Eliminated(NamedTuple):
    """A system with a dense inverse on its nodes; other places keep their values."""

    rows: RowSystem
    nodes: jax.Array

    @staticmethod
    def of(system: Chosen, nodes: jax.Array) -> _Eliminated:
        count, _, block = system.target.shape
        size, number = count * block, jnp.arange(nodes.shape[0], dtype=jnp.int32)
        place = jnp.full(size + 3, nodes.shape[0], jnp.int32).at[nodes].set(number)
        target, weight = (
            jnp.moveaxis(x, 1, 2).reshape(size, -1)[nodes] for x in (system.target, system.weight)
        )
        return _Eliminated(row_system(place[target], weight), nodes)

    def solve(self, b: jax.Array) -> jax.Array:
        return b.at[self.nodes].set(self.rows.solve(b[self.nodes]))

    def transpose_solve(self, b: jax.Array) -> jax.Array:
        return b.at[self.nodes].set(self.rows.transpose_solve(b[self.nodes]))
