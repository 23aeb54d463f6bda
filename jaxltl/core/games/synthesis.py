"""Synthesis for a game: winning region, permissive strategy, independent checks, and a counter-play.

Example: a robot that must stay on the left, where it can.
  >>> import jaxltl as jl
  >>> from jaxltl.core.games.synthesis import synthesize
  >>> from jaxltl.core.games.winning import task_game
  >>> world = jl.make_mdp([[[0], [1]], [[1], [0]]], [[[1.0], [1.0]]] * 2, label=[[1], [0]],
  ...                     propositions=["left"], initial=[0.5, 0.5])
  >>> game, objective = task_game(jl.make_game(world, [True, True]), "G left")
  >>> solved = synthesize(game, objective)
  >>> solved.wins.tolist(), solved.verdict.system, solved.play.failed
  ([True, False], True, True)
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, make_monitor
from jaxltl.core.games.objective import GR1, Parity
from jaxltl.core.games.permissive import Permissive, apply_strategy, permissive_strategy
from jaxltl.core.games.verify import Verification, verify
from jaxltl.core.games.winning import (
    Winning,
    adversarial_chance,
    objective_at,
    winning_region,
)
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models import Game, Product, Restriction, restrict
from jaxltl.core.values.undiscounted.total_reward import worst_case_steps

STAGES = ("reading", "solving", "checking", "strategy", "writing")


@dataclass(frozen=True)
class GameNodes:
    """The product game that is solved, with its reachable states numbered."""

    # N nodes, reachable from any state of the world; the initial distribution is that of the
    # game
    game: Game
    objective: Parity | GR1  # of the system
    world_state: np.ndarray  # world_state, automaton_state: int[N]
    automaton_state: np.ndarray
    by_chance: np.ndarray  # bool[N], nodes where the environment resolves a random move
    start: np.ndarray  # int[S], the initial node of each state of the world
    automaton: Automaton | None  # of the formula, or None


@dataclass(frozen=True)
class PlayStep:
    """A position of a play, and the move that leads there."""

    node: int  # the position
    # "system", "environment", "chance" for a random move that the environment resolves, or "start"
    mover: str
    action: str  # the name of the move


@dataclass(frozen=True)
class EnvironmentPlay:
    """A play that the environment wins."""

    steps: list[PlayStep]  # its positions in order
    repeats_from: int | None  # the step from which it repeats for ever, or None
    failed: bool  # whether it ends in a violation that no continuation can undo
    by_chance: bool  # whether a random move was resolved against the system


@dataclass(frozen=True)
class Synthesis:
    """A solved game with its strategies and their independent checks."""

    game: Game  # the states of the world, without an automaton
    nodes: GameNodes  # the product game that is solved
    winning: Winning  # the region and both players' strategies, on the nodes
    verdict: Verification  # of the independent check of both strategies
    # a permissive strategy, or None if the system wins from no initial state
    strategy: Permissive | None
    restricted: Restriction | None  # the game under that strategy
    strategy_verdict: Verification | None  # of the independent check of that game
    play: EnvironmentPlay | None  # one that the environment wins from an initial state, or None
    # bounds of the expected moves of both players until acceptance from any initial state: with the
    # system's moves drawn uniformly, as by the saved policy, and with any of the allowed ones
    moves: tuple[float, ...] | None

    @property
    def wins(self) -> np.ndarray:
        """``bool[S]``: the system wins the runs that start in a state of the world."""
        wins: np.ndarray = np.asarray(self.winning.region)[self.nodes.start]
        return wins

    @functools.cached_property
    def base(self) -> np.ndarray:
        """``int[N']``: the node of each state of the restricted game."""
        assert self.strategy is not None and self.restricted is not None
        base = np.asarray(self.strategy.base_state)
        nodes: np.ndarray = base[np.asarray(self.restricted.base_state)]
        return nodes

    @property
    def starts(self) -> np.ndarray:
        """The initial states of the world."""
        return np.flatnonzero(np.asarray(self.game.initial) > 0)

    @property
    def lost_starts(self) -> np.ndarray:
        """Those from which the environment wins."""
        lost: np.ndarray = self.starts[~self.wins[self.starts]]
        return lost


def synthesize(
    game: Game,
    objective: Parity | GR1,
    *,
    chance: str = "random",
    method: str = "auto",
    bound: int | None = None,
    actions: Sequence[str] | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Synthesis:
    """Solves a game, checks the solution, and extracts a permissive strategy.

    Args:
      game: a game, or the product of one with a formula's automaton, of :func:`~jaxltl.core.games.winning.task_game`.
      objective: of the system.
      chance: random moves are by probability, ``"random"``, or the environment's, ``"adversarial"``.
      method, bound: of :func:`~jaxltl.core.games.permissive_strategy`.
      actions: names of the actions in plays; default their numbers.
      progress: called with the name of each stage.

    Raises:
      ValueError: a method that does not fit the objective.
    """
    progress("solving")
    nodes = make_nodes(game, objective, chance)
    winning = winning_region(nodes.game, nodes.objective)
    progress("checking")
    verdict = verify(winning)
    wins = np.asarray(winning.region)
    initial = np.asarray(nodes.game.initial) > 0
    progress("strategy")
    strategy = restricted = strategy_verdict = moves = None
    if wins[initial].any():
        strategy = permissive_strategy(nodes.game, nodes.objective, method=method, bound=bound)
        restricted = apply_strategy(strategy)
        strategy_verdict = check_strategy(nodes, strategy, restricted)
        moves = expected_moves(nodes, strategy, restricted)
    lost = np.flatnonzero(initial & ~wins)
    names = tuple(map(str, range(game.num_actions))) if actions is None else tuple(actions)
    play = lost_play(nodes, winning, int(lost[0]), names) if lost.size else None
    world = game
    if isinstance(game.mdp, Product):
        world = Game(game.mdp.mdp, jnp.asarray(game.system).reshape(game.state_shape)[:, 0])
    return Synthesis(
        world, nodes, winning, verdict, strategy, restricted, strategy_verdict, play, moves
    )


def make_nodes(game: Game, objective: Parity | GR1, chance: str = "random") -> GameNodes:
    """The product game that is solved, with its reachable states numbered."""
    automaton = game.mdp.automaton if isinstance(game.mdp, Product) else None
    width = 1 if automaton is None else game.state_shape[1]
    first = 0 if automaton is None else int(automaton.initial)
    num_states = game.state_shape[0]
    start = np.arange(num_states) * width + first
    origin, num_own = np.arange(game.num_states), game.num_states
    if chance == "adversarial":
        game, base_state = adversarial_chance(game)
        objective, origin = objective_at(objective, base_state), np.asarray(base_state)
    memories = 1 if len(game.state_shape) == 1 else width
    everywhere = np.zeros(game.num_states)
    everywhere[start] = 1 / start.size
    reached = restrict(game, everywhere)
    number = np.asarray(reached.base_state) * memories + np.asarray(reached.memory)
    initial = jnp.asarray(game.initial).ravel()[number]
    explicit = reached.model
    return GameNodes(
        game=explicit.replace(mdp=explicit.mdp.replace(initial=initial)),
        objective=objective_at(objective, jnp.asarray(number)),
        world_state=origin[number] // width,
        automaton_state=origin[number] % width,
        by_chance=number >= num_own,
        start=np.searchsorted(number, start),
        automaton=automaton,
    )


def check_strategy(nodes: GameNodes, strategy: Permissive, restricted: Restriction) -> Verification:
    """Independent check that the system wins with any choice of allowed moves."""
    game = restricted.model
    base = strategy.base_state[restricted.base_state]
    nobody = jnp.zeros(game.num_states, bool)
    objective = objective_at(nodes.objective, base)
    shape: tuple[int, ...] = (game.num_states,)
    actions = [jnp.zeros(shape, jnp.int32)] * 2
    if isinstance(objective, GR1):
        actions = [
            jnp.zeros((*shape, len(sets)), jnp.int32)
            for sets in (objective.guarantees, objective.assumptions)
        ]
    return verify(Winning(game.replace(system=nobody), objective, ~nobody, *actions))


def expected_moves(
    nodes: GameNodes, strategy: Permissive, restricted: Restriction
) -> tuple[float, ...] | None:
    """The bounds of ``Synthesis.moves``; None for other objectives than Buchi and reachability."""
    game, base = restricted.model, strategy.base_state[restricted.base_state]
    objective = objective_at(nodes.objective, base)
    # States in which an adversary resolves a random move have moves that are none of the players'.
    if isinstance(objective, GR1) or objective.num_priorities > 2 or nodes.by_chance.any():
        return None
    accepting = np.asarray((objective.priority == 0) | objective.won) & ~np.asarray(objective.lost)
    if accepting.all():  # safety
        return None
    return tuple(
        float(worst_case_steps(x, accepting, game.available).upper[game.initial > 0].max())
        for x in (game, Game(game.mdp, jnp.zeros_like(game.system)))
    )


# --- a play that the environment wins -------------------------------------------------------


def lost_play(
    nodes: GameNodes, winning: Winning, node: int, actions: tuple[str, ...]
) -> EnvironmentPlay:
    """Play from a node of the losing region, until a violation or a repetition.

    The system delays a certain violation as long as possible, else takes its first move; random
    moves are resolved against it.
    """
    game, objective = nodes.game, winning.objective
    failed = np.asarray(objective.lost)  # a violation that no continuation can undo
    if nodes.automaton is not None:
        verdict = np.asarray(make_monitor(nodes.automaton).verdict)
        failed = failed | (verdict == Verdict.VIOLATED)[nodes.automaton_state]
    time = np.asarray(attractor(game, jnp.asarray(failed), rule=~game.system).rank)
    time = np.where(failed, 0, np.where(time > 0, time, np.iinfo(np.int32).max))
    successor, used = np.asarray(game.mdp.successor), np.asarray(game.mdp.probability) > 0
    available, system = np.asarray(game.available), np.asarray(game.system)
    outside = ~np.asarray(winning.region)
    counter = np.asarray(winning.counter_action).reshape(game.num_states, -1)
    advances = np.zeros((1, game.num_states), bool)
    if isinstance(objective, GR1):
        advances = np.asarray(objective.assumptions)

    def worst(action: int) -> int:
        """The losing successor with the earliest violation."""
        nexts = successor[node, action][used[node, action]]
        nexts = nexts[outside[nexts]]
        return int(nexts[np.argmin(time[nexts])])

    steps, met, memory, by_chance = [PlayStep(node, "start", "")], {(node, 0): 0}, 0, False
    while not failed[node]:
        if system[node]:
            # A losing node has a losing successor by every move.
            action = int(max(np.flatnonzero(available[node]), key=lambda a: time[worst(int(a))]))
        else:
            action = int(counter[node, memory])
        target, mover = worst(action), "system" if system[node] else "environment"
        mover = "chance" if nodes.by_chance[node] else mover
        by_chance |= used[node, action].sum() > 1
        memory = (memory + int(advances[memory, node])) % len(advances)
        node = target
        steps.append(PlayStep(node, mover, "" if mover == "chance" else actions[action]))
        if (node, memory) in met:
            return EnvironmentPlay(steps, met[node, memory], False, bool(by_chance))
        met[node, memory] = len(steps) - 1
    # The automaton reads labels on exit, so that the violation is decided one step earlier.
    return EnvironmentPlay(
        steps[: max(1, len(steps) - (nodes.automaton is not None))], None, True, bool(by_chance)
    )


def strategy_play(
    synthesis: Synthesis, num_steps: int, seed: int = 0
) -> list[tuple[int, int | None]]:
    """Play with random moves among those that the permissive strategy of the system allows.

    Args:
      synthesis: of :func:`synthesize`, with a strategy.
      num_steps: number of moves.
      seed: of the random moves.

    Returns:
      Nodes and moves; those of the environment have the numbers of its actions plus the number of
      actions, and random moves are None.
    """
    assert synthesis.restricted is not None
    game, rng, base = synthesis.restricted.model, np.random.default_rng(seed), synthesis.base
    count = synthesis.game.num_actions
    successor, chance = np.asarray(game.mdp.successor), np.asarray(game.mdp.probability, float)
    allowed, system = np.asarray(game.available), np.asarray(game.system)
    initial = np.asarray(game.initial, float)
    here = int(rng.choice(len(initial), p=initial / initial.sum()))
    steps: list[tuple[int, int | None]] = []
    for _ in range(num_steps):
        action = int(rng.choice(np.flatnonzero(allowed[here])))
        move = None if action >= count else action + count * (not system[here])
        steps.append((int(base[here]), move))
        likely = chance[here, action]
        here = int(rng.choice(successor[here, action], p=likely / likely.sum()))
    return steps
