"""Prepared solves of interval models: one graph, many intervals, in ``jit``, ``vmap``, ``grad``."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxltl.core import struct
from jaxltl.core.validation import float_array
from jax import lax

from jaxltl.core.models.interval import IntervalMDP, refuse_ball
from jaxltl.core.models.ops.array_namespace import jit, is_traced, to_jax
from jaxltl.core.models.action_numbers import row_actions, rows_of_policy
from jaxltl.core.models.ops.operators import is_deterministic
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.interval.robust_values import Query
from jaxltl.core.sparse.interval.uncertainty_set import UncertainMDP
from jaxltl.core.sparse.prepared.interval_plan import (
    IntervalPlan,
    plan_reachability,
    plan_total_reward,
)
from jaxltl.core.sparse.rows import concatenated_ranges
from jaxltl.core.types import Solution, Status, require_shape, status_code
from jaxltl.core.models.protocols import Array
from jaxltl.core.models.sparse import Reward
from jaxltl.core.values.engine.host_solution import default_tolerance
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import row_system
from jaxltl.core.values.interval.robust_policy_iteration import (
    NodeBounds,
    RobustProblem,
    greedy_distributions,
    enclose,
    leaving,
    rounding,
)
from jaxltl.core.values.door.row_engines import certain_reward
from jaxltl.core.values.engine.row_form import row_form
from jaxltl.core.values.interval.sides import nature_direction

_LOOSE = 1e-6  # how far ends may miss a distribution, as in the models


@brief
@struct.dataclass
class PreparedInterval:
    """Preprocessed question about an interval model, see :class:`Prepared`.

    Undecided states are the nodes 0 to N - 1; the nodes N, N + 1 and N + 2 have the values 0, 1
    and infinity.

    Attributes:
      table, target: ``int32[R', W]``, entries of the remaining rows (T is padding), and their nodes.
      owner, row: ``int32[R']``, the node of each row, and its row of the model.
      choice: ``int32[N, A]``, the rows of a node, padded with the first one.
      first: ``int32[N]``, a row that leaves the node.
      node: ``int32[S]``, of each state.
      policy: ``int32[S]``, rows of states that are no nodes, or of all if a policy was given.
      entry_row, action: ``int32[T]`` and ``int32[R]``, the row of each entry, the action of each row.
      within: ``bool[T]``, entries to which nature keeps where values are known.
      answers: invariants of the preprocessing: entries, questions, their rows, answers.
      lower, upper, reward: ``float[T]``, ``float[T]``, ``float[R]``, as they were.
      question: ``"probability"`` or ``"reward"``, static.
      objective, nature_objective: ``"max"`` or ``"min"``, of the policy and of nature, static.
      num_rows: R, static.
      has_free_cycles: True if the leader may cycle for ever at no cost, static.

    Example:
      >>> from jaxltl.core.models import interval_rows
      >>> coin = interval_rows(None, [0, 2, 3, 4], [1, 2, 1, 2], [.4, .3, 1, 1], [.7, .6, 1, 1])
      >>> prepared = prepare_interval(coin, [False, True, False])
      >>> prepared.objective, prepared.nature_objective, prepared.size, prepared.node.tolist()
      ('max', 'min', 1, [0, 2, 1])
    """

    table: Array
    target: Array
    owner: Array
    row: Array
    choice: Array
    first: Array
    node: Array
    policy: Array
    entry_row: Array
    action: Array
    within: Array
    answers: Array
    lower: Array
    upper: Array
    reward: Array
    question: str = struct.field(pytree_node=False)
    objective: str = struct.field(pytree_node=False)
    nature_objective: str = struct.field(pytree_node=False)
    num_rows: int = struct.field(pytree_node=False)
    has_free_cycles: bool = struct.field(pytree_node=False)

    @property
    def num_states(self) -> int:
        """S, of the model."""
        return int(self.node.shape[-1])

    @property
    def size(self) -> int:
        """The number N of nodes."""
        return int(self.first.shape[-1])

    def sum_rows(self, quantity: jax.Array) -> jax.Array:
        """Sums over the entries of each row, ``[R]`` from ``[T]``."""
        return jax.ops.segment_sum(quantity, self.entry_row, self.num_rows, indices_are_sorted=True)


def prepare_interval(
    model: IntervalMDP,
    target: Array | str,
    *,
    stay: Array | str | None = None,
    reward: Reward = None,
    policy: Array | None = None,
    objective: str = "max",
    nature: str | None = None,
) -> PreparedInterval:
    """Preprocessed question about an interval model, see `prepare`."""
    refuse_ball(model, "prepare has no rule for its derivatives")
    direction = nature_direction(nature, objective)
    form = row_form(model)
    target = form.states("target", target)
    stay = None if stay is None else form.states("stay", stay)
    host: UncertainMDP = model.host
    entry: Array = np.arange(model.num_transitions)
    if policy is not None:
        if not is_deterministic(policy):
            raise ValueError(
                "prepare takes a policy of actions, int[S], of an interval model; weights are for "
                "the host's solvers."
            )
        policy = rows_of_policy(model.nominal, policy)
        host, entry = host.under_policy(policy)
    up, large = objective == "max", direction == "max"
    if policy is not None:
        up = large  # without choices, the policy has the objective of nature
    cost = None if reward is None else certain_reward(form, reward)
    if cost is None:
        plan = plan_reachability(host, target, stay, Query(up, large))
    else:
        mine = cost if policy is None else cost[np.asarray(policy)]
        plan = plan_total_reward(host, mine, target, Query(up, large))
    origin = np.arange(host.mdp.num_rows) if policy is None else np.asarray(policy)
    prepared = _prepared(model, cost, host, plan, entry, origin)
    return replace(prepared, objective=objective, nature_objective=direction)


def _prepared(
    model: IntervalMDP,
    cost: Array,
    host: UncertainMDP,
    plan: IntervalPlan,
    entry: np.ndarray,
    origin: np.ndarray,
) -> PreparedInterval:
    """The arrays; `entry` and `origin` are the entries and rows of the model that `host` has."""
    mdp, whole = host.mdp, model.nominal.host
    dtype = jnp.zeros(()).dtype
    open_ = np.isnan(plan.known)
    size = int(open_.sum())
    node = np.where(plan.known == 1, size + 1, np.where(np.isinf(plan.known), size + 2, size))
    node[open_] = np.arange(size)
    rows = plan.rows
    count = np.diff(mdp.entry_start)[rows]
    width = int(count.max(initial=1))
    place = np.repeat(np.arange(rows.size), count), concatenated_ranges(np.zeros_like(count), count)
    mine = concatenated_ranges(mdp.entry_start[rows], count)
    nowhere = whole.num_transitions
    table, target = (np.full((rows.size, width), x, np.int32) for x in (nowhere, size))
    used = plan.used[mine]
    table[place] = np.where(used, entry[mine], nowhere)
    target[place] = np.where(used, node[mdp.successor[mine]], size)
    owner = node[mdp.state[rows]]
    each = np.bincount(owner, minlength=size)
    rank = np.minimum(np.arange(each.max(initial=1)), each[:, None] - 1)
    start = each.cumsum() - each
    choice = start[:, None] + rank
    number = np.full(mdp.num_rows, -1)
    number[rows] = np.arange(rows.size)
    inside = np.ones(whole.num_transitions, bool)
    inside[entry] = plan.within
    answers = plan.queries
    prepared = PreparedInterval(
        table=table,
        target=target,
        owner=owner.astype(np.int32),
        row=origin[rows].astype(np.int32),
        choice=choice.astype(np.int32),
        first=number[plan.row[open_]].astype(np.int32),
        node=node.astype(np.int32),
        policy=origin[plan.row].astype(np.int32),
        entry_row=whole.row.astype(np.int32),
        action=row_actions(model.nominal).astype(np.int32),
        within=inside,
        answers=(
            entry[answers.entry].astype(np.int32),
            answers.group.astype(np.int32),
            answers.room,
            np.diff(whole.entry_start)[origin[answers.row]].astype(np.int32),
        ),
        lower=np.asarray(model.lower, dtype),
        upper=np.asarray(model.upper, dtype),
        reward=None if cost is None else cost.astype(dtype),
        question="probability" if cost is None else "reward",
        objective="max",
        nature_objective="max",
        num_rows=whole.num_rows,
        has_free_cycles=plan.has_free_cycles,
    )
    result: PreparedInterval = to_jax(prepared)
    return result


def require_prepared_reward(prepared: jax.Array | None, reward: jax.Array | None) -> None:
    """Raises ValueError if a reward is given and none was prepared, or has another shape."""
    if reward is None:
        return
    if prepared is None:
        raise ValueError(
            "a reward is given, but the question is a probability: prepare it with a reward."
        )
    require_shape("reward", reward, prepared.shape)


def solve_prepared_interval(
    prepared: PreparedInterval,
    *,
    lower: chex.Array | None = None,
    upper: chex.Array | None = None,
    reward: chex.Array | None = None,
    tolerance: chex.Array | float | None = None,
    max_steps: chex.Array | int = 100,
) -> Solution:
    """Solution of a prepared question about an interval model, see `solve_prepared`."""
    dtype = prepared.lower.dtype
    lower, upper, reward = (
        None if x is None else jnp.asarray(x if is_traced(x) else float_array(name, x), dtype)
        for name, x in (("lower", lower), ("upper", upper), ("reward", reward))
    )
    for name, ends in (("lower", lower), ("upper", upper)):
        if ends is not None:
            require_shape(name, ends, prepared.lower.shape)
    require_prepared_reward(prepared.reward, reward)
    if tolerance is None:
        tolerance = default_tolerance(prepared.lower)
    return _solve(prepared, lower, upper, reward, tolerance, max_steps)


@jit()
def _solve(
    prepared: PreparedInterval,
    lower: Array,
    upper: Array,
    reward: Array,
    tolerance: Array,
    max_steps: Array,
) -> Solution:
    finite, valid = _checked(prepared, *lax.stop_gradient((lower, upper, reward)))
    lower = prepared.lower if lower is None else lower
    upper = prepared.upper if upper is None else upper
    reward = prepared.reward if reward is None else reward
    problem = _robust_problem(prepared, lower, upper, reward)
    tolerance = jnp.asarray(tolerance, lower.dtype)
    if prepared.size:
        bounds = sequential_vmap(enclose, problem, tolerance, jnp.asarray(max_steps, jnp.int32))
    else:
        none, proven = jnp.zeros(0, lower.dtype), jnp.asarray(True)
        bounds = NodeBounds(
            none, none, proven, proven, none, problem.first, problem.lower, jnp.int32(0)
        )
    return _answer(prepared, problem, bounds, (lower, upper), tolerance, (finite, valid))


def _checked(
    prepared: PreparedInterval, lower: Array, upper: Array, reward: Array
) -> tuple[jax.Array, jax.Array]:
    """Tests that numbers are finite, and that the preprocessing holds for them."""
    finite, valid = jnp.asarray(True), jnp.asarray(True)
    if lower is not None or upper is not None:
        low = prepared.lower if lower is None else lower
        high = prepared.upper if upper is None else upper
        total = prepared.sum_rows
        finite &= jnp.all(jnp.isfinite(low)) & jnp.all(jnp.isfinite(high))
        slack = max(_LOOSE, 128 * float(jnp.finfo(low.dtype).eps))
        valid &= jnp.all((low >= 0) & (low <= high) & (high <= 1 + slack))
        width = total(jnp.ones_like(low))
        miss = rounding(width, low.dtype)
        valid &= jnp.all((total(low) <= 1 + miss) & (total(high) >= 1 - miss))
        valid &= jnp.all((low > 0) == (prepared.lower > 0))
        valid &= jnp.all((high > 0) == (prepared.upper > 0))
        entry, group, room, width = prepared.answers
        if room.shape[0]:
            parts = partial(
                jax.ops.segment_sum,
                segment_ids=group,
                num_segments=room.shape[0],
                indices_are_sorted=True,
            )
            ends = high[entry]
            mass = parts(ends)
            # A sum near one has the right sign if no addition rounds, and the same one if nothing
            # has changed; else it does not tell.
            grain = 1 / float(jnp.finfo(low.dtype).eps)
            coarse = parts(jnp.where(ends * grain == jnp.floor(ends * grain), 0, 1)) == 0
            same = parts(jnp.where(ends == prepared.upper[entry], 0, 1)) == 0
            clear = jnp.abs(mass - 1) > rounding(width, low.dtype)
            valid &= jnp.all(same | ((clear | coarse) & ((mass >= 1) == room)))
    if reward is not None:
        finite &= jnp.all(jnp.isfinite(reward))
        valid &= jnp.all(reward >= 0) & jnp.all((reward > 0) == (prepared.reward > 0))
    return finite, valid


def _robust_problem(
    prepared: PreparedInterval, lower: Array, upper: Array, reward: Array
) -> RobustProblem:
    """The residual problem with its intervals and rewards."""
    low, high = (jnp.append(x, 0)[prepared.table] for x in (lower, upper))
    is_reward = prepared.question == "reward"
    cost = -reward[prepared.row] if is_reward else jnp.zeros(prepared.row.shape, low.dtype)
    wanted = "min" if is_reward else "max"
    chain = prepared.choice.shape[1] == 1
    nature = prepared.nature_objective == wanted
    return RobustProblem(
        prepared.target,
        prepared.owner,
        prepared.choice,
        prepared.first,
        low,
        high,
        cost,
        policy_leads=nature if chain else prepared.objective == wanted,
        nature_leads=nature,
        relative=is_reward,
        has_free_cycles=prepared.has_free_cycles,
    )


def _answer(
    prepared: PreparedInterval,
    problem: RobustProblem,
    bounds: NodeBounds,
    ends: tuple[jax.Array, jax.Array],
    tolerance: jax.Array,
    checks: tuple[jax.Array, jax.Array],
) -> Solution:
    """The solution at the states."""
    (lower, upper), (finite, valid) = ends, checks
    is_reward, dtype = problem.relative, problem.lower.dtype
    middle = bounds.middle
    highest = jnp.inf if is_reward else 1.0
    sign = -1 if is_reward else 1
    ends = (bounds.upper, bounds.lower) if is_reward else (bounds.lower, bounds.upper)
    low, high = (sign * x for x in ends)
    sure = bounds.lower_proven, bounds.upper_proven
    sure = sure[::-1] if is_reward else sure
    low = jnp.where(sure[0], jnp.clip(low, 0, highest), 0)
    high = jnp.where(sure[1], jnp.clip(high, 0, highest), highest)
    middle = jnp.clip(sign * middle, low, high)
    residual = jnp.max(jnp.abs(_image(problem, middle, sign) - middle), initial=0)
    value = _attached(problem, bounds, middle, sign) if prepared.size else middle
    scale = jnp.where(jnp.isfinite(high), high, 1) if is_reward else 1.0
    narrow = jnp.all((high - low <= tolerance * scale) & (low <= high))
    proven = bounds.lower_proven & bounds.upper_proven
    small = residual <= tolerance * jnp.max(jnp.abs(middle), initial=1 if not is_reward else 0)
    valid |= ~finite  # NaN and infinity have the status NONFINITE
    finite &= jnp.all(jnp.isfinite(lax.stop_gradient(middle)))
    status = status_code(proven & narrow, finite, proven, valid=valid)
    status = jnp.where(~proven & small & (status == Status.MAX_STEPS), Status.UNCERTIFIED, status)
    good = valid & finite
    known = jnp.asarray([0, 1, jnp.inf], dtype)

    def everywhere(x: jax.Array, bad: float) -> jax.Array:
        return jnp.where(good, jnp.concatenate([x, known]), bad)[prepared.node]

    row, free = prepared.policy, upper - lower
    if prepared.size:
        mine = jnp.append(prepared.row[bounds.row], 0)[jnp.minimum(prepared.node, prepared.size)]
        row = jnp.where(prepared.node < prepared.size, mine, row)
    room = prepared.sum_rows(jnp.where(prepared.within, free, 0))
    rest = jnp.maximum(1 - prepared.sum_rows(lower), 0)
    share = jnp.where(room > 0, jnp.minimum(rest / jnp.where(room > 0, room, 1), 1), 0)
    chance = jnp.where(prepared.within, lower + free * share[prepared.entry_row], 0)
    chance = chance.at[prepared.table].set(bounds.probability, mode="drop")
    return Solution(
        value=everywhere(value, jnp.nan),
        policy=prepared.action[row],
        nature=lax.stop_gradient(chance),
        lower=everywhere(low, -jnp.inf),
        upper=everywhere(high, jnp.inf),
        residual=jnp.where(good, residual, jnp.nan),
        num_steps=bounds.rounds,
        status=status,
        method="policy iteration with nature",
    )


def _image(problem: RobustProblem, x: jax.Array, sign: int) -> jax.Array:
    """The optimality operator applied to values."""
    if not problem.size:
        return x
    gain = problem.ahead(sign * x)
    best = problem.best(jnp.sum(problem.greedy(gain) * gain, axis=1) + problem.cost)[0]
    return lax.stop_gradient(x + sign * best)


def _attached(problem: RobustProblem, bounds: NodeBounds, value: jax.Array, sign: int) -> jax.Array:
    """Values with implicit derivatives, policy and order of successors held fixed."""
    row, target = bounds.row, problem.target[bounds.row]
    value = lax.stop_gradient(value)
    key = lax.stop_gradient(problem.ahead(sign * value))[row]
    p = greedy_distributions(problem.lower[row], problem.upper[row], problem.key(key))
    ends = jnp.asarray([0, 1], value.dtype)

    def operator(x: jax.Array) -> jax.Array:
        return sign * problem.cost[row] + jnp.sum(p * jnp.concatenate([x, ends])[target], axis=1)

    mass, share = lax.stop_gradient(leaving(target, p))
    return implicit(operator, value, row_system(target, share, mass))
