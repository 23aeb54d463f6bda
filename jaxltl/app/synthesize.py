"""Synthesis from a game file: who wins from where, all the ways to win, and the evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxltl.app.files.game import GameFile, World, automaton_of, load_game, load_objective
from jaxltl.app.files.schema import errors_in
from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.environments.monitor import Verdict, make_monitor
from jaxltl.core.games.objective import GR1, Parity
from jaxltl.core.games.permissive import Permissive, apply_strategy, permissive_strategy
from jaxltl.core.games.verify import Verification, verify
from jaxltl.core.games.winning import Winning, adversarial_chance, objective_at, winning_region
from jaxltl.core.graphs.attractor import attractor
from jaxltl.core.models.construct.restrict import Restriction, restrict
from jaxltl.core.models.game import Game

Progress = Callable[[str], None]
STAGES = ("reading", "solving", "checking", "strategy", "writing")


class Nodes(NamedTuple):
    """The game that is solved: the world beside the task's automaton, its states numbered.

    Attributes:
      game: ``N`` nodes, all that can follow a start in any state of the world. The initial
        distribution is the game file's.
      objective: what the system is to achieve.
      world_state, automaton_state: ``int[N]``.
      by_chance: ``bool[N]``, where the environment decides a random move in chance's place.
      start: ``int[S]``, the node of each state of the world in which a run may start there.
      automaton: the task's, or None.
    """

    game: Game
    objective: Parity | GR1
    world_state: np.ndarray
    automaton_state: np.ndarray
    by_chance: np.ndarray
    start: np.ndarray
    automaton: Automaton | None


class Step(NamedTuple):
    """One position of a play, and what led there.

    Attributes:
      node: the position.
      mover: who moved: ``"system"``, ``"environment"``, ``"chance"`` where the environment
        decides in its place, or ``"start"``.
      action: the name of the move.
    """

    node: int
    mover: str
    action: str


class Play(NamedTuple):
    """A play that the environment wins.

    Attributes:
      steps: its positions in order.
      repeats_from: the number of the step from which it goes round for ever, or None.
      failed: whether it ends because the task has failed, whatever follows.
      by_chance: whether a random move went against the system on the way.
    """

    steps: list[Step]
    repeats_from: int | None
    failed: bool
    by_chance: bool


@dataclass(frozen=True)
class Synthesis:
    """What was asked and found out.

    Attributes:
      file, world, nodes: the parts of the game.
      winning: the region and both players' strategies, on the nodes.
      verdict: of the independent check of these.
      strategy: a permissive strategy, or None if the system wins from no initial state.
      restricted: the game in which the system follows it.
      strategy_verdict: of the independent check of that.
      play: one that the environment wins from an initial state; None if it cannot.
    """

    file: GameFile
    world: World
    nodes: Nodes
    winning: Winning
    verdict: Verification
    strategy: Permissive | None
    restricted: Restriction | None
    strategy_verdict: Verification | None
    play: Play | None

    @property
    def wins(self) -> np.ndarray:
        """``bool[S]``: the system wins the runs that start in a state of the world."""
        return np.asarray(self.winning.region)[self.nodes.start]

    @property
    def starts(self) -> np.ndarray:
        """The initial states of the world."""
        return np.flatnonzero(np.asarray(self.world.game.initial) > 0)


def synthesize(file: GameFile, progress: Progress = lambda stage: None) -> Synthesis:
    """Solves the game of a file, checks the solution, and extracts a permissive strategy.

    Args:
      file: from :func:`~jaxltl.app.files.game.read_game`.
      progress: is told each of :data:`STAGES` as it begins.

    Returns:
      :class:`Synthesis`.

    Raises:
      ValueError: something in the file is wrong, or the strategy that it asks for does not
        exist although the system wins.
    """
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
    strategy = restricted = strategy_verdict = None
    if wins[initial].any():
        strategy = _strategy(file, nodes)
        restricted = apply_strategy(strategy)
        strategy_verdict = check_strategy(nodes, strategy, restricted)
    lost = np.flatnonzero(initial & ~wins)
    play = lost_play(nodes, winning, int(lost[0]), world.actions) if lost.size else None
    return Synthesis(
        file, world, nodes, winning, verdict, strategy, restricted, strategy_verdict, play
    )


def make_nodes(file: GameFile, world: World) -> Nodes:
    """The game to be solved, see :class:`Nodes`; of a file's world and task."""
    game, objective = load_objective(file, world)
    automaton = automaton_of(game)
    width = 1 if automaton is None else game.state_shape[1]
    first = 0 if automaton is None else int(automaton.initial)
    start = np.arange(world.game.num_states) * width + first
    origin, num_own = np.arange(game.num_states), game.num_states
    if file.task.chance == "adversarial":
        game, found = adversarial_chance(game)
        objective, origin = objective_at(objective, found), np.asarray(found)
    memories = 1 if len(game.state_shape) == 1 else width
    everywhere = np.zeros(game.num_states)
    everywhere[start] = 1 / start.size
    reached = restrict(game, everywhere)
    number = np.asarray(reached.base_state) * memories + np.asarray(reached.memory)
    initial = jnp.asarray(game.initial).ravel()[number]
    explicit = reached.model
    return Nodes(
        game=explicit.replace(mdp=explicit.mdp.replace(initial=initial)),
        objective=objective_at(objective, jnp.asarray(number)),
        world_state=origin[number] // width,
        automaton_state=origin[number] % width,
        by_chance=number >= num_own,
        start=np.searchsorted(number, start),
        automaton=automaton,
    )


def _strategy(file: GameFile, nodes: Nodes) -> Permissive:
    method, bound = file.strategy.method, file.strategy.bound
    with errors_in(f"{file.path}: [strategy] "):
        return permissive_strategy(nodes.game, nodes.objective, method=method, bound=bound)


def check_strategy(nodes: Nodes, strategy: Permissive, restricted: Restriction) -> Verification:
    """An independent check that the system wins whichever of the allowed moves it makes."""
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


# --- a play that the environment wins -------------------------------------------------------


def lost_play(nodes: Nodes, winning: Winning, node: int, actions: tuple[str, ...]) -> Play:
    """One play from a node outside of the winning region, until it fails or repeats.

    The environment follows its strategy. The system holds out as long as it can where its
    defeat is a matter of time, and else makes its first move; chance goes against it.
    """
    game, objective = nodes.game, winning.objective
    failed = _failed(nodes, objective)
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
        """The successor that is worst for the system."""
        nexts = successor[node, action][used[node, action]]
        nexts = nexts[outside[nexts]]
        return int(nexts[np.argmin(time[nexts])])

    steps, met, memory, by_chance = [Step(node, "start", "")], {(node, 0): 0}, 0, False
    while not failed[node]:
        if system[node]:
            # Every move has a successor outside of the region, or the node were inside.
            moves = np.flatnonzero(available[node])
            action = int(max(moves, key=lambda a: time[worst(int(a))]))
        else:
            action = int(counter[node, memory])
        target, mover = worst(action), "system" if system[node] else "environment"
        mover = "chance" if nodes.by_chance[node] else mover
        by_chance |= used[node, action].sum() > 1
        memory = (memory + int(advances[memory, node])) % len(advances)
        node = target
        steps.append(Step(node, mover, "" if mover == "chance" else actions[action]))
        if (node, memory) in met:
            return Play(steps, met[node, memory], False, bool(by_chance))
        met[node, memory] = len(steps) - 1
    # An automaton reads the label of the state that is left, so the step before decides.
    return Play(
        steps[: max(1, len(steps) - (nodes.automaton is not None))], None, True, bool(by_chance)
    )


def _failed(nodes: Nodes, objective: Parity | GR1) -> np.ndarray:
    """Where the task has failed, whatever follows."""
    failed = np.asarray(objective.lost)
    if nodes.automaton is not None:
        verdict = np.asarray(make_monitor(nodes.automaton).verdict)
        failed = failed | (verdict == Verdict.VIOLATED)[nodes.automaton_state]
    return failed


def demand(found: Synthesis) -> None:
    """Raises a ValueError if the file demands a strategy and there is none."""
    if found.file.demanded and found.strategy is None:
        where = found.world.describe(int(found.starts[0]))
        raise ValueError(
            f"{found.file.path}: [strategy] demands a strategy, but the task is unrealizable: the "
            f"environment wins from every initial state, for example: {where}. Weaken the task, "
            "assume something of the environment, or leave [strategy] out."
        )
