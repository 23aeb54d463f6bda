"""Games of generalised reactivity: the triple fixpoint, its layers, and both strategies.

Piterman, Pnueli and Sa'ar (2006), "Synthesis of reactive(1) designs", with chance as in
:mod:`jaxltl.core.games.winning`: within what the system can remain in, and for each guarantee, sets
grow round by round from which the system comes nearer to the guarantee or an assumption fails
for ever.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jaxltl.core.games.objective import GR1
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.graphs.support import repeat
from jaxltl.core.models.game import Game
from jaxltl.core.models.operators import exists_successor, first_action, forall_successor


class Reactive(NamedTuple):
    """The region of a GR(1) game with strategies of both players.

    Attributes:
      region: ``bool[S]``.
      action: ``int32[S, J]``, the system's moves towards each guarantee.
      counter_action: ``int32[S, M]``, the environment's towards each assumption.
    """

    region: jax.Array
    action: jax.Array
    counter_action: jax.Array


class Layers(NamedTuple):
    """For each guarantee and assumption the round in which a state is first covered.

    Attributes:
      region: ``bool[S]``.
      round: ``int32[J, M, S]``; in the region least over M at the layer that covers the
        state, and :data:`NEVER` outside.
    """

    region: jax.Array
    round: jax.Array


NEVER = jnp.iinfo(jnp.int32).max


def solve_gr1(game: Game, objective: GR1, moves: jax.Array | None = None) -> Reactive:
    """From where the system achieves a GR(1) objective, and winning strategies of both.

    Args:
      game: the game.
      objective: what the system is to achieve.
      moves: ``bool[S, A]``, those that there are; default the available ones.

    Returns:
      :class:`Reactive`.
    """
    num_guarantees, num_assumptions = len(objective.guarantees), len(objective.assumptions)
    moves = game.available if moves is None else moves
    _, first = first_action(moves)
    actions = jnp.repeat(first[None], num_guarantees, axis=0)
    counters = jnp.repeat(first[None], num_assumptions, axis=0)

    def body(carry):
        inside, actions, counters, _ = carry
        before = inside
        for j in range(num_guarantees):
            inside, counters = _keep(game, moves, inside, counters)
            allowed = _within(game, moves, inside)
            found, action = _pursue(game, objective, j, inside, allowed)
            actions = actions.at[j].set(action)
            against = _prevent(game, objective, inside, allowed, found)
            counters = jnp.where(inside & ~found, against, counters)
            inside = found
        return inside, actions, counters, jnp.any(inside != before)

    start = (~objective.lost, actions, counters, jnp.bool_(True))
    region, actions, counters, _ = repeat(body, start, (game, objective))
    return Reactive(region, jnp.moveaxis(actions, 0, -1), jnp.moveaxis(counters, 0, -1))


def _keep(
    game: Game, moves: jax.Array, inside: jax.Array, counters: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The part of a set that the environment cannot force the play out of."""
    out = attractor(game, ~inside, moves, rule=~game.system, among=inside)
    return inside & ~out.region, jnp.where(inside & out.region, out.action, counters)


def _within(game: Game, moves: jax.Array, inside: jax.Array) -> jax.Array:
    """The system's moves that surely stay inside, and all of the environment's."""
    return moves & (forall_successor(game, inside) | ~game.system[..., None])


def _near(game: Game, found: jax.Array) -> jax.Array:
    """The environment's moves that may lead to a set: ``bool[S, A]``. They help the system."""
    return exists_successor(game, found) & ~game.system[..., None]


def _pursue(
    game: Game, objective: GR1, j: int, inside: jax.Array, allowed: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Where the system, without leaving a set, meets guarantee j or an assumption fails.

    Returns:
      ``bool[S]``, and the system's moves there, ``int32[S]``.
    """
    goal = inside & objective.guarantees[j]

    def body(carry):
        found, action, _ = carry
        near = attractor(game, found, allowed, rule=game.system, among=inside)
        action = jnp.where(near.region & ~found, near.action, action)
        grown = near.region
        for i in range(len(objective.assumptions)):
            covered = _waiting(game, objective, i, inside, allowed, near.region, near.region)
            stays = first_action(allowed & forall_successor(game, covered))[1]
            action = jnp.where(covered & ~grown, stays, action)
            grown = grown | covered
        return grown, action, jnp.any(grown != near.region)

    _, first = first_action(allowed)
    found, action, _ = repeat(body, (goal, first, jnp.bool_(True)), (game, objective, inside))
    return found, action


def _waiting(
    game: Game, objective: GR1, i: int, inside: jax.Array, allowed: jax.Array, near: jax.Array,
    found: jax.Array,
) -> jax.Array:
    """Where assumption i fails for as long as the play is not near to a set `found`."""
    missed = inside & ~near
    forced = attractor(
        game, ~inside | (missed & objective.assumptions[i]),
        allowed & ~_near(game, found), rule=~game.system, among=missed,
    )
    return inside & ~forced.region


def _prevent(
    game: Game, objective: GR1, inside: jax.Array, allowed: jax.Array, found: jax.Array
) -> jax.Array:
    """The environment's moves, ``int32[M, S]``, that meet every assumption and avoid a set."""
    missed = inside & ~found
    allowed = allowed & ~_near(game, found)
    moves = []
    for assumption in objective.assumptions:
        goal = missed & assumption
        towards = attractor(game, ~inside | goal, allowed, rule=~game.system, among=missed)
        moves.append(jnp.where(goal, first_action(allowed)[1], towards.action))
    return jnp.stack(moves)


def gr1_layers(game: Game, objective: GR1) -> Layers:
    """The rounds of the triple fixpoint, one step a round, in the region.

    In round r with Y what is covered before, layer (r, i) is the greatest X from which the
    system, moving within the region, is at guarantee j, or comes into Y with positive
    probability, or stays in X where assumption i does not hold.

    Args:
      game: the game.
      objective: the objective.

    Returns:
      :class:`Layers`.
    """
    region = solve_gr1(game, objective).region
    allowed = _within(game, game.available, region)
    rows = []
    for j in range(len(objective.guarantees)):
        goal = region & objective.guarantees[j]

        def body(carry, goal=goal):
            found, rounds, n, _ = carry
            leads = allowed & exists_successor(game, found)
            some, all_ = first_action(leads)[0], ~first_action(allowed & ~leads)[0]
            near = goal | (region & jnp.where(game.system, some, all_))
            covered = jnp.stack([
                _waiting(game, objective, i, region, allowed, near, found)
                for i in range(len(objective.assumptions))
            ])
            rounds = jnp.where(covered & (rounds == NEVER), n, rounds)
            grown = found | covered.any(0)
            return grown, rounds, n + 1, jnp.any(grown != found)

        none = jnp.zeros(game.state_shape, bool)
        rounds = jnp.full((len(objective.assumptions), *game.state_shape), NEVER, jnp.int32)
        start = (none, rounds, jnp.int32(0), jnp.bool_(True))
        rows.append(repeat(body, start, (game, objective, region))[1])
    return Layers(region, jnp.stack(rows))
