"""Episodes in worlds that have places: one picture, or a page that plays them.

Example:
  >>> import jax.numpy as jnp, numpy as np
  >>> from jaxltl import make_environment
  >>> from jaxltl.core.environments import Episode, Timestep, make_box
  >>> def step(world, action, key):
  ...     return Timestep({"place": world["place"] + action}, 0.0, False)
  >>> walk = make_environment(
  ...     lambda key: {"place": jnp.zeros(2)}, step, lambda world: world["place"],
  ...     actions=make_box(-1, 1, (2,)), propositions=["far"],
  ...     labels=lambda world: jnp.array([world["place"][0] > 1]))
  >>> zeros, made = np.zeros(2), np.ones(2, bool)
  >>> episode = Episode(  # two steps to the right, as run_episode would return them
  ...     {"place": np.array([[0, 0], [1, 0], [2, 0.0]])}, np.zeros((2, 2)), np.zeros((2, 2)),
  ...     zeros, zeros, np.array([[False], [False], [True]]), made, False, False, np.ones(2))
  >>> from jaxltl.plot import draw_episode, draw_episodes, play_episode
  >>> play_episode(walk, episode, title="to the right").lower().startswith("<!doctype html>")
  True
  >>> len(draw_episode(walk, episode).axes), len(draw_episodes(walk, [episode, episode]).axes)
  (1, 2)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.tree_util import Partial
from matplotlib.axes import Axes
from matplotlib.colors import is_color_like, to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from jaxltl.core.environments import Environment, Episode
from jaxltl.envs.flat_world import Discs, FlatState
from jaxltl.envs.letter_world import LetterState
from jaxltl.envs.zone_world import ZoneState
from jaxltl.io.templates import render
from jaxltl.plot.board import ROBOT, rule_cells
from jaxltl.plot.style import ACCENT, FAINT, INK, KINDS, MUTED, PAPER, blank, head, note, write

_PIXELS = 440.0


class Scene(NamedTuple):
    """The geometry of an episode in image coordinates: y points down, origin at the upper left."""

    size: float  # of the square
    cells: int  # the number per side; 0 for continuous worlds
    letters: list[tuple[int, int, str]]  # (column, row, name) of cells
    discs: list[tuple[float, float, float, str]]  # (x, y, radius, name) of round objects
    track: NDArray[np.float64]  # float[T + 1, 2], where the agent was
    heading: NDArray[np.float64] | None  # float[T + 1], where it looked, radians, or None
    labels: list[str]  # the propositions that held, for each of the T + 1 worlds
    joined: bool  # whether opposite sides are


def draw_episode(environment: Environment, episode: Episode, *, title: str | None = None) -> Figure:
    """The map of a letter world, a flat world or a zone world with one episode as a line.

    Other worlds need a ``place``, ``float[2]``, as an attribute or key; marks show where a
    proposition begins to hold.

    Args:
      environment: the world, with or without a time limit, or a task's environment of it.
      episode: of :func:`~jaxltl.core.environments.episodes.run_episode`, of one trajectory.
      title: default the propositions that held, in order.

    Raises:
      ValueError: another world, or many trajectories.
    """
    figure = blank(4.4, 4.9)
    scene = scene_of(environment, episode)
    _draw_scene(figure.subplots(), scene, title)
    ends = f"ends after {len(scene.track) - 1} steps"
    note(figure, [(ACCENT, "begins", "o"), (ACCENT, ends, "s")])
    return figure


def draw_episodes(
    environment: Environment, episodes: Sequence[Episode], *, titles: Sequence[str] | None = None
) -> Figure:
    """The maps of several episodes, each as in :func:`draw_episode`, side by side.

    Args:
      environment, episodes, titles: one or more episodes of the environment, and their titles.

    Raises:
      ValueError: no episode, another world, or many trajectories in one.
    """
    if not episodes:
        raise ValueError("there is no episode; give at least one.")
    figure = blank(3.4 * len(episodes), 3.9)
    every = figure.subplots(1, len(episodes), squeeze=False)[0]
    for i, (axes, episode) in enumerate(zip(every, episodes, strict=True)):
        _draw_scene(axes, scene_of(environment, episode), titles[i] if titles else None)
    note(figure, [(ACCENT, "begins", "o"), (ACCENT, "ends", "s")])
    return figure


def _draw_scene(axes: Axes, scene: Scene, title: str | None) -> None:
    _draw_ground(axes, scene)
    halo = [withStroke(linewidth=3.0, foreground=PAPER, alpha=0.8)]
    for part in _segments(scene):
        axes.plot(
            *part.T, color=ACCENT, lw=1.5, zorder=5, path_effects=halo, solid_capstyle="round"
        )
    places = _spread(scene)
    for place, marker in ((places[0], "o"), (places[-1], "s")):
        axes.plot(*place, marker, color=ACCENT, ms=7, mec=PAPER, mew=1.0, zorder=6)
    head(axes, _met(scene) if title is None else title)


def scene_of(environment: Environment, episode: Episode) -> Scene:
    """The scene that :func:`draw_episode` and :func:`play_episode` draw."""
    valid = np.asarray(episode.valid)
    if valid.ndim != 1:
        raise ValueError(
            f"the episode has {valid.ndim} axes of steps; take one trajectory of "
            "many, jax.tree.map(lambda x: x[0], episode)."
        )
    world, count = _place_of(episode.world), int(valid.sum()) + 1
    label = np.asarray(episode.label)[:count]
    labels = [
        ", ".join(name for name, holds in zip(environment.propositions, row, strict=True) if holds)
        for row in label
    ]
    if not isinstance(world, LetterState | FlatState | ZoneState):
        return _free(np.asarray(world, float)[:count], labels)
    numbers: Any = environment.labels
    while isinstance(numbers.args[0], Partial):  # wrappers of a limit or a task
        numbers = numbers.args[0]
    numbers = numbers.args[0]
    if isinstance(world, LetterState):
        letter, place = np.asarray(world.letter)[0], np.asarray(world.place)[:count]
        cells = round(len(letter) ** 0.5)
        names = environment.propositions
        letters = [
            (c % cells, c // cells, names[x]) for c, x in enumerate(letter) if x < len(names)
        ]
        track = np.stack([place % cells, place // cells], axis=1) + 0.5
        return Scene(cells, cells, letters, [], track, None, labels, True)
    track = np.asarray(world.place, float)[:count]
    if isinstance(world, FlatState):
        discs = _named(numbers, environment.propositions)
        return _upright(float(numbers.extent), discs, track, None, labels)
    zone, radius = np.asarray(world.zone, float)[0], float(numbers.radius)
    zones = [
        (x, y, radius, name)
        for name, places in zip(environment.propositions, zone, strict=True)
        for x, y in places
    ]
    heading = np.asarray(world.heading, float)[:count]
    return _upright(float(numbers.extent), zones, track, heading, labels)


def _place_of(world: object) -> Any:
    """The innermost world that has places, below wrappers such as time limits and tasks."""
    while not isinstance(world, LetterState | FlatState | ZoneState):
        place = world.get("place") if isinstance(world, dict) else getattr(world, "place", None)
        if place is not None and np.ndim(place) == 2 and np.shape(place)[1] == 2:
            return place
        if hasattr(world, "world"):
            world = world.world
        elif type(world) is tuple and len(world) == 2:
            world = world[0]
        else:
            raise ValueError(
                f"{type(world).__name__} has no picture; give an episode of a "
                "letter_world, a flat_world or a zone_world, or of a world with a "
                "place, float[2]."
            )
    return world


def _free(track: NDArray[np.float64], labels: list[str]) -> Scene:
    """Scene of a world without known regions: marks where propositions become true."""
    least, upper = track.min(axis=0), track.max(axis=0)
    side = 1.16 * max(float((upper - least).max()), 1e-6)
    corner = (least + upper) / 2 - side / 2
    places = np.stack([track[:, 0] - corner[0], side - (track[:, 1] - corner[1])], axis=1)
    marks, before = [], ""
    for (x, y), now in zip(places.tolist(), labels, strict=True):
        if now and now != before:
            marks.append((x, y, 0.03 * side, now))
        before = now
    return Scene(side, 0, [], marks, places, None, labels, False)


def _named(discs: Discs, names: tuple[str, ...]) -> list[tuple[float, float, float, str]]:
    center, radius = np.asarray(discs.center, float), np.asarray(discs.radius, float)
    color = np.asarray(discs.color).argmax(axis=1)
    return [(x, y, r, names[c]) for (x, y), r, c in zip(center, radius, color, strict=True)]


def _upright(
    extent: float, discs: list[Any], track: NDArray[np.float64], heading: Any, labels: list[str]
) -> Scene:
    """Converts from a centred square with y up to image coordinates."""
    turned = [(x + extent, extent - y, r, name) for x, y, r, name in discs]
    places = np.stack([track[:, 0] + extent, extent - track[:, 1]], axis=1)
    return Scene(2 * extent, 0, [], turned, places, heading, labels, False)


def tint(name: str, number: int) -> str:
    """A pale colour: by the name if it is one of a colour, else by number."""
    if not is_color_like(name):
        return KINDS[number % len(KINDS)]
    red, green, blue = (0.55 + 0.45 * x for x in to_rgb(name))
    return to_hex((red, green, blue))


def _met(scene: Scene) -> str:
    """Propositions in the order in which they became true; the last ones if there are many."""
    before, labels = "", []
    for now in scene.labels:
        if now and now != before:
            labels.append(now)
        before = now
    text = " → ".join(labels[-8:])
    return ("… → " if len(labels) > 8 else "") + (text or "nothing held")


def _spread(scene: Scene) -> NDArray[np.float64]:
    """Places with a small drift, so that repeated visits stay visible."""
    count = len(scene.track)
    drift = np.linspace(-0.18, 0.18, count) if scene.cells and count > 1 else np.zeros(count)
    return scene.track + drift[:, None]


def _segments(scene: Scene) -> list[NDArray[np.float64]]:
    """Line segments between places; two halves across a joined border."""
    places, parts = _spread(scene), []
    begin = 0
    for i, step in enumerate(np.diff(scene.track, axis=0)):
        if scene.joined and np.abs(step).max() > 1.5:
            way = -np.sign(step) * (np.abs(step) > 1.5)
            parts.append(np.vstack([places[begin : i + 1], places[i] + 0.55 * way]))
            begin = i + 1
            parts.append(np.vstack([places[i + 1] - 0.55 * way, places[i + 1]]))
    parts.append(places[begin:])
    return [x for x in parts if len(x) > 1]


def _draw_ground(axes: Axes, scene: Scene) -> None:
    for column, row, name in scene.letters:
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor="#eef2f5", lw=0))
        halo = [withStroke(linewidth=2.5, foreground="#eef2f5", alpha=0.8)]
        style = {"weight": "bold", "zorder": 7, "path_effects": halo}
        write(axes, (column + 0.5, row + 0.53), name, 12, MUTED, **style)
    if scene.cells:
        rule_cells(axes, scene.cells, scene.cells, FAINT)
    for i, (x, y, radius, name) in enumerate(scene.discs):
        axes.add_patch(Circle((x, y), radius, facecolor=tint(name, i), alpha=0.75, lw=0, zorder=1))
        write(axes, (x, y), name, 7.5, INK, zorder=3)
    axes.set(xlim=(0, scene.size), ylim=(scene.size, 0), aspect="equal", xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set(color=MUTED, lw=0.8, ls="--" if scene.joined else "-")


# --- a page that plays it -------------------------------------------------------------------------


def play_episode(environment: Environment, episode: Episode, *, title: str | None = None) -> str:
    """A self-contained HTML page that plays an episode, with a pause button and a slider.

    Args:
      environment, episode, title: as for :func:`draw_episode`.

    Raises:
      ValueError: another world, or many trajectories.
    """
    scene = scene_of(environment, episode)
    zoom = _PIXELS / scene.size
    frames: dict[str, Any] = {
        "place": (scene.track * zoom).round(1).tolist(),
        "labels": scene.labels,
        "wait": 260 if scene.cells else 40,
    }
    if scene.heading is not None:
        frames["turn"] = (-np.degrees(scene.heading)).round(1).tolist()
    pieces = [
        scene._replace(track=scene.track[t : t + 2], cells=0) for t in range(len(scene.track) - 1)
    ]
    return render(
        "jaxltl.plot",
        "episode.html",
        title=_met(scene) if title is None else title,
        scene=scene,
        zoom=zoom,
        side=_PIXELS,
        lines=[(t + 1, line) for t, piece in enumerate(pieces) for line in _segments(piece)],
        frames=frames,
        tint=tint,
        robot=ROBOT,
    )
