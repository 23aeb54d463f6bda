"""Pictures, one call each: automata, models, grid maps, games of two robots, learning curves.

Each function returns a new matplotlib ``Figure`` and touches no global state, so it works
without a display and in any thread. ``figure.savefig("name.svg")`` writes it. Those named live
return the text of an SVG for pages that move, and ``playback`` that of one that moves by itself.
"""

from jaxltl.plot.automata import automaton
from jaxltl.plot.curves import bands, curves, guarantees, lines, paths, sweep
from jaxltl.plot.described import described
from jaxltl.plot.episodes import draw_episode, draw_episodes, play_episode
from jaxltl.plot.games import compare, game_moves, game_region, game_values
from jaxltl.plot.live import live_automaton, live_curve, live_map
from jaxltl.plot.maps import grid, strategies
from jaxltl.plot.models import model, solution
from jaxltl.plot.playback import playback
from jaxltl.plot.style import to_bytes
from jaxltl.plot.worlds import temporal_gridworld

__all__ = [
    "automaton",
    "bands",
    "compare",
    "curves",
    "described",
    "draw_episode",
    "draw_episodes",
    "game_moves",
    "game_region",
    "game_values",
    "grid",
    "guarantees",
    "lines",
    "live_automaton",
    "live_curve",
    "live_map",
    "model",
    "paths",
    "play_episode",
    "playback",
    "solution",
    "strategies",
    "sweep",
    "temporal_gridworld",
    "to_bytes",
]
