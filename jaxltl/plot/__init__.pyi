from .automata import automaton as automaton
from .certificates import certificate as certificate
from .curves import (
    bands as bands,
    curves as curves,
    guarantees as guarantees,
    lines as lines,
    paths as paths,
    sweep as sweep,
)
from .episodes import (
    draw_episode as draw_episode,
    draw_episodes as draw_episodes,
    play_episode as play_episode,
)
from .games import (
    compare as compare,
    game_moves as game_moves,
    game_region as game_region,
    game_values as game_values,
    strategy_moves as strategy_moves,
)
from .live import (
    live_automaton as live_automaton,
    live_curve as live_curve,
    live_map as live_map,
    playback as playback,
)
from .machines import (
    controller as controller,
    live_controller as live_controller,
    windows as windows,
)
from .maps import (
    grid as grid,
    strategies as strategies,
    temporal_gridworld as temporal_gridworld,
)
from .models import model as model, solution as solution
from .style import described as described, to_bytes as to_bytes
