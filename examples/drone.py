"""A drone above fields, as a world of one's own; `drone.toml` beside this file names `make`."""

import jax
import jax.numpy as jnp

from jaxltl import Environment, make_environment
from jaxltl.core.environments import Timestep, make_box

FIELDS = {"base": (0.0, 0.0), "field": (0.7, 0.4), "well": (-0.6, 0.5)}
NEAR = 0.35
MARGIN = 1.6


def make(wind: float = 0.01, horizon: int = 80) -> Environment:
    """The drone begins somewhere, and pushes against its speed and the wind.

    Args:
      wind: the standard deviation of its gusts.
      horizon: after how many steps an episode ends.
    """
    centers = jnp.array(list(FIELDS.values()))

    def reset(key):
        place = jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0)
        return {"place": place, "speed": jnp.zeros(2), "time": jnp.int32(0)}

    def step(world, push, key):
        gust = wind * jax.random.normal(key, (2,))
        speed = 0.8 * world["speed"] + 0.04 * jnp.clip(push, -1, 1) + gust
        place, time = world["place"] + speed, world["time"] + 1
        lost = jnp.abs(place).max() > MARGIN
        after = {"place": place, "speed": speed, "time": time}
        return Timestep(after, reward=0.0, terminated=lost, truncated=time >= horizon)

    def observe(world):
        return jnp.concatenate([world["place"], 10 * world["speed"]])

    def labels(world):
        near = jnp.linalg.norm(world["place"] - centers, axis=1) < NEAR
        out = jnp.abs(world["place"]).max() > 1.3
        return jnp.append(near, out)

    return make_environment(
        reset,
        step,
        observe,
        actions=make_box(-1.0, 1.0, (2,)),
        labels=labels,
        propositions=[*FIELDS, "out"],
        horizon=horizon,
    )
