"""Attractors, almost-sure sets, prob0 and prob1 states: exact analyses of the graph of a model.

Only the supports of the probabilities matter. Inside ``jit`` and ``vmap`` regions grow by sweeps,
which are fast where few are needed; on concrete arrays they are computed on the host, in time linear
in the transitions. Of a sparse model allowed actions are ``bool[R]``, and an action is a row.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple, Any

import jax
import numpy as np

from jaxltl.core import validation
from jaxltl.core.array_types import Array
from jaxltl.core.graphs.graph import Graph, on_graph
from jaxltl.core.models.game import Game
from jaxltl.core.models.ops.array_namespace import jax_array
from jaxltl.core.models.ops.choices import choice_mask
from jaxltl.core.models.ops.state_sets import state_set
from jaxltl.core.models.protocols import Model, PyTree
from jaxltl.core.pretty_print import brief


@brief
class Attractor(NamedTuple):
    """A region that a goal attracts, with an action that makes progress.

    Attributes:
      region: ``bool[S]``.
      action: ``int32[S]``: in the region outside the goal, an allowed action with a successor nearer to
        the goal (the first allowed one if all lead nearer); elsewhere the first available one.
      rank: ``int32[S]``: the round in which the state joined, 0 in the goal; undefined outside.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[0, 0.5, 0.5], [1, 0, 0]], [[0, 1, 0], [0, 0, 0]],
      ...                       [[0, 0, 1], [0, 0, 0]]])
      >>> found = jl.graphs.attractor(fork, np.array([False, True, False]))
      >>> found.region.tolist(), found.rank[:2].tolist()
      ([True, True, False], [1, 0])
    """

    region: jax.Array
    action: jax.Array
    rank: jax.Array


def attractor(
    model: Model,
    goal: Array | str,
    allowed: jax.Array | None = None,
    *,
    rule: str | jax.Array | np.ndarray = "exists",
    chance: str = "some",
    among: Array | str | None = None,
) -> Attractor:
    """Attractor of a goal: the least R with ``goal <= R`` closed under a rule.

    With a rule for each state it is the attractor of a player in a game: ``"exists"`` in the states
    of that player, ``"forall"`` in the others.

    Args:
      model: the model.
      goal: ``bool[S]``, a label's name, or a Boolean formula of labels; so are other sets.
      allowed: ``bool[S, A]``, the actions that count; default: the available ones.
      rule: ``"exists"``: some allowed action leads to R; ``"forall"``: every allowed
        action does (so a state without any is attracted). Or ``bool[S]``: True for exists.
      chance: an action leads to R if ``"some"`` successor lies in R, or if ``"all"`` do.
      among: ``bool[S]``, the states outside the goal that may join; default: all.

    Returns:
      :class:`Attractor`. Boolean: there is no derivative.

    Raises:
      ValueError: unknown rule or chance, or a mask of another shape, or with other values than True
        and False (or 0 and 1).

    Example:
      >>> from jaxltl import from_dense
      >>> mdp = from_dense([[[0, 1.0]], [[0, 1.0]]])
      >>> attractor(mdp, np.array([True, False])).region.tolist()
      [True, False]
    """
    if isinstance(rule, str):
        word = validation.choice("rule", rule, ("exists", "forall"))
        exists: Array | bool | None = word == "exists"
    else:
        exists = state_set(model, "rule", rule)
    validation.choice("chance", chance, ("some", "all"))
    goal = state_set(model, "goal", goal)
    among = None if among is None else state_set(model, "among", among)
    allowed = choice_mask(model, "allowed", allowed)
    return on_graph(partial(attract, chance=chance), model, goal, allowed, exists, among)


def attract(
    graph: Graph,
    goal: Array,
    allowed: Array | None = None,
    rule: Array | bool = True,
    among: Array | None = None,
    *,
    chance: str = "some",
) -> Attractor:
    """:func:`attractor` on a graph, with a rule ``bool[S]`` or ``bool[]``, True for exists."""
    xp, shape = graph.xp, graph.state_shape
    return Attractor(
        *graph.attract(
            goal,
            graph.available if allowed is None else allowed,
            xp.broadcast_to(rule, shape),
            xp.ones(shape, bool) if among is None else among,
            chance,
        )
    )


def avoidable(model: Model, goal: Array | str, allowed: jax.Array | None = None) -> jax.Array:
    """States from which some policy surely never reaches the goal: ``bool[S]``.

    The complement of the ``"forall"`` attractor: the minimal reachability probability is zero exactly there.
    In a game the policy is the system's, against every environment.

    Args:
      model, goal, allowed: as of :func:`attractor`.

    Returns:
      ``bool[S]``. Boolean: there is no derivative.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[0, 0.5, 0.5], [1, 0, 0]], [[0, 1, 0], [0, 0, 0]],
      ...                       [[0, 0, 1], [0, 0, 0]]])
      >>> avoidable(fork, np.array([False, True, False])).tolist()
      [True, False, True]
    """
    goal, allowed = state_set(model, "goal", goal), choice_mask(model, "allowed", allowed)
    return jax_array(on_graph(avoid, model, goal, allowed, _system(model)))


def _system(model: Model) -> Array | bool:
    """The states in which the policy chooses."""
    return model.system if isinstance(model, Game) else True


def avoid(
    graph: Graph, goal: Array, allowed: Array | None = None, system: Array | bool = True
) -> Array:
    """:func:`avoidable` on a graph."""
    return ~attract(graph, goal, allowed, rule=graph.xp.logical_not(system)).region


def almost_surely_reaching(
    model: Model,
    goal: Array | str,
    allowed: jax.Array | None = None,
    *,
    reaching: Attractor | None = None,
) -> Attractor:
    """States from which some policy reaches the goal with probability one.

    The greatest X such that within X, by actions that surely stay in X, the goal is
    reachable (de Alfaro 1997). In a game the policy is the system's, against every environment.

    Args:
      model, goal, allowed: as of :func:`attractor`.
      reaching: ``attractor(model, goal, allowed)``, if it is known already.

    Returns:
      :class:`Attractor`: the region and, outside the goal, the actions of such a policy.
      Boolean: there is no derivative.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[0, 0.5, 0.5], [1, 0, 0]], [[0, 1, 0], [0, 0, 0]],
      ...                       [[0, 0, 1], [0, 0, 0]]])
      >>> almost_surely_reaching(fork, np.array([False, True, False])).region.tolist()
      [False, True, False]
    """
    goal, allowed = state_set(model, "goal", goal), choice_mask(model, "allowed", allowed)
    return on_graph(surely, model, goal, allowed, reaching, _system(model))


def surely(
    graph: Graph,
    goal: Array,
    allowed: Array | None = None,
    reaching: Attractor | None = None,
    system: Array | bool = True,
) -> Attractor:
    """:func:`almost_surely_reaching` on a graph."""
    allowed = graph.available if allowed is None else allowed & graph.available

    def inner(region: Array) -> Attractor:
        # First all states that are forced out, then those that cannot reach the goal inside.
        outside = attract(graph, ~region, allowed, graph.xp.logical_not(system), ~goal).region
        return attract(graph, goal, allowed & graph.forall(~outside), system, ~outside)

    def body(carry: PyTree) -> PyTree:
        attractor, _ = carry
        smaller = inner(attractor.region)
        return smaller, graph.xp.any(smaller.region != attractor.region)

    start = attract(graph, goal, allowed, system) if reaching is None else reaching
    # A state that cannot reach the goal at all is what removes others.
    some = ~graph.xp.all(start.region) | ~graph.xp.all(system)
    result: Attractor = graph.repeat(body, (start, some))[0]
    return result


class Sets(NamedTuple):
    """Prob1 states, prob0 states, and a policy that attains these probabilities."""

    one: Any  # arrays of the graph's namespace
    zero: Any
    action: Any


def policy_sets(graph: Graph, target: Array, policy: Array) -> Sets:
    """Prob0 and prob1 states of a policy, from its support."""
    allowed = graph.available & (policy > 0)
    zero = ~attract(graph, target, allowed).region
    doomed = attract(graph, zero, allowed, among=~target).region
    return Sets(~doomed, zero, graph.xp.zeros(target.shape, np.int32))


def max_sets(graph: Graph, target: Array) -> Sets:
    """Prob0 and prob1 states of the maximal probability, with a policy that attains it."""
    some = attract(graph, target)
    sure = surely(graph, target, reaching=some)
    action = graph.xp.where(sure.region, sure.action, some.action)
    return Sets(sure.region, ~some.region, action)


def min_sets(graph: Graph, target: Array) -> Sets:
    """Prob0 and prob1 states of the minimal probability, with a policy that attains it."""
    zero = avoid(graph, target)
    doomed = attract(graph, zero, among=~target).region
    stays, action = graph.first(graph.available & graph.forall(zero))
    first = graph.first(graph.available)[1]
    return Sets(~doomed, zero, graph.xp.where(stays, action, first))
