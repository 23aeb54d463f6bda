"""Prepared solves: one graph, many probabilities and rewards, in ``jit``, ``vmap``, ``grad``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import lax

from jaxltl.core.values.engine.validated import validated
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.mesh.sharded import refuse_sharded
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.models.ops.underflow import is_subnormal
from jaxltl.core.models.sparse import Rewards, choice_reward, refuse_underflow
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.prepared.reachability_plan import Plan, plan_optimum, plan_policy
from jaxltl.core.sparse.solvers.reachability import reduce_reachability, reduce_total_reward
from jaxltl.core.types import Solution, require_shape, row_tolerance, status_code
from jaxltl.core.values import facts
from jaxltl.core.values.engine.block_sweeps import Blocks, Chosen, chosen_names, meets, sweep
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import in_turn
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.values.interval.robust import refuse_nature
from jaxltl.core.values.prepared.prepared_interval import (
    PreparedInterval,
    prepare_interval,
    solve_prepared_interval,
)
from jaxltl.core.values.prepared.interval_iteration import SLACK, Problem, enclose_cycles


@brief(facts=facts.prepared)
@struct.dataclass
class Prepared:
    """A question about a model after preprocessing, for solves with other numbers.

    Made by :func:`prepare`, read by :func:`solve_prepared`. Give it to a compiled function as an
    argument: what a function closes over becomes part of the program.

    Attributes:
      segments: the blocks.
      place: ``int32[S]``, where a state's value is.
      nodes: ``int32[M]``, the places with rows; others fill blocks.
      own: ``int32[S]``, the place whose row a state takes, or -1.
      row: ``int32[S]``, the row that it takes else.
      entry_row: ``int32[T]``, the row of each transition.
      row_state: ``int32[R]``, the state of each row.
      probability, reward: ``float[T]`` and ``float[R]``, as they were.
      loops: rows that lead to where they are: entries, groups, rows, groups of these; or None.
      cycles: end components that are one node, or None.
      question: ``"probability"`` or ``"reward"``, static.
      objective: ``"max"``, ``"min"`` or ``"policy"``, static.
      cyclic: whether some nodes are on cycles, static.
      levels, choices, terms, groups: see the plan, static.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> prepared = prepare(coin, [False, True, False])
      >>> prepared.question, prepared.objective, prepared.num_states, prepared.num_rows
      ('probability', 'max', 3, 3)
    """

    segments: tuple[Blocks, Blocks, Blocks]
    place: Any
    nodes: Any
    own: Any
    row: Any
    entry_row: Any
    row_state: Any
    probability: Any
    reward: Any
    loops: Any
    cycles: Any
    question: str = struct.field(pytree_node=False)
    objective: str = struct.field(pytree_node=False)
    cyclic: bool = struct.field(pytree_node=False)
    levels: int = struct.field(pytree_node=False)
    choices: int = struct.field(pytree_node=False)
    terms: int = struct.field(pytree_node=False)
    groups: int = struct.field(pytree_node=False)

    @property
    def num_states(self) -> int:
        """S, of the model."""
        return self.place.shape[-1]

    @property
    def num_rows(self) -> int:
        """R, of the model."""
        return self.row_state.shape[-1]

    @property
    def size(self) -> int:
        """Number N of places."""
        return self.segments[2].last


def prepare(
    model: Any,
    target: chex.Array,
    *,
    stay: chex.Array | None = None,
    reward: str | Rewards | chex.Array | None = None,
    policy: chex.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
) -> Prepared | PreparedInterval:
    """Prepares a question about a model for solves with other numbers inside ``jit``.

    What the graph decides is decided here: chains of single successors, states worth nothing, one
    or infinity, and end components are gone from what is solved. What is left stands in blocks of
    equal shape, later states first, so that one pass solves what has no cycles.

    Args:
      model: a concrete SparseMDP, or what :func:`~jaxltl.core.models.construct.convert.to_sparse` takes.
      target: ``bool[S]``.
      stay: ``bool[S]``, the states that may be passed before; default all. Not with a reward.
      reward: asks for the expected total reward until the target and not for the probability of
        reaching it; as of :func:`~jaxltl.core.models.sparse.choice_reward`, finite and at least 0.
      policy: of an IntervalMDP, rows ``int32[S]`` to be evaluated; default: optimise.
      objective: ``"max"``, ``"min"``, or ``"policy"`` for values of policies that are given later.
      nature: of an IntervalMDP, ``"adversarial"`` (default) or ``"cooperative"``, see
        :func:`~jaxltl.core.values.prepared.prepared_interval.prepare_interval`.

    Returns:
      A pytree of arrays. Which transitions are possible and which rewards are zero is settled.

    Raises:
      ValueError: a shape or the objective is wrong, a reward is negative or not finite, there is
        `stay` with a reward, or something is traced.

    Not differentiable: it reads the graph, on the host; :func:`solve_prepared` has the derivatives.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> prepared = prepare(coin, [False, True, False])
      >>> solve = jax.jit(lambda p: solve_prepared(prepared, probability=p).value[0])
      >>> round(solve(jnp.array([0.25, 0.75, 1, 1])).item(), 3)
      0.25
    """
    if isinstance(model, IntervalMDP):
        return prepare_interval(
            model,
            target,
            stay=stay,
            reward=reward,
            policy=policy,
            objective=objective,
            nature=nature,
        )
    refuse_nature(nature)
    if policy is not None:
        raise ValueError(
            'policy is for models with intervals; prepare with objective="policy" and give the '
            "policy to solve_prepared."
        )
    if objective not in ("max", "min", "policy"):
        raise ValueError(f'objective={objective!r}; it must be "max", "min" or "policy".')
    refuse_sharded(model)
    if is_traced((model, target, stay, reward)):
        raise ValueError(
            "prepare reads its model, so it works on concrete arrays only; call it "
            "before jit, and solve_prepared inside."
        )
    if stay is not None and reward is not None:
        raise ValueError("expected rewards are until the target alone: leave stay out.")
    sparse = to_sparse(model)
    host = sparse.host
    target = np.asarray(target, bool).ravel()
    require_shape("target", target, (host.num_states,))
    if stay is not None:
        stay = np.asarray(stay, bool).ravel()
        require_shape("stay", stay, (host.num_states,))
    cost = None if reward is None else choice_reward(sparse, reward)
    if cost is not None and not (np.isfinite(cost) & (cost >= 0)).all():
        r = int(np.flatnonzero(~(np.isfinite(cost) & (cost >= 0)))[0])
        raise ValueError(
            f"the reward of a choice of state {host.state[r]} is {cost[r]:.6g}; "
            "prepared solves need finite rewards of at least 0."
        )
    if objective == "policy":
        plan = plan_policy(host, target, stay, cost)
    elif cost is None:
        plan = plan_optimum(
            reduce_reachability(host, target, maximize=objective == "max", stay=stay), None
        )
    else:
        kept = host.over_choices(np.maximum, cost) > 0
        plan = plan_optimum(
            reduce_total_reward(host, cost, target, maximize=objective == "max", kept=kept), cost
        )
    return _prepared(host, plan, cost, objective)


def _prepared(host: Any, plan: Plan, cost: Any, objective: str) -> Prepared:
    dtype = jnp.zeros(()).dtype
    refuse_underflow(host.row_start, host.entry_start, host.probability, dtype)
    vector = np.concatenate(
        [host.probability, np.zeros(host.num_rows) if cost is None else cost, [1.0, 0.0]]
    )
    if plan.loops is not None:
        rest = np.bincount(plan.loops.group, host.probability[plan.loops.entry], plan.loops.groups)
        scale = np.ones(host.num_rows)
        scale[plan.loops.row] = 1 / np.maximum(rest, 1e-300)[plan.loops.row_group]
        vector[: host.num_transitions] *= scale[host.row]
        vector[host.num_transitions : -2] *= scale
    blocks, nodes, first = [], [], 0
    for part in plan.schedule.segments:
        full = (part.source != vector.size - 1).any((1, 2)).ravel()
        nodes.append(first + np.flatnonzero(full))
        weight = vector[part.source].astype(dtype)
        blocks.append(Blocks(part.target, part.source, weight, part.name, first))
        first = blocks[-1].last
    loops = None if plan.loops is None else tuple(x.astype(np.int32) for x in plan.loops[:4])
    cycles = None if plan.cycles is None else tuple(x.astype(np.int32) for x in plan.cycles)
    found = Prepared(
        segments=(blocks[0], blocks[1], blocks[2]),
        place=plan.place,
        nodes=np.concatenate(nodes).astype(np.int32),
        own=plan.own,
        row=plan.row,
        entry_row=host.row.astype(np.int32),
        row_state=host.state.astype(np.int32),
        probability=host.probability.astype(dtype),
        reward=None if cost is None else cost.astype(dtype),
        loops=loops,
        cycles=cycles,
        question="probability" if cost is None else "reward",
        objective=objective,
        cyclic=plan.schedule.segments[1].target.size > 0,
        levels=plan.schedule.levels,
        choices=plan.schedule.choices,
        terms=plan.terms + blocks[0].target.shape[2],
        groups=0 if plan.loops is None else plan.loops.groups,
    )
    return to_jax(found)


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
    max_steps: chex.Array | int = 100_000,
) -> Solution:
    """Solves a prepared question, with other probabilities, intervals or rewards.

    Without cycles one pass is exact but for rounding, which is known in advance. With cycles,
    bounds of both sides are proven by passes, see :mod:`jaxltl.core.values.prepared.interval_iteration`.

    Args:
      prepared: the question.
      probability: ``float[T]``, of the same transitions, all positive; rows sum to one.
      lower, upper: ``float[T]``, of a prepared IntervalMDP in place of probabilities, see
        :func:`~jaxltl.core.values.prepared.prepared_interval.solve_prepared_interval`.
      reward: ``float[R]``, finite, at least 0, and 0 where it was; also positive where it was, if
        the least is asked for. Only if a reward was prepared.
      policy: rows ``int32[S]`` or weights ``float[R]``, if it was prepared for policies; a chain
        needs none.
      tolerance: the width of the enclosure asked for, for rewards as a share of the value; default
        1e-6 in double precision, 1e-3 in single.
      max_steps: passes at most.

    Returns:
      :class:`Solution`; `value` ``float[S]``, exactly what the graph says where it decides,
      `policy` ``int32[S]``, rows that attain the bound on the safe side, or the given policy.
      ``INVALID`` where probabilities, rewards or the policy are not as they must be,
      ``NONFINITE`` where they are NaN or infinite.

    Raises:
      ValueError: a shape is wrong, or there is a policy and none was prepared for, or no policy.

    Differentiable, forward and reverse, in the probabilities, in the rewards and in the weights of
    a policy, along distributions; of an optimum with its policy held fixed.

    Example:
      >>> from jaxltl import make_sparse
      >>> coin = make_sparse(None, [0, 2, 3, 4], [1, 2, 1, 2], [0.5, 0.5, 1, 1])
      >>> prepared = prepare(coin, [False, True, False])
      >>> solve = jax.jit(lambda p: solve_prepared(prepared, probability=p))
      >>> found = solve(jnp.array([0.25, 0.75, 1, 1]))
      >>> round(found.value[0].item(), 3), found.status.item()
      (0.25, 0)
      >>> slope = jax.eval_shape(jax.grad(lambda p: solve(p).value[0]), prepared.probability)
      >>> slope.shape
      (4,)
    """
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
    probability, reward = given_numbers(prepared, probability, reward)
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
    dtype = prepared.probability.dtype
    if tolerance is None:
        tolerance = 1e-6 if dtype == jnp.float64 else 1e-3
    return _solve(prepared, probability, reward, policy, tolerance, max_steps)


def given_numbers(prepared: Prepared, probability: Any, reward: Any) -> tuple[Any, Any]:
    """Given probabilities and rewards, with checked shapes."""
    probability, reward = (None if x is None else jnp.asarray(x) for x in (probability, reward))
    if probability is not None:
        require_shape("probability", probability, prepared.probability.shape)
    if reward is not None:
        if prepared.reward is None:
            raise ValueError(
                "a reward is given, but the question is a probability: prepare it with a reward."
            )
        require_shape("reward", reward, prepared.reward.shape)
    return probability, reward


@jax.jit
def _solve(
    prepared: Prepared, probability: Any, reward: Any, policy: Any, tolerance: Any, max_steps: Any
) -> Solution:
    dtype = prepared.probability.dtype
    tolerance = jnp.asarray(tolerance, dtype)
    share, taken = _shares(prepared, policy)
    finite, valid = checked_numbers(prepared, probability, reward, share)
    if probability is not None or reward is not None or share is not None:
        prepared = refilled(prepared, probability, reward, share)
    decided = None
    if prepared.objective == "policy":
        decided = _decided(prepared, reward, share)
    found = _enclosed(prepared, decided, tolerance, max_steps)
    value = _attached(prepared, found, decided)
    return _answer(prepared, found, decided, value, tolerance, finite, valid, taken)


class _Shares(NamedTuple):
    weight: jax.Array
    used: jax.Array
    valid: jax.Array
    finite: jax.Array


def _shares(prepared: Prepared, policy: Any) -> tuple[_Shares | None, Any]:
    """Weights of the rows under the policy, normalised, and the policy of the solution."""
    if prepared.objective != "policy":
        return None, None
    dtype = prepared.probability.dtype
    if policy is None:
        policy = jnp.ones(prepared.num_rows, dtype)
    policy = jnp.asarray(policy)
    if is_deterministic(policy):
        rows = jnp.arange(prepared.num_rows, dtype=jnp.int32)
        used = policy[prepared.row_state] == rows
        weight = used.astype(dtype)
    else:
        weight = policy.astype(dtype)
        used = weight > 0
    total = jax.ops.segment_sum(
        weight, prepared.row_state, prepared.num_states, indices_are_sorted=True
    )
    slack = row_tolerance(dtype)
    valid = jnp.all(jnp.abs(total - 1) <= slack) & jnp.all(weight >= 0)
    valid &= ~jnp.any(is_subnormal(weight))
    finite = jnp.all(jnp.isfinite(weight))
    total = jnp.where(total > 0, total, 1)
    return _Shares(weight / total[prepared.row_state], used, valid, finite), policy


def checked_numbers(
    prepared: Prepared, probability: Any, reward: Any, share: _Shares | None
) -> tuple[jax.Array, jax.Array]:
    """Whether numbers are finite, and whether they are valid."""
    finite, valid = jnp.asarray(True), jnp.asarray(True)
    if probability is not None:
        probability = lax.stop_gradient(probability).astype(prepared.probability.dtype)
        total = jax.ops.segment_sum(
            probability, prepared.entry_row, prepared.num_rows, indices_are_sorted=True
        )
        finite &= jnp.all(jnp.isfinite(total))
        slack = row_tolerance(probability.dtype)
        valid &= jnp.all(probability > 0) & jnp.all(jnp.abs(total - 1) <= slack)
    if reward is not None:
        finite &= jnp.all(jnp.isfinite(reward))
        before = prepared.reward > 0
        valid &= jnp.all(reward >= 0) & jnp.all(before | (reward == 0))
        if prepared.objective == "min":
            valid &= jnp.all((reward > 0) == before)
    if share is not None:
        finite, valid = finite & share.finite, valid & share.valid
    return finite, valid


def refilled(prepared: Prepared, probability: Any, reward: Any, share: _Shares | None) -> Prepared:
    """The prepared question with other weights in its blocks."""
    dtype = prepared.probability.dtype
    p = prepared.probability if probability is None else jnp.asarray(probability, dtype)
    r = prepared.reward if reward is None else jnp.asarray(reward, dtype)
    scale = None if share is None else share.weight
    if prepared.loops is not None:
        entry, group, row, row_group = prepared.loops
        rest = p[entry] if scale is None else p[entry] * scale[prepared.entry_row[entry]]
        total = jax.ops.segment_sum(rest, group, prepared.groups, indices_are_sorted=True)
        inverse = jnp.where(total > 0, 1 / jnp.where(total > 0, total, 1), 0)[row_group]
        if scale is None:
            scale = jnp.ones(prepared.num_rows, dtype)
        scale = scale.at[row].multiply(inverse, unique_indices=True)
    if r is None:
        r = jnp.zeros(prepared.num_rows, dtype)
    if scale is not None:
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


def _decided(prepared: Prepared, reward: Any, share: _Shares | None) -> _Decided:
    """Places where the value of a policy is 0, 1 or infinite."""
    assert share is not None
    size = prepared.size
    earned = prepared.reward if reward is None else reward
    paid = jnp.zeros(prepared.num_rows, bool) if earned is None else share.used & (earned > 0)
    used = jnp.concatenate([share.used[prepared.entry_row], paid, jnp.asarray([True, False])])
    support = tuple(used[x.source] for x in prepared.segments)
    goal = size if prepared.question == "probability" else size + 1
    seed = jnp.zeros(size + 3, bool).at[goal].set(True)
    reached = meets(prepared.segments, support, seed, prepared.cyclic)
    # States that never get there; other places are parts of rows, of which none may be taken.
    states = jnp.zeros(size + 3, bool).at[prepared.place].set(True)
    never = states & ~reached
    never = never.at[size:].set(jnp.asarray([False, False, True]))
    lost = meets(prepared.segments, support, never, prepared.cyclic)
    if prepared.question == "probability":
        return _Decided(
            ~states | (reached & lost), states & reached & ~lost, jnp.zeros(size + 3, bool)
        )
    paying = jnp.zeros(size + 3, bool).at[size].set(True)
    earns = meets(prepared.segments, support, paying, prepared.cyclic)
    return _Decided(~lost & earns, jnp.zeros(size + 3, bool), lost)


class _Found(NamedTuple):
    """Enclosed values of the places, ``float[N]``."""

    value: jax.Array
    lower: jax.Array
    upper: jax.Array
    rank: jax.Array | None
    residual: jax.Array
    steps: jax.Array
    proven: jax.Array


def _least(prepared: Prepared) -> float:
    """Bound on what a sum loses to underflow."""
    return 4 * prepared.terms * float(jnp.finfo(prepared.probability.dtype).tiny)


def _enclosed(
    prepared: Prepared, decided: _Decided | None, tolerance: jax.Array, max_steps: Any
) -> _Found:
    prepared = lax.stop_gradient(prepared)
    dtype, size = prepared.probability.dtype, prepared.size
    unit, least = prepared.terms * float(jnp.finfo(dtype).eps), _least(prepared)
    given: dict[str, Any] = {"maximize": prepared.objective != "min"}
    if decided is not None:
        given["keep"] = decided.keep[:size].astype(dtype)
        given["put"] = decided.put[:size].astype(dtype)
    start = jnp.zeros(size + 3, dtype).at[size].set(1)
    if prepared.cyclic:
        return _solve_cyclic(prepared, start, given, unit, least, tolerance, max_steps)
    x, rank = sweep(prepared.segments[0], start, choose=decided is None, **given)
    x = x[:size]
    share = 1.3 * prepared.levels * unit
    known = share <= 0.1
    lower = jnp.maximum(x * (1 - share) - prepared.levels * least, 0) if known else x * 0
    upper = x * (1 + share) + prepared.levels * least if known else x * 0 + jnp.inf
    zero = jnp.zeros((), dtype)
    return _Found(x, lower, upper, rank, zero, jnp.asarray(1, jnp.int32), jnp.asarray(known))


def _solve_cyclic(
    prepared: Prepared,
    start: jax.Array,
    given: dict[str, Any],
    unit: float,
    least: float,
    tolerance: jax.Array,
    max_steps: Any,
) -> _Found:
    """Bounds from both sides where the system has cycles."""
    before, core, after = prepared.segments
    size = prepared.size
    down: Any = partial(sweep, factor=1 - unit, shift=-least, **given)
    up: Any = partial(sweep, factor=1 + unit, shift=least, **given)
    arrays = {k: x for k, x in given.items() if k != "maximize"}

    def enclosed(core: Blocks, arrays: Any, tolerance: Any, low: Any, high: Any, most: Any) -> Any:
        options = {"maximize": given["maximize"], **arrays}
        problem = Problem(core, options, unit, least, tolerance, prepared.question == "reward")
        return enclose_cycles(problem, low, high, most)

    # How much work it is depends on the lane.
    s = in_turn(
        enclosed,
        core,
        arrays,
        tolerance,
        down(before, start)[0],
        up(before, start)[0],
        jnp.asarray(max_steps, jnp.int32),
    )
    low, high = down(after, s.low)[0], up(after, s.high)[0]
    rank = None
    if "keep" not in given:
        # Greedy in a bound that a pass does not worsen: its policy attains it.
        safe = low if given["maximize"] else jnp.where(s.proven, high, low)
        parts: list[Any] = []
        for part in prepared.segments:
            safe, ranks = sweep(part, safe, choose=True, **given)
            parts.append(ranks)
        rank = jnp.concatenate(parts)
    low, high = low[:size], high[:size]
    middle = jnp.where(s.proven, low + (high - low) / 2, low)
    return _Found(middle, low, high, rank, s.moved, s.steps, s.proven)


# --- what comes out -----------------------------------------------------------------------------


def _attached(prepared: Prepared, found: _Found, decided: _Decided | None) -> jax.Array:
    """Values of the places with implicit derivatives."""
    size, dtype = prepared.size, prepared.probability.dtype
    if not size:
        return found.value
    system = chosen_rows(prepared, found.rank)
    put = jnp.zeros(size, dtype)
    if decided is not None:
        count, _, block = system.target.shape
        keep = decided.keep[:size].astype(dtype)
        system = replace(system, weight=system.weight * keep.reshape(count, 1, block))
        put = decided.put[:size].astype(dtype)
    fixed = lax.stop_gradient(system)
    one = jnp.asarray([1, 0, 0], dtype)

    def operator(x: jax.Array) -> jax.Array:
        return system.image(jnp.concatenate([x, one])) + put

    return implicit(operator, found.value, solve=fixed.solve, transpose_solve=fixed.transpose_solve)


def chosen_rows(prepared: Prepared, rank: jax.Array | None) -> Chosen:
    """The linear system of the rows with given ranks; by default the first ones."""
    target = jnp.concatenate([x.target for x in prepared.segments])
    weight = jnp.concatenate([x.weight for x in prepared.segments])
    if rank is None:
        return Chosen(target[:, 0], weight[:, 0], prepared.cyclic)
    at = rank[:, None, None]
    return Chosen(
        jnp.take_along_axis(target, at, 1)[:, 0],
        jnp.take_along_axis(weight, at, 1)[:, 0],
        prepared.cyclic,
    )


def _answer(
    prepared: Prepared,
    found: _Found,
    decided: _Decided | None,
    value: jax.Array,
    tolerance: jax.Array,
    finite: jax.Array,
    valid: jax.Array,
    taken: Any,
) -> Solution:
    """The solution; checked at the nodes, which may be far fewer than the states."""
    dtype, size = prepared.probability.dtype, prepared.size
    relative = prepared.question == "reward"
    most = jnp.inf if relative else 1.0
    value = value + lax.stop_gradient(jnp.clip(value, 0, most) - value)
    lower, upper = found.lower, jnp.minimum(found.upper, most)
    if decided is not None:
        keep, put, infinite = (x[:size] for x in decided)
        known = jnp.where(infinite, jnp.inf, put.astype(dtype))
        value, lower, upper = (jnp.where(keep, x, known) for x in (value, lower, upper))
    width = jnp.where(lower == upper, 0, upper - jnp.where(jnp.isfinite(lower), lower, 0))
    scale = jnp.where(jnp.isfinite(upper), upper, 1) if relative else 1
    floor = 1e3 * SLACK * _least(prepared)  # what rewards of zero are known to
    narrow = jnp.all((width <= tolerance * scale + floor) & (lower <= upper))
    finite &= jnp.all(~jnp.isnan(lax.stop_gradient(value)))
    status = status_code(found.proven & narrow, finite, found.proven, valid=valid | ~finite)
    good = valid & finite
    ends = jnp.asarray([0, 0, jnp.inf] if relative else [1, 0, 0], dtype)

    def everywhere(x: jax.Array, bad: float) -> jax.Array:
        x = jnp.where(good, jnp.concatenate([x, ends]), jnp.asarray(bad, dtype))
        return x.at[prepared.place].get(mode="promise_in_bounds")

    return Solution(
        value=everywhere(value, jnp.nan),
        lower=everywhere(lower, -jnp.inf),
        upper=everywhere(upper, jnp.inf),
        policy=_policy(prepared, found) if taken is None else taken,
        residual=jnp.where(good, found.residual, jnp.nan),
        num_steps=found.steps,
        status=status,
    )


def _policy(prepared: Prepared, found: _Found) -> jax.Array:
    """An optimal policy, ``int32[S]``."""
    names = jnp.concatenate([x.name for x in prepared.segments])
    if found.rank is None or not names.shape[0]:
        return prepared.row
    chosen = chosen_names(names, found.rank, prepared.choices)
    own = prepared.own
    rows = jnp.where(own >= 0, chosen[jnp.maximum(own, 0)], prepared.row)
    if prepared.cycles is None:
        return rows
    return _going_round(prepared, rows)


def _going_round(prepared: Prepared, rows: jax.Array) -> jax.Array:
    """The policy completed inside end components by rows towards the exit."""
    state, inside, owner, entry_row, successor = prepared.cycles
    picked = rows[state]
    there = prepared.row_state[picked] == state
    count, many = state.shape[0], inside.shape[0]
    last = jnp.iinfo(jnp.int32).max

    def further(carry: Any) -> Any:
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
