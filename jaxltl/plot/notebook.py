"""Notebook representations of objects: small pictures with a text alternative."""

from __future__ import annotations

import html
import re
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from jaxltl.core.automata.automaton import Automaton
from jaxltl.core.games import Permissive, Winning
from jaxltl.core.models import MDP, DenseMDP, Game, Product, SparseMDP
from jaxltl.core.pretty_print import picture, readable
from jaxltl.core.types import Solution
from jaxltl.plot.automata import automaton
from jaxltl.plot.games import game_region
from jaxltl.plot.models import board_of_robots, model, solution
from jaxltl.plot.style import to_bytes

_STATES, _ARROWS = 40, 120  # of an automaton, up to which it is drawn
_PLACES, _SOME_PLACES = 9, 64  # of a board, up to which there is a map for each, and for some


def svg(draw: Callable[..., Figure], *arguments: object, text: str, **options: object) -> str:
    """A figure as an inline SVG with a text alternative."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of signs that the font lacks, which stay boxes
        drawn = to_bytes(draw(*arguments, **options), "svg").decode()
    label = html.escape(" ".join(text.split()))
    head = f'<svg role="img" aria-label="{label}" style="max-width:100%;height:auto"'
    opening, rest = drawn[drawn.index("<svg") + 4 :].split(">", 1)
    return f"{head}{opening}><title>{label}</title>{rest}"


def _stacked(pictures: list[str], text: str) -> str | None:
    """Pictures stacked vertically in one SVG."""
    if not pictures:
        return None
    sizes = [
        [float(re.search(rf' {side}="([0-9.]+)pt"', one)[1]) for side in ("width", "height")]  # type: ignore[index]
        for one in pictures
    ]
    wide, high = max(w for w, _ in sizes), sum(h for _, h in sizes)
    label, y, parts = html.escape(" ".join(text.split())), 0.0, []
    for one, (_, height) in zip(pictures, sizes, strict=True):
        inner = one.replace('role="img"', f'y="{y:.2f}"', 1).replace('pt"', '"', 2)
        parts.append(re.sub(r' aria-label="[^"]*" style="[^"]*"', "", inner, count=1))
        y += height
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-label="{label}" '
        f'style="max-width:100%;height:auto" width="{wide:.2f}pt" height="{high:.2f}pt" '
        f'viewBox="0 0 {wide:.2f} {high:.2f}"><title>{label}</title>{"".join(parts)}</svg>'
    )


@picture.register
def _(value: Automaton) -> str | None:
    if value.delta.ndim > 2:
        return None
    arrows = sum(len(set(row)) for row in np.asarray(value.delta).tolist())
    if len(value.delta) > _STATES or arrows > _ARROWS:
        return None
    return svg(automaton, value, text=repr(value))


@picture.register(MDP)
@picture.register(DenseMDP)
@picture.register(SparseMDP)
@picture.register(Game)
def _model(value: object) -> str | None:
    try:
        return svg(model, value, text=repr(value))
    except ValueError:  # too large
        return None


@picture.register
def _(value: Product) -> str | None:
    parts = [picture(value.mdp), picture(value.automaton)]
    return _stacked([part for part in parts if part is not None], repr(value))


@picture.register
def _(value: Solution) -> str | None:
    read = readable(value.value)
    if read is None or read.size < 3 or not np.isfinite(read).any():
        return None
    return svg(solution, value, text=repr(value))


@picture.register(Winning)
@picture.register(Permissive)
def _region(value: Winning | Permissive) -> str | None:
    """Winning region on the system's turns in the initial memory state, for games of two robots."""
    game, region = value.game, np.asarray(value.region)
    if isinstance(game.mdp, Product):
        memory = np.asarray(game.mdp.initial_memory)
        region = np.take_along_axis(region, memory[:, None], axis=1)[:, 0]
        game = replace(game, mdp=game.mdp.mdp)
    board = board_of_robots(game)
    if board is None or len(board.places) > _SOME_PLACES:
        return None
    count = len(board.places)
    some = None if count <= _PLACES else [count * i // 4 + count // 8 for i in range(4)]
    return svg(game_region, region, board, environment=some, text=repr(value))
