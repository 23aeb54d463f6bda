"""Report of a synthesis: summary, text, strategy files, pictures and the HTML page."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxltl.app.files.game import SolvedGame, task_text
from jaxltl.app.wording import plain, took
from jaxltl.app.run_job import begin_drawing, write_results
from jaxltl.io.certificate.results import Certifiable, formula_question, write_certificates
from jaxltl.plot.drawing import Picture, draw
from jaxltl.plot.explorer import Explorer, ReportTrajectory
from jaxltl.app.reports.page import Report, Section, aligned, number
from jaxltl.app.wording import Record, Result
from jaxltl.core.games import GR1, Permissive, Winning
from jaxltl.core.games.synthesis import EnvironmentPlay, strategy_play
from jaxltl.core.games.strategy_policy import explored, policy_of_nodes
from jaxltl.core.models.game import Game, is_deterministic
from jaxltl.core.models.product import product
from jaxltl.core.policies.policy_file import save_policy, write_policy_file
from jaxltl.envs.text_map import parse_map


# --- results --------------------------------------------------------------------------------


def summary(synthesis: SolvedGame, seconds: float) -> Record:
    """The results for ``result.json``."""
    file, world = synthesis.file, synthesis.world
    wins, starts = synthesis.wins, synthesis.starts
    won = int(wins[starts].sum())
    outcome = "realizable" if won == starts.size else "partly realizable" if won else "unrealizable"
    automaton, about = synthesis.nodes.automaton, None
    strategy, verdict = synthesis.strategy, synthesis.strategy_verdict
    if strategy is not None and synthesis.restricted is not None and verdict is not None:
        game, memory = synthesis.restricted.model, strategy.game.state_shape
        system, available = np.asarray(game.system), np.asarray(game.available)
        about = {
            "maximal": strategy.maximal,
            "reason": strategy.reason,
            "num_memory": memory[1] if len(memory) > 1 else 1,
            "num_states": game.num_states,
            "num_system_states": int(system.sum()),
            "num_moves": int(available.sum()),
            "num_system_moves": int(available[system].sum()),
            "confirmed": verdict.system,
            "refuted_by": verdict.reason,
        }
    result = {
        "game": file.name,
        "task": task_text(file.task),
        "chance": file.task.chance,
        "deterministic": is_deterministic(world.game),
        "num_states": world.game.num_states,
        "num_memory": 1 if automaton is None else len(automaton.delta),
        "outcome": outcome,
        "region": {
            "states": int(wins.sum()),
            "initial_states": won,
            "num_initial_states": int(starts.size),
            "lost_initial_states": [world.position(s) for s in synthesis.lost_starts[:100]],
        },
        "verdict": synthesis.verdict._asdict(),
        "strategy": about,
        "expected_moves": synthesis.moves
        and dict(zip(("drawn", "any"), synthesis.moves, strict=True)),
        "play": synthesis.play
        and {
            **vars(synthesis.play),
            "steps": [
                {"mover": step.mover, "move": step.action, **synthesis.position(step)}
                for step in synthesis.play.steps
            ],
        },
        **took(seconds),
    }
    return dict(plain(result))


def is_confirmed(result: Result) -> bool:
    """True if the independent check confirms a :func:`summary`."""
    claims, strategy = result["verdict"], result["strategy"]
    sound = strategy is None or strategy["confirmed"]
    return bool(claims["system"] and claims["environment"] and sound)


def report_of(synthesis: SolvedGame) -> Report:
    """The report of a synthesis, of its :func:`summary`."""

    def values(result: Result) -> Record:
        reason = f"permissive strategy, {(result['strategy'] or {}).get('reason')}"
        moves = (result["expected_moves"] or {}).values()
        return {
            "synthesis": synthesis,
            "reason": textwrap.fill(reason, 96, subsequent_indent="  "),
            "moves": ["unbounded" if x is None else number(x) for x in moves],
            "verdict": verdict(result),
            "confirmed": is_confirmed(result),
            "play": describe_play(synthesis),
            "title": result["game"],
            "formula": result["task"],
            "file_title": "Game file",
        }

    return Report("synthesis", values, has_remarks=False)


def verdict(result: Result) -> str:
    """Verdict of the independent check, as text."""
    strategy = result["strategy"]
    if is_confirmed(result):
        more = " and the permissive strategy" if strategy else ""
        return f"independent check: confirmed, both players' strategies{more}"
    reasons = [result["verdict"]["reason"], (strategy or {}).get("refuted_by", "")]
    return f"independent check: REFUTED: {' '.join(r for r in reasons if r)}"


# --- plays -----------------------------------------------------------------------------------


def describe_play(synthesis: SolvedGame) -> list[str]:
    """A play that the environment wins, as lines of a table."""
    play, world = synthesis.play, synthesis.world
    if play is None:
        return []
    rows = [["step", "mover", "move", *(world.position(0))]]
    for i, step in enumerate(play.steps):
        where = synthesis.position(step).values()
        cells = (f"{x['row']}, {x['column']}" if isinstance(x, dict) else str(x) for x in where)
        rows.append([str(i), step.mover, step.action, *cells])
    return [f"  {line}" for line in (*aligned(rows), _ending(play, synthesis))]


def _ending(play: EnvironmentPlay, synthesis: SolvedGame) -> str:
    last, objective = len(play.steps) - 1, synthesis.winning.objective
    if play.failed:
        chance = ", after random moves against the system" if play.by_chance else ""
        return f"the objective is violated in step {last}{chance}"
    round_ = f"steps {play.repeats_from} to {last} repeat"
    if play.by_chance:
        return f"{round_} as long as random moves are against the system"
    never = []
    if isinstance(objective, GR1):
        loop = [step.node for step in play.steps[play.repeats_from :]]
        met = [bool(np.asarray(row)[loop].any()) for row in objective.guarantees]
        guarantees = synthesis.file.task.guarantees or ()
        never = [g for g, m in zip(guarantees, met, strict=True) if not m]
    missed = f"never satisfy {' nor '.join(never)}" if never else "violate the objective"
    return f"{round_} for ever, and {missed}"


# --- files ----------------------------------------------------------------------------------


def save(out: Path, synthesis: SolvedGame) -> None:
    """Writes the strategies into a directory, atomically, as policies that `load_policy` reads.

    Besides the arrays of a policy of the world they have those of the solved game:
    ``strategy.npz``, if the system wins from some initial state, is its permissive strategy as
    the restricted game of N states: ``successor``, ``probability``, ``initial``, ``system``,
    ``label``, ``propositions`` and ``actions`` as in a game file's model; the allowed moves
    ``mask [N, A]``; ``world_state``, ``automaton_state`` and ``memory [N]`` of each state; and the
    winning region of the world, ``region [S]``.

    ``counter_strategy.npz``, if the environment wins from some: ``counter_action [N]``, or for
    GR(1) ``[N, M]`` with ``assumptions [M, N]``, which advance its memory; and its game of N
    nodes, as above.
    """
    nodes, winning = synthesis.nodes, synthesis.winning
    if synthesis.strategy is not None and synthesis.restricted is not None:
        arrays = _arrays(synthesis, synthesis.restricted.model, synthesis.base)
        arrays["mask"] = synthesis.restricted.model.available
        arrays["memory"] = synthesis.restricted.memory
        _write(out / "strategy.npz", "strategy", synthesis, synthesis.strategy, arrays)
    if synthesis.play is not None:
        game = nodes.game
        lost = jnp.where(winning.region, 0, game.initial)
        game = replace(game, mdp=game.mdp.replace(initial=lost / lost.sum()))
        arrays = _arrays(synthesis, game, np.arange(game.num_states))
        arrays |= {"counter_action": winning.counter_action, "available": game.available}
        if isinstance(winning.objective, GR1):
            arrays["assumptions"] = winning.objective.assumptions
        _write(out / "counter_strategy.npz", "counter-strategy", synthesis, winning, arrays)


def _write(
    path: Path, kind: str, synthesis: SolvedGame, strategy: Permissive | Winning, arrays: Record
) -> None:
    """Writes a strategy as a finite-memory policy, or as its game alone where it is none."""
    nodes, world = synthesis.nodes, synthesis.world
    player = "system" if isinstance(strategy, Permissive) else "environment"
    part = explored(strategy, player)
    memory, task = part.memory, None
    if nodes.automaton is not None:
        memory = nodes.automaton_state[part.state] + memory * len(nodes.automaton.delta)
        task = product(world.game.mdp, nodes.automaton, label_on="exit")
    skipped, state = nodes.by_chance[part.state], nodes.world_state[part.state]
    part = part._replace(state=state, memory=memory)
    options: Record = {"skipped": skipped, "task": task, "actions": world.actions}
    try:
        policy = policy_of_nodes(part, world.game.num_states, **options)
    except ValueError:  # an adversary's random moves
        write_policy_file(path, kind, arrays)
        return
    save_policy(path, policy, {k: v for k, v in arrays.items() if k != "actions"})


def _arrays(synthesis: SolvedGame, game: Game, node: np.ndarray) -> Record:
    return {
        **{name: getattr(game.mdp, name) for name in ("successor", "probability")},
        **{name: getattr(game, name) for name in ("initial", "system", "label")},
        "propositions": np.array(game.propositions, str),
        "actions": np.array(synthesis.world.actions),
        "world_state": synthesis.nodes.world_state[node],
        "automaton_state": synthesis.nodes.automaton_state[node],
        "region": synthesis.wins,
    }


FILES = (
    "certificate.umb",
    "strategy.npz",
    "counter_strategy.npz",
    "automaton.svg",
    "region.svg",
    "moves.svg",
    "report.html",
)
MAX_MAPS = 36  # of the environment's places


def pictures(synthesis: SolvedGame, environment: int | None = None) -> list[Picture]:
    """Pictures: the automaton, and maps if the game has one."""
    # Import here: solving alone does not need matplotlib.
    from jaxltl import plot

    drawn = []
    if synthesis.nodes.automaton is not None and len(synthesis.nodes.automaton.delta) <= 40:
        caption = "States are named by the remaining formula."
        svg = plot.to_bytes(plot.automaton(synthesis.nodes.automaton))
        drawn.append(Picture("automaton.svg", "Automaton of the formula", svg, caption, "play"))
    world = synthesis.world
    if world.text is not None and world.places is not None:
        count = len(world.places)
        few = None
        if count > MAX_MAPS:  # those with the most losing cells, in order
            lost = ~synthesis.wins.reshape(count, count, 2)[:, :, 1]
            few = sorted(np.argsort(-lost.sum(axis=1), kind="stable")[:12].tolist())
        caption = "A map for each place of the environment's robot."
        region = plot.game_region(synthesis.wins, world.text, environment=few, wall=world.wall)
        drawn.append(Picture("region.svg", "Winning region", plot.to_bytes(region), caption))
        if synthesis.strategy is not None:
            caption = (
                "The allowed moves, for one place of the environment's robot; the system wins with "
                "any choice among them."
            )
            goals, names = synthesis.file.task.guarantees or (), world.actions
            options: Record = {"actions": names, "goals": goals, "wall": world.wall}
            moves = plot.strategy_moves(synthesis, world.text, environment, **options)
            svg = plot.to_bytes(moves)
            drawn.append(Picture("moves.svg", "Permissive strategy", svg, caption))
    return drawn


def place_of(synthesis: SolvedGame, cell: tuple[int, int] | None) -> int | None:
    """The index of the place in a cell, which has row and column from 1."""
    if cell is None:
        return None
    places = synthesis.world.places
    if places is None:
        raise ValueError(f"--environment {cell[0]} {cell[1]}: the game has no map.")
    here = np.flatnonzero((places == np.array(cell) - 1).all(axis=1))
    if not here.size:
        rows, columns = places.max(axis=0) + 1
        raise ValueError(
            f"--environment {cell[0]} {cell[1]} is a wall or off the map, which has rows 1 to "
            f"{rows} and columns 1 to {columns}."
        )
    return int(here[0])


# --- the page --------------------------------------------------------------------------------


_PLAY_STEPS = 40  # of a play of the strategy
_PLAYERS = ("system", "environment")


def write(synthesis: SolvedGame, out: Path, place: int | None, seconds: float) -> Result:
    """Writes the strategies, pictures, report and result of a synthesis to a directory."""
    for stale in ("result.json", *FILES):
        (out / stale).unlink(missing_ok=True)
    save(out, synthesis)
    sections: list[Section] = [*pictures(synthesis, place), play_explorer(synthesis)]
    result = {
        **summary(synthesis, seconds),
        "certificates": write_certificates(out, _certifiable(synthesis)),
    }
    begun = begin_drawing(sections, lambda drawing: lambda: draw(drawing))
    write_results(out / "game.toml", report_of(synthesis), result, begun)
    return result


def _certifiable(synthesis: SolvedGame) -> list[Certifiable] | str:
    """The greatest probability of the objective, which 1 and 0 bound where one player wins surely."""
    game, automaton = synthesis.world.game, synthesis.nodes.automaton
    if synthesis.file.task.chance == "adversarial" and not is_deterministic(game):
        return "random moves are the environment's, and the certified game has probabilities"
    count = game.num_states * (1 if automaton is None else len(automaton.delta))
    question = formula_question(task_text(synthesis.file.task))
    return [Certifiable(game, None, question, num_nodes=count)]


def play_explorer(synthesis: SolvedGame) -> Explorer:
    """Plays on the map: one of the strategy, and one that the environment wins."""
    world, nodes, runs = synthesis.world, synthesis.nodes, []

    def steps_of(
        met: Iterable[int], moves: Iterable[int | None]
    ) -> list[tuple[int, int, int | None]]:
        return [
            (int(nodes.world_state[node]), int(nodes.automaton_state[node]), move)
            for node, move in zip(met, moves, strict=True)
        ]

    if synthesis.strategy is not None and synthesis.restricted is not None:
        met, drawn = zip(*strategy_play(synthesis, _PLAY_STEPS), strict=True)
        runs.append(ReportTrajectory("the system follows its strategy", steps_of(met, drawn)))
    if synthesis.play is not None:
        every = synthesis.play.steps
        moves = [
            None  # of chance
            if step.mover == "chance"
            else _PLAYERS.index(step.mover) * len(world.actions) + world.actions.index(step.action)
            for step in every[1:]
        ]
        steps = steps_of((step.node for step in every), [*moves, None])
        runs.append(ReportTrajectory("the environment wins", steps))
    visited = {state for run in runs for state, _, _ in run.steps}
    place, cells, caption = None, {}, "Step by step."
    if world.text is not None and world.places is not None:
        place = parse_map(world.text)
        number = world.places @ [place.shape[1], 1]
        cells = {state: number[list(world.robots(state))].tolist() for state in visited}
        caption = (
            "Step by step: on the map the larger piece is the system's robot, the smaller one the "
            "environment's."
        )
    return Explorer(
        name="play",
        title="Plays",
        caption=caption,
        size=world.game.num_states if place is None else place.size,
        automaton=nodes.automaton,
        layers={},
        runs=runs,
        place=place,
        actions=tuple(f"{name} ({player})" for player in _PLAYERS for name in world.actions),
        wall=world.wall,
        cells=cells,
        places={state: world.describe(state) for state in visited},
    )
