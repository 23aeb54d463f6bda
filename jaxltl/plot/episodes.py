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

import html
import json
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
from jaxltl.plot.board import ROBOT, rule_cells
from jaxltl.plot.style import ACCENT, FAINT, INK, KINDS, MUTED, PAPER, head, note, write

_PIXELS = 440.0


class Scene(NamedTuple):
    """The geometry of an episode in image coordinates: y points down, origin at the upper left."""

    size: float  # of the square
    cells: int  # the number per side; 0 for continuous worlds
    letters: list[tuple[int, int, str]]  # (column, row, name) of cells
    discs: list[tuple[float, float, float, str]]  # (x, y, radius, name) of round objects
    track: NDArray[np.float64]  # float[T + 1, 2], where the agent was
    heading: NDArray[np.float64] | None  # float[T + 1], where it looked, radians, or None
    shown: list[str]  # the propositions that held, for each of the T + 1 worlds
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
    figure = Figure(figsize=(4.4, 4.9), layout="constrained", facecolor=PAPER)
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
    figure = Figure(figsize=(3.4 * len(episodes), 3.9), layout="constrained", facecolor=PAPER)
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
    shown = [
        ", ".join(name for name, holds in zip(environment.propositions, row, strict=True) if holds)
        for row in label
    ]
    if not isinstance(world, LetterState | FlatState | ZoneState):
        return _free(np.asarray(world, float)[:count], shown)
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
        return Scene(cells, cells, letters, [], track, None, shown, True)
    track = np.asarray(world.place, float)[:count]
    if isinstance(world, FlatState):
        discs = _named(numbers, environment.propositions)
        return _upright(float(numbers.extent), discs, track, None, shown)
    zone, radius = np.asarray(world.zone, float)[0], float(numbers.radius)
    zones = [
        (x, y, radius, name)
        for name, places in zip(environment.propositions, zone, strict=True)
        for x, y in places
    ]
    heading = np.asarray(world.heading, float)[:count]
    return _upright(float(numbers.extent), zones, track, heading, shown)


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


def _free(track: NDArray[np.float64], shown: list[str]) -> Scene:
    """Scene of a world without known regions: marks where propositions become true."""
    least, most = track.min(axis=0), track.max(axis=0)
    side = 1.16 * max(float((most - least).max()), 1e-6)
    corner = (least + most) / 2 - side / 2
    places = np.stack([track[:, 0] - corner[0], side - (track[:, 1] - corner[1])], axis=1)
    marks, before = [], ""
    for (x, y), now in zip(places.tolist(), shown, strict=True):
        if now and now != before:
            marks.append((x, y, 0.03 * side, now))
        before = now
    return Scene(side, 0, [], marks, places, None, shown, False)


def _named(discs: Discs, names: tuple[str, ...]) -> list[tuple[float, float, float, str]]:
    center, radius = np.asarray(discs.center, float), np.asarray(discs.radius, float)
    color = np.asarray(discs.color).argmax(axis=1)
    return [(x, y, r, names[c]) for (x, y), r, c in zip(center, radius, color, strict=True)]


def _upright(
    extent: float, discs: list[Any], track: NDArray[np.float64], heading: Any, shown: list[str]
) -> Scene:
    """Converts from a centred square with y up to image coordinates."""
    turned = [(x + extent, extent - y, r, name) for x, y, r, name in discs]
    places = np.stack([track[:, 0] + extent, extent - track[:, 1]], axis=1)
    return Scene(2 * extent, 0, [], turned, places, heading, shown, False)


def tint(name: str, number: int) -> str:
    """A pale colour: by the name if it is one of a colour, else by number."""
    if not is_color_like(name):
        return KINDS[number % len(KINDS)]
    red, green, blue = (0.55 + 0.45 * x for x in to_rgb(name))
    return to_hex((red, green, blue))


def _met(scene: Scene) -> str:
    """Propositions in the order in which they became true; the last ones if there are many."""
    before, found = "", []
    for now in scene.shown:
        if now and now != before:
            found.append(now)
        before = now
    text = " → ".join(found[-8:])
    return ("… → " if len(found) > 8 else "") + (text or "nothing held")


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

_STYLE = """
:root { color-scheme: light dark; --ink: #1f2a37; --muted: #5a6673; --line: #d5dae0;
  --page: #f6f7f8; --card: #ffffff; --accent: #1a647e; --on-accent: #ffffff; --soft: #eef2f5; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6eaee; --muted: #a3afbb; --line: #3a444f;
  --page: #13171c; --card: #1b2128; --accent: #74c0da; --on-accent: #0d1a20; --soft: #2a333c; } }
body { margin: 0; padding: 1rem; background: var(--page); color: var(--ink);
  font: 1rem/1.5 system-ui, sans-serif; }
main { max-width: 34rem; margin: 0 auto; } h1 { font-size: 1.2rem; margin: 0 0 .6rem;
  overflow-wrap: anywhere; }
svg { width: 100%; height: auto; background: var(--card); border: 1px solid var(--line);
  border-radius: 10px; } svg text { text-anchor: middle; dominant-baseline: central; }
.letter rect { fill: var(--soft); } .letter text { fill: var(--muted); font-weight: 700; }
.rule { stroke: var(--line); fill: none; } .disc text { fill: #1f2a37; }
.track { fill: none; stroke: var(--accent); stroke-width: 3; stroke-linejoin: round; }
.controls { display: flex; gap: .8rem; align-items: center; margin: .7rem 0; }
button { min-width: 5rem; min-height: 2.75rem; border: 0; border-radius: 8px; font: inherit;
  background: var(--accent); color: var(--on-accent); cursor: pointer; }
input { flex: 1; min-width: 0; min-height: 2.75rem; accent-color: var(--accent); }
:focus-visible { outline: 3px solid var(--accent); outline-offset: 2px; }
output { font-variant-numeric: tabular-nums; } .muted { color: var(--muted); }
"""
_SCRIPT = """
const frames = JSON.parse(document.getElementById("frames").textContent);
const token = document.getElementById("token"), bar = document.getElementById("at");
const lines = [...document.querySelectorAll(".track")], told = document.getElementById("told");
const button = document.getElementById("play");
let timer = null;
function show(t) {
  bar.value = t;
  const [x, y] = frames.place[t];
  const turn = frames.turn ? ` rotate(${frames.turn[t]})` : "";
  token.setAttribute("transform", `translate(${x} ${y})${turn}`);
  for (const line of lines) line.style.display = Number(line.dataset.step) <= t ? "" : "none";
  const last = frames.place.length - 1;
  told.textContent = `step ${t} of ${last}: ${frames.shown[t] || "nothing holds"}`;
}
function stop() { clearInterval(timer); timer = null; button.textContent = "Play"; }
button.onclick = () => {
  if (timer) return stop();
  if (Number(bar.value) === frames.place.length - 1) show(0);
  button.textContent = "Pause";
  timer = setInterval(() => {
    const t = Number(bar.value) + 1;
    if (t < frames.place.length) show(t); else stop();
  }, frames.wait);
};
bar.oninput = () => { stop(); show(Number(bar.value)); };
show(0);
"""


def play_episode(environment: Environment, episode: Episode, *, title: str | None = None) -> str:
    """A self-contained HTML page that plays an episode, with a pause button and a slider.

    Args:
      environment, episode, title: as for :func:`draw_episode`.

    Raises:
      ValueError: another world, or many trajectories.
    """
    scene = scene_of(environment, episode)
    zoom = _PIXELS / scene.size
    name = html.escape(_met(scene) if title is None else title)
    frames: dict[str, Any] = {
        "place": (scene.track * zoom).round(1).tolist(),
        "shown": scene.shown,
        "wait": 260 if scene.cells else 40,
    }
    if scene.heading is not None:
        frames["turn"] = (-np.degrees(scene.heading)).round(1).tolist()
    data = json.dumps(frames).replace("<", "\\u003c")
    last = len(scene.track) - 1
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{name}</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style><main><h1>{name}</h1>{_ground_svg(scene, zoom)}"
        '<div class="controls"><button id="play">Play</button>'
        f'<input id="at" type="range" min="0" max="{last}" value="0" aria-label="step"></div>'
        '<p><output id="told" for="at"></output></p></main>'
        f'<script type="application/json" id="frames">{data}</script>'
        f"<script>{_SCRIPT}</script></html>"
    )


def _ground_svg(scene: Scene, zoom: float) -> str:
    """SVG of the map, the track by steps, and the agent."""
    side, parts = scene.size * zoom, []
    for column, row, name in scene.letters:
        x, y = column * zoom, row * zoom
        parts.append(
            f'<g class="letter"><rect x="{x:.1f}" y="{y:.1f}" width="{zoom:.1f}" '
            f'height="{zoom:.1f}"/><text x="{x + zoom / 2:.1f}" y="{y + zoom / 2:.1f}" '
            f'font-size="{zoom * 0.4:.1f}">{html.escape(name)}</text></g>'
        )
    for i in range(1, scene.cells):
        parts.append(
            f'<path class="rule" d="M{i * zoom:.1f} 0V{side:.1f}M0 {i * zoom:.1f}H{side:.1f}"/>'
        )
    for i, (x, y, radius, name) in enumerate(scene.discs):
        x, y = x * zoom, y * zoom
        parts.append(
            f'<g class="disc"><circle cx="{x:.1f}" cy="{y:.1f}" r="{radius * zoom:.1f}" '
            f'fill="{tint(name, i)}"/><text x="{x:.1f}" y="{y:.1f}" font-size="13">'
            f"{html.escape(name)}</text></g>"
        )
    for t in range(len(scene.track) - 1):
        piece = scene._replace(track=scene.track[t : t + 2], shown=[])
        for line in _segments(piece._replace(cells=0)):
            points = " ".join(f"{x:.1f},{y:.1f}" for x, y in line * zoom)
            parts.append(f'<polyline class="track" data-step="{t + 1}" points="{points}"/>')
    radius = zoom * 0.3 if scene.cells else 9
    nose = "" if scene.heading is None else f'<path d="M{radius} -4L{radius + 8} 0L{radius} 4Z"/>'
    parts.append(f'<g id="token" fill="{ROBOT}"><circle r="{radius:.1f}"/>{nose}</g>')
    told = "A map of cells" if scene.cells else "A map"
    return (
        f'<svg viewBox="0 0 {side:.1f} {side:.1f}" role="img" aria-label="{told} with the '
        f'agent on it">{"".join(parts)}</svg>'
    )
