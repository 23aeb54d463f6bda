"""Independent verification of almost-sure winning regions and strategies of stochastic games.

With the strategy of one player fixed, the game is a decision process of the other player, and its
end components decide it. No nested fixed point is computed, so that the check is independent of the
solver.
"""

from __future__ import annotations

from collections.abc import Iterator

from typing import NamedTuple

import numpy as np

from jaxltl.core.models.protocols import PyTree
from jaxltl.core.array_types import Booleans, Integers
from jaxltl.core.games.objective import GR1, Parity
from jaxltl.core.games.winning import Winning
from jaxltl.core.models.compiled import is_sparse
from jaxltl.core.models.construct.convert import to_sparse
from jaxltl.core.models.game import Game, as_game
from jaxltl.core.pretty_print import brief
from jaxltl.core.sparse.graph.components import forward_reachable, strong_components


@brief
class Verification(NamedTuple):
    """Result of :func:`verify`; true if both players' claims hold.

    Attributes:
      system: the system's strategy wins almost surely in the region.
      environment: the environment's strategy prevents that outside of the region.
      reason: the error and its state for each claim that fails; else empty.

    Example:
      >>> import jaxltl as jl
      >>> fork = jl.from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 0]]], initial=[1, 0],
      ...                      label={"crash": [1]})
      >>> found = jl.verify(jl.winning_region(fork, "G !crash"))
      >>> bool(found), found.system, found.environment, found.reason
      (True, True, True, '')
    """

    system: bool
    environment: bool
    reason: str

    def __bool__(self) -> bool:
        return self.system and self.environment


def verify(winning: Winning) -> Verification:
    """Verifies a winning region and the strategies of both players, on the host.

    *The system's claim.* With its actions fixed, every run stays in the region until it is won, and no
    end component in the region fails the objective (by an odd least priority, or by meeting every
    assumption and missing a guarantee). Almost every run eventually stays in an end component
    (de Alfaro 1997).

    *The environment's claim.* With its actions fixed, the system does not reach the region, or an end
    component that achieves the objective, with probability one from any state outside. Both claims
    together prove that the region is the almost-sure winning region.

    For :class:`GR1` the claims are checked from every memory state. Each search is linear in the
    transitions times memory states.

    Args:
      winning: an object with the fields `game`, `objective`, `region`, `action` and `counter_action`
        of ``Winning``.

    Returns:
      :class:`Verification`.

    Raises:
      ValueError: the region or an action has the wrong shape, such as a batch of them.

    Example:
      >>> from jaxltl.core.games import reach, winning_region
      >>> from jaxltl import from_dense
      >>> world = from_dense([[[1.0, 0], [0, 1.0]], [[0, 1.0], [0, 1.0]]])
      >>> found = winning_region(world, reach(world, np.array([False, True])))
      >>> bool(verify(found)), verify(found.replace(action=np.array([0, 0]))).reason
      (True, 'around state 0 the run can stay for ever with least priority 1, which is odd')
    """
    claim = _claim(winning)
    system, environment = _refute_system(claim), _refute_environment(claim)
    reason = "; ".join(x for x in (system, environment) if x)
    return Verification(not system, not environment, reason)


class _GameMoves(NamedTuple):
    """The moves of a game over flat states, in order of states and actions."""

    state: Integers  # of each move
    action: Integers
    move: Integers  # of each edge, ascending
    successor: Integers


class _Claim(NamedTuple):
    """A ``Winning`` with flat states: ``[S]``, actions ``[S, memories]``, sets ``[n, S]``."""

    shape: tuple[int, ...]  # of the game's states
    moves: _GameMoves
    system: Booleans
    region: Booleans
    won: Booleans
    lost: Booleans
    action: Integers
    counter_action: Integers
    priority: Integers | None  # of a parity objective
    assumptions: Booleans
    guarantees: Booleans


def _claim(winning: Winning) -> _Claim:
    game, objective = as_game(winning.game), winning.objective
    shape = game.state_shape
    if isinstance(objective, GR1):
        sets = tuple(
            np.asarray(x).reshape(len(x), -1) for x in (objective.assumptions, objective.guarantees)
        )
        priority, won = None, np.zeros(shape, bool)
    elif isinstance(objective, Parity):
        sets = (np.zeros((1, np.prod(shape, dtype=int)), bool),) * 2
        priority = np.asarray(objective.priority).ravel()
        won = np.asarray(objective.won) & ~np.asarray(objective.lost)
    else:
        raise ValueError(f"objective is a {type(objective).__name__}; give a Parity or a GR1.")

    def flat(name: str, width: int) -> np.ndarray:
        value = np.asarray(getattr(winning, name))
        expected = (*shape, width) if isinstance(objective, GR1) and width else shape
        if value.shape != expected:
            raise ValueError(
                f"{name} has shape {value.shape}; expected {expected}. Of a batch, give one game "
                "at a time."
            )
        return value.reshape(-1, max(width, 1))

    return _Claim(
        shape,
        _moves(game),
        np.asarray(game.system).ravel(),
        flat("region", 0)[:, 0].astype(bool),
        won.ravel(),
        np.asarray(objective.lost).ravel(),
        flat("action", len(sets[1])),
        flat("counter_action", len(sets[0])),
        priority,
        *sets,
    )


def _refute_system(claim: _Claim) -> str:
    """The error in the system's claim; empty if it holds."""
    bad = np.flatnonzero(claim.region & claim.lost)
    if bad.size:
        return f"state {_name(claim, bad[0])} is in the region but already lost"
    undecided = claim.region & ~claim.won
    missing = _unavailable(claim, claim.action, undecided & claim.system)
    if missing:
        return f"the system's strategy has no valid action: {missing}"
    play = _induced_mdp(claim, claim.system, claim.action, claim.guarantees)
    memories = play.memories
    node_in = np.repeat(undecided, memories)
    edge = np.flatnonzero(node_in[play.source] & ~np.repeat(claim.region, memories)[play.target])
    if edge.size:
        pair = int(play.pair[edge[0]])
        node, action = int(play.owner[pair]), int(claim.moves.action[pair // memories])
        who = "strategy's" if claim.system[node // memories] else "environment's"
        return f"from {_where(claim, play, node)} the {who} action {action} leaves the region"
    for avoid, meet, reason in _failures(claim):
        witness = _component(play, node_in & ~np.repeat(avoid, memories), meet)
        if witness is not None:
            return f"around {_where(claim, play, witness)} the run can {reason}"
    return ""


def _refute_environment(claim: _Claim) -> str:
    """The error in the environment's claim; empty if it holds."""
    bad = np.flatnonzero(claim.won & ~claim.region)
    if bad.size:
        return f"state {_name(claim, bad[0])} is already won but outside the region"
    undecided = ~claim.region & ~claim.lost
    missing = _unavailable(claim, claim.counter_action, undecided & ~claim.system)
    if missing:
        return f"the environment's strategy has no valid action: {missing}"
    play = _induced_mdp(claim, ~claim.system, claim.counter_action, claim.assumptions)
    memories = play.memories
    node_in = np.repeat(undecided, memories)
    for avoid, meet, reason in _successes(claim):
        node = _component(play, node_in & ~np.repeat(avoid, memories), meet)
        if node is not None:
            where = _where(claim, play, node)
            return f"around {where}, outside the region, the system can {reason}"
    # No component outside the region is a success, so all that is left is to enter the region.
    goal = np.repeat(claim.region & ~claim.lost, memories)
    entering = _almost_surely(play, goal, node_in)
    nodes = np.flatnonzero(entering & node_in)
    if nodes.size:
        where = _where(claim, play, nodes[0])
        return f"from {where}, outside the region, the system can enter the region almost surely"
    return ""


def _failures(claim: _Claim) -> Iterator[tuple[PyTree, PyTree, str]]:
    """End components that fail the objective: one set is avoided and all others are met."""
    if claim.priority is not None:
        yield from _least_priorities(claim.priority, 1)
        return
    for j, guarantee in enumerate(claim.guarantees):
        reason = f"meet every assumption for ever and never guarantee {j}"
        yield guarantee, claim.assumptions, reason


def _successes(claim: _Claim) -> Iterator[tuple[PyTree, PyTree, str]]:
    """End components that achieve the objective, in the same form."""
    if claim.priority is not None:
        yield from _least_priorities(claim.priority, 0)
        return
    yield np.zeros_like(claim.region), claim.guarantees, "meet every guarantee for ever"
    for i, assumption in enumerate(claim.assumptions):
        yield assumption, claim.guarantees[:0], f"stay for ever without assumption {i}"


def _least_priorities(priority: Integers, parity: int) -> Iterator[tuple[PyTree, PyTree, str]]:
    for p in np.unique(priority[priority % 2 == parity]).tolist():
        kind = "odd" if parity else "even"
        reason = f"stay for ever with least priority {p}, which is {kind}"
        yield priority < p, (priority == p)[None], reason


def _name(claim: _Claim, state: int) -> str:
    where = tuple(int(i) for i in np.unravel_index(state, claim.shape))
    return str(where[0]) if len(where) == 1 else str(where)


def _where(claim: _Claim, play: _InducedMDP, node: int) -> str:
    state, memory = divmod(int(node), play.memories)
    extra = f" with memory {memory}" if play.memories > 1 else ""
    return f"state {_name(claim, state)}{extra}"


def _unavailable(claim: _Claim, action: Integers, where: Booleans) -> str:
    """The first action of a strategy that cannot be taken."""
    moves = claim.moves
    base = int(moves.action.max()) + 1
    known = (action >= 0) & (action < base)
    requested = np.arange(action.shape[0])[:, None] * base + np.where(known, action, 0)
    number = moves.state * base + moves.action
    place = np.minimum(np.searchsorted(number, requested), number.size - 1)
    valid = known & (number[place] == requested)
    wrong = np.argwhere(where[:, None] & ~valid)
    if not wrong.size:
        return ""
    state, memory = wrong[0]
    extra = f" with memory {memory}" if action.shape[1] > 1 else ""
    return f"{action[state, memory]} is not available in state {_name(claim, state)}{extra}"


# --- one player against chance ----------------------------------------------------------------


class _InducedMDP(NamedTuple):
    """The graph of the free player: edges from nodes ``state * memories + memory`` by numbered pairs."""

    source: Integers
    pair: Integers  # move * memories + memory, a choice; all its edges are possible at once
    target: Integers
    into: Integers  # the pairs with an edge into node n are into[start[n]:start[n + 1]]
    start: Integers
    owner: Integers  # the node of each pair
    nodes: int
    memories: int


def _induced_mdp(claim: _Claim, owner: Booleans, action: Integers, goals: Booleans) -> _InducedMDP:
    """The game with one player's actions fixed; the memory advances past a goal that is met."""
    moves = claim.moves
    memories = len(goals)
    memory = np.arange(memories)
    after = np.where(goals.T, (memory + 1) % memories, memory)  # [S, memories]
    allowed = ~owner[moves.state, None] | (action[moves.state] == moves.action[:, None])
    allowed = allowed[moves.move]
    state = moves.state[moves.move]
    source = (state[:, None] * memories + memory)[allowed]
    pair = (moves.move[:, None] * memories + memory)[allowed]
    target = (moves.successor[:, None] * memories + after[state])[allowed]
    nodes = owner.size * memories
    order = np.argsort(target, kind="stable")
    start = np.searchsorted(target[order], np.arange(nodes + 1))
    of_pair = (moves.state[:, None] * memories + memory).ravel()
    return _InducedMDP(source, pair, target, pair[order], start, of_pair, nodes, memories)


def _moves(game: Game) -> _GameMoves:
    """All moves of a game; the actions of a sparse one are its rows."""
    model = to_sparse(game.mdp)
    host, row = model.host, np.arange(model.num_rows)
    action = row if is_sparse(game.mdp) else np.asarray(model.action)
    return _GameMoves(*(x.astype(int) for x in (host.state, action, host.row, host.successor)))


def _component(play: _InducedMDP, inside: Booleans, meet: Booleans) -> int | None:
    """A node of an end component that meets every set of states, or None."""
    if not inside.any():
        return None
    label = _end_components(play, inside)
    labels = np.unique(label[label >= 0])
    for met in np.repeat(meet, play.memories, axis=1):
        labels = np.intersect1d(labels, label[met & (label >= 0)])
    return int(np.flatnonzero(label == labels[0])[0]) if labels.size else None


def _end_components(play: _InducedMDP, inside: Booleans) -> Integers:
    """The smallest node of each node's maximal end component among some; -1 without one."""
    alive = _staying(play, inside, inside)
    while True:
        _trim(play, alive, inside)
        edge = alive[play.pair]
        source, target = play.source[edge], play.target[edge]
        label = strong_components(source, target, play.nodes)
        leaving = label[source] != label[target]
        if not leaving.any():
            stuck = np.ones(play.nodes, bool)
            stuck[source] = False
            return np.where(stuck, -1, label)
        alive[play.pair[edge][leaving]] = False


def _almost_surely(play: _InducedMDP, goal: Booleans, inside: Booleans) -> Booleans:
    """Nodes from which choices reach the goal with probability one, through inside nodes."""
    while True:
        alive = _staying(play, inside, inside | goal)
        _trim(play, alive, inside)
        edge = alive[play.pair]
        smaller = forward_reachable(play.target[edge], play.source[edge], goal) & inside
        if (smaller == inside).all():
            return inside | goal
        inside = smaller


def _staying(play: _InducedMDP, sources: Booleans, targets: Booleans) -> Booleans:
    """Pairs of some nodes that surely lead to some nodes, ``bool[pairs]``."""
    alive = np.zeros(play.owner.size, bool)
    alive[play.pair] = True
    alive[play.pair[~sources[play.source] | ~targets[play.target]]] = False
    return alive


def _trim(play: _InducedMDP, alive: Booleans, inside: Booleans) -> None:
    """Removes pairs that lead to inside nodes without pairs, until none is left, in place."""
    remaining = np.bincount(play.owner[alive], minlength=play.nodes)
    stuck = np.flatnonzero(inside & (remaining == 0)).tolist()
    while stuck:
        node = stuck.pop()
        for pair in play.into[play.start[node] : play.start[node + 1]].tolist():
            if alive[pair]:
                alive[pair] = False
                source = play.owner[pair]
                remaining[source] -= 1
                if not remaining[source]:
                    stuck.append(source)
