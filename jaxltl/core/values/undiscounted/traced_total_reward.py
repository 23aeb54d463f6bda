"""Expected total rewards inside ``jit`` and over a mesh.

The graph decides where the value is infinite or 0. Elsewhere it is the fixed point of
``T x = opt_a (r(s, a) + (P x)(s, a))``, enclosed between the solutions of ``l = (1 - e) T l`` and
``u = (1 + e) T u`` for a small e, which is found by trial: one application of T proves
``l <= T l`` and ``u >= T u``, because e exceeds the rounding of a backup.

- ``u >= T u`` and ``u >= 0`` bound a maximum, which is the least such u. For a minimum
  ``u >= T_pi u`` bounds the value of pi if pi reaches the target almost surely, by its graph.
- ``l <= T l`` bounds the value of every policy that reaches the target almost surely, since
  ``P^n l -> 0`` (Bertsekas and Tsitsiklis 1991). A maximum is finite only where all policies do.
- A minimum with end components of zero reward has several fixed points. Their states are collapsed:
  they share the best choice that leaves the end component.

The equations are solved by inexact policy iteration (Newton's method): in each step the linear
system of the greedy policy is solved to the relative residual 1e-2 (the forcing term) by BiCGSTAB,
and by elimination for small models on one device. The system is scaled by the value, so that small
values get as many digits as large ones.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.graphs.attractor import attract, avoid, surely
from jaxltl.core.graphs.end_components import EndComponents, components_within
from jaxltl.core.graphs.graph import TracedGraph
from jaxltl.core.graphs.reaching import policy_sets
from jaxltl.core.models.ops.operators import (
    action_argmax,
    action_mean,
    expectation,
    is_representable,
    policy_operator,
    valid_policy,
)
from jaxltl.core.models.ops.successor_tables import action_columns, sweep_operator
from jaxltl.core.models.product import Product
from jaxltl.core.models.protocols import ActionModel
from jaxltl.core.types import Solution, status_code
from jaxltl.core.values.engine.certificates import refuse, rounding_unit, underflow
from jaxltl.core.values.engine.chain_systems import ChainSystem
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import in_turn
from jaxltl.core.values.engine.linear import System, bicgstab, inverse, is_small, norm

_FORCING = 1e-2  # relative residual of a linear system
_POOR = 0.5  # relative residual from which a solution is not used
_SWEEPS = 128  # under the greedy policy, if its system is not solved
_ATTEMPTS = 8  # number of shares e
_ROUNDINGS = 3  # the smallest e, in rounding errors of a backup
_REST = 400  # steps of policy iteration in which the error must halve
_SAME = 80  # steps for which one counts that does not change the policy
_LARGEST = 0.1  # the largest share e
_MOST_STEPS = 1_000_000


class _Problem(NamedTuple):
    """Residual problem after qualitative preprocessing."""

    model: ActionModel  # the model
    sign: int  # 1 for a maximum, -1 for a minimum; static
    reward: jax.Array  # ``float[S, A]``
    policy: jax.Array | None  # ``float[S, A]``, the policy to evaluate, or None
    open: jax.Array  # ``bool[S]``, where the value is finite and not 0
    finite: jax.Array  # ``bool[S]``
    # ``bool[S, A]``, the actions to choose from; in collapsed end components those that leave
    allowed: jax.Array
    start: jax.Array  # ``int32[S]``, actions that leave the open states almost surely
    decided: jax.Array  # ``int32[S]``, actions for the states that are not open
    circles: EndComponents | None  # for a minimum, the end components of zero reward


class _Point(NamedTuple):
    """A value, its image under T, the action, and in an end component the state that takes it."""

    value: jax.Array
    image: jax.Array
    action: jax.Array
    leaves: jax.Array


_Progress = tuple[_Point, jax.Array, jax.Array, jax.Array, jax.Array]
Tree = TypeVar("Tree")


class Found(NamedTuple):
    """Result of :func:`total_reward_by_sweeps` without derivatives."""

    value: jax.Array  # value, lower, upper: ``float[S]``, 0 where it is infinite
    lower: jax.Array
    upper: jax.Array
    policy: jax.Array  # ``int32[S]``, attains the bound on the safe side
    leaves: jax.Array  # ``int32[S]``, the state with the action that gives the value
    open: jax.Array  # open, finite: as in the problem
    finite: jax.Array
    residual: jax.Array  # residual, num_steps, status: as in a Solution
    num_steps: jax.Array
    status: jax.Array


@partial(jax.jit, static_argnames=("objective",))
def total_reward_by_sweeps(
    model: ActionModel,
    reward: jax.Array,
    target: jax.Array,
    policy: jax.Array | None,
    tolerance: jax.Array | float,
    *,
    objective: str,
) -> Solution:
    """Traced :func:`~jaxltl.core.values.undiscounted.total_reward.total_reward`, with its arguments."""
    # Bounds are 0 and infinity where nothing is proven. If a reward is negative or not finite, the
    # value is NaN and the status ``NONFINITE``.
    target, reward = jnp.asarray(target, bool), jnp.asarray(reward, model.dtype)
    earns = jnp.all(jnp.where(model.available, (reward >= 0) & jnp.isfinite(reward), True))
    reward = jnp.where(model.available & earns, reward, 0)
    checked = None if policy is None else valid_policy(model, policy)
    weight = None if checked is None else checked.distribution
    found: Found = in_turn(
        partial(_enclosed, objective=objective), model, reward, target, weight, tolerance
    )
    # The optimum's derivative is that of the policy that attains it (Danskin).
    chosen = found.policy if weight is None else weight

    def follow(y: jax.Array) -> jax.Array:
        ahead = action_mean(chosen, reward + expectation(model, y))
        return jnp.where(found.open, ahead.ravel()[found.leaves], 0)

    finite = found.finite & earns
    system = ChainSystem(model, chosen, found.open, found.leaves)
    value = implicit(follow, found.value, system=lax.stop_gradient(system))
    value, lower, upper = (
        jnp.where(finite, x, jnp.where(earns, jnp.inf, bad))
        for x, bad in ((value, jnp.nan), (found.lower, -jnp.inf), (found.upper, jnp.inf))
    )
    none = status_code(earns, earns, valid=is_representable(model))
    solution = Solution(
        value=value,
        policy=chosen,
        lower=lower,
        upper=upper,
        residual=found.residual,
        num_steps=found.num_steps,
        status=jnp.maximum(found.status, none),
    )
    return (
        solution
        if checked is None
        else refuse(solution, checked.given, checked.valid, checked.representable)
    )


def _enclosed(
    model: ActionModel,
    reward: jax.Array,
    target: jax.Array,
    policy: jax.Array | None,
    tolerance: jax.Array | float,
    *,
    objective: str,
) -> Found:
    graph = TracedGraph(model)
    if policy is not None:
        problem = _of_policy(graph, reward, target, policy)
    else:
        problem = (_largest if objective == "max" else _smallest)(graph, reward, target)
    return _solution(problem, jnp.asarray(tolerance, model.dtype))


# --- qualitative preprocessing ----------------------------------------------------------------


def _of_policy(
    graph: TracedGraph, reward: jax.Array, target: jax.Array, policy: jax.Array
) -> _Problem:
    taken = graph.available & (policy > 0)
    finite = policy_sets(graph, target, policy).one
    first = graph.first(taken)[1]
    return _Problem(
        graph.model,
        1,
        reward,
        policy,
        _earning(graph, reward, target, taken) & finite,
        finite,
        taken,
        first,
        first,
        None,
    )


def _earning(
    graph: TracedGraph, reward: jax.Array, target: jax.Array, taken: jax.Array
) -> jax.Array:
    """The states from which a positive reward may be earned before the target."""
    some = graph.first(taken & _positive(reward))[0] & ~target
    return attract(graph, some, taken, among=~target).region & ~target


def _positive(reward: jax.Array) -> jax.Array:
    """True if a reward is positive, also if it is subnormal, which arithmetic flushes to 0."""
    kind = jnp.int64 if reward.dtype.itemsize == 8 else jnp.int32
    return lax.bitcast_convert_type(reward, kind) > 0


def _largest(graph: TracedGraph, reward: jax.Array, target: jax.Array) -> _Problem:
    never = jnp.asarray(avoid(graph, target))
    doomed = attract(graph, never, among=~target)
    finite = ~doomed.region
    first = graph.first(graph.available)[1]
    avoids = graph.first(graph.available & graph.forall(never))[1]
    decided = jnp.where(never, avoids, jnp.where(finite, first, doomed.action))
    open_ = _earning(graph, reward, target, graph.available) & finite
    return _Problem(
        graph.model, 1, reward, None, open_, finite, graph.available, first, decided, None
    )


def _smallest(graph: TracedGraph, reward: jax.Array, target: jax.Array) -> _Problem:
    sure = surely(graph, target)
    finite = sure.region
    allowed = graph.available & graph.forall(finite) & graph.on_choices(finite & ~target)
    # The value is 0 where the target is reached almost surely without reward.
    free = allowed & ~_positive(reward)
    nothing = surely(graph, target, free)
    open_ = finite & ~nothing.region
    circles = components_within(graph, open_, free)
    return _Problem(
        graph.model,
        -1,
        reward,
        None,
        open_,
        finite,
        allowed & ~circles.inside,
        sure.action,
        nothing.action,
        circles,
    )


# --- the operator -----------------------------------------------------------------------------


def _numbers(shape: tuple[int, ...]) -> jax.Array:
    size = 1
    for n in shape:
        size *= n
    return jnp.arange(size, dtype=jnp.int32).reshape(shape)


def _backup(problem: _Problem, value: jax.Array) -> _Point:
    """A value's image under T, 0 outside of the open states."""
    ahead = problem.reward + expectation(problem.model, value)
    leaves = _numbers(value.shape)
    if problem.policy is not None:
        image, action = action_mean(problem.policy, ahead), problem.start
    else:
        best, action = action_argmax(problem.sign * ahead, problem.allowed)
        image = problem.sign * best
    if problem.circles is not None:
        image, leaves = lax.cond(
            jnp.any(problem.circles.inside),
            partial(_least, problem.circles.component),
            lambda image: (image, leaves),
            image,
        )
    return _Point(value, jnp.where(problem.open, image, 0), action, leaves)


def _least(component: jax.Array, image: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The minimum over each state's end component, and the first state that attains it."""
    label, flat, last = component.ravel(), image.ravel(), image.size - 1
    best = jax.ops.segment_min(flat, label, num_segments=flat.size)[label]
    mine = jnp.where(flat <= best, _numbers(flat.shape), last)
    first = jax.ops.segment_min(mine, label, num_segments=flat.size)[label]
    return best.reshape(image.shape), first.reshape(image.shape)


def _where_it_leaves(problem: _Problem, at: _Point, x: jax.Array) -> jax.Array:
    if problem.circles is None:
        return x
    return lax.cond(jnp.any(problem.circles.inside), lambda x: x.ravel()[at.leaves], lambda x: x, x)


def _onward(problem: _Problem, at: _Point) -> Callable[[jax.Array], jax.Array]:
    """``x -> P_pi x`` for the policy that attains an image, 0 outside of the open states."""
    model = problem.model
    if problem.policy is None and not isinstance(model, Product):
        along = policy_operator(model, at.action)
    else:
        weight = at.action if problem.policy is None else problem.policy

        def along(x: jax.Array) -> jax.Array:
            return action_mean(weight, expectation(model, x))

    return lambda x: jnp.where(problem.open, _where_it_leaves(problem, at, along(x)), 0)


def _improved(problem: _Problem, factor: jax.Array, at: _Point) -> tuple[jax.Array, jax.Array]:
    """A step of policy iteration for ``v = factor * T v``, and its number of applications of P."""
    # If the linear system is not solved, sweeps under its policy.
    model, onward = problem.model, _onward(problem, at)
    swept = factor * at.image
    change = swept - at.value
    positive = jnp.all(jnp.where(problem.open, at.value > 0, True))
    scale = jnp.where(positive & problem.open, at.value, 1)
    wanted = change / scale

    def matvec(x: jax.Array) -> jax.Array:
        return x - factor * onward(scale * x) / scale

    if is_small(sweep_operator(model), change.size):
        weight = problem.policy
        if weight is None:
            weight = jax.nn.one_hot(at.action, model.num_actions, dtype=model.dtype)
        system = System(
            sweep_operator(model),
            action_columns(model.num_actions, weight),
            problem.open.ravel() * factor,
        )
        eye = jnp.eye(change.size, dtype=model.dtype)
        moves = (eye - system.matrix())[at.leaves.ravel()]
        x = (inverse(eye - moves) @ change.ravel()).reshape(change.shape) / scale
        n = jnp.int32(0)
    else:
        x, n = bicgstab(matvec, wanted, tolerance=_FORCING)
    left = norm((wanted - matvec(x)).ravel())
    solved = left <= _POOR * norm(wanted.ravel())  # false for NaN
    x = lax.cond(
        solved,
        lambda: x,
        lambda: lax.fori_loop(1, _SWEEPS, lambda _, x: x + (wanted - matvec(x)), wanted),
    )
    return at.value + scale * x, n + jnp.where(solved, 1, _SWEEPS)


def _solved(
    problem: _Problem, factor: jax.Array, goal: jax.Array, at: _Point, num_steps: jax.Array
) -> tuple[_Point, jax.Array]:
    """An approximate solution of ``v = factor * T v`` by policy iteration."""
    tiny = jnp.finfo(at.value.dtype).tiny

    def error(at: _Point) -> jax.Array:
        swept = factor * at.image
        size = jnp.maximum(jnp.maximum(jnp.abs(swept), jnp.abs(at.value)), tiny)
        return jnp.max(jnp.where(problem.open, jnp.abs(swept - at.value) / size, 0))

    def body(carry: _Progress) -> _Progress:
        at, n, _, best, rest = carry
        value, m = _improved(problem, factor, at)
        new = _backup(problem, value)
        found = error(new)
        waits = rest + jnp.where(jnp.all(new.action == at.action), _SAME, 1)
        halved = found < best / 2  # false for NaN
        return (
            new,
            n + m + 1,
            found,
            jnp.where(halved, found, best),
            jnp.where(halved, 0, waits).astype(jnp.int32),
        )

    def goes_on(carry: _Progress) -> jax.Array:
        _, n, found, _, rest = carry
        return ~(found <= goal) & (rest < _REST) & (n < _MOST_STEPS)

    first = error(at)
    start = (at, num_steps, first, jnp.where(jnp.isfinite(first), first, jnp.inf), jnp.int32(0))
    return lax.while_loop(goes_on, body, start)[:2]


# --- the enclosure ----------------------------------------------------------------------------


class _Search(NamedTuple):
    """State of the search for bounds; pairs are lower and upper."""

    at: _Point  # the current point
    share: jax.Array  # e
    bounds: tuple[jax.Array, jax.Array]  # the proven bounds
    shares: tuple[jax.Array, jax.Array]  # the e of each proven bound, else infinity
    safe: _Point  # the point with a policy that attains the bound on the safe side
    tries: jax.Array  # tries, num_steps: numbers of trials, and of applications of P
    num_steps: jax.Array
    ended: jax.Array  # whether other shares would not help


def _width(problem: _Problem, bounds: tuple[jax.Array, jax.Array]) -> jax.Array:
    """The largest relative width."""
    lower, upper = bounds
    each = jnp.where(jnp.isfinite(upper), (upper - lower) / upper, jnp.inf)
    return jnp.max(jnp.where(problem.open, each, 0))


def _tried(problem: _Problem, unit: jax.Array, tolerance: jax.Array, k: _Search) -> _Search:
    """One trial: solves for one of the bounds, checks it, and updates the share."""
    above = k.tries % 2 == 1
    factor = 1 + jnp.where(above, k.share, -k.share)
    at, n = _solved(problem, factor, k.share / 4, k.at, k.num_steps)
    # Images are constant in a collapsed end component.
    offered = jnp.where(problem.open, jnp.maximum(factor * at.image, 0), 0)
    at = _backup(problem, offered)
    # Sums of nonnegative terms have a relative error, and an absolute one by underflow.
    least = underflow(problem.model)
    most, fewest = at.image * (1 + unit) + least, at.image * (1 - unit) - least
    holds = jnp.where(above, most <= offered, fewest >= offered)
    proven = jnp.all(jnp.where(problem.open, holds & jnp.isfinite(offered), True))

    def kept(new: Tree, old: Tree, where: jax.Array) -> Tree:
        return jax.tree.map(lambda x, y: jnp.where(where, x, y), new, old)

    below = proven & ~above & (k.share <= k.shares[0])
    over = proven & above & (k.share <= k.shares[1])
    bounds = kept(offered, k.bounds[0], below), kept(offered, k.bounds[1], over)
    shares = kept(k.share, k.shares[0], below), kept(k.share, k.shares[1], over)
    safe = kept(at, k.safe, below if problem.sign > 0 else over)
    below_known, above_known = (x <= k.share for x in shares)
    narrower = jnp.clip(tolerance / (2 * _width(problem, bounds)), 1e-3, 0.5)
    floor = _ROUNDINGS * unit
    change = jnp.where(below_known, jnp.where(above_known, narrower, 1 / 32), 16)
    share = jnp.where(above, jnp.maximum(k.share * change, floor), k.share)
    ended = above & ((below_known & (k.share <= floor)) | (share > _LARGEST))
    return _Search(at, share, bounds, shares, safe, k.tries + 1, n, ended)


def _solution(problem: _Problem, tolerance: jax.Array) -> Found:
    zero = jnp.zeros(problem.open.shape, problem.reward.dtype)
    weight = problem.start if problem.policy is None else problem.policy
    gain = jnp.where(problem.open, action_mean(weight, problem.reward), 0)
    start = _Point(zero, gain, problem.start, _numbers(zero.shape))
    unit = jnp.asarray(rounding_unit(problem.model), zero.dtype)
    never = jnp.asarray(jnp.inf, zero.dtype)
    k = _Search(
        start,
        jnp.sqrt(jnp.maximum(tolerance, 0) * _ROUNDINGS * unit),
        (zero, jnp.where(problem.open, jnp.inf, zero)),
        (never, never),
        start,
        jnp.int32(0),
        jnp.int32(0),
        jnp.bool_(False),
    )
    k = lax.while_loop(
        lambda k: (_width(problem, k.bounds) > tolerance) & (k.tries < 2 * _ATTEMPTS) & ~k.ended,
        partial(_tried, problem, unit, tolerance),
        k,
    )
    policy, decides = _policy(problem, k.safe)
    lower, upper = k.bounds
    if problem.sign < 0:
        # The bound holds for a policy that leaves the open states almost surely.
        upper = jnp.where(problem.open & ~decides, jnp.inf, upper)
    both = jnp.isfinite(upper)
    value = jnp.where(both, (lower + upper) / 2, jnp.maximum(k.at.image, lower))
    mine = _backup(problem, value)
    residual = jnp.max(jnp.where(problem.open, jnp.abs(mine.image - value), 0))
    narrow = _width(problem, (lower, upper)) <= tolerance
    status = status_code(narrow, jnp.isfinite(residual), jnp.all(both) & k.ended)
    return Found(
        value,
        lower,
        upper,
        policy,
        k.safe.leaves,
        problem.open,
        problem.finite,
        residual,
        k.num_steps,
        status,
    )


def _policy(problem: _Problem, safe: _Point) -> tuple[jax.Array, jax.Array]:
    """A point's policy in all states, and whether it leaves the open states almost surely."""
    graph = TracedGraph(problem.model)
    action, always = safe.action, jnp.bool_(True)
    if problem.circles is not None:
        inside = problem.circles.inside
        circling, _ = graph.first(inside)
        exits = circling & (safe.leaves == _numbers(circling.shape))
        towards = lax.cond(
            jnp.any(circling), lambda: attract(graph, exits, inside).action, lambda: action
        )
        action = jnp.where(circling & ~exits, towards, action)
    if problem.sign < 0:
        taken = jax.nn.one_hot(action, problem.model.num_actions, dtype=problem.reward.dtype)
        goal = problem.finite & ~problem.open
        always = jnp.all(policy_sets(graph, goal, taken).one | ~problem.open)
    return jnp.where(problem.open, action, problem.decided), always
