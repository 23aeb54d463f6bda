"""Probabilities of reaching a set and of satisfying a formula, with certified bounds.

Where a probability is exactly 0 or exactly 1 is decided on the graph. In between, a fixed
policy is a linear system, certified by its residual, and an optimum is enclosed by
interval iteration with end components collapsed. No bound rests on a small change.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxltl.core.values.engine.validated import validated
from jaxltl.core.graphs.attractor import attract, surely
from jaxltl.core.graphs.end_components import EndComponents, components_within
from jaxltl.core.graphs.graph import Graph, TracedGraph, graph_of, is_table, take
from jaxltl.core.graphs.reaching import Sets, max_sets, min_sets, policy_sets
from jaxltl.core.models.game import Game
from jaxltl.core.models.interval import IntervalMDP
from jaxltl.core.models.mdp import MDP, DenseMDP, support
from jaxltl.core.models.mesh.sharded import is_sharded
from jaxltl.core.models.ops.array_namespace import is_traced, to_jax
from jaxltl.core.models.ops.operators import (
    action_argmax,
    action_mean,
    expectation,
    policy_operator,
    is_deterministic,
    require_policy,
    valid_policy,
)
from jaxltl.core.models.ops.successor_tables import action_columns, sweep_operator
from jaxltl.core.models.product import Product
from jaxltl.core.sparse.solvers import dense_reachability as host
from jaxltl.core.sparse.solvers.layered_reachability import PaddedProduct, layered_reachability
from jaxltl.core.sparse.solvers.shortest_path import quickest
from jaxltl.core.types import Solution, Status, require_shape, status_code
from jaxltl.core.values.engine.certificates import m_matrix_error, refuse, rounding_unit
from jaxltl.core.values.engine.host_solution import is_sparse, reachability
from jaxltl.core.values.engine.implicit_diff import implicit
from jaxltl.core.values.engine.iterate import in_turn, iterate
from jaxltl.core.values.engine.linear import Inverse, System, solver
from jaxltl.core.values.interval.robust import refuse_nature, robust_reachability

_POLICY_SWEEPS = 8  # sweeps under the greedy policy for one of the optimality operator
_FINER = 8  # how much nearer a guess is, once the bounds are near
_FAR_SWEEPS = 6  # sweeps of a guess, or of interval iteration after one that failed
_HOST_LIMIT = 4096  # states up to which a concrete model is solved on the host, by elimination
QUICK_LIMIT = 100_000  # states of a concrete model up to which its quickest policy is looked for
_FILLED = 2048  # of these undecided, as elimination may fill a matrix of so many rows


@validated()
def reachability_probability(
    model: Any,
    target: jax.Array,
    *,
    stay: jax.Array | None = None,
    policy: jax.Array | None = None,
    objective: str = "max",
    nature: str | None = None,
    method: str = "auto",
    tolerance: jax.Array | float | None = None,
    max_steps: jax.Array | int = 1_000_000,
    start: tuple[jax.Array, jax.Array] | None = None,
) -> Solution:
    """Probability of ever reaching a set of states.

    The least solution of ``y = 1`` on the target, ``y = sum_a pi(s, a) (P y)(s, a)``
    elsewhere (2.5); for optima with a maximum or minimum over available actions
    (Baier and Katoen 2008, section 10.6). Small concrete models are solved on the host by
    elimination and policy iteration, and nothing is compiled. Other optima: interval iteration
    (Haddad and Monmege 2018) with maximal end components collapsed and each bound rounded
    outwards. Sparse models are solved by :mod:`jaxltl.core.sparse.solvers.reachability`, large products whose
    worlds mix by :mod:`jaxltl.core.sparse.solvers.layered_reachability`.

    Args:
      model: the model.
      target: ``bool[S]``.
      stay: ``bool[S]``, the states that may be passed before (until); default all. Concrete.
      policy: ``float[S, A]`` or ``int32[S]``: evaluate this policy. Default: optimise. Of a sparse
        model ``float[R]``, or rows ``int32[S]``.
      objective: ``"max"`` or ``"min"``; ignored when a policy is given.
      nature: of interval models only, see
        :func:`~jaxltl.core.values.interval.robust.robust_reachability`, which answers then.
      method: for a given policy: ``"direct"`` (elimination, however slowly the policy
        makes progress), ``"iterative"`` (Krylov), or ``"auto"``, direct for small models.
      tolerance: half the width of the enclosure asked for. Default: the square root of the
        dtype's precision must be met, and an optimum is then enclosed as closely as the dtype
        allows, until a round of sweeps gains less than rounding takes. Of a sparse model, or with
        `stay`: the whole width, 1e-6 by default (1e-3 in single precision).
      max_steps: sweeps at most.
      start: bounds of the optimum from below and above to go on from, such as those of a solution
        that ended after `max_steps`; used where bounds are found by sweeps. They are believed.

    Returns:
      :class:`Solution`; `value` is ``float[S]``, exactly 0 or 1 where the graph says so. An
      optimum's `policy` is ``int32[S]`` and attains its bound on the safe side
      (`lower` for a maximum, `upper` for a minimum). Of the policies that do it is the
      quickest, on a concrete model, see
      :func:`~jaxltl.core.values.undiscounted.satisfaction.optimal_satisfaction`.

    Raises:
      ValueError: a shape is wrong, or the objective or method is unknown.

    Differentiable in the policy and in the probabilities, with the support held fixed.

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0.5, 0.25, 0.25]], [[0, 1.0, 0]], [[0, 0, 1.0]]])
      >>> round(reachability_probability(mdp, jnp.array([False, True, False])).value[0].item(), 3)
      0.5
    """
    if method not in ("auto", "direct", "iterative"):
        raise ValueError(f"method={method!r}; choose auto, direct or iterative.")
    if objective not in ("max", "min"):
        raise ValueError(f'objective={objective!r}; it must be "max" or "min".')
    if isinstance(model, IntervalMDP):
        return robust_reachability(
            model,
            target,
            policy=policy,
            objective=objective,
            nature=nature,
            stay=stay,
            tolerance=tolerance,
        )
    refuse_nature(nature)
    require_shape("target", target, model.state_shape)
    if is_sparse(model) or stay is not None:
        return reachability(
            model, target, stay=stay, policy=policy, objective=objective, tolerance=tolerance
        )
    traced = is_traced((model, target, policy, tolerance, max_steps, start))
    traced |= is_sharded(model)
    readable = not traced and is_table(model)
    small = readable and math.prod(model.state_shape) <= _HOST_LIMIT
    if policy is not None:
        require_policy(model, policy)
        found = None
        if small and method != "iterative":
            found = _policy_on_host(model, target, policy, tolerance)
        if found is None:
            found = _evaluate(model, target, policy, tolerance, max_steps, method=method)
        return found
    if traced:
        return _inside_jit(model, target, tolerance, max_steps, start, objective=objective)
    found = _by_layers(model, target, tolerance, objective)
    if found is not None:
        return found
    graph = graph_of(model)
    sets, components = _decided(model, np.asarray(target), objective=objective)
    if components is not None and not components.inside.any():
        components = None
    found, ties = None, False
    if small:
        found, ties = _optimum_on_host(model, graph, sets, components, tolerance, objective)
    if found is None:
        arguments = to_jax((sets, components))
        found = _optimize(model, *arguments, tolerance, max_steps, start, objective=objective)
    if not readable:
        return found
    decided = sets.zero | (np.asarray(target) if objective == "max" else sets.one)
    action = np.asarray(found.policy)
    good = _attaining(graph, sets, components, action, ties, objective)
    return replace(found, policy=to_jax(_quickest(model, graph, good, decided, action)))


@partial(jax.jit, static_argnames=("objective",))
def _inside_jit(model, target, tolerance, max_steps, start, *, objective) -> Solution:
    sets, components = in_turn(partial(_decided, objective=objective), model, target)
    return _optimize(model, sets, components, tolerance, max_steps, start, objective=objective)


def _decided(model: Any, target: Any, *, objective: str) -> tuple[Sets, EndComponents | None]:
    """What the graph decides of an optimum, and the end components in what is left."""
    graph = graph_of(model, target)
    target = take(graph, target)
    if objective == "min":
        return min_sets(graph, target), None
    sets = max_sets(graph, target)
    return sets, components_within(graph, ~(sets.one | sets.zero))


# --- small concrete models: the host ---------------------------------------------------------


def action_matrices(model: Any) -> list[Any]:
    """The transitions of a concrete model, a matrix for each action."""
    model = model.mdp if isinstance(model, Game) else model
    world: Any = model.mdp if isinstance(model, Product) else model
    dense = isinstance(world, DenseMDP)
    weight = np.where(
        support(world), np.asarray(world.transition if dense else world.probability), 0
    )
    memory = np.zeros((world.num_states, 1), np.int32)
    if world is not model:
        memory = np.asarray(model.next_memory)
    on_entry = getattr(model, "label_on", "entry") == "entry"
    return host.transition_rows(
        None if dense else np.asarray(world.successor), weight, memory, on_entry
    )


def _unit(model: Any) -> float:
    """Rounding of a backup in double precision."""
    terms = model.num_successors + model.num_actions + 4
    return terms * float(np.finfo(np.float64).eps)


def _host_solution(model: Any, found: host.Bounds, policy: Any, tolerance: Any) -> Solution | None:
    """The bounds in the model's precision, rounded outwards; None if wider than asked."""
    dtype, shape = np.dtype(model.dtype), model.state_shape
    exact = found.lower == found.upper
    low, high = (
        np.where(exact, x, np.nextafter(x.astype(dtype), end)).clip(0, 1).astype(dtype)
        for x, end in ((found.lower, dtype.type(-1)), (found.upper, dtype.type(2)))
    )
    goal = np.sqrt(np.finfo(dtype).eps) if tolerance is None else float(tolerance)
    if not (high - low <= 2 * goal).all():
        return None
    value = found.value.astype(dtype).clip(low, high)
    arrays = (
        value.reshape(shape),
        policy,
        low.reshape(shape),
        high.reshape(shape),
        np.asarray(found.residual, dtype),
        np.int32(found.rounds),
        np.int32(Status.CONVERGED),
    )
    return Solution(*to_jax(arrays))


def _by_layers(model: Any, target: Any, tolerance: Any, objective: str) -> Solution | None:
    """Of a large product, one part of the automaton after the other; None where that is no help."""
    world = model.mdp if isinstance(model, Product) else None
    if not isinstance(world, MDP) or model.label_on != "entry" or model.num_states <= QUICK_LIMIT:
        return None
    eps = float(np.finfo(np.dtype(model.dtype)).eps)
    width = max(4 * eps, 1e-11) if tolerance is None else 2 * float(tolerance) - 4 * eps
    beside = PaddedProduct(
        np.asarray(world.successor),
        support(world),
        np.asarray(world.probability),
        np.asarray(world.available),
        np.asarray(model.automaton.delta),
        np.asarray(model.letter),
        None if model.allowed is None else np.asarray(model.allowed),
    )
    if not width > 0:
        return None
    found = layered_reachability(
        beside, np.asarray(target), maximize=objective == "max", tolerance=width
    )
    if found is None:
        return None
    half = (found.upper - found.lower) / 2
    # The operator carries the bounds towards each other, so the value by half of what is between.
    bounds = host.Bounds(
        found.lower + half,
        found.lower,
        found.upper,
        float(half.max()),
        found.sweeps,
        found.action,
        half > 0,
    )
    return _host_solution(model, bounds, found.action, tolerance)


def _policy_on_host(model: Any, target: Any, policy: Any, tolerance: Any) -> Solution | None:
    table = np.asarray(policy)
    if is_deterministic(table):
        table = np.eye(model.num_actions, dtype=model.dtype)[table]
    graph = graph_of(model)
    sets = policy_sets(graph, np.asarray(target), table)
    one, zero = sets.one.ravel(), sets.zero.ravel()
    undecided = ~(one | zero)
    if undecided.sum() > _FILLED:
        return None
    chain = host.policy_row(action_matrices(model), table.reshape(len(one), -1).astype(float))
    found = host.of_policy(chain, one, undecided, _unit(model))
    return None if found is None else _host_solution(model, found, table, tolerance)


def _optimum_on_host(
    model: Any,
    graph: Graph,
    sets: Sets,
    components: EndComponents | None,
    tolerance: Any,
    objective: str,
) -> tuple[Solution | None, Any]:
    """The optimum, if it could be found, and the actions that tie: ``bool[S, A]``."""
    allowed, group = graph.available, np.arange(sets.one.size, dtype=np.int32)
    if components is not None:
        allowed, group = allowed & ~components.inside, np.asarray(components.component).ravel()
    undecided = ~(sets.one | sets.zero)
    if undecided.sum() > _FILLED:
        return None, False
    rows = action_matrices(model)
    found = host.optimum(
        rows,
        allowed.reshape(len(group), -1),
        group,
        sets.one.ravel(),
        undecided.ravel(),
        1 if objective == "max" else -1,
        _unit(model),
    )
    if found is None:
        return None, False
    exits, action = (x.reshape(sets.one.shape) for x in (found.exits, found.action))
    if components is not None:
        towards = attract(graph, exits, components.inside).action
        action = np.where(exits, action, towards)
    policy = np.where(undecided, action, sets.action).astype(np.int32)
    ties = _ties(model, rows, found, objective).reshape(graph.available.shape)
    return _host_solution(model, found, policy, tolerance), ties


def _ties(model: Any, rows: list[Any], found: host.Bounds, objective: str) -> Any:
    """The actions that do not lead away from the bound that is attained: ``bool[S, A]``.

    It is then a bound of whatever policy decides almost surely by them.
    """
    unit = _unit(model)
    bound = found.lower if objective == "max" else found.upper
    ahead = np.stack([row @ bound for row in rows], -1)
    if objective == "max":
        keeps = ahead * (1 - unit) >= bound[:, None]
    else:
        keeps = ahead * (1 + unit) <= bound[:, None]
    return keeps & ((bound > 0) & (bound < 1))[:, None]


def _attaining(
    graph: Graph,
    sets: Sets,
    components: EndComponents | None,
    policy: Any,
    ties: Any,
    objective: str,
) -> Any:
    """Actions by which any policy that decides almost surely attains the bound: ``bool[S, A]``."""
    undecided = ~(sets.one | sets.zero)[..., None]
    good = undecided & ((policy[..., None] == np.arange(graph.num_actions)) | ties)
    if objective == "max":
        good |= sets.one[..., None] & graph.forall(sets.one)
    if components is not None:
        good |= components.inside
    return good & graph.available


def attaining_actions(model: Any, target: Any, *, objective: str) -> tuple[Any, Solution] | None:
    """Actions by which every policy that takes them all now and then attains a bound.

    Where the probability is strictly between 0 and 1: those in end components, and those that do
    not lead away from the bound. By them a policy decides almost surely, if it can.

    Args:
      model: a concrete model.
      target: ``bool[S]``.
      objective: ``"max"`` or ``"min"``.

    Returns:
      ``bool[S, A]``, False elsewhere, and the bounds, `lower` of a maximum, `upper` of a minimum;
      None if that could not be shown on the host.
    """
    if not is_table(model) or math.prod(model.state_shape) > _HOST_LIMIT:
        return None
    graph = graph_of(model)
    sets, components = _decided(model, np.asarray(target), objective=objective)
    found, ties = _optimum_on_host(model, graph, sets, components, np.inf, objective)
    if found is None:
        return None
    if components is not None:
        ties = ties | components.inside
    decided = sets.one | sets.zero
    good = ties & ~decided[..., None] & graph.available
    return (good, found) if attract(graph, decided, good).region.all() else None


def _quickest(model: Any, graph: Graph, good: Any, decided: Any, policy: Any) -> Any:
    """The policy of some actions that decides in the least expected time.

    Where it is decided, or if that is too hard to find, it is the policy that is given.
    """
    if decided.size > QUICK_LIMIT or decided.all():
        return policy
    start = surely(graph, decided, good)
    if not start.region.all():
        return policy
    action = np.where(decided, policy, start.action)
    found = quickest(
        action_matrices(model), good.reshape(decided.size, -1), ~decided.ravel(), action.ravel()
    )
    return policy if found is None else found.reshape(decided.shape).astype(np.int32)


# --- a fixed policy: a linear system with a certificate -----------------------------------


@partial(jax.jit, static_argnames=("method",))
def _evaluate(model, target, policy, tolerance, max_steps, *, method) -> Solution:
    """Solves ``y = 1_one + (P_pi y) on the undecided states`` and encloses the answer."""
    target = jnp.asarray(target, bool)
    checked = valid_policy(model, policy)
    policy = checked.distribution
    sets = policy_sets(TracedGraph(model), target, policy)
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    weight = action_columns(model.num_actions, policy)
    system = lax.stop_gradient(
        System(sweep_operator(model), weight, undecided.ravel().astype(model.dtype))
    )
    linear = solver(system, method, max_steps=max_steps)

    def onward(y: jax.Array) -> jax.Array:
        return jnp.where(undecided, action_mean(policy, expectation(model, y)), 0)

    still = lax.stop_gradient(policy)
    value, n = lax.stop_gradient(linear.counted(one))
    value = jnp.where(undecided, value, one)
    # Elimination can break down where rounding closes what leaves a set hardly ever.
    value = jnp.clip(jnp.where(jnp.isfinite(value), value, 0), 0, 1)
    error, residual, _ = lax.stop_gradient(
        m_matrix_error(model, linear.solve, onward, value, undecided)
    )
    goal = jnp.sqrt(jnp.finfo(model.dtype).eps) if tolerance is None else tolerance
    solution = Solution(
        value=value,
        policy=still,
        lower=jnp.maximum(value - error, 0),
        upper=jnp.minimum(value + error, 1),
        residual=residual,
        num_steps=n,
        # What elimination leaves is rounding.
        status=status_code(
            jnp.max(error) <= goal, jnp.isfinite(residual), isinstance(linear, Inverse)
        ),
    )
    found = implicit(
        lambda y: one + onward(y),
        lax.stop_gradient(value),
        solve=linear.solve,
        transpose_solve=linear.transpose_solve,
    )
    solution = replace(lax.stop_gradient(solution), value=found, policy=policy)
    return refuse(solution, checked.given, checked.valid)


# --- optima: interval iteration -------------------------------------------------------------


class _Search(NamedTuple):
    """A problem of finding an optimum; `sign` times probabilities are maximised.

    Where `cheap`, sweeps under a fixed policy go through its chain over single states; a product
    gathers whole rows, which such a chain cannot.
    """

    model: Any
    undecided: jax.Array
    one: jax.Array
    components: EndComponents | None
    goal: jax.Array

    @property
    def cheap(self) -> bool:
        return self.components is None and not isinstance(self.model, Product)

    @property
    def slack(self) -> float:
        """Sums of nonnegative terms err by a relative amount, so rounded outwards bounds stay."""
        return rounding_unit(self.model)

    @property
    def leaving(self) -> jax.Array:
        available = self.model.available
        return available if self.components is None else available & ~self.components.inside

    def best(self, sign: int, y: jax.Array) -> tuple[jax.Array, jax.Array]:
        value, action = action_argmax(sign * expectation(self.model, y), self.leaving)
        return jnp.where(self.undecided, _collapse(self.components, sign * value), self.one), action

    def nearer(self, sign: int, near: jax.Array, image: jax.Array) -> jax.Array:
        return sign * jnp.maximum(sign * near, sign * image * (1 - sign * self.slack))

    def closer(self, sign: int, far: jax.Array, image: jax.Array) -> jax.Array:
        return sign * jnp.minimum(sign * far, sign * image * (1 + sign * self.slack))


class _Bounds(NamedTuple):
    near: jax.Array
    far: jax.Array
    failed: jax.Array  # whether the last guess was no bound
    moved: jax.Array
    rests: jax.Array  # whether a round gained less than rounding takes

    @property
    def half(self) -> jax.Array:
        return jnp.max(jnp.abs(self.far - self.near)) / 2


def _tighter(sign: int, finest: bool, table: None, carry: _Bounds, search: _Search) -> _Bounds:
    """One round: a sweep and some under the greedy policy for `near`, a guess or sweeps for `far`.

    A value that the operator does not carry away from the optimum is a bound, because the fixed
    point is unique where end components are collapsed; so `far` is guessed, and where the guess
    fails, plain interval iteration goes on. Where the bounds are to be the finest, this goes on
    beyond the goal: a guess is then a bound of the same shape that is `_FINER` times as near.
    """
    near, far, failed, *_ = carry
    image, action = search.best(sign, near)
    close = jnp.bool_(finest) & (carry.half <= search.goal)
    aim = jnp.where(close, carry.half / _FINER, search.goal)
    settled = jnp.max(jnp.abs(image - near)) <= aim / 32
    new_near = search.nearer(sign, near, image)
    if search.cheap:
        new_near = _followed(sign, search, new_near, action)

    def guess() -> tuple[jax.Array, jax.Array]:
        # `near` moved by almost the tolerance; some sweeps give it its shape.
        beyond = jnp.where(close, (far - new_near) / _FINER, sign * 1.8 * search.goal)
        offered = jnp.clip(new_near + beyond, 0, 1)
        offered = jnp.where(search.undecided, offered, search.one)

        def sweep(_, pair: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            return pair[1], search.best(sign, pair[1])[0] * (1 + sign * search.slack)

        before, after = lax.fori_loop(0, _FAR_SWEEPS, sweep, (offered, offered))
        proven = jnp.all(sign * after <= sign * before)
        return jnp.where(proven, search.closer(sign, far, after), far), ~proven

    def sweeps() -> tuple[jax.Array, jax.Array]:
        step = lax.fori_loop(
            0, _FAR_SWEEPS, lambda _, y: search.closer(sign, y, search.best(sign, y)[0]), far
        )
        return step, jnp.bool_(False)

    gain = jnp.max(jnp.abs(new_near - near))
    rests = close & (gain <= search.slack / 8)
    new_far, failed = lax.cond(
        settled | rests, lambda: lax.cond(failed | ~settled, sweeps, guess), lambda: (far, failed)
    )
    far_gain = jnp.max(jnp.abs(new_far - far))
    rests &= ~failed & (far_gain <= search.slack / 8)
    return _Bounds(new_near, new_far, failed, (gain > 0) | (far_gain > 0) | failed, rests)


def _followed(sign: int, search: _Search, near: jax.Array, action: jax.Array) -> jax.Array:
    onward = policy_operator(search.model, action)

    def sweep(_, y: jax.Array) -> jax.Array:
        image = onward(y.ravel()).reshape(y.shape)
        return search.nearer(sign, y, jnp.where(search.undecided, image, search.one))

    return lax.fori_loop(0, _POLICY_SWEEPS, sweep, near)


def _ended(finest: bool, carry: _Bounds, search: _Search) -> jax.Array:
    return (carry.rests if finest else carry.half <= search.goal) | ~carry.moved


@partial(jax.jit, static_argnames=("objective",))
def _optimize(model, sets: Sets, components, tolerance, max_steps, start, *, objective) -> Solution:
    """Encloses an optimum between a bound that a policy attains and one that is proven.

    The attained bound ("near") is the lower one of a maximum and the upper one of a
    minimum. Sweeps under its own greedy policy move it soundly and cheaply.
    """
    sign = 1 if objective == "max" else -1
    undecided = ~(sets.one | sets.zero)
    one = sets.one.astype(model.dtype)
    eps = jnp.finfo(model.dtype).eps
    goal = jnp.asarray(jnp.sqrt(eps) if tolerance is None else tolerance, model.dtype)
    search = _Search(model, undecided, one, components, goal)
    top = jnp.where(undecided, 1, one)
    low, high = (
        (one, top)
        if start is None
        else (jnp.where(undecided, jnp.clip(x, 0, 1), one) for x in start)
    )
    near, far = (low, high) if objective == "max" else (high, low)
    finest, no = tolerance is None, jnp.bool_(False)
    bounds, n = iterate(
        partial(_tighter, sign, finest),
        partial(_ended, finest),
        None,
        _Bounds(near, far, no, ~no, no),
        search,
        max_steps=max_steps,
    )
    near, far = bounds.near, bounds.far
    still = lax.stop_gradient(search)
    action = still.best(sign, near)[1]
    if components is not None:
        own = action_argmax(expectation(still.model, near), still.leaving)[0]
        exits = undecided & (own >= _collapse(components, own))
        towards = attract(TracedGraph(model), exits, components.inside).action
        action = jnp.where(exits, action, towards)
    lower, upper = (near, far) if objective == "max" else (far, near)
    value = (lower + upper) / 2
    residual = jnp.max(jnp.abs(still.best(sign, value)[0] - value))
    policy = jnp.where(undecided, action, sets.action)
    solution = Solution(
        value=value,
        policy=policy,
        lower=lower,
        upper=upper,
        residual=residual,
        num_steps=n,
        status=status_code(bounds.half <= goal, jnp.isfinite(residual)),
    )
    solution = jax.tree.map(lax.stop_gradient, solution)

    def follow(y: jax.Array) -> jax.Array:
        return jnp.where(undecided, action_mean(policy, expectation(model, y)), one)

    # The optimum's derivative is that of the policy that attains it (Danskin).
    return replace(solution, value=implicit(follow, solution.value))


def _collapse(components: EndComponents | None, value: jax.Array) -> jax.Array:
    """The largest value in each state's end component."""
    if components is None:
        return value
    label = components.component.ravel()
    best = jax.ops.segment_max(value.ravel(), label, num_segments=label.size)
    return best[label].reshape(value.shape)
