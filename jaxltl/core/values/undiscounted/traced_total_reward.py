"""Expected total rewards inside ``jit`` and over a mesh.

The graph decides where the value is infinite or 0. Elsewhere it is the fixed point of
``T x = opt_a (r(s, a) + (P x)(s, a))``, enclosed between the solutions of ``l = (1 - e) T l`` and
``u = (1 + e) T u`` for a small e, which is found by trial: one application of T proves
``l <= T l`` and ``u >= T u``, because e exceeds the rounding of a backup. Values and backups are in
double words (:mod:`~jaxltl.core.models.ops.double_word`), so that e is about 1e-11 in single
precision, and the width of the enclosure 1e-11 times the number of steps.

- ``u >= T u`` and ``u >= 0`` bound a maximum, which is the least such u. For a minimum
  ``u >= T_pi u`` bounds the value of pi if pi reaches the target almost surely, by its graph.
- ``l <= T l`` bounds the value of every policy that reaches the target almost surely, since
  ``P^n l -> 0`` (Bertsekas and Tsitsiklis 1991). A maximum is finite only where all policies do.
- A minimum with end components of zero reward has several fixed points. Their states are collapsed:
  they share the best choice that leaves the end component.

The equations are solved by inexact policy iteration (Newton's method): in each step the linear
system of the greedy policy is solved to the relative residual 1e-2 (the forcing term) by BiCGSTAB,
and by elimination for small models on one device; further steps under the same policy are those of
iterative refinement. The system is scaled by the value, so that small values get as many digits as
large ones. Optimal reachability probabilities are total rewards of entering the target.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax

from jaxltl.core.models.ops.array_namespace import jit
from jaxltl.core.graphs.attractor import attract, avoid, policy_sets, surely
from jaxltl.core.graphs.graph import TracedGraph, state_numbers
from jaxltl.core.graphs.end_components import EndComponents, components_within
from jaxltl.core.models.ops import double_word as dw
from jaxltl.core.models.ops.operators import (
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
from jaxltl.core.values.engine.certificates import refuse
from jaxltl.core.values.engine.implicit_diff import ChainSystem, implicit
from jaxltl.core.values.engine.iterate import sequential_vmap
from jaxltl.core.values.engine.linear import (
    System,
    bicgstab,
    inverse,
    is_small,
    most_products,
    norm,
    random_shadow,
)

_FORCING = 1e-2  # relative residual of a linear system
_POOR = 0.5  # relative residual from which a solution is not used
_SWEEPS = 128  # under the greedy policy, if its system is not solved
_ATTEMPTS = 8  # number of shares e
_ROUNDINGS = 3  # the smallest e, in rounding errors of a backup
_REST = 400  # steps of policy iteration in which the error must halve
_SAME = 80  # steps for which one counts that does not change the policy
_LARGEST = 0.1  # the largest share e
_MAX_STEPS = 1_000_000


class TotalRewardProblem(NamedTuple):
    """Residual problem after qualitative preprocessing."""

    rows: dw.DoubleWordRows  # of the model, and of the policy to evaluate if there is one
    sign: int  # 1 for a maximum, -1 for a minimum; static
    reward: jax.Array  # ``[S, A]``, in double words
    policy: jax.Array | None  # ``float[S, A]``, the policy as given, or None
    undecided: jax.Array  # ``bool[S]``, where the value is finite and not 0
    finite: jax.Array  # ``bool[S]``
    # ``bool[S, A]``, the actions to choose from; in collapsed end components those that leave
    allowed: jax.Array
    # ``int32[S]``, actions that leave the undecided states almost surely; None if all do
    start: jax.Array | None
    decided: jax.Array  # ``int32[S]``, actions for the other states
    circles: EndComponents | None  # the end components that are collapsed
    highest: float = float("inf")  # static: a bound on the value; finite ones make widths absolute

    @property
    def model(self) -> ActionModel:
        return self.rows.model


class _BellmanImage(NamedTuple):
    """A value, its image under T, the action, and in an end component the state that takes it."""

    value: jax.Array  # value, image: in double words
    image: jax.Array
    action: jax.Array
    leaves: jax.Array


# The inverse of the system of a policy, empty for large models; its actions; where it leaves.
_Inverse = tuple[jax.Array, jax.Array, jax.Array]
# The image of a point, in double words, and the relative and the absolute error of a solution.
_Equation = tuple[Callable[[_BellmanImage], jax.Array], jax.Array, jax.Array]
_Progress = tuple[_BellmanImage, _Inverse, jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]
Tree = TypeVar("Tree")


@jit("objective")
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
    enclosure, finite = sequential_vmap(
        partial(_enclosed, objective=objective), model, reward, target, weight, tolerance
    )
    chosen = enclosure.policy if weight is None else weight
    # Where the value is finite, the target is reached almost surely, also where it is 0.
    chain = ChainSystem(model, chosen, finite & ~target)
    image, constant = partial(chain.image, reward=reward), lax.stop_gradient(chain)
    value, finite = implicit(image, enclosure.value, constant), finite & earns
    value, lower, upper = (
        jnp.where(finite, x, jnp.where(earns, jnp.inf, bad))
        for x, bad in ((value, jnp.nan), (enclosure.lower, -jnp.inf), (enclosure.upper, jnp.inf))
    )
    none = status_code(earns, earns, valid=is_representable(model))
    status = jnp.maximum(enclosure.status, none)
    solution = replace(
        enclosure, value=value, policy=chosen, lower=lower, upper=upper, status=status
    )
    return refuse(solution, checked)


def _enclosed(
    model: ActionModel,
    reward: jax.Array,
    target: jax.Array,
    policy: jax.Array | None,
    tolerance: jax.Array | float,
    *,
    objective: str,
) -> tuple[Solution, jax.Array]:
    """The enclosure, and where the value is finite."""
    graph, rows = TracedGraph(model), dw.normalised_rows(model, policy)
    if policy is not None:
        problem = _of_policy(graph, rows, reward, target, policy)
    else:
        problem = (_largest if objective == "max" else _smallest)(graph, rows, reward, target)
    tolerance = jnp.asarray(tolerance, model.dtype)
    return solve_problem(problem, tolerance, tolerance), problem.finite


# --- qualitative preprocessing ----------------------------------------------------------------


def _of_policy(
    graph: TracedGraph,
    rows: dw.DoubleWordRows,
    reward: jax.Array,
    target: jax.Array,
    policy: jax.Array,
) -> TotalRewardProblem:
    taken = graph.available & (policy > 0)
    finite = policy_sets(graph, target, policy).one
    first = graph.first(taken)[1]
    return TotalRewardProblem(
        rows,
        1,
        dw.double_word(reward),
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


def _largest(
    graph: TracedGraph, rows: dw.DoubleWordRows, reward: jax.Array, target: jax.Array
) -> TotalRewardProblem:
    never = jnp.asarray(avoid(graph, target))
    doomed = attract(graph, never, among=~target)
    finite = ~doomed.region
    first = graph.first(graph.available)[1]
    avoids = graph.first(graph.available & graph.forall(never))[1]
    decided = jnp.where(never, avoids, jnp.where(finite, first, doomed.action))
    undecided = _earning(graph, reward, target, graph.available) & finite
    gain = dw.double_word(reward)
    return TotalRewardProblem(
        rows, 1, gain, None, undecided, finite, graph.available, None, decided, None
    )


def _smallest(
    graph: TracedGraph, rows: dw.DoubleWordRows, reward: jax.Array, target: jax.Array
) -> TotalRewardProblem:
    sure = surely(graph, target)
    finite = sure.region
    allowed = graph.available & graph.forall(finite) & graph.on_choices(finite & ~target)
    # The value is 0 where the target is reached almost surely without reward.
    free = allowed & ~_positive(reward)
    nothing = surely(graph, target, free)
    undecided = finite & ~nothing.region
    circles = components_within(graph, undecided, free)
    return TotalRewardProblem(
        rows,
        -1,
        dw.double_word(reward),
        None,
        undecided,
        finite,
        allowed & ~circles.inside,
        sure.action,
        nothing.action,
        circles,
    )


# --- the operator -----------------------------------------------------------------------------


def _backup(problem: TotalRewardProblem, value: jax.Array) -> _BellmanImage:
    """A value's image under T, 0 outside of the undecided states."""
    ahead = problem.rows.expectation(value)
    return _chosen(problem, value, dw.plus(problem.reward, ahead))


def _chosen(problem: TotalRewardProblem, value: jax.Array, ahead: jax.Array) -> _BellmanImage:
    """The image of a value from those of its choices."""
    leaves = state_numbers(value.shape)
    if problem.policy is not None:
        image, action = problem.rows.mean(ahead), problem.decided
    else:
        image, action = dw.best(ahead if problem.sign > 0 else -ahead, problem.allowed)
    if problem.circles is not None:
        image, leaves = lax.cond(
            jnp.any(problem.circles.inside),
            partial(_greatest, problem.circles.component),
            lambda image: (image, leaves),
            image,
        )
    image = jnp.where(problem.undecided, image, 0)
    return _BellmanImage(value, image if problem.sign > 0 else -image, action, leaves)


def _greatest(component: jax.Array, image: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The maximum over each state's end component, and the first state that attains it."""
    label, flat = component.ravel(), image.ravel()

    def top(x: jax.Array) -> jax.Array:
        return x >= jax.ops.segment_max(x, label, num_segments=flat.size)[label]

    high, low = dw.words(flat)
    first = top(high) & top(jnp.where(top(high), low, -jnp.inf))
    mine = jnp.where(first, state_numbers(flat.shape), flat.size - 1)
    leaves = jax.ops.segment_min(mine, label, num_segments=flat.size)[label]
    return flat[leaves].reshape(image.shape), leaves.reshape(image.shape)


def _where_it_leaves(problem: TotalRewardProblem, at: _BellmanImage, x: jax.Array) -> jax.Array:
    if problem.circles is None:
        return x
    result: jax.Array = lax.cond(
        jnp.any(problem.circles.inside), lambda x: x.ravel()[at.leaves], lambda x: x, x
    )
    return result


def _onward(problem: TotalRewardProblem, at: _BellmanImage) -> Callable[[jax.Array], jax.Array]:
    """``x -> P_pi x`` for the policy that attains an image, 0 outside of the undecided states."""
    model = problem.model
    if problem.policy is None and not isinstance(model, Product):
        along = policy_operator(model, at.action)
    else:
        weight = at.action if problem.policy is None else problem.policy

        def along(x: jax.Array) -> jax.Array:
            return action_mean(weight, expectation(model, x))

    return lambda x: jnp.where(problem.undecided, _where_it_leaves(problem, at, along(x)), 0)


def _inverse(problem: TotalRewardProblem, at: _BellmanImage, known: _Inverse) -> _Inverse:
    """The inverse of the system of the policy that attains an image, unless it is known."""
    model, weight = problem.model, problem.policy
    table, size = sweep_operator(model), problem.undecided.size
    if not is_small(table, size):
        return known
    if weight is None:
        weight = jax.nn.one_hot(at.action, model.num_actions, dtype=model.dtype)

    def inverted() -> jax.Array:
        columns = action_columns(model.num_actions, weight)
        system = System(table, columns, problem.undecided.ravel().astype(model.dtype))
        eye = jnp.eye(size, dtype=model.dtype)
        return inverse(eye - (eye - system.matrix())[at.leaves.ravel()])

    same = jnp.all((at.action == known[1]) & (at.leaves == known[2]))
    return lax.cond(same, lambda: known[0], inverted), at.action, at.leaves


def _improved(
    problem: TotalRewardProblem, change: jax.Array, at: _BellmanImage, known: _Inverse
) -> tuple[jax.Array, jax.Array]:
    """A step of policy iteration, and its number of applications of P."""
    # If the linear system is not solved, sweeps under its policy.
    onward, size = _onward(problem, at), jnp.abs(dw.words(at.value)[0])
    scale = jnp.where(problem.undecided & (size > 0), size, 1)
    wanted = change / scale

    def matvec(x: jax.Array) -> jax.Array:
        return x - onward(scale * x) / scale

    if known[0].size:
        x, n = (known[0] @ change.ravel()).reshape(change.shape) / scale, jnp.int32(0)
    else:
        right = wanted.ravel()
        inner, n = bicgstab(
            lambda x: matvec(x.reshape(wanted.shape)).ravel(),
            right,
            tolerance=_FORCING * norm(right),
            max_steps=most_products(right.size),
            shadow=random_shadow(right),
        )
        x = inner.x.reshape(wanted.shape)
    residual = norm((wanted - matvec(x)).ravel())
    solved = residual <= _POOR * norm(wanted.ravel())  # false for NaN
    x = lax.cond(
        solved,
        lambda: x,
        lambda: lax.fori_loop(1, _SWEEPS, lambda _, x: x + (wanted - matvec(x)), wanted),
    )
    return dw.plus(at.value, dw.double_word(scale * x)), n + jnp.where(solved, 1, _SWEEPS)


def _solved(
    problem: TotalRewardProblem,
    equation: _Equation,
    start: _BellmanImage,
    known: _Inverse,
    num_steps: jax.Array,
) -> tuple[_BellmanImage, _Inverse, jax.Array]:
    """An approximate solution of ``v = image(v)`` by policy iteration, and its backup."""
    # One backup in the program serves the steps and the solution, which is an image.
    image, goal, slack = equation

    def body(carry: _Progress) -> _Progress:
        at, known, n, best, rest, wait, _ = carry
        begun = n >= 0
        swept = image(at)
        change = dw.minus(swept, at.value)
        size = jnp.maximum(*(jnp.abs(dw.words(x)[0]) for x in (swept, at.value)))
        excess = jnp.maximum(jnp.abs(change) - slack, 0)
        error = jnp.max(excess / jnp.maximum(size, jnp.finfo(size.dtype).tiny))
        halved = begun & (error < best / 2)  # false for NaN
        best, rest = jnp.where(halved, error, best), jnp.where(halved, 0, rest + wait)
        goes_on = ~(error <= goal) & (rest < _REST) & (n < _MAX_STEPS)

        def improved() -> tuple[jax.Array, _Inverse, jax.Array]:
            own = _inverse(problem, at, known)
            value, m = _improved(problem, change, at, own)
            return value, own, n + m + 1

        def offered() -> tuple[jax.Array, _Inverse, jax.Array]:
            # Images are constant in a collapsed end component.
            return jnp.where(dw.words(swept)[0] > 0, swept, 0), known, jnp.maximum(n, 0)

        value, known, after = lax.cond(begun & goes_on, improved, offered)
        new = _backup(problem, value)
        wait = jnp.where(jnp.all(new.action == at.action), _SAME, 1).astype(jnp.int32)
        return new, known, after, best, rest, wait, begun & ~goes_on

    none, never = jnp.int32(0), jnp.asarray(jnp.inf, goal.dtype)
    first = (start, known, num_steps, never, none, none, none > 0)
    return lax.while_loop(lambda carry: ~carry[-1], body, first)[:3]


# --- the enclosure ----------------------------------------------------------------------------


class _BoundSearch(NamedTuple):
    """State of the search for bounds; pairs are lower and upper."""

    at: _BellmanImage  # the current point
    known: _Inverse
    share: jax.Array  # e
    bounds: tuple[jax.Array, jax.Array]  # the proven bounds, in double words
    shares: tuple[jax.Array, jax.Array]  # the e of each proven bound, else infinity
    gap: jax.Array  # their distance, infinite without an upper one
    safe: _BellmanImage  # the point with a policy that attains the bound on the safe side
    residual: jax.Array  # of that point
    tries: jax.Array  # number of trials
    num_steps: jax.Array  # number of applications of P; -1 before the first backup
    ended: jax.Array  # whether other shares would not help


def _width(problem: TotalRewardProblem, gap: jax.Array, upper: jax.Array) -> jax.Array:
    """The largest width, relative unless the value has a bound."""
    scale = upper if math.isinf(problem.highest) else 1
    each = jnp.where(jnp.isfinite(upper), gap / scale, jnp.inf)
    return jnp.max(jnp.where(problem.undecided, each, 0))


def _wide(problem: TotalRewardProblem, k: _BoundSearch) -> jax.Array:
    return _width(problem, k.gap, dw.words(k.bounds[1])[0])


def _tried(problem: TotalRewardProblem, tolerance: jax.Array, k: _BoundSearch) -> _BoundSearch:
    """One trial: solves for one of the bounds, checks it, and updates the share."""
    rows, above = problem.rows, (k.tries & 1) == 1
    sign = jnp.where(above, 1, -1).astype(k.share.dtype)
    size = jnp.max(jnp.abs(dw.words(k.at.image)[0]))
    # The shift exceeds the loss where words are flushed to zero.
    shift, factor = 8 * rows.underflow(size), dw.double_word(jnp.ones_like(sign), sign * k.share)

    def image(at: _BellmanImage) -> jax.Array:
        swept = dw.plus(dw.product(factor, at.image), dw.double_word(sign * shift))
        return jnp.where(problem.undecided, swept, 0)

    equation = image, k.share / 4, shift / 4
    at, known, n = _solved(problem, equation, k.at, k.known, k.num_steps)
    offered, value = at.value, dw.words(at.value)[0]
    slack = rows.unit * value + rows.underflow(jnp.max(value))
    gain = dw.minus(at.image, offered)
    holds = jnp.where(above, -gain >= slack, (gain >= slack) | (value == 0))
    proven = jnp.all(jnp.where(problem.undecided, holds & jnp.isfinite(value), True))

    def select(new: Tree, old: Tree, where: jax.Array) -> Tree:
        result: Tree = jax.tree.map(lambda x, y: jnp.where(where, x, y), new, old)
        return result

    below = proven & ~above & (k.share <= k.shares[0])
    over = proven & above & (k.share <= k.shares[1])
    bounds = select(offered, k.bounds[0], below), select(offered, k.bounds[1], over)
    shares = select(k.share, k.shares[0], below), select(k.share, k.shares[1], over)
    safer = (below if problem.sign > 0 else over) | (k.num_steps < 0)
    safe, residual = select((at, jnp.max(jnp.abs(gain))), (k.safe, k.residual), safer)
    high = dw.words(bounds[1])[0]
    gap = jnp.where(jnp.isfinite(high), dw.minus(bounds[1], bounds[0]), jnp.inf)
    below_known, above_known = (x <= k.share for x in shares)
    narrower = jnp.clip(tolerance / (2 * _width(problem, gap, high)), 1e-3, 0.5)
    floor = _ROUNDINGS * rows.unit
    # A small share without an upper bound is too small for the precision of the solution.
    fewer = jnp.where(k.share < jnp.finfo(value.dtype).eps, 16, 1 / 32)
    change = jnp.where(below_known, jnp.where(above_known, narrower, fewer), 16)
    share = jnp.where(above, jnp.maximum(k.share * change, floor), k.share)
    ended = above & ((below_known & above_known & (k.share <= floor)) | (share > _LARGEST))
    steps = k.tries + 1, n, ended
    return _BoundSearch(at, known, share, bounds, shares, gap, safe, residual, *steps)


def solve_problem(
    problem: TotalRewardProblem, tolerance: jax.Array, requested: jax.Array
) -> Solution:
    """The enclosure of a problem, of width `tolerance` if possible; converged if `requested`.

    Values are 0 where they are infinite.
    """
    rows, model = problem.rows, problem.model
    dtype, eps = model.dtype, float(jnp.finfo(model.dtype).eps)
    zero = dw.double_word(jnp.zeros(problem.undecided.shape, dtype))
    numbers, none = state_numbers(zero.shape), jnp.int32(0)
    # Where every policy leaves the undecided states, the first one is greedy for zero.
    start, num_steps = _BellmanImage(zero, zero, problem.decided, numbers), none - 1
    if problem.start is not None:
        gain = jnp.where(problem.undecided, action_mean(problem.start, problem.reward), 0)
        start, num_steps = _BellmanImage(zero, gain, problem.start, numbers), none
    size = zero.size if is_small(sweep_operator(model), zero.size) else 0
    no_inverse = jnp.zeros((size, size), dtype), jnp.full_like(numbers, -1), numbers
    never = jnp.asarray(jnp.inf, dtype)
    highest = jnp.where(problem.undecided, problem.highest, 0).astype(dtype)
    # Rounding both ends to the dtype takes a little of the width.
    inner = jnp.maximum(tolerance - 2 * eps, tolerance / 2)
    share = jnp.maximum(2 * _ROUNDINGS * rows.unit, 1e-6 * tolerance).astype(dtype)
    residual = jnp.max(jnp.abs(dw.words(start.image)[0]))
    k = _BoundSearch(
        start,
        no_inverse,
        share,
        (zero, highest.astype(zero.dtype)),
        (never, never),
        highest,
        start,
        residual,
        none,
        num_steps,
        none > 0,
    )
    k = lax.while_loop(
        lambda k: (_wide(problem, k) > inner) & (k.tries < 2 * _ATTEMPTS) & ~k.ended,
        partial(_tried, problem, inner),
        k,
    )
    policy, decides = _policy(problem, k.safe)
    lower, upper = dw.outwards(k.bounds[0], -1), dw.outwards(k.bounds[1], 1)
    lower = jnp.maximum(lower, 0)
    upper = jnp.where(problem.undecided, jnp.maximum(upper, jnp.finfo(dtype).tiny), upper)
    upper = jnp.minimum(upper, problem.highest)
    if problem.sign < 0:
        # The bound holds for a policy that leaves the undecided states almost surely.
        upper = jnp.where(problem.undecided & ~decides, problem.highest, upper)
    both = jnp.isfinite(upper)
    middle = dw.words(k.bounds[0])[0] + k.gap / 2
    value = jnp.where(both, middle, jnp.maximum(dw.words(k.at.image)[0], lower))
    value = jnp.clip(value, lower, upper)
    narrow = _width(problem, upper - lower, upper) <= requested
    exhausted = k.ended | (_wide(problem, k) <= inner)
    status = status_code(narrow, jnp.all(jnp.isfinite(value)), jnp.all(both) & exhausted)
    num_steps = jnp.maximum(k.num_steps, 0)
    return Solution(value, policy, lower, upper, k.residual, num_steps, status)


def _policy(problem: TotalRewardProblem, safe: _BellmanImage) -> tuple[jax.Array, jax.Array]:
    """A point's policy in all states, and whether it leaves the undecided states almost surely."""
    graph = TracedGraph(problem.model)
    action, always = safe.action, jnp.bool_(True)
    if problem.circles is not None:
        inside = problem.circles.inside
        circling, _ = graph.first(inside)
        exits = circling & (safe.leaves == state_numbers(circling.shape))
        towards = lax.cond(
            jnp.any(circling), lambda: attract(graph, exits, inside).action, lambda: action
        )
        action = jnp.where(circling & ~exits, towards, action)
    if problem.sign < 0:
        taken = jax.nn.one_hot(action, problem.model.num_actions, dtype=problem.reward.dtype)
        goal = problem.finite & ~problem.undecided
        always = jnp.all(policy_sets(graph, goal, taken).one | ~problem.undecided)
    return jnp.where(problem.undecided, action, problem.decided), always
