"""HTML report of a synthesis: winning region, strategy, and plays on the map."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from jaxltl.app.reports import synthesize as report
from jaxltl.app.reports.drawing import Picture, draw
from jaxltl.app.reports.explorer import Explorer, Run, TooLarge, View, explorer
from jaxltl.app.reports.figures import Remark
from jaxltl.app.reports.page import render_page
from jaxltl.app.reports.synthesize import describe_play, is_confirmed, verdict
from jaxltl.app.synthesize import Synthesis
from jaxltl.envs.text_map import parse_map
from jaxltl.app.wording import Result
from jaxltl.core.files import atomic_write

_PLAY_STEPS = 40  # of a play of the strategy
_PLAYERS = ("system", "environment")
_TITLES = {
    "automaton.svg": ("Automaton of the formula", "States are named by the remaining formula."),
    "region.svg": ("Winning region", "A map for each place of the environment's robot."),
    "moves.svg": (
        "Permissive strategy",
        "The allowed moves, for one place of the environment's robot; the system wins with any "
        "choice among them.",
    ),
}


def write(found: Synthesis, out: Path, place: int | None, seconds: float) -> Result:
    """Writes the strategies, pictures, report and result of a synthesis to a directory."""
    for stale in ("result.json", *report.FILES):
        (out / stale).unlink(missing_ok=True)
    report.save(out, found)
    pictures = report.pictures(found, place)
    result = report.summary(found, seconds)
    text = page(result, found, pictures, (out / "game.toml").read_text())
    # The result is last, so that its presence implies that all other files are complete.
    encoded = (json.dumps(result, indent=2, allow_nan=False) + "\n").encode()
    files = (("report.html", text.encode()), ("result.json", encoded))
    for name, content in (*pictures, *files):
        with atomic_write(out / name) as file:
            file.write(content)
    return result


def page(
    result: Result, found: Synthesis, pictures: Iterable[tuple[str, bytes]], file_text: str
) -> str:
    """The report in HTML."""
    part = play_explorer(found)
    drawn = {key: draw(each).decode() for key, each in part.drawings.items()}
    shown = [
        (Picture(name, title, None, caption, "play" if name == "automaton.svg" else ""), svg)
        for name, svg in pictures
        for title, caption in [_TITLES[name]]
    ]
    return render_page(
        "synthesis.html",
        {**result, "task": result["game"], "formula": result["task"]},
        [(part, drawn)],
        shown,
        file_text,
        remarks=remarks(result),
        tiles=_tiles(result),
        play="\n".join(describe_play(found)),
        file_title="Game file",
    )


def _tiles(result: Result) -> list[tuple[str, str]]:
    region, strategy = result["region"], result["strategy"]
    tiles = [
        (
            f"{region['initial_states']} of {region['num_initial_states']}",
            "initial states from which the system wins",
        )
    ]
    if strategy:
        kind = "all winning ones" if strategy["maximal"] else "not all winning ones"
        tiles += [
            (str(strategy["num_states"]), "states of the game under the strategy"),
            (str(strategy["num_system_moves"]), f"moves allowed to the system, {kind}"),
        ]
    return tiles


def remarks(result: Result) -> list[Remark]:
    """Remarks on the result, with their kinds."""
    kinds = {"realizable": "good", "partly realizable": "note", "unrealizable": "warning"}
    return [
        (kinds[result["outcome"]], f"The task is {result['outcome']}."),
        ("good" if is_confirmed(result) else "warning", verdict(result)),
    ]


def play_explorer(found: Synthesis) -> Explorer | TooLarge:
    """Plays on the map: one of the strategy, and one that the environment wins."""
    world, nodes = found.world, found.nodes
    runs = []
    if found.strategy is not None and found.restricted is not None:
        runs.append(Run("the system follows its strategy", _strategy_play(found)))
    if found.play is not None:
        runs.append(Run("the environment wins", _counter_play(found)))
    visited = {state for run in runs for state, _, _ in run.steps}
    place = None
    cells: dict[int, list[int]] = {}
    caption = "Step by step."
    if world.text is not None and world.places is not None:
        place, count = parse_map(world.text), len(world.places)
        number = world.places @ [place.shape[1], 1]
        for state in visited:
            environment, system, _ = np.unravel_index(state, (count, count, 2))
            cells[state] = [int(number[system]), int(number[environment])]
        caption = (
            "Step by step: on the map the larger piece is the system's robot, the smaller one the "
            "environment's."
        )
    return explorer(
        View(
            name="play",
            title="Plays",
            caption=caption,
            size=world.game.num_states if place is None else place.size,
            place=place,
            actions=tuple(f"{name} ({player})" for player in _PLAYERS for name in world.actions),
            wall=world.wall,
            cells=cells,
            places={state: world.describe(state) for state in visited},
        ),
        nodes.automaton,
        {},
        runs,
    )


def _counter_play(found: Synthesis) -> list[tuple[int, int, int | None]]:
    """The play that the environment wins; chance has no action."""
    assert found.play is not None
    world, nodes, steps = found.world, found.nodes, found.play.steps
    moves: list[int | None] = [
        None
        if step.mover == "chance"
        else _PLAYERS.index(step.mover) * len(world.actions) + world.actions.index(step.action)
        for step in steps[1:]
    ]
    return [
        (int(nodes.world_state[step.node]), int(nodes.automaton_state[step.node]), move)
        for step, move in zip(steps, [*moves, None], strict=True)
    ]


def _strategy_play(found: Synthesis) -> list[tuple[int, int, int | None]]:
    """A play with random moves among those that the strategy allows."""
    assert found.strategy is not None and found.restricted is not None
    game, nodes, rng = found.restricted.model, found.nodes, np.random.default_rng(0)
    base = np.asarray(found.strategy.base_state)[np.asarray(found.restricted.base_state)]
    mdp = game.mdp
    successor, chance = np.asarray(mdp.successor), np.asarray(mdp.probability, float)
    allowed, system = np.asarray(game.available), np.asarray(game.system)
    count = len(found.world.actions)
    initial = np.asarray(game.initial, float)
    here = int(rng.choice(len(initial), p=initial / initial.sum()))
    steps: list[tuple[int, int, int | None]] = []
    for _ in range(_PLAY_STEPS):
        action = int(rng.choice(np.flatnonzero(allowed[here])))
        shown = None if action >= count else action + count * (not system[here])
        node = base[here]
        steps.append((int(nodes.world_state[node]), int(nodes.automaton_state[node]), shown))
        likely = chance[here, action]
        here = int(rng.choice(successor[here, action], p=likely / likely.sum()))
    return steps
