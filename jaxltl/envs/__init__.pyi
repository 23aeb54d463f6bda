from . import (
    continuous_worlds as continuous_worlds,
    lqr as lqr,
    navigation as navigation,
    navigation_steps as navigation_steps,
    networks as networks,
    post_offices as post_offices,
    robots as robots,
    temporal_gridworld as temporal_gridworld,
)
from .adapters.brax import from_brax as from_brax
from .adapters.brax import from_playground as from_playground
from .adapters.gymnax import from_craftax as from_craftax
from .adapters.gymnax import from_gymnax as from_gymnax
from .adapters.jaxmarl import from_jaxmarl as from_jaxmarl
from .adapters.jumanji import from_jumanji as from_jumanji
from .adapters.minigrid import from_navix as from_navix
from .adapters.pgx import from_pgx as from_pgx
from .adapters.minigrid import from_xminigrid as from_xminigrid
from .by_name import make as make
from .conveyor_world import conveyor_world as conveyor_world
from .flat_world import flat_world as flat_world
from .gridworld import gridworld as gridworld, partial_gridworld as partial_gridworld
from .gymnasium_runner import run_policy as run_policy
from .gymnasium_tables import from_gymnasium as from_gymnasium
from .gymnasium_task import gymnasium_task as gymnasium_task
from .gymnasium_vector import gymnasium_vector as gymnasium_vector
from .letter_world import letter_world as letter_world
from .robots import grid_game as grid_game
from .zone_world import zone_world as zone_world
