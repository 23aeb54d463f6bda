"""What a synthesis found, as one self-contained page."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jaxltl.app.drawing import Picture, draw
from jaxltl.app.explorer import Explorer, Run, TooLarge, explorer
from jaxltl.app.reports.live import Said, live_page
from jaxltl.app.reports.page import Remark, rows, tiles
from jaxltl.app.reports.synthesize import describe_play, is_confirmed, verdict
from jaxltl.app.synthesize import Synthesis
from jaxltl.envs.text_map import parse_map

_LONGEST = 40  # steps of a play of the strategy
_TITLES = {
    "automaton.svg": ("The task as an automaton", "States are named by what is left to satisfy."),
    "region.svg": ("From where the system wins", "A map for each place of the environment."),
    "moves.svg": (
        "What the system may do",
        "Each allowed move, where the environment's robot is "
        "in one place; whichever of them it makes, it wins.",
    ),
}


def page(
    result: Mapping[str, Any],
    found: Synthesis,
    pictures: Iterable[tuple[str, bytes]],
    file_text: str,
) -> str:
    """The report as HTML that needs no other file.

    Args:
      result: from :func:`~jaxltl.app.reports.synthesize.summary`.
      found: what that sums up.
      pictures: names and SVG.
      file_text: the game file.
    """
    region, strategy = result["region"], result["strategy"]
    figures = [
        (
            f"{region['initial_states']} of {region['num_initial_states']}",
            "initial states from which the system wins",
        )
    ]
    if strategy:
        figures += [
            (str(strategy["num_states"]), "states of the game inside the strategy"),
            (
                f"{strategy['num_system_moves']}",
                "moves that it allows the system, "
                + ("all that lose nothing" if strategy["maximal"] else "not all there are"),
            ),
        ]
    part = play_explorer(found)
    drawn = {key: draw(each).decode() for key, each in part.drawings.items()}
    told = []
    if found.play is not None:
        told = [
            "<h2>A play that the environment wins</h2><div class=scroll><pre><code>"
            + html.escape("\n".join(describe_play(found)))
            + "</code></pre></div>"
        ]
    if strategy:
        told.append(
            "<h2>The strategy</h2>"
            + rows(
                (),
                [
                    ("kind", html.escape(strategy["reason"])),
                    ("memory", str(strategy["num_memory"])),
                    ("states of the system", str(strategy["num_system_states"])),
                    ("moves, the environment's too", str(strategy["num_moves"])),
                ],
                more='class="told"',
            )
        )
    sentence = f"{result['num_states']} states × {result['num_memory']} automaton states"
    shown = [
        (
            Picture(
                name,
                _TITLES[name][0],
                None,
                _TITLES[name][1],
                "play" if name == "automaton.svg" else "",
            ),
            svg,
        )
        for name, svg in pictures
    ]
    said = Said(sentence, remarks(result), tiles(figures), told, "The game file")
    about = {**result, "task": result["game"], "formula": result["task"]}
    return live_page(about, said, [(part, drawn)], shown, file_text)


def remarks(result: Mapping[str, Any]) -> list[Remark]:
    """What the page says first."""
    won = {"realizable": "good", "partly realizable": "note", "unrealizable": "warning"}
    return [
        (won[result["outcome"]], f"The task is {result['outcome']}."),
        ("good" if is_confirmed(result) else "warning", verdict(result)),
    ]


def play_explorer(found: Synthesis) -> Explorer | TooLarge:
    """Plays on the map: one of the strategy, and one that the environment wins."""
    world, nodes = found.world, found.nodes
    names = tuple(f"{name} ({who})" for who in _WHO for name in world.actions)
    runs = []
    if found.strategy is not None and found.restricted is not None:
        runs.append(Run("the system follows its strategy", _strategy_play(found)))
    if found.play is not None:
        steps = found.play.steps
        moves: list[int | None] = [
            None
            if step.mover == "chance"
            else _WHO.index(step.mover) * len(world.actions) + world.actions.index(step.action)
            for step in steps[1:]
        ]
        runs.append(
            Run(
                "the environment wins",
                [
                    (int(nodes.world_state[step.node]), int(nodes.automaton_state[step.node]), move)
                    for step, move in zip(steps, [*moves, None], strict=True)
                ],
            )
        )
    met = {state for run in runs for state, _, _ in run.steps}
    place: Any = None
    cells: dict[int, list[int]] = {}
    if world.text is not None and world.places is not None:
        place, count = parse_map(world.text), len(world.places)
        number = world.places @ [place.shape[1], 1]
        for state in met:
            environment, system, _ = np.unravel_index(state, (count, count, 2))
            cells[state] = [int(number[system]), int(number[environment])]
    return explorer(
        "play",
        "Plays",
        "Step by step: on the map the larger piece is the system's robot, the "
        "smaller one the environment's."
        if place is not None
        else "Step by step.",
        nodes.automaton,
        {},
        runs,
        size=world.game.num_states if place is None else place.size,
        place=place,
        actions=names,
        wall=world.wall,
        cells=cells,
        places={state: world.describe(state) for state in met},
    )


_WHO = ("system", "environment")


def _strategy_play(found: Synthesis) -> list[tuple[int, int, int | None]]:
    """A play in which every player makes some move that the strategy allows."""
    assert found.strategy is not None and found.restricted is not None
    game, nodes, rng = found.restricted.model, found.nodes, np.random.default_rng(0)
    base = np.asarray(found.strategy.base_state)[np.asarray(found.restricted.base_state)]
    mdp: Any = game.mdp
    successor, chance = np.asarray(mdp.successor), np.asarray(mdp.probability, float)
    can, system = np.asarray(game.available), np.asarray(game.system)
    count = len(found.world.actions)
    initial = np.asarray(game.initial, float)
    here = int(rng.choice(len(initial), p=initial / initial.sum()))
    steps: list[tuple[int, int, int | None]] = []
    for _ in range(_LONGEST):
        action = int(rng.choice(np.flatnonzero(can[here])))
        told = None if action >= count else action + count * (not system[here])
        steps.append(
            (int(nodes.world_state[base[here]]), int(nodes.automaton_state[base[here]]), told)
        )
        likely = chance[here, action]
        here = int(rng.choice(successor[here, action], p=likely / likely.sum()))
    return steps
