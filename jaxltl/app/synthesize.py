"""Synthesis from a game file: winning region, permissive strategy, checks, counter-play."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
import jax.numpy as jnp
import numpy as np

from jaxltl.app.files.game import (
    GameFile,
    StrategyTable,
    MappedGame,
    automaton_of,
    load_game,
    load_objective,
)
from jaxltl.core.automata import Automaton
from jaxltl.core.environments import Verdict, make_monitor
from jaxltl.core.games import (
    GR1,
    Parity,
    Permissive,
    apply_strategy,
    permissive_strategy,
    Verification,
    verify,
    Winning,
    winning_region,
)
from jaxltl.core.games.winning import adversarial_chance, objective_at
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models import Game, Restriction, restrict
from jaxltl.core.validation import errors_in
from jaxltl.core.values.undiscounted.total_reward import worst_case_steps


Progress = Callable[[str], None]
STAGES = ("reading", "solving", "checking", "strategy", "writing")


@dataclass(frozen=True)
class GameNodes:
    """The product game that is solved, with its reachable states numbered."""

    # N nodes, reachable from any state of the world; the initial distribution is that of the game
    # file
    game: Game
    objective: Parity | GR1  # of the system
    world_state: np.ndarray  # world_state, automaton_state: int[N]
    automaton_state: np.ndarray
    by_chance: np.ndarray  # bool[N], nodes where the environment resolves a random move
    start: np.ndarray  # int[S], the initial node of each state of the world
    automaton: Automaton | None  # of the formula, or None


@dataclass(frozen=True)
class Step:
    """A position of a play, and the move that leads there."""

    node: int  # the position
    # "system", "environment", "chance" for a random move that the environment resolves, or "start"
    mover: str
    action: str  # the name of the move


@dataclass(frozen=True)
class EnvironmentPlay:
    """A play that the environment wins."""

    steps: list[Step]  # its positions in order
    repeats_from: int | None  # the step from which it repeats for ever, or None
    failed: bool  # whether it ends in a violation that no continuation can undo
    by_chance: bool  # whether a random move was resolved against the system


@dataclass(frozen=True)
class Synthesis:
    """A solved game with its strategies and their independent checks."""

    file: GameFile  # file, world, nodes: the game
    world: MappedGame
    nodes: GameNodes
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
        return np.asarray(self.winning.region)[self.nodes.start]

    @functools.cached_property
    def base(self) -> np.ndarray:
        """``int[N']``: the node of each state of the restricted game."""
        assert self.strategy is not None and self.restricted is not None
        return np.asarray(self.strategy.base_state)[np.asarray(self.restricted.base_state)]

    @property
    def starts(self) -> np.ndarray:
        return np.flatnonzero(np.asarray(self.world.game.initial) > 0)

    @property
    def lost_starts(self) -> np.ndarray:
        return self.starts[~self.wins[self.starts]]


def synthesize(file: GameFile, progress: Progress = lambda stage: None) -> Synthesis:
    """Solves the game of a file, checks the solution, and extracts a permissive strategy."""
    progress("reading")
    world = load_game(file)
    nodes = make_nodes(file, world)
    progress("solving")
    winning = winning_region(nodes.game, nodes.objective)
    progress("checking")
    verdict = verify(winning)
    wins = np.asarray(winning.region)
    initial = np.asarray(nodes.game.initial) > 0
    progress("strategy")
    strategy = restricted = strategy_verdict = moves = None
    if wins[initial].any():
        table = file.strategy or StrategyTable()
        with errors_in(f"{file.path}: [strategy] "):
            strategy = permissive_strategy(
                nodes.game, nodes.objective, method=table.method, bound=table.bound
            )
        restricted = apply_strategy(strategy)
        strategy_verdict = check_strategy(nodes, strategy, restricted)
        moves = expected_moves(nodes, strategy, restricted)
    lost = np.flatnonzero(initial & ~wins)
    play = lost_play(nodes, winning, int(lost[0]), world.actions) if lost.size else None
    return Synthesis(
        file, world, nodes, winning, verdict, strategy, restricted, strategy_verdict, play, moves
    )


def make_nodes(file: GameFile, world: MappedGame) -> GameNodes:
    """The product game of a file's world and objective."""
    game, objective = load_objective(file, world)
    automaton = automaton_of(game)
    width = 1 if automaton is None else game.state_shape[1]
    first = 0 if automaton is None else int(automaton.initial)
    start = np.arange(world.game.num_states) * width + first
    origin, num_own = np.arange(game.num_states), game.num_states
    if file.task.chance == "adversarial":
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

    steps, met, memory, by_chance = [Step(node, "start", "")], {(node, 0): 0}, 0, False
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
        steps.append(Step(node, mover, "" if mover == "chance" else actions[action]))
        if (node, memory) in met:
            return EnvironmentPlay(steps, met[node, memory], False, bool(by_chance))
        met[node, memory] = len(steps) - 1
    # The automaton reads labels on exit, so that the violation is decided one step earlier.
    return EnvironmentPlay(
        steps[: max(1, len(steps) - (nodes.automaton is not None))], None, True, bool(by_chance)
    )


def demand(synthesis: Synthesis) -> None:
    """Raises ValueError if the file demands a strategy and the task is unrealizable."""
    if synthesis.file.strategy and synthesis.strategy is None:
        where = synthesis.world.describe(int(synthesis.starts[0]))
        raise ValueError(
            f"{synthesis.file.path}: [strategy] demands a strategy, but the task is unrealizable: the "
            f"environment wins from every initial state, for example: {where}. Weaken the task, "
            "assume something of the environment, or leave [strategy] out."
        )
