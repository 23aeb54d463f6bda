"""GR(1) games: triple fixpoint, its layers, and strategies of both players.

Piterman, Pnueli and Sa'ar (2006), "Synthesis of reactive(1) designs", with chance as in
:mod:`jaxltl.core.games.winning`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxltl.core.models.protocols import PyTree
from jaxltl.core.array_types import Array
from jaxltl.core.games.objective import GR1
from jaxltl.core.graphs.attractor import attract
from jaxltl.core.graphs.graph import Graph


class Reactive(NamedTuple):
    """The region of a GR(1) game with strategies of both players."""

    region: jax.Array  # bool[S]
    action: jax.Array  # int32[S, J], the system's moves towards each guarantee
    counter_action: jax.Array  # int32[S, M], the environment's towards each assumption


class Layers(NamedTuple):
    """Rounds ``int32[J, M, S]`` of the triple fixpoint in which states of the region are first covered."""

    region: jax.Array
    round: jax.Array  # least over M at the layer that covers the state; NEVER outside


NEVER = np.iinfo(np.int32).max


class _GR1Arena(NamedTuple):
    """A game graph with its owners and its objective."""

    graph: Graph
    system: Array
    objective: GR1


def solve_gr1(graph: Graph, system: Array, objective: GR1, moves: Array | None = None) -> Reactive:
    """Winning region of a GR(1) objective, and winning strategies of both players."""
    xp, arena = graph.xp, _GR1Arena(graph, system, objective)
    num_guarantees, num_assumptions = len(objective.guarantees), len(objective.assumptions)
    moves = graph.available if moves is None else moves & graph.available
    _, first = graph.first(moves)

    def body(carry: PyTree) -> PyTree:
        inside, actions, counters, _ = carry
        before, actions = inside, list(actions)
        for j in range(num_guarantees):
            inside, counters = _keep(arena, moves, inside, counters)
            allowed = _within(arena, moves, inside)
            reached, actions[j] = _pursue(arena, j, inside, allowed)
            against = _prevent(arena, inside, allowed, reached)
            counters = xp.where(inside & ~reached, against, counters)
            inside = reached
        return inside, tuple(actions), counters, xp.any(inside != before)

    counters = xp.stack([first] * num_assumptions)
    start = (~objective.lost, (first,) * num_guarantees, counters, xp.asarray(True))
    region, actions, counters, _ = graph.repeat(body, start)
    return Reactive(region, xp.stack(actions, axis=-1), xp.moveaxis(counters, 0, -1))


def _keep(arena: _GR1Arena, moves: Array, inside: Array, counters: Array) -> tuple[Array, Array]:
    """The subset in which the system can remain."""
    graph, system, _ = arena
    out = attract(graph, ~inside, moves, rule=~system, among=inside)
    return inside & ~out.region, graph.xp.where(inside & out.region, out.action, counters)


def _within(arena: _GR1Arena, moves: Array, inside: Array) -> Array:
    """Moves of the system that surely stay inside, and all moves of the environment."""
    result: Array = moves & (arena.graph.forall(inside) | ~arena.graph.on_choices(arena.system))
    return result


def _near(arena: _GR1Arena, target: Array) -> Array:
    """The environment's moves that may lead to a set: ``bool[S, A]``. They help the system."""
    result: Array = arena.graph.exists(target) & ~arena.graph.on_choices(arena.system)
    return result


def _pursue(arena: _GR1Arena, j: int, inside: Array, allowed: Array) -> tuple[Array, Array]:
    """States from which the system, inside a set, meets guarantee j or an assumption fails."""
    graph, system, objective = arena
    xp = graph.xp

    def body(carry: PyTree) -> PyTree:
        reached, action, _ = carry
        attracted = attract(graph, reached, allowed, rule=system, among=inside)
        action = xp.where(attracted.region & ~reached, attracted.action, action)
        grown = attracted.region
        for i in range(len(objective.assumptions)):
            covered = _waiting(arena, i, inside, allowed, attracted.region, attracted.region)
            stays = graph.first(allowed & graph.forall(covered))[1]
            action = xp.where(covered & ~grown, stays, action)
            grown = grown | covered
        return grown, action, xp.any(grown != attracted.region)

    goal = inside & objective.guarantees[j]
    start = (goal, graph.first(allowed)[1], xp.asarray(True))
    reached, action, _ = graph.repeat(body, start)
    return reached, action


def _waiting(
    arena: _GR1Arena, i: int, inside: Array, allowed: Array, excluded: Array, target: Array
) -> Array:
    """States in which assumption i fails while the play is outside `excluded` and not near `target`."""
    missed = inside & ~excluded
    forced = attract(
        arena.graph,
        ~inside | (missed & arena.objective.assumptions[i]),
        allowed & ~_near(arena, target),
        rule=~arena.system,
        among=missed,
    )
    return inside & ~forced.region


def _prevent(arena: _GR1Arena, inside: Array, allowed: Array, target: Array) -> Array:
    """Moves of the environment, ``int32[M, S]``, that meet every assumption and avoid a set."""
    graph, system, objective = arena
    missed = inside & ~target
    allowed = allowed & ~_near(arena, target)
    moves = []
    for assumption in objective.assumptions:
        goal = missed & assumption
        towards = attract(graph, ~inside | goal, allowed, rule=~system, among=missed)
        moves.append(graph.xp.where(goal, graph.first(allowed)[1], towards.action))
    result: Array = graph.xp.stack(moves)
    return result


def gr1_layers(graph: Graph, system: Array, objective: GR1) -> Layers:
    """Rounds of the triple fixpoint inside the region, one step each."""
    xp, arena = graph.xp, _GR1Arena(graph, system, objective)
    # In round r, with Y the states covered before, layer (r, i) is the greatest X from which the
    # system, moving within the region, is at guarantee j, or enters Y with positive probability, or
    # stays in X where assumption i does not hold.
    region = solve_gr1(graph, system, objective).region
    allowed = _within(arena, graph.available, region)
    rows = []
    for j in range(len(objective.guarantees)):
        goal = region & objective.guarantees[j]

        def body(carry: PyTree, goal: Array = goal) -> PyTree:
            reached, rounds, n, _ = carry
            leads = allowed & graph.exists(reached)
            some, all_ = graph.first(leads)[0], ~graph.first(allowed & ~leads)[0]
            excluded = goal | (region & xp.where(system, some, all_))
            covered = xp.stack(
                [
                    _waiting(arena, i, region, allowed, excluded, reached)
                    for i in range(len(objective.assumptions))
                ]
            )
            rounds = xp.where(covered & (rounds == NEVER), n, rounds)
            grown = reached | covered.any(0)
            return grown, rounds, n + 1, xp.any(grown != reached)

        none = xp.zeros(graph.state_shape, bool)
        rounds = xp.full((len(objective.assumptions), *graph.state_shape), NEVER, np.int32)
        start = (none, rounds, xp.int32(0), xp.asarray(True))
        rows.append(graph.repeat(body, start)[1])
    return Layers(region, xp.stack(rows))
